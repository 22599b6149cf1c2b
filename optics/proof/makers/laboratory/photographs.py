"""Photographs between films: a phone's camera sees a sheet beside bare light, 24 x 32 px, red, green and blue, 8 bits.

Each pixel of each photograph is a reading with a direction of its own (`ray.x`, `ray.y`: tangents, right and up), with
the sheet before it or not, and with the number of its photograph. Plans: one film turned; both crossed and turned
together; the sheet turned between crossed films. Exposures are fixed or noted from the file of each photograph."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from optics.proof.makers.laboratory import folder
from optics.proof.makers.laboratory.bench import MOST_FRAMES
from optics.proof.makers.laboratory.phone import COLOURS
from optics.proof.makers.laboratory.session import Meter, Session, wandering
from optics.proof.makers.laboratory.student import everyday

HEIGHT, WIDTH, FIELD = 24, 32, 4.0  # px, px, deg across: a crop about the middle
BLACK = 8.0  # DN
PLANS = ("one film turned", "one film turned", "sheet turned", "crossed and turned together")
PIXEL = ("ray.x", "ray.y", "sample.there", "frame")  # what is a pixel's own, and no setting


@dataclass(frozen=True)
class Camera(Meter):
    """Electrons are counted: `gain` DN each. `black` DN without light, `top` DN the end of the range."""

    gain: float = 0.05
    black: float = BLACK
    top: float = 255.0

    def sd(self, signal: np.ndarray) -> np.ndarray:
        return np.sqrt(self.gain * np.maximum(signal, 0) + self.floor**2 + 1 / 12)

    def shown(self, signal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        # an offset below black is the amplifier's: it is there where no light is
        counted = self.gain * rng.poisson(np.maximum(signal, 0) / self.gain) + np.minimum(signal, 0)
        return np.clip(np.round(self.black + counted + self.floor * rng.standard_normal(signal.shape)), 0, self.top)


@dataclass(frozen=True)
class Photographs(Session):
    """A session of `frames` photographs; its settings have a row per pixel."""

    frames: int = 1

    @property
    def clock(self) -> np.ndarray:
        return self.settings["frame"]

    def take(self, hidden, rng: np.random.Generator) -> np.ndarray:
        """(frames, H, W, 3) DN: the lamp wanders from photograph to photograph."""
        signal = self.mean(hidden, self.turned_off(rng)).reshape(self.frames, HEIGHT, WIDTH, 3)
        lamp = 1 + self.wander * wandering(self.frames, self.memory, rng)
        return self.meter.shown(signal * lamp[:, None, None, None], rng)


def session(rng: np.random.Generator) -> Photographs:
    plan = str(rng.choice(PLANS))
    dial = np.arange(0.0, 180.0, float(rng.choice([10.0, 15.0, 20.0])))
    fixed, free = {"middle.inserted": 0.0}, ()
    if plan == "one film turned":
        settings, free = {"analyzer.angle": dial}, ("analyzer_zero",)
        fixed["polarizer.angle"] = 0.0
    elif plan == "sheet turned":
        settings = {"sample.angle": np.tile(dial, 2), "analyzer.angle": np.repeat([90.0, 0.0], len(dial))}
        fixed["polarizer.angle"] = 0.0
    else:
        settings = {"polarizer.angle": dial, "analyzer.angle": dial + 90.0}
    frames = len(next(iter(settings.values())))
    assert frames <= MOST_FRAMES
    if rng.random() < 0.5:
        settings["camera.exposure"] = rng.choice([1.0, 0.5, 0.25], frames)  # as the phone chose it, in its files
    row, column = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    focal = WIDTH / 2 / math.tan(math.radians(FIELD / 2))
    pixels = {
        "ray.x": (column.ravel() - WIDTH / 2) / focal,
        "ray.y": (HEIGHT / 2 - row.ravel()) / focal,
        "sample.there": (column.ravel() > WIDTH / 2).astype(float),
    }
    count = HEIGHT * WIDTH
    settings = {key: np.repeat(values, count) for key, values in settings.items()}
    settings |= {key: np.tile(values, frames) for key, values in pixels.items()}
    settings["frame"] = np.repeat(np.arange(frames, dtype=float), count)
    camera = Camera(255.0 - BLACK, float(rng.uniform(0.3, 1.0)), 0.0, unit="DN", gain=float(rng.uniform(0.02, 0.1)))
    sheet = rng.random() < 0.5
    retardance = float(rng.choice([120.0, 250.0, 400.0]))
    base, given = ({"plate_0": retardance}, {"sample.retard_0": retardance}) if sheet else ({}, {})
    found = Photographs(
        settings, fixed, camera, COLOURS, base, given, free, note=f"photographs, {plan}, {frames}", frames=frames
    )
    return replace(everyday(found, rng, dial_sd=float(rng.uniform(0.3, 1.0))), misread=None)


def write(path: Path, made: Photographs, images: np.ndarray) -> Path:
    """PNG files and captures.toml, with the settings of each photograph."""
    from PIL import Image

    (path / "frames").mkdir(parents=True)
    camera = made.meter
    assert isinstance(camera, Camera)
    own = [key for key in made.settings if key not in PIXEL]
    text = ['scene = "polarizer_bench"', *folder.known(made), *noise(camera, made.noise_said)]
    stated = {k: v for k, v in made.fixed.items() if k.partition(".")[0] not in made.absent}
    text += folder.block("parameters", {**stated, **made.given, "camera.x_fov": FIELD})
    if "sample" not in made.absent:
        text += ['"sample.region_map" = "halves"']  # the sheet is on the right
    text += folder.uncertainties(made) + folder.exclusions(made)
    for index, image in enumerate(images.astype(np.uint8)):
        name = f"frames/{index:02d}.png"
        Image.fromarray(image).save(path / name)
        text += ["[[frames]]", f'image = "{name}"']
        text += folder.block(
            "frames.parameters", {key: float(made.settings[key][index * HEIGHT * WIDTH]) for key in own}
        )
    (path / "captures.toml").write_text("\n".join(text) + "\n", encoding="utf-8")
    return path


def noise(camera: Camera, said: float) -> list[str]:
    """In the terms of EMVA 1288."""
    return [
        "[noise]",
        f"system_gain = {camera.gain * (said or 1.0) ** 2:.4g}",
        f"dark_noise = {camera.floor * (said or 1.0):.4g}",
        f"black_level = {camera.black:g}",
        f"saturation = {camera.top:g}",
        "prnu = 0.0",
    ]
