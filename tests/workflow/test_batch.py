"""A batch ends the same, whatever happened on the way: kills, shards, workers, damage."""

import csv
import dataclasses
import hashlib
import itertools
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from optics.cli import main
from optics.errors import OutOfBounds, OutputExists
from optics.files import exr
from optics.files.output import alone
from optics.light.rendering import RenderJob
from optics.study import batch, blocks
from optics.study.blocks import TRIES, Blocks
from optics.study.engines import EngineFailed, Local, work_through

JOB = """
scene = "gelsight"
out = "out"
count = 5
seed = 7
outputs = ["exr", "png", "dn"]
[defines]
width = 32
height = 24
[parameters]
"gel.indenter_size" = 2.0
[sample]
"gel.press_x" = { uniform = [-4, 4] }
"led_1.power" = { normal = [1, 0.05] }
"gel.press_depth" = { grid = [0.2, 0.6] }
[noise]
system_gain = 0.05
dark_noise = 1.0
black_level = 8.0
saturation = 255.0
prnu = 0.01
"""
TOTAL = 10


def content(folder):
    """Every file by its hash; locks hold nothing."""
    return {
        p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file() and not p.name.startswith(".lock")
    }


@pytest.fixture
def job(tmp_path):
    (tmp_path / "job.toml").write_text(JOB)
    return tmp_path / "job.toml"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of an uninterrupted run in one process."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "job.toml").write_text(JOB)
    result = batch.run(folder / "job.toml", workers=1)
    assert (result.total, result.own, result.made, result.complete) == (TOTAL, TOTAL, TOTAL, True)
    return folder / "out"


# -- what is drawn ---------------------------------------------------------------------------------------------------
def draws(tmp_path, sample, count=400, **more):
    text = f'scene = "gelsight"\nout = "out"\ncount = {count}\n' + "".join(f"{k} = {v}\n" for k, v in more.items())
    (tmp_path / "draws.toml").write_text(text + "[sample]\n" + sample)
    job = batch.read(tmp_path / "draws.toml")
    return [job.values(i) for i in range(job.total)]


def test_distributions(tmp_path):
    found = draws(
        tmp_path,
        "a = {uniform = [2, 4]}\nb = {log_uniform = [0.01, 100]}\nc = {normal = [5, 2]}\n"
        'd = {choice = ["x", "y", 3]}\n',
        4000,
    )
    a, b, c = (np.array([v[k] for v in found]) for k in "abc")
    # 4000 draws: standard errors 0.009, 0.06 (of ln b, sd 2.66: 0.042), 0.03; four of each
    assert a.min() >= 2 and a.max() <= 4 and a.mean() == pytest.approx(3, abs=0.037)
    assert b.min() >= 0.01 and b.max() <= 100 and np.log(b).mean() == pytest.approx(0, abs=0.17)
    assert c.mean() == pytest.approx(5, abs=0.13) and c.std() == pytest.approx(2, abs=0.09)
    assert all(abs(n - 4000 / 3) < 4 * 30 for n in Counter(v["d"] for v in found).values())
    assert abs(np.corrcoef([a, np.log(b), c]) - np.eye(3)).max() < 4 / np.sqrt(4000)


def test_a_draw_depends_on_seed_index_and_key_alone(tmp_path):
    one = draws(tmp_path, "a = {uniform = [0, 1]}\nb = {uniform = [0, 1]}\n")
    assert draws(tmp_path, "b = {uniform = [0, 1]}\na = {uniform = [0, 1]}\n", 10) == one[:10]
    assert [v["a"] for v in draws(tmp_path, "a = {uniform = [0, 1]}\n", 10)] == [v["a"] for v in one[:10]]
    assert all(v["a"] != w["a"] for v, w in zip(one, draws(tmp_path, "a = {uniform = [0, 1]}\n", seed=1)))
    assert all(v["a"] != v["b"] for v in one)


