"""Refits: an effect is added, everything is calibrated again, and what comes of it is compared with its score."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from optics.diagnosis import statistics as st
from optics.diagnosis.evidence import Candidate, Evidence, Progress, at_bound
from optics.diagnosis.result import Refit
from optics.diagnosis.score import Table
from optics.diagnosis.session import FEWEST_FRAMES, Frames, Session
from optics.diagnosis.thresholds import CLEAR, JUDGED
from optics.fit import calibrate, gauges
from optics.fit.model import Model, value_of
from optics.fit.result import Fit
from optics.scene.declare import Effect
from optics.scene.parameter import Values, Variable
from optics.words import percent, spaced

START = 0.7  # of the expected change, to begin a refit from: the linear estimate overshoots more often than not
LOW_START = 0.1  # of the expected change: a second start, for effects whose images bend
ENOUGH = 0.5  # of the predicted fall: a refit that brings it needs no second start
IMPLAUSIBLE, TIMES = 10.0, "times the plausible strength"  # flagged
NONLINEAR = 2.0  # factor between the fall and its prediction, beyond which an effect is flagged
ROOM = 0.9  # of the way to a bound that a start may go: at a bound, one-sided derivatives vanish
LEFT = 0.1  # of the way to a bound that the base keeps from it, for the same reason
GUIDED = 3.0  # plausible sizes that a start moves the base: beyond, the linearisation is no guide
LOOKS = 3  # at an effect's image, to find the strength at which it was taken
SEEN_AT = 0.25  # relative change of the strength below which its image needs no further look
ROUGH = 0.5  # chi2 per variable at which a refit of a diagnosis, which compares falls far above 1, may stop
# Of what a refit leaves beyond noise: a promised fall below it is not worth another linearisation. Where misfit is
# left, falls that differ by less than a fifth decide nothing (`optics.diagnosis.thresholds.MARGIN`).
COARSE = 0.01
TINY = 1e-12  # of gains and of squares of their changes
SEVERAL = 3  # lights whose changes from frame to frame are told
FEW = 12  # iterations of a refit of images that continues one: it has been brought near
FAILURES = (ValueError, ArithmeticError, np.linalg.LinAlgError)  # by which a refit says that it has no result


@dataclass(frozen=True)
class Cooled:
    """What a diagnosis begins again from, where an explanation leaves so little that what is known counts less than it
    did in the base (`optics.fit.tempering`): every explanation, and the base, is then held to it alike.

    base    calibrated with priors that count as that explanation asks;   refit, foresee   as of
            `optics.diagnosis.diagnose.diagnose`, from there;   remark: a warning that the diagnosis gets
    """

    base: Fit
    refit: Callable[..., Fit]
    foresee: Callable[[Sequence[Sequence[Variable]], Progress], None]
    remark: str


@dataclass(frozen=True)
class Expected:
    """Effects that an earlier diagnosis of the study found beside one that was added since, and where: the values of
    the fit with all of them. A base that lacks them may have moved to where none of them shows."""

    names: frozenset[str]
    values: Values


@dataclass
class Case:
    """A calibrated model under diagnosis; the arguments are those of `optics.diagnosis.diagnose.diagnose`.

    over_dials   (explanation, its effect with a strength per frame) -> lead over errors of dials, where it was asked"""

    model: Model
    fit: Fit
    evidence: Evidence
    table: Table
    refit: Callable[..., Fit]
    fitted: list[int]
    held_out: list[int]
    variables_of: Callable[[Effect], Sequence[Variable]]
    rows_max: int
    seed: int
    say: Progress
    places: list[dict[str, np.ndarray]] | None = None
    foresee: Callable[[Sequence[Sequence[Variable]], Progress], None] | None = None
    expected: Sequence[Expected] = ()
    negligible: float = COARSE
    over_dials: dict[tuple[frozenset[str], str], float] = field(default_factory=dict)

    @cached_property
    def session(self) -> Session:
        """Of a table."""
        return Session(self.model, self.evidence)

    @cached_property
    def lamp(self) -> Frames | None:
        """Of images; None where there are too few of them, or too few values in each."""
        enough = len(self.evidence.frames) >= FEWEST_FRAMES and min(len(b.r) for b in self.evidence.blocks) >= JUDGED
        return Frames(self.model, self.evidence) if enough else None

    @property
    def measured(self) -> bool:
        """Whether repeats fix the size of the noise."""
        return self.model.captures is not None and self.model.captures.noise is None

    @property
    def base(self) -> list[Variable]:
        """The variables of the fit that act in the fitted frames."""
        return [v for v in self.fit.variables if v.frames is None or set(v.frames) & set(self.fitted)]

    @property
    def before(self) -> float:
        """chi2 of the base, with its priors."""
        return self.evidence.normal.square + self.prior_chi2(self.fit.values)

    def prior_chi2(self, values: Values) -> float:
        """What the base's priors add to chi2, as often as they count beside it (`Variable.weight`)."""
        return sum(v.weight * square for v, square in self._from_priors(values))

    def known_chi2(self, values: Values) -> float:
        """The same, once: what was known before contradicts the values by so much, whatever images say."""
        return sum(square for _, square in self._from_priors(values))

    def _from_priors(self, values: Values) -> list[tuple[Variable, float]]:
        return [
            (v, ((value_of(self.model, values, v) - v.prior[0]) / v.prior[1]) ** 2)
            for v in self.fit.variables
            if v.prior is not None
        ]


