"""A measured background enters a prediction by name, and every derivative follows it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from optics.captures.capture_set import Captures, Frame
from optics.captures.noise import Noise
from optics.errors import UnknownKey
from optics.scene.parameter import Values, Variable

WIDTH, HEIGHT = 48, 36  # px
PRESSED = {"gel.press_x": 1.0, "gel.press_y": -0.5, "gel.press_depth": 0.4}
KEYS = {
    "camera.gain": 1.03,
    "camera.gain_g": 0.98,
    "led_1.power": 1.2,
    "led_1.power_b": 0.7,
    "led_2.mu": 1.6,
    "membrane.ground_g": 2e-3,
    "gel.height_loss": 0.2,
    "gel.skirt": 0.4,
    "gel.press_depth": 0.4,
    "gel.shown_through": 0.1,  # of the contact: at rest there is none, also where the mesh is still pressed
}


@pytest.fixture(scope="module")
def models(mitsuba):
    from optics.fit.scene_model import SceneModel
    from optics.scene import loader as scene

    loaded = scene.load("gelsight", {"width": WIDTH, "height": HEIGHT})
    frame = Frame("press", np.zeros((HEIGHT, WIDTH, 3), np.float32), parameters=dict(PRESSED))
    flat = (80 + np.arange(WIDTH)[None, :, None] * np.array([1.0, 0.5, 0.2]) + np.zeros((HEIGHT, 1, 1))).astype(
        np.float32
    )
    captures = Captures(Path("."), str(loaded.path), [frame], noise=Noise(0.1, 1.0, 2.0, 255.0, 0.0), flat_field=flat)
    return {mode: SceneModel(loaded, captures, flat_field=mode) for mode in ("multiplicative", "additive", None)}


def test_modes_are_named_and_others_refused(models):
    from optics.fit.scene_model import SceneModel

    model = models["additive"]
    assert SceneModel(model.scene, model.captures).flat_field == "multiplicative" and models[None].flat is None
    with pytest.raises(UnknownKey, match="did you mean 'additive'"):
        SceneModel(model.scene, model.captures, flat_field="aditive")


@pytest.mark.parametrize("mode", ["multiplicative", "additive"])
def test_the_untouched_sensor_is_the_background_times_its_gain(models, mode):
    model = models[mode]
    values = Values(frame={0: {"gel.press_depth": 0.0, "camera.gain": 1.1, "camera.gain_b": 0.9}})
    expected = 2 + (model.captures.flat_field - 2) * 1.1 * np.array([1, 1, 0.9])
    # both sides come from the same image; rims of the gel are the same as well
    assert np.abs(model.predict(values)[0] - expected).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["multiplicative", "additive"])
@pytest.mark.parametrize("key", KEYS)
def test_derivatives_agree_with_differences(models, mode, key):
    model = models[mode]
    values = Values(frame={0: dict(KEYS)})
    variable = Variable(key, (key,), model.parameters[key], (0,))
    prediction, images = next(iter(model.derivatives(values, [variable], [0])))
    assert np.abs(prediction - model.predict(values)[0]).max() < 1e-4
    p = model.parameters[key]
    step = (p.step if p.how == "difference" else 0.3) * p.plausible
    sides = []
    for sign in (1, -1):
        moved = values.copy()
        moved.put(variable, KEYS[key] + sign * step)
        sides.append(model.predict(moved)[0])
    expected = (sides[0] - sides[1]) / (2 * step)
    # steps wide enough for float32 images; the same steps for what is a difference itself
    assert np.linalg.norm(images[key] - expected) < 0.01 * np.linalg.norm(expected)


def test_the_share_of_the_background_that_the_scene_explains(models):
    share = models["additive"].background_share()
    assert len(share) == 3 and all(s["share"] <= 1 and s["structure"] > 0 for s in share)


def test_a_power_per_band_scales_that_band_alone(models):
    model = models[None]
    dim = model.predict(Values(common={f"led_{k}.power_g": 0.5 for k in range(1, 7)}))[0] - 2
    full = model.predict(Values())[0] - 2
    assert dim[..., 1] == pytest.approx(full[..., 1] / 2, rel=1e-6) and np.array_equal(
        dim[..., [0, 2]], full[..., [0, 2]]
    )


def test_the_gel_acts_on_light_from_all_sides_too(models):
    """A coat that lets the object through is brighter where it is touched, whatever lights it; and gel that absorbs
    takes its share of light that no LED made, by Beer-Lambert over the way to the camera."""
    model = models[None]
    dark = {**dict.fromkeys(model.scene.powers.values(), 0.0), "membrane.ambient": 1e-3, **PRESSED}
    now = {**model.base, **dark}
    plain = model.renderer.radiance(now)
    ratio = model.renderer.radiance({**now, "gel.shown_through": 0.2}) / plain
    touched = model.coordinates(Values(frame={0: dark}), 0)["contact"] > 0
    far = np.hypot(*np.mgrid[-HEIGHT / 2 : HEIGHT / 2, -WIDTH / 2 : WIDTH / 2]) > 20  # px
    assert touched.sum() > 5
    np.testing.assert_allclose(np.median(ratio[touched]), 1.2, rtol=1e-5)
    np.testing.assert_allclose(ratio[far & ~touched], 1.0, rtol=1e-5)
    fading = model.renderer.radiance({**now, "gel.absorption": 0.05}) / plain
    middle = fading[HEIGHT // 2, WIDTH // 2]
    np.testing.assert_allclose(middle, np.exp(-0.05 * now["gel.thickness"]), rtol=0.03)  # at a slant, and pressed


@pytest.mark.parametrize("mode", ["multiplicative", "additive"])
def test_noise_of_a_background_is_no_texture_of_the_scene(models, mode):
    """A background with 2 DN of noise, times a gain of 1.1. Of the untouched sensor the laplacian (weights 1, 1, 1, 1,
    -4) is 2.2 sqrt(20) = 9.8 DN of noise, and a hundredth of that where the background is smoothed. The laplacian of
    the dent, which the scene makes, stays: what is left of the noise adds 1 %."""
    from scipy.ndimage import laplace

    from optics.diagnosis.fingerprints import without_grain
    from optics.fit.scene_model import SceneModel
    from optics.scene.loader import load

    def opened(flat):  # each its own scene: what one model sets in a scene, another does not know
        own = load("gelsight", {"width": WIDTH, "height": HEIGHT})
        return SceneModel(own, replace(models[mode].captures, flat_field=flat.astype(np.float32)), flat_field=mode)

    flat = models[mode].captures.flat_field
    model, grainy = opened(flat), opened(flat + 2 * np.random.default_rng(1).standard_normal(flat.shape))
    for depth, low, high in ((0.0, 0.0, 0.2), (0.4, 0.95, 1.05)):
        values = Values(frame={0: {"gel.press_depth": depth, "camera.gain": 1.1}})
        (prediction,) = (np.asarray(image, float) for image in grainy.predict(values))
        smooth = without_grain(grainy, values, 0, prediction)
        edges = [laplace(image[..., 0])[3:-3, 3:-3] for image in (prediction, smooth)]
        clean = laplace(np.asarray(model.predict(values)[0], float)[..., 0])[3:-3, 3:-3]
        if depth:
            assert low < edges[1].std() / clean.std() < high
        else:
            assert edges[0].std() > 7 and edges[1].std() < high
    assert without_grain(models[None], values, 0, prediction) is prediction
