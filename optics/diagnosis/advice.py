"""The next measurement: which frame, not yet taken, would tell effects apart that the present frames cannot.

A shot is rendered at the study's values with hypothetical settings (another exposure, a deeper press, other lights, a
turned polarizer); its derivative images determine what it would add. Let G_A, G_B be two effects' images in units of
the noise, after projecting off everything that a calibration solves for, and effect A be true with the strength s that
was found for it. Then

    D_AB = s^2 (|G_A|^2 - (G_A.G_B)^2/|G_B|^2)         expected chi2 by which the data prefer A over B at its best
    P(A beats B) = Phi(sqrt(D_AB)/2)

(T-optimality: Atkinson & Fedorov, Biometrika 62, 57 (1975); several and one-sided strengths:
`optics.diagnosis.statistics.gap`). Informations of frames add up, so that a choice among shots costs algebra only. A
new press brings nuisance parameters: its place and depth, with the stage's priors; every frame brings those that the
study solves for in each frame. Saturated pixels of a shot do not count."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import chain, zip_longest

import numpy as np

from optics.captures.capture_set import Frame
from optics.captures.noise import SATURATED
from optics.diagnosis import statistics as st
from optics.diagnosis.evidence import Candidate, Evidence, Progress, measure
from optics.diagnosis.result import Advice, Apart, Diagnosis, Row
from optics.diagnosis.thresholds import CLEAR, MARGIN, close
from optics.fit.model import Model
from optics.scene.declare import Effect
from optics.scene.parameter import Values, Variable, beside, keys_with
from optics.words import spaced

VariablesOf = Callable[[Model, Effect], Sequence[Variable]]  # what adding an effect to this model frees

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
ENOUGH = 4 * CLEAR  # D at which the right one wins in 99.95 % of cases; a plan needs no more
MEMBERS = 5  # effects that are told apart at once
# of chi2 below the best: 20 times less likely the cause in noise alone; a rival still, but not taken to be true
LIKELY = 6.0
CLOCKS = ("clock", "approach")  # roles of settings that tell when and from where, not what
UNTOUCHED = "untouched"  # the name of no press: it has no place to solve for


@dataclass(frozen=True)
class Shot:
    """A frame that could be taken: frame `like` again, except for the settings.

    family    the kind of change; words: what to do
    settings  key -> value that differs from the frame `like`
    press     name of the new press that it shows; '' for the press of `like`, which shares its place
    """

    family: str
    words: str
    like: int
    settings: dict[str, float] = field(default_factory=dict)
    press: str = ""


# -- which shots a scene admits --------------------------------------------------------------------------------------
def families(model: Model, values: Values, frames: Sequence[int]) -> list[Shot]:
    """The shots to try, at most SHOTS, in turn from each family: by the keys that the model has and that frames turn.

    Places and depths of a press, the camera's exposure, single lights, darkness and dimmed light, turned and removed
    films, a nearer and a farther object; for every other setting that the frames turned, a value between and one beyond
    either end."""
    like = _typical(model, values, frames)
    now = _now(model, values, like)
    found = [
        *_exposures(model, now, like),
        *_presses(model, values, frames, now, like),
        *_lights(model, values, frames, now, like),
        Shot("repeat", f"{_same(model, like)} once more", like),
        *_films(model, now, like),
        *_distances(model, now, like),
        *_turned(model, frames, now, like),
    ]
    found = [
        s
        for s in found
        if all(model.parameters[k].bounds[0] <= v <= model.parameters[k].bounds[1] for k, v in s.settings.items())
    ]
    queues: dict[str, list[Shot]] = {}
    for shot in found:
        queues.setdefault(shot.family, []).append(shot)
    return [shot for shot in chain(*zip_longest(*queues.values())) if shot is not None][:SHOTS]


def _now(model: Model, values: Values, frame: int) -> dict[str, float]:
    """Numbers that hold in a frame, by key; of a sweep of readings, the median of each setting that it turns."""
    own = model.frames[frame]
    swept = {k: float(np.median(v)) for k, v in own.readings.items()}
    return {**model.base, **values.common, **own.parameters, **swept, **values.frame.get(frame, {})}


def _press(model: Model) -> tuple[str, str, str] | None:
    """Keys of place and depth of a press; None where nothing can be pressed."""
    depth = keys_with(model.parameters, "press depth")
    if not depth:
        return None
    x, y = (beside(model.parameters, depth[0], role) for role in ("press x", "press y"))
    return None if x is None or y is None else (x, y, depth[0])


def _same(model: Model, like: int) -> str:
    if model.frames[like].readings:
        return f"{len(model.frames[like].image)} of the same readings"
    return "the same press" if _press(model) else "the same frame"


def _typical(model: Model, values: Values, frames: Sequence[int]) -> int:
    """The brightest frame that shows a press of median depth: the shots vary it."""
    press = _press(model)
    if press is not None:
        depths = {f: abs(_now(model, values, f)[press[2]]) for f in frames}
        pressed = sorted(d for d in depths.values() if d > 0)
        if pressed:
            middle = pressed[len(pressed) // 2]
            frames = [f for f in frames if abs(depths[f] - middle) < 1e-6 + 0.02 * middle]
    return max(frames, key=lambda f: float(np.mean(model.frames[f].image)))


def _exposures(model: Model, now: Mapping, like: int) -> Iterator[Shot]:
    for key in keys_with(model.parameters, "exposure")[:1]:
        image, noise = np.asarray(model.frames[like].image, float), model.noise
        for factor in EXPOSURES:
            brighter = noise.black_level + factor * (image - noise.black_level)
            if factor < 1 or np.mean(brighter >= SATURATED * noise.saturation) < BRIGHT:
                yield Shot(
                    "exposure",
                    f"{_same(model, like)} at {factor:g} {'of' if factor < 1 else 'times'} the exposure",
                    like,
                    {key: factor * float(now[key])},
                )


def _presses(model: Model, values: Values, frames: Sequence[int], now: Mapping, like: int) -> Iterator[Shot]:
    keys = _press(model)
    if keys is None:
        return
    known = np.array([[_now(model, values, f)[k] for k in keys] for f in frames])
    known = known[known[:, 2] > 0] if (known[:, 2] > 0).any() else known
    depth = float(np.median(known[:, 2])) or 0.5
    deepest = DEEPEST * float(now.get(beside(model.parameters, keys[2], "thickness"), math.inf))
    near, far = _reaches(model, known, now, keys)
    for i, (x, y) in enumerate(places(known[:, :2], near, PLACES)):
        yield Shot(
            "another place",
            f"another press, {depth:.2g} mm deep at x = {x:.2g} mm, y = {y:.2g} mm",
            like,
            dict(zip(keys, (x, y, depth))),
            press=f"place-{i + 1}",
        )
    x, y, pressed = (float(now[k]) for k in keys)
    here = pressed or depth
    deep = min(1.5 * here, deepest)
    for i, (u, v) in enumerate(places(known[:, :2], far, FAR)):
        yield Shot(
            "farther out",
            f"a press farther out, {deep:.2g} mm deep at x = {u:.2g} mm, y = {v:.2g} mm",
            like,
            dict(zip(keys, (u, v, deep))),
            press=f"far-{i + 1}",
        )
    for factor in DEPTHS:
        to = min(factor * here, deepest)
        if factor < 1 or to > 1.1 * here:
            family = "deeper press" if factor > 1 else "shallower press"
            yield Shot(
                family,
                f"the same place pressed {to:.2g} mm deep",
                like,
                dict(zip(keys, (x, y, to))),
                press=f"depth-{to:.2g}",
            )
    if pressed > 0:
        yield Shot("no press", "nothing pressed, the same light", like, {keys[2]: 0.0}, press=UNTOUCHED)


def _reaches(model: Model, known: np.ndarray, now: Mapping, keys: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """(2,), (2,) mm from the middle: how far other presses may lie (as far as the present ones, or 0.3 of the gel's
    side where these are few), and how far out one still lies on the pad, if the scene states its size."""
    reach = np.abs(known[:, :2]).max(0)
    sides = [now.get(beside(model.parameters, key, role)) for key, role in zip(keys, ("width", "length"))]
    least = np.array([1.0 if side is None else 0.3 * float(side) for side in sides])
    far = [
        min(2 * max(r, 0.5), 0.9 * model.parameters[key].bounds[1]) if side is None else RIM * float(side) / 2
        for key, side, r in zip(keys, sides, reach)
    ]
    return np.where(reach > 0.3 * least, reach, least), np.array(far)


def places(known: np.ndarray, reach: np.ndarray, count: int) -> list[tuple[float, float]]:
    """`count` places within +-reach (2,), each as far as possible from all known ones (n, 2) and from each other."""
    grid = np.stack(np.meshgrid(*(np.linspace(-r, r, 7) for r in reach)), -1).reshape(-1, 2)
    taken = list(np.asarray(known, float).reshape(-1, 2))
    found = []
    for _ in range(count):
        distance = (
            np.min([np.hypot(*((grid - t) / reach).T) for t in taken], 0) if taken else -np.hypot(*(grid / reach).T)
        )
        taken.append(grid[int(np.argmax(np.round(distance, 9)))])
        found.append((float(taken[-1][0]), float(taken[-1][1])))
    return found


def _lights(model: Model, values: Values, frames: Sequence[int], now: Mapping, like: int) -> Iterator[Shot]:
    keys = keys_with(model.parameters, "power")
    driven = model.driven
    if not keys:
        return

    def pattern(on: Sequence[str]) -> dict[str, float]:
        """What a frame sets: drive levels, or only which lights are dark where this model has no drive levels."""
        return {k: float(k in on) for k in keys if driven is not None or k not in on}

    def lit(frame: int) -> tuple[str, ...]:
        return tuple(k for k in keys if _now(model, values, frame)[k] != 0)

    here, what = lit(like), _same(model, like)
    wanted = [p for p in dict.fromkeys(map(lit, frames)) if p and p != here]
    half = len(keys) // 2
    subsets = [tuple(keys), *([tuple(keys[:half]), tuple(keys[half:])] if len(keys) > 3 else []), *((k,) for k in keys)]
    wanted += [p for p in subsets if p != here and p not in wanted and len(keys) > 1]
    for on in wanted:
        names = [k.rpartition(".")[0] for k in on]
        words = (
            "all lights on"
            if len(on) == len(keys)
            else f"{names[0]} alone"
            if len(on) == 1
            else "only " + ", ".join(names) + " lit"
        )
        yield Shot("other light", f"{what}, {words}", like, pattern(on))
    yield Shot("dark", "all lights off", like, dict.fromkeys(keys, 0.0))
    if driven is not None and here:
        dimmed = {k: DIMMED * float(model.frames[like].parameters.get(k, 1.0)) for k in here}
        yield Shot("dimmed light", f"{what} at {DIMMED:g} of the lights' power", like, {**pattern(here), **dimmed})


def _films(model: Model, now: Mapping, like: int) -> Iterator[Shot]:
    """Angles of polarizers and sheets, and films put in and taken out."""
    what = _same(model, like)
    absent = set(model.captures.absent) if model.captures is not None else set()
    for key in keys_with(model.parameters, "angle"):
        if key.rpartition(".")[0] in absent:  # nobody can turn what is not there
            continue
        inserted = beside(model.parameters, key, "inserted")
        if inserted is not None and not now[inserted]:
            for turn in (45.0, 20.0):
                yield Shot(
                    "film put in",
                    f"{what}, {key.rpartition('.')[0]} put in at {now[key] + turn:g} deg",
                    like,
                    {inserted: 1.0, key: float(now[key]) + turn},
                )
            continue
        for turn in (45.0, 90.0, 20.0):
            to = (float(now[key]) + turn) % 180.0
            yield Shot("polarizer angle", f"{what} with {key} = {to:g} deg", like, {key: to})
        if inserted is not None:
            yield Shot("film taken out", f"{what} without {key.rpartition('.')[0]}", like, {inserted: 0.0})


def _distances(model: Model, now: Mapping, like: int) -> Iterator[Shot]:
    for key in keys_with(model.parameters, "distance"):
        for factor in (0.5, 2.0, 0.25):
            if now[key] > 0:
                to = factor * float(now[key])
                yield Shot("object distance", f"the object at {to:.3g} mm", like, {key: to}, press=f"distance-{to:.3g}")


def _turned(model: Model, frames: Sequence[int], now: Mapping, like: int) -> Iterator[Shot]:
    """Settings that the frames turned and that no family above covers: a value in the widest gap, and one beyond either
    end."""
    known = ("power", "exposure", "angle", "inserted", "distance", *CLOCKS)  # roles
    special = {*(_press(model) or ()), *(k for name in known for k in keys_with(model.parameters, name))}
    turned: dict[str, set[float]] = {}
    for f in frames:
        own = model.frames[f]
        for key, value in (*own.parameters.items(), *own.readings.items()):
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
                yield Shot(
                    f"another {key}",
                    f"{_same(model, like)} with {key} = {to:.4g}{spaced(model.parameters[key].unit)}",
                    like,
                    {key: to},
                )


# -- what shots would add --------------------------------------------------------------------------------------------
@dataclass
class Member:
    """An effect in the information matrix: its columns in the present frames, and those that each shot brings (`more`).

    strength  coefficients of the columns at which the effect is assumed true
    likely    whether it is assumed true at all; otherwise it is only a rival
    """

    name: str
    columns: list[int]
    sides: list[int]
    strength: list[float]
    likely: bool = True
    more: dict[int, tuple[list[int], list[int], list[float]]] = field(default_factory=dict)

    def bring(self, shot: int, column: int, side: int, strength: float) -> None:
        """Add a strength that acts in this shot only."""
        columns, sides, strengths = self.more.setdefault(shot, ([], [], []))
        columns.append(column)
        sides.append(side)
        strengths.append(strength)

    def at(self, chosen: Sequence[int]) -> tuple[np.ndarray, list[int], np.ndarray]:
        """(columns, sides, strength) with those that the chosen shots bring."""
        parts = [
            (self.columns, self.sides, self.strength),
            *(self.more[s] for s in dict.fromkeys(chosen) if s in self.more),
        ]
        columns = [column for own, _, _ in parts for column in own]
        sides = [side for _, own, _ in parts for side in own]
        strength = [s for _, _, own in parts for s in own]
        return np.array(columns, int), sides, np.array(strength, float)


@dataclass
class Outlook:
    """Informations of the present frames and of each shot, on the same columns: the base, nuisance parameters of the
    shots, the effects.

    present     (m, m);   shots: [(m, m)]
    base        columns that a calibration solves for, with 1/sd^2 of their priors in `precision`
    nuisances   nuisance parameters that each shot brings, in words
    truncation  of the base's eigenvalues, see `optics.diagnosis.statistics.Normal.truncation`
    nested      pairs (i, j) of members where j contains i
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
        """(V, columns): information of the present frames and the chosen shots on the effects, all else projected off.

        As `optics.diagnosis.statistics.project`, with a ridge of the size of its truncation in place of eigenvectors: a
        choice takes hundreds of these, and an eigenvector problem of this size takes fifty times as long as a linear
        solve, as its threads wait for each other."""
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
        """(n, n) D[a, b], a true as found; infinite where nothing needs telling apart: for a itself, for what contains
        a, and where a is not likely."""
        return self.falls(chosen)[0]

    def falls(self, chosen: Sequence[int] = ()) -> tuple[np.ndarray, np.ndarray]:
        """(gaps (n, n), full (n,)): D as in `gaps`, and s'Vs, the fall of chi2 by the true effect itself."""
        v, rest = self.information(chosen)
        place = {column: i for i, column in enumerate(rest)}
        own = [m.at(chosen) for m in self.members]
        index = [[place[c] for c in columns] for columns, _, _ in own]
        scores = np.stack(
            [v[:, i] @ strength for i, (_, _, strength) in zip(index, own)]
        )  # (n, k): what each would leave, if true
        full = np.array(
            [max(float(strength @ score[i]), 0.0) for score, i, (_, _, strength) in zip(scores, index, own)]
        )
        found = np.full((len(own), len(own)), np.inf)
        for b, (i, (_, sides, _)) in enumerate(zip(index, own)):
            if len(i) == 1:  # `Cone.solve` of one strength, for all at once: a plan asks hundreds of times
                u = scores[:, i[0]] if sides[0] == 0 else np.maximum(sides[0] * scores[:, i[0]], 0.0)
                mimicked = u**2 / v[i[0], i[0]] if v[i[0], i[0]] > 0 else np.zeros(len(own))
            else:
                cone = st.Cone(v[np.ix_(i, i)], sides, draws=1)
                mimicked = np.array([cone.solve(u)[0] for u in scores[:, i]])
            d = full - mimicked
            found[:, b] = np.where(d > 1e-9 * full, d, 0.0)  # below, it is rounding
        for a, member in enumerate(self.members):
            found[a, [b for b in range(len(own)) if a == b or (a, b) in self.nested or not member.likely]] = np.inf
        return found, full

    def least(self, chosen: Sequence[int] = ()) -> float:
        """The smallest D between any two."""
        return float(self.gaps(chosen).min(initial=np.inf))

    def worth(self, chosen: Sequence[int] = ()) -> float:
        """The smallest D between any two, discounted where it is less than MARGIN of the effect's own fall: where
        misfit is left, a verdict requires both."""
        gaps, full = self.falls(chosen)
        share = gaps / np.where(full > 0, MARGIN * full, 1.0)[:, None]
        return float((gaps * np.minimum(share, 1.0)).min(initial=np.inf))

    def choose(self, count: int, worth: Callable[[Sequence[int]], float], enough: float = math.inf) -> list[int]:
        """Up to `count` shots (one may be taken twice) until they are worth `enough`: greedily, each then exchanged
        while that helps."""
        known = cache(worth)  # exchanges come back to the same shots again and again

        def of(shots: Sequence[int]) -> float:
            return known(tuple(sorted(shots)))

        chosen: list[int] = []
        while len(chosen) < count and of(chosen) < enough:
            chosen.append(max(range(len(self.shots)), key=lambda s: of([*chosen, s])))
            before = -math.inf
            while of(chosen) > before and len(chosen) > 1:
                before = of(chosen)
                for i in range(len(chosen)):
                    trial = max(([*chosen[:i], s, *chosen[i + 1 :]] for s in range(len(self.shots))), key=of)
                    if of(trial) > of(chosen) * (1 + 1e-6):
                        chosen = trial
        return chosen


