"""A study's fit where it is used again: the same held-out numbers everywhere, and a calibrated sensor to render.

Two small studies: presses of a touch sensor, 48 x 36 px, one of three held out, with the place of each press found in
it; and readings of a photodiode behind two polarizers with a gain per sweep, one sweep in four held out."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import tomlkit

import optics as package
from optics.captures import capture_set as capture_files
from optics.captures.noise import Noise
from optics.errors import BadScene, UnknownKey
from optics.files import exr
from optics.light.rendering import RenderJob
from optics.pages.view import View
from optics.proof.makers import bench as jones
from optics.scene import loader as scene
from optics.study import loop
from optics.study.fit_files import fit_file, read_fit
from optics.study.record import Record

DIODE = Noise(system_gain=0.05, dark_noise=2.0, black_level=64.0, saturation=4095.0, prnu=0.0)


@pytest.fixture(scope="module")
def touched(tmp_path_factory, mitsuba):
    """A study of six frames with LEDs driven at 0.8: powers, a roughness, and where each press is."""
    folder = tmp_path_factory.mktemp("fits")
    loaded = scene.load("gelsight", {"width": "48", "height": "36"})
    noise, rng, frames = Noise(0.05, 1.0, 8.0, 255.0, 0.0), np.random.default_rng(0), []
    images = RenderJob(loaded, black=8.0)
    for k, (x, y, depth) in enumerate([(-2.0, 1.0, 0.4), (2.0, -1.0, 0.5), (3.0, 2.0, 0.4)]):
        for led in ("led_1", "led_3"):
            set_here = {
                **{f"{n}.power": 0.8 * (n == led) for n in loaded.leds},
                **{"gel.press_x": x, "gel.press_y": y, "gel.press_depth": depth},
            }
            made = images.take({**set_here, "camera.exposure": 150.0, "gel.press_x": x + 0.03, f"{led}.power": 1.0})
            image = noise.expose(made.camera, rng).astype(np.float32)
            frames.append(capture_files.Frame(f"p{k}.{led}", image, group=f"press-{k}", parameters=set_here))
    captures = capture_files.write(
        capture_files.Captures(Path("."), "gelsight", frames, {"camera.exposure": 150.0}, noise),
        folder / "captures",
        bits=8,
    )
    setup = loop.Setup(
        captures=str(captures),
        free=["led_[13].power", "membrane.sigma"],
        per_group=["gel.press_x"],
        held_out=["press-2"],
    )
    loop.begin(setup, folder / "study")
    return folder / "study"


@pytest.fixture(scope="module")
def read(tmp_path_factory, mitsuba):
    """A study of 96 readings, to which a gain per sweep was added."""
    folder = tmp_path_factory.mktemp("table")
    settings = [
        {"polarizer.angle": a, "analyzer.angle": 11.25 * i, "source.power": p}
        for a in (0.0, 60.0, 100.0)
        for p in (0.5, 1.0)
        for i in range(16)
    ]
    jones.write(folder / "captures", jones.Truth(photodiode=jones.Photodiode(gain=2.2)), settings, DIODE, 3)
    study = package.calibrate(folder / "captures", folder / "study")
    study.add("gain drift")
    return folder / "study"


@pytest.fixture(params=["touched", "read"])
def studied(request):
    return request.getfixturevalue(request.param)


# -- one number ------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_ladder_compare_view_and_report_give_one_held_out_number(studied, optics):
    """The poses that were found in held-out frames are used, and count, wherever the number is given."""
    record = Record.open(studied)
    level, fit = record.steps[-1]["held_out"], read_fit(studied)["fit"]
    assert fit["held_out_parameters"] > 0 and level["dof"] == level["n"] - fit["held_out_parameters"]
    text = f"{level['chi2_per_dof']:.3f}"
    if record.steps[-1]["effect"]:  # few readings: what was fitted to them shows in the digits that are printed
        assert text != f"{level['chi2'] / level['n']:.3f}"
    assert text in record.table()
    code, said, _ = optics("compare", record.ladder["captures"], "--fit", studied)
    row = next(line for line in said.splitlines() if line.startswith("held out"))
    assert code == 0 and text in row
    again = package.compare(record.ladder["captures"], studied).comparison.held_out
    assert again.chi2_per_dof == pytest.approx(level["chi2_per_dof"], rel=1e-9)  # sums in another order
    view = View(studied)
    try:
        held = [f for f in view.record()["frames"] if f["held_out"]]
        kept = next(i for i, f in enumerate(view.model.frames) if f.name == held[0]["name"])
        measured, use = view.capture(kept)
        prediction, sd = view.predict(kept, {})
    finally:
        view.close()
    assert f"{sum(f['chi2'] for f in held) / sum(f['dof'] for f in held):.3f}" == text
    z = ((measured - prediction) / sd)[np.broadcast_to(use, measured.shape)]
    assert np.sum(z.astype(float) ** 2) == pytest.approx(held[0]["chi2"], rel=1e-5)  # images travel in single precision
    page = package.Study.open(studied).report(studied / "page.html", overwrite=True).read_text(encoding="utf-8")
    table = re.search(r"held out</th>.*?</table>", page, re.S)[0]
    assert f"{level['chi2_per_dof']:#.4g}" in table


@pytest.mark.slow
def test_new_captures_count_nothing_as_fitted(touched, read, optics, tmp_path):
    """The same scene and fit on other readings: no number was fitted to them, and none is held out."""
    settings = [{"polarizer.angle": 30.0, "analyzer.angle": 11.25 * i, "source.power": 1.0} for i in range(16)]
    jones.write(tmp_path / "captures", jones.Truth(photodiode=jones.Photodiode(gain=2.2)), settings, DIODE, 4)
    base = read / "steps" / "00-base"  # the last step has values of frames that the new set does not have
    found = package.compare(tmp_path / "captures", base)
    assert found.comparison.total.dof == found.comparison.total.n and found.comparison.held_out is None
    assert "not the captures that the fit was made of" in found.notes[0]
    code, _, said = optics("compare", tmp_path / "captures", "--fit", touched)
    assert code == 2 and "its values belong to the scene gelsight, not to polarizer_bench" in said


def test_a_copied_set_is_the_same_set(read, tmp_path):
    import shutil

    record = Record.open(read)
    shutil.copytree(record.ladder["captures"], tmp_path / "elsewhere")
    found = package.compare(tmp_path / "elsewhere", read)
    assert not found.notes and found.comparison.held_out.chi2_per_dof == record.steps[-1]["held_out"]["chi2_per_dof"]


# -- a calibrated sensor ---------------------------------------------------------------------------------------------
def sent(fit, *names):
    """--set arguments of a fit's values, as one would type them."""
    return [word for key, value in fit.items() for word in ("--set", f"{key}={value!r}")]


