"""Sensors and benches of the proof: what can be hidden, by which independent path captures are made, how a study of them begins."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from optics import captures as capture_files, demo, jones, loop, scene as scenes, synthetic, synthetic_wild as wild
from optics.effect import registry
from optics.noise import Noise
from optics.proof.cells import MISTAKES, Cell, pairs_of


def strength_at(change: float, change_of: Callable[[float], float], start: float, most: float) -> float:
    """The strength whose change of the picture is so large, by secant steps in the logarithm; inf where `most` does not reach it."""
    if change_of(most) < change:
        return math.inf
    trial = min(start, most)
    for _ in range(12):
        now = change_of(trial)
        if abs(now / change - 1) < 0.02:
            break
        half = change_of(trial / 2)
        power = np.clip(math.log(max(now, 1e-15) / max(half, 1e-15)) / math.log(2), 0.3, 3.0)
        trial = min(trial * float(np.clip((change / max(now, 1e-15)) ** (1 / power), 0.05, 20)), most)
    return trial


class Rig:
    """A sensor or bench. Strengths are in the units of the effects' own parameters, from neutral.

    name, effects (that can be hidden), others (of these, with another law), unknown {kind: coordinates}, pairs, mistakes
    """

    cluttered = True
    others: tuple[str, ...] = ()
    mistakes: tuple[str, ...] = ()
    random = ()  # effects whose strength is a standard deviation, not a value

    def __init__(self):
        self.known: dict[tuple[str, float], float] = {}

    def strength(self, effect: str, change: float) -> float:
        """That changes the picture by so much (rms over mean, before any calibration)."""
        if (effect, change) not in self.known:
            self.known[effect, change] = self._strength(effect, change)
        return self.known[effect, change]

    def truth(self, cell: Cell) -> dict[str, float]:
        """{effect: strength} of what is hidden; empty where it cannot be had that strong."""
        found = {e: self.strength(e, cell.change) for e in cell.hidden}
        return found if all(math.isfinite(s) for s in found.values()) else {}


def _noted(noise: Noise, mistake: str) -> Noise:
    """What is written down of a camera."""
    if mistake.startswith("gain"):
        return replace(noise, system_gain=noise.system_gain * (1.2 if "+" in mistake else 0.8))
    if mistake.startswith("black"):
        return replace(noise, black_level=noise.black_level + 0.5)
    return noise


class Touch(Rig):
    """`digit`: ten presses lit by red, green and blue LEDs at once, one of them at 0.4 of the exposure as well, and a dark frame; three of
    the presses are held out. 12 bits, 38 000 electrons: noise of 1 % at the mean signal."""

    name, scene_name = "digit", "digit"
    width, height, exposure = 36, 48, 700.0
    effects = ("lens vignetting", "veiling glare", "lens blur", "colour crosstalk", "residual response curve", "interreflection",
               "ambient light", "LED size", "gel absorption", "radial distortion", "gain drift", "gel wedge", "gel bulge", "specular lobe",
               "gel haze")
    others = tuple(wild.OTHER)
    unknown = wild.UNKNOWN
    mistakes = MISTAKES
    pairs = pairs_of([e for e in effects if e not in ("interreflection", "gain drift")])
    random = ("gain drift",)
    presses = 10

    def __init__(self):
        super().__init__()
        self.kept: dict = {}

    def scene(self):
        return scenes.load(self.scene_name, {"width": str(self.width), "height": str(self.height)})

    def built(self, scene, seed: int) -> dict[str, float]:
        return {**demo.truth(scene, seed), f"{scene.camera.name}.exposure": self.exposure}

    def shots(self, scene, seed: int) -> list[wild.Shot]:
        everything = {led: 1.0 for led in scene.leds}
        at = [tuple(float(v) for v in p) for p in synthetic.presses(self.presses, seed)]
        shots = [wild.Shot(f"press{k:02d}", f"press-{k:02d}", p, everything) for k, p in enumerate(at)]
        return [*shots, wild.Shot("press00-short", "press-00", at[0], everything, 0.4), wild.Shot("dark", "press-00", at[0], {})]

    def make(self, folder: Path, cell: Cell) -> dict[str, float]:
        """Write the captures of a cell; returns the truth, {} where the effect cannot be had that strong."""
        scene = self.scene()
        truth = {} if cell.kind == "unknown" else self.truth(cell)
        if cell.kind in ("library", "pair") and not truth:
            return {}
        unknown = {cell.hidden[0]: cell.change / self._pattern(scene, cell)} if cell.kind == "unknown" else {}
        pattern = {"pattern 0.3 %": 0.003, "pattern 1 %": 0.01}.get(cell.mistake, 0.0)
        maker = wild.Wild(scene, self.built(scene, cell.seed), truth, seed=1000 + cell.seed, unknown=unknown, clutter=cell.clutter,
                          other=cell.law == "other", kept=self.kept)
        if pattern:
            maker.mottle, maker.wrinkle, maker.clutter = 0 * maker.mottle, None, pattern / wild.PATTERN
            maker.mesh = lambda press, pitch=0.02: synthetic.Maker.mesh(maker, press, pitch)
        found = maker.shoot(self.shots(scene, cell.seed), self.scene_name, _noted(maker.noise, cell.mistake))
        if cell.mistake == "demosaiced":
            for frame in found.frames:
                frame.image = _demosaiced(frame.image)
        capture_files.write(found, folder, bits=None if cell.mistake == "demosaiced" else 16)
        return truth or unknown

    def setup(self, folder: Path, seed: int) -> loop.Setup:
        return loop.Setup(captures=str(folder), per_group=[], seed=seed)

    def _pattern(self, scene, cell: Cell) -> float:
        """Rms change over the mean signal of an unknown kind of size 1, in the maker's own means."""
        built = self.built(scene, cell.seed)
        plain = wild.Wild(scene, built, seed=1000 + cell.seed, kept=self.kept)
        changed = wild.Wild(scene, built, seed=1000 + cell.seed, unknown={cell.hidden[0]: 0.01}, kept=self.kept)
        means = []
        for maker in (plain, changed):
            maker.noise, noise = wild.Mean(maker.noise), maker.noise
            means.append([np.minimum(f.image, noise.saturation) - noise.black_level for f in maker.shoot(self.shots(scene, cell.seed), self.scene_name, noise).frames])
        return float(np.sqrt(np.mean((np.array(means[1]) - means[0]) ** 2)) / np.mean(means[0])) / 0.01

    def _strength(self, effect: str, change: float) -> float:
        """By the model, whose pictures have no noise; this sets how much is hidden and takes no part in the making."""
        if effect in self.random:
            return change
        from optics.parameter import Values
        from optics.render import Model

        scene = self.scene()
        built, parameter = self.built(scene, 0), self._parameter(scene, effect)
        frames = [capture_files.Frame(s.name, np.zeros((self.height, self.width, 3), np.float32), None, s.group,
                                      {**{f"{led}.power": float(s.drive.get(led, 0.0)) for led in scene.leds},
                                       **{f"{scene.gel.name}.press_{n}": v for n, v in zip(("x", "y", "depth"), s.press)}}, [], "")
                  for s in self.shots(scene, 0)[:3]]
        noise = wild.CAMERA
        model = Model(scene, capture_files.Captures(Path("."), self.scene_name, frames, {}, noise, None, None, "DN", None, []), noise)
        key, (low, high), neutral = parameter
        plain = np.array(model.predict(Values(dict(built)))) - noise.black_level
        plain = np.minimum(plain, noise.saturation - noise.black_level)

        def change_of(s: float) -> float:
            image = np.array(model.predict(Values({**built, key: neutral + s}))) - noise.black_level
            image = np.minimum(image, noise.saturation - noise.black_level)
            return float(np.sqrt(np.mean((image - plain) ** 2)) / plain.mean())

        return strength_at(change, change_of, 0.1 * scene.parameters[key].plausible, high - neutral)

    def _parameter(self, scene, effect: str):
        key = next(iter(scene.keys_of(registry().find_effect(effect)).values()))[0]
        p = scene.parameters[key]
        return key, p.bounds, float(p.neutral if p.neutral is not None else p.default)

    def parameters(self, effect: str) -> tuple[dict[str, float], float] | None:
        """({key: weight}, neutral) of the sum of parameters that a hidden strength is, from neutral; None: nothing to compare with."""
        if effect in self.random:
            return None
        key, _, neutral = self._parameter(self.scene(), effect)
        return {key: 1.0}, neutral


