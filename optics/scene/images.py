"""What effects of a lens do to images: blur by a Gaussian, and a change of size about the optical axis.

Both are linear in the image and analytic in their strength, for derivatives by complex step."""

from __future__ import annotations

import numpy as np


def blurred(image: np.ndarray, variance) -> np.ndarray:
    """An image (H, W, B) smeared by Gaussians of a variance along each axis, px^2, one for all bands or (B,).

    By the cosine transform, as a factor exp(-V (pi k/N)^2/2): the image is mirrored at its borders, and the result is
    exact for any V, also far below a pixel."""
    from scipy.fft import dctn, idctn

    rows, columns = image.shape[:2]
    frequency2 = (np.pi * np.arange(rows) / rows)[:, None] ** 2 + (np.pi * np.arange(columns) / columns) ** 2
    transfer = np.exp(-np.asarray(variance) * frequency2[..., None] / 2)
    return idctn(dctn(image, axes=(0, 1)) * transfer, axes=(0, 1))


def resampling(places) -> np.ndarray:
    """(M, N) matrix that reads N equidistant values at places (M,), 0 at the first and N - 1 at the last of as many
    places; complex ones give derivatives. Beyond its ends a row of values goes on as it ends.

    Cubic convolution, of the third order (Keys, IEEE Trans. ASSP 29, 1153, 1981)."""
    places = np.asarray(places)
    count = len(places)
    first = np.floor(places.real).astype(int)
    t = places - first
    weights = (
        ((-0.5 * t + 1) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1,
        ((-1.5 * t + 2) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )
    matrix = np.zeros((count, count), places.dtype)
    rows = np.arange(count)
    for k, weight in enumerate(weights):
        np.add.at(matrix, (rows, np.clip(first + k - 1, 0, count - 1)), weight)
    return matrix


def magnified(image: np.ndarray, growth, middle: tuple[float, float]) -> np.ndarray:
    """An image (H, W, B) larger by the factor 1 + growth (B,) about a point (u, v) in px: what was seen at the distance
    r from it is seen at (1 + growth) r. Pixel centres are at +0.5."""
    found = np.empty(image.shape, np.result_type(image, growth))
    for band, g in enumerate(np.asarray(growth)):
        columns, rows = (
            resampling((np.arange(n) + 0.5 - m) / (1 + g) + m - 0.5)
            for n, m in zip((image.shape[1], image.shape[0]), middle)
        )
        found[..., band] = rows @ image[..., band] @ columns.T
    return found
