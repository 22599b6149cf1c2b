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
Measured curves, of the LED or of the pigment, are integrated by a Gauss rule of eight nodes.
Fingerprint
    markers shine in the colour of the emission, as bright as the ultraviolet at their place, at every angle of an
    analyser.
Validity
    LEDs of a known wavelength (a white LED excites nothing); opaque markers: no light passes, none is absorbed twice.
References
    Vi2TaP (RA-L 2025), II.B: Silc Pig pigment under UVC LEDs; Lakowicz, Principles of Fluorescence Spectroscopy, 3rd
    ed., ch. 1.
XML
    emission_spectrum string: measured power of the fluorescence over the wavelength, in place of the Gaussian of
        `emission_peak`: a file, a name or a law (see "Spectra" in the guide); relative
    excitation_spectrum string: measured absorptance over the wavelength, 0 to 1 and 0 beyond its ends, which
        `absorptance` scales, in place of the Gaussian of `absorption_peak`
"""

import math

from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.line import of_part
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
DARK = 1e-6  # share of a lamp's light whose absorption counts as none
NODES = 8  # of integrals over a lamp's spectrum


def build():
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    class Fluorescent(matt()):
        kind = "fluorescent"

        def __init__(self, props):
            super().__init__(props)
            self.read_spectrum(props, "emission_spectrum", "power")
            self.read_spectrum(props, "excitation_spectrum", "absorptance")

        def fluorescence(self, si, led, to_led, distance):
            """Radiance per nm that light of an LED excites, for a unit vector to it and its distance."""
            cos = dr.maximum(dr.dot(si.sh_frame.n, to_led), 0.0)
            return self.excited(si, led, led.kappa(si, to_led, distance) * cos)

        def excited(self, si, led, irradiance):
            """Radiance per nm that light of an LED's spectrum excites, by the irradiance in the middle of the
            spectrum."""
            absorbed, area = self.overlap(led)
            if self.integral is not None:  # the power of a light is that of all its wavelengths
                absorbed /= area
            absorbed = irradiance * absorbed
            if "spectrum" not in led.curves:
                absorbed = dr.select(led.wavelength > 0, absorbed, 0.0)
            left = getattr(self, "yield") * dr.exp(-self.bleaching * self.time)
            seen = mi.Frame3f.cos_theta(si.wi) > 0
            if self.lane is not None:
                return dr.select(seen, left * absorbed * self.lane / math.pi, 0.0)
            bands = self.nm(si.wavelengths)
            measured = self.curves.get("emission_spectrum")
            if measured is not None:
                return dr.select(seen, left * absorbed * measured(bands) / (photons_of(measured) * math.pi), 0.0)
            s = self.emission_fwhm / WIDTH
            photons = dr.exp(-dr.square((bands - self.emission_peak) / s) / 2) / (math.sqrt(2 * math.pi) * s)
            return dr.select(seen, left * absorbed * photons / (bands * math.pi), 0.0)

        def overlap(self, led):
            """int w a l dl of an LED with the peak 1, and the area of its spectrum, nm."""
            lamp, measured = led.curves.get("spectrum"), self.curves.get("excitation_spectrum")
            form = led.curves.get("line_shape")
            s1, s2 = led.fwhm / WIDTH, self.absorption_fwhm / WIDTH
            area = of_part(led, led).area
            if lamp is None and measured is None and form is None:
                square = dr.square(s1) + dr.square(s2)
                middle = (led.wavelength * dr.square(s2) + self.absorption_peak * dr.square(s1)) / square
                apart = dr.exp(-dr.square(led.wavelength - self.absorption_peak) / (2 * square))
                return self.absorptance * area * s2 / dr.sqrt(square) * apart * middle, area
            if form is not None:
                scale = led.fwhm / form.fwhm
                rule = [(led.wavelength + (x - form.peak) * scale, w * scale) for x, w in gauss_rule(form)]
            elif lamp is None:
                x, w = np.polynomial.hermite.hermgauss(NODES)
                rule = [(led.wavelength + math.sqrt(2) * s1 * x, math.sqrt(2) * s1 * w) for x, w in zip(x, w)]
            else:
                rule = gauss_rule(lamp)
            total = mi.Float(0.0)
            for nm, weight in rule:
                if measured is not None:
                    share = measured(mi.UnpolarizedSpectrum(nm))[0]
                else:
                    share = dr.exp(-dr.square((nm - self.absorption_peak) / s2) / 2)
                total += weight * share * nm
            return self.absorptance * total, area

        def excited_by(self, own, lamp):
            """Whether light of a measured spectrum excites it, at the numbers `own`; numpy."""
            nm = np.arange(lamp.span[0], lamp.span[1] + 0.5)
            measured, s = self.curves.get("excitation_spectrum"), own.absorption_fwhm / WIDTH
            share = np.exp(-(((nm - own.absorption_peak) / s) ** 2) / 2) if measured is None else measured(nm)
            return float((lamp(nm) * share).sum()) > DARK * float(lamp(nm).sum())

        def emission(self, own, nm):
            """Power per nm that is emitted, per photon, at wavelengths; numpy."""
            measured = self.curves.get("emission_spectrum")
            if measured is not None:
                return measured(nm) / photons_of(measured)
            s = own.emission_fwhm / WIDTH
            return np.exp(-(((nm - own.emission_peak) / s) ** 2) / 2) / (math.sqrt(2 * math.pi) * s * nm)

        def returned(self, nm):
            """Reflectance at wavelengths (Dr.Jit)."""
            return self.in_range(self.rho_r, self.rho_g, self.rho_b, nm)

        def brdf(self, si, wo, active=True):
            return self.rho(si) * dr.inv_pi

    return Fluorescent


def photons_of(curve):
    """int P(l) l dl of a measured power: photons, up to a constant."""
    import numpy as np

    nm = np.arange(curve.span[0], curve.span[1] + 0.25, 0.25)
    return float(np.trapezoid(curve(nm) * nm, nm))


def gauss_rule(lamp):
    """[(nm, weight)] of integrals over a measured spectrum of peak 1."""
    import numpy as np

    from optics.spectra.quadrature import gauss_nodes, lagrange

    nm = np.arange(lamp.span[0], lamp.span[1] + 0.25, 0.25)
    power = lamp(nm) / float(lamp.values.max()) * 0.25
    nodes = gauss_nodes(nm, power, NODES)
    return [(float(n), float(w)) for n, w in zip(nodes, lagrange(nodes, nm) @ power)]


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


def check_measured_curves():
    """Gaussians that are given as curves, of LED and pigment, shine as those that are given by their numbers."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    place = {"position": [0.0, 0.0, 10.0], "power": 100.0}
    line = {"wavelength": 365.0, "fwhm": 20.0}
    numbers = {"absorption_peak": 330.0, "absorption_fwhm": 90.0, "emission_peak": 520.0, "emission_fwhm": 60.0}
    nm = np.arange(150.0, 800.0, 2.0)
    taken, sent = (np.exp(-4 * math.log(2) * ((nm - p) / w) ** 2) for p, w in ((330.0, 90.0), (520.0, 60.0)))
    taken_text, sent_text = (
        ", ".join(f"{n:g}:{v:.9f}" for n, v in zip(nm, values)) for values in (taken, sent / nm * 520)
    )
    paints = [made("fluorescent", **numbers)]
    paints += [made("fluorescent", excitation_spectrum=taken_text, emission_spectrum=sent_text)]
    lamps = [made("led", **place, **line), made("led", **place, spectrum="gaussian(365, 20)")]
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.sh_frame, si.wi = mi.Frame3f(mi.Normal3f(0, 0, 1)), mi.Vector3f(0, 0, 1)
    si.wavelengths = type(si.wavelengths)(500.0, 520.0, 560.0, 600.0)
    found = [
        [float(lane[0]) for lane in paint.fluorescence(si, lamp, mi.Vector3f(0, 0, 1), mi.Float(10.0))]
        for paint in paints
        for lamp in lamps
    ]
    for other in found[1:]:
        agree(other, found[0], 1e-3)  # straight lines between points 2 nm apart


def random(rng):
    """A pigment that ultraviolet light excites."""
    return {
        "yield": rng.uniform(0.2, 0.9),
        "emission_peak": rng.uniform(450, 620),
        "emission_fwhm": rng.uniform(40, 100),
    }


part = Part("fluorescent", "bsdf", PARAMETERS, build, checks=(check_photons, check_measured_curves), random=random)
