"""A sensor with a secret, made by another path than the model: the loop names it, adds it, and reaches the noise.

One secret of the polarizer bench runs always and one of a sensor on small images, the others with the slow tests. White
LEDs cannot show colour crosstalk: DIGIT's have to."""

import runpy
import sys
from pathlib import Path

import pytest

from optics.errors import OutputExists
from optics.proof import demo

ROOT = Path(__file__).resolve().parents[2]


# How near the strengths come, relative. One standard error is 5 % of the wedge and 8 % of the specular lobe. The makers
# draw an LED's disc at random, mesh a bulge finer (measured: -6 %) and interpolate a distorted image (-8 %).
NEAR = {"LED size": 0.15, "gel wedge": 0.25, "gel bulge": 0.15, "radial distortion": 0.1, "specular lobe": 0.1}


def found(folder, name, sensor="gelsight"):
    heard = []
    result = demo.run(folder, seed=2, effect=name, sensor=sensor, say=heard.append)
    story = "\n".join(heard)
    assert result["hidden"]["effect"] == name and result["claimed"] == [name], story
    assert result["held_out"] <= min(1.1, result["first"]), story
    if name != "gain drift":  # which has no strength, but a gain in every frame
        strength = next(iter(result["strengths"].values()))[0]
        assert abs(strength / result["hidden"]["strength"] - 1) < NEAR.get(name, 0.05), story
    assert (folder / "report.html").is_file()
    return result, story


def test_the_hidden_effect_is_named_added_and_the_noise_reached(mitsuba, tmp_path):
    result, story = found(tmp_path, "camera gamma", demo.BENCH)
    assert result["verdict"] == "NOTHING" and result["right"], story
    with pytest.raises(OutputExists, match="seed 2"):
        demo.run(tmp_path, seed=3)


SMALL = (64, 48)  # px: a quarter of the values of `make demo`, whose loop, maker and noise are otherwise the same


@pytest.mark.slow
def test_the_error_falls_to_the_noise_at_a_glance(mitsuba, tmp_path, monkeypatch):
    """What `make demo` shows, on small images: from ten times the noise's variance and more to the noise alone."""
    monkeypatch.setitem(demo.SENSORS, "gelsight", (SMALL, demo.SENSORS["gelsight"][1]))
    result, story = found(tmp_path, "lens vignetting")
    assert result["first"] > 10, story
    # 7 mosaics of 3072 values are held out: chi2 per value scatters by sqrt(2/21504) = 1 %; the model's rims add to it
    assert result["held_out"] == pytest.approx(1, abs=0.05), story
    assert result["verdict"] == "NOTHING" and result["right"], story


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(demo.SECRETS))
def test_every_secret_is_found(mitsuba, tmp_path, name):
    found(tmp_path, name)


@pytest.mark.slow
def test_colour_crosstalk_is_found_under_coloured_leds(mitsuba, tmp_path):
    found(tmp_path, "colour crosstalk", "digit")


@pytest.mark.slow
def test_the_example_calibrates_the_demonstration(mitsuba, tmp_path, monkeypatch, capsys):
    demo.make(tmp_path / "captures", 2, "lens vignetting")
    monkeypatch.setattr(sys, "argv", ["calibrate_gelsight.py", str(tmp_path / "captures")])
    runpy.run_path(str(ROOT / "examples" / "calibrate_gelsight.py"), run_name="__main__")
    said = capsys.readouterr().out
    assert "led_1.x" in said and "chi2 per degree of freedom" in said and "held out" in said
