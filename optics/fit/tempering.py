"""What is known keeps its weight while the model is wrong.

    minimise chi2/T + priors,    T = max over squares of any side of  sum of (sum of r over a square)^2 / n

with the n whitened residuals r of images. Chi2 knows noise alone: where a model misses images by ten times their noise,
it would sell every prior for a little less misfit, and lights, poses and shapes run away to wherever they make up for
what the model lacks. With the misfit's own size in place of the noise, chi2/T is about the number of values. Neighbours
miss alike, though, and parameters act on many of them: what counts is by how much the sum over a square varies more
than one of noise, whose squares add up to n for any side. A misfit far below the noise of one pixel is far above that
of a thousand. (Bayesian tempering, or the power likelihood, with the power that the misfit itself suggests: Gruenwald &
van Ommen, Bayesian Analysis 12, 1069, 2017; the design effect of clusters, Kish, Survey Sampling, 1965.)

Minimising chi2 + T priors is the same, so that T is a weight of the priors (`Variable.weight`), and all else stays. A
model that misses nothing has T = 1."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optics.fit.model import Model
from optics.scene.parameter import Values, Variable

# Of an image's shorter side, the largest square in which neighbours may miss alike; smaller ones have halves of it. In
# shares of the image, since one that is binned must weigh what is known as one that is not.
LARGEST = 1 / 4
NOISE = 5.0  # standard deviations of chi2: a smaller excess is no misfit


def temperature(model: Model, values: Values, frames: Sequence[int], dof: int) -> float:
    """T of the images of these frames at these values; 1 where nothing but noise is left."""
    square, whole, sums = 0.0, 0, dict.fromkeys(sides(min(np.asarray(model.frames[frames[0]].image).shape[:2])), 0.0)
    for index, prediction in zip(frames, model.predict(values, frames)):
        usable = np.broadcast_to(model.usable(index), prediction.shape)
        sd = np.sqrt(model.variance(values, index, prediction))
        r = np.where(usable, (model.frames[index].image - prediction) / sd, 0.0)
        square, whole = square + float(np.sum(r**2)), whole + int(usable.sum())
        for side in sums:
            height, width = (n // side * side for n in r.shape[:2])
            blocks = r[:height, :width].reshape(height // side, side, width // side, side, -1).sum((1, 3))
            sums[side] += float(np.sum(blocks**2))
    dof = min(dof, whole)
    excess = square - dof
    if not excess > NOISE * np.sqrt(2 * max(dof, 1)):
        return 1.0
    return float(1 + (max(sums.values()) - whole) / dof)


def sides(shorter: int) -> list[int]:
    """px, sides of the squares: a quarter of an image's shorter side, an eighth, ... one pixel."""
    found, side = [], max(round(LARGEST * shorter), 1)
    while side:
        found.append(side)
        side //= 2
    return found


def tempered(variables: Sequence[Variable], weight: float) -> list[Variable]:
    """The variables with priors that count so many times."""
    return [replace(v, weight=float(weight)) for v in variables]


def weight_of(variables: Sequence[Variable]) -> float:
    """T of a fit's variables, of which those that an effect brought since may still have 1."""
    return max((v.weight for v in variables), default=1.0)
