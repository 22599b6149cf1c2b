"""Capture sets: the folder with `captures.toml` through which a measurement reaches the program.

Everything a file gets wrong is refused here, before any rendering, with the file, the frame, the key, the value, its
unit, what is allowed and the next step. Images become (H, W, C) float32 in DN, row 0 on top; a row of a table of point
readings becomes a frame of 1 x 1 pixel."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from optics.captures import readings
from optics.captures.noise import DEMOSAICED, SATURATED, UNITS, Noise, step_of
from optics.errors import BadCapture, OutputExists, UnknownKey
from optics.files import toml_checks as checks
from optics.files.images import SUFFIXES, read_image, read_mask, write_image
from optics.files.output import new_folder
from optics.scene.parameter import Parameter

FILE = "captures.toml"
MARK = "# Written by optics"
KEYS = ("scene", "values_are", "flat_field", "cfa", "noise", "parameters", "frames", "table")
FRAME_KEYS = ("image", "mask", "repeats", "group", "parameters")
TABLE_KEYS = ("file", "values", "rename", "scale")
NOISE_KEYS = tuple(name for name in UNITS if name != "quantisation")  # the step is read off the images
SUNK = 5.0  # sd of the dark noise that the median of a frame may lie below the black level
CFA = ("RGGB", "BGGR", "GRBG", "GBRG")


@dataclass
class Frame:
    """One setting of the experiment: its image, what may be used of it, and what was set."""

    name: str
    image: np.ndarray  # (H, W, C) float32, DN
    mask: np.ndarray | None = None  # (H, W) bool, True = use
    group: str | None = None  # frames of one group are held out together
    parameters: dict[str, float | str] = field(default_factory=dict)  # by scene parameter key
    repeats: list[np.ndarray] = field(default_factory=list)  # same settings, same shape
    file: str = ""
    readings: dict[str, np.ndarray] = field(
        default_factory=dict
    )  # of a sweep: (N, 1, 1) settings of each reading, by key
    rows: np.ndarray | None = (
        # of a sweep: (N, 1, 1) row of the table that each reading stands in, as it was recorded; None: nowhere yet
        None
    )


@dataclass
class Table:
    """Point readings: one row per frame. `rename`: column -> parameter key; `scale`: to the parameter's unit."""

    file: str
    values: list[str]
    rename: dict[str, str] = field(default_factory=dict)
    scale: dict[str, float] = field(default_factory=dict)


@dataclass
class Captures:
    """A capture set; `bits` is 8 or 16 for integer files, None for floats."""

    folder: Path
    scene: str  # name of a shipped scene, or absolute path of an XML file
    frames: list[Frame]
    parameters: dict[str, float | str] = field(default_factory=dict)
    noise: Noise | None = None
    flat_field: np.ndarray | None = None  # (H, W, C) float32
    cfa: str | None = None  # raw mosaic: image is (H, W, 1)
    values_are: str = "DN"
    table: Table | None = None
    warnings: list[str] = field(default_factory=list)
    bits: int | None = None


# -- Loading ---------------------------------------------------------------------------------------------------------
def load(path: str | Path) -> Captures:
    """Read and check a capture set, given its folder or its `captures.toml`.

    Raises BadCapture (UnknownKey for a key that the format lacks). Settings are held against a scene by `check`.
    """
    path = Path(path)
    path = path / FILE if path.is_dir() else path
    where, folder = str(path), path.parent
    if not path.is_file():
        raise BadCapture(f"{where}: no such file; a capture set is a folder with {FILE}; give the folder or the file")
    data = checks.parse(path)
    checks.keys(data, KEYS, where)
    scene = checks.text(data, "scene", where)
    if scene is None:
        raise BadCapture(f"{where}: scene is missing; allowed: a shipped scene's name or the path of an XML file")
    if scene.lower().endswith(".xml"):
        scene = str(checks.existing(folder, scene, f"{where}: scene").resolve())
    values_are = checks.text(data, "values_are", where, ("DN", "radiance")) or "DN"
    cfa = checks.text(data, "cfa", where, CFA)
    noise = _noise(data["noise"], f"{where}: [noise]") if "noise" in data else None
    common = checks.settings(data.get("parameters", {}), f"{where}: [parameters]")
    if ("frames" in data) == ("table" in data):
        raise BadCapture(
            f"{where}: {'both [[frames]] and [table] stand' if 'frames' in data else 'zero frames'}; allowed: "
            "one [[frames]] or more, or one [table] of point readings"
        )
    captures = Captures(folder, scene, [], common, noise, None, cfa, values_are)
    if "table" in data:
        for key in ("cfa", "flat_field"):
            if key in data:
                raise BadCapture(f"{where}: {key} belongs to images, not to a [table]; remove it")
        captures.table, captures.frames = _read_table(folder, data["table"], f"{where}: [table]")
    else:
        _read_frames(captures, data["frames"], where)
        if values_are == "DN" and cfa is None and captures.frames[0].image.shape[2] == 3:
            captures.warnings.append(DEMOSAICED)
        if "flat_field" in data:
            here = f"{where}: flat_field"
            captures.flat_field, _ = read_image(
                checks.existing(folder, checks.text(data, "flat_field", where), here), here
            )
            _same_size(captures.flat_field, captures, here)
    images = [image for f in captures.frames for image in (f.image, *f.repeats)]
    if noise is not None:
        captures.noise = replace(noise, quantisation=step_of(images))
    _check_levels(captures, where)
    if noise is None and len(images) == len(captures.frames):
        captures.warnings.append(
            "neither [noise] nor repeats: nothing says how large a residual may be; give the EMVA 1288 "
            f"numbers ({', '.join(NOISE_KEYS)}) or repeated frames"
        )
    return captures


