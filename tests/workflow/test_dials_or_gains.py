"""Photographs behind a film that is turned by hand, whose errors nobody states: an error of each, or a gain of each?"""

import numpy as np
import pytest
from PIL import Image

from optics.study import loop

HEIGHT, WIDTH = 10, 12
DIAL = np.arange(0.0, 180.0, 9.0)
BLACK, TOP, GAIN = 8.0, 255.0, 0.05  # DN, DN, DN per electron

HEAD = """
scene = "polarizer_bench"
bands = [600, 535, 465]
absent = ["sample"]
[noise]
system_gain = 0.05
dark_noise = 0.5
black_level = 8
saturation = 255
prnu = 0.0
[parameters]
"middle.inserted" = 0
"polarizer.angle" = 0
"""


def photographs(path, rng, gains=1.0, errors=0.0, gamma=1.0, stated=None):
    """PNG files of even light behind two films, Malus' law with a response curve, Poisson noise."""
    (path / "frames").mkdir(parents=True)
    light = 0.5 * np.cos(np.radians(DIAL + errors)) ** 2
    text = HEAD + (f'[uncertainty]\n"analyzer.angle" = {stated}\n' if stated else "")
    for index, mean in enumerate((TOP - BLACK) * np.broadcast_to(gains, DIAL.shape) * light**gamma):
        electrons = rng.poisson(mean / GAIN, (HEIGHT, WIDTH, 3))
        image = BLACK + GAIN * electrons + 0.5 * rng.standard_normal((HEIGHT, WIDTH, 3))
        Image.fromarray(np.clip(np.round(image), 0, TOP).astype(np.uint8)).save(path / f"frames/{index:02d}.png")
        text += f'[[frames]]\nimage = "frames/{index:02d}.png"\n[frames.parameters]\n"analyzer.angle" = {DIAL[index]}\n'
    (path / "captures.toml").write_text(text)
    return path


def begun(tmp_path, **hidden):
    captures = photographs(tmp_path / "set", np.random.default_rng(3), **hidden)
    free = ["source.power_r", "source.power_g", "source.power_b"]
    setup = loop.Setup(captures=str(captures), free=free, per_group=[])
    study, model, fit = loop.begin(setup, tmp_path / "study")
    return study, model, loop.recorded(study.ladder["facts"]["setup"]), fit


def judged(tmp_path, **hidden):
    study, model, setup, fit = begun(tmp_path, **hidden)
    return loop.examine(study, model, setup, fit, advised=False)


def drawn(sd):
    return sd * np.random.default_rng(4).standard_normal(len(DIAL))


def test_a_dial_that_is_read_by_eye_gets_its_width_and_nothing_is_missing(mitsuba, tmp_path):
    """Of fifteen settings a width is known to 18 %; it is drawn towards none by what is likely."""
    errors = drawn(0.5)
    study, model, setup, fit = begun(tmp_path, errors=errors)
    (width,) = setup.uncertainty.values()
    assert 0.6 < width / np.std(errors) < 1.5
    d = loop.examine(study, model, setup, fit, advised=False)
    assert d.word == "NOTHING", d.sentence


@pytest.mark.slow
def test_gains_that_no_dial_makes_are_a_claim(mitsuba, tmp_path):
    """Gains that scatter by 20 % are fitted to the noise by films that are up to 20 deg off, as nobody sets them."""
    d = judged(tmp_path, gains=np.exp(drawn(0.2)))
    assert (d.word, d.claimed) == ("CLAIM", "gain drift"), d.sentence


def test_held_out_frames_verify_gains_by_where_their_dials_would_stand(mitsuba, tmp_path):
    """A dial that is stated to .4 deg: without gains it would have to stand 10 deg off, in held-out frames as well."""
    d = judged(tmp_path, gains=np.exp(drawn(0.2)), errors=drawn(0.4), stated=0.4)
    assert (d.word, d.claimed) == ("CLAIM", "gain drift"), d.sentence
    assert d.levels[-1].fall > 100 and d.levels[-1].frames_better == d.levels[-1].frames


@pytest.mark.slow
def test_a_response_curve_beside_errors_of_a_dial_is_no_drift(mitsuba, tmp_path):
    """A gain of each frame explains both."""
    d = judged(tmp_path, errors=drawn(0.5), gamma=1.25)
    assert d.word in ("CLAIM", "AMBIGUOUS") and "camera gamma" in [d.claimed, *d.ambiguous], d.sentence
    assert "gain drift" not in [d.claimed, *d.ambiguous], d.sentence
