"""Beads: thousands of small balls at random places in the gel, one geometry, carried along when the skin is pressed.

Definition
    s_j = ((width - D)(a_j - 1/2), (length - D)(b_j - 1/2), -(top + (bottom - top) c_j))    at rest, mm
        + settling (D_j/D)^2 (cos(gravity), sin(gravity), 0)     Stokes: large beads sink faster
    D_j = D exp(spread n_j - spread^2/2)                         diameters; D: `diameter`
    s_j -> s_j + u(s_j)                                          u: displacement in the pressed skin
with a, b, c uniform in 0 to 1 and n normal, drawn once from the seed: the same XML gives the same beads. Where a bead
would overlap one that is there already, its place is drawn again; if that fails too often the beads do not fit, and the
scene is refused. `width`, `length`, `top` and `bottom` stretch the places that were drawn. A bead moves as the point at
its middle does and stays round.
Fingerprint
    a press moves every bead by its own amount, by its depth and its distance from the press.
Validity
    beads much stiffer than the gel and small against the bend of its displacement; they do not hold the gel back. The
    ball is a polyhedron of 80, 320 or 1280 faces (`detail` 1, 2, 3) with a ball's mean silhouette; with 320 it departs
    from a circle by up to 1 % of the radius.
References
    Sensors 19 (2019) 928, section 2: balls of 0.5 to 0.6 mm in a gel of 30 x 30 x 4.5 mm; Widom, J. Chem. Phys. 44
    (1966) 3888, for random sequential addition.
XML
    count integer, 1000: number of beads
    seed integer, 0: of the draw
    detail integer, 2: subdivisions of an icosahedron, 1 to 4
    fine integer, 1: 1 to 6; cells of a pixel, 10 across the radius of a bead, and twice as many in all for each step
    places string, drawn: a table of measured places in place of the draw, .csv with the columns x, y, depth and perhaps
        diameter, mm, at rest; `count`, `width`, `length`, `top` and `bottom` then say nothing, nor do `diameter` and
        `spread` beside measured diameters
"""

from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.mitsuba_parts import Declared
from optics.scene.parameter import Parameter
from optics.scene.regions import found_file

PARAMETERS = (
    Parameter(
        "width", "mm", 30.0, (0.1, 1000.0), "of the body that holds them, along x", plausible=0.1, how="difference"
    ),
    Parameter("length", "mm", 30.0, (0.1, 1000.0), "of that body, along y", plausible=0.1, how="difference"),
    Parameter(
        "top", "mm", 0.4, (0.0, 100.0), "depth of the highest middles below the face", plausible=0.1, how="difference"
    ),
    Parameter(
        "bottom", "mm", 4.1, (0.0, 100.0), "depth of the lowest middles below the face", plausible=0.1, how="difference"
    ),
    Parameter("diameter", "mm", 0.55, (0.001, 50.0), "mean diameter D", plausible=0.02, how="difference"),
    Parameter(
        "spread",
        "1",
        0.0,
        (-0.5, 0.5),
        "relative standard deviation of the diameters",
        neutral=0.0,
        plausible=0.05,
        how="difference",
        step=0.4,
    ),
    Parameter(
        "settling",
        "mm",
        0.0,
        (-5.0, 5.0),
        "way that a bead of the mean diameter sank while the gel was soft",
        neutral=0.0,
        plausible=0.2,
        how="difference",
    ),
    Parameter(
        "gravity",
        "deg",
        90.0,
        (-360.0, 360.0),
        "which way was down in the mould, from x (right) to y (down)",
        plausible=20.0,
        how="difference",
        step=0.4,
    ),
)
TRIES = 400  # draws of a bead's place before it counts as not fitting


