"""Calibration: the values of free parameters that explain the captures, by Levenberg-Marquardt on derivative images.

    minimise  sum_pixels ((y - f(theta)) / sigma)^2 + sum_priors ((theta - mean) / sd)^2

with sigma from the prediction (not from the data), re-evaluated at every linearisation; masks from data and noise only.
The steps are those of `optics.fit.descent`; what is found is an `optics.fit.result.Fit`."""

from __future__ import annotations

import fnmatch
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from optics.captures.capture_set import group_of
from optics.errors import Underdetermined, UnknownKey
from optics.fit import starts
from optics.fit.descent import Descent, Normal, Rows, covariance_of, prior_terms, stacked, whiten
from optics.fit.model import Model, seeds_apart, value_of
from optics.fit.result import Fit, warnings_of
from optics.scene.parameter import Values, Variable
from optics.words import some, spaced

Prior = tuple[float | None, float]  # (mean, or None for the present value; standard deviation)

NEGLIGIBLE = 1e-3  # of the excess of chi2: a promised fall below it is not worth another linearisation; it is a tenth
# of what a diagnosis allows its base (`optics.diagnosis.score.SETTLED`)
NEAR = 20.0  # promised fall of chi2 per variable below which a fit is close to its optimum: a few standard deviations
# of each variable, within which shadow rims make chi2 rough
STEPS, STEPS_NEAR = 8, 3  # predictions per linearisation: far off, eight cost less than one linearisation of ten or
# more variables; close to the optimum the first step does nearly all
WORTH = 0.1  # of the accuracy asked for: what a step on the same derivative images must promise or gain
PART = 0.3  # of the first promise: while a linearisation still promises more, it no longer holds, and a new one is made
SCALINGS = 3  # times that powers are solved for by themselves before the first step
OFF = 0.1  # sd: a factor that is smaller is off, as far as the data tell
EXCESS = 3.0  # sd of chi2 above its degrees of freedom, from which a misfit is worth a search
SHORT = 8  # linearisations of such a descent, before it is known to lead anywhere
LEAD = 10.8  # of chi2, by which another start must be better: a lead that noise alone takes in 1 of 1000 cases
LEADS = 0.01  # of the excess of chi2, by which it must: ten times what is NEGLIGIBLE to where each of the two ends
FOLLOWED = 0.25  # of the promise: what a step around the bend of a valley must gain to be followed by another
TRIES = 4  # linearisations close to the optimum, before a fit that no longer gains ends
CHORD_DAMPING = 1e-6  # of `extended`, which starts at the base's optimum: only directions that nothing determines


# -- variables -------------------------------------------------------------------------------------------------------
def variables_from(
    model: Model,
    free: Sequence[str],
    per_group: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    frames: Sequence[int] | None = None,
) -> list[Variable]:
    """Variables for key patterns: `free` with one value for all frames (`led_*.x`), `per_group` with one per group.

    priors   pattern -> (mean or None for the present value, standard deviation)
    frames   those whose groups get variables; None: all
    Raises UnknownKey for a pattern that matches no number of the scene.
    """
    numbers = [k for k, p in model.parameters.items() if p.is_number]
    variables: list[Variable] = []

    def matching(pattern: str) -> list[str]:
        found = fnmatch.filter(numbers, pattern)
        if not found:
            raise UnknownKey(pattern, numbers, "parameter", hint="`optics params SCENE` lists them; * and ? match")
        return found

    for pattern in free:
        variables += [
            Variable(k, (k,), model.parameters[k]) for k in matching(pattern) if all(k != v.name for v in variables)
        ]
    groups: dict[str, list[int]] = {}
    for index in range(len(model.frames)) if frames is None else frames:
        groups.setdefault(group_of(model.frames[index]), []).append(index)
    for pattern in per_group:
        for key in matching(pattern):
            variables += [Variable(f"{key}[{g}]", (key,), model.parameters[key], tuple(ii)) for g, ii in groups.items()]
    for pattern, (mean, sd) in (priors or {}).items():
        hit = False
        for i, v in enumerate(variables):
            if fnmatch.fnmatch(v.keys[0], pattern) or fnmatch.fnmatch(v.name, pattern):
                variables[i] = v.with_prior(value_of(model, Values(), v) if mean is None else mean, sd)
                hit = True
        if not hit:
            raise UnknownKey(pattern, [v.name for v in variables], "free parameter for a prior")
    return variables


