"""Comparison of predictions with measurements: numbers per frame, LED, region and channel, curves and maps.

Pure functions on arrays: nothing here knows a scene, a plugin or a file format. The residual is measured minus
predicted throughout, and "in sigmas" means divided by the standard deviation that the noise model gives each value.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from optics.errors import Underdetermined
from optics.words import table

SCOPES = (  # what the numbers are split by; regions may overlap, all other parts add up to the whole
    (),
    ("role",),
    ("frame",),
    ("led",),
    ("group",),
    ("channel",),
    ("region",),
    ("frame", "channel"),
    ("frame", "region"),
    ("led", "channel"),
    ("led", "region"),
)
UNITS = {
    "radius": "px",
    "row": "px",
    "column": "px",
    "site": "deg",
    "height": "mm",
    "depth": "mm",
    "incidence": "deg",
    "emission": "deg",
    "led_distance": "mm",
    "contact_distance": "px",
    "gel_path": "mm",
    "slope": "deg",
    "intensity": "DN",
    "half_angle": "deg",
    "led_angle": "deg",
    "light_azimuth": "deg",
    "press_distance": "mm",
    "signal": "DN",
    "gradient": "DN/px",
    "laplacian": "DN/px^2",
}
FAR = ("far field", "far", "far_field")
SITES_MAX = 4  # analysers of a mosaic up to which each has a curve of its own
SIDE_MIN_SSIM = 3  # px; the smallest window that has a variance


@dataclass(frozen=True)
class Row:
    """The numbers of one part of the data.

    scope     what it is split by, with the label of each: {"frame": "press-03", "channel": "R"}; {} is the whole
    n         values used (one per pixel and channel); share: of those in the part
    chi2      sum of squared residuals in sigmas; dof: n less its share of the fitted parameters
    bias rms  DN, mean and root mean square of measured minus predicted
    noise     DN, root mean square of the standard deviation that the noise model expects
    signal    DN, mean predicted value above the black level
    l1 ssim   mean absolute error and structural similarity, values normalised to full scale 0..1
    psnr      dB, peak signal to noise ratio, same normalisation
    """

    scope: dict[str, str]
    n: int
    share: float
    chi2: float
    dof: float
    bias: float
    rms: float
    noise: float
    signal: float
    l1: float
    psnr: float
    ssim: float

    @property
    def chi2_per_dof(self) -> float:
        return self.chi2 / self.dof if self.dof > 0 else math.nan

    @property
    def label(self) -> str:
        return ", ".join(self.scope.values()) or "all"


@dataclass(frozen=True)
class Curve:
    """Mean residual in sigmas, with its standard error, in bins of one coordinate.

    channel  "all", one channel, or of a mosaic one analyser ("45 deg")
    centre   mean coordinate in each bin; labels: names instead of numbers, for frame and channel
    se       sample standard deviation / sqrt(n), 1 where n is 1: it takes neighbouring pixels as independent
    rms      root mean square residual in sigmas: 1 is noise
    """

    coordinate: str
    unit: str
    channel: str
    centre: np.ndarray
    mean: np.ndarray
    se: np.ndarray
    rms: np.ndarray
    n: np.ndarray
    labels: tuple[str, ...] | None = None


@dataclass
class Comparison:
    """Everything `compare` finds. `text`, `to_csv` and `to_json` are three views of the same numbers.

    frames      per frame: frame (its name), led, group, role ("fitted" or "held out"), settings (those that vary)
    similarity  mean and standard deviation over frames of l1, ssim, psnr
    rms_map     (H, W, C) root mean square residual in sigmas over frames; NaN where no frame is usable
    mean_map    (H, W, C) mean signed residual in sigmas over frames
    """

    rows: list[Row]
    curves: list[Curve]
    frames: list[dict]
    channels: list[str]
    similarity: dict[str, tuple[float, float]]
    full_scale: float
    rms_map: np.ndarray | None = field(default=None, repr=False)
    mean_map: np.ndarray | None = field(default=None, repr=False)

    def row(self, **labels: str) -> Row:
        """The row of exactly these labels: row(), row(role="held out"), row(frame="press-03", channel="R")."""
        for row in self.rows:
            if row.scope == labels:
                return row
        raise KeyError(f"no row for {labels}; rows are split by {', '.join('+'.join(s) or 'all' for s in SCOPES)}")

    def by(self, *names: str) -> list[Row]:
        return [row for row in self.rows if tuple(row.scope) == names]

    @property
    def total(self) -> Row:
        return self.row()

    @property
    def fitted(self) -> Row | None:
        return next((row for row in self.by("role") if row.scope["role"] == "fitted"), None)

    @property
    def held_out(self) -> Row | None:
        return next((row for row in self.by("role") if row.scope["role"] == "held out"), None)

    def worst(self) -> list[int]:
        """Indices of frames, largest misfit first; frames without a usable value last."""
        value = np.array([row.chi2_per_dof for row in self.by("frame")])
        return [int(i) for i in np.argsort(-np.where(np.isnan(value), -np.inf, value), kind="stable")]

    def text(self, scopes: Sequence[tuple[str, ...]] = SCOPES[:7]) -> str:
        """Aligned table for a terminal, one block per scope that splits the data."""
        head = ("", "values", "used", "chi2/dof", "bias DN", "rms DN", "noise DN", "L1", "PSNR dB", "SSIM")
        blocks = []
        for scope in scopes:
            rows = self.by(*scope)
            own_group = scope == ("group",) and len(rows) == len(self.frames)  # the block of frames says it
            if (rows and scope in ((), ("frame",))) or (len(rows) > 1 and not own_group):
                blocks.append([("by " + " and ".join(scope) if scope else "", *head[1:])] + [_cells(r) for r in rows])
        lines = iter(table([line for block in blocks for line in block], left=(0,)).split("\n"))
        shown = ["\n".join(next(lines) for _ in block) for block in blocks]
        s = self.similarity
        several = len(self.frames) > 1
        shown.append(
            f"over frames, {'mean and sd' if several else 'one of them'}: "
            + ", ".join(
                f"{name} {_fixed(s[key][0], p)}{f' +- {s[key][1]:.{p}f}' if math.isfinite(s[key][1]) else ''}{unit}"
                for key, name, p, unit in (("l1", "L1", 4, ""), ("ssim", "SSIM", 4, ""), ("psnr", "PSNR", 2, " dB"))
            )
        )
        return "\n\n".join(shown)

    def to_csv(self) -> str:
        """One line per row; the columns role, frame, led, group, region, channel are empty where not split."""
        out = io.StringIO()
        labels = ("role", "frame", "led", "group", "region", "channel")
        numbers = ("n", "share", "chi2", "dof", "chi2_per_dof", "bias", "rms", "noise", "signal", "l1", "psnr", "ssim")
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(labels + numbers)
        for row in self.rows:
            writer.writerow([row.scope.get(k, "") for k in labels] + [getattr(row, k) for k in numbers])
        return out.getvalue()

    def to_dict(self) -> dict:
        """Plain data without the maps. NaN becomes None and infinity 'inf', so that any JSON reader takes it."""
        return plain(
            {
                "rows": [asdict(r) for r in self.rows],
                "curves": [asdict(c) for c in self.curves],
                "frames": self.frames,
                "channels": self.channels,
                "similarity": self.similarity,
                "full_scale": self.full_scale,
            }
        )

    def to_json(self) -> str:
        return json.dumps(self.to_dict(), indent=1, allow_nan=False)

    @classmethod
    def from_dict(
        cls, data: Mapping, rms_map: np.ndarray | None = None, mean_map: np.ndarray | None = None
    ) -> Comparison:
        """The inverse of `to_dict`; the maps are kept in files of their own."""
        rows = [_row_from(r) for r in data["rows"]]
        curves = [_curve_from(c) for c in data["curves"]]
        similarity = {k: (_number(v[0]), _number(v[1])) for k, v in data["similarity"].items()}
        return cls(
            rows,
            curves,
            list(data["frames"]),
            list(data["channels"]),
            similarity,
            float(data["full_scale"]),
            rms_map,
            mean_map,
        )

    @classmethod
    def from_json(cls, text: str) -> Comparison:
        return cls.from_dict(json.loads(text))


def compare(
    measured: Sequence[np.ndarray],
    predicted: Sequence[np.ndarray],
    sd: Sequence[np.ndarray],
    usable: Sequence[np.ndarray],
    coordinates: Sequence[Mapping[str, np.ndarray]] | None = None,
    settings: Sequence[Mapping] | None = None,
    groups: Sequence[str] | Mapping[str, Sequence[int]] | None = None,
    *,
    names: Sequence[str] | None = None,
    leds: Sequence[str] | None = None,
    channels: Sequence[str] | None = None,
    full_scale: float = 255.0,
    held_out: Sequence[int] = (),
    parameters: int = 0,
    held_out_parameters: int = 0,
    bins: int = 16,
    black_level: float = 0.0,
    units: Mapping[str, str] | None = None,
    cell: tuple[int, int] = (1, 1),
) -> Comparison:
    """Compare frames (H, W) or (H, W, C) in DN with their predictions; all lists have one entry per frame.

    sd           standard deviation of each measured value, DN
    usable       bool, (H, W) or (H, W, C); values that are not finite or have sd <= 0 are left out as well
    coordinates  name -> (H, W) or (H, W, C); bool: a region (contact, rim, shadow; the far field is what none of them
                 covers); number: a coordinate to plot the residual against. NaN: the pixel has none. Intensity (the
                 predicted DN), channel, frame and every setting that varies between frames are always among them
    settings     key -> value; gives the LED label where `leds` does not: the parts whose .power is above 0
    groups       name per frame, or group -> indices
    held_out     indices of the frames that the calibration did not see
    parameters   fitted with the other frames; held_out_parameters: poses that were fitted on the held-out ones
    full_scale   DN of 1.0 in l1, ssim and psnr; black_level: DN without light
    cell         rows and columns that a raw mosaic repeats: curves along `row` and `column` take whole cells, as rows
                 of one cell look through other filters. With a coordinate `site` (deg) each analyser has its own curves

    Raises ValueError when lists or shapes disagree, Underdetermined when no value is usable.
    """
    frames = len(measured)
    _same_length(
        frames,
        predicted=predicted,
        sd=sd,
        usable=usable,
        coordinates=coordinates,
        settings=settings,
        names=names,
        leds=leds,
    )
    if not full_scale > 0:
        raise ValueError(f"full_scale = {full_scale} DN is not above 0")
    data = [_frame(i, *arrays) for i, arrays in enumerate(zip(measured, predicted, sd, usable))]
    if not any(use.any() for *_, use in data):
        raise Underdetermined(
            "no usable value in any frame: everything is masked, saturated, not finite, or where the shape is not "
            "known; check the masks and the noise model's saturation; allowed: --region all"
        )
    shape = data[0][0].shape
    channels = list(channels or {1: ["L"], 3: ["R", "G", "B"]}.get(shape[2], [f"c{k}" for k in range(shape[2])]))
    varied = _varied(settings or [{}] * frames)
    planes = [
        _planes({**c, **v}, d[0].shape, i)
        for i, (c, v, d) in enumerate(zip(coordinates or [{}] * frames, varied, data))
    ]
    info = {
        "frame": list(names or [f"{i:03d}" for i in range(frames)]),
        "led": list(leds or [led_label(s) for s in settings or [{}] * frames]),
        "group": _group_names(groups, frames),
        "role": ["held out" if i in set(held_out) else "fitted" for i in range(frames)],
    }

    regions = _region_names(planes)
    sums = _sums(data, planes, regions, full_scale, black_level)
    per_value = _parameters_per_value(sums["n"][:, 0].sum(1), info["role"], parameters, held_out_parameters)
    rows = [
        _row(scope, sums, keep, per_value, full_scale)
        for names_of_scope in SCOPES
        for scope, keep in _parts(names_of_scope, info, regions, channels)
    ]
    per_frame = [row for row in rows if tuple(row.scope) == ("frame",) and row.n]
    similarity = {key: _mean_sd([getattr(row, key) for row in per_frame]) for key in ("l1", "ssim", "psnr")}

    whitened = [np.where(use, (y - f) / np.where(use, s, 1.0), np.nan) for y, f, s, use in data]
    rms_map, mean_map = _maps(whitened)
    whole = [_whole_cells(p, cell) for p in planes]
    curves = _curves(whitened, data, whole, info["frame"], channels, bins, {**UNITS, **(units or {})})
    about = [{**{k: v[i] for k, v in info.items()}, "settings": varied[i]} for i in range(frames)]
    return Comparison(rows, curves, about, channels, similarity, float(full_scale), rms_map, mean_map)


def led_label(settings: Mapping) -> str:
    """The parts whose `.power` is above 0, joined by ' + '; 'all' where none is set, or three or more and all of
    them."""
    power = {k.rsplit(".", 1)[0]: float(v) for k, v in settings.items() if k.endswith(".power")}
    on = [name for name, value in power.items() if value > 0]
    if not power or (len(on) == len(power) and len(on) > 2):
        return "all"
    return " + ".join(on) or "none"


def structural_similarity_map(measured: np.ndarray, predicted: np.ndarray, usable: np.ndarray) -> tuple:
    """SSIM of two (H, W) planes with range 0..1: (H, W) map, (H, W) bool where it counts.

    Masked pixels take the predicted value in both planes, so that what a window sees of them is no difference. The
    border of half a window does not count, as in scikit-image's mean."""
    from skimage.metrics import structural_similarity

    side = min(7, min(measured.shape) - 1 + min(measured.shape) % 2)  # 7 px unless the plane is smaller; odd
    if side < SIDE_MIN_SSIM or not usable.any():
        return np.full(measured.shape, np.nan), np.zeros(measured.shape, bool)
    filled = np.where(np.isfinite(predicted), predicted, 0.0)
    _, local = structural_similarity(
        np.where(usable, measured, filled), filled, data_range=1.0, win_size=side, full=True
    )
    inner = np.zeros(measured.shape, bool)
    pad = side // 2
    inner[pad : measured.shape[0] - pad, pad : measured.shape[1] - pad] = True
    return local, inner & usable


