"""The command line shows what the library knows, writes what it says, and keeps stdout for results."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from optics import cli
from optics.captures import capture_set as capture_files
from optics.captures.noise import Noise
from optics.cli import shared
from optics.files import exr
from optics.light.rendering import RenderJob
from optics.scene import loader as scene
from optics.scene.parameter import Values

SIZE = ["-D", "width=64", "-D", "height=48"]
HEAVY = ("mitsuba", "drjit", "numpy", "scipy", "matplotlib", "colour", "pydantic", "rich.console")


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """Six frames of a sensor with a known power, three presses under two LEDs."""
    folder = tmp_path_factory.mktemp("measured")
    loaded = scene.load("gelsight", {"width": "48", "height": "36"})
    noise, rng = Noise(0.05, 1.0, 8.0, 255.0, 0.0), np.random.default_rng(0)
    images = RenderJob(loaded, black=8.0)
    frames = []
    for k, (x, y, depth) in enumerate([(-2.0, 1.0, 0.4), (2.0, -1.0, 0.5), (3.0, 2.0, 0.4)]):
        for led in ("led_1", "led_3"):
            values = {
                **{f"{n}.power": float(n == led) for n in loaded.leds},
                "gel.press_x": x,
                "gel.press_y": y,
                "gel.press_depth": depth,
            }
            signal = images.take({**values, "camera.exposure": 150.0, f"{led}.power": 1.25}).camera
            frames.append(
                capture_files.Frame(
                    f"p{k}-{led}", noise.expose(signal, rng).astype(np.float32), group=f"press-{k}", parameters=values
                )
            )
    found = capture_files.Captures(Path("."), "gelsight", frames, {"camera.exposure": 150.0}, noise)
    return capture_files.write(found, folder / "set", bits=8)


# -- looking around --------------------------------------------------------------------------------------------------
def test_help_needs_nothing_heavy():
    code = (
        "import sys, optics.cli as c\ntry: c.main(['--help'])\nfinally: print([m for m in sys.argv[1].split() if m in "
        "sys.modules])"
    )
    child = subprocess.run([sys.executable, "-c", code, " ".join(HEAVY)], capture_output=True, text=True, timeout=60)
    assert child.stdout.splitlines()[-1] == "[]", child.stdout + child.stderr


@pytest.mark.parametrize(
    "name", [(c.name or c.callback.__name__).replace("_", "-") for c in cli.app.registered_commands]
)
def test_every_command_has_help(optics, name):
    code, out, err = optics(name, "--help")
    assert code == 0 and "--quiet" in out and "--debug" in out and err == ""


def test_no_arguments_is_help(optics):
    assert optics()[:2] == optics("--help")[:2]


def test_version(optics):
    from optics import __version__

    assert optics("--version") == (0, f"optics {__version__}\n", "")


def test_scenes(optics):
    _, text, _ = optics("scenes")
    _, data, _ = optics("scenes", "--json")
    lines = [line for line in text.splitlines() if line and not line.startswith(" ")]  # behind them: a first look
    assert [line.split()[0] for line in lines if line.split()[0] in scene.shipped_scenes()] == scene.shipped_scenes()
    assert all(Path(r["file"]).is_file() and r["title"] for r in json.loads(data))


def test_params_are_complete(optics):
    code, text, _ = optics("params", "gelsight", *SIZE)
    rows = json.loads(optics("params", "gelsight", *SIZE, "--json")[1])
    loaded = scene.load("gelsight", {"width": "64", "height": "48"})
    assert code == 0 and [r["key"] for r in rows] == list(loaded.values())
    assert [line.split()[0] for line in text.splitlines()[1:]] == [r["key"] for r in rows]
    by_key = {r["key"]: r for r in rows}
    assert by_key["membrane.sigma"] == {
        "key": "membrane.sigma",
        "value": pytest.approx(0.2),
        "unit": "rad",
        "bounds": [0.0, 1.5],
        "choices": None,
        "neutral": None,
        "plausible": 0.1,
        "differentiable": True,
        "derivative": "ad",
        "linear": False,
        "squared": True,
        "effect": None,
        "meaning": "roughness sigma of (S3)",
    }
    assert by_key["camera.vignetting"]["effect"] == "lens vignetting" and by_key["camera.vignetting"]["neutral"] == 0
    assert by_key["led_1.x"]["bounds"] == [None, None]  # unbounded; JSON has no infinity
    assert by_key["gel.indenter"]["choices"] and not by_key["gel.indenter"]["differentiable"]


@pytest.mark.parametrize("name", scene.shipped_scenes())
def test_params_of_every_scene(optics, name):
    code, text, err = optics("params", name)
    assert (code, err) == (0, "") and text.splitlines()[0].split() == [
        "key",
        "value",
        "unit",
        "bounds",
        "neutral",
        "derivative",
        "meaning",
    ]


def test_spectra_are_listed_and_drawn(optics, tmp_path):
    """Sources, bands and error in the list; a picture whose size says that something is in it."""
    auto = ("digit", *SIZE, "-D", "bands=auto")
    code, text, _ = optics("params", *auto)
    assert (
        code == 0
        and "peak 625, fwhm 14.8; its shape: led_algainp_633.csv" in text
        and "Nikon 5100" in text
        and "estimated error" in text
    )
    code, text, err = optics("plot-spectra", *auto, "-o", str(tmp_path / "spectra.png"))
    assert (code, text.strip()) == (0, str(tmp_path / "spectra.png")) and "led_red: 604.6, 626.8" in err
    assert np.std(Image.open(tmp_path / "spectra.png").convert("L")) > 10
    drawn = json.loads(optics("plot-spectra", "gelsight", "-o", str(tmp_path / "plain.svg"), "--json")[1])
    assert [s["source"] for s in drawn["spectra"]] == ["white"] * 6 and drawn["bands"] is None
    assert (tmp_path / "plain.svg").read_text().startswith("<?xml")
    code, _, err = optics("plot-spectra", "digit", "-o", str(tmp_path / "spectra.gif"))
    assert code == 2 and ".svg" in err


def test_params_by_pattern_and_definition(optics):
    _, text, _ = optics("params", "gelsight", "gel.press_d*", "led_?.x", *SIZE, "-D", "depth=0.25")
    lines = text.splitlines()[1:]
    assert [line.split()[0] for line in lines] == [
        "gel.press_depth",
        *(f"led_{i}.x" for i in range(1, 7)),
    ]  # as in the file
    assert lines[0].split()[1:3] == ["0.25", "mm"]


def test_effects_and_their_pages(optics):
    records = json.loads(optics("effects", "--json")[1])
    assert {"lens-vignetting", "gel-absorption"} <= {r["key"] for r in records}
    assert all(r["parameters"] and r["needs"] for r in records)
    for name in ("lens-vignetting", "Lens vignetting"):
        code, page, _ = optics("effects", name)
        assert code == 0 and "cos^4" in page and "vignetting.py" in page and "References" in page


def test_parts_have_pages_too(optics):
    from optics.scene.registry import known

    found, (_, text, _) = known(), optics("effects")
    assert not set(found.parts) & set(found.effects) and text.splitlines()[-1].endswith(", ".join(sorted(found.parts)))
    for kind, part in found.parts.items():
        code, page, _ = optics("effects", kind.replace("_", "-"))
        assert code == 0 and part.doc.strip() in page and part.file in page
        assert [line.split()[0] for line in page.splitlines()[-len(part.parameters) :]] == [
            p.name for p in part.parameters
        ]
    record = json.loads(optics("effects", "led", "--json")[1])
    assert record["key"] == "led" and "led-size" in record["effects"] and "cos(a)^mu / d^2" in record["page"]
    assert {p["name"]: p["unit"] for p in record["parameters"]}["x"] == "mm"


def test_a_users_plugin_is_listed_beside_the_shipped_ones(optics, tmp_path):
    (tmp_path / "rust.py").write_text(
        '"""Rust: reddens."""\nfrom optics.scene.declare import Effect\nfrom optics.parameter import '
        'Parameter\neffect = Effect("rust", "membrane", (Parameter("rust", "1", 0.0, neutral=0.0),))\n'
    )
    code, page, _ = optics("effects", "rust", "--plugins", tmp_path)
    assert code == 0 and "reddens" in page


def test_doctor(optics):
    from optics import doctor

    code, text, _ = optics("doctor")
    assert code == (0 if doctor.is_sound(doctor.report()) else 1) and "LLVM" in text
    assert {"ok", "rows"} <= json.loads(optics("doctor", "--json")[1]).keys()


# -- arguments and errors --------------------------------------------------------------------------------------------
def test_priors():
    assert shared.priors(["led_*.x=11+-0.5", "gel.press_*=+-0.05", "a=-1e-3±2", "b=1 +/- .1"]) == {
        "led_*.x": (11.0, 0.5),
        "gel.press_*": (None, 0.05),
        "a": (-1e-3, 2.0),
        "b": (1.0, 0.1),
    }


@pytest.mark.parametrize("text", ["a=1", "a=1+-", "a=1+-0", "a=1+--2", "a", "=1+-1", "a=x+-1", "a=+-nan"])
def test_bad_priors(text):
    with pytest.raises(ValueError, match="--prior"):
        shared.priors([text])


def test_debug_shows_where_an_error_came_from(optics):
    code, out, err = optics("params", "nowhere.xml", "--debug")
    assert (code, out) == (2, "") and "Traceback" in err and err.splitlines()[-1].startswith("error: ")


def test_a_bug_shows_its_traceback(optics, monkeypatch):
    monkeypatch.setattr(scene, "shipped_scenes", lambda: 1 / 0)
    code, _, err = optics("scenes")
    assert code == 2 and "Traceback" in err and "a bug" in err.splitlines()[-1]


@pytest.mark.parametrize("inside", [False, True])
def test_ctrl_c_is_said_in_one_line(optics, monkeypatch, inside):
    """Python's own exception, and Dr.Jit's for a Ctrl-C within a render, which it puts around Python's."""

    def stopped():
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as ctrl_c:
            if inside:
                raise RuntimeError("the evaluation was stopped") from ctrl_c
            raise

    monkeypatch.setattr(scene, "shipped_scenes", stopped)
    assert optics("scenes") == (130, "", "interrupted\n")


