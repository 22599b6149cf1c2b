"""Programs that end early: Ctrl-C at any moment, kill -9 at any moment, two at once. One line and 130, or nothing left
that a later run cannot use."""

import contextlib
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.slow

LIMIT, BUSY = 60, 10  # s of the processor, and how many times as long at most where others have it
MOMENTS = np.linspace(0.03, 1.05, 12)  # of the whole run: imports, loading, work, the end, and beyond
COMMANDS = {
    "render": "render small.xml -o out/x.exr --png",
    "calibrate": "calibrate readings -o out/study",
    "batch": "batch job.toml --workers 1",
    "crew": "batch job.toml --workers 2",
    "diagnose": "diagnose study",
    "report": "report study -o out/page.html",
}


def _spent(pid: int) -> tuple[float, bool]:
    """(s of the processor that a process has used with all it started, whether any of them wants it now)."""
    try:
        state, *fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        below = [int(p) for f in Path(f"/proc/{pid}/task").glob("*/children") for p in f.read_text().split()]
    except OSError:  # it ended
        return 0.0, False
    own = sum(map(int, fields[10:14])) / os.sysconf("SC_CLK_TCK")  # and of those that ended
    used, wanted = zip((own, state in "RD"), *map(_spent, below))
    return sum(used), any(wanted)


