"""What a step records of held-out frames is what was fitted in them for this step."""

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from optics.diagnosis import held_out
from optics.scene.parameter import Values, Variable
from optics.study import loop


def test_a_resumed_study_records_the_poses_found_in_this_step(monkeypatch):
    """A study that was taken up again starts with the poses of the step before, in held-out frames as well."""
    now = Values({"camera.blur": 0.5}, {0: {"gel.press_x": 1.1}, 1: {"gel.press_x": 2.0}})  # frame 1 is held out
    found_now = Values(dict(now.common), {**now.frame, 1: {"gel.press_x": 2.7}})
    fit = SimpleNamespace(values=now, variables=[], frames=[0], warnings=[])
    monkeypatch.setattr(loop, "held_out_values", lambda model, found, held: (found_now, 1))
    monkeypatch.setattr(loop, "comparison_of", lambda *a: SimpleNamespace(fitted=None))
    monkeypatch.setattr(loop.checks, "after_calibration", lambda *a: [])
    monkeypatch.setattr(loop, "null_models", lambda *a: None)
    monkeypatch.setattr(loop, "background_of", lambda *a: None)
    monkeypatch.setattr(loop, "origin_of", lambda *a: None)
    monkeypatch.setattr(loop, "Fit", SimpleNamespace)
    seen = {}
    monkeypatch.setattr(loop, "shown_frames", lambda model, values, held: seen.setdefault("shown", values))
    record = SimpleNamespace(add_step=lambda name, key, kept, *a, **more: seen.setdefault("kept", kept.values))
    loop.write_step(record, SimpleNamespace(where_used=nullcontext), None, fit, [1], 0.0)
    for values in (seen["shown"], seen["kept"]):
        assert values.frame == {0: {"gel.press_x": 1.1}, 1: {"gel.press_x": 2.7}}
        assert values.common == {"camera.blur": 0.5}


def test_values_without_some_variables_have_what_was_given_again():
    """A strength that the study was begun with comes back; what a frame has of its own goes, in held-out frames too."""
    glare, gain = (
        SimpleNamespace(keys=(key,), frames=frames) for key, frames in (("camera.glare", None), ("camera.gain", (0,)))
    )
    now = Values(
        {"camera.glare": 0.3, "led.x": 1.0}, {0: {"camera.gain": 1.1, "gel.press_x": 2.0}, 1: {"camera.gain": 0.9}}
    )
    left = now.without([glare, gain], {"camera.glare": 0.1, "led.x": 7.0})
    assert left.common == {"led.x": 1.0, "camera.glare": 0.1}
    assert left.frame == {0: {"gel.press_x": 2.0}, 1: {}}
    assert "camera.glare" not in now.without([glare], {}).common and now.common["camera.glare"] == 0.3


@pytest.mark.parametrize(("near", "starts", "left"), [(4.0, [2.0], 4.0), (9.0, [2.0, 0.0], 1.0)])
def test_a_held_out_press_starts_where_the_base_had_it(near, starts, left, monkeypatch):
    """At 2 mm, where the base misses by 5; where that is no better, at 0 too, where the effect's own fit has it."""
    press = Variable("press", ("press",), None)
    asked, misses = [], {0.0: 1.0, 2.0: near}

    def predicted(case, start, free):
        asked.append(start.common["press"])
        return [misses[start.common["press"]]], start

    monkeypatch.setattr(held_out, "_predicted", predicted)
    monkeypatch.setattr(held_out, "_square", lambda model, f, prediction, *_: prediction)
    monkeypatch.setattr(held_out, "noisier", lambda *_: 0.0)
    monkeypatch.setattr(held_out, "chi2", lambda *_: (1.0, 1.0))
    case = SimpleNamespace(
        evidence=SimpleNamespace(normal=SimpleNamespace(square=1.0, count=1), noise=1.0, is_table=False),
        model=SimpleNamespace(base={"press": 0.0}),
        held_out=[0],
        say=lambda *_: None,
        variables_of=lambda effect: [],
    )
    one = np.ones((1, 1, 1))
    base = held_out.Base([press], Values({"press": 2.0}), [5.0], [one], [one])
    member = SimpleNamespace(effect=SimpleNamespace(name="glare"))
    found = held_out.levels(case, base, [member], SimpleNamespace(values=Values({"press": 0.0})))
    assert asked == starts and found[-1].chi2_held_out == left and found[-1].fall == 5.0 - left
