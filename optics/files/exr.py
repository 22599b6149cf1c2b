"""Images on disk: float32 EXR with spectral and Stokes channels, and 8-bit PNG previews.

Channels by name: `R`, `G`, `B` (preview, linear sRGB), `S0.525,000000nm` ... `S3.525,000000nm` (spectral radiance and
the other Stokes components per band; Fichet, Pacanowski & Wilkie, JCGT 10(3), 2021), and others such as `depth.Z`,
`normal.X`, `variance.R`. Images are (H, W), row 0 on top. Every file appears whole or not at all."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from optics.files.output import replacing

RESERVED = (
    "channels",
    "chunkCount",
    "compression",
    "dataWindow",
    "displayWindow",
    "lineOrder",
    "name",
    "pixelAspectRatio",
    "screenWindowCenter",
    "screenWindowWidth",
    "tiles",
    "type",
    "version",
)
SPECTRAL_NAME = re.compile(r"S([0-3])\.(\d+(?:,\d+)?)nm")


# -- EXR -------------------------------------------------------------------------------------------------------------
def write(
    path: str | Path,
    channels: Mapping[str, np.ndarray],
    header: Mapping[str, object] | None = None,
    half: Sequence[str] = (),
) -> Path:
    """Write channels, each (H, W), as float32 (those named in `half`: float16), ZIP-compressed without loss.

    header  text, numbers (kept as float32 by the format) or mappings (kept as JSON text: `provenance`, `units`)
    An existing file is replaced in one step. Raises ValueError on channels of two sizes, complex values, values beyond
    the range of their type, unknown names in `half`, reserved header names.
    """
    import OpenEXR

    path = Path(path)
    if not channels:
        raise ValueError(f"{path}: no channels to write; give at least one (H, W) array")
    unknown = sorted(set(half) - set(channels))
    if unknown:
        raise ValueError(f"{path}: half = {', '.join(unknown)}: no such channel; there are {', '.join(channels)}")
    shape, first = None, ""
    pixels = {}
    for name, values in channels.items():
        values = np.asarray(values)
        if not name or values.ndim != 2 or 0 in values.shape or values.dtype.kind not in "fiub":
            raise ValueError(
                f"{path}: channel '{name}' is {values.dtype} of shape {values.shape}; allowed: a name and "
                "real values of shape (H, W); split other arrays into one channel each"
            )
        shape, first = (shape, first) if shape else (values.shape, name)
        if values.shape != shape:
            raise ValueError(
                f"{path}: channel '{name}' has {values.shape} pixels, '{first}' {shape}; one file, one size"
            )
        pixels[name] = _narrowed(values, np.float16 if name in half else np.float32, f"{path}: channel '{name}'")
    attributes = {key: _attribute(path, key, value) for key, value in (header or {}).items()}
    with replacing(path) as file:
        OpenEXR.File(
            {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **attributes}, pixels
        ).write(str(file))
    return path


def read(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, str | float]]:
    """Read (channels as float32 (H, W) by name, header attributes that are text or numbers).

    Raises FileNotFoundError, and ValueError for a file that is no EXR, is damaged, has several parts, or whose pixels
    do not fill the image (its data window is not its display window).
    """
    import OpenEXR

    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        if not OpenEXR.isOpenExrFile(str(path)):
            raise ValueError("its first bytes are not those of an EXR")
        file = OpenEXR.File(str(path), separate_channels=True)
        channels = {name: np.ascontiguousarray(channel.pixels, np.float32) for name, channel in file.channels().items()}
        if len(file.parts) != 1:
            raise ValueError(f"it has {len(file.parts)} parts; allowed: 1; split it")
        data, display = (file.header().get(name) for name in ("dataWindow", "displayWindow"))
        if not np.array_equal(data, display):
            raise ValueError(
                f"its pixels are those of {_window(data)}, its image that of {_window(display)}; allowed: the same; "
                "crop or fill it"
            )
    except (RuntimeError, ValueError, TypeError) as error:
        raise ValueError(f"{path}: unreadable as EXR ({error})") from error
    header = {
        key: float(str(np.float32(value))) if isinstance(value, float) else value
        for key, value in file.header().items()
        if key not in RESERVED and isinstance(value, (str, int, float))
    }
    return channels, header


def _window(corners: Sequence[np.ndarray]) -> str:
    """Corners of a window as (first column, first row) to (last column, last row)."""
    return " to ".join(f"({x}, {y})" for x, y in corners)


def _narrowed(values: np.ndarray, dtype: type, where: str) -> np.ndarray:
    with np.errstate(over="ignore"):
        narrow: np.ndarray = np.ascontiguousarray(values, dtype)
    if np.any(np.isinf(narrow) & np.isfinite(values)):
        raise ValueError(
            f"{where}: values up to {np.nanmax(np.abs(values)):g} do not fit {np.dtype(dtype).name} "
            f"(at most {np.finfo(dtype).max:g}); take it out of `half` or scale it"
        )
    return narrow


def _attribute(path: Path, key: str, value: object) -> str | int | float:
    if key in RESERVED:
        raise ValueError(f"{path}: header '{key}' belongs to the format itself; choose another name")
    if isinstance(value, Mapping):
        return json.dumps(value, sort_keys=True)
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (str, int, float, np.integer, np.floating)):
        raise ValueError(f"{path}: header '{key}' = {value!r}; allowed: text, a number or a mapping")
    return value.item() if isinstance(value, np.generic) else value


# -- Spectra ---------------------------------------------------------------------------------------------------------
def spectral_name(band_nm: float, stokes: int = 0) -> str:
    """525 -> 'S0.525,000000nm' (the comma because EXR splits layer names at dots)."""
    return f"S{stokes}." + f"{band_nm:.6f}nm".replace(".", ",")


def spectral_channels(bands_nm: Sequence[float], stokes: np.ndarray) -> dict[str, np.ndarray]:
    """Channels of (H, W, B) radiance or (H, W, B, 4) Stokes vectors; bands in nm, one per entry of axis 2."""
    stokes = np.asarray(stokes)
    if stokes.ndim not in (3, 4) or stokes.shape[2] != len(bands_nm) or (stokes.ndim == 4 and stokes.shape[3] != 4):
        raise ValueError(
            f"spectral image of shape {stokes.shape}; allowed: (H, W, B) or (H, W, B, 4), B = {len(bands_nm)}"
        )
    if len({spectral_name(band) for band in bands_nm}) != len(bands_nm):
        raise ValueError(f"bands {list(bands_nm)} nm: two of them are the same to 1e-6 nm; join them")
    parts = stokes[..., None] if stokes.ndim == 3 else stokes
    return {spectral_name(band, s): parts[:, :, b, s] for s in range(parts.shape[3]) for b, band in enumerate(bands_nm)}


def spectral_image(channels: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The inverse: (bands in nm (B,), (H, W, B, 1 or 4)) of the spectral channels, others passed over."""
    found = {
        (int(m[1]), float(m[2].replace(",", "."))): values
        for name, values in channels.items()
        if (m := SPECTRAL_NAME.fullmatch(name))
    }
    bands = sorted({band for _, band in found})
    count = 1 + max((s for s, _ in found), default=-1)
    if count not in (1, 4) or len(found) != count * len(bands):
        raise ValueError(
            f"{len(found)} spectral channels: {len(bands)} bands, Stokes components up to S{count - 1}; "
            "allowed: the same bands in S0, or in S0 to S3"
        )
    return np.array(bands), np.stack([np.stack([found[s, band] for s in range(count)], -1) for band in bands], 2)


