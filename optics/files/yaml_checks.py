"""YAML files of other programs: plain data alone, with one clear error for what is none."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from optics.errors import BadCapture

BYTES = 20_000_000  # a hundred thousand annotations


def parse(file: Path) -> Any:
    """What a YAML file holds: tables, lists, texts and numbers. Raises BadCapture, also where a key stands twice, of
    which YAML would take the last without a word."""
    import yaml

    if file.stat().st_size > BYTES:
        raise BadCapture(f"{file}: {file.stat().st_size / 1e6:.3g} MB; allowed: up to {BYTES / 1e6:g} MB of YAML")
    try:
        return yaml.load(file.read_text(encoding="utf-8-sig"), _loader())
    except RecursionError as error:
        raise BadCapture(f"{file}: no YAML: nested too deep; write it again") from error
    except (yaml.YAMLError, ValueError) as error:
        raise BadCapture(f"{file}: no YAML ({error}); correct it, or write it again") from error


@cache
def _loader() -> type:
    import yaml

    class Loader(yaml.SafeLoader):
        def construct_mapping(self, node: Any, deep: bool = False) -> dict:
            seen = set()
            for key, _ in node.value:
                name = (key.tag, key.value) if isinstance(key, yaml.ScalarNode) else None
                if name and name in seen and key.tag != "tag:yaml.org,2002:merge":
                    raise yaml.YAMLError(f"line {key.start_mark.line + 1}: {key.value} appears twice in one table")
                seen.add(name)
            return super().construct_mapping(node, deep)

    return Loader


def number(table: Any, key: str, where: Path | str, low: float = -1e6, high: float = 1e6, default: Any = None) -> float:
    """A number of a table, from `low` to `high`. Raises BadCapture."""
    value = table.get(key, default) if isinstance(table, Mapping) else default
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise BadCapture(f"{where}: {key} = {short(value)}; allowed: a number from {low:g} to {high:g}")
    return float(value)


def short(value: Any) -> str:
    """A value as text, cut off where it is long, nested, or holds itself."""
    shown = reprlib.Repr()
    shown.maxstring = shown.maxother = 80
    shown.maxlong, shown.maxlevel = 40, 2
    try:
        return shown.repr(value)
    except ValueError:  # a whole number of thousands of digits
        return "a number beyond any use"
