"""Scan folders of a bench that lights one LED per image: plates of balls pressed into the gel, and the flat field.

    import_scans("scans", "captures/bench", bin=8)

A scan folder holds `scan.yaml` and one image per LED; a folder of scans holds some with pressed balls, whose circles
are annotated with their places in the grid (`GridCircle`: x, y in px, gx, gy), and one without, the flat field. What
goes out is what `optics.captures.importing` writes, with a frame for each scan and LED: its flat field is that of its
LED, its settings say which LED is on and where the plate is pressed.

A scan of something else has a shape where a map of heights lies beside it (`heightmap.tmd`), and is imported where
`mapped` names it: the map presses the gel over all of the view. Its frames are there to be predicted: whoever derived
the map had these images, so that the advice is to hold them out.

Derived, not measured, and said so:
    plate      the similarity that maps (gx, gy) to (x, y): `gel.press_x`, `gel.press_y` of the ball nearest the middle
               and `gel.press_rz`; it is compared with `calibspacing` and `mmperpixel`
    depth      from where the balls' shadows end (`depth_by_shadows`); where they cast none, from a touched radius of
               CONTACT times the ball's
    noise      variance against signal of half the squared differences of neighbours in image over flat field, where no
               ball is near
    lights     the direction of the least-squares fit I/F = l.n + c on the balls, both less the pedestal, at DISTANCE
    pedestal   what the camera reads without light, by the noise of its images (`photon_noise`), unless it is given
    black      values that are cut off below (`corrections.black_levels`): masked, of blocks the whole block
    stretch    how far each press spreads the skin (optics.captures.skin_motion): `gel.stretch` and its slopes, of no
               effect until `stretched coating` is asked for
    masks      blemishes, of plates: values that miss the median around them, or on balls a linear shading, by BLEMISH
               standard deviations"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from optics.captures.capture_set import Frame
from optics.captures.corrections import (
    at_black,
    black_levels,
    black_text,
    correction,
    drift_text,
    sentences,
)
from optics.captures.importing import MAPS, Imported, comment, filled, noise_of_levels, write_set
from optics.captures.noise import Noise
from optics.captures.photon_noise import OF_GAUSSIAN, PhotonNoise, photon_noise
from optics.captures.skin_motion import SkinMotion, skin_motion
from optics.errors import BadCapture, UnknownKey
from optics.files import yaml_checks
from optics.files.heights import read_tmd
from optics.files.images import read_image, varied
from optics.files.output import shipped
from optics.files.yaml_checks import short
from optics.skin.contact import STRETCH

FILE, HEIGHTS = "scan.yaml", "heightmap.tmd"
BIN = 4  # px each way that are averaged where nobody says
LEDS = 64  # images of one scan
SMALLEST, ACROSS = 5.0, 200  # px of a ball's radius at least, and how many of them are across an image at most
DISTANCE = 30.0  # mm from the middle of the face to a light, where no better is known
# Standard deviations of priors, by judgement. Circles are annotated to a pixel, and together they fix where a plate is,
# but for a shift of camera or lens; a holder centres the lights on the camera's axis within a few mm.
ANNOTATED = 1.5  # px of the whole image
CENTRED = 3.0  # mm
CAMERA = 200.0  # mm: nearly telecentric, as lenses for inspection are
CONTACT = 0.85  # of the ball's radius: touched, where nothing tells
BALL, NEAR = 0.7, 1.8  # of the ball's radius: of it within, of the level face beyond
BEHIND = 0.3  # of the ball's radius: half the width of the strip in which a shadow's end is sought
DARK = 0.7  # of the level face, below which it is shadow
STEP = 1.0  # DN from value to value
BLEMISH = 6.0  # standard deviations; noise alone reaches it in one of 5e8 values
AROUND = 9  # px, of the median that a value is held against
LEVELS = 12
THICKNESS = 4.0  # mm of the gel
# Of a ball's radius, the pitch of the mesh and of the maps of its dent. Flanks of balls are off by .7 % of the light
# (rms, against 32 and 60) with these, by 1.1 % with 12 and 20, by 3 % with 8 and 12.
MESH, MAP = 16, 30
# Of a ball's radius: circles drawn twice around one ball are no farther apart. Circles of measured plates miss a square
# grid by .009 to .012 (rms), two of them differ by sqrt 2 times that: this is six times as much.
SAME = 0.1
ALIKE = 0.01  # relative: scales that differ by more are a contradiction
COVERED = 0.02  # relative: a map of heights has the size of the image to within this
POSE = ("gel.press_x", "gel.press_y", "gel.press_depth", "gel.press_rx", "gel.press_ry", "gel.press_rz")


@dataclass
class Scan:
    """images (N, H, W, 1) DN, one for each LED;   circles (B, 4): x, y in px from the first pixel's middle, gx, gy

    radius, spacing in mm and mm per pixel, as annotated; 0 where nothing is pressed
    heights: the file with a map of what is pressed, of a scan without circles"""

    name: str
    labels: list[str]
    images: np.ndarray
    circles: np.ndarray
    radius: float
    spacing: float
    mm_per_pixel: float
    remarks: Sequence[str] = ()
    heights: Path | None = None


@dataclass(frozen=True)
class Scans:
    """What a folder of scans holds: those of pressed plates, those that a map of heights presses, the flat field, and
    in words those that are not used."""

    plates: list[Scan]
    mapped: list[Scan]
    flat: Scan
    unused: list[str]


@dataclass(frozen=True)
class Plate:
    """Where a plate of balls lies: (x, y) mm of the ball nearest the middle, turn in deg, mm between balls as the
    circles have it, rms in mm by which circles miss the similarity, and all balls (B, 2) in mm."""

    x: float
    y: float
    turn: float
    spacing: float
    rms: float
    balls: np.ndarray


def is_scan_source(source: Path) -> bool:
    """Whether a folder holds scan folders, or is one."""
    return source.is_dir() and ((source / FILE).is_file() or any(source.glob(f"*/{FILE}")))


# -- reading ---------------------------------------------------------------------------------------------------------
def read_scan(folder: Path) -> Scan:
    """A scan folder; raises BadCapture with the file, the key and what is allowed."""
    file = folder / FILE
    if not file.is_file():
        raise BadCapture(f"{file}: no such file; give a scan folder, or a folder of them")
    data = yaml_checks.parse(file)
    names = data.get("images") if isinstance(data, dict) else None
    if not isinstance(names, list) or not 0 < len(names) <= LEDS or not all(isinstance(n, str) for n in names):
        raise BadCapture(
            f"{file}: images = {short(names)}; allowed: a list of file names, one for each LED, at most {LEDS}"
        )
    labels = [Path(n).stem.removeprefix("image") for n in names]
    for name, label in zip(names, labels):
        if names.count(name) > 1 or labels.count(label) > 1:
            raise BadCapture(f"{file}: images: {short(name)} appears twice; allowed: one image for each LED")
        if not re.fullmatch(r"[\w-]+", label, re.ASCII):
            raise BadCapture(
                f"{file}: images: {short(name)}: names of files name the LEDs; allowed: letters, digits, - and _, such "
                "as image07.png"
            )
    images: list[np.ndarray] = []
    for name in names:
        if Path(name).name != name or len(name) > 200 or not (folder / name).is_file():
            raise BadCapture(
                f"{file}: images: no file {short(name)} in {folder}; allowed: names of images that lie there"
            )
        image, _ = read_image(folder / name, f"{folder / name}")
        varied(image, f"{folder / name}")
        if image.shape[2] != 1 or (images and image.shape != images[0].shape):
            of = f", as {names[0]} with {images[0].shape}" if images else ""
            raise BadCapture(
                f"{folder / name}: (H, W, C) = {image.shape}{of}; allowed: one channel, all images of one size"
            )
        images.append(image.astype(np.float64))
    height, width = images[0].shape[:2]
    marks = data.get("annotations") or []
    if not isinstance(marks, list):
        raise BadCapture(f"{file}: annotations = {short(marks)}; allowed: a list of tables, of the type GridCircle")
    circles = [
        _circle(a, f"{file}: annotations[{k}]", (width, height))
        for k, a in enumerate(marks)
        if _of(a, "type") == "GridCircle"
    ]
    if not circles:
        heights = folder / HEIGHTS
        scan = Scan(folder.name, labels, np.stack(images), np.zeros((0, 4)), 0.0, 0.0, 0.0)
        return replace(scan, heights=heights) if heights.is_file() else scan
    radius, spacing, scale = (
        yaml_checks.number(data, key, file, 1e-6, 1e3) for key in ("calibradius", "calibspacing", "mmperpixel")
    )
    least, most = max(SMALLEST, max(height, width) / ACROSS), min(height, width) / 2
    if not least <= radius / scale <= most:
        raise BadCapture(
            f"{file}: calibradius = {radius:g} mm at mmperpixel = {scale:g} mm are {radius / scale:.3g} px; allowed: "
            f"balls of {least:.3g} to {most:.3g} px radius in images of {width} x {height} px"
        )
    if spacing < radius:
        raise BadCapture(
            f"{file}: calibspacing = {spacing:g} mm between balls of calibradius = {radius:g} mm; allowed: more than "
            "their radius"
        )
    one_a_ball, remarks = _merged(np.array(circles, float), radius / scale, f"{file}: annotations", folder.name)
    return Scan(folder.name, labels, np.stack(images), one_a_ball, radius, spacing, scale, remarks)


def _of(table: Any, key: str) -> Any:
    return table.get(key) if isinstance(table, dict) else None


def _circle(table: Any, where: str, size: tuple[int, int]) -> list[float]:
    """x, y in px, of which a ball at the edge may stand beyond the image; gx, gy."""
    place = [yaml_checks.number(table, key, where, -n, 2.0 * n) for key, n in zip("xy", size)]
    return [*place, *(yaml_checks.number(table, key, where, -1e4, 1e4) for key in ("gx", "gy"))]


def _merged(circles: np.ndarray, radius: float, where: str, scan: str) -> tuple[np.ndarray, list[str]]:
    """(one circle a ball: the mean of those that were drawn around it, remarks); circles (B, 4) and radius in px.

    Raises BadCapture where circles of one place in the grid lie apart, or circles of two places on one ball."""
    from scipy.spatial import cKDTree

    apart = SAME * radius
    places, ball = np.unique(circles[:, 2:], axis=0, return_inverse=True)
    members = [circles[ball.ravel() == k, :2] for k in range(len(places))]
    merged = np.column_stack([[m.mean(0) for m in members], places])
    for drawn, (gx, gy) in zip(members, places):
        widest = max(math.dist(a, b) for a in drawn for b in drawn)
        if widest > apart:
            raise BadCapture(
                f"{where}: {len(drawn)} circles at gx, gy = {gx:g}, {gy:g} lie {widest:.3g} px apart; allowed: one a "
                f"ball, or several within {apart:.3g} px ({SAME:g} of a ball's radius), which are averaged"
            )
    distance, other = cKDTree(merged[:, :2]).query(merged[:, :2], k=min(2, len(merged)))
    if len(merged) > 1 and distance[:, 1].min() <= apart:
        first = int(np.argmin(distance[:, 1]))
        a, b = (f"{gx:g}, {gy:g}" for gx, gy in places[[first, other[first, 1]]])
        raise BadCapture(
            f"{where}: the circles at gx, gy = {a} and {b} lie {distance[first, 1]:.3g} px apart; allowed: one place "
            "in the grid for each ball"
        )
    again = sum(len(m) > 1 for m in members)
    balls = f"{again} ball{'s' if again > 1 else ''}"
    return merged, [f"{scan}: {balls} annotated more than once: the mean of the circles is used"] * bool(again)


def scans_in(source: Path, mapped: Sequence[str] = ()) -> Scans:
    """The scans of a folder of scan folders; `mapped` names those that a map of heights is to press.

    Raises BadCapture; UnknownKey for a name that no scan has."""
    if not source.is_dir():
        raise BadCapture(f"{source}: no such folder; give a folder that holds scan folders")
    if (source / FILE).is_file():
        raise BadCapture(f"{source}: is one scan; give the folder that holds it beside the flat field's")
    folders = sorted(p.parent for p in source.glob(f"*/{FILE}"))
    if not folders:
        raise BadCapture(f"{source}: holds no folder with a {FILE}; allowed: scans of pressed balls and a flat field")
    names = [folder.name for folder in folders]
    for name in mapped:
        if name not in names:
            raise UnknownKey(name, names, "scan", str(source))
    scans = [read_scan(folder) for folder in folders]
    plates, others = [s for s in scans if len(s.circles)], [s for s in scans if not len(s.circles)]
    if not plates:
        raise BadCapture(f"{source}: no scan has annotations of type GridCircle; needed: one of pressed balls or more")
    first = plates[0]
    taken = [s for s in scans if s.name in mapped]
    for scan in taken:
        _check_map(source, scan, first)
    alike = [s for s in others if _same_bench(s, first) and s.name not in mapped]
    level = [s for s in alike if s.heights is None]
    flats = [s for s in level if _is_flat(s)] or level or [s for s in alike if _is_flat(s)]
    if not flats:
        have = ", ".join(f"{s.name} {s.images.shape[2]} x {s.images.shape[1]} px" for s in others) or "none"
        raise BadCapture(
            f"{source}: no flat field for {first.name} ({first.images.shape[2]} x {first.images.shape[1]} px, LEDs "
            f"{', '.join(first.labels)}): scans without circles: {have}; needed: one of nothing pressed, with the same "
            "camera and LEDs" + ", that --heightmap does not name" * bool(mapped)
        )
    used = [s for s in plates if _same_bench(s, first)]
    left = [s for s in scans if s is not flats[0] and not any(s is u for u in (*used, *taken))]
    return Scans(used, taken, flats[0], _unused(left, first))


def _is_flat(scan: Scan) -> bool:
    """Whether a scan is called a flat field."""
    return "flat" in scan.name.lower()


def _same_bench(scan: Scan, first: Scan) -> bool:
    """Whether two scans are of one camera and the same LEDs."""
    return scan.images.shape == first.images.shape and scan.labels == first.labels


def _check_map(source: Path, scan: Scan, first: Scan) -> None:
    """Raises BadCapture where a map of heights cannot press the gel of the plates' bench."""
    where = f"{source / scan.name / HEIGHTS}"
    if len(scan.circles):
        raise BadCapture(f"{source / scan.name}: its {FILE} has circles: it is imported as a plate of balls")
    if scan.heights is None:
        raise BadCapture(f"{where}: no such file; needed: a map of the heights that were pressed")
    if not _same_bench(scan, first):
        raise BadCapture(
            f"{source / scan.name}: {scan.images.shape[2]} x {scan.images.shape[1]} px, LEDs {', '.join(scan.labels)}; "
            f"allowed: those of {first.name}, {first.images.shape[2]} x {first.images.shape[1]} px, LEDs "
            f"{', '.join(first.labels)}"
        )
    heights, steps = read_tmd(scan.heights, where)
    deep = float(np.ptp(heights))
    if not 0 < deep < THICKNESS:
        raise BadCapture(
            f"{where}: heights from {heights.min():.4g} to {heights.max():.4g} mm; allowed: heights in mm that "
            f"differ, by less than the gel's thickness of {THICKNESS:g} mm"
        )
    has = [step * count for step, count in zip(steps, heights.shape[::-1])]
    wanted = [count * first.mm_per_pixel for count in first.images.shape[2:0:-1]]
    if any(abs(own / seen - 1) > COVERED for own, seen in zip(has, wanted)):
        raise BadCapture(
            f"{where}: {has[0]:.4g} x {has[1]:.4g} mm, but the image shows {wanted[0]:.4g} x {wanted[1]:.4g} mm; "
            f"allowed: a map of all of the image, to within {COVERED:.0%}"
        )


