"""Import of 9DTact's calibration folders: a translucent gel over a dark coat, lit by white LEDs, pressed by one ball.

    import_translucent("calibration/sensor_1", "captures/translucent", bin=5)

What comes in: `sensor_N` with `depth_calibration` (the untouched sensor and a ball press, raw and rectified) and
`camera_calibration` (the rectification maps and the scale); beside it or up to three folders above, `shape_config.yaml`
(the ball's radius) and `led_pcb_positions.csv` (where the LEDs stand on their board). What goes out is what
`optics.captures.importing` writes: the press as a frame with a mask, the untouched sensor as its flat field.

Derived, not measured, and said so:
    press      the circle on which the darkening has fallen to EDGE of its largest, along rays from its middle
    depth      R - sqrt(R^2 - a^2), R the ball's radius and a the circle's: there the face crosses its untouched height
    noise      second differences of neighbours LAG px apart, of image over flat field, beyond CLEAR circle radii; it
               counts the flat field's noise as well, which is as large
    gain       of each channel: mean of the press over that of the flat field, beyond FAR circle radii
    lights     at the places of their board, whose distance and turn about the camera are assumed; else on a ring"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from optics.captures.capture_set import Frame
from optics.captures.corrections import (
    DRIFTED,
    at_black,
    black_levels,
    black_text,
    correction,
    drift_text,
    sentences,
)
from optics.captures.importing import (
    FAR,
    GEL_MARGIN,
    STEEPEST,
    Imported,
    comment,
    depth_of,
    filled,
    noise_of_channels,
    write_set,
)
from optics.captures.noise import SATURATED, Noise
from optics.errors import BadCapture
from optics.files import yaml_checks
from optics.files.images import read_image, varied
from optics.files.output import shipped

DEPTH, CAMERA = "depth_calibration", "camera_calibration"
CONFIG, BOARD = "shape_config.yaml", "led_pcb_positions.csv"
ABOVE = 3  # folders above the sensor's in which the configuration and the board are looked for
AVERAGED = 10  # frames that the authors' program averages and cuts to whole DN
EDGE = 0.05  # of the largest darkening: where a contact ends
RAYS, RAYS_LEAST = 72, 36  # from a contact's middle, and those that must cross its edge
CLEAR = 2.0  # circle radii beyond which the press varies slowly from pixel to pixel
LAG = 4  # px: nearer neighbours share noise
LEVELS = 12
CUT = 5.0  # standard deviations: of noise alone one value in 2e6 is beyond
SPECK = 6.0  # standard deviations; noise alone reaches it in one of 5e8 values
AROUND = 9  # px, of the median that a value is held against
THICKNESS = 2.5  # mm of the gel, as the mould's plate in the sensor's drawings
DISTANCE = 20.0  # mm from the camera to the face
LED_HEIGHT = 15.0  # mm from the face to the LEDs' board
RING = 10.0  # mm: radius of the ring, where no board is given
LEDS = 8
HAZE, COAT = 0.1, 0.005  # 1/mm; reflectance: most of the light comes from the gel
ALIKE = 0.1  # relative: depths that differ by more are a contradiction


@dataclass
class Press:
    """A ball press as rectified images (H, W, 3) in DN, and what the folder says about it.

    missing   (H, W) bool: pixels that show no raw pixel, or one that another pixel shows as well
    earlier   a further image of the untouched sensor, or None
    table     mm, the authors' depth by darkening in DN, or None
    files     the configuration and the board's table that were found, by name"""

    source: str
    untouched: np.ndarray
    pressed: np.ndarray
    missing: np.ndarray
    earlier: np.ndarray | None
    table: np.ndarray | None
    mm_per_pixel: float
    ball_radius: float
    leds: np.ndarray | None
    remarks: list[str]
    files: dict[str, str]


@dataclass(frozen=True)
class Circle:
    """x, y, radius in px, pixel centres at +0.5; rms: px by which the edge misses it; darkening: DN, the largest."""

    x: float
    y: float
    radius: float
    rms: float
    darkening: float


def is_translucent_source(source: Path) -> bool:
    """Whether a folder is a sensor's calibration, or holds one."""
    return source.is_dir() and bool((source / DEPTH).is_dir() or any(source.glob(f"sensor_*/{DEPTH}")))


