"""A capture set is read exactly, and everything that is wrong with one is said before anything is rendered."""

import math
import os
import re

import numpy as np
import OpenEXR
import pytest
import tifffile
from PIL import Image

from optics.captures import capture_set as captures
from optics.captures.noise import Noise
from optics.errors import BadCapture, OutOfBounds, OutputExists, UnknownKey
from optics.files import exr
from optics.files.images import read_image
from optics.scene.parameter import Parameter

NOISE = "[noise]\nsystem_gain = 0.05\ndark_noise = 1.5\nblack_level = 8.0\nsaturation = 255.0\nprnu = 0.003\n"
FRAME = '[[frames]]\nimage = "frames/000.png"\n'
BENCH = 'scene = "bench"\n[table]\nfile = "malus.csv"\nvalues = ["reading"]\n'


@pytest.fixture
def folder(tmp_path):
    """Two gray frames, a repeat, masks, images of other kinds and a table; the test writes `captures.toml`."""
    rng = np.random.default_rng(0)
    (tmp_path / "frames").mkdir()
    frames = tmp_path / "frames"
    gray = rng.integers(10, 200, (6, 8)).astype(np.uint8)

    def save(name, array):
        Image.fromarray(array).save(frames / name)

    for name in ("000.png", "000b.png", "001.png"):
        save(name, gray + rng.integers(0, 9, gray.shape).astype(np.uint8))
    save("rgb.png", rng.integers(0, 200, (6, 8, 3)).astype(np.uint8))
    save("other_size.png", gray[:4])
    save("white.png", np.full_like(gray, 255))
    save("mask.png", (gray > 60).astype(np.uint8))
    save("empty.png", np.zeros_like(gray))
    save("alpha.png", rng.integers(0, 200, (6, 8, 4)).astype(np.uint8))
    save("deep.png", gray.astype(np.uint16) * 40)
    Image.fromarray(gray).convert("P").save(frames / "palette.png")
    Image.fromarray(gray > 60).save(frames / "bits.png")
    Image.fromarray(gray).save(frames / "lossy.jpg")
    (frames / "text.png").write_text("no image")
    (frames / "cut.png").write_bytes((frames / "000.png").read_bytes()[:60])
    nan, inf = gray.astype(np.float32), gray.astype(np.float32)
    nan[2, 3], inf[0, 0] = np.nan, np.inf
    for name, array in (
        ("nan", nan),
        ("inf", inf),
        ("complex", gray + 0j),
        ("words", np.full((6, 8), "x")),
        ("object", np.array([[None]])),
        ("cube", np.zeros((2, 6, 8, 3))),
        ("front", np.zeros((3, 6, 80))),
        ("huge", np.full((6, 8), 1e300)),
    ):
        np.save(frames / f"{name}.npy", array)
    tifffile.imwrite(frames / "pages.tif", np.stack([gray, gray]), photometric="minisblack")
    Image.fromarray(gray).save(
        frames / "animated.png", save_all=True, append_images=[Image.fromarray(gray + 1)], duration=100
    )
    os.mkfifo(frames / "pipe.png")
    (frames / "turn.png").symlink_to("turn.png")
    save("caf\u00e9.png", gray)
    box = {"dataWindow": [[5, 5], [12, 10]], "displayWindow": [[0, 0], [15, 11]]}
    corners = {k: tuple(np.array(corner, np.int32) for corner in v) for k, v in box.items()}
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.NO_COMPRESSION, **corners}
    OpenEXR.File(header, {"Y": gray.astype(np.float32)}).write(str(frames / "part.exr"))
    exr.write(frames / "depth.exr", {"depth.Z": np.ones((6, 8)), "Y": np.ones((6, 8))})
    (tmp_path / "malus.csv").write_text("angle (rad),reading\n0.0,100\n0.7853981634,50.5\n1.5707963268,1\n")
    (tmp_path / "bad.csv").write_text("analyzer.angle,reading\n0,1\n10,nan\n20,dark\n30\n")
    (tmp_path / "spread.csv").write_text("analyzer.angle,sd,reading\n0,1,10\n10,-1,9\n")
    (tmp_path / "scene.xml").write_text("<scene version='3.0.0'/>")
    return tmp_path


def load(folder, text):
    (folder / "captures.toml").write_text(text, encoding="utf-8")
    return captures.load(folder)


# -- What is right ---------------------------------------------------------------------------------------------------
def test_every_key_of_the_format(folder):
    Image.fromarray(np.full((6, 8), 200, np.uint8)).save(folder / "background.png")
    c = load(
        folder,
        'scene = "scene.xml"\nflat_field = "background.png"\ncfa = "RGGB"\nvalues_are = "DN"\n'
        + NOISE
        + '[parameters]\n"camera.x_fov" = 40\n"indenter.shape" = "ball"\n'
        + FRAME
        + 'mask = "frames/mask.png"\nrepeats = ["frames/000b.png"]\ngroup = "press-03"\n[frames.parameters]\n'
        '"led_red.power" = 1.0\n"analyzer.angle" = 45\n[[frames]]\nimage = "frames/001.png"\n',
    )
    frame = c.frames[0]
    assert c.folder == folder and c.scene == str((folder / "scene.xml").resolve()) and c.cfa == "RGGB" and c.bits == 8
    assert c.noise == Noise(0.05, 1.5, 8.0, 255.0, 0.003, quantisation=1.0)
    assert c.parameters == {"camera.x_fov": 40.0, "indenter.shape": "ball"}
    assert frame.parameters == {"led_red.power": 1.0, "analyzer.angle": 45.0}
    assert (frame.name, frame.file, frame.group, len(frame.repeats)) == ("000", "frames/000.png", "press-03", 1)
    assert frame.image.shape == (6, 8, 1) and frame.image.dtype == np.float32
    np.testing.assert_array_equal(frame.image[..., 0], np.array(Image.open(folder / "frames/000.png")))
    np.testing.assert_array_equal(frame.mask, np.array(Image.open(folder / "frames/mask.png")) > 0)
    assert np.all(c.flat_field == 200) and c.frames[1].mask is None and c.warnings == []
    assert captures.groups(c) == {"press-03": [0], "001": [1]}
    assert captures.load(folder / "captures.toml").frames[1].name == "001"