@dataclass
class Attempt:
    """A refit that had a result.

    fall, after   of chi2 with the base's weights, priors included; expected: `after` if the model were true
    images        whitened residuals (H, W, C) of each frame
    """

    fit: Fit
    fall: float
    after: float
    expected: float
    images: list[np.ndarray]


def refit_each(case: Case, chosen: Sequence[Candidate]) -> dict[str, Fit]:
    """Refit with each chosen effect and write the result into its row; {effect: fit} of those that had one."""
    fits = {}
    if case.foresee is not None:
        case.foresee([c.variables for c in chosen], case.say)
    for n, c in enumerate(chosen):
        case.say("refit", n, len(chosen))
        predicted, linear = _look_again(case, c)
        best = _best_attempt(case, c, predicted, linear)
        if best is None:
            c.row.flags.append("refit without a result")
            continue
        fits[c.effect.name] = best.fit
        write(case, c, best, predicted)
    case.say("refit", len(chosen), len(chosen))
    return fits


def _best_attempt(case: Case, c: Candidate, predicted: float, linear: np.ndarray) -> Attempt | None:
    """The refit with the largest fall; None where none had a result.

    Where an image is not proportional to its strength, other minima lie between a weak effect and a strong one: such an
    effect starts from its full strength as well, and any effect from a weak one, until a start brings ENOUGH."""
    best = None
    starts = [(START, 0.0), *([(1.0, ENOUGH)] if c.form == "secant" else []), (LOW_START, ENOUGH)]
    for fraction, enough in starts:
        if enough and (predicted < CLEAR or best is not None and best.fall > enough * predicted):
            break
        try:
            refitted = with_effects(case, [(c, linear)], fraction)
        except FAILURES as error:
            c.row.flags.append(f"refit failed: {error}")
            continue
        found = weighed(case, refitted)
        if math.isfinite(found.after) and (best is None or found.fall > best.fall):
            best = found
    if best is not None and any(math.isfinite(v.parameter.period) for v in c.variables):
        best = _nearer(case, c, best)
    for e in case.expected:
        if e.names == {c.effect.name} and (best is None or after_at(case, e.values) < best.after - CLEAR):
            there = from_there(case, [c], e.values)
            again = None if there is None else weighed(case, there)
            if again is not None and math.isfinite(again.after) and (best is None or again.fall > best.fall):
                best = again
    return best


def _nearer(case: Case, c: Candidate, best: Attempt) -> Attempt:
    """Of strengths that a period repeats, the refit that begins near neutral, if it explains as much with less: two
    films that are both turned by a quarter let the same light pass."""

    def sizes(found: Fit) -> np.ndarray:
        return (np.array([value_of(case.model, found.values, v) for v in c.variables]) - c.start) / c.plausible

    far = sizes(best.fit)
    if np.abs(far).max() <= IMPLAUSIBLE:
        return best
    start = best.fit.values.copy()
    for v, at, size in zip(c.variables, c.start, far * c.plausible * GUIDED / np.abs(far).max()):
        start.put(v, float(at + size))
    found = from_there(case, [c], start)
    near = None if found is None else weighed(case, found)
    if near is None or not near.fall > best.fall - CLEAR or np.abs(sizes(near.fit)).max() > np.abs(far).max():
        return best
    return near


def after_at(case: Case, values: Values) -> float:
    """chi2 at values, by the base's weights, priors included."""
    return chi2(case, values)[0] + case.prior_chi2(values)


