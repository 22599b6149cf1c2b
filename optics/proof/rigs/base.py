"""What all rigs are: strengths that make a given change, the truth of a cell, and captures as a workshop would hand
them in."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from optics.captures import capture_set as capture_files
from optics.captures.noise import Noise
from optics.proof.cells import MISTAKES, Cell
from optics.study import loop

PATTERN = 0.005  # rms of a fixed gain per pixel of the sensor, at clutter 1
PATTERNS = {"pattern 0.3 %": 0.003, "pattern 1 %": 0.01}  # rms of one that nobody noted


class Rig:
    """A sensor or bench. Strengths are in the units of the effects' own parameters, from where the sensor without them
    has these.

    effects    that can be hidden;                       others     of these, with another law
    unknown    {kind: coordinates by any of which it is rightly named};        pairs, mistakes
    random     effects whose strength is a standard deviation over frames, not a value
    free       what is calibrated (empty: the scene's own);                    defines   of the scene, for maker and
               model
    """

    name = ""
    effects: tuple[str, ...] = ()
    others: tuple[str, ...] = ()
    unknown: Mapping[str, tuple[str, ...]] = {}
    pairs: Sequence[tuple[str, str]] = ()
    mistakes: tuple[str, ...] = MISTAKES
    random: tuple[str, ...] = ()
    cluttered = True
    free: tuple[str, ...] = ()
    defines: Mapping[str, str] = {}
    held_out: tuple[str, ...] | None = None
    outside = False  # a bench of another laboratory, which plans and counts its cells by itself

    def __init__(self):
        self._strengths: dict[tuple[str, float], float] = {}

    # -- what a sensor says of itself ---------------------------------------------------------------------------------
    def captures(
        self, cell: Cell, truth: Mapping[str, float], unknown: Mapping[str, float], *, mean: bool = False
    ) -> capture_files.Captures:
        """Frames with {effect: strength} or {unknown kind: size} in them; `mean`: as they are in the mean, without
        noise."""
        raise NotImplementedError

    def strength_of(self, effect: str, change: float) -> float:
        raise NotImplementedError

    def parameters(self, effect: str) -> tuple[dict[str, float], float] | None:
        """({key: weight}, start) of the sum of parameters that a hidden strength is, from its start; None: nothing to
        compare with."""
        raise NotImplementedError

    def says_the_same(self, cell: Cell) -> Sequence[str]:
        """Effects of the library that mean what is hidden, besides its own name."""
        return ()

    def known(self, scene, seed: int) -> dict[str, float]:
        """Values of the sensor as it was built, by key; empty where it has no such values."""
        return {}

    def parts(self, cell: Cell) -> list[int]:
        """Parts of the image (`optics.proof.measures`) in which an unknown kind acts; empty where it acts
        everywhere."""
        return []

    # -- what follows -------------------------------------------------------------------------------------------------
    def strength(self, effect: str, change: float) -> float:
        """That changes the image by so much (rms over mean, before any calibration); inf where none does."""
        if (effect, change) not in self._strengths:
            self._strengths[effect, change] = change if effect in self.random else self.strength_of(effect, change)
        return self._strengths[effect, change]

    def truth(self, cell: Cell) -> dict[str, float]:
        """{effect or unknown kind: strength} of what is hidden; empty where it cannot be had that strong."""
        if cell.kind == "unknown":
            return {cell.hidden[0]: cell.change / self.unknown_change(cell)}
        found = {e: self.strength(e, cell.change) for e in cell.hidden}
        return found if all(math.isfinite(s) for s in found.values()) else {}

    def unknown_change(self, cell: Cell) -> float:
        """Rms change over the mean signal by an unknown kind of size 1, in the maker's own means."""
        plain, changed = (
            self._signal(self.captures(cell, {}, unknown, mean=True)) for unknown in ({}, {cell.hidden[0]: 0.01})
        )
        return change_of(changed, plain) / 0.01

    @staticmethod
    def _signal(captures: capture_files.Captures) -> np.ndarray:
        """Mean DN above black of all frames, no more than the camera can say."""
        noise = captures.noise
        return np.minimum([f.image for f in captures.frames], noise.saturation) - noise.black_level

    def make(self, folder: Path, cell: Cell) -> dict[str, float]:
        """Write the captures of a cell; returns the truth, {} where the effect cannot be had that strong."""
        truth = self.truth(cell)
        if cell.hidden and not truth:
            return {}
        found = self.captures(cell, *(({}, truth) if cell.kind == "unknown" else (truth, {})))
        found.noise = noted(found.noise, cell.mistake)
        whole = cell.mistake != "demosaiced"
        if not whole:
            for frame in found.frames:
                frame.image = demosaiced(frame.image)
        capture_files.write(found, folder, bits=16 if whole and found.table is None else None)
        return truth

    def setup(self, folder: Path, seed: int) -> loop.Setup:
        return loop.Setup(
            captures=str(folder),
            defines=dict(self.defines),
            free=list(self.free),
            per_group=[],
            seed=seed,
            held_out=None if self.held_out is None else list(self.held_out),
        )


class ImageRig(Rig):
    """A rig whose strengths the model's noise-free images tell: that sets how much is hidden, and takes no part in the
    making.

    several   {effect: keys} that a hidden strength moves together, where it is not the first parameter of the effect
              alone
    most      {effect: strength} that the sensor can have, where that is less than the parameter's bounds
    frames    of a set that strengths are found from
    """

    several: Mapping[str, tuple[str, ...]] = {}
    most: Mapping[str, float] = {}
    frames = 3

    def scene(self):
        raise NotImplementedError

    def built(self, scene, seed: int) -> dict[str, float]:
        """Values of the sensor as it was built."""
        raise NotImplementedError

    def known(self, scene, seed: int) -> dict[str, float]:
        return self.built(self.scene(), seed)

    def parts(self, cell: Cell) -> list[int]:
        from optics.proof.measures import parts_of

        if cell.kind != "unknown" or cell.hidden[0] not in LOCAL:
            return []
        width, height = self.scene().camera.resolution
        return parts_of(SCREENS[cell.hidden[0]](*screen(width, height)))

    def keys(self, scene, effect: str) -> tuple[str, ...]:
        return self.several.get(effect) or (next(iter(scene.keys_of(scene.registry.find_effect(effect)).values()))[0],)

    def start(self, scene, key: str) -> float:
        """What strengths count from: the sensor's own value, without the effect."""
        return float(self.built(scene, 0).get(key, scene.values()[key]))

    def strength_of(self, effect: str, change: float) -> float:
        from optics.fit.scene_model import SceneModel
        from optics.scene.parameter import Values

        captures = self.captures(Cell(self.name, "none", (), 0.0, 0.0, "same", "", 0), {}, {}, mean=True)
        captures.frames = captures.frames[: self.frames]
        scene = self.scene()  # after the captures, whose makers work in another variant
        built, keys = self.built(scene, 0), self.keys(scene, effect)
        start = {key: self.start(scene, key) for key in keys}  # a scene's values follow its predictions
        model = SceneModel(scene, captures, captures.noise)

        def signal(s: float) -> np.ndarray:
            values = {**built, **{key: float(np.clip(start[key] + s, *scene.parameters[key].bounds)) for key in keys}}
            images = np.array(model.predict(Values(values)))
            return np.minimum(images, captures.noise.saturation) - captures.noise.black_level

        plain, first = signal(0.0), scene.parameters[keys[0]]
        return strength_at(
            change,
            lambda s: change_of(signal(s), plain),
            0.1 * first.plausible,
            self.most.get(effect, first.bounds[1] - start[keys[0]]),
        )

    def parameters(self, effect: str) -> tuple[dict[str, float], float] | None:
        if effect in self.random:
            return None
        scene = self.scene()
        key = self.keys(scene, effect)[0]
        return {key: 1.0}, self.start(scene, key)


def change_of(image: np.ndarray, plain: np.ndarray) -> float:
    """Rms of what differs, over the mean of the plain signal."""
    return float(np.sqrt(np.mean((image - plain) ** 2)) / plain.mean())


def strength_at(change: float, changed_by: Callable[[float], float], start: float, most: float) -> float:
    """The strength whose change of the image is so large, by secant steps in the logarithm; inf where `most` does not
    reach it."""
    if changed_by(most) < change:
        return math.inf
    trial = min(start, most)
    for _ in range(12):
        now = changed_by(trial)
        if abs(now / change - 1) < 0.02:
            break
        half = changed_by(trial / 2)
        power = np.clip(math.log(max(now, 1e-15) / max(half, 1e-15)) / math.log(2), 0.3, 3.0)
        trial = min(trial * float(np.clip((change / max(now, 1e-15)) ** (1 / power), 0.05, 20)), most)
    return trial


# -- what is written down wrongly, or done to images -----------------------------------------------------------------
def noted(noise: Noise, mistake: str) -> Noise:
    """What is written down of a camera."""
    if mistake.startswith("gain"):
        return replace(noise, system_gain=noise.system_gain * (1.2 if "+" in mistake else 0.8))
    if mistake.startswith("black"):
        return replace(noise, black_level=noise.black_level + 0.5)
    return noise


def demosaiced(image: np.ndarray) -> np.ndarray:
    """Bilinear: each channel is known at its own places of a Bayer mosaic and interpolated between."""
    from scipy.ndimage import convolve

    channel = capture_files.cfa_channel(image.shape, "RGGB")
    kernel = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]], float)
    out = []
    for c in range(3):
        known = (channel == c).astype(float)
        out.append(convolve(image[..., c] * known, kernel, mode="reflect") / convolve(known, kernel, mode="reflect"))
    return np.stack(out, -1).astype(np.float32)


