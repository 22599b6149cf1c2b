"""Effects that act over the wavelength, hidden on `colour_bench`, where a colour sensor reads LEDs one after the other
through a wave plate, and on `digit` with channels as integrals; both by sums in steps of 1 nm
(optics.proof.makers.colour).

clutter    as of the benches and sensors that these are: wandering lamps and a jittering analyser; pattern, mottle and
           wrinkles
law        "other": effects with the same cause and size as the library's, but another law, as in OTHER of the makers
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from optics.captures import capture_set as capture_files
from optics.captures.noise import Noise
from optics.proof import demo
from optics.proof.cells import Cell
from optics.proof.makers import colour, touch
from optics.proof.makers.colour import Line
from optics.proof.rigs.base import PATTERNS, Mean, Rig, change_of, smooth, strength_at
from optics.proof.rigs.bench import JITTER, PHOTODIODE, WANDER
from optics.proof.rigs.touch import CAMERA, Digit, Shot, Wild
from optics.scene import loader as scenes
from optics.study import loop

SENSOR = "Nikon 5100 (NPL)"
NODES = {"plate": {"bands": "auto 3"}, "lens": {"bands": "auto 2"}}  # both change within the line of an LED
IN_LAMPS = ("LED centre shift", "LED width", "phosphor leak")


class ColourBench(Rig):
    """144 readings of three channels: each of six LEDs, the analyser round in twelve steps, the plate at two angles.
    The powers of the LEDs are known to 1 %, as by a radiometer; the paint, the plate's retardance and the analyser's
    zero are not."""

    name = "colour_bench"
    effects = ("LED centre shift", "LED width", "phosphor leak", "sensitivity tail", "metameric paint",
               "dispersive retardance")  # fmt: skip
    others = effects
    mistakes = ("gain +20 %", "gain -20 %", "black level 0.5 DN")
    defines = NODES["plate"]
    lamps: Mapping[str, colour.Lamp] = {
        "led_blue": (Line(470, 25),),
        "led_cyan": (Line(505, 30),),
        "led_green": (Line(530, 35),),
        "led_amber": (Line(592, 17),),
        "led_red": (Line(625, 20),),
        "led_white": (Line(450, 20, 1.0), Line(560, 120, 4.0)),
    }
    powers = {"led_red": 1.2, "led_white": 1.6}  # of the others 1
    radiometer = 0.01  # relative error of the LEDs' powers
    exposure, retardance = 60000.0, 100.0  # full scale per radiance; deg at 540 nm, as it is sold
    most = {"LED centre shift": 20.0, "LED width": 0.8, "phosphor leak": 0.5, "sensitivity tail": 0.3,
            "metameric paint": 2.0, "dispersive retardance": 0.8}  # fmt: skip
    seen = {
        "LED centre shift": "led_blue.centre_shift",
        "LED width": "led_blue.line_growth",
        "phosphor leak": "led_blue.phosphor_leak",
        "sensitivity tail": "camera.sensitivity_tail",
        "metameric paint": "paint.metamerism",
        "dispersive retardance": "plate.retard_dispersion",
    }

    def built(self, seed: int) -> dict[str, float]:
        """The bench as it is: powers, reflectances, retardance and the analyser's zero."""
        rng = np.random.default_rng([seed, 1])
        values = {
            f"{led}.power": self.powers.get(led, 1.0) * (1 + self.radiometer * rng.uniform(-1, 1)) for led in self.lamps
        }
        values |= {f"paint.rho_{c}": rng.uniform(0.45, 0.75) for c in "rgb"}
        return {**values, "plate.retard_0": self.retardance + 5 * rng.uniform(-1, 1), "analyzer.offset": rng.normal()}

    def settings(self) -> list[dict[str, float]]:
        found = []
        for led in self.lamps:
            for turn in (0.0, 45.0):
                for step in range(12):
                    dials = {"analyzer.angle": 30.0 * step, "plate.angle": turn}
                    found.append({**{f"{n}.power": float(n == led) for n in self.lamps}, **dials})
        return found

    def light(
        self, built: Mapping[str, float], hidden: Mapping[str, float], law: str = "same", turned: np.ndarray | float = 0
    ) -> np.ndarray:
        """(n, 1, 3) share of full scale of every reading; `turned`: deg by which the analyser is off its dial."""
        scene_places = _places(self.name, tuple(self.lamps))
        other, settings = law == "other", self.settings()
        quantum = colour.sensitivities(SENSOR, hidden, other)
        paint = colour.reflectance([built[f"paint.rho_{c}"] for c in "rgb"], hidden, other)
        phase = colour.plate_phase(built["plate.retard_0"], hidden.get("dispersive retardance", 0.0), other)
        dial = np.array([s["analyzer.angle"] for s in settings]) + built["analyzer.offset"] + turned
        plate = np.array([s["plate.angle"] for s in settings])
        passed = colour.between_polarizers(np.zeros(len(dial)), plate, dial, phase)
        scale = self.exposure / colour.unit(list(self.lamps.values()), SENSOR)
        found = np.zeros((len(settings), 1, 3))
        for led, lamp in self.lamps.items():
            own = [i for i, s in enumerate(settings) if s[f"{led}.power"]]
            sent = built[f"{led}.power"] * colour.on_card(scene_places[led])
            weights = quantum * colour.spectrum(lamp, hidden, other) * paint
            found[own, 0] = scale * sent * passed[own] @ weights.T
        return found

    def strength_of(self, effect: str, change: float) -> float:
        built = self.built(0)
        plain = self.light(built, {})
        return strength_at(
            change,
            lambda s: change_of(self.light(built, {effect: s}), plain),
            0.01 * self.most[effect],
            self.most[effect],
        )

    def captures(self, cell: Cell, truth, unknown, *, mean: bool = False) -> capture_files.Captures:
        settings = self.settings()
        rng = np.random.default_rng(zlib.crc32(cell.name.encode()))
        turned = cell.clutter * JITTER * rng.standard_normal(len(settings))
        signal = self.light(self.built(cell.seed), truth, cell.law, turned)
        signal = signal * (1 + cell.clutter * WANDER * smooth((len(settings), 1), len(settings) / 40, rng)[..., None])
        values = PHOTODIODE.black_level + (PHOTODIODE.saturation - PHOTODIODE.black_level) * signal
        values = values if mean else PHOTODIODE.expose(values, rng)
        frames = [
            capture_files.Frame(f"row {i}", value.astype(np.float32).reshape(1, 1, -1), parameters=dict(own))
            for i, (own, value) in enumerate(zip(settings, values))
        ]
        table = capture_files.Table("readings.csv", ["red", "green", "blue"])
        return capture_files.Captures(Path("."), self.name, frames, noise=PHOTODIODE, table=table)

    def setup(self, folder: Path, seed: int) -> loop.Setup:
        found = super().setup(folder, seed)
        found.free = [*(f"{led}.power" for led in self.lamps), "paint.rho_*", "plate.retard_0", "analyzer.offset"]
        found.values = {"plate.retard_0": self.retardance}
        powers = {f"{led}.power": self.powers.get(led, 1.0) for led in self.lamps}
        found.priors = {key: (power, self.radiometer * power) for key, power in powers.items()}
        return found

    def parameters(self, effect: str) -> tuple[dict[str, float], float] | None:
        return {self.seen[effect]: 1.0}, 0.0


