"""A calibration of a model that lacks much stays near what is known, until what it lacks is found."""

import numpy as np
import pytest

from optics import facade
from optics.captures import capture_set
from optics.proof import demo
from optics.proof.makers import touch
from optics.scene import loader
from optics.study import stages

AMBIENT = 2e-3  # twenty times what the demonstration hides: half of an LED's light
KNOWN = {"gel.smoothing": (None, 0.02)}  # mm


@pytest.fixture(scope="module")
def captures(mitsuba, tmp_path_factory):
    """Two presses under two LEDs each, by stock Mitsuba, with light from all sides that no LED sends."""
    folder = tmp_path_factory.mktemp("astray") / "captures"
    scene = loader.load("gelsight", {"width": "60", "height": "45"})
    built = {**demo.truth(scene, 4), "camera.exposure": 100.0}
    maker = touch.Maker(scene, built, {"ambient light": AMBIENT}, demo.CAMERA, 7, spp=32, frames=demo.FRAMES)
    drives = [{led: 1.0} for led in list(scene.leds)[:2]]
    shot = maker.captures(touch.presses(2, 4), drives, scene_name="gelsight")
    shot.parameters["camera.exposure"] = built["camera.exposure"]
    capture_set.write(shot, folder, bits=16)
    return folder, built


@pytest.mark.slow
def test_shapes_do_not_make_up_for_light(captures, tmp_path, monkeypatch):
    folder, built = captures
    free = ["led_1.power", "led_2.power", "gel.smoothing"]

    def study(name):
        return facade.calibrate(folder, tmp_path / name, free=free, values=built, priors=KNOWN, held_out=[])

    def off(fit):
        return abs(fit.values.common["gel.smoothing"] - 0.25) / KNOWN["gel.smoothing"][1]

    with monkeypatch.context() as patch:
        patch.setattr(stages, "temperature", lambda *_: 1.0)
        assert off(study("astray").fit) > 5  # sold for a part of what is missing: 8.9 standard deviations
    held = study("held")
    assert off(held.fit) < 1 and held.fit.tempering > 1e3
    # one standard deviation of noise is a hundredth of a micrometre: errors count the misfit
    assert held.fit.error[2] > 0.5 * KNOWN["gel.smoothing"][1] > 100 * held.fit.sd[2]
    assert any("Priors count" in warning for warning in held.fit.warnings)

    held.add("ambient light")
    assert held.fit.values.common["membrane.ambient"] == pytest.approx(AMBIENT, rel=0.01)
    assert held.fit.chi2_per_dof < 1.5 and held.fit.tempering < 10  # rims, by 32 samples
    again = facade.Study.open(tmp_path / "held")  # with the same weights
    assert again.fit.tempering == pytest.approx(held.fit.tempering)
    np.testing.assert_allclose(again.fit.estimate, held.fit.estimate, rtol=1e-3, atol=1e-4)
