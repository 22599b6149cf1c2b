"""Gauges: what no frame shows is found by its Gram matrix, named, and the combinations beside it are known."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from optics.captures.noise import Noise
from optics.fit import gauges
from optics.fit.calibrate import fit
from optics.scene.parameter import Parameter, Values, Variable

sys.path.insert(0, str(Path(__file__).parent))
from mock_model import Exact, Frame

OFFSET = Parameter("offset", "deg", 0.0, (-180.0, 180.0), neutral=0.0, plausible=1.0)
POWER = Parameter("power", "1", 1.0, (0.0, 1e6), linear=True, plausible=0.1)
WOBBLE = Parameter("wobble", "1", 0.0, (-0.5, 0.5), neutral=0.0, plausible=0.01, through="angle")
SIGMA = 0.5  # DN


class Bench(Exact):
    """Malus by hand: DN = 100 p1 p2 cos(psi + a - b)^2, the dial psi in steps of 10 deg; c is a film on the table."""

    def __init__(self, offset=0.5):
        self.noise = Noise(
            system_gain=1e-9, dark_noise=SIGMA, black_level=0.0, saturation=1e4, prnu=0.0, quantisation=0.0
        )
        self.shape, self.dial = (36, 1, 1), np.arange(0.0, 360.0, 10.0).reshape(-1, 1, 1)
        self.parameters = {f"{film}.offset": OFFSET for film in "abc"} | {"p1.power": POWER, "p2.power": POWER}
        self.base = {key: p.default for key, p in self.parameters.items()}
        self.frames = [Frame("sweep", np.zeros(self.shape))]
        light = self.light({**self.base, "a.offset": offset})
        self.frames[0].image = light + SIGMA * np.random.default_rng(1).normal(size=self.shape)

    def light(self, now):
        turn = (self.dial + now["a.offset"] - now["b.offset"]) * np.pi / 180
        return 100 * now["p1.power"] * now["p2.power"] * np.cos(turn) ** 2

    def predict(self, values, frames=None, seed=0):
        return [self.light(self.at(values, 0))]

    def derivatives(self, values, variables, frames=None, secant=None, seed=0):
        now = self.at(values, 0)
        stepped = {v.name: {**now, v.keys[0]: now[v.keys[0]] + 1e-30j} for v in variables}
        yield (
            self.light(now),
            {name: (self.light(own).imag / 1e-30).astype(np.float32) for name, own in stepped.items()},
        )

    def variables(self, *names, sd=10.0):
        """Powers, and offsets with the prior of an effect's strengths."""
        own = [Variable(name, (name,), self.parameters[name]) for name in names]
        return [v.with_prior(0.0, sd) if v.parameter is OFFSET and sd else v for v in own]


def test_the_difference_of_two_offsets_is_known_and_their_common_rotation_a_gauge():
    """Malus' curve tells the angle between two films; 10 deg of prior on each leaves each at +- 7.07."""
    model = Bench()
    variables = model.variables("p1.power", "a.offset", "b.offset", "c.offset")
    found = fit(model, variables)
    assert found.sd[1:3] == pytest.approx(10 / np.sqrt(2), rel=1e-3)
    (gauge,), (known,) = found.gauges.gauges, found.gauges.known
    assert gauge.text == "a common rotation of a.offset and b.offset" and set(gauge.members) == {1, 2}
    # d DN/d angle = 100 sin(2 psi) per rad, rms 100/sqrt(2): 0.5 DN of 36 readings
    expected = np.degrees(SIGMA / (100 * np.sqrt(18)))
    assert known.text == "a.offset - b.offset" and known.unit == "deg"
    assert known.sd == pytest.approx(expected, rel=0.02) and known.value == pytest.approx(0.5, abs=4 * known.sd)
    assert found.gauges.silent == [3] and found.gauges.count == 2  # a power and one angle
    table = found.table()
    assert "7.1" not in table and f"known: {known}" in table and "unseen" in table
    assert not any("correlated" in w for w in found.warnings)


