"""Raw mosaics for the eye, which sees a grid of dots in them.

analysers   an image for each analyser of a polarization camera, side by side as they lie in the cell
filters     of a colour camera, cells of 2 x 2 px as one pixel with three colours

What is shown beside one another stays comparable: residuals keep a standard deviation of 1."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from optics.captures.capture_set import cfa_channel
from optics.fit.compare import Comparison
from optics.study.shown import Fingerprint, Shown

SEAM = 48  # of an image's longer side: the part that lies between the images of two analysers


def unwoven(image: np.ndarray, cell: tuple[int, int]) -> np.ndarray:
    """(H, W, ...) -> about the same, less what fills no cell: the pixels at each place of the cell together, as an
    image of their own at that place, with a seam of NaN (False, 0) between them. `cell`: rows and columns."""
    (rows, columns), height, width = cell, image.shape[0] // cell[0], image.shape[1] // cell[1]
    seam = math.ceil(max(image.shape[:2]) / SEAM)
    shape = rows * (height + seam) - seam, columns * (width + seam) - seam, *image.shape[2:]
    nothing = np.nan if image.dtype.kind == "f" else 0
    found = np.full(shape, nothing, image.dtype)
    for i, j in np.ndindex(rows, columns):
        top, left = i * (height + seam), j * (width + seam)
        found[top : top + height, left : left + width] = image[i::rows, j::columns][:height, :width]
    return found


class Eye:
    """How the frames of a study are shown.

    facts   `mosaic`, angles in deg row by row, or `cfa` (optics.study.shown.mosaic_of)
    note    what a caption says of it; '' where frames are shown as they are
    """

    def __init__(self, facts: Mapping):
        rows, self.cfa = facts.get("mosaic") or (), facts.get("cfa")
        self.cell = (len(rows), len(rows[0])) if rows else (1, 1)
        self.note = ""
        if rows:
            self.note = "each analyser of the mosaic is an image of its own, placed as in the cell: " + " / ".join(
                " ".join(f"{angle:g}°" for angle in row) for row in rows
            )
        elif self.cfa:
            self.note = f"each cell of the colour filters ({self.cfa}) is one pixel, of the mean of each colour"

    def whole(self, image: np.ndarray) -> np.ndarray:
        """An image in DN, (H, W, C)."""
        return self._colours(image, np.mean) if self.cfa else unwoven(image, self.cell)

    def frame(self, f: Shown) -> Shown:
        if not self.note:
            return f
        usable = f.usable if f.usable.ndim == 3 else np.broadcast_to(f.usable[..., None], f.measured.shape)
        measured, predicted, variance = (self.whole(a) for a in (f.measured, f.predicted, np.square(f.sd, dtype=float)))
        if not self.cfa:
            return replace(
                f, measured=measured, predicted=predicted, sd=np.sqrt(variance), usable=unwoven(usable, self.cell)
            )
        count = self._colours(np.ones(f.measured.shape), np.sum)
        usable = self._colours(usable, np.min) > 0
        return replace(f, measured=measured, predicted=predicted, sd=np.sqrt(variance / count), usable=usable)

    def fingerprint(self, f: Fingerprint) -> Fingerprint:
        return replace(f, image=self._sigmas(f.image), residual=self._sigmas(f.residual))

    def maps(self, c: Comparison) -> Comparison:
        if c.mean_map is None or c.rms_map is None or not self.note:
            return c
        if self.cfa:
            square = self._colours(np.asarray(c.rms_map, float) ** 2, np.nanmean)
            return replace(c, mean_map=self._sigmas(c.mean_map), rms_map=np.sqrt(square))
        return replace(c, mean_map=unwoven(c.mean_map, self.cell), rms_map=unwoven(c.rms_map, self.cell))

    def _sigmas(self, z: np.ndarray) -> np.ndarray:
        """Residuals in standard deviations, NaN where masked; of the colours of a cell, the sum over the root of their
        number."""
        if not self.cfa:
            return unwoven(z, self.cell)
        return self._colours(z, lambda own, axis: own.sum(axis) / np.sqrt(own.shape[axis]))

    def _colours(self, image: np.ndarray, of) -> np.ndarray:
        """(H, W, 3) -> (H/2, W/2, 3): `of` the pixels of each cell that have the colour."""
        image = np.asarray(image, float)
        height, width = (n // 2 * 2 for n in image.shape[:2])
        channel = cfa_channel((2, 2), self.cfa)
        found = []
        for k in range(3):
            places = np.argwhere(channel == k)
            found.append(of(np.stack([image[i:height:2, j:width:2, k] for i, j in places], -1), axis=-1))
        return np.stack(found, -1)


def filled(image: np.ndarray, pattern: str) -> np.ndarray:
    """(H, W, 3) of a raw mosaic -> the same, with the colours that a pixel has no filter for: the mean of those in its
    cell of 2 x 2 px. What was measured stays; a row or column that fills no cell stays as well."""
    found = np.array(image)
    cells = Eye({"cfa": pattern}).whole(image).repeat(2, axis=0).repeat(2, axis=1)
    inside = found[: cells.shape[0], : cells.shape[1]]
    measured = cfa_channel(cells.shape, pattern)[..., None] == np.arange(3)
    np.copyto(inside, cells, where=~measured, casting="same_kind")
    return found