def test_table_rows_become_frames_of_one_pixel(folder):
    c = load(
        folder, BENCH + 'rename = { "angle (rad)" = "analyzer.angle" }\nscale = { "analyzer.angle" = 57.29577951 }\n'
    )
    assert [f.image.shape for f in c.frames] == [(1, 1, 1)] * 3 and c.table.values == ["reading"]
    assert [float(f.image[0, 0, 0]) for f in c.frames] == [100.0, 50.5, 1.0]
    assert [f.parameters["analyzer.angle"] for f in c.frames] == pytest.approx(
        [0, 45, 90], abs=1e-6
    )  # ten digits in the file


DIODE = """# an instrument's own header, which is not read
made on a Monday; 20 readings
run;Winkel/rad;sd/deg;U/V
a;0;0,25;1,002
a;0;0,25;0,998

b;1,5;1;-0,104
b;1,5;1;-0,101
"""
DIODE_TOML = """scene = "bench"
bands = [540]
absent = ["sample"]
[uncertainty]
"polarizer.angle" = 0.5
[parameters]
"polarizer.angle" = 10
[exclude]
"gain drift" = "fixed gain, checked before and after"
[table]
file = "diode.txt"
values = ["U/V"]
delimiter = ";"
decimal = ","
skip = 2
group = "run"
rename = { "Winkel/rad" = "analyzer.angle" }
scale = { "analyzer.angle" = 57.29577951, "U/V" = 1000 }
offset = { "analyzer.angle" = 3.0, "U/V" = 100 }
uncertainty = { "analyzer.angle" = "sd/deg" }
"""


def test_a_table_as_an_instrument_writes_it(folder):
    """A photodiode in volts: semicolons, decimal commas, lines above the header, a negative reading."""
    (folder / "diode.txt").write_text(DIODE)
    c = load(folder, DIODE_TOML)
    assert (c.bands, c.absent, c.uncertainty) == ([540.0], ["sample"], {"polarizer.angle": 0.5})
    assert c.exclude == {"gain drift": "fixed gain, checked before and after"}
    values = [float(f.image[0, 0, 0]) for f in c.frames]
    assert values == pytest.approx([1102, 1098, -4, -1])  # 1000 U + 100: below 0 it is a reading like any other
    assert [f.parameters["analyzer.angle"] for f in c.frames] == pytest.approx([3, 3, 88.943669, 88.943669])
    assert [f.uncertainty for f in c.frames] == [{"analyzer.angle": sd} for sd in (0.25, 0.25, 1.0, 1.0)]
    assert captures.groups(c) == {"a": [0, 1], "b": [2, 3]}
    assert c.step == pytest.approx(1.0)  # 0.001 V, times 1000
    assert sum("not known" in w for w in c.warnings) == 1 and not any("repeats" in w for w in c.warnings)
    assert c.uncertainty_of(c.frames[2]) == {"analyzer.angle": 1.0}


@pytest.mark.parametrize(
    ("delimiter", "text"),
    [
        ("\\t", "a.b\treading\n1\t2.5\n3\t4\n"),
        (" ", "  a.b   reading\n 1  2.5\n3       4\n"),
        (";", "a.b;reading;\n1;2.5;\n3;4;\n"),  # a delimiter at the end of each line
    ],
)
def test_delimiters(folder, delimiter, text):
    (folder / "malus.csv").write_text(text)
    c = load(folder, BENCH + f'delimiter = "{delimiter}"\n')
    assert [(f.parameters, float(f.image.item())) for f in c.frames] == [({"a.b": 1.0}, 2.5), ({"a.b": 3.0}, 4.0)]


def test_scale_may_name_a_column_as_it_is_in_the_file(folder):
    c = load(folder, BENCH + 'rename = { "angle (rad)" = "a.b" }\nscale = { "angle (rad)" = 57.29577951 }\n')
    assert [f.parameters["a.b"] for f in c.frames] == pytest.approx([0, 45, 90], abs=1e-6)


def test_of_a_table_the_noise_is_one_number_and_nothing_is_masked(folder):
    """A lux meter: no saturation, no black level, no gain; readings at and below 0 are used."""
    (folder / "malus.csv").write_text("a.b,reading\n0,705\n45,350\n90,0\n90,-2\n")
    c = load(folder, BENCH + "[noise]\ndark_noise = 2.0\n")
    assert not c.noise.ends and c.noise.signed and c.noise.system_gain == 0 and c.noise.saturation == 705
    assert all(c.noise.usable(f.image).all() for f in c.frames)
    assert float(c.noise.variance(-2.0)) == pytest.approx(4 + 1 / 12)  # whole lux
    ends = load(folder, BENCH + "[noise]\ndark_noise = 2.0\nsaturation = 720\n")
    assert [bool(ends.noise.usable(f.image).all()) for f in ends.frames] == [False, True, True, True]
    assert not any("not known" in w for w in ends.warnings)
    # a reading at the end of the scale is not used, and no reason to refuse the others; all of them are
    cut = load(folder, BENCH + "[noise]\ndark_noise = 2.0\nsaturation = 700\n")
    assert [bool(cut.noise.usable(f.image).all()) for f in cut.frames] == [False, True, True, True]
    (folder / "malus.csv").write_text("a.b,reading\n0,705\n45,750\n")
    with pytest.raises(BadCapture, match="none of the 2 values of .malus.csv. .* is usable"):
        load(folder, BENCH + "[noise]\ndark_noise = 2.0\nsaturation = 700\n")
    (folder / "malus.csv").write_text("a.b,reading\n0,705\n45,350\n90,0\n90,-2\n")
    with pytest.raises(BadCapture, match=r"dark_noise \(DN, rms\) missing; give the standard deviation of a reading"):
        load(folder, BENCH + "[noise]\nsaturation = 720\n")


