"""A phone's camera looks at a lit screen or a lamp through films: the mean of a region in each photograph, red, green
and blue, 8 bits, linear by its raw file or bent by a tone curve.

Plans: one film turned before a screen; two films, one turned; a clear plastic sheet between crossed films, turned. A
few tens of photographs, films held in printed rings by hand. The exposure is fixed, or noted from the file of each
photograph."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from optics.proof.makers.laboratory.session import Meter, Session
from optics.proof.makers.laboratory.student import everyday

PLANS = ("two films", "two films", "sheet turned", "three films", "one film")
COLOURS = (600.0, 535.0, 465.0)  # nm


def session(rng: np.random.Generator) -> Session:
    plan = str(rng.choice(PLANS))
    dial = np.arange(0.0, float(rng.choice([180.0, 360.0])) + 0.1, float(rng.choice([5.0, 10.0])))
    fixed, free = {"middle.inserted": 0.0, "polarizer.angle": 0.0}, ("analyzer_zero",)
    settings = {"analyzer.angle": dial}
    if plan == "three films":
        fixed = {"middle.inserted": 1.0, "polarizer.angle": 0.0, "analyzer.angle": 90.0}
        settings, free = {"middle.angle": dial}, ("middle_zero",)
    elif plan == "one film":
        fixed = {"middle.inserted": 0.0, "analyzer.inserted": 0.0}
        settings, free = {"polarizer.angle": dial}, ()
    elif plan == "sheet turned":
        settings = {"sample.angle": np.tile(dial, 2), "analyzer.angle": np.repeat([90.0, 0.0], len(dial))}
        free = ()
    sheet = plan == "sheet turned" and rng.random() < 0.6  # of known retardance: layers of tape that were measured
    retardance = float(rng.choice([120.0, 250.0, 400.0]))
    count = len(next(iter(settings.values())))
    if rng.random() < 0.4:
        settings["camera.exposure"] = rng.choice([1.0, 0.5, 0.25], count)  # as the phone chose it, in its files
    # the mean of some hundred pixels: fractions of a DN
    meter = Meter(
        247.0, float(rng.uniform(0.05, 0.3)), float(rng.uniform(0.003, 0.01)), ((math.inf, 0.01),), "DN", 1.0, 2
    )
    base, given = ({"plate_0": retardance}, {"sample.retard_0": retardance}) if sheet else ({}, {})
    found = Session(settings, fixed, meter, COLOURS, base, given, free, note=f"{plan}, a region's mean")
    found = replace(found, plate_in=sheet or plan != "sheet turned")
    return replace(everyday(found, rng, dial_sd=float(rng.uniform(0.3, 1.0))), misread=None)
