"""The pieces of a calibration: bounded steps, coordinates in which a fit steps, and what is solved for in other
frames."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from optics.captures.noise import Noise
from optics.fit import calibrate
from optics.fit.calibrate import extended, fit, for_frames
from optics.fit.descent import Descent, Normal, solve
from optics.fit.result import Fit, warnings_of
from optics.scene.parameter import Parameter, Values, Variable

sys.path.insert(0, str(Path(__file__).parent))
from mock_model import Exact, Frame


def problem(rng, n, flat=0):
    j = rng.normal(size=(4 * n, n)) * 10.0 ** rng.uniform(-3, 3, n)  # units differ by many orders
    j[:, n - flat :] = 0
    return j.T @ j, j.T @ rng.normal(size=4 * n)


def test_a_free_step_solves_the_normal_equations():
    a, b = problem(np.random.default_rng(0), 6)
    free = np.full(6, np.inf)
    np.testing.assert_allclose(solve(a, b, -free, free), np.linalg.solve(a, b), rtol=1e-8)
    damped = solve(a, b, -free, free, 0.5)
    np.testing.assert_allclose(damped, np.linalg.solve(a + 0.5 * np.diag(np.diag(a)), b), rtol=1e-8)


@pytest.mark.parametrize("seed", range(20))
def test_a_bounded_step_is_the_best_within_its_bounds(seed):
    """The conditions of Karush, Kuhn and Tucker: no slope where it is free, an outward one where it is held."""
    rng = np.random.default_rng(seed)
    a, b = problem(rng, 7)
    size = np.abs(np.linalg.solve(a, b))
    low, high = -size * rng.uniform(0, 1.5, 7), size * rng.uniform(0, 1.5, 7)
    x = solve(a, b, low, high)
    slope = (a @ x - b) / np.sqrt(np.diag(a)) / np.linalg.norm(b / np.sqrt(np.diag(a)))
    at_low, at_high = np.isclose(x, low, rtol=1e-9), np.isclose(x, high, rtol=1e-9)
    assert np.all(x >= low) and np.all(x <= high) and (at_low | at_high).any()
    assert np.abs(slope[~at_low & ~at_high]).max(initial=0) < 1e-7
    assert slope[at_low].min(initial=0) > -1e-7 and slope[at_high].max(initial=0) < 1e-7


def test_what_does_nothing_stays_put():
    a, b = problem(np.random.default_rng(1), 5, flat=2)
    x = solve(a, b, np.full(5, -np.inf), np.full(5, np.inf))
    assert np.isfinite(x).all() and np.all(x[3:] == 0)
    both = np.vstack([np.ones((1, 2))] * 3)  # only the sum is determined
    x = solve(both.T @ both, both.T @ np.ones(3), np.full(2, -10.0), np.full(2, 10.0))
    np.testing.assert_allclose(x, [0.5, 0.5])


@pytest.mark.parametrize("more", [{}, {"squared": True}, {"squared": True, "saturates": 0.3}])
def test_coordinates_return_and_have_the_slope_they_say(more):
    p = Parameter("s", "1", 0.2, (0.0, 2.0), **more)
    for value in (0.01, 0.2, 0.7, 1.5):
        u, h = p.coordinate(value), 1e-6
        assert p.at_coordinate(u) == pytest.approx(value, rel=1e-9)
        slope = (p.coordinate(value + h) - p.coordinate(value - h)) / (2 * h)
        assert 1 / p.per_coordinate(value) == pytest.approx(slope, rel=1e-5)
    assert p.at_coordinate(-1.0) == (0.0 if more else -1.0)


def test_a_factor_moves_by_its_logarithm():
    power = Parameter("power", "1", 1.0, (0.0, 1e6), linear=True)
    for value in (0.3, 2.0):
        assert power.stepped(value, 0.2) * power.stepped(value, -0.2) == pytest.approx(value**2)
        assert power.stepped(value, 1e-6) == pytest.approx(value + 1e-6, rel=1e-10)
        slow, fast = (power.stepped(value, value * (1 + side * 1e-6)) for side in (-1, 1))
        assert 0 < fast - slow == pytest.approx(2e-6 * np.e * value, rel=1e-3)  # smooth at the turn to a line
    assert power.stepped(2.0, -9.0) > 0 and power.stepped(0.0, 0.5) == 0.5  # a light that is off can be switched on
    for other in (Parameter("x", "mm", 1.0), Parameter("glare", "DN", 1.0, (0.0, 9.0), neutral=0.0, linear=True)):
        assert other.stepped(1.0, 0.5) == 1.5


@pytest.mark.parametrize("side", [-1, 1])
def test_a_step_to_a_bound_ends_on_it(side):
    """Not beside it by rounding: what stands at a bound is taken as known, and has no slope to be judged by."""
    sigma = Variable(
        "sigma", ("skin.sigma",), Parameter("sigma", "rad", 0.2, (0.0, 1.5), plausible=0.1, squared=True, saturates=0.3)
    )
    model = Exact()
    model.base = {"skin.sigma": 0.2}
    for start in np.linspace(0.01, 1.4, 40):
        descent = Descent(model, [sigma], Values({"sigma": start}), [])
        for push in (1e6, -1e-17):  # and stays there
            descent.take(Normal(np.eye(1), np.array([side * push]), 0.0, 0.0, [], [], []))
            descent.theta = descent.step(0.0)[0]
            assert descent.theta == (descent.low if side < 0 else descent.high)


class Twice(Exact):
    """Three lights, one image each, on a face that sends light on once and, to a share of 3e-3, twice: with the
    reflectances rho_c L_fc = P_f m_fc (rho_c + 3e-3 rho_c^2 w_c) / (1 + ((x - x_f)/5)^2). A vignetting, 1 % if not told
    otherwise, is in the images alone."""

    shape = (100, 100, 3)
    parameters = {
        f"{part}{name}": Parameter(name, unit, start, bounds, plausible=0.1, linear=unit == "1")
        for i in range(3)
        for part, name, unit, start, bounds in (
            (f"led_{i}.", "power", "1", 1.0, (0.0, 1e6)),
            ("face.", f"rho_{i}", "1", 0.3, (0.0, 10.0)),
            (f"led_{i}.", "x", "mm", 0.0, (-5.0, 5.0)),
        )
    }

    def __init__(self, rng, vignetting=0.01):
        self.noise = Noise(system_gain=0.02, dark_noise=1.0, black_level=0.0, saturation=4095.0, prnu=0.0)
        self.base = {key: p.default for key, p in self.parameters.items()}
        self.frames = [Frame(f"f{i}", np.zeros(self.shape)) for i in range(3)]
        self.across, self.mixed, self.w = (
            np.linspace(-4, 4, 100),
            np.eye(3) + 0.02 * rng.uniform(size=(3, 3)),
            rng.uniform(0.5, 1, self.shape),
        )
        self.true = {f"led_{i}.x": 0.4 * i - 0.3 for i in range(3)} | {f"face.rho_{i}": 0.5 + 0.2 * i for i in range(3)}
        for frame, light in zip(self.frames, self.predict(Values(self.true))):
            light = light * (1 - vignetting * np.add.outer(self.across**2, self.across**2) / 16)[..., None]
            frame.image = light + self.noise.sd(light) * rng.standard_normal(self.shape)

    def _lit(self, now, f):
        rho = np.array([now[f"face.rho_{c}"] for c in range(3)])
        if f == 3:
            return np.zeros(self.shape)
        return (
            2500
            * now[f"led_{f}.power"]
            * self.mixed[f]
            * (rho + 3e-3 * rho**2 * self.w)
            / (1 + ((self.across - now[f"led_{f}.x"]) / 5) ** 2)[:, None]
        )

    def predict(self, values, frames=None, seed=0):
        return [self._lit({**self.base, **values.common}, f) for f in (frames if frames is not None else range(3))]

    def derivatives(self, values, variables, frames=None, secant=None, seed=0):
        now = {**self.base, **values.common}
        for f in frames:
            yield (
                self._lit(now, f),
                {
                    v.name: self._lit({**now, v.name: now[v.name] + 1e-30j}, f).imag / 1e-30
                    for v in variables
                    if f < 3 and v.name.startswith(("face", f"led_{f}"))
                },
            )

    def linear_in(self, variable):
        return variable.name.endswith("power")


class Valleys(Exact):
    """Ten narrow valleys that bend: of each pair (x, y), one value tells y - x^2 a hundred times better than another
    tells x, as of a light whose place and direction nearly make up for each other."""

    shape = (40, 50, 1)
    pairs = 10
    parameters = {
        f"p{k}.{axis}": Parameter(axis, "1", 0.0, (-20.0, 20.0), plausible=1.0) for k in range(10) for axis in "xy"
    }

    def __init__(self, rng):
        self.noise = Noise(system_gain=1.0, dark_noise=1.0, black_level=0.0, saturation=4095.0, prnu=0.0)
        self.columns = np.linalg.qr(rng.standard_normal((2000, 2 * self.pairs)))[0]
        self.frames = [Frame("f", np.zeros(self.shape))]
        level = self._lit(dict.fromkeys(self.parameters, 0.0), 0)
        self.frames[0].image = level + self.noise.sd(level) * rng.standard_normal(self.shape)

    def _lit(self, now, f):
        x, y = (np.array([now[f"p{k}.{axis}"] for k in range(self.pairs)]) for axis in "xy")
        told = np.concatenate([3 * x, 300 * (y - x**2)])
        return (1000 + np.sqrt(1000) * (self.columns @ told)).reshape(self.shape)

    def predict(self, values, frames=None, seed=0):
        return [self._lit({**self.base, **values.common}, f) for f in (frames if frames is not None else range(1))]

    def derivatives(self, values, variables, frames=None, secant=None, seed=0):
        now = {**self.base, **values.common}
        for f in frames:
            yield (
                self._lit(now, f),
                {v.name: self._lit({**now, v.name: now[v.name] + 1e-30j}, f).imag / 1e-30 for v in variables},
            )

    @property
    def base(self):
        return {key: p.default for key, p in self.parameters.items()}

    def linear_in(self, variable):
        return False


@pytest.mark.parametrize("seed", range(3))
def test_a_narrow_valley_that_bends_is_followed_to_its_floor(seed):
    """Undamped steps leave it and damped ones creep. From a start whose chi2 is less than 20 per variable too high, as
    the one of an effect's refit, nothing that another fit would gain is left."""
    model = Valleys(np.random.default_rng(seed))
    variables = [Variable(key, (key,), p) for key, p in model.parameters.items()]
    start = {f"p{k}.{axis}": 1.2 if axis == "x" else 1.44 for k in range(model.pairs) for axis in "xy"}
    found = fit(model, variables, Values(start))
    least = fit(model, variables, Values(dict.fromkeys(start, 0.0)), tolerance=1e-6, max_iterations=200)
    assert found.converged and len(found.history) < 15
    assert abs(found.chi2 - least.chi2) < 1.0, (found.history, least.history)


