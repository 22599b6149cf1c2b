"""Measured height maps: surfaces as (rows, columns) of heights in mm, towards the sensor.

    .tmd    Binary TrueMap Data v2.0: heights and their spacing in mm
    .npy    heights in mm
    .png    16 bits, heights in micrometres
In a TMD file the spacing stands; of the others somebody has to say it. Raises BadCapture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from optics.errors import BadCapture
from optics.files.images import read_array

SUFFIXES = (".tmd", ".npy", ".png")
TMD = b"Binary TrueMap Data File v2.0\r\n\0"  # 32 bytes


def read_heights(file: Path, where: str) -> tuple[np.ndarray, tuple[float, float] | None]:
    """(heights (rows, columns) in mm, (mm from sample to sample along x, along y), None where the file has no such)."""
    if file.suffix.lower() == ".tmd":
        return read_tmd(file, where)
    heights = read_array(file, where)
    heights = heights[..., 0] if heights.ndim == 3 and heights.shape[2] == 1 else heights
    if heights.ndim != 2 or min(heights.shape) < 2 or heights.dtype.kind not in "uif":
        raise BadCapture(f"{where}: {heights.dtype} of shape {heights.shape}; allowed: (rows, columns) of numbers")
    if file.suffix.lower() == ".png":
        if heights.dtype != np.uint16:
            raise BadCapture(f"{where}: a PNG of {heights.dtype}; allowed: 16 bits, heights in micrometres")
        heights = heights / 1000.0
    return _finite(np.asarray(heights, float), where), None


def read_tmd(file: Path, where: str) -> tuple[np.ndarray, tuple[float, float]]:
    """A TrueMap file: 32 bytes of name, a comment that ends with 0, columns and rows (uint32), lengths along x and y
    and two offsets (float32, mm), and heights (float32, mm), row by row."""
    data = file.read_bytes()
    end = data.find(b"\0", len(TMD))
    if not data.startswith(TMD) or end < 0 or len(data) < end + 25:
        raise BadCapture(f"{where}: no TrueMap file; allowed: '{TMD[:29].decode()}', a comment, sizes and heights")
    columns, rows = (int(n) for n in np.frombuffer(data, "<u4", 2, end + 1))
    length_x, length_y = (float(x) for x in np.frombuffer(data, "<f4", 2, end + 9))
    first = end + 25
    if min(columns, rows) < 2 or len(data) != first + 4 * columns * rows or not (length_x > 0 and length_y > 0):
        raise BadCapture(
            f"{where}: {columns} x {rows} heights over {length_x:g} x {length_y:g} mm in {len(data)} bytes; allowed: "
            f"2 x 2 or more over more than 0 mm, in {first + 4 * columns * rows} bytes; the file is cut off or damaged"
        )
    heights = np.frombuffer(data, "<f4", columns * rows, first).reshape(rows, columns)
    return _finite(heights.astype(float), where), (length_x / columns, length_y / rows)


def _finite(heights: np.ndarray, where: str) -> np.ndarray:
    if not np.isfinite(heights).all():
        row, column = np.argwhere(~np.isfinite(heights))[0]
        raise BadCapture(
            f"{where}: {np.sum(~np.isfinite(heights))} heights are NaN or infinite, the first in row {row}, column "
            f"{column}; allowed: finite mm; fill the gaps first"
        )
    return heights
