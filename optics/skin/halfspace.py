"""How a dent of the skin's face carries along what lies deeper: a soft incompressible half-space, in Fourier space.

    ux, uy, uz = carried(pressed, pressed.pitch, depth)         displacement at a depth, three maps around the press
    axis
    points = displaced(gel, x, y, depth)                        where the skin's points at (x, y, -depth) are now, mm
    q, u = stress_integrals(pressed, pressed.pitch, h1, h2)     stress differences that light collects between two
    depths

The face of the body h >= 0 (h = -z: depth, towards the camera) is pushed in by D(x, y) without friction. With the
transform f^ = integral f exp(-i(kx x + ky y)), k = |(kx, ky)|, the shear modulus G and Poisson's ratio nu:

    uz^ =  D^ (1 + kh/(2(1 - nu))) exp(-kh)                     along h, positive where D is
    ux^ =  D^ (i kx/k) ((1 - 2 nu) - kh)/(2(1 - nu)) exp(-kh)   and uy^ with ky
    p^  =  G k D^/(1 - nu)                                      pressure that makes the dent
    (s_xx - s_yy)^ = -2G D^ (kx^2 - ky^2)/k^2 ((1 - 2 nu) k - k^2 h)/(2(1 - nu)) exp(-kh)
    (2 s_xy)^      = -2G D^   2 kx ky/k^2     ((1 - 2 nu) k - k^2 h)/(2(1 - nu)) exp(-kh)         tension positive

At nu = 1/2 the face itself does not move sideways, and

    u(x, y, h) = integral D(x', y') 3 h^2 (x - x', y - y', h) / (2 pi R^5) dx' dy'      R: distance to the point of the
    face

so that every bit of a dent pushes all points straight away from itself: downwards below it, outwards beside it, fading
as R^-4 (sideways) and R^-5 (down). uz keeps the dent's volume at every depth.

Validity: small strains. What lies in order stays in order down to dents as deep as the first sheet under the face, and
further where they are wide. The body has no end: a skin whose inner face is free bends and follows a dent further than
this, one that is backed by something hard follows less.

Source: Boussinesq's point load, Johnson, Contact Mechanics (1985), 3.2, by the transforms 1/R -> 2 pi exp(-kh)/k and
log(R + h) -> -2 pi exp(-kh)/k^2; the tests hold it against the point load and against Hertz' contact.
"""

from __future__ import annotations

import math
from functools import cached_property, lru_cache

import numpy as np

from optics.polarization.layers import Texture
from optics.skin.contact import LocalMap, local_axis, surface, window

REACH = 10.0  # depths by which maps are wider than the dent on each side: what is cut off there is 1e-4 of the largest
NODES = 8  # per depth: exp(-kh) leaves little that is finer; a cubic spline errs by 1e-4 of the largest at most
WIDEST = 1001  # nodes a side
LEVELS = 9  # of points at many depths: a linear step between them leaves (0.5 mm / depth)^2 / 8 of a dent


def carried(
    dent: LocalMap | np.ndarray, pitch: float, depth: float, poisson: float = 0.5
) -> tuple[LocalMap, LocalMap, LocalMap]:
    """Displacement (ux, uy, uz) in mm at a depth below the face: ux, uy along x and y, uz into the skin (-z) like the
    dent.

    dent     (n, n) D in mm, n odd, [v, u] around the press axis, zero at the border
    pitch    mm
    depth    mm below the untouched face, >= 0
    poisson  0.5: incompressible. Below, sideways tails fade as r^-2, and the border of the maps takes a share of them

    The maps are REACH depths wider than the dent on each side and as coarse as the depth allows. They fade to zero over
    their outer eighth as a LocalMap must."""
    _check(pitch, poisson, depth)
    plane = Plane(dent, pitch, depth, depth)
    kh = plane.k * depth
    down = (1 + kh / (2 * (1 - poisson))) * np.exp(-kh)
    side = 1j * ((1 - 2 * poisson) - kh) / (2 * (1 - poisson)) * np.exp(-kh)
    return plane.map(side * plane.cos), plane.map(side * plane.sin), plane.map(down)


