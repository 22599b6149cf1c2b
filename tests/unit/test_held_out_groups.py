"""Which groups of frames are held out when nobody says: one in four, and none that alone shows a level of a setting."""

from types import SimpleNamespace

import pytest

from optics.study.setup import _every_fourth


def held(frames):
    """Groups that are held out, of frames given by their settings; each is a group by its number."""
    model = SimpleNamespace(frames=[SimpleNamespace(parameters=f) for f in frames])
    return _every_fourth(model, {str(i): [i] for i in range(len(frames))})


@pytest.mark.parametrize(
    "frames, expected",
    [
        ([{"a": float(i)} for i in range(9)], ["1", "5"]),  # a dial that is turned: each value is like its neighbours
        ([{"exposure": e} for e in (1.0, 0.4, 1.0, 1.0, 1.0, 1.0)], ["2", "5"]),
        ([{"exposure": e} for e in (1.0, 0.4, 1.0, 0.4, 1.0, 1.0)], ["1", "5"]),
        ([{}, {"exposure": 0.4}, {}, {}, {}, {}], ["2", "5"]),  # stated in one frame alone
    ],
)
def test_a_frame_that_alone_shows_a_level_is_kept(frames, expected):
    assert held(frames) == expected


def test_where_all_show_a_level_of_their_own_the_first_is_held_out():
    frames = [{"a": 0.0}] * 9 + [{"a": 1.0}, {"a": 2.0}, {"b": 3.0}, {"a": 0.0, "c": 1.0}]
    assert held(frames)[2] == "9"
