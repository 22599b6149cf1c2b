"""Readings as a capture folder, written by hand as a stranger would: a table as the instrument writes it, and what he
knows in captures.toml."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from optics.proof.makers.laboratory.bench import GREEN
from optics.proof.makers.laboratory.session import DIALS, Meter, Session

CHANNELS = {1: ("reading",), 3: ("red", "green", "blue")}


def write(folder: Path, session: Session, readings: np.ndarray) -> Path:
    """Write a table and captures.toml. Readings stand in the instrument's unit, with its decimals; the noise in DN, the
    unit times `per`."""
    folder.mkdir(parents=True)
    meter = session.meter
    values = [f"{meter.unit} {name}" if readings.shape[1] > 1 else meter.unit for name in CHANNELS[readings.shape[1]]]
    turns = {key: f"{key.partition('.')[0]} (rad)" for key in session.settings if session.radians and key in DIALS}
    mark, comma = ("\t", True) if session.continental else (",", False)
    lines = [f"{session.note}"] if session.headed else []
    named = [] if session.runs is None else ["run"]
    lines += [mark.join([*(turns.get(key, key) for key in session.settings), *values, *named])]
    for i, row in enumerate(readings):
        cells = [
            f"{math.radians(column[i]):.6f}" if key in turns else f"{column[i]:.6g}"
            for key, column in session.settings.items()
        ]
        cells += [f"{value / meter.per:.{meter.decimals}f}" for value in row]
        cells = [cell.replace(".", ",") if comma else cell for cell in cells]
        lines.append(mark.join([*cells, *([] if session.runs is None else [str(session.runs[i])])]))
    (folder / "readings.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    text = ['scene = "polarizer_bench"', *known(session), *(_noise(session) if session.noise_said else [])]
    stated = {k: v for k, v in session.fixed.items() if k.partition(".")[0] not in session.absent}
    text += block("parameters", {**stated, **session.given})
    text += uncertainties(session) + exclusions(session)
    text += ["[table]", 'file = "readings.txt"', f"values = [{', '.join(map(_quoted, values))}]"]
    text += ["skip = 1"] if session.headed else []
    text += ['group = "run"'] if named else []
    text += ['delimiter = "\\t"', 'decimal = ","'] if comma else []
    scale = dict.fromkeys(turns, 180 / math.pi)
    if meter.per != 1:
        scale |= dict.fromkeys(values, meter.per)
    text += _inline("rename", {column: _quoted(key) for key, column in turns.items()})
    text += _inline("scale", {name: f"{factor:.10g}" for name, factor in scale.items()})
    (folder / "captures.toml").write_text("\n".join(text) + "\n", encoding="utf-8")
    return folder


def _quoted(text: str) -> str:
    return f'"{text}"'


def _inline(name: str, values: Mapping[str, str]) -> list[str]:
    return [f"{name} = {{ {', '.join(f'{_quoted(k)} = {v}' for k, v in values.items())} }}"] if values else []


def uncertainties(session: Session) -> list[str]:
    """Of the dials that move, where it is stated."""
    sd = math.hypot(session.dial_sd, session.encoder / math.sqrt(12))
    if not session.dials_said or not sd:
        return []
    return block("uncertainty", {key: float(f"{sd:.2g}") for key in DIALS if key in session.settings})


def exclusions(session: Session) -> list[str]:
    """Causes that are ruled out, each with its reason."""
    lines = [f'"{effect}" = "{reason}"' for effect, reason in session.exclude.items()]
    return ["[exclude]", *lines] if lines else []


def known(session: Session) -> list[str]:
    """Bands, and parts that are absent."""
    found = []
    if session.bands != (GREEN,):  # which is what a bench is described at
        found += [f"bands = [{', '.join(f'{b:g}' for b in session.bands)}]"]
    if session.absent:
        found += [f"absent = [{', '.join(map(_quoted, session.absent))}]"]
    return found


def _noise(session: Session) -> list[str]:
    """The scatter of a reading; what goes with the reading stands as that of a fixed pattern."""
    meter: Meter = session.meter
    return [
        "[noise]",
        f"dark_noise = {max(meter.floor * session.noise_said, 1e-4):.4g}",
        f"saturation = {meter.full:g}",
        f"prnu = {meter.relative * session.noise_said:.4g}",
    ]


def block(name: str, values: Mapping[str, float]) -> list[str]:
    """Numbers by key under [name]; nothing where there are none."""
    return [f"[{name}]", *(f'"{key}" = {value:.8g}' for key, value in values.items())] if values else []
