"""Explanations: sets of one, two or three effects, refitted together, that compete on equal terms.

Every explanation is calibrated together with all that the base calibrates. What counts is its score

    score = fall - cost
    cost  = ln det(1 + t V t) + sum over effects (3 ln(1 + x^2/2) + EACH)

with the fall of deviance, V the information that the data hold on the strengths (k, k), t their plausible sizes, and x
how far an effect's strengths are from neutral, in plausible sizes. The first term of the cost is what strengths could
have fitted, whatever the data are: the Occam factor of a marginal likelihood whose prior is t wide. The second is the
density of Student's t with two degrees of freedom: a strength of 36 plausible sizes costs 19. The third is the prior
odds of an effect. The deviance is chi2 in units of what the best explanation leaves, or of the noise that is stated
where that is more; of readings, each explanation may have noise that neighbours share besides
(`optics.diagnosis.correlation`): a lamp that wanders is a rival of whatever changes slowly.

Whether an explanation needs an effect that a simpler one lacks is a question of significance: family-wise; of images,
with the design effect of what tells the two apart (`optics.diagnosis.homogeneity.variances`), by which the price of a
lamp that wanders is not divided: frames tell it, not pixels. Of two that are not
nested, one is told apart from the best when its score is TOLD lower (CLEAR, where plausibility alone decides; an effect
is claimed when every explanation without it is SURE lower, and NO_TIE where plausibility alone decides, and when it
adds more to the fall than its strengths' distance from neutral costs: chance brings a significant fall by strengths
that nobody expects); of readings,
what it predicts better of blocks of the session that were left out counts against that lead; and when, of images or of
readings with MISSTATED noise, the difference of falls exceeds the smaller of HALF of what the best one leaves and
MARGIN of its fall, as misfit that is left may lie along any direction; and of images, where misfit is left, noise that
frames share rules out nothing that leaves less by itself at no more cost. All others survive. An effect that is part of
every explanation that survives is missing, whichever of them is right.

Sources: MacKay, Bayesian interpolation, Neural Computation 4, 415 (1992), Occam factor; Vuong, Econometrica 57, 307
(1989), the variance of a difference of log likelihoods."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest

import numpy as np
from scipy.special import chdtri

from optics.diagnosis import homogeneity, pairs
from optics.diagnosis import statistics as st
from optics.diagnosis.correlation import NOTICED, SHORTEST, Correlation, Readings
from optics.diagnosis.evidence import Candidate, at_bound, measure, priors, silent
from optics.diagnosis.refit import (
    FAILURES,
    START,
    Case,
    clear,
    excess_of,
    from_there,
    known_of,
    weighed,
    with_effects,
    write,
)
from optics.diagnosis.result import Explanation, leaves_nothing
from optics.diagnosis.score import solve
from optics.diagnosis.session import Frames
from optics.diagnosis.thresholds import CLEAR, EACH, EXCESS, HALF, LEVEL, MARGIN, MISSTATED, NO_TIE, SURE, TOLD
from optics.fit import calibrate
from optics.fit.model import value_of
from optics.fit.result import Fit
from optics.scene.parameter import Values, Variable

LARGEST = 3  # effects of one explanation
LEADERS, FOLLOWERS = 3, 4  # explanations that are extended in each round, and effects that each is extended by
REACH = 3 * CLEAR  # of the best score: an explanation that is expected to stay farther behind is not refitted
LINEAR = 0.1  # relative difference of a refit's fall from the one expected, below which nothing is linearised again
NEARLY = 0.9  # the same beside an explanation that leaves nothing
TRUSTED = 0.7  # of what a linearisation expects: an explanation that is expected to fall short by more is not refitted
BLOCKS = 8  # pieces of a session, each left out once
LEAST = 2  # values per number that is fitted, below which no set of effects is refitted
CONTENDERS = 40  # explanations of a table whose shared noise is sought; others are behind without it
WIDTHS = np.geomspace(0.003, 3.0, 13)  # plausible sizes: of the prior of strengths of each frame
ALONE = 0.01  # of what all readings know of a direction: what the others know where a block alone determines it
ALIKE = 1.0  # chi2 between the predictions of two explanations, of all values, below which they are the same
LOOSE = 10.0  # plausible sizes: what keeps a strength that a left-out block alone determines near neutral


@dataclass(eq=False)
class Trial:
    """An explanation that was refitted.

    members    effects, none for the base;   fit, fall, after, expected, images   as of `optics.diagnosis.refit.Attempt`
    cost       see the module
    deviance   see the module; NaN before the competition;   gain: what shared noise lowers it by
    price      of images, what a lamp that wanders costs of it (`optics.diagnosis.correlation.Correlation`)
    readings   of a table, or frames of images, about it; None before
    settled    chi2 of its priors beside a lamp, by the lamp (`_from_priors`)
    bare       whether it leaves no more of images than noise that is stated too small (MISSTATED), without structure,
               and a lamp that wanders unnoticed
    ahead      chi2 of the blocks that were left out in turn, less that of the base; NaN where it was not computed
    refuted    what rules it out besides its score, in words; '' for nothing
    dials      whose errors, which nobody states, it needs to survive (`optics.diagnosis.dials_as_rival`); '' for none
    """

    members: list[Candidate]
    fit: Fit
    fall: float
    after: float
    expected: float
    images: list[np.ndarray]
    cost: float = 0.0
    excess_sd: float = 0.0
    structure_p: float = math.nan
    deviance: float = math.nan
    gain: float = 0.0
    price: float = 0.0
    readings: Readings | None = None
    settled: dict[tuple[float, float], tuple[float, float]] = field(default_factory=dict)
    bare: bool = False
    ahead: float = math.nan
    refuted: str = ""
    dials: str = ""

    @property
    def names(self) -> frozenset[str]:
        return frozenset(c.effect.name for c in self.members)

    @property
    def expectation(self) -> float:
        """Mean fall if none of its effects were there."""
        return sum(c.cone.expectation for c in self.members)

    @property
    def keys(self) -> set:
        return {(key, v.frames) for c in self.members for v in c.variables for key in v.keys}

    @property
    def by_frame(self) -> bool:
        """Whether it has a strength for each frame: what a lamp does there, it explains."""
        return any(c.effect.scope == "frame" for c in self.members)

    @property
    def complete(self) -> bool:
        """Whether it leaves nothing to explain."""
        return self.bare or leaves_nothing(self.structure_p, self.excess_sd)

    def left(self, dof: int) -> float:
        """chi2 beyond its expectation, 0 or more."""
        return max(self.excess_sd, 0.0) * math.sqrt(2 * dof)


@dataclass
class Outcome:
    """What the competition came to.

    leader       the explanation with the best score; best: the simplest that is not told apart from it
    survivors    all that are not told apart from the best, the best first
    larger       explanations that contain survivors and have a better score than any that they contain: that more is
                 needed is not shown, but likelier than not
    core         effects that every survivor has
    leads        explanation -> (lead of the best in score, lead needed)
    scale        chi2 per degree of freedom that the best leaves, at least 1; correlation: of the readings about it
    shared       whether noise that neighbouring readings share explains it as well as the best does
    wander       rms of such noise over that of the signal, where nothing else explains it
    untried      pairs of effects of images that may do better than the best by their scores, and were not refitted
    refuted      explanations that would survive, but for frames that were held out (`optics.diagnosis.held_out`) or for
                 strengths of each frame that follow a setting
    """

    leader: Trial
    best: Trial
    survivors: list[Trial]
    trials: list[Trial]
    scale: float
    correlation: Correlation
    leads: dict[frozenset[str], tuple[float, float]] = field(default_factory=dict)
    shared: bool = False
    wander: float = 0.0
    larger: list[Trial] = field(default_factory=list)
    untried: list[frozenset[str]] = field(default_factory=list)
    refuted: list[Trial] = field(default_factory=list)

    @property
    def core(self) -> list[str]:
        common = frozenset.intersection(*[t.names for t in self.survivors])
        return [c.effect.name for c in self.best.members if c.effect.name in common]

    @property
    def named(self) -> set[str]:
        """The effects of all survivors."""
        return {name for t in self.survivors for name in t.names}

    @property
    def base(self) -> Trial:
        """The explanation without effects."""
        return next(t for t in self.trials if not t.members)

    def score(self, trial: Trial) -> float:
        """Fall of deviance from chi2 of the base, less the cost."""
        return self.base.after / self.scale - trial.deviance - trial.cost

    def without(self, trial: Trial, name: str) -> Trial:
        """The trial with most of the other effects of a trial: what is lost without the one."""
        return max((t for t in self.trials if t.names <= trial.names - {name}), key=lambda t: t.fall)

    def own_fall(self, trial: Trial, name: str) -> float:
        """What an effect adds to the fall of the others of its trial."""
        return trial.fall - self.without(trial, name).fall

    def told(self) -> list[Explanation]:
        """All trials as records, the best first and those that were refuted last."""
        found: list[Explanation] = []
        same = self._same_as()
        for t in [*self.trials, *self.refuted]:
            sd = {v.name: float(s) for v, s in zip(t.fit.variables, t.fit.sd)}
            variables = [v for c in t.members for v in c.variables]
            estimates = {v.name: float(e) for v, e in zip(t.fit.variables, t.fit.estimate)}
            lead, needed = self.leads.get(t.names, (0.0, 0.0))
            found.append(
                Explanation(
                    effects=[c.effect.name for c in t.members],
                    fall=t.fall,
                    cost=t.cost,
                    excess_sd=t.excess_sd,
                    structure_p=t.structure_p,
                    lead=lead,
                    needed=needed,
                    ahead=t.ahead,
                    variables=[v.name for v in variables],
                    strength=[estimates.get(v.name, math.nan) for v in variables],
                    sd=[sd.get(v.name, math.nan) for v in variables],
                    units=[v.parameter.unit for v in variables],
                    survives=bool(t.members) and t in self.survivors,
                    told={c.effect.name: known_of(t.fit, c) for c in t.members if t in self.survivors},
                    same_as=same.get(t.names, ""),
                    larger=t in self.larger,
                    refuted=t.refuted if t in self.refuted else "",
                    dials=t.dials,
                    values=t.fit.values.record() if len(t.members) > 1 and t in [*self.survivors, *self.larger] else {},
                )
            )
        return found

    def _same_as(self) -> dict[frozenset[str], str]:
        """The survivors that predict the same values as a better one, by its name."""
        found: dict[frozenset[str], str] = {}
        first: list[Trial] = []
        for t in sorted((t for t in [*self.survivors, *self.larger] if t.members), key=self.trials.index):
            for o in first:
                if _distance(t, o) < ALIKE:
                    found[t.names] = " with ".join(c.effect.name for c in o.members)
                    break
            else:
                first.append(t)
        return found


def _distance(one: Trial, other: Trial) -> float:
    """chi2 between the predictions of two explanations, of all values."""
    return sum(float(np.sum((a - b).astype(float) ** 2)) for a, b in zip(one.images, other.images))


def apart(case: Case, true: Trial, other: Trial) -> float:
    """chi2, with what is known, by which another explanation as it was found misses data of the true one."""
    return _distance(true, other) + case.known_chi2(other.fit.values) - case.known_chi2(true.fit.values)


# -- what an explanation costs ---------------------------------------------------------------------------------------
def occam(information: np.ndarray, plausible: np.ndarray) -> float:
    """ln det(1 + t V t): what strengths could have fitted; 0 for those that no data determine."""
    scaled = information * np.outer(plausible, plausible)
    return float(np.sum(np.log1p(np.maximum(np.linalg.eigvalsh((scaled + scaled.T) / 2), 0.0))))


def implausible(c: Candidate, change: np.ndarray) -> float:
    """3 ln(1 + x^2/2), x the length of the change in plausible sizes; of strengths per frame, their rms."""
    square = np.square(np.asarray(change, float) / c.plausible)
    x2 = float(np.mean(square) if c.effect.scope == "frame" else np.sum(square))
    return 3 * math.log1p(x2 / 2) + EACH


def cost_of(case: Case, members: Sequence[Candidate], found: Fit) -> float:
    """Of a refit."""
    names = [v.name for v in found.variables]
    own = [names.index(v.name) for c in members for v in c.variables if v.name in names]
    covariance = np.asarray(found.covariance, float)[np.ix_(own, own)]
    known = np.isfinite(np.diag(covariance)) & (np.diag(covariance) > 0)
    t = np.concatenate([c.plausible for c in members])[: len(own)]
    by_frame = np.concatenate([np.full(len(c.variables), c.effect.scope == "frame") for c in members])[: len(own)]
    change = np.array([value_of(case.model, found.values, found.variables[i]) for i in own])
    change = change - np.concatenate([c.start for c in members])[: len(own)]
    total = 0.0
    if known.any():
        inner, size = covariance[np.ix_(known, known)], t[known]
        scaled, moved = inner / np.outer(size, size), change[known] / size
        total = _width_cost(scaled, np.where(by_frame[known], moved, 0.0), by_frame[known])
    return total + farness(case, members, found) + EACH * len(members)


def farness(case: Case, members: Sequence[Candidate], found: Fit) -> float:
    """What it costs that the strengths of a refit are far from neutral: 3 ln(1 + x^2/2) of each effect."""
    changes = [(c, np.array([value_of(case.model, found.values, v) for v in c.variables]) - c.start) for c in members]
    return sum(implausible(c, change) - EACH for c, change in changes)


def _width_cost(covariance: np.ndarray, change: np.ndarray, by_frame: np.ndarray) -> float:
    """ln det(1 + T C^-1) of strengths in plausible sizes, T their prior: 1, or of strengths of each frame the width w^2
    that costs least, with the prior's own chi2, change' (C + T)^-1 change: a lamp that wanders by 0.3 % could not have
    fitted 5 % in each frame."""

    def cost(width: float) -> float:
        prior = np.where(by_frame, width, 1.0)
        both = np.linalg.eigvalsh(covariance / np.outer(prior, prior))
        spread = float(np.sum(np.log1p(1 / np.maximum(both, 1e-12))))
        if not by_frame.any():
            return spread
        own = covariance[np.ix_(by_frame, by_frame)] + width**2 * np.eye(int(by_frame.sum()))
        return spread + float(change[by_frame] @ np.linalg.solve(own, change[by_frame]))

    return min(map(cost, WIDTHS)) if by_frame.any() else cost(1.0)


def expected_cost(c: Candidate) -> float:
    """Of an effect that was scored."""
    return occam(c.cone.information, c.plausible) + implausible(c, c.change_of(c.linear))


# -- the search ------------------------------------------------------------------------------------------------------
def search(case: Case, chosen: Sequence[Candidate], fits: dict[str, Fit]) -> Outcome:
    """Refit the sets of effects that may explain the residual, and let them compete.

    chosen   effects that were refitted one by one; fits: their fits, to which those that are found here are added
    """
    trials = _singly(case, chosen, fits)
    _expected(case, trials)
    if not case.evidence.is_table:
        untried = _joined(case, trials)
        _within(case, trials, fits)
        return replace(compete(case, list(trials.values())), untried=untried)
    race = Race(case, trials)
    race.widen()
    for name in sorted(race.leader.names):
        race.widen(without=name)
    _within(case, trials, fits)
    outcome = compete(case, list(trials.values()))
    if race.exchange([*outcome.survivors, *outcome.larger]):
        _within(case, trials, fits)
        outcome = compete(case, list(trials.values()))
    return _weighed_by_blocks(case, outcome)


def _singly(case: Case, chosen: Sequence[Candidate], fits: dict[str, Fit]) -> dict[frozenset[str], Trial]:
    """No effect, and each that was refitted."""
    trials: dict[frozenset[str], Trial] = {frozenset(): _nothing(case)}
    for c in chosen:
        if c.effect.name in fits:
            trials[frozenset([c.effect.name])] = _trial(case, [c], fits[c.effect.name])
    return trials


def _expected(case: Case, trials: dict[frozenset[str], Trial]) -> None:
    """Refit the sets that an earlier diagnosis found, from where it left them."""
    for e in case.expected:
        members = [c for c in case.table.order if c.effect.name in e.names]
        if e.names in trials or len(members) < 2 or not _fits_in(case, members):
            continue
        found = from_there(case, members, e.values)
        if found is not None:
            trials[e.names] = _trial(case, members, found)


def _within(case: Case, trials: dict[frozenset[str], Trial], fits: dict[str, Fit]) -> None:
    """Refit the sets within the best explanations from where these are, without an effect that they can do without.

    The best effect may be one that no derivative of the base points to, and that is found beside another: of a plate of
    50 degrees the base's images show the turn of a film, and beside that turn the plate, which explains all. Where that
    makes a set the best one, its own parts are asked in turn."""
    for _ in range(LARGEST - 1):
        if not _without_one(case, trials, fits):
            break


def _without_one(case: Case, trials: dict[frozenset[str], Trial], fits: dict[str, Fit]) -> bool:
    """One round of that; whether any refit clearly explains more than was known."""
    scale, any_improved = _scale(case, trials.values()), False
    for t in sorted(trials.values(), key=lambda t: -_score(t, scale))[:LEADERS]:
        for c in t.members if len(t.members) > 1 else []:
            rest = [m for m in t.members if m is not c]
            names = t.names - {c.effect.name}
            loss = clear(t.fit, c, [value_of(case.model, t.fit.values, v) for v in c.variables]) ** 2
            known = trials.get(names)
            reached = known.fall if known is not None else -math.inf
            if not loss < REACH * scale or t.fall - loss < reached + CLEAR * scale:
                continue
            start = t.fit.values.copy()
            for v, at in zip(c.variables, c.start):
                start.put(v, float(at))
            if _improved(case, trials, fits, rest, start):
                found = trials[names].fall
                any_improved |= found > reached + CLEAR * scale
                # effects that the base hides as it hid this one explain about as much as this one does; where that is
                # far less than the best explains, they are no rivals of the best
                if len(rest) == 1 and found > TRUSTED * max(o.fall for o in trials.values()):
                    _rivals(case, trials, fits, rest[0])
    return any_improved


def _improved(
    case: Case, trials: dict[frozenset[str], Trial], fits: dict[str, Fit], members: list[Candidate], start: Values
) -> bool:
    """Refit a set from a start; whether it explains more than it did before."""
    names = frozenset(c.effect.name for c in members)
    found = from_there(case, members, start)
    made = None if found is None else _trial(case, members, found)
    if made is None or not made.fall > (trials[names].fall if names in trials else 0.0):
        return False
    trials[names] = made
    if len(members) == 1:
        fits[members[0].effect.name] = made.fit
        write(case, members[0], weighed(case, made.fit), members[0].row.net)
    return True


def _rivals(case: Case, trials: dict[frozenset[str], Trial], fits: dict[str, Fit], own: Candidate) -> None:
    """Refit the other effects from where one was found that the base had hidden: theirs may be hidden there as well."""
    values = fits[own.effect.name].values.copy()
    for v, at in zip(own.variables, own.start):
        values.put(v, float(at))
    known = [c for c in case.table.order if not c.broken]
    there = [Candidate.at(case.model, values, c.effect, c.variables) for c in known]
    try:
        evidence = measure(case.model, values, case.base, there, case.evidence.frames, case.rows_max, case.seed, silent)
        solve(evidence, there, case.seed)
    except FAILURES:
        return
    needed = TRUSTED * max((t.row.net for t in there if t.effect.name == own.effect.name), default=math.inf)
    for c, t in zip(known, there):
        if t.effect.name == own.effect.name or t.broken or not t.row.net > needed:
            continue
        start = values.copy()
        for v, at, step in zip(c.variables, t.start, START * t.change_of(t.linear)):
            start.put(v, float(np.clip(at + step, *v.parameter.bounds)))
        _improved(case, trials, fits, [c], start)


def _nothing(case: Case) -> Trial:
    """The base, as the explanation without effects."""
    evidence = case.evidence
    after = evidence.normal.square
    excess = excess_of(evidence, after, float(evidence.normal.count), [])
    return Trial([], case.fit, 0.0, case.before, after, evidence.whitened, 0.0, excess)


def _trial(case: Case, members: list[Candidate], found: Fit) -> Trial:
    made = weighed(case, found)
    columns = [*case.evidence.base, *(i for c in members for i in c.columns)]
    return Trial(
        members,
        found,
        made.fall,
        made.after,
        made.expected,
        made.images,
        cost_of(case, members, found),
        excess_of(case.evidence, made.after, made.expected, members),
        case.evidence.structure(made.images, columns).p,
        bare=not case.evidence.is_table and _is_bare(case, made.images, made.after, made.expected, columns),
    )


def _is_bare(case: Case, images: Sequence[np.ndarray], after: float, expected: float, columns: Sequence[int]) -> bool:
    """See `Trial`. A lamp adds a share of its signal to each frame: a w, with the whitened signal w of the frame as it
    was measured, and a = w'r / w'w."""
    evidence, black = case.evidence, float(case.model.noise.black_level)
    rest, swung, lit = [], 0.0, 0.0
    for frame, r, sigma, use in zip(evidence.frames, images, evidence.sigma, evidence.use):
        w = np.where(use, (np.asarray(case.model.frames[frame].image, float) - black) / sigma, 0.0)
        bright = max(float(np.sum(w**2)), 1e-300)
        a = float(np.sum(w * r)) / bright
        rest.append(r - a * w)
        swung, lit = swung + a**2 * bright, lit + bright
    most = 1 + EXCESS * math.sqrt(2 / max(evidence.normal.count, 1)) if case.measured else MISSTATED
    if swung > NOTICED**2 * lit or after - swung > most * expected:
        return False
    return evidence.structure(rest, columns).p >= LEVEL


def _score(trial: Trial, scale: float) -> float:
    return trial.fall / scale - trial.cost


def _scale(case: Case, trials: Iterable[Trial]) -> float:
    """chi2 per degree of freedom of the most complete explanation, at least 1."""
    best = max(trials, key=lambda t: t.fall)
    dof = max(case.evidence.normal.count - case.evidence.projected.rank - len(best.keys), 1)
    return max(1.0 + best.excess_sd * math.sqrt(2 * dof) / dof, 1.0)


def _leader(case: Case, trials: dict[frozenset[str], Trial]) -> Trial:
    scale = _scale(case, trials.values())
    return max(trials.values(), key=lambda t: _score(t, scale))


def _fits_in(case: Case, members: Sequence[Candidate]) -> bool:
    """Whether a set may be refitted: no strength twice, none that contains another, values enough for all of them."""
    keys = [key for c in members for v in c.variables for key in v.keys]
    numbers = case.evidence.projected.rank + sum(len(c.cone.live) for c in members)
    return len(set(keys)) == len(keys) and case.evidence.normal.count > LEAST * numbers


class Race:
    """The search among explanations of a table, whose refits take milliseconds; `trials` is filled."""

    def __init__(self, case: Case, trials: dict[frozenset[str], Trial]):
        self.case, self.trials = case, trials
        self.known: dict[frozenset[str], list[tuple[Candidate, float, Values]]] = {}

    @property
    def leader(self) -> Trial:
        return _leader(self.case, self.trials)

    def widen(self, without: str = "") -> None:
        """Extend the best explanations by the effects that explain most of what each of them leaves."""
        for size in range(1, LARGEST):
            # by falls as they are: what no explanation has reached yet must not count as noise
            ranked = sorted(self.trials.values(), key=lambda t: -_score(t, 1.0))
            top = _score(ranked[0], 1.0)
            leaders: list[Trial] = []
            for t in ranked:
                if len(t.members) == size and without not in t.names and not any(o.keys <= t.keys for o in leaders):
                    leaders.append(t)
            # beside an explanation that leaves nothing, only what may come near it is of interest
            few = bool(without) and ranked[0].complete
            for t in leaders[: 2 * LEADERS if few else LEADERS]:
                short = top - _score(t, 1.0)
                followers = [f for f in self.followers(t) if f[0].effect.name != without]
                for c, gain, values in followers[:FOLLOWERS]:
                    if gain - expected_cost(c) > max(0.0, (NEARLY if few else TRUSTED) * short - REACH):
                        self.add(t, c, values)

    def exchange(self, survivors: Sequence[Trial]) -> bool:
        """Put in place of each effect of an explanation all that explain as much beside the others; whether any did."""
        before, scale = len(self.trials), _scale(self.case, self.trials.values())
        for t in survivors:
            for c in t.members if len(t.members) > 1 else []:
                rest = self.trials.get(t.names - {c.effect.name})
                if rest is None or not rest.members:
                    continue
                gain = _score(t, scale) - _score(rest, scale)
                for other, net, values in self.followers(rest):
                    if net / scale - expected_cost(other) > TRUSTED * gain - REACH:
                        self.add(rest, other, values)
        return len(self.trials) > before

    def add(self, trial: Trial, c: Candidate, start: Values) -> None:
        """Refit an explanation with one more effect, if that has not been done."""
        names = trial.names | {c.effect.name}
        members = [*trial.members, _original(self.case, c)]
        if names in self.trials or not _fits_in(self.case, members):
            return
        variables = [*self.case.base, *(v for m in members for v in m.variables)]
        alone = self.trials.get(frozenset([c.effect.name]))
        if alone is not None and "nonlinear" in members[-1].row.flags:
            # a strength that a linearisation does not find, such as a retardance of another order
            start = start.copy()
            for v in members[-1].variables:
                start.put(v, value_of(self.case.model, alone.fit.values, v))
        try:
            found = calibrate.fit(self.case.model, variables, start, list(self.case.fitted))
        except FAILURES:
            return
        made = _trial(self.case, members, found)
        if math.isfinite(made.after):
            self.trials[names] = made

    def followers(self, trial: Trial) -> list[tuple[Candidate, float, Values]]:
        """(effect, expected fall, start) of effects beside an explanation, best first."""
        if trial.names not in self.known:
            self.known[trial.names] = _followers(self.case, trial)
        return self.known[trial.names]


def _original(case: Case, c: Candidate) -> Candidate:
    """The candidate as the base's evidence knows it; where nothing of it is visible there, as a dispersion without a
    retardance, with the test of what is visible beside the other effects."""
    found = next(o for o in case.table.order if o.effect.name == c.effect.name)
    return found if len(found.cone.live) else replace(found, cone=c.cone)


def _followers(case: Case, trial: Trial) -> list[tuple[Candidate, float, Values]]:
    """(effect, expected fall, start) of effects beside an explanation, best first: where its refit brought what was
    expected of it, by the derivative images of the base, else by those at its fit."""
    values = trial.fit.values
    taken = {key for c in trial.members for v in c.variables for key in v.keys}
    linear = _is_linear(case, trial)
    others = [
        o
        for o in case.table.order
        if o.effect.name not in trial.names
        and not o.broken
        and (len(o.cone.live) or not linear)
        and not taken & {key for v in o.variables for key in v.keys}
    ]
    if not others:
        return []
    scored = _beside(case, trial, others) if linear else _beside_at(case, trial, others)
    found = []
    for c, net, change in scored:
        start = values.copy()
        for v, step in zip(c.variables, START * change):
            start.put(v, float(np.clip(value_of(case.model, values, v) + step, *v.parameter.bounds)))
        found.append((c, net, start))
    return sorted(found, key=lambda t: -t[1])


def _is_linear(case: Case, trial: Trial) -> bool:
    """Whether the fall of an explanation is the one that the base's derivative images expect."""
    own = np.array([i for c in trial.members for i in c.columns]) - len(case.evidence.base)
    live = own[[bool(x) for x in np.diag(case.table.information)[own] > 0]]
    inverse, _ = st.inverse(case.table.information[np.ix_(live, live)], st.VISIBLE)
    score = case.evidence.projected.score[live]
    return abs(trial.fall / max(float(score @ inverse @ score), 1e-9) - 1) < LINEAR


