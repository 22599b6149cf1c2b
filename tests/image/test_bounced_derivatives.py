"""Derivatives while light is reflected twice: what the second reflection brings changes with lights and coat too."""

import numpy as np
import pytest


@pytest.mark.parametrize("key", ["led_1.x", "membrane.rho_r", "membrane.sigma", "gel.absorption"])
def test_derivatives_with_a_second_reflection(key, bench):
    """Against central differences of the prediction, of another step, with the same second directions; without the
    second reflection's part the derivative is off by several times the tolerance."""
    p = bench.scene.parameters[key]
    base = {**bench.values, "gel.press_depth": 1.2, "integrator.interreflection": 3.0}
    base |= {"membrane.sigma": 0.1, "gel.absorption": 0.05}
    step = 0.5 * p.step * p.plausible
    above, below = (bench.image({**base, key: base[key] + s * step}) for s in (1, -1))
    wanted = (above - below) / (2 * step)
    found = bench.derivative(key, base)
    smooth = np.abs(wanted - found) < np.quantile(np.abs(wanted - found), 0.98)  # a light that moves crosses rims
    scale = np.sqrt(np.mean(wanted[smooth] ** 2))
    off = np.sqrt(np.mean((found - wanted)[smooth] ** 2)) / scale
    alone = bench.derivative(key, {**base, "integrator.interreflection": 0.0})
    assert off < 0.01
    assert np.sqrt(np.mean((alone - wanted)[smooth] ** 2)) / scale > 0.03
