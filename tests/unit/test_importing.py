"""Importing labelled ball presses: what is derived, what is said, and what is refused."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from optics.captures import capture_set as captures
from optics.captures import importing
from optics.errors import BadCapture, OutputExists, UnknownKey

H, W, R = 48, 64, 8  # px
PACKAGE = importlib.util.find_spec("taxim")  # holds packs of 480 x 640 px; never imported


@pytest.fixture
def presses():
    """Twelve images of 48 x 64 px with a bright disc where each circle is, noise of 2 DN and gains of 1 and 1.04."""
    rng = np.random.default_rng(3)
    v, u = np.mgrid[:H, :W]
    circles = np.column_stack([rng.uniform(8, W - 8, 12), rng.uniform(8, H - 8, 12), np.full(12, R / 3)])
    flat = 90.0 + 0.5 * u[..., None] + np.zeros(3)
    images = []
    for i, (x, y, r) in enumerate(circles):
        disc = np.hypot(u - x, v - y) < r
        images.append(
            np.round(flat * (1.04 if i == 5 else 1.0) + 40 * disc[..., None] + 2 * rng.standard_normal((H, W, 3)))
        )
    return importing.Presses("made here", [f"p{i}" for i in range(12)], np.array(images), circles, flat + 12)


OPTIONS = {"ball_radius": 2.0, "mm_per_pixel": 0.2}


def test_presses_become_captures_with_a_scene_and_numbers(presses, tmp_path):
    found = importing.import_presses(presses, tmp_path / "set", **OPTIONS)
    loaded = captures.load(found.folder)
    assert sorted(p.name for p in found.folder.iterdir()) == [
        "README.txt",
        "captures.toml",
        "flat_field.exr",
        "frames",
        "import.json",
        "scene.xml",
    ]
    assert loaded.scene == str(found.folder / "scene.xml") and len(loaded.frames) == 12
    first = loaded.frames[0]
    assert first.group == "p0"
    # label (0, 0) is the centre of the first pixel, (W/2, H/2) - 1/2 the middle of the image
    assert first.parameters["gel.press_x"] == pytest.approx((presses.circles[0, 0] + 0.5 - W / 2) * 0.2, abs=1e-5)
    assert first.parameters["gel.press_y"] == pytest.approx((presses.circles[0, 1] + 0.5 - H / 2) * 0.2, abs=1e-5)
    a = 0.85 * R / 3 * 0.2
    root = np.sqrt(4 - a * a)
    assert first.parameters["gel.press_depth"] == pytest.approx(0.8 * a / root + 2 - root, abs=1e-5)
    # medians over 1000 pixels of 2 % scatter each: 0.1 %
    assert loaded.frames[5].parameters["camera.gain_g"] == pytest.approx(1.04, abs=4e-3)
    assert max(loaded.noise.correlation) < 0.05  # of some 25,000 products: 0 +- .01
    assert found.facts["background"] == "median"  # which has less noise, as nothing changes
    assert loaded.noise.sd(100.0) == pytest.approx(2.02, rel=0.15)  # 2 DN and the rounding; twelve levels per channel
    assert np.abs(loaded.flat_field - (90 + 0.5 * np.arange(W)[:, None])).mean() < 1.0
    assert json.loads((found.folder / "import.json").read_text())["presses"] == 12
    assert importing.circles_of(loaded)[3] == pytest.approx([*(presses.circles[3, :2] + 0.5), R / 3], abs=1e-3)


@pytest.fixture
def wrinkled(presses):
    """The same with a pattern of stripes (4 DN rms) that turns into another one within six presses."""
    stripes = 4 * np.sqrt(2) * np.sin(0.5 * np.arange(H))[:, None, None] * np.ones((W, 3))
    crossed = 4 * np.sqrt(2) * np.sin(0.4 * np.arange(W))[:, None] * np.ones((H, W, 3))
    turn = np.arange(12)[:, None, None, None] * np.pi / 12
    presses.images = np.round(presses.images + np.cos(turn) * stripes + np.sin(turn) * crossed)
    return presses


def test_noise_that_neighbours_share_is_measured_and_written(presses, tmp_path):
    """Each pixel is the mean of itself and three neighbours, round the edges: the next one shares two of the four. The
    noise of such means is 1 DN, to which the step adds 1/12 DN^2 that nobody shares."""
    for image in presses.images:
        image[:] = np.round(sum(np.roll(image, shift, (0, 1)) for shift in ((0, 0), (0, 1), (1, 0), (1, 1))) / 4)
    found = importing.import_presses(presses, tmp_path / "set", **OPTIONS)
    assert captures.load(found.folder).noise.correlation == pytest.approx([0.5 / (1 + 1 / 12)] * 3, abs=0.03)
    assert "- correlation of the noise of neighbouring pixels: 0.4" in (found.folder / "README.txt").read_text()


def test_where_the_untouched_sensor_changes_each_press_has_a_background_of_its_own(wrinkled, tmp_path):
    found = importing.import_presses(wrinkled, tmp_path / "set", **OPTIONS)
    loaded = captures.load(found.folder)
    assert found.facts["background"] == "near" and loaded.flat_field is None
    rest = found.facts["background_left"]
    assert min(rest["median"]) > 2.5  # 16 DN^2 of stripes over 4 of noise; a median follows half of them
    said = next(c for c in found.facts["corrections"] if "untouched sensor changes" in c["what"])
    assert "a background of its own" in said["what"] and said["what"] in (found.folder / "README.txt").read_text()
    # what is left far from the circles is noise: that of the image, and that of the mean of some three others
    distances = importing._distances((H, W), importing.circles_of(loaded))
    square = []
    for frame, far in zip(loaded.frames, distances > importing.FAR):
        gain = np.array([frame.parameters[f"camera.gain_{c}"] for c in "rgb"])
        expected = frame.flat_field * gain
        square.append(((frame.image - expected) ** 2 / loaded.noise.variance(expected))[far].mean())
    # 9000 values; what is left of the stripes over two presses adds a few per cent, which the noise law has seen too
    assert np.mean(square) == pytest.approx(1.0, abs=0.1)
    assert max(square) < 1.6  # at the ends of the session all neighbours are on one side


def test_any_background_may_be_asked_for(wrinkled, tmp_path):
    asked = importing.import_presses(wrinkled, tmp_path / "median", background="median", **OPTIONS)
    assert asked.facts["background"] == "median" and captures.load(asked.folder).flat_field is not None
    assert not any("untouched" in c["what"] for c in asked.facts["corrections"])
    with pytest.raises(UnknownKey, match="background"):
        importing.import_presses(wrinkled, tmp_path / "none", background="nearest", **OPTIONS)


def test_contradictions_are_said_with_their_numbers(presses, tmp_path):
    found = importing.import_presses(
        presses,
        tmp_path / "set",
        ball_radius=0.5,
        mm_per_pixel=0.2,
        mm_per_pixel_check=0.19,
        contact_share=0.5,
        skirt=0.2,
    )
    text = "\n".join(found.warnings)
    for words in (
        "12 of 12 labelled circles are larger than the ball",
        "0.53 mm, ball radius 0.50 mm",
        "-5.0%",
        "not the background of these presses",
        "12 / 12 / 12 DN",
        "frames differ in gain",
    ):
        assert words in text
    assert text.splitlines()[0] in (found.folder / "README.txt").read_text()


def test_binning_averages_and_keeps_saturation():
    image = np.full((4, 4, 3), 100.0)
    image[0, 0] = 255.0
    small = importing.binned(image, 2)
    assert small.shape == (2, 2, 3) and np.all(small[0, 0] == 255) and np.all(small[1, 1] == 100)


def test_depth_of_a_touched_radius_is_what_the_skin_does():
    from optics.skin import contact

    depth = importing.depth_of(1.2, 2.5, 0.7)
    profile = contact.indenter_profile("sphere", 2.5, (0, 0, 0), 6.0, 0.05)
    pressed, _ = contact.displacement(profile, depth, 4.0, 0.0, skirt=0.7)
    middle = len(pressed.values) // 2
    row = pressed.values[middle, middle : middle + 90]  # 4.5 mm; the map fades to zero from 5.2 mm on
    slope = -np.gradient(np.log(row), 0.05)
    x = 0.05 * np.arange(len(slope))
    # beyond the touched radius the skin falls by 1/e per 0.7 mm; the last blur of one pitch rounds the edge only
    assert slope[(x > 1.5) & (x < 4)] == pytest.approx(1 / 0.7, rel=0.02)
    assert slope[x < 1.0].max() < 1 / 0.7


def test_an_import_is_replaced_only_when_asked(presses, tmp_path):
    importing.import_presses(presses, tmp_path / "set", **OPTIONS)
    with pytest.raises(OutputExists, match="allow to overwrite"):
        importing.import_presses(presses, tmp_path / "set", **OPTIONS)
    importing.import_presses(presses, tmp_path / "set", **OPTIONS, overwrite=True)
    (tmp_path / "set" / "notes.txt").write_text("mine")
    with pytest.raises(OutputExists):
        importing.import_presses(presses, tmp_path / "set", **OPTIONS, overwrite=True)


@pytest.fixture
def pack(presses):
    return {
        "imgs": presses.images.astype(np.uint8),
        "touch_center": presses.circles[:, :2],
        "touch_radius": presses.circles[:, 2],
        "f0": presses.given.astype(np.uint8),
    }


def test_a_pack_is_read(pack, tmp_path):
    np.savez(tmp_path / "pack.npz", **pack)
    found = importing.read_taxim(tmp_path / "pack.npz")
    assert found.images.shape == (12, H, W, 3) and found.given.shape == (H, W, 3)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"imgs": None}, "imgs missing"),
        ({"touch_radius": np.ones(5)}, r"touch_radius has the shape \(5,\)"),
        ({"imgs": np.zeros((12, H, W), np.uint8)}, r"imgs has the shape"),
        ({"f0": np.zeros((2, 2, 3))}, "f0 has the shape"),
        ({"touch_center": np.array([{}] * 12, object)}, "without pickles"),
    ],
)
def test_a_bad_pack_is_refused(pack, tmp_path, change, words):
    np.savez(tmp_path / "pack.npz", **{k: v for k, v in {**pack, **change}.items() if v is not None})
    with pytest.raises(BadCapture, match=words):
        importing.read_taxim(tmp_path / "pack.npz")


def test_files_that_are_no_pack_are_refused(tmp_path):
    (tmp_path / "text.npz").write_text("hello")
    np.save(tmp_path / "one.npy", np.zeros(3))
    for name, words in (("none.npz", "no such file"), ("text.npz", "cannot be read"), ("one.npy", "cannot be read")):
        with pytest.raises(BadCapture, match=words):
            importing.read_taxim(tmp_path / name)


@pytest.mark.parametrize(
    "table, words",
    [
        ("file,center_x,center_y_px,contact_radius_px\na.png,1,2,3", "unknown column 'center_x_px'"),
        ("file,center_x_px,center_y_px,contact_radius_px\n", "zero rows"),
        ("file,center_x_px,center_y_px,contact_radius_px\nb.png,1,2,3", "no image 'b.png'"),
        ("file,center_x_px,center_y_px,contact_radius_px\na.png,1,two,3", "line 2: center_y_px = 'two'"),
        ("file,center_x_px,center_y_px,contact_radius_px\na.png,1,2,3\na.png,1,2,3", "given in line 2 already"),
    ],
)
def test_a_bad_table_of_circles_is_refused(tmp_path, table, words):
    from PIL import Image

    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "a.png")
    (tmp_path / "circles.csv").write_text(table)
    with pytest.raises(BadCapture, match=words):
        importing.read_circles(tmp_path, tmp_path / "circles.csv")


def test_circles_and_options_out_of_range_are_refused(presses, tmp_path):
    for options, words in (
        ({"ball_radius": -1}, "ball_radius = -1"),
        ({"bin": 5}, "do not divide"),
        ({"leds": 4}, "leds = 4"),
    ):
        with pytest.raises(BadCapture, match=words):
            importing.import_presses(presses, tmp_path / "set", **{**OPTIONS, **options})
    presses.circles[2, 0] = 500
    with pytest.raises(BadCapture, match=r"p2: circle at \(500"):
        importing.import_presses(presses, tmp_path / "set", **OPTIONS)


def test_corrections_are_written_down(presses, tmp_path):
    found = importing.import_presses(presses, tmp_path / "set", **OPTIONS, bin=2)
    entries = json.loads((found.folder / "import.json").read_text())["corrections"]
    assert [e["what"] for e in entries][0] == "pixels are averaged" and entries[0]["how_much"] == "blocks of 2 x 2 px"
    assert any("camera.gain_r" in e["what"] for e in entries)
    assert "blocks of 2 x 2 px" in (found.folder / "README.txt").read_text()
    assert any("drifts: +" in text and "% in p5; largest step" in text for text in found.warnings)


def test_values_clipped_at_black_are_masked(presses, tmp_path):
    """A camera that ends at 80 DN: the dark side of the images is cut there in one channel."""
    presses.images[..., 2] = np.maximum(presses.images[..., 2] - 15, 80)
    found = importing.import_presses(presses, tmp_path / "set", **OPTIONS)
    assert any("clipped at the black level" in text and "channel B at 80 DN" in text for text in found.warnings)
    frame = captures.load(found.folder).frames[0]
    assert np.array_equal(frame.mask, presses.images[0, ..., 2] > 80)
    small = importing.binned(presses.images[0], 2, 255.0, [None, None, 80.0])
    assert (small[:, 0, 2] == 80).all() and (small[:, 0, 0] != small[:, 0, 2]).all()


@pytest.fixture
def large(pack, tmp_path):
    """A pack's folder with larger images and its own scale."""
    folder = tmp_path / "gelsight"
    folder.mkdir()
    wide = {key: pack[key].repeat(2, -3).repeat(2, -2) for key in ("imgs", "f0")}
    circles = {"touch_center": 2 * pack["touch_center"] + 0.5, "touch_radius": 2 * pack["touch_radius"]}
    names = np.array([f"frame_{i}.jpg" for i in range(13)])
    np.savez(folder / "dataPack.npz", **wide, **circles, names=names)
    (folder / "params.json").write_text(json.dumps({"sensor": {"pixmm": 0.11, "w": 128, "h": 96}}))
    return folder