@pytest.mark.parametrize("seed", range(4))
def test_powers_and_reflectances_that_hardly_differ_are_found_from_anywhere(seed):
    """Along P rho = const chi2 is almost flat, and pulled by what the model lacks: straight or damped steps get stuck
    in that bent valley."""
    model = Twice(np.random.default_rng(seed))
    variables = [Variable(key, (key,), p) for key, p in model.parameters.items()]
    one, two = [fit(model, variables, Values({f"led_{i}.power": power for i in range(3)})) for power in (1.0, 2.0)]
    assert one.converged and two.converged and max(len(one.history), len(two.history)) < 8
    assert abs(one.chi2 - two.chi2) < len(variables)  # what `converged` promises
    for i in range(3):
        assert one.values.common[f"led_{i}.power"] * one.values.common[f"face.rho_{i}"] == pytest.approx(
            0.5 + 0.2 * i, rel=0.01
        )


@pytest.mark.parametrize("seed", range(4))
def test_where_much_is_missing_the_last_of_chi2_is_not_waited_for(seed, monkeypatch):
    """A thousandth of what noise does not explain: below that, steps along flat valleys cost more than they can
    tell."""
    model = Twice(np.random.default_rng(seed), vignetting=0.1)
    variables = [Variable(key, (key,), p) for key, p in model.parameters.items()]
    soon = fit(model, variables, Values({f"led_{i}.power": 1.5 for i in range(3)}))
    monkeypatch.setattr(calibrate, "NEGLIGIBLE", 0.0)
    late = fit(model, variables, Values({f"led_{i}.power": 1.5 for i in range(3)}))
    excess = late.chi2 - late.dof
    assert (
        soon.converged and len(soon.history) < len(late.history) and excess > 1e6
    )  # without it two of these four do not converge
    assert 0 < soon.chi2 - late.chi2 < 2e-3 * excess