def test_a_flat_field_per_frame(folder):
    for name, level in (("red", 100), ("green", 50)):
        Image.fromarray(np.full((6, 8), level, np.uint8)).save(folder / f"{name}.png")
    c = load(
        folder,
        'scene = "bench"\nflat_field = "red.png"\n'
        + NOISE
        + FRAME
        + 'flat_field = "green.png"\n[frames.uncertainty]\n"gel.press_x" = 0.02\n[frames.parameters]\n'
        + '"gel.press_x" = 1\n[[frames]]\nimage = "frames/001.png"\n',
    )
    assert np.all(c.frames[0].flat_field == 50) and c.frames[1].flat_field is None and np.all(c.flat_field == 100)
    assert c.frames[0].uncertainty == {"gel.press_x": 0.02} and c.frames[1].uncertainty == {}
    back = captures.load(captures.write(c, folder / "copy", bits=8))
    assert np.all(back.frames[0].flat_field == 50) and back.frames[1].flat_field is None
    assert back.frames[0].uncertainty == {"gel.press_x": 0.02}


def test_what_costs_trust_is_a_warning(folder):
    text = 'scene = "bench"\n[[frames]]\nimage = "frames/rgb.png"\n'
    assert any("demosaiced" in w and "cfa" in w for w in load(folder, text + NOISE).warnings)
    measured = load(folder, 'cfa = "none"\n' + text + NOISE)  # as of three sensors
    assert measured.cfa is None and not any("demosaiced" in w for w in measured.warnings)
    again = captures.load(captures.write(measured, folder / "copy", bits=8))
    assert again.cfa is None and not any("demosaiced" in w for w in again.warnings)
    assert any("repeated frames" in w for w in load(folder, text).warnings)
    assert load(folder, 'scene = "bench"\n' + FRAME + NOISE).warnings == []


def test_a_frame_below_its_black_level_is_refused_only_where_it_is_cut_off(folder):
    sunk = 'scene = "bench"\n[[frames]]\nimage = "frames/sunk.png"\n' + FRAME + NOISE.replace("1.5", "1.0")

    def frame(values):
        Image.fromarray(values.astype(np.uint8)).save(folder / "frames" / "sunk.png")

    dark = np.random.default_rng(0).integers(0, 2, (6, 8))  # DN, for a black level of 8
    frame(np.maximum(dark, 1))
    warned = "frame 0 .*half of its values are 1 DN or less.*black_level is too high, or the camera has a dark offset"
    assert any(re.search(warned, w) for w in load(folder, sunk).warnings)
    frame(dark * 0)
    with pytest.raises(BadCapture, match="half of its values are 0 DN or less.*correct .noise. black_level"):
        load(folder, sunk)


@pytest.mark.parametrize(
    ("suffix", "dtype", "channels"),
    [
        *[
            (suffix, dtype, channels)
            for suffix in (".png", ".tif", ".tiff")
            for dtype in (np.uint8, np.uint16)
            for channels in (1, 3)
        ],
        *[(".npy", dtype, channels) for dtype in (np.uint8, np.uint16, np.float32) for channels in (1, 3, 5)],
        (".exr", np.float32, 1),
        (".exr", np.float32, 3),
        (".tif", np.float32, 1),
    ],
)
def test_files_are_read_to_the_last_digit(tmp_path, suffix, channels, dtype):
    rng = np.random.default_rng(3)
    top = 1 if dtype == np.float32 else np.iinfo(dtype).max
    image = (rng.random((5, 7, channels)) * top).astype(dtype)
    file = tmp_path / f"image{suffix}"
    if suffix == ".npy":
        np.save(file, image if channels > 1 else image[..., 0])
    elif suffix == ".exr":
        exr.write(file, dict(zip("RGB" if channels == 3 else "Y", np.moveaxis(image, -1, 0))))
    elif suffix != ".png":
        tifffile.imwrite(file, image if channels > 1 else image[..., 0])
    elif channels == 3 and dtype == np.uint16:
        file.write_bytes(png_of_16_bit_colour(image))
    else:
        Image.fromarray(image if channels > 1 else image[..., 0]).save(file)
    back, bits = read_image(file, "here")
    np.testing.assert_array_equal(back, image.astype(np.float32))
    assert bits == {np.uint8: 8, np.uint16: 16, np.float32: None}[dtype]


def png_of_16_bit_colour(image):
    """A PNG by the letter of its standard, independent of the decoder: chunks of length, name, data, CRC."""
    import struct
    import zlib

    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    height, width, _ = image.shape
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in image)
    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def test_planar_and_lzw_tiff(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (5, 7, 3)).astype(np.uint8)
    tifffile.imwrite(tmp_path / "p.tif", np.moveaxis(image, -1, 0), photometric="rgb", planarconfig="separate")
    Image.fromarray(image).save(tmp_path / "l.tif", compression="tiff_lzw")
    for name in ("p.tif", "l.tif"):
        np.testing.assert_array_equal(read_image(tmp_path / name, "here")[0], image)


