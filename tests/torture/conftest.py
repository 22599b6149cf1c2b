"""Hostile input by the hundred: `make torture` tries all of it, the usual run a small part.

What may happen is the same everywhere (`met`): the command works, or it ends with one line that says what is wrong.
A case is one hostile input: an example of hypothesis, a value of an option, or else a test. The summary counts them."""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import signal

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings
from PIL import Image

LIMIT = 60  # s of the processor: nothing here takes longer than a second or two; what does, hangs
BUSY = 10
COMMON = {
    "deadline": None,
    "derandomize": True,  # the same cases in every run: a failure can be looked at
    "database": None,
    "phases": [Phase.explicit, Phase.generate],  # a case is a command: shrinking it takes minutes and tells little
    "suppress_health_check": list(HealthCheck),
}
settings.register_profile("few", max_examples=6, **COMMON)
settings.register_profile("torture", max_examples=100, **COMMON)
settings.load_profile("torture" if os.environ.get("OPTICS_TORTURE") else "few")

NOISE = "[noise]\nsystem_gain = 0.05\ndark_noise = 1.0\nblack_level = 8.0\nsaturation = 255.0\nprnu = 0.0\n"
IMAGES = f"""scene = "small.xml"
values_are = "DN"
{NOISE}[parameters]
"camera.exposure" = 100.0
[uncertainty]
"gel.press_x" = 0.1
[exclude]
"gain drift" = "fixed"
[[frames]]
image = "a.png"
mask = "mask.png"
group = "one"
[frames.parameters]
"led_1.power" = 1.0
"gel.press_depth" = 0.4
[[frames]]
image = "b.png"
group = "two"
repeats = ["c.png"]
[frames.parameters]
"gel.press_x" = 1.0
"gel.press_depth" = 0.3
"""
READINGS = """scene = "polarizer_bench"
absent = ["sample", "middle"]
bands = [540]
[noise]
dark_noise = 0.5
[parameters]
"polarizer.angle" = 0.0
[uncertainty]
"analyzer.angle" = 0.0
"polarizer.angle" = 0.0
[table]
file = "readings.csv"
values = ["volts"]
delimiter = ";"
decimal = ","
skip = 1
group = "run"
rename = { "angle" = "analyzer.angle" }
scale = { "volts" = 100.0 }
offset = { "volts" = 1.5 }
"""
JOB = """scene = "small.xml"
out = "out"
count = 1
seed = 3
lights = "together"
outputs = ["png"]
[parameters]
"gel.press_depth" = 0.4
[sample]
"gel.press_x" = { uniform = [-1.0, 1.0] }
"led_1.power" = { choice = [0.5, 1.0] }
"""
BEADS = """scene = "particle_gel"
out = "beads"
count = 12
outputs = ["png"]
[defines]
width = 24
height = 24
beads = 60
detail = 1
[parameters]
"gel.press_depth" = 0.8
[sample]
"gel.press_x" = { uniform = [-9.0, 9.0] }
"""


BOARDS = {
    "kicad": 'Ref,Val,Package,PosX,PosY,Rot,Side\n"D1","LED","0603",12.5000,-3.2500,90.0000,top\n',
    "ascii": "## Unit = mm, Angle = deg.\n# Ref     Val   PosX       PosY\nD1        LED   12.5       -3.25\n## End\n",
    "altium": "Units used: mil\n\nDesignator\tLayer\tMid X\tMid Y\nD1\tTop\t12.5mm\t-3.25mm\nD2\tTop\t100\t2\n",
    "easyeda": "Designator;Mid X(mil);Mid Y(mil)\nD1;492.126;-127,953\n",
}
BALLS = {(i, j): (40.0 + 24 * i, 36.0 + 24 * j) for i in range(3) for j in range(2)}  # px in images of 128 x 96 px


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """Count the examples that hypothesis hands to a test."""
    handle = getattr(item.obj, "hypothesis", None)
    if handle is None:
        return (yield)
    inner, tried = handle.inner_test, 0

    @functools.wraps(inner)
    def counted(*arguments, **named):
        nonlocal tried
        tried += 1
        return inner(*arguments, **named)

    handle.inner_test = counted
    try:
        return (yield)
    finally:
        handle.inner_test = inner
        item.user_properties.append(("cases", tried))


def pytest_terminal_summary(terminalreporter):
    """Say how many cases were tried; one test is one case where it does not say otherwise."""
    kinds = {kind: terminalreporter.getreports(kind) for kind in ("passed", "failed")}
    tried = {
        kind: sum(dict(report.user_properties).get("cases", 1) for report in reports if report.when == "call")
        for kind, reports in kinds.items()
    }
    failed = len(kinds["failed"])
    terminalreporter.write_line(f"{sum(tried.values())} hostile cases tried, {failed} tests failed")


@contextlib.contextmanager
def within(seconds: int = LIMIT):
    """Fail, and do not wait, where something hangs: after so many seconds of the processor, or BUSY times as long where
    it does nothing, or the machine does other things."""

    def late(*_):
        raise AssertionError(f"still busy after {seconds} s")

    timers = {signal.ITIMER_PROF: (signal.SIGPROF, seconds), signal.ITIMER_REAL: (signal.SIGALRM, BUSY * seconds)}
    before = {sent: signal.signal(sent, late) for sent, _ in timers.values()}
    for timer, (_, most) in timers.items():
        signal.setitimer(timer, most)
    try:
        yield
    finally:
        for timer in timers:
            signal.setitimer(timer, 0)
        for sent, handler in before.items():
            signal.signal(sent, handler)