def _beside(case: Case, trial: Trial, others: Sequence[Candidate]) -> list[tuple[Candidate, float, np.ndarray]]:
    """(effect, expected fall, change) by the base's derivative images, an explanation's own projected off too."""
    evidence, found = case.evidence, []
    base = [*evidence.base, *(i for c in trial.members for i in c.columns)]
    rest = [i for c in others for i in c.columns]
    projected = evidence.project(evidence.normal, base, rest)
    seen = projected.survival > st.VISIBLE
    first = 0
    for c in others:
        own = np.arange(first, first + len(c.columns))
        first += len(c.columns)
        shown = np.outer(seen[own], seen[own])
        cone = st.Cone(projected.information[np.ix_(own, own)] * shown, c.sides, case.seed, draws=1000)
        fall, linear = cone.solve(projected.score[own] * seen[own])
        twin = replace(c, cone=cone, linear=linear)
        found.append((twin, fall - cone.expectation, twin.change_of(linear)))
    return found


def _beside_at(case: Case, trial: Trial, others: Sequence[Candidate]) -> list[tuple[Candidate, float, np.ndarray]]:
    """As `_beside`, by derivative images at the fit of the explanation."""
    values = trial.fit.values
    there = [Candidate.at(case.model, values, o.effect, o.variables) for o in others]
    base = [case.evidence.columns[i] for i in case.evidence.base] + [v for c in trial.members for v in c.variables]
    evidence = measure(case.model, values, base, there, case.evidence.frames, case.rows_max, case.seed, silent)
    solve(evidence, there, case.seed)
    return [(c, c.row.net, c.change_of(c.linear)) for c in there if len(c.cone.live) and not c.broken]


