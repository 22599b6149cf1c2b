"""Captures of a pressed gel by a renderer of its own: stock Mitsuba, a denser mesh, its own seeds.

It shares nothing with `optics.light.renderer` or the `tactile` integrator. Mitsuba's `path` traces the light in the
mono variant, one channel and one LED at a time, with its `perspective` camera, on a finer mesh than the model's.
Effects are made by stock means (more bounces, a `constant` emitter, an LED's disc sampled at random) or by scipy on the
image, not by the functions that a fit uses. Then come photons, read noise and quantisation. Shared with the model are
only the formulas of the LED and the membrane, which tests hold to closed forms, the shape of a dent, and measured
sensitivities of a camera.

How far the model's images are from these, as a share of the noise: with 16 frames of 12 bits, 64 samples per pixel add
0.01 to 0.02 to chi2 per value, nearly all of it at rims; 256 samples halve that. A disc for an LED adds 0.05."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from optics.captures import capture_set as capture_files
from optics.captures.noise import Noise
from optics.light.development import sensitivities
from optics.proof.makers import in_variant
from optics.scene.loader import Scene

VARIANT = "llvm_ad_mono"
FINE = 8  # parts of a pixel each way, on which blur acts: what a pixel has is the mean of what falls on it
# Times the samples in the penumbra of a disc, and of light that is reflected twice: with 64 of them their own noise is
# a tenth to a third of the photons', and most of it lies in the few pixels that show how large a disc is
PENUMBRA, REFLECTED = 8, 4
HALO = 0.04  # of the image's diagonal: the standard deviation of the halo, between the library's two
AROUND = 6  # pixels beyond the borders that blur brings light from
CAMERA = Noise(system_gain=0.04, dark_noise=0.8, black_level=8.0, saturation=255.0, prnu=0.0)
MAKERS = (
    "lens vignetting",
    "veiling glare",
    "lens halo",
    "lens blur",
    "colour crosstalk",
    "residual response curve",
    "interreflection",
    "ambient light",
    "LED size",
    "gel absorption",
    "radial distortion",
    "gain drift",
    "LED drift",
    "gel wedge",
    "gel bulge",
    "refraction at the window",
    "specular lobe",
    "gel haze",
    "dark offset",
)


def presses(count: int, seed: int, width: float = 7.0, length: float = 5.0, depth: tuple[float, float] = (0.35, 0.8)):
    """(count, 3) press positions and depths (mm) that cover the field: a Latin hypercube."""
    from scipy.stats import qmc

    cube = qmc.LatinHypercube(d=3, rng=np.random.default_rng([seed, 11])).random(count)
    return np.column_stack(
        [(cube[:, 0] - 0.5) * width, (cube[:, 1] - 0.5) * length, depth[0] + cube[:, 2] * (depth[1] - depth[0])]
    )


class Maker:
    """Makes frames of a scene's values with one hidden effect or none.

    effects   {name of a known effect: strength}, in the units of the effect's own parameters
    noise     of one frame
    spp       samples per pixel, of a point that lights a face directly; their noise is far below the photons'
    frames    exposed one after the other and summed to one image; the captures state the noise of the sum
    """

    def __init__(
        self,
        scene: Scene,
        values: Mapping[str, float] | None = None,
        effects: Mapping[str, float] | None = None,
        noise: Noise = CAMERA,
        seed: int = 0,
        spp: int = 64,
        frames: int = 1,
    ):
        self.values = {**scene.values(), **(values or {})}
        self.leds = list(scene.leds)
        self.gel, self.camera, self.membrane = scene.gel.name, scene.camera.name, next(iter(scene.membranes))
        self.size = scene.camera.resolution
        self.frames = {
            n: np.array([[float(c[0]) for c in axis] for axis in led.frame]) for n, led in scene.leds.items()
        }
        self.lines = {n: led.curves["line_shape"] for n, led in scene.leds.items() if "line_shape" in led.curves}
        self.effects = dict(effects or {})
        unknown = set(self.effects) - set(MAKERS)
        if unknown:
            raise ValueError(f"no independent way to make {', '.join(sorted(unknown))}; known: {', '.join(MAKERS)}")
        self.noise, self.seed, self.spp, self.frames_summed = noise, seed, spp, frames
        self.count, self.wide = 0, False
        self.camera_z = float(scene.camera.columns[3].z[0])
        self.bands = np.array(scene.integrator.bands)
        self.matrix = sensitivities(
            scene.camera.sensitivity, scene.integrator.bands
        )  # of the camera's channels, (3, 3)

    # -- the face -----------------------------------------------------------------------------------------------------
    def mesh(self, press: Sequence[float], pitch: float = 0.02):
        """The coated face on a grid that is finer than the model's around the dent, with its exact normals."""
        import mitsuba as mi

        from optics.skin import contact

        v, g = self.values, self.gel
        profile = contact.indenter_profile(v[f"{g}.indenter"], v[f"{g}.indenter_size"], (0.0, 0.0, 0.0), 3.0, 0.03)
        pressed, touch = contact.displacement(
            profile, press[2], v[f"{g}.thickness"], v[f"{g}.smoothing"], skirt=v.get(f"{g}.skirt", 0.0)
        )
        width, length = v[f"{g}.width"], v[f"{g}.length"]
        x = contact.graded_axis(-width / 2, width / 2, press[0], 3.0, pitch, 481)
        y = contact.graded_axis(-length / 2, length / 2, press[1], 3.0, pitch, 481)
        z = -contact.surface(x[None, :], y[:, None], press[0], press[1], pressed)
        if "gel bulge" in self.effects:
            ring = contact.ring_bulge(pressed, touch, v[f"{g}.thickness"])
            z = z + self.effects["gel bulge"] * contact.surface(x[None, :], y[:, None], press[0], press[1], ring)
        if "gel wedge" in self.effects:
            z = z + np.tan(np.radians(self.effects["gel wedge"])) * x[None, :]
        points = np.stack(np.broadcast_arrays(x[None, :], y[:, None], z), -1).reshape(-1, 3)
        index = np.arange(len(points)).reshape(len(y), len(x))
        a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
        faces = np.stack([a, d, c, a, c, b], -1).reshape(-1, 3)
        normals = contact.grid_normals(x, y, np.broadcast_to(z, (len(y), len(x)))).reshape(-1, 3)
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict(self.coating(1.0))
        mesh = mi.Mesh("face", len(points), len(faces), properties, has_vertex_normals=True)
        params = mi.traverse(mesh)
        params["vertex_positions"] = mi.Float(points.astype(np.float32).ravel())
        params["vertex_normals"] = mi.Float(normals.astype(np.float32).ravel())
        params["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
        params.update()
        return mesh

    def coating(self, rho: float) -> dict:
        v = self.values
        return {
            "type": "membrane",
            "rho_r": float(rho),
            "sigma": float(v[f"{self.membrane}.sigma"]),
            "specular": float(self.effects.get("specular lobe", 0.0)),
        }

    # -- light --------------------------------------------------------------------------------------------------------
    def sensor(self) -> dict:
        import mitsuba as mi

        width, height = self.size
        looking = mi.ScalarTransform4f([[-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, self.camera_z], [0, 0, 0, 1]])
        return {
            "type": "perspective",
            "fov": float(self.values[f"{self.camera}.x_fov"]),
            "fov_axis": "x",
            "near_clip": 0.01,
            "far_clip": 1000.0,
            "to_world": looking,
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "rfilter": {"type": "box"},
                "pixel_format": "luminance",
                "component_format": "float32",
            },
            "sampler": {"type": "multijitter", "sample_count": self.spp},
        }

    def emitter(self, led: str) -> dict:
        """The LED aimed by an axis of its own making: straight ahead, then panned and tilted to the true axis."""
        v = self.values
        side, up, ahead = self.frames[led]
        axis = ahead + np.tan(np.radians(v[f"{led}.pan"])) * side + np.tan(np.radians(v[f"{led}.tilt"])) * up
        place = {n: float(v[f"{led}.{n}"]) for n in ("x", "y", "z", "mu")}
        return {
            "type": "led",
            "power": 1.0,
            "target": [place["x"], place["y"], place["z"] + 1.0],
            **place,
            "pan": float(np.degrees(np.arctan(axis[0] / axis[2]))),
            "tilt": float(np.degrees(np.arctan(axis[1] / axis[2]))),
        }

    def colour(self, led: str) -> np.ndarray:
        """(3,) share of an LED's power in each band: a Gaussian about its wavelength, the straight lines of a measured
        table moved there, or white, times its power per band."""
        v = self.values
        peak, width = v[f"{led}.wavelength"], v[f"{led}.fwhm"]
        table = self.lines.get(led)
        if peak <= 0:
            line = np.ones(3)
        elif table is None:
            line = np.exp(-4 * np.log(2) * ((self.bands - peak) / width) ** 2)
        else:
            power, top = table.values / table.values.max(), int(table.values.argmax())
            left = np.interp(0.5, power[: top + 1], table.nm[: top + 1])
            right = np.interp(-0.5, -power[top:], table.nm[top:])
            line = np.interp(table.nm[top] + (self.bands - peak) * (right - left) / width, table.nm, power, 0, 0)
        return line * [v[f"{led}.power_{c}"] for c in "rgb"]

    def disc(self, led: str) -> dict:
        """The LED as a disc across its axis, for the hidden effect "LED size"."""
        v = self.values
        place = {n: float(v[f"{led}.{n}"]) for n in ("x", "y", "z", "mu", "pan", "tilt")}
        return {
            "type": "led",
            "power": 1.0,
            "area": float(self.effects["LED size"]),
            **place,
            "target": [float(v[f"{led}.{c}"] + a) for c, a in zip("xyz", self.frames[led][2])],
        }

    def scene(self, mesh, light: dict, depth: int):
        import mitsuba as mi

        content = {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": depth, "rr_depth": 1000},
            "sensor": self.sensor(),
            "face": mesh,
            "light": light,
        }
        if "refraction at the window" in self.effects:
            content["window"] = {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate([0, 0, -8]).rotate([1, 0, 0], 180).scale([30, 30, 1]),
                "bsdf": {
                    "type": "dielectric",
                    "ext_ior": 1.0,
                    "int_ior": float(self.effects["refraction at the window"]),
                },
            }
        return mi.load_dict(content, optimize=False)

    def traced(self, scene, rho: float, led: str | None = None, depth: int = 2, times: int = 1) -> np.ndarray:
        """(H, W) radiance by Mitsuba's path tracer, by so many times the samples; the scene's light is moved to where
        the LED is."""
        import mitsuba as mi

        params = mi.traverse(scene)
        params["face.bsdf.rho_r"] = mi.Float(float(rho))
        if led is not None:
            for name, value in self.emitter(led).items():
                if name in ("x", "y", "z", "mu", "pan", "tilt"):
                    params[f"light.{name}"] = mi.Float(value)
        params.update()
        self.count += 1
        integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 1000})
        seed = (self.seed * 100003 + self.count) % 2**32
        return np.array(mi.render(scene, integrator=integrator, spp=times * self.spp, seed=seed))[..., 0]

    def light(self, press: Sequence[float]) -> dict[str, np.ndarray]:
        """{LED: (H, W, 3) radiance at power 1}, and under 'ambient' what no LED made."""
        with in_variant(VARIANT):
            v = self.values
            mesh = self.mesh(press)
            rho = [v[f"{self.membrane}.rho_{c}"] for c in "rgb"]
            bounce = self.effects.get("interreflection", 0.0)
            images = {}
            scene = self.scene(mesh, self.emitter(self.leds[0]), 2)
            for led in self.leds:
                if "LED size" in self.effects:
                    disc = self.scene(mesh, self.disc(led), 2)
                    images[led] = self.traced(disc, 1.0, times=PENUMBRA)[..., None] * np.array(rho)
                elif bounce or "specular lobe" in self.effects:
                    depth, times = (3, REFLECTED) if bounce else (2, 1)
                    stack = [self.traced(scene, r, led, depth, times) for r in rho]
                    if bounce and bounce != 1:
                        direct = self.traced(scene, 1.0, led)
                        stack = [r * direct + bounce * (s - r * direct) for r, s in zip(rho, stack)]
                    images[led] = np.stack(stack, -1)
                else:
                    images[led] = self.traced(scene, 1.0, led)[..., None] * np.array(rho)
                if {"gel absorption", "gel haze"} & set(self.effects):
                    images[led] = self.through_gel(images[led], led, press)
                images[led] = images[led] * self.colour(led)
            if "ambient light" in self.effects:
                sky = {
                    "type": "constant",
                    "radiance": {"type": "uniform", "value": self.effects["ambient light"] / np.pi},
                }
                images["ambient"] = self.traced(self.scene(mesh, sky, 2), 1.0)[..., None] * np.array(rho)
            return images

    @contextmanager
    def widened(self, fine: int, around: int) -> Iterator[None]:
        """Within it, images have `fine` parts of a pixel each way and show `around` pixels more at each border, by as
        many samples of a pixel."""
        size, spp, v, fov = self.size, self.spp, self.values, f"{self.camera}.x_fov"
        wide = [n + 2 * around for n in size]
        half = np.tan(np.radians(v[fov]) / 2) * wide[0] / size[0]
        self.values = {**v, fov: 2 * float(np.degrees(np.arctan(half)))}
        self.size, self.spp, self.wide = (fine * wide[0], fine * wide[1]), max(spp // fine**2, 1), True
        try:
            yield
        finally:
            self.values, self.size, self.spp, self.wide = v, size, spp, False

    def smeared(self, press: Sequence[float]) -> dict[str, np.ndarray]:
        """`light` behind a lens that bends or blurs: before pixels take their means, as they do not say where in them a
        rim is."""
        if not {"radial distortion", "lens blur"} & set(self.effects):
            return self.light(press)
        with self.widened(FINE, AROUND):
            light = self.light(press)
        width, height = self.size
        found = {}
        for name, image in light.items():
            planes = np.moveaxis(image, -1, 0)
            if "radial distortion" in self.effects:
                planes = [self.bent(plane) for plane in planes]
            if "lens blur" in self.effects:
                planes = [self.spread(plane) for plane in planes]
            parts = np.stack(planes, -1).reshape(height + 2 * AROUND, FINE, width + 2 * AROUND, FINE, -1)
            found[name] = parts.mean((1, 3))[AROUND:-AROUND, AROUND:-AROUND]
        return found

    def bent(self, plane: np.ndarray) -> np.ndarray:
        """A plane of parts of pixels behind a lens that distorts."""
        from scipy.ndimage import map_coordinates

        focal = FINE * self.size[0] / 2 / np.tan(np.radians(self.values[f"{self.camera}.x_fov"]) / 2)
        height, width = plane.shape
        y, x = np.mgrid[:height, :width] + 0.5
        x, y = (x - width / 2) / focal, (y - height / 2) / focal
        xs, ys = x, y  # where a distorted point came from
        for _ in range(20):
            stretch = self.stretch(xs**2 + ys**2)
            xs, ys = x / stretch, y / stretch
        return map_coordinates(
            plane, [ys * focal + height / 2 - 0.5, xs * focal + width / 2 - 0.5], order=3, mode="nearest"
        )

    def stretch(self, r2: np.ndarray) -> np.ndarray:
        """x_d/x of a lens that distorts, by the square of the tangent: 1 + k1 r^2."""
        return 1 + self.effects["radial distortion"] * r2

    def spread(self, plane: np.ndarray) -> np.ndarray:
        """A plane of parts of pixels behind the lens."""
        from scipy.ndimage import gaussian_filter

        return gaussian_filter(plane, FINE * np.sqrt(self.effects["lens blur"]), mode="nearest", truncate=6)

    def together(self, light: Mapping[str, np.ndarray], drive: Mapping[str, float], frame: int) -> np.ndarray | float:
        """The radiance of a frame's LEDs, each of which may drift by itself; 0 where none is lit."""
        size, rng = self.effects.get("LED drift", 0.0), np.random.default_rng([self.seed, frame, 29])
        drift = dict(zip(self.leds, 1 + size * rng.standard_normal(len(self.leds))))
        return sum(p * drift[led] * self.values[f"{led}.power"] * light[led] for led, p in drive.items() if p)

    def through_gel(self, image: np.ndarray, led: str, press) -> np.ndarray:
        """Beer-Lambert and single scattering in numpy, on the analytic view of the dented plane (pixel centres)."""
        v = self.values
        a, h = self.effects.get("gel absorption", 0.0), self.effects.get("gel haze", 0.0)
        point, camera = self.seen(press)
        lamp = np.array([v[f"{led}.{c}"] for c in "xyz"])
        thickness = v[f"{self.gel}.thickness"]
        along = camera - point

        def inside(p, q):
            rise = np.where(
                q[..., 2] < -thickness, (p[..., 2] + thickness) / np.maximum(p[..., 2] - q[..., 2], 1e-9), 1.0
            )
            return np.linalg.norm(q - p, axis=-1) * np.clip(rise, 0, 1)

        view = inside(point, np.broadcast_to(camera, point.shape))
        out = image * np.exp(-(a + h) * (view + inside(point, np.broadcast_to(lamp, point.shape))))[..., None]
        if h:
            toward = along / np.linalg.norm(along, axis=-1, keepdims=True)
            side, up, ahead = self.frames[led]
            axis = ahead + np.tan(np.radians(v[f"{led}.pan"])) * side + np.tan(np.radians(v[f"{led}.tilt"])) * up
            axis = axis / np.linalg.norm(axis)
            steps = 64
            for k in range(steps):
                s = view * (k + 0.5) / steps
                x = point + toward * s[..., None]
                d = np.maximum(np.linalg.norm(lamp - x, axis=-1), 0.2)
                cos = np.maximum(((x - lamp) @ axis) / d, 1e-9)
                way = view - s + inside(x, np.broadcast_to(lamp, x.shape))
                veil = h / (4 * np.pi) * cos ** v[f"{led}.mu"] / d**2 * np.exp(-h * way) * view / steps
                out = out + veil[..., None]
        return out

    def seen(self, press) -> tuple[np.ndarray, np.ndarray]:
        """(H, W, 3) point of the face at every pixel's centre (fixed-point iteration on the height), and the camera."""
        from optics.skin import contact

        v, g = self.values, self.gel
        width, height = self.size
        focal = width / 2 / np.tan(np.radians(v[f"{self.camera}.x_fov"]) / 2)
        y, x = np.mgrid[:height, :width] + 0.5
        direction = np.stack([(x - width / 2) / focal, (y - height / 2) / focal, np.ones_like(x)], -1)
        profile = contact.indenter_profile(v[f"{g}.indenter"], v[f"{g}.indenter_size"], (0.0, 0.0, 0.0), 3.0, 0.03)
        pressed, _ = contact.displacement(
            profile, press[2], v[f"{g}.thickness"], v[f"{g}.smoothing"], skirt=v.get(f"{g}.skirt", 0.0)
        )
        camera = np.array([0.0, 0.0, self.camera_z])
        z = np.zeros_like(x)
        for _ in range(12):
            p = camera + direction * (z - self.camera_z)[..., None]
            z = -contact.surface(p[..., 0], p[..., 1], press[0], press[1], pressed)
        return camera + direction * (z - self.camera_z)[..., None], camera

    # -- camera -------------------------------------------------------------------------------------------------------
    def photograph(self, radiance: np.ndarray, rng, frame: int) -> np.ndarray:
        """Noisy, quantised DN of a radiance (H, W, 3); the camera's effects by scipy."""
        v, e, cam = self.values, self.effects, self.camera
        width, height = self.size
        focal = width / 2 / np.tan(np.radians(v[f"{cam}.x_fov"]) / 2)
        y, x = np.mgrid[:height, :width] + 0.5
        x, y = (x - width / 2) / focal, (y - height / 2) / focal
        image = radiance.astype(float)
        if "lens vignetting" in e:
            image = image * (np.cos(np.arctan(np.hypot(x, y))) ** (4 * e["lens vignetting"]))[..., None]
        if "veiling glare" in e:
            image = image + e["veiling glare"] * (image.mean((0, 1)) - image)
        if "lens halo" in e:
            from scipy.ndimage import gaussian_filter

            width = HALO * np.hypot(*image.shape[:2])
            image = image + e["lens halo"] * (gaussian_filter(image, (width, width, 0), mode="nearest") - image)
        signal = image @ self.matrix.T * v[f"{cam}.exposure"]
        if "gain drift" in e:
            signal = signal * (1 + e["gain drift"] * np.random.default_rng([self.seed, frame, 5]).standard_normal())
        if "colour crosstalk" in e:
            k = e["colour crosstalk"]
            signal = signal @ np.array([[1 - 2 * k, k, k], [k, 1 - 2 * k, k], [k, k, 1 - 2 * k]])
        if "residual response curve" in e:
            signal = signal + e["residual response curve"] * signal * (1 - signal)
        n = self.noise
        mean = n.black_level + (n.saturation - n.black_level) * signal + e.get("dark offset", 0.0)
        return sum(n.expose(mean, rng) for _ in range(self.frames_summed))

    def captures(
        self,
        at: np.ndarray,
        drives: Sequence[Mapping[str, float]] | None = None,
        known_to: float = 0.0,
        cfa: str | None = None,
        progress: Callable[[str, int, int], None] | None = None,
        scene_name: str = "gelsight",
    ) -> capture_files.Captures:
        """A capture set: every press under every lighting of `drives` (default: each LED alone).

        known_to   mm: standard deviation of the error of the press positions that are written down
        cfa        pattern of a raw mosaic; None: three values per pixel
        """
        rng = np.random.default_rng([self.seed, 3])
        drives = drives or [{led: 1.0} for led in self.leds]
        frames = []
        at = np.asarray(at, float)
        with in_variant(VARIANT):
            lights = []
            for press in at:
                lights.append(self.smeared(press))
                if progress:
                    progress("captures", len(lights), len(at))
        for k, (press, light) in enumerate(zip(at, lights)):
            noted = press + known_to * rng.standard_normal(3) * (1, 1, 0.5)
            for drive in drives:
                radiance = self.together(light, drive, len(frames)) + light.get("ambient", 0.0)
                if np.ndim(radiance) == 0:
                    radiance = np.zeros((*self.size[::-1], 3))
                settings = {f"{led}.power": float(drive.get(led, 0.0)) for led in self.leds}
                settings.update(
                    {
                        f"{self.gel}.press_x": float(noted[0]),
                        f"{self.gel}.press_y": float(noted[1]),
                        f"{self.gel}.press_depth": float(max(noted[2], 0.0)),
                    }
                )
                on = "+".join(led for led, p in drive.items() if p) or "dark"
                image = self.photograph(radiance, rng, len(frames)).astype(np.float32)
                if cfa is not None:
                    image = np.take_along_axis(image, capture_files.cfa_channel(image.shape, cfa)[..., None], axis=2)
                frames.append(
                    capture_files.Frame(
                        name=f"press{k:02d}-{on}",
                        image=image,
                        mask=None,
                        group=f"press-{k:02d}",
                        parameters=settings,
                        repeats=[],
                        file=f"frames/press{k:02d}-{on}.png",
                    )
                )
        return capture_files.Captures(
            folder=Path("."),
            scene=scene_name,
            frames=frames,
            parameters={},
            noise=self.noise if self.frames_summed == 1 else self.noise.summed(self.frames_summed),
            flat_field=None,
            cfa=cfa,
            values_are="DN",
            table=None,
            warnings=[],
        )
