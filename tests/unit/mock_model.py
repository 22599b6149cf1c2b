"""A touch sensor in numpy that speaks the language of `optics.fit.model.Model`, to judge `diagnose` on known truths in
seconds.

A plane that balls press into (smooth cap), six point LEDs (two per colour), a camera above. Ten effects, among them
one-sided ones, one whose onset is quadratic (defocus width), one with a strength per frame (flicker); five more exist
that no library holds (stain, banding, height gain, slope gain, drift of the red light). Derivatives are complex steps,
so exact."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np

from optics.captures.capture_set import Frame
from optics.captures.noise import Noise
from optics.diagnosis.statistics import cosines
from optics.errors import Underdetermined
from optics.fit.result import Fit
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter, Values, Variable

STEP = 1e-30
RADIUS, EDGE = 4.0, 0.05  # mm: ball, softness of the rim of the contact
HALF, CAMERA = 4.0, 12.0  # mm: half width of the view, distance of the camera
LEDS = 6

EFFECT_PARAMETERS = {
    "vignetting": Parameter("vignetting", "1", 0.0, (0.0, 1.0), neutral=0.0, plausible=0.3),
    "glare": Parameter("glare", "1", 0.0, (0.0, 0.3), neutral=0.0, plausible=0.01),
    "gamma": Parameter("gamma", "1", 0.0, (-0.5, 0.5), neutral=0.0, plausible=0.1),
    "lobe": Parameter("lobe", "1", 0.0, (-0.9, 3.0), neutral=0.0, plausible=0.3),
    "absorption": Parameter("absorption", "1/mm", 0.0, (0.0, 0.5), neutral=0.0, plausible=0.02),
    "crosstalk": Parameter("crosstalk", "1", 0.0, (0.0, 0.3), neutral=0.0, plausible=0.02),
    "defocus": Parameter("defocus", "px", 0.0, (0.0, 4.0), neutral=0.0, plausible=0.7, squared=True),
    "flicker": Parameter("flicker", "1", 0.0, (-0.5, 0.5), neutral=0.0, plausible=0.02),
    "albedo_x": Parameter("albedo_x", "1/mm", 0.0, (-0.1, 0.1), neutral=0.0, plausible=0.005),
    "albedo_y": Parameter("albedo_y", "1/mm", 0.0, (-0.1, 0.1), neutral=0.0, plausible=0.005),
    "bounce": Parameter("bounce", "1", 0.0, (0.0, 1.0), neutral=0.0, plausible=1.0),
    "stain": Parameter("stain", "1", 0.0, (-0.9, 0.9), neutral=0.0, plausible=0.1),
    "banding": Parameter("banding", "1", 0.0, (-0.5, 0.5), neutral=0.0, plausible=0.02),
    "height_gain": Parameter("height_gain", "1/mm", 0.0, (-0.5, 0.5), neutral=0.0, plausible=0.05),
    "slope_gain": Parameter("slope_gain", "1", 0.0, (-2.0, 2.0), neutral=0.0, plausible=0.3),
    "red_drift": Parameter("red_drift", "1", 0.0, (-0.5, 0.5), neutral=0.0, plausible=0.02),
}
LIBRARY = (
    Effect("vignetting", "camera", ("vignetting",), acts=("radius",), needs="light over the whole image"),
    Effect("glare", "camera", ("glare",), acts=("intensity",), needs="dark and bright regions"),
    Effect("gamma", "camera", ("gamma",), acts=("intensity", "exposure"), needs="frames at two exposures"),
    Effect("LED lobe", "led", ("lobe",), acts=("led angle",), needs="presses at many places"),
    Effect("absorption", "gel", ("absorption",), acts=("led distance",), needs="presses at many places"),
    Effect("crosstalk", "camera", ("crosstalk",), acts=("channel",), needs="coloured light"),
    Effect("defocus", "camera", ("defocus",), onset="secant", acts=("curvature",), needs="sharp rims"),
    Effect("flicker", "camera", ("flicker",), scope="frame", acts=("frame",), needs="several frames"),
    Effect("albedo gradient", "membrane", ("albedo_x", "albedo_y"), acts=("row", "column"), needs="presses"),
    Effect("interreflection", "membrane", ("bounce",), onset="both", acts=("slope",), needs="deep presses"),
)
UNKNOWN = ("stain", "banding", "height_gain", "slope_gain", "red_drift")


class Exact:
    """A model whose predictions have no error of their own, and no geometry: what the mocks of this folder share."""

    monte_carlo = False
    captures = None
    driven = None  # what a frame sets is a light's power itself
    drives: frozenset[str] = frozenset()

    @property
    def size(self) -> float:
        return float(np.prod(self.shape))

    def at(self, values: Values, index: int) -> dict[str, float]:
        return {**self.base, **values.common, **self.frames[index].parameters, **values.frame.get(index, {})}

    def linear_in(self, variable: Variable) -> bool:
        return False

    def usable(self, index: int) -> np.ndarray:
        return np.ones(self.shape, bool)

    def variance(self, values: Values, index: int, prediction: np.ndarray) -> np.ndarray:
        return self.noise.variance(prediction)

    def error_of_estimate(self, values: Values, index: int) -> np.ndarray:
        return np.zeros(self.shape)

    def coordinates(self, values: Values, index: int, seed: int = 0) -> dict[str, np.ndarray]:
        return {}

    def errors_of_settings(self, values: Values, index: int) -> dict[str, np.ndarray]:
        return {}

    def lit_geometry(self, values: Values, index: int) -> dict[str, np.ndarray]:
        return {}

    def wavelengths(self) -> list[float]:
        return [0.0] * self.shape[2]

    def family(self, key: str) -> str:
        return ""

    def imagine(self, frames):
        twin = copy(self)
        twin.frames = [*self.frames, *frames]
        return twin


class MockModel(Exact):
    """The mock; `unit` rescales the unit of parameters, {'vignetting': 100} is per cent."""

    def __init__(
        self,
        presses: int,
        side: int = 28,
        noise: Noise | None = None,
        unit: dict | None = None,
        render_noise: float = 0.0,
    ):
        self.noise = noise or Noise(system_gain=0.02, dark_noise=1.0, black_level=64.0, saturation=1023.0, prnu=0.0)
        self.shape = (side, side, 3)
        self.unit, self.render_noise = unit or {}, render_noise
        self.kept: dict = {}
        self.parameters: dict[str, Parameter] = {}
        self.base: dict[str, float] = {}
        for i in range(LEDS):
            angle = 2 * np.pi * (i + 0.3) / LEDS
            for name, value, plausible in (
                ("x", 9 * np.cos(angle), 0.3),
                ("y", 9 * np.sin(angle), 0.3),
                ("z", 5.0, 0.3),
                ("power", 1.0, 0.1),
            ):
                bounds = (1e-3, 10.0) if name == "power" else (-30.0, 30.0)
                self._add(
                    f"led{i}.{name}",
                    Parameter(
                        name,
                        "1" if name == "power" else "mm",
                        value,
                        bounds,
                        plausible=plausible,
                        role="power" if name == "power" else f"light {name}",
                    ),
                )
        for name, value, bounds in (
            ("press_x", 0.0, (-5.0, 5.0)),
            ("press_y", 0.0, (-5.0, 5.0)),
            ("press_depth", 0.6, (0.05, 2.0)),
        ):
            self._add(f"gel.{name}", Parameter(name, "mm", value, bounds, plausible=0.1, role=name.replace("_", " ")))
        for name, parameter in EFFECT_PARAMETERS.items():
            self._add(f"sensor.{name}", parameter)
        self.frames = [Frame(f"press-{i:02d}", np.zeros(self.shape)) for i in range(presses)]
        centre = (np.arange(side) + 0.5) / side * 2 - 1
        self.x, self.y = np.meshgrid(centre * HALF, centre * HALF)
        self.cosines = cosines(side)
        self.waves = np.add.outer(np.arange(side) ** 2, np.arange(side) ** 2) * (np.pi / side) ** 2
        self.cells = np.random.default_rng(5).standard_normal((side, side))

    def _add(self, key: str, parameter: Parameter) -> None:
        u = self.unit.get(key, self.unit.get(key.split(".")[1], 1.0))
        if u != 1.0:
            low, high = parameter.bounds
            parameter = replace(
                parameter,
                default=parameter.default * u,
                bounds=(low * u, high * u),
                plausible=parameter.plausible * u,
                neutral=None if parameter.neutral is None else parameter.neutral * u,
            )
        self.parameters[key], self.base[key] = parameter, float(parameter.default)

    def _at(self, values: Values, frame: int) -> dict:
        """Every parameter's value in a frame, in the units in which the physics is written."""
        now = self.at(values, frame)
        return {k: v / self.unit.get(k, self.unit.get(k.split(".")[1], 1.0)) for k, v in now.items()}

    # -- the physics --------------------------------------------------------------------------------------------------
    def surface(self, v: dict):
        """Height (mm) and its slopes: a ball's cap with a soft rim."""
        key = tuple(v[f"gel.{a}"] for a in ("press_x", "press_y", "press_depth"))
        if key not in self.kept:
            dx, dy = self.x - key[0], self.y - key[1]
            t = (key[2] - (dx**2 + dy**2) / (2 * RADIUS)) / EDGE
            inside = np.where(t.real > 0, t, 0) + np.log1p(np.exp(-t * np.where(t.real > 0, 1, -1)))
            share = 1 / (1 + np.exp(-t))
            self._keep(key, (EDGE * inside, -share * dx / RADIUS, -share * dy / RADIUS))
        return self.kept[key]

    def _keep(self, key, value) -> None:
        if len(self.kept) > 300:
            self.kept.clear()
        self.kept[key] = value

    def _light(self, i: int, v: dict):
        """What one LED sends to the camera from every point."""
        x, y, z, power = (v[f"led{i}.{a}"] for a in ("x", "y", "z", "power"))
        lobe, absorption = v["sensor.lobe"], v["sensor.absorption"]
        key = (i, x, y, z, lobe, absorption, v["gel.press_x"], v["gel.press_y"], v["gel.press_depth"])
        if key not in self.kept:
            h, sx, sy = self.surface(v)
            lx, ly, lz = x - self.x, y - self.y, z - h
            r2 = lx**2 + ly**2 + lz**2
            r = np.sqrt(r2)
            cos = (lz - sx * lx - sy * ly) / (r * np.sqrt(1 + sx**2 + sy**2))
            light = 60 * np.where(cos.real > 0, cos, 0) / r2
            if lobe != 0:  # an LED looks at the middle of the pad; the lobe is cos^mu of the angle to that axis
                beam = (x * lx + y * ly + z * lz) / (np.sqrt(x**2 + y**2 + z**2) * r)
                light = light * np.exp(lobe * np.log(np.where(beam.real > 0.05, beam, 0.05)))
            if absorption != 0:
                light = light * np.exp(-absorption * (r - 9))
            self._keep(key, light)
        return power * self.kept[key]

    def _blur(self, image, width):
        c = self.cosines
        return np.moveaxis(
            c.T @ (np.exp(-0.5 * width**2 * self.waves) * (c @ np.moveaxis(image, -1, 0) @ c.T)) @ c, 0, -1
        )

    def _image(self, v: dict) -> np.ndarray:
        """Noise-free DN of one frame; analytic in every parameter."""
        h, sx, sy = self.surface(v)
        e = {name: v[f"sensor.{name}"] for name in EFFECT_PARAMETERS}
        image = np.stack([self._light(c, v) + self._light(c + 3, v) for c in range(3)], -1)
        if e["albedo_x"] != 0 or e["albedo_y"] != 0:
            image = image * (1 + e["albedo_x"] * self.x + e["albedo_y"] * self.y)[..., None]
        slope2 = (sx**2 + sy**2)[..., None]
        if e["height_gain"] != 0 or e["slope_gain"] != 0:
            image = image * (1 + e["height_gain"] * h[..., None] + e["slope_gain"] * slope2)
        if e["bounce"] != 0:  # what is tilted sends light to its neighbours
            image = image + e["bounce"] * 0.6 * self._blur(slope2 * image, 3.0)
        if e["vignetting"] != 0:
            image = image * (1 - e["vignetting"] * (1 - 1 / (1 + (self.x**2 + self.y**2) / CAMERA**2) ** 2))[..., None]
        if e["stain"] != 0:
            image = image * (1 - e["stain"] * np.exp(-((self.x - 1.5) ** 2 + (self.y + 1) ** 2) / 1.3))[..., None]
        if e["banding"] != 0:
            image = image * (1 + e["banding"] * np.sin(2.1 * self.y + 0.5))[..., None]
        if e["defocus"] != 0:
            image = self._blur(image, e["defocus"])
        total = image.sum(-1, keepdims=True)
        if e["crosstalk"] != 0:
            image = image + e["crosstalk"] * (total / 2 - 1.5 * image)
        if e["red_drift"] != 0:
            image = image * (1 + e["red_drift"] * np.array([1.0, 0.0, 0.0]))
        image = (image + e["glare"]) * (1 + e["flicker"]) * 0.9
        if e["gamma"] != 0:
            image = np.exp((1 + e["gamma"]) * np.log(np.where(image.real > 1e-6, image, 1e-6)))
        return self.noise.black_level + (self.noise.saturation - self.noise.black_level) * image

    # -- the interface ------------------------------------------------------------------------------------------------
    def predict(self, values: Values, frames=None, seed: int = 0) -> list[np.ndarray]:
        return [self._image(self._at(values, f)) for f in (range(len(self.frames)) if frames is None else frames)]

    def derivatives(self, values, variables, frames=None, secant=None, seed=0):
        secant = secant or {}
        for f in range(len(self.frames)) if frames is None else frames:
            now = self._at(values, f)
            prediction = self._image(now)
            images = {}
            for n, v in enumerate(variables):
                if not v.holds_in(f):
                    continue
                u = self.unit.get(v.keys[0], self.unit.get(v.keys[0].split(".")[1], 1.0))
                if v.name in secant:
                    step = secant[v.name] / u
                    image = (self._image({**now, **{k: now[k] + step for k in v.keys}}) - prediction) / step
                else:
                    image = self._image({**now, **{k: now[k] + 1j * STEP for k in v.keys}}).imag / STEP
                if self.render_noise:
                    rng = np.random.default_rng([seed, f, n])
                    image = image * (1 + self.render_noise * rng.standard_normal(image.shape))
                images[v.name] = image / u
            yield prediction, images

    def usable(self, index: int) -> np.ndarray:
        mask = self.noise.usable(self.frames[index].image)
        own = self.frames[index].mask
        return mask if own is None else mask & own[..., None]

    def coordinates(self, values: Values, index: int, seed: int = 0) -> dict[str, np.ndarray]:
        now = self._at(values, index)
        h, sx, sy = self.surface(now)
        distance = np.hypot(self.x - now["gel.press_x"], self.y - now["gel.press_y"])
        return {
            "radius": np.hypot(self.x, self.y),
            "row": self.y,
            "column": self.x,
            "height": h,
            "slope": np.degrees(np.arctan(np.hypot(sx, sy))),
            "contact": h > 3 * EDGE,
            "contact_distance": distance,
            "intensity": self._image(now),
        }

    # -- roles --------------------------------------------------------------------------------------------------------
    def variable(self, key: str, frame: int | None = None, prior=None) -> Variable:
        name = key if frame is None else f"{key}[{self.frames[frame].name}]"
        return Variable(name, (key,), self.parameters[key], None if frame is None else (frame,), prior)

    def base_variables(self, frames) -> list[Variable]:
        common = [self.variable(f"led{i}.{a}") for i in range(LEDS) for a in ("x", "y", "z", "power")]
        return common + [self.variable(f"gel.{a}", f) for f in frames for a in ("press_x", "press_y", "press_depth")]

    def variables_of(self, effect: Effect) -> list[Variable]:
        frames = range(len(self.frames)) if effect.scope == "frame" else [None]
        return [self.variable(f"sensor.{name}", f) for name in effect.parameter_names for f in frames]


