"""9DTact's calibration folders: what an import derives from a press that was drawn with numpy, and what it refuses."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from optics.captures import capture_set, translucent
from optics.errors import BadCapture, OutputExists
from optics.scene import loader

HEIGHT, WIDTH, SCALE = 172, 230, 0.1  # px of the crop, mm/px
TOP, LEFT = 20, 30  # of the crop in the raw image
RAW = (220, 300)
BALL, THICKNESS = 4.0, 2.5  # mm
AT, TOUCHED = (1.3, -0.8), 2.6  # mm from the middle of the image; where the face crosses its untouched height
DEPTH = BALL - np.sqrt(BALL**2 - TOUCHED**2)
FAR_GAIN = np.array([0.98, 0.985, 1.01])
SD = 0.8  # DN
SHARED = Path(__file__).parents[3] / "shared" / "data" / "9dtact_translucent"


def face(shape, top, left):
    """mm by which the face lies below its untouched height: a ball's cap, and a bulge around it that fades."""
    v, u = np.mgrid[: shape[0], : shape[1]] + 0.5
    x, y = (u - left - WIDTH / 2) * SCALE - AT[0], (v - top - HEIGHT / 2) * SCALE - AT[1]
    r = np.hypot(x, y)
    cap = np.sqrt(np.maximum(BALL**2 - r**2, 0)) - np.sqrt(BALL**2 - TOUCHED**2)
    out = np.maximum(r - TOUCHED, 0)
    return np.where(r < TOUCHED, cap, -0.35 * out * np.exp(-out / 0.8))


def images(rng, specks=()):
    """(untouched, pressed) raw images in DN: brightness grows with the gel's thickness above a dark coat."""
    v, u = np.mgrid[: RAW[0], : RAW[1]]
    flat = (150 + 0.03 * u - 0.02 * v)[..., None] * (1.0, 0.98, 0.95)
    rest, light = THICKNESS, np.maximum(THICKNESS - face(RAW, TOP, LEFT), 0)
    share = (0.3 + (1 - np.exp(-0.4 * light))) / (0.3 + (1 - np.exp(-0.4 * rest)))
    pressed = flat * FAR_GAIN * share[..., None]
    for row, column in specks:
        pressed[row : row + 3, column : column + 3] *= 1.3
    return [np.round(image + SD * rng.standard_normal(image.shape)).astype(np.uint8) for image in (flat, pressed)]


def write_sensor(folder, rng, *, board=True, **kwargs):
    """A folder as 9DTact's programs leave it: `folder/sensor_1` and the files beside it."""
    depth, camera = folder / "sensor_1" / "depth_calibration", folder / "sensor_1" / "camera_calibration"
    depth.mkdir(parents=True)
    camera.mkdir()
    rows, columns = (index.copy() for index in np.indices(RAW))
    rows[:, 160] = rows[:, 159]  # one column of the rectified image shows the raw pixels of its neighbour
    columns[:, 160] = columns[:, 159]
    crop = np.s_[TOP : TOP + HEIGHT, LEFT : LEFT + WIDTH]
    for name, image in zip(("ref", "sample"), images(rng, **kwargs)):
        Image.fromarray(image).save(depth / f"{name}.png")
        Image.fromarray(image[rows, columns][crop]).save(depth / f"rectify_crop_{name}.png")
    np.save(camera / "row_index.npy", rows.astype(np.int32))
    np.save(camera / "col_index.npy", columns.astype(np.int32))
    np.save(camera / "position_scale.npy", np.array([TOP + HEIGHT / 2, LEFT + WIDTH / 2, SCALE]))
    np.save(depth / "Pixel_to_Depth.npy", np.linspace(0, DEPTH, 50))
    (folder / "shape_config.yaml").write_text(
        f"camera_calibration:\n  crop_size:\n    - {HEIGHT}\n    - {WIDTH}\ndepth_calibration:\n  BallRad: {BALL}\n"
    )
    if board:
        places = [(5, 18), (14, 18), (23, 18), (5, 10.5), (23, 10.5), (5, 3), (14, 3), (23, 3)]
        lines = [f"LED{k},{x},{y}" for k, (x, y) in enumerate(places, 1)]
        (folder / "led_pcb_positions.csv").write_text("\n".join(["designator,x_mm,y_mm", *lines]))
    return folder


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return write_sensor(tmp_path_factory.mktemp("9dtact"), np.random.default_rng(4), specks=[(50, 60)])


