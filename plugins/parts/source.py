"""Source: a luminous area that a camera or a photodiode looks at: a lamp behind a diffuser, a screen.

Definition
    S = L (1, q, u, 0)                    Stokes vector, the same in all directions
    L = power power_c w(lambda) (1 + drift g(time)),  g(t) = (1 - exp(-settling t))/settling, or t where settling is 0
with the power (radiance, relative), the shares of the first three bands, the spectrum w of an LED (a Gaussian; 1 in
every band when `wavelength` is 0), and the linear polarization q = `dop_q` = p cos(2a), u = `dop_u` = p sin(2a) of the
degree p along the angle a, from the surface's x axis to its y axis. `time` is the experimenter's clock, a setting of a
frame or a reading.
Fingerprint
    power scales a reading; polarized light makes the first polarizer's own angle count; a drift grows with time,
    whatever is set.
Validity
    an even surface. Among dielectric bodies it lights what stands there; elsewhere it lights nothing else.
A `room` is such a surface before the sensor, off (power 0) until somebody adds it: the light of the surroundings.
References
    Goldstein, Polarized Light, 3rd ed., ch. 4.
XML
    spectrum string: measured power over the wavelength, in place of the Gaussian: a file, a name or a law
"""

import math
from dataclasses import replace

from optics.scene.checking import agree, ray
from optics.scene.checking import stokes as sent
from optics.scene.declare import Part
from optics.scene.line import LINE, relative
from optics.scene.mitsuba_parts import Declared
from optics.scene.parameter import Parameter
from optics.scene.warming import drifted

PARAMETERS = (
    Parameter(
        "power",
        "1",
        1.0,
        (0.0, 1e6),
        "radiance L, relative; 0 switches the source off",
        plausible=0.1,
        linear=True,
        role="power",
        free="all",
    ),
    *(
        Parameter(
            f"power_{c}",
            "1",
            1.0,
            (0.0, 1e6),
            f"share of the power in the {word} band ({colour})",
            plausible=0.1,
            linear=True,
            role="band power",
            band=band,
            free="all",
        )
        for band, (c, word, colour) in enumerate(
            (("r", "first", "red"), ("g", "second", "green"), ("b", "third", "blue"))
        )
    ),
    Parameter(
        "dop_q",
        "1",
        0.0,
        (-1.0, 1.0),
        "linear polarization along 0 deg, less that along 90",
        neutral=0.0,
        plausible=0.05,
        how="layer",
    ),
    Parameter(
        "dop_u",
        "1",
        0.0,
        (-1.0, 1.0),
        "linear polarization along 45 deg, less that along 135",
        neutral=0.0,
        plausible=0.05,
        how="layer",
    ),
    Parameter(
        "drift",
        "1",
        0.0,
        (-1.0, 1.0),
        "relative change per unit of time, at time 0",
        neutral=0.0,
        plausible=0.01,
        through="time",
        how="layer",
    ),
    Parameter(
        "settling",
        "1",
        0.0,
        (0.0, 1e3),
        "rate at which a drift settles, per unit of time; 0: it never does",
        neutral=0.0,
        plausible=0.1,
        through="time",
        how="layer",
    ),
    Parameter(
        "time",
        "1",
        0.0,
        (-1e6, 1e6),
        "the clock: minutes, or any unit that `drift` is meant in",
        role="clock",
        plausible=1.0,
        how="layer",
    ),
    *(replace(p, how="layer") for p in LINE),
)
ROOM = (
    replace(
        PARAMETERS[0], default=0.0, neutral=0.0, plausible=1e-5, doc="radiance L of the surroundings, relative", free=""
    ),
    *(replace(p, free="") for p in PARAMETERS[1:]),
)


def stokes(crossing, source):
    """Stokes vector at power 1, against the crossing's axes."""
    level = relative(source, getattr(source, "curve", None))(crossing.wavelengths) * drifted(source)
    q, u = crossing.axis(0.0)  # of the surface's x axis, against the crossing's axes
    return level, level * (source.dop_q * q - source.dop_u * u), level * (source.dop_q * u + source.dop_u * q), 0


