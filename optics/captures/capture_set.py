"""Capture sets: the folder with `captures.toml` through which a measurement reaches the program.

Everything a file gets wrong is refused here, before any rendering, with the file, the frame, the key, the value, its
unit, what is allowed and the next step. Images become (H, W, C) float32 in DN, row 0 on top; a row of a table of point
readings becomes a frame of 1 x 1 pixel."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from optics.captures import readings
from optics.captures.noise import (
    DEMOSAICED,
    PER_CHANNEL,
    SATURATED,
    UNITS,
    UNLIMITED,
    Noise,
    may_be_demosaiced,
    repeated,
    step_of,
)
from optics.captures.readings import DECIMALS, DELIMITERS, NAMES, Row, Table
from optics.errors import BadCapture, BadScene, OutputExists, UnknownKey
from optics.files import toml_checks as checks
from optics.files.images import SUFFIXES, read_image, read_mask, write_image
from optics.files.output import new_folder
from optics.polarization import mosaic as mosaics
from optics.polarization.mosaic import Mosaic
from optics.scene.parameter import Parameter
from optics.spectra.bands import parse
from optics.words import key_of

FILE = "captures.toml"
MARK = "# Written by optics"
KEYS = (
    "scene",
    "values_are",
    "bands",
    "absent",
    "flat_field",
    "cfa",
    "mosaic",
    "noise",
    "parameters",
    "uncertainty",
    "exclude",
    "frames",
    "table",
)
FRAME_KEYS = ("image", "mask", "repeats", "group", "flat_field", "parameters", "uncertainty")
TABLE_KEYS = (
    "file",
    "values",
    "rename",
    "delimiter",
    "decimal",
    "skip",
    "group",
    "scale",
    "offset",
    "uncertainty",
    "ignore",
)
OPTIONAL_NOISE_KEYS = ("correlation",)  # of images
NOISE_KEYS = tuple(  # the step is read off the images
    name for name in UNITS if name not in ("quantisation", *OPTIONAL_NOISE_KEYS)
)
UNMOVED = 8  # readings in a row at one setting, on average, from which its error is solved for and not weighed
SUNK = 5.0  # sd of the dark noise that the median of a frame may lie below the black level
Find = Callable[[str, str], Path]  # (name, where it stands) -> the file, or BadCapture
CFA = ("RGGB", "BGGR", "GRBG", "GBRG")
NO_CFA = "none"  # each pixel has measured values of its own in all channels


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
    flat_field: np.ndarray | None = None  # (H, W, C) float32: the untouched sensor under this frame's lights
    # standard deviation of a setting by key, in its unit; it replaces the set's. Of a sweep: see `sweeps`
    uncertainty: dict[str, Any] = field(default_factory=dict)
    # of a sweep: which time each of its settings was made, by key, a number or, where `uncertainty` has one standard
    # deviation for each reading, (N, 1, 1): readings, or sweeps, of one number share the setting's error
    made: dict[str, Any] = field(default_factory=dict)


def group_of(frame: Frame) -> str:
    """The name of a frame's group; of one that is in none, its own."""
    return frame.group or frame.name


@dataclass
class Captures:
    """A capture set.

    bits         8 or 16 for integer files, None for floats
    bands        nm, the scene's definition `bands`, or its text: a range, or auto; empty: the scene's own
    absent       names of parts of the scene that were not there
    uncertainty  standard deviation of a setting by key, in its unit, where a frame says no other
    exclude      effect -> why it is ruled out
    step         one unit of the last place that a table's readings are written with; 0: unknown
    """

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
    bands: list[float] | str = field(default_factory=list)
    absent: list[str] = field(default_factory=list)
    uncertainty: dict[str, float] = field(default_factory=dict)
    exclude: dict[str, str] = field(default_factory=dict)
    step: float = 0.0
    mosaic: Mosaic | None = None  # of analysers (deg), row by row: image is (H, W, 1), each pixel seen through its own
    unfiltered: bool = False  # stated: no mosaic of colour filters, each pixel measures all channels
    files: dict[str, Path] = field(default_factory=dict)  # all that was read, by the name that captures.toml has for it

    def uncertainty_of(self, frame: Frame) -> dict[str, Any]:
        """Standard deviations of what a frame sets, by key; those of 0 are left out."""
        known = {**self.uncertainty, **frame.uncertainty}
        return {key: sd for key, sd in known.items() if key in frame.parameters and sd > 0}


