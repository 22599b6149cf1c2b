"""Import: labelled ball presses of a tactile camera become a capture set, with a scene that repeats the measured facts.

    import_taxim("dataPack.npz", "captures/taxim", ball_radius=2.0, mm_per_pixel=0.1245)
    import_taxim("calib/gelsight", "captures/taxim", bin=4)        a pack's folder: params.json says mm per pixel
    import_circles("images", "labels.csv", "captures/digit", ball_radius=3.0, mm_per_pixel=1 / 17.15)

What comes in: images of one ball pressed at many places, and circles drawn around the contacts by hand. What goes out
is a folder of `captures` with, beside it, `scene.xml` (from the template `scenes/templates/ball_presses.xml`),
`import.json` (everything that was derived) and `README.txt` (the same in sentences, contradictions first).

Derived, not measured, and said so in these files:
    press      x, y = (circle's centre + 0.5 - half the image) mm_per_pixel;   labels count pixel centres from 0
    depth      from a touched radius a = contact_share times the circle's radius: skirt a/sqrt(R^2 - a^2) + R - sqrt(R^2
               - a^2)
    gain       of every frame and channel: median of frame over background, beyond three circle radii
    background per-pixel median of all presses; or of each press the mean of those next to it, if the untouched sensor
               changes during the session (`optics.captures.backgrounds`); or a given image
    noise      variance against signal of half the squared differences of successive frames beyond three circle radii
    black      values that are cut off below (`corrections.black_levels`): masked, of blocks the whole block
    lights     per channel the direction l of the least-squares fit I - B = l.(n - n0) on the labelled balls, at 16 mm
A circle drawn by eye is a start: what to solve for from there stands in import.json under `setup`, and `optics
calibrate` follows it: the lights, the skirt, and every press's position and depth, with priors about the imported
values; the ball's radius too, where circles are drawn larger than the ball."""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from optics.captures import backgrounds
from optics.captures import capture_set as capture_sets
from optics.captures.capture_set import Captures, Frame
from optics.captures.corrections import at_black, black_levels, black_text, correction, drift_text, sentences
from optics.captures.noise import SATURATED, Noise, photon_transfer
from optics.errors import BadCapture, OutputExists, UnknownKey
from optics.files.archives import opened
from optics.files.images import SUFFIXES, read_image, varied
from optics.files.output import new_folder, shipped

PACK, TABLE, PARAMETERS = "dataPack.npz", "polycalib.npz", "params.json"  # of a Taxim calibration
SMALL = 160  # px: width of the reduced images whose scale its authors give
CROWDED = 0.5  # of the presses over one pixel: beyond, a median is of pressed values
COLUMNS = ("file", "center_x_px", "center_y_px", "contact_radius_px")
FAR = 3.0  # circle radii beyond which a press leaves the image alone, but for a skirt of a few per mille
LED_DISTANCE = 16.0  # mm from the middle of the face, where no better is known
ALIKE = 0.15  # relative: channels whose standard deviations one law misses by more have laws of their own
MOST_SHARED = 0.95  # correlation of neighbours: beyond, a law of single pixels says nothing
LEAST = 0.01  # of the mean variance: what gain and dark noise have at least
STEEPEST = 0.93  # of the ball's radius: largest touched radius, where the flank is 68 deg steep and the depth finite
MEDIAN_OF = 5  # presses, from which on a per-pixel median is free of the ones that cover a pixel
GEL_MARGIN = 1.15  # of the view: size of the gel, so that its edge is never seen
POSE = ("gel.press_x", "gel.press_y", "gel.press_depth")
LIGHTS = ("led_*.[xyz]", "led_*.pan", "led_*.tilt", "led_*.mu")
PRIORS = {
    "led_*.[xy]": 8.0,
    "led_*.z": 3.0,
    "led_*.pan": 20.0,
    "led_*.tilt": 20.0,
    "led_*.mu": 4.0,
    "gel.skirt": 0.15,
    "gel.indenter_size": 0.15,
    "gel.press_[xy]": 0.4,
    "gel.press_depth": 0.5,
}  # sd about the imported value, in the parameter's unit
BEHIND = {
    "median": " of the presses, per pixel",
    "near": ": of each press, the mean of those before and after it; its noise is part of the stated one",
}
EXTRAS = ("scene.xml", "import.json", "README.txt")
MAPS = "heights"  # folder of a capture set, for maps of heights
BACKGROUNDS = ("median", "near", "given")


@dataclass
class Presses:
    """Images of ball presses with their circles.

    images   (N, H, W, 3) DN;   circles (N, 3): centre x, y and radius in px, pixel centres count from 0
    given    (H, W, 3) DN, an image of the untouched sensor, or None
    remarks  what reading them found
    """

    source: str
    names: list[str]
    images: np.ndarray
    circles: np.ndarray
    given: np.ndarray | None = None
    remarks: list[str] = field(default_factory=list)


@dataclass
class Imported:
    """What an import left: the folder, the contradictions in sentences, and every derived number."""

    folder: Path
    warnings: list[str]
    facts: dict = field(default_factory=dict)


