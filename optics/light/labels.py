"""What a learner is told beside an image: forces, pressure, shear, displacement, pose and markers of a press.

    found = labels.of(scene, position, seen, ("force", "markers"))
    found.channels     EXR name -> (H, W), per pixel
    found.numbers      for the manifest: name -> number or list
    found.arrays       for an .npz: what is per node

    force         numbers `force` (N along x, y and into the skin), `torque` (N mm about z), `contact_area` (mm^2);
                  arrays `force` (n, n, 3) N per node at `x`, `y` (mm), `slip`
    pressure      channels `pressure.Y` (N/mm^2), `traction.X`, `.Y` (N/mm^2), `slip.Y` (1 where the skin slides)
    displacement  channels `displacement.X`, `.Y`, `.Z` (mm, world axes) of the elastic skin at its face; arrays
                  `displacement` (m, m, 3) at `skin_x`, `skin_y`; number `dent_difference` (mm, rms)
    height        channel `height.Z` (mm, z of the face that is rendered); array `height` at `skin_x`, `skin_y`
    pose          numbers `pose`: where the indenter stands and how it is turned, and its shape
    markers       numbers `markers` (N rows u, v in px now), `markers_at_rest`, `marker_motion`, `markers_3d` (mm)

The dent that is rendered is geometry (optics.skin.contact); forces and displacement are those of an elastic skin under
the same indenter at the same depth (optics.skin.pressing). `dent_difference` says how far the two are apart: the root
of the mean square over the press's surroundings. Per pixel, loads are those at the place that the pixel sees.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from optics.errors import BadScene, UnknownKey
from optics.files.output import replacing
from optics.scene.loader import Scene

LABELS = ("force", "pressure", "displacement", "height", "pose", "markers")
NUMBERS = {  # name -> unit and meaning of what goes to the manifest; of a pose those of the scene's parameters
    "force": ("N", "of the indenter on the skin, along x, y and into the skin"),
    "torque": ("N mm", "of the indenter on the skin about the press axis, from x to y"),
    "contact_area": ("mm^2", "touched area"),
    "dent_difference": ("mm", "rms distance of the rendered face from the elastic one about the press"),
    "markers": ("px", "u, v of each marker's cap in the image"),
    "markers_at_rest": ("px", "u, v while nothing presses"),
    "marker_motion": ("px", "u, v now less those at rest"),
    "markers_3d": ("mm", "x, y, z of each marker's cap"),
}
ARRAYS = {  # of what is per node
    "force": ("N", "on each node along x, y and into the skin"),
    "x": ("mm", "of the columns of nodes of force"),
    "y": ("mm", "of the rows of nodes of force"),
    "slip": ("", "whether a node slides"),
    "displacement": ("mm", "of the elastic skin's face, along the world's axes"),
    "height": ("mm", "z of the rendered face"),
    "skin_x": ("mm", "of the columns of nodes of displacement and height"),
    "skin_y": ("mm", "of the rows of nodes of displacement and height"),
}
CHANNELS = {  # of what is per pixel
    "pressure": ("N/mm^2", "of the indenter on what a pixel sees"),
    "traction": ("N/mm^2", "shear of the indenter on what a pixel sees, along x and y"),
    "slip": ("", "1 where the skin slides"),
    "displacement": ("mm", "of the elastic skin at what a pixel sees, along the world's axes"),
    "height": ("mm", "z of the rendered face"),
}
NODES = 81  # a side, of the arrays over the whole skin
NEWTON = 12  # steps to a marker's pixel
STEP = 0.5  # px, of differences of the camera's rays


@dataclass
class Labels:
    """Labels of one image, by the kind of file that they go to."""

    channels: dict[str, np.ndarray] = field(default_factory=dict)
    numbers: dict[str, object] = field(default_factory=dict)
    arrays: dict[str, np.ndarray] = field(default_factory=dict)


def check(scene: Scene, names: Sequence[str]) -> None:
    """Raises BadScene for labels that a scene does not have."""
    for name in names:
        if lacks := _lacking(scene, name):
            raise BadScene(f"{scene.path}: no label '{name}': the scene lacks {lacks}; leave it out of the labels")


def _lacking(scene: Scene, name: str) -> str:
    """What a label needs that the scene does not have; empty for nothing."""
    if name == "markers":
        return "" if _markers(scene) and scene.camera is not None else "a part 'markers' before a part 'camera'"
    if name == "force" and scene.block is not None:
        return ""
    if name == "pose" and (scene.gel or scene.block) is not None:
        return ""
    return "" if hasattr(scene.gel, "touching") else "a skin that is pressed, such as the part 'gel'"


def named(scene: Scene, text: str | None) -> tuple[str, ...]:
    """The labels of a command line: names by commas, or `all` that the scene has. Raises UnknownKey, BadScene."""
    if text is None:
        return ()
    if text.strip() == "all":
        return tuple(name for name in LABELS if not _lacking(scene, name))
    names = tuple(dict.fromkeys(part.strip() for part in text.split(",")))
    for name in names:
        if name not in LABELS:
            raise UnknownKey(name, [*LABELS, "all"], "label", "--labels")
    return names


def described(scene: Scene, names: Sequence[str]) -> dict[str, dict[str, str]]:
    """Name of a number or of a pose's part -> unit and meaning, of these labels of a scene."""
    if not names:
        return {}
    told = of(scene, None, None, names).numbers
    found = {name: dict(zip(("unit", "doc"), NUMBERS[name])) for name in told if name != "pose"}
    part = scene.gel if scene.gel is not None else getattr(scene.block, "target", None)
    for name in told.get("pose", {}):
        own = scene.parameters.get(f"{part.name}.{name}")
        found[f"pose.{name}"] = {"unit": own.unit, "doc": own.doc} if own is not None else {"unit": "", "doc": ""}
    return found


