"""Which samples of a batch are recorded, and who makes the next: blocks of samples that any number of workers share.

The folder of a batch is all that workers have in common, so that every engine (optics.study.engines) and any number of
commands at once may work on it. Samples are cut into blocks of consecutive indices. A worker claims a block by a lock,
which the system frees however the worker ends; what it made is appended to the block's own file. In `.parts`:

    00012.lock     held by the worker that is at block 12
    00012.part     lines of a block in the making: {"try": index, "run": ...} before a sample, its record after it, or
                   {"failed": why, "index": ..., "run": ...}
    00012.jsonl    the records of a complete block

Once every block is complete, all records stand in manifest.jsonl in their order, and `.parts` is gone. On a file
system without locks two workers may make the same sample: both write the same bytes, and one record counts."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import stat
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

from optics.errors import OutputExists
from optics.files.output import alone, file_hash, replacing, write_text

BLOCKS = (
    256  # blocks that a job has at least, where it has so many samples: twenty workers end within 5 % of each other
)
SIZE_MOST = 1000  # samples of a block: a million have a thousand files of records
TICK = 2_000_000_000  # ns: the coarsest clock of a file system; what was written so shortly before is read
TRIES = 3  # of one sample in one run, whatever ended them: an error, or a worker that died

Record = dict[str, Any]


class SampleFailed(RuntimeError):
    """A sample that could not be made; the others are kept."""


class DiskFull(SampleFailed):
    """A sample that found no space; no other one will."""


@dataclass
class Block:
    """A block that is claimed.

    records   index -> record of what is made
    tries     index -> how often this run began it
    failures  index -> why the last try of this run ended in an error
    """

    samples: range
    file: Path
    run: str
    records: dict[int, Record] = field(default_factory=dict)
    tries: Counter[int] = field(default_factory=Counter)
    failures: dict[int, str] = field(default_factory=dict)
    lines: TextIO | None = None

    @property
    def wanted(self) -> list[int]:
        """Samples to be made: without a record, and not begun too often."""
        return [i for i in self.samples if i not in self.records and self.tries[i] < TRIES]

    @property
    def given_up(self) -> list[int]:
        return [i for i in self.samples if i not in self.records and self.tries[i] >= TRIES]

    def begin(self, index: int) -> None:
        self._write({"try": index, "run": self.run})
        self.tries[index] += 1

    def add(self, record: Record) -> None:
        self._write(record)
        self.records[record["index"]] = record

    def fail(self, index: int, why: str) -> None:
        self._write({"failed": why, "index": index, "run": self.run})
        self.failures[index] = why

    def _write(self, line: Mapping) -> None:
        if self.lines is None:
            self.lines = open(self.file, "a", encoding="utf-8")  # noqa: SIM115  the claim closes it
            if self.lines.tell():
                self.lines.write("\n")  # ends a line that a killed worker left incomplete
        self.lines.write(json.dumps(line, sort_keys=True) + "\n")
        self.lines.flush()


@dataclass(frozen=True)
class Counts:
    """Samples of a shard: recorded, begun too often, and tries of this run."""

    recorded: int
    given_up: int
    tries: int


class Blocks:
    """The blocks of a batch's folder.

    total   samples of the job
    shard   (k, n): every n-th block from the k-th on
    run     names the run whose tries count
    """

    def __init__(self, folder: Path, total: int, shard: tuple[int, int] = (1, 1), run: str = ""):
        self.folder, self.total, self.shard, self.run = folder, total, shard, run
        self.size = max(1, min(SIZE_MOST, total // BLOCKS))
        self.count = -(-total // self.size)
        self.numbers = range(shard[0] - 1, self.count, shard[1])
        self.parts, self.manifest = folder / ".parts", folder / "manifest.jsonl"

    def samples(self, number: int) -> range:
        return range(number * self.size, min(self.total, (number + 1) * self.size))

    @property
    def own(self) -> int:
        """Samples of the shard."""
        return sum(len(self.samples(n)) for n in self.numbers)

    @property
    def finished(self) -> bool:
        return self.manifest.is_file()

    def file(self, number: int, kind: str) -> Path:
        return self.parts / f"{number:05d}.{kind}"

    def complete(self) -> set[int]:
        """Numbers of complete blocks."""
        if self.finished:
            return set(range(self.count))
        there = _names(self.parts)
        return {n for n in range(self.count) if there and self.file(n, "jsonl").name in there}

    # -- work ---------------------------------------------------------------------------------------------------------
    @contextmanager
    def claim(self, number: int) -> Iterator[Block | None]:
        """A block to work on; None where another worker is at it, or where it is complete."""
        self.parts.mkdir(exist_ok=True)
        with ExitStack() as held:
            try:
                held.enter_context(alone(self.file(number, "lock"), ""))
            except OutputExists:
                yield None
                return
            block = self.read(number)
            # In this order: records are gone from `.parts` only after they stand in the manifest.
            if self.file(number, "jsonl").exists() or self.finished:
                yield None
                return
            try:
                yield block
            finally:
                if block.lines is not None:
                    block.lines.close()
                if len(block.records) == len(block.samples):
                    write_text(self.file(number, "jsonl"), text(block.records))
                    block.file.unlink(missing_ok=True)

    def read(self, number: int) -> Block:
        """What is recorded of a block, which others may be writing."""
        part = self.file(number, "part")
        block = Block(self.samples(number), part, self.run)
        for line in _lines(self.file(number, "jsonl")) + _lines(part):
            if "failed" in line:
                if line.get("run") == self.run:
                    block.failures[line["index"]] = line["failed"]
            elif "try" in line:
                block.tries[line["try"]] += line.get("run") == self.run
            elif line["index"] in block.samples:
                block.records[line["index"]] = line
        return block

    def counts(self) -> Counts:
        if self.finished:
            return Counts(self.own, 0, 0)
        done = self.complete()
        recorded = sum(len(self.samples(n)) for n in self.numbers if n in done)
        open_blocks = [self.read(n) for n in self.opened() if n not in done]
        return Counts(
            recorded + sum(len(b.records) for b in open_blocks),
            sum(len(b.given_up) for b in open_blocks),
            sum(sum(b.tries.values()) for b in open_blocks),
        )

    def opened(self) -> list[int]:
        """Blocks of the shard that somebody has begun and not completed."""
        there = _names(self.parts)
        return [n for n in self.numbers if self.file(n, "part").name in there]

    def failures(self) -> dict[int, str]:
        """Index -> why, of samples of the shard that were begun too often."""
        return {
            i: block.failures.get(i, "its worker died")
            for n in self.opened()
            for block in [self.read(n)]
            for i in block.given_up
        }

    # -- the folder ---------------------------------------------------------------------------------------------------
    def verify(self, progress: Any = None, all_of_them: bool = False) -> None:
        """Compare the files of the shard's records with size and hash; what differs counts as not made. Records of
        blocks that another worker is at are left to it.

        A file of the recorded size that nobody wrote to since its record was written is taken as it is, without reading
        it; all_of_them: every file is read."""
        if self.finished and not self._verify_manifest(progress, all_of_them):
            return
        for file in self.folder.glob("manifest*.jsonl"):  # unfinished ones are those of earlier versions
            self._reopen(file)
        checked = 0
        for number in self.numbers:
            for kind in ("part", "jsonl"):
                if not self.file(number, kind).exists():
                    continue
                block, since = self.read(number), _since(self.file(number, kind), all_of_them)
                bad = {i for i, record in block.records.items() if not stands(self.folder, record, since)}
                checked += len(block.records)
                if progress:
                    progress("checking what is there", checked, self.own)
                if bad or (kind == "jsonl" and len(block.records) < len(block.samples)):
                    self._drop(number, bad)
                break

    def _verify_manifest(self, progress: Any, all_of_them: bool) -> bool:
        """Whether a finished batch must be opened again."""
        known, since, began = 0, _since(self.manifest, all_of_them), time.time_ns()
        with open(self.manifest, "rb") as lines:
            for line in lines:
                record = _record(line)
                if record is None or record.get("index") != known or "files" not in record:
                    return True
                known += 1
                if (record["index"] // self.size) in self.numbers and not stands(self.folder, record, since):
                    return True
                if progress:
                    progress("checking what is there", known, self.total)
        if known != self.total:
            return True
        shutil.rmtree(self.parts, ignore_errors=True)
        if len(self.numbers) == self.count:
            with suppress(OSError):  # of a folder that may only be read
                os.utime(self.manifest, ns=(began, began))  # what was read now need not be read again
        return False

    def _reopen(self, manifest: Path) -> None:
        """Take the records of a manifest back into blocks, block by block where it is in order."""
        self.parts.mkdir(exist_ok=True)
        with open(manifest, "rb") as lines:
            records = (r for r in filter(None, map(_record, lines)) if "files" in r)
            for number, own in itertools.groupby(records, lambda record: record["index"] // self.size):
                if number < self.count and not self.file(number, "jsonl").exists():
                    self._store(number, {**{r["index"]: r for r in own}, **self.read(number).records})
        manifest.with_suffix(".csv").unlink(missing_ok=True)
        manifest.unlink()

    def _drop(self, number: int, bad: set[int]) -> None:
        try:
            with alone(self.file(number, "lock"), ""):
                block = self.read(number)
                self._store(number, {i: r for i, r in block.records.items() if i not in bad})
        except OutputExists:
            return

    def _store(self, number: int, records: Mapping[int, Record]) -> None:
        """Replace all that is recorded of a block."""
        whole = len(records) == len(self.samples(number))
        write_text(self.file(number, "jsonl" if whole else "part"), text(records))
        self.file(number, "part" if whole else "jsonl").unlink(missing_ok=True)

    def sweep(self) -> None:
        """Remove what workers that died left of the shard's samples, but for blocks that somebody is at."""
        left: dict[int, list[Path]] = {}
        for file in (self.folder / "images").glob(".*"):
            index = file.name.lstrip(".").split(".")[0].split("-")[0]
            if index.isdecimal() and int(index) // self.size in self.numbers:
                left.setdefault(int(index) // self.size, []).append(file)
        for number, files in left.items():
            self.parts.mkdir(exist_ok=True)
            try:
                with alone(self.file(number, "lock"), ""):
                    for file in files:
                        file.unlink(missing_ok=True)
            except OutputExists:
                continue

    def records(self) -> Iterator[Record]:
        """All records of the job that there are, in their order."""
        if self.finished:
            with open(self.manifest, "rb") as lines:
                yield from filter(None, map(_record, lines))
            return
        for number in range(self.count):
            block = self.read(number)
            yield from (block.records[i] for i in sorted(block.records))

    def finish(self) -> bool:
        """Write one ordered manifest once every block of the job is complete; whether it is."""
        if not self.finished:
            if self.complete() < set(range(self.count)):
                return False
            with replacing(self.manifest) as file, open(file, "w", encoding="utf-8") as out:
                for number in range(self.count):
                    out.write(self.file(number, "jsonl").read_text(encoding="utf-8"))
        shutil.rmtree(self.parts, ignore_errors=True)
        return True


def stands(folder: Path, record: Mapping, since: int = -1) -> bool:
    """Whether every file of a record is there, with its size and, of those written to after `since` (ns), its hash."""
    for entry in record["files"].values():
        file = folder / entry["file"]
        try:
            status = file.stat()
        except OSError:
            return False
        if not stat.S_ISREG(status.st_mode) or status.st_size != entry["size"]:
            return False
        if status.st_mtime_ns > since and file_hash(file) != entry["hash"]:
            return False
    return True


def _since(records: Path, all_of_them: bool) -> int:
    """When records were written last, ns, less TICK: their files stood by then; -1 where every file is to be read."""
    try:
        return -1 if all_of_them else records.stat().st_mtime_ns - TICK
    except FileNotFoundError:
        return -1


def text(records: Mapping[int, Record]) -> str:
    return "".join(json.dumps(records[i], sort_keys=True) + "\n" for i in sorted(records))


def _record(line: str | bytes) -> Record | None:
    """A line as a record; None for one that a killed worker left incomplete, or that is none: its sample is made
    again."""
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(record, dict):
        return None
    if "failed" in record:
        return record if isinstance(record["failed"], str) and _is_whole(record.get("index")) else None
    if "try" in record:
        return record if _is_whole(record["try"]) else None
    return sample_record(record)


def sample_record(record: Any) -> Record | None:
    """The record of a sample as it is; None where it is none, such as one with files outside the batch's folder."""
    if not isinstance(record, dict) or not _is_whole(record.get("index")) or not _is_whole(record.get("unit", 0)):
        return None
    files, sample, labels = (record.get(name) for name in ("files", "sample", "labels"))
    if not isinstance(files, dict) or not files or not isinstance(sample, dict):
        return None
    values = all(isinstance(v, (int, float, str)) and not isinstance(v, bool) for v in sample.values())
    whole = values and all(_is_entry(entry) for entry in files.values())
    return record if whole and ("labels" not in record or isinstance(labels, dict)) else None


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 62


def _is_entry(entry: object) -> bool:
    if not isinstance(entry, dict) or not isinstance(entry.get("hash"), str) or not _is_whole(entry.get("size")):
        return False
    file = entry.get("file")
    return isinstance(file, str) and "\0" not in file and not os.path.isabs(file) and ".." not in Path(file).parts


def _names(folder: Path) -> set[str]:
    try:
        return set(os.listdir(folder))
    except FileNotFoundError:
        return set()


def _lines(file: Path) -> list[Record]:
    try:
        text = file.read_text(encoding="utf-8", errors="replace")
        return [record for line in text.splitlines() if (record := _record(line))]
    except FileNotFoundError:
        return []