def _demosaiced(image: np.ndarray) -> np.ndarray:
    """Bilinear: each channel is known at its own places of a Bayer mosaic and interpolated between."""
    from scipy.ndimage import convolve

    channel = capture_files.cfa_channel(image.shape, "RGGB")
    kernel = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]], float)
    out = []
    for c in range(3):
        known = (channel == c).astype(float)
        out.append(convolve(image[..., c] * known, kernel, mode="reflect") / convolve(known, kernel, mode="reflect"))
    return np.stack(out, -1).astype(np.float32)


class Bench(Rig):
    """`polarizer_bench`: 600 readings of a photodiode, by coherency matrices: five angles of P1, the analyser round and back, two powers
    of the lamp, two angles of the sample; a third of them with a film put in between, or at 0.15 of the exposure, as `optics diagnose`
    advises: without, a leak looks like a hazy sample, and stray light like an offset."""

    name = "polarizer_bench"
    effects = ("polarizer misalignment", "servo scale", "servo backlash", "analyzer wobble", "retardance", "camera gamma", "polarized source",
               "extinction leak", "depolarization", "dark offset", "stray light", "source drift")
    unknown = wild.UNKNOWN_READINGS
    mistakes = ("gain +20 %", "gain -20 %", "black level 0.5 DN")
    # of the rest, the sum of two looks like another: leak and depolarization, offset and stray light
    # and an angle too far on average, which is what a scale does: of opposite sign they leave nothing to be seen
    pairs = [p for p in pairs_of([e for e in effects if e not in ("depolarization", "stray light")])
             if set(p) != {"polarizer misalignment", "servo scale"}]
    count = 600
    most = {"polarizer misalignment": 20, "servo scale": 0.2, "servo backlash": 20, "analyzer wobble": 0.4, "retardance": 80, "camera gamma": 1,
            "polarized source": 0.9, "extinction leak": 0.3, "depolarization": 0.9, "dark offset": 500, "stray light": 1.0, "source drift": 0.03}
    # what of the effect's parameters the readings know: of two films' misalignments, the difference
    seen: Mapping[str, tuple[dict[str, float], float]] = {
        "polarizer misalignment": ({"analyzer.offset": 1.0, "polarizer.offset": -1.0}, 0.0), "servo scale": ({"analyzer.scale": 1.0}, 1.0),
        "servo backlash": ({"analyzer.backlash": 1.0}, 0.0), "analyzer wobble": ({"analyzer.wobble_c": 1.0}, 0.0),
        "camera gamma": ({"camera.gamma": 1.0}, 0.0), "depolarization": ({"sample.depolarization": 1.0}, 0.0),
        "dark offset": ({"camera.offset": 1.0}, 0.0), "source drift": ({"source.drift": 1.0}, 0.0)}

    def settings(self) -> list[dict[str, float]]:
        found = jones.malus_sweep(self.count, polarizer_angles=(0.0, 60.0, 100.0, 190.0, 250.0))
        for i, own in enumerate(found):
            own.update({"source.power": (1.0, 0.5)[i % 2], "sample.angle": (0.0, 45.0)[i // 2 % 2], "middle.inserted": float(i // 4 % 6 == 0),
                        "middle.angle": 20.0, "camera.exposure": 0.15 if i // 4 % 6 == 1 else 1.0})
        return found

    def bench(self, hidden: Mapping[str, float]) -> jones.Truth:
        p1, p2, source, sample, diode, stray = jones.Polarizer(), jones.Polarizer(), jones.Source(), jones.Sample(), jones.Photodiode(gain=2.0), 0.0
        for effect, s in hidden.items():
            if effect == "polarizer misalignment":
                p2 = replace(p2, offset=s)
            elif effect == "servo scale":
                p2 = replace(p2, scale=1 + s)
            elif effect == "servo backlash":
                p2 = replace(p2, backlash=s)
            elif effect == "analyzer wobble":
                p2 = replace(p2, wobble_c=s)
            elif effect == "extinction leak":
                p1, p2 = replace(p1, leak=s), replace(p2, leak=s)
            elif effect == "retardance":
                sample = replace(sample, retardance=s, axis=20.0)
            elif effect == "depolarization":
                sample = replace(sample, depolarization=s)
            elif effect == "polarized source":
                source = replace(source, dop=s, dop_angle=30.0)
            elif effect == "source drift":
                source = replace(source, drift=s)
            elif effect == "camera gamma":
                diode = replace(diode, gamma=1 + s)
            elif effect == "dark offset":
                diode = replace(diode, offset=s)
            else:
                stray = s
        return jones.Truth(p1=p1, p2=p2, source=source, sample=sample, photodiode=diode, stray=stray)

    def mean(self, hidden: Mapping[str, float]) -> np.ndarray:
        return wild.bench_light(self.bench(hidden), self.settings())

    def _strength(self, effect: str, change: float) -> float:
        plain = self.mean({})

        def change_of(s: float) -> float:
            return float(np.sqrt(np.mean((self.mean({effect: s}) - plain) ** 2)) / plain.mean())

        return strength_at(change, change_of, 0.01 * self.most[effect], self.most[effect])

    def make(self, folder: Path, cell: Cell) -> dict[str, float]:
        truth = {} if cell.kind == "unknown" else self.truth(cell)
        if cell.kind in ("library", "pair") and not truth:
            return {}
        unknown = {cell.hidden[0]: 2 * cell.change} if cell.kind == "unknown" else {}  # patterns are of rms 0.3 to 0.7
        capture_files.write(wild.sweep(self.bench(truth), self.settings(), 1000 + cell.seed, unknown, cell.clutter,
                                       noted=_noted(wild.READINGS_NOISE, cell.mistake)), folder)
        return truth or unknown

    def setup(self, folder: Path, seed: int) -> loop.Setup:
        return loop.Setup(captures=str(folder), per_group=[], seed=seed)

    def parameters(self, effect: str) -> tuple[dict[str, float], float] | None:
        return self.seen.get(effect)


RIGS: dict[str, type[Rig]] = {rig.name: rig for rig in (Touch, Bench)}
