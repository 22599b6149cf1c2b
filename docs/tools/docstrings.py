"""Docstrings as the API pages show them: plain text becomes paragraphs, aligned columns and formulas stay as they are.

The docstrings of this project are written for a reader of the source: no markup but `backticks`, formulas and tables of
attributes indented or in columns. Read as reStructuredText they would raise warnings and lose their shape."""

from __future__ import annotations

import re

COLUMNS = re.compile(r"\S {2,}\S")  # two or more spaces within a line: a column, which a paragraph would close up


def reshaped(lines: list[str]) -> list[str]:
    """reStructuredText that shows plain text as it stands."""
    paragraphs: list[list[str]] = [[]]
    for line in lines:
        if line.strip():
            paragraphs[-1].append(line)
        else:
            paragraphs.append([])
    found: list[str] = []
    for own in paragraphs:
        if any(line.startswith("  ") or COLUMNS.search(line) for line in own):
            found += [".. code-block:: text", "   :class: wrapped", "", *(f"   {line}" for line in own), ""]
        else:
            found += [*(escaped(line) for line in own), ""]
    return found


def escaped(line: str) -> str:
    """A line without markup; `code` becomes ``code``."""
    pieces = re.split(r"(`[^`]+`)", line)
    return "".join(f"`{p}`" if p.startswith("`") and len(p) > 1 else re.sub(r"([\\*_|`])", r"\\\1", p) for p in pieces)


def process(app, what, name, obj, options, lines) -> None:
    lines[:] = reshaped(lines)


def setup(app) -> None:
    app.connect("autodoc-process-docstring", process)
