"""A level gel: no light casts a shadow on it, so that other presses of a session need not bring its mesh back."""

import numpy as np
import pytest

from optics.light.renderer import Renderer
from optics.scene import loader

SMALL = {"width": "32", "height": "24"}
LIGHTS = ("led_1", "led_2")
WITH_AREA = {"led_1.area": 2.0, "led_2.area": 2.0}


@pytest.fixture(scope="module")
def scene(mitsuba):
    return loader.load("gelsight", SMALL)


@pytest.fixture(scope="module")
def values(scene):
    """Of a gel at rest that fills the view."""
    return {**scene.values(), "gel.width": 40.0, "gel.length": 40.0, "gel.press_depth": 0.0}


@pytest.mark.parametrize("area", ({}, WITH_AREA), ids=("points", "discs"))
@pytest.mark.parametrize("together", (False, True), ids=("apart", "together"))
def test_images_of_moved_lights_need_no_mesh(scene, values, monkeypatch, area, together):
    """The images and their derivatives are those with the mesh in its place, which stays away."""
    values = {**values, **area}
    moved = {**values, "led_1.x": values["led_1.x"] + 1.0}

    def made(renderer):
        renderer.together = set(LIGHTS) if together else set()
        found = [renderer.image(values, light) for light in LIGHTS]
        renderer.apply({**values, "gel.press_depth": 0.6})
        for light in LIGHTS:
            found.append(renderer.image(moved, light))
            found += [renderer.led_tangent(moved, light, f"{light}.{name}") for name in ("x", "mu")]
        return found, scene.gel.number("press_depth")

    quick, depth = made(Renderer(scene))
    assert depth == 0.6
    monkeypatch.setattr(Renderer, "_bare", lambda *_: False)
    whole, depth = made(Renderer(scene))
    assert depth == 0.0
    for a, b in zip(quick, whole, strict=True):
        assert np.allclose(a, b, rtol=1e-5, atol=1e-6 * np.abs(b).max())
    assert np.abs(quick[0] - quick[2]).max() > 1e-3 * quick[0].max()


@pytest.mark.parametrize("others", ({"gel.press_depth": 0.5}, {"gel.curve_xx": 2e-3}, {"gel.wedge_x": 1.0}), ids=str)
def test_a_gel_that_is_not_level_may_shade_itself(scene, values, others):
    assert set(others) <= set(scene.parameters)
    renderer = Renderer(scene)
    assert renderer.hits(values).bare
    assert not renderer.hits({**values, **others}).bare


def test_a_rim_in_view_takes_finer_samples(scene, values):
    assert not Renderer(scene).hits({**values, "gel.width": 4.0}).bare


def test_light_goes_through_the_gel_of_its_own_frame(scene, values):
    """Its thickness acts on light and shapes the mesh: where that stands for another frame, it is not that one's."""
    absorbing = {**values, "gel.absorption": 0.05, "gel.thickness": 4.0}
    moved = {**absorbing, "led_1.x": values["led_1.x"] + 1.0}
    renderer = Renderer(scene)
    renderer.image(absorbing, "led_1")
    renderer.image({**absorbing, "gel.thickness": 6.0}, "led_1")
    assert np.allclose(renderer.image(moved, "led_1"), Renderer(scene).image(moved, "led_1"), rtol=1e-5)


def test_what_a_window_sends_back_is_not_left_out(scene, values, monkeypatch):
    """Haze before a window, by the second of two ways."""
    hazy = {**values, "gel.haze": 0.03}
    quick = Renderer(scene).bounced(hazy, "led_1")
    monkeypatch.setattr(Renderer, "_bare", lambda *_: False)
    assert np.allclose(quick, Renderer(scene).bounced(hazy, "led_1"), rtol=1e-5, atol=1e-9)
