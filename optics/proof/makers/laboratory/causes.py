"""What is hidden on a bench: each cause in the maker's own numbers, by its usual law or by another, and kinds that no
library of such effects has.

A cause has groups of numbers that move together (`groups`): one strength each, from PLAIN. A hidden one is a direction
in them, drawn at random (`draw`), times a size. Names are those of the library's effects; the formulas are those of
`bench`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from optics.proof.makers.laboratory.bench import FILMS, MOST_FRAMES, PLAIN, Bench

Groups = tuple[tuple[str, ...], ...]
Direction = dict[str, float]


@dataclass(frozen=True)
class Cause:
    """groups    of numbers of the bench, one strength each, given the films that turn; low, high: bounds of strengths
    draw      a direction of size 1, given a generator and the films that turn
    most      size beyond which no bench is, in the numbers' units
    other     the same cause and size by another law, {number: value} of a direction times a size; law: in words
    """

    groups: Callable[[Sequence[str]], Groups]
    draw: Callable[[np.random.Generator, Sequence[str]], Direction]
    most: float
    low: float = -math.inf
    high: float = math.inf
    other: Callable[[Direction, float], Direction] | None = None
    law: str = ""


def at(direction: Mapping[str, float], size: float) -> Direction:
    """Numbers of a bench with a cause of this size."""
    return {name: PLAIN[name] + size * value for name, value in direction.items()}


def both(*parts: Bench) -> dict[str, float]:
    """A bench with several causes: where two move one number, their departures from PLAIN add up."""
    found: dict[str, float] = {}
    for part in parts:
        for name, value in part.items():
            found[name] = found.get(name, PLAIN[name]) + value - PLAIN[name]
    return found


# -- helpers: one number, one of each turning film, two numbers at a random angle -------------------------------------
def _one(name: str):
    return {"groups": lambda turned: ((name,),), "draw": lambda rng, turned: {name: rng.choice([-1.0, 1.0])}}


def _up(*names: str):
    return {"groups": lambda turned: (names,), "draw": lambda rng, turned: dict.fromkeys(names, 1.0)}


def _per_film(*ends: str):
    """Each turning film has numbers of its own; hidden is one film's, in a random direction."""

    def draw(rng, turned):
        film, angle = rng.choice(list(turned)), rng.uniform(0, 2 * math.pi)
        values = (rng.choice([-1.0, 1.0]),) if len(ends) == 1 else (math.cos(angle), math.sin(angle))
        return {f"{film}_{end}": float(v) for end, v in zip(ends, values)}

    return {"groups": lambda turned: tuple((f"{film}_{end}",) for film in turned for end in ends), "draw": draw}


def _plane(first: str, second: str):
    def draw(rng, turned):
        angle = rng.uniform(0, 2 * math.pi)
        return {first: math.cos(angle), second: math.sin(angle)}

    return {"groups": lambda turned: ((first,), (second,)), "draw": draw}


def _renamed(d: Direction, size: float, old: str, new: str, factor: float = 1.0) -> Direction:
    return {name.replace(old, new): size * factor * value for name, value in d.items()}


