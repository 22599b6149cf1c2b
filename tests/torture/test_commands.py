"""Every command with every fault: hostile values of each option, sizes and counts beyond any use, plugins that fail,
read-only folders. What is refused is refused in one line, before anything is written."""

import itertools
import os
import re
import shutil
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import typer.main
from PIL import Image

from optics.cli import app, main

PLUGIN = """from optics import Effect, Parameter
def f(image, camera):
    return {body}
effect = Effect("odd", "camera", (Parameter("odd", "1", 0.0, (-1, 1), neutral=0.0, plausible=0.1),), {{"{stage}": f}})
"""
COMMANDS = {c.name: c for c in typer.main.get_command(app).commands.values()}
# what each command needs besides; a valid run of it takes at most a second
BASE = {
    "params": "small.xml",
    "scenes": "",
    "effects": "",
    "render": "small.xml -o out/x.exr",
    "batch": "job.toml --workers 1",
    "mueller": "--fit study",
    "sweep": "polarizer_bench",
    "import": "readings -o out/set",
    "design": "small.xml -n 2 --effects lens-vignetting",
    "compare": "readings",
    "calibrate": "readings -o out/study",
    "locate": "images -o out/beads.csv",
    "diagnose": "study",
    "add": "study extinction-leak",
    "report": "study -o out/page.html",
    "values": "study",
    "plot-spectra": "digit -o out/spectra.png",
    "scoreboard": "-o out/board --study study",
    "rehearse": "study",
    "imitate": "study -o out/set",
    "read": "markers images/a.png",
    "export": "made -o out/data --to webdataset",
    "force-tables": "--draws 1",
    "force-features": "beads.toml -o out/features --project --flow sparse --bins 4",
    "force-train": "features.npz -o out/map.npz --kind linear --bins 3",
    "force-test": "map.npz features.npz",
}
TOKENS = ["", "nan", "-1", "1e400", "x" * 3000, "no/such/place", "/dev/null", "\u202e\x07", "*", "=", "a=b", "0"]
NUMBERS = ["-9223372036854775809", "0", "-1", "1e9", "99999999999999999999", "inf", "0x10", "\uff11", "1.5", ""]


def options():
    """(command, option, value): all of them."""
    for name, words in BASE.items():
        for parameter in COMMANDS[name].params:
            option = max(parameter.opts, key=len)
            if (
                option.startswith("--")
                and option not in ("--help", "--browser")
                and not getattr(parameter, "is_flag", 0)
            ):
                number = parameter.bare_type in (int, float)
                for value in NUMBERS if number else TOKENS:
                    yield name, words, option, value


ALL = list(options())


def test_every_command_is_tried():
    assert set(COMMANDS) - set(BASE) <= {"view", "doctor", "demo", "bench", "machine", "proof"}, set(COMMANDS)
    assert len(ALL) > 500


@pytest.mark.slow
@pytest.mark.parametrize("part", range(40))
def test_hostile_options(place, met, monkeypatch, record_property, part):
    """Forty parts of all cases."""
    monkeypatch.chdir(place)
    mine = list(itertools.islice(ALL, part, None, 40))
    record_property("cases", len(mine))
    for name, words, option, value in mine:
        shutil.rmtree(place / "out", ignore_errors=True)
        met(name, *words.split(), f"{option}={value}", seconds=120)


LARGE = {
    "render small.xml -D width=200000 -D height=200000 -o x.exr": "200000 x 200000 pixels; allowed",
    "render small.xml --spp 1000000000000 -o x.exr": "spp = 1000000000000; allowed",
    "render small.xml --spp 1000000 -D width=320 -D height=240 -o x.exr": r"spp = 1000000 of 320 x 240 pixels",
    "batch many.toml": r"1e\+18 samples; allowed: up to",
    "batch grid.toml": r"1e\+15 samples; allowed: up to",
    "design small.xml -n 1000000000": "1000000000 frames; allowed: 2 to 1000",
    "compare png": "200000 x 200000 pixels; allowed",
    "compare npy": r"a\.npy: unreadable",
}