def test_grids_multiply_and_the_last_is_fastest(tmp_path):
    found = draws(tmp_path, 'a = {grid = [1, 2]}\nb = {grid = ["x", "y", "z"]}\nc = {uniform = [0, 1]}\n', 2)
    assert [(v["a"], v["b"]) for v in found[::2]] == [(a, b) for a in (1, 2) for b in "xyz"]
    assert len({v["c"] for v in found}) == 12
    (tmp_path / "draws.toml").write_text('scene = "gelsight"\nout = "out"\n[sample]\na = {grid = [1, 2, 3]}\n')
    assert batch.read(tmp_path / "draws.toml").total == 3


@pytest.mark.parametrize(("text", "shard"), [("1/1", (1, 1)), ("3/4", (3, 4)), ("12/12", (12, 12))])
def test_shards(text, shard):
    assert batch.parse_shard(text) == shard


# -- what is written -------------------------------------------------------------------------------------------------
def test_files_tell_how_they_were_made(whole):
    names = [f"{i:06d}{end}" for i in range(TOTAL) for end in ("-dn.png", ".exr", ".png")]
    assert sorted(p.name for p in (whole / "images").iterdir()) == names
    records = [json.loads(line) for line in (whole / "manifest.jsonl").read_text().splitlines()]
    assert [r["index"] for r in records] == list(range(TOTAL))
    with open(whole / "manifest.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    for record, row in zip(records, rows):
        assert float(row["gel.press_x"]) == record["sample"]["gel.press_x"] and float(row["gel.indenter_size"]) == 2
        for role, entry in record["files"].items():
            data = (whole / entry["file"]).read_bytes()
            assert row[role] == entry["file"] and len(data) == entry["size"]
            assert entry["hash"] == "sha256:" + hashlib.sha256(data).hexdigest()
    channels, header = exr.read(whole / rows[7]["exr"])
    made = json.loads(header["provenance"])
    assert (
        made["parameters"]["gel.press_x"] == records[7]["sample"]["gel.press_x"]
        and made["parameters"]["gel.press_depth"] == 0.6
    )
    assert channels["depth.Z"].min() == pytest.approx(24 - 0.6, abs=0.1)  # pixels of 0.56 mm


def test_noise_is_the_cameras(whole):
    def read(end):
        images = []
        for i in range(TOTAL):
            with Image.open(whole / "images" / f"{i:06d}{end}.png") as opened:
                images.append(np.asarray(opened, float))
        return np.array(images)

    clean, noisy = read(""), read("-dn")
    difference = noisy - clean
    expected = 0.05 * (clean - 8) + 1 + 2 / 12 + (0.01 * (clean - 8)) ** 2  # both are rounded to 1 DN
    assert difference.mean() == pytest.approx(0, abs=0.1)
    assert (difference**2).mean() == pytest.approx(expected.mean(), rel=0.05)  # 23040 values: 1 %
    assert len({image.tobytes() for image in difference}) == TOTAL


def test_each_light_alone(tmp_path):
    (tmp_path / "job.toml").write_text(
        JOB.replace("count = 5", 'count = 1\nlights = "each"\nlayers = ["spectral"]').replace(
            "grid = [0.2, 0.6]", "grid = [0.6]"
        )
    )
    result = batch.run(tmp_path / "job.toml", workers=1)
    record = json.loads((result.folder / "manifest.jsonl").read_text())
    assert len(record["files"]) == 18 and record["files"]["led_3.exr"]["file"] == "images/000000-led_3.exr"
    alone = [exr.read(result.folder / record["files"][f"led_{i}.exr"]["file"])[0] for i in range(1, 7)]
    assert set(alone[0]) == {"R", "G", "B", *(exr.spectral_name(b) for b in (610, 540, 460))}
    job = batch.read(tmp_path / "job.toml")
    from optics.scene import loader as scene

    together = RenderJob(scene.load("gelsight", {"width": "32", "height": "24"})).take(
        {**job.parameters, **job.values(0)}
    )
    np.testing.assert_allclose(
        sum(c["S0.540,000000nm"] for c in alone), together.channels["S0.540,000000nm"], rtol=1e-5
    )


# -- what happens on the way -----------------------------------------------------------------------------------------
def test_nothing_is_made_twice(whole):
    before = content(whole)
    result = batch.run(whole.parent / "job.toml", workers=1)
    assert (result.made, result.complete) == (0, True) and content(whole) == before


def test_shards_are_together_the_whole(whole, job):
    first = batch.run(job, (1, 3), workers=1)
    assert (first.own, first.made, first.complete) == (4, 4, False) and not (first.folder / "manifest.csv").exists()
    assert batch.run(job, (3, 3), workers=1).own == 3
    assert batch.run(job, (2, 2), workers=1).complete is False  # what other shards made already is not made again
    last = batch.run(job, (2, 3), workers=1)
    assert last.complete and content(last.folder) == content(whole)


def recorded(folder):
    return Blocks(folder, TOTAL).counts().recorded


def command(job, *options):
    return [sys.executable, "-m", "optics.cli", "batch", str(job), *options]


# The command line, in a process that stops itself once it has begun a sample (with one worker it makes them itself).
STOPS = """
import os, signal, sys
from optics.cli import main
from optics.study.batch import Maker
make = Maker.make
def stops(self, index):
    if index == {index}:
        os.kill(os.getpid(), signal.SIGSTOP)
    return make(self, index)
Maker.make = stops
sys.exit(main(sys.argv[1:]))
"""
LONG = 300  # s for what takes seconds where other processes have the cores


@pytest.fixture
def start():
    """Starts commands that heed interrupts even where these tests run in the background; none outlives its test."""
    with ExitStack() as all_of_them:

        def start(words):
            process = subprocess.Popen(
                words,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                env={**os.environ, "PYTHONPATH": str(Path(batch.__file__).parents[2])},
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
            )
            all_of_them.enter_context(process)  # waits, and closes its pipes
            all_of_them.callback(process.kill)
            return process

        yield start


def wait(process, until, seconds=LONG):
    """Wait for something while a process runs; what it said where it ends before, or where that takes too long."""
    deadline = time.monotonic() + seconds
    while not until():
        late = time.monotonic() > deadline
        if late:
            process.kill()
        assert process.poll() is None and not late, (f"{seconds} s" if late else "it ended", process.communicate())
        time.sleep(0.01)


def state(pid):
    """One letter, as in ps: T is stopped; None where there is no such process."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return None


def stopped_at(start, job, index):
    """A command that has stopped in the midst of a sample; it holds the lock of that sample."""
    process = start([sys.executable, "-c", STOPS.format(index=index), "batch", str(job), "--workers", "1"])
    wait(process, lambda: state(process.pid) == "T")
    return process


def children(pid):
    """Processes whose parent is `pid`."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            if int(stat.read_text().rsplit(")", 1)[1].split()[1]) == pid:
                found.append(int(stat.parent.name))
        except (OSError, IndexError):
            continue
    return found


