"""How names, numbers and tables are written: in a terminal, on a page (`typeset`), in a notebook."""

from __future__ import annotations

import html
import math
import re
import textwrap
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

NARROWEST = 7  # characters of a column that is broken over lines
PROSE = 30  # characters of a line of prose in a table: what is narrower is hard to read
FILLED = 90  # characters from which on a line of a page, of at most 120, goes on in the next
UNBROKEN = 14  # characters of a word or number that stays whole, where the line has room for all of these


_room: ContextVar[int | None] = ContextVar("room", default=None)  # characters of a line of the terminal


@contextmanager
def fitting(width: int | None) -> Iterator[None]:
    """Within, tables are at most so wide, where their columns allow it; None: as wide as they are."""
    token = _room.set(width)
    try:
        yield
    finally:
        _room.reset(token)


def table(rows: Sequence[Sequence[str]], left: Collection[int] | None = None) -> str:
    """Aligned columns, two spaces apart; `left`: columns that begin at the left (None: all), the others end at the
    right.

    Where there is a terminal (`fitting`), cells of the widest columns go over several lines, so that a row fits; where
    one space between columns leaves more words whole, it is one."""
    return "\n".join(line for row in _laid_out(rows, left) for line in row)


def fits(rows: Sequence[Sequence[str]]) -> bool:
    """Whether a table fits the terminal with all of its cells on one line."""
    width = _room.get()
    return width is None or _across([max(map(len, column)) for column in zip(*rows)], 2) <= width


def _across(widths: Sequence[int], between: int) -> int:
    """Characters of a row of columns."""
    return sum(widths) + between * (len(widths) - 1)


def _laid_out(rows: Sequence[Sequence[str]], left: Collection[int] | None = None) -> list[list[str]]:
    """The lines of each row of a table; names of files may hold what would break a line."""
    rows = [[_CONTROL.sub("?", cell) for cell in row] for row in rows]
    widths, width = [max(len(cell) for cell in column) for column in zip(*rows)], _room.get()
    limits, between = widths, 2
    if width is not None and _across(widths, between) > width:
        limits, between = _limits(rows, widths, width)
    broken = [[textwrap.wrap(c, m) or [""] if len(c) > m else [c] for c, m in zip(row, limits)] for row in rows]
    widths = [max(len(line) for row in broken for line in row[i]) for i in range(len(widths))]

    def line(cells: Sequence[str]) -> str:
        placed = (
            c.ljust(w) if left is None or i in left else c.rjust(w) for i, (c, w) in enumerate(zip(cells, widths))
        )
        return (" " * between).join(placed).rstrip()

    return [[line(cells) for cells in zip_longest(*row, fillvalue="")] for row in broken]


def _limits(rows: Sequence[Sequence[str]], widths: Sequence[int], width: int) -> tuple[list[int], int]:
    """How wide each column may be, and the spaces between two: the widest columns give way first, and words and numbers
    stay whole where that is enough."""

    def whole(cell: str) -> int:
        parts = [cell] if _NUMBER.fullmatch(cell) else cell.split()
        return min(max(map(len, parts), default=0), UNBROKEN)

    floors, narrowest = [max(map(whole, column)) for column in zip(*rows)], [NARROWEST] * len(widths)
    for least, between in ((floors, 2), (floors, 1), (narrowest, 2), (narrowest, 1)):
        for cap in range(max(widths), 0, -1):
            limits = [max(cap, floor) for floor in least]
            if _across([*map(min, widths, limits)], between) <= width:
                return limits, between
    return narrowest, 1


def annotated(rows: Sequence[Sequence[str]], short: Sequence[Sequence[str]], notes: Sequence[str]) -> str:
    """A table whose last column is prose, beside the others; or, where the line leaves less than PROSE characters for
    it, the `short` rows, each with its note under it."""
    width = _room.get()
    others = [max(len(cell) for cell in column) for column in list(zip(*rows))[:-1]]
    if width is None or sum(others) + 2 * len(others) + PROSE <= width:
        return table(rows)
    indent = " " * 4
    below = [textwrap.wrap(note, max(width, PROSE), initial_indent=indent, subsequent_indent=indent) for note in notes]
    return "\n".join(text for row, note in zip(_laid_out(short), below) for text in (*row, *note))


def wrapped(text: str) -> str:
    """Text whose lines are broken between words where the terminal ends (`fitting`), and go on below where they began;
    without one, as it is."""
    return "\n".join(part for line in text.split("\n") for part in _broken(line))


def reflowed(page: str) -> str:
    """A page of prose and formulas for the terminal: paragraphs are filled anew, lines with columns are broken."""
    width = _room.get()
    if width is None:
        return page
    source, lines = page.split("\n"), [""]
    for before, line, after in zip(["", *source], source, [*source[1:], ""]):
        heads = _indent(after) > _indent(line)
        if _goes_on(before) and _is_prose(line) and not heads and _indent(line) == _indent(before):
            lines[-1] += f" {line.strip()}"
        else:
            lines.append(line)
    return wrapped("\n".join(lines[1:]))