def _places(scene: str, leds: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Where LEDs stand, mm, by the scene's text."""
    text, found = scenes.find(scene).read_text(encoding="utf-8"), {}
    for led in leds:
        place = re.search(rf'id="{led}">\s*<point name="position" x="([^"]+)" y="([^"]+)" z="([^"]+)"', text)
        assert place is not None, led
        found[led] = np.array([float(v) for v in place.groups()])
    return found


class WildColour(Wild):
    """`Wild` whose light is summed over the wavelength: stock Mitsuba says how bright a white face is at every pixel,
    the rest is arithmetic."""

    lamps: Mapping[str, colour.Lamp] = {
        "led_red": (Line(625, 17),),
        "led_green": (Line(530, 47),),
        "led_blue": (Line(470, 35),),
    }

    def __init__(self, scene, values, hidden: Mapping[str, float], *arguments, **options):
        self.hidden, self.bent = dict(hidden), options.pop("other")
        super().__init__(scene, values, {}, *arguments, **options)
        self.matrix = np.eye(3)  # `light` gives the channels

    def colour(self, led: str) -> np.ndarray:
        return np.ones(3)

    def light(self, press) -> dict[str, np.ndarray]:
        v, hidden, other = self.values, self.hidden, self.bent
        whole = {f"{self.membrane}.rho_{c}": 1.0 for c in "rgb"}
        moved = bool(set(colour.BENT_BY_LENS) & set(hidden))
        try:
            self.values = {**v, **whole}
            with self.widened(colour.FINE, colour.AROUND) if moved else nullcontext():
                grey = {led: image[..., 0] for led, image in super().light(press).items()}
                ways = {led: self._way(led, press) for led in grey} if "gel yellowing" in hidden else {}
        finally:
            self.values = v
        quantum = colour.sensitivities(SENSOR, hidden, other)
        quantum = quantum * colour.reflectance([v[f"{self.membrane}.rho_{c}"] for c in "rgb"], hidden, other)
        x, y = self._tangents()
        found = {}
        for led, image in grey.items():
            weights = quantum * colour.spectrum(self.lamps[led], hidden, other)
            weights = weights / colour.unit(list(self.lamps.values()), SENSOR)
            if led in ways:
                kept = np.exp(-hidden["gel yellowing"] * ways[led][..., None] * colour.tail_of_yellow(other))
                found[led] = image[..., None] * (kept @ weights.T)
            else:
                field = np.hypot(x, y)
                found[led] = colour.through_lens(image, weights, field, hidden, other)
        return found

    def _way(self, led: str, press) -> np.ndarray:
        """(H, W) mm that light goes inside the gel, there and back."""
        self.effects = {"gel absorption": 1e-3}
        try:
            return -np.log(self.through_gel(np.ones(self.size[::-1] + (1,)), led, press)[..., 0]) / 1e-3
        finally:
            self.effects = {}


class DigitColour(Digit):
    """Four presses, each lit by red, green and blue alone and by all of them, one at 0.4 of the exposure as well, and
    a dark frame; one of the presses is held out. The paint was measured, to 1 %; axes, lobes and heights of the LEDs
    are those of the drawing."""

    name = "digit_colour"
    effects = (
        *IN_LAMPS, "sensitivity tail", "metameric paint", "gel yellowing", "chromatic focus", "lateral colour",
        "filter edge shift",
    )  # fmt: skip
    others = effects
    unknown: Mapping[str, tuple[str, ...]] = {}
    random = ()
    pairs = ()
    mistakes = ("gain +20 %", "gain -20 %", "pattern 0.3 %")
    defines = {
        **NODES["lens"],
        **{f"line_{name}": "" for name in ("red", "green", "blue")},  # Gaussians, as the maker's
        **{f"fwhm_{led.removeprefix('led_')}": f"{lines[0].width:g}" for led, lines in WildColour.lamps.items()},
    }
    samples = 1024  # of a pixel by the maker: with 256, what they miss pulls a yellowing of the gel by 0.2 to 0.4 sd
    several = {
        "LED centre shift": tuple(f"led_{c}.centre_shift" for c in ("red", "green", "blue")),
        "LED width": tuple(f"led_{c}.line_growth" for c in ("red", "green", "blue")),
        "phosphor leak": tuple(f"led_{c}.phosphor_leak" for c in ("red", "green", "blue")),
        "sensitivity tail": ("camera.sensitivity_tail",),
        "metameric paint": ("membrane.metamerism",),
        "gel yellowing": ("gel.yellowing",),
        "chromatic focus": ("camera.chromatic_blur",),
        "lateral colour": ("camera.lateral_colour",),
        "filter edge shift": ("camera.edge_tilt",),
    }
    width, height = 24, 32
    frames = 4

    def scene(self):
        return scenes.load("digit", {"width": str(self.width), "height": str(self.height), **self.defines})

    def built(self, scene, seed: int) -> dict[str, float]:
        drawn = ("z", "pan", "tilt", "mu")
        found = {k: v for k, v in demo.truth(scene, seed).items() if k.rpartition(".")[2] not in drawn}
        return {**found, f"{scene.camera.name}.exposure": self.exposure}

    def shots(self, scene, seed: int):
        at = [tuple(float(v) for v in p) for p in touch.presses(4, seed)]
        leds = list(scene.leds)
        drives = {"all": dict.fromkeys(leds, 1.0), **{led: {led: 1.0} for led in leds}}
        shots = [
            Shot(f"press{k:02d}-{name}", f"press-{k:02d}", press, drive)
            for k, press in enumerate(at)
            for name, drive in drives.items()
        ]
        return [
            *shots,
            Shot("press00-short", "press-00", at[0], drives["all"], 0.4),
            Shot("dark", "press-00", at[0], {}),
        ]

    def captures(self, cell: Cell, truth, unknown, *, mean: bool = False) -> capture_files.Captures:
        scene = self.scene()
        noise: Noise | Mean = Mean(CAMERA) if mean else CAMERA
        maker = WildColour(
            scene,
            self.built(scene, cell.seed),
            truth,
            noise,
            1000 + cell.seed,
            self.samples,
            other=cell.law == "other",
            clutter=cell.clutter,
            pattern=PATTERNS.get(cell.mistake),
            kept=self.kept,
        )
        found = maker.shoot(self.shots(scene, cell.seed), "digit")
        found.noise = CAMERA
        return found

    def setup(self, folder: Path, seed: int) -> loop.Setup:
        found = super().setup(folder, seed)
        found.free = ["led_*.x", "led_*.y", "led_*.power", "membrane.rho_*", "membrane.sigma"]
        paint = {f"membrane.rho_{c}": rho for c, rho in zip("rgb", (0.66, 0.52, 0.40))}
        found.priors = {key: (rho, 0.01 * rho) for key, rho in paint.items()}
        return found
