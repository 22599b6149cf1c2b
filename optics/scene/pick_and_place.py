"""Where the parts of a printed circuit board stand, from the pick-and-place file that it was populated by.

    x, y = placed("board.csv:D7", folders)        mm

KiCad (CSV and ASCII), Altium, Eagle and EasyEDA write a table with a row for each part: its designator and its middle.
The heads of the columns differ (HEADS), separators are commas, semicolons, tabs or blanks, lengths are in mm unless a
head, a number or a line above the table names another unit (UNITS)."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path

HEADS = {  # in small letters, without spaces, units and signs
    "designator": ("designator", "ref", "refdes", "reference", "part"),
    "x": ("midx", "posx", "centerx", "x", "refx"),
    "y": ("midy", "posy", "centery", "y", "refy"),
}
UNITS = {  # mm
    "mm": 1.0,
    **dict.fromkeys(("mil", "mils", "thou"), 0.0254),
    **dict.fromkeys(("in", "inch", "inches"), 25.4),
    "cm": 10.0,
    **dict.fromkeys(("um", "\u00b5m", "\u03bcm"), 0.001),
}
LARGEST = 10_000.0  # mm: no board is wider
LONGEST = 10_000  # rows: no board has more parts
BYTES = 10_000_000


def placed(named: str, folders: Sequence[str | Path] = ()) -> tuple[float, float]:
    """(x, y) in mm of the part that `FILE:DESIGNATOR` names, of a file in one of these folders or below it.

    Raises ValueError, FileNotFoundError."""
    name, colon, designator = named.rpartition(":")
    if not colon or not name or not designator:
        raise ValueError(f"placed = {_short(named)!r}; allowed: FILE:DESIGNATOR, such as board.csv:D7")
    file = _file(name, folders)
    lines = list(enumerate(_text(file).splitlines(), 1))
    (above, separator, cells), columns = _head(lines, file)
    units = {c: _unit_of(cells[columns[c]], lines[:above], file) for c in "xy"}
    found: dict[int, tuple[float, float]] = {}
    there = []
    for number, line in lines[above + 1 :]:
        row = _cells(line, separator)
        if not line.strip() or line.startswith("#") or len(row) <= columns["designator"]:
            continue
        there.append(row[columns["designator"]])
        if there[-1] != designator:
            continue
        if len(row) <= max(columns.values()):
            raise ValueError(
                f"{file}: line {number}: {len(row)} columns of {len(cells)}; needed: {designator}'s x and y"
            )
        x, y = (_mm(row[columns[c]], units[c], separator, f"{file}: line {number}: {c}") for c in "xy")
        found[number] = (x, y)
    if not found:
        raise ValueError(f"{file}: no part '{_short(designator)}'; it has {_few(there) or 'no parts'}")
    if len(set(found.values())) > 1:
        raise ValueError(
            f"{file}: '{designator}' appears several times, in lines {', '.join(map(str, found))}; allowed: one; "
            "name parts of several boards apart"
        )
    return next(iter(found.values()))


def _file(name: str, folders: Sequence[str | Path]) -> Path:
    """A file by its name, in the first of these folders that has it; one outside of them all is refused unread."""
    places = [Path(folder).resolve() for folder in folders] or [Path.cwd()]
    try:
        file = next((f for f in (place / name for place in places) if f.is_file()), None)
    except OSError:  # a name that no system allows
        file = None
    if file is None:
        raise FileNotFoundError(
            f"{_short(name)}: no such file in {places[0]}; allowed: a pick-and-place file beside the scene's XML"
        )
    if not any(file.resolve().is_relative_to(place) for place in places):
        raise ValueError(
            f"{name}: lies outside {places[0]}, at {file.resolve()}; allowed: a file beside the scene's XML, or in a "
            "folder below; copy it there"
        )
    return file


def _text(file: Path) -> str:
    with open(file, "rb") as opened:
        data = opened.read(BYTES + 1)
    text = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig", errors="replace")
    if len(data) > BYTES or text.count("\n") > LONGEST:
        raise ValueError(f"{file}: no pick-and-place table: over {LONGEST} rows, or over {BYTES / 1e6:g} MB")
    return text


def _head(lines: Sequence[tuple[int, str]], file: Path) -> tuple[tuple[int, str, list[str]], dict[str, int]]:
    """((its place in the lines, separator, cells), column of each of HEADS) of the first line that has them all."""
    nearly: tuple[list[str], str] | None = None
    for place, (_, line) in enumerate(lines):
        for separator in (",", ";", "\t", " "):
            cells = _cells(line.lstrip("# ") if separator == " " else line, separator)
            short = [_named(cell)[0] for cell in cells]
            columns = {
                c: short.index(own[0]) for c, names in HEADS.items() if (own := [n for n in names if n in short])
            }
            missing = [c for c in HEADS if c not in columns]
            if not missing:
                return (place, separator, cells), columns
            if "designator" in columns and len(cells) > 1 and nearly is None:
                nearly = cells, missing[0]
    if nearly is not None:
        cells, column = nearly
        raise ValueError(
            f"{file}: no column for {column}; its head is {_few(cells)}; known: {', '.join(HEADS[column])}"
        )
    raise ValueError(
        f"{file}: no pick-and-place table; needed: a head with a column for the designator "
        f"({', '.join(HEADS['designator'])}), for x and for y, separated by commas, semicolons, tabs or blanks"
    )


def _cells(line: str, separator: str) -> list[str]:
    """A line's cells. Lines are read one by one: a quote that is left open ends with its line."""
    if separator == " ":
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error:  # a cell longer than any place
        return []


