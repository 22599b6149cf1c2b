"""Homogeneity: whether a strength is the same in all parts of the data, and whether it is more than clutter makes
(`optics.diagnosis.clutter`)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from optics.captures.capture_set import group_of
from optics.diagnosis import fingerprints as prints
from optics.diagnosis import statistics as st
from optics.diagnosis.clutter import Others, by_clutter, variances
from optics.diagnosis.correlation import Correlation
from optics.diagnosis.evidence import Block, Candidate, Evidence, Progress, at_bound, measure
from optics.diagnosis.result import Explanation, Refit, Split
from optics.diagnosis.session import Frames, Session
from optics.diagnosis.thresholds import LEVEL, UNEVEN
from optics.fit.compare import led_label
from optics.fit.model import Model, value_of
from optics.fit.result import Fit
from optics.scene.parameter import Variable

EVEN = 0.05  # of the fall: what splitting may gain where the scatter of clutter does not explain it
# Of what an effect leaves: if splitting its strength takes more, the rest lies where the effect acts, and the effect is
# not its cause.
SAME_PLACE = 0.5
HAIR = 0.01  # of the fall: a split that gains less says nothing about what the effect is


@dataclass
class Added:
    """A fitted effect with the evidence at its values.

    own         columns of the base, of what was added beside and of the effect; of images, of other candidates too
    calibrated  those of the base and of what was added beside; effect, others: of the effect, of the others
    change      (k,) of its strengths from where they started
    images      per block, the whitened difference (n,) that the effect makes; again: the same of other samples, where
                these are Monte Carlo estimates, for products in which their noise does not add up
    net         fall of chi2 with it
    scale       of the noise over the stated one, where what is left is noise
    apart       (n, k) of all kept values -> the same as of independent values, in which `own` is then given
    """

    name: str
    own: Evidence
    calibrated: list[int]
    effect: list[int]
    others: list[int]
    change: np.ndarray
    images: list[np.ndarray]
    again: list[np.ndarray]
    net: float
    scale: float = 1.0
    apart: Callable[[np.ndarray], np.ndarray] = np.asarray


def split(
    model: Model,
    evidence: Evidence,
    places: list[dict],
    rows_max: int,
    seed: int,
    say: Progress,
    c: Candidate,
    found: Fit,
    left: Refit | Explanation,
    net: float,
    beside: Sequence[Variable] = (),
    noise: Correlation | None = None,
    over_noise: float = 0.0,
    candidates: Sequence[Candidate] = (),
) -> tuple[list[Split], float, np.ndarray, np.ndarray]:
    """Whether a fitted effect has the same strength in every part of the data, and `scatter` of its strength.

    With the effect in the base, the image e by which it differs from the model without it is cut into parts e 1{part},
    and these are scored: a true effect gains nothing by being cut, a proxy does.

    places   coordinates of every kept value (`optics.diagnosis.fingerprints.places`)
    found    the fit with the effect; left: what is left with it; net: its fall
    beside   variables of what was added together with it
    noise    what neighbouring readings, or the pixels of a frame, share of it: a lamp that wanders differs from frame
             to frame, and so would a strength that takes up what the lamp did
    over_noise   net fall of chi2 beside that noise, of images
    candidates   all that were scored: of images, those that are not in the fit say what clutter there is
    """
    added = _added(model, evidence, rows_max, seed, say, c, found, net, beside, candidates)
    dof = max(evidence.normal.count - evidence.projected.rank, 1)
    table = evidence.is_table
    if not table and left.structure_p >= LEVEL:
        added.scale = max(1 + left.excess_sd * math.sqrt(2 / dof), 1.0)
    parts = _parts(model, added.own, places)
    whole = added
    if noise is not None and not table:
        added = _of_independent_frames(model, added, noise)
    results = _cuts(added, parts, places)
    if noise is not None and table:  # how sure a split is depends on what neighbours share, its share of the fall not
        added = _of_independent_readings(model, added, noise)
        sure = {s.by: s for s in _cuts(added, parts, places)}
        results = [replace(sure[s.by], fall=s.fall, h=s.h) for s in results if s.by in sure]
    level = LEVEL / max(len(results), 1)  # Bonferroni
    excess = left.excess_sd * math.sqrt(2 * dof)

    def most(s: Split) -> float:
        """The h that is allowed."""
        if s.p >= level:
            return max(s.h, UNEVEN)
        if left.complete:  # only noise is left, and p is what it says
            return HAIR
        return max(HAIR, min(EVEN if s.chance < LEVEL else UNEVEN, SAME_PLACE * excess / max(net, 1e-9)))

    results = [replace(s, limit=most(s), holds=s.h <= most(s)) for s in results]
    judged = added if table else whole
    if c.effect.scope == "frame":  # frames do not scatter about strengths that each has for itself
        places = [{name: values for name, values in p.items() if name != "frame"} for p in places]
    others = judged.others if added is judged else ()
    chance, clutter, errors = scatter(judged.own, judged.calibrated, judged.effect, judged.change, places, net, others)
    if added is not judged:  # errors are those of a fit without a lamp; whether it is there is asked beside that lamp
        change = _at_optimum(added)
        chance, *_ = scatter(added.own, added.calibrated, added.effect, change, places, over_noise, added.others)
    return results, chance, clutter, errors


def _at_optimum(added: Added) -> np.ndarray:
    """(k,) change of an effect's strengths by the weights of its evidence, which may not be those of the fit."""
    own = added.own
    projected = own.project(own.thinned(), added.calibrated, added.effect, own.thinning)
    return added.change + st.inverse(projected.information, st.VISIBLE)[0] @ projected.score


