"""Scan folders of a bench that lights one LED per picture: what an import derives from scans that were drawn with
numpy, and what it refuses."""

import json
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image
from scipy.ndimage import gaussian_filter

from optics.captures import capture_set, scans
from optics.errors import BadCapture, UnknownKey
from optics.files.heights import TMD
from optics.light.rendering import RenderJob
from optics.scene import loader
from optics.scene.parameter import Values
from optics.study.setup import open_model, setup_for

HEIGHT, WIDTH, SCALE = 384, 512, 0.012  # px, px, mm/px
RADIUS, SPACING = 0.25, 1.0
AZIMUTHS = {"07": -90.0, "08": -150.0, "09": 145.0}
GAIN = 0.02  # DN per DN of variance
SHARED = Path(__file__).parents[3] / "shared" / "data" / "gelsight_single_led"


def middles(x, y, turn):
    """{(gx, gy): mm from the middle of the image} of all balls in view."""
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    grid = [(i, j) for i in range(-4, 5) for j in range(-4, 5)]
    at = {(i, j): (x + SPACING * (c * i - s * j), y + SPACING * (s * i + c * j)) for i, j in grid}
    edge = WIDTH * SCALE / 2 - 0.3, HEIGHT * SCALE / 2 - 0.3
    return {k: p for k, p in at.items() if abs(p[0]) < edge[0] and abs(p[1]) < edge[1]}


