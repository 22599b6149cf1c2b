"""Indenters with many contacts: a plate of balls on a square grid, and surfaces that were measured as height maps.

Both are heights of a lower surface over (u, v), as `optics.skin.contact.indenter_profile` uses them."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from optics.files.heights import read_heights
from optics.skin.contact import cone_envelope, sphere


def balls(
    u: np.ndarray,
    v: np.ndarray,
    radius: float,
    spacing: float,
    turn: np.ndarray,
    slope: float,
    tall: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """(height, envelope) of balls of a radius, `spacing` mm apart in rows and columns without end, one on the axis;
    heights over the lowest point of that one. tall: height over width of each.

    The plate is turned with its balls (turn: rotation matrix): they stay balls, and stand where they were turned to."""
    plane = turn[:2, :2]
    number = np.rint(np.einsum("ij,j...->i...", np.linalg.inv(plane), np.stack([u, v])) / spacing) * spacing
    x, y = np.einsum("ij,j...->i...", plane, number)
    rise = np.einsum("j,j...->...", turn[2, :2], number)
    height, envelope = (tall * h for h in sphere(u - x, v - y, radius, slope / tall))
    return height + rise, envelope + rise


def height_map(
    axis: np.ndarray, size: float, path: str, stamp: int, turn: np.ndarray, slope: float
) -> tuple[np.ndarray, np.ndarray]:
    """(height, envelope) of a measured surface at axis x axis: its highest point, towards the sensor, is 0; inf beyond
    its edges. `size`: as `optics.files.heights` has it; stamp: the file's time, for the cache."""
    from scipy.ndimage import map_coordinates

    heights, (step_x, step_y) = _read(path, stamp, size)
    u, v = np.meshgrid(axis, axis)
    a, b = np.einsum("ij,j...->i...", np.linalg.inv(turn[:2, :2]), np.stack([u, v]))
    pitch = axis[1] - axis[0]
    fewer = [max(round(pitch / step), 1) for step in (step_y, step_x)]
    rows, columns = (n // f * f for n, f in zip(heights.shape, fewer))
    mean = heights[:rows, :columns].reshape(rows // fewer[0], fewer[0], columns // fewer[1], fewer[1]).mean((1, 3))
    # the middle of the map lies (N - 1)/2 samples from its first, that of the first block (f - 1)/2
    at = [
        (x / step + (count - 1) / 2 - (few - 1) / 2) / few
        for x, step, count, few in zip((b, a), (step_y, step_x), heights.shape, fewer)
    ]
    inside = (at[0] >= 0) & (at[0] <= mean.shape[0] - 1) & (at[1] >= 0) & (at[1] <= mean.shape[1] - 1)
    low = mean.max() - map_coordinates(mean, at, order=1, mode="nearest")
    height = np.where(inside, low + turn[2, 0] * a + turn[2, 1] * b, np.inf)
    if not inside.any():
        raise ValueError(f"indenter {path}: the map does not reach its own middle; give it 2 x 2 samples or more")
    return height, cone_envelope(height / pitch, slope) * pitch


@lru_cache(maxsize=4)
def _read(path: str, stamp: int, size: float) -> tuple[np.ndarray, tuple[float, float]]:
    """Heights in mm and mm from sample to sample along x and y."""
    heights, steps = read_heights(Path(path), f"indenter {path}")
    if steps is None:
        return heights, (size, size)
    return heights * size, (steps[0] * size, steps[1] * size)
