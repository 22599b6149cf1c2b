"""The record of a study on disk: base model, + effect, + effect, each with its fit, errors, diagnosis and images.

A study is a folder that a later run, a report, or a reader without this program can use:

    STUDY/ladder.json                  inputs by hash, versions, seed, command, noise, and the list of steps
    STUDY/steps/00-base/step.json      the same entry as in ladder.json, which can be rebuilt from these
                        fit.toml       [parameters] to lay over the scene again, [uncertainty], [frames.NAME], and what
                                       they belong to (optics.study.calibrated)
                        metrics.json   optics.fit.compare, and null models where there are any
                        diagnosis.json optics.diagnosis
                        images/*.npz   measured, predicted, sd, usable of the frames shown, and the settings of a sweep
                        of
                                       readings; fingerprints; maps
    STUDY/steps/01-lens-vignetting/...

A step is written beside its place and renamed into it, so it is whole or absent. Nothing is ever overwritten, but for a
diagnosis that is made again.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import shutil
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from optics import words
from optics.diagnosis.result import Diagnosis, table_of
from optics.diagnosis.result import Row as Ranked
from optics.errors import BadCapture, OutputExists, UnknownKey
from optics.files.archives import opened
from optics.files.output import alone, file_hash, input_hashes, new_folder, replacing, versions, write_text
from optics.fit.compare import Comparison, Row, plain
from optics.fit.result import Fit
from optics.study.fit_files import fit_record, fit_toml, read_fit
from optics.study.places import portable
from optics.study.shown import Fingerprint, Shown

FORMAT = 1
SHOWN_MAX = 8  # frames whose images a step keeps
DAMAGED = (  # what numpy and zipfile raise on an archive that was changed
    ValueError,
    KeyError,
    EOFError,
    OSError,
    NotImplementedError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
    tokenize.TokenError,
)
LOCK = ".lock"  # held by the process that writes
SETTING = "setting "  # begins the names of a sweep's settings in its file


class Record:
    """A study on disk. `create` or `open` it; `add_step` appends a step; everything else reads.

    ladder   the content of ladder.json; steps: its list of steps
    """

    def __init__(self, folder: Path, ladder: dict[str, Any]):
        self.folder, self.ladder = Path(folder), ladder
        self._held = 0  # how often this object holds the lock

    # -- life ---------------------------------------------------------------------------------------------------------
    @classmethod
    def create(
        cls,
        folder: str | Path,
        *,
        scene: str,
        captures: str,
        inputs: Sequence[str | Path] | Mapping[str, str] = (),
        near: Mapping[str, str] | None = None,
        seed: int = 0,
        command: Sequence[str] = (),
        title: str = "",
        noise: Any = None,
        warnings: Sequence[str] = (),
        facts: Mapping | None = None,
        prints: Sequence[str] = (),
        noise_floor: float = 1.0,
        noise_floor_source: str = "noise model",
        resume: bool = False,
    ) -> Record:
        """Start a study in a folder that does not exist yet, or is empty.

        inputs       files and folders that the result depends on, each file recorded by SHA-256; or name -> hash, as
                     `optics.study.places.inputs_of` gives them
        near         where inputs lie, relative to the study: it may be moved together with them
        noise        optics.captures.noise.Noise, or a dictionary; facts: plain values to print (frames, image size ...)
        prints       of the captures (optics.captures.identity), by which a draft knows them again
        noise_floor  chi2/dof of a perfect model: 1, unless repeated frames say otherwise
        resume       go on with the study in `folder` when its inputs, scene and seed are the same

        Raises OutputExists, or BadCapture when the study to resume was made from something else.
        """
        folder = Path(folder)
        hashes = dict(inputs) if isinstance(inputs, Mapping) else input_hashes(inputs)
        if (folder / "ladder.json").exists():
            if not resume:
                raise OutputExists(
                    f"{folder} holds a study already; choose another folder, or go on with it (--resume)"
                )
            study = cls.open(folder, empty=True)
            old = study.ladder
            changed = [] if Path(old["scene"]).name == Path(scene).name else ["scene"]
            changed += _other_setup(old.get("facts", {}).get("setup"), dict(facts or {}).get("setup"))
            changed += ["seed"] if old["seed"] != seed else []
            before = portable(old["inputs"], old["captures"]) if isinstance(inputs, Mapping) else old["inputs"]
            changed += sorted(k for k in hashes.keys() | before.keys() if hashes.get(k) != before.get(k))
            if changed:
                raise BadCapture(
                    f"{folder}: cannot resume, changed since the study began: {', '.join(changed[:5])}"
                    f"{' ...' if len(changed) > 5 else ''}; start a study in a new folder"
                )
            return study
        if folder.exists() and (not folder.is_dir() or any(p.name != LOCK for p in folder.iterdir())):
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
            "near": dict(near or {}),
            "drafts": {},
            "noise": _as_dict(noise) or {},
            "noise_floor": {"chi2_per_dof": float(noise_floor), "source": noise_floor_source},
            "warnings": list(warnings),
            "facts": dict(facts or {}),
            "prints": list(prints),
            "shown": [],
            "steps": [],
        }
        folder.mkdir(parents=True, exist_ok=True)
        study = cls(folder, json.loads(_dumps(record)))
        with study.alone():
            if (folder / "ladder.json").exists():
                raise OutputExists(f"{folder} holds a study already, which another process has begun")
            try:
                (folder / "steps").mkdir(exist_ok=True)
                study._save()
            except BaseException:
                study.discard()
                raise
        return study

    @classmethod
    def open(cls, folder: str | Path, empty: bool = False) -> Record:
        """Read a study. Steps that were written whole but not yet listed are included.

        Raises FileNotFoundError without a ladder.json, ValueError where it cannot be read, or has no step and may not
        be
        `empty`."""
        folder = Path(folder)
        file = folder / "ladder.json"
        if not file.is_file():
            raise FileNotFoundError(
                f"{folder} is no study: it has no ladder.json; name the folder that `optics calibrate CAPTURES -o "
                "STUDY` "
                "wrote"
            )
        try:
            record = json.loads(file.read_text(encoding="utf-8"))
            if record["format"] != FORMAT:
                raise ValueError(f"format {record['format']}, this program reads {FORMAT}")
            record["steps"] = []
            for path in sorted(folder.glob("steps/[0-9][0-9]-*/step.json")):
                file = path
                record["steps"].append(_step(json.loads(path.read_text(encoding="utf-8"))))
            file = folder / "ladder.json"
            for name in ("scene", "inputs", "shown"):
                record[name]
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
                f"{folder}: the study has no step yet, its calibration was interrupted; "
                f"`optics calibrate {record['captures']} -o {folder} --resume` finishes it"
            )
        return cls(folder, record)

    def discard(self) -> None:
        """Remove a study that has no step yet; one that has is left alone."""
        if not self.steps:
            shutil.rmtree(self.folder / "steps", ignore_errors=True)
            (self.folder / "ladder.json").unlink(missing_ok=True)
            (self.folder / LOCK).unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # it may hold other things
                self.folder.rmdir()

    @contextlib.contextmanager
    def alone(self) -> Iterator[None]:
        """Keep other processes from writing to the study. Raises OutputExists where one does, or has added a step since
        this record was read."""
        if self._held:
            self._held += 1
            try:
                yield
            finally:
                self._held -= 1
            return
        with alone(
            self.folder / LOCK,
            f"{self.folder}: another process works on this study; wait until it ends, then try again",
        ):
            there = sorted(p.parent.name for p in self.folder.glob("steps/[0-9][0-9]-*/step.json"))
            if there != [s["folder"] for s in self.steps]:
                raise OutputExists(
                    f"{self.folder}: another process has added a step since this study was opened; open it again"
                )
            self._held = 1
            try:
                yield
            finally:
                self._held = 0

    @property
    def steps(self) -> list[dict]:
        return self.ladder["steps"]

    def added(self, index: int = -1) -> list[str]:
        """Keys of the effects in the model of a step, in the order in which they were added."""
        found: list[str] = []
        for step in self.steps[: index % len(self.steps) + 1] if self.steps else ():
            found = [key for key in found if key not in step.get("dropped", ())]
            if step["effect"]:
                found.append(step["effect"])
        return found

    def note_inputs(self, hashes: Mapping[str, str]) -> None:
        """Record what the next steps depend on besides the inputs that the study began with: name -> hash."""
        with self.alone():
            self.ladder["inputs"] = {**hashes, **self.ladder["inputs"]}
            self._save()

    def note_draft(self, file: Path) -> None:
        """Record a plugin that was drafted from this study and lies in it."""
        name = file.resolve().relative_to(self.folder.resolve()).as_posix()
        with self.alone():
            self.ladder["drafts"] = {**self.ladder.get("drafts", {}), name: file_hash(file)}
            self._save()

    def changed_inputs(self) -> list[str]:
        """Input files that are gone or differ from the recorded hash."""
        return [
            path
            for path, digest in self.ladder["inputs"].items()
            if not Path(path).is_file() or file_hash(Path(path)) != digest
        ]

    # -- a step -------------------------------------------------------------------------------------------------------
    def add_step(
        self,
        name: str,
        effect: str | None,
        fit: Fit | Mapping,
        comparison: Comparison,
        diagnosis: Diagnosis | Mapping | None = None,
        frames: Sequence[Shown] = (),
        fingerprints: Sequence[Fingerprint] = (),
        *,
        nulls: Mapping | None = None,
        background: Mapping | None = None,
        origin: Mapping[str, Mapping] | None = None,
        seconds: float | None = None,
        warnings: Sequence[str] = (),
        dropped: Sequence[str] = (),
    ) -> Path:
        """Append a step and return its folder.

        name         as in a sentence: "base", "lens vignetting"; the folder becomes NN-lens-vignetting
        effect       key of the effect that was added; None for the base
        fit          optics.fit.Fit, or what `fit_record` makes of one
        comparison   of all frames, with held_out given where there are any
        diagnosis    a Diagnosis, or its dictionary
        frames       all frames or some; at most 8 are kept: the worst of the first step, the same ones in every later
                     step, and at least one held-out frame where there is one; of sweeps of readings, every one
        nulls        optics.fit.null_models.NullTable.json(): errors of models without physics
        background   mode of the flat field, and per channel how much of the background the scene explains
        origin       optics.study.calibrated.origin_of: what fit.toml says of the scene and the captures
        dropped      keys of effects of earlier steps that are not in the model any more

        Raises OutputExists when the model has the effect already, or a base.
        """
        if self.steps and (effect is None or effect in self.added()):
            raise OutputExists(f"{self.folder}: '{name}' has a step already; start another study to add it differently")
        index = len(self.steps)
        folder = f"{index:02d}-{_slug(name)}"
        if not self.ladder["shown"]:
            self.ladder["shown"] = _choose(frames, comparison)
        given = {f.name: f for f in frames}
        kept = [given[n] for n in self.ladder["shown"] if n in given]
        record = fit_record(fit, [f["frame"] for f in comparison.frames])
        diagnosis = _as_dict(diagnosis)
        entry = {
            "index": index,
            "name": name,
            "effect": effect,
            "dropped": list(dropped),
            "folder": folder,
            "created": _now(),
            "seconds": seconds,
            "fitted": _level(comparison.fitted),
            "held_out": _level(comparison.held_out),
            "total": _level(comparison.total),
            **{key: record[key] for key in ("converged", "reason", "variables", "correlations", "tempering")},
            "warnings": [*record["warnings"], *warnings],
            "frames": [_frame_entry(i, f) for i, f in enumerate(kept)],
            "fingerprints": [_fingerprint_entry(i, f) for i, f in enumerate(fingerprints)],
        }
        entry = json.loads(_dumps(entry))
        path = self.folder / "steps" / folder
        if path.exists():
            raise OutputExists(f"{path} exists; open the study again to go on after its last step")
        with self.alone(), new_folder(path) as new:
            (new / "images").mkdir()
            (new / "fit.toml").write_text(fit_toml(record, name, origin), encoding="utf-8")
            (new / "metrics.json").write_text(
                _dumps({**comparison.to_dict(), "nulls": nulls or {}, "background": background or {}}), encoding="utf-8"
            )
            if diagnosis is not None:
                (new / "diagnosis.json").write_text(_dumps(diagnosis), encoding="utf-8")
            for item, shown in zip(entry["frames"], kept):
                _write_frame(new / item["file"], shown)
            for item, print_ in zip(entry["fingerprints"], fingerprints):
                np.savez_compressed(new / item["file"], image=_single(print_.image), residual=_single(print_.residual))
            if comparison.rms_map is not None and comparison.mean_map is not None:
                np.savez_compressed(new / "images/maps.npz", rms=comparison.rms_map, mean=comparison.mean_map)
            (new / "step.json").write_text(_dumps(entry), encoding="utf-8")
        self.steps.append(entry)
        try:
            self._save()
        except BaseException:  # a full disk, or Ctrl-C: the study is as it was
            self.steps.pop()
            shutil.rmtree(path, ignore_errors=True)
            raise
        return path

    def put_diagnosis(
        self, index: int, diagnosis: Diagnosis | Mapping, fingerprints: Sequence[Fingerprint] = ()
    ) -> None:
        """Add a diagnosis to a recorded step, with what its best effects would explain. A later one replaces it."""
        with self.alone():
            self._put_diagnosis(index, diagnosis, fingerprints)

    def _put_diagnosis(self, index: int, diagnosis: Diagnosis | Mapping, fingerprints: Sequence[Fingerprint]) -> None:
        folder, entry = self.path(index), self.steps[index]
        items = [_fingerprint_entry(i, f) for i, f in enumerate(fingerprints)]
        for item, f in zip(items, fingerprints):
            with replacing(folder / item["file"]) as file:
                np.savez_compressed(file, image=_single(f.image), residual=_single(f.residual))
        write_text(folder / "diagnosis.json", _dumps(_as_dict(diagnosis)))
        entry.update(json.loads(_dumps({"fingerprints": items})))
        write_text(folder / "step.json", _dumps(entry))
        self._save()

    def put_ranking(self, index: int, rows: Sequence[Ranked]) -> None:
        """Keep the ranking by score of a step whose diagnosis is still under way."""
        write_text(self.path(index) / "ranking.csv", table_of(rows))

    def refits(self, index: int) -> Path:
        """The folder in which a diagnosis of a step keeps its refits while it is under way."""
        return self.path(index) / "refits"

    def _save(self) -> None:
        write_text(self.folder / "ladder.json", _dumps(self.ladder))

    # -- reading ------------------------------------------------------------------------------------------------------
    def path(self, index: int) -> Path:
        return self.folder / "steps" / self.steps[index]["folder"]

    def metrics(self, index: int) -> dict:
        return _read(self.path(index) / "metrics.json")

    def comparison(self, index: int) -> Comparison:
        file = self.path(index) / "images/maps.npz"
        maps = {}
        if file.exists():
            with _arrays(file) as arrays:
                maps = {"rms_map": arrays["rms"], "mean_map": arrays["mean"]}
        return Comparison.from_dict(self.metrics(index), **maps)

    def diagnosis(self, index: int) -> dict | None:
        file = self.path(index) / "diagnosis.json"
        return _read(file) if file.exists() else None

    def fit(self, index: int) -> dict:
        return read_fit(self.path(index) / "fit.toml")

    def frames(self, index: int) -> list[Shown]:
        out = []
        for f in self.steps[index]["frames"]:
            with _arrays(self.path(index) / f["file"]) as a:
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
            with _arrays(self.path(index) / f["file"]) as a:
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
        floor = self.ladder["noise_floor"]
        return "\n".join(
            [words.table(lines, left=(0, 6)), f"noise floor: chi2/dof {floor['chi2_per_dof']:.3f} ({floor['source']})"]
        )


def _other_setup(before: Mapping | None, now: Mapping | None) -> list[str]:
    """The choices in which two setups differ, but for places; none where a record has no setup."""
    if before is None or now is None:
        return []
    now = json.loads(_dumps(now))
    apart = ("captures", "plugins", "uncertainty")  # an error of dials that was found stands in the record alone
    return sorted(name for name in before if name not in apart and before[name] != now.get(name))


@contextlib.contextmanager
def readable(folder: Path, *more: type[Exception]) -> Iterator[None]:
    """What a study's files hold that no study writes is said of the study: a key that is missing, another type.

    more   further errors that mean the same"""
    meant: tuple[type[Exception], ...] = (KeyError, TypeError, AttributeError, IndexError, ArithmeticError, *more)
    try:
        yield
    except meant as error:
        if isinstance(error, UnknownKey):
            raise
        raise ValueError(
            f"{folder}: its record is damaged ({type(error).__name__}: {error}); restore it, or start a new study; "
            "--debug shows where"
        ) from error


def _step(entry: dict[str, Any]) -> dict[str, Any]:
    """What a step.json holds; raises KeyError or TypeError where it is something else."""
    for name in ("index", "name", "effect", "folder", "frames", "fingerprints"):
        entry[name]
    return entry


def _read(file: Path) -> dict:
    """A JSON file of a step. Raises ValueError, which names it."""
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{file}: damaged or cut off ({error}); restore it, or start a new study") from error
    if not isinstance(found, dict):
        raise ValueError(f"{file}: holds no table; restore it, or start a new study")
    return found


@contextlib.contextmanager
def _arrays(file: Path) -> Iterator[Any]:
    """The arrays of a step's file. Raises ValueError, which names it."""
    try:
        with opened(file) as arrays:
            yield arrays
    except DAMAGED as error:
        raise ValueError(f"{file}: damaged or cut off ({error}); restore it, or start a new study") from error


