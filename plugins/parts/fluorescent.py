"""Fluorescent pigment: a matt surface that turns ultraviolet light into visible light.

Definition
    E_abs = int kappa cos(theta) w(l) a(l) l dl                  absorbed light of an LED, as a number of photons
    L(lambda) = yield E_abs f(lambda)/(pi lambda)                radiance of the fluorescence, Lambertian, unpolarized
        exp(-bleaching time)                                     less, the longer it was lit; `time`: of the frame
    f_r = rho/pi                                                 and what is reflected
with kappa and the spectrum w of the LED (S2), the absorptance a (a Gaussian of peak `absorptance` at
`absorption_peak`), the quantum `yield`, and the emission's photon spectrum f (a Gaussian of unit area at
`emission_peak`). Both w and a are Gaussians, whose product has a closed form: with their widths s1, s2, S^2 = s1^2 +
s2^2 and the peaks l1, l2
    int w a l dl = absorptance sqrt(2 pi) s1 s2/S exp(-(l1 - l2)^2/(2 S^2)) (l1 s2^2 + l2 s1^2)/S^2
Fingerprint
    markers shine in the colour of the emission, as bright as the ultraviolet at their place, at every angle of an
    analyser.
Validity
    LEDs of a known wavelength (a white LED excites nothing); opaque markers: no light passes, none is absorbed twice.
References
    Vi2TaP (RA-L 2025), II.B: Silc Pig pigment under UVC LEDs; Lakowicz, Principles of Fluorescence Spectroscopy, 3rd
    ed., ch. 1.
"""

import math

from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.parameter import Parameter
from optics.scene.surfaces import matt

PARAMETERS = (
    Parameter("yield", "1", 0.5, (0.0, 1.0), "photons out per photon absorbed", plausible=0.1, linear=True),
    Parameter(
        "absorptance", "1", 0.9, (0.0, 1.0), "share of the light absorbed at the peak", plausible=0.1, linear=True
    ),
    Parameter("absorption_peak", "nm", 300.0, (100.0, 1000.0), "wavelength absorbed best", plausible=10.0),
    Parameter("absorption_fwhm", "nm", 120.0, (1.0, 1000.0), "full width at half maximum", plausible=10.0),
    Parameter("emission_peak", "nm", 525.0, (200.0, 2000.0), "wavelength emitted most", plausible=5.0),
    Parameter("emission_fwhm", "nm", 70.0, (1.0, 1000.0), "full width at half maximum", plausible=5.0),
    Parameter(
        "bleaching",
        "1",
        0.0,
        (0.0, 1e3),
        "rate at which the fluorescence falls, per unit of time",
        neutral=0.0,
        plausible=0.02,
        through="time",
    ),
    Parameter(
        "time",
        "1",
        0.0,
        (-1e6, 1e6),
        "the clock: minutes, or any unit that `bleaching` is meant in",
        role="clock",
        plausible=1.0,
    ),
    *(
        Parameter(
            f"rho_{c}", "1", 0.3, (0.0, 10.0), f"reflectance in the {word} band ({colour})", plausible=0.1, linear=True
        )
        for c, word, colour in (("r", "first", "red"), ("g", "second", "green"), ("b", "third", "blue"))
    ),
)
WIDTH = 2 * math.sqrt(2 * math.log(2))  # fwhm over standard deviation


def build():
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    class Fluorescent(matt()):
        kind = "fluorescent"

        def fluorescence(self, si, led, to_led, distance):
            """Radiance per nm that light of an LED excites, for a unit vector to it and its distance."""
            cos = dr.maximum(dr.dot(si.sh_frame.n, to_led), 0.0)
            return self.excited(si, led, led.kappa(si, to_led, distance) * cos)

        def excited(self, si, led, irradiance):
            """Radiance per nm that light of an LED's spectrum excites, by the irradiance in the middle of the
            spectrum."""
            s1, s2 = led.fwhm / WIDTH, self.absorption_fwhm / WIDTH
            square = dr.square(s1) + dr.square(s2)
            middle = (led.wavelength * dr.square(s2) + self.absorption_peak * dr.square(s1)) / square
            overlap = (
                self.absorptance
                * math.sqrt(2 * math.pi)
                * s1
                * s2
                / dr.sqrt(square)
                * dr.exp(-dr.square(led.wavelength - self.absorption_peak) / (2 * square))
                * middle
            )
            if self.integral is not None:  # the power of a light is that of all its wavelengths
                overlap /= math.sqrt(2 * math.pi) * s1
            absorbed = dr.select(led.wavelength > 0, irradiance * overlap, 0.0)
            bands = self.nm(si.wavelengths)
            s = self.emission_fwhm / WIDTH
            photons = dr.exp(-dr.square((bands - self.emission_peak) / s) / 2) / (math.sqrt(2 * math.pi) * s)
            seen = mi.Frame3f.cos_theta(si.wi) > 0
            left = getattr(self, "yield") * dr.exp(-self.bleaching * self.time)
            if self.lane is not None:
                return dr.select(seen, left * absorbed * self.lane / math.pi, 0.0)
            return dr.select(seen, left * absorbed * photons / (bands * math.pi), 0.0)

        def emission(self, own, nm):
            """Power per nm that is emitted, per photon, at wavelengths; numpy."""
            s = own.emission_fwhm / WIDTH
            return np.exp(-(((nm - own.emission_peak) / s) ** 2) / 2) / (math.sqrt(2 * math.pi) * s * nm)

        def returned(self, nm):
            """Reflectance at wavelengths (Dr.Jit)."""
            return self.in_range(self.rho_r, self.rho_g, self.rho_b, nm)

        def brdf(self, si, wo, active=True):
            return self.rho(si) * dr.inv_pi

    return Fluorescent


def check_photons():
    """The radiance over all wavelengths, as photons: yield/pi times the photons absorbed, summed over the spectra."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    paint = made("fluorescent", **{"yield": 0.4, "absorptance": 0.8, "absorption_peak": 330.0, "absorption_fwhm": 90.0})
    led = made("led", position=[0.0, 0.0, 10.0], power=100.0, wavelength=365.0, fwhm=20.0)
    nm = np.linspace(100, 900, 4001)
    spectrum, taken = (np.exp(-4 * math.log(2) * ((nm - p) / w) ** 2) for p, w in ((365.0, 20.0), (330.0, 90.0)))
    absorbed = 0.8 * (spectrum * taken * nm).sum() * 0.2
    si = dr.zeros(mi.SurfaceInteraction3f, nm.size)
    si.sh_frame, si.wi = mi.Frame3f(mi.Normal3f(0, 0, 1)), mi.Vector3f(0, 0, 1)
    si.wavelengths = type(si.wavelengths)(mi.Float(nm.astype("f")))
    found = np.array(paint.fluorescence(si, led, mi.Vector3f(0, 0, 1), mi.Float(10.0)))[0]
    agree((found * nm).sum() * 0.2, 0.4 / math.pi * absorbed, 1e-4)  # power/d^2 = 1


def random(rng):
    """A pigment that ultraviolet light excites."""
    return {
        "yield": rng.uniform(0.2, 0.9),
        "emission_peak": rng.uniform(450, 620),
        "emission_fwhm": rng.uniform(40, 100),
    }


part = Part("fluorescent", "bsdf", PARAMETERS, build, checks=(check_photons,), random=random)
