"""Gel: the soft layer of the sensor and its coated face, pressed by an indenter.

Definition
    z(x, y) = z0 - D(x - press_x, y - press_y) + sum of `surface` effects      the coated face
    z0 = (curve_xx x^2 + 2 curve_xy x y + curve_yy y^2)/2                     the face at rest; level without a curve
    D0 = clip(press_depth + z0 - m - h, 0, thickness)          h(x, y): height of the indenter over its lowest point
    D <- max(D0, G_sd * D), from D = D0, sd = smoothing, smoothing/2, smoothing/4, smoothing/8                  (S1.6)
    D <- G_sd * D once more, sd^2 = (smoothing/16)^2 + map_pitch^2                        without restoring the contact
with G_sd * D the blur by a Gaussian of that standard deviation (mm); the maximum puts the skin back onto the indenter
after each blur. Steep walls of h are cut to a slope, and the rim of D0 is rounded, within about a node of the map
(optics.skin.contact). The gel fills -thickness < z < 0; the camera stands at z < -thickness. The face is a triangle
mesh on a graded grid that is fine around the contact and moves with it, so that images vary smoothly with the press.
A ball with `flattening` f is (1 - f) times as tall as wide: h is (1 - f) times that of the ball.
The depth is counted from the face where the indenter's axis meets it, m = z0(press_x, press_y), that of a plate of
balls from the mean of z0 over the gel; and the plate takes the share `evened` of z0 - m out of the face beside them.
With `coat` d > 0 the camera sees the coating's inner face, parallel to the one that is touched:
    h'(x) = d + min over |s| <= d of h(x + s) - sqrt(d^2 - s^2)
With `fillet` > 0 the skin bridges corners with arcs of that radius: D0 is closed by a ball of it before the smoothing.
With `skirt` > 0 the skin beside the contact falls off as exp(-distance / skirt) before the smoothing: in place of D0
stands the max over touched points p of D0(p) exp(-|x - p| / skirt).
The forces of a press are those of an elastic skin under the same indenter at the same depth (optics.skin.pressing): E =
`young`, `poisson`, on a rigid window at its thickness; with `backing` deep, without end; with `backing` held, held at
its rim, free behind, and stiffened by `springs` in its middle plane (optics.skin.held). They are labels: the dent that
is seen stays the one above, unless `dent_model` is elastic: then the face, and what it carries, move as that skin does,
and `smoothing`, `skirt` and `fillet` do nothing. An indenter that came to where it stands by `shift_x`, `shift_y` and a
turn by `twist` after it had pressed drags along what sticks to it by `friction` (Coulomb); sheets, markers and beads in
the gel are carried sideways by that shear.
By how much a wide press stretches the face is not computed: `stretch`, `stretch_x` ... `stretch_yy` state it, J - 1 = s
+ sx x + sy y + sxx x^2 + sxy x y + syy y^2, J the area of a piece of pressed skin over that at rest, for effects of it.
Indenters: sphere (`indenter_size` = radius),
cylinder lying on its side (radius), cube face down (edge), balls (radius) `indenter_spacing` apart on a plate without
end, one of them at the press, a mesh file (STL, OBJ, PLY; `indenter_size` = scale) or a measured height map (TMD;
`indenter_size` = scale; NPY in mm or 16 bit PNG in micrometres: mm from sample to sample).
Fingerprint
    position and depth of the press move the dent; `smoothing` widens its skirt, `skirt` gives it a long tail.
Validity
    quasi-static presses; the skirt is a smoothing, not elasticity, so that dent and forces are two models of one press.
    The gel's far side rests on a rigid window. Forces hold for small strains, a few thicknesses from the gel's rim.
References
    F-TAC Hand supplementary information, S1.2 and S1.6. `young`: elastomers of such sensors have 5 to 20 Shore A,
    which is 0.28 to 0.73 MPa by Gent, Rubber Chem. Technol. 31 (1958) 896; a force that you measured tells yours.
XML
    pitch float, 0.03: mm, of the fine part of the mesh
    map_pitch float, 0.03: mm, of the maps that hold the dent's shape
    extent float, 3.0: mm, half width of the fine part of the mesh and of those maps
    columns integer, 0: vertices of the mesh along x; 0: 80 more than the fine part has
    rows integer, 0: vertices of the mesh along y, likewise
"""

