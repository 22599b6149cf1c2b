"""How a printed grid skin gives way under a touch: a lattice of springs between the corners of its cells (D3Q14).

    skin = Lattice((21, 21, 7), pitch=0.8, material=Material(young=0.6, poisson=0.47, density=1.1))
    pressed = balance(skin, Push(sphere(6.0), depth=1.0, at=(0.5, 0.0)))     at rest, found directly: under a second
    pressed = settle(skin, Push(sphere(6.0), depth=1.0))                     at rest, by damped motion: seconds
    corners = pressed.positions.reshape(-1, 3)[cells(skin.shape)]            (cells, 8, 3) mm: hexahedra for a renderer

Frame and units. mm, N, MPa, g, ms: one set, as 1 N = 1 g mm/ms^2. Node (m, n, l) rests at x = (m - (R-1)/2) h, y = (n -
(C-1)/2) h, z = (l - (L-1)) h: the outer face is z = 0, the glued face z = -(L-1) h lies towards the camera. Indenters
come from +z. Cells are cubes of edge h, the pitch: only for these do the weights below give an isotropic body.

Springs. A node has 6 neighbours along the axes (weight g = 2) and 8 across the cells' diagonals, sqrt(3) h away (g =
3/4). Each cell owns a share of its springs, a quarter of an edge and all of a diagonal, so that faces, edges and soft
cells have springs of the right strength and a uniform stress is exact up to the surface (but for shear at the block's
eight corners, where a single diagonal pulls with alpha h e_yz/2 along x, and so on). With x the vector from node to
node, X the same at rest and V = h^3 the energy of a cell is

    sum_springs share { alpha g/2 (|x| - |X|)^2 + chi beta g/(2 |X|^2) |x - T X|^2 } + kappa/2 V (J - 1)^2

alpha   N/mm  linear springs, along their lines at any length and direction
beta    N mm  shear springs, chi = 2/3: what a spring's end moves in the frame that turns with the cell; T is the
        rotation in the polar decomposition of the cell's mean deformation gradient
kappa   MPa   the cell's resistance to a change of its volume V J, of the hexahedron with trilinear faces

The first two are the source's. For long waves, with C_ijkl = 1/(2V) sum_j alpha g_j X_i X_j X_k X_l / |X|^2 over the 14
springs and the same for the others, the body is isotropic and has Lame's constants

    lambda = alpha/h + kappa        mu = alpha/h + beta/h^3

The linear springs are isotropic for g_1/g_3 = 8/3, which 2 and 3/4 are; the shear springs are with any weights and any
chi, and with these weights chi = 2/3 makes their modulus just beta/V. nu = lambda/(2 (lambda + mu)) reaches 1/4 without
kappa. Beyond, beta would be negative, and the lattice would fold: a pattern that alternates along two axes and moves
along the third stretches no linear spring at all. Rubber has nu near 1/2, hence kappa. `spring_constants` lets the
shear springs bear SHARE of mu; where nu < 1/6 they bear more, and kappa = 0: the source's model, complete.

Where the printed equations do not agree with each other or with the lattice, this is used:
(7), (8)  alpha and beta are spring constants, so the braces are an energy and a force; over V they are densities, which
          (9) then adds to a weight in N and (12) divides by a mass. Here: without 1/V. (12) is right with F in N and
          theta in 1/ms.
(8)       F = +d phi/du has the wrong sign. The right-hand side is the force -d Phi/du of Phi = 1/2 sum_i phi_i, which
          counts every spring once.
(7)       No angle of D3Q14 has the cosine sqrt(2)/2: they are 54.7 deg (1/sqrt(3)) between edge and diagonal and 70.5
          deg (1/3) between diagonals. With 45 deg the lattice is under stress at rest. With the right ones it is not
          isotropic: what springs on these angles add to C44 is 2 times what they add to (C11 - C12)/2 for the former
          alone, 0.95 times for both.
(8)       The second term belongs to the energy chi beta g/2 |u_j - u_i|^2/|x|^2, which is no linearised angle and
          charges for turning the body as a whole (a Born spring). Here it is taken in the frame of the cell, as above.

Validity. Small strains: isotropic linear elasticity, turned by any angle. Large strains: a law of its own. For nu =
0.47 its stress is within 4 % of a neo-Hookean body's from 0.6 to 1.1 times the length, 9 % above it at 1.2. Cells turn
inside out, which is an error, at a third to a half of the thickness, under a small sphere at about 0.8 of its radius.
The body is uniform within a cell: walls and filling enter by their mixture (`grid_material`), single cells by
`factors`.

Accuracy against linear elasticity (quadratic finite elements, nu = 0.47, `linear`). Glued block, 6 cells over the
thickness: the force of a plate 2 %, the give under shear 3 %; 8 cells 1.3 and 2.1 %. Sphere: 18 % with 5 nodes in
contact, 5 % with 9 to 13, 2 % from 30 on. Against neo-Hookean elements, a sphere of 6 mm pressed 0.25 to 1 mm into 5
mm: 5 to 10 % too little force with 6 cells, 4 to 6 % with 10.

Time for 1 mm of a 6 mm sphere into 5 mm, one core: 21 x 21 x 7 nodes 0.5 s (`balance`) or 1.4 s (`settle`), 26 x 32 x 8
nodes 1.2 or 2.7 s.

Source: Fan, Li, Cong & Zhang, "MagicGripper" (mini-MagicTac), supplementary VII-A, eqs. (4)-(17); kappa and the cell's
frame are additions."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product

import numpy as np

from optics.skin.contact import smooth_step, soft_ramp

WEIGHTS = (2.0, 0.75)  # g of the springs along the axes and along the diagonals
CHI = 2 / 3
SHARE = 0.5  # of the shear modulus, borne by shear springs; with 0.25 skins fold in some presses over a third of them
STEEPEST = math.tan(math.radians(75.0))  # slope of the cone around an indenter, where its own side would be a wall
TOLERANCE = 1e-6  # residual force at rest over all forces on the skin
CHECKED = 20  # time steps between looks at whether it rests
SAFETY = 0.8  # of the longest stable time step: the springs of a pressed skin are stiffer than at rest

# A cell's corners (i, j, k), 0 or 1; its springs as differences of corners; and its modes: the position of a point of
# the cell at xi, eta, zeta in -1 ... 1 is the sum of modes times 1, xi, eta, zeta, eta zeta, zeta xi, xi eta, xi eta
# zeta.
CORNERS = np.array(list(product((0, 1), repeat=3)))
ENDS = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(CORNERS[a] - CORNERS[b]).sum() == 1]
ENDS += [(a, 7 - a) for a in range(4)]
SPRINGS = np.array([np.eye(8)[b] - np.eye(8)[a] for a, b in ENDS])  # (16, 8): 12 edges, 4 diagonals
REST = np.array([1.0] * 12 + [math.sqrt(3.0)] * 4)[:, None]  # pitches
OWNED = np.array([WEIGHTS[0] / 4] * 12 + [WEIGHTS[1]] * 4)[:, None]  # g times the share that one cell has of the spring
_xi, _eta, _zeta = 2.0 * CORNERS.T - 1
MODES = np.array([_xi**0, _xi, _eta, _zeta, _eta * _zeta, _zeta * _xi, _xi * _eta, _xi * _eta * _zeta]) / 8  # (8, 8)
# Of the shear springs' energy beta |F - T|^2 + beta/h^2 sum_modes bending/2 |mode|^2, modes 4 to 7
BENDING = np.array([32 / 3] * 3 + [56 / 3])[:, None]
# Volume/8 of a hexahedron = sum of factor [a, b, c] over modes a, b, c: the mean of its Jacobian determinant
VOLUME = ((1.0, (1, 2, 3)), (-1 / 3, (1, 5, 6)), (-1 / 3, (2, 6, 4)), (-1 / 3, (3, 4, 5)))


# -- Materials and springs -------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Material:
    """An isotropic elastic material.

    young    MPa, > 0
    poisson  0 ... 0.499
    density  g/cm^3, > 0; matters to motion and weight only
    """

    young: float
    poisson: float
    density: float = 1.1

    def __post_init__(self):
        _positive("Young's modulus", self.young, "MPa")
        _positive("density", self.density, "g/cm^3")
        if not 0 <= self.poisson <= 0.499:
            raise ValueError(
                f"Poisson's ratio = {self.poisson:g}; the lattice needs 0 to 0.499: below 0 its springs push, at 0.5 "
                "nothing "
                "changes its volume; take 0.47 to 0.49 for rubber"
            )

    @property
    def lame(self) -> tuple[float, float]:
        """lambda = E nu/((1 + nu)(1 - 2 nu)) and mu = E/(2 (1 + nu)), MPa."""
        nu = self.poisson
        return self.young * nu / ((1 + nu) * (1 - 2 * nu)), self.young / (2 * (1 + nu))


@dataclass(frozen=True)
class Springs:
    """The lattice's constants: alpha N/mm (linear), beta N mm (shear), kappa MPa (volume)."""

    alpha: float
    beta: float
    kappa: float = 0.0


