"""Starts: where a search for periodic parameters begins, besides the present values.

A descent ends in the nearest minimum, and some parameters have many: the orders of a retardance, the quadrants of a
polarizer whose zero nobody knows. Their declarations name places to begin from (`Parameter.starts`). Each is tried by a
prediction in which the linear parameters (powers, an offset in DN) are solved for,

    chi2(start) = min over p of |(y - f(start, p)) / sigma|^2

with sigma from the measured values, the same for every trial; the best few are worth a descent. A table of readings is
predicted in milliseconds. For images the number of trials is bounded by the number of values to predict."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from optics.fit.descent import solve, stacked, whiten
from optics.fit.model import Model, value_of
from optics.scene.parameter import Values, Variable

DIRECTIONS = 8  # of a vector: a component along its neighbours is at least cos(22.5 deg) = 0.92 of it
MOST = 320  # trials: five unknown zeros of a film beside eight lengths in eight directions
WORK = 1_000_000  # values that all trials together predict: a few seconds of images between polarizers
SMALL = 20_000  # values of one prediction, up to which FOLLOWED trials are followed; beyond, half as many
FOLLOWED = 4  # trials that are worth a descent
LEAST = 8  # trials that images get where the present values say nothing: a vector's shortest length in all directions
FRAMES = 4  # that trials predict: sweeps cover the whole range each, and images of one sensor differ in a few settings
SAME = 1e-6  # relative difference of chi2 below which two trials are the same minimum by a symmetry

Trial = dict[int, float]  # place of a variable -> its value


def declared(variables: Sequence[Variable], over: Sequence[str] | None = None) -> list[int]:
    """Places of the variables that hold in all frames and name places to begin from; `over`: of these names only."""
    return [
        i
        for i, v in enumerate(variables)
        if v.parameter.starts and v.frames is None and (over is None or v.name in over)
    ]


def alternatives(
    model: Model, variables: Sequence[Variable], values: Values, over: Sequence[str] | None = None
) -> list[list[Trial]]:
    """For each parameter, or vector of two, with starts: where to put it, the present values first."""
    names = {v.keys: i for i, v in enumerate(variables)}
    found, taken = [], set()
    for i in declared(variables, over):
        v = variables[i]
        if i in taken:
            continue
        partner = names.get(tuple(f"{key.rpartition('.')[0]}.{v.parameter.pair}" for key in v.keys), i)
        taken |= {i, partner}
        here = {k: value_of(model, values, variables[k]) for k in (i, partner)}
        if partner != i:
            turns = [2 * math.pi * k / DIRECTIONS for k in range(DIRECTIONS)]
            trials = [{i: s * math.cos(t), partner: s * math.sin(t)} for s in v.parameter.starts for t in turns]
        elif v.parameter.pair:
            trials = [{i: sign * s} for s in v.parameter.starts for sign in (1, -1)]
        else:
            trials = [{i: s} for s in v.parameter.starts]
        bounds = {k: variables[k].parameter.bounds for k in (i, partner)}
        trials = [{k: float(np.clip(x, *bounds[k])) for k, x in trial.items()} for trial in trials]
        found.append([here, *trials])
    return found


def number_of_trials(model: Model, frames: Sequence[int], blind: bool) -> int:
    """How many predictions a search may make; 0: none. blind: whether the present values show nothing."""
    if model.monte_carlo:
        return 0
    per_trial = sum(model.frames[f].image.size for f in _shown(frames))
    allowed = min(MOST, WORK // max(per_trial, 1))
    return max(allowed, LEAST) if blind else allowed if allowed > LEAST else 0


def number_followed(model: Model, frames: Sequence[int]) -> int:
    """How many of the best trials are followed by a descent."""
    return FOLLOWED if sum(model.frames[f].image.size for f in frames) <= SMALL else FOLLOWED // 2


def search(
    model: Model,
    variables: Sequence[Variable],
    values: Values,
    frames: Sequence[int],
    most: int,
    over: Sequence[str] | None = None,
) -> list[tuple[float, Values]]:
    """Trials of starts, the best first: (chi2, values with the linear parameters solved for). At most `most` of them;
    where all combinations are more, one parameter is searched after the other, twice. Of trials that are the same by a
    symmetry, the first declared is kept."""
    choices = alternatives(model, variables, values, over)
    shown = _shown(frames)
    weights = [_weight(model, values, f) for f in shown]
    linear = [v for v in variables if model.linear_in(v) or v.parameter.how == "image" and v.parameter.linear]
    linear = [v for v in linear if v.frames is None or set(v.frames) & set(shown)]
    tried: dict[tuple, tuple[float, Values]] = {}

    def tried_at(trial: Trial) -> float:
        key = tuple(sorted(trial.items()))
        if key not in tried:
            there = values.copy()
            for i, value in trial.items():
                there.put(variables[i], value)
            tried[key] = _solved(model, linear, there, shown, weights)
        return tried[key][0]

    if math.prod(map(len, choices)) <= most:
        for combined in itertools.product(*choices):
            tried_at({k: x for trial in combined for k, x in trial.items()})
    else:
        best = {k: x for trials in choices for k, x in trials[0].items()}
        for n in range(2 * len(choices)):  # those that follow in this round keep their share
            trials, later = choices[n % len(choices)], choices[n % len(choices) + 1 :]
            room = most - len(tried) - sum(map(len, later))
            best = min(({**best, **trial} for trial in trials[: max(room, 1)]), key=tried_at)
    ranked: list[tuple[float, Values]] = []
    for chi2, there in sorted(tried.values(), key=lambda t: t[0]):
        if math.isfinite(chi2) and all(abs(chi2 - other) > SAME * other for other, _ in ranked):
            ranked.append((chi2, there))
    return ranked


def _shown(frames: Sequence[int]) -> list[int]:
    """Up to FRAMES of them, evenly spaced."""
    count = min(FRAMES, len(frames))
    return [frames[(2 * k + 1) * len(frames) // (2 * count)] for k in range(count)]


def _weight(model: Model, values: Values, frame: int) -> np.ndarray:
    """(H, W, C) 1/sigma at the usable values, 0 at the others, by the measured values."""
    image = np.asarray(model.frames[frame].image, float)
    return np.sqrt(model.usable(frame) / model.variance(values, frame, image)).astype(np.float32)


def _solved(
    model: Model, linear: Sequence[Variable], values: Values, frames: Sequence[int], weights: Sequence[np.ndarray]
) -> tuple[float, Values]:
    """(chi2, values) after the linear parameters are solved for; infinite where a prediction is not finite."""
    names = {v.name: i for i, v in enumerate(linear)}
    a, b, square = np.zeros((len(linear), len(linear))), np.zeros(len(linear)), 0.0
    for frame, scale, (prediction, images) in zip(frames, weights, model.derivatives(values, linear, frames)):
        left = whiten(model, frame, prediction, scale).astype(float)
        j = stacked(images, scale).astype(float)
        where = np.array([names[n] for n in images], int)
        a[np.ix_(where, where)] += j @ j.T
        b[where] += j @ left
        square += float(left @ left)
    theta = np.array([value_of(model, values, v) for v in linear])
    low, high = (np.array([v.parameter.bounds[k] for v in linear]) for k in (0, 1))
    if not np.isfinite(a).all() or not math.isfinite(square):
        return math.inf, values
    step = solve(a, b, low - theta, high - theta) if len(linear) else np.zeros(0)
    for v, t in zip(linear, theta + step):
        values.put(v, float(t) if t > v.parameter.bounds[0] or not v.parameter.factor else value_of(model, values, v))
    return square - float(2 * b @ step - step @ a @ step), values
