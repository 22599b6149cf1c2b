"""Beside the verdict: upper limits, a word for each effect, warnings, and hints what to measure next."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optics.captures import noise as camera_noise
from optics.diagnosis import statistics as st
from optics.diagnosis.decide import CURVE, HOMOGENEITY, PREDICTS, Findings
from optics.diagnosis.evidence import Candidate, Evidence, at_bound, measure, priors
from optics.diagnosis.explanations import Outcome, Trial
from optics.diagnosis.fingerprints import NO_DRAFT
from optics.diagnosis.refit import Case
from optics.diagnosis.result import NAMED, Basis, Condition, Shift, Split
from optics.diagnosis.score import KAPPA, Table
from optics.diagnosis.shared_noise import is_a_gain, wander_of
from optics.diagnosis.text import AT_FAULT, leaves_misfit, left_of, moved_by
from optics.diagnosis.thresholds import CLEAR, EXCESS, LEVEL
from optics.fit.model import value_of
from optics.scene.declare import Effect
from optics.words import percent, some, spaced

LONE = 6.0  # sd, by which a reading is off that is named: among ten thousand readings of noise none is
SLIGHT = 0.05  # rms change over the mean signal, within which images of other effects stay as they were to a twentieth
RENDER_NOISE = 0.01  # of the camera's variance: Monte Carlo noise above it weakens every test
SMOOTH = 0.7  # of the noise expected in fine detail: below, neighbouring pixels share their noise
CERTAIN, NOTHING_LEFT = 5.0, 3.0  # standard deviations of an effect that was there, and of one that is not any more
SWUNG = 0.1  # of the excess: a lamp that makes more of it is mentioned
REPEATABLE = 1000  # times as many frames: above, repeats are no advice
# where no shot was simulated
USUALLY = "the same press at 0.4 of the exposure, and one deeper press, often tell more than repeats"


def write_limits(case: Case, claimed: Trial | None, basis: Basis) -> None:
    """Upper limits of every effect; after a claim, at the values of the best explanation, so as not to be misled. Where
    that leaves much, more is missing there too, and they are those of the base."""
    evidence, others, widen = case.evidence, case.table.order, math.sqrt(max(basis.phi, 1.0))
    if claimed is not None and leaves_misfit(claimed.excess_sd, basis):
        claimed = None
    if claimed is not None:
        others = [c for c in others if c not in claimed.members]
        near = _beside(case, claimed)
        if near is None:
            evidence, others = _again(case, claimed, others)
        else:
            evidence = near
        widen = math.sqrt(max(left_of(claimed.excess_sd, basis), 1.0))
    for c in others:
        _write_limit(evidence, c, list(c.forms) if claimed is not None else [c.form], widen)


def _again(case: Case, claimed: Trial, others: Sequence[Candidate]) -> tuple[Evidence, list[Candidate]]:
    """Evidence at the values with what was claimed, and the other candidates with their columns there."""
    values = claimed.fit.values
    base = [
        v
        for v in [
            *(case.evidence.columns[i] for i in case.evidence.base),
            *(v for c in claimed.members for v in c.variables),
        ]
        if not at_bound(v, value_of(case.model, values, v))
    ]
    found = [replace(c, forms={}, broken=False) for c in others]
    frames = case.evidence.frames
    own = measure(case.model, values, base, found, frames, case.rows_max, case.seed, case.say, "upper limits")
    return own, found


def _beside(case: Case, claimed: Trial) -> Evidence | None:
    """The evidence of the base with the residual that is left, and with what was claimed in its base: images of other
    effects are then those of before, which saves as many renders as a ranking takes. None where what was claimed, and
    the base with it, changed images by more than SLIGHT."""
    evidence, k = case.evidence, case.evidence.thinning
    if evidence.is_table:
        return None
    moved = sum(float(np.sum((a - b) ** 2)) for a, b in zip(evidence.whitened, claimed.images))
    if evidence.noise * math.sqrt(moved / max(evidence.normal.count, 1)) > SLIGHT:
        return None
    blocks = [
        replace(block, r=np.asarray(image, float).reshape(-1)[block.index])
        for block, image in zip(evidence.blocks, claimed.images)
    ]
    values = claimed.fit.values

    def free(column: int) -> bool:
        variable = evidence.columns[column]
        return not at_bound(variable, value_of(case.model, values, variable))

    held = [i for i, column in enumerate(evidence.base) if free(column)]
    added = [i for c in claimed.members for i in c.columns if free(i)]
    base = [evidence.base[i] for i in held]
    own = replace(
        evidence,
        blocks=blocks,
        base=[*base, *added],
        rest=[i for i in evidence.rest if i not in added],
        precision=evidence.precision[held],
        pull=priors(case.model, values, [evidence.columns[i] for i in base])[1],
    )
    projected = own.project(own.thinned(), own.base, own.rest, k)
    own.projected = replace(projected, information=projected.information * k, score=projected.score * k)
    return own


def _write_limit(evidence: Evidence, c: Candidate, forms: Sequence[str], widen: float) -> None:
    """|change| + 2 sd of each strength, by the form of the effect's image that explains most; the sd times `widen`."""
    projected, best = evidence.projected, -math.inf
    place = {column: j for j, column in enumerate(evidence.rest)}
    for form in forms:
        columns = c.forms[form]
        seen = [j for j, i in enumerate(columns) if i in place and projected.survival[place[i]] > st.VISIBLE]
        if not seen or c.broken:
            continue
        own = [place[columns[j]] for j in seen]
        cone = st.Cone(projected.information[np.ix_(own, own)], [c.sides[j] for j in seen], draws=1000)
        fall, found = cone.solve(projected.score[own])
        if fall - cone.expectation > best:
            best = fall - cone.expectation
            linear = np.full(len(c.variables), math.nan)
            linear[seen] = np.abs(found) + 2 * widen * cone.sd
            # the form of the limit, not that of the score
            c.row.upper = replace(c, form=form).change_of(linear).tolist()


