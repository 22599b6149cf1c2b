"""The scoreboard on captures whose truth is known: what is right reaches the noise, what is wrong stands above it, and
the published numbers are only set beside."""

import importlib.util
import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from optics import facade
from optics.captures import capture_set, importing, scans
from optics.captures.noise import Noise
from optics.errors import BadCapture
from optics.study import board as boards
from optics.study.scoreboard import BACKGROUND, PHOTOGRAPH, _Bench, circle, scoreboard

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"

spec = importlib.util.spec_from_file_location("made_scans", ROOT / "tests" / "unit" / "test_scans.py")
made = importlib.util.module_from_spec(spec)
spec.loader.exec_module(made)


@pytest.fixture(scope="module")
def plates(mitsuba, tmp_path_factory):
    """Two plates of balls under three LEDs, one at a time, drawn by a formula: a far light, some light from all
    sides."""
    path, rng = tmp_path_factory.mktemp("bench"), np.random.default_rng(5)
    made.write_scan(path / "one", made.middles(0.13, -0.21, 2.0), rng)
    made.write_scan(path / "two", made.middles(-0.3, 0.1, -1.0), rng)
    made.write_scan(path / "flat", {}, rng, annotated=False)
    return scans.import_scans(path, tmp_path_factory.mktemp("out") / "plates", bin=2).folder


@pytest.fixture(scope="module")
def of_plates(plates):
    (found,) = scoreboard([plates])
    return found


@pytest.fixture(scope="module")
def study(mitsuba, tmp_path_factory):
    """A calibrated study of captures that its own model took: the physical model is exactly right."""
    path = tmp_path_factory.mktemp("exact")
    rng = np.random.default_rng(7)
    made.write_scan(path / "scans" / "one", made.middles(0.13, -0.21, 2.0), rng)
    made.write_scan(path / "scans" / "two", made.middles(-0.3, 0.1, -1.0), rng)
    made.write_scan(path / "scans" / "three", made.middles(0.2, 0.3, 1.0), rng)
    made.write_scan(path / "scans" / "flat", {}, rng, annotated=False)
    scans.import_scans(path / "scans", path / "first", bin=8)
    choices = {"free": ["led_*.[xy]"], "per_group": ["gel.press_x"], "held_out": ["two"]}
    first = facade.calibrate(path / "first", path / "first-study", **choices)
    first.imitate(path / "captures", {"gel.press_depth": 0.18})
    return facade.calibrate(path / "captures", path / "study", fit=path / "first-study", **choices)


@pytest.mark.slow
def test_tables_that_are_right_reach_the_noise(of_plates):
    """Within 0.65 radii the far light sees all of the balls: Lambert and linear in the normal are exactly right."""
    assert of_plates.held_out == ["two"] and of_plates.fitted == ["one"] and of_plates.frames == 3
    for name in ("directional Lambert with shadow", "linear in the normal", "cubic in the normal"):
        contact = of_plates.entry(name).contact
        # the noise itself is an estimate, good to 15 % in variance (test_scans), and so is the flat field
        assert 0.75 < contact.chi2_per_dof < 1.3, name
        assert "the balls' own normals" in of_plates.entry(name).how["contact"]
    right, flat = of_plates.entry("linear in the normal"), of_plates.entry("mean")
    assert flat.contact.chi2_per_dof > 50 and flat.contact.ratio > 10 * right.contact.ratio
    assert of_plates.best(boards.RIVAL).contact.ratio <= right.contact.ratio
    assert not of_plates.beaten and of_plates.best(boards.STEP) is None


@pytest.mark.slow
def test_background_and_photographs_are_worse_than_the_truth(of_plates):
    truth = of_plates.entry("linear in the normal")
    for name in (BACKGROUND, PHOTOGRAPH):
        wrong = of_plates.entry(name)
        assert wrong.contact.ratio > 5 * truth.contact.ratio and wrong.contact.l1 > 5 * truth.contact.l1
        assert wrong.contact.psnr < truth.contact.psnr - 10 and wrong.contact.ssim < truth.contact.ssim
        assert wrong.whole.rms > truth.whole.rms
    # each held-out frame is predicted by that of the other plate under the same LED
    assert of_plates.entry(PHOTOGRAPH).how["whole"] == "one_07, one_08, one_09"
    assert of_plates.entry(PHOTOGRAPH).numbers is None and of_plates.entry(BACKGROUND).numbers == 0


