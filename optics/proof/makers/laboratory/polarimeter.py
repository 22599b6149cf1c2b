"""A polarimeter: a plate is turned between two films, or a film behind a plate, by lamp, LED or laser, in one band or
three.

Plans: a plate turned between films that stand crossed, then parallel; a plate turned between parallel films; an
analyser turned behind a plate at several angles. The plate is one of a catalogue, with its retardance, or an unknown
sample. The light source has slow noise of its own."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from optics.proof.makers.laboratory.bench import GREEN
from optics.proof.makers.laboratory.session import Meter, Session
from optics.proof.makers.laboratory.student import everyday

PLANS = ("sample turned", "sample turned", "catalogue plate turned", "analyser behind the sample")
LEDS = (625.0, 530.0, 470.0)  # nm


def session(rng: np.random.Generator) -> Session:
    plan = str(rng.choice(PLANS))
    bands = LEDS if rng.random() < 0.5 else (GREEN,)
    turn = np.arange(0.0, 360.0, float(rng.choice([4.0, 5.0, 7.5])))
    fixed = {"middle.inserted": 0.0, "polarizer.angle": 0.0}
    base: dict[str, float] = {}
    given: dict[str, float] = {}
    if plan == "analyser behind the sample":
        dial = np.arange(0.0, 180.0, 10.0)
        places = np.array([0.0, 22.5, 45.0, 67.5])
        settings = {"sample.angle": np.repeat(places, len(dial)), "analyzer.angle": np.tile(dial, len(places))}
    elif plan == "sample turned":
        settings = {"sample.angle": np.tile(turn, 2), "analyzer.angle": np.repeat([90.0, 0.0], len(turn))}
    else:
        settings, fixed["analyzer.angle"] = {"sample.angle": turn}, 0.0
    plate_in = plan == "catalogue plate turned" or rng.random() < 0.6
    if plate_in:
        retardance = float(rng.choice([90.0, 90.0, 180.0, 140.0]))  # deg at 540 nm, by its catalogue
        base, given = {"plate_0": retardance}, {"sample.retard_0": retardance}
    count = len(next(iter(settings.values())))
    if rng.random() < 0.5:
        settings["source.time"] = np.round(np.arange(count) * float(rng.uniform(0.05, 0.3)), 2)
    meter = Meter(
        10000.0,
        float(rng.uniform(2.0, 20.0)),
        float(rng.uniform(0.001, 0.005)),
        ((math.inf, 1.0),),
        "V",
        1000.0,
        3,
    )
    found = Session(settings, fixed, meter, bands, base, given, note=f"{plan}, {len(bands)} band(s)")
    motor = rng.random() < 0.6
    found = everyday(found, rng, dial_sd=0.0 if motor else float(rng.uniform(0.2, 0.7)), encoder=0.36 if motor else 0.0)
    return replace(found, misread=None, plate_in=plate_in)
