"""Residual response curve: the camera's response departs from the calibrated one.

Definition
    m' = m + r m (1 - m)
with the response m in units of full scale. r > 0 lifts the middle tones (a gamma below 1); 0 and full scale stay.
Fingerprint
    depends on the intensity of a pixel alone, whatever its cause. Within one exposure, powers and lobes of the LEDs
    absorb nearly all of it in a calibration; frames at another exposure or power reveal it.
Validity
    a smooth, monotone bend: |r| < 1. The sharp knee of a tone mapper is another effect.
References
    F-TAC Hand supplementary information, S1.1; Mitsunaga & Nayar, CVPR 1999.
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def bend(image, camera):
    return image + camera.response_bend * image * (1 - image)


def check_parabola():
    """The ends stay, the middle moves by r/4, and m and 1 - m move by the same amount: r/16 3 at 1/4 and 3/4."""
    found = bend(np.array([0.0, 0.25, 0.5, 0.75, 1.0]), SimpleNamespace(response_bend=0.2))
    agree(found, [0.0, 0.2875, 0.55, 0.7875, 1.0])


effect = Effect(
    name="residual response curve",
    part="camera",
    stages={"response": bend},
    parameters=(
        Parameter(
            "response_bend", "1", 0.0, (-0.95, 0.95), "bend r of the response", neutral=0.0, plausible=0.05, how="image"
        ),
    ),
    acts=("intensity",),
    needs="the same scene at two exposures or powers",
    checks=(check_parabola,),
)