def _joined(case: Case, trials: dict[frozenset[str], Trial]) -> list[frozenset[str]]:
    """Pairs of images' effects, whose refits are dear: those that may win by the linear fall of both. Returns those
    that still may when so many as can be waited for were refitted.

    They are ranked beside what a lamp may have done to whole frames, and without it, by falls as they are. Of two
    causes each alone leaves much, for which a lamp that swings makes up, and what no explanation has reached yet counts
    as noise. By the first ranking no pair may be worth a refit then, while the refit of the right one would show that
    the lamp stands still. What refits reach is asked of the pairs that come after them."""
    _bound_wander(case, trials.values())
    live = [c for c in case.table.order if len(c.cone.live) and not c.broken]
    leaders = [c for c in live if c.row.p_family < LEVEL][: pairs.CONSIDERED]
    known = {c.effect.name for c in leaders}
    ranked = pairs.ranked(case.evidence, leaders, [c for c in live if c.effect.name not in known])
    scale = _scale(case, trials.values())
    rankings = [
        _Ranking(
            lambda t: _score(t, scale) + _gain(case, t, scale),
            ranked,
            lambda net, both: net / scale + _expected_gain(case, both, scale) - sum(map(expected_cost, both)),
        ),
        _Ranking(lambda t: _score(t, 1.0), ranked, lambda net, both: net - sum(map(expected_cost, both)), False),
    ]
    tried = set(trials)
    for n in range(pairs.REFITTED):
        wanted = _next(rankings, trials.values(), tried)
        if not wanted:
            break
        case.say("refit of pairs", n, pairs.REFITTED)
        a, b, linear = wanted[0]
        tried.add(names := _names(wanted[0]))
        try:
            found = with_effects(case, [(a, linear[: len(a.columns)]), (b, linear[len(a.columns) :])], START)
        except FAILURES:
            continue
        made = _trial(case, [a, b], found)
        if math.isfinite(made.after):
            trials[names] = made
    case.say("refit of pairs", pairs.REFITTED, pairs.REFITTED)
    return [_names(pair) for pair in _next(rankings, trials.values(), tried)]


