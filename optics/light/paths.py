"""Paths: camera rays followed straight through layers and clear boundaries, and what light loses on its way back.

A ray passes layers (optics.polarization.layers) unbent and boundaries (part `interface`) by Snell's law until it meets
a surface that it cannot pass. The geometry is traced once by Mitsuba; the Mueller matrices of what was passed are
multiplied in numpy, for any values of the layers' parameters: numbers, one per ray, or complex ones that carry a
derivative.

Stokes vectors at the camera refer to the image's horizontal axis x (right, across the ray and the vertical) and to y
(up): optics.polarization.mueller's axes for light that travels towards the camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType, SimpleNamespace

import numpy as np

from optics.errors import BadScene
from optics.polarization.layers import Crossing, evaluate
from optics.polarization.mueller import Mueller, Slab, diattenuator, face, fresnel
from optics.scene.layer import active_effects
from optics.scene.mitsuba_parts import is_part

STEPS = 24  # surfaces that a ray may pass
BLOCK = 8192  # rays at a time in numpy: what they take stays near the processor
CROSSINGS = 100_000  # rays whose crossings are kept, 90 bytes at each surface: of more, arithmetic takes the time
GRAZE = 1e-4  # mm per mm of the coordinates: how far beyond a surface a ray goes on


@dataclass
class Step:
    """One surface that rays meet: `part` (N,) index into the scene's layers, -1 where a ray passes none; vectors (N, 3)
    in the surface's own axes."""

    part: np.ndarray
    k: np.ndarray
    x: np.ndarray
    u: np.ndarray
    v: np.ndarray


@dataclass
class Path:
    """Rays that were followed: the steps, where they end (Dr.Jit: si, origin of the last stretch), and how they
    arrive."""

    names: list[str]
    steps: list[Step]
    si: object
    origin: object
    end: Step
    shape: np.ndarray  # (N,) index of the scene's shape that a path ends on, -1 for none
    lost: np.ndarray  # (N,) bool: reflected totally, or after STEPS surfaces
    fields: dict  # the layers' stress patterns when the rays were traced
    regions: list[np.ndarray] = field(default_factory=list)  # (N,) the number of the region met, of each map
    matrices: dict = field(
        default_factory=dict
    )  # of layers at real values: a derivative by one layer leaves the others
    groups: list = field(default_factory=list)
    crossings: dict = field(default_factory=dict)  # of groups of rays at the surfaces that they meet
    ends: dict = field(default_factory=dict)  # of each source: the rays that end on it, what it last sent along them

    def sequences(self) -> list[tuple[tuple[int, ...], np.ndarray]]:
        """Rays by the parts that they pass: (indices of the parts, from the camera on; which rays), up to BLOCK of them
        each."""
        if not self.steps:
            return [((), np.arange(len(self.lost)))]
        if not self.groups:
            table, code = np.stack([s.part for s in self.steps], -1), np.zeros(len(self.lost), np.int64)
            for column in table.T:  # one number for each sequence met so far
                code = np.unique(code * (len(self.names) + 1) + column + 1, return_inverse=True)[1]
            firsts = np.unique(code, return_index=True)[1]
            for first in firsts:
                rays = np.flatnonzero(code == code[first])
                parts = tuple(int(i) for i in table[first])
                self.groups += [(parts, rays[start : start + BLOCK]) for start in range(0, len(rays), BLOCK)]
        return self.groups

    def kept(self, group: int, place: int, name: str, scene, values: Mapping, make) -> Mueller:
        """A layer's matrix for a group of rays; the last one made at real values is kept."""
        own = own_values(scene, name, values)
        if any(isinstance(v, (complex, np.ndarray)) for v in own):
            return make()
        known, matrix = self.matrices.get((group, place), (None, None))
        if known != own:
            matrix = make()
            self.matrices[group, place] = own, matrix
        return matrix

    def forget(self) -> None:
        """Let go of what grows with the rays and can be made anew."""
        self.matrices.clear()
        self.crossings.clear()
        self.ends.clear()

    def crossing(self, group: int, place: int, step: Step, rays: np.ndarray, bands: np.ndarray) -> Crossing:
        """How a group of rays crosses the surface that it meets at a place of its sequence; of few rays it is kept."""
        if len(self.lost) > CROSSINGS:
            return crossing_at(step, rays, bands)
        known = self.crossings.get((group, place))
        if known is None or known.wavelengths is not bands:
            known = self.crossings[group, place] = crossing_at(step, rays, bands)
        return known