def write_verdicts(
    table: Table, word: str, winner: Candidate | None, outcome: Outcome, splits: Sequence[Split]
) -> None:
    """Each effect's own verdict and the flags that come of splits and of other weights."""
    members = [c for t in outcome.survivors for c in t.members]
    for c in table.order:
        mine = [s for s in splits if s.effect == c.effect.name]
        if mine and not all(s.holds for s in mine):
            c.row.flags.append("inhomogeneous")
        if c.row.refit is None and c.row.net <= 0 or c.row.p_family >= LEVEL:
            c.row.verdict = "nothing visible" if "nothing visible" in c.row.flags else "no evidence"
        elif word == "CLAIM" and c is winner:
            c.row.verdict = "claimed"
        elif word == "AMBIGUOUS" and c in members:
            c.row.verdict = "possible"
        elif word == "PARTIAL" and c is winner:
            c.row.verdict = "partial"
        if c is winner and table.p_best < LEVEL and table.fragile(c.effect.name, outcome.named):
            c.row.flags.append("fragile")


def warnings_of(
    case: Case,
    word: str,
    winner: Candidate | None,
    outcome: Outcome,
    shifts: Sequence[Shift],
    dropped: Sequence[str],
    basis: Basis,
) -> list[str]:
    """What weakens the verdict, in sentences."""
    model, evidence, table = case.model, case.evidence, case.table
    texts = [] if case.fit.converged else [f"the base stopped before it converged: {case.fit.reason}"]
    if model.captures is not None:
        texts += [w for w in camera_noise.warnings_of(model.noise, model.captures) if w not in texts]
    if dropped:
        texts.append(f"at a bound, and therefore held fixed: {', '.join(dropped)}")
    if evidence.not_finite:
        texts.append(f"{evidence.not_finite} values left out because prediction or derivative is not finite")
    if evidence.render_noise > RENDER_NOISE:
        texts.append(
            f"Monte Carlo noise of the prediction adds {evidence.render_noise:.1%} to the variance; render with more "
            "samples"
        )
    noisy = [c.effect.name for c in table.order if c.row.kappa > KAPPA]
    if noisy:
        texts.append(
            f"the noise of derivative images exceeds {KAPPA:.0%} of their signal: {', '.join(noisy)}; render with more "
            "samples"
        )
    if basis.high_frequency < SMOOTH:
        texts.append(
            f"fine detail of the residual has {basis.high_frequency:.2f} of the noise expected: the images look "
            "interpolated or filtered, or the noise is overstated; neighbouring pixels then share their noise and "
            "p is too small"
        )
    excess, best = basis.chi2 - basis.dof, outcome.best
    explained = bool(best.members) and table.p_best < LEVEL and best.fall > excess / 2 > 0
    lone = of_one_reading(case, best)
    if abs(basis.excess_sd) > EXCESS and basis.structure_p >= LEVEL and not (explained or lone):
        texts.append(
            f"chi2 is {basis.phi:.3g} per degree of freedom without structure: the noise model (gain, PRNU) is off "
            "rather than the physics"
        )
    texts += filter(None, [lone])
    if winner is not None and table.p_best < LEVEL:
        name = winner.effect.name
        for what, other in table.preferred.items():
            if other and other == table.fragile(name, outcome.named):
                texts.append(f"fragile: {what} the best effect is {other}, not {name}")
    if outcome.correlation.share > 0:
        texts.append(
            f"neighbouring readings share {outcome.correlation.share:.0%} of their noise, over some "
            f"{outcome.correlation.length:.2g} readings: falls of chi2 are reduced accordingly"
        )
    moved = [s for s in shifts if s.warn]
    if winner is not None and moved and word in NAMED:
        texts.append(
            f"with {winner.effect.name}, calibrated parameters move by more than 3 sd or out of their priors: "
            + some([moved_by(s) for s in moved], 3)
        )
    return texts


