"""Target: a solid body in front of the sensor, a cylinder or a ball, for what the camera sees through the skin and what
presses it.

Definition
    stance lying      a cylinder, axis along x at z = distance + diameter/2, from x - length/2 to x + length/2
    stance standing   a cylinder, axis along z at (x, y), flat end towards the sensor, from z = distance to z = distance
                      + length
    stance ball       a ball of the diameter, its middle at (x, y, distance + diameter/2)
The nearest point stands `distance` before the untouched face at z = 0; a negative distance is that of an object that
presses it: a `block` gives way to it, a `gel` has a press of its own.
Fingerprint
    its image shrinks with the distance, as 1/(distance + camera's distance from the face).
Validity
    circles are polygons of 256 sides, inside them by 8e-5 of the radius. Coordinates (u, v) on it, for maps of light
    and patterns, are fine on what looks at the sensor and coarse behind; they jump nowhere in view.
References
    Vi2TaP (RA-L 2025), Fig. 5: cylinders of 20, 30 and 40 mm diameter, 60 to 10 mm before the skin.
"""

from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.mitsuba_parts import Declared
from optics.scene.parameter import Parameter

PARAMETERS = (
    Parameter(
        "diameter", "mm", 20.0, (0.1, 1000.0), "of the cylinder or ball", plausible=0.1, how="difference", step=1.0
    ),
    Parameter(
        "length", "mm", 80.0, (0.1, 2000.0), "of the cylinder along its axis", plausible=0.2, how="difference", step=1.0
    ),
    Parameter(
        "distance",
        "mm",
        20.0,
        (-5.0, 2000.0),
        "from the untouched face to its nearest point",
        role="distance",
        plausible=0.2,
        how="difference",
        step=1.0,
    ),
    Parameter("x", "mm", 0.0, (-1000.0, 1000.0), "its middle, right", plausible=0.2, how="difference", step=1.0),
    Parameter("y", "mm", 0.0, (-1000.0, 1000.0), "its middle, down", plausible=0.2, how="difference", step=1.0),
    Parameter(
        "stance",
        "-",
        "lying",
        choices=("lying", "standing", "ball"),
        doc="a cylinder lying across the view along x, one standing on end, or a ball",
    ),
)
SEGMENTS = 256  # around the axis
ROWS = 130  # from pole to pole
EDGES = (
    0,
    32,
    33,
    49,
    81,
    97,
    98,
    130,
)  # of a cylinder: middle, rim of the end, of the mantle, two of the mantle, and back
FINE = 10.0  # mm of a lying cylinder to either side of its middle, that have four fifths of the coordinate u
NEAR = 48  # of the segments to either side of its nearest line, that have four fifths of v


