"""Which spectral effects are tied to what every calibration frees, and what tells them apart."""

import re

import numpy as np
import pytest

from optics.files.output import shipped
from optics.light.rendering import RenderJob
from optics.proof.makers import colour as makers
from optics.proof.rigs.colour import DigitColour, WildColour
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
    images = images / np.linalg.norm(images, axis=0)
    # 1e-4: powers and reflectances have a common factor, along which images of single precision leave 1e-6 of noise
    made = images @ np.linalg.lstsq(images, effect, rcond=1e-4)[0]
    return np.linalg.norm(effect - made) / np.linalg.norm(effect)


@pytest.fixture(scope="module")
def digit(mitsuba):
    return loader.load("digit", DIGIT)


def powers(scene):
    return [[f"{led}.power"] for led in scene.leds]


def greys_of(scene, seen):
    """{LED: (H, W) image of it alone over what each channel sees of its light}, which is alike in all channels."""
    job, values = RenderJob(scene), scene.values()
    off = {f"{led}.power": 0.0 for led in scene.leds}
    dark, found = job.take({**values, **off}).camera, {}
    for led in scene.leds:
        image = job.take({**values, **off, f"{led}.power": values[f"{led}.power"]}).camera - dark
        found[led] = (image / seen[led].sum(1)).mean(-1)
    job.take(values)  # a scene keeps the values that it was rendered with last
    return found


@pytest.mark.slow
def test_what_powers_and_rho_leave_of_a_metameric_paint(mitsuba):
    """With one light in each range it is all but a gain of that light; the flanks of lines 17 to 47 nm wide, which
    reach into other ranges and channels, leave 8.4 % of its image. That share by sums in steps of 1 nm, of lines as
    formulas: the nodes follow it to 2 %, as there are two for a line (of a single one all but .3 % was taken up)."""
    digit = loader.load("digit", {**DigitColour.defines, **DIGIT})  # Gaussians, as the maker's
    camera = makers.sensitivities("Nikon 5100 (NPL)")
    seen = {led: camera * makers.spectrum(lamp, {}) for led, lamp in WildColour.lamps.items()}
    nm, ranges, grey = makers.NM, [], greys_of(digit, seen)
    slope = np.zeros(len(nm))
    for (low, high), middle in zip(makers.RANGES, makers.MIDDLES):
        ranges.append(((nm >= low) & (nm < high)) / 2 + ((nm > low) & (nm <= high)) / 2)
        slope += ranges[-1] * (nm - middle) / 100

    def image(weights):
        """What {LED: (N,)} leaves of their light, as (H W C,)."""
        return sum(grey[led][..., None] * (seen[led] @ own) for led, own in weights.items()).ravel()

    alone = [image({led: np.ones(len(nm))}) for led in seen]
    images = np.stack(alone + [image(dict.fromkeys(seen, own)) for own in ranges], -1)
    effect = image(dict.fromkeys(seen, slope))
    rest = effect - images @ np.linalg.lstsq(images, effect, rcond=1e-10)[0]
    expected = np.linalg.norm(rest) / np.linalg.norm(effect)
    found = left(digit, ["membrane.metamerism"], 1e-3, powers(digit) + RHO)
    assert 0.08 < expected < 0.09 and found == pytest.approx(expected, rel=0.02)


def test_a_second_light_of_known_power_tells_a_metameric_paint(mitsuba, digit, tmp_path):
    """An LED of 560 nm beside the green one of 530 nm, of known powers: one reflectance does not serve both. Of the
    paint's image rho then leaves half; with three LEDs of known powers it leaves a sixth, on their flanks."""
    text = (shipped("scenes") / "digit.xml").read_text(encoding="utf-8")
    yellow = re.search(r'<emitter type="led" id="led_green">.*?</emitter>', text, re.S)[0]
    for old, new in (("led_green", "led_yellow"), ('value="530"', 'value="560"'), ('x="14" y="-1"', 'x="0" y="-17"')):
        assert old in yellow
        yellow = yellow.replace(old, new)
    file = tmp_path / "two.xml"
    file.write_text(text.replace("</scene>", yellow + "</scene>"), encoding="utf-8")
    two = loader.load(file, DIGIT)
    one, both = (left(scene, ["membrane.metamerism"], 1e-3, RHO) for scene in (digit, two))
    assert both > 0.4 and both > 2 * one, (one, both)


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
