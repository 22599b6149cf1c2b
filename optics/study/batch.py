"""Many images of one scene, from a job file; a run can be stopped and resumed, and the result is the same bit by bit.

    scene   = "gelsight"                       # a shipped scene, or an XML file relative to this one;
    # fit   = "study"                          # or a calibrated sensor: a study's folder or a fit.toml. frame = "NAME":
    #                                          # with what was set and found in this frame of its captures
    out     = "presses"                        # folder, relative to this file
    count   = 1000                             # random draws; with grids: draws per point of the grid
    seed    = 1
    lights  = "together"                       # or "each": one image per LED
    outputs = ["exr", "png", "dn"]             # everything; the camera's DN; the camera's DN with noise (needs [noise])
    labels  = ["force", "pressure"]            # for learners (optics.light.labels); none without it
    [defines]                                  # of the XML's <default>s
    width = 320
    [parameters]                               # the same in every image
    "gel.indenter_size" = 2.0
    [sample]
    "gel.press_x"     = { uniform = [-4, 4] }
    "gel.press_depth" = { log_uniform = [0.1, 1] }
    "led_1.power"     = { normal = [1, 0.05] }
    "gel.indenter"    = { choice = ["sphere", "cube"] }
    "gel.press_rz"    = { grid = [0, 30, 60] } # every value; several grids: every combination, the last one fastest

A draw depends on seed, index and key alone: not on the order of work, on shards or workers, nor on what else is
sampled. The folder gets images/, job.json (what it was made from), manifest.jsonl (a line per sample, appended once its
files stand) and, when all is done, manifest.csv."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
import os
import signal
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from optics.captures.noise import Noise
from optics.errors import OutOfBounds, OutputExists, UnknownKey
from optics.files import toml_checks as checks
from optics.files.output import alone, check_folder, file_hash, replacing, write_text
from optics.light import labels as labelling
from optics.light.labels import LABELS
from optics.light.rendering import LAYERS, RenderJob
from optics.scene import loader as scenes
from optics.scene.mitsuba_parts import DEFAULT_VARIANT
from optics.scene.trust import Named
from optics.study.calibrated import Calibrated, calibrated

Progress = Callable[[str, int, int], None]

Finite = Annotated[float, Field(allow_inf_nan=False)]
Value = Finite | str
Pair = Annotated[list[Finite], Field(min_length=2, max_length=2)]


SAMPLES_MOST = 10_000_000  # of one job, whose manifest is one file


class BadJob(ValueError):
    """A job file that contradicts its format or its scene."""


class SampleFailed(RuntimeError):
    """A sample that could not be made; those before it are kept."""


class Strict(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class Distribution(Strict):
    """A distribution of values: exactly one of the five is given."""

    uniform: Pair | None = Field(None, description="[low, high], low < high")
    log_uniform: Pair | None = Field(None, description="[low, high], 0 < low < high")
    normal: Pair | None = Field(None, description="[mean, standard deviation], the second above 0")
    choice: Annotated[list[Value], Field(min_length=1)] | None = Field(None, description="a list of numbers or texts")
    grid: Annotated[list[Value], Field(min_length=1)] | None = Field(None, description="a list of numbers or texts")

    @model_validator(mode="after")
    def _one(self):
        given = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(
                f"{' and '.join(given) or 'nothing'} given; allowed: exactly one of "
                f"{', '.join(type(self).model_fields)}"
            )
        pair = self.uniform or self.log_uniform
        if pair and not pair[0] < pair[1]:
            raise ValueError(f"{given[0]} = {pair}; allowed: [low, high] with low < high")
        if self.log_uniform and not pair[0] > 0:
            raise ValueError(f"log_uniform = {pair}; allowed: [low, high] with 0 < low")
        if self.normal and not self.normal[1] > 0:
            raise ValueError(f"normal = {self.normal}; allowed: [mean, standard deviation] with the second above 0")
        return self

    def draw(self, rng: np.random.Generator) -> float | str:
        if self.uniform:
            return float(rng.uniform(*self.uniform))
        if self.log_uniform:
            return float(np.exp(rng.uniform(*np.log(self.log_uniform))))
        if self.normal:
            return float(rng.normal(*self.normal))
        return self.choice[int(rng.integers(len(self.choice)))]

    @property
    def extremes(self) -> list[float | str]:
        """The extreme values of all draws, for a check of bounds; none for a normal, which has no ends."""
        return self.uniform or self.log_uniform or self.choice or self.grid or []


class Camera(Strict):
    """[noise]: EMVA 1288, as in captures.toml."""

    system_gain: Finite = Field(description="DN per electron, > 0")
    dark_noise: Finite = Field(description="DN rms, >= 0")
    black_level: Finite = Field(description="DN")
    saturation: Annotated[float, Field(gt=0, le=65535)] = Field(description="DN, up to 65535")
    prnu: Finite = Field(description="relative rms, >= 0")


class Job(Strict):
    scene: Annotated[str, Field(min_length=1)] | None = Field(
        None, description="a shipped scene's name or the path of an XML file"
    )
    fit: Annotated[str, Field(min_length=1)] | None = Field(
        None, description="a study's folder or a fit.toml, relative to the job file, in place of a scene"
    )
    frame: Annotated[str, Field(min_length=1)] | None = Field(
        None, description="a frame of the fit's captures, with what was set and found in it"
    )
    out: Annotated[str, Field(min_length=1)] = Field(description="a folder, relative to the job file")
    count: Annotated[int, Field(ge=1)] | None = Field(None, description="a whole number from 1 on")
    seed: Annotated[int, Field(ge=0)] = Field(0, description="a whole number from 0 on")
    lights: Literal["together", "each"] = Field("together", description='"together" or "each"')
    outputs: Annotated[list[Literal["exr", "png", "dn"]], Field(min_length=1)] = Field(
        ["exr"], description='a list of "exr", "png", "dn"'
    )
    layers: list[Literal[LAYERS]] = Field(
        list(LAYERS), description=f"what an EXR holds beside the preview: {', '.join(LAYERS)}"
    )
    labels: list[Literal[LABELS]] = Field([], description=f"a list of {', '.join(LABELS)}")
    spp: Annotated[int, Field(ge=1)] | None = Field(None, description="samples per pixel from 1 on: Monte Carlo")
    variant: str = Field(DEFAULT_VARIANT, description="a Mitsuba variant")
    defines: dict[str, Value | int] = Field({}, description="numbers or texts")
    parameters: dict[str, Value] = Field({}, description="numbers or texts")
    sample: dict[str, Distribution] = Field({}, description="key = {uniform = [low, high]}, ...")
    noise: Camera | None = Field(None, description="a table with " + ", ".join(Camera.model_fields))

    @field_validator("outputs", "layers", "labels")
    @classmethod
    def _once(cls, names):
        if len(set(names)) != len(names):
            raise ValueError("a name stands twice; allowed: each once")
        return names

    @model_validator(mode="after")
    def _whole(self):
        if self.scene is None and self.fit is None:
            raise ValueError("scene is missing; allowed: a shipped scene's name, the path of an XML file, or a fit")
        if self.frame is not None and self.fit is None:
            raise ValueError(f'frame = "{self.frame}", but no fit; give the fit of whose captures it is')
        if self.count is None and not self.grids:
            raise ValueError("count is missing; allowed: a whole number from 1 on, or a grid in [sample]")
        if "dn" in self.outputs and self.noise is None and self.fit is None:
            raise ValueError('outputs names "dn", but [noise] is missing; give ' + ", ".join(Camera.model_fields))
        if self.total > SAMPLES_MOST:
            raise ValueError(f"{self.total:.3g} samples; allowed: up to {SAMPLES_MOST:,} in one job; split it")
        twice = sorted(set(self.parameters) & set(self.sample))
        if twice:
            raise ValueError(f"{twice[0]} stands in [parameters] and in [sample]; allowed: one of them")
        return self

    # -- samples ------------------------------------------------------------------------------------------------------
    @property
    def grids(self) -> dict[str, list]:
        return {key: d.grid for key, d in self.sample.items() if d.grid is not None}

    @property
    def total(self) -> int:
        return math.prod(len(values) for values in self.grids.values()) * (self.count or 1)

    def values(self, index: int) -> dict[str, float | str]:
        """What is sampled in the image of this index, by key."""
        point = (
            np.unravel_index(index // (self.count or 1), [len(v) for v in self.grids.values()]) if self.grids else ()
        )
        chosen = {key: grid[int(i)] for (key, grid), i in zip(self.grids.items(), point)}
        return {key: chosen[key] if key in chosen else d.draw(self.rng(index, key)) for key, d in self.sample.items()}

    def rng(self, index: int, purpose: str) -> np.random.Generator:
        """The random stream of one index for one purpose."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(index, zlib.crc32(purpose.encode()))))

    def camera_noise(self) -> Noise | None:
        return None if self.noise is None else Noise(**self.noise.model_dump())