def spring_constants(material: Material, pitch: float) -> Springs:
    """alpha = (1 - s) mu h, beta = s mu h^3, kappa = lambda - (1 - s) mu, with s = max(SHARE, 1 - lambda/mu).

    pitch  h in mm
    """
    _positive("pitch", pitch, "mm")
    lam, mu = material.lame
    share = max(SHARE, 1 - lam / mu)
    return Springs((1 - share) * mu * pitch, share * mu * pitch**3, max(lam - (1 - share) * mu, 0.0))


@dataclass(frozen=True)
class Equivalent:
    """What a lattice is to long waves.

    young, poisson  MPa and 1, stretched along an axis
    anisotropy      2 C44/(C11 - C12), Zener's ratio: 1 is isotropic, above it shear along the axes is resisted more
    """

    young: float
    poisson: float
    anisotropy: float


def equivalent(springs: Springs, pitch: float, weights: tuple[float, float] = WEIGHTS, chi: float = CHI) -> Equivalent:
    """E = (C11 - C12)(C11 + 2 C12)/(C11 + C12), nu = C12/(C11 + C12) of the lattice.

    C11 = (g1 + 4/3 g3) alpha/h + 2 M + kappa, C12 = 4/3 g3 alpha/h + kappa, C44 = 4/3 g3 alpha/h + M with the shear
    springs' modulus M = chi beta (g1 + 4/3 g3)/(2 h^3).

    pitch    h in mm
    weights  (g1, g3) of springs along axes and diagonals; any but the source's are for comparison only
    Raises ValueError where the springs carry no load.
    """
    _positive("pitch", pitch, "mm")
    g1, g3 = weights
    diagonal = 4 / 3 * g3 * springs.alpha / pitch
    shear = chi * springs.beta * (g1 + 4 / 3 * g3) / (2 * pitch**3)
    c11, c12 = g1 * springs.alpha / pitch + diagonal + 2 * shear + springs.kappa, diagonal + springs.kappa
    c44 = diagonal + shear
    if not (c11 > c12 and c11 + 2 * c12 > 0 and c44 > 0):
        raise ValueError(
            f"springs alpha = {springs.alpha:g} N/mm, beta = {springs.beta:g} N mm, kappa = {springs.kappa:g} MPa at a "
            "pitch of "
            f"{pitch:g} mm carry no load (C11 = {c11:g}, C12 = {c12:g}, C44 = {c44:g} MPa); beta/h^3 must be above "
            "-alpha/h"
        )
    young = (c11 - c12) * (c11 + 2 * c12) / (c11 + c12)
    return Equivalent(young, c12 / (c11 + c12), 2 * c44 / (c11 - c12))


@dataclass(frozen=True)
class Mixture:
    """A grid of walls and filling as one material.

    fraction  of the volume that is wall
    voigt     equal strain: the means of K and mu, an upper bound
    reuss     equal stress: the means of 1/K and 1/mu, a lower bound
    hill      the mean of the two bounds of K and of mu: the estimate
    """

    fraction: float
    voigt: Material
    reuss: Material
    hill: Material


def grid_material(wall: Material, filling: Material, wall_thickness: float, cell_size: float) -> Mixture:
    """Cubes of `filling` between closed walls; wall fraction 1 - (c/(c + t))^3, density the mean by volume (exact).

    wall_thickness  t in mm, >= 0
    cell_size       c in mm, > 0: inner edge of a cell, from wall to wall

    The bounds hold for any arrangement. A resolved cell with walls of 0.2 and a cube of 0.8 mm has Hill's E to 10 %
    while the filling is 0.3 to 10 times as stiff as the walls; at 0.1 times it has 1.3 of it, as closed walls bear what
    the filling does not."""
    _positive("cell size", cell_size, "mm")
    if not (math.isfinite(wall_thickness) and wall_thickness >= 0):
        raise ValueError(f"wall thickness = {wall_thickness:g} mm; it must be 0 or more, 0.1 to 0.4 is usual")
    fraction = 1 - (cell_size / (cell_size + wall_thickness)) ** 3
    parts = np.array([fraction, 1 - fraction])
    density = float(parts @ [wall.density, filling.density])
    moduli = np.array([[lam + 2 / 3 * mu, mu] for lam, mu in (wall.lame, filling.lame)])
    voigt, reuss = parts @ moduli, 1 / (parts @ (1 / moduli))
    return Mixture(fraction, *(_from_moduli(*m, density) for m in (voigt, reuss, (voigt + reuss) / 2)))


def _from_moduli(bulk: float, shear: float, density: float) -> Material:
    return Material(9 * bulk * shear / (3 * bulk + shear), (3 * bulk - 2 * shear) / (2 * (3 * bulk + shear)), density)


