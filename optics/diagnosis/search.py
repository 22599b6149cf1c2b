"""The search for explanations: which sets of effects are refitted.

Of a table refits take milliseconds: the best explanations are extended by what explains most of what they leave, and
their effects exchanged for others. Of images refits are dear: pairs are ranked by the linear fall of both."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import zip_longest

import numpy as np

from optics.diagnosis import pairs
from optics.diagnosis import statistics as st
from optics.diagnosis.competition import compete, weighed_by_blocks
from optics.diagnosis.evidence import Candidate, measure, silent
from optics.diagnosis.explanations import Outcome, Trial, expected_cost, nothing, scale_of, trial_of, worth
from optics.diagnosis.refit import FAILURES, START, Case, clear, from_there, weighed, with_effects, write
from optics.diagnosis.score import solve
from optics.diagnosis.shared_noise import bound_wander, expected_gain, gain_of
from optics.diagnosis.thresholds import CLEAR, LEVEL
from optics.fit import calibrate
from optics.fit.model import value_of
from optics.fit.result import Fit
from optics.scene.parameter import Values

LARGEST = 3  # effects of one explanation
LEADERS, FOLLOWERS = 3, 4  # explanations that are extended in each round, and effects that each is extended by
REACH = 3 * CLEAR  # of the best score: an explanation that is expected to stay farther behind is not refitted
LINEAR = 0.1  # relative difference of a refit's fall from the one expected, below which nothing is linearised again
NEARLY = 0.9  # the same beside an explanation that leaves nothing
TRUSTED = 0.7  # of what a linearisation expects: an explanation that is expected to fall short by more is not refitted
LEAST = 2  # values per number that is fitted, below which no set of effects is refitted


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
    return weighed_by_blocks(case, outcome)


def _singly(case: Case, chosen: Sequence[Candidate], fits: dict[str, Fit]) -> dict[frozenset[str], Trial]:
    """No effect, and each that was refitted."""
    trials: dict[frozenset[str], Trial] = {frozenset(): nothing(case)}
    for c in chosen:
        if c.effect.name in fits:
            trials[frozenset([c.effect.name])] = trial_of(case, [c], fits[c.effect.name])
    return trials


def _expected(case: Case, trials: dict[frozenset[str], Trial]) -> None:
    """Refit the sets that an earlier diagnosis found, from where it left them."""
    for e in case.expected:
        members = [c for c in case.table.order if c.effect.name in e.names]
        if e.names in trials or len(members) < 2 or not _fits_in(case, members):
            continue
        found = from_there(case, members, e.values)
        if found is not None:
            trials[e.names] = trial_of(case, members, found)


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
    scale, any_improved = scale_of(case, trials.values()), False
    for t in sorted(trials.values(), key=lambda t: -worth(t, scale))[:LEADERS]:
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
    made = None if found is None else trial_of(case, members, found)
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


def _leader(case: Case, trials: dict[frozenset[str], Trial]) -> Trial:
    scale = scale_of(case, trials.values())
    return max(trials.values(), key=lambda t: worth(t, scale))


def _fits_in(case: Case, members: Sequence[Candidate]) -> bool:
    """Whether a set may be refitted: no strength twice, none that contains another, values enough for all of them."""
    keys = [key for c in members for v in c.variables for key in v.keys]
    numbers = case.evidence.projected.rank + sum(len(c.cone.live) for c in members)
    return len(set(keys)) == len(keys) and case.evidence.normal.count > LEAST * numbers


# -- explanations of a table ------------------------------------------------------------------------------------------
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
            ranked = sorted(self.trials.values(), key=lambda t: -worth(t, 1.0))
            top = worth(ranked[0], 1.0)
            leaders: list[Trial] = []
            for t in ranked:
                if len(t.members) == size and without not in t.names and not any(o.keys <= t.keys for o in leaders):
                    leaders.append(t)
            # beside an explanation that leaves nothing, only what may come near it is of interest
            few = bool(without) and ranked[0].complete
            for t in leaders[: 2 * LEADERS if few else LEADERS]:
                short = top - worth(t, 1.0)
                followers = [f for f in self.followers(t) if f[0].effect.name != without]
                for c, gain, values in followers[:FOLLOWERS]:
                    if gain - expected_cost(c) > max(0.0, (NEARLY if few else TRUSTED) * short - REACH):
                        self.add(t, c, values)

    def exchange(self, survivors: Sequence[Trial]) -> bool:
        """Put in place of each effect of an explanation all that explain as much beside the others; whether any did."""
        before, scale = len(self.trials), scale_of(self.case, self.trials.values())
        for t in survivors:
            for c in t.members if len(t.members) > 1 else []:
                rest = self.trials.get(t.names - {c.effect.name})
                if rest is None or not rest.members:
                    continue
                gain = worth(t, scale) - worth(rest, scale)
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
        made = trial_of(self.case, members, found)
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


# -- pairs of effects of images ---------------------------------------------------------------------------------------
def _joined(case: Case, trials: dict[frozenset[str], Trial]) -> list[frozenset[str]]:
    """Pairs of images' effects, whose refits are dear: those that may win by the linear fall of both. Returns those
    that still may when so many as can be waited for were refitted.

    They are ranked beside what a lamp may have done to whole frames, and without it, by falls as they are. Of two
    causes each alone leaves much, for which a lamp that swings makes up, and what no explanation has reached yet counts
    as noise. By the first ranking no pair may be worth a refit then, while the refit of the right one would show that
    the lamp stands still. What refits reach is asked of the pairs that come after them."""
    bound_wander(case, trials.values())
    live = [c for c in case.table.order if len(c.cone.live) and not c.broken]
    leaders = [c for c in live if c.row.p_family < LEVEL][: pairs.CONSIDERED]
    known = {c.effect.name for c in leaders}
    ranked = pairs.ranked(case.evidence, leaders, [c for c in live if c.effect.name not in known])
    scale = scale_of(case, trials.values())
    rankings = [
        _Ranking(
            lambda t: worth(t, scale) + gain_of(case, t, scale),
            ranked,
            lambda net, both: net / scale + expected_gain(case, both, scale) - sum(map(expected_cost, both)),
        ),
        _Ranking(lambda t: worth(t, 1.0), ranked, lambda net, both: net - sum(map(expected_cost, both)), False),
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
        made = trial_of(case, [a, b], found)
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