def _unused(left: Sequence[Scan], first: Scan) -> list[str]:
    """Which scans are not used, and why, in sentences."""
    shaped = [s.name for s in left if s.heights is not None and _same_bench(s, first)]
    others = [s.name for s in left if s.name not in shaped]
    found = []
    if others:
        found.append(f"not used: {', '.join(others)} (another camera or other LEDs, or neither balls nor a {HEIGHTS})")
    if shaped:
        options = " ".join(f"--heightmap {shlex.quote(name)}" for name in shaped)
        found.append(f"not used: {', '.join(shaped)} (no balls); '{options}' takes the shape from {HEIGHTS}")
    return found


# -- deriving --------------------------------------------------------------------------------------------------------
def plate_of(scan: Scan) -> Plate:
    """The similarity that maps places in the grid to circles; raises BadCapture where three balls do not fix it."""
    place, number = scan.circles[:, :2] + 0.5, scan.circles[:, 2:]
    height, width = scan.images.shape[1:3]
    at = (place - (width / 2, height / 2)) * scan.mm_per_pixel
    full = np.column_stack([number, np.ones(len(number))])
    if np.linalg.matrix_rank(full) < 3:
        raise BadCapture(f"{scan.name}: {len(number)} circles on one line; needed: three that span the plate")
    flip = 1.0 if np.linalg.det(np.linalg.lstsq(full, at, rcond=None)[0][:2]) > 0 else -1.0
    grid, where = (number * (1.0, flip)) @ (1, 1j), at @ (1, 1j)
    (scale, shift), *_ = np.linalg.lstsq(np.column_stack([grid, np.ones(len(grid))]), where, rcond=None)
    rms = float(np.sqrt(np.mean(np.abs(grid * scale + shift - where) ** 2)))
    middle = where[np.argmin(np.abs(where))]
    turn = (math.degrees(np.angle(scale)) + 45.0) % 90.0 - 45.0
    return Plate(float(middle.real), float(middle.imag), turn, float(abs(scale)), rms, at)