@pytest.mark.slow
def test_numbers_are_counted_and_split_by_lamp(of_plates):
    linear = of_plates.entry("linear in the normal, with position")
    assert linear.numbers == 3 * 12 and linear.each == 12
    cells = linear.contact.cells
    assert [c["led"] for c in cells] == ["led_07", "led_08", "led_09"]
    low, high = linear.contact.span("ratio")
    assert low <= linear.contact.ratio <= high
    # the whole is the mean of its parts, weighted by values
    whole = math.sqrt(sum(c["n"] * c["ratio"] ** 2 for c in cells) / sum(c["n"] for c in cells))
    assert linear.contact.ratio == pytest.approx(whole, rel=1e-9)
    assert sum(c["n"] for c in cells) == linear.contact.n


@pytest.mark.slow
def test_the_directional_table_finds_the_lights(of_plates):
    """A degree: as the import's own estimate from the same balls (test_scans)."""
    found = {led.removeprefix("led_"): azimuth for led, azimuth in of_plates.rivals_azimuths.items()}
    assert found == pytest.approx(made.AZIMUTHS, abs=1.0)


@pytest.mark.slow
def test_the_error_against_the_number_of_presses(study):
    (found,) = scoreboard([], [study.folder], presses=True)
    rows = found.by_presses["linear in the normal"]
    assert [r["presses"] for r in rows] == [1, 2]
    full = found.entry("linear in the normal")
    assert rows[-1]["ratio"] == pytest.approx(full.contact.ratio, rel=1e-6)
    (own,) = found.of(boards.STEP)
    again = found.by_presses[own.name]
    # two plates are what the study was fitted to: the same minimum, to the tolerance of a fit
    assert again[-1]["ratio"] == pytest.approx(own.contact.ratio, rel=0.02)


@pytest.mark.slow
def test_a_model_that_is_right_reaches_the_noise_and_beats_every_rival(study):
    (found,) = scoreboard([study.setup.captures], [study.folder, study.folder])  # named twice, scored once
    (own,) = found.of(boards.STEP)
    assert found.studies == [str(study.folder)] and own.name == "study: base"
    assert own.contact.chi2_per_dof == pytest.approx(1.0, abs=0.15)  # a thousand values: sd 0.04
    assert not found.beaten and found.best(boards.RIVAL).contact.ratio > own.contact.ratio
    # the whole image is what the ladder says of the held-out frames
    recorded = study.record.steps[0]["held_out"]
    assert own.whole.chi2_per_dof == pytest.approx(recorded["chi2_per_dof"], rel=1e-3)
    assert own.whole.rms == pytest.approx(recorded["rms"], rel=1e-3)
    assert own.numbers == 6 and own.poses == 1  # x and y of three LEDs; the held-out plate's x
    (ring,) = found.rings
    assert sum(led["step"] for led in ring.leds) == pytest.approx(360.0)
    assert ring.off == pytest.approx(0.0, abs=1e-6)  # three points lie on a circle


@pytest.mark.slow
def test_the_command_writes_a_page_and_a_record_and_overwrites_nothing(optics, study, tmp_path):
    code, out, _ = optics("scoreboard", study.setup.captures, "--study", study.folder, "-o", tmp_path / "page")
    assert code == 0 and "study: base" in out and "linear in the normal" in out and "Table S1" in out
    page = (tmp_path / "page" / "scoreboard.html").read_text(encoding="utf-8")
    assert "beats every rival" in page and "0.976 ± 0.008" in page and "38.8 ± 1.2" in page
    assert "http" not in page.replace("http://www.w3.org", "")  # self-contained
    record = json.loads((tmp_path / "page" / "scoreboard.json").read_text(encoding="utf-8"))
    (found,) = record["boards"]
    assert {e["name"] for e in found["entries"]} >= {BACKGROUND, PHOTOGRAPH, "mean", "study: base"}
    assert record["published"]["l1"] == [0.009, 0.003]
    code, _, err = optics("scoreboard", "--study", study.folder, "-o", tmp_path / "page")
    assert code == 2 and "--force" in err
    code, out, _ = optics("scoreboard", "--study", study.folder, "-o", tmp_path / "page", "--force", "--json")
    assert code == 0 and json.loads(out)["boards"][0]["region"] == "0.65 radii of each whole ball"


