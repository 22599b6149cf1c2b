"""Derivatives while light is reflected twice: what the second reflection brings changes with lights and coat too."""

import numpy as np
import pytest

from optics.light import renderer

KEYS = ["led_1.x", "membrane.rho_r", "membrane.sigma", "gel.absorption"]


def compared(bench, key):
    """(rms of the derivative image without the second reflection, of the derivative image itself) less a central
    difference of the prediction, of another step; over the rms of that difference. A light that moves crosses rims:
    without the 2 % of the pixels that differ most."""
    p = bench.scene.parameters[key]
    base = {**bench.values, "gel.press_depth": 1.2, "integrator.interreflection": 3.0}
    base |= {"membrane.sigma": 0.1, "gel.absorption": 0.05}
    step = 0.5 * p.step * p.plausible
    above, below = (bench.image({**base, key: base[key] + s * step}) for s in (1, -1))
    wanted = (above - below) / (2 * step)
    found = bench.derivative(key, base)
    smooth = np.abs(wanted - found) < np.quantile(np.abs(wanted - found), 0.98)
    scale = np.sqrt(np.mean(wanted[smooth] ** 2))
    alone = bench.derivative(key, {**base, "integrator.interreflection": 0.0})
    return [np.sqrt(np.mean((x - wanted)[smooth] ** 2)) / scale for x in (alone, found)]


@pytest.mark.slow
@pytest.mark.parametrize("key", KEYS)
def test_derivatives_with_a_second_reflection(key, bench, monkeypatch):
    """With the directions of the prediction. What is left is the curvature over half a step: at most 1.6e-4 of the
    derivative (LED place, roughness). Without the second reflection's part the derivative is off by .03 to .07."""
    monkeypatch.setattr(renderer, "ROUGHLY", 1)
    alone, off = compared(bench, key)
    assert off < 5e-4
    assert alone > 0.03


@pytest.mark.slow
def test_fewer_directions_leave_little_error(bench):
    """Of derivatives, with a second reflection three times as strong as physics allows: the noise of a quarter of the
    directions, 0.055 of what leaving the second reflection out would bring; twice that is allowed."""
    alone, off = compared(bench, "membrane.sigma")
    assert off < 0.11 * alone


@pytest.mark.parametrize("seed, share, rough", [(0, 0.0, False), (1001, 0.0, True), (1001, 0.5, False)])
def test_a_ranking_asks_for_fewer_directions(seed, share, rough, bench, monkeypatch):
    """With a seed of its own, of light that the model does not have yet; a fit has those of its predictions."""
    asked, key = [], "integrator.interreflection"

    def bounced(values, led, seed, component, roughly):
        asked.append(roughly)
        return np.zeros((1, 1, 3))

    monkeypatch.setattr(bench.model.renderer, "bounced", bounced)
    bench.model._component_tangent({**bench.values, key: share}, key, 1.0, seed, False, 0)
    assert asked and set(asked) == {rough}