@contextmanager
def held(out, index):
    """The lock of a sample, as a worker holds it that is at it."""
    (out / ".parts").mkdir(parents=True)
    with alone(out / ".parts" / f"{index:05d}.lock", "it is another's"):
        yield


in_proc = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes in /proc")


@in_proc
def test_killed_in_the_middle_and_resumed(whole, job, start):
    """The test holds the lock of the last sample until the kill, so that the command cannot end before, however fast
    the machine is, or however late this test is called."""
    out = job.parent / "out"
    workers: set[int] = set()
    with held(out, TOTAL - 1):
        process = start(command(job, "--workers", "2"))
        wait(process, lambda: workers.update(children(process.pid)) or recorded(out) >= 3)
        process.kill()
        process.communicate()
        deadline = time.monotonic() + LONG
        while any(Path(f"/proc/{pid}").exists() for pid in workers):
            assert time.monotonic() < deadline, "workers outlive the process that started them"
            time.sleep(0.05)
    done = recorded(out)
    assert len(workers) >= 2 and 3 <= done < TOTAL
    for name in (".000009.0123456789abcdef.exr", "..000009-dn.0123.4567.png"):  # as a kill in mid-write leaves them
        (out / "images" / name).write_bytes(b"half an image")
    with open(out / ".parts" / "00009.part", "a") as file:
        file.write('{"index": 9, "sam')
    result = batch.run(job, workers=1)
    assert result.complete and result.made == TOTAL - done
    assert content(out) == content(whole)


