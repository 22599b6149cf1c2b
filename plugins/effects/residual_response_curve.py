"""Residual response curve: the camera's response departs from the calibrated one.

Definition
    m' = m + r m (1 - m)
with the response m in units of full scale; r > 0 lifts the middle tones (a gamma below 1), 0 and full scale stay.
Fingerprint
    depends on the intensity of a pixel alone, whatever made it. Calibration of powers and lobes absorbs nearly all of
    it within one exposure; frames at another exposure or power bring it out.
Validity
    a smooth, monotone bend: |r| < 1; sharp knees of a tone mapper are not this.
References
    F-TAC Hand supplementary information, S1.1; Mitsunaga & Nayar, CVPR 1999.
"""

from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def bend(image, camera):
    return image + camera.response_bend * image * (1 - image)


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
)