def read(file: str | Path, fit: str | Path | None = None, frame: str | None = None) -> Job:
    """Read and check a job file; raises BadJob, or UnknownKey for a key that the format lacks.

    fit, frame   stand for those of the file; where the file names others they are refused
    """
    file = Path(file)
    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such job file; a job is a TOML file with scene, out, count and [sample]")
    data = checks.parse(file)
    for name, value in (("fit", None if fit is None else os.path.abspath(fit)), ("frame", frame)):
        if value is None:
            continue
        own = data.get(name)
        if own is not None and value != (os.path.abspath(file.parent / str(own)) if name == "fit" else own):
            raise BadJob(f"{file}: {name} = {own!r}, but --{name} {value}; leave out one of them")
        data[name] = value
    for name in ("parameters", "sample"):
        for key, value in (data.get(name) or {}).items() if isinstance(data.get(name), dict) else ():
            names = Distribution.model_fields if name == "sample" else ()
            if (
                isinstance(value, dict)
                and not set(value) & set(names)
                and any(isinstance(v, (dict, float, int)) for v in value.values())
            ):
                raise BadJob(
                    f"{file}: [{name}]: {key} is a table; a key with a dot stands in quotes: "
                    f'"{key}.{next(iter(value))}"'
                )
    try:
        job = Job.model_validate(data)
        job.camera_noise()
    except ValidationError as error:
        raise _explained(error, file) from error
    except ValueError as error:
        raise BadJob(f"{file}: [noise]: {error}") from error
    return job