Pair = tuple[Candidate, Candidate, np.ndarray]  # two effects, and coefficients of both


class _Ranking:
    """Pairs by what is expected of them, and the trials that they are held against by `score_of`.

    beside   whether what a lamp may have done to whole frames is counted. If not, a pair that contains an effect which
             leaves nothing but that lamp is not asked for
    """

    def __init__(
        self,
        score_of: Callable[[Trial], float],
        ranked: Sequence[tuple[float, Candidate, Candidate, np.ndarray]],
        expected_of: Callable[[float, list[Candidate]], float],
        beside: bool = True,
    ):
        self.score_of, self.beside = score_of, beside
        expected = [(expected_of(net - pairs.shortfall([a, b]), [a, b]), (a, b, x)) for net, a, b, x in ranked]
        self.expected = sorted(expected, key=lambda e: -e[0])

    def wanted(self, trials: Iterable[Trial]) -> list[Pair]:
        """The pairs that are expected to do better than the best trial, best first: than its refit, or than was
        expected of it where that was less. What images promised too little of one pair they may of others.

        A forecast that was wrong about the best pair may be as wrong about its rivals. A turned film with vignetting
        brought 169 more than the 90,255 expected of it; 98 less was expected of a turned plate with vignetting, which
        brought more than the film."""
        top, best = max(((self.score_of(t), t) for t in trials), key=lambda s: s[0])
        promised = next((e for e, pair in self.expected if _names(pair) == best.names), top)
        wrong = min(abs(top - promised), pairs.LEAD * best.fall)
        found = []
        for expected, pair in self.expected:
            nested = best.names <= _names(pair)
            if nested and (not best.members or (best.complete and not self.beside)):
                continue
            needed = max(CLEAR, pairs.LEAD * best.fall) if nested else -CLEAR - wrong
            if expected - min(top, promised) >= needed:
                found.append(pair)
        return found


