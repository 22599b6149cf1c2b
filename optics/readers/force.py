"""The force on a skin from the motion of the beads in it, in a pinhole camera's image.

    moved = image_motion(points, u, focal, distance)          dp of (3), px
    force = reconstruct(points, moved, unit, focal, distance) (8), N: by the pseudo-inverse
    kappa = condition(points, force, unit, focal, distance)   (10), N/px: error of the force per noise in dp

A point force F at the origin moves bead j at (x, y, h) by H_j F (`unit`: optics.skin.forces.unit_displacements). The
camera looks at the skin from a distance d below its face, so that a bead stands d - h in front of it, and its focal
length is f px. What (3) gives for the motion in the image is linear in F at the observed motion (6):

    dp_j = P_j(dp_j) F,   P_j = [dp_j + f (x, y)/(d - h)] H_j3/(d - h) + f H_j12/(d - h)

One bead gives two equations for three unknowns; all beads together are solved in the sense of least squares, which
without noise is exact. Noise in dp becomes J dp with J = P+ (1 - diag(H_j3 F/(d - h_j))) where dp is free of noise, and
kappa is the Frobenius norm of J.

Only two numbers of camera and skin can be found from images of known forces: f/E, by which every motion is multiplied,
and d. Source: Sensors 19 (2019) 928, eqs. (3)-(10) and appendix B.
"""

from __future__ import annotations

import numpy as np


def image_motion(points: np.ndarray, moved: np.ndarray, focal: float, distance: float) -> np.ndarray:
    """(N, 2) px: by how much the images of beads at rest at `points` (N, 3) shift when they move by `moved` (N, 3), mm.

    focal     f, px;   distance  d, mm, from the optical centre to the face of the skin

    Raises ValueError where a bead lies behind the camera."""
    points, moved = _arrays(points, moved)
    _in_front(points, distance)
    after = points + moved
    _in_front(after, distance)
    return focal * (after[:, :2] / (distance - after[:, 2:]) - points[:, :2] / (distance - points[:, 2:]))


def matrix(points: np.ndarray, motion: np.ndarray, unit: np.ndarray, focal: float, distance: float) -> np.ndarray:
    """P (2 N, 3) of (7), px/N: the motion (N, 2) in the image, px, is P F.

    unit   (N, 3, 3) displacement of each bead per unit force, mm/N"""
    points, motion = _arrays(points, motion)
    _in_front(points, distance)
    away = distance - points[:, 2]
    toward = (motion + focal * points[:, :2] / away[:, None]) / away[:, None]
    return (toward[:, :, None] * unit[:, None, 2, :] + (focal / away)[:, None, None] * unit[:, :2, :]).reshape(-1, 3)


def reconstruct(points: np.ndarray, motion: np.ndarray, unit: np.ndarray, focal: float, distance: float) -> np.ndarray:
    """(3,) the point force at the origin, N, by the pseudo-inverse of P (8)."""
    system = matrix(points, motion, unit, focal, distance)
    return np.linalg.lstsq(system, np.asarray(motion, float).ravel(), rcond=None)[0]


def sensitivity(points: np.ndarray, force: np.ndarray, unit: np.ndarray, focal: float, distance: float) -> np.ndarray:
    """J (3, 2 N), N/px: error of the force per error of the motion, at the motion that the force makes without
    noise."""
    points, force = np.asarray(points, float), np.asarray(force, float)
    moved = unit @ force
    system = matrix(points, image_motion(points, moved, focal, distance), unit, focal, distance)
    return np.linalg.pinv(system) * np.repeat(1 - moved[:, 2] / (distance - points[:, 2]), 2)


def condition(points: np.ndarray, force: np.ndarray, unit: np.ndarray, focal: float, distance: float) -> float:
    """kappa (10), N/px: the Frobenius norm of `sensitivity`."""
    return float(np.linalg.norm(sensitivity(points, force, unit, focal, distance)))


def _arrays(points, other) -> tuple[np.ndarray, np.ndarray]:
    points, other = np.asarray(points, float), np.asarray(other, float)
    if points.ndim != 2 or points.shape[1] != 3 or len(other) != len(points) or other.ndim != 2:
        raise ValueError(f"beads of shape {points.shape} and motions of {other.shape}; allowed: (N, 3) and N motions")
    return points, other


def _in_front(points: np.ndarray, distance: float) -> None:
    if len(points) and points[:, 2].max() >= distance:
        raise ValueError(
            f"a bead is {points[:, 2].max():g} mm deep, and the optical centre is {distance:g} mm below the face; "
            "allowed: beads in front of the camera"
        )