def stress_integrals(
    dent: LocalMap | np.ndarray, pitch: float, h1: float, h2: float, poisson: float = 0.5
) -> tuple[LocalMap, LocalMap]:
    """Q = integral (s_xx - s_yy) dh and U = integral 2 s_xy dh from depth h1 to h2, over the shear modulus: mm; tension
    positive.

    dent, pitch, poisson    as in `carried`
    h1, h2                  mm, 0 <= h1 <= h2

    Both are taken along lines across the skin. Beside a contact the skin is compressed along the radius: Q < 0 on the x
    axis, Q > 0 on the y axis, U < 0 where x y > 0. The greater tension lies at atan2(U, Q)/2 from x to y."""
    _check(pitch, poisson, h1, h2)
    plane = Plane(dent, pitch, h1, h2)

    def antiderivative(h):  # of -((1 - 2 nu) k - k^2 h) exp(-kh)
        return ((1 - 2 * poisson) - (1 + plane.k * h)) * np.exp(-plane.k * h)

    size = (antiderivative(h2) - antiderivative(h1)) / (1 - poisson)
    return (
        plane.map(size * (plane.cos - plane.sin) * (plane.cos + plane.sin)),
        plane.map(size * 2 * plane.cos * plane.sin),
    )


def displaced(gel, x: np.ndarray, y: np.ndarray, depth: float) -> np.ndarray:
    """(..., 3) world mm: where the points that rest at (x, y, -depth) in the skin are under the gel part's present
    dent.

    x, y  mm, broadcast together; fastest as a grid, x of shape (1, nx) and y of shape (ny, 1). gel: None for an
          untouched skin
    """
    if hasattr(gel, "carry"):  # a skin that knows better than its dent
        return gel.carry(x, y, depth)
    ux = uy = uz = 0.0
    if getattr(gel, "elastic", False):
        ux, uy, uz = gel.moved(x, y, depth)
    elif gel is not None and gel.map.values.any():
        press = gel.numbered("press x"), gel.numbered("press y")
        ux, uy, uz = (surface(x, y, *press, m) for m in _carried(gel.map, depth))
        if hasattr(gel, "sheared"):  # a drag of the indenter, besides its dent
            ux, uy, uz = (a + b for a, b in zip((ux, uy, uz), gel.sheared(x, y, depth)))
    return np.stack(np.broadcast_arrays(x + ux, y + uy, -depth - uz), -1)


def carried_points(gel, points: np.ndarray) -> np.ndarray:
    """(N, 3) world mm: where the points that rest at `points` (N, 3), z < 0 in the skin, are under the present dent.

    Of a dent alone the displacement is found at LEVELS depths, and is linear in between."""
    x, y, depth = points[:, 0], points[:, 1], -points[:, 2]
    if gel is None or not (hasattr(gel, "carry") or getattr(gel, "elastic", False) or gel.map.values.any()):
        return points.copy()
    if hasattr(gel, "carry"):
        return gel.carry(x, y, depth)
    levels = np.linspace(depth.min(), depth.max(), LEVELS)
    moved = np.stack([displaced(gel, x, y, float(level)) - [0, 0, -level] for level in levels])
    place = np.interp(depth, levels, np.arange(LEVELS)) if levels[-1] > levels[0] else np.zeros(len(depth))
    low = np.minimum(place.astype(int), LEVELS - 2)
    share, each = (place - low)[:, None], np.arange(len(points))
    return (1 - share) * moved[low, each] + share * moved[low + 1, each] + np.stack([0 * x, 0 * x, -depth], -1)


@lru_cache(maxsize=8)
def _carried(dent: LocalMap, depth: float) -> tuple[LocalMap, LocalMap, LocalMap]:
    """`carried`, kept: a gel's map stays the same object while the press only moves, and sheets at one depth share
    it."""
    return carried(dent, dent.pitch, depth)