def layered(scene) -> bool:
    """Whether a scene has layers, or sources that may be polarized."""
    return bool(scene.sources) or any(scene.declaration(n).mueller is not None for n in scene.parts)


def passable(scene) -> list[str]:
    """Names of the parts that a camera ray passes: layers and clear boundaries."""
    declared = {n: scene.declaration(n) for n in scene.parts}
    return [n for n, part in declared.items() if part.mueller is not None or part.refracts]


def trace(scene, u: np.ndarray, v: np.ndarray) -> Path:
    """Follow the camera's rays through pixel positions (N,)."""
    import drjit as dr
    import mitsuba as mi

    camera, names = scene.camera, passable(scene)
    n = len(u)
    o, d = camera.ray(mi.Float(np.asarray(u, np.float32)), mi.Float(np.asarray(v, np.float32)))
    zero = mi.Vector3d(dr.zeros(mi.Float64, n))
    direction, origin = mi.Vector3d(d) + zero, mi.Point3d(o) + zero
    # across the image's vertical, as Mitsuba's `stokes` has it
    x = dr.normalize(dr.cross(mi.Vector3d(camera.turned(mi.Vector3f(0, 1, 0))), direction))
    wavelengths = scene.integrator.wavelengths(n)
    steps, lost = [], dr.zeros(mi.Bool, n)
    extents = {i: e for i, name in enumerate(names) if (e := getattr(scene.parts[name], "extent", lambda: None)())}
    indices = {i: scene.parts[name].number("index") for i, name in enumerate(names) if scene.declaration(name).refracts}
    layers = [mi.BSDFPtr(scene.parts[name]) for name in names]
    shapes = [mi.ShapePtr(shape) for shape in scene.mitsuba.shapes()]
    for _ in range(STEPS + 1):
        si = scene.mitsuba.ray_intersect(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction), mi.Float(0), wavelengths))
        part, shape = (_which(met, pointers) for met, pointers in ((si.bsdf(), layers), (si.shape, shapes)))
        part = dr.select(lost, -1, part)
        place, normal = _placed(part, si, -direction, x, extents)
        for i, index in indices.items():
            if index != 1:
                direction, x, total = _refract(part == i, direction, x, normal, index)
                lost |= total
        p = mi.Point3d(si.p)
        far = 1 + dr.maximum(dr.maximum(dr.abs(p.x), dr.abs(p.y)), dr.abs(p.z))
        origin = dr.select(part >= 0, p + direction * (GRAZE * far), origin)
        # at once: piece by piece, every array would trace the rays anew
        dr.eval(si, part, shape, place, direction, x, origin, lost)
        met = np.array(part)
        step = Step(met, *(np.array(a).T for a in place[:2]), *(np.array(a) for a in place[2:]))
        if not (met >= 0).any():
            break
        steps.append(step)
    else:
        lost |= part >= 0
    shape, lost = np.array(shape), np.array(lost)
    # the ray that reaches the end is straight; light that it brings to `origin` leaves the surface towards it
    return Path(
        names,
        steps,
        si,
        mi.Point3f(origin),
        step,
        shape,
        lost,
        {n: scene.parts[n].field for n in names if getattr(scene.parts[n], "field", None) is not None},
        _regions(scene, names, steps, step),
    )