class Bend(Exact):
    """One pixel, 100 arctan(x): from x = 1.39 a full step leads as far to the other side, and brings nothing of what it
    promises."""

    shape = (1, 1, 1)
    parameters = {"led.x": Parameter("x", "mm", 1.0, (-50.0, 50.0), plausible=1.0)}
    base = {"led.x": 1.0}
    frames = [Frame("one", np.zeros((1, 1, 1)))]

    def predict(self, values, frames=None, seed=0):
        return [np.full(self.shape, 100 * np.arctan(values.common["led.x"]))]

    def derivatives(self, values, variables, frames=None, secant=None, seed=0):
        yield self.predict(values)[0], {"led.x": np.full(self.shape, 100 / (1 + values.common["led.x"] ** 2))}

    def variance(self, values, index, prediction):
        return np.ones(self.shape)


@pytest.mark.parametrize("start", [1.3, 1.36, 1.38, 1.39, 1.4, -1.38])
def test_a_step_that_brings_a_hundredth_of_its_promise_is_shortened(start):
    """On the same derivative images, which cost most: at most four linearisations with the one that sees the end, where
    taking any gain for progress needs five to eight. To .05 in chi2, which `fit` allows a variable."""
    model = Bend()
    found = fit(model, [Variable("led.x", ("led.x",), model.parameters["led.x"])], Values({"led.x": start}))
    assert found.converged and len(found.history) <= 4 and found.chi2 < 0.05


