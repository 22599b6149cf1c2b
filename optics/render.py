"""Prediction: what a scene says that a capture set should look like, frame by frame, and how that changes.

Light is linear in every LED, so each LED is rendered once per geometry at power 1 and kept; powers, exposure, colour and
response act on the kept images. One sample per pixel is exact away from edges: pixels at the rim of a shadow or of the
gel are sampled 64 times. Derivative images come from Dr.Jit in forward mode through the shading,
with the primary hits and shadows kept; at rims, where that misses the moving edge, and for everything that moves geometry
they are central differences with common samples (`Parameter.how`).
"""

from __future__ import annotations

import copy
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from optics import paths
from optics.captures import Captures, cfa_channel, sweeps
from optics.develop import STEP, Developer
from optics.effect import DEFAULT_VARIANT, registry
from optics.errors import BadScene, UnknownKey
from optics.noise import Noise
from optics.parameter import Parameter, Values, Variable
from optics.scene import Scene

RIM_SAMPLES = 128  # per pixel at rims; a power of two. Of a picture 36 px wide, chi2 misses a path tracer by 10 to 60 with 64, by 5 to 20 with 128
LAYERED_RIM_SAMPLES = 32  # in scenes with layers, whose matrices are multiplied for every sample
PAINTED = 0.05  # of the largest reflectance of a texture: a step from pixel to pixel that needs finer samples
BENT = 1e-3  # difference of a pixel's mean normal from that at its middle, above which finer samples are taken: a fifth of a grey level in 200
CREASE = 25.0  # deg from pixel to pixel: what is no smooth surface
POWERS = ("power", "power_r", "power_g", "power_b")  # images are kept per unit of each
FLAT_FIELDS = ("multiplicative", "additive", "none")
BOUNCE_SAMPLES = 32  # directions per cell for the second bounce
BOUNCE_CELL = 2  # px each way of a cell