def _names(pair: Pair) -> frozenset[str]:
    return frozenset(c.effect.name for c in pair[:2])


def _next(rankings: Sequence[_Ranking], trials: Iterable[Trial], tried: set[frozenset[str]]) -> list[Pair]:
    """The pairs that any ranking wants and that were not tried, the best of each ranking in turn."""
    turns = zip_longest(*(r.wanted(trials) for r in rankings))
    found = {_names(pair): pair for turn in turns for pair in turn if pair}
    return [pair for names, pair in found.items() if names not in tried]


def _bound_wander(case: Case, trials: Iterable[Trial]) -> None:
    """Where effects leave nothing, a lamp that swings as nobody would let it is no rival of theirs; nor is it of images
    where no effect may have a strength for each frame, as where captures state that exposures are the same."""
    alike = not case.evidence.is_table and not any(c.effect.scope == "frame" for c in case.table.order)
    most = NOTICED if alike or any(t.members and t.complete for t in trials) else math.inf
    if case.evidence.is_table:
        case.session.most = most
    elif case.lamp is not None:
        case.lamp.most = most


def _lamp_noise(case: Case, trial: Trial, scale: float) -> Correlation:
    """The noise that frames share with their neighbours about an explanation of images; none where it has a gain of
    each frame."""
    if case.lamp is None or trial.by_frame:
        return Correlation(scale)
    return _of_frames(case, case.lamp, trial).noise(scale)


def _gain(case: Case, trial: Trial, scale: float) -> float:
    """By how much that noise lowers the deviance."""
    return _lamp_noise(case, trial, scale).gain


def _expected_gain(case: Case, members: Sequence[Candidate], scale: float) -> float:
    """The same of a set of effects, before it is refitted."""
    if case.lamp is None or any(c.effect.scope == "frame" for c in members):
        return 0.0
    evidence = case.evidence
    columns = evidence.dense([*evidence.base, *(i for c in members for i in c.columns)])
    return case.lamp.about(np.concatenate([b.r for b in evidence.blocks]), columns).noise(scale).gain


# -- the competition -------------------------------------------------------------------------------------------------
def compete(case: Case, trials: list[Trial]) -> Outcome:
    """The explanations that are not told apart from the best."""
    scale, correlation = _scale(case, trials), Correlation()
    order = sorted(trials, key=lambda t: -_score(t, scale))
    for t in order:
        t.deviance = t.after / scale
    _bound_wander(case, order)
    if case.evidence.is_table:
        for t in order:
            if t.readings is not None:
                t.readings.most = case.session.most
        best = next((t for t in order if t.members), order[0])
        scale = max(_readings(case, best).correlation().scale, 1.0)
        correlation = _readings(case, best).noise(scale)
        for i, t in enumerate(order):
            t.deviance = t.after / scale
            # from what its refit reached: where that stopped short, images promise what no refit brings
            if i < CONTENDERS or len(t.members) < 2 or t.readings is not None:
                t.gain = _readings(case, t).noise(scale).gain
                t.deviance = _readings(case, t).standing(scale)
        # whitened by what readings of one setting share, residuals are of another size: of the others by as much as
        # those of the best, which are noise; of a base that misses much, that is another number
        for t in order:
            if t.readings is None:
                t.deviance += (_readings(case, best).reached - best.after) / scale
        order.sort(key=lambda t: t.deviance + t.cost)
    elif case.lamp is not None:
        for t in order:
            noise = _lamp_noise(case, t, scale)
            t.gain, t.price = noise.gain, noise.price
            t.deviance -= t.gain
        order.sort(key=lambda t: t.deviance + t.cost)
    # whether there is anything is a question of its own, which costs do not answer
    leader = next((t for t in order if t.members), order[0])
    outcome = Outcome(leader, leader, [leader], order, scale, correlation)
    outcome.wander = wander_of(case, outcome, outcome.base)
    if (instead := _lamp_or_gains(case, outcome)) is not None:
        outcome.leader = outcome.best = leader = instead
        outcome.survivors = [leader]
    for t in order:
        if t is not leader:
            outcome.leads[t.names] = _lead(case, outcome, leader, t)
    return _with_survivors(case, outcome)


