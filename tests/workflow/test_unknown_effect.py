"""The tutorial of an effect that the library lacks, executed: puzzling residual, curve, table, formula, noise floor."""

import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_the_tutorial_goes_from_a_puzzling_residual_to_the_noise_floor(mitsuba, tmp_path):
    story = runpy.run_path(str(ROOT / "examples" / "unknown_effect.py"))
    found = story["main"](tmp_path / "story")
    base, table, formula = found["levels"].values()
    assert found["words"] == ["UNKNOWN", "CLAIM", "NOTHING"]
    assert (found["coordinate"], found["family"]) == ("row", "camera")
    # 28 000 held-out values: chi2/dof of noise is good to 0.0085 (1 sd)
    assert base > 1.15 and table < 1.03 and formula < 1.03
    value, sd = found["strength"]
    assert abs(value - found["expected"]) < 4 * sd < 0.002
    page = (tmp_path / "story" / "index.html").read_text(encoding="utf-8")
    for picture in ("1-residual", "2-curves", "3-draft", "4-formula", "5-answer", "6-ladder"):
        assert f"{picture}.png" in page and (tmp_path / "story" / f"{picture}.png").stat().st_size > 5000
    assert (tmp_path / "story" / "answer" / "report.html").is_file()
    with pytest.raises(FileExistsError, match="not empty"):
        story["main"](tmp_path / "story")