def test_strengths_are_told_as_combinations():
    model = Bench()
    variables = model.variables("p1.power", "a.offset", "b.offset", "c.offset")
    found = fit(model, variables)
    text = gauges.strengths_told(found, variables[1:], found.estimate[1:])
    value = found.gauges.known[0]
    assert text == (f"{value} (a common rotation of a.offset and b.offset does not show; c.offset does not show)")
    assert gauges.strengths_told(found.covariance[1:, 1:], variables[1:], found.estimate[1:]) == text
    alone = fit(model, model.variables("p1.power", "a.offset"))
    told = gauges.strengths_told(alone, alone.variables[1:], alone.estimate[1:])
    assert told.startswith("0.") and told.endswith(" deg") and "(" not in told


def test_a_strength_of_which_nothing_is_known_does_not_hide_the_others():
    """The gain of a frame behind crossed films is known to 3e5, the others to 1e-3: those were told to be unknown."""
    model = Bench()
    variables = model.variables("a.offset", "b.offset", "c.offset")
    found = np.diag([0.01, 3e9, 0.02]) ** 2
    text = gauges.strengths_told(found, variables, [0.5, 0.0, 1.0])
    assert text.startswith("a.offset = 0.500 +- 0.010 deg, c.offset = 1.000 +- 0.020 deg"), text
    assert "(b.offset does not show)" in text


def test_an_effect_that_the_base_holds_has_nothing_of_its_own():
    """Beside a free offset of the one film, that of the other is the same angle."""
    model = Bench()
    variables = model.variables("p1.power", "a.offset", sd=None) + model.variables("b.offset")
    found = fit(model, variables)
    text = gauges.strengths_told(found, variables[2:], found.estimate[2:])
    assert text == "nothing of it is determined (b.offset does not show)"


def test_factors_that_share_a_scale_are_known_by_their_product():
    model = Bench(0.0)
    start = Values({"p1.power": 4.0, "p2.power": 0.25})
    found = fit(model, model.variables("p1.power", "p2.power"), start)
    (gauge,), (known,) = found.gauges.gauges, found.gauges.known
    assert gauge.text == "a common scale of p1.power and p2.power" and known.text == "p1.power * p2.power"
    assert known.value == pytest.approx(1.0, abs=4 * known.sd)
    assert known.sd == pytest.approx(SIGMA / 100 / np.sqrt(36 * 3 / 8), rel=0.02)  # cos^4 is 3/8 on average
    assert any(w.startswith("the captures cannot tell apart p1.power, p2.power") for w in found.warnings)


def test_two_gauges_are_told_one_by_one():
    """Of a sum x + y and of 2u - v nothing else is known; z stands alone."""
    rng = np.random.default_rng(0)
    j = rng.normal(size=(50, 3)) @ np.array([[1.0, 1, 0, 0, 0], [0, 0, 2, -1, 0], [0, 0, 0, 0, 1]])
    found = gauges.find(j.T @ j, list("xyuvz"), np.ones(5), [1.0, 2.0, 3.0, 4.0, 5.0], ["mm"] * 5)
    assert found.count == 3 and sorted(map(set, (g.members for g in found.gauges)), key=min) == [{0, 1}, {2, 3}]
    assert {k.text: k.value for k in found.known} == {"x + y": pytest.approx(3.0), "u - 0.5 v": pytest.approx(1.0)}
    assert found.known[0].sd == pytest.approx(1 / np.sqrt(50), rel=0.3)  # of 50 values with unit noise


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_units_do_not_matter(unit):
    """In another unit the value and the plausible size of x are other numbers; the combination is the same quantity."""
    rng = np.random.default_rng(0)
    j = rng.normal(size=(50, 2)) @ np.array([[1.0, 1, 0], [0, 0, 1]])  # per plausible size
    found = gauges.find(j.T @ j, list("xyz"), [unit, 1.0, 1.0], [unit, 2.0, 3.0])
    assert found.count == 2 and found.known[0].value / unit == pytest.approx(3.0)
    assert found.known[0].sd / unit == pytest.approx(1 / np.sqrt(50), rel=0.3)