def _noise(table: object, where: str) -> Noise:
    checks.keys(table, NOISE_KEYS, where)
    missing = [f"{key} ({UNITS[key]})" for key in NOISE_KEYS if key not in table]
    if missing:
        raise BadCapture(
            f"{where}: {', '.join(missing)} missing; give all of {', '.join(NOISE_KEYS)}, or leave [noise] out "
            "to have it estimated from repeats"
        )
    numbers = {key: checks.number(table[key], key, UNITS[key], where) for key in NOISE_KEYS}
    try:
        return Noise(**numbers)
    except ValueError as error:
        raise BadCapture(f"{where}: {error}") from error


def _read_frames(captures: Captures, tables: object, where: str) -> None:
    if not isinstance(tables, list) or not tables:
        raise BadCapture(
            f"{where}: frames = {tables!r}: zero frames; allowed: one [[frames]] or more, each with an image"
        )
    specs, seen = [], {}
    for index, table in enumerate(tables):  # all texts first, then the images: a typing error costs no reading
        here = f"{where}: frame {index}"
        checks.keys(table, FRAME_KEYS, here)
        image = checks.text(table, "image", here)
        if image is None:
            raise BadCapture(f"{here}: image is missing; give the path of a {', '.join(SUFFIXES)} file")
        here += f" ('{image}')"
        files = [checks.existing(captures.folder, image, f"{here}: image")]
        files += [
            checks.existing(captures.folder, name, f"{here}: repeats") for name in checks.texts(table, "repeats", here)
        ]
        for file in files:
            if (same := file.resolve()) in seen:
                raise BadCapture(
                    f"{here}: '{file.name}' is used twice (first by frame {seen[same]}); allowed: each image "
                    "once, as it is one reading; remove one of them"
                )
            seen[same] = index
        mask = checks.text(table, "mask", here)
        mask = checks.existing(captures.folder, mask, f"{here}: mask") if mask else None
        settings = checks.settings(table.get("parameters", {}), f"{here}: parameters")
        specs.append((here, image, files, mask, checks.text(table, "group", here), settings))
    stems = [Path(image).stem for _, image, *_ in specs]
    depths = {}
    for (here, image, files, mask, group, settings), stem in zip(specs, stems):
        name = stem if stems.count(stem) == 1 else image
        for file in files:
            image_read, bits = read_image(file, f"{here}: {file.name}")
            depths.setdefault(bits, file.name)
            if file is files[0]:
                frame = Frame(name, image_read, None, group, settings, [], image)
                captures.frames.append(frame)
            else:
                frame.repeats.append(image_read)
            _same_size(image_read, captures, f"{here}: {file.name}")
        if mask is not None:
            frame.mask = read_mask(mask, frame.image.shape, f"{here}: mask '{mask.name}'")
    if len(depths) > 1:
        raise BadCapture(
            f"{where}: files of different depth ({', '.join(f'{n}: {b or 32} bit' for b, n in depths.items())}): "
            "their DN differ; write all in one depth"
        )
    captures.bits = next(iter(depths))