def _cuts(added: Added, parts: dict[str, tuple[list[str], list[np.ndarray]]], places: list[dict]) -> list[Split]:
    """The splits by each of `_parts`."""
    plain = added.own.thinned(extra=max([len(labels) for labels, _ in parts.values()], default=0))
    cuts = [_cut(added, by, labels, bins, plain, places) for by, (labels, bins) in parts.items()]
    return [cut for cut in cuts if cut is not None]


def _added(
    model: Model,
    evidence: Evidence,
    rows_max: int,
    seed: int,
    say: Progress,
    c: Candidate,
    found: Fit,
    net: float,
    beside: Sequence[Variable],
    candidates: Sequence[Candidate],
) -> Added:
    """Measure again at the values with the effect."""
    base = [
        v
        for v in [*(evidence.columns[i] for i in evidence.base), *beside, *c.variables]
        if v in c.variables or not at_bound(v, value_of(model, found.values, v))
    ]
    own = measure(
        model, found.values, base, [], evidence.frames, rows_max, seed, say, f"homogeneity of {c.effect.name}"
    )
    change = np.array([value_of(model, found.values, v) for v in c.variables]) - c.start
    effect = [i for i, v in enumerate(base) if v in c.variables]
    calibrated = [i for i in own.base if i not in effect]
    own.precision, own.pull = own.precision[calibrated], own.pull[calibrated]  # effect variables follow the base's
    others = _with_others(own, evidence, candidates, {v.name for v in base})
    without = found.values.copy()
    for v, start in zip(c.variables, c.start):
        without.put(v, float(start))

    def images(seed: int) -> list[np.ndarray]:
        changes = zip(*(model.predict(values, own.frames, seed) for values in (found.values, without)))
        return [
            (np.asarray(new, float) - old).reshape(-1)[block.index] / block.sigma
            for block, (new, old) in zip(own.blocks, changes)
        ]

    first = images(own.seed)
    twice = any(block.b is not None for block in own.blocks)
    again = images(own.seed + 1) if twice else first
    return Added(c.effect.name, own, calibrated, effect, others, change, first, again, net)


