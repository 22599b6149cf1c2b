"""Sensors that see a pressed gel lit by LEDs: `digit` and `gelsight`, made by stock Mitsuba's path tracer.

`Wild` is `optics.proof.makers.touch.Maker` with the imperfections of a built sensor:

    clutter    c = 1: fixed pattern of the sensor 0.5 % rms, mottle of the coating 1 % rms (0.4 mm), wrinkles of the
               skin of 0.3 deg rms, the same in every frame; no effect of the library describes these
    shape      "other": effects with the same cause and size as the library's, but another law, as in OTHER
    unknown    what the library does not have, as in UNKNOWN
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optics.captures import capture_set as capture_files
from optics.captures.noise import Noise
from optics.proof import demo
from optics.proof.cells import Cell, pairs_of
from optics.proof.makers import in_variant
from optics.proof.makers import touch as synthetic
from optics.proof.rigs.base import PATTERNS, ImageRig, Mean, Workshop, smooth
from optics.scene import loader as scenes

CAMERA = Noise(
    system_gain=0.1, dark_noise=2.0, black_level=256.0, saturation=4095.0, prnu=0.0
)  # 12 bits, 38 000 electrons
MOTTLE, WRINKLE = 0.01, 0.3  # rms: of the coating, deg of the skin's slope; at clutter 1
GRAIN = 0.4  # mm: of mottle and wrinkles
IN_CAMERA = (
    "lens vignetting",
    "veiling glare",
    "lens halo",
    "lens blur",
    "colour crosstalk",
    "residual response curve",
    "radial distortion",
    "gain drift",
    "dark offset",
)

# effect -> how the other law differs; what is not here has one law only
OTHER = {
    "lens vignetting": "1 - 2 a t^2 (1 + 0.6 t^2/t_max^2) of the tangent t, as measured lenses fall off, for cos^(4 a)",
    "veiling glare": "light spreads over a fifth of the image, not over all of it",
    "lens blur": "an even disc of the same variance, for a Gaussian",
    "colour crosstalk": "three times as much between neighbours in wavelength as between red and blue",
    "residual response curve": "bent more in the shadows: k s (1 - s) (1.6 - 1.2 s)",
    "interreflection": "all bounces, for one",
    "ambient light": "half as much again on one side of the image as in the middle, half as much on the other",
    "LED size": "a bar along the LED's first side, of the same variance as the disc",
    "gel absorption": "a tenth stronger in red, a tenth weaker in blue",
    "radial distortion": "k (r^2 + r^4/r_max^2)/2",
    "gain drift": "a tenth of it for each channel by itself",
    "gel wedge": "steeper to one side: w x (1 + 0.3 x/half)",
    "gel haze": "forwards (Henyey-Greenstein, g = 0.5)",
}
# kind -> coordinates by any of which it is rightly named
UNKNOWN = {
    "stain": ("place",),
    "banding": ("row",),
    "tap": ("column",),
    "ring": ("radius",),
    "height bands": ("height", "gel_path"),
    "slope gain": ("slope",),
    "contact film": ("contact", "contact_distance"),
    "red drift": ("frame",),
}


class Wild(Workshop, synthetic.Maker):
    """A maker of frames with clutter, laws of another shape, and kinds that the library lacks: see `Workshop.furnish`.

    kept   images of presses, by geometry: makers that share them make only what differs anew
    """

    def __init__(
        self,
        scene,
        values=None,
        effects=None,
        noise: Noise | Mean = CAMERA,
        seed: int = 0,
        spp: int = 256,
        *,
        unknown: Mapping[str, float] | None = None,
        clutter: float = 0.0,
        other: bool = False,
        pattern: float | None = None,
        kept: dict | None = None,
    ):
        super().__init__(scene, values, effects, noise, seed, spp)
        if other and (lacking := set(self.effects) - set(OTHER)):
            raise ValueError(f"{', '.join(sorted(lacking))}: one law only; allowed with another: {', '.join(OTHER)}")
        self.furnish(unknown or {}, UNKNOWN, clutter, other, pattern)
        self.kept = {} if kept is None else kept
        width, height = self.size
        rng = np.random.default_rng([seed, 18])
        self.mottle = (
            self.clutter * MOTTLE * smooth((height, width), GRAIN / (2 * self._half() / width), rng)[..., None]
        )
        self.wrinkle = smooth((256, 256), GRAIN / (24.0 / 256), rng)  # over 24 mm

    def _half(self) -> float:
        """mm: half the width of what is seen of the face."""
        return -self.camera_z * np.tan(np.radians(self.values[f"{self.camera}.x_fov"]) / 2)

    def _tangents(self) -> tuple[np.ndarray, np.ndarray]:
        width, height = self.size
        focal = width / 2 / np.tan(np.radians(self.values[f"{self.camera}.x_fov"]) / 2)
        y, x = np.mgrid[:height, :width] + 0.5
        return (x - width / 2) / focal, (y - height / 2) / focal

    # -- the face -----------------------------------------------------------------------------------------------------
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
        params["vertex_normals"] = mi.Float(
            (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32).ravel()
        )
        params.update()
        return mesh

    def _wrinkled(self, x, y):
        """Rise (mm) and slopes of the wrinkles: cubic splines of a map whose slope is WRINKLE deg rms at clutter 1."""
        from scipy.ndimage import map_coordinates, spline_filter

        step = 24.0 / 256
        coefficients = spline_filter(self.wrinkle, order=3, mode="grid-wrap")

        def at(dx=0.0, dy=0.0):
            return map_coordinates(
                coefficients, [(y + dy) / step + 128, (x + dx) / step + 128], order=3, mode="grid-wrap", prefilter=False
            )

        h = 0.01
        rise, slope_x, slope_y = at(), (at(h) - at(-h)) / (2 * h), (at(0, h) - at(0, -h)) / (2 * h)
        gy, gx = np.gradient(self.wrinkle, step)
        size = self.clutter * np.tan(np.radians(WRINKLE)) / np.sqrt((gx**2 + gy**2).mean())
        return size * rise, size * slope_x, size * slope_y

    # -- light --------------------------------------------------------------------------------------------------------
    def light(self, press: Sequence[float]) -> dict[str, np.ndarray]:
        key = (
            self.seed,
            self.size,
            self.clutter,
            self.other,
            tuple(np.round(press, 9)),
            tuple(sorted((n, s) for n, s in self.effects.items() if n not in IN_CAMERA)),
        )
        light = dict(self.kept.get(key, {}))
        if not light:
            self.count = 0
            light = super().light(press)
            if not self.wide:  # in parts of pixels, those of sixty presses would take a gigabyte
                while len(self.kept) > 60:
                    self.kept.pop(next(iter(self.kept)))
                self.kept[key] = dict(light)
        if self.other and "ambient" in light:
            x, _ = self._tangents()
            light["ambient"] = light["ambient"] * (1 + 0.5 * x / x.max())[..., None]
        return light

    def traced(self, scene, rho, led=None, depth=2, times=1):
        if self.other and "interreflection" in self.effects and depth == 3:
            depth = 6
        if not (self.other and "LED size" in self.effects) or led is not None:
            return super().traced(scene, rho, led, depth, times)
        return self._bar(scene, rho, depth)

    def _bar(self, scene, rho, depth):
        """Three points along the LED's side with the variance of a disc of the area A along a line, A/(4 pi) (scene: of
        the disc)."""
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
            bands.append(super().through_gel(image[..., band : band + 1], led, press))
        self.effects = effects
        out = np.concatenate(bands, -1)
        if (
            "gel haze" in effects
        ):  # the veil alone, weighed by the phase function's ratio at the mean angle of the image
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

    # -- camera -------------------------------------------------------------------------------------------------------
    def photograph(self, radiance, rng, frame, press=None, exposure: float = 1.0):
        values, key = self.values, f"{self.camera}.exposure"
        self.values = {**values, key: values[key] * exposure}
        try:
            return super().photograph(radiance * (1 + self.mottle), rng, frame, press)
        finally:
            self.values = values

    def lens(self, image):
        from scipy.ndimage import gaussian_filter

        e = self.effects
        x, y = self._tangents()
        t2 = x**2 + y**2
        width, _ = self.size
        if "lens vignetting" in e:
            image = image * (1 - 2 * e["lens vignetting"] * t2 * (1 + 0.6 * t2 / t2.max()))[..., None]
        if "veiling glare" in e:
            wide = np.stack([gaussian_filter(image[..., c], width / 5, mode="reflect") for c in range(3)], -1)
            image = image + e["veiling glare"] * (wide - image)
        return image

    def stretch(self, r2):
        if not self.other:
            return super().stretch(r2)
        x, y = self._tangents()
        return super().stretch((r2 + r2**2 / (x**2 + y**2).max()) / 2)

    def spread(self, plane):
        from scipy.signal import fftconvolve

        if not self.other:
            return super().spread(plane)
        # the variance of a disc of radius R is R^2/4 along a line
        disc = _disc(synthetic.FINE * np.sqrt(4 * self.effects["lens blur"]))
        return fftconvolve(np.pad(plane, disc.shape[0] // 2, "edge"), disc, mode="valid")

    def sensed(self, signal, frame: int):
        e = self.effects
        if "gain drift" in e:
            rng = np.random.default_rng([self.seed, frame, 5])
            signal = signal * (1 + e["gain drift"] * (rng.standard_normal() + 0.1 * rng.standard_normal(3)))
        if "colour crosstalk" in e:
            k = e["colour crosstalk"]
            near, far = 1.5 * k, 0.5 * k
            signal = signal @ np.array(
                [[1 - near - far, near, far], [near, 1 - 2 * near, near], [far, near, 1 - near - far]]
            )
        if "residual response curve" in e:
            signal = signal + e["residual response curve"] * signal * (1 - signal) * (1.6 - 1.2 * signal)
        return signal

    def gain(self, kind: str, size: float, frame: int, press) -> np.ndarray:
        from optics.skin import contact

        if kind not in ("height bands", "slope gain", "contact film"):
            return super().gain(kind, size, frame, press)
        point = self.seen(press)[0]
        if kind == "height bands":  # fringes, as of a film whose thickness goes with the height
            p = np.cos(2 * np.pi * point[..., 2] / 0.4)
        elif kind == "slope gain":
            p = sum(g**2 for g in np.gradient(point[..., 2], 2 * self._half() / self.size[0])) / 0.04
        else:  # a film that the contact leaves
            p = -contact.surface(point[..., 0], point[..., 1], press[0], press[1], self._touch(press))
        return 1 + size * p[..., None]

    def _touch(self, press):
        from optics.skin import contact

        v, g = self.values, self.gel
        profile = contact.indenter_profile(v[f"{g}.indenter"], v[f"{g}.indenter_size"], (0.0, 0.0, 0.0), 3.0, 0.03)
        return contact.displacement(
            profile, press[2], v[f"{g}.thickness"], v[f"{g}.smoothing"], skirt=v.get(f"{g}.skirt", 0.0)
        )[1]

    def shoot(self, shots: Sequence[Shot], scene_name: str) -> capture_files.Captures:
        """A capture set of these shots."""
        rng = np.random.default_rng([self.seed, 3])
        frames = []
        with in_variant(synthetic.VARIANT):
            lights = [self.smeared(shot.press) for shot in shots]
        for number, (shot, light) in enumerate(zip(shots, lights)):
            radiance = self.together(light, shot.drive, number) + light.get("ambient", 0.0)
            radiance = radiance + np.zeros((*self.size[::-1], 3))
            settings = {f"{led}.power": float(shot.drive.get(led, 0.0)) for led in self.leds}
            settings |= {f"{self.gel}.press_{n}": float(v) for n, v in zip(("x", "y", "depth"), shot.press)}
            settings[f"{self.camera}.exposure"] = float(self.values[f"{self.camera}.exposure"] * shot.exposure)
            image = self.photograph(radiance, rng, number, shot.press, shot.exposure).astype(np.float32)
            frames.append(
                capture_files.Frame(shot.name, image, None, shot.group, settings, [], f"frames/{shot.name}.png")
            )
        return capture_files.Captures(Path("."), scene_name, frames, {}, self.noise, None, None, "DN", None, [])


@dataclass(frozen=True)
class Shot:
    """A frame to take: press (x, y, depth in mm), LED drives, exposure over the usual one."""

    name: str
    group: str
    press: tuple[float, float, float]
    drive: Mapping[str, float]
    exposure: float = 1.0


def _disc(radius: float) -> np.ndarray:
    """Kernel of an even disc (px), each cell by its share of 9 x 9 points; sum 1."""
    side = int(np.ceil(radius)) + 1
    at = (np.arange(9 * (2 * side + 1)) + 0.5) / 9 - side - 0.5
    inside = (at[:, None] ** 2 + at**2 <= radius**2).astype(float)
    kernel = inside.reshape(2 * side + 1, 9, 2 * side + 1, 9).mean((1, 3))
    return kernel / kernel.sum()


# -- the sensors -----------------------------------------------------------------------------------------------------
class Touch(ImageRig):
    """12 bits, 38 000 electrons: noise of 1 % at the mean signal of a bright frame."""

    effects = (
        "lens vignetting",
        "veiling glare",
        "lens blur",
        "colour crosstalk",
        "residual response curve",
        "interreflection",
        "ambient light",
        "LED size",
        "gel absorption",
        "radial distortion",
        "gain drift",
        "gel wedge",
        "gel bulge",
        "specular lobe",
        "gel haze",
        "dark offset",
    )
    others = tuple(OTHER)
    unknown = UNKNOWN
    random = ("gain drift", "LED drift")
    width = height = 0
    exposure = 0.0

    def __init__(self):
        super().__init__()
        self.kept: dict = {}

    def scene(self):
        return scenes.load(self.name, {"width": str(self.width), "height": str(self.height)})

    def built(self, scene, seed: int) -> dict[str, float]:
        return {**demo.truth(scene, seed), f"{scene.camera.name}.exposure": self.exposure}

    def shots(self, scene, seed: int) -> list[Shot]:
        raise NotImplementedError

    def captures(self, cell: Cell, truth, unknown, *, mean: bool = False) -> capture_files.Captures:
        scene = self.scene()
        maker = Wild(
            scene,
            self.built(scene, cell.seed),
            truth,
            Mean(CAMERA) if mean else CAMERA,
            1000 + cell.seed,
            unknown=unknown,
            clutter=cell.clutter,
            other=cell.law == "other",
            pattern=PATTERNS.get(cell.mistake),
            kept=self.kept,
        )
        found = maker.shoot(self.shots(scene, cell.seed), self.name)
        found.noise = CAMERA
        return found


class Digit(Touch):
    """Ten presses lit by red, green and blue LEDs at once, one of them at 0.4 of the exposure as well, and a dark
    frame; three of the presses are held out."""

    name = "digit"
    effects = (*Touch.effects, "LED drift")
    pairs = pairs_of([e for e in Touch.effects if e not in ("interreflection", "gain drift")])
    width, height, exposure = 36, 48, 700.0

    def shots(self, scene, seed: int) -> list[Shot]:
        everything = dict.fromkeys(scene.leds, 1.0)
        at = [tuple(float(v) for v in p) for p in synthetic.presses(10, seed)]
        shots = [Shot(f"press{k:02d}", f"press-{k:02d}", p, everything) for k, p in enumerate(at)]
        return [*shots, Shot("press00-short", "press-00", at[0], everything, 0.4), Shot("dark", "press-00", at[0], {})]


class Gelsight(Touch):
    """Eight presses under two of the six white LEDs each, one after the other; one of them at 0.4 of the exposure as
    well, and a dark frame; two of the presses are held out. White light hardly shows crosstalk between colours."""

    name = "gelsight"
    effects = tuple(e for e in Touch.effects if e != "colour crosstalk")
    pairs = pairs_of([e for e in effects if e not in ("interreflection", "gain drift")])
    width, height, exposure = 40, 30, 200.0

    def shots(self, scene, seed: int) -> list[Shot]:
        leds, shots = list(scene.leds), []
        at = [tuple(float(v) for v in p) for p in synthetic.presses(8, seed)]
        for k, press in enumerate(at):
            for step in (0, len(leds) // 2):
                led = leds[(k + step) % len(leds)]
                shots.append(Shot(f"press{k:02d}-{led}", f"press-{k:02d}", press, {led: 1.0}))
        return [
            *shots,
            Shot("press00-short", "press-00", at[0], {leds[0]: 1.0}, 0.4),
            Shot("dark", "press-00", at[0], {}),
        ]
