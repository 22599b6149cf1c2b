"""Mosaics of analysers: the cell of angles that repeats over the pixels of a polarization camera.

An angle is that of the transmission axis, deg, counterclockwise in the image from its right; the first row of a cell
lies on top, its first angle at the image's first column."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

LARGEST = 8  # px each way of a cell
ALLOWED = (
    f"allowed: rows of equal length, 1 x 1 to {LARGEST} x {LARGEST} angles from -180 to 180 deg, row by row as the "
    "camera sees them: [[90, 45], [135, 0]]"
)

Mosaic = tuple[tuple[float, ...], ...]


def checked(rows: object) -> Mosaic:
    """The cell of angles (deg) as tuples; raises ValueError with what is allowed."""
    is_cell = isinstance(rows, Sequence) and not isinstance(rows, str) and 0 < len(rows) <= LARGEST
    if not is_cell or not all(isinstance(row, Sequence) and not isinstance(row, str) for row in rows):  # type: ignore
        raise ValueError(f"mosaic = {rows!r} is no table of angles; {ALLOWED}")
    cell: Sequence = rows  # type: ignore[assignment]
    width = len(cell[0])
    if not 0 < width <= LARGEST or any(len(row) != width for row in cell):
        raise ValueError(f"mosaic = {rows!r} has rows of {', '.join(str(len(row)) for row in cell)} angles; {ALLOWED}")
    for angle in (angle for row in cell for angle in row):
        number = isinstance(angle, (int, float)) and not isinstance(angle, bool)
        if not number or not math.isfinite(angle) or abs(angle) > 180:
            raise ValueError(f"mosaic: {angle!r} is no angle in deg; {ALLOWED}")
    return tuple(tuple(float(angle) for angle in row) for row in cell)


def read_mosaic(text: str) -> Mosaic:
    """The cell that a text gives, () for none: "90 45; 135 0", or the four angles of a 2 x 2 cell "90 45 135 0"."""
    if not text.strip():
        return ()
    try:
        rows = [[float(angle) for angle in re.split(r"[\s,]+", row.strip()) if angle] for row in text.split(";")]
    except ValueError:
        raise ValueError(f'mosaic "{text}" holds what is no number; {ALLOWED}') from None
    if len(rows) == 1 and len(rows[0]) == 4:
        rows = [rows[0][:2], rows[0][2:]]
    return checked(rows)
