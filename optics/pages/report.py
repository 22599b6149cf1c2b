"""One self-contained HTML page from a study: images first, then the numbers behind them.

Everything is inside the file: images as data URIs, charts as SVG drawn here, a page of script without libraries. What a
study lacks (a diagnosis, held-out frames, null models) is left out of the page. The layout is in `report.html.j2`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from optics import words
from optics.errors import OutputExists
from optics.files.output import spare_records, write_text
from optics.fit.compare import UNITS, Comparison, Curve
from optics.pages.drawing import (
    CODES_PER_SIGMA,
    DIVERGING,
    MASKED,
    SEQUENTIAL,
    SIDE_MIN,
    SIGMA_RANGE,
    codes,
    colour_bar,
    colour_planes,
    coloured,
    combined,
    eight_bit,
    escaped,
    log_ticks_between,
    number,
    percent,
    ramp,
    rgb,
    rounded_up,
    scaled,
    step_name,
    svg_chart,
    ticks_between,
    webp,
    wrapped,
)
from optics.pages.glossary import GLOSSARY, explained
from optics.pages.mosaics import Eye
from optics.study.record import Record
from optics.study.shown import Fingerprint, Shown
from optics.words import ANYWHERE, NO_LIMIT, Reach, as_float, below, figures, fixed, share_text, some, spaced

BUDGET = 4_500_000  # bytes of embedded images; the page stays below 6 MB
SIDE_MAX = 512  # px; larger frames are binned for display
FRAMES_MIN = 4  # frames that stay when the budget is short; below that, pixels are binned
FINGERPRINTS_SHOWN = 4
FINGERPRINT_SIDE = 128  # px
FEW = 8  # values of a setting that colours or panels can tell apart
LINES = 24  # values of a setting above which no predicted curve is drawn for each
PANELS = 6
MARKS = 60_000  # readings drawn on a page, over steps and channels
LINEAR_TO = 15.0  # sigmas; residuals beyond bend their axis
PLACE = "place in the sweep"
MOVED_SHOWN = 3.0  # standard deviations; beyond, a parameter's move is marked

NO_IMAGES = {"frames": [], "steps": [], "channels": [], "note": ""}
FRAMES = {"frame": "frame", "frames": "frames", "data": "frames"}  # what the page calls the parts of the data
SWEEPS = {"frame": "sweep", "frames": "sweeps", "data": "readings"}
# the formats of a page: a true minus, powers of ten, a dash for what is missing
measure, pvalue = partial(words.with_sd, typeset=True), partial(words.p_text, typeset=True)


def scatter(pair: tuple[float, float]) -> str:
    """Mean ± standard deviation over frames; of a single frame, its own."""
    mean, sd = pair
    return measure(mean, sd) if math.isfinite(mean) and math.isfinite(sd) else number(mean, 5)


def estimated(v: Mapping) -> str:
    """A calibrated value of a step's record, with its standard deviation, or that it is not determined."""
    low, high = v.get("bounds") or (-math.inf, math.inf)
    reach = Reach(as_float(low), as_float(high), as_float(v.get("plausible")))
    return measure(v["value"], v["sd"], reach=reach)


CHANNEL_STYLE = {"R": "red", "G": "green", "B": "blue"}
SITE_STYLES = ("red", "green", "blue", "ochre")  # of the analysers of a mosaic, by angle


def report(study_folder: str | Path, out: str | Path, *, overwrite: bool = False) -> Path:
    """Write the page of a study to `out` (a file, or a folder: then report.html in it) and return its path.

    Raises OutputExists, FileNotFoundError when there is no study, ValueError when it has no step.
    """
    out = Path(out)
    out = out / "report.html" if out.is_dir() or not out.suffix else out
    spare_records(out)
    if out.exists() and not overwrite:
        raise OutputExists(f"{out} exists; name another file, or --force to replace it")
    return write_text(out, render(Record.open(study_folder)))


