"""Elastic skin: a soft gel under a cover, pressed by a needle with a round end; the face between the two is what shows.

Definition
    z(x, y) = -u_h(x - press_x, y - press_y, cover)              the gel's face, under the cover; flat at z = 0
    u = H * p                                                    an elastic half-space under the pressure p of a ball
                                                                 (optics.skin.forces; eqs. (1) and (2) of the source)
    F = E* f(press_depth) + press_force                          normal force on the ball of `tip_radius`: Sneddon's f,
                                                                 E* = young/(1 - poisson^2)
The half-space begins at the cover's outer face, z = +cover, and has the same material everywhere: the cover, the gel
and what is below. The gel fills -thickness < z < 0. The contact drags the skin along with `drag_x` and `drag_y` times
its normal force, spread as the pressure is. `young` sets the force that a depth takes, and nothing that is seen, unless
`press_force` presses. `stiff_base` leads over to a layer of cover and gel on a rigid base at z = -thickness, under the
same normal force (optics.skin.layer). Sheets, markers and beads in the gel move with the same displacement
u, sideways too.
Fingerprint
    beads near the press move away from it and towards the camera; the motion fades as 1/distance, far wider than a
    smoothed dent. A drag moves them all one way.
Validity
    small strains: a dent of the face by a tenth of its depth. The real base is stiff, which `stiff_base` gives; the
    real cover is stiffer than the gel, which nothing here gives.
References
    Sensors 19 (2019) 928, sections 2 and 3.1; Johnson, Contact Mechanics (1985), ch. 3.
XML
    pitch float, 0.03: mm, of the fine part of the mesh
    map_pitch float, 0.03: mm, of the maps that hold the contact's shape
    extent float, 3.0: mm, half width of the fine part of the mesh and of those maps
    columns integer, 0: vertices of the mesh along x; 0: 80 more than the fine part has
    rows integer, 0: vertices of the mesh along y, likewise
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.parameter import Parameter
from optics.scene.registry import declared, known
from optics.skin import contact, forces, pressing
from optics.skin.layer import base_correction
from optics.skin.stack import Layer

_GEL = declared(Path(__file__).with_name("gel.py"))[0]
SIZES = {"width": 30.0, "length": 30.0, "thickness": 4.5}  # mm
KEPT = (*SIZES, "press_x", "press_y", "press_depth")
PARAMETERS = (
    *(replace(p, default=SIZES.get(p.name, p.default)) for p in _GEL.parameters if p.name in KEPT),
    Parameter(
        "cover",
        "mm",
        1.25,
        (0.3, 20.0),
        "from the gel's face to the outer face, where it is pressed",
        plausible=0.1,
        how="difference",
    ),
    Parameter(
        "tip_radius", "mm", 0.6, (0.05, 50.0), "radius of the ball that presses", plausible=0.05, how="difference"
    ),
    Parameter(
        "press_force",
        "N",
        0.0,
        (0.0, 100.0),
        "normal force beyond the one that press_depth takes",
        neutral=0.0,
        plausible=0.1,
        how="difference",
    ),
    *(
        Parameter(
            f"drag_{axis}",
            "1",
            0.0,
            (-2.0, 2.0),
            f"tangential force along {axis} over the normal force",
            neutral=0.0,
            plausible=0.2,
            how="difference",
        )
        for axis in "xy"
    ),
    Parameter(
        "stiff_base",
        "1",
        0.0,
        (0.0, 1.0),
        "share of the way from a half-space (0) to a layer on a rigid base (1)",
        neutral=0.0,
        plausible=0.5,
        how="difference",
        step=0.4,  # a shorter one moves outlines by less than samples are apart
    ),
    Parameter("poisson", "1", 0.5, (0.0, 0.5), "Poisson's ratio", plausible=0.02, how="difference"),
    Parameter("young", "MPa", 0.12, (1e-4, 100.0), "Young's modulus", plausible=0.02, how="difference"),
)


def build():
    class ElasticSkin(known().parts["gel"].build()):
        kind = "elastic_skin"
        indenter, indenter_radius = "sphere", "tip_radius"
        pressing = (
            "press_x",
            "press_y",
            "press_depth",
            "press_force",
            "tip_radius",
            "cover",
            "drag_x",
            "drag_y",
            "poisson",
            "young",
        )

        def ball(self, now=None):
            """The contact of the tip (optics.skin.forces.Ball)."""
            n = self.number if now is None else now.__getitem__
            elastic = n("young"), n("poisson")
            found = forces.ball(n("press_depth"), n("tip_radius"))
            if n("press_force") == 0:
                return found
            found = forces.ball_by_force(found.force(*elastic) + n("press_force"), n("tip_radius"), *elastic)
            if found.depth > n("thickness"):
                deep, thick, force = found.depth, n("thickness"), n("press_force")
                raise ValueError(
                    f"'{self.name}': press_force = {force:g} N presses the ball {deep:.3g} mm deep, the gel is "
                    f"{thick:g} mm thick; allowed: less force, or a larger `young` (now {elastic[0]:g} MPa)"
                )
            return found

        def force(self):
            """(3,) force of the press along x, y and into the skin, N."""
            normal = self.ball().force(self.number("young"), self.number("poisson"))
            return normal * np.array([self.number("drag_x"), self.number("drag_y"), 1.0])

        def touching(self):
            """Pressure, shear and forces of the press on the outer face (optics.skin.pressing.Contact), around
            (press_x, press_y); of the half-space, whose force `stiff_base` keeps."""
            n = self.number
            profile = contact.indenter_profile("sphere", n("tip_radius"), (0.0, 0.0, 0.0), self.extent, self.map_pitch)
            deep = (Layer(math.inf, n("young"), n("poisson")),)
            touch = pressing.indent(profile, self.ball().depth, deep)
            shear = touch.pressure[..., None] * [n("drag_x"), n("drag_y")]
            return replace(touch, shear=shear, slip=touch.touched & bool(shear.any()))

        def carry(self, x, y, depth):
            """(..., 3) world mm: where the points that rest at (x, y, -depth) are now; arrays are broadcast."""
            n = self.number
            x, y, depth = np.broadcast_arrays(*(np.asarray(a, float) for a in (x, y, depth)))
            rest = np.stack([x, y, -depth], -1)
            places, loads = self.ball().nodes(n("young"), n("poisson"), (n("drag_x"), n("drag_y")))
            if not len(places):
                return rest
            at = np.stack([x - n("press_x"), y - n("press_y"), depth + n("cover")], -1).reshape(-1, 3)
            moved = forces.displacements(at, places, loads, n("young"), n("poisson"))
            if n("stiff_base") != 0:
                thick = n("cover") + n("thickness")
                at[:, 2] = np.minimum(at[:, 2], thick)
                elastic = n("young"), n("poisson")
                less = base_correction(at, *self.ball().rings(), self.force()[2], *elastic, thick)
                moved = moved + n("stiff_base") * less
            return rest + moved.reshape(rest.shape) * [1.0, 1.0, -1.0]

        def press(self, now=None):
            """Dent of the outer face and contact on a grid around the press axis."""
            found = self.ball(now)
            axis = contact.local_axis(2 * round(self.extent / self.map_pitch) + 1, self.map_pitch)
            r = np.hypot(axis, axis[:, None])
            fade = contact.window(len(axis))
            radius = np.linspace(0, r.max(), 400)
            dent = np.interp(r, radius, found.face(radius)) * fade * fade[:, None]
            touch = np.clip((found.a - r) / self.map_pitch + 0.5, 0, 1) if found.a else np.zeros_like(r)
            return contact.LocalMap(dent, self.map_pitch), contact.LocalMap(touch, self.map_pitch)

        def heights(self, x, y):
            self.map, self.touch = self.press()
            x, y = np.asarray(x, float)[None, :], np.asarray(y, float)[:, None]
            z = self.carry(x, y, np.zeros(1))[..., 2]
            for function in self.functions("surface"):
                z = z + function(x, y, self)
            return z

        def to_string(self):
            return f"ElasticSkin[{self.name}]"

    return ElasticSkin


def check_point_force():
    """Far from a small contact the face moves as under a point force (Boussinesq): 3 F/(4 pi E) (h^2/R^2 + 1)/R at
    nu = 1/2; without a press it is flat."""
    skin = made("elastic_skin", press_force=0.02, tip_radius=0.2, cover=1.0, press_x=0.5, bsdf={"type": "membrane"})
    assert abs(skin.force()[2] - 0.02) < 1e-9  # N
    x = np.array([3.0, 6.0, 12.0])
    r2 = x**2 + 1
    # the contact is 0.2 mm wide: (a/R)^2 of the displacement at the nearest point
    agree(skin.heights(0.5 + x, [0.0])[0], -3 * 0.02 / (4 * np.pi * 0.12) * (1 / r2 + 1) / np.sqrt(r2), 5e-3)
    agree(made("elastic_skin", bsdf={"type": "membrane"}).heights(x, x), np.zeros((3, 3)))


def random(rng):
    """A needle beside the middle, a fraction of its radius deep."""
    place = {f"press_{axis}": rng.uniform(-8, 8) for axis in "xy"}
    return {"press_depth": rng.uniform(0.1, 0.8), "tip_radius": rng.uniform(0.4, 1.0), **place}


part = Part("elastic_skin", "shape", PARAMETERS, build, (check_point_force,), role="gel", random=random)
