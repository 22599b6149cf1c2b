"""A session on a bench: what is turned and noted, the instrument, and what goes wrong every day.

Everyday imperfections of every session: the dial's own reading error (or an encoder's step), a lamp that wanders slowly
(Ornstein-Uhlenbeck), the steps of the instrument, zeros of the scales that nobody knows, and now and then a row that
was read ten degrees off."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from optics.proof.makers.laboratory.bench import FILMS, GREEN, Bench, Settings, reading
from optics.proof.makers.laboratory.causes import both

DIALS = (*(f"{film}.angle" for film in FILMS), "sample.angle")


@dataclass(frozen=True)
class Meter:
    """What reads: `full` DN per unit of light, noise of `floor` DN and of the share `relative` of a reading, in steps.

    steps      ((up to, step), ...) in DN: an instrument that changes range
    unit       of a reading as written, with so many decimals;   per   DN per unit
    clipped    whether it shows nothing below 0
    """

    full: float
    floor: float
    relative: float
    steps: tuple[tuple[float, float], ...] = ((math.inf, 1.0),)
    unit: str = "mV"
    per: float = 1.0
    decimals: int = 0
    clipped: bool = False

    def sd(self, signal: np.ndarray) -> np.ndarray:
        """DN of a signal, its own step included."""
        step = self.step(signal)
        return np.sqrt(self.floor**2 + (self.relative * signal) ** 2 + step**2 / 12)

    def step(self, signal: np.ndarray) -> np.ndarray:
        tops = np.array([top for top, _ in self.steps])
        return np.array([step for _, step in self.steps])[np.searchsorted(tops, np.abs(signal)).clip(0, len(tops) - 1)]

    def shown(self, signal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """DN as written down, of a signal without noise."""
        noisy = signal + rng.standard_normal(signal.shape) * np.hypot(self.floor, self.relative * signal)
        step = self.step(noisy)
        return np.clip(np.round(noisy / step) * step, 0.0 if self.clipped else -math.inf, self.full)


@dataclass(frozen=True)
class Session:
    """settings   scene key -> (n,) as written down, columns of the table;   fixed   the same in every reading
    base       numbers of the bench as its owner describes it (a plate that is there)
    given      {scene key: value} by which he describes it
    free       numbers of the bench that he does not know and solves for, besides the lamp's power: zeros of dials
    zeros      what they really are, deg
    dial_sd    deg, of each setting of a dial by hand;     encoder   deg, step of an encoder: 0, none
    wander     relative rms of the lamp, correlated over `memory` readings;   flicker   relative, of the mains
    misread    index of a row whose dial was read 10 deg off; None
    noise_said, dials_said, absent, exclude    what he writes: share of the true noise (0: nothing of it), whether dial
               errors are stated
    runs       (n,) names of the runs that readings belong to, which are held out together; None: none has a name
    radians, continental, headed    how: angles in rad, commas for points, a line before the names of the columns
    power      of the lamp;   plate_in   False: what is turned is a sample holder, empty unless something is hidden in
               it
    """

    settings: dict[str, np.ndarray]
    fixed: dict[str, float]
    meter: Meter
    bands: tuple[float, ...] = (GREEN,)
    base: dict[str, float] = field(default_factory=dict)
    given: dict[str, float] = field(default_factory=dict)
    free: tuple[str, ...] = ()
    zeros: dict[str, float] = field(default_factory=dict)
    dial_sd: float = 0.0
    encoder: float = 0.0
    wander: float = 0.0
    memory: float = 10.0
    flicker: float = 0.0
    misread: int | None = None
    noise_said: float = 1.0
    dials_said: bool = False
    absent: tuple[str, ...] = ()
    exclude: Mapping[str, str] = field(default_factory=dict)
    runs: np.ndarray | None = None
    radians: bool = False
    continental: bool = False
    headed: bool = False
    power: float = 2.0
    plate_in: bool = True
    note: str = ""

    @property
    def count(self) -> int:
        return len(next(iter(self.settings.values())))

    @property
    def turned(self) -> tuple[str, ...]:
        """Films whose dials move."""
        return tuple(f for f in FILMS if f"{f}.angle" in self.settings and self.inside(f))

    def inside(self, film: str) -> bool:
        return bool(self.fixed.get(f"{film}.inserted", 0.0 if film == "middle" else 1.0))

    @property
    def all_settings(self) -> dict[str, np.ndarray]:
        return {**{key: np.full(self.count, value) for key, value in self.fixed.items()}, **self.settings}

    def owner(self) -> dict[str, float]:
        """The bench as it is when nothing is hidden: lamp, zeros, what its owner knows."""
        return both({f"power_{band}": self.power for band in range(len(self.bands))}, self.base, self.zeros)

    def mean(self, hidden: Bench, settings: Settings | None = None) -> np.ndarray:
        """(n, C) DN, without noise, at the settings as written or at others."""
        return reading(
            both(self.owner(), hidden), self.all_settings if settings is None else settings, self.bands, self.meter.full
        )

    def turned_off(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """The settings as they really were: each time that a dial moves, it stops a little off what is written."""
        found = self.all_settings
        for key in self.dials:
            stay = self.stays(key) - 1
            error = self.dial_sd * rng.standard_normal(stay[-1] + 1)
            error = error + self.encoder * rng.uniform(-0.5, 0.5, stay[-1] + 1)
            found[key] = found[key] + error[stay]
            if self.misread is not None and key == f"{(self.turned or ('analyzer',))[0]}.angle":
                found[key][self.misread] += 10.0
        return found

    def lamp_seen(self) -> float:
        """How far the lamp wanders from frame to frame, in standard deviations of the mean of a frame."""
        frames = len(np.unique(self.settings["frame"]))
        lit = np.square(self.mean({}) / self.meter.sd(self.mean({})))
        return self.wander * math.sqrt(float(lit.sum()) / frames)

    def take(self, hidden: Bench, rng: np.random.Generator) -> np.ndarray:
        """(n, C) DN as written down."""
        signal = self.mean(hidden, self.turned_off(rng))
        lamp = 1 + self.wander * wandering(self.count, self.memory, rng)
        lamp = lamp + self.flicker * np.sin(2 * np.pi * (0.37 * np.arange(self.count) + rng.uniform()))
        return self.meter.shown(signal * lamp[:, None], rng)

    @property
    def dials(self) -> tuple[str, ...]:
        """Keys of the dials that stop off what is written."""
        return tuple(key for key in DIALS if key in self.settings)

    @property
    def clock(self) -> np.ndarray:
        """(n,) steps by which the lamp wanders."""
        return np.arange(self.count, dtype=float)

    def stays(self, key: str) -> np.ndarray:
        """(n,) number of the setting of a dial at which each reading was taken."""
        return np.cumsum(np.diff(self.settings[key], prepend=np.nan) != 0)

    def off(self, hidden: Bench, key: str) -> tuple[np.ndarray, np.ndarray]:
        """(n, C) DN each: what 1 sd of a dial's error does, in first and in second order."""
        sd = math.hypot(self.dial_sd, self.encoder / math.sqrt(12))
        here = self.mean(hidden)
        up, down = (self.mean(hidden, {**self.all_settings, key: self.settings[key] + d}) for d in (sd, -sd))
        return (up - down) / 2, (up + down - 2 * here) / math.sqrt(2)

    def sd(self, hidden: Bench) -> np.ndarray:
        """(n, C) DN of a reading: the instrument, the dials and the lamp, each reading by itself."""
        signal = self.mean(hidden)
        variance = self.meter.sd(signal) ** 2 + (self.wander * signal) ** 2
        for key in self.dials:
            variance += sum(np.square(part) for part in self.off(hidden, key))
        return np.sqrt(variance)

    def covariance(self, hidden: Bench, keep: np.ndarray) -> np.ndarray:
        """(m C, m C) DN^2 of the readings `keep` (m,), which stand for all: with the errors that readings at one
        setting share, and the lamp's, which is correlated over `memory`."""
        signal = self.mean(hidden)[keep]
        rows, channels = signal.shape
        row = np.repeat(np.arange(rows), channels)
        found = np.diag(np.ravel(self.meter.sd(signal)) ** 2) * rows / self.count
        for key in self.dials:
            stay = self.stays(key)
            share = len(np.unique(stay[keep])) / len(np.unique(stay))
            same = (stay[keep][:, None] == stay[keep])[row][:, row] * share
            for part in self.off(hidden, key):
                found += same * np.outer(part[keep], part[keep])
        lamp = np.exp(-np.abs(self.clock[keep][:, None] - self.clock[keep]) / max(self.memory, 1e-6))
        return found + self.wander**2 * lamp[row][:, row] * np.outer(signal, signal)


def wandering(count: int, memory: float, rng: np.random.Generator) -> np.ndarray:
    """Ornstein-Uhlenbeck, rms 1, correlated over `memory` steps."""
    keep = math.exp(-1 / max(memory, 1e-6))
    steps = rng.standard_normal(count)
    found = np.empty(count)
    found[0] = steps[0]
    for i in range(1, count):
        found[i] = keep * found[i - 1] + math.sqrt(1 - keep * keep) * steps[i]
    return found
