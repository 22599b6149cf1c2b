"""Transport: light in dielectric bodies that reflect and refract it many times, from lights to the camera, by Monte
Carlo and by maps.

In a printed grid a ray meets some hundred faces, and a pinhole camera never meets the small LEDs at the grid's sides.
So light is followed from both ends to where it is scattered:

    from the lights    packets of light fly through all faces, are absorbed along every stretch (exp(-alpha d)),
                       scattered by the bodies and by matt surfaces, and leave what they are worth in two maps: the
                       fluence in every cell of a grid (track length by volume, 1/mm^2 per unit of power), and the
                       irradiance on matt surfaces
    from the camera    rays fly through all faces the same way; each ends on a matt surface, where it reads the
                       irradiance, and gathers on its way what the bodies scatter towards it, sigma_s/(4 pi) of the
                       fluence

At every face the way is drawn by Fresnel's reflectance; absorption is weighed, never drawn, so that derivatives by
absorption are exact: every contribution times the length of its way (d/d alpha exp(-alpha l) = -l exp(-alpha l)).
Polarization is followed as the row (from the camera) or column (from a light) of the Mueller matrix of everything met
so far, in axes that travel along. On a rough face the ray meets a facet, drawn as often as it is seen (Beckmann's
slopes), and all that a face does is done about the facet's normal m; the way on is weighed by Smith's G1(wo, m), and
what leaves on the wrong side of the face is lost.

The maps know cells and matt surfaces with coordinates on them (u, v); matt surfaces are taken as Lambertian. Light that
comes straight to a matt surface, through air, is left to the camera's rays, which look from there to every light.
Without maps (`reach="paths"`) rays of the camera go on until they meet a luminous area: without the maps' resolution,
and slower the smaller the area. It is what the maps are tested against, beside stock Mitsuba.

Source: Fan, Li, Cong & Zhang, MagicGripper, supplementary VII-A, eqs. (18)-(29); Veach, thesis (1997), 5.2, for
radiance across a boundary (1/n^2) against power (1); Jensen, Realistic Image Synthesis Using Photon Mapping (2001), for
maps of light; Walter, Marschner, Li & Torrance, EGSR 2007, and Heitz & d'Eon, CGF 33, 103 (2014), for rough faces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from optics.errors import BadScene
from optics.light.paths import part_values
from optics.light.solid_angle import Rectangle
from optics.polarization.mueller import diattenuator, fresnel, fresnel_reflection, retarder, rotation
from optics.scene.surfaces import coefficient

DEPTH = 512  # faces that a ray may meet; of the scene magictac's, 6e-5 would meet more
FAINT = 0.3  # below this share of its start, half of the packets go on with twice the weight
BATCHES = 8  # independent parts of an image, maps and all, for its standard error
AT_ONCE = 4_000_000  # rays that are followed together
TEXELS = 64  # of an irradiance map, each way
SMOOTH = 1e-4  # roughness up to which a face is smooth: Mitsuba's distributions know no less
ASTRAY = (
    5e-3  # faces per ray that rounding may lead a ray past, at edges: 2e-5 in a grid at rest, 1e-3 in a pressed one
)
SPLIT = 2  # parts of a cell of the fluence map, each way
POINTS = 2  # of a light, each way, that a lit place looks at
WEAK = 1e-12  # birefringence that turns nothing
AIR = "air"


@dataclass(frozen=True)
class Material:
    """What a body is made of, per band: refractive index, absorption and scattering coefficients in 1/mm; roughness of
    its faces; birefringence along x."""

    name: str
    index: np.ndarray
    absorption: np.ndarray
    scattering: np.ndarray
    roughness: float = 0.0
    birefringence: float = 0.0
    of: str = ""  # the material that it is a share of
    share: float = 1.0


@dataclass
class Estimate:
    """Linear images of every light at power 1.

    radiance   (L, H, W, B);   error   its standard error, from batches
    slopes     material -> (L, H, W, B): derivative by its absorption coefficient, mm
    lost       share of all rays and packets that were cut off after DEPTH faces
    """

    lights: list[str]
    radiance: np.ndarray
    error: np.ndarray
    slopes: dict[str, np.ndarray]
    lost: float


class Transport:
    """A scene of dielectric bodies, matt surfaces and lights, ready to be photographed at the scene's present
    values."""

    def __init__(self, scene, lights: Sequence[str] | None = None):
        """lights: those to follow; None: all. A light's image does not depend on the others."""
        if scene.camera is None or scene.integrator is None:
            raise BadScene(f"{scene.path}: an image needs a part of the type 'camera' and the integrator 'tactile'")
        if not scene.lights:
            raise BadScene(f"{scene.path}: the scene has no light (an emitter of the type 'led' or 'source')")
        self.scene = scene
        self.bands = np.array(scene.integrator.bands or (540.0,))
        self.lights = [n for n in scene.lights if lights is None or n in lights]
        self.width, self.height = scene.camera.resolution
        self.materials = materials(scene, self.bands)
        self.surfaces = [Surface(scene, shape, self.materials) for shape in scene.mitsuba.shapes()]
        for s in self.surfaces:
            if s.cells is not None:
                self._fill(s)
        self.cells = [s.cells for s in self.surfaces if s.cells is not None]
        matt, cells = 0, 0
        for s in self.surfaces:
            if s.cells is not None:
                s.first, cells = cells, cells + len(s.cells.rows)
            elif s.matt:
                s.first, matt = matt * TEXELS**2, matt + 1
        self.voxels, self.texels = cells * SPLIT**3, matt * TEXELS**2

    def take(
        self,
        rays: int = 64,
        packets: int = 400_000,
        seed: int = 0,
        slopes: bool = False,
        reach: str = "maps",
        progress: Callable[[str, int, int], None] | None = None,
    ) -> Estimate:
        """The image of every light.

        rays     from the camera, per pixel;   packets   from each light, for the maps
        slopes   also the derivative by each material's absorption
        reach    "maps", or "paths": rays of the camera alone find the luminous areas (parts `source`)
        """
        if reach not in ("maps", "paths"):
            raise ValueError(f"reach = {reach!r}; allowed: maps, paths")
        if reach == "paths" and self.scene.leds:
            raise BadScene(
                f"{self.scene.path}: rays of the camera never meet an LED, which is a point; allowed with reach = "
                "'paths': "
                "luminous areas (emitters of the type 'source')"
            )
        # bands that go different ways are followed apart
        if reach == "maps":
            self._check_maps()
        same = all(np.ptp(m.index) == 0 and abs(m.birefringence) < WEAK for m in self.materials)
        groups = [list(range(len(self.bands)))] if same else [[b] for b in range(len(self.bands))]
        kinds = len(self.materials) if slopes else 1
        images, followed, lost, astray = 0.0, 0, 0.0, 0.0
        for group in groups:  # with the same random numbers: equal indices would give equal images
            run = Run(self, group, kinds, seed, progress)
            images = images + run.images(max(rays // BATCHES, 1), max(packets // BATCHES, 1), reach == "maps")
            followed, lost, astray = followed + run.followed, lost + run.lost, astray + run.astray
        if astray > ASTRAY * followed:
            raise BadScene(
                f"{self.scene.path}: {astray / followed:.2g} times per ray a face of a dielectric body is met "
                "from a material that is not "
                "its neighbour: bodies overlap, a normal points inwards, or `outside` names the wrong material"
            )
        mean, error = images.mean(0), images.std(0, ddof=1) / np.sqrt(BATCHES)
        by = {}
        for m, slope in zip(self.materials[1:], mean[1:]):
            by[m.of or m.name] = by.get(m.of or m.name, 0.0) + m.share * slope
        return Estimate(self.lights, mean[0], error[0], by, lost / followed)

    def _fill(self, grid: Surface) -> None:
        """Say what is in each cell, with a material of its own for one that lacks filling."""
        cell, share = grid.shape.lacking()
        grid.fillings = np.full(len(grid.cells.rows), grid.inside)
        if share > 0 and grid.inside >= 0:
            m = self.materials[grid.inside]
            grid.fillings[cell] = len(self.materials)
            self.materials.append(
                Material(
                    f"{m.name}, unfilled",
                    1 + (m.index - 1) * (1 - share),
                    m.absorption * (1 - share),
                    m.scattering * (1 - share),
                    m.roughness,
                    m.birefringence * (1 - share),
                    m.name,
                    1 - share,
                )
            )

    def seen_through(self, rays: int, seed: int = 0) -> np.ndarray:
        """(cells, H, W): length (mm) in each cell of the camera's rays of each pixel, in the mean, by their weight in
        the first band."""
        return Run(self, [0], 1, seed).lengths(rays)

    def _check_maps(self) -> None:
        """Refuse what the maps do not hold: scattering outside cells, polarized lights."""
        filling = {number for s in self.surfaces if s.cells is not None for number in (s.inside, *s.fillings)}
        for number, m in enumerate(self.materials):
            if number not in filling and m.scattering.max() > 1e-12:
                raise BadScene(
                    f"{self.scene.path}: {m.name}.scattering = {m.scattering.max():g} 1/mm; allowed: 0 in a "
                    "material that fills no "
                    "`cells`, as light is mapped in cells only"
                )
        for name, part in self.scene.sources.items():
            if part.number("dop_q") or part.number("dop_u"):
                raise BadScene(
                    f"{self.scene.path}: '{name}' sends polarized light; allowed among dielectric bodies: dop_q = "
                    "dop_u = 0"
                )


class Run:
    """Packets and rays for bands that go the same way.

    group      numbers of the bands;   kinds  1, or one more for each material: images and maps, then their derivatives
               by absorption
    rows       (light, band) of the images and maps that are kept: what a light does not send needs none
    followed   rays so far;   lost   cut off;   astray   met a face from the wrong side
    """

    def __init__(
        self, transport: Transport, group: Sequence[int], kinds: int, seed: int, progress: Callable | None = None
    ):
        import drjit as dr
        import mitsuba as mi

        self.of, self.group, self.kinds, self.seed = transport, list(group), kinds, seed
        self.scene, self.progress = transport.scene, progress or (lambda what, done, total: None)
        self.followed, self.lost, self.astray = 0, 0.0, 0.0
        bands = (*transport.bands, *[transport.bands[-1]] * 4)[: dr.size_v(mi.UnpolarizedSpectrum)]
        self.wavelengths = mi.UnpolarizedSpectrum(*[float(b) for b in bands]) if mi.is_spectral else mi.Color0f()
        levels = np.array([self._level(n) for n in transport.lights])  # (L, B)
        self.rows = [(light, b) for light, own in enumerate(levels) for b in self.group if own[b] > 1e-6 * own.max()]

        def table(kind, values):
            found = kind(np.ascontiguousarray(values))
            dr.make_opaque(found)
            return found

        rows = np.full(levels.shape, -1)
        for row, place in enumerate(self.rows):
            rows[place] = row
        self.levels, self.row = levels, [table(mi.Int32, rows[:, b]) for b in self.group]
        self.level = [table(mi.Float, levels[:, b]) for b in self.group]
        materials, surfaces = transport.materials, transport.surfaces
        self.index = table(mi.Float, [m.index[group[0]] for m in materials])
        self.scattering = table(mi.Float, [m.scattering[group[0]] for m in materials])
        self.absorption = [table(mi.Float, [m.absorption[b] for m in materials]) for b in self.group]
        rough = [materials[s.inside].roughness if s.inside >= 0 else 0.0 for s in surfaces]
        self.roughness = table(mi.Float, rough) if any(rough) else None
        turns = [2e6 * np.pi * m.birefringence / transport.bands[group[0]] for m in materials]  # rad/mm
        self.retardance = table(mi.Float, turns) if any(abs(m.birefringence) >= WEAK for m in materials) else None
        self.pointers = [mi.ShapePtr(s.shape) for s in surfaces]
        self.outside, self.inside, self.first, self.matt, self.grid, self.light = (
            table(mi.Int32, values)
            for values in (
                [s.outside for s in surfaces],
                [s.inside for s in surfaces],
                [s.first for s in surfaces],
                [s.matt for s in surfaces],
                [s.cells is not None for s in surfaces],
                [transport.lights.index(s.light) if s.light in transport.lights else -1 for s in surfaces],
            )
        )
        boxes = [s.shape.bbox() for s in surfaces if s.inside >= 0]
        low, high = np.min([np.ravel(b.min) for b in boxes], 0), np.max([np.ravel(b.max) for b in boxes], 0)
        self.aim, self.radius = [float(c) for c in (low + high) / 2], float(np.linalg.norm(high - low) / 2)
        self.filled = None
        if transport.cells:
            origins, turns, volumes = (
                np.concatenate([getattr(c, n) for c in transport.cells]) for n in ("origins", "rows", "volumes")
            )
            self.origin = [table(mi.Float, origins[:, i]) for i in range(3)]
            self.turn = [[table(mi.Float, turns[:, i, j]) for j in range(3)] for i in range(3)]
            self.volume = table(mi.Float, volumes.ravel())
            filled = np.concatenate([s.fillings for s in surfaces if s.cells is not None])
            mixed = any((s.fillings != s.inside).any() for s in surfaces if s.cells is not None)
            self.filled = table(mi.Int32, filled) if mixed else None

    def _level(self, light: str) -> list[float]:
        """What a light at power 1 sends in each band, relative."""
        import mitsuba as mi

        part, wavelengths = (
            self.scene.parts[light],
            self.wavelengths if mi.is_spectral else mi.UnpolarizedSpectrum(float(self.of.bands[0])),
        )
        level = part.level(wavelengths) if light in self.scene.sources else part.spectrum(wavelengths)
        return [float(np.ravel(np.array(level[b]))[0]) for b in range(len(self.of.bands))]

    def images(self, rays: int, packets: int, maps: bool) -> np.ndarray:
        """(BATCHES, kinds, L, H, W, B), of so many rays per pixel and packets per light in each batch."""
        import drjit as dr
        import mitsuba as mi

        of, lights = self.of, len(self.of.lights)
        rows, pixels = BATCHES * len(self.rows) * self.kinds, self.of.height * self.of.width
        self.maps = maps
        self.fluence, self.irradiance = (dr.zeros(mi.Float, max(rows * size, 1)) for size in (of.voxels, of.texels))
        self.out = dr.zeros(mi.Float, rows * pixels)
        for name, follow, wanted, each in (
            ("packets", self._shine, packets if maps else 0, lights),
            ("rays", self._look, rays, pixels),
        ):
            most, done = max(AT_ONCE // (BATCHES * each), 1), 0
            while done < wanted:
                count = min(most, wanted - done)
                follow(count, wanted, done)
                done += count
                self.progress(name, done, wanted)
        found = np.array(self.out).reshape(BATCHES, len(self.rows), self.kinds, of.height, of.width)
        image = np.zeros((BATCHES, self.kinds, lights, of.height, of.width, len(of.bands)))
        for row, (light, band) in enumerate(self.rows):
            image[:, :, light, ..., band] = found[:, row]
        return image / rays

    def random(self, lane, kind: int, done: int):
        """Random numbers of each lane. States and increments are hashed: generators that start beside one another are
        correlated, and batches with them, whose spread then understates the error (measured: by 1.4 in variance)."""
        import drjit as dr
        import mitsuba as mi

        key = dr.opaque(mi.UInt32, int(np.random.SeedSequence([self.seed, kind, done]).generate_state(1)[0]))
        state, increment = mi.sample_tea_32(lane, key)
        return mi.PCG32(1, mi.UInt64(state), mi.UInt64(increment))

    def place(self, s, row, kind: int, size: int):
        """Where a row of the state's batch begins in maps or images of a size."""
        import mitsuba as mi

        return ((s["batch"] * len(self.rows) + mi.UInt32(row)) * self.kinds + kind) * size

    # -- places -------------------------------------------------------------------------------------------------------
    def voxel(self, cell, p, active):
        """Which part of its cell a place lies in."""
        import drjit as dr
        import mitsuba as mi

        part = mi.UInt32(0)
        way = [p[i] - dr.gather(mi.Float, self.origin[i], cell, active) for i in range(3)]
        for row in self.turn:
            place = sum(dr.gather(mi.Float, row[i], cell, active) * way[i] for i in range(3)) * SPLIT
            part = part * SPLIT + mi.UInt32(dr.clip(place, 0, SPLIT - 1e-3))
        return cell * SPLIT**3 + part

    def texel(self, si, k, active, shift=(0.0, 0.0)):
        """Where the map of surface k holds a place; `shift` in texels."""
        import drjit as dr
        import mitsuba as mi

        column, row = (mi.UInt32(dr.clip(c * TEXELS + d, 0, TEXELS - 1e-3)) for c, d in zip(si.uv, shift))
        return mi.UInt32(dr.gather(mi.Int32, self.first, k, active)) + row * TEXELS + column

    def number(self, si):
        """Of the surface that was met."""
        import drjit as dr
        import mitsuba as mi

        k = mi.UInt32(0)
        for number, pointer in enumerate(self.pointers):
            k = dr.select(si.shape == pointer, mi.UInt32(number), k)
        return k

    def ways(self, s, length=None):
        """Length of the way in each material so far, and `length` further in the present one."""
        import drjit as dr

        if length is None:
            return s["ways"]
        return [way + dr.select(s["medium"] == m, length, 0.0) for m, way in enumerate(s["ways"], 1)]

    def faded(self, s, length, further=0.0):
        """Weights per band after a stretch in the present material."""
        import drjit as dr
        import mitsuba as mi

        return [
            t * dr.exp(-(dr.gather(mi.Float, a, s["medium"]) + further) * length)
            for t, a in zip(s["tau"], self.absorption)
        ]

    # -- flight -------------------------------------------------------------------------------------------------------
    def fly(self, start: dict, forward: bool, drawn: bool, along: Callable, at: Callable) -> dict:
        """Follow rays through all faces until they end; gives their last state, with `ended` where `at` says so: there
        p and d are those of the last stretch.

        start    p, d, rng, x (axis across d that Stokes vectors refer to), tau (share of what each ray started with,
                 per band of the group), weight (what that is; 1), and numbers that stay: pixel, light, batch
        forward  from a light: the Stokes vector is carried along; else from the camera: what it is sensitive to
        drawn    scattering is drawn by Monte Carlo; else it only weakens, and `along` gathers it
        along    f(s, length, sigma, active): what is left or found on a straight stretch of the state s
        at       f(s, si, k, hit) -> mask: what is left or found on surface number k, and where the ray ends there
        """
        import drjit as dr
        import mitsuba as mi

        count = dr.width(start["d"])
        zero = dr.zeros(mi.Float, count)
        state = {
            **{
                name: mi.UInt32(start.get(name, 0)) + dr.zeros(mi.UInt32, count)
                for name in ("pixel", "light", "batch", "medium", "cell", "depth")
            },
            "p": mi.Point3f(start["p"]),
            "d": mi.Vector3f(start["d"]),
            "x": mi.Vector3f(start["x"]),
            "rng": start["rng"],
            "v": [zero + entry for entry in (start.get("weight", 1.0), 0.0, 0.0, 0.0)],
            "tau": [t + zero for t in start["tau"]],
            "ways": [zero + 0.0 for _ in self.of.materials[1:]],
            "astray": zero + 0.0,
            "active": dr.full(mi.Bool, True, count),
            "cut": dr.full(mi.Bool, False, count),
            "ended": dr.full(mi.Bool, False, count),
        }
        end = dr.while_loop(
            (state,), lambda s: s["active"], lambda s: (self.onward(dict(s), forward, drawn, along, at),)
        )[0]
        dr.eval(end)  # all at once: what is asked for alone follows the rays anew
        self.followed += count
        self.lost += float(dr.count(end["cut"])[0])
        self.astray += float(dr.sum(end["astray"])[0])
        return end

    def onward(self, s: dict, forward: bool, drawn: bool, along: Callable, at: Callable) -> dict:
        """The state after the next surface, or after the next place where a body scatters."""
        import drjit as dr
        import mitsuba as mi

        active, rng, flight = s["active"], s["rng"], s["d"]
        si = self.scene.mitsuba.ray_intersect(
            mi.Ray3f(s["p"], flight, mi.Float(0), self.wavelengths), mi.RayFlags.All, False, active
        )
        hit = active & si.is_valid()
        k = self.number(si)
        sigma = dr.gather(mi.Float, self.scattering, s["medium"])
        length, scattered = dr.select(hit, si.t, 0.0), mi.Bool(False)
        if drawn:
            free = -dr.log(1 - rng.next_float32()) / dr.maximum(sigma, 1e-12)
            scattered = hit & (free < length)
            length = dr.select(scattered, free, length)
        along(s, length, sigma, hit)
        s["tau"] = self.faded(s, length, 0.0 if drawn else sigma)
        s["ways"] = self.ways(s, length)
        if self.retardance is not None:
            s["v"], s["x"] = self.retarded(s, length, forward)
        hit &= ~scattered
        ends = at(s, si, k, hit)
        face, axis, d = self.at_face(s, si, k, hit, rng, forward)
        mixed = self.scatter(s, si, hit & ~face & ~ends, scattered, ends, d, rng)
        s["x"] = dr.select(mixed, mi.Vector3f(mi.Frame3f(s["d"]).s), dr.select(face, axis, s["x"]))
        self.thin_out(s, face | mixed, ends, rng)
        s["ended"] = ends
        s["p"] = dr.select(scattered, s["p"] + length * flight, dr.select(hit & ~ends, si.spawn_ray(s["d"]).o, s["p"]))
        s["rng"] = rng
        return s

    def at_face(self, s: dict, si, k, hit, rng, forward: bool) -> tuple:
        """Reflect or refract rays at the faces of dielectric bodies, into the state; gives where that is, the axis that
        Stokes vectors refer to from there on, and the direction."""
        import drjit as dr
        import mitsuba as mi

        flight = s["d"]
        outside, inside = (dr.gather(mi.Int32, a, k) for a in (self.outside, self.inside))
        cell = mi.UInt32(dr.gather(mi.Int32, self.first, k)) + si.prim_index // 12  # where it is one
        if self.filled is not None:
            grid = hit & (dr.gather(mi.Int32, self.grid, k) > 0)
            inside = dr.select(grid, dr.gather(mi.Int32, self.filled, cell, grid), inside)
        face = hit & (inside >= 0)
        front = dr.dot(flight, si.n) < 0
        normal = mi.Vector3f(dr.select(front, si.n, -si.n))
        here, there = mi.UInt32(dr.select(front, outside, inside)), mi.UInt32(dr.select(front, inside, outside))
        n = dr.gather(mi.Float, self.index, there, face) / dr.select(
            face, dr.gather(mi.Float, self.index, here, face), 1.0
        )
        n = dr.select(face, n, 1.0)
        if self.roughness is not None:
            normal, seen = self.facet(flight, normal, dr.gather(mi.Float, self.roughness, k, face), rng)
        cos = dr.minimum(dr.abs(dr.dot(flight, normal)), 1.0)
        r_s, r_p, cos2 = fresnel(cos, n)
        share = (r_s + r_p) / 2
        back = rng.next_float32() < share
        bounced, passed = dr.maximum(share, 1e-9), dr.maximum(1 - share, 1e-9)
        if not forward:
            passed = passed * (n * n)  # of a radiance
        across = dr.cross(flight, normal)
        level = dr.squared_norm(across) < 1e-10  # at normal incidence every axis serves
        axis = dr.select(level, s["x"], dr.normalize(across))
        turned = self.turned(s["v"], s["x"], axis, flight, forward)
        act = (lambda m: m @ tuple(turned)) if forward else (lambda m: m.after(tuple(turned)))
        s["v"] = [
            dr.select(face, dr.select(back, a / bounced, b / passed), c)
            for a, b, c in zip(act(fresnel_reflection(cos, n)), act(diattenuator(1.0, 0, 1 - r_s, 1 - r_p)), s["v"])
        ]
        d = dr.select(face, dr.select(back, flight + 2 * cos * normal, flight / n + (cos / n - cos2) * normal), flight)
        if self.roughness is not None:
            s["tau"] = [dr.select(face, t * seen(d), t) for t in s["tau"]]
        s["astray"] = s["astray"] + dr.select(face & (here != s["medium"]), 1.0, 0.0)
        s["medium"] = dr.select(face, dr.select(back, here, there), s["medium"])  # what rounding led astray is back
        entered = face & ~back & front & (dr.gather(mi.Int32, self.grid, k) > 0)
        s["cell"] = dr.select(entered, cell, s["cell"])
        return face, axis, d

    def scatter(self, s: dict, si, other, scattered, ends, d, rng):
        """Send rays on from other surfaces (`other`) and from within bodies (`scattered`), into all directions and
        unpolarized; all others along d. Gives where light was scattered."""
        import drjit as dr
        import mitsuba as mi

        bs, weight = si.bsdf().sample(
            mi.BSDFContext(), si, rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()), other
        )
        weight = mi.unpolarized_spectrum(weight)
        s["tau"] = [dr.select(other, t * weight[b], t) for b, t in zip(self.group, s["tau"])]
        sphere = mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
        s["d"] = dr.select(
            ends, s["d"], dr.normalize(dr.select(other, si.to_world(bs.wo), dr.select(scattered, sphere, d)))
        )
        mixed = other | scattered
        s["v"] = [s["v"][0]] + [dr.select(mixed, 0.0, entry) for entry in s["v"][1:]]
        return mixed

    def thin_out(self, s: dict, on, ends, rng) -> None:
        """Of the faint, half go on with twice the weight; after DEPTH faces a ray is cut off."""
        import drjit as dr

        brightest = reduce(dr.maximum, s["tau"])
        faint = (brightest < FAINT) & ~ends
        on = on & (brightest > 0) & (~faint | (rng.next_float32() < 0.5))
        s["tau"] = [dr.select(faint, 2 * t, t) for t in s["tau"]]
        s["depth"] = s["depth"] + 1
        s["cut"] = on & (s["depth"] >= DEPTH)
        s["active"] = on & ~s["cut"]

    def retarded(self, s, length, forward: bool) -> tuple:
        """Stokes vector or row, and its axis, after a stretch of a material that is birefringent along the world's x
        axis."""
        import drjit as dr
        import mitsuba as mi

        flight, along = s["d"], mi.Vector3f(1, 0, 0)
        across = along - dr.dot(along, flight) * flight
        square = dr.squared_norm(across)  # sin^2 of the angle between the ray and the axis
        seen = square > 1e-10
        axis = dr.select(seen, dr.normalize(across), s["x"])
        plate = retarder(dr.gather(mi.Float, self.retardance, s["medium"]) * square * length, 0.0)
        turned = tuple(self.turned(s["v"], s["x"], axis, flight, forward))
        return [a + mi.Float(0) for a in (plate @ turned if forward else plate.after(turned))], axis

    @staticmethod
    def facet(flight, normal, roughness, rng) -> tuple:
        """The normal m of the facet that a ray meets on a face, and G1(d, m): the share of what leaves the facet along
        d that others let by, 0 on the wrong side of the face.

        m is drawn by a hash of the generator's state: the same numbers at every roughness > 0, and all others those of
        a smooth face."""
        import drjit as dr
        import mitsuba as mi

        frame, smooth = mi.Frame3f(normal), roughness <= SMOOTH
        facets = mi.MicrofacetDistribution(mi.MicrofacetType.Beckmann, roughness)
        hidden = mi.sample_tea_32(mi.UInt32(rng.state), mi.UInt32(rng.state >> 32))
        m, _ = facets.sample(frame.to_local(-flight), mi.Point2f(*[mi.Float(h >> 8) * 2.0**-24 for h in hidden]))
        return (
            dr.select(smooth, normal, frame.to_world(mi.Vector3f(m))),
            lambda d: dr.select(smooth, 1.0, facets.smith_g1(frame.to_local(d), mi.Vector3f(m))),
        )

    @staticmethod
    def turned(v, x, axis, flight, forward: bool):
        """A Stokes vector, or the row of a detector, in axes that begin with `axis` instead of x."""
        import drjit as dr

        light = flight if forward else -flight  # the way that the light goes
        c, u = dr.dot(axis, x), dr.dot(dr.cross(light, axis), x)  # of the angle from `axis` to x
        if forward:
            return rotation(c * c - u * u, -2 * c * u) @ tuple(v)
        return rotation(c * c - u * u, 2 * c * u).after(tuple(v))

    # -- from the lights ----------------------------------------------------------------------------------------------
    def panel(self, name: str) -> Surface:
        """What a source shines from."""
        return next(s for s in self.of.surfaces if s.light == name)

    def seen_panel(self, name: str, place, sample):
        """A point of a source's area, its normal there, and cos_l / r^2 by its density: the solid angle that it stands
        for."""
        import drjit as dr
        import mitsuba as mi

        panel = self.panel(name)
        if panel.rectangle is not None:
            p, omega = panel.rectangle.seen(place, sample)
            return p, panel.rectangle.normal, omega
        start = panel.shape.sample_position(mi.Float(0), sample)
        to = place - start.p
        square = dr.maximum(dr.squared_norm(to), 1e-12)
        return start.p, start.n, dr.maximum(dr.dot(to, start.n), 0.0) * dr.rsqrt(square) / square / start.pdf

    @staticmethod
    def chip(led, sample):
        """A point of an LED."""
        return led.point(sample) if led.reach() > 0 else led.position()

    def _emitted(self, light: int, drawn: Sequence):
        """Where packets of a light start, which way they go, the power of all of them, and the weight of each, by five
        random numbers."""
        import drjit as dr
        import mitsuba as mi

        name, count = self.of.lights[light], dr.width(drawn[0])
        part, one, two = self.scene.parts[name], mi.Point2f(drawn[0], drawn[1]), mi.Point2f(drawn[2], drawn[3])
        if name in self.scene.sources:
            start = self.panel(name).shape.sample_position(mi.Float(0), one)
            # half of the packets by the cosine, half towards a ball around the dielectric bodies, which may be small
            # and far away
            cosine = mi.Frame3f(start.n).to_world(mi.warp.square_to_cosine_hemisphere(two))
            to = mi.Point3f(*self.aim) - start.p
            distance = dr.norm(to)
            edge = dr.safe_sqrt(
                1 - dr.square(dr.minimum(self.radius / distance, 1.0))
            )  # cosine of the ball's radius; 0 from within
            aimed = (edge > 0) & (drawn[4] < 0.5)
            cone = mi.Frame3f(to / distance).to_world(mi.warp.square_to_uniform_cone(two, edge))
            d = dr.select(aimed, cone, cosine)
            cos = dr.maximum(dr.dot(d, start.n), 0.0)
            inside = (edge > 0) & (dr.dot(d, to) > edge * distance)
            chance = dr.select(edge > 0, cos / (2 * dr.pi), cos / dr.pi) + dr.select(
                inside, 1 / (4 * dr.pi * dr.maximum(1 - edge, 1e-9)), 0.0
            )
            weight = cos / dr.pi / dr.maximum(chance, 1e-12)
            return start.p + 1e-4 * (1 + dr.max(dr.abs(start.p))) * start.n, d, dr.pi / start.pdf, weight
        z = dr.power(1 - two.x, 1 / (part.mu + 1))  # of cos(theta)^mu
        s, c = dr.sincos(2 * dr.pi * two.y)
        d = mi.Frame3f(part.axis()).to_world(mi.Vector3f(c, s, 0) * dr.safe_sqrt(1 - z * z) + mi.Vector3f(0, 0, 1) * z)
        return (
            self.chip(part, one) + dr.zeros(mi.Point3f, count),
            d,
            2 * dr.pi / (part.mu + 1) + dr.zeros(mi.Float, count),
            dr.full(mi.Float, 1.0, count),
        )

    def _shine(self, packets: int, wanted: int, done: int) -> None:
        """Packets of all lights, into the maps."""
        import drjit as dr
        import mitsuba as mi

        lights, count = len(self.of.lights), len(self.of.lights) * BATCHES * packets
        number = dr.arange(mi.UInt32, count)
        light, batch = number // (BATCHES * packets), (number // packets) % BATCHES
        # a light has its own random numbers, whichever others are followed
        places = [list(self.scene.lights).index(n) for n in self.of.lights]
        lane = dr.gather(mi.UInt32, mi.UInt32(places), light) * (BATCHES * packets) + number % (BATCHES * packets)
        rng = self.random(lane, 1, done)
        drawn = [rng.next_float32() for _ in range(5)]
        p, d, power, weight = self._emitted(0, drawn)
        for k in range(1, lights):
            own = light == k
            p, d, power, weight = (
                dr.select(own, new, old) for new, old in zip(self._emitted(k, drawn), (p, d, power, weight))
            )
        share = power / wanted

        def leave(where, size, place, worth, tau, ways, s, active):
            for column, row in enumerate(self.row):
                own = dr.gather(mi.Int32, row, s["light"])
                for kind in range(self.kinds):
                    value = worth * tau[column] if kind == 0 else -worth * tau[column] * ways[kind - 1]
                    dr.scatter_add(where, value, self.place(s, own, kind, size) + place, active & (own >= 0))

        def along(s, length, sigma, hit):
            """Track length by volume, at a random place of the stretch."""
            if self.of.voxels:
                active = hit & (sigma > 0)
                u = s["rng"].next_float32() * length
                voxel = self.voxel(s["cell"], s["p"] + u * s["d"], active)
                volume = dr.select(active, dr.gather(mi.Float, self.volume, voxel, active), 1.0)
                worth = s["v"][0] * dr.gather(mi.Float, shares, s["light"]) * length / volume
                leave(self.fluence, self.of.voxels, voxel, worth, self.faded(s, u), self.ways(s, u), s, active)

        def at(s, si, k, hit):
            if self.of.texels:
                # what comes straight from a light, the camera's rays find by themselves
                matt = (
                    hit & (dr.gather(mi.Int32, self.matt, k) > 0) & (mi.Frame3f.cos_theta(si.wi) > 0) & (s["depth"] > 0)
                )
                area = dr.select(matt, dr.norm(dr.cross(si.dp_du, si.dp_dv)) / TEXELS**2, 1.0)
                leave(
                    self.irradiance,
                    self.of.texels,
                    self.texel(si, k, matt),
                    s["v"][0] * dr.gather(mi.Float, shares, s["light"]) / area,
                    s["tau"],
                    s["ways"],
                    s,
                    matt,
                )
            return mi.Bool(False)

        # the power of a light is the same for all of its packets
        shares = dr.gather(mi.Float, share, dr.arange(mi.UInt32, lights) * (BATCHES * packets))
        dr.eval(p, d, shares, weight, rng)
        tau = [dr.gather(mi.Float, level, light) for level in self.level]
        self.fly(
            {
                "p": p,
                "d": d,
                "x": mi.Frame3f(d).s,
                "tau": tau,
                "rng": rng,
                "light": light,
                "batch": batch,
                "weight": weight,
            },
            True,
            True,
            along,
            at,
        )
        dr.eval(self.fluence, self.irradiance)

    # -- from the camera ----------------------------------------------------------------------------------------------
    def straight(self, light: int, si, sample, active):
        """Irradiance that a light at power 1 sends to a surface with nothing in between, from the point of it that a
        sample names: a panel's is cos_s Omega (of its solid angle), an LED's cos_l^mu cos_s/r^2."""
        import drjit as dr

        name = self.of.lights[light]
        part = self.scene.parts[name]
        if name in self.scene.sources:
            p, axis, share = self.seen_panel(name, si.p, sample)
        else:
            p, axis = self.chip(part, sample), part.axis()
            to = si.p - p
            square = dr.maximum(dr.squared_norm(to), 1e-12)
            share = dr.power(dr.maximum(dr.dot(to, axis) * dr.rsqrt(square), 1e-9), part.mu) / square
        to = p - si.p
        cos = dr.dot(to, si.n) * dr.rsqrt(dr.maximum(dr.squared_norm(to), 1e-12))
        lit = active & (dr.dot(to, axis) < 0) & (cos > 0)
        lit &= ~self.scene.mitsuba.ray_test(si.spawn_ray_to(p), lit)
        return dr.select(lit, cos * share, 0.0)

    def _seen(self, rays: int, batches: int, done: int) -> dict:
        """Where rays of the camera start, so many per pixel and batch."""
        import drjit as dr
        import mitsuba as mi

        camera, height, width = self.scene.camera, self.of.height, self.of.width
        number = dr.arange(mi.UInt32, height * width * rays * batches)
        pixel, batch = (number // rays) % (height * width), number // (rays * height * width)
        rng = self.random(number, 0, done)
        p, d = camera.ray(mi.Float(pixel % width) + rng.next_float32(), mi.Float(pixel // width) + rng.next_float32())
        x = dr.normalize(dr.cross(d, camera.turned(mi.Vector3f(0, -1, 0))))
        return {
            "p": p,
            "d": d,
            "x": x,
            "tau": [mi.Float(1.0) for _ in self.group],
            "rng": rng,
            "pixel": pixel,
            "batch": batch,
        }

    def lengths(self, rays: int) -> np.ndarray:
        """(cells, H, W): length in each cell of the camera's rays, so many per pixel, by their weight."""
        import drjit as dr
        import mitsuba as mi

        pixels = self.of.height * self.of.width
        fills = np.zeros(len(self.of.materials), bool)
        fills[[number for s in self.of.surfaces if s.cells is not None for number in s.fillings]] = True
        fills, found = mi.Float(fills.astype(np.float32)), dr.zeros(mi.Float, self.of.voxels // SPLIT**3 * pixels)

        def along(s, length, sigma, hit):
            within = hit & (dr.gather(mi.Float, fills, s["medium"]) > 0)
            dr.scatter_add(found, s["v"][0] * s["tau"][0] * length, s["cell"] * pixels + s["pixel"], within)

        def at(s, si, k, hit):
            return hit & (dr.gather(mi.Int32, self.matt, k) > 0)

        self.fly(self._seen(rays, 1, 0), False, False, along, at)
        return np.array(found).reshape(-1, self.of.height, self.of.width) / rays

    def _look(self, rays: int, wanted: int, done: int) -> None:
        """Rays of the camera, into the images."""
        import drjit as dr
        import mitsuba as mi

        pixels = self.of.height * self.of.width

        def see(s, row, kind, value, active):
            dr.scatter_add(self.out, value, self.place(s, row, kind, pixels) + s["pixel"], active)

        def see_light(s, row, value, active):
            """Light that faded on the way of this ray alone, and its derivatives."""
            see(s, row, 0, value, active)
            for kind in range(1, self.kinds):
                see(s, row, kind, -value * s["ways"][kind - 1], active)

        def read(where, size, place, worth, tau, ways, s, active):
            for row, (_, band) in enumerate(self.rows):
                own = worth * tau[self.group.index(band)]
                held = [
                    dr.gather(mi.Float, where, self.place(s, row, kind, size) + place, active)
                    for kind in range(self.kinds)
                ]
                see(s, row, 0, own * held[0], active)
                for kind in range(1, self.kinds):
                    see(s, row, kind, own * (held[kind] - ways[kind - 1] * held[0]), active)

        def along(s, length, sigma, hit):
            """What the body scatters towards the camera, from a random place of the stretch."""
            if self.maps and self.of.voxels:
                active = hit & (sigma > 0)
                u = s["rng"].next_float32() * length
                read(
                    self.fluence,
                    self.of.voxels,
                    self.voxel(s["cell"], s["p"] + u * s["d"], active),
                    s["v"][0] * length * sigma / (4 * dr.pi),
                    self.faded(s, u, sigma),
                    self.ways(s, u),
                    s,
                    active,
                )

        def at(s, si, k, hit):
            facing = hit & (mi.Frame3f.cos_theta(si.wi) > 0)
            luminous = dr.gather(mi.Int32, self.light, k)
            for row, (light, band) in enumerate(self.rows):
                if self.of.lights[light] in self.scene.sources:
                    value = s["v"][0] * s["tau"][self.group.index(band)] * float(self.levels[light, band])
                    see_light(s, row, value, facing & (luminous == light))
            return facing & (dr.gather(mi.Int32, self.matt, k) > 0) if self.maps else mi.Bool(False)

        end = self.fly(self._seen(rays, BATCHES, done), False, not self.maps, along, at)
        if self.maps and self.of.texels:
            self._lit(end, read, see_light)
        dr.eval(self.out)

    def _lit(self, s: dict, read: Callable, see_light: Callable) -> None:
        """What rays that ended on matt surfaces find there: light of the map, and light that comes straight."""
        import mitsuba as mi

        matt = s["ended"]
        si = self.scene.mitsuba.ray_intersect(
            mi.Ray3f(s["p"], s["d"], mi.Float(0), self.wavelengths), mi.RayFlags.All, False, matt
        )
        matt &= si.is_valid()
        k, rng = self.number(si), s["rng"]
        reflectance = mi.unpolarized_spectrum(
            si.bsdf().eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, 1), matt)
        )  # rho/pi
        tau = [t * reflectance[b] for b, t in zip(self.group, s["tau"])]
        shift = [rng.next_float32() - 0.5 for _ in range(2)]  # in the mean, the map is read linearly between its texels
        read(self.irradiance, self.of.texels, self.texel(si, k, matt, shift), s["v"][0], tau, s["ways"], s, matt)
        in_air = matt & (s["medium"] == 0)
        x, y = rng.next_float32(), rng.next_float32()
        points = [mi.Point2f((i + x) / POINTS, (j + y) / POINTS) for i in range(POINTS) for j in range(POINTS)]
        straight = [
            sum(self.straight(light, si, point, in_air) for point in points) / len(points)
            for light in range(len(self.of.lights))
        ]
        for row, (light, band) in enumerate(self.rows):
            value = s["v"][0] * tau[self.group.index(band)] * straight[light] * float(self.levels[light, band])
            see_light(s, row, value, in_air)


# -- what a scene is made of -----------------------------------------------------------------------------------------
class Surface:
    """A shape as rays know it: `outside`, `inside` numbers of the materials that it parts (-1: it is no face of a
    dielectric body), `light` the name of the source that it is, `matt` whether it keeps a map of its irradiance,
    `cells` of a grid."""

    def __init__(self, scene, shape, known: Sequence[Material]):
        import mitsuba as mi

        names = [m.name for m in known]
        self.shape, self.first = shape, 0
        bsdf = shape.bsdf()
        clear = getattr(bsdf, "role", "") == "clear"
        self.inside = names.index(bsdf.name) if clear else -1
        self.outside = names.index(bsdf.around.name if bsdf.around is not None else AIR) if clear else -1
        self.light = next((n for n, part in scene.sources.items() if shape.emitter() is part), "")
        diffuse = bsdf is not None and not clear and mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseReflection)
        self.matt = diffuse and not self.light
        if self.matt and shape.is_mesh() and not shape.has_vertex_texcoords():
            raise BadScene(
                f"{scene.path}: '{shape.id()}' is matt, and no map of its light can be kept on a mesh without "
                "texture coordinates; "
                "allowed among dielectric bodies: rectangles, cubes, spheres, meshes with coordinates"
            )
        if (
            not (clear or diffuse or self.light)
            or mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy)
            or not clear
            and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta | mi.BSDFFlags.Null)
        ):
            raise BadScene(
                f"{scene.path}: the surface '{shape.id()}' is neither clear nor matt; allowed among dielectric "
                "bodies: materials of the type "
                "'clear', and matt ones (diffuse, membrane)"
            )
        self.rectangle = Rectangle.of(shape) if self.light else None
        self.cells = shape.cells(SPLIT) if hasattr(shape, "cells") else None


def materials(scene, bands: np.ndarray) -> list[Material]:
    """Air, then the scene's clear materials, at the present values."""
    found, values = [Material(AIR, np.ones(len(bands)), np.zeros(len(bands)), np.zeros(len(bands)))], scene.values()
    for name, part in scene.parts.items():
        if part.role == "clear":
            own = part_values(scene, name, values, {})
            found.append(
                Material(
                    name,
                    *(
                        coefficient(own, s, bands, scene.registry.functions(part.kind, s))
                        for s in ("index", "absorption")
                    ),
                    np.full(len(bands), own.scattering),
                    own.roughness,
                    own.birefringence,
                )
            )
    return found
