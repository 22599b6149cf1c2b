"""Camera gamma: the camera's tone curve is a power law.

Definition
    m' = m^(1 + g)                                               of the response m in units of full scale; below 0 as it
    is
g < 0 lifts the middle tones; 0 and full scale stay. Cameras that write images for viewing have 1/2.2 and hide it from
nobody; a photodiode's amplifier bends by a percent.
Fingerprint
    depends on the intensity of a pixel alone, and most in the dark, relatively: Malus' dark end is too bright or too
    dark, as by a leak, but by more at half the power. The residual response curve is symmetric about half scale; this
    is not.
Validity
    monotone; no toe, no shoulder.
References
    Mitsunaga & Nayar, CVPR 1999; F-TAC Hand supplementary information, S1.1.
"""

import numpy as np

from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def curve(image, camera):
    lit = np.real(image) > 1e-9
    m = np.where(lit, image, 1.0)
    return np.where(lit, m * np.exp(camera.gamma * np.log(m)), image)


effect = Effect(
    name="camera gamma",
    part="camera",
    stages={"response": curve},
    parameters=(
        Parameter("gamma", "1", 0.0, (-0.9, 4.0), "g: exponent less 1", neutral=0.0, plausible=0.02, how="image"),
    ),
    acts=("intensity",),
    needs="a wide range of intensities, or the same scene at two exposures",
)