def test_a_reader_that_has_seen_enough_is_no_error():
    run = "import sys; from optics import cli; sys.exit(cli.main(['scenes', '--json']))"
    with subprocess.Popen(
        [sys.executable, "-c", run], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as child:
        child.stdout.close()
        assert (child.stderr.read(), child.wait(60)) == ("", 0)


def test_quiet_says_nothing_but_results(optics, tmp_path):
    assert optics("render", "gelsight", *SIZE, "-o", tmp_path / "a.exr")[2] != ""
    assert optics("render", "gelsight", *SIZE, "-o", tmp_path / "b.exr", "--quiet")[2] == ""


# -- render ----------------------------------------------------------------------------------------------------------
def test_a_image_of_a_sensor(optics, tmp_path):
    file = tmp_path / "new" / "a.exr"
    code, out, _ = optics(
        "render",
        "digit",
        "-D",
        "width=48",
        "-D",
        "height=64",
        "-D",
        "depth=0.5",
        "--set",
        "gel.press_x=1",
        "-o",
        file,
        "--png",
    )
    assert code == 0 and out.split() == [str(file), str(file.with_suffix(".json")), str(file.with_suffix(".png"))]
    channels, header = exr.read(file)
    bands, spectra = exr.spectral_image(channels)
    assert list(bands) == [470, 530, 625] and spectra.shape == (64, 48, 3, 1)
    leds = sum(np.stack([channels[f"{led}.{c}"] for c in "BGR"], -1) for led in ("led_red", "led_green", "led_blue"))
    np.testing.assert_allclose(leds, spectra[..., 0], rtol=1e-5)  # float32 sums
    assert channels["led_red.R"].mean() > 100 * channels["led_red.G"].mean()
    assert channels["depth.Z"].max() == pytest.approx(17.6, abs=1e-3)  # the untouched face; rays start within 1e-3 mm
    assert channels["depth.Z"].min() == pytest.approx(17.1, abs=0.02)  # 0.5 mm deep, sampled at pixels of 0.27 mm
    normal = np.stack([channels[f"normal.{c}"] for c in "XYZ"], -1)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1, atol=1e-5)
    row, column = np.argwhere(channels["contact.Y"] > 0).mean(0)
    focal = 48 / 2 / np.tan(np.radians(40.13 / 2))  # px
    assert column + 0.5 == pytest.approx(24 + focal * 1 / 17.6, abs=0.5) and row + 0.5 == pytest.approx(32, abs=0.5)
    record = json.loads(header["provenance"])
    assert record["parameters"]["gel.press_x"] == 1 and record["scene"]["defines"]["depth"] == "0.5"
    assert record["scene"]["hash"].startswith("sha256:") and "effects/lens_vignetting.py" in record["plugins"]
    assert {**json.loads(file.with_suffix(".json").read_text()), "command": 0} == {**record, "command": 0}

    again = scene.load("digit", record["scene"]["defines"])  # the record is enough to make it again
    image = RenderJob(again).take(record["parameters"], record["seed"])
    np.testing.assert_allclose(image.channels["S0.625,000000nm"], channels["S0.625,000000nm"], rtol=1e-5)
    with Image.open(file.with_suffix(".png")) as opened:
        shown = np.asarray(opened, float)
    assert np.abs(shown - np.clip(np.round(image.camera), 0, 255)).max() <= 1  # a DN on the edge of two