# -- reading ---------------------------------------------------------------------------------------------------------
def read_press(source: Path, ball_radius: float | None = None, mm_per_pixel: float | None = None) -> Press:
    """A sensor's calibration folder; options stand above its files. Raises BadCapture with the file and the next
    step."""
    folder = _sensor(source)
    config, config_file = _config(folder)
    if ball_radius is None:
        ball_radius = _number(config.get("depth_calibration"), "BallRad", config_file)
        if ball_radius is None:
            raise BadCapture(
                f"{folder}: no {CONFIG} with depth_calibration: BallRad (mm) in it or up to {ABOVE} folders above; "
                "give --ball-radius"
            )
    maps, origin, scale = _maps(folder, config, config_file)
    if mm_per_pixel is None:
        if scale is None:
            raise BadCapture(f"{folder / CAMERA / 'position_scale.npy'}: no such file; give --mm-per-pixel")
        mm_per_pixel = scale
    for name, value in (("ball radius", ball_radius), ("mm per pixel", mm_per_pixel)):
        if not (math.isfinite(value) and value > 0):
            raise BadCapture(f"{folder}: {name} = {value:g} mm; allowed: above 0")
    remarks: list[str] = []
    untouched, pressed = (_rectified(folder, name, maps, origin, remarks) for name in ("ref", "sample"))
    if untouched.shape != pressed.shape:
        raise BadCapture(
            f"{folder / DEPTH}: ref {untouched.shape} and sample {pressed.shape} (H, W, C) differ; allowed: one size"
        )
    missing = np.zeros(untouched.shape[:2], bool)
    earlier = None
    if maps is not None and origin is not None:
        shown = _crop(maps[0] * 100_000 + maps[1], origin, untouched.shape)
        _, first, count = np.unique(shown, return_index=True, return_counts=True)
        missing = np.ones(shown.size, bool)
        missing[first] = False
        missing = missing.reshape(shown.shape) | (shown == 0)
        if (folder / CAMERA / "ref.png").is_file():
            earlier = _crop(_raw(folder / CAMERA / "ref.png", maps[0].shape)[maps], origin, untouched.shape)
    table_file = folder / DEPTH / "Pixel_to_Depth.npy"
    table = _array(table_file) if table_file.is_file() else None
    if table is not None and (table.ndim != 1 or not table.size or not np.isfinite(table).all()):
        raise BadCapture(f"{table_file}: shape {table.shape}; allowed: (N,) finite depths in mm, by darkening in DN")
    leds = _board(folder)
    files = {name: str(file) for name in (CONFIG, BOARD) if (file := _near(folder, name)) is not None}
    return Press(
        str(folder), untouched, pressed, missing, earlier, table, mm_per_pixel, ball_radius, leds, remarks, files
    )


def _sensor(source: Path) -> Path:
    if (source / DEPTH).is_dir():
        return source
    found = sorted(p.parent for p in source.glob(f"sensor_*/{DEPTH}") if p.is_dir())
    if len(found) == 1:
        return found[0]
    if not found:
        raise BadCapture(f"{source}: holds no {DEPTH}; give the folder sensor_N of a 9DTact calibration")
    raise BadCapture(
        f"{source}: holds {len(found)} sensors ({', '.join(p.name for p in found)}), which are cameras of their own; "
        "give one of them"
    )


def _near(folder: Path, name: str) -> Path | None:
    """A file in a folder, or in one of the ABOVE folders that it lies in."""
    places = [folder, *folder.resolve().parents[:ABOVE]]
    return next((place / name for place in places if (place / name).is_file()), None)


def _config(folder: Path) -> tuple[Mapping, Path]:
    file = _near(folder, CONFIG)
    if file is None:
        return {}, folder / CONFIG
    data = yaml_checks.parse(file)
    if not isinstance(data, dict):
        raise BadCapture(f"{file}: {type(data).__name__}; allowed: keys and values")
    return data, file


def _number(table: Any, key: str, file: Path) -> float | None:
    known = isinstance(table, dict) and table.get(key) is not None
    return yaml_checks.number(table, key, file) if known else None


def _array(file: Path) -> np.ndarray:
    try:
        values = np.load(file, allow_pickle=False)
    except Exception as error:  # numpy raises whatever it finds
        raise BadCapture(
            f"{file}: cannot be read as .npy without pickles ({type(error).__name__}: {error}); save it with numpy.save"
        ) from error
    if values.dtype.kind not in "uif":
        raise BadCapture(f"{file}: values of type {values.dtype}; allowed: numbers")
    return values