# -- The lattice -----------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Lattice:
    """A skin at rest, cut into cubes.

    shape     (R, C, L) nodes along x, y and z, each >= 2; `nodes` finds it from a size in mm
    pitch     h in mm, the edge of a cell
    material  of a full cell
    factors   (R-1, C-1, L-1) > 0 that multiply the stiffness of single cells: 0.01 for one that was not filled; None:
              all 1. Below about 1e-4 a press takes long to solve. Masses stay
    held      'base' (the face z = -(L-1) h is glued), 'base and sides', or (R, C, L, 3) bool: coordinates of nodes that
              stay

    Raises ValueError for shapes and numbers that make no lattice, and where the skin could move as a whole.
    """

    shape: tuple[int, int, int]
    pitch: float
    material: Material
    factors: np.ndarray | None = None
    held: str | np.ndarray = "base"

    def __post_init__(self):
        if np.ndim(self.pitch):
            raise ValueError(
                f"pitch = {self.pitch} mm; give one number: cells must be cubes, only then is D3Q14 isotropic"
            )
        _positive("pitch", self.pitch, "mm")
        if len(self.shape) != 3 or min(self.shape) < 2 or any(n != int(n) for n in self.shape):
            raise ValueError(f"lattice shape = {self.shape} nodes; need three whole numbers (R, C, L), each 2 or more")
        object.__setattr__(self, "shape", tuple(int(n) for n in self.shape))
        cells_shape = tuple(n - 1 for n in self.shape)
        if self.factors is not None:
            factors = np.array(self.factors, float)
            if factors.shape != cells_shape or not (np.isfinite(factors).all() and (factors > 0).all()):
                raise ValueError(
                    f"stiffness factors of shape {factors.shape}, least {np.min(factors, initial=np.inf):g}; need "
                    "shape "
                    f"{cells_shape}, one above 0 for each cell (0.01 where it was not filled)"
                )
            object.__setattr__(self, "factors", factors)
        if isinstance(self.held, str):
            if self.held not in ("base", "base and sides"):
                raise ValueError(f"held = '{self.held}'; must be 'base', 'base and sides' or (R, C, L, 3) bool")
        elif np.shape(self.held) != (*self.shape, 3) or np.asarray(self.held).dtype != bool:
            raise ValueError(
                f"held has shape {np.shape(self.held)}; need bool of {(*self.shape, 3)}: coordinates that stay"
            )
        x, stays = self._rest, ~self._free
        turns = np.stack([np.cross(axis, x)[stays] for axis in np.eye(3)], -1)
        shifts = np.broadcast_to(np.eye(3), (len(x), 3, 3))[stays]
        if np.linalg.matrix_rank(np.concatenate([shifts, turns / self.pitch], -1)) < 6:
            raise ValueError("the skin can move as a whole; hold its base ('base'), or six coordinates that fix it")

    @cached_property
    def springs(self) -> Springs:
        return spring_constants(self.material, self.pitch)

    @property
    def thickness(self) -> float:
        """mm from the glued to the outer face."""
        return (self.shape[2] - 1) * self.pitch

    @property
    def positions(self) -> np.ndarray:
        """(R, C, L, 3) mm: the nodes at rest."""
        return self._rest.reshape(*self.shape, 3).copy()

    @cached_property
    def mass(self) -> np.ndarray:
        """(R, C, L) g: rho h^3/8 from every cell that a node belongs to."""
        share = self.material.density * 1e-3 * self.pitch**3 / 8
        return share * np.bincount(_corners(self.shape).ravel()).reshape(self.shape)

    @cached_property
    def frequency(self) -> float:
        """rad/ms: (pi/(2 H)) sqrt(mu/rho), the lowest of a wide skin of thickness H, glued on one face, swinging
        sideways."""
        return math.pi / (2 * self.thickness) * math.sqrt(self.material.lame[1] / (self.material.density * 1e-3))

    @cached_property
    def longest_step(self) -> float:
        """ms: 2/omega with omega^2 = 8 k/(rho h^3) and k the largest eigenvalue of a cell's stiffness.

        No node of the lattice swings faster than its stiffest cell would alone, so Verlet is stable below this at rest.
        """
        cell = Lattice((2, 2, 2), self.pitch, self.material)
        blocks = _stiffness(cell, cell._rest)[..., 0]
        largest = np.linalg.eigvalsh(blocks.transpose(2, 0, 3, 1).reshape(24, 24))[-1]
        largest *= 1.0 if self.factors is None else self.factors.max()
        return 2 / math.sqrt(8 * largest / (self.material.density * 1e-3 * self.pitch**3))

    def forces(self, positions: np.ndarray) -> tuple[np.ndarray, float]:
        """The springs' forces on the nodes, -d Phi/dx, (R, C, L, 3) N, and their energy Phi in N mm at `positions` in
        mm."""
        f, energy = _forces(self, _shaped("positions", positions, (*self.shape, 3), "mm").reshape(-1, 3))
        return f.reshape(*self.shape, 3), energy

    @cached_property
    def _rest(self) -> np.ndarray:
        r, c, depth = self.shape
        axes = np.arange(r) - (r - 1) / 2, np.arange(c) - (c - 1) / 2, np.arange(depth) - (depth - 1.0)
        return self.pitch * np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)

    @cached_property
    def _free(self) -> np.ndarray:
        """(nodes, 3) bool."""
        if not isinstance(self.held, str):
            return ~np.asarray(self.held).reshape(-1, 3)
        free = np.ones((*self.shape, 3), bool)
        free[:, :, 0] = False
        if self.held == "base and sides":
            free[[0, -1]] = free[:, [0, -1]] = False
        return free.reshape(-1, 3)

    @cached_property
    def _factors(self) -> np.ndarray | float:
        return 1.0 if self.factors is None else self.factors.ravel()


def nodes(size: tuple[float, float, float], pitch: float) -> tuple[int, int, int]:
    """(R, C, L) = floor(size/h) + 1 for a skin of `size` = (X, Y, Z) mm: what is over at the edges is left out."""
    _positive("pitch", pitch, "mm")
    for length in size:
        _positive("skin size", length, "mm")
    return tuple(math.floor(length / pitch * (1 + 1e-12)) + 1 for length in size)


def cells(shape: tuple[int, int, int]) -> np.ndarray:
    """(cells, 8) int: the nodes of each hexahedron, for positions.reshape(-1, 3); cells in the order of `factors`.

    Corners go round the face nearer the camera, (0,0) (1,0) (1,1) (0,1) in (x, y), then likewise round the outer one:
    as in VTK."""
    return _corners(tuple(shape))[[0, 4, 6, 2, 1, 5, 7, 3]].T.copy()


def volume_ratio(positions: np.ndarray, pitch: float) -> np.ndarray:
    """J, (R-1, C-1, L-1): volume of each cell over h^3, faces trilinear; positions (R, C, L, 3) in mm."""
    shape = np.shape(positions)[:3]
    m = MODES @ _gather(np.reshape(positions, (-1, 3)), shape)
    return (_volume(m)[0] * 8 / pitch**3).reshape([n - 1 for n in shape])


