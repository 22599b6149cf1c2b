"""The next measurement: which frame would tell effects apart that the present frames cannot, by how much, before it is taken.

A shot is rendered at the study's values with hypothetical settings (another exposure, a deeper press, other lights, a turned polarizer);
its derivative images say what it would add. With G_A, G_B what is left of two effects' images, in units of the noise, after everything
that a calibration solves for is projected off, and effect A true with the strength s that was found for it,

    D_AB = s^2 (|G_A|^2 - (G_A.G_B)^2/|G_B|^2)         expected chi2 by which the data prefer A over B at its best
    P(A beats B) = Phi(sqrt(D_AB)/2)

(T-optimality: Atkinson & Fedorov, Biometrika 62, 57 (1975); several and one-sided strengths: `optics.statistics.gap`). Informations of
frames add up, so that a choice among shots costs algebra only. A new press brings unknowns of its own, its place and depth with what
the stage knows of them; every frame brings what the study solves for in each frame. Saturated pixels of a shot do not count.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from optics import statistics as st
from optics.evidence import Candidate, Evidence, Progress, measure, value_of
from optics.noise import SATURATED
from optics.parameter import Values, Variable
from optics.verdict import CLEAR, MARGIN, Advice, Apart, Diagnosis

EXPOSURES = (0.4, 0.15, 2.5)  # of the present one: far enough to bend a response, near enough to see something
DEPTHS = (2.0, 0.5)  # of the present one: a new geometry costs ten times what another light costs, so few are tried
DIMMED = 0.4  # of all lights' power
BRIGHT = 0.5  # share of an image that may saturate before a longer exposure is not worth a frame
DEEPEST = 0.4  # of the gel's thickness: beyond, no contact formula holds
FAR, RIM = 1, 0.7  # places farther out that are tried; share of the pad's half width where they may lie
PLACES = 3  # other places that are tried: as many as a plan of "more presses" takes
TAKEN = 3  # shots of a plan
SHOTS = 20  # that are simulated: each costs the derivative images of one frame
ROWS = 300_000  # values that all shots together may keep: informations of thinned pixels, scaled up
ENOUGH = 4 * CLEAR  # D at which the right one wins in 99.95 % of cases; more is not asked of a plan
MEMBERS = 5  # effects that are told apart at once
LIKELY = 6.0  # of chi2 below the best: 20 times less likely the cause in noise alone; a rival still, but not taken to be true
CLOCKS = ("time", "approach")  # settings that tell when and from where, not what


@dataclass(frozen=True)
class Shot:
    """A frame that could be taken: frame `like` again, but for the settings.

    family    what kind of change it is; words: what to do
    settings  key -> value that differs from the frame `like`
    press     name of the new press that it shows; '': the press of `like`, whose place is known as well as it is
    exposure  factor on the exposure, in the settings already
    frames    how many it costs
    """

    family: str
    words: str
    like: int
    settings: dict[str, float] = field(default_factory=dict)
    press: str = ""
    exposure: float = 1.0
    frames: int = 1


# -- which shots a scene admits ---------------------------------------------------------------------------------------


def families(model, values: Values, frames: Sequence[int], most: int = SHOTS) -> list[Shot]:
    """The shots to try, at most `most`, the families' first members first: found from the keys that the model has and frames turn.

    Places and depths where there is a press, exposure where there is a camera with one, single lights, darkness and dimmed light
    where there are lights, turned and removed films, an object nearer and farther, and for every other setting that the frames turned
    a value between and one beyond.
    """
    like = _typical(model, values, frames)
    now = _now(model, values, like)
    found = [*_exposures(model, now, like), *_presses(model, values, frames, now, like), *_lights(model, values, frames, now, like),
             Shot("repeat", f"{_same(model, like)} once more", like), *_films(model, now, like), *_distances(model, now, like),
             *_turned(model, frames, now, like)]
    found = [s for s in found if all(model.parameters[k].bounds[0] <= v <= model.parameters[k].bounds[1] for k, v in s.settings.items())]
    queues: dict[str, list[Shot]] = {}
    for shot in found:
        queues.setdefault(shot.family, []).append(shot)
    return list(_in_turn(list(queues.values())))[:most]


def _in_turn(queues: list[list[Shot]]) -> Iterator[Shot]:
    for i in range(max(map(len, queues), default=0)):
        yield from (queue[i] for queue in queues if i < len(queue))


def _now(model, values: Values, frame: int) -> dict[str, float]:
    """Numbers that hold in a frame, by key; of a sweep of readings what they share, and the middle of what they do not."""
    own = model.frames[frame]
    swept = {k: float(np.median(v)) for k, v in getattr(own, "readings", {}).items()}
    return {**model.base, **values.common, **own.parameters, **swept, **values.frame.get(frame, {})}


def _keys(model, name: str) -> list[str]:
    return [k for k in model.parameters if k.rpartition(".")[2] == name]


def _press(model) -> tuple[str, str, str] | None:
    """Keys of place and depth of a press; None where nothing can be pressed."""
    depth = _keys(model, "press_depth")
    return tuple(depth[0].replace("press_depth", n) for n in ("press_x", "press_y", "press_depth")) if depth else None


def _same(model, like: int) -> str:
    if getattr(model.frames[like], "readings", None):
        return f"{len(model.frames[like].image)} of the same readings"
    return "the same press" if _press(model) else "the same frame"


def _typical(model, values: Values, frames: Sequence[int]) -> int:
    """The brightest frame that shows a press of middling depth: what the shots vary."""
    press = _press(model)
    if press is not None:
        depths = {f: abs(_now(model, values, f)[press[2]]) for f in frames}
        pressed = sorted(d for d in depths.values() if d > 0)
        if pressed:
            middle = pressed[len(pressed) // 2]
            frames = [f for f in frames if abs(depths[f] - middle) < 1e-6 + 0.02 * middle]
    return max(frames, key=lambda f: float(np.mean(model.frames[f].image)))


def _exposures(model, now: Mapping, like: int) -> Iterator[Shot]:
    for key in _keys(model, "exposure")[:1]:
        image, noise = np.asarray(model.frames[like].image, float), model.noise
        for factor in EXPOSURES:
            brighter = noise.black_level + factor * (image - noise.black_level)
            if factor < 1 or np.mean(brighter >= SATURATED * noise.saturation) < BRIGHT:
                yield Shot("exposure", f"{_same(model, like)} at {factor:g} of the exposure" if factor < 1 else
                           f"{_same(model, like)} at {factor:g} times the exposure", like, {key: factor * float(now[key])}, exposure=factor)


def _presses(model, values: Values, frames: Sequence[int], now: Mapping, like: int) -> Iterator[Shot]:
    keys = _press(model)
    if keys is None:
        return
    known = np.array([[_now(model, values, f)[k] for k in keys] for f in frames])
    known = known[known[:, 2] > 0] if (known[:, 2] > 0).any() else known
    depth = float(np.median(known[:, 2])) or 0.5
    thickness = float(now.get(keys[2].replace("press_depth", "thickness"), math.inf))
    for i, (x, y) in enumerate(places(known[:, :2], _reach(model, known, now, keys), PLACES)):
        yield Shot("another place", f"another press, {depth:.2g} mm deep at x = {x:.2g} mm, y = {y:.2g} mm", like,
                   dict(zip(keys, (x, y, depth))), press=f"place-{i + 1}")
    x, y, here = (float(now[k]) for k in keys)
    here = here or depth
    deep = min(1.5 * here, DEEPEST * thickness)
    wide = _width(model, known, now, keys)
    for i, (u, v) in enumerate(places(known[:, :2], wide, FAR)):
        yield Shot("farther out", f"a press farther out, {deep:.2g} mm deep at x = {u:.2g} mm, y = {v:.2g} mm", like,
                   dict(zip(keys, (u, v, deep))), press=f"far-{i + 1}")
    for factor in DEPTHS:
        to = min(factor * here, DEEPEST * thickness)
        if factor < 1 or to > 1.1 * here:
            family = "deeper press" if factor > 1 else "shallower press"
            yield Shot(family, f"the same place pressed {to:.2g} mm deep", like, dict(zip(keys, (x, y, to))), press=f"depth-{to:.2g}")
    if here > 0:
        yield Shot("no press", "nothing pressed, the same light", like, {keys[2]: 0.0}, press="untouched")


def _width(model, known: np.ndarray, now: Mapping, keys: Sequence[str]) -> np.ndarray:
    """(2,) mm: how far from the middle a press still lies on the pad, as far as the scene says how large that is."""
    found = []
    for key, name, reach in zip(keys, ("width", "length"), np.abs(known[:, :2]).max(0)):
        side = now.get(key.rpartition(".")[0] + f".{name}")
        found.append(RIM * float(side) / 2 if side is not None else min(2 * max(reach, 0.5), 0.9 * model.parameters[key].bounds[1]))
    return np.array(found)


def _reach(model, known: np.ndarray, now: Mapping, keys: Sequence[str]) -> np.ndarray:
    """(2,) how far from the middle presses may lie, mm: as far as they did, or a third of the gel's side where there were few."""
    reach = np.abs(known[:, :2]).max(0)
    sides = [now.get(keys[0].replace("press_x", name)) for name in ("width", "length")]
    least = [0.3 * float(s) if s is not None else 1.0 for s in sides]
    return np.where(reach > 0.3 * np.array(least), reach, least)