@pytest.fixture(scope="session")
def material(tmp_path_factory, mitsuba):
    """Good input of every kind: captures of images and of readings, a scene, a job, a finished batch, a study of
    readings."""
    import optics as package
    from optics.readers import force_learning
    from optics.scene import loader
    from optics.study import batch

    folder = tmp_path_factory.mktemp("torture")
    rng = np.random.default_rng(0)
    text = loader.find("gelsight").read_text(encoding="utf-8")
    for name, old, new in (("width", 320, 16), ("height", 240, 12)):
        text = text.replace(f'name="{name}" value="{old}"', f'name="{name}" value="{new}"')
    images = folder / "images"
    images.mkdir()
    for place in (folder, images):
        (place / "small.xml").write_text(text, encoding="utf-8")
    for name in "abc":
        Image.fromarray(rng.integers(60, 70, (12, 16, 3)).astype(np.uint8)).save(images / f"{name}.png")
    Image.fromarray(np.full((12, 16), 255, np.uint8)).save(images / "mask.png")
    (images / "captures.toml").write_text(IMAGES)
    (images / "import.json").write_text('{"setup": {"free": ["led_1.power"], "priors": {"led_1.power": [1.0, 0.3]}}}')
    readings = folder / "readings"
    readings.mkdir()
    rows = [
        f"{a},0;{np.cos(np.radians(a)) ** 2 + rng.normal(0, 0.005):.5f}".replace(".", ",") for a in range(0, 180, 6)
    ]
    lines = [f"{row};r{i % 5}" for i, row in enumerate(rows)]
    (readings / "readings.csv").write_text("Bench 3\nangle;volts;run\n" + "\n".join(lines) + "\n")
    (readings / "captures.toml").write_text(READINGS)
    _boards(folder)
    _scans(folder / "scans", rng)
    (folder / "job.toml").write_text(JOB)
    (folder / "beads.toml").write_text(BEADS)
    (folder / "made.toml").write_text(JOB.replace('out = "out"\ncount = 1', 'out = "made"\ncount = 3'))
    batch.run(folder / "made.toml", workers=1)
    place, force = rng.uniform(-14, 14, (40, 2)), rng.uniform(0.1, 1.0, 40)
    motion = rng.normal(size=(40, 4, 4, 2))
    sizes = np.hypot(*np.moveaxis(motion, -1, 0)), np.arctan2(motion[..., 1], motion[..., 0])
    pressed = force_learning.FeatureSet(motion, *sizes, place, force, (30.0, 30.0), "dense")
    pressed.write(folder / "features.npz")
    force_learning.linear(pressed, 3).write(folder / "map.npz")
    package.calibrate(readings, folder / "study")
    package.Study.open(folder / "study").diagnose(advised=False)
    return folder


def _boards(folder):
    """A small bench whose first LED stands where FILE says, and files of four programs."""
    from optics.scene import loader

    text = loader.find("gelsight_bench").read_text(encoding="utf-8").replace('value="320"', 'value="16"')
    text = text.replace('value="240"', 'value="12"')
    start, end = text.index('<emitter type="led" id="led_1">'), text.index('<emitter type="led" id="led_2">')
    led = '<string name="board" value="ring"/><string name="placed" value="FILE:D1"/>'
    led = f'<emitter type="led" id="led_1">{led}</emitter>'
    (folder / "board.xml").write_text(f"{text[:start]}{led}{text[end:]}", encoding="utf-8")
    for kind, table in BOARDS.items():
        (folder / f"{kind}.csv").write_text(table)


def _scans(folder, rng):
    """A plate of balls under three LEDs, and the flat field."""
    import yaml

    y, x = np.mgrid[:96, :128]
    for name, balls in (("one", BALLS), ("flat", {})):
        (folder / name).mkdir(parents=True)
        for label, turn in (("07", 0.0), ("08", 2.1), ("09", 4.2)):
            shade = 100.0 + rng.normal(0, 1.5, x.shape)
            for u, v in balls.values():
                near = np.hypot(x - u, y - v) < 7
                shade[near] += 6 * ((x - u) * np.cos(turn) + (y - v) * np.sin(turn))[near]
            Image.fromarray(np.round(shade).astype(np.uint8)).save(folder / name / f"image{label}.png")
        circles = [{"type": "GridCircle", "gx": i, "gy": j, "x": u, "y": v} for (i, j), (u, v) in balls.items()]
        table = {"images": [f"image{label}.png" for label in ("07", "08", "09")], "annotations": circles}
        sizes = {"calibradius": 0.4, "calibspacing": 1.2, "mmperpixel": 0.05}
        (folder / name / "scan.yaml").write_text(yaml.safe_dump(table | (sizes if balls else {})))


@pytest.fixture
def place(material, tmp_path):
    """A copy of the good input, which a test may spoil."""
    return shutil.copytree(material, tmp_path / "place")


@pytest.fixture
def met(capsys):
    """Run a command line; fails unless it works or is refused in one line: no traceback, no hang, no other code."""
    from optics.cli import main

    def run(*words, seconds: int = LIMIT) -> tuple[int, str]:
        capsys.readouterr()
        with within(seconds):
            code = main([str(w) for w in words])
        said = capsys.readouterr()
        told = [line for line in said.err.splitlines() if line.startswith("error: ")]
        assert code in (0, 1, 2), (words, code, said.err)
        assert "Traceback" not in said.err and "(a bug" not in said.err, (words, said.err)
        assert code != 2 or len(told) == 1, (words, said.err)
        assert code != 2 or len(told[0]) > len("error: ") + 8, (words, said.err)
        return code, told[0] if told else ""

    return run
