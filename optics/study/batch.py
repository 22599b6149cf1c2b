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
    [noise]                                    # of the output "dn"; see captures
    system_gain = 0.2                          # DN per electron
    dark_noise  = 2.0                          # DN
    black_level = 64.0
    saturation  = 1023.0
    prnu        = 0.0
    [parameters]                               # the same in every image
    "gel.indenter_size" = 2.0
    [sample]
    "gel.press_x"     = { uniform = [-4, 4] }
    "gel.press_depth" = { log_uniform = [0.1, 1] }
    "led_1.power"     = { normal = [1, 0.05] }
    "gel.indenter"    = { choice = ["sphere", "cube"] }
    "gel.press_rz"    = { grid = [0, 30, 60] } # every value; several grids: every combination, the last one fastest

A series of sensors, each with `per_unit` images (optics.study.draws):

    per_unit  = 50
    posterior = true                           # calibrated values with the fit's covariance; or a list of patterns
    [unit]                                     # as [sample], once for each sensor
    "led_1.power"    = { normal = [1, 0.05] }
    "lens vignetting" = { plausible = 1 }      # an effect, or a parameter: so many plausible sizes, about what it is

A draw depends on seed, index and key alone: not on the order of work, on shards or workers, nor on what else is
sampled. The folder gets images/, job.json (what it was made from) and, when all is done, manifest.jsonl (a line per
sample) and manifest.csv; until then a sample is recorded, once its files stand, in .parts (optics.study.blocks)."""

from __future__ import annotations

import csv
import functools
import itertools
import json
import math
import os
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError, field_validator, model_validator

from optics.captures.noise import Noise
from optics.errors import OutOfBounds, OutputExists, UnknownKey
from optics.files import toml_checks as checks
from optics.files.output import FULL, alone, check_folder, file_hash, replacing, write_json, write_text
from optics.light import labels as labelling
from optics.light.labels import LABELS
from optics.light.rendering import LAYERS, RenderJob
from optics.processes import cores, for_workers
from optics.scene import loader as scenes
from optics.scene.mitsuba_parts import DEFAULT_VARIANT, use_variant
from optics.scene.trust import Named
from optics.study.blocks import Block, Blocks, DiskFull, SampleFailed
from optics.study.calibrated import Calibrated, calibrated
from optics.study.draws import BadJob, Distribution, Drawn, Draws, Finite, Strict, Value, stream
from optics.study.engines import ENGINES, Local, Status, work_through

Progress = Callable[[str, int, int], None]

SAMPLES_MOST = 10_000_000  # of one job, whose manifest is one file
CHECKED = 10_000  # samples of a job whose draws are looked at before any is rendered, evenly over all: a second or two
RECYCLE = 1000  # samples of one worker: its start, a few seconds, is then a hundredth of its work, or less


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
    unit: dict[str, Distribution] = Field({}, description="key = {uniform = [low, high]}, ...")
    per_unit: Annotated[int, Field(ge=1)] = Field(1, description="a whole number from 1 on: images of a sensor")
    posterior: bool | Annotated[list[str], Field(min_length=1)] = Field(
        False, description="true, or a list of patterns of the fit's variables"
    )
    noise: Camera | None = Field(None, description="a table with " + ", ".join(Camera.model_fields))

    @field_validator("outputs", "layers", "labels")
    @classmethod
    def _once(cls, names):
        if len(set(names)) != len(names):
            raise ValueError("a name appears twice; allowed: each once")
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
        tables = {"parameters": self.parameters, "sample": self.sample, "unit": self.unit}
        for one, two in itertools.combinations(tables, 2):
            if twice := sorted(set(tables[one]) & set(tables[two])):
                raise ValueError(f"{twice[0]} stands in [{one}] and in [{two}]; allowed: one of them")
        for key, d in self.unit.items():
            if d.grid is not None:
                raise ValueError(f"[unit] {key}: a grid counts images, and not sensors; allowed: choice")
        if self.posterior and self.fit is None:
            raise ValueError("posterior, but no fit; give the fit whose covariance it is")
        return self

    # -- samples ------------------------------------------------------------------------------------------------------
    @property
    def grids(self) -> dict[str, list]:
        return {key: d.grid for key, d in self.sample.items() if d.grid is not None}

    @property
    def total(self) -> int:
        return math.prod(len(values) for values in self.grids.values()) * (self.count or 1)

    def values(self, index: int) -> dict[str, float | str]:
        """What is drawn for the image of this index, by key; what takes a scene to draw is in optics.study.draws."""
        point = (
            np.unravel_index(index // (self.count or 1), [len(v) for v in self.grids.values()]) if self.grids else ()
        )
        chosen = {key: grid[int(i)] for (key, grid), i in zip(self.grids.items(), point)}
        found = {}
        for table, number, prefix in ((self.sample, index, ""), (self.unit, index // self.per_unit, "unit ")):
            for key, d in table.items():
                if key in chosen:
                    found[key] = chosen[key]
                elif d.plausible is None:
                    found[key] = d.draw(self.rng(number, prefix + key))
        return found

    def rng(self, index: int, purpose: str) -> np.random.Generator:
        """The random stream of one index for one purpose."""
        return stream(self.seed, index, purpose)

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
    for name in ("parameters", "sample", "unit"):
        for key, value in (data.get(name) or {}).items() if isinstance(data.get(name), dict) else ():
            names = Distribution.model_fields if name != "parameters" else ()
            if (
                isinstance(value, dict)
                and not set(value) & set(names)
                and any(isinstance(v, (dict, float, int)) for v in value.values())
            ):
                raise BadJob(
                    f'{file}: [{name}]: {key} is a table; a key with a dot needs quotes: "{key}.{next(iter(value))}"'
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
    kinds = ("float", "str", "int", "bool")  # pydantic names what it tried
    places = [
        [str(p) for p in e["loc"] if p not in kinds and not str(p).startswith(("list[", "constrained-"))]
        for e in error.errors()
    ]
    first, place, more = error.errors()[0], places[0], len(set(map(tuple, places))) - 1
    model, field = Job, None
    for name in place:  # down to the model that holds the key
        if field is not None and field.annotation is not None:
            inner = {"noise": Camera, "sample": Distribution, "unit": Distribution}.get(place[0])
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
        + (f" (and {more} more)" if more else "")
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
        if job.posterior and sensor.posterior is None:
            raise BadJob(
                f"{file}: posterior, but the fit holds no covariance; calibrate again, as earlier versions kept none"
            )
        self.draws = Draws(
            job, sensor.scene, self.values, self.file, sensor.posterior if job.posterior else None, sensor.levels
        )
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
        for drawn in self.draws.drawn:
            key, d, parameter = drawn.name, drawn.distribution, drawn.parameter
            where = f"{self.file}: [{'unit' if drawn.unit else 'sample'}]"
            if not parameter.is_number and not (d.choice or d.grid):
                raise BadJob(
                    f"{where}: {key} is a word and no number; allowed: choice or grid of {', '.join(parameter.choices)}"
                )
            for value in d.extremes:
                parameter.check(value, key, where)
                scene.check_press({**self.values, key: value}, where)
            if d.normal is not None:
                self._check_normal(drawn, where)
        self._check_draws()

    def _check_draws(self) -> None:
        """What is drawn together, of up to CHECKED samples: values that a draw of another makes bad."""
        scene, total = self.images.scene, self.job.total
        if not self.draws.keys:
            return
        gel = scene.gel
        press = () if gel is None else [scene.key(gel.name, role) for role in ("press depth", "thickness")]
        rest = {**scene.values(), **self.values}
        for index in sorted({k * total // min(CHECKED, total) for k in range(min(CHECKED, total))}):
            where = f"{self.file}: sample {index}"
            values = self.draws.at(index)
            scene.check(values, where)
            if set(values) & set(press) and None not in press:
                depth, thickness = (values.get(key, rest[key]) for key in press)
                if depth > thickness:
                    scene.check_press({**rest, **values}, where)

    def _check_normal(self, drawn: Drawn, where: str) -> None:
        """A normal has no ends, so its draws themselves are checked."""
        (mean, sd), (low, high) = drawn.distribution.normal, drawn.parameter.bounds
        if low <= mean - 40 * sd and mean + 40 * sd <= high:
            return
        step = self.job.per_unit if drawn.unit else 1
        for index in range(0, self.job.total, step):
            value = drawn.distribution.draw(self.job.rng(index // step, drawn.purpose))
            if not low <= value <= high:
                raise OutOfBounds(
                    drawn.name,
                    value,
                    drawn.parameter.unit,
                    drawn.parameter.bounds,
                    f"{where}: normal = {drawn.distribution.normal} draws at {'unit' if drawn.unit else 'index'} "
                    f"{index // step}",
                )

    def identity(self) -> dict:
        """What the files depend on."""
        record = self.images.record
        numbers = {k: v for k, v in record["versions"].items() if k not in ("python", "system")}
        return {
            "job": self.job.model_dump(
                mode="json", exclude={"out", "fit", "frame", *(() if self.job.labels else ("labels",))}
            ),
            **(
                {"fit": self.values, "noise": self.noise and asdict(self.noise), **self._posterior()}
                if self.job.fit is not None
                else {}
            ),
            # JSON keeps no order of keys, and the order of grids says which sample is which.
            **({"grids": list(self.job.grids)} if len(self.job.grids) > 1 else {}),
            "scene": record["scene"],
            "plugins": record["plugins"],
            "versions": numbers,
        }

    def _posterior(self) -> dict:
        return {} if self.draws.posterior is None else {"posterior": self.draws.posterior.table()}

    def described(self) -> dict:
        """Key -> unit and meaning of what is fixed and drawn, and of labels, for who reads the folder."""
        scene = self.images.scene
        found = {key: scene.parameters[key] for key in [*self.job.parameters, *self.draws.keys]}
        labels = labelling.described(scene, self.job.labels)
        return {
            **{key: {"unit": p.unit, "doc": p.doc} for key, p in found.items()},
            **{f"labels.{name}": told for name, told in labels.items()},
            **({"unit": {"unit": "", "doc": "number of the sensor in the series"}} if self.draws.serial else {}),
        }

    def make(self, index: int) -> dict:
        """Write the files of one sample, each whole or not at all, and return its line of the manifest."""
        job = self.job
        values = self.draws.at(index)
        unit = {"unit": self.draws.unit_of(index)} if self.draws.serial else {}
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
        labels = {"labels": told} if job.labels else {}
        return {"index": index, **unit, "sample": values, "files": files, **labels}

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

        frame = self.exposed(image.camera, self.job.rng(index, f"noise {stem.name}"))
        return write_image(stem.with_name(stem.name + "-dn"), frame, 8 if self.noise.saturation <= 255 else 16)

    def exposed(self, camera: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(H, W, C) whole DN of what the camera makes of an image, with noise and its fixed pattern."""
        pattern = self.noise.fixed_pattern(camera.shape, self.job.rng(0, "fixed pattern"))
        return np.clip(np.round(self.noise.expose(camera, rng, pattern)), 0, None)


