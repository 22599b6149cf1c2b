"""Noise that neighbouring readings share: its likelihood is that of the covariance, its numbers are found, and slow
curves owe it most of their significance."""

import numpy as np
import pytest

from optics.diagnosis.correlation import FEWEST, KINDS, LENGTHS, MOST, NOTED, NOTICED, Readings, powers

COUNT = 160
TURN = np.linspace(0, 2 * np.pi, COUNT)
SIGNAL = 150 * np.cos(TURN) ** 2  # noise of 1 %
LOADS = {"amplifier": np.ones(COUNT), "lamp": SIGNAL}
FITTED = np.column_stack([SIGNAL, np.ones(COUNT)])


def covariance(power, length, kind, order=None):
    """V, as the module writes it."""
    order = np.arange(COUNT) if order is None else order
    load = SIGNAL / np.sqrt(np.mean(SIGNAL**2)) if kind == "lamp" else np.ones(COUNT)
    return np.eye(COUNT) + power * np.outer(load, load) * np.exp(-np.abs(order[:, None] - order) / length)


def drawn(rng, power, length, kind):
    return np.linalg.cholesky(covariance(power, length, kind)) @ rng.standard_normal(COUNT)


def about(residual, fitted=FITTED, order=None):
    """Readings about a fit, in whatever order."""
    order = np.arange(COUNT) if order is None else order
    basis = np.linalg.qr(fitted)[0]
    return Readings(residual - basis @ (basis.T @ residual), fitted, order, LOADS)