def outlook(
    model: Model,
    values: Values,
    evidence: Evidence,
    members: Sequence[Candidate],
    strengths: Sequence[np.ndarray],
    shots: Sequence[Shot],
    variables_of: VariablesOf,
    seed: int = 0,
    progress: Progress | None = None,
) -> Outlook:
    """Render every shot once at the values, and sum up its information; this needs no data.

    evidence   of the present frames, in which the members were scored (`columns`, `form`)
    strengths  coefficients of each member's columns at which it is assumed true
    variables_of(model, effect)  as in `optics.diagnosis.diagnose`, for a model that has the shots as frames
    """
    say = progress or (lambda what, done, total: None)
    first = len(model.frames)
    twin, values = imagined(model, values, shots)
    base, fresh = _base_with_shots(twin, evidence, shots, first)
    again = [
        Candidate.at(
            twin,
            values,
            c.effect,
            [v for v in variables_of(twin, c.effect) if v.frames is None or min(v.frames) >= first],
        )
        for c in members
    ]
    imaged = measure(
        twin,
        values,
        [*base, *fresh],
        again,
        range(first, len(twin.frames)),
        ROWS,
        seed,
        say,
        "what other frames would show",
    )

    size = len(base) + len(fresh)
    now, then = (
        dict(zip(evidence.base, range(len(base)))),
        {i: i for i in range(size)},
    )  # columns of `evidence`, `imaged` -> joint ones
    joint = []
    for c, twin_c, strength in zip(members, again, strengths):
        own = list(range(size, size + len(c.columns)))
        size += len(own)
        now.update(zip(c.columns, own))
        shared = {v.name: i for v, i in zip(c.variables, own)}
        member = Member(c.effect.name, own, list(c.sides), [float(s) for s in strength])
        rms = float(np.sqrt(np.mean(np.square(strength)))) if len(strength) else 0.0
        for v, side, column in zip(twin_c.variables, twin_c.sides, twin_c.forms[c.form]):
            if v.frames is not None and v.name not in shared:  # of this frame alone, taken to be as large as the others
                shared[v.name], size = size, size + 1
                member.bring(v.frames[0] - first, shared[v.name], side, -rms if side < 0 else rms)
            then[column] = shared[v.name]
        joint.append(member)
    precision = np.concatenate([evidence.precision, [v.precision for v in fresh]])
    nuisances = [[_unknown(v) for v in fresh if v.holds_in(first + n)] for n in range(len(shots))]
    return Outlook(
        _placed(evidence.normal.gram, now, size),
        [_placed(gram, then, size) for gram in informations(imaged)],
        list(range(len(base) + len(fresh))),
        precision,
        joint,
        nuisances,
        evidence.normal.truncation(evidence.base),
        nested_in(members),
    )


