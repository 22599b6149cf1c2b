"""Findings: the numbers that a verdict is made of, gathered from scores, explanations, splits, curves and held-out
frames."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optics.diagnosis import dials_as_rival
from optics.diagnosis import fingerprints as prints
from optics.diagnosis import statistics as st
from optics.diagnosis.competition import fall_over_noise, lead_without
from optics.diagnosis.correlation import NOTICED, WANDER
from optics.diagnosis.decide import Findings, Opponent, ordered, rivals
from optics.diagnosis.dials import unstated
from optics.diagnosis.evidence import Candidate, Evidence, at_bound
from optics.diagnosis.explanations import Outcome, farness
from optics.diagnosis.refit import Case, clear
from optics.diagnosis.result import Basis, Fingerprint, Law, Level, Split
from optics.diagnosis.shared_noise import beside_noise
from optics.diagnosis.thresholds import AS_GOOD, DETAIL, HIDDEN, LEVEL, MAIN, MISSTATED, SURE, TOLD, UNEVEN
from optics.fit.compare import led_label
from optics.fit.model import Model, value_of
from optics.fit.result import Fit
from optics.fit.run_away import powers_apart
from optics.fit.scene_model import SceneModel
from optics.scene.parameter import Variable


def basis_of(model: Model, evidence: Evidence, structure: st.Structure) -> Basis:
    """What the verdict rests on: data, noise and misfit of the base."""
    n, rank = evidence.normal.count, evidence.projected.rank
    dof = max(n - rank, 1)
    chi2 = evidence.projected.chi2
    frame_n = [max(int(u.sum()), 1) for u in evidence.use]
    frame_chi2 = [float(np.sum(w.astype(float) ** 2)) for w in evidence.whitened]
    return Basis(
        frames=len(evidence.frames),
        values=n,
        masked=evidence.masked,
        not_finite=evidence.not_finite,
        thinning=evidence.thinning,
        signal=evidence.signal,
        noise=evidence.noise,
        misfit=evidence.noise * math.sqrt(chi2 / dof),
        chi2=chi2,
        dof=dof,
        rank=rank,
        phi=chi2 / dof,
        excess_sd=(chi2 - dof) / math.sqrt(2 * dof),
        gradient=evidence.gradient,
        structure_f=structure.f,
        structure_p=structure.p,
        high_frequency=structure.high,
        render_noise=evidence.render_noise,
        frame_names=[model.frames[f].name for f in evidence.frames],
        frame_phi=[c / m for c, m in zip(frame_chi2, frame_n)],
    )


def subject_of(case: Case, outcome: Outcome) -> Candidate | None:
    """The effect that a verdict may name: of those that every survivor has, or else of the best explanation, the one
    without which most is lost; None where nothing is told apart from no effect at all. One that errors of dials stand
    against waits for the others: these are missing whatever the dials did."""
    best = outcome.best
    able = [c for c in best.members if c.effect.name in outcome.core] or best.members
    able = [c for c in able if not _unset(case, outcome, c)] or able
    return max(able, key=lambda c: outcome.own_fall(best, c.effect.name), default=None)


def findings_of(
    case: Case,
    outcome: Outcome,
    fingerprints: Sequence[Fingerprint],
    laws: Sequence[Law],
    splits: Sequence[Split],
    chance: float,
    levels: Sequence[Level],
    basis: Basis,
) -> Findings:
    """The numbers that decide.

    laws     of the effects that the model has already, best first
    splits   of the survivors' main effects; chance: p of the subject's strength by scatter
    """
    table, subject, best = case.table, subject_of(case, outcome), outcome.best
    measured = case.measured
    misstated = basis.structure_p >= LEVEL and basis.phi < MISSTATED and not (measured or case.evidence.is_table)
    if subject is None:
        fall = max([t.fall - t.expectation for t in outcome.trials] + [0.0])
        own = Findings(table.p_best, basis.structure_p, fall=fall, excess_sd=basis.excess_sd)
        if case.evidence.is_table and outcome.wander <= WANDER:
            noise, p = beside_noise(case, outcome)
            own = replace(own, wander=outcome.wander, wander_p=p, memory=noise.length)
    else:
        own = _of_subject(case, outcome, subject, splits, chance, levels, basis)
    base = levels[0]
    own = replace(own, measured=measured, misstated=misstated)
    own = replace(own, base_fitted=base.chi2_fitted, base_held_out=base.chi2_held_out)
    if laws and laws[0].p < LEVEL:
        lead = law_lead(case, outcome, laws[0].score)
        own = replace(own, law=f"{laws[0].effect} along {laws[0].coordinate}", law_lead=lead)
    if not fingerprints:
        return own
    if swings := _swings(outcome, fingerprints, basis):
        return replace(own, rival=True, ratio=swings.ratio, coordinate=swings.coordinate, curve_share=swings.share)
    whole = {f.coordinate: f.net for f in fingerprints}
    curve = followed(case, subject, best.fit, best.fall - best.expectation, fingerprints)
    fingerprints = [f for f in fingerprints if not f.per_frame]
    # a curve is no better than effects while any set of them does as well: the leader, not the simplest beside it
    leader = outcome.leader if subject else outcome.base
    complete = bool(leader.members) and leader.complete
    fall = leader.fall - leader.expectation if subject else own.fall
    session = case.session if case.evidence.is_table else case.lamp
    if beside := session is not None and not leader.by_frame:
        scale = outcome.scale
        fingerprints = prints.beside_shared_noise(
            case.model, case.evidence, case.places or [], fingerprints, session, scale
        )
        # of those that effects bring beside such noise too
        ahead = [leader] if subject else outcome.trials
        fall = max(0.0, *(outcome.base.deviance - t.deviance - t.expectation for t in ahead))
    fingerprints = [replace(f, ratio=f.net / max(fall, 1.0)) for f in fingerprints]
    if not fingerprints:
        return own
    opponent = Opponent(
        fall,
        leader.cost,
        len(leader.members),
        sum(len(c.cone.live) for c in leader.members),
        complete,
        complete or case.evidence.is_table,
    )
    better = [curve] if curve else [] if _is_detail(own) else rivals(fingerprints, opponent)
    # beside noise that explains most, a curve of something else may seem to do better than an effect
    better = [f for f in better if whole[f.coordinate] >= AS_GOOD * own.fall]
    best_curve = better[0] if better else fingerprints[0]
    lead = best_curve.net - best_curve.cost - (opponent.fall - opponent.cost)
    return replace(
        own,
        ratio=best_curve.net / max(fall, 1.0),
        beside=beside,
        rival=bool(better),
        curve_lead=math.inf if curve else 0.0 if complete else lead,
        coordinate=best_curve.coordinate,
        curve_share=best_curve.share,
    )


def _is_detail(own: Findings) -> bool:
    """Whether the best explanation leaves less than DETAIL of the excess, by HIDDEN standard deviations of the share,
    each 1/excess_sd. To have explained more than all of it is no better."""
    return own.weighed and max(1 - own.share, 0.0) + HIDDEN / own.excess_sd < DETAIL


def law_lead(case: Case, outcome: Outcome, score: float) -> float:
    """Lead of the best explanation over another law: a law falls from what noise that neighbours share leaves without
    any effect; beside gains of each frame, which are that noise, from the whole misfit."""
    without_lamp = outcome.best.by_frame and not case.evidence.is_table
    return outcome.score(outcome.best) - (0.0 if without_lamp else outcome.score(outcome.base)) - score


def _swings(outcome: Outcome, fingerprints: Sequence[Fingerprint], basis: Basis) -> Fingerprint | None:
    """The curve along a clock where a wander that is too large for noise explains the residual better than any effect
    does: a lamp that swings by 7 % is no noise, but something that happens in the session."""
    structure = outcome.wander > NOTICED and outcome.base.after > MISSTATED * basis.dof
    if not structure or outcome.score(outcome.base) < outcome.score(outcome.leader) + TOLD:
        return None
    clocks = [f for f in fingerprints if f.family == "time" and f.p < LEVEL]
    return ordered(clocks)[0] if clocks else None


def _of_subject(
    case: Case,
    outcome: Outcome,
    subject: Candidate,
    splits: Sequence[Split],
    chance: float,
    levels: Sequence[Level],
    basis: Basis,
) -> Findings:
    """What the refits, the splits and the held-out frames say about the subject of a verdict."""
    name, best, table = subject.effect.name, outcome.best, case.table
    mine = [s for s in splits if s.effect == name]
    names = {s.effect for s in splits}
    even = [all(s.holds for s in splits if s.effect == n) for n in names]
    worst = max(mine, key=lambda s: (not s.holds, s.h), default=None)
    excess = basis.chi2 - basis.dof
    lead, needed, against = lead_without(case, outcome, subject)
    carried, carried_by = _carried(case, outcome, subject)
    strength = [value_of(case.model, best.fit.values, v) for v in subject.variables]
    fall, held_out = fall_over_noise(case, outcome, name), levels[-1].fall if len(levels) > 1 else math.nan
    rest = outcome.without(best, name)
    priced = farness(case, best.members, best.fit) - farness(case, rest.members, rest.fit)
    return Findings(
        table.p_best,
        basis.structure_p,
        name,
        table.family.p(float(subject.cone.p(fall))),
        best.fall - best.expectation,
        common=name in outcome.core,
        shared=outcome.shared,
        survivors=len(outcome.survivors),
        lead=lead,
        needed=needed,
        against=against,
        detail_of=_detail_of(outcome, name),
        share=(best.fall - best.expectation) / excess if excess > 0 else math.nan,
        excess_sd=basis.excess_sd,
        left=basis.misfit * math.sqrt(max(1 - best.fall / basis.chi2, 0.0)),
        uneven=worst.h if worst else math.nan,
        uneven_by=f" by {worst.by} ({_extremes(worst)})" if worst else "",
        uneven_limit=worst.limit if worst else UNEVEN,
        uneven_certain=any(s.p < LEVEL and s.chance < LEVEL for s in mine),
        even=all(s.holds for s in mine),
        some_even=any(even) if even else True,
        held_out=held_out,
        p_both=table.family.p(float(subject.cone.p(max(fall + held_out / outcome.scale, 0.0)))),
        ahead=-best.ahead,
        clear=clear(best.fit, subject, strength),
        far=_far(subject, strength),
        adds=fall,
        priced=priced,
        at_end=_at_end(subject, strength),
        complete=best.complete,
        ran=_ran(case, best.fit),
        unset=_unset(case, outcome, subject),
        chance=chance,
        carried=carried,
        carried_by=carried_by,
        fragile=table.fragile(name, outcome.named),
        untried=[" with ".join(sorted(names)) for names in outcome.untried if name not in names],
        run_away=powers_apart(case.model, best.fit),
    )


def _detail_of(outcome: Outcome, name: str) -> str:
    """Effects of the best explanation that not every survivor has, where they explain nearly all without those that
    every survivor has, and more than these do; '' where they do not. Those that all have may then be a detail of the
    law of the others."""
    best, core = outcome.best, set(outcome.core)
    undecided, decided = best.names - core, best.names & core
    if name not in decided or not undecided:
        return ""
    rest, own = (max(t.fall for t in outcome.trials if t.names <= names) for names in (undecided, decided))
    return " with ".join(sorted(undecided)) if rest > max(MAIN * best.fall, own) else ""


def _far(subject: Candidate, strength: Sequence[float]) -> float:
    """The change of an effect's strengths in plausible sizes: of several, the root of the sum of squares; of strengths
    of each frame, the rms."""
    square = np.square((np.array(strength) - subject.start) / subject.plausible)
    return math.sqrt(float(np.mean(square) if subject.effect.scope == "frame" else np.sum(square)))


def _at_end(subject: Candidate, strength: Sequence[float]) -> str:
    """'camera.glare 1' where a strength that moved stands at an end of its range; '' where none does."""
    ends = [
        f"{v.name} {x:.3g}"
        for v, x, start in zip(subject.variables, strength, subject.start)
        if at_bound(v, x) and abs(x - start) > 0
    ]
    return ", ".join(ends)


def _unset(case: Case, outcome: Outcome, subject: Candidate) -> str:
    """The dials that images turn and nobody states, where their errors may be what an effect with a strength per frame
    explains."""
    model = case.model
    if subject.effect.scope != "frame" or case.evidence.is_table or not isinstance(model, SceneModel):
        return ""
    keys = unstated(model)
    names = outcome.best.names, subject.effect.name
    if keys and names not in case.over_dials:
        case.over_dials[names] = dials_as_rival.lead_over(case, outcome, subject, keys)
    return " and ".join(keys) if keys and case.over_dials[names] <= SURE else ""


def _ran(case: Case, fit: Fit) -> str:
    """The values of the base that stand at a bound, and that a fit brings back by more than a plausible size."""

    def moved(v: Variable) -> float:
        return abs(value_of(case.model, fit.values, v) - value_of(case.model, case.fit.values, v))

    return ", ".join(v.name for v in case.base if v.name in case.fit.at_bound and moved(v) > v.parameter.plausible)


def _carried(case: Case, outcome: Outcome, subject: Candidate) -> tuple[float, str]:
    """(share, part) of the frame, the LED or the channel in which most of the fall lies by an effect that has a
    strength per frame; (0, '') for other effects, and where there are fewer than three parts. Where each light has a
    strength, that one light or its colour carries all is what the effect says: frames are asked about then."""
    if subject.effect.scope != "frame":
        return 0.0, ""
    model, evidence = case.model, case.evidence
    without = outcome.without(outcome.best, subject.effect.name)
    gain = [np.asarray(a, float) ** 2 - np.asarray(b, float) ** 2 for a, b in zip(without.images, outcome.best.images)]
    # what is known of dials falls too: where they took the effect up, images hardly know of it
    known = case.known_chi2(without.fit.values) - case.known_chi2(outcome.best.fit.values)
    total = sum(float(g.sum()) for g in gain) + max(known, 0.0)
    frames = [model.frames[f] for f in evidence.frames]
    by: dict[str, dict[str, float]] = {"frame": {}, "LED": {}, "channel": {}}
    for frame, g in zip(frames, gain):
        for kind, label in (("frame", frame.name), ("LED", led_label(frame.parameters))):
            by[kind][label] = by[kind].get(label, 0.0) + float(g.sum())
        for label, own in zip(prints.channel_names(evidence), g.sum((0, 1))):
            by["channel"][label] = by["channel"].get(label, 0.0) + float(own)
    asked = by if subject.effect.per == "kind" else ("frame",)
    most = [
        (max(parts.values()), f"{kind} {max(parts, key=lambda k: parts[k])}")
        for kind, parts in by.items()
        if len(parts) > 2 and kind in asked
    ]
    if not most or not total > 0:
        return 0.0, ""
    fall, part = max(most)
    return fall / total, part


def followed(
    case: Case, subject: Candidate | None, fit: Fit, net: float, fingerprints: Sequence[Fingerprint]
) -> Fingerprint | None:
    """The curve along a setting (clocks aside), or of LEDs, that an effect's per-frame strengths follow, and that
    explains as much: such strengths mimic whatever depends on what was set in each frame. None for other effects, and
    where they do not follow any, as a drift does not."""
    if subject is None or subject.effect.scope != "frame":
        return None
    model, evidence = case.model, case.evidence
    series: dict[tuple[str, ...], dict[int, float]] = {}  # of each light apart, where each has a strength
    for v in fit.variables:
        if v.name in subject.row.variables and v.frames:
            series.setdefault(v.keys, {})[v.frames[0]] = value_of(model, fit.values, v)
    turned = prints.settings(model, evidence)
    found: list[tuple[float, Fingerprint]] = []
    for curve, own in itertools.product(fingerprints, series.values()):
        if curve.net <= AS_GOOD * net:
            continue
        if curve.coordinate == "LED":
            groups: dict[str, list[float]] = {}
            for f, y in own.items():
                groups.setdefault(led_label(model.frames[f].parameters), []).append(y)
            found.append((st.differs(list(groups.values())), curve))
        elif curve.coordinate in turned and curve.family != "time":
            x = dict(zip(evidence.frames, turned[curve.coordinate]))
            both = [(x[f], y) for f, y in own.items() if math.isfinite(x.get(f, math.nan))]
            found.append((st.follows(*np.array(both).T) if len(both) > 1 else math.nan, curve))
    if not found:
        return None
    p, curve = min(found, key=lambda t: (math.isnan(t[0]), t[0]))
    return curve if p * len(found) < LEVEL else None  # Bonferroni: the best of as many settings


def _extremes(split: Split) -> str:
    """'R 2.75, B 0.03': the parts of a split where the strength is largest and smallest."""
    order = np.argsort(split.strength)
    return ", ".join(f"{split.labels[i]} {split.strength[i]:.2f}" for i in (order[-1], order[0]))