@in_proc
def test_interrupted_says_how_to_go_on(whole, job, start):
    process = stopped_at(start, job, 4)
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGCONT)
    out, err = process.communicate(timeout=LONG)
    assert (
        process.returncode == 130
        and err.splitlines()[-1] == "interrupted: what was made is kept, the same command goes on"
    )
    assert "Traceback" not in err and out == ""
    assert recorded(job.parent / "out") == 4
    assert not [p for p in (job.parent / "out" / "images").iterdir() if p.name.startswith(".")]
    assert batch.run(job, workers=1).complete and content(job.parent / "out") == content(whole)


def test_damage_is_found_and_mended(whole, tmp_path):
    import shutil

    shutil.copytree(whole, tmp_path / "out")
    (tmp_path / "job.toml").write_text(JOB)
    images = tmp_path / "out" / "images"
    (images / "000001.exr").write_bytes((images / "000001.exr").read_bytes()[:-7])  # cut short
    data = bytearray((images / "000004-dn.png").read_bytes())
    data[len(data) // 2] ^= 1  # the same size
    (images / "000004-dn.png").write_bytes(bytes(data))
    (images / "000008.png").unlink()
    result = batch.run(tmp_path / "job.toml", workers=1)
    assert result.made == 3 and content(tmp_path / "out") == content(whole)


@pytest.mark.parametrize(
    "changed",
    [
        {"index": "x"},
        {"index": None},
        {"files": [1]},
        {"files": {"png": "x"}},
        {"files": {"png": {"file": "/etc/passwd", "size": 1, "hash": "x"}}},
        {"files": {"png": {"file": "../job.toml", "size": 1, "hash": "x"}}},
        {"sample": 3},
        {"labels": []},
    ],
    ids=str,
)
def test_a_record_that_is_none_counts_as_not_made(whole, tmp_path, changed, capsys):
    """Whoever edited it: the sample is made again, and an export reads nothing outside the batch's folder."""
    import shutil

    shutil.copytree(whole, tmp_path / "out")
    (tmp_path / "job.toml").write_text(JOB)
    manifest = tmp_path / "out" / "manifest.jsonl"
    records = [json.loads(line) for line in manifest.read_text().splitlines()]
    records[3].update(changed)
    manifest.write_text("".join(json.dumps(record) + "\n" for record in records))
    assert main(["export", str(tmp_path / "out"), "-o", str(tmp_path / "data"), "--to", "webdataset"]) == 2
    assert "manifest.jsonl: line 4: no record of sample 3; run `optics batch` again" in capsys.readouterr().err
    result = batch.run(tmp_path / "job.toml", workers=1)
    assert result.made == 1 and content(tmp_path / "out") == content(whole)


def test_files_of_others_among_the_records_are_left_alone(whole, tmp_path):
    import shutil

    shutil.copytree(whole, tmp_path / "out")
    (tmp_path / "job.toml").write_text(JOB)
    parts, manifest = tmp_path / "out" / ".parts", tmp_path / "out" / "manifest.jsonl"
    parts.mkdir()
    for index, line in enumerate(manifest.read_text().splitlines()[:-1]):
        (parts / f"{index:05d}.jsonl").write_text(line + "\n")
    manifest.unlink()
    for name in ("0abc.jsonl", "99999.jsonl", "0x.part"):
        (parts / name).write_text("{}\n")
    (parts / "00009.part").write_text('{"try": "x"}\n{"failed": 1, "index": []}\n[1]\nnull\n' + "[" * 99_999 + "\n\xff")
    result = batch.run(tmp_path / "job.toml", workers=1)
    assert result.made == 1 and content(tmp_path / "out") == content(whole)


def test_an_export_of_a_manifest_cut_short_is_refused(whole, tmp_path, capsys):
    import shutil

    shutil.copytree(whole, tmp_path / "out")
    manifest = tmp_path / "out" / "manifest.jsonl"
    manifest.write_text("".join(manifest.read_text().splitlines(keepends=True)[:4]))
    assert main(["export", str(tmp_path / "out"), "-o", str(tmp_path / "data"), "--to", "webdataset"]) == 2
    assert "manifest.jsonl: 4 records of 10 samples; run `optics batch` again" in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    ("old", "new", "changed"),
    [
        ("seed = 7", "seed = 8", "job.seed"),
        ("[-4, 4]", "[-4, 5]", r"job.sample.gel.press_x.uniform"),
        ("width = 32", "width = 40", "job.defines.width"),
        ('"dn"]', '"dn"]\nspp = 4', "job.spp"),
    ],
)
def test_another_job_is_refused(whole, tmp_path, old, new, changed):
    (tmp_path / "job.toml").write_text(JOB.replace(old, new).replace('"out"', f'"{whole}"'))
    before = content(whole)
    with pytest.raises(OutputExists, match=f"made from another job: changed {changed}"):
        batch.run(tmp_path / "job.toml", workers=1)
    assert content(whole) == before


