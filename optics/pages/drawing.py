"""What all pages draw with: colour scales, images as data URIs, axes and their ticks."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from optics import words
from optics.files.exr import in_colours

SIDE_MIN = 8  # px; smaller frames are readings, shown as points over the settings
SIGMA_RANGE = 5.0  # the residual colour bar is symmetric, +- this
CODES_PER_SIGMA = 4  # residual images carry quarters of a sigma, so that the page can colour and read them
# Blue, paper, red: told apart with every kind of colour vision, lightness falls evenly to both ends.
DIVERGING = ("#08306b", "#1d5fa6", "#6aa5d8", "#bcd6ea", "#f5f3ef", "#f3c3a8", "#dd7c5c", "#b22f33", "#650a1c")
SEQUENTIAL = ("#f5f3ef", "#e6d9c0", "#d9b36c", "#b9762f", "#7a3d1a", "#33160b")
MASKED = "#8a8a8a"
# numbers as a page sets them
number, percent = partial(words.number, typeset=True), partial(words.percent, typeset=True)


def eight_bit(image: np.ndarray, white: float) -> np.ndarray:
    return np.clip(np.nan_to_num(in_colours(image)) / white * 255 + 0.5, 0, 255).astype(np.uint8)


def colour_planes(z: np.ndarray) -> np.ndarray:
    """Residual planes for the viewer: its channels where there are 1 or 3, else their combination."""
    return z if z.shape[2] in (1, 3) else combined(z)[..., None]


def combined(z: np.ndarray) -> np.ndarray:
    """Sum over channels / sqrt(number of usable channels): noise keeps a standard deviation of 1. (H, W), NaN if
    none."""
    n = np.isfinite(z).sum(2)
    return np.where(n > 0, np.nansum(z, 2) / np.sqrt(np.maximum(n, 1)), np.nan)


def codes(z: np.ndarray) -> np.ndarray:
    """Residuals in sigmas as bytes: 128 + 4 z, clipped to 1..255; 0 is masked."""
    return np.where(np.isfinite(z), np.clip(np.round(np.nan_to_num(z) * CODES_PER_SIGMA) + 128, 1, 255), 0).astype(
        np.uint8
    )


def webp(image: np.ndarray) -> str:
    """Lossless image as a data URI. image: (H, W, 1 or 3) uint8."""
    from PIL import Image

    shown = Image.fromarray(image[..., 0] if image.shape[2] == 1 else image).convert("RGB")
    out = io.BytesIO()
    shown.save(out, "WEBP", lossless=True, quality=60, method=3, exact=True)
    return "data:image/webp;base64," + base64.b64encode(out.getvalue()).decode()


def coloured(plane: np.ndarray, low: float, high: float, colours: Sequence[str]) -> str:
    """(H, W) with NaN for masked -> palette PNG as a data URI, 41 levels from low to high."""
    from PIL import Image

    levels = 41
    index = np.clip(np.round((np.nan_to_num(plane) - low) / (high - low) * (levels - 1)), 0, levels - 1)
    image = Image.fromarray(np.where(np.isfinite(plane), index, levels).astype(np.uint8))
    image.putpalette([v for colour in (*ramp(colours, levels), rgb(MASKED)) for v in colour])
    out = io.BytesIO()
    image.save(out, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(out.getvalue()).decode()


def rgb(colour: str) -> tuple[int, int, int]:
    return tuple(int(colour[i : i + 2], 16) for i in (1, 3, 5))


def ramp(colours: Sequence[str], count: int) -> list[tuple[int, int, int]]:
    """`count` colours between equally spaced ones."""
    anchors = np.array([rgb(c) for c in colours], float)
    at = np.linspace(0, len(colours) - 1, count)
    return [
        tuple(int(round(v)) for v in c)
        for c in np.stack([np.interp(at, np.arange(len(colours)), anchors[:, k]) for k in range(3)], 1)
    ]


def colour_bar() -> str:
    return "linear-gradient(to right," + ",".join(DIVERGING) + ")"


def rounded_up(value: float) -> float:
    power = 10 ** math.floor(math.log10(value)) if value > 0 else 1.0
    return next(k * power for k in (1, 1.5, 2, 3, 5, 7, 10) if value <= k * power * (1 + 1e-9))


def svg_chart(width: int, height: int, parts: Sequence[str], words: str, fixed: bool = False) -> str:
    size = f' style="width:{width}px;height:{height}px"' if fixed else ""
    return (
        f'<svg viewBox="0 0 {width} {height}"{size} role="img" aria-label="{escaped(words)}">'
        + "".join(parts)
        + "</svg>"
    )


def scaled(low: float, high: float, start: float, end: float):
    span = high - low or 1.0
    return lambda value: start + (value - low) / span * (end - start)


def ticks_between(low: float, high: float, count: int) -> list[float]:
    """Round numbers in [low, high], about `count` of them."""
    rough = (high - low) / max(count, 1)
    if not rough > 0:
        return [low]
    power = 10 ** math.floor(math.log10(rough))
    step = next(k * power for k in (1, 2, 5, 10) if rough <= k * power * 1.0001)
    return [round(k * step, 12) + 0.0 for k in range(math.ceil(low / step), math.floor(high / step) + 1)]


def log_ticks_between(low: float, high: float) -> list[float]:
    for marks in (
        (1,),
        (1, 3),
        (1, 2, 5),
        (1, 1.2, 1.5, 2, 3, 5, 7),
        (1, 1.05, 1.1, 1.2, 1.3, 1.5, 2, 3, 4, 5, 6, 7, 8, 9),
    ):
        found = [
            m * 10.0**k
            for k in range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
            for m in marks
            if low <= m * 10.0**k <= high
        ]
        if len(found) >= 4:
            return found
    return found


def wrapped(text: str, width: int) -> list[str]:
    import textwrap

    return textwrap.wrap(text, width) or [""]


def escaped(text) -> str:
    import html

    return html.escape(str(text), quote=True)


# -- tables ----------------------------------------------------------------------------------------------------------
def step_name(step: Mapping) -> str:
    return ("+ " if step["index"] else "") + step["name"]