def test_a_packs_folder_says_its_own_scale(large, tmp_path):
    found = importing.import_taxim(large, tmp_path / "set", bin=2)
    assert found.facts["mm_per_pixel"] == 0.11 and found.facts["mm_per_pixel_after_binning"] == 0.22
    assert found.facts["ball_radius_mm"] == 2.0 and found.facts["background"] == "median"
    text = "\n".join(found.warnings)
    assert "does not say the ball's radius" in text and "names has 13 entries for 12 images" in text
    assert "JPEG" in text and "two ways to find the scale" not in text
    # the same presses as in the small pack, but for where pixel centres lie
    first = captures.load(found.folder).frames[0]
    assert first.name == "000" and first.image.shape == (H, W, 3)
    own = importing.import_taxim(large / "dataPack.npz", tmp_path / "own", mm_per_pixel=0.2, ball_radius=3.0, bin=2)
    assert own.facts["mm_per_pixel"] == 0.2 and "ball's radius" not in "\n".join(own.warnings)


def test_crowded_presses_take_the_given_background(large, tmp_path):
    with np.load(large / "dataPack.npz") as data:
        arrays = dict(data)
    arrays["touch_center"] = np.tile([64.0, 48.0], (12, 1))
    np.savez(large / "dataPack.npz", **arrays)
    found = importing.import_taxim(large, tmp_path / "set", bin=2)
    assert found.facts["background"] == "given"
    assert any(text.startswith("100% of the presses lie over one pixel") for text in found.warnings)


