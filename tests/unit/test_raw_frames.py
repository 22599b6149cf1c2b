"""Importing raw frames of a polarization camera: settings, depth, repeats, binning, and what is refused."""

import numpy as np
import pytest
from PIL import Image

from optics.captures import capture_set, raw_frames
from optics.captures.noise import Noise, estimate
from optics.errors import BadCapture, OutputExists

MOSAIC = ((90.0, 45.0), (135.0, 0.0))
TRUE = Noise(0.1, 2.0, 100.0, 4095.0, 0.0)
H, W = 24, 32


def signal(angle):
    """(H, W, 1) DN of light of a degree of 0.5 at an angle in deg, brighter to the right."""
    v, u = np.mgrid[:H, :W]
    a = np.radians(np.array(MOSAIC)[v % 2, u % 2] - angle)
    return (100 + 40 * (u + 5) * (1 + 0.5 * np.cos(2 * a)))[..., None]


def save(file, image):
    Image.fromarray(np.asarray(image, np.uint16)[..., 0]).save(file)


@pytest.fixture
def folder(tmp_path):
    """Three angles, six repeats each, 12 bit at the upper end of 16."""
    rng = np.random.default_rng(4)
    (tmp_path / "raw").mkdir()
    for angle in (0, 30, 75):
        for k in range(6):
            save(tmp_path / "raw" / f"film__angle={angle}__{k}.tif", 16 * TRUE.expose(signal(angle), rng))
    return tmp_path


def test_names_of_files_say_settings_and_repeats_give_the_noise(folder):
    read = raw_frames.import_frames(
        folder / "raw", folder / "set", mosaic=MOSAIC, rename={"angle": "polarizer.angle"}, black_level=100.0
    )
    captures = capture_set.load(read.folder)
    assert captures.mosaic == MOSAIC and captures.scene == "polarization_camera" and captures.bits == 16
    assert [f.parameters for f in captures.frames] == [{"polarizer.angle": a} for a in (0.0, 30.0, 75.0)]
    assert [len(f.repeats) for f in captures.frames] == [5, 5, 5]
    assert any("divided by 16" in text for text in read.warnings) and any("12 bit" in text for text in read.warnings)
    mean = np.mean([captures.frames[1].image, *captures.frames[1].repeats], 0)
    # six frames of up to 20 DN: 8 DN, at 4 sigma
    assert np.abs(mean - signal(30)).max() < 4 * 20 / np.sqrt(6)
    found = estimate(captures, black_level=100.0, saturation=4095.0)
    assert found.system_gain == pytest.approx(0.1, rel=0.1)  # 14000 values: 1 %, and the spread of levels


def test_a_table_says_settings_groups_and_masks(folder):
    save(folder / "raw" / "mask.png", np.where(np.arange(W) < 20, 255, 0)[None, :, None] * np.ones((H, 1, 1)))
    (folder / "settings.csv").write_text(
        "file,angle,polarizer.inserted,group,mask\nfilm__angle=0__0.tif,0,1,a,mask.png\nfilm__angle=30__0.tif,30,1,b,\n"
    )
    read = raw_frames.import_frames(
        folder / "raw",
        folder / "set",
        mosaic=MOSAIC,
        settings=folder / "settings.csv",
        rename={"angle": "polarizer.angle"},
        system_gain=0.1,
        dark_noise=2.0,
        black_level=100.0,
    )
    first, second = capture_set.load(read.folder).frames
    assert first.parameters == {"polarizer.angle": 0.0, "polarizer.inserted": 1.0} and first.group == "a"
    assert first.mask.sum() == 20 * H and second.mask is None and second.group == "b"


def test_binning_averages_pixels_of_one_angle(folder):
    options = {"mosaic": MOSAIC, "rename": {"angle": "polarizer.angle"}, "system_gain": 0.1, "dark_noise": 2.0}
    read = raw_frames.import_frames(folder / "raw", folder / "set", bin=4, black_level=100.0, **options)
    captures = capture_set.load(read.folder)
    one = np.mean([captures.frames[2].image, *captures.frames[2].repeats], 0)
    assert one.shape == (6, 8, 1) and captures.noise.system_gain == 0.1 / 16 and captures.noise.dark_noise == 0.5
    angle = np.array(MOSAIC)[np.arange(6)[:, None] % 2, np.arange(8) % 2]
    middle = 8 * (np.arange(8) // 2) + 3 + np.arange(8) % 2  # of the four columns of a site in a block
    expected = 100 + 40 * (middle + 5) * (1 + 0.5 * np.cos(2 * np.radians(angle - 75)))
    assert np.abs(one[..., 0] - expected).max() < 4 * 20 / np.sqrt(6 * 16)


def test_a_block_with_a_saturated_pixel_stays_saturated(tmp_path):
    (tmp_path / "raw").mkdir()
    image = np.full((8, 8, 1), 1000)
    image[1, 1] = 4095
    save(tmp_path / "raw" / "a.png", image)
    read = raw_frames.import_frames(
        tmp_path / "raw", tmp_path / "set", mosaic=MOSAIC, bin=2, system_gain=0.1, dark_noise=2.0
    )
    binned = capture_set.load(read.folder).frames[0].image[..., 0]
    assert binned.shape == (4, 4) and binned[1, 1] == 4095 and (np.delete(binned.ravel(), 5) == 1000).all()


@pytest.mark.parametrize(
    "options, said",
    [
        ({}, "'angle' is no parameter key"),
        ({"bits": 10}, "do not fit 10 bit"),
        ({"system_gain": 0.1}, "one of them is missing"),
        ({"settings": "none.csv"}, "no such file"),
        ({"mosaic": ((90.0,), (45.0, 0.0))}, "rows of 1, 2 angles"),
    ],
)
def test_what_is_wrong_is_said(folder, options, said):
    rename = {} if not options else {"angle": "polarizer.angle"}
    with pytest.raises(ValueError, match=said):
        raw_frames.import_frames(folder / "raw", folder / "set", **{"mosaic": MOSAIC, "rename": rename, **options})
    assert not (folder / "set").exists()


def test_frames_in_colour_and_a_folder_in_use_are_refused(folder):
    options = {"mosaic": MOSAIC, "rename": {"angle": "polarizer.angle"}}
    raw_frames.import_frames(folder / "raw", folder / "set", **options)
    with pytest.raises(OutputExists):
        raw_frames.import_frames(folder / "raw", folder / "set", **options)
    Image.fromarray(np.zeros((H, W, 3), np.uint8)).save(folder / "raw" / "angle=5.png")
    with pytest.raises(BadCapture, match="3 channels"):
        raw_frames.import_frames(folder / "raw", folder / "other", **options)


def test_the_command_line_reads_them(folder, optics):
    code, out, err = optics(
        "import", folder / "raw", "--mosaic", "90 45 135 0", "--rename", "angle=polarizer.angle", "-o", folder / "set"
    )
    assert code == 0 and str(folder / "set") in out and "12 bit" in err
    code, _, err = optics("import", folder / "raw", "--bits", "12", "-o", folder / "more")
    assert code == 2 and "--mosaic" in err
