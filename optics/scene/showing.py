"""A scene as plain records, and in a notebook."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from optics import words

if TYPE_CHECKING:
    from optics.scene.loader import Scene


def records(scene: Scene) -> list[dict[str, Any]]:
    """One record per parameter: key, part, kind, value, unit, low, high, neutral, plausible, meaning.

    kind   of the part (led, gel, ...), '' for a stock Mitsuba plugin; low, high: None for a choice among words
    """
    values = scene.values()
    out = []
    for key, p in scene.parameters.items():
        name = key.rsplit(".", 1)[0]
        low, high = p.bounds if p.is_number else (None, None)
        out.append(
            {
                "key": key,
                "part": name,
                "kind": scene.parts[name].kind if name in scene.parts else "",
                "value": values[key],
                "unit": p.unit,
                "low": low,
                "high": high,
                "neutral": p.neutral,
                "plausible": p.plausible if p.is_number else None,
                "meaning": p.doc,
            }
        )
    return out


def html(scene: Scene) -> str:
    """What a notebook shows of a scene: its parts, and their parameters folded away."""
    rows = records(scene)
    blocks = []
    for name, part in scene.parts.items():
        own = [r for r in rows if r["part"] == name]
        lines = [
            (
                r["key"],
                words.number(r["value"], 6)
                if isinstance(r["value"], str)
                else words.number(r["value"], 6, typeset=True),
                r["unit"] if words.spaced(r["unit"]) else "",
                _bounds(r["low"], r["high"]),
                r["meaning"],
            )
            for r in own
        ]
        table = words.html_table(("key", "value", "unit", "bounds", "meaning"), lines, left=(0, 2, 4))
        title = f"{words.escaped(name)}: {words.escaped(part.kind)}, {len(own)} parameter{'' if len(own) == 1 else 's'}"
        blocks.append(f"<details><summary>{title}</summary>{table}</details>")
    size = " × ".join(map(str, scene.camera.resolution)) + " px, " if scene.camera is not None else ""
    return words.html_block(f"Scene: {scene.path.stem}", *blocks, note=f"{size}{len(scene.parts)} parts; {scene.path}")


def _bounds(low: float | None, high: float | None) -> str:
    if low is None or high is None:
        return "a choice"
    if math.isinf(low) and math.isinf(high):
        return "any"
    return f"{words.number(low, typeset=True)} … {words.number(high, typeset=True)}"
