"""Inner filter: dye in the gel absorbs the excitation on its way to the beads, and some of their light on the way back.

Definition
    L' = L exp(-a(lambda_led) d_light - a(lambda) d_view)        Beer-Lambert, each way at its own wavelength
    a(lambda) = dye exp(-4 ln 2 ((lambda - dye_peak)/dye_fwhm)^2)
with the lengths d of both ways inside the gel, -thickness < z < 0, the peak lambda_led of the LED's spectrum (of a
white LED, whose `wavelength` is 0, the band) and the band lambda. Fluorescence comes to the camera at another
wavelength than the one that made it: what dims its way in need not dim its way out.
Fingerprint
    beads fade with their distance from the LEDs and with the depth of gel above the rays, in the colour of the
    emission, where that colour itself is not absorbed. Gel absorption takes all bands alike, and both ways.
Validity
    dye that is dissolved in the gel evenly and shines itself so little that nothing is seen; LEDs that are narrow
    against the absorption.
References
    Lakowicz, Principles of Fluorescence Spectroscopy, 3rd ed., 2.5 (inner filter effects); Bouguer-Lambert-Beer law.
"""

import math
from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def coefficient(wavelength, gel):
    import drjit as dr

    return gel.dye * dr.exp(-4 * math.log(2) * dr.square((wavelength - gel.dye_peak) / gel.dye_fwhm))


def filtered(path, gel):
    import drjit as dr
    import mitsuba as mi

    band = mi.UnpolarizedSpectrum(path.wavelengths) if mi.is_spectral else mi.UnpolarizedSpectrum(gel.band or 540.0)
    seen = coefficient(band, gel)
    excited = seen
    if path.led is not None:
        excited = dr.select(path.led.wavelength > 0, coefficient(path.led.wavelength, gel), seen)
    return dr.exp(-excited * path.light - seen * path.view)


def check_two_ways():
    """Blue light of 465 nm is halved in ln 2/a = 6.93 mm on its way in; green light, 120 nm and so two widths from the
    peak, passes all but whole on its way out: exp(-16 ln 2) of the coefficient."""
    import mitsuba as mi

    gel = SimpleNamespace(dye=0.1, dye_peak=465.0, dye_fwhm=60.0, band=585.0)
    bands = mi.UnpolarizedSpectrum(585.0) if mi.is_spectral else mi.Color0f()
    for light, view, left in ((6.931471806, 0.0, 0.5), (0.0, 6.931471806, 1.0)):
        path = SimpleNamespace(
            light=mi.Float(light),
            view=mi.Float(view),
            led=SimpleNamespace(wavelength=mi.Float(465.0)),
            wavelengths=bands,
        )
        agree(np.array(filtered(path, gel)).ravel(), left, 2e-5)  # 0.5^(2^-16) = 1 - 1.06e-5


effect = Effect(
    name="inner filter",
    part="elastic_skin",
    stages={"segment": filtered},
    parameters=(
        Parameter("dye", "1/mm", 0.0, (0.0, 10.0), "absorption coefficient at the peak", neutral=0.0, plausible=0.02),
    ),
    shape=(
        Parameter("dye_peak", "nm", 465.0, (200.0, 2000.0), "wavelength absorbed best", plausible=10.0),
        Parameter("dye_fwhm", "nm", 60.0, (1.0, 1000.0), "full width at half maximum", plausible=10.0),
    ),
    acts=("led_distance", "gel_path", "channel"),
    needs="LEDs of another colour than the beads' light, lit one by one",
    checks=(check_two_ways,),
)
