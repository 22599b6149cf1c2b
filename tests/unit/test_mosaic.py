"""A raw mosaic through the model: each pixel is predicted, used and differentiated in its own channel."""

from pathlib import Path

import numpy as np
import pytest

from optics.captures.capture_set import Captures, Frame, cfa_channel
from optics.captures.noise import Noise
from optics.fit.scene_model import SceneModel
from optics.scene import loader as scene
from optics.scene.parameter import Values, Variable

PATTERN = "GBRG"


@pytest.fixture(scope="module")
def models(mitsuba):
    sensor = scene.load("gelsight", {"width": "24", "height": "20"})
    settings = {"camera.exposure": 20.0, "gel.press_depth": 0.5}
    dark = Frame("a", np.zeros((20, 24, 3), np.float32), parameters=settings)
    noise = Noise(0.04, 0.8, 8.0, 255.0, 0.0)
    full = SceneModel(sensor, Captures(Path("."), "gelsight", [dark], noise=noise))
    rng = np.random.default_rng(3)
    image = noise.expose(full.predict(Values())[0], rng).astype(np.float32)
    channel = cfa_channel(image.shape, PATTERN)[..., None]
    raw = Frame("a", np.take_along_axis(image, channel, 2), parameters=settings)
    return full, SceneModel(sensor, Captures(Path("."), "gelsight", [raw], noise=noise, cfa=PATTERN)), channel


def test_every_pixel_counts_once_in_the_channel_of_its_filter(models):
    full, mosaic, channel = models
    use = mosaic.usable(0)
    assert (
        use.shape == (20, 24, 3)
        and mosaic.size == 480
        and full.size == 1440
        and np.array_equal(use.sum(-1), np.ones((20, 24)))
    )
    assert np.array_equal(use.argmax(-1), channel[..., 0]) and channel[0, 0, 0] == 1 and channel[1, 0, 0] == 0


def test_the_prediction_is_that_of_the_colour_camera_at_the_filters(models):
    full, mosaic, channel = models
    one, other = full.predict(Values())[0], mosaic.predict(Values())[0]
    np.testing.assert_array_equal(one, other)
    residual = (mosaic.frames[0].image - other)[mosaic.usable(0)] / mosaic.noise.sd(other)[mosaic.usable(0)]
    assert abs(residual.std() - 1) < 0.15  # 480 values: their sd scatters by 0.03, saturated pixels aside


def test_a_fit_finds_the_reflectance_of_each_channel(models):
    from optics.fit import calibrate

    _, mosaic, _ = models
    free = [
        Variable(f"membrane.rho_{c}", (f"membrane.rho_{c}",), mosaic.parameters[f"membrane.rho_{c}"]) for c in "rgb"
    ]
    truth = mosaic.scene.values()
    found = calibrate.fit(mosaic, free, Values({v.name: 1.4 * truth[v.name] for v in free}))
    pulls = (found.estimate - [truth[v.name] for v in free]) / found.sd
    assert found.converged and np.abs(pulls).max() < 4 and 300 < found.dof < 480
