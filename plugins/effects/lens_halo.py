"""Lens halo: the lens scatters a share of the light by a little, into a halo around what is bright.

Definition
    I'(x) = (1 - n - f) I(x) + n (I * G_near)(x) + f (I * G_far)(x)
with Gaussians G of a standard deviation of 2 % and 6 % of the image's diagonal, and the shares n and f of the light in
either. The tails of a lens's point spread (roughness and dust of its surfaces, a diffusing cover, light that returns
between sensor and filter) are as wide as the lens makes them; a halo of a width between the two is their mixture to
8 % of it (rms, for an image whose spectrum falls as 1/f). Beyond its borders the image goes on with the slope that it
has there.
Fingerprint
    dark places beside bright ones become brighter, dark frames and the middle of wide dark areas do not. Lens blur acts
    within a pixel or two of a rim, veiling glare alike in the whole image. Haze of the gel makes a halo too, but its
    light comes from where the beams of the LEDs pass, whatever the face shows.
Validity
    one halo over the whole field and for all colours.
References
    McCann & Rizzi, The Art and Science of HDR Imaging, Wiley 2012 (glare); ISO 9358:1994.
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.images import blurred
from optics.scene.parameter import Parameter

NEAR, FAR = 0.02, 0.06  # standard deviations, of the image's diagonal


def scatter(image, camera):
    diagonal = np.hypot(*image.shape[:2])
    near, far = (blurred(image, (width * diagonal) ** 2) - image for width in (NEAR, FAR))
    return image + camera.halo_near * near + camera.halo_far * far


def check_variances():
    """A point keeps its light, and the second moment of what it becomes is n V_near + f V_far."""
    image = np.zeros((121, 161, 1))
    image[60, 80] = 1.0
    v, u = np.mgrid[:121, :161]
    diagonal2 = 121**2 + 161**2
    for near, far in ((0.05, 0.0), (0.0, 0.05), (0.1, 0.02)):
        found = scatter(image, SimpleNamespace(halo_near=near, halo_far=far))[..., 0]
        agree(found.sum(), 1.0, 1e-4)  # of 2 to 5 % in the halo, what its tails leave at the borders
        for away in (u - 80, v - 60):
            agree((away**2 * found).sum(), (near * NEAR**2 + far * FAR**2) * diagonal2, 2e-3)  # as above


def check_even_light_stays():
    """An even image and an even slope stay as they are, up to the borders."""
    v, u = np.mgrid[:24, :32]
    image = (5.0 + 0.02 * u - 0.03 * v)[..., None]
    agree(scatter(image, SimpleNamespace(halo_near=0.1, halo_far=0.1)), image, 1e-7)  # the kernels end at six sd


effect = Effect(
    name="lens halo",
    part="camera",
    stages={"lens": scatter},
    mixes_pixels=True,
    parameters=(
        Parameter(
            "halo_near",
            "1",
            0.0,
            (0.0, 1.0),
            "share n of the light in the near halo",
            neutral=0.0,
            plausible=0.03,
            how="image",
        ),
        Parameter(
            "halo_far",
            "1",
            0.0,
            (0.0, 1.0),
            "share f of the light in the far halo",
            neutral=0.0,
            plausible=0.03,
            how="image",
        ),
    ),
    acts=("intensity", "curvature"),
    needs="bright places beside dark ones: deep presses with shadows",
    checks=(check_variances, check_even_light_stays),
)
