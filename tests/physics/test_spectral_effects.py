"""Which spectral effects are tied to what every calibration frees, and what tells them apart."""

import re

import numpy as np
import pytest

from optics.files.output import shipped
from optics.light.rendering import RenderJob
from optics.scene import loader

DIGIT = {"width": "24", "height": "32", "depth": "0.6", "bands": "auto"}
RHO = [[f"membrane.rho_{c}"] for c in "rgb"]


def left(scene, keys, step, others):
    """Share of an effect's image that a combination of the images of other parameters does not make."""
    job, base = RenderJob(scene), scene.values()

    def change(keys, step):
        one, none = (job.take({k: base[k] + s * step for k in keys}).camera for s in (1, 0))
        return ((one - none) / step).ravel()

    effect, images = change(keys, step), np.stack([change(own, 0.01) for own in others], -1)
    made = images @ np.linalg.lstsq(images, effect, rcond=1e-10)[0]
    return np.linalg.norm(effect - made) / np.linalg.norm(effect)


@pytest.fixture(scope="module")
def digit(mitsuba):
    return loader.load("digit", DIGIT)


def powers(scene):
    return [[f"{led}.power"] for led in scene.leds]


def test_a_metameric_paint_is_tied_to_powers_and_rho(digit):
    """With one light in each band it is a gain of that light. A step of 0.05 bends by 1e-4; the flanks of a green LED
    of 47 nm change by 3 % more than its peak, which no power takes up: a thousandth of the change is in them."""
    assert left(digit, ["membrane.metamerism"], 0.05, powers(digit) + RHO) < 5e-3


def test_a_second_light_of_known_power_tells_a_metameric_paint(mitsuba, digit, tmp_path):
    """A cyan LED of 510 nm beside the green one of 530 nm: one reflectance does not serve both."""
    text = (shipped("scenes") / "digit.xml").read_text(encoding="utf-8")
    cyan = re.search(r'<emitter type="led" id="led_green">.*?</emitter>', text, re.S)[0]
    for old, new in (("led_green", "led_cyan"), ('value="530"', 'value="510"'), ('x="14" y="-1"', 'x="0" y="-17"')):
        assert old in cyan
        cyan = cyan.replace(old, new)
    file = tmp_path / "two.xml"
    file.write_text(text.replace("</scene>", cyan + "</scene>"), encoding="utf-8")
    two = loader.load(file, DIGIT)
    one, both = (left(scene, ["membrane.metamerism"], 0.05, RHO) for scene in (digit, two))
    assert both > 0.1 and both > 2 * one, (one, both)


@pytest.mark.parametrize(
    ("keys", "step"),
    [
        (["led_red.centre_shift", "led_green.centre_shift", "led_blue.centre_shift"], 0.1),
        (["gel.yellowing"], 1e-3),
        (["camera.lateral_colour"], 1e-3),
        (["camera.chromatic_blur"], 0.5),
    ],
)
def test_other_effects_leave_more_than_powers_and_rho_take_up(digit, keys, step):
    """A twentieth of their image and more: of a change of 2 % that is 0.1 %, which a few presses show."""
    assert left(digit, keys, step, powers(digit) + RHO) > 0.05
