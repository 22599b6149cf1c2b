"""Point readings (photodiode, lux meter) as CSV: one row per frame, one column per setting or channel."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from optics.errors import BadCapture, UnknownKey

Row = tuple[dict[str, float | str], list[float]]  # (settings by key, reading per channel)


def read(
    file: Path, values: Sequence[str], rename: Mapping[str, str], scale: Mapping[str, float], where: str
) -> list[Row]:
    """Rows of a comma-separated file; `values` and `scale` speak of columns after `rename`; `scale` multiplies
    settings.

    Raises BadCapture, and UnknownKey for a column that the file lacks.
    """
    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
        rows = [row for row in csv.reader(lines) if any(map(str.strip, row))]
    except (csv.Error, UnicodeDecodeError) as error:
        raise BadCapture(f"{file}: unreadable as CSV: {error}; save it as UTF-8 with commas") from error
    if len(rows) < 2:
        raise BadCapture(f"{file}: zero frames; allowed: a line of column names, then a row per frame, with commas")
    columns = [column.strip() for column in rows[0]]
    if len(columns) == 1 and (found := next((mark for mark in ";\t" if mark in rows[0][0]), None)):
        raise BadCapture(
            f"{file}: its cells are separated by {found!r}; allowed: commas, and points in decimal numbers; save it as "
            "such"
        )
    for column in rename:
        if column not in columns:
            raise UnknownKey(column, columns, "column", f"{where}: rename", f"the columns of {file}, before rename")
    columns = [rename.get(column, column) for column in columns]
    settings = [column for column in columns if column not in values]
    for what, wanted, known in (("values", values, columns), ("scale", scale, settings)):
        for column in wanted:
            if column not in known:
                raise UnknownKey(column, known, "column", f"{where}: {what}", f"the columns of {file}, after rename")
    if len(set(columns)) < len(columns) or len(set(values)) < len(values) or "" in columns:
        raise BadCapture(
            f"{file}: columns {columns}, values {list(values)}; allowed: each name once, none empty; rename one"
        )
    found = []
    for index, row in enumerate(rows[1:]):
        here = f"{file}: frame {index}"
        if len(row) != len(columns):
            raise BadCapture(
                f"{here}: {len(row)} cells {row}; allowed: {len(columns)}, one per column; correct the row"
            )
        cells = {c: _cell(text.strip(), c, c in values or c in scale, here) for c, text in zip(columns, row)}
        found.append(
            ({c: cells[c] * scale[c] if c in scale else cells[c] for c in settings}, [cells[c] for c in values])
        )
    return found


def _cell(text: str, column: str, number: bool, where: str) -> float | str:
    try:
        value = float(text)
    except ValueError:
        if not number and text:
            return text  # a choice, such as the name of an indenter
        raise BadCapture(
            f"{where}: {column} = '{text}' is no number; allowed: finite numbers; correct the row"
        ) from None
    if not math.isfinite(value):
        raise BadCapture(f"{where}: {column} = {text}; allowed: finite numbers; correct the row or remove it")
    return value


def write(file: Path, rows: Sequence[Row], values: Sequence[str]) -> None:
    """Write rows that all have the same settings; raises BadCapture where they have not."""
    keys = list(rows[0][0])
    for index, (settings, _) in enumerate(rows):
        if set(settings) != set(keys):
            raise BadCapture(f"frame {index} sets {sorted(settings)}; allowed in a table: {sorted(keys)}, as frame 0")
    with file.open("w", newline="", encoding="utf-8") as stream:
        csv.writer(stream).writerows([[*keys, *values], *([*(s[key] for key in keys), *v] for s, v in rows)])
