"""Block: the body of a printed grid, which gives way to a target that presses its face.

Definition
    -thickness < z < 0, |x| < width/2, |y| < length/2 at rest; the face at z = -thickness is glued, the others are free.
A `target` in the scene with distance < 0 is pressed -distance into the face at z = 0. How the body gives way is that of
springs between the corners of cubes (D3Q14, optics.skin.lattice), between them a cubic spline; the cells of a grid are
carried along. Where the target touches, it is in optical contact: its surface lies inside the body, by 5 micrometres,
so that light that would be totally reflected meets it instead.
Fingerprint
    the touched cells change from what total reflection shows to the colour of what touches, lit through the walls;
    around it the walls' lines bend, the wider the deeper.
Validity
    one elastic material without friction, glued to a rigid base; what is printed of two is their mixture
    (lattice.grid_material). The whole touched area is in contact: no rough gap.
References
    Fan, Li, Cong & Zhang, MagicGripper, supplementary VII-A, eqs. (4)-(17); physics of the contact: III.B and Fig. 4.
XML
    layers integer, 7: cubes of the lattice through the thickness
    pitch float, 0.1: mm, of the mesh of the faces
"""

from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.mitsuba_parts import Declared
from optics.scene.parameter import Parameter

PARAMETERS = (
    Parameter("width", "mm", 16.4, (0.1, 1000.0), "size along x", plausible=0.1, how="difference", step=1.0),
    Parameter("length", "mm", 16.4, (0.1, 1000.0), "size along y", plausible=0.1, how="difference", step=1.0),
    Parameter(
        "thickness",
        "mm",
        5.5,
        (0.01, 100.0),
        "from the glued to the touched face",
        plausible=0.1,
        how="difference",
        step=1.0,
    ),
    Parameter(
        "young",
        "MPa",
        0.6,
        (1e-4, 1e5),
        "Young's modulus, for forces: shapes do not depend on it",
        plausible=0.1,
        how="difference",
    ),
    Parameter("poisson", "1", 0.45, (0.0, 0.49), "Poisson's ratio", plausible=0.01, how="difference", step=1.0),
)
REACH = 0.005  # mm: how far a target lies inside the body that it touches
CLING = 0.03  # of the lattice's pitch: gaps that close, as the spline sags between corners that touch
DENSITY = 1.1  # g/cm^3: nothing depends on it at rest