def test_a_changed_plugin_is_another_job(whole, tmp_path, monkeypatch):
    from optics.light import rendering

    (tmp_path / "job.toml").write_text(JOB.replace('"out"', f'"{whole}"'))
    monkeypatch.setattr(batch, "RenderJob", rendering.RenderJob)
    monkeypatch.setattr(rendering, "plugins_record", lambda registry: {"effects/lens_vignetting.py": "sha256:0"})
    with pytest.raises(OutputExists, match="changed plugins"):
        batch.run(tmp_path / "job.toml", workers=1)


def failing(monkeypatch, error, often=99):
    """Sample 2 ends in an error, so many times; returns the indices that were begun."""
    make, begun = batch.Maker.make, []

    def fails(self, index):
        begun.append(index)
        if index == 2 and begun.count(2) <= often:
            raise error
        return make(self, index)

    monkeypatch.setattr(batch.Maker, "make", fails)
    return begun


def test_a_sample_that_fails_is_named_and_the_others_are_made(whole, job, monkeypatch):
    begun = failing(monkeypatch, RuntimeError("no such press"))
    with pytest.raises(
        batch.SampleFailed, match=r"sample 2 \(gel.press_x = .*\): RuntimeError: no such press; what was made is kept"
    ):
        batch.run(job, workers=1)
    assert begun.count(2) == TRIES and sorted({*begun}) == list(range(TOTAL))
    out = job.parent / "out"
    assert recorded(out) == TOTAL - 1 and not (out / "manifest.jsonl").exists()
    monkeypatch.undo()
    assert batch.run(job, workers=1).made == 1 and content(out) == content(whole)


def test_a_sample_that_fails_once_is_made(whole, job, monkeypatch):
    begun = failing(monkeypatch, RuntimeError("a file server that hiccups"), often=1)
    assert batch.run(job, workers=1).complete and begun.count(2) == 2
    assert content(job.parent / "out") == content(whole)


def test_a_full_disk_ends_the_run_at_once(whole, job, monkeypatch):
    begun = failing(monkeypatch, OSError(28, "No space left on device"))
    with pytest.raises(batch.SampleFailed, match=r"sample 2 \(.*No space left on device; what was made is kept"):
        batch.run(job, workers=1)
    assert begun == [0, 1, 2] and recorded(job.parent / "out") == 2
    monkeypatch.undo()
    assert batch.run(job, workers=1).made == TOTAL - 2 and content(job.parent / "out") == content(whole)