# -- the folder ------------------------------------------------------------------------------------------------------
def folder_of(job: Job, file: Path) -> Path:
    return Path(os.path.abspath(Path(file).parent / job.out))


def _open_folder(folder: Path, identity: Mapping) -> None:
    """Start a folder, or resume one that was made from the same job."""
    note, identity = folder / "job.json", json.loads(json.dumps(identity))
    if note.is_file():
        try:
            before = json.loads(note.read_text(encoding="utf-8"))
            if not isinstance(before, dict):
                raise ValueError("no table")
        except (ValueError, RecursionError) as error:
            raise OutputExists(
                f"{note}: unreadable ({error}); restore it, or choose another folder for `out`"
            ) from error
        if before != identity:
            changed = _changes(before, identity)
            raise OutputExists(
                f"{folder} was made from another job: changed {', '.join(changed[:4])}"
                f"{' ...' if len(changed) > 4 else ''}; choose another folder for `out`, or undo the change"
            )
        return
    check_folder(folder)
    if folder.exists() and (not folder.is_dir() or any(not p.name.startswith(".") for p in folder.iterdir())):
        raise OutputExists(f"{folder} exists and holds no batch; choose another folder for `out`")
    write_text(note, json.dumps(identity, indent=1, sort_keys=True) + "\n")  # first: it makes the folder a batch's
    (folder / "images").mkdir(exist_ok=True)