class PointModel(Exact):
    """A photodiode behind a turned polarizer: one reading per frame, a cos^2(angle) + leak + dark + second harmonic."""

    shape = (1, 1, 1)
    parameters = {
        "lamp.power": Parameter("power", "1", 1.0, (0.0, 10.0), plausible=0.1, role="power"),
        "polarizer.angle": Parameter("angle", "deg", 0.0, (-90.0, 90.0), plausible=1.0, role="angle"),
        "polarizer.leak": Parameter("leak", "1", 0.0, (0.0, 1.0), neutral=0.0, plausible=0.02),
        "lamp.drift": Parameter("drift", "1", 0.0, (-1.0, 1.0), neutral=0.0, plausible=0.02),
        "lamp.ripple": Parameter("ripple", "1", 0.0, (-1.0, 1.0), neutral=0.0, plausible=0.02),
    }
    library = (
        Effect("extinction", "polarizer", ("leak",), acts=("analyzer.angle",)),
        Effect("lamp drift", "lamp", ("drift",), acts=("frame",)),
    )

    def __init__(self, angles, rng, **truth):
        self.noise = Noise(0.02, 1.0, 20.0, 4095.0, 0.0, 0.0)
        self.base = {key: float(p.default) for key, p in self.parameters.items()}
        self.frames = [
            Frame(f"reading-{i:02d}", np.zeros(self.shape), parameters={"analyzer.angle": float(a)})
            for i, a in enumerate(angles)
        ]
        true = Values({"polarizer.angle": 3.0, **truth})
        for frame, signal in zip(self.frames, self.predict(true)):
            frame.image = (signal + self.noise.sd(signal) * rng.standard_normal(self.shape)).astype(np.float32)

    def _read(self, v, f):
        turned = np.pi / 180 * (self.frames[f].parameters["analyzer.angle"] - v["polarizer.angle"])
        light = np.cos(turned) ** 2 + v["polarizer.leak"] + v["lamp.ripple"] * np.sin(4 * turned)
        light = light * v["lamp.power"] * (1 + v["lamp.drift"] * (f / len(self.frames) - 0.5))
        return 20.0 + 3000.0 * light * np.ones(self.shape)

    def predict(self, values, frames=None, seed=0):
        return [
            self._read({**self.base, **values.common}, f)
            for f in (range(len(self.frames)) if frames is None else frames)
        ]

    def derivatives(self, values, variables, frames=None, secant=None, seed=0):
        now = {**self.base, **values.common}
        for f in range(len(self.frames)) if frames is None else frames:
            yield (
                self._read(now, f),
                {v.name: self._read({**now, v.keys[0]: now[v.keys[0]] + 1j * STEP}, f).imag / STEP for v in variables},
            )

    def variable(self, key):
        return Variable(key, (key,), self.parameters[key])

    def variables_of(self, effect):
        return [self.variable(f"{effect.part}.{name}") for name in effect.parameter_names]