def test_a_set_without_a_flat_field_is_scored_in_dn(mitsuba, tmp_path):
    """Four presses of the shipped sensor as noise: the contact is where the ball touches, and nothing has a ratio."""
    rng = np.random.default_rng(3)
    frames = [
        capture_set.Frame(
            f"press-{k}",
            rng.normal(100, 2, (60, 80, 3)).astype(np.float32),
            None,
            f"press-{k}",
            {"gel.press_x": 0.3 * k, "gel.press_depth": 0.5},
        )
        for k in range(4)
    ]
    noise = Noise(0.04, 0.0, 0.0, 255.0, 0.0)
    capture_set.write(capture_set.Captures(Path("."), "gelsight", frames, noise=noise), tmp_path / "set")
    (found,) = scoreboard([tmp_path / "set"])
    assert found.held_out == ["press-1"] and found.region == "where the indenter touches" and found.measure == "rms"
    assert any("no flat field" in note for note in found.notes)
    assert BACKGROUND not in [e.name for e in found.entries]
    mean = found.entry("mean").contact
    assert mean.ratio is None and mean.rms == pytest.approx(2.0, rel=0.2) and mean.chi2_per_dof < 1.4
    assert found.entry(PHOTOGRAPH).contact.rms == pytest.approx(2.0 * math.sqrt(2), rel=0.2)
    assert found.channels == ["R", "G", "B"] and len(mean.cells) == 3


@pytest.mark.slow
def test_what_cannot_be_scored_is_refused(mitsuba, tmp_path, plates):
    with pytest.raises(ValueError, match="nothing to score"):
        scoreboard()
    with pytest.raises(KeyError, match="unknown group of frames 'tow'; did you mean 'two'"):
        scoreboard([plates], held_out=["tow"])
    with pytest.raises(BadCapture, match="nothing is held out"):
        scoreboard([plates], held_out=[])
    one = capture_set.load(plates)
    one.frames = [f for f in one.frames if f.group == "one"]
    capture_set.write(one, tmp_path / "one")
    with pytest.raises(BadCapture, match="one group of frames"):
        scoreboard([tmp_path / "one"])


def test_the_circle_through_points():
    """A regular ring, and one with a point off by 0.1: the middle moves by a third of a tenth at most."""
    turns = np.radians([10, 70, 130, 190, 250, 310])
    at = np.array([1.0, -2.0]) + 5.0 * np.stack([np.cos(turns), np.sin(turns)], -1)
    middle, radius, off = circle(at)
    assert middle == pytest.approx([1.0, -2.0]) and radius == pytest.approx(5.0) and off < 1e-9
    at[0, 0] += 0.1
    middle, radius, off = circle(at)
    assert np.hypot(*(middle - (1.0, -2.0))) < 0.034 and 0.01 < off < 0.1
    assert circle(np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]])) is None


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "gelsight_single_led").is_dir(), reason=f"no real images in {DATA}")
def test_tables_on_a_real_bench(mitsuba, tmp_path):
    """Fitted on one plate, tested on another, at 8 px a pixel: four numbers of the normal halve the error of one
    direction, as was measured at 4 px (.033-.042 and .071-.077, of .179-.187)."""
    found = scans.import_scans(DATA / "gelsight_single_led", tmp_path / "set", bin=8)
    (board,) = scoreboard([found.folder], held_out=["BGA-002"])
    assert 0.16 < board.entry("mean").contact.ratio < 0.20
    assert 0.055 < board.entry("directional Lambert with shadow").contact.ratio < 0.08
    assert 0.022 < board.entry("linear in the normal").contact.ratio < 0.042
    assert board.entry(PHOTOGRAPH).contact.ratio > board.entry(BACKGROUND).contact.ratio


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "digitdepth_digit_ball").is_dir(), reason=f"no real images in {DATA}")
def test_a_real_set_of_single_presses_is_scored(mitsuba, tmp_path):
    folder = DATA / "digitdepth_digit_ball"
    importing.import_circles(
        folder / "images", folder / "labels.csv", tmp_path / "set", ball_radius=3.0, mm_per_pixel=1 / 17.15, bin=8
    )
    (board,) = scoreboard([tmp_path / "set"])
    errors = {e.name: e.contact.ratio for e in board.entries}
    assert errors["linear in the normal"] < errors[PHOTOGRAPH] < errors[BACKGROUND]
    rows = board.by_presses["quadratic in the normal, with position"]
    assert rows[-1]["presses"] == 10 and rows[-1]["ratio"] < rows[0]["ratio"]


def test_a_table_gets_a_gain_where_a_study_finds_one():
    """Least squares above black, of usable values alone."""
    bench = object.__new__(_Bench)
    rng = np.random.default_rng(0)
    light = rng.uniform(20, 200, (6, 7, 2))
    image = 5.0 + light * np.array([1.1, 0.8])
    mask = np.ones(light.shape, bool)
    mask[0, 0], image[0, 0] = False, 255.0
    bench.black, bench.model = 5.0, SimpleNamespace(frames=[SimpleNamespace(image=image)])
    bench.mask = lambda index, inner: mask
    assert bench.with_gain(0, 5.0 + light, True)[mask] == pytest.approx(image[mask])
