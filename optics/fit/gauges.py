"""Gauges: changes of several variables that no frame shows, and the combinations of these that frames do determine.

With J the derivative images over the noise and s the plausible sizes, G = s J'J s holds what the data say. Scaled to a
unit diagonal, eigenvectors with an eigenvalue below LIMIT are null directions. Their basis is chosen sparse: each
variable that is held (a pivot) belongs to one direction n alone, n = 1 in it, and of every other variable v

    v - sum_k n_k(v) pivot_k

does not change along any of them: it is known, with the standard deviation of the pseudo-inverse of G. Factors (powers,
transmittances) that share a scale are taken by their logarithms: their products and quotients are known. Unpolarized
light that passes two films tells analyzer.offset - polarizer.offset, and not where both count from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from optics.fit.model import Model
from optics.scene.parameter import Parameter, Variable, beside, keys_with
from optics.words import some, spaced, with_sd

if TYPE_CHECKING:
    from optics.fit.result import Fit

LIMIT = 1e-7  # eigenvalue of a null direction, G scaled to a unit diagonal: 3000 times the error; images in single
# precision leave 1e-14 of an exact one
STILL = 1e-6  # chi2 that a change of plausible size brings, below which frames do not depend on a variable
MEMBER = 0.01  # component of a null direction, over its largest: what is smaller is the error of a direction at LIMIT
HELD = 0.3  # component, over the largest, that a variable needs to be the one that is held
EQUAL = 0.02  # relative difference of components that count as equal
LISTED = 4  # combinations that are named; of more, their number and the largest


@dataclass(frozen=True)
class Gauge:
    """A change that no frame shows: `members` (places) change together, `change` in their units for 1 unit of the held
    one (of factors: relative changes); `text` says it in words."""

    members: tuple[int, ...]
    change: tuple[float, ...]
    held: int
    text: str


@dataclass(frozen=True)
class Known:
    """A combination that the frames determine: text, value and standard deviation in `unit`; places of its members."""

    text: str
    value: float
    sd: float
    unit: str
    members: tuple[int, ...]

    def __str__(self) -> str:
        return f"{self.text} = {with_sd(self.value, self.sd)}{spaced(self.unit)}"


@dataclass
class Gauges:
    """Null directions of a fit, and what is known beside them.

    silent   places of variables on which no frame depends
    count    how many numbers the frames determine: variables, less gauges, less silent ones
    """

    gauges: list[Gauge] = field(default_factory=list)
    known: list[Known] = field(default_factory=list)
    silent: list[int] = field(default_factory=list)
    count: int = 0

    @property
    def members(self) -> set[int]:
        """Places of all variables that some gauge moves."""
        return {i for g in self.gauges for i in g.members}

    def lines(self) -> list[str]:
        """One sentence for each gauge, then the combinations."""
        told = [f"gauge: {g.text} does not show" for g in self.gauges]
        many = len(self.known) > LISTED
        return told + [f"known: {k}" for k in self.known[:LISTED]] + (["known: ..."] if many else [])


def find(
    gram: np.ndarray,
    names: Sequence[str],
    plausible: Sequence[float],
    values: Sequence[float],
    units: Sequence[str] | None = None,
    factors: Sequence[bool] | None = None,
    precision: np.ndarray | None = None,
) -> Gauges:
    """Gauges and known combinations of variables.

    gram        (p, p) J'J of the data alone, whitened, per plausible size of each variable
    plausible, values, units   of each variable; factors: whether it multiplies light, None: none does
    precision   (p, p) of data and priors, per plausible size, for the standard deviations; None: gram
    """
    gram, sizes, at = np.asarray(gram, float), np.asarray(plausible, float), np.asarray(values, float)
    precision = gram if precision is None else np.asarray(precision, float)
    units = ["1"] * len(names) if units is None else list(units)
    own = np.diag(gram)
    silent = [i for i in range(len(names)) if not own[i] > STILL]
    live = np.array([i for i in range(len(names)) if own[i] > STILL], int)
    found = Gauges(silent=silent, count=len(live))
    if len(live) < 2:
        return found
    scale = np.sqrt(own[live])
    eigen, vectors = np.linalg.eigh(gram[np.ix_(live, live)] / np.outer(scale, scale))
    basis, held = sparse_basis(vectors[:, eigen < LIMIT])
    if not held:
        return found
    found.count -= len(held)
    full = np.zeros((len(names), len(held)))  # change of each variable in its unit, per unit of the basis
    full[live] = basis / scale[:, None] * sizes[live, None]
    pivots = [int(live[i]) for i in held]
    covariance = _inverse(precision) * np.outer(sizes, sizes)
    multiply = np.zeros(len(names), bool) if factors is None else np.asarray(factors, bool) & (at > 0)
    for group in _groups(full != 0):
        columns = [k for k in range(len(held)) if full[group, k].any()]
        logs = bool(multiply[group].all())
        change = full / np.where(multiply, at, 1.0)[:, None] if logs else full.copy()
        change[:, columns] /= change[[pivots[k] for k in columns], columns]
        for k in columns:
            members = [i for i in group if change[i, k]]
            text = _gauge_text([names[i] for i in members], change[members, k], [units[i] for i in members], logs)
            found.gauges.append(Gauge(tuple(members), tuple(change[members, k]), pivots[k], text))
        for i in group:
            if i in pivots:
                continue
            weight = {i: 1.0, **{pivots[k]: -change[i, k] for k in columns if change[i, k]}}
            found.known.append(_combination(weight, names, at, units, covariance, logs))
    return found


def gauges_of(fit: Fit) -> Gauges:
    """The gauges of a fit's last linearisation; none where it has no linearisation."""
    if fit.normal is None or not fit.variables:
        return Gauges(count=len(fit.variables))
    sizes = np.array([v.parameter.plausible for v in fit.variables])
    both = fit.normal.a * np.outer(sizes, sizes)
    return _of_variables(both - _priors(fit.variables), fit.variables, fit.estimate.tolist(), both)


