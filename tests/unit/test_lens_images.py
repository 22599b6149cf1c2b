"""Images that a lens moves and smears, against closed forms of what a pixel gets."""

import numpy as np
import pytest
from scipy.special import erf

from optics.scene.images import bend, blurred, magnified, of_pixels

WIDTH, HEIGHT, SD = 40, 30, 1.1  # px; of a spot's Gaussian


def spots(growth: float = 0.0, variance: float = 0.0) -> np.ndarray:
    """(H, W, 1) of spots that are seen larger by a factor about the middle and smeared by a variance, each pixel the
    mean over its area."""
    total = np.zeros((HEIGHT, WIDTH))
    for u, v in ((8.3, 7.1), (29.6, 12.4), (20.2, 22.8)):
        sd = np.hypot(SD * (1 + growth), np.sqrt(variance))
        across, down = (
            np.diff(erf((np.arange(n + 1) - (at - n / 2) * (1 + growth) - n / 2) / sd / np.sqrt(2)))
            for n, at in ((WIDTH, u), (HEIGHT, v))
        )
        total += np.outer(down, across)
    return total[..., None] * (1 + growth) ** 2  # a surface's brightness stays


def test_a_small_growth_moves_details_as_it_should():
    """Spots 2.6 px across: the size of the change within 2 % of itself (the spline moves waves of 4 px by 4.5 % too
    little, of 6 px by .8 %; cubic convolution would miss 15 %)."""
    growth = 0.005
    expected, found = spots(growth) - spots(), magnified(spots(), np.array([growth]), (WIDTH / 2, HEIGHT / 2)) - spots()
    size = float((found * expected).sum() / (expected**2).sum())
    assert size == pytest.approx(1, abs=0.02)
    assert np.linalg.norm(found - expected) < 0.1 * np.linalg.norm(expected)


def test_what_leaves_at_a_border_has_come_from_beyond_it():
    """A slope stays a slope to the last pixel under blur and growth: nothing mirrors it, nothing makes it level."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    slope = (100 + 3 * u - 2 * v)[..., None]
    for variance in (0.6, 30.0):  # 1e-5 of the image: what rings of the kink where what was turned ends, 6 sd outside
        assert blurred(slope, variance) == pytest.approx(slope, abs=1e-3)
    larger = magnified(slope, np.array([-0.02]), (WIDTH / 2, HEIGHT / 2))
    expected = 100 + 3 * ((u - 20) / 0.98 + 20) - 2 * ((v - 15) / 0.98 + 15)
    assert larger[..., 0] == pytest.approx(expected, abs=1e-6)  # 0.268^14 of what a row of splines ends with


@pytest.mark.parametrize("variance", [0.05, 0.6, 3.0])
def test_blur_makes_of_a_spot_a_wider_one(variance):
    """Within 3 % of the change: a spot's spectrum goes a little beyond what pixels can hold."""
    inner = (slice(6, -6), slice(6, -6))
    expected, found = (image[inner] - spots()[inner] for image in (spots(0.0, variance), blurred(spots(), variance)))
    assert float((found * expected).sum() / (expected**2).sum()) == pytest.approx(1, abs=0.03)


def test_what_bends_smoothly_has_its_mean_by_second_differences():
    """Of polynomials of the third degree exactly, at the borders and beside a rim of the second; nothing where rims are
    all around."""
    rng = np.random.default_rng(5)
    v, u = np.mgrid[:9, :12].astype(float)
    places = (np.arange(64) + 0.5) / 64 - 0.5
    fine_v, fine_u = (
        x[..., None, None] + shift for x, shift in zip((v, u), np.meshgrid(places, places, indexing="ij"))
    )
    for degree, inner in ((2, slice(None)), (3, slice(1, -1))):
        terms = [(a, b) for a in range(degree + 1) for b in range(degree + 1 - a)]
        weights = rng.standard_normal(len(terms))

        def surface(x, y):
            return sum(w * x**a * y**b for w, (a, b) in zip(weights, terms))

        middles, means = surface(v, u), surface(fine_v, fine_u).mean((-1, -2))
        found = middles + bend(middles[..., None], np.zeros((9, 12), bool))[..., 0] / 24
        # 64 x 64 midpoints leave 1/4096 of the difference
        assert np.abs(found - means)[inner, inner].max() < 1e-3 * np.abs(means - middles)[inner, inner].max()
    rim = np.zeros((9, 12), bool)
    rim[4, 5] = True
    edge = np.where(rim, 100.0, v**2)
    off = bend(edge[..., None], rim)[..., 0]
    assert (off[~rim] == 2).all()
    rim[:, ::2] = rim[::2] = True
    assert (bend(edge[..., None], rim) == 0).all()


@pytest.mark.parametrize("kind", [np.float32, complex])
def test_second_differences_go_around_rims_and_on_beyond_borders(kind):
    """Of x^2 + 3 y^2 they are 2 + 6 everywhere; a pixel at a rim, which is anything, changes none of them."""
    y, x = np.mgrid[:9, :11]
    image = np.stack([x**2 + 3 * y**2, 0 * x], -1).astype(kind)
    rim = np.zeros((9, 11), bool)
    expected = np.broadcast_to([8.0, 0.0], image.shape)
    assert bend(image, rim) == pytest.approx(expected) and bend(image, rim).dtype == kind
    image[4, 6], rim[4, 6] = 1000.0, True
    assert bend(image, rim)[~rim] == pytest.approx(expected[~rim])
    assert bend(image[:2], rim[:2]) == pytest.approx(expected[:2] - [6.0, 0.0])  # two rows have no second difference


def test_a_pixel_is_the_mean_of_its_parts():
    parts = np.arange(2 * 6 * 9 * 2).reshape(2, 6, 9, 2) * (1 + 2j)
    assert of_pixels(parts, 3) == pytest.approx(parts.reshape(2, 2, 3, 3, 3, 2).mean((-4, -2)))
