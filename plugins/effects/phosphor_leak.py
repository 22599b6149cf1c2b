"""Phosphor leak: the blue light of a white LED's die that its phosphor lets through.

Definition
    S'(lambda) = (1 - l) S(lambda) + l A G(lambda)/B             l = `phosphor_leak`
with the area A of the spectrum S, the line G of the die (a Gaussian of `die_wavelength` and `die_width`) and its area
B, so that the power of all wavelengths is kept. A thin or old phosphor lets more through, a thick one less.
Fingerprint
    blue gains and the other channels lose their share, alike wherever the LED lights.
Validity
    one leak for all LEDs, the same in all directions: the rim of a white LED's lobe is yellow, which this is not. Bands
    that are read at their centres show it as far as one of them lies within the die's line. Of a blue LED it is its
    power.
References
    Schubert, Light-Emitting Diodes, 2nd ed., ch. 21.
"""

import math

from optics.polarization.mueller import exp
from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.line import relative
from optics.scene.parameter import Parameter


def leak(spectrum, nm, led):
    u = (nm - led.die_wavelength) / led.die_width
    die = exp(-4 * math.log(2) * u * u) / (math.sqrt(math.pi / (4 * math.log(2))) * led.die_width)
    return spectrum(nm) + led.phosphor_leak * (die * spectrum.area - spectrum(nm))


def check_power_is_kept():
    """A tenth of all light is then in the die's line; the area stays."""
    from types import SimpleNamespace

    import numpy as np

    led = SimpleNamespace(wavelength=560.0, fwhm=100.0, phosphor_leak=0.1, die_wavelength=450.0, die_width=20.0)
    nm = np.arange(100.0, 1100.0)
    base = relative(led)
    found = leak(base, nm, led)
    agree(found.sum(), base(nm).sum(), 1e-9)
    agree((found - 0.9 * base(nm)).sum(), 0.1 * base.area, 1e-9)


effect = Effect(
    name="phosphor leak",
    part="led",
    stages={"spectrum": leak},
    parameters=(
        Parameter(
            "phosphor_leak",
            "1",
            0.0,
            (-0.05, 0.9),
            "share l of the light in the die's line",
            neutral=0.0,
            plausible=0.02,
        ),
    ),
    shape=(
        Parameter("die_wavelength", "nm", 450.0, (360.0, 500.0), "peak of the die's line", plausible=5.0),
        Parameter("die_width", "nm", 20.0, (5.0, 60.0), "full width at half maximum of the die's line", plausible=3.0),
    ),
    acts=("channel", "led"),
    needs="white LEDs and several channels; to tell it from a tail or from stray light, a long-pass filter of "
    "500 nm before the LED, which takes the die's line away",
    checks=(check_power_is_kept,),
)