def inverted(positions: np.ndarray) -> np.ndarray:
    """(R-1, C-1, L-1) bool: cells that are turned inside out at a corner, where the three edges no longer span a volume
    > 0."""
    shape = np.shape(positions)[:3]
    x = _gather(np.reshape(positions, (-1, 3)), shape)
    found = np.zeros(x.shape[2], bool)
    for a, corner in enumerate(CORNERS):
        e = [(x[:, a ^ bit] - x[:, a]) * (1 - 2 * side) for bit, side in zip((4, 2, 1), corner)]
        found |= (e[0] * _cross(e[1], e[2])).sum(0) <= 0
    return found.reshape([n - 1 for n in shape])


# -- Energy of the cells ---------------------------------------------------------------------------------------------
# Arrays are (3, 8, cells): component, corner or mode, cell.


@lru_cache(maxsize=8)
def _corners(shape) -> np.ndarray:
    """(8, cells): index of the nodes at the corners, in the order of CORNERS."""
    index = np.arange(math.prod(shape)).reshape(shape)
    r, c, depth = (n - 1 for n in shape)
    found = np.stack([index[i : r + i, j : c + j, k : depth + k].ravel() for i, j, k in CORNERS])
    found.flags.writeable = False
    return found


def _gather(x, shape) -> np.ndarray:
    return np.ascontiguousarray(x.T)[:, _corners(shape)]


def _cross(a, b) -> np.ndarray:
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _volume(m) -> tuple[np.ndarray, np.ndarray]:
    """Volume/8 (cells) and its derivative by the modes (3, 8, cells)."""
    volume, slope = 0.0, np.zeros_like(m)
    for factor, (a, b, c) in VOLUME:
        bc = _cross(m[:, b], m[:, c])
        volume = volume + factor * (m[:, a] * bc).sum(0)
        slope[:, a] += factor * bc
        slope[:, b] += factor * _cross(m[:, c], m[:, a])
        slope[:, c] += factor * _cross(m[:, a], m[:, b])
    return volume, slope


def _rotation(gradient) -> np.ndarray:
    """T of gradient = T S, (3, 3, cells), columns in the second axis, by Higham's iteration T <- (T + T^-T)/2."""
    t = gradient
    for _ in range(40):
        a, b, c = t[:, 0], t[:, 1], t[:, 2]
        bc = _cross(b, c)
        before, t = t, (t + np.stack([bc, _cross(c, a), _cross(a, b)], 1) / (a * bc).sum(0)) / 2
        if not np.abs(t - before).max() > 1e-8:  # converges quadratically: 1e-16 is left; also ends where there is none
            break
    return t


def _forces(lattice: Lattice, x) -> tuple[np.ndarray, float]:
    """(nodes, 3) N and N mm, for (nodes, 3) mm."""
    h, s = lattice.pitch, lattice.springs
    corners = _gather(x, lattice.shape)
    along = SPRINGS @ corners
    length = np.sqrt((along * along).sum(0))
    strained = s.alpha * OWNED * (length - REST * h)
    energy = (strained * (length - REST * h)).sum(0) / 2
    pull = SPRINGS.T @ (along * (strained / length))
    m = MODES @ corners
    slope = np.zeros_like(m)
    if s.kappa:
        volume, slope = _volume(m)
        pressure = s.kappa * (8 / h**3 * volume - 1)
        energy += pressure**2 / (2 * s.kappa) * h**3
        slope *= 8 * pressure
    gradient = m[:, 1:4] * (2 / h)
    strain = gradient - _rotation(gradient)
    bent = s.beta / h**2 * BENDING * m[:, 4:]
    energy += s.beta * (strain * strain).sum((0, 1)) + (bent * m[:, 4:]).sum((0, 1)) / 2
    slope[:, 1:4] += 4 * s.beta / h * strain
    slope[:, 4:] += bent
    pull += MODES.T @ slope
    pull *= lattice._factors
    index, n = _corners(lattice.shape).ravel(), len(x)
    return -np.stack([np.bincount(index, p.ravel(), n) for p in pull], 1), float((energy * lattice._factors).sum())


def _stiffness(lattice: Lattice, x) -> np.ndarray:
    """d^2 energy/dx^2 of every cell, (3, 3, 8, 8, cells) N/mm: exact, also where cells are strained and turned."""
    h, s = lattice.pitch, lattice.springs
    corners = _gather(x, lattice.shape)
    count = corners.shape[2]
    along = SPRINGS @ corners
    length = np.sqrt((along * along).sum(0))
    ratio = REST * h / length
    stiff = s.alpha * OWNED
    along *= np.sqrt(stiff * ratio) / length
    total = np.empty((3, 3, 8, 8, count))

    m = MODES @ corners
    modes = np.zeros((3, 3, 8, 8, count))
    if s.kappa:
        volume, slope = _volume(m)
        pressure = 8 * s.kappa * (8 / h**3 * volume - 1)
        slope *= 8 * math.sqrt(s.kappa / h**3)
        np.multiply(slope[:, None, :, None], slope[None, :, None, :], out=modes)
        for factor, (a, b, c) in VOLUME:
            for i, j, k in ((a, b, c), (b, c, a), (c, a, b)):
                lever = factor * pressure * m[:, k]
                for p in range(3):
                    q, r = (p + 1) % 3, (p + 2) % 3
                    for row, column, sign in ((p, q, 1), (q, p, -1)):
                        modes[row, column, i, j] += sign * lever[r]
                        modes[column, row, j, i] += sign * lever[r]
    # |F - T|^2: its second derivative is 2 (1 - D^T (tr S - S)^-1 D), with D what a change of F turns
    gradient = m[:, 1:4] * (2 / h)
    t = _rotation(gradient)
    stretch = np.einsum("pin,pjn->nij", t, gradient)
    stretch = (stretch + stretch.transpose(0, 2, 1)) / 2
    inverse = np.linalg.inv(np.trace(stretch, axis1=1, axis2=2)[:, None, None] * np.eye(3) - stretch).transpose(1, 2, 0)
    turn = np.zeros((3, 3, 3, count))  # (turned about, component, column of F, cell)
    for a in range(3):
        turn[a, :, (a + 1) % 3], turn[a, :, (a + 2) % 3] = t[:, (a + 2) % 3], -t[:, (a + 1) % 3]
    half = np.einsum("abn,bqjn->aqjn", inverse, turn)
    modes[:, :, 1:4, 1:4] -= 8 * s.beta / h**2 * np.einsum("apin,aqjn->pqijn", turn, half)
    own = s.beta / h**2 * np.array([0.0, 8.0, 8.0, 8.0, *BENDING[:, 0]])
    for p in range(3):
        for i in range(8):
            modes[p, p, i, i] += own[i]
    np.matmul(MODES.T, np.matmul(MODES.T, modes.reshape(3, 3, 8, 8 * count)).reshape(3, 3, 8, 8, count), out=total)

    loose = stiff * (1 - ratio)
    for spring, (a, b) in enumerate(ENDS):
        block = along[:, None, spring] * along[None, :, spring]
        block[range(3), range(3)] += loose[spring]
        total[:, :, a, a] += block
        total[:, :, b, b] += block
        total[:, :, a, b] -= block
        total[:, :, b, a] -= block
    total *= lattice._factors
    return total