def _goes_on(line: str) -> bool:
    """Whether its writer broke this line of prose because it was full."""
    return _is_prose(line) and len(line) >= FILLED


def _is_prose(line: str) -> bool:
    """Whether a line has words, and neither columns nor the mark of a list."""
    text = line.strip()
    return bool(text) and "   " not in text and not re.match(r"[-*|#=~+]|\d+\.", text)


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip())


def _broken(line: str) -> list[str]:
    width = _room.get()
    if width is None or len(line) <= width:
        return [line]
    indent = " " * min(_indent(line), width // 2)
    return textwrap.wrap(
        line.strip(),
        width,
        initial_indent=indent,
        subsequent_indent=indent if _is_prose(line) else f"{indent}    ",
        break_long_words=False,
        break_on_hyphens=False,
    )


_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")
_NUMBER = re.compile(r"[-+]?[\d.]\S*( \S{1,3})?")  # with its unit


def some(names: Sequence[str], most: int = 5, between: str = ", ") -> str:
    """The first few names, and how many more there are."""
    return between.join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def key_of(name: str) -> str:
    """A name as one word, for the command line and for folders: 'lens vignetting' -> 'lens-vignetting'."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def spaced(unit: str) -> str:
    """A unit to stand behind a number: ' mm', or nothing for a pure number."""
    return "" if unit in ("", "1") else f" {unit}"


def number(value: object, digits: int = 3, typeset: bool = False) -> str:
    """0.012345 -> '0.0123'; a word stays as it is; '-' for what is missing.

    typeset   a true minus, powers of ten, groups of thousands, a dash for what is missing
    """
    if isinstance(value, str) and not typeset:
        return value
    x = as_float(value)
    if not typeset:
        return "-" if math.isnan(x) else f"{x:.{digits}g}"
    if not math.isfinite(x):
        return "–" if math.isnan(x) else "∞" if x > 0 else "−∞"
    size = abs(x)
    if size and (size >= 1e6 or size < 1e-4):
        mantissa, power = f"{x:.{max(digits - 2, 0)}e}".split("e")
        text = f"{mantissa}·10{str(int(power)).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))}"
    elif round(size) >= 10**digits:  # 99.7 in two digits is 100
        text = f"{x:,.0f}".replace(",", "\u202f")
    else:
        text = f"{x:.{digits}g}"
    return text.replace("-", "−")


def figures(value: object, digits: int = 4) -> str:
    """Like a typeset `number`, with closing zeros, so that a column lines up."""
    x = as_float(value)
    if not math.isfinite(x) or round(abs(x)) >= 10**digits or 0 < abs(x) < 1e-3:
        return number(x, digits, typeset=True)
    return f"{x:#.{digits}g}".rstrip(".").replace("-", "−")


def fixed(value: object, places: int) -> str:
    """A typeset number with so many decimal places."""
    x = as_float(value)
    return f"{x:.{places}f}".replace("-", "−") if math.isfinite(x) else number(x, typeset=True)


def percent(value: object, digits: int = 3, typeset: bool = False) -> str:
    """0.0123 -> '1.23 %'; '-' for what is no finite number."""
    x = as_float(value)
    if not math.isfinite(x):
        return "–" if typeset else "-"
    return f"{figures(100 * x, digits)}\u202f%" if typeset else f"{100 * x:.{digits}g} %"


def share_text(share: object, typeset: bool = False) -> str:
    """A part of a whole in whole per cent, 0 to 100: what noise puts beyond either end is the end."""
    x = as_float(share)
    if math.isnan(x):
        return "–" if typeset else "-"
    return f"{min(max(x, 0.0), 1.0):.0%}".replace("%", "\u202f%" if typeset else "%")


def p_text(p: object, typeset: bool = False) -> str:
    """A probability, in two digits."""
    x = as_float(p)
    if typeset:
        return "< 10⁻⁹" if x < 1e-9 else number(x, 2, typeset=True)
    return "?" if math.isnan(x) else "<1e-9" if x < 1e-9 else f"{x:.1e}" if x < 1e-3 else f"{x:.2g}"


# -- numbers that mean something -------------------------------------------------------------------------------------
NOT_DETERMINED, ERROR_UNKNOWN, NO_LIMIT = "not determined", "error unknown", "no limit"
BEYOND = 10.0  # plausible sizes: a limit above it excludes nothing that anybody would expect
UNBOUNDED = 1000.0  # plausible sizes that stand for the range of a parameter without bounds


@dataclass(frozen=True)
class Reach:
    """What a parameter's value can be: its bounds and its plausible size, in its unit. NaN: not known."""

    low: float = -math.inf
    high: float = math.inf
    plausible: float = math.nan

    @property
    def width(self) -> float:
        """high - low; without bounds, UNBOUNDED plausible sizes; infinite where these are not known."""
        if math.isfinite(self.high - self.low):
            return self.high - self.low
        return math.inf if math.isnan(self.plausible) else UNBOUNDED * abs(self.plausible)

    def holds(self, value: object, sd: object = 0.0) -> bool:
        """Whether an estimate says anything: it is finite and within its bounds, and its error is less than their
        width. An error that is not known (NaN) is no reason against it."""
        x, s = as_float(value), as_float(sd)
        slack = 1e-6 * self.width if math.isfinite(self.width) else 0.0  # of rounding, for what stands at a bound
        return math.isfinite(x) and self.low - slack <= x <= self.high + slack and not s >= self.width

    def excludes(self, limit: object, start: object = 0.0) -> bool:
        """Whether an upper limit of the change from `start` rules anything out: it is finite, some value within bounds
        lies beyond it, and it is below BEYOND plausible sizes."""
        x, at = as_float(limit), as_float(start)
        farthest = max(self.high - at, at - self.low)
        return math.isfinite(x) and x < farthest and not x > BEYOND * abs(self.plausible)


ANYWHERE = Reach()


def with_sd(value: object, sd: object, typeset: bool = False, unit: str = "", reach: Reach = ANYWHERE) -> str:
    """0.3142, 0.0123 -> '0.314 +- 0.012': both rounded at the second digit of the standard deviation.

    'not determined' in place of a number that says nothing: it is not finite, lies beyond the bounds of its parameter,
    or its standard deviation is infinite or larger than the bounds are wide. 'error unknown' where the standard
    deviation is not a number. A standard deviation of 0 is left out: the value is not an estimate.
    """
    x, s = as_float(value), as_float(sd)
    if not reach.holds(x, s):
        return NOT_DETERMINED
    return _rounded(x, s, typeset) + spaced(unit) + (f" ({ERROR_UNKNOWN})" if math.isnan(s) else "")


def _rounded(x: float, s: float, typeset: bool) -> str:
    if not s > 0:
        return number(x, 5, typeset=True) if typeset else f"{x:.3g}"
    places = max(0, 1 - math.floor(math.log10(s)))
    if not typeset:
        places = min(places, 12)
        return f"{round(x, places) + 0.0:.{places}f} +- {s:.{places}f}"  # + 0.0: -0.0 reads 0.0
    if places > 7 or s >= 1e5:
        return f"{number(x, 4, typeset=True)} ± {number(s, 2, typeset=True)}"
    return f"{round(x, places) + 0.0:.{places}f} ± {s:.{places}f}".replace("-", "−")


def below(
    limit: object, typeset: bool = False, unit: str = "", reach: Reach = ANYWHERE, start: object = 0.0, digits: int = 2
) -> str:
    """An upper limit of the change from `start`: '< 0.55 deg', or 'no limit' where it rules nothing out."""
    return f"< {number(limit, digits, typeset)}{spaced(unit)}" if reach.excludes(limit, start) else NO_LIMIT


def times_sd(value: object) -> str:
    """A difference in standard deviations: '+3.1 sd'; 'error unknown' where there is no such number."""
    x = as_float(value)
    return f"{x:+.1f} sd" if math.isfinite(x) else ERROR_UNKNOWN


def as_float(value: Any) -> float:
    """A number as float; NaN for None and for what is no number. Infinities stay."""
    try:
        return math.nan if value is None else float(value)
    except (TypeError, ValueError):
        return math.nan


# -- a notebook ------------------------------------------------------------------------------------------------------
SMALL = "font-size:90%;opacity:.75"


def html_table(head: Sequence[str], rows: Sequence[Sequence[str]], left: Collection[int] = (0,)) -> str:
    """A table for a notebook, escaped, without a style sheet; `left`: columns that begin at the left."""

    def line(cells: Sequence[str], tag: str) -> str:
        sides = ["left" if i in left else "right" for i in range(len(cells))]
        aligned = (
            f'<{tag} style="text-align:{side};padding:1px 8px">{html.escape(str(cell))}</{tag}>'
            for side, cell in zip(sides, cells)
        )
        return f"<tr>{''.join(aligned)}</tr>"

    body = "".join(line(row, "td") for row in rows)
    return f'<table style="border-collapse:collapse">{line(head, "th")}{body}</table>'


def html_block(title: str, *parts: str, note: str = "") -> str:
    """A titled block for a notebook: `title` and `note` are escaped, `parts` are HTML already."""
    below = f'<div style="{SMALL}">{html.escape(note)}</div>' if note else ""
    return f"<div><b>{html.escape(title)}</b>{below}{''.join(parts)}</div>"


def escaped(text: str) -> str:
    """Text that may stand in HTML."""
    return html.escape(text)


def html_list(texts: Sequence[str]) -> str:
    """Sentences as a list for a notebook, escaped; nothing for none."""
    return f"<ul>{''.join(f'<li>{html.escape(t)}</li>' for t in texts)}</ul>" if texts else ""
