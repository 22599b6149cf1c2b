"""Point readings (photodiode, lux meter) as instruments write them: one row per reading, one column per setting or
channel."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from optics.errors import BadCapture, UnknownKey

DELIMITERS = (",", ";", "\t", " ")  # a blank stands for any run of blanks
DECIMALS = (".", ",")
NAMES = {",": "commas", ";": "semicolons", "\t": 'tabs ("\\t")', " ": 'blanks (" ")'}
LARGEST = float(np.finfo(np.float32).max)  # of a cell: readings are single precision
FINEST = 7  # decimal places: what readings of single precision hold


@dataclass
class Table:
    """Point readings: one row per frame. Columns go by their names in the file, or by those that `rename` gives.

    file         path, relative to the folder of the capture set
    values       columns that hold readings, one per channel
    rename       column -> parameter key
    delimiter    between cells: ",", ";", a tab, or " " for any run of blanks;   decimal: mark, "." or ","
    skip         lines before the line of column names
    group        column whose text names the group that is held out together; "": none
    scale, offset   column -> number; a cell becomes scale * cell + offset. Settings: to the parameter's unit. Readings:
                 the scale that the noise is stated in
    uncertainty  parameter key -> column with the standard deviation of that setting, in the key's unit
    ignore       columns that are passed over, such as another series of readings
    """

    file: str
    values: list[str]
    rename: dict[str, str] = field(default_factory=dict)
    scale: dict[str, float] = field(default_factory=dict)
    delimiter: str = ","
    decimal: str = "."
    skip: int = 0
    group: str = ""
    offset: dict[str, float] = field(default_factory=dict)
    uncertainty: dict[str, str] = field(default_factory=dict)
    ignore: list[str] = field(default_factory=list)


@dataclass
class Row:
    """A reading: settings by key, the reading per channel, its group (None: none), and what is known of its settings.

    uncertainty   standard deviation of a setting by key, in the key's unit
    """

    settings: dict[str, float | str]
    values: list[float]
    group: str | None = None
    uncertainty: dict[str, float] = field(default_factory=dict)


def read(file: Path, table: Table, where: str) -> tuple[list[Row], float]:
    """(rows of a file, step of its readings): the step is one unit of the last decimal place that readings are written
    with, times the scale, the coarsest of all channels; 0 where that is beyond single precision.

    Raises BadCapture, and UnknownKey for a column that the file lacks.
    """
    lines = _cells(file, table)
    columns, table = _columns(file, lines[0], table, where)
    numbers = {*table.values, *table.scale, *table.offset, *table.uncertainty.values()}
    spread = {column: key for key, column in table.uncertainty.items()}
    found, step = [], 0.0
    for index, cells in enumerate(lines[1:]):
        here = f"{file}: frame {index}"
        if len(cells) != len(columns):
            raise BadCapture(
                f"{here}: {len(cells)} cells {cells}; allowed: {len(columns)}, one per column; correct the row"
            )
        row = Row({}, [])
        values: dict[str, float] = {}
        for column, text in zip(columns, cells):
            if column in table.ignore:
                continue
            if column == table.group:
                if not text:
                    raise BadCapture(f"{here}: {column} = ''; allowed: the name of a group in every row")
                row.group = text
                continue
            cell = _cell(text, column, column in numbers, table.decimal, here)
            if column in table.scale or column in table.offset:
                cell = float(cell) * table.scale.get(column, 1.0) + table.offset.get(column, 0.0)
            if column in table.values:
                values[column] = float(cell)
            elif column in spread:
                if float(cell) < 0:
                    raise BadCapture(
                        f"{here}: {column} = {cell:g}, the uncertainty of {spread[column]}; allowed: 0 or more"
                    )
                row.uncertainty[spread[column]] = float(cell)
            else:
                row.settings[column] = cell
        row.values = [values[column] for column in table.values]
        found.append(row)
    for column in table.values:
        place = columns.index(column)
        step = max(step, abs(table.scale.get(column, 1.0)) * _step([c[place] for c in lines[1:]], table.decimal))
    return found, step


def _cells(file: Path, table: Table) -> list[list[str]]:
    """The cells of every line that is not blank, the line of column names first."""
    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
        if table.skip >= len(lines):
            raise BadCapture(f"{file}: skip = {table.skip}, but it has {len(lines)} lines; allowed: fewer")
        lines = [line for line in lines[table.skip :] if line.strip()]
        if table.delimiter == " ":
            rows = [line.split() for line in lines]
        else:
            rows = [
                [cell.strip() for cell in row]
                for row in csv.reader(lines, delimiter=table.delimiter)
                if any(map(str.strip, row))
            ]
    except (csv.Error, UnicodeDecodeError) as error:
        raise BadCapture(f"{file}: unreadable as a table: {error}; save it as UTF-8 text") from error
    if len(rows) < 2:
        raise BadCapture(f"{file}: zero frames; allowed: a line of column names, then a row per frame")
    if len(rows[0]) == 1:
        found = next((mark for mark in DELIMITERS if mark != table.delimiter and mark in rows[0][0]), None)
        if found:
            raise BadCapture(
                f"{file}: its cells are separated by {found!r}, not by {NAMES[table.delimiter]}; allowed: "
                f"delimiter = {_toml(found)} under [table]; skip = N passes over N lines before the column names"
            )
    if rows[0][-1] == "" and len(rows[0]) > 1:  # a delimiter at the end of every line
        rows = [row[:-1] if len(row) == len(rows[0]) and row[-1] == "" else row for row in rows]
    return rows


def _toml(mark: str) -> str:
    return '"\\t"' if mark == "\t" else f'"{mark}"'


def _columns(file: Path, header: Sequence[str], table: Table, where: str) -> tuple[list[str], Table]:
    """(names of the columns after `rename`, the table in these names)."""
    for column in table.rename:
        if column not in header:
            raise UnknownKey(column, header, "column", f"{where}: rename", f"the columns of {file}, before rename")
    columns = [table.rename.get(column, column) for column in header]

    def named(column: str, what: str, known: Sequence[str]) -> str:
        column = column if column in known else table.rename.get(column, column)
        if column not in known:
            raise UnknownKey(column, known, "column", f"{where}: {what}", f"the columns of {file}, after rename")
        return column

    values = [named(column, "values", columns) for column in table.values]
    group = named(table.group, "group", columns) if table.group else ""
    spread = {key: named(column, "uncertainty", columns) for key, column in table.uncertainty.items()}
    if len(set(columns)) < len(columns) or len(set(values)) < len(values) or "" in columns:
        raise BadCapture(f"{file}: columns {columns}, values {values}; allowed: each name once, none empty; rename one")
    ignore = [named(column, "ignore", columns) for column in table.ignore]
    roles = [*values, *([group] if group else []), *spread.values(), *ignore]
    if len(set(roles)) < len(roles):
        raise BadCapture(
            f"{where}: the column '{max(roles, key=roles.count)}' is named twice, of values, group, uncertainty and "
            "ignore; "
            "allowed: one of these"
        )
    settings = [column for column in columns if column not in roles]
    for key in spread:
        if key not in settings:
            raise UnknownKey(key, settings, "setting", f"{where}: uncertainty", f"the columns of {file}, after rename")
    numbers = [column for column in columns if column != group and column not in ignore]
    scale = {named(column, "scale", numbers): factor for column, factor in table.scale.items()}
    offset = {
        named(column, "offset", [c for c in numbers if c not in spread.values()]): shift
        for column, shift in table.offset.items()
    }
    return columns, Table(
        table.file,
        values,
        table.rename,
        scale,
        table.delimiter,
        table.decimal,
        table.skip,
        group,
        offset,
        spread,
        ignore,
    )


def _cell(text: str, column: str, number: bool, decimal: str, where: str) -> float | str:
    plain = text
    if decimal == ",":
        plain = text.replace(",", ".") if "." not in text else text.replace(",", "?")
    try:
        value = float(plain.replace("_", "?"))  # Python reads 1_0 as 10
    except ValueError:
        if not number and text:
            return text  # a choice, such as the name of an indenter
        other = "," if decimal == "." else "."
        hint = f'; decimal = "{other}" under [table] reads it' if _reads(text, other) else "; correct the row"
        raise BadCapture(f"{where}: {column} = '{text}' is no number; allowed: finite numbers{hint}") from None
    if not abs(value) <= LARGEST:
        raise BadCapture(f"{where}: {column} = {text}; allowed: finite numbers; correct the row or remove it")
    return value


def _reads(text: str, decimal: str) -> bool:
    """Whether a text is a number with this decimal mark."""
    try:
        float(text.replace(decimal, "."))
    except ValueError:
        return False
    return text.count(decimal) == 1


def _step(texts: Sequence[str], decimal: str) -> float:
    """One unit of the last decimal place of numbers as they are written; 1 of whole numbers; 0 beyond FINEST places."""
    places = 0
    for text in texts:
        mantissa, _, exponent = text.lower().partition("e")
        digits = len(mantissa.partition(decimal)[2].rstrip("0"))
        places = max(places, digits - int(exponent or 0))
    return 10.0**-places if places <= FINEST else 0.0


# -- Writing ---------------------------------------------------------------------------------------------------------
def write(file: Path, rows: Sequence[Row], values: Sequence[str]) -> tuple[str, dict[str, str]]:
    """Write rows that all have the same settings, in commas and points; returns the column of groups ("" without) and
    {key: column} of uncertainties. Readings are written with the digits that single precision holds.

    Raises BadCapture where the rows differ in what they have."""
    keys, spread = list(rows[0].settings), list(rows[0].uncertainty)
    grouped = rows[0].group is not None
    for index, row in enumerate(rows):
        if set(row.settings) != set(keys):
            raise BadCapture(
                f"frame {index} sets {sorted(row.settings)}; allowed in a table: {sorted(keys)}, as frame 0"
            )
        if set(row.uncertainty) != set(spread) or (row.group is not None) != grouped:
            raise BadCapture(
                f"frame {index} has the group {row.group!r} and uncertainties of {sorted(row.uncertainty)}; allowed in "
                f"a table: those of frame 0, {rows[0].group!r} and {sorted(spread)}"
            )
    taken = {*keys, *values}
    group = _free("group", taken) if grouped else ""
    columns = {key: _free(f"sd {key}", taken) for key in spread}
    header = [*keys, *([group] if grouped else []), *columns.values(), *values]
    lines: list[list[object]] = [
        [
            *(row.settings[key] for key in keys),
            *([row.group] if grouped else []),
            *(row.uncertainty[key] for key in spread),
            *(value if isinstance(value, str) else str(np.float32(value)) for value in row.values),
        ]
        for row in rows
    ]
    with file.open("w", newline="", encoding="utf-8") as stream:
        csv.writer(stream).writerows([header, *lines])
    return group, columns


def _free(name: str, taken: set[str]) -> str:
    """A column name that is not taken yet, and now is."""
    while name in taken:
        name += "_"
    taken.add(name)
    return name