# -- Loading ---------------------------------------------------------------------------------------------------------
def load(path: str | Path, outside: bool = False) -> Captures:
    """Read and check a capture set, given its folder or its `captures.toml`.

    outside   its images and tables may lie anywhere, and not only in its folder

    Raises BadCapture (UnknownKey for a key that the format lacks). Settings are held against a scene by `check`.
    """
    path = Path(path)
    path = path / FILE if path.is_dir() else path
    where, folder = str(path), path.parent
    if path.exists() and not path.is_file():
        raise BadCapture(f"{where}: a folder, a pipe or a device; allowed: a file; put the text of the set there")
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
    cfa = checks.text(data, "cfa", where, (*CFA, NO_CFA))
    unfiltered, cfa = cfa == NO_CFA, None if cfa == NO_CFA else cfa
    noise = _noise(data["noise"], f"{where}: [noise]", "table" in data) if "noise" in data else None
    common = checks.settings(data.get("parameters", {}), f"{where}: [parameters]")
    if ("frames" in data) == ("table" in data):
        raise BadCapture(
            f"{where}: {'both [[frames]] and [table] are given' if 'frames' in data else 'zero frames'}; allowed: "
            "one [[frames]] or more, or one [table] of point readings"
        )
    mosaic = _mosaic(data["mosaic"], cfa, where) if "mosaic" in data else None
    captures = Captures(folder, scene, [], common, noise, None, cfa, values_are, mosaic=mosaic, unfiltered=unfiltered)
    captures.bands = _bands(data, where)
    captures.absent = checks.texts(data, "absent", where)
    captures.uncertainty = _uncertainty(data.get("uncertainty", {}), f"{where}: [uncertainty]")
    captures.exclude = _exclude(data.get("exclude", {}), f"{where}: [exclude]")
    captures.files[FILE] = path

    def find(name: str, what: str) -> Path:
        file = (checks.existing if outside else checks.inside)(folder, name, what)
        captures.files[name] = file
        return file

    step = 0.0
    if "table" in data:
        for key in ("cfa", "mosaic", "flat_field"):
            if key in data:
                raise BadCapture(f"{where}: {key} belongs to images, not to a [table]; remove it")
        captures.table, captures.frames, step = _read_table(find, data["table"], f"{where}: [table]")
    else:
        _read_frames(captures, find, data["frames"], where)
        if may_be_demosaiced(captures):
            captures.warnings.append(DEMOSAICED)
        if "flat_field" in data:
            here = f"{where}: flat_field"
            captures.flat_field, _ = read_image(find(checks.text(data, "flat_field", where) or "", here), here)
            _same_size(captures.flat_field, captures, here)
    images = [image for f in captures.frames for image in (f.image, *f.repeats)]
    _check_channels(captures, where)
    if noise is not None:
        noise = captures.noise = replace(noise, quantisation=max(step, step_of(images)))
        if captures.table is not None and noise.saturation == math.inf:
            captures.noise = replace(noise, saturation=_top(captures, noise.black_level))
    elif captures.table is not None:
        captures.step = step
    if captures.table is not None and (noise is None or noise.saturation == math.inf):
        captures.warnings.append(UNLIMITED)
    _check_levels(captures, where)
    if noise is None and not any(f.repeats for f in captures.frames) and not repeated(captures):
        captures.warnings.append(
            "neither [noise] nor repeats: nothing says how large a residual may be; give "
            + (
                "dark_noise (the standard deviation of a reading) under [noise], or rows of equal settings"
                if captures.table is not None
                else f"the EMVA 1288 numbers ({', '.join(NOISE_KEYS)}) or repeated frames"
            )
        )
    return captures


def _mosaic(rows: object, cfa: str | None, where: str) -> Mosaic:
    if cfa is not None:
        raise BadCapture(
            f"{where}: both cfa and mosaic are given; allowed: one of them; for a colour polarization camera, write "
            "the pixels of one colour as images of their own"
        )
    try:
        return mosaics.checked(rows)
    except ValueError as error:
        raise BadCapture(f"{where}: {error}") from error


