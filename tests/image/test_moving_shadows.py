"""Derivatives by the place of a point light at the rims of its shadows."""

import numpy as np
import pytest

from optics.light.renderer import Renderer
from optics.scene import loader

FINE = 4096  # samples of a rim's pixel, for what the images are held against


def pressed(name, defines):
    scene = loader.load(name, defines)
    gel = scene.gel.name
    values = {**scene.values(), f"{gel}.press_depth": 0.8, f"{gel}.press_x": 0.6, f"{gel}.press_y": -0.4}
    return scene, values | dict.fromkeys(scene.powers.values(), 1.0)


def differences(scene, values, led, step):
    """(derivatives (3, ...) by the place of an LED, by differences of images with FINE samples, pixels at rims)."""
    fine = Renderer(scene)
    fine.rim_samples = FINE
    sides = [[fine.led({**values, f"{led}.{n}": values[f"{led}.{n}"] + s * step}, led) for s in (1, -1)] for n in "xyz"]
    rims = np.logical_and.reduce([image.rim for pair in sides for image in pair])
    return np.stack([(a.radiance - b.radiance) / (2 * step) for a, b in sides]), rims


@pytest.mark.parametrize("name", ["digit", pytest.param("gelsight", marks=pytest.mark.slow)])
def test_a_shadow_stays_where_the_light_moves_along_its_beam(mitsuba, name):
    """Each pixel's three derivatives are off by what the samples of its edge round to, and agree in that none of it
    lies along the beam: there, they are exact as far as the beam of the pixel is that of the dent."""
    scene, values = pressed(name, {"width": "48", "height": "36"})
    renderer, tried = Renderer(scene), 0
    for led in list(scene.leds)[:3]:
        truth, rims = differences(scene, values, led, 0.1)
        rims &= renderer.led(values, led).rim
        found = np.stack([renderer.led_tangent(values, led, f"{led}.{n}") for n in "xyz"])
        place = scene.places_of(values, [led])[led]
        beam = place - [values[f"{scene.gel.name}.press_x"], values[f"{scene.gel.name}.press_y"], 0.0]
        beam /= np.linalg.norm(beam)
        largest = np.sqrt((truth[:, rims] ** 2).sum(0).mean())
        if rims.sum() < 20:
            continue
        tried += 1
        error = found[:, rims] - truth[:, rims]
        assert np.sqrt((error**2).sum(0).mean()) < 0.1 * largest
        assert np.sqrt((np.tensordot(beam, error, 1) ** 2).mean()) < 0.015 * largest  # 0.07 by differences in x, y, z
    assert tried