def build():
    import mitsuba as mi
    import numpy as np
    import trimesh

    from optics.skin.cloud import draw, read_places, sizes
    from optics.skin.halfspace import carried_points

    class Beads(Declared.on_mesh()):
        kind = "beads"
        moved_by = "gel"
        carrier = None
        aside = False  # whether the mesh waits
        times = 0  # how often the beads were placed
        version = 0  # how often `put` was called

        def __init__(self, props):
            self.count, self.seed = int(props.get("count", 1000)), int(props.get("seed", 0))
            table = str(props.get("places", "drawn"))
            self.given, self.measured = None, None  # places and diameters that are known
            if table != "drawn":
                self.given, self.measured = read_places(found_file([str(f) for f in mi.file_resolver()], table))
                self.count = len(self.given)
            self.detail = int(props.get("detail", 2))
            self.fine = int(props.get("fine", 1))
            if self.count < 1 or not 1 <= self.detail <= 4 or not 1 <= self.fine <= 6:
                raise ValueError(
                    f"beads: count = {self.count}, detail = {self.detail}, fine = {self.fine}; allowed: at least 1 "
                    "bead, a detail of 1 to 4, fine of 1 to 6"
                )
            ball = trimesh.creation.icosphere(subdivisions=self.detail)
            # Cauchy: the mean silhouette of a convex body is a quarter of its surface
            self.ball = ball.vertices * (4 * np.pi / ball.area) ** 0.5
            n = len(self.ball)
            faces = ball.faces + n * np.arange(self.count)[:, None, None]
            mi.Mesh.__init__(self, "beads", n * self.count, faces.size // 3, props, True, False)
            self.declare(props)
            own = self.number
            if not own("top") < own("bottom"):
                raise ValueError(
                    f"beads '{self.name}': top = {own('top'):g} mm, bottom = {own('bottom'):g} mm; allowed: a "
                    "top above the bottom"
                )
            if self.given is None:
                self.drawn = draw(self.count, self.box(), self.diameters(), self.seed, self.name, TRIES)
            params = mi.traverse(self)
            params["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
            self.rebuild(params)

        def wire(self, scene):
            self.carrier = scene.one("gel")
            self.follow(self.carrier)

        def box(self):
            """Sizes of the box that holds the middles, mm."""
            n = self.number
            return n("width") - n("diameter"), n("length") - n("diameter"), n("bottom") - n("top")

        def layer(self):
            """Depths of the highest and of the lowest middle below the face, mm."""
            return self.number("top"), self.number("bottom")

        def takes(self, name):
            if name in ("spread", "diameter") and self.measured is not None:
                return False
            return self.given is None or name not in ("width", "length", "top", "bottom")

        def put(self, points, diameters=None):
            """Take (N, 3) places at rest in the world, mm, and (N,) diameters as known; they show when the part is
            placed next."""
            if len(points) != self.count:
                raise ValueError(f"beads '{self.name}': {len(points)} places for {self.count} beads")
            self.given = np.array(points, float)
            self.measured = None if diameters is None else np.array(diameters, float)
            self.version += 1

        def diameters(self):
            """(N,) mm."""
            if self.measured is not None:
                return self.measured
            return sizes(self.count, self.number("diameter"), self.number("spread"), self.seed)

        def sunk(self):
            """(N, 3) mm that the beads have sunk."""
            down = np.radians(self.number("gravity"))
            way = self.number("settling") * (self.diameters() / self.number("diameter")) ** 2
            return way[:, None] * [np.cos(down), np.sin(down), 0.0]

        def rest(self):
            """(N, 3) middles in the world while nothing presses, mm."""
            points = self.given
            if points is None:
                points = (self.drawn - [0.5, 0.5, 0.0]) * self.box()
                points = points * [1, 1, -1] - [0, 0, self.number("top")]
            return points + self.sunk()

        def centres(self):
            """(N, 3) present middles in the world, mm, in the order of `rest`."""
            return self.middles.copy()

        def balls(self):
            """(N, 3) present middles and (N,) radii, mm: what is traced as balls (optics.scene.crowd)."""
            return self.middles, self.diameters() / 2

        def rebuild(self, params):
            """Vertices for the present parameters and dent."""
            self.middles = carried_points(self.carrier, self.rest())
            self.times += 1
            if self.aside:
                return
            radii = self.diameters()[:, None, None] / 2
            vertices = self.middles[:, None].astype(np.float32) + (radii * self.ball).astype(np.float32)
            params["vertex_positions"] = mi.Float(vertices.ravel())
            params.update()

        def to_string(self):
            return f"Beads[{self.name}, {self.count}]"

    return Beads


def check_places():
    """As many beads as were asked for, none overlapping, all inside; the same seed, the same places."""
    import numpy as np
    from scipy.spatial import cKDTree

    size = {"width": 6.0, "length": 5.0, "top": 0.4, "bottom": 3.6, "diameter": 0.6, "count": 80, "detail": 1}
    one, same, other = (made("beads", **size, seed=s, bsdf={"type": "fluorescent"}).centres() for s in (3, 3, 4))
    assert one.shape == (80, 3) and np.abs(one - other).max() > 1
    agree(one, same)
    assert cKDTree(one).query(one, 2)[0][:, 1].min() >= 0.6 - 1e-9
    assert np.all(np.abs(one[:, 0]) <= 2.7) and np.all(np.abs(one[:, 1]) <= 2.2)
    assert np.all((one[:, 2] >= -3.6) & (one[:, 2] <= -0.4))


def random(rng):
    """Beads of half a millimetre, near the face or deep."""
    top = rng.uniform(0.3, 1.0)
    return {"top": top, "bottom": top + rng.uniform(2.0, 4.0), "diameter": rng.uniform(0.3, 0.7)}


part = Part("beads", "shape", PARAMETERS, build, checks=(check_places,), random=random)