def build():
    import mitsuba as mi
    import numpy as np

    from optics.skin import lattice

    class Target(Declared.on_mesh()):
        kind = "target"

        def __init__(self, props):
            index = np.arange((ROWS + 1) * (SEGMENTS + 1)).reshape(ROWS + 1, SEGMENTS + 1)
            a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
            faces = np.stack([a, c, b, a, d, c], -1).reshape(-1, 3)
            mi.Mesh.__init__(self, "target", index.size, len(faces), props, True, True)
            self.declare(props)
            angle = 2 * np.pi * (np.arange(SEGMENTS + 1) / SEGMENTS - 0.5)  # the seam lies opposite to the nearest line
            angle[-1] = angle[0]  # of the same point
            self.circle = np.stack([np.cos(angle), np.sin(angle)], -1)
            params = mi.traverse(self)
            params["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
            self.rebuild(params)

        def profile(self):
            """(ROWS + 1,) distance from the axis and place along it, from pole to pole, mm."""
            n = self.number
            radius, length = n("diameter") / 2, n("length")
            row = np.arange(ROWS + 1)
            if self.stance == "ball":
                angle = np.pi * row / ROWS
                return radius * np.sin(angle), radius * (1 - np.cos(angle))
            fine = min(FINE, 0.4 * length) if self.stance == "lying" else 0.25 * length
            along = (0.0, 0.0, 0.0, length / 2 - fine, length / 2 + fine, length, length, length)
            return np.interp(row, EDGES, (0.0, *[radius] * 6, 0.0)), np.interp(row, EDGES, along)

        def coordinates(self):
            """(ROWS + 1, SEGMENTS + 1, 2) u, v."""
            row, column = np.arange(ROWS + 1), np.arange(SEGMENTS + 1)
            if self.stance == "lying":
                u = np.interp(row, EDGES, (0, 0.05, 0.05, 0.1, 0.9, 0.95, 0.95, 1))
                v = np.interp(column - SEGMENTS / 2, (-SEGMENTS / 2, -NEAR, NEAR, SEGMENTS / 2), (0, 0.1, 0.9, 1))
                return np.stack(np.meshgrid(u, v, indexing="ij"), -1)
            # a disc around the nearest point: of a ball, areas are in proportion
            radius = (
                np.sin(np.pi * row / ROWS / 2)
                if self.stance == "ball"
                else np.interp(row, EDGES, (0, 0.8, 0.8, 0.84, 0.91, 0.95, 0.95, 1))
            )
            return 0.5 + 0.5 * radius[:, None, None] * self.circle

        def rebuild(self, params):
            """Vertices for the present parameters."""
            n = self.number
            radius, (out, along) = n("diameter") / 2, self.profile()
            if (
                self.stance == "lying"
            ):  # rows: directions of the circle and of the axis; a corner lies nearest to the face
                across, axis = np.array([(0.0, 0.0, -1.0), (0.0, 1.0, 0.0)]), np.array([-1.0, 0.0, 0.0])
                start = np.array([n("x") + n("length") / 2, n("y"), n("distance") + radius])
            else:
                across, axis = np.array([(1.0, 0.0, 0.0), (0.0, -1.0, 0.0)]), np.array([0.0, 0.0, 1.0])
                start = np.array([n("x"), n("y"), n("distance")])
            vertices = start + out[:, None, None] * (self.circle @ across) + along[:, None, None] * axis
            params["vertex_positions"] = mi.Float(vertices.astype(np.float32).ravel())
            params["vertex_texcoords"] = mi.Float(self.coordinates().astype(np.float32).ravel())
            params.update()

        def height(self, x, y):
            """mm of its lower surface above its nearest point, at mm from its own middle; cones of 75 deg in place of
            walls."""
            n = self.number
            if self.stance == "ball":
                return lattice.sphere(n("diameter"))(x, y)
            if self.stance == "standing":
                return lattice.punch(n("diameter"))(x, y)
            over = np.maximum(np.abs(x) - n("length") / 2, 0.0)
            return lattice.sphere(n("diameter"))(0 * x, y) + lattice.STEEPEST * over

        def to_string(self):
            return f"Target[{self.name}]"

    return Target


def check_sizes():
    """The box about a lying and a standing cylinder and about a ball, 7 mm before the face."""
    import mitsuba as mi
    import numpy as np

    size = {"diameter": 20.0, "length": 30.0, "distance": 7.0, "x": 1.0, "y": -2.0}
    boxes = {
        "lying": ((-14, -12, 7), (16, 8, 27)),
        "standing": ((-9, -12, 7), (11, 8, 37)),
        "ball": ((-9, -12, 7), (11, 8, 27)),
    }
    for stance, box in boxes.items():
        points = np.array(mi.traverse(made("target", stance=stance, **size))["vertex_positions"]).reshape(-1, 3)
        agree([points.min(0), points.max(0)], box, 0, 10 * 8e-5)  # polygons of 256 sides


def random(rng):
    """An object of 1 to 4 cm, up to 6 cm before the skin."""
    return {"diameter": rng.uniform(10, 40), "length": rng.uniform(20, 100), "distance": rng.uniform(5, 60)}


part = Part("target", "shape", PARAMETERS, build, checks=(check_sizes,), random=random)