def _same_size(image: np.ndarray, captures: Captures, where: str) -> None:
    shape = captures.frames[0].image.shape
    if image.shape != shape:
        raise BadCapture(
            f"{where}: (H, W, C) = {image.shape} pixels; allowed: {shape}, as '{captures.frames[0].file}'; "
            "one camera, one size: split the set or crop the images"
        )
    if captures.cfa and shape[2] != 1:
        raise BadCapture(
            f"{where}: cfa = '{captures.cfa}' but the image has {shape[2]} channels; allowed: the raw mosaic (one "
            "value per pixel); remove cfa if the image is demosaiced"
        )


def _check_levels(captures: Captures, where: str) -> None:
    full = 2**captures.bits - 1 if captures.bits else math.inf
    top = captures.noise.saturation if captures.noise else full
    if top > full:
        raise BadCapture(
            f"{where}: [noise]: saturation = {top:g} DN; allowed: <= {full:g} DN, the end of {captures.bits} bit "
            "files; above it nothing would be masked"
        )
    used = [
        (f"frame {i} ('{f.file}')", f.image if f.mask is None else f.image[f.mask])
        for i, f in enumerate(captures.frames)
    ]
    for what, values in used + [("flat_field", captures.flat_field)] * (captures.flat_field is not None):
        if np.all(values >= top):
            raise BadCapture(
                f"{where}: {what}: all saturated, every value used is >= {top:g} DN; allowed: some values below; "
                "remove it or expose it shorter"
            )
    if captures.noise is not None and captures.table is None:
        least = captures.noise.black_level - SUNK * float(captures.noise.sd(captures.noise.black_level))
        for what, values in used:
            if values.size and (middle := float(np.median(values))) < least:
                raise BadCapture(
                    f"{where}: {what}: half of its values are {middle:g} DN or less, far below what it has without "
                    "light, "
                    f"black_level = {captures.noise.black_level:g} DN; allowed: {least:.4g} DN or more; correct "
                    "[noise] black_level"
                )
    if captures.noise is not None and not any(_lit(captures, f).any() for f in captures.frames):
        raise BadCapture(f"{where}: {_unusable(captures)}")


def _lit(captures: Captures, frame: Frame) -> np.ndarray:
    """(H, W, C) values that say something of the light: not masked, not saturated, above black level."""
    use = captures.noise.usable(frame.image) & (frame.image > captures.noise.black_level)
    return use if frame.mask is None else use & frame.mask[..., None]


def _unusable(captures: Captures) -> str:
    """Why not one value of a set can be used, and what to do."""
    noise, masked, bright, dark = captures.noise, 0, 0, 0
    for f in captures.frames:
        use = np.broadcast_to(True if f.mask is None else f.mask[..., None], f.image.shape)
        masked += np.sum(~use)
        bright += np.sum(use & (f.image > noise.black_level) & ~noise.usable(f.image))
        dark += np.sum(use & (f.image <= noise.black_level))
    low, high = min(f.image.min() for f in captures.frames), max(f.image.max() for f in captures.frames)
    cut = "" if noise.pedestal else " or within 3 sigma of 0 (there is no pedestal)"
    why = [
        f"{count} {what}"
        for count, what in (
            (dark, f"not above black_level = {noise.black_level:g} DN"),
            (bright, f"beside or above {SATURATED:.0%} of saturation = {noise.saturation:g} DN{cut}"),
            (masked, "masked"),
        )
        if count
    ]
    files = list(dict.fromkeys(f.file for f in captures.frames))
    return (
        f"none of the {dark + bright + masked} values of '{files[0]}'{' ...' if len(files) > 1 else ''} ({low:g} to "
        f"{high:g}) is usable: "
        f"{', '.join(why)}; allowed: raw DN (no volts, no 0 to 1) between these levels; correct [noise], the masks or "
        "the exposure"
    )


def _read_table(folder: Path, data: object, where: str) -> tuple[Table, list[Frame]]:
    checks.keys(data, TABLE_KEYS, where)
    name, values = checks.text(data, "file", where), checks.texts(data, "values", where)
    if name is None or not values:
        raise BadCapture(
            f"{where}: file = {name!r}, values = {values}; allowed: the path of a CSV file, one column or more"
        )
    rename, scale = data.get("rename", {}), data.get("scale", {})
    checks.keys(rename, (), f"{where}: rename")
    checks.keys(scale, (), f"{where}: scale")
    rename = {column: checks.text(rename, column, f"{where}: rename") for column in rename}
    scale = {key: checks.number(factor, f'"{key}"', "", f"{where}: scale") for key, factor in scale.items()}
    rows = readings.read(checks.existing(folder, name, f"{where}: file"), values, rename, scale, where)
    frames = [
        Frame(f"row {index}", np.array(reading, np.float32).reshape(1, 1, -1), parameters=settings, file=name)
        for index, (settings, reading) in enumerate(rows)
    ]
    return Table(name, values, rename, scale), frames


