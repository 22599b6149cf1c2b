"""A curve given by points, for effects that are drafted from a diagnosis: `lookup(x, at, values)`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def lookup(x, at: Sequence[float], values: Sequence[float]):
    """The polygon through the points (at, values) at x, constant beyond its ends; `at` rises.

    x   a number, an array (complex where a derivative is taken by complex step: the slope goes along), or a Dr.Jit
        float (the derivative by forward mode goes along)
    """
    at, values = np.asarray(at, float), np.asarray(values, float)
    if len(at) != len(values) or len(at) < 2 or not np.all(np.diff(at) > 0):
        raise ValueError(
            f"lookup: {len(at)} places and {len(values)} values; allowed: as many of either, at least two, places "
            "rising"
        )
    slopes = np.diff(values) / np.diff(at)
    if type(x).__module__.startswith(("drjit", "mitsuba")):
        import drjit as dr

        result = x * 0 + float(values[0])
        for begin, width, slope in zip(at, np.diff(at), slopes):
            result += float(slope) * dr.clip(x - float(begin), 0, float(width))
        return result
    real = np.real(x)
    result = np.interp(real, at, values)
    if np.iscomplexobj(x):
        result = result + 1j * np.imag(x) * np.array([0.0, *slopes, 0.0])[np.searchsorted(at, real, side="right")]
    return result