def for_frames(model: Model, variables: Sequence[Variable], frames: Sequence[int]) -> list[Variable]:
    """The per-frame variables of a fit, for other frames: one per group where the fit has one per group.

    A prior is kept where it is the same for all, or where all are centred on what their frames set.
    """
    found = []
    for keys in dict.fromkeys(v.keys for v in variables if v.frames is not None):
        alike = [v for v in variables if v.keys == keys and v.frames is not None]
        groups = [group_of(model.frames[_first(v)]) for v in alike]
        single = len(set(groups)) < len(groups)  # several values within one group: each frame has its own
        shared: dict[str, list[int]] = {}
        for f in frames:
            shared.setdefault(model.frames[f].name if single else group_of(model.frames[f]), []).append(f)
        found += [
            Variable(f"{keys[0]}[{name}]", keys, alike[0].parameter, tuple(own), _prior_in(model, alike, own[0]))
            for name, own in shared.items()
        ]
    return found


def _prior_in(model: Model, alike: Sequence[Variable], frame: int) -> tuple[float, float] | None:
    """The prior in another frame of what variables have in theirs; None where theirs do not say."""
    key, priors = alike[0].keys[0], [v.prior for v in alike]
    said = _said(model, frame, key)
    if said is not None and all(v.prior == _said(model, _first(v), key) for v in alike):
        return said
    if len(set(priors)) == 1:
        return priors[0]
    known = [prior for prior in priors if prior is not None]
    if len(known) < len(priors) or len({sd for _, sd in known}) > 1:
        return None
    if all(mean == model.at(Values(), _first(v))[key] for v, (mean, _) in zip(alike, known)):
        return float(model.at(Values(), frame)[key]), known[0][1]
    return None


def _said(model: Model, frame: int, key: str) -> tuple[float, float] | None:
    """(setting, its uncertainty) of a frame; None where it does not say both."""
    if model.captures is None:
        return None
    own = model.frames[frame]
    sd = model.captures.uncertainty_of(own).get(key)
    return None if sd is None or np.ndim(sd) else (float(own.parameters[key]), float(sd))


def _first(variable: Variable) -> int:
    """The first frame of a variable that some frames have for themselves."""
    assert variable.frames is not None
    return variable.frames[0]


def with_start(model: Model, variables: Sequence[Variable], values: Values) -> Values:
    """A copy of the values in which every variable is set explicitly."""
    filled = values.copy()
    for variable in variables:
        filled.put(variable, value_of(model, values, variable))
    return filled


# -- fits ------------------------------------------------------------------------------------------------------------
def fit(
    model: Model,
    variables: Sequence[Variable],
    start: Values | None = None,
    frames: Sequence[int] | None = None,
    *,
    max_iterations: int = 40,
    robust: bool = False,
    tolerance: float = 0.05,
    negligible: float | None = None,
    asked: float = math.inf,
    progress: Callable[[str, int, int], None] | None = None,
) -> Fit:
    """Levenberg-Marquardt within bounds.

    Stops when the fall of chi2 that the linearisation still predicts is below `tolerance` per variable or below
    `negligible` of the excess (None: NEGLIGIBLE), or when no damping lowers chi2; `Fit.reason` says which. It gives up
    where even the fall that is promised leaves more than `asked`. Raises OutOfBounds for a start value outside of its
    bounds, Underdetermined when no value is usable or no variable changes anything."""
    variables = list(variables)
    frames = list(range(len(model.frames))) if frames is None else list(frames)
    filled = with_start(model, variables, start or Values())
    first = np.array([value_of(model, filled, v) for v in variables])
    for v, value in zip(variables, first):
        v.parameter.check(value, v.name, "start value")
    descent = Descent(model, variables, filled, frames, robust)
    done = 0

    def tick() -> None:
        nonlocal done
        done += 1
        if progress:
            progress("calibrate", done, (max_iterations + SCALINGS) * len(frames))

    share = NEGLIGIBLE if negligible is None else negligible
    history, reason = _descend(descent, max_iterations, tolerance * max(len(variables), 1), share, asked, tick)
    if descent.at is not descent.theta:  # the last steps moved on from where the derivative images were made
        descent.linearise()
    return _fit_at(descent, history, reason, first)