def strengths_told(fit: Fit | np.ndarray, variables: Sequence[Variable], values: Sequence[float]) -> str:
    """What is known of the strengths of an effect, in words: 'analyzer.offset - polarizer.offset = 0.495 +- 0.020 deg
    (common rotation of analyzer.offset and polarizer.offset does not show)'.

    fit      a fit that holds the variables, or their covariance (k, k), with the priors of the variables in it; all
             else that was calibrated is allowed to make up for a change
    values   (k,) of the strengths, in their units
    """
    sizes = np.array([v.parameter.plausible for v in variables])
    if isinstance(fit, np.ndarray):
        covariance = np.asarray(fit, float)
        sd = np.sqrt(np.maximum(np.diag(covariance), 0))
        fine = np.isfinite(sd) & (sd > 0)
        both = np.zeros_like(covariance)
        # in units of what is known of each: one of which nothing is known must not drown the others in rounding
        both[np.ix_(fine, fine)] = _inverse(covariance[np.ix_(fine, fine)] / np.outer(sizes[fine], sizes[fine]))
        data = both - _priors(variables) * np.outer(fine, fine)
        # of a prior and nothing else, rounding is left
        data[np.abs(data) < 1e-6 * np.sqrt(np.outer(np.diag(both), np.diag(both)))] = 0.0
    else:
        both, data = _share(fit, variables)
    found = _of_variables(data, variables, values, both)
    sd = np.sqrt(np.maximum(np.diag(_inverse(both)), 0)) * sizes
    apart = [i for i in range(len(variables)) if i not in found.members and i not in found.silent]
    many = len(apart) + len(found.known) > 1
    told = [
        (f"{variables[i].name} = " if many else "") + with_sd(values[i], sd[i]) + spaced(variables[i].parameter.unit)
        for i in apart
    ]
    told += [str(k) for k in found.known]
    if len(told) > LISTED:
        largest = max(range(len(apart)), key=lambda i: abs(values[apart[i]]), default=None)
        told = [
            f"{len(told)} values" + ("" if largest is None else f", the largest of those known alone {told[largest]}")
        ]
    notes = [f"{g.text} does not show" for g in found.gauges]
    if found.silent:
        unseen = some([variables[i].name for i in found.silent])
        notes.append(f"{unseen} {'does' if len(found.silent) == 1 else 'do'} not show")
    return (", ".join(told) or "nothing of it is determined") + (f" ({'; '.join(notes)})" if notes else "")