@lru_cache(maxsize=4)
def _pattern(shape) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Where the blocks of cells go in a block-sparse matrix: place of (8, 8, cells), column indices, row starts,
    diagonal."""
    index, n = _corners(shape), math.prod(shape)
    keys, place = np.unique(index[:, None] * n + index[None], return_inverse=True)
    columns = keys % n
    starts = np.searchsorted(keys, np.arange(n + 1) * n)
    return place.ravel(), columns.astype(np.int32), starts.astype(np.int32), np.flatnonzero(keys // n == columns)


def _assembled(lattice: Lattice, x):
    """The lattice's stiffness, sparse (3 nodes, 3 nodes) N/mm, and its diagonal blocks (nodes, 3, 3)."""
    from scipy.sparse import bsr_array

    blocks = _stiffness(lattice, x)
    place, columns, starts, diagonal = _pattern(lattice.shape)
    data = np.empty((len(columns), 3, 3))
    for p, q in product(range(3), repeat=2):
        data[:, p, q] = np.bincount(place, blocks[p, q].ravel(), len(columns))
    return bsr_array((data, columns, starts), shape=(3 * len(x), 3 * len(x))), data[diagonal]


# -- Indenters -------------------------------------------------------------------------------------------------------
Height = Callable[[np.ndarray, np.ndarray], np.ndarray]


def sphere(diameter: float) -> Height:
    """R - sqrt(R^2 - r^2) in mm above the lowest point; from 75 deg on its tangent cone, reached at a depth of 0.74
    R."""
    _positive("sphere diameter", diameter, "mm")
    radius = diameter / 2
    steep = radius * STEEPEST / math.hypot(1.0, STEEPEST)
    rise = radius - math.sqrt(radius**2 - steep**2)

    def height(x, y):
        r = np.hypot(x, y)
        return np.where(r < steep, radius - np.sqrt(np.maximum(radius**2 - r * r, 0.0)), rise + STEEPEST * (r - steep))

    return height


def punch(diameter: float, rounding: float = 0.1) -> Height:
    """A flat round face with a side of 75 deg; between r = D/2 and D/2 + 2 `rounding` (mm) it is rounded off.

    With a rounding below half a pitch a node near the rim may rest under it or beside it: forces then differ by some 4
    %."""
    _positive("punch diameter", diameter, "mm")
    _positive("rounding of a punch", rounding, "mm")
    return lambda x, y: STEEPEST * soft_ramp(np.hypot(x, y) - diameter / 2 - rounding, rounding)


def plate() -> Height:
    """A flat face that reaches everywhere."""
    return lambda x, y: np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))


@dataclass(frozen=True, eq=False)
class Push:
    """An indenter that comes from +z, without friction.

    shape  f(x, y) -> mm above its lowest point, for arrays of mm from its own axis; inf where there is nothing.
           `sphere`, `punch`, `plate` or any function with bounded slopes: walls are to be cones, as in
           optics/skin/contact.py
    depth  mm, >= 0: how far its lowest point lies under the untouched face
    at     (x, y) mm of its axis
    shear  (x, y) mm by which it then moves sideways
    stuck  True: nodes that touch before the shear move with the indenter, whole; the others stay free and may come to
           touch it. False: it slides, so only where it ends matters
    """

    shape: Height
    depth: float
    at: tuple[float, float] = (0.0, 0.0)
    shear: tuple[float, float] = (0.0, 0.0)
    stuck: bool = False

    def __post_init__(self):
        if not callable(self.shape):
            raise ValueError(
                f"indenter shape = {self.shape!r}; must be sphere(D), punch(D), plate() or a function f(x, y) in mm"
            )
        if not (math.isfinite(self.depth) and self.depth >= 0):
            raise ValueError(
                f"depth = {self.depth:g} mm; it must be 0 (touching) or more, less than the skin's thickness"
            )
        for name in ("at", "shear"):
            if np.shape(getattr(self, name)) != (2,) or not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"{name} = {getattr(self, name)}; need two numbers (x, y) in mm")


# -- Results ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Deformed:
    """A skin under load.

    lattice       what was loaded
    positions     (R, C, L, 3) mm: where the nodes are; with `cells` the hexahedra between them
    force         (3,) N: the indenter's on the skin; -force[2] is how hard it presses
    reaction      (3,) N: of what holds the skin; force + reaction + weight and nodal forces = 0 at rest
    contact       (R, C) bool: nodes of the outer face that touch the indenter
    penetration   mm by which the deepest node lies inside the indenter, but for those stuck to it
    energy        N mm in the springs
    residual      forces that nothing balances over all forces (root of sums of squares)
    at_rest       residual and motion are within the tolerance
    steps         of Newton's method or of time
    seconds       on the clock
    duration      ms of motion, 0 for `balance`
    """

    lattice: Lattice
    positions: np.ndarray
    force: np.ndarray
    reaction: np.ndarray
    contact: np.ndarray
    penetration: float
    energy: float
    residual: float
    at_rest: bool
    steps: int
    seconds: float
    duration: float = 0.0

    @property
    def displacement(self) -> np.ndarray:
        """(R, C, L, 3) mm."""
        return self.positions - self.lattice.positions

    @property
    def volume_ratio(self) -> np.ndarray:
        """(R-1, C-1, L-1): each cell's volume over that at rest."""
        return volume_ratio(self.positions, self.lattice.pitch)


