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

How they are found: `optics.diagnosis.search`; which of them survive: `optics.diagnosis.competition`.

Source: MacKay, Bayesian interpolation, Neural Computation 4, 415 (1992), Occam factor."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from optics.diagnosis.correlation import NOTICED, Correlation, Readings
from optics.diagnosis.evidence import Candidate
from optics.diagnosis.refit import Case, excess_of, known_of, weighed
from optics.diagnosis.result import Explanation, leaves_nothing
from optics.diagnosis.thresholds import EACH, EXCESS, LEVEL, MISSTATED
from optics.fit.model import value_of
from optics.fit.result import Fit

ALIKE = 1.0  # chi2 between the predictions of two explanations, of all values, below which they are the same
WIDTHS = np.geomspace(0.003, 3.0, 13)  # plausible sizes: of the prior of strengths of each frame


@dataclass(eq=False)
class Trial:
    """An explanation that was refitted.

    members    effects, none for the base;   fit, fall, after, expected, images   as of `optics.diagnosis.refit.Attempt`
    cost       see the module
    deviance   see the module; NaN before the competition;   gain: what shared noise lowers it by
    price      of images, what a lamp that wanders costs of it (`optics.diagnosis.correlation.Correlation`)
    readings   of a table, or frames of images, about it; None before
    settled    chi2 of its priors beside a lamp, by the lamp (`optics.diagnosis.competition`)
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

    def records(self) -> list[Explanation]:
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
                if distance(t, o) < ALIKE:
                    found[t.names] = " with ".join(c.effect.name for c in o.members)
                    break
            else:
                first.append(t)
        return found


def distance(one: Trial, other: Trial) -> float:
    """chi2 between the predictions of two explanations, of all values."""
    return sum(float(np.sum((a - b).astype(float) ** 2)) for a, b in zip(one.images, other.images))


def apart(case: Case, true: Trial, other: Trial) -> float:
    """chi2, with what is known, by which another explanation as it was found misses data of the true one."""
    return distance(true, other) + case.known_chi2(other.fit.values) - case.known_chi2(true.fit.values)


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


# -- refits as explanations -------------------------------------------------------------------------------------------
def nothing(case: Case) -> Trial:
    """The base, as the explanation without effects."""
    evidence = case.evidence
    after = evidence.normal.square
    excess = excess_of(evidence, after, float(evidence.normal.count), [])
    return Trial([], case.fit, 0.0, case.before, after, evidence.whitened, 0.0, excess)


def trial_of(case: Case, members: list[Candidate], found: Fit) -> Trial:
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


def worth(trial: Trial, scale: float) -> float:
    return trial.fall / scale - trial.cost


def scale_of(case: Case, trials: Iterable[Trial]) -> float:
    """chi2 per degree of freedom of the most complete explanation, at least 1."""
    best = max(trials, key=lambda t: t.fall)
    dof = max(case.evidence.normal.count - case.evidence.projected.rank - len(best.keys), 1)
    return max(1.0 + best.excess_sd * math.sqrt(2 * dof) / dof, 1.0)
