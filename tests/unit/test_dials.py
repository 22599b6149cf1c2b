"""Errors of dials that nobody states: found by their likelihood, and not mistaken for effects, nor effects for them."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from optics.diagnosis.dials import LOOSE, Products, most_likely
from optics.diagnosis.dials_at_extinction import width_in
from optics.diagnosis.session import _whitening
from optics.diagnosis.thresholds import EACH

COUNT = 72
DIAL = np.linspace(-90.0, 85.0, COUNT)
LIGHT = np.cos(np.radians(DIAL)) ** 2
NOISE = 0.002
SLOPE = -np.sin(2 * np.radians(DIAL)) * np.radians(1) / NOISE  # whitened, per deg
FITTED = np.column_stack([LIGHT, np.ones(COUNT)]) / NOISE
WOBBLES = np.column_stack([LIGHT * np.cos(np.radians(DIAL)), LIGHT * np.sin(np.radians(DIAL))]) * 0.05 / NOISE
BESIDE = LOOSE * WOBBLES


def products(residual, errors=None):
    return Products.of(np.column_stack([FITTED, BESIDE, np.diag(SLOPE) if errors is None else errors]), residual)


def drawn(rng, sd, hidden=0.0):
    """Whitened readings of a bench whose dial is sd off at every setting, with a wobble of so many plausible sizes."""
    turned = LIGHT + SLOPE * NOISE * sd * rng.standard_normal(COUNT)
    return (turned - LIGHT) / NOISE + rng.standard_normal(COUNT) + hidden * WOBBLES[:, 0]


@pytest.mark.parametrize("hidden", [0.0, 5.0])
def test_the_error_of_dials_is_found_whatever_acts_besides(hidden):
    """Of 72 settings a width is known to 1/sqrt(2 x 72), 8 %; 40 benches bring that to 1.3 %."""
    rng = np.random.default_rng(1)
    found = [most_likely([products(drawn(rng, 0.5, hidden)).likelihood(2, 4)]) for _ in range(40)]
    sds = np.array([f.sd for f in found])
    assert np.mean(sds) == pytest.approx(0.5, rel=0.05) and np.std(sds) < 0.08
    assert np.mean([f.low <= 0.5 <= f.high for f in found]) > 0.5  # 68 % of intervals of one sd


def test_exact_dials_have_none():
    """Chance brings NOTED on one of six benches (it has one side only, and a larger noise is a rival); the width is
    a third of what the readings could not miss."""
    rng = np.random.default_rng(2)
    found = [f for _ in range(100) if (f := most_likely([products(drawn(rng, 0.0)).likelihood(2, 4)])) is not None]
    assert len(found) < 30 and all(f.sd < 0.15 for f in found)


def test_noise_that_is_stated_too_small_is_no_dial_error():
    """Three times the noise, everywhere alike: dials would be silent at the turning points."""
    rng = np.random.default_rng(3)
    widths = [most_likely([products(3 * rng.standard_normal(COUNT)).likelihood(2, 4)]) for _ in range(40)]
    assert sum(w is not None and w.gain > 6 for w in widths) <= 2


def test_images_that_dwarf_the_noise_change_no_width():
    """Three leaks that are alike and 1e9 times as large as noise, as behind crossed films whose model is dark: rounding
    leaves of their differences what has no sign. The width is that of a bench with one of them."""
    rng = np.random.default_rng(5)
    residual = drawn(rng, 0.5)
    leak = (LIGHT**2)[:, None]
    one = np.column_stack([FITTED, leak, BESIDE, np.diag(SLOPE)])
    plain = most_likely([Products.of(one, residual).likelihood(2, 5)])
    for size in 10.0 ** np.arange(3, 11):
        alike = size * leak * (1 + 1e-9 * rng.standard_normal((COUNT, 3)))
        found = most_likely(
            [Products.of(np.column_stack([FITTED, alike, BESIDE, np.diag(SLOPE)]), residual).likelihood(2, 7)]
        )
        assert found is not None and found.sd == pytest.approx(plain.sd, rel=0.1), size


def test_the_likelihood_is_that_of_the_covariance():
    """-2 ln L = r' P r + ln det V, restricted to what no fit touches, at the scale 1."""
    rng = np.random.default_rng(4)
    errors = np.zeros((COUNT, COUNT // 2))  # two readings at each setting
    errors[np.arange(COUNT), np.arange(COUNT) // 2] = SLOPE
    residual = errors @ (0.7 * rng.standard_normal(COUNT // 2)) + rng.standard_normal(COUNT)
    found = most_likely([products(residual, errors).likelihood(2, 4)])
    rest = np.linalg.qr(FITTED, mode="complete")[0][:, 2:]

    def minus_two_ln(width):
        v = rest.T @ (np.eye(COUNT) + BESIDE @ BESIDE.T + width**2 * errors @ errors.T) @ rest
        chi2 = rest.T @ residual @ np.linalg.solve(v, rest.T @ residual)
        scale = max(chi2 / len(v), 1.0)
        return chi2 / scale + len(v) * np.log(scale) + np.linalg.slogdet(v)[1], scale

    (best, scale), (none, _) = minus_two_ln(found.sd), minus_two_ln(0.0)
    assert scale == 1.0 and found.gain == pytest.approx(none - best, rel=1e-6)
    assert all(minus_two_ln(w)[0] >= best - 0.05 for w in (0.8 * found.sd, 1.2 * found.sd))


def test_readings_of_one_setting_are_whitened_by_what_they_share():
    """Two dials: one stays for all six readings, the other for three at a time; shares of the noise as they are
    weighed, so that the mean of n has the error of one setting."""
    rng = np.random.default_rng(5)
    shares = {"slow": rng.uniform(0.2, 0.6, 6), "fast": rng.uniform(0.2, 0.6, 6)}
    numbers = {"slow": np.zeros(6), "fast": np.repeat([0, 1], 3)}
    turn = _whitening(np.arange(6), shares, numbers, np.arange(6))
    own = np.diag(1 - shares["slow"] ** 2 - shares["fast"] ** 2)
    slow = np.outer(shares["slow"], shares["slow"]) / 6
    fast = np.outer(shares["fast"], shares["fast"]) / 3 * (numbers["fast"][:, None] == numbers["fast"])
    np.testing.assert_allclose(turn @ (own + slow + fast) @ turn.T, np.eye(6), atol=1e-12)


def test_stated_dials_are_not_asked():
    from optics.diagnosis.dials import unstated

    angle = SimpleNamespace(unit="deg", how="layer")
    frame = SimpleNamespace(parameters={"a.angle": 0.0, "c.angle": 0.0}, readings={"b.angle": np.arange(3.0)})
    other = SimpleNamespace(parameters={"a.angle": 5.0, "c.angle": 0.0}, readings={"b.angle": np.arange(3.0)})
    model = SimpleNamespace(
        renderer=SimpleNamespace(layered=True),
        frames=[frame, other],
        parameters=dict.fromkeys(("a.angle", "b.angle", "c.angle"), angle),
        stated_errors={"b.angle"},
    )
    assert unstated(model) == ["a.angle"]  # b is stated, c never turns


GAINS = np.diag(0.05 * LIGHT) / NOISE  # of plausible size, whitened


@pytest.mark.parametrize("gains, sd", [(0.0, 0.5), (0.2, 0.0)])
def test_a_gain_of_each_image_is_no_error_of_a_dial_nor_the_other_way_round(gains, sd):
    """Each image has one setting. Gains of 20 % would be errors of up to 20 deg, as none are made."""
    rng = np.random.default_rng(6)
    found = []
    for _ in range(20):
        residual = drawn(rng, sd) + gains * LIGHT / NOISE * rng.standard_normal(COUNT)
        images = Products.of(np.column_stack([FITTED, GAINS, np.diag(SLOPE)])[::2], residual[::2])
        found.append(most_likely([images.likelihood(2, 2, 2 + COUNT)]))
    if sd:
        assert np.mean([f.sd for f in found]) == pytest.approx(sd, rel=0.1)
    else:
        assert all(f is None or f.sd < 0.3 for f in found)


def test_effects_that_take_up_all_together_do_so_one_at_a_time():
    """Of twelve settings, as images have: twelve effects and a gain of each would take up any error together. One
    effect and the gains leave it in seven of ten; in the others the gains may be it as well."""
    rng = np.random.default_rng(7)
    few = slice(0, COUNT, 6)
    angle = np.radians(DIAL[few])
    waves = np.column_stack([f(n * angle) for n in range(1, 7) for f in (np.cos, np.sin)]) * 0.05 * LIGHT[few, None]
    gains, slope = np.diag(0.05 * LIGHT[few]) / NOISE, np.diag(SLOPE[few])
    together, each = [], []
    for _ in range(16):
        residual = SLOPE[few] * 0.5 * rng.standard_normal(12) + rng.standard_normal(12)
        whole = Products.of(np.column_stack([FITTED[few, :1], LOOSE * waves / NOISE, gains, slope]), residual)
        together.append(most_likely([whole.likelihood(1, 13, 25)]))
        own = [whole.of_columns([0, *kept, *range(13, 37)]) for kept in ([], *([i] for i in range(1, 13)))]
        each.append(
            most_likely([p.likelihood(1, 1 + bool(i), 13 + bool(i), EACH * bool(i)) for i, p in enumerate(own)])
        )
    assert sum(f is not None and 0.25 < f.sd < 1.0 for f in each) >= 8
    assert sum(f is not None for f in together) < 2


def ended(rng, width, zero, assumed=0.5, frames=9, told=400.0):
    """A calibration of photographs between crossed films, each of which tells the difference of two dials to 1/20 deg:
    both stand between it and their settings, as the assumed width has it."""
    variables, estimate, normal = [], [], np.zeros((2 * frames, 2 * frames))
    apart, prior = np.array([-1.0, 1.0]) / math.sqrt(2), np.eye(2) / assumed**2
    for f in range(frames):
        seen = apart @ (width * rng.standard_normal(2) + [0.0, zero]) + rng.standard_normal() / math.sqrt(told)
        information = told * np.outer(apart, apart) + prior
        normal[2 * f : 2 * f + 2, 2 * f : 2 * f + 2] = information
        estimate += list(np.linalg.solve(information, told * apart * seen))
        known = {"prior": (0.0, assumed), "precision": 1 / assumed**2, "parameter": SimpleNamespace(role="angle")}
        variables += [SimpleNamespace(keys=(key,), frames=(f,), **known) for key in ("polarizer", "analyzer")]
    return SimpleNamespace(variables=variables, estimate=np.array(estimate), normal=SimpleNamespace(a=normal))


@pytest.mark.parametrize("zero", [0.0, 3.0])
def test_between_crossed_films_the_width_follows_from_where_angles_end_and_no_zero_is_taken_for_it(zero):
    """Of nine differences a width is known to a quarter; of sixty sets its mean to a thirtieth. The prior draws it down
    by a tenth."""
    rng = np.random.default_rng(0)
    found = [width_in(ended(rng, 0.6, zero)).sd for _ in range(60)]
    assert 0.85 < np.mean(found) / 0.6 < 1.02
    assert np.std(found) / 0.6 < 0.28


def test_exact_dials_between_crossed_films_have_no_width():
    """Chance brings twice the log likelihood of one exact bench in six above 1, and a width of a tenth of a degree."""
    rng = np.random.default_rng(1)
    found = [width_in(ended(rng, 0.0, 1.0)) for _ in range(60)]
    assert sum(w is not None for w in found) < 20
    assert all(w.sd < 0.1 for w in found if w is not None)