# -- input -----------------------------------------------------------------------------------------------------------
def _same_length(frames: int, **lists) -> None:
    if not frames:
        raise ValueError("no frames to compare")
    for name, values in lists.items():
        if values is not None and len(values) != frames:
            raise ValueError(f"{name} has {len(values)} entries for {frames} measured frames; give one per frame")


def _frame(index: int, measured, predicted, sd, usable) -> tuple:
    """The four arrays of a frame as (H, W, C), and usable restricted to what is finite."""
    y = np.asarray(measured, float)
    y = y[..., None] if y.ndim == 2 else y
    if y.ndim != 3:
        raise ValueError(f"frame {index}: shape {y.shape} is neither (H, W) nor (H, W, C)")
    shaped = []
    for name, value in (("predicted", predicted), ("sd", sd), ("usable", usable)):
        value = np.asarray(value)
        value = value[..., None] if value.ndim == 2 else value
        try:
            shaped.append(np.broadcast_to(value, y.shape))
        except ValueError:
            raise ValueError(f"frame {index}: {name} has shape {value.shape}, measured has {y.shape}") from None
    f, s, use = shaped
    use = use.astype(bool) & np.isfinite(y) & np.isfinite(f) & np.isfinite(s) & (s > 0)
    return y, np.asarray(f, float), np.asarray(s, float), use


