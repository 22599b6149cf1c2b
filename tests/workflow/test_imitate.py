"""Captures as a model would take them: the command line from a study to what an effect would look like, and that the
loop finds it."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from optics.captures import capture_set as capture_files
from optics.cli import app
from optics.proof import demo
from optics.proof.rigs import bench as readings
from optics.proof.rigs import touch
from optics.scene import loader as scenes
from optics.study import loop

SIZE = {"width": "40", "height": "30"}


@pytest.fixture(scope="module")
def study(tmp_path_factory, mitsuba):
    folder = tmp_path_factory.mktemp("imitate")
    scene = scenes.load("digit", SIZE)
    built = {**demo.truth(scene, 1), "camera.exposure": 700.0}
    everything = dict.fromkeys(scene.leds, 1.0)
    shots = [
        touch.Shot(f"press{k}", f"press-{k}", at, everything)
        for k, at in enumerate([(-1.5, 1.0, 0.5), (1.0, -1.5, 0.6), (0.5, 2.0, 0.7)])
    ]
    capture_files.write(touch.Wild(scene, built, spp=64).shoot(shots, "digit"), folder / "captures", bits=16)
    setup = loop.Setup(
        captures=str(folder / "captures"),
        free=["led_*.power", "membrane.sigma"],
        per_group=[],
        held_out=["press-1"],
        values={k: v for k, v in built.items() if k != "camera.exposure"},
    )
    loop.begin(setup, folder / "study")
    return folder / "study"


@pytest.mark.slow
def test_imitated_captures_are_the_models_own_with_the_cameras_noise(study, tmp_path):
    runner = CliRunner()
    said = runner.invoke(app, ["imitate", str(study), "-o", str(tmp_path / "plain")])
    assert said.exit_code == 0 and "optics calibrate" in said.output, said.output
    runner.invoke(app, ["imitate", str(study), "-o", str(tmp_path / "glare"), "--set", "camera.glare=0.05"])
    found, model, _ = loop.take_up(study)
    values = loop.kept(found, model)[1]
    plain, glare = capture_files.load(tmp_path / "plain"), capture_files.load(tmp_path / "glare")
    assert [f.parameters for f in plain.frames] == [f.parameters for f in model.captures.frames]
    for index, (frame, other) in enumerate(zip(plain.frames, glare.frames)):
        use = model.usable(index)
        prediction = model.predict(values, [index])[0]
        z = ((frame.image - prediction) / model.noise.sd(prediction))[use]
        assert abs(np.mean(z**2) - 1) < 6 * np.sqrt(2 / z.size) and abs(z.mean()) < 6 / np.sqrt(z.size)  # six sd
        assert ((other.image - frame.image) / model.noise.sd(prediction))[use].std() > 2  # the glare is to be seen
    again = runner.invoke(app, ["imitate", str(study), "-o", str(tmp_path / "glare")])
    assert again.exit_code != 0 and "exists" in str(again.exception)


@pytest.mark.slow
def test_an_effect_is_put_into_the_measured_images(study, tmp_path):
    """They change by what the model's images change, and by nothing else; what is known of their noise stays."""
    record, model, _ = loop.take_up(study)
    advice = model.captures.folder / "import.json"
    advice.write_text('{"setup": {"region": "all"}}', encoding="utf-8")
    said = CliRunner().invoke(
        app, ["imitate", str(study), "-o", str(tmp_path / "out"), "--set", "camera.glare=0.05", "--into-captures"]
    )
    advice.unlink()
    assert said.exit_code == 0, said.output
    assert "all" in (tmp_path / "out" / "import.json").read_text(encoding="utf-8")
    values = loop.kept(record, model)[1]
    glaring = values.copy()
    glaring.common["camera.glare"] = 0.05
    changes = [b - a for a, b in zip(model.predict(values), model.predict(glaring))]
    injected = capture_files.load(tmp_path / "out")
    for index, (frame, change) in enumerate(zip(injected.frames, changes)):
        measured, use = model.frames[index].image, model.usable(index)
        # float32 of some 4000 DN, twice
        assert np.abs(np.where(use, frame.image - measured - change, 0)).max() < 1e-3 < np.abs(change).max() / 1000
    signal = np.linspace(70, 4000, 50)[:, None, None] * np.ones((1, 1, 3))
    assert np.allclose(injected.noise.variance(signal), model.noise.variance(signal), rtol=1e-6)
    said = CliRunner().invoke(app, ["imitate", str(study), "-o", str(tmp_path / "same"), "--into-captures"])
    assert said.exit_code != 0 and "none of the images would change" in str(said.exception)


@pytest.mark.slow
def test_a_rehearsal_from_the_command_line(study):
    said = CliRunner().invoke(app, ["rehearse", str(study), "--change", "1", "--json"])
    assert said.exit_code == 0, said.output
    found = json.loads(said.output[said.output.index("{") :])
    shares = {r["effect"]: r["named"] for r in found["rows"]}
    assert found["change"] == 0.01 and shares["colour crosstalk"] > 0.9  # three LEDs of three colours
    assert all(0 <= v <= 1 for v in shares.values())


def test_readings_are_not_imitated(tmp_path):
    bench = readings.Bench()
    capture_files.write(readings.sweep(bench.light({}), bench.settings()[:100], 1), tmp_path / "captures")
    loop.begin(bench.setup(tmp_path / "captures", 1), tmp_path / "study")
    said = CliRunner().invoke(app, ["imitate", str(tmp_path / "study"), "-o", str(tmp_path / "out")])
    assert said.exit_code != 0 and "readings in a table cannot be imitated" in str(said.exception)