@in_proc
def test_commands_at_once_share_the_work(whole, job, start):
    """A block that another worker is at is left to it, and is made where that one dies."""
    first = stopped_at(start, job, 4)
    out = job.parent / "out"
    blocks = Blocks(out, TOTAL)
    assert recorded(out) == 4
    for workers in (1, 2):
        assert not batch.run(job, workers=workers).complete
        assert recorded(out) == TOTAL - 1, "all but the one that is held"
    first.kill()
    first.communicate()
    result = batch.run(job, workers=1)
    assert (result.made, result.complete) == (1, True) and not blocks.parts.exists()
    assert content(out) == content(whole)


@pytest.mark.parametrize("other", [True, False], ids=["goes on", "has died"])
def test_two_commands_that_finish_at_once_without_locks(job, monkeypatch, other):
    """The other one's sweep takes away what this one is writing: this one waits for the other's manifest."""
    write = batch._write_table

    def swept(own, blocks):
        if other:
            threading.Timer(0.3, lambda: (write(own, blocks), blocks.finish())).start()
        raise FileNotFoundError(2, "No such file or directory", ".manifest.x.csv")

    monkeypatch.setattr(batch, "_write_table", swept)
    monkeypatch.setattr(batch, "PATIENCE", 5.0 if other else 0.1)
    if other:
        assert batch.run(job, workers=1).complete and (job.parent / "out" / "manifest.csv").is_file()
    else:
        with pytest.raises(FileNotFoundError):
            batch.run(job, workers=1)


def test_who_finishes_leaves_the_records_to_another_that_is_at_it(whole, job, monkeypatch):
    """Both have found all complete. The second one wrote the manifest and took the records from under the first one's
    table, which then lacked rows."""
    out, write, ends = job.parent / "out", batch._write_table, []

    def slow(own, blocks):
        ends.append(threading.Thread(target=lambda: ends.append(batch.finish(own, Blocks(out, TOTAL)))))
        ends[0].start()
        time.sleep(0.5)
        assert not (out / "manifest.jsonl").exists() and (out / ".parts").is_dir()
        write(own, blocks)

    monkeypatch.setattr(batch, "_write_table", slow)
    assert batch.run(job, workers=1).complete
    ends[0].join()
    assert ends[1:] == [True] and content(out) == content(whole)


def test_a_table_that_lacks_rows_is_not_kept(job, monkeypatch):
    """Where a file system has no locks, records may go while the table is written."""
    records = Blocks.records
    monkeypatch.setattr(Blocks, "records", lambda self: itertools.islice(records(self), TOTAL - 1))
    monkeypatch.setattr(batch, "PATIENCE", 0.1)
    with pytest.raises(FileNotFoundError, match="records are gone"):
        batch.run(job, workers=1)
    assert not list((job.parent / "out").glob("manifest*"))
    monkeypatch.undo()
    assert batch.run(job, workers=1).complete


@in_proc
def test_a_worker_that_is_killed_is_replaced(whole, job, start):
    """While the test holds the lock of the last sample the command cannot end, and while the command is stopped it
    cannot let its workers go."""
    out = job.parent / "out"
    with held(out, TOTAL - 1):
        process = start(command(job, "--workers", "2", "--json"))
        wait(process, lambda: recorded(out) >= 3)
        process.send_signal(signal.SIGSTOP)
        workers = [pid for pid in children(process.pid) if "spawn_main" in Path(f"/proc/{pid}/cmdline").read_text()]
        os.kill(workers[0], signal.SIGKILL)
    process.send_signal(signal.SIGCONT)
    said, err = process.communicate(timeout=LONG)
    assert process.returncode == 0 and json.loads(said)["complete"], err
    assert content(out) == content(whole)


