"""How an indenter presses a soft skin: from its shape and depth to the displaced surface, in numpy, smoothly.

    profile = indenter_profile("sphere", 1.5, (0, 0, 0), extent=4.0, pitch=0.03)       once per indenter
    pressed, contact = displacement(profile, depth=0.5, thickness=2.0, smoothing=0.4)   once per depth
    x = graded_axis(-8, 8, press_x, 2.0, 0.05, 161); y = graded_axis(...)               once per position
    z = -surface(x[None, :], y[:, None], press_x, press_y, pressed)                     height of the membrane, mm
    n = grid_normals(x, y, z)

The indenter comes from +z and pushes the membrane towards the camera (-z). Its own frame has the axes of the world:
u along x, v along y; maps are indexed [v, u]. A rotation (rx, ry, rz) turns about x, then y, then z of that frame.

Everything here is continuous, and all but isolated kinks differentiable, in position, depth, size and smoothing, so
that a calibration may take differences with steps far below the pitch of a grid: no masks, no snapping. Two devices
serve that. Walls steeper than `steepest` become cones (nothing is lost: neither membrane nor mesh follows a vertical
wall), and edges are softened over about one pitch.

Source of the deformation: the GelSight-type supplement, S1.2 (depth kept within the elastomer thickness) and S1.6
(smoothing by pyramid Gaussian kernels, after Si & Yuan, Taxim, RA-L 7, 2361, 2022).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from threading import RLock
from typing import Any, TypeVar

import numpy as np
from cachetools import LRUCache, cached

from optics.errors import UnknownKey
from optics.files.heights import SUFFIXES as MAP_FILES

F = TypeVar("F", bound=Callable)

# the numbers of a skin that state J - 1 = s + sx x + sy y + sxx x^2 + sxy x y + syy y^2, in this order
STRETCH = ("stretch", "stretch_x", "stretch_y", "stretch_xx", "stretch_xy", "stretch_yy")
SHAPES = ("sphere", "cylinder", "cube", "balls")
MESH_FILES = (".stl", ".obj", ".ply")
FILES = (*MESH_FILES, *MAP_FILES)
FARTHEST = 1e4  # mm, of a mesh: no indenter is larger, and the samples along longer sides would fill the memory
FLATTEST = 0.05  # slope that softens the contact edge of flat faces: a twentieth of a pitch of height
STEPS = (10, 24)  # directions from which a parallel face is found: towards the face's normal, and around it
HALVINGS = 40  # of a quarter turn: 1e-12 rad
NEWTON = 20  # steps to a contact line: from the steepest place six are enough for skirts of a tenth of the radius
DETACHING = 0.3  # the weight of contact fades while the smoothed skin goes from 1 to 1.3 times the indenter's depth


KEPT = 2e8  # bytes of maps that each function below keeps: a plate of balls has maps of 10 MB, and many of them


def kept(size: Callable[[Any], int]) -> Callable[[F], F]:
    """Keep the latest results of a function, at least one; `size`: the bytes of one, with what it works out later."""
    return cached(LRUCache(KEPT, getsizeof=lambda made: min(size(made), KEPT)), lock=RLock())


# -- Maps ------------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class LocalMap:
    """A quantity around the press axis: values [v, u] at `axis` x `axis`, zero outside, twice differentiable.

    values  (n, n) float64, n odd; zero with zero slope at the border
    pitch   mm
    """

    values: np.ndarray
    pitch: float

    def __array__(self, dtype=None, copy=None):
        return np.array(self.values, dtype=dtype, copy=copy)

    @property
    def axis(self) -> np.ndarray:
        """Coordinates u = v of the nodes, mm from the press axis."""
        return local_axis(len(self.values), self.pitch)

    @property
    def volume(self) -> float:
        """Integral over the plane (mm^3 for a map in mm)."""
        return float(self.values.sum() * self.pitch**2)

    @cached_property
    def coefficients(self) -> np.ndarray:
        """Weights of the cubic B-splines that pass through the values; three rows and columns of zeros around."""
        from scipy.linalg import solveh_banded

        n = len(self.values)
        bands = np.array([np.full(n, 1 / 6), np.full(n, 4 / 6)])
        solved = solveh_banded(bands, solveh_banded(bands, self.values, check_finite=False).T, check_finite=False).T
        return np.pad(solved, 3)


def local_axis(n: int, pitch: float) -> np.ndarray:
    return pitch * (np.arange(n) - (n - 1) / 2)


def smooth_step(q: np.ndarray) -> np.ndarray:
    """3 q^2 - 2 q^3: from 0 to 1 over q = 0..1 with zero slope at both ends; q must lie in there."""
    return q * q * (3.0 - 2.0 * q)


def soft_ramp(t: np.ndarray, e: np.ndarray) -> np.ndarray:
    """max(t, 0) with its corner rounded over |t| < e (integral of smooth_step): exact outside, 0.19 e too high at 0."""
    q = np.clip(t / (2.0 * e) + 0.5, 0.0, 1.0)
    return np.where(t < e, e * q**3 * (2.0 - q), t)


@lru_cache(maxsize=64)
def window(n: int) -> np.ndarray:
    """(n,) 1 inside, falling over the outer eighth of the half width to exactly 0 in the last two nodes, C2."""
    half = (n - 1) / 2
    taper = max(6.0, half / 8)
    q = np.clip((half - 1 - np.abs(np.arange(n) - half)) / taper, 0.0, 1.0)
    return q**3 * (10.0 - 15.0 * q + 6.0 * q * q)


def gaussian_blur(a: np.ndarray, sd: float) -> np.ndarray:
    """Periodic convolution with the discrete Gaussian of standard deviation `sd` (in nodes), smooth in sd from 0 on.

    Transfer function exp(-sd^2 (1 - cos k)) per axis (Lindeberg 1990): positive, unit sum and variance exactly sd^2
    also below one node, where a sampled Gaussian fails. Returns a square of an FFT-friendly size >= that of `a`, which
    is filled up with zeros."""
    from scipy.fft import irfft2, next_fast_len, rfft2

    m = next_fast_len(max(a.shape), real=True)
    k = 2.0 * np.pi / m * np.arange(m)
    transfer = np.exp(-(sd**2) * (1.0 - np.cos(k)))
    spectrum = rfft2(a, (m, m))
    spectrum *= transfer[:, None]
    spectrum *= transfer[: m // 2 + 1]
    return np.maximum(irfft2(spectrum, (m, m), overwrite_x=True), 0.0)


# -- Indenters -------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class RestFace:
    """A face that is not level, z = level + share (z0 - level), z0 = (xx x^2 + 2 xy x y + yy y^2)/2, away from the
    camera.

    xx, xy, yy        1/mm
    press_x, press_y  mm, where the axis of an indenter meets it
    level             mm, z of the plane that the depth of the press is counted from
    share             of z0 that is left while the indenter presses
    """

    xx: float
    xy: float
    yy: float
    press_x: float = 0.0
    press_y: float = 0.0
    level: float = 0.0
    share: float = 1.0

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """z in mm at x and y of the sensor, mm."""
        z0 = (self.xx * x * x + 2 * self.xy * x * y + self.yy * y * y) / 2
        return self.level + self.share * (z0 - self.level)

    def around(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """mm by which it stands out over its level, at u and v from the indenter's axis, mm."""
        return self.height(u + self.press_x, v + self.press_y) - self.level