# -- Loads -----------------------------------------------------------------------------------------------------------
class _Setup:
    """A lattice and all that acts on it, checked: `nodal` forces (nodes, 3) N, the push, the nodes of the outer `face`.

    linear  True: springs and contact as of the shape at rest
    """

    def __init__(self, lattice: Lattice, push: Push | None, forces, gravity, linear: bool = False):
        n = math.prod(lattice.shape)
        self.lattice, self.push, self.linear, self.start = lattice, push, linear, time.perf_counter()
        self.face = np.arange(lattice.shape[2] - 1, n, lattice.shape[2])
        self.nodal = np.zeros((n, 3))
        if forces is not None:
            self.nodal += _shaped("nodal forces", forces, (*lattice.shape, 3), "N").reshape(n, 3)
        if np.shape(gravity) != (3,) or not np.isfinite(gravity).all():
            raise ValueError(f"gravity = {gravity}; need three numbers in m/s^2, (0, 0, 9.81) with the outer face down")
        self.nodal += lattice.mass.reshape(n, 1) * np.asarray(gravity, float) * 1e-3
        if push is None:
            return
        if push.depth >= lattice.thickness:
            raise ValueError(f"depth = {push.depth:g} mm; the skin is {lattice.thickness:g} mm thick, press less deep")
        rest = lattice._rest[self.face]
        heights = np.asarray(self.legs()[0].indenter(1.0).height(rest))
        if heights.shape != (len(rest),) or np.isnan(heights).any():
            raise ValueError(
                f"the indenter's shape gives heights of shape {heights.shape}, {np.isnan(heights).sum()} of them not a "
                "number, "
                f"over {len(rest)} nodes; it must give one height in mm for each x, y, and inf where there is nothing"
            )
        if ((heights < push.depth) & ~lattice._free[self.face, 2]).any():
            raise ValueError(
                f"depth = {push.depth:g} mm pushes the indenter into nodes that are held; keep it off them"
            )
        if push.depth > 0 and heights.min() >= push.depth:
            raise ValueError(
                f"depth = {push.depth:g} mm reaches no node: over the nearest one the indenter is {heights.min():g} mm "
                "above "
                f"its lowest point; press deeper, take a pitch below {lattice.pitch:g} mm, or move it over the skin"
            )

    def legs(self) -> list[_Leg]:
        """The way to the end: down, then sideways if the indenter sticks."""
        push = self.push
        if push is None:
            return [_Leg(self, (0.0, 0.0), np.zeros((2, 2)), False)]
        at, end = np.array(push.at, float), np.add(push.at, push.shear)
        if not push.stuck:
            return [_Leg(self, (0.0, push.depth), np.array([end, end]), False)]
        down = _Leg(self, (0.0, push.depth), np.array([at, at]), False)
        return [down, _Leg(self, (push.depth, push.depth), np.array([at, end]), True)] if any(push.shear) else [down]

    def forces(self, x) -> tuple[np.ndarray, float]:
        """The springs' (nodes, 3) N and their energy N mm."""
        if not self.linear:
            return _forces(self.lattice, x)
        moved = (x - self.lattice._rest).ravel()
        pull = self.stiffness(x)[0] @ moved
        return -pull.reshape(x.shape), float(moved @ pull) / 2

    def stiffness(self, x):
        return self._stiffness_at_rest if self.linear else _assembled(self.lattice, x)

    @cached_property
    def _stiffness_at_rest(self):
        return _assembled(self.lattice, self.lattice._rest)


class _Leg:
    """Part of a push: depth and place (2: from, to), and whether nodes stick to the indenter; `share` goes from 0 to
    1."""

    def __init__(self, setup: _Setup, depth, place, sticks: bool):
        self.setup, self.depth, self.place, self.sticks = setup, depth, place, sticks
        self.stuck = np.zeros(len(setup.lattice._rest), bool)
        self.free, self.began = setup.lattice._free, None

    def begin(self, x, touching) -> None:
        """Take over from the leg before: positions (nodes, 3) and the nodes of the face that touch."""
        if self.sticks:
            self.stuck[self.setup.face[touching]] = True
            self.free = self.free & ~self.stuck[:, None]
        self.began = x[self.stuck]

    def nodal(self, share: float) -> np.ndarray:
        return self.setup.nodal * (1.0 if self.sticks else share)

    def carried(self, share: float) -> np.ndarray:
        """Where the stuck nodes are."""
        return self.began + share * np.append(self.place[1] - self.place[0], 0.0)

    def indenter(self, share: float) -> _Indenter | None:
        push, setup = self.setup.push, self.setup
        if push is None:
            return None
        depth, place = ((1 - share) * a + share * b for a, b in (self.depth, self.place))
        rest = setup.lattice._rest[setup.face] if setup.linear else None
        return _Indenter(push.shape, depth, place, setup.lattice._free[setup.face], rest)


class _Indenter:
    """An indenter at one depth and place, over all nodes (k, 3) of the outer face: gaps, and their gradients.

    free  (k, 3) bool: coordinates that may move
    rest  None, or the positions over which all heights are taken (linear)
    """

    def __init__(self, shape: Height, depth: float, place, free, rest=None):
        self.shape, self.depth, self.place, self.free, self.rest = shape, depth, place, free, rest

    def height(self, x) -> np.ndarray:
        return self.shape(x[:, 0] - self.place[0], x[:, 1] - self.place[1])

    def gap(self, x) -> np.ndarray:
        """mm from nodes up to the indenter's surface: negative inside it."""
        return self.height(x if self.rest is None else self.rest) - self.depth - x[:, 2]

    def slope(self, x, e=1e-5) -> np.ndarray:
        """Gradient of the gap by what is free of the node's position, (k, 3): it points out of the indenter."""
        found = np.full((len(x), 3), (0.0, 0.0, -1.0))
        if self.rest is None:
            for i in range(2):
                step = e * np.eye(3)[i]
                ahead, behind = self.height(x + step), self.height(x - step)
                there = np.isfinite(ahead) & np.isfinite(behind)
                found[there, i] = (ahead[there] - behind[there]) / (2 * e)
        return found * self.free

    def put_out(self, x) -> tuple[np.ndarray, np.ndarray]:
        """Nodes inside the indenter moved to the nearest point of its surface, so along its normal; and which they
        were."""
        inside = (self.gap(x) < 0) & self.free[:, 2]
        found, i = x.copy(), inside[:, None]
        for _ in range(30):
            slope, off, gap = self.slope(found), x - found, self.gap(found)
            ahead = ((off * slope).sum(1) + np.where(np.isfinite(gap), gap, 0.0)) / np.maximum(
                (slope * slope).sum(1), 1.0
            )
            move = np.where(i, off - ahead[:, None] * slope, 0.0)
            found += move
            if not np.abs(move).max() > 1e-12:
                break
        return found, inside


class _Bounds:
    """What may not move: coordinates that are not `free` (nodes, 3), and touching `nodes` along their `normals` (k,
    3)."""

    def __init__(self, leg: _Leg, x, touching, indenter: _Indenter | None):
        self.free, self.nodes = leg.free, leg.setup.face[touching]
        slope = np.zeros((0, 3)) if indenter is None else indenter.slope(x[leg.setup.face])[touching]
        self.steepness = np.sqrt((slope * slope).sum(1))
        self.normals = slope / self.steepness[:, None]

    def loose(self, v) -> np.ndarray:
        """The part of vectors (nodes, 3) that nothing holds."""
        v = v * self.free
        v[self.nodes] -= self.normals * self.along(v)[:, None]
        return v

    def along(self, v) -> np.ndarray:
        """Components of touching nodes' vectors along their normals, (k,)."""
        return (v[self.nodes] * self.normals).sum(1)

    def residual(self, total, nodal) -> float:
        """Norm of the forces that nothing balances, over that of all forces from outside."""
        loose = self.loose(total)
        outside = math.hypot(np.linalg.norm(total - loose), np.linalg.norm(nodal))
        return float(np.linalg.norm(loose)) / outside if outside else 0.0


