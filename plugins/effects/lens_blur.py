"""Lens blur: defocus and diffraction smear the image.

Definition
    I' = I * G,  G a Gaussian of variance V (px^2) along each axis
The convolution is computed in the cosine transform as a factor exp(-V (pi k/N)^2 / 2), which is exact for any V, also
far below a pixel. Beyond its borders the image goes on with the slope that it has there, as what lies outside sends
light in too. The strength is the variance rather than the width, so that the onset is linear. On sharp edges it is
linear only up to 1/16 px^2; the ranking therefore tries a finite step as well.
Fingerprint
    acts where the image is curved: at shadow rims and at the rim of the contact. LED size blurs shadow rims only,
    smoothing of the gel only the dent.
Validity
    the same blur over the whole field; wider tails than a Gaussian are glare or halo. Halves of pixels are blurred, and
    rims that are narrower are as wide as these.
References
    Goodman, Introduction to Fourier Optics, ch. 6.
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.images import blurred
from optics.scene.parameter import Parameter


def smear(image, camera):
    return blurred(image, camera.blur * camera.side**2)


def check_point_spread():
    """A point spreads by its variance, keeps its light, and variances add."""
    image = np.zeros((60, 80, 1))
    image[30, 40] = 1.0
    v, u = np.mgrid[:60, :80]
    for variance in (0.5, 2.0, 9.0):
        spread = smear(image, SimpleNamespace(blur=variance, side=1))
        agree(spread.sum(), 1.0, 1e-5)  # but for the ringing of its band limit beyond the borders
        assert spread.min() > -2e-3  # band-limited: below half a pixel of width it rings a little
        for axis, middle in ((v, 30), (u, 40)):
            # exp(-V w^2/2) has the second moment V; the sampled kernel has it but for what its tails leave at the
            # borders
            agree(((axis - middle) ** 2 * spread[..., 0]).sum(), variance, 1e-3)
    twice = smear(smear(image, SimpleNamespace(blur=1.5, side=1)), SimpleNamespace(blur=0.5, side=1))
    agree(twice, smear(image, SimpleNamespace(blur=2.0, side=1)), 0, 1e-6)  # as above


effect = Effect(
    name="lens blur",
    part="camera",
    stages={"lens": smear},
    onset="both",
    mixes_pixels=True,
    finer=True,
    parameters=(
        Parameter("blur", "px^2", 0.0, (0.0, 400.0), "variance V of the blur", neutral=0.0, plausible=1.0, how="image"),
    ),
    acts=("curvature", "rim"),
    needs="sharp edges: deep presses with shadows, small indenters",
    checks=(check_point_spread,),
)
