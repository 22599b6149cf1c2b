"""One image of a scene with everything that is known of it: what `optics render` and `optics batch` write.

A sensor of this program's parts is rendered LED by LED, without noise (optics.light.renderer), through polarizing
layers as well. Every other Mitsuba scene, and a sensor beside stock lights or behind stock glass, goes through
`mi.render`, with the variance of each mean. An EXR holds

    R, G, B                      preview, linear sRGB; of a sensor times its exposure, so that 1 is full scale
    S0.610,000000nm ...          radiance per band; S1 to S3 in scenes with layers, and where the integrator has
                                 `stokes`
    depth.Z                      mm from the camera along its axis; infinite where a ray met nothing
    normal.X, .Y, .Z             of the surface, in the scene's frame
    pressure.Y, traction.X ...   labels that were asked for (optics.light.labels)
    contact.Y                    1 where the indenter touches what is seen
    led_1.R, .G, .B ...          what one LED sends, in the first three bands; with the ambient light they add up to S0
    camera.R, .G, .B             where channels are integrals over the wavelength: each before exposure and gain;
                                 led_1.R ... are then shares of these. S0 is radiance per nm, and none has auto bands
    colour.X, .Y, .Z             CIE 1931 tristimulus values there; white light of radiance 1 has Y = 1
    variance.*                   variance of the mean of a Monte Carlo channel

and its provenance: scene and plugins by hash, every parameter, versions, seed. It names no place and no time, so that
on one thread (optics.study.batch) the same input gives the same bytes; with several, sums may differ in their last bit.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from optics.errors import BadScene
from optics.files import exr
from optics.files.output import file_hash, versions
from optics.light import labels as labelling
from optics.light import paths
from optics.light.development import Developer
from optics.light.labels import Labels
from optics.light.monte_carlo import renderer_of
from optics.light.renderer import Renderer
from optics.light.samples import Hits, Sample
from optics.scene.integral import FEW
from optics.scene.loader import Scene
from optics.scene.mitsuba_parts import is_part
from optics.scene.registry import Registry
from optics.spectra.colours import linear_srgb

UNITS = "W.mm^-2.sr^-1"  # of S0, for LED powers in W/sr
PASSES = 8  # of a Monte Carlo render: their scatter is its variance
LAYERS = ("spectral", "aov", "leds")


@dataclass
class Rendering:
    """A rendered image.

    channels   EXR name -> (H, W)
    header     EXR header
    camera     (H, W, C) DN of the camera, free of noise and not clipped; None for scenes without a camera of this
               program's
    labels     what a learner is told beside it (optics.light.labels)
    """

    channels: dict[str, np.ndarray]
    header: dict[str, object] = field(default_factory=dict)
    camera: np.ndarray | None = None
    labels: Labels = field(default_factory=Labels)

    def stokes(self) -> tuple[np.ndarray, np.ndarray]:
        """Bands in nm (B,) and Stokes vectors (H, W, B, 4); raises ValueError where the image has none."""
        bands, vectors = exr.spectral_image(self.channels)
        if vectors.shape[3] != 4:
            raise ValueError("the image holds no Stokes vectors: S0 only; allowed: images with S0 to S3")
        return bands, vectors

    def write_exr(self, path: Path) -> Path:
        return exr.write(path, self.channels, self.header)

    def write_png(self, path: Path, saturation: float = 255.0) -> Path:
        """The camera's DN as they are; without a camera, the preview as sRGB."""
        if self.camera is not None:
            return exr.write_png(path, self.camera, white=saturation, tone="linear")
        names = [n for n in "RGB" if n in self.channels] or ["Y"]
        return exr.write_png(path, np.nan_to_num(np.stack([self.channels[n] for n in names], -1)))


SPP_MOST = 1_000_000  # hours for the smallest image
LANES_MOST = 2**32 - 1  # rays of one pass