def simulate(model: MockModel, rng: np.random.Generator, truth: dict | None = None, clutter: float = 0.0) -> Values:
    """Expose the frames of a model with true values of its effects; returns a start near the truth.

    truth    effect parameter -> value, or a list with one value per frame
    clutter  1: fixed pattern 0.5 %, mottle 1 % (4 px), wrinkles 0.3 deg, all of which no effect describes
    """
    from scipy.ndimage import gaussian_filter

    true, start = Values(), Values()
    count = len(model.frames)
    for key in model.parameters:
        if key.startswith("led"):
            u = model.unit.get(key, 1.0)
            size = 0.03 * u if key.endswith("power") else 0.15 * u
            true.common[key] = model.base[key] + size * rng.standard_normal()
            start.common[key] = true.common[key] + size / 3 * rng.standard_normal()
    for f in range(count):
        place = {
            "gel.press_x": rng.uniform(-1.8, 1.8),
            "gel.press_y": rng.uniform(-1.8, 1.8),
            "gel.press_depth": rng.uniform(0.4, 1.0),
        }
        true.frame[f] = {k: v * model.unit.get(k, 1.0) for k, v in place.items()}
        start.frame[f] = {k: (v + 0.02 * rng.standard_normal()) * model.unit.get(k, 1.0) for k, v in place.items()}
        for name, value in (truth or {}).items():
            u = model.unit.get(name, 1.0)
            true.frame[f][f"sensor.{name}"] = float(value[f] if np.ndim(value) else value) * u
    side = model.shape[0]
    smooth = [gaussian_filter(rng.standard_normal((side, side)), 2.0) for _ in range(3)]
    mottle, wrinkle_x, wrinkle_y = (s / s.std() for s in smooth)
    fixed = 0.005 * clutter * rng.standard_normal(model.shape)
    tilt = np.radians(0.3) * clutter
    for f, frame in enumerate(model.frames):
        image = model.predict(true, [f])[0]
        if clutter:
            light = image - model.noise.black_level
            light = light * (1 + 0.01 * clutter * mottle[..., None] + fixed)
            # A wrinkle turns the normal: each channel gains by the tilt towards its own lamps.
            for c in range(3):
                angle = 2 * np.pi * (c + 0.3) / LEDS
                light[..., c] *= 1 + tilt * (wrinkle_x * np.cos(angle) + wrinkle_y * np.sin(angle)) * 0.5
            image = model.noise.black_level + light
        frame.image = model.noise.expose(image, rng).astype(np.float32)
    return start


