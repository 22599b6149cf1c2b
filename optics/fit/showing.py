"""A fit as plain records, as a chart, and in a notebook."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from optics import words

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from optics.fit.result import Fit

SHOWN_MOST = 40  # variables in a chart: those that moved most
SURPRISING = 3.0  # standard deviations beyond which a pull is marked


def records(fit: Fit) -> list[dict[str, Any]]:
    """One record per variable.

    name, keys, unit, value, sd (1 standard deviation), start, neutral, plausible, frames (indices; None: all),
    prior_mean, prior_sd, pull = (value - prior_mean) / prior_sd, at_bound, gauge (whether only combinations of it with
    others are determined). None where there is no such number.
    """
    out, members, ended = [], fit.gauges.members, fit.ended
    for i, (v, value, sd) in enumerate(zip(fit.variables, np.asarray(fit.estimate, float), fit.sd)):
        mean, width = v.prior if v.prior is not None else (None, None)
        out.append(
            {
                "name": v.name,
                "keys": list(v.keys),
                "unit": v.parameter.unit,
                "value": float(value),
                "sd": float(sd),
                "start": None if fit.start is None else float(fit.start[i]),
                "neutral": v.parameter.neutral,
                "plausible": v.parameter.plausible,
                "frames": None if v.frames is None else list(v.frames),
                "prior_mean": mean,
                "prior_sd": width,
                "pull": None if mean is None or width is None else (float(value) - mean) / width,
                "at_bound": v.name in ended,
                "gauge": i in members,
            }
        )
    return out


def plot(fit: Fit) -> Figure:
    """How far each variable moved, how far priors were left, and the misfit of each frame in units of the noise."""
    from optics.files.charts import BLUE, GREY, ORANGE, RED, chart, height_for, legend_below

    rows = records(fit)
    moved = [(r, _moved(r)) for r in rows if r["start"] is not None]
    moved = sorted(moved, key=lambda m: -abs(m[1]))[:SHOWN_MOST][::-1]
    pulls = sorted((r for r in rows if r["pull"] is not None), key=lambda r: -abs(r["pull"]))[:SHOWN_MOST][::-1]
    panels = [*(["moved"] if moved else []), *(["pulls"] if pulls else []), "frames"]
    figure, axes = chart(4.2 * len(panels), height_for(max(len(moved), len(pulls), 6)), len(panels))
    axes = dict(zip(panels, np.atleast_1d(axes)))
    if moved:
        axis = axes["moved"]
        at = range(len(moved))
        sd = [min(r["sd"] / r["plausible"], 1e6) for r, _ in moved]  # an undetermined one is infinite
        axis.errorbar([m for _, m in moved], at, xerr=sd, fmt="o", ms=4, lw=1, color=BLUE, ecolor=GREY)
        reach = 1.2 * max([abs(m) for _, m in moved] + [0.1])
        axis.set(yticks=list(at), xlim=(-reach, reach), xlabel="change from the start, in plausible sizes")
        axis.set_yticklabels([r["name"] + (" *" if r["at_bound"] else "") for r, _ in moved], fontsize=8)
        axis.axvline(0, color=GREY, lw=0.8)
        axis.set_title("variables" + (" (* at a bound)" if any(r["at_bound"] for r, _ in moved) else ""), fontsize=10)
    if pulls:
        axis = axes["pulls"]
        colours = [RED if abs(r["pull"]) > SURPRISING else BLUE for r in pulls]
        axis.barh(range(len(pulls)), [r["pull"] for r in pulls], color=colours)
        axis.set(yticks=range(len(pulls)), xlabel="(value - prior) / sd of the prior")
        axis.set_yticklabels([r["name"] for r in pulls], fontsize=8)
        axis.axvline(0, color=GREY, lw=0.8)
        axis.set_title("pulls of the priors", fontsize=10)
    axis = axes["frames"]
    n = np.maximum(np.asarray(fit.frame_n, float), 1)
    share = np.asarray(fit.frame_chi2, float) / n
    band = 2 * np.sqrt(2 / n)  # two standard deviations of chi2/n
    axis.fill_between(fit.frames, 1 - band, 1 + band, step="mid", color=GREY, alpha=0.3, label="noise, 2 sd")
    axis.plot(fit.frames, share, "o", ms=4, color=ORANGE, label="frames")
    axis.axhline(1, color=GREY, lw=0.8)
    if share.max(initial=1) > 5:
        axis.set_yscale("log")
    axis.set(xlabel="frame", ylabel="chi2 per value")
    axis.set_title(f"misfit by frame; all: chi2/dof {fit.chi2_per_dof:.3g}", fontsize=10)
    legend_below(axis, 2)
    return figure


def html(fit: Fit) -> str:
    """What a notebook shows of a fit."""
    correlation = np.abs(fit.correlation - np.eye(len(fit.variables)))
    gauges = fit.gauges
    lines, blurred = [], fit.blurred(gauges)
    for i, r in enumerate(records(fit)):
        j = int(np.argmax(correlation[i])) if len(fit.variables) > 1 else i
        lines.append(
            (
                r["name"],
                words.with_sd(r["value"], r["sd"], typeset=True, reach=fit.variables[i].parameter.reach)
                if i not in blurred
                else words.number(r["value"], 4, typeset=True) + (" (unseen)" if i in gauges.silent else " (gauge)"),
                r["unit"] if words.spaced(r["unit"]) else "",
                words.number(r["start"], 5, typeset=True),
                "" if r["pull"] is None else words.number(r["pull"], 2, typeset=True),
                f"{words.fixed(fit.correlation[i, j], 2)} {fit.variables[j].name}" if j != i else "",
                "at its bound" if r["at_bound"] else "",
            )
        )
    head = ("variable", "estimate", "unit", "start", "pull", "strongest correlation", "")
    state = "converged" if fit.converged else "not converged"
    return words.html_block(
        f"Fit: χ²/dof {words.figures(fit.chi2_per_dof)}, {state}",
        words.html_table(head, lines, left=(0, 2, 5, 6)),
        words.html_list([*gauges.lines(), *(f"warning: {w}" for w in fit.warnings)]),
        note=f"{len(fit.frames)} frames, {fit.dof} degrees of freedom; {fit.reason}",
    )


def _moved(record: dict[str, Any]) -> float:
    """Change from the start in plausible sizes; 0 for what is not finite."""
    change = (record["value"] - record["start"]) / record["plausible"]
    return change if math.isfinite(change) else 0.0
