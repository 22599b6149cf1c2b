"""What a spectrum looks like: CIE XYZ and linear sRGB, without chromatic adaptation unless asked for."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from optics.errors import UnknownKey
from optics.spectra.curve import Curve
from optics.spectra.quadrature import widths

OBSERVER = "CIE 1931 2 Degree Standard Observer"


@lru_cache(maxsize=1)
def _observer() -> tuple[np.ndarray, np.ndarray]:
    import colour

    data = colour.MSDS_CMFS[OBSERVER]
    return np.asarray(data.wavelengths, float), np.asarray(data.values, float).T


def matching(nm: np.ndarray) -> np.ndarray:
    """(3, N) colour matching functions of the CIE 1931 observer, from the table in steps of 1 nm; 0 outside 360 to 830
    nm."""
    table_nm, table = _observer()
    return np.stack([np.interp(nm, table_nm, row, left=0.0, right=0.0) for row in table])


def xyz(light: Curve, path: Any = None, nm: np.ndarray | None = None) -> np.ndarray:
    """(3,) tristimulus values of a light, or of what a path f(nm) leaves of it, by sums in steps of 1 nm; the light
    itself has Y = 1."""
    nm = np.arange(360.0, 831.0) if nm is None else nm
    weights = matching(nm) * light(nm) * widths(nm)
    found: np.ndarray = weights @ (np.ones(len(nm)) if path is None else path(nm)) / weights[1].sum()
    return found


def linear_srgb(tristimulus: np.ndarray, adapt_from: np.ndarray | None = None) -> np.ndarray:
    """Linear sRGB (..., 3) of XYZ (..., 3), negative outside its gamut.

    adapt_from  XYZ (3,) of a white that is to look like D65, by the Bradford transform; None: no adaptation
    """
    import colour

    values = np.asarray(tristimulus, float)
    space = colour.RGB_COLOURSPACES["sRGB"]
    if adapt_from is not None:
        to = colour.xy_to_XYZ(space.whitepoint)
        matrix = colour.adaptation.matrix_chromatic_adaptation_VonKries(
            np.asarray(adapt_from) / adapt_from[1], to, transform="Bradford"
        )
        values = values @ matrix.T
    found: np.ndarray = values @ np.asarray(space.matrix_XYZ_to_RGB).T
    return found


def illuminant(name: str) -> np.ndarray:
    """XYZ (3,) with Y = 1 of a CIE illuminant; raises UnknownKey."""
    import colour

    known = colour.CCS_ILLUMINANTS[OBSERVER]
    if name not in known:
        raise UnknownKey(name, known, "illuminant")
    found: np.ndarray = np.asarray(colour.xy_to_XYZ(known[name]), float)
    return found
