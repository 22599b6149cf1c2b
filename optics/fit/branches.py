"""Branches: other minima of what single frames have for themselves.

Between crossed films a photograph is as bright on either side of the extinction, I = P sin^2(d) with d the sum of what
two dials are off. On which side it is, only a detail of the image tells (how the extinction runs across the field),
and a descent stays on the side that it began on. What a frame has for itself is walked along the direction in which
its image tells most of it, in all frames at once, as they do not depend on each other; where another minimum is lower,
everything is calibrated again from there. If no bright frame tells the light, P may be wrong together with the sides of
many frames, and is walked too. Only angles are walked: only they have two sides of an extinction."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, product

import numpy as np

from optics.fit import calibrate
from optics.fit.descent import whiten
from optics.fit.model import Model, value_of
from optics.fit.result import Fit
from optics.fit.tempering import weight_of
from optics.scene.parameter import Values

REACH = 3.0  # sd of the priors about their means: as far as errors of settings go
STEP = 0.25  # sd of the priors: of a walk
TOLD = 4.0  # of what the prior tells: a frame that tells less has no minimum but the prior's
FINE = 0.5  # sd of what is known along a walk, to which a minimum is found before everything is calibrated from there
LOWER = 1.0  # of chi2, by which another minimum must be lower: rounding is not
ROUNDS = 12  # of walks and calibrations, each of which goes down
VAGUE = 0.03  # relative sd of the light, from which the sides of all frames may be wrong together
FACTORS = (1.0, 2.0, 0.5, 4.0, 0.25)  # of the light, tried then: beside twice as much a frame is 0.7 times as far off

Places = Mapping[int, float]  # frame -> t, sd of the priors from where its angles stand


def over_branches(model: Model, found: Fit, follow: Callable[[Values], Fit]) -> Fit:
    """A calibration, or the lowest one that is found from where single frames have a lower minimum.

    follow   calibrates all variables of the fit from given values"""
    for _ in range(ROUNDS):
        walks = Walks(model, found)
        for values in chain(walks.lower(), walks.turned_round()):
            other = follow(values)
            if other.total < found.total - LOWER:
                found = other
                break
        else:
            break
    return found


@dataclass(frozen=True)
class Walk:
    """The angles that one frame has for itself, along one direction.

    places      of their variables in the fit
    means, sds  of their priors, which count `weight` times; at: where they stand, in sd about the means
    direction   in sd, of length 1: in which the frame tells most
    told        1/sd^2 of what frame and prior tell along it, in sd of the priors
    """

    places: tuple[int, ...]
    means: np.ndarray
    sds: np.ndarray
    weight: float
    at: np.ndarray
    direction: np.ndarray
    told: float

    @property
    def middle(self) -> float:
        """t closest to the means of the priors."""
        return -float(self.at @ self.direction)

    def angles(self, t: float) -> np.ndarray:
        return self.means + self.sds * (self.at + t * self.direction)

    def prior(self, t: float) -> float:
        """chi2 of the priors."""
        return self.weight * float(np.sum((self.at + t * self.direction) ** 2))


class Walks:
    """The walks of all frames of a fit that tell of angles with priors which no other frame has; none where predictions
    are Monte Carlo estimates, of which a walk would take minutes.

    of       frame -> its walk
    powers   places of the variables that all light is proportional to
    """

    def __init__(self, model: Model, found: Fit):
        self.model, self.found, self.of = model, found, dict[int, Walk]()
        self.powers = [i for i, v in enumerate(found.variables) if v.frames is None and model.linear_in(v)]
        if found.normal is None or model.monte_carlo:
            return
        self.scales = {f: scale for f, (_, _, scale) in zip(found.frames, found.normal.rows)}
        weight = weight_of(found.variables)
        for f, places in own_angles(found).items():
            priors = [found.variables[i].prior for i in places]
            means, sds = np.array([prior for prior in priors if prior is not None]).T
            told, directions = np.linalg.eigh(found.normal.a[np.ix_(places, places)] * np.outer(sds, sds))
            at = (np.array([value_of(model, found.values, found.variables[i]) for i in places]) - means) / sds
            if told[-1] > TOLD:
                self.of[f] = Walk(places, means, sds, weight, at, directions[:, -1], float(told[-1]))

    def lower(self) -> list[Values]:
        """Values with frames at other minima than those of the fit, where these are lower; the lowest first."""
        if not self.of:
            return []
        known = [self.found.sd[i] / max(self.found.estimate[i], 1e-300) for i in self.powers]
        vague = max(known, default=0.0) > VAGUE
        return [v for _, v in sorted(filter(None, map(self._lowest, FACTORS if vague else (1.0,))), key=lambda t: t[0])]

    def turned_round(self) -> Iterator[Values]:
        """Values with what several angles of a frame are off from their settings turned round, some of them or all,
        where the frame by itself is lower then: a sheet between crossed films has extinctions of its own."""
        found, lower = self.found, False
        values = found.values.copy()
        for f, walk in self.of.items():
            own = [found.variables[i] for i in walk.places]
            off = walk.sds * walk.at
            starts = [walk.means + off * signs for signs in product((1, -1), repeat=len(own))] if len(own) > 1 else []
            least = math.inf
            for n, start in enumerate(starts):
                ended = calibrate.fit(self.model, own, self._turned(found.values.copy(), f, start), [f])
                if ended.total < least - LOWER * (n > 0):
                    least, lower = ended.total, lower or n > 0
                    self._turned(values, f, ended.estimate)
        if lower:
            yield values

    def moved(self, at: Places, factor: float = 1.0) -> Values:
        """The values of the fit with the angles of some frames elsewhere, and with so many times the light."""
        values, variables = self.found.values.copy(), self.found.variables
        for i in self.powers if factor != 1 else ():
            low, high = variables[i].parameter.bounds
            values.put(variables[i], float(np.clip(factor * self.found.estimate[i], low, high)))
        for f, t in at.items():
            self._turned(values, f, self.of[f].angles(t))
        return values

    def _turned(self, values: Values, f: int, angles: np.ndarray) -> Values:
        """The values, in which the angles of a frame are put."""
        for i, angle in zip(self.of[f].places, angles):
            v = self.found.variables[i]
            values.put(v, float(np.clip(angle, *v.parameter.bounds)))
        return values

    def _misfits(self, at: Places, factor: float) -> dict[int, float]:
        """Frame -> chi2 of its image there, by the weights of the fit, plus that of its priors."""
        found = {}
        for f, prediction in zip(at, self.model.predict(self.moved(at, factor), list(at))):
            whitened = whiten(self.model, f, prediction, self.scales[f]).astype(float)
            found[f] = float(whitened @ whitened) + self.of[f].prior(at[f])
        return found

    def _lowest(self, factor: float) -> tuple[float, Values] | None:
        """(sum of misfits, values) where each frame is at its lowest minimum with so many times the light; None where
        all are at the minimum that they have in the fit."""
        steps = np.arange(-REACH, REACH + STEP / 2, STEP)
        along = [self._misfits({f: w.middle + s for f, w in self.of.items()}, factor) for s in steps]
        minima = {f: w.middle + steps[_minima(w.middle + steps, [c[f] for c in along])] for f, w in self.of.items()}
        if factor == 1:  # the fit is at its minima
            lowest = {f: (misfit, 0.0) for f, misfit in self._misfits(dict.fromkeys(self.of, 0.0), factor).items()}
        else:
            lowest = self._narrowed({f: float(ts[0]) for f, ts in minima.items()}, factor)
        moved = set()
        for n in range(1, max(map(len, minima.values()))):
            others = self._narrowed({f: float(ts[n]) for f, ts in minima.items() if n < len(ts)}, factor)
            for f, other in others.items():
                if other[0] < lowest[f][0] - LOWER:
                    lowest[f] = other
                    moved.add(f)
        if not moved:
            return None
        at = {f: t for f, (_, t) in lowest.items()}
        return sum(misfit for misfit, _ in lowest.values()), self.moved(at, factor)

    def _narrowed(self, at: Places, factor: float) -> dict[int, tuple[float, float]]:
        """Frame -> (misfit, t) of the minimum about a place: ever shorter steps to both sides."""
        best = {f: (misfit, at[f]) for f, misfit in self._misfits(at, factor).items()}
        widest = STEP * math.sqrt(max(self.of[f].told for f in at)) / FINE
        for halvings in range(1, math.ceil(math.log2(max(widest, 2.0))) + 1):
            middles = {f: t for f, (_, t) in best.items()}
            for step in (-STEP / 2**halvings, STEP / 2**halvings):
                beside = {f: t + step for f, t in middles.items()}
                best = {f: min(best[f], (misfit, beside[f])) for f, misfit in self._misfits(beside, factor).items()}
        return best


def own_angles(found: Fit) -> dict[int, tuple[int, ...]]:
    """Frame -> places of the angles with priors that it alone has."""
    own: dict[int, tuple[int, ...]] = {}
    for i, v in enumerate(found.variables):
        if v.frames is not None and len(v.frames) == 1 and v.prior is not None and v.parameter.role == "angle":
            own[v.frames[0]] = (*own.get(v.frames[0], ()), i)
    return own


def _minima(t: np.ndarray, line: Sequence[float]) -> list[int]:
    """Places of the minima of a line, the one that t = 0 lies in first."""
    own = int(np.argmin(np.abs(t)))
    while own > 0 and line[own - 1] < line[own]:
        own -= 1
    while own < len(line) - 1 and line[own + 1] < line[own]:
        own += 1
    return [own, *(i for i in range(1, len(line) - 1) if line[i - 1] > line[i] <= line[i + 1] and i != own)]