def _regions(scene, names: list[str], steps: list[Step], end: Step) -> list[np.ndarray]:
    """The numbers of the regions that rays meet, of each map on a layer or a source; 0 where they meet none."""
    found = []
    for name in (*names, *scene.sources):
        part = scene.parts[name]
        regions = part.map_of_regions({n: getattr(part, n) for n in part.words})
        if regions is not None:
            layer = name in names
            for step in steps if layer else [end]:
                met = regions(step.u, step.v)
                found.append(np.where(step.part == names.index(name), met, 0) if layer else met)
    return found


def _which(met, pointers: list):
    """Index of the pointer that each ray met, -1 for none of them (Dr.Jit)."""
    import drjit as dr
    import mitsuba as mi

    found = mi.Int32(-1)
    for index, pointer in enumerate(pointers):
        found = dr.select(met == pointer, mi.Int32(index), found)
    return found


def _placed(part, si, k, x, extents: Mapping) -> tuple[tuple, object]:
    """(k, x, u, v) of rays at a surface in its own axes, and its normal (Dr.Jit): z the normal, x the first direction
    of its coordinates; `extents` of parts that stretch."""
    import drjit as dr
    import mitsuba as mi

    normal, du, dv = (mi.Vector3d(a) for a in (si.sh_frame.n, si.dp_du, si.dp_dv))
    size_u, size_v = dr.norm(du), dr.norm(dv)
    flat = size_u == 0
    du, normal = dr.select(flat, mi.Vector3d(1, 0, 0), du), dr.select(flat, mi.Vector3d(0, 0, -1), normal)
    e1 = dr.normalize(du - dr.dot(du, normal) * normal)
    e2 = dr.cross(normal, e1)
    own = [mi.Vector3d(*(dr.dot(axis, a) for axis in (e1, e2, normal))) for a in (k, x)]
    for index, (width, length) in extents.items():
        size_u, size_v = dr.select(part == index, width, size_u), dr.select(part == index, length, size_v)
    u, v = (mi.Float64(a) - 0.5 for a in (si.uv.x, si.uv.y))
    return (*own, u * size_u, v * size_v * dr.select(dr.dot(dv, e2) < 0, -1.0, 1.0)), normal


def _refract(here, direction, x, normal, index: float) -> tuple:
    """Directions beyond a boundary of the rays `here`, the axes x carried along (s stays s, p stays p), and where
    nothing passes (Dr.Jit)."""
    import drjit as dr

    cos1 = -dr.dot(direction, normal)
    n = dr.select(cos1 >= 0, index, 1 / index)
    facing = dr.select(cos1 >= 0, normal, -normal)
    cos1 = dr.abs(cos1)
    square = 1 - (1 - dr.square(cos1)) / dr.square(n)
    total = here & (square <= 0)
    cos2 = dr.sqrt(dr.maximum(square, 0))
    bent = dr.normalize(direction / n + (cos1 / n - cos2) * facing)
    s = dr.cross(direction, facing)
    length = dr.norm(s)
    s = dr.select(length > 1e-9, s / dr.maximum(length, 1e-12), x)
    turned = dr.dot(x, s) * s + dr.dot(x, dr.cross(direction, s)) * dr.cross(bent, s)
    on = here & ~total
    return dr.select(on, bent, direction), dr.select(on, turned, x), total


# -- what light loses ------------------------------------------------------------------------------------------------
def part_values(scene, name: str, values: Mapping, fields: Mapping) -> SimpleNamespace:
    """A part's parameters as its functions read them; arrays of readings stand along the first axis."""
    part = scene.parts[name]

    def shaped(value):
        return np.reshape(value, (-1, 1)) if isinstance(value, np.ndarray) else value

    return SimpleNamespace(
        name=name,
        **{n: shaped(values[f"{name}.{n}"]) for n in (*part.numbers, *part.words)},
        **part.context({n: values[f"{name}.{n}"] for n in part.words}),
        field=fields.get(name),
    )


