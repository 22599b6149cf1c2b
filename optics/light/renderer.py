"""Prediction: what a scene says that a capture set should look like, frame by frame, and how that changes.

Light is linear in every LED, so each LED is rendered once per geometry at power 1 and kept; powers, exposure, colour
and response act on the kept images. Of small images, LEDs over one geometry are rendered at once
(`optics.light.together`). One sample per pixel does away from edges, at its middle; in scenes without layers
a 24th of the second differences from pixel to pixel leads from there to the mean of the pixel
(`optics.scene.images.bend`; next to an LED of `gelsight` with pixels of 0.5 mm the two differ by 0.5 %, on `digit` by
0.1 %). Pixels at the rim of a shadow or of the gel are sampled 128 times; where the face bends, and in the penumbra of
a light of many points, 16 times. Derivative images come from Dr.Jit in forward mode through the shading, with the
primary hits and shadows kept; at rims, where that misses the moving edge, and for everything that moves geometry they
are central differences with common samples (`Parameter.how`)."""

from __future__ import annotations

import copy
import math
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from types import SimpleNamespace

import numpy as np

from optics.errors import Apart, BadScene
from optics.light import paths
from optics.light.outlines import Grain, Outlines
from optics.light.samples import Finer, Hits, LedImage, Sample, Traced, aligned, around, creases, edges
from optics.light.slopes import Slopes, board_of, of_light
from optics.light.together import Group, alike
from optics.processes import return_memory
from optics.scene.images import bend, finer_of, from_parts, in_parts, repeated
from optics.scene.loader import Scene
from optics.scene.mitsuba_parts import DEFAULT_VARIANT

# per pixel at rims; a power of two. Of an image 36 px wide, chi2 misses a path tracer by 10 to 60 with 64, by 5 to 20
# with 128
RIM_SAMPLES = 128
PINHOLE = 1e-9  # mm^2: a pupil smaller than a wavelength across is a point
# Of a crowded scene, whose pixels nearly all have rims: cells across the radius of a ball, see optics.light.outlines
CELLS = 10
ABOUT = 0.05  # relative change of the focus below which the blur counts as the same
MOST_ELSEWHERE = 8  # cells each way of pixels that show no ball, at most; four of them share a ray
CROWD = "crowd"  # the finer samples of its pixels
BEHIND_PUPIL = 4  # times as many at other edges behind a pupil
LAYERED_RIM_SAMPLES = 32  # in scenes with layers, whose matrices are multiplied for every sample
# mm^2: the step by which a pupil's image is made. A smaller one changes beads 4 px wide by little more than an image's
# errors
CROWDED_PUPIL = 2.0
PAINTED = 0.05  # of the largest reflectance of a texture: a step from pixel to pixel that needs finer samples
BENT_SIDE = 4  # finer samples each way where the face bends: the mean of what varies smoothly needs few
SOFT = 25  # points of a light, above which rims of its shadows take the samples of what bends, BENT_SIDE each way
R2 = 0.7548776662466927, 0.5698402909980532  # of the R2 sequence: shifts from pixel to pixel
CORNERS = np.array([[0.5, 0.5], [0.02, 0.02], [0.98, 0.02], [0.02, 0.98], [0.98, 0.98]]).T  # of a pixel
FLAT_FIELDS = ("multiplicative", "additive", "none")
MEMORY = 2e9  # bytes of hits, with what images need for their derivatives, that are kept
IMAGES = 5e8  # bytes of images that are kept without them, of a renderer that remembers REMEMBER geometries
REMEMBER = 24
TOGETHER = 500_000  # pixels of all LEDs that are rendered at once, at most: of larger images, computing takes the time
MOST_FINER = 1_000_000  # their finer samples, at most
AT_ONCE = 4_000_000  # ends of camera rays times parameters whose tangents are made together
PER_RAY = 250  # bytes of a camera ray's end and its light, by the memory of processes that held ten million of them
BOUNCE_SAMPLES = 32  # directions per cell for the second bounce, at least
# of these, an image has at least so many: few of a face meet a lit flank. On a plate of balls, whose second reflections
# are 6 % of the direct light, 128 per cell of an image of 153 x 128 px leave .5 % of it, rms
BOUNCE_RAYS = 2**19
# The same of a crowded scene, where each pixel is a cell: what its directions miss is noise that no neighbour shares,
# and lets a fit find the second reflections too weak (by a fifth with 256 per pixel, where powers absorb half of them)
CROWDED_BOUNCE_RAYS = 2**20
CROWDED_BOUNCES = 16  # of a pixel, at least; twice as many for each step of `fine`
BOUNCE_NUMBERS = 10  # of a direction: a place in the cell, a technique, two directions, a point of the light
# Times fewer directions suffice for how second reflections change, with the same ones on both sides
ROUGHLY = 4
# Where no frame uses a pixel, times fewer directions, but so many at least: glare brings the mean of many such cells.
# Of a lens that blurs far, pixels within its reach of a mask get the noise of a few
ASIDE = 16
FEWEST = 4
BOUNCE_CELL = 2  # px each way of a cell; 1 in a crowded scene, whose pixels differ, and of small images
# directions of a pixel: where BOUNCE_RAYS give as many, each pixel is a cell. What a dent 8 px across reflects into
# itself is smeared by cells of 2 px, and was found a quarter too strong
FEW_BOUNCES = 64


@dataclass(frozen=True, eq=False)
class Pixels:
    """Pixels (H, W) of an image, the same only as themselves: part of the keys of what is kept."""

    mask: np.ndarray

    @cached_property
    def traced(self) -> Traced:
        return Traced(self.mask)


@contextmanager
def everywhere(renderer) -> Iterator[None]:
    """Within it all pixels are wanted: for the gel at rest, which frames with other masks share, and for what is asked
    of the whole view."""
    wanted, renderer.wanted = renderer.wanted, None
    try:
        yield
    finally:
        renderer.wanted = wanted


