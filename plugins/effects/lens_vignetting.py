"""Lens vignetting: the image falls off towards the corners.

Definition
    I'(theta) = I(theta) cos(theta)^(4 v)
theta the angle between the ray and the optical axis, v the strength: 0 none, 1 the natural cos^4 law of a thin lens,
more with mechanical vignetting.
Fingerprint
    a smooth fall-off with the distance to the principal point, the same in every channel, LED and frame. A lobe
    exponent mu that is too large looks alike while all LEDs stand on one side; LEDs on all sides, or frames with one
    LED each, separate the two.
Validity
    rotational symmetry; no sharp edge of a lens mount.
References
    Born & Wolf, Principles of Optics, 4.8.1; Goldman, IEEE TPAMI 32, 2276 (2010).
"""

from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def fall_off(image, camera):
    return image * (1 + camera.tan[..., None] ** 2) ** (-2 * camera.vignetting)


effect = Effect(
    name="lens vignetting",
    part="camera",
    stages={"lens": fall_off},
    parameters=(
        Parameter(
            "vignetting",
            "1",
            0.0,
            (0.0, 20.0),
            "strength v; 1 is the natural cos^4 fall-off",
            neutral=0.0,
            plausible=0.5,
            how="image",
        ),
    ),
    acts=("radius",),
    needs="frames lit from different sides, one LED each",
)