def _noise(table: object, where: str, readings_: bool) -> Noise:
    """The noise model; of a table of readings only the standard deviation of a reading must be given."""
    known = NOISE_KEYS if readings_ else (*NOISE_KEYS, *OPTIONAL_NOISE_KEYS)
    checks.keys(table, known, where)
    assert isinstance(table, Mapping)
    usual = {"system_gain": 0.0, "black_level": 0.0, "saturation": math.inf, "prnu": 0.0} if readings_ else {}
    missing = [f"{key} ({UNITS[key].strip('()')})" for key in NOISE_KEYS if key not in table and key not in usual]
    if missing:
        raise BadCapture(
            f"{where}: {', '.join(missing)} missing; give "
            + (
                "the standard deviation of a reading, or leave [noise] out to have it estimated from rows of equal "
                "settings"
                if readings_
                else f"all of {', '.join(NOISE_KEYS)}, or leave [noise] out to have it estimated from repeats"
            )
        )
    numbers = {key: _noise_number(table[key], key, where, readings_) for key in known if key in table}
    try:
        return Noise(**{**usual, **numbers}, signed=readings_, ends="saturation" in numbers or not readings_)
    except ValueError as error:
        raise BadCapture(f"{where}: {error}") from error


def noise_table(noise: Noise) -> Any:
    """[noise] as `_noise` reads it, with units: a table of tomlkit."""
    import tomlkit

    written = [key for key in NOISE_KEYS if key != "saturation" or noise.ends]
    written += [key for key in OPTIONAL_NOISE_KEYS if np.any(getattr(noise, key))]
    table = tomlkit.table()
    for key in written:
        table.add(key, tomlkit.item(noise.written(key)).comment(UNITS[key]))
    return table


def _noise_number(value: object, key: str, where: str, readings_: bool) -> Any:
    """A number, or of what each channel may have its own, a number for each."""
    if not isinstance(value, list) or key not in PER_CHANNEL:
        return checks.number(value, key, UNITS[key], where)
    if readings_:
        raise BadCapture(f"{where}: {key} = {value!r}; allowed: one number, as a table has no R, G and B")
    return tuple(checks.number(one, key, UNITS[key], where) for one in value)


def _check_channels(captures: Captures, where: str) -> None:
    """A number for each channel belongs to colour images, whose pixels have all of them."""
    channels = captures.frames[0].image.shape[2]
    for key in PER_CHANNEL:
        if isinstance(own := getattr(captures.noise, key, None), tuple) and channels != len(own):
            raise BadCapture(
                f"{where}: [noise]: {key} = {list(own)}, but images have {channels} channel"
                f"{'s' if channels > 1 else ''} per pixel; allowed: one number, or R, G, B of images that are "
                "developed to colour"
            )


def _bands(data: Mapping, where: str) -> list[float] | str:
    if "bands" not in data:
        return []
    bands = data["bands"]
    if isinstance(bands, str) and re.match(r"auto\b|[\d.]+:", bands):  # a range, or nodes of integrals
        try:
            parse(bands, where)
        except BadScene as error:
            raise BadCapture(str(error)) from error
        return bands
    if not isinstance(bands, list) or not bands:
        raise BadCapture(
            f"{where}: bands = {bands!r}; allowed: a list of wavelengths in nm, such as [470, 530, 625], a range such "
            'as "400:700:10", or "auto"'
        )
    numbers = [checks.number(band, "bands", "nm", where) for band in bands]
    if min(numbers) <= 0 or len(set(numbers)) < len(numbers):
        raise BadCapture(f"{where}: bands = {bands!r} nm; allowed: wavelengths above 0, each once")
    return numbers


def _uncertainty(table: object, where: str) -> dict[str, float]:
    """Standard deviations by key, 0 or more."""
    settings = checks.settings(table, where)
    for key, sd in settings.items():
        if isinstance(sd, str) or sd < 0:
            raise BadCapture(f'{where}: "{key}" = {sd!r}; allowed: a standard deviation in the key\'s unit, 0 or more')
    return {key: float(sd) for key, sd in settings.items()}