def _planes(coordinates: Mapping[str, np.ndarray | float], shape: tuple, index: int) -> dict[str, np.ndarray]:
    planes = {}
    for name, value in coordinates.items():
        value = np.asarray(value)
        value = value[..., None] if value.ndim == 2 else value
        try:
            planes[FAR[0] if name in FAR else name] = np.broadcast_to(value, shape)
        except ValueError:
            raise ValueError(f"frame {index}: coordinate '{name}' has shape {value.shape}, the image {shape}") from None
    return planes


def _varied(settings: Sequence[Mapping]) -> list[dict[str, float]]:
    """Per frame, the numbers among the settings that are not the same in all frames; NaN where a frame has none.

    Powers that are only switched are left out: the LED labels say it.
    """
    every = dict.fromkeys(k for s in settings for k, v in s.items() if not isinstance(v, (str, bool)))
    keys = [k for k in every if len({s.get(k) for s in settings}) > (2 if k.endswith(".power") else 1)]
    return [{k: float(s.get(k, math.nan)) for k in keys} for s in settings]


def _group_names(groups, frames: int) -> list[str]:
    if groups is None:
        return [f"{i:03d}" for i in range(frames)]
    if isinstance(groups, Mapping):
        of = {int(i): str(name) for name, members in groups.items() for i in members}
        return [of.get(i, f"{i:03d}") for i in range(frames)]
    _same_length(frames, groups=groups)
    return [f"{i:03d}" if g is None else str(g) for i, g in enumerate(groups)]


