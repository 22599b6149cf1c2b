"""Programs that end early: Ctrl-C at any moment, kill -9 at any moment, two at once. One line and 130, or nothing left
that a later run cannot use."""

import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.slow

# Python ends by the signal while it starts and looks for the program: those first milliseconds are not the program's
BEGUN = "import sys; print('begun', flush=True); from optics.cli import main; sys.exit(main())"
MOMENTS = np.linspace(0.05, 2.5, 12)  # s after the program begins: imports, loading, work, the end
COMMANDS = {
    "render": "render small.xml -o out/x.exr --png",
    "calibrate": "calibrate readings -o out/study",
    "batch": "batch job.toml --workers 1",
    "crew": "batch job.toml --workers 2",
    "diagnose": "diagnose study",
    "report": "report study -o out/page.html",
}


def started(place, words):
    child = subprocess.Popen(
        [sys.executable, "-c", BEGUN, *words.split()],
        cwd=place,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert child.stdout.readline() == "begun\n"
    return child


def left(place):
    """Files that nobody asked for: temporary ones."""
    return [f for f in place.rglob(".*") if f.is_file() and not f.name.startswith(".lock")]


@pytest.mark.parametrize("moment", MOMENTS, ids=lambda m: f"{m:.2f}s")
@pytest.mark.parametrize("name", COMMANDS)
def test_ctrl_c_is_one_line_and_130(place, name, moment):
    (place / "job.toml").write_text((place / "job.toml").read_text().replace("count = 1", "count = 40"))
    child = started(place, COMMANDS[name])
    time.sleep(moment)
    child.send_signal(signal.SIGINT)
    out, err = child.communicate(timeout=60)
    lines = [line for line in err.splitlines() if not line.startswith("warning: ")]
    if child.returncode in (0, 1):  # it was done before
        return
    told = [line for line in lines if line.startswith("interrupted")]
    assert child.returncode == 130 and len(told) == 1 and "Traceback" not in err, (child.returncode, err)
    assert not left(place), left(place)
    if name == "calibrate":
        assert not (place / "out" / "study" / "ladder.json").exists() or (place / "out/study/steps/00-base").is_dir()


@pytest.mark.parametrize("moment", np.linspace(0.3, 3.0, 8), ids=lambda m: f"{m:.2f}s")
def test_a_killed_study_is_whole_absent_or_said_to_be_cut_off(place, met, monkeypatch, moment):
    monkeypatch.chdir(place)
    child = started(place, "calibrate readings -o out/study")
    time.sleep(moment)
    child.kill()
    child.communicate()
    code, said = met("values", "out/study")
    assert code == 0 or "cut off" in said or "is no study" in said, said
    assert met("calibrate", "readings", "-o", "out/study", "--resume")[0] in (0, 1)
    assert met("values", "out/study")[0] == 0


def test_a_killed_batch_goes_on_to_the_same_pixels(place, met, monkeypatch):
    monkeypatch.chdir(place)
    job = (place / "job.toml").read_text().replace("count = 1", "count = 60")
    for out in ("whole", "cut"):
        (place / f"{out}.toml").write_text(job.replace('"out"', f'"{out}"'))
    assert met("batch", "whole.toml", "--workers", "1") == (0, "")
    for moment in (1.2, 1.8, 2.2):
        child = started(place, "batch cut.toml --workers 1")
        time.sleep(moment)
        child.kill()
        child.communicate()
    assert met("batch", "cut.toml", "--workers", "1") == (0, "")
    images = {
        out: {f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in (place / out / "images").iterdir()}
        for out in ("whole", "cut")
    }
    assert len(images["whole"]) == 60 and images["whole"] == images["cut"]


def test_two_adds_at_once_leave_a_readable_study(place, met, monkeypatch):
    monkeypatch.chdir(place)
    effects = ("extinction leak", "stray light", "polarized source", "dark offset")
    begin = "import sys; from optics.cli import main; sys.exit(main())"
    children = [
        subprocess.Popen(
            [sys.executable, "-c", begin, "add", "study", effect],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for effect in effects
    ]
    said = [child.communicate(timeout=120)[1] for child in children]
    assert all(child.returncode in (0, 1, 2) for child in children) and not any("Traceback" in text for text in said)
    assert met("report", "study", "-o", "page.html")[0] == 0
    steps = sorted(p.name for p in Path("study/steps").iterdir())
    assert len(steps) == 1 + sum(child.returncode in (0, 1) for child in children), (steps, said)
