"""Where the shape is known: what counts as contact, that a fit of it sees nothing else, and that its fit says so."""

import numpy as np
import pytest

from optics.captures.capture_set import Captures, Frame
from optics.captures.noise import Noise
from optics.errors import BadScene, UnknownKey
from optics.fit.contact import INNER
from optics.fit.scene_model import SceneModel
from optics.scene import loader
from optics.scene.parameter import Values


def model_of(scene, settings, region):
    height, width = scene.camera.resolution[::-1]
    image = np.full((height, width, 1), 100.0, np.float32)
    frames = [Frame(f"f{k}", image, None, f"p{k}", dict(own)) for k, own in enumerate(settings)]
    noise = Noise(system_gain=1.0, dark_noise=1.0, black_level=0.0, saturation=255.0, prnu=0.0)
    return SceneModel(scene, Captures(scene.path.parent, "scene", frames, noise=noise), noise, region=region)


@pytest.fixture(scope="module")
def bench_scene(mitsuba):
    return loader.load("gelsight_bench", {"width": "102", "height": "85"})


def test_the_contact_of_a_plate_of_balls(bench_scene):
    """INNER radii around each whole ball: its share of the image is that of the circles in the plate's cells."""
    shifted = {"gel.press_x": 0.3, "gel.press_y": -0.2}
    model = model_of(bench_scene, [shifted], "contact")
    own, all_of_it = model.usable(0), model.usable(0, "all")
    assert all_of_it.all() and not own.all()
    x, y = np.moveaxis(model.renderer.hits(model.untouched(model.at(Values(), 0))).position[..., :2], -1, 0)
    nearest = np.hypot((x - 0.3) - np.round(x - 0.3), (y + 0.2) - np.round(y + 0.2))
    inside = nearest < INNER * 0.2465
    assert not (own[..., 0] & ~inside).any()
    whole = (np.abs(x) < 3.0) & (np.abs(y) < 2.5)  # cells whose balls are whole in view
    assert (own[..., 0] == inside)[whole].all()


def test_an_untouched_frame_is_known_everywhere(bench_scene):
    model = model_of(bench_scene, [{"gel.press_depth": 0.0}, {"gel.press_depth": 0.2}], "contact")
    assert model.usable(0).all()
    assert not model.usable(1).all()


def test_the_contact_of_one_indenter_is_where_it_touches(mitsuba):
    scene = loader.load("gelsight", {"width": "60", "height": "45"})
    height, width = scene.camera.resolution[::-1]
    image = np.full((height, width, len(scene.integrator.bands)), 100.0, np.float32)
    noise = Noise(system_gain=1.0, dark_noise=1.0, black_level=0.0, saturation=255.0, prnu=0.0)
    frame = Frame("f", image, None, "p", {"gel.press_depth": 0.8})
    model = SceneModel(scene, Captures(scene.path.parent, "scene", [frame], noise=noise), noise, region="contact")
    assert (model.usable(0)[..., 0] == model.coordinates(Values(), 0)["contact"])[model.usable(0, "all")[..., 0]].all()
    assert 0 < model.usable(0).mean() < 0.5


def test_bad_regions(bench_scene, mitsuba):
    with pytest.raises(UnknownKey, match="contact"):
        model_of(bench_scene, [{}], "contcat")
    bench = loader.load("polarizer_bench")
    with pytest.raises(BadScene, match="no gel that something presses; allowed: all"):
        model_of(bench, [{}], "contact")