def nearest(shape: tuple[int, ...], balls: np.ndarray, mm_per_pixel: float) -> tuple[np.ndarray, np.ndarray]:
    """((H, W, 2) mm from the nearest ball's middle to each pixel's, (H, W) their lengths)."""
    from scipy.spatial import cKDTree

    v, u = np.mgrid[: shape[0], : shape[1]] + 0.5
    at = np.stack([u - shape[1] / 2, v - shape[0] / 2], -1) * mm_per_pixel
    distance, index = cKDTree(balls).query(at.reshape(-1, 2))
    return at - balls[index].reshape(*shape, 2), distance.reshape(shape)


def neighbour_noise(ratios: np.ndarray, flats: np.ndarray, use: np.ndarray, saturation: float) -> Noise:
    """Noise from neighbours along rows: half the squared difference of image over flat field, times the flat field.

    ratios, flats (F, H, W) less the black level;   saturation as much;   use (F, H, W) bool: the level face. The
    coating's grain counts as noise."""
    level = (flats[..., 1:] + flats[..., :-1]) / 2
    square = (np.diff(ratios, axis=2) * level) ** 2 / 2
    both = use[..., 1:] & use[..., :-1] & (level < 0.9 * saturation)
    if both.sum() < 50 * LEVELS:
        raise BadCapture(
            f"{int(both.sum())} pixels of the level face are in view, {50 * LEVELS} needed to estimate the noise; "
            "give scans of fewer balls, or --bin less"
        )
    order = np.argsort(level[both], kind="stable")
    groups = [(level[both][g], square[both][g]) for g in np.array_split(order, LEVELS)]
    light = np.array([g.mean() for g, _ in groups])
    # by the median, which a speck of dust does not move
    variance = np.array([np.median(s) / OF_GAUSSIAN for _, s in groups])
    # in the dark neighbours round alike: the steps of a camera of 8 bit do not average in blocks
    steps = STEP**2 / 12
    weight = np.array([float(len(g)) for g, _ in groups])
    found = noise_of_levels(light, np.maximum(variance - steps, 0.1 * variance), weight, saturation)
    return replace(found, dark_noise=math.sqrt(found.dark_noise**2 + steps))


