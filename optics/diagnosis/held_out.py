"""Held-out frames, and what had moved to hide an effect.

On held-out frames the parameters that all frames share are frozen, and only what each frame has for itself is solved
for, for the base and for the base with the winner alike."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from optics.diagnosis.evidence import Candidate
from optics.diagnosis.refit import Case, chi2
from optics.diagnosis.result import Level, Shift
from optics.fit.calibrate import for_frames
from optics.fit.model import Model, value_of
from optics.fit.result import Fit
from optics.scene.parameter import Values, Variable

MOVED = 3.0  # standard deviations, of the fit or of the prior, that a parameter must have moved to be reported


def levels(case: Case, winner: Candidate | None, fits: Mapping[str, Fit]) -> list[Level]:
    """Misfit of the base and, if there is a winner, of the base with it, on fitted and on held-out frames."""
    evidence, fit, held_out, say = case.evidence, case.fit, case.held_out, case.say
    before, after = evidence.normal.square, chi2(case, fits[winner.effect.name].values)[0] if winner else math.nan

    if not held_out:
        found = [_level(case, "base", before)]
        return found + ([_level(case, winner.effect.name, after)] if winner else [])
    say("held-out frames", 0, 2)
    pose = for_frames(case.model, fit.variables, held_out)
    predictions, values = _predicted(case, fit.values.copy(), pose)
    masks, sds, base = [], [], []
    for f, prediction in zip(held_out, predictions):
        variance = evidence.variance(case.model, f, prediction, values)
        use = np.asarray(case.model.usable(f), bool) & np.isfinite(prediction)
        masks.append(use)
        sds.append(np.sqrt(np.where(use, variance, 1.0)))
        base.append(_square(case.model, f, prediction, use, sds[-1]))
    count = int(sum(m.sum() for m in masks))
    found = [_level(case, "base", before, sum(base), count)]
    if winner is None or not count:
        return found
    say("held-out frames", 1, 2)
    own = [v for v in case.variables_of(winner.effect) if v.frames is not None and set(v.frames) & set(held_out)]
    predictions, _ = _predicted(case, fits[winner.effect.name].values.copy(), [*pose, *own])
    with_effect = [
        _square(case.model, f, prediction, use, sd) for f, prediction, use, sd in zip(held_out, predictions, masks, sds)
    ]
    fall = sum(base) - sum(with_effect) - len(own)
    better = int(sum(b > w for b, w in zip(base, with_effect)))
    say("held-out frames", 2, 2)
    return [*found, _level(case, winner.effect.name, after, sum(with_effect), count, fall, better)]


def _predicted(case: Case, values: Values, free: list[Variable]) -> tuple[list[np.ndarray], Values]:
    """Predictions of the held-out frames after fitting what is `free` there, and the values."""
    if free:
        values = case.refit(case.model, free, values, frames=list(case.held_out)).values
    return [np.asarray(case.model.predict(values, [f])[0], float) for f in case.held_out], values


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


def _square(model: Model, frame: int, prediction: np.ndarray, use: np.ndarray, sd: np.ndarray) -> float:
    """chi2 of a frame; a prediction that is not finite counts as no residual, as its pixel was not used before."""
    residual = (np.asarray(model.frames[frame].image, float) - prediction) / sd
    return float(np.sum(np.where(use & np.isfinite(residual), residual, 0.0) ** 2))


def shifts(case: Case, winner: Candidate, fits: Mapping[str, Fit]) -> list[Shift]:
    """How far the base's parameters moved when the winner was added, the farthest (in their own sd) first."""
    model, fit, found = case.model, case.fit, fits[winner.effect.name]
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
        moved.append(Shift(winner.effect.name, v.name, v.parameter.unit, before, after, in_sd, warn))
    return sorted(moved, key=lambda s: -abs(s.in_sd) if math.isfinite(s.in_sd) else 0.0)