def informations(evidence: Evidence) -> list[np.ndarray]:
    """(m, m) of each frame, on all columns: from the values that were kept, scaled up to all values."""
    found = []
    for block in evidence.blocks:
        normal = st.Normal(len(evidence.columns))
        normal.add(block.where, block.a, block.r, block.b)
        found.append(evidence.thinning * normal.gram)
    return found


def _placed(gram: np.ndarray, to: Mapping[int, int], size: int) -> np.ndarray:
    """(size, size): the columns of a matrix moved to their places `to`; those without a place are left out."""
    found = np.zeros((size, size))
    found[np.ix_(list(to.values()), list(to.values()))] = gram[np.ix_(list(to), list(to))]
    return found


def nested_in(members: Sequence[Candidate]) -> set[tuple[int, int]]:
    """Pairs (i, j) of which j contains i."""
    return {(i, j) for i, a in enumerate(members) for j, b in enumerate(members) if b.contains(a)}


def imagined(model: Model, values: Values, shots: Sequence[Shot]) -> tuple[Model, Values]:
    """(model, values) with the shots as further frames, whose images are the model's predictions."""
    first = len(model.frames)
    twin, values = model.imagine([_frame(model, shot, n) for n, shot in enumerate(shots)]), values.copy()
    for key in (twin.driven or set()) - (model.driven or set()):
        values.common.setdefault(key, float(model.base[key]))  # what was the light's power is now its power at drive 1
    for n, shot in enumerate(shots, first):
        own = values.frame.get(shot.like, {})
        values.frame[n] = {
            k: v for k, v in own.items() if k not in shot.settings and not (shot.press and is_place(model, k))
        }
        twin.frames[n].image = np.minimum(twin.predict(values, [n])[0], model.noise.saturation).astype(np.float32)
    return twin, values


