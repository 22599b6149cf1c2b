"""How far a press spreads the skin: the coating's grain, found again in the image of the untouched sensor.

    X = x + u(x),   J = 1/det(1 + du/dx)

A point of the skin that a press shows at x lies at X in the flat field; J is the area that a piece of skin takes when
pressed over the area that it takes at rest. Squares of image between the contacts are looked for in the flat field by
normalized cross-correlation; u is the cubic in x and y that their places follow, by least squares with a Cauchy loss,
as squares without grain are found anywhere, and dust on the window does not move. The mean of the LEDs' logarithms is
used, without what is wider than grain.

A gel between a window and a plate cannot be compressed, so it gives way to the side: squeezed by a share e of its
thickness it spreads over 1/(1 - e) of its area (K. L. Johnson, Contact Mechanics, 5.8)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optics.skin.contact import STRETCH

ACROSS = 1200  # px: images are averaged down to about this; grain is wider than the pixels that are lost
GRAIN = (0.75, 6.0)  # px after averaging: standard deviations of the two blurs whose difference is grain
HALF, REACH = 1 / 7, 1 / 6  # of the spacing of contacts: half a square's side, and how far it is looked for
CLEAR = 1.4  # of a contact's radius: what its shadow and skirt change
AGREES = 1.0  # px after averaging: the Cauchy loss's scale, and how well a place agrees with the cubic
LEAST = 30  # places that agree, for the 20 numbers of two cubics
SHARE = 0.2  # of all places: chance alone makes one of 300 agree


@dataclass(frozen=True)
class SkinMotion:
    """u of a press, and what it does to areas.

    coefficients  (10, 2) of 1, x, y, xx, xy, yy, xxx, xxy, xyy, yyy in half widths of the image about its middle; u in
                  the same unit
    half_width    mm, of the image;   half_height
    places        squares that agree, of so many tried;   rms  mm, by which they miss u
    """

    coefficients: np.ndarray
    half_width: float
    half_height: float
    places: tuple[int, int]
    rms: float

    def displacement(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """(..., 2) mm from places (mm from the middle of the image) to where the skin lies in the flat field."""
        terms = cubic(np.asarray(x, float) / self.half_width, np.asarray(y, float) / self.half_width)
        return self.half_width * (terms @ self.coefficients)

    def areal_stretch(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """J - 1 at places in mm from the middle of the image."""
        a, b = np.asarray(x, float) / self.half_width, np.asarray(y, float) / self.half_width
        zero, one = np.zeros_like(a), np.ones_like(a)
        along_x = np.stack([zero, one, zero, 2 * a, b, zero, 3 * a * a, 2 * a * b, b * b, zero], -1)
        along_y = np.stack([zero, zero, one, zero, a, 2 * b, zero, a * a, 2 * a * b, 3 * b * b], -1)
        (xx, yx), (xy, yy) = (np.moveaxis(d @ self.coefficients, -1, 0) for d in (along_x, along_y))
        return 1 / ((1 + xx) * (1 + yy) - xy * yx) - 1

    def settings(self) -> dict[str, float]:
        """The `stretch` parameters of a gel: J - 1 = s + sx x + sy y + sxx x^2 + sxy x y + syy y^2, by least squares
        over the image; 1, 1/mm and 1/mm^2."""
        x, y = self._grid()
        terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)
        found = np.linalg.lstsq(terms, self.areal_stretch(x, y), rcond=None)[0]
        return dict(zip(STRETCH, map(float, found)))

    def extremes(self) -> tuple[float, float]:
        """Smallest and largest J - 1 on a grid over the image."""
        found = self.areal_stretch(*self._grid())
        return float(found.min()), float(found.max())

    def _grid(self) -> np.ndarray:
        """(2, 625) x and y of a grid over the image, mm from its middle."""
        axes = (np.linspace(-half, half, 25) for half in (self.half_width, self.half_height))
        return np.reshape(np.meshgrid(*axes), (2, -1))


def cubic(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(..., 10): 1, x, y, xx, xy, yy, xxx, xxy, xyy, yyy."""
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], -1)