# -- makers from a workshop ------------------------------------------------------------------------------------------
class Mean:
    """A camera without noise: `photograph` gives the mean."""

    def __init__(self, noise: Noise):
        self.black_level, self.saturation, self.sd = noise.black_level, noise.saturation, noise.sd

    @staticmethod
    def expose(signal, rng):
        return signal


def smooth(shape: tuple[int, int], sd: float, rng: np.random.Generator) -> np.ndarray:
    """Gaussian noise of the correlation length sd (pixels), rms 1."""
    from scipy.ndimage import gaussian_filter

    found = gaussian_filter(rng.standard_normal(shape), sd, mode="wrap")
    return found / found.std()


# gains of order 1 over the image: u across it, v down it, r from its middle to its corners, all to 1
SCREENS: dict[str, Callable] = {
    "stain": lambda u, v, r: np.exp(-(((u - 0.7) / 0.12) ** 2 + ((v - 0.35) / 0.1) ** 2) / 2),
    "banding": lambda u, v, r: np.sin(2 * np.pi * 2.6 * v + 0.5),
    "tap": lambda u, v, r: np.where(u < 0.5, 1.0, 0.0),
    "ring": lambda u, v, r: np.exp(-(((r - 0.55) / 0.1) ** 2)),
}
LOCAL = ("stain", "tap", "ring")  # of these, kinds that act in a part of the image and nowhere else


