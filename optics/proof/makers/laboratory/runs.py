"""Runs up and down: a film is turned from 0 to 360 deg and back, over and over, each way a run that has a name.

Two to six runs, at one power of the lamp or two, by hand or by a motor, with the time of each reading and the side from
which its dial was approached. The gain of the meter is fixed, and stated; the lamp wanders over ten readings or more.
Where runs are held out, what one of them alone shows must not be asked of the others."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from optics.proof.makers.laboratory.session import Meter, Session
from optics.proof.makers.laboratory.student import everyday


def session(rng: np.random.Generator) -> Session:
    up = np.arange(0.0, 360.1, float(rng.choice([6.0, 10.0])))
    count = int(rng.integers(2, 7))
    way = np.repeat(np.resize([1.0, -1.0], count), len(up))
    dial = np.concatenate([up if k % 2 == 0 else up[::-1] for k in range(count)])
    settings = {"analyzer.angle": dial, "analyzer.approach": way}
    settings["source.time"] = np.round(np.cumsum(rng.uniform(0.1, 0.4, len(dial))), 2)
    if rng.random() < 0.4:
        settings["source.power"] = np.where(np.arange(len(dial)) < len(up) * (count // 2), 1.0, 0.6)
    meter = Meter(
        5000.0, float(rng.uniform(2.0, 8.0)), float(rng.uniform(0.001, 0.003)), ((math.inf, 1.0),), "V", 1000.0, 3
    )
    found = Session(
        settings,
        {"middle.inserted": 0.0, "polarizer.angle": 0.0, "camera.gain": 1.0},
        meter,
        free=("analyzer_zero",),
        runs=np.repeat([f"run {k + 1}" for k in range(count)], len(up)),
        note=f"{count} runs up and down",
    )
    motor = rng.random() < 0.5
    found = everyday(found, rng, dial_sd=0.0 if motor else float(rng.uniform(0.1, 0.5)), encoder=0.25 if motor else 0.0)
    return replace(found, misread=None, memory=float(rng.uniform(10.0, 60.0)))
