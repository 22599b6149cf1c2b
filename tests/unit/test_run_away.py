"""Powers that have run away from the others."""

from types import SimpleNamespace

import numpy as np
import pytest

from optics.fit.result import Fit
from optics.fit.run_away import powers_apart
from optics.scene.parameter import Parameter, Values, Variable

MODEL = SimpleNamespace(linear_in=lambda v: "power" in v.name)


def fit_of(sd, prior=None, **values):
    total, share = (
        Parameter("power", "1", 1.0, (0.0, 1e6)),
        Parameter("power_r", "1", 1.0, (0.0, 1e6), role="band power"),
    )
    variables = [Variable(name, (f"source.{name}",), share if "_" in name else total, prior=prior) for name in values]
    estimate, covariance = np.array(list(values.values())), np.diag(np.square(sd))
    return Fit(Values(), variables, estimate, covariance, 0.0, 1, [0], [0.0], [1], True, "")


def test_a_band_that_the_model_calls_dark_is_named():
    found = fit_of([380, 0.0075, 0.0027, 1e-5], power_r=39810.0, power_g=6.685, power_b=4.947, roughness=1e-4)
    assert powers_apart(MODEL, found) == "power_r 3.98e+04, 8e+03 times power_b"
    vague = fit_of([38, 0.0075, 0.4], power_r=39810.0, power_g=6.685, power_b=4.9)
    assert powers_apart(MODEL, vague) == "power_r 3.98e+04, 6e+03 times power_g"


@pytest.mark.parametrize(
    "found",
    [
        fit_of([0.9, 0.06, 0.01], power_r=90.0, power_g=6.0, power_b=1.0),  # bands differ
        fit_of([0.001, 0.0004], red_power_r=1.0, red_power_b=0.005),  # a red lamp, of which blue would come through
        fit_of([0.5, 1e-4, 1e-4], power=5000.0, power_g=1.0, power_b=0.8),  # all of it, and shares
        fit_of([380, 0.01], power=39810.0, roughness=0.1),  # of one power nobody knows the unit
        fit_of([2e4, 0.01], power_r=39810.0, power_g=6.0),  # images hardly tell of it
        fit_of([380, 0.01], prior=(3e4, 1e4), power_r=39810.0, power_g=6.0),  # somebody knows it
    ],
)
def test_powers_that_differ_or_are_known_have_not_run_away(found):
    assert powers_apart(MODEL, found) == ""
