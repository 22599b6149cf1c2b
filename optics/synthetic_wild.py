"""Captures as they come from a workshop: clutter that nobody models, effects of another shape, effects that no library has.

`Wild` is `optics.synthetic.Maker` (stock Mitsuba, its own meshes) with

    clutter    c = 1: fixed pattern of the sensor 0.5 % rms, mottle of the coating 1 % rms (0.4 mm), wrinkles of the skin of 0.3 deg rms,
               the same in every frame; of these no effect of the library knows (diagnosis laboratory, 3.4)
    shape      "other": effects with the same cause and size as the library's, but another law, as in OTHER
    unknown    what the library does not have, as in UNKNOWN

`sweep` does the same for readings of the polarizer bench, on the means of `optics.jones`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from optics import captures as capture_files, jones
from optics.noise import Noise
from optics.synthetic import Maker

CAMERA = Noise(system_gain=0.1, dark_noise=2.0, black_level=256.0, saturation=4095.0, prnu=0.0)  # 12 bits, 38 000 electrons
PATTERN, MOTTLE, WRINKLE = 0.005, 0.01, 0.3  # rms: of a gain per pixel, of the coating, deg of the skin's slope; at clutter 1
GRAIN = 0.4  # mm: of mottle and wrinkles

# effect -> how the other law differs; what is not here has one law only
OTHER = {
    "lens vignetting": "1 - 2 a t^2 (1 + 0.6 t^2/t_max^2) of the tangent t, as measured lenses fall off, for cos^(4 a)",
    "veiling glare": "light spreads over a fifth of the picture, not over all of it",
    "lens blur": "an even disc of the same variance, for a Gaussian",
    "colour crosstalk": "three times as much between neighbours in wavelength as between red and blue",
    "residual response curve": "bent more in the shadows: k s (1 - s) (1.6 - 1.2 s)",
    "interreflection": "all bounces, for one",
    "ambient light": "half as much again on one side of the picture as in the middle, half as much on the other",
    "LED size": "a bar along the LED's first side, of the same variance as the disc",
    "gel absorption": "a tenth stronger in red, a tenth weaker in blue",
    "radial distortion": "k (r^2 + r^4/r_max^2)/2",
    "gain drift": "a tenth of it for each channel by itself",
    "gel wedge": "steeper to one side: w x (1 + 0.3 x/half)",
    "gel haze": "forwards (Henyey-Greenstein, g = 0.5)",
}
# kind -> coordinates by any of which it is rightly named
UNKNOWN = {
    "stain": ("place",), "banding": ("row",), "tap": ("column",), "ring": ("radius",), "height gain": ("height", "gel_path"),
    "slope gain": ("slope",), "contact film": ("contact", "contact_distance"), "red drift": ("frame",),
}
# of the bench's readings
UNKNOWN_READINGS = {"third harmonic": ("analyzer.angle",), "warm-up": ("source.time",), "lamp step": ("source.power",),
                    "smeared film": ("polarizer.angle",)}


def smooth(shape: tuple[int, int], sd: float, rng: np.random.Generator) -> np.ndarray:
    """Gaussian noise of the correlation length sd (pixels), rms 1."""
    from scipy.ndimage import gaussian_filter

    found = gaussian_filter(rng.standard_normal(shape), sd, mode="wrap")
    return found / found.std()


class Wild(Maker):
    """A maker of frames with clutter, laws of another shape, and kinds that the library lacks.

    unknown   {kind of UNKNOWN: relative size}: the signal gains (1 + size p), p of order 1
    clutter   1 is what a good sensor has
    light     kept pictures of presses, by geometry: makers that share them make only what differs anew
    """

    def __init__(self, scene, values=None, effects=None, noise: Noise | None = None, seed: int = 0, spp: int = 256, *,
                 unknown: Mapping[str, float] | None = None, clutter: float = 0.0, other: bool = False, kept: dict | None = None):
        super().__init__(scene, values, effects, noise or CAMERA, seed, spp)
        if lacking := set(unknown or {}) - set(UNKNOWN):
            raise ValueError(f"no kind {', '.join(sorted(lacking))}; known: {', '.join(UNKNOWN)}")
        if other and (lacking := set(self.effects) - set(OTHER)):
            raise ValueError(f"{', '.join(sorted(lacking))}: one law only; allowed with another: {', '.join(OTHER)}")
        self.unknown, self.clutter, self.other = dict(unknown or {}), float(clutter), other
        self.kept = {} if kept is None else kept
        width, height = self.size
        rng = np.random.default_rng([seed, 17])
        half = self._half()
        grain = GRAIN / (2 * half / width)  # px
        self.pattern = PATTERN * rng.standard_normal((height, width, 3))
        self.mottle = MOTTLE * smooth((height, width), grain, rng)[..., None]
        self.wrinkle = smooth((256, 256), GRAIN / (24.0 / 256), rng)  # over 24 mm

    def _half(self) -> float:
        """mm: half the width of what is seen of the face."""
        return -self.camera_z * np.tan(np.radians(self.values[f"{self.camera}.x_fov"]) / 2)

    def _tangents(self) -> tuple[np.ndarray, np.ndarray]:
        width, height = self.size
        focal = width / 2 / np.tan(np.radians(self.values[f"{self.camera}.x_fov"]) / 2)
        y, x = np.mgrid[:height, :width] + 0.5
        return (x - width / 2) / focal, (y - height / 2) / focal

    # -- the face -------------------------------------------------------------------------------------------------------

    def mesh(self, press: Sequence[float], pitch: float = 0.02):
        import mitsuba as mi

        mesh = super().mesh(press, pitch)
        bent = self.other and "gel wedge" in self.effects
        if not self.clutter and not bent:
            return mesh
        params = mi.traverse(mesh)
        points = np.array(params["vertex_positions"]).reshape(-1, 3).astype(float)
        normals = np.array(params["vertex_normals"]).reshape(-1, 3).astype(float)
        x, y = points[:, 0], points[:, 1]
        slope_x, slope_y = np.zeros(len(x)), np.zeros(len(x))
        if self.clutter:
            rise, slope_x, slope_y = self._wrinkled(x, y)
            points[:, 2] += rise
        if bent:
            steep = 0.3 * np.tan(np.radians(self.effects["gel wedge"])) / (self.values[f"{self.gel}.width"] / 2)
            points[:, 2] += steep * x**2
            slope_x = slope_x + 2 * steep * x
        sign = np.sign(normals[:, 2:])
        normals = normals / np.abs(normals[:, 2:])  # (-zx, -zy, 1) times the side that they look to
        normals[:, 0] -= sign[:, 0] * slope_x
        normals[:, 1] -= sign[:, 0] * slope_y
        params["vertex_positions"] = mi.Float(points.astype(np.float32).ravel())
        params["vertex_normals"] = mi.Float((normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32).ravel())
        params.update()
        return mesh

    def _wrinkled(self, x, y):
        """Rise (mm) and slopes of the wrinkles: cubic splines of a map whose slope is WRINKLE deg rms at clutter 1."""
        from scipy.ndimage import map_coordinates, spline_filter

        step = 24.0 / 256
        coefficients = spline_filter(self.wrinkle, order=3, mode="grid-wrap")

        def at(dx=0.0, dy=0.0):
            return map_coordinates(coefficients, [(y + dy) / step + 128, (x + dx) / step + 128], order=3, mode="grid-wrap", prefilter=False)

        h = 0.01
        rise, slope_x, slope_y = at(), (at(h) - at(-h)) / (2 * h), (at(0, h) - at(0, -h)) / (2 * h)
        gy, gx = np.gradient(self.wrinkle, step)
        size = self.clutter * np.tan(np.radians(WRINKLE)) / np.sqrt((gx**2 + gy**2).mean())
        return size * rise, size * slope_x, size * slope_y

    # -- light ----------------------------------------------------------------------------------------------------------

    def light(self, press: Sequence[float]) -> dict[str, np.ndarray]:
        key = (self.seed, self.clutter, self.other, tuple(np.round(press, 9)),
               tuple(sorted((n, s) for n, s in self.effects.items() if n not in IN_CAMERA)))
        if key not in self.kept:
            while len(self.kept) > 60:
                self.kept.pop(next(iter(self.kept)))
            self.count = 0
            self.kept[key] = super().light(press)
        light = dict(self.kept[key])
        if self.other and "ambient" in light:
            x, _ = self._tangents()
            light["ambient"] = light["ambient"] * (1 + 0.5 * x / x.max())[..., None]
        return light

    def traced(self, scene, rho, led=None, depth=2):
        if self.other and "interreflection" in self.effects and depth == 3:
            depth = 6
        if not (self.other and "LED size" in self.effects) or led is not None:
            return super().traced(scene, rho, led, depth)
        return self._bar(scene, rho, depth)

    def _bar(self, scene, rho, depth):
        """Three points along the LED's side with the variance of a disc of the area A along a line, A/(4 pi) (scene: of the disc)."""
        import mitsuba as mi

        light = mi.traverse(scene)
        place = [float(np.ravel(np.array(light[f"light.{c}"]))[0]) for c in "xyz"]
        led = min(self.leds, key=lambda n: sum((place[i] - self.values[f"{n}.{c}"]) ** 2 for i, c in enumerate("xyz")))
        mesh = next(s for s in scene.shapes() if s.id() == "face")
        away = np.sqrt(1.5 * self.effects["LED size"] / (4 * np.pi))  # two of three points stand off
        emitter, images = self.emitter(led), []
        for k in (-1, 0, 1):
            at = {c: emitter[c] + k * away * self.frames[led][0][i] for i, c in enumerate("xyz")}
            aimed = {**emitter, **at, "target": [at["x"], at["y"], at["z"] + 1.0]}
            images.append(super().traced(self.scene(mesh, aimed, 2), rho, None, depth))
        return np.mean(images, 0)

    def through_gel(self, image, led, press):
        if not self.other:
            return super().through_gel(image, led, press)
        effects, bands = dict(self.effects), []
        for band, share in enumerate((1.1, 1.0, 0.9)):
            own = {"gel absorption": effects["gel absorption"] * share} if "gel absorption" in effects else {}
            self.effects = {**effects, **own}
            bands.append(super().through_gel(image[..., band:band + 1], led, press))
        self.effects = effects
        out = np.concatenate(bands, -1)
        if "gel haze" in effects:  # the veil alone, weighed by the phase function's ratio at the mean angle of the picture
            self.effects = {"gel absorption": effects["gel haze"]}
            clear = super().through_gel(image, led, press)
            self.effects = effects
            point, camera = self.seen(press)
            lamp = np.array([self.values[f"{led}.{c}"] for c in "xyz"])
            to, back = camera - point, point - lamp
            cos = (to * back).sum(-1) / np.maximum(np.linalg.norm(to, axis=-1) * np.linalg.norm(back, axis=-1), 1e-9)
            phase = (1 - 0.25) / (1 + 0.25 - cos) ** 1.5
            out = clear + (out - clear) * phase[..., None]
        return out

    # -- camera ---------------------------------------------------------------------------------------------------------

    def photograph(self, radiance, rng, frame, exposure: float = 1.0, press: Sequence[float] | None = None):
        image = radiance
        if self.clutter:
            image = image * (1 + self.clutter * self.mottle)
        if self.unknown:
            image = image * self._unknown_gain(press, frame)
        effects, noise, values = self.effects, self.noise, self.values
        if self.other:
            image = self._other_lens(image)
            self.effects = {}
        self.values = {**values, f"{self.camera}.exposure": values[f"{self.camera}.exposure"] * exposure}
        self.noise = Mean(noise)
        try:
            mean = super().photograph(image, rng, frame)
        finally:
            self.effects, self.noise, self.values = effects, noise, values
        signal = (mean - noise.black_level) / (noise.saturation - noise.black_level)
        if self.other:
            signal = self._other_sensor(signal, frame)
        if self.clutter:
            signal = signal * (1 + self.clutter * self.pattern)
        return noise.expose(noise.black_level + (noise.saturation - noise.black_level) * signal, rng)

    def _other_lens(self, image):
        from scipy.ndimage import convolve, gaussian_filter, map_coordinates

        e = self.effects
        x, y = self._tangents()
        t2 = x**2 + y**2
        width, height = self.size
        if "radial distortion" in e:
            focal = width / 2 / np.tan(np.radians(self.values[f"{self.camera}.x_fov"]) / 2)
            xs, ys = x, y
            for _ in range(20):
                r2 = xs**2 + ys**2
                s = 1 + e["radial distortion"] * (r2 + r2**2 / t2.max()) / 2
                xs, ys = x / s, y / s
            at = [ys * focal + height / 2 - 0.5, xs * focal + width / 2 - 0.5]
            image = np.stack([map_coordinates(image[..., c], at, order=3, mode="nearest") for c in range(3)], -1)
        if "lens vignetting" in e:
            image = image * (1 - 2 * e["lens vignetting"] * t2 * (1 + 0.6 * t2 / t2.max()))[..., None]
        if "lens blur" in e:
            disc = _disc(np.sqrt(4 * e["lens blur"]))  # the variance of a disc of radius R is R^2/4 along a line
            image = np.stack([convolve(image[..., c], disc, mode="reflect") for c in range(3)], -1)
        if "veiling glare" in e:
            wide = np.stack([gaussian_filter(image[..., c], width / 5, mode="reflect") for c in range(3)], -1)
            image = image + e["veiling glare"] * (wide - image)
        return image

    def _other_sensor(self, signal, frame: int):
        e = self.effects
        if "gain drift" in e:
            rng = np.random.default_rng([self.seed, frame, 5])
            signal = signal * (1 + e["gain drift"] * (rng.standard_normal() + 0.1 * rng.standard_normal(3)))
        if "colour crosstalk" in e:
            k = e["colour crosstalk"]
            near, far = 1.5 * k, 0.5 * k
            signal = signal @ np.array([[1 - near - far, near, far], [near, 1 - 2 * near, near], [far, near, 1 - near - far]])
        if "residual response curve" in e:
            signal = signal + e["residual response curve"] * signal * (1 - signal) * (1.6 - 1.2 * signal)
        return signal

    def _unknown_gain(self, press, frame: int):
        """(H, W, 1 or 3) gain by the kinds that the library lacks; each pattern is of order 1."""
        from optics.gel import contact

        width, height = self.size
        v, u = (np.mgrid[:height, :width] + 0.5) / np.array([height, width])[:, None, None]
        x, y = self._tangents()
        gain = np.ones((height, width, 1))
        for kind, size in self.unknown.items():
            if kind == "stain":
                p = np.exp(-(((u - 0.7) / 0.12) ** 2 + ((v - 0.35) / 0.1) ** 2) / 2)
            elif kind == "banding":
                p = np.sin(2 * np.pi * 2.6 * v + 0.5)
            elif kind == "tap":
                p = np.where(u < 0.5, 1.0, 0.0)
            elif kind == "ring":
                r = np.sqrt(x**2 + y**2)
                p = np.exp(-(((r / r.max()) - 0.55) / 0.1) ** 2)
            elif kind == "red drift":
                gain = gain * (1 + size * np.random.default_rng([self.seed, frame, 7]).standard_normal() * np.array([1.0, 0, 0]))
                continue
            else:
                point = self.seen(press)[0]
                if kind == "height gain":
                    p = -point[..., 2] / 0.5
                elif kind == "slope gain":
                    p = sum(g**2 for g in np.gradient(point[..., 2], 2 * self._half() / width)) / 0.04
                else:  # a film that the contact leaves
                    p = -contact.surface(point[..., 0], point[..., 1], press[0], press[1], self._touch(press))
            gain = gain * (1 + size * p[..., None])
        return gain

    def _touch(self, press):
        from optics.gel import contact

        v, g = self.values, self.gel
        profile = contact.indenter_profile(v[f"{g}.indenter"], v[f"{g}.indenter_size"], (0.0, 0.0, 0.0), 3.0, 0.03)
        return contact.displacement(profile, press[2], v[f"{g}.thickness"], v[f"{g}.smoothing"], skirt=v.get(f"{g}.skirt", 0.0))[1]

    def shoot(self, shots: Sequence["Shot"], scene_name: str, noted: Noise | None = None) -> capture_files.Captures:
        """A capture set of these shots; `noted`: the noise that is written down (None: the true one)."""
        rng = np.random.default_rng([self.seed, 3])
        frames = []
        for number, shot in enumerate(shots):
            light = self.light(shot.press)
            radiance = sum(p * self.values[f"{led}.power"] * light[led] for led, p in shot.drive.items() if p)
            radiance = radiance + light.get("ambient", 0.0) + np.zeros((*self.size[::-1], 3))
            settings = {f"{led}.power": float(shot.drive.get(led, 0.0)) for led in self.leds}
            settings |= {f"{self.gel}.press_{n}": float(v) for n, v in zip(("x", "y", "depth"), shot.press)}
            settings[f"{self.camera}.exposure"] = float(self.values[f"{self.camera}.exposure"] * shot.exposure)
            image = self.photograph(radiance, rng, number, shot.exposure, shot.press).astype(np.float32)
            frames.append(capture_files.Frame(shot.name, image, None, shot.group, settings, [], f"frames/{shot.name}.png"))
        return capture_files.Captures(Path("."), scene_name, frames, {}, noted or self.noise, None, None, "DN", None, [])


