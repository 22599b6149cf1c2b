"""Features of presses to learn forces from: of rendered images of a batch, or of beads that are projected, unrendered.

    project("train.toml", [("dense", 40)])     {("dense", 40): FeatureSet}: the motion that the beads of each press have
    measure("test.toml", [("dense", 40)])      the motion that optical flow finds in the images of `optics batch`

Both take the job file of a batch (optics.study.batch) of a scene with beads in a gel that knows its force. A press is
told by the gel's position and force. The image at rest is rendered here, of the job's sensor without a press.

Projected features share with the images what can be seen: the bead that a pixel shows is found by a ray through its
middle at rest. `dense` counts each pixel with the motion of its bead, a pixel without a bead with that of the nearest
one that has one; `sparse` counts each bead once whose middle shows. They lack what optical flow errs by, and beads that
a press covers or uncovers.

A thousand presses of the same depth differ by their place alone. Their displacement is taken from a table over radius
and depth of the bead, cubic in both (tests: true to 1e-4 of the largest). A press with a drag has no such symmetry; it
is computed bead by bead."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from optics.errors import BadScene, OutputExists
from optics.readers import flow
from optics.readers.force_learning import FeatureSet
from optics.scene.trust import Named
from optics.study import batch
from optics.study.blocks import Blocks

Readout = tuple[str, int]  # "dense" or "sparse"; bins each way
Progress = Callable[[str, int, int], None]
OFTEN = 12  # presses of the same shape from which a table is cheaper than each bead alone
AT_A_TIME = 256  # presses


class Sensor:
    """The scene of a job: beads at rest, and the gel that moves them."""

    def __init__(self, maker: batch.Maker):
        self.maker, self.scene = maker, maker.images.scene
        parts: Sequence[Any] = list(self.scene.parts.values())
        beads = [p for p in parts if hasattr(p, "centres") and hasattr(p, "diameters")]
        gel: Any = self.scene.gel
        if len(beads) != 1 or not (hasattr(gel, "carry") and hasattr(gel, "force")):
            raise BadScene(
                f"{self.scene.path}: forces are learnt of one body of beads in a gel that carries them and knows its "
                "force; allowed: a scene like particle_gel"
            )
        self.beads, self.gel = beads[0], gel
        self.x, self.y, depth, width, length = (
            str(self.scene.key(gel.name, role)) for role in ("press x", "press y", "press depth", "width", "length")
        )
        values = {**self.scene.values(), **maker.values}
        unpressed = {key: 0.0 for key in (depth, f"{gel.name}.press_force") if key in values}
        self.values, self.base = values, {**values, **unpressed}
        self.face = float(self.base[width]), float(self.base[length])
        self.scene.set(self.base)
        self.rest = self.beads.rest()
        self.at_rest = self.scene.camera.project(self.rest)
        columns, rows = self.scene.camera.resolution
        self.shape = (int(rows), int(columns))

    def hold(self, values: Mapping[str, Any]) -> tuple[np.ndarray, float]:
        """Turn the gel's numbers, without building the scene again; (2,) mm place and N force of the press."""
        prefix = f"{self.gel.name}."
        for key, value in values.items():
            if key.startswith(prefix) and not isinstance(value, str):
                self.gel.hold(key.removeprefix(prefix), float(value))
        return np.array([values[self.x], values[self.y]], float), float(self.gel.force()[2])

    def shown(self) -> np.ndarray:
        """(H, W) the number of the bead that the middle of each pixel shows at rest, -1 where there is none."""
        import mitsuba as mi
        from scipy.spatial import cKDTree

        places = flow.pixel_middles(self.shape).astype(np.float32)
        ray: Any = self.scene.camera.ray(mi.Float(places[:, 0]), mi.Float(places[:, 1]))
        met = np.array(self.scene.traced.scene.ray_intersect(mi.Ray3f(*ray)).p, float).T
        away, nearest = cKDTree(self.rest).query(met)
        on = away < 0.51 * self.beads.diameters()[nearest]  # float32 at outlines
        return np.where(on, nearest, -1).reshape(self.shape)


def weights(sensor: Sensor, shown: np.ndarray, readout: Readout) -> Any:
    """(m, N) sparse matrix: how much each bead counts in each bin, its rows summing to 1 or 0."""
    from scipy import ndimage, sparse

    kind, bins = readout
    if kind == "dense":
        _, (v, u) = ndimage.distance_transform_edt(shown < 0, return_indices=True)
        places, bead = flow.pixel_middles(shown.shape), shown[v, u].ravel()
    else:
        inside = (sensor.at_rest >= 0).all(1) & (sensor.at_rest < shown.shape[::-1]).all(1)
        column, row = np.where(inside[:, None], sensor.at_rest, 0).astype(int).T
        bead = np.nonzero(inside & (shown[row, column] == np.arange(len(sensor.rest))))[0]
        places = sensor.at_rest[bead]
    at = (places[:, 1] * bins / shown.shape[0]).astype(int) * bins + (places[:, 0] * bins / shown.shape[1]).astype(int)
    counts = sparse.csr_matrix((np.ones(len(at)), (at, bead)), (bins * bins, len(sensor.rest)))
    return sparse.diags(1 / np.maximum(np.asarray(counts.sum(1)).ravel(), 1)) @ counts