# -- Using -----------------------------------------------------------------------------------------------------------
def check(captures: Captures, parameters: Mapping[str, Parameter]) -> None:
    """Hold every setting against the scene's parameters by key; raises UnknownKey, OutOfBounds or ValueError."""
    path = captures.folder / FILE
    places = [(f"{path}: [parameters]", captures.parameters)]
    places += [(f"{path}: frame {i} ('{f.file or f.name}')", f.parameters) for i, f in enumerate(captures.frames)]
    for where, settings in places:
        for key, value in settings.items():
            if key not in parameters:
                raise UnknownKey(
                    key,
                    parameters,
                    "parameter",
                    where,
                    "`optics params SCENE` lists them"
                    + (
                        f'; rename = {{ "{key}" = "KEY" }} under [table] of {FILE} gives a column its key'
                        if captures.table is not None and settings is not captures.parameters
                        else ""
                    ),
                )
            parameters[key].check(value, key, where)


def subset(captures: Captures, frames: Sequence[int]) -> Captures:
    """The same set with only the frames of these indices, in this order."""
    count = len(captures.frames)
    for index in frames:
        if not 0 <= index < count:
            raise IndexError(f"frame {index}: {captures.folder} has {count} frames; allowed: 0 to {count - 1}")
    return replace(captures, frames=[captures.frames[i] for i in frames], warnings=list(captures.warnings))


def sweeps(captures: Captures, parameters: Mapping[str, Parameter], lights: Sequence[str]) -> Captures:
    """The rows of a table as a few frames of many readings, (N, 1, C), which are predicted at once.

    Readings are ordered by the setting that takes the most values and dealt out to 8 sweeps (4 of fewer than 32
    readings, 1 of fewer than 8), so that each covers the whole range. Settings that move the scene's geometry keep
    sweeps of their own."""
    settings = [f.parameters for f in captures.frames]
    keys = sorted({k for own in settings for k in own})
    powers = {f"{name}.power" for name in lights}
    still = [k for k in keys if parameters[k].how not in ("layer", "image") and k not in powers]
    found: dict[tuple, list[int]] = {}
    for index, own in enumerate(settings):
        found.setdefault((tuple(sorted(own)), *(own.get(k) for k in still)), []).append(index)
    frames = []
    for rows in found.values():
        own = settings[rows[0]]
        moving = [k for k in own if k not in still and len({settings[i][k] for i in rows}) > 1]
        if moving:
            first = max(moving, key=lambda k: (parameters[k].unit == "deg", len({settings[i][k] for i in rows})))
            rows = sorted(rows, key=lambda i: settings[i][first])
        count = 8 if len(rows) >= 32 else 4 if len(rows) >= 8 else 1
        for part in range(count):
            mine = rows[part::count]
            readings = {k: np.array([settings[i][k] for i in mine], float).reshape(-1, 1, 1) for k in moving}
            image = np.concatenate([captures.frames[i].image for i in mine])
            name = f"readings {mine[0]} ... {mine[-1]}" if len(mine) > 1 else f"reading {mine[0]}"
            frames.append(
                Frame(
                    name,
                    image,
                    None,
                    None,
                    {k: v for k, v in own.items() if k not in moving},
                    [],
                    captures.frames[mine[0]].file,
                    readings,
                    np.array(mine, float).reshape(-1, 1, 1),
                )
            )
    return replace(captures, frames=frames, warnings=list(captures.warnings))


def groups(captures: Captures) -> dict[str, list[int]]:
    """Frame indices by group, in order of appearance; a frame without a group is a group of its own, by its name."""
    found: dict[str, list[int]] = {}
    taken = {f.group for f in captures.frames}
    for index, f in enumerate(captures.frames):
        own = f.name if f.name not in taken else f"{f.name} (frame {index})"
        found.setdefault(f.group if f.group is not None else own, []).append(index)
    return found