def test_the_step_is_read_off_the_images(folder):
    values = 16 * np.arange(48).reshape(6, 8)  # 12 bit in the upper bits of 16
    Image.fromarray(values.astype(np.uint16)).save(folder / "frames/000.png")
    assert load(folder, 'scene = "bench"\n' + NOISE + FRAME).noise.quantisation == 16.0
    np.save(folder / "frames/mean.npy", values / 3)
    assert load(folder, 'scene = "bench"\n' + NOISE + FRAME.replace("000.png", "mean.npy")).noise.quantisation == 0.0


def test_noise_of_each_channel_is_read_and_written(folder):
    own = NOISE.replace("0.05", "[0.05, 0.04, 0.1]").replace("1.5", "[1.5, 0.7, 1.0]")
    c = load(folder, 'scene = "bench"\n' + own + FRAME.replace("000.png", "rgb.png"))
    assert c.noise.system_gain == (0.05, 0.04, 0.1) and c.noise.dark_noise == (1.5, 0.7, 1.0)
    assert captures.load(captures.write(c, folder / "again", bits=8)).noise == c.noise


# -- What is wrong ---------------------------------------------------------------------------------------------------
def frames(extra="", image="frames/000.png", before=""):
    return f'scene = "bench"\n{before}{NOISE}[[frames]]\nimage = "{image}"\n{extra}'


def noise(old, new):
    return 'scene = "bench"\n' + NOISE.replace(old, new) + FRAME


