"""The spectrum of a light: a line, a measured curve, or white; and what effects make of it.

The same functions serve numpy, complex numbers among them, and Dr.Jit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from optics.polarization.mueller import exp, real, where
from optics.scene.parameter import Parameter

EDGES = (580.0, 500.0)  # nm: where the first band of shares and reflectances ends, and the second
WHITE = 470.0  # nm over which a white light spreads its power: 360 to 830
LINE = (  # what a light with a Gaussian spectrum declares
    Parameter(
        "wavelength",
        "nm",
        0.0,
        (0.0, 2000.0),
        "peak wavelength; 0: the same in every band",
        plausible=3.0,
        role="light wavelength",
    ),
    Parameter(
        "fwhm",
        "nm",
        30.0,
        (1.0, 1000.0),
        "full width at half maximum of the spectrum",
        plausible=5.0,
        role="light width",
    ),
)


@dataclass(frozen=True)
class Spectrum:
    """nm -> relative power of a light, 1 at the peak; what effects of the stage `spectrum` are given.

    power   the function
    centre  mean wavelength, nm; of a white light 595
    area    integral over the wavelength, nm
    line    1 for a light with a line or a curve, 0 for a white one, on which a shift and a width do nothing
    """

    power: Callable[[Any], Any]
    centre: Any
    area: Any
    line: Any

    def __call__(self, nm):
        return self.power(nm)


def relative(own, curve=None, form=None) -> Spectrum:
    """The spectrum of a curve; else a line about `own.wavelength`, as wide as `own.fwhm`; else 1 everywhere.

    form   the line's form, a curve (optics.spectra.curve) of which only peak and width are replaced; None: a Gaussian
    """
    if curve is not None:
        peak = float(curve.values.max())
        return Spectrum(lambda nm: curve(nm) / peak, curve.centre, curve.area / peak, 1.0)

    def line(nm):
        u = (nm - own.wavelength) / own.fwhm
        if form is None:
            return where(real(own.wavelength) > 0, exp(-4 * math.log(2) * u * u), 1.0 + 0.0 * u)
        return where(
            real(own.wavelength) > 0, form(form.peak + form.fwhm * u) / float(form.values.max()), 1.0 + 0.0 * u
        )

    coloured = real(own.wavelength) > 0
    zero = 0.0 * own.wavelength
    if form is None:
        width, centre = math.sqrt(math.pi / (4 * math.log(2))) * own.fwhm, own.wavelength
    else:
        width = form.area / float(form.values.max()) / form.fwhm * own.fwhm
        centre = own.wavelength + (form.centre - form.peak) / form.fwhm * own.fwhm
    return Spectrum(
        line,
        where(coloured, centre + zero, 595.0 + zero),
        where(coloured, width + zero, WHITE + zero),
        where(coloured, 1.0 + zero, zero),
    )


def of_part(part, own) -> Spectrum:
    """The spectrum of a light, at its numbers `own`, by the curves that it was given."""
    return relative(own, part.curves.get("spectrum"), part.curves.get("line_shape"))


def changed(base: Spectrum, functions: Sequence[Callable], own) -> Spectrum:
    """What effects of the stage `spectrum` make of a spectrum, one after the other. They keep its area."""
    for function in functions:
        base = Spectrum(_after(base, function, own), base.centre, base.area, base.line)
    return base


def _after(base: Spectrum, function: Callable, own) -> Callable[[Any], Any]:
    return lambda nm: function(base, nm, own)