def places(known: np.ndarray, reach: np.ndarray, count: int) -> list[tuple[float, float]]:
    """`count` places within +-reach (2,), each as far as can be from all (n, 2) that are known and from each other."""
    grid = np.stack(np.meshgrid(*(np.linspace(-r, r, 7) for r in reach)), -1).reshape(-1, 2)
    taken = list(np.asarray(known, float).reshape(-1, 2))
    found = []
    for _ in range(count):
        distance = np.min([np.hypot(*((grid - t) / reach).T) for t in taken], 0) if taken else -np.hypot(*(grid / reach).T)
        taken.append(grid[int(np.argmax(np.round(distance, 9)))])
        found.append((float(taken[-1][0]), float(taken[-1][1])))
    return found


def _lights(model, values: Values, frames: Sequence[int], now: Mapping, like: int) -> Iterator[Shot]:
    keys = _keys(model, "power")
    driven = getattr(model, "driven", None)
    if not keys:
        return

    def pattern(on: Sequence[str]) -> dict[str, float]:
        """What a frame sets: drive levels; where levels are no setting of this model, only what is dark is said."""
        return {k: float(k in on) for k in keys if driven is not None or k not in on}

    lit = lambda f: tuple(k for k in keys if _now(model, values, f)[k] != 0)  # noqa: E731
    here, what = lit(like), _same(model, like)
    seen = dict.fromkeys([here, *map(lit, frames)])
    wanted = [p for p in seen if p and p != here]
    half = len(keys) // 2
    subsets = [tuple(keys), *([tuple(keys[:half]), tuple(keys[half:])] if len(keys) > 3 else []), *((k,) for k in keys)]
    wanted += [p for p in subsets if p != here and p not in wanted and len(keys) > 1]
    for on in wanted:
        names = [k.rpartition(".")[0] for k in on]
        words = "all lights on" if len(on) == len(keys) else f"{names[0]} alone" if len(on) == 1 else "only " + ", ".join(names) + " lit"
        yield Shot("other light", f"{what}, {words}", like, pattern(on))
    yield Shot("dark", "all lights off", like, dict.fromkeys(keys, 0.0))
    if driven is not None and here:
        dimmed = {k: DIMMED * float(model.frames[like].parameters.get(k, 1.0)) for k in here}
        yield Shot("dimmed light", f"{what} at {DIMMED:g} of the lights' power", like, {**pattern(here), **dimmed})