def _exclude(table: object, where: str) -> dict[str, str]:
    checks.keys(table, (), where)
    assert isinstance(table, Mapping)
    for effect, reason in table.items():
        if not isinstance(reason, str) or not reason.strip():
            raise BadCapture(f'{where}: "{effect}" = {reason!r}; allowed: the reason in quotes, which is printed')
    return dict(table)


def _top(captures: Captures, black: float) -> float:
    """A full scale for readings whose end nobody knows: the largest, so that powers near 1 predict it."""
    top = max(float(f.image.max()) for f in captures.frames)
    return top if top > black else black + 1.0


def _read_frames(captures: Captures, find: Find, tables: object, where: str) -> None:
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
        files = [find(image, f"{here}: image")]
        files += [find(name, f"{here}: repeats") for name in checks.texts(table, "repeats", here)]
        for file in files:
            if (same := file.resolve()) in seen:
                raise BadCapture(
                    f"{here}: '{file.name}' is used twice (first by frame {seen[same]}); allowed: each image "
                    "once, as it is one reading; remove one of them"
                )
            seen[same] = index
        mask = checks.text(table, "mask", here)
        mask = find(mask, f"{here}: mask") if mask else None
        settings = checks.settings(table.get("parameters", {}), f"{here}: parameters")
        spread = _uncertainty(table.get("uncertainty", {}), f"{here}: uncertainty")
        flat = checks.text(table, "flat_field", here)
        flat = find(flat, f"{here}: flat_field") if flat else None
        specs.append((here, image, files, mask, checks.text(table, "group", here), settings, spread, flat))
    stems = [Path(image).stem for _, image, *_ in specs]
    depths = {}
    flats: dict[Path, np.ndarray] = {}
    for (here, image, files, mask, group, settings, spread, flat), stem in zip(specs, stems):
        name = stem if stems.count(stem) == 1 else image
        for file in files:
            image_read, bits = read_image(file, f"{here}: {file.name}")
            depths.setdefault(bits, file.name)
            if file is files[0]:
                frame = Frame(name, image_read, None, group, settings, [], image, uncertainty=spread)
                captures.frames.append(frame)
            else:
                frame.repeats.append(image_read)
            _same_size(image_read, captures, f"{here}: {file.name}")
        if mask is not None:
            frame.mask = read_mask(mask, frame.image.shape, f"{here}: mask '{mask.name}'")
        if flat is not None:
            if flat not in flats:
                flats[flat], _ = read_image(flat, f"{here}: flat_field '{flat.name}'")
                _same_size(flats[flat], captures, f"{here}: flat_field '{flat.name}'")
            frame.flat_field = flats[flat]
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

    if captures.mosaic and shape[2] != 1:
        raise BadCapture(
            f"{where}: mosaic = {[list(row) for row in captures.mosaic]} but the image has {shape[2]} channels; "
            "allowed: the raw frame (one value per pixel); remove mosaic if the image is no raw frame of a "
            "polarization camera"
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
    flats = [("flat_field", captures.flat_field)] + [
        (f"frame {i} ('{f.file}'): flat_field", f.flat_field) for i, f in enumerate(captures.frames)
    ]
    # of a table a frame is one reading: those at the end of the scale are not used, as pixels are not
    whole = captures.table is None
    for what, values in used + [(what, flat) for what, flat in flats if flat is not None] if whole else []:
        if np.all(values >= top):
            raise BadCapture(
                f"{where}: {what}: all saturated, every value used is >= {top:g} DN; allowed: some values below; "
                "remove it or expose it shorter"
            )
    if captures.noise is not None and captures.table is None:
        _check_black(captures, used, where)
    if captures.noise is not None and not any(_lit(captures, f).any() for f in captures.frames):
        raise BadCapture(f"{where}: {_unusable(captures)}")


def _check_black(captures: Captures, used: Sequence[tuple[str, np.ndarray]], where: str) -> None:
    """Images far below their black level: refused where half of their values are cut off at 0, else a warning."""
    noise = captures.noise
    least = noise.black_level - SUNK * float(np.max(noise.sd(np.full(3, noise.black_level))))
    sunk = [(what, float(np.median(values))) for what, values in used if values.size]
    sunk = [(what, middle) for what, middle in sunk if middle < least]
    if not sunk:
        return
    what, middle = min(sunk, key=lambda one: one[1])
    text = (
        f"{what}: half of its values are {middle:g} DN or less, far below what it has without light, "
        f"black_level = {noise.black_level:g} DN"
    )
    if captures.bits and middle <= 0:
        raise BadCapture(f"{where}: {text}; allowed: {least:.4g} DN or more; correct [noise] black_level")
    others = f"; {len(sunk) - 1} other frames are as dark" if len(sunk) > 1 else ""
    captures.warnings.append(f"{text}{others}: either [noise] black_level is too high, or the camera has a dark offset")


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
        f"{', '.join(why)}; allowed: "
        + (
            "readings above black_level, which is in their own unit; correct [noise], scale or offset"
            if captures.table is not None
            else "raw DN (no volts, no 0 to 1) between these levels; correct [noise], the masks or the exposure"
        )
    )


