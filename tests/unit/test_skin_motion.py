"""The stretch of a skin found by its grain: known motions of drawn grain, and what has no grain."""

from pathlib import Path

import numpy as np
import pytest

from optics.captures.skin_motion import skin_motion

SCANS = Path(__file__).parents[3] / "shared" / "data" / "gelsight_single_led"

SIZE, SCALE, SPACING, RADIUS = (300, 400), 0.02, 1.0, 0.22  # px, mm/px, mm, mm
U = np.zeros((10, 2))  # of 1, x, y, xx, xy, yy, xxx, xxy, xyy, yyy, in half widths: 0.1 mm at the image's rim
U[0, 1], U[1, 0], U[2, 1] = 0.008, -0.012, -0.022
U[6, 0], U[8, 0], U[7, 1], U[9, 1] = -0.008, -0.004, -0.004, -0.01


def balls():
    x, y = np.meshgrid(np.arange(-4, 5), np.arange(-4, 5))
    return np.stack([x.ravel(), y.ravel()], -1) * SPACING + (0.2, -0.1)


def scene(rng, u=U, grain=0.05, noise=0.004, window=0.01):
    """(flat, pressed) (2, H, W) DN: grain that the motion carries, dust that it does not, two lights, dark rings around
    the contacts, noise and whole numbers."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    height, width = SIZE
    pad = 60
    skin = gaussian_filter(rng.normal(size=(height + 2 * pad, width + 2 * pad)), 1.5)
    skin *= grain / skin.std()
    fixed = gaussian_filter(rng.normal(size=SIZE), 1.5)
    fixed *= window / fixed.std()
    v, w = np.mgrid[:height, :width] + 0.5
    x, y = (w - width / 2) / (width / 2), (v - height / 2) / (width / 2)
    terms = np.stack([x**0, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], -1)
    move = terms @ u * width / 2
    carried = map_coordinates(skin, [v - 0.5 + pad + move[..., 1], w - 0.5 + pad + move[..., 0]], order=3)
    at = np.stack([w - width / 2, v - height / 2], -1) * SCALE
    off = np.hypot(*np.moveaxis(at[:, :, None] - balls(), -1, 0)).min(-1)
    ring = 1 - 0.6 * np.exp(-(((off - RADIUS) / 0.05) ** 2))
    lights = np.stack([100 * (1 + 0.2 * x - 0.1 * y), 90 * (1 - 0.25 * x)])
    still = lights * np.exp(skin[pad : pad + height, pad : pad + width] + fixed)
    moved = lights * np.exp(carried + fixed) * ring
    return tuple(np.round(i * (1 + noise * rng.normal(size=i.shape))) for i in (still, moved))


def truth(x, y):
    """J - 1 at places in mm, by differences of the motion."""
    half = SIZE[1] / 2 * SCALE

    def u(x, y):
        a, b = x / half, y / half
        return np.stack([a**0, a, b, a * a, a * b, b * b, a**3, a * a * b, a * b * b, b**3], -1) @ U * half

    h = 1e-5
    (xx, yx), (xy, yy) = (
        np.moveaxis((u(x + i * h, y + j * h) - u(x - i * h, y - j * h)) / (2 * h), -1, 0) for i, j in ((1, 0), (0, 1))
    )
    return 1 / ((1 + xx) * (1 + yy) - xy * yx) - 1


def test_a_known_motion_is_found():
    """Places of 150 and more agree; J - 1 within .01 of .035 to .06 where the view is not at its rim."""
    flat, pressed = scene(np.random.default_rng(3))
    found = skin_motion(flat, pressed, balls(), SPACING, RADIUS, SCALE)
    assert found.places[0] > 150 and found.rms < SCALE  # a pixel: places are whole pixels
    x, y = np.meshgrid(np.linspace(-3, 3, 7), np.linspace(-2, 2, 5))
    j = truth(x, y)
    assert j.min() < 0.036 and j.max() > 0.06
    np.testing.assert_allclose(found.areal_stretch(x, y), j, atol=0.01)
    s = found.settings()
    stated = (
        s["stretch"] + s["stretch_x"] * x + s["stretch_y"] * y
        + s["stretch_xx"] * x * x + s["stretch_xy"] * x * y + s["stretch_yy"] * y * y
    )  # fmt: skip
    np.testing.assert_allclose(stated, found.areal_stretch(x, y), atol=0.002)  # of a cubic motion J is nearly quadratic


def test_a_skin_at_rest_is_not_stretched():
    flat, pressed = scene(np.random.default_rng(4), u=0 * U)
    found = skin_motion(flat, pressed, balls(), SPACING, RADIUS, SCALE)
    assert np.abs(found.extremes()).max() < 0.005


@pytest.mark.slow
@pytest.mark.parametrize("case", ["no grain", "grain of another skin", "no room between the contacts"])
def test_nothing_is_stated_where_nothing_is_known(case):
    rng = np.random.default_rng(5)
    flat, pressed = scene(rng, grain=1e-9 if case == "no grain" else 0.05, window=1e-9)
    if case == "grain of another skin":
        flat = scene(rng)[0]
    radius = 0.4 if case == "no room between the contacts" else RADIUS
    assert skin_motion(flat, pressed, balls(), SPACING, radius, SCALE) is None


@pytest.mark.slow
@pytest.mark.skipif(not SCANS.is_dir(), reason="measured scans are not here")
def test_two_presses_of_a_real_skin_stretch_it_alike(tmp_path):
    """Plates that two scans press in at different places stretch the same gel: by 3 to 6 % in the middle, more towards
    its rim, and alike within 3 %."""
    from optics.captures.scans import plate_of, scans_in

    read = scans_in(SCANS)
    scans, flat = read.plates, read.flat
    found = []
    for scan in scans:
        plate = plate_of(scan)
        images = (flat.images[..., 0], scan.images[..., 0])
        motion = skin_motion(*images, plate.balls, plate.spacing, scan.radius, scan.mm_per_pixel)
        assert motion.places[0] > 150
        found.append(motion.areal_stretch(np.array([0.0, 3.3, -3.3, 0, 0]), np.array([0.0, 0, 0, 2.7, -2.7])))
    one, other = found
    assert 0.03 < one[0] < 0.06 and one[1:].mean() > one[0]
    np.testing.assert_allclose(one, other, atol=0.03)