def _films(model, now: Mapping, like: int) -> Iterator[Shot]:
    """Angles of polarizers and sheets, and films put in and taken out."""
    what = _same(model, like)
    for key in _keys(model, "angle"):
        inserted = f"{key.rpartition('.')[0]}.inserted"
        if not now.get(inserted, 1.0):
            for turn in (45.0, 20.0):
                yield Shot("film put in", f"{what}, {key.rpartition('.')[0]} put in at {now[key] + turn:g} deg", like,
                           {inserted: 1.0, key: float(now[key]) + turn})
            continue
        for turn in (45.0, 90.0, 20.0):
            to = (float(now[key]) + turn) % 180.0
            yield Shot("polarizer angle", f"{what} with {key} = {to:g} deg", like, {key: to})
        if inserted in now:
            yield Shot("film taken out", f"{what} without {key.rpartition('.')[0]}", like, {inserted: 0.0})


def _distances(model, now: Mapping, like: int) -> Iterator[Shot]:
    for key in _keys(model, "distance"):
        for factor in (0.5, 2.0, 0.25):
            if now[key] > 0:
                to = factor * float(now[key])
                yield Shot("object distance", f"the object at {to:.3g} mm", like, {key: to}, press=f"distance-{to:.3g}")


def _turned(model, frames: Sequence[int], now: Mapping, like: int) -> Iterator[Shot]:
    """Settings that the frames turned and no family above knows: a value in the widest gap, and one beyond."""
    special = {*(_press(model) or ()), *(k for n in ("power", "exposure", "angle", "inserted", "distance", *CLOCKS) for k in _keys(model, n))}
    turned: dict[str, set[float]] = {}
    for f in frames:
        own = model.frames[f]
        for key, value in (*own.parameters.items(), *getattr(own, "readings", {}).items()):
            if key not in special and not isinstance(value, str):
                turned.setdefault(key, set()).update(np.unique(value).tolist())
    for key, taken in turned.items():
        if len(taken) < 2:
            continue
        levels = sorted(taken)
        gap = int(np.argmax(np.diff(levels)))
        low, high = model.parameters[key].bounds
        beyond = min(levels[-1] + (levels[-1] - levels[0]) / 2, high)
        for to in ((levels[gap] + levels[gap + 1]) / 2, beyond, max(levels[0] - (levels[-1] - levels[0]) / 2, low)):
            if to not in taken:
                unit = model.parameters[key].unit
                yield Shot(f"another {key}", f"{_same(model, like)} with {key} = {to:.4g}{'' if unit in ('', '1') else ' ' + unit}", like, {key: to})