class Plane:
    """The transform of a dent at the wave numbers of the grid on which a depth is wanted, and the way back.

    near, far    depths in mm: `near` sets how coarse the maps may be, `far` how wide they must be
    spectrum     (m, m/2 + 1) D^ in mm^3; k 1/mm, cos = kx/k and sin = ky/k (0 at k = 0) broadcast against it

    The sum over the dent is taken at those wave numbers directly, so that a coarse grid costs no accuracy. The period
    is twice the maps' width: the nearest image of the dent is farther from every node than the cut-off border."""

    def __init__(self, dent, pitch: float, near: float, far: float):
        from scipy.fft import next_fast_len

        values = np.asarray(dent, float)
        if values.ndim != 2 or values.shape[0] != values.shape[1] or not len(values) % 2:
            raise ValueError(f"dent of shape {values.shape}; it must be square with an odd number of nodes")
        half = (len(values) - 1) / 2 * pitch + REACH * far
        self.pitch = max(pitch, near / NODES, 2 * half / (WIDEST - 1))
        self.n = 2 * math.ceil(half / self.pitch - 1e-9) + 1
        self.m = next_fast_len(2 * self.n, real=True)
        kx = 2 * np.pi * np.fft.rfftfreq(self.m, self.pitch)
        ky = 2 * np.pi * np.fft.fftfreq(self.m, self.pitch)[:, None]
        self.k = np.hypot(kx, ky)
        self.cos, self.sin = (np.divide(a, self.k, out=np.zeros_like(self.k), where=self.k > 0) for a in (kx, ky))
        axis = local_axis(len(values), pitch)
        self.spectrum = np.exp(-1j * ky * axis) @ values @ np.exp(-1j * axis[:, None] * kx) * pitch**2

    def map(self, transfer: np.ndarray) -> LocalMap:
        """FT^-1[transfer D^], faded out at the border."""
        from scipy.fft import irfft2

        values = irfft2(self.spectrum * transfer, (self.m, self.m)) / self.pitch**2
        middle = np.arange(self.n) - (self.n - 1) // 2
        w = window(self.n)
        return LocalMap(values[np.ix_(middle, middle)] * w * w[:, None], self.pitch)


def _check(pitch: float, poisson: float, *depths: float) -> None:
    in_order = all(map(math.isfinite, depths)) and sorted(depths) == [*depths] and depths[0] >= 0
    if not (pitch > 0 and 0 <= poisson <= 0.5 and in_order):
        raise ValueError(
            f"half-space: pitch = {pitch:g} mm, Poisson's ratio {poisson:g}, depth "
            f"{' to '.join(f'{d:g}' for d in depths)} mm; "
            "need pitch > 0, a ratio in 0 ... 0.5 and depths >= 0 in rising order"
        )


class SkinStress:
    """The stress pattern of a pressed skin for a sheet in it (plugins/effects/stress_birefringence.py): f(x, y, size)
    -> (P_q, P_u)
    in mm; of an elastic dent, by the face alone.

    x, y are the sheet's own axes as the camera sees it (x right, y up): y of the world and 2 s_xy change their signs.
    The integral runs from h1 to h2. Taken over by whoever traces rays, as the scene moves on to other presses."""

    def __init__(self, gel, h1: float, h2: float):
        self.press = gel.numbered("press x"), gel.numbered("press y")
        self.touch = gel.touching() if getattr(gel, "elastic", False) else None
        self.dent, self.depths = gel.map if self.touch is None else None, (h1, h2)

    @cached_property
    def maps(self) -> tuple[LocalMap, LocalMap] | None:
        """Made when first asked for: a sheet without stress asks never."""
        dent = self.dent if self.touch is None else self.touch.displacement()[2]
        return _stress(dent, *self.depths) if dent.values.any() else None

    @cached_property
    def texture(self):
        return None if self.maps is None else Texture(np.stack([m.values for m in self.maps], -1))

    def __call__(self, x, y, size):
        if self.maps is None:
            return 0.0 * x, 0.0 * x
        if isinstance(x, np.ndarray):
            q, u = (surface(x.ravel(), -y.ravel(), *self.press, m).reshape(x.shape) for m in self.maps)
        else:  # linear between the maps' nodes
            width = len(self.maps[0].values) * self.maps[0].pitch
            q, u = self.texture((x - self.press[0]) / width + 0.5, (-y - self.press[1]) / width + 0.5)
        return q, -u


@lru_cache(maxsize=8)
def _stress(dent: LocalMap, h1: float, h2: float) -> tuple[LocalMap, LocalMap]:
    """`stress_integrals`, kept."""
    return stress_integrals(dent, dent.pitch, h1, h2)