def rendered(file):
    channels, _ = exr.read(file)
    return {name: np.asarray(image) for name, image in channels.items()}


@pytest.mark.slow
@pytest.mark.parametrize("frame", [None, "p1.led_3"])
def test_a_calibrated_sensor_is_the_scene_with_its_values(touched, optics, tmp_path, frame):
    """`--fit` is the same as to name scene, definitions and every value by hand; a light shines with the power that was
    found times the level that it was driven with."""
    fit = read_fit(touched)
    by_hand = {"camera.exposure": 150.0, **fit["parameters"]}
    for led in ("led_1", "led_3"):
        by_hand[f"{led}.power"] *= 0.8
    off = {f"led_{i}.power": 0.0 for i in (2, 4, 5, 6)}  # never on in the captures
    if frame is not None:
        off["led_1.power"] = 0.0
        by_hand |= {"gel.press_y": -1.0, "gel.press_depth": 0.5, **fit["frames"][frame]}
        assert abs(fit["frames"][frame]["gel.press_x"] - 2.03) < 0.02  # set 2.00, found where it was
    own = ["--frame", frame] if frame else []
    more = ["--set", "camera.blur=0.4"]
    assert optics("render", "--fit", touched, *own, *more, "-o", tmp_path / "a.exr", "--png")[0] == 0
    size = ["-D", "width=48", "-D", "height=36"]
    named = sent({**by_hand, **off})
    assert optics("render", "gelsight", *size, *named, *more, "-o", tmp_path / "b.exr")[0] == 0
    ours, theirs = rendered(tmp_path / "a.exr"), rendered(tmp_path / "b.exr")
    assert ours.keys() == theirs.keys() and ours["R"].max() > 0.05
    for name, image in theirs.items():
        np.testing.assert_allclose(ours[name], image, rtol=1e-5, atol=1e-9, err_msg=name)  # sums over threads
    loaded = package.load(fit=touched, frame=frame)
    assert {k: loaded.values()[k] for k in {**by_hand, **off}} == {**by_hand, **off}
    if frame:
        record, model, _ = loop.take_up(touched)
        index = [f.name for f in model.frames].index(frame)
        predicted = model.predict(loop.kept(record, model)[1], [index])[0]
        image = RenderJob(package.load(fit=touched, frame=frame), black=8.0).take().camera
        np.testing.assert_allclose(image, predicted, rtol=1e-4, atol=1e-3)  # DN; the renderer's samples are the same


