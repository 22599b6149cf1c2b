"""Which part of each pixel shows which ball, against rays by the thousand; and that images change as smoothly as balls
move."""

import numpy as np
import pytest

from optics.light.outlines import Grain, Outlines

SIDE, FOCAL, FOCUS, PUPIL = 12, 60.0, 16.0, 0.6


@pytest.fixture(scope="module")
def balls():
    """Some that hide each other in part, 1 to 5 px wide, some beyond the image's edges."""
    rng = np.random.default_rng(1)
    radii, middles = rng.uniform(0.15, 0.6, 14), []
    while len(middles) < len(radii):
        own = np.array([*rng.uniform(-1.8, 1.8, 2), rng.uniform(14, 19)])
        if all(np.linalg.norm(own - m) > radii[len(middles)] + r for m, r in zip(middles, radii)):
            middles.append(own)
    return np.array(middles), radii


def rays(u, v, lens=None):
    """Of a pinhole at the origin, or of a square pupil."""
    d = np.stack([(u - SIDE / 2) / FOCAL, (v - SIDE / 2) / FOCAL, np.ones_like(u)], -1)
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    o = np.zeros_like(d)
    if lens is not None:
        o[:, :2] = PUPIL * (2 * np.asarray(lens).T - 1)
        d = FOCUS * d - o
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
    return o.astype(np.float32), d.astype(np.float32)


def first_met(o, d, middles, radii):
    """Numbers of the balls that rays meet first, -1 for none."""
    nearest, found = np.full(len(o), np.inf), np.full(len(o), -1)
    for k, (middle, radius) in enumerate(zip(middles, radii)):
        to = middle - o.astype(float)
        along = (to * d).sum(1)
        inside = radius**2 - ((to**2).sum(1) - along**2)
        t = np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), np.inf)
        nearest, found = np.minimum(nearest, t), np.where(t < nearest, k, found)
    return found


def by_force(balls, lens_side=1, each=96):
    """(balls + 1, pixels) share of each pixel that shows each ball, the first of none."""
    places = (np.arange(SIDE * each) + 0.5) / each
    u, v = (a.ravel() for a in np.meshgrid(places, places))
    shares = 0.0
    middle = (np.arange(lens_side) + 0.5) / lens_side
    for a in middle:
        for b in middle:
            lens = None if lens_side == 1 else np.broadcast_to([[a], [b]], (2, u.size))
            met = first_met(*rays(u, v, lens), *balls).reshape(SIDE, each, SIDE, each)
            shares = shares + np.stack([(met == k).mean((1, 3)).ravel() for k in range(-1, len(balls[1]))])
    return shares / lens_side**2


def shares_of(outlines, shown, count):
    found = np.zeros((count + 1, SIDE**2))
    found[0, ~outlines.own.ravel()] = 1
    np.add.at(found, (np.where(shown.pair < 0, -1, outlines.ball[shown.pair]) + 1, shown.pixel), shown.weight)
    return found


@pytest.fixture(scope="module")
def truth(balls):
    return by_force(balls)


@pytest.mark.parametrize("side, rms, most", [(4, 4e-3, 0.04), (8, 1.5e-3, 0.015), (16, 5e-4, 5e-3)])
def test_shares_of_pixels(balls, truth, side, rms, most):
    """Of the pixels that show a ball; the error falls with the cells. 96 x 96 rays err by 2e-4."""
    outlines = Outlines(rays, (SIDE, SIDE), *balls)
    found = shares_of(outlines, outlines.shown(Grain(2.0, 0.0, side)), len(balls[1]))
    error = (found - truth)[truth > 0]
    assert np.sqrt(np.mean(error**2)) < rms and np.abs(error).max() < most
    np.testing.assert_allclose(found.sum(0), 1, atol=1e-5)


def test_shares_behind_a_pupil(balls, truth):
    """Of outlines that are blurred over up to a pixel; sharp ones are off by ten times as much."""
    outlines = Outlines(rays, (SIDE, SIDE), *balls, PUPIL * np.sqrt(2))
    found, blurred = (
        shares_of(outlines, outlines.shown(Grain(2.0, 1.0, 8)), len(balls[1])),
        by_force(balls, lens_side=10, each=16),
    )
    error, sharp = (np.sqrt(np.mean((a - blurred)[blurred > 0] ** 2)) for a in (found, truth))
    assert error < 0.12 * sharp


def test_rays_meet_what_they_are_for(balls):
    """But for a few whose cell is crossed by several outlines."""
    outlines = Outlines(rays, (SIDE, SIDE), *balls)
    shown = outlines.shown(Grain(2.0, 0.0, 4))
    o, d = (a.copy() for a in rays(shown.u, shown.v))
    meant = np.where(shown.pair < 0, -1, outlines.ball[shown.pair])
    before = np.mean(first_met(o, d, *balls) != meant)
    cut = np.flatnonzero(shown.cut)
    d[cut] = outlines.aimed(shown, cut, o[cut], d[cut])
    assert np.mean(first_met(o, d, *balls) != meant) < min(0.006, before / 3)


def test_no_ball_is_seen():
    outlines = Outlines(rays, (SIDE, SIDE), np.array([[0.0, 0.0, -15.0]]), np.array([0.5]))
    assert not outlines.own.any() and len(outlines.shown(Grain(2.0, 0.0, 4)).pixel) == 0


def test_an_image_moves_with_its_camera(mitsuba):
    """Second differences of the image, where outlines move by a thirtieth of a pixel, are small beside the first ones;
    of rays that count as what they meet they are nearly as large. Shadows are left, which are cast or not."""
    from optics.light.renderer import Renderer
    from optics.scene import loader

    few = {
        "width": 24,
        "height": 24,
        "x_fov": 24,
        "beads": 12,
        "field": 6,
        "diameter": 1.2,
        "top": 0.65,
        "bottom": 3.85,
    }
    renderer = Renderer(loader.load("particle_gel", {k: str(v) for k, v in few.items()}))
    values = renderer.scene.values()
    images = np.array([renderer.radiance({**values, "camera.x": x})[..., 1] for x in np.linspace(0, 0.05, 6)])
    first, second = (np.sqrt(np.mean(np.diff(images, n, axis=0) ** 2)) for n in (1, 2))
    assert second < 0.3 * first
