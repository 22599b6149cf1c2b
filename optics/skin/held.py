"""The contact of any indenter with a skin that is held at its rim, free behind, and stiffened by a film.

    skin = held_skin(48.0, 43.0, 5.0, 0.04, 0.49, 0.003)       mm, N/mm^2, springs N/mm^3; solved once, kept
    touch = indent(profile, depth, (x, y), skin)               optics.skin.pressing.Contact, of this skin
    moved = touch.moved(x, y, (x0, y0), depth)                 mm along x, y and into the skin

Elements of 2 mm (optics.skin.composite) tell how the skin bends, and nothing of a contact of 2 mm. So the influence of
a load is parted in two:

    K = K_layer + (K_held - K_bonded)

K_layer, exact, is that of an endless layer of this thickness on a rigid window (optics.skin.stack), on a fine grid.
K_held and K_bonded are finite elements of one mesh, of this skin and of that layer. Close to the load both err alike,
and the error falls out; what is left varies over a thickness, and cubic splines carry it to the fine grid. Pressure is
the solution of p >= 0, K p >= overlap, p (K p - overlap) = 0, by an active set.

Validity: small strains, as in the source, whose skin is pressed to three fifths of its thickness all the same; friction
does not change the pressure. A press nearer to the rim than a thickness or two feels more of it than this.
Source: optics.skin.composite; the splitting of a Green's function into a near closed form and a far numerical part.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from optics.skin import pressing
from optics.skin.composite import FORMS, Skin, complementary, solver
from optics.skin.contact import LocalMap, Profile, local_axis, surface
from optics.skin.pressing import MARGIN, Contact
from optics.skin.stack import Layer, fields

NODES = 31  # across the grid of a contact: a ball's force is then true to 3e-3 of itself
COARSE = 17  # of the first solution, which says where the fine one looks
ELEMENTS = 4  # through the thickness, the film's plane in the middle
EDGE = 0.4  # of the thickness, of an element along the face
AT_A_TIME = 64  # loads
MOST = 40  # elements along a side
COMPRESSIBLE = 0.4995  # the largest ratio of these elements: forces of a held skin are then true to 1e-3
PITCH = 0.25  # mm, of maps that cover the whole skin


class HeldSkin:
    """Finite elements of a skin, as what they add to an endless layer on a window.

    differences   (load node, z, y, x, 3) mm/N along x, y and inwards: of a unit load along one axis (0, 1: x, y; 2:
                  inwards) at each node of the outer face, of this skin less of the layer; planes z from the inner face
                  to the outer one
    """

    def __init__(self, width: float, length: float, thickness: float, young: float, poisson: float, springs: float):
        counts = (2 * min(max(round(side / (2 * EDGE * thickness)), 4), MOST // 2) for side in (width, length))
        poisson = min(poisson, COMPRESSIBLE)
        self.skin = Skin((width, length, thickness), (*counts, ELEMENTS), young, poisson, ELEMENTS // 2)
        self.springs = springs
        self.layer = Layer(thickness, young, poisson)
        self.axes = [np.linspace(-side / 2, side / 2, n) for side, n in zip((width, length), self.skin.shape)]
        self._differences: dict[int, np.ndarray] = {}

    def differences(self, axis: int) -> np.ndarray:
        if axis not in self._differences:
            self._differences[axis] = self._solve(axis)
        return self._differences[axis]

    def _solve(self, axis: int) -> np.ndarray:
        """The loads along one axis (0, 1: x, y; 2: inwards), and what the layer would do less."""
        skin = self.skin
        nx, ny, nz = skin.shape
        face = skin.layer(0)
        base = np.zeros(len(skin.nodes), bool)
        base[skin.layer(ELEMENTS)] = True
        sign = np.array([1.0, 1.0, -1.0])  # inwards is -z

        def moved(nodes: np.ndarray, solve) -> np.ndarray:
            found = np.empty((len(nodes), nx, ny, nz, 3))
            for start in range(0, len(nodes), AT_A_TIME):
                some = nodes[start : start + AT_A_TIME]
                loads = np.zeros((3 * len(skin.nodes), len(some)))
                loads[3 * some + axis, np.arange(len(some))] = sign[axis]
                found[start : start + AT_A_TIME] = solve(loads).T.reshape(len(some), nx, ny, nz, 3) * sign
            return found

        bonded = moved(face[[(nx // 2) * ny + ny // 2]], solver(skin, 0.0, FORMS[0], base | skin.held))[0]
        quarter = face.reshape(nx, ny)[: (nx + 1) // 2, : (ny + 1) // 2]
        found = np.empty((nx, ny, nx, ny, nz, 3))
        found[: quarter.shape[0], : quarter.shape[1]] = moved(
            quarter.ravel(), solver(skin, self.springs, FORMS[0], skin.held)
        ).reshape(*quarter.shape, nx, ny, nz, 3)
        self._mirror(found, axis)
        for i in range(nx):
            for j in range(ny):  # of a layer without end, the motion about any load is that about the middle
                x, y = ((max(0, a), min(n, n + a)) for a, n in ((i - nx // 2, nx), (j - ny // 2, ny)))
                here = found[i, j, slice(*x), slice(*y)]
                here -= bonded[x[0] - i + nx // 2 : x[1] - i + nx // 2, y[0] - j + ny // 2 : y[1] - j + ny // 2]
        return np.ascontiguousarray(found.transpose(1, 0, 4, 3, 2, 5).reshape(nx * ny, nz, ny, nx, 3))

    @staticmethod
    def _mirror(found: np.ndarray, axis: int) -> None:
        """Fill in the loads beyond the first quarter: the skin is its own mirror image along x and along y."""
        for along in (0, 1):
            loads = np.moveaxis(found, along, 0)
            n = len(loads)
            signs = np.where(np.arange(3) == along, -1.0, 1.0) * (-1.0 if axis == along else 1.0)
            loads[(n + 1) // 2 :] = np.flip(loads[: n // 2][::-1], 2 + along) * signs

    @cached_property
    def splines(self) -> tuple[Any, Any]:
        """Cardinal cubic splines of the face's nodes along x and y."""
        from scipy.interpolate import make_interp_spline

        return tuple(make_interp_spline(axis, np.eye(len(axis)), k=3) for axis in self.axes)  # type: ignore[return-value]

    def weights(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """(N, nodes of the face) shares of the nodes in a value at places (N,), mm, x fastest; 0 beyond the rim."""
        one, two = self._along(x, 0), self._along(y, 1)
        return (two[:, :, None] * one[:, None, :]).reshape(len(one), two.shape[1] * one.shape[1])

    def _along(self, at: np.ndarray, axis: int) -> np.ndarray:
        ends = self.axes[axis][[0, -1]]
        inside = (at >= ends[0]) & (at <= ends[1])
        return self.splines[axis](np.clip(at, *ends)) * inside[:, None]

    def compliance(self, axis: int) -> np.ndarray:
        """(nodes, nodes) mm/N of the face along the load."""
        found = self.differences(axis)[:, -1, ..., axis]
        found = found.reshape(len(found), -1)
        return (found + found.T) / 2  # rounding

    def plane(self, nodal: np.ndarray, depth: float) -> np.ndarray:
        """(y, x, 3) mm at the nodes of the plane at a depth, of loads (nodes, 3) in N at the face's nodes; linear
        between the elements' planes."""
        at = min(max(ELEMENTS * (1 - depth / self.layer.thickness), 0.0), float(ELEMENTS))
        low = min(int(at), ELEMENTS - 1)
        total = np.zeros((*(len(a) for a in self.axes[::-1]), 3))
        for axis in range(3):
            if nodal[:, axis].any():
                planes = self.differences(axis)[:, low : low + 2]
                two = np.tensordot(nodal[:, axis], planes, 1)
                total += (low + 1 - at) * two[0] + (at - low) * two[1]
        return total


held_skin = lru_cache(maxsize=2)(HeldSkin)


@dataclass(frozen=True, eq=False)
class HeldContact(Contact):
    """A Contact with a held skin, pressed at `place` (x, y) mm."""

    skin: HeldSkin = field(kw_only=True)
    place: tuple[float, float] = field(kw_only=True)

    @cached_property
    def nodal(self) -> np.ndarray:
        """(nodes, 3) N: the forces, shared out to the nodes of the face."""
        v, u = np.nonzero(self.touched | self.shear.any(-1))
        weights = self.skin.weights(self.place[0] + self.axis[u], self.place[1] + self.axis[v])
        return weights.T @ self.forces[v, u]

    def moved(self, x: np.ndarray, y: np.ndarray, press: tuple[float, float], depth: float = 0.0) -> np.ndarray:
        x, y = np.broadcast_arrays(*(np.asarray(a, float) for a in (x, y))) if np.ndim(x) != 2 else (x, y)
        maps = self._near(depth)
        near = [surface(x, y, *self.place, m) for m in maps]
        plane = self._far(depth)
        if np.ndim(x) == 2 and np.shape(x)[0] == 1 and np.shape(y)[1:] == (1,):
            two, one = self.skin._along(y[:, 0], 1), self.skin._along(x[0], 0)
            far = np.einsum("vj,jic,ui->cvu", two, plane, one, optimize=True)
        else:
            at = [np.ravel(a) for a in np.broadcast_arrays(x, y)]
            one, two = self.skin._along(at[0], 0), self.skin._along(at[1], 1)
            far = np.einsum("nj,jic,ni->cn", two, plane, one, optimize=True)
            far = far.reshape(3, *np.broadcast_shapes(np.shape(x), np.shape(y)))
        return np.stack(np.broadcast_arrays(*near)) + far

    def _near(self, depth: float) -> tuple[LocalMap, LocalMap, LocalMap]:
        if ("near", depth) not in self._kept:
            self._kept["near", depth] = fields(self.pressure, self.shear, self.pitch, self.stack, depth)
        return self._kept["near", depth]

    def _far(self, depth: float) -> np.ndarray:
        if ("far", depth) not in self._kept:
            self._kept["far", depth] = self.skin.plane(self.nodal, depth)
        return self._kept["far", depth]

    @cached_property
    def _kept(self) -> dict:
        return {}

    def displacement(self, depth: float = 0.0) -> tuple[LocalMap, LocalMap, LocalMap]:
        """As maps that cover the whole skin; `moved` is exact and faster."""
        half = max(abs(p) + side[-1] for p, side in zip(self.place, self.skin.axes)) + 2 * PITCH
        axis = local_axis(2 * math.ceil(half / PITCH) + 1, PITCH)
        x, y = self.place[0] + axis[None, :], self.place[1] + axis[:, None]
        return tuple(LocalMap(m, PITCH) for m in self.moved(x, y, self.place, depth))  # type: ignore[return-value]

    def sideways(self) -> pressing.Operator:
        """The influence of shear, for pressing.drag."""
        layer = super().sideways()
        u, v = np.meshgrid(self.axis, self.axis)
        weights = self.skin.weights(self.place[0] + u.ravel(), self.place[1] + v.ravel())
        used = np.flatnonzero(np.abs(weights).max(0) > 1e-9)
        weights = weights[:, used]
        between = self._sideways(used) * self.pitch**2
        n = len(self.axis)

        def moved(q: np.ndarray) -> np.ndarray:
            nodal = (q.reshape(2, -1) @ weights).ravel()
            return layer.moved(q) + ((between @ nodal).reshape(2, -1) @ weights.T).reshape(2, n, n)

        gram = np.kron(np.eye(2), weights.T @ weights)
        steepest = float(np.abs(np.linalg.eigvals(between @ gram)).max())
        return pressing.Operator(moved, layer.steepest + steepest)

    def _sideways(self, used: np.ndarray) -> np.ndarray:
        """(2 n, 2 n) mm/N between some nodes of the face, x before y."""
        rows = []
        for load in (0, 1):
            face = self.skin.differences(load)[used, -1]
            face = face.reshape(len(used), -1, 3)[:, used]
            rows.append(np.concatenate([face[..., 0].T, face[..., 1].T]))
        whole = np.concatenate(rows, 1)
        return (whole + whole.T) / 2


@lru_cache(maxsize=4)
def indent(profile: Profile, depth: float, place: tuple[float, float], skin: HeldSkin) -> HeldContact:
    """The contact of an indenter whose lowest point is `depth` mm below the untouched face; kept, do not write into
    it."""
    half = pressing.reach(profile, depth)
    inside = None
    for n in (COARSE, NODES):
        pitch = 2 * half / (n - 1)
        overlap = depth - pressing.lowest(profile, local_axis(n, pitch))
        pressure = _solve(overlap, pitch, place, skin, depth, inside)
        inside = pressure > 0, local_axis(n, pitch)
    none = np.zeros((n, n, 2))
    return HeldContact(overlap, pressure, none, np.zeros((n, n), bool), pitch, (skin.layer,), skin=skin, place=place)


def _solve(
    overlap: np.ndarray, pitch: float, place: tuple[float, float], skin: HeldSkin, depth: float, before
) -> np.ndarray:
    """(n, n) N/mm^2. before: what a coarser grid found touched, and its axis; the search is beside it, and as far as
    the solution asks for."""
    from scipy.ndimage import binary_dilation, map_coordinates

    n = len(overlap)
    pressure = np.zeros((n, n))
    if depth <= 0 or overlap.max() <= 0:
        return pressure
    able = overlap > -MARGIN * depth
    axis = local_axis(n, pitch)
    look, start = able.copy(), overlap > 0
    if before is not None and before[0].any():
        touched, coarse = before
        at = (axis - coarse[0]) / (coarse[1] - coarse[0])
        share = map_coordinates(touched.astype(float), np.meshgrid(at, at, indexing="ij"), order=1)
        look, start = able & binary_dilation(share > 0, iterations=2), share > 0.5
    wrapped = pressing.Influence(n, pitch, (skin.layer,)).cells
    m = len(wrapped)
    on_skin = np.logical_and.outer(*(np.abs(p + axis) <= a[-1] for p, a in zip(place[::-1], skin.axes[::-1])))
    able &= on_skin
    while True:
        v, u = np.nonzero(look & on_skin)
        if not len(v):
            return pressure
        weights = skin.weights(place[0] + axis[u], place[1] + axis[v])
        used = np.flatnonzero(np.abs(weights).max(0, initial=0.0) > 1e-9)
        weights = weights[:, used]
        between = skin.compliance(2)[np.ix_(used, used)] * pitch**2
        matrix = wrapped[(v[:, None] - v) % m, (u[:, None] - u) % m] + weights @ between @ weights.T
        pressure[:] = 0.0
        pressure[v, u] = complementary(matrix, overlap[v, u], start[v, u])
        rest = able & ~look
        if not rest.any():
            return pressure
        b, a = np.nonzero(rest)
        own = pressure[v, u]
        far = skin.weights(place[0] + axis[a], place[1] + axis[b])[:, used] @ (between @ (weights.T @ own))
        short = overlap[b, a] - far - wrapped[(b[:, None] - v) % m, (a[:, None] - u) % m] @ own
        if not (short > 1e-6 * depth).any():
            return pressure
        look, start = able, pressure > 0