@pytest.mark.slow
def test_the_first_image_of_a_scene_is_its_first_look(optics, tmp_path):
    """With nothing set a newcomer sees a press in colour, and how; what is set, and a file of your own, mean what they
    say."""
    made = {}
    for name, words in (
        ("bare", ["gelsight"]),
        ("look", ["gelsight", "--look", "-D", "width=64", "--set", "camera.exposure=100"]),
        ("plain", ["gelsight", "--no-look"]),
        ("set", ["gelsight", *SIZE]),
        ("own", [shutil.copy(scene.find("gelsight"), tmp_path / "own.xml")]),
    ):
        code, _, err = optics("render", *words, "-o", tmp_path / f"{name}.exr")
        assert code == 0 and ("nothing was set, so this is the first look: -D depth=" in err) == (name == "bare"), err
        made[name] = exr.read(tmp_path / f"{name}.exr")[0], json.loads((tmp_path / f"{name}.json").read_text())
    touched = {name: bool(channels["contact.Y"].max() > 0) for name, (channels, _) in made.items()}
    assert touched == {"bare": True, "look": True, "plain": False, "set": False, "own": False}
    colours = np.stack([made["bare"][0][c] for c in "RGB"], -1)
    assert np.ptp(colours, -1).mean() > 0.3 * colours.mean()
    assert made["look"][1]["parameters"]["camera.exposure"] == 100 and made["look"][0]["R"].shape == (240, 64)
    code, _, err = optics("render", "polarizer_bench", "--look", "-o", tmp_path / "x.exr")
    assert code == 2 and "has no first look that is an image; it has: optics sweep" in err
    code, _, err = optics("render", "--fit", tmp_path, "--look", "-o", tmp_path / "x.exr")
    assert code == 2 and "has no first look" in err and not (tmp_path / "x.exr").exists()


