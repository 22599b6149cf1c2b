"""Lens vignetting: the image falls off towards the corners.

Definition
    I'(theta) = I(theta) cos(theta)^(4 v)
theta is the angle between the ray and the optical axis, v the strength: 0 for none, 1 for the natural cos^4 law of a
thin lens, more with mechanical vignetting.
Fingerprint
    a smooth fall-off with the distance from the principal point, the same in every channel, LED and frame. A lobe
    exponent mu that is too large looks alike while all LEDs are on one side; LEDs on all sides, or frames with one LED
    each, separate the two.
Validity
    rotational symmetry; no sharp edge of a lens mount.
References
    Born & Wolf, Principles of Optics, 4.8.1; Goldman, IEEE TPAMI 32, 2276 (2010).
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def fall_off(image, camera):
    return image * (1 + camera.tan[..., None] ** 2) ** (-2 * camera.vignetting)


def check_cosine_law():
    """cos^4 at v = 1 and cos^10 at v = 2.5, at 0, 30 and 60 degrees off the axis: cos = 1, sqrt(3)/2, 1/2."""
    tan, image = np.tan(np.radians([[0.0, 30.0, 60.0]])), np.full((1, 3, 3), 0.5)
    for v, expected in ((1.0, [1, 9 / 16, 1 / 16]), (2.5, [1, (3 / 4) ** 5, 2.0**-10])):
        found = fall_off(image, SimpleNamespace(tan=tan, vignetting=v))
        agree(found[0], 0.5 * np.array(expected)[:, None] * np.ones(3))


effect = Effect(
    name="lens vignetting",
    part="camera",
    stages={"lens": fall_off},
    parameters=(
        Parameter(
            "vignetting",
            "1",
            0.0,
            (0.0, 200.0),
            "strength v; 1 is the natural cos^4 fall-off",
            neutral=0.0,
            plausible=0.5,
            how="image",
        ),
    ),
    acts=("radius",),
    needs="frames lit from different sides, one LED each",
    checks=(check_cosine_law,),
)