def test_far_from_the_best_a_factor_moves_straight():
    """By its logarithm a light that turns away would grow without measure."""
    power = Variable("power", ("led.power",), Parameter("power", "1", 1.0, (0.0, 1e6), linear=True))
    model = Exact()
    model.base = {"led.power": 1.0}
    descent = Descent(model, [power], Values(), [])
    descent.take(Normal(np.eye(1), np.array([0.5]), 0.0, 0.0, [], [], []))
    assert descent.step(0.0)[0] == pytest.approx(1.5)
    descent.creep()
    assert descent.step(0.0)[0] == pytest.approx(np.exp(0.5))


class Valley(Exact):
    """Pixels a (y - x^2 / 2) and the prior of x: a valley along the parabola, hundreds of times as steep across."""

    shape = (1, 1, 1)
    parameters = {
        "led.x": Parameter("x", "mm", 0.0, (-50.0, 50.0), plausible=1.0),
        "led.y": Parameter("y", "mm", 0.0, (-50.0, 50.0), plausible=1.0),
    }
    base = {"led.x": 0.0, "led.y": 0.0}
    frames = [Frame("one", np.zeros((1, 1, 1)))]
    steep = 300.0

    def predict(self, values, frames=None, seed=0):
        x, y = (values.common[key] for key in self.parameters)
        return [np.full(self.shape, self.steep * (y - x**2 / 2))]

    def derivatives(self, values, variables, frames=None, secant=None, seed=0):
        slopes = {"led.x": -self.steep * values.common["led.x"], "led.y": self.steep}
        yield self.predict(values)[0], {name: np.full(self.shape, slope) for name, slope in slopes.items()}

    def variance(self, values, index, prediction):
        return np.ones(self.shape)


@pytest.mark.parametrize("away", [3.0, 5.0, 7.0])
def test_a_bent_valley_is_followed_to_its_end(away):
    """Its straight steps gain a sixtieth of what they promise: along the tangent to where the prior lies, chi2 rises
    to thousands. Without steps around the bend the fit ended with "which no step brought"."""
    model = Valley()
    start, prior = Values({"led.x": 0.0, "led.y": 0.0}), (away, 1.0)
    variables = [Variable(key, (key,), model.parameters[key]) for key in model.parameters]
    found = fit(model, [variables[0].with_prior(*prior), variables[1]], start, max_iterations=40)
    assert found.converged, found.reason
    assert found.total < 2  # as good as the fit is asked for, 1 a variable


class Lamps(Exact):
    """Frames in which each lamp of a scene shines alone, y = power (1 + x): one lamp is dead."""

    def __init__(self, light):
        self.noise = Noise(system_gain=0.02, dark_noise=1.0, black_level=64.0, saturation=4095.0, prnu=0.0)
        self.shape = (4, 4, 1)
        self.pattern = 1 + np.arange(16.0).reshape(self.shape)
        power = Parameter("power", "1", 1.0, (0.0, 1e6), linear=True, plausible=0.1)
        self.parameters = {f"led_{i}.power": power for i in range(len(light))}
        self.base = dict.fromkeys(self.parameters, 1.0)
        noise = np.random.default_rng(0).normal(size=(len(light), *self.shape))
        self.frames = [Frame(f"f{i}", 64 + p * self.pattern + e) for i, (p, e) in enumerate(zip(light, noise))]

    def linear_in(self, variable):
        return True

    def predict(self, values, frames=None, seed=0):
        return [64 + self.at(values, i)[f"led_{i}.power"] * self.pattern for i in frames]

    def derivatives(self, values, variables, frames=None, secant=None, seed=0):
        for i, image in zip(frames, self.predict(values, frames)):
            yield image, {v.name: self.pattern for v in variables if v.keys[0] == f"led_{i}.power"}