@pytest.fixture(scope="module")
def imported(source, tmp_path_factory):
    return translucent.import_translucent(source, tmp_path_factory.mktemp("out") / "set")


def test_the_press_is_found_by_the_image_itself(imported):
    contact = json.loads((imported.folder / "import.json").read_text())["contact"]
    # 72 rays that meet the edge to some tenths of a pixel of 0.1 mm
    assert (contact["x_mm"], contact["y_mm"]) == pytest.approx(AT, abs=0.02)
    # the edge is where the darkening has fallen to 5 %: 0.05 mm of 0.96 mm of depth, and the blur of 1.5 px
    assert contact["radius_mm"] == pytest.approx(TOUCHED, abs=0.1)
    assert contact["depth_mm"] == pytest.approx(DEPTH, rel=0.1)
    assert contact["edge_off_rms_mm"] < 0.03
    assert imported.facts["circles_px"][0][0] * SCALE == pytest.approx(AT[0] + WIDTH * SCALE / 2, abs=0.02)


def test_the_set_has_a_press_a_mask_a_flat_field_and_noise(imported):
    found = capture_set.load(imported.folder)
    (frame,) = found.frames
    assert frame.image.shape == found.flat_field.shape == (HEIGHT, WIDTH, 3) and found.bits == 8
    assert not frame.mask[:, 160 - LEFT].any() and frame.mask[:, 161 - LEFT].all()  # a raw pixel counts once
    assert not frame.mask[51 - TOP, 61 - LEFT] and frame.mask.mean() > 0.99  # the speck
    gains = [frame.parameters[f"camera.gain_{c}"] for c in "rgb"]
    # 5000 pixels of 0.5 % each; the bulge of the gel has fallen to 1e-4 there
    assert gains == pytest.approx(FAR_GAIN, abs=1e-3)
    # the noise of both images, each with its step of 1 DN; one of the two steps is added by the noise itself
    assert found.noise.sd(150.0) == pytest.approx(np.sqrt(2 * (SD**2 + 1 / 12)), rel=0.05)


def test_what_was_assumed_and_corrected_is_said(imported):
    text = "\n".join(imported.warnings)
    assert "far from the contact drifts: -2 / -1.5 / +1 % in press" in text
    assert "8 LEDs stand as on their board" in text and "it differs by 0 mm" in text
    assert "one press: nothing can be held out" in text and "the gel bulges" in text
    assert "authors' table" not in text  # it agrees
    whats = [c["what"] for c in json.loads((imported.folder / "import.json").read_text())["corrections"]]
    assert any("repeat a raw pixel" in w for w in whats) and any("dust" in w for w in whats)
    assert all(what in (imported.folder / "README.txt").read_text() for what in whats)


def test_the_scene_has_the_leds_of_the_board(imported):
    scene = loader.load(capture_set.load(imported.folder).scene)
    values = scene.values()
    assert sum(key.endswith(".power") for key in values) == 8
    assert (values["led_1.x"], values["led_1.y"], values["led_1.z"]) == pytest.approx((-9.0, -7.5, -15.0))
    assert values["gel.indenter_size"] == BALL and values["gel.haze"] > 0