def _with_others(own: Evidence, evidence: Evidence, candidates: Sequence[Candidate], taken: set[str]) -> list[int]:
    """Columns that are added to the evidence of images: of the candidates whose variables are not `taken`, at the
    values of the base; none where both do not use the same pixels."""
    alike = all(np.array_equal(one.index, other.index) for one, other in zip(own.blocks, evidence.blocks))
    if own.is_table or not alike:
        return []
    free = [c for c in candidates if not {v.name for v in c.variables} & taken]
    there = list(dict.fromkeys(column for c in free for column in c.columns))
    first = len(own.columns)
    added = list(range(first, first + len(there)))
    own.columns = [*own.columns, *(evidence.columns[i] for i in there)]
    own.blocks = [
        replace(
            block,
            where=np.concatenate([block.where, added]).astype(int),
            a=np.column_stack([block.a, more]),
            b=None if block.b is None else np.column_stack([block.b, more]),
        )
        for block, more in zip(own.blocks, (block.columns(there) for block in evidence.blocks))
    ]
    return added


def _of_independent_readings(model: Model, added: Added, noise: Correlation) -> Added:
    """The same with columns and residuals of readings as if these were independent."""
    own, session = added.own, Session(model, added.own)

    def apart(columns: np.ndarray) -> np.ndarray:
        return session.independent(columns, noise)

    everything = np.arange(len(own.columns))
    residual = np.concatenate([block.r for block in own.blocks])
    whole = _dealt(apart(np.column_stack([own.dense(list(everything)), residual])), own.blocks)
    blocks = [
        replace(block, where=everything, a=part[:, :-1], b=None, r=part[:, -1])
        for block, part in zip(own.blocks, whole)
    ]
    return replace(added, own=replace(own, blocks=blocks), apart=apart)


def _of_independent_frames(model: Model, added: Added, noise: Correlation) -> Added:
    """The same with columns and residuals of images as if a lamp did nothing to whole frames."""
    own, lamp = added.own, Frames(model, added.own)

    def apart(columns: np.ndarray) -> np.ndarray:
        return np.concatenate(lamp.independent(_dealt(columns, own.blocks), noise))

    a = lamp.independent([block.a for block in own.blocks], noise)
    b = lamp.independent([block.a if block.b is None else block.b for block in own.blocks], noise)
    r = lamp.independent([block.r for block in own.blocks], noise)
    blocks = [
        replace(block, a=one, b=None if block.b is None else other, r=left)
        for block, one, other, left in zip(own.blocks, a, b, r)
    ]
    return replace(added, own=replace(own, blocks=blocks), apart=apart)


def _dealt(values: np.ndarray, blocks: Sequence[Block]) -> list[np.ndarray]:
    """Values (n, ...) of all blocks, one array each."""
    return np.split(values, np.cumsum([len(block.r) for block in blocks])[:-1])


