"""Strip: a rectangle that shines, as a row of LEDs behind a diffuser, a light bar or a panel beside the gel.

Definition
    L_b = 1/A int_A V T f_b(wi, s) cos(theta) kappa_b dA          radiance that the lit point x sends to the camera (S5)
    kappa_b = eta cos(a)^mu / d^2 w_b power_b                     1/mm^2; 0 where cos(a) <= 0, see the part `led` (S2)
over the area A = length width of the rectangle, with the distance d of its point S from x, the unit vector s from x
towards S, the angle a between the beam and the axis p, the power eta = `power` times `gain`, the visibility V, the
transmittance T of the gel, the membrane's reflection f and the angle theta between s and the skin's normal. At mu = 1
each point is Lambertian and the rectangle has the radiance eta/A: without shadows it gives the irradiance pi eta/A F, F
the view factor of a polygon (Lambert). The rectangle lies across the nominal axis, its long side along `along`, turned
by `roll`; `pan` and `tilt` turn the lobe alone.
    S_k: n points that stand for A/n each;  n = 4 ceil((length + width)/(2 mm)), at least 16, of the XML's sizes
Along the strip they are Gauss-Legendre points, two in each of n/4 cells. Across it each has another place, and its
mirror image: the edge of a shadow crosses them one by one, or in pairs.
Fingerprint
    shadows get a penumbra, wide along the strip and narrow across it; the light falls off more slowly than that of a
    point.
Validity
    the same radiance over the whole area: a row of bare LEDs is several parts `led`. The n points show as steps of 1/n
    to 2/n in a penumbra, and as spots nearer to the strip than a millimetre. A calibration that changes the sizes keeps
    n.
References
    Lambert, Photometria (1760); Howell et al., A Catalog of Radiation Heat Transfer Configuration Factors, B-3, B-4;
    F-TAC Hand supplementary information, S1.3, eq. (S2), for the light of a point.
XML
    position point: where its middle stands, mm, in place of `x`, `y`, `z`
    target point, (0, 0, 0): what it faces, mm: the axis is from the position to here
    along vector: the direction of its long side, as far as that lies across the axis
    spectrum string: measured power over the wavelength, as of the part `led`
    line_shape string: measured shape of the line, as of the part `led`
    board string: id of the part `board` that it stands on, as of the part `led`
    placed string: FILE:DESIGNATOR of a pick-and-place file, as of the part `led`
    points integer, 0: number n of points, a multiple of 4; 0: by its size
"""

import math
from pathlib import Path

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.parameter import Parameter
from optics.scene.registry import declared, known

FEWEST = 16
PARAMETERS = (
    *(
        p
        for p in declared(Path(__file__).with_name("led.py"))[0].parameters
        if p.role not in ("light area", "light turn")
    ),
    Parameter("length", "mm", 10.0, (0.01, 100.0), "size along its long side", plausible=0.5, how="difference"),
    Parameter("width", "mm", 1.0, (0.01, 100.0), "size across its long side", plausible=0.2, how="difference"),
    Parameter(
        "roll", "deg", 0.0, (-180.0, 180.0), "turn of the rectangle about the axis", plausible=2.0, how="difference"
    ),
)


def build():
    import drjit as dr
    import mitsuba as mi

    class Strip(known().parts["led"].build()):
        kind = "strip"

        def __init__(self, props):
            along, count = props.get("along", None), int(props.get("points", 0))
            super().__init__(props)
            if along is not None:
                self.own_frame = [dr.opaque(mi.Vector3f, v) for v in self.turned([float(c) for c in along])]
            size = self.number("length") + self.number("width")
            count = count or max(4 * math.ceil(size / 2), FEWEST)
            if count < 4 or count % 4:
                raise ValueError(f"strip '{self.name}': points = {count}; allowed: 0 and multiples of 4, such as 16")
            self.grid = lattice(count)

        def turned(self, along):
            """The frame (side, up, forward) whose side is `along` as far as that lies across the axis."""
            axis = [float(c[0]) for c in self.own_frame[2]]
            side = np.array(along) - np.dot(along, axis) * np.array(axis)
            if np.linalg.norm(side) < 1e-3 * max(np.linalg.norm(along), 1e-30):
                raise ValueError(f"strip '{self.name}': along = {along} is the direction of its axis; choose another")
            side /= np.linalg.norm(side)
            return side.tolist(), np.cross(axis, side).tolist(), axis

        def point(self, sample):
            """A point of the rectangle for a sample of the unit square, x along its length."""
            side, up, _ = self.frame
            sin, cos = dr.sincos(dr.deg2rad(self.roll))
            x, y = self.length * (sample.x - 0.5), self.width * (sample.y - 0.5)
            return self.position() + side * (cos * x - sin * y) + up * (sin * x + cos * y)

        def places(self):
            """Points of the unit square that stand for the area, each for an equal share."""
            return self.grid

        def reach(self):
            """From the middle to a corner, mm."""
            return math.hypot(self.number("length"), self.number("width")) / 2

        def bbox(self):
            box = mi.ScalarBoundingBox3f()
            for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
                box.expand(mi.ScalarPoint3f(*[float(c[0]) for c in self.point(mi.Point2f(*corner))]))
            return box

        def to_string(self):
            return f"Strip[{self.name}]"

    return Strip


