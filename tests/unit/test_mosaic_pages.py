"""Raw mosaics on pages: what a person sees of them, against images whose planes are known."""

import numpy as np
import pytest

from optics.captures.capture_set import cfa_channel
from optics.fit.compare import Comparison
from optics.pages import scoreboard
from optics.pages.mosaics import Eye, filled, unwoven
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
    assert image.shape == (H, W - 1, 1)
    for i, j in np.ndindex(2, 2):
        quarter = image[i * 23 : i * 23 + 23, j * 30 : j * 30 + 30, 0]
        np.testing.assert_array_equal(quarter, CELL[i][j] + 1000.0 * np.arange(23)[:, None] + 0 * np.arange(30))


def test_cells_that_are_no_squares():
    level = np.tile([[1, 2, 3]], (4, 2))
    np.testing.assert_array_equal(unwoven(level, (1, 3)), np.repeat([[1, 1, 2, 2, 3, 3]], 4, 0))


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
    assert found["size"] == ((30, 23) if "cfa" in mosaic else (60, 46) if mosaic else (W, H))


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
