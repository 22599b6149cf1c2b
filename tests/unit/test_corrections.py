"""What an import finds in measured values: clipping at black and drift, against images whose truth is known."""

import numpy as np
import pytest

from optics.captures import corrections


def noisy(level, rng, sd=3.0, shape=(80, 100)):
    return np.clip(np.round(level + sd * rng.standard_normal(shape)), 0, 255)


def test_a_pile_at_the_lowest_level_is_clipping_and_a_tail_is_not():
    rng = np.random.default_rng(2)
    dark, bright = noisy(1.0, rng), noisy(40.0, rng)
    floor = np.maximum(noisy(17.0, rng), 16.0)  # a camera that ends at 16 DN
    found = corrections.black_levels([np.stack([dark, bright, floor], -1)] * 2)
    assert found == [0.0, None, 16.0]
    # the darkest image of ordinary noise has a few values at its lowest level
    assert corrections.black_levels([np.stack([bright, noisy(60.0, rng)], -1)]) == [None, None]
    assert corrections.black_levels([np.full((8, 8, 1), 7.0)]) == [None]  # of one value nothing is known


def test_values_at_black_are_marked_channel_by_channel():
    image = np.array([[[0.0, 5.0], [3.0, 16.0]]])
    assert corrections.at_black(image, [0.0, 16.0]).tolist() == [[[True, True], [False, True]]]
    assert not corrections.at_black(image, [None, None]).any()
    remark, entry = corrections.black_text([0.0, None, 16.0], [0.02, 0.0, 0.001])
    assert "2 % of channel R at 0 DN, 0.1 % of channel B at 16 DN" in remark and "channel G" not in remark
    assert set(entry) == {"what", "how_much", "where"}


def test_drift_is_said_with_its_frame_its_step_and_its_trend():
    gains = 1 + np.array([[0.0], [0.002], [0.004], [0.030], [0.008]])
    text = corrections.drift_text(gains, list("abcde"))
    assert "+3 % in d" in text and "+2.6 % from c to d" in text
    # slope of the least-squares line, 0.0044 a frame, over four steps
    assert text.endswith("trend over all frames +1.8 %")
    assert corrections.drift_text(np.full((5, 3), 1.004), list("abcde")) is None


@pytest.mark.parametrize("entries", [[], [corrections.correction("a is masked", "3 %", "all frames")]])
def test_sentences_of_corrections(entries):
    assert corrections.sentences(entries) == ["- a is masked: 3 %; all frames"] * len(entries)