# -- what shots would add ---------------------------------------------------------------------------------------------


@dataclass
class Member:
    """An effect in the information matrix: columns that the present frames see, and those that a shot brings (by shot).

    strength  coefficients of the columns at which the effect is taken to be true
    likely    whether it is taken to be true at all; else it is a rival only
    """

    name: str
    columns: list[int]
    sides: list[int]
    strength: list[float]
    likely: bool = True
    more: dict[int, tuple[list[int], list[int], list[float]]] = field(default_factory=dict)

    def at(self, chosen: Sequence[int]) -> tuple[np.ndarray, list[int], np.ndarray]:
        parts = [(self.columns, self.sides, self.strength), *(self.more[s] for s in dict.fromkeys(chosen) if s in self.more)]
        columns, sides, strength = ([x for part in parts for x in part[i]] for i in range(3))
        return np.array(columns, int), sides, np.array(strength, float)


@dataclass
class Outlook:
    """Informations of the present frames and of each shot, on the same columns: the base, unknowns of the shots, the effects.

    present     (m, m);   shots: [(m, m)]
    base        columns that a calibration solves for, with 1/sd^2 of their priors in `precision`
    nuisances   unknowns that each shot brings, in words
    nested      pairs (i, j) of members where j can do all that i can
    """

    present: np.ndarray
    shots: list[np.ndarray]
    base: list[int]
    precision: np.ndarray
    members: list[Member]
    nuisances: list[list[str]]
    truncation: float
    nested: set[tuple[int, int]] = field(default_factory=set)

    def information(self, chosen: Sequence[int]) -> tuple[np.ndarray, list[int]]:
        """(V, columns): what the present frames and the chosen shots would say of the effects, everything else projected off.

        As `optics.statistics.project`, with a ridge of the size of its truncation in place of eigenvectors: a choice takes hundreds of
        these, and threads that wait for each other make an eigenvector problem of this size fifty times as slow as a solution.
        """
        gram = sum((self.shots[s] for s in chosen), self.present)
        rest = list(dict.fromkeys(i for m in self.members for i in m.at(chosen)[0]))
        raw = np.diag(gram)
        live = [i for i, column in enumerate(self.base) if raw[column] > 0]  # not the unknowns of other shots
        base = [self.base[i] for i in live]
        k, across = gram[np.ix_(base, base)] + np.diag(self.precision[live]), gram[np.ix_(base, rest)]
        scale = 1 / np.sqrt(np.diag(k))[:, None]
        k = k * scale * scale.T + self.truncation * len(base) * np.eye(len(base))
        v = gram[np.ix_(rest, rest)] - across.T @ (scale * np.linalg.solve(k, scale * across))
        seen = np.diag(v) > st.VISIBLE * raw[rest]
        return (v + v.T) / 2 * np.outer(seen, seen), rest

    def gaps(self, chosen: Sequence[int] = ()) -> np.ndarray:
        """(n, n) D[a, b], a true as found; infinite where there is nothing to tell: a itself, what contains a, a not likely."""
        return self.falls(chosen)[0]

    def falls(self, chosen: Sequence[int] = ()) -> tuple[np.ndarray, np.ndarray]:
        """(gaps (n, n), full (n,)): D as in `gaps`, and s'Vs, the fall of chi2 by the true effect itself."""
        v, rest = self.information(chosen)
        place = {column: i for i, column in enumerate(rest)}
        own = [m.at(chosen) for m in self.members]
        index = [np.array([place[c] for c in columns], int) for columns, _, _ in own]
        found, full = np.full((len(own), len(own)), np.inf), np.zeros(len(own))
        cones = [st.Cone(v[np.ix_(i, i)], sides, draws=1) if len(i) > 1 else None for i, (_, sides, _) in zip(index, own)]
        for a, (_, _, strength) in enumerate(own):
            score = v[:, index[a]] @ strength
            full[a] = max(float(strength @ score[index[a]]), 0.0)
            for b, (_, sides, _) in enumerate(own):
                if a == b or (a, b) in self.nested or not self.members[a].likely:
                    continue
                if cones[b] is not None:
                    mimicked = cones[b].solve(score[index[b]])[0]
                else:
                    i = index[b][0]
                    u = score[i] if sides[0] == 0 else max(sides[0] * score[i], 0.0)
                    mimicked = u**2 / v[i, i] if v[i, i] > 0 else 0.0
                found[a, b] = full[a] - mimicked if full[a] - mimicked > 1e-9 * full[a] else 0.0  # below, it is rounding
        return found, full

    def least(self, chosen: Sequence[int] = ()) -> float:
        """The smallest D between any two."""
        return float(self.gaps(chosen).min(initial=np.inf))

    def worth(self, chosen: Sequence[int] = ()) -> float:
        """The smallest D between any two, discounted where it is less than MARGIN of the fall itself: with misfit a verdict asks for both."""
        gaps, full = self.falls(chosen)
        share = gaps / np.where(full > 0, MARGIN * full, 1.0)[:, None]
        return float((gaps * np.minimum(share, 1.0)).min(initial=np.inf))

    def choose(self, count: int, worth: Callable[[Sequence[int]], float], enough: float = math.inf) -> list[int]:
        """Up to `count` shots (one may be taken twice) until they are worth enough: one after the other, each exchanged while that helps."""
        chosen: list[int] = []
        while len(chosen) < count and worth(chosen) < enough:
            chosen.append(max(range(len(self.shots)), key=lambda s: worth([*chosen, s])))
            best, before = worth(chosen), -math.inf
            while best > before and len(chosen) > 1:
                before = best
                for i in range(len(chosen)):
                    trial = max(([*chosen[:i], s, *chosen[i + 1:]] for s in range(len(self.shots))), key=worth)
                    if worth(trial) > best * (1 + 1e-6):
                        best, chosen = worth(trial), trial
        return chosen


