"""Powers that have run away.

A band that the model calls dark in every frame, as it is between crossed films, takes whatever light there is for its
own: its power grows thousands of times until a last trace of the transmission explains that light. What is ranked from
there is ranked in a light that no lamp sends."""

from __future__ import annotations

from optics.fit.model import Model
from optics.fit.result import Fit
from optics.scene.parameter import Variable

# times the least of the others: bands of one lamp, or lamps of one kind, differ by ten, and powers that ran away by 800
APART = 100.0
KNOWN = 0.1  # relative sd of a power that the images tell; that of a lamp that is off says nothing


def powers_apart(model: Model, found: Fit) -> str:
    """'source.power_r 4e+04, 8e+03 times source.power_b', of the largest power that no prior holds; '' where none
    stands apart from the others.

    A red lamp has little blue, of which as much would come through: so much power changes as much light. What has run
    away changes little, and its error is as many times that of the others."""
    powers = [
        (float(value), float(sd), v)
        for v, value, sd in zip(found.variables, found.estimate, found.sd)
        if v.frames is None and v.prior is None and model.linear_in(v) and 0 <= sd < KNOWN * value
    ]
    pairs = [
        (value / other, value, v, o)
        for value, sd, v in powers
        for other, well, o in powers
        if _of_a_kind(v, o) and value > APART * other and sd > APART * well
    ]
    if not pairs:
        return ""
    times, most, v, other = max(pairs, key=lambda p: (p[1], p[0]))
    return f"{v.name} {most:.3g}, {times:.2g} times {other.name}"


def _of_a_kind(one: Variable, other: Variable) -> bool:
    """Whether two powers are counted alike: shares of bands in one light, or the same number of lights of one kind."""
    a, b = (v.keys[0].rpartition(".") for v in (one, other))
    return one.parameter.role == other.parameter.role and (a[0] == b[0] or one.parameter.doc == other.parameter.doc)