def _read_table(find: Find, data: object, where: str) -> tuple[Table, list[Frame], float]:
    """(table, a frame per row, step of the readings)."""
    checks.keys(data, TABLE_KEYS, where)
    assert isinstance(data, Mapping)
    name, values = checks.text(data, "file", where), checks.texts(data, "values", where)
    if name is None or not values:
        raise BadCapture(
            f"{where}: file = {name!r}, values = {values}; allowed: the path of a table, one column or more"
        )
    words = {what: _words(data, what, where) for what in ("rename", "uncertainty")}
    numbers: dict[str, dict[str, float]] = {}
    for what in ("scale", "offset"):
        checks.keys(data.get(what, {}), (), f"{where}: {what}")
        numbers[what] = {
            key: checks.number(value, f'"{key}"', "", f"{where}: {what}") for key, value in data.get(what, {}).items()
        }
    for column, factor in numbers["scale"].items():
        if factor == 0:
            raise BadCapture(f'{where}: scale: "{column}" = 0; allowed: any other number')
    delimiter, decimal = data.get("delimiter", ","), data.get("decimal", ".")
    if delimiter not in DELIMITERS:
        raise BadCapture(f"{where}: delimiter = {delimiter!r}; allowed: {', '.join(map(repr, DELIMITERS))}")
    if decimal not in DECIMALS:
        raise BadCapture(f"{where}: decimal = {decimal!r}; allowed: {', '.join(map(repr, DECIMALS))}")
    if delimiter == decimal:
        raise BadCapture(
            f"{where}: decimal = ',' and cells separated by {NAMES[delimiter]}; allowed: another delimiter, such as ';'"
        )
    skip = data.get("skip", 0)
    if isinstance(skip, bool) or not isinstance(skip, int) or skip < 0:
        raise BadCapture(f"{where}: skip = {skip!r}; allowed: the number of lines before the column names, 0 or more")
    table = Table(
        name,
        values,
        words["rename"],
        numbers["scale"],
        delimiter,
        decimal,
        skip,
        checks.text(data, "group", where) or "",
        numbers["offset"],
        words["uncertainty"],
        checks.texts(data, "ignore", where),
    )
    rows, step = readings.read(find(name, f"{where}: file"), table, where)
    frames = [
        Frame(
            f"row {index}",
            np.array(row.values, np.float32).reshape(1, 1, -1),
            group=row.group,
            parameters=row.settings,
            file=name,
            uncertainty=row.uncertainty,
        )
        for index, row in enumerate(rows)
    ]
    return table, frames, step


def _words(data: Mapping, what: str, where: str) -> dict[str, str]:
    """A table of texts."""
    table = data.get(what, {})
    checks.keys(table, (), f"{where}: {what}")
    return {key: checks.text(table, key, f"{where}: {what}") or "" for key in table}


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
                        f'; rename = {{ "{key}" = "KEY" }} under [table] of {FILE} gives a column its key, '
                        f'ignore = ["{key}"] ignores it'
                        if captures.table is not None and settings is not captures.parameters
                        else ""
                    ),
                )
            parameters[key].check(value, key, where)
    _check_uncertainties(captures, parameters)