@pytest.mark.slow
@pytest.mark.parametrize("levels, power", [(["led_1.power"], 0.9 * 1.25), ([], 0.9)])
def test_a_drive_level_that_was_fitted_multiplies_the_power(touched, tmp_path, levels, power):
    """As `SceneModel.at` has it: what was fitted in a frame is a light's drive level where this is known with an
    uncertainty, and else its power itself."""
    data = tomlkit.parse(fit_file(touched).read_text(encoding="utf-8"))
    data["parameters"]["led_1.power"] = 1.25
    data["frames"]["p0.led_1"]["led_1.power"] = 0.9
    data["sensor"]["levels"] = levels
    (tmp_path / "fit.toml").write_text(tomlkit.dumps(data), encoding="utf-8")
    assert package.load(fit=tmp_path / "fit.toml", frame="p0.led_1").values()["led_1.power"] == pytest.approx(power)
    assert package.load(fit=tmp_path / "fit.toml").values()["led_1.power"] == pytest.approx(0.8 * 1.25)


def test_the_camera_of_a_calibrated_sensor_has_the_levels_of_its_captures(touched, optics, tmp_path):
    from PIL import Image

    optics(
        "render",
        "--fit",
        touched,
        "-o",
        tmp_path / "a.exr",
        "--png",
        *[w for i in range(1, 7) for w in ("--set", f"led_{i}.power=0")],
    )
    assert np.asarray(Image.open(tmp_path / "a.png")).max() == 8  # black level, DN


@pytest.mark.parametrize(
    "words, said",
    [
        (["render", "digit", "--fit", "{study}"], "its values belong to the scene gelsight, not to digit"),
        (["render", "--fit", "{study}", "--frame", "p9"], "unknown frame 'p9'"),
        (["render", "--fit", "{study}/ladder.json"], "not valid TOML"),
        (["render", "--fit", "{tmp}"], "neither a study nor a step of one"),
        (["render", "--fit", "{tmp}/none.toml"], "no such file"),
        (["render"], "no scene; allowed: a shipped scene's name"),
        (["render", "gelsight", "--frame", "p1.led_3"], "of which captures? Add --fit STUDY"),
        (["render", "--fit", "{study}", "-D", "wdth=3"], "unknown definition 'wdth'"),
        (["render", "--fit", "{tmp}/old.toml"], "it does not name its scene"),
        (["render", "--fit", "{tmp}/moved.toml"], "its scene /nowhere/mine.xml is gone; give the file where it is now"),
        (["render", "--fit", "{tmp}/plugins.toml"], "its plugins were in /nowhere, which is gone"),
        (["render", "--fit", "{readings}", "--frame", "a"], "unknown frame 'a'"),
    ],
)
def test_what_contradicts_a_fit_is_refused(touched, read, optics, tmp_path, words, said):
    (tmp_path / "old.toml").write_text('[parameters]\n"led_1.power" = 1.0\n')
    (tmp_path / "moved.toml").write_text('[sensor]\nscene = "/nowhere/mine.xml"\n')
    (tmp_path / "plugins.toml").write_text('[sensor]\nscene = "gelsight"\nplugins = "/nowhere"\n')
    words = [w.format(study=touched, tmp=tmp_path, readings=read) for w in words]
    code, _, error = optics(*words, "-o", tmp_path / "x.exr")
    assert code == 2 and said in error and len(error.splitlines()) == 1
    assert not (tmp_path / "x.exr").exists()


def test_the_same_scene_under_another_name_is_taken(touched, tmp_path):
    copy = tmp_path / "copy.xml"
    copy.write_text(scene.find("gelsight").read_text(encoding="utf-8"), encoding="utf-8")
    assert package.load(copy, fit=touched).values() == package.load(fit=touched).values()
    copy.write_text(copy.read_text(encoding="utf-8") + "<!-- changed -->", encoding="utf-8")
    with pytest.raises(BadScene, match="belong to the scene gelsight"):
        package.load(copy, fit=touched)
    with pytest.raises(UnknownKey, match="unknown frame"):
        package.load(fit=touched, frame="p1.led_9")


