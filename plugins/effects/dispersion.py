"""Dispersion: a clear material's refractive index depends on the wavelength.

Definition
    n(lambda) = index + dispersion ((540/lambda)^2 - 1)          Cauchy's law with one term
Fingerprint
    coloured fringes at edges of cells; red, green and blue see the walls in slightly different places.
Validity
    the visible; 0.005 to 0.01 is expected of printed resins. In mi.render all bands follow the path of the first.
References
    Born & Wolf, Principles of Optics, 2.3.4.
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def disperse(n, wavelengths, clear):
    ratio = 540.0 / wavelengths
    return n + clear.dispersion * (ratio * ratio - 1)


def check_abbe_number():
    """BK7 by Cauchy's A = 1.5046, B = 0.00420 um^2: n at the lines C, d, F (656.3, 587.6, 486.1 nm), and the Abbe
    number (n_d - 1)/(n_F - n_C) = 64.4 of these coefficients."""
    a, b = 1.5046, 0.00420
    dispersion = b / 0.54**2  # in units of the index at 540 nm
    lines = np.array([656.3, 587.6, 486.1])
    c, d, f = disperse(a + dispersion, lines, SimpleNamespace(dispersion=dispersion))
    agree([c, d, f], [1.51435, 1.51676, 1.52237], 0, 1e-5)
    agree((d - 1) / (f - c), 64.4, 0, 0.2)


def random(rng):
    """Positive, as of every clear polymer in the visible."""
    return {"dispersion": rng.uniform(0, 0.02)}


effect = Effect(
    name="dispersion",
    part="clear",
    stages={"index": disperse},
    per="part",
    parameters=(
        Parameter(
            "dispersion",
            "1",
            0.0,
            (-0.1, 0.1),
            "dispersion of the index",
            neutral=0.0,
            plausible=0.005,
            how="difference",
            step=1.0,
        ),
    ),
    acts=("channel", "radius"),
    needs="images in two colours as far apart as 460 and 620 nm",
    checks=(check_abbe_number,),
    random=random,
)