@dataclass(frozen=True, eq=False)
class Balls:
    """One ball on the axis, or a square grid of them on a turned plate.

    radius   mm;   slope  beyond which each goes on as a cone (`Profile.envelope`)
    spacing  mm from middle to middle; 0: one ball
    turn     (3, 3) of the plate: balls stay balls, and stand where they are turned to
    tall     height over width of each: 1 of a ball, less of a flattened one
    face     of the skin at rest; None: level
    """

    radius: float
    slope: float
    spacing: float = 0.0
    turn: np.ndarray = field(default_factory=lambda: np.eye(3))
    tall: float = 1.0
    face: RestFace | None = None

    def places(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(u, v) as rows and columns of balls (2, ...), and the whole numbers of the nearest ball."""
        if not self.spacing:
            return np.zeros((2, *u.shape)), np.zeros((2, *u.shape), int)
        (a, b), (c, d) = np.linalg.inv(self.turn[:2, :2] * self.spacing)
        at = np.stack([a * u + b * v, c * u + d * v])
        return at, np.rint(at).astype(int)

    def distance(self, at: np.ndarray, number: np.ndarray) -> np.ndarray:
        """Horizontal distance from the axes of balls, mm; of rows and columns as `places` has them."""
        (a, b), (c, d) = self.turn[:2, :2] * self.spacing
        across, along = at - number
        return np.hypot(a * across + b * along, c * across + d * along)

    def rise(self, number: np.ndarray) -> np.ndarray:
        """mm by which the lowest points of balls (2, ...) stand above that of the ball on the axis; over a curved face,
        less what the face stands out to each."""
        rise = np.einsum("j,j...->...", self.turn[2, :2] * self.spacing, number)
        return rise if self.face is None else rise - self.face.around(*self.middle(number))

    def middle(self, number: np.ndarray) -> np.ndarray:
        """(2, ...) u and v of the middles of balls, mm."""
        return np.einsum("ij,j...->i...", self.turn[:2, :2] * self.spacing, number)

    def lower(self, r: np.ndarray) -> np.ndarray:
        """Height of a ball's lower side at the distance r from its axis, over its lowest point, mm."""
        slope = self.slope / self.tall  # of the ball that is as tall as wide
        edge = self.radius * slope / math.hypot(1.0, slope)
        inner = np.minimum(r, edge)
        return self.tall * (self.radius - np.sqrt(self.radius**2 - inner**2) + slope * (r - inner))

    def contact_line(self, depth: np.ndarray, skirt: float) -> np.ndarray:
        """Radius (mm) at which a skirt leaves a ball, where depth - lower(r) = skirt d lower/dr; 0 where it is not
        touched. On the ball r = R sin t, and

            f(t) = depth/tall - R + R cos t - skirt tan t = 0

        falls ever faster, so that Newton's steps from beyond the root end there."""
        steepest = math.atan(self.slope / self.tall)
        t = np.full(np.shape(depth), steepest)

        def excess(t):
            return depth / self.tall - self.radius * (1 - np.cos(t)) - skirt * np.tan(t)

        beyond = np.maximum(excess(t), 0.0) / (self.slope / self.tall)  # of deep contacts, on the cone
        for _ in range(NEWTON):
            t = np.clip(t + excess(t) / (self.radius * np.sin(t) + skirt / np.cos(t) ** 2), 0.0, steepest)
        return np.where(depth > 0, self.radius * np.sin(t) + beyond, 0.0)

    def fillet(self, depth: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """(r where an arc of this radius leaves a ball, r where it meets the untouched face), mm; 0 and 0 of a ball
        that does not touch. The arc's middle lies a radius above the face, and beside the ball's point at the angle t,
        from its lowest point, by a radius along the normal n there:

            f(t) = depth - tall R (1 - cos t) - radius (1 - n_z) = 0,   n = (tall sin t, cos t)/norm

        falls all the way, so that halving finds it."""
        deep = np.asarray(depth, float)
        low, high = np.zeros(deep.shape), np.full(deep.shape, math.atan(self.slope / self.tall))
        for _ in range(HALVINGS):
            t = (low + high) / 2
            normal = np.cos(t) / np.hypot(self.tall * np.sin(t), np.cos(t))
            above = deep - self.tall * self.radius * (1 - np.cos(t)) - radius * (1 - normal) > 0
            low, high = np.where(above, t, low), np.where(above, high, t)
        across = self.tall * np.sin(low) / np.hypot(self.tall * np.sin(low), np.cos(low))
        leaves = self.radius * np.sin(low)
        return np.where(deep > 0, leaves, 0.0), np.where(deep > 0, leaves + radius * across, 0.0)

    def bridged(self, u: np.ndarray, v: np.ndarray, depth: float, radius: float) -> np.ndarray:
        """Displacement (mm) at (u, v) around the axis with a skin that bends no more sharply than this radius."""
        at, nearest = self.places(u, v)
        low = nearest.reshape(2, -1).min(1)
        every = np.indices(np.ptp(nearest.reshape(2, -1), axis=1) + 1) + low.reshape(2, 1, 1)
        deep = depth - self.rise(every)
        leaves, meets = self.fillet(deep, radius)
        place = tuple(nearest - low.reshape(2, 1, 1))
        r = self.distance(at, nearest) if self.spacing else np.hypot(u, v)
        out = np.clip(meets[place] - r, 0.0, radius)
        return np.where(r < leaves[place], deep[place] - self.lower(r), radius - np.sqrt(radius**2 - out**2))

    def dragged(self, u: np.ndarray, v: np.ndarray, depth: float, skirt: float) -> np.ndarray:
        """Displacement with an exponential skirt (mm) at (u, v) around the axis; see `dragged`."""
        at, nearest = self.places(u, v)
        low = nearest.reshape(2, -1).min(1) - 1
        every = np.indices(np.ptp(nearest.reshape(2, -1), axis=1) + 3) + low.reshape(2, 1, 1)
        deep = depth - self.rise(every)
        line = self.contact_line(deep, skirt)
        edge = np.where(deep > 0, deep - self.lower(line), 0.0)

        def drag(r, number, u, v):
            place = tuple(number - low.reshape(2, *[1] * r.ndim))
            out = np.maximum(r - line[place], 0.0)
            inside, rim = deep[place] - self.lower(r), edge[place]
            if self.face is not None:  # by which the face stands out to a point of the contact more than to its middle
                middle = self.middle(number)
                shrunk = np.minimum(line[place] / np.maximum(r, 1e-12), 1.0)
                foot = middle + shrunk * (np.stack([u, v]) - middle)
                more = self.face.around(*foot) - self.face.around(*middle)
                inside, rim = inside + more, np.maximum(rim + np.where(rim > 0, more, 0.0), 0.0)
            return np.where(r < line[place], inside, rim * np.exp(-out / skirt))

        if not self.spacing:
            return drag(np.hypot(u, v), nearest, u, v)
        found = drag(self.distance(at, nearest), nearest, u, v)
        # Of a tilted plate another of the four balls around may drag more, where it is hardly further: with a margin m
        # r2 - r1 < m asks for S^2 - 2 S f < m (r1 + r2), f the way to the nearest row or column, r1 + r2 < 2.3 S.
        margin = math.inf
        if edge.min() > 0:
            margin = skirt * math.log(edge.max() / edge.min()) + float(np.ptp(line)) + 1e-9
        between = (np.abs(at - nearest) > 0.5 - 1.2 * margin / self.spacing).any(0)
        own, around = at[:, between], np.floor(at[:, between]).astype(int)
        for corner in ((0, 0), (1, 0), (0, 1), (1, 1)):
            number = around + np.reshape(corner, (2, 1))
            others = drag(self.distance(own, number), number, u[between], v[between])
            found[between] = np.maximum(found[between], others)
        return found


@dataclass(frozen=True, eq=False)
class Profile:
    """Lower surface of an indenter: height in mm above its lowest point, on [v, u] = `axis` x `axis`.

    height    (n, n) as seen from below; inf where there is nothing above
    envelope  (n, n) finite: the lowest surface of slope <= tan(steepest) that holds the indenter, which is `height` on
              all but steep parts: min over the indenter's points (u', v', h') of h' + tan(steepest) |(u, v) - (u', v')|
    pitch     mm
    balls     of a sphere, or of a plate of them, whose skirt is a closed form; None: another indenter
    """

    height: np.ndarray
    envelope: np.ndarray
    pitch: float
    balls: Balls | None = None

    @property
    def axis(self) -> np.ndarray:
        return local_axis(len(self.height), self.pitch)

    @cached_property
    def edge_width(self) -> np.ndarray:
        """Height over which the contact edge is softened, mm: one pitch across the edge, times the slope there."""
        dv, du = np.gradient(self.envelope, self.pitch)
        return self.pitch * np.sqrt(du * du + dv * dv + FLATTEST**2)

    @cached_property
    def lowest(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest envelope of every row and of every column, to find the block that a depth can reach."""
        return self.envelope.min(axis=1), self.envelope.min(axis=0)

    def over(self, face: RestFace) -> Profile:
        """The indenter as a face that is not level meets it: its height over each point of that face, less that over a
        level face."""
        return _over(self, face)

    def block(self, height: float) -> tuple[slice, slice]:
        """Rows and columns that hold all nodes whose envelope is below `height`."""
        slices = []
        for low in self.lowest:
            inside = np.flatnonzero(low < height)
            slices.append(slice(inside[0], inside[-1] + 1) if len(inside) else slice(0, 0))
        return tuple(slices)


def indenter_profile(
    shape: str | Path,
    size: float,
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0),
    extent: float = 4.0,
    pitch: float = 0.03,
    steepest: float = 75.0,
    spacing: float = 1.0,
    coat: float = 0.0,
    flattening: float = 0.0,
) -> Profile:
    """Height of an indenter's lower surface above its lowest point, around the indenter's own axis; cached.

    shape     'sphere' (size = radius), 'cylinder' (size = radius, length 4 size, lying along x), 'cube' (size = edge, a
              face down), each centred on the axis; 'balls' (size = radius), a plate of balls without end, one on the
              axis (optics.skin.patterns); a .stl, .obj or .ply file in mm (size = factor on it), whose axis is the z
              axis of its own frame; or a height map (optics.files.heights), .tmd (size = factor on it), .npy or .png
              (size = mm from sample to sample), whose middle is on the axis
    size      mm (mesh: 1), > 0
    rotation  deg about x, then y, then z
    extent    mm, half width of the local grid: at least the contact's half width plus three times the smoothing, over
              0.85, because maps fade out over the outer eighth
    pitch     mm of the local grid; 1/10 of the contact radius or less
    steepest  deg, see Profile.envelope; a sphere is exact down to depth = R (1 - cos(steepest)), 0.74 R
    spacing   mm between the middles of balls
    coat      mm of skin between the indenter and the face that is meant, see `through_coat`
    flattening  1 - height/width of a sphere or of balls: below 0 they are taller than wide; others have none

    Spheres, cubes and cylinders are closed forms. A mesh is sampled once per power of two of its size, at half the
    pitch, and carried to the size asked for by a C2 spline: smooth in size but for a change by interpolation error
    where size passes sqrt(2) times a power of two. Only `envelope` is smooth; `height` is read at the nearest ray.

    Raises UnknownKey (no such shape), FileNotFoundError, ValueError (a number out of range, a file without triangles).
    """
    if not (math.isfinite(size) and size > 0):
        raise ValueError(f"indenter size = {size:g} mm; it must be above 0")
    if not (0 < pitch < extent) or extent / pitch > 2000:
        raise ValueError(
            f"indenter grid: pitch = {pitch:g} mm, extent = {extent:g} mm; need 0 < pitch < extent <= 2000 pitch"
        )
    if not 0 < steepest < 90:
        raise ValueError(f"steepest = {steepest:g} deg; it must lie between 0 and 90 deg, 75 is usual")
    shape, stamp = str(shape), 0
    if shape not in SHAPES:
        if not shape.lower().endswith(FILES):
            hint = f"a mesh must end in {', '.join(MESH_FILES)}, a height map in {', '.join(MAP_FILES)}"
            raise UnknownKey(shape, SHAPES, "indenter shape", hint=hint)
        path = Path(shape).expanduser().resolve()
        if not path.is_file():
            raise FileNotFoundError(f"indenter {path}: no such file; give its path or one of {', '.join(SHAPES)}")
        shape, stamp = str(path), path.stat().st_mtime_ns
    if shape == "balls" and not (math.isfinite(spacing) and spacing >= 2 * size):
        raise ValueError(
            f"indenter balls: spacing = {spacing:g} mm for balls of radius {size:g} mm; it must be {2 * size:g} mm or "
            "more, from middle to middle"
        )
    spacing = float(spacing) if shape == "balls" else 0.0
    if not (math.isfinite(coat) and coat >= 0):
        raise ValueError(f"indenter coat = {coat:g} mm; it must be 0 or more")
    numbers = (float(size), *map(float, rotation), float(extent), float(pitch), float(steepest), spacing)
    if not -1 < flattening < 1:
        raise ValueError(f"indenter flattening = {flattening:g}; it must lie between -1 and 1")
    if shape in ("sphere", "balls"):  # of a ball, the parallel face is a ball, of a flattened one nearly one
        wide, high = size + coat, (1 - flattening) * size + coat
        return _profile(shape, stamp, float(wide), *numbers[1:], high / wide)
    return _through_coat(_profile(shape, stamp, *numbers), float(coat))


@kept(lambda made: 3 * made.height.nbytes)
def _profile(shape, stamp, size, rx, ry, rz, extent, pitch, steepest, spacing, tall=1.0) -> Profile:
    from optics.skin import patterns

    n = 2 * math.ceil(extent / pitch - 1e-9) + 1
    axis, slope = local_axis(n, pitch), math.tan(math.radians(steepest))
    u, v = np.meshgrid(axis, axis)
    turn = rotation_matrix(rx, ry, rz)
    if shape == "sphere":
        height, envelope = (tall * h for h in sphere(u, v, size, slope / tall))
    elif shape == "cube":
        height, envelope = cube(u, v, size, turn, slope)
    elif shape == "cylinder":
        height, envelope = cylinder(u, v, size, turn, slope)
    elif shape == "balls":
        height, envelope = patterns.balls(u, v, size, spacing, turn, slope, tall)
    elif shape.lower().endswith(MAP_FILES):
        height, envelope = patterns.height_map(axis, size, shape, stamp, turn, slope)
    else:
        height, envelope = mesh(axis, size, shape, stamp, (rx, ry, rz), extent, pitch, slope)
    for a in (height, envelope):
        a.flags.writeable = False
    found = {"sphere": Balls(size, slope, tall=tall), "balls": Balls(size, slope, spacing, turn, tall)}
    return Profile(height, envelope, pitch, found.get(shape))


@kept(lambda made: 3 * made.height.nbytes)
def _over(profile: Profile, face: RestFace) -> Profile:
    z0 = face.around(profile.axis[None, :], profile.axis[:, None])
    balls = None if profile.balls is None else replace(profile.balls, face=face)
    return Profile(profile.height - z0, profile.envelope - z0, profile.pitch, balls)


@kept(lambda made: 3 * made.height.nbytes)
def _through_coat(profile: Profile, coat: float) -> Profile:
    if coat == 0:
        return profile
    height = through_coat(profile.envelope, profile.pitch, coat)
    height.flags.writeable = False
    return Profile(height, height, profile.pitch)


def through_coat(height: np.ndarray, pitch: float, coat: float) -> np.ndarray:
    """Of a face that lies on a surface of this height (n, n), the parallel face at the distance `coat` (mm):

        h'(x) = coat + min over |s| <= coat of h(x + s) - sqrt(coat^2 - s^2)

    Flat parts stay, a sphere's radius grows, smooth parts follow h' - h = coat (1 - sqrt(1 + |grad h|^2)), and sharp
    edges get round. The minimum is sought in `STEPS` directions: 1 % of the coat too high, up to 8 % at sharp edges."""
    from scipy.ndimage import shift

    lowest = np.array(height)
    for angle in (np.arange(STEPS[0]) + 1) / STEPS[0] * (math.pi / 2):
        out, up = coat * math.sin(angle) / pitch, coat * (1 - math.cos(angle))
        for turn in 2 * math.pi * np.arange(STEPS[1]) / STEPS[1]:
            there = (-out * math.sin(turn), -out * math.cos(turn))
            moved = shift(height, there, order=1, mode="nearest")
            np.minimum(lowest, moved + up, out=lowest)
    return lowest


def rotation_matrix(rx: float, ry: float, rz: float) -> np.ndarray:
    """Rz Ry Rx for angles in deg, with exact zeros at right angles."""
    matrix = np.eye(3)
    for axis, angle in enumerate((rx, ry, rz)):
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        i, j = (axis + 1) % 3, (axis + 2) % 3
        one = np.eye(3)
        one[i, i], one[i, j], one[j, i], one[j, j] = c, -s, s, c
        matrix = one @ matrix
    matrix[np.abs(matrix) < 1e-15] = 0.0
    return matrix


def sphere(u, v, radius, slope):
    """h = R - sqrt(R^2 - r^2), and its tangent cone beyond r = R sin(steepest)."""
    r = np.hypot(u, v)
    height = np.where(r <= radius, radius - np.sqrt(np.maximum(radius**2 - r**2, 0.0)), np.inf)
    steep = radius * slope / math.hypot(1.0, slope)
    cone = radius - math.sqrt(radius**2 - steep**2) + slope * (r - steep)
    return height, np.where(r <= steep, height, cone)


def cone_over_edge(u, v, a, b, slope):
    """Lowest of h' + slope * distance over the points of the segment from a to b (3-vectors): a cone along an edge.

    With m the edge's rise per horizontal mm and q the distance of (u, v) from its line, the minimum stands
    m q / sqrt(slope^2 - m^2) before the foot of the perpendicular, or at an end.
    """
    if a[2] > b[2]:
        a, b = b, a
    run, rise = math.hypot(b[0] - a[0], b[1] - a[1]), b[2] - a[2]
    x, y = u - a[0], v - a[1]
    if rise >= slope * run * (1 - 1e-12):  # steeper than the cone: its lower end decides
        return a[2] + slope * np.hypot(x, y)
    c, s, m = (b[0] - a[0]) / run, (b[1] - a[1]) / run, rise / run
    along, across = c * x + s * y, np.abs(c * y - s * x)
    at = np.clip(along - m / math.sqrt(slope**2 - m**2) * across, 0.0, run)
    return a[2] + m * at + slope * np.hypot(along - at, across)


def cube(u, v, edge, turn, slope):
    """Entry of vertical rays into a turned cube (slab method); around it the cones over its twelve edges."""
    half = edge / 2
    near, far = np.full(u.shape, -np.inf), np.full(u.shape, np.inf)
    gentle = np.zeros(u.shape, bool)
    for i in range(3):  # along each of the cube's own axes
        start, step = turn[0, i] * u + turn[1, i] * v, turn[2, i]
        if step == 0:
            far = np.where(np.abs(start) <= half, far, -np.inf)
            continue
        enter, leave = (-math.copysign(half, step) - start) / step, (math.copysign(half, step) - start) / step
        gentle = np.where(enter > near, math.hypot(turn[0, i], turn[1, i]) <= slope * abs(step), gentle)
        near, far = np.maximum(near, enter), np.minimum(far, leave)
    corners = np.array([[x, y, z] for x in (-half, half) for y in (-half, half) for z in (-half, half)]) @ turn.T
    base = corners[:, 2].min()
    height = np.where(near <= far, near - base, np.inf)
    envelope = np.where(gentle, height, np.inf)
    for i in range(8):
        for bit in (1, 2, 4):
            if not i & bit:
                ends = corners[i] - (0, 0, base), corners[i | bit] - (0, 0, base)
                envelope = np.minimum(envelope, cone_over_edge(u, v, *ends, slope))
    return height, envelope


def cylinder(u, v, radius, turn, slope, sides=128):
    """Entry of vertical rays into a turned cylinder; around it the cones over its steepest lines and its two rims.

    The rims are polygons of `sides` (inside the circle by 0.03 % of the radius); the rest is exact.
    """
    a, half, flattest = turn[:, 0], 2 * radius, 1 / math.hypot(1.0, slope)
    tilt, level = a[2], 1 - a[2] ** 2
    e1 = turn[:, 1] if level < 1e-12 else np.array([-a[1], a[0], 0]) / math.sqrt(level)
    e2 = np.cross(a, e1)
    height, envelope = np.full(u.shape, np.inf), np.full(u.shape, np.inf)
    if level > 1e-12:  # the mantle
        s = a[0] * u + a[1] * v
        root = (s * tilt) ** 2 - level * (u * u + v * v - s * s - radius**2)
        z = (s * tilt - np.sqrt(np.maximum(root, 0.0))) / level
        along = s + z * tilt
        hit = (root >= 0) & (np.abs(along) <= half)
        height = np.where(hit, z, np.inf)
        envelope = np.where(hit & ((along * tilt - z) >= flattest * radius), z, np.inf)
    if tilt != 0:  # the end that looks down
        m = -math.copysign(1.0, tilt) * a
        z = (half - m[0] * u - m[1] * v) / m[2]
        hit = (u - half * m[0]) ** 2 + (v - half * m[1]) ** 2 + (z - half * m[2]) ** 2 <= radius**2
        height = np.where(hit, np.minimum(height, z), height)
        if -m[2] >= flattest:
            envelope = np.where(hit, np.minimum(envelope, z), envelope)
    outside = np.isinf(envelope)
    x, y = u[outside], v[outside]
    cones = np.full(x.shape, np.inf)
    sine = -flattest / e2[2] if e2[2] else np.inf
    if abs(sine) < 1:
        for cosine in (math.sqrt(1 - sine**2), -math.sqrt(1 - sine**2)):
            line = radius * (cosine * e1 + sine * e2)
            cones = np.minimum(cones, cone_over_edge(x, y, line - half * a, line + half * a, slope))
    angles = 2 * np.pi / sides * np.arange(sides)
    circle = radius * (np.cos(angles)[:, None] * e1 + np.sin(angles)[:, None] * e2)
    base = -radius * math.sqrt(level) - half * abs(tilt)
    for rim in (circle - half * a, circle + half * a):
        cones = np.minimum(cones, cone_over_polygon(x, y, rim, slope))
    envelope[outside] = cones
    return height - base, envelope - base


def cone_over_polygon(u, v, corners, slope):
    """cone_over_edge for the closed polygon: the best corner first, then exactly over its two sides."""
    best, which = np.full(u.shape, np.inf), np.zeros(u.shape, int)
    for i, (x, y, z) in enumerate(corners):
        h = z + slope * np.sqrt((u - x) ** 2 + (v - y) ** 2)
        which = np.where(h < best, i, which)
        best = np.minimum(h, best)
    order = np.argsort(which, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(which[order])) + 1) if len(order) else []
    for group in groups:
        i = which[group[0]]
        for j in (i - 1, (i + 1) % len(corners)):
            side = cone_over_edge(u[group], v[group], corners[i], corners[j], slope)
            best[group] = np.minimum(best[group], side)
    return best


# -- Mesh indenters --------------------------------------------------------------------------------------------------
def mesh(axis, size, path, stamp, rotation, extent, pitch, slope):
    """Height and envelope of a mesh file at axis x axis, from a sampling at the nearest power of two of its size."""
    from scipy.ndimage import map_coordinates

    scale = 2.0 ** round(math.log2(size))
    ray_pitch = pitch / scale / 2
    height, envelope = _mesh_samples(path, stamp, rotation, extent / scale * 1.45, ray_pitch, slope)
    n = len(height)
    at = axis / size / ray_pitch + (n - 1) / 2
    near = np.rint(at).astype(int)
    rows, columns = np.meshgrid(at, at, indexing="ij")
    # without prefilter: C2, never overshoots at kinks, and a curvature c costs only c ray_pitch^2 / 6 of height
    smooth = map_coordinates(envelope, [rows, columns], order=3, prefilter=False, mode="nearest")
    return size * height[np.ix_(near, near)], size * smooth


@lru_cache(maxsize=4)
def _mesh_samples(path, stamp, rotation, extent, pitch, slope):
    """The mesh at size 1: its height at pixel rays, and the envelope of slope <= `slope` under it."""
    import trimesh

    try:
        loaded = trimesh.load(path, force="mesh", process=False)
        triangles = np.asarray(loaded.triangles, float)
    except Exception as error:  # trimesh raises whatever its readers raise
        raise ValueError(f"indenter mesh {path}: cannot be read ({type(error).__name__}: {error})") from error
    if not len(triangles) or triangles.shape[1:] != (3, 3) or not np.isfinite(triangles).all():
        raise ValueError(f"indenter mesh {path}: no triangles with finite corners; export a triangle mesh in mm")
    if np.abs(triangles).max() > FARTHEST:
        raise ValueError(
            f"indenter mesh {path}: a corner {np.abs(triangles).max():.3g} mm from its origin; allowed: up to "
            f"{FARTHEST:g} mm; export it in mm, about its tip"
        )
    triangles = triangles @ rotation_matrix(*rotation).T
    triangles[..., 2] -= triangles[..., 2].min()
    n = 2 * math.ceil(extent / pitch) + 1
    triangles = triangles / pitch + ((n - 1) / 2, (n - 1) / 2, 0)
    height = lower_surface(triangles, n) * pitch
    if np.isinf(height).all():
        raise ValueError(f"indenter mesh {path}: nothing within {extent:.3g} mm of its z axis; move it there")
    return height, cone_envelope(np.minimum(height / pitch, edge_cones(triangles, n, slope)), slope) * pitch


def lower_surface(triangles: np.ndarray, n: int, chunk: int = 4_000_000) -> np.ndarray:
    """(n, n) lowest z over each integer (column x, row y) of triangles (m, 3, 3); inf where there is none."""
    height = np.full(n * n, np.inf)
    low = np.maximum(np.ceil(triangles[..., :2].min(axis=1) - 1e-9).astype(int), 0)
    high = np.minimum(np.floor(triangles[..., :2].max(axis=1) + 1e-9).astype(int), n - 1)
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    ab, ac = b - a, c - a
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    count = np.prod(np.maximum(high - low + 1, 0), axis=1) * (np.abs(area) > 1e-12)
    kept = np.flatnonzero(count)
    parts = np.searchsorted(np.cumsum(count[kept]), np.arange(chunk, count.sum() + chunk, chunk))
    for some in np.split(kept, np.unique(parts)):
        if not len(some):
            continue
        t = np.repeat(some, count[some])
        k = np.arange(len(t)) - np.repeat(np.cumsum(count[some]) - count[some], count[some])
        width = high[t, 0] - low[t, 0] + 1
        x, y = low[t, 0] + k % width, low[t, 1] + k // width
        dx, dy = x - a[t, 0], y - a[t, 1]
        p = (dx * ac[t, 1] - dy * ac[t, 0]) / area[t]
        q = (dy * ab[t, 0] - dx * ab[t, 1]) / area[t]
        hit = (p >= -1e-9) & (q >= -1e-9) & (p + q <= 1 + 1e-9)
        z = a[t, 2] + p * ab[t, 2] + q * ac[t, 2]
        np.minimum.at(height, (y * n + x)[hit], z[hit])
    return height.reshape(n, n)


def edge_cones(triangles: np.ndarray, n: int, slope: float) -> np.ndarray:
    """(n, n) lowest z + slope * distance to points along the triangles' sides less than a node away; inf elsewhere.

    It puts silhouettes and ridges where they are, between the nodes that rays pass.
    """
    out = np.full(n * n, np.inf)
    a, b = triangles.reshape(-1, 3), np.roll(triangles, -1, axis=1).reshape(-1, 3)
    near = (np.maximum(a, b)[:, :2].min(axis=1) > 0) & (np.minimum(a, b)[:, :2].max(axis=1) < n - 1)
    a, b = a[near], b[near]
    count = np.ceil(2 * np.hypot(*(b - a)[:, :2].T)).astype(int) + 2  # points at most half a node apart
    side = np.repeat(np.arange(len(a)), count)
    k = np.arange(len(side)) - np.repeat(np.cumsum(count) - count, count)
    p = a[side] + (b - a)[side] * (k / (count[side] - 1))[:, None]
    p = p[(p[:, :2] > 0).all(axis=1) & (p[:, :2] < n - 1).all(axis=1)]
    first = np.floor(p[:, :2]).astype(int)
    for corner in ((0, 0), (1, 0), (0, 1), (1, 1)):
        node = first + corner
        np.minimum.at(out, node[:, 1] * n + node[:, 0], p[:, 2] + slope * np.hypot(*(p[:, :2] - node).T))
    return out.reshape(n, n)


def cone_envelope(height: np.ndarray, rise: float) -> np.ndarray:
    """min over nodes of height' + rise * distance, distance by steps along 16 directions (0 to 2.7 % too long).

    Steps of doubling length, one direction after the other: exact for that polygonal distance, in log time.
    """
    out = height.copy()
    n = len(out)

    def overlap(shift):
        return slice(max(shift, 0), n + min(shift, 0))

    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2)):
        for sign in (1, -1):
            step = 1
            while step * max(abs(dx), abs(dy)) < n:
                sx, sy = sign * step * dx, sign * step * dy
                to, source = (overlap(sy), overlap(sx)), (overlap(-sy), overlap(-sx))
                out[to] = np.minimum(out[to], out[source] + rise * step * math.hypot(dx, dy))
                step *= 2
    return out


# -- Deformation -----------------------------------------------------------------------------------------------------
@kept(lambda made: sum(2 * one.values.nbytes for one in made))
def displacement(
    profile: Profile,
    depth: float,
    thickness: float,
    smoothing: float,
    levels: int = 4,
    skirt: float = 0.0,
    fillet: float = 0.0,
) -> tuple[LocalMap, LocalMap]:
    """How far a skin is pushed towards the camera, D(u, v) >= 0 in mm, and where it touches (weight 0..1).

    profile    of the indenter
    depth      mm that its lowest point stands below the untouched skin; 0 or less: no contact, D = 0
    thickness  mm of the gel: D0 = clip(depth - h, 0, thickness), h = Profile.envelope
    smoothing  mm, standard deviation of the widest Gaussian; 0: D = D0 but for the last blur
    levels     number of Gaussians, each half as wide as the one before
    skirt      mm over which the skin beside the contact falls to 1/e, see `dragged`; 0: the pyramid alone makes the
               skirt
    fillet     mm, least radius of the skin where it bridges a corner, see `bridged`; 0: it follows

    Pyramid (S1.6): D <- max(D0, G_k * D) for the sd smoothing, smoothing/2, smoothing/4, ... The maximum restores the
    contact after each blur: the skin rests on the indenter where it would otherwise pass through it and leaves it where
    the smoothed skin lies deeper. To restore all of D0 > 0, as S1.6 can be read, would force D to 0 at the rim of D0, a
    groove that no gel shows. The real contact is therefore smaller than that rim, as in Hertz' theory. The weight of
    contact is 1 where G*D <= D0 and 0 where G*D >= 1.3 D0, and falls over the rim of D0 itself within one pitch.

    A last blur without restoring (as in Taxim) rounds what a film would not follow, the maximum's corner included, and
    lets corners pass between nodes without a jolt: sd^2 = (smoothing / 2^levels)^2 + pitch^2. It lowers the cap of a
    sphere by sd^2 / R, about 1 um.

    Both maps fade to zero over the outer eighth of the local grid. Results are cached: do not write into them.
    """
    if not (
        math.isfinite(depth)
        and math.isfinite(smoothing)
        and smoothing >= 0
        and thickness > 0
        and 0 <= skirt < 1e3
        and 0 <= fillet < 1e3
    ):
        raise ValueError(
            f"press: depth = {depth:g} mm, smoothing = {smoothing:g} mm, thickness = {thickness:g} mm, skirt = "
            f"{skirt:g} mm, fillet = {fillet:g} mm; "
            "need finite depth, smoothing >= 0, thickness > 0, skirt >= 0 and fillet >= 0"
        )
    n, pitch = len(profile.height), profile.pitch
    pressed, touch = np.zeros((n, n)), np.zeros((n, n))
    if depth <= 0:
        return LocalMap(pressed, pitch), LocalMap(touch, pitch)
    block = profile.block(2 * depth)  # the softened rim ends at height < 2 depth; all beyond is exactly 0
    t, e = depth - profile.envelope[block], profile.edge_width[block]
    e = e * depth / (e + depth)  # never above the depth, so that D0 -> 0 with it
    d0 = soft_ramp(t, e)
    if 2 * depth > thickness:
        d0 = d0 - soft_ramp(t - thickness, e)
    weight = smooth_step(np.clip(t / (2 * e) + 0.5, 0.0, 1.0))
    pressed[block] = d0
    if skirt > 0 or fillet > 0:
        bare = pressed
        if skirt > 0:
            pressed = dragged(profile, bare, depth, thickness, skirt)
        if fillet > 0:
            pressed = np.maximum(pressed, bridged(profile, bare, depth, thickness, fillet))
        weight = weight * (1.0 - smooth_step(np.clip((pressed[block] - d0) / (DETACHING * d0 + 1e-300), 0.0, 1.0)))
        block = (slice(0, n), slice(0, n))  # the skirt belongs to what the blurs below must not take away
        d0, touch[profile.block(2 * depth)] = pressed, weight
        weight = touch
    if smoothing > 0 and levels > 0:
        for level in range(levels):
            pressed = gaussian_blur(pressed, smoothing / pitch / 2**level)
            above = pressed[block] - d0
            np.maximum(pressed[block], d0, out=pressed[block])
        weight = weight * (1.0 - smooth_step(np.clip(above / (DETACHING * d0 + 1e-300), 0.0, 1.0)))
    pressed = gaussian_blur(pressed, math.hypot(smoothing / pitch / 2**levels, 1.0))[:n, :n]
    touch[block] = weight
    w = window(n)
    return LocalMap(pressed * w * w[:, None], pitch), LocalMap(touch * w * w[:, None], pitch)


def dragged(profile: Profile, d0: np.ndarray, depth: float, thickness: float, skirt: float) -> np.ndarray:
    """Displacement with an exponential skirt: D(x) = max over points p of D0(p) exp(-|x - p| / skirt), mm.

    Every touched point drags the skin around it, and the drag falls by 1/e over `skirt`; the strongest wins. The skin
    leaves the indenter where its slope is D0 / skirt, without a kink, and goes on as an exponential. (A membrane under
    tension T on a bed of stiffness k falls over sqrt(T/k) in the same way, but for the curvature of the contact line.)
    For balls the contact line is the root of D0(r) = skirt D0'(r), a closed form otherwise; other indenters take the
    cone envelope of -log D0 on the grid, whose distances are up to 2.7 % too long.
    """
    if profile.balls is None or depth >= thickness:
        low = -np.log(np.maximum(d0, 1e-12))
        return np.exp(-cone_envelope(low, profile.pitch / skirt))
    return profile.balls.dragged(*np.meshgrid(profile.axis, profile.axis), depth, skirt)


def bridged(profile: Profile, d0: np.ndarray, depth: float, thickness: float, radius: float) -> np.ndarray:
    """Displacement of a skin that bends no more sharply than a radius where it bridges a corner, mm: its closing by a
    ball of that radius, which rolls over it on the gel's side and reaches no further.

    Between a ball and the face beside it this is an arc that is tangent to both (a membrane under the tension T that a
    pressure p holds against them has the radius T/p); of balls a closed form, of other indenters and over a curved face
    found on the grid, up to 3 % of the radius too deep."""
    if profile.balls is None or profile.balls.face is not None or depth >= thickness:
        grown = -through_coat(-d0, profile.pitch, radius)
        return np.maximum(through_coat(grown, profile.pitch, radius), d0)
    return profile.balls.bridged(*np.meshgrid(profile.axis, profile.axis), depth, radius)


@kept(lambda made: 2 * made.values.nbytes)
def ring_bulge(pressed: LocalMap, contact: LocalMap, spread: float) -> LocalMap:
    """Ring that an incompressible gel raises around a contact, b(u, v) >= 0 in mm away from the camera (+z).

        b = V w (G * D) / integral of w (G * D),    V = integral of D dA,    G = Gaussian of sd `spread`
        w = (1 - c) (1 - step(min(1, (g * c) / 0.4))),    step(q) = 3 q^2 - 2 q^3,    g = Gaussian of sd a/3

    D displacement, c contact weight, a = sqrt(contact area / pi). Scaled by a strength s, z = -D + s b: at s = 1 the
    volume that the indenter took reappears in full, at 0 none of it (the gel is compressible or flows elsewhere). w is
    0 in the contact, where the skin follows the indenter, and rises over a/3 around it, so that the ring starts without
    a step. For a small contact G * D is V times the Gaussian itself; a long one raises a long ring.

    spread  mm; the gel thickness is the natural value (a bonded layer passes stress on over about its thickness)

    The map is wider (by four spreads) and coarser (spread/16 at most) than `pressed`. What would be raised beyond the
    border of the gel is lost there."""
    if not spread > 0:
        raise ValueError(f"ring spread = {spread:g} mm; it must be above 0, the gel thickness is usual")
    n, pitch = len(pressed.values), pressed.pitch
    stride = max(1, int(spread / 16 / pitch))
    coarse = stride * pitch
    m = 2 * math.ceil(((n - 1) / 2 * pitch + 4 * spread) / coarse) + 1
    volume = pressed.volume
    if volume <= 0:
        return LocalMap(np.zeros((m, m)), coarse)
    hats = _hats(n, stride, m)
    d, c = hats @ pressed.values @ hats.T, hats @ contact.values @ hats.T
    radius = math.sqrt(contact.volume / math.pi)
    near = gaussian_blur(c, math.hypot(radius / 3 / coarse, 1.0))[:m, :m]
    w = window(m)
    ring = gaussian_blur(d, spread / coarse)[:m, :m] * w * w[:, None]
    ring *= (1.0 - np.minimum(c, 1.0)) * (1.0 - smooth_step(np.minimum(near / 0.4, 1.0)))
    total = ring.sum() * coarse**2
    return LocalMap(ring * (volume / total), coarse)


@lru_cache(maxsize=8)
def _hats(n: int, stride: int, m: int) -> np.ndarray:
    """(m, n) means over hats of half width `stride`: to a coarser grid about the same centre, sums preserved."""
    fine, coarse = (np.arange(n) - (n - 1) / 2) / stride, np.arange(m) - (m - 1) / 2
    return np.maximum(0.0, 1.0 - np.abs(fine - coarse[:, None])) / stride


# -- Surface ---------------------------------------------------------------------------------------------------------
def spline_weights(at: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """First index into padded coefficients and the four cubic B-spline weights (4, ...) at positions in nodes."""
    at = np.clip(at, -2.0, n + 1.0)  # beyond, all four weights fall on the zeros around
    first = np.minimum(np.floor(at), n)
    f = at - first
    g = 1.0 - f
    weights = np.array([g**3, 4 - 6 * f * f + 3 * f**3, 4 - 6 * g * g + 3 * g**3, f**3]) / 6
    return first.astype(int) + 2, weights


def surface(x: np.ndarray, y: np.ndarray, press_x: float, press_y: float, local_map: LocalMap) -> np.ndarray:
    """Value of a local map centred on (press_x, press_y) at world points, by cubic B-spline (C2); zero outside.

    x, y  mm, broadcast together. Fastest as a grid: x of shape (1, nx) and y of shape (ny, 1).
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    c, n, pitch = local_map.coefficients, len(local_map.values), local_map.pitch
    i, wx = spline_weights((x - press_x) / pitch + (n - 1) / 2, n)
    j, wy = spline_weights((y - press_y) / pitch + (n - 1) / 2, n)
    if x.ndim == y.ndim == 2 and x.shape[0] == 1 and y.shape[1] == 1:
        i, j = i[0], j[:, 0]
        rows = sum(wy[k] * c[j + k] for k in range(4))
        return sum(rows[:, i + k] * wx[k] for k in range(4))
    z = 0.0
    for k in range(4):
        z = z + wy[k] * sum(wx[m] * c[j + k, i + m] for m in range(4))
    return z


def graded_axis(
    low: float, high: float, centre: float, fine_half_width: float, fine_pitch: float, count: int
) -> np.ndarray:
    """(count,) coordinates from low to high: fine_pitch within centre +- fine_half_width, growing outside.

    The pitch is fine_pitch + g * (distance from the fine zone), a geometric growth, and g is what makes the count come
    out: the coordinates are the inverse of the integral of 1/pitch at equal steps, once continuously differentiable in
    the centre wherever that lies, inside, across the border or far off. Where the count would allow a finer pitch than
    fine_pitch all over, the axis is uniform.

    Raises ValueError if low >= high or the count is too small for the fine zone.
    """
    from scipy.optimize import brentq

    if not (low < high and fine_pitch > 0 and fine_half_width >= 0 and math.isfinite(centre)):
        raise ValueError(
            f"axis from {low:g} to {high:g} mm with a fine zone of {centre:g} +- {fine_half_width:g} mm at "
            f"{fine_pitch:g} mm; need low < high, a finite centre, half width >= 0 and pitch > 0"
        )
    steps, p, w = count - 1, fine_pitch, fine_half_width
    if steps * p >= high - low:
        return np.linspace(low, high, count)
    if steps < 2 * w / p + 8:
        raise ValueError(
            f"axis of {count} points: the fine zone alone takes {2 * w / p:.0f}; allow at least "
            f"{2 * w / p + 9:.0f} points, or widen its pitch ({p:g} mm) or narrow it ({2 * w:g} mm)"
        )

    def counted(x, g):  # points from the centre to x
        far = abs(x - centre)
        return math.copysign(min(far, w) / p + math.log1p(g * max(far - w, 0.0) / p) / g, x - centre)

    def excess(g):
        return counted(high, g) - counted(low, g) - steps

    top = 1.0
    while excess(top) > 0:
        top *= 4
    g = brentq(excess, 1e-9, top, xtol=1e-15, rtol=1e-14) if excess(1e-9) > 0 else 1e-9
    k = np.linspace(counted(low, g), counted(high, g), count)
    far = np.maximum(np.abs(k) - w / p, 0.0)
    x = centre + np.sign(k) * (p * np.minimum(np.abs(k), w / p) + p / g * np.expm1(g * far))
    x[0], x[-1] = low, high
    return x


def grid_normals(x_axis: np.ndarray, y_axis: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(ny, nx, 3) unit normals (z_x, z_y, -1) / norm of the surface z (ny, nx): towards the camera at z < 0.

    Slopes by differences of second order on uneven axes, also at the border.
    """
    zy, zx = np.gradient(z, y_axis, x_axis, edge_order=2)
    n = np.stack([zx, zy, np.full_like(z, -1.0)], axis=-1)
    return n / np.sqrt(zx * zx + zy * zy + 1.0)[..., None]