BAD = {
    "bad TOML": ('scene = "bench"\n[noise]\nsystem_gain = \n' + FRAME, "not valid TOML.*line 3"),
    "key twice": (frames('image = "frames/001.png"\n'), "not valid TOML.*line 10"),
    "no scene": (NOISE + FRAME, "scene is missing; allowed"),
    "scene a number": ("scene = 3\n" + NOISE + FRAME, "scene = 3; allowed: text"),
    "scene file missing": ('scene = "scena.xml"\n' + NOISE + FRAME, "no such file.*did you mean 'scene.xml'"),
    "unknown key": (frames(before='flatfield = "a.png"\n'), "unknown key 'flatfield'; did you mean 'flat_field'"),
    "unknown frame key": (frames('repeat = ["a.png"]\n'), "frame 0: unknown key 'repeat'; did you mean 'repeats'"),
    "unknown noise key": (
        noise("dark_noise", "read_noise"),
        r"\[noise\]: unknown key 'read_noise'; did you mean 'dark_noise'",
    ),
    "noise keys missing": (noise("dark_noise = 1.5\n", ""), r"dark_noise \(DN, rms\) missing; give all"),
    "negative noise": (noise("1.5", "-1.5"), "dark_noise = -1.5 DN, rms; allowed: >= 0"),
    "negative prnu": (noise("0.003", "-0.003"), "prnu = -0.003 .*allowed: >= 0"),
    "gain zero": (noise("0.05", "0"), "system_gain = 0 DN per electron; allowed: > 0"),
    "noise not a number": (noise("1.5", '"low"'), "dark_noise = 'low' DN, rms; allowed: a finite number"),
    "noise a truth value": (noise("1.5", "true"), "dark_noise = True DN, rms; allowed: a finite number"),
    "noise infinite": (noise("255.0", "inf"), "saturation = inf DN; allowed: a finite number"),
    "saturation below black": (noise("255.0", "8.0"), "saturation = 8 DN; allowed: > black_level = 8 DN"),
    "saturation beyond the file": (noise("255.0", "4095"), "saturation = 4095 DN; allowed: <= 255 DN"),
    "gains of a gray image": (noise("0.05", "[0.05, 0.04, 0.1]"), "but images have 1 channel per pixel; allowed: one"),
    "two gains": (noise("0.05", "[0.05, 0.04]"), "allowed: a number, or three of them, for R, G and B"),
    "a gain in words": (noise("0.05", '[0.05, 0.04, "b"]'), "system_gain = 'b' DN per electron; allowed: a finite"),
    "saturation a list": (noise("255.0", "[255.0, 255.0, 255.0]"), "saturation = .255.0, 255.0, 255.0. DN; allowed"),
    "gains of a table": (BENCH + "[noise]\ndark_noise = [1, 2, 3]\n", "allowed: one number, as a table has no R"),
    "noise no table": ('scene = "bench"\nnoise = 3\n' + FRAME, r"\[noise\] = 3 is no table"),
    "values_are": (frames(before='values_are = "lux"\n'), "values_are = 'lux'; allowed: DN, radiance"),
    "cfa pattern": (frames(before='cfa = "RGB"\n'), "cfa = 'RGB'; allowed: RGGB"),
    "cfa on colour": (frames(before='cfa = "RGGB"\n', image="frames/rgb.png"), "3 channels; allowed: the raw mosaic"),
    "parameter NaN": (
        frames(before='[parameters]\n"camera.x_fov" = nan\n'),
        r'\[parameters\]: "camera.x_fov" = nan; allowed',
    ),
    "parameter a list": (
        frames('[frames.parameters]\n"led.power" = [1.0]\n'),
        r'frame 0 .*"led.power" = \[1.0\]; allowed',
    ),
    "key without quotes": (frames("[frames.parameters]\nled_red.power = 1.0\n"), 'needs quotes: "led_red.power"'),
    "zero frames": ('scene = "bench"\nframes = []\n', "zero frames; allowed: one"),
    "no frames at all": ('scene = "bench"\n' + NOISE, "zero frames; allowed: one"),
    "frames no list": ('scene = "bench"\n[frames]\nimage = "frames/000.png"\n', "zero frames; allowed: one"),
    "frames and table": (BENCH + FRAME, r"both \[\[frames\]\] and \[table\]"),
    "no image key": ('scene = "bench"\n[[frames]]\ngroup = "a"\n', "frame 0: image is missing"),
    "image missing": (frames(image="frames/00.png"), "frame 0 .*no such file.*did you mean 'frames/00"),
    "image a folder": (frames(image="frames"), "image = .*a folder, a pipe or a device in .*; allowed: a file"),
    "image a pipe": (frames(image="frames/pipe.png"), "a folder, a pipe or a device in .*; allowed: a file"),
    "image a link to itself": (frames(image="frames/turn.png"), "a link that leads back to itself; allowed: a file"),
    "backslash": (frames(image=r"frames\\000.png"), r"no such file.*write / between folders: 'frames/000.png'"),
    "another form of Unicode": (
        frames(image="frames/cafe\u0301.png"),
        "another form of Unicode: copy 'frames/caf\u00e9.png'",
    ),
    "capital letters": (frames(image="frames/000.PNG"), "no such file.*did you mean 'frames/000.png'"),
    "animation": (frames(image="frames/animated.png"), "2 images in one file; allowed: one"),
    "EXR of a part of an image": (
        frames(image="frames/part.exr"),
        r"its pixels are those of \(5, 5\) to \(12, 10\), its image that of \(0, 0\) to \(15, 11\); allowed: the same",
    ),
    "image twice": (frames('[[frames]]\nimage = "./frames/000.png"\n'), "frame 1 .*used twice .first by frame 0"),
    "repeat is the image": (frames('repeats = ["frames/000.png"]\n'), "used twice"),
    "repeats a text": (frames('repeats = "frames/001.png"\n'), "repeats = 'frames/001.png'; allowed: a list"),
    "repeat missing": (frames('repeats = ["frames/9.png"]\n'), "repeats = 'frames/9.png': no such file"),
    "group a number": (frames("group = 3\n"), "group = 3; allowed: text in quotes"),
    "two sizes": (
        frames('[[frames]]\nimage = "frames/other_size.png"\n'),
        r"frame 1 .*\(4, 8, 1\) pixels; allowed: \(6, 8, 1\)",
    ),
    "two sizes in repeats": (frames('repeats = ["frames/other_size.png"]\n'), r"frame 0 .*\(4, 8, 1\) pixels; allowed"),
    "two depths": (frames('[[frames]]\nimage = "frames/deep.png"\n'), "different depth.*8 bit.*16 bit"),
    "flat field of another size": (
        frames(before='flat_field = "frames/other_size.png"\n'),
        "flat_field: .*pixels; allowed",
    ),
    "flat field missing": (frames(before='flat_field = "flat.png"\n'), "flat_field = 'flat.png': no such file"),
    "flat field saturated": (frames(before='flat_field = "frames/white.png"\n'), "flat_field: all saturated"),
    "NaN": (frames(image="frames/nan.npy"), "1 values are NaN or infinite, the first in row 2, column 3, channel 0"),
    "infinite": (frames(image="frames/inf.npy"), "NaN or infinite, the first in row 0"),
    "beyond float32": (frames(image="frames/huge.npy"), "48 values are NaN or infinite"),
    "all saturated": (frames('[[frames]]\nimage = "frames/white.png"\n'), "frame 1 .*all saturated.*>= 255 DN"),
    "all saturated, no noise": ('scene = "bench"\n[[frames]]\nimage = "frames/white.png"\n', "all saturated"),
    "complex": (frames(image="frames/complex.npy"), "type complex128; allowed"),
    "words": (frames(image="frames/words.npy"), "type <U1; allowed"),
    "objects": (frames(image="frames/object.npy"), "unreadable as .npy"),
    "four axes": (frames(image="frames/cube.npy"), r"shape \(2, 6, 8, 3\); allowed"),
    "channels in front": (frames(image="frames/front.npy"), "channels last"),
    "alpha": (frames(image="frames/alpha.png"), "alpha channel; allowed"),
    "palette": (frames(image="frames/palette.png"), "palette"),
    "one bit": (frames(image="frames/bits.png"), "type bool; allowed"),
    "jpeg": (frames(image="frames/lossy.jpg"), "'.jpg' files are not read; allowed: .png.*JPEG alters"),
    "no image inside": (frames(image="frames/text.png"), "unreadable as .png"),
    "cut file": (frames(image="frames/cut.png"), "unreadable as .png"),
    "pages": (frames(image="frames/pages.tif"), "2 pages"),
    "EXR of other channels": (frames(image="frames/depth.exr"), "channels .*depth.Z; allowed: one channel, or R, G, B"),
    "mask of another size": (frames('mask = "frames/other_size.png"\n'), r"mask.*\(4, 8\) pixels; allowed: \(6, 8\)"),
    "mask empty": (frames('mask = "frames/empty.png"\n'), "mask.*empty.*non-zero = use"),
    "mask missing": (frames('mask = "frames/m.png"\n'), "mask = 'frames/m.png': no such file"),
    "table file missing": (
        BENCH.replace("malus", "malu"),
        r"file = 'malu.csv': no such file.*did you mean 'malus.csv'",
    ),
    "table without values": ('scene = "bench"\n[table]\nfile = "malus.csv"\n', r"values = \[\]; allowed"),
    "table column missing": (BENCH.replace("reading", "readings"), "unknown column 'readings'; did you mean 'reading'"),
    "rename of no column": (
        BENCH + 'rename = { "angle" = "a.b" }\n',
        "unknown column 'angle'; did you mean 'angle .rad.'",
    ),
    "scale of no column": (BENCH + 'scale = { "a.b" = 2.0 }\n', "scale: unknown column 'a.b'"),
    "scale not a number": (BENCH + 'scale = { "angle (rad)" = "2" }\n', "scale: .*= '2'; allowed: a finite number"),
    "column twice": (BENCH + 'rename = { "angle (rad)" = "reading" }\n', "each name once"),
    "reading not finite": (BENCH.replace("malus", "bad"), "frame 1: reading = nan; allowed: finite"),
    "table key": (BENCH + "columns = 3\n", r"\[table\]: unknown key 'columns'"),
    "bands no list": ('bands = "470"\n' + BENCH, "bands = '470'; allowed: a list of wavelengths in nm"),
    "bands empty": ("bands = []\n" + BENCH, r"bands = \[\]; allowed: a list"),
    "bands a word": ('bands = ["red"]\n' + BENCH, "bands = 'red' nm; allowed: a finite number"),
    "bands negative": ("bands = [470, -1]\n" + BENCH, r"bands = \[470, -1\] nm; allowed: wavelengths above 0"),
    "bands twice": ("bands = [470, 470]\n" + BENCH, "allowed: wavelengths above 0, each once"),
    "absent a text": ('absent = "sample"\n' + BENCH, "absent = 'sample'; allowed: a list of texts"),
    "uncertainty negative": (
        BENCH + '[uncertainty]\n"analyzer.angle" = -1\n',
        r'\[uncertainty\]: "analyzer.angle" = -1.0; allowed: a standard deviation in the key',
    ),
    "uncertainty a word": (
        BENCH + '[uncertainty]\n"analyzer.angle" = "1 deg"\n',
        r'"analyzer.angle" = .1 deg.; allowed: a standard deviation',
    ),
    "uncertainty of a frame": (
        frames('[frames.uncertainty]\n"led.power" = -0.1\n'),
        r'frame 0 .*uncertainty: "led.power" = -0.1; allowed',
    ),
    "exclude without reason": (
        BENCH + '[exclude]\n"gain drift" = true\n',
        r'\[exclude\]: "gain drift" = True; allowed: the reason in quotes',
    ),
    "exclude a list": ('exclude = ["gain drift"]\n' + BENCH, r"\[exclude\] = .* is no table"),
    "flat field of a frame missing": (
        frames('flat_field = "flat.png"\n'),
        "frame 0 .*flat_field = 'flat.png': no such",
    ),
    "flat field of a frame of another size": (
        frames('flat_field = "frames/other_size.png"\n'),
        r"frame 0 .*flat_field 'other_size.png': .*\(4, 8, 1\) pixels; allowed",
    ),
    "flat field of a frame saturated": (
        frames('flat_field = "frames/white.png"\n'),
        "frame 0 .*flat_field: all saturated",
    ),
    "delimiter": (BENCH + 'delimiter = "|"\n', r"delimiter = '\|'; allowed: ',', ';'"),
    "decimal": (BENCH + 'decimal = "·"\n', "decimal = '·'; allowed: '.', ','"),
    "decimal commas between commas": (
        BENCH + 'decimal = ","\n',
        "decimal = ',' and cells separated by commas; allowed",
    ),
    "skip": (BENCH + "skip = -1\n", "skip = -1; allowed: the number of lines before the column names"),
    "skip too many": (BENCH + "skip = 40\n", "skip = 40, but it has 4 lines; allowed: fewer"),
    "group of no column": (BENCH + 'group = "run"\n', r"\[table\]: group: unknown column 'run'"),
    "group is a reading": (BENCH + 'group = "reading"\n', "column 'reading' is named twice"),
    "offset of no column": (BENCH + 'offset = { "volts" = 1 }\n', "offset: unknown column 'volts'"),
    "offset not a number": (BENCH + 'offset = { "reading" = "1" }\n', "offset: .*= '1'; allowed: a finite number"),
    "scale of zero": (BENCH + 'scale = { "reading" = 0 }\n', 'scale: "reading" = 0; allowed: any other'),
    "uncertainty column missing": (
        BENCH + 'uncertainty = { "angle (rad)" = "sd" }\n',
        "uncertainty: unknown column 'sd'",
    ),
    "uncertainty of no column": (
        BENCH.replace("malus", "spread") + 'uncertainty = { "analyzer.angel" = "sd" }\n',
        "uncertainty: unknown setting 'analyzer.angel'; did you mean 'analyzer.angle'",
    ),
    "uncertainty column negative": (
        BENCH.replace("malus", "spread") + 'uncertainty = { "analyzer.angle" = "sd" }\n',
        "frame 1: sd = -1, the uncertainty of analyzer.angle; allowed: 0 or more",
    ),
    "table with cfa": ('cfa = "RGGB"\n' + BENCH, "cfa belongs to images"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_input_is_refused_in_words(folder, kind):
    text, expected = BAD[kind]
    with pytest.raises((BadCapture, UnknownKey)) as caught:
        load(folder, text)
    message = str(caught.value)
    assert str(folder) in message
    assert re.search(expected, message), message


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ("a.b,reading\n0,dark\n", "frame 0: reading = 'dark' is no number"),
        ("a.b,reading\n0\n", r"1 cells \['0'\]; allowed: 2"),
        ("a.b,reading\n", "zero frames"),
        ("a.b,reading\n,3\n", "a.b = '' is no number"),
        ("a.b,reading\n0,1e300\n", "reading = 1e300; allowed: finite numbers"),
        ("a.b,reading\n0,1_0\n", "reading = '1_0' is no number"),
        ("a.b;reading\n0;1\n", "separated by .;., not by commas; allowed: delimiter = .;. under"),
        ("a.b\treading\n0\t1\n", r'allowed: delimiter = "\\t" under'),
        ('a.b,reading\n0,"1,5"\n', "reading = '1,5' is no number.*decimal = \",\" under"),
    ],
)
def test_bad_rows_are_refused_in_words(folder, rows, expected):
    (folder / "malus.csv").write_text(rows)
    with pytest.raises((BadCapture, UnknownKey), match=expected):
        load(folder, BENCH)


