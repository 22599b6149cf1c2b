"""Balls painted by numpy: where rays meet them, what hides and shades what, and how bright they are, in closed form."""

import numpy as np
import pytest

from optics.fit.painted import Box, Canvas, Glow, between, dims, layers, meet, shaded, shine


def straight(u, v):
    """Rays along z through a pixel grid of a tenth of a millimetre."""
    o = np.column_stack([0.1 * u, 0.1 * v, np.zeros_like(u)])
    return o, np.broadcast_to([0.0, 0.0, 1.0], o.shape)


def test_rays_meet_balls_where_pythagoras_says():
    x = np.array([0.0, 0.3, 0.59, 0.61])
    o = np.column_stack([x, 0 * x, 0 * x])[None].astype(np.float32)
    d = np.broadcast_to(np.float32([0, 0, 1]), o.shape)
    t, terms = meet(o, d, np.float32([[[0, 0, 5]]]), np.float32([[0.6]]))
    np.testing.assert_allclose(t[0, :3], 5 - np.sqrt(0.36 - x[:3] ** 2), rtol=1e-6)
    assert np.isinf(t[0, 3])
    np.testing.assert_allclose(terms[0, :3, 1], x[:3] / 0.6, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(terms[0, :3, 1:4], axis=1), 1, rtol=1e-5)


def test_a_glow_is_found_again_though_some_of_it_lies_in_shadow():
    rng = np.random.default_rng(0)
    places = rng.uniform(-3, 3, (4000, 3))
    normals = rng.normal(size=(4000, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    x, y, z = places.T
    light = (20 + x - 0.1 * y * z) * (2 - normals[:, 2] + 0.5 * normals[:, 0] * normals[:, 1])
    dark = rng.random(4000) < 0.1
    seen = np.where(dark, 0.3 * light, light)[:, None]
    found = Glow.fitted(places, normals, seen)
    terms = np.column_stack([np.ones(4000), normals, *(normals.T[[0, 0, 0, 1, 1]] * normals.T[[0, 1, 2, 1, 2]])])
    again = shine(terms[:, None], found.at(places))[:, 0, 0]
    # those in shadow are three standard deviations off at first, and are left out one after the other
    assert np.abs(again / light - 1).max() < 0.02
    np.testing.assert_allclose(shine(terms[:, None], found.times(2).at(places))[:, 0, 0], 2 * again, rtol=1e-5)


def test_samples_show_the_nearest_ball_and_know_the_one_behind():
    canvas = Canvas(straight, (20, 20), 2)
    middles = np.array([[1.0, 1.0, 5.0], [1.2, 1.0, 7.0], [1.0, 1.0, 9.0]])
    radii = np.array([0.3, 0.3, 0.8])
    pixels = canvas.around(middles[:, :2] / 0.1, 9)
    t, terms = canvas.terms(pixels, middles, radii)
    t[pixels < 0] = np.inf
    light = np.broadcast_to(np.float32([1.0, 2.0, 3.0])[:, None, None, None], (*t.shape, 1)).copy()
    shown = layers([Box(np.arange(3), pixels, t, light)], canvas.samples, np.zeros((canvas.samples, 1), np.float32))
    first, light = shown.first.reshape(20, 20, 4), shown.light.reshape(20, 20, 4)
    behind = shown.behind.reshape(20, 20, 4)
    assert (first[9:11, 9:11] == 0).all() and (behind[9:11, 9:11] == 2).all()  # within both 0.3's: 1 is behind 0
    assert (first[10, 14] == 1).all() and (behind[10, 14] == 3).all()
    assert (first[10, 16] == 2).all() and (behind[10, 16] == 0).all()
    assert (first[0, 0] == -1).all() and (light[0, 0] == 0).all()
    assert np.isinf(shown.far.reshape(20, 20, 4)[10, 16]).all()
    # a picture three times as bright as ball 2 is painted, and as bright as the others
    picture = light.mean(2)[..., None] * np.where(first[..., :1] == 2, 3.0, 1.0)
    np.testing.assert_allclose(dims(shown, picture, 3, 4), [1, 1, 3], rtol=1e-5)


def test_a_ball_is_dark_where_another_stands_before_its_light():
    ball, spots = np.array([[0.0, 0.0, 0.0]]), np.array([[0.0, 0.0, -10.0], [10.0, 0.0, -10.0]])
    known = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -2.0], [0.0, 3.0, -2.0]])
    found = between(ball, known, spots, 1.0)
    assert found.shape == (1, 2, 3 + 1, 3)
    np.testing.assert_allclose(found[0, 0, 0], known[1])  # neither itself nor what stands aside
    assert np.isnan(found[0, 0, 1:]).all() and np.isnan(found[0, 1]).all()
    angle = np.radians([0.0, 30.0, -30.0])
    normals = np.column_stack([np.sin(angle), 0 * angle, -np.cos(angle)])[None].astype(np.float32)
    share = shaded(ball, 0.5, normals, spots, found)[0]
    places = 0.5 * normals[0]
    to = spots[:, None] - places
    distance = np.linalg.norm(to, axis=-1)
    each = np.maximum((to * normals[0]).sum(-1), 0) / distance**3
    # the first light is 10 away: its ray passes the ball at 2 by 0.23 mm at most, less than its radius
    np.testing.assert_allclose(share, each[1] / each.sum(0), rtol=1e-5)
    np.testing.assert_allclose(shaded(ball, 0.5, normals, spots, np.full_like(found, np.nan)), 1, rtol=1e-6)


@pytest.mark.parametrize("shape", [(5, 7), (7, 5)])
def test_pixels_around_a_place_stay_in_the_image(shape):
    canvas = Canvas(straight, shape, 1)
    pixels = canvas.around(np.array([[0.5, 0.5], [np.nan, 3.0]]), 1)
    assert set(pixels[0]) == {-1, 0, 1, shape[1], shape[1] + 1}
    assert (pixels[1] == -1).all()
