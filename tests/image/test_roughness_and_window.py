"""Derivatives by a roughness beside light that the window returns: a surface is then asked twice what it reflects."""

import numpy as np

from optics.light.renderer import Renderer
from optics.scene import loader


def test_roughness_has_a_derivative_beside_light_returned_by_the_window(mitsuba):
    scene = loader.load("gelsight_bench", {"width": "24", "height": "18"})
    renderer = Renderer(scene)
    led = next(iter(scene.leds))
    values = {**scene.values(), "gel.returned": 0.3, "membrane.sigma": 0.3, "gel.press_depth": 0.4}
    with renderer.asking(["membrane.sigma", f"{led}.x"]):
        tangent = renderer.led_tangent(values, led, "membrane.sigma")
    step = 1e-3
    above, below = (renderer.image({**values, "membrane.sigma": 0.3 + s}, led) for s in (step, -step))
    expected = (above - below) / (2 * step)
    assert np.abs(expected).max() > 0
    # float32 images over 2e-3, and the third derivative times 1e-6
    np.testing.assert_allclose(tangent, expected, atol=2e-3 * np.abs(expected).max())