def spectral_header(polarized: bool, units: str = "W.m^-2.sr^-1") -> dict[str, str]:
    """Header attributes of the spectral layout: its version, the unit of S0, the handedness of the Stokes frame."""
    handed = {"polarisationHandedness": "right"} if polarized else {}
    return {"spectralLayoutVersion": "1.0", "emissiveUnits": units, **handed}


def preview_channels(bands_nm: Sequence[float], radiance: np.ndarray) -> dict[str, np.ndarray]:
    """R, G, B (linear sRGB, >= 0) of (H, W, B) radiance, scaled so that 1 in every band has luminance 1.

    Colour matching functions: Wyman, Sloan & Shirley, JCGT 2(2), 2013, multi-lobe fit; a preview, no colorimetry.
    """

    def lobe(mean: float, low: float, high: float) -> np.ndarray:  # nm
        return np.exp(-0.5 * ((bands - mean) / np.where(bands < mean, low, high)) ** 2)

    bands = np.asarray(bands_nm, float)
    x = 1.056 * lobe(599.8, 37.9, 31.0) + 0.362 * lobe(442.0, 16.0, 26.7) - 0.065 * lobe(501.1, 20.4, 26.2)
    y = 0.821 * lobe(568.8, 46.9, 40.5) + 0.286 * lobe(530.9, 16.3, 31.1)
    z = 1.217 * lobe(437.0, 11.8, 36.0) + 0.681 * lobe(459.0, 26.0, 13.8)
    to_srgb = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
    rgb = np.maximum(np.asarray(radiance) @ (to_srgb @ np.stack([x, y, z])).T / max(y.sum(), 1e-9), 0.0)
    return {name: rgb[..., i] for i, name in enumerate("RGB")}


# -- PNG -------------------------------------------------------------------------------------------------------------
def srgb(linear: np.ndarray) -> np.ndarray:
    """The display value of a linear one, both 0..1 (IEC 61966-2-1)."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def in_colours(image: np.ndarray) -> np.ndarray:
    """(H, W, 1 or 3) of an image (H, W, C) as it is shown: of more channels, which go up in wavelength, the means of
    the last, the middle and the first third; of two, their mean."""
    count = image.shape[2]
    if count in (1, 3):
        return image
    if count < 3:
        return image.mean(2, keepdims=True)
    return np.stack([part.mean(2) for part in np.array_split(image, 3, axis=2)[::-1]], -1)


def write_png(path: str | Path, image: np.ndarray, *, white: float = 1.0, tone: str = "srgb") -> Path:
    """An 8-bit preview of (H, W) or (H, W, C): `white` becomes 255, what lies beyond is clipped; see `in_colours`.

    tone  'srgb' for linear radiance; 'linear' for values that are shown as they are, such as DN (white=255)
    """
    from PIL import Image

    image = np.asarray(image, float)
    image = in_colours(image) if image.ndim == 3 else image
    image = image[..., 0] if image.ndim == 3 and image.shape[2] == 1 else image
    if tone not in ("srgb", "linear") or not white > 0:
        raise ValueError(f"{path}: tone = {tone!r}, white = {white}; allowed: 'srgb' or 'linear', white > 0")
    if image.ndim != 2 and image.shape[2:] != (3,):
        raise ValueError(f"{path}: image of shape {image.shape}; allowed: (H, W) or (H, W, C)")
    if not np.isfinite(image).all():
        raise ValueError(f"{path}: {np.sum(~np.isfinite(image))} values are not finite; replace them before a preview")
    shown = srgb(image / white) if tone == "srgb" else np.clip(image / white, 0.0, 1.0)
    with replacing(Path(path)) as file:
        Image.fromarray(np.round(255 * shown).astype(np.uint8)).save(file, format="PNG")
    return Path(path)