import math
from dataclasses import replace

from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.mitsuba_parts import Declared, coarseness
from optics.scene.parameter import Parameter
from optics.skin import contact, held, pressing
from optics.skin.stack import Layer

FINE = 25  # of a ball's radius, the pitch that a coarser mesh keeps: with 16, flanks are off by 1 % of the light
INDENTER_SIZE = 1.5  # mm
# mm. Facets put rims of shadows a little off, by h^2/24R to h^2/8R of a ball's flank. Of four summed frames of 12 bits,
# chi2 of 230 000 values is 760 above that of a path tracer on a far finer mesh at 0.06 mm, and 350 at 0.03 mm, most of
# it from samples; a vignetting that is known to 0.08 % comes out 3.9 errors low at 0.06 mm, 1.1 at 0.03 mm and 0.6 at
# 0.02 mm. A press takes a fifth longer than at 0.06 mm.
PITCH = 0.03
# Vertices beside the fine part, where the face is nearly flat, and in all, unless stated. With 48 a gel bulge, whose
# ring is wider than the fine part, came out 1.6 % higher in one set; with 24, images of a face of 0.2 m radius are off
# by 8e-4 of their mean, with 80 by 1e-4.
BESIDE, MOST = 80, 2000
DRAG = ("friction", "shift_x", "shift_y", "twist")
SHEARING = ("poisson", *DRAG)
ROUNDING = ("smoothing", "skirt", "fillet")  # of the geometric dent
CURVE = ("curve_xx", "curve_xy", "curve_yy")
STAGE = 0.05  # mm: how well a stage usually knows where it presses
PARAMETERS = (
    Parameter("width", "mm", 20.0, (0.1, 1000.0), "size along x", plausible=0.1, how="difference", role="width"),
    Parameter("length", "mm", 16.0, (0.1, 1000.0), "size along y", plausible=0.1, how="difference", role="length"),
    Parameter(
        "thickness",
        "mm",
        4.0,
        (0.01, 100.0),
        "from the window to the coated face",
        plausible=0.1,
        how="difference",
        role="thickness",
    ),
    Parameter(
        "press_x",
        "mm",
        0.0,
        (-500.0, 500.0),
        "where the indenter's axis meets the face, right",
        plausible=0.1,
        how="difference",
        role="press x",
        free="press",
        prior_sd=STAGE,
    ),
    Parameter(
        "press_y",
        "mm",
        0.0,
        (-500.0, 500.0),
        "where the indenter's axis meets the face, down",
        plausible=0.1,
        how="difference",
        role="press y",
        free="press",
        prior_sd=STAGE,
    ),
    Parameter(
        "press_depth",
        "mm",
        0.0,
        (0.0, 50.0),
        "how far the indenter's lowest point is below the face",
        plausible=0.05,
        how="difference",
        step=0.4,
        role="press depth",
        free="press",
        prior_sd=STAGE,
    ),
    *(
        Parameter(
            name,
            "1/mm",
            0.0,
            (-0.5, 0.5),
            f"curve of the face at rest, {term}; below 0: it stands out in the middle",
            neutral=0.0,
            plausible=2e-3,
            how="difference",
        )
        for name, term in zip(CURVE, ("along x", "xy: a saddle", "along y"))
    ),
    Parameter(
        "evened",
        "1",
        0.5,
        (0.0, 1.0),
        "share of the curve that a plate of balls takes out of the skin between the balls",
        plausible=0.3,
        how="difference",
    ),
    Parameter("press_rx", "deg", 0.0, (-180.0, 180.0), "turn of the indenter about x", plausible=1.0, how="difference"),
    Parameter("press_ry", "deg", 0.0, (-180.0, 180.0), "turn of the indenter about y", plausible=1.0, how="difference"),
    Parameter("press_rz", "deg", 0.0, (-180.0, 180.0), "turn of the indenter about z", plausible=1.0, how="difference"),
    Parameter(
        "indenter",
        "-",
        "sphere",
        choices=contact.SHAPES,
        doc="sphere, cylinder, cube, balls (on a square grid), a mesh file or a height map",
        files=contact.FILES,
    ),
    Parameter(
        "indenter_size",
        "mm",
        INDENTER_SIZE,
        (1e-3, 1000.0),
        "radius, radius, edge, radius of the balls, scale of the mesh, or spacing of a map's samples",
        plausible=0.02,
        how="difference",
        step=0.8,
    ),
    Parameter(
        "indenter_spacing",
        "mm",
        1.0,
        (2e-3, 1000.0),
        "from ball to ball of a plate of balls",
        plausible=0.01,
        how="difference",
    ),
    Parameter(
        "smoothing",
        "mm",
        0.25,
        (1e-3, 5.0),
        "standard deviation of the widest kernel of S1.6",
        plausible=0.05,
        how="difference",
        step=0.4,
    ),
    Parameter(
        "skirt",
        "mm",
        0.0,
        (0.0, 5.0),
        "length over which the skin beside the contact falls to 1/e; 0: a Gaussian skirt, by smoothing alone",
        neutral=0.0,
        plausible=0.3,
        how="difference",
    ),
    Parameter(
        "coat",
        "mm",
        0.0,
        (0.0, 1.0),
        "thickness of the coating, between the indenter and the face that the camera sees",
        neutral=0.0,
        plausible=0.02,
        how="difference",
        step=1.0,  # rims of shadows must cross several of the finer samples
    ),
    Parameter(
        "flattening",
        "1",
        0.0,
        (-0.5, 0.5),
        "1 - height/width of a ball indenter; below 0: taller than wide",
        neutral=0.0,
        plausible=0.05,
        how="difference",
    ),
    Parameter(
        "fillet",
        "mm",
        0.0,
        (0.0, 5.0),
        "least radius of the skin where it bridges the corner beside a contact; 0: it follows",
        neutral=0.0,
        plausible=0.1,
        how="difference",
        starts=(0.05, 0.2, 1.0),  # below the skirt's own length it does nothing
    ),
    Parameter("young", "MPa", 0.28, (1e-4, 1e4), "Young's modulus", plausible=0.02, how="difference"),
    Parameter("poisson", "1", 0.49, (0.0, 0.5), "Poisson's ratio", plausible=0.005, how="difference"),
    Parameter(
        "backing",
        "-",
        "rigid",
        choices=("rigid", "deep", "held"),
        doc="what forces find behind: a window, more gel, or nothing, the rim being held",
    ),
    Parameter(
        "springs",
        "N/mm^3",
        0.0,
        (0.0, 1e3),
        "of a held skin: c of the spheroid of springs that stand for a film in its middle plane",
        plausible=0.001,
        how="difference",
        step=1.0,
    ),
    Parameter(
        "dent_model",
        "-",
        "geometric",
        choices=("geometric", "elastic"),
        doc="what is seen: the indenter's shape with a smoothing, or the face of the elastic skin",
    ),
    Parameter("friction", "1", 0.8, (0.0, 10.0), "Coulomb's, of indenter and skin", plausible=0.1, how="difference"),
    *(
        Parameter(
            f"shift_{axis}",
            "mm",
            0.0,
            (-50.0, 50.0),
            f"how far the indenter moved along {axis} after it had pressed, to where it stands",
            plausible=0.1,
            how="difference",
        )
        for axis in "xy"
    ),
    *(
        Parameter(
            name,
            unit,
            0.0,
            (-bound, bound),
            f"areal stretch of the pressed face, J - 1: its {word}",
            plausible=size,
            how="difference",
        )
        for name, unit, bound, size, word in (
            ("stretch", "1", 2.0, 0.05, "value at x = y = 0"),
            ("stretch_x", "1/mm", 1.0, 0.01, "slope along x"),
            ("stretch_y", "1/mm", 1.0, 0.01, "slope along y"),
            ("stretch_xx", "1/mm^2", 1.0, 2e-3, "share of x^2"),
            ("stretch_xy", "1/mm^2", 1.0, 2e-3, "share of x y"),
            ("stretch_yy", "1/mm^2", 1.0, 2e-3, "share of y^2"),
        )
    ),
    Parameter(
        "twist",
        "deg",
        0.0,
        (-360.0, 360.0),
        "how far the indenter turned about z after it had pressed, from x to y",
        plausible=2.0,
        how="difference",
    ),
)