# -- numbers ---------------------------------------------------------------------------------------------------------
def _region_names(coordinates: list[dict]) -> list[str]:
    """'all' first, then every boolean coordinate, then the far field where nothing else is given."""
    found = list(dict.fromkeys(n for planes in coordinates for n, v in planes.items() if v.dtype == bool))
    return ["all", *(n for n in found if n != FAR[0]), *FAR[: len(found) > 0]]


def _sums(
    data: list[tuple], coordinates: list[dict], regions: list[str], full_scale: float, black_level: float
) -> dict[str, np.ndarray]:
    """Sums over pixels per (frame, region, channel); every row is made from these, so marginals agree exactly."""
    keys = ("total", "n", "difference", "absolute", "square", "chi2", "variance", "signal", "ssim", "ssim_n")
    sums = {key: np.zeros((len(data), len(regions), data[0][0].shape[2])) for key in keys}
    for i, (y, f, s, use) in enumerate(data):
        d = np.where(use, y - f, 0.0)
        terms = {
            "n": use,
            "difference": d,
            "absolute": np.abs(d),
            "square": d * d,
            "chi2": (d / np.where(use, s, 1.0)) ** 2,
            "variance": np.where(use, s, 0.0) ** 2,
            "signal": np.where(use, f - black_level, 0.0),
        }
        similar = [
            structural_similarity_map(y[..., c] / full_scale, f[..., c] / full_scale, use[..., c])
            for c in range(y.shape[2])
        ]
        counts = np.stack([m for _, m in similar], -1)
        terms["ssim"] = np.where(counts, np.stack([v for v, _ in similar], -1), 0.0)
        terms["ssim_n"] = counts
        terms["total"] = np.ones(y.shape)
        masks = {n: v for n, v in coordinates[i].items() if v.dtype == bool}
        masks["all"] = np.ones(y.shape, bool)
        if FAR[0] in regions and FAR[0] not in masks:
            others = [m for n, m in masks.items() if n != "all"]
            masks[FAR[0]] = ~np.any(others, axis=0) if others else masks["all"]
        for j, region in enumerate(regions):
            if region in masks:
                for key, term in terms.items():
                    sums[key][i, j] = np.sum(term, axis=(0, 1), where=masks[region])
    return sums


