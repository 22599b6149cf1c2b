"""Markers: short cylinders in rows and columns on the skin's inner face, carried along when the skin is pressed.

Definition
    base   (x, y, -depth) -> (x + u_x, y + u_y, -depth - u_z)     middle of a marker's foot; u as in the part `carried`
    axis   across the face: normal to its mean slopes over the foot, (u(x + r) - u(x - r))/(2r)
    cap    base + height axis, radius r, facing the camera (-z)
`columns` x `rows` of them (XML integers, 5 x 4) at pitch_x, pitch_y around the world's z axis. The cap moves as a rigid
disc, the foot's rim stays on the face, and the wall runs straight between them, so that no light passes under a marker
on a bent face. The foot is open: the skin is there.
Fingerprint
    a press moves markers outwards and towards the camera and tilts them away from the contact.
Validity
    markers as soft as the skin or small against the bend of its face; otherwise as for the part `carried`.
References
    Vi2TaP (RA-L 2025), II.B: 5 x 4 markers, 9.5 x 8.5 mm apart, cast in holes of 1.5 mm radius and 1 mm depth.
XML
    columns integer, 5: markers along x
    rows integer, 4: markers along y
"""

from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.mitsuba_parts import Declared
from optics.scene.parameter import Parameter

PARAMETERS = (
    Parameter("pitch_x", "mm", 9.5, (0.0, 100.0), "distance of columns", plausible=0.05, how="difference", step=1.0),
    Parameter("pitch_y", "mm", 8.5, (0.0, 100.0), "distance of rows", plausible=0.05, how="difference", step=1.0),
    Parameter("radius", "mm", 1.5, (0.01, 50.0), "radius r", plausible=0.05, how="difference", step=1.0),
    Parameter(
        "height", "mm", 1.0, (0.001, 50.0), "from the face to the cap", plausible=0.05, how="difference", step=1.0
    ),
    Parameter(
        "depth",
        "mm",
        5.0,
        (0.0, 100.0),
        "of the face that they stand on, below the untouched outer face",
        plausible=0.1,
        how="difference",
        step=1.0,
    ),
)
SEGMENTS = 96  # of a circle: 0.07 % of the area is lost


def build():
    import mitsuba as mi
    import numpy as np

    from optics.skin.halfspace import displaced

    class Markers(Declared.on_mesh()):
        kind = "markers"
        moved_by = "gel"
        carrier = None

        def __init__(self, props):
            self.columns, self.rows = int(props.get("columns", 5)), int(props.get("rows", 4))
            count = self.columns * self.rows
            i = np.arange(SEGMENTS)
            j = (i + 1) % SEGMENTS
            foot, top, rim, middle = (
                i,
                i + SEGMENTS,
                i + 2 * SEGMENTS,
                3 * SEGMENTS,
            )  # the cap's rim is its own: a sharp edge
            faces = np.concatenate(
                [
                    np.stack([foot, foot[j], top[j]], -1),
                    np.stack([foot, top[j], top], -1),
                    np.stack([rim, rim[j], np.full_like(i, middle)], -1),
                ]
            )
            faces = faces + (middle + 1) * np.arange(count)[:, None, None]
            mi.Mesh.__init__(self, "markers", (middle + 1) * count, faces.size // 3, props, True, False)
            self.declare(props)
            angle = 2 * np.pi / SEGMENTS * i
            self.circle = np.stack([np.cos(angle), -np.sin(angle)], -1)  # counterclockwise as the camera sees it
            params = mi.traverse(self)
            params["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
            self.rebuild(params)

        def wire(self, scene):
            self.carrier = scene.one("gel")
            self.follow(self.carrier)

        def rest(self):
            """(N, 2) places (x, y) of the feet's middles at rest, mm: row by row, from low y to high and from low x to
            high."""
            x = self.number("pitch_x") * (np.arange(self.columns) - (self.columns - 1) / 2)
            y = self.number("pitch_y") * (np.arange(self.rows) - (self.rows - 1) / 2)
            return np.stack([np.tile(x, self.rows), np.repeat(y, self.columns)], -1)

        def centres(self):
            """(N, 3) present middles of the caps, mm, in the order of `rest`."""
            return self.caps.copy()

        def centres_at_rest(self):
            """(N, 3) middles of the caps while nothing presses, mm, in the order of `rest`."""
            flat = np.full((self.columns * self.rows, 1), -(self.number("depth") + self.number("height")))
            return np.concatenate([self.rest(), flat], -1)

        def rebuild(self, params):
            """Vertices for the present parameters and dent."""
            n = self.number
            radius = n("radius")
            # the foot's middle, four points of its rim along x and y, and the rim itself
            around = radius * np.concatenate([[(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)], self.circle])
            at = self.rest()[:, None] + around
            points = displaced(self.carrier, at[..., 0], at[..., 1], n("depth"))
            base, foot = points[:, 0], points[:, 5:]
            axis = np.cross(points[:, 3] - points[:, 4], points[:, 1] - points[:, 2])  # y cross x: towards the camera
            axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
            e1 = points[:, 1] - points[:, 2]
            e1 /= np.linalg.norm(e1, axis=-1, keepdims=True)
            e2 = np.cross(e1, axis)  # y, at rest
            self.caps = base + n("height") * axis
            rim = self.caps[:, None] + radius * (self.circle[:, :1] * e1[:, None] + self.circle[:, 1:] * e2[:, None])
            vertices = np.concatenate([foot, rim, rim, self.caps[:, None]], 1)
            params["vertex_positions"] = mi.Float(vertices.astype(np.float32).ravel())
            params.update()

        def to_string(self):
            return f"Markers[{self.name}]"

    return Markers


def check_rows_and_columns():
    """Two by three caps, a height of 1 mm above the face that is 5 mm deep, at their pitches around the middle."""
    import numpy as np

    size = {"columns": 2, "rows": 3, "pitch_x": 6.0, "pitch_y": 4.0, "height": 1.0, "depth": 5.0}
    caps = made("markers", **size, bsdf={"type": "fluorescent"}).centres()
    x, y = np.meshgrid([-3.0, 3.0], [-4.0, 0.0, 4.0])
    agree(caps, np.stack([x.ravel(), y.ravel(), np.full(6, -6.0)], -1), 0, 1e-6)
    agree(caps, made("markers", **size, bsdf={"type": "fluorescent"}).centres_at_rest(), 0, 1e-6)


def random(rng):
    """Markers that leave at least half of the face free."""
    pitch = rng.uniform(4, 12)
    return {"pitch_x": pitch, "pitch_y": pitch, "radius": pitch * rng.uniform(0.1, 0.3)}


part = Part("markers", "shape", PARAMETERS, build, checks=(check_rows_and_columns,), random=random)
