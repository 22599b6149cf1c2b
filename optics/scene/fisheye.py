"""Fisheye laws: how far from the principal point a lens images what it sees at an angle from its axis.

    theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)        Kannala and Brandt, OpenCV's order
    r/f = theta_d                     equidistant: with k1 ... k4 it is the model of cv2.fisheye
        = 2 sin(theta_d/2)            equisolid
        = 2 tan(theta_d/2)            stereographic

Pure numpy, angles in rad. The inverse of the polynomial exists up to the angle at which it folds over (`fold`)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

LAWS = ("equidistant", "equisolid", "stereographic")


def bent(theta, k: Sequence):
    """theta_d of theta; numpy or Dr.Jit."""
    t2 = theta * theta
    return theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))


def slope(theta, k: Sequence):
    """d theta_d / d theta; numpy or Dr.Jit."""
    t2 = theta * theta
    return 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))


def radius(law: str, theta_d):
    """r/f of theta_d, of any shape."""
    if law == "equisolid":
        return 2 * np.sin(np.minimum(theta_d, math.pi) / 2)
    return 2 * np.tan(theta_d / 2) if law == "stereographic" else theta_d


def growth(law: str, theta_d):
    """d(r/f) / d theta_d, of any shape."""
    if law == "equisolid":
        return np.cos(np.minimum(theta_d, math.pi) / 2)
    return 1 / np.cos(theta_d / 2) ** 2 if law == "stereographic" else np.ones_like(theta_d)


def angle(law: str, r):
    """theta_d of r/f, of any shape; infinite where the law has no such radius."""
    if law == "equisolid":
        return np.where(np.asarray(r) <= 2, 2 * np.arcsin(np.minimum(r, 2) / 2), np.inf)
    return 2 * np.arctan(np.asarray(r) / 2) if law == "stereographic" else r


def fold(k: Sequence[float]) -> float:
    """The smallest theta, rad, beyond which theta_d falls; infinite where it rises up to pi."""
    roots = np.roots([9 * k[3], 7 * k[2], 5 * k[1], 3 * k[0], 1.0])  # of the slope, in theta^2
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.maximum(np.abs(roots), 1)) & (roots.real > 0)]
    first = math.sqrt(real.min()) if len(real) else math.inf
    return first if first < math.pi else math.inf


def project(points: np.ndarray, law: str, k: Sequence[float], focal: tuple, middle: tuple) -> np.ndarray:
    """(N, 2) u, v in px of points (N, 3) in the camera's frame (x right, y down, z forward); NaN beyond the fold."""
    x, y, z = np.moveaxis(np.asarray(points, float), -1, 0)
    across = np.hypot(x, y)
    theta = np.arctan2(across, z)
    end = fold(k)
    theta_d = bent(np.where(theta <= end, theta, np.nan), k)
    r = radius(law, theta_d)
    away = np.divide(r, across, out=np.zeros_like(across), where=across > 0)
    return np.stack([focal[0] * x * away + middle[0], focal[1] * y * away + middle[1]], -1)