def _frame(model: Model, shot: Shot, number: int) -> Frame:
    like = model.frames[shot.like]
    readings = {k: v for k, v in like.readings.items() if k not in shot.settings}
    return replace(
        like,
        name=f"shot-{number + 1}",
        repeats=[],
        parameters={**like.parameters, **shot.settings},
        group=shot.press or like.group,
        readings=readings,
        rows=None,
    )


def is_place(model: Model, key: str) -> bool:
    """Whether a parameter belongs to the touched object and not to the frame: all frames of a press share it."""
    p = model.parameters[key]
    return p.role.startswith("press ") or p.how == "difference"


def _base_with_shots(
    twin: Model, evidence: Evidence, shots: Sequence[Shot], first: int
) -> tuple[list[Variable], list[Variable]]:
    """The base's variables, extended to the shots of their press, and the nuisance parameters that shots bring."""
    base, fresh = [], []
    kinds: dict[tuple, Variable] = {}  # the first of each kind that frames have for themselves
    for v in (evidence.columns[i] for i in evidence.base):
        if v.frames is not None:
            kinds.setdefault(v.keys, v)
            shares = [
                n
                for n, s in enumerate(shots, first)
                if not s.press and s.like in v.frames and is_place(twin, v.keys[0])
            ]
            v = replace(v, frames=(*v.frames, *shares))
        base.append(v)
    for keys, v in kinds.items():
        groups: dict[str, list[int]] = {}
        for n, shot in enumerate(shots, first):
            if is_place(twin, keys[0]):
                owner = "" if shot.press == UNTOUCHED else shot.press
            else:
                owner = "" if keys[0] in shot.settings else twin.frames[n].name
            if owner:
                groups.setdefault(owner, []).append(n)
        # of a prior only the width counts: no data are needed
        fresh += [replace(v, name=f"{keys[0]}[{owner}]", frames=tuple(own)) for owner, own in groups.items()]
    return base, fresh


