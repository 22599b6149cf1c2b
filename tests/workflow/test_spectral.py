"""A shift of all LEDs' wavelengths, hidden in a DIGIT whose channels are integrals, is found blind."""

from pathlib import Path

import numpy as np
import pytest

import optics
from optics.captures import capture_set
from optics.captures.noise import Noise
from optics.light.rendering import RenderJob
from optics.scene import loader

SIZE = {"width": "48", "height": "64"}
SHIFT = 3.0  # nm
PRESSES = ((-2.0, 1.0, 0.5), (2.0, -1.0, 0.6), (1.0, 4.0, 0.4), (-1.0, -4.0, 0.5))


@pytest.mark.slow
def test_a_hidden_shift_of_wavelengths_is_claimed(mitsuba, tmp_path):
    """With paint that is known: where all of rho_r, rho_g and rho_b are free, they can stand in for a part of it."""
    scene = loader.load("digit", {**SIZE, "bands": "auto"})
    hidden = {key: SHIFT for key in scene.parameters if key.endswith(".centre_shift")}
    noise, rng = Noise(0.02, 1.0, 4.0, 255.0, 0.0), np.random.default_rng(0)
    job, frames = RenderJob(scene, black=4.0), []
    for k, press in enumerate(PRESSES):
        values = dict(zip(("gel.press_x", "gel.press_y", "gel.press_depth"), press))
        image = np.clip(noise.expose(job.take({**values, **hidden}).camera, rng), 0, 255).astype(np.float32)
        frames.append(capture_set.Frame(f"p{k}", image, group=f"press-{k}", parameters=values))
    captures = capture_set.Captures(Path("."), "digit", frames, {}, noise, bands="auto")
    folder = capture_set.write(captures, tmp_path / "set", bits=8)
    paint = {f"membrane.rho_{c}": (0.6, 0.01) for c in "rgb"}
    study = optics.calibrate(folder, tmp_path / "study", defines=SIZE, priors=paint)
    found = study.diagnose()
    assert found.word == "CLAIM" and found.claimed == "LED centre shift"
    (row,) = [r for r in found.rows if r.name == "LED centre shift"]
    assert row.refit.strength[0] == pytest.approx(SHIFT, abs=4 * row.refit.sd[0])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gelsight", "digit", "vi2tap"])
def test_auto_bands_cost_little_more_than_fixed_ones(mitsuba, name):
    """Processor time of an image at another press; the targets are those of `make bench`. A tenth more is allowed for
    other work on the machine."""
    from optics.proof.speed import SPECTRAL, spectral_cost

    fixed, auto, _ = spectral_cost(name)
    assert auto / fixed < 1.1 * SPECTRAL[name][2], (auto, fixed)