class Renderer:
    """Linear images of a scene, one LED at a time, with a memory for what was rendered before."""

    by_chance = False  # whether pictures are Monte Carlo estimates

    def __init__(self, scene: Scene, remember: int = 24):
        if scene.camera is None or scene.integrator is None:
            raise BadScene(f"{scene.path}: a prediction needs a part of the type 'camera' and the integrator 'tactile'")
        if not scene.lights:
            raise BadScene(f"{scene.path}: the scene has no light (an emitter of the type 'led' or 'source')")
        paths.check(scene)
        self.scene = scene
        self.width, self.height = scene.camera.resolution
        self.bands = len(scene.integrator.bands or (0,))
        if self.bands > scene.integrator.lanes:
            raise BadScene(f"{scene.path}: {self.bands} bands, but the variant {scene.variant} carries {scene.integrator.lanes}; "
                           f"load the scene with variant='{DEFAULT_VARIANT}' or name one band")
        self.layered = paths.layered(scene)
        self.rim_samples = LAYERED_RIM_SAMPLES if self.layered else RIM_SAMPLES
        self.wavelengths = np.array(scene.integrator.bands or (540.0,))
        self.remember = remember
        self._transmissions: OrderedDict = OrderedDict()
        self._recent: list[paths.Path] = []
        self._hits: OrderedDict = OrderedDict()
        self._images: OrderedDict = OrderedDict()
        image_keys = {k for k, p in scene.parameters.items() if p.how == "image"}
        self.layer_keys = {k for k, p in scene.parameters.items() if p.how == "layer"}
        words = {f"{n}.{w}" for n, p in scene.parts.items() if registry().parts[p.kind].mueller is not None for w in p.words}
        self.layer_order = sorted(self.layer_keys | words)  # what the layers' matrices depend on
        led_keys = {k for k in scene.parameters if k.rsplit(".", 1)[0] in scene.lights} - self.layer_keys
        own = [k for k in scene.parameters if k not in image_keys and k not in led_keys and k not in self.layer_keys]
        self.bounce_key = f"{scene.integrator.name}.interreflection"
        self.geometry_keys = [k for k in own if self.kind(k) in ("camera", "interface", "", *scene.MOVED) or
                              (self.kind(k) == "gel" and k.rsplit(".", 1)[1] in scene.shaping)]
        ambient = {n for e in registry().at_stage("membrane", "ambient") for n in e.parameter_names}
        self.ambient_keys = [k for k in own if self.kind(k) == "membrane" and k.rsplit(".", 1)[1] in ambient]
        self.shading_keys = [k for k in own if k not in self.geometry_keys and k != self.bounce_key
                             and k not in self.ambient_keys]
        self.led_keys = {n: [k for k in led_keys if k.rsplit(".", 1)[0] == n and k.rsplit(".", 1)[1] not in POWERS]
                         for n in scene.lights}
        self._fixed = {k for k in self.geometry_keys if self.kind(k)}  # of stock plugins, some shade and none is slow to set
        self._still = {k: scene.parameters[k].neutral for k in self.ambient_keys}
        self._tangents: OrderedDict = OrderedDict()
        self.together: set[str] = set()  # LEDs whose images are wanted of the same geometry

    def kind(self, key: str) -> str:
        part = self.scene.parts.get(key.rsplit(".", 1)[0])
        return part.kind if part is not None else ""

    # -- geometry -----------------------------------------------------------------------------------------------------

    def geometry(self, values: Mapping) -> tuple:
        return tuple(values[k] for k in self.geometry_keys)

    def _apply(self, values: Mapping, move: bool = True) -> None:
        """Set everything but the LEDs' powers, which stay at 1: images are kept per unit of power.

        move = False leaves the geometry where it is (rebuilding the gel costs more than an image): enough for shading at
        hits that are kept, but not for tracing or for shadows.
        """
        now = {k: v for k, v in values.items() if k in self.scene.parameters and k not in self.layer_keys
               and not isinstance(v, np.ndarray) and (move or k not in self._fixed)}
        now.update({f"{n}.{power}": 1.0 for n in self.scene.lights for power in POWERS})
        self.scene.set(now)

    def _trace(self, u: np.ndarray, v: np.ndarray) -> tuple:
        import drjit as dr
        import mitsuba as mi

        with dr.suspend_grad():
            if self.layered:
                path = paths.trace(self.scene, u, v)
                return Sample(path.si, mi.UnpolarizedSpectrum(1.0), path.origin, path)
            si, weight, origin = self.scene.integrator.hits(
                self.scene.mitsuba, self.scene.camera, mi.Float(u.astype(np.float32)), mi.Float(v.astype(np.float32)))
            dr.eval(si, weight, origin)
        return Sample(si, weight, origin)

    def hits(self, values: Mapping) -> "Hits":
        """Primary hits at pixel centres for a geometry; kept."""
        key = self.geometry(values)
        if key in self._hits:
            self._hits.move_to_end(key)
            return self._hits[key]
        self._apply(values)
        v, u = np.mgrid[:self.height, :self.width] + 0.5
        hits = Hits(self._trace(u.ravel(), v.ravel()), self.height, self.width)
        hits.edges |= self._painted(hits)
        self._hits[key] = hits
        while len(self._hits) > self.remember:
            self._hits.popitem(last=False)
        return hits

    def _painted(self, hits: "Hits") -> np.ndarray:
        """Pixels in whose neighbourhood the texture of a membrane's reflectance has an edge."""
        import drjit as dr
        import mitsuba as mi

        edges = np.zeros(hits.shape, bool)
        for m in self.scene.membranes.values():
            if not m.reflectance.is_spatially_varying():
                continue
            own = hits.si.is_valid() & (hits.si.bsdf() == mi.BSDFPtr(m))
            paint = dr.select(own, m.reflectance.eval(hits.si, own), 0.0)[0]
            own, paint = np.array(own).reshape(hits.shape), np.broadcast_to(np.array(paint), hits.valid.size).reshape(hits.shape)
            if own.any():
                low, high = _around(np.where(own, paint, paint[own].mean()))
                edges |= high - low > PAINTED * paint[own].max()
        return edges

    # -- one LED ------------------------------------------------------------------------------------------------------

    def _led_key(self, values: Mapping, led: str) -> tuple:
        return (led, self.geometry(values), tuple(values[k] for k in self.shading_keys),
                tuple(values[k] for k in self.led_keys[led]))

    def led(self, values: Mapping, led: str) -> "LedImage":
        """The image that one LED makes at power 1 by direct light, kept with what its derivatives need."""
        key = self._led_key(values, led)
        if key in self._images:
            self._images.move_to_end(key)
            return self._images[key]
        hits = self.hits(values)
        self._apply(values)
        image = self._keep(key, self._render_led(hits, led))
        for other in self.together - {led}:  # moving the geometry costs more than an image: make what will be asked for next
            key = self._led_key(values, other)
            if key not in self._images:
                self._keep(key, self._render_led(hits, other))
        return image

    def _keep(self, key: tuple, image: "LedImage") -> "LedImage":
        self._images[key] = image
        while len(self._images) > self.remember * len(self.scene.lights):
            self._images.popitem(last=False)
        return image

    def _render_led(self, hits: "Hits", led: str) -> "LedImage":
        if led in self.scene.sources:  # what it sends lies in the weights
            rim = self._joint_rim(hits)
            index = np.flatnonzero(rim)
            image = LedImage(led, hits, rim, index, self._rim_samples(hits, index), None, None, hits.valid)
            image.raw = (np.ones((1, self.bands)), np.ones((1, 1, self.bands)))
            return image
        part = self.scene.leds[led]
        visible = self._visible(hits.si, part)
        rim = self._joint_rim(hits) if self.layered else self._rim(hits, visible)
        share = np.where(rim, 1.0, hits.bent)
        index = np.flatnonzero(share)
        samples = self._rim_samples(hits, index)
        rim_visible = self._visible(samples.si, part) if len(index) else None
        image = LedImage(led, hits, rim, index, samples, visible, rim_visible, self._seen(visible).mean(0) > 0.5)
        image.share = share.reshape(-1, 1)[index]
        image.raw = self._raw(image, lambda: self._shade(hits.sample, part, visible),
                              lambda: self._shade(samples, part, rim_visible))
        if not self.layered:
            image.radiance = self._mix(image, image.raw)
        return image

    def _seen(self, visible) -> np.ndarray:
        """(points of the source, H, W)"""
        return np.array(visible).reshape(-1, self.height, self.width)

    def _rim(self, hits: "Hits", visible) -> np.ndarray:
        return np.logical_or.reduce([_edges(s & hits.valid) for s in self._seen(visible)]) | hits.edges

    def _joint_rim(self, hits: "Hits") -> np.ndarray:
        """Pixels at a rim for any light: in scenes with layers one set of finer samples serves all."""
        if hits.joint is None:
            rims = [self._rim(hits, self._visible(hits.si, part)) for part in self.scene.leds.values()]
            hits.joint = np.logical_or.reduce([hits.edges, *rims])
        return hits.joint

    # -- what layers leave of it ----------------------------------------------------------------------------------------

    def image(self, values: Mapping, light: str, component: int = 0) -> np.ndarray:
        """(H, W, B) what one light makes at power 1, layers and all; (N, 1, B) where `values` hold arrays of readings.

        component  of the Stokes vector in the camera's axes
        """
        image = self.led(values, light)
        if not self.layered:
            return image.radiance if component == 0 else np.zeros_like(image.radiance)
        seen = [None if r is None or w is None else r * w for r, w in zip(image.raw, self.weights(values, image, component))]
        for add in self._glows(values, image, component):
            seen = [s if s is None else s + a for s, a in zip(seen, add)]
        return self._mix(image, seen)

    def _glows(self, values: Mapping, image: "LedImage", component: int) -> Iterator[tuple]:
        """What boundaries send to the camera by themselves while one light is on (stage `glow`): at centres, at finer samples."""
        effects = registry().at_stage("interface", "glow")
        names = [n for n, p in self.scene.parts.items() if p.kind == "interface"] if image.led in self.scene.leds else []
        for name in names:
            own = paths.part_values(self.scene, name, values, {})
            functions = [e.stages["glow"] for e in effects
                         if any(getattr(own, n) != self.scene.parts[name].numbers[n].neutral for n in e.parameter_names)]
            if not functions:
                continue
            shines = [i for i, s in enumerate(self.scene.mitsuba.shapes()) if getattr(s.bsdf(), "kind", "") == "fluorescent"]
            marked = np.isin(image.hits.path.shape, shines)
            glow = SimpleNamespace(markers=image.raw[0][marked].mean(0, dtype=float) if marked.any() else np.zeros(self.bands),
                                   wavelengths=self.wavelengths)
            light = sum(function(glow, own) for function in functions)
            yield tuple(None if path is None else light * paths.transmission(
                self.scene, path, values, self.wavelengths, component, name)[0].reshape(shape) for path, shape in (
                (image.hits.path, (-1, self.bands)),
                (image.samples.path if len(image.index) else None, (len(image.index), self.rim_samples, self.bands))))

    def weights(self, values: Mapping, image: "LedImage", component: int = 0) -> tuple:
        """What the layers leave of a light: (H W, B) at the pixels' centres, (n, S, B) at the finer samples of rims."""
        centre = self._weight(values, image.led, image.hits.path, component, ())
        fine = None
        if len(image.index):
            fine = self._weight(values, image.led, image.samples.path, component, (image.index.tobytes(),))
            fine = fine.reshape(len(image.index), self.rim_samples, self.bands)
        return centre, fine

    def _weight(self, values: Mapping, light: str, path, component: int, where: tuple) -> np.ndarray:
        key = (self.geometry(values), component, *where, *(v.tobytes() if isinstance(v, np.ndarray) else v for v in (
            values[k] for k in self.layer_order)))
        if key not in self._transmissions:
            if all(path is not other for other in self._recent):  # matrices are large: those of the last two paths are kept
                self._recent.append(path)
                if len(self._recent) > 4:
                    self._recent.pop(0).matrices.clear()
            self._transmissions[key] = paths.transmission(self.scene, path, values, self.wavelengths, component)
            while len(self._transmissions) > 2 * self.remember:
                self._transmissions.popitem(last=False)
        row = self._transmissions[key]
        if light not in self.scene.sources:
            return row[0]
        sent = paths.emitted(self.scene, light, path, values, self.wavelengths)
        return sum(r * s for r, s in zip(row, sent) if not isinstance(s, int))

    # -- all lights ---------------------------------------------------------------------------------------------------

    def lit(self, values: Mapping) -> list[str]:
        """The lights that are on."""
        return [n for n in self.scene.lights if np.any(values[f"{n}.power"] != 0)]

    def light(self, values: Mapping, light: str, seed: int = 0, component: int = 0) -> np.ndarray:
        """(H, W, B) what one light makes at its power, by one reflection and by two."""
        image = self.image(values, light, component)
        if values[self.bounce_key]:
            image = image + values[self.bounce_key] * self.bounced(values, light, seed, component)
        return self.powers(values, light) * image

    def radiance(self, values: Mapping, seed: int = 0, component: int = 0) -> np.ndarray:
        """(H, W, B): linear image; complex where `values` hold a complex step of a layer's parameter."""
        lights = (self.light(values, n, seed, component) for n in self.lit(values))
        return sum(lights, self.ambient(values, component))

    def stokes(self, values: Mapping, seed: int = 0) -> np.ndarray:
        """(4, H, W, B): Stokes vectors at the camera; (4, N, 1, B) where `values` hold arrays of readings."""
        return np.stack([self.radiance(values, seed, component) for component in range(4)])

    def _rim_samples(self, hits: "Hits", index: np.ndarray):
        key = index.tobytes()
        if key not in hits.rims:
            # A Hammersley set, shifted from pixel to pixel: an edge in any direction crosses the samples one by one, and
            # not in rows, so that a shadow that moves changes a pixel in small steps.
            count = self.rim_samples
            k = np.arange(count)
            reversed_bits = sum(((k >> b) & 1) / 2 ** (b + 1) for b in range(count.bit_length() - 1))
            shift = np.outer(index, (0.7548776662466927, 0.5698402909980532))  # the R2 sequence
            u = (index % self.width)[:, None] + (k / count + shift[:, :1]) % 1.0
            v = (index // self.width)[:, None] + (reversed_bits + shift[:, 1:]) % 1.0
            hits.rims = {key: self._trace(u.ravel(), v.ravel()) if len(index) else None}  # only the latest is kept
        return hits.rims[key]

    def _discs(self, part) -> list:
        """Sample positions on the emitting disc, as points of the unit square; [None] for a point source.

        Four points stand for the inner quarter of the disc's area and twelve for the ring around it, each on the circle
        that has its part's mean square radius, 1/8 and 5/8: the width of a penumbra is that of the whole disc.
        """
        if part.number("area") == 0:
            return [None]
        at = [0.5 + sign * (mean_square**0.5) / 2 for sign, mean_square in ((-1, 5 / 8), (-1, 1 / 8), (1, 1 / 8), (1, 5 / 8))]
        return [(a, b) for a in at for b in at]

    def _visible(self, si, part):
        """Share of the LED that each hit sees; a Float (a mask for a point source)."""
        import drjit as dr
        import mitsuba as mi

        integrator = self.scene.integrator
        share = []
        for place in self._discs(part):
            point = part.position() if place is None else part.point(mi.Point2f(*place))
            share.append(integrator.visible(self.scene.mitsuba, si, dr.detach(point), part))
        dr.eval(share)
        return share[0] if len(share) == 1 else share

    def _shade(self, sample: Sample, part, visible):
        """Direct radiance per band at hits, an UnpolarizedSpectrum attached to whatever carries gradients."""
        import mitsuba as mi

        integrator, scene = self.scene.integrator, self.scene.mitsuba
        places = self._discs(part)
        if len(places) == 1:
            return integrator.direct(scene, *sample[:3], part, visible)
        parts = [integrator.direct(scene, *sample[:3], part, seen, mi.Point2f(*place)) for place, seen in zip(places, visible)]
        return sum(parts[1:], parts[0]) / len(parts)

    def _raw(self, image: "LedImage", centre: Callable, rim: Callable) -> tuple:
        """Shading at pixel centres (H W, B) and at the finer samples of rims (n, S, B), None without rims."""
        fine = self._bands(rim()).reshape(len(image.index), self.rim_samples, self.bands) if len(image.index) else None
        return self._bands(centre()).reshape(self.height * self.width, self.bands), fine

    def _mix(self, image: "LedImage", raw: tuple, weights: tuple = (1.0, 1.0)) -> np.ndarray:
        """(H, W, B) from pixel centres and, where the rim is, from the mean of the finer samples, by its share."""
        result = raw[0] * weights[0] if self.layered else raw[0].copy()
        if len(image.index):
            result[image.index] += image.share * ((raw[1] * weights[1]).mean(1) - result[image.index])
        return result.reshape(-1, self.width, self.bands) if len(result) != self.height * self.width else result.reshape(
            self.height, self.width, self.bands)

    def _bands(self, spectrum) -> np.ndarray:
        import drjit as dr

        dr.eval(spectrum)  # lane by lane: one array of all lanes would carry its size into the kernel
        return np.stack([np.array(spectrum[i]) for i in range(self.bands)], -1)

    def powers(self, values: Mapping, led: str) -> np.ndarray:
        """(B,) power of an LED in each band, relative to its image."""
        shares = [values[f"{led}.{name}"] for name in POWERS[1:]] + [1.0] * self.bands
        return values[f"{led}.power"] * np.array(shares[:self.bands])

    def led_tangent_at_rest(self, values: Mapping, led: str, key: str) -> np.ndarray:
        """`led_tangent`, kept: all frames share the gel at rest."""
        known = (key, *self._led_key(values, led), *(values[k] for k in self.layer_order))
        if known not in self._tangents:
            self._tangents[known] = self.led_tangent(values, led, key).astype(np.float32)
            while len(self._tangents) > 8 * len(self.scene.lights):
                self._tangents.popitem(last=False)
        return self._tangents[known]

    def led_tangent(self, values: Mapping, led: str, key: str) -> np.ndarray:
        """d radiance / d parameter of one LED's image, forward mode; rims by central differences where the LED moves."""
        import drjit as dr
        import mitsuba as mi

        image = self.led(values, led)
        name, parameter = key.rsplit(".", 1)
        part, lamp = self.scene.parts[name], self.scene.leds[led]
        moves = part is lamp and parameter in ("x", "y", "z")
        self._apply(values, move=moves and len(image.index) > 0)
        value = getattr(part, parameter)

        def tangent(sample, visible):
            attached = mi.Float(dr.detach(value))
            dr.enable_grad(attached)
            setattr(part, parameter, attached)
            try:
                shaded = self._shade(sample, lamp, visible)
                dr.set_grad(attached, 1.0)
                return dr.forward_to(shaded, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
            finally:
                setattr(part, parameter, value)

        def moved_rim():
            step = part.numbers[parameter].step * part.numbers[parameter].plausible
            sides = []
            for sign in (1, -1):
                setattr(part, parameter, dr.opaque(mi.Float, float(value[0]) + sign * step))
                try:
                    sides.append(self._shade(image.samples, lamp, self._visible(image.samples.si, lamp)))
                finally:
                    setattr(part, parameter, value)
            return (sides[0] - sides[1]) / (2 * step)

        raw = self._raw(image, lambda: tangent(image.hits.sample, image.visible),
                        moved_rim if moves else lambda: tangent(image.samples, image.rim_visible))
        return self._mix(image, raw, self.weights(values, image) if self.layered else (1.0, 1.0))

    def bounced(self, values: Mapping, led: str, seed: int = 0, component: int = 0) -> np.ndarray:
        """(H, W, B): light of one LED at power 1 after two reflections, unpolarized before any layers, as a component of the
        Stokes vector; Monte Carlo over the second direction.

        Light from all around varies slowly: it is gathered for every second pixel each way, over the area of the four,
        and interpolated linearly in between. The samples are the same for every geometry and LED of a seed.
        """
        import mitsuba as mi
        from scipy.ndimage import zoom

        if led in self.scene.sources:  # it lights nothing
            return np.zeros((1, 1, self.bands))
        key = ("bounced", seed, *self._led_key(values, led))
        if key in self._images:
            self._images.move_to_end(key)
            return self._bounced(values, led, self._images[key], component)
        self._apply(values)
        rows, columns = -(-self.height // BOUNCE_CELL), -(-self.width // BOUNCE_CELL)
        v, u = np.mgrid[:rows, :columns]
        rng = np.random.default_rng([seed, 77])
        count = u.size * BOUNCE_SAMPLES
        at = [np.repeat(a.ravel(), BOUNCE_SAMPLES) + rng.random(count) for a in (u, v)]
        sample = self._trace(*(np.minimum(a * BOUNCE_CELL, size - 1e-3) for a, size in zip(at, (self.width, self.height))))
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(int(rng.integers(2**31)), count)
        light = self.scene.integrator.bounced(self.scene.mitsuba, *sample[:3], self.scene.leds[led], 1, sampler)
        coarse = self._bands(light).reshape(rows, columns, BOUNCE_SAMPLES, self.bands).mean(2)
        image = zoom(coarse, (BOUNCE_CELL, BOUNCE_CELL, 1), order=1, mode="nearest", grid_mode=True)
        self._images[key] = image[:self.height, :self.width].astype(float)
        return self._bounced(values, led, self._images[key], component)

    def _bounced(self, values: Mapping, led: str, image: np.ndarray, component: int) -> np.ndarray:
        """A bounced image behind the layers."""
        if not self.layered:
            return image if component == 0 else np.zeros_like(image)
        weight = self._weight(values, led, self.hits(values).path, component, ())
        return image * weight.reshape(-1, self.width, self.bands)

    def glows(self, values: Mapping) -> bool:
        """Whether there is light that no LED made."""
        return any(values[k] != neutral for k, neutral in self._still.items())

    def ambient(self, values: Mapping, component: int = 0) -> np.ndarray:
        """(H, W, B): radiance of the membranes that no LED made."""
        if not self.glows(values) or component and not self.layered:
            return np.zeros((self.height, self.width, self.bands))
        if not self.layered:
            return np.broadcast_to(self._shone(values, self.hits(values).sample), (self.height * self.width, self.bands)).reshape(
                self.height, self.width, self.bands).astype(float)
        image = self.glow(values)
        return self._mix(image, image.raw, self.weights(values, image, component))

    def glow(self, values: Mapping) -> "LedImage":
        """The image of light that no LED made, in a scene with layers, before these."""
        hits = self.hits(values)
        rim = self._joint_rim(hits)
        index = np.flatnonzero(rim)
        image = LedImage("", hits, rim, index, self._rim_samples(hits, index), None, None, hits.valid)
        image.raw = (self._shone(values, hits.sample),
                     self._shone(values, image.samples).reshape(len(index), self.rim_samples, self.bands) if len(index) else None)
        return image

    def _shone(self, values: Mapping, sample: "Sample") -> np.ndarray:
        """(N, B): radiance of the membranes that no LED made, at the ends of camera rays."""
        self._apply(values, move=False)
        return sum(self._bands(self.scene.integrator.ambient(self.scene.mitsuba, sample.si, sample.weight, m) + 0 * sample.si.t)
                   for m in self.scene.membranes.values())


class Sample(NamedTuple):
    """Camera rays at their ends (Dr.Jit), and in a scene with layers the paths that they took."""

    si: object
    weight: object
    origin: object
    path: paths.Path | None = None


class Hits:
    """Primary hits of one geometry: si, weight, origin (Dr.Jit), and what they show as numpy images."""

    def __init__(self, sample: Sample, height: int, width: int):
        self.sample = sample
        self.si, self.weight, self.origin, self.path = sample
        self.shape = (height, width)
        self.rims: dict = {}
        self.joint: np.ndarray | None = None
        self.valid = np.array(self.si.is_valid()).reshape(height, width)
        self.edges = _edges(self.valid)
        if self.path is not None:  # what is passed, and what is met, changes at an edge
            for met in (self.path.shape, *(step.part for step in self.path.steps)):
                self.edges |= _edges(met.reshape(height, width))
            self.edges |= _creases(np.where(self.valid[..., None], self.normal, 0.0))
        self.bent = np.zeros((height, width)) if self.path is not None else _bent(np.where(self.valid[..., None], self.normal, 0.0))

    def image(self, values) -> np.ndarray:
        return np.array(values).reshape(self.shape)

    @property
    def position(self) -> np.ndarray:
        return np.array(self.si.p).T.reshape(*self.shape, 3)

    @property
    def normal(self) -> np.ndarray:
        return np.array(self.si.sh_frame.n).T.reshape(*self.shape, 3)


class LedImage:
    """One LED's image with the hits, rim pixels and shadows that it was made from."""

    def __init__(self, led, hits, rim, index, samples, visible, rim_visible, lit):
        self.led, self.hits, self.rim, self.index, self.samples = led, hits, rim, index, samples
        self.visible, self.rim_visible, self.lit = visible, rim_visible, lit
        self.share: np.ndarray | float = 1.0  # (n, 1) of the finer samples in each of those pixels
        self.raw: tuple | None = None  # what the light makes before layers: at centres, at finer samples
        self.radiance: np.ndarray | None = None  # the image, in scenes without layers


class Model:
    """A scene held against a capture set: predictions, derivative images, masks and coordinates, frame by frame.

    frames       of the captures; a raw mosaic stands in all three channels, and `usable` takes each pixel in its own
    base         scene values overlaid with what holds in every frame, by key
    parameters   key -> Parameter
    shape        (H, W, C)
    flat_field   how the measured background B of the untouched sensor enters: "multiplicative" (True), what the scene
                 does not know of the background is a gain; "additive", it is light that a press leaves as it is; None
    """

    def __init__(self, scene: Scene, captures: Captures, noise: Noise | None = None,
                 flat_field: bool | str | None = True):
        from optics.by_chance import renderer_of

        noise = noise or captures.noise
        if noise is None:
            raise BadScene(f"{captures.folder}: no noise model; give [noise] in captures.toml or repeats to estimate it from")
        if captures.table is not None:
            captures = sweeps(captures, scene.parameters, scene.lights)
        self.scene, self.captures, self.noise = scene, captures, noise
        self.mosaic, self.frames = None, captures.frames
        background = captures.flat_field
        if captures.cfa is not None:
            self.mosaic = cfa_channel(captures.frames[0].image.shape, captures.cfa)[..., None] == np.arange(3)
            self.frames = [replace(f, image=np.repeat(f.image, 3, axis=2)) for f in captures.frames]
            background = None if background is None else np.repeat(background, 3, axis=2)
        self.renderer = renderer_of(scene)
        self.by_chance = self.renderer.by_chance  # whether predictions are Monte Carlo estimates, whose error `variance` holds
        self._edges_kept: dict[int, np.ndarray] = {}
        self.parameters: dict[str, Parameter] = scene.parameters
        self.base = {**scene.values(), **scene.check(captures.parameters, f"{captures.folder}/captures.toml [parameters]")}
        for frame in self.frames:
            scene.check(frame.parameters, f"{frame.file or captures.folder}: frame {frame.name}")
        self.companions = self._companions()
        # A power that frames set is a drive level: what a calibration finds is the LED's power at drive 1.
        self.driven = {f"{n}.power" for n in scene.lights} & {k for f in self.frames for k in (*f.parameters, *f.readings)}
        self.base.update({k: 1.0 for k in self.driven})
        self.shape = self.frames[0].image.shape
        height, width = self.shape[:2] if captures.table is None else (1, 1)
        if (width, height) != scene.camera.resolution:
            raise BadScene(
                f"{captures.folder}: images of {width} x {height} px, but the scene's camera has "
                f"{scene.camera.resolution[0]} x {scene.camera.resolution[1]} px; load the scene with "
                f"-D width={width} -D height={height}")
        self.developer = Developer(scene.camera, scene.integrator.bands or (0.0,), noise.black_level, noise.saturation)
        if self.developer.matrix.shape[0] != self.shape[2]:
            channels, wanted, first = self.shape[2], self.developer.matrix.shape[0], captures.frames[0].file
            raise BadScene(f"{captures.folder / 'captures.toml'}: '{first}' has channels: {channels}, the camera of the scene '{captures.scene}' has "
                           f"{wanted}; allowed: {wanted}, " + (
                               "a column of `values` for each" if captures.table is not None else
                               "or one with cfa = \"RGGB\" (or its like) if it is a raw mosaic; or take a scene whose integrator names one band"
                               if channels == 1 else "one for each band of the scene's integrator"))
        if flat_field not in (True, False, None, *FLAT_FIELDS):
            raise UnknownKey(str(flat_field), FLAT_FIELDS, "flat-field mode")
        self.flat_field = {True: FLAT_FIELDS[0], False: None, "none": None}.get(flat_field, flat_field)
        self.flat = None  # the measured background above black, a declared nuisance; see `predict`
        if self.flat_field and background is not None and scene.gel is None:
            raise BadScene(f"{captures.folder}: the set has a background, and the scene no gel that could be at rest in it; allowed: "
                           "--flat-field none")
        if self.flat_field and background is not None:
            self.flat = np.maximum(np.asarray(background, float) - self.noise.black_level, 1e-3)

    def imagine(self, frames: Sequence) -> "Model":
        """The same model, with the same renderer, with further frames: what `optics.advise` could have somebody measure."""
        twin = copy.copy(self)
        twin.frames = [*self.frames, *frames]
        twin.driven = self.driven | ({f"{n}.power" for n in self.scene.lights} & {k for f in frames for k in (*f.parameters, *f.readings)})
        twin.base = {**self.base, **dict.fromkeys(twin.driven - self.driven, 1.0)}
        twin.companions, twin._edges_kept = twin._companions(), dict(self._edges_kept)
        return twin

    # -- values -------------------------------------------------------------------------------------------------------

    def at(self, values: Values, index: int) -> dict:
        """Every parameter's value in a frame: base <- fitted in all frames <- set in this frame <- fitted in this frame.

        The power of an LED that frames set is the product of the setting and of the fitted power.
        """
        now = {**self.base, **values.common}
        frame = self.frames[index]
        for key, value in (*frame.parameters.items(), *frame.readings.items()):
            now[key] = value * now[key] if key in self.driven else value
        now.update(values.frame.get(index, {}))
        return now

    def _acts(self, variable: Variable, index: int) -> dict[str, float]:
        """The keys through which a variable acts in a frame, each with d key / d variable."""
        own = {**self.frames[index].parameters, **self.frames[index].readings}
        if variable.frames is not None:
            return dict.fromkeys(variable.keys, 1.0)
        return {k: own[k] if k in own else 1.0 for k in variable.keys if k not in own or k in self.driven}

    def _companions(self) -> list[set[str]]:
        """For each frame the LEDs that are lit in any frame of the same press: they share its geometry."""
        presses: dict[tuple, set[str]] = {}
        keys = []
        for frame in self.frames:
            own = {**self.base, **frame.parameters, **frame.readings}
            key = (frame.group, *(own[k] for k in self.renderer.geometry_keys))
            presses.setdefault(key, set()).update(n for n in self.scene.lights if np.any(own[f"{n}.power"] != 0))
            keys.append(key)
        return [presses[key] for key in keys]

    def linear_in(self, variable: Variable) -> bool:
        """Whether predictions are linear in a variable together with all others of which this holds: the LEDs' powers."""
        return all(self._is_power(k) for k in variable.keys)

    def _is_power(self, key: str) -> bool:
        name, _, parameter = key.rpartition(".")
        return name in self.scene.lights and parameter in POWERS

    def check_variables(self, variables: Sequence[Variable]) -> None:
        for variable in variables:
            for key in variable.keys:
                if key not in self.parameters:
                    raise UnknownKey(key, self.parameters, "parameter", hint="`optics params SCENE` lists them")

    def lit(self, now: Mapping) -> dict[str, np.ndarray]:
        """The lights that are on and their powers per band (B,), or (N, 1, B) of readings."""
        return {n: self.renderer.powers(now, n) for n in self.renderer.lit(now)}

    # -- prediction ---------------------------------------------------------------------------------------------------

    def radiance(self, now: Mapping, seed: int = 0) -> np.ndarray:
        """(H, W, B): linear image of a frame."""
        return self.renderer.radiance(now, seed)

    def untouched(self, now: Mapping) -> dict:
        """The same frame with the gel at rest."""
        gel = self.scene.gel.name
        return {**now, **dict.fromkeys((f"{gel}.press_x", f"{gel}.press_y", f"{gel}.press_depth"), 0.0)}

    def _rests(self, key: str) -> bool:
        """Whether a parameter does nothing while the gel is untouched."""
        name, _, parameter = key.rpartition(".")
        return self.renderer.kind(key) == "gel" and parameter in self.scene.gel.pressing

    def predict(self, values: Values, frames: Sequence[int] | None = None, seed: int = 0) -> list[np.ndarray]:
        """Noise-free DN (H, W, C) of each frame.

        With a flat field B (the measured background of the untouched sensor), P0 the prediction for the gel at rest in the
        same frame, and the frame's gain g per channel:
            multiplicative   black + g (B - black) (P - black)/(P0 - black)
            additive         black + g (B - black) + P - P0             (light adds up: exact for a linear response)
        """
        return [self._predict(self._turn_to(values, i), seed) for i in self._indices(frames)]

    def _turn_to(self, values: Values, index: int) -> dict:
        """A frame's values, and word to the renderer of what else is wanted of its geometry."""
        self.renderer.together = self.companions[index]
        return self.at(values, index)

    def _develop(self, now: Mapping, seed: int) -> np.ndarray:
        return self.developer.develop(self.radiance(now, seed), now)

    def _predict(self, now: Mapping, seed: int = 0) -> np.ndarray:
        image = self._develop(now, seed)
        if self.flat is None:
            return image
        black = self.noise.black_level
        flat = self.flat * self._gains(now)
        rest = self._develop(self.untouched(now), seed)
        if self.flat_field == "additive":
            return black + flat + image - rest
        return black + (image - black) * flat / np.maximum(rest - black, 1e-6)

    def _gains(self, now: Mapping) -> np.ndarray:
        """(C,) gain of a frame by which its background is scaled."""
        return self.developer.gains(self.developer.view(now))

    def background_share(self, values: Values | None = None, index: int = 0) -> list[dict[str, float]]:
        """How much of the flat field the scene explains by itself, per channel: rms of the flat field's structure about
        its mean, rms of what is left of it after the predicted background, both in DN, and the share 1 - (left/structure)^2.

        A multiplicative flat field divides what is left out, an additive one adds it; either way it is not explained.
        """
        if self.flat is None:
            raise BadScene(f"{self.captures.folder}: no flat field in use")
        rest = self._develop(self.untouched(self.at(values or Values(), index)), 0) - self.noise.black_level
        found = []
        for c in range(self.shape[2]):
            structure, left = np.std(self.flat[..., c]), np.sqrt(np.mean((self.flat - rest)[..., c] ** 2))
            found.append({"structure": float(structure), "left": float(left), "share": float(1 - (left / structure) ** 2)})
        return found

    def _indices(self, frames) -> list[int]:
        return list(range(len(self.frames))) if frames is None else list(frames)

    def derivatives(self, values: Values, variables: Sequence[Variable], frames: Sequence[int] | None = None,
                    secant: Mapping[str, float] | None = None, seed: int = 0,
                    ) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
        """Per frame: prediction (H, W, C) in DN and {variable's name: d prediction / d value}, float32.

        `secant` gives, by name, a finite step to take from the present value in place of the tangent. Variables that do
        nothing in a frame are left out of its dictionary.
        """
        self.check_variables(variables)
        for index in self._indices(frames):
            yield self._differentiate(values, [v for v in variables if v.holds_in(index)], secant or {}, seed, index)

    def _differentiate(self, values: Values, variables: Sequence[Variable], secant: Mapping[str, float], seed: int,
                       index: int):
        now = self._turn_to(values, index)
        black = self.noise.black_level
        linear = self.developer.linearise(self.radiance(now, seed), now)
        prediction = linear.image
        if self.flat is not None:
            at_rest = self.untouched(now)
            rest = self.developer.linearise(self.radiance(at_rest, seed), at_rest)
            flat = self.flat * self._gains(now)
            if self.flat_field == "additive":
                prediction, scale, share, gained = black + flat + linear.image - rest.image, 1.0, 1.0, 1.0
            else:
                level = np.maximum(rest.image - black, 1e-6)
                scale, share = flat / level, (linear.image - black) / level
                prediction, gained = black + (linear.image - black) * scale, share
        images = {}
        for variable in variables:
            acts = self._acts(variable, index)
            if not acts:
                continue
            if variable.name in secant:
                image = self._secant(values, variable, index, secant[variable.name], prediction, seed)
            else:
                image = self._tangent(linear, now, acts, seed)
                if self.flat is not None:
                    still = self._tangent(rest, at_rest, {k: f for k, f in acts.items() if not self._rests(k)}, seed, True)
                    if image is not None or still is not None:
                        image = scale * ((0 if image is None else image) - share * (0 if still is None else still))
                        if any(self.parameters[k].how == "image" for k in acts):
                            stepped = {**now, **{k: now[k] + 1j * STEP for k in acts}}
                            image = image + gained * self.flat * (self._gains(stepped).imag / STEP)
            if image is not None:
                images[variable.name] = image.astype(np.float32)
        return prediction, images

    def _secant(self, values: Values, variable: Variable, index: int, step: float, prediction, seed: int) -> np.ndarray:
        """[f(value + step) - f(value)] / step of the whole prediction; the step turns round at a bound."""
        value = values.get(variable, self.base)
        if not variable.parameter.bounds[0] <= value + step <= variable.parameter.bounds[1]:
            step = -step
        moved = values.copy()
        moved.put(variable, value + step)
        return (self._predict(self.at(moved, index), seed) - prediction) / step

    def _tangent(self, linear, now: Mapping, acts: Mapping[str, float], seed: int,
                 at_rest: bool = False) -> np.ndarray | None:
        """d DN / d value in a frame for keys that share one value; None where nothing depends on them."""
        camera = tuple(k for k in acts if self.parameters[k].how == "image")
        light = None
        for key, factor in acts.items():
            if key in camera:
                continue
            change = self._light_tangent(now, key, factor, seed, at_rest)
            if change is not None:
                light = change if light is None else light + change
        total = None if light is None else linear.of_image(light)
        if camera:
            total = linear.of_parameter(camera) + (0 if total is None else total)
        return total

    def _light_tangent(self, now: Mapping, key: str, factor: float, seed: int, at_rest: bool) -> np.ndarray | None:
        """factor times d radiance / d key in a frame."""
        name, parameter = key.rsplit(".", 1)
        kind = self.renderer.kind(key)
        lit = self.lit(now)
        tangent = self.renderer.led_tangent_at_rest if at_rest else self.renderer.led_tangent
        glows = self.renderer.glows(now)
        if not lit and not glows and key not in self.renderer.ambient_keys and self.parameters[key].how != "difference":
            return None  # a dark frame
        if self.parameters[key].how == "layer":
            return factor * (np.imag(self.radiance({**now, key: now[key] + 1j * STEP}, seed)) / STEP)
        if key == self.renderer.bounce_key:
            return factor * sum(power * self.renderer.bounced(now, led, seed) for led, power in lit.items()) if lit else None
        if self._is_power(key):
            if np.all(factor == 0):
                return None
            # the power is a product of four: the derivative by one of them is the product of the others
            others = self.renderer.powers({**now, key: 1.0}, name)
            if parameter != "power":
                others = np.where(np.arange(self.renderer.bands) == POWERS.index(parameter) - 1, others, 0.0)
            factor = factor * others
            if not np.any(factor):
                return None
            return factor * self.renderer.light({**now, **{f"{name}.{p}": 1.0 for p in POWERS}}, name, seed)
        if kind == "led" and name not in lit:
            return None
        if self.renderer.by_chance:
            return factor * self.renderer.tangent(now, key, seed)
        if key in self.renderer.ambient_keys:
            return factor * self._difference_ambient(now, key)
        if self.parameters[key].how == "difference" and kind != "led":
            return factor * self._difference(now, key, seed)
        if kind == "led":
            image = (self._difference_led(now, name, key) if self.parameters[key].how == "difference"
                     else tangent(now, name, key))
            return factor * lit[name] * image
        total = sum((power * tangent(now, led, key) for led, power in lit.items()), 0.0)
        if glows:
            total = total + self._difference_ambient(now, key)
        return factor * total

    def _difference(self, now: Mapping, key: str, seed: int) -> np.ndarray:
        """Central difference of the linear image, one-sided at a bound; common samples."""
        low, high = self.parameters[key].sides(now[key])
        return (self.radiance({**now, key: high}, seed) - self.radiance({**now, key: low}, seed)) / (high - low)

    def _difference_led(self, now: Mapping, led: str, key: str) -> np.ndarray:
        low, high = self.parameters[key].sides(now[key])
        return (self.renderer.image({**now, key: high}, led) - self.renderer.image({**now, key: low}, led)) / (high - low)

    def _difference_ambient(self, now: Mapping, key: str) -> np.ndarray:
        low, high = self.parameters[key].sides(now[key])
        return (self.renderer.ambient({**now, key: high}) - self.renderer.ambient({**now, key: low})) / (high - low)

    # -- what a fit and a diagnosis need of the data --------------------------------------------------------------------

    def usable(self, index: int) -> np.ndarray:
        """(H, W, C) pixels to use: not saturated, not clipped at black, not masked by the user, of a mosaic's own channel."""
        frame = self.frames[index]
        mask = self.noise.usable(frame.image)
        mask = np.broadcast_to(mask if mask.ndim == 3 else mask[..., None], frame.image.shape).copy()
        if frame.mask is not None:
            mask &= np.asarray(frame.mask, bool)[..., None]
        if self.mosaic is not None:
            mask &= self.mosaic
        if self.renderer.layered and self.captures.table is None:
            mask &= self._resolved(index)
        return mask

    def _resolved(self, index: int) -> np.ndarray:
        """(H, W, C) False at sharp edges that the finer samples resolve worse than the noise: where the step across a pixel,
        over the number of samples, is more than a sixth of the noise. At the base's values, so that a fit cannot move it."""
        if index not in self._edges_kept:
            now = self.at(Values(), index)
            low = high = 0.0
            images = [(self.renderer.led(now, light), power) for light, power in self.lit(now).items()]
            for image, power in images + [(self.renderer.glow(now), 1.0)] * self.renderer.glows(now):
                if not len(image.index):
                    continue
                fine = image.raw[1] * self.renderer.weights(now, image)[1]
                low, high = low + power * fine.min(1), high + power * fine.max(1)
            known = np.ones(self.shape, bool)
            if np.ndim(high):
                view = self.developer.view(now)
                full = self.noise.saturation - self.noise.black_level
                step = ((high - low) @ self.developer.matrix.T) * np.abs(view.exposure * self.developer.gains(view)) * full
                level = self.predict(Values(), [index])[0].reshape(-1, self.shape[2])[image.index]
                known.reshape(-1, self.shape[2])[image.index] = step / self.renderer.rim_samples < self.noise.sd(level) / 6
            self._edges_kept[index] = known
        return self._edges_kept[index]

    @property
    def size(self) -> float:
        """Values that a frame holds (on average, of readings): pixels x channels, or the pixels of a mosaic."""
        return float(np.mean([f.image.size for f in self.frames])) / (3 if self.mosaic is not None else 1)

    def variance(self, values: Values, index: int, prediction: np.ndarray) -> np.ndarray:
        """(H, W, C) in DN^2, of a frame about its prediction: the camera's noise, and the prediction's own error where pictures are
        Monte Carlo estimates, averaged over 3 x 3 pixels (the error itself is known to a quarter)."""
        noise = self.noise.variance(prediction)
        return noise + self._error(values, index) if self.by_chance else noise

    def _error(self, values: Values, index: int) -> np.ndarray:
        """(H, W, C) variance of a Monte Carlo prediction, DN^2."""
        from scipy.ndimage import uniform_filter

        now = self.at(values, index)
        view = self.developer.view(now)
        full = (self.noise.saturation - self.noise.black_level) * np.abs(view.exposure * self.developer.gains(view))
        return uniform_filter((self.renderer.error(now) ** 2 @ (self.developer.matrix**2).T) * full**2, (3, 3, 0), mode="nearest")

    def chance(self, index: int = 0) -> float:
        """Error of the prediction itself over the camera's noise in a frame, rms; 0 where pictures are exact."""
        if not self.by_chance:
            return 0.0
        prediction = self.predict(Values(), [index])[0]
        return float(np.sqrt(np.mean(self._error(Values(), index) / self.noise.variance(prediction))))

    def coordinates(self, values: Values, index: int, seed: int = 0) -> dict[str, np.ndarray]:
        """What is known of every pixel of a frame; see `optics.compare` and `optics.diagnose` for their use."""
        from scipy.ndimage import distance_transform_edt

        now = self.at(values, index)
        hits = self.renderer.hits(now)
        view = self.developer.view(now)
        p, n = hits.position, hits.normal
        lit = self.lit(now)
        height, width = self.shape[:2]
        shadow = np.zeros((height, width), bool)
        rim = hits.edges.copy()
        incidence, distance, best = np.full((height, width), np.nan), np.full((height, width), np.nan), np.zeros((height, width))
        for led in lit:
            if led in self.scene.sources:
                continue
            image = self.renderer.led(now, led)
            shadow |= ~image.lit & hits.valid
            rim |= image.rim
            to = np.array([now[f"{led}.{a}"] for a in "xyz"]) - p
            length = np.linalg.norm(to, axis=-1)
            cos = np.clip((to * n).sum(-1) / np.maximum(length, 1e-9), -1, 1)
            strength = (lit[led] * self.renderer.image(now, led)).sum(-1)
            brightest = strength > best
            best = np.where(brightest, strength, best)
            incidence = np.where(brightest, np.degrees(np.arccos(cos)), incidence)
            distance = np.where(brightest, length, distance)
        origin = np.array(hits.origin).T.reshape(p.shape) if np.array(hits.origin).size == p.size else np.array(hits.origin)
        to_camera = origin - p
        emission = np.degrees(np.arccos(np.clip((to_camera * n).sum(-1) / np.maximum(
            np.linalg.norm(to_camera, axis=-1), 1e-9), -1, 1)))
        known = {
            "radius": view.tan * view.focal, "row": view.v, "column": view.u, "emission": emission,
            "incidence": incidence, "led_distance": distance, "intensity": self.radiance(now, seed).mean(-1),
            "shadow": shadow, "rim": rim & hits.valid,
            "frame": np.full((height, width), float(index)),
        }
        if self.scene.gel is not None:
            gel = self.scene.gel
            self.renderer._apply(now)
            x, y = np.where(hits.valid, p[..., 0], 0), np.where(hits.valid, p[..., 1], 0)
            touch = gel.contact_weight(x.ravel(), y.ravel()).reshape(height, width) > 0.5
            slope = np.degrees(np.arccos(np.clip(-n[..., 2], -1, 1)))
            known.update({
                "height": np.where(hits.valid, -p[..., 2], 0), "slope": slope, "contact": touch & hits.valid,
                "curvature": np.gradient(n[..., 0], axis=1) + np.gradient(n[..., 1], axis=0),
                "contact_distance": distance_transform_edt(~touch) if touch.any() else np.full((height, width), np.nan),
                "gel_path": np.array(gel.number("thickness") + p[..., 2]) / np.maximum(np.cos(np.radians(emission)), 1e-3),
            })
        known["far"] = ~(known.get("contact", shadow) | known["rim"] | shadow) & hits.valid
        if self.captures.table is None:
            return known
        frame = self.frames[index]
        count = frame.image.shape[0]  # of one place: only what is set, and when it was read, tells readings apart
        return {"intensity": np.broadcast_to(known["intensity"], (count, 1)), "far": np.ones((count, 1), bool), "reading": frame.rows[..., 0],
                "frame": np.full((count, 1), float(index)), **{k: v[..., 0] for k, v in frame.readings.items()}}


def _creases(normal: np.ndarray) -> np.ndarray:
    """Pixels on either side of a sharp edge of a body: normals (H, W, 3) that turn by more than CREASE from one to the next."""
    found = np.zeros(normal.shape[:2], bool)
    for axis in (0, 1):
        near, far = (np.take(normal, range(k, normal.shape[axis] - 1 + k), axis) for k in (0, 1))
        turned = (near * far).sum(-1) < np.cos(np.radians(CREASE)) * np.linalg.norm(near, axis=-1) * np.linalg.norm(far, axis=-1)
        first, second = ((slice(None),) * axis + (slice(k, normal.shape[axis] - 1 + k),) for k in (0, 1))
        found[first] |= turned
        found[second] |= turned
    return found


def _bent(normal: np.ndarray) -> np.ndarray:
    """(H, W) share, 0 to 1, by which finer samples stand for a pixel and not its middle.

    The mean over a pixel of what varies is its middle and a twenty-fourth of its second differences. Where these are, for the normals
    (H, W, 3), above 24 BENT, the share is 1, and it fades to 0 at half of that: a picture has no steps when a dent moves.
    """
    found = np.zeros(normal.shape[:2])
    for axis in (0, 1):
        if normal.shape[axis] < 3:
            continue
        inner = (slice(None),) * axis + (slice(1, -1),)
        found[inner] = np.maximum(found[inner], np.linalg.norm(np.diff(normal, 2, axis=axis), axis=-1) / 24)
    return np.clip(2 * found / BENT - 1, 0.0, 1.0)


def _edges(mask: np.ndarray) -> np.ndarray:
    """Pixels whose neighbourhood (3 x 3) is not all of one kind."""
    low, high = _around(mask)
    return low != high


def _around(plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest value in the neighbourhood (3 x 3) of each pixel."""
    from scipy.ndimage import maximum_filter, minimum_filter

    return minimum_filter(plane, 3), maximum_filter(plane, 3)