def test_missing_sets_and_other_encodings(tmp_path):
    with pytest.raises(BadCapture, match="no such file; a capture set is a folder"):
        captures.load(tmp_path / "nowhere")
    (tmp_path / "captures.toml").write_bytes(b'scene = "\xff"\n')
    with pytest.raises(BadCapture, match="byte 9 is no UTF-8"):
        captures.load(tmp_path)


def test_settings_are_held_against_the_scene(folder):
    known = {
        "led_red.power": Parameter("power", "W", 1.0, (0.0, 10.0)),
        "analyzer.angle": Parameter("angle", "deg", 0.0, (-180, 180)),
        "indenter.shape": Parameter("shape", "", "ball", choices=("ball", "edge")),
    }
    c = load(
        folder,
        'scene = "bench"\n[parameters]\n"indenter.shape" = "edge"\n'
        + FRAME
        + '[frames.parameters]\n"analyzer.angle" = 45\n',
    )
    captures.check(c, known)
    for settings, error, text in (
        ({"led_red.powr": 1.0}, UnknownKey, "frame 0 .'frames/000.png'.*did you mean 'led_red.power'"),
        ({"analyzer.angle": 450.0}, OutOfBounds, r"frame 0.*analyzer.angle = 450 deg .*\[-180, 180\] deg"),
        ({"led_red.power": "high"}, ValueError, "frame 0.*'high' is not a number in W"),
        ({"indenter.shape": "bal"}, UnknownKey, "frame 0.*did you mean 'ball'"),
    ):
        c.frames[0].parameters = settings
        with pytest.raises(error, match=text):
            captures.check(c, known)


