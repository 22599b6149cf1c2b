"""Matplotlib figures that belong to whoever made them: no global state, no window; a notebook shows them as PNG."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure

# Told apart with every kind of colour vision, and in grey.
BLUE, ORANGE, RED, GREY = "#1d5fa6", "#d9962f", "#b22f33", "#8a8a8a"

LEGEND_AT = -0.42  # inches from the axis: below its label


class Chart(Figure):
    """A figure to save (`chart.savefig("fit.png")`) or to end a notebook cell with."""

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.savefig(file, format="png", dpi=110)
        return file.getvalue()


def chart(width: float, height: float, columns: int = 1, shares: Sequence[float] | None = None) -> tuple[Chart, Any]:
    """A figure (inches) with axes side by side: one, or an array of `columns`; `shares` of the width."""
    figure = Chart(figsize=(width, height), layout="constrained")
    axes = figure.subplots(1, columns, width_ratios=shares)
    for axis in [axes] if columns == 1 else axes:
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def legend_below(axis: Any, columns: int) -> None:
    """A legend under the axis label, where it hides no data."""
    from matplotlib.transforms import offset_copy

    below = offset_copy(axis.transAxes, axis.figure, y=LEGEND_AT)
    axis.legend(
        fontsize=8, loc="upper center", bbox_to_anchor=(0.5, 0), bbox_transform=below, ncol=columns, frameon=False
    )


def height_for(rows: int) -> float:
    """Inches for so many labelled rows."""
    return max(2.6, 0.26 * rows + 1.0)