def cfa_channel(shape: Sequence[int], pattern: str) -> np.ndarray:
    """Which channel (0 R, 1 G, 2 B) each pixel of a raw mosaic holds: (H, W) int for shape (H, W, ...)."""
    if pattern not in CFA:
        raise UnknownKey(pattern, CFA, "cfa")
    cell = np.array(["RGB".index(letter) for letter in pattern]).reshape(2, 2)
    return cell[np.ix_(np.arange(shape[0]) % 2, np.arange(shape[1]) % 2)]


# -- Writing ---------------------------------------------------------------------------------------------------------
def write(captures: Captures, folder: str | Path, *, overwrite: bool = False, bits: int | None = None) -> Path:
    """Write a capture set that `load` reads back; the folder appears whole or not at all. Returns the folder.

    bits  8 or 16: PNG of whole DN; None: float32 EXR. A flat field that is not whole stays float32.
    Raises BadCapture, and OutputExists: `overwrite` replaces only what this function wrote, never a measured set.
    """
    folder = Path(os.path.abspath(folder))
    if bits not in (None, 8, 16):
        raise ValueError(f"bits = {bits!r}; allowed: 8, 16 or None (float32)")
    if not captures.frames:
        raise BadCapture(f"{folder}: zero frames; allowed: one or more")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        if not overwrite:
            raise OutputExists(f"{folder} exists and is not empty; choose another folder, or allow to overwrite it")
        names = {p.name if p.stem != "flat_field" else "flat_field" for p in folder.glob("*")}
        if (
            FILE not in names
            or names - {FILE, "frames", "readings.csv", "flat_field"}
            or not ((folder / FILE).read_text(encoding="utf-8").startswith(MARK))
        ):
            raise OutputExists(
                f"{folder} holds more than a capture set written by this program and is never replaced; "
                "choose another folder"
            )
    with new_folder(folder, replace=overwrite) as temporary:
        _fill(captures, temporary, folder, bits)
    return folder


def _fill(captures: Captures, folder: Path, final: Path, bits: int | None) -> None:
    import tomlkit

    document = tomlkit.document()
    document.add(tomlkit.comment(MARK[2:]))
    xml = captures.scene.lower().endswith(".xml")
    document["scene"] = Path(os.path.relpath(captures.scene, final)).as_posix() if xml else captures.scene
    if captures.values_are != "DN":
        document["values_are"] = captures.values_are
    if (flat := captures.flat_field) is not None:
        depth = bits if np.all(flat == np.round(flat)) else None
        document["flat_field"] = write_image(folder / "flat_field", flat, depth).name
    if captures.cfa:
        document["cfa"] = captures.cfa
    if captures.noise:
        document["noise"] = tomlkit.table()
        for key in NOISE_KEYS:
            document["noise"].add(key, tomlkit.item(float(getattr(captures.noise, key))).comment(UNITS[key]))
    if captures.parameters:
        document["parameters"] = _plain(captures.parameters)
    if captures.table is not None:
        document["table"] = {"file": "readings.csv", "values": captures.table.values}
        rows = [(_plain(f.parameters), [float(value) for value in f.image.ravel()]) for f in captures.frames]
        readings.write(folder / "readings.csv", rows, captures.table.values)
    else:
        names = [
            re.sub(r"[^\w.+-]+", "_", f.name) or "frame" for f in captures.frames
        ]  # "~" is left for what belongs to one
        if len(set(names)) < len(names):
            raise BadCapture(f"{final}: two frames are called '{max(names, key=names.count)}'; allowed: each name once")
        (folder / "frames").mkdir()
        tables = document["frames"] = tomlkit.aot()
        for name, f in zip(names, captures.frames):
            stem = folder / "frames" / name
            table = {"image": f"frames/{write_image(stem, f.image, bits).name}"}
            if f.mask is not None:
                write_image(stem.with_name(name + "~mask"), 255 * f.mask[..., None].astype(np.uint8), 8)
                table["mask"] = f"frames/{name}~mask.png"
            if f.repeats:
                files = [write_image(stem.with_name(f"{name}~repeat{i}"), r, bits) for i, r in enumerate(f.repeats)]
                table["repeats"] = [f"frames/{file.name}" for file in files]
            if f.group is not None:
                table["group"] = f.group
            if f.parameters:
                table["parameters"] = _plain(f.parameters)
            tables.append(tomlkit.item(table))
    (folder / FILE).write_text(tomlkit.dumps(document), encoding="utf-8")


def _plain(parameters: Mapping[str, float | str]) -> dict[str, float | str]:
    return {key: value if isinstance(value, str) else float(value) for key, value in parameters.items()}
