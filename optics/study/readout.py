"""What a robot would compute from images on disk: markers, proximity, the printed grid, likeness to another image.

    rows = markers(images, rest, grid=(5, 4))        a row per marker
    rows = proximity(images, background)             a row per image, as are the next two
    rows = grid(images, still)
    rows = likeness(images, reference)

Images are given as {name: file}; each row is a dictionary of numbers and words for a table or JSON, and None stands for
what is not there. The arithmetic is that of optics.readers; this only reads files and names columns."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from optics.errors import BadCapture
from optics.files.images import SUFFIXES, read_image
from optics.readers import grid as grid_reader
from optics.readers import markers as marker_reader
from optics.readers import proximity as proximity_reader

Row = dict[str, object]
Progress = Callable[[str, int, int], None]


def images(paths: Sequence[Path]) -> dict[str, Path]:
    """{name: file} of files, and of the images in folders in the order of their names: PNG and TIFF, or where there are
    none EXR and NPY. Raises BadCapture for what is no image, and for a name that stands twice."""
    found: dict[str, Path] = {}
    for path in map(Path, paths):
        if not path.exists():
            raise BadCapture(
                f"{path}: no such file or folder; allowed: images ({', '.join(SUFFIXES)}) or folders of them"
            )
        inside = [path]
        if path.is_dir():
            files = [f for f in sorted(path.iterdir()) if f.is_file() and not f.name.startswith(".")]
            camera = [f for f in files if f.suffix.lower() in SUFFIXES[:3]]
            inside = camera or [f for f in files if f.suffix.lower() in SUFFIXES[3:]]
            if not inside:
                raise BadCapture(f"{path}: no images in it; allowed: a folder with {', '.join(SUFFIXES)} files")
        for file in inside:
            if str(file) in found:
                raise BadCapture(f"{file} is named twice; allowed: each image once")
            found[str(file)] = file
    return found


def _each(files: Mapping[str, Path], what: str, progress: Progress | None) -> Iterable[tuple[str, np.ndarray]]:
    for i, (name, file) in enumerate(files.items()):
        yield name, read_image(file, name)[0]
        if progress:
            progress(what, i + 1, len(files))


def markers(
    files: Mapping[str, Path],
    rest: Path | None = None,
    grid: tuple[int, int] | None = None,
    progress: Progress | None = None,
) -> list[Row]:
    """A row per marker: file, marker, x, y (px), and with an image at rest dx, dy (px; None where it is lost), else
    area (px), contrast, score, roundness. grid: (columns, rows), to number them row by row."""
    count = None if grid is None else grid[0] * grid[1]
    rows: list[Row] = []
    at_rest = None
    if rest is not None:
        at_rest = _ordered(_found(read_image(rest, str(rest))[0], count, str(rest)), grid, str(rest)).centres
    for name, image in _each(files, "markers", progress):
        found = _found(image, count, name)
        if at_rest is not None:
            moved = marker_reader.match(at_rest, found)
            for i, (place, move) in enumerate(zip(at_rest, moved)):
                x, y = place + move
                rows.append({"file": name, "marker": i, **_numbers(x=x, y=y, dx=move[0], dy=move[1])})
            continue
        found = _ordered(found, grid, name)
        for i, (x, y) in enumerate(found.centres):
            numbers = _numbers(
                x=x,
                y=y,
                area=found.areas[i],
                contrast=found.contrast[i],
                score=found.score[i],
                roundness=found.roundness[i],
            )
            rows.append({"file": name, "marker": i, **numbers})
    return rows


@contextmanager
def _of(name: str) -> Iterator[None]:
    """Errors in it begin with the file's name."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _found(image: np.ndarray, count: int | None, name: str) -> marker_reader.Markers:
    with _of(name):
        return marker_reader.find(image, count)


def _ordered(found: marker_reader.Markers, grid: tuple[int, int] | None, name: str) -> marker_reader.Markers:
    with _of(name):
        return found if grid is None else found[marker_reader.grid_order(found, *grid)]


def proximity(
    files: Mapping[str, Path],
    background: Path,
    threshold: float | None = None,
    curve: Sequence[tuple[float, float]] | None = None,
    reference_area: float | None = None,
    progress: Progress | None = None,
) -> list[Row]:
    """A row per image: file, area of the nearest object (px), r (eq. (9) of the source), and with a curve (r, mm) of a
    reference object the distance (mm; None off the curve).

    The first image that shows an object is where it is first detected (A0); `reference_area` is that of the reference
    there (A0'; None: this object is the reference)."""
    behind = read_image(background, str(background))[0]
    rows: list[Row] = []
    first = None
    for name, image in _each(files, "proximity", progress):
        with _of(name):
            area = proximity_reader.area(image, behind, threshold)
        first = first or area
        r = proximity_reader.metric(area, first, reference_area or first, behind[..., 0].size) if first else math.nan
        row: Row = {"file": name, **_numbers(area=area, r=r)}
        if curve is not None:
            row |= _numbers(distance=proximity_reader.distance(r, *np.transpose(curve)))
        rows.append(row)
    return rows