def _maps(
    folder: Path, config: Mapping, config_file: Path
) -> tuple[tuple[np.ndarray, np.ndarray] | None, tuple[int, int, int, int] | None, float | None]:
    """((row, column) of the raw pixel that each rectified one shows, (top, left, height, width) of the crop, mm/px)."""
    place = folder / CAMERA
    position = place / "position_scale.npy"
    origin, scale = None, None
    if position.is_file():
        values = _array(position)
        if values.shape != (3,) or not np.isfinite(values).all() or values[2] <= 0:
            raise BadCapture(f"{position}: {values.tolist()}; allowed: row, column (px), mm per pixel above 0")
        camera = config.get("camera_calibration")
        size = camera.get("crop_size", [345, 460]) if isinstance(camera, dict) else [345, 460]
        if not isinstance(size, list) or len(size) != 2 or not all(isinstance(n, int) and n > 0 for n in size):
            raise BadCapture(
                f"{config_file}: crop_size = {size!r}; allowed: two whole numbers above 0, rows and columns"
            )
        corner = [int(middle - n / 2) for middle, n in zip(values[:2], size)]
        origin, scale = (*corner, *size), float(values[2])
    files = [place / f"{name}_index.npy" for name in ("row", "col")]
    if not all(file.is_file() for file in files):
        return None, origin, scale
    rows, columns = (_array(file) for file in files)
    if rows.shape != columns.shape or rows.ndim != 2 or rows.dtype.kind not in "ui" or columns.dtype.kind not in "ui":
        raise BadCapture(
            f"{files[0]}, {files[1].name}: shapes {rows.shape}, {columns.shape}, types {rows.dtype}, {columns.dtype}; "
            "allowed: two (H, W) arrays of whole numbers"
        )
    if min(rows.min(), columns.min()) < 0:
        raise BadCapture(f"{files[0]}, {files[1].name}: negative; allowed: rows and columns of the raw image, from 0")
    return (rows, columns), origin, scale


def _raw(file: Path, maps_shape: tuple[int, ...]) -> np.ndarray:
    image, _ = read_image(file, str(file))
    varied(image, str(file))
    if image.shape != (*maps_shape, 3):
        raise BadCapture(f"{file}: (H, W, C) = {image.shape}; allowed: {(*maps_shape, 3)}, as the rectification maps")
    return image.astype(np.float64)


def _crop(image: np.ndarray, origin: tuple[int, int, int, int], shape: tuple[int, ...]) -> np.ndarray:
    top, left = origin[:2]
    cut = image[top : top + shape[0], left : left + shape[1]]
    if cut.shape[:2] != shape[:2]:
        raise BadCapture(
            f"position_scale.npy: a crop of {shape[0]} x {shape[1]} px at row {top}, column {left} leaves the maps of "
            f"{image.shape[0]} x {image.shape[1]} px; allowed: one that lies inside"
        )
    return cut


def _rectified(folder: Path, name: str, maps, origin, remarks: list[str]) -> np.ndarray:
    """rectify_crop_`name`.png, held against the raw image; made from that one where it is missing."""
    file, raw = folder / DEPTH / f"rectify_crop_{name}.png", folder / DEPTH / f"{name}.png"
    made = None
    if raw.is_file() and maps is not None and origin is not None:
        image = _raw(raw, maps[0].shape)
        if maps[0].max() >= image.shape[0] or maps[1].max() >= image.shape[1]:
            raise BadCapture(
                f"{folder / CAMERA}: row_index to {maps[0].max()}, col_index to {maps[1].max()}; allowed: inside the "
                f"raw image of {image.shape[0]} rows and {image.shape[1]} columns"
            )
        made = image[maps]
    if not file.is_file():
        if made is None:
            raise BadCapture(
                f"{file}: no such file, and {raw.name} with row_index, col_index and position_scale.npy is not "
                "complete; give either"
            )
        remarks.append(f"{file.name} is missing: made from {raw.name} by the rectification maps")
        return _crop(made, origin, origin[2:])
    image, _ = read_image(file, str(file))
    varied(image, str(file))
    if image.shape[2] != 3:
        raise BadCapture(f"{file}: {image.shape[2]} channels; allowed: 3, a colour image")
    if made is not None and np.any(_crop(made, origin, image.shape) != image):
        apart = np.abs(_crop(made, origin, image.shape) - image)
        remarks.append(
            f"{file.name} is not {raw.name} by the rectification maps: {np.mean(apart.max(-1) > 0):.1%} of the pixels "
            f"differ, by up to {apart.max():g} DN; {file.name} is used"
        )
    return image.astype(np.float64)


