"""The spectrum of a light: a Gaussian line, a measured curve, or white; and what effects make of it.

The same functions serve numpy, complex numbers among them, and Dr.Jit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from optics.polarization.mueller import exp, real, where

EDGES = (580.0, 500.0)  # nm: where the first band of shares and reflectances ends, and the second
WHITE = 470.0  # nm over which a white light spreads its power: 360 to 830


def relative(own, curve=None) -> Callable[[Any], Any]:
    """nm -> relative power, 1 at the peak: of a curve, else a Gaussian about `own.wavelength`, else 1 everywhere."""
    if curve is not None:
        peak = float(curve.values.max())
        return lambda nm: curve(nm) / peak

    def line(nm):
        u = (nm - own.wavelength) / own.fwhm
        return where(real(own.wavelength) > 0, exp(-4 * math.log(2) * u * u), 1.0 + 0.0 * u)

    return line


def area(own, curve=None):
    """Integral of `relative` over the wavelength, nm."""
    if curve is not None:
        return curve.area / float(curve.values.max())
    width = math.sqrt(math.pi / (4 * math.log(2))) * own.fwhm
    return where(real(own.wavelength) > 0, width, WHITE + 0.0 * width)


def centre(own, curve=None):
    """Mean wavelength, nm; of a white light 595."""
    return curve.centre if curve is not None else where(real(own.wavelength) > 0, own.wavelength, 595.0)


def changed(base: Callable[[Any], Any], functions: Sequence[Callable], own) -> Callable[[Any], Any]:
    """nm -> what effects of the stage `spectrum` make of a spectrum, one after the other."""
    for function in functions:
        base = _after(base, function, own)
    return base


def _after(base: Callable, function: Callable, own) -> Callable[[Any], Any]:
    return lambda nm: function(base, nm, own)