def of_one_reading(case: Case, best: Trial) -> str:
    """A reading that holds more than half of what the best explanation leaves beyond noise: it may have been written
    down wrongly. '' where none does, and of images."""
    evidence, frames = case.evidence, [case.model.frames[f] for f in case.evidence.frames]
    if not evidence.is_table:
        return ""
    squares = [np.square(np.asarray(image, float)).reshape(len(image), -1).sum(1) for image in best.images]
    count = sum(int(np.asarray(use).sum()) for use in evidence.use)
    excess = sum(float(s.sum()) for s in squares) - count
    k = max(range(len(squares)), key=lambda k: float(squares[k].max()))
    i, most = int(np.argmax(squares[k])), float(squares[k].max())
    if excess < EXCESS * math.sqrt(2 * count) or most < max(excess / 2, LONE**2):
        return ""
    rows = frames[k].rows
    number = int(rows[i, 0, 0]) if rows is not None else i
    at = ", ".join(f"{key} = {values[i, 0, 0]:.5g}" for key, values in list(frames[k].readings.items())[:4])
    return (
        f"reading {number} (from 0{'; ' + at if at else ''}) is off by {math.sqrt(most):.2g} sd and holds "
        f"{min(most / excess, 1.0):.0%} of the excess that is left: check what is written down of it, or take it again"
    )


def lamp_text(case: Case, outcome: Outcome, basis: Basis) -> str:
    """A sentence on what a lamp did to whole frames, where that is much of the misfit of images: a verdict counts it as
    noise, which its reader would not see. Empty elsewhere, also where there is no excess to share."""
    best = outcome.best
    if case.evidence.is_table or case.lamp is None or best.by_frame:
        return ""
    if not basis.excess_sd > EXCESS:
        return ""
    share = best.gain * outcome.scale / max(basis.chi2 - basis.dof, 1.0)
    if not share > SWUNG:
        return ""
    names = [c.effect.name for c in case.table.order if is_a_gain(c)]
    more = f" If no lamp did that, add {some(names)} and diagnose again." if names else ""
    swing = percent(wander_of(case, outcome, best))
    frames = "Besides, whole frames" if best.members else "Whole frames"
    return (
        f"{frames} are brighter or darker than predicted by {swing} (rms), which is {percent(min(share, 1.0), 2)} of "
        f"the excess and counts as noise: a lamp or an exposure that changes from frame to frame.{more}"
    )


def replaced(case: Case, best: Trial, added: Sequence[Effect]) -> list[str]:
    """A sentence where the best explanation leaves nothing of effects that were added before.

    Their strengths were CERTAIN errors from neutral. They are at a tenth of that, or at a quarter of it and within
    NOTHING_LEFT errors of neutral."""
    sd = [{v.name: float(s) for v, s in zip(fit.variables, fit.sd)} for fit in (case.fit, best.fit)]
    gone: dict[str, list[str]] = {}
    for effect in added:
        names = {v.name for v in case.variables_of(effect)}
        own = []
        for v in (v for v in case.fit.variables if v.name in names and v.name in sd[1]):
            was, now = (value_of(case.model, fit.values, v) for fit in (case.fit, best.fit))
            neutral = v.parameter.neutral
            if neutral is not None and (there := abs(was - neutral)) > CERTAIN * sd[0][v.name]:
                left = max(min(NOTHING_LEFT * sd[1][v.name], there / 4), there / 10)
                own.append((abs(now - neutral) < left, f"{v.name} {was:.3g} -> {now:.2g}{spaced(v.parameter.unit)}"))
        if own and all(found for found, _ in own):
            gone[effect.name] = [text for _, text in own]
    if not gone:
        return []
    *first, last = (c.effect.name for c in best.members)
    commands = [f"optics add STUDY '{name}'" for name in first]
    commands.append(" ".join([f"optics add STUDY '{last}'", *(f"--drop '{name}'" for name in gone)]))
    return [
        f"with {' and '.join([*first, last])} nothing is left of {' and '.join(gone)}, added before "
        f"({some([text for texts in gone.values() for text in texts], 3)}): one stands in for the other; compare the "
        f"held-out frames without it ({'; '.join(commands)})"
    ]