def lamps(light):
    model = Lamps(light)
    return model, [Variable(k, (k,), p) for k, p in model.parameters.items()]


@pytest.mark.parametrize("start", [1e-6, 1.0, 1e5])
def test_powers_are_solved_for_before_the_first_step(start):
    """They are linear: two linearisations, the second with the noise of the right brightness, serve any start."""
    model, variables = lamps([30.0, 200.0])
    found = fit(model, variables, Values(dict.fromkeys(model.parameters, start)))
    assert found.converged and len(found.history) <= 2
    assert np.abs(found.estimate - [30.0, 200.0]).max() < 4 * found.sd.max()


class Tilted(Lamps):
    """Lamps over a dark signal that rises along the image, of which none acts as a lamp."""

    def __init__(self, light, tilt):
        super().__init__(light)
        self.parameters["camera.tilt"] = Parameter("tilt", "DN", 0.0, plausible=1.0)
        self.base["camera.tilt"] = 0.0
        rising = np.linspace(-1, 1, 16).reshape(self.shape)
        self.slope = rising - self.pattern * (rising * self.pattern).sum() / (self.pattern**2).sum()
        for frame in self.frames:
            frame.image = frame.image + tilt * self.slope
        self.linearised = 0

    def linear_in(self, variable):
        return variable.parameter.linear

    def predict(self, values, frames=None, seed=0):
        tilts = [self.at(values, i)["camera.tilt"] * self.slope for i in frames]
        return [image + tilt for image, tilt in zip(super().predict(values, frames), tilts)]

    def derivatives(self, values, variables, frames=None, secant=None, seed=0):
        self.linearised += 1
        for image, images in super().derivatives(values, variables, frames):
            yield image, {**images, "camera.tilt": self.slope}


def test_a_faint_lamp_that_is_far_off_costs_no_linearisation_of_its_own():
    """Its factor is far off, but correcting it alone gains almost nothing: no scaling step is taken."""
    model = Tilted([50.0, 0.0], 100.0)
    variables = [Variable(k, (k,), p) for k, p in model.parameters.items()]
    found = fit(model, variables, Values({"led_0.power": 50.0, "led_1.power": 0.06}))
    assert found.converged and found.estimate[2] == pytest.approx(100.0, abs=5 * found.sd[2])
    assert model.linearised <= len(found.history)


def test_a_factor_falls_but_is_not_switched_off():
    """A dead lamp ends within its error of 0 and is named; none of the steps there is more than tenfold."""
    model, variables = lamps([50.0, -0.5])  # darker than black by half a DN, as a wrong black level makes it
    seen = []
    predict = model.predict
    model.predict = lambda values, *a, **k: seen.append(values.common["led_1.power"]) or predict(values, *a, **k)
    found = fit(model, variables, Values(dict.fromkeys(model.parameters, 50.0)))
    assert found.converged and 0 < found.estimate[1] < found.sd[1] and found.at_bound == ["led_1.power"]
    assert min(b / a for a, b in zip(seen, seen[1:])) >= 0.1 * (1 - 1e-9)
    model, variables = lamps([50.0, -20.0])  # far below black: no power above 0 is best, however few its steps were
    assert fit(model, variables, Values(dict.fromkeys(model.parameters, 50.0))).at_bound == ["led_1.power"]
    off = fit(model, variables, Values({"led_0.power": 50.0, "led_1.power": 0.0}))
    assert off.estimate[1] == 0.0 and off.at_bound == ["led_1.power"]  # a lamp that is off may stay off
    light, variables = lamps([50.0, 40.0])
    assert fit(light, variables, Values({"led_1.power": 0.0})).estimate[1] == pytest.approx(40.0, rel=0.02)


