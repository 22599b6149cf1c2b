"""The tour: its commands run as they stand, and print what the page says they print."""

from __future__ import annotations

import os
from pathlib import Path

import matplotlib
import pytest
import tour

ROOT = Path(__file__).resolve().parents[2]
MEASURED = Path(os.environ.get("OPTICS_DATA", ROOT.parent / "shared" / "data")) / "digitdepth_digit_ball"
# Sums over threads and other versions of LLVM move the last digits; a wrong model moves far more.
CLOSE = 0.05
# A calibration of 52 parameters on hand-drawn labels stops a little elsewhere on another machine.
CLOSE_REAL = 0.15
SMALL = 1e-3  # numbers below are rounding or nearly nothing: their digits say nothing


@pytest.fixture(autouse=True)
def without_windows():
    before = matplotlib.get_backend()
    matplotlib.use("Agg")
    yield
    matplotlib.use(before)


def hold(found, close=CLOSE):
    """Every line that the page shows is printed, with its numbers."""
    missing = [line for block in found for line in block.missing]
    assert missing == []
    for block in found:
        if block.language != "text" or not block.printed:
            continue
        now, _ = tour.present(block.text, block.printed)
        for said, printed in zip(block.text.splitlines(), now.splitlines()):
            numbers = [[float(n) for n in tour.NUMBER.findall(line)] for line in (said, printed)]
            for a, b in zip(*numbers, strict=True):
                assert abs(a - b) <= max(close * abs(a), SMALL), f"the page says: {said}\nthe program: {printed}"


@pytest.mark.slow
def test_the_bench_part_runs_as_it_stands(mitsuba, tmp_path):
    found = tour.walk(tmp_path)
    hold(found)
    page = tour.PAGE.read_text(encoding="utf-8")
    for name in tour.images(page, real=False):
        assert (tmp_path / name).stat().st_size > 5_000, f"{name}: no such image was made"
        assert (tour.IMAGES / name).is_file(), f"{name} is missing: python docs/tools/tour.py FOLDER --write"


@pytest.mark.slow
@pytest.mark.skipif(not MEASURED.is_dir(), reason=f"no measured images in {MEASURED} (OPTICS_DATA names their folder)")
def test_the_real_part_runs_as_it_stands(mitsuba, tmp_path):
    tour.lay_out(MEASURED, tmp_path)
    found = tour.walk(tmp_path, real=True, quick=False)
    hold(found, CLOSE_REAL)
    for name in tour.images(tour.PAGE.read_text(encoding="utf-8"), real=True):
        assert (tour.IMAGES / name).is_file()


def test_the_commands_of_the_page_exist():
    """Also those of the part that is skipped: a command that was renamed is noticed without the images."""
    import typer

    from optics.cli import app

    known = typer.main.get_command(app).commands
    for block in tour.blocks(tour.PAGE.read_text(encoding="utf-8")):
        for command in tour.commands(block) if block.language == "sh" else ():
            assert command[0] in ("optics", "cp", *tour.FETCHED), command
            assert command[0] != "optics" or command[1] in known, command


def test_a_line_that_is_no_longer_printed_is_noticed():
    shown = "a 1.0 b\n...\nc 2 ...\n"
    assert tour.present(shown, "a 1.5 b\nx\nc 3 and more\n") == ("a 1.5 b\n...\nc 3 ...\n", [])
    assert tour.present(shown, "a 1.5 b\nc\n")[1] == ["c 2 ..."]
    page = "```sh\noptics scenes\n```\n\n```text\nno such line\n```\n" + tour.REAL
    assert [b.missing for b in tour.walk(Path.cwd(), page=page) if b.missing] == [["no such line"]]
