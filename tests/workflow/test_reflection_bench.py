"""The reflection bench: readings of s and p light about Brewster's angle by Fresnel's formulas in plain numpy, through
the calibration and the loop."""

from pathlib import Path

import numpy as np
import pytest

from optics.captures import capture_set
from optics.captures.capture_set import Captures, Frame, Table
from optics.captures.noise import Noise
from optics.fit.model import value_of
from optics.study import loop

NOISE = Noise(0.05, 2.0, 64.0, 4095.0, 0.0)
INDEX, LAMP = 1.52, 3.0


def reflectances(theta, n=INDEX):
    """R_s, R_p at deg, by the laws of sine and tangent."""
    a = np.radians(np.maximum(theta, 1e-3))
    b = np.arcsin(np.sin(a) / n)
    return (np.sin(a - b) / np.sin(a + b)) ** 2, (np.tan(a - b) / np.tan(a + b)) ** 2


def reading(theta, before, behind, *, back=0.0, scatter=0.0, offset=0.0, power=LAMP):
    """DN of a lamp behind a film at `before` (90 s, 0 p), the plate, and a film at `behind` (None: out); T1 = 0.8."""
    r_s, r_p = (r + back * r * (1 - r) ** 2 / (1 - r * r) for r in reflectances(theta + offset))
    amplitudes = np.array([np.cos(np.radians(before)), np.sin(np.radians(before))])  # p, s
    p, s = (1 - scatter) * 0.8 * power / 2 * np.array([r_p, r_s]) * amplitudes**2
    dust = scatter * 0.8 * power / 2
    if behind is None:
        return 64 + (4095 - 64) * (p + s + dust)
    c, d = np.cos(np.radians(behind)) ** 2, np.sin(np.radians(behind)) ** 2
    return 64 + (4095 - 64) * 0.8 * (p * c + s * d + dust / 2)


def readings(seed, **hidden):
    """s and p light, and no film behind or one that is crossed, over the dial, at two powers of the lamp."""
    rng, frames = np.random.default_rng(seed), []
    for i, theta in enumerate(np.arange(8.0, 78.0, 1.0)):
        for before in (0.0, 90.0):
            for behind in (None, 90.0 - before):
                power = (1.0, 0.5)[i % 2]
                dn = reading(theta, before, behind, power=LAMP * power, **hidden)
                image = NOISE.expose(np.full((1, 1, 1), dn), rng).astype(np.float32)
                settings = {
                    "plate.incidence": theta,
                    "polarizer.angle": before,
                    "analyzer.angle": 0.0 if behind is None else behind,
                    "analyzer.inserted": float(behind is not None),
                    "source.power": power,
                }
                frames.append(Frame(f"{i}", image, parameters=settings))
    frames = [frames[i] for i in rng.permutation(len(frames))]  # as a careful experimenter would take them
    return Captures(Path("."), "reflection_bench", frames, {}, NOISE, table=Table("readings.csv", ["reading"]))


def study_of(folder, seed=3, **hidden):
    capture_set.write(readings(seed, **hidden), folder / "captures")
    setup = loop.Setup(captures=str(folder / "captures"))
    return (setup, *loop.begin(setup, folder / "study"))


def at_the_noise(chi2_per_dof, count):
    return abs(chi2_per_dof - 1) < 5 * np.sqrt(2 / count)  # five standard deviations of the mean, 1


@pytest.mark.slow
def test_a_calibration_finds_the_index_from_brewsters_minimum(tmp_path):
    setup, study, model, fit = study_of(tmp_path)
    found = {v.name: (value_of(model, fit.values, v), sd) for v, sd in zip(fit.variables, fit.sd)}
    for name, truth in (("plate.index", INDEX), ("source.power", LAMP)):
        assert abs(found[name][0] - truth) < 4 * found[name][1] and found[name][1] < 0.01 * truth
    assert at_the_noise(fit.chi2 / fit.dof, fit.dof)
    assert loop.examine(study, model, setup, fit, advised=False).word == "NOTHING"


@pytest.mark.slow
@pytest.mark.parametrize(
    "effect, hidden, key, strength",
    [
        pytest.param("back-face reflection", {"back": 0.4}, "plate.back_face", 0.4, marks=pytest.mark.slow),
        ("surface scattering", {"scatter": 4e-3}, "plate.scatter", 4e-3),
        ("incidence misalignment", {"offset": -1.0}, "plate.incidence_offset", -1.0),
    ],
)
def test_what_the_plate_does_besides_is_found(effect, hidden, key, strength, tmp_path):
    """Named, alone or among what looks alike; added, its strength is the truth and readings fall to the noise."""
    setup, study, model, fit = study_of(tmp_path, **hidden)
    diagnosis = loop.examine(study, model, setup, fit, advised=False)
    assert effect == diagnosis.missing or effect in diagnosis.ambiguous, diagnosis.sentence
    fit, _ = loop.extend(study, model, setup, fit, model.scene.registry.find_effect(effect))
    variable = next(i for i, v in enumerate(fit.variables) if v.name == key)
    found = value_of(model, fit.values, fit.variables[variable])
    assert abs(found - strength) < 4 * fit.sd[variable]
    assert at_the_noise(fit.chi2 / fit.dof, fit.dof)
