"""The proof as one HTML page, sensor by sensor: targets, what others measure, confusion matrix, predictions against
what came, pulls, null sets. No rate pools sensors."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from optics.files.output import write_text
from optics.proof.count import Count, Counted
from optics.proof.rates import Rate, last, named

INK, GOOD, BAD, SOFT = "#26323c", "#1d5fa6", "#b22f33", "#d9b36c"


def write(found: Count, records: Sequence[dict], file: Path) -> Path:
    """Write the page, and the counts beside it as proof.json."""
    from jinja2 import Environment, FileSystemLoader, select_autoescape

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=select_autoescape(["html", "j2"]),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    cells = sorted(
        (
            {
                "rig": r["cell"]["rig"],
                "kind": r["cell"]["kind"],
                "hidden": " + ".join(r["cell"]["hidden"]) or "nothing",
                "change": 100 * r["cell"]["change"],
                "snr": r["cell"].get("snr", 0.0),
                "clutter": r["cell"]["clutter"],
                "law": r["cell"]["law"],
                "mistake": r["cell"]["mistake"],
                "seed": r["cell"]["seed"],
                "word": " then ".join(s["word"].replace("_", " ") for s in r["steps"]),
                "named": " + ".join(sorted(named(r))) or ", ".join(last(r)["ambiguous"] if r["steps"] else []),
                "right": _right(r),
                "note": r["failed"] or (last(r)["sentence"] if r["steps"] else "cannot be made that strong"),
            }
            for r in records
        ),
        key=lambda c: (c["rig"], c["kind"], c["hidden"], c["change"], c["clutter"], c["seed"]),
    )
    figures = {
        name: {
            "confusion": confusion(one),
            "falls": falls([r for r in records if r["cell"]["rig"] == name]),
            "pulls": pulls(one),
            "nulls": nulls(one),
        }
        for name, one in found.rigs.items()
    }
    html = environment.get_template("page.html.j2").render(
        found=found,
        figures=figures,
        power=power(found) if found.rigs else "",
        cells=cells,
    )
    for path, text in ((file, html), (file.with_name("proof.json"), json.dumps(found.json(), indent=1))):
        write_text(path, text)
    return file


def _right(r: dict) -> str:
    """'right', 'wrong' or '' (nothing claimed)."""
    if not r["steps"] or not named(r):
        return ""
    same = (r.get("facts") or {}).get("same", {})
    true = {*r["cell"]["hidden"], *(name for names in same.values() for name in names)}
    return "right" if r["cell"]["kind"] in ("library", "pair") and named(r) <= true else "wrong"


def _svg(draw, width: float = 5.2, height: float = 3.4) -> str:
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(
        {
            "font.size": 9,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "svg.fonttype": "none",
            "text.color": INK,
            "axes.labelcolor": INK,
            "svg.hashsalt": "proof",
        }
    ):
        figure = Figure(figsize=(width, height), layout="constrained")
        draw(figure.subplots())
        out = io.StringIO()
        figure.savefig(out, format="svg", transparent=True, metadata={"Date": None})
    text = out.getvalue()
    return text[text.index("<svg") :]


def confusion(found: Counted) -> str:
    """Rows: what was hidden; columns: what was claimed, or the verdict where nothing was."""
    rows = sorted(
        found.confusion,
        key=lambda k: (k.startswith("noise"), k.startswith("not in"), k in ("nothing", "two effects"), k),
    )
    words = ["both", "another", "one of two", "AMBIGUOUS", "PARTIAL", "UNKNOWN", "CANNOT_TELL", "NOTHING"]
    told = {t for row in found.confusion.values() for t in row}
    columns = [r for r in rows if r in told] + sorted(told - set(rows) - set(words)) + [w for w in words if w in told]
    table = np.array([[found.confusion[r].get(c, 0) for c in columns] for r in rows], float)
    share = table / np.maximum(table.sum(1, keepdims=True), 1)

    def draw(ax):
        ax.imshow(np.where(table > 0, share, np.nan), cmap="Blues", vmin=0, vmax=1.4, aspect="auto")
        for i, j in zip(*np.nonzero(table)):
            wrong = columns[j] not in words[2:] and columns[j] not in (rows[i], "both")
            ax.text(
                j,
                i,
                f"{table[i, j]:.0f}",
                ha="center",
                va="center",
                color=BAD if wrong else INK,
                weight="bold" if wrong else "normal",
            )
        ax.set_xticks(
            range(len(columns)),
            [c.replace("_", " ").lower() if c.isupper() else c for c in columns],
            rotation=60,
            ha="right",
            rotation_mode="anchor",
        )
        ax.set_yticks(range(len(rows)), rows)
        ax.set_xlabel("named")
        ax.set_ylabel("hidden")
        ax.spines[:].set_visible(False)
        ax.tick_params(length=0)

    return _svg(draw, 3.5 + 0.3 * len(columns), 2.2 + 0.23 * len(rows))


def power(found: Count) -> str:
    """Share of right claims against the raw change, without clutter."""

    def draw(ax):
        for k, (rig, one) in enumerate(found.rigs.items()):
            levels = one.power
            x = sorted(levels, key=float)
            if not x:
                continue
            rates = [Rate("", *levels[v], 0, 0) for v in x]
            y = [r.value for r in rates]
            error = np.array([[r.value - r.interval[0], r.interval[1] - r.value] for r in rates]).T
            ax.errorbar(
                [float(v) * 1.03**k for v in x],
                y,
                error,
                marker="o",
                capsize=3,
                color=(GOOD, BAD, SOFT, INK)[k % 4],
                label=rig,
            )
        ax.set_xscale("log")
        ax.set_xticks([0.2, 0.5, 2], ["0.2", "0.5", "2"])
        ax.minorticks_off()
        ax.set_ylim(0, 1.03)
        ax.set_xlabel("change of the image by the hidden effect, %")
        ax.set_ylabel("claimed rightly")
        if ax.get_legend_handles_labels()[0]:
            ax.legend(frameon=False)

    return _svg(draw)


def falls(records: Sequence[dict]) -> str:
    """Fall of chi2 that the refit brought, against the prediction by the score."""
    points = [
        (before, after, name in r["cell"]["hidden"])
        for r in records
        if r["steps"] and not r["failed"] and r["cell"]["kind"] == "library" and r.get("facts") is None
        for name, (before, after) in last(r)["falls"].items()
        if before > 1 and after > 1
    ]

    def draw(ax):
        for right, colour, label in ((False, SOFT, "other effects"), (True, GOOD, "the hidden effect")):
            own = np.array([(b, a) for b, a, t in points if t == right])
            if len(own):
                ax.plot(own[:, 0], own[:, 1], ".", color=colour, label=label, markersize=4)
        if points:
            low, high = min(min(p[:2]) for p in points), max(max(p[:2]) for p in points)
            ax.plot([low, high], [low, high], color=INK, linewidth=0.8)
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.set_xlabel("fall of chi2 predicted")
        ax.set_ylabel("fall that came")
        if ax.get_legend_handles_labels()[0]:
            ax.legend(frameon=False)

    return _svg(draw)


def pulls(found: Counted) -> str:
    """(found - true)/sd of claimed strengths, without clutter, beside the normal density."""
    values = np.clip(found.pulls["no clutter"], -6, 6)

    def draw(ax):
        edges = np.linspace(-6, 6, 25)
        ax.hist(values, edges, color=GOOD, alpha=0.7)
        x = np.linspace(-6, 6, 200)
        ax.plot(x, len(values) * 0.5 * np.exp(-x * x / 2) / np.sqrt(2 * np.pi), color=INK)
        ax.set_xlabel("(strength found - true) / sd; beyond 6: at 6")
        ax.set_ylabel("claims")

    return _svg(draw)


def nulls(found: Counted) -> str:
    """Family-wise p of sets with nothing hidden: on the diagonal where it means what it says."""
    p = np.sort(found.null_p)

    def draw(ax):
        ax.step([0, *p, 1], [0, *(np.arange(len(p)) + 1) / max(len(p), 1), 1], where="post", color=GOOD)
        ax.plot([0, 1], [0, 1], color=INK, linewidth=0.8)
        ax.set_xlabel("family-wise p, nothing hidden, no clutter")
        ax.set_ylabel("share of sets below")

    return _svg(draw, 3.6, 3.4)