class RenderJob:
    """Makes images of one scene, with other values each time.

    black, saturation   DN, of the camera
    spp                 samples per pixel: render by Monte Carlo, even where LED by LED is possible
    labels              what is known of the press besides (optics.light.labels.LABELS)
    stokes              S1 to S3 in every scene; without it, where there are layers or the integrator has `stokes`
    method              "LED by LED", "from lights and camera" (dielectric bodies), or why the scene goes through
                        `mi.render`
    """

    def __init__(
        self,
        scene: Scene,
        *,
        spp: int | None = None,
        black: float = 0.0,
        saturation: float = 255.0,
        layers: Sequence[str] = LAYERS,
        stokes: bool = False,
        labels: Sequence[str] = (),
    ):
        if spp is not None and not 1 <= spp <= SPP_MOST:
            raise ValueError(f"spp = {spp}; allowed: whole numbers from 1 to {SPP_MOST:,} (samples per pixel)")
        self.scene, self.spp, self.layers, self.labels = scene, spp, tuple(layers), tuple(labels)
        labelling.check(scene, self.labels)
        self.base = scene.values()
        sensors = scene.mitsuba.sensors()
        if len(sensors) != 1:
            raise BadScene(f"{scene.path}: {len(sensors)} cameras; one is allowed: write one <sensor>")
        if not scene.mitsuba.emitters():
            raise BadScene(f'{scene.path}: no light; add an LED, <emitter type="led" id="led_1">, or another emitter')
        if scene.mitsuba.integrator() is None:
            raise BadScene(
                f'{scene.path}: no integrator; add <integrator type="tactile" id="integrator">, or another one'
            )
        if stokes and not (scene.integrator is not None and scene.integrator.bands and "polarized" in scene.variant):
            raise BadScene(
                f"{scene.path}: no Stokes vectors from this integrator and the variant {scene.variant}; allowed: the "
                "integrator 'tactile' with `bands`, and a variant with 'polarized' in its name"
            )
        reason = "samples per pixel were asked for" if spp is not None else obstacle(scene, chance=True)
        if not reason and stokes and (scene.monte_carlo or not paths.layered(scene)):
            reason = "Stokes vectors were asked for of a scene without layers"
        if reason and scene.integral is not None:
            raise BadScene(
                f"{scene.path}: {reason}, and mi.render carries {FEW} bands; allowed: bands such as 620, 540, 460, or "
                "without it"
            )
        if reason and scene.monte_carlo and scene.leds:
            raise BadScene(
                f"{scene.path}: {reason}, but mi.render brings no light of an LED, which is a point, through "
                "dielectric bodies; allowed: "
                "without --spp and --stokes, or luminous areas (emitters of the type 'source') in place of LEDs"
            )
        self.renderer = None if reason else renderer_of(scene, remember=1)
        if self.renderer is not None and self.renderer.layered:
            reason = veiled(self.renderer, self.base)
            self.renderer = None if reason else self.renderer
        self.stokes = stokes or paths.layered(scene) or (scene.integrator is not None and scene.integrator.stokes)
        self.method = (
            f"Monte Carlo: {reason}"
            if reason
            else "from lights and camera"
            if self.renderer.monte_carlo
            else "LED by LED"
        )
        self.developer, self.integral, self.auto = None, None, False
        self.bands = scene.integrator.bands if scene.integrator is not None else ()
        if scene.camera is not None and scene.integrator is not None:
            self.integral = scene.integral
            self.auto = self.integral is not None and self.integral.auto
            distances = self.renderer.distances if self.renderer is not None else None
            self.developer = Developer(scene.camera, self.bands or (0.0,), black, saturation, distances)
        self.record = {
            "scene": scene_record(scene),
            "plugins": plugins_record(scene.registry),
            "variant": scene.variant,
            "method": self.method,
            "versions": versions(),
        }

    @property
    def exact(self) -> bool:
        """Whether images are made LED by LED."""
        return self.renderer is not None

    def take(
        self,
        values: Mapping[str, float | str] | None = None,
        seed: int = 0,
        lit: Sequence[str] | None = None,
        progress: Callable[[str, int, int], None] | None = None,
    ) -> Rendering:
        """The image for values that replace the scene's; lit: the lights that are on (None: all with power)."""
        if self.exact and self.renderer.monte_carlo:
            self.renderer.progress = progress
        now = {**self.base, **self.scene.check(values or {})}
        if lit is not None:
            now.update({power: 0.0 for led, power in self.scene.powers.items() if led not in lit})
        image = self._exact(now, seed) if self.renderer is not None else self._monte_carlo(now, seed)
        image.header["provenance"] = {**self.record, "seed": seed, "parameters": now}
        pressed = None if self.scene.block is None else self.scene.block.press()
        force = getattr(self.scene.gel, "force", None)  # of a skin that knows it
        if pressed is not None or force is not None:
            newtons = pressed.force if pressed is not None else force()
            image.header["provenance"]["press"] = {"force": [float(f) for f in newtons], "unit": "N"}
        if self.labels:
            image.labels = self._labelled(now)
            image.channels.update(image.labels.channels)
            image.header["provenance"]["labels"] = image.labels.numbers
        return image

    def _labelled(self, now: Mapping) -> Labels:
        """The labels of the scene as it was rendered."""
        position = seen = None
        if self.scene.gel is not None:
            hits = self.renderer.hits(now) if self.renderer is not None else self._hits()
            position, seen = hits.position, labelling.on_skin(self.scene, hits)
        return labelling.of(self.scene, position, seen, self.labels)

    def _exact(self, now: Mapping, seed: int) -> Rendering:
        renderer = self.renderer
        arriving = {**now, **paths.undetected(self.scene)}  # the Stokes vectors before the detector weighs them
        alone = {light: renderer.light(arriving, light, seed) for light in renderer.lit(now)}
        totals = [sum(alone.values(), renderer.ambient(arriving))]
        if renderer.layered:
            totals += [renderer.radiance(arriving, seed, component) for component in (1, 2, 3)]
        channels = self._radiance_channels(np.stack(totals, -1), now)
        if "aov" in self.layers:
            channels.update(self._surface(renderer.hits(now), now))
        if "leds" in self.layers:
            if self.integral is not None:
                mixing = self.developer.mixing(self.developer.view(now))
                alone = {light: image @ mixing.T for light, image in alone.items()}
            for light, image in alone.items():
                channels.update(zip((f"{light}.{n}" for n in self._band_names()), np.moveaxis(image, -1, 0)))
        if renderer.monte_carlo:
            scatter = renderer.error(now) ** 2
            scatter = exr.spectral_channels(self.bands, scatter) if self.bands else {"Y": scatter[..., 0]}
            channels.update({f"variance.{name}": image for name, image in scatter.items() if name in channels})
        header = exr.spectral_header(renderer.layered, UNITS if self.integral is None else UNITS + ".nm^-1")
        header = header if self.bands and not self.auto else {}
        side = self.developer.side(now)
        if side > 1:
            with renderer.splitting(side):
                totals = [renderer.radiance(arriving, seed, component) for component in range(len(totals))]
        self.scene.set(now)  # the renderer leaves the LEDs at power 1
        return Rendering(channels, header, self._developed(totals, now))

    def _developed(self, stokes: Sequence[np.ndarray], now: Mapping) -> np.ndarray:
        """(H, W, C) DN of Stokes vectors, (H, W, B) each; without S1 and S2, light is unpolarized."""
        if self.developer.site is None:
            row = paths.detected(self.scene, now)
            return self.developer.develop(sum(w * s for w, s in zip(row[1:], stokes[1:])) + row[0] * stokes[0], now)
        whole = [stokes[j] if j < len(stokes) else np.zeros_like(stokes[0]) for j in range(3)]
        return self.developer.develop(np.stack(whole), now)

    def _monte_carlo(self, now: Mapping, seed: int) -> Rendering:
        scene = self.scene
        scene.set(now)
        polarized, ours = "polarized" in scene.variant, scene.integrator is not None
        asked = ours and scene.integrator.stokes
        if ours:
            scene.integrator.stokes = polarized  # its channels are the only way to the bands
        try:
            mean, variance, spp = self._passes(seed)
        finally:
            if ours:
                scene.integrator.stokes = asked
        vectors: list[np.ndarray] = []
        if ours and polarized:
            mean, variance = ({name: image for name, image in c.items() if "." in name} for c in (mean, variance))
            lanes = self.bands or (0.0,)
            pick = lambda c, s: np.stack([c[f"S{s}.{j}"] for j in range(len(lanes))], -1)  # noqa: E731
            vectors = [pick(mean, s) for s in range(4)]
            components = range(4) if self.stokes else range(1)
            channels = self._radiance_channels(np.stack([vectors[s] for s in components], -1), now)
            if self.bands and variance:  # of one pass none is known
                scatter = exr.spectral_channels(self.bands, np.stack([pick(variance, s) for s in range(4)], -1))
                variance = {n: image for n, image in scatter.items() if n in channels}
        else:
            channels = mean
        channels.update({f"variance.{name}": image for name, image in variance.items() if name in channels})
        if "aov" in self.layers:
            channels.update(self._surface(self._hits(), now))
        header = {
            **(exr.spectral_header(self.stokes, UNITS) if vectors and self.bands else {}),
            "samplesPerPixel": spp,
        }
        camera = None
        if vectors and self.developer is not None:  # whose rays came through all of the pupil
            camera = self._developed(vectors, {**now, scene.key(scene.camera.name, "pupil"): 0.0})
        return Rendering(channels, header, camera)

    def _passes(self, seed: int) -> tuple[dict, dict, int]:
        """Mean and variance of the mean of every channel by name, and the samples per pixel; passes of different
        seeds."""
        import mitsuba as mi

        sensor = self.scene.mitsuba.sensors()[0]
        spp = self.spp or int(sensor.sampler().sample_count())
        width, height = (int(n) for n in sensor.film().crop_size())
        most = LANES_MOST // (width * height)
        if spp > PASSES * most:
            raise ValueError(
                f"spp = {spp} of {width} x {height} pixels; allowed: up to {PASSES * most} (samples per pixel), as "
                "Dr.Jit traces at most 2^32 rays at once; add images of several seeds"
            )
        passes = min(PASSES, spp)
        per_pass = spp // passes
        seeds = np.random.SeedSequence(seed).generate_state(passes)
        total, squares = 0.0, 0.0
        for k in range(passes):
            image = np.array(mi.render(self.scene.mitsuba, spp=per_pass, seed=int(seeds[k])), float)
            total, squares = total + image, squares + image * image
        names = [f.name for f in sensor.film().bitmap(raw=False).struct_()]
        total = total.reshape(*total.shape[:2], -1)
        mean = total / passes
        if len(names) != mean.shape[2]:
            names = [f"channel{i}" for i in range(mean.shape[2])]
        variance = np.maximum(squares.reshape(mean.shape) / passes - mean**2, 0) / max(passes - 1, 1)
        split = [{name: image[..., i] for i, name in enumerate(names)} for image in (mean, variance)]
        return split[0], split[1] if passes > 1 else {}, per_pass * passes

    def _band_names(self) -> list[str]:
        if self.integral is not None:
            count = len(self.integral.quantum)
            return list("RGB") if count == 3 else ["Y"] if count == 1 else [f"channel{c}" for c in range(count)]
        return list("RGB") if len(self.bands) == 3 else [exr.spectral_name(b)[3:] for b in self.bands] or ["Y"]

    def _radiance_channels(self, radiance: np.ndarray, now: Mapping) -> dict[str, np.ndarray]:
        """Preview and spectral channels of (H, W, B), or of Stokes vectors (H, W, B, 4)."""
        s0 = radiance if radiance.ndim == 3 else radiance[..., 0]
        if not self.bands:
            parts = radiance[..., 0, :] if radiance.ndim == 4 and radiance.shape[3] == 4 else ()
            return {"Y": s0[..., 0], **{f"S{i}.Y": parts[..., i] for i in range(4) if len(parts)}}
        if self.integral is not None:
            return self._colours(radiance, now)
        camera = self.scene.camera
        exposure = 1.0 if camera is None else now[self.scene.key(camera.name, "exposure")]
        channels = exr.preview_channels(self.bands, s0 * exposure)
        if "spectral" in self.layers:
            parts = radiance[..., 0] if radiance.ndim == 4 and radiance.shape[3] == 1 else radiance
            channels.update(exr.spectral_channels(self.bands, parts))
        return channels

    def _colours(self, radiance: np.ndarray, now: Mapping) -> dict[str, np.ndarray]:
        """Preview, linear channels and XYZ of Stokes vectors (H, W, B, S), by integrals over the wavelength; spectral
        channels of fixed bands."""
        s0 = radiance[..., 0]
        tristimulus = s0 @ self.integral.colour_matrix(now).T
        full = now[self.scene.key(self.scene.camera.name, "exposure")]
        channels = dict(zip("RGB", np.moveaxis(np.maximum(linear_srgb(tristimulus * full), 0.0), -1, 0)))
        channels.update({f"colour.{n}": tristimulus[..., i] for i, n in enumerate("XYZ")})
        linear = s0 @ self.developer.mixing(self.developer.view(now)).T
        channels.update({f"camera.{n}": linear[..., i] for i, n in enumerate(self._band_names())})
        if "spectral" in self.layers and not self.auto:
            channels.update(exr.spectral_channels(self.bands, s0 if radiance.shape[3] == 1 else radiance))
        return channels

    def _hits(self) -> Hits:
        """What the rays through the pixels' centres meet."""
        import drjit as dr
        import mitsuba as mi

        scene, sensor = self.scene.mitsuba, self.scene.mitsuba.sensors()[0]
        width, height = (int(n) for n in sensor.film().crop_size())
        v, u = (mi.Float((a.ravel() + 0.5).astype(np.float32)) for a in np.mgrid[:height, :width])
        with dr.suspend_grad():
            if self.developer is not None and paths.layered(self.scene):
                path = paths.trace(self.scene, np.array(u), np.array(v))
                return Hits(Sample(path.si, None, path.origin, path), height, width)
            if self.developer is not None:
                si, weight, origin = self.scene.integrator.hits(scene, self.scene.camera, u, v)
            else:
                ray, _ = sensor.sample_ray(
                    mi.Float(0), mi.Float(0.5), mi.Point2f(u / width, v / height), mi.Point2f(0.5)
                )
                si, weight, origin = scene.ray_intersect(ray), None, ray.o
        return Hits(Sample(si, weight, origin), height, width)

    def _surface(self, hits: Hits, now: Mapping) -> dict[str, np.ndarray]:
        """depth, normal and contact of what the pixels' centres see."""
        import mitsuba as mi

        origin, axis = self._view(now)
        valid, position = hits.valid, hits.position
        normal = np.where(valid[..., None], hits.normal, 0.0)
        channels = {"depth.Z": np.where(valid, (position - origin) @ axis, np.inf)}
        channels.update({f"normal.{name}": normal[..., i] for i, name in enumerate("XYZ")})
        if self.scene.gel is not None:
            x, y = (np.where(valid, position[..., i], 0.0) for i in (0, 1))
            touched = self.scene.gel.contact_weight(x.ravel(), y.ravel()).reshape(valid.shape) > 0.5
            if hits.path is not None:  # what lies behind a clear skin is not touched
                touched &= hits.image(hits.si.shape == mi.ShapePtr(self.scene.gel)).astype(bool)
            channels["contact.Y"] = (touched & valid).astype(np.float32)
        return channels

    def _view(self, now: Mapping) -> tuple[np.ndarray, np.ndarray]:
        """Position and axis of the camera."""
        import mitsuba as mi

        camera = self.scene.camera
        if camera is not None:
            o, d = camera.ray(*(mi.Float(place) for place in camera.middle()))
        else:
            pose = self.scene.mitsuba.sensors()[0].world_transform()
            o, d = pose @ mi.Point3f(0), pose @ mi.Vector3f(0, 0, 1)
        return tuple(np.array(a, float).reshape(3, -1)[:, 0] for a in (o, d))


