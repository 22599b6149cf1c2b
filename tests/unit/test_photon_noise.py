"""The black level that the noise of images tells, of cameras that count electrons one by one."""

import numpy as np
import pytest
from scipy import ndimage

from optics.captures.photon_noise import photon_noise

SIZE, PITCH = (480, 600), 60.0  # px
GAIN = 0.025  # DN per electron


def lights(rng, grain=0.02):
    """Light in DN, without a pedestal, of balls on a level face that four lamps light one after another: Lambert's law
    but for 2 % of light from all sides, a lens that blurs by 1.2 px, and a coating whose grain has `grain` rms."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]] / PITCH
    pattern = ndimage.gaussian_filter(rng.standard_normal(SIZE), 1.0)
    albedo = 1 + grain * pattern / pattern.std()
    x, y = (u % 1 - 0.5) / 0.4, (v % 1 - 0.5) / 0.4
    ball = x**2 + y**2 < 0.85
    nx, ny = x * ball, y * ball
    nz = np.sqrt(1 - nx**2 - ny**2)
    for azimuth in np.radians([0.0, 90.0, 180.0, 270.0]):
        direct = 0.6 * (nx * np.cos(azimuth) + ny * np.sin(azimuth)) + 0.8 * nz
        falling = 1 + 0.02 * (np.cos(azimuth) * (u - 5) + np.sin(azimuth) * (v - 4))
        yield ndimage.gaussian_filter(90 * falling * albedo * np.maximum(direct, 0.02), 1.2)


def pictures(rng, pedestal, dark=0.2, **options):
    return [
        np.clip(np.round(rng.poisson(s / GAIN) * GAIN + pedestal + dark * rng.standard_normal(SIZE)), 0, 255)
        for s in lights(rng, **options)
    ]


@pytest.mark.parametrize("pedestal", [8.0, 16.0])
def test_the_black_level_is_where_photon_noise_ends(pedestal):
    """Mean of four sets of one scene. Dark noise of .2 DN takes 1.6 DN off, .04/K; of forty such sets the mean was .6
    DN above that, and they scattered by .6 DN: of the mean of four, 1.5 DN is that and three errors."""
    found = [photon_noise([pictures(np.random.default_rng(seed), pedestal)], 255.0) for seed in range(4)]
    assert np.mean([f.black_level for f in found]) == pytest.approx(pedestal - 0.2**2 / GAIN, abs=1.5)
    assert 0.3 < np.mean([f.sd for f in found]) < 1.6
    assert np.mean([f.system_gain for f in found]) == pytest.approx(GAIN, rel=0.05)


@pytest.mark.parametrize("grain", [0.0, 0.05])
def test_a_camera_without_a_pedestal_has_none(grain):
    """Whatever grain the coating has, in each of four sets."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        assert photon_noise([pictures(rng, 0.0, dark=0.1, grain=grain) for _ in range(2)], 255.0) is None


def test_what_is_no_photon_noise_says_nothing():
    """Images that are coded for viewing, whose noise grows more slowly than their values; a face that is level, so that
    there is nothing dark; one image of a scene; no noise at all."""
    rng = np.random.default_rng(7)
    coded = [255 * (p / 255) ** 0.45 for p in pictures(rng, 8.0)]
    level = [np.round(rng.poisson(80.0 / GAIN, SIZE) * GAIN + 8.0) for _ in range(4)]
    for scene in (coded, level, pictures(rng, 8.0)[:1], [np.full(SIZE, 40.0)] * 4, [np.zeros(SIZE)] * 4):
        assert photon_noise([scene], 255.0) is None