def test_workers_are_recycled(whole, job):
    states = []
    result = batch.run(job, workers=2, recycle=3, watch=states.append)
    assert result.complete and content(result.folder) == content(whole)
    assert [s.done for s in states] == sorted(s.done for s in states) and states[-1].done == TOTAL
    assert max(s.workers for s in states) == 2 and {s.died for s in states} == {0}


def test_workers_load_while_the_job_is_checked(tmp_path):
    """The first lives are lived by the processes that were started before; those that nobody needs end with it."""
    engine = Local(2, {}, tmp_path)
    engine.warm(5, time.sleep, 0)
    begun = {pid for process in engine.ready for pid in process._processes}
    assert len(begun) == 2 and {work.result() for work in engine.start([os.getpid, os.getpid])} == begun
    assert engine.start([os.getpid])[0].result() not in begun  # a life has a process of its own
    engine.stop()
    idle = Local(2, {}, tmp_path)
    idle.warm(1, time.sleep, 600)
    (process,) = idle.ready
    (child,) = process._processes.values()
    idle.stop()
    assert child.exitcode is not None


def test_no_process_outlives_a_job_that_is_refused(job):
    job.write_text(job.read_text().replace("[sample]", '[sample]\n"led_2.power" = { choice = [-5.0] }'))
    with pytest.raises(OutOfBounds):
        batch.run(job, workers=2)
    assert not multiprocessing.active_children()


def test_workers_that_cannot_start_are_reported(job, monkeypatch):
    batch.run(job, (1, 4), workers=1)
    note = job.parent / "out" / "job.json"
    broken = dataclasses.replace(batch.Life(batch.read(job), job, None, (1, 1), "run"), plugins=[job.parent / "absent"])
    with pytest.raises(EngineFailed, match=r"workers died before they began a sample: .*absent"):
        work_through(Local(1, {}, note.parent), broken, Blocks(note.parent, TOTAL), 100)


def test_a_stock_scene_is_the_same_bit_by_bit(tmp_path):
    (tmp_path / "stock.xml").write_text("""<scene version="3.0.0"><integrator type="path"/><sensor type="perspective">
        <transform name="to_world"><lookat origin="0,-4,4" target="0,0,0" up="0,0,1"/></transform><film type="hdrfilm">
        <integer name="width" value="48"/><integer name="height" value="32"/></film></sensor>
        <shape type="sphere"><bsdf type="diffuse"/></shape><emitter type="constant" id="sky"/></scene>""")
    for name in ("a", "b"):
        (tmp_path / f"{name}.toml").write_text(
            f'scene = "stock.xml"\nout = "{name}"\ncount = 2\nspp = 32\nvariant = "llvm_ad_rgb"\n'
        )
        assert batch.run(tmp_path / f"{name}.toml", workers=1).complete
    assert content(tmp_path / "a") == content(tmp_path / "b")