def import_taxim(
    pack: str | Path,
    folder: str | Path,
    *,
    ball_radius: float | None = None,
    mm_per_pixel: float | None = None,
    mm_per_pixel_check: float | None = None,
    background: str | None = None,
    **options,
) -> Imported:
    """Import the calibration pack of Taxim: an .npz with imgs, touch_center, touch_radius and f0, never unpickled, or
    the folder that holds it as dataPack.npz.

    ball_radius   mm; None: 2, half the diameter that its authors give
    mm_per_pixel  None: `sensor: pixmm` of the params.json beside the pack; without one, for images SMALL px wide, the
                  authors' 0.1245 mm/px, held against 4 x 0.03 mm/px as a second route to the same scale
    background    None: f0 where presses crowd over half of the images and a median would show them, else as in
                  `import_presses`
    Options as in `import_presses`. Raises BadCapture."""
    path = pack_of(Path(pack))
    presses = read_taxim(path)
    remarks, width = list(presses.remarks), presses.images.shape[2]
    if mm_per_pixel is None:
        mm_per_pixel = _scale_of(path)
        if mm_per_pixel is None and width == SMALL:
            mm_per_pixel, mm_per_pixel_check = 0.1245, mm_per_pixel_check or 0.12
        elif mm_per_pixel is None:
            raise BadCapture(
                f"{path}: no {PARAMETERS} beside it with sensor: pixmm, mm per pixel of images {width} px wide; give "
                "--mm-per-pixel"
            )
    if ball_radius is None:
        ball_radius = 2.0
        remarks.append("the pack does not say the ball's radius: 2 mm are assumed, as the authors of Taxim give")
    if background is None:
        crowd = _covered(presses)
        crowded = presses.given is not None and (crowd > CROWDED or len(presses.images) < MEDIAN_OF)
        background = "given" if crowded else None
        if crowded:
            remarks.append(
                f"{crowd:.0%} of the presses lie over one pixel: their median would show the contact, so that f0 is "
                "the background"
            )
    presses.remarks = remarks
    return import_presses(
        presses,
        folder,
        ball_radius=ball_radius,
        mm_per_pixel=mm_per_pixel,
        mm_per_pixel_check=mm_per_pixel_check,
        background=background,
        **options,
    )


def import_circles(
    images: str | Path,
    circles: str | Path,
    folder: str | Path,
    *,
    ball_radius: float,
    mm_per_pixel: float,
    untouched: str | Path | None = None,
    **options,
) -> Imported:
    """Import a folder of images and a CSV file of circles with the columns file, center_x_px, center_y_px,
    contact_radius_px.

    untouched  an image of the sensor without contact; None: the background comes from the presses
    Options as in `import_presses`. Raises BadCapture.
    """
    presses = read_circles(images, circles)
    if untouched is not None:
        presses.given = _colour_image(Path(untouched), f"{untouched}", presses.images.shape[1:])
        options.setdefault("background", "given")
    return import_presses(presses, folder, ball_radius=ball_radius, mm_per_pixel=mm_per_pixel, **options)


# -- Reading ---------------------------------------------------------------------------------------------------------
def is_pack(source: Path) -> bool:
    """Whether a folder is that of a calibration pack."""
    return source.is_dir() and any((source / name).is_file() for name in (PACK, TABLE))


def pack_of(source: Path) -> Path:
    """The pack of a folder, or the file itself."""
    if source.is_dir():
        if not (source / PACK).is_file():
            has = f"; {TABLE} is a table fitted to images, which it does not hold" if (source / TABLE).is_file() else ""
            raise BadCapture(f"{source}: no {PACK} with the images of presses{has}; give a folder that has it")
        return source / PACK
    return source


def _scale_of(pack: Path) -> float | None:
    """mm per pixel by the parameter file beside a pack, None without one."""
    file = pack.with_name(PARAMETERS)
    if not file.is_file():
        return None
    try:
        sensor = json.loads(file.read_text(encoding="utf-8")).get("sensor", {})
        value = sensor.get("pixmm")
    except (ValueError, AttributeError) as error:
        raise BadCapture(f"{file}: no JSON table with sensor: pixmm ({error})") from error
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not (math.isfinite(value) and value > 0):
        raise BadCapture(f"{file}: sensor: pixmm = {value!r} mm per pixel; allowed: a number above 0")
    return float(value)