def blemishes(ratio: np.ndarray, sd: np.ndarray, offset: np.ndarray, radius: float) -> np.ndarray:
    """(H, W) bool: dust, hair and glints, one pixel around them included.

    On the balls values are held against a shading that is linear in the normal, on the level face against the median
    around them; by `sd` of noise, or by how far half of the values scatter where that is more.
    ratio, sd (H, W);   offset (H, W, 2) mm from the nearest ball's middle"""
    from scipy.ndimage import binary_dilation, median_filter

    distance, found = np.hypot(*np.moveaxis(offset, -1, 0)), np.zeros(ratio.shape, bool)
    ball, level = distance < BALL * radius, distance > NEAR * radius
    shading = _normals(offset[ball], radius)
    residual = ratio - median_filter(np.where(level, ratio, np.median(ratio[level])), AROUND)
    residual[ball] = ratio[ball] - shading @ np.linalg.lstsq(shading, ratio[ball], rcond=None)[0]
    for area in (ball, level):
        spread = np.median(np.abs(residual[area])) / 0.6745  # of a Gaussian, its standard deviation
        found |= area & (np.abs(residual) > BLEMISH * np.maximum(sd, spread))
    return binary_dilation(found, iterations=1)


def _normals(offset: np.ndarray, radius: float) -> np.ndarray:
    """(n, 4): x, y and z of balls' normals, towards the camera, and 1."""
    x, y = (offset / radius).T
    return np.column_stack([x, y, np.sqrt(1 - x * x - y * y), np.ones(len(x))])


def light_of(ratio: np.ndarray, offset: np.ndarray, use: np.ndarray, radius: float) -> np.ndarray:
    """(3,) l of the least-squares fit ratio = l.n + c on balls; n points to the camera (x right, y down)."""
    return np.linalg.lstsq(_normals(offset[use], radius), ratio[use], rcond=None)[0][:3]