def _cut(
    added: Added, by: str, labels: list[str], bins: list[np.ndarray], plain: st.Normal, places: list[dict]
) -> Split | None:
    """The split of an effect's image into named parts, its limit still open; None where calibration absorbs all parts.

    bins    per block, the part (n,) of each value
    plain   normal equations of the kept values, with room for the parts
    """
    from scipy.special import chdtrc

    own, calibrated, effect = added.own, added.calibrated, added.effect
    count, first, k = len(labels), len(own.columns), own.thinning

    def parts_of(images: Sequence[np.ndarray]) -> list[np.ndarray]:
        cut = [image[:, None] * (index[:, None] == np.arange(count)) for image, index in zip(images, bins)]
        return _dealt(added.apart(np.concatenate(cut)), own.blocks)

    cut = parts_of(added.images)
    again = cut if added.again is added.images else parts_of(added.again)
    normal, rest = plain.copy(), np.arange(first, first + count)
    for block, one, other in zip(own.blocks, cut, again):
        # samples of the same seed meet in none of the products
        across = one.T @ block.middle if block.b is None else (one.T @ block.b + other.T @ block.a) / 2
        normal.gram[np.ix_(rest, block.where)] += across
        normal.gram[np.ix_(block.where, rest)] += across.T
        normal.gram[np.ix_(rest, rest)] += (one.T @ other + other.T @ one) / 2
        normal.score[rest] += (one + other).T @ block.r / 2
    lengths = np.diag(normal.gram)[rest]
    projected = own.project(normal, calibrated + effect, [*rest], k)
    fall, dof, *_ = st.joint(projected, lengths)
    # What the parts gain together is no difference between them: the image that the effect makes is not quite its
    # derivative times its strength.
    whole, apart = _together(projected, lengths)
    fall, dof = max(fall - whole, 0.0), dof - (apart is not None)
    if dof <= 0:
        return None
    _, _, delta, sd = st.joint(own.project(normal, calibrated, [*rest], k), lengths)
    cut = _off_base(own, [(one + other) / 2 for one, other in zip(cut, again)], projected, calibrated + effect)
    found = variances(cut, [block.r for block in own.blocks], places)
    score, information = projected.score, projected.information
    if apart is not None:
        score, information = apart @ score, apart @ information @ apart.T
        found = [(apart @ b @ apart.T, parts) for b, parts in found]
    return Split(
        effect=added.name,
        by=by,
        labels=labels,
        strength=(1 + delta).tolist(),
        sd=sd.tolist(),
        fall=fall * k,
        dof=dof,
        p=float(chdtrc(dof, fall / added.scale)),
        h=max(fall - dof, 0.0) * k / max(added.net, 1e-9),
        chance=by_clutter(score, information, found),
        limit=UNEVEN,
        holds=True,
    )


def _together(projected: st.Projected, lengths: np.ndarray) -> tuple[float, np.ndarray | None]:
    """(fall with one strength for all parts of an image, what takes that off the parts' scores: u - V 1 (1'u)/(1'V 1));
    (0, None) where the base absorbs the whole image."""
    v = projected.information.sum(1)
    if v.sum() <= st.VISIBLE * float(lengths.sum()):
        return 0.0, None
    return float(projected.score.sum()) ** 2 / float(v.sum()), np.eye(len(v)) - np.outer(v, np.ones(len(v))) / v.sum()


def scattered(refit: Refit, chance: float, clutter: np.ndarray) -> Refit:
    """A refit with the p of its strength by scatter, and that scatter added to its errors; where only noise is left,
    its errors are those of noise."""
    if refit.complete:
        return replace(refit, chance=chance)
    return replace(
        refit,
        chance=chance,
        clutter=clutter.tolist(),
        sd=np.sqrt(np.square(refit.sd) + np.maximum(np.diag(clutter), 0.0)).tolist(),
    )


def with_errors(found: Fit, variables: Sequence[Variable], noise: np.ndarray) -> Fit:
    """A fit with the covariance of noise (k, k) of some variables where it ended, if that is larger: chord steps, whose
    derivative images are those of the base, do not know that a leak's size is hard to tell from the power of the lamp
    that only shows through it."""
    names = [v.name for v in found.variables]
    own = [names.index(v.name) for v in variables]
    covariance, larger = np.array(found.covariance, float), np.diag(noise)
    if not (np.isfinite(noise).all() and (larger > 0).all() and (larger > np.diag(covariance)[own]).any()):
        return found
    covariance[np.ix_(own, own)] = noise
    return replace(found, covariance=covariance)


