"""Board: a rigid carrier of LEDs, such as the ring around a lens or a flexible print along a window's edge.

Definition
    S = o + R (s cos(t) x - s sin(t) y, s sin(t) x + s cos(t) y, z)
places an LED that names the board: its x, y, z (mm) and its `turn` t are in the board's plane and along its axis, s is
`scale` and o = (x, y, z) the board's origin. R turns about the x axis by rx, then about y by ry, then about z by rz, by
the right hand. The LED's `target` is a point of the board's frame as well, so that its axis turns with the board.
    An LED names its board, <string name="board" value="ring"/>, and may take its x and y from the pick-and-place file
that the board was populated by, <string name="placed" value="board.csv:D7"/>.
    One pose stands for the places of all LEDs: a board that is 1 mm off moves them alike, one of unknown size scales
them, and LEDs of a circle stay on a circle, wherever on it each is soldered (`turn`).
Fingerprint
    an origin that is off makes the LEDs of one side nearer and those of the other farther; a scale or height that is
    wrong makes all shading too steep or too flat.
Validity
    the board itself is not seen: it casts no shadow and returns no light ('light from the surrounding face').
References
    three rotations one after the other: Goldstein, Classical Mechanics, 4.4.
"""

from optics.scene.boards import on_board
from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.mitsuba_parts import Declared
from optics.scene.parameter import Parameter

PARAMETERS = (
    *(
        Parameter(axis, "mm", 0.0, doc=f"origin o, {where}", plausible=0.5, step=0.2)
        for axis, where in (
            ("x", "to the right in the image"),
            ("y", "down in the image"),
            ("z", "from the camera towards the skin"),
        )
    ),
    *(
        Parameter(f"r{axis}", "deg", 0.0, (-180.0, 180.0), f"turn about the {axis} axis", plausible=1.0, step=0.2)
        for axis in "xyz"
    ),
    Parameter("scale", "1", 1.0, (0.01, 100.0), "scale s of the places in the board's plane", plausible=0.05, step=0.2),
)


def build():
    import drjit as dr
    import mitsuba as mi

    class Board(Declared.on(mi.Emitter)):
        kind = "board"

        def __init__(self, props):
            mi.Emitter.__init__(self, props)
            self.declare(props)
            self.m_flags = +mi.EmitterFlags.Empty
            self.m_needs_sample_2 = self.m_needs_sample_3 = False

        # -- places ---------------------------------------------------------------------------------------------------
        def turned(self, v):
            """R v, for a vector of the board's frame."""
            for angle, (i, j) in ((self.rx, (1, 2)), (self.ry, (2, 0)), (self.rz, (0, 1))):
                sin, cos = dr.sincos(dr.deg2rad(angle))
                w = [v.x, v.y, v.z]
                w[i], w[j] = cos * w[i] - sin * w[j], sin * w[i] + cos * w[j]
                v = mi.Vector3f(*w)
            return v

        def about_axis(self, v, turn, scale=1.0):
            """A vector of the board's frame, turned by `turn` (deg) about its axis and scaled across it."""
            sin, cos = dr.sincos(dr.deg2rad(turn))
            return mi.Vector3f(scale * (cos * v.x - sin * v.y), scale * (sin * v.x + cos * v.y), v.z)

        def place(self, at, turn):
            """Where a point `at` of the board's frame stands, mm."""
            return mi.Point3f(self.x, self.y, self.z) + self.turned(self.about_axis(mi.Vector3f(at), turn, self.scale))

        def stands(self, at, turn):
            """The same in numbers, without waiting for the device."""
            return tuple(map(float, on_board(at, turn, self.held)))

        # -- Mitsuba: it sends no light -------------------------------------------------------------------------------
        def sample_direction(self, it, sample, active=True):
            return dr.zeros(mi.DirectionSample3f), mi.Spectrum(0.0)

        def eval_direction(self, it, ds, active=True):
            return mi.Spectrum(0.0)

        def pdf_direction(self, it, ds, active=True):
            return mi.Float(0.0)

        def eval(self, si, active=True):
            return mi.Spectrum(0.0)

        def bbox(self):
            return mi.ScalarBoundingBox3f(mi.ScalarPoint3f(*[self.number(n) for n in "xyz"]))

        def traverse(self, cb):
            self.put_parameters(cb)

        def parameters_changed(self, keys=()):
            self.reread(keys)

        def to_string(self):
            return f"Board[{self.name}]"

    return Board


def check_places():
    """A quarter of a turn about each axis; scale and turn in the plane; axes stay at right angles."""
    import mitsuba as mi
    import numpy as np

    def at(place, turn=0.0, **pose):
        board = made("board", **{"x": 9.0, "y": 9.0, "z": 9.0, **pose})  # a middle, against which rounding is small
        return np.array(board.place(mi.Point3f(*(float(c) for c in place)), mi.Float(turn)), float).ravel() - 8.0

    agree(at((1.0, 2.0, 3.0), x=10.0, y=20.0, z=30.0), [3.0, 14.0, 25.0], 1e-5)
    agree(at((0.0, 1.0, 0.0), rx=90.0), [1.0, 1.0, 2.0], 1e-5)
    agree(at((0.0, 0.0, 1.0), ry=90.0), [2.0, 1.0, 1.0], 1e-5)
    agree(at((1.0, 0.0, 0.0), rz=90.0), [1.0, 2.0, 1.0], 1e-5)
    agree(at((1.0, 0.0, 2.0), turn=90.0, scale=3.0), [1.0, 4.0, 3.0], 1e-5)
    # about fixed axes, x first
    agree(at((0.0, 1.0, 0.0), rx=90.0, ry=90.0), [2.0, 1.0, 1.0], 1e-5)
    pose = {"rx": 20.0, "ry": -35.0, "rz": 50.0, "scale": 1.0}
    axes = np.array([at(e, 15.0, **pose) for e in np.eye(3)]) - 1.0
    agree(1 + axes @ axes.T, 1 + np.eye(3), 1e-5)


def random(rng):
    """A board some millimetres from where it was drawn."""
    return {"x": rng.uniform(-1, 1), "y": rng.uniform(-1, 1), "rx": rng.uniform(-3, 3), "scale": rng.uniform(0.9, 1.1)}


part = Part("board", "emitter", PARAMETERS, build, (check_places,), random=random)
