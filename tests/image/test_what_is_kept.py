"""What a renderer keeps: images to either side of a geometry without their rays, and what second directions meet, for
all lights."""

from pathlib import Path

import numpy as np
import pytest

from optics.captures.capture_set import Captures, Frame
from optics.captures.noise import Noise
from optics.fit.scene_model import SceneModel
from optics.light.renderer import Pixels, Renderer
from optics.scene import loader
from optics.scene.parameter import Values, Variable

SMALL = {"width": "32", "height": "24"}
LIGHTS = ("led_1", "led_2")


@pytest.fixture(scope="module")
def scene(mitsuba):
    return loader.load("gelsight", SMALL)


@pytest.fixture
def values(scene):
    return {**scene.values(), "gel.press_depth": 0.8}


def made(renderer, values):
    return [renderer.image(values, light) for light in LIGHTS]


@pytest.mark.parametrize("side", (1, 2))
def test_images_made_in_passing_are_the_same_and_push_nothing_out(scene, values, side):
    whole, passing = Renderer(scene), Renderer(scene)
    moved = {**values, "gel.press_x": 0.4}
    passing.together = set(LIGHTS)
    with whole.splitting(side), passing.splitting(side):
        before = passing.led(values, "led_1")
        held = list(passing._images)
        with passing.in_passing():
            beside = made(passing, moved)
        assert list(passing._images) == held and passing.led(values, "led_1") is before
        assert all(np.array_equal(a, b) for a, b in zip(beside, made(whole, moved)))
        # the other frames of a press ask for the same images: nothing is traced for them again
        geometry = passing.scene.gel.number("press_x")
        passing.apply(values)
        with passing.in_passing():
            again = made(passing, moved)
        assert all(a is b for a, b in zip(again, beside)) and passing.scene.gel.number("press_x") != geometry
    kept = {id(image.hits) for image in passing._images.values()}
    assert all(id(hits) in kept or not hits.rims for hits in passing._hits.values())


@pytest.mark.slow
def test_lights_share_what_second_directions_meet(scene, values, monkeypatch):
    """The same images as where each light has its rays traced, for one trace of second directions in place of two; and
    another where the gel or the seed is another."""
    shared, apart = Renderer(scene), Renderer(scene)
    integrator, traced = scene.integrator, []
    met = type(integrator).met_next
    monkeypatch.setattr(type(integrator), "met_next", lambda *a: traced.append(1) or met(*a))
    found = [shared.bounced(values, light) for light in LIGHTS]
    assert len(traced) == 1
    whole = type(integrator).bounced
    monkeypatch.setattr(type(integrator), "bounced", lambda self, *a: whole(self, *a[:8]))
    for light, image in zip(LIGHTS, found):
        wanted = apart.bounced(values, light)
        assert wanted.max() > 0 and np.allclose(image, wanted, rtol=1e-5, atol=1e-6 * wanted.max())
    monkeypatch.undo()
    monkeypatch.setattr(type(integrator), "met_next", lambda *a: traced.append(1) or met(*a))
    traced.clear()
    shared.bounced(values, "led_1", seed=1)
    shared.bounced({**values, "gel.press_depth": 0.5}, "led_1", seed=1)
    shared.bounced({**values, "led_1.x": values["led_1.x"] + 1}, "led_1", seed=1)
    assert len(traced) == 3  # the last goes back to the gel of the first
    apart.memory = 0.0
    assert np.allclose(apart.bounced(values, "led_1", seed=1), shared.bounced(values, "led_1", seed=1), rtol=1e-5)
    assert len(traced) == 3  # where there is no memory for them, each light traces its own


@pytest.mark.parametrize("cell", (1, 2))
def test_second_reflections_are_gathered_where_they_are_wanted(scene, values, cell, monkeypatch):
    """The same light at pixels that a fit uses, by fewer directions; elsewhere the same on average, as lens and glare
    scatter it over the image."""
    whole, part = Renderer(scene), Renderer(scene)
    whole.bounce = part.bounce = cell, 1024
    mask = np.zeros((whole.height, whole.width), bool)
    mask[3:9, 21:30] = True
    everywhere = whole.bounced(values, "led_1")
    part.wanted, followed = Pixels(mask), []
    spread = part._directions
    monkeypatch.setattr(part, "_directions", lambda *a: followed.append(spread(*a)) or followed[-1])
    some = part.bounced(values, "led_1")
    assert np.allclose(some[mask], everywhere[mask], rtol=1e-5, atol=1e-7 * everywhere.max())
    assert len(followed[0][0][0]) < 0.3 * whole._cells()[0] * whole._cells()[1] * 1024
    aside, known = some[~mask].mean(0), everywhere[~mask].mean(0)
    # noise of 64 directions a cell, few of which meet a lit flank: 4 % of the mean, over 12 sets of directions
    assert np.all(known > 0) and np.allclose(aside, known, rtol=0.15)
    left, right = (
        (image * ~mask[..., None])[:, :, 0].reshape(6, 4, 8, 4).sum((1, 3)).ravel() for image in (some, everywhere)
    )
    assert np.corrcoef(left, right)[0, 1] > 0.95  # each where it belongs: in blocks of 4 px
    # what is kept for some pixels does not serve others
    part.wanted = None
    assert np.allclose(part.bounced(values, "led_1"), everywhere, rtol=1e-5, atol=1e-7 * everywhere.max())