def obstacle(scene: Scene, chance: bool = False) -> str:
    """Why a scene cannot be rendered LED by LED; empty where it can. chance: dielectric bodies are none, as light is
    followed by Monte Carlo."""
    import mitsuba as mi

    if scene.camera is None or scene.integrator is None or not scene.lights:
        return "the scene has no camera, LED and integrator of this program's"
    others = [e for e in scene.mitsuba.emitters() if not is_part(e)]
    if others:
        return f"{len(others)} of its lights are no LED"
    for shape in scene.mitsuba.shapes():
        bsdf = shape.bsdf()
        if shape.is_medium_transition():
            return "it has a medium"
        if is_part(bsdf):
            declared = scene.registry.parts[bsdf.kind]
            if declared.refracts or declared.mueller is not None or declared.role == "clear" and chance:
                continue
        if mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta | mi.BSDFFlags.Null):
            return "it has mirrors or clear surfaces that are no 'interface'"
        if paths.layered(scene) and polarizes(bsdf):
            return f"its surface '{shape.id()}' polarizes the light that it reflects"
    if paths.layered(scene):
        try:
            paths.check(scene)
        except BadScene as error:
            return str(error)
    return ""


def polarizes(bsdf) -> bool:
    """Whether a surface makes polarized light of unpolarized light, or keeps polarization; in unpolarized variants
    nothing does."""
    import drjit as dr
    import mitsuba as mi

    if not mi.is_polarized:
        return False
    n = 64
    rng = np.random.default_rng(0)
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.t, si.n, si.sh_frame, si.uv = (
        mi.Float(1),
        mi.Normal3f(0, 0, 1),
        mi.Frame3f(mi.Vector3f(0, 0, 1)),
        mi.Point2f(0.5),
    )
    if mi.is_spectral:
        si.wavelengths = mi.UnpolarizedSpectrum(540.0)
    si.wi, wo = (
        mi.warp.square_to_uniform_hemisphere(mi.Point2f(*rng.random((2, n)).astype(np.float32))) for _ in range(2)
    )
    matrix = bsdf.eval(mi.BSDFContext(), si, wo)
    own = [np.abs(np.array(matrix[i, j])).max() for i in range(4) for j in range(4)]
    return max(own[1:]) > 1e-5 * own[0]  # rounding leaves 1e-7


