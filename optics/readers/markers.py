"""Bright round markers on a skin: where they are in an image, and how far each has moved from its place at rest.

    rest = find(rest_image, count=20)                       centres, areas, contrast and detectability
    order = grid_order(rest.centres, columns=5, rows=4)     row by row, as the sensor's maker counts them
    moved = match(rest.centres[order], find(image))         dU = U - U0, px, NaN where a marker is lost
    places, moved = displacement(rest_image, image, grid=(5, 4))       the same in one call

Images are (H, W) or (H, W, C) in DN or radiance, row 0 on top; points are (x, y) in px, the centre of the first pixel
at (0.5, 0.5). Source: Vi2TaP (RA-L 2025), III.A.2-3, where the image is made binary, round markers are located in it,
and the displacements dU feed the tactile network. The paper's centres come from Canny edges; these are centroids of
light, which use every pixel of a marker and not only its rim."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from scipy import ndimage
from scipy.optimize import linear_sum_assignment
from skimage.filters import threshold_otsu

SMALLEST = 9  # px; below, an area says nothing about roundness
SIGNIFICANT = 5.0  # sd of the smoothed noise: once in 3e6 pixels by chance
LAPLACIAN = np.outer(
    (1, -2, 1), (1, -2, 1)
)  # blind to planes and to straight edges along rows and columns; white noise x 6
REACH = 0.45  # of the distance to the nearest neighbour: below one half, so that no point is in reach of two markers
LOW = 0.5  # of the marker's mean brightness: the most that the centroid cuts off below
OFF_GRID = 0.5  # cells; beyond, a point is nearer to another node


# -- Finding ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Markers:
    """What `find` found, the most detectable first.

    centres    (n, 2) x, y in px
    areas      (n,) px, above half of the marker's own brightness: true until blur is as wide as the marker
    contrast   (n,) Weber: (marker - surround) / (surround - black level); infinite before black
    score      (n,) detectability d': (marker - surround) / sd of the surround, noise and texture alike; infinite where
               that is perfectly even (whole numbers count as uncertain by their step / sqrt(12)). At 3, a threshold
               half way between takes 7 % of both for the other, pixel by pixel
    roundness  (n,) minor axis / major axis x how well the ellipse of the same second moments covers it: 1 for a disc
    """

    centres: np.ndarray
    areas: np.ndarray
    contrast: np.ndarray
    score: np.ndarray
    roundness: np.ndarray

    def __len__(self) -> int:
        return len(self.areas)

    def __getitem__(self, index) -> Markers:
        """Some of them, or all in another order: markers[order]."""
        index = np.atleast_1d(np.arange(len(self))[index])
        return Markers(*(getattr(self, f.name)[index] for f in fields(self)))

    def mask(self, shape: tuple[int, ...], margin: float = 2.0) -> np.ndarray:
        """(H, W) bool: pixels of an image of this shape that a marker hides, as a disc of its area and `margin` px
        around."""
        y, x = np.ogrid[: shape[0], : shape[1]]
        hidden = np.zeros(shape[:2], bool)
        for (at_x, at_y), area in zip(self.centres, self.areas):
            hidden |= np.hypot(x + 0.5 - at_x, y + 0.5 - at_y) < math.sqrt(area / math.pi) + margin
        return hidden


def find(
    image: np.ndarray,
    count: int | None = None,
    *,
    largest: float | None = None,
    roundness: float = 0.5,
    detectable: float = 3.0,
    smoothing: float = 1.0,
    black_level: float = 0.0,
) -> Markers:
    """Locate bright round markers; the centre is the centroid of the light above the local surround.

    image        (H, W) or (H, W, C), any real dtype; channels are averaged: if the pigment shines in one only, give
                 that one
    count        keep that many, the most detectable; fewer come back where fewer are found, an empty result where none
                 is
    largest      px, diameter that no marker exceeds; what is wider is background. None: a fifth of the image's shorter
                 side
    roundness    smallest, see `Markers`; a disc seen at 60 deg has 0.5
    detectable   smallest score
    smoothing    px, sd of the Gaussian before the threshold; the centroid takes the image as it is
    black_level  DN of no light: of importance to the Weber contrast alone

    What each step is for:
      background   the opening by a square of `largest`: brightness that is wider than any marker, taken off
      homogeneity  what is left is divided by its maximum within `largest` around, so that lamps may leave one side
                   dimmer
      threshold    Otsu's, and no lower than 5 sd of the noise
      extent       above half of each candidate's own peak; 9 px at least, and whole: what the image border cuts is left
                   out
      surround     a plane through the ring around it, fitted by least squares, its outliers left out
      centroid     of the light above the surround and above twice its sd, up to a third of a radius beyond the extent
    On an even surround the centre is true to 0.4 noise / excess px along x and y, whatever the size. An opaque marker
    before a surround of slope g (DN per px) is found g radius^2 / (4 excess) px downhill; blur mixes texture at the rim
    in. Raises ValueError for another shape, for values that are not finite and for settings out of range."""
    grey = _grey(image)
    height, width = grey.shape
    if largest is None and min(height, width) < 15:
        raise ValueError(f"{width} x {height} pixels; allowed: 15 each way or more, of which a marker may take a fifth")
    largest = min(height, width) / 5 if largest is None else float(largest)
    if not (3 <= largest <= min(height, width)):
        raise ValueError(
            f"largest marker = {largest:g} px; allowed: 3 to {min(height, width)} px, the image's shorter side; "
            "give a little more than the diameter of a marker"
        )
    for name, value, low, high in (
        ("count", count, 0, math.inf),
        ("roundness", roundness, 0, 1),
        ("detectable", detectable, 0, math.inf),
        ("smoothing", smoothing, 0, largest),
    ):
        if value is not None and not low <= value <= high:
            raise ValueError(f"{name} = {value:g}; allowed: {low:g} to {high:g}; see optics.readers.markers.find")
    step_sd = 0.0 if np.asarray(image).dtype.kind == "f" else 12**-0.5
    found = [
        m
        for m in (_measure(grey, *piece, black_level, step_sd) for piece in _candidates(grey, largest, smoothing))
        if m is not None and m[5] >= roundness and m[4] >= detectable
    ]
    table = np.array(found, float).reshape(-1, 6)
    table = table[np.lexsort((-table[:, 3], -table[:, 4]))][:count]
    return Markers(table[:, :2], *table[:, 2:].T)


def _grey(image: np.ndarray) -> np.ndarray:
    """(H, W) float64, mean over channels; raises ValueError for what is no image."""
    image = np.asarray(image)
    if image.ndim not in (2, 3) or 0 in image.shape or image.dtype.kind not in "buif":
        raise ValueError(
            f"image of shape {image.shape} and type {image.dtype}; allowed: real (H, W) or (H, W, C), channels last"
        )
    grey = image.astype(float).mean(axis=2) if image.ndim == 3 else image.astype(float)
    if not np.isfinite(grey).all():
        raise ValueError(
            f"image: {np.sum(~np.isfinite(grey))} pixels are NaN or infinite; allowed: finite values; fill bad "
            "pixels from their neighbours"
        )
    return grey


def noise_sd(plane: np.ndarray) -> float:
    """Standard deviation of white noise in (H, W), from its second differences: smooth shading and edges hardly count.

    The median absolute deviation of the mask [1 -2 1]^T [1 -2 1] / 6 (Immerkaer, CVIU 64, 300, 1996, who takes the
    mean). Noise that a demosaicing or a blur has made smooth is underestimated."""
    inner = ndimage.convolve(plane, LAPLACIAN, mode="nearest")[1:-1, 1:-1]
    return float(np.median(np.abs(inner))) / 0.6745 / 6 if inner.size else 0.0


def smoothed_sd(sd: float, smoothing: float) -> float:
    """What a Gaussian of sd `smoothing` px leaves of white noise: sd / (2 sqrt(pi) smoothing), never more than sd."""
    return sd / max(1.0, 2 * math.sqrt(math.pi) * smoothing)


def _candidates(grey: np.ndarray, largest: float, smoothing: float):
    """(slices, mask within) of every bright piece, as wide as half of its own peak; pieces that the border cuts left
    out."""
    smooth = ndimage.gaussian_filter(grey, smoothing) if smoothing else grey
    size = 2 * math.ceil(largest / 2) + 1
    above = smooth - ndimage.uniform_filter(ndimage.grey_opening(smooth, size=size), size)
    above -= np.median(above)  # the opening follows the noise's low side
    floor = max(SIGNIFICANT * smoothed_sd(noise_sd(grey), smoothing), 1e-9 * np.abs(grey).max())
    if not above.max() > floor:
        return
    around = ndimage.uniform_filter(ndimage.maximum_filter(above, size=2 * size + 1), size)
    even = np.clip(above / np.maximum(around, floor), 0, 1.5)
    label, n = ndimage.label((even > threshold_otsu(even)) & (above > floor))
    if not n:
        return
    peak = np.concatenate([[np.inf], ndimage.maximum(above, label, np.arange(1, n + 1))])
    label, _ = ndimage.label(above > peak[label] / 2)
    for k, (rows, columns) in enumerate(ndimage.find_objects(label), 1):
        whole = rows.start > 0 and columns.start > 0 and rows.stop < grey.shape[0] and columns.stop < grey.shape[1]
        if whole and max(rows.stop - rows.start, columns.stop - columns.start) <= largest + 2:
            yield (rows, columns), label[rows, columns] == k


def _measure(grey: np.ndarray, place: tuple[slice, slice], mask: np.ndarray, black_level: float, step_sd: float):
    """(x, y, area, contrast, score, roundness) of one candidate, or None where it is too small to tell."""
    mask = ndimage.binary_fill_holes(mask)
    area = int(mask.sum())
    if area < SMALLEST:
        return None
    radius = math.sqrt(area / math.pi)
    skirt = math.ceil(1.5 + 0.3 * radius)  # px beyond half of the peak that blur may have spread light over
    margin = skirt + 2 + math.ceil(0.7 * radius)
    top, left = max(place[0].start - margin, 0), max(place[1].start - margin, 0)
    window = grey[top : place[0].stop + margin, left : place[1].stop + margin]
    inside = np.zeros(window.shape, bool)
    inside[place[0].start - top :, place[1].start - left :][: mask.shape[0], : mask.shape[1]] = mask
    away = ndimage.distance_transform_edt(~inside)
    y, x = np.indices(window.shape) + 0.5

    # the surround
    basis = np.stack([np.ones(window.size), (x - x.mean()).ravel() / radius, (y - y.mean()).ravel() / radius], -1)
    use, values = (away > skirt).ravel(), window.ravel()
    for _ in range(3):  # the neighbours' light is no surround
        if use.sum() < 8:
            return None
        plane = basis @ np.linalg.lstsq(basis[use], values[use], rcond=None)[0]
        light = values - plane
        spread = 1.4826 * np.median(np.abs(light[use]))
        use &= np.abs(light) <= 3 * max(spread, 1e-12 * np.abs(values).max())
    sd = max(float(np.std(light[use])), step_sd)
    light, plane = light.reshape(window.shape), plane.reshape(window.shape)
    excess, surround = float(light[inside].mean()), float(plane[inside].mean()) - black_level
    if excess <= 0:
        return None

    # the marker
    weight = np.where(
        away <= skirt, np.maximum(light - min(2 * sd, LOW * excess), 0.0), 0.0
    )  # not the texture beside it
    at = np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
    spread = np.cov(np.stack([x[inside], y[inside]]), bias=True) + np.eye(2) / 12  # pixels are squares, no points
    minor, major = np.sqrt(np.linalg.eigvalsh(spread))
    covered = min(1.0, area / (4 * math.pi * minor * major))
    return (
        at[0] + left,
        at[1] + top,
        area,
        excess / surround if surround > 0 else math.inf,
        excess / sd if sd > 1e-9 * excess else math.inf,
        minor / major * covered,
    )


# -- Following -------------------------------------------------------------------------------------------------------
def match(rest: Markers | np.ndarray, now: Markers | np.ndarray, reach: float | None = None) -> np.ndarray:
    """dU = U - U0: the displacement of each marker of `rest`, (n, 2) px, NaN where none of `now` is its own.

    rest, now  (n, 2) and (m, 2) x, y in px, or what `find` returns
    reach      px, the longest displacement; by default 0.45 of each marker's distance to its nearest neighbour at rest

    The pairs with the least sum of (distance / reach)^2, a marker that is left without one counting as 1; each of `now`
    is used once at most. A skin that moves as a whole by more than half a pitch is matched wrongly: follow it frame by
    frame. Raises ValueError where a single marker has no neighbour to take the reach from. Source: Vi2TaP (RA-L 2025),
    III.A.3."""
    rest, now = _points(rest, "rest"), _points(now, "now")
    n, m = len(rest), len(now)
    moved = np.full((n, 2), np.nan)
    if n == 0:
        return moved
    if reach is None:
        if n == 1:
            raise ValueError("reach = None and one marker at rest, which has no neighbour; give reach in px")
        apart = np.linalg.norm(rest[:, None] - rest, axis=2)
        reaches = REACH * np.min(apart + np.where(np.eye(n), np.inf, 0), axis=1)
    elif reach > 0:
        reaches = np.full(n, float(reach))
    else:
        raise ValueError(
            f"reach = {reach:g} px; allowed: above 0; half the distance between markers is the most that is safe"
        )
    away = np.sum((now - rest[:, None]) ** 2, axis=2) / reaches[:, None] ** 2
    row, column = linear_sum_assignment(np.hstack([away, np.ones((n, n))]))  # n ways to be lost
    row, column = row[column < m], column[column < m]
    moved[row] = now[column] - rest[row]
    return moved


def displacement(
    rest_image: np.ndarray,
    image: np.ndarray,
    grid: tuple[int, int] | None = None,
    reach: float | None = None,
    **options,
) -> tuple[np.ndarray, np.ndarray]:
    """(places U0, displacements dU = U - U0), both (n, 2) px, from an image at rest and another; NaN where a marker is
    lost.

    grid     (columns, rows) of the markers: exactly that many are looked for, and places come row by row, as a network
             wants them. None: all that `find` finds at rest, the most detectable first
    reach    px, see `match`
    options  of `find` but for the count, the same for both images

    Raises ValueError where the image at rest does not show the grid. Source: Vi2TaP (RA-L 2025), III.A.3.
    """
    rest = find(rest_image, grid and grid[0] * grid[1], **options).centres
    if grid:
        rest = rest[grid_order(rest, *grid)]
    return rest, match(rest, find(image, **options), reach)


def grid_order(centres: Markers | np.ndarray, columns: int = 5, rows: int = 4) -> np.ndarray:
    """(columns rows,) indices that order the markers of a matrix row by row: top to bottom, and left to right in each.

    centres  (columns rows, 2) x, y in px, in any order

    A homography takes the grid to its image: first by the four corners, then by all markers, each given to one node so
    that the squared distances are least, until nothing changes. Of 5 x 4 markers off their nodes by up to 0.3 cells
    along x and y, seen in perspective of 1.5 : 1 and turned by up to 25 deg, 100 % are ordered; beyond, ever more are
    refused (of 3 : 1 and 25 deg a third to a half), but of 8000 random grids up to 45 deg, 0.4 cells and 3 : 1 none
    came back in a wrong order. Raises ValueError where the number is wrong or a marker is more than half a cell off its
    node. Source: Vi2TaP (RA-L 2025), II.B: 5 x 4 markers."""
    points = _points(centres, "centres")
    if min(columns, rows) < 2 or len(points) != columns * rows:
        raise ValueError(
            f"{len(points)} markers for {columns} columns x {rows} rows; allowed: exactly {columns * rows}, 2 x 2 at "
            "least; order a complete image at rest and follow its markers by `match`"
        )
    nodes = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2).astype(float)
    z = (points - points.mean(0)) / np.maximum(points.std(0), 1e-12)
    corners = [np.argmin(z @ d) for d in ((1, 1), (-1, 1), (1, -1), (-1, -1))]
    at = [0, columns - 1, (rows - 1) * columns, rows * columns - 1]
    order, last = np.array(corners), None
    for _ in range(10 if len(set(corners)) == 4 else 0):
        predicted = _project(_homography(nodes[at], points[order]), nodes)
        if not np.isfinite(predicted).all():
            break
        order, at = linear_sum_assignment(np.sum((predicted[:, None] - points) ** 2, axis=2))[1], slice(None)
        if np.array_equal(order, last):
            off = np.linalg.norm(_project(_homography(points[order], nodes), points[order]) - nodes, axis=1)
            if off.max() > OFF_GRID:
                break
            return order
        last = order
    raise ValueError(
        f"{len(points)} markers do not form {columns} columns x {rows} rows: some are more than {OFF_GRID:g} cells "
        "off their node; look at the centres, and check columns and rows, a false marker, a turn of the image"
    )


def _points(points: Markers | np.ndarray, name: str) -> np.ndarray:
    points = np.asarray(points.centres if isinstance(points, Markers) else points, float)
    if points.size == 0:
        return np.zeros((0, 2))
    if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
        raise ValueError(
            f"{name}: shape {points.shape}, {np.sum(~np.isfinite(points))} values not finite; allowed: finite (n, 2), "
            "x and y in px; leave lost markers out"
        )
    return points


def _homography(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(3, 3) H with target ~ H source for points (n >= 4, 2), by the direct linear transform on normalised points."""

    def normal(p):
        scale = 1 / max(p.std(), 1e-12)
        return np.array([[scale, 0, -scale * p[:, 0].mean()], [0, scale, -scale * p[:, 1].mean()], [0, 0, 1]])

    a, b = normal(source), normal(target)
    s, t = _project(a, source), _project(b, target)
    one, none = np.ones((len(s), 1)), np.zeros((len(s), 3))
    h = np.hstack([s, one])
    system = np.vstack([np.hstack([h, none, -t[:, :1] * h]), np.hstack([none, h, -t[:, 1:] * h])])
    return np.linalg.inv(b) @ np.linalg.svd(system)[2][-1].reshape(3, 3) @ a


def _project(h: np.ndarray, points: np.ndarray) -> np.ndarray:
    p = points @ h[:, :2].T + h[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):  # a point at infinity is the caller's to notice
        return p[:, :2] / p[:, 2:]