def lattice(count):
    """A multiple of four of points in the unit square, all with the same weight; a list of pairs.

    The points come in pairs (x, 1/2 + y), (x, 1/2 - y), so that what is odd across the strip has no error. x and 2 y
    take the Gauss-Legendre points of two nodes a cell, whose weights are equal: the error along the strip falls with
    the fourth power of the cell. y takes them in constant steps (a Korobov lattice), by the step with the least
    products of Legendre polynomials in x and y, whose means over a square are 0.
    """
    half = count // 2
    k = np.arange(half)
    at = (k // 2 + 0.5 + (k % 2 - 0.5) / math.sqrt(3)) / (half // 2)

    def across(step):
        return at[(step * k + (step - 1) // 2) % half] / 2

    def error(step):
        orders = ((i, j) for i in range(1, 5) for j in (2, 4))
        means = [np.mean(legendre(i, 2 * at - 1) * legendre(j, 2 * across(step))) for i, j in orders]
        return float(np.sum(np.square(means)))

    y = across(min((s for s in range(1, half, 2) if math.gcd(s, half) == 1), key=error))
    return [(float(u), float(v)) for u, d in zip(at, y) for v in (0.5 + d, 0.5 - d)]


def legendre(order, x):
    """The Legendre polynomial of an order at x, scaled to a mean square of 1 over -1 to 1."""
    return math.sqrt(2 * order + 1) * np.polynomial.legendre.Legendre.basis(order)(x)


def check_irradiance():
    """The irradiance of a parallel plane below the middle of a Lambertian strip is that of Lambert's polygon; the
    points are all apart, and along either side they have the moments of a uniform density."""
    import drjit as dr
    import mitsuba as mi

    length, width, depth, power = 12.0, 2.0, 3.0, 5.0
    strip = made(
        "strip",
        position=[1.0, 2.0, -depth],
        target=[1.0, 2.0, 0.0],
        along=[1.0, 0, 0],
        length=length,
        width=width,
        power=power,
        mu=1.0,
    )
    it = dr.zeros(mi.Interaction3f)
    it.p = mi.Point3f(1.0, 2.0, 0.0)
    found = 0.0
    for place in strip.places():
        to = strip.point(mi.Point2f(*place)) - it.p
        distance = dr.norm(to)
        found += strip.kappa(it, to / distance, distance)[0] * depth / distance[0] / len(strip.places())
    a, b = length / 2, width / 2
    ra, rb = math.hypot(a, depth), math.hypot(b, depth)
    quarter = (a / ra * math.atan(b / ra) + b / rb * math.atan(a / rb)) / 2  # pi times the view factor, Howell B-3
    agree(found, 4 * quarter * power / (length * width), 1e-3)  # of 28 points
    x, y = np.array(lattice(28)).T
    agree([x.mean(), y.mean(), (x**2).mean(), (y**3).mean()], [1 / 2, 1 / 2, 1 / 3, 1 / 4], 1e-12)
    assert len(set(x)) == 14 and len(set(y)) == 28


def random(rng):
    """A coloured bar beside a gel."""
    size = {"length": rng.uniform(5, 40), "width": rng.uniform(0.5, 8), "roll": rng.uniform(-20, 20)}
    return {**size, "wavelength": rng.uniform(450, 640), "fwhm": rng.uniform(20, 150), "mu": rng.uniform(0.8, 3)}


part = Part("strip", "emitter", PARAMETERS, build, (check_irradiance,), role="led", random=random)
