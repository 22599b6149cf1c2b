"""What the residual adds to the curvature of chi2, for the angles of single frames.

    d2 chi2 / d angle2  =  2 ( J'WJ - sum of W r d2f/d angle2 )

Gauss-Newton keeps the first term. Where a film stands crossed or parallel, its image f stands still as it turns: the
first term vanishes, and a step by it alone is many degrees too long and promises a fall that no step brings. The second
term is found from predictions on both sides of the angle. An angle with an error of its own in every frame acts in that
frame alone, so that all frames are moved at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from optics.fit.model import Model, value_of
from optics.scene.parameter import Values, Variable

HALF = 0.5  # deg: half width of the second difference; far above rounding, and small beside the period of Malus


def own_curvature(model: Model, variables: Sequence[Variable], values: Values, frames: Sequence[int]) -> np.ndarray:
    """(p,) the second term above, halved as in the normal equations, in 1/deg^2, where it makes chi2 steeper; 0 for all
    variables but angles that hold in some frames only, and everywhere where predictions are Monte Carlo estimates.

    Where it makes chi2 flatter it is left out, so that the normal matrix stays positive definite."""
    found = np.zeros(len(variables))
    angles = [i for i, v in enumerate(variables) if v.frames is not None and v.parameter.role == "angle"]
    if not angles or model.monte_carlo:
        return found
    middle = dict(zip(frames, model.predict(values, frames)))
    for key in dict.fromkeys(variables[i].keys for i in angles):
        own = [i for i in angles if variables[i].keys == key]
        moved = sorted({f for i in own for f in variables[i].frames or ()} & set(frames))
        sides = [model.predict(_turned(model, values, [variables[i] for i in own], h), moved) for h in (-HALF, HALF)]
        at = {frame: (low, high) for frame, low, high in zip(moved, *sides)}
        for i in own:
            for frame in set(variables[i].frames or ()) & set(moved):
                low, high = at[frame]
                bend = (low - 2 * middle[frame] + high) / HALF**2
                pull = (model.frames[frame].image - middle[frame]) / model.variance(values, frame, middle[frame])
                found[i] -= float(np.sum(pull * bend, where=model.usable(frame)))
    return np.maximum(found, 0.0)


def _turned(model: Model, values: Values, variables: Sequence[Variable], by: float) -> Values:
    """The values with these variables `by` higher, within their bounds."""
    moved = values.copy()
    for v in variables:
        moved.put(v, float(np.clip(value_of(model, values, v) + by, *v.parameter.bounds)))
    return moved