def outlook(model, values: Values, evidence: Evidence, members: Sequence[Candidate], strengths: Sequence[np.ndarray],
            shots: Sequence[Shot], variables_of: Callable, seed: int = 0, progress: Progress | None = None) -> Outlook:
    """Render every shot once at the values, and sum up what it would say; no data are needed.

    evidence   of the present frames, in which the members were scored (`columns`, `form`)
    strengths  coefficients of each member's columns at which it is taken to be true
    variables_of(model, effect)  as in `optics.diagnose`, for a model that has the shots as frames
    """
    say = progress or (lambda what, done, total: None)
    first = len(model.frames)
    twin, values = imagined(model, values, shots)
    base, fresh, owners = _base_with_shots(twin, evidence, shots, first)
    again = [_with_shots(twin, values, c, variables_of, first) for c in members]
    pictured = measure(twin, values, [*base, *fresh], again, range(first, len(twin.frames)), ROWS, seed, say, "what other frames would show")

    p, q = len(base), len(fresh)
    present = evidence.base + [i for c in members for i in c.columns]
    wide = p + q + sum(len(c.columns) for c in members)
    at = {i: i for i in range(p + q)}  # columns of `pictured` -> of the joint matrix
    joint, place, extra = [], p + q, wide
    for c, twin_c, strength in zip(members, again, strengths):
        own = list(range(place, place + len(c.columns)))
        place += len(own)
        shared = {v.name: i for v, i in zip(c.variables, own)}
        member = Member(c.effect.name, own, list(c.sides), [float(s) for s in strength])
        rms = float(np.sqrt(np.mean(np.square(strength)))) if len(strength) else 0.0
        for v, side, column in zip(twin_c.variables, twin_c.sides, twin_c.forms[c.form]):
            if v.name not in shared:  # a strength of this frame alone, taken to be as large as the others are
                shared[v.name], extra = extra, extra + 1
                new, sides, sizes = member.more.setdefault(v.frames[0] - first, ([], [], []))
                new.append(shared[v.name])
                sides.append(side)
                sizes.append(-rms if side < 0 else rms)
            at[column] = shared[v.name]
        joint.append(member)
    total = np.zeros((extra, extra))
    known = [*range(p), *range(p + q, wide)]
    total[np.ix_(known, known)] = evidence.normal.gram[np.ix_(present, present)]
    grams = []
    for block in pictured.blocks:
        b = block.a if block.b is None else block.b
        product = block.a.T @ b * pictured.thinning
        where = [at.get(int(i), -1) for i in block.where]
        keep = [i for i, to in enumerate(where) if to >= 0]
        gram = np.zeros((extra, extra))
        np.add.at(gram, np.ix_([where[i] for i in keep], [where[i] for i in keep]), ((product + product.T) / 2)[np.ix_(keep, keep)])
        grams.append(gram)
    precision = np.concatenate([evidence.precision[:p], [0.0 if v.prior is None else 1 / v.prior[1] ** 2 for v in fresh]])
    nuisances = [[_unknown(v) for v, s in zip(fresh, owners) if n in s] for n in range(len(shots))]
    nested = {(i, j) for i, a in enumerate(members) for j, b in enumerate(members) if i != j and b.contains(a)}
    return Outlook(total, grams, [*range(p + q)], precision, joint, nuisances, evidence.normal.truncation(evidence.base), nested)


