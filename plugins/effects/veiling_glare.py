"""Veiling glare: the lens spreads a share of the light evenly over the image.

Definition
    I'(x) = (1 - g) I(x) + g mean(I)
with the glare fraction g: the share of the light that lenses, filter and cover scatter over the whole image.
Fingerprint
    shadows become brighter and highlights darker. The offset is the same everywhere in a frame and is proportional to
    the frame's total light. Ambient light looks alike but does not depend on the LEDs: frames of different exposure, or
    a dark frame, separate the two. A black level that is wrong by half a DN is taken for glare.
Validity
    scatter much wider than the image; a halo around bright spots is another effect.
References
    ISO 9358:1994, veiling glare of image forming systems.
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def spread(image, camera):
    return (1 - camera.glare) * image + camera.glare * image.mean((0, 1), keepdims=True)


def check_light_is_kept():
    """Of a black and white image a share of the mean, 1/2, reaches the black pixels; the total light stays."""
    image = np.zeros((4, 6, 3))
    image[:, :3] = 1.0
    found = spread(image, SimpleNamespace(glare=0.3))
    agree(found[:, 3:], np.full((4, 3, 3), 0.15))
    agree(found[:, :3], np.full((4, 3, 3), 0.85))
    agree(found.mean((0, 1)), [0.5] * 3)


effect = Effect(
    name="veiling glare",
    part="camera",
    stages={"lens": spread},
    mixes_pixels=True,
    parameters=(
        Parameter("glare", "1", 0.0, (0.0, 1.0), "glare fraction g", neutral=0.0, plausible=0.02, how="image"),
    ),
    acts=("intensity", "frame"),
    needs="deep shadows, and frames of different total light",
    checks=(check_light_is_kept,),
)