def test_existing_images_are_kept_unless_forced(optics, tmp_path):
    file = tmp_path / "a.exr"
    assert optics("render", "gelsight", *SIZE, "-o", file)[0] == 0
    before = file.read_bytes()
    assert optics("render", "gelsight", *SIZE, "-D", "depth=0.5", "-o", file)[0] == 2 and file.read_bytes() == before
    assert (
        optics("render", "gelsight", *SIZE, "-D", "depth=0.5", "-o", file, "--force")[0] == 0
        and file.read_bytes() != before
    )
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.exr", "a.json"]


@pytest.mark.slow
def test_monte_carlo_agrees_within_its_own_variance(optics, tmp_path):
    for name, options in (("exact", []), ("random", ["--spp", "64", "--seed", "3"])):
        assert optics("render", "gelsight", *SIZE, "-D", "depth=0.5", *options, "-o", tmp_path / f"{name}.exr")[0] == 0
    exact, random = (exr.read(tmp_path / f"{n}.exr")[0] for n in ("exact", "random"))
    for band in ("S0.610,000000nm", "S0.460,000000nm"):
        variance, difference = random[f"variance.{band}"], random[band] - exact[band]
        # where the face is flat the centre of a pixel is its mean; 2000 pixels: their variances' mean is known to 1 %
        flat = (exact["normal.Z"] < -0.9999) & (variance > 0)
        assert flat.sum() > 2000
        assert abs(difference[flat].sum()) < 4 * np.sqrt(variance[flat].sum())
        assert np.mean(difference[flat] ** 2) == pytest.approx(np.mean(variance[flat]), rel=0.15)
    assert "led_1.R" not in random and "depth.Z" in random