def render(study: Record) -> str:
    """The page as text."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    from optics.pages import residual_maps

    eye = Eye(study.ladder["facts"])
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        number=number,
        fixed=fixed,
        figures=figures,
        measure=measure,
        percent=percent,
        pvalue=pvalue,
    )
    environment.globals.update(measure=measure, scatter=scatter, estimated=estimated)
    comparisons = [study.comparison(i) for i in range(len(study.steps))]
    shown = [[eye.frame(f) for f in study.frames(i)] for i in range(len(study.steps))]
    points = Readings.of(shown)
    viewer = viewer_images(study, shown) if points is None else NO_IMAGES
    seen = [eye.maps(c) for c in comparisons]
    prints = [[eye.fingerprint(f) for f in study.fingerprints(i)] for i in range(len(study.steps))]
    nouns = FRAMES if points is None else SWEEPS
    verdicts = [verdict(told(study.diagnosis(i), points)) for i in range(len(study.steps))]
    page = environment.get_template("report.html.j2").render(
        glossary={k: v for k, v in GLOSSARY.items() if not points or "image" not in k + v},
        study=study.ladder,
        steps=study.steps,
        headline=headline(study, verdicts, nouns),
        verdicts=verdicts,
        tiles=tiles(study.steps),
        viewer=viewer,
        payload=_script(viewer),
        colour_bar=colour_bar(),
        woven=eye.note,
        nouns=nouns,
        points=points,
        plots=reading_plots(points, study.steps, comparisons[0].channels) if points else {},
        ladder_wide=ladder_chart(study, 920, 330, nouns),
        ladder_narrow=ladder_chart(study, 360, 300, nouns),
        fingerprints=[[] if points else fingerprint_images(own) for own in prints],
        readings=[] if viewer["frames"] or points else reading_charts(comparisons),
        curves=residual_curves(comparisons, points),
        channel_key=channel_key(comparisons[0]),
        maps=map_images(seen, study.steps) if points is None else [],
        pages=residual_maps.pages(seen, shown, study.steps) if points is None else [],
        coordinates=[residual_maps.coordinates(told(study.diagnosis(i), points)) for i in range(len(study.steps))],
        facts=facts(study.ladder["facts"], points),
        numbers=number_tables(comparisons, nouns),
        nulls=null_table(study.metrics(len(study.steps) - 1)),
        background=study.metrics(len(study.steps) - 1).get("background") or {},
        parameters=parameter_tables(study.steps),
        comparisons=comparisons,
    )
    return explained(page)


# -- words -----------------------------------------------------------------------------------------------------------
def headline(study: Record, verdicts: list, nouns: Mapping[str, str]) -> dict:
    """One sentence with the numbers that matter, and the last verdict."""
    first, last = _level(study.steps[0]), _level(study.steps[-1])
    floor = study.ladder["noise_floor"]["chi2_per_dof"]
    where = f"on held-out {nouns['data']}" if study.steps[-1]["held_out"] else f"on the fitted {nouns['data']}"
    added = _and([s["name"] for s in study.steps[1:]])
    now = f"{percent(last['misfit'])} of the signal, where noise alone is {percent(last['noise'])}"
    at_floor = last["chi2_per_dof"] <= floor * (1 + max(0.02, 4 * math.sqrt(2 / max(last["dof"], 1))))
    if added:
        fell = last["misfit"] < first["misfit"]
        text = (
            f"Adding {added} {'lowers' if fell else 'does not lower'} the misfit {where} from "
            f"{percent(first['misfit'])} to {now}."
        )
    else:
        text = f"The base model misses the measurement by {now} ({where})."
    rest = (
        "What is left is noise."
        if at_floor
        else (f"What is left is {math.sqrt(max(last['chi2_per_dof'] / floor, 0)):.2f} times the noise.")
    )
    return {
        "text": text,
        "rest": rest,
        "verdict": verdicts[-1],
        "title": study.ladder["title"] or study.ladder["scene"],
    }


def tiles(steps: Sequence[Mapping]) -> list[dict]:
    """Before and after, of the numbers that people compare."""
    first, last = _level(steps[0]), _level(steps[-1])
    which = "held out" if steps[-1]["held_out"] else "fitted"
    rows = (
        ("chi2_per_dof", "χ²/dof", "{:#.3g}"),
        ("l1", "L1 of full scale", "{:.4f}"),
        ("psnr", "PSNR, dB", "{:.1f}"),
        ("ssim", "SSIM", "{:.4f}"),
    )
    return [
        {"label": f"{label}, {which}", "before": _text(first[key], form), "after": _text(last[key], form)}
        for key, label, form in rows
        if math.isfinite(last[key])
    ]


def facts(record: Mapping, points: Readings | None = None) -> dict[str, list[tuple[str, str]]]:
    """What a study notes about its data, as text: plain values to list, and tables of settings to fold away."""

    def text(key: str, value) -> str:
        if isinstance(value, float):
            return percent(value) if key == "masked" else number(value, 4)
        if key == "mosaic":
            return " / ".join(" ".join(f"{angle:g}°" for angle in row) for row in value)
        if isinstance(value, (list, tuple)):
            return (" × " if all(isinstance(v, int) for v in value) else ", ").join(map(str, value))
        return json.dumps(value) if isinstance(value, Mapping) else str(value)

    plain = [(k.replace("_", " "), text(k, v)) for k, v in record.items() if not isinstance(v, Mapping)]
    if points is not None:
        plain = [
            ("readings", f"{len(points.measured)} in {points.sweeps} sweeps"),
            ("channels", str(points.measured.shape[1])),
            *(
                (f"{k} sweeps" if k in ("fitted", "held out") else k, v)
                for k, v in plain
                if k not in ("frames", "image")
            ),
        ]
    folded = [
        (k.replace("_", " "), text(k, v))
        for table in record.values()
        if isinstance(table, Mapping)
        for k, v in table.items()
        if v not in (None, "", [], {})
    ]
    return {"plain": plain, "folded": folded}


def null_table(metrics: Mapping) -> dict:
    """The null models of a step beside its own; empty where there are none."""
    if not metrics.get("nulls"):
        return {}
    from optics.fit import null_models as nulls

    table = nulls.NullTable.from_json(metrics["nulls"])
    tables = [
        {
            "title": f"{split}, {len(names)} frames",
            "rows": [
                {
                    "name": "this model" if s.model == nulls.PHYSICAL else s.model,
                    "own": s.model == nulls.PHYSICAL,
                    "errors": [*s.rms_near, *s.rms_whole],
                }
                for s in table.scores
                if s.split == split
            ],
        }
        for split, names in (("held out", table.held_out), ("fitted", table.fitted))
    ]
    return {
        "tables": tables,
        "noise": table.noise,
        "channels": table.channels,
        "near": f"{nulls.NEAR:g}",
        "won": table.won,
    }


def _level(step: Mapping) -> dict:
    """The numbers of the held-out frames, else of the fitted ones; NaN where a number is missing."""
    level = step["held_out"] or step["fitted"] or step["total"] or {}
    keys = ("chi2_per_dof", "dof", "misfit", "noise", "l1", "psnr", "ssim")
    return {k: math.nan if level.get(k) is None else float(level[k]) for k in keys}


def _and(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + f" and {names[-1]}" if names else ""


def _text(value: float, form: str) -> str:
    return form.format(value) if math.isfinite(value) else "–"


# -- images ----------------------------------------------------------------------------------------------------------
def viewer_images(study: Record, steps: list[list[Shown]]) -> dict:
    """What the viewer shows: measured once per frame, predicted and residual per frame and step.

    Fewer frames, then binned pixels, keep the page small; `note` says so.
    """
    names = [n for n in study.ladder["shown"] if all(any(f.name == n for f in frames) for frames in steps)]
    if not names or max(steps[0][0].measured.shape[:2]) < SIDE_MIN:
        return NO_IMAGES
    table = [{f.name: f for f in frames} for frames in steps]
    held = next((n for n in names if table[0][n].held_out), None)
    if held in names[FRAMES_MIN:]:  # stays when frames are left out
        names = [*(rest := [n for n in names if n != held])[: FRAMES_MIN - 1], held, *rest[FRAMES_MIN - 1 :]]
    rows = [{r.scope["frame"]: r for r in study.comparison(i).by("frame")} for i in range(len(table))]
    bins = max(math.ceil(max(table[0][n].measured.shape[:2]) / SIDE_MAX) for n in names)
    while True:
        bundles, total = [], 0
        for name in names:
            bundle = _encode(name, table, rows, bins)
            total += bundle.pop("bytes")
            if total > BUDGET and (len(bundles) >= FRAMES_MIN or bins < min(table[0][name].measured.shape[:2])):
                break
            bundles.append(bundle)
        if len(bundles) >= min(FRAMES_MIN, len(names)):
            break
        bins += 1
    notes = []
    if len(bundles) < len(names):
        notes.append(f"{len(names) - len(bundles)} of {len(names)} recorded frames are left out to keep the page small")
    if bins > 1:
        notes.append(
            f"shown in blocks of {bins}×{bins} pixels; residuals are summed over a block and divided by the root "
            "of its pixel count, so that noise keeps a standard deviation of 1"
        )
    count = table[0][names[0]].measured.shape[2]
    return {
        "frames": [b["frame"] for b in bundles],
        "channels": {1: ["L"], 3: ["R", "G", "B"]}.get(count, ["all"]),
        "steps": [
            {"name": step["name"], "frames": [b["steps"][i] for b in bundles]} for i, step in enumerate(study.steps)
        ],
        "note": "; ".join(notes),
    }


def _encode(name: str, table: list[dict[str, Shown]], rows: list[dict], bins: int) -> dict:
    """One frame: what was measured, and what each step predicts and leaves over, as data URIs."""
    f = table[0][name]
    y, white = _block(f.measured, bins), _white(f)
    frame = {
        "name": name,
        "led": f.led,
        "group": f.group,
        "heldOut": f.held_out,
        "height": y.shape[0],
        "width": y.shape[1],
        "white": white,
        "measured": webp(eight_bit(y, white)),
        "grey": y.shape[2] not in (1, 3),
    }
    steps = []
    for shown, row in zip(table, rows):
        f = shown[name]
        steps.append(
            {
                "predicted": webp(eight_bit(_block(f.predicted, bins), white)),
                "residual": webp(codes(colour_planes(_block_sigma(f.residual, bins)))),
                "chi2": figures(row[name].chi2_per_dof, 3) if name in row else "–",
            }
        )
    size = len(frame["measured"]) + sum(len(s["predicted"]) + len(s["residual"]) for s in steps)
    return {"frame": frame, "steps": steps, "bytes": size}


def _white(frame: Shown) -> float:
    """DN that is shown white: a round number above 99 % of the values, the same for measured and predicted."""
    top = float(np.nanpercentile(frame.measured, 99)) if np.isfinite(frame.measured).any() else 1.0
    step = 10 ** math.floor(math.log10(max(top, 1e-9))) / 4
    return math.ceil(max(top, 1e-9) / step) * step


def _blocks(image: np.ndarray, bins: int) -> np.ndarray:
    """(H, W, C) -> (H/b, W/b, C, b*b), cropped to whole blocks."""
    h, w = image.shape[0] // bins, image.shape[1] // bins
    cut = image[: h * bins, : w * bins].reshape(h, bins, w, bins, -1)
    return cut.transpose(0, 2, 4, 1, 3).reshape(h, w, image.shape[2], bins * bins)


def _block(image: np.ndarray, bins: int) -> np.ndarray:
    return image if bins == 1 else _blocks(image, bins).mean(-1)


def _block_sigma(z: np.ndarray, bins: int) -> np.ndarray:
    if bins == 1:
        return z
    blocks = _blocks(z, bins)
    n = np.isfinite(blocks).sum(-1)
    return np.where(n > 0, np.nansum(blocks, -1) / np.sqrt(np.maximum(n, 1)), np.nan)


def fingerprint_images(fingerprints: Sequence[Fingerprint]) -> list[dict]:
    """Per effect: what it would add, beside the residual that it is to explain, on one scale."""
    out = []
    for f in fingerprints[:FINGERPRINTS_SHOWN]:
        if max(f.image.shape[:2]) < SIDE_MIN:
            continue
        bins = max(1, math.ceil(max(f.image.shape[:2]) / FINGERPRINT_SIDE))
        image, residual = (combined(_block_sigma(a, bins)) / bins for a in (f.image, f.residual))
        top = float(np.nanpercentile(np.abs(image), 99.5)) if np.isfinite(image).any() else 0.0
        noise = 1 / bins
        scale = rounded_up(max(top, 2 * noise))
        out.append(
            {
                "effect": f.effect,
                "key": _key(f.effect),
                "frame": f.frame,
                "strength": f.strength,
                "scale": number(scale),
                "image": coloured(image, -scale, scale, DIVERGING),
                "width": image.shape[1],
                "height": image.shape[0],
                "residual": coloured(residual, -scale, scale, DIVERGING),
            }
        )
    return out


def map_images(comparisons: list[Comparison], steps: Sequence[Mapping]) -> list[dict]:
    """Of the first and the last step: mean residual over all frames, and its root mean square, per pixel."""
    out = []
    for i in dict.fromkeys((0, len(comparisons) - 1)):
        c = comparisons[i]
        if c.mean_map is None or max(c.mean_map.shape[:2]) < SIDE_MIN:
            continue
        bins = max(1, math.ceil(max(c.mean_map.shape[:2]) / 256))
        mean = combined(_block_sigma(c.mean_map * math.sqrt(len(c.frames)), bins))
        square = np.where(np.isfinite(c.rms_map), c.rms_map.astype(float) ** 2, np.nan)
        count = np.isfinite(square).sum(2)
        rms = np.sqrt(np.where(count > 0, np.nansum(square, 2) / np.maximum(count, 1), np.nan))
        rms = _block_sigma(rms[..., None], bins)[..., 0] / bins
        out.append(
            {
                "step": step_name(steps[i]),
                "mean": coloured(mean, -SIGMA_RANGE, SIGMA_RANGE, DIVERGING),
                "rms": coloured(rms, 0, SIGMA_RANGE, SEQUENTIAL),
                "width": mean.shape[1],
                "height": mean.shape[0],
            }
        )
    return out


def _script(viewer: dict) -> str:
    """The viewer's data for a script element; '<' is written so that no text can end the element."""
    data = {
        **viewer,
        "ramp": ramp(DIVERGING, 81),
        "masked": rgb(MASKED),
        "range": SIGMA_RANGE,
        "perSigma": CODES_PER_SIGMA,
    }
    return json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")