def _lamp_or_gains(case: Case, outcome: Outcome) -> Trial | None:
    """Of images, the explanation by a gain of each frame that leads in place of effects which explain nothing beside a
    lamp that wanders: that lamp is what the gains are, and no rival of theirs."""
    leader = outcome.leader
    if case.evidence.is_table or not leader.members or leader.by_frame or _adds_to_noise(leader, outcome.base):
        return None
    for t in outcome.trials:
        if t.by_frame and t.members:
            lead, needed = _lead(case, outcome, t, leader)
            if lead > needed:
                return t
    return None


def beside_refuted(case: Case, outcome: Outcome, refuted: Sequence[Trial], why: str) -> Outcome:
    """The competition of all other explanations; those that are refuted stay in its record."""
    for t in refuted:
        t.refuted = why
    gone = [*outcome.refuted, *refuted]
    rest = compete(case, [t for t in outcome.trials if t not in gone])
    rest = _weighed_by_blocks(case, rest) if case.evidence.is_table else replace(rest, untried=outcome.untried)
    rest.leads.update({t.names: _lead(case, rest, rest.leader, t) for t in gone})
    rest.refuted = gone
    return rest


def wander_of(case: Case, outcome: Outcome, trial: Trial) -> float:
    """Rms of the noise that neighbours share about an explanation, over that of the signal; 0 for images that are too
    few to tell, or where each frame has a strength."""
    if case.evidence.is_table:
        readings = _readings(case, trial)
    elif case.lamp is not None and not trial.by_frame:
        readings = _of_frames(case, case.lamp, trial)
    else:
        return 0.0
    return math.sqrt(readings.noise(outcome.scale).power * outcome.scale / max(readings.bright, 1e-12))


def beside_noise(case: Case, outcome: Outcome) -> tuple[Correlation, float]:
    """(noise that neighbouring readings share about the base, p of structure and of jumps that it leaves); p is NaN
    where there is no such noise, or it leaves misfit. A lamp that wanders does not jump, as one that is changed does,
    and takes longer than neighbours: noise of the SHORTEST memory may stand for flicker."""
    readings = _readings(case, outcome.base)
    noise = readings.correlation()
    if not noise.power or noise.scale > MISSTATED or noise.length <= SHORTEST:
        return noise, math.nan
    evidence = case.evidence
    left = evidence.structure(evidence.whitened, evidence.base, lambda c: case.session.independent(c, noise))
    new = case.session.independent(np.concatenate([b.r for b in evidence.blocks])[:, None], noise)[:, 0]
    jump = len(new) * math.erfc(float(np.abs(new).max()) / math.sqrt(2))
    return noise, min(left.p, jump)


def fall_beside(outcome: Outcome, trial: Trial, name: str) -> float:
    """What an effect adds to the others of a trial, of chi2 beside the noise that each of both shares."""
    return outcome.scale * (outcome.without(trial, name).deviance - trial.deviance)


def noise_of(case: Case, outcome: Outcome, trial: Trial) -> Correlation | None:
    """What neighbouring readings, or the pixels of a frame, share about an explanation; None of images that are too few
    to tell, or where each frame has a strength. A lamp that swings by more than NOTICED is no noise of images."""
    if case.evidence.is_table:
        return _readings(case, trial).noise(outcome.scale)
    if case.lamp is None or trial.by_frame:
        return None
    return _of_frames(case, case.lamp, trial).noise(outcome.scale, NOTICED)


def _with_survivors(case: Case, outcome: Outcome) -> Outcome:
    outcome = _survived(case, outcome)
    outcome.survivors += _under_other_names(outcome)
    outcome.larger = _larger(case, outcome) if outcome.best.members else []
    return outcome


def _larger(case: Case, outcome: Outcome) -> list[Trial]:
    """See `Outcome`."""
    found: list[Trial] = []
    for t in sorted(outcome.trials, key=lambda t: len(t.members)):
        inner = [o for o in (*outcome.survivors, *found) if o.members and o.keys < t.keys]
        if not inner or t in outcome.survivors or any(outcome.score(o) >= outcome.score(t) for o in inner):
            continue
        if outcome.shared and not _adds_to_noise(t, outcome.base):
            continue
        if t is outcome.leader or not _told(case, outcome, outcome.leader, t):
            found.append(t)
    return found


def _under_other_names(outcome: Outcome) -> list[Trial]:
    """Explanations that predict the same values as a survivor, and were ruled out by what is plausible alone, where
    that costs less than NO_TIE: what a strength is counted in, such as the full scale of a meter that reads a
    thousandth of it, must not choose between names of one law."""
    alive = [t for t in outcome.survivors if t.members]
    found = []
    for t in outcome.trials:
        if not t.members or t in outcome.survivors or t in outcome.refuted or any(o.keys < t.keys for o in alive):
            continue
        if outcome.shared and not _adds_to_noise(t, outcome.base):
            continue
        same = [o for o in alive if len(o.members) == len(t.members) and abs(o.fall - t.fall) < ALIKE]
        if any(t.cost < o.cost + NO_TIE and _distance(o, t) < ALIKE for o in same):
            found.append(t)
            outcome.leads[t.names] = outcome.leads[t.names][0], NO_TIE
    return found


def _survived(case: Case, outcome: Outcome) -> Outcome:
    best = outcome.leader
    base = outcome.base
    lead, needed = _lead(case, outcome, best, base) if best.members else (0.0, 0.0)
    fall = (base.after - best.after) / outcome.scale
    # what readings or frames share is a rival where it, and not chance, is what stands against an effect
    able = (case.evidence.is_table or case.lamp is not None) and needed < fall
    outcome.shared = able and lead <= needed
    if able and lead < -TOLD:  # noise explains it better than any effect does, at the odds of any other rival
        outcome.best, outcome.survivors = base, [base]
        return outcome
    while True:
        # what the leader rules out stays so beside a simpler one
        judges = [best] if best is outcome.leader else [best, outcome.leader]
        told = {id(t) for t in outcome.trials for j in judges if t is not j and _told(case, outcome, j, t)}
        alive = [best] + [t for t in outcome.trials if t is not best and id(t) not in told]
        alive += [t for t in _inherited(case, outcome, alive) if t not in alive]
        alive = [t for t in alive if t is best or not _says_nothing(t, base)]
        outcome.shared |= able and base in alive
        # noise is a rival that is no explanation by effects; what is clearly not worth its cost beside it, or explains
        # no more than chance does, is that noise under another name
        if outcome.shared:
            alive = [t for t in alive if t is best or (t.members and _adds_to_noise(t, base))]
        # an explanation within another that is not told apart says the same with less
        kept = [t for t in alive if not any(o is not t and o.keys < t.keys for o in alive)]
        kept.sort(key=lambda t: t.deviance + t.cost)
        if best in kept:
            break
        best = next(t for t in kept if t.keys < best.keys) if any(t.keys < best.keys for t in kept) else kept[0]
    outcome.best, outcome.survivors = best, [best, *(t for t in kept if t is not best)]
    # what the simplest is not clearly ahead of survives, though a larger explanation rules it out: that is not needed
    for name in outcome.core:
        rival, lead, needed = _without(case, outcome, next(c for c in best.members if c.effect.name == name))
        if lead <= needed and rival.members and rival not in outcome.survivors:
            if rival.keys < best.keys:  # nobody needs it: what it was beside is asked for alone
                outcome.survivors = _all_without(case, outcome, name)
                outcome.best = outcome.survivors[0]
            else:
                outcome.survivors.append(rival)
                outcome.leads[rival.names] = lead, needed
            break
        outcome.shared |= able and lead <= needed and not rival.members
    return outcome