def _board(folder: Path) -> np.ndarray | None:
    """(N, 2) mm: LEDs of the board about its middle, x right and y up; None without a table."""
    file = _near(folder, BOARD)
    if file is None:
        return None
    places = []
    with file.open(newline="", encoding="utf-8-sig") as stream:
        for line, row in enumerate(csv.DictReader(stream), 2):
            try:
                place = [float(row[key]) for key in ("x_mm", "y_mm")]
            except (KeyError, TypeError, ValueError) as error:
                raise BadCapture(f"{file}: line {line}: {error}; needed: x_mm and y_mm, numbers in mm") from error
            if not np.isfinite(place).all():
                raise BadCapture(f"{file}: line {line}: x_mm, y_mm = {place}; allowed: finite numbers in mm")
            places.append(place)
    if len(places) < 3:
        raise BadCapture(f"{file}: {len(places)} LEDs; needed: 3 or more, one a line")
    found = np.array(places)
    return found - (found.min(0) + found.max(0)) / 2


# -- deriving --------------------------------------------------------------------------------------------------------
def contact_circle(darkening: np.ndarray, sd: float, where: str) -> Circle:
    """The circle on which a dark contact ends, by a least-squares fit to where RAYS rays fall to EDGE of the largest
    darkening. darkening (H, W) DN, untouched less pressed; sd: DN, its noise. Raises BadCapture where there is none."""
    from scipy.ndimage import gaussian_filter, label, map_coordinates

    smooth = gaussian_filter(darkening, 1.5)
    peak = float(np.percentile(smooth, 99.9))
    if peak < 10 * sd:
        raise BadCapture(
            f"{where}: the press is {peak:.2g} DN darker than the untouched sensor where it is darkest, noise {sd:.2g} "
            "DN; needed: a contact of ten times the noise; check that ref and sample are not exchanged"
        )
    parts, _ = label(smooth > peak / 2)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    y, x = (float(v.mean()) for v in np.nonzero(parts == sizes.argmax()))
    reach = np.arange(0.0, math.hypot(*darkening.shape), 0.5)
    angles = np.linspace(0, 2 * np.pi, RAYS, endpoint=False)
    radius, rms = 0.0, 0.0
    for _ in range(3):  # from a better middle, rays meet the edge squarely
        u, v = x + np.outer(np.cos(angles), reach), y + np.outer(np.sin(angles), reach)
        # beyond the image infinity, so that no ray ends there
        values = map_coordinates(smooth, [v, u], order=1, mode="constant", cval=np.inf)
        below = values < EDGE * peak
        hit = below.any(1)
        if hit.sum() < RAYS_LEAST:
            raise BadCapture(
                f"{where}: {int(hit.sum())} of {RAYS} rays from ({x:.0f}, {y:.0f}) px meet the contact's edge inside "
                f"the image; needed: {RAYS_LEAST}; press nearer to the middle"
            )
        index = below.argmax(1)[hit]
        rows = np.arange(RAYS)[hit]
        inner, outer = values[rows, index - 1], values[rows, index]
        at = reach[index - 1] + (inner - EDGE * peak) / (inner - outer) * 0.5
        px, py = x + at * np.cos(angles[hit]), y + at * np.sin(angles[hit])
        (a, b, c), *_ = np.linalg.lstsq(np.column_stack([2 * px, 2 * py, np.ones_like(px)]), px**2 + py**2, rcond=None)
        x, y, radius = float(a), float(b), math.sqrt(c + a * a + b * b)
        rms = float(np.sqrt(np.mean((np.hypot(px - x, py - y) - radius) ** 2)))
    return Circle(x + 0.5, y + 0.5, radius, rms, peak)


