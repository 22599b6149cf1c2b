"""From the command line to polarized light: images with Stokes vectors, the matrices on a ray, a reading against an
angle."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from optics.captures import capture_set as capture_files
from optics.captures.noise import Noise
from optics.files import exr
from optics.polarization import mueller
from optics.scene import loader as scene

SMALL = ["-D", "width=48", "-D", "height=36"]
BENCH = ["-D", "width=24", "-D", "height=16", "-D", "x_fov=8", "-D", "bands=620, 540, 460"]


def stokes_of(file):
    channels, header = exr.read(file)
    return (*exr.spectral_image(channels), channels, header)


# -- images ----------------------------------------------------------------------------------------------------------
def test_a_scene_with_layers_gives_stokes_vectors(optics, tmp_path):
    file = tmp_path / "a.exr"
    code, out, err = optics(
        "render",
        "polarizer_bench",
        *BENCH,
        "--set",
        "analyzer.inserted=0",
        "--set",
        "sample.retard_0=90",
        "--set",
        "sample.angle=30",
        "-o",
        file,
        "--stokes",
        "--png",
    )
    assert code == 0, err
    files = [tmp_path / f"a.{end}" for end in ("exr", "json", "png", "dolp.png", "aolp.png")]
    assert out.split() == [str(f) for f in files] and sorted(tmp_path.iterdir()) == sorted(files)
    assert err.startswith("LED by LED")
    bands, stokes, channels, header = stokes_of(file)
    assert (
        {"R", "G", "B"} <= channels.keys()
        and list(bands) == [460, 540, 620]
        and header["polarisationHandedness"] == "right"
    )
    expected = (
        0.4
        * mueller.retarder(*(np.radians(90) * c for c in (np.cos(np.pi / 3), np.sin(np.pi / 3)))).numpy()
        @ [1, 1, 0, 0]
    )
    np.testing.assert_allclose(stokes[8, 12, 1], expected, atol=2e-4)  # 0.2 deg off the axis
    np.testing.assert_allclose(np.linalg.norm(stokes[..., 1:], axis=-1), stokes[..., 0], rtol=1e-5)
    np.testing.assert_allclose(channels["source.G"], channels["S0.540,000000nm"], rtol=1e-6)
    for file in files[3:]:
        with Image.open(file) as shown:
            assert np.ptp(np.asarray(shown.convert("L"))) > 100


@pytest.mark.slow
def test_the_exact_image_and_monte_carlo_agree(optics, tmp_path):
    options = ["vi2tap", *SMALL, "-D", "analyzer=35", "-D", "depth=1", "-D", "bands=650, 580, 520, 460"]
    for name, more in (("exact", []), ("random", ["--spp", "16", "--seed", "2"])):
        assert optics("render", *options, *more, "-o", tmp_path / f"{name}.exr")[0] == 0
    _, exact, channels, _ = stokes_of(tmp_path / "exact.exr")
    bands, random, scattered, _ = stokes_of(tmp_path / "random.exr")
    assert exact.shape == random.shape == (36, 48, 4, 4)
    methods = [json.loads((tmp_path / f"{n}.json").read_text())["method"].split(":")[0] for n in ("exact", "random")]
    assert methods == ["LED by LED", "Monte Carlo"]
    np.testing.assert_array_equal(scattered["depth.Z"], channels["depth.Z"])  # both look through the skin
    assert not channels["contact.Y"].any()  # what is seen is not the skin that is touched
    variance = np.stack(
        [np.stack([scattered[f"variance.{exr.spectral_name(b, s)}"] for s in range(4)], -1) for b in bands], 2
    )
    thing = (channels["depth.Z"] > 30) & (
        channels["depth.Z"] < 60
    )  # the object; the wall's chequers are finer than these pixels
    level = exact[thing][..., 0].mean()
    for s in range(4):
        apart = (random - exact)[thing][..., s].mean()
        # four sigmas of the mean, and a hundredth for edges of an image as small as this
        assert abs(apart) < 4 * np.sqrt(variance[thing][..., s].sum()) / exact[thing][..., s].size + 0.01 * level
    assert np.abs(exact[thing][..., 1:3]).mean() > 0.3 * level


@pytest.mark.slow
def test_an_led_behind_a_layer_is_not_taken_for_dark(optics, tmp_path):
    text = scene.find("vi2tap").read_text(encoding="utf-8")
    inside = text.replace(
        '<point name="position" x="-200" y="-150" z="-100"/>', '<point name="position" x="6" y="8" z="-15"/>'
    )
    (tmp_path / "inside.xml").write_text(inside)
    code, out, err = optics(
        "render",
        tmp_path / "inside.xml",
        "-D",
        "width=24",
        "-D",
        "height=18",
        "-D",
        "spp=2",
        "-o",
        tmp_path / "a.exr",
        "--json",
    )
    assert code == 0, err
    assert json.loads(out)["method"] == "Monte Carlo: the light of room_left passes layers before it meets anything"


def test_stokes_vectors_of_a_scene_without_layers(optics, tmp_path):
    code, out, err = optics(
        "render",
        "gelsight",
        "-D",
        "width=32",
        "-D",
        "height=24",
        "-D",
        "spp=2",
        "--stokes",
        "-o",
        tmp_path / "a.exr",
        "--json",
    )
    assert code == 0, err
    assert json.loads(out)["method"] == "Monte Carlo: Stokes vectors were asked for of a scene without layers"
    _, stokes, channels, header = stokes_of(tmp_path / "a.exr")
    assert stokes.shape[3] == 4 and "polarisationHandedness" in header
    assert optics("render", "gelsight", "-D", "width=32", "-D", "height=24", "-o", tmp_path / "b.exr")[0] == 0
    assert exr.spectral_image(exr.read(tmp_path / "b.exr")[0])[1].shape[3] == 1  # as ever


# -- what layers do --------------------------------------------------------------------------------------------------
def test_matrices_for_programs(optics):
    code, out, err = optics(
        "mueller",
        "polarizer_bench",
        "--set",
        "sample.retard_0=90",
        "--set",
        "sample.angle=30",
        "--wavelength",
        "540",
        "--wavelength",
        "460",
        "--json",
    )
    found = json.loads(out)
    assert code == 0 and found["wavelengths"] == [540, 460] and found["ends_on"] == "lamp" and found["at"] == [0.5, 0.5]
    layers = {layer["name"]: layer for layer in found["layers"]}
    assert list(layers) == ["analyzer", "middle", "sample", "polarizer"] and layers["sample"]["kind"] == "sheet"
    assert [b["retardance"] for b in layers["sample"]["bands"]] == pytest.approx([90, 90 * 540 / 460])
    assert layers["sample"]["bands"][0]["fast_axis"] == pytest.approx(30)
    assert layers["polarizer"]["bands"][0]["retardance"] is None  # a perfect polarizer; JSON has no NaN
    product = np.array(found["product"]["matrix"])
    whole = np.eye(4)
    for layer in found["layers"]:
        whole = whole @ np.array(layer["matrix"])
    np.testing.assert_allclose(product, whole, atol=1e-12)


def test_matrices_in_words(optics):
    code, out, err = optics("mueller", "vi2tap", *SMALL, "--at", "24.3,18.2")
    assert code == 0 and "analyzer, inner_face, silicone, film, outer_face; it ends on object" in out.splitlines()[0]
    assert "product: analyzer inner_face silicone film outer_face" in out and "n^2" in err
    row = next(line for line in out.splitlines() if line.startswith("film "))
    assert row.split()[:8] == [
        "film",
        "all",
        "bands",
        "0.402",
        "0.8",
        "0.004",
        "0.99005",
        "0.004447",
    ]  # a whisker off the axis
    code, out, _ = optics("mueller", "polarizer_bench", "--part", "middle", "--set", "middle.angle=30")
    assert code == 0 and "product" not in out and "0.8" not in out.splitlines()[3]


# -- a reading against an angle --------------------------------------------------------------------------------------
@pytest.fixture
def measured(tmp_path):
    """A table of readings that follow Malus, with two polarizer angles, a drive level of 0.5 and a clock."""
    noise, rng, frames = Noise(0.05, 0.5, 8.0, 4095.0, 0.0), np.random.default_rng(1), []
    for polarizer in (0.0, 30.0):
        for angle in np.arange(0, 180, 10.0):
            signal = 8 + 4087 * 0.5 * 0.32 * np.cos(np.radians(angle - polarizer)) ** 2
            reading = noise.expose(np.full((1, 1, 1), signal), rng).astype(np.float32)
            frames.append(
                capture_files.Frame(
                    f"r{len(frames)}",
                    reading,
                    parameters={
                        "analyzer.angle": angle,
                        "polarizer.angle": polarizer,
                        "source.power": 0.5,
                        "source.time": float(len(frames)),
                    },
                )
            )
    found = capture_files.Captures(
        Path("."), "polarizer_bench", frames, {}, noise, table=capture_files.Table("readings.csv", ["V"])
    )
    return capture_files.write(found, tmp_path / "set")


def test_a_sweep(optics, tmp_path):
    plot, table = tmp_path / "new" / "a.png", tmp_path / "a.csv"
    code, out, err = optics("sweep", "polarizer_bench", "--set", "analyzer.leak=0.004", "-o", plot, "--csv", table)
    assert code == 0, err
    assert out.splitlines()[-2:] == [str(plot), str(table)]
    assert out.splitlines()[2].split()[:6] == ["reading", "81.6", "0", "0.408", "90", "200"]
    rows = [line.split(",") for line in table.read_text().splitlines()]
    assert (
        rows[0] == ["analyzer.angle", "reading"]
        and len(rows) == 38
        and float(rows[10][1]) == pytest.approx((81.6 + 0.408) / 2)
    )
    with Image.open(plot) as shown:
        assert min(shown.size) > 400
    before = plot.read_bytes()
    assert optics("sweep", "polarizer_bench", "--steps", "5", "-o", plot)[0] == 2 and plot.read_bytes() == before
    found = json.loads(
        optics(
            "sweep",
            "polarizer_bench",
            "--key",
            "sample.depolarization",
            "--from",
            "0",
            "--to",
            "1",
            "--steps",
            "3",
            "--set",
            "analyzer.angle=90",
            "--json",
        )[1]
    )
    assert found["curves"][0]["readings"] == [[pytest.approx(255 * r, abs=1e-6)] for r in (0, 0.08, 0.16)]
    assert found["summary"][0]["extinction_ratio"] is None  # of a perfect zero


def test_a_sweep_beside_readings(optics, measured, tmp_path):
    code, out, err = optics("sweep", "polarizer_bench", "--captures", measured, "-o", tmp_path / "a.png", "--json")
    found = json.loads(out)
    assert code == 0 and [r["settings"] for r in found["summary"]] == [
        {"polarizer.angle": 0.0},
        {"polarizer.angle": 30.0},
    ]
    assert "source.time takes 36 values" in err
    for row in found["summary"]:  # photons: sqrt(0.05 x 650 at the top), half of that in the mean; DN that are rounded
        assert row["from_measured"] < 6
    _, out, _ = optics(
        "sweep",
        "polarizer_bench",
        "--captures",
        measured,
        "--set",
        "polarizer.angle=30",
        "--set",
        "source.power=2",
        "--json",
    )
    double = json.loads(out)["summary"]
    assert len(double) == 1 and double[0]["largest"] == pytest.approx(
        8 + 4087 * 0.32
    )  # the drive level times the power
    (tmp_path / "fit.toml").write_text('[parameters]\n"analyzer.offset" = 5.0\n')
    _, out, _ = optics("sweep", "polarizer_bench", "--captures", measured, "--fit", tmp_path / "fit.toml", "--json")
    assert json.loads(out)["summary"][0]["from_measured"] > 30


# -- what a user gets wrong ------------------------------------------------------------------------------------------
WRONG = [
    (["mueller", "polarizer_bench", "--at", "3,1"], r"--at 3,1: outside the image; allowed: .* to 1,1"),
    (
        ["mueller", "polarizer_bench", "--part", "analyser"],
        r"unknown layer 'analyser'; did you mean 'analyzer'\? the ray through",
    ),
    (
        ["mueller", "polarizer_bench", "--set", "analyzer.angel=3"],
        r"--set: unknown parameter .* did you mean 'analyzer.angle'",
    ),
    (["mueller", "polarizer_bench", "--wavelength", "5"], r"--wavelength 5: allowed: 100 to 10000 nm"),
    (
        ["mueller", "polarizer_bench", "-D", "x_fov=90", "--at", "0,0.5"],
        r"passes no layer; the scene has analyzer, .*: give another place",
    ),
    (["sweep", "gelsight"], r"unknown parameter 'analyzer.angle'.*`optics params SCENE`"),
    (["sweep", "polarizer_bench", "--key", "analyzer.leak"], r"analyzer.leak: --from is missing; allowed: 0 to 1"),
    (
        ["sweep", "polarizer_bench", "--key", "analyzer.leak", "--from", "0", "--to", "2"],
        r"analyzer.leak = .* is outside its bounds",
    ),
    (
        ["sweep", "polarizer_bench", "--key", "sample.stress_pattern"],
        r"is a word .*allowed: a parameter that is a number",
    ),
    (["sweep", "polarizer_bench", "--to", "0"], r"--from and --to are both 0 deg; allowed: two values"),
    (["sweep", "polarizer_bench", "-o", "{tmp}/a.jpg"], r"'.jpg' is no format of a plot; allowed: .*png"),
    (["sweep", "polarizer_bench", "--captures", "{tmp}/none"], r"no such file; a capture set is a folder"),
    (["sweep", "polarizer_bench", "--captures", "{set}", "--radiance"], r"readings are DN; leave out one"),
    (
        ["sweep", "polarizer_bench", "--captures", "{set}", "--key", "middle.angle"],
        r"no reading sets 'middle.angle'; they set analyzer.angle",
    ),
    (
        ["sweep", "polarizer_bench", "--captures", "{set}", "--set", "polarizer.angle=7"],
        r"none of 36 readings agrees with --set",
    ),
    (
        ["sweep", "polarizer_bench", "--captures", "{set}", "-D", "bands=620, 540, 460"],
        r"readings of 1 channels, .* has 3; load",
    ),
    (["sweep", "polarizer_bench", "--fit", "{tmp}/fit.toml"], r"fit.toml: no such file; a study writes one"),
    (
        ["render", "gelsight", *SMALL, "-o", "{tmp}/a.exr", "--stokes", "--variant", "llvm_ad_rgb"],
        r"no Stokes vectors .*allowed: .*'polarized'",
    ),
]


@pytest.mark.parametrize("arguments, message", WRONG, ids=[" ".join(a[:1] + a[-2:]) for a, _ in WRONG])
def test_errors_are_one_line(optics, measured, tmp_path, arguments, message):
    import re

    before = sorted(p for p in tmp_path.rglob("*"))
    code, out, err = optics(*(a.replace("{tmp}", str(tmp_path)).replace("{set}", str(measured)) for a in arguments))
    assert (code, out) == (2, "") and len(err.splitlines()) == 1 and re.search(message, err), err
    assert sorted(p for p in tmp_path.rglob("*")) == before


def test_maps_are_claimed_before_any_work(optics, tmp_path):
    (tmp_path / "a.aolp.png").write_text("mine")
    code, _, err = optics("render", "polarizer_bench", "-o", tmp_path / "a.exr", "--stokes")
    assert code == 2 and "a.aolp.png exists" in err and [p.name for p in tmp_path.iterdir()] == ["a.aolp.png"]