def fit_over_starts(
    model: Model,
    variables: Sequence[Variable],
    start: Values | None = None,
    frames: Sequence[int] | None = None,
    *,
    max_iterations: int = 40,
    robust: bool = False,
    tolerance: float = 0.05,
    negligible: float | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    over: Sequence[str] | None = None,
) -> Fit:
    """As `fit`; where misfit is left and variables declare starts (`Parameter.starts`), from the best of these too.

    over   names of the variables whose starts are tried; None: of all. A refit tries those of the effect that is added

    Other starts are tried by predictions only (`optics.fit.starts`), at the start values of all else; the best
    few are followed for SHORT linearisations, and one that leads is calibrated. Of several that are as good
    the one with the smallest values is taken. Without such variables, or without misfit, this is `fit`. Raises
    Underdetermined only after the starts: at 0 a retardance between crossed polarizers has no slope."""
    frames = list(range(len(model.frames))) if frames is None else list(frames)
    filled = with_start(model, variables, start or Values())
    follow = functools.partial(
        fit, model, variables, frames=frames, robust=robust, negligible=negligible, progress=progress
    )
    first: Fit | None = None
    error = Underdetermined("no start")
    try:
        first = follow(filled, max_iterations=max_iterations, tolerance=tolerance)
    except Underdetermined as raised:
        error = raised
    values = _elsewhere(model, variables, filled, frames, first, follow, over)
    if values is not None:
        found = follow(values, max_iterations=max_iterations, tolerance=tolerance)
        found.start = np.array([value_of(model, filled, v) for v in variables])
        if first is None or found.total < first.total - _lead(first):
            return found
    if first is None:
        raise error
    return first


def _misfits(found: Fit) -> bool:
    """Whether a fit leaves more than noise."""
    return found.chi2 - found.dof > EXCESS * math.sqrt(2 * max(found.dof, 1))


def _lead(found: Fit) -> float:
    """By how much another minimum must be lower than this one."""
    return max(LEAD, LEADS * (found.chi2 - found.dof))


def _elsewhere(
    model: Model,
    variables: Sequence[Variable],
    start: Values,
    frames: Sequence[int],
    first: Fit | None,
    follow: Callable[..., Fit],
    over: Sequence[str] | None,
) -> Values | None:
    """Values that a search over starts leads to, if they lead."""
    own = starts.declared(variables, over)
    if not own or not any(model.usable(f).any() for f in frames):
        return None
    if first is not None and not _misfits(first):
        return None
    blind = first is None or not first.seen(own)
    most = starts.number_of_trials(model, frames, blind)
    ended: list[Fit] = []
    trials = (
        starts.search(model, variables, start, frames, most, over)[: starts.number_followed(model, frames)]
        if most
        else []
    )

    def size(values: Values) -> float:
        return sum((value_of(model, values, variables[i]) / variables[i].parameter.plausible) ** 2 for i in own)

    for n, (_, values) in enumerate(trials):
        try:
            ended.append(follow(values, max_iterations=SHORT, tolerance=1.0))
        except Underdetermined:  # as blind there as at the start
            continue
        if not _misfits(ended[-1]) and all(size(ended[-1].values) < size(other) for _, other in trials[n + 1 :]):
            break  # what is left is no better, and larger
    least = min((f.total for f in ended), default=math.inf)
    if not least < (math.inf if first is None else first.total - _lead(first)):
        return None
    alike = [f for f in ended if f.total - least < _lead(f)]
    return min((f.values for f in alike), key=size)


