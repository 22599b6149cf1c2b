"""Errors of dials that nobody states as a rival of an effect with a strength for each frame.

Images are taken one by one, and a film that is turned between them stops a little off its setting each time. Where
captures do not say how far, an error of each frame explains what a gain of each frame does; but not as well: a turned
film must be turned far to halve what passes, and whoever turns it reads its scale. So the errors are fitted in place of
the effect, of a width that is sought, and held against it as any explanation is (`optics.diagnosis.explanations`); the
width is as likely as `optics.diagnosis.dials` says. So are other effects with these errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optics.diagnosis.competition import design_effect
from optics.diagnosis.dials import WIDTHS, unlikely, unstated
from optics.diagnosis.evidence import Candidate
from optics.diagnosis.explanations import Outcome, Trial, cost_of, implausible
from optics.diagnosis.refit import FAILURES, Case, chi2, further
from optics.diagnosis.thresholds import SURE
from optics.fit.model import value_of
from optics.fit.result import Fit
from optics.fit.scene_model import SceneModel
from optics.scene.declare import Effect
from optics.scene.parameter import Values, Variable

ERRORS = Effect("errors of dials", part="layer", parameters=(), scope="frame")
ASKED = 3  # explanations of one effect, the best of those without a strength per frame, that are tried with the errors
STEPS = 2  # calibrations, each of FEW linearisations, that the errors may take: they may be far from where dials stand


def lead_over(case: Case, outcome: Outcome, subject: Candidate, keys: Sequence[str]) -> float:
    """By how much the best explanation is ahead, in score, of itself with errors of dials in place of one of its
    effects; minus infinity where these cannot be fitted."""
    values = outcome.best.fit.values.copy()
    for v, at in zip(subject.variables, subject.start):
        values.put(v, float(at))
    return _lead_over_errors(case, outcome, [c for c in outcome.best.members if c is not subject], values, keys)


def with_rivals(case: Case, outcome: Outcome) -> Outcome:
    """The outcome in which explanations without a strength per frame survive, if errors of dials that nobody states
    bring them as near to the best one, which is such strengths, as a claim forbids. By themselves they are ruled out:
    what the dials did to each frame, the strengths explain as well."""
    best, model = outcome.best, case.model
    if case.evidence.is_table or len(best.members) != 1 or not best.by_frame or not isinstance(model, SceneModel):
        return outcome
    keys = unstated(model)
    alone = [t for t in outcome.trials if len(t.members) == 1 and not t.by_frame and t not in outcome.survivors]
    for t in alone[:ASKED] if keys else []:
        if -math.inf < _lead_over_errors(case, outcome, t.members, t.fit.values.copy(), keys) <= SURE:
            t.dials = " and ".join(keys)
            outcome.survivors.append(t)
    return outcome


def _lead_over_errors(
    case: Case, outcome: Outcome, others: Sequence[Candidate], values: Values, keys: Sequence[str]
) -> float:
    """By how much the best explanation is ahead of some effects with errors of dials, fitted from these values."""
    model, best = case.model, outcome.best
    assert isinstance(model, SceneModel)
    doubted = [v for key in keys for v in _of_each(model, key, case.fitted)]
    known = [v for v in case.base if not (v.frames is not None and set(v.keys) & set(keys))]
    wanted = [*known, *(v for c in others for v in c.variables), *doubted]
    try:
        for _ in range(STEPS):
            found = further(model, wanted, values, list(case.fitted), negligible=case.negligible)
            values = found.values
    except FAILURES:
        return -math.inf
    # of what the base knows of these dials, nothing is held against them: the width is sought
    own = replace(case, fit=replace(case.fit, variables=known))
    left, expected, images = chi2(own, found.values)
    errors = Candidate.at(model, Values(), ERRORS, doubted)
    rival = Trial([*others, errors], found, 0.0, left + own.prior_chi2(found.values), expected, images)
    rival.cost = cost_of(own, rival.members, found) + _cost_of_width(own, errors, found)
    data = (left - chi2(case, best.fit.values)[0]) / outcome.scale / design_effect(case, outcome, best, rival)
    priors = own.known_chi2(found.values) - case.known_chi2(best.fit.values)
    return data + priors + rival.cost - best.cost


def _cost_of_width(case: Case, errors: Candidate, found: Fit) -> float:
    """What the errors cost by their size more than as a strength of each frame."""
    change = np.array([value_of(case.model, found.values, v) for v in errors.variables]) - errors.start
    return float(unlikely(math.sqrt(float(np.mean(change**2))))) - implausible(errors, change)


def _of_each(model: SceneModel, key: str, frames: Sequence[int]) -> list[Variable]:
    """The setting of a dial in each frame that turns it."""
    own = [(i, model.frames[i]) for i in frames if key in model.frames[i].parameters]
    prior = [(float(f.parameters[key]), float(WIDTHS[-1])) for _, f in own]
    return [Variable(f"{key}[{f.name}]", (key,), model.parameters[key], (i,), p) for (i, f), p in zip(own, prior)]