def _says_nothing(trial: Trial, base: Trial) -> bool:
    """Whether a refit ended where the base is. The effect's derivative images may have promised much, but no step away
    from neutral brought anything."""
    return bool(trial.members) and trial.fall < ALIKE and _distance(trial, base) < ALIKE


def _adds_to_noise(trial: Trial, base: Trial) -> bool:
    """Whether effects explain more than chance does of what noise that neighbours share leaves by itself, and are worth
    their cost."""
    gain = base.deviance - trial.deviance
    chance = float(chdtri(max(sum(len(c.cone.live) for c in trial.members), 1), LEVEL))
    return gain > max(trial.cost - CLEAR, chance)


def _all_without(case: Case, outcome: Outcome, name: str) -> list[Trial]:
    """The survivors, each without an effect that it is not surely better with; the best first."""
    found: list[Trial] = []
    for t in outcome.survivors:
        inner = next((o for o in outcome.trials if o.members and o.names == t.names - {name}), None)
        if inner is not None:
            lead, needed = _lead(case, outcome, t, inner)
            t = inner if lead <= max(needed, SURE) else t
        found += [t] if t not in found else []
    found = [t for t in found if not any(o is not t and o.keys < t.keys for o in found)]
    return sorted(found, key=lambda t: t.deviance + t.cost)


def _told(case: Case, outcome: Outcome, best: Trial, other: Trial) -> bool:
    """Whether an explanation is ruled out beside the best; one that says the same with more is not asked."""
    if best.keys < other.keys:
        return True
    lead, needed = outcome.leads[other.names] if best is outcome.leader else _lead(case, outcome, best, other)
    # whether anything predicts better than nothing is a condition of a claim, not of what is told apart
    ahead = best.ahead - other.ahead if other.members and best.ahead > other.ahead else 0.0
    return lead - ahead > needed


def _inherited(case: Case, outcome: Outcome, alive: Sequence[Trial]) -> list[Trial]:
    """Explanations that are not told apart from a simpler one within one that survives: freedom that the simpler one
    lacks, such as a colour, is no evidence against a third that lacks it too."""
    found = []
    for t in alive:
        for inner in outcome.trials:
            if inner.members and inner.keys < t.keys and len(inner.members) == len(t.members):
                for other in outcome.trials:
                    if len(other.members) > len(t.members) or inner.keys <= other.keys or other in (t, inner):
                        continue
                    lead, needed = _lead(case, outcome, inner, other)
                    if not lead > needed and other.deviance + other.cost < inner.deviance + inner.cost + CLEAR:
                        found.append(other)
    return found


def _lead(case: Case, outcome: Outcome, best: Trial, other: Trial) -> tuple[float, float]:
    """(lead in score, lead needed) of one explanation over another; over one within it, the fall that the rest brings,
    and the fall that would be significant among so many effects."""
    cost, is_table = other.cost - best.cost, case.evidence.is_table
    data = other.deviance - best.deviance
    shared = other.gain - best.gain
    if best.by_frame and not is_table and not (other.bare and _adds_to_noise(other, outcome.base)):
        # a lamp that swings as nobody would let it is no rival of a gain of each frame, but the same; nor is one that
        # swings a little beside effects that explain nothing
        data, shared = data + shared, 0.0
    lamp = shared
    if not is_table:
        # a lamp is judged by whole frames, and pixels that miss alike have no part in that
        price = other.price - best.price if lamp else 0.0
        data = _less_alike(case, outcome, outcome.scale * (data - price), best, other) + price
    lead, needed = data + cost, TOLD if data > TOLD else CLEAR  # what is plausible decides alone only where it is clear
    if other.keys < best.keys:
        significant = data - _significant(case, best, other)
        # noise that the simpler one shares, and the other does not need, is no part of that: a rival with a cost
        if significant < lead - needed or shared < TOLD:
            lead, needed, cost = data, data - significant, 0.0
    # where misfit is left, a lamp's wander makes up for much of it: it rules out nothing that leaves less without it
    if not is_table and outcome.scale > MISSTATED and other.fall > best.fall and other.cost < best.cost + TOLD:
        return lead, max(needed, lead)
    if best.complete or (is_table and outcome.scale < MISSTATED):
        return lead, needed
    # of images, less what a lamp did to whole frames: that lies in no direction of an effect
    scale = 0.0 if is_table else outcome.scale
    fall = best.fall - other.fall - scale * lamp
    dof = max(case.evidence.normal.count - case.evidence.projected.rank, 1)
    misfit = min(HALF * max(best.left(dof) - scale * best.gain, 0.0), MARGIN * best.fall)
    if misfit and fall + cost * outcome.scale < misfit:
        return lead, max(needed, lead + misfit - fall)
    return lead, needed


def _significant(case: Case, best: Trial, inner: Trial) -> float:
    """The fall of chi2 by the effects beside those of an inner explanation at which LEVEL is reached, family-wise."""
    single = case.table.family.critical(LEVEL)
    more = [c for c in best.members if c.effect.name not in inner.names]
    if len(more) == 1:
        return more[0].cone.critical(single)
    # of one that contains another, the strengths that it has besides
    free = sum(len(c.cone.live) for c in best.members) - sum(len(c.cone.live) for c in inner.members)
    return float(chdtri(max(free, 1), single))


def design_effect(case: Case, outcome: Outcome, one: Trial, other: Trial) -> float:
    """By how much the variance of the difference of two chi2 of images exceeds what independent noise makes."""
    direction = _kept(case, [a - b for a, b in zip(one.images, other.images)])
    left = _kept(case, outcome.leader.images)
    if case.lamp is not None and not outcome.leader.by_frame:
        # what a lamp did to whole frames has been counted: it is no scatter between them
        noise = _of_frames(case, case.lamp, outcome.leader).noise(outcome.scale)
        direction, left = case.lamp.independent(direction, noise), case.lamp.independent(left, noise)
    total = sum(float(d @ d) for d in direction)
    if not total > 0 or case.places is None:
        return 1.0
    found = homogeneity.variances([d[:, None] for d in direction], left, case.places)
    return max([1.0, *(float(b[0, 0]) / total for b, parts in found if parts > 2)])


def lead_without(case: Case, outcome: Outcome, subject: Candidate) -> tuple[float, float, str]:
    """(lead, lead needed, rival in words) of the best explanation over the best one without an effect, and without one
    that contains it."""
    rival, lead, needed = _without(case, outcome, subject)
    return lead, needed, " with ".join(c.effect.name for c in rival.members)


def _without(case: Case, outcome: Outcome, subject: Candidate) -> tuple[Trial, float, float]:
    """(the best explanation without an effect, and without any that contains it; lead over it; lead that a claim
    needs)."""
    own = {(key, v.frames) for v in subject.variables for key in v.keys}
    best = outcome.best
    rivals = sorted((t for t in outcome.trials if not own <= t.keys), key=lambda t: t.deviance + t.cost)
    near = [t for t in rivals[1:] if t.members and t.deviance + t.cost < best.deviance + best.cost + NO_TIE]
    found = []
    for rival in [*rivals[:1], *near]:
        lead, needed = _lead(case, outcome, best, rival)
        if not (rival.keys < best.keys and rival.gain - best.gain < TOLD):  # by significance, in white noise
            by_data = lead - (rival.cost - best.cost) > TOLD or not rival.members
            needed = max(needed, SURE if by_data else NO_TIE)
        found.append((rival, lead, needed))
    return min(found, key=lambda t: t[1] - t[2])


