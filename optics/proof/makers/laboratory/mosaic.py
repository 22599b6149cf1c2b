"""A polarization camera: a panel of four quarters, each of an unknown polarization, seen by pixels with analysers of
their own at 90 45 / 135 0 deg, raw, 12 bits; bare, and behind a film that is turned by hand or by a motor.

Each pixel of each frame is a reading: its analyser's angle is `analyzer.angle`, the film before the camera stands in
the bench's middle, `region` is the quarter that the pixel sees."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from optics.proof.makers.laboratory import folder
from optics.proof.makers.laboratory.bench import REGIONS
from optics.proof.makers.laboratory.photographs import Camera, noise
from optics.proof.makers.laboratory.session import Session, wandering
from optics.proof.makers.laboratory.student import everyday

HEIGHT, WIDTH, FIELD = 12, 16, 1.0  # px, px, deg across: so narrow that all rays are along the axis
CELL = ((90, 45), (135, 0))
FULL, BLACK = 4095.0, 64.0  # DN
UNKNOWN = tuple(
    f"region_{k}_{what}" for k in range(REGIONS) for what in ("level", "q", "u") if (k, what) != (0, "level")
)


@dataclass(frozen=True)
class Mosaic(Session):
    """A session of `frames` raw frames; its settings have a row per pixel."""

    frames: int = 1

    @property
    def turned(self) -> tuple[str, ...]:
        return ("middle",)

    def take(self, hidden, rng: np.random.Generator) -> np.ndarray:
        """(frames, H, W) DN."""
        signal = self.mean(hidden, self.turned_off(rng)).reshape(self.frames, HEIGHT, WIDTH)
        lamp = 1 + self.wander * wandering(self.frames, self.memory, rng)
        return self.meter.shown(signal * lamp[:, None, None], rng)

    @property
    def dials(self) -> tuple[str, ...]:
        """The film stops off its scale; the analysers on the pixels stay."""
        return ("middle.angle",)

    @property
    def clock(self) -> np.ndarray:
        return self.settings["frame"]


def session(rng: np.random.Generator) -> Mosaic:
    angles = np.arange(0.0, 180.0, float(rng.choice([22.5, 30.0, 45.0])))
    inside = np.concatenate([[0.0, 0.0], np.ones(len(angles))])
    frames, count = len(inside), HEIGHT * WIDTH
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    settings = {
        "middle.inserted": np.repeat(inside, count),
        "middle.angle": np.repeat(np.concatenate([[0.0, 0.0], angles]), count),
        "camera.exposure": np.repeat(np.concatenate([[1.0, 0.4], np.ones(len(angles))]), count),
        "analyzer.angle": np.tile(np.array(CELL, float)[row.ravel() % 2, column.ravel() % 2], frames),
        "region": np.tile((2.0 * (row >= HEIGHT // 2) + (column >= WIDTH // 2)).ravel(), frames),
        "frame": np.repeat(np.arange(frames, dtype=float), count),
        "ray.x": np.zeros(frames * count),
        "ray.y": np.zeros(frames * count),
    }
    camera = Camera(
        FULL - BLACK,
        float(rng.uniform(1.0, 4.0)),
        0.0,
        unit="DN",
        gain=float(rng.uniform(0.2, 0.5)),
        black=BLACK,
        top=FULL,
    )
    zeros = {}
    for k in range(REGIONS):
        p, a = rng.uniform(0.0, 0.8), rng.uniform(0, 2 * np.pi)
        zeros |= {f"region_{k}_q": p * np.cos(a), f"region_{k}_u": p * np.sin(a)}
        zeros |= {f"region_{k}_level": rng.uniform(0.6, 1.4)} if k else {}
    found = Mosaic(
        settings,
        {"polarizer.inserted": 0.0},
        camera,
        free=UNKNOWN,
        zeros=zeros,
        frames=frames,
        note=f"polarization camera, {frames} frames",
    )
    made = everyday(found, rng, dial_sd=float(rng.uniform(0.1, 0.6)))
    return replace(made, free=UNKNOWN, zeros=zeros, misread=None, noise_said=made.noise_said or 1.0)


def write(path: Path, made: Mosaic, images: np.ndarray) -> Path:
    """Raw frames as 16 bit PNG files and captures.toml; the film before the camera is the scene's polarizer."""
    from PIL import Image

    (path / "frames").mkdir(parents=True)
    camera = made.meter
    assert isinstance(camera, Camera)
    text = ['scene = "polarization_camera"', f"mosaic = {[list(row) for row in CELL]}"]
    text += ['absent = ["sample"]'] if "sample" in made.absent else []
    text += [*noise(camera, made.noise_said)]
    text += folder.block(
        "parameters", {"camera.x_fov": FIELD, **{k: v for k, v in made.fixed.items() if "camera" in k}}
    )
    text += folder.block("uncertainty", {"polarizer.angle": made.dial_sd}) if made.dials_said else []
    text += folder.exclusions(made)
    for index, image in enumerate(images.astype(np.uint16)):
        name, first = f"frames/{index:02d}.png", index * HEIGHT * WIDTH
        Image.fromarray(image).save(path / name)
        own = {key: float(made.settings[f"middle.{key}"][first]) for key in ("inserted", "angle")}
        stated = {f"polarizer.{key}": value for key, value in own.items()}
        stated["camera.exposure"] = float(made.settings["camera.exposure"][first])
        text += ["[[frames]]", f'image = "{name}"', *folder.block("frames.parameters", stated)]
    (path / "captures.toml").write_text("\n".join(text) + "\n", encoding="utf-8")
    return path