def _result(leg: _Leg, share, x, touching, at_rest, steps, duration=0.0) -> Deformed:
    """What a leg came to at its `share`."""
    setup, nodal = leg.setup, leg.nodal(share)
    positions, indenter = x.reshape(*setup.lattice.shape, 3), leg.indenter(share)
    bad = inverted(positions)
    if bad.any():
        raise ValueError(
            f"{bad.sum()} of {bad.size} cells are turned inside out"
            + (f" at a depth of {setup.push.depth:g} mm; press less deep" if setup.push else "; use smaller forces")
            + f", take a lattice finer than {setup.lattice.pitch:g} mm or a blunter indenter"
        )
    bounds = _Bounds(leg, x, touching, indenter)
    elastic, energy = setup.forces(x)
    total = elastic + nodal
    outside = bounds.loose(total) - total
    contact = leg.stuck.copy()
    contact[bounds.nodes] = True
    inside = 0.0 if indenter is None else -float(indenter.gap(x[setup.face])[~leg.stuck[setup.face]].min(initial=0.0))
    return Deformed(
        setup.lattice,
        positions,
        outside[contact].sum(0),
        outside[~contact].sum(0),
        contact[setup.face].reshape(positions.shape[:2]),
        inside,
        energy,
        bounds.residual(total, nodal),
        at_rest,
        steps,
        time.perf_counter() - setup.start,
        duration,
    )


# -- Rest, found directly --------------------------------------------------------------------------------------------
def balance(
    lattice: Lattice,
    push: Push | None = None,
    forces: np.ndarray | None = None,
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    linear: bool = False,
    tolerance: float = TOLERANCE,
    progress: Callable[[int, float], None] | None = None,
) -> Deformed:
    """Positions at which all forces balance, by Newton's method with exact contact: no node inside, none pulled.

    forces     (R, C, L, 3) N on the nodes
    gravity    (3,) m/s^2, along x, y, z
    linear     True: small strains and displacements, as in linear elasticity: the stiffness at rest, heights of the
               indenter over the nodes at rest, contact forces along z. For comparisons; the default is exact for the
               lattice
    tolerance  of Deformed.residual
    progress   called with (steps done, residual)

    Each step solves for the touching nodes that it assumes, by conjugate gradients; then those that are pulled are let
    go and those inside the indenter are taken in (the primal-dual active set). The depth grows by at most a pitch at a
    time.

    Raises ValueError for loads that do not fit the lattice, before any work, for cells turned inside out, and where no
    rest is found."""
    setup = _Setup(lattice, push, forces, gravity, linear)
    x, touching, steps = lattice._rest, np.zeros(len(setup.face), bool), 0
    for leg in setup.legs():
        leg.begin(x, touching)
        way = np.abs(np.diff(leg.depth)).sum() + np.abs(np.diff(leg.place, axis=0)).sum()
        parts = max(1, math.ceil(way / lattice.pitch))
        for finer in (1, 2, 4):
            found = x, touching & ~leg.stuck[setup.face]
            for part in range(parts * finer):
                last = part + 1 == parts * finer
                found = _newton(leg, (part + 1) / (parts * finer), *found, tolerance if last else 1e-2, steps, progress)
                steps = found[2]
                if found[0] is None:
                    break
                found = found[:2]
            if found[0] is not None:
                break
        else:
            raise ValueError(
                f"no rest found in {steps} steps: "
                + (
                    f"a depth of {push.depth:g} mm may be too much for {lattice.thickness:g} mm; press less deep, "
                    if push
                    else "the forces may be too large; use smaller ones, "
                )
                + "take a finer lattice, or use `settle`"
            )
        x, touching = found
    return _result(leg, 1.0, x, touching, True, steps)


def _newton(leg: _Leg, share, x, touching, tolerance, steps, progress):
    """(positions, touching, steps) at a share of a leg; positions are None where there is no rest in 40 steps."""
    setup, face, pitch = leg.setup, leg.setup.face, leg.setup.lattice.pitch
    indenter, nodal = leg.indenter(share), leg.nodal(share)
    touchable = ~leg.stuck[face] & setup.lattice._free[face, 2]
    if indenter is not None:
        touching = touching | ((indenter.gap(x[face]) < 0) & touchable)
    total = setup.forces(x)[0] + nodal
    with np.errstate(all="ignore"):
        for _ in range(40):
            steps += 1
            bounds = _Bounds(leg, x, touching, indenter)
            matrix, diagonal = setup.stiffness(x)
            move = np.zeros_like(x)
            move[leg.stuck] = leg.carried(share) - x[leg.stuck]
            if indenter is not None:
                move[bounds.nodes] = -(indenter.gap(x[face])[touching] / bounds.steepness)[:, None] * bounds.normals
            right = total - (matrix @ move.ravel()).reshape(x.shape)
            move += _solve(matrix, diagonal, right, bounds, tolerance / 10 if setup.linear else 5e-3)
            whole = 1.0 if setup.linear else min(1.0, pitch / 2 / max(np.abs(move).max(), 1e-300))
            x = x + whole * move
            total = setup.forces(x)[0] + nodal
            if not np.isfinite(total).all():
                break
            changed = False
            if indenter is not None:
                bounds = _Bounds(leg, x, touching, indenter)
                gap = indenter.gap(x[face])
                now = (gap < -1e-9 * pitch) & touchable
                now[touching] = (bounds.along(total) < 0) & np.isfinite(gap[touching])
                changed = (now != touching).any() or np.abs(gap[touching]).max(initial=0.0) > 1e-6 * pitch
                touching = now
            residual = bounds.residual(total, nodal)
            if progress is not None:
                progress(steps, residual)
            if not changed and whole == 1.0 and residual <= tolerance:
                return x, touching, steps
    return None, None, steps


def _solve(matrix, diagonal, right, bounds: _Bounds, tolerance: float, most: int = 3000) -> np.ndarray:
    """What moves freely, (nodes, 3), by conjugate gradients with the inverse of each node's own stiffness before
    them."""
    inverse = np.linalg.inv(diagonal)
    x, r = np.zeros_like(right), bounds.loose(right)
    p, rz, enough = np.zeros_like(right), 1.0, tolerance * np.linalg.norm(r)
    for step in range(most):
        if not np.linalg.norm(r) > enough:
            break
        z = bounds.loose(np.matmul(inverse, r[..., None])[..., 0])
        rz, before = (r * z).sum(), rz
        p = z + (rz / before if step else 0.0) * p
        kp = bounds.loose((matrix @ p.ravel()).reshape(p.shape))
        curvature = (p * kp).sum()
        if not curvature > 0:  # a strained lattice may fold this way: go on from what was found
            return x if step else p
        x += rz / curvature * p
        r -= rz / curvature * kp
    return x


# -- Motion ----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Moment:
    """One step of a motion; arrays are (R, C, L, 3), in mm, mm/ms and N.

    time        ms
    positions   U
    velocities  V, at the same time as the positions
    halfway     V half a step before; with indenters the one that keeps out of them
    forces      the springs' and the load's
    energy      N mm in the springs
    """

    time: float
    positions: np.ndarray
    velocities: np.ndarray
    halfway: np.ndarray
    forces: np.ndarray
    energy: float