class Child:
    """A command in a process of its own, whose time is that of the processor: on a busy machine it comes as far."""

    # Python ends by the signal while it starts and looks for the program: those milliseconds are not the program's
    BEGUN = "import sys, optics; print('begun', flush=True); from optics.cli import main; sys.exit(main())"

    def __init__(self, place, words):
        self.process = subprocess.Popen(
            [sys.executable, "-c", self.BEGUN, *words.split()],
            cwd=place,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
        assert self.process.stdout.readline() == "begun\n"
        self.begun = _spent(self.process.pid)[0]

    @property
    def spent(self) -> float:
        """s of the processor since it has begun, with all that it started."""
        return _spent(self.process.pid)[0] - self.begun

    def wait_until(self, moment: float) -> None:
        """Until it has used so many seconds, or has ended."""
        while self.process.poll() is None and self.spent < moment:
            time.sleep(0.005)

    def end(self, seconds: int = LIMIT) -> tuple[int, str, str, float]:
        """(exit code, stdout, stderr, s of the processor since it has begun). Fails where it hangs: uses so many
        seconds more, or nothing of it wants the processor for as long, or it takes BUSY times as long."""
        start, since, last = time.monotonic(), time.monotonic(), self.spent
        first = used = last
        while True:
            try:
                out, err = self.process.communicate(timeout=0.2)
                return self.process.returncode, out, err, used
            except subprocess.TimeoutExpired:
                pass
            used, wants = (v - self.begun if k == 0 else v for k, v in enumerate(_spent(self.process.pid)))
            now = time.monotonic()
            if wants or used > last:
                since, last = now, used
            if used - first > seconds or now - since > seconds or now - start > BUSY * seconds:
                self.process.kill()
                raise AssertionError(
                    f"still there after {used - first:.0f} s of the processor, {now - start:.0f} s in all"
                )


@pytest.fixture
def start(place):
    """Start a command in the place; none outlives its test."""
    with contextlib.ExitStack() as all_of_them:

        def begin(words: str) -> Child:
            child = Child(place, words)
            all_of_them.enter_context(child.process)  # waits, and closes its pipes
            all_of_them.callback(child.process.kill)
            return child

        yield begin


@pytest.fixture(scope="module")
def whole(material, tmp_path_factory):
    """Seconds of the processor that a command takes undisturbed, measured once."""
    known = {}

    def seconds(words):
        if words not in known:
            place = shutil.copytree(material, tmp_path_factory.mktemp("whole") / "place")
            many(place)
            child = Child(place, words)
            with child.process:
                code, _, err, known[words] = child.end()
            assert code in (0, 1), err
        return known[words]

    return seconds


def many(place):
    """A job of forty samples, which takes as long as the other commands."""
    (place / "job.toml").write_text((place / "job.toml").read_text().replace("count = 1", "count = 40"))


def left(place):
    """Files that nobody asked for: temporary ones."""
    return [f for f in place.rglob(".*") if f.is_file() and not f.name.startswith(".lock")]


@pytest.mark.parametrize("moment", MOMENTS, ids=lambda m: f"{m:.2f}")
@pytest.mark.parametrize("name", COMMANDS)
def test_ctrl_c_is_one_line_and_130(place, start, whole, name, moment):
    many(place)
    moment *= whole(COMMANDS[name])
    child = start(COMMANDS[name])
    child.wait_until(moment)
    child.process.send_signal(signal.SIGINT)
    code, _, err, _ = child.end()
    lines = [line for line in err.splitlines() if not line.startswith("warning: ")]
    if code in (0, 1):  # it was done before
        return
    told = [line for line in lines if line.startswith("interrupted")]
    assert code == 130 and len(told) == 1 and "Traceback" not in err, (code, err)
    assert not left(place), left(place)
    if name == "calibrate":
        assert not (place / "out" / "study" / "ladder.json").exists() or (place / "out/study/steps/00-base").is_dir()


@pytest.mark.parametrize("then", ["None | object()", "show('work', 1, 2)"])
def test_ctrl_c_that_a_package_swallows(then):
    """trimesh catches all where it imports its own parts, and goes on with what it lacks; or the work goes on."""
    program = f"""
import os, signal, sys, time
from optics.cli import main, terminal
from optics.scene import loader

def imports():
    with terminal.progress() as show:
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5)
        except BaseException:
            pass
        {then}
    return []

loader.shipped_scenes = imports
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
sys.argv = ["optics", "scenes"]
sys.exit(main())
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr, done.stdout) == (130, "interrupted\n", "")


def test_ctrl_c_waits_while_an_enumeration_is_made():
    """An exception there would end the program by SIGABRT."""
    program = """
import enum, signal, sys, time
from types import SimpleNamespace
from optics.cli import terminal
terminal.stop(signal.SIGINT, SimpleNamespace(f_code=SimpleNamespace(co_filename=enum.__file__)))
try:
    time.sleep(20)
except KeyboardInterrupt:
    sys.exit(7)
"""
    assert subprocess.run([sys.executable, "-c", program], timeout=120).returncode == 7


@pytest.mark.parametrize("moment", np.linspace(0.1, 1.0, 8), ids=lambda m: f"{m:.2f}")
def test_a_killed_study_is_whole_absent_or_said_to_be_cut_off(place, met, start, whole, monkeypatch, moment):
    monkeypatch.chdir(place)
    moment *= whole("calibrate readings -o out/study")
    child = start("calibrate readings -o out/study")
    child.wait_until(moment)
    child.process.kill()
    child.end()
    code, said = met("values", "out/study")
    assert code == 0 or "interrupted" in said or "cut off" in said or "is no study" in said, said
    assert met("calibrate", "readings", "-o", "out/study", "--resume")[0] in (0, 1)
    assert met("values", "out/study")[0] == 0


def test_a_killed_batch_goes_on_to_the_same_pixels(place, met, start, monkeypatch):
    """Killed after the first sample, and twice later on."""
    monkeypatch.chdir(place)
    job = (place / "job.toml").read_text().replace("count = 1", "count = 60")
    for out in ("whole", "cut"):
        (place / f"{out}.toml").write_text(job.replace('"out"', f'"{out}"'))
    assert met("batch", "whole.toml", "--workers", "1") == (0, "")
    codes = []
    for made in (1, 5, 20):
        child = start("batch cut.toml --workers 1")
        while len([*(place / "cut" / "images").glob("[0-9]*.png")]) < made and child.process.poll() is None:
            time.sleep(0.002)
        child.process.kill()
        codes.append(child.end()[0])
    assert codes[0] == -signal.SIGKILL and set(codes) <= {0, -signal.SIGKILL}, codes
    assert met("batch", "cut.toml", "--workers", "1") == (0, "")
    images = {
        out: {f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in (place / out / "images").iterdir()}
        for out in ("whole", "cut")
    }
    assert len(images["whole"]) == 60 and images["whole"] == images["cut"]


def test_two_adds_at_once_leave_a_readable_study(place, met, start, monkeypatch):
    monkeypatch.chdir(place)
    effects = ("extinction-leak", "stray-light", "polarized-source", "dark-offset")
    children = [start(f"add study {effect}") for effect in effects]
    ends = [child.end(120) for child in children]
    assert all(code in (0, 1, 2) for code, *_ in ends) and not any("Traceback" in err for _, _, err, _ in ends)
    assert met("report", "study", "-o", "page.html")[0] == 0
    steps = sorted(p.name for p in Path("study/steps").iterdir())
    assert len(steps) == 1 + sum(code in (0, 1) for code, *_ in ends), (steps, ends)