def _is_table(file: Path) -> bool:
    """Whether a file is there and holds a JSON table."""
    try:
        return isinstance(json.loads(file.read_text(encoding="utf-8")), dict)
    except (OSError, ValueError, RecursionError):
        return False


def _changes(before, now, name: str = "") -> list[str]:
    if isinstance(before, dict) and isinstance(now, dict):
        return [
            c
            for key in sorted(before.keys() | now.keys())
            for c in _changes(before.get(key), now.get(key), f"{name}.{key}" if name else str(key))
        ]
    return [] if before == now else [name]


PATIENCE = 10.0  # s for another command to write its manifest, also where a file server tells of it seconds later


def finish(job: Job, blocks: Blocks) -> bool:
    """Write one ordered manifest and its table once every sample of the job is recorded; whether it is.

    One worker does it, and the others wait for it: whoever ends first removes the records that the table is made of."""
    while not blocks.finished:
        if len(blocks.complete()) < blocks.count:
            return blocks.finished  # while the blocks were counted, another one may have ended
        try:
            with alone(blocks.parts / "finish.lock", ""):
                for pattern in (".manifest.*", ".job.*", ".parameters.*"):  # of commands that were killed
                    for file in blocks.folder.glob(pattern):
                        file.unlink(missing_ok=True)
                if not blocks.finished:
                    _write_table(job, blocks)
                    blocks.finish()
        except OutputExists:  # another worker is at it; the lock is free if that one dies
            time.sleep(PATIENCE / 50)
        except FileNotFoundError:  # `.parts` is gone, or, where a file system has no locks, what was being written
            until = time.monotonic() + PATIENCE
            while not blocks.finished:  # another command has been at it, or is
                if time.monotonic() > until:
                    raise
                time.sleep(PATIENCE / 50)
    return blocks.finish()