def test_uncertainties_belong_to_settings(folder):
    known = {
        "analyzer.angle": Parameter("angle", "deg", 0.0, (-180, 180)),
        "camera.x_fov": Parameter("x_fov", "deg", 40.0, (1, 90)),
        "indenter.shape": Parameter("shape", "", "ball", choices=("ball", "edge")),
    }
    text = 'scene = "bench"\n[parameters]\n"indenter.shape" = "edge"\n' + NOISE
    frame = FRAME + '[frames.parameters]\n"analyzer.angle" = 45\n'
    captures.check(load(folder, text + '[uncertainty]\n"analyzer.angle" = 1\n' + frame), known)
    for key, error, expected in (
        ("analyzer.angel", UnknownKey, r"\[uncertainty\]: .*did you mean 'analyzer.angle'"),
        ("camera.x_fov", BadCapture, "camera.x_fov has an uncertainty, and nothing sets it; allowed: keys that"),
        ("indenter.shape", BadCapture, "indenter.shape is a choice of words; allowed: numbers"),
    ):
        with pytest.raises(error, match=expected):
            captures.check(load(folder, text + f'[uncertainty]\n"{key}" = 1\n' + frame), known)
        with pytest.raises(error, match=expected.replace(r"\[uncertainty\]", "frame 0 .*uncertainty")):
            captures.check(load(folder, text + frame + f'[frames.uncertainty]\n"{key}" = 1\n'), known)


# -- Using and writing -----------------------------------------------------------------------------------------------
def made(folder, shape=(6, 8, 3), bits=8):
    rng = np.random.default_rng(2)
    top = 2 ** (bits or 8) - 10

    def image():
        return rng.integers(9, top, shape).astype(np.float32) + (0.0 if bits else 0.25)

    listed = [
        captures.Frame(
            f"press {i}",
            image(),
            rng.random(shape[:2]) > 0.3 if i else None,
            "a" if i else None,
            {"led.power": 0.1 * i, "indenter.shape": "ball"},
            [image() for _ in range(i)],
        )
        for i in range(3)
    ]
    return captures.Captures(
        folder,
        "bench",
        listed,
        {"camera.x_fov": 1 / 3},
        Noise(0.05, 1.5, 8.0, float(top), 0.003, 1.0 if bits else 0.0),
        image() + 0.5,
        "RGGB" if shape[2] == 1 else None,
    )


def assert_same(a, b):
    assert (a.scene, a.parameters, a.noise, a.cfa, a.values_are) == (
        b.scene,
        b.parameters,
        b.noise,
        b.cfa,
        b.values_are,
    )
    assert captures.groups(a).keys() == captures.groups(b).keys() and len(a.frames) == len(b.frames)
    np.testing.assert_array_equal(a.flat_field, b.flat_field)
    for f, g in zip(a.frames, b.frames):
        assert (f.name, f.group, f.parameters) == (g.name, g.group, g.parameters) and len(f.repeats) == len(g.repeats)
        for x, y in zip((f.image, *f.repeats), (g.image, *g.repeats)):
            np.testing.assert_array_equal(x, y)
        np.testing.assert_array_equal(f.mask, g.mask)


