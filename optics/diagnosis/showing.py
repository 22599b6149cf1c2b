"""A diagnosis as plain records, as a chart, and in a notebook."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from optics import words

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from optics.diagnosis.result import Diagnosis, Row

NOTABLE = 0.01  # family-wise p below which an effect is listed: the level of the test
SHOWN_MOST = 14  # effects, and curves, in a chart or a notebook
COLOURS = {"camera": "#1d5fa6", "light": "#d9962f", "geometry": "#4c8b57", "time": "#8a5fa8", "": "#777777"}


def records(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """One record per effect, best first: the fields of `Row`, `net`, and those of its refit with `refit_` before.

    Strengths are lists, one entry per variable; a list of one is given as its entry. None where there is no refit.
    """
    return [_record(row) for row in diagnosis.rows]


def _record(row: Row) -> dict[str, Any]:
    from optics.diagnosis.result import Refit

    def plain(value: Any) -> Any:
        return value[0] if isinstance(value, list) and len(value) == 1 else value

    out = {f.name: plain(getattr(row, f.name)) for f in fields(row) if f.name not in ("refit", "flags")}
    out |= {"flags": list(row.flags), "net": row.net}
    for f in fields(Refit):
        out[f"refit_{f.name}"] = None if row.refit is None else plain(getattr(row.refit, f.name))
    return out


def plot(diagnosis: Diagnosis) -> Figure:
    """The ranking of effects by what they explain, and what curves along coordinates explain beside them."""
    from optics.files.charts import BLUE, GREY, RED, chart, height_for, legend_below

    rows = [r for r in diagnosis.rows if r.net > 0 or r.refit is not None]
    rows = sorted(rows, key=lambda r: -(r.refit.fall if r.refit else r.fall))[:SHOWN_MOST][::-1]
    curves = [f for f in diagnosis.fingerprints if f.net > 0 and not f.per_frame][:SHOWN_MOST][::-1]
    figure, axes = chart(11 if curves else 7, height_for(max(len(rows), len(curves), 6)), 2 if curves else 1)
    left = axes[0] if curves else axes
    at = range(len(rows))
    left.barh(at, [max(r.fall, 0) for r in rows], color=GREY, label="predicted, linearised")
    refits = [(i, r) for i, r in enumerate(rows) if r.refit is not None]
    if refits:
        colours = [RED if r.name == diagnosis.claimed else BLUE for _, r in refits]
        left.barh(
            [i for i, _ in refits],
            [max(r.refit.fall, 0) for _, r in refits if r.refit is not None],
            height=0.4,
            color=colours,
            label="refit, everything calibrated again",
        )
        legend_below(left, 2)
    left.set(yticks=at, xlabel="fall of chi2")
    left.set_yticklabels([r.name for r in rows], fontsize=8)
    left.set_title("effects", fontsize=10)
    if curves:
        right = axes[1]
        best = max((r.refit.fall if r.refit else r.fall for r in rows), default=0.0)
        right.barh(
            range(len(curves)),
            [f.net for f in curves],
            color=[COLOURS.get(f.family, COLOURS[""]) for f in curves],
        )
        if best > 0:
            right.axvline(best, color=RED, lw=1, label="best effect")
        for family in dict.fromkeys(f.family for f in curves):
            right.bar(0, 0, color=COLOURS.get(family, COLOURS[""]), label=family or "other")
        legend_below(right, 4)
        right.set(yticks=range(len(curves)), xlabel="fall of chi2, less its number of bins")
        right.set_yticklabels([f.coordinate for f in curves], fontsize=8)
        right.set_title("a free curve along a coordinate", fontsize=10)
    named = diagnosis.claimed or words.some(diagnosis.ambiguous, 4)
    title = diagnosis.word.replace("_", " ") + (f": {named}" if named else "")
    figure.suptitle(title, fontsize=12)
    return figure


def html(diagnosis: Diagnosis) -> str:
    """What a notebook shows of a diagnosis."""
    b = diagnosis.basis
    shown = [r for r in diagnosis.rows if r.refit is not None or r.p_family < NOTABLE][:SHOWN_MOST]
    lines = []
    for r in shown:
        strength = r.refit.strength if r.refit else [a + c for a, c in zip(r.start, r.change)]
        sd = r.refit.sd if r.refit else r.sd
        lines.append(
            (
                r.name,
                words.number(r.fall, 4, typeset=True),
                words.number(r.refit.fall, 4, typeset=True) if r.refit else "",
                words.p_text(r.p_family, typeset=True),
                words.with_sd(strength[0], sd[0], typeset=True, reach=r.reach(0))
                if len(strength) == 1
                else f"{len(strength)} values",
                r.units[0] if len(strength) == 1 and words.spaced(r.units[0]) else "",
                "" if math.isnan(r.share) else words.share_text(r.share, typeset=True),
                r.verdict,
            )
        )
    head = ("effect", "fall of χ²", "refit", "family-wise p", "strength", "unit", "of the excess", "")
    return words.html_block(
        diagnosis.word.replace("_", " "),
        f"<p>{words.escaped(diagnosis.sentence)}</p>",
        words.html_table(head, lines, left=(0, 5, 7)) if lines else "",
        words.html_list(
            [*(f"next: {hint}" for hint in diagnosis.hints), *(f"warning: {w}" for w in diagnosis.warnings)]
        ),
        note=f"{b.frames} frames; noise {words.percent(b.noise, typeset=True)} of the signal, misfit "
        f"{words.percent(b.misfit, typeset=True)}",
    )
