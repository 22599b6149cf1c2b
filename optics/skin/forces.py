"""How forces on the face of a soft half-space move what lies in it: point forces, pressures, a ball that is pressed.

    u = displacements(points, places, forces, young)          any number of point forces, superposed
    load = ball(depth, radius)                                contact of a rigid ball: size, force, pressure, face
    places, forces = load.nodes(young)                        its pressure as point forces

A force F on the face at the origin moves the point s = (x, y, h), h > 0 below the face, by H F with R = |s| (eq. (2) of
the source; the last column is Boussinesq's solution, the first two are Cerruti's):

    H = (1 + nu)/(2 pi E R) [ (R^2 + x^2)/R^2 + (1 - 2 nu)(R^2 + R h - x^2)/(R + h)^2
                              x y/R^2 - (1 - 2 nu) x y/(R + h)^2                          ...
                              z-components: x h/R^2 + (1 - 2 nu) x/(R + h), ..., h^2/R^2 + 2 (1 - nu) ]

Frame: x right, y down as the world's, h = -z into the skin; forces and displacements have the components (x, y, h), so
that a force (0, 0, 1) pushes the skin in. Units: mm, N, N/mm^2 (MPa).

A rigid ball of the radius R, frictionless, that sinks in by delta touches up to a, c R = R tanh(s) (Sneddon):

    delta = R s tanh(s) at c = a,   F = E* [(a^2 + R^2) s_a - a R],   E* = E/(1 - nu^2)
    u(r) = delta - R + sqrt(R^2 - r^2) up to a, integral (2/pi) asin(c/r) d delta(c) beyond

which is Hertz' contact for a << R and holds beyond it: a needle with a round end touches nothing but its end while
a < R. Every ring of the contact is the pressure of a flat punch, E* d delta/(pi sqrt(c^2 - r^2)).

Validity: small strains, one material without end. A layer on a rigid base gives way less:
optics/skin/layer.py.
Source: Design, Motivation and Evaluation of a Full-Resolution Optical Tactile Sensor, Sensors 19 (2019) 928, eqs. (1)
and (2); Johnson, Contact Mechanics (1985), 3.2, 3.6, 4.2; Sneddon, Int. J. Eng. Sci. 3 (1965) 47.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

RADII, ANGLES = 4, 12  # of the nodes of a pressure: two contact radii away the error is 1e-5 of the displacement
FINE = 48  # of a quadrature over a contact
CHUNK = 200_000  # point-node pairs at a time: 15 MB


def unit_displacements(points: np.ndarray, young: float, poisson: float = 0.5) -> np.ndarray:
    """H (..., 3, 3), mm/N: column k is the displacement of a point by the unit force k on the face at the origin.

    points   (..., 3) x, y, h in mm, h >= 0, none at the origin
    young    E, N/mm^2; poisson  nu, 0 to 1/2
    """
    points = np.asarray(points)
    points = points if np.iscomplexobj(points) else points.astype(float)
    _check(points, young, poisson)
    x, y, h = np.moveaxis(points, -1, 0)
    r = np.sqrt(x * x + y * y + h * h)
    if np.any(r == 0):
        raise ValueError("a point lies at the force itself, where the displacement has no bound; spread the force")
    soft, below = 1 - 2 * poisson, r + h
    rows = np.empty((*points.shape, 3), points.dtype)
    rows[..., 0, 0] = 1 + x * x / r**2 + soft * (r**2 + r * h - x * x) / below**2
    rows[..., 1, 1] = 1 + y * y / r**2 + soft * (r**2 + r * h - y * y) / below**2
    rows[..., 0, 1] = rows[..., 1, 0] = x * y / r**2 - soft * x * y / below**2
    for i, side in enumerate((x, y)):
        rows[..., i, 2] = side * h / r**2 - soft * side / below
        rows[..., 2, i] = side * h / r**2 + soft * side / below
    rows[..., 2, 2] = h * h / r**2 + 2 * (1 - poisson)
    return rows * ((1 + poisson) / (2 * math.pi * young) / r)[..., None, None]


def displacements(
    points: np.ndarray, places: np.ndarray, forces: np.ndarray, young: float, poisson: float = 0.5
) -> np.ndarray:
    """(N, 3) displacement in mm of points by any number of point forces on the face.

    points   (N, 3) x, y, h in mm, h >= 0
    places   (K, 2) x, y of the forces, mm;   forces  (K, 3) N, the third one into the skin

    Raises ValueError for a force that pulls the skin outwards: nothing in contact does that.
    """
    points, places, forces = (np.asarray(a, float) for a in (points, places, forces))
    if places.shape != (len(forces), 2) or forces.shape != (len(forces), 3):
        raise ValueError(f"places {places.shape} and forces {forces.shape}; they must be (K, 2) and (K, 3)")
    if len(forces) and forces[:, 2].min() < 0:
        k = int(forces[:, 2].argmin())
        raise ValueError(
            f"force {k} has a normal part of {forces[k, 2]:g} N: it lifts the skin off; allowed: 0 and more, "
            "which pushes the skin in"
        )
    moved = np.zeros(points.shape)
    step = max(1, CHUNK // max(len(forces), 1))
    for start in range(0, len(points) if len(forces) else 0, step):
        at = points[start : start + step]
        relative = np.concatenate(
            [at[:, None, :2] - places, np.broadcast_to(at[:, None, 2:], (len(at), len(places), 1))], -1
        )
        moved[start : start + step] = np.einsum("nkij,kj->ni", unit_displacements(relative, young, poisson), forces)
    return moved


# -- Pressures ---------------------------------------------------------------------------------------------------------
def pressure_nodes(pressure: np.ndarray, pitch: float, traction: tuple[float, float] = (0.0, 0.0)) -> tuple:
    """A pressure on a square grid as point forces: places (K, 2) mm and forces (K, 3) N.

    pressure   (H, W) N/mm^2 at the middles of cells around the origin, >= 0;  pitch  mm
    traction   shear stress along x and y over the pressure

    Good at depths from one pitch on.
    """
    pressure = np.asarray(pressure, float)
    if pressure.ndim != 2 or not np.isfinite(pressure).all() or pressure.min(initial=0) < 0 or not pitch > 0:
        raise ValueError(
            f"pressure of shape {pressure.shape}, smallest {pressure.min(initial=0):g} N/mm^2, pitch {pitch:g} mm; "
            "allowed: a grid of finite values >= 0 (below 0 the skin would lift off) and pitch > 0"
        )
    v, u = np.nonzero(pressure)
    places = np.stack([u - (pressure.shape[1] - 1) / 2, v - (pressure.shape[0] - 1) / 2], -1) * pitch
    return places, (pressure[v, u] * pitch**2)[:, None] * [*traction, 1.0]


@dataclass(frozen=True)
class Ball:
    """Contact of a rigid ball that sinks into a half-space: `depth`, `radius` and the contact radius `a`, mm."""

    depth: float
    radius: float
    a: float

    def stiff_force(self) -> float:
        """F/E* in mm^2."""
        if self.a == 0:
            return 0.0
        s = self.depth / self.a
        if s * s < 1e-4:  # where the difference below has no digits left: Hertz, true to s^2
            return 4 / 3 * math.sqrt(self.radius) * self.depth**1.5
        return (self.a**2 + self.radius**2) * s - self.a * self.radius

    def force(self, young: float, poisson: float = 0.5) -> float:
        """Normal force, N."""
        return self.stiff_force() * young / (1 - poisson**2)

    def _rings(self) -> tuple[np.ndarray, np.ndarray]:
        """Radii c of flat punches that make up the contact, and the depth d delta of each, mm."""
        t, w = _gauss(FINE)
        s = t * self.depth / self.a
        slope = np.tanh(s) + s / np.cosh(s) ** 2
        return self.radius * np.tanh(s), self.radius * slope * w * self.depth / self.a

    def face(self, r: np.ndarray) -> np.ndarray:
        """Displacement of the face into the skin at the distances r from the axis, mm."""
        r = np.abs(np.asarray(r, float))
        if self.a == 0:
            return np.zeros_like(r)
        inside = r <= self.a
        c, d = self._rings()
        beyond = (2 / np.pi * np.arcsin(c / np.where(inside, np.inf, r)[..., None]) * d).sum(-1)
        cap = self.depth - self.radius + np.sqrt(np.maximum(self.radius**2 - r**2, 0))
        return np.where(inside, cap, beyond)

    def rings(self) -> tuple[np.ndarray, np.ndarray]:
        """Radii, mm, of rings that stand for the pressure, and the share of the force of each.

        They are Gauss' for the pressure's own weight, so that its moments up to r^14 are true."""
        if self.a == 0:
            return np.zeros(0), np.zeros(0)
        c, d = self._rings()
        t, w = _gauss(FINE)
        square = (c[:, None] ** 2 * (1 - t**2)).ravel() / self.a**2
        share = (2 * c * d)[:, None] * w  # of a punch: uniform in t = sqrt(1 - r^2/c^2)
        q, weight = _condensed(square, share.ravel(), RADII)
        return self.a * np.sqrt(q), weight / weight.sum()

    def nodes(self, young: float, poisson: float = 0.5, shear: tuple[float, float] = (0.0, 0.0)) -> tuple:
        """The pressure as point forces: places (K, 2) mm, forces (K, 3) N.

        shear   tangential force along x and y over the normal force, spread as the pressure is"""
        r, share = self.rings()
        angle = 2 * np.pi * (np.arange(ANGLES) + np.arange(len(r))[:, None] / 2) / ANGLES
        places = np.stack([r[:, None] * np.cos(angle), r[:, None] * np.sin(angle)], -1).reshape(-1, 2)
        normal = np.repeat(share * self.force(young, poisson), ANGLES) / ANGLES
        return places, normal[:, None] * np.array([*shear, 1.0])


def ball(depth: float, radius: float) -> Ball:
    """The contact of a rigid ball of a radius that sinks in by a depth, mm; a depth of 0 and below touches nothing."""
    if not (radius > 0 and math.isfinite(depth)):
        raise ValueError(f"ball: depth {depth:g} mm, radius {radius:g} mm; allowed: a finite depth, a radius above 0")
    if depth <= 0:
        return Ball(0.0, radius, 0.0)
    wanted = depth / radius
    s = math.sqrt(wanted) if wanted < 1 else wanted  # s tanh(s) = wanted: convex, from above Newton's steps fall
    for _ in range(50):
        tanh = math.tanh(s)
        step = (s * tanh - wanted) / (tanh + s * (1 - tanh * tanh))
        s -= step
        if abs(step) < 1e-14 * s:
            break
    return Ball(depth, radius, radius * math.tanh(s))


def ball_by_force(force: float, radius: float, young: float, poisson: float = 0.5) -> Ball:
    """The contact of a rigid ball that bears a normal force, N."""
    from scipy.optimize import brentq

    if force < 0:
        raise ValueError(f"normal force = {force:g} N lifts the skin off; allowed: 0 and more")
    wanted = force * (1 - poisson**2) / young
    if wanted == 0:
        return ball(0.0, radius)
    high = (wanted / (4 / 3 * math.sqrt(radius))) ** (2 / 3) + wanted / radius
    while ball(high, radius).stiff_force() < wanted:
        high *= 2
    return ball(brentq(lambda d: ball(d, radius).stiff_force() - wanted, 0.0, high, xtol=1e-14, rtol=1e-13), radius)


def _gauss(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights of Gauss and Legendre on 0 to 1."""
    x, w = np.polynomial.legendre.leggauss(n)
    return (x + 1) / 2, w / 2