def further(
    model: Model,
    variables: Sequence[Variable],
    start: Values,
    frames: Sequence[int],
    *,
    asked: float = math.inf,
    negligible: float = COARSE,
) -> Fit:
    """A calibration of images that continues another one, as far as a diagnosis needs it."""
    return calibrate.fit(
        model, variables, start, frames, max_iterations=FEW, tolerance=ROUGH, negligible=negligible, asked=asked
    )


def from_there(case: Case, members: Sequence[Candidate], values: Values) -> Fit | None:
    """The refit of effects from values that another fit came to; None without a result."""
    variables = [*case.base, *(v for c in members for v in c.variables)]
    frames = list(case.fitted)
    try:
        if case.evidence.is_table:  # of readings, to its end
            return calibrate.fit(case.model, variables, values, frames)
        return further(case.model, variables, values, frames, negligible=case.negligible)
    except FAILURES:
        return None


def with_effects(case: Case, effects: Sequence[tuple[Candidate, np.ndarray]], fraction: float) -> Fit:
    """Refit with effects, from a fraction of their expected change; raises one of FAILURES without a result."""
    variables = [*case.base, *(v for c, _ in effects for v in c.variables)]
    return case.refit(case.model, variables, _start(case, effects, fraction), frames=list(case.fitted))


def weighed(case: Case, found: Fit) -> Attempt:
    """A refit with what it leaves, by the base's weights."""
    after, expected, images = chi2(case, found.values)
    after += case.prior_chi2(found.values)
    return Attempt(found, case.before - after, after, expected, images)


def write(case: Case, c: Candidate, best: Attempt, predicted: float) -> None:
    """Write a refit into the row of its effect, with flags for what is unusual."""
    found, evidence = best.fit, case.evidence
    strength = [value_of(case.model, found.values, v) for v in c.variables]
    sd = {v.name: float(s) for v, s in zip(found.variables, found.sd)}
    ended = [v.name for v, s, at in zip(c.variables, strength, c.start) if at_bound(v, s) and abs(s - at) > 0]
    ratio = best.fall / predicted if predicted > 0 else math.nan
    c.row.refit = Refit(
        fall=best.fall,
        predicted=predicted,
        ratio=ratio,
        chi2_before=case.before,
        chi2_after=best.after,
        strength=strength,
        sd=[sd.get(v.name, math.nan) for v in c.variables],
        at_bound=ended,
        excess_sd=excess_of(evidence, best.after, best.expected, [c]),
        structure_p=evidence.structure(best.images, [*evidence.base, *c.columns]).p,
        converged=bool(found.converged),
        reason=str(found.reason),
        clear=clear(found, c, strength),
        told=known_of(found, c),
    )
    size = np.abs(np.array(strength) - c.start) / c.plausible
    unusual = {
        "nonlinear": not 1 / NONLINEAR <= ratio <= NONLINEAR and predicted > CLEAR,
        "at a bound": bool(ended),
        f"{size.max():.2g} {TIMES}": size.max() > IMPLAUSIBLE and best.fall > CLEAR,
    }
    kept = [flag for flag in c.row.flags if flag not in unusual and not flag.endswith(TIMES)]  # of an earlier refit
    c.row.flags[:] = [*kept, *(flag for flag, so in unusual.items() if so)]


def known_of(found: Fit, c: Candidate) -> str:
    """What is known of strengths of which a gauge leaves only combinations, or of which each frame has one, in words;
    '' where each is known."""
    if c.effect.scope == "frame":
        return _from_frame_to_frame(found, c)
    names = [v.name for v in found.variables]
    if not all(v.name in names for v in c.variables):
        return ""
    own = [names.index(v.name) for v in c.variables]
    covariance = np.asarray(found.covariance, float)[np.ix_(own, own)]
    text = gauges.strengths_told(covariance, c.variables, [float(found.estimate[i]) for i in own])
    return text if "not show" in text else ""


def _swings_of(found: Fit, c: Candidate) -> list[tuple[float, Variable]]:
    """How much the strengths of single frames vary (`_spread`), of each parameter, with a variable of it; the largest
    first."""
    asked, places = {v.name for v in c.variables}, dict[tuple[str, ...], list[int]]()
    for i, v in enumerate(found.variables):
        if v.name in asked:
            places.setdefault(v.keys, []).append(i)
    spreads = []
    for own in places.values():
        first = found.variables[own[0]]
        x, covariance = np.asarray(found.estimate, float)[own], np.asarray(found.covariance, float)[np.ix_(own, own)]
        if first.parameter.neutral == 1:  # factors, of which nobody may know the scale: relative to their mean
            x = np.maximum(x, TINY)
            x, covariance = np.log(x), covariance / np.outer(x, x)
        spreads.append((_spread(x, covariance), first))
    return sorted(spreads, key=lambda t: -t[0])


