"""What a printed grid says of its surroundings, as in examples/states_magictac.py: MagicGripper's Figures 25 to 28,
with its thresholds."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
spec = importlib.util.spec_from_file_location("states_magictac", ROOT / "examples" / "states_magictac.py")
states = importlib.util.module_from_spec(spec)
spec.loader.exec_module(states)


@pytest.mark.slow
def test_states_as_published(mitsuba):
    made = states.images()
    _, rows, wide = states.readings(made)
    by = {state: [k for k, m in enumerate(made) if m[0] == state] for state in states.PUBLISHED}
    fixed, held = rows["fixed"][0], rows["holds its mean"][0]
    walls = rows["holds its mean"][1]
    (still,) = by["still"]
    assert fixed[still].proximity == "Normal" and held[still].similarity > 0.85
    for k in by["approach"]:  # entropy up, correlation of the channels low, nothing touched
        assert fixed[k].entropy > 2 and fixed[k].proximity == "Approaching" and held[k].similarity > 0.85
    for k in by["flashlight"]:  # entropy up, correlation up to nearly 1
        assert fixed[k].entropy > 1 and fixed[k].proximity == "Noise" and fixed[k].correlation > 0.7
    assert fixed[by["flashlight"][-1]].correlation > 0.9 and walls[by["flashlight"][-1]].similarity < 0.5
    for k in by[
        "touch"
    ]:  # from 0.85 to below 0.8, where the camera holds its mean; with a fixed exposure light only adds
        assert held[k].similarity < 0.8 < fixed[k].similarity
    assert (
        wide[still] == 0 and (sorted(wide) == wide) and wide[by["touch"][-1]] > 2 * wide[by["touch"][0]] > 0
    )  # wider with force