def _check_uncertainties(captures: Captures, parameters: Mapping[str, Parameter]) -> None:
    """Uncertainties belong to numbers that the set, or the frame, sets."""
    path = captures.folder / FILE
    everywhere = {*captures.parameters, *(key for f in captures.frames for key in f.parameters)}
    places = [(f"{path}: [uncertainty]", captures.uncertainty, everywhere)]
    places += [
        (f"{path}: frame {i} ('{f.file or f.name}'): uncertainty", f.uncertainty, {*captures.parameters, *f.parameters})
        for i, f in enumerate(captures.frames)
    ]
    for where, table, stated in places:
        for key in table:
            if key not in parameters:
                raise UnknownKey(key, parameters, "parameter", where, "`optics params SCENE` lists them")
            if not parameters[key].is_number:
                raise BadCapture(f"{where}: {key} is a choice of words; allowed: numbers")
            if key not in stated:
                raise BadCapture(
                    f"{where}: {key} has an uncertainty, and nothing sets it; allowed: keys that [parameters] or "
                    "frames set; for a free parameter give a prior (--prior)"
                )


def state(captures: Captures, parts: Mapping[str, Any], effects: Mapping[str, str]) -> Captures:
    """The set with what it says of a scene checked: parts that are absent are taken out where they can be.

    parts     name -> part, with the method `named(role)`;   effects   key -> name of all that are known
    A part with a parameter of the role "inserted" has it at 0. Raises UnknownKey, and BadCapture for a part that is
    absent and inserted."""
    where = f"{captures.folder / FILE}"
    found = dict(captures.parameters)
    for part in captures.absent:
        if part not in parts:
            raise UnknownKey(part, parts, "part", f"{where}: absent", "`optics params SCENE` lists what they have")
        name = parts[part].named("inserted")
        if name is None:
            continue
        key = f"{part}.{name}"
        settings = [("[parameters]", captures.parameters)]
        settings += [(f"frame {i} ('{f.file or f.name}')", f.parameters) for i, f in enumerate(captures.frames)]
        for place, own in settings:
            if own.get(key, 0.0) != 0.0:
                raise BadCapture(f"{where}: {place}: {key} = {own[key]}, but '{part}' is absent; allowed: one of these")
        found[key] = 0.0
    for effect in captures.exclude:
        if key_of(effect) not in effects:
            raise UnknownKey(effect, effects.values(), "effect", f"{where}: [exclude]", "`optics effects` lists them")
    return replace(captures, parameters=found)


def definitions(captures: Captures, given: Mapping[str, str], scene: Path) -> dict[str, str]:
    """The scene's definitions (-D): those given, then what the set says. Raises BadCapture for bands that the scene
    does not take."""
    if not captures.bands or "bands" in given:
        return dict(given)
    if not re.search(r'<default\s+name="bands"', scene.read_text(encoding="utf-8")):
        raise BadCapture(
            f'{captures.folder / FILE}: bands = {captures.bands} nm, but {scene} has no <default name="bands">; '
            "allowed: a scene whose integrator takes $bands; name it in the XML, or remove bands"
        )
    named = captures.bands
    return {**given, "bands": named if isinstance(named, str) else ", ".join(f"{band:g}" for band in named)}


def stated(captures: Captures) -> dict[str, float | str]:
    """What every frame has, with one value, because the experimenter said so: {key: value}."""
    found: dict[str, float | str] = {}
    for key in dict.fromkeys((*captures.parameters, *(k for f in captures.frames for k in f.parameters))):
        if any(key in f.readings for f in captures.frames):
            continue
        values = {f.parameters.get(key, captures.parameters.get(key)) for f in captures.frames}
        if len(values) == 1 and (value := values.pop()) is not None:
            found[key] = value
    return found


def subset(captures: Captures, frames: Sequence[int]) -> Captures:
    """The same set with only the frames of these indices, in this order."""
    count = len(captures.frames)
    for index in frames:
        if not 0 <= index < count:
            raise IndexError(f"frame {index}: {captures.folder} has {count} frames; allowed: 0 to {count - 1}")
    return replace(captures, frames=[captures.frames[i] for i in frames], warnings=list(captures.warnings))


