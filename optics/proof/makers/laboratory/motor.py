"""A motor with an encoder turns one film before a photodiode: hundreds of readings, several at each place, the lamp's
slow wander, mains flicker.

The noise of a reading is given, or is what the readings at one place say. Plans: once around; forth and back, with the
side of approach noted or not; two powers of the lamp; two exposures; three films; both films turned."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from optics.proof.makers.laboratory.session import Meter, Session
from optics.proof.makers.laboratory.student import everyday

PLANS = ("two films", "two films", "forth and back", "two powers", "two exposures", "three films", "both turned")


def session(rng: np.random.Generator) -> Session:
    plan = str(rng.choice(PLANS))
    encoder = float(rng.choice([0.25, 0.36, 0.5]))
    stay = int(rng.integers(1, 5))  # readings at an unmoved dial
    places = int(rng.integers(60, 180))
    turns = float(rng.choice([180.0, 360.0, 400.0]))
    dial = np.repeat(np.round(np.linspace(0.0, turns, places) / encoder) * encoder, stay)
    fixed, free = {"middle.inserted": 0.0, "polarizer.angle": 0.0}, ("analyzer_zero",)
    settings = {"analyzer.angle": dial}
    if plan == "three films":
        fixed = {"middle.inserted": 1.0, "polarizer.angle": 0.0, "analyzer.angle": 90.0}
        settings, free = {"middle.angle": dial}, ("middle_zero",)
    elif plan == "forth and back":
        way = np.repeat([1.0, -1.0], len(dial))
        settings = {"analyzer.angle": np.concatenate([dial, dial[::-1]])}
        if rng.random() < 0.7:
            settings["analyzer.approach"] = way
    elif plan in ("two powers", "two exposures"):
        key = "source.power" if plan == "two powers" else "camera.exposure"
        settings = {"analyzer.angle": np.tile(dial, 2), key: np.repeat([1.0, 0.3], len(dial))}
    elif plan == "both turned":
        fixed.pop("polarizer.angle")
        settings = {"polarizer.angle": np.repeat([0.0, 40.0, 95.0], len(dial)), "analyzer.angle": np.tile(dial, 3)}
    count = len(next(iter(settings.values())))
    if count > 900:
        keep = np.arange(count) // stay % math.ceil(count / 900) == 0  # whole places: what repeats there, repeats
        settings = {key: value[keep] for key, value in settings.items()}
        count = int(keep.sum())
    if rng.random() < 0.6:
        settings["source.time"] = np.round(np.arange(count) * float(rng.uniform(0.01, 0.05)), 3)
    meter = Meter(
        10000.0,
        float(rng.uniform(1.0, 10.0)),
        float(rng.uniform(0.0003, 0.002)),
        ((math.inf, 1.0),),
        "V",
        1000.0,
        3,
    )
    found = Session(settings, fixed, meter, free=free, note=f"{plan}, encoder {encoder:g} deg, {stay} at each place")
    found = everyday(found, rng, encoder=encoder)
    return replace(
        found,
        misread=None,
        memory=float(rng.uniform(20, 200)),
        flicker=found.wander * float(rng.uniform(0, 0.7)),
        noise_said=found.noise_said if "source.time" in settings or stay == 1 or rng.random() < 0.5 else 0.0,
        radians=bool(rng.random() < 0.4),
    )
