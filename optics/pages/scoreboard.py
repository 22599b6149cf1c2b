"""The scoreboard as one self-contained HTML page: images, bars, tables, the ring of LEDs, the published numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from optics import words
from optics.pages.drawing import (
    DIVERGING,
    SIDE_MIN,
    colour_bar,
    coloured,
    eight_bit,
    escaped,
    log_ticks_between,
    number,
    rounded_up,
    scaled,
    svg_chart,
    webp,
    wrapped,
)
from optics.pages.mosaics import Eye
from optics.study.board import PUBLISHED, STEP, Board, Entry, Level
from optics.words import figures, fixed, some

SIDE_MAX = 360  # px; larger images are shown in blocks
BAR = 22  # px, height of a model's line
QUANTILE = 98  # per cent of residuals within the range of colours
SYMBOLS = ((", with position squared", " × place²"), (", with position", " × place"), ("in the normal", "in n"))
LABELS = {"wide": 330, "narrow": 158}  # px, of the models' names


def render(boards: Sequence[Board]) -> str:
    """The page as text."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(number=number, fixed=fixed, figures=figures, some=some)
    return environment.get_template("scoreboard.html.j2").render(
        boards=[_board(b) for b in boards],
        published={**PUBLISHED, "pairs": _published()},
        colour_bar=colour_bar(),
        step=STEP,
        title=" · ".join(dict.fromkeys(b.name for b in boards)),
    )


def _board(board: Board) -> dict[str, Any]:
    return {
        "board": board,
        "headline": headline(board),
        "dots": {width: dots(board, size, LABELS[width]) for width, size in (("wide", 920), ("narrow", 360))},
        "curves": {width: curves(board, *size) for width, size in (("wide", (920, 330)), ("narrow", (360, 300)))},
        "legend": legend(board),
        "images": images(board),
        "tables": [
            {
                "title": title,
                "rows": [_row(e, getattr(e, which), e.how.get(which, "")) for e in board.entries],
                "note": note,
            }
            for which, title, note in (
                ("contact", "In the contact", f"Contact: {board.region}, as the captures state it."),
                ("whole", "Whole image", "All usable values; tables are fitted to all of them here."),
            )
        ],
        "cells": _cells(board),
        "rings": board.rings,
        "regular": 360 / len(board.rings[0].leds) if board.rings else math.nan,
    }


# -- words and numbers -----------------------------------------------------------------------------------------------
def headline(board: Board) -> str:
    """One sentence: the best step beside the best rival in the contact."""
    step, rival = board.best(STEP), board.best("rival")
    ratio = board.measure == "ratio"

    def said(entry: Entry) -> str:
        value = getattr(entry.contact, board.measure)
        return f"{100 * value:.2g} % of the flat field" if ratio else f"{value:.3g} DN"

    if rival is None:
        return "Nothing to compare with."
    if step is None:
        return f"No calibrated model is given. The best rival in the contact, “{rival.name}”, misses by {said(rival)}."
    if board.beaten:
        return (
            f"A rival beats the physical model: in the contact “{rival.name}” misses by {said(rival)}, “{step.name}” "
            f"by {said(step)}."
        )
    return (
        f"The physical model beats every rival: in the contact “{step.name}” misses by {said(step)}, the best rival, "
        f"“{rival.name}”, by {said(rival)}."
    )


def _row(entry: Entry, level: Level, how: str) -> dict[str, Any]:
    low, high = level.span("ratio")
    sd = level.sd

    def scatter(value: float, key: str, places: int) -> str:
        return fixed(value, places) + (f" ± {fixed(sd[key], places)}" if math.isfinite(sd[key]) else "")

    return {
        "name": entry.name,
        "own": entry.kind == STEP,
        "numbers": "image" if entry.numbers is None else number(entry.numbers, 5),
        "each": "–" if entry.numbers is None else number(entry.each, 3),
        "ratio": "–" if level.ratio is None else fixed(level.ratio, 4),
        "range": f"{fixed(low, 4)} – {fixed(high, 4)}" if math.isfinite(low) else "–",
        "rms": fixed(level.rms, 2),
        "chi2": figures(level.chi2_per_dof, 4),
        "l1": scatter(level.l1, "l1", 4),
        "ssim": scatter(level.ssim, "ssim", 3),
        "psnr": scatter(level.psnr, "psnr", 1),
        "how": how,
    }