def _unknown(v: Variable) -> str:
    return v.keys[0] + ("" if v.prior is None else f" +- {v.prior[1]:g}{spaced(v.parameter.unit)}")


# -- advice ----------------------------------------------------------------------------------------------------------
def next_measurement(
    model: Model,
    values: Values,
    evidence: Evidence,
    members: Sequence[Candidate],
    variables_of: VariablesOf,
    *,
    enough: float = ENOUGH,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[Advice]:
    """Shots that tell the members apart: the best of each family, best first; then the best up to TAKEN together, as
    many as bring D to `enough`; and for comparison TAKEN more presses (or repeats, where nothing is pressed).

    Ranked by the smallest D between any two members or, where no effect explains all, by `Outlook.worth`. A member
    whose fall of chi2 is far below the best's counts as a rival only. Empty for fewer than two members. Costs the
    derivative images of the base and the members in as many frames as there are shots; new presses cost most."""
    if len(members) < 2:
        return []
    shots = families(model, values, evidence.frames)
    seen = outlook(
        model, values, evidence, members, [strength_of(c) for c in members], shots, variables_of, seed, progress
    )
    best = max(_net(c.row) for c in members)
    for member, c in zip(seen.members, members):
        member.likely = best - _net(c.row) <= max(LIKELY, MARGIN * best)
    complete = any(c.row.refit is not None and c.row.refit.complete for c in members)
    judge = seen.least if complete else seen.worth
    worth = [judge([s]) for s in range(len(shots))]
    leaders: dict[str, list[int]] = {}
    for s in sorted(range(len(shots)), key=lambda s: -worth[s]):
        leaders.setdefault(shots[s].family, [s])
    more = [s for s, shot in enumerate(shots) if shot.family == "another place"][:TAKEN]
    more = more or [s for s, shot in enumerate(shots) if shot.family == "repeat"] * TAKEN
    plans = {"together": seen.choose(TAKEN, judge, enough), "more of the same": more}
    before = seen.falls()
    return [
        _advice(seen, shots, family, chosen, before, complete)
        for family, chosen in {**leaders, **plans}.items()
        if chosen
    ]


def _net(row: Row) -> float:
    """Fall less its mean when the effect is absent, of the refit where there was one."""
    return row.net if row.refit is None else row.net_refit


def strength_of(c: Candidate) -> np.ndarray:
    """Coefficients at which a member is assumed true: as the refit found it, else as the score expects it, else of
    plausible size."""
    if c.row.refit is not None:
        change = np.array(c.row.refit.strength) - c.start
        if np.isfinite(change).all() and change.any():
            return c.linear_of(change)
    return c.direction


def _advice(
    seen: Outlook,
    shots: Sequence[Shot],
    family: str,
    chosen: Sequence[int],
    before: tuple[np.ndarray, np.ndarray],
    complete: bool,
) -> Advice:
    names, taken = [m.name for m in seen.members], [shots[s] for s in chosen]
    (now, full_now), (then, full_then) = before, seen.falls(chosen)

    def share(d: np.ndarray, full: np.ndarray, i: int, j: int) -> float:
        return math.nan if complete or not full[i] > 0 else float(d[i, j] / full[i])

    pairs = [
        Apart(
            names[i],
            names[j],
            float(now[i, j]),
            float(then[i, j]),
            st.probability_correct(now[i, j]),
            st.probability_correct(then[i, j]),
            share(now, full_now, i, j),
            share(then, full_then, i, j),
        )
        for i, j in np.argwhere(np.isfinite(now))
    ]
    counted = Counter(shot.words for shot in taken)
    return Advice(
        "; ".join(words if n == 1 else f"{words} ({n} times)" for words, n in counted.items()),
        family,
        [dict(s.settings) for s in taken],
        [s.press for s in taken],
        len(taken),
        sorted(pairs, key=lambda p: p.before),
        list(dict.fromkeys(u for s in chosen for u in seen.nuisances[s])),
    )


def exchanged(sets: Sequence[Sequence[str]]) -> list[str]:
    """The effects of which each may stand in the place of the others in a set: the longest such list, or none. Shots
    tell effects apart one by one, not sets that differ in two."""
    places: dict[frozenset[str], list[str]] = {}
    for names in sets:
        for name in names:
            places.setdefault(frozenset(names) - {name}, []).append(name)
    longest = max(places.values(), key=len, default=[])
    return longest if len(longest) > 1 else []


def asked_for(diagnosis: Diagnosis) -> list[str]:
    """Names of the effects that a next measurement has to tell apart; none where the verdict does not depend on it."""
    failed = {c.name for c in diagnosis.conditions if not c.holds}
    if diagnosis.word == "AMBIGUOUS" and len(diagnosis.survivors) > 1:
        return exchanged([e.effects for e in diagnosis.survivors])[:MEMBERS]
    if diagnosis.word != "AMBIGUOUS" and not (diagnosis.word == "CANNOT_TELL" and "lead" in failed):
        return []
    net = {row.name: _net(row) for row in diagnosis.rows}
    best = max(net.values(), default=0.0)
    alike = [name for name in sorted(net, key=lambda n: net[n], reverse=True) if best > 0 and close(best, net[name])]
    return alike[:MEMBERS] if len(alike) > 1 else []


def advise(
    model: Model, diagnosis: Diagnosis, variables_of: VariablesOf, seed: int = 0, progress: Progress | None = None
) -> list[Advice]:
    """The next measurement after a diagnosis in this process (its evidence is in memory); empty where the verdict does
    not depend on telling two effects apart."""
    evidence, names = diagnosis.evidence, asked_for(diagnosis)
    if evidence is None or len(names) < 2:
        return []
    members = [c for c in evidence.candidates if c.effect.name in names and not c.broken and c.columns]
    return next_measurement(model, evidence.values, evidence, members, variables_of, seed=seed, progress=progress)
