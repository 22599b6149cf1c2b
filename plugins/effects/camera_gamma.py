"""Camera gamma: the camera's tone curve is a power law.

Definition
    m' = m^(1 + g)               of the response m in units of full scale; values below 0 stay as they are
g < 0 lifts the middle tones; 0 and full scale stay. Cameras that write images for viewing use an exponent of about
1/2.2; the amplifier of a photodiode bends the curve by about a percent.
Fingerprint
    depends on the intensity of a pixel alone. The relative change is largest in the dark: the dark end of Malus' curve
    is too bright or too dark, as by a leak, but by more at half the power. The residual response curve is symmetric
    about half of full scale; a gamma is not.
Validity
    monotone; no toe, no shoulder.
References
    Mitsunaga & Nayar, CVPR 1999; F-TAC Hand supplementary information, S1.1.
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def curve(image, camera):
    lit = np.real(image) > 1e-9
    m = np.where(lit, image, 1.0)
    return np.where(lit, m * np.exp(camera.gamma * np.log(m)), image)


def check_powers():
    """sqrt at g = -1/2 and the square at g = 1; 0, full scale and values below 0 stay."""
    m = np.array([-0.01, 0.0, 0.04, 0.25, 1.0])
    agree(curve(m, SimpleNamespace(gamma=-0.5)), [-0.01, 0.0, 0.2, 0.5, 1.0])
    agree(curve(m, SimpleNamespace(gamma=1.0)), [-0.01, 0.0, 0.0016, 0.0625, 1.0])


effect = Effect(
    name="camera gamma",
    part="camera",
    stages={"response": curve},
    parameters=(
        Parameter("gamma", "1", 0.0, (-0.9, 4.0), "g: exponent less 1", neutral=0.0, plausible=0.02, how="image"),
    ),
    acts=("intensity",),
    needs="a wide range of intensities, or the same scene at two exposures",
    checks=(check_powers,),
)