def _published() -> dict[str, str]:
    places = {"l1": 3, "ssim": 3, "psnr": 1}
    return {key: f"{fixed(PUBLISHED[key][0], p)} ± {fixed(PUBLISHED[key][1], p)}" for key, p in places.items()}


def _cells(board: Board) -> dict[str, Any]:
    """Errors in the contact by lamp and channel: heads, and a row for each model."""
    many = len(board.channels) > 1
    heads = [
        c["led"] + (f" {c['channel']}" if many else "") if c["led"] != "all" else c["channel"]
        for c in board.entries[0].contact.cells
    ]
    key, places = board.measure, 4 if board.measure == "ratio" else 2
    rows = [
        {"name": e.name, "own": e.kind == STEP, "values": [fixed(c[key], places) for c in e.contact.cells]}
        for e in board.entries
    ]
    return {"heads": heads, "rows": rows, "what": "rms of the ratio" if key == "ratio" else "rms, DN"}


# -- charts ----------------------------------------------------------------------------------------------------------
def dots(board: Board, width: int, label: int) -> str:
    """The error in the contact of every model as a dot, and its span over lamps and channels, on a logarithmic axis."""
    key = board.measure
    values = [float(getattr(e.contact, key)) for e in board.entries]
    spans = [e.contact.span(key) for e in board.entries]
    floor = board.entries[0].contact
    noise = floor.noise * (floor.ratio / floor.rms if floor.ratio and floor.rms else 1.0)
    finite = [v for v in (*values, *(s for pair in spans for s in pair), noise) if math.isfinite(v) and v > 0]
    low, high = min(finite) * 0.85, max(finite) * 1.1
    x = scaled(math.log(low), math.log(high), label, width - 46)
    height = BAR * len(values) + 64
    parts = []
    for tick in _few(log_ticks_between(low, high), width):
        at = x(math.log(tick))
        parts.append(f'<line class="grid" x1="{at:.1f}" x2="{at:.1f}" y1="4" y2="{height - 40}"/>')
        parts.append(f'<text class="tick" x="{at:.1f}" y="{height - 24}" text-anchor="middle">{number(tick)}</text>')
    at = x(math.log(noise))
    parts.append(f'<line class="floor" x1="{at:.1f}" x2="{at:.1f}" y1="4" y2="{height - 40}"/>')
    parts.append(f'<text class="floorlabel" x="{at + 5:.1f}" y="{height - 44}">noise</text>')
    for k, (entry, value, (least, most)) in enumerate(zip(board.entries, values, spans)):
        y = 6 + BAR * k
        kind = "own" if entry.kind == STEP else "rival"
        name = _short(entry.name, int(label / 6.6))
        parts.append(f'<text class="{kind}" x="{label - 8}" y="{y + 14}" text-anchor="end">{escaped(name)}</text>')
        if not value > 0:
            continue
        at = right = x(math.log(value))
        parts.append(f'<line class="guide" x1="{label}" x2="{at:.1f}" y1="{y + 10}" y2="{y + 10}"/>')
        if least > 0 and most > least:
            left, right = x(math.log(least)), x(math.log(most))
            parts.append(f'<line class="span {kind}" x1="{left:.1f}" x2="{right:.1f}" y1="{y + 10}" y2="{y + 10}"/>')
        parts.append(
            f'<circle class="{kind}" cx="{at:.1f}" cy="{y + 10}" r="5">'
            f"<title>{escaped(entry.name)}: {number(value, 4)}</title></circle>"
        )
        parts.append(f'<text class="tick" x="{max(at + 5, right) + 5:.1f}" y="{y + 14}">{number(value)}</text>')
    what = "rms of the ratio to the flat field, in the contact" if key == "ratio" else "rms in the contact, DN"
    parts.append(f'<text class="axis" x="{width - 46}" y="{height - 6}" text-anchor="end">{what}</text>')
    return svg_chart(width, height, parts, f"{what}, of each model")


def _short(name: str, most: int) -> str:
    """A name in so many letters, by symbols where it is too long."""
    for phrase, symbol in SYMBOLS if len(name) > most else ():
        name = name.replace(phrase, symbol)
    return name if len(name) <= most else wrapped(name, most - 2)[0].rstrip(",:") + " …"


def _few(ticks: Sequence[float], width: int) -> list[float]:
    """As many ticks as fit."""
    step = max(1, math.ceil(len(ticks) * 90 / width))
    return list(ticks)[::step]


def legend(board: Board) -> list[tuple[str, str]]:
    """(class of its colour, name) of each line of `curves`."""
    return [(f"c{k % 8}", name) for k, name in enumerate(_several(board))]


