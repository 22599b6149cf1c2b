"""Derivatives of one light that are made together are those that are made one by one."""

import numpy as np
import pytest

from optics.light.renderer import Renderer
from optics.scene import loader

SMALL = {"width": "32", "height": "24"}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gelsight", "digit", "gelsight_bench", "vi2tap", "particle_gel"])
def test_together_as_one_by_one(mitsuba, name):
    """Every parameter of a light and of its board, away from where effects vanish: beside other effects too."""
    scene = loader.load(name, SMALL if name != "particle_gel" else {**SMALL, "beads": "20"})
    values = {**scene.values()}
    renderer = Renderer(scene)
    led = next(iter(scene.leds))
    keys = [k for k in renderer.led_keys[led] if scene.parameters[k].how == "ad"]
    assert len(keys) > 4
    for key in keys:
        p = scene.parameters[key]
        if p.neutral is not None and values[key] == p.neutral:
            values[key] = float(np.clip(p.neutral + 0.3 * p.plausible, *p.bounds))
    apart = {key: renderer.led_tangent(values, led, key) for key in keys}
    assert not renderer._slopes
    with renderer.asking(keys):
        together = {key: renderer.led_tangent(values, led, key) for key in reversed(keys)}
        ((_, made),) = renderer._slopes.values()
        assert len(made) == len(keys)
    assert not renderer._slopes
    for key in keys:
        largest = np.abs(apart[key]).max()
        # single precision, summed in another order
        assert np.allclose(together[key], apart[key], rtol=1e-4, atol=2e-5 * max(largest, 1e-12)), key