def test_an_effect_may_do_nothing_in_a_dark_frame():
    model = Twice(np.random.default_rng(0))
    model.frames.append(Frame("dark", model.noise.sd(0.0) * np.ones(model.shape)))
    power, x = [
        [Variable(f"led_{i}.{name}", (f"led_{i}.{name}",), model.parameters[f"led_{i}.{name}"]) for i in range(3)]
        for name in ("power", "x")
    ]
    base = fit(model, power, Values(model.true), frames=range(4))
    more = extended(model, base, x)
    assert [len(where) for where, *_ in base.normal.rows] == [1, 1, 1, 0] and more.converged and more.chi2 < base.chi2


class Bent(Exact):
    """Values of which an effect's images bend, and a pattern that no variable makes: most of chi2 stays."""

    shape = (40, 50, 1)

    def __init__(self):
        rng = np.random.default_rng(4)
        self.noise = Noise(system_gain=0.02, dark_noise=1.0, black_level=0.0, saturation=4095.0, prnu=0.0)
        self.one, self.other, left = rng.normal(size=(3, *self.shape))
        self.parameters = {k: Parameter(k, "1", 0.0, plausible=1.0) for k in ("lamp.x", "lens.y")}
        self.base = {"lamp.x": 0.0, "lens.y": 0.0}
        self.frames = [Frame("f", 100 + 20 * self.other + 40 * left + rng.normal(size=self.shape))]
        self.predictions = 0

    def predict(self, values, frames=None, seed=0):
        self.predictions += 1
        now = self.at(values, 0)
        return [100 + self.one * now["lamp.x"] + self.other * (now["lens.y"] + 0.02 * now["lens.y"] ** 2)]

    def variance(self, values, index, prediction):
        return np.ones(self.shape)

    def derivatives(self, values, variables, frames=None, secant=None, seed=0):
        y = self.at(values, 0)["lens.y"]
        slopes = {"lamp.x": self.one, "lens.y": self.other * (1 + 0.04 * y)}
        yield self.predict(values)[0], {v.name: slopes[v.name] for v in variables}


def test_chord_steps_end_where_they_bring_a_hundredth_of_what_stays():
    """The fall is that of steps to the end within a hundredth of the misfit, for a part of the predictions."""
    model = Bent()
    x, y = (Variable(k, (k,), p) for k, p in model.parameters.items())
    base = fit(model, [x])
    model.predictions = 0
    whole = extended(model, base, [y], steps=40)
    taken, model.predictions = model.predictions, 0
    soon = extended(model, base, [y], steps=40, negligible=0.01)
    excess = whole.chi2 - model.frames[0].image.size
    assert excess > 1e6 and base.chi2 - whole.chi2 > 0.1 * excess
    assert model.predictions < taken and 0 <= soon.chi2 - whole.chi2 < 0.01 * excess


class Sampled(Exact):
    """One frame, y = level + a (0.2 g) + e(seed) where a > 0, with the same errors e, 0.085 rms, at every a: rays that
    cross a pupil. The data are without them, and without noise; values have a noise of 1."""

    level = Parameter("level", "1", 10.0, plausible=0.1)
    area = Parameter("area", "mm^2", 0.0, (0.0, 100.0), neutral=0.0, plausible=0.5)

    def __init__(self):
        self.shape = (100, 200, 1)
        self.noise = Noise(system_gain=0.02, dark_noise=1.0, black_level=0.0, saturation=4095.0, prnu=0.0)
        self.parameters = {"lamp.level": self.level, "lens.area": self.area}
        self.base = {"lamp.level": 10.0, "lens.area": 0.0}
        self.pattern = 0.2 * np.random.default_rng([0, 1]).normal(size=self.shape)
        self.frames = [Frame("f", 10 + 1.4 * self.pattern)]

    def image(self, level, area, seed):
        error = 0.085 * np.random.default_rng(seed).normal(size=self.shape) if area > 0 else 0.0
        return level + area * self.pattern + error

    def predict(self, values, frames=None, seed=0):
        now = self.at(values, 0)
        return [self.image(now["lamp.level"], now["lens.area"], seed)]

    def variance(self, values, index, prediction):
        return np.ones(self.shape)

    def derivatives(self, values, variables, frames=None, secant=None, seed=0):
        here, now = self.predict(values, frames, seed)[0], self.at(values, 0)
        found = {}
        for v in variables:
            step = (secant or {}).get(v.name, 0.1)
            there = {**now, v.keys[0]: now[v.keys[0]] + step}
            found[v.name] = (self.image(there["lamp.level"], there["lens.area"], seed) - here) / step
        yield here, found