def test_the_filter_gives_the_likelihood_of_the_covariance():
    """r'(V^-1 - V^-1 X (X'V^-1 X)^-1 X'V^-1) r + ln det V, for gaps in the numbering and readings of one moment."""
    rng = np.random.default_rng(1)
    order = np.sort(rng.integers(0, 300, COUNT))
    shuffled = rng.permutation(COUNT)
    residual = rng.standard_normal(COUNT)
    basis = np.linalg.qr(FITTED)[0]
    residual = residual - basis @ (basis.T @ residual)
    found = Readings(residual[shuffled], FITTED[shuffled], order[shuffled], {k: v[shuffled] for k, v in LOADS.items()})
    for kind, left, logs, determinant in found.shared:
        for i in (3, len(left) // 2, len(left) - 5):
            v = covariance(found.power[i], found.length[i], kind, order)
            inverse = np.linalg.inv(v)
            normal = basis.T @ inverse @ basis
            fit = np.linalg.solve(normal, basis.T @ inverse @ residual)
            rest = residual - basis @ fit
            assert left[i] == pytest.approx(rest @ inverse @ rest, rel=1e-9)
            assert logs[i] == pytest.approx(np.linalg.slogdet(v)[1], rel=1e-9)
            assert determinant[i] == pytest.approx(np.linalg.slogdet(normal)[1], abs=1e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_power_length_and_kind_are_found(kind):
    rng = np.random.default_rng(2)
    found = [about(drawn(rng, 2.0, 8.0, kind)).correlation() for _ in range(20)]
    assert np.mean([c.kind == kind for c in found]) >= 0.9
    assert np.median([c.scale for c in found]) == pytest.approx(1, abs=0.15)
    # a grid in steps of 2.5 and 1.9
    assert 0.8 < np.median([c.power for c in found]) < 5 and 3 < np.median([c.length for c in found]) < 16


def test_white_noise_is_left_alone():
    """NOTED, twice the log likelihood, for three numbers of two kinds."""
    rng = np.random.default_rng(3)
    found = [about(rng.standard_normal(COUNT)) for _ in range(60)]
    assert np.mean([f.correlation().power > 0 for f in found]) <= 0.15
    white = [f.white for f in found]
    assert [f.deviance(1.0) for f in found] == pytest.approx(white, abs=2 * NOTED)


def test_a_slow_curve_is_worth_little_beside_a_lamp_that_wanders():
    """What a wobble's two strengths gain of chi2 is ten times what noise is allowed; of deviance it is what independent
    noise would give them."""
    rng = np.random.default_rng(4)
    wobble = np.column_stack([FITTED, SIGNAL * np.sin(TURN / 2), SIGNAL * np.cos(TURN / 2)])
    falls = []
    for _ in range(30):
        noise = drawn(rng, 3.0, 20.0, "lamp")
        plain, with_it = about(noise), about(noise, wobble)
        falls.append((plain.white - with_it.white, plain.deviance(1.0) - with_it.deviance(1.0)))
    chi2, deviance = np.mean(falls, 0)
    assert chi2 > 40 and deviance < 8


def test_a_sharp_curve_keeps_its_significance_beside_a_lamp_that_wanders():
    rng = np.random.default_rng(5)
    sharp = np.where(np.arange(COUNT) % 2, 1.0, -1.0)
    noise = drawn(rng, 3.0, 20.0, "lamp") + sharp
    fall = about(noise).deviance(1.0) - about(noise, np.column_stack([FITTED, sharp])).deviance(1.0)
    assert fall == pytest.approx(COUNT, rel=0.25)


def test_of_few_readings_no_correlation_is_asked():
    few = FEWEST + 1
    readings = Readings(np.ones(few), FITTED[:few], np.arange(few), {k: v[:few] for k, v in LOADS.items()})
    assert not readings.shared and readings.correlation().power == 0
    many = FEWEST + 2
    assert (
        len(Readings(TURN[:many], FITTED[:many], np.arange(many), {k: v[:many] for k, v in LOADS.items()}).length)
        % LENGTHS
        == 0
    )


def test_what_shares_nothing_counts_beside():
    """Values that no lamp moves, given by their products alone: the likelihood of both together."""
    rng = np.random.default_rng(6)
    more = rng.standard_normal((50, 2))
    residual, further = drawn(rng, 2.0, 8.0, "lamp"), rng.standard_normal(50)
    columns = np.column_stack([more, further])
    found = Readings(residual, FITTED, np.arange(COUNT), LOADS, columns.T @ columns, 50)
    whole, rest = np.vstack([FITTED, more]), np.concatenate([residual, further])
    fit = np.linalg.lstsq(whole, rest, rcond=None)[0]
    assert found.white == pytest.approx(np.sum((rest - whole @ fit) ** 2), rel=1e-9)
    kind, left, logs, _ = found.shared[1]
    i = len(left) // 2
    v = np.eye(COUNT + 50)
    v[:COUNT, :COUNT] = covariance(found.power[i], found.length[i], kind)
    inverse = np.linalg.inv(v)
    fit = np.linalg.solve(whole.T @ inverse @ whole, whole.T @ inverse @ rest)
    assert left[i] == pytest.approx((rest - whole @ fit) @ inverse @ (rest - whole @ fit), rel=1e-8)
    assert logs[i] == pytest.approx(np.linalg.slogdet(v)[1], rel=1e-9)


def test_what_is_known_beforehand_is_one_more_noise():
    """Of dials with the images K, known to P: the likelihood is that of V + K P^-1 K', to a constant."""
    rng = np.random.default_rng(7)
    dials, precision = np.zeros((COUNT, 4)), np.array([1.0, 4.0, 0.25, 9.0])
    dials[np.arange(COUNT), np.arange(COUNT) % 4] = rng.uniform(5, 20, COUNT)
    residual = drawn(rng, 2.0, 8.0, "lamp")
    beside = np.zeros((5, 5))
    beside[range(4), range(4)] = precision
    found = Readings(residual, dials, np.arange(COUNT), LOADS, beside, 4, known=np.arange(4))

    def deviance(v):
        v = v + (dials / precision) @ dials.T
        return residual @ np.linalg.solve(v, residual) + np.linalg.slogdet(v)[1]

    without = deviance(np.eye(COUNT)) - found.white
    for kind, left, logs, _ in found.shared:
        for i in (3, len(left) // 2, len(left) - 5):
            expected = deviance(covariance(found.power[i], found.length[i], kind))
            assert left[i] + logs[i] == pytest.approx(expected - without, abs=1e-6)


def test_a_usual_wander_is_tried_whatever_the_noise_of_a_reading():
    """The mean of a photograph has 1e3 times less noise than a reading: 3 % of its signal are 1e3 times more of it."""
    for bright in (1.0, 1e4, 5e6):
        tried = powers(bright)
        assert tried[-1] >= max(MOST, NOTICED**2 * bright) * (1 - 1e-9)
        assert np.diff(np.log10(tried)) == pytest.approx(0.4, abs=1e-9)