def shaded(balls, azimuth, rng, spots=(), pedestal=0.0, blur=0.0):
    """A picture in DN: a far light 50 deg high over half balls on a plane, some light from all sides, a fall-off across
    the face, shot noise; a dark speck at each of `spots`; of a lens that blurs by `blur` px, and a
    camera that adds a pedestal."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    x, y = (u - WIDTH / 2) * SCALE, (v - HEIGHT / 2) * SCALE
    nx, ny = np.zeros_like(x), np.zeros_like(x)
    for a, b in balls:
        near = np.hypot(x - a, y - b) < 0.95 * RADIUS
        nx[near], ny[near] = (x - a)[near] / RADIUS, (y - b)[near] / RADIUS
    high, turn = np.radians(50), np.radians(azimuth)
    direct = np.cos(high) * (nx * np.cos(turn) + ny * np.sin(turn)) + np.sin(high) * np.sqrt(1 - nx**2 - ny**2)
    signal = 90 * (1 + 0.05 * (x * np.cos(turn) + y * np.sin(turn))) * (np.maximum(direct, 0) + 0.3)
    for row, column in spots:
        signal[row : row + 10, column : column + 10] *= 0.5
    signal = gaussian_filter(signal, blur)
    noisy = signal + np.sqrt(GAIN * signal) * rng.standard_normal(signal.shape)
    return np.clip(np.round(noisy + pedestal), 0, 255)


def circle(x, y, gx, gy):
    return {"type": "GridCircle", "gx": gx, "gy": gy, "x": x, "y": y}


def write_scan(folder, balls, rng, annotated=True, spots=(), pedestal=0.0, blur=0.0, **changed):
    folder.mkdir(parents=True)
    for label, azimuth in AZIMUTHS.items():
        picture = shaded(list(balls.values()), azimuth, rng, spots, pedestal, blur)
        Image.fromarray(picture.astype(np.uint8)).save(folder / f"image{label}.png")
    at = {k: (float(a / SCALE + WIDTH / 2 - 0.5), float(b / SCALE + HEIGHT / 2 - 0.5)) for k, (a, b) in balls.items()}
    circles = [circle(x, y, i, j) for (i, j), (x, y) in at.items()]
    table = {
        "images": [f"image{label}.png" for label in AZIMUTHS],
        "calibradius": RADIUS if annotated else 0,
        "calibspacing": SPACING if annotated else 0,
        "mmperpixel": SCALE if annotated else 0,
        "annotations": [*circles, {"type": "Note"}] if annotated else [],
    }
    (folder / "scan.yaml").write_text(yaml.safe_dump({**table, **changed}))


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    path, rng = tmp_path_factory.mktemp("bench"), np.random.default_rng(5)
    write_scan(path / "one", middles(0.13, -0.21, 2.0), rng, spots=[(40, 60)])
    write_scan(path / "two", middles(-0.3, 0.1, -1.0), rng)
    write_scan(path / "flat", {}, rng, annotated=False)
    return path


@pytest.fixture(scope="module")
def imported(source, tmp_path_factory):
    return scans.import_scans(source, tmp_path_factory.mktemp("out") / "captures", bin=4)


@pytest.mark.slow
def test_plates_noise_and_lights_are_derived(imported):
    facts = json.loads((imported.folder / "import.json").read_text())
    for name, (x, y, turn) in {"one": (0.13, -0.21, 2.0), "two": (-0.3, 0.1, -1.0)}.items():
        found = facts["scans"][name]
        assert (found["x_mm"], found["y_mm"]) == pytest.approx((x, y), abs=1e-6)
        assert (found["turn_deg"], found["spacing_mm"]) == pytest.approx((turn, SPACING), abs=1e-6)
    # 1500 pixels a ball and 20 balls, a falling light: far below a degree
    assert facts["light_azimuths_deg"] == pytest.approx(AZIMUTHS, abs=1.0)
    # blocks of 16 pixels: a sixteenth of GAIN, and of the steps of 1 DN, as much again for the flat field
    expected = 2 * (GAIN * 90 + 1 / 12) / 16
    assert imported.facts["noise"]["system_gain"] * 90 + imported.facts["noise"]["dark_noise"] ** 2 == pytest.approx(
        expected, rel=0.15
    )


@pytest.mark.slow
def test_a_pedestal_is_found_in_the_noise_unless_it_is_given(imported, tmp_path, monkeypatch):
    """12 DN, of a camera without dark noise behind a lens that blurs; and none where there is none."""
    assert imported.facts["black_level"] == {"DN": 0.0, "by": "assumed"}
    assert "black level: 0 DN, assumed" in (imported.folder / "README.txt").read_text()
    for name, value in {"HEIGHT": 2 * HEIGHT, "WIDTH": 2 * WIDTH, "SCALE": SCALE / 2}.items():
        monkeypatch.setitem(globals(), name, value)
    rng, camera = np.random.default_rng(5), {"pedestal": 12.0, "blur": 1.2}
    write_scan(tmp_path / "in" / "one", middles(0.13, -0.21, 2.0), rng, **camera)
    write_scan(tmp_path / "in" / "flat", {}, rng, annotated=False, **camera)
    found = scans.import_scans(tmp_path / "in", tmp_path / "out", bin=4)
    told = found.facts["black_level"]
    assert told["by"] == "photon noise"
    assert told["DN"] == pytest.approx(12.0, abs=3 * told["sd_DN"])
    assert capture_set.load(found.folder).noise.black_level == told["DN"]
    assert any("black level" in c["what"] for c in found.facts["corrections"])
    assert found.facts["light_azimuths_deg"] == pytest.approx(AZIMUTHS, abs=1.0)
    for wrong, said in ((300.0, "below saturation, 255 DN"), (-5.0, "0 or more"), (125.0, "flat, the flat field")):
        with pytest.raises(BadCapture, match=said):
            scans.import_scans(tmp_path / "in", tmp_path / "out2", bin=4, black_level=wrong)
    given = scans.import_scans(tmp_path / "in", tmp_path / "out2", bin=4, black_level=11.0)
    assert given.facts["black_level"] == {"DN": 11.0, "by": "given"}
    assert capture_set.load(given.folder).noise.black_level == 11.0


@pytest.mark.slow
def test_captures_have_a_flat_field_and_settings_for_each_led(imported):
    found = capture_set.load(imported.folder)
    assert [f.name for f in found.frames] == [f"{s}_{k}" for s in ("one", "two") for k in AZIMUTHS]
    for frame in found.frames:
        on = [key for key, value in frame.parameters.items() if key.endswith(".power") and value > 0]
        assert on == [f"led_{frame.name[-2:]}.power"] and frame.flat_field is not None
        assert frame.group == frame.name[:-3] and frame.image.shape == (HEIGHT // 4, WIDTH // 4, 1)
    speck = found.frames[0].mask[10:13, 15:18]
    assert not speck.any()  # 10 pixels at (40, 60)
    assert all(f.mask.mean() > 0.99 for f in found.frames)
    assert "dust, hair or glints" in imported.warnings[0]


@pytest.mark.slow
def test_the_scene_shows_the_balls_where_they_are(imported):
    """Touched where the balls are, and nowhere else; the LEDs stand where the shading says."""
    found = capture_set.load(imported.folder)
    scene = loader.load(found.scene)
    shot = RenderJob(scene).take({k: v for k, v in found.frames[0].parameters.items() if "press" in k})
    touched = np.asarray(shot.channels["contact.Y"])
    v, u = np.mgrid[: HEIGHT // 4, : WIDTH // 4] + 0.5
    x, y = (u - WIDTH / 8) * 4 * SCALE, (v - HEIGHT / 8) * 4 * SCALE
    distance = np.min([np.hypot(x - a, y - b) for a, b in middles(0.13, -0.21, 2.0).values()], 0)
    inner = (np.abs(x) < 2.5) & (np.abs(y) < 1.8)
    assert touched[inner & (distance < 0.5 * RADIUS)].all() and not touched[inner & (distance > 1.2 * RADIUS)].any()
    for label, azimuth in AZIMUTHS.items():
        x, y = (scene.values()[f"led_{label}.{axis}"] for axis in "xy")
        assert np.degrees(np.arctan2(y, x)) == pytest.approx(azimuth, abs=1.0)


@pytest.mark.parametrize(
    "spoil, message",
    [
        ({"images": "image07.png"}, "images = 'image07.png'; allowed: a list of file names"),
        ({"images": ["image07.png", "../two/image08.png"]}, "no file '../two/image08.png'"),
        ({"images": ["image07.png", "image07.png"]}, "'image07.png' appears twice"),
        ({"images": ["image0.7.png"]}, "names of files name the LEDs; allowed: letters, digits"),
        ({"calibradius": "a"}, "calibradius = 'a'; allowed: a number"),
        ({"calibradius": 0.001}, "are 0.0833 px; allowed: balls of 5 to 192 px radius in images of 512 x 384 px"),
        ({"calibspacing": 0.1}, "calibspacing = 0.1 mm between balls of calibradius = 0.25 mm"),
        ({"mmperpixel": 0}, "mmperpixel = 0; allowed: a number from 1e-06 to 1000"),
        ({"annotations": 3}, "annotations = 3; allowed: a list"),
        (
            {"annotations": [{"type": "GridCircle", "x": 1, "y": 2, "gx": 0}]},
            "annotations[0]: gy = None; allowed: a number",
        ),
        (
            {"annotations": [{"type": "GridCircle", "x": 1e300, "y": 2, "gx": 0, "gy": 0}]},
            "annotations[0]: x = 1e+300; allowed: a number from -512 to 1024",
        ),
        (
            {"annotations": [circle(100, 200, 0, 0), circle(104, 200, 0, 0)]},
            "2 circles at gx, gy = 0, 0 lie 4 px apart; allowed: one a ball, or several within 2.08 px",
        ),
        (
            {"annotations": [circle(100, 200, 0, 0), circle(101, 200, 1, 0), circle(200, 200, 2, 0)]},
            "the circles at gx, gy = 0, 0 and 1, 0 lie 1 px apart; allowed: one place in the grid for each ball",
        ),
    ],
)
def test_a_bad_scan_is_refused(tmp_path, spoil, message):
    write_scan(tmp_path / "one", middles(0, 0, 0), np.random.default_rng(1), **spoil)
    with pytest.raises(BadCapture) as error:
        scans.import_scans(tmp_path, tmp_path / "out")
    assert message in str(error.value) and "scan.yaml" in str(error.value)


def test_circles_drawn_twice_are_averaged(tmp_path):
    """A ball annotated three times within a tenth of its radius of 21 px counts once, at the mean."""
    balls = middles(0, 0, 0)
    write_scan(tmp_path / "one", balls, np.random.default_rng(1))
    file = tmp_path / "one" / "scan.yaml"
    table = yaml.safe_load(file.read_text())
    (again,) = (a for a in table["annotations"] if (a.get("gx"), a.get("gy")) == (1, 0))
    table["annotations"] += [circle(again["x"] + 1.5, again["y"], 1, 0), circle(again["x"], again["y"] - 1.2, 1, 0)]
    file.write_text(yaml.safe_dump(table))
    scan = scans.read_scan(tmp_path / "one")
    assert len(scan.circles) == len(balls)
    (found,) = scan.circles[(scan.circles[:, 2:] == (1, 0)).all(1)]
    assert found[:2] == pytest.approx((again["x"] + 0.5, again["y"] - 0.4), abs=1e-9)
    assert scan.remarks == ["one: 1 ball annotated more than once: the mean of the circles is used"]
    with pytest.raises(BadCapture, match="no flat field"):  # what is missing, and not the circles
        scans.import_scans(tmp_path, tmp_path / "out")


BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i + 1}: &a{i + 1} [{', '.join(9 * [f'*a{i}'])}]\n" for i in range(9)
)


@pytest.mark.parametrize(
    "text, message",
    [
        ("images: [a, b", "no YAML (while parsing a flow sequence"),
        ("", "images = None; allowed"),
        (
            "images: [a.png]\ncalibradius: 1\ncalibradius: 2\n",
            "no YAML (line 3: calibradius appears twice in one table)",
        ),
        ("images: " + 5000 * "[", "nested too deep"),
        ("images: !!python/object/apply:os.getcwd []", "no YAML (could not determine a constructor"),
        (BOMB + "images: *a9\n", "images = [[[...], [...], "),
        ("x: " + 5000 * "9", "no YAML"),
    ],
)
def test_yaml_that_is_none_or_too_much(tmp_path, text, message):
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "scan.yaml").write_text(text)
    with pytest.raises(BadCapture) as error:
        scans.import_scans(tmp_path, tmp_path / "out")
    assert message in str(error.value) and "scan.yaml" in str(error.value) and len(str(error.value)) < 500


def test_circles_of_another_plate_are_refused(tmp_path):
    rng = np.random.default_rng(3)
    write_scan(tmp_path / "one", middles(0, 0, 0), rng, calibspacing=3.0)
    write_scan(tmp_path / "flat", {}, rng, annotated=False)
    with pytest.raises(BadCapture, match="one: circles are 1 mm apart .* about calibspacing = 3 mm"):
        scans.import_scans(tmp_path, tmp_path / "out")


@pytest.mark.slow
def test_scans_without_a_flat_field_or_of_another_scale(tmp_path, source):
    rng = np.random.default_rng(2)
    write_scan(tmp_path / "one", middles(0, 0, 0), rng)
    with pytest.raises(BadCapture, match="no flat field for one \\(512 x 384 px, LEDs 07, 08, 09\\)"):
        scans.import_scans(tmp_path, tmp_path / "out")
    write_scan(tmp_path / "flat", {}, rng, annotated=False)
    write_scan(tmp_path / "wide", middles(0, 0, 0), rng, calibspacing=1.1)
    found = scans.import_scans(tmp_path, tmp_path / "out", bin=8)
    assert any(
        "wide: balls are 1 mm apart by their circles and mmperpixel, 1.1 mm by calib" in w for w in found.warnings
    )


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.is_dir(), reason="the measured scans are not here")
def test_measured_scans_are_read(tmp_path):
    """LEDs on a regular ring, by the shading alone; circles within 5 um of a grid of 1 mm; the groove is left out."""
    found = scans.import_scans(SHARED, tmp_path / "out", bin=8)
    azimuths = np.sort(list(found.facts["light_azimuths_deg"].values()))
    assert np.diff(azimuths) == pytest.approx(60, abs=6)
    for plate in found.facts["scans"].values():
        assert plate["spacing_mm"] == pytest.approx(1, abs=2e-3) and plate["circles_off_rms_mm"] < 5e-3
    assert any("not used: groove" in w for w in found.warnings)


def write_map(file, heights, scale=SCALE):
    rows, columns = heights.shape
    sizes = struct.pack("<IIffff", columns, rows, columns * scale, rows * scale, 0.0, 0.0)
    file.write_bytes(TMD + b"\0" + sizes + heights.astype("<f4").tobytes())


def hill():
    """Heights (HEIGHT, WIDTH) in mm of a hill that stands right of the middle and above it, wider than high."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    x, y = (u - WIDTH / 2) * SCALE, (v - HEIGHT / 2) * SCALE
    return 0.12 * np.exp(-((x - 1.0) ** 2) / 0.5 - (y + 0.7) ** 2 / 0.25) - 0.3