# -- what the captures cannot show -----------------------------------------------------------------------------------
def acting(model: Model, variables: Sequence[Variable]) -> list[Variable]:
    """The variables of an effect without those that the captures cannot show, whatever their values.

    Left out are keys of films that are out of the beam in all frames, and keys that show through the changes of a
    setting (`Parameter.through`) that has one value in all frames: the wobble of a dial that never turned is a
    transmittance, its scale an offset. So are gains of a light in frames that it does not light, and where no frame
    has another light beside it: they are gains of whole frames then. Variables keep their names; one without a key left
    is dropped."""
    found = []
    lit = _lit(model) if any(v.parameter.role == "power gain" for v in variables) else {}
    for v in variables:
        keys = tuple(k for k in v.keys if _acts(model, k) and _shows(model, k, v.frames, lit))
        if keys:
            found.append(v if keys == v.keys else replace(v, keys=keys))
    return found


def _acts(model: Model, key: str) -> bool:
    parameters: Mapping[str, Parameter] = model.parameters
    inserted = beside(parameters, key, "inserted")
    if inserted is not None and key != inserted and not np.any([np.any(x) for x in _set(model, inserted)]):
        return False
    through = parameters[key].through
    if not through:
        return True
    own = f"{key.rpartition('.')[0]}.{through}"
    seen = [own] if own in parameters else keys_with(parameters, through)
    return any(len({float(x) for part in _set(model, k) for x in np.ravel(part)}) > 1 for k in seen)


def _lit(model: Model) -> dict[str, list[bool]]:
    """Part -> whether it sends light in each frame, of what has a power."""
    return {
        key.rpartition(".")[0]: [bool(np.any(x)) for x in _set(model, key)]
        for key in keys_with(model.parameters, "power")
    }


def _shows(model: Model, key: str, frames: Sequence[int] | None, lit: Mapping[str, Sequence[bool]]) -> bool:
    """False of the gain of a light in frames (None: all) that it does not light, or that is alone in all its frames."""
    if model.parameters[key].role != "power gain":
        return True
    own = lit[key.rpartition(".")[0]]
    beside_others = any(on and sum(other[i] for other in lit.values()) > 1 for i, on in enumerate(own))
    return beside_others and any(own[i] for i in frames or range(len(own)))


def _set(model: Model, key: str) -> list:
    """Every frame's value of a parameter, before any fit; an array of a sweep's readings."""
    settings = [{**model.base, **f.parameters, **f.readings} for f in model.frames]
    return [own[key] for own in settings]


# -- algebra ---------------------------------------------------------------------------------------------------------
def _of_variables(data: np.ndarray, variables: Sequence[Variable], values: Sequence[float], both: np.ndarray) -> Gauges:
    parameters = [v.parameter for v in variables]
    return find(
        data,
        [v.name for v in variables],
        [p.plausible for p in parameters],
        values,
        [p.unit for p in parameters],
        [p.factor for p in parameters],
        both,
    )


def _priors(variables: Sequence[Variable]) -> np.ndarray:
    """(p, p) what priors add to the precision, per plausible size."""
    return np.diag([v.parameter.plausible**2 * v.precision for v in variables])


def _share(fit: Fit, variables: Sequence[Variable]) -> tuple[np.ndarray, np.ndarray]:
    """(k, k) precisions per plausible size of some variables of a fit, with all others free: of data and priors, and
    without the variables' own priors."""
    if fit.normal is None:
        raise ValueError("strengths_told: the fit has no linearisation; give a result of `fit`, or a covariance")
    names = [v.name for v in fit.variables]
    own = [names.index(v.name) for v in variables]
    rest = [i for i in range(len(names)) if i not in own]
    sizes = np.array([v.parameter.plausible for v in fit.variables])
    a = fit.normal.a * np.outer(sizes, sizes)
    alone = np.diag(a)[own] - np.diag(_priors([fit.variables[i] for i in own]))
    both = a[np.ix_(own, own)] - a[np.ix_(own, rest)] @ _inverse(a[np.ix_(rest, rest)]) @ a[np.ix_(rest, own)]
    data = both - _priors([fit.variables[i] for i in own])
    # of what other variables make up for, rounding is left
    gone = np.diag(data) < LIMIT * alone
    data[gone], data[:, gone] = 0.0, 0.0
    return both, data


