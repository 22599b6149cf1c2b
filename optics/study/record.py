"""The record of a study: base model, + effect, + effect, each with its fit, its errors, its diagnosis and its images.

A study is a folder that a later run, a report or a reader without this program can use:

    STUDY/ladder.json                  inputs by hash, versions, seed, command, noise, and the list of steps
    STUDY/steps/00-base/step.json      the same entry as in ladder.json, which can be rebuilt from these
                        fit.toml       [parameters] to lay over the scene again, [uncertainty], [frames.NAME]
                        metrics.json   optics.fit.compare, and null models where given
                        diagnosis.json optics.diagnosis.diagnose
                        images/*.npz   measured, predicted, sd, usable of the frames shown, and of a sweep of readings
                                       the settings of each; fingerprints; maps
    STUDY/steps/01-lens-vignetting/...

A step is written beside its place and renamed into it, so it is whole or absent; nothing is ever overwritten.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from optics import words
from optics.errors import BadCapture, OutputExists
from optics.files.output import file_hash, input_hashes, versions
from optics.fit.compare import Comparison, Row, led_label, plain

FORMAT = 1
SHOWN_MAX = 8
PACKAGES = ("mitsuba", "drjit", "numpy", "scipy", "scikit-image")
CORRELATION_SHOWN = 0.9
SETTING = "setting "  # begins the names of a sweep's settings in its file


@dataclass(frozen=True)
class Shown:
    """A frame for the eye: (H, W, C) DN measured, predicted and sd, bool usable, and what was lit and pressed.

    settings  of a sweep of point readings, (N, 1, C): (N,) what was set at each, by parameter key; units: of these keys
    """

    name: str
    measured: np.ndarray
    predicted: np.ndarray
    sd: np.ndarray
    usable: np.ndarray
    led: str = ""
    group: str = ""
    held_out: bool = False
    settings: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    units: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @property
    def residual(self) -> np.ndarray:
        """(H, W, C) measured minus predicted in sigmas, NaN where not usable."""
        good = np.broadcast_to(self.usable if self.usable.ndim == 3 else self.usable[..., None], self.measured.shape)
        good = good & (self.sd > 0)
        return np.where(good, (self.measured - self.predicted) / np.where(good, self.sd, 1.0), np.nan)


@dataclass(frozen=True)
class Fingerprint:
    """What an effect would add to a frame, and the residual that it is to explain; both (H, W, C) in sigmas.

    image   what the calibration absorbs is taken out: a refit's change of the image (`fingerprints_of`), or strength *
            projected derivative image
    """

    effect: str
    frame: str
    image: np.ndarray
    residual: np.ndarray
    strength: float = math.nan


class Study:
    """A ladder on disk. `create` or `open` it; `add_step` appends; everything else reads."""

    def __init__(self, folder: Path, record: dict):
        self.folder, self.record = Path(folder), record

    # -- life -------------------------------------------------------------------------------------------------------

    @classmethod
    def create(
        cls,
        folder: str | Path,
        *,
        scene: str,
        captures: str,
        inputs: Sequence[str | Path] = (),
        seed: int = 0,
        command: Sequence[str] = (),
        title: str = "",
        noise=None,
        warnings: Sequence[str] = (),
        facts: Mapping | None = None,
        noise_floor: float = 1.0,
        noise_floor_source: str = "noise model",
        resume: bool = False,
    ) -> Study:
        """Start a study in a folder that does not exist yet, or is empty.

        inputs       files and folders that the result depends on; each file is recorded by SHA-256
        noise        optics.captures.noise.Noise, or a dictionary; facts: plain values to print (frames, image size ...)
        noise_floor  chi2/dof of a perfect model: 1, unless repeated frames say otherwise
        resume       go on with the study in `folder` when its inputs, scene and seed are the same

        Raises OutputExists, or BadCapture when the study to resume was made from something else.
        """
        folder = Path(folder)
        hashes = input_hashes(inputs)
        if (folder / "ladder.json").exists():
            if not resume:
                raise OutputExists(
                    f"{folder} holds a study already; choose another folder, or go on with it (--resume)"
                )
            study = cls.open(folder, empty=True)
            old = study.record
            changed = [k for k, new in (("scene", scene), ("seed", seed)) if old[k] != new]
            changed += sorted(k for k in hashes.keys() | old["inputs"].keys() if hashes.get(k) != old["inputs"].get(k))
            if changed:
                raise BadCapture(
                    f"{folder}: cannot resume, changed since the study began: {', '.join(changed[:5])}"
                    f"{' ...' if len(changed) > 5 else ''}; start a study in a new folder"
                )
            return study
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise OutputExists(f"{folder} exists and holds no study; choose another folder")
        if not (math.isfinite(noise_floor) and noise_floor > 0):
            raise ValueError(f"noise_floor = {noise_floor} (chi2/dof) is not above 0")
        record = {
            "format": FORMAT,
            "title": title,
            "scene": scene,
            "captures": captures,
            "created": _now(),
            "seed": seed,
            "command": list(map(str, command)),
            "versions": versions(),
            "inputs": hashes,
            "noise": _as_dict(noise) or {},
            "noise_floor": {"chi2_per_dof": float(noise_floor), "source": noise_floor_source},
            "warnings": list(warnings),
            "facts": dict(facts or {}),
            "shown": [],
            "steps": [],
        }
        (folder / "steps").mkdir(parents=True, exist_ok=True)
        study = cls(folder, json.loads(_dumps(record)))
        study._save()
        return study

    @classmethod
    def open(cls, folder: str | Path, empty: bool = False) -> Study:
        """Read a study; steps that were written whole but not yet listed are taken in.

        Raises FileNotFoundError without a ladder.json, ValueError when it cannot be read, or has no step and may not be
        `empty`."""
        folder = Path(folder)
        file = folder / "ladder.json"
        if not file.is_file():
            raise FileNotFoundError(
                f"{folder} is no study: it has no ladder.json; name the folder that `optics calibrate CAPTURES -o STUDY` wrote"
            )
        try:
            record = json.loads(file.read_text(encoding="utf-8"))
            if record["format"] != FORMAT:
                raise ValueError(f"format {record['format']}, this program reads {FORMAT}")
            record["steps"] = []
            for path in sorted(folder.glob("steps/[0-9][0-9]-*/step.json")):
                record["steps"].append(json.loads(path.read_text(encoding="utf-8")))
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{file}: not a readable study ({error}); restore it or start a new one") from error
        wanted = list(range(len(record["steps"])))
        if [s["index"] for s in record["steps"]] != wanted:
            found = ", ".join(s["folder"] for s in record["steps"])
            raise ValueError(
                f"{folder}/steps: steps are missing or double ({found}); restore them or start a new study"
            )
        if record["steps"] and not record["shown"]:
            record["shown"] = [f["name"] for f in record["steps"][0]["frames"]]
        if not record["steps"] and not empty:
            raise ValueError(
                f"{folder}: the study has no step yet, its calibration was cut off; `optics calibrate {record['captures']} -o "
                f"{folder} --resume` finishes it"
            )
        return cls(folder, record)

    def discard(self) -> None:
        """Remove a study that has no step yet; one that has is left alone."""
        if not self.steps:
            shutil.rmtree(self.folder / "steps", ignore_errors=True)
            (self.folder / "ladder.json").unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # it may hold other things
                self.folder.rmdir()

    @property
    def steps(self) -> list[dict]:
        return self.record["steps"]

    def has(self, effect: str | None) -> bool:
        return any(step["effect"] == effect for step in self.steps)

    def note_inputs(self, files: Sequence[str | Path]) -> None:
        """Record files that the next steps depend on besides the inputs that the study began with."""
        self.record["inputs"] = {**input_hashes(files), **self.record["inputs"]}
        self._save()

    def changed_inputs(self) -> list[str]:
        """Input files that are gone or differ from the recorded hash."""
        return [
            path
            for path, digest in self.record["inputs"].items()
            if not Path(path).is_file() or file_hash(Path(path)) != digest
        ]

    # -- a step -----------------------------------------------------------------------------------------------------

    def add_step(
        self,
        name: str,
        effect: str | None,
        fit,
        comparison: Comparison,
        diagnosis=None,
        frames: Sequence[Shown] = (),
        fingerprints: Sequence[Fingerprint] = (),
        *,
        nulls: Mapping | None = None,
        background: Mapping | None = None,
        seconds: float | None = None,
        warnings: Sequence[str] = (),
    ) -> Path:
        """Append a step and return its folder.

        name         as in a sentence: "base", "lens vignetting"; the folder becomes NN-lens-vignetting
        effect       key of the effect that was added; None for the base
        fit          optics.fit.calibrate.Fit, or what `fit_record` makes of one
        comparison   of all frames, with held_out given where there are any
        diagnosis    optics.diagnosis.diagnose.Diagnosis, or its dictionary
        frames       all frames or some; at most 8 are kept: the worst of the first step, the same ones in every later
                     step, and at least one held-out frame where there is one; of sweeps of readings, every one
        nulls        optics.fit.null_models.NullTable.json(): errors of models without physics
        background   mode of the flat field, and per channel how much of the background the scene explains

        Raises OutputExists when the effect has a step already.
        """
        if self.steps and self.has(effect):
            raise OutputExists(f"{self.folder}: '{name}' has a step already; start another study to add it differently")
        index = len(self.steps)
        folder = f"{index:02d}-{_slug(name)}"
        if not self.record["shown"]:
            self.record["shown"] = _choose(frames, comparison)
        kept = {f.name: f for f in frames}
        kept = [kept[n] for n in self.record["shown"] if n in kept]
        record = fit_record(fit, [f["frame"] for f in comparison.frames])
        diagnosis = _as_dict(diagnosis)
        entry = {
            "index": index,
            "name": name,
            "effect": effect,
            "folder": folder,
            "created": _now(),
            "seconds": seconds,
            "fitted": _level(comparison.fitted),
            "held_out": _level(comparison.held_out),
            "total": _level(comparison.total),
            "converged": record["converged"],
            "reason": record["reason"],
            "variables": record["variables"],
            "correlations": record["correlations"],
            "warnings": [*record["warnings"], *warnings],
            "frames": [
                {
                    "file": f"images/frame-{i:02d}.npz",
                    "name": f.name,
                    "led": f.led,
                    "group": f.group,
                    "held_out": bool(f.held_out),
                    **({"units": dict(f.units)} if f.settings else {}),
                }
                for i, f in enumerate(kept)
            ],
            "fingerprints": [
                {
                    "file": f"images/fingerprint-{i:02d}.npz",
                    "effect": f.effect,
                    "frame": f.frame,
                    "strength": float(f.strength),
                }
                for i, f in enumerate(fingerprints)
            ],
        }
        entry = json.loads(_dumps(entry))
        with self._new_folder(folder) as new:
            (new / "images").mkdir()
            (new / "fit.toml").write_text(fit_toml(record, name), encoding="utf-8")
            (new / "metrics.json").write_text(
                _dumps({**comparison.to_dict(), "nulls": nulls or {}, "background": background or {}}), encoding="utf-8"
            )
            if diagnosis is not None:
                (new / "diagnosis.json").write_text(_dumps(diagnosis), encoding="utf-8")
            for item, f in zip(entry["frames"], kept):
                shape = np.shape(f.measured)
                use = np.asarray(f.usable, bool)
                use = np.broadcast_to(use[..., None] if use.ndim < len(shape) else use, shape)
                np.savez_compressed(
                    new / item["file"],
                    measured=_single(f.measured),
                    predicted=_single(f.predicted),
                    sd=_single(np.broadcast_to(f.sd, shape)),
                    usable=use,
                    **{SETTING + key: np.asarray(value) for key, value in f.settings.items()},
                )
            for item, f in zip(entry["fingerprints"], fingerprints):
                np.savez_compressed(new / item["file"], image=_single(f.image), residual=_single(f.residual))
            if comparison.rms_map is not None:
                np.savez_compressed(new / "images/maps.npz", rms=comparison.rms_map, mean=comparison.mean_map)
            (new / "step.json").write_text(_dumps(entry), encoding="utf-8")
        self.steps.append(entry)
        self._save()
        return self.folder / "steps" / folder

    def put_diagnosis(self, index: int, diagnosis, fingerprints: Sequence[Fingerprint] = ()) -> None:
        """Add the diagnosis of a recorded step, and what its best effects would explain; a later one replaces it."""
        folder, entry = self.path(index), self.steps[index]
        items = [
            {
                "file": f"images/fingerprint-{i:02d}.npz",
                "effect": f.effect,
                "frame": f.frame,
                "strength": float(f.strength),
            }
            for i, f in enumerate(fingerprints)
        ]
        for item, f in zip(items, fingerprints):
            with replaced(folder / item["file"]) as new:
                np.savez_compressed(new, image=_single(f.image), residual=_single(f.residual))
        with replaced(folder / "diagnosis.json") as new:
            new.write(_dumps(_as_dict(diagnosis)).encode())
        entry.update(json.loads(_dumps({"fingerprints": items})))
        with replaced(folder / "step.json") as new:
            new.write(_dumps(entry).encode())
        self._save()

    @contextlib.contextmanager
    def _new_folder(self, name: str) -> Iterator[Path]:
        """A folder to fill, renamed into its place at the end and removed when something fails."""
        final, temporary = self.folder / "steps" / name, self.folder / "steps" / f".{name}.{os.getpid()}"
        if final.exists():
            raise OutputExists(f"{final} exists; open the study again to go on after its last step")
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        try:
            yield temporary
            temporary.rename(final)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)

    def _save(self) -> None:
        temporary = self.folder / f".ladder.json.{os.getpid()}"
        temporary.write_text(_dumps(self.record), encoding="utf-8")
        os.replace(temporary, self.folder / "ladder.json")

    # -- reading ----------------------------------------------------------------------------------------------------

    def path(self, index: int) -> Path:
        return self.folder / "steps" / self.steps[index]["folder"]

    def metrics(self, index: int) -> dict:
        return json.loads((self.path(index) / "metrics.json").read_text(encoding="utf-8"))

    def comparison(self, index: int) -> Comparison:
        file = self.path(index) / "images/maps.npz"
        maps = {}
        if file.exists():
            with np.load(file) as arrays:
                maps = {"rms_map": arrays["rms"], "mean_map": arrays["mean"]}
        return Comparison.from_dict(self.metrics(index), **maps)

    def diagnosis(self, index: int) -> dict | None:
        file = self.path(index) / "diagnosis.json"
        return json.loads(file.read_text(encoding="utf-8")) if file.exists() else None

    def fit(self, index: int) -> dict:
        return read_fit(self.path(index) / "fit.toml")

    def frames(self, index: int) -> list[Shown]:
        out = []
        for f in self.steps[index]["frames"]:
            with np.load(self.path(index) / f["file"]) as a:
                settings = {k.removeprefix(SETTING): a[k] for k in a.files if k.startswith(SETTING)}
                out.append(
                    Shown(
                        f["name"],
                        a["measured"],
                        a["predicted"],
                        a["sd"],
                        a["usable"],
                        f["led"],
                        f["group"],
                        f["held_out"],
                        settings,
                        f.get("units", {}),
                    )
                )
        return out

    def fingerprints(self, index: int) -> list[Fingerprint]:
        out = []
        for f in self.steps[index]["fingerprints"]:
            with np.load(self.path(index) / f["file"]) as a:
                strength = math.nan if f["strength"] is None else f["strength"]
                out.append(Fingerprint(f["effect"], f["frame"], a["image"], a["residual"], strength))
        return out

    def table(self) -> str:
        """The ladder as aligned text: one line per step, and the noise floor below."""
        lines = [("step", "fitted chi2/dof", "held-out chi2/dof", "held-out misfit", "noise", "parameters", "")]
        for step in self.steps:
            fitted, held = step["fitted"], step["held_out"]
            level = held or fitted or step["total"]
            lines.append(
                (
                    f"{step['index']:02d} {'+ ' if step['index'] else ''}{step['name']}",
                    _format(fitted, "chi2_per_dof", "{:.3f}"),
                    _format(held, "chi2_per_dof", "{:.3f}"),
                    _format(held, "misfit", "{:.2%}"),
                    _format(level, "noise", "{:.2%}"),
                    str(len(step["variables"])),
                    "" if step["converged"] else f"not converged: {step['reason']}",
                )
            )
        floor = self.record["noise_floor"]
        return "\n".join(
            [words.table(lines, left=(0, 6)), f"noise floor: chi2/dof {floor['chi2_per_dof']:.3f} ({floor['source']})"]
        )


@contextlib.contextmanager
def replaced(file: Path) -> Iterator:
    """A binary file to write beside its place and rename into it at the end."""
    temporary = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        with open(temporary, "wb") as new:
            yield new
        os.replace(temporary, file)
    finally:
        temporary.unlink(missing_ok=True)


# -- images of a model
# ---------------------------------------------------------------------------------------------------


def shown_frames(model, values, held_out: Sequence[int] = (), frames: Sequence[int] | None = None) -> list[Shown]:
    """All frames, or the given ones, of an optics.fit.scene_model.SceneModel with its predictions for `values`."""
    indices = list(range(len(model.frames))) if frames is None else list(frames)
    out = []
    for i in indices:
        f, prediction = model.frames[i], np.asarray(model.predict(values, [i])[0])
        settings = (
            {}
            if model.captures.table is None
            else {
                key: np.broadcast_to(np.ravel(value), len(prediction))
                for key, value in (*f.parameters.items(), *f.readings.items())
            }
        )
        out.append(
            Shown(
                f.name,
                np.asarray(f.image),
                prediction,
                np.sqrt(model.variance(values, i, prediction)),
                model.usable(i),
                led_label(f.parameters),
                f.group or "",
                i in set(held_out),
                settings,
                {key: model.parameters[key].unit for key in settings},
            )
        )
    return out


def fingerprints_of(model, fit, diagnosis, frame: int, count: int = 4) -> list[Fingerprint]:
    """What the best effects of a diagnosis change in a frame when they are added and everything is calibrated again.

    image = (prediction of the refit - prediction of the base) / sd, beside residual = (measured - base) / sd: a right
    effect looks like the residual. Taken from the refits themselves, so it holds where the image is not linear as well.
    """
    base = np.asarray(model.predict(fit.values, [frame])[0])
    use = model.usable(frame)
    sd = np.sqrt(model.variance(fit.values, frame, base))
    found = model.frames[frame]
    residual = np.where(use, (np.asarray(found.image) - base) / sd, np.nan)
    rows = [r for r in diagnosis.rows if r.name in diagnosis.fits][:count]
    out = []
    for row in rows:
        image = (np.asarray(model.predict(diagnosis.fits[row.name].values, [frame])[0]) - base) / sd
        strength = row.refit.strength[0] if row.refit is not None and len(row.refit.strength) == 1 else math.nan
        out.append(Fingerprint(row.name, found.name, np.where(use, image, np.nan), residual, strength))
    return out


# -- fits ---------------------------------------------------------------------------------------------------------------


def fit_record(fit, frame_names: Sequence[str] = ()) -> dict:
    """An optics.fit.calibrate.Fit as plain data; a mapping of that form is completed and returned.

    variables: name, keys, unit, value, sd, frames (names or None), prior, pull = (value - prior mean) / prior sd,
    neutral, plausible, at_bound. `pull` is against the prior's own sd: it says how far the calibration had to leave it.
    """
    blank = {
        "parameters": {},
        "frames": {},
        "variables": [],
        "correlations": [],
        "chi2": None,
        "dof": None,
        "converged": True,
        "reason": "",
        "warnings": [],
    }
    if isinstance(fit, Mapping):
        return {**blank, **fit}

    def name_of(index: int) -> str:
        return frame_names[index] if index < len(frame_names) else f"{index:03d}"

    variables = []
    for v, value, sd in zip(fit.variables, np.asarray(fit.estimate, float), np.asarray(fit.sd, float)):
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
    }


def fit_toml(record: Mapping, name: str = "") -> str:
    """The values of a fit as TOML that can be laid over a scene again: [parameters] and [frames.NAME], key = value."""
    import tomlkit

    unit = {key: v["unit"] for v in record["variables"] for key in v["keys"]}
    document = tomlkit.document()
    document.add(
        tomlkit.comment(
            f"Calibrated values{f' of the step {chr(34)}{name}{chr(34)}' if name else ''}: lay them over "
            "the scene with --values FILE."
        )
    )

    def table(values: Mapping):
        out = tomlkit.table()
        for key, value in values.items():
            out.add(key, value if isinstance(value, (str, bool)) else float(value))
            if unit.get(key):
                out[key].comment(unit[key])
        return out

    def nested(frames: Mapping):
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
    for key in ("chi2", "dof", "converged", "reason"):
        if record[key] is not None:
            fit.add(key, record[key])
    document.add("fit", fit)
    return tomlkit.dumps(document)


def read_fit(file: str | Path) -> dict:
    """fit.toml as plain dictionaries: parameters, uncertainty, frames, frames_uncertainty, fit."""
    import tomlkit

    data = tomlkit.parse(Path(file).read_text(encoding="utf-8")).unwrap()
    return {key: data.get(key, {}) for key in ("parameters", "uncertainty", "frames", "frames_uncertainty", "fit")}


# -- provenance
# ---------------------------------------------------------------------------------------------------------

# -- small things
# -------------------------------------------------------------------------------------------------------


def _choose(frames: Sequence[Shown], comparison: Comparison) -> list[str]:
    """At most SHOWN_MAX names, worst first, with a held-out one among them where there is one; every sweep of
    readings."""
    given = {f.name: f for f in frames}
    if any(f.settings for f in frames):
        return list(given)
    order = [comparison.frames[i]["frame"] for i in comparison.worst()]
    order = [n for n in order if n in given] + [n for n in given if n not in order]
    kept = order[:SHOWN_MAX]
    held = [n for n in order if given[n].held_out]
    if held and not any(n in held for n in kept):
        kept[-1] = held[0]
    return kept


def _level(row: Row | None) -> dict | None:
    """What the ladder says of a part of the data; misfit and noise are relative to the mean signal."""
    if row is None or not row.n:
        return None
    signal = abs(row.signal) or math.nan
    return {
        "chi2": row.chi2,
        "dof": row.dof,
        "chi2_per_dof": row.chi2_per_dof,
        "n": row.n,
        "rms": row.rms,
        "noise_dn": row.noise,
        "misfit": row.rms / signal,
        "noise": row.noise / signal,
        "l1": row.l1,
        "psnr": row.psnr,
        "ssim": row.ssim,
    }


def _as_dict(record) -> dict | None:
    """A mapping, an object with to_dict, or a dataclass, as a dictionary."""
    if record is None or isinstance(record, Mapping):
        return record
    return record.to_dict() if hasattr(record, "to_dict") else dataclasses.asdict(record)


def _format(level: Mapping | None, key: str, form: str) -> str:
    return "-" if level is None or level[key] is None else form.format(level[key])


def _dumps(value) -> str:
    return json.dumps(plain(value), indent=1, allow_nan=False) + "\n"


def _single(array) -> np.ndarray:
    return np.asarray(array, np.float32)


def _slug(name: str) -> str:
    return words.key_of(name) or "step"


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="seconds")