def _explained(error: ValidationError, file: Path) -> Exception:
    """The first validation error as a sentence: what, where, allowed."""
    first, more = error.errors()[0], error.error_count() - 1
    place = [str(p) for p in first["loc"] if not str(p).startswith(("list[", "constrained-", "float", "str", "int"))]
    model, field = Job, None
    for name in place:  # down to the model that holds the key
        if field is not None and field.annotation is not None:
            inner = {"noise": Camera, "sample": Distribution}.get(place[0])
            model = inner or model
        field = model.model_fields.get(name, field)
    where = f"{file}: " + (f"[{place[0]}] " if len(place) > 1 else "")
    name = ".".join(place[1:] if len(place) > 1 else place)
    if first["type"] == "extra_forbidden":
        return UnknownKey(place[-1], model.model_fields, "key", where.rstrip(": "))
    if first["type"] == "missing":
        return BadJob(f"{where}{name} is missing; allowed: {field.description}")
    text = first["msg"].removeprefix("Value error, ")
    if first["type"] != "value_error":
        text = f"{first['input']!r}; allowed: {field.description if field else text}"
    return BadJob(
        f"{where}{f'{name} = ' if first['type'] != 'value_error' else f'{name}: ' if name else ''}{text}"
        + (f" (and {more} more)" if more and first["type"] not in ("union",) else "")
    )


def _sensor(job: Job, file: Path, plugins: Named) -> Calibrated:
    """The scene of a job, and the values of its fit."""
    given = None
    if job.scene is not None:
        given = file.parent / job.scene if job.scene.endswith(".xml") else job.scene
    defines = {k: str(v) for k, v in job.defines.items()}
    if job.fit is None:
        return Calibrated(scenes.load(given, defines, job.variant, plugins), {})
    fit = file.parent / job.fit
    return calibrated(fit, frame=job.frame, scene=given, defines=defines, variant=job.variant, plugins=plugins)


