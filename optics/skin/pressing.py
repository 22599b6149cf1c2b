"""What a rigid indenter's shape and depth cost: pressure, shear, forces and the true displacement of an elastic skin.

    touch = press(overlap, pitch, stack)                     pressure >= 0 on a grid; touch.force in N
    held = drag(touch, (0.1, 0.0), twist, friction)          and the shear under a sideways move, with stick and slip
    ux, uy, uh = held.displacement(depth)                    of the skin at a depth, mm

The skin is a stack of layers (optics.skin.stack) under a rigid, first frictionless indenter. With the influence K of
the pressure on the face and the overlap o(x, y) by which the indenter would stand in the untouched skin,

    p >= 0,   u = K p >= o,   p (u - o) = 0        which is   min over p >= 0 of  p K p / 2 - o p

The move of the indenter by d(x, y) = (dx, dy) + twist e_z x r drags along what sticks: with the pressure as it is, the
shear q obeys |q| <= friction p, the skin under it moves by K_t q, and what slips does so along q,

    min over |q| <= friction p of  q K_t q / 2 - d q

Both are solved by projected gradients with momentum and restarts (Beck & Teboulle 2009; O'Donoghue & Candes 2015); K
is the closed form of uniform cells on a half-space (Love 1929) of the uppermost layer, and what the other layers and
the base take away is added from a Hankel integral, by FFT on a doubled grid, so that nothing repeats.

Validity: small strains and slopes; the move is one step from a press without shear; shear does not change the pressure
(exact on an incompressible half-space); the skin is wider than the contact by a few thicknesses. Checked against Hertz,
a flat punch, a thin bonded layer, Cattaneo and Mindlin, Lubkin, and finite elements of a skin with a stiff film.
Source: Johnson, Contact Mechanics (1985), ch. 3, 4, 5 and 7; Polonsky & Keer, Wear 231 (1999) 206, for the grid.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from optics.skin.contact import LocalMap, Profile, local_axis, surface
from optics.skin.stack import Layer, fields, half_space, response

NODES = 81  # across the grid of an indenter's contact: a ball's force is then true to 1e-3 of itself
MARGIN = 0.15  # of the depth: beside a press a layer that keeps its volume may rise to meet the indenter
DECAY = 24.0  # k times the uppermost thickness at the end of the Hankel integrals: exp(-2 k t) of their start is left
STEPS = 3000  # of the descent, at most; 100 to 700 are usual, more on finer grids
SETTLED = 1e-5  # change of the load over a step, relative: the force is then true to 1e-4 of itself
NEVER = "the {what} did not settle in {steps} steps: change {change:.1e} of the load; take a coarser grid"


@dataclass(frozen=True, eq=False)
class Contact:
    """A skin under an indenter, on a grid around the press axis.

    overlap    (n, n) mm, n odd, [v, u]: by which the indenter stands in the untouched skin
    pressure   (n, n) N/mm^2, >= 0;   shear  (n, n, 2) N/mm^2: the indenter's on the skin, along x and y
    slip       (n, n) bool: touched, and sliding
    pitch      mm;   stack  what is pressed
    """

    overlap: np.ndarray
    pressure: np.ndarray
    shear: np.ndarray
    slip: np.ndarray
    pitch: float
    stack: tuple[Layer, ...]

    @property
    def axis(self) -> np.ndarray:
        """Coordinates u = v of the nodes from the press axis, mm."""
        return local_axis(len(self.pressure), self.pitch)

    @property
    def touched(self) -> np.ndarray:
        """(n, n) bool: nodes under pressure."""
        return self.pressure > 0

    @property
    def touch(self) -> LocalMap:
        """1 where the indenter touches, 0 elsewhere."""
        return LocalMap(self.touched.astype(float), self.pitch)

    @property
    def area(self) -> float:
        """Touched area, mm^2."""
        return float(self.touched.sum() * self.pitch**2)

    @property
    def forces(self) -> np.ndarray:
        """(n, n, 3) N: of each node's cell, along x, y and into the skin."""
        return np.concatenate([self.shear, self.pressure[..., None]], -1) * self.pitch**2

    @property
    def force(self) -> np.ndarray:
        """(3,) N: of the whole contact, along x, y and into the skin."""
        return self.forces.sum((0, 1))

    @property
    def torque(self) -> float:
        """N mm: of the shear about the press axis, from x to y."""
        u, v = self.axis, self.axis[:, None]
        return float((u * self.forces[..., 1] - v * self.forces[..., 0]).sum())

    def displacement(self, depth: float = 0.0) -> tuple[LocalMap, LocalMap, LocalMap]:
        """Displacement of the skin along x, y and inwards (mm) at a depth below the untouched face; kept."""
        if depth not in self._maps:
            self._maps[depth] = fields(self.pressure, self.shear, self.pitch, self.stack, depth)
        return self._maps[depth]

    def moved(self, x: np.ndarray, y: np.ndarray, press: tuple[float, float], depth: float = 0.0) -> np.ndarray:
        """(3, ...) mm along x, y and inwards of the points that rest at (x, y, -depth), mm, of a press at `press`."""
        return np.stack(np.broadcast_arrays(*(surface(x, y, *press, m) for m in self.displacement(depth))))

    @cached_property
    def _maps(self) -> dict[float, tuple[LocalMap, LocalMap, LocalMap]]:
        return {}

    def sideways(self) -> Operator:
        """The influence of shear on the face's own grid."""
        return _by_waves(Influence(len(self.axis), self.pitch, self.stack).sideways, len(self.axis))


