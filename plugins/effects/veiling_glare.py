"""Veiling glare: the lens spreads a share of the light evenly over the image.

Definition
    I'(x) = (1 - g) I(x) + g mean(I)
with the glare fraction g of the light that lenses, filter and cover scatter out of its way.
Fingerprint
    shadows lift, highlights drop; the offset is the same everywhere in a frame and follows the frame's total light.
    Ambient light looks alike but does not follow the LEDs: frames of different exposure or a dark frame separate the
    two. A black level that is wrong by half a DN is taken for glare.
Validity
    scatter much wider than the image; a halo around bright spots is another effect.
References
    ISO 9358:1994, veiling glare of image forming systems.
"""

from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def spread(image, camera):
    return (1 - camera.glare) * image + camera.glare * image.mean((0, 1), keepdims=True)


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
)
