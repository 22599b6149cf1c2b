"""What images are made from: the ends of camera rays at pixels' centres (`Hits`), finer samples of some pixels
(`Finer`), and the image of one LED with both (`LedImage`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from optics.light import paths
from optics.light.outlines import Grain, Outlines

# difference of a pixel's mean normal from that at its middle, above which finer samples are taken: a fifth of a grey
# level in 200
BENT = 1e-3
LATTICE = 4  # px from one to the next of the pixels that are followed where none is wanted
CREASE = 25.0  # deg from pixel to pixel: what is no smooth surface


def aligned(values: np.ndarray, kind: type = np.float32) -> np.ndarray:
    """A copy (n,) that begins at a multiple of 64 bytes. Dr.Jit reads numpy's memory where it lies, and compiles each
    kernel anew for what does not begin so."""
    memory = np.empty(values.size * np.dtype(kind).itemsize + 64, np.uint8)
    found = memory[-memory.ctypes.data % 64 :][: memory.size - 64].view(kind)
    found[:] = values.ravel()
    return found


class Sample(NamedTuple):
    """Camera rays at their ends (Dr.Jit), and in a scene with layers the paths that they took."""

    si: object
    weight: object
    origin: object
    path: paths.Path | None = None


class Traced:
    """Pixels whose centres camera rays are sent through where not all are wanted: these, their neighbours, which tell
    how a pixel varies, and every LATTICE-th of the others each way, which stand for those about them.

    index     their numbers;   nearest   (H W,) of each pixel, the place in `index` of the one that stands for it"""

    def __init__(self, wanted: np.ndarray):
        from scipy.ndimage import binary_dilation, distance_transform_edt

        traced = binary_dilation(wanted, np.ones((3, 3), bool))
        first = (min(LATTICE // 2, n - 1) for n in traced.shape)
        traced[tuple(slice(k, None, LATTICE) for k in first)] = True
        self.index = np.flatnonzero(traced)
        place = np.zeros(traced.shape, np.int32)
        place[traced] = np.arange(len(self.index))
        rows, columns = distance_transform_edt(~traced, return_distances=False, return_indices=True)
        self.nearest = place[rows, columns].ravel()


class Hits:
    """Primary hits of one geometry: si, weight, origin (Dr.Jit), and what they show as numpy images.

    traced   the pixels whose centres were followed; None: all"""

    def __init__(self, sample: Sample, height: int, width: int, traced: Traced | None = None):
        self.sample, self.traced = sample, traced
        self.si, self.weight, self.origin, self.path = sample
        self.shape = (height, width)
        self.size = height * width if traced is None else len(traced.index)
        self.rims: dict = {}
        self.outlines: Outlines | None = None  # of the balls of a crowded scene, and how finely it is made
        self.grain: Grain | None = None
        self.joint: np.ndarray | None = None
        self.lit: dict[tuple[str, ...], tuple] = {}  # what lights see of the pixels' centres, with their numbers then
        self.eye = np.zeros(3)  # where the camera stood
        self.bare = False  # whether nothing casts a shadow on what is seen, and no pixel needs finer samples
        self.valid = self.image(self.si.is_valid())
        self.edges = edges(self.valid)
        if self.path is not None:  # what is passed, and what is met, changes at an edge
            for met in (self.path.shape, *self.path.regions, *(step.part for step in self.path.steps)):
                self.edges |= edges(met.reshape(height, width))
            self.edges |= creases(np.where(self.valid[..., None], self.normal, 0.0))
        self.bent = (
            np.zeros((height, width))
            if self.path is not None
            else bends(np.where(self.valid[..., None], self.normal, 0.0))
        )

    def everywhere(self, values: np.ndarray) -> np.ndarray:
        """(H W, ...) of values (size, ...) at the centres that were followed."""
        return values if self.traced is None else values[self.traced.nearest]

    def image(self, values) -> np.ndarray:
        """(H, W) of what one number a ray (Dr.Jit) is."""
        return self.everywhere(np.broadcast_to(np.array(values), self.size)).reshape(self.shape)

    @property
    def position(self) -> np.ndarray:
        return self.everywhere(np.array(self.si.p).T).reshape(*self.shape, 3)

    @property
    def normal(self) -> np.ndarray:
        return self.everywhere(np.array(self.si.sh_frame.n).T).reshape(*self.shape, 3)


class Finer:
    """Finer samples of some pixels, those of a pixel behind each other.

    counts   (n,) of each pixel;   sample   their ends, N in all, or what gives them; None where no pixel has any
    at       their places u, v in px, (N,) each
    weights  (N,) share of the pixel that each stands for; None: all of a pixel alike
    """

    def __init__(
        self,
        counts: np.ndarray,
        sample: Sample | Callable[[], Sample] | None,
        at: tuple[np.ndarray, np.ndarray],
        weights: np.ndarray | None = None,
    ):
        self.counts, self._sample, self.at, self.weights = counts, sample, at, weights
        self.size = int(counts.sum())
        self._starts = np.cumsum(counts) - counts
        self._sorted: dict = {}  # side -> which samples lie in which part of a pixel, as weights of their mean

    @property
    def sample(self) -> Sample | None:
        return self._sample() if callable(self._sample) else self._sample

    def mean(self, values: np.ndarray) -> np.ndarray:
        """(n, B) mean in each pixel of values (N, B)."""
        if self.weights is not None:
            return np.add.reduceat(values * self.weights[:, None], self._starts)
        return np.add.reduceat(values, self._starts) / self.counts[:, None]

    def in_parts(self, values: np.ndarray, side: int, index: np.ndarray, width: int) -> np.ndarray:
        """(n, side^2, B) mean of values (N, B) in each part of the pixels `index`, row by row; in a part without a
        sample the pixel's mean."""
        from scipy.sparse import coo_array

        if side not in self._sorted:
            pixel = np.repeat(np.arange(len(self.counts)), self.counts)
            corner = (index % width)[pixel], (index // width)[pixel]
            column, row = (np.clip(((a - c) * side).astype(int), 0, side - 1) for a, c in zip(self.at, corner))
            part = pixel * side**2 + row * side + column
            own = np.ones(self.size) if self.weights is None else self.weights
            count = np.bincount(part, own, minlength=len(self.counts) * side**2)
            weights = coo_array((own / count[part], (part, np.arange(self.size))), (len(count), self.size)).tocsr()
            self._sorted[side] = weights, count.reshape(-1, side**2, 1) == 0
        weights, empty = self._sorted[side]
        found = (weights @ values).reshape(len(self.counts), side**2, -1)
        return np.where(empty, self.mean(values)[:, None], found) if empty.any() else found

    def span(self, values: np.ndarray) -> np.ndarray:
        """(n, B) largest less smallest of values (N, B) in each pixel."""
        return np.maximum.reduceat(values, self._starts) - np.minimum.reduceat(values, self._starts)


class LedImage:
    """One LED's image with the hits, rim pixels and shadows that it was made from.

    group   that it was made with (`optics.light.together.Group`), which holds the shadows; None of one by itself"""

    def __init__(self, led, hits, rim, index, finer, visible, rim_visible, lit, group=None):
        self.led, self.hits, self.rim, self.index, self.finer, self.group = led, hits, rim, index, finer, group
        self._visible, self._rim_visible, self.lit = visible, rim_visible, lit
        self.share: np.ndarray | float = 1.0  # (n, 1) of the finer samples in each of those pixels
        self.raw: tuple | None = None  # what the light makes before layers: at centres, at finer samples
        self.radiance: np.ndarray | None = None  # the image, in scenes without layers

    @property
    def ends(self) -> int:
        """Ends of camera rays that its finer samples keep; those of a group are all of it."""
        return self.finer.size if self.group is None else self.group.ends

    @property
    def visible(self):
        """What the light reaches of the pixels' centres."""
        return self._visible if self.group is None else self.group.visible_to(self.led)

    @property
    def rim_visible(self):
        """What the light reaches of the finer samples."""
        return self._rim_visible if self.group is None else self.group.finely_visible_to(self.led)


def creases(normal: np.ndarray) -> np.ndarray:
    """Pixels on either side of a sharp edge of a body: normals (H, W, 3) that turn by more than CREASE from one to the
    next."""
    found = np.zeros(normal.shape[:2], bool)
    for axis in (0, 1):
        near, far = (np.take(normal, range(k, normal.shape[axis] - 1 + k), axis) for k in (0, 1))
        turned = (near * far).sum(-1) < np.cos(np.radians(CREASE)) * np.linalg.norm(near, axis=-1) * np.linalg.norm(
            far, axis=-1
        )
        first, second = ((slice(None),) * axis + (slice(k, normal.shape[axis] - 1 + k),) for k in (0, 1))
        found[first] |= turned
        found[second] |= turned
    return found


def bends(normal: np.ndarray) -> np.ndarray:
    """(H, W) share, 0 to 1, by which finer samples stand for a pixel and not its middle.

    The mean over a pixel of what varies is its middle and a twenty-fourth of its second differences. Where these are,
    for the normals (H, W, 3), above 24 BENT, the share is 1, and it fades to 0 at half of that: an image has no steps
    when a dent moves."""
    found = np.zeros(normal.shape[:2])
    for axis in (0, 1):
        if normal.shape[axis] < 3:
            continue
        inner = (slice(None),) * axis + (slice(1, -1),)
        found[inner] = np.maximum(found[inner], np.linalg.norm(np.diff(normal, 2, axis=axis), axis=-1) / 24)
    return np.clip(2 * found / BENT - 1, 0.0, 1.0)


def edges(masks: np.ndarray) -> np.ndarray:
    """Pixels of masks (..., H, W) whose neighbourhood (3 x 3) is not all of one kind."""
    low, high = around(masks)
    return low != high


def around(planes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest value in the neighbourhood (3 x 3) of each pixel of images (..., H, W)."""
    from scipy.ndimage import maximum_filter, minimum_filter

    size = (*(1,) * (planes.ndim - 2), 3, 3)
    return minimum_filter(planes, size), maximum_filter(planes, size)