def own_values(scene, name: str, values: Mapping) -> tuple:
    """The values of a part's own parameters, words included."""
    part = scene.parts[name]
    return tuple([values[f"{name}.{n}"] for n in (*part.numbers, *part.words)])


def crossing_at(step: Step, rays, bands: np.ndarray) -> Crossing:
    """How some of the rays pass the surface of a step; arrays (n, 1) against bands (B,)."""
    k, x = (tuple(a[rays][:, i : i + 1] for i in range(3)) for a in (step.k, step.x))
    return Crossing(k, x, step.u[rays][:, None], step.v[rays][:, None], bands)


def layer_matrix(
    scene, name: str, crossing: Crossing, values: Mapping, fields: Mapping = MappingProxyType({})
) -> Mueller:
    """Mueller matrix of one part for light that crosses it towards the camera."""
    part = scene.parts[name]
    own = part_values(scene, name, values, fields)
    if scene.declaration(name).refracts:
        # the camera's side is the one that the normal points to: seen from there the relative index is `index`
        front = crossing.k[2] > 0
        n = np.where(front, own.index, 1 / own.index)
        # cos of the ray beyond the boundary, from which the light comes; the same transmittance both ways
        r_s, r_p, _ = fresnel(np.abs(crossing.k[2]), n)
        return diattenuator(*crossing.plane(), 1 - r_s, 1 - r_p) * (1 / n**2)
    active = active_effects(scene.registry, part.kind, {n: getattr(own, n) for n in part.numbers})
    return evaluate(scene.declaration(name).mueller, crossing, own, active)


def reflected(scene, name: str, values: Mapping):
    """Share of light that each face of a layer reflects: its parameter with the role `face`, 0 where it has none or is
    taken out."""
    share, inserted = scene.key(name, "face"), scene.key(name, "inserted")
    return 0.0 if share is None else values[share] * (1.0 if inserted is None else values[inserted])


def slab(matrix: Mueller, share) -> Slab:
    """A layer whose faces reflect a share of the light each; its matrix holds their losses already."""
    if np.all(np.asarray(share) == 0):
        return Slab(matrix)
    share = np.reshape(share, (-1, 1)) if isinstance(share, np.ndarray) else share
    side = face(share)
    return side.after(Slab(matrix * (1 / ((1 - share) * (1 - share))))).after(side)


def detected(scene, values: Mapping) -> tuple:
    """The row (r0, r1, r2, r3) by which the camera weighs S0 ... S3 of the light that reaches it: (1, 0, 0, 0) unless
    effects of the stage `detector` are in force; entries are numbers or (N, 1).

    Behind a mosaic of analysers a detector meets one polarization: its weights are those of the stage `site`."""
    row: tuple = (1.0, 0, 0, 0)
    camera = scene.camera
    if camera is None or getattr(camera, "mosaic", ()) or not scene.registry.at_stage(camera.kind, "detector"):
        return row
    own = part_values(scene, camera.name, values, {})
    for effect in active_effects(scene.registry, camera.kind, vars(own), "detector"):
        row = effect.stages["detector"](row, own)
    return row


def undetected(scene) -> dict[str, float]:
    """The parameters of the stage `detector` at neutral, by key: with them component 0 is S0."""
    camera = scene.camera
    effects = () if camera is None else scene.registry.at_stage(camera.kind, "detector")
    return {f"{camera.name}.{n}": camera.numbers[n].neutral for e in effects for n in e.parameter_names}


