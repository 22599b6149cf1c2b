"""The pieces of a calibration: bounded steps, coordinates in which a fit steps, and what is solved for in other frames."""

from types import SimpleNamespace

import numpy as np
import pytest

from optics.calibrate import Fit, for_frames, solve, warnings_of
from optics.parameter import Parameter, Variable


def problem(rng, n, flat=0):
    j = rng.normal(size=(4 * n, n)) * 10.0 ** rng.uniform(-3, 3, n)  # units differ by many orders
    j[:, n - flat:] = 0
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


def test_priors_go_along_to_other_frames_where_they_say_something_about_them():
    frames = [SimpleNamespace(name=f"f{i}", group=f"press-{i // 2}", parameters={"gel.press_x": float(i // 2)}) for i in range(6)]
    model = SimpleNamespace(frames=frames, base={"gel.press_x": 0.0, "camera.gain": 1.0})
    x, gain = Parameter("press_x", "mm", 0.0), Parameter("gain", "1", 1.0)

    def fitted(*priors):
        return [Variable(f"x[{g}]", ("gel.press_x",), x, (2 * g, 2 * g + 1), prior) for g, prior in enumerate(priors)]

    about_its_own = for_frames(model, fitted((0.0, 0.1), (1.0, 0.1)), [4, 5])
    assert [(v.name, v.frames, v.prior) for v in about_its_own] == [("gel.press_x[press-2]", (4, 5), (2.0, 0.1))]
    assert for_frames(model, fitted((0.3, 0.1), (0.3, 0.1)), [4, 5])[0].prior == (0.3, 0.1)
    assert for_frames(model, fitted((0.2, 0.1), (0.7, 0.1)), [4, 5])[0].prior is None
    each = [Variable(f"g[{i}]", ("camera.gain",), gain, (i,)) for i in range(4)]
    assert [v.frames for v in for_frames(model, each, [4, 5])] == [(4,), (5,)]


def test_what_is_correlated_among_each_other_is_one_warning():
    names = [*(f"led_{i}.power" for i in range(1, 7)), "rho", "x", "y", "alone"]
    common = np.zeros((len(names), 3))
    common[:7, 0], common[7, 1], common[8, 1] = 1, 1, -1
    covariance = common @ common.T + 1e-3 * np.eye(len(names))
    result = Fit(None, [SimpleNamespace(name=n) for n in names], np.zeros(len(names)), covariance, 1.0, 1, [], [], [], True, "")
    every, pair = warnings_of(result, np.linalg.inv(covariance))
    assert every.startswith("led_1.power, led_2.power, led_3.power, led_4.power, led_5.power and 2 more are correlated among each other")
    assert every.endswith("hold one of them, or give it a prior")
    direction = np.r_[np.ones(7), np.zeros(3)] / np.sqrt(7)
    flat = np.eye(10) - (1 - 1e-9) * np.outer(direction, direction)  # the same set, undetermined: said once
    apart, *others = warnings_of(result, flat)
    assert apart.startswith("the captures cannot tell apart led_1.power") and others == [pair]
    assert pair == "x and y are correlated to -0.9990"
