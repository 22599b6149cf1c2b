"""Colour crosstalk: a channel sees a share of its neighbours' light.

Definition
    I'_c = (1 - (n - 1) x) I_c + x sum of the other channels      n channels
from overlapping colour filters and charge that wanders between the pixels of the mosaic.
Fingerprint
    colours move towards grey, by the same share everywhere. Strong where LEDs of different colour light different
    flanks, invisible where all channels agree (white LEDs on a grey membrane).
Validity
    one share for all pairs; a full matrix is a matter of the camera's `sensitivity`.
References
    ISO 17321-1; Hirakawa, IEEE ICIP 2008 (cross-talk explained).
"""

from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def mix(image, camera):
    n = image.shape[-1]
    return image * (1 - n * camera.crosstalk) + image.sum(-1, keepdims=True) * camera.crosstalk


effect = Effect(
    name="colour crosstalk",
    part="camera",
    stages={"sensor": mix},
    parameters=(
        Parameter(
            "crosstalk",
            "1",
            0.0,
            (0.0, 0.33),
            "share x from each other channel",
            neutral=0.0,
            plausible=0.03,
            how="image",
        ),
    ),
    acts=("channel",),
    needs="LEDs of different colours, or a coloured membrane",
)