def sweeps(captures: Captures, parameters: Mapping[str, Parameter], lights: Sequence[str]) -> Captures:
    """The rows of a table as a few frames of many readings, (N, 1, C), which are predicted at once.

    Readings of a group make a sweep. Without groups they are ordered by the setting that takes the most values and
    dealt out to 8 sweeps (4 of fewer than 32 readings, 1 of fewer than 8), so that each covers the whole range.
    Settings that move the scene's geometry keep sweeps of their own.

    The error of a setting is drawn when the setting is made, and rows that follow each other with the same value share
    it. Where a setting lasts for UNMOVED rows or more on average, its error is one number for all of these: such rows
    keep sweeps of their own, which say its standard deviation (`Frame.uncertainty`, a number) and which of them share
    it (`Frame.made`); a setting that is made once for the whole table becomes one of the set. Elsewhere a sweep says
    (N, 1, 1) sd sqrt(n) for n rows in a row: readings are weighed as independent ones, and the mean of n independent
    errors of that size has the standard deviation sd of the one that they share. Such rows stay in one sweep."""
    settings = [f.parameters for f in captures.frames]
    keys = sorted({k for own in settings for k in own})
    powers = {f"{name}.power" for name in lights}
    still = [k for k in keys if parameters[k].how not in ("layer", "image") and k not in powers]
    spread = [captures.uncertainty_of(f) for f in captures.frames]
    runs = {k: _runs(captures.frames, k) for k in keys if any(k in own for own in spread)}
    together = {k: np.bincount(number) for k, number in runs.items()}
    lasting = [
        k
        for k, number in runs.items()
        if k not in powers and (k in still or len(number) >= UNMOVED * (number[-1] + 1) or number[-1] == 0)
    ]
    once = [k for k in lasting if runs[k][-1] == 0]
    lasting = [k for k in lasting if k not in once]
    common = {k: settings[0][k] for k in once}
    # what all readings share of a light's drive level, its power takes up
    weighed_keys = [k for k in runs if k not in lasting and runs[k][-1] > 0]
    found: dict[tuple, list[int]] = {}
    for index, own in enumerate(settings):
        apart = (*(own.get(k) for k in still), *(int(runs[k][index]) for k in lasting))
        found.setdefault((captures.frames[index].group, tuple(sorted(own)), *apart), []).append(index)
    frames = []
    for rows in found.values():
        first = rows[0]
        moving = [
            k for k in settings[first] if k not in still and k not in once and len({settings[i][k] for i in rows}) > 1
        ]
        if moving:
            along = max(moving, key=lambda k: (parameters[k].unit == "deg", len({settings[i][k] for i in rows})))
            rows = sorted(rows, key=lambda i: settings[i][along])
        dealt: dict[tuple, list[int]] = {}  # rows that share an error are held out together
        for i in rows:
            dealt.setdefault(tuple(int(runs[k][i]) for k in weighed_keys) or (i,), []).append(i)
        count = 8 if len(rows) >= 32 else 4 if len(rows) >= 8 else 1
        count = 1 if captures.frames[first].group is not None else min(count, len(dealt))
        for part in range(count):
            mine = [i for own in list(dealt.values())[part::count] for i in own]
            swept = {k: _column([settings[i][k] for i in mine]) for k in moving}
            image = np.concatenate([captures.frames[i].image for i in mine])
            name = f"readings {mine[0]} ... {mine[-1]}" if len(mine) > 1 else f"reading {mine[0]}"
            weighed = {
                k: _column([spread[i].get(k, 0.0) * math.sqrt(together[k][runs[k][i]]) for i in mine])
                for k in weighed_keys
            }
            shared = {k: spread[first][k] for k in lasting if k in spread[first]}
            frames.append(
                Frame(
                    name,
                    image,
                    None,
                    captures.frames[first].group,
                    {k: v for k, v in settings[first].items() if k not in moving and k not in once},
                    [],
                    captures.frames[first].file,
                    swept,
                    _column(mine),
                    uncertainty={**weighed, **shared},
                    made={
                        **{k: _column(runs[k][mine]) for k in weighed_keys},
                        **{k: int(runs[k][first]) for k in shared},
                    },
                )
            )
    return replace(
        captures,
        frames=frames,
        parameters={**captures.parameters, **common},
        uncertainty={
            **{k: sd for k, sd in captures.uncertainty.items() if k in captures.parameters},
            **{k: spread[0][k] for k in once if k in spread[0]},
        },
        warnings=list(captures.warnings),
    )