def _named(head: str) -> tuple[str, str]:
    """(name, unit) of a column's head: in brackets or behind the name, '' without one."""
    head = head.strip().lower()
    unit = re.search(r"[(\[]\s*(.*?)\s*[)\]]", head)
    name = re.sub(r"[(\[].*?[)\]]|[^a-z\u00b5\u03bc]", "", head)
    if unit is None:
        for known in (n for names in HEADS.values() for n in names):
            if name.startswith(known) and name[len(known) :] in UNITS:
                return known, name[len(known) :]
    return name, "" if unit is None else unit[1]


def _unit_of(head: str, above: Sequence[tuple[int, str]], file: Path) -> float:
    """mm of a column's unit, by its head or else by a line above the table, such as 'Units used: mil'."""
    unit = _named(head)[1]
    for _, line in above:
        said = re.search(r"(?i)\bunits?(?: used)?\s*[:=]\s*(\w+)", line)
        unit = unit or (said[1].lower() if said else "")
    if unit and unit not in UNITS:
        raise ValueError(f"{file}: unit '{_short(unit)}' of the column '{_short(head)}'; allowed: {', '.join(UNITS)}")
    return UNITS[unit or "mm"]


def _mm(text: str, unit: float, separator: str, where: str) -> float:
    number = re.fullmatch(
        r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-z\u00b5\u03bc]*)", _point(text, separator), re.ASCII
    )
    own = number[2].lower() if number else ""
    if number is None or (own and own not in UNITS):
        raise ValueError(f"{where} = {_short(text)!r}; allowed: a number, in mm or with a unit: {', '.join(UNITS)}")
    value = float(number[1]) * (UNITS[own] if own else unit)
    if not abs(value) <= LARGEST:
        raise ValueError(f"{where} = {value:g} mm; allowed: {-LARGEST:g} to {LARGEST:g} mm; check its unit")
    return value


def _point(text: str, separator: str) -> str:
    """A decimal comma as a point, where commas part nothing."""
    return text if separator == "," or text.count(",") != 1 or "." in text else text.replace(",", ".")


def _short(text: str, most: int = 60) -> str:
    return text if len(text) <= most else f"{text[:most]} ..."


def _few(names: Sequence[str]) -> str:
    return ", ".join(_short(name, 30) for name in names[:12]) + " ..." * (len(names) > 12)
