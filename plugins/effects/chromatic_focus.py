"""Chromatic focus: the lens focuses each wavelength at a distance of its own.

Definition
    I'_b = I_b * G_b,  G_b a Gaussian of the variance c ((lambda_b - lambda_0)/100)^2      px^2 along each axis
with c = `chromatic_blur`, px^2 at 100 nm from the wavelength lambda_0 = `focus_wavelength` that is in focus. The focal
length of a simple lens changes in proportion to its index, df/f = -dn/(n - 1), which over the visible is nearly a line
in the wavelength; the blur's radius grows with the defocus and so its variance with the square. The strength is a
variance, so that the onset is linear.
Fingerprint
    rims are sharp in one colour and soft in another. Lens blur softens all colours alike.
Validity
    one blur over the field, alike in front of the focus and behind it. On sharp edges the onset is linear up to 1/16
    px^2 only; the ranking therefore tries a finite step as well. Halves of pixels are blurred: at rims that are
    narrower a strength was off by up to 0.2 % (three sets of 24 x 32 px), and by 1.4 % with whole pixels. In a single
    band nothing happens: that one colour is out of focus is lens blur, and so nearly is that of one narrow light.
References
    Born & Wolf, Principles of Optics, 4.7 (axial chromatic aberration) and 8.8 (defocus).
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.images import blurred
from optics.scene.parameter import Parameter


def defocus(image, camera):
    several = np.ptp(camera.bands) > 0
    away = np.where(several & (camera.bands > 0), (camera.bands - camera.focus_wavelength) / 100, 0.0)
    return blurred(image, camera.chromatic_blur * (camera.side * away) ** 2)


def check_variances():
    """A point keeps its light and spreads by c at 100 nm from the focus, by c/4 at 50 nm; in focus it stays. Blur of
    2 px and more, whose kernel does not ring."""
    point = np.zeros((61, 81, 3))
    point[30, 40] = 1.0
    camera = SimpleNamespace(bands=np.array([640.0, 540.0, 490.0]), focus_wavelength=540.0, chromatic_blur=16.0, side=1)
    spread = defocus(point, camera)
    away = np.arange(61)[:, None] - 30
    for band, variance in enumerate((16.0, 0.0, 4.0)):
        agree(spread[..., band].sum(), 1.0, 1e-9)  # but for tails beyond the borders
        # what the sampled kernel's tails leave at the borders, as of lens blur
        agree((away**2 * spread[..., band]).sum(), variance, 1e-3, 1e-9)
    camera.bands = camera.bands[:1]
    agree(defocus(point[..., :1], camera), point[..., :1], 1e-9, 1e-9)


effect = Effect(
    name="chromatic focus",
    part="camera",
    stages={"lens": defocus},
    onset="both",
    mixes_pixels=True,
    finer=True,
    parameters=(
        Parameter(
            "chromatic_blur",
            "px^2",
            0.0,
            (0.0, 400.0),
            "variance c of the blur at 100 nm from the focus",
            neutral=0.0,
            plausible=1.0,
            how="image",
        ),
    ),
    shape=(
        Parameter(
            "focus_wavelength",
            "nm",
            540.0,
            (300.0, 1100.0),
            "wavelength lambda_0 in focus",
            plausible=30.0,
            how="image",
        ),
    ),
    acts=("curvature", "rim", "channel"),
    needs="sharp edges in two colours as far apart as 470 and 625 nm",
    checks=(check_variances,),
)