@pytest.mark.parametrize(
    "spoil, words",
    [
        (lambda f: (f / "dataPack.npz").rename(f / "polycalib.npz"), "polycalib.npz is a table fitted to images"),
        (lambda f: (f / "dataPack.npz").unlink(), "no dataPack.npz with the images"),
        (lambda f: (f / "params.json").unlink(), "sensor: pixmm, mm per pixel of images 128 px wide; give --mm-per"),
        (lambda f: (f / "params.json").write_text('{"sensor": {"pixmm": "a"}}'), "pixmm = 'a' mm per pixel"),
        (lambda f: (f / "params.json").write_text("[1]"), "no JSON table"),
    ],
)
def test_a_bad_packs_folder_is_refused(large, tmp_path, spoil, words):
    spoil(large)
    with pytest.raises(BadCapture, match=words):
        importing.import_taxim(large, tmp_path / "set")


@pytest.mark.skipif(PACKAGE is None, reason="the package taxim and its packs are not here")
@pytest.mark.parametrize("sensor, presses, background", [("gelsight", 48, "median"), ("gelsight_mini", 24, "given")])
def test_measured_packs_of_480_by_640_px(tmp_path, sensor, presses, background):
    """Their own scale; the Mini is pressed at one place, so that a median would show the ball."""
    pack = Path(PACKAGE.submodule_search_locations[0]) / "calib" / sensor
    found = importing.import_taxim(pack, tmp_path / "set", bin=8)
    assert found.facts["mm_per_pixel"] == 0.0295 and found.facts["background"] == background
    assert found.facts["presses"] == presses and found.facts["size_px"] == [60, 80]
    assert found.facts["labelled_radius_mm"][1] < 2.0  # no circle is larger than the ball
    loaded = captures.load(found.folder)
    assert np.abs(np.array(found.facts["frame_gain"]) - 1).max() < 0.05
    assert loaded.noise.sd(np.full(3, 100.0)).max() < 2.0