def _descend(
    descent: Descent, max_iterations: int, accuracy: float, negligible: float, asked: float, tick: Callable[[], None]
) -> tuple[list[float], str]:
    """Linearise and step until nothing worth a linearisation is promised: (misfit at each linearisation, why it
    stopped). Leaves the descent at the best point."""
    count = len(descent.variables)
    history: list[float] = []
    best, tries = (np.inf, np.inf, descent.theta, descent.values), 0
    for iteration in range(max_iterations):
        normal = descent.linearise(tick)
        _require_data(descent, normal)
        for _ in range(SCALINGS if iteration == 0 else 0):  # sigma goes with the prediction: once more at the new scale
            if not descent.scale():
                break
            normal = descent.linearise(tick)
        history.append(normal.total)
        promise, excess = descent.promised, max(normal.chi2 - sum(normal.frame_n) + count, 0.0)
        enough = max(accuracy, negligible * excess)
        least = enough if negligible < NEGLIGIBLE else accuracy  # a fit that goes further takes larger steps to it
        if promise < enough:
            return history, _converged(len(history))
        if normal.total - promise > asked:
            return history, f"not followed: the linear model promised a fall of {promise:.3g}, and more was asked for"
        near = promise < NEAR * count
        if near:
            descent.creep()
            if normal.total + promise < best[0] + best[1]:  # as rough as chi2 is, what is promised counts beside it
                best = (promise, normal.total, descent.theta, descent.values)
            followed = descent.around()
            if followed > FOLLOWED * promise:
                continue
            tries += 1
            # the last steps gained less than a quarter of what is promised, or good enough was reached before
            stuck = len(history) > 1 and history[-2] - promise / 4 < history[-1]
            if (tries > TRIES and stuck) or (tries > 1 and best[0] < count / 2):
                break
        gained = (followed if near else 0.0) + descent.chord(
            STEPS_NEAR if near else STEPS,
            WORTH * least,
            NEAR * count if near else 0.0,
            PART,
            negligible if negligible > NEGLIGIBLE else 0.0,
        )
        if negligible > NEGLIGIBLE and gained < negligible * excess:
            return history, f"converged to {negligible:.2g} of the misfit after {iteration + 1} linearisations"
        if gained < accuracy and not near:
            return history, f"no lower misfit within reach; the linear model still promised {promise:.3g}"
    else:
        if best[0] >= count / 2:
            return (
                history,
                f"stopped after {max_iterations} linearisations without converging; allow more or start nearer",
            )
    descent.theta, descent.values = best[2:]
    if best[0] < count:
        return history, _converged(len(history))
    return history, f"the linear model still promised a fall of {best[0]:.3g}, which no step brought"


def _converged(linearisations: int) -> str:
    """A fit that starts at its optimum, as one that is taken up again does, needs one to know it."""
    if linearisations == 1:
        return "converged: the start is the optimum, by one linearisation"
    return f"converged after {linearisations} linearisations"


def _require_data(descent: Descent, normal: Normal) -> None:
    """Raise Underdetermined when no value is usable or no variable changes anything."""
    variables, frames = descent.variables, descent.frames
    if sum(normal.frame_n) == 0:
        names = [descent.model.frames[f].name for f in frames]
        raise Underdetermined(
            f"no usable value in the {len(frames)} frames to fit ({some(names)}): all are saturated, at black, or "
            "masked; check [noise] black_level and saturation in captures.toml, and the masks"
        )
    if variables and not np.diag(normal.a).any():
        there = [f"{v.name} = {value:.4g}{spaced(v.parameter.unit)}" for v, value in zip(variables, descent.theta)]
        raise Underdetermined(
            f"none of the {len(variables)} free parameters changes any frame: at {some(there)}; allowed: parameters "
            "that some frame depends on; free others, or correct what the frames set"
        )


def _fit_at(descent: Descent, history: list[float], reason: str, start: np.ndarray) -> Fit:
    """The fit that a descent has come to, linearised there."""
    variables, normal, theta = descent.variables, descent.here, _turned_back(descent)
    covariance = covariance_of(normal.a)
    best = theta + np.where(np.isfinite(covariance), covariance, 0.0) @ normal.b  # of the linearisation, bounds or not
    # of variables with priors, the degrees of freedom that these and not the data hold: sum of c_ii/sd_i^2
    held = sum(
        float(np.clip(c * v.precision, 0.0, 1.0)) for v, c in zip(variables, np.diag(covariance)) if v.precision > 0
    )
    result = Fit(
        descent.values,
        variables,
        theta,
        covariance,
        normal.chi2,
        round(sum(normal.frame_n) - len(variables) + held),
        descent.frames,
        normal.frame_chi2,
        normal.frame_n,
        reason.startswith("converged"),
        reason,
        history,
        start=start,
        at_bound=[
            v.name
            for v, t, lo, hi, sd, to in zip(
                variables, theta, descent.low, descent.high, np.sqrt(np.diag(covariance)), best
            )
            if t <= lo or t >= hi or (v.parameter.factor and sd < np.inf and (t < OFF * sd or to <= lo))
        ],
        normal=normal,
    )
    result.warnings = warnings_of(result, normal.a)
    return result


def _turned_back(descent: Descent) -> np.ndarray:
    """The values that a descent has come to; periodic ones within half a period of their prior, or of neutral."""
    theta = np.array(descent.theta, float)
    for i, v in enumerate(descent.variables):
        middle = v.prior[0] if v.prior is not None else v.parameter.neutral
        if math.isfinite(v.parameter.period) and middle is not None:
            turns = round((theta[i] - middle) / v.parameter.period)
            if turns:
                theta[i] -= turns * v.parameter.period
                descent.values.put(v, theta[i])
    return theta