def grid(
    files: Mapping[str, Path],
    still: Mapping[str, Path],
    thresholds: Mapping[str, float] | None = None,
    progress: Progress | None = None,
) -> list[Row]:
    """A row per image: file, entropy (bit), correlation, similarity, and the states proximity, contact and both
    together. still: images with nothing near; thresholds: those of `optics.readers.grid.read_sequence` by name."""
    bits: set[int | None] = set()

    def colours(of: Mapping[str, Path]) -> Iterator[np.ndarray]:
        for name, file in of.items():
            image, depth = read_image(file, name)
            bits.add(depth)
            if len(bits) > 1:
                others = ", ".join(_depth(b) for b in bits - {depth})
                raise BadCapture(f"{name}: {_depth(depth)} beside {others}; allowed: all of one depth")
            if image.shape[2] != 3:
                raise BadCapture(f"{name}: {image.shape[2]} channels; allowed: R, G, B, as the channels are compared")
            yield image

    still_frames = list(colours(still))
    top = 65535.0 if bits == {16} else grid_reader.TOP
    groups = min(grid_reader.BACKGROUNDS, len(still_frames))
    references = grid_reader.references(still_frames, groups, saturation=top)
    names = list(files)

    def counted() -> Iterator[np.ndarray]:
        for i, image in enumerate(colours(files)):
            if progress:
                progress("grid", i + 1, len(names))
            yield image

    readings = grid_reader.read_sequence(counted(), references, **(thresholds or {}))
    return [
        {
            "file": names[row.frame],
            **_numbers(entropy=row.entropy, correlation=row.correlation, similarity=row.similarity),
            "proximity": row.proximity,
            "contact": row.contact,
            "state": row.state,
        }
        for row in readings
    ]


def likeness(files: Mapping[str, Path], reference: Path, progress: Progress | None = None) -> list[Row]:
    """A row per image: file, SSIM (mean over pixels and channels), L1 (of full scale) and PSNR (dB; None where the
    images are the same), against a reference. Full scale is that of the files' depth; of EXR and NPY, 1."""
    from optics.fit.compare import structural_similarity_map

    wanted, bits = read_image(reference, str(reference))
    full = 1.0 if bits is None else 2.0**bits - 1
    rows: list[Row] = []
    for i, (name, file) in enumerate(files.items()):
        image, depth = read_image(file, name)
        if image.shape != wanted.shape or depth != bits:
            raise BadCapture(
                f"{name}: {image.shape}, {_depth(depth)}; allowed: {wanted.shape}, {_depth(bits)}, as {reference}"
            )
        a, b = image / full, wanted / full
        use = np.ones(a.shape[:2], bool)
        maps = [structural_similarity_map(a[..., c], b[..., c], use) for c in range(a.shape[2])]
        ssim = np.mean([values[counts].mean() for values, counts in maps])
        square = float(np.mean((a - b) ** 2))
        psnr = -10 * math.log10(square) if square else math.nan
        rows.append({"file": name, **_numbers(ssim=ssim, l1=np.abs(a - b).mean(), psnr=psnr)})
        if progress:
            progress("ssim", i + 1, len(files))
    return rows


def _numbers(**values: float | np.ndarray) -> Row:
    """Numbers for JSON: None where there is none."""
    return {name: float(value) if np.isfinite(value) else None for name, value in values.items()}


def _depth(bits: int | None) -> str:
    return "float" if bits is None else f"{bits} bit"


def curve_of(file: Path) -> list[tuple[float, float]]:
    """(r, mm) rows of a CSV file with the columns r and distance."""
    import csv

    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such file; a curve is a CSV file with the columns r and distance (mm)")
    with open(file, newline="", encoding="utf-8-sig") as lines:
        table = csv.DictReader(lines)
        if not {"r", "distance"} <= set(table.fieldnames or ()):
            raise ValueError(
                f"{file}: columns {', '.join(table.fieldnames or ()) or 'none'}; allowed: r and distance (mm)"
            )
        rows = []
        for number, row in enumerate(table, 2):
            try:
                rows.append((float(row["r"]), float(row["distance"])))
            except (TypeError, ValueError):
                raise ValueError(
                    f"{file}, line {number}: {row['r']}, {row['distance']}; allowed: two numbers"
                ) from None
    try:
        proximity_reader.distance(1.0, *np.reshape(rows, (-1, 2)).T)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    return rows
