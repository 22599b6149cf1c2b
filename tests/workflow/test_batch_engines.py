"""The engines of batches: the same images on each, whatever dies on the way.

Ray runs in process and Slurm on this machine (`sinfo` must answer); each test is skipped where its engine is absent."""

import contextlib
import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from optics.cli import main
from optics.errors import UnknownKey
from optics.study import batch, engines
from optics.study.blocks import Blocks

JOB = """
scene = "gelsight"
out = "out"
count = {count}
seed = 7
outputs = ["exr", "dn"]
layers = ["spectral"]
[defines]
width = 16
height = 12
[sample]
"gel.press_x" = {{ uniform = [-4, 4] }}
"gel.press_depth" = {{ uniform = [0.1, 0.8] }}
[noise]
system_gain = 0.05
dark_noise = 1.0
black_level = 8.0
saturation = 255.0
prnu = 0.01
"""
COUNT = 300  # seconds of work, so that twenty kills fall within it


def slurm_answers():
    return shutil.which("sinfo") and subprocess.run(["sinfo"], capture_output=True).returncode == 0


def present(engine):
    if engine == "ray":
        pytest.importorskip("ray")
    if engine == "slurm":
        pytest.importorskip("submitit")
        if not slurm_answers():
            pytest.skip("no Slurm answers on this machine")


def content(folder):
    return {
        p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file() and not p.name.startswith(".lock")
    }


def job_in(folder, count=COUNT):
    folder.mkdir(exist_ok=True)
    (folder / "job.toml").write_text(JOB.format(count=count))
    return folder / "job.toml"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return content(batch.run(job_in(tmp_path_factory.mktemp("whole") / "job"), workers=1).folder)


def command(job, *options):
    return subprocess.Popen(
        [sys.executable, "-m", "optics.cli", "batch", str(job), *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(batch.__file__).parents[2])},
    )


def workers_of(out):
    """Processes that hold the lock of a block of this folder: those at work, on any engine."""
    found = set()
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            target = os.readlink(link)
        except OSError:
            continue
        if target.startswith(str(out / ".parts")) and target.endswith(".lock"):
            found.add(int(link.parts[2]))
    return sorted(found - {os.getpid()})


@pytest.mark.slow  # a minute on "local", two on "slurm" and "ray"
@pytest.mark.parametrize("engine", engines.ENGINES)
def test_killed_at_20_random_moments(whole, tmp_path, engine):
    """kill -9 of the command or of one of its workers, twenty times: every byte is that of the undisturbed run."""
    present(engine)
    rng, job = random.Random(20), job_in(tmp_path)
    out, kills, process = job.parent / "out", 0, None
    began = time.monotonic()
    while kills < 20:
        if process is None or process.poll() is not None:
            assert not (out / "manifest.jsonl").exists(), f"finished after {kills} kills; raise COUNT"
            process = command(job, "--on", engine, "--workers", "2", "--recycle", "40")
        before = Blocks(out, COUNT).counts().recorded
        while process.poll() is None and Blocks(out, COUNT).counts().recorded < before + rng.randrange(1, 8):
            assert time.monotonic() < began + 1500
            time.sleep(0.01)
        workers = workers_of(out)
        victim = rng.choice([process.pid, *workers[:2]])
        try:
            os.kill(victim, signal.SIGKILL)
        except ProcessLookupError:
            continue
        kills += 1
        if victim == process.pid:
            process.communicate()
    if process.poll() is None:
        process.kill()
        process.communicate()
    for _ in range(3):  # what tasks that outlive their command are at is theirs
        last = command(job, "--on", engine, "--workers", "2")
        said, _ = last.communicate(timeout=600)
        if (out / "manifest.jsonl").exists():
            break
    assert last.returncode == 0, said
    assert content(out) == whole