def extended(
    model: Model,
    base: Fit,
    extra: Sequence[Variable],
    secant: Mapping[str, float] | None = None,
    steps: int = 10,
    seed: int = 0,
    negligible: float = 0.0,
) -> Fit:
    """Free further variables and calibrate everything again, by chord steps on a converged fit's derivative images.

    Each step costs one prediction, where `fit` would make all derivative images again: for ranking many effects. The
    extra variables' images are tangents at the base's values, or secants of the sizes in `secant`. The steps follow the
    true prediction, so the result is a true minimum along them; only its last digits and its errors are those of the
    base's linearisation. `converged` says whether the fall that is still predicted is below 1 per variable. A gain
    below the share `negligible` of what is left beyond noise ends them.

    Where predictions have sampling errors, these images have samples of their own, of two seeds that belong to `seed`:
    errors that an image shared with the predictions would draw the root of J'Wr to where they are small, and the square
    of its own errors would be taken for information."""
    if base.normal is None:
        raise ValueError("extended: the base fit has no linearisation; give a result of `fit`")
    variables = [*base.variables, *extra]
    p, first = len(variables), len(base.variables)
    index_of = {v.name: i for i, v in enumerate(variables)}
    values = with_start(model, extra, base.values)
    a, b = np.zeros((p, p)), np.zeros(p)
    rows: list[Rows] = []
    a[:first, :first] = base.normal.a
    pairs = _twice(model, values, extra, base.frames, secant or {}, seeds_apart(seed))
    predictions = model.predict(values, base.frames)
    for frame, (where, j, scale), prediction, (one, other) in zip(base.frames, base.normal.rows, predictions, pairs):
        sides = stacked(one, scale), stacked(other, scale)
        new = (sides[0] + sides[1]) / 2
        there = np.array([index_of[n] for n in one], int)
        whitened = whiten(model, frame, prediction, scale)
        product = sides[0].astype(float) @ sides[1].astype(float).T
        a[np.ix_(there, there)] += (product + product.T) / 2
        cross = j.astype(float) @ new.astype(float).T
        a[np.ix_(where, there)] += cross
        a[np.ix_(there, where)] += cross.T
        acting, both = np.array([*where, *there], int), np.concatenate([j, new])
        rows.append((acting, both, scale))
        b[acting] += both.astype(float) @ whitened
    pull, curvature, prior = prior_terms(model, variables, values)
    a[first:, first:] += np.diag(curvature[first:])
    descent = Descent(model, variables, values, base.frames, damping=CHORD_DAMPING)
    descent.take(Normal(a, b + pull, base.chi2, prior, base.frame_chi2, base.frame_n, rows))
    before, promised = descent.here.total, descent.promised
    descent.chord(steps, WORTH * p, negligible=negligible)
    here = descent.here
    return Fit(
        descent.values,
        variables,
        descent.theta,
        covariance_of(here.a),
        here.chi2,
        base.dof - len(extra),
        base.frames,
        here.frame_chi2,
        here.frame_n,
        descent.promised < p,
        "chord steps",
        [before, here.total],
        promised=promised,
    )


def _twice(
    model: Model,
    values: Values,
    variables: Sequence[Variable],
    frames: Sequence[int],
    secant: Mapping[str, float],
    seeds: tuple[int, int],
) -> Iterator[tuple[dict[str, np.ndarray], dict[str, np.ndarray]]]:
    """Per frame, derivative images by name of two seeds; the same images twice once those of a frame are found not to
    depend on the seed."""

    def images(frames: Sequence[int], seed: int) -> Iterator[dict[str, np.ndarray]]:
        return (own for _, own in model.derivatives(values, variables, frames, secant=secant, seed=seed))

    exact = False
    others: Iterator[dict[str, np.ndarray]] = iter(())
    for n, one in enumerate(images(frames, seeds[0])):
        if exact:
            yield one, one
            continue
        if n < 2:  # of the first frame alone: it may tell that the others need none
            others = images(frames[:1] if n == 0 else frames[1:], seeds[1])
        other = next(others)
        exact = bool(one) and all(np.array_equal(one[k], other[k], equal_nan=True) for k in one)
        yield one, other
