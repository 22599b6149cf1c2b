"""Fingerprints: a residual as curves along everything that is known of a pixel.

`places` gathers the coordinates of every kept value: those of the model (`optics.fit.model.Model`), those of any image
(row, column, channel, frame, a map of cells), those of the prediction (signal, its gradient, its Laplacian) and the
settings that the experimenter turned. `fingerprints` fits a gain and an offset per bin of each, after projecting off
what a calibration absorbs, and ranks them by the fall of chi2. `families` says whether the residual depends on the
camera, on light, on geometry or on time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from optics.diagnosis import statistics as st
from optics.diagnosis.decide import ordered
from optics.diagnosis.evidence import Evidence, Progress
from optics.diagnosis.result import Family, Fingerprint
from optics.diagnosis.session import Frames, Session
from optics.diagnosis.thresholds import AS_GOOD, EXCESS, LEVEL, MIMICS
from optics.fit.compare import UNITS, led_label
from optics.fit.model import Model
from optics.fit.scene_model import SceneModel
from optics.scene.parameter import Values, keys_with

SIDE = 4  # cells per side of the coordinate 'place': a finer map would fit any clutter and forbid every claim
NOT_A_COORDINATE = {"far", "quadrant"}  # regions that others make up
YES_NO = ("contact", "shadow", "rim")
PER_BIN = 4  # readings per bin, at least: a gain and an offset are fitted to them
IN_PIXELS = {"px": 1.0, "DN/px": -1.0, "DN/px^2": -2.0}  # unit -> its power of a length in pixels
LINES = 64  # bins of 'row', 'column' and 'reading': a shutter, a read-out or an unsteady lamp acts on single rows
GRAIN = 2.0  # px: width of the Gaussian that takes the noise off a measured background
# Share of a curve's direction that calibration must leave for it to be drawn; the rest (a level, a slope) is unknown.
SEEN = 0.01

FAMILIES = {  # what a coordinate belongs to; a setting belongs to the family of the part that it is a setting of
    "camera": ("radius", "row", "column", "place", "channel", "signal", "gradient", "laplacian"),
    "light": ("incidence", "half_angle", "led_distance", "led_angle", "light_azimuth", "intensity", "shadow", "LED"),
    "geometry": (
        "height",
        "depth",
        "slope",
        "curvature",
        "emission",
        "contact",
        "contact_distance",
        "press_distance",
        "gel_path",
        "rim",
    ),
    "time": ("frame", "reading"),
}

EDGES = "a change that depends on edges mixes pixels: use the stage 'lens' (plugins/effects/lens_blur.py)"
NO_DRAFT = {  # coordinates along which no effect can be drafted: why, and what to do instead
    "intensity": "a curve along the radiance before the camera bends it is no image function; draft along 'signal'",
    "frame": "a number per frame says nothing of the next frame; 'gain drift' frees a gain per frame",
    "site": "an analyser's own level is its gain: 'site gain' frees one for each angle of a mosaic",
    "reading": "the row of a table is no setting; add a column `source.time` with the time of each reading, or one "
    "of what else changed",
    "LED": "an LED's own level is its power, which a calibration solves for; light besides it comes in some frames and "
    "not in others: see in which; or draft along 'led_distance' or 'led_angle'",
    "gradient": EDGES,
    "laplacian": EDGES,
}


def family_of(coordinate: str, of_setting: str = "") -> str:
    """camera, light, geometry, time or setting; `of_setting` is what the model says of a setting
    (`optics.fit.model.Model.family`)."""
    found = next((family for family, names in FAMILIES.items() if coordinate in names), "")
    return found or of_setting or "setting"


# -- covariates ------------------------------------------------------------------------------------------------------
def places(model: Model, values: Values, evidence: Evidence) -> list[dict[str, np.ndarray]]:
    """Per block, {coordinate: (n,) of its values}: of the model, of the prediction, of any image, and settings. What is
    counted in pixels is in those of the camera, also of a model in cells."""
    found, cell = [], getattr(model, "cell", 1)
    order = {frame: i for i, frame in enumerate(evidence.frames)}
    turned = settings(model, evidence)
    lights = [led_label(model.frames[f].parameters) for f in evidence.frames]
    kinds = _lights(evidence, model)
    table = model.captures is not None and model.captures.table is not None
    for block in evidence.blocks:
        shape = np.asarray(model.frames[block.frame].image).shape
        row, column, channel = np.unravel_index(block.index, shape)
        known = {"signal": block.prediction.astype(np.float32)}
        planes = {**model.coordinates(values, block.frame, evidence.seed), **model.lit_geometry(values, block.frame)}
        if min(shape[:2]) >= 2 * SIDE:
            prediction = np.asarray(model.predict(values, [block.frame], evidence.seed)[0], float)
            planes.update(_texture(without_grain(model, values, block.frame, prediction)))
        for name, plane in planes.items():
            plane = np.asarray(plane)
            if plane.ndim not in (2, 3):
                continue
            plane = np.broadcast_to(plane if plane.ndim == 3 else plane[..., None], shape)
            known[name] = plane.reshape(-1)[block.index].astype(np.float32)
        if not table:
            known.update(
                row=row.astype(np.float32),
                column=column.astype(np.float32),
                quadrant=(2 * (2 * row >= shape[0]) + (2 * column >= shape[1])).astype(np.float32),
            )
        known.update(channel=channel.astype(np.float32), frame=np.full(len(row), order[block.frame], np.float32))
        known.update(
            {key: np.full(len(row), numbers[order[block.frame]], np.float32) for key, numbers in turned.items()}
        )
        if len(kinds) > 1:
            known["LED"] = np.full(len(row), kinds.index(lights[order[block.frame]]), np.float32)
        for name in known.keys() & UNITS.keys() if cell > 1 else ():
            middle = (cell - 1) / 2 if name in ("row", "column") else 0.0
            known[name] = np.float32(cell ** IN_PIXELS.get(UNITS[name], 0)) * known[name] + np.float32(middle)
        if min(shape[:2]) >= 2 * SIDE:
            known["place"] = (row * SIDE // shape[0] * SIDE + column * SIDE // shape[1]).astype(np.float32)
        found.append(known)
    return found


def without_grain(model: Model, values: Values, frame: int, prediction: np.ndarray) -> np.ndarray:
    """A predicted image whose measured background is smoothed: that is an image with noise of its own. Where it was
    brighter by chance, the prediction has a peak, and the measurement seems to lack it."""
    from scipy.ndimage import gaussian_filter

    if not isinstance(model, SceneModel) or (background := model.flat_of(frame)) is None:
        return prediction
    flat = background * model.gains(model.at(values, frame))
    black = float(model.noise.black_level)
    share = 1.0 if model.flat_field == "additive" else (prediction - black) / flat
    return prediction + share * (gaussian_filter(flat, (GRAIN, GRAIN, 0), mode="nearest") - flat)


def _texture(prediction: np.ndarray) -> dict[str, np.ndarray]:
    """(H, W, C) gradient in DN/px and Laplacian in DN/px^2 of a predicted image: where blur and sharpening act."""
    from scipy.ndimage import laplace

    steep = np.hypot(*np.gradient(prediction, axis=(0, 1)))
    return {
        "gradient": steep,
        "laplacian": np.stack([laplace(prediction[..., c], mode="nearest") for c in range(prediction.shape[2])], -1),
    }


def settings(model: Model, evidence: Evidence) -> dict[str, list[float]]:
    """key -> value per fitted frame of the numbers that the experimenter turned, other than which LED was on and those
    of parts that are absent."""
    absent = set() if model.captures is None else set(model.captures.absent)
    turned: dict[str, list[float]] = {}
    frames = [model.frames[f] for f in evidence.frames]
    lights = keys_with(model.parameters, "power")
    keys = {key for f in frames for key in f.parameters if key.rpartition(".")[0] not in absent}
    for key in sorted(keys - set(lights)):
        values = [f.parameters.get(key, math.nan) for f in frames]
        numbers = [float(v) if isinstance(v, (int, float)) else math.nan for v in values]
        if len({v for v in numbers if math.isfinite(v)}) > 1:
            turned[key] = numbers
    return turned


def _own_of_frames(model: Model, evidence: Evidence) -> set[str]:
    """Settings of which each value has a bin and that nobody turned: what the fit solves for frame by frame, such as
    the place of a press, and a gain that every frame has for itself."""
    solved = {key for i in evidence.base for key in evidence.columns[i].keys if evidence.columns[i].frames is not None}
    gains = {key for key, p in model.parameters.items() if p.how == "image" and p.multiplies}
    found = set()
    for key, numbers in settings(model, evidence).items():
        different = len({v for v in numbers if math.isfinite(v)})
        if different <= st.BINS and (key in solved or (key in gains and different == len(numbers))):
            found.add(key)
    return found


# -- curves ----------------------------------------------------------------------------------------------------------
def fingerprints(
    model: Model, evidence: Evidence, found: list[dict], reference: float, say: Progress
) -> list[Fingerprint]:
    """The residual along every coordinate: bins of gain and offset, projected like effects; best first.

    Falls of chi2 count every direction that is left. A curve is drawn (and drafted) without directions of which
    calibration leaves less than SEEN, such as a level, which LED powers absorb: these would be large, and only noise.

    found      what `places` returns
    reference  net fall of chi2 of the best effect, which the curves' ratios refer to
    """
    k = evidence.thinning
    names = sorted(set.intersection(*[set(p) for p in found]) - NOT_A_COORDINATE)
    named, own_of_frames = _named(evidence, model), _own_of_frames(model, evidence)
    plain_normal = evidence.thinned(extra=2 * max(LINES, *named.values()))
    carriers = _carriers(model, evidence)
    lit = sum(float(np.sum(np.square(gain))) for gain, _ in carriers)
    middles = [block.middle for block in evidence.blocks]
    ends = np.cumsum([len(block.r) for block in evidence.blocks])[:-1]
    first = len(evidence.columns)
    dof_all = max(evidence.normal.count - evidence.projected.rank, 1)
    excess = evidence.projected.chi2 - dof_all
    weighed = excess > EXCESS * math.sqrt(2 * dof_all)
    curves_of = []
    for n, name in enumerate(names):
        say("fingerprints", n, len(names))
        x = np.concatenate([p[name] for p in found])
        index, count = _bins(evidence, name, x, named)
        if not count:
            continue
        normal = plain_normal.copy()
        for block, middle, bins, carrier in zip(evidence.blocks, middles, np.split(index, ends), carriers):
            st.add_bins(normal, block.where, middle, block.r, first, bins, count, carrier)
        rest = list(range(first, first + 2 * count))
        projected = evidence.project(normal, evidence.base, rest, k)
        lengths = np.diag(normal.gram)[rest]
        fall, dof, _, _ = st.joint(projected, lengths)
        if dof == 0:
            continue
        curves, drawn = {}, {}
        for kind, own in (("gain", slice(0, count)), ("offset", slice(count, 2 * count))):
            part = replace(projected, information=projected.information[own, own], score=projected.score[own])
            curves[kind], drawn[kind] = (st.joint(part, lengths[own], least) for least in (1e-6, SEEN))
        kind = max(curves, key=lambda name: curves[name][0] - curves[name][1])
        _, _, curve, sd = drawn[kind]
        net = (fall - dof) * k
        centres = [float(np.median(x[index == i])) if np.any(index == i) else math.nan for i in range(count)]
        curves_of.append(
            Fingerprint(
                name,
                fall,
                dof,
                _chance(evidence, fall, dof, dof_all, evidence.projected.chi2),
                net,
                net / reference,
                kind,
                centres,
                curve.tolist(),
                sd.tolist(),
                _labels(evidence, model, name, centres),
                family_of(name, model.family(name)),
                net / excess if weighed else math.nan,
                _unit_of(model, name),
                math.sqrt(max(fall, 0.0) / max(lit, 1e-12)),
                name in own_of_frames,
            )
        )
    say("fingerprints", len(names), len(names))
    return sorted(curves_of, key=lambda f: -f.net)


def beside_shared_noise(
    model: Model,
    evidence: Evidence,
    found: list[dict],
    curves: Sequence[Fingerprint],
    session: Session | Frames,
    scale: float,
) -> list[Fingerprint]:
    """The significant curves, with their falls of deviance (`optics.diagnosis.correlation`): beside noise that
    neighbours share, a curve along what was turned slowly counts for less, as a lamp that wanders brings it too.

    scale   variance over the stated one
    """
    named, carriers = _named(evidence, model), [np.concatenate(c) for c in zip(*_carriers(model, evidence))]
    base, r = evidence.dense(evidence.base), np.concatenate([block.r for block in evidence.blocks])
    before, judged = session.about(r, base), []
    reached = before.deviance(scale)
    for f in curves:
        if f.p > LEVEL:
            continue
        index, count = _bins(evidence, f.coordinate, np.concatenate([p[f.coordinate] for p in found]), named)
        held = index[:, None] == np.arange(count)
        after = session.about(r, np.hstack([base, *(held * carrier[:, None] for carrier in carriers)]))
        dof = before.free - after.free
        if not 0 < dof < before.free:
            continue
        fall = reached - after.deviance(scale)
        judged.append(
            replace(f, fall=fall, dof=dof, p=_chance(evidence, fall, dof, before.free, reached), net=fall - dof)
        )
    return judged


def _named(evidence: Evidence, model: Model) -> dict[str, int]:
    """Coordinates whose bins have names: one each, whether it holds data or not."""
    return {
        "place": SIDE * SIDE,
        "frame": len(evidence.frames),
        "channel": evidence.channels,
        "LED": len(_lights(evidence, model)),
    }


def _carriers(model: Model, evidence: Evidence) -> list[tuple[np.ndarray, np.ndarray]]:
    """What a gain and an offset of one do to the kept values of each block, whitened."""
    black = float(model.noise.black_level)
    return [((block.prediction - black) / block.sigma, 1 / block.sigma) for block in evidence.blocks]


def _bins(evidence: Evidence, name: str, x: np.ndarray, named: Mapping[str, int]) -> tuple[np.ndarray, int]:
    """(bin (n,) of every kept value along a coordinate, -1 for none; their number, 0 where there are too few).

    A gain and an offset are fitted to each bin: of few readings, more bins would fit each reading by itself."""
    if name in named:
        edges: np.ndarray | None = np.arange(named[name] + 1) - 0.5
    else:
        most = max(min(LINES, len(x) // PER_BIN), 2) if evidence.is_table else LINES
        lines = most if name in ("row", "column", "reading") else min(st.BINS, most)
        edges = st.bin_edges(x, lines, PER_BIN if evidence.is_table else 20)
    if edges is None or len(edges) < 3:
        return np.full(len(x), -1), 0
    return np.where(np.isfinite(x), np.searchsorted(edges, x, side="right") - 1, -1), len(edges) - 1


def _chance(evidence: Evidence, fall: float, dof: int, free: int, chi2: float) -> float:
    """p of a fall by `dof` bins in noise alone; of readings, in noise as large as what the bins leave of chi2: its size
    is often stated too small, and nothing else is there to tell."""
    from scipy.special import chdtrc
    from scipy.stats import f as fisher

    p = float(chdtrc(dof, fall))
    if not evidence.is_table or free <= dof:
        return p
    left = max(chi2 - fall, 1e-300) / (free - dof)
    return max(p, float(fisher.sf(fall / max(dof, 1) / left, dof, free - dof)))


def _unit_of(model: Model, coordinate: str) -> str:
    if coordinate in model.parameters:
        return model.parameters[coordinate].unit
    if coordinate == "intensity":  # of the light, before the camera makes DN of it
        return ""
    return "mm" if coordinate.endswith(".distance") else UNITS.get(coordinate, "")


def _labels(evidence: Evidence, model: Model, name: str, centres: Sequence[float]) -> list[str]:
    """Names of the bins of a coordinate that has no scale."""
    if name == "frame":
        return [model.frames[f].name for f in evidence.frames]
    if name == "LED":
        return _lights(evidence, model)
    if name == "channel":
        return [f"{c} ({nm:.0f} nm)" if nm else c for c, nm in zip(channel_names(evidence), model.wavelengths())]
    if name in YES_NO and len(centres) == 2:
        return ["no", "yes"]
    if name == "place":
        return [f"row {i // SIDE + 1}, column {i % SIDE + 1} of {SIDE}" for i in range(len(centres))]
    return []


def _lights(evidence: Evidence, model: Model) -> list[str]:
    return sorted({led_label(model.frames[f].parameters) for f in evidence.frames})


def channel_names(evidence: Evidence) -> list[str]:
    return ["R", "G", "B"] if evidence.channels == 3 else [str(i) for i in range(evidence.channels)]


# -- families of coordinates -----------------------------------------------------------------------------------------
def families(found: Sequence[Fingerprint]) -> list[Family]:
    """The best curve of each family; the family that the residual depends on most comes first.

    A map of the sensor mimics every curve that does not move, and a number per frame every setting: such a curve stands
    for its family, and its family comes first, only where no other curve is nearly as good."""
    own: dict[str, list[Fingerprint]] = {}
    for f in (f for f in found if not f.per_frame):
        own.setdefault(f.family, []).append(f)
    best = ordered([ordered(curves)[0] for curves in own.values()])
    return [
        Family(f.family, f.coordinate, f.net, f.share, f.net / best[0].net if best[0].net > 0 else 0.0) for f in best
    ]


def goes_with(found: Sequence[Family]) -> str:
    """One sentence: what the residual depends on, and on what less; '' without a curve that explains anything."""
    if not found or found[0].net <= 0:
        return ""

    weighed = math.isfinite(found[0].share)

    def words(f: Family) -> str:
        name = "a setting" if f.family == "setting" else f"the {f.family}" if f.family == "camera" else f.family
        how = f" {max(f.share, 0.0):.0%}" if weighed else "" if f is found[0] else f", {max(f.of_best, 0.0):.2f} of it"
        return f"{name} ({f.coordinate}{how})"

    near = [f for f in found[1:] if f.of_best > AS_GOOD and f.coordinate not in MIMICS]
    rest = [f for f in found[1:] if f not in near]
    text = f"It goes with {' or '.join(map(words, [found[0], *near]))}"
    text += ", which these captures do not separate" if near else ""
    if rest:
        text += (
            f"; less with {', '.join(map(words, rest))}" if near else f" rather than with {', '.join(map(words, rest))}"
        )
    how = (
        "of the excess misfit a curve along it explains"
        if weighed
        else "a curve along it explains of what the best curve does"
    )
    return f"{text}; in brackets the best coordinate of each and how much {how}."


def unexplained(found: Sequence[Fingerprint], best_effect: float, excess: float, patterned: bool = False) -> str:
    """One sentence: shares of the excess misfit that the best effect, the best curve, and neither of them explains.

    best_effect   net fall of chi2 with it;   excess: chi2 less its degrees of freedom
    patterned     whether a pattern of another kind was named, which explains more: the rest is no mystery then
    """
    best = next((f for f in found if not f.per_frame), None)
    if not excess > 0 or best is None:
        return ""
    effect, curve = (min(max(x / excess, 0.0), 1.0) for x in (best_effect, best.net))
    text = (
        f"The best effect explains {effect:.0%} of the excess misfit, the best curve, along '{best.coordinate}', "
        f"{curve:.0%}."
    )
    rest = f"{1 - max(effect, curve):.0%}"
    return text if patterned or rest == "0%" else f"{text} Neither of them explains the other {rest}."
