"""A finished batch as a data set that learning libraries read: WebDataset, HDF5, zarr, LeRobot, each with a data card.

The EXR files of the batch stay the master; an export is made from them and can be made again. It holds, per sample,

    values     what was fixed and drawn, by key, and the labels of the record: numbers and words
    arrays     images "camera": the camera's digital numbers as its files hold them, `camera` (free of noise) and
               `camera_noisy`, uint8 for a camera of 8 bits and uint16 (of 12 bits: 0 to 4095) beyond
               images "float": what the EXR holds, float32: radiance (H, W, bands), or stokes (H, W, bands, 4), preview,
               depth, normal, contact, led_1 ..., by the names of optics.light.rendering
               files .npy of the record by their own names, and .npz as `nodes.` and the names in them, with either

It is written in files of `per_file` samples, each whole or not at all; an interrupted export goes on with the first
that is missing."""

from __future__ import annotations

import io
import json
import math
import tarfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from pydantic import BaseModel, Field, RootModel, ValidationError, model_validator

from optics.errors import OutputExists, UnknownKey
from optics.files import exr
from optics.files.archives import opened
from optics.files.images import read_array
from optics.files.output import check_folder, file_hash, replacing, write_json, write_text
from optics.light import labels as labelling
from optics.study.blocks import sample_record
from optics.study.engines import library

NODES = "nodes."  # before the names of what is per node: pixels have such names as well
PLANES = {  # of what every EXR or camera file holds
    "camera": ("DN", "the camera's numbers without noise"),
    "camera_noisy": ("DN", "the camera's numbers"),
    "preview": ("full scale", "R, G, B of the camera without noise, linear"),
    "radiance": ("W mm^-2 sr^-1", "per band, for LED powers in W/sr"),
    "stokes": ("W mm^-2 sr^-1", "S0 to S3 per band"),
    "depth": ("mm", "from the camera along its axis; infinite where a ray meets nothing"),
    "normal": ("", "of the surface in the scene's frame"),
    "contact": ("", "1 where the indenter touches what is seen"),
}
PER_FILE = 1000
CHUNK = 4_000_000  # bytes of a zarr chunk: few files, and one sample is still read fast
IMAGES = ("camera", "float")
Progress = Callable[[str, int, int], None]


@dataclass
class Item:
    """One sample. arrays: name -> array; files: name -> the PNG file that holds the same 8-bit image."""

    index: int
    values: dict[str, float | str]
    arrays: dict[str, np.ndarray]
    files: dict[str, Path] = field(default_factory=dict)


# -- reading a batch -------------------------------------------------------------------------------------------------
class Batch:
    """A finished batch's folder. Raises FileNotFoundError where it is none, or not finished."""

    def __init__(self, folder: Path):
        self.folder = Path(folder)
        self.manifest = self.folder / "manifest.jsonl"
        if not (self.folder / "job.json").is_file():
            raise FileNotFoundError(
                f"{folder}: no batch: job.json is missing; name the folder that `optics batch` made"
            )
        if not self.manifest.is_file():
            raise FileNotFoundError(f"{folder}: the batch is not finished; run `optics batch` again, then export it")
        self.made = _table(self.folder / "job.json", _Made)
        units = self.folder / "parameters.json"
        self.parameters = _table(units, _Described) if units.is_file() else {}
        self.job: dict[str, Any] = self.made["job"]
        noise = self.made.get("noise") or self.job["noise"]
        self.saturation = 255.0 if noise is None else noise["saturation"]
        grids = [len(d["grid"]) for d in self.job["sample"].values() if d.get("grid")]
        asked = math.prod(grids) * (self.job["count"] or 1)
        with open(self.manifest, "rb") as lines:
            self.starts = np.cumsum([0, *map(len, lines)])[:-1]  # bytes before each record
        self.total = len(self.starts)
        if self.total != asked:
            raise ValueError(f"{self.manifest}: {self.total} records of {asked} samples; {AGAIN}")
        self.roles = list(next(self.records())["files"])

    def bands(self) -> list[float]:
        """nm, of the last axis of `radiance`, or the last but one of `stokes`."""
        files = next(self.records())["files"]
        file = next(entry["file"] for role, entry in files.items() if role.endswith("exr"))
        channels, _ = exr.read(self.folder / file)
        spectral = {name: image for name, image in channels.items() if exr.SPECTRAL_NAME.fullmatch(name)}
        return [float(band) for band in exr.spectral_image(spectral)[0]]

    def records(self, first: int = 0) -> Iterator[dict]:
        with open(self.manifest, "rb") as lines:
            lines.seek(self.starts[first])
            for index, line in enumerate(lines, first):
                record = sample_record(_loaded(line))
                if record is None or record["index"] != index:
                    raise ValueError(f"{self.manifest}: line {index + 1}: no record of sample {index}; {AGAIN}")
                yield record

    def item(self, record: Mapping, images: str, only: Sequence[str]) -> Item:
        """A sample's values and arrays; only: names of arrays, none for all. Raises ValueError for a damaged file."""
        item = Item(record["index"], self.values(record), {})
        for role, entry in record["files"].items():
            file = self.folder / entry["file"]
            light, _, kind = role.rpartition(".")
            prefix = f"{light}." if light else ""
            if kind == "png" and self.saturation > 255:
                continue  # a preview of 8 bits, and not the DN of this camera
            if _is_read(file, images):
                _as_recorded(file, entry)
            for name, values in _arrays(file, kind, images).items():
                item.arrays[prefix + name] = values
                if values.dtype == np.uint8 and file.suffix == ".png":
                    item.files[prefix + name] = file
        if only:
            for name in only:
                if name not in item.arrays:
                    raise UnknownKey(name, item.arrays, "array", str(self.folder), f"(images '{images}')")
            item.arrays = {name: item.arrays[name] for name in only}
        if not item.arrays:
            raise ValueError(
                f"{self.folder}: no array for images = '{images}'; its files are {', '.join(self.roles)}; allowed: "
                "'camera' of batches with the outputs png or dn, 'float' of those with exr"
            )
        return item

    def values(self, record: Mapping) -> dict[str, float | str]:
        """Numbers and words of a sample, by key; NaN for a number that there is none of: a marker outside the image."""
        own = {key: record[key] for key in sorted(record.keys() - {"index", "sample", "files"})}
        told = labelling.flat({**self.job["parameters"], **record["sample"], **own})
        return {
            name: math.nan if value is None else value if isinstance(value, str) else float(value)  # type: ignore[arg-type]
            for name, value in told.items()
        }