@pytest.mark.slow  # twenty seconds each
@pytest.mark.parametrize("engine", ["slurm", "ray"])
def test_the_same_images_on_a_cluster(tmp_path, engine):
    present(engine)
    there = batch.run(job_in(tmp_path / "there", 20), workers=2, on=engine, recycle=8)
    here = batch.run(job_in(tmp_path / "here", 20), workers=1)
    assert there.complete and there.made == 20 and content(there.folder) == content(here.folder)


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_submitit_task_is_a_life(tmp_path):
    """submitit without Slurm: its own processes of this machine, whose handles it leaves to the garbage collector."""
    pytest.importorskip("submitit")
    there = batch.run(job_in(tmp_path, 3), workers=1, on="slurm", options={"cluster": "local", "timeout_min": "5"})
    assert there.complete and there.made == 3


@pytest.mark.slow  # fills a file system of 3 MB; needs the right to mount one
def test_a_disk_that_is_filled(whole, tmp_path):
    job = job_in(tmp_path)
    out = tmp_path / "out"
    out.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(out)], capture_output=True).returncode:
        pytest.skip("no right to mount a small file system")
    try:
        process = command(job, "--workers", "2")
        said, _ = process.communicate(timeout=300)
        assert process.returncode in (1, 2) and "No space left on device" in said and "the same command goes on" in said
        made = Blocks(out, COUNT).counts().recorded
        assert 0 < made < COUNT
        subprocess.run(["mount", "-o", "remount,size=200m", str(out)], check=True)
        said, _ = command(job, "--workers", "2").communicate(timeout=300)
        assert content(out) == whole, said
    finally:
        subprocess.run(["umount", str(out)], check=True)


def test_engines_that_are_not_there_are_named(tmp_path, monkeypatch, capsys):
    job = job_in(tmp_path, 2)
    with pytest.raises(UnknownKey, match="unknown engine 'slrum'; did you mean 'slurm'"):
        batch.run(job, on="slrum")
    monkeypatch.setattr(engines, "find_spec", lambda name: None)
    for engine, package in (("slurm", "submitit"), ("ray", "ray")):
        assert main(["batch", str(job), "--on", engine]) != 0
        said = capsys.readouterr().err
        assert f"needs the package '{package}'" in said and f"pip install 'tactile-optics[{engine}]'" in said
    assert main(["batch", str(job), "--engine", "partition=cpu", "--workers", "2"]) != 0
    assert "unknown option of the engine 'local' 'partition'" in capsys.readouterr().err
    assert not list((tmp_path / "out" / "images").iterdir())


def test_ctrl_c_cancels_tasks_of_slurm_that_wait_or_run(tmp_path, monkeypatch):
    """By a cluster that is none: of four tasks one ended, one runs, two wait. What was recorded stands."""

    class Task:
        cancelled = False

        def __init__(self, ended):
            self.done = lambda: ended
            self.exception = lambda: None

        def cancel(self, check=True):
            self.cancelled = True

    tasks = []

    class Cluster:
        def __init__(self, folder, cluster):
            assert cluster == "slurm"

        def update_parameters(self, **given):
            assert given["slurm_array_parallelism"] == 2

        def batch(self):
            return contextlib.nullcontext()

        def submit(self, life):
            if not tasks:
                life()  # the first one makes its samples and ends
            tasks.append(Task(ended=not tasks))
            return tasks[-1]

    def looked(status):
        raise KeyboardInterrupt

    monkeypatch.setattr(engines, "library", lambda *names: SimpleNamespace(AutoExecutor=Cluster))
    job = job_in(tmp_path, 6)
    with pytest.raises(KeyboardInterrupt):
        batch.run(job, on="slurm", workers=2, recycle=2, watch=looked)
    assert [task.cancelled for task in tasks] == [False] + [True] * (len(tasks) - 1) and len(tasks) >= 3
    assert Blocks(tmp_path / "out", 6).counts().recorded == 2
    assert batch.run(job, workers=1).made == 4


def test_parameters_that_submitit_lacks_are_named(tmp_path):
    pytest.importorskip("submitit")
    job = job_in(tmp_path, 2)
    with pytest.raises(ValueError, match="--on slurm: .*partitoin.*allowed: parameters of submitit.AutoExecutor"):
        batch.run(job, on="slurm", options={"cluster": "local", "partitoin": "cpu"})
