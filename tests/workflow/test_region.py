"""Where the shape is known: what counts as contact, that a fit of it sees nothing else, and that its fit says so."""

import numpy as np
import pytest

from optics.captures.capture_set import Captures, Frame
from optics.captures.noise import Noise
from optics.errors import BadScene, UnknownKey
from optics.fit.known_shape import APART, FAR, INNER
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


def test_what_is_known_of_a_plate_of_balls(bench_scene):
    """INNER radii around each whole ball, and the middles of four balls, APART from each."""
    shifted = {"gel.press_x": 0.3, "gel.press_y": -0.2}
    model = model_of(bench_scene, [shifted], "known")
    own, all_of_it = model.usable(0)[..., 0], model.usable_in(0, "all")
    assert all_of_it.all() and not own.all()
    x, y = np.moveaxis(model.renderer.hits(model.untouched(model.at(Values(), 0))).position[..., :2], -1, 0)
    nearest = np.hypot((x - 0.3) - np.round(x - 0.3), (y + 0.2) - np.round(y + 0.2))
    inside, between = nearest < INNER * 0.2465, nearest > APART
    assert not (own & ~inside & ~between).any() and own[between].all()
    whole = (np.abs(x) < 3.0) & (np.abs(y) < 2.5)  # cells whose balls are whole in view
    assert (own == (inside | between))[whole].all()
    normal = model.renderer.hits(model.at(Values(), 0)).normal[between]
    assert normal[:, 2] == pytest.approx(-1, abs=1e-4)  # level, to a degree


def test_an_untouched_frame_is_known_everywhere(bench_scene):
    model = model_of(bench_scene, [{"gel.press_depth": 0.0}, {"gel.press_depth": 0.2}], "known")
    assert model.usable(0).all()
    assert not model.usable(1).all()


def test_what_is_known_of_one_indenter(mitsuba):
    """Where it touches, and the face two contact radii from there."""
    scene = loader.load("gelsight", {"width": "60", "height": "45"})
    height, width = scene.camera.resolution[::-1]
    image = np.full((height, width, len(scene.integrator.bands)), 100.0, np.float32)
    noise = Noise(system_gain=1.0, dark_noise=1.0, black_level=0.0, saturation=255.0, prnu=0.0)
    frame = Frame("f", image, None, "p", {"gel.press_depth": 0.4})
    model = SceneModel(scene, Captures(scene.path.parent, "scene", [frame], noise=noise), noise, region="known")
    own, known = model.usable(0)[..., 0], model.coordinates(Values(), 0)
    radius = np.sqrt(known["contact"].sum() / np.pi)
    wanted = known["contact"] | (known["contact_distance"] > FAR * radius)
    assert (own == wanted)[model.usable_in(0, "all")[..., 0]].all()
    assert own[known["contact"]].any() and own[~known["contact"]].any() and not own.all()


def test_bad_regions(bench_scene, mitsuba):
    with pytest.raises(UnknownKey, match="known"):
        model_of(bench_scene, [{}], "knwon")
    bench = loader.load("polarizer_bench")
    with pytest.raises(BadScene, match="no gel that something presses; allowed: all"):
        model_of(bench, [{}], "known")