def _several(board: Board) -> dict[str, list[Mapping[str, Any]]]:
    return {name: rows for name, rows in board.by_presses.items() if len(rows) > 1}


def curves(board: Board, width: int, height: int) -> str:
    """Held-out error against the number of presses fitted; nothing where there is one number only."""
    shown, key = _several(board), board.measure
    if not shown:
        return ""
    points = {name: [(r["presses"], r[key]) for r in rows if r[key] > 0] for name, rows in shown.items()}
    flat = [p for rows in points.values() for p in rows]
    counts = sorted({p[0] for p in flat})
    low, high = min(p[1] for p in flat) * 0.9, min(max(p[1] for p in flat), 20 * min(p[1] for p in flat)) * 1.1
    x = scaled(math.log(counts[0]), math.log(counts[-1]), 58, width - 20)
    y = scaled(math.log(low), math.log(high), height - 46, 12)
    parts = []
    for tick in log_ticks_between(low, high):
        at = y(math.log(tick))
        parts.append(f'<line class="grid" x1="58" x2="{width - 20}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text class="tick" x="52" y="{at + 4:.1f}" text-anchor="end">{number(tick)}</text>')
    for count in counts:
        parts.append(
            f'<text class="tick" x="{x(math.log(count)):.1f}" y="{height - 26}" text-anchor="middle">{count}</text>'
        )
    for k, (name, rows) in enumerate(points.items()):
        line = " ".join(f"{x(math.log(n)):.1f},{y(math.log(min(v, high))):.1f}" for n, v in rows)
        parts.append(f'<polyline class="c{k % 8}" points="{line}"><title>{escaped(name)}</title></polyline>')
        parts += [
            f'<circle class="c{k % 8}" cx="{x(math.log(n)):.1f}" cy="{y(math.log(v)):.1f}" r="3"/>'
            for n, v in rows
            if v <= high
        ]
    parts.append(f'<text class="axis" x="{width - 20}" y="{height - 6}" text-anchor="end">presses fitted</text>')
    return svg_chart(width, height, parts, "held-out error against the number of presses fitted")


# -- images ----------------------------------------------------------------------------------------------------------
def images(board: Board) -> dict[str, Any]:
    """The measured frame, and for each model shown its prediction and its residual, with one range of colours."""
    found = board.images
    if found is None or min(found.measured.shape[:2]) < SIDE_MIN:
        return {}
    eye = Eye(found.mosaic)
    raw = eye.whole(found.measured)
    bins = max(1, math.ceil(max(raw.shape[:2]) / SIDE_MAX))
    usable = np.where(found.usable if found.usable.ndim == 3 else found.usable[..., None], 1.0, np.nan)
    measured = _blocks(raw, bins)
    white = rounded_up(float(np.nanpercentile(found.measured, 99.5)))
    residuals = {
        name: _mean(_blocks(eye.whole((found.measured - p) * usable), bins), 2) for name, p in found.predicted.items()
    }
    own = board.best(STEP) or board.best("rival")
    first = residuals[own.name] if own and own.name in residuals else next(iter(residuals.values()))
    limit = rounded_up(max(float(np.nanpercentile(np.abs(first), QUANTILE)), 1e-3 * board.full_scale))
    return {
        "frame": found.frame,
        "measured": webp(eight_bit(measured, white)),
        "size": measured.shape[:2][::-1],
        "limit": words.number(limit),
        "note": eye.note,
        "models": [
            {
                "name": name,
                "predicted": webp(eight_bit(_blocks(eye.whole(p), bins), white)),
                "residual": coloured(residuals[name], -limit, limit, DIVERGING),
            }
            for name, p in found.predicted.items()
        ],
    }


def _blocks(image: np.ndarray, bins: int) -> np.ndarray:
    """Means of blocks of (H, W, C); NaN is left out."""
    if bins == 1:
        return np.asarray(image, float)
    h, w = (n // bins * bins for n in image.shape[:2])
    parts = np.asarray(image, float)[:h, :w].reshape(h // bins, bins, w // bins, bins, -1)
    return _mean(parts, (1, 3))


def _mean(values: np.ndarray, axis: int | tuple[int, ...]) -> np.ndarray:
    """Mean of what is no NaN; NaN where all is."""
    count = np.isfinite(values).sum(axis)
    return np.where(count > 0, np.nansum(values, axis) / np.maximum(count, 1), np.nan)
