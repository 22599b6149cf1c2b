"""Carried sheet: a thin sheet in the soft skin, or its inner face, that goes along when the face is pressed.

Definition
    (x, y, -depth) -> (x + u_x, y + u_y, -depth - u_z)       u: displacement of an incompressible half-space at that
    depth
                                                             under the gel's dent D (optics.skin.halfspace)
A rectangle `width` x `length` around the world's z axis, `depth` below the untouched face at z = 0; it lies flat while
the gel is not pressed. Its texture coordinates are those of the place at rest, u = x/width + 1/2, v = y/length + 1/2:
the first direction runs along x at rest and turns with the sheet. Its normals look at the camera, towards -z. A layer
on it (a polarizer film, a stressed plate) moves, tilts and turns with it.
Fingerprint
    a press tilts and shifts the sheet over about its depth around the contact; without a press nothing.
Validity
    dents shallower than `depth`, small strains; effects of the face's shape other than the press are not carried. The
    sheet stretches with the skin and does not stiffen it: a film resists. On the mesh of `columns` x `rows` vertices
    (XML integers, 121 x 109) heights are linear and the first direction is constant in each triangle.
References
    Vi2TaP (RA-L 2025), II.B: a film embedded in a silicone skin of 5 mm. Johnson, Contact Mechanics (1985), 3.2.
XML
    columns integer, 121: vertices of the mesh along x
    rows integer, 109: vertices of the mesh along y
"""

from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.mitsuba_parts import Declared
from optics.scene.parameter import Parameter

PARAMETERS = (
    Parameter(
        "width", "mm", 48.0, (0.1, 1000.0), "size along x", plausible=0.1, how="difference", step=1.0, role="width"
    ),
    Parameter(
        "length", "mm", 43.0, (0.1, 1000.0), "size along y", plausible=0.1, how="difference", step=1.0, role="length"
    ),
    Parameter(
        "depth",
        "mm",
        2.5,
        (0.0, 100.0),
        "below the untouched face; at most the gel's thickness",
        plausible=0.1,
        how="difference",
        step=1.0,
    ),
)


def build():
    import mitsuba as mi
    import numpy as np

    from optics.skin.halfspace import displaced

    class Carried(Declared.on_mesh()):
        kind = "carried"
        moved_by = "gel"
        carrier = None

        def __init__(self, props):
            self.columns, self.rows = int(props.get("columns", 121)), int(props.get("rows", 109))
            index = np.arange(self.columns * self.rows).reshape(self.rows, self.columns)
            a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
            faces = np.stack([a, d, c, a, c, b], -1)  # normals towards the camera (-z)
            mi.Mesh.__init__(self, "carried", index.size, faces.size // 3, props, True, True)
            self.declare(props)
            self.u, self.v = np.linspace(0, 1, self.columns)[None, :], np.linspace(0, 1, self.rows)[:, None]
            params = mi.traverse(self)
            params["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
            uv = np.stack(np.broadcast_arrays(self.u, self.v), -1)
            params["vertex_texcoords"] = mi.Float(uv.astype(np.float32).ravel())
            self.rebuild(params)

        def wire(self, scene):
            self.carrier = scene.one("gel")
            self.follow(self.carrier)

        def rebuild(self, params):
            """Vertices for the present parameters and dent."""
            n = self.number
            points = displaced(self.carrier, (self.u - 0.5) * n("width"), (self.v - 0.5) * n("length"), n("depth"))
            params["vertex_positions"] = mi.Float(points.astype(np.float32).ravel())
            params.update()

        def to_string(self):
            return f"Carried[{self.name}]"

    return Carried


def check_flat_at_rest():
    """Without a press the sheet is the rectangle at its depth, its first direction along x."""
    import mitsuba as mi
    import numpy as np

    sheet = made("carried", width=8.0, length=6.0, depth=2.5, columns=3, rows=2, bsdf={"type": "sheet"})
    found = np.array(mi.traverse(sheet)["vertex_positions"]).reshape(2, 3, 3)
    x, y = np.meshgrid([-4.0, 0.0, 4.0], [-3.0, 3.0])
    agree(found, np.stack([x, y, np.full_like(x, -2.5)], -1), 0, 1e-6)


part = Part("carried", "shape", PARAMETERS, build, checks=(check_flat_at_rest,))
