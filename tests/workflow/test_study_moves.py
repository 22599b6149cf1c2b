"""A study goes on wherever it and its inputs lie, whoever installed the program. One process writes it at a time. What
is damaged or cut off is named."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import optics as package
from optics.errors import BadCapture, OutputExists
from optics.files import output
from optics.scene import loader, trust
from optics.study import loop, places
from optics.study.record import Record

TEXT = """scene = "{scene}"
absent = ["sample", "middle"]
[noise]
dark_noise = 0.5
[parameters]
"polarizer.angle" = 0.0
[uncertainty]
"analyzer.angle" = 0.0
"polarizer.angle" = 0.0
[table]
file = "readings.csv"
values = ["reading"]
group = "run"
"""


@pytest.fixture(scope="module")
def project(tmp_path_factory, mitsuba):
    """A project folder: a scene of its own beside captures, and a study of them, begun from inside the folder."""
    folder = tmp_path_factory.mktemp("moves") / "project"
    captures = folder / "captures"
    captures.mkdir(parents=True)
    shutil.copy(loader.find("polarizer_bench"), folder / "bench.xml")
    rng, rows = np.random.default_rng(3), ["analyzer.angle,reading,run"]
    for run in range(4):
        for a in np.arange(0.0, 180.0, 7.5):
            rows.append(f"{a},{100 * (0.99 * np.cos(np.radians(a)) ** 2 + 0.01) + rng.normal(0, 0.5):.3f},r{run}")
    (captures / "captures.toml").write_text(TEXT.format(scene="../bench.xml"))
    (captures / "readings.csv").write_text("\n".join(rows) + "\n")
    package.calibrate(captures, folder / "study")
    return folder


@pytest.fixture
def moved(project, tmp_path):
    """A copy of the project elsewhere; the first one is gone while it is used."""
    shutil.copytree(project, tmp_path / "other" / "name")
    hidden = project.with_name("hidden")
    project.rename(hidden)
    yield tmp_path / "other" / "name"
    hidden.rename(project)


def test_a_moved_project_goes_on(moved, optics, monkeypatch):
    monkeypatch.chdir(moved / "captures")  # and from any directory
    code, said, error = optics("add", "../study", "extinction leak")
    assert code == 0, error
    assert optics("report", "../study")[0] == 0
    assert optics("compare", ".", "--fit", "../study")[0] == 0
    assert optics("render", "--fit", "../study", "-o", "../x.exr")[0] == 0
    assert optics("calibrate", ".", "-o", "../study", "--resume")[0] == 0
    names = json.loads((moved / "study" / "ladder.json").read_text())["inputs"]
    assert not [name for name in names if Path(name).is_absolute()]


def test_a_study_without_its_captures_says_where_it_looked(moved, tmp_path, optics):
    (moved / "captures").rename(tmp_path / "readings")
    code, _, said = optics("add", moved / "study", "extinction leak")
    assert code == 2 and "its captures are gone" in said and "--captures DIR" in said
    (tmp_path / "bench.xml").write_bytes((moved / "bench.xml").read_bytes())
    assert optics("add", moved / "study", "extinction leak", "--captures", tmp_path / "readings")[0] == 0
    (tmp_path / "readings" / "readings.csv").write_text("analyzer.angle,reading,run\n0,1,a\n")
    code, _, said = optics("diagnose", moved / "study", "--captures", tmp_path / "readings")
    assert code == 2 and "changed since the study began: captures/readings.csv" in said


def test_what_is_not_determined_is_told_so(project, tmp_path, optics):
    """Records write an infinite standard deviation as a word."""
    study = shutil.copytree(project / "study", tmp_path / "study")
    file = study / "steps" / "00-base" / "step.json"
    step = json.loads(file.read_text())
    step["variables"][0]["sd"] = "inf"
    file.write_text(json.dumps(step))
    code, said, error = optics("values", study)
    assert code == 0 and "undetermined" in said, error


def test_what_is_no_input_may_change(moved, optics):
    (moved / "captures" / "notes.txt").write_text("a remark")
    assert optics("add", moved / "study", "extinction leak")[0] == 0
    (moved / "bench.xml").write_text((moved / "bench.xml").read_text() + "<!-- -->")
    code, _, said = optics("diagnose", moved / "study")
    assert code == 2 and "changed since the study began: scene/bench.xml" in said


def test_a_record_of_an_earlier_version_is_read(project, tmp_path):
    """Earlier versions recorded absolute paths: of the captures, of the scene, of every plugin where it shipped."""
    shutil.copytree(project, tmp_path / "p")
    file = tmp_path / "p" / "study" / "ladder.json"
    record = json.loads(file.read_text())
    captures = record["facts"]["setup"]["captures"]
    shipped = {
        f"/opt/a/checkout/plugins/{name.removeprefix(places.SHIPPED)}": digest
        for name, digest in record["inputs"].items()
        if name.startswith(places.SHIPPED)
    }
    own = {f"{captures}/{n}": record["inputs"][f"captures/{n}"] for n in ("captures.toml", "readings.csv")}
    record["inputs"] = {**shipped, **own, f"{project}/bench.xml": record["inputs"]["scene/bench.xml"]}
    del record["near"], record["drafts"], record["facts"]["setup"]["outside"]
    file.write_text(json.dumps(record))
    found, _, _ = loop.take_up(tmp_path / "p" / "study")
    assert len(shipped) > 50
    record["inputs"][next(iter(shipped))] = "sha256:0"
    file.write_text(json.dumps(record))
    with pytest.raises(BadCapture, match="changed since the study began: plugins/"):
        loop.take_up(tmp_path / "p" / "study")


def test_a_plugin_is_found_by_its_content(project, tmp_path, monkeypatch):
    monkeypatch.setattr(trust, "_agreed", set())
    shutil.copytree(project, tmp_path / "p")
    own = tmp_path / "p" / "own"
    own.mkdir()
    (own / "ring.py").write_text(
        "'''Ring.'''\nfrom optics import Effect, Parameter\n"
        "effect = Effect('ring', 'camera', (Parameter('ring', '1', 0.0, (-1, 1), neutral=0.0, plausible=0.01),),\n"
        "    {'sensor': lambda image, camera: image * (1 + camera.ring)})\n"
    )
    package.calibrate(tmp_path / "p" / "captures", tmp_path / "p" / "second", plugins=own)
    (tmp_path / "p").rename(tmp_path / "q")
    study = package.Study.open(tmp_path / "q" / "second")
    assert "ring" in study.model.scene.registry.effects
    assert "ring" in package.load(fit=study.folder).registry.effects
    shutil.rmtree(tmp_path / "q" / "own")
    with pytest.raises(BadCapture, match="own/ring.py"):
        loop.take_up(tmp_path / "q" / "second")
    with pytest.raises(FileNotFoundError, match="--plugins DIR"):
        package.load(fit=study.folder)


# -- two at once -----------------------------------------------------------------------------------------------------
def test_two_at_once_leave_a_readable_study(project, tmp_path, optics):
    shutil.copytree(project, tmp_path / "p")
    study = tmp_path / "p" / "study"
    first, second = (package.Study.open(study) for _ in range(2))
    assert first.model and second.fit
    with first.record.alone():
        code, _, said = optics("add", study, "extinction leak")
        assert code == 2 and "another process works on this study" in said
        assert optics("report", study)[0] == 0  # reading is free
    first.add("extinction leak")
    with pytest.raises(OutputExists, match="another process has added a step since"):
        second.add("stray light")
    assert [s["name"] for s in Record.open(study).steps] == ["base", "extinction leak"]


def test_a_killed_process_leaves_no_lock(project, tmp_path):
    shutil.copytree(project, tmp_path / "p")
    study = tmp_path / "p" / "study"
    hold = (
        "import sys, time\nfrom optics.study.record import Record\n"
        "with Record.open(sys.argv[1]).alone():\n    print('held', flush=True)\n    time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", hold, study], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout.readline() == "held\n"
        with pytest.raises(OutputExists, match="another process"), Record.open(study).alone():
            pass
        child.kill()
    with Record.open(study).alone():
        pass


# -- damage ----------------------------------------------------------------------------------------------------------
def test_a_fit_that_was_cut_off_is_refused_wherever_it_was_cut(project, tmp_path):
    text = (project / "study" / "steps" / "00-base" / "fit.toml").read_text()
    cut = tmp_path / "fit.toml"
    for size in [*range(0, len(text) - 1, 97), len(text) - 2]:  # the last byte is the end of the line
        cut.write_text(text[:size])
        with pytest.raises(ValueError, match=r"fit\.toml: (cut off|not valid TOML)"):
            package.load(fit=cut)
    cut.write_text(text)
    assert package.load(fit=cut, scene=project / "bench.xml")
    cut.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())  # as some editors save it
    assert package.load(fit=cut, scene=project / "bench.xml")


@pytest.mark.parametrize(
    "name", ["ladder.json", "step.json", "metrics.json", "fit.toml", "images/maps.npz", "images/frame-00.npz"]
)
def test_a_damaged_file_of_a_study_is_named(project, tmp_path, optics, name):
    study = tmp_path / "study"
    shutil.copytree(project / "study", study)
    file = next(f for f in (study / name, study / "steps" / "00-base" / name) if f.exists() or f.parent.name != "study")
    if not file.exists():
        pytest.skip("readings have no such file")
    data = file.read_bytes()
    for broken in (data[: len(data) // 2], b"", b"[1]", b"\0" * 64):
        file.write_bytes(broken)
        for words in (("report", study, "--force"), ("render", "--fit", study, "-o", tmp_path / "x.exr", "--force")):
            code, _, said = optics(*words)
            lines = [line for line in said.splitlines() if not line.startswith("warning")]
            assert code == 0 or (code == 2 and len(lines) == 1 and "Traceback" not in said), said
            if words[0] == "report" and name not in ("fit.toml", "images/maps.npz"):
                assert code == 2 and (name in said or "steps" in said or "ladder.json" in said), said


def test_nothing_writes_over_a_record(project, tmp_path, optics):
    shutil.copytree(project, tmp_path / "p")
    study = tmp_path / "p" / "study"
    before = {f: f.read_bytes() for f in study.rglob("*") if f.is_file() and f.name != ".lock"}
    record, step = study / "ladder.json", study / "steps" / "00-base" / "step.json"
    for words in (
        ("report", study, "-o", record, "--force"),
        ("diagnose", study, "--csv", step),
        ("render", "gelsight", "-o", step.with_suffix(".exr"), "--force"),
        ("import", tmp_path / "p" / "captures", "--circles", "x", "-o", study, "--force"),
        ("calibrate", tmp_path / "p" / "captures", "-o", study),
        ("imitate", study, "-o", study),
        ("compare", tmp_path / "p" / "captures", "-o", study),
    ):
        code, _, said = optics(*words)
        assert code == 2, (words, said)
    assert before == {f: f.read_bytes() for f in study.rglob("*") if f.is_file() and f.name != ".lock"}


# -- a full disk -----------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits of file sizes end processes elsewhere")
@pytest.mark.parametrize(
    "words",
    [
        "calibrate captures -o new",
        pytest.param("report study", marks=pytest.mark.slow),
        "render gelsight -D width=64 -D height=48 -o x.exr --png",
        pytest.param("compare captures -o out", marks=pytest.mark.slow),
    ],
)
def test_a_full_disk_leaves_nothing_and_names_the_file(project, tmp_path, words):
    """A limit of 2 KiB on the size of files stands for the disk: writing fails in the middle of a file."""
    shutil.copytree(project, tmp_path / "p")
    before = {str(f) for f in (tmp_path / "p").rglob("*")}
    limited = (
        "import resource, sys\n"
        "from optics.cli import main\nfrom optics.doctor import require_llvm\nrequire_llvm()\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (2048, 2048))\nsys.exit(main(sys.argv[1:]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", limited, *words.split()],
        cwd=tmp_path / "p",
        capture_output=True,
        text=True,
    )
    # Dr.Jit says by itself that it cannot keep a compiled kernel
    lines = [line for line in done.stderr.splitlines() if not line.startswith(("warning", "jit_"))]
    assert done.returncode == 2 and len(lines) == 1, done.stderr
    assert str(tmp_path / "p") in lines[0] or any(w in lines[0] for w in ("x.json", "report.html", "new", "out")), lines
    assert {str(f) for f in (tmp_path / "p").rglob("*")} - before <= {str(tmp_path / "p" / "study" / ".lock")}


@pytest.mark.parametrize("words", ["calibrate captures -o new", "add study extinction-leak"])
def test_a_disk_that_is_full_at_the_last_file_of_a_step_leaves_nothing(project, tmp_path, optics, monkeypatch, words):
    """Its folder stands by then, and only the record of the study does not."""
    shutil.copytree(project, tmp_path / "p")
    monkeypatch.chdir(tmp_path / "p")
    before = {f.relative_to(tmp_path): f.read_bytes() for f in tmp_path.rglob("*") if f.is_file()}
    save = Record._save

    def full(record):
        if record.steps:
            raise OSError(28, "No space left on device", str(record.folder / "ladder.json"))
        save(record)

    monkeypatch.setattr(Record, "_save", full)
    code, _, said = optics(*words.split())
    assert code == 2 and "ladder.json: No space left on device" in said
    after = {f.relative_to(tmp_path): f.read_bytes() for f in tmp_path.rglob("*") if f.is_file() and f.name != ".lock"}
    assert after == {name: data for name, data in before.items() if name.name != ".lock"}
    assert not (tmp_path / "p" / "new").exists()
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path / "p")
    assert optics(*words.split())[0] == 0


def test_a_full_disk_is_said_with_the_file(tmp_path):
    with (
        pytest.raises(OSError, match=r"No space left on device: it is not written.*'.*a\.txt'"),
        output.replacing(tmp_path / "a.txt") as file,
    ):
        file.write_text("half")
        raise OSError(28, "No space left on device")
    with (
        pytest.raises(OSError),
        output.together([tmp_path / "new" / "deep" / name for name in ("a.exr", "a.json")]),
        output.replacing(tmp_path / "new" / "deep" / "a.exr") as file,
    ):
        file.write_text("half")
        raise OSError(28, "No space left on device")
    with pytest.raises(OSError, match="no reason of ours"), output.replacing(tmp_path / "a.txt"):
        raise OSError("no reason of ours")
    assert not list(tmp_path.iterdir())


def test_a_device_is_written_to_and_never_replaced(tmp_path):
    """As root, a file put in the place of /dev/null would be found by every other program."""
    import os
    import threading

    pipe, read = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: read.append(pipe.read_text()))
    reader.start()
    output.write_text(pipe, "text")
    reader.join(10)
    assert read == ["text"] and pipe.is_fifo()
    with pytest.raises(IsADirectoryError, match="is a folder"):
        output.write_text(tmp_path, "text")