def hints_of(
    word: str,
    conditions: Sequence[Condition],
    outcome: Outcome,
    findings: Findings,
    gaps: Sequence[Sequence[float]],
    names: Sequence[str],
) -> list[str]:
    """What to measure next, in words: from D between the effects and from what they declare, without simulated shots.

    gaps   D[i][j] between the refitted effects `names`
    """
    members = list({c.effect.name: c for t in outcome.survivors for c in t.members}.values())
    single = [t.members[0] for t in outcome.survivors if len(t.members) == 1]
    failed = {c.name for c in conditions if not c.holds}
    hints = []
    if word == "AMBIGUOUS":
        hints = _for_a_tie(single, gaps, names) if len(single) > 1 else []
        hints += [f"{c.effect.name} needs: {c.effect.needs}" for c in members if c.effect.needs and c not in single]
        if findings.shared:
            hints.append(
                "take the settings in a shuffled order, or return to one of them again and again: a drift during the "
                "session then no longer follows the settings"
            )
    if "spread" in failed:
        hints.append(f"repeat {findings.carried_by}: nearly all of the fall of chi2 comes from it")
    if PREDICTS in failed:
        hints.append("check what is written down of the held-out frames, or hold out others (--hold-out)")
    if "held out" in failed and word != "NOTHING":
        hints.append(
            "hold out other frames (other presses or positions), or find why the held-out frames do not improve"
        )
    if HOMOGENEITY in failed:
        hints.append(
            "look at the parts of the data between which its strength differs most (optics view shows what is left of "
            "every frame): what sets them apart is not in the model, or was noted wrongly"
        )
    if word in ("CANNOT_TELL", "UNKNOWN"):
        hints.append("optics compare CAPTURES --fit STUDY lists the misfit by frame, by light and by channel")
    if "near" in failed:
        hints.append(f"no effect brings the model near its images: check {AT_FAULT}")
    if CURVE in failed:
        hints.append(
            "check [noise]: repeats of one frame determine system_gain and dark_noise, a flat_field removes the "
            "sensor's own pattern"
        )
    if word == "UNKNOWN" and findings.another_law:
        hints.append(
            f"write an effect with the law that this sensor follows ({findings.law}), or state the errors of settings "
            "under [uncertainty]"
        )
    elif word == "UNKNOWN" and findings.coordinate in NO_DRAFT:
        hints.append(f"no effect can be drafted along '{findings.coordinate}': {NO_DRAFT[findings.coordinate]}")
    elif word == "UNKNOWN":
        hints.append(
            "draft an effect from the curve (optics effects new NAME --from STUDY), add it, and diagnose again"
        )
    return hints


def _for_a_tie(members: Sequence[Candidate], gaps: Sequence[Sequence[float]], names: Sequence[str]) -> list[str]:
    """What tells the effects of an ambiguous set apart, above all the pair that is hardest to tell apart."""

    def least(a: Candidate, b: Candidate) -> float:
        i, j = names.index(a.effect.name), names.index(b.effect.name)
        return min(gaps[i][j], gaps[j][i])

    pairs = [(least(a, b), a, b) for i, a in enumerate(members) for b in members[i + 1 :]]
    d, a, b = min(pairs, key=lambda pair: pair[0])
    pair = (
        f"hardest pair: {a.effect.name} / {b.effect.name}, expected chi2 between them D = {d:.3g}, "
        f"P(correct) = {st.probability_correct(d):.2f} in noise alone; "
    )
    more = math.ceil(CLEAR / d) if d > 0 else 0
    if d >= CLEAR:
        hints = [
            pair + "the noise would allow a decision, but the misfit that both leave does not",
            "add each of them in a copy of the study, diagnose again, and keep the one that leaves the least: further "
            "missing effects hide which of them it is",
        ]
    elif 0 < more < REPEATABLE:
        hints = [pair + f"{more} times as many frames of the same kind would decide in 95 % of cases"]
    else:
        hints = [pair + "more frames of the same kind will not decide"]
    for one, other in ((a, b), (b, a)):
        alone = [x for x in one.effect.acts if x not in other.effect.acts]
        if alone:
            hints.append(f"only {one.effect.name} acts through {', '.join(alone)}: vary that and keep the rest")
    hints += [f"{c.effect.name} needs: {c.effect.needs}" for c in members if c.effect.needs]
    return [*hints, USUALLY]
