"""Ring: LEDs on a circle, one light together.

Definition
    L_b = 1/n sum_k V_k T f_b(wi, s_k) cos(theta_k) kappa_b(S_k)    radiance that the lit point sends to the camera (S5)
    S_k = S + radius (cos(a_k) e1 + sin(a_k) e2),  a_k = 2 pi k/n + roll
    kappa_b = eta cos^mu / d^2 w_b power_b                          of the part `led` (S2)
with the middle S of the circle, the axes e1 (side) and e2 (up) across the ring's axis and the power eta =
`power` times `gain` of all n LEDs together. All have the axis of the ring. The spectrum is that of the part `led`.
Fingerprint
    shadows of n edges each, all around; the light varies little over the field.
Validity
    LEDs of one kind and one power; a ring of LEDs that are switched one by one is n parts `led`.
References
    Sensors 19 (2019) 928, section 2: two rings of LEDs around the lens; F-TAC Hand supplementary information, (S2).
XML
    position point: its middle, mm, in place of `x`, `y`, `z`
    target point, (0, 0, 0): what its axis looks at, mm
    count integer, 8: number n of LEDs
    spectrum string: measured power over the wavelength, as of the part `led`
    line_shape string: measured shape of the line, as of the part `led`
    board string: id of the part `board` that it stands on, as of the part `led`
    placed string: FILE:DESIGNATOR of a pick-and-place file, as of the part `led`
"""

import math
from pathlib import Path

from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.parameter import Parameter
from optics.scene.registry import declared, known

PARAMETERS = (
    *(
        p
        for p in declared(Path(__file__).with_name("led.py"))[0].parameters
        if p.role not in ("light area", "light turn")
    ),
    Parameter("radius", "mm", 8.0, (0.01, 500.0), "of the circle", plausible=0.3, how="difference"),
    Parameter("roll", "deg", 0.0, (-360.0, 360.0), "turn about the axis", plausible=3.0, how="difference"),
)


def build():
    import drjit as dr
    import mitsuba as mi

    class Ring(known().parts["led"].build()):
        kind = "ring"

        def __init__(self, props):
            self.count = int(props.get("count", 8))
            if self.count < 2:
                raise ValueError(f"ring: count = {self.count}; allowed: 2 LEDs and more; one is a part 'led'")
            super().__init__(props)

        def point(self, sample):
            """The LED that a sample of the unit square falls on, by its first number."""
            side, up, _ = self.frame
            k = dr.floor(dr.clip(sample.x, 0, 1 - 1e-6) * self.count)
            sin, cos = dr.sincos(2 * dr.pi * k / self.count + dr.deg2rad(self.roll))
            return self.position() + self.radius * (cos * side + sin * up)

        def places(self):
            return [((k + 0.5) / self.count, 0.5) for k in range(self.count)]

        def reach(self):
            return self.number("radius")

        def bbox(self):
            box = mi.ScalarBoundingBox3f()
            for place in self.places():
                box.expand(mi.ScalarPoint3f(*[float(c[0]) for c in self.point(mi.Point2f(*place))]))
            return box

        def to_string(self):
            return f"Ring[{self.name}]"

    return Ring


def check_circle():
    """n points on the circle, evenly apart; the irradiance on the axis is that of one LED at the slant distance."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    ring = made("ring", position=[0.0, 0.0, -4.0], radius=3.0, count=5, power=2.0, mu=1.0)
    at = np.array([np.array(ring.point(mi.Point2f(*place)), float).ravel() for place in ring.places()])
    agree(np.linalg.norm(at - [0, 0, -4], axis=1), np.full(5, 3.0), 1e-5)
    agree(np.linalg.norm(at - np.roll(at, 1, 0), axis=1), np.full(5, 6 * math.sin(math.pi / 5)), 1e-5)
    it = dr.zeros(mi.Interaction3f)
    to = ring.point(mi.Point2f(0.5, 0.5)) - it.p
    agree(ring.kappa(it, to / dr.norm(to), dr.norm(to))[0], 2.0 * 0.8 / 25, 1e-5)


def random(rng):
    """A blue ring around a lens."""
    return {"radius": rng.uniform(4, 20), "wavelength": rng.uniform(440, 480), "mu": rng.uniform(0.8, 3)}


part = Part("ring", "emitter", PARAMETERS, build, (check_circle,), role="led", random=random)
