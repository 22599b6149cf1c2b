"""Regions: a map of whole numbers on a surface, which says where a part of it has parameters of its own.

A part with a map declares a word with the role "regions": a pattern of `PATTERNS`, or the name of an image, `.png` or
`.npy`, (H, W) of whole numbers from 0 to 7; an image of 0 and 255 alone counts as 0 and 1. Row 0 is on top (+y of the
surface), column 0 at -x. The map lies about the surface's middle with square pixels. It is `region_size` mm wide, an
attribute of the part in XML; 0, the default, makes it as wide as what the camera sees at the distance of the surface,
so that a map drawn in a photograph fits."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

from optics.errors import BadCapture, BadScene
from optics.polarization.mueller import real, where

LARGEST = 7
FILES = (".npy", ".png")
PATTERNS = {"even": [[0]], "halves": [[0, 1]], "quarters": [[0, 1], [2, 3]]}  # row by row, as the camera sees them
ALLOWED = f"allowed: an image (H, W) of whole numbers from 0 to {LARGEST}, or of 0 and 255, as .npy or .png"


class Regions:
    """The number of the region at a place: f(x, y) -> 0 ... 7, for numpy's arrays (complex ones too) and Dr.Jit's.

    labels  (H, W) of whole numbers;   width  mm that its columns span, x and y count from its middle
    Beyond its edge a map goes on as at the edge."""

    def __init__(self, labels, width: float):
        import numpy as np

        self.labels = np.asarray(labels, int)
        self.width = width
        self.made: dict[str, object] = {}

    def has(self, number: int) -> bool:
        return bool((self.labels == number).any())

    def __call__(self, x, y):
        import numpy as np

        rows, columns = self.labels.shape
        pitch = self.width / columns
        i, j = real(x) / pitch + columns / 2, rows / 2 - real(y) / pitch
        if isinstance(i, (np.ndarray, float)):
            column, row = (np.clip(np.floor(a), 0, n - 1).astype(int) for a, n in ((i, columns), (j, rows)))
            return self.labels[row, column]
        return self._looked_up(i, j)

    def _looked_up(self, i, j):
        import drjit as dr
        import mitsuba as mi

        variant = str(mi.variant())
        if variant not in self.made:
            self.made[variant] = mi.Float(self.labels.ravel().astype("float32"))
        rows, columns = self.labels.shape
        column, row = (mi.UInt32(dr.clip(dr.floor(mi.Float(a)), 0, n - 1)) for a, n in ((i, columns), (j, rows)))
        return dr.gather(mi.Float, self.made[variant], row * columns + column)

    def within(self, x, y, number: int):
        """1 where the region has this number, 0 elsewhere."""
        found = self(x, y)
        return where(found == number, 1.0 + 0.0 * found, 0.0 * found)


def found_file(folders: Sequence[str], name: str) -> Path:
    """A file by its name, in the first of these folders that has it."""
    places = [Path(folder) / name for folder in folders]
    return next((place for place in places if place.is_file()), places[0])


def read_regions(path: Path):
    """(H, W) whole numbers of an image of regions; raises BadScene with the file and what is allowed."""
    import numpy as np

    from optics.files.images import read_array

    if not path.is_file():
        raise BadScene(f"{path}: no such file; {ALLOWED}")
    try:
        values = np.squeeze(read_array(path, str(path)))
    except BadCapture as error:
        raise BadScene(f"{error}; {ALLOWED}") from error
    if values.ndim != 2 or values.dtype.kind not in "buif" or not np.isfinite(values).all():
        raise BadScene(f"{path}: shape {values.shape}, type {values.dtype}; {ALLOWED}")
    if set(np.unique(values)) == {0, 255}:
        values = values / 255
    labels = np.round(values).astype(int)
    if (labels != values).any() or labels.min() < 0 or labels.max() > LARGEST:
        raise BadScene(f"{path}: values from {values.min():g} to {values.max():g}; {ALLOWED}")
    return labels


class Maps:
    """The maps of one part by their word, each read once.

    folders  where files of maps lie, the scene's first;   width  mm of a map

    It holds no part: a part that were held in a circle would outlive its shape, which Dr.Jit then still asks for."""

    def __init__(self, folders: Sequence[str], width: float):
        self.folders, self.width = tuple(folders), width
        self.known: dict[str, Regions] = {}

    def __call__(self, word: str) -> Regions | None:
        if word not in self.known:
            labels = read_regions(found_file(self.folders, word)) if word.endswith(FILES) else PATTERNS[word]
            self.known[word] = Regions(labels, self.width)
        return self.known[word]


def view_width(camera, shape) -> float:
    """mm that a camera in its nominal pose sees at the distance of a shape's middle, across its image; 1 without a
    camera."""
    import numpy as np

    if camera is None or not hasattr(camera, "columns"):
        return 1.0
    box = shape.bbox()
    middle = (np.array(box.min).ravel() + np.array(box.max).ravel()) / 2
    axis, place = (np.array(camera.columns[j]).ravel() for j in (2, 3))
    width, height = camera.resolution
    left, right = camera.normalised(SimpleNamespace(**camera.held), np.array([0.0, width]), height / 2)[0]
    return float(abs((middle - place) @ axis) * (right - left))
