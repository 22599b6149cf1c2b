"""`polarizer_bench`: readings of a photodiode behind two or three films, by coherency matrices
(optics.proof.makers.bench).

clutter    c = 1: the lamp wanders by 0.3 % rms in some minutes, the analyser is off its dial by 0.05 deg rms from
           reading to reading
law        "other": effects with the same cause and size as the library's, but another law, as in OTHER
unknown    what the library does not have, as in UNKNOWN
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from optics.captures import capture_set as capture_files
from optics.captures.noise import Noise
from optics.proof.cells import Cell, pairs_of
from optics.proof.makers import bench as jones
from optics.proof.rigs.base import Rig, change_of, smooth, strength_at

PHOTODIODE = Noise(0.01, 1.0, 64.0, 4095.0, 0.0)  # 400 000 electrons: 0.3 % at the mean reading
GAIN = 2.0  # full scale per unit radiance
WANDER, JITTER = 0.003, 0.05  # of the lamp, rms relative; deg rms of the analyser; at clutter 1
# kind -> coordinates by any of which it is rightly named
UNKNOWN = {
    "third harmonic": ("analyzer.angle",),
    "swinging supply": ("source.time",),
    "lamp step": ("source.power",),
    "smeared film": ("polarizer.angle",),
}

# effect -> how the other law differs from that of the library, with its strength s; what is not here has one law only
OTHER = {
    "servo scale": "the ratio changes along the turn: true angle = dial (1 + s dial/360), for dial (1 + s)",
    "servo backlash": "taken up over the first 20 degrees after the film turns back, for at once",
    "analyzer wobble": "s (cos psi + 0.5 cos 2 psi), as of a wedged film that is dusty as well",
    "retardance": "of two sheets with s/2 each, their axes 30 degrees apart",
    "camera gamma": "m^(1 + s (1.4 - 0.8 m)): bent more in the shadows",
    "polarized source": "half as much again at half the power, half as much at the whole",
    "extinction leak": "the analyser's is 1 + 0.6 cos psi of the mean: thinner on one side",
    "depolarization": "the beam meets 1.4 s at one angle of the sheet, 0.6 s at the other: cloudy in places",
    "stray light": "1.3 s in one half of the analyser's turn, 0.7 s in the other",
    "source drift": "warms up, by as much in all: s T (1 - exp(-t/8 min))/(1 - exp(-T/8 min)) in T min, for s t",
}


def bench_light(
    truth: jones.Truth, settings: jones.Settings, noise: Noise = PHOTODIODE, turned: np.ndarray | None = None
) -> np.ndarray:
    """(n, 1) mean of readings above black, DN, at settings in the model's keys: films that are out (`middle.inserted`,
    ...) and the exposure too, which `jones` knows as parts of the bench. `turned`: deg by which the analyser is off its
    dial."""
    turned = np.zeros(len(settings)) if turned is None else turned
    light = np.zeros((len(settings), 1))
    sets = [(s.get("middle.inserted", 0.0), s.get("camera.exposure", 1.0)) for s in settings]
    for middle, exposure in sorted(set(sets)):
        own = [i for i, s in enumerate(sets) if s == (middle, exposure)]
        film = replace(truth.p1, offset=0.0, scale=1.0, backlash=0.0) if middle else None  # of the same roll
        bench = replace(truth, pm=film, photodiode=replace(truth.photodiode, gain=truth.photodiode.gain * exposure))
        dials = [
            {k: v for k, v in settings[i].items() if k in jones.DEFAULTS and (middle or not k.startswith("middle."))}
            for i in own
        ]
        for i, dial in zip(own, dials):
            dial["analyzer.angle"] = dial["analyzer.angle"] + turned[i]
        light[own] = jones.expected(bench, dials, noise) - noise.black_level
    return light


def other_light(effect: str, s: float, settings: jones.Settings, turned: np.ndarray | None = None) -> np.ndarray:
    """`bench_light` with one effect of strength s by its law of OTHER: by turned dials, and by mixtures of benches, as
    light adds up."""
    plain = jones.with_effects({}, GAIN)
    turned = np.zeros(len(settings)) if turned is None else turned
    dial, turn, time, power, way = (
        np.array([row.get(key, jones.DEFAULTS[key]) for row in settings])[:, None]
        for key in ("analyzer.angle", "sample.angle", "source.time", "source.power", "analyzer.approach")
    )
    psi, warmed = np.radians(dial), 1 - np.exp(-time / 8.0)

    def lit(truth: jones.Truth = plain, off: np.ndarray | float = 0.0) -> np.ndarray:
        return bench_light(truth, settings, turned=turned + np.ravel(off))

    def mixed(truth: jones.Truth, share) -> np.ndarray:
        return (1 - share) * lit() + share * lit(truth)

    if effect == "servo scale":
        return lit(off=s * dial**2 / 360)
    if effect == "servo backlash":
        back = np.flatnonzero(
            np.diff(way[:, 0], prepend=np.nan) != 0
        )  # readings before which it turned back, the first among them
        since = np.abs(dial - dial[back[np.searchsorted(back, np.arange(len(dial)), side="right") - 1]])
        return lit(off=s * way * (np.minimum(since / 20, 1) - 0.5))
    if effect == "analyzer wobble":
        return lit() * (1 + s * (np.cos(psi) + 0.5 * np.cos(2 * psi)))
    if effect == "retardance":
        return lit(
            replace(plain, sample=jones.Sample(retardance=s / 2, axis=5.0, stress_retardance=s / 2, stress_axis=35.0))
        )
    if effect == "camera gamma":
        swing = PHOTODIODE.saturation - PHOTODIODE.black_level
        m = lit() / swing
        return swing * m ** (1 + s * (1.4 - 0.8 * m))
    if effect == "polarized source":
        return mixed(replace(plain, source=jones.Source(dop=1.0, dop_angle=30.0)), s * np.where(power < 0.75, 1.5, 0.5))
    if effect == "extinction leak":
        half = replace(plain, p1=replace(plain.p1, leak=s))
        leaky = replace(half, p2=replace(plain.p2, leak=s))
        return lit(half) + (1 + 0.6 * np.cos(psi)) * (lit(leaky) - lit(half))
    if effect == "depolarization":
        hazy = replace(plain, sample=jones.Sample(depolarization=1.0))
        return mixed(hazy, s * np.where(turn < 22.5, 1.4, 0.6))
    if effect == "stray light":
        return lit() + (lit(replace(plain, stray=s)) - lit()) * (1 + 0.3 * np.sign(np.sin(psi)))
    if effect == "source drift":
        return lit() * (1 + s * time.max() * warmed / warmed.max())
    raise ValueError(f"{effect}: one law only; allowed with another: {', '.join(OTHER)}")


def gain(kind: str, settings: jones.Settings) -> np.ndarray:
    """(n, 1) relative gain of the readings, less 1, by a kind of UNKNOWN of size 1."""
    analyzer, polarizer, time, power = (
        np.array([s.get(key, jones.DEFAULTS[key]) for s in settings])[:, None]
        for key in ("analyzer.angle", "polarizer.angle", "source.time", "source.power")
    )
    return {
        "third harmonic": lambda: np.cos(3 * np.radians(analyzer)),
        "swinging supply": lambda: np.sin(time / 3.0),
        "lamp step": lambda: (power < 0.75).astype(float),
        "smeared film": lambda: -((polarizer > 80) & (polarizer < 120)).astype(float),
    }[kind]()


def sweep(
    light: Callable[..., np.ndarray],
    settings: jones.Settings,
    seed: int,
    unknown: Mapping[str, float] | None = None,
    clutter: float = 0.0,
    mean: bool = False,
) -> capture_files.Captures:
    """Readings of a bench as a capture set with a table. `light(settings, turned=)`: `bench_light` or `other_light` of
    a bench; see the module for `unknown` and `clutter`."""
    rng = np.random.default_rng([seed, 19])
    count = len(settings)
    signal = light(settings, turned=clutter * JITTER * rng.standard_normal(count))
    signal = signal * (1 + clutter * WANDER * smooth((count, 1), count / 40, rng))
    for kind, size in (unknown or {}).items():
        signal = signal * (1 + size * gain(kind, settings))
    values = PHOTODIODE.black_level + signal
    values = values if mean else PHOTODIODE.expose(values, rng)
    keys = list(dict.fromkeys(key for s in settings for key in s))
    frames = [
        capture_files.Frame(
            f"row {i}",
            value.astype(np.float32).reshape(1, 1, -1),
            parameters={key: float(s.get(key, jones.DEFAULTS.get(key, 0.0))) for key in keys},
        )
        for i, (s, value) in enumerate(zip(settings, values))
    ]
    return capture_files.Captures(
        Path("."), "polarizer_bench", frames, noise=PHOTODIODE, table=capture_files.Table("readings.csv", ["reading"])
    )


class Bench(Rig):
    """600 readings: five angles of P1, the analyser round and back, two powers of the lamp, two angles of the sample; a
    third of them with a film put in between, or at 0.15 of the exposure, as `optics diagnose` advises: without, a leak
    looks like a hazy sample, and stray light like an offset."""

    name = "polarizer_bench"
    effects = (
        "polarizer misalignment",
        "servo scale",
        "servo backlash",
        "analyzer wobble",
        "retardance",
        "camera gamma",
        "polarized source",
        "extinction leak",
        "depolarization",
        "dark offset",
        "stray light",
        "source drift",
    )
    others, unknown = tuple(OTHER), UNKNOWN
    mistakes = ("gain +20 %", "gain -20 %", "black level 0.5 DN")
    # of the rest, the sum of two looks like another: leak and depolarization, offset and stray light
    # and an angle too far on average, which is what a scale does: of opposite sign they leave nothing to be seen
    pairs = [
        p
        for p in pairs_of([e for e in effects if e not in ("depolarization", "stray light")])
        if set(p) != {"polarizer misalignment", "servo scale"}
    ]
    count = 600
    most = {
        "polarizer misalignment": 20,
        "servo scale": 0.2,
        "servo backlash": 20,
        "analyzer wobble": 0.4,
        "retardance": 80,
        "camera gamma": 1,
        "polarized source": 0.9,
        "extinction leak": 0.3,
        "depolarization": 0.9,
        "dark offset": 500,
        "stray light": 1.0,
        "source drift": 0.03,
    }
    # what of the effect's parameters the readings know: of two films' misalignments, the difference
    seen: Mapping[str, tuple[dict[str, float], float]] = {
        "polarizer misalignment": ({"analyzer.offset": 1.0, "polarizer.offset": -1.0}, 0.0),
        "servo scale": ({"analyzer.scale": 1.0}, 1.0),
        "servo backlash": ({"analyzer.backlash": 1.0}, 0.0),
        "analyzer wobble": ({"analyzer.wobble_c": 1.0}, 0.0),
        "camera gamma": ({"camera.gamma": 1.0}, 0.0),
        "depolarization": ({"sample.depolarization": 1.0}, 0.0),
        "dark offset": ({"camera.offset": 1.0}, 0.0),
        "source drift": ({"source.drift": 1.0}, 0.0),
    }

    def settings(self) -> list[dict[str, float]]:
        found = jones.malus_sweep(self.count, polarizer_angles=(0.0, 60.0, 100.0, 190.0, 250.0))
        for i, own in enumerate(found):
            own.update(
                {
                    "source.power": (1.0, 0.5)[i % 2],
                    "sample.angle": (0.0, 45.0)[i // 2 % 2],
                    "middle.inserted": float(i // 4 % 6 == 0),
                    "middle.angle": 20.0,
                    "camera.exposure": 0.15 if i // 4 % 6 == 1 else 1.0,
                }
            )
        return found

    def light(self, hidden: Mapping[str, float]) -> Callable[..., np.ndarray]:
        return partial(bench_light, jones.with_effects(hidden, GAIN))

    def mean(self, hidden: Mapping[str, float]) -> np.ndarray:
        return self.light(hidden)(self.settings())

    def strength_of(self, effect: str, change: float) -> float:
        plain = self.mean({})
        return strength_at(
            change, lambda s: change_of(self.mean({effect: s}), plain), 0.01 * self.most[effect], self.most[effect]
        )

    def captures(self, cell: Cell, truth, unknown, *, mean: bool = False) -> capture_files.Captures:
        light = partial(other_light, *next(iter(truth.items()))) if cell.law == "other" else self.light(truth)
        own = zlib.crc32(cell.name.encode())  # noise and clutter that no other cell of its round has
        return sweep(light, self.settings(), own, unknown, cell.clutter, mean)

    def parameters(self, effect: str) -> tuple[dict[str, float], float] | None:
        return self.seen.get(effect)