def of(scene: Scene, position: np.ndarray | None, seen: np.ndarray | None, names: Sequence[str]) -> Labels:
    """The labels of the scene as it is set now.

    position   (H, W, 3) mm: what the pixels' centres see; seen  (H, W) bool: whether that is the skin's pressed face.
               None: no channels
    """
    found = Labels()
    if "pose" in names:
        found.numbers["pose"] = _pose(scene)
    if "markers" in names:
        _put_markers(scene, found)
    if scene.gel is None or not hasattr(scene.gel, "touching"):
        if "force" in names:
            pressed = scene.block.press()
            force = [0.0, 0.0, 0.0] if pressed is None else [*map(float, pressed.force)]
            found.numbers["force"] = [force[0], force[1], 0.0 - force[2]]  # into the skin
        return found
    if set(names) <= {"pose", "markers"}:
        return found
    gel = scene.gel
    touch, press = gel.touching(), (gel.numbered("press x"), gel.numbered("press y"))
    if "force" in names:
        found.numbers |= {"force": [*map(float, touch.force)], "torque": touch.torque, "contact_area": touch.area}
        found.arrays |= {"force": touch.forces, "x": press[0] + touch.axis, "y": press[1] + touch.axis}
        found.arrays["slip"] = touch.slip
    x, y = (gel.numbered(side) / 2 * np.linspace(-1, 1, NODES) for side in ("width", "length"))
    flat = np.zeros((0, 0)) if position is None else position[..., 0]
    at = (flat, flat) if position is None else (position[..., 0], position[..., 1])
    shown = np.zeros((0, 0), bool) if seen is None else seen
    if "pressure" in names and position is not None:
        inside = shown & (_at(touch.touched.astype(float), touch.pitch, press, *at) > 0.5)
        for name, load in (
            ("pressure.Y", touch.pressure),
            ("traction.X", touch.shear[..., 0]),
            ("traction.Y", touch.shear[..., 1]),
        ):
            found.channels[name] = np.where(inside, _at(load, touch.pitch, press, *at), 0.0)
        found.channels["slip.Y"] = (inside & (_at(touch.slip.astype(float), touch.pitch, press, *at) > 0.5)).astype(
            np.float32
        )
    if "displacement" in names:
        signs = np.array([1.0, 1.0, -1.0])[:, None, None]
        grid = signs * _moved(gel, touch, press, x[None, :], y[:, None])
        found.arrays |= {"displacement": np.moveaxis(grid, 0, -1), "skin_x": x, "skin_y": y}
        rendered = gel.heights(x, y)
        near = np.hypot(x[None, :] - press[0], y[:, None] - press[1]) < gel.numbered("thickness") + touch.axis[-1]
        found.numbers["dent_difference"] = (
            float(np.sqrt(np.mean((grid[2] - rendered)[near] ** 2))) if near.any() else 0.0
        )
        if position is not None:
            for name, moved in zip("XYZ", signs * _moved(gel, touch, press, *at)):
                found.channels[f"displacement.{name}"] = np.where(shown, moved, 0.0)
    if "height" in names:
        found.arrays |= {"height": gel.heights(x, y), "skin_x": x, "skin_y": y}
        if position is not None:
            found.channels["height.Z"] = np.where(shown, position[..., 2], 0.0)
    return found