def test_large_images_push_out_no_more_than_they_take(scene, monkeypatch):
    """Images in parts of pixels are four times as large: what is kept is counted in bytes, the oldest go first."""
    from optics.light import renderer as own

    renderer = Renderer(scene)
    small, large = np.zeros(100, np.float32), np.zeros(400, np.float32)
    monkeypatch.setattr(own, "IMAGES", 100 * small.nbytes)
    for n in range(90):
        renderer._keep_plain((n,), small)
    renderer._keep_plain(("large",), large)
    assert len(renderer._plain) == 91
    for n in range(4):
        renderer._keep_plain(("large", n), large)
    assert (9,) not in renderer._plain and (10,) in renderer._plain
    renderer._keep_plain(("large", 0), large)  # made again: it takes no more
    assert (10,) in renderer._plain and sum(i.nbytes for i in renderer._plain.values()) == renderer._plain_bytes


@pytest.mark.parametrize("share", (0.0, 0.5))
def test_a_second_seed_renders_only_what_depends_on_it(scene, share):
    """The image of light reflected twice; and where there is such light, all images that it is a part of."""
    shape = (int(SMALL["height"]), int(SMALL["width"]), 3)
    frame = Frame("press", np.zeros(shape, np.float32), parameters={"gel.press_depth": 0.8})
    model = SceneModel(scene, Captures(Path("."), str(scene.path), [frame], noise=Noise(0.1, 1.0, 0.0, 255.0, 0.0)))
    second = model.renderer.bounce_key
    keys = ("led_1.x", "led_1.mu", "gel.press_x", "camera.gain", second)
    variables = [Variable(key, (key,), model.parameters[key]) for key in keys]
    found = [next(iter(model.derivatives(Values({second: share}), variables, seed=s)))[1] for s in (0, 1)]
    same = {k for k in keys if np.shares_memory(found[0][k], found[1][k])}
    assert same == (set() if share else set(keys) - {second})
    assert not any(np.array_equal(found[0][k], found[1][k]) for k in set(keys) - same)


def test_presses_share_the_gel_at_rest_whatever_they_are_like(scene):
    shape = (int(SMALL["height"]), int(SMALL["width"]), 3)
    frame = Frame("press", np.zeros(shape, np.float32), parameters={"gel.press_depth": 0.8})
    model = SceneModel(scene, Captures(Path("."), str(scene.path), [frame], noise=Noise(0.1, 1.0, 0.0, 255.0, 0.0)))
    plain, other = (
        model.untouched(model.at(Values(more), 0)) for more in ({}, {"gel.skirt": 0.5, "gel.indenter_size": 3.0})
    )
    curved = model.untouched(model.at(Values({"gel.curve_xx": 2e-3}), 0))
    assert model.renderer.geometry(plain) == model.renderer.geometry(other) != model.renderer.geometry(curved)


def test_what_shows_under_a_press_alone_leaves_the_gel_at_rest(scene):
    """Declared of parameters (`when_pressed`), and true: the image at rest is the same to the bit, that of a press
    another, but for what only plates of balls show."""
    shape = (int(SMALL["height"]), int(SMALL["width"]), 3)
    frame = Frame("press", np.zeros(shape, np.float32), parameters={"gel.press_depth": 0.8, "gel.stretch": 0.04})
    model = SceneModel(scene, Captures(Path("."), str(scene.path), [frame], noise=Noise(0.1, 1.0, 0.0, 255.0, 0.0)))
    now = model.at(Values(), 0)
    plain = model.untouched(now)
    at_rest, pressed = model.renderer.radiance(plain), model.renderer.radiance(now)
    keys = [key for key, p in scene.parameters.items() if p.when_pressed]
    assert {"gel.shown_through", "gel.stretch_gain", "gel.uneven_xy"} <= set(keys)
    for key in keys:
        value = 5 * scene.parameters[key].plausible
        assert model.untouched(model.at(Values({key: value}), 0)) == plain
        assert np.array_equal(model.renderer.radiance({**plain, key: value}), at_rest), key
        changed = np.abs(model.renderer.radiance({**now, key: value}) - pressed).max() / pressed.max()
        assert (changed < 1e-7) == (key == "gel.shown_between"), (key, changed)  # the rest is rounding