def with_lasting_settings(captures: Captures) -> Captures:
    """The images of a set, each with the time that its uncertain settings were made (`Frame.made`): frames of a group
    that follow each other with the same value share its error, as rows of a table do (`sweeps`)."""
    spread = [captures.uncertainty_of(f) for f in captures.frames]
    runs = {k: _runs(captures.frames, k, groups=True) for k in {k for own in spread for k in own}}
    frames = [
        replace(f, made={k: int(runs[k][i]) for k in own}) for i, (f, own) in enumerate(zip(captures.frames, spread))
    ]
    return replace(captures, frames=frames, warnings=list(captures.warnings))


def _column(values: Sequence[Any]) -> np.ndarray:
    return np.array(values, float).reshape(-1, 1, 1)


def _runs(frames: Sequence[Frame], key: str, groups: bool = False) -> np.ndarray:
    """(N,) number of the time that a setting was made for each row: it was made anew where its value changes, or the
    group does."""

    def made(frame: Frame) -> tuple[object, ...]:
        return frame.parameters.get(key), frame.group if groups else None

    changed = [made(a) != made(b) for a, b in zip(frames, frames[1:])]
    return np.concatenate([[0], np.cumsum(changed, dtype=int)])


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
            or names - {FILE, "frames", "readings.csv", "flat_field", "flat"}
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
    if captures.bands:
        named = captures.bands
        whole = named if isinstance(named, str) else [int(b) if b == int(b) else b for b in named]
        document["bands"] = whole
    if captures.absent:
        document["absent"] = captures.absent
    if captures.flat_field is not None:
        document["flat_field"] = _write_flat(folder / "flat_field", captures.flat_field, bits).name
    if captures.cfa or captures.unfiltered:
        document["cfa"] = captures.cfa or NO_CFA
    if captures.mosaic:
        document["mosaic"] = [list(row) for row in captures.mosaic]
    if captures.noise:
        document["noise"] = noise_table(captures.noise)
    for name, content in (
        ("parameters", _plain(captures.parameters)),
        ("uncertainty", _plain(captures.uncertainty)),
        ("exclude", captures.exclude),
    ):
        if content:
            document[name] = content
    if captures.table is not None:
        rows = [
            Row(_plain(f.parameters), [float(v) for v in f.image.ravel()], f.group, dict(f.uncertainty))
            for f in captures.frames
        ]
        group, spread = readings.write(folder / "readings.csv", rows, captures.table.values)
        table = {"file": "readings.csv", "values": captures.table.values}
        document["table"] = {
            **table,
            **({"group": group} if group else {}),
            **({"uncertainty": spread} if spread else {}),
        }
    else:
        names = [
            re.sub(r"[^\w.+-]+", "_", f.name) or "frame" for f in captures.frames
        ]  # "~" is left for what belongs to one
        if len(set(names)) < len(names):
            raise BadCapture(f"{final}: two frames are called '{max(names, key=names.count)}'; allowed: each name once")
        (folder / "frames").mkdir()
        flats: dict[int, str] = {}  # frames of one flat field share its file
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
            if f.flat_field is not None:
                if id(f.flat_field) not in flats:
                    (folder / "flat").mkdir(exist_ok=True)
                    flats[id(f.flat_field)] = f"flat/{_write_flat(folder / 'flat' / name, f.flat_field, bits).name}"
                table["flat_field"] = flats[id(f.flat_field)]
            for key, content in (("parameters", f.parameters), ("uncertainty", f.uncertainty)):
                if content:
                    table[key] = _plain(content)
            tables.append(tomlkit.item(table))
    (folder / FILE).write_text(tomlkit.dumps(document), encoding="utf-8")


def _write_flat(file: Path, flat: np.ndarray, bits: int | None) -> Path:
    """A flat field in the frames' depth, where it is whole."""
    return write_image(file, flat, bits if np.all(flat == np.round(flat)) else None)


def _plain(parameters: Mapping[str, float | str]) -> dict[str, float | str]:
    return {key: value if isinstance(value, str) else float(value) for key, value in parameters.items()}