@dataclass(frozen=True)
class Shot:
    """A frame to take: press (x, y, depth in mm), LED drives, exposure over the usual one."""

    name: str
    group: str
    press: tuple[float, float, float]
    drive: Mapping[str, float]
    exposure: float = 1.0


class Mean:
    """A camera without noise: `photograph` gives the mean."""

    def __init__(self, noise: Noise):
        self.black_level, self.saturation = noise.black_level, noise.saturation

    @staticmethod
    def expose(signal, rng):
        return signal


def _disc(radius: float) -> np.ndarray:
    """Kernel of an even disc (px), each cell by its share of 9 x 9 points; sum 1."""
    side = int(np.ceil(radius)) + 1
    at = (np.arange(9 * (2 * side + 1)) + 0.5) / 9 - side - 0.5
    inside = (at[:, None] ** 2 + at**2 <= radius**2).astype(float)
    kernel = inside.reshape(2 * side + 1, 9, 2 * side + 1, 9).mean((1, 3))
    return kernel / kernel.sum()


IN_CAMERA = ("lens vignetting", "veiling glare", "lens blur", "colour crosstalk", "residual response curve", "radial distortion", "gain drift")


# -- readings -----------------------------------------------------------------------------------------------------------

READINGS_NOISE = Noise(0.01, 1.0, 64.0, 4095.0, 0.0)  # 400 000 electrons: 0.3 % at the mean reading
WANDER, JITTER = 0.003, 0.05  # of the lamp, rms relative, in some minutes; deg rms of the analyser; at clutter 1