AGAIN = "run `optics batch` again, which makes what is missing or damaged, then export it"


def _is_read(file: Path, images: str) -> bool:
    """Whether an export of `images` takes anything from a file; labels always."""
    return {".png": images == "camera", ".exr": images == "float"}.get(file.suffix, True)


def _as_recorded(file: Path, entry: Mapping) -> None:
    """Raises ValueError for a file that is not the one of its sample: one of another would have wrong labels."""
    if not file.is_file():
        raise ValueError(f"{file}: no such file; {AGAIN}")
    if file.stat().st_size != entry["size"] or file_hash(file) != entry["hash"]:
        raise ValueError(
            f"{file}: not the file that was recorded when its sample was made; allowed: the same content; "
            "run `optics batch --check-files` again, which makes it anew, then export it"
        )


def _loaded(text: str | bytes) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


class _Noise(BaseModel):
    saturation: float = Field(gt=0)


class _Drawn(BaseModel):
    grid: list[float | str] | None = None


class _Job(BaseModel):
    seed: int
    count: int | None = Field(ge=1)
    parameters: dict[str, float | str]
    sample: dict[str, _Drawn]
    unit: dict[str, _Drawn] = {}
    noise: _Noise | None


class _Scene(BaseModel):
    name: str
    hash: str
    defines: dict[str, Any]


class _Made(BaseModel):
    """What the card says of job.json."""

    job: _Job
    scene: _Scene
    plugins: dict[str, Any]
    versions: dict[str, str]
    noise: _Noise | None = None
    grids: list[str] = []

    @model_validator(mode="after")
    def _known(self) -> _Made:
        if "optics" not in self.versions or any(not (d := self.job.sample.get(k)) or not d.grid for k in self.grids):
            raise ValueError("versions or grids are not those of a batch")
        return self


class _Described(RootModel[dict[str, dict[str, str]]]):
    """parameters.json: key -> unit, doc."""