def build():
    import mitsuba as mi
    import numpy as np
    from scipy.ndimage import map_coordinates, spline_filter

    from optics.skin import lattice

    class Block(Declared.on_mesh()):
        kind = "block"
        moved_by = "target"
        target = None

        def __init__(self, props):
            self.layers = int(props.get("layers", 7))  # of the lattice
            self.pitch = float(props.get("pitch", 0.1))  # mm, of the mesh of the face
            props["face_normals"] = True
            counts = [
                max(int(np.ceil(float(props.get(n, d)) / self.pitch)), 1)
                for n, d in (("width", 16.4), ("length", 16.4))
            ]
            self.counts = (*counts, 4 * self.layers)
            faces, self.sides, number = box_faces(self.counts)
            mi.Mesh.__init__(self, "block", number, len(faces), props, False, False)
            self.declare(props)
            self.pressed, self.pressed_by = None, None
            params = mi.traverse(self)
            params["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
            self.rebuild(params)

        def wire(self, scene):
            self.target = scene.one("target")
            self.follow(self.target)

        def at_rest(self):
            """(N, 3) vertices of the untouched body, mm; those of the touched face come first."""
            return box_points(self.sides, [self.number(n) for n in ("width", "length", "thickness")])

        # -- the press ------------------------------------------------------------------------------------------------
        def press(self):
            """The lattice under the present target (optics.skin.lattice.Deformed), or None where no corner is reached;
            kept."""
            target = self.target
            if target is None or target.number("distance") >= 0:
                return None
            n, t = self.number, target.number
            key = tuple(n(p) for p in self.numbers) + tuple(t(p) for p in target.numbers) + (target.stance,)
            if key != self.pressed_by:
                pitch = n("thickness") / self.layers
                shape = tuple(int(np.ceil(n(side) / pitch - 1e-9)) + 1 for side in ("width", "length")) + (
                    self.layers + 1,
                )
                skin = lattice.Lattice(shape, pitch, lattice.Material(n("young"), n("poisson"), DENSITY))
                at = skin.positions[:, :, -1]
                reached = (target.height(at[..., 0] - t("x"), at[..., 1] - t("y")) < -t("distance")).any()
                push = lattice.Push(target.height, -t("distance"), (t("x"), t("y")))
                self.pressed, self.pressed_by = lattice.balance(skin, push) if reached else None, key
                if reached:
                    self.splines = [
                        spline_filter(self.pressed.displacement[..., a], 3, mode="nearest") for a in range(3)
                    ]
            return self.pressed

        def displacement(self, points):
            """(..., 3) mm by which points of the body at rest (..., 3) move: a cubic spline through the lattice's
            nodes."""
            pressed, points = self.press(), np.asarray(points, float)
            if pressed is None:
                return np.zeros_like(points)
            size = np.array(pressed.lattice.shape)
            at = points / pressed.lattice.pitch + [(size[0] - 1) / 2, (size[1] - 1) / 2, size[2] - 1]
            at = np.moveaxis(np.clip(at, 0, size - 1), -1, 0)
            return np.stack(
                [map_coordinates(s, at, order=3, mode="nearest", prefilter=False) for s in self.splines], -1
            )

        def rebuild(self, params):
            """Vertices for the present parameters and press."""
            rest = self.at_rest()
            vertices = rest + self.displacement(rest)
            target = self.target
            if target is not None and target.number("distance") < 0:
                face = vertices[rest[:, 2] == 0]
                surface = target.number("distance") + target.height(
                    face[:, 0] - target.number("x"), face[:, 1] - target.number("y")
                )
                gap = np.maximum(surface - face[:, 2], 0.0)
                near = np.exp(-((gap / (CLING * self.number("thickness") / self.layers)) ** 2))
                face[:, 2] = surface - gap + near * (gap + REACH)
                vertices[rest[:, 2] == 0] = face
            params["vertex_positions"] = mi.Float(vertices.astype(np.float32).ravel())
            params.update()

        def to_string(self):
            return f"Block[{self.name}]"

    return Block


def box_faces(counts):
    """Triangles of the six sides of a box, its sides, and the number of vertices: a grid on each side, of
    (columns, rows) or along z."""
    import numpy as np

    nx, ny, nz = counts
    found, sides, first = [], [], 0
    for axis, end in ((2, 1), (2, 0), (0, 0), (0, 1), (1, 0), (1, 1)):
        across = [a for a in range(3) if a != axis]
        size = [1 + (nx, ny, nz)[a] for a in across]
        index = first + np.arange(size[0] * size[1]).reshape(size)
        a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
        quads = np.stack([a, b, c, a, c, d], -1).reshape(-1, 3)
        outwards = (end == 1) != (axis == 1)  # x cross z is -y
        found.append(quads if outwards else quads[:, ::-1])
        sides.append((axis, end, across, size))
        first += index.size
    return np.concatenate(found), sides, first


def box_points(sides, extent):
    """(N, 3) mm, the vertices of the sides of a box of this extent below z = 0, in the order of `box_faces`."""
    import numpy as np

    extent = np.array(extent)
    low = np.array([-extent[0] / 2, -extent[1] / 2, -extent[2]])
    points = []
    for axis, end, across, size in sides:
        share = np.empty((*size, 3))
        share[..., axis] = end
        for a, grid in zip(across, np.meshgrid(*(np.linspace(0, 1, n) for n in size), indexing="ij")):
            share[..., a] = grid
        points.append((low + share * extent).reshape(-1, 3))
    return np.concatenate(points)


def check_closed_box():
    """At rest the mesh is a closed box: by the divergence theorem its faces, normals outwards, hold width x length x
    thickness."""
    import mitsuba as mi
    import numpy as np

    body = made("block", width=3.0, length=2.0, thickness=1.5, pitch=0.5, layers=2, bsdf={"type": "clear"})
    held = mi.traverse(body)
    points = np.array(held["vertex_positions"], float).reshape(-1, 3)
    a, b, c = (points[np.array(held["faces"]).reshape(-1, 3)[:, i]] for i in range(3))
    agree((a * np.cross(b, c)).sum() / 6, 9.0, 1e-5)
    agree([points.min(0), points.max(0)], [[-1.5, -1, -1.5], [1.5, 1, 0]], 0, 1e-6)


def random(rng):
    """A soft print of a few millimetres."""
    return {"thickness": rng.uniform(3, 8), "young": rng.uniform(0.1, 2), "poisson": rng.uniform(0.3, 0.49)}


part = Part("block", "shape", PARAMETERS, build, checks=(check_closed_box,), random=random)
