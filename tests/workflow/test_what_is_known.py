"""Photographs between films that are turned together, by dials that are known to .7 deg: where the base misses
the images by much, what is written down of dials counts many times; beside the right effect it counts once."""

import numpy as np
import pytest

from optics.study import loop

OFF, DIAL = -7.5, 0.7  # deg: the analyser's zero, and how well dials are set
FIELD = 4.0  # deg, across


def frames(rng):
    """(light, settings): cos^2 of the angle between the films, which stand where no dial says."""
    for i, angle in enumerate(np.arange(0.0, 180.0, 20.0)):
        # crossed, and a third of them halfway, on either side: what tells the lamp's power, and the way the zero is off
        apart = 90.0 if i % 3 else 45.0 + 90.0 * (i % 2)
        between = apart + OFF + DIAL * (rng.standard_normal() - rng.standard_normal())
        light = 50000.0 * (np.cos(np.radians(between)) ** 2 + 2e-4)
        yield light, {"polarizer.angle": angle, "analyzer.angle": angle + apart}


HEAD = (
    f'[parameters]\n"camera.x_fov" = {FIELD}',
    f'[uncertainty]\n"polarizer.angle" = {DIAL}\n"analyzer.angle" = {DIAL}',
)


@pytest.mark.slow
def test_dials_stand_off_by_what_is_known_of_them(mitsuba, between_films, tmp_path):
    rng = np.random.default_rng(3)
    setup = loop.Setup(captures=str(between_films(tmp_path / "set", frames(rng), HEAD, rng)), free=["source.power"])
    record, model, fit = loop.begin(setup, tmp_path / "study")
    assert fit.tempering > 100  # the base misses the images by many times their noise
    found = loop.examine(record, model, setup, fit, advised=False)
    offset = found.fits["polarizer misalignment"]
    assert offset.tempering == 1.0
    assert offset.chi2 < offset.dof * (1 + 5 * np.sqrt(2 / offset.dof))
    between = {v.name: e for v, e in zip(offset.variables, offset.estimate)}
    turned = between.get("analyzer.offset", 0.0) - between.get("polarizer.offset", 0.0)
    # the mean of nine differences of two dials
    assert abs(turned - OFF) < 3 * DIAL * np.sqrt(2 / 9) and abs(turned) > 5
    assert any("that it counts once" in warning for warning in found.warnings)
    assert found.word in ("CLAIM", "AMBIGUOUS") and "polarizer misalignment" in {found.claimed, *found.ambiguous}
    # a diagnosis that was stopped goes on from the refits that it kept, and says the same
    again = loop.examine(record, model, setup, fit, advised=False)
    assert (again.word, again.claimed, again.ambiguous) == (found.word, found.claimed, found.ambiguous)
    assert any("that it counts once" in warning for warning in again.warnings)
