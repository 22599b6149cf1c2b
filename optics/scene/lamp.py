"""A lamp by the clock: it drifts along a line, or towards a level that it settles at.

The output of a lamp whose temperature approaches a balance at the rate 1/tau changes as 1 - exp(-t/tau): of a filament,
an LED on its board, the coil of a supply (Newton's law of cooling)."""

from __future__ import annotations

from optics.polarization.mueller import exp, real, where

SMALL = 0.05  # settling times time, below which a power series is exact to 3e-12


def drifted(lamp):
    """1 + drift time (1 - exp(-x))/x with x = settling time: relative output of a lamp, at the numbers `drift`,
    `settling` and `time` of a part. Settling 0 is a straight line."""
    x = lamp.settling * lamp.time
    small = real(x) * real(x) < SMALL**2
    safe = where(small, SMALL + 0.0 * x, x)
    series = 1 - x / 2 * (1 - x / 3 * (1 - x / 4 * (1 - x / 5 * (1 - x / 6))))
    share = where(small, series, (1 - exp(-safe)) / safe)
    return 1 + lamp.drift * lamp.time * share