class Carried:
    """Where a press takes the beads: (N, 3) world mm by `values` of a sample."""

    def __init__(self, sensor: Sensor, samples: Sequence[dict]):
        self.sensor = sensor
        self.often = {shape for shape, n in Counter(map(self._shape, samples)).items() if n >= OFTEN}
        self.tables: dict[tuple, tuple] = {}

    def _shape(self, values: dict) -> tuple:
        """What of a press is not its place."""
        return tuple(sorted((k, v) for k, v in values.items() if k not in (self.sensor.x, self.sensor.y)))

    def __call__(self, values: dict, place: np.ndarray) -> np.ndarray:
        rest, gel = self.sensor.rest, self.sensor.gel
        x, y, depth = rest[:, 0], rest[:, 1], -rest[:, 2]
        shape = self._shape(values)
        if shape not in self.often or gel.force()[:2].any():
            return gel.carry(x, y, depth)
        if shape not in self.tables:
            self.tables[shape] = self._table(place)
        along, across = x - place[0], y - place[1]
        r = np.hypot(along, across)
        side, up = (spline.ev(r, depth) for spline in self.tables[shape])
        out = np.divide(side, r, out=np.zeros_like(r), where=r > 0)
        return rest + np.stack([out * along, out * across, up], -1)

    def _table(self, place: np.ndarray) -> tuple:
        """Displacement away from the axis and along z over radius and depth, mm."""
        from scipy.interpolate import RectBivariateSpline

        deep = -self.sensor.rest[:, 2]
        reach = 1.01 * np.hypot(*self.sensor.face)
        r = reach * np.sinh(np.linspace(0, 4, 240)) / np.sinh(4)  # 0.03 mm apart at the axis, where it bends most
        h = np.linspace(deep.min(), deep.max() + 1e-6, 28)
        grid_r, grid_h = np.meshgrid(r, h, indexing="ij")
        moved = self.sensor.gel.carry(place[0] + grid_r, np.full_like(grid_r, place[1]), grid_h)
        side, up = moved[..., 0] - place[0] - grid_r, moved[..., 2] + grid_h
        return tuple(RectBivariateSpline(r, h, a, s=0) for a in (side, up))


class Collected:
    """What is known of each press so far, and FeatureSets of it in the end."""

    def __init__(self, readouts: Sequence[Readout]):
        self.found: dict[Readout, list[tuple[np.ndarray, ...]]] = {readout: [] for readout in readouts}
        self.places: list[np.ndarray] = []
        self.forces: list[float] = []
        self.seconds = dict.fromkeys(readouts, 0.0)  # of flow and bins

    def press(self, sensor: Sensor, values: Mapping[str, Any]) -> np.ndarray:
        """Turn the gel to a press and keep its place and force; (2,) mm place."""
        place, force = sensor.hold(values)
        self.places.append(place)
        self.forces.append(force)
        return place

    def sets(self, order: Sequence[int], face: tuple[float, float], source: Mapping[str, Any]) -> dict:
        """A FeatureSet for each readout, of presses that came in the order of these indices."""
        back = np.argsort(order)
        place, force = (np.array(a, np.float32)[back] for a in (self.places, self.forces))
        made = {}
        for readout, parts in self.found.items():
            motion, size, angle = (np.concatenate(a)[back].astype(np.float32) for a in zip(*parts))
            seconds = self.seconds[readout] / len(order)
            own = {**source, **({"seconds": seconds} if seconds else {})}
            made[readout] = FeatureSet(motion, size, angle, place, force, face, readout[0], own)
        return made


