"""The residual of one frame before and after the missing effects were added, as one labelled image.

    python -m optics.proof.before_after renders/demo/study renders/gallery/residual_before_after.png

Left is the first step of a study, right the last one, both of the frame that the first step misses most (a held-out
one, where there is any). Colours are sigmas of the noise, channels combined: what is noise alone looks like noise."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

WIDTH = 640  # px, in all
GAP, LINE, MARGIN = 8, 15, 4  # px: between the images, of a line of text, around text
INK, PAPER = "#26323c", "#ffffff"


def before_after(study: str | Path, file: str | Path) -> Path:
    """Write the image of a study's folder (of images, with two steps or more); returns its path.

    Raises ValueError for a study that has nothing to compare.
    """
    from PIL import Image, ImageDraw

    from optics.pages.drawing import SIGMA_RANGE, step_name
    from optics.study.record import Record

    record = Record.open(study)
    if len(record.steps) < 2:
        raise ValueError(f"{study}: {len(record.steps)} step; allowed: 2 or more; add an effect first")
    first, last = ({f.name: f for f in record.frames(i)} for i in (0, len(record.steps) - 1))
    if any(f.settings for f in first.values()):
        raise ValueError(f"{study}: point readings; allowed: images; its report shows readings as curves")
    frames = [f for f in first.values() if f.name in last]
    frames = [f for f in frames if f.held_out] or frames
    worst = max(frames, key=lambda f: np.nanmean(f.residual**2)).name
    panels = [
        (name, _coloured(shown[worst].residual), float(np.nanmean(shown[worst].residual ** 2)))
        for name, shown in ((step_name(record.steps[0]), first), (step_name(record.steps[-1]), last))
    ]
    width = (WIDTH - GAP) // 2
    height = round(width * panels[0][1].height / panels[0][1].width)
    page = Image.new("RGB", (WIDTH, height + 3 * LINE + 2 * MARGIN), PAPER)
    draw = ImageDraw.Draw(page)
    for k, (name, image, chi2) in enumerate(panels):
        left = k * (width + GAP)
        draw.text((left + MARGIN, 1), f"{name}: chi2 per value {chi2:.{1 if chi2 > 3 else 2}f}", INK, _font())
        page.paste(image.resize((width, height), Image.Resampling.NEAREST), (left, LINE + MARGIN))
    low = LINE + height + 2 * MARGIN
    held_out = ", held out" if first[worst].held_out else ""
    note = f"frame {worst}{held_out}: measured minus predicted, in standard deviations of the noise"
    draw.text((MARGIN, low), note, INK, _font())
    bar = np.linspace(-SIGMA_RANGE, SIGMA_RANGE, 120)[None, :, None].repeat(8, 0)
    page.paste(_coloured(bar), (MARGIN + 20, low + LINE + 3))
    draw.text((MARGIN, low + LINE), f"-{SIGMA_RANGE:g}", INK, _font())
    draw.text((MARGIN + 144, low + LINE), f"+{SIGMA_RANGE:g}", INK, _font())
    file = Path(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    page.save(file, optimize=True)
    return file


def _coloured(residual: np.ndarray):
    """A residual (H, W, C) in sigmas as an image, channels combined so that noise keeps a standard deviation of 1."""
    from PIL import Image

    from optics.pages.drawing import DIVERGING, MASKED, SIGMA_RANGE, combined, ramp

    z = combined(np.asarray(residual, float))
    levels = np.array([*ramp(DIVERGING, 101), tuple(int(MASKED[i : i + 2], 16) for i in (1, 3, 5))], np.uint8)
    index = np.clip(np.nan_to_num(z) / SIGMA_RANGE * 50 + 50, 0, 100).round().astype(int)
    return Image.fromarray(levels[np.where(np.isfinite(z), index, 101)])


def _font():
    from PIL import ImageFont

    return ImageFont.load_default(12)


def main(
    study: Annotated[Path, typer.Argument(help="Folder of a study.")],
    output: Annotated[Path, typer.Argument(help="PNG to write.")],
) -> None:
    """Show the residual of a study's first and last step side by side."""
    print(before_after(study, output))


if __name__ == "__main__":
    typer.run(main)
