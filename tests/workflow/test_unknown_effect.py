"""The tutorial of an effect that the library lacks, executed: puzzling residual, curve, table, formula, noise floor."""

import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]


def test_the_formula_is_what_the_maker_does_to_rows(tmp_path):
    """The ripple integrated over each row's exposure, by the maker, against the formula that the tutorial fills into
    the stub."""
    from optics.captures.noise import Noise
    from optics.scene.registry import declared
    from optics.study.draft import new_effect, write

    story = runpy.run_path(str(ROOT / "examples" / "unknown_effect.py"))
    height, width = 48, 6
    maker = object.__new__(story["RollingShutter"])
    maker.values, maker.camera, maker.size = {"camera.x_fov": 40.0, "camera.exposure": 1.0}, "camera", (width, height)
    maker.effects, maker.seed, maker.frames_summed = {}, 0, 1
    maker.matrix, maker.noise = np.eye(3), Noise(1e-9, 0.0, 0.0, 1e9, 0.0)  # next to no noise and no rounding
    rows = maker.photograph(np.full((height, width, 3), 0.5), np.random.default_rng(0), 0)[:, 0, 0] / 0.5e9 - 1
    period = 1 / (story["HERTZ"] * story["LINE"])
    phase, amplitude = story["phase_of"](np.arange(height), rows, period)
    assert amplitude == pytest.approx(story["RIPPLE"] * np.sinc(story["HERTZ"] * story["OPEN"]), rel=1e-3)
    file = write(story["filled_in"](new_effect("shutter ripple", "lens"), phase), tmp_path, "shutter ripple")
    effect = declared(file)[0]
    for check in effect.checks:
        check()
    v, u = np.mgrid[:height, :width] + 0.5
    camera = SimpleNamespace(v=v, u=u, width=width, height=height, shutter_ripple=amplitude)
    assert effect.stages["lens"](np.ones((height, width, 3)), camera)[:, 0, 0] - 1 == pytest.approx(
        rows, abs=5e-5
    )  # phase to 3 digits


@pytest.mark.slow
def test_the_tutorial_goes_from_a_puzzling_residual_to_the_noise_floor(mitsuba, tmp_path):
    story = runpy.run_path(str(ROOT / "examples" / "unknown_effect.py"))
    found = story["main"](tmp_path / "story")
    base, table, formula = found["levels"].values()
    assert found["words"] == ["UNKNOWN", "CLAIM", "NOTHING"]
    assert (found["coordinate"], found["family"]) == ("row", "camera")
    # 28 000 held-out values: chi2/dof of noise is good to 0.0085 (1 sd)
    assert base > 1.15 and table < 1.03 and formula < 1.03
    value, sd = found["strength"]
    assert abs(value - found["expected"]) < 4 * sd < 0.002
    page = (tmp_path / "story" / "index.html").read_text(encoding="utf-8")
    for image in ("1-residual", "2-curves", "3-draft", "4-formula", "5-answer", "6-ladder"):
        assert f"{image}.png" in page and (tmp_path / "story" / f"{image}.png").stat().st_size > 5000
    assert (tmp_path / "story" / "answer" / "report.html").is_file()
    with pytest.raises(FileExistsError, match="not empty"):
        story["main"](tmp_path / "story")


@pytest.mark.slow
def test_a_curve_along_geometry_becomes_an_effect_as_well(mitsuba, tmp_path, optics):
    """A coating that shines the brighter the steeper it stands, by 0.6 % per degree, which no effect of the library
    does."""
    from optics.captures import capture_set as captures
    from optics.proof import demo
    from optics.proof.makers.touch import Maker, presses
    from optics.scene import loader as scenes
    from optics.study.record import Record

    class Tilted(Maker):
        def light(self, press):
            points, _ = self.seen(press)
            normal = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
            slope = np.degrees(np.arccos(np.clip(np.abs(normal[..., 2]) / np.linalg.norm(normal, axis=-1), 0, 1)))
            return {led: image * (1 + 0.006 * slope)[..., None] for led, image in super().light(press).items()}

    scene = scenes.load("gelsight", {"width": "64", "height": "48"})
    maker = Tilted(scene, {**demo.truth(scene, 3), "camera.exposure": 200.0}, seed=7)
    found = maker.captures(presses(4, 3), [{led: 1.0} for led in list(scene.leds)[:3]])
    found.parameters["camera.exposure"] = 200.0
    captures.write(found, tmp_path / "captures", bits=8)
    study = tmp_path / "study"
    free = [
        w
        for n in (
            "led_[1-3].[xyz]",
            "led_[1-3].pan",
            "led_[1-3].tilt",
            "led_[1-3].mu",
            "led_[1-3].power",
            "membrane.rho_[gb]",
            "membrane.sigma",
        )
        for w in ("--free", n)
    ]
    assert optics("calibrate", tmp_path / "captures", "-o", study, "--per-group", "none", *free)[0] == 0
    assert optics("diagnose", study)[0] == 1
    told = Record.open(study).diagnosis(0)
    assert told["word"] == "UNKNOWN" and told["families"][0]["family"] == "geometry"
    slope = next(f for f in told["fingerprints"] if f["coordinate"] == "slope")
    assert slope["share"] > 0.9
    steps = np.polyfit(slope["centres"], slope["curve"], 1, w=1 / np.array(slope["sd"]))
    assert steps[0] == pytest.approx(0.006, rel=0.3)  # per degree; calibration absorbs a part
    assert optics("effects", "new", "tilt shade", "--from", study, "--along", "slope")[0] == 0
    assert optics("add", study, "tilt shade")[0] == 0
    base, drafted = Record.open(study).steps
    strength = next(v["value"] for v in drafted["variables"] if v["keys"] == ["gel.tilt_shade"])
    assert 0.8 < strength < 1.3  # about the curve as it was found
    for role in ("fitted", "held_out"):
        excess = [step[role]["chi2_per_dof"] - 1 for step in (base, drafted)]
        assert excess[0] > 0.1 and excess[1] < 0.3 * excess[0]
    file = study / "plugins" / "tilt_shade.py"
    file.write_text(file.read_text() + "# changed\n")
    code, _, error = optics("diagnose", study)
    assert code == 2 and "tilt_shade.py" in error and "start a new study" in error