def project(
    file: str | Path,
    readouts: Sequence[Readout],
    seeds: Sequence[int] | None = None,
    plugins: Named = None,
    progress: Progress | None = None,
) -> dict[Readout, FeatureSet]:
    """Features of the presses of a job file by the motion that the scene gives its beads, without an image.

    seeds   of the beads' places (the scene's definition `seed`), of which each press takes one at random; None: the
            job's own

    Raises what a batch raises of its job file, and BadScene for a scene without beads that a gel carries."""
    file = Path(file)
    job = batch.read(file)
    defines: list[dict[str, Any]] = [{}] if seeds is None else [{"seed": int(s)} for s in seeds]
    taken = np.array([job.rng(i, "bead seed").integers(len(defines)) for i in range(job.total)])
    collected, order = Collected(readouts), []  # type: ignore[var-annotated]
    for k, define in enumerate(defines):
        numbers = np.nonzero(taken == k)[0]
        if not len(numbers):
            continue
        maker = batch.Maker(job.model_copy(update={"defines": {**job.defines, **define}}), file, plugins)
        maker.check()
        sensor = Sensor(maker)
        strange = [key for key in job.sample if not key.startswith(f"{sensor.gel.name}.")]
        if strange:
            raise batch.BadJob(
                f"{file}: [sample]: {strange[0]}; presses are projected of one sensor: allowed are parameters of "
                f"{sensor.gel.name}; give it under [parameters], or render the images with optics batch"
            )
        shown = sensor.shown()
        sums = {readout: weights(sensor, shown, readout) for readout in readouts}
        samples = [{**sensor.values, **maker.draws.at(int(i))} for i in numbers]
        carried = Carried(sensor, samples)
        for start in range(0, len(samples), AT_A_TIME):
            motions = []
            for values in samples[start : start + AT_A_TIME]:
                place = collected.press(sensor, values)
                motions.append(sensor.scene.camera.project(carried(values, place)) - sensor.at_rest)
            order.extend(numbers[start : start + AT_A_TIME])
            for readout, weight in sums.items():
                collected.found[readout].append(_binned(np.stack(motions), weight, readout[1]))
            if progress:
                progress("projecting", len(order), job.total)
    source = _source(maker, "projected")
    if seeds is not None:
        source["bead_seeds"] = [int(s) for s in seeds]
    return collected.sets(order, sensor.face, source)


def _binned(motion: np.ndarray, weight: Any, bins: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean vector, mean size and circular mean of the angle, of motions (P, N, 2); as optics.readers.flow.bin_means of
    every pixel or bead, for many presses at once."""
    p = len(motion)
    size = np.hypot(motion[..., 0], motion[..., 1])
    still = size == 0
    unit = motion / np.where(still, 1, size)[..., None]
    unit[still] = [1.0, 0.0]  # the angle of no motion is 0, as arctan2 has it

    def means(values: np.ndarray) -> np.ndarray:
        return np.asarray(weight @ values.T, np.float32).T.reshape(p, bins, bins)

    x, y = means(unit[..., 0]), means(unit[..., 1])
    return np.stack([means(motion[..., 0]), means(motion[..., 1])], -1), means(size), np.arctan2(y, x)


def _source(maker: batch.Maker, how: str) -> dict[str, Any]:
    identity = maker.identity()
    return {"made": how, **{name: identity[name] for name in ("job", "scene", "versions")}}


def measure(
    file: str | Path,
    readouts: Sequence[Readout],
    plugins: Named = None,
    progress: Progress | None = None,
) -> dict[Readout, FeatureSet]:
    """Features of the images that `optics batch` has made of a job so far, by optical flow from the image at rest.

    The image at rest is rendered here, with the noise of the job. `seconds` of the source: per image, of flow and bins.
    Raises BadScene as `project` does, BadJob for a job whose images show no flow, OutputExists for a folder without
    images, ModuleNotFoundError without OpenCV."""
    from optics.files.images import read_image

    file = Path(file)
    job = batch.read(file)
    output = next((o for o in ("dn", "png") if o in job.outputs), None)
    if job.lights != "together" or output is None:
        raise batch.BadJob(
            f'{file}: lights = "{job.lights}", outputs = {job.outputs}; optical flow reads images with all lights on: '
            'lights = "together", outputs = ["dn"]'
        )
    maker = batch.Maker(job, file, plugins)
    maker.check()
    blocks = Blocks(maker.folder, job.total)
    total = blocks.counts().recorded
    if not total:
        raise OutputExists(f"{maker.folder}: no images of {file} are there; make them with optics batch {file}")
    sensor = Sensor(maker)
    rest: Any = maker.images.take(sensor.base).camera
    rest = maker.exposed(rest, job.rng(0, "noise at rest")) if output == "dn" else np.clip(np.round(rest), 0, None)
    readers = {readout: flow.FlowReader(rest, *readout) for readout in readouts}
    collected, order = Collected(readouts), []  # type: ignore[var-annotated]
    for record in blocks.records():  # one at a time, in the order of their indices
        order.append(record["index"])
        collected.press(sensor, {**sensor.values, **record["sample"]})
        path = maker.folder / record["files"][output]["file"]
        image, bits = read_image(path, str(path))
        image = image.astype(np.uint8) if bits == 8 else image  # as a camera gives it
        for readout, reader in readers.items():
            start = time.perf_counter()
            found = reader(image)
            collected.seconds[readout] += time.perf_counter() - start
            collected.found[readout].append(tuple(a[None] for a in found))
        if progress:
            progress("optical flow", len(order), total)
    return collected.sets(order, sensor.face, _source(maker, "images"))
