"""The kinds of source that `optics import` reads, and what may be given of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optics.captures import hyperspectral, importing, raw_frames, scans, translucent
from optics.cli.shared import pairs
from optics.polarization.mosaic import read_mosaic

EVERYWHERE = ("--bin",)
CAMERA = ("--settings", "--rename", "--scene", "--bits", "--black-level", "--system-gain", "--dark-noise")
PRESSES = ("--ball-radius", "--mm-per-pixel", "--leds", "--every", "--background")


@dataclass(frozen=True)
class Kind:
    """A kind of source.

    words   what it is;   takes, needs  options, as they are written
    read    (source, folder, keywords) -> what an import left; keywords are options without dashes, of those that were
            given, and `overwrite`, `progress`
    """

    words: str
    takes: tuple[str, ...]
    read: Callable[..., Any]
    needs: tuple[str, ...] = ()


def _cubes(source: Path, folder: Path, *, progress: Callable | None, rename: list | None = None, **given: Any) -> Any:
    return hyperspectral.import_cubes(source, folder, rename=pairs(rename, "--rename"), **given)


def _frames(
    source: Path, folder: Path, *, progress: Callable | None, mosaic: str, rename: list | None = None, **given: Any
) -> Any:
    named = pairs(rename, "--rename")
    return raw_frames.import_frames(source, folder, mosaic=read_mosaic(mosaic), rename=named, **given)


def _scans(source: Path, folder: Path, *, heightmap: list[str] | None = None, **given: Any) -> Any:
    return scans.import_scans(source, folder, mapped=[name.rstrip("/") for name in heightmap or ()], **given)


def _circles(source: Path, folder: Path, *, circles: Path, **given: Any) -> Any:
    return importing.import_circles(source, circles, folder, **given)


FRAMES = Kind("a folder of raw frames of a polarization camera", ("--mosaic", *CAMERA), _frames)
CUBES = Kind("a set of hyperspectral images", ("--bands", *CAMERA), _cubes)
SCANS = Kind("a folder of scans (scan.yaml)", ("--heightmap", "--black-level"), _scans)
OF_9DTACT = Kind("a calibration folder of 9DTact", ("--ball-radius", "--mm-per-pixel"), translucent.import_translucent)
PACKS = Kind("a calibration pack", PRESSES, importing.import_taxim)
IMAGES = Kind(
    "a folder of images of presses",
    ("--circles", "--untouched", *PRESSES),
    _circles,
    ("--circles", "--ball-radius", "--mm-per-pixel"),
)
KINDS = (FRAMES, CUBES, SCANS, OF_9DTACT, PACKS, IMAGES)
WHY = {
    "--circles": "a table with the columns file, center_x_px, center_y_px, contact_radius_px",
    "--ball-radius": "mm, which circles do not tell",
    "--mm-per-pixel": "which circles do not tell",
}


def kind_of(source: Path, mosaic: str | None) -> Kind:
    """The kind of a source, by its layout; a mosaic is that of raw frames."""
    if mosaic is not None:
        return FRAMES
    if hyperspectral.is_cube_source(source):
        return CUBES
    if scans.is_scan_source(source):
        return SCANS
    if translucent.is_translucent_source(source):
        return OF_9DTACT
    return PACKS if source.suffix == ".npz" or importing.is_pack(source) else IMAGES


def read(source: Path, folder: Path, given: Mapping[str, Any], overwrite: bool, progress: Callable | None) -> Any:
    """Import a source; `given`: options as they are written -> values, None where they were not.

    Raises ValueError for an option that its kind does not take, or that it needs."""
    given = {flag: value for flag, value in given.items() if value is not None}
    kind = kind_of(source, given.get("--mosaic"))
    wrong = [flag for flag in given if flag not in (*kind.takes, *EVERYWHERE)]
    if wrong:
        what = f"{', '.join(wrong)}: not for {kind.words}, as which {source} is read"
        more = ', or give --mosaic "90 45 135 0" as well' if kind is IMAGES and set(wrong) <= set(CAMERA) else ""
        raise ValueError(f"{what}; leave {'these' if wrong[1:] else 'it'} out{more}")
    missing = [flag for flag in kind.needs if flag not in given]
    if missing:
        wanted = "; ".join(f"{flag} ({WHY[flag]})" for flag in missing)
        raise ValueError(f"{source}: is read as {kind.words}, which needs {wanted}")
    keywords = {flag[2:].replace("-", "_"): value for flag, value in given.items()}
    return kind.read(source, folder, **keywords, overwrite=overwrite, progress=progress)
