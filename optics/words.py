"""How names, numbers and tables read in a terminal."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Sequence


def table(rows: Sequence[Sequence[str]], left: Collection[int] | None = None) -> str:
    """Aligned columns, two spaces apart; `left`: those that begin at the left (None: all), the others end at the
    right."""
    widths = [max(len(cell) for cell in column) for column in zip(*rows)]
    return "\n".join(
        "  ".join(
            cell.ljust(w) if left is None or i in left else cell.rjust(w)
            for i, (cell, w) in enumerate(zip(row, widths))
        ).rstrip()
        for row in rows
    )


def some(names: Sequence[str], most: int = 5, between: str = ", ") -> str:
    """The first few names, and how many more there are."""
    return between.join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def key_of(name: str) -> str:
    """A name as one word, for the command line and for folders: 'lens vignetting' -> 'lens-vignetting'."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def spaced(unit: str) -> str:
    """A unit to stand behind a number: ' mm', or nothing for a pure number."""
    return "" if unit in ("", "1") else f" {unit}"


def percent(x: float) -> str:
    """0.0123 -> '1.23 %'; '-' for what is no number."""
    return "-" if x is None or not math.isfinite(x) else f"{100 * x:.3g} %"


def p_text(p: float) -> str:
    """A probability, in two digits."""
    return "?" if math.isnan(p) else "<1e-9" if p < 1e-9 else f"{p:.1e}" if p < 1e-3 else f"{p:.2g}"


def with_sd(x: float, sd: float) -> str:
    """0.3142, 0.0123 -> '0.314 +- 0.012': two digits of the standard deviation."""
    if not (math.isfinite(sd) and sd > 0):
        return f"{x:.3g}"
    digits = max(0, 1 - math.floor(math.log10(sd)))
    digits = min(digits, 12)
    return f"{round(x, digits) + 0.0:.{digits}f} +- {sd:.{digits}f}"  # + 0.0: -0.0 reads 0.0
