"""Noise that neighbours share, about an explanation: of readings along the session, of frames what a lamp did."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from optics.diagnosis.correlation import NOTICED, SHORTEST, Correlation, Readings
from optics.diagnosis.evidence import Candidate, at_bound, measure, priors, silent
from optics.diagnosis.explanations import Outcome, Trial
from optics.diagnosis.refit import Case
from optics.diagnosis.session import Frames
from optics.diagnosis.thresholds import MISSTATED
from optics.fit.model import value_of
from optics.scene.parameter import Variable


def lamp_noise(case: Case, trial: Trial, scale: float) -> Correlation:
    """The noise that frames share with their neighbours about an explanation of images; none where it has a gain of
    each frame."""
    if case.lamp is None or trial.by_frame:
        return Correlation(scale)
    return frames_about(case, case.lamp, trial).noise(scale)


def gain_of(case: Case, trial: Trial, scale: float) -> float:
    """By how much that noise lowers the deviance."""
    return lamp_noise(case, trial, scale).gain


def expected_gain(case: Case, members: Sequence[Candidate], scale: float) -> float:
    """The same of a set of effects, before it is refitted."""
    if case.lamp is None or any(c.effect.scope == "frame" for c in members):
        return 0.0
    evidence = case.evidence
    columns = evidence.dense([*evidence.base, *(i for c in members for i in c.columns)])
    return case.lamp.about(np.concatenate([b.r for b in evidence.blocks]), columns).noise(scale).gain


def is_a_gain(c: Candidate) -> bool:
    """Whether an effect has one strength for each frame as a whole."""
    return c.effect.scope == "frame" and c.effect.per == "kind"


def bound_wander(case: Case, trials: Iterable[Trial]) -> None:
    """Where effects leave nothing, a lamp that swings as nobody would let it is no rival of theirs; nor is it of images
    where no effect may have a strength for each frame, as where captures state that exposures are the same."""
    alike = not case.evidence.is_table and not any(is_a_gain(c) for c in case.table.order)
    most = NOTICED if alike or any(t.members and t.complete for t in trials) else math.inf
    if case.evidence.is_table:
        case.session.most = most
    elif case.lamp is not None:
        case.lamp.most = most


def wander_of(case: Case, outcome: Outcome, trial: Trial) -> float:
    """Rms of the noise that neighbours share about an explanation, over that of the signal; 0 for images that are too
    few to tell, or where each frame has a strength."""
    if case.evidence.is_table:
        readings = readings_about(case, trial)
    elif case.lamp is not None and not trial.by_frame:
        readings = frames_about(case, case.lamp, trial)
    else:
        return 0.0
    return math.sqrt(readings.noise(outcome.scale).power * outcome.scale / max(readings.bright, 1e-12))


def noise_of(case: Case, outcome: Outcome, trial: Trial) -> Correlation | None:
    """What neighbouring readings, or the pixels of a frame, share about an explanation; None of images that are too few
    to tell, or where each frame has a strength. A lamp that swings by more than NOTICED is no noise of images."""
    if case.evidence.is_table:
        return readings_about(case, trial).noise(outcome.scale)
    if case.lamp is None or trial.by_frame:
        return None
    return frames_about(case, case.lamp, trial).noise(outcome.scale, NOTICED)


def beside_noise(case: Case, outcome: Outcome) -> tuple[Correlation, float]:
    """(noise that neighbouring readings share about the base, p of structure and of jumps that it leaves); p is NaN
    where there is no such noise, or it leaves misfit. A lamp that wanders does not jump, as one that is changed does,
    and takes longer than neighbours: noise of the SHORTEST memory may stand for flicker."""
    readings = readings_about(case, outcome.base)
    noise = readings.correlation()
    if not noise.power or noise.scale > MISSTATED or noise.length <= SHORTEST:
        return noise, math.nan
    evidence = case.evidence
    left = evidence.structure(evidence.whitened, evidence.base, lambda c: case.session.independent(c, noise))
    new = case.session.independent(np.concatenate([b.r for b in evidence.blocks])[:, None], noise)[:, 0]
    jump = len(new) * math.erfc(float(np.abs(new).max()) / math.sqrt(2))
    return noise, min(left.p, jump)


# -- readings and frames about an explanation -------------------------------------------------------------------------
def kept_values(case: Case, images: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Of whitened images (H, W, C), the values that the evidence keeps, per block."""
    return [np.asarray(i, float).reshape(-1)[b.index] for i, b in zip(images, case.evidence.blocks)]


def readings_about(case: Case, trial: Trial) -> Readings:
    """The readings about an explanation; whitened once, as it competes more than once."""
    if trial.readings is None:
        residual = np.concatenate(kept_values(case, trial.images))
        base = [case.evidence.columns[i] for i in case.evidence.base]
        known = priors(case.model, trial.fit.values, base)
        trial.readings = case.session.about(residual, derivatives_of(case, trial), known)
    return trial.readings


def frames_about(case: Case, lamp: Frames, trial: Trial) -> Readings:
    """The frames about an explanation of images, with the derivative images of the base; once, as it competes more
    than once."""
    if trial.readings is not None:
        trial.readings.most = lamp.most
        return trial.readings
    trial.readings = lamp.about(*frame_images(case, trial))
    return trial.readings


def frame_images(case: Case, trial: Trial) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """(whitened residual, images of the base and of an explanation's strengths, what is known of the base)."""
    evidence = case.evidence
    columns = evidence.dense([*evidence.base, *(i for c in trial.members for i in c.columns)])
    known = priors(case.model, trial.fit.values, [evidence.columns[i] for i in evidence.base])
    return np.concatenate(kept_values(case, trial.images)), columns, known


def derivatives_of(case: Case, trial: Trial) -> np.ndarray:
    """(n, k) whitened derivative images of the base and of an explanation's strengths, at its fit; 0 of those that
    stand at a bound there."""
    base = [case.evidence.columns[i] for i in case.evidence.base] + [v for c in trial.members for v in c.variables]
    columns = _derivatives(case, trial, base)
    columns[:, [at_bound(v, value_of(case.model, trial.fit.values, v)) for v in base]] = 0.0
    return columns


def _derivatives(case: Case, trial: Trial, base: Sequence[Variable]) -> np.ndarray:
    """(n, k) whitened derivative images at an explanation's fit; those that the fit made last, where it has them."""
    normal = trial.fit.normal
    if normal is not None and trial.fit.frames == case.evidence.frames:
        names = {v.name: i for i, v in enumerate(trial.fit.variables)}
        place = {names[v.name]: i for i, v in enumerate(base)}
        parts = [np.zeros((j.shape[1], len(base))) for _, j, _ in normal.rows]
        for part, (where, j, _) in zip(parts, normal.rows):
            there = [(place[int(w)], k) for k, w in enumerate(where) if int(w) in place]
            part[:, [i for i, _ in there]] = j[[k for _, k in there]].T
        if [len(p) for p in parts] == [len(b.r) for b in case.evidence.blocks]:
            return np.concatenate(parts)
    own = measure(case.model, trial.fit.values, base, [], case.evidence.frames, case.rows_max, case.seed, silent)
    return own.dense(own.base)