def bench_light(truth: jones.Truth, settings: jones.Settings, noise: Noise = READINGS_NOISE, turned: np.ndarray | None = None) -> np.ndarray:
    """(n, 1) mean of readings above black, DN, at settings in the model's keys: films that are out (`middle.inserted`, ...) and the
    exposure too, which `jones` knows as parts of the bench. `turned`: deg by which the analyser is off its dial."""
    turned = np.zeros(len(settings)) if turned is None else turned
    light = np.zeros((len(settings), 1))
    sets = [(s.get("middle.inserted", 0.0), s.get("camera.exposure", 1.0)) for s in settings]
    for middle, exposure in sorted(set(sets)):
        own = [i for i, s in enumerate(sets) if s == (middle, exposure)]
        film = replace(truth.p1, offset=0.0, scale=1.0, backlash=0.0) if middle else None  # of the same roll
        bench = replace(truth, pm=film, photodiode=replace(truth.photodiode, gain=truth.photodiode.gain * exposure))
        dials = [{k: v for k, v in settings[i].items() if k in jones.DEFAULTS and (middle or not k.startswith("middle."))} for i in own]
        for i, dial in zip(own, dials):
            dial["analyzer.angle"] = dial["analyzer.angle"] + turned[i]
        light[own] = jones.expected(bench, dials, noise) - noise.black_level
    return light