@lru_cache(maxsize=32)
def indent(profile: Profile, depth: float, stack: tuple[Layer, ...]) -> Contact:
    """The contact of an indenter (optics.skin.contact.indenter_profile) whose lowest point is `depth` mm below the
    untouched face; kept, do not write into it."""
    pitch = 2 * reach(profile, depth) / (NODES - 1)
    return press(depth - lowest(profile, local_axis(NODES, pitch)), pitch, stack)


def reach(profile: Profile, depth: float) -> float:
    """Half width of a grid around the press axis that holds the contact of an indenter, mm."""
    axis = profile.axis
    reached = profile.block(max(depth, 1e-6) * (1 + MARGIN))
    half = max((float(np.abs(axis[side][[0, -1]]).max()) for side in reached if len(axis[side])), default=0.0)
    return min(half + profile.pitch, float(axis[-1]))


def lowest(profile: Profile, local: np.ndarray) -> np.ndarray:
    """(n, n) mm: height of an indenter over its lowest point, at the nodes of a grid around the press axis."""
    from scipy.ndimage import map_coordinates

    at = (local - profile.axis[0]) / profile.pitch
    return map_coordinates(profile.envelope, np.meshgrid(at, at, indexing="ij"), order=1)


@lru_cache(maxsize=4)
def dragged(touch: Contact, move: tuple[float, float], twist: float, friction: float) -> Contact:
    """`drag`, kept."""
    return drag(touch, move, twist, friction)


@lru_cache(maxsize=4)
def shear_alone(touch: Contact) -> Contact:
    """What the shear of a contact does to the skin without its pressure; kept."""
    return replace(touch, pressure=np.zeros_like(touch.pressure))


def press(overlap: np.ndarray, pitch: float, stack: Sequence[Layer]) -> Contact:
    """The contact of a frictionless rigid indenter. Raises RuntimeError where the descent does not settle.

    overlap   (n, n) mm, n odd: depth less the indenter's height over its lowest point; below 0 beside it
    """
    overlap, stack = np.asarray(overlap, float), tuple(stack)
    n = len(overlap)
    if overlap.shape != (n, n) or not n % 2 or not np.isfinite(overlap).all() or not pitch > 0:
        raise ValueError(
            f"overlap of shape {overlap.shape}, pitch {pitch:g} mm; allowed: a square grid of an odd number of finite "
            "values in mm, pitch above 0"
        )
    none = np.zeros((n, n, 2))
    if overlap.max() <= 0:
        return Contact(overlap, np.zeros((n, n)), none, np.zeros((n, n), bool), pitch, stack)
    influence = _by_waves(Influence(n, pitch, stack).normal, n)
    pressure = descend(influence, overlap[None], lambda p: np.maximum(p, 0.0), "pressure")[0]
    return Contact(overlap, pressure, none, np.zeros((n, n), bool), pitch, stack)


def drag(touch: Contact, move: tuple[float, float], twist: float, friction: float) -> Contact:
    """The contact after the indenter moved sideways and turned, in one step.

    move      mm, along x and y;   twist  rad, about the press axis, from x to y;   friction  Coulomb's coefficient
    """
    if not (np.isfinite([*move, twist, friction]).all() and friction >= 0):
        raise ValueError(
            f"move {move} mm, twist {twist:g} rad, friction {friction:g}; allowed: finite numbers, friction 0 or more"
        )
    axis = touch.axis
    aim = np.stack([move[0] - twist * axis[:, None] + 0 * axis, move[1] + twist * axis + 0 * axis[:, None]])
    limit = friction * touch.pressure
    if not aim.any() or not limit.any():
        return replace(touch, slip=touch.touched & bool(aim.any()))

    def within(q):
        size = np.hypot(*q)
        return q * np.where(size > limit, limit / np.maximum(size, 1e-300), 1.0)

    shear = descend(touch.sideways(), aim, within, "shear")
    slip = touch.touched & (np.hypot(*shear) > limit * (1 - 1e-6))
    return replace(touch, shear=np.moveaxis(shear, 0, -1), slip=slip)


class Operator(NamedTuple):
    """An influence K on a grid: `moved` (c, n, n) of loads (c, n, n), and no less than its largest eigenvalue."""

    moved: Callable[[np.ndarray], np.ndarray]
    steepest: float


def _by_waves(influence: np.ndarray, n: int) -> Operator:
    """Of a transform (c, c, m, m/2 + 1) of K on the doubled grid."""
    from scipy.fft import irfft2, rfft2

    m = influence.shape[-2]

    def moved(x):
        return irfft2(np.einsum("ab...,b...->a...", influence, rfft2(x, (m, m))), (m, m))[:, :n, :n]

    return Operator(moved, float(np.linalg.eigvalsh(np.moveaxis(influence, (0, 1), (-2, -1))).max()))