def depth_by_shadows(ratio: np.ndarray, offset: np.ndarray, radius: float, light: np.ndarray) -> float | None:
    """Depth d (mm) of balls whose shadows, in light of the elevation e, end x mm from their middles:

        x = R / sin e - (R - d) / tan e

    a ray that touches the ball, from the height at which it does to the level face. The shadow ends half-way between
    its darkest and the level face, in the mean over all balls. None where no shadow falls beyond the ball.

    ratio (H, W) of image over flat field;   offset (H, W, 2) mm from the nearest ball;   light as `light_of` has it"""
    flat = float(np.hypot(*light[:2]))
    elevation = math.atan2(light[2], flat)
    if not (flat > 0 and 0 < elevation < math.pi / 2):
        return None
    away = -offset @ (light[:2] / flat)
    across = np.abs(offset @ (np.array([-light[1], light[0]]) / flat))
    edges = np.arange(0.0, 2.0 + 1e-9, 0.05) * radius
    near = (across < BEHIND * radius) & (away > 0) & (away < edges[-1])
    count = np.histogram(away[near], edges)[0]
    if (count == 0).any():
        return None
    profile = np.histogram(away[near], edges, weights=ratio[near])[0] / count
    darkest, end = int(np.argmin(profile)), len(profile) - 1
    half = (profile[darkest] + 1) / 2
    if profile[darkest] > DARK or profile[end] < half:
        return None
    while profile[end - 1] > half:
        end -= 1
    share = (half - profile[end - 1]) / (profile[end] - profile[end - 1])
    x = (edges[end] + (share - 0.5) * (edges[1] - edges[0])) if end else 0.0
    depth = radius - (radius / math.sin(elevation) - x) * math.tan(elevation)
    # a ball that stands lower than where the ray would touch it casts no shadow beyond itself
    return depth if radius * (1 - math.cos(elevation)) < depth < 2 * radius else None


# -- importing -------------------------------------------------------------------------------------------------------
def import_scans(
    source: str | Path,
    folder: str | Path,
    *,
    bin: int | None = None,
    saturation: float = 255.0,
    black_level: float | None = None,
    mapped: Sequence[str] = (),
    overwrite: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
) -> Imported:
    """Write scans of pressed plates as a capture set with its scene; see the module's text for what is derived.

    bin      pixels per side that are averaged into one, None: BIN, or as many as leave an image; rows and columns that
             fill no block are left out, as many on both sides
    black_level   DN without light; None: what the noise says, or 0
    mapped   names of further scans, whose maps of heights press the gel

    Raises BadCapture, OutputExists; UnknownKey for a name that no scan has."""
    tick = progress or (lambda *_: None)
    read = scans_in(Path(source), mapped)
    scans, flat = read.plates, read.flat
    first = scans[0]
    height, width = first.images.shape[1:3]
    most = min(height, width) // 32
    bin = max(min(BIN, most), 1) if bin is None else bin
    if not 1 <= int(bin) == bin <= most:
        raise BadCapture(f"{source}: bin = {bin}; allowed: whole numbers from 1 to {most}")
    if black_level is not None and not 0 <= black_level < saturation:
        raise BadCapture(
            f"--black-level {black_level:g} DN; allowed: 0 or more and below saturation, {saturation:g} DN: the mean "
            "of an image with the lens covered"
        )
    darkest = min(float(np.median(i)) for i in flat.images)
    if black_level is not None and black_level >= darkest:
        raise BadCapture(
            f"--black-level {black_level:g} DN: {flat.name}, the flat field, has no more than {darkest:g} DN under one "
            "of the LEDs; allowed: less, the mean of an image with the lens covered"
        )
    scale, warnings = first.mm_per_pixel * bin, list(read.unused)
    steps = len(scans) + 1
    tick("import", 0, steps)
    black = black_levels([i for s in (*scans, *read.mapped, flat) for i in s.images])
    told = None
    if black_level is None and black == [None]:
        told = photon_noise([s.images[..., 0] for s in (*scans, flat)], saturation, STEP)
    pedestal = black_level if black_level is not None else round(told.black_level, 2) if told else 0.0
    flats = np.stack([filled(i, bin, saturation, black)[..., 0] for i in flat.images])
    plates, cut, settings, motions = [], [], [], {}
    for done, scan in enumerate(scans, 1):
        plate = plate_of(scan)
        warnings += [*scan.remarks, *_contradictions(scan, plate, first)]
        plates.append(plate)
        cut.append(np.stack([filled(i, bin, saturation, black)[..., 0] for i in scan.images]))
        pose = dict(zip(POSE, (plate.x, plate.y, 0.0, 0.0, 0.0, plate.turn)))
        settings.append({key: round(float(value), 6) for key, value in pose.items()})
        motion = skin_motion(
            flat.images[..., 0], scan.images[..., 0], plate.balls, plate.spacing, scan.radius, scan.mm_per_pixel
        )
        if motion:
            motions[scan.name] = motion
            settings[-1] |= {f"gel.{key}": float(f"{value:.4g}") for key, value in motion.settings().items()}
        tick("import", done, steps)
    shape = flats.shape[1:]
    offsets, distances = zip(*(nearest(shape, p.balls, scale) for p in plates))
    above = np.maximum(flats - pedestal, STEP)
    ratios = [(images - pedestal) / above for images in cut]
    level = np.stack([np.broadcast_to(d > NEAR * s.radius, flats.shape) for d, s in zip(distances, scans)])
    noise = neighbour_noise(
        np.concatenate(ratios), np.concatenate([above] * len(scans)), level.reshape(-1, *shape), saturation - pedestal
    )
    noise = replace(noise, black_level=pedestal, saturation=saturation)
    lights = _lights(scans, ratios, offsets, distances)
    for pose, *shown in zip(settings, scans, ratios, offsets):
        pose["gel.press_depth"] = round(_depth(*shown, lights), 6)
    for scan in read.mapped:
        settings.append(_mapped_pose(scan))
        warnings.append(
            f"{scan.name}: pressed by {HEIGHTS}, which was derived from images, and held out of a fit; if you name "
            f"others to hold out, name it too: '--hold-out {shlex.quote(scan.name)}'"
        )
    frames, masked, dark, drift = [], [], [], []
    for scan, images, ratio, offset, pose in zip(scans, cut, ratios, offsets, settings):
        for k, label in enumerate(scan.labels):
            # a ratio has the noise of the image and of the flat field
            sd = noise.sd(flats[k]) * math.sqrt(2) / above[k]
            off = blemishes(ratio[k], sd, offset, scan.radius)
            masked.append(float(off.mean()))
            lost = _cut_off(images[k], flats[k], black)
            dark.append(float(lost.mean()))
            level_face = np.hypot(*np.moveaxis(offset, -1, 0)) > NEAR * scan.radius
            drift.append(float(np.median(ratio[k][level_face & ~lost])))
            frames.append(_frame(scan, label, images[k], flats[k], ~(off | lost), pose))
    for scan, pose in zip(read.mapped, settings[len(scans) :]):
        for label, whole, level in zip(scan.labels, scan.images, flats):
            image = filled(whole, bin, saturation, black)[..., 0]
            lost = _cut_off(image, level, black)
            dark.append(float(lost.mean()))
            frames.append(_frame(scan, label, image, level, ~lost, pose))
    if max(masked) > 0:
        warnings.append(
            f"dust, hair or glints: {100 * float(np.mean(masked)):.2g} % of the values are masked, up to "
            f"{100 * max(masked):.2g} % of a frame"
        )
    corrections = _corrections(bin, masked)
    if told:
        text = f"{told.black_level:.3g} +- {told.sd:.2g} DN, where the line of photon noise against signal ends"
        corrections.append(
            correction("a black level that nobody stated is written to captures.toml", text, "all images")
        )
    if max(dark) > 0:
        remark, entry = black_text(black, [float(np.mean(dark))])
        warnings.append(remark)
        corrections.append(entry)
    remark = drift_text(np.array(drift)[:, None], [f.name for f in frames])
    if remark:
        warnings.append(f"{remark}; left as it is: light that the balls throw on the level face looks the same")
    if motions and len(motions) < len(settings):
        for pose in settings:  # a column of all frames or of none
            pose |= {f"gel.{key}": pose.get(f"gel.{key}", 0.0) for key in STRETCH}
    facts = _facts(source, scans, flat, plates, motions, bin, scale, shape, noise, lights, warnings)
    facts["corrections"] = corrections
    facts["black_level"] = _pedestal(black_level, told, black != [None])
    if read.mapped:
        facts["heightmaps"] = [scan.name for scan in read.mapped]
        facts["setup"]["held_out"] = [scan.name for scan in read.mapped]
    path = write_set(
        Path(folder),
        frames,
        noise,
        None,
        _scene(facts, scans, lights),
        facts,
        bits=None,
        overwrite=overwrite,
        text=readme(facts),
        files={settings["gel.indenter"]: scan.heights for scan, settings in zip(read.mapped, settings[len(scans) :])},
    )
    tick("import", steps, steps)
    return Imported(path, warnings, facts)