def test_stokes_channels_where_the_integrator_has_them(optics, tmp_path):
    text = scene.find("gelsight").read_text(encoding="utf-8")
    (tmp_path / "s.xml").write_text(
        text.replace(
            '<integrator type="tactile" id="integrator">',
            '<integrator type="tactile" id="integrator"><boolean name="stokes" value="true"/>',
        )
    )
    code, out, err = optics("render", tmp_path / "s.xml", *SIZE, "--spp", "4", "-o", tmp_path / "s.exr", "--json")
    channels, header = exr.read(tmp_path / "s.exr")
    _, stokes = exr.spectral_image(channels)
    assert code == 0, err
    assert stokes.shape[3] == 4 and header["polarisationHandedness"] == "right"
    assert np.abs(stokes[..., 1:]).max() <= 1e-6 * stokes[..., 0].max()  # the membrane depolarizes
    assert json.loads(out)["method"].startswith("Monte Carlo")


STOCK = """<scene version="3.0.0"><integrator type="path"/>
<sensor type="perspective"><float name="fov" value="40"/>
  <transform name="to_world"><lookat origin="0,-4,4" target="0,0,0" up="0,0,1"/></transform>
  <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="24"/></film>
  <sampler type="independent"><integer name="sample_count" value="16"/></sampler></sensor>
<shape type="obj"><string name="filename" value="block.obj"/>
  <bsdf type="diffuse"><texture type="bitmap" name="reflectance">
    <string name="filename" value="check.png"/></texture></bsdf></shape>
<shape type="ply"><string name="filename" value="ball.ply"/><bsdf type="roughconductor"/></shape>
<emitter type="constant"/></scene>"""


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_rgb", None])
def test_any_other_mitsuba_scene(optics, tmp_path, variant):
    import trimesh

    trimesh.creation.box((2, 2, 0.4)).export(tmp_path / "block.obj")
    trimesh.creation.icosphere(radius=0.7).apply_translation((0, 0, 0.8)).export(tmp_path / "ball.ply")
    Image.fromarray(np.kron(np.indices((4, 4)).sum(0) % 2, np.ones((4, 4))).astype(np.uint8) * 255).save(
        tmp_path / "check.png"
    )
    (tmp_path / "stock.xml").write_text(STOCK)
    code, _, err = optics(
        "render",
        tmp_path / "stock.xml",
        *(["--variant", variant] if variant else []),
        "-o",
        tmp_path / "stock.exr",
        "--png",
    )
    channels, header = exr.read(tmp_path / "stock.exr")
    assert code == 0, err
    assert {"R", "G", "B", "variance.R", "depth.Z", "normal.X"} <= channels.keys() and "contact.Y" not in channels
    assert np.isfinite(channels["R"]).all() and channels["R"].mean() > 0.1
    hit = np.isfinite(channels["depth.Z"])
    assert 0.1 < hit.mean() < 1 and 3 < channels["depth.Z"][hit].min() < 5.66  # the middle is 5.66 away
    record = json.loads(header["provenance"])
    assert set(record["scene"]["files"]) == {"ball.ply", "block.obj", "check.png"}
    with Image.open(tmp_path / "stock.png") as shown:
        assert shown.size == (32, 24)