def far_neighbour_noise(
    pressed: np.ndarray, untouched: np.ndarray, far: np.ndarray, saturation: float, lag: int = LAG, step: float = 1.0
) -> tuple[Noise, list[dict]]:
    """Noise of a frame over a flat field: second differences of values `lag` px apart along rows, two thirds of their
    squares, against the flat field's level; and per channel.

    step   DN, of the quantisation: its step^2/12 is taken off, as a Noise adds it again; 0 where values are means"""
    use = far[:, : -2 * lag] & far[:, lag:-lag] & far[:, 2 * lag :]
    level = untouched[:, lag:-lag]
    use = use & (level.max(-1) < 0.9 * saturation)
    if use.sum() < 50 * LEVELS:
        raise BadCapture(
            f"{int(use.sum())} pixels of the image lie beyond {CLEAR:g} radii of the contact, {50 * LEVELS} needed to "
            "estimate the noise; press less deep, or take a smaller bin"
        )
    ratio = pressed / np.maximum(untouched, 1.0)
    apart = (ratio[:, lag:-lag] - (ratio[:, : -2 * lag] + ratio[:, 2 * lag :]) / 2) * level
    light, square = level[use], apart[use] ** 2 / 1.5
    channels: list[dict] = []
    laws: list[list[tuple]] = []
    for c in range(light.shape[1]):
        # a mean without dust; a median of whole numbers would be one of few values
        kept = square[:, c] <= CUT**2 * square[:, c].mean()
        order = np.flatnonzero(kept)[np.argsort(light[kept, c], kind="stable")]
        groups = [(light[g, c].mean(), square[g, c].mean(), len(g)) for g in np.array_split(order, LEVELS)]
        laws.append(groups)
        channels.append(
            {"channel": "rgb"[c], "signal": float(light[kept, c].mean()), "sd": math.sqrt(square[kept, c].mean())}
        )
    return noise_of_channels(laws, channels, saturation, step), channels


def specks(pressed: np.ndarray, untouched: np.ndarray, noise: Noise) -> np.ndarray:
    """(H, W) bool: dust and glints, by SPECK standard deviations of image over flat field from the median around, in
    any channel."""
    from scipy.ndimage import median_filter

    ratio = pressed / np.maximum(untouched, 1.0)
    apart = np.abs(ratio - median_filter(ratio, (AROUND, AROUND, 1)))
    spread = np.median(apart, (0, 1)) / 0.6745  # of a Gaussian, its standard deviation
    sd = noise.sd(untouched) / np.maximum(untouched, 1.0)
    return (apart > SPECK * np.maximum(sd, spread)).any(-1)


def ring_of(leds: np.ndarray | None) -> np.ndarray:
    """(N, 2) mm of LEDs: the board's, or LEDS on a ring of RING mm."""
    if leds is not None:
        return leds
    angles = 2 * np.pi * np.arange(LEDS) / LEDS
    return RING * np.column_stack([np.cos(angles), np.sin(angles)])


def unlike_when_turned(leds: np.ndarray) -> float:
    """mm by which LEDs miss themselves when the board is turned by half or mirrored: how far its turn matters."""
    worst = 0.0
    for sign in ((-1, -1), (1, -1), (-1, 1)):
        apart = np.linalg.norm(leds[:, None] - leds[None] * sign, axis=-1).min(1)
        worst = max(worst, float(apart.max()))
    return worst