def sweep(truth: jones.Truth, settings: jones.Settings, seed: int, unknown: Mapping[str, float] | None = None, clutter: float = 0.0,
          noise: Noise = READINGS_NOISE, noted: Noise | None = None) -> capture_files.Captures:
    """Readings of the bench as a capture set with a table; see the module for `unknown` and `clutter`, `bench_light` for settings."""
    if lacking := set(unknown or {}) - set(UNKNOWN_READINGS):
        raise ValueError(f"no kind {', '.join(sorted(lacking))}; known: {', '.join(UNKNOWN_READINGS)}")
    rng = np.random.default_rng([seed, 19])
    count = len(settings)
    light = bench_light(truth, settings, noise, clutter * JITTER * rng.standard_normal(count))
    light = light * (1 + clutter * WANDER * smooth((count, 1), count / 40, rng))
    of = {key: np.array([s.get(key, jones.DEFAULTS[key]) for s in settings])[:, None] for key in jones.DEFAULTS}
    for kind, size in (unknown or {}).items():
        p = {"third harmonic": lambda: np.cos(3 * np.radians(of["analyzer.angle"])),
             "warm-up": lambda: -np.exp(-of["source.time"] / 4.0),
             "lamp step": lambda: (of["source.power"] < 0.75).astype(float),
             "smeared film": lambda: -((of["polarizer.angle"] > 80) & (of["polarizer.angle"] < 120)).astype(float)}[kind]()
        light = light * (1 + size * p)
    values = noise.expose(noise.black_level + light, rng)
    keys = list(dict.fromkeys(key for s in settings for key in s))
    frames = [capture_files.Frame(f"row {i}", value.astype(np.float32).reshape(1, 1, -1),
                                  parameters={key: float(s.get(key, jones.DEFAULTS.get(key, 0.0))) for key in keys})
              for i, (s, value) in enumerate(zip(settings, values))]
    return capture_files.Captures(Path("."), "polarizer_bench", frames, noise=noted or noise,
                                  table=capture_files.Table("readings.csv", ["reading"]))