def _parameters_per_value(n: np.ndarray, roles: list[str], parameters: int, held_out_parameters: int) -> np.ndarray:
    """Fitted parameters per value of each frame: they are shared out evenly over the values that they were fitted
    to."""
    held = np.array([role == "held out" for role in roles])
    out = np.zeros(len(n))
    for mask, count in ((~held, parameters), (held, held_out_parameters)):
        total = n[mask].sum()
        out[mask] = count / total if total else 0.0
    return out


def _parts(scope: tuple[str, ...], info: dict, regions: list[str], channels: list[str]):
    """Yield ({label name: label}, (frames, region, channels)) for each part of a scope."""
    every = np.arange(len(info["frame"]))
    choices = []
    for name in scope:
        choices.append(
            {"region": regions[1:], "channel": channels}.get(name) or list(dict.fromkeys(info.get(name, [])))
        )
    if scope and (not all(choices) or (scope[-1] in ("region", "channel") and len(scope) > 1 and len(choices[-1]) < 2)):
        return
    for labels in _product(choices):
        frames, region, keep = every, 0, np.arange(len(channels))
        for name, label in zip(scope, labels):
            if name == "region":
                region = regions.index(label)
            elif name == "channel":
                keep = np.array([channels.index(label)])
            else:
                frames = np.array([i for i in frames if info[name][i] == label])
        if len(frames):
            yield dict(zip(scope, labels)), (frames, region, keep)