def fall_over_noise(case: Case, outcome: Outcome, name: str) -> float:
    """What an effect adds to the best explanation, less what noise shared by neighbours would take up without it."""
    without = outcome.without(outcome.best, name)
    if case.evidence.is_table:
        return without.deviance - outcome.best.deviance
    return _less_alike(case, outcome, outcome.own_fall(outcome.best, name), outcome.best, without)


def _less_alike(case: Case, outcome: Outcome, fall: float, best: Trial, other: Trial) -> float:
    """What is left of a fall of chi2 of images, with priors, when neighbours that miss alike do not count apart.

    What is known beforehand, as where a dial stood, is no image: it does not scatter between parts of one, and counts
    once, however often it counted in the fit."""
    (weighed, known), (weighed_best, known_best) = (_from_priors(case, outcome, t) for t in (other, best))
    return (fall - (weighed - weighed_best)) / design_effect(case, outcome, best, other) + known - known_best


def _from_priors(case: Case, outcome: Outcome, trial: Trial) -> tuple[float, float]:
    """(chi2 of the priors as they are weighed, chi2 with each counted once) of an explanation beside what a lamp made
    of the images: a dial that went far off for the lamp's sake is not held against it as well."""
    values, lamp = trial.fit.values, case.lamp
    if lamp is not None and not trial.by_frame and trial.gain > 0:
        key = (outcome.scale, lamp.most)
        if key not in trial.settled:
            noise, values = _of_frames(case, lamp, trial).noise(outcome.scale), values.copy()
            steps = lamp.settled(*_read(case, trial), noise)
            for v, step in zip((case.evidence.columns[i] for i in case.evidence.base), steps):
                if v.prior is not None:
                    values.put(v, value_of(case.model, values, v) + float(step))
            trial.settled[key] = case.prior_chi2(values), case.known_chi2(values)
        return trial.settled[key]
    return case.prior_chi2(values), case.known_chi2(values)


def _kept(case: Case, images: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Of whitened images (H, W, C), the values that the evidence keeps, per block."""
    return [np.asarray(i, float).reshape(-1)[b.index] for i, b in zip(images, case.evidence.blocks)]


def _readings(case: Case, trial: Trial) -> Readings:
    """The readings about an explanation; whitened once, as it competes more than once."""
    if trial.readings is None:
        residual = np.concatenate(_kept(case, trial.images))
        base = [case.evidence.columns[i] for i in case.evidence.base]
        known = priors(case.model, trial.fit.values, base)
        trial.readings = case.session.about(residual, _measured(case, trial), known)
    return trial.readings


def _of_frames(case: Case, lamp: Frames, trial: Trial) -> Readings:
    """The frames about an explanation of images, with the derivative images of the base; once, as it competes more
    than once."""
    if trial.readings is not None:
        trial.readings.most = lamp.most
        return trial.readings
    trial.readings = lamp.about(*_read(case, trial))
    return trial.readings


def _read(case: Case, trial: Trial) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """(whitened residual, images of the base and of an explanation's strengths, what is known of the base)."""
    evidence = case.evidence
    columns = evidence.dense([*evidence.base, *(i for c in trial.members for i in c.columns)])
    known = priors(case.model, trial.fit.values, [evidence.columns[i] for i in evidence.base])
    return np.concatenate(_kept(case, trial.images)), columns, known


def _measured(case: Case, trial: Trial) -> np.ndarray:
    """(n, k) whitened derivative images of the base and of an explanation's strengths, at its fit; 0 of those that
    stand at a bound there."""
    base = [case.evidence.columns[i] for i in case.evidence.base] + [v for c in trial.members for v in c.variables]
    columns = _derivatives(case, trial, base)
    columns[:, [at_bound(v, value_of(case.model, trial.fit.values, v)) for v in base]] = 0.0
    return columns


def _derivatives(case: Case, trial: Trial, base: Sequence[Variable]) -> np.ndarray:
    """(n, k) whitened derivative images at an explanation's fit; those that the fit made last, where it has them."""
    normal = trial.fit.normal
    if normal is not None and trial.fit.frames == case.evidence.frames:
        names = {v.name: i for i, v in enumerate(trial.fit.variables)}
        place = {names[v.name]: i for i, v in enumerate(base)}
        parts = [np.zeros((j.shape[1], len(base))) for _, j, _ in normal.rows]
        for part, (where, j, _) in zip(parts, normal.rows):
            there = [(place[int(w)], k) for k, w in enumerate(where) if int(w) in place]
            part[:, [i for i, _ in there]] = j[[k for _, k in there]].T
        if [len(p) for p in parts] == [len(b.r) for b in case.evidence.blocks]:
            return np.concatenate(parts)
    own = measure(case.model, trial.fit.values, base, [], case.evidence.frames, case.rows_max, case.seed, silent)
    return own.dense(own.base)


# -- blocks left out -------------------------------------------------------------------------------------------------
def _weighed_by_blocks(case: Case, outcome: Outcome) -> Outcome:
    """The outcome when explanations near the best must also predict blocks of the session that were left out."""
    near = [t for t in outcome.trials if t is outcome.leader or t in outcome.survivors or not t.members]
    near += [t for t in outcome.trials[: 2 * LEADERS] if t not in near]
    for t in near:
        t.ahead = left_out(case, t)
    base = next(t.ahead for t in near if not t.members)
    for t in near:
        t.ahead -= base
    return _with_survivors(case, outcome)


def left_out(case: Case, trial: Trial) -> float:
    """chi2 of the readings, each block of the session predicted by a fit of all others.

    With images X and residuals r of block b at the optimum, (G - G_b + P) step = -X_b'r_b moves the optimum to that of
    the others; P holds priors, and strengths of each frame that only the block determines (LOOSE). Other directions
    that only the block determines (ALONE), as a backlash where it is the only run downwards, stay: the others cannot
    tell what they would predict."""
    columns, r = _measured(case, trial), np.concatenate(_kept(case, trial.images))
    order = case.evidence.order(case.model)
    prior = np.zeros(columns.shape[1])
    prior[: len(case.evidence.precision)] = case.evidence.precision
    known = len(case.evidence.base)
    prior[known:] = [1 / (LOOSE * t) ** 2 for c in trial.members for t in c.plausible]
    turn, total = st.root(columns.T @ columns + np.diag(prior)).T, 0.0
    least = max(0.0 if trial.by_frame else ALONE, st.VISIBLE)
    for block in blocks(case, order):
        own = columns[block] @ turn  # in axes in which all readings together know each direction by 1
        shares, axes = np.linalg.eigh(np.eye(turn.shape[1]) - own.T @ own)  # of that, what the others know
        axes = axes[:, shares > least]
        step = axes @ ((own @ axes).T @ r[block] / shares[shares > least])
        total += float(np.sum((r[block] + own @ step) ** 2))
    return total


def blocks(case: Case, order: np.ndarray) -> list[np.ndarray]:
    """Places of the readings of each block: groups where captures name three or more, else pieces of the session."""
    numbers = np.concatenate([np.full(len(b.r), i) for i, b in enumerate(case.evidence.blocks)])
    groups = [case.model.frames[f].group for f in case.evidence.frames]
    names = list(dict.fromkeys(groups))
    if None not in names and len(names) > 2:
        return [np.flatnonzero(np.isin(numbers, [i for i, g in enumerate(groups) if g == name])) for name in names]
    return [piece for piece in np.array_split(np.argsort(order, kind="stable"), BLOCKS) if len(piece)]