def test_without_a_board_the_leds_stand_on_a_ring(tmp_path):
    write_sensor(tmp_path / "in", np.random.default_rng(1), board=False)
    found = translucent.import_translucent(tmp_path / "in" / "sensor_1", tmp_path / "set", bin=2)
    assert found.facts["leds_from"] == "assumed" and len(found.facts["leds_mm"]) == 8
    assert any("8 LEDs are assumed on a ring of 10 mm" in text for text in found.warnings)
    assert capture_set.load(found.folder).frames[0].image.shape == (HEIGHT // 2, WIDTH // 2, 3)
    # blocks of four pixels: half of the noise of the two images
    assert capture_set.load(found.folder).noise.sd(150.0) == pytest.approx(np.sqrt(2 * (SD**2 + 1 / 12)) / 2, rel=0.05)
    with pytest.raises(OutputExists):
        translucent.import_translucent(tmp_path / "in", tmp_path / "set")


def test_rectified_images_are_made_where_they_are_missing(tmp_path, imported):
    write_sensor(tmp_path / "in", np.random.default_rng(4), specks=[(50, 60)])
    for name in ("ref", "sample"):
        (tmp_path / "in" / "sensor_1" / "depth_calibration" / f"rectify_crop_{name}.png").unlink()
    found = translucent.import_translucent(tmp_path / "in", tmp_path / "set")
    assert "rectify_crop_ref.png is missing: made from ref.png" in "\n".join(found.warnings)
    one, two = (capture_set.load(i.folder) for i in (found, imported))
    assert np.array_equal(one.frames[0].image, two.frames[0].image)


def _depth(folder):
    return folder / "sensor_1" / "depth_calibration"


def _camera(folder):
    return folder / "sensor_1" / "camera_calibration"


@pytest.mark.parametrize(
    "spoil, words",
    [
        (lambda f: shutil.rmtree(_depth(f)), "holds no depth_calibration"),
        (lambda f: shutil.copytree(f / "sensor_1", f / "sensor_2"), r"holds 2 sensors \(sensor_1, sensor_2\)"),
        (lambda f: (f / "shape_config.yaml").unlink(), "give --ball-radius"),
        (lambda f: (f / "shape_config.yaml").write_text("depth_calibration:\n  BallRad: four\n"), "BallRad = 'four'"),
        (lambda f: (f / "shape_config.yaml").write_text("depth_calibration:\n  BallRad: -4\n"), "ball radius = -4 mm"),
        (lambda f: (_camera(f) / "position_scale.npy").unlink(), "give --mm-per-pixel"),
        (lambda f: np.save(_camera(f) / "position_scale.npy", np.zeros(3)), "mm per pixel above 0"),
        (lambda f: np.save(_camera(f) / "position_scale.npy", np.array([500.0, 5, 0.1])), "leaves the maps"),
        (lambda f: np.save(_camera(f) / "row_index.npy", np.full(RAW, 999)), "row_index to 999"),
        (lambda f: np.save(_camera(f) / "col_index.npy", np.zeros(3)), "two \\(H, W\\) arrays of whole numbers"),
        (lambda f: np.save(_depth(f) / "Pixel_to_Depth.npy", np.full(5, np.nan)), "finite depths in mm"),
        (lambda f: (f / "led_pcb_positions.csv").write_text("designator,x_mm\nLED1,3\n"), "line 2: 'y_mm'"),
        (lambda f: (f / "led_pcb_positions.csv").write_text("x_mm,y_mm\n1,2\n"), "1 LEDs; needed: 3 or more"),
        (
            lambda f: shutil.copy(_depth(f) / "rectify_crop_ref.png", _depth(f) / "rectify_crop_sample.png"),
            "needed: a contact of ten times the noise",
        ),
    ],
)
def test_a_bad_folder_is_refused(source, tmp_path, spoil, words):
    folder = tmp_path / "in"
    shutil.copytree(source, folder)
    spoil(folder)
    with pytest.raises(BadCapture, match=words):
        translucent.import_translucent(folder, tmp_path / "set")
    assert not (tmp_path / "set").exists()


@pytest.mark.skipif(not SHARED.is_dir(), reason="the measured 9DTact folder is not here")
def test_the_measured_sensor_is_read(tmp_path):
    """A round contact of 3.4 mm, whose depth is that of the authors' table; two pixels of rim; LEDs of the board."""
    found = translucent.import_translucent(SHARED, tmp_path / "set")
    contact, text = found.facts["contact"], "\n".join(found.warnings)
    assert contact["radius_mm"] == pytest.approx(3.4, abs=0.1) and contact["edge_off_rms_mm"] < 0.05
    assert contact["depth_mm"] == pytest.approx(1.9151, rel=0.05)
    assert "differ, by up to" not in text and "authors' table" not in text
    assert found.facts["leds_from"] == "led_pcb_positions.csv" and len(found.facts["leds_mm"]) == 8
    assert 0.4 < capture_set.load(found.folder).noise.sd(160.0) < 0.8