def _moved(gel, touch, press, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(3, ...) mm along x, y and into the skin: the elastic displacement of the face that is seen, at places on it."""
    if not hasattr(gel, "carry"):
        return touch.moved(x, y, press)
    x, y = np.broadcast_arrays(x, y)
    moved = gel.carry(x, y, np.zeros(1)) - np.stack([x, y, np.zeros(x.shape)], -1)
    return np.moveaxis(moved, -1, 0) * np.array([1.0, 1.0, -1.0])[:, None, None]


def _at(values: np.ndarray, pitch: float, press: tuple[float, float], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A grid around the press at places, linear between the nodes; 0 outside."""
    from scipy.ndimage import map_coordinates

    middle = (len(values) - 1) / 2
    at = [(y - press[1]) / pitch + middle, (x - press[0]) / pitch + middle]
    return map_coordinates(values, at, order=1, mode="constant")


def _pose(scene: Scene) -> dict[str, float | str]:
    """The values that say where and how the skin is pressed, by their names: a gel's own, or those of a block's
    target."""
    part = scene.gel if scene.gel is not None else scene.block.target
    if part is None:
        return {}
    names = getattr(part, "pressing", (*part.numbers, *part.words))
    return {n: part.held[n] if n in part.held else getattr(part, n) for n in names}


# -- Markers ---------------------------------------------------------------------------------------------------------
def _markers(scene: Scene) -> list:
    return [part for part in scene.parts.values() if hasattr(part, "centres_at_rest")]


def _put_markers(scene: Scene, found: Labels) -> None:
    now = np.concatenate([part.centres() for part in _markers(scene)])
    still = np.concatenate([part.centres_at_rest() for part in _markers(scene)])
    pixels, before = project(scene.camera, now), project(scene.camera, still)
    found.numbers |= {
        "markers": _rows(pixels),
        "markers_at_rest": _rows(before),
        "marker_motion": _rows(pixels - before),
        "markers_3d": _rows(now),
    }


def _rows(table: np.ndarray) -> list[list[float | None]]:
    """Rows for JSON: None where there is no number."""
    return [[float(v) if np.isfinite(v) else None for v in row] for row in np.round(table, 5)]


def project(camera, points: np.ndarray) -> np.ndarray:
    """(N, 2) px: where a camera of any law sees points (N, 3), mm; NaN for those outside its image. The straight way:
    without what refracts in between.

    The camera's own rays are turned around by Newton's steps, from the nearest of a coarse grid."""
    import drjit as dr
    import mitsuba as mi

    width, height = camera.resolution

    def rays(uv):
        with dr.suspend_grad():
            origin, d = camera.ray(*(mi.Float(uv[:, i].astype(np.float32)) for i in (0, 1)))
        return np.array(origin, float).T, np.array(d, float).T

    def towards(origin, at):
        """Directions of points from where rays start."""
        way = at - origin
        return way / np.linalg.norm(way, axis=-1, keepdims=True)

    def off(uv):
        """How far the rays' directions are from those of the points."""
        origin, d = rays(uv)
        return d - towards(origin, points)

    u, v = np.meshgrid(np.linspace(0, width, 17), np.linspace(0, height, 17))
    grid = np.stack([u.ravel(), v.ravel()], -1)
    cosines = np.stack([np.nan_to_num(towards(o, points) @ d, nan=-1.0) for o, d in zip(*rays(grid))], 1)
    uv = grid[np.argmax(cosines, axis=1)]
    for _ in range(NEWTON):
        here, right, down = (off(uv + shift) for shift in ((0, 0), (STEP, 0), (0, STEP)))
        slope = np.stack([right - here, down - here], -1) / STEP
        square = np.swapaxes(slope, 1, 2) @ slope
        step = np.swapaxes(slope, 1, 2) @ here[..., None]
        uv = np.clip(uv - np.linalg.solve(square, step)[..., 0], (-width, -height), (2 * width, 2 * height))
    apart = np.linalg.norm(off(uv), axis=-1)
    pixel = np.linalg.norm(slope, axis=1).min(-1)
    inside = (uv >= 0).all(-1) & (uv <= (width, height)).all(-1) & (apart < 0.05 * pixel)
    return np.where(inside[:, None], uv, np.nan)


def on_skin(scene: Scene, hits) -> np.ndarray:
    """(H, W) bool: whether a pixel's centre sees the face that is pressed."""
    import mitsuba as mi

    return hits.valid & hits.image(hits.si.shape == mi.ShapePtr(scene.gel)).astype(bool)


def flat(numbers: Mapping[str, object], name: str = "") -> dict[str, object]:
    """Labels as columns of a table: force.0, force.1 ..., pose.press_x, markers.0.0 ..."""
    items = enumerate(numbers) if isinstance(numbers, list) else numbers.items()
    found: dict[str, object] = {}
    for key, value in items:
        whole = f"{name}.{key}" if name else str(key)
        found |= flat(value, whole) if isinstance(value, (dict, list)) else {whole: value}
    return found


def write(path: Path, arrays: Mapping[str, np.ndarray]) -> Path:
    """Write an .npz, whole or not at all; the same arrays give the same bytes."""
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    return path