def _mapped_pose(scan: Scan) -> dict[str, float | str]:
    """Settings with which a map of heights presses the gel: its middle in the middle of the image, and so deep that all
    of it touches."""
    heights, _ = read_tmd(scan.heights, str(scan.heights))
    pose: dict[str, float | str] = dict.fromkeys(POSE, 0.0)
    deep = math.ceil(1e3 * float(np.ptp(heights))) / 1e3
    return pose | {"gel.press_depth": deep, "gel.indenter": f"{MAPS}/{scan.name}.tmd", "gel.indenter_size": 1.0}


def _cut_off(image: np.ndarray, flat: np.ndarray, black: np.ndarray) -> np.ndarray:
    """(H, W) bool: where image or flat field are cut off below."""
    return at_black(image[..., None], black)[..., 0] | at_black(flat[..., None], black)[..., 0]


def _frame(scan: Scan, label: str, image: np.ndarray, flat: np.ndarray, mask: np.ndarray, pose: Mapping) -> Frame:
    """The frame of a scan under one LED."""
    on = {f"led_{other}.power": float(other == label) for other in scan.labels}
    frame = Frame(f"{scan.name}_{label}", image[..., None].astype(np.float32), mask, scan.name, {**pose, **on})
    frame.flat_field = flat[..., None].astype(np.float32)
    return frame


def _corrections(bin: int, masked: Sequence[float]) -> list[dict[str, str]]:
    found = []
    if bin > 1:
        found.append(correction("pixels are averaged", f"blocks of {bin} x {bin} px", "all images and flat fields"))
    if max(masked) > 0:
        share = f"{100 * float(np.mean(masked)):.2g} % of the values, up to {100 * max(masked):.2g} % of a frame"
        found.append(correction("dust, hair and glints are masked", share, "each plate and LED"))
    return found