def screen(width: int, height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(H, W) u across the image, v down it, r from its middle to its corners, all to 1, at the middles of pixels."""
    y, x = np.mgrid[:height, :width] + 0.5
    r = np.hypot(x - width / 2, y - height / 2)
    return x / width, y / height, r / r.max()


class Workshop:
    """For a maker's class: clutter of the camera, gains that no library knows, and effects by another law, about its
    own `photograph`.

    The maker brings values, effects, noise, seed, size, and a photograph(radiance, rng, frame) that ends in
    noise.expose."""

    def furnish(
        self,
        unknown: Mapping[str, float],
        kinds,
        clutter: float = 0.0,
        other: bool = False,
        pattern: float | None = None,
    ) -> None:
        """unknown   {kind: size}: the signal gains (1 + size p), p of order 1
        clutter   1 is what a good sensor has;   pattern   rms of a fixed pattern of the sensor, in place of the
                  clutter's
        other     effects act in `lens` and `sensed`, not in the maker's own photograph
        """
        if lacking := set(unknown) - set(kinds):
            raise ValueError(f"no kind {', '.join(sorted(lacking))}; known: {', '.join(kinds)}")
        self.unknown, self.clutter, self.other = dict(unknown), float(clutter), other
        width, height = self.size
        rng = np.random.default_rng([self.seed, 17])
        self.pattern = (self.clutter * PATTERN if pattern is None else pattern) * rng.standard_normal(
            (height, width, 3)
        )

    def gain(self, kind: str, size: float, frame: int, press) -> np.ndarray:
        """(H, W, 1 or 3) gain by a kind that the library lacks."""
        if kind == "red drift":
            return 1 + size * np.random.default_rng([self.seed, frame, 7]).standard_normal() * np.array([[[1.0, 0, 0]]])
        return 1 + size * SCREENS[kind](*screen(*self.size))[..., None]

    def photograph(self, radiance, rng, frame: int, press=None):
        image = radiance
        for kind, size in self.unknown.items():
            image = image * self.gain(kind, size, frame, press)
        effects, noise = self.effects, self.noise
        if self.other:
            image = self.lens(image)
        self.effects, self.noise = {} if self.other else effects, Mean(noise)
        try:
            mean = super().photograph(image, rng, frame)
        finally:
            self.effects, self.noise = effects, noise
        signal = (mean - noise.black_level) / (noise.saturation - noise.black_level)
        if self.other:
            signal = self.sensed(signal, frame)
        return noise.expose(
            noise.black_level + (noise.saturation - noise.black_level) * signal * (1 + self.pattern), rng
        )
