"""A soft layer on a rigid base: what the base takes from the motion that a half-space would have.

    less = base_correction(points, radii, shares, force, young, poisson, thickness)  (N, 3) mm, added to a half-space's

A normal load with the symmetry of a circle presses the face h = 0; the layer sticks to the base at h = t. In Hankel
space, with u = grad(phi + h psi) - 4 (1 - nu) psi e_h (Papkovich and Neuber) and harmonic phi, psi,

    u_h = phi' + h psi' - (3 - 4 nu) psi,                      u_r = -k (phi + h psi)          (of J0(kr) and J1(kr))
    s_hh = 2 G [phi'' + h psi'' - 2 (1 - nu) psi'] = -p,       s_rh = 0                        at h = 0
    u_h = u_r = 0                                                                              at h = t

are four equations for the parts of phi and psi that fall as exp(-kh) and rise as exp(k(h - t)). The half-space's
solution is subtracted before the way back: what is left falls as exp(-k (2t - h)) and has no peak under the load.

Source: Johnson, Contact Mechanics (1985), 5.8; Burmister, J. Appl. Phys. 16 (1945) 89; the tests hold the sum against
the equations of elasticity and the boundary conditions by differences."""

from __future__ import annotations

import math

import numpy as np

NODES = 160  # of the integral over k: the fields are wanted out to 5 thicknesses
DECAY = 24.0  # k t at its end: exp(-24) is left at the base, where it falls most slowly
CHUNK = 2000  # points at a time


def base_correction(
    points: np.ndarray,
    radii: np.ndarray,
    shares: np.ndarray,
    force: float,
    young: float,
    poisson: float,
    thickness: float,
) -> np.ndarray:
    """(N, 3) mm along x, y, h: displacement of a layer on a rigid base less that of a half-space.

    points      (N, 3) x, y, h in mm about the axis of the load, 0 <= h <= thickness
    radii, shares   of rings that stand for the load, mm and 1;   force  N;   thickness  t, mm
    """
    from scipy.special import j0, j1

    points = np.asarray(points, float)
    if len(points) and not (points[:, 2].min() >= -1e-9 and points[:, 2].max() <= thickness + 1e-9):
        raise ValueError(
            f"depths from {points[:, 2].min():g} to {points[:, 2].max():g} mm in a layer of {thickness:g} mm; allowed: "
            "0 to its thickness"
        )
    x, w = np.polynomial.legendre.leggauss(NODES)
    k, w = (x + 1) / 2 * DECAY / thickness, w / 2 * DECAY / thickness
    shear = young / (2 * (1 + poisson))
    load = force / (2 * math.pi) * (j0(k[:, None] * radii) * shares).sum(-1)
    falling, rising = _solved(k, load / (2 * shear), poisson, thickness)
    out = np.zeros_like(points)
    for start in range(0, len(points), CHUNK):
        at = points[start : start + CHUNK]
        r, h = np.hypot(at[:, 0], at[:, 1])[:, None], at[:, 2:]
        down, up = np.exp(-k * h), np.exp(k * (h - thickness))
        (a, b), (c, d) = falling, rising
        phi, psi = a * down + c * up, b * down + d * up
        slope_phi, slope_psi = k * (c * up - a * down), k * (d * up - b * down)
        into = ((slope_phi + h * slope_psi - (3 - 4 * poisson) * psi) * j0(k * r) * k * w).sum(-1)
        side = (-k * (phi + h * psi) * j1(k * r) * k * w).sum(-1)
        away = np.divide(side, r[:, 0], out=np.zeros_like(side), where=r[:, 0] > 0)
        out[start : start + CHUNK] = np.stack([away * at[:, 0], away * at[:, 1], into], -1)
    return out


def _solved(k: np.ndarray, load: np.ndarray, poisson: float, t: float) -> tuple:
    """(a, b), (c, d): phi = a exp(-kh) + c exp(k(h - t)), psi with b and d; of the layer less the half-space."""
    n, end = len(k), np.exp(-k * t)
    system, right = np.zeros((n, 4, 4)), np.zeros((n, 4))
    columns = ((0, -1.0, np.ones(n), end), (2, 1.0, end, np.ones(n)))  # first unknown, sign of the slope, at 0, at t
    for first, sign, top, bottom in columns:
        s = sign * k
        system[:, 0, first] = k * k * top
        system[:, 0, first + 1] = -2 * (1 - poisson) * s * top
        system[:, 1, first] = s * top
        system[:, 1, first + 1] = -(1 - 2 * poisson) * top
        system[:, 2, first] = s * bottom
        system[:, 2, first + 1] = (t * s - (3 - 4 * poisson)) * bottom
        system[:, 3, first] = bottom
        system[:, 3, first + 1] = t * bottom
    # the half-space: phi'' - 2 (1 - nu) psi' = -load and phi' = (1 - 2 nu) psi at h = 0, falling parts alone
    half_b = -load / k
    half_a = -(1 - 2 * poisson) * half_b / k
    # unknowns are the difference: no load at the face, and at the base minus what the half-space has there
    right[:, 2] = -((-k * half_a - (t * k + 3 - 4 * poisson) * half_b) * end)
    right[:, 3] = -((half_a + t * half_b) * end)
    scale = np.abs(system).max(-1, keepdims=True)
    found = np.linalg.solve(system / scale, (right / scale[..., 0])[..., None])[..., 0]
    return (found[:, 0], found[:, 1]), (found[:, 2], found[:, 3])