@pytest.mark.parametrize("bits", [8, 16, None])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_written_sets_come_back(tmp_path, bits, channels):
    c = made(tmp_path, (6, 8, channels), bits)
    for i, f in enumerate(c.frames):
        f.name = f"press-{i}"
    folder = captures.write(c, tmp_path / "new" / "set", bits=bits)
    back = captures.load(folder)
    assert_same(back, c)
    assert back.bits == bits and back.frames[2].parameters["led.power"] == 0.2  # repr of a float: exact
    assert_same(captures.load(captures.write(back, tmp_path / "again", bits=bits)), back)


def test_a_written_table_comes_back_in_parameter_units(folder):
    c = load(
        folder, BENCH + 'rename = { "angle (rad)" = "analyzer.angle" }\nscale = { "analyzer.angle" = 57.29577951 }\n'
    )
    back = captures.load(captures.write(c, folder / "copy"))
    assert [f.parameters for f in back.frames] == [f.parameters for f in c.frames]
    assert [float(f.image[0, 0, 0]) for f in back.frames] == [100.0, 50.5, 1.0]
    c.frames[1].parameters["led.power"] = 1.0
    with pytest.raises(BadCapture, match="allowed in a table"):
        captures.write(c, folder / "copy2")


def test_a_written_table_keeps_all_that_is_known(folder):
    (folder / "diode.txt").write_text(DIODE)
    c = load(folder, DIODE_TOML + "[noise]\ndark_noise = 2.0\nblack_level = 100\n")
    back = captures.load(captures.write(c, folder / "copy"))
    again = captures.load(captures.write(back, folder / "again"))
    for other in (back, again):
        for name in ("scene", "parameters", "noise", "bands", "absent", "uncertainty", "exclude", "warnings"):
            assert getattr(other, name) == getattr(c, name), name
        for f, g in zip(c.frames, other.frames):
            assert (f.parameters, f.uncertainty, f.group) == (g.parameters, g.uncertainty, g.group)
            np.testing.assert_array_equal(f.image, g.image)
    c.frames[1].group = None
    with pytest.raises(BadCapture, match="frame 1 has the group None"):
        captures.write(c, folder / "copy2")


def test_an_xml_scene_is_found_from_the_new_folder(folder):
    c = load(folder, 'scene = "scene.xml"\n' + FRAME)
    assert captures.load(captures.write(c, folder / "a" / "b", bits=8)).scene == c.scene


def test_nothing_is_overwritten_unasked(tmp_path):
    c = made(tmp_path)
    folder = captures.write(c, tmp_path / "set", bits=8)
    with pytest.raises(OutputExists, match="not empty"):
        captures.write(c, folder, bits=8)
    c.parameters["camera.x_fov"] = 50.0
    captures.write(c, folder, bits=8, overwrite=True)
    assert captures.load(folder).parameters["camera.x_fov"] == 50.0
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(OutputExists, match="never replaced"):
        captures.write(c, folder, bits=8, overwrite=True)
    (folder / "notes.txt").unlink()
    text = (folder / "captures.toml").read_text()
    (folder / "captures.toml").write_text(text.split("\n", 1)[1])  # a set made by hand: a measurement, kept
    with pytest.raises(OutputExists, match="never replaced"):
        captures.write(c, folder, bits=8, overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["set"]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda c: c.frames[1].image.__setitem__((0, 0, 0), 0.5), "do not fit 8 bit"),
        (lambda c: c.frames[1].image.__setitem__((0, 0, 0), 256), "do not fit 8 bit"),
        (lambda c: c.frames[1].image.__setitem__((0, 0, 0), math.nan), "NaN or infinite"),
        (lambda c: setattr(c.frames[1], "name", "press/2"), "two frames are called 'press_2'"),
        (lambda c: c.frames.clear(), "zero frames"),
    ],
)
def test_a_failed_write_leaves_nothing(tmp_path, change, text):
    c = made(tmp_path)
    change(c)
    with pytest.raises(BadCapture, match=text):
        captures.write(c, tmp_path / "set", bits=8)
    assert not list(tmp_path.iterdir())


def test_a_failed_replacement_restores_the_old_set(tmp_path, monkeypatch):
    from pathlib import Path

    c = made(tmp_path)
    folder = captures.write(c, tmp_path / "set", bits=8)
    rename = Path.rename

    def fails_for_the_new(self, target):
        if Path(target) == folder and not self.name.endswith(".old"):
            raise OSError("disk full")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fails_for_the_new)
    with pytest.raises(OSError, match="disk full"):
        captures.write(c, folder, bits=8, overwrite=True)
    monkeypatch.undo()
    assert len(captures.load(folder).frames) == 3 and [p.name for p in tmp_path.iterdir()] == ["set"]


def test_subset_and_groups(tmp_path):
    c = made(tmp_path)
    assert captures.groups(c) == {"press 0": [0], "a": [1, 2]}
    c.frames[0].name = "a"  # a name that is also a group's
    assert captures.groups(c) == {"a (frame 0)": [0], "a": [1, 2]}
    part = captures.subset(c, [2, 0])
    assert [f.name for f in part.frames] == ["press 2", "a"] and len(c.frames) == 3 and part.noise == c.noise
    for index in (3, -1):
        with pytest.raises(IndexError, match="allowed: 0 to 2"):
            captures.subset(c, [index])


def test_which_channel_a_site_of_the_mosaic_holds():
    np.testing.assert_array_equal(captures.cfa_channel((3, 4, 1), "RGGB"), [[0, 1, 0, 1], [1, 2, 1, 2], [0, 1, 0, 1]])
    np.testing.assert_array_equal(captures.cfa_channel((2, 3), "GBRG"), [[1, 2, 1], [0, 1, 0]])
    with pytest.raises(UnknownKey, match="RGGB"):
        captures.cfa_channel((2, 2), "RGBG")