def _covered(presses: Presses) -> float:
    """Largest share of the presses that lie over one pixel, within 1.5 circle radii."""
    step = max(1, presses.images.shape[2] // 80)  # of a coarse grid: circles are wide
    height, width = (n // step for n in presses.images.shape[1:3])
    return float(np.mean(_distances((height, width), _blocks(presses.circles, step)) < 1.5, 0).max())


def read_taxim(pack: str | Path) -> Presses:
    """Presses of a Taxim calibration pack; raises BadCapture with the array, its shape and what is allowed."""
    path = pack_of(Path(pack))
    if not path.is_file():
        raise BadCapture(f"{path}: no such file; give the dataPack .npz of a Taxim calibration")
    wanted = ("imgs", "touch_center", "touch_radius")
    try:
        with opened(path) as data:
            missing = [key for key in wanted if key not in data.files]
            if missing:
                raise BadCapture(
                    f"{path}: {', '.join(missing)} missing (it has {', '.join(data.files) or 'nothing'}); needed: "
                    f"{', '.join(wanted)}, and f0 where there is an image of the untouched gel"
                )
            arrays = {key: data[key] for key in (*wanted, "f0", "names") if key in data.files}
    except BadCapture:
        raise
    except Exception as error:  # zipfile, zlib and numpy raise whatever they find
        raise BadCapture(
            f"{path}: cannot be read as .npz without pickles ({type(error).__name__}: {error}); save its arrays "
            "with numpy.savez and numeric types"
        ) from error
    images, centres, radii = (arrays[key] for key in wanted)
    where = str(path)
    if images.ndim != 4 or images.shape[-1] != 3 or not len(images):
        raise BadCapture(f"{where}: imgs has the shape {images.shape}; allowed: (N, H, W, 3) with N >= 1")
    for key, shape in (("touch_center", (len(images), 2)), ("touch_radius", (len(images),))):
        if arrays[key].shape != shape:
            raise BadCapture(
                f"{where}: {key} has the shape {arrays[key].shape}; allowed: {shape}, one row per image of imgs"
            )
    if "f0" in arrays and arrays["f0"].shape != images.shape[1:]:
        raise BadCapture(f"{where}: f0 has the shape {arrays['f0'].shape}; allowed: {images.shape[1:]}, as the images")
    for key in ("imgs", "f0"):
        if key in arrays and arrays[key].dtype.kind not in "uif":
            raise BadCapture(f"{where}: {key} has the type {arrays[key].dtype}; allowed: numbers")
    listed = [str(n) for n in arrays.get("names", ())]
    names, remarks = [Path(n).stem for n in listed], []
    if any(n.lower().endswith((".jpg", ".jpeg")) for n in listed):
        remarks.append(
            "the images were JPEG files: neighbouring pixels share their noise, and fine shading is altered; averages "
            "over 8 x 8 px (bin) suffer least"
        )
    if listed and len(listed) != len(images):
        remarks.append(f"names has {len(listed)} entries for {len(images)} images: presses are numbered instead")
    if len(set(names)) < len(names) or len(names) != len(images):
        names = [f"{i:03d}" for i in range(len(images))]
    given = arrays.get("f0")
    circles = np.column_stack([centres, radii]).astype(np.float64)
    return Presses(where, names, images, circles, given, remarks)


def read_circles(images: str | Path, circles: str | Path) -> Presses:
    """Presses of a folder of images and a CSV of circles; raises BadCapture with file, row, column and value."""
    folder, table = Path(images), Path(circles)
    if not folder.is_dir():
        raise BadCapture(f"{folder}: no such folder of images")
    if not table.is_file():
        raise BadCapture(f"{table}: no such file; give a CSV with the columns {', '.join(COLUMNS)}")
    try:
        with open(table, newline="", encoding="utf-8-sig") as stream:
            reader = csv.DictReader(stream)
            known = [name.strip() for name in reader.fieldnames or ()]
            reader.fieldnames = known
            rows = list(reader)
    except (UnicodeDecodeError, csv.Error) as error:
        raise BadCapture(f"{table}: no CSV in UTF-8 ({error})") from error
    for column in COLUMNS:
        if column not in known:
            raise BadCapture(str(UnknownKey(column, known, "column", str(table), f"needed: {', '.join(COLUMNS)}")))
    if not rows:
        raise BadCapture(f"{table}: zero rows; needed: one per image")
    names, images_read, found, seen = [], [], [], {}
    for line, row in enumerate(rows, 2):
        where = f"{table}: line {line}"
        name = (row["file"] or "").strip()
        if name in seen:
            raise BadCapture(f"{where}: '{name}' was given in line {seen[name]} already; one circle per image")
        seen[name] = line
        numbers = []
        for column in COLUMNS[1:]:
            try:
                numbers.append(float(row[column]))
            except (TypeError, ValueError):
                raise BadCapture(f"{where}: {column} = {row[column]!r} is not a number in px") from None
        file = folder / name
        if not name or not file.is_file():
            raise BadCapture(
                f"{where}: no image '{name}' in {folder}; allowed: {', '.join(SUFFIXES)} files of that folder"
            )
        if not file.resolve().is_relative_to(folder.resolve()):
            raise BadCapture(f"{where}: '{name}' lies outside {folder}; allowed: files of that folder; copy it there")
        images_read.append(_colour_image(file, f"{where}: {name}", images_read[0].shape if images_read else None))
        names.append(name)
        found.append(numbers)
    stems = [Path(name).stem for name in names]
    names = stems if len(set(stems)) == len(stems) else [f"{i:03d}" for i in range(len(stems))]
    return Presses(f"{folder} with {table}", names, np.stack(images_read), np.array(found))


def _colour_image(file: Path, where: str, shape: tuple | None) -> np.ndarray:
    image, _ = read_image(file, where)
    if image.shape[-1] != 3 or (shape is not None and image.shape != shape):
        raise BadCapture(
            f"{where}: (H, W, C) = {image.shape}; allowed: {shape or '(H, W, 3)'}, one camera, one size, colour"
        )
    return image.astype(np.float64)


# -- Importing -------------------------------------------------------------------------------------------------------
def import_presses(
    presses: Presses,
    folder: str | Path,
    *,
    ball_radius: float,
    mm_per_pixel: float,
    mm_per_pixel_check: float | None = None,
    camera_distance: float = 30.0,
    gel_thickness: float = 4.0,
    skirt: float = 0.8,
    contact_share: float = 0.85,
    background: str | None = None,
    leds: int = 3,
    bin: int = 1,
    every: int = 1,
    saturation: float = 255.0,
    overwrite: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
) -> Imported:
    """Write presses as a capture set with its scene; see the module's text for what is derived.

    ball_radius         mm;   mm_per_pixel of the full image on the untouched face
    mm_per_pixel_check  mm/px by a second route, or None; a disagreement above 1 % is a warning
    camera_distance     mm from the face to the camera's centre of projection
    skirt               mm, start of `gel.skirt`;   contact_share  start of touched over labelled radius
    background          'median' of the presses, 'near' (of the presses before and after each) or 'given' (the image of
                        the untouched sensor); None: 'near' where it leaves clearly less than the median
    leds                3: one per channel; 6: shared by the channels, each with a power per channel
    bin                 pixels per side that are averaged into one; a block with a saturated pixel stays saturated
    every               take every n-th press; background and noise come from all of them
    Raises BadCapture, OutputExists.
    """
    lengths = {
        "ball_radius": ball_radius,
        "mm_per_pixel": mm_per_pixel,
        "camera_distance": camera_distance,
        "gel_thickness": gel_thickness,
        "contact_share": contact_share,
        "saturation": saturation,
    }
    _check_options(presses, lengths, background, every, leds)
    _check(presses, bin)
    tick = progress or (lambda *_: None)
    tick("import", 0, 4)
    scale = mm_per_pixel * bin
    black = black_levels(list(presses.images) + ([] if presses.given is None else [presses.given]))
    images, given, circles = _binned_presses(presses, bin, saturation, black)
    masks = _masks(images, black)
    median = np.median(images, 0)
    flat = given if background == "given" else median
    far = (_distances(images.shape[1:3], circles) > FAR) & ~at_black(images, black).any(-1)
    gains = np.array([_gain(image, flat, beyond) for image, beyond in zip(images, far)])
    tick("import", 1, 4)
    even = images / gains[:, None, None]
    noise, levels = far_noise(even, far, saturation, 1.0 if bin == 1 else 0.0)
    noise = replace(noise, correlation=shared_by_neighbours(even, far))
    of_each, count = backgrounds.near(even, far, median)
    rest = {"median": backgrounds.left(even, median, far, noise), "near": backgrounds.left(even, of_each, far, noise)}
    if background is None:
        background = "near" if np.mean(rest["near"]) < backgrounds.BETTER * np.mean(rest["median"]) else "median"
    if background == "near":
        noise = backgrounds.with_background(noise, count, far)
        gains = np.array([_gain(image, own, beyond) for image, own, beyond in zip(images, of_each, far)])
    tick("import", 2, 4)
    touched = np.minimum(contact_share * circles[:, 2] * scale, STEEPEST * ball_radius)
    taken = slice(None, None, every)
    depths = [depth_of(a, ball_radius, skirt) for a in touched[taken]]
    frames = _frames(presses.names[taken], images[taken], circles[taken], gains[taken], depths, scale, masks[taken])
    if background == "near":
        for frame, own in zip(frames, of_each[taken]):
            frame.flat_field = own.astype(np.float32)
    behind = (of_each if background == "near" else flat) * gains[:, None, None]
    directions = light_directions(images, behind, circles, ball_radius / scale)
    facts = {
        "source": presses.source,
        "presses": len(frames),
        "every": every,
        "size_px": list(images.shape[1:3]),
        "bin": bin,
        "ball_radius_mm": ball_radius,
        "mm_per_pixel": mm_per_pixel,
        "mm_per_pixel_after_binning": scale,
        "camera_distance_mm": camera_distance,
        "x_fov_deg": math.degrees(2 * math.atan(images.shape[2] * scale / 2 / camera_distance)),
        "skirt_mm": skirt,
        "contact_share": contact_share,
        "background": background,
        "background_left": {name: values.tolist() for name, values in rest.items()},
        **_derived(circles[:, 2] * scale, circles[taken], gains, noise, levels, directions),
        # ball, scale or labels are wrong where a circle is larger than the ball: the images decide
        "setup": _setup(leds, free_ball=bool(np.any(circles[taken, 2] * scale > ball_radius))),
    }
    facts["warnings"] = presses.remarks + contradictions(
        presses, facts, images, median, given, gains, noise, saturation, mm_per_pixel_check
    )
    facts["corrections"] = _corrections(images, gains, black, bin, saturation)
    if background == "near":
        facts["corrections"].append(_of_each_press(rest))
    if any(level is not None for level in black):
        facts["warnings"].append(black_text(black, at_black(images, black).mean((0, 1, 2)).tolist())[0])
    tick("import", 3, 4)
    xml = _scene_xml(facts, gel_thickness, touched.max() + 5 * skirt, led_elements(directions, leds, flat.mean((0, 1))))
    one = None if background == "near" else flat
    path = write_set(Path(folder), frames, noise, one, xml, facts, bits=8 if bin == 1 else None, overwrite=overwrite)
    tick("import", 4, 4)
    return Imported(path, facts["warnings"], facts)


def _check_options(presses: Presses, lengths: dict[str, float], background: str | None, every: int, leds: int) -> None:
    """Raises BadCapture, or UnknownKey, for an option that is out of range or contradicts the presses."""
    for name, value in lengths.items():
        if not (math.isfinite(value) and value > 0):
            raise BadCapture(f"{presses.source}: {name} = {value:g}; allowed: above 0")
    if background is not None and background not in BACKGROUNDS:
        raise UnknownKey(background, BACKGROUNDS, "background")
    if background == "given" and presses.given is None:
        raise BadCapture(
            f"{presses.source}: background = 'given', but there is no image of the untouched sensor; give "
            "one, or take 'median' or 'near'"
        )
    if not 1 <= every <= len(presses.images):
        raise BadCapture(
            f"{presses.source}: every = {every}; allowed: 1 to {len(presses.images)}, the number of presses"
        )
    if leds not in (3, 6):
        raise BadCapture(f"{presses.source}: leds = {leds}; allowed: 3 (one per channel) or 6 (shared)")
    if background != "given" and len(presses.images) < MEDIAN_OF:
        raise BadCapture(
            f"{presses.source}: {len(presses.images)} presses; a per-pixel median needs {MEDIAN_OF} or more, else give "
            "an image of the untouched sensor"
        )


def _masks(images: np.ndarray, black: Sequence[float | None]) -> list[np.ndarray | None]:
    """(H, W) bool of every image, True = use, or None where all may be used.

    Values cut off at 0 DN need none: a Noise without a pedestal leaves them out, channel by channel."""
    above = [level if level is not None and level > 0 else None for level in black]
    if not any(above):
        return [None] * len(images)
    masks = [~at_black(image, above).any(-1) for image in images]
    return [None if mask.all() else mask for mask in masks]


def _corrections(images, gains, black: Sequence[float | None], bin: int, saturation: float) -> list[dict[str, str]]:
    """What was changed or left out, for import.json."""
    found = []
    if bin > 1:
        found.append(correction("pixels are averaged", f"blocks of {bin} x {bin} px", "all images and the background"))
    found.append(
        correction(
            "brightness of frames far from the contact, set as camera.gain_r, gain_g, gain_b",
            f"sd {_rgb(100 * gains.std(0))} %, up to {np.abs(gains - 1).max():.1%}",
            "every frame; values stay as they are",
        )
    )
    share = np.mean(images >= SATURATED * saturation, (0, 1, 2))
    if share.any():
        found.append(
            correction(
                "saturated values are masked" + (", their blocks keep the largest value" if bin > 1 else ""),
                f"{_rgb(100 * share)} % of R / G / B",
                "all images",
            )
        )
    if any(level is not None for level in black):
        found.append(black_text(black, at_black(images, black).mean((0, 1, 2)).tolist())[1])
    return found


def _of_each_press(rest: dict[str, np.ndarray]) -> dict[str, str]:
    """What it took that the untouched sensor changes."""
    median, near = (_rgb(np.sqrt(rest[name])) for name in ("median", "near"))
    return correction(
        "the untouched sensor changes during the session: each press has a background of its own, from the presses "
        "next to it",
        f"beyond {FAR:g} circle radii a median of all leaves {median} of the noise (rms, R / G / B), these {near}",
        "every frame",
    )


def _frames(names, images, circles, gains, depths, scale: float, masks) -> list[Frame]:
    """Frames with the press (mm) that their circles (px) tell, and with their gains."""
    height, width = images.shape[1:3]
    middle = np.array([width / 2, height / 2])
    frames = []
    for name, image, circle, gain, depth, mask in zip(names, images, circles, gains, depths, masks):
        x, y = (circle[:2] - middle) * scale
        settings = {
            "gel.press_x": x,
            "gel.press_y": y,
            "gel.press_depth": depth,
            **{f"camera.gain_{c}": g for c, g in zip("rgb", gain)},
        }
        settings = {key: round(float(value), 6) for key, value in settings.items()}
        frames.append(Frame(name, image.astype(np.float32), mask, name, settings))
    return frames


def _derived(radii, circles, gains, noise: Noise, levels: list[dict], directions) -> dict:
    """What was read off the images, for import.json. radii: mm, of all labels; circles: px, of the presses taken."""
    return {
        "labelled_radius_mm": _span(radii),
        "circles_px": circles.round(4).tolist(),
        "frame_gain_sd": gains.std(0).tolist(),
        "frame_gain": gains.round(5).tolist(),
        "noise": {
            "system_gain": noise.written("system_gain"),
            "dark_noise": noise.written("dark_noise"),
            "correlation": noise.written("correlation"),
            "levels": levels,
            "how": "half the squared differences of successive frames beyond three circle radii, after their gains: "
            "temporal noise, banding and drift together",
        },
        "light_directions": dict(zip("rgb", directions)),
    }


def _setup(leds: int, free_ball: bool) -> dict:
    """What a calibration of the imported set is advised to solve for; see `optics.study.loop.setup_for`."""
    free = ["led_*.power_?" if leds > 3 else "led_*.power", *LIGHTS, "gel.skirt"]
    if free_ball:
        free.append("gel.indenter_size")
    return {
        "free": free,
        "per_group": list(POSE),
        "flat_field": "additive",
        "priors": {
            pattern: [None, sd] for pattern, sd in PRIORS.items() if pattern in free or pattern != "gel.indenter_size"
        },
    }


def _scene_xml(facts: dict, gel_thickness: float, extent: float, leds: str) -> str:
    """The template of a scene with the facts filled in; extent: mm, how far the dent reaches; leds: XML elements."""
    template = (shipped("scenes") / "templates" / "ball_presses.xml").read_text(encoding="utf-8")
    (height, width), scale = facts["size_px"], facts["mm_per_pixel_after_binning"]
    return template.format(
        source=comment(facts["source"]),
        width=width,
        height=height,
        x_fov=f"{facts['x_fov_deg']:.5g}",
        distance=f"{facts['camera_distance_mm']:g}",
        ball=f"{facts['ball_radius_mm']:g}",
        scale=f"{scale:.6g}",
        skirt=f"{facts['skirt_mm']:g}",
        thickness=f"{gel_thickness:g}",
        gel_width=f"{GEL_MARGIN * width * scale:.4g}",
        gel_length=f"{GEL_MARGIN * height * scale:.4g}",
        extent=f"{extent:.3g}",
        leds=leds,
        circle_low=f"{facts['labelled_radius_mm'][0]:.3g}",
        circle_high=f"{facts['labelled_radius_mm'][1]:.3g}",
    )


def _check(presses: Presses, bin: int) -> None:
    count, height, width, _ = presses.images.shape
    if not 1 <= int(bin) == bin <= min(height, width) // 8:
        raise BadCapture(f"{presses.source}: bin = {bin}; allowed: whole numbers from 1 to {min(height, width) // 8}")
    if height % bin or width % bin:
        raise BadCapture(f"{presses.source}: images of {width} x {height} px do not divide into blocks of {bin} px")
    if not np.isfinite(presses.images).all():
        raise BadCapture(f"{presses.source}: the images hold values that are not finite")
    for name, image in zip(presses.names, presses.images):
        varied(image, f"{presses.source}: {name}")
    for name, (x, y, r) in zip(presses.names, presses.circles):
        if not (np.isfinite([x, y, r]).all() and r > 0 and 0 <= x < width and 0 <= y < height):
            raise BadCapture(
                f"{presses.source}: {name}: circle at ({x:g}, {y:g}) px with radius {r:g} px; allowed: a centre "
                f"inside the {width} x {height} px image and a radius above 0"
            )


def binned(
    image: np.ndarray, bin: int, saturation: float = 255.0, black: Sequence[float | None] | None = None
) -> np.ndarray:
    """Means of blocks of bin x bin pixels; a block with a saturated value keeps its largest, one with a value at its
    channel's black level that level, so that they stay masked."""
    if bin == 1:
        return np.asarray(image, np.float64)
    height, width, channels = image.shape
    blocks = np.asarray(image, np.float64).reshape(height // bin, bin, width // bin, bin, channels)
    top, low = blocks.max((1, 3)), blocks.min((1, 3))
    means = np.where(top >= SATURATED * saturation, top, blocks.mean((1, 3)))
    return means if black is None else np.where(at_black(low, black), low, means)


def filled(
    image: np.ndarray, bin: int, saturation: float = 255.0, black: Sequence[float | None] | None = None
) -> np.ndarray:
    """Means of blocks (`binned`), of the middle of the image that they fill."""
    height, width = (n // bin * bin for n in image.shape[:2])
    top, left = (image.shape[0] - height) // 2, (image.shape[1] - width) // 2
    return binned(image[top : top + height, left : left + width], bin, saturation, black)


def _binned_presses(
    presses: Presses, bin: int, saturation: float, black: Sequence[float | None]
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
    """Images, the image of the untouched sensor or None, and circles, in binned pixels whose centres are at +0.5."""
    images = np.stack([binned(i, bin, saturation, black).astype(np.float32) for i in presses.images])
    given = None if presses.given is None else binned(presses.given, bin, saturation, black)
    return images, given, _blocks(presses.circles, bin)


def _blocks(circles: np.ndarray, bin: int) -> np.ndarray:
    """Circles in px, pixel centres from 0, as circles in blocks, whose centres are at +0.5."""
    return np.column_stack([(circles[:, :2] + 0.5) / bin, circles[:, 2] / bin])


def depth_of(touched: float, ball_radius: float, skirt: float) -> float:
    """mm by which a ball's lowest point stands below the face when it touches up to the radius `touched` (mm)."""
    root = math.sqrt(ball_radius**2 - touched**2)
    return skirt * touched / root + ball_radius - root


def _distances(shape: tuple[int, int], circles: np.ndarray) -> np.ndarray:
    """(N, H, W) distance of every pixel's centre from each circle's centre, in circle radii."""
    v, u = np.mgrid[: shape[0], : shape[1]] + 0.5
    x, y, r = (circles[:, i, None, None] for i in range(3))
    return np.hypot(u - x, v - y) / r


def _gain(image: np.ndarray, flat: np.ndarray, beyond: np.ndarray) -> np.ndarray:
    return np.median((image / np.maximum(flat, 5.0))[beyond], 0) if beyond.any() else np.ones(image.shape[-1])


def far_noise(images: np.ndarray, far: np.ndarray, saturation: float, step: float = 1.0) -> tuple[Noise, list[dict]]:
    """Noise from successive frames where neither is pressed: half the squared difference against the mean, 12 levels
    each.

    One law for all channels, or one for each (`noise_of_channels`); step: DN, of the quantisation. Nothing is filtered
    out, so banding counts as noise; neighbouring pixels share it, which chi2 per degree of freedom hides."""
    means: list[np.ndarray] = []
    squares: list[np.ndarray] = []
    channel: list[dict] = []
    for i in range(len(images) - 1):
        use = far[i] & far[i + 1]
        if use.sum() < 50:
            continue
        a, b = images[i][use], images[i + 1][use]
        means.append((a + b) / 2)
        squares.append((a - b) ** 2 / 2)
    if not means:
        raise BadCapture(
            "no two successive presses leave an untouched part of the image in common: the noise cannot be "
            "estimated; give images of more presses"
        )
    mean, square = np.concatenate(means), np.concatenate(squares)
    laws = []
    for c in range(mean.shape[1]):
        own = []
        for group in np.array_split(np.argsort(mean[:, c], kind="stable"), 12):
            if mean[group, c].mean() < 0.9 * saturation:
                own.append((mean[group, c].mean(), square[group, c].mean(), len(group)))
        laws.append(own)
        channel.append(
            {"channel": "rgb"[c], "signal": float(mean[:, c].mean()), "sd": float(np.sqrt(square[:, c].mean()))}
        )
    return noise_of_channels(laws, channel, saturation, step), channel


def shared_by_neighbours(images: np.ndarray, far: np.ndarray) -> tuple[float, ...]:
    """The correlation of the noise of neighbouring pixels, for each channel: that of the difference of successive
    frames where neither is pressed, along rows and columns. Without a difference there is none."""
    products, squares = np.zeros(images.shape[-1]), np.zeros(images.shape[-1])
    for a, b, use in zip(images, images[1:], far[1:] & far[:-1]):
        difference = a - b
        for one, other in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
            both = use[one] & use[other]
            x, y = difference[one][both], difference[other][both]
            products += np.sum(x * y, 0)
            squares += np.sum(x**2 + y**2, 0) / 2
    found = products / np.maximum(squares, 1e-12)
    return tuple(np.round(np.clip(found, 0.0, MOST_SHARED), 3).tolist())


def noise_of_channels(
    laws: Sequence[Sequence[tuple]], channel: Sequence[dict], saturation: float, step: float
) -> Noise:
    """One law for all channels where it meets each of them to ALIKE, else a gain and a dark noise for each.

    laws     per channel the (level of light DN, variance DN^2, weight) that it was measured at
    channel  per channel its mean `signal` and `sd`, DN
    step     DN, of the quantisation: its step^2/12 is taken off, as a Noise adds it again; 0 where values are means
    """
    laws = [[(light, max(v - step**2 / 12, 0.1 * v), weight) for light, v, weight in own] for own in laws]
    every = [level for own in laws for level in own]
    one = replace(noise_of_levels(*(np.array(v, float) for v in zip(*every)), saturation), quantisation=step)
    if all(abs(c["sd"] / float(one.sd(c["signal"])) - 1) <= ALIKE for c in channel) or not all(laws):
        return one
    own = [noise_of_levels(*(np.array(v, float) for v in zip(*levels)), saturation) for levels in laws]
    return replace(one, system_gain=tuple(n.system_gain for n in own), dark_noise=tuple(n.dark_noise for n in own))


def noise_of_levels(light: np.ndarray, variance: np.ndarray, weight: np.ndarray, saturation: float) -> Noise:
    """Noise from variances (n,) at levels of light (n,), DN; where they show no photon transfer, one that has their
    mean."""
    (gain, floor), _ = photon_transfer(light, variance, weight)
    mean = float(np.average(variance, weights=weight))
    if gain <= 0:  # no photon transfer in these data: banding and drift rule
        gain, floor = LEAST * mean / float(np.average(light, weights=weight)), mean
    elif floor < 0:
        gain = float(np.average(variance / light, weights=weight))
    # above 0, as in the dark it is all the noise that there is
    return Noise(float(gain), math.sqrt(max(floor, LEAST * mean)), 0.0, saturation, 0.0, 1.0)


def light_directions(images, backgrounds, circles, radius: float) -> list[list[float]]:
    """Per channel the vector l with I - B = l . (n - n0) on the labelled contacts, in DN; n points to the camera.

    Its direction is where the channel's light comes from, but for light that comes from all sides.
    """
    normals, steps = [], []
    v, u = np.mgrid[: images.shape[1], : images.shape[2]] + 0.5
    for image, flat, (x, y, r) in zip(images, backgrounds, circles):
        inside = np.hypot(u - x, v - y) < 0.8 * min(r, radius)
        nx, ny = ((u - x) / radius)[inside], ((v - y) / radius)[inside]
        normals.append(np.stack([nx, ny, np.sqrt(1 - nx**2 - ny**2) - 1], -1))
        steps.append((image - flat)[inside])
    found, *_ = np.linalg.lstsq(np.concatenate(normals), np.concatenate(steps), rcond=None)
    return [[float(value) for value in column] for column in found.T]


def led_elements(directions: Sequence[Sequence[float]], leds: int, level: np.ndarray) -> str:
    """XML of the lights: at LED_DISTANCE from the middle, in the directions that the contacts show; a start, not a
    finding."""
    texts = []
    for k in range(leds):
        nx, ny, _ = directions[k % 3]
        azimuth = math.atan2(ny, nx) + (0.0, 0.0, 0.0, 1.0, -1.0, 2.1)[k]
        strength = math.hypot(nx, ny) / max(float(level[k % 3]), 1.0)
        elevation = min(max(math.atan2(1.0, max(strength, 0.3)), 0.3), 0.9)
        x, y = (LED_DISTANCE * math.cos(elevation) * f(azimuth) for f in (math.cos, math.sin))
        shares = [1.0 if c == k % 3 else (0.0 if leds == 3 else 0.1) for c in range(3)]
        weight = 1.0 if k < 3 else 0.2
        name = ("led_red", "led_green", "led_blue")[k] if leds == 3 else f"led_{k + 1}"
        power = math.pi * LED_DISTANCE**2 * float(level[k % 3]) / 255.0 * weight
        texts.append(
            f'''    <emitter type="led" id="{name}">
        <point name="position" x="{x:.4g}" y="{y:.4g}" z="{-LED_DISTANCE * math.sin(elevation):.4g}"/>
        <point name="target" x="{-3 * math.cos(azimuth):.4g}" y="{-3 * math.sin(azimuth):.4g}" z="0"/>
        <float name="mu" value="2"/>
        <float name="power" value="{power:.4g}"/>
'''
            + "".join(f'        <float name="power_{c}" value="{share:g}"/>\n' for c, share in zip("rgb", shares))
            + "    </emitter>"
        )
    return "\n".join(texts)


def _span(values: np.ndarray) -> list[float]:
    return [float(values.min()), float(values.max())]


def contradictions(
    presses: Presses, facts: dict, images, median, given, gains, noise, saturation, second: float | None
) -> list[str]:
    """Contradictions between labels, scale and images, in sentences with numbers."""
    texts, ball = [], facts["ball_radius_mm"]
    low, high = facts["labelled_radius_mm"]
    count = int((presses.circles[:, 2] * facts["mm_per_pixel"] > ball).sum())
    if count:
        texts.append(
            f"{count} of {len(presses.circles)} labelled circles are larger than the ball itself: radius up to "
            f"{presses.circles[:, 2].max():g} px = {high:.2f} mm, ball radius {ball:.2f} mm; the scale, the ball or "
            "the "
            "labels are wrong, or the circle is drawn around the skirt of the dent: free gel.press_depth per press, "
            "and gel.indenter_size"
        )
    elif high > 0.95 * ball:
        texts.append(
            f"labelled circles up to {high:.2f} mm reach {high / ball:.0%} of the ball radius ({ball:.2f} mm): flanks "
            "would be steeper than 72 deg there"
        )
    if second is not None and abs(second / facts["mm_per_pixel"] - 1) > 0.01:
        texts.append(
            f"two ways to find the scale disagree: {facts['mm_per_pixel']:.4g} mm/px and {second:.4g} mm/px, "
            f"{second / facts['mm_per_pixel'] - 1:+.1%}; all lengths are uncertain by that"
        )
    scatter = noise.sd(median.mean((0, 1)))
    if given is not None:
        # where less than half of the presses are near: elsewhere the median is not of the untouched sensor
        near = np.mean(_distances(images.shape[1:3], _blocks(presses.circles, facts["bin"])) < FAR, 0)
        apart = (median - given)[near < CROWDED] if (near < CROWDED).any() else np.zeros((1, given.shape[-1]))
        rms, shift = np.sqrt(np.mean(apart**2, 0)), apart.mean(0)
        facts["given_against_median_rms"] = rms.tolist()
        if np.any(rms > 1.2 * scatter):  # the median's own noise adds a few per cent
            texts.append(
                "the given image of the untouched sensor is not the background of these presses: rms difference to "
                f"their median {_rgb(rms)} DN (mean {_rgb(shift, True)}), noise {_rgb(scatter)} DN; "
                f"background in use: {facts['background']}"
            )
    if np.abs(gains - 1).max() > 0.01:
        texts.append(
            f"frames differ in gain: sd {_rgb(100 * gains.std(0))} %, largest departure {np.abs(gains - 1).max():.1%}; "
            f"set as camera.gain_r, gain_g, gain_b in every frame; {drift_text(gains, presses.names)}"
        )
    if facts["background"] == "median":
        covered = np.mean(
            _distances(images.shape[1:3], _blocks(presses.circles, facts["bin"])) < 1.5,
            0,
        )
        if covered.max() > 0.4:
            texts.append(
                f"the median background is biased where presses crowd: up to {covered.max():.0%} of the presses lie "
                f"over one pixel ({np.mean(covered > 0.4):.1%} of the image above 40 %)"
            )
    share = np.mean(images >= SATURATED * saturation, (0, 1, 2))
    if share.max() > 1e-3:
        texts.append(f"saturated values (masked): {_rgb(100 * share)} %")
    rms = np.array([level["sd"] for level in facts["noise"]["levels"]])
    expected = noise.sd(np.array([level["signal"] for level in facts["noise"]["levels"]]))
    if isinstance(noise.system_gain, tuple):
        texts.append(
            f"one noise law does not hold in all channels: {_rgb(rms)} DN; each has its own gain and dark noise"
        )
    elif np.any(np.abs(rms / expected - 1) > ALIKE):
        texts.append(f"one noise law does not hold in all channels: measured {_rgb(rms)} DN, law {_rgb(expected)} DN")
    return texts


def _rgb(values, signed: bool = False) -> str:
    return " / ".join(f"{v:+.2g}" if signed else f"{v:.2g}" for v in values)


def comment(text: str) -> str:
    """Text that may stand in an XML comment and in a template's output."""
    return text.replace("--", "- -").replace("<", "(").replace(">", ")")


def write_set(
    folder: Path,
    frames,
    noise,
    flat,
    xml: str,
    facts: dict,
    bits: int | None,
    overwrite: bool,
    text: str = "",
    files: Mapping[str, Path] | None = None,
) -> Path:
    """flat: one for all frames, None where each has its own; text: of README.txt, that of presses without it; files: of
    names in the folder that settings name, the files to copy there."""
    folder = Path(os.path.abspath(folder))
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        ours = {*EXTRAS, "captures.toml", "frames", "flat", *_copied(folder)}
        names = [p.name for p in folder.glob("*")] if folder.is_dir() else []
        extra = [name for name in names if name not in ours and not name.startswith("flat_field.")]
        if not overwrite or extra or not (folder / "import.json").is_file():
            raise OutputExists(
                f"{folder} exists and is not empty; choose another folder"
                + ("" if extra or overwrite else ", or allow to overwrite what an import left there")
            )
    with new_folder(folder, replace=overwrite) as temporary:
        flat = None if flat is None else np.asarray(flat, np.float32)
        captures = Captures(temporary, str(temporary / "scene.xml"), frames, {}, noise, flat)
        capture_sets.write(captures, temporary, bits=bits)
        (temporary / "scene.xml").write_text(xml, encoding="utf-8")
        (temporary / "import.json").write_text(json.dumps(facts, indent=1), encoding="utf-8")
        (temporary / "README.txt").write_text(text or readme(facts), encoding="utf-8")
        for name, file in (files or {}).items():
            (temporary / name).parent.mkdir(exist_ok=True)
            shutil.copyfile(file, temporary / name)
    return folder


def _copied(folder: Path) -> set[str]:
    """The folder of a capture set in which an earlier import left maps of heights, if it did."""
    try:
        note = json.loads((folder / "import.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return set()
    return {MAPS} if isinstance(note, dict) and note.get("heightmaps") else set()


def readme(facts: dict) -> str:
    """The import in sentences, contradictions first."""
    height, width = facts["size_px"]
    levels = facts["noise"]["levels"]
    lines = [f"{facts['presses']} ball presses from {facts['source']}", "", "Contradictions"]
    lines += [f"- {text}" for text in facts["warnings"]] or ["- none found"]
    lines += ["", "Corrections", *sentences(facts["corrections"])]
    lines += [
        "",
        "Given",
        f"- ball radius {facts['ball_radius_mm']:g} mm, {facts['mm_per_pixel']:.5g} mm/px, camera at "
        f"{facts['camera_distance_mm']:g} mm",
        "",
        "Derived",
        f"- images of {width} x {height} px" + (f", means of blocks of {facts['bin']} px" if facts["bin"] > 1 else ""),
        f"- labelled radii {facts['labelled_radius_mm'][0]:.2f} to {facts['labelled_radius_mm'][1]:.2f} mm; the "
        "touched radius "
        f"starts at {facts['contact_share']:g} of that",
        f"- background: {facts['background']}{BEHIND.get(facts['background'], '')}",
        f"- gain of frames: sd {_rgb(100 * np.array(facts['frame_gain_sd']))} %",
        f"- noise (sd, R / G / B): {_rgb([level['sd'] for level in levels])} DN at "
        f"{_rgb([level['signal'] for level in levels])} DN; {facts['noise']['how']}",
        f"- correlation of the noise of neighbouring pixels: {_rgb(facts['noise']['correlation'])}",
        "- lights in scene.xml: directions from the contacts' shading, distance assumed; calibrate them",
        "",
    ]
    return "\n".join(lines)


def has_circles(captures: Captures) -> bool:
    """Whether a set was imported with labelled circles."""
    path = captures.folder / "import.json"
    return path.is_file() and "circles_px" in json.loads(path.read_text(encoding="utf-8"))


def circles_of(captures: Captures) -> np.ndarray:
    """(N, 3) labelled circles of an imported set: centre x, y and radius in px of its images, pixel centres at +0.5."""
    path = captures.folder / "import.json"
    if not path.is_file():
        raise BadCapture(f"{path}: no such file; labelled circles are known for imported sets only")
    return np.array(json.loads(path.read_text(encoding="utf-8"))["circles_px"], float)
