"""Tables of the normal: each is exact on what it can express, has the numbers that it says, and never sees what is
masked."""

import numpy as np
import pytest

from optics.errors import Underdetermined
from optics.fit.null_models import Binned, Lambert, Polynomial, Shape, place_of, tables

SIZE = (40, 60)
BLACK = 7.0
NUMBERS = {
    "mean": 1,
    "directional Lambert with shadow": 3,
    "linear in the normal": 4,
    "linear in the normal, with position": 12,
    "cubic in the normal": 16,
    "linear in the normal, with position squared": 24,
    "quadratic in the normal, with position": 27,
}  # harmonics 1, 4, 9, 16 up to order 0 to 3, times 1, (1, x, y) or a quadratic


def ball(x0, y0, radius=0.5, slope=0.95):
    """A shape with a ball at (x0, y0) in units of half the image's width, level around it, under an uneven flat
    field."""
    x, y = place_of(SIZE)
    u, v = (x - x0) / radius, (y - y0) / radius
    on = np.hypot(u, v) < slope
    z = np.sqrt(np.maximum(1 - u * u - v * v, 0))
    tilt = np.where(on[..., None], np.stack([u, v, z - 1], -1), 0.0)
    background = BLACK + (100 + 20 * x[..., None]) * np.array([1.0, 0.7])
    return Shape(background, tilt, x, y, BLACK)


def fitted(table, images, shapes, weights=None):
    weights = weights or [np.ones(image.shape) for image in images]
    return table.fit(shapes, list(zip(images, weights)))


def shaded(shape, f):
    return shape.black + (shape.background - shape.black) * f[..., None]


def direction(shape, light=(0.5, -0.3, 0.4)):
    """max(0, l.n) + 1 - l_z."""
    n = shape.tilt + (0, 0, 1)
    return np.maximum(n @ np.array(light), 0) + 1 - light[2]


@pytest.mark.parametrize("table", [variants[0] for variants in tables()], ids=lambda t: t.name)
def test_a_table_has_the_numbers_that_it_says(table):
    rng = np.random.default_rng(1)
    shapes = [ball(-0.2, 0.1), ball(0.3, -0.1)]
    fitted(table, [s.background + rng.normal(size=s.background.shape) for s in shapes], shapes)
    if table.name in NUMBERS:
        assert table.numbers() == NUMBERS[table.name]
    else:
        assert table.numbers() % 6 == 0 and 6 * 100 < table.numbers() <= 6 * 24 * 48


@pytest.mark.parametrize("added", [False, True])
@pytest.mark.parametrize(
    "table, truth",
    [
        (lambda added: Polynomial("mean", 0, added=added), lambda s: np.full(SIZE, 1.2)),
        (lambda added: Lambert(added), direction),
        (lambda added: Polynomial("linear", 1, added=added), lambda s: 1.1 + s.tilt @ np.array([0.5, -0.3, 0.4])),
        (
            lambda added: Polynomial("position", 1, 1, added),
            lambda s: 1.1 + 0.1 * s.x + (s.tilt @ np.array([0.5, -0.3, 0.4])) * (1 + 0.2 * s.y),
        ),
        (
            lambda added: Polynomial("cubic", 3, added=added),
            lambda s: 1 + s.tilt[..., 0] ** 3 + 0.2 * s.tilt[..., 2] ** 2,
        ),
        (lambda added: Polynomial("quadratic", 2, 1, added), lambda s: 1 + s.tilt[..., 0] * s.tilt[..., 1] * (1 - s.x)),
    ],
    ids=["mean", "directional", "linear", "linear with position", "cubic", "quadratic with position"],
)
def test_what_a_table_can_express_is_predicted_on_another_press(table, truth, added):
    """Without noise, to rounding; the directional one to the steps of its search for lit pixels, which ends exactly.

    Three presses: two lie on a line, and say nothing of what changes across it."""
    shapes, other = [ball(-0.3, 0.1), ball(0.25, -0.15), ball(0.1, 0.15)], ball(0.0, 0.05)

    def image(shape):
        if not added:
            return shaded(shape, truth(shape))
        return shape.background + 80.0 * (truth(shape)[..., None] - 1) * np.array([1.0, 0.7])

    found = fitted(table(added), [image(s) for s in shapes], shapes)
    assert np.abs(found.predict(other) - image(other)).max() < 1e-6


def test_the_light_of_the_directional_table_is_found_in_attached_shadow():
    """A low light leaves a third of the ball dark; a linear table cannot say so."""
    light, shapes = (0.8, 0.2, 0.3), [ball(-0.3, 0.1), ball(0.25, -0.15)]
    images = [shaded(s, direction(s, light)) for s in shapes]
    lambert = fitted(Lambert(), images, shapes)
    assert np.abs(lambert.light - light).max() < 1e-9
    linear = fitted(Polynomial("linear", 1), images, shapes)
    assert np.abs(linear.predict(shapes[0]) - images[0]).max() > 3.0  # DN


def test_masked_values_do_not_count():
    shapes = [ball(-0.3, 0.1), ball(0.25, -0.15)]
    images = [shaded(s, direction(s)) for s in shapes]
    weights = [np.ones(i.shape) for i in images]
    images[0][5:15, 5:15] += 500.0
    weights[0][5:15, 5:15] = 0.0
    found = fitted(Lambert(), images, shapes, weights)
    assert np.abs(found.light - (0.5, -0.3, 0.4)).max() < 1e-9
    with pytest.raises(Underdetermined, match="linear in the normal: no usable pixel"):
        fitted(Polynomial("linear in the normal", 1), images, shapes, [np.zeros(i.shape) for i in images])


def test_the_polynomial_table_follows_what_no_polynomial_of_the_normal_does():
    """A step of the shading across one azimuth: bins of 7.5 deg hold it, and a bin without pixels takes its
    neighbour's."""

    def step(shape):
        return np.where(shape.tilt[..., 0] > 0.0, 1.4, 0.8)

    shapes = [ball(x, y) for x, y in [(-0.3, 0.1), (0.25, -0.15), (0.1, 0.1), (-0.1, -0.1)]]
    images = [shaded(s, step(s)) for s in shapes]
    other = ball(0.02, 0.03)
    binned, cubic = (fitted(t, images, shapes) for t in (Binned(24, 48), Polynomial("cubic", 3)))
    errors = [np.sqrt(np.mean((t.predict(other) - shaded(other, step(other))) ** 2)) for t in (binned, cubic)]
    assert errors[0] < errors[1] / 2
    assert np.isfinite(binned.coefficients).all() and binned.coefficients[:, 0, 0].min() > 0.5