@pytest.mark.slow
@pytest.mark.parametrize("words", LARGE)
def test_sizes_and_counts_beyond_any_use(place, met, monkeypatch, words):
    monkeypatch.chdir(place)
    (place / "many.toml").write_text('scene = "small.xml"\nout = "out"\ncount = 1000000000000000000\n')
    grid = "".join(f'"led_{i}.power" = {{ grid = {list(range(1000))} }}\n' for i in range(1, 6))
    (place / "grid.toml").write_text(f'scene = "small.xml"\nout = "out"\ncount = 1\n[sample]\n{grid}')
    for name in ("png", "npy"):
        shutil.copytree(place / "images", place / name)
        file = place / name / "captures.toml"
        file.write_text(file.read_text().replace("a.png", f"a.{name}"))

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    size = struct.pack(">IIBBBBB", 200000, 200000, 8, 2, 0, 0, 0)
    pixels = chunk(b"IDAT", zlib.compress(bytes(1000)))
    (place / "png" / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", size) + pixels + chunk(b"IEND", b""))
    head = "{'descr': '<f4', 'fortran_order': False, 'shape': (200000, 200000, 3), }".ljust(117) + "\n"
    (place / "npy" / "a.npy").write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + head.encode() + bytes(100))
    code, said = met(*words.split(), seconds=20)
    assert code == 2 and re.search(LARGE[words], said), said


WRONG = {
    "image[:3]": r"gives an array of shape \(3, 16, 3\); allowed: numbers of the shape \(12, 16, 3\)",
    "1 / 0": "ZeroDivisionError: division by zero",
    "None": "gives NoneType; allowed",
    "image * float('nan')": "gives NaN or infinity",
    "'x'": "gives str; allowed",
    "exit()": "SystemExit|gives NoneType|NameError",
}


@pytest.mark.parametrize("body", WRONG)
@pytest.mark.parametrize("stage", ["sensor", *(pytest.param(s, marks=pytest.mark.slow) for s in ("lens", "response"))])
def test_a_plugin_that_fails_is_named(place, met, monkeypatch, body, stage):
    monkeypatch.chdir(place)
    (place / "own").mkdir()
    (place / "own" / "odd.py").write_text(
        PLUGIN.format(body=body.replace("exit()", "exec('raise ValueError(1)')"), stage=stage)
    )
    code, said = met("render", "small.xml", "-o", "x.exr", "--plugins", "own", "--set", "camera.odd=0.1")
    expected = WRONG[body] if body != "exit()" else "ValueError: 1"
    assert code == 2 and re.search(rf"odd\.py: the effect 'odd', stage '{stage}': ({expected})", said), said


def test_a_plugin_that_ends_the_program_is_named(place, met, monkeypatch):
    monkeypatch.chdir(place)
    (place / "odd.py").write_text("import sys\nsys.exit(0)\n")
    code, said = met("render", "small.xml", "-o", "x.exr", "--plugins", "odd.py")
    assert code == 2 and "odd.py: SystemExit" in said


@pytest.mark.slow  # each starts programs of its own
@pytest.mark.skipif(sys.version_info < (3, 11), reason="Python 3.10 looks in the current folder for a spawned worker")
@pytest.mark.parametrize("words", ["batch job.toml --workers 2", "batch job.toml --on ray --workers 1", "doctor"])
def test_modules_in_the_current_folder_do_not_run(place, words):
    """Captures may lie where a command is given: what starts further processes takes no module from there."""
    if "ray" in words:
        pytest.importorskip("ray")
    for name in ("signal", "json", "pickle", "socket", "numpy", "mitsuba", "submitit", "optics"):
        (place / f"{name}.py").write_text(f"open({str(place / 'ran')!r}, 'a').write({name!r})\n")
    program = Path(sys.executable).with_name("optics")
    done = subprocess.run([program, *words.split()], cwd=place, capture_output=True, text=True, timeout=300)
    assert not (place / "ran").exists(), (place / "ran").read_text()
    assert done.returncode in ((0, 1) if words == "doctor" else (0,)), done.stderr


