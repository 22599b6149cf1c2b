"""Panel: a luminous area of up to four regions, each of which sends light of a polarization of its own.

Definition
    S = power power_c level_k (1, q_k, u_k, 0) (1 + drift g(time))   Stokes vector in the region k, level_0 = 1
    g(t) = (1 - exp(-settling t))/settling                           t where settling is 0
with the power (radiance, relative), the shares of the first three bands, and the linear polarization q_k = `dop_q`,
`dop_q_1` ... `dop_q_3` = p cos(2a), u_k = p sin(2a) of the degree p along the angle a, from the surface's x axis to its
y axis. `region_map` says where the regions lie: even (region 0 alone), halves (0 left, 1 right), quarters (0 1 above 2
3, as the camera sees them) or an image of whole numbers (optics.scene.regions); regions beyond the fourth are like the
fourth. A calibration solves for the power, the levels and the polarizations: the Stokes vectors are unknown.
Fingerprint
    each region has one degree and one angle of polarization; a polarization camera sees them at once.
Validity
    even within a region, linear polarization; lights nothing else.
References
    Goldstein, Polarized Light, 3rd ed., ch. 4.
XML
    region_size float, 0.0: width of the map of regions, mm; 0: as wide as the camera sees
"""

import math

import numpy as np

from optics.polarization.mueller import where
from optics.scene.checking import agree, ray
from optics.scene.checking import stokes as sent
from optics.scene.declare import Part
from optics.scene.mitsuba_parts import Declared
from optics.scene.parameter import Parameter
from optics.scene.regions import FILES, PATTERNS, Regions
from optics.scene.warming import drifted

REGIONS = 4
PARAMETERS = (
    Parameter(
        "power",
        "1",
        1.0,
        (0.0, 1e6),
        "radiance L of the region 0, relative; 0 switches the panel off",
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
    *(
        Parameter(
            f"level_{k}",
            "1",
            1.0,
            (0.0, 1e3),
            f"radiance of the region {k} over that of the region 0",
            plausible=0.1,
            how="layer",
            free="all",
        )
        for k in range(1, REGIONS)
    ),
    *(
        Parameter(
            f"dop_{letter}{f'_{k}' if k else ''}",
            "1",
            0.0,
            (-1.0, 1.0),
            f"linear polarization of the region {k} along {along} deg, less that along {across}",
            plausible=0.05,
            how="layer",
            free="all",
            **({} if k else {"neutral": 0.0}),
        )
        for k in range(REGIONS)
        for letter, along, across in (("q", 0, 90), ("u", 45, 135))
    ),
    Parameter(
        "drift", "1", 0.0, (-1.0, 1.0), "change per unit of time, at time 0", neutral=0.0, plausible=0.01, how="layer"
    ),
    Parameter(
        "settling",
        "1",
        0.0,
        (0.0, 1e3),
        "rate at which a drift settles, per unit of time; 0: it never does",
        neutral=0.0,
        plausible=0.1,
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
    Parameter(
        "region_map",
        "-",
        "even",
        role="regions",
        choices=tuple(PATTERNS),
        doc="where the regions lie: even, halves, quarters or an image of numbers",
        files=FILES,
    ),
)


def stokes(crossing, panel):
    """Stokes vector at power 1, against the crossing's axes."""
    level = drifted(panel) + 0.0 * crossing.u
    dop_q, dop_u = panel.dop_q + 0.0 * level, panel.dop_u + 0.0 * level
    regions = getattr(panel, "regions", None)
    if regions is not None:
        number = regions(crossing.u, crossing.v)
        first = level
        for k in range(1, REGIONS):
            here = number == k if k < REGIONS - 1 else number >= k
            own = [getattr(panel, f"{name}_{k}") + 0.0 * level for name in ("dop_q", "dop_u")]
            level = where(here, first * getattr(panel, f"level_{k}"), level)
            dop_q, dop_u = where(here, own[0], dop_q), where(here, own[1], dop_u)
    q, u = crossing.axis(0.0)  # of the surface's x axis, against the crossing's axes
    level = level + 0.0 * crossing.wavelengths
    return level, level * (dop_q * q - dop_u * u), level * (dop_q * u + dop_u * q), 0


def build():
    import drjit as dr
    import mitsuba as mi

    from optics.scene.layer import crossing_of, numbers_of

    class Panel(Declared.on(mi.Emitter)):
        kind = "panel"

        def __init__(self, props):
            mi.Emitter.__init__(self, props)
            self.declare(props)
            self.m_flags = +mi.EmitterFlags.Surface
            self.m_needs_sample_3 = True

        def wire(self, scene):
            own = [shape for shape in scene.scene.shapes() if shape.emitter() is self]
            if own:
                self.place_maps(scene.one("camera"), own[0])

        def context(self, words):
            return {"regions": self.map_of_regions(words)}

        def emitted(self, si):
            """What leaves towards si.wi, in Mitsuba's implicit axes; light leaves on the side of the normal."""
            shares = (self.power_r, self.power_g, self.power_b, mi.Float(1.0))
            colour = self.power * mi.UnpolarizedSpectrum(*shares[: dr.size_v(mi.UnpolarizedSpectrum)])
            colour = dr.select(mi.Frame3f.cos_theta(si.wi) > 0, colour, 0.0)
            vector = stokes(crossing_of(si, self.band), numbers_of(self))
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
            # what it lights, it lights as if it were all like the region 0, unpolarized
            level = mi.UnpolarizedSpectrum(self.power * drifted(self))
            level = dr.select(dr.dot(ds.d, ds.n) < 0, level, 0.0)
            return mi.mueller.depolarizer(level) if mi.is_polarized else mi.Spectrum(level)

        def pdf_direction(self, it, ds, active=True):
            return dr.select(dr.dot(ds.d, ds.n) < 0, self.get_shape().pdf_direction(it, ds, active), 0.0)

        def bbox(self):
            return self.get_shape().bbox()

        def to_string(self):
            return f"Panel[{self.name}]"

    return Panel


def check_a_vector_for_each_region():
    """Quarters of a map 4 mm wide: levels 1, 2, 0.5, 3 and p = 0.3 at 0, 45, 90 and 135 deg."""
    light = {"level_1": 2.0, "level_2": 0.5, "level_3": 3.0, "dop_q": 0.3, "dop_u_1": 0.3, "dop_q_2": -0.3}
    light.update(dop_u_3=-0.3, regions=Regions(PATTERNS["quarters"], 4.0))
    expected = [[1, 0.3, 0, 0], [2, 0, 0.6, 0], [0.5, -0.15, 0, 0], [3, 0, -0.9, 0]]
    for (u, v), vector in zip(((-1.0, 1.0), (1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)), expected):
        agree(sent("panel", ray(u=u, v=v), **light)[0], vector, 1e-12, 1e-15)


def random(rng):
    """Regions of levels of 0.5 to 1.5 that are polarized by up to 0.5 at any angle."""
    found = {f"level_{k}": rng.uniform(0.5, 1.5) for k in range(1, REGIONS)}
    for k in range(REGIONS):
        p, double = rng.uniform(0, 0.5), rng.uniform(0, 2 * math.pi)
        end = f"_{k}" if k else ""
        found.update({f"dop_q{end}": p * np.cos(double), f"dop_u{end}": p * np.sin(double)})
    return {**found, "time": rng.uniform(0, 5), **{f"power_{c}": rng.uniform(0.5, 1.5) for c in "rgb"}}


part = Part(
    "panel",
    "emitter",
    PARAMETERS,
    build,
    (check_a_vector_for_each_region,),
    role="source",
    stokes=stokes,
    random=random,
)