class Renderer:
    """Linear images of a scene, one LED at a time, with a memory for what was rendered before."""

    monte_carlo = False  # whether images are Monte Carlo estimates

    def __init__(self, scene: Scene, remember: int = REMEMBER):
        if scene.camera is None or scene.integrator is None:
            raise BadScene(f"{scene.path}: a prediction needs a part of the type 'camera' and the integrator 'tactile'")
        if not scene.lights:
            raise BadScene(f"{scene.path}: the scene has no light (an emitter of the type 'led' or 'source')")
        paths.check(scene)
        self.scene = scene
        self.width, self.height = scene.camera.resolution
        self.bands = len(scene.integrator.bands or (0,))
        self.integral = scene.integral
        self.colours = np.arange(self.bands) if self.integral is None else self.integral.colours
        self._lanes: np.ndarray | None = (
            None  # numbers of the bands that a pass carries, of channels that are integrals
        )
        if self.bands > scene.integrator.lanes and self.integral is None:
            raise BadScene(
                f"{scene.path}: {self.bands} bands, but the variant {scene.variant} carries {scene.integrator.lanes}; "
                f"load the scene with variant='{DEFAULT_VARIANT}' or name one band"
            )
        self.layered = paths.layered(scene)
        self.crowded = scene.traced is not None and not self.layered  # by many balls, with rims in most pixels
        self.fine = max((getattr(part, "fine", 1) for part in scene.parts.values()), default=1)
        if self.crowded:  # rays start all over the pupil: it is no longer a blur of the image
            scene.camera.sampled = True
            for name in (scene.camera.named("pupil"), scene.camera.named("focus")):
                key = f"{scene.camera.name}.{name}"
                scene.parameters[key] = replace(scene.parameters[key], how="difference", step=1.0)
            key = f"{scene.camera.name}.{scene.camera.named('pupil')}"
            scene.parameters[key] = replace(scene.parameters[key], plausible=CROWDED_PUPIL)
        self.rim_samples = LAYERED_RIM_SAMPLES if self.layered else RIM_SAMPLES
        cell = 1 if FEW_BOUNCES * self.height * self.width <= BOUNCE_RAYS else BOUNCE_CELL
        cells = -(-self.height // cell) * -(-self.width // cell)
        self.bent_side, self.bounce = BENT_SIDE, (cell, _power_of_two(max(BOUNCE_SAMPLES, BOUNCE_RAYS / cells)))
        self.grazing = not self.crowded  # whether second directions are drawn where a level skin meets itself
        if self.crowded:
            rays = CROWDED_BOUNCE_RAYS / (self.height * self.width)
            self.bounce = 1, _power_of_two(max(CROWDED_BOUNCES << (self.fine - 1), rays))
        self.wavelengths = np.array(scene.integrator.bands or (540.0,))
        self.remember = remember
        self._transmissions: OrderedDict = OrderedDict()
        self._recent: list[paths.Path] = []
        self._hits: OrderedDict = OrderedDict()
        self._grains: dict[int, Grain] = {}  # by the focus
        self._began = scene.values() if self.crowded else {}
        self._second: tuple[tuple, tuple] | None = None  # what second directions meet, and of which values
        self._drawn: OrderedDict[tuple, tuple] = OrderedDict()  # places and numbers of these directions
        self._glow: tuple[tuple, LedImage] | None = None  # the image of light that no LED made, and of which values
        self._images: OrderedDict[tuple, LedImage] = OrderedDict()
        self._plain: OrderedDict[tuple, np.ndarray] = OrderedDict()  # of differences, which need nothing else
        self._plain_bytes = 0
        image_keys = {k for k, p in scene.parameters.items() if p.how == "image"}
        self.layer_keys = {k for k, p in scene.parameters.items() if p.how == "layer"}
        words = {
            f"{n}.{w}" for n, p in scene.parts.items() if scene.declaration(n).mueller is not None for w in p.words
        }
        self.layer_order = sorted(self.layer_keys | words)  # what the layers' matrices depend on
        lights = {*scene.lights, *scene.boards}
        led_keys = {k for k in scene.parameters if k.rsplit(".", 1)[0] in lights} - self.layer_keys
        led_keys -= {k for k in led_keys if scene.parameters[k].role == "regions"}  # which are geometry
        self.power_keys = scene.power_keys(*scene.lights)  # images are kept per unit of each
        own = [k for k in scene.parameters if k not in image_keys and k not in led_keys and k not in self.layer_keys]
        self.bounce_key = scene.key(scene.integrator.name, "second bounce") or ""
        self.geometry_keys = [k for k in own if scene.moves(k)]
        ambient = {
            f"{n}.{parameter}"
            for n, m in scene.membranes.items()
            for e in scene.registry.at_stage(m.kind, "ambient")
            for parameter in e.parameter_names
        }
        self.ambient_keys = [k for k in own if k in ambient]
        self.shading_keys = [
            k for k in own if k not in self.geometry_keys and k != self.bounce_key and k not in self.ambient_keys
        ]
        self._clocks = {k: told for k in self.shading_keys if (told := self._told_by(k))}
        self.led_keys = {
            n: [k for k in led_keys if k.rsplit(".", 1)[0] in (n, board_of(light)) and k not in self.power_keys]
            for n, light in scene.lights.items()
        }
        self._fixed = {
            k for k in self.geometry_keys if self.kind(k)
        }  # of stock plugins, some shade and none is slow to set
        self._still = {k: scene.parameters[k].neutral for k in self.ambient_keys}
        self._tangents: OrderedDict = OrderedDict()
        self._kept_rays = 0.0  # camera rays that are kept, at most
        self.memory = MEMORY  # bytes; less of it where several processes share the frames
        self.together: set[str] = set()  # LEDs whose images are wanted of the same geometry
        self.asked: set[str] = set()  # parameters whose derivatives will be asked for, see `asking`
        self._slopes: dict[tuple, tuple[LedImage, dict[str, tuple]]] = {}  # those that were made with others
        # those whose centres are followed, which take finer samples where they need them, and all directions of second
        # reflections; None: all
        self.wanted: Pixels | None = None
        # whether something of the scene must be asked of each LED by itself: of plugins of one's own nobody knows
        self.apart = bool(scene.registry.own_files)
        self.side = 1  # values of a pixel each way, see `splitting`
        self.passing = self.roughly = False  # whether nothing but images is kept, see `in_passing`

    @contextmanager
    def in_passing(self, roughly: bool = False) -> Iterator[None]:
        """Within it, images are kept without the ends of the camera rays that they were made from: of values to either
        side of those at which tangents are asked for, which would push these out of the memory.

        roughly   with ROUGHLY times fewer second directions, where both sides of a difference are made so"""
        before, self.passing, self.roughly = (self.passing, self.roughly), True, roughly
        try:
            yield
        finally:
            self.passing, self.roughly = before
            held = {id(image.hits) for image in self._images.values()}
            for hits in self._hits.values():
                if id(hits) not in held:
                    hits.rims.clear()

    @contextmanager
    def splitting(self, side: int) -> Iterator[None]:
        """Within it, images (H, W, B) are (side H, side W, B), with a value for each part of a pixel: for a lens that
        brings light from pixel to pixel. The mean of a pixel's parts is its value.

        Finer samples are sorted into the parts. A pixel without any varies by the slope of the pixels about it."""
        before, self.side = self.side, 1 if self.monte_carlo else side
        try:
            yield
        finally:
            self.side = before

    def _parts_of(self, image: np.ndarray) -> np.ndarray:
        """An image of what varies slowly, as fine as images are wanted."""
        return image if self.side == 1 or image.shape[:2] != (self.height, self.width) else finer_of(image, self.side)

    def _told_by(self, key: str) -> list[str]:
        """Of a clock, the keys of the parameters that show through it and nothing else; empty of others, and of a clock
        that something else reads."""
        name, _, clock = key.rpartition(".")
        part = self.scene.parts.get(name)
        if part is None or self.scene.parameters[key].role != "clock":
            return []
        own = [e for e in self.scene.registry.effects.values() if part.kind in self.scene.registry.kinds(e.part)]
        if any(clock in e.reads for e in own):
            return []
        return [k for k, p in self.scene.parameters.items() if p.through == clock and k.rpartition(".")[0] == name]

    def _shading(self, values: Mapping) -> tuple:
        """What the shading of surfaces depends on; without clocks that nothing shows through: a press that is made
        again later has the same images."""
        idle = {
            clock
            for clock, keys in self._clocks.items()
            if all(values[k] == self.scene.parameters[k].neutral for k in keys)
        }
        return tuple(None if k in idle else values[k] for k in self.shading_keys)

    def kind(self, key: str) -> str:
        part = self.scene.parts.get(key.rsplit(".", 1)[0])
        return part.kind if part is not None else ""

    # -- geometry -----------------------------------------------------------------------------------------------------
    def geometry(self, values: Mapping) -> tuple:
        own = tuple(values[k] for k in self.geometry_keys)
        return (*own, *(c.part.version for c in self.scene.traced.crowds)) if self.crowded else own

    def apply(self, values: Mapping, move: bool = True) -> None:
        """Set everything but the LEDs' powers, which stay at 1: images are kept per unit of power.

        move = False leaves the geometry where it is (rebuilding the gel costs more than an image): enough for shading
        at hits that are kept, but not for tracing or for shadows."""
        now = {
            k: v
            for k, v in values.items()
            if k in self.scene.parameters
            and k not in self.layer_keys
            and not isinstance(v, np.ndarray)
            and (move or k not in self._fixed)
        }
        now.update(dict.fromkeys(self.power_keys, 1.0))
        self.scene.set(now, meshes=not self.crowded)
        gel = self.scene.gel
        if hasattr(gel, "recall"):
            gel.recall(None if move else {n: values[f"{gel.name}.{n}"] for n in (*gel.numbers, *gel.words)})

    def _world(self):
        """The Mitsuba scene that rays meet."""
        return self.scene.traced.scene if self.crowded else self.scene.mitsuba

    def _rays(self, u, v, lens=None):
        """Origins, directions and weights of the camera's rays in a crowded scene, behind its flat interfaces.

        lens   places in the unit square that stand for the pupil, (2, N); None: its middle"""
        import drjit as dr
        import mitsuba as mi

        o, d = self.scene.camera.ray(mi.Float(u), mi.Float(v))
        if lens is not None:
            o, d = self.scene.camera.through(mi.Point2f(*(mi.Float(aligned(a)) for a in lens)), o, d)
        return self.scene.traced.enter(o, d, self.scene.integrator.wavelengths(dr.width(o)))

    def _plain_rays(self, u: np.ndarray, v: np.ndarray, lens: np.ndarray | None = None) -> tuple:
        """Origins and directions (N, 3) of `_rays`, numpy."""
        import drjit as dr

        with dr.suspend_grad():
            o, d, _ = self._rays(aligned(u), aligned(v), lens)
            dr.eval(o, d)
        return tuple(np.broadcast_to(np.array(a).T, (len(u), 3)) for a in (o, d))

    def _trace(self, u: np.ndarray, v: np.ndarray, lens: tuple | np.ndarray | None = None, aim=None) -> Sample:
        """The ends of camera rays through places in px, and on a pupil; aim: (which rays, (origins, directions) ->
        directions that they take in their place), numpy."""
        import drjit as dr
        import mitsuba as mi

        with dr.suspend_grad():
            u, v = aligned(u), aligned(v)
            if self.layered:
                path = paths.trace(self.scene, u, v)
                return Sample(path.si, mi.UnpolarizedSpectrum(1.0), path.origin, path)
            u, v = mi.Float(u), mi.Float(v)
            if self.crowded:
                o, d, weight = self._rays(u, v, lens)
                if aim is not None:
                    dr.eval(o, d)
                    at = mi.UInt32(aligned(aim[0], np.uint32))
                    own = (np.array(dr.gather(type(a), a, at)).T for a in (o, d))
                    dr.scatter(d, mi.Vector3f(*(mi.Float(aligned(a)) for a in aim[1](*own).T)), at)
                si, _, origin = self.scene.integrator.reached(self._world(), o, d)
                si = self.scene.traced.sharpen(si, origin)
            else:
                si, weight, origin = self.scene.integrator.hits(self._world(), self.scene.camera, u, v)
            dr.eval(si, weight, origin)
        return Sample(si, weight, origin)

    def hits(self, values: Mapping) -> Hits:
        """Primary hits for a geometry, at the centres of all pixels or of those that `wanted` ones need; kept."""
        wanted = self.wanted
        key = (wanted, self.geometry(values))  # hits of all pixels are others: a difference must not mix the two
        if key in self._hits:
            self._hits.move_to_end(key)
            return self._hits[key]
        grain = self._grain(values) if self.crowded else None
        self.apply(values)
        traced = None if wanted is None else wanted.traced
        index = np.arange(self.height * self.width) if traced is None else traced.index
        v, u = (place + 0.5 for place in divmod(index, self.width))
        hits = Hits(self._trace(u, v), self.height, self.width, traced)
        hits.eye = self._eye()
        if self.crowded:
            hits.edges |= self._other_edges(hits, values)
            hits.outlines, hits.grain = self._outlines(values), grain
        hits.edges |= self._painted(hits)
        hits.bare = self._bare(hits)
        self._hits[key] = hits
        while len(self._hits) > self.remember:
            self._hits.popitem(last=False)
        self._make_room(hits, hits.size)
        return hits

    def _bare(self, hits: Hits) -> bool:
        """Whether the skin is level and nothing but windows stands beside it: no light casts a shadow, and no pixel
        needs finer samples, so that the mesh need not be brought there again."""
        if self.layered or self.crowded or hits.edges.any() or not getattr(self.scene.gel, "level", False):
            return False
        return all(shape is self.scene.gel or _is_window(shape) for shape in self._world().shapes())

    def _eye(self) -> np.ndarray:
        """(3,) where the camera stands, mm."""
        import mitsuba as mi

        origin, _ = self.scene.camera.ray(*(mi.Float(place) for place in self.scene.camera.middle()))
        return np.array(origin, float).reshape(3, -1)[:, 0]

    def distances(self, values: Mapping) -> np.ndarray:
        """(H, W) mm from the camera to what pixels' centres see; infinite where that is nothing."""
        hits = self.hits({k: v.real if isinstance(v, complex) else v for k, v in values.items()})
        return np.where(hits.valid, np.linalg.norm(hits.position - hits.eye, axis=-1), np.inf)

    def _make_room(self, latest: Hits, added: int) -> None:
        """Forget the oldest geometries while what is kept is larger than `memory`: large images with many rims.

        added   camera rays that were kept since; all are counted again only where there may be too many"""
        self._kept_rays += added
        if PER_RAY * self._kept_rays <= self.memory:
            return
        images = self._images.values()
        rays: dict[Hits, dict[int, int]] = {}  # geometry -> ends of camera rays by the samples that hold them
        for hits in (*(i.hits for i in images), *self._hits.values()):
            rays.setdefault(hits, {0: hits.size})
        for image in images:  # of one geometry, they may share their finer samples, of one group they do
            rays[image.hits][id(image.group or image.finer)] = image.ends
        size = {hits: PER_RAY * sum(own.values()) for hits, own in rays.items()}
        total = sum(size.values())
        if total > self.memory:
            import drjit as dr

            dr.flush_malloc_cache()  # Dr.Jit keeps what is released, in sizes that the next geometry does not ask for
            return_memory()
        for old in [hits for hits in size if hits is not latest]:
            if total <= self.memory:
                break
            total -= size[old]
            self._hits = OrderedDict((k, h) for k, h in self._hits.items() if h is not old)
            self._images = OrderedDict((k, i) for k, i in self._images.items() if i.hits is not old)
        self._kept_rays = total / PER_RAY

    def share_memory(self, count: int) -> None:
        """Keep a part of what a renderer keeps, as one of so many processes that share the frames."""
        self.memory = MEMORY / count

    def forget_hits(self) -> None:
        """Release the kept hits: a search over many geometries returns to none of them."""
        self._hits.clear()
        self._glow = self._second = None

    def contact_weight(self, values: Mapping, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """1 where the gel is touched at points (x, y) in mm of any shape, 0 elsewhere; between at the rim."""
        self.apply(values)
        return self.scene.gel.contact_weight(x, y)

    def _painted(self, hits: Hits) -> np.ndarray:
        """Pixels in whose neighbourhood the texture of a membrane's reflectance has an edge."""
        import drjit as dr
        import mitsuba as mi

        found = np.zeros(hits.shape, bool)
        for m in self.scene.membranes.values():
            if not m.reflectance.is_spatially_varying():
                continue
            own = hits.si.is_valid() & (hits.si.bsdf() == mi.BSDFPtr(m))
            paint = dr.select(own, m.reflectance.eval(hits.si, own), 0.0)[0]
            own, paint = hits.image(own), hits.image(paint)
            if own.any():
                low, high = around(np.where(own, paint, paint[own].mean()))
                found |= high - low > PAINTED * paint[own].max()
        return found

    # -- one LED ------------------------------------------------------------------------------------------------------
    def _led_key(self, values: Mapping, led: str) -> tuple:
        return (
            led,
            self.geometry(values),
            self._shading(values),
            tuple(values[k] for k in self.led_keys[led]),
        )

    def _image_key(self, values: Mapping, led: str) -> tuple:
        return (*self._led_key(values, led), self.wanted)

    def led(self, values: Mapping, led: str) -> LedImage:
        """The image that one LED makes at power 1 by direct light, kept with what its derivatives need."""
        key = self._image_key(values, led)
        if key in self._images:
            self._images.move_to_end(key)
            return self._images[key]
        hits = self.hits(values)
        if alike := self._placed_alike(key):
            self.apply(values, move=False)
            return self._keep(key, self._shaded_again(alike))
        self.apply(values, move=not hits.bare)
        # moving the geometry costs more than an image: make what will be asked for next
        keys = {led: key}
        for other in sorted(self.together - {led}):
            own = self._image_key(values, other)
            if own not in self._images and self._plain_key(own) not in self._plain:
                keys[other] = own
        found = self._render(hits, list(keys))
        for name, own in keys.items():
            self._keep(own, found[name])
        return found[led]

    def _plain_key(self, key: tuple) -> tuple:
        """The key of a plain image as finely as images are wanted."""
        return key if self.side == 1 else (*key, self.side)

    def _placed_alike(self, key: tuple) -> LedImage | None:
        """A kept image of the same LED in the same place over the same geometry, which differs in shading alone: with
        its shadows nothing needs to be traced. None where there is none, or shading is that of layers."""
        led, geometry, _, *own = key
        if self.layered or led in self.scene.sources:
            return None
        alike = (i for k, i in reversed(self._images.items()) if (k[0], k[1], *k[3:]) == (led, geometry, *own))
        return next(alike, None)

    def _shaded_again(self, alike: LedImage) -> LedImage:
        """The image of an LED by the shadows of another."""
        image = copy.copy(alike)
        image.raw = self._direct(image)
        image.radiance = self._mix(image, image.raw)
        return image

    def _direct(self, image: LedImage) -> tuple:
        """Direct light of an image's LED at pixel centres and at the finer samples."""
        part = self.scene.leds[image.led]
        return self._raw(
            image,
            lambda: self._shade(image.hits.sample, part, image.visible),
            lambda: self._shade(image.finer.sample, part, image.rim_visible),
        )

    def _keep(self, key: tuple, image: LedImage) -> LedImage:
        if self.passing and image.radiance is not None:
            self._keep_plain(key, image.radiance)
            if self.side > 1:
                self._keep_plain(self._plain_key(key), self._mix(image, image.raw, side=self.side))
            return image
        self._images[key] = image
        while len(self._images) > self.remember * len(self.scene.lights):
            self._images.popitem(last=False)
        self._make_room(image.hits, image.ends)
        if image.radiance is not None:
            self._keep_plain(key, image.radiance)
        return image

    def _keep_plain(self, key: tuple, image: np.ndarray) -> np.ndarray:
        before = self._plain.get(key)
        self._plain_bytes += image.nbytes - (0 if before is None else before.nbytes)
        self._plain[key] = image
        most = IMAGES * self.remember / REMEMBER
        # of both sides of a difference, in pixels and in parts of these
        while self._plain_bytes > most and len(self._plain) > 4 * len(self.scene.lights):
            self._plain_bytes -= self._plain.popitem(last=False)[1].nbytes
        return image

    def _render(self, hits: Hits, leds: Sequence[str]) -> dict[str, LedImage]:
        """LED -> its image over one geometry; of alike ones at once, where images are small."""
        found: dict[str, LedImage] = {}
        for names in self._alike(hits, leds):
            if len(names) > 1:
                try:
                    images = self._render_together(hits, names)
                except Apart:
                    self.apart, images = True, {}
                if images:
                    found.update(images)
                    continue
            found.update((name, self._render_led(hits, name)) for name in names)
        return found

    @property
    def at_once(self) -> bool:
        """Whether LEDs over one geometry are rendered at once."""
        alone = self.apart or self.layered or self.crowded or self.integral is not None
        return not alone and TOGETHER // (self.width * self.height) > 1

    def _alike(self, hits: Hits, leds: Sequence[str]) -> list[list[str]]:
        """The LEDs in groups that are rendered at once."""
        most = TOGETHER // hits.size
        if not self.at_once or len(leds) < 2:
            return [[name] for name in leds]
        faces = [s.bbox().max.z for s in self._world().shapes() if _is_window(s)]
        lights = [self.scene.leds[name] for name in leds if name in self.scene.leds]
        groups = [[light.name for light in own] for own in alike(lights, faces)]
        groups += [[name] for name in leds if name not in self.scene.leds]
        return [own[i : i + most] for own in groups for i in range(0, len(own), most)]

    def _render_led(self, hits: Hits, led: str) -> LedImage:
        if led in self.scene.sources:  # what it sends lies in the weights
            rim = self._joint_rim(hits)
            index = np.flatnonzero(rim)
            image = LedImage(led, hits, rim, index, self._finer(hits, index), None, None, hits.valid)
            own = np.zeros((1, self.bands))
            own[:, self._own(led)] = 1.0
            image.raw = own, (own if len(index) else None)
            return image
        if self.crowded:
            return self._render_crowded(hits, led)
        part = self.scene.leds[led]
        visible = self._unshaded(hits, part)
        seen = self._seen(hits, visible)
        rim = self._joint_rim(hits) if self.layered else self._rim(hits, seen)
        index, bent, share = self._sampled(hits, part, rim)
        finer = self._finer(hits, index, bent)
        rim_visible = self._visible(finer.sample.si, part) if len(index) else None
        image = LedImage(led, hits, rim, index, finer, visible, rim_visible, seen.mean(0) > 0.5)
        image.share = share
        image.raw = self._direct(image)
        if not self.layered:
            image.radiance = self._mix(image, image.raw)
        return image

    def _sampled(self, hits: Hits, part, rim: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(numbers of the pixels that take finer samples of an LED's light, which of them take few, (n, 1) share by
        which these stand for the pixel)."""
        share = np.where(rim, 1.0, hits.bent)
        if self.wanted is not None:
            share = np.where(self.wanted.mask, share, 0.0)
        index = np.flatnonzero(share)
        # of a light of many points, an edge in the shadow of one is small
        few = ~(hits.edges if len(part.places()) > SOFT else rim)
        return index, np.flatnonzero(few.ravel()[index]), share.reshape(-1, 1)[index]

    def _render_together(self, hits: Hits, leds: Sequence[str]) -> dict[str, LedImage]:
        """The images of alike LEDs: rays, shadows and shading of all of them at once; {} where that would be too many
        rays, as on a painted face."""
        parts = [self.scene.leds[name] for name in leds]
        group = Group(parts, hits.sample, hits.size)
        group.visible = self._reached(
            hits, parts, lambda: self._visible(group.centres().si, group.at_centres(), hits.bare)
        )
        seen = self._seen(hits, group.visible).reshape(-1, len(parts), *hits.shape)
        rims = self._rim(hits, seen)
        indices, few, shares = zip(*(self._sampled(hits, part, rim) for part, rim in zip(parts, rims)))
        few = [np.isin(np.arange(len(index)), bent) for index, bent in zip(indices, few)]
        if sum(np.where(own, self.bent_side**2, self.rim_samples).sum() for own in few) > MOST_FINER:
            return {}
        # LEDs share a pixel's samples, unless one takes few there and another many
        own, places = np.unique(2 * np.concatenate(indices) + np.concatenate(few), return_inverse=True)
        places = np.split(places, np.cumsum(list(map(len, indices)))[:-1])
        finer = group.split(self._in_pixels(own // 2, own % 2 == 1), places)
        if group.finer is not None:
            group.rim_visible = self._visible(group.finer.si, group.at_finer())
        (centres,) = self._bands([self._shade(group.centres(), group.at_centres(), group.visible)])
        fine = None
        if group.finer is not None:
            (fine,) = self._bands([self._shade(group.finer, group.at_finer(), group.rim_visible)])
        raw = group.apart(centres, fine)
        found = {}
        for k, name in enumerate(leds):
            lit = seen[:, k].mean(0) > 0.5
            image = found[name] = LedImage(name, hits, rims[k], indices[k], finer[k], None, None, lit, group)
            image.share, image.raw = shares[k], (hits.everywhere(raw[k][0]), raw[k][1])
            image.radiance = self._mix(image, image.raw)
        return found

    def _render_crowded(self, hits: Hits, led: str) -> LedImage:
        """The image of one LED in a crowded scene: finer samples in all pixels, few where no outline is."""
        index = np.arange(hits.valid.size)
        finer = self._in_crowd(hits)
        visible = self._visible(finer.sample.si, self.scene.leds[led])
        image = LedImage(led, hits, None, index, finer, None, visible, None)
        image.raw = self._direct(image)
        image.radiance = self._mix(image, image.raw)
        return image

    def shadows(self, values: Mapping, led: str) -> tuple[np.ndarray, np.ndarray]:
        """(H, W), (H, W) bool: pixels at a rim of a shadow or a body, and those whose middle most of a light's points
        reach."""
        image = self.led(values, led)
        if not self.crowded:
            return image.rim, image.lit
        self.apply(values)
        hits = image.hits
        seen = self._seen(hits, self._unshaded(hits, self.scene.leds[led]))
        return self._rim(hits, seen), seen.mean(0) > 0.5

    def _seen(self, hits: Hits, visible) -> np.ndarray:
        """(points of the source and lights, H, W) of what is visible from the centres that were followed."""
        seen = np.array(visible).reshape(-1, hits.size)
        return hits.everywhere(seen.T).T.reshape(-1, *hits.shape)

    def _rim(self, hits: Hits, seen: np.ndarray) -> np.ndarray:
        """(..., H, W) pixels at a rim of the geometry, or of the shadow of a point of a source, of sources that reach
        (points, ..., H, W)."""
        return edges(seen & hits.valid).any(0) | hits.edges

    def _joint_rim(self, hits: Hits) -> np.ndarray:
        """Pixels at a rim for any light: in scenes with layers one set of finer samples serves all."""
        if hits.joint is None:
            rims = (self._rim(hits, self._seen(hits, self._unshaded(hits, part))) for part in self.scene.leds.values())
            hits.joint = np.logical_or.reduce([hits.edges, *rims])
        return hits.joint

    def _unshaded(self, hits: Hits, part):
        """`_visible` at pixel centres, kept."""
        return self._reached(hits, [part], lambda: self._visible(hits.si, part, hits.bare))

    def _reached(self, hits: Hits, parts: Sequence, see: Callable):
        """What `see` finds that lights reach of the pixels' centres, kept for as long as they stand where they do."""
        names, standing = tuple(part.name for part in parts), [_standing(part) for part in parts]
        if names not in hits.lit or hits.lit[names][0] != standing:
            hits.lit[names] = standing, see()
        return hits.lit[names][1]

    # -- what layers leave of it --------------------------------------------------------------------------------------
    def image(self, values: Mapping, light: str, component: int = 0) -> np.ndarray:
        """(H, W, B) what one light makes at power 1, layers and all; (N, 1, B) where `values` hold arrays of readings.

        component  of the Stokes vector in the camera's axes; 0: what the camera records, S0 unless its detector
                   prefers a polarization (stage `detector`)
        """
        if not self.layered:
            key = self._plain_key(self._image_key(values, light))
            plain = self._plain.get(key)
            if plain is None:
                lit = self.led(values, light)
                plain = lit.radiance if self.side == 1 else self._plain.get(key)
                if plain is None:
                    plain = self._keep_plain(key, self._mix(lit, lit.raw, side=self.side))
            return plain if component == 0 else np.zeros_like(plain)
        image = self.led(values, light)
        pairs = zip(image.raw, self.weights(values, image, component))
        glows = list(self._glows(values, image, component))
        if not glows:
            return self._layered(image, pairs, self._own(light))
        seen = [None if r is None or w is None else r * w for r, w in pairs]
        for add in glows:
            seen = [s if s is None else s + a for s, a in zip(seen, add)]
        return self._mix(image, seen, side=self.side)

    def _layered(self, image: LedImage, pairs: Iterable[tuple], own: np.ndarray) -> np.ndarray:
        """(H, W, B) of light that is dark but in its own bands, which lie beside each other, behind layers; pairs of
        what it makes before them and of what they leave."""
        inside = slice(own.min(), own.max() + 1) if len(own) else slice(0, 1)
        seen = [None if r is None or w is None else r[:, inside] * w[:, inside] for r, w in pairs]
        lit = self._mix(image, seen, side=self.side)
        if lit.shape[-1] == self.bands:
            return lit
        found = np.zeros((*lit.shape[:2], self.bands), lit.dtype)
        found[..., inside] = lit
        return found

    def _glows(self, values: Mapping, image: LedImage, component: int) -> Iterator[tuple]:
        """What boundaries send to the camera by themselves while one light is on (stage `glow`): at centres, at finer
        samples."""
        names = [n for n in self.scene.parts if self.scene.declaration(n).refracts and image.led in self.scene.leds]
        for name in names:
            effects = self.scene.registry.at_stage(self.scene.parts[name].kind, "glow")
            own = paths.part_values(self.scene, name, values, {})
            functions = [
                e.stages["glow"]
                for e in effects
                if any(getattr(own, n) != self.scene.parts[name].numbers[n].neutral for n in e.parameter_names)
            ]
            if not functions:
                continue
            shines = [i for i, s in enumerate(self.scene.mitsuba.shapes()) if hasattr(s.bsdf(), "fluorescence")]
            marked = np.isin(image.hits.path.shape, shines)
            glow = SimpleNamespace(
                markers=image.raw[0][marked].mean(0, dtype=float) if marked.any() else np.zeros(self.bands),
                wavelengths=self.wavelengths,
            )
            light = sum(function(glow, own) for function in functions)
            yield tuple(
                None
                if path is None
                else light * paths.transmission(self.scene, path, values, self.wavelengths, component, name)[0]
                for path in (image.hits.path, image.finer.sample.path if len(image.index) else None)
            )

    def weights(self, values: Mapping, image: LedImage, component: int = 0) -> tuple:
        """What the layers leave of a light: (H W, B) at the pixels' centres, (N, B) at the finer samples of rims."""
        centre = self._weight(values, image.led, image.hits.path, component, ())
        fine = None
        if len(image.index):
            fine = self._weight(values, image.led, image.finer.sample.path, component, (image.index.tobytes(),))
        return centre, fine

    def _weight(self, values: Mapping, light: str, path, component: int, where: tuple) -> np.ndarray:
        key = (
            self.geometry(values),
            component,
            *where,
            *(v.tobytes() if isinstance(v, np.ndarray) else v for v in (values[k] for k in self.layer_order)),
        )
        if key not in self._transmissions:
            if all(
                path is not other for other in self._recent
            ):  # matrices are large: those of the last geometries, at centres and at finer samples, are kept
                self._recent.append(path)
                if len(self._recent) > 2 * min(self.remember, 2):
                    self._recent.pop(0).forget()
            self._transmissions[key] = paths.transmission(self.scene, path, values, self.wavelengths, component)
            while len(self._transmissions) > 2 * self.remember:
                self._transmissions.popitem(last=False)
        row = self._transmissions[key]
        if light not in self.scene.sources:
            return row[0]
        sent = paths.emitted(self.scene, light, path, values, self.wavelengths)
        if self.integral is not None and not self.integral.auto:
            sent = tuple(s / self.integral.width(light, values) for s in sent)
        return sum(r * s for r, s in zip(row, sent) if not isinstance(s, int))

    # -- all lights ---------------------------------------------------------------------------------------------------
    def lit(self, values: Mapping) -> list[str]:
        """The lights that are on."""
        return [n for n in self.scene.lights if np.any(values[self.scene.powers[n]] != 0)]

    def light(self, values: Mapping, light: str, seed: int = 0, component: int = 0) -> np.ndarray:
        """(H, W, B) what one light makes at its power, by one reflection and by two."""
        image = self.image(values, light, component)
        if self.bounce_key and values[self.bounce_key]:
            image = image + values[self.bounce_key] * self.bounced(values, light, seed, component, self.roughly)
        return self.powers(values, light) * image

    def radiance(self, values: Mapping, seed: int = 0, component: int = 0) -> np.ndarray:
        """(H, W, B): linear image that the camera records; complex where `values` hold a complex step of a layer's
        parameter."""
        lights = (self.light(values, n, seed, component) for n in self.lit(values))
        return sum(lights, self.ambient(values, component))

    def stokes(self, values: Mapping, seed: int = 0) -> np.ndarray:
        """(4, H, W, B): Stokes vectors at the camera; (4, N, 1, B) where `values` hold arrays of readings."""
        plain = {**values, **paths.undetected(self.scene)}
        return np.stack([self.radiance(plain, seed, component) for component in range(4)])

    def _finer(self, hits: Hits, index: np.ndarray, bent: np.ndarray | tuple = ()) -> Finer:
        """Finer samples of the pixels `index`; of `bent` among them, where no edge is, fewer."""
        key = (index.tobytes(), np.asarray(bent).tobytes())
        if key not in hits.rims:  # only the latest is kept
            hits.rims = {key: self._in_pixels(index, np.isin(np.arange(len(index)), bent))}
        return hits.rims[key]

    def _in_pixels(self, index: np.ndarray, bent: np.ndarray) -> Finer:
        """A Hammersley set in each pixel, shifted from pixel to pixel: an edge in any direction crosses the samples one
        by one, and not in rows, so that a shadow that moves changes a pixel in small steps. What only bends is smooth:
        the middles of a square grid."""
        counts, u, v = self._places(index, bent, self.rim_samples, self.bent_side)
        return Finer(counts, self._trace(u, v) if len(index) else None, (u, v))

    def _places(self, index: np.ndarray, bent: np.ndarray, samples: int, side: int) -> tuple[np.ndarray, ...]:
        """(n,) samples of each pixel, (N,) each u, v in px: `samples` of a Hammersley set, of `bent` pixels side x side
        of a grid."""
        counts = np.where(bent, side**2, samples)
        starts = np.cumsum(counts) - counts
        u, v = np.empty((2, counts.sum()), np.float32)
        rim = starts[~bent, None] + np.arange(samples)
        middle = starts[bent, None] + np.arange(side**2)
        u[rim], v[rim] = self._at(index[~bent], self._set(index[~bent], samples))
        u[middle], v[middle] = self._at(index[bent], _grid(side))
        return counts, u, v

    def _other_edges(self, hits: Hits, values: Mapping) -> np.ndarray:
        """Pixels in which something else than a ball ends or folds: in whose corners and middle not one body is seen
        behind the balls, also those of bodies that no middle sees, and all that are as near to one of these as circles
        of confusion are wide; and folds, but for those beside a ball."""
        from scipy.ndimage import maximum_filter

        index = np.arange(self.height * self.width)
        bodies = self._bodies(*self._at(index, CORNERS)).astype(int)
        ball = (bodies > 0) & (bodies < self.scene.traced.bodies)
        low, high = (own(np.where(ball, none, bodies), 1) for own, none in ((np.min, 2**62), (np.max, -1)))
        parted = (high > low).reshape(self.height, self.width)
        beside = maximum_filter(ball.any(1).reshape(self.height, self.width), 3)
        folds = creases(np.where(hits.valid[..., None], hits.normal, 0.0)) & ~beside
        camera = self.scene.camera
        area, wide = values[f"{camera.name}.{camera.named('pupil')}"], 0.0
        own = SimpleNamespace(**{n: values[f"{camera.name}.{n}"] for n in camera.numbers})
        v, u = np.mgrid[: self.height, : self.width] + 0.5
        if area > PINHOLE and parted.any():
            reach = self._reach()
            wide = max(np.abs(camera.astray(own, u, v, far)).max() for far in (reach.min(), reach.max()))
        # by a pixel at least, so that a small pupil changes no pixel's way of being sampled
        return folds | maximum_filter(parted, 2 * max(int(np.ceil(wide * np.sqrt(area / np.pi))), 1) + 1)

    def _outlines(self, values: Mapping) -> Outlines:
        """Where in the image the crowds' balls are, of the scene as it stands."""
        camera, crowds = self.scene.camera, self.scene.traced.crowds
        area = values[f"{camera.name}.{camera.named('pupil')}"]
        pupil = math.sqrt(area / math.pi) if area > PINHOLE else 0.0
        middles, radii = (np.concatenate([getattr(c, n) for c in crowds]) for n in ("middles", "radii"))
        return Outlines(self._plain_rays, (self.height, self.width), middles, radii, pupil)

    def _grain(self, values: Mapping) -> Grain:
        """How finely a crowd is made, by the values at which the renderer began, so that it is the same for all images;
        but for the focus, as far as it makes a difference."""
        camera = self.scene.camera
        pupil, focus = (f"{camera.name}.{camera.named(role)}" for role in ("pupil", "focus"))
        about = round(math.log(max(values[focus], 1e-3)) / ABOUT)
        if about not in self._grains:
            base = {**self._began, pupil: math.pi, focus: math.exp(ABOUT * about)}  # a radius of 1 mm
            self.apply(base)
            self._grains[about] = self._outlines(base).grain(CELLS * 2 ** ((self.fine - 1) / 2))
        return self._grains[about]

    def _in_crowd(self, hits: Hits) -> Finer:
        """Finer samples of all pixels of a crowded scene: rays for each part of those that show balls, few where none
        is, and many where something else ends."""
        if CROWD not in hits.rims:
            outlines = hits.outlines
            shown, others = outlines.shown(hits.grain), np.flatnonzero(~outlines.own.ravel())
            side = min(hits.grain.cells, MOST_ELSEWHERE)
            bent = ~hits.edges.ravel()[others]
            samples = _power_of_two(side**2) * (BEHIND_PUPIL if outlines.pupil else 1)
            counts, *places = self._places(others, bent, samples, max(side // 2, 2))
            plain = int(counts.sum())
            pixel = np.concatenate([np.repeat(others, counts), shown.pixel])
            order = np.argsort(pixel, kind="stable")
            u, v = (np.concatenate(own)[order] for own in zip(places, (shown.u, shown.v)))
            weight = np.concatenate([np.repeat(1 / counts, counts), shown.weight])[order]
            lens = None
            if outlines.pupil:
                lens = np.full((2, len(pixel)), 0.5, np.float32)
                rim = (np.cumsum(counts) - counts)[~bent, None] + np.arange(samples)
                lens[:, rim] = _places_on_lens(samples, others[~bent])
                lens[:, plain:] = shown.lens
                lens = lens[:, order]
            cut = np.flatnonzero(shown.cut)
            place = np.argsort(order)[plain:]  # where the rays for balls came to stand
            aim = (place[cut].astype(np.uint32), partial(outlines.aimed, shown, cut)) if len(cut) else None
            counts = np.bincount(pixel, minlength=hits.valid.size)
            hits.rims = {CROWD: Finer(counts, self._trace(u, v, lens, aim), (u, v), weight)}
        return hits.rims[CROWD]

    def _reach(self) -> np.ndarray:
        """Distances of the balls from the camera, mm."""
        eye = self._eye()
        return np.concatenate([np.linalg.norm(c.middles - eye, axis=1) for c in self.scene.traced.crowds])

    def _bodies(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """A number for each body that rays through places in px of any shape meet, other than any other's; 0 where they
        meet none."""
        import drjit as dr
        import mitsuba as mi

        o, d, _ = self._rays(u.ravel(), v.ravel())
        ray = mi.Ray3f(o, d, mi.Float(0), self.scene.integrator.wavelengths(dr.width(o)))
        return np.array(self.scene.traced.number(self._world().ray_intersect_preliminary(ray, coherent=True))).reshape(
            u.shape
        )

    def _set(self, index: np.ndarray, count: int) -> tuple[np.ndarray, ...]:
        """(P, count) places in pixels: a Hammersley set, shifted in each by the R2 sequence."""
        places = np.arange(count, dtype=np.float32) / count, _reversed(count).astype(np.float32)
        shifts = ((index * shift % 1.0).astype(np.float32) for shift in R2)
        return tuple((place + shift[:, None]) % 1.0 for place, shift in zip(places, shifts))

    def _at(self, index: np.ndarray, places: tuple) -> tuple[np.ndarray, np.ndarray]:
        """(P, n) positions in px of places in pixels."""
        corners = index % self.width, index // self.width
        u, v = ((corner[:, None] + place).astype(np.float32) for corner, place in zip(corners, places))
        return u, v

    def _visible(self, si, part, bare: bool = False):
        """Share of the LED that each hit sees; a Float (a mask for a point source). bare: nothing casts shadows."""
        import drjit as dr

        integrator = self.scene.integrator
        if bare:
            valid = si.is_valid()
            dr.eval(valid)
            return [valid] * len(part.places()) if len(part.places()) > 1 else valid
        share = []
        for point in integrator.spots(part):
            share.append(integrator.visible(self._world(), si, dr.detach(point), part))
            dr.eval(share[-1])
        return share[0] if len(share) == 1 else share

    def _shade(self, sample: Sample, part, visible):
        """Direct radiance per band at hits, an UnpolarizedSpectrum."""
        return self._shade_each(sample, part, visible, lambda light: [light])[0]

    def _shade_each(self, sample: Sample, part, visible, take: Callable) -> list:
        """The means of what `take` makes, as a list, of the direct radiance that each point of the source sends, while
        this is attached to whatever carries gradients.

        A point is evaluated before the next begins: all share a kernel, which would otherwise grow with their number.
        """
        import drjit as dr

        self._tune(sample.si)
        shares, totals = visible if isinstance(visible, list) else [visible], []
        for point, seen in zip(self.scene.integrator.spots(part), shares):
            own = take(self.scene.integrator.direct(self._world(), *sample[:3], part, seen, point))
            totals = [total + new for total, new in zip(totals, own)] if totals else own
            if len(shares) > 1:
                dr.eval(totals)
        return [total / len(shares) for total in totals]

    def _raw(self, image: LedImage, centre: Callable, rim: Callable) -> tuple:
        """Shading at pixel centres (H W, B) and at the finer samples (N, B), None without any; of a crowded scene at
        the finer ones alone, which all its pixels have."""
        fine = self._each_band(rim, image.led) if len(image.index) else None
        if self.crowded:
            return np.zeros((self.height * self.width, self.bands)), fine
        return image.hits.everywhere(self._each_band(centre, image.led).reshape(-1, self.bands)), fine

    def _mix(self, image: LedImage, raw: Sequence, weights: tuple = (1.0, 1.0), side: int = 1) -> np.ndarray:
        """(H, W, B) from pixel centres and, where the rim is, from the mean of the finer samples, by its share; of
        `side` parts of a pixel each way (side H, side W, B)."""
        result = raw[0] * weights[0] if self.layered else raw[0].copy()
        centres = result.copy() if side > 1 else result
        height = self.height if len(result) == self.height * self.width else -1
        if height > 0 and image.rim is not None and not self.layered:
            pixels = result.reshape(height, self.width, -1)
            pixels += bend(pixels, image.rim) / 24
        fine = raw[1] * weights[1] if len(image.index) else None
        if fine is not None:
            result[image.index] += image.share * (image.finer.mean(fine) - result[image.index])
        result = result.reshape(height, self.width, result.shape[-1])
        if side == 1 or height < 0:
            return result
        return self._in_parts(image, result, centres.reshape(result.shape), fine, side)

    def _in_parts(
        self, image: LedImage, result: np.ndarray, centres: np.ndarray, fine: np.ndarray | None, side: int
    ) -> np.ndarray:
        """(side H, side W, B): pixels `result` (H, W, B) in parts, whose mean they are. They differ as the middles
        `centres` of the pixels about them do, and where finer samples are, as these."""
        found = in_parts(finer_of(centres, side) - repeated(centres, side), side)
        found = found.reshape(-1, side**2, result.shape[-1])
        if fine is not None:
            apart = image.finer.in_parts(fine, side, image.index, self.width)
            share = image.share if np.ndim(image.share) == 0 else np.asarray(image.share)[..., None]
            found[image.index] += share * (apart - apart.mean(1, keepdims=True) - found[image.index])
        found += result.reshape(-1, 1, result.shape[-1])
        return from_parts(found.reshape(self.height, self.width, side, side, -1))

    def _bands(self, spectra: Sequence, count: int | None = None) -> list[np.ndarray]:
        import drjit as dr

        dr.eval(spectra)  # lane by lane: one array of all lanes would carry its size into the kernel
        lanes = range(self.bands if count is None else count)
        return [np.stack([np.array(spectrum[i]) for i in lanes], -1) for spectrum in spectra]

    def _own(self, led: str) -> np.ndarray:
        """Numbers of the bands in which a light is rendered; of no light, all."""
        if self.integral is None or not led:
            return np.arange(self.bands)
        return self.integral.bands_of(led)

    def _each_band(self, shade: Callable, led: str = "") -> np.ndarray:
        """(N, B) of what `shade` gives per lane."""
        return self._each_band_of(lambda: [shade()], led)[0]

    def _each_band_of(self, shade: Callable, led: str = "") -> list[np.ndarray]:
        """(N, B) of each spectrum in the list that `shade` gives per lane; of channels that are integrals in as many
        passes as the light's bands take, 0 in the bands of others."""
        if self.integral is None:
            return self._bands(shade())
        found: list[np.ndarray] = []
        own, lanes = self._own(led), self.scene.integrator.lanes
        seen = len(own) > 0
        own = own if seen else np.zeros(1, int)  # a light that no channel sees
        for start in range(0, len(own), lanes):
            self._lanes = own[start : start + lanes]
            self._light_lanes(led)
            try:
                raw = self._bands(shade(), len(self._lanes))
            finally:
                here, self._lanes = self._lanes, None
                self._light_lanes("")
            if not start:
                found = [np.zeros((len(image), self.bands), image.dtype) for image in raw]
            for image, lanes_of_it in zip(found, raw):
                image[:, here] = lanes_of_it * seen
        return found

    def _light_lanes(self, led: str) -> None:
        """Tell a light and the pigments which lanes of the present pass are theirs; where none is present, nothing."""
        if not self.integral.auto:
            return
        for name, part in self.scene.parts.items():
            pigment = hasattr(part, "fluorescence")
            if self._lanes is None or not (name == led or pigment):
                if name in self.scene.leds or pigment:
                    part.lane = None
                continue
            part.lane = self._spectrum(self.integral.lanes(led, name if pigment else ""))

    def _spectrum(self, per_band: np.ndarray):
        """The lanes of the present pass of numbers (B,); those without a band repeat the last."""
        import drjit as dr
        import mitsuba as mi

        lanes = self.scene.integrator.lanes
        own = per_band[self._lanes] if len(self._lanes) else per_band[:1] * 0
        padded = np.append(own, [own[-1]] * lanes)[:lanes]
        return mi.UnpolarizedSpectrum(*(dr.opaque(mi.Float, float(v)) for v in padded))

    def _tune(self, si) -> None:
        """Give what camera rays met the wavelengths of the present pass."""
        if self._lanes is not None:
            si.wavelengths = type(si.wavelengths)(self._spectrum(self.integral.nm))

    def powers(self, values: Mapping, led: str) -> np.ndarray:
        """(B,) power of an LED in each band, relative to its image."""
        own = [values[key] for key in self.scene.band_powers[led]]
        gain = self.scene.power_gains.get(led)
        power = values[self.scene.powers[led]] * (1.0 if gain is None else values[gain])
        if self.integral is not None:
            return power * np.array(own)[self.colours] if own else np.full(self.bands, power)
        shares = own + [1.0] * self.bands
        return power * np.array(shares[: self.bands])

    def led_tangent_at_rest(self, values: Mapping, led: str, key: str, component: int = 0) -> np.ndarray:
        """`led_tangent`, kept: all frames share the gel at rest."""
        now = tuple(values[k] for k in self.shading_keys)  # also clocks, through which a derivative shows
        known = (
            key,
            component,
            now,
            *self._led_key(values, led),
            *(values[k] for k in self.layer_order),
            self.side,
        )
        if known not in self._tangents:
            with everywhere(self):
                self._tangents[known] = self.led_tangent(values, led, key, component).astype(np.float32)
            while len(self._tangents) > 8 * len(self.scene.lights):
                self._tangents.popitem(last=False)
        return self._tangents[known]

    def led_tangent(self, values: Mapping, led: str, key: str, component: int = 0) -> np.ndarray:
        """d / d parameter of one LED's image (of a component of the Stokes vectors), forward mode; where the LED moves,
        rims by how its shadows do (optics.light.moving_shadows), of areas and in crowded scenes by central
        differences."""
        image = self.led(values, led)
        found = self._slopes.setdefault((led, id(image)), (image, {}))[1]
        if key not in found:
            # what a surface holds enters by a call of its own, which a graph that is gone through again cannot follow
            own = self.led_keys[led]
            asked = [k for k in own if k in self.asked and self.scene.parameters[k].how == "ad"] if key in own else []
            others = [k for k in asked if k != key and k not in found]
            rays = [image.finer.size, image.hits.size]
            if image.group is not None:
                rays = [sum(image.group.sizes), rays[1] * len(image.group.names)]
            at_once = max(int(AT_ONCE / max(rays)), 1)
            keys = [key, *others[: at_once - 1]]
            mates = self._mates(values, image, keys)
            try:
                slopes_of = Slopes(self, image, keys, mates).made(values)
            except Apart:  # of a group alone
                self.apart = True
                slopes_of = Slopes(self, image, keys).made(values)
            for mate, slopes in slopes_of.items():
                self._slopes.setdefault((mate.led, id(mate)), (mate, {}))[1].update(slopes)
            if not self.asked:
                self._slopes.clear()
        if component and not self.layered:
            return self._dark()
        weights = self.weights(values, image, component) if self.layered else (1.0, 1.0)
        return self._mix(image, found[key], weights, self.side)

    def _dark(self) -> np.ndarray:
        return np.zeros((self.side * self.height, self.side * self.width, self.bands))

    @contextmanager
    def asking(self, keys: Iterable[str]) -> Iterator[None]:
        """Within it, tangents of these parameters will be asked for: of one LED they are made together, as they share
        all that its light is made of."""
        self.asked = set(keys)
        try:
            yield
        finally:
            self.asked = set()
            self._slopes.clear()

    def _mates(self, values: Mapping, image: LedImage, keys: Sequence[str]) -> list[LedImage]:
        """The images whose tangents are made with those of an LED's image: of all LEDs that it was made with, where
        they are lit as well and will be asked for the same; [] for none."""
        group, lit = image.group, self.lit(values)
        if self.apart or group is None or not all(name in lit for name in group.names):
            return []
        wanted = [of_light(key, image.led, name) for key in keys for name in group.names]
        found = [self._images.get(self._image_key(values, name)) for name in group.names]
        alike = all(mate is not None and mate.group is group for mate in found)
        return found if alike and self.asked.issuperset(wanted) else []

    def bounced(
        self, values: Mapping, led: str, seed: int = 0, component: int = 0, roughly: bool = False
    ) -> np.ndarray:
        """(H, W, B): light of one LED at power 1 after two reflections, unpolarized before any layers, as a component
        of the Stokes vector; the mean over second directions.

        Light from all around varies slowly: of large images it is gathered for every second pixel each way, over the
        area of the four, and interpolated linearly in between. A cell's directions are those of one Sobol sequence,
        shifted from cell to cell by another, so that what a mean misses is noise of single cells. They are the same for
        every geometry and LED of a seed, for differences. Far from the pixels that are wanted they are few.

        roughly   with ROUGHLY times fewer directions
        """
        from scipy.ndimage import zoom

        if led in self.scene.sources:  # it lights nothing
            return np.zeros((1, 1, self.bands))
        cell, samples = self.bounce
        samples = max(samples // ROUGHLY, 1) if roughly else samples
        key = ("bounced", seed, samples, *self._image_key(values, led))
        if key in self._plain:
            return self._bounced(values, led, self._plain[key], component)
        if self.hits(values).bare and len(self._world().shapes()) == 1:  # a level skin does not meet itself
            return self._parts_of(np.zeros((self.height, self.width, self.bands), np.float32))
        self.apply(values)
        sample, numbers, met = self._spread(values, seed, samples)
        for other in (led, *sorted(self.together - {led})):  # as for direct light: these will be asked for next
            own = ("bounced", seed, samples, *self._image_key(values, other))
            if other in self.scene.sources or own in self._plain:
                continue

            def shade(lamp=self.scene.leds[other]):
                self._tune(sample.si)
                if met is not None:
                    self._tune(met)
                world, given = self._world(), Directions(numbers)
                return self.scene.integrator.bounced(world, *sample[:3], lamp, 1, given, self.grazing, met)

            coarse = self._over_cells(self._each_band(shade, other), samples)
            image = zoom(coarse, (cell, cell, 1), order=1, mode="nearest", grid_mode=True)
            self._keep_plain(own, image[: self.height, : self.width].astype(np.float32))
        return self._bounced(values, led, self._plain[key], component)

    def _spread(self, values: Mapping, seed: int, samples: int) -> tuple:
        """`_spread_rays`, and what their second directions meet, which all LEDs share; the latest is kept. None of so
        many rays that they would take more than a quarter of the memory: each LED then traces its own."""
        key = (seed, samples, self.wanted, self.grazing, self.geometry(values), self._shading(values))
        if self._second is None or self._second[0] != key:
            self._second = None
            sample, numbers = self._spread_rays(seed, samples)
            self._tune(sample.si)
            met = None
            if 4 * PER_RAY * len(numbers[0]) <= self.memory:
                met = self.scene.integrator.met_next(self._world(), sample.si, Directions(numbers), self.grazing)
            self._second = key, (sample, numbers, met)
        return self._second[1]

    def _spread_rays(self, seed: int, samples: int) -> tuple[Sample, list]:
        """(ends of the camera rays that gather light from all around, the numbers that their second directions are
        drawn by, in Dr.Jit arrays): the same for every geometry and LED."""
        cell = self.bounce[0]
        at, numbers = self._directions(seed, samples)
        sample = self._trace(*(np.minimum(a * cell, size - 1e-3) for a, size in zip(at, (self.width, self.height))))
        return sample, numbers

    def _directions(self, seed: int, samples: int) -> tuple[list[np.ndarray], list]:
        """(u, v in cells of where these rays pass, Dr.Jit arrays of the numbers of their second directions); the two
        latest sets are kept, of images and of rough ones of the same pixels."""
        import mitsuba as mi
        from scipy.stats import qmc

        key = (seed, samples, self.wanted, *self.bounce)
        if key not in self._drawn:
            while len(self._drawn) > 1:
                self._drawn.popitem(last=False)
            rows, columns = self._cells()
            rng = np.random.default_rng([seed, 77])
            drawn, shifts = (
                qmc.Sobol(BOUNCE_NUMBERS, rng=rng).random(_power_of_two(n))[:n] for n in (samples, rows * columns)
            )
            parts = [
                (np.divmod(np.repeat(cells, count), columns), (drawn[:count] + shifts[cells, None]) % 1)
                for cells, count in self._counted(samples)
            ]
            numbers = np.concatenate([own.reshape(-1, BOUNCE_NUMBERS) for _, own in parts])
            v, u = (np.concatenate([place[k] for place, _ in parts]) for k in (0, 1))
            at = [a + numbers[:, k] for k, a in enumerate((u, v))]
            self._drawn[key] = at, [mi.Float(aligned(c)) for c in numbers[:, 2:].T]
        return self._drawn[key]

    def _cells(self) -> tuple[int, int]:
        """Rows and columns of the cells that second reflections are gathered for."""
        return -(-self.height // self.bounce[0]), -(-self.width // self.bounce[0])

    def _counted(self, samples: int) -> list[tuple[np.ndarray, int]]:
        """(numbers of cells, directions of each): of those that wanted pixels are interpolated from, as many as asked
        for; of all others few."""
        from scipy.ndimage import binary_dilation

        rows, columns = self._cells()
        if self.wanted is None:
            return [(np.arange(rows * columns), samples)]
        cell = self.bounce[0]
        mask = np.pad(self.wanted.mask, ((0, rows * cell - self.height), (0, columns * cell - self.width)))
        near = mask.reshape(rows, cell, columns, cell).any((1, 3))
        if cell > 1:
            near = binary_dilation(near, np.ones((3, 3), bool))
        fewer = min(max(samples // ASIDE, FEWEST), samples)
        return [(np.flatnonzero(near), samples), (np.flatnonzero(~near), fewer)]

    def _over_cells(self, light: np.ndarray, samples: int) -> np.ndarray:
        """(rows, columns, B) means of what directions brought, cell by cell."""
        found, begin = np.empty((*self._cells(), self.bands), light.dtype), 0
        for cells, count in self._counted(samples):
            end = begin + len(cells) * count
            found.reshape(-1, self.bands)[cells] = light[begin:end].reshape(-1, count, self.bands).mean(1)
            begin = end
        return found

    def _bounced(self, values: Mapping, led: str, image: np.ndarray, component: int) -> np.ndarray:
        """A bounced image behind the layers."""
        if not self.layered:
            return self._parts_of(image if component == 0 else np.zeros_like(image))
        weight = self._weight(values, led, self.hits(values).path, component, ())
        return self._parts_of(image * weight.reshape(-1, self.width, self.bands))

    def glows(self, values: Mapping) -> bool:
        """Whether there is light that no LED made."""
        return any(values[k] != neutral for k, neutral in self._still.items())

    def ambient(self, values: Mapping, component: int = 0) -> np.ndarray:
        """(H, W, B): radiance of the membranes that no LED made."""
        if not self.glows(values) or component and not self.layered:
            return self._dark()
        if not self.layered:
            hits = self.hits(values)
            shone = hits.everywhere(np.broadcast_to(self._shone(values, hits.sample), (hits.size, self.bands)))
            return self._parts_of(shone.reshape(*hits.shape, self.bands).astype(float))
        image = self.glow(values)
        own = np.arange(self.bands) if self.integral is None else np.flatnonzero(self.integral.white)
        return self._layered(image, zip(image.raw, self.weights(values, image, component)), own)

    def glow(self, values: Mapping) -> LedImage:
        """The image of light that no LED made, in a scene with layers, before these; the latest is kept."""
        hits = self.hits(values)
        key = tuple(values[k] for k in (*self.ambient_keys, *self.shading_keys))
        if self._glow is not None and self._glow[1].hits is hits and self._glow[0] == key:
            return self._glow[1]
        rim = self._joint_rim(hits)
        index = np.flatnonzero(rim)
        image = LedImage("", hits, rim, index, self._finer(hits, index), None, None, hits.valid)
        image.raw = (
            self._shone(values, hits.sample),
            self._shone(values, image.finer.sample) if len(index) else None,
        )
        self._glow = key, image
        return image

    def _shone(self, values: Mapping, sample: Sample) -> np.ndarray:
        """(N, B): radiance of the membranes that no LED made, at the ends of camera rays."""
        self.apply(values, move=False)

        def shade(membrane):
            self._tune(sample.si)
            return self.scene.integrator.ambient(self._world(), *sample[:3], membrane) + 0 * sample.si.t

        found = sum(self._each_band(lambda m=m: shade(m)) for m in self.scene.membranes.values())
        return found if self.integral is None else found * self.integral.white


class Directions:
    """What a sampler of Mitsuba is to `bounced`, with given numbers in the unit interval: Dr.Jit arrays."""

    def __init__(self, numbers: Iterable):
        self._numbers = iter(numbers)

    def next_1d(self):
        return next(self._numbers)

    def next_2d(self):
        import mitsuba as mi

        return mi.Point2f(next(self._numbers), next(self._numbers))


def _is_window(shape) -> bool:
    from optics.light.led_by_led import is_interface  # once a variant is set

    return is_interface(shape)


def _power_of_two(number: float) -> int:
    """The next one: as many points of a Sobol sequence are even in every half."""
    return 1 << math.ceil(math.log2(number))


def _standing(light) -> tuple:
    """All numbers that a light and its board have: what its shadows depend on, and more."""
    board = getattr(light, "board", None)
    return (*light.held.values(), *(board.held.values() if board is not None else ()))


def _places_on_lens(count: int, index: np.ndarray) -> np.ndarray:
    """(2, P, count) places on the unit square that stand for the pupil, to go with those in pixels: further coordinates
    of the R4 sequence, which are in step with no other, shifted from pixel to pixel."""
    step = 1 / 1.1673039782614187 ** np.arange(3, 5)  # powers of the root of x^5 = x + 1
    return np.stack([(np.arange(count) * s + np.asarray(index)[:, None] * s * 0.5) % 1.0 for s in step])


def _grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    """(n,), (n,) the middles of a square grid in a pixel, row by row."""
    k = np.arange(side**2)
    return (k % side + 0.5) / side, (k // side + 0.5) / side


def _reversed(count: int) -> np.ndarray:
    """(n,) the second coordinates of a Hammersley set: the bits of a number, behind the point in reverse."""
    k = np.arange(count)
    return sum(((k >> b) & 1) / 2 ** (b + 1) for b in range(count.bit_length() - 1))
