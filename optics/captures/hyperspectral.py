"""Import: measured hyperspectral images become a capture set, each band a channel of its own.

    import_cubes("cubes", "captures/skin", scene="digit", bands="400:700:10")

What comes in: cubes of one size and the same bands,
    ENVI            a header (.hdr) with `wavelength`, and the raw file beside it; BSQ, BIL or BIP, 8 to 64 bit
    Spectral EXR    channels S0.550,000000nm ... (Fichet, Pacanowski & Wilkie, JCGT 10(3), 2021)
    a folder        of grey PNG or TIFF images of narrow bands, whose names say the wavelength: skin_550nm.tif
alone or several in a folder. What was set in each stands in a CSV with the column `file`, or in the names of the files,
as pieces `name=number` between commas or double underscores: `press_x=1__press_y=0__550nm.tif`. Cubes with the same
settings are repeats.

What goes out is a folder of `captures` with images (H, W, B), B ascending in the wavelength, bands = "auto", and
`sensitivities.csv`: what each channel sees, a Gaussian about its wavelength with the full width at half maximum that
the header gives, and without one the step to its neighbours. The scene's camera gets it by `-D
sensitivity=FOLDER/sensitivities.csv`. Values are DN as they are; no white or dark reference is applied."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from optics.captures import capture_set as capture_sets
from optics.captures.capture_set import Captures
from optics.captures.noise import Noise
from optics.captures.raw_frames import BLACK_LEVEL_LOST, Read, framed, keyed, listed, named
from optics.errors import BadCapture, BadScene, OutputExists
from optics.files import exr
from optics.files.images import CHANNELS_MOST, PIXELS_MOST, read_image
from optics.files.output import new_folder
from optics.spectra.bands import parse
from optics.spectra.reading import LENGTHS, gaussian

SENSITIVITIES = "sensitivities.csv"
TYPES = {1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8", 12: "u2", 13: "u4", 14: "i8", 15: "u8"}  # of ENVI
AXES = {"bsq": "BHW", "bil": "HBW", "bip": "HWB"}
RAW = ("", ".raw", ".img", ".dat", ".bsq", ".bil", ".bip", ".bin", ".cube")
NEEDED = ("samples", "lines", "bands", "data type", "interleave", "wavelength")
NAMED = re.compile(r"(?<![\d.,])(\d{3,4}(?:[.,]\d+)?)\s*nm\b", re.I)
NARROW = (".png", ".tif", ".tiff")
STEP = 0.5  # nm, of the sensitivities that are written
WIDE = 3.0  # full widths to each side that a Gaussian is written over: 1e-11 of its peak


@dataclass
class Cube:
    """A hyperspectral image: nm (B,) ascending, values (H, W, B) float32, full widths at half maximum (B,) nm.

    whole   largest value that its type can have, of whole numbers; None of others
    mask    (H, W) True where every band has a value
    """

    nm: np.ndarray
    values: np.ndarray
    width: np.ndarray
    whole: int | None = None
    mask: np.ndarray | None = None


def is_cube_source(source: Path) -> bool:
    """Whether a path is that of hyperspectral images: a header, a Spectral EXR, or a folder that has such, or images
    that name wavelengths."""
    if source.is_dir():
        files = list(source.iterdir())
        return any(is_cube_source(f) for f in files if f.is_file()) or (
            len([f for f in files if f.suffix.lower() in NARROW and NAMED.search(f.stem)]) > 1
        )
    if source.suffix.lower() == ".hdr":
        return source.is_file()
    if source.suffix.lower() != ".exr" or not source.is_file():
        return False
    try:
        return any(exr.SPECTRAL_NAME.fullmatch(name) for name in exr.read(source)[0])
    except ValueError:
        return False


def import_cubes(
    source: str | Path,
    folder: str | Path,
    *,
    scene: str = "digit",
    settings: str | Path | None = None,
    rename: Mapping[str, str] | None = None,
    bands: str | None = None,
    bits: int | None = None,
    bin: int = 1,
    black_level: float = 0.0,
    system_gain: float | None = None,
    dark_noise: float | None = None,
    overwrite: bool = False,
) -> Read:
    """Write hyperspectral images as a capture set; see the module's text.

    settings  a CSV with the column file; None: the names of the files say what was set
    rename    name in the CSV or in file names -> parameter key
    bands     a range "400:700:10", nm: channels are means of the source's bands within half a step; a band on the
              border of two counts in the upper one, so that channels share no noise. None: as they are
    bits      of a value, which saturates at 2^bits - 1, and with it every mean that it is part of; None: those of its
              type, of real numbers the largest value
    bin       pixels each way that are averaged
    black_level, system_gain, dark_noise    DN, DN per electron, DN rms of single values; gain and noise both or neither
    Raises BadCapture, OutputExists.
    """
    source = Path(source)
    if (system_gain is None) != (dark_noise is None):
        raise BadCapture("system_gain and dark_noise: one of them is missing; allowed: both, or neither and repeats")
    if bin < 1:
        raise BadCapture(f"bin = {bin}; allowed: 1 or more pixels")
    _check_output(Path(folder), overwrite)
    found = _found(source, None if settings is None else Path(settings))
    rows: list = []
    cubes: list[Cube] = []
    warnings: list[str] = []
    first, counts = found[0][2](), 1
    full = float(np.float32(2**bits - 1 if bits is not None else first.whole or np.inf))  # as values are
    for file, own, read in found:
        cube = read() if cubes else first
        if cube.values.shape != first.values.shape or not np.array_equal(cube.nm, first.nm):
            raise BadCapture(
                f"{file}: (H, W, bands) = {cube.values.shape}; allowed: {first.values.shape} with the wavelengths of "
                f"{found[0][0].name}; one camera, one size"
            )
        if (most := cube.values.max()) > full:
            raise BadCapture(f"{file}: values up to {most:g} DN do not fit {bits} bit; allowed: up to {full:g} DN")
        if bands is not None:
            cube, counts = _joined(cube, bands, str(source), full)
        cubes.append(_binned(cube, bin, str(file), full))
        rows.append((file, keyed(own, rename or {}, str(file))))
    if len(cubes[0].nm) > CHANNELS_MOST:
        raise BadCapture(
            f"{source}: {len(cubes[0].nm)} bands; allowed: up to {CHANNELS_MOST} channels; join bands: "
            f'bands = "{cubes[0].nm[0]:.0f}:{cubes[0].nm[-1]:.0f}:10"'
        )
    averaged = bin * bin * counts
    noise, top = None, full if np.isfinite(full) else float(max(c.values.max() for c in cubes))
    if system_gain is not None and dark_noise is not None:
        noise = Noise(system_gain / averaged, dark_noise / np.sqrt(averaged), black_level, top, 0.0)
    frames = framed(rows, [c.values for c in cubes], [c.mask for c in cubes])
    if noise is None and black_level:
        warnings.append(BLACK_LEVEL_LOST.format(black_level))
    if noise is None and not any(f.repeats for f in frames):
        warnings.append(
            "neither repeats nor system_gain and dark_noise: nothing says how large a residual may be; record two "
            "cubes or more at the same settings, or state the camera's numbers"
        )
    with new_folder(Path(folder), replace=overwrite) as temporary:
        captures = Captures(temporary, scene, frames, {}, noise, bands="auto")
        capture_sets.write(captures, temporary, bits=None)
        (temporary / SENSITIVITIES).write_text(_sensitivities(cubes[0], source.name), encoding="utf-8")
    warnings.append(f"channels are narrow bands: give the camera -D sensitivity={Path(folder) / SENSITIVITIES}")
    return Read(Path(folder), warnings)


def _check_output(folder: Path, overwrite: bool) -> None:
    """Refuse a folder that holds anything but what an import of cubes leaves."""
    if not folder.exists() or folder.is_dir() and not any(folder.iterdir()):
        return
    kept = not folder.is_dir() or {f.name for f in folder.iterdir()} - {capture_sets.FILE, "frames", SENSITIVITIES}
    if kept or not overwrite:
        raise OutputExists(
            f"{folder} exists and is not empty; choose another folder"
            + ("" if kept else ", or allow to overwrite what an import left there")
        )


# -- which files are which cubes -------------------------------------------------------------------------------------
def _found(source: Path, settings: Path | None) -> list:
    """(file, settings, f() -> Cube) of each cube of a source."""
    if not source.exists():
        raise BadCapture(f"{source}: no such file; allowed: an ENVI header (.hdr), a Spectral EXR, or a folder of them")
    if source.is_file():
        return [(source, {}, lambda: _cube(source))]
    kinds = {s: [f for f in source.iterdir() if f.suffix.lower() == s] for s in (".hdr", ".exr")}
    kind = next((s for s, files in kinds.items() if files), None)
    if kind is not None:
        rows = listed(source, settings) if settings is not None else named(source, (kind,))
        return [(file, own, lambda file=file: _cube(file)) for file, own in rows]
    rows = listed(source, settings) if settings is not None else named(source, NARROW)
    groups: dict[tuple, list[tuple[float, Path]]] = {}
    for file, own in rows:
        if not (word := NAMED.search(file.stem)):
            raise BadCapture(f"{file}: its name has no wavelength; allowed: one such as skin_550nm.tif in each name")
        groups.setdefault(tuple(sorted(own.items())), []).append((float(word[1].replace(",", ".")), file))
    return [(own[0][1], dict(key), lambda own=own: _narrow(sorted(own))) for key, own in groups.items()]


def _cube(file: Path) -> Cube:
    return read_envi(file) if file.suffix.lower() == ".hdr" else read_spectral_exr(file)


def _narrow(files: Sequence[tuple[float, Path]]) -> Cube:
    """The cube of grey images of one band each."""
    nm = np.array([n for n, _ in files])
    images, depths = [], set()
    for file in (f for _, f in files):
        image, bits = read_image(file, str(file))
        if image.shape[2] != 1 or images and image.shape != images[0].shape:
            raise BadCapture(
                f"{file}: (H, W, C) = {image.shape}; allowed: one channel"
                + (f", {images[0].shape[:2]} pixels as the others" if images else ", the light of one narrow band")
            )
        images.append(image)
        depths.add(bits)
    if len(depths) > 1:
        raise BadCapture(f"{files[0][1].parent}: images of 8 and of 16 bit: their DN differ; write all in one depth")
    bits = depths.pop()
    return _ordered(nm, np.concatenate(images, 2), None, 2**bits - 1 if bits else None, str(files[0][1].parent))


def read_spectral_exr(file: Path) -> Cube:
    """The bands of S0 of a Spectral EXR. Raises BadCapture."""
    try:
        channels, _ = exr.read(file)
        nm, values = exr.spectral_image({n: c for n, c in channels.items() if n.startswith("S0.")})
    except (FileNotFoundError, ValueError) as error:
        raise BadCapture(f"{file}: {error}; allowed: channels S0.550,000000nm ...") from error
    return _ordered(nm, values[..., 0], None, None, str(file))


def read_envi(file: Path) -> Cube:
    """An ENVI cube by its header. Raises BadCapture with the field and what is allowed."""
    fields = _envi_fields(file)
    if missing := [name for name in NEEDED if name not in fields]:
        raise BadCapture(f"{file}: {', '.join(missing)} missing; allowed: a header with {', '.join(NEEDED)}")
    width, height, count = (_whole(fields, name, file, 1) for name in ("samples", "lines", "bands"))
    code, order = _whole(fields, "data type", file), fields["interleave"].strip().lower()
    if code not in TYPES or order not in AXES:
        raise BadCapture(
            f"{file}: data type = {code}, interleave = {order}; allowed: types {', '.join(map(str, TYPES))} (real "
            f"numbers), interleave {', '.join(AXES)}"
        )
    if width * height > PIXELS_MOST:
        raise BadCapture(f"{file}: {height} x {width} pixels; allowed: up to {PIXELS_MOST:,}")
    kind = np.dtype((">" if _whole(fields, "byte order", file, 0, "0") else "<") + TYPES[code])
    nm, fwhm = _numbers(fields, "wavelength", file), _numbers(fields, "fwhm", file)
    unit = fields.get("wavelength units", "").strip().lower().rstrip("s")
    scale = {"nanometer": 1.0, "micrometer": 1e3, "micron": 1e3, "unknown": 1.0, "": 1.0, **LENGTHS}.get(unit)
    if scale is None:
        raise BadCapture(f"{file}: wavelength units = {unit}; allowed: nanometers, micrometers")
    if len(nm) != count or len(fwhm) not in (0, count):
        raise BadCapture(f"{file}: {len(nm)} wavelengths and {len(fwhm)} fwhm of {count} bands; allowed: one a band")
    if nm.max() * scale < 30:
        raise BadCapture(
            f"{file}: wavelengths up to {nm.max():g} nm are not light; allowed: wavelength units = micrometers, "
            "where they are such"
        )
    data = next((f for s in RAW if (f := file.with_suffix(s)).is_file()), None)
    if data is None:
        raise BadCapture(f"{file}: no raw file beside it; allowed: {file.stem} with one of {', '.join(RAW[1:])}")
    start, sizes = _whole(fields, "header offset", file, 0, "0"), {"H": height, "W": width, "B": count}
    expected = start + width * height * count * kind.itemsize
    if data.stat().st_size != expected:
        raise BadCapture(
            f"{data}: {data.stat().st_size} bytes; allowed: {expected} by the header ({height} x {width} pixels, "
            f"{count} bands, {kind.itemsize} bytes each{f', after {start}' if start else ''})"
        )
    axes = AXES[order]
    stored = np.fromfile(data, kind, offset=start).reshape([sizes[a] for a in axes])
    values = stored.transpose([axes.index(a) for a in "HWB"])
    whole = int(np.iinfo(kind).max) if kind.kind in "iu" else None
    bad = _numbers(fields, "data ignore value", file)
    mask = ~(values == bad[0]).any(2) if bad.size else None
    values = values if mask is None else np.where(mask[..., None], values, 0)
    return _ordered(nm * scale, values, fwhm * scale if fwhm.size else None, whole, str(file), mask)


def _envi_fields(file: Path) -> dict[str, str]:
    """Fields of a header by their names in lower case; lists in braces, which may go over lines, without these."""
    try:
        text = file.read_text(encoding="utf-8-sig", errors="replace")  # descriptions are written in any encoding
    except OSError as error:
        raise BadCapture(f"{file}: no ENVI header ({error})") from error
    if not text.lstrip().startswith("ENVI"):
        raise BadCapture(f"{file}: its first line is not ENVI; allowed: a header of the ENVI format")
    found = re.findall(r"^\s*([^=\n;]+?)\s*=\s*(\{[^}]*\}|[^\n]*)", text, re.M)
    return {name.lower(): value.strip().strip("{}").strip() for name, value in found}


def _whole(fields: Mapping[str, str], name: str, file: Path, least: int = 0, usual: str = "") -> int:
    text = fields.get(name, usual).strip()
    if not text.isdigit() or int(text) < least:
        raise BadCapture(f"{file}: {name} = {text}; allowed: a whole number, {least} or more")
    return int(text)


def _numbers(fields: Mapping[str, str], name: str, file: Path) -> np.ndarray:
    try:
        return np.array([float(word) for word in re.split(r"[,\s]+", fields.get(name, "")) if word])
    except ValueError:
        raise BadCapture(f"{file}: {name} = {fields[name][:40]}; allowed: numbers between commas") from None


# -- cubes -----------------------------------------------------------------------------------------------------------
def _ordered(nm, values, width, whole: int | None, where: str, mask: np.ndarray | None = None) -> Cube:
    """A checked cube, its bands ascending; without widths, the steps between neighbours."""
    order = np.argsort(nm, kind="stable")
    nm = np.asarray(nm, float)[order]
    if len(nm) < 2 or np.any(np.diff(nm) <= 0):
        twice = nm[:-1][np.diff(nm) <= 0]
        raise BadCapture(
            f"{where}: {len(nm)} bands" + (f", {twice[0]:g} nm twice" if twice.size else "") + "; allowed: two and "
            "more, each wavelength once; tell cubes apart by settings in their names, such as press_x=1__550nm.tif"
        )
    values = np.ascontiguousarray(np.asarray(values)[..., order], np.float32)
    if not np.isfinite(values).all():
        raise BadCapture(f"{where}: values that are NaN or infinite; allowed: finite ones; give them as the ENVI field "
                         "'data ignore value', and a finite number")  # fmt: skip
    return Cube(nm, values, np.gradient(nm) if width is None else np.asarray(width, float)[order], whole, mask)


def _joined(cube: Cube, bands: str, where: str, full: float = np.inf) -> tuple[Cube, int]:
    """Means of bands within half a step of each of a range, and the least number of bands in a mean."""
    try:
        centres, nodes = parse(bands, where)
    except BadScene as error:
        raise BadCapture(str(error)) from error
    if nodes is not None or len(centres) < 2:
        raise BadCapture(f"{where}: bands = {bands!r}; allowed: a range such as 400:700:10")
    nm = np.sort(np.array(centres))
    step = float(np.diff(nm).min())
    inside = [(cube.nm - n >= -step / 2 - 1e-9) & (cube.nm - n < step / 2 - 1e-9) for n in nm]
    if empty := [n for n, own in zip(nm, inside) if not own.any()]:
        raise BadCapture(
            f"{where}: bands = {bands!r}: none of the source's bands ({cube.nm[0]:g} to {cube.nm[-1]:g} nm) lies "
            f"within {step / 2:g} nm of {empty[0]:g} nm; allowed: a range that they cover"
        )
    values = np.stack([_mean(cube.values[..., own], -1, full) for own in inside], -1)
    middle = np.array([cube.nm[own].mean() for own in inside])
    # variance of what several bands see together: their own and that of their centres, as full widths
    spread = [np.sqrt((cube.width[own] ** 2).mean() + 8 * np.log(2) * cube.nm[own].var()) for own in inside]
    return replace(cube, nm=middle, values=values, width=np.array(spread)), min(int(own.sum()) for own in inside)


def _mean(values: np.ndarray, axes: int | tuple[int, ...], full: float) -> np.ndarray:
    """Means; saturated where one of the values is, since what that one would have been is not known."""
    return np.where((values >= full).any(axes), full, values.mean(axes)).astype(np.float32)


def _binned(cube: Cube, bin: int, where: str, full: float) -> Cube:
    height, width = (n // bin for n in cube.values.shape[:2])
    if not height or not width:
        raise BadCapture(f"{where}: bin = {bin} of {cube.values.shape[:2]} pixels; allowed: a block or more")
    if bin == 1:
        return cube
    blocks = [
        a[: height * bin, : width * bin].reshape(height, bin, width, bin, -1)
        for a in (cube.values, np.ones(cube.values.shape[:2]) if cube.mask is None else cube.mask)
    ]
    mask = None if cube.mask is None else blocks[1].all((1, 3))[..., 0]
    return replace(cube, values=_mean(blocks[0], (1, 3), full), mask=mask)


def _sensitivities(cube: Cube, source: str) -> str:
    """A table of what each channel sees, peak 1."""
    low, high = (cube.nm + s * WIDE * cube.width for s in (-1, 1))
    nm = np.arange(max(np.floor(low.min()), 1.0), np.ceil(high.max()) + STEP / 2, STEP)
    rows = np.column_stack([nm, *(gaussian(nm, n, w) for n, w in zip(cube.nm, cube.width))])
    rows[:, 1:][rows[:, 1:] < 1e-12] = 0.0
    head = f"# source: bands of {source}\nwavelength (nm)," + ",".join(f"{n:g} nm" for n in cube.nm)
    return "\n".join([head, *(",".join(f"{v:.6g}" for v in row) for row in rows)]) + "\n"