def test_command_line(whole, capsys):
    assert main(["batch", str(whole.parent / "job.toml"), "--workers", "1"]) == 0
    assert capsys.readouterr().out == f"{whole}: 10 of 10 samples, 0 of them made now, all complete: manifest.csv\n"
    assert main(["batch", str(whole.parent / "job.toml"), "--shard", "2/5", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "folder": str(whole),
        "total": 10,
        "own": 2,
        "made": 0,
        "complete": True,
    }


def test_labels_stand_in_the_manifest_and_beside_the_images(tmp_path):
    """Forces rise with the depth, the table has a column for each number, and the arrays add up to the force."""
    file = tmp_path / "job.toml"
    text = JOB.replace("count = 5", 'labels = ["force", "pose"]').replace('"exr", "png", "dn"', '"png"')
    file.write_text(text.replace('"gel.press_x" = { uniform = [-4, 4] }\n', ""))
    folder = batch.run(file, workers=1).folder
    records = [json.loads(line) for line in (folder / "manifest.jsonl").read_text().splitlines()]
    force = [r["labels"]["force"][2] for r in records]
    assert len(force) == 2 and 0 < force[0] < force[1]
    with np.load(folder / records[1]["files"]["labels"]["file"], allow_pickle=False) as arrays:
        np.testing.assert_allclose(arrays["force"].sum((0, 1)), records[1]["labels"]["force"], rtol=1e-12)
    with open(folder / "manifest.csv", newline="") as lines:
        rows = list(csv.DictReader(lines))
    assert float(rows[1]["force.2"]) == force[1] and float(rows[1]["pose.press_depth"]) == 0.6
    before = content(folder)
    (folder / records[0]["files"]["labels"]["file"]).unlink()
    assert batch.run(file, workers=1).made == 1 and content(folder) == before  # the same bytes again


def test_unknown_labels_are_named(tmp_path):
    file = tmp_path / "job.toml"
    file.write_text(JOB.replace("seed = 7", 'seed = 7\nlabels = ["forces"]'))
    with pytest.raises(batch.BadJob, match="labels.* 'forces'; allowed: a list of force, pressure"):
        batch.read(file)


def test_a_press_deeper_than_the_gel_is_refused_wherever_it_is_stated(tmp_path, capsys):
    file = tmp_path / "job.toml"
    file.write_text(
        JOB.replace("width = 32", "width = 32\ndepth = 6").replace('"gel.press_depth" =', '"gel.press_rz" =')
    )
    assert main(["batch", str(file)]) == 2
    assert "gel.press_depth" in (said := capsys.readouterr().err) and "the gel is 4 mm thick" in said
    assert not (tmp_path / "out").exists()
    for words in (["-D", "depth=6"], ["--set", "gel.press_depth=6"]):
        assert main(["render", "gelsight", *words, "-o", str(tmp_path / "x.exr")]) == 2
        assert "the gel is 4 mm thick" in capsys.readouterr().err
    assert not (tmp_path / "x.exr").exists()


def test_what_nobody_wrote_to_is_not_read_again(tmp_path, monkeypatch):
    """A finished batch is checked by sizes and times; a changed file is found, and with check_files one whose time was
    set back."""
    file = tmp_path / "job.toml"
    file.write_text(JOB)
    folder = batch.run(file, workers=1).folder
    read, plain = [], blocks.file_hash
    monkeypatch.setattr(blocks, "file_hash", lambda name: read.append(name) or plain(name))
    long_ago = time.time_ns() - 10 * blocks.TICK
    for image in (folder / "images").iterdir():
        os.utime(image, ns=(long_ago, long_ago))
    assert batch.run(file, workers=1).made == 0 and read == []
    victim = folder / "images" / "000002.png"
    whole = victim.read_bytes()
    victim.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    os.utime(victim, ns=(long_ago, long_ago))
    assert batch.run(file, workers=1).made == 0
    assert batch.run(file, workers=1, check_files=True).made == 1 and victim.read_bytes() == whole
    victim.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    assert batch.run(file, workers=1).made == 1 and victim.read_bytes() == whole


def test_draws_that_are_bad_together_are_named_before_rendering(tmp_path, monkeypatch):
    """Each value lies within its bounds, and so does each alone in the scene; sample 2 presses deeper than its gel."""
    file = tmp_path / "job.toml"
    table = '[sample]\n"gel.thickness" = { grid = [4.0, 1.0] }\n"gel.press_depth" = { grid = [0.5, 1.5] }\n'
    file.write_text(JOB.split("[sample]")[0].replace("count = 5", "") + table + "[noise]" + JOB.split("[noise]")[1])
    monkeypatch.setattr(batch, "fill", lambda *a, **k: pytest.fail("it renders"))
    with pytest.raises(OutOfBounds, match=r"sample 3.*gel.press_depth = 1.5"):
        batch.run(file, workers=1)
    assert not (tmp_path / "out").exists()
