"""A curve given by points, for effects that are drafted from a diagnosis: `lookup(x, at, values)`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def lookup(x, at: Sequence[float], values: Sequence[float]):
    """The polygon through the points (at, values) at x, constant beyond its ends; `at` rises.

    x   a number, an array (complex where a derivative is taken by complex step: the slope goes along), or a Dr.Jit float (the
        derivative by forward mode goes along)
    """
    at, values = np.asarray(at, float), np.asarray(values, float)
    if len(at) != len(values) or len(at) < 2 or not np.all(np.diff(at) > 0):
        raise ValueError(f"lookup: {len(at)} places and {len(values)} values; allowed: as many of either, at least two, places rising")
    slopes = np.diff(values) / np.diff(at)
    if type(x).__module__.startswith(("drjit", "mitsuba")):
        import drjit as dr

        result = x * 0 + float(values[0])
        for begin, width, slope in zip(at, np.diff(at), slopes):
            result += float(slope) * dr.clip(x - float(begin), 0, float(width))
        return result
    x = np.asarray(x)
    real = np.real(x)
    k = np.clip(np.searchsorted(at, real, side="right") - 1, 0, len(slopes) - 1)
    inside = (real > at[0]) & (real < at[-1])
    return np.where(inside, values[k] + slopes[k] * (x - at[k]), np.where(real <= at[0], values[0], values[-1]))