@pytest.fixture(scope="module")
def shaped(tmp_path_factory):
    """A plate of balls, the flat field, and a coin with its map."""
    path, rng = tmp_path_factory.mktemp("shaped"), np.random.default_rng(6)
    write_scan(path / "balls", middles(0.13, -0.21, 2.0), rng)
    for name in ("coin", "flat"):
        write_scan(path / name, {}, rng, annotated=False)
    write_map(path / "coin" / "heightmap.tmd", hill())
    return path


def test_a_map_of_heights_presses_the_gel_where_it_is_asked_for(shaped, tmp_path):
    unused = scans.scans_in(shaped).unused
    assert unused == ["not used: coin (no balls); '--heightmap coin' takes the shape from heightmap.tmd"]
    earlier = tmp_path / "captures" / "heights"
    earlier.mkdir(parents=True)
    (earlier / "stamp.tmd").write_text("")
    (earlier.parent / "import.json").write_text('{"heightmaps": ["stamp"]}')
    found = scans.import_scans(shaped, earlier.parent, bin=8, mapped=["coin"], overwrite=True)
    assert [f.name for f in earlier.iterdir()] == ["coin.tmd"]
    assert any("name it too: '--hold-out coin'" in w for w in found.warnings)
    model = open_model(setup := setup_for(found.folder))
    assert setup.held_out == ["coin"] and "heights/coin.tmd" in model.captures.files
    wider = model.at(Values({"gel.indenter_size": 0.3}), 0)
    assert wider["gel.indenter_size"] == 0.3  # the size of balls may be calibrated
    groups = [f.group for f in model.frames]
    assert groups == ["balls"] * 3 + ["coin"] * 3
    position = model.renderer.hits(model.at(Values(), groups.index("coin"))).position
    expected = hill().reshape(HEIGHT // 8, 8, WIDTH // 8, 8).mean((1, 3))
    # means of 8 samples along a slope of .2 and ends of facets: 1 um; a pixel's ray meets the face aside of its middle
    # by a thousandth of its height
    assert position[..., 2] == pytest.approx(expected.min() - expected, abs=3e-3)
    assert np.ptp(position[..., 2]) == pytest.approx(np.ptp(expected), rel=0.02)


@pytest.mark.parametrize(
    "name, message",
    [
        ("cion", "cion"),
        ("balls", "has circles: it is imported as a plate of balls"),
        ("flat", "flat/heightmap.tmd: no such file"),
        ("small", "3.072 x 2.304 mm, but the image shows 6.144 x 4.608 mm"),
        ("deep", "heights from -300 to -180 mm; allowed: heights in mm that differ, by less than the gel's thickness"),
    ],
)
def test_a_map_that_cannot_be_used_is_refused(shaped, tmp_path, name, message):
    shutil.copytree(shaped, tmp_path / "scans")
    shutil.copytree(shaped / "coin", tmp_path / "scans" / "small")
    shutil.copytree(shaped / "coin", tmp_path / "scans" / "deep")
    write_map(tmp_path / "scans" / "small" / "heightmap.tmd", hill(), SCALE / 2)
    write_map(tmp_path / "scans" / "deep" / "heightmap.tmd", 1e3 * hill())
    with pytest.raises((BadCapture, UnknownKey)) as error:
        scans.import_scans(tmp_path / "scans", tmp_path / "out", bin=8, mapped=[name])
    assert message in str(error.value)


def test_a_scan_with_a_map_is_no_flat_field(shaped, tmp_path):
    folder = tmp_path / "scans"
    shutil.copytree(shaped, folder)
    (folder / "coin").rename(folder / "a_flat_coin")
    assert scans.scans_in(folder).flat.name == "flat"
    assert scans.scans_in(folder, ["a_flat_coin"]).flat.name == "flat"
    (folder / "flat").rename(folder / "background")
    assert scans.scans_in(folder, ["a_flat_coin"]).flat.name == "background"
    shutil.rmtree(folder / "background")
    with pytest.raises(BadCapture, match="one of nothing pressed.*that --heightmap does not name"):
        scans.scans_in(folder, ["a_flat_coin"])


def test_a_prior_of_the_user_leaves_the_other_advised_ones(tmp_path):
    advised = {"board.[xy]": [None, 3.0], "board.scale": [None, 0.7]}
    (tmp_path / "import.json").write_text(
        json.dumps({"setup": {"free": ["board.[xy]", "board.scale"], "priors": advised, "values": {"gel.n": 1.4}}})
    )
    setup = setup_for(tmp_path, priors={"board.x": [None, 1.0]}, values={"gel.press_depth": 0.1})
    assert list(setup.priors.items()) == [
        ("board.[xy]", (None, 3.0)),
        ("board.scale", (None, 0.7)),
        ("board.x", (None, 1.0)),
    ]
    assert setup.values == {"gel.n": 1.4, "gel.press_depth": 0.1}
    assert setup_for(tmp_path, free=["board.x"]).priors == {}