# -- readings --------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Readings:
    """All point readings of a study: (M,) settings by key, (M, C) DN measured, and of each step (M, C) predicted and
    residual.

    residual  measured minus predicted in sigmas, NaN where not usable
    """

    settings: dict[str, np.ndarray]
    units: Mapping[str, str]
    held_out: np.ndarray
    measured: np.ndarray
    predicted: list[np.ndarray]
    residual: list[np.ndarray]
    sweeps: int

    @classmethod
    def of(cls, steps: Sequence[Sequence[Shown]]) -> Readings | None:
        """The readings of a study's frames, step by step; None where they are images or single readings without
        settings."""
        shown = steps[0]
        names = [f.name for f in shown]
        if (
            not shown
            or not all(f.settings or _column(f) for f in shown)
            or any([f.name for f in s] != names for s in steps)
        ):
            return None
        own = [f.settings or {PLACE: np.arange(len(f.measured))} for f in shown]
        settings = {k: np.concatenate([o[k] for o in own]) for k in own[0] if all(k in o for o in own)}
        settings = {k: np.round(v.astype(float), 6) if v.dtype.kind in "fiu" else v for k, v in settings.items()}

        def joined(values) -> np.ndarray:
            return np.concatenate([np.reshape(v, (len(v), -1)) for v in values])

        return cls(
            settings,
            shown[0].units,
            np.concatenate([np.full(len(f.measured), f.held_out) for f in shown]),
            joined(f.measured for f in shown),
            [joined(f.predicted for f in s) for s in steps],
            [joined(f.residual for f in s) for s in steps],
            len(shown),
        )

    def folds(self) -> tuple[str, list[str], list[str]]:
        """The setting to draw along, the one told apart by colour (or none), and those told apart by panels.

        Along: of those with many values an angle before others and time last, then the one with the most.
        """
        count = {k: len(np.unique(v)) for k, v in self.settings.items()}
        numbers = [k for k in count if self.settings[k].dtype.kind == "f"]
        if not numbers:
            return "", [], []
        many = [k for k in numbers if count[k] > FEW] or numbers
        unit = self.units.get
        along = max(many, key=lambda k: (unit(k) == "deg", unit(k) not in ("s", "min", "h"), count[k]))
        few = sorted((k for k in count if k != along and 1 < count[k] <= FEW), key=lambda k: -count[k])
        panels: list[str] = []
        for key in few[1:]:
            if len(self.cells([*panels, key])[1]) <= PANELS:
                panels.append(key)
        return along, few[:1], panels

    def cells(self, keys: Sequence[str]) -> tuple[np.ndarray, list[str]]:
        """(M,) which combination of these settings each reading has, and the combinations in words."""
        if not keys:
            return np.zeros(len(self.measured), int), [""]
        codes = np.stack([np.unique(self.settings[k], return_inverse=True)[1] for k in keys], 1)
        _, first, cell = np.unique(codes, axis=0, return_index=True, return_inverse=True)
        return cell.ravel(), [", ".join(self.words(k, self.settings[k][i]) for k in keys) for i in first]

    def words(self, key: str, value) -> str:
        text = number(value, 4) if isinstance(value, float) else str(value)
        return f"{key} {text}{spaced(self.units.get(key, ''))}"


def _column(f: Shown) -> bool:
    """A sweep that was recorded without its settings."""
    return f.measured.shape[1] == 1 and len(f.measured) >= SIDE_MIN


