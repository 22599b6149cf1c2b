"""Dispersion: a clear material's refractive index depends on the wavelength.

Definition
    n(lambda) = index + dispersion ((540/lambda)^2 - 1)          Cauchy's law with one term
Fingerprint
    coloured fringes at edges of cells; red, green and blue see the walls in slightly different places.
Validity
    the visible; of printed resins 0.005 to 0.01 is expected. In mi.render all bands go the way of the first.
References
    Born & Wolf, Principles of Optics, 2.3.4.
"""

from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def disperse(n, wavelengths, clear):
    ratio = 540.0 / wavelengths
    return n + clear.dispersion * (ratio * ratio - 1)


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
        ),
    ),
    acts=("channel", "radius"),
    needs="images in two colours",
)
