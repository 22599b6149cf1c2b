"""LED width: the spectrum of an LED is wider or narrower than its data sheet says.

Definition
    S'(lambda) = S(c + (lambda - c)/(1 + g))/(1 + g)             g = `line_growth`, c the mean wavelength of S
so that the power of all wavelengths is kept. The width of a junction's line grows in proportion to the temperature at
least: by 1.8 kT in energy, 10 % for 30 K.
Fingerprint
    channels whose sensitivity only touches the line gain, that at the line's peak loses a little, alike wherever the
    LED lights; white LEDs do not change.
Validity
    the form stays; one growth for all LEDs. Of a Gaussian it is what its `fwhm` does. In bands that are read at their
    centres the power at the peak falls as 1/(1 + g), which the LED's power can undo.
References
    Schubert, Light-Emitting Diodes, 2nd ed., ch. 5.
"""

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.line import relative
from optics.scene.parameter import Parameter


def widen(spectrum, nm, led):
    growth = 1 + led.line_growth * spectrum.line
    return spectrum(spectrum.centre + (nm - spectrum.centre) / growth) / growth


def check_power_is_kept():
    """A line of 40 nm that grows by a quarter is one of 50 nm, 4/5 as high; its area stays."""
    from types import SimpleNamespace

    import numpy as np

    led, nm = SimpleNamespace(wavelength=530.0, fwhm=40.0, line_growth=0.25), np.arange(300.0, 760.0)
    found = widen(relative(led), nm, led)
    agree(found, 0.8 * relative(SimpleNamespace(wavelength=530.0, fwhm=50.0))(nm), 1e-9, 1e-30)
    agree(found.sum(), relative(led)(nm).sum(), 1e-9)


effect = Effect(
    name="LED width",
    part="led",
    stages={"spectrum": widen},
    parameters=(Parameter("line_growth", "1", 0.0, (-0.8, 5.0), "growth g of the width", neutral=0.0, plausible=0.1),),
    acts=("channel", "led"),
    needs="coloured LEDs, or a measured spectrum, and several channels; to tell it from a shift or a response, 10 nm "
    "band-pass filters on both flanks of a line",
    checks=(check_power_is_kept,),
)