def _condensed(x: np.ndarray, weight: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss' n nodes and weights for a measure of many points: the moments up to 2 n - 1 stay (Stieltjes)."""
    before, now = np.zeros_like(x), np.ones_like(x)
    a, b, size = [], [], weight.sum()
    for _ in range(n):
        norm = (weight * now**2).sum()
        b.append(norm / size)
        a.append((weight * x * now**2).sum() / norm)
        size = norm
        before, now = now, (x - a[-1]) * now - (b[-1] if len(a) > 1 else 0.0) * before
    off = np.sqrt(b[1:])
    q, vectors = np.linalg.eigh(np.diag(a) + np.diag(off, 1) + np.diag(off, -1))
    return q, weight.sum() * vectors[0] ** 2


def _check(points: np.ndarray, young: float, poisson: float) -> None:
    if points.shape[-1:] != (3,) or not np.isfinite(points).all() or np.any(points[..., 2].real < 0):
        raise ValueError(
            f"points of shape {points.shape}; allowed: (..., 3) finite x, y, h in mm with h >= 0, below the face"
        )
    if not (young > 0 and math.isfinite(young) and 0 <= poisson <= 0.5):
        raise ValueError(f"E = {young:g} N/mm^2, Poisson's ratio {poisson:g}; allowed: E > 0, a ratio from 0 to 0.5")
