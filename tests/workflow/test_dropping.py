"""An effect that was added and is not the cause: the diagnosis that finds the cause says so, and it can be dropped."""

import numpy as np
import pytest

import optics
from optics.captures.noise import Noise
from optics.errors import UnknownKey
from optics.pages.view import View
from optics.proof.makers import bench as jones

LEAK, READINGS = 0.02, 96
NOISE = Noise(system_gain=0.05, dark_noise=2.0, black_level=64.0, saturation=4095.0, prnu=0.0)


@pytest.fixture(scope="module")
def astray(tmp_path_factory):
    """A study of films that leak, to which stray light was added: of a lamp at two powers."""
    folder = tmp_path_factory.mktemp("dropping")
    film = jones.Polarizer(leak=LEAK)
    truth = jones.Truth(photodiode=jones.Photodiode(gain=2.2), p1=film, p2=film)
    settings = [
        {"polarizer.angle": a, "analyzer.angle": 11.25 * i, "source.power": p}
        for a in (0.0, 60.0, 100.0)
        for p in (0.5, 1.0)
        for i in range(16)
    ]
    jones.write(folder / "captures", truth, settings, NOISE, 3)
    study = optics.calibrate(folder / "captures", folder / "study")
    study.add("stray light")
    return study


def test_an_effect_that_stood_in_for_another_is_named_and_dropped(astray):
    verdict = astray.diagnose(advised=False)
    assert verdict.ambiguous == ["extinction leak", "depolarization"], verdict.sentence  # one law, at every setting
    (told,) = [hint for hint in verdict.hints if "nothing is left of" in hint]
    best = verdict.explanations[0].effects[0]
    assert f"with {best} nothing is left of stray light, added before (camera.stray " in told
    assert f"optics add STUDY '{best}' --drop 'stray light'" in told
    found = astray.add("extinction leak", drop="stray light")
    assert astray.effects == ["extinction leak"] and "stray light" in [e.name for e in astray.candidates()]
    assert "camera.stray" not in {*found.values.common, *(v.name for v in found.variables)}
    assert astray.record.steps[-1]["fitted"]["chi2_per_dof"] == pytest.approx(1.0, abs=4 * np.sqrt(2 / READINGS))
    again = optics.Study.open(astray.folder)
    assert again.effects == ["extinction leak"] and "+ extinction leak without stray light" in again.table()
    assert again.record.added(1) == ["stray-light"] and again.record.added(0) == []
    assert again.fit.values.common == pytest.approx(found.values.common, rel=1e-6)
    assert View(astray.folder, step=1).step["name"] == "stray light"


def test_only_what_was_added_can_be_dropped(astray):
    with pytest.raises(ValueError, match="'camera gamma' is no part of the study.*allowed: "):
        astray.add("depolarization", drop=["camera gamma"])
    with pytest.raises(UnknownKey, match="stray lihgt"):
        astray.add("depolarization", drop=["stray lihgt"])
