"""The black level of a camera from the noise of its images: where the line of variance against signal ends.

Definition
    var S = K (S - b) + q^2/12                                   photon transfer, as in `optics.captures.noise`
    D = I_1/S_1 - I_2/S_2                                        two images of one scene under two lights
    E (L D)^2 = sum over both of (K (S - b) + q^2/12)/S^2 + t^2 + (p b)^2 (1/S_1 - 1/S_2)^2
with the images I, their smooth level S, DN, the step q between values, and the Laplacian L, whose squared weights add
up to 1. A pattern p of the scene's own is in both images: D has left of it what the black level makes of it, and t
what the lights do. All but q come of least squares over groups of pixels of about the same S_1 and S_2; of the squares
in a group their median is taken, which dust and edges do not move.
Validity
    linear images that no lossy format and no smoothing has passed. Dark noise of r DN is not told from b: the level
    that is found is b - r^2/K. A curve that is bent downwards, as of a camera that codes for viewing, ends below 0 and
    says nothing.
References
    EMVA Standard 1288, release 4.0, 2.2; J. Immerkaer, Computer Vision and Image Understanding 64, 300 (1996); J. W.
    Tukey, Exploratory Data Analysis (1977), 16 (twicing, of the level).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.optimize import nnls

SMOOTH = 5  # px, side of the squares over which the level is a mean
LAPLACIAN = np.outer([1, -2, 1], [1, -2, 1]) / 6
MIDDLE = 1200  # px, side of the middle of an image that is looked at: a million pixels tell enough
LEVELS, ENOUGH = 16, 100  # groups along each level, and the pixels that one has at least
WIDE = 1.5  # times the lowest level that the highest is at least: a line over less says nothing of where it ends
OF_GAUSSIAN = 0.4549  # median of a squared Gaussian of variance 1
CERTAIN = 3.0  # standard deviations above 0 of a black level that is believed


@dataclass(frozen=True)
class PhotonNoise:
    """What the noise of images says of their camera.

    black_level   DN: the mean of what pairs of images say, weighted by their errors
    sd            DN: how far they scatter, which is more than the error of their mean: some of it they share
    system_gain   DN of variance per DN"""

    black_level: float
    sd: float
    system_gain: float


def photon_noise(scenes: Sequence[Sequence[np.ndarray]], saturation: float, step: float = 1.0) -> PhotonNoise | None:
    """What the noise says of images (H, W) in DN, some of each scene, each under a light of its own; None where they
    do not determine a black level above 0."""
    found = []
    for images in scenes:
        parts = [_middle(p) for p in images]
        smooth = [_level(p) for p in parts]
        count = len(parts)
        for i in range(count if count > 2 else count - 1):
            pair = [(parts[k], smooth[k]) for k in (i, (i + 1) % count)]
            found.append(_ending(pair, 0.9 * saturation, step))
    told = np.array([f for f in found if f is not None])
    if len(told) < 2:
        return None
    precision = told[:, 1] ** -2.0
    weight = precision / precision.sum()
    level, _, gain = weight @ told
    sd = math.hypot(math.sqrt(weight @ (told[:, 0] - level) ** 2), precision.sum() ** -0.5)
    return PhotonNoise(float(level), sd, float(gain)) if level > CERTAIN * sd else None


def _middle(image: np.ndarray) -> np.ndarray:
    top, left = (max(n - MIDDLE, 0) // 2 for n in image.shape)
    return np.asarray(image[top : top + MIDDLE, left : left + MIDDLE], np.float64)


def _level(image: np.ndarray) -> np.ndarray:
    """A mean over squares, and what such a mean takes from it: twice smoothed, a dark hollow is as dark as it is, and
    not as bright as its surroundings make its mean."""
    once = ndimage.uniform_filter(image, SMOOTH)
    return 2 * once - ndimage.uniform_filter(once, SMOOTH)


def _ending(pair: Sequence[tuple[np.ndarray, np.ndarray]], top: float, step: float) -> tuple[float, ...] | None:
    """(b, its standard error, K) of a pair of (image, level); None where it tells nothing."""
    (first, s1), (second, s2) = pair
    with np.errstate(divide="ignore", invalid="ignore"):
        square = ndimage.convolve(first / s1 - second / s2, LAPLACIAN) ** 2
    use = (np.minimum(s1, s2) > step) & (np.maximum(s1, s2) < top) & np.isfinite(square)
    if not use.any():
        return None
    s1, s2, square = s1[use], s2[use], square[use]
    bins = [np.searchsorted(np.linspace(s.min(), s.max(), LEVELS + 1)[1:-1], s) for s in (s1, s2)]
    code = LEVELS * bins[0] + bins[1]
    order = np.argsort(code, kind="stable")
    groups = [g for g in np.split(order, np.flatnonzero(np.diff(code[order])) + 1) if len(g) >= ENOUGH]
    if len(groups) < LEVELS:
        return None
    levels = np.array([(s1[g].mean(), s2[g].mean()) for g in groups])
    if levels.max() < WIDE * levels.min():
        return None
    design = np.stack(
        [(1 / levels).sum(1), (1 / levels**2).sum(1), np.ones(len(groups)), np.diff(1 / levels)[:, 0] ** 2], 1
    )
    variance = np.array([np.median(square[g]) for g in groups]) / OF_GAUSSIAN
    count, fitted = np.sqrt([len(g) for g in groups]), variance
    for _ in range(4):  # weights from the line, not from the scatter
        weight = count / np.maximum(fitted, 1e-3 * variance.max())
        whole = design * weight[:, None]
        line = _least_squares(whole, variance * weight)
        fitted = design @ line
    gain, end = line[0], step**2 / 12 - line[1]
    if gain <= 0 or end >= gain * levels.min():  # no noise of photons, or a line that ends among the readings
        return None
    free = [0, 1, *(k for k in (2, 3) if line[k] > 0)]
    return _with_error(whole[:, free], (variance - fitted) * weight, gain, end)


def _least_squares(design: np.ndarray, values: np.ndarray) -> np.ndarray:
    """What is at least 0, but for the second number, which has either sign."""
    scale = np.maximum(np.linalg.norm(design, axis=0), np.finfo(float).tiny)
    both, _ = nnls(np.column_stack([design / scale, -design[:, 1] / scale[1]]), values)
    both[1] -= both[-1]
    return both[:-1] / scale


def _with_error(design: np.ndarray, left: np.ndarray, gain: float, end: float) -> tuple[float, float, float]:
    """(b, its standard error, K) with b = end/gain, by what the line leaves."""
    covariance = np.linalg.pinv(design.T @ design) * (left @ left) / max(len(left) - design.shape[1], 1)
    slope = np.array([-end / gain**2, -1 / gain])  # of b by K and by the second number of the line
    return end / gain, math.sqrt(slope @ covariance[:2, :2] @ slope), gain