@pytest.mark.slow
def test_a_sensor_beside_other_lights_goes_through_mitsuba(optics, tmp_path):
    text = scene.find("gelsight").read_text(encoding="utf-8")
    (tmp_path / "lit.xml").write_text(text.replace("</scene>", '<emitter type="constant"/></scene>'))
    _, out, _ = optics("render", tmp_path / "lit.xml", *SIZE, "-D", "spp=4", "-o", tmp_path / "lit.exr", "--json")
    assert json.loads(out)["method"] == "Monte Carlo: 1 of its lights are no LED"
    assert exr.read(tmp_path / "lit.exr")[0]["S0.610,000000nm"].mean() > 0.1  # of a sky of 1


# -- models and measurements -----------------------------------------------------------------------------------------
def test_compare(optics, measured, tmp_path):
    code, text, _ = optics("compare", measured, "-o", tmp_path / "cmp")
    assert code == 0 and text.splitlines()[1].split()[1] == str(6 * 48 * 36 * 3)
    record = json.loads((tmp_path / "cmp" / "comparison.json").read_text())
    assert json.loads(optics("compare", measured, "--json")[1])["rows"][0]["rms"] == pytest.approx(
        record["rows"][0]["rms"]
    )
    images = sorted((tmp_path / "cmp" / "images").iterdir())
    with Image.open(images[0]) as shown:
        assert len(images) == 6 and shown.size == (3 * 48, 36)
    chi2 = record["rows"][0]["chi2"] / record["rows"][0]["dof"]
    right = json.loads(
        optics("compare", measured, "--json", "--set", "led_1.power=1.25", "--set", "led_3.power=1.25")[1]
    )["rows"][0]
    assert chi2 > 2 and right["chi2"] / right["dof"] == pytest.approx(1, abs=0.03)  # 31104 values: sd 0.008


@pytest.mark.slow
def test_calibrate_writes_a_study_that_compare_can_use(optics, measured, tmp_path):
    study = tmp_path / "study"
    code, out, err = optics(
        "calibrate",
        measured,
        "--free",
        "led_[13].power",
        "--per-group",
        "none",
        "--prior",
        "led_1.power=+-1",
        "--hold-out",
        "press-2",
        "-o",
        study,
    )
    assert code == 0, err
    assert out.splitlines()[-1] == str(study) and "warning: 8 bit" in err
    from optics.study.record import Record

    found = {v["name"]: v for v in Record.open(study).steps[0]["variables"]}
    for name in ("led_1.power", "led_3.power"):
        assert abs(found[name]["value"] - 1.25) < 4 * found[name]["sd"] < 0.05
    step = Record.open(study).steps[0]
    assert step["held_out"]["chi2_per_dof"] == pytest.approx(1, abs=0.06)  # 10368 values: sd 0.014
    apart = json.loads(optics("compare", measured, "--json", "--hold-out", "press-2")[1])["rows"]
    alone = json.loads(optics("compare", measured, "--json")[1])["rows"]
    assert {"fitted", "held out"} <= {r["scope"].get("role") for r in apart}
    assert "held out" not in {r["scope"].get("role") for r in alone}
    rows = json.loads(optics("compare", measured, "--json", "--fit", study / "steps" / "00-base" / "fit.toml")[1])[
        "rows"
    ]
    held = next(r for r in rows if r["scope"] == {"role": "held out"})
    assert (held["chi2"], held["dof"]) == pytest.approx((step["held_out"]["chi2"], step["held_out"]["dof"]), rel=1e-9)