def _product(choices: list[list[str]]) -> list[tuple[str, ...]]:
    out: list[tuple[str, ...]] = [()]
    for options in choices:
        out = [head + (o,) for head in out for o in options]
    return out


def _row(scope: dict, sums: dict, keep: tuple, per_value: np.ndarray, full_scale: float) -> Row:
    frames, region, channel = keep
    s = {key: float(v[np.ix_(frames, [region], channel)].sum()) for key, v in sums.items()}
    n = s["n"]
    dof = float((sums["n"][np.ix_(frames, [region], channel)].sum((1, 2)) * (1 - per_value[frames])).sum())
    if not n:
        return Row(scope, 0, 0.0, *[math.nan] * 9)
    mse = s["square"] / n / full_scale**2
    return Row(
        scope,
        int(n),
        n / s["total"],
        s["chi2"],
        dof,
        s["difference"] / n,
        math.sqrt(s["square"] / n),
        math.sqrt(s["variance"] / n),
        s["signal"] / n,
        s["absolute"] / n / full_scale,
        -10 * math.log10(mse) if mse > 0 else math.inf,
        s["ssim"] / s["ssim_n"] if s["ssim_n"] else math.nan,
    )


def _mean_sd(values: list[float]) -> tuple[float, float]:
    known = np.array(values, float)
    known = known[np.isfinite(known)]
    if not len(known):
        return math.nan, math.nan
    return float(known.mean()), float(known.std(ddof=1)) if len(known) > 1 else math.nan