def veiled(renderer: Renderer, values: Mapping) -> str:
    """What LEDs light the image through layers, by more than a thousandth of their light: LED by LED, a layer in the
    way of their light is taken for a wall. Empty for none."""
    import drjit as dr
    import mitsuba as mi

    hits, scene = renderer.hits(values), renderer.scene
    scene.set({**values, **dict.fromkeys(scene.power_keys(*scene.lights), 1.0)})
    passing = int(mi.BSDFFlags.Null | mi.BSDFFlags.DeltaTransmission)
    found, count = [], min(renderer.bands, scene.integrator.lanes)
    with dr.suspend_grad():
        for name, led in scene.leds.items():
            point = led.position()
            seen = scene.integrator.visible(scene.mitsuba, hits.si, point, led)
            ray, going, behind = hits.si.spawn_ray_to(point), hits.si.is_valid() & ~seen, mi.Bool(False)
            for _ in range(paths.STEPS):
                met = scene.mitsuba.ray_intersect(ray, going)
                behind |= going & ~met.is_valid()
                going &= met.is_valid() & ((met.bsdf().flags() & passing) != 0)
                ray = dr.select(going, met.spawn_ray_to(point), ray)
                dr.eval(ray, going, behind)
                if not np.any(np.array(going)):
                    break
            if np.any(np.array(behind)):
                light = [
                    scene.integrator.direct(scene.mitsuba, hits.si, 1.0, hits.origin, led, way)
                    for way in (seen, behind)
                ]
                direct, through = (np.array([float(np.array(a[i]).sum()) for i in range(count)]) for a in light)
                if np.any(through > 1e-3 * direct):
                    found.append(name)
    return f"the light of {' and '.join(found)} passes layers before it meets anything" if found else ""


# -- provenance ------------------------------------------------------------------------------------------------------
def scene_record(scene: Scene) -> dict:
    """Name and hash of the scene file, its definitions, and the hash of every file that it names."""
    text = scene.path.read_text(encoding="utf-8")
    named = re.findall(r'name="(?:filename|indenter)"\s+value="([^"$]+\.\w+)"', text)
    named += [str(v) for v in scene.defines.values()] + [str(v) for v in scene.values().values() if isinstance(v, str)]
    files = {}
    for name in named:
        for folder in (scene.path.parent, Path()):
            if (folder / name).is_file():
                files[Path(name).name] = file_hash(folder / name)
                break
    return {
        "name": scene.path.name,
        "hash": file_hash(scene.path),
        "files": dict(sorted(files.items())),
        "defines": {k: str(v) for k, v in sorted(scene.defines.items())},
    }


def plugins_record(registry: Registry) -> dict[str, str]:
    """Plugin file, relative to its folder, -> hash."""
    return {registry.name_of(file): file_hash(file) for file in registry.files}


# -- files -----------------------------------------------------------------------------------------------------------