def skin_motion(
    flat: np.ndarray, pressed: np.ndarray, contacts: np.ndarray, spacing: float, radius: float, scale: float
) -> SkinMotion | None:
    """The motion of the skin between two sets of images of one camera, (N, H, W) DN each, one image for each LED.

    contacts  (B, 2) mm from the middle of the image: a grid of contacts, `spacing` mm apart, of `radius` mm
    scale     mm per pixel

    None where too few places agree: no grain, or motion beyond REACH."""
    from scipy.optimize import least_squares

    times = max(1, round(flat.shape[2] / ACROSS))
    scale = scale * times
    rest, moved = (grain(images, times) for images in (flat, pressed))
    height, width = rest.shape
    half, reach = int(HALF * spacing / scale), int(REACH * spacing / scale)
    if half < 6 or spacing / 2 - half * scale < CLEAR * radius:
        return None  # no square fits between the contacts
    middle = np.array([width, height]) / 2
    found = []
    for column, row in np.round(_between(contacts, spacing) / scale + middle).astype(int):
        if half <= column < width - half and half <= row < height - half:
            found.append((column, row, *_match(rest, moved, column, row, half, reach)))
    if len(found) < LEAST:
        return None
    column, row, right, down = np.array(found, float).T
    unit = width / 2
    terms = cubic((column - middle[0]) / unit, (row - middle[1]) / unit)
    u = np.stack([right, down], -1)

    def fit(count: int, start: np.ndarray) -> np.ndarray:
        """Coefficients of the first so many terms; the loss is that of each place, of its two coordinates together."""

        def off(c: np.ndarray) -> np.ndarray:
            d = np.hypot(*(terms[:, :count] @ c.reshape(count, 2) - u).T) / AGREES
            return np.sqrt(np.log1p(d * d))

        return least_squares(off, start.ravel(), method="trf").x.reshape(count, 2)

    c = fit(3, np.vstack([np.median(u, 0), np.zeros((2, 2))]))
    for count in (6, 10):
        c = fit(count, np.vstack([c, np.zeros((count - len(c), 2))]))
    off = np.hypot(*(terms @ c - u).T)
    agree = off < 2 * AGREES
    if agree.sum() < max(LEAST, SHARE * len(off)):
        return None
    c = np.linalg.lstsq(terms[agree], u[agree], rcond=None)[0]
    rms = float(np.sqrt(np.mean(np.sum((terms[agree] @ c - u[agree]) ** 2, -1)))) * scale
    return SkinMotion(c / unit, unit * scale, height / 2 * scale, (int(agree.sum()), len(off)), rms)


def grain(images: np.ndarray, times: int) -> np.ndarray:
    """(H', W') of (N, H, W) DN: the mean over the LEDs of the logarithm, less what is wider or finer than grain."""
    from scipy.ndimage import gaussian_filter
    from skimage.measure import block_reduce

    height, width = (n // times * times for n in images.shape[1:])
    sums = np.zeros((height // times, width // times))
    for image in images:
        sums += np.log(np.maximum(block_reduce(image[:height, :width], (times, times), np.mean), 1.0))
    fine, wide = (gaussian_filter(sums / len(images), sd) for sd in GRAIN)
    return fine - wide


def _between(contacts: np.ndarray, spacing: float) -> np.ndarray:
    """(n, 2) mm: places on the lines between the rows of the grid, and between its columns, four to a spacing; half a
    spacing or more from every contact."""
    from scipy.spatial import cKDTree

    tree = cKDTree(contacts)
    found = []
    for i, j in tree.query_pairs(1.2 * spacing, output_type="ndarray"):
        along = contacts[j] - contacts[i]
        across = np.array([-along[1], along[0]])
        found += [(contacts[i] + contacts[j]) / 2 + share * across for share in (-0.5, -0.25, 0.0, 0.25, 0.5)]
    places = np.unique(np.round(np.array(found).reshape(-1, 2) / (0.05 * spacing)), axis=0) * 0.05 * spacing
    kept: list[np.ndarray] = []
    for place in places[tree.query(places)[0] > 0.45 * spacing]:
        if not kept or np.hypot(*(np.array(kept) - place).T).min() > 0.15 * spacing:
            kept.append(place)
    return np.array(kept).reshape(-1, 2)


def _match(rest: np.ndarray, moved: np.ndarray, column: int, row: int, half: int, reach: int) -> Sequence[float]:
    """(right, down) px from a square of the pressed image to where the image at rest is most like it."""
    from skimage.feature import match_template

    square = moved[row - half : row + half, column - half : column + half]
    top, left = max(row - half - reach, 0), max(column - half - reach, 0)
    window = rest[top : row + half + reach, left : column + half + reach]
    alike = match_template(window, square)
    y, x = np.unravel_index(int(np.argmax(alike)), alike.shape)
    return left + x - (column - half), top + y - (row - half)