def _spread(x: np.ndarray, covariance: np.ndarray) -> float:
    """Standard deviation of values about their mean, less what their errors make of it: those of a dim light scatter.
    An error that all share, as of a scale, is none of it. Each value counts by the variance that it has of both.

    Source: DerSimonian & Laird, Meta-analysis in clinical trials, Control. Clin. Trials 7, 177 (1986)."""
    known = np.isfinite(np.diag(covariance)) & (np.diag(covariance) > 0)
    x, covariance = x[known], covariance[np.ix_(known, known)]
    if len(x) < 2:
        return 0.0
    others = np.where(np.eye(len(x), dtype=bool), np.nan, covariance)
    own, square = np.maximum(np.diag(covariance) - np.nanmedian(others, 0), TINY), 0.0  # less what most share
    for _ in range(3):
        weight = 1 / (own + square)
        weight /= weight.sum()
        about = np.eye(len(x)) - weight
        square = max(float(weight @ ((about @ x) ** 2 - np.diag(about @ covariance @ about.T))), 0.0)
    return math.sqrt(square)


def _from_frame_to_frame(found: Fit, c: Candidate) -> str:
    """'1.9 % (rms from frame to frame)' of strengths that each frame has for itself, or of each part that has them:
    'led_red 1.9 %, led_blue 0.1 % (rms from frame to frame)', the largest first."""
    ranked = _swings_of(found, c)
    parts = [v.keys[0].rpartition(".")[0] for _, v in ranked]
    texts = []
    for (rms, v), part in zip(ranked, parts):
        of = "" if len(ranked) == 1 else f"{part} " if parts.count(part) == 1 else f"{v.keys[0]} "
        texts.append(of + (percent(rms, 2) if v.parameter.neutral == 1 else f"{rms:.2g}{spaced(v.parameter.unit)}"))
    more = f", {len(texts) - SEVERAL} others less" if len(texts) > SEVERAL else ""
    return f"{', '.join(texts[:SEVERAL])}{more} (rms from frame to frame)" if texts else ""


def swings(found: Fit, c: Candidate) -> float:
    """Of strengths that each frame has for each part, how much those of one part vary, in plausible sizes: the largest
    standard deviation. 0 for other effects."""
    if c.effect.scope != "frame" or c.effect.per == "kind":
        return 0.0
    return max((rms / v.parameter.plausible for rms, v in _swings_of(found, c)), default=0.0)


def clear(found: Fit, c: Candidate, strength: Sequence[float]) -> float:
    """sqrt(d' C^-1 d) of the strengths' change d and their covariance C: standard deviations from none. NaN where C is
    unknown."""
    names = [v.name for v in found.variables]
    own = [names.index(v.name) for v in c.variables if v.name in names]
    covariance = np.asarray(found.covariance, float)[np.ix_(own, own)]
    if len(own) < len(c.variables) or not np.isfinite(covariance).all():
        return math.nan
    change = np.array(strength) - c.start
    inverse, rank = st.inverse(covariance)
    return math.sqrt(max(float(change @ inverse @ change), 0.0)) if rank else math.nan


def _look_again(case: Case, c: Candidate) -> tuple[float, np.ndarray]:
    """(predicted fall of a refit, coefficients) of an effect by its image at the strength that was found, not at the
    plausible one.

    A secant to the plausible strength is the wrong image where a weak effect has another shape than a strong one: leaks
    that add in amplitude, two components of one retardance. Scores and tests keep their values."""
    model, evidence, values = case.model, case.evidence, case.fit.values
    fall, linear, first = c.row.fall, c.linear, len(evidence.columns)
    if c.form != "secant" or not linear.any():
        return fall, linear
    plain, k = evidence.thinned(extra=1), evidence.thinning
    before = model.predict(values, evidence.frames, evidence.seed)
    for _ in range(LOOKS):
        there, normal = values.copy(), plain.copy()
        for v, start, step in zip(c.variables, c.start, c.change_of(linear)):
            there.put(v, float(np.clip(start + step, *v.parameter.bounds)))
        for block, old, new in zip(evidence.blocks, before, model.predict(there, evidence.frames, evidence.seed)):
            image = (np.asarray(new, float) - old).reshape(-1)[block.index] / block.sigma
            st.add_bins(normal, block.where, block.middle, block.r, first, np.zeros(len(block.r), int), 1, [image])
        projected = evidence.project(normal, evidence.base, [first], k)
        information, score = projected.information[0, 0], projected.score[0]
        if not (math.isfinite(score) and projected.survival[0] > st.VISIBLE and score > 0):
            return c.row.fall, c.linear
        fall, times = k * score**2 / information, score / information
        if abs(times - 1) < SEEN_AT:
            break
        linear = linear * min(max(times, 0.1), 10.0)  # one look trusts a linearisation over one decade
    return float(fall), linear


