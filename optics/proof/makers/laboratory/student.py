"""A student's bench: a lamp, films on mounts that are turned by hand, a photodiode with a volt meter or a lux meter.

Plans as laboratory courses describe them: one film turned in the lamp's light; two, one of them turned; three, the
outer two crossed, the middle one turned; two films both turned; two curves at two distances of the lamp. 19 to 75
readings in steps of 5 or 10 deg, a reading error of the scale of .3 to 1 deg, zeros of the scales unknown."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from optics.proof.makers.laboratory.bench import FILMS
from optics.proof.makers.laboratory.session import Meter, Session

DIMMEST = 0.003  # of the range: what is seen of a lamp of power 1 where films are crossed, at least
STEADY = 0.03  # relative: a lamp that wanders by more is noticed, and mended
PLANS = ("one film", "two films", "three films", "both turned", "two powers", "forth and back")


def session(rng: np.random.Generator) -> Session:
    plan = str(rng.choice(PLANS))
    step = float(rng.choice([5.0, 10.0]))
    start = float(rng.choice([0.0, -90.0, -180.0]))
    turn = float(rng.choice([180.0, 360.0]))
    dial = np.arange(start, start + turn + 0.1, step)
    settings, fixed, free = _plan(plan, dial, rng)
    count = len(next(iter(settings.values())))
    if rng.random() < 0.6 or plan == "two powers":
        settings["source.time"] = np.round(np.cumsum(rng.uniform(0.2, 0.6, count)), 1)
    found = Session(settings, fixed, meter(rng), free=free, note=f"{plan}, every {step:g} deg")
    return everyday(found, rng, dial_sd=float(rng.uniform(0.3, 1.0)))


def _plan(plan: str, dial: np.ndarray, rng: np.random.Generator):
    """Columns, what holds in all readings, and the zeros that are not known."""
    fixed = {"middle.inserted": 0.0}
    there_and_back = np.concatenate([dial, dial[::-1]])[: 75 - 75 % 2]
    if plan == "one film":
        return {"polarizer.angle": dial}, {**fixed, "analyzer.inserted": 0.0}, ()
    if plan == "three films":
        return (
            {"middle.angle": dial},
            {"middle.inserted": 1.0, "polarizer.angle": 0.0, "analyzer.angle": 90.0},
            ("middle_zero",),
        )
    if plan == "both turned":
        dial = dial[dial < dial[0] + 180][::2]
        first = np.repeat([0.0, 30.0, 75.0], len(dial))
        return {"polarizer.angle": first, "analyzer.angle": np.tile(dial, 3)}, fixed, ("analyzer_zero",)
    if plan == "two powers":
        dial = dial[: 75 // 2]
        power = np.repeat([1.0, float(rng.choice([0.25, 0.4]))], len(dial))
        return {"analyzer.angle": np.tile(dial, 2), "source.power": power}, fixed, ("analyzer_zero",)
    if plan == "forth and back":
        way = np.where(np.arange(len(there_and_back)) < len(dial), 1.0, -1.0)
        return {"analyzer.angle": there_and_back, "analyzer.approach": way}, fixed, ("analyzer_zero",)
    return {"analyzer.angle": dial}, {**fixed, "polarizer.angle": 0.0}, ("analyzer_zero",)


def meter(rng: np.random.Generator) -> Meter:
    """A photodiode with a digital volt meter, or a lux meter that shows whole lux and changes its range."""
    if rng.random() < 0.5:
        full = float(rng.choice([900.0, 2600.0, 9000.0]))
        return Meter(full, 0.5, float(rng.uniform(0.002, 0.01)), ((2000.0, 1.0), (math.inf, 10.0)), "lux", clipped=True)
    return Meter(
        5000.0, float(rng.uniform(1.0, 8.0)), float(rng.uniform(0.0005, 0.004)), ((math.inf, 1.0),), "V", 1000.0, 3
    )


def everyday(found: Session, rng: np.random.Generator, *, dial_sd: float = 0.0, encoder: float = 0.0) -> Session:
    """With what goes wrong every day, and what its owner writes of it."""
    found = replace(found, dial_sd=dial_sd, encoder=encoder, power=bright(found))
    if rng.random() < 0.3:  # set against a film whose axis is marked: its zero is known
        found = replace(found, free=())
    zeros = {name: float(rng.uniform(-25, 25)) for name in found.free if name.endswith("_zero")}
    found = replace(found, zeros=zeros)
    noise = float(np.sqrt(np.mean(found.sd({}) ** 2)) / max(found.mean({}).mean(), 1e-9))
    return replace(
        found,
        wander=min(noise, STEADY) * float(rng.uniform(0.0, 1.0)),
        memory=float(rng.uniform(3.0, 20.0)),
        misread=int(rng.integers(found.count)) if rng.random() < 0.08 else None,
        noise_said=float(rng.choice([1.0, 1.0, 0.85, 1.2])),
        dials_said=bool(rng.random() < 0.6),
    )


def bright(found: Session) -> float:
    """Power of the lamp at which the largest reading is at 0.7 of the range, as far as a lamp goes: of crossed films
    the light that their dials let through is all there is."""
    top = float(replace(found, power=1.0).mean({}).max()) / found.meter.full
    return 0.7 / max(top, DIMMEST)


def known(found: Session, hidden: tuple[str, ...], rng: np.random.Generator) -> Session:
    """With what its owner writes of parts that are not there, of causes that he has excluded, with his reasons, and of
    a gain that is fixed: all true of this bench."""
    absent = [film for film in FILMS if not found.inside(film) and rng.random() < 0.5]
    if not {"depolarization", "retardance", "stress birefringence", "dichroism"} & {*hidden}:
        absent += ["sample"] if not found.base and found.plate_in and rng.random() < 0.5 else []
    exclude = {cause: why for cause, why in REASONS.items() if cause not in hidden and rng.random() < 0.25}
    fixed = {**found.fixed, "camera.gain": 1.0} if rng.random() < 0.5 else found.fixed
    return replace(
        found,
        absent=tuple(absent),
        exclude=exclude,
        fixed=fixed,
        continental=bool(rng.random() < 0.3),
        headed=bool(rng.random() < 0.5),
    )


REASONS = {
    "dark offset": "the meter was read with its cap on before and after",
    "stray light": "the room was dark: nothing is read with the lamp off",
    "camera gamma": "linear within 0.1 % by its data sheet",
    "residual response curve": "linear within 0.1 % by its data sheet",
    "polarized source": "the lamp stands behind two diffusers",
    "source drift": "the lamp was on for an hour",
}