def reading_plots(r: Readings, steps: Sequence[Mapping], channels: Sequence[str]) -> dict:
    """Per step and channel the panels of readings and residuals against one setting, on the same scales throughout."""
    along, colour, panel_keys = r.folds()
    if not along:
        return {}
    hue, hues = r.cells(colour) if colour else (np.full(len(r.measured), -1), [])  # class k-1: ink
    panel, titles = r.cells(panel_keys)
    lines = [k for k, v in r.settings.items() if k != along and len(np.unique(v)) <= LINES]
    line, _ = r.cells(lines)
    plots = len(steps) * r.measured.shape[1]
    stride = math.ceil(len(r.measured) * plots / MARKS)
    drawn = np.arange(len(r.measured)) % stride == 0
    finite = [np.abs(z[np.isfinite(z)]) for z in r.residual]
    top = max(4.0, *(float(z.max(initial=0)) for z in finite))
    values = np.concatenate([r.measured, *r.predicted])
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    scales = (float(r.settings[along].min()), float(r.settings[along].max())), (min(low, 0.0), high), top
    axis = ",".join(filter(None, (_spoken(along), spaced(r.units.get(along, "")))))
    out = []
    for i in range(len(steps)):
        for c in range(r.measured.shape[1]):
            z = r.residual[i][:, c]
            beyond = float(np.mean(np.abs(z[np.isfinite(z)]) > 3)) if np.isfinite(z).any() else math.nan
            out.append(
                {
                    "step": i,
                    "channel": c,
                    "beyond": percent(beyond, 2),
                    "panels": [
                        reading_panel(r, i, c, along, axis, (panel == p) & drawn, panel == p, hue, line, scales, title)
                        for p, title in enumerate(titles)
                    ],
                }
            )
    return {
        "plots": out,
        "channels": list(channels),
        "along": _spoken(along),
        "hues": hues,
        "panels": len(titles),
        "merged": [k for k in lines if k not in (*colour, *panel_keys) and len(np.unique(r.settings[k])) > 1],
        "note": f"one reading in {stride} is drawn" if stride > 1 else "",
    }


def reading_panel(
    r: Readings,
    step: int,
    channel: int,
    along: str,
    axis: str,
    drawn: np.ndarray,
    mine: np.ndarray,
    hue: np.ndarray,
    line: np.ndarray,
    scales: tuple,
    title: str,
    width: int = 460,
) -> str:
    """SVG: readings as points (held out: rings) on the predicted curves, and below them the residual in sigmas.

    The residual's axis is linear to about 3 sigmas and logarithmic beyond where some step leaves more than 15.
    """
    left, right, top, bottom, split, floor = 50, 8, 26, 326, 200, 364
    (x_low, x_high), (y_low, y_high), z_top = scales
    bent = z_top > LINEAR_TO

    def shape(value):
        return np.arcsinh(np.asarray(value) / 3) if bent else np.asarray(value)

    def z(value):
        return z_at(shape(value))

    pad = 0.04 * ((y_high - y_low) or 1.0)
    x, y = scaled(x_low, x_high, left + 6, width - right - 6), scaled(y_low - pad, y_high + pad, split - 12, top)
    reach = 1.06 * float(shape(z_top))
    z_at = scaled(-reach, reach, bottom, split)

    def grid(at: float, text: str, style: str = "grid") -> str:
        return (
            f'<line class="{style}" x1="{left}" x2="{width - right}" y1="{at:.1f}" y2="{at:.1f}"/>'
            f'<text class="tick" x="{left - 6}" y="{at + 4:.1f}" text-anchor="end">{text}</text>'
        )

    parts = [f'<text class="title" x="{left}" y="14">{escaped(title)}</text>'] if title else []
    parts += [grid(y(t), number(t, 4)) for t in ticks_between(y_low, y_high, 4)]
    for sigmas in (3, 1):
        parts.append(
            f'<rect class="sigmas" x="{left}" width="{width - left - right}" y="{z(sigmas):.1f}" '
            f'height="{z(-sigmas) - z(sigmas):.1f}"/>'
        )
    marks = (
        [t for t in (3, 10, 30, 100, 300, 1000, 3000, 10000) if t <= z_top]
        if bent
        else [3, *([10] if z_top > 10 else [])]
    )
    parts += [grid(float(z(s * t)), ("+" if s > 0 else "−") + number(t, 5)) for t in marks for s in (1, -1)]
    parts.append(grid(float(z(0)), "0 σ", "zero"))
    parts += [
        f'<text class="tick" x="{x(t):.1f}" y="{bottom + 16}" text-anchor="middle">{number(t, 4)}</text>'
        for t in _angles(x_low, x_high, r.units.get(along, ""))
    ]
    parts.append(
        f'<text class="axis" x="{(left + width - right) / 2:.0f}" y="{floor - 6}" text-anchor="middle">'
        f"{escaped(axis)}</text>"
    )
    at, predicted, measured, sigma = (
        v[..., channel] if v.ndim > 1 else v
        for v in (r.settings[along], r.predicted[step], r.measured, r.residual[step])
    )
    for h in np.unique(hue[mine]):
        own = mine & (hue == h)
        parts.append(_predictions(at[own], predicted[own], line[own], x, y, f"k{h}", 0.05 * (y_high - y_low)))
    for values, scale in ((measured, y), (sigma, z)):
        good = drawn & np.isfinite(sigma)
        if scale is y:
            parts.append(_dots("mark off", x(at[drawn & ~good]), y(measured[drawn & ~good])))
        for h in np.unique(hue[good]):
            for held in (False, True):
                own = good & (hue == h) & (r.held_out == held)
                where = x(at[own]), scale(values[own])
                parts.append(
                    _dots(f"mark k{h}{' held' if held else ''}", *where) + (_dots("hole", *where) if held else "")
                )
    used = sigma[mine & np.isfinite(sigma)]
    rms = number(math.sqrt(np.mean(used**2))) if len(used) else "–"
    return svg_chart(
        width,
        floor,
        parts,
        f"Readings and predictions against {along}{', ' if title else ''}{title}, residual below: "
        f"{mine.sum()} readings, rms residual {rms} sigmas",
    )


def _dots(style: str, xs: np.ndarray, ys: np.ndarray) -> str:
    """Points as one path of strokes without length: a round cap makes each a dot."""
    return f'<path class="{style}" d="{"".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(xs, ys))}"/>' if len(xs) else ""


def _predictions(at: np.ndarray, predicted: np.ndarray, line: np.ndarray, x, y, style: str, tolerance: float) -> str:
    """Curves through the predictions of each line, or of all where lines are too short; a dash each where none is
    smooth."""
    for group in (line, np.zeros_like(line)):
        curves = [_averaged(at[group == g], predicted[group == g]) for g in np.unique(group)]
        if all(_smooth(*curve, tolerance) for curve in curves):
            return "".join(f'<path class="curve {style}" d="{_bezier(x(a), y(b))}"/>' for a, b, _ in curves)
    return (
        f'<path class="curve {style}" d="{"".join(f"M{a - 4:.1f} {b:.1f}h8" for a, b in zip(x(at), y(predicted)))}"/>'
    )