def build(kind_of="source"):
    import drjit as dr
    import mitsuba as mi

    from optics.scene.layer import crossing_of, numbers_of

    class Source(Declared.on(mi.Emitter)):
        kind = kind_of

        def __init__(self, props):
            mi.Emitter.__init__(self, props)
            self.declare(props)
            self.read_spectrum(props, "spectrum", "power")
            self.m_flags = +mi.EmitterFlags.Surface
            self.m_needs_sample_3 = True

        def context(self, words):
            return {"curve": self.curves.get("spectrum")}

        def colour(self):
            shares = (self.power_r, self.power_g, self.power_b, mi.Float(1.0))
            return self.power * mi.UnpolarizedSpectrum(*shares[: dr.size_v(mi.UnpolarizedSpectrum)])

        def emitted(self, si):
            """What leaves towards si.wi, in Mitsuba's implicit axes; light leaves on the side of the normal."""
            vector = stokes(crossing_of(si, self.band), numbers_of(self))
            colour = dr.select(mi.Frame3f.cos_theta(si.wi) > 0, self.colour(), 0.0)
            if not mi.is_polarized:
                return mi.Spectrum(vector[0] * colour)
            rows = [[mi.UnpolarizedSpectrum(component) * colour, 0, 0, 0] for component in vector]
            return mi.Spectrum(*[mi.UnpolarizedSpectrum(e) for row in rows for e in row])

        def eval(self, si, active=True):
            return dr.select(active, self.emitted(si), 0.0)

        def sample_direction(self, it, sample, active=True):
            ds = self.get_shape().sample_direction(it, sample, active)
            active &= (dr.dot(ds.d, ds.n) < 0) & (ds.pdf != 0)
            ds.emitter = mi.EmitterPtr(self)
            return ds, dr.select(active, self.eval_direction(it, ds, active) / ds.pdf, 0.0)

        def eval_direction(self, it, ds, active=True):
            level = mi.UnpolarizedSpectrum(self.level(it.wavelengths)) * self.colour()
            level = dr.select(dr.dot(ds.d, ds.n) < 0, level, 0.0)
            return mi.mueller.depolarizer(level) if mi.is_polarized else mi.Spectrum(level)

        def level(self, wavelengths):
            bands = mi.UnpolarizedSpectrum(wavelengths) if mi.is_spectral else mi.UnpolarizedSpectrum(540.0)
            return relative(self, self.curves.get("spectrum"))(bands) * drifted(self)

        def pdf_direction(self, it, ds, active=True):
            return dr.select(dr.dot(ds.d, ds.n) < 0, self.get_shape().pdf_direction(it, ds, active), 0.0)

        def bbox(self):
            return self.get_shape().bbox()

        def to_string(self):
            return f"Source[{self.name}]"

    return Source


def check_stokes_vector():
    """(1, p cos 2a, p sin 2a, 0) of the degree p = 0.3 at the angle a = 30 deg, half as bright at half the width of its
    spectrum."""
    c, s = 0.3 * math.cos(math.radians(60)), 0.3 * math.sin(math.radians(60))
    light = {"dop_q": c, "dop_u": s, "wavelength": 540.0, "fwhm": 40.0}
    for kind in ("source", "room"):
        vector = sent(kind, ray(wavelengths=(540.0, 560.0)), **light)
        agree(vector, [[1, c, s, 0], [0.5, c / 2, s / 2, 0]], 1e-12, 1e-15)


def random(rng):
    """A lamp of any colour that is polarized by up to 0.3 at any angle."""
    p, double = rng.uniform(0, 0.3), rng.uniform(0, 2 * math.pi)
    colours = {f"power_{c}": rng.uniform(0.5, 1.5) for c in "rgb"}
    return {"dop_q": p * math.cos(double), "dop_u": p * math.sin(double), "time": rng.uniform(0, 5), **colours}


CHECKS = (check_stokes_vector,)
part = Part("source", "emitter", PARAMETERS, build, CHECKS, stokes=stokes, random=random)
room = Part("room", "emitter", ROOM, lambda: build("room"), CHECKS, stokes=stokes)