def test_values_of_a_fit_hold_for_their_frames(measured, tmp_path):
    from optics.study.fit_files import values_of
    from optics.study.setup import Setup, open_model

    (tmp_path / "fit.toml").write_text('[parameters]\n"led_1.x" = 10.5\n[frames.p1-led_3]\n"gel.press_x" = 1.5\n')
    model = open_model(Setup(captures=str(measured)))
    values = values_of(model, tmp_path / "fit.toml", {"led_3.mu": 2.0})
    assert values == Values({"led_1.x": 10.5, "led_3.mu": 2.0}, {3: {"gel.press_x": 1.5}})


def test_progress_is_lines_where_there_is_no_terminal(capsys, monkeypatch):
    """One every ten seconds: none of quick work, none with --quiet. What begins anew is numbered."""
    from optics.cli import shared

    clock = iter([0.0, 3.0, 11.0, 11.0, 12.0, 30.0, 30.0, 31.0, 50.0, 50.0])
    monkeypatch.setattr(shared.time, "monotonic", lambda: next(clock))
    with shared.Terminal().progress() as show:
        for done in range(4):
            show("calibrate", done, 10)
        for done in (0, 1):
            show("calibrate", done, 10)
    assert capsys.readouterr().err == "calibrate: 1 of 10\ncalibrate: 3 of 10\ncalibrate (2): 1 of 10\n"
    silent = shared.Terminal()
    silent.quiet = True
    with silent.progress() as show:
        assert show is None


def test_a_calibration_folder_of_9dtact_is_known_by_its_layout(tmp_path, capsys):
    (tmp_path / "sensor_1" / "depth_calibration").mkdir(parents=True)
    assert cli.main(["import", str(tmp_path), "-o", str(tmp_path / "out")]) == 2
    assert "give --ball-radius" in capsys.readouterr().err
    assert cli.main(["import", str(tmp_path), "-o", str(tmp_path / "out"), "--circles", "a.csv"]) == 2
    assert "--circles: not for a calibration folder of 9DTact, as which " in capsys.readouterr().err


ENDS = {  # words of a shell -> (exit code, what stderr says)
    "{optics} scenes >&-": (0, ""),
    "{optics} scenes 2>&- >/dev/null": (0, ""),
    "{optics} scenes --json >/dev/full": (2, "error: standard output: No space left on device"),
    # the image is written, whatever becomes of the remark how long it took
    "{optics} render gelsight -D width=16 -D height=12 -o a.exr 2>/dev/full >/dev/null && test -s a.exr": (
        0,
        "",
    ),
    "{optics} render nothing 2>/dev/full": (2, ""),
    "{optics} render gelsight -D width=16 -D height=12 --spp 1 -o one.exr": (0, ""),  # one pass: no variance is known
    "mkdir gone && cd gone && rmdir ../gone && {optics} params gelsight": (
        2,
        "error: the current folder is gone; change",
    ),
    "cp {scene} $'bad\\xff.xml' && {optics} params $'bad\\xff.xml'": (2, "Mitsuba reads no path that is not UTF-8"),
}


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs bash and /dev/full")
@pytest.mark.parametrize("words", ENDS)
def test_odd_ends_of_a_pipe_and_odd_folders(tmp_path, words):
    command = f"{sys.executable} -m optics.cli"
    script = words.replace("{optics}", command).replace("{scene}", str(scene.find("gelsight")))
    home = {**os.environ, "PYTHONPATH": str(Path(cli.__file__).parents[2])}
    done = subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True, env=home)
    code, said = ENDS[words]
    assert done.returncode == code and said in done.stderr and "Traceback" not in done.stderr, done.stderr