def _write_table(job: Job, blocks: Blocks) -> None:
    """manifest.csv: a row per sample, with what is fixed and what is drawn by key, the numbers of labels, and its files
    by role."""
    with replacing(blocks.manifest.with_suffix(".csv")) as file, open(file, "w", encoding="utf-8", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        keys: list[str] = []
        told: list[str] = []
        roles: list[str] = []
        written = 0
        for record in blocks.records():
            unit = {"unit": record["unit"]} if "unit" in record else {}
            values = {**unit, **job.parameters, **record["sample"]}
            labels = labelling.flat(record.get("labels", {}))
            files = record["files"]
            if not keys:
                keys, told, roles = list(values), list(labels), list(files)
                writer.writerow(["index", *keys, *told, *roles])
            row = (*(values[k] for k in keys), *(labels.get(k) for k in told), *(files[r]["file"] for r in roles))
            writer.writerow([record["index"], *row])
            written += 1
        if written < blocks.total:
            raise FileNotFoundError(f"{blocks.parts}: records of {written} samples of {blocks.total}")


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
    on: str = "local",
    options: Mapping[str, str] | None = None,
    recycle: int = RECYCLE,
    watch: Callable[[Status], None] | None = None,
    check_files: bool = False,
) -> Result:
    """Make the missing samples of a job's shard. It can be stopped at any moment and called again, and called from
    several machines that share the folder.

    fit, frame   a calibrated sensor, where the job file names none (optics.study.calibrated)
    workers   processes of one thread each; None: as many as there are cores, on a cluster what its engine takes. With 1
              on "local", everything happens in this process.
    on        "local", "slurm" or "ray" (optics.study.engines), with its own `options`
    recycle   samples that a worker makes before a fresh one takes its place
    watch     is told the Status, several times a second
    check_files   read every file that is there and compare its hash; else only those that were written to since
    Raises BadJob, UnknownKey, OutOfBounds, OutputExists before any rendering, SampleFailed and EngineFailed in its
    course.
    """
    for name, number in (("workers", workers), ("recycle", recycle)):
        if number is not None and number < 1:
            raise ValueError(f"{name} = {number}; allowed: whole numbers from 1 on")
    if on not in ENGINES:
        raise UnknownKey(on, ENGINES, "engine", "--on")
    file = Path(os.path.abspath(file))
    job = read(file, fit, frame)
    folder = folder_of(job, file)
    check_folder(folder)
    here = on == "local" and (workers or cores()) == 1
    with _workers_loading(job, folder, workers, options) if on == "local" and not here else nullcontext() as local:
        maker = Maker(job, file, plugins)
        maker.check()
        _open_folder(folder, maker.identity())
        if not _is_table(folder / "parameters.json"):
            write_json(folder / "parameters.json", maker.described())
        blocks = Blocks(folder, job.total, shard, uuid.uuid4().hex[:8])
        blocks.verify(progress, check_files)
        blocks.sweep()
        before = blocks.counts().recorded
        if before < blocks.own:
            try:
                if here:
                    _here(blocks, maker, watch)
                else:
                    life = Life(job, file, plugins, shard, blocks.run)
                    with for_workers():
                        engine = local or ENGINES[on](workers, options or {}, folder)
                        work_through(engine, life, blocks, recycle, watch)
            finally:
                blocks.sweep()
    made = blocks.counts().recorded - before
    complete = finish(job, blocks)
    failures = {} if complete else blocks.failures()
    if failures:
        index, why = next(iter(failures.items()))
        raise failed(job, index, why, len(failures) - 1)
    return Result(folder, job.total, blocks.own, made, complete, maker.notes)