# -- one sample ------------------------------------------------------------------------------------------------------
class Maker:
    """Makes the files of one sample after the other."""

    def __init__(self, job: Job, file: Path, plugins: Named):
        self.job, self.file = job, Path(file)
        sensor = _sensor(job, self.file, plugins)
        sensor.noise = job.camera_noise() or sensor.noise
        self.noise, self.notes = sensor.noise, sensor.notes
        if "dn" in job.outputs and self.noise is None:
            raise BadJob(f'{file}: outputs names "dn", but neither [noise] nor the fit tells the noise of the camera')
        self.values = {**sensor.values, **job.parameters}
        self.images = RenderJob(
            sensor.scene,
            spp=job.spp,
            layers=job.layers,
            black=sensor.black,
            saturation=sensor.saturation,
            labels=job.labels,
        )
        self.folder = folder_of(job, self.file)

    def check(self) -> None:
        """Check every value that can be drawn against the scene; raises before anything is rendered."""
        job, scene = self.job, self.images.scene
        if job.lights == "each" and not scene.lights:
            raise BadJob(f'{self.file}: lights = "each", but {scene.path} has no LED or source; allowed: "together"')
        if "dn" in job.outputs and self.images.developer is None:
            raise BadJob(
                f"{self.file}: outputs names \"dn\", but {scene.path} has no part 'camera' to make DN; allowed: "
                "exr, png"
            )
        scene.check(job.parameters, f"{self.file}: [parameters]")
        if job.parameters:
            scene.check_press(self.values, f"{self.file}: [parameters]")
        if job.fit is None:  # of a fit alone nobody stated a depth
            scene.check_press({**scene.values(), **self.values}, f"{self.file}: [defines]")
        for key, d in job.sample.items():
            where = f"{self.file}: [sample]"
            if key not in scene.parameters:
                raise UnknownKey(key, scene.parameters, "parameter", where, "`optics params SCENE` lists them")
            parameter = scene.parameters[key]
            if not parameter.is_number and not (d.choice or d.grid):
                raise BadJob(
                    f"{where}: {key} is a word and no number; allowed: choice or grid of {', '.join(parameter.choices)}"
                )
            for value in d.extremes:
                parameter.check(value, key, where)
                scene.check_press({**self.values, key: value}, where)
            if d.normal is not None:
                self._check_normal(key, d)

    def _check_normal(self, key: str, d: Distribution) -> None:
        """A normal has no ends, so its draws themselves are checked."""
        parameter = self.images.scene.parameters[key]
        low, high = parameter.bounds
        if low <= d.normal[0] - 40 * d.normal[1] and d.normal[0] + 40 * d.normal[1] <= high:
            return
        for index in range(self.job.total):
            value = d.draw(self.job.rng(index, key))
            if not low <= value <= high:
                raise OutOfBounds(
                    key,
                    value,
                    parameter.unit,
                    parameter.bounds,
                    f"{self.file}: [sample]: normal = {d.normal} draws at index {index}",
                )

    def identity(self) -> dict:
        """What the files depend on."""
        record = self.images.record
        numbers = {k: v for k, v in record["versions"].items() if k not in ("python", "system")}
        return {
            "job": self.job.model_dump(
                mode="json", exclude={"out", "fit", "frame", *(() if self.job.labels else ("labels",))}
            ),
            **({"fit": self.values} if self.job.fit is not None else {}),
            "scene": record["scene"],
            "plugins": record["plugins"],
            "versions": numbers,
        }

    def make(self, index: int) -> dict:
        """Write the files of one sample, each whole or not at all, and return its line of the manifest."""
        job = self.job
        values = job.values(index)
        lights = [None] if job.lights == "together" else list(self.images.scene.lights)
        files, told = {}, {}
        for led in lights:
            stem = self.folder / "images" / (f"{index:06d}" if led is None else f"{index:06d}-{led}")
            seed = int(job.rng(index, "render").integers(2**31))
            image = self.images.take({**self.values, **values}, seed, None if led is None else [led])
            for output in job.outputs:
                files[output if led is None else f"{led}.{output}"] = self._entry(
                    self._write(image, output, stem, index)
                )
            told = image.labels.numbers  # of the press, whatever is lit
        if job.labels and image.labels.arrays:
            path = self.folder / "images" / f"{index:06d}.npz"
            files["labels"] = self._entry(labelling.write(path, image.labels.arrays))
        return {"index": index, "sample": values, "files": files, **({"labels": told} if job.labels else {})}

    def _entry(self, path: Path) -> dict:
        return {
            "file": path.relative_to(self.folder).as_posix(),
            "size": path.stat().st_size,
            "hash": file_hash(path),
        }

    def _write(self, image, output: str, stem: Path, index: int) -> Path:
        if output == "exr":
            return image.write_exr(stem.with_name(stem.name + ".exr"))
        if output == "png":
            return image.write_png(
                stem.with_name(stem.name + ".png"), 255.0 if self.noise is None else self.noise.saturation
            )
        from optics.files.images import write_image

        pattern = self.noise.fixed_pattern(image.camera.shape, self.job.rng(0, "fixed pattern"))
        frame = self.noise.expose(image.camera, self.job.rng(index, f"noise {stem.name}"), pattern)
        path = stem.with_name(stem.name + "-dn.png")
        with replacing(path) as temporary:
            write_image(
                temporary.with_name(temporary.stem),
                np.clip(np.round(frame), 0, None),
                8 if self.noise.saturation <= 255 else 16,
            )
        return path


