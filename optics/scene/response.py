"""Responses: the inverse of a camera's response as a cubic, in numpy, with derivatives by a complex step."""

from __future__ import annotations

import numpy as np


def inverse_cubic(irradiance, a, b):
    """m with G(m) = m + a (m^2 - m) + b (m^3 - m) = irradiance, by Newton from m = irradiance; (S1.1).

    Beyond full scale (m > 1) and below 0 the response goes on as a straight line, so that it stays invertible.
    """
    if np.all(a == 0) and np.all(b == 0):
        return irradiance
    x = np.asarray(irradiance)
    m = np.clip(x.real, 0, 1)
    ra, rb = np.real(a), np.real(b)
    for _ in range(30):
        slope = 1 + ra * (2 * m - 1) + rb * (3 * m * m - 1)
        if np.any(slope <= 0):
            raise ValueError(
                f"response with quadratic term {ra:g} and cubic term {rb:g} is not monotone on [0, 1]; "
                "its inverse needs 1 + a (2m - 1) + b (3m^2 - 1) > 0"
            )
        step = (m + ra * (m * m - m) + rb * (m**3 - m) - np.clip(x.real, 0, 1)) / slope
        m = np.clip(m - step, 0, 1)
        if np.abs(step).max() < 1e-13:
            break
    inside = (x.real >= 0) & (x.real <= 1)
    # one complex Newton step carries the derivative along; outside, the end's slope does
    slope = 1 + a * (2 * m - 1) + b * (3 * m * m - 1)
    end = np.clip(x.real, 0, 1)
    value = m - (m + a * (m * m - m) + b * (m**3 - m) - np.where(inside, x, end)) / slope
    return value + np.where(inside, 0, (x - end) / slope)