def _contradictions(scan: Scan, plate: Plate, first: Scan) -> list[str]:
    """In sentences; raises BadCapture where circles are of no such plate."""
    found = []
    if not 0.5 < plate.spacing / scan.spacing < 2 or plate.rms > scan.radius:
        raise BadCapture(
            f"{scan.name}: circles are {plate.spacing:.4g} mm apart and miss a square grid by {plate.rms:.2g} mm rms; "
            f"allowed: about calibspacing = {scan.spacing:g} mm apart, and less than a ball's radius of "
            f"{scan.radius:g} mm off; annotate them again, or correct mmperpixel"
        )
    if abs(plate.spacing / scan.spacing - 1) > ALIKE:
        found.append(
            f"{scan.name}: balls are {plate.spacing:.4g} mm apart by their circles and mmperpixel, {scan.spacing:.4g} "
            "mm by calibspacing: one of the two is wrong"
        )
    if plate.rms > 0.1 * scan.radius:
        found.append(
            f"{scan.name}: circles miss a square grid by {plate.rms:.2g} mm rms, {plate.rms / scan.radius:.0%} of a "
            "ball's radius"
        )
    if abs(scan.mm_per_pixel / first.mm_per_pixel - 1) > ALIKE:
        found.append(
            f"{scan.name}: {scan.mm_per_pixel:.4g} mm/px, but {first.mm_per_pixel:.4g} in {first.name}: one camera has "
            "one scale"
        )
    return found


def _lights(
    scans: Sequence[Scan], ratios: Sequence[np.ndarray], offsets: Sequence[np.ndarray], distances: Sequence[np.ndarray]
) -> dict[str, np.ndarray]:
    """Label -> mean of the directions that the scans show."""
    found: dict[str, list[np.ndarray]] = {}
    for scan, ratio, offset, distance in zip(scans, ratios, offsets, distances):
        inside = distance < BALL * scan.radius
        for label, one in zip(scan.labels, ratio):
            found.setdefault(label, []).append(light_of(one, offset, inside, scan.radius))
    return {label: np.mean(several, 0) for label, several in found.items()}


def _depth(scan: Scan, ratios: np.ndarray, offset: np.ndarray, lights: Mapping[str, np.ndarray]) -> float:
    """Depth of a plate's balls, mm: the median over the LEDs, no more than the touched radius of a whole ball."""
    found = [depth_by_shadows(one, offset, scan.radius, lights[label]) for label, one in zip(scan.labels, ratios)]
    known = [depth for depth in found if depth is not None]
    if not known:
        return scan.radius * (1 - math.sqrt(1 - CONTACT**2))
    return min(float(np.median(known)), scan.radius)


def _facts(
    source, scans, flat, plates, motions: Mapping[str, SkinMotion], bin, scale, shape, noise, lights, warnings
) -> dict:
    azimuths = {label: math.degrees(math.atan2(y, x)) for label, (x, y, _) in lights.items()}
    return {
        "source": str(source),
        "scans": {
            s.name: {
                "balls": len(s.circles),
                "x_mm": p.x,
                "y_mm": p.y,
                "turn_deg": p.turn,
                "spacing_mm": p.spacing,
                "circles_off_rms_mm": p.rms,
                "skin_motion": _motion(motions.get(s.name)),
            }
            for s, p in zip(scans, plates)
        },
        "flat_field": flat.name,
        "size_px": list(shape),
        "bin": bin,
        "ball_radius_mm": scans[0].radius,
        "ball_spacing_mm": scans[0].spacing,
        "mm_per_pixel": scans[0].mm_per_pixel,
        "mm_per_pixel_after_binning": scale,
        "camera_distance_mm": CAMERA,
        "x_fov_deg": math.degrees(2 * math.atan(shape[1] * scale / 2 / CAMERA)),
        "noise": {"system_gain": noise.system_gain, "dark_noise": noise.dark_noise},
        "light_azimuths_deg": azimuths,
        "setup": {
            # depth, tilt and the skin between the balls do not matter there
            "region": "known",
            "free": ["board.[xyz]", "board.scale", "led_*.turn"],
            "per_group": ["gel.press_[xy]"],
            "flat_field": "multiplicative",
            "priors": {
                "board.[xy]": [None, CENTRED],
                "board.z": [None, 0.7 * DISTANCE],
                "board.scale": [None, 0.7],
                "led_*.turn": [None, 30.0],
                "gel.press_[xy]": [None, ANNOTATED * scans[0].mm_per_pixel],
            },
        },
        "warnings": warnings,
    }


def _pedestal(given: float | None, told: PhotonNoise | None, cut_off: bool) -> dict[str, Any]:
    """The black level that was written, and where it is from."""
    if given is not None:
        return {"DN": given, "by": "given"}
    if told is None:
        return {"DN": 0.0, "by": "values are cut off below" if cut_off else "assumed"}
    return {"DN": round(told.black_level, 2), "sd_DN": round(told.sd, 2), "by": "photon noise"}


def _motion(motion: SkinMotion | None) -> dict[str, Any] | None:
    if motion is None:
        return None
    return {
        "areal_stretch": list(motion.extremes()),
        "places_agree": list(motion.places),
        "places_off_rms_mm": motion.rms,
        "coefficients": motion.coefficients.tolist(),
        "half_width_mm": motion.half_width,
    }