def _start(case: Case, effects: Sequence[tuple[Candidate, np.ndarray]], fraction: float) -> Values:
    """Effects at a fraction of their expected change, and the base where it would move to make room for them."""
    evidence, first = case.evidence, len(case.evidence.base)
    values, moves = case.fit.values.copy(), np.zeros(first)
    for c, linear in effects:
        linear = linear * fraction
        for v, start, step in zip(c.variables, c.start, c.change_of(linear)):
            low, high = v.parameter.bounds
            lowest = start + ROOM * (low - start) if math.isfinite(low) else -math.inf
            highest = start + ROOM * (high - start) if math.isfinite(high) else math.inf
            values.put(v, float(np.clip(start + step, lowest, highest)))
        moves = moves + evidence.projected.response[:, np.array(c.columns) - first] @ linear
    for i, move in zip(evidence.base, moves):
        v = evidence.columns[i]
        here = value_of(case.model, case.fit.values, v)
        limit = GUIDED * abs(v.parameter.plausible)
        to = here + float(np.clip(move, -limit, limit))
        low, high = v.parameter.bounds
        lowest = low + LEFT * (here - low) if math.isfinite(low) else to
        highest = high - LEFT * (high - here) if math.isfinite(high) else to
        values.put(v, float(np.clip(to, lowest, highest)))
    return values


def chi2(case: Case, values: Values) -> tuple[float, float, list[np.ndarray]]:
    """chi2 of other values with the base's pixels and weights, its expectation if they were true, and the whitened
    residual images (H, W, C).

    Brighter pixels are noisier: with the base's weights, chi2 of the truth is sum of variance/sigma^2, not the number
    of values. Errors of Monte Carlo estimates count as at the base (`noisier`)."""
    total, expected, images = 0.0, 0.0, []
    evidence, model = case.evidence, case.model
    predicted = model.predict(values, evidence.frames)
    for frame, prediction, sigma, use in zip(evidence.frames, predicted, evidence.sigma, evidence.use):
        image = np.where(use, (np.asarray(model.frames[frame].image, float) - prediction) / sigma, 0.0)
        total += float(np.sum(image**2))
        variance = evidence.variance(model, frame, np.asarray(prediction, float), values)
        expected += float(np.sum(np.where(use, variance, 0.0) / sigma.astype(float) ** 2))
        images.append(image)
        more = noisier(case, frame, values, case.fit.values, use, sigma)
        total, expected = total - more, expected - more
    return total, expected, images


def noisier(case: Case, frame: int, values: Values, before: Values, use: np.ndarray, sigma: np.ndarray) -> float:
    """What errors of Monte Carlo estimates add to chi2 of a frame more than at the values `before`; 0 where images are
    exact.

    A prediction with an error e of its own leaves (r - e)^2, on average r^2 + e^2. Strengths of which images show next
    to nothing are drawn to where e is small: twice the absorption of a printed grid, with lights made stronger, took 12
    off chi2, of which 4 were left for predictions by other random numbers."""
    if not case.model.monte_carlo:
        return 0.0
    own, other = (case.model.error_of_estimate(v, frame) for v in (values, before))
    return float(np.sum(np.where(use, own - other, 0.0) / np.asarray(sigma, float) ** 2))


def excess_of(evidence: Evidence, after: float, expected: float, added: Sequence[Candidate]) -> float:
    """Standard deviations by which chi2 with these effects exceeds its expectation if nothing else were missing."""
    free = evidence.projected.rank + sum(len(c.cone.live) for c in added)
    return (after - expected + free) / math.sqrt(2 * max(evidence.normal.count - free, 1))
