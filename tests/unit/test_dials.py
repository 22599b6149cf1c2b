"""Errors of dials that nobody states: found by their likelihood, and not mistaken for effects, nor effects for them."""

from types import SimpleNamespace

import numpy as np
import pytest

from optics.diagnosis.dials import LOOSE, Products
from optics.diagnosis.session import _whitening

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
    found = [products(drawn(rng, 0.5, hidden)).most_likely(2, 4) for _ in range(40)]
    sds = np.array([f.sd for f in found])
    assert np.mean(sds) == pytest.approx(0.5, rel=0.05) and np.std(sds) < 0.08
    assert np.mean([f.low <= 0.5 <= f.high for f in found]) > 0.5  # 68 % of intervals of one sd


def test_exact_dials_have_none():
    """Chance brings NOTED on one of six benches (it has one side only, and a larger noise is a rival); the width is
    a third of what the readings could not miss."""
    rng = np.random.default_rng(2)
    found = [f for _ in range(100) if (f := products(drawn(rng, 0.0)).most_likely(2, 4)) is not None]
    assert len(found) < 30 and all(f.sd < 0.15 for f in found)


def test_noise_that_is_stated_too_small_is_no_dial_error():
    """Three times the noise, everywhere alike: dials would be silent at the turning points."""
    rng = np.random.default_rng(3)
    widths = [products(3 * rng.standard_normal(COUNT)).most_likely(2, 4) for _ in range(40)]
    assert sum(w is not None and w.gain > 6 for w in widths) <= 2


def test_images_that_dwarf_the_noise_change_no_width():
    """Three leaks that are alike and 1e9 times as large as noise, as behind crossed films whose model is dark: rounding
    leaves of their differences what has no sign. The width is that of a bench with one of them."""
    rng = np.random.default_rng(5)
    residual = drawn(rng, 0.5)
    leak = (LIGHT**2)[:, None]
    one = np.column_stack([FITTED, leak, BESIDE, np.diag(SLOPE)])
    plain = Products.of(one, residual).most_likely(2, 5)
    for size in 10.0 ** np.arange(3, 11):
        alike = size * leak * (1 + 1e-9 * rng.standard_normal((COUNT, 3)))
        found = Products.of(np.column_stack([FITTED, alike, BESIDE, np.diag(SLOPE)]), residual).most_likely(2, 7)
        assert found is not None and found.sd == pytest.approx(plain.sd, rel=0.1), size


def test_the_likelihood_is_that_of_the_covariance():
    """-2 ln L = r' P r + ln det V, restricted to what no fit touches, at the scale 1."""
    rng = np.random.default_rng(4)
    errors = np.zeros((COUNT, COUNT // 2))  # two readings at each setting
    errors[np.arange(COUNT), np.arange(COUNT) // 2] = SLOPE
    residual = errors @ (0.7 * rng.standard_normal(COUNT // 2)) + rng.standard_normal(COUNT)
    found = products(residual, errors).most_likely(2, 4)
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