def _scene(facts: Mapping, scans: Sequence[Scan], lights: Mapping[str, np.ndarray]) -> str:
    template = (shipped("scenes") / "templates" / "led_scans.xml").read_text(encoding="utf-8")
    (height, width), scale = facts["size_px"], facts["mm_per_pixel_after_binning"]
    view = max(height, width) * scale
    ball = facts["ball_radius_mm"]
    return template.format(
        source=comment(facts["source"]),
        width=width,
        height=height,
        x_fov=f"{facts['x_fov_deg']:.6g}",
        distance=f"{CAMERA:g}",
        scale=f"{scale:.6g}",
        ball=f"{ball:g}",
        spacing=f"{facts['ball_spacing_mm']:g}",
        thickness=f"{THICKNESS:g}",
        gel_width=f"{1.15 * width * scale:.4g}",
        gel_length=f"{1.15 * height * scale:.4g}",
        # the maps about the ball nearest to the middle reach beyond the gel, where they fade out over an eighth
        extent=f"{(0.58 * view + facts['ball_spacing_mm'] / 2) / 0.85:.4g}",
        pitch=f"{ball / MESH:.4g}",
        map_pitch=f"{ball / MAP:.4g}",
        columns=2 * math.ceil(0.58 * width * scale / (ball / MESH)) + 1,
        rows=2 * math.ceil(0.58 * height * scale / (ball / MESH)) + 1,
        smoothing=f"{0.1 * ball:.3g}",
        skirt=f"{0.1 * ball:.3g}",
        **_ring(lights),
    )


def _ring(lights: Mapping[str, np.ndarray]) -> dict[str, str]:
    """The board's height and its LEDs as XML: on one circle, each in the direction that the balls' shading shows, at
    the mean elevation."""
    elevations = [math.atan2(z, math.hypot(x, y)) for x, y, z in lights.values()]
    elevation = min(max(float(np.mean(elevations)), 0.3), 1.2)
    radius, height = DISTANCE * math.cos(elevation), DISTANCE * math.sin(elevation)
    leds = [_led(label, math.atan2(y, x), radius, height) for label, (x, y, _) in lights.items()]
    return {"board_z": f"{-height:.4g}", "leds": "\n".join(leds)}


def _led(label: str, azimuth: float, radius: float, height: float) -> str:
    place = f'x="{radius * math.cos(azimuth):.5g}" y="{radius * math.sin(azimuth):.5g}"'
    return f"""    <emitter type="led" id="led_{label}">
        <string name="board" value="board"/>
        <point name="position" {place} z="0"/>
        <point name="target" x="0" y="0" z="{height:.4g}"/>
        <float name="mu" value="0"/>
        <float name="power" value="0"/>
    </emitter>"""


def readme(facts: Mapping) -> str:
    """The import in sentences, contradictions first."""
    height, width = facts["size_px"]
    places = [
        f"- {name}: {s['balls']} balls, {s['spacing_mm']:.4f} mm apart, turned by {s['turn_deg']:.3f} deg; circles "
        f"miss the grid by {1000 * s['circles_off_rms_mm']:.2g} um rms"
        for name, s in facts["scans"].items()
    ]
    azimuths = ", ".join(f"{label} {a:.1f}" for label, a in facts["light_azimuths_deg"].items())
    return "\n".join(
        [
            f"Plates of balls under one LED at a time, from {facts['source']}",
            "",
            "Contradictions and blemishes",
            *([f"- {text}" for text in facts["warnings"]] or ["- none found"]),
            "",
            "Corrections",
            *(sentences(facts["corrections"]) or ["- none"]),
            "",
            "Given",
            f"- balls of {facts['ball_radius_mm']:g} mm radius, {facts['ball_spacing_mm']:g} mm apart; "
            f"{facts['mm_per_pixel']:.6g} mm/px",
            f"- flat field: {facts['flat_field']}, one for each LED",
            *(f"- {name}: the shape of its {HEIGHTS}" for name in facts.get("heightmaps", ())),
            "",
            "Derived",
            *places,
            *_stretched(facts["scans"]),
            f"- images of {width} x {height} px, means of blocks of {facts['bin']} px",
            f"- noise: {facts['noise']['system_gain']:.3g} DN/DN and {facts['noise']['dark_noise']:.3g} DN, by "
            "neighbours of the level face; the coating's grain counts as noise",
            f"- black level: {_of_pedestal(facts['black_level'])}",
            f"- lights in scene.xml: azimuths {azimuths} deg by the balls' shading, seen from the middle of the view; "
            "assumed: one circle, parallel to the face, its distance, lights without a lobe; calibrate them",
            "",
            "Advised for a calibration (import.json)",
            "- region known: where balls touch, and half-way between them, the shape is known, and only the optics can "
            "be wrong; '--region all' fits the skin between them as well, with gel.skirt and gel.smoothing free",
            "- free: the circle's middle, height and size, and where on it each LED stands (turn)",
            "",
        ]
    )


def _of_pedestal(fact: Mapping[str, Any]) -> str:
    if fact["by"] == "given":
        return f"{fact['DN']:g} DN, given"
    if fact["by"] != "photon noise":
        why = "the noise of the images tells none" if fact["by"] == "assumed" else fact["by"]
        return (
            f"0 DN, assumed: {why}; take an image with the lens covered and import again with '--black-level' its mean"
        )
    return (
        f"{fact['DN']:.3g} +- {fact['sd_DN']:.2g} DN, where the line of photon noise against signal ends. Dark noise "
        "of r DN makes it r^2/K too low, with K DN of variance per DN of light. Better: take an image with the lens "
        "covered and give its mean as '--black-level'"
    )


def _stretched(scans: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """What the grain of the coating says of each scan, a sentence each."""
    found = []
    for name, facts in scans.items():
        if (motion := facts["skin_motion"]) is None:
            found.append(f"- {name}: the coating's grain is not found again in the flat field; no stretch is stated")
            continue
        low, high = (100 * share for share in motion["areal_stretch"])
        agree, tried = motion["places_agree"]
        found.append(
            f"- {name}: the skin is stretched by {low:.2g} to {high:.2g} % of its area against the flat field "
            f"({agree} of {tried} places of its grain agree, within {1000 * motion['places_off_rms_mm']:.2g} um rms)"
        )
    return found