def imagined(model, values: Values, shots: Sequence[Shot]):
    """(model, values) with the shots as further frames, whose images are what the model predicts."""
    first = len(model.frames)
    frames = [_frame(model, shot, n) for n, shot in enumerate(shots)]
    twin, values = model.imagine(frames), values.copy()
    for key in getattr(twin, "driven", set()) - getattr(model, "driven", set()):
        values.common.setdefault(key, float(model.base[key]))  # what was the light's power is now its power at drive 1
    for n, shot in enumerate(shots):
        own = values.frame.get(shot.like, {})
        values.frame[first + n] = {k: v for k, v in own.items() if k not in shot.settings and not (shot.press and is_place(model, k))}
    for n in range(len(shots)):
        prediction = np.asarray(twin.predict(values, [first + n])[0], float)
        twin.frames[first + n].image = np.minimum(prediction, model.noise.saturation).astype(np.float32)
    return twin, values


def _frame(model, shot: Shot, number: int):
    like = model.frames[shot.like]
    group = getattr(like, "group", None)
    more = {"group": shot.press or group} if shot.press else {}
    if "readings" in {f.name for f in fields(like)}:
        more["readings"] = {k: v for k, v in like.readings.items() if k not in shot.settings}
    return replace(like, name=f"shot-{number + 1}", repeats=[], parameters={**like.parameters, **shot.settings}, **more)


