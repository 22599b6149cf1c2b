"""Spectral effects hidden by plain sums over the wavelength: the makers against the model, and blind verdicts."""

import numpy as np
import pytest

from optics.fit.scene_model import SceneModel
from optics.proof import blind
from optics.proof.cells import Cell
from optics.proof.rigs.bench import PHOTODIODE
from optics.proof.rigs.colour import ColourBench, DigitColour
from optics.scene import loader
from optics.scene.parameter import Values

KEYS = {  # of the bench: what a hidden strength is in the model
    "LED centre shift": "centre_shift",
    "LED width": "line_growth",
    "phosphor leak": "phosphor_leak",
}


@pytest.fixture(scope="module")
def bench():
    return ColourBench()


def cell(rig, effect, change, seed=0, law="same"):
    kind = "library" if effect else "none"
    return Cell(rig.name, kind, (effect,) if effect else (), change, 0.0, law, "", seed)


@pytest.mark.parametrize("effect", ["", *ColourBench.effects])
def test_the_bench_is_made_as_the_model_has_it(mitsuba, bench, effect):
    """Sums in steps of 1 nm against Gauss nodes: below a third of the noise in every reading, at strengths that change
    the image by 0.5 %. The sensor sees a square of the card, the model its middle: 1.2e-3 of the light."""
    strength = bench.strength(effect, 0.005) if effect else 0.0
    captures = bench.captures(cell(bench, effect, 0.0), {effect: strength} if effect else {}, {}, mean=True)
    model = SceneModel(loader.load("colour_bench", bench.defines), captures, PHOTODIODE)
    keys = [f"{led}.{KEYS[effect]}" for led in bench.lamps] if effect in KEYS else [bench.seen.get(effect)]
    values = Values({**bench.built(0), **(dict.fromkeys(keys, strength) if effect else {})})
    worst = 0.0
    for image, frame in zip(model.predict(values), model.frames):
        found = (np.ravel(image) - PHOTODIODE.black_level) / 1.0012 + PHOTODIODE.black_level
        made = frame.image.astype(float).ravel()
        worst = max(worst, float((np.abs(found - made) / PHOTODIODE.sd(made)).max()))
    assert worst < 0.33, worst


def test_other_laws_have_the_cause_and_size_but_not_the_shape(bench):
    built = bench.built(0)
    plain = bench.light(built, {})
    for effect in bench.effects:
        strength = bench.strength(effect, 0.005)
        own, other = (bench.light(built, {effect: strength}, law) - plain for law in ("same", "other"))
        assert 0.4 < np.linalg.norm(other) / np.linalg.norm(own) < 2.5, effect
        assert 0.4 < np.vdot(own, other) / np.linalg.norm(own) / np.linalg.norm(other) < 0.9995, effect  # .46 to .9989


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["", "LED centre shift", "dispersive retardance"])
def test_blind_verdicts_on_the_bench(mitsuba, bench, effect):
    record = blind.run(bench, cell(bench, effect, 0.005))
    step = record["steps"][-1]
    assert (step["word"], step["claimed"]) == (("CLAIM", effect) if effect else ("NOTHING", ""))
    if effect:
        found, sd = step["strength"][effect]
        assert abs(found - record["truth"][effect]) < 4 * sd


@pytest.mark.slow
def test_a_blind_verdict_on_digit(mitsuba):
    rig = DigitColour()
    record = blind.run(rig, cell(rig, "LED centre shift", 0.02))
    step = record["steps"][-1]
    assert step["claimed"] == "LED centre shift"
