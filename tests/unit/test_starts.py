"""Starts: where a search begins, what a trial solves for, and how many trials there may be."""

import sys
from pathlib import Path

import numpy as np
import pytest

from optics.captures.noise import Noise
from optics.errors import Underdetermined
from optics.fit import calibrate, starts
from optics.scene.parameter import Parameter, Values, Variable

sys.path.insert(0, str(Path(__file__).parent))
from mock_model import Exact, Frame

SIZES = (30.0, *(90.0 * k for k in range(1, 9)))
SIGMA = 0.3  # DN


class Plate(Exact):
    """A retarder between crossed polarizers, in three colours, at the angles t of the polarizers:

    DN = 100 power sin(delta/2)^2 sin(2 (t - c))^2, (delta_c, delta_s) = delta (cos 2c, sin 2c), delta as 1/wavelength.
    """

    RATIO = np.array([540 / 620, 1.0, 540 / 460])

    def __init__(self, delta=400.0, axis=20.0, power=1.0, readings=8):
        self.noise = Noise(1e-9, SIGMA, 0.0, 1e4, 0.0, 0.0)
        self.turned = np.radians(np.linspace(0, 90, readings, endpoint=False)).reshape(-1, 1, 1)
        self.shape = (readings, 1, 3)
        component = Parameter("s", "deg", 0.0, (-720.0, 720.0), neutral=0.0, plausible=10.0, starts=SIZES, pair="c")
        self.parameters = {
            "plate.c": Parameter(**{**component.__dict__, "name": "c", "pair": "s"}),
            "plate.s": component,
            "lamp.power": Parameter("power", "1", 1.0, (0.0, 1e6), linear=True, plausible=0.1),
        }
        self.base = {"plate.c": 0.0, "plate.s": 0.0, "lamp.power": 1.0}
        self.count = 0
        two = np.radians(2 * axis)
        true = {"plate.c": delta * np.cos(two), "plate.s": delta * np.sin(two), "lamp.power": power}
        noise = SIGMA * np.random.default_rng(0).normal(size=self.shape)
        self.frames = [Frame("sweep", self.light(true) + noise)]

    def linear_in(self, variable):
        return variable.keys == ("lamp.power",)

    def light(self, now):
        self.count += 1
        c, s = now["plate.c"], now["plate.s"]
        delta = np.sqrt(c * c + s * s + 1e-60) * np.pi / 180
        across = (np.sin(2 * self.turned) * c - np.cos(2 * self.turned) * s) * np.pi / 180 / delta
        return 100 * now["lamp.power"] * np.sin(delta * self.RATIO / 2) ** 2 * across**2

    def predict(self, values, frames=None, seed=0):
        return [self.light(self.at(values, i)).real for i in frames]

    def derivatives(self, values, variables, frames=None, secant=None, seed=0):
        for i in frames:
            now = self.at(values, i)
            stepped = {v.name: {**now, v.keys[0]: now[v.keys[0]] + 1e-30j} for v in variables}
            light = {name: self.light(own) for name, own in stepped.items()}
            yield self.light(now).real, {n: (x.imag / 1e-30).astype(np.float32) for n, x in light.items()}

    def variables(self, *keys):
        return [Variable(key, (key,), self.parameters[key]) for key in keys or self.parameters]


@pytest.mark.parametrize("delta", [20.0, 130.0, 400.0, 690.0])
def test_the_order_is_found_whatever_the_light(delta):
    """The lamp is thirty times as bright as the start says: every trial solves for it."""
    model = Plate(delta, power=30.0)
    with pytest.raises(Underdetermined):  # at 0 all is dark, to first order
        calibrate.fit(model, model.variables())
    found = calibrate.fit_over_starts(model, model.variables())
    assert np.hypot(*found.estimate[:2]) == pytest.approx(delta, abs=1.0)
    assert found.estimate[2] == pytest.approx(30.0, rel=0.1) and list(found.start) == [0.0, 0.0, 1.0]


def test_the_smallest_of_equals_is_taken():
    """In one colour a retardance and its complement to 360 deg look alike."""
    model = Plate(70.0)
    model.RATIO = np.ones(3)
    model.frames[0].image = model.light({"plate.c": 70.0, "plate.s": 0.0, "lamp.power": 1.0})
    found = calibrate.fit_over_starts(model, model.variables("plate.c", "plate.s"))
    assert np.hypot(*found.estimate) == pytest.approx(70.0, abs=1.0)


def test_what_fits_is_not_searched_further():
    model = Plate(60.0)
    near = Values({"plate.c": 40.0, "plate.s": 30.0})
    model.count = 0
    plain = calibrate.fit(model, model.variables(), near)
    alone, model.count = model.count, 0
    found = calibrate.fit_over_starts(model, model.variables(), near)
    assert model.count == alone and found.estimate == pytest.approx(plain.estimate)


def test_only_the_starts_that_are_asked_for_are_tried():
    """A refit of another effect does not search what the base has found."""
    model = Plate(400.0)
    near = Values({"plate.c": 60.0, "plate.s": 60.0})
    plain = calibrate.fit(model, model.variables(), near)
    assert plain.chi2 > 10 * plain.dof
    found = calibrate.fit_over_starts(model, model.variables(), near, over=["lamp.power"])
    assert found.estimate == pytest.approx(plain.estimate)
    found = calibrate.fit_over_starts(model, model.variables(), near, over=["plate.s"])
    assert np.hypot(*found.estimate[:2]) == pytest.approx(400.0, abs=1.0)  # the vector, by either component


def test_a_search_keeps_to_the_number_of_its_trials():
    model = Plate()
    for most in (LEAST := starts.LEAST, 40, 100):
        model.count = 0
        ranked = starts.search(model, model.variables(), Values(dict(model.base)), [0], most)
        assert len(ranked) > 0 and model.count <= 2 * (most + 2)  # a trial: a prediction, and one for the power
    assert most > 9 * starts.DIRECTIONS > LEAST  # the last one tried all
    best = np.hypot(ranked[0][1].common["plate.c"], ranked[0][1].common["plate.s"])
    assert round(best) in (360, 450) and ranked == sorted(ranked, key=lambda t: t[0])  # on either side of 400


def test_large_images_are_searched_only_where_the_present_values_show_nothing():
    model = Plate()
    assert starts.number_of_trials(model, [0], False) == starts.MOST
    model.frames = [Frame(f"f{i}", np.zeros((480, 640, 3))) for i in range(9)]
    assert starts.number_of_trials(model, range(9), False) == 0
    assert starts.number_of_trials(model, range(9), True) == starts.LEAST
    assert starts.number_followed(model, range(9)) < starts.FOLLOWED
    model.monte_carlo = True
    assert starts.number_of_trials(model, range(9), True) == 0


def test_a_held_component_leaves_its_partner_both_signs():
    model = Plate()
    (trials,) = starts.alternatives(model, model.variables("plate.s"), Values())
    assert [t[0] for t in trials] == [0.0, *(sign * s for s in SIZES for sign in (1, -1))]


def test_a_start_beyond_its_bounds_is_refused():
    with pytest.raises(ValueError, match="90"):
        Parameter("offset", "deg", 0.0, (-60.0, 60.0), starts=(90.0,))