def _table(file: Path, form: type[BaseModel]) -> dict[str, Any]:
    found = _loaded(file.read_bytes())
    try:
        form.model_validate(found, strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "all of it"
        raise ValueError(f"{file}: {where}: {first['msg']}; restore it, or {AGAIN}") from error
    return found


def _arrays(file: Path, kind: str, images: str) -> dict[str, np.ndarray]:
    """What one file of a sample gives, name -> array."""
    if file.suffix == ".npz":
        with opened(file) as arrays:
            return {NODES + name: arrays[name] for name in arrays.files}
    if file.suffix == ".npy":
        return {kind: np.load(file, allow_pickle=False)}
    if file.suffix == ".png":
        return {{"png": "camera", "dn": "camera_noisy"}[kind]: _image(file)} if images == "camera" else {}
    return _layers(file) if images == "float" else {}


def _image(file: Path) -> np.ndarray:
    image = read_array(file, str(file))
    return image[..., None] if image.ndim == 2 else image


def _layers(file: Path) -> dict[str, np.ndarray]:
    """The channels of an EXR in groups: (H, W), (H, W, C); radiance (H, W, bands), stokes (H, W, bands, 4)."""
    channels, _ = exr.read(file)
    groups: dict[str, list[str]] = {}
    spectral = {n for n in channels if exr.SPECTRAL_NAME.fullmatch(n)}
    for name in channels:
        if name not in spectral:
            group = name.rpartition(".")[0] if "." in name else "preview"
            groups.setdefault(group, []).append(name)
    found = {}
    if spectral:
        _, vectors = exr.spectral_image({n: channels[n] for n in spectral})
        found["radiance" if vectors.shape[3] == 1 else "stokes"] = vectors[..., 0] if vectors.shape[3] == 1 else vectors
    order = {c: i for i, c in enumerate("RGBXYZ")}  # EXR sorts by name: B before G before R
    for group, names in groups.items():
        names.sort(key=lambda n: (order.get(n.rpartition(".")[2], 9), n))
        stack = [channels[n] for n in names]
        found[group] = stack[0] if len(stack) == 1 else np.stack(stack, -1)
    return {name: np.asarray(a, np.float32) for name, a in found.items()}


# -- statistics ------------------------------------------------------------------------------------------------------
class Moments:
    """Count, extremes, mean and standard deviation of numbers that come in parts; of arrays per last axis."""

    def __init__(self) -> None:
        self.of: dict[str, dict[str, Any]] = {}

    def add(self, name: str, values: Any) -> None:
        if isinstance(values, str):
            own = self.of.setdefault(name, {"words": {}})
            own["words"][values] = own["words"].get(values, 0) + 1
            return
        rows = np.atleast_1d(np.asarray(values, float))
        rows = rows.reshape(-1, rows.shape[-1]) if rows.ndim > 2 else rows.reshape(-1, 1)
        rows = rows[np.isfinite(rows).all(axis=1)]  # depth is infinite where a ray met nothing
        self._merge(
            name,
            {
                "count": len(rows),
                "min": rows.min(0, initial=np.inf).tolist(),
                "max": rows.max(0, initial=-np.inf).tolist(),
                "sum": rows.sum(0).tolist(),
                "squares": (rows**2).sum(0).tolist(),
            },
        )

    def merge(self, other: Mapping[str, Mapping]) -> None:
        for name, own in other.items():
            if "words" in own:
                words = self.of.setdefault(name, {"words": {}})["words"]
                for word, count in own["words"].items():
                    words[word] = words.get(word, 0) + count
            else:
                self._merge(name, own)

    def _merge(self, name: str, new: Mapping) -> None:
        old = self.of.get(name)
        if old is None:
            self.of[name] = dict(new)
            return
        self.of[name] = {
            "count": old["count"] + new["count"],
            "min": np.minimum(old["min"], new["min"]).tolist(),
            "max": np.maximum(old["max"], new["max"]).tolist(),
            "sum": np.add(old["sum"], new["sum"]).tolist(),
            "squares": np.add(old["squares"], new["squares"]).tolist(),
        }

    def summary(self, name: str) -> dict[str, Any]:
        own = self.of[name]
        if "words" in own:
            return own
        count = own["count"]
        if not count:
            none = [None] * len(own["sum"])
            return {"min": none, "max": none, "mean": none, "std": none, "count": 0}
        mean = np.divide(own["sum"], count)
        variance = np.maximum(np.divide(own["squares"], count) - mean**2, 0.0)
        return {
            "min": own["min"],
            "max": own["max"],
            "mean": mean.tolist(),
            "std": np.sqrt(variance).tolist(),
            "count": own["count"],
        }


# -- formats ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Plan:
    """batch, its first item, total samples, those of a file, those of an episode."""

    batch: Batch
    first: Item
    total: int
    per_file: int
    episode: int

    def name(self, number: int, suffix: str) -> str:
        return f"samples-{number:06d}{suffix}"


class Format(Protocol):
    """write: number of a file -> its samples; finish: what the whole needs; pattern: names the files to a reader.

    Making one refuses what the format cannot hold, and writes nothing."""

    pattern: str

    def __init__(self, folder: Path, plan: Plan): ...
    def write(self, number: int, items: Sequence[Item] | Iterator[Item]) -> None: ...
    def finish(self, moments: Moments) -> None: ...


class WebDataset:
    """Tar files; a sample is 000123.json and an entry per array: .png for 8 bits, .npy otherwise."""

    def __init__(self, folder: Path, plan: Plan):
        self.folder, self.plan = folder, plan
        last = -(-plan.total // plan.per_file) - 1
        self.pattern = f"samples-{{{0:06d}..{last:06d}}}.tar" if last else plan.name(0, ".tar")

    def write(self, number: int, items: Sequence[Item] | Iterator[Item]) -> None:
        with replacing(self.folder / self.plan.name(number, ".tar")) as file, tarfile.open(file, "w") as tar:
            for item in items:
                key = f"{item.index:08d}"
                values = {k: None if v != v else v for k, v in item.values.items()}  # JSON has no NaN
                self._add(tar, f"{key}.json", json.dumps({"index": item.index, **values}).encode())
                for name, array in item.arrays.items():
                    stem = name.replace(".", "_")  # what follows the first dot is the name of the entry
                    if name in item.files:
                        self._add(tar, f"{key}.{stem}.png", item.files[name].read_bytes())
                    else:
                        memory = io.BytesIO()
                        np.save(memory, array)
                        self._add(tar, f"{key}.{stem}.npy", memory.getvalue())

    @staticmethod
    def _add(tar: tarfile.TarFile, name: str, data: bytes) -> None:
        entry = tarfile.TarInfo(name)
        entry.size = len(data)
        tar.addfile(entry, io.BytesIO(data))

    def finish(self, moments: Moments) -> None:
        pass


class Sink(io.FileIO):
    """A file for the HDF5 library, which ends the process where the system takes no more, as on a full disk: the first
    error is kept, what comes later is dropped, and the error is raised once the library is done."""

    def __init__(self, path: Path):
        super().__init__(path, "w+")
        self.failed: OSError | None = None

    def write(self, data: Any) -> int:
        left = memoryview(data).cast("B")
        while left and self.failed is None:
            try:
                left = left[super().write(left) :]
            except OSError as error:
                self.failed = error
        return memoryview(data).nbytes

    def truncate(self, size: int | None = None) -> int:
        if self.failed is None:
            try:
                return super().truncate(size)
            except OSError as error:
                self.failed = error
        return size or 0

    def __exit__(self, *raised: Any) -> None:
        super().__exit__(*raised)
        if self.failed is not None:
            raise self.failed


class Hdf5:
    """Files with a dataset per array, (N, ...), compressed, a chunk per sample, and `values/KEY`, (N,)."""

    def __init__(self, folder: Path, plan: Plan):
        self.h5py = library("h5py", "--to hdf5", "data")
        self.folder, self.plan, self.pattern = folder, plan, "samples-*.h5"

    def write(self, number: int, items: Sequence[Item] | Iterator[Item]) -> None:
        count = min(self.plan.per_file, self.plan.total - number * self.plan.per_file)
        with (
            replacing(self.folder / self.plan.name(number, ".h5")) as path,
            Sink(path) as sink,
            self.h5py.File(sink, "w") as file,
        ):
            index = file.create_dataset("index", (count,), "i8")
            for name, values in self.plan.first.arrays.items():
                file.create_dataset(
                    name, (count, *values.shape), values.dtype, chunks=(1, *values.shape), compression="gzip"
                )
            for key, value in self.plan.first.values.items():
                kind = self.h5py.string_dtype() if isinstance(value, str) else "f8"
                file.create_dataset(f"values/{key}", (count,), kind).attrs["unit"] = unit_of(self.plan.batch, key)
            for row, item in enumerate(items):
                if sink.failed:
                    break
                index[row] = item.index
                for name, values in item.arrays.items():
                    file[name][row] = values
                for key, value in item.values.items():
                    file[f"values/{key}"][row] = value

    def finish(self, moments: Moments) -> None:
        pass


class Zarr:
    """One group: an array (N, ...) per name in chunks of whole samples, and `values/KEY`, (N,); words are numbers of
    the list `words` in the array's attributes."""

    def __init__(self, folder: Path, plan: Plan):
        self.zarr = library("zarr", "--to zarr", "data")
        self.plan, self.pattern, self.root = plan, "samples.zarr", folder / "samples.zarr"
        self.words = self._words()

    @cached_property
    def targets(self) -> dict[str, Any]:
        """Name -> zarr array of all that is stored."""
        first = self.plan.first
        group = self.zarr.open_group(str(self.root), mode="a")
        group.attrs["samples"] = self.plan.total
        arrays = {name: self._open(name, values.shape, values.dtype) for name, values in first.arrays.items()}
        numbers = {key: self._open(f"values/{key}", (), "f8") for key in first.values}
        for key, array in numbers.items():
            array.attrs["unit"] = unit_of(self.plan.batch, key)
            if key in self.words:
                array.attrs["words"] = self.words[key]
        return {**arrays, **numbers, "index": self._open("index", (), "i8")}

    def _words(self) -> dict[str, list[str]]:
        words = {key: {str(v)} for key, v in self.plan.first.values.items() if isinstance(v, str)}
        for record in self.plan.batch.records() if words else ():
            for key, value in self.plan.batch.values(record).items():
                if key in words:
                    words[key].add(str(value))
        return {key: sorted(found) for key, found in words.items()}

    def _rows(self, shape: tuple[int, ...], dtype: Any) -> int:
        """Samples of a chunk: a few MB, and a whole number of chunks in what is written at once."""
        size = np.dtype(dtype).itemsize * math.prod(shape)
        most, whole = max(1, CHUNK // size), self.plan.per_file
        return max(rows for rows in range(1, whole + 1) if whole % rows == 0 and (rows <= most or rows == 1))

    def _open(self, name: str, shape: tuple[int, ...], dtype: Any) -> Any:
        return self.zarr.open_array(
            str(self.root / name),
            mode="a",
            shape=(self.plan.total, *shape),
            chunks=(self._rows(shape, dtype), *shape),
            dtype=dtype,
        )

    def write(self, number: int, items: Sequence[Item] | Iterator[Item]) -> None:
        first = number * self.plan.per_file
        targets = self.targets
        waiting: dict[str, list] = {name: [] for name in targets}
        stored = dict.fromkeys(waiting, first)

        def store(name: str) -> None:
            place, rows = stored[name], waiting[name]
            if rows:
                targets[name][place : place + len(rows)] = np.stack(rows)
            stored[name], waiting[name] = place + len(rows), []

        for item in items:
            values = {k: self.words[k].index(v) if isinstance(v, str) else v for k, v in item.values.items()}
            for name, value in {**item.arrays, **values, "index": item.index}.items():
                waiting[name].append(value)
                if len(waiting[name]) == targets[name].chunks[0]:
                    store(name)
        for name in waiting:
            store(name)

    def finish(self, moments: Moments) -> None:
        pass


class LeRobot:
    """LeRobotDataset v3.0: an 8-bit array is an image `observation.images.NAME`, other arrays are
    `observation.NAME`, numbers are `observation.state`, words are `observation.KEY`. An episode is a run of the last
    grid of the job (a press in steps), or one sample."""

    FPS = 10  # of time stamps: a batch has no clock

    def __init__(self, folder: Path, plan: Plan):
        self.pa, self.pq = (library(m, "--to lerobot", "data") for m in ("pyarrow", "pyarrow.parquet"))
        self.folder, self.plan, self.pattern = folder, plan, "data/chunk-*/file-*.parquet"
        for name, values in plan.first.arrays.items():
            if values.dtype == np.uint16:
                raise ValueError(
                    f"--to lerobot: {name} has 16 bits, and images of LeRobot have 8; allowed: --images float, or "
                    "webdataset, hdf5, zarr"
                )
        self.numbers = [k for k, v in plan.first.values.items() if not isinstance(v, str)]
        self.words = [k for k, v in plan.first.values.items() if isinstance(v, str)]
        self.task = f"samples of {plan.batch.made['scene']['name']}"

    def features(self) -> dict[str, dict[str, Any]]:
        found: dict[str, dict[str, Any]] = {}
        for name, values in self.plan.first.arrays.items():
            if values.dtype == np.uint8:
                names: list[str] | None = ["height", "width", "channels"]
                found[f"observation.images.{name}"] = {"dtype": "image", "shape": list(values.shape), "names": names}
            else:
                found[f"observation.{name}"] = {"dtype": str(values.dtype), "shape": list(values.shape), "names": None}
        if self.numbers:
            found["observation.state"] = {
                "dtype": "float32",
                "shape": [len(self.numbers)],
                "names": self.numbers,
            }
        for key in self.words:
            found[f"observation.{key}"] = {"dtype": "string", "shape": [1], "names": None}
        found["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
        for name in ("frame_index", "episode_index", "index", "task_index"):
            found[name] = {"dtype": "int64", "shape": [1], "names": None}
        return found

    def write(self, number: int, items: Sequence[Item] | Iterator[Item]) -> None:
        pa, length = self.pa, self.plan.episode
        columns: dict[str, list] = {name: [] for name in self.features()}
        first = number * self.plan.per_file
        for place, item in enumerate(items, first):
            for name, values in item.arrays.items():
                if values.dtype == np.uint8:
                    columns[f"observation.images.{name}"].append({"bytes": _png(item, name), "path": f"{place}.png"})
                else:
                    columns[f"observation.{name}"].append(self._cell(values.tolist()))
            if self.numbers:
                columns["observation.state"].append(self._cell([item.values[k] for k in self.numbers]))
            for key in self.words:
                columns[f"observation.{key}"].append(item.values[key])
            columns["timestamp"].append(place % length / self.FPS)
            columns["frame_index"].append(place % length)
            columns["episode_index"].append(place // length)
            columns["index"].append(place)
            columns["task_index"].append(0)
        types = {name: self._type(feature) for name, feature in self.features().items()}
        table = pa.table({name: pa.array(columns[name], types[name]) for name in columns})
        path = self.folder / f"data/chunk-{number // 1000:03d}/file-{number % 1000:03d}.parquet"
        with replacing(path) as file:
            self.pq.write_table(table, file, compression="zstd")

    @staticmethod
    def _cell(values: list) -> Any:
        """What stands in a table: LeRobot reads a feature of the shape (1,) as a number and not as a list."""
        return values[0] if len(values) == 1 and not isinstance(values[0], list) else values

    def _type(self, feature: Mapping) -> Any:
        pa = self.pa
        if feature["dtype"] == "image":
            return pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        kind = pa.type_for_alias(feature["dtype"])
        shape = feature["shape"]
        if shape == [1]:
            return kind
        if len(shape) == 1:
            return pa.list_(kind, shape[0])
        for _ in shape:
            kind = pa.list_(kind)
        return kind

    def finish(self, moments: Moments) -> None:
        pa, plan = self.pa, self.plan
        episodes = -(-plan.total // plan.episode)
        bounds = [(e * plan.episode, min(plan.total, (e + 1) * plan.episode)) for e in range(episodes)]
        files = [a // plan.per_file for a, _ in bounds]
        meta = self.folder / "meta"
        table = pa.table(
            {
                "episode_index": list(range(episodes)),
                "tasks": [[self.task]] * episodes,
                "length": [b - a for a, b in bounds],
                "data/chunk_index": [f // 1000 for f in files],
                "data/file_index": [f % 1000 for f in files],
                "dataset_from_index": [a for a, _ in bounds],
                "dataset_to_index": [b for _, b in bounds],
                "meta/episodes/chunk_index": [0] * episodes,
                "meta/episodes/file_index": [0] * episodes,
            }
        )
        with replacing(meta / "episodes/chunk-000/file-000.parquet") as file:
            self.pq.write_table(table, file)
        tasks = pa.table({"task_index": [0], "__index_level_0__": [self.task]})
        column = {"name": None, "field_name": "__index_level_0__", "pandas_type": "unicode", "numpy_type": "object"}
        pandas = {"index_columns": ["__index_level_0__"], "columns": [column], "column_indexes": []}
        with replacing(meta / "tasks.parquet") as file:
            self.pq.write_table(tasks.replace_schema_metadata({"pandas": json.dumps(pandas)}), file)
        features = self.features()
        write_json(
            meta / "info.json",
            {
                "codebase_version": "v3.0",
                "robot_type": None,
                "total_episodes": episodes,
                "total_frames": plan.total,
                "total_tasks": 1,
                "chunks_size": 1000,
                "data_files_size_in_mb": 100,
                "video_files_size_in_mb": 200,
                "fps": self.FPS,
                "splits": {"train": f"0:{episodes}"},
                "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
                "video_path": None,
                "features": features,
            },
        )
        write_json(meta / "stats.json", self._stats(moments, features))

    def _stats(self, moments: Moments, features: Mapping) -> dict[str, Any]:
        """As LeRobot has them: of images per channel, in shares of 255, (C, 1, 1); of the state per number."""
        found = {}
        kinds = ("min", "max", "mean", "std")
        for name, values in self.plan.first.arrays.items():
            own = moments.summary(f"arrays/{name}")
            if values.dtype == np.uint8:
                shares = {k: [[[v / 255.0]] for v in own[k]] for k in kinds}
                found[f"observation.images.{name}"] = {**shares, "count": [self.plan.total]}
        if self.numbers:
            rows = [moments.summary(f"values/{key}") for key in self.numbers]
            state = {k: np.array([row[k][0] for row in rows], float).tolist() for k in kinds}  # None: NaN
            found["observation.state"] = {**state, "count": [self.plan.total]}
        return found


def _png(item: Item, name: str) -> bytes:
    return item.files[name].read_bytes()


FORMATS: dict[str, type[Format]] = {"webdataset": WebDataset, "hdf5": Hdf5, "zarr": Zarr, "lerobot": LeRobot}


def unit_of(batch: Batch, key: str) -> str:
    return described(batch, key).get("unit", "")


def described(batch: Batch, key: str) -> dict[str, str]:
    """Unit and meaning of a value; of a number in a list (labels.force.0), those of the list."""
    while key not in batch.parameters and "." in key:
        key = key.rpartition(".")[0]
    return dict(batch.parameters.get(key, {}))


def array_described(name: str) -> tuple[str, str]:
    """Unit and meaning of an array; of one LED's image, those of the image."""
    if name.startswith(NODES):
        return labelling.ARRAYS.get(name.removeprefix(NODES), ("", ""))
    return {**PLANES, **labelling.CHANNELS}.get(name.rpartition(".")[2], ("", ""))


# -- the export ------------------------------------------------------------------------------------------------------
def export(
    batch: str | Path,
    folder: str | Path,
    to: str,
    *,
    images: str = "camera",
    arrays: Sequence[str] = (),
    per_file: int = PER_FILE,
    licence: str = "",
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write a finished batch into `folder` in a format; returns what the data card says.

    to        one of FORMATS
    images    "camera" or "float"; see this module
    arrays    names of arrays to take; none: all
    per_file  samples of a file; LeRobot: rounded up to whole episodes
    licence   of the data, as the card states it

    It may be stopped and called again. Raises UnknownKey, ValueError, FileNotFoundError for a batch that is not
    finished, OutputExists where the folder holds something else, ModuleNotFoundError where a library is missing.
    """
    if to not in FORMATS:
        raise UnknownKey(to, FORMATS, "format", "--to")
    if images not in IMAGES:
        raise UnknownKey(images, IMAGES, "kind of images", "--images")
    if per_file < 1:
        raise ValueError(f"per_file = {per_file}; allowed: whole numbers from 1 on")
    source, folder = Batch(Path(batch)), Path(folder)
    episode = _episode(source) if to == "lerobot" else 1
    per_file = -(-per_file // episode) * episode
    first = source.item(next(source.records()), images, arrays)
    plan = Plan(source, first, source.total, per_file, episode)
    identity = {
        "batch": file_hash(source.manifest),
        "to": to,
        "images": images,
        "arrays": sorted(first.arrays),
        "per_file": per_file,
    }
    card = folder / "card.json"
    state = folder / ".export"
    if _already(folder, state, card, identity):
        made = json.loads(card.read_text(encoding="utf-8"))
        if licence and licence != made["licence"]:
            made["licence"] = licence
            write_text(folder / "card.md", _page(made))
            write_json(card, made)
        return made
    writer = FORMATS[to](folder, plan)
    write_json(state / "export.json", identity)
    moments = Moments()
    count = -(-source.total // per_file)
    for number in range(count):
        note = state / f"{number:06d}.json"
        if not note.is_file():
            own = Moments()
            try:
                writer.write(number, _counted(plan, number, images, arrays, own, progress))
            except OSError as error:
                if error.filename is None and error.errno is not None:  # the libraries' own do not say where
                    raise OSError(
                        error.errno, f"{error.strerror}; what is whole is kept, the same command goes on", str(folder)
                    ) from error
                raise
            write_json(note, own.of)
        moments.merge(json.loads(note.read_text(encoding="utf-8")))
    writer.finish(moments)
    made = _card(plan, identity, moments, writer.pattern, licence)
    write_text(folder / "card.md", _page(made))
    write_json(card, made)
    for note in state.iterdir():
        note.unlink()
    state.rmdir()
    return made


def _already(folder: Path, state: Path, card: Path, identity: Mapping) -> bool:
    """Whether the same export stands complete. Raises OutputExists for another one."""
    note = state / "export.json"
    if card.is_file() or note.is_file():
        before = json.loads((card if card.is_file() else note).read_text(encoding="utf-8"))
        before = before["export"] if card.is_file() else before
        changed = [key for key in identity if before.get(key) != identity[key]]
        if changed:
            raise OutputExists(f"{folder} holds another export: changed {', '.join(changed)}; choose another folder")
        return card.is_file()
    check_folder(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputExists(f"{folder} exists and holds no export; choose another folder")
    return False


def _counted(
    plan: Plan, number: int, images: str, arrays: Sequence[str], moments: Moments, progress: Progress | None
) -> Iterator[Item]:
    """The items of one file, whose numbers go into the moments."""
    first = number * plan.per_file
    for place, record in enumerate(plan.batch.records(first), first):
        if place == first + plan.per_file:
            return
        item = plan.batch.item(record, images, arrays)
        for name, values in item.arrays.items():
            expected = plan.first.arrays.get(name)
            if expected is None or expected.shape != values.shape or expected.dtype != values.dtype:
                raise ValueError(
                    f"{plan.batch.folder}: sample {item.index}: {name} is {values.dtype} {values.shape}, not as in the "
                    "first sample; allowed: arrays of one shape; leave it out by naming the others with --array"
                )
            moments.add(f"arrays/{name}", values)
        kinds, usual = ({k: type(v) for k, v in values.items()} for values in (item.values, plan.first.values))
        if unlike := sorted(k for k in kinds.keys() | usual.keys() if kinds.get(k) is not usual.get(k)):
            raise ValueError(
                f"{plan.batch.folder}: sample {item.index}: the value {unlike[0]} is missing, new, or of another kind "
                "than in the first sample; allowed: the same numbers and words in each; make two batches of them"
            )
        for key, value in item.values.items():
            moments.add(f"values/{key}", value)
        yield item
        if progress:
            progress("export", place + 1, plan.total)


def _episode(batch: Batch) -> int:
    """Samples of an episode: a run through the job's last grid."""
    drawn = batch.job["sample"]
    grids = batch.made.get("grids") or [key for key, d in drawn.items() if d.get("grid")]
    return len(drawn[grids[-1]]["grid"]) if grids and (batch.job["count"] or 1) == 1 else 1


# -- the card --------------------------------------------------------------------------------------------------------
def _card(plan: Plan, identity: Mapping, moments: Moments, pattern: str, licence: str) -> dict[str, Any]:
    made, job = plan.batch.made, plan.batch.job
    named = {**job["sample"], **job.get("unit", {})}
    jointly = [f"the effect {name}" for name in named if "." not in name]  # which stands for its parameters
    jointly += ["the posterior of the calibration"] * bool(job.get("posterior"))
    sampled = next(plan.batch.records())["sample"]
    values = {}
    for key in plan.first.values:
        drawn = named.get(key) or ({"with": " or ".join(jointly)} if key in sampled and jointly else None)
        values[key] = {
            **described(plan.batch, key),
            "drawn": {k: v for k, v in drawn.items() if v is not None} if drawn else None,
            **moments.summary(f"values/{key}"),
        }
    return {
        "export": dict(identity),
        "files": pattern,
        "samples": plan.total,
        "licence": licence or "not stated",
        "seed": job["seed"],
        "scene": made["scene"],
        "calibrated": made.get("fit"),
        "plugins": made["plugins"],
        "versions": made["versions"],
        "job": job,
        "arrays": {
            name: {
                "shape": list(a.shape),
                "dtype": str(a.dtype),
                **dict(zip(("unit", "doc"), array_described(name))),
                **moments.summary(f"arrays/{name}"),
            }
            for name, a in plan.first.arrays.items()
        },
        **({"bands_nm": plan.batch.bands()} if plan.first.arrays.keys() & {"radiance", "stokes"} else {}),
        "values": values,
    }


def _page(card: Mapping) -> str:
    """The card as Markdown."""

    def span(own: Mapping) -> str:
        if "words" in own:
            return ", ".join(f"{word} ({count})" for word, count in sorted(own["words"].items()))
        if not own["count"]:
            return "no number"
        low, high = min(own["min"]), max(own["max"])
        return f"{low:.6g} to {high:.6g}, mean {float(np.mean(own['mean'])):.6g}"

    def drawn(own: Mapping) -> str:
        return ", ".join(f"{k} {v}" for k, v in own["drawn"].items()) if own["drawn"] else "fixed, or a label"

    lines = [
        f"# Data card: {card['samples']:,} samples of {card['scene']['name']}",
        "",
        "Images of a camera-based touch sensor, rendered by physical optics (tactile-optics "
        f"{card['versions']['optics']}); no photograph is among them.",
        "",
        f"- format: {card['export']['to']}, files `{card['files']}`, images: {card['export']['images']}",
        f"- licence: {card['licence']}",
        f"- seed: {card['seed']}; a sample depends on seed and index alone",
        f"- scene: {card['scene']['name']}, {card['scene']['hash']}"
        + ("; values of a calibrated sensor" if card["calibrated"] else ""),
        "- definitions: " + (", ".join(f"{k} = {v}" for k, v in card["scene"]["defines"].items()) or "none"),
        "- versions: " + ", ".join(f"{k} {v}" for k, v in sorted(card["versions"].items())),
        f"- batch: manifest {card['export']['batch']}",
        "",
        "## Arrays",
        "",
        "| name | unit | shape | type | range | meaning |",
        "|---|---|---|---|---|---|",
        *(
            f"| {n} | {a.get('unit', '')} | {a['shape']} | {a['dtype']} | {span(a)} | {a.get('doc', '')} |"
            for n, a in card["arrays"].items()
        ),
        *(["", f"Bands: {', '.join(f'{b:g}' for b in card['bands_nm'])} nm."] if "bands_nm" in card else []),
        "",
        "## Values",
        "",
        "| key | unit | drawn from | found | meaning |",
        "|---|---|---|---|---|",
        *(
            f"| {k} | {v.get('unit', '')} | {drawn(v)} | {span(v)} | {v.get('doc', '').replace('|', '/')} |"
            for k, v in card["values"].items()
        ),
    ]
    return "\n".join(lines) + "\n"
