"""Raw mosaics on pages: what a person sees of them, against images whose planes are known."""

import numpy as np
import pytest

from optics.captures.capture_set import cfa_channel
from optics.fit.compare import Comparison, compare
from optics.pages import scoreboard
from optics.pages.mosaics import Eye, filled, unwoven
from optics.pages.report import channel_styles
from optics.study.board import Images
from optics.study.shown import Fingerprint, Shown

CELL = [[90.0, 45.0], [135.0, 0.0]]
H, W = 46, 61  # the last column fills no cell


def shown(rng, channels, usable):
    predicted = np.broadcast_to(100.0, (H, W, channels))
    sd = np.broadcast_to(rng.uniform(1, 5, (H, W, 1)), predicted.shape)
    noise = rng.standard_normal((H, W, 1)) * sd  # of a colour mosaic the same in all channels, as one pixel has one
    return Shown("a", predicted + noise, predicted, sd, usable)


def test_each_analyser_is_an_image_of_its_own():
    level = np.tile(CELL, (H // 2, W // 2 + 1))[:H, :W, None]
    ramp = np.arange(H)[:, None, None] // 2 * 1000.0
    image = unwoven(level + ramp, (2, 2))
    assert image.shape == (H + 2, W + 1, 1)  # a seam of 61 / 48 px, rounded up; the last column is left out
    for i, j in np.ndindex(2, 2):
        quarter = image[i * 25 : i * 25 + 23, j * 32 : j * 32 + 30, 0]
        np.testing.assert_array_equal(quarter, CELL[i][j] + 1000.0 * np.arange(23)[:, None] + 0 * np.arange(30))
    assert np.isnan(image[23:25]).all() and np.isnan(image[:, 30:32]).all()
    assert np.isfinite(image).sum() == H * (W - 1)


def test_cells_that_are_no_squares():
    level = np.tile([[1, 2, 3]], (4, 2))
    np.testing.assert_array_equal(unwoven(level, (1, 3)), np.repeat([[1, 1, 0, 2, 2, 0, 3, 3]], 4, 0))


def test_a_study_without_a_mosaic_is_shown_as_it_is():
    frame = shown(np.random.default_rng(0), 1, np.ones((H, W), bool))
    eye = Eye({"frames": 3})
    assert eye.note == "" and eye.frame(frame) is frame
    np.testing.assert_array_equal(eye.whole(frame.measured), frame.measured)


def test_residuals_of_analysers_stay_what_they_are():
    rng = np.random.default_rng(0)
    usable = rng.uniform(size=(H, W)) > 0.1
    frame, eye = shown(rng, 1, usable), Eye({"mosaic": CELL})
    assert eye.note.endswith("90\u00b0 45\u00b0 / 135\u00b0 0\u00b0")
    np.testing.assert_array_equal(eye.frame(frame).residual, unwoven(frame.residual, (2, 2)))
    found = eye.fingerprint(Fingerprint("e", "a", frame.residual, 2 * frame.residual))
    np.testing.assert_array_equal(found.residual, 2 * found.image)


def test_colour_filters_become_pixels_with_three_colours():
    """Levels of 10, 20 and 30 DN; residuals of noise alone keep a standard deviation of 1, in green too."""
    rng = np.random.default_rng(1)
    own = cfa_channel((H, W), "GRBG")[..., None] == np.arange(3)
    eye = Eye({"cfa": "GRBG"})
    raw = np.repeat(np.where(own, [10.0, 20.0, 30.0], 0.0).sum(-1, keepdims=True), 3, 2)
    np.testing.assert_array_equal(eye.whole(raw), np.broadcast_to([10.0, 20.0, 30.0], (23, 30, 3)))
    frame = shown(rng, 3, own & (rng.uniform(size=(H, W, 1)) > 0.05))
    seen = eye.frame(frame)
    z = seen.residual
    assert z.shape == (23, 30, 3) and 0.02 < np.isnan(z).mean() < 0.15  # 5 % masked, 10 % of green
    assert np.nanstd(z, axis=(0, 1)) == pytest.approx(1, abs=4 / np.sqrt(2 * 600))
    mean = np.where(own, rng.standard_normal((H, W, 1)), np.nan)
    maps = eye.maps(Comparison([], [], {}, ["R", "G", "B"], [], 255.0, np.abs(mean), mean))
    assert np.nanstd(maps.mean_map, axis=(0, 1)) == pytest.approx(1, abs=4 / np.sqrt(2 * 690))
    assert np.sqrt(np.mean(maps.rms_map**2, axis=(0, 1))) == pytest.approx(1, abs=4 / np.sqrt(2 * 690))


@pytest.mark.parametrize(
    ("mosaic", "said"), [({"mosaic": CELL}, "90\u00b0 45\u00b0"), ({"cfa": "RGGB"}, "(RGGB)"), ({}, "")]
)
def test_the_scoreboard_says_how_it_shows_a_frame(mosaic, said):
    class Board:
        full_scale = 255.0
        images = None

        def best(self, kind):
            return None

    rng, channels = np.random.default_rng(2), 3 if "cfa" in mosaic else 1
    raw = np.repeat(rng.uniform(10, 200, (H, W, 1)), channels, 2)
    whole = np.ones((H, W, channels), bool)
    board = Board()
    board.images = Images("a", raw, {"m": raw + 1}, whole, whole[..., 0], mosaic)
    found = scoreboard.images(board)
    assert said in found["note"] and bool(found["note"]) == bool(mosaic)
    assert found["size"] == ((30, 23) if "cfa" in mosaic else (62, 48) if mosaic else (W, H))


def test_curves_of_a_mosaic_take_whole_cells_and_each_analyser():
    """Analysers that are 0.5 and 1 sd too bright and a slope over rows: along rows the slope alone is left, without a
    zigzag, and each analyser has it beside its own level. Of one frame of 47 rows in 16 bins, single rows would mix
    in other shares from bin to bin."""
    rows, site = np.arange(47)[:, None] + 0.5 + np.zeros(60), np.tile(CELL, (24, 30))[:47]
    level = {0.0: 0.0, 45.0: 0.5, 90.0: 1.0, 135.0: 0.0}
    z = np.vectorize(level.get)(site) + 0.02 * (rows // 2 * 2 + 1)
    coordinates = {"row": rows, "column": np.arange(60) + 0.5 + np.zeros((47, 1)), "site": site}
    whole = np.ones(z.shape, bool)

    def along_rows(cell):
        found = compare([100 + z], [0 * z + 100], [whole * 1.0], [whole], [coordinates], cell=cell)
        return {c.channel: c for c in found.curves if c.coordinate == "row"}

    found = along_rows((2, 2))
    assert found["all"].n.sum() == 46 * 60  # row 46 fills no cell
    for name, shift in {"all": 0.375, "0 deg": 0.0, "45 deg": 0.5, "90 deg": 1.0, "135 deg": 0.0}.items():
        c = found[name]
        np.testing.assert_allclose(c.mean, shift + 0.02 * c.centre, atol=1e-9)
    single = along_rows((1, 1))["all"]
    assert np.abs(single.mean - 0.375 - 0.02 * single.centre).max() > 0.1
    styles = channel_styles(Comparison([], list(found.values()), [], ["L"], {}, 255.0))
    assert sorted(styles) == ["0 deg", "135 deg", "45 deg", "90 deg", "B", "G", "R"]


def test_the_live_page_shows_a_mosaic_in_colour():
    """An even light of (3, 5, 7), and one red pixel brighter: each pixel has what its cell measured, odd rows stay."""
    channel = cfa_channel((5, 4), "RGGB")
    image = np.where(channel[..., None] == np.arange(3), np.array([3.0, 5.0, 7.0]), 0.0)
    image[2, 2, 0] = 9.0
    found = filled(image, "RGGB")
    expected = np.broadcast_to([3.0, 5.0, 7.0], (5, 4, 3)).copy()
    expected[2:4, 2:4, 0] = 9.0
    expected[4] = image[4]
    assert np.array_equal(found, expected)
    measured = channel[..., None] == np.arange(3)
    assert np.array_equal(found[measured], image[measured])