# -- the folder ------------------------------------------------------------------------------------------------------
def folder_of(job: Job, file: Path) -> Path:
    return Path(os.path.abspath(Path(file).parent / job.out))


def _open_folder(folder: Path, identity: Mapping) -> None:
    """Start a folder, or resume one that was made from the same job."""
    note = folder / "job.json"
    if note.is_file():
        try:
            before = json.loads(note.read_text(encoding="utf-8"))
        except ValueError as error:
            raise OutputExists(
                f"{note}: unreadable ({error}); restore it, or choose another folder for `out`"
            ) from error
        if before != identity:
            changed = _changes(before, json.loads(json.dumps(identity)))
            raise OutputExists(
                f"{folder} was made from another job: changed {', '.join(changed[:4])}"
                f"{' ...' if len(changed) > 4 else ''}; choose another folder for `out`, or undo the change"
            )
        return
    check_folder(folder)
    if folder.exists() and (not folder.is_dir() or any(not p.name.startswith(".") for p in folder.iterdir())):
        raise OutputExists(f"{folder} exists and holds no batch; choose another folder for `out`")
    (folder / "images").mkdir(parents=True, exist_ok=True)
    write_text(note, json.dumps(identity, indent=1, sort_keys=True) + "\n")


def _changes(before, now, name: str = "") -> list[str]:
    if isinstance(before, dict) and isinstance(now, dict):
        return [
            c
            for key in sorted(before.keys() | now.keys())
            for c in _changes(before.get(key), now.get(key), f"{name}.{key}" if name else str(key))
        ]
    return [] if before == now else [name]


@contextmanager
def _alone(folder: Path, shard: tuple[int, int]) -> Iterator[None]:
    """Lock a shard against a second process; the system frees the lock however the process ends."""
    lock = folder / f".lock-{shard[0]}-of-{shard[1]}"
    said = f"{folder}: another process works on shard {shard[0]}/{shard[1]}; wait for it, or take another shard"
    with alone(lock, said):
        yield


def _manifest(folder: Path, shard: tuple[int, int]) -> Path:
    return folder / ("manifest.jsonl" if shard == (1, 1) else f"manifest-{shard[0]}-of-{shard[1]}.jsonl")


def _lines(file: Path) -> dict[int, dict]:
    """Records by index; a line that a killed process left incomplete is skipped."""
    found = {}
    for line in file.read_text(encoding="utf-8").splitlines() if file.is_file() else ():
        try:
            record = json.loads(line)
            found[record["index"]] = record
        except (ValueError, TypeError, KeyError):
            continue
    return found


