"""A curve over the wavelength, for numbers, complex numbers and Dr.Jit.

What a curve is of decides what its values may be, and what lies beyond its ends: light, sensitivity and the absorptance
of a pigment are 0 there, a transmittance, a reflectance, an absorption and an index stay as they are at the end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

KINDS = {  # of a curve: its unit, the values it may have, and whether it is 0 beyond its ends
    "power": ("relative", (0.0, np.inf), True),
    "sensitivity": ("relative", (0.0, np.inf), True),
    "transmittance": ("1", (0.0, 1.0), False),
    "reflectance": ("1", (0.0, 1.0), False),
    "absorptance": ("1", (0.0, 1.0), True),
    "absorption": ("1/mm", (0.0, np.inf), False),
    "index": ("1", (0.1, 10.0), False),
}
VISIBLE = (360.0, 830.0)  # nm: the range of the CIE's colour matching functions
STEP = 0.25  # nm, of integrals: below a sixth of a line's width, a sum over a Gaussian is exact to 1e-12


@dataclass(frozen=True, eq=False)
class Curve:
    """A curve through values (N,) at wavelengths (N,) in nm, ascending, with straight lines in between.

    kind     one of KINDS
    source   what it was read from, in words
    cubic    monotone cubics in between (PCHIP, Fritsch & Butland 1984): of a curve that is moved or stretched the slope
             counts, which straight lines make jump
    """

    nm: np.ndarray
    values: np.ndarray
    kind: str = "power"
    source: str = ""
    cubic: bool = False

    def __call__(self, wavelengths: Any) -> Any:
        """The values at wavelengths in nm: an array, complex ones among them (analytic but for the corners), or a
        spectrum of Dr.Jit."""
        if not isinstance(wavelengths, (int, float, complex, np.ndarray, np.generic, list, tuple)):
            return self._at_lanes(wavelengths)
        at = np.asarray(wavelengths)
        place = np.clip(np.searchsorted(self.nm, at.real, side="right") - 1, 0, max(len(self.nm) - 2, 0))
        if len(self.nm) == 1:
            slope, low = np.zeros(at.shape), self.values[place]
        else:
            slope = (np.diff(self.values) / np.diff(self.nm))[place]
            low = self.values[place]
        found = low + slope * (at - self.nm[place])
        if self.cubic:
            found = np.polyval(self._pieces[:, place], at - self.nm[place])
        below, above = at.real < self.nm[0], at.real > self.nm[-1]
        ends = (0.0, 0.0) if KINDS[self.kind][2] else (self.values[0], self.values[-1])
        return np.where(below, ends[0], np.where(above, ends[1], found))

    def _at_lanes(self, wavelengths: Any) -> Any:
        """The same for a spectrum of Dr.Jit, from a table in steps of `STEP`."""
        import drjit as dr
        import mitsuba as mi

        start, table = self._table
        data = mi.Float(table)
        lanes = mi.UnpolarizedSpectrum(wavelengths)
        found: Any = mi.UnpolarizedSpectrum(0.0)
        for lane in range(dr.size_v(mi.UnpolarizedSpectrum)):
            place = dr.clip((lanes[lane] - start) / STEP, 0, len(table) - 1.001)
            low = mi.UInt32(dr.floor(dr.detach(place)))
            first, second = dr.gather(mi.Float, data, low), dr.gather(mi.Float, data, low + 1)
            found[lane] = first + (second - first) * (place - mi.Float(low))
        return found

    @cached_property
    def _table(self) -> tuple[float, np.ndarray]:
        """Where the table of `_at_lanes` starts, nm, and its values; the first and the last are those beyond the
        ends."""
        start = np.floor(self.nm[0] / STEP) * STEP - STEP
        nm = np.arange(start, self.nm[-1] + 2.5 * STEP, STEP)
        return float(start), self(nm).astype(np.float32)

    @property
    def span(self) -> tuple[float, float]:
        """First and last wavelength, nm."""
        return float(self.nm[0]), float(self.nm[-1])

    @cached_property
    def area(self) -> float:
        """Integral over the wavelength."""
        if self.cubic:
            fine = np.linspace(*self.span, max(round((self.nm[-1] - self.nm[0]) / STEP), 1) + 1)
            return float(np.trapezoid(self(fine), fine))
        return float(np.trapezoid(self.values, self.nm))

    @cached_property
    def centre(self) -> float:
        """Mean wavelength, nm."""
        fine = np.arange(self.nm[0], self.nm[-1] + STEP / 2, STEP)
        weights = self(fine)
        return float((fine * weights).sum() / weights.sum())

    @cached_property
    def peak(self) -> float:
        """Wavelength of the largest value, nm."""
        return float(self.nm[int(np.argmax(self.values))])

    @cached_property
    def fwhm(self) -> float:
        """Distance of the outermost wavelengths with half of the largest value, nm; to an end, where it has more."""
        nm = np.linspace(*self.span, max(round((self.nm[-1] - self.nm[0]) / (STEP / 25)), 1) + 1)
        return float(np.ptp(nm[self(nm) >= self.values.max() / 2]))

    @cached_property
    def _pieces(self) -> np.ndarray:
        """(4, N - 1) coefficients of the cubics, the highest power first."""
        from scipy.interpolate import PchipInterpolator

        pieces: np.ndarray = PchipInterpolator(self.nm, self.values).c
        return pieces


def constant(value: float = 1.0, kind: str = "transmittance") -> Curve:
    """The same value at every wavelength."""
    return Curve(np.array([1.0, 1e5]), np.array([value, value]), kind, f"{value:g}")


def grid(curves: Sequence[Any] = (), span: tuple[float, float] = VISIBLE) -> np.ndarray:
    """Wavelengths of integrals, nm: steps of STEP over a span, or over all that curves cover of it."""
    low = max([span[0], *(c.span[0] for c in curves)])
    high = min([span[1], *(c.span[1] for c in curves)])
    count = max(round((high - low) / STEP), 1)
    return low + STEP * np.arange(count + 1)
