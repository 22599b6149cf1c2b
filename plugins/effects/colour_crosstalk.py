"""Colour crosstalk: a channel sees a share of its neighbours' light.

Definition
    I'_c = (1 - (n - 1) x) I_c + x sum of the other channels      n channels
Causes are overlapping colour filters and charge that diffuses between the pixels of the mosaic.
Fingerprint
    colours move towards grey, by the same share everywhere. The effect is strong where LEDs of different colour light
    different flanks, and invisible where all channels agree (white LEDs on a grey membrane).
Validity
    one share for all pairs of channels; a full matrix belongs in the camera's `sensitivity`.
References
    ISO 17321-1; Hirakawa, IEEE ICIP 2008 (cross-talk explained).
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def mix(image, camera):
    n = image.shape[-1]
    return image * (1 - n * camera.crosstalk) + image.sum(-1, keepdims=True) * camera.crosstalk


def check_light_is_kept():
    """Pure red loses 2 x to green and blue; grey stays grey; at x = 1/3 every colour becomes grey."""
    red, grey = np.array([[[0.6, 0.0, 0.0]]]), np.full((1, 1, 3), 0.2)
    agree(mix(red, SimpleNamespace(crosstalk=0.1))[0, 0], [0.48, 0.06, 0.06])
    agree(mix(grey, SimpleNamespace(crosstalk=0.1)), grey)
    agree(mix(red, SimpleNamespace(crosstalk=1 / 3))[0, 0], [0.2, 0.2, 0.2], 1e-12, 1e-15)


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
    checks=(check_light_is_kept,),
)