def _all_lines(folder: Path) -> dict[int, dict]:
    found = {}
    for file in sorted(folder.glob("manifest*.jsonl")):
        found.update(_lines(file))
    return found


def _stands(folder: Path, record: Mapping) -> bool:
    """Whether every file of a record is there, with its size and hash."""
    for entry in record["files"].values():
        file = folder / entry["file"]
        if not file.is_file() or file.stat().st_size != entry["size"] or file_hash(file) != entry["hash"]:
            return False
    return True


def _text(records: Mapping[int, dict]) -> str:
    return "".join(json.dumps(records[i], sort_keys=True) + "\n" for i in sorted(records))


def _finish(folder: Path, job: Job) -> bool:
    """Write one ordered manifest and the table once every sample of the job is complete."""
    records = _all_lines(folder)
    if len(records) < job.total:
        return False
    keys, roles = list(job.parameters) + list(job.sample), list(next(iter(records.values()))["files"])
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    told = list(labelling.flat(records[min(records)].get("labels", {})))
    writer.writerow(["index", *keys, *told, *roles])
    for index in sorted(records):
        values = {**job.parameters, **records[index]["sample"]}
        labels = labelling.flat(records[index].get("labels", {}))
        files = records[index]["files"]
        writer.writerow(
            [index, *(values[k] for k in keys), *(labels.get(k) for k in told), *(files[r]["file"] for r in roles)]
        )
    write_text(folder / "manifest.jsonl", _text(records))
    write_text(folder / "manifest.csv", out.getvalue())
    for part in folder.glob("manifest-*-of-*.jsonl"):
        part.unlink(missing_ok=True)
    return True


# -- the work --------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Result:
    """folder, samples of the job, of this shard, those made now, whether the whole job is complete, and what images of
    a calibrated sensor leave out."""

    folder: Path
    total: int
    own: int
    made: int
    complete: bool
    notes: list[str] = field(default_factory=list)


def parse_shard(text: str) -> tuple[int, int]:
    """'2/4' -> (2, 4): the second of four shards. Raises ValueError."""
    head, slash, tail = text.partition("/")
    if not (slash and head.isdecimal() and tail.isdecimal() and 1 <= int(head) <= int(tail)):
        raise ValueError(f"shard '{text}'; allowed: k/n with 1 <= k <= n, such as 1/4, 2/4, 3/4, 4/4")
    return int(head), int(tail)


def run(
    file: str | Path,
    shard: tuple[int, int] = (1, 1),
    workers: int | None = None,
    plugins: Named = None,
    progress: Progress | None = None,
    *,
    fit: str | Path | None = None,
    frame: str | None = None,
) -> Result:
    """Make the missing samples of a job's shard. It can be stopped at any moment and called again.

    fit, frame   a calibrated sensor, where the job file names none (optics.study.calibrated)
    workers   processes of one thread each; None: as many as there are cores. With 1 everything happens in this process.
    Raises BadJob, UnknownKey, OutOfBounds, OutputExists before any rendering, SampleFailed in its course.
    """
    if workers is not None and workers < 1:
        raise ValueError(f"workers = {workers}; allowed: whole numbers from 1 on")
    file = Path(os.path.abspath(file))
    job = read(file, fit, frame)
    folder = folder_of(job, file)
    check_folder(folder)
    maker = Maker(job, file, plugins)
    maker.check()
    _open_folder(folder, maker.identity())
    own = range(shard[0] - 1, job.total, shard[1])
    made = 0
    with _alone(folder, shard):
        todo = _remaining(folder, shard, own, progress)
        workers = max(1, min(workers or _cores(), len(todo)))
        work = _here(maker, todo) if workers == 1 else _crew(job, file, plugins, todo, workers)
        manifest = _manifest(folder, shard)
        try:
            with open(manifest, "a", encoding="utf-8") as lines:
                for record in work:
                    lines.write(json.dumps(record, sort_keys=True) + "\n")
                    lines.flush()
                    made += 1
                    if progress:
                        progress("batch", len(own) - len(todo) + made, len(own))
        finally:
            work.close()
            _sweep(folder, shard)
    return Result(folder, job.total, len(own), made, _finish(folder, job), maker.notes)


