"""LED centre shift: the spectrum of an LED stands at another wavelength than its data sheet says.

Definition
    S'(lambda) = S(lambda - d)                                   d = `centre_shift` in nm
Junctions emit at longer waves when they are warm: red AlInGaP LEDs by 0.1 to 0.2 nm/K, blue and green InGaN ones by
0.03 to 0.1 nm/K. Green and blue LEDs emit at shorter waves with more current, by up to 10 nm over the range of a data
sheet.
Fingerprint
    the channels on the flanks of whose sensitivity the LED stands change against the others, alike wherever that LED
    lights; white LEDs do not change. In bands that are read at their centres it is a change of the LED's power in each
    band.
Validity
    the form of the spectrum stays; one shift for all LEDs. Of a Gaussian it is what its `wavelength` does. Channels as
    integrals (bands "auto") give its true size; what a pigment absorbs is not shifted.
References
    Schubert, Light-Emitting Diodes, 2nd ed., ch. 4 and 6; CIE 127:2007.
"""

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.line import relative
from optics.scene.parameter import Parameter


def shift(spectrum, nm, led):
    return spectrum(nm - led.centre_shift * spectrum.line)


def check_shifted_line():
    """The peak stands at 533 nm, half of it at half the width beside; white light is white."""
    from types import SimpleNamespace

    import numpy as np

    led = SimpleNamespace(wavelength=530.0, fwhm=40.0, centre_shift=3.0)
    agree(shift(relative(led), np.array([533.0, 553.0, 513.0]), led), [1.0, 0.5, 0.5])
    white = SimpleNamespace(wavelength=0.0, fwhm=40.0, centre_shift=3.0)
    agree(shift(relative(white), np.array([450.0, 650.0]), white), [1.0, 1.0])


effect = Effect(
    name="LED centre shift",
    part="led",
    stages={"spectrum": shift},
    parameters=(
        Parameter("centre_shift", "nm", 0.0, (-50.0, 50.0), "shift d of the spectrum", neutral=0.0, plausible=1.0),
    ),
    acts=("channel", "led"),
    needs="coloured LEDs, or a measured spectrum, and several channels; to tell it from a paint or a width, a "
    "second LED within 30 nm of the first, or a 10 nm band-pass filter on one flank of its line",
    checks=(check_shifted_line,),
)
