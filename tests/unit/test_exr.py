"""What is written as EXR or PNG comes back, and never half-written."""

import json

import numpy as np
import pytest

from optics.files import exr


@pytest.fixture
def rng():
    return np.random.default_rng(1)


def test_round_trip_is_exact(tmp_path, rng):
    channels = {name: rng.normal(size=(5, 7)).astype(np.float32) for name in ("R", "G", "B", "depth.Z", "normal.X")}
    channels["depth.Z"][0, 0] = np.inf  # a ray that met nothing
    channels["normal.X"][1, 1] = np.nan
    header = {"units": "DN", "exposure_ms": 0.1, "frame": 3, "comment": "5 µm ± 1"}
    back, read_header = exr.read(exr.write(tmp_path / "new" / "image.exr", channels, header))
    assert set(back) == set(channels)
    for name, values in channels.items():
        assert back[name].dtype == np.float32
        np.testing.assert_array_equal(back[name], values)  # float32 in, float32 out: no tolerance
    assert read_header == header


def test_provenance_is_json_in_the_header(tmp_path):
    provenance = {"version": "0.1.0", "seed": 3, "scene": {"led.power": 1.25}, "note": "x" * 5000}
    exr.write(tmp_path / "a.exr", {"Y": np.ones((2, 3))}, {"provenance": provenance})
    assert json.loads(exr.read(tmp_path / "a.exr")[1]["provenance"]) == provenance


def test_half_channels_keep_eleven_bits(tmp_path, rng):
    values = rng.uniform(1, 100, (8, 8))
    back, _ = exr.read(exr.write(tmp_path / "a.exr", {"Y": values, "variance.Y": values}, half=["variance.Y"]))
    np.testing.assert_allclose(back["variance.Y"], values, rtol=2**-11)  # half a unit of a 11-bit significand
    np.testing.assert_allclose(back["Y"], values, rtol=2**-24)


@pytest.mark.parametrize("components", [1, 4])
def test_spectral_names_and_back(tmp_path, rng, components):
    bands = [460.0, 525.0, 630.5]
    stokes = rng.normal(size=(4, 6, 3, components)).astype(np.float32)
    channels = exr.spectral_channels(bands, stokes if components == 4 else stokes[..., 0])
    assert list(channels)[:3] == ["S0.460,000000nm", "S0.525,000000nm", "S0.630,500000nm"]
    assert ("S3.525,000000nm" in channels) == (components == 4)
    preview = exr.preview_channels(bands, stokes[..., 0])
    header = exr.spectral_header(components == 4)
    back, read_header = exr.read(exr.write(tmp_path / "s.exr", {**preview, **channels}, header))
    read_bands, read_stokes = exr.spectral_image(back)
    np.testing.assert_array_equal(read_bands, bands)
    np.testing.assert_array_equal(read_stokes, stokes)
    assert read_header == header and header["spectralLayoutVersion"] == "1.0"
    assert ("polarisationHandedness" in header) == (components == 4)


def test_a_reader_of_the_convention_opens_it(tmp_path, rng):
    """colour-science's reader of Spectral EXR finds every band and Stokes component."""
    pytest.importorskip("OpenImageIO")
    import colour

    bands = [400.0, 452.5, 700.0]
    stokes = rng.normal(size=(6, 8, 3, 4)).astype(np.float32)
    exr.write(tmp_path / "s.exr", exr.spectral_channels(bands, stokes), exr.spectral_header(True))
    found = colour.read_spectral_image_Fichet2021(str(tmp_path / "s.exr"))
    for k in range(4):
        nm, values = found[f"S{k}"]
        np.testing.assert_allclose(nm, bands)
        np.testing.assert_array_equal(values, stokes[..., k])


def test_preview_has_the_colour_of_the_light():
    one = np.eye(3)[None]  # three pixels, each lit in one band
    rgb = np.stack(list(exr.preview_channels([460.0, 530.0, 640.0], one).values()), -1)[0]
    assert list(rgb.argmax(axis=1)) == [2, 1, 0]
    flat = exr.preview_channels(np.arange(400.0, 701.0, 5.0), np.ones((1, 1, 61)))
    luminance = 0.2126 * flat["R"] + 0.7152 * flat["G"] + 0.0722 * flat["B"]
    assert luminance[0, 0] == pytest.approx(1.0, abs=1e-3)  # the sRGB matrix is printed to four digits


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    file = exr.write(tmp_path / "a.exr", {"Y": np.ones((2, 2))})
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        exr.write(file, {"Y": np.zeros((2, 2))})
    monkeypatch.undo()
    assert exr.read(file)[0]["Y"].min() == 1.0
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


