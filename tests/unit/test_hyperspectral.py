"""Hyperspectral images become capture sets: three formats of one cube, what is refused, and a model that predicts
it."""

import numpy as np
import pytest
from PIL import Image

from optics.captures import capture_set, hyperspectral
from optics.errors import BadCapture, OutputExists
from optics.files import exr
from optics.light.rendering import RenderJob
from optics.scene import loader

NM = np.arange(450.0, 651.0, 10.0)
NUMBERS = {"system_gain": 0.02, "dark_noise": 1.0}


@pytest.fixture(scope="module")
def cube():
    return np.random.default_rng(3).integers(20, 4000, (6, 8, len(NM))).astype("u2")


def envi(file, values, order="bil", kind=">u2", **changed):
    """An ENVI header and its raw file."""
    code = {"u1": 1, "f4": 4, "u2": 12}[kind[-2:]]
    fields = {
        "samples": values.shape[1],
        "lines": values.shape[0],
        "bands": values.shape[2],
        "header offset": 4,
        "data type": code,
        "interleave": order,
        "byte order": int(kind[0] == ">"),
        "wavelength units": "Nanometers",
        "wavelength": "{ " + ",\n ".join(f"{n:g}" for n in NM) + "}",
        "fwhm": "{" + ", ".join(["12.5"] * len(NM)) + "}",
        **changed,
    }
    text = "".join(f"{name} = {value}\n" for name, value in fields.items() if value is not None)
    # a description in the encoding of the instrument's maker
    file.write_bytes(f"ENVI\ndescription = {{a cube at 20 °C, of\n two lines}}\n{text}".encode("latin-1"))
    stored = values.transpose({"bsq": (2, 0, 1), "bil": (0, 2, 1), "bip": (0, 1, 2)}[order]).astype(kind)
    file.with_suffix(".raw").write_bytes(b"\0\0\0\0" + stored.tobytes())
    return file


@pytest.mark.parametrize(("order", "kind"), [("bsq", "<u2"), ("bil", ">u2"), ("bip", "<f4")])
def test_a_cube_comes_in_from_envi(cube, tmp_path, order, kind):
    read = hyperspectral.import_cubes(envi(tmp_path / "a.hdr", cube, order, kind), tmp_path / "set", **NUMBERS)
    captures = capture_set.load(read.folder)
    assert np.array_equal(captures.frames[0].image, cube.astype(np.float32)) and captures.bands == "auto"
    assert captures.noise.saturation == (65535.0 if kind[1] == "u" else cube.max())
    assert f"sensitivity={tmp_path / 'set'}" in read.warnings[-1]
    from optics.spectra.reading import read_channels

    curves = read_channels("sensitivities.csv", [read.folder])
    assert [c.centre for c in curves] == pytest.approx(NM, abs=0.01)  # six digits of a table in steps of 0.5 nm
    assert curves[3](NM[3] + 12.5 / 2) == pytest.approx(0.5, abs=1e-2)  # the given width, between points of the table


def test_spectral_exr_and_narrow_images_are_the_same_cube(cube, tmp_path):
    """The EXR's bands in any order; images of one press each, two presses told apart by their names."""
    shuffled = np.random.default_rng(0).permutation(len(NM))
    exr.write(tmp_path / "a.exr", exr.spectral_channels(NM[shuffled], cube[..., shuffled].astype(float)))
    hyperspectral.import_cubes(tmp_path / "a.exr", tmp_path / "one", **NUMBERS)
    folder = tmp_path / "narrow"
    folder.mkdir()
    for press in (1.0, 2.0):
        for b, nm in enumerate(NM):
            Image.fromarray((cube[..., b] + int(press)).astype("u2")).save(folder / f"x={press:g}__skin {nm:g}nm.png")
    hyperspectral.import_cubes(folder, tmp_path / "two", rename={"x": "gel.press_x"}, **NUMBERS)
    one, two = capture_set.load(tmp_path / "one"), capture_set.load(tmp_path / "two")
    assert np.array_equal(one.frames[0].image, cube.astype(np.float32))
    assert [f.parameters for f in two.frames] == [{"gel.press_x": 1.0}, {"gel.press_x": 2.0}]
    assert all(np.array_equal(f.image, cube + np.float32(k)) for k, f in enumerate(two.frames, 1))


