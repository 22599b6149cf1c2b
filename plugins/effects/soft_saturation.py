"""Soft saturation: a detector or its amplifier levels off below the end of the scale.

Definition
    m' = m/(1 + s m^8)^(1/8)
of the response m in units of full scale: a straight line that levels off at s^(-1/8) of full scale, with a knee at
about four fifths of it.
Fingerprint
    bright ends alone are flattened, by -s m^9/8 at first: the maxima of Malus' curve are blunt while its flanks and its
    dark end stay. A bend over the whole scale (a residual response curve, a compression m/(1 + s m)) changes the middle
    tones as well.
Validity
    one knee, the same in every channel. Values at the hard end of the scale are masked, by [noise] saturation.
References
    EMVA Standard 1288, release 4.0 (2021), linearity; Mitsunaga & Nayar, CVPR 1999.
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def level_off(image, camera):
    square = image * image
    eighth = square * square
    return image * (1 + camera.soft_saturation * eighth * eighth) ** -0.125


def check_a_line_with_a_ceiling():
    """At s = 2^8 a ceiling of 1/2: 0.2 is lowered by 8e-5 of itself, 10 becomes 1/2, 1/2 becomes 1/2 2^(-1/8)."""
    found = level_off(np.array([0.0, 0.2, 0.5, 10.0]), SimpleNamespace(soft_saturation=256.0))
    agree(found, [0.0, 0.2 * (1 + 0.4**8) ** -0.125, 0.5 * 2**-0.125, 0.5], 1e-9)
    agree(found[1], 0.2, 1e-4)


def random(rng):
    """A ceiling between 1.2 and 0.7 of full scale."""
    return {"soft_saturation": rng.uniform(0.7, 1.2) ** -8}


effect = Effect(
    name="soft saturation",
    part="camera",
    stages={"response": level_off},
    parameters=(
        Parameter(
            "soft_saturation",
            "1",
            0.0,
            (0.0, 1e4),
            "s: the response levels off at s^(-1/8) of full scale",
            neutral=0.0,
            plausible=0.5,
            how="image",
        ),
    ),
    acts=("intensity",),
    needs="readings up to the bright end of the scale, at two powers or exposures",
    checks=(check_a_line_with_a_ceiling,),
    random=random,
)