def descend(influence: Operator, aim: np.ndarray, project: Callable, what: str) -> np.ndarray:
    """argmin over allowed x of x K x / 2 - aim x, by projected gradients with momentum.

    influence   K;   aim  (c, n, n);   project  onto what is allowed
    """
    moved, steepest = influence
    x = before = np.zeros_like(aim)
    speed = 1.0
    change = math.inf
    for _ in range(STEPS):
        faster = (1 + math.sqrt(1 + 4 * speed**2)) / 2
        ahead = x + (speed - 1) / faster * (x - before)
        before, x = x, project(ahead - (moved(ahead) - aim) / steepest)
        if ((ahead - x) * (x - before)).sum() > 0:  # the momentum leads uphill
            faster = 1.0
        speed = faster
        change = math.sqrt(np.square(x - before).sum() / max(np.square(x).sum(), 1e-300))
        if change < SETTLED:
            return x
    raise RuntimeError(NEVER.format(what=what, steps=STEPS, change=change))


# -- Influence -------------------------------------------------------------------------------------------------------
class Influence:
    """The face's displacement under uniform cells, on a grid of twice the nodes: `cells` (m, m) mm^3/N by the pressure
    of the cell at [0, 0], others around it; transforms `normal` of it (1, 1, m, m/2 + 1) and `sideways` of the shear
    (2, 2, m, m/2 + 1)."""

    def __init__(self, n: int, pitch: float, stack: tuple[Layer, ...]):
        from scipy.fft import next_fast_len, rfft2

        m = next_fast_len(2 * n, real=True)
        place = np.fft.fftfreq(m, 1 / m) * pitch  # a load's cell at 0, all others around it
        normal, xx, yy, xy = _cells(place, pitch, stack[0])
        if len(stack) > 1 or math.isfinite(stack[0].thickness):
            reach = float(np.hypot(place.min(), place.min()))
            down, mean, half = _less(2.0 ** math.ceil(math.log2(reach)), stack)  # few of them, which are kept
            r, turn = np.hypot(place, place[:, None]), 2 * np.arctan2(place[:, None], place)
            normal = normal + down(r) * pitch**2
            xx, yy = (a + (mean(r) - s * np.cos(turn) * half(r)) * pitch**2 for a, s in ((xx, 1), (yy, -1)))
            xy = xy - np.sin(turn) * half(r) * pitch**2
        self.cells = normal
        self.normal = rfft2(normal)[None, None].real  # even in x and y
        self.sideways = np.array([[rfft2(xx), rfft2(xy)], [rfft2(xy), rfft2(yy)]]).real


def _cells(place: np.ndarray, pitch: float, layer: Layer) -> tuple[np.ndarray, ...]:
    """u_h per pressure, u_x per q_x, u_y per q_y and u_x per q_y of a uniform cell on a half-space, mm^3/N.

    Integrals of 1/r, x^2/r^3, y^2/r^3 and x y/r^3 over the cell, from the corners; Johnson, 3.2 and 3.6."""
    edge = np.array([place + pitch / 2, place - pitch / 2])
    total = np.zeros((3, len(place), len(place)))
    for i, sx in enumerate((1, -1)):
        for j, sy in enumerate((1, -1)):
            x, y = edge[i], edge[j][:, None]
            r = np.hypot(x, y)
            total += sx * sy * np.array([y * np.log(x + r), x * np.log(y + r), -r])
    xx, yy, xy = total
    unit = 1 / (2 * math.pi * layer.shear)
    soft = (1 - layer.poisson) * (xx + yy)
    return (
        soft * unit,
        (soft + layer.poisson * xx) * unit,
        (soft + layer.poisson * yy) * unit,
        layer.poisson * xy * unit,
    )


@lru_cache(maxsize=16)
def _less(reach: float, stack: tuple[Layer, ...]) -> tuple[Callable, ...]:
    """What the stack gives way more or less than a half-space of its uppermost layer, per point force, mm/N, as
    functions of the distance: u_h, and mean and half difference of u along and across."""
    from scipy.interpolate import CubicSpline
    from scipy.special import j0, jv

    thin = stack[0].thickness
    nodes = max(200, int(DECAY / thin * reach))
    x, w = np.polynomial.legendre.leggauss(nodes)
    k, w = (x + 1) / 2 * DECAY / thin, w / 2 * DECAY / thin
    found, half = response(k, stack), half_space(k, stack[0])
    r = np.linspace(0.0, 1.01 * reach, max(200, int(16 * reach / thin)))
    waves = k * r[:, None]
    weight = w * k / (2 * math.pi)
    down = (j0(waves) * (weight * (found.down - half.down))).sum(-1)
    along, across = found.along - half.along, found.across - half.across
    mean = (j0(waves) * (weight * (along + across) / 2)).sum(-1)
    apart = (jv(2, waves) * (weight * (along - across) / 2)).sum(-1)
    return tuple(CubicSpline(r, values) for values in (down, mean, apart))