def _frame_entry(index: int, f: Shown) -> dict[str, Any]:
    """What a step says of a frame whose images it keeps."""
    entry = {"file": f"images/frame-{index:02d}.npz", "name": f.name, "led": f.led, "group": f.group}
    return {**entry, "held_out": bool(f.held_out), **({"units": dict(f.units)} if f.settings else {})}


def _fingerprint_entry(index: int, f: Fingerprint) -> dict[str, Any]:
    file = f"images/fingerprint-{index:02d}.npz"
    return {"file": file, "effect": f.effect, "frame": f.frame, "strength": float(f.strength)}


def _write_frame(file: Path, f: Shown) -> None:
    shape = np.shape(f.measured)
    use = np.asarray(f.usable, bool)
    arrays: dict[str, Any] = {
        "measured": _single(f.measured),
        "predicted": _single(f.predicted),
        "sd": _single(np.broadcast_to(f.sd, shape)),
        "usable": np.broadcast_to(use[..., None] if use.ndim < len(shape) else use, shape),
        **{SETTING + key: np.asarray(value) for key, value in f.settings.items()},
    }
    np.savez_compressed(file, **arrays)


def _choose(frames: Sequence[Shown], comparison: Comparison) -> list[str]:
    """Names of the frames to keep: at most SHOWN_MAX, worst first, one of them held out where any is; all sweeps."""
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


def _as_dict(record: Any) -> dict | None:
    """A mapping, an object with to_dict, or a dataclass, as a dictionary."""
    if record is None or isinstance(record, Mapping):
        return None if record is None else dict(record)
    return record.to_dict() if hasattr(record, "to_dict") else dataclasses.asdict(record)


def _format(level: Mapping | None, key: str, form: str) -> str:
    return "-" if level is None or level[key] is None else form.format(level[key])


def _dumps(value: object) -> str:
    return json.dumps(plain(value), indent=1, allow_nan=False) + "\n"


def _single(array: object) -> np.ndarray:
    return np.asarray(array, np.float32)


def _slug(name: str) -> str:
    return words.key_of(name) or "step"


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="seconds")
