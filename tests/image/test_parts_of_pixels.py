"""A lens moves and smears light before pixels take their means: where rims are, such a lens acts on parts of pixels."""

import numpy as np
import pytest

from optics.scene import loader
from optics.scene.images import SIDE, finer_of, of_pixels

FULL_SCALE = 255.0  # DN of the bench
COARSE = 4  # pixels of the bench each way that are one of the coarse camera
# effect -> (key, value for coarse pixels, the same for those of the bench)
LENS = {
    "lens blur": ("camera.blur", 0.5, 0.5 * COARSE**2),
    "chromatic focus": ("camera.chromatic_blur", 0.6, 0.6 * COARSE**2),
    "lateral colour": ("camera.lateral_colour", 0.02, 0.02),
}
SHADOWS = {"gel.press_depth": 1.0, "led_3.power": 0.0, "led_5.power": 0.0}  # sharp ones, which no other light fills


def of_size(bench, across):
    """The bench's sensor in sharp shadows, with pixels as wide as so many of the bench's."""
    width, height = (str(n // across) for n in bench.scene.camera.resolution)
    scene = loader.load(bench.scene.path, {**bench.scene.defines, "width": width, "height": height})
    return type(bench)(scene, {**bench.values, **SHADOWS})


@pytest.fixture
def coarse(bench):
    """A sensor whose rims are narrower than its pixels."""
    return of_size(bench, COARSE)


@pytest.mark.parametrize("effect", LENS)
def test_coarse_pixels_are_the_mean_of_what_fine_ones_see(effect, bench, coarse):
    """The change by a lens at 20 x 15 px against the mean of that at 80 x 60 px: measured 0.016, 0.029 and 0.037 of
    itself, by the samples of rims and as parts are halves of pixels. On whole pixels it is 2.7 to 4 times as much."""
    key, value, on_fine = LENS[effect]
    fine, now = of_size(bench, 1), {**coarse.values, key: value}
    expected = of_pixels(fine.image({key: on_fine}) - fine.image(), COARSE)
    developed = coarse.model.developer.develop
    on_pixels = developed(coarse.model.radiance(now), now) - developed(coarse.model.radiance(now), coarse.values)
    inner = slice(1, -1), slice(1, -1)  # beyond its borders an image goes on as it ends

    def off(found):
        return np.linalg.norm((found - expected)[inner]) / np.linalg.norm(expected[inner])

    found = off(coarse.image({key: value}) - coarse.image())
    assert found < 0.05
    assert off(on_pixels / FULL_SCALE) > 2 * found


@pytest.mark.parametrize("key", [key for key, *_ in LENS.values()])
def test_the_derivative_at_neutral_is_that_of_parts(key, coarse):
    """Against a one-sided difference of a ten-thousandth of a plausible change, whose bend leaves 1e-3."""
    step = 1e-4 * coarse.scene.parameters[key].plausible
    expected = (coarse.image({key: step}) - coarse.image({key: 0.0})) / step
    found = coarse.derivative(key)
    assert np.linalg.norm(found - expected) < 1e-3 * np.linalg.norm(expected)


@pytest.mark.parametrize("key", ["membrane.sigma", "led_1.power", "gel.haze", *(key for key, *_ in LENS.values())])
def test_derivatives_behind_a_lens_follow_its_images(key, coarse):
    """Central differences behind a lens that blurs: 1e-3, of a thousandth of a plausible change."""
    base = {"camera.blur": 0.5, "camera.chromatic_blur": 0.6, "camera.lateral_colour": 0.01}
    p = coarse.scene.parameters[key]
    value = base.get(key, coarse.values[key]) + 0.5 * p.plausible
    step = (0.05 if p.how == "ad" else 1e-3) * p.plausible
    high, low = (coarse.image({**base, key: value + s * step}) for s in (1, -1))
    found = coarse.derivative(key, {**base, key: value})
    expected = (high - low) / (2 * step)
    assert np.linalg.norm(found - expected) < 1e-3 * np.linalg.norm(expected)


def test_the_mean_of_the_parts_is_the_pixel(coarse):
    """To rounding, at rims and where finer samples count by a share; and parts differ from each other at rims."""
    renderer, now = coarse.renderer, coarse.values
    whole = renderer.radiance(now)
    with renderer.splitting(SIDE):
        parts = renderer.radiance(now)
    assert parts.shape[:2] == tuple(SIDE * n for n in whole.shape[:2])
    assert np.abs(of_pixels(parts, SIDE) - whole).max() < 1e-6 * whole.max()
    rim = renderer.shadows(now, "led_1")[0]
    within = parts.reshape(whole.shape[0], SIDE, whole.shape[1], SIDE, -1)
    assert np.ptp(within, axis=(1, 3))[rim].max() > 0.1 * whole.max()


def test_nothing_is_parted_without_such_a_lens(coarse, monkeypatch):
    """Other effects of a lens are made of whole pixels, as without any: no image in parts is asked for."""

    def refuse(*_, **__):
        raise AssertionError("an image in parts")

    monkeypatch.setattr(type(coarse.renderer), "_in_parts", refuse)
    others = {"camera.glare": 0.1, "camera.vignetting": 0.5}
    coarse.image(others)
    coarse.derivative("membrane.sigma", others)
    coarse.derivative("camera.glare", others)
    with pytest.raises(AssertionError, match="in parts"):
        coarse.image({"camera.blur": 0.5})


def test_effects_that_know_of_no_parts_change_pixels_as_ever(bench):
    """Veiling glare after a blur so small that it does nothing is that of the means of pixels, and so are stray light
    and vignetting: 1e-12 is rounding."""
    rng = np.random.default_rng(3)
    developer, (width, height) = bench.model.developer, bench.scene.camera.resolution
    parts = rng.uniform(0.1, 1, (SIDE * height, SIDE * width, 3))
    values = {**bench.values, "camera.glare": 0.2, "camera.vignetting": 0.6, "camera.stray": 0.01}
    own = {k: v for k, v in values.items() if k in bench.scene.parameters}
    expected = developer.develop(of_pixels(parts, SIDE), own)
    found = developer.develop(parts, {**own, "camera.blur": 1e-20})
    assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()


def test_an_image_that_varies_slowly_gets_finer():
    """A plane is met to rounding, but for the last pixels' outer parts as well; the mean of the parts is the image."""
    v, u = np.mgrid[:6, :9] + 0.5
    plane = (3 + 2 * u - v)[..., None]
    for side in (2, 4):
        fine_v, fine_u = (np.mgrid[: 6 * side, : 9 * side] + 0.5) / side
        assert finer_of(plane, side)[..., 0] == pytest.approx(3 + 2 * fine_u - fine_v, abs=1e-12)
    rough = np.random.default_rng(1).random((6, 9, 2))
    assert of_pixels(finer_of(rough, 4), 4) == pytest.approx(rough, abs=1e-12)
