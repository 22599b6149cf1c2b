"""Photographs between films that stand parallel and crossed, where the light stands still as a film turns, under a lamp
whose power changes from frame to frame: a linearisation sees next to nothing of the films' angles there, and asks for
steps that no angle can make."""

import numpy as np
import pytest

from optics.fit.curvature import own_curvature
from optics.fit.descent import Descent, normal_equations
from optics.fit.model import value_of
from optics.proof.cells import Cell
from optics.proof.rigs import RIGS
from optics.study import loop

DIAL = 0.7  # deg: how well dials are set
DRIFT = 0.03  # of the lamp, from frame to frame


def frames(rng):
    """(light, settings): cos^2 of the angle between two films, the second of which turns."""
    for apart in [0.0, 90.0, 45.0] * 4:
        between = apart + DIAL * rng.standard_normal()
        light = 50000.0 * (1 + DRIFT * rng.standard_normal()) * (np.cos(np.radians(between)) ** 2 + 2e-4)
        yield light, {"analyzer.angle": apart}


HEAD = ('[parameters]\n"camera.x_fov" = 4.0\n"polarizer.angle" = 0.0', f'[uncertainty]\n"analyzer.angle" = {DIAL}')


@pytest.mark.slow
def test_curvature_of_angles_against_chi2(mitsuba, between_films, tmp_path):
    rng = np.random.default_rng(5)
    setup = loop.Setup(captures=str(between_films(tmp_path / "set", frames(rng), HEAD, rng)), free=["source.power"])
    _, model, fit = loop.begin(setup, tmp_path / "study")
    assert fit.converged, fit.reason
    angles = [i for i, v in enumerate(fit.variables) if v.keys == ("analyzer.angle",)]
    assert angles
    fitted = list(fit.frames)
    bend = own_curvature(model, fit.variables, fit.values, fitted)
    assert (bend[angles] > 0).any() and not np.delete(bend, angles).any()

    # against chi2 itself, with the weights held: J'WJ + bend is half its second difference
    normal = normal_equations(model, fit.variables, fit.values, fitted)
    weight = {f: 1 / model.variance(fit.values, f, p) for f, p in zip(fitted, model.predict(fit.values, fitted))}

    def misfit(values):
        pairs = zip(fitted, model.predict(values, fitted))
        return sum(float(np.sum(((model.frames[f].image - p) ** 2 * weight[f])[model.usable(f)])) for f, p in pairs)

    for i in angles:
        v, h = fit.variables[i], 0.1
        sides = []
        for by in (-h, h):
            moved = fit.values.copy()
            moved.put(v, value_of(model, moved, v) + by)
            sides.append(misfit(moved))
        second = (sides[0] - 2 * misfit(fit.values) + sides[1]) / (2 * h**2)
        known = second - (normal.a[i, i] - v.precision)
        # f'''' of cos^2 changes the second difference of half a degree by 1e-4, derivative images are single precision
        assert np.isclose(bend[i], max(known, 0.0), atol=2e-3 * abs(second)), (v.name, bend[i], known)


@pytest.mark.slow
def test_what_is_promised_there_is_what_steps_bring(mitsuba, tmp_path):
    """A sheet turned between films under a lamp that drifts and a camera whose curve bends: with J'WJ alone the sheet
    is asked to turn by 5.5 deg for a fall of 108, no step brings any of it, and the base is refused."""
    rig = RIGS["photographs"]()
    cell = Cell("photographs", "library", ("camera gamma",), 0.0, 0.0, "other", "", 3003, 0.79)
    rig.make(tmp_path / "set", cell)
    setup = rig.setup(tmp_path / "set", cell.seed)
    _, model, fit = loop.begin(setup, tmp_path / "study")
    assert fit.converged, fit.reason
    descent = Descent(model, fit.variables, fit.values, list(fit.frames))
    total = descent.linearise().total
    promised, moved = descent.promised, descent.step(0.0)[0]
    assert promised < len(fit.variables)
    assert abs(descent._at(moved)[2].total - total + promised) < len(fit.variables)
