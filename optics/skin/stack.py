"""How a stack of soft and stiff layers on a base gives way to pressure and shear on its face, wave by wave.

    stack = (Layer(4.0, 0.28, 0.48),)                                  the face first; thickness mm, E N/mm^2, nu
    soft = response(k, stack, depth=0.0)                               mm per N/mm^2 at the wave numbers k, 1/mm
    maps = fields(loads, pitch, stack, depth)                          displacement at a depth under loads on a grid

The layers stick to each other, and the last one to a rigid base; a last layer of infinite thickness is a half-space. In
each layer, with u = grad(phi + h psi) - 4 (1 - nu) psi e_h (Papkovich and Neuber), harmonic phi and psi, the depth h
from the layer's own face, L along the wave vector and T across it, the shear modulus G and loads ~ exp(i k L):

    u_h = phi' + h psi' - (3 - 4 nu) psi                u_L = i k (phi + h psi)               u_T = chi
    s_hh = 2 G [phi'' + h psi'' - 2 (1 - nu) psi']      s_Lh = 2 G i k [phi' + h psi' - (1 - 2 nu) psi]    s_Th = G chi'

are continuous from layer to layer and zero at the base. The parts that fall as exp(-kh) and rise as exp(k(h - t)) are
the unknowns, so that nothing overflows. nu = 1/2 is allowed.

Validity: small strains, layers without end. Closed forms that it meets: Boussinesq and Cerruti for one half-space, the
layer bonded to a rigid base, ((3 - 4 nu) sinh 2kt - 2kt) / ((3 - 4 nu) cosh 2kt + 2 (kt)^2 + 5 - 12 nu + 8 nu^2).
Source: Johnson, Contact Mechanics (1985), 5.8; Burmister, J. Appl. Phys. 16 (1945) 89.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from optics.skin.contact import LocalMap
from optics.skin.halfspace import REACH, Plane

MEAN = 1 / (4 * math.log(1 + math.sqrt(2)))  # of a square of wave numbers about 0: where 1/k has its mean over it
WAVES = 600  # lengths at which the response is solved; between them it is linear in log k, true to 1e-4
WIDE = 4.0  # thicknesses beside the loads: a layer on a rigid base moves by less than 1e-3 of the largest there


@dataclass(frozen=True)
class Layer:
    """One layer: thickness mm (infinite: a half-space, allowed last), Young's modulus N/mm^2, Poisson's ratio."""

    thickness: float
    young: float
    poisson: float

    def __post_init__(self):
        if not (self.thickness > 0 and self.young > 0 and math.isfinite(self.young) and 0 <= self.poisson <= 0.5):
            raise ValueError(
                f"layer: thickness {self.thickness:g} mm, E = {self.young:g} N/mm^2, Poisson's ratio {self.poisson:g}; "
                "allowed: thickness and E above 0, a ratio from 0 to 0.5"
            )

    @property
    def shear(self) -> float:
        """Shear modulus, N/mm^2."""
        return self.young / (2 * (1 + self.poisson))


class Response(NamedTuple):
    """Displacement per load of a wave, mm per N/mm^2, of the shape of k. With loads q_L, q_T along the face and the
    pressure p: u_L = along q_L + i side p, u_T = across q_T, u_h = down p - i lift q_L."""

    along: np.ndarray
    across: np.ndarray
    down: np.ndarray
    side: np.ndarray
    lift: np.ndarray


def half_space(k: np.ndarray, layer: Layer) -> Response:
    """What `response` is at the face of one layer without end (Boussinesq, Cerruti)."""
    soft = 1 / (layer.shear * k)
    down, side = (1 - layer.poisson) * soft, (1 - 2 * layer.poisson) / 2 * soft
    return Response(down, soft, down, side, side)


def response(k: np.ndarray, stack: Sequence[Layer], depth: float = 0.0) -> Response:
    """Displacement per load at a depth (mm) below the untouched face, for wave numbers k > 0 (1/mm) of any shape."""
    stack = tuple(stack)
    if not stack or any(math.isinf(layer.thickness) for layer in stack[:-1]):
        raise ValueError(f"{len(stack)} layers; allowed: one or more, of which only the last may have no end")
    total = sum(layer.thickness for layer in stack)
    if not 0 <= depth <= total + 1e-9:
        raise ValueError(f"depth {depth:g} mm in a stack of {total:g} mm; allowed: 0 to its thickness")
    shape, k = np.shape(k), np.ravel(np.asarray(k, float))
    at, inside = depth, 0
    while inside < len(stack) - 1 and at > stack[inside].thickness:
        at -= stack[inside].thickness
        inside += 1
    unit = max(layer.shear for layer in stack)
    n, layers = len(k), len(stack)
    plane, plane_load = np.zeros((n, 4 * layers, 4 * layers)), np.zeros((n, 4 * layers, 2))
    turn, turn_load = np.zeros((n, 2 * layers, 2 * layers)), np.zeros((n, 2 * layers, 1))
    tops = [_state(k, layer, 0.0, unit) for layer in stack]
    ends = [_state(k, layer, layer.thickness, unit) for layer in stack]
    plane[:, :2, :4], plane_load[:, 0, 0], plane_load[:, 1, 1] = tops[0][0][:, 2:], -1 / (unit * k), -1 / (unit * k)
    turn[:, :1, :2], turn_load[:, 0, 0] = tops[0][1][:, 1:], -1 / (unit * k)
    for i in range(layers - 1):
        rows, left, right = (slice(m * i + m // 2, m * (i + 1) + m // 2) for m in (4, 2)), 4 * i, 2 * i
        both, one = rows
        plane[:, both, left : left + 8] = np.concatenate([ends[i][0], -tops[i + 1][0]], -1)
        turn[:, one, right : right + 4] = np.concatenate([ends[i][1], -tops[i + 1][1]], -1)
    plane[:, -2:, -4:], turn[:, -1:, -2:] = ends[-1][0][:, :2], ends[-1][1][:, :1]
    if math.isinf(stack[-1].thickness):  # nothing rises from infinitely deep
        plane[:, -2:, -4:], turn[:, -1:, -2:] = np.eye(4)[2:], np.eye(2)[1:]
    found, turned = np.linalg.solve(plane, plane_load), np.linalg.solve(turn, turn_load)
    here, around = _state(k, stack[inside], at, unit)
    motion = here[:, :2] @ found[:, 4 * inside : 4 * inside + 4]  # (n, [u_L / i, u_h], [q_L / i, p])
    across = (around[:, :1] @ turned[:, 2 * inside : 2 * inside + 2])[:, 0, 0]
    values = (motion[:, 0, 0], across, motion[:, 1, 1], motion[:, 0, 1], motion[:, 1, 0])
    return Response(*(v.reshape(shape) for v in values))


def _state(k: np.ndarray, layer: Layer, h: float, unit: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows u_L/i, u_h, s_Lh/i, s_hh (stresses over unit k) of the amplitudes k phi and psi that fall and those that
    rise, (n, 4, 4); and rows u_T, s_Th, (n, 2, 2)."""
    end = math.isinf(layer.thickness)
    down = np.exp(-k * h) if math.isfinite(h) else np.zeros_like(k)
    up = np.zeros_like(k) if end else np.exp(k * (h - layer.thickness))
    kh = k * (h if math.isfinite(h) else 0.0)
    nu, stiff = layer.poisson, 2 * layer.shear / unit
    columns, turning = [], []
    for size, s in ((down, -1.0), (up, 1.0)):  # s k is the slope over the value
        one = np.ones_like(k)
        of_phi = (one, s * one, stiff * s * one, stiff * one)
        of_psi = (
            kh,
            s * kh - (3 - 4 * nu),
            stiff * (s * kh - (1 - 2 * nu)),
            stiff * (kh - 2 * (1 - nu) * s),
        )
        columns += [np.stack(of, -1) * size[:, None] for of in (of_phi, of_psi)]
        turning.append(np.stack([one, stiff / 2 * s * one], -1) * size[:, None])
    return np.stack(columns, -1), np.stack(turning, -1)


