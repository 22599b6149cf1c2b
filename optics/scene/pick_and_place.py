"""Where the parts of a printed circuit board stand, from the pick-and-place file that it was populated by.

    x, y = placed("board.csv:D7", folders)        mm

KiCad, Altium, Eagle and EasyEDA write a table with a row for each part: its designator and its middle. The heads of the
columns differ (HEADS), separators are commas, semicolons or tabs, lengths are in mm unless a head or a number says
mil."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from pathlib import Path

from optics.scene.regions import found_file

HEADS = {  # in small letters, without spaces, units and signs
    "designator": ("designator", "ref", "refdes", "reference", "part"),
    "x": ("midx", "posx", "centerx", "x", "refx"),
    "y": ("midy", "posy", "centery", "y", "refy"),
}
MIL = 0.0254  # mm
LONGEST = 10_000  # rows: no board has more parts


def placed(named: str, folders: Sequence[str | Path] = ()) -> tuple[float, float]:
    """(x, y) in mm of the part that `FILE:DESIGNATOR` names. Raises ValueError, FileNotFoundError."""
    name, colon, designator = named.rpartition(":")
    if not colon or not name or not designator:
        raise ValueError(f"placed = {named!r}; allowed: FILE:DESIGNATOR, such as board.csv:D7")
    file = found_file(tuple(str(f) for f in folders), name)
    rows = _rows(file)
    columns = _columns(rows[0], file)
    for number, row in enumerate(rows[1:], 2):
        if len(row) > max(columns.values()) and row[columns["designator"]].strip() == designator:
            return tuple(_mm(row[columns[c]], rows[0][columns[c]], f"{file}: row {number}: {c}") for c in "xy")  # type: ignore[return-value]
    there = [row[columns["designator"]].strip() for row in rows[1:] if len(row) > columns["designator"]]
    raise ValueError(f"{file}: no part '{designator}'; it has {', '.join(there[:12])}{' ...' * (len(there) > 12)}")


def _rows(file: Path) -> list[list[str]]:
    text = file.read_text(encoding="utf-8-sig", errors="replace")
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    heads = [k for k, line in enumerate(lines) if re.search(r"(?i)designator|\bref", line)]
    if not heads or len(lines) > LONGEST:
        raise ValueError(
            f"{file}: no pick-and-place table; needed: a head with a column for the designator ("
            f"{', '.join(HEADS['designator'])}), for x and for y, and at most {LONGEST} rows"
        )
    head = lines[heads[0]]
    separator = max(",;\t", key=head.count)
    return list(csv.reader(lines[heads[0] :], delimiter=separator))


def _columns(head: Sequence[str], file: Path) -> dict[str, int]:
    short = [re.sub(r"\(.*?\)|[^a-z]", "", h.lower()) for h in head]
    found = {}
    for column, names in HEADS.items():
        own = [short.index(n) for n in names if n in short]
        if not own:
            raise ValueError(
                f"{file}: no column for {column}; its head is {', '.join(head)}; known: {', '.join(names)}"
            )
        found[column] = own[0]
    return found


def _mm(text: str, head: str, where: str) -> float:
    number = re.fullmatch(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(mm|mil)?\s*", text)
    try:
        value = float(number[1]) if number else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{where} = {text!r}; allowed: a number of mm, or of mil")
    unit = (number[2] if number else None) or ("mil" if "mil" in head.lower() else "mm")
    return value * (MIL if unit == "mil" else 1.0)
