"""Finished cells, kept in the repository: a file per sensor, a line per cell.

    renders/gallery/cells/digit.jsonl

A line is a record of `optics.proof.blind` without what neither rates nor page read, its numbers to five digits, and
`made`: the commit that the program was at ('+': with changes of its own) and the day. A cell that is there is counted
and is not run again."""

from __future__ import annotations

import datetime
import json
import math
import subprocess
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from optics.files.output import write_text

FOLDER = Path("renders/gallery/cells")
DIGITS = 5
READ = {  # of a step
    "word",
    "claimed",
    "ambiguous",
    "kinds",
    "sentence",
    "added",
    "p_best",
    "score",
    "refit",
    "set",
    "falls",
    "failing",
    "excess_sd",
    "held_out",
    "coordinates",
    "correct",
    "strength",
    "bias",
    "flagged",
}
CHARACTERS = 240  # of a sentence


@cache
def made() -> str:
    """'commit, day': where the program is."""
    day = datetime.date.today().isoformat()
    here = Path(__file__).parent
    try:
        commit, changed = (
            subprocess.run(["git", *command], cwd=here, capture_output=True, text=True, check=True).stdout.strip()
            for command in (
                ("rev-parse", "--short=10", "HEAD"),
                ("status", "--porcelain", "--", ":/optics", ":/plugins", ":/scenes"),
            )
        )
    except (OSError, subprocess.CalledProcessError):
        return f"no commit, {day}"
    return f"{commit}{'+' if changed else ''}, {day}"


def read(folder: Path = FOLDER) -> dict[str, dict]:
    """{name of a cell: its record} of all files; a line that was cut off is passed over."""
    found = {}
    for file in sorted(folder.glob("*.jsonl")):
        for line in file.read_text(encoding="utf-8").splitlines():
            try:
                record = json.loads(line)
            except json.JSONDecodeError:
                continue
            found[record["name"]] = record
    return found


def add(folder: Path, records: Mapping[str, dict]) -> None:
    """Put {name: record} into the files, in place of what was there of the same cells."""
    everything = {**read(folder), **{name: thin(name, record) for name, record in records.items()}}
    by_rig: dict[str, list[str]] = {}
    for name in sorted(everything):
        by_rig.setdefault(everything[name]["cell"]["rig"], []).append(name)
    folder.mkdir(parents=True, exist_ok=True)
    for rig, names in by_rig.items():
        lines = [json.dumps(everything[name], allow_nan=False, separators=(",", ":")) for name in names]
        write_text(folder / f"{rig}.jsonl", "\n".join(lines) + "\n")


def thin(name: str, record: dict) -> dict:
    """A record as a line holds it."""
    steps = [{k: v for k, v in step.items() if k in READ} for step in record["steps"]]
    for step in steps:
        step["sentence"] = step.get("sentence", "")[:CHARACTERS]
    whole = {"name": name, **{k: v for k, v in record.items() if k != "making"}, "steps": steps}
    return _short(whole)


def _short(value):
    if isinstance(value, dict):
        return {k: _short(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_short(v) for v in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value
