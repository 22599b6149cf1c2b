"""A fit on disk: `fit.toml`, whose values can be laid over a scene again, and the table of variables in `step.json`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from optics.errors import UnknownKey
from optics.files.toml_checks import tomllib
from optics.fit.known_shape import ALL, REGIONS
from optics.fit.result import Fit
from optics.fit.scene_model import SceneModel
from optics.scene.parameter import LARGEST, Values

CORRELATION_SHOWN = 0.9  # absolute correlation beyond which a pair of variables is listed
PARTS = ("variables", "keys", "value", "sd", "correlation")
AGAIN = "restore the file, or calibrate again"
ROUNDING = 1e-6  # of a correlation's diagonal and eigenvalues: files of earlier versions are no better


@dataclass(frozen=True)
class Posterior:
    """What a fit knows of the values that all frames share, jointly Gaussian.

    names, keys       of the variables, and the parameters that each sets
    mean, covariance  (p,) as found, (p, p) of optics.fit.result.Fit.posterior
    """

    names: tuple[str, ...]
    keys: tuple[tuple[str, ...], ...]
    mean: np.ndarray
    covariance: np.ndarray

    def draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """(count, p) draws."""
        sd = np.sqrt(np.diag(self.covariance))
        eigen, vectors = np.linalg.eigh(self.covariance / np.outer(sd, sd))  # of the correlation: units differ
        root = vectors * np.sqrt(np.maximum(eigen, 0.0))
        return self.mean + rng.standard_normal((count, len(sd))) @ root.T * sd

    def only(self, places: Sequence[int]) -> Posterior:
        """Some of the variables, whatever the others are."""
        names, keys = tuple(self.names[i] for i in places), tuple(self.keys[i] for i in places)
        return Posterior(names, keys, self.mean[list(places)], self.covariance[np.ix_(places, places)])

    def table(self) -> dict[str, Any]:
        """As fit.toml has it: the lower triangle of the correlation, whose thin directions need all digits."""
        sd = np.sqrt(np.diag(self.covariance))
        correlation = self.covariance / np.outer(sd, sd)
        return {
            "variables": list(self.names),
            "keys": [list(keys) for keys in self.keys],
            "value": self.mean.tolist(),
            "sd": sd.tolist(),
            "correlation": [correlation[i, : i + 1].tolist() for i in range(len(sd))],
        }

    @classmethod
    def from_table(cls, table: Mapping[str, Any], where: str) -> Posterior:
        """Raises ValueError for what is no such table, UnknownKey for an entry that it does not have."""
        from pydantic import ValidationError

        where = f"{where}: [posterior]"
        try:
            read = _posterior_table().model_validate(table)
        except ValidationError as error:
            errors = error.errors()
            first = next((e for e in errors if e["type"] == "extra_forbidden"), errors[0])
            name = "".join(f"[{p}]" if isinstance(p, int) else str(p) for p in first["loc"])
            if first["type"] == "extra_forbidden":
                raise UnknownKey(name, PARTS, "entry", where) from error
            if first["type"] == "missing":
                raise ValueError(f"{where}: {name} is missing; {AGAIN}") from error
            allowed = first["msg"].replace("Input should be", "allowed:")
            raise ValueError(f"{where}: {name} = {first['input']!r}; {allowed}; {AGAIN}") from error
        count = len(read.variables)
        for name in PARTS:
            if len(getattr(read, name)) != count:
                raise ValueError(f"{where}: {count} variables, but {len(getattr(read, name))} of {name}; {AGAIN}")
        for what, names in (("variables", read.variables), ("keys", [key for keys in read.keys for key in keys])):
            if len(set(names)) < len(names):
                twice = next(name for name in names if names.count(name) > 1)
                raise ValueError(f"{where}: {what}: '{twice}' appears twice; allowed: each once; {AGAIN}")
        lower = np.zeros((count, count))
        for i, row in enumerate(read.correlation):
            if len(row) != i + 1:
                raise ValueError(
                    f"{where}: correlation[{i}]: {len(row)} numbers; allowed: {i + 1}, the last 1; {AGAIN}"
                )
            lower[i, : i + 1] = row
        correlation = lower + np.tril(lower, -1).T
        least = float(np.linalg.eigvalsh(correlation)[0])
        if np.abs(np.diag(correlation) - 1).max() > ROUNDING or least < -ROUNDING:
            raise ValueError(
                f"{where}: correlation: no correlation of numbers, with {np.diag(correlation).min():g} on its diagonal "
                f"and a least eigenvalue of {least:.3g}; allowed: 1, and 0 or more; {AGAIN}"
            )
        sd = np.array(read.sd)
        keys = tuple(map(tuple, read.keys))
        return cls(tuple(read.variables), keys, np.array(read.value), correlation * np.outer(sd, sd))


@cache
def _posterior_table() -> Any:
    """The model of [posterior] (pydantic takes its time to be imported)."""
    from typing import Annotated

    from pydantic import ConfigDict, Field, create_model

    number = Annotated[float, Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
    spread = Annotated[float, Field(ge=1 / LARGEST, le=LARGEST, allow_inf_nan=False)]
    kinds = {
        "variables": Annotated[list[str], Field(min_length=1)],
        "keys": list[Annotated[list[str], Field(min_length=1)]],
        "value": list[number],
        "sd": list[spread],
        "correlation": list[list[number]],
    }
    config = ConfigDict(strict=True, extra="forbid")
    return create_model("Table", __config__=config, **{name: (kind, ...) for name, kind in kinds.items()})  # type: ignore[call-overload]


def posterior_of(fit: Fit) -> Posterior | None:
    """That of a fit; None without a linearisation, or where no value is shared by all frames."""
    covariance = fit.posterior
    shared = [i for i, v in enumerate(fit.variables) if v.frames is None]
    if covariance is None or not shared:
        return None
    names, keys = tuple(v.name for v in fit.variables), tuple(v.keys for v in fit.variables)
    return Posterior(names, keys, np.asarray(fit.estimate, float), covariance).only(shared)


def fit_record(fit: Fit | Mapping, frame_names: Sequence[str] = ()) -> dict:
    """A fit as plain data; a mapping of that form is completed and returned.

    variables   name, keys, unit, value, sd, frames (names or None), prior, pull, neutral, plausible, bounds, at_bound
    tempering   Fit.tempering, which `sd` counts
    posterior   Posterior, or None
    pull        (value - prior mean) / prior sd: how far the data moved it from what was known
    """
    blank: dict[str, Any] = {
        "parameters": {},
        "frames": {},
        "variables": [],
        "correlations": [],
        "chi2": None,
        "dof": None,
        "converged": True,
        "reason": "",
        "warnings": [],
        "tempering": 1.0,
        "posterior": None,
    }
    if isinstance(fit, Mapping):
        return {**blank, **fit}

    def name_of(index: int) -> str:
        return frame_names[index] if index < len(frame_names) else f"{index:03d}"

    variables = []
    for v, value, sd in zip(fit.variables, np.asarray(fit.estimate, float), np.asarray(fit.error, float)):
        p = v.parameter
        variables.append(
            {
                "name": v.name,
                "keys": list(v.keys),
                "unit": p.unit,
                "value": float(value),
                "sd": float(sd),
                "frames": None if v.frames is None else [name_of(i) for i in v.frames],
                "prior": None if v.prior is None else list(v.prior),
                "pull": None if v.prior is None else (float(value) - v.prior[0]) / v.prior[1],
                "neutral": p.neutral,
                "plausible": p.plausible,
                "bounds": list(p.bounds),
                "at_bound": v.name in getattr(fit, "at_bound", ()),
            }
        )
    pairs = []
    if len(variables) > 1:
        with np.errstate(invalid="ignore"):  # an undetermined variable has an infinite variance
            r = np.nan_to_num(np.asarray(fit.correlation, float))
        for i, j in zip(*np.nonzero(np.triu(np.abs(r) > CORRELATION_SHOWN, 1))):
            pairs.append([variables[i]["name"], variables[j]["name"], float(r[i, j])])
    return {
        **blank,
        "parameters": dict(fit.values.common),
        "frames": {name_of(i): dict(own) for i, own in sorted(fit.values.frame.items()) if own},
        "variables": variables,
        "correlations": sorted(pairs, key=lambda p: -abs(p[2]))[:20],
        "chi2": float(fit.chi2),
        "dof": float(fit.dof),
        "converged": bool(fit.converged),
        "reason": str(fit.reason),
        "warnings": list(getattr(fit, "warnings", ()) or ()),
        "tempering": fit.tempering,
        "posterior": posterior_of(fit),
    }


def fit_toml(record: Mapping, name: str = "", origin: Mapping[str, Mapping] | None = None) -> str:
    """The values of a fit as TOML that can be laid over a scene again: [parameters] and [frames.NAME], key = value.

    origin   `optics.study.calibrated.origin_of`: the tables `sensor`, and entries that `fit` has besides its own
    """
    import tomlkit

    unit = {key: v["unit"] for v in record["variables"] for key in v["keys"]}
    document = tomlkit.document()
    document.add(
        tomlkit.comment(
            f"Calibrated values{f' of the step {chr(34)}{name}{chr(34)}' if name else ''}: `--fit FILE` of "
            "compare, render, batch and sweep takes them."
        )
    )
    document.add(tomlkit.comment(WHOLE))

    def table(values: Mapping) -> Any:
        out = tomlkit.table()
        for key, value in values.items():
            out.add(key, value if isinstance(value, (str, bool)) else float(value))
            if unit.get(key):
                out[key].comment(unit[key])
        return out

    def nested(frames: Mapping) -> Any:
        out = tomlkit.table(is_super_table=True)
        for frame, values in frames.items():
            out.add(frame, table(values))
        return out

    document.add("parameters", table(record["parameters"]))
    common = {key: v["sd"] for v in record["variables"] if v["frames"] is None for key in v["keys"]}
    document.add("uncertainty", table(common))
    document["uncertainty"].comment("one standard deviation")
    if record["frames"]:
        document.add("frames", nested(record["frames"]))
        own: dict = {}
        for v in record["variables"]:
            for frame in v["frames"] or ():
                own.setdefault(frame, {}).update(dict.fromkeys(v["keys"], v["sd"]))
        if own:
            document.add("frames_uncertainty", nested(own))
    fit = tomlkit.table()
    origin = origin or {}
    for key, value in {
        **{k: record[k] for k in ("chi2", "dof", "converged", "reason")},
        **origin.get("fit", {}),
    }.items():
        if value is not None:
            fit.add(key, value)
    document.add("fit", fit)
    if record["posterior"] is not None:
        document.add("posterior", tomlkit.item(record["posterior"].table()))
        document["posterior"].comment("joint covariance of values that all frames share: optics.study.fit_files")
    if origin.get("sensor"):
        document.add("sensor", tomlkit.item(dict(origin["sensor"])))
    return f"{tomlkit.dumps(document).rstrip()}\n\n{END}\n"


WHOLE = "Whole only with its last line."  # begins a file that ends with END
END = "# end"
TABLES = ("parameters", "uncertainty", "frames", "frames_uncertainty", "fit", "posterior", "sensor")


def read_fit(file: str | Path) -> dict[str, dict]:
    """fit.toml as plain dictionaries: parameters, uncertainty, frames, frames_uncertainty, fit, posterior, sensor.

    file   a fit.toml, or the folder of a study, whose last step is taken

    Raises FileNotFoundError, and ValueError for what is not TOML, or was cut off.
    """
    file = fit_file(file)
    try:
        text = file.read_text(encoding="utf-8-sig")
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file}: not valid TOML: {error}; restore the file, or take another step's") from error
    head = text.lstrip().splitlines()[:3]
    cut = f"# {WHOLE}" in head and text.rstrip().splitlines()[-1] != END
    if cut or not text.strip() or (any(line.startswith("# Calibrated values") for line in head) and "fit" not in data):
        raise ValueError(f"{file}: cut off: its end is missing; restore the file, or take another step's")
    for key in data:
        if key not in TABLES:
            raise UnknownKey(key, TABLES, "table", str(file), f"(allowed: {', '.join(TABLES)})")
    for key in TABLES:
        if not isinstance(data.get(key, {}), dict):
            raise ValueError(f"{file}: {key} = {data[key]!r}; allowed: a table, [{key}]")
    for key, kind in KINDS.items():
        table, _, name = key.partition(".")
        value = data.get(table, {}).get(name)
        if value is not None and not _is(value, kind):
            raise ValueError(f"{file}: [{table}] {name} = {value!r}; allowed: {kind}")
    region = data.get("sensor", {}).get("region") or ALL
    if region not in REGIONS:
        raise UnknownKey(region, REGIONS, "region", f"{file}: [sensor]")
    for table in ("frames", "frames_uncertainty"):
        if not _is(data.get(table, {}), "a table of tables"):
            raise ValueError(f"{file}: [{table}]: allowed: a table for each frame")
    return {key: data.get(key, {}) for key in TABLES}


KINDS = {  # of entries that the program reads
    "fit.captures": "text",
    "fit.held_out": "a list of texts",
    "fit.parameters": "a whole number",
    "fit.held_out_parameters": "a whole number",
    "sensor.scene": "text",
    "sensor.scene_hash": "text",
    "sensor.plugins": "a list of texts",
    "sensor.plugin_files": "a table of texts",
    "sensor.flat_field": "text",
    "sensor.region": "text",
    "sensor.defines": "a table of texts",
    "sensor.noise": "a table of numbers",
    "sensor.settings": "a table of numbers or texts",
    "sensor.frames": "a table of tables",
    "sensor.drive": "a table of numbers",
    "sensor.levels": "a list of texts",
    "sensor.uncertainty": "a table of numbers",
}


def _is(value: object, kind: str) -> bool:
    if kind == "text":
        return isinstance(value, str)
    if kind == "a whole number":
        return isinstance(value, int) and not isinstance(value, bool)
    if kind == "a list of texts":
        return isinstance(value, str) or (isinstance(value, list) and all(isinstance(v, str) for v in value))
    if not isinstance(value, dict):
        return False
    if kind == "a table of tables":
        return all(isinstance(v, dict) for v in value.values())
    if kind == "a table of numbers":
        return all(isinstance(v, (int, float)) or _is_numbers(v) for v in value.values())
    words = kind == "a table of numbers or texts"
    return all(isinstance(v, str) or (words and isinstance(v, (int, float))) for v in value.values())


def _is_numbers(value: object) -> bool:
    """Of a noise that each channel has its own."""
    return isinstance(value, list) and all(isinstance(v, (int, float)) for v in value)


def fit_file(path: str | Path) -> Path:
    """The fit.toml that a path names: the file itself, or that of the last step of a study's folder."""
    path = Path(path)
    if path.is_dir():
        steps = sorted(path.glob("steps/[0-9][0-9]-*/fit.toml"))
        if not steps and not (path / "fit.toml").is_file():
            raise FileNotFoundError(
                f"{path}: neither a study nor a step of one: no fit.toml in it; name the folder that `optics calibrate "
                "CAPTURES -o STUDY` wrote, or one of its files STUDY/steps/NN-name/fit.toml"
            )
        return steps[-1] if steps else path / "fit.toml"
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; a study writes one to STUDY/steps/NN-name/fit.toml")
    return path


def values_of(model: SceneModel, file: str | Path | None, sets: Mapping[str, float | str]) -> Values:
    """The values of a fit.toml (None: none), and above them those of `sets`.

    Raises UnknownKey for a frame that the model's captures do not have, ValueError for what is not TOML, and what
    `Scene.check` raises.
    """
    if file is None:
        return Values(dict(model.scene.check(sets, "--set")))
    data = read_fit(file)
    common = model.scene.check({**data["parameters"]}, f"{file}: [parameters]")
    names = {f.name: i for i, f in enumerate(model.frames)}
    own: dict[int, dict[str, Any]] = {}
    for name, values in data["frames"].items():
        if name not in names:
            raise UnknownKey(name, names, "frame", str(file), "the fit belongs to another set of captures")
        own[names[name]] = dict(model.scene.check(values, f"{file}: [frames.{name}]"))
    return Values({**common, **model.scene.check(sets, "--set")}, own)