def test_bands_are_joined_and_pixels_averaged(cube, tmp_path):
    """Means of three bands at 460, 490, ... and of 2 x 2 pixels; the variance of what three bands of 12.5 nm at steps
    of 10 nm see is theirs and that of their centres, 200/3 nm^2."""
    cube = cube.copy()
    cube[0, 0, 0] = 7
    cube[4, 3, 1] = 4095  # saturated at 12 bits: so is the mean that it is part of
    file = envi(tmp_path / "a.hdr", cube, **{"data ignore value": 7})
    hyperspectral.import_cubes(file, tmp_path / "set", bands="460:640:30", bin=2, bits=12, **NUMBERS)
    captures = capture_set.load(tmp_path / "set")
    expected = cube.astype(float).reshape(3, 2, 4, 2, 7, 3).mean((1, 3, 5))
    expected[2, 1, 0] = 4095
    assert captures.frames[0].image[1:] == pytest.approx(expected[1:], rel=1e-6)
    assert captures.frames[0].mask.sum() == 11 and not captures.frames[0].mask[0, 0]
    assert captures.noise.dark_noise == pytest.approx(1 / np.sqrt(12))
    joined, _ = hyperspectral._joined(hyperspectral.read_envi(file), "460:640:30", "")
    assert joined.width == pytest.approx(np.sqrt(12.5**2 + 8 * np.log(2) * 200 / 3))
    pairs, count = hyperspectral._joined(hyperspectral.read_envi(file), "460:640:20", "")
    assert count == 2 and pairs.nm == pytest.approx(np.arange(455.0, 636.0, 20.0)), "a band on a border is used once"


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"wavelength": None}, "wavelength missing"),
        ({"wavelength": "{1, 2}"}, "2 wavelengths and 21 fwhm of 21 bands"),
        ({"wavelength": "{" + ", ".join(f"{n / 1000:g}" for n in NM) + "}"}, "wavelength units = micrometers"),
        ({"wavelength": "{" + ", ".join(["500"] * 21) + "}"}, "500 nm twice"),
        ({"wavelength units": "wavenumber"}, "allowed: nanometers"),
        ({"data type": 6}, "data type = 6.*real numbers"),
        ({"lines": 7}, "bytes; allowed: .* by the header"),
        ({"samples": "many"}, "samples = many; allowed: a whole number"),
    ],
)
def test_a_bad_header_is_refused(cube, tmp_path, changed, says):
    with pytest.raises(BadCapture, match=says):
        hyperspectral.import_cubes(envi(tmp_path / "a.hdr", cube, **changed), tmp_path / "set", **NUMBERS)
    assert not (tmp_path / "set").exists()


def test_what_is_no_cube_is_refused(cube, tmp_path):
    file = envi(tmp_path / "a.hdr", cube)
    with pytest.raises(BadCapture, match="none of the source's bands"):
        hyperspectral.import_cubes(file, tmp_path / "set", bands="400:700:10", **NUMBERS)
    with pytest.raises(BadCapture, match="both, or neither"):
        hyperspectral.import_cubes(file, tmp_path / "set", dark_noise=1.0)
    read = hyperspectral.import_cubes(file, tmp_path / "plain", black_level=8.0)
    assert "black_level = 8 DN belongs to [noise]" in read.warnings[0]
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("kept")
    with pytest.raises(OutputExists):
        hyperspectral.import_cubes(file, tmp_path / "mine", overwrite=True, **NUMBERS)
    file.with_suffix(".raw").unlink()
    with pytest.raises(BadCapture, match="no raw file beside it"):
        hyperspectral.import_cubes(file, tmp_path / "set", **NUMBERS)
    exr.write(tmp_path / "mine" / "rgb.exr", dict(zip("RGB", np.zeros((3, 4, 4)))))
    assert not hyperspectral.is_cube_source(tmp_path / "mine") and hyperspectral.is_cube_source(tmp_path)
    with pytest.raises(BadCapture, match="do not fit 8 bit"):
        hyperspectral.import_cubes(envi(tmp_path / "b.hdr", cube), tmp_path / "set", bits=8, **NUMBERS)


@pytest.mark.slow
def test_a_model_predicts_what_a_hyperspectral_camera_saw(mitsuba, tmp_path):
    """Radiance per nm that DIGIT sends, rendered at every 2.5 nm and blurred by bands of 15 nm in plain numpy, is what
    auto bands predict of the imported set: chi2 by the noise that was put in, and the exposure that was hidden."""
    from optics.captures.noise import Noise
    from optics.facade import compare

    size = {"width": "12", "height": "16", "depth": "0.5"}
    nm = np.arange(400.0, 700.1, 2.5)
    rendered = RenderJob(loader.load("digit", {**size, "bands": "400:700:2.5"})).take().channels
    radiance = exr.spectral_image(rendered)[1][..., 0]
    centres = np.arange(450.0, 651.0, 10.0)
    seen = np.exp(-4 * np.log(2) * ((nm - centres[:, None]) / 15.0) ** 2)
    signal = radiance @ seen.T * 2.5
    gain, noise = 3000.0 / signal.max(), Noise(0.05, 2.0, 64.0, 4095.0, 0.0)
    values = np.clip(noise.expose(64.0 + gain * signal, np.random.default_rng(1)), 0, 4095).astype("u2")
    header = {"wavelength": "{" + ",".join(f"{n:g}" for n in centres) + "}", "fwhm": "{" + "15, " * 20 + "15}"}
    camera = {"system_gain": 0.05, "dark_noise": 2.0, "black_level": 64.0, "bits": 12}
    read = hyperspectral.import_cubes(envi(tmp_path / "a.hdr", values, **header), tmp_path / "set", **camera)
    defines = {**size, "sensitivity": str(read.folder / "sensitivities.csv")}
    scene = loader.load("digit", {**defines, "bands": "auto"})
    exposure = gain / (4095.0 - 64.0) * scene.integral.unit
    found = compare(read.folder, values={"camera.exposure": exposure}, defines=defines).comparison
    # 4032 values: the standard deviation of chi2 a value is 0.022
    assert found.total.chi2_per_dof == pytest.approx(1.0, abs=0.07), found.text()
