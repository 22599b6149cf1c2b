"""Import: raw frames of a polarization camera become a capture set.

    import_frames("frames", "captures/film", mosaic=((90, 45), (135, 0)), rename={"angle": "polarizer.angle"})

What comes in: a folder of raw frames (TIFF, PNG, NPY; one value per pixel, one size), and what was set in each: in a
CSV with the column `file` and a column for every setting, or in the names of the files, as pieces `name=number` between
commas or double underscores: `run1__angle=30__2.tif`. Frames with the same settings are repeats, from which the noise
is estimated. The columns or pieces `group` and `mask` are those of captures.toml.

Derived from the frames, and said in sentences:
    depth   the bits of a value: 8 of 8 bit files; of others the least of 10, 12, 14, 16 that holds the brightest value.
            Cameras that shift 10 or 12 bit to the upper end of 16 leave the lower bits 0 everywhere: they are shifted
            back
    noise   saturation 2^bits - 1; the rest as given, or by repeats"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optics.captures import capture_set as capture_sets
from optics.captures.capture_set import Captures, Frame
from optics.captures.noise import Noise
from optics.errors import BadCapture, UnknownKey
from optics.files.images import SUFFIXES, read_image, read_mask, varied
from optics.polarization.mosaic import Mosaic, checked

DEPTHS = (10, 12, 14, 16)
OWN = ("file", "group", "mask")
PIECES = re.compile(r",|__")
BLACK_LEVEL_LOST = (
    "black_level = {:g} DN belongs to [noise], which repeats stand in for: it is not written down; give system_gain "
    "and dark_noise as well"
)


@dataclass
class Read:
    """What an import left: the folder and what it says, in sentences."""

    folder: Path
    warnings: list[str]


def import_frames(
    source: str | Path,
    folder: str | Path,
    *,
    mosaic: Mosaic,
    settings: str | Path | None = None,
    rename: Mapping[str, str] | None = None,
    scene: str = "polarization_camera",
    bits: int | None = None,
    bin: int = 1,
    black_level: float = 0.0,
    system_gain: float | None = None,
    dark_noise: float | None = None,
    overwrite: bool = False,
) -> Read:
    """Write a folder of raw frames as a capture set; see the module's text for what is derived.

    mosaic    analyser angles of the camera's cell of pixels, deg, row by row as the camera sees them
    settings  a CSV; None: the names of the files say what was set
    rename    name in the CSV or in file names -> parameter key
    bits      of a value, 8 to 16; None: derived
    bin       cells per side whose pixels of one angle are averaged: a frame shrinks by it, its noise too
    black_level, system_gain, dark_noise    DN, DN per electron, DN rms of single pixels; gain and noise both or neither
    Raises BadCapture, OutputExists.
    """
    source, mosaic = Path(source), checked(mosaic)
    if (system_gain is None) != (dark_noise is None):
        raise BadCapture("system_gain and dark_noise: one of them is missing; allowed: both, or neither and repeats")
    if bin < 1 or bits is not None and not 8 <= bits <= 16:
        raise BadCapture(f"bin = {bin}, bits = {bits}; allowed: bin 1 or more, bits 8 to 16")
    if not source.is_dir():
        raise BadCapture(f"{source}: no such folder of raw frames")
    rows = listed(source, Path(settings)) if settings is not None else named(source, SUFFIXES)
    rows = [(file, keyed(own, rename or {}, str(file))) for file, own in rows]
    images, masks = _read(rows, mosaic)
    warnings: list[str] = []
    images, depth = _levelled(images, bits, warnings)
    if bin > 1:
        masks = [None if mask is None else _binned(mask[..., None].astype(float), mosaic, bin) == 1 for mask in masks]
        full = 2**depth - 1
        images = [np.where(_any(image >= full, mosaic, bin), full, _binned(image, mosaic, bin)) for image in images]
    count = bin * bin
    noise = None
    if system_gain is not None and dark_noise is not None:
        noise = Noise(system_gain / count, dark_noise / bin, black_level, float(2**depth - 1), 0.0)
    frames = framed(rows, images, masks)
    if noise is None and black_level:
        warnings.append(BLACK_LEVEL_LOST.format(black_level))
    if noise is None and not any(f.repeats for f in frames):
        warnings.append(
            "neither repeats nor system_gain and dark_noise: nothing says how large a residual may be; record two "
            "frames or more at the same settings, or state the camera's numbers"
        )
    captures = Captures(Path(folder), scene, frames, {}, noise, mosaic=mosaic)
    whole = (8 if depth == 8 else 16) if bin == 1 else None
    written = capture_sets.write(captures, folder, overwrite=overwrite, bits=whole)
    return Read(written, warnings)


# -- what was set ----------------------------------------------------------------------------------------------------
def named(source: Path, suffixes: Sequence[str]) -> list[tuple[Path, dict[str, str]]]:
    """Files of a folder, each with the pieces name=value of its name."""
    files = sorted(file for file in source.iterdir() if file.suffix.lower() in suffixes)
    if not files:
        raise BadCapture(f"{source}: no frames; allowed: {', '.join(suffixes)} files")
    found = []
    for file in files:
        own: dict[str, str] = {}
        for piece in PIECES.split(file.stem):
            name, sign, value = piece.partition("=")
            if not sign:
                continue
            if name.strip() in own:
                raise BadCapture(f"{file}: '{name.strip()}' appears twice in the file's name; name it once")
            own[name.strip()] = value.strip()
        found.append((file, own))
    return found


def listed(source: Path, table: Path) -> list[tuple[Path, dict[str, str]]]:
    """Files that a CSV lists, each with the cells of its other columns."""
    if not table.is_file():
        raise BadCapture(f"{table}: no such file; give a CSV with the column file and one for each setting")
    try:
        with table.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.DictReader(stream)
            names = [name.strip() for name in reader.fieldnames or ()]
            reader.fieldnames = names
            cells = list(reader)
    except (UnicodeDecodeError, csv.Error) as error:
        raise BadCapture(f"{table}: no CSV in UTF-8 ({error})") from error
    if "file" not in names:
        raise BadCapture(str(UnknownKey("file", names, "column", str(table), "needed: file, and one for each setting")))
    if not cells:
        raise BadCapture(f"{table}: zero rows; needed: one per frame")
    found, seen = [], set()
    for line, row in enumerate(cells, 2):
        name = (row["file"] or "").strip()
        file = source / name
        if not name or not file.is_file():
            raise BadCapture(f"{table}: line {line}: no frame '{name}' in {source}")
        if name in seen:
            raise BadCapture(f"{table}: line {line}: '{name}' was listed before; allowed: each frame once")
        seen.add(name)
        found.append((file, {k: (v or "").strip() for k, v in row.items() if k and k != "file" and (v or "").strip()}))
    return found


def keyed(own: Mapping[str, str], rename: Mapping[str, str], where: str) -> dict[str, float | str]:
    """Settings by key, numbers where they are numbers."""
    found: dict[str, float | str] = {}
    for name, text in own.items():
        key = rename.get(name, name)
        if key not in OWN and "." not in key:
            raise BadCapture(
                f"{where}: '{name}' is no parameter key; allowed: keys such as polarizer.angle, group, mask; name its "
                f"key: rename {name}=polarizer.angle"
            )
        try:
            found[key] = text if key in OWN else float(text)
        except ValueError:
            found[key] = text
    return found


# -- images ----------------------------------------------------------------------------------------------------------
def _read(rows: Sequence[tuple[Path, Mapping]], mosaic: Mosaic) -> tuple[list[np.ndarray], list[np.ndarray | None]]:
    images: list[np.ndarray] = []
    masks: list[np.ndarray | None] = []
    for file, own in rows:
        image, _ = read_image(file, str(file))
        if image.shape[2] != 1:
            raise BadCapture(
                f"{file}: {image.shape[2]} channels; allowed: raw frames of one value per pixel, not demosaiced"
            )
        if images and image.shape != images[0].shape:
            raise BadCapture(f"{file}: {image.shape[:2]} pixels; allowed: {images[0].shape[:2]}, as the first frame")
        if (image != np.round(image)).any() or image.min() < 0:
            raise BadCapture(f"{file}: values are not whole numbers from 0 on; allowed: DN as the camera gave them")
        images.append(image)
        mask = own.get("mask")
        masks.append(None if mask is None else read_mask(file.parent / str(mask), image.shape, f"{file}: mask"))
    if all(image.min() == image.max() for image in images):
        varied(images[0], str(rows[0][0]))
    height, width = images[0].shape[:2]
    if height < len(mosaic) or width < len(mosaic[0]):
        raise BadCapture(f"{rows[0][0]}: {height} x {width} pixels are less than a cell of the mosaic")
    return images, masks


def _levelled(images: list[np.ndarray], bits: int | None, warnings: list[str]) -> tuple[list[np.ndarray], int]:
    """Images in DN of their depth, and the depth in bits."""
    top = max(int(image.max()) for image in images)
    used = int(np.bitwise_or.reduce([int(np.bitwise_or.reduce(image.astype(np.int64), axis=None)) for image in images]))
    empty = (used & -used).bit_length() - 1 if used else 0  # low bits that no value uses
    if top > 255 and empty in (2, 4, 6):  # 14, 12 or 10 bit at the upper end of 16
        warnings.append(f"the lower {empty} bits of every value are 0: values are divided by {2**empty}")
        images, top = [image / 2**empty for image in images], top >> empty
    depth = bits or (8 if top <= 255 else next(b for b in DEPTHS if top < 2**b))
    if top >= 2**depth:
        raise BadCapture(
            f"values up to {top} DN do not fit {depth} bit; allowed: 0 to {2**depth - 1}; give the camera's bits"
        )
    if bits is None:
        warnings.append(f"values up to {top} DN: taken as {depth} bit, saturated at {2**depth - 1} DN")
    return images, depth


def _cells(image: np.ndarray, mosaic: Mosaic, bin: int) -> np.ndarray:
    """(rows, bin, h, columns, bin, w) of an image (H, W, 1) whose edges that fill no block are cut."""
    h, w = len(mosaic), len(mosaic[0])
    rows, columns = image.shape[0] // (h * bin), image.shape[1] // (w * bin)
    if not rows or not columns:
        raise BadCapture(
            f"bin = {bin}: blocks of {h * bin} x {w * bin} px in frames of {image.shape[0]} x {image.shape[1]} px; "
            "allowed: a block or more"
        )
    return image[: rows * h * bin, : columns * w * bin, 0].reshape(rows, bin, h, columns, bin, w)


def _joined(cells: np.ndarray) -> np.ndarray:
    rows, h, columns, w = cells.shape
    return cells.reshape(rows * h, columns * w, 1)


def _binned(image: np.ndarray, mosaic: Mosaic, bin: int) -> np.ndarray:
    """Means of the pixels of one angle over blocks of bin x bin cells, in the same layout."""
    return _joined(_cells(image, mosaic, bin).mean((1, 4)))


def _any(mask: np.ndarray, mosaic: Mosaic, bin: int) -> np.ndarray:
    return _joined(_cells(mask, mosaic, bin).any((1, 4)))


def framed(rows: Sequence[tuple[Path, Mapping]], images: Sequence[np.ndarray], masks: Sequence) -> list[Frame]:
    """A frame for each combination of settings; further files of the same are its repeats."""
    frames: dict[tuple, Frame] = {}
    for (file, own), image, mask in zip(rows, images, masks):
        key = tuple(sorted((k, v) for k, v in own.items()))
        if key in frames:
            frames[key].repeats.append(image.astype(np.float32))
            continue
        settings = {k: v for k, v in own.items() if k not in OWN}
        name = re.sub(r"[^\w.+=-]+", "_", file.stem)
        mask = None if mask is None else np.asarray(mask).reshape(np.shape(mask)[:2])
        group = own.get("group")
        frames[key] = Frame(name, image.astype(np.float32), mask, None if group is None else str(group), settings)
    return list(frames.values())
