"""What warms up, by the clock: it drifts along a line, or towards a level that it settles at.

What a part sends or reads changes as 1 - exp(-t/tau) while its temperature approaches a balance at the rate 1/tau: the
output of a filament, of an LED on its board, the dark signal of a detector (Newton's law of cooling)."""

from __future__ import annotations

from optics.polarization.mueller import exp, real, where

SMALL = 0.05  # settling times time, below which a power series is exact to 3e-12


def settled(time, rate):
    """(1 - exp(-x))/rate with x = rate time: how long it would have drifted along its first slope. Rate 0: `time`."""
    x = rate * time
    small = real(x) * real(x) < SMALL**2
    safe = where(small, SMALL + 0.0 * x, x)
    series = 1 - x / 2 * (1 - x / 3 * (1 - x / 4 * (1 - x / 5 * (1 - x / 6))))
    share = where(small, series, (1 - exp(-safe)) / safe)
    return time * share


def drifted(lamp):
    """1 + drift settled(time): relative output of a lamp, at the numbers `drift`, `settling` and `time` of a part."""
    return 1 + lamp.drift * settled(lamp.time, lamp.settling)
