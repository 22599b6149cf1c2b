"""What a batch draws: a series of sensors, plausible sizes, and what a fit leaves open, against closed forms."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from optics.errors import OutOfBounds, UnknownKey
from optics.fit.descent import Normal
from optics.fit.result import Fit
from optics.scene import loader
from optics.scene.parameter import Parameter, Values, Variable
from optics.study import batch
from optics.study.draws import BadJob, Draws
from optics.study.fit_files import Posterior, fit_record, fit_toml, posterior_of, read_fit

FILE = Path("job.toml")


@pytest.fixture(scope="module")
def scene(mitsuba):
    return loader.load("gelsight", {"width": "16", "height": "12"})


def job(**tables):
    tables = {"scene": "gelsight", "out": "out", "count": 4000, **tables}
    return batch.Job.model_validate(tables)


def test_a_unit_keeps_its_draw_for_all_its_images(scene):
    made = job(
        per_unit=5,
        sample={"gel.press_x": {"uniform": [-1.0, 1.0]}},
        unit={"led_1.power": {"normal": [1.0, 0.05]}, "led_2.power": {"plausible": 0.1}},
    )
    draws = Draws(made, scene, {}, FILE)
    found = [draws.at(i) for i in range(40)]
    for key in ("led_1.power", "led_2.power"):
        values = np.array([f[key] for f in found]).reshape(8, 5)
        assert (values == values[:, :1]).all() and len(np.unique(values)) == 8
    assert len({f["gel.press_x"] for f in found}) == 40
    alone = Draws(job(per_unit=5, unit={"led_1.power": {"normal": [1.0, 0.05]}}), scene, {}, FILE)
    assert alone.at(7)["led_1.power"] == found[7]["led_1.power"], "a draw depends on nothing that is drawn beside it"


def test_an_effect_is_drawn_in_plausible_sizes_within_its_bounds(scene):
    effect = scene.registry.find_effect("lens vignetting")
    draws = Draws(job(sample={"lens vignetting": {"plausible": 2.0}}), scene, {}, FILE)
    keys = [key for keys in scene.keys_of(effect).values() for key in keys]
    assert draws.keys == keys and len(keys) >= 1
    for key in keys:
        p = scene.parameters[key]
        found = np.array([draws.at(i)[key] for i in range(4000)])
        low, high = ((b - scene.values()[key]) / (2 * p.plausible) for b in p.bounds)
        expected = stats.truncnorm(low, high, loc=scene.values()[key], scale=2 * p.plausible)
        assert stats.kstest(found, expected.cdf).pvalue > 1e-3  # fixed seed: a wrong law of 4000 draws has p << 1e-10


def test_shared_parameters_of_an_effect_stay_shared(scene):
    shared = next(
        e
        for e in scene.registry.effects.values()
        if e.per == "kind" and scene.can_express(e) and max(map(len, scene.keys_of(e).values())) > 1
    )
    draws = Draws(job(unit={shared.name: {"plausible": 1.0}}), scene, {}, FILE).at(0)
    for keys in scene.keys_of(shared).values():
        assert len({draws[key] for key in keys}) == 1


def test_a_change_about_a_value_outside_reach_is_said(scene):
    parameter = scene.parameters["led_1.power"]
    draws = Draws(job(sample={"led_1.power": {"plausible": 1e-9}}), scene, {"led_1.power": -1.0}, FILE)
    with pytest.raises(OutOfBounds, match=r"led_1.power = -1 .*bounds"):
        draws.at(0)
    assert parameter.bounds[0] == 0


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ({"sample": {"lens vignettin": {"plausible": 1.0}}}, "did you mean 'lens vignetting'"),
        ({"sample": {"lens vignetting": {"uniform": [0.0, 1.0]}}}, "is an effect; allowed: { plausible = 1 }"),
        ({"unit": {"gel.indenter": {"plausible": 1.0}}}, "gel.indenter is a word and no number; allowed: choice"),
        ({"unit": {"retardance": {"plausible": 1.0}}}, "cannot express 'retardance'"),
    ],
)
def test_what_cannot_be_drawn_is_said(scene, tables, said):
    with pytest.raises((UnknownKey, BadJob)) as error:
        Draws(job(**tables), scene, {}, FILE)
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ({"unit": {"a": {"grid": [1.0]}}}, "a grid counts images, and not sensors"),
        ({"unit": {"a": {"plausible": 1.0}}, "sample": {"a": {"plausible": 1.0}}}, r"in \[sample\] and in \[unit\]"),
        ({"posterior": True}, "posterior, but no fit"),
    ],
)
def test_a_job_that_contradicts_itself_is_refused(tables, said):
    with pytest.raises(ValueError, match=said):
        job(**tables)


# -- the posterior ---------------------------------------------------------------------------------------------------
def fitted(normal, sizes, frames=None):
    names = [f"led_{i + 1}.power" for i in range(len(sizes))]
    variables = [
        Variable(n, (n,), Parameter("power", "W/sr", 1.0, (0.0, math.inf), plausible=s), f)
        for n, s, f in zip(names, sizes, frames or [None] * len(sizes))
    ]
    size = len(sizes)
    return Fit(
        Values(),
        variables,
        np.ones(size),
        np.linalg.pinv(normal),
        chi2=1.0,
        dof=1,
        frames=[0],
        frame_chi2=[1.0],
        frame_n=[1],
        converged=True,
        reason="",
        normal=Normal(np.asarray(normal, float), np.zeros(size), 1.0, 0.0, [1.0], [1], []),
    )


def test_what_captures_leave_open_stays_within_plausible_sizes():
    """Only the sum of two values is known, to 0.01: their difference has the plausible size, 0.3."""
    known, size = 0.01, 0.3
    fit = fitted(np.ones((2, 2)) / known**2, [size, size])
    covariance = fit.posterior
    total, difference = (w @ covariance @ w for w in (np.array([1.0, 1.0]), np.array([1.0, -1.0])))
    assert total == pytest.approx(1 / (1 / known**2 + 1 / (2 * size**2)), rel=1e-9)  # 1'C1 along (1, 1)/sqrt 2, twice
    assert difference == pytest.approx(2 * size**2, rel=1e-9)


def test_what_is_known_well_keeps_its_covariance():
    a = np.array([[4.0, 1.0], [1.0, 2.0]]) * 1e6
    np.testing.assert_allclose(fitted(a, [0.5, 0.2]).posterior, np.linalg.inv(a), rtol=1e-4)  # sd^2/size^2 = 2e-5


def test_values_of_single_frames_are_integrated_out(tmp_path):
    a = np.array([[4.0, 1.0, 0.5], [1.0, 2.0, 0.2], [0.5, 0.2, 3.0]]) * 1e4
    fit = fitted(a, [0.5, 0.5, 0.5], [None, (0,), None])
    posterior = posterior_of(fit)
    whole = np.linalg.inv(a + np.eye(3) / 0.25)
    assert posterior.names == ("led_1.power", "led_3.power")
    np.testing.assert_allclose(posterior.covariance, whole[np.ix_([0, 2], [0, 2])], rtol=1e-12)
    (tmp_path / "fit.toml").write_text(fit_toml(fit_record(fit, ["a"])))
    read = Posterior.from_table(read_fit(tmp_path / "fit.toml")["posterior"], "fit.toml")
    np.testing.assert_allclose(read.covariance, posterior.covariance, rtol=1e-14)


TABLE = {
    "variables": ["led_1.power", "led_3.power"],
    "keys": [["led_1.power"], ["led_3.power"]],
    "value": [1.0, 2.0],
    "sd": [0.1, 0.2],
    "correlation": [[1.0], [0.5, 1.0]],
}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"sd": [1.0]}, "2 variables, but 1 of sd"),
        ({"sd": [0.1, 0.0]}, r"sd\[1\] = 0.0; allowed: greater"),
        ({"sd": [0.1, float("nan")]}, r"sd\[1\] = nan; allowed: a finite number"),
        ({"sd": [0.1, 1e300]}, r"sd\[1\] = 1e\+300; allowed: less"),
        ({"value": [True, 1.0]}, r"value\[0\] = True; allowed: a valid number"),
        ({"value": "12"}, "value = '12'; allowed: a valid list"),
        ({"keys": ["ab", "cd"]}, r"keys\[0\] = 'ab'"),
        ({"keys": [["led_1.power"], []]}, r"keys\[1\] = \[\]"),
        ({"keys": [["led_1.power"], ["led_1.power"]]}, "keys: 'led_1.power' appears twice"),
        ({"variables": ["a", "a"]}, "variables: 'a' appears twice"),
        ({"correlation": [[1.0], [float("nan"), 1.0]]}, r"correlation\[1\]\[0\] = nan"),
        ({"correlation": [[1.0], [1.0]]}, r"correlation\[1\]: 1 numbers; allowed: 2"),
        ({"correlation": [[1.0, 0.5], [0.5, 1.0]]}, r"correlation\[0\]: 2 numbers; allowed: 1"),
        ({"correlation": [[1.0], [1.2, 1.0]]}, "a least eigenvalue of -0.2; allowed: 1, and 0 or more"),
        ({"correlation": [[1.0], [0.5, 0.9]]}, "with 0.9 on its diagonal"),
        ({"corelation": [[1.0]]}, "unknown entry 'corelation'; did you mean 'correlation'"),
        (dict.fromkeys(TABLE, []), r"variables = \[\]"),
    ],
)
def test_a_table_that_is_no_posterior(changed, message):
    with pytest.raises((ValueError, UnknownKey), match=rf"fit.toml: \[posterior\].*{message}"):
        Posterior.from_table({**TABLE, **changed}, "fit.toml")


def test_three_numbers_that_cannot_be_correlated_so():
    """Each pair could be: an eigenvalue of 1 + 2 (-.9) cos(0) = -.8 says that the three cannot."""
    rows = [[1.0], [0.9, 1.0], [0.9, -0.9, 1.0]]
    table = {
        "variables": ["a", "b", "c"],
        "keys": [["a"], ["b"], ["c"]],
        "value": [0.0] * 3,
        "sd": [1.0] * 3,
        "correlation": rows,
    }
    with pytest.raises(ValueError, match="a least eigenvalue of -0.8"):
        Posterior.from_table(table, "fit.toml")


def test_a_posterior_of_an_ill_conditioned_fit_can_be_drawn_from():
    """Columns that agree to 1e-7, beside one that is 1e6 times as strong: no eigenvalue below 0 by rounding."""
    j = np.random.default_rng(0).standard_normal((50, 4))
    j[:, 1] = j[:, 0] * (1 + 1e-7)
    j[:, 2] *= 1e6
    fit = fitted(1e6 * j.T @ j, [0.5, 0.2, 0.1, 0.3])
    table = posterior_of(fit).table()
    read = Posterior.from_table(table, "fit.toml")
    np.testing.assert_array_equal(read.covariance, read.covariance.T)
    assert np.linalg.eigvalsh(read.covariance / np.outer(table["sd"], table["sd"]))[0] > -1e-14


def test_a_posterior_is_drawn_jointly_and_within_bounds(scene):
    names = ("led_1.power", "led_2.power", "membrane.sigma")
    sd, correlation = np.array([0.02, 0.03, 0.05]), np.array([[1, 0.9, 0], [0.9, 1, -0.3], [0, -0.3, 1]])
    mean = np.array([1.0, 2.0, 0.0])  # a roughness that was found at its bound: half of its draws are refused
    posterior = Posterior(names, tuple((n,) for n in names), mean, correlation * np.outer(sd, sd))
    made = job(fit="study", scene=None, posterior=True, per_unit=2)
    draws = Draws(made, scene, {}, FILE, posterior, {"led_2.power": 0.5})
    found = np.array([[draws.at(i)[n] for n in names] for i in range(0, 4000, 2)])
    assert (np.array(list(draws.at(1).values())) == found[0]).all() and len(np.unique(found[:, 0])) == 2000
    powers = found[:, :2] / [1.0, 0.5]
    # a cut of the third bends the others through their correlation with it: the second by -0.3 sd sqrt(2/pi)
    expected = mean[:2] - [0, 0.3 * 0.03 * math.sqrt(2 / math.pi)]
    assert np.abs(powers.mean(0) - expected).max() < 4 * 0.03 / math.sqrt(2000)
    bent = 0.9 / math.sqrt(1 - 0.3**2 * 2 / math.pi)  # ... and takes 2/pi of what the third gave to its variance
    assert np.corrcoef(powers.T)[0, 1] == pytest.approx(bent, abs=4 * (1 - bent**2) / math.sqrt(2000))
    assert found[:, 2].min() >= 0 and stats.kstest(found[:, 2], stats.halfnorm(scale=0.05).cdf).pvalue > 1e-3
    some = Draws(
        job(fit="s", scene=None, posterior=["led_*"], unit={"led_2.power": {"normal": [1.0, 0.1]}}),
        scene,
        {},
        FILE,
        posterior,
    )
    assert set(some.at(0)) == {"led_1.power", "led_2.power"} and some.posterior.names == ("led_1.power",)
    with pytest.raises(UnknownKey, match="unknown variable 'lamp"):
        Draws(made.model_copy(update={"posterior": ["lamp*"]}), scene, {}, FILE, posterior)
    every = job(fit="s", scene=None, posterior=["led_2*"], unit={"led_2.power": {"normal": [1.0, 0.1]}})
    with pytest.raises(BadJob, match="sets or draws every value itself; leave posterior out"):
        Draws(every, scene, {}, FILE, posterior)
    outside = replace(posterior, mean=np.array([1.0, 2.0, -1.0]))
    with pytest.raises(BadJob, match="most often outside is membrane.sigma; leave it out"):
        Draws(made, scene, {}, FILE, outside).at(0)