# -- maps and curves -------------------------------------------------------------------------------------------------
def _maps(whitened: list[np.ndarray]) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Root mean square and mean over frames per pixel; None where frames differ in size."""
    if len({z.shape for z in whitened}) != 1:
        return None, None
    n = np.zeros(whitened[0].shape)
    first, second = np.zeros_like(n), np.zeros_like(n)
    for z in whitened:
        good = np.isfinite(z)
        z = np.where(good, z, 0.0)
        n, first, second = n + good, first + z, second + z * z
    seen = np.where(n > 0, n, np.nan)
    return np.sqrt(second / seen).astype(np.float32), (first / seen).astype(np.float32)


def _whole_cells(planes: dict[str, np.ndarray], cell: tuple[int, int]) -> dict[str, np.ndarray]:
    """`row` and `column` of a pixel (px, centres at +0.5) replaced by those of the centre of its cell; NaN where the
    edge of the image cuts the cell."""
    found = dict(planes)
    for axis, (name, size) in enumerate(zip(("row", "column"), cell)):
        if name in planes and size > 1:
            at = planes[name]
            found[name] = np.where(at < at.shape[axis] // size * size, (at // size + 0.5) * size, np.nan)
    return found


def _curves(whitened, data, coordinates, names, channels, bins, units) -> list[Curve]:
    """Residual in sigmas against every number-valued coordinate, and against intensity, channel and frame."""
    z = np.concatenate([w.reshape(-1, w.shape[2]) for w in whitened])
    site = _gathered("site", whitened, data, coordinates)[:, 0]
    angles = np.unique(site[np.isfinite(site)])
    angles = angles if 1 < len(angles) <= SITES_MAX and len(channels) == 1 else angles[:0]
    given = list(
        dict.fromkeys(
            n
            for planes in coordinates
            for n, v in planes.items()
            if v.dtype != bool and n not in ("intensity", "channel", "frame")
        )
    )
    curves = []
    for name in given + ["intensity"]:
        x = _gathered(name, whitened, data, coordinates)
        edges = _edges(x[np.isfinite(z) & np.isfinite(x)], bins)
        if edges is None:
            continue
        unit = units.get(name, "")
        curves.append(_binned(name, unit, "all", x.ravel(), z.ravel(), edges))
        if len(channels) > 1:
            curves += [_binned(name, unit, label, x[:, c], z[:, c], edges) for c, label in enumerate(channels)]
        for angle in angles if name != "site" else ():
            own = site == angle
            curves.append(_binned(name, unit, f"{angle:g} deg", x[own, 0], z[own, 0], edges))
    frame = np.concatenate([np.full(w.shape[0] * w.shape[1], i) for i, w in enumerate(whitened)])
    for name, index, labels in (
        ("channel", np.broadcast_to(np.arange(len(channels)), z.shape), channels),
        ("frame", np.broadcast_to(frame[:, None], z.shape), names),
    ):
        if len(labels) > 1:
            edges = np.arange(len(labels) + 1) - 0.5
            curves.append(_binned(name, "", "all", index.ravel(), z.ravel(), edges, tuple(labels)))
    return curves


def _gathered(name: str, whitened, data, coordinates) -> np.ndarray:
    """(values, C): a coordinate of all frames, NaN where a frame has none."""
    return np.concatenate(
        [
            np.broadcast_to(_plane(name, planes, d), w.shape).reshape(-1, w.shape[2])
            for planes, d, w in zip(coordinates, data, whitened)
        ]
    )


def _plane(name: str, planes: dict, frame: tuple) -> np.ndarray:
    return frame[1] if name == "intensity" else planes.get(name, np.full((1, 1, 1), np.nan))


def _edges(x: np.ndarray, bins: int) -> np.ndarray | None:
    """Edges halfway between equal counts and equal widths; a bin per value where there are few; None where only one.

    Equal counts alone put every bin on the flat background, equal widths alone leave the far ones empty.
    """
    if not len(x):
        return None
    sample = x[:: max(1, len(x) // 200_000)]
    values = np.unique(sample)
    if len(values) < 2:
        return None
    if len(values) <= bins:
        middle = (values[1:] + values[:-1]) / 2
        return np.concatenate([[-np.inf], middle, [np.inf]])
    low, high = np.quantile(sample, [0.002, 0.998])
    edges = np.unique((np.quantile(sample, np.linspace(0, 1, bins + 1)) + np.linspace(low, high, bins + 1)) / 2)
    edges[0], edges[-1] = -np.inf, np.inf
    return edges if len(edges) > 2 else None


def _binned(name, unit, channel, x, z, edges, labels=None) -> Curve:
    good = np.isfinite(x) & np.isfinite(z)
    x, z = x[good].astype(float), z[good]
    index = np.searchsorted(edges, x, side="right") - 1
    size = len(edges) - 1
    n = np.bincount(index, minlength=size)
    some = np.where(n > 0, n, np.nan)
    centre, mean, square = (np.bincount(index, weights=w, minlength=size) / some for w in (x, z, z * z))
    spread = np.sqrt(np.maximum(square - mean**2, 0) * some / np.where(n > 1, n - 1, np.nan))
    se = np.where(n == 1, 1.0, spread / np.sqrt(some))  # a single value scatters by its own sigma
    return Curve(name, unit, channel, centre, mean, se, np.sqrt(square), n, labels)


# -- views -----------------------------------------------------------------------------------------------------------
def _cells(row: Row) -> tuple[str, ...]:
    if not row.n:
        return (row.label, "0", *["-"] * 8)
    numbers = (row.chi2_per_dof, row.bias, row.rms, row.noise, row.l1, row.psnr, row.ssim)
    cells = [_fixed(x, places) for x, places in zip(numbers, (3, 3, 3, 3, 4, 2, 4))]
    cells[1] = f"{row.bias:+.3f}"
    return (row.label, str(row.n), f"{100 * row.share:.1f} %", *cells)


def _fixed(value: float, places: int) -> str:
    """With so many decimal places; '-' where there is no such number: no degree of freedom, no window, no error."""
    return f"{value:.{places}f}" if math.isfinite(value) else "-"


def _row_from(data: Mapping[str, Any]) -> Row:
    numbers = {k: _number(v) for k, v in data.items() if k not in ("scope", "n")}
    return Row(scope=data["scope"], n=int(data["n"]), **numbers)


def _curve_from(data: Mapping[str, Any]) -> Curve:
    arrays = {k: np.array([_number(x) for x in data[k]]) for k in ("centre", "mean", "se", "rms")}
    labels = None if data.get("labels") is None else tuple(data["labels"])
    return Curve(data["coordinate"], data["unit"], data["channel"], **arrays, n=np.array(data["n"], int), labels=labels)


def plain(value: Any) -> Any:
    """JSON-ready copy: arrays become lists, NaN None, infinity 'inf'."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else "inf" if value > 0 else "-inf"
    return value


def _number(value) -> float:
    return math.nan if value is None else float(value)