def build():
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    class Gel(Declared.on_mesh()):
        kind = "gel"
        carries = False
        indenter_radius = "indenter_size"  # the parameter that holds the radius of what presses
        pressing = (
            "press_x",
            "press_y",
            "press_depth",
            "evened",
            "press_rx",
            "press_ry",
            "press_rz",
            "indenter",
            "indenter_size",
            "indenter_spacing",
            "smoothing",
            "skirt",
            "coat",
            "flattening",
            "fillet",
            "young",
            "poisson",
            "backing",
            "springs",
            "dent_model",
            "friction",
            "shift_x",
            "shift_y",
            "twist",
            *contact.STRETCH,
        )  # what does nothing while press_depth is 0

        def __init__(self, props):
            self.pitch = float(props.get("pitch", PITCH))  # mm, of the fine part of the mesh
            self.map_pitch = float(props.get("map_pitch", 0.03))  # mm, of the maps that hold the dent's shape
            self.extent = float(props.get("extent", 3.0))  # mm, half width of the fine part
            positive = max(self.pitch, 1e-9)  # `axes` refuses a pitch that is not
            enough = min(math.ceil(2 * self.extent / positive) + BESIDE, MOST)
            self.columns, self.rows = (int(props.get(name, 0)) or enough for name in ("columns", "rows"))
            coarsest = float(props.get(self.indenter_radius, INDENTER_SIZE)) / FINE
            if (times := min(coarseness(), max(int(coarsest / positive), 1))) > 1:
                self.pitch *= times
                self.columns, self.rows = -(-self.columns // times), -(-self.rows // times)
            index = np.arange(self.columns * self.rows).reshape(self.rows, self.columns)
            a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
            faces = np.stack([a, d, c, a, c, b], -1).reshape(-1, 3)  # normals towards the camera (-z)
            mi.Mesh.__init__(self, "gel", index.size, len(faces), props, True, False)
            self.declare(props)
            self._map = None
            self.level = False  # whether all of the face lies in one plane across the camera's axis
            self.seen_touch = None  # of which a texture was made
            self.recalled = None  # another geometry than the mesh is in, as `recall` has it
            self.deep = None  # its thickness, mm, Dr.Jit
            if self.indenter.lower().endswith(contact.FILES):
                self.indenter = str(mi.file_resolver().resolve(self.indenter))
            params = mi.traverse(self)
            params["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
            self.rebuild(params)

        def wire(self, scene):
            self.carries = any(getattr(part, "moved_by", None) == self.role for part in scene.parts)
            self.coats = tuple(part for part in scene.parts if hasattr(part, "brdf"))  # membranes

        def takes(self, name):
            if self.elastic:
                return name not in ROUNDING and (self.carries or name not in DRAG)
            return self.carries or name not in SHEARING  # what is carried sideways is all that shows of a drag

        @property
        def map(self):
            """The face's displacement around the press axis (optics.skin.contact.LocalMap)."""
            if self._map is None:  # of an elastic dent, few ask for it
                self._map = self.touching().displacement()[2]
            return self._map

        @map.setter
        def map(self, found):
            self._map = found

        @property
        def elastic(self):
            """Whether the face that is seen is that of the elastic skin."""
            return getattr(self, "dent_model", "") == "elastic"

        def rest_face(self, now=None):
            """The face that the indenter finds (optics.skin.contact.RestFace); None: level."""
            n = self.number if now is None else now.__getitem__
            xx, xy, yy = map(n, CURVE)
            if not (xx or xy or yy):
                return None
            shape = self.indenter if now is None else now["indenter"]
            face = contact.RestFace(xx, xy, yy, n("press_x"), n("press_y"))
            if shape == "balls" and n("press_depth") > 0:
                mean = (xx * n("width") ** 2 + yy * n("length") ** 2) / 24
                return replace(face, level=mean, share=1 - n("evened"))
            return replace(face, level=face.around(0.0, 0.0))

        def profile(self, now=None):
            """Lower surface of the indenter (optics.skin.contact.Profile), over the face that it finds; of the values
            `now`, or of the gel's own."""
            face, level = self.rest_face(now), self.level_profile(now)
            return level if face is None else level.over(face)

        def level_profile(self, now=None):
            n = self.number if now is None else now.__getitem__
            return contact.indenter_profile(
                self.indenter if now is None else now["indenter"],
                n("indenter_size"),
                (n("press_rx"), n("press_ry"), n("press_rz")),
                self.extent,
                self.map_pitch,
                spacing=n("indenter_spacing"),
                coat=n("coat"),
                flattening=n("flattening"),
            )

        def press(self, now=None):
            """Displacement and contact maps on the indenter's own grid (optics.skin.contact); of the values `now`, or
            of the gel's own."""
            n = self.number if now is None else now.__getitem__
            if self.elastic if now is None else now.get("dent_model") == "elastic":
                touch = self.touching(now)
                return touch.displacement()[2], touch.touch
            sizes = (n("press_depth"), n("thickness"), n("smoothing"))
            return contact.displacement(self.profile(now), *sizes, skirt=n("skirt"), fillet=n("fillet"))

        def touching(self, now=None):
            """Pressure, shear and forces of the press (optics.skin.pressing.Contact), around (press_x, press_y); of the
            values `now`, or of the gel's own."""
            n = self.number if now is None else now.__getitem__
            backing = self.backing if now is None else now["backing"]
            if backing == "held":
                sizes = (n("width"), n("length"), n("thickness"), n("young"), n("poisson"), n("springs"))
                place = (n("press_x"), n("press_y"))
                touch = held.indent(self.profile(now), n("press_depth"), place, held.held_skin(*sizes))
            else:
                layer = Layer(n("thickness") if backing == "rigid" else math.inf, n("young"), n("poisson"))
                touch = pressing.indent(self.profile(now), n("press_depth"), (layer,))
            move = (n("shift_x"), n("shift_y"))
            return pressing.dragged(touch, move, math.radians(n("twist")), n("friction"))

        def moved(self, x, y, depth):
            """(3, ...) mm along x, y and into the gel: how the elastic skin moves what rests at (x, y, -depth); what
            lies deeper than the gel, as its inner face."""
            n = self.number
            return self.touching().moved(x, y, (n("press_x"), n("press_y")), min(depth, n("thickness")))

        def sheared(self, x, y, depth):
            """(3, ...) mm along x, y and into the gel: what a drag of the indenter does to points that rest at
            (x, y, -depth)."""
            n = self.number
            if n("press_depth") <= 0 or not (n("shift_x") or n("shift_y") or n("twist")):
                return 0.0, 0.0, 0.0
            alone = pressing.shear_alone(self.touching())
            return alone.moved(x, y, (n("press_x"), n("press_y")), min(depth, n("thickness")))

        def heights(self, x, y):
            """z of the coated face (mm) at x (columns,) and y (rows,), mm, with every `surface` effect: (rows,
            columns)."""
            n = self.number
            x, y = np.asarray(x, float)[None, :], np.asarray(y, float)[:, None]
            if self.elastic:
                self._map, self.touch = None, self.touching().touch
                z = -self.moved(x, y, 0.0)[2]
            else:
                self.map, self.touch = self.press()
                z = -contact.surface(x, y, n("press_x"), n("press_y"), self.map)
            if (face := self.rest_face()) is not None:
                z = z + face.height(x, y)
            for function in self.functions("surface"):
                z = z + function(x, y, self)
            return z

        def axes(self):
            """Coordinates of the grid's columns and rows, mm."""
            n = self.number
            half = (n("width") / 2, n("length") / 2)
            return tuple(
                contact.graded_axis(-h, h, n(press), min(self.extent, h), self.pitch, count)
                for h, press, count in zip(half, ("press_x", "press_y"), (self.columns, self.rows))
            )

        def rebuild(self, params):
            """Vertices of the face for the present parameters."""
            xs, ys = self.axes()
            z = chord_corrected(self.heights(xs, ys), xs, ys)
            self.level = not np.ptp(z)
            x, y = np.broadcast_to(xs, z.shape), np.broadcast_to(ys[:, None], z.shape)
            params["vertex_positions"] = mi.Float(np.stack([x, y, z], -1).astype(np.float32).ravel())
            params.update()

        def contact_weight(self, x, y):
            """1 inside the contact, 0 outside, at points (x, y) of any shape."""
            from scipy.ndimage import map_coordinates

            values, pitch = self.touch.values, self.touch.pitch
            middle = (len(values) - 1) / 2
            at = [
                (np.asarray(y) - self.number("press_y")) / pitch + middle,
                (np.asarray(x) - self.number("press_x")) / pitch + middle,
            ]
            return map_coordinates(values, at, order=1, mode="constant")

        def beside(self, p):
            """1 where the plate between the balls touches the face at the point p, 0 on a ball, and where no plate of
            balls is pressed; Dr.Jit."""
            n = self.number if self.recalled is None else self.recalled.__getitem__
            shape = self.indenter if self.recalled is None else self.recalled["indenter"]
            return 1 - self.touched(p) if shape == "balls" and n("press_depth") > 0 else dr.zeros(mi.Float, 1)

        def stretched(self, p):
            """J - 1 of the face at the point p, as the gel's `stretch` parameters state it; 0 where nothing is pressed;
            Dr.Jit."""
            n = self.number if self.recalled is None else self.recalled.__getitem__
            if n("press_depth") <= 0:
                return dr.zeros(mi.Float, 1)
            s, x, y, xx, xy, yy = (dr.opaque(mi.Float, n(name)) for name in contact.STRETCH)
            return s + (x + xx * p.x + xy * p.y) * p.x + (y + yy * p.y) * p.y

        def recall(self, values):
            """Let `touched` and `length_inside` answer for another geometry than the mesh is in: the gel's values by
            name; None: its own."""
            self.recalled = values
            self.deep = None if values is None else dr.opaque(mi.Float, values["thickness"])

        def touched(self, p):
            """1 where the indenter touches the face at the point p, 0 elsewhere; Dr.Jit."""
            n = self.number if self.recalled is None else self.recalled.__getitem__
            touch = self.touch if self.recalled is None else self.press(self.recalled)[1]
            if self.seen_touch is not touch:
                self.seen_touch = touch
                values = np.ascontiguousarray(touch.values[..., None], np.float32)
                self.touch_texture = mi.Texture2f(
                    mi.TensorXf(values),
                    use_accel=False,  # of texture units, whose weights have eight bits
                    filter_mode=dr.FilterMode.Linear,
                    wrap_mode=dr.WrapMode.Clamp,
                )
            # opaque: numbers would be compiled into a kernel for each press
            width = dr.opaque(mi.Float, len(touch.values) * touch.pitch)
            u, v = ((x - dr.opaque(mi.Float, n(key))) / width + 0.5 for x, key in ((p.x, "press_x"), (p.y, "press_y")))
            return self.touch_texture.eval(mi.Point2f(u, v))[0]

        # -- the way of light in the gel ------------------------------------------------------------------------------
        def length_inside(self, p, q):
            """Length (mm) of the part of the segment p-q that lies in the gel, z > -thickness, for p inside."""
            thickness = self.thickness if self.deep is None else self.deep
            share = (p.z + thickness) / dr.maximum(p.z - q.z, 1e-6)
            share = dr.select(q.z >= -thickness, 1.0, dr.clip(share, 0, 1))
            # of light from all around p is q, where the norm has no derivative
            return dr.sqrt(dr.maximum(dr.squared_norm(q - p), 1e-12)) * share

        def path(self, p, camera, lamp, led, si):
            return Path(self, p, camera, lamp, led, si)

        def to_string(self):
            return f"Gel[{self.name}]"

    return Gel


def chord_corrected(z, x, y):
    """Vertex heights whose linear interpolation has the surface's mean: z - (h_x^2 z_xx + h_y^2 z_yy)/12.

    A mesh with its vertices on a dent lies inside the dent, by h^2/12 of its curvature on average; uncorrected,
    cast shadows come out shorter, by 0.01 px at a pitch of 0.06 mm, which a calibration on many frames notices."""
    import numpy as np

    out = z.copy()
    hx, hy = np.diff(x), np.diff(y)
    out[:, 1:-1] -= (
        (np.diff(z, axis=1)[:, 1:] / hx[1:] - np.diff(z, axis=1)[:, :-1] / hx[:-1]) * (hx[1:] + hx[:-1]) / 24
    )
    out[1:-1] -= (np.diff(z, axis=0)[1:] / hy[1:, None] - np.diff(z, axis=0)[:-1] / hy[:-1, None]) * (
        (hy[1:] + hy[:-1]) / 24
    )[:, None]
    return out


class Path:
    """What a `segment` or `volume` function sees: lit point, camera, lamp, LED and the lengths inside the gel
    (mm)."""

    def __init__(self, gel, p, camera, lamp, led, si):
        self.p, self.camera, self.lamp, self.led, self.si = p, camera, lamp, led, si
        self.view = gel.length_inside(p, camera)
        self.light = gel.length_inside(p, lamp)
        self.wavelengths = si.wavelengths


def check_sphere():
    """Inside the contact the face is the ball: a cap of the height d - R + sqrt(R^2 - r^2); at rest it is flat."""
    import numpy as np

    r, radius, depth = np.array([0.0, 0.3, 0.6]), 1.5, 0.5
    pressed = made("gel", press_depth=depth, indenter_size=radius, press_x=0.7, bsdf={"type": "membrane"})
    # mm; the map's pitch is 0.03 mm: a sagitta of 0.03^2/8/1.5 = 1e-4, and smoothing
    agree(pressed.heights(0.7 + r, [0.0])[0], -(depth - radius + np.sqrt(radius**2 - r**2)), 0, 2e-3)
    agree(made("gel", bsdf={"type": "membrane"}).heights(r, r), np.zeros((3, 3)))


def random(rng):
    """A ball or an edge of a few millimetres, pressed by less than half of its size, beside the middle."""
    size = rng.uniform(1, 3)
    place = {f"press_{axis}": rng.uniform(-2, 2) for axis in "xy"}
    return {"indenter_size": size, "press_depth": size * rng.uniform(0.1, 0.4), **place}


part = Part("gel", "shape", PARAMETERS, build, checks=(check_sphere,), random=random)