REFUSED = {
    "calibrate readings -o s --free source.power --per-group source.power": "source.power: free for all frames and for",
    "calibrate readings -o s --prior source.power=-5+-1": r"prior source\.power: source\.power = -5 is outside",
    "calibrate readings -o s --per-group analyzer.angle": r"analyzer\.angle: set anew in the readings of a group",
    "sweep polarizer_bench --to=1e400": "--to inf: not finite",
    "calibrate readings -o study --resume --seed 3": "cannot resume, changed since the study began: seed",
    "calibrate readings -o study --resume --robust": "cannot resume, changed since the study began: robust",
    "render small.xml -o x.exr --set gel.press_depth=30": r"the gel is 4 mm thick: gel\.press_depth = 30 mm",
    "batch deep.toml": r"\[sample\]: the gel is 4 mm thick: gel\.press_depth = 30 mm",
    "compare deep": r"frame 0 \('a\.png'\): the gel is 4 mm thick: gel\.press_depth = 30 mm",
    "compare readings --fit misspelt.toml": r"misspelt\.toml: unknown table 'paramters'; did you mean 'parameters'",
    "compare readings --fit doubled.toml": r"doubled\.toml: not valid TOML",
    "sweep polarizer_bench -o a.png --csv a.png": r"a\.png is named for two outputs",
    "import black --circles black/c.csv --ball-radius 3 --mm-per-pixel 0.05 -o s": "a: every value is black; allowed",
    "import white --circles white/c.csv --ball-radius 3 --mm-per-pixel 0.05 -o s": "a: every value is 255 DN; allowed",
    "import images --mosaic 90,45,135,0 --every 3 -o s": "--every: not for a folder of raw frames",
    "compare stock": "stock.*camera",
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_cannot_hold_is_refused(place, met, monkeypatch, words):
    monkeypatch.chdir(place)
    text = (place / "images" / "captures.toml").read_text()
    shutil.copytree(place / "images", place / "deep")
    (place / "deep" / "captures.toml").write_text(text.replace('press_depth" = 0.4', 'press_depth" = 30.0'))
    (place / "deep.toml").write_text(
        'scene = "small.xml"\nout = "out"\ncount = 1\n[sample]\n"gel.press_depth" = { uniform = [0.1, 30.0] }\n'
    )
    (place / "misspelt.toml").write_text('[paramters]\n"source.power" = 1.0\n')
    (place / "doubled.toml").write_text('[parameters]\n"source.power" = 1.0\n"source.power" = 2.0\n')
    for name, level in (("black", 0), ("white", 255)):
        (place / name).mkdir()
        for k, letter in enumerate("abcde"):
            image = np.random.default_rng(k).integers(50, 90, (32, 40, 3)) if k else np.full((32, 40, 3), level)
            Image.fromarray(image.astype(np.uint8)).save(place / name / f"{letter}.png")
        rows = "".join(f"{letter}.png,20,16,5\n" for letter in "abcde")
        (place / name / "c.csv").write_text(f"file,center_x_px,center_y_px,contact_radius_px\n{rows}")
    shutil.copytree(place / "images", place / "stock")
    xml = (place / "small.xml").read_text()
    sensor = re.search(r"<sensor.*?</sensor>", xml, re.DOTALL)[0]
    film = '<film type="hdrfilm"><integer name="width" value="$width"/><integer name="height" value="$height"/></film>'
    (place / "stock" / "small.xml").write_text(
        xml.replace(sensor, f'<sensor type="perspective" id="camera">{film}</sensor>')
    )
    code, said = met(*words.split())
    assert code == 2 and re.search(REFUSED[words], said), said
    assert not (place / "s").exists() and not (place / "x.exr").exists()


@pytest.mark.parametrize(
    ("level", "code", "said"),
    [
        (0, 2, "far below what it has without light"),
        (255, 2, "frame 1 ('b.png'): all saturated"),
        (128, 0, "1 of 2 images hold one value everywhere, such as 'b', where every value is 128 DN"),
    ],
)
def test_images_without_shading_are_named(place, capsys, monkeypatch, level, code, said):
    monkeypatch.chdir(place)
    for name in "bc":  # c repeats b
        Image.fromarray(np.full((12, 16, 3), level, np.uint8)).save(place / "images" / f"{name}.png")
    assert main(["compare", "images"]) == code
    assert said in capsys.readouterr().err


def test_copies_of_an_image_are_named(place, capsys, monkeypatch):
    monkeypatch.chdir(place)
    (place / "images" / "b.png").write_bytes((place / "images" / "a.png").read_bytes())
    file = place / "images" / "captures.toml"
    file.write_text(file.read_text().replace('repeats = ["c.png"]\n', ""))
    assert main(["compare", "images"]) == 0
    assert "1 of 2 images are identical to another one ('b' to 'a')" in capsys.readouterr().err


def test_tables_of_circles_name_images_of_their_folder(place, met, monkeypatch):
    monkeypatch.chdir(place)
    rng = np.random.default_rng(0)
    (place / "presses" / "more").mkdir(parents=True)
    names = ["a.png", "b.png", "more/a.png", "c.png", "d.png"]
    for name in names:
        Image.fromarray(rng.integers(90, 110, (24, 32, 3)).astype(np.uint8)).save(place / "presses" / name)
    shutil.copy(place / "presses" / "a.png", place / "other.png")
    words = "import presses --circles c.csv --ball-radius 2 --mm-per-pixel 0.1 -o set"
    for last, code in (("../other.png", 2), (str(place / "other.png"), 2), ("d.png", 0)):
        rows = "".join(f"{name},16,12,4\n" for name in (*names[:4], last))
        (place / "c.csv").write_text("file,center_x_px,center_y_px,contact_radius_px\n" + rows)
        found, said = met(*words.split())
        assert found == code and (code == 0 or f"'{last}' lies outside presses" in said), said
    frames = sorted((place / "set" / "frames").iterdir())
    assert len(frames) == 5 and len({f.read_bytes() for f in frames}) == 5  # two of them are called 'a'


@pytest.mark.slow
def test_a_tactile_scene_takes_a_stock_camera(place, met, monkeypatch):
    monkeypatch.chdir(place)
    xml = (place / "small.xml").read_text()
    sensor = re.search(r"<sensor.*?</sensor>", xml, re.DOTALL)[0]
    look = re.search(r"<transform.*?</transform>", sensor, re.DOTALL)[0]
    film = '<film type="hdrfilm"><integer name="width" value="$width"/><integer name="height" value="$height"/></film>'
    (place / "stock.xml").write_text(
        xml.replace(
            sensor, f'<sensor type="perspective" id="camera"><float name="fov" value="41"/>{look}{film}</sensor>'
        )
    )
    assert met("render", "stock.xml", "-o", "x.exr", "--png", "--spp", "16") == (0, "")
    assert np.asarray(Image.open("x.png")).std() > 1


def test_marks_and_line_ends_of_other_systems_are_read(place, met, monkeypatch):
    monkeypatch.chdir(place)
    for file in (*(place / n / "captures.toml" for n in ("images", "readings")), place / "readings" / "readings.csv"):
        file.write_bytes(b"\xef\xbb\xbf" + file.read_text().replace("\n", "\r\n").encode())
    job = (place / "job.toml").read_text()
    (place / "job.toml").write_bytes(b"\xef\xbb\xbf" + job.replace("\n", "\r\n").encode())
    for words in ("compare images", "compare readings", "batch job.toml --workers 1"):
        assert met(*words.split()) == (0, ""), words


WRITING = [
    "render small.xml -o out/x.exr",
    "batch job.toml --workers 1",
    "calibrate readings -o out/study",
    "compare readings -o out/numbers",
    "design small.xml -n 2 -o out/plan",
    "report study -o out/page.html",
    "diagnose study",
    "add study extinction-leak",
    "effects new ripple -o out/own",
    "effects new ripple --from study --along signal",
]


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() == 0 and not shutil.which("setpriv"), reason="root may write everywhere")
@pytest.mark.parametrize("words", WRITING)
def test_a_read_only_folder(place, words):
    """As somebody who may not write: one line, which names the place."""
    user = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups"] if os.geteuid() == 0 else []
    for folder, _, files in os.walk(place):
        os.chmod(folder, 0o555)
        for file in files:
            os.chmod(os.path.join(folder, file), 0o444)
    for folder in place.parents[:3]:
        os.chmod(folder, 0o755)
    home = {"HOME": "/nonexistent", "XDG_CONFIG_HOME": "/nonexistent", "XDG_CACHE_HOME": "/nonexistent"}
    done = subprocess.run(
        [*user, sys.executable, "-m", "optics.cli", *words.split()],
        cwd=place, capture_output=True, text=True, timeout=120, env={**os.environ, **home},
    )  # fmt: skip
    lines = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert done.returncode == 2 and len(lines) == 1 and "Traceback" not in done.stderr, done.stderr
    assert re.search(r"cannot be written to|Permission denied|part of|no part", lines[0]), lines
    for folder, _, _ in os.walk(place):
        os.chmod(folder, 0o755)