def _inverse(a: np.ndarray) -> np.ndarray:
    """Pseudo-inverse of a precision, or of a covariance, in its scaled basis, without its null directions."""
    scale = np.sqrt(np.where(np.diag(a) > 0, np.diag(a), 1.0))
    eigen, vectors = np.linalg.eigh(a / np.outer(scale, scale))
    kept = eigen > 1e-12 * max(eigen.max(initial=0.0), 1e-300)
    return (vectors[:, kept] / eigen[kept]) @ vectors[:, kept].T / np.outer(scale, scale)


def sparse_basis(null: np.ndarray) -> tuple[np.ndarray, list[int]]:
    """(basis (p, k), held variables): of the null space, with as few variables in each direction as there may be. The
    last variable that takes part well enough is held."""
    basis, held = null.copy(), []
    for k in range(null.shape[1]):
        rest = np.linalg.norm(basis[:, k:], axis=1)
        pivot = int(np.flatnonzero(rest >= HELD * rest.max())[-1])
        turn = np.linalg.qr(basis[pivot : pivot + 1, k:].T, mode="complete")[0]
        basis[:, k:] = basis[:, k:] @ turn  # only the first of them moves the pivot now
        basis[:, k] /= basis[pivot, k]
        for other in (*range(k), *range(k + 1, null.shape[1])):
            basis[:, other] -= basis[pivot, other] * basis[:, k]
        held.append(pivot)
    largest = np.abs(basis).max(0, initial=1e-300)
    return np.where(np.abs(basis) > MEMBER * largest, basis, 0.0), held


def _groups(moves: np.ndarray) -> list[list[int]]:
    """Places of variables (rows) that share null directions (columns), directly or through others."""
    left, groups = {i for i in range(len(moves)) if moves[i].any()}, []
    while left:
        group: set[int] = set()
        grown = {min(left)}
        while grown != group:
            group = grown
            grown = {i for i in left if moves[i][moves[sorted(group)].any(0)].any()} | group
        groups.append(sorted(group))
        left -= group
    return groups


def _gauge_text(names: Sequence[str], change: np.ndarray, units: Sequence[str], logs: bool) -> str:
    listed = some(names, 3) if len(names) > 3 else " and ".join([", ".join(names[:-1]), names[-1]])
    size = np.abs(change)
    equal = np.all(np.abs(size / size.max() - 1) < EQUAL)
    if logs and equal:
        return f"a common scale of {listed}"
    if equal and len(set(units)) == 1 and len(set(np.sign(change))) == 1:
        return f"a common {'rotation' if units[0] == 'deg' else 'change'} of {listed}"
    if len(names) > 3 and len(set(np.sign(change))) == 1:
        return f"a common change of {listed}, by different amounts,"
    if logs:  # the one that changes most by a factor e
        steps = [f"{name} by a factor {math.exp(c):.3g}" for name, c in zip(names, change / size.max())]
    else:
        steps = [f"{name} by {c:+.3g}{spaced(unit)}" for name, c, unit in zip(names, change, units)]
    return f"a change of {some(steps, 3, ' with ')}"


def _combination(
    weight: Mapping[int, float],
    names: Sequence[str],
    at: np.ndarray,
    units: Sequence[str],
    covariance: np.ndarray,
    logs: bool,
) -> Known:
    places = list(weight)
    w = np.array([weight[i] for i in places])
    own = covariance[np.ix_(places, places)]
    if logs:
        value = float(np.exp(w @ np.log(at[places])))
        relative = w / at[places]
        text = names[places[0]] + "".join(
            f" {'*' if c > 0 else '/'} {names[i]}{'' if abs(abs(c) - 1) < EQUAL else f'^{abs(c):.3g}'}"
            for i, c in zip(places[1:], w[1:])
        )
        return Known(text, value, value * math.sqrt(max(relative @ own @ relative, 0.0)), "1", tuple(places))
    text = names[places[0]] + "".join(
        f" {'+' if c > 0 else '-'} {'' if abs(abs(c) - 1) < EQUAL else f'{abs(c):.3g} '}{names[i]}"
        for i, c in zip(places[1:], w[1:])
    )
    return Known(text, float(w @ at[places]), math.sqrt(max(w @ own @ w, 0.0)), units[places[0]], tuple(places))