@contextmanager
def _workers_loading(job: Job, folder: Path, workers: int | None, options: Mapping[str, str] | None) -> Iterator[Local]:
    """The engine of this machine, whose first workers load the program while the caller checks the job; not for a batch
    that is finished, which needs none."""
    local = Local(workers, options or {}, folder)
    try:
        if not (folder / "manifest.jsonl").is_file():
            with for_workers():
                local.warm(job.total, use_variant, job.variant)
        yield local
    finally:
        local.stop()


def _here(blocks: Blocks, maker: Maker, watch: Callable[[Status], None] | None) -> None:
    """All of a shard in this process."""
    begin, before = time.monotonic(), blocks.counts()

    def made(count: int) -> None:
        if watch:
            now, seconds = before.recorded + count, time.monotonic() - begin
            watch(Status(now, blocks.own, count, 0, 0, 1, seconds))

    with serial():
        fill(blocks, lambda: maker, made=made)


@dataclass(frozen=True)
class Life:
    """What one worker does, on any engine: make up to `limit` samples, and end. Returns how many it made.

    place   (k, n): this worker begins at the k-th of n places, so that workers rarely want the same block
    """

    job: Job
    file: Path
    plugins: Named
    shard: tuple[int, int]
    run: str
    place: tuple[int, int] = (0, 1)
    limit: int = RECYCLE

    def __call__(self) -> int:
        folder = folder_of(self.job, self.file)
        blocks = Blocks(folder, self.job.total, self.shard, self.run)

        def maker() -> Maker:
            found = Maker(self.job, self.file, self.plugins)
            _open_folder(folder, found.identity())  # on this machine, too, it makes the same images
            return found

        with serial():
            count = fill(blocks, maker, self.limit, self.place)
        finish(self.job, blocks)
        return count

    def checkpoint(self) -> Any:
        """What submitit submits again when a task runs out of time, or gives way to another."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


def fill(
    blocks: Blocks,
    maker: Callable[[], Maker],
    limit: float = math.inf,
    place: tuple[int, int] = (0, 1),
    made: Callable[[int], None] | None = None,
) -> int:
    """Claim blocks and make their samples, until `limit` of them are made or no block is to be had; how many were.

    A sample that ends in an error is tried again, with others between, up to TRIES times. Raises DiskFull at once.
    """
    first = place[0] * len(blocks.numbers) // place[1]
    order = [*blocks.numbers[first:], *blocks.numbers[:first]]
    maker, count, trying = functools.cache(maker), 0, True
    while trying:
        trying, complete = False, blocks.complete()
        for number in order:
            if number in complete:
                continue
            with blocks.claim(number) as block:
                for index in block.wanted if block is not None else ():
                    if count >= limit:
                        return count
                    trying = True
                    count += _make(block, maker(), index)
                    if made:
                        made(count)
    return count


def _make(block: Block, maker: Maker, index: int) -> bool:
    """Make and record one sample; whether it was made."""
    try:
        block.begin(index)
        block.add(maker.make(index))
        return True
    except Exception as error:
        why = f"{type(error).__name__}: {error}"
        if isinstance(error, OSError) and error.errno in FULL:
            raise failed(maker.job, index, why, kind=DiskFull) from error
        block.fail(index, why)
        return False


@contextmanager
def serial() -> Iterator[None]:
    """Sums over faces (normals) and samples (a film) take the order of threads into their last bit: no threads."""
    import drjit as dr

    threads = dr.thread_count()
    dr.set_thread_count(0)
    try:
        yield
    finally:
        dr.set_thread_count(threads)


def failed(job: Job, index: int, why: str, more: int = 0, kind: type[SampleFailed] = SampleFailed) -> SampleFailed:
    values = ", ".join(f"{k} = {v:.4g}" if isinstance(v, float) else f"{k} = {v}" for k, v in job.values(index).items())
    return kind(
        f"sample {index} ({values or 'nothing sampled'}): {why}"
        + (f" (and {more} samples more)" if more else "")
        + "; what was made is kept, the same command goes on"
    )