def raw_change(model: MockModel, values: Values, name: str, size: float) -> float:
    """Rms change of the images by an effect over the mean signal, before any calibration."""
    with_effect = values.copy()
    with_effect.common[f"sensor.{name}"] = size
    change = [b - a for a, b in zip(model.predict(values), model.predict(with_effect))]
    signal = np.mean(model.predict(values)) - model.noise.black_level
    return float(np.sqrt(np.mean(np.square(change))) / signal)


def strength_for(model: MockModel, name: str, change: float) -> float:
    """The strength of an effect that makes a raw change of this size."""
    values = Values(frame={f: {"gel.press_depth": 0.7, "gel.press_x": 0.5} for f in range(1)})
    trial = 0.1 * model.parameters[f"sensor.{name}"].plausible
    for _ in range(6):
        trial *= change / max(raw_change(model, values, name, trial), 1e-12)
    return trial


def mock_fit(
    model, variables, start: Values, frames=None, max_iterations: int = 40, progress=None, robust=False
) -> Fit:
    """Levenberg-Marquardt with weights from the prediction, priors as rows, bounds by clipping."""
    frames = list(range(len(model.frames))) if frames is None else list(frames)
    variables = [v for v in variables if v.frames is None or set(v.frames) & set(frames)]
    if not variables:
        raise Underdetermined("nothing to fit")
    values, damping, history = start.copy(), 1e-4, []
    low, high = (np.array([v.parameter.bounds[i] for v in variables]) for i in (0, 1))

    def read(values):
        out = []
        for v in variables:
            own = values.frame.get(v.frames[0], {}) if v.frames is not None else {}
            out.append(own.get(v.keys[0], values.common.get(v.keys[0], model.base[v.keys[0]])))
        return np.array(out)

    def system(values, sigmas=None):
        gram, score, square, counts, own = np.zeros((len(variables),) * 2), np.zeros(len(variables)), [], [], []
        for i, f in enumerate(frames):
            here = [j for j, v in enumerate(variables) if v.holds_in(f)]
            prediction, images = next(model.derivatives(values, [variables[j] for j in here], [f]))
            use = model.usable(f)
            sigma = np.sqrt(model.noise.variance(prediction)) if sigmas is None else sigmas[i]
            a = np.stack([images[variables[j].name][use] / sigma[use] for j in here], 1)
            r = ((model.frames[f].image - prediction) / sigma)[use]
            gram[np.ix_(here, here)] += a.T @ a
            score[here] += a.T @ r
            square.append(float(r @ r))
            counts.append(r.size)
            own.append(sigma)
        x = read(values)
        for j, v in enumerate(variables):
            if v.prior is not None:
                gram[j, j] += 1 / v.prior[1] ** 2
                score[j] += (v.prior[0] - x[j]) / v.prior[1] ** 2
        return gram, score, square, counts, own

    def chi2(values, sigmas):
        total = 0.0
        for f, sigma in zip(frames, sigmas):
            r = (model.frames[f].image - model.predict(values, [f])[0]) / sigma
            total += float(np.sum(r[model.usable(f)] ** 2))
        return total + sum(((x - v.prior[0]) / v.prior[1]) ** 2 for x, v in zip(read(values), variables) if v.prior)

    converged, reason = False, "iterations"
    for _ in range(max_iterations):
        gram, score, square, counts, sigmas = system(values)
        x = read(values)
        now = chi2(values, sigmas)
        history.append(now)
        scale = 1 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
        active = ~(((x <= low) & (score < 0)) | ((x >= high) & (score > 0)))
        for _ in range(12):
            lhs = gram * scale * scale[:, None] + damping * np.eye(len(x))
            step = np.zeros(len(x))
            step[active] = scale[active] * np.linalg.solve(lhs[np.ix_(active, active)], (scale * score)[active])
            trial = values.copy()
            for v, value in zip(variables, np.clip(x + step, low, high)):
                trial.put(v, value)
            after = chi2(trial, sigmas)
            if after <= now * (1 + 1e-13):
                damping = max(damping / 10, 1e-12)
                break
            damping *= 10
        else:
            converged, reason = True, "no step lowers chi2"
            break
        values = trial
        if now - after < 1e-4 and float(step @ gram @ step) < 1e-2:
            converged, reason = True, "chi2 stands"
            break
    gram, score, square, counts, _ = system(values)
    scale = 1 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    covariance = np.linalg.pinv(gram * scale * scale[:, None], rcond=1e-10, hermitian=True) * scale * scale[:, None]
    return Fit(
        values,
        list(variables),
        read(values),
        covariance,
        sum(square),
        sum(counts) - len(variables),
        frames,
        square,
        counts,
        converged,
        reason,
        history,
    )
