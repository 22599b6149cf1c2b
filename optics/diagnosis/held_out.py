"""Held-out frames, and what had moved to hide an effect.

On held-out frames the parameters that all frames share are frozen, and only what each frame has for itself is solved
for, for the base and for the base with the winner alike. A lamp that wanders by w (rms, relative) from frame to frame
is such a thing: chi2 = r'(1 + w^2 g g')^-1 r of a frame, with its whitened signal g. What is known of a frame's own
settings counts in by how much chi2 falls, but not in the misfit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optics.diagnosis import statistics as st
from optics.diagnosis.competition import beside_refuted
from optics.diagnosis.evidence import Candidate
from optics.diagnosis.explanations import Outcome, Trial
from optics.diagnosis.refit import Case, chi2, noisier
from optics.diagnosis.result import Level, Shift
from optics.diagnosis.shared_noise import wander_of
from optics.diagnosis.thresholds import TOLD
from optics.fit.branches import over_branches
from optics.fit.calibrate import for_frames
from optics.fit.model import Model, value_of
from optics.fit.result import Fit
from optics.scene.parameter import Values, Variable

SQUARES = 4  # fields per side of a held-out frame that is judged in halves
ASKED = 6  # explanations, the best first, that must predict the held-out frames: each costs a fit of their poses
MOVED = 3.0  # standard deviations, of the fit or of the prior, that a parameter must have moved to be reported


def judge(case: Case, outcome: Outcome) -> tuple[Outcome, list[Level]]:
    """The competition when explanations must predict the frames that were held out, and the levels of its best.

    Of explanations that the fitted frames do not tell apart, one is refuted where held-out frames are predicted worse
    with it than without anything, by TOLD (chi2 in units of what the best explanation leaves) and in most of them,
    while another one predicts them better: a few angles may not tell an analyser that wobbles from a lamp that drifts,
    where a further angle does."""
    found: dict[frozenset[str], list[Level]] = {}
    base = Base.of(case) if case.held_out else None

    def levels_of(t: Trial) -> list[Level]:
        if t.names not in found:
            wander = 0.0 if case.evidence.is_table else wander_of(case, outcome, t)
            found[t.names] = levels(case, base, t.members, t.fit, wander)
        return found[t.names]

    while case.held_out and len(outcome.survivors) > 1:
        last = [(t, levels_of(t)[-1]) for t in outcome.survivors[:ASKED] if t.members]
        kept = [t for t, level in last if level.fall > 0]
        refuted = [
            t for t, level in last if level.fall < -TOLD * outcome.scale and 2 * level.frames_better < level.frames
        ]
        if not (kept and refuted):
            break
        outcome = beside_refuted(case, outcome, refuted, "held-out frames refute it")
    return outcome, levels_of(outcome.best)


@dataclass(frozen=True)
class Base:
    """The base on held-out frames.

    pose      variables that each has for itself, which were fitted there
    predictions, masks, sds   (H, W, C) of each frame
    """

    pose: list[Variable]
    values: Values
    predictions: list[np.ndarray]
    masks: list[np.ndarray]
    sds: list[np.ndarray]

    @classmethod
    def of(cls, case: Case) -> Base:
        case.say("held-out frames", 0, 2)
        pose = for_frames(case.model, case.fit.variables, case.held_out)
        predictions, values = _predicted(case, case.fit.values.copy(), pose)
        masks, sds = [], []
        for f, prediction in zip(case.held_out, predictions):
            variance = case.evidence.variance(case.model, f, prediction, values)
            masks.append(np.asarray(case.model.usable(f), bool) & np.isfinite(prediction))
            sds.append(np.sqrt(np.where(masks[-1], variance, 1.0)))
        return cls(pose, values, predictions, masks, sds)


def levels(
    case: Case, on_held_out: Base | None, members: Sequence[Candidate], with_them: Fit, wander: float = 0.0
) -> list[Level]:
    """Misfit of the base and, if there are any, of the base with effects, on fitted and on held-out frames, where the
    lamp wanders.

    A strength per frame is found on one half of a held-out frame and judged on the other."""
    evidence, held_out, say = case.evidence, case.held_out, case.say
    before, after = evidence.normal.square, chi2(case, with_them.values)[0] if members else math.nan
    name = " + ".join(c.effect.name for c in members)

    if on_held_out is None:
        found = [_level(case, "base", before)]
        return found + ([_level(case, name, after)] if members else [])
    pose, base_values, predictions_of_base = on_held_out.pose, on_held_out.values, on_held_out.predictions
    masks, sds = on_held_out.masks, on_held_out.sds
    base = [
        _square(case.model, f, prediction, use, sd, wander)
        for f, prediction, use, sd in zip(held_out, predictions_of_base, masks, sds)
    ]
    count = int(sum(m.sum() for m in masks))
    found = [_level(case, "base", before, sum(base), count)]
    if not members or not count:
        return found
    say("held-out frames", 1, 2)
    own = [
        v
        for c in members
        for v in case.variables_of(c.effect)
        if v.frames is not None and set(v.frames) & set(held_out)
    ]
    free = [*pose, *own]

    def having(start: Values) -> tuple[np.ndarray, np.ndarray]:
        """chi2 of each frame with the effects, and with what was known of its settings."""
        predictions, values = _predicted(case, start, free)
        if own:
            squares = _crossed(case, free, held_out, predictions, values, masks, sds)
        else:
            squares = [
                _square(case.model, f, prediction, use, sd, wander) - noisier(case, f, values, base_values, use, sd)
                for f, prediction, use, sd in zip(held_out, predictions, masks, sds)
            ]
        return np.array(squares), np.array(squares) + _known(case, pose, values)

    if own:
        base = _crossed(case, pose, held_out, predictions_of_base, base_values, masks, sds)
        found[0] = _level(case, "base", before, sum(base), count)
    # a dial that must stand far off what is written down predicts a frame no better than one that misses it
    without = np.array(base) + _known(case, pose, base_values)
    near = with_them.values.copy()
    for v in pose:
        near.put(v, value_of(case.model, base_values, v))
    # A press lies where it lay without the effects, or nearly so: steps of images are dear. Where it does not, a strong
    # effect may have bent the base far from the truth. Readings cost nothing, and have angles with several ends.
    with_effect, total = having(with_them.values.copy() if evidence.is_table else near)
    if not evidence.is_table and total.sum() > without.sum():
        with_effect, total = min((with_effect, total), having(with_them.values.copy()), key=lambda pair: pair[1].sum())
    say("held-out frames", 2, 2)
    fall, better = float(np.sum(without - total)), int(np.sum(without > total))
    return [*found, _level(case, name, after, float(with_effect.sum()), count, fall, better)]


def _known(case: Case, pose: Sequence[Variable], values: Values) -> np.ndarray:
    """Of each held-out frame, what was known of its own settings before: chi2 of its priors, each counted once."""
    found = np.zeros(len(case.held_out))
    for v in pose:
        own = [i for i, frame in enumerate(case.held_out) if v.holds_in(frame)]
        if v.prior is not None and own:
            found[own] += ((value_of(case.model, values, v) - v.prior[0]) / v.prior[1]) ** 2 / len(own)
    return found


def _crossed(
    case: Case,
    free: Sequence[Variable],
    frames: Sequence[int],
    predictions: Sequence[np.ndarray],
    values: Values,
    masks: Sequence[np.ndarray],
    sds: Sequence[np.ndarray],
) -> list[float]:
    """chi2 of each frame, one half of it predicted by a fit of the other, and the other way round.

    With images X and residuals r of a half at the optimum of both, (G - G_h + P) step = -X'r moves it to that of the
    other half; P holds priors. Halves are a chessboard of SQUARES x SQUARES fields, of readings the first and the
    second half."""
    found = []
    derivatives = case.model.derivatives(values, free, frames, seed=case.seed)
    for f, prediction, use, sd, (_, images) in zip(frames, predictions, masks, sds, derivatives):
        there = [v for v in free if v.name in images]
        acting, prior = [np.asarray(images[v.name], float) for v in there], np.diag([v.precision for v in there])
        residual = np.where(use, (np.asarray(case.model.frames[f].image, float) - prediction) / sd, 0.0)
        residual = np.where(np.isfinite(residual), residual, 0.0)
        x = np.stack([np.where(use, image / sd, 0.0) for image in acting], -1) if acting else np.zeros((*use.shape, 0))
        first, total = _half(use.shape), 0.0
        gram = np.einsum("hwci,hwcj->ij", x, x)
        for half in (first, ~first):
            own, r = x[half], residual[half]
            inverse, _ = st.inverse(gram - np.einsum("nci,ncj->ij", own, own) + prior)
            total += float(np.sum((r + own @ (inverse @ np.einsum("nci,nc->i", own, r))) ** 2))
        found.append(total)
    return found


def _half(shape: tuple[int, ...]) -> np.ndarray:
    """(H, W) bool, the fields of one colour of a chessboard; of readings (N, 1), the first half."""
    row, column = (np.arange(n) * min(SQUARES, n) // n for n in shape[:2])
    if shape[1] == 1:
        return np.broadcast_to((np.arange(shape[0]) < shape[0] // 2)[:, None], shape[:2])
    return (row[:, None] + column) % 2 == 0


def _predicted(case: Case, values: Values, free: list[Variable]) -> tuple[list[np.ndarray], Values]:
    """Predictions of the held-out frames after fitting what is `free` there, and the values."""
    if free:

        def follow(values: Values) -> Fit:
            return case.refit(case.model, free, values, frames=list(case.held_out))

        values = over_branches(case.model, follow(values), follow).values
    return [np.asarray(image, float) for image in case.model.predict(values, case.held_out)], values


def _level(
    case: Case,
    name: str,
    fitted: float,
    held: float = math.nan,
    count: int = 0,
    fall: float = math.nan,
    better: int = 0,
) -> Level:
    """Misfits from chi2 on fitted frames and on `count` held-out values."""
    evidence, n = case.evidence, case.evidence.normal.count
    return Level(
        name,
        evidence.noise * math.sqrt(fitted / n),
        evidence.noise * math.sqrt(held / count) if count else math.nan,
        fitted / n,
        held / count if count else math.nan,
        n,
        count,
        fall,
        better,
        len(case.held_out),
    )


def _square(
    model: Model, frame: int, prediction: np.ndarray, use: np.ndarray, sd: np.ndarray, wander: float = 0.0
) -> float:
    """chi2 of a frame; a prediction that is not finite counts as no residual, as its pixel was not used before."""
    residual = (np.asarray(model.frames[frame].image, float) - prediction) / sd
    use = use & np.isfinite(residual)
    r, g = residual[use], ((prediction - float(model.noise.black_level)) / sd)[use]
    return float(r @ r - (wander * (r @ g)) ** 2 / (1 + wander**2 * (g @ g)))


def shifts(case: Case, members: Sequence[Candidate], found: Fit) -> list[Shift]:
    """How far the base's parameters moved when effects were added, the farthest (in their own sd) first."""
    model, fit, name = case.model, case.fit, " + ".join(c.effect.name for c in members)
    sd = {v.name: float(s) for v, s in zip(fit.variables, fit.sd)}
    present = {v.name for v in found.variables}
    moved = []
    for v in fit.variables:
        if v.name not in present:
            continue
        before, after = value_of(model, fit.values, v), value_of(model, found.values, v)
        own = sd.get(v.name, math.nan)
        in_sd = (after - before) / own if own > 0 else math.nan
        out = v.prior is not None and abs(after - v.prior[0]) > MOVED * v.prior[1]
        warn = bool(abs(in_sd) > MOVED or out)
        moved.append(Shift(name, v.name, v.parameter.unit, before, after, in_sd, warn))
    return sorted(moved, key=lambda s: -abs(s.in_sd) if math.isfinite(s.in_sd) else 0.0)
