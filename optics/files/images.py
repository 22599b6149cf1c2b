"""Camera images on disk, digital number for digital number: PNG and TIFF (8, 16 bit), EXR, NPY.

What alters or hides a DN is refused: JPEG, palettes, alpha channels, several pages, channels in front. Raises
BadCapture with the place, what is allowed and the next step."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from optics.errors import BadCapture
from optics.files import exr
from optics.files.output import replacing

SUFFIXES = (".png", ".tif", ".tiff", ".exr", ".npy")
CHANNELS_MOST = 64
PIXELS_MOST = 200_000_000  # of one image: beyond any camera, below what 32-bit sizes and a few GB hold


def read_image(file: Path, where: str) -> tuple[np.ndarray, int | None]:
    """(image (H, W, C) float32, bits: 8 or 16, None for floats and other integers); (H, W) becomes (H, W, 1)."""
    values = read_array(file, where)
    if values.dtype.kind not in "uif":
        raise BadCapture(
            f"{where}: values of type {values.dtype}; allowed: whole or real numbers; save DN as 8 or 16 bit"
        )
    values = values[..., None] if values.ndim == 2 else values
    if values.ndim != 3 or 0 in values.shape or values.shape[2] > CHANNELS_MOST:
        raise BadCapture(
            f"{where}: shape {values.shape}; allowed: (H, W) or (H, W, C), C <= {CHANNELS_MOST}, channels last"
        )
    with np.errstate(over="ignore"):  # what is beyond float32 becomes infinite and is refused as such
        image = np.ascontiguousarray(values, np.float32)
    if not np.isfinite(image).all():
        row, column, channel = np.argwhere(~np.isfinite(image))[0]
        raise BadCapture(
            f"{where}: {np.sum(~np.isfinite(image))} values are NaN or infinite, the first in row {row}, column "
            f"{column}, channel {channel}; allowed: finite DN; leave bad pixels out by a mask, not by NaN"
        )
    return image, 8 * values.dtype.itemsize if values.dtype in (np.uint8, np.uint16) else None


def read_mask(file: Path, shape: tuple[int, ...], where: str) -> np.ndarray:
    """(H, W) bool, True = use: where any channel of the file is not zero."""
    values = read_array(file, where)
    values = np.asarray(values.any(axis=2)) if values.ndim == 3 else values
    if values.shape != shape[:2]:
        raise BadCapture(f"{where}: (H, W) = {values.shape} pixels; allowed: {shape[:2]}, as the image")
    if values.dtype.kind not in "biuf" or not np.isfinite(values).all():
        raise BadCapture(f"{where}: values of type {values.dtype}, or not finite; allowed: 0 = leave out, else = use")
    if not values.any():
        raise BadCapture(
            f"{where}: empty, all is 0 and no pixel is used; allowed: non-zero = use; remove the mask to use all"
        )
    return values != 0


def read_array(file: Path, where: str) -> np.ndarray:
    """The file's array as it is, (H, W) or (H, W, C)."""
    reader = {".png": _png, ".tif": _tiff, ".tiff": _tiff, ".exr": _exr, ".npy": _npy}.get(file.suffix.lower())
    if reader is None:
        hint = "; JPEG alters every pixel: record PNG or raw" if file.suffix.lower() in (".jpg", ".jpeg") else ""
        raise BadCapture(f"{where}: '{file.suffix}' files are not read; allowed: {', '.join(SUFFIXES)}{hint}")
    if not file.exists():
        raise BadCapture(f"{where}: no such file; correct the name or add the file")
    if not file.is_file():  # a pipe or a device would be waited for, or never end
        raise BadCapture(f"{where}: a folder, a pipe or a device; allowed: a file; save the image as one")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's about large images: the limit here is stated
            return reader(file, where)
    except BadCapture:
        raise
    except MemoryError as error:
        raise BadCapture(f"{where}: not enough memory to read it ({error}); crop or bin the image") from error
    except Exception as error:  # decoders raise whatever they like on a damaged file
        raise BadCapture(
            f"{where}: unreadable as {file.suffix} ({type(error).__name__}: {error}); write it again"
        ) from error


def varied(image: np.ndarray, where: str) -> None:
    """Raises BadCapture for an image without any: all black, all saturated, or one value."""
    low, high = (image.min(), image.max()) if image.size else (0, 0)
    if low == high:
        what = "black" if low == 0 else f"{high:g} DN"
        raise BadCapture(
            f"{where}: every value is {what}; allowed: an image with some shading; record it with another exposure, or "
            "leave the file out"
        )


def _fits(shape: Sequence[int], where: str) -> None:
    if math.prod(shape[:2]) > PIXELS_MOST:
        raise BadCapture(
            f"{where}: {shape[0]} x {shape[1]} pixels; allowed: up to {PIXELS_MOST:,} pixels; crop or bin the image"
        )