def motion(
    lattice: Lattice,
    positions: np.ndarray,
    velocities: np.ndarray,
    step: float,
    damping: float = 0.0,
    load: Callable[[float], np.ndarray] | np.ndarray | None = None,
    constrain: Callable[[float, np.ndarray], np.ndarray] | None = None,
) -> Iterator[Moment]:
    """Velocity Verlet, eqs. (14)-(17), for ever: the state after each step.

        U' = U + V dt + A dt^2/2     V* = V + A dt/2     A' = F(U')/m - theta V*     V' = V* + A' dt/2

    positions, velocities  (R, C, L, 3) mm and mm/ms at the start; held coordinates stay where they are
    step                   dt in ms; stable below (sqrt(theta^2 + 4 w^2) - theta)/w^2, w = 2/lattice.longest_step
    damping                theta in 1/ms; energy is kept to order dt^2 without, and falls as it should to order dt with
                           it
    load                   (R, C, L, 3) N on the nodes, or a function of the time
    constrain              (time, U') -> U' where the nodes may be; V* follows: how indenters act

    Raises ValueError for an unstable step, a bad start, and where positions are no longer finite.
    """
    _positive("time step", step, "ms")
    if not (math.isfinite(damping) and damping >= 0):
        raise ValueError(
            f"damping = {damping:g} 1/ms; it must be 0 or more, {2 * lattice.frequency:.3g} damps the lowest swing"
        )
    limit = _longest_step(lattice, damping)
    if step > limit:
        raise ValueError(f"time step = {step:g} ms; Verlet is stable up to {limit:.3g} ms here, take {SAFETY} of that")
    positions = _shaped("positions", positions, (*lattice.shape, 3), "mm")
    velocities = _shaped("velocities", velocities, (*lattice.shape, 3), "mm/ms")
    return _moments(lattice, positions, velocities, step, damping, load, constrain)


def _longest_step(lattice: Lattice, damping: float) -> float:
    """ms: (sqrt(theta^2 + 4 w^2) - theta)/w^2, w the bound on the fastest swing."""
    fastest = 2 / lattice.longest_step
    return (math.sqrt(damping**2 + 4 * fastest**2) - damping) / fastest**2


def _moments(lattice, u, v, step, damping, load, constrain) -> Iterator[Moment]:
    free = lattice._free.reshape(u.shape)
    mass = lattice.mass[..., None]

    def pushed(now, u):
        f, energy = _forces(lattice, u.reshape(-1, 3))
        f = f.reshape(u.shape)
        if load is not None:
            f = f + (load(now) if callable(load) else load)
        return f, energy

    now, v = 0.0, v * free
    a = (pushed(now, u)[0] / mass - damping * v) * free
    while True:
        now += step
        to = u + v * step + a * (step * step / 2)
        half = v + a * (step / 2)
        if constrain is not None:
            kept = constrain(now, to)
            half, to = half + (kept - to) / step, kept
        u = to
        with np.errstate(all="ignore"):
            f, energy = pushed(now, u)
        if not math.isfinite(energy):
            raise ValueError(
                f"positions are not finite at {now:g} ms; take a step below {step:g} ms, smaller or slower loads"
            )
        a = (f / mass - damping * half) * free
        v = half + a * (step / 2)
        yield Moment(now, u, v, half, f, energy)


def settle(
    lattice: Lattice,
    push: Push | None = None,
    forces: np.ndarray | None = None,
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    damping: float | None = None,
    step: float | None = None,
    ramp: float | None = None,
    tolerance: float = 1e-5,
    most_steps: int = 20_000,
    progress: Callable[[int, float], None] | None = None,
) -> Deformed:
    """The skin's damped motion under a load until it rests: velocity Verlet, `motion`.

    push, forces, gravity, progress   as in `balance`; loads grow smoothly over the ramp
    damping     theta in 1/ms; None: 2 lattice.frequency, critical for the lowest swing
    step        dt in ms; None: SAFETY of the longest stable one
    ramp        ms; None: half a period of the lowest swing
    tolerance   rest: Deformed.residual and kinetic energy over the springs' are both below
    most_steps  the motion is given up after so many; `at_rest` is then False

    Nodes that get into the indenter in a step are put back out along its normal, and lose their velocity into it: no
    penalty stiffness, and the same contact at rest as in `balance`. Raises as `balance` and `motion` do."""
    setup = _Setup(lattice, push, forces, gravity)
    theta = 2 * lattice.frequency if damping is None else damping
    step = SAFETY * _longest_step(lattice, theta) if step is None else step
    ramp = math.pi / lattice.frequency if ramp is None else ramp
    _positive("ramp", ramp, "ms")
    shape, mass = (*lattice.shape, 3), lattice.mass[..., None]
    x, touching, steps, duration = lattice._rest, np.zeros(len(setup.face), bool), 0, 0.0
    legs = setup.legs()
    for leg in legs:
        leg.begin(x, touching)

        def share(now):
            return float(smooth_step(min(now / ramp, 1.0)))

        def constrain(now, u, leg=leg):
            nonlocal touching
            u, indenter = u.reshape(-1, 3).copy(), leg.indenter(share(now))
            u[leg.stuck] = leg.carried(share(now))
            if indenter is not None:
                u[setup.face], touching = indenter.put_out(u[setup.face])
                touching &= ~leg.stuck[setup.face]
            return u.reshape(shape)

        def load(now, leg=leg):
            return leg.nodal(share(now)).reshape(shape)

        for moment in motion(lattice, x.reshape(shape), np.zeros(shape), step, theta, load, constrain):
            steps += 1
            if steps % CHECKED and steps < most_steps:
                continue
            x = moment.positions.reshape(-1, 3)
            bounds = _Bounds(leg, x, touching, leg.indenter(share(moment.time)))
            residual = bounds.residual(moment.forces.reshape(-1, 3), setup.nodal)
            kinetic = float((mass * moment.halfway**2).sum()) / 2
            at_rest = moment.time >= ramp and residual <= tolerance and kinetic <= tolerance * moment.energy
            if progress is not None:
                progress(steps, residual)
            if at_rest or steps >= most_steps:
                break
        duration += moment.time
        if not at_rest:
            break
    at_rest = at_rest and leg is legs[-1]
    return _result(leg, share(moment.time), x, touching, at_rest, steps, duration)


def _positive(what: str, value: float, unit: str) -> None:
    if not (np.isscalar(value) and math.isfinite(value) and value > 0):
        raise ValueError(f"{what} = {value} {unit}; it must be a number above 0")


def _shaped(what: str, array: np.ndarray, shape: tuple[int, ...], unit: str) -> np.ndarray:
    array = np.asarray(array, float)
    if array.shape != shape or not np.isfinite(array).all():
        bad = (~np.isfinite(array)).sum()
        raise ValueError(
            f"{what} of shape {array.shape}, {bad} of them not finite; need finite {unit} of shape {shape}"
        )
    return array
