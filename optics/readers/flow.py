"""Features of the motion between two images of a skin full of beads: mean size and mean direction in each bin.

    size, angle, count = bin_means(places, motion, (480, 480), 40)       (11), (12): 40 x 40 bins

Source: Sensors 19 (2019) 928, eqs. (11) and (12)."""

from __future__ import annotations

import numpy as np


def bin_means(
    places: np.ndarray, motion: np.ndarray, shape: tuple[int, int], bins: int | tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean size (11), px, circular mean of the angle (12), rad from x to y, and number of motions in each bin; each
    (rows, columns).

    places   (N, 2) x, y in px: in which bin a motion counts; those beyond the image count nowhere
    motion   (N, 2) px; rows that are not finite (a bead that was lost) count nowhere
    shape    (H, W) of the image;   bins  as many each way, or (rows, columns)

    A bin without a motion has size, angle and count 0. The circular mean is that of directions: every motion counts
    alike, large or small."""
    places, motion = np.asarray(places, float), np.asarray(motion, float)
    rows, columns = (bins, bins) if np.isscalar(bins) else bins
    if places.shape != motion.shape or places.ndim != 2 or places.shape[1] != 2:
        raise ValueError(f"places of shape {places.shape}, motions of {motion.shape}; allowed: both (N, 2)")
    if not (1 <= rows <= shape[0] and 1 <= columns <= shape[1]):
        raise ValueError(f"{rows} x {columns} bins; allowed: 1 to {shape[0]} rows and 1 to {shape[1]} columns")
    known = np.isfinite(motion).all(-1) & np.isfinite(places).all(-1)
    known &= (places >= 0).all(-1) & (places[:, 0] < shape[1]) & (places[:, 1] < shape[0])
    places, motion = places[known], motion[known]
    at = (places[:, 1] * rows / shape[0]).astype(int) * columns + (places[:, 0] * columns / shape[1]).astype(int)
    size, angle = np.hypot(*motion.T), np.arctan2(motion[:, 1], motion[:, 0])

    def total(values):
        return np.bincount(at, values, rows * columns)

    count = np.bincount(at, minlength=rows * columns)
    mean = total(size) / np.maximum(count, 1)
    direction = np.arctan2(total(np.sin(angle)), total(np.cos(angle)))
    return tuple(a.reshape(rows, columns) for a in (mean, np.where(count > 0, direction, 0.0), count))


def feature_vector(size: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """(2 m,) the sizes of all bins row by row, then the angles."""
    return np.concatenate([np.ravel(size), np.ravel(angle)])