def is_place(model, key: str) -> bool:
    """Whether a parameter belongs to what is touched and not to the frame: all frames of a press share it."""
    return key.rpartition(".")[2].startswith("press_") or model.parameters[key].how == "difference"


def _base_with_shots(twin, evidence: Evidence, shots: Sequence[Shot], first: int) -> tuple[list[Variable], list[Variable], list[set[int]]]:
    """The base's variables, which hold in the shots of their press as well; the unknowns that shots bring, and whose they are."""
    known = [evidence.columns[i] for i in evidence.base]
    base = []
    for v in known:
        shares = () if v.frames is None else tuple(
            first + n for n, s in enumerate(shots) if not s.press and s.like in v.frames and is_place(twin, v.keys[0]))
        base.append(v if v.frames is None else replace(v, frames=(*v.frames, *shares)))
    fresh, owners = [], []
    for keys in dict.fromkeys(v.keys for v in known if v.frames is not None):
        alike = [v for v in known if v.keys == keys and v.frames is not None]
        groups: dict[str, list[int]] = {}
        for n, shot in enumerate(shots):
            if is_place(twin, keys[0]):
                if shot.press and shot.press != "untouched":
                    groups.setdefault(shot.press, []).append(n)
            elif keys[0] not in shot.settings:
                groups.setdefault(twin.frames[first + n].name, []).append(n)
        for name, own in groups.items():
            mean = float(shots[own[0]].settings.get(keys[0], twin.base[keys[0]]))
            prior = None if alike[0].prior is None else (mean, alike[0].prior[1])
            fresh.append(Variable(f"{keys[0]}[{name}]", keys, alike[0].parameter, tuple(first + n for n in own), prior))
            owners.append(set(own))
    return base, fresh, owners


def _unknown(v: Variable) -> str:
    unit = "" if v.parameter.unit in ("", "1") else f" {v.parameter.unit}"
    return v.keys[0] + ("" if v.prior is None else f" +- {v.prior[1]:g}{unit}")


def _with_shots(twin, values: Values, c: Candidate, variables_of: Callable, first: int) -> Candidate:
    """A member with its variables in the shots: those of all frames, and strengths of their own where it has one per frame."""
    variables = [v for v in variables_of(twin, c.effect) if v.frames is None or min(v.frames) >= first]
    return candidate(twin, values, c.effect, variables)


def candidate(model, values: Values, effect, variables: Sequence[Variable]) -> Candidate:
    """An effect under test at the values: where its strengths start, and to which side they may go."""
    start = np.array([value_of(model, values, v) for v in variables])
    near = [1e-6 * abs(v.parameter.plausible) for v in variables]
    sides = [1 if x <= v.parameter.bounds[0] + e else -1 if x >= v.parameter.bounds[1] - e else 0 for v, x, e in zip(variables, start, near)]
    return Candidate(effect, list(variables), start, sides, np.array([v.parameter.plausible for v in variables]))


# -- advice -----------------------------------------------------------------------------------------------------------


