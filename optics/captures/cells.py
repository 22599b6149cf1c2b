"""Captures in cells: every k x k pixels averaged into one, with the noise that such means have.

A diagnosis of large images is made in cells: what it decides are falls of chi2, for which images of a few thousand
values each are enough, and a refit of a dozen images of 512 x 612 px would take an hour. Rows and columns on the right
and at the bottom that fill no cell are left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optics.captures.capture_set import Captures, Frame
from optics.captures.noise import Noise


def in_cells(captures: Captures, noise: Noise, k: int) -> Captures:
    """The captures in cells of k x k pixels; a cell with a pixel that may not be used may not be used.

    noise   of the captures' pixels. Raises ValueError for readings and for raw mosaics, whose neighbours differ.
    """
    if captures.table is not None or captures.cfa is not None or captures.mosaic:
        raise ValueError(f"{captures.folder}: readings and raw mosaics have no cells; allowed: images of equal pixels")
    fields: dict[int, np.ndarray] = {}

    def field(image: np.ndarray | None) -> np.ndarray | None:
        """A flat field, which frames may share: so do their cells."""
        if image is None:
            return None
        if id(image) not in fields:
            fields[id(image)] = _means(image, k)
        return fields[id(image)]

    def cells(frame: Frame) -> Frame:
        use = noise.usable(frame.image, dilate=0).all(-1)
        if frame.mask is not None:
            use &= np.asarray(frame.mask, bool)
        return replace(
            frame,
            image=_means(frame.image, k),
            mask=_blocks(use[..., None], k).all((1, 3))[..., 0],
            repeats=[_means(image, k) for image in frame.repeats],
            flat_field=field(frame.flat_field),
        )

    return replace(
        captures,
        frames=[cells(f) for f in captures.frames],
        flat_field=field(captures.flat_field),
        noise=noise.in_cells(k),
    )


def _blocks(image: np.ndarray, k: int) -> np.ndarray:
    """(H/k, k, W/k, k, C) of an image (H, W, C)."""
    rows, columns = image.shape[0] // k, image.shape[1] // k
    return image[: rows * k, : columns * k].reshape(rows, k, columns, k, image.shape[2])


def _means(image: np.ndarray, k: int) -> np.ndarray:
    return _blocks(np.asarray(image, np.float64), k).mean((1, 3)).astype(np.float32)
