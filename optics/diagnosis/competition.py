"""The competition of explanations: which of them survive, and which effects all of these have.

An effect that is part of every survivor is missing, whichever of them is right. All explanations survive but those that
are told apart from the best:

    nested       whether the larger one is needed is a question of significance: family-wise; of images, with the
                 design effect of what tells the two apart (`optics.diagnosis.homogeneity.variances`). The price of a
                 lamp that wanders is not divided by it: frames tell that lamp, not pixels
    not nested   one is told apart when its score is TOLD lower, or CLEAR where plausibility alone decides
    a claim      needs every explanation without the effect to be SURE lower (NO_TIE where plausibility alone decides),
                 and more of the fall than the distance of its strengths from neutral costs: chance brings a
                 significant fall by strengths that nobody expects

Three things count against a lead:

    readings     blocks of the session that were left out, where the other one predicts them better
    misfit       of images, or of readings whose noise is MISSTATED, what is left may lie along any direction: the
                 difference of falls must exceed the smaller of HALF of what the best one leaves and MARGIN of its fall
    a lamp       of images with misfit left, noise that frames share rules out nothing that leaves less by itself at no
                 more cost

Source: Vuong, Econometrica 57, 307 (1989), the variance of a difference of log likelihoods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from optics.diagnosis import homogeneity
from optics.diagnosis import statistics as st
from optics.diagnosis.correlation import Correlation
from optics.diagnosis.evidence import Candidate
from optics.diagnosis.explanations import ALIKE, Outcome, Trial, distance, scale_of, worth
from optics.diagnosis.refit import Case, swings
from optics.diagnosis.shared_noise import (
    bound_wander,
    derivatives_of,
    frame_images,
    frames_about,
    kept_values,
    lamp_noise,
    readings_about,
    wander_of,
)
from optics.diagnosis.thresholds import CLEAR, HALF, LEVEL, MARGIN, MISSTATED, NO_TIE, SURE, SWINGING, TOLD
from optics.fit.model import value_of

NEAR = 6  # explanations, the best in score, that must predict blocks that were left out
BLOCKS = 8  # pieces of a session, each left out once
CONTENDERS = 40  # explanations of a table whose shared noise is sought; others are behind without it
ALONE = 0.01  # of what all readings know of a direction: what the others know where a block alone determines it
LOOSE = 10.0  # plausible sizes: what keeps a strength that a left-out block alone determines near neutral


def compete(case: Case, trials: list[Trial]) -> Outcome:
    """The explanations that are not told apart from the best."""
    if not case.evidence.is_table:
        trials = [t for t in trials if not any(swings(t.fit, c) > SWINGING for c in t.members)]
    scale, correlation = scale_of(case, trials), Correlation()
    order = sorted(trials, key=lambda t: -worth(t, scale))
    for t in order:
        t.deviance = t.after / scale
    bound_wander(case, order)
    if case.evidence.is_table:
        for t in order:
            if t.readings is not None:
                t.readings.most = case.session.most
        best = next((t for t in order if t.members), order[0])
        scale = max(readings_about(case, best).correlation().scale, 1.0)
        correlation = readings_about(case, best).noise(scale)
        for i, t in enumerate(order):
            t.deviance = t.after / scale
            # from what its refit reached: where that stopped short, images promise what no refit brings
            if i < CONTENDERS or len(t.members) < 2 or t.readings is not None:
                t.gain = readings_about(case, t).noise(scale).gain
                t.deviance = readings_about(case, t).standing(scale)
        # whitened by what readings of one setting share, residuals are of another size: of the others by as much as
        # those of the best, which are noise; of a base that misses much, that is another number
        for t in order:
            if t.readings is None:
                t.deviance += (readings_about(case, best).reached - best.after) / scale
        order.sort(key=lambda t: t.deviance + t.cost)
    elif case.lamp is not None:
        for t in order:
            noise = lamp_noise(case, t, scale)
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
    rest = weighed_by_blocks(case, rest) if case.evidence.is_table else replace(rest, untried=outcome.untried)
    rest.leads.update({t.names: _lead(case, rest, rest.leader, t) for t in gone})
    rest.refuted = gone
    return rest


# -- who survives -----------------------------------------------------------------------------------------------------
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
        if t is outcome.leader or not _ruled_out(case, outcome, outcome.leader, t):
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
        if any(t.cost < o.cost + NO_TIE and distance(o, t) < ALIKE for o in same):
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
        ruled_out = {id(t) for t in outcome.trials for j in judges if t is not j and _ruled_out(case, outcome, j, t)}
        alive = [best] + [t for t in outcome.trials if t is not best and id(t) not in ruled_out]
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
    return bool(trial.members) and trial.fall < ALIKE and distance(trial, base) < ALIKE


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


def _ruled_out(case: Case, outcome: Outcome, best: Trial, other: Trial) -> bool:
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


# -- leads ------------------------------------------------------------------------------------------------------------
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


def held_against(case: Case, outcome: Outcome, rival: Trial) -> tuple[tuple[float, float], tuple[float, float]]:
    """(lead, lead needed) of the best explanation over one of images that did not compete, and of that one over it."""
    noise = lamp_noise(case, rival, outcome.scale)
    rival.gain, rival.price = noise.gain, noise.price
    rival.deviance = rival.after / outcome.scale - noise.gain
    return _lead(case, outcome, outcome.best, rival), _lead(case, outcome, rival, outcome.best)


def design_effect(case: Case, outcome: Outcome, one: Trial, other: Trial) -> float:
    """By how much the variance of the difference of two chi2 of images exceeds what independent noise makes."""
    direction = kept_values(case, [a - b for a, b in zip(one.images, other.images)])
    left = kept_values(case, outcome.leader.images)
    if case.lamp is not None and not outcome.leader.by_frame:
        # what a lamp did to whole frames has been counted: it is no scatter between them
        noise = frames_about(case, case.lamp, outcome.leader).noise(outcome.scale)
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


def fall_beside(outcome: Outcome, trial: Trial, name: str) -> float:
    """What an effect adds to the others of a trial, of chi2 beside the noise that each of both shares."""
    return outcome.scale * (outcome.without(trial, name).deviance - trial.deviance)


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
            noise, values = frames_about(case, lamp, trial).noise(outcome.scale), values.copy()
            steps = lamp.settled(*frame_images(case, trial), noise)
            for v, step in zip((case.evidence.columns[i] for i in case.evidence.base), steps):
                if v.prior is not None:
                    values.put(v, value_of(case.model, values, v) + float(step))
            trial.settled[key] = case.prior_chi2(values), case.known_chi2(values)
        return trial.settled[key]
    return case.prior_chi2(values), case.known_chi2(values)


# -- blocks left out -------------------------------------------------------------------------------------------------
def weighed_by_blocks(case: Case, outcome: Outcome) -> Outcome:
    """The outcome when explanations near the best must also predict blocks of the session that were left out."""
    near = [t for t in outcome.trials if t is outcome.leader or t in outcome.survivors or not t.members]
    near += [t for t in outcome.trials[:NEAR] if t not in near]
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
    columns, r = derivatives_of(case, trial), np.concatenate(kept_values(case, trial.images))
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