def fields(
    pressure: np.ndarray, shear: np.ndarray, pitch: float, stack: Sequence[Layer], depth: float
) -> tuple[LocalMap, LocalMap, LocalMap]:
    """Displacement along x and y and into the stack (mm) at a depth, under loads on a grid around the press axis.

    pressure   (n, n) N/mm^2, n odd, [v, u];   shear  (n, n, 2) N/mm^2, along x and y;   pitch  mm

    The maps are WIDE thicknesses wider than the loads on each side and fade to zero over their outer eighth. A stack
    without a rigid base moves far and wide, and is cut there; its thickness counts as five times the loads' width."""
    thickness = sum(layer.thickness for layer in stack)
    thickness = thickness if math.isfinite(thickness) else 5 * pitch * len(pressure)
    total = None
    for load, axis in ((pressure, "h"), (shear[..., 0], "x"), (shear[..., 1], "y")):
        if not load.any():
            continue
        plane = Plane(load, pitch, depth, WIDE * thickness / REACH)
        k = np.where(plane.k == 0, MEAN * plane.k[0, 1], plane.k)
        nodes = np.geomspace(k.min(), k.max(), WAVES)
        along, across, down, side, lift = (
            np.interp(np.log(k), np.log(nodes), values) for values in response(nodes, stack, depth)
        )
        if axis == "h":
            moved = (1j * side * plane.cos, 1j * side * plane.sin, down)
        else:
            same, other = (plane.cos, plane.sin) if axis == "x" else (plane.sin, plane.cos)
            # where k = 0 there is no direction, and along and across are one
            straight = np.where(plane.k == 0, across, along * same**2 + across * other**2)
            sideways = (along - across) * same * other
            moved = (*((straight, sideways) if axis == "x" else (sideways, straight)), -1j * lift * same)
        maps = [plane.map(each) for each in moved]
        total = maps if total is None else [LocalMap(a.values + b.values, a.pitch) for a, b in zip(total, maps)]
    if total is None:
        return (LocalMap(np.zeros_like(pressure), pitch),) * 3
    return tuple(total)