def _remaining(folder: Path, shard: tuple[int, int], own: Sequence[int], progress: Progress | None) -> list[int]:
    """Indices of a shard without a record, or whose files differ from it; removes what a killed process left."""
    known, bad = _all_lines(folder), set()
    done = [i for i in own if i in known]
    for k, index in enumerate(done):
        if not _stands(folder, known[index]):
            bad.add(index)
        if progress and k % 50 == 0:
            progress("checking what is there", k + 1, len(done))
    _sweep(folder, shard)
    for manifest in folder.glob("manifest*.jsonl") if bad else [_manifest(folder, shard)]:
        lines = {i: r for i, r in _lines(manifest).items() if i not in bad}
        if manifest.is_file() and manifest.read_text(encoding="utf-8") != _text(lines):
            write_text(manifest, _text(lines))
    if bad:
        (folder / "manifest.csv").unlink(missing_ok=True)
    return [i for i in own if i not in known or i in bad]


def _sweep(folder: Path, shard: tuple[int, int]) -> None:
    """Remove unfinished files of this shard."""
    for file in (folder / "images").glob(".*"):
        index = file.name[1:7]
        if index.isdecimal() and int(index) % shard[1] == shard[0] - 1:
            file.unlink(missing_ok=True)


def _here(maker: Maker, todo: Sequence[int]) -> Iterator[dict]:
    import drjit as dr

    threads = dr.thread_count()
    dr.set_thread_count(
        0
    )  # sums over faces (normals) and samples (a film) take the order of threads into their last bit
    try:
        for index in todo:
            try:
                yield maker.make(index)
            except Exception as error:
                raise _failed(maker.job, index, f"{type(error).__name__}: {error}") from error
    finally:
        dr.set_thread_count(threads)


def _failed(job: Job, index: int, why: str) -> SampleFailed:
    values = ", ".join(f"{k} = {v:.4g}" if isinstance(v, float) else f"{k} = {v}" for k, v in job.values(index).items())
    return SampleFailed(
        f"sample {index} ({values or 'nothing sampled'}): {why}; what was made before is kept, the same command goes on"
    )


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _crew(job: Job, file: Path, plugins: Named, todo: Sequence[int], workers: int) -> Iterator[dict]:
    """Records from worker processes, in the order in which they finish.

    Each holds one end of a pipe and nothing else of this process, so that it ends when this one is killed.
    """
    from multiprocessing import get_context
    from multiprocessing.connection import wait

    context = get_context("spawn")
    waiting = iter(todo)
    busy = {}  # connection -> (process, index)
    processes = []
    try:
        for index in itertools.islice(waiting, workers):
            here, there = context.Pipe()
            process = context.Process(target=_work, args=(there, job, file, plugins), daemon=True)
            process.start()
            there.close()
            processes.append(process)
            here.send(index)
            busy[here] = (process, index)
        while busy:
            for connection in wait(list(busy)):
                process, index = busy.pop(connection)
                try:
                    answer = connection.recv()
                except (EOFError, OSError):
                    process.join(5)
                    raise _failed(job, index, f"its process ended (exit code {process.exitcode})") from None
                if isinstance(answer, str):
                    raise _failed(job, index, answer)
                following = next(waiting, None)
                if following is None:
                    connection.close()
                else:
                    connection.send(following)
                    busy[connection] = (process, following)
                yield answer
    finally:
        for process in processes:
            if busy:
                process.terminate()
        for process in processes:
            process.join(10)


def _work(connection, job: Job, file: Path, plugins: Named) -> None:
    """The loop of a worker: it receives an index, and sends a record or the text of an error."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    try:
        index = connection.recv()
        try:
            import drjit as dr

            dr.set_thread_count(0)  # see `_here`
            maker = Maker(job, file, plugins)
        except Exception as error:
            connection.send(f"{type(error).__name__}: {error}")
            return
        while True:
            try:
                answer = maker.make(index)
            except Exception as error:
                answer = f"{type(error).__name__}: {error}"
            connection.send(answer)
            index = connection.recv()
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return  # the parent has no more work, or is gone