LEAKS = tuple(f"{film}_leak" for film in FILMS)
CAUSES: dict[str, Cause] = {
    "polarizer misalignment": Cause(
        groups=lambda turned: tuple((f"{film}_zero",) for film in FILMS),
        draw=lambda rng, turned: {f"{rng.choice(FILMS)}_zero": rng.choice([-1.0, 1.0])},
        most=20,
    ),
    "servo scale": Cause(
        **_per_film("scale"),
        most=0.1,
        other=lambda d, s: _renamed(d, s, "scale", "bent"),
        law="the ratio grows along the turn: s dial |dial|/360",
    ),
    "servo backlash": Cause(
        **_up(*(f"{film}_slack" for film in FILMS)),
        most=25,
        other=lambda d, s: _renamed(d, s, "slack", "lag"),
        law="taken up over the first 20 degrees after the film turns back",
    ),
    "analyzer wobble": Cause(
        **_per_film("wobble_c", "wobble_s"),
        most=0.3,
        other=lambda d, s: {
            **at(d, s),
            **{f"{name.split('_')[0]}_wobble_2": 0.4 * s for name in d if name.endswith("_c")},
        },
        law="with 0.4 of it twice per turn, as of a wedged film that is dusty as well",
    ),
    "eccentric dial": Cause(
        **_per_film("eccentric_c", "eccentric_s"),
        most=10,
        other=lambda d, s: {
            **at(d, s),
            **{f"{name.split('_')[0]}_eccentric_2": 0.5 * s for name in d if name.endswith("_c")},
        },
        law="with half of it twice per turn, as of a printed scale that is squeezed",
    ),
    "extinction leak": Cause(
        **_up(*LEAKS),
        most=0.4,
        low=0.0,
        high=0.8,
        other=lambda d, s: {name: s * share for name, share in zip(LEAKS, (0.3, 1.0, 1.7))},
        law="films of different batches: 0.3, 1 and 1.7 of it",
    ),
    "depolarization": Cause(**_up("haze"), most=0.9, low=0.0, high=1.0),
    "retardance": Cause(
        **_plane("plate_0", "plate_45"),
        most=160,
        other=lambda d, s: {**at(d, s), "twist": 25.0},
        law="the plate's axis turns by 25 degrees from face to face",
    ),
    "stress birefringence": Cause(**_up("plate_0"), most=160),
    "dichroism": Cause(**_plane("dichroic_q", "dichroic_u"), most=0.6),
    "polarized source": Cause(**_plane("lamp_q", "lamp_u"), most=0.9),
    "polarized detector": Cause(
        **_plane("detector_q", "detector_u"),
        most=0.3,
        low=-1.0,
        high=1.0,
        other=lambda d, s: _renamed(d, s, "detector", "detector_bright"),
        law="the more the brighter the light is: I/I_max of it",
    ),
    "source drift": Cause(
        **_one("drift"),
        most=0.05,
        other=lambda d, s: {"warm_up": d["drift"] * 10 * s},
        law="warms up, and then stays: 1 - exp(-5 t/T)",
    ),
    "camera gamma": Cause(
        **_one("gamma"),
        most=0.6,
        low=-0.8,
        other=lambda d, s: {"gamma_shadows": s * d["gamma"]},
        law="m^(1 + s (1.4 - 0.8 m)): bent more in the shadows",
    ),
    "residual response curve": Cause(
        **_one("bend"),
        most=0.6,
        low=-0.9,
        high=0.9,
        other=lambda d, s: {"knee": s},
        law="linear to half of the range, then m - 2 s (m - 1/2)^2",
    ),
    "dark offset": Cause(
        **_one("dark"),
        most=400,
        other=lambda d, s: {"dark_growth": s * d["dark"]},
        law="grows as the detector warms: s (1 - exp(-5 t/T))",
    ),
    "stray light": Cause(
        **_up("stray"),
        most=0.5,
        other=lambda d, s: {"stray": s, "stray_q": 0.3 * s, "stray_u": 0.2 * s},
        law="some of it through the analyser, polarized: 0.3 and 0.2 of it turn with its axis",
    ),
    "colour crosstalk": Cause(**_up("crosstalk"), most=0.3, low=0.0, high=0.33),
    "site gain": Cause(
        groups=lambda turned: (("site_q",), ("site_u",), ("site_d",)),
        draw=lambda rng, turned: dict(zip(("site_q", "site_u", "site_d"), rng.standard_normal(3))),
        most=0.15,
    ),
    "site extinction": Cause(**_up("analyzer_leak"), most=0.3, low=0.0, high=0.8),
    "site misalignment": Cause(**_one("analyzer_zero"), most=15),
    "film misalignment": Cause(**_one("middle_zero"), most=15),
    "film leak": Cause(**_up("middle_leak"), most=0.3, low=0.0, high=0.8),
    "lens vignetting": Cause(**_up("vignetting"), most=40, low=-10.0, high=100.0),
    "gain drift": Cause(
        groups=lambda turned: tuple((f"gain_{frame}",) for frame in range(MOST_FRAMES)),
        draw=lambda rng, turned: {f"gain_{frame}": float(rng.standard_normal()) for frame in range(MOST_FRAMES)},
        most=0.2,
    ),
    "coloured leak": Cause(
        groups=lambda turned: (LEAKS, tuple(f"{name}_slope" for name in LEAKS)),
        draw=lambda rng, turned: {
            **dict.fromkeys(LEAKS, 1.0),
            **dict.fromkeys((f"{name}_slope" for name in LEAKS), rng.choice([-0.9, 0.9])),
        },
        most=0.2,
    ),
}

DIALS = tuple(f"{film}.angle" for film in FILMS)
# kinds that no library effect is: a direction of size 1, the largest size, coordinates that a curve of it runs along
UNKNOWN: dict[str, tuple[Callable[[np.random.Generator, Sequence[str]], Direction], float, tuple[str, ...]]] = {
    "striped film": (_per_film("stripe_c", "stripe_s")["draw"], 0.9, DIALS),
    "eccentric pinion": (_per_film("pinion_c", "pinion_s")["draw"], 10.0, DIALS),
    "fatigue": (lambda rng, turned: {"fatigue": 1.0}, 1.0, ("reading", "source.time", "intensity", *DIALS)),
    "range step": (lambda rng, turned: {"range_step": rng.choice([-1.0, 1.0])}, 0.3, ("intensity", "analyzer.angle")),
    "lamp step": (lambda rng, turned: {"lamp_step": rng.choice([-1.0, 1.0])}, 0.3, ("source.time", "reading", "frame")),
}