# -- importing -------------------------------------------------------------------------------------------------------
def import_translucent(
    source: str | Path,
    folder: str | Path,
    *,
    ball_radius: float | None = None,
    mm_per_pixel: float | None = None,
    camera_distance: float = DISTANCE,
    gel_thickness: float = THICKNESS,
    led_height: float = LED_HEIGHT,
    bin: int = 1,
    saturation: float = 255.0,
    overwrite: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
) -> Imported:
    """Write a 9DTact calibration folder as a capture set with its scene; see the module's text for what is derived.

    ball_radius, mm_per_pixel   mm; None: as the folder's files say
    camera_distance, led_height mm from the untouched face to the camera and to the LEDs' board
    bin   pixels per side that are averaged into one; rows and columns that fill no block are left out on both sides
    Raises BadCapture, OutputExists."""
    lengths = {
        "camera_distance": camera_distance,
        "gel_thickness": gel_thickness,
        "led_height": led_height,
        "saturation": saturation,
    }
    for name, value in lengths.items():
        if not (math.isfinite(value) and value > 0):
            raise BadCapture(f"{source}: {name} = {value:g}; allowed: above 0")
    tick = progress or (lambda *_: None)
    tick("import", 0, 3)
    press = read_press(Path(source), ball_radius, mm_per_pixel)
    height, width = press.untouched.shape[:2]
    if not 1 <= int(bin) == bin <= min(height, width) // 32:
        raise BadCapture(f"{source}: bin = {bin}; allowed: whole numbers from 1 to {min(height, width) // 32}")
    black = black_levels([press.untouched, press.pressed])
    cut = at_black(press.untouched, black) | at_black(press.pressed, black)
    circle = contact_circle((press.untouched - press.pressed).mean(-1), _rough_sd(press), press.source)
    tick("import", 1, 3)
    noise_full, _ = far_neighbour_noise(press.pressed, press.untouched, _beyond(circle, press, CLEAR), saturation)
    speck = specks(press.pressed, press.untouched, noise_full)
    bad = speck | cut.any(-1) | (press.untouched >= SATURATED * saturation).any(-1)
    bad = bad | press.missing if bin == 1 else bad  # blocks of pixels that share a raw one share little
    untouched, pressed = (filled(image, bin, saturation) for image in (press.untouched, press.pressed))
    mask = filled(bad[..., None].astype(float), bin)[..., 0] == 0
    circle_binned = _in_blocks(circle, press.untouched.shape, bin)
    scale = press.mm_per_pixel * bin
    far = ~_near_circle(untouched.shape, circle_binned, CLEAR) & mask
    step = 1.0 if bin == 1 else 0.0
    noise, levels = far_neighbour_noise(pressed, untouched, far, saturation, max(1, LAG // bin), step)
    gain = _gain(pressed, untouched, ~_near_circle(untouched.shape, circle_binned, FAR) & mask)
    touched = min(circle.radius * press.mm_per_pixel, STEEPEST * press.ball_radius)
    depth = depth_of(touched, press.ball_radius, 0.0)
    middle = untouched.shape[1] / 2, untouched.shape[0] / 2
    settings = {
        "gel.press_x": (circle_binned.x - middle[0]) * scale,
        "gel.press_y": (circle_binned.y - middle[1]) * scale,
        "gel.press_depth": depth,
        **{f"camera.gain_{c}": g for c, g in zip("rgb", gain)},
    }
    settings = {key: round(float(value), 6) for key, value in settings.items()}
    frame = Frame("press", pressed.astype(np.float32), mask, "press", settings)
    leds = ring_of(press.leds)
    corrections = _corrections(press, speck, cut, black, bad, gain, bin)
    facts: dict[str, Any] = {
        "source": press.source,
        "files": press.files,
        "presses": 1,
        "size_px": list(untouched.shape[:2]),
        "bin": bin,
        "ball_radius_mm": press.ball_radius,
        "mm_per_pixel": press.mm_per_pixel,
        "mm_per_pixel_after_binning": scale,
        "camera_distance_mm": camera_distance,
        "gel_thickness_mm": gel_thickness,
        "led_height_mm": led_height,
        "x_fov_deg": math.degrees(2 * math.atan(untouched.shape[1] * scale / 2 / camera_distance)),
        "contact": {
            "x_mm": settings["gel.press_x"],
            "y_mm": settings["gel.press_y"],
            "radius_mm": circle.radius * press.mm_per_pixel,
            "edge_off_rms_mm": circle.rms * press.mm_per_pixel,
            "depth_mm": depth,
            "darkening_dn": circle.darkening,
        },
        "circles_px": [[round(v, 4) for v in (circle_binned.x, circle_binned.y, circle_binned.radius)]],
        "leds_mm": [[round(float(v), 4) for v in place] for place in leds],
        "leds_from": BOARD if press.leds is not None else "assumed",
        "background": "given",
        "frame_gain": [[round(float(g), 5) for g in gain]],
        "noise": {
            "system_gain": noise.written("system_gain"),
            "dark_noise": noise.written("dark_noise"),
            "levels": levels,
            "how": f"second differences of pixels {max(1, LAG // bin)} px apart, of the press over the untouched "
            f"sensor beyond {CLEAR:g} circle radii: the noise of both images",
        },
        "corrections": corrections,
        "setup": {
            "free": ["membrane.rho_?"],  # haze and coat make one ratio: one of them is held
            "per_group": ["gel.press_x", "gel.press_y", "gel.press_depth"],
            "flat_field": "multiplicative",
            "priors": {
                "gel.press_[xy]": [None, 0.1],
                "gel.press_depth": [None, 0.2 * depth],
                "membrane.rho_?": [None, COAT],
            },
        },
    }
    facts["warnings"] = _warnings(press, circle, depth, touched, gain, black, cut, untouched, pressed, leds)
    tick("import", 2, 3)
    path = write_set(
        Path(folder),
        [frame],
        noise,
        untouched,
        _scene(facts, leds, untouched.mean((0, 1)), press.leds is not None),
        facts,
        bits=8 if bin == 1 else None,
        overwrite=overwrite,
        text=readme(facts),
    )
    tick("import", 3, 3)
    return Imported(path, facts["warnings"], facts)


def _rough_sd(press: Press) -> float:
    """DN: noise of the darkening, by neighbours along rows, before the contact is known."""
    apart = np.diff((press.untouched - press.pressed).mean(-1), axis=1)
    return float(np.median(np.abs(apart))) / 0.6745 / math.sqrt(2) + 1e-3


def _near_circle(shape: Sequence[int], circle: Circle, radii: float) -> np.ndarray:
    v, u = np.mgrid[: shape[0], : shape[1]] + 0.5
    return np.hypot(u - circle.x, v - circle.y) < radii * circle.radius


def _beyond(circle: Circle, press: Press, radii: float) -> np.ndarray:
    return ~_near_circle(press.untouched.shape, circle, radii) & ~press.missing


def _in_blocks(circle: Circle, shape: Sequence[int], bin: int) -> Circle:
    """The circle in the pixels of blocks, of the middle of the image that they fill."""
    top, left = ((n - n // bin * bin) // 2 for n in shape[:2])
    return Circle(
        (circle.x - left) / bin, (circle.y - top) / bin, circle.radius / bin, circle.rms / bin, circle.darkening
    )


def _gain(pressed: np.ndarray, untouched: np.ndarray, far: np.ndarray) -> np.ndarray:
    """(C,) mean of the press over that of the untouched sensor, 1 where the contact leaves no part of the image alone.

    A median would be one of few values, as the noise is less than the step of 1 DN."""
    return pressed[far].mean(0) / untouched[far].mean(0) if far.sum() >= 50 else np.ones(pressed.shape[-1])


def _corrections(press: Press, speck, cut, black, bad, gain, bin: int) -> list[dict[str, str]]:
    found = [
        correction(
            "brightness of the press far from the contact, set as camera.gain_r, gain_g, gain_b",
            " / ".join(f"{100 * (g - 1):+.2f}" for g in gain) + " % of the untouched sensor",
            f"beyond {FAR:g} circle radii; values stay as they are",
        )
    ]
    if press.missing.any() and bin == 1:
        found.append(
            correction(
                "rectified pixels that repeat a raw pixel are masked",
                f"{int(press.missing.sum())} pixels, {press.missing.mean():.2%}",
                "all channels of the press",
            )
        )
    if speck.any():
        found.append(
            correction(
                "dust and glints are masked",
                f"{int(speck.sum())} pixels, {speck.mean():.2%}",
                "all channels of the press",
            )
        )
    if cut.any():
        found.append(black_text(black, cut.mean((0, 1)).tolist())[1])
    return found


def _warnings(press: Press, circle: Circle, depth, touched, gain, black, cut, untouched, pressed, leds) -> list[str]:
    found = list(press.remarks)
    radius = circle.radius * press.mm_per_pixel
    if radius > STEEPEST * press.ball_radius:
        found.append(
            f"the contact's circle of {radius:.2f} mm is larger than {STEEPEST:.0%} of the ball's radius, "
            f"{press.ball_radius:g} mm: the scale or the ball is wrong, or the circle holds the dent's skirt; depth "
            f"taken from {touched:.2f} mm"
        )
    if circle.rms > 0.05 * circle.radius:
        found.append(
            f"the contact's edge misses a circle by {circle.rms * press.mm_per_pixel:.2g} mm rms, "
            f"{circle.rms / circle.radius:.0%} of its radius"
        )
    if press.table is not None and abs(press.table.max() / depth - 1) > ALIKE:
        found.append(
            f"the authors' table of depths reaches {press.table.max():.2f} mm, the contact's circle says {depth:.2f} mm"
        )
    drift = drift_text(gain[None], ["press"])
    if drift:
        found.append(f"{drift}; a press that takes light away everywhere looks the same")
    if press.earlier is not None:
        shift = np.median(press.earlier / np.maximum(press.untouched, 5.0), (0, 1)) - 1
        if np.abs(shift).max() > DRIFTED:
            found.append(
                "the untouched sensor changed between the two calibrations: "
                f"{' / '.join(f'{100 * s:+.2g}' for s in shift)} % brighter in {CAMERA}/ref.png; not used"
            )
    bulge = float(np.max((pressed / np.maximum(untouched, 5.0)).mean(-1)) - 1)
    if bulge > 0.02:
        found.append(
            f"around the contact the image is up to {bulge:.0%} brighter than untouched: the gel bulges, or scatters "
            "light sideways; the scene has neither to start with (effect: gel bulge)"
        )
    if cut.any():
        found.append(black_text(black, cut.mean((0, 1)).tolist())[0])
    if press.leds is None:
        found.append(f"no {BOARD}: {LEDS} LEDs are assumed on a ring of {RING:g} mm radius")
    else:
        found.append(
            f"{len(leds)} LEDs stand as on their board, whose turn about the camera is not known: assumed x right, "
            f"y up; turned by half or mirrored, it differs by {unlike_when_turned(leds):.2g} mm"
        )
    found.append(
        f"images are means of {AVERAGED} frames cut to whole DN: 0.5 DN lower than the mean in both, on average"
    )
    found.append("one press: nothing can be held out, so no verdict can be verified; record more presses")
    return found


def _scene(facts: Mapping, leds: np.ndarray, level: np.ndarray, given: bool) -> str:
    template = (shipped("scenes") / "templates" / "translucent_press.xml").read_text(encoding="utf-8")
    (height, width), scale = facts["size_px"], facts["mm_per_pixel_after_binning"]
    far, thickness = facts["led_height_mm"], facts["gel_thickness_mm"]
    # irradiance of LEDs of power 1 at the middle of the face, by (S2), and what coat and haze send back of it
    one = sum((far / math.hypot(far, *place)) / (far**2 + place @ place) for place in leds)
    path = math.hypot(far, *leds.std(0))
    back = COAT / math.pi * math.exp(-2 * HAZE * thickness) + HAZE * thickness / (4 * math.pi) * math.exp(-HAZE * path)
    shares = level / level.mean()
    return template.format(
        source=comment(facts["source"]),
        given="the ball, places of the LEDs on their board" if given else "the ball",
        assumed="the board's distance and turn" if given else "places of the LEDs",
        width=width,
        height=height,
        x_fov=f"{facts['x_fov_deg']:.6g}",
        distance=f"{facts['camera_distance_mm']:g}",
        scale=f"{scale:.6g}",
        coat=f"{COAT:g}",
        haze=f"{HAZE:g}",
        ball=f"{facts['ball_radius_mm']:g}",
        thickness=f"{thickness:g}",
        gel_width=f"{GEL_MARGIN * width * scale:.4g}",
        gel_length=f"{GEL_MARGIN * height * scale:.4g}",
        extent=f"{1.5 * facts['contact']['radius_mm'] + 1.0:.3g}",
        leds="\n".join(
            _led(k, place, far, float(level.mean()) / 255.0 / (one * back), shares) for k, place in enumerate(leds, 1)
        ),
    )


def _led(number: int, place: np.ndarray, far: float, power: float, shares: np.ndarray) -> str:
    x, y = place[0], -place[1]  # y up on the board, down in the image
    bands = "\n".join(f'        <float name="power_{c}" value="{share:.4g}"/>' for c, share in zip("rgb", shares))
    return f"""    <emitter type="led" id="led_{number}">
        <point name="position" x="{x:.4g}" y="{y:.4g}" z="-{far:g}"/>
        <point name="target" x="{x:.4g}" y="{y:.4g}" z="0"/>
        <float name="mu" value="1"/>
        <float name="power" value="{power:.4g}"/>
{bands}
    </emitter>"""


def readme(facts: Mapping) -> str:
    """The import in sentences, contradictions first."""
    contact, (height, width) = facts["contact"], facts["size_px"]
    levels = facts["noise"]["levels"]
    return "\n".join(
        [
            f"A ball press on a translucent gel over a dark coat, from {facts['source']}",
            "",
            "Contradictions and remarks",
            *[f"- {text}" for text in facts["warnings"]],
            "",
            "Corrections",
            *sentences(facts["corrections"]),
            "",
            "Given",
            f"- ball radius {facts['ball_radius_mm']:g} mm, {facts['mm_per_pixel']:.5g} mm/px",
            f"- LEDs: {len(facts['leds_mm'])}, {facts['leds_from']}",
            *[f"- {file}" for file in facts["files"].values()],
            "",
            "Assumed",
            f"- camera at {facts['camera_distance_mm']:g} mm, LEDs at {facts['led_height_mm']:g} mm from the face, gel "
            f"{facts['gel_thickness_mm']:g} mm thick, haze {HAZE:g} 1/mm, reflectance of the coat {COAT:g}",
            "",
            "Derived",
            f"- images of {width} x {height} px, means of blocks of {facts['bin']} px",
            f"- contact at ({contact['x_mm']:.3f}, {contact['y_mm']:.3f}) mm, radius {contact['radius_mm']:.3f} mm, "
            f"off a circle by {1000 * contact['edge_off_rms_mm']:.2g} um rms, depth {contact['depth_mm']:.3f} mm",
            "- noise (sd, R / G / B): "
            + " / ".join(f"{level['sd']:.2g}" for level in levels)
            + f" DN; {facts['noise']['how']}",
            "",
        ]
    )