def _png(file: Path, where: str) -> np.ndarray:
    from PIL import Image

    with file.open("rb") as begin:
        head = begin.read(26)
    if head[:2] == b"\xff\xd8":
        raise BadCapture(f"{where}: a JPEG by the name of .png; JPEG alters every pixel: record PNG or raw")
    if head[12:16] == b"IHDR":  # before Pillow, whose own limit says nothing of the file
        _fits((int.from_bytes(head[20:24], "big"), int.from_bytes(head[16:20], "big")), where)
    with Image.open(file, formats=["PNG"]) as image:
        depth, colour = head[24:]  # of the header chunk: bits per value, kind of colour
        if colour in (4, 6) or "transparency" in image.info:
            raise BadCapture(
                f"{where}: has an alpha channel; allowed: gray or RGB; remove it (a mask is a file of its own)"
            )
        if colour == 3 or depth not in (1, 8, 16):
            raise BadCapture(
                f"{where}: has a palette or {depth} bit; allowed: 8 or 16 bit gray or RGB; save it as such"
            )
        if getattr(image, "n_frames", 1) != 1:
            raise BadCapture(f"{where}: {image.n_frames} images in one file; allowed: one; one file per reading")
        if (depth, colour) != (16, 2):
            image.load()
            return np.asarray(image).astype({1: bool, 8: np.uint8, 16: np.uint16}[depth])
    import mitsuba as mi  # Pillow would cut 16 bit colour to 8 without a word

    return np.array(mi.Bitmap(str(file)))


def _tiff(file: Path, where: str) -> np.ndarray:
    import tifffile
    from PIL import Image

    with tifffile.TiffFile(file) as tiff:
        page = tiff.pages[0]
        if len(tiff.pages) != 1 or page.axes not in ("YX", "YXS", "SYX"):
            raise BadCapture(
                f"{where}: {len(tiff.pages)} pages of axes {page.axes}; allowed: one page; one file per reading"
            )
        _fits(page.shape if page.axes != "SYX" else page.shape[1:], where)
        if page.extrasamples:
            raise BadCapture(f"{where}: has an alpha or extra channel; allowed: gray or RGB; remove it")
        if page.photometric not in (1, 2):  # min-is-black, RGB
            raise BadCapture(
                f"{where}: colours are {page.photometric.name}; allowed: MINISBLACK or RGB; save it as such"
            )
        try:
            values = page.asarray()
        except ValueError:  # a compression that tifffile leaves to a package of its own, such as LZW
            with Image.open(file, formats=["TIFF"]) as image:
                values = np.asarray(image)
            if values.shape != page.shape or values.dtype != page.dtype:
                raise BadCapture(
                    f"{where}: {page.compression.name} compression of {page.dtype} is not read; allowed: "
                    "none or DEFLATE; save it again"
                ) from None
        return np.moveaxis(values, 0, -1) if page.axes == "SYX" else values


def _exr(file: Path, where: str) -> np.ndarray:
    channels, _ = exr.read(file)
    if "A" in channels:
        raise BadCapture(f"{where}: has an alpha channel; allowed: one channel, or R, G, B; remove it")
    names = list(channels) if len(channels) == 1 else ["R", "G", "B"]
    if set(names) != set(channels):
        raise BadCapture(
            f"{where}: channels {', '.join(channels)}; allowed: one channel, or R, G, B; use NPY for others"
        )
    return np.stack([channels[name] for name in names], -1)


def _npy(file: Path, where: str) -> np.ndarray:
    values = np.load(file, mmap_mode="r", allow_pickle=False)  # a header that says more than the file holds is refused
    if values.ndim > 1:
        _fits(values.shape, where)
    return np.array(values)


def write_image(stem: Path, image: np.ndarray, bits: int | None) -> Path:
    """Write (H, W, C): 8 or 16 bit PNG of whole numbers, or float32 EXR (bits = None); NPY where C is not 1 or 3."""
    image = np.asarray(image)
    if not np.isfinite(image).all():
        raise BadCapture(f"{stem.name}: NaN or infinite values; allowed: finite DN; use a mask")
    if bits is None:
        values, suffix = image.astype(np.float32), ".exr"
    else:
        if np.any(image != np.round(image)) or image.min() < 0 or image.max() > 2**bits - 1:
            raise BadCapture(
                f"{stem.name}: values {image.min():g} to {image.max():g} DN do not fit {bits} bit; allowed: whole "
                f"numbers 0 to {2**bits - 1}; use bits=None, or expose with a quantisation of 1 DN"
            )
        values, suffix = image.astype({8: np.uint8, 16: np.uint16}[bits]), ".png"
    count = image.shape[2]
    file = stem.parent / (stem.name + (suffix if count in (1, 3) else ".npy"))
    with replacing(file) as temporary:
        if count not in (1, 3):
            np.save(temporary, values, allow_pickle=False)
        elif bits is None:
            names = "RGB" if count == 3 else "Y"
            exr.write(temporary, {name: values[..., i] for i, name in enumerate(names)}, {"units": "DN"})
        elif bits == 16 and count == 3:
            import mitsuba as mi

            mi.Bitmap(np.ascontiguousarray(values)).write(str(temporary))
        else:
            from PIL import Image

            Image.fromarray(values if count == 3 else values[..., 0]).save(temporary)
    return file
