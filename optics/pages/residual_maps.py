"""What a report shows of residuals beyond a mean per pixel: by region, by colour, and what many frames have in common.

regions      mean and standard deviation of the residual in cells of the sensor: a mean off 0 is a wrong model, a
             standard deviation above 1 something that changes from frame to frame or from pixel to pixel
colours      the mean residual of the three channels as a colour: grey where all agree, a hue where some channels miss
             more
components   singular vectors of the residual frames: what the frames have in common, and how much of it each frame has;
             noise alone gives every component the same share
coordinates  how much of the excess a curve along each coordinate explains, by family
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping, Sequence

import numpy as np

from optics.fit.compare import Comparison
from optics.pages.drawing import (
    DIVERGING,
    SEQUENTIAL,
    SIDE_MIN,
    coloured,
    combined,
    number,
    percent,
    step_name,
)
from optics.study.shown import Shown
from optics.words import fixed

CELLS = 16  # of a regional map along the longer side
COMPONENTS = 3
SIDE = 96  # px; components of larger images are taken of means over blocks
COLOURED = 64  # px of the image of colours
LISTED = 14  # coordinates
FRAMES_MIN = 3


def pages(comparisons: Sequence[Comparison], shown: Sequence[Sequence[Shown]], steps: Sequence[Mapping]) -> list[dict]:
    """Of the first and the last step: the images of regions and colours, and the components; what is missing is left
    out."""
    out = []
    for i in dict.fromkeys((0, len(steps) - 1)):
        c = comparisons[i]
        if c.mean_map is None or max(c.mean_map.shape[:2]) < SIDE_MIN:
            continue
        out.append({"step": step_name(steps[i]), **regions(c), "colours": colours(c), **components(shown[i])})
    return out


def _cells(image: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) or (H, W, C) -> means and numbers of values, (h, w), of blocks of `size` px, those at the far edges
    smaller; NaN where none."""

    def summed(a):
        return np.add.reduceat(np.add.reduceat(a, np.arange(0, a.shape[0], size), 0), np.arange(0, a.shape[1], size), 1)

    image = np.asarray(image, float).reshape(*image.shape[:2], -1)
    good = np.isfinite(image)
    count = summed(good.sum(-1))
    return np.where(count > 0, summed(np.where(good, image, 0.0).sum(-1)) / np.maximum(count, 1), np.nan), count


def regions(c: Comparison) -> dict:
    """Mean and standard deviation of the residual in sigmas, over frames, channels and pixels of a cell."""
    size = max(1, math.ceil(max(c.mean_map.shape[:2]) / CELLS))
    mean, square = (_cells(image, size)[0] for image in (c.mean_map, c.rms_map.astype(float) ** 2))
    sd = np.sqrt(np.maximum(square - mean**2, 0))
    top = max(float(np.nanmax(np.abs(mean), initial=0)), 0.05)
    return {
        "mean": coloured(mean, -top, top, DIVERGING),
        "mean_top": number(top, 2),
        "sd": coloured(sd, 0, 2, SEQUENTIAL),
        "worst": number(float(np.nanmax(sd, initial=0)), 3),
        "cell": size,
        "width": c.mean_map.shape[1],
        "height": c.mean_map.shape[0],
    }


def colours(c: Comparison) -> str:
    """The mean residual of blocks, in its own standard deviations: grey is 0, red, green and blue their channels, +-5;
    '' without colours."""
    if c.mean_map.shape[2] != 3:
        return ""
    from PIL import Image

    size = max(1, math.ceil(max(c.mean_map.shape[:2]) / COLOURED))
    z = np.stack(
        [mean * np.sqrt(count * len(c.frames)) for mean, count in (_cells(c.mean_map[..., k], size) for k in range(3))],
        -1,
    )
    out = io.BytesIO()
    Image.fromarray((np.clip(np.nan_to_num(z) / 10 + 0.5, 0, 1) * 15 + 0.5).astype(np.uint8) * 17).save(
        out, "PNG", optimize=True
    )
    return "data:image/png;base64," + base64.b64encode(out.getvalue()).decode()


def components(shown: Sequence[Shown]) -> dict:
    """Singular vectors of the recorded residual frames (frames x pixels, channels combined), the largest first.

    share   of the sum of squares;  noise: what each has of white noise, 1 / frames
    scores  per frame, in sigmas rms: how much of the component the frame has, with its sign
    """
    frames = [f for f in shown if f.measured.shape == shown[0].measured.shape and min(f.measured.shape[:2]) >= SIDE_MIN]
    if len(frames) < FRAMES_MIN:
        return {"components": []}
    size = max(1, math.ceil(max(frames[0].measured.shape[:2]) / SIDE))
    # a mean over n pixels, times sqrt(n): noise keeps a standard deviation of 1
    z = np.stack(
        [np.nan_to_num(mean * np.sqrt(count)) for mean, count in (_cells(combined(f.residual), size) for f in frames)]
    )
    shape = z.shape[1:]
    u, s, v = np.linalg.svd(z.reshape(len(frames), -1), full_matrices=False)
    total = float((s**2).sum()) or 1.0
    found = []
    for k in range(min(COMPONENTS, len(frames))):
        sign = 1.0 if u[:, k].sum() >= 0 else -1.0
        image = sign * v[k].reshape(shape) * math.sqrt(v.shape[1])  # rms 1
        scores = sign * u[:, k] * s[k] / math.sqrt(v.shape[1])
        found.append(
            {
                "image": coloured(image, -3, 3, DIVERGING),
                "share": percent(s[k] ** 2 / total, 2),
                "scores": [{"frame": f.name, "score": fixed(x, 2)} for f, x in zip(frames, scores)],
            }
        )
    return {"components": found, "noise": percent(1 / len(frames), 2), "count": len(frames)}


def coordinates(diagnosis: Mapping | None) -> list[dict]:
    """Rows of the table of coordinates, best first: family, fall of chi2, share of the excess, and over the best
    effect's fall."""
    rows = [f for f in (diagnosis or {}).get("fingerprints") or () if (f.get("net") or 0) > 0]
    best = max([f["net"] for f in rows], default=1.0)
    return [
        {
            "name": f["coordinate"],
            "family": f.get("family") or "",
            "net": number(f["net"], 4),
            "bar": fixed(100 * f["net"] / best, 1),
            "share": percent(f.get("share")),
            "ratio": number(f.get("ratio")),
        }
        for f in rows[:LISTED]
    ]