def transmission(scene, path: Path, values: Mapping, bands: np.ndarray, component: int = 0, until: str = "") -> tuple:
    """A row of the Mueller matrix from a path's end to the camera: how much of each of S0 ... S3 there becomes the
    `component` here; 4 entries (N, B). Component 0 is what the camera records (`detected`): S0, unless its detector
    prefers a polarization.

    N is the number of rays, or of the readings that `values` holds arrays for (then one ray serves them all). Rays that
    are lost transmit nothing. `until` a part: from that part, without it, to the camera; nothing where a ray does not
    meet it."""
    one = len(path.lost) == 1
    arrays = [v for v in values.values() if isinstance(v, np.ndarray)]
    stepped = any(isinstance(v, complex) for v in values.values()) or any(np.iscomplexobj(v) for v in arrays)
    count, kind = max([len(path.lost), *(v.size for v in arrays)]), complex if stepped else float
    out = [np.zeros((count, len(bands)), kind) for _ in range(4)]
    start = detected(scene, values) if component == 0 else tuple(1.0 if j == component else 0 for j in range(4))
    for group, (parts, rays) in enumerate(path.sequences()):
        names = [(path.names[index], step) for step, index in zip(path.steps, parts) if index >= 0]
        if until:
            met = [name for name, _ in names]
            if until not in met:
                continue
            names = names[: met.index(until)]
        matrices = [
            path.kept(
                group,
                place,
                name,
                scene,
                values,
                lambda group=group, place=place, name=name, step=step, rays=rays: layer_matrix(
                    scene, name, path.crossing(group, place, step, rays, bands), values, path.fields
                ),
            )
            for place, (name, step) in enumerate(names)
        ]
        row = start
        shares = {name: reflected(scene, name, values) for name, _ in names}
        if any(np.any(np.asarray(share) != 0) for share in shares.values()):
            stack = None
            for (name, step), matrix in reversed(list(zip(names, matrices))):  # light meets the farthest first
                if scene.declaration(name).refracts:  # a radiance grows by n^2 one way and shrinks by it the other
                    index = values[f"{name}.index"]
                    back = np.where(step.k[rays][:, 2:] > 0, index, 1 / index) ** 4
                    own = Slab(matrix, t_back=matrix.reversed * back)
                else:
                    own = slab(matrix, shares[name])
                stack = own if stack is None else own.after(stack)
            row = stack.t.after(row)
        else:
            for matrix in matrices:
                row = matrix.after(row)
        where = slice(None) if one else rays
        for entry, new in zip(out, row):
            entry[where] = new
    keep = ~path.lost[:, None]
    return tuple(entry * keep for entry in out) if path.lost.any() else tuple(out)


def emitted(scene, name: str, path: Path, values: Mapping, bands: np.ndarray) -> tuple:
    """Stokes vector (4 entries that broadcast to (N, B)) that a source of the scene sends along the paths, at power 1;
    0 where a path does not end on it."""
    import mitsuba as mi

    source = scene.parts[name]
    if name not in path.ends or path.ends[name][0].wavelengths is not bands:
        on = np.array(path.si.emitter(scene.mitsuba) == mi.EmitterPtr(source)) & (path.end.k[:, 2] > 0)
        path.ends[name] = crossing_at(path.end, slice(None), bands), on[:, None], None, ()
    crossing, on, known, sent = path.ends[name]
    given = own_values(scene, name, values)
    alike = not any(isinstance(v, np.ndarray) for v in given)
    if alike and known == given:
        return sent
    own = part_values(scene, name, values, {})
    if scene.integral is not None and scene.integral.auto:  # its spectrum is in the matrix from bands to channels
        own.curve, own.wavelength = None, 0.0
    vector = scene.declaration(name).stokes(crossing, own)
    sent = tuple(0 if isinstance(c, int) else c * on for c in vector)
    if alike:
        path.ends[name] = crossing, on, given, sent
    return sent


def check(scene) -> None:
    """Refuse layers on shapes whose first direction turns with the place."""
    for shape in scene.mitsuba.shapes():
        material = shape.bsdf()
        layer = is_part(material) and scene.declaration(material.name).mueller is not None
        if layer and str(shape).startswith("Disk"):
            raise BadScene(
                f"{scene.path}: '{shape.bsdf().name}' stands on a disk, whose first direction runs outwards and would "
                "turn with the place; allowed: a rectangle or a mesh with texture coordinates"
            )
