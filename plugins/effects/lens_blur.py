"""Lens blur: defocus and diffraction smear the image.

Definition
    I' = I * G,  G a Gaussian of variance V (px^2) along each axis
computed in the cosine transform, exp(-V (pi k/N)^2 / 2), which mirrors the image at its borders and is exact for any V,
also far below a pixel. The strength is the variance and not the width, so that its onset is linear; on sharp edges it
is straight only up to 1/16 px^2, so the ranking tries a finite step as well.
Fingerprint
    acts where the image is curved: shadow rims, the rim of the contact. LED size blurs shadow rims only, smoothing of
    the gel only the dent.
Validity
    the same blur over the whole field; wider tails than a Gaussian are glare or halo.
References
    Goodman, Introduction to Fourier Optics, ch. 6.
"""

import numpy as np

from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def smear(image, camera):
    from scipy.fft import dctn, idctn

    rows, columns = image.shape[:2]
    frequency2 = (np.pi * np.arange(rows) / rows)[:, None] ** 2 + (np.pi * np.arange(columns) / columns) ** 2
    transfer = np.exp(-camera.blur * frequency2 / 2)[..., None]
    return idctn(dctn(image, axes=(0, 1)) * transfer, axes=(0, 1))


effect = Effect(
    name="lens blur",
    part="camera",
    stages={"lens": smear},
    onset="both",
    mixes_pixels=True,
    parameters=(
        Parameter("blur", "px^2", 0.0, (0.0, 400.0), "variance V of the blur", neutral=0.0, plausible=1.0, how="image"),
    ),
    acts=("curvature", "rim"),
    needs="sharp edges: deep presses with shadows, small indenters",
)
