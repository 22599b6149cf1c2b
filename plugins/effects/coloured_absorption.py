"""Coloured absorption: a clear material absorbs some colours more than others.

Definition
    alpha(lambda) = absorption exp(absorption_slope (lambda - 540)/100)
Fingerprint
    the colour of the image shifts with the length of the path through the material: printed resins turn yellow.
Validity
    an exponential over the bands; no effect where nothing is absorbed.
References
    Fan, Li, Cong & Zhang, MagicGripper, supplementary VII-A, eq. (27), for one wavelength.
"""

from types import SimpleNamespace

import numpy as np

from optics.polarization.mueller import exp
from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def fade(alpha, wavelengths, clear):
    return alpha * exp(clear.absorption_slope * (wavelengths - 540.0) / 100)


def check_doubling():
    """A slope of -ln 2 per 100 nm: 440 nm is absorbed twice as well as 540 nm, and 640 nm half as well."""
    found = fade(0.1, np.array([640.0, 540.0, 440.0]), SimpleNamespace(absorption_slope=-0.6931471806))
    agree(found, [0.05, 0.1, 0.2], 1e-9)


effect = Effect(
    name="coloured absorption",
    part="clear",
    stages={"absorption": fade},
    per="part",
    parameters=(
        Parameter(
            "absorption_slope",
            "1",
            0.0,
            (-10.0, 10.0),
            "change of ln(alpha) per 100 nm",
            neutral=0.0,
            plausible=0.2,
            how="path",
        ),
    ),
    acts=("channel", "led_distance"),
    needs="LEDs of two colours at the same side",
    checks=(check_doubling,),
)