def _averaged(at: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Sorted abscissas, each once, with the mean there, and the largest distance of a value from its mean."""
    centres, which = np.unique(at, return_inverse=True)
    mean = np.bincount(which, values) / np.bincount(which)
    return centres, mean, float(np.abs(values - mean[which]).max())


def _smooth(at: np.ndarray, values: np.ndarray, spread: float, tolerance: float) -> bool:
    """Whether every value lies within the tolerance of the cubic through its four neighbours."""
    if len(at) < 6 or not spread <= tolerance:
        return False
    near = (-2, -1, 1, 2)
    a = [at[2 + j : len(at) - 2 + j] for j in near]
    cubic = sum(
        values[2 + j : len(at) - 2 + j] * math.prod((at[2:-2] - a[m]) / (a[n] - a[m]) for m in range(4) if m != n)
        for n, j in enumerate(near)
    )
    return bool(np.all(np.abs(cubic - values[2:-2]) <= tolerance))


def _bezier(x: np.ndarray, y: np.ndarray) -> str:
    """A path through the points with continuous slopes."""
    slope, third = np.gradient(y, x), np.diff(x) / 3
    segments = np.stack(
        [x[:-1] + third, y[:-1] + third * slope[:-1], x[1:] - third, y[1:] - third * slope[1:], x[1:], y[1:]], 1
    )
    return f"M{x[0]:.1f} {y[0]:.1f}" + "".join("C" + " ".join(f"{v:.1f}" for v in row) for row in segments)


def _angles(low: float, high: float, unit: str) -> list[float]:
    """Ticks; of angles over more than a right angle, whole parts of a turn."""
    if unit != "deg" or high - low < 90:
        return ticks_between(low, high, 6)
    step = next(s for s in (30, 45, 90, 180, 360, 720, 1e9) if (high - low) / s <= 9)
    return [k * step for k in range(math.ceil(low / step), math.floor(high / step) + 1)]


# -- charts ----------------------------------------------------------------------------------------------------------
def ladder_chart(study: Record, width: int, height: int, nouns: Mapping[str, str] = FRAMES) -> str:
    """SVG: chi2/dof of every step, held out and fitted, over the noise floor, on a logarithmic scale."""
    steps = study.steps
    floor = study.ladder["noise_floor"]["chi2_per_dof"]
    lines = [(key, [_value(s[key], "chi2_per_dof") for s in steps]) for key in ("fitted", "held_out")]
    values = [v for _, line in lines for v in line if math.isfinite(v) and v > 0] or [floor]
    low, high = 0.88 * min([floor, *values]), 1.3 * max([1.25 * floor, *values])
    left, right, top, bottom = 46, 16, 34, 62
    x = scaled(-0.35, len(steps) - 0.65, left, width - right)
    y = scaled(math.log(low), math.log(high), height - bottom, top)
    parts = []
    for tick in log_ticks_between(low, high):
        at = y(math.log(tick))
        parts.append(
            f'<line class="grid" x1="{left}" x2="{width - right}" y1="{at:.1f}" y2="{at:.1f}"/>'
            f'<text class="tick" x="{left - 7}" y="{at + 4:.1f}" text-anchor="end">{number(tick)}</text>'
        )
    dof = max([_value(s["held_out"] or s["fitted"], "dof") for s in steps[-1:]] + [1.0])
    spread = 2 * math.sqrt(2 / dof) if math.isfinite(dof) else 0.0
    up, down = y(min(math.log(floor * (1 + spread)), math.log(high))), y(math.log(max(floor * (1 - spread), low)))
    at = y(math.log(floor))
    parts.append(
        f'<rect class="floorband" x="{left}" width="{width - left - right}" y="{up:.1f}" '
        f'height="{max(down - up, 0.5):.1f}"/>'
        f'<line class="floor" x1="{left}" x2="{width - right}" y1="{at:.1f}" y2="{at:.1f}"/>'
        f'<text class="floorlabel" x="{width - right}" y="{at + 15:.1f}" text-anchor="end">'
        f"noise floor {figures(floor, 3)}</text>"
    )
    for key, line in lines:
        points = [(x(i), y(math.log(v)), v) for i, v in enumerate(line) if math.isfinite(v) and v > 0]
        if not points:
            continue
        path = " ".join(f"{px:.1f},{py:.1f}" for px, py, _ in points)
        parts.append(f'<polyline class="line {key}" points="{path}"/>')
        parts += [
            f'<circle class="dot {key}" cx="{px:.1f}" cy="{py:.1f}" r="5"><title>{number(v)}</title></circle>'
            for px, py, v in points
        ]
        if key == "held_out" or not any(math.isfinite(v) for v in lines[1][1]):
            parts += [
                f'<text class="value" x="{px + 9:.1f}" y="{py - 9:.1f}">{figures(v, 3)}</text>' for px, py, v in points
            ]
    slot = (width - left - right) / max(len(steps), 1)
    for i, step in enumerate(steps):
        for k, label in enumerate(wrapped(("+ " if i else "") + step["name"], max(8, int(slot / 6.6)))[:3]):
            parts.append(
                f'<text class="step" x="{x(i):.1f}" y="{height - bottom + 22 + 15 * k}" text-anchor="middle">'
                f"{escaped(label)}</text>"
            )
    parts.append(f'<text class="tick" x="{left}" y="14">χ²/dof</text>')
    legend = width - right
    for key, label, wide in (("fitted", f"fitted {nouns['data']}", 92), ("held_out", f"held-out {nouns['data']}", 122)):
        if any(math.isfinite(v) for v in dict(lines)[key]):
            legend -= wide
            parts.append(
                f'<circle class="dot {key}" cx="{legend:.0f}" cy="10" r="5"/>'
                f'<text class="tick" x="{legend + 10:.0f}" y="14">{label}</text>'
            )
    said = "; ".join(
        f"{step_name(s)}: held out {number(_value(s['held_out'], 'chi2_per_dof'))}, "
        f"fitted {number(_value(s['fitted'], 'chi2_per_dof'))}"
        for s in steps
    )
    return svg_chart(width, height, parts, f"Chi-squared per degree of freedom. {said}. Noise floor {number(floor)}.")


def residual_curves(comparisons: list[Comparison], points: Readings | None = None) -> list[dict]:
    """One small chart per coordinate: the first step's curve, of each colour or analyser too, and the last step's."""
    first, final = comparisons[0].curves, comparisons[-1].curves
    if points is not None:
        first, final = (
            [
                replace(
                    c,
                    coordinate="sweep" if c.coordinate == "frame" else c.coordinate,
                    unit=points.units.get(c.coordinate, c.unit),
                )
                for c in curves
            ]
            for curves in (first, final)
        )
    last = {c.coordinate: c for c in final if c.channel == "all"}
    styles, out = channel_styles(comparisons[0]), []
    for curve in (c for c in first if c.channel == "all"):
        channels = [c for c in first if c.coordinate == curve.coordinate and c.channel in styles]
        after = last.get(curve.coordinate) if len(comparisons) > 1 else None
        own = [c for c in final if c.coordinate == curve.coordinate and c.channel in styles]
        alone = curve_chart(after, own, styles=styles) if after is not None else ""
        out.append({"svg": curve_chart(curve, channels, after, styles), "alone": alone})
    return out


def channel_styles(c: Comparison) -> dict[str, str]:
    """Channel of a curve -> class of its colour: of a colour camera's channels, or of the analysers of a mosaic."""
    sites = list(dict.fromkeys(curve.channel for curve in c.curves if curve.channel.endswith(" deg")))
    return {**CHANNEL_STYLE, **dict(zip(sites, SITE_STYLES))}


def channel_key(c: Comparison) -> list[tuple[str, str]]:
    """(class of its colour, name) of the lines of channels in `residual_curves`."""
    if len(c.channels) == 3:
        return [("red", "its red"), ("green", "green"), ("blue", "blue")]
    sites = {name: style for name, style in channel_styles(c).items() if name not in CHANNEL_STYLE}
    return [
        (style, f"{'' if k else 'analyser '}{name.removesuffix(' deg')}\N{DEGREE SIGN}")
        for k, (name, style) in enumerate(sites.items())
    ]


def curve_chart(
    curve: Curve,
    channels: Sequence[Curve] = (),
    after: Curve | None = None,
    styles: Mapping[str, str] = CHANNEL_STYLE,
    width: int = 340,
    height: int = 210,
) -> str:
    """SVG: mean residual in sigmas +- standard error against a coordinate."""
    left, right, top, bottom = 42, 12, 12, 38
    drawn = [c for c in (curve, after, *channels) if c is not None]
    extent = np.concatenate([c.mean + k * np.nan_to_num(c.se) for c in drawn for k in (-1, 1)])
    extent = extent[np.isfinite(extent)]
    top_value = max(float(np.abs(extent).max()) if len(extent) else 1.0, 0.1)
    low = min(float(extent.min()) if len(extent) else 0.0, -0.15 * top_value)
    high = max(float(extent.max()) if len(extent) else 0.0, 0.15 * top_value)
    pad = 0.08 * (high - low)
    y = scaled(low - pad, high + pad, height - bottom, top)
    centres = np.concatenate([c.centre for c in drawn])
    centres = centres[np.isfinite(centres)]
    if not len(centres):
        return ""
    x_low, x_high = float(centres.min()), float(centres.max())
    gap = 0.04 * (x_high - x_low) or 0.5
    gap = 0.5 if curve.labels else gap
    x = scaled(x_low - gap, x_high + gap, left, width - right)
    parts = []
    marks = ticks_between(low - pad, high + pad, 4)
    for tick in marks if len(marks) > 2 else ticks_between(low - pad, high + pad, 8):
        parts.append(
            f'<line class="grid" x1="{left}" x2="{width - right}" y1="{y(tick):.1f}" y2="{y(tick):.1f}"/>'
            f'<text class="tick" x="{left - 6}" y="{y(tick) + 4:.1f}" text-anchor="end">{number(tick)}</text>'
        )
    parts.append(f'<line class="zero" x1="{left}" x2="{width - right}" y1="{y(0):.1f}" y2="{y(0):.1f}"/>')
    if curve.labels and len(curve.labels) <= 4:
        ticks = [(i, escaped(label)) for i, label in enumerate(curve.labels)]
    else:
        ticks = [(t, number(t, 4)) for t in ticks_between(x_low, x_high, 5)]
    parts += [
        f'<text class="tick" x="{x(t):.1f}" y="{height - bottom + 16}" text-anchor="middle">{label}</text>'
        for t, label in ticks
    ]
    unit = f", {curve.unit}" if curve.unit and curve.unit != "1" else ""
    number_of = " number" if curve.coordinate in ("frame", "sweep") else ""
    parts.append(
        f'<text class="axis" x="{(left + width - right) / 2:.0f}" y="{height - 4}" text-anchor="middle">'
        f"{escaped(_spoken(curve.coordinate))}{number_of}{unit}</text>"
    )
    for c in channels:
        good = np.isfinite(c.centre) & np.isfinite(c.mean)
        points = " ".join(f"{x(a):.1f},{y(b):.1f}" for a, b in zip(c.centre[good], c.mean[good]))
        parts.append(f'<polyline class="channel {styles[c.channel]}" points="{points}"/>')
    for c, style in ((curve, "before"), (after, "after")):
        if c is None:
            continue
        style = "after" if after is None else style
        good = np.isfinite(c.centre) & np.isfinite(c.mean)
        points = " ".join(f"{x(a):.1f},{y(b):.1f}" for a, b in zip(c.centre[good], c.mean[good]))
        if not c.labels:
            parts.append(f'<polyline class="{style}" points="{points}"/>')
        for a, b, e in zip(c.centre[good], c.mean[good], np.nan_to_num(c.se[good])):
            parts.append(
                f'<line class="bar {style}" x1="{x(a):.1f}" x2="{x(a):.1f}" y1="{y(b - e):.1f}" y2="{y(b + e):.1f}"/>'
                f'<circle class="point {style}" cx="{x(a):.1f}" cy="{y(b):.1f}" r="2.4"/>'
            )
    largest = float(np.nanmax(np.abs(curve.mean))) if np.isfinite(curve.mean).any() else math.nan
    return svg_chart(
        width,
        height,
        parts,
        f"Mean residual in sigmas against {curve.coordinate}; largest at first {number(largest)}"
        + (f", at last {number(float(np.nanmax(np.abs(after.mean))))}" if after is not None else ""),
    )


def _spoken(key: str) -> str:
    """A coordinate as words; the key of a parameter stays as it is."""
    return key if "." in key else key.replace("_", " ")


def _reading_curve(key: str, unit: str, x: np.ndarray, values, se) -> Curve:
    """Readings or predictions against a setting; se: standard errors."""
    one = np.ones(len(x))
    return Curve(key, unit, "all", x, np.array(values), np.array(se), one, one)


def reading_charts(comparisons: list[Comparison]) -> list[str]:
    """For frames of one or a few pixels: mean reading against each setting that varies, with the prediction."""
    first, last = comparisons[0], comparisons[-1]
    keys = [k for k in (last.frames[0].get("settings") or {}) if len({f["settings"].get(k) for f in last.frames}) > 2]
    out = []
    for key in keys:
        x = np.array([as_float(f["settings"].get(key)) for f in last.frames])
        order = [int(i) for i in np.argsort(x, kind="stable") if math.isfinite(x[i])]
        rows, before = last.by("frame"), first.by("frame")
        order = [i for i in order if rows[i].n]
        one = np.ones(len(order))
        unit = next((c.unit for c in last.curves if c.coordinate == key), "")
        curve = partial(_reading_curve, key, unit, x[order])
        measured = curve(
            [rows[i].signal + rows[i].bias for i in order], [rows[i].noise / math.sqrt(rows[i].n) for i in order]
        )
        lines = [("after", curve([rows[i].signal for i in order], 0 * one))]
        if len(comparisons) > 1:
            lines.insert(0, ("before", curve([before[i].signal for i in order], 0 * one)))
        out.append(_reading_chart(measured, lines))
    return out


def _reading_chart(measured: Curve, lines: Sequence[tuple[str, Curve]], width: int = 520, height: int = 280) -> str:
    left, right, top, bottom = 52, 12, 12, 38
    values = np.concatenate([measured.mean, *(c.mean for _, c in lines)])
    span = float(np.ptp(values)) or 1.0
    x = scaled(float(measured.centre.min()), float(measured.centre.max()), left + 6, width - right - 6)
    low, high = float(values.min()) - 0.06 * span, float(values.max()) + 0.06 * span
    y = scaled(low, high, height - bottom, top)
    parts = [
        f'<line class="grid" x1="{left}" x2="{width - right}" y1="{y(t):.1f}" y2="{y(t):.1f}"/>'
        f'<text class="tick" x="{left - 6}" y="{y(t) + 4:.1f}" text-anchor="end">{number(t, 4)}</text>'
        for t in ticks_between(low, high, 5)
    ]
    parts += [
        f'<text class="tick" x="{x(t):.1f}" y="{height - bottom + 16}" text-anchor="middle">{number(t, 4)}</text>'
        for t in ticks_between(float(measured.centre.min()), float(measured.centre.max()), 6)
    ]
    unit = f", {measured.unit}" if measured.unit else ""
    parts.append(
        f'<text class="axis" x="{(left + width - right) / 2:.0f}" y="{height - 4}" text-anchor="middle">'
        f"{escaped(_spoken(measured.coordinate))}{unit}</text>"
    )
    for style, c in lines:
        points = " ".join(f"{x(a):.1f},{y(b):.1f}" for a, b in zip(c.centre, c.mean))
        parts.append(f'<polyline class="{style}" points="{points}"/>')
    for a, b, e in zip(measured.centre, measured.mean, measured.se):
        parts.append(
            f'<line class="bar ink" x1="{x(a):.1f}" x2="{x(a):.1f}" y1="{y(b - e):.1f}" y2="{y(b + e):.1f}"/>'
            f'<circle class="point ink" cx="{x(a):.1f}" cy="{y(b):.1f}" r="3"/>'
        )
    return svg_chart(width, height, parts, f"Readings and predictions against {measured.coordinate}")


def _value(level: Mapping | None, key: str) -> float:
    value = (level or {}).get(key)
    return math.nan if value is None else float(value)


def number_tables(comparisons: list[Comparison], nouns: Mapping[str, str] = FRAMES) -> list[dict]:
    """Rows of the last step by frame, LED, group, channel and region, each with the first step's chi2/dof."""
    first, last = comparisons[0], comparisons[-1]
    out = []
    data, frames = nouns["data"].capitalize(), nouns["frames"].capitalize()
    for scope, title in (
        ("role", f"{data} fitted and held out"),
        ("frame", frames),
        ("led", "LEDs"),
        ("group", "Presses"),
        ("channel", "Channels"),
        ("region", "Regions"),
    ):
        before = {r.label: r.chi2_per_dof for r in first.by(scope)}
        rows = [{"label": r.label, "before": before.get(r.label, math.nan), "row": r} for r in last.by(scope)]
        if scope == "group" and len(rows) == len(last.frames):
            continue  # every frame its own group: the table of frames says it
        if len(rows) > 1 or scope == "frame":
            out.append({"scope": scope, "title": title, "rows": rows})
    return out


def parameter_tables(steps: Sequence[Mapping]) -> dict:
    """Every calibrated number with its value in each step, its pull against the prior and how far it moved.

    moved: last minus first value in standard deviations of the first: what the first step's own error bar would have
    had to cover, so a large one says that a missing effect had pushed the parameter away.
    """
    by_step = [{v["name"]: v for v in s["variables"]} for s in steps]
    names = list(dict.fromkeys(n for variables in by_step for n in variables))
    common, own = [], []
    for name in names:
        values = [variables.get(name) for variables in by_step]
        present = [v for v in values if v]
        first, last = present[0], present[-1]
        moved, sd = math.nan, as_float(first.get("sd"))
        if len(present) > 1 and sd > 0:  # not where nothing determined it: infinite
            moved = (last["value"] - first["value"]) / sd
        row = {
            "name": name,
            "unit": last.get("unit", ""),
            "values": values,
            "pull": last.get("pull"),
            "moved": moved,
            "shift": last["value"] - first["value"] if len(present) > 1 else math.nan,
            "added": values[0] is None,
            "at_bound": bool(last.get("at_bound")),
            "far": abs(moved) > MOVED_SHOWN,
        }
        (own if last.get("frames") else common).append(row)
    return {"common": common, "frames": own}


# -- diagnoses -------------------------------------------------------------------------------------------------------
NAMED = 0.01  # family-wise p at or above which an effect only gets an upper limit
COLUMNS = (  # of the ranking: key, title, whether it is text
    ("verdict", "verdict", True),
    ("fall", "χ² fall predicted", False),
    ("actual", "after refit", False),
    ("strength", "strength", False),
    ("plausible", "of plausible", False),
    ("image", "image change", False),
    ("share", "explains", False),
    ("survival", "visible", False),
    ("p", "p, family", False),
    ("confused", "confused with", True),
    ("flags", "notes", True),
)


def verdict(diagnosis: Mapping | None) -> dict | None:
    """What the page shows of optics.diagnosis.diagnose.Diagnosis.to_dict(); every part that is missing is left out."""
    if not diagnosis or not diagnosis.get("word"):
        return None
    d = diagnosis
    ranked = [_candidate(r) for r in d.get("rows") or ()]
    shown = [r for r in ranked if r["evidence"]]
    columns = [
        {"key": key, "title": title, "left": left}
        for key, title, left in COLUMNS
        if any(r["cells"][key] not in ("", "–") for r in shown)
    ]
    curves = [f for f in d.get("fingerprints") or () if as_float(f.get("net")) > 0 and f.get("curve")]
    curves = [f for f in curves if not f.get("per_frame")]
    return {
        "word": str(d["word"]).replace("_", " "),
        "sentence": (text := prose(d.get("sentence")))[:1].upper() + text[1:],
        "conditions": [
            {"name": prose(c.get("name")), "holds": bool(c.get("holds")), "text": prose(c.get("text"))}
            for c in d.get("conditions") or ()
        ],
        "warnings": [prose(w) for w in d.get("warnings") or ()],
        "hints": [prose(h) for h in d.get("hints") or ()],
        "ranking": shown,
        "columns": columns,
        "by_key": {_key(r["name"]): r for r in ranked},
        "limits": [f"{r['name']} {r['limit']}" for r in ranked if not r["evidence"] and r["limit"]],
        "not_tested": [f"{name} ({prose(why)})" for name, why in (d.get("not_tested") or {}).items()],
        "splits": [_split(s) for s in d.get("splits") or ()],
        "levels": list(d.get("levels") or ()),
        "shifts": list(d.get("shifts") or ())[:8],
        "curves": [_draft(f) for f in curves[:6]],
        "pairs": _pairs(d),
        "explanations": _explanations(d),
        "advice": _advice(d),
    }


def told(diagnosis: Mapping | None, points: Readings | None) -> Mapping | None:
    """A diagnosis in the words of readings: frames are sweeps, and a split by their place in an image is left out."""
    if not diagnosis or points is None:
        return diagnosis

    def spoken(value):
        if isinstance(value, str):
            return re.sub(r"\bframe(s?)\b", r"sweep\1", value)
        if isinstance(value, Mapping):
            return {k: spoken(v) for k, v in value.items()}
        return [spoken(v) for v in value] if isinstance(value, (list, tuple)) else value

    return spoken({**diagnosis, "splits": [s for s in diagnosis.get("splits") or () if s.get("by") != "quadrant"]})


def _candidate(r: Mapping) -> dict:
    """A row of the ranking, its cells as text."""
    refit = r.get("refit") or {}
    strength = refit.get("strength") or [
        as_float(a) + as_float(c) for a, c in zip(r.get("start") or (), r.get("change") or ())
    ]
    sd = refit.get("sd") or r.get("sd") or [None] * len(strength)
    unit = (r.get("units") or [""])[0]
    told = list(zip(*(r.get(key) or () for key in ("low", "high", "plausible"))))
    reaches = [Reach(*map(as_float, own)) for own in told] or [ANYWHERE] * len(strength)
    sd = [math.inf if s is None else s for s in sd]  # of a strength that the projection has left nothing of
    known = any(reach.holds(v, s) for reach, v, s in zip(reaches, strength, sd)) or not strength
    values = [measure(v, s, unit=unit, reach=reach) for v, s, reach in zip(strength, sd, reaches)]
    upper = [
        (as_float(u), start, reach) for u, start, reach in zip(r.get("upper") or (), r.get("start") or (), reaches)
    ]
    upper = [u for u in upper if math.isfinite(u[0])]
    meant = all(reach.excludes(u, start) for u, start, reach in upper)
    limit = (below(max(u[0] for u in upper), True, unit) if meant else NO_LIMIT) if upper else ""
    confused = f"{r['confused_with']} ({number(as_float(r.get('cos')), 2)})" if r.get("confused_with") else ""
    cells = {
        "fall": number(as_float(r.get("fall")), 4),
        "actual": number(as_float(refit.get("fall")), 4),
        "strength": some(list(dict.fromkeys(values)) if not known else values, 3, "; "),
        "plausible": number(as_float(r.get("of_plausible")), 2) if known else "–",
        "image": percent(as_float(r.get("image")), 2) if known else "–",
        "share": share_text(r.get("share"), typeset=True),
        "survival": percent(as_float(r.get("survival")), 2),
        "p": pvalue(as_float(r.get("p_family"))),
        "confused": confused,
        "flags": ", ".join(map(prose, r.get("flags") or ())),
        "verdict": prose(r.get("verdict")),
    }
    return {
        "name": str(r.get("name", "")),
        "cells": cells,
        "limit": limit,
        "fall": cells["fall"],
        "actual": cells["actual"],
        "strength": cells["strength"],
        "verdict": cells["verdict"],
        "evidence": bool(refit) or not as_float(r.get("p_family")) >= NAMED,
    }


def _split(s: Mapping) -> dict:
    """One test of homogeneity: its parts as a strip of points with error bars about 1."""
    strength, sd = [as_float(v) for v in s.get("strength") or ()], [as_float(v) for v in s.get("sd") or ()]
    labels = [str(label) for label in s.get("labels") or ()]
    worst = max(range(len(strength)), key=lambda i: abs(np.nan_to_num(strength[i] - 1)), default=None)
    return {
        "effect": str(s.get("effect", "")),
        "by": prose(s.get("by")),
        "svg": strip(strength, sd, labels),
        "worst": "" if worst is None else f"{labels[worst]}: {measure(strength[worst], sd[worst])}",
        "parts": len(labels),
        "h": number(as_float(s.get("h")), 2),
        "p": pvalue(as_float(s.get("p"))),
        "chance": pvalue(as_float(s.get("chance"))),
        "holds": bool(s.get("holds", True)),
    }


def strip(
    values: Sequence[float], sds: Sequence[float], labels: Sequence[str], width: int = 200, height: int = 36
) -> str:
    """SVG: one point with its error bar per part, and the line at 1."""
    good = [(v, s if math.isfinite(s) else 0.0) for v, s in zip(values, sds) if math.isfinite(v)]
    if not good:
        return ""
    reach = max([0.05] + [abs(v - 1) + s for v, s in good])
    x, y = scaled(-0.5, len(values) - 0.5, 6, width - 6), scaled(1 - 1.1 * reach, 1 + 1.1 * reach, height - 3, 3)
    parts = [f'<line class="zero" x1="0" x2="{width}" y1="{y(1):.1f}" y2="{y(1):.1f}"/>']
    for i, (v, s, label) in enumerate(zip(values, sds, labels)):
        if math.isfinite(v):
            s = s if math.isfinite(s) else 0.0
            parts.append(
                f'<line class="bar after" x1="{x(i):.1f}" x2="{x(i):.1f}" y1="{y(v - s):.1f}" y2="{y(v + s):.1f}"/>'
                f'<circle class="point after" cx="{x(i):.1f}" cy="{y(v):.1f}" r="3"><title>{escaped(label)}: '
                f"{measure(v, s)}</title></circle>"
            )
    said = ", ".join(f"{label} {measure(v, s)}" for label, v, s in zip(labels, values, sds))
    return svg_chart(width, height, parts, f"Strength relative to the whole: {said}", fixed=True)


def _draft(f: Mapping) -> dict:
    """A curve along a coordinate that would explain the residual, as a chart; along 'place', as a map of cells."""
    name, gain = str(f.get("coordinate", "")), f.get("kind") == "gain"
    centres, curve, sd = (np.array([as_float(v) for v in f.get(key) or ()]) for key in ("centres", "curve", "sd"))
    curve, sd = (100 * curve, 100 * sd) if gain else (curve, sd)
    what, image, chart = "relative gain, %" if gain else "offset, DN", "", ""
    side = math.isqrt(len(curve))
    if name == "place" and side * side == len(curve):
        top = rounded_up(float(np.nanmax(np.abs(curve), initial=1e-9)))
        image, what = coloured(curve.reshape(side, side), -top, top, DIVERGING), f"{what}, colours ±{number(top)}"
    elif len(curve) == len(centres) == len(sd):
        one = np.ones(len(curve))
        labels = tuple(f.get("labels") or ()) or None
        # the gain of a bin that holds next to no light is known so badly that its bar would flatten the curve
        told = ~(sd > 10 * np.nanmedian(sd)) | (np.abs(curve) > 3 * sd) if np.isfinite(sd).any() else one > 0
        curve = np.where(told, curve, np.nan)
        unit = f["unit"] if "unit" in f else UNITS.get(name, "")
        chart = curve_chart(Curve(name, unit or "", "all", centres, curve, sd, one, one, labels))
    return {
        "name": prose(name),
        "family": str(f.get("family") or ""),
        "what": what,
        "image": image,
        "svg": chart,
        "dof": f.get("dof"),
        "ratio": number(as_float(f.get("ratio")), 2),
        "net": number(as_float(f.get("net"))),
    }


def _explanations(d: Mapping) -> list[dict]:
    """Sets of effects that were refitted: all that are not ruled out, and the best of the others; none where there is
    but one effect to tell of."""
    sets = [e for e in d.get("explanations") or () if e.get("effects")]
    if len(sets) < 2:
        return []

    def possible(e: Mapping) -> bool:
        return bool(e.get("survives") or e.get("larger"))

    alive, others = ([e for e in sets if possible(e) == wanted] for wanted in (True, False))
    others.sort(key=lambda e: not e.get("refuted"))  # the reason is not in the other columns
    return [
        {
            "name": " + ".join(e["effects"]),
            "fall": _text(as_float(e.get("fall")), "{:.4g}"),
            "cost": _text(as_float(e.get("cost")), "{:.3g}"),
            "excess": _text(as_float(e.get("excess_sd")), "{:.2g}") + " sd",
            "lead": "–" if e in alive[:1] else _text(as_float(e.get("lead")), "{:.3g}"),
            "needed": "–" if e in alive[:1] else _text(as_float(e.get("needed")), "{:.3g}"),
            "survives": possible(e),
            "why": _why_not(e),
        }
        for e in [*alive[:8], *others[:4]]
    ]


def _why_not(e: Mapping) -> str:
    """Why a set of effects does not survive, where its score does not say so."""
    if why := e.get("refuted"):
        return why if isinstance(why, str) else "held-out frames refute it"  # older records say only that
    return "" if as_float(e.get("lead")) > as_float(e.get("needed")) else "contains a survivor"


def _pairs(d: Mapping) -> dict | None:
    """P(the right one wins) between effects that cannot be told apart."""
    names, matrix = d.get("compared") or [], d.get("correct") or []
    keep = [i for i, n in enumerate(names) if n in (d.get("ambiguous") or [])]
    if len(keep) < 2 or len(matrix) != len(names):
        return None
    return {
        "names": [names[i] for i in keep],
        "rows": [[percent(as_float(matrix[i][j]), 2) if i != j else "" for j in keep] for i in keep],
    }


def _advice(d: Mapping) -> list[dict]:
    """Shots that were simulated, the best few together first: what each would make of the pair that is hardest to tell
    apart."""
    rows = []
    for a in d.get("advice") or ():
        if not a.get("pairs"):
            continue
        p = a["pairs"][0]
        kind = {"together": "best together", "more of the same": "more of the same, to compare"}.get(
            a["family"], a["family"]
        )
        rows.append(
            {
                "kind": kind,
                "shot": prose(a["shot"]),
                "pair": f"{p['effect']} / {p['rival']}",
                "first": a["family"] != "together",
                "before": number(as_float(p["before"]), 3),
                "after": number(as_float(p["after"]), 3),
                "correct": f"{as_float(p['correct_before']):.2f} → {as_float(p['correct_after']):.2f}",
                "share": ""
                if math.isnan(after := as_float(p.get("share_after")))
                else f"{percent(as_float(p['share_before']))} → {percent(after)}",
                "brings": ", ".join(prose(n) for n in a.get("nuisances") or ()),
            }
        )
    return sorted(rows, key=lambda r: r["first"])


def prose(text) -> str:
    """Text made for a terminal, typeset for the page: ± for +-, arrows, χ²."""
    return str(text or "").replace("+-", "±").replace(" -> ", " → ").replace("chi2", "χ²")


def _key(name: str) -> str:
    return "".join(c if c.isalnum() else "-" for c in name.lower())