def test_chord_steps_do_not_follow_the_errors_that_predictions_share_with_their_images():
    """By images of the predictions' own samples the root of J'Wr lies at 1.04, as errors are worth as much as the
    pattern there: -e'e/(0.5 g'g) = -0.36. By others it is at 1.4 but for products of independent errors, which are
    0.02 each of g'g = 800. The error that is told is 1/|g|, not that of an image with the square of its errors."""
    model = Sampled()
    level, area = (Variable(k, (k,), p) for k, p in model.parameters.items())
    base = fit(model, [level])
    found = extended(model, base, [area], {"lens.area": 0.5}, steps=40)
    assert found.estimate[1] == pytest.approx(1.4, abs=0.08)  # four times 0.02
    # products of errors with the pattern and with each other are 0.02 of g'g
    assert found.sd[1] == pytest.approx(1 / np.linalg.norm(model.pattern), rel=0.05)


def test_priors_go_along_to_other_frames_where_they_say_something_about_them():
    model = Exact()
    model.frames = [
        Frame(f"f{i}", np.zeros((1, 1, 1)), group=f"press-{i // 2}", parameters={"gel.press_x": float(i // 2)})
        for i in range(6)
    ]
    model.base = {"gel.press_x": 0.0, "camera.gain": 1.0}
    x, gain = Parameter("press_x", "mm", 0.0), Parameter("gain", "1", 1.0)

    def fitted(*priors):
        return [Variable(f"x[{g}]", ("gel.press_x",), x, (2 * g, 2 * g + 1), prior) for g, prior in enumerate(priors)]

    about_its_own = for_frames(model, fitted((0.0, 0.1), (1.0, 0.1)), [4, 5])
    assert [(v.name, v.frames, v.prior) for v in about_its_own] == [("gel.press_x[press-2]", (4, 5), (2.0, 0.1))]
    assert for_frames(model, fitted((0.3, 0.1), (0.3, 0.1)), [4, 5])[0].prior == (0.3, 0.1)
    assert for_frames(model, fitted((0.2, 0.1), (0.7, 0.1)), [4, 5])[0].prior is None
    each = [Variable(f"g[{i}]", ("camera.gain",), gain, (i,)) for i in range(4)]
    assert [v.frames for v in for_frames(model, each, [4, 5])] == [(4,), (5,)]


def test_what_is_not_determined_has_not_come_to_its_bound():
    """Of two powers that only their product is known of, one runs low: an error of many times the value says nothing
    about a bound. One that is known to be off, and one that stands at its bound, do."""
    power = Parameter("power", "1", 1.0, (0.0, 1e3), plausible=0.1, multiplies=True)
    variables = [Variable(n, (n,), power) for n in ("open", "off", "at")]
    names = [v.name for v in variables]
    covariance = np.diag([1e8, 1e-2, 1e-2])
    result = Fit(None, variables, np.array([0.5, 1e-3, 0.0]), covariance, 1.0, 1, [], [], [], True, "", at_bound=names)
    assert result.ended == ["off", "at"]
    told = warnings_of(result, np.linalg.inv(covariance))
    assert [t for t in told if "ended" in t] == ["off ended at its bound", "at ended at its bound"]


def test_what_is_correlated_among_each_other_is_one_warning():
    names = [*(f"led_{i}.power" for i in range(1, 7)), "rho", "x", "y", "alone"]
    common = np.zeros((len(names), 3))
    common[:7, 0], common[7, 1], common[8, 1] = 1, 1, -1
    covariance = common @ common.T + 1e-3 * np.eye(len(names))
    result = Fit(
        None, [SimpleNamespace(name=n) for n in names], np.zeros(len(names)), covariance, 1.0, 1, [], [], [], True, ""
    )
    every, pair = warnings_of(result, np.linalg.inv(covariance))
    assert every.startswith(
        "led_1.power, led_2.power, led_3.power, led_4.power, led_5.power and 2 more are correlated among each other"
    )
    assert every.endswith("hold one of them, or give it a prior")
    direction = np.r_[np.ones(7), np.zeros(3)] / np.sqrt(7)
    flat = np.eye(10) - (1 - 1e-9) * np.outer(direction, direction)  # the same set, undetermined: said once
    apart, *others = warnings_of(result, flat)
    assert apart.startswith("the captures cannot tell apart led_1.power") and others == [pair]
    assert pair == "x and y are correlated to -0.9990"