def next_measurement(model, values: Values, evidence: Evidence, members: Sequence[Candidate], variables_of: Callable, *,
                     frames: Sequence[int] | None = None, shots: Sequence[Shot] | None = None, take: int = TAKEN, enough: float = ENOUGH,
                     seed: int = 0, progress: Progress | None = None) -> list[Advice]:
    """Shots that tell the members apart, the best of each family, best first; then the best up to `take` together, no more of them than
    bring D to `enough`; and for comparison `take` more presses (or repeats, where nothing is pressed).

    Ranked by the smallest D between any two members, per frame; where no effect explains all, as `Outlook.worth` has it. A member
    whose fall of chi2 is far below the best's counts as a rival and is not taken to be true. Nothing is returned for fewer than two
    members. Costs the derivative images of as many frames as there are shots, of the base and of the members; a new press is the dear part.
    """
    if len(members) < 2:
        return []
    strengths = [strength_of(c) for c in members]
    shots = families(model, values, evidence.frames if frames is None else frames) if shots is None else list(shots)
    seen = outlook(model, values, evidence, members, strengths, shots, variables_of, seed, progress)
    net = [-math.inf if c.row is None else c.row.net if c.row.refit is None else c.row.net_refit for c in members]
    for member, own in zip(seen.members, net):
        member.likely = not max(net) - own > max(LIKELY, MARGIN * max(net))
    before = seen.gaps()
    singles = [seen.gaps([s]) for s in range(len(shots))]
    clean = any(c.row is not None and c.row.refit is not None and c.row.refit.complete for c in members)
    judge = seen.least if clean else seen.worth
    worth = [judge([s]) / shot.frames for s, shot in enumerate(shots)]
    order = sorted(range(len(shots)), key=lambda s: -worth[s])
    best = list({shots[s].family: s for s in reversed(order)}.values())
    best.sort(key=order.index)
    found = [_advice(seen, shots[s].words, shots[s].family, [shots[s]], before, singles[s], seen.nuisances[s]) for s in best]
    plan = seen.choose(take, judge, enough)
    more = [s for s, shot in enumerate(shots) if shot.family == "another place"][:take]
    more = more or [s for s, shot in enumerate(shots) if shot.family == "repeat"] * take
    for family, chosen in (("together", plan), ("more of the same", more)):
        if chosen:
            unknown = list(dict.fromkeys(u for s in chosen for u in seen.nuisances[s]))
            found.append(_advice(seen, _joined([shots[s].words for s in chosen]), family, [shots[s] for s in chosen], before,
                                 seen.gaps(chosen), unknown))
    return found


def _joined(words: Sequence[str]) -> str:
    counted = {w: list(words).count(w) for w in words}
    return "; ".join(w if n == 1 else f"{w} ({n} times)" for w, n in counted.items())


def strength_of(c: Candidate) -> np.ndarray:
    """Coefficients at which a member is taken to be true: as the refit found it, else as the score expects it, else plausible."""
    if c.row is not None and c.row.refit is not None:
        change = np.array(c.row.refit.strength) - c.start
        if np.isfinite(change).all() and change.any():
            return c.linear_of(change)
    if c.linear is not None and c.linear.any():
        return c.linear
    return c.plausible * np.where(np.array(c.sides) < 0, -1.0, 1.0)


def _advice(seen: Outlook, words: str, family: str, shots: Sequence[Shot], before: np.ndarray, after: np.ndarray,
            nuisances: Sequence[str]) -> Advice:
    names = [m.name for m in seen.members]
    pairs = [Apart(names[i], names[j], float(before[i, j]), float(after[i, j]), st.probability_correct(before[i, j]),
                   st.probability_correct(after[i, j]))
             for i in range(len(names)) for j in range(len(names)) if np.isfinite(before[i, j])]
    return Advice(words, family, [dict(s.settings) for s in shots], [s.press for s in shots], sum(s.frames for s in shots),
                  sorted(pairs, key=lambda p: p.before), list(nuisances))


def asked_for(diagnosis: Diagnosis) -> list[str]:
    """Names of the effects that a next measurement has to tell apart; none where the verdict does not hang on that."""
    failed = {c.name for c in diagnosis.conditions if not c.holds}
    if diagnosis.word == "AMBIGUOUS" and len(diagnosis.ambiguous) > 1:
        return diagnosis.ambiguous[:MEMBERS]
    if diagnosis.word != "AMBIGUOUS" and not (diagnosis.word == "CANNOT_TELL" and failed & {"lead", "margin"}):
        return []
    net = {row.name: row.net if row.refit is None else row.net_refit for row in diagnosis.rows}
    best = max(net.values(), default=0.0)
    close = [name for name in sorted(net, key=net.get, reverse=True) if best > 0 and best - net[name] < max(CLEAR, MARGIN * best)]
    return close[:MEMBERS] if len(close) > 1 else []


def advise(model, diagnosis: Diagnosis, variables_of: Callable, seed: int = 0, progress: Progress | None = None) -> list[Advice]:
    """The next measurement after a diagnosis of this process; nothing where it does not hang on two effects that look alike."""
    evidence, names = diagnosis.evidence, asked_for(diagnosis)
    if evidence is None or len(names) < 2:
        return []
    members = [c for c in evidence.candidates if c.effect.name in names and not c.broken and c.columns]
    return next_measurement(model, evidence.values, evidence, members, variables_of, seed=seed, progress=progress)