def test_a_batch_of_a_calibrated_sensor(touched, optics, tmp_path):
    """A job names a fit in place of a scene, or gets it by --fit; noise and black level are those of its captures."""
    text = (
        'out = "{}"\ncount = 1\nseed = 2\noutputs = ["exr", "dn"]\n[sample]\n"gel.press_x" = {{ uniform = [-1, 1] }}\n'
    )
    (tmp_path / "a.toml").write_text(f'fit = "{touched}"\n' + text.format("a"))
    (tmp_path / "b.toml").write_text('scene = "gelsight"\n' + text.format("b"))
    assert optics("batch", tmp_path / "a.toml", "--workers", 1)[0] == 0
    assert optics("batch", tmp_path / "b.toml", "--workers", 1, "--fit", touched)[0] == 0
    drawn = json.loads((tmp_path / "a" / "manifest.jsonl").read_text())["sample"]["gel.press_x"]
    optics("render", "--fit", touched, "--set", f"gel.press_x={drawn!r}", "-o", tmp_path / "one.exr")
    ours, theirs = rendered(tmp_path / "a" / "images" / "000000.exr"), rendered(tmp_path / "one.exr")
    for name, image in theirs.items():
        np.testing.assert_allclose(ours[name], image, rtol=1e-5, atol=1e-9, err_msg=name)
    for name in ("000000.exr", "000000-dn.png"):
        a, b = ((tmp_path / folder / "images" / name).read_bytes() for folder in "ab")
        assert a == b
    code, _, said = optics("batch", tmp_path / "a.toml", "--workers", 1, "--fit", tmp_path)
    assert code == 2 and "leave out one of them" in said
    (tmp_path / "c.toml").write_text(text.format("c"))
    code, _, said = optics("batch", tmp_path / "c.toml")
    assert code == 2 and "scene is missing; allowed: a shipped scene's name, the path of an XML file, or a fit" in said


def test_a_sweep_starts_from_the_values_of_a_fit(read, optics):
    """The light follows the power that was found, above the black level of the readings."""
    words = ["sweep", "--fit", read, "--json", "--to", 90, "--steps", 3]
    found, half = (json.loads(optics(*words, *more)[1]) for more in ([], ["--set", "source.power=0.5"]))
    assert found["black"] == 64.0 and found["scene"].endswith("polarizer_bench.xml")
    light, less = (np.array(f["curves"][0]["readings"])[:, 0] - 64.0 for f in (found, half))
    # readings were driven at two levels, 0.5 and 1: the lamp shines with the power at drive level 1
    assert light * 0.5 == pytest.approx(less * read_fit(read)["parameters"]["source.power"], rel=1e-5)


@pytest.mark.slow
def test_no_share_of_values_is_negative(tmp_path, mitsuba):
    """Sweeps differ in length: of 49 readings the held-out ones are the shorter ones, and nothing is masked."""
    settings = [{"polarizer.angle": 0.0, "analyzer.angle": 3.6 * i, "source.power": 1.0} for i in range(49)]
    jones.write(tmp_path / "captures", jones.Truth(photodiode=jones.Photodiode(gain=2.2)), settings, DIODE, 5)
    study = package.calibrate(tmp_path / "captures", tmp_path / "study")
    lengths = [len(f.image) for f in study.model.frames]
    assert len(set(lengths)) == 2 and study.record.ladder["facts"]["masked"] == 0.0
    verdict = study.diagnose(advised=False)
    assert verdict.basis.masked == pytest.approx(0.0, abs=1e-12) and "(0 % masked)" in verdict.text()


def test_a_calibration_starts_from_a_fit(read, optics, tmp_path):
    """New readings of the same bench start from the values of the fit; what is given stands above them."""
    settings = [{"polarizer.angle": 30.0, "analyzer.angle": 11.25 * i, "source.power": 1.0} for i in range(32)]
    jones.write(tmp_path / "captures", jones.Truth(photodiode=jones.Photodiode(gain=2.2)), settings, DIODE, 6)
    code, _, error = optics("calibrate", tmp_path / "captures", "--fit", read, "-o", tmp_path / "study")
    assert code == 0, error
    study = package.Study.open(tmp_path / "study")
    known = read_fit(read)
    assert study.setup.values == known["parameters"]
    again = package.calibrate(tmp_path / "captures", tmp_path / "again", fit=read, values={"source.power": 2.0})
    assert again.setup.values == {**known["parameters"], "source.power": 2.0}
    assert again.fit.start[0] == 2.0 != known["parameters"]["source.power"]
    with pytest.raises(FileNotFoundError, match="neither a study nor a step"):
        package.calibrate(tmp_path / "captures", tmp_path / "never", fit=tmp_path)
    assert not (tmp_path / "never").exists()


def test_what_a_study_found_is_listed_and_patterns_set_many(touched, optics):
    code, out, error = optics("values", touched, "led_*.power", "--json")
    assert code == 0, error
    known = read_fit(touched)["parameters"]
    assert {v["name"]: v["value"] for v in json.loads(out)} == {
        key: pytest.approx(value) for key, value in known.items() if key.endswith(".power")
    }
    code, _, error = optics("values", touched, "lad_*")
    assert code == 2 and "unknown parameter of this study 'lad_*'" in error
    scene = package.load("gelsight")
    assert scene.spread({"led_*.mu": 2.0, "led_2.mu": 3.0}) == {
        f"led_{k}.mu": 3.0 if k == 2 else 2.0 for k in range(1, 7)
    }
    code, _, error = optics("compare", package.Study.open(touched).setup.captures, "--set", "lad_*.mu=1")
    assert code == 2 and "unknown parameter 'lad_*.mu'" in error