def test_what_is_determined_has_no_gauge():
    rng = np.random.default_rng(0)
    j = rng.normal(size=(50, 4)) * [1.0, 10.0, 0.1, 1.0]
    j[:, 3] = j[:, 0] + 1e-2 * j[:, 3]  # alike, and yet told apart
    found = gauges.find(j.T @ j, list("abcd"), np.ones(4), np.ones(4))
    assert not found.gauges and not found.known and found.count == 4


def test_dials_that_never_turned_and_films_on_the_table_are_not_freed():
    """A wobble shows through the turns of its dial; a film that is not in the beam shows nothing."""
    inserted = Parameter("inserted", "1", 1.0, (0.0, 1.0), role="inserted")
    angle = Parameter("angle", "deg", 0.0)
    parameters = {
        f"{film}.{p.name}": p for film in ("first", "second", "out") for p in (inserted, angle, OFFSET, WOBBLE)
    }
    base = {key: p.default for key, p in parameters.items()} | {"out.inserted": 0.0, "first.angle": 30.0}
    turned = {"second.angle": np.array([0.0, 45.0]).reshape(-1, 1, 1)}
    frames = [Frame("sweep", np.zeros((2, 1, 1)), parameters={"first.angle": 30.0}, readings=turned)]
    model = SimpleNamespace(parameters=parameters, base=base, frames=frames)

    def own(name):
        return [Variable(f"{film}.{name}", (f"{film}.{name}",), parameters[f"{film}.{name}"]) for film in FILMS]

    FILMS = ("first", "second", "out")
    assert [v.name for v in gauges.acting(model, own("wobble"))] == ["second.wobble"]
    assert [v.name for v in gauges.acting(model, own("offset"))] == ["first.offset", "second.offset"]
    shared = Variable("film.wobble", tuple(f"{film}.wobble" for film in FILMS), WOBBLE)
    assert [(v.name, v.keys) for v in gauges.acting(model, [shared])] == [("film.wobble", ("second.wobble",))]


def test_the_gain_of_a_light_shows_beside_another_light():
    """Of frames with one light each it is the gain of the frame; a frame without the light does not show it."""
    gain = Parameter("gain", "1", 1.0, (0.0, 100.0), neutral=1.0, role="power gain")
    parameters = {f"{led}.{n}": p for led in "ab" for n, p in (("power", replace(POWER, role="power")), ("gain", gain))}
    variables = [Variable(f"{led}.gain[{i}]", (f"{led}.gain",), gain, (i,)) for led in "ab" for i in range(3)]

    def acting(*lit):
        frames = [
            Frame("f", np.zeros((1, 1, 1)), parameters={f"{led}.power": float(led in on) for led in "ab"}) for on in lit
        ]
        model = SimpleNamespace(parameters=parameters, base=dict.fromkeys(parameters, 1.0), frames=frames)
        return [v.name for v in gauges.acting(model, variables)]

    assert acting("a", "b", "a") == []
    assert acting("ab", "b", "a") == ["a.gain[0]", "a.gain[2]", "b.gain[0]", "b.gain[1]"]


def test_gains_that_change_together_are_told_without_their_factors():
    """Five gains of which dark frames hardly know any, beside a power that they make up for."""
    names, change = [f"camera.gain[{i}]" for i in range(5)], np.array([1.0, 0.7, 0.68, 0.9, 1.0])
    told = gauges._gauge_text(names, change, ["1"] * 5, logs=True)
    assert told == (
        "a common change of camera.gain[0], camera.gain[1], camera.gain[2] and 2 more, by different amounts,"
    )
    opposed = gauges._gauge_text(names, change * [1, -1, 1, 1, 1], ["1"] * 5, logs=True)
    assert opposed.startswith("a change of camera.gain[0] by a factor 2.72 with camera.gain[1] by a factor 0.497")