@pytest.mark.parametrize(
    ("channels", "options", "text"),
    [
        ({}, {}, "no channels"),
        ({"Y": np.ones((2, 2, 3))}, {}, r"\(H, W\)"),
        ({"Y": np.ones((2, 2), complex)}, {}, "complex128"),
        ({"": np.ones((2, 2))}, {}, "a name"),
        ({"R": np.ones((2, 2)), "G": np.ones((2, 3))}, {}, "one size"),
        ({"Y": np.full((2, 2), 1e39)}, {}, "do not fit float32"),
        ({"Y": np.full((2, 2), 1e5)}, {"half": ["Y"]}, "do not fit float16"),
        ({"Y": np.ones((2, 2))}, {"half": ["X"]}, "no such channel"),
        ({"Y": np.ones((2, 2))}, {"header": {"compression": "none"}}, "belongs to the format"),
        ({"Y": np.ones((2, 2))}, {"header": {"done": True}}, "allowed: text"),
    ],
)
def test_bad_writes_say_why(tmp_path, channels, options, text):
    with pytest.raises(ValueError, match=text):
        exr.write(tmp_path / "a.exr", channels, **options)
    assert not list(tmp_path.iterdir())


def test_bad_reads_say_why(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        exr.read(tmp_path / "a.exr")
    (tmp_path / "a.exr").write_bytes(b"not an image")
    with pytest.raises(ValueError, match="unreadable as EXR"):
        exr.read(tmp_path / "a.exr")
    whole = exr.write(tmp_path / "b.exr", {"Y": np.random.default_rng(0).normal(size=(64, 64))}).read_bytes()
    (tmp_path / "b.exr").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="unreadable as EXR"):
        exr.read(tmp_path / "b.exr")


@pytest.mark.parametrize(
    ("bands", "shape"), [([500], (2, 2)), ([500], (2, 2, 2)), ([500, 600], (2, 2, 2, 3)), ([500, 500], (2, 2, 2))]
)
def test_bad_spectra_say_why(bands, shape):
    with pytest.raises(ValueError, match="allowed|the same"):
        exr.spectral_channels(bands, np.zeros(shape))


def test_incomplete_stokes_vectors_are_refused():
    with pytest.raises(ValueError, match="S0 to S3"):
        exr.spectral_image({"S0.500,000000nm": np.zeros((2, 2)), "S1.500,000000nm": np.zeros((2, 2))})


def test_png_shows_dn_as_they_are_and_light_as_srgb(tmp_path):
    from PIL import Image

    dn = np.arange(256.0).reshape(16, 16)
    assert np.array_equal(Image.open(exr.write_png(tmp_path / "dn.png", dn, white=255, tone="linear")), dn)
    light = Image.open(exr.write_png(tmp_path / "light.png", np.full((2, 3, 3), 0.5)))
    assert light.size == (3, 2) and np.all(np.array(light) == 188)  # sRGB of 0.5 is 0.7354 = 187.5 / 255
    assert exr.srgb(np.array([-1.0, 0.0, 0.0031308, 1.0, 2.0])) == pytest.approx([0, 0, 0.04045, 1, 1], abs=1e-5)
    bands = Image.open(exr.write_png(tmp_path / "bands.png", np.arange(6.0)[None, None], white=255, tone="linear"))
    assert np.array_equal(np.array(bands)[0, 0], [4, 2, 0])  # means 4.5, 2.5, 0.5 of thirds, rounded to even
    for bad, options in (
        (np.full((2, 2), np.nan), {}),
        (np.zeros((2, 2, 2, 2)), {}),
        (dn, {"tone": "film"}),
        (dn, {"white": 0}),
    ):
        with pytest.raises(ValueError, match="allowed|not finite"):
            exr.write_png(tmp_path / "bad.png", bad, **options)