def scatter(
    own: Evidence,
    calibrated: Sequence[int],
    effect: Sequence[int],
    change: np.ndarray,
    places: list[dict],
    fall: float = 0.0,
    others: Sequence[int] = (),
) -> tuple[float, np.ndarray, np.ndarray]:
    """(p, covariance that clutter adds, covariance of noise) of a strength by its scatter between parts of the sensor
    or session.

    others     columns of effects that are not there, which say what clutter there is

    fall       of chi2 with it. It counts where it is more than the square of the strength over its error: that error
               may be one of what it multiplies, such as the power of a lamp that only shows through a leak

    p          does not assume independent noise, as neighbours share clutter (`by_clutter`); NaN for too few parts
    clutter    (k, k) V^-1 (B - V) V^-1, with B of `variances`, of the map in which it is larger; zero for too few parts
    noise      (k, k) V^-1 at the values that were found
    """
    normal, clutter = own.thinned(), np.zeros((len(effect),) * 2)
    projected = own.project(normal, calibrated, effect, own.thinning)
    white = st.root(projected.information, st.VISIBLE)
    covariance = white.T @ white
    images = _off_base(own, [block.columns(effect) for block in own.blocks], projected, calibrated)
    left = [block.r for block in own.blocks]
    found = variances(images, left, places)
    for b, parts in found:
        if st.inverse(white @ b @ white.T)[1] < parts - 1:
            clutter = max(
                clutter,
                covariance @ (b - projected.information) @ covariance,
                key=lambda c: float(np.trace(c @ projected.information)),
            )
    score = projected.information @ change
    square = float(score @ change)
    if 0 < square < fall:
        score = score * math.sqrt(fall / square)
    if others:
        base = [*calibrated, *effect]
        rest = own.project(normal, base, others, own.thinning)
        beside = _off_base(own, [block.columns(others) for block in own.blocks], rest, base)
        found = Others(beside, left, places).join(images, found)
    return by_clutter(score, projected.information, found), clutter, covariance


def _off_base(
    own: Evidence, images: Sequence[np.ndarray], projected: st.Projected, base: Sequence[int]
) -> list[np.ndarray]:
    """Images of each block after projecting off what the base absorbs."""
    return [image + block.columns(base) @ projected.response for block, image in zip(own.blocks, images)]


def _parts(model: Model, evidence: Evidence, places: list[dict]) -> dict[str, tuple[list[str], list[np.ndarray]]]:
    """name -> (labels, per block the part of each value): channel, frame, LED, group, settings, contact, quadrant."""
    frames = [model.frames[f] for f in evidence.frames]
    names = [f.name for f in frames]
    parts: dict[str, tuple[list[str], list[np.ndarray]]] = {}
    seen: list[list[int]] = []

    def of_coordinate(by: str, coordinate: str, labels: list[str]) -> None:
        if all(coordinate in p for p in places):
            parts[by] = (labels, [np.nan_to_num(p[coordinate]).astype(int) for p in places])

    def of_frame(by: str, labels: list[str]) -> None:
        kinds = list(dict.fromkeys(labels))  # by first occurrence, so that equal partitions have equal numbers
        numbers = [kinds.index(label) for label in labels]
        if len(kinds) >= 2 and numbers not in seen:
            seen.append(numbers)
            parts[by] = (kinds, [np.full(len(p["channel"]), i) for i, p in zip(numbers, places)])

    of_coordinate("channel", "channel", prints.channel_names(evidence))
    dealt = evidence.is_table and not any(f.group for f in frames)  # readings are dealt out in turn
    if not dealt:
        of_frame("frame", names)
    of_frame("LED", [led_label(f.parameters) for f in frames])
    if not dealt:
        of_frame("group", [group_of(f) for f in frames])
    for key, numbers in prints.settings(model, evidence).items():
        if len(set(numbers)) <= 8:
            of_frame(key, [f"{v:g}" for v in numbers])
    # settings that a sweep changes from reading to reading
    for key in sorted(set.intersection(*[set(p) for p in places]) - set(parts)):
        if "." in key:
            found = np.unique(np.concatenate([p[key] for p in places]))
            if 2 <= len(found) <= 8 and np.isfinite(found).all():
                parts[key] = ([f"{v:g}" for v in found], [np.searchsorted(found, p[key]) for p in places])
    of_coordinate("contact", "contact", ["no contact", "contact"])
    of_coordinate("quadrant", "quadrant", ["top left", "top right", "bottom left", "bottom right"])
    return {by: given for by, given in parts.items() if len(given[0]) > 1}
