"""How a verdict reads: the sentence with the numbers that decided it, and the report for a terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from optics.diagnosis.decide import CURVE, HOMOGENEITY, PREDICTS, STANDS_OUT, Findings, wander_text
from optics.diagnosis.result import (
    NAMED,
    PLANS,
    Advice,
    Basis,
    Condition,
    Diagnosis,
    Explanation,
    Fingerprint,
    Level,
    Row,
    Shift,
    kinds_of,
    leaves_nothing,
)
from optics.diagnosis.thresholds import CLEAR, CLUTTERED, EXCESS, LEVEL, MARGIN, MISSTATED, STRENGTH, SURE
from optics.words import (
    ANYWHERE,
    NO_LIMIT,
    NOT_DETERMINED,
    Reach,
    below,
    p_text,
    percent,
    share_text,
    spaced,
    table,
    times_sd,
    with_sd,
)

MOST = 0.9  # of the excess: explanations of less are not all that is missing, and the verdict says so
LEAST = 0.1  # D with the best shots, below which these leave two effects as alike as they are
# what to check where no effect brings the model near its images
AT_FAULT = (
    "units, LEDs that were off, black_level, that images are linear (not encoded for viewing) and whole, with row 0 at "
    "the top, and that the camera stands and sees as the scene says (what is not known is solved for if captures.toml "
    "gives it under [parameters] and its error under [uncertainty])"
)


def strength_text(
    values: Sequence[float], sds: Sequence[float], units: Sequence[str], reaches: Sequence[Reach] = ()
) -> str:
    """Strengths with their standard deviations: all of them up to three, else the largest that is determined."""
    unit = units[0] if units else ""
    reaches = reaches or [ANYWHERE] * len(values)
    sds = [math.inf if math.isnan(s) else s for s in sds]  # of a strength that the projection has left nothing of
    if len(values) <= 3:
        texts = [with_sd(v, s, reach=r) for v, s, r in zip(values, sds, reaches)]
        said = texts[-1:] if len(set(texts)) == 1 and texts[0] == NOT_DETERMINED else texts
        return ", ".join(said) + (spaced(unit) if said and said[-1] != NOT_DETERMINED else "")
    known = [i for i, (v, s, r) in enumerate(zip(values, sds, reaches)) if r.holds(v, s)]
    if not known:
        return f"{len(values)} values, {NOT_DETERMINED}"
    biggest = max(known, key=lambda i: abs(values[i]))
    return f"{len(values)} values up to {with_sd(values[biggest], sds[biggest], unit=unit)}"


def left_of(excess_sd: float, basis: Basis) -> float:
    """chi2 per degree of freedom that an explanation leaves."""
    return 1 + excess_sd * math.sqrt(2 / max(basis.dof, 1))


def leaves_misfit(excess_sd: float, basis: Basis) -> bool:
    """Whether an explanation leaves more than a wrong size of the noise would: what else is missing has no limits."""
    return left_of(excess_sd, basis) > MISSTATED


def limits(row: Row) -> list[float]:
    """The upper limits of an effect's strengths that rule something out; none where one of them has no limit."""
    seen = [i for i, u in enumerate(row.upper) if math.isfinite(u)]
    start = [*row.start, *[0.0] * (len(row.upper) - len(row.start))]
    return [row.upper[i] for i in seen] if all(row.reach(i).excludes(row.upper[i], start[i]) for i in seen) else []


def limit_text(row: Row) -> str:
    """The upper limit of an effect: of its strengths, the largest."""
    if not any(math.isfinite(u) for u in row.upper):
        return f"{row.name}: nothing visible"
    known = limits(row)
    return f"{row.name} {below(max(known), unit=row.units[0])}" if known else f"{row.name}: {NO_LIMIT}"


def moved_by(s: Shift) -> str:
    """How far a calibrated parameter moved when the effect was added."""
    return f"{s.variable} by {abs(s.after - s.before):.2g}{spaced(s.unit)}"


def advice_text(a: Advice) -> str:
    """What a shot would tell apart, by how much."""
    p = a.hardest
    return (
        f"{a.shot}: {'tells' if p.told else 'hardly tells'} {p.effect} from {p.rival}, D {p.before:.3g} "
        f"-> {p.after:.3g}, P(correct) {p.correct_before:.2f} -> {p.correct_after:.2f}"
        + (
            ""
            if math.isnan(p.share_after)
            else f", D over the fall {percent(p.share_before)} -> {percent(p.share_after)} "
            f"({percent(MARGIN)} needed while misfit is left)"
        )
        + (f"; the closest two then have D {a.least:.3g}" if a.least < min(0.9 * p.after, 4 * CLEAR) else "")
    )


def advice_lines(advice: Sequence[Advice]) -> list[str]:
    """The best plan, as many further presses for comparison, and up to four single shots that make a difference."""
    plans = {a.family: a for a in advice if a.family in PLANS}
    singles = [a for a in advice if a.family not in PLANS]
    lines = [f"next: {advice_text(plans['together'])}"] if "together" in plans else []
    if lines and (p := plans["together"].hardest).after < LEAST:
        # a shot that changes nothing is no advice
        return [
            f"next: none of the simulated frames separates {p.effect} from {p.rival}; another setting or part would"
        ]
    if "more of the same" in plans:
        lines.append(f"      (more of the same instead: {advice_text(plans['more of the same'])})")
    known = {a.shot for a in plans.values()}
    return (
        lines + [f"next, or by itself: {advice_text(a)}" for a in singles if a.shot not in known and a.hardest.told][:4]
    )


def sentence(
    word: str,
    conditions: Sequence[Condition],
    f: Findings,
    rows: Sequence[Row],
    explanations: Sequence[Explanation],
    fingerprints: Sequence[Fingerprint],
    levels: Sequence[Level],
    shifts: Sequence[Shift],
    basis: Basis,
) -> str:
    """The verdict in words, with the numbers that decided it.

    rows      all effects; explanations: sets of effects that were refitted, best first
    levels    misfit without and with the winner; shifts: what moved when it was added
    """
    failing = [c for c in conditions if not c.holds and c.name != "structure is left"]
    if word == "NOTHING":
        return _nothing(f, len(rows))
    if word == "AMBIGUOUS":
        return _ambiguous(f, explanations)
    if word == "UNKNOWN" and f.another_law:
        return (
            f"structure is left that a freer law explains: {f.law}, with a strength that changes along it. Its score "
            f"is {-f.law_lead:.3g} above that of the best effect. The effect is in the model, but this sensor follows "
            "another law."
        )
    if word == "UNKNOWN":
        return _unknown(f, next(c for c in fingerprints if c.coordinate == f.coordinate), basis)
    if word == "CANNOT_TELL" and f.another_value:
        return _another_value(f)
    if word == "CANNOT_TELL" and (missed := [c for c in failing if c.name == PREDICTS]):
        return f"nothing is missing in the frames that were fitted, but {missed[0].text}."
    if word == "CANNOT_TELL":
        last = [c for c in failing if c.name == CURVE]  # says more than all others together
        reasons = "; ".join(f"{c.name}: {c.text}" for c in last or failing) or "; ".join(c.text for c in conditions)
        return f"{_seen(conditions, basis)}, but no verdict holds ({reasons}).{_so_far(f, explanations, basis)}"
    winner = next(row for row in rows if row.name == f.winner)
    if word == "CLAIM":
        return _claim(f, winner, rows, explanations, levels, shifts, basis)
    return _partial(f, winner, failing)


def _another_value(f: Findings) -> str:
    effects = f"the best explanation by effects by {f.fall:.4g}" if f.winner else "and no effect stands out beside it"
    return (
        f"misfit is left that another value of {f.fixed} explains. The calibration keeps this value. With it free chi2 "
        f"falls by {f.fixed_fall:.4g}, {effects}."
    )


def _seen(conditions: Sequence[Condition], basis: Basis) -> str:
    """What asks for an effect where none is named."""
    if not leaves_nothing(basis.structure_p, basis.excess_sd):
        return "misfit is left"
    return "an effect stands out" if any(c.name == STANDS_OUT and c.holds for c in conditions) else "structure is left"


def _so_far(f: Findings, explanations: Sequence[Explanation], basis: Basis) -> str:
    """The explanation with the best score where no verdict holds, in a sentence; '' where nothing is told apart from no
    effect."""
    best = next((e for e in explanations if e.survives and e.effects), None)
    if not f.winner or best is None:
        return ""
    excess = basis.chi2 - basis.dof
    share = f", which explains {share_text(best.fall / excess)} of the excess misfit" if f.weighed else ""
    return f" The best explanation so far is {best.name}{share}."


def _nothing(f: Findings, tested: int) -> str:
    none = f"none of {tested} effects is significant"
    if not f.p_family < LEVEL:
        how = f"family-wise p {p_text(f.p_family)}"
    elif not f.p_winner < LEVEL:
        how = f"after refit, family-wise p {p_text(f.p_winner)}"
    elif f.refuted and not (f.clear < STRENGTH or f.chance >= LEVEL):
        how = f"the best, {f.winner}, raises chi2 of the held-out frames by {-f.held_out:.2g}"
    elif f.adds < f.priced and f.clear >= STRENGTH:
        none = f"of {tested} effects one is significant, but too far from plausible for what it explains"
        how = f"{f.winner} lowers chi2 by {f.adds:.3g}; {f.far:.2g} times its plausible strength costs {f.priced:.3g}"
    elif not f.chance > LEVEL:
        how = f"after refit, the best, {f.winner}, has a strength of {f.clear:.2g} sd"
    else:
        how = f"the best, {f.winner}, scatters as much between parts of the data, p {p_text(f.chance)}"
    tail = (
        f"{wander_text(f)}, as from a lamp whose power wanders, explains the rest "
        f"(structure left: p {p_text(f.wander_p)})"
        if not math.isnan(f.wander_p)
        else f"the excess of {f.excess_sd:.2g} sd has no structure, as of a noise that is stated too small"
        if f.weighed
        else f"no excess misfit is left ({f.excess_sd:.2g} sd)"
        if math.isnan(f.structure_p)
        else f"no structure is left (p {p_text(f.structure_p)})"
    )
    return f"{none} ({how}) and {tail}. The upper limits say what may still be there."


def _claim(
    f: Findings,
    row: Row,
    rows: Sequence[Row],
    explanations: Sequence[Explanation],
    levels: Sequence[Level],
    shifts: Sequence[Shift],
    basis: Basis,
) -> str:
    alive = [e for e in explanations if e.survives]
    best = alive[0]
    text = f"{row.name} is missing, strength {_strength_in(best, row)}."
    if len(best.effects) > 1 or len(alive) > 1:
        text += " It is part of every explanation that is not ruled out: " + ", or ".join(e.name for e in alive) + "."
    if math.isnan(levels[0].held_out):  # of readings that are too few to hold any out
        lowered = f"chi2 of blocks of readings that were left out in turn by {f.ahead:.4g}"
    else:
        lowered = f"held-out misfit from {percent(levels[0].held_out)} to {percent(levels[-1].held_out)}"
    text += (
        f" Adding {'it' if len(best.effects) == 1 else best.name} lowers {lowered} "
        f"(noise: {percent(basis.noise)}). {_alike(f)}"
    )
    others = [] if leaves_misfit(best.excess_sd, basis) else [r for r in rows if r is not row and limits(r)]
    if others:
        text += " Upper limits of other effects: " + ", ".join(limit_text(r) for r in others[:3]) + "."
    moved = [s for s in shifts if s.warn][:2]
    if moved:
        text += " Without it, " + " and ".join(moved_by(s).replace(" by ", " was off by ", 1) for s in moved) + "."
    text += (
        " With it no excess is left; whether a smaller effect is, the next diagnosis tells."
        if best.complete and len(best.effects) == 1
        else f" Add it, calibrate and diagnose again: with {best.name} no excess is left."
        if best.complete
        else f" With {best.name} {_left(best)} is left: add it, calibrate and diagnose again."
    )
    return text + (
        " A lower held-out error verifies the prediction, not the cause. The evidence for the cause is the lead in "
        f"score ({f.lead:.3g}, over {f.against or 'no effect'}), the homogeneity, and that no curve does better."
    )


def _alike(f: Findings) -> str:
    """Whether the strength is the same everywhere: h, the share that splitting it gains, says how far that holds."""
    if math.isnan(f.uneven):
        return "It explains too little, or the data have too few parts, to ask whether its strength is the same in all."
    if f.uneven_certain:
        return (
            f"Between parts of the data its strength differs{f.uneven_by}, by less than matters (h {f.uneven:.2g}, "
            f"{f.uneven_limit:.2g} allowed)."
        )
    return "Its strength is the same in every part of the data."


def _left(best: Explanation) -> str:
    """What an explanation leaves. Where the noise is less than captures say, that is no excess but structure."""
    p = p_text(best.structure_p)
    return (
        f"structure (p {p})" if best.excess_sd < EXCESS else f"an excess of {best.excess_sd:.2g} sd (structure: p {p})"
    )


def _strength_in(e: Explanation, row: Row) -> str:
    """The strengths of an effect within an explanation."""
    if e.told.get(row.name):
        return e.told[row.name]
    own = [i for i, name in enumerate(e.variables) if name in row.variables]
    reaches = [row.reach(row.variables.index(e.variables[i])) for i in own]
    return strength_text([e.strength[i] for i in own], [e.sd[i] for i in own], [e.units[i] for i in own], reaches)


def _ambiguous(f: Findings, explanations: Sequence[Explanation]) -> str:
    kinds = kinds_of(explanations)
    names = ", or ".join(_kind(kind) for kind in kinds)
    count = len(kinds)
    other = f" By other weights or masks {f.fragile} does better." if f.fragile else ""
    doubted = [e for e in explanations if e.survives and e.dials]
    if doubted:
        other += (
            f" {' or '.join(e.name for e in doubted)} explains as much only with errors of {doubted[0].dials}, which "
            "the captures do not state."
        )
    if f.untried:
        other += f" By its score {f.untried[0]} may explain more, and was not calibrated."
    if f.weighed and f.share < MOST:
        other += f" The best explains {share_text(f.share)} of the excess misfit; the rest has another cause."
    if f.detail_of:
        other += (
            f" Each of these explanations has {f.winner}. It may be a detail of what is not decided: {f.detail_of} "
            "explains nearly all without it."
        )
    if f.shared:
        return (
            "the data do not decide between noise that neighbours in the session share, such as a lamp whose power "
            f"wanders, and {'this explanation' if count == 1 else f'{count} explanations'} (fall of chi2): "
            f"{names}.{other}"
        )
    if f.unset:
        return (
            f"the captures state no error of {f.unset}. Such errors act on each frame, as one strength per frame "
            f"does. The data do not decide between these errors and: {names}.{other}"
        )
    if f.fixed_lead <= f.fixed_needed:
        return (
            f"the data do not decide between another value of {f.fixed}, which the calibration keeps "
            f"({f.fixed_fall:.4g}), and {'this explanation' if count == 1 else f'{count} explanations'} (fall of "
            f"chi2): {names}.{other}"
        )
    if f.law_lead <= SURE:
        return (
            f"the data do not decide between a freer law of {f.law}, which is in the model, and "
            f"{'this explanation' if count == 1 else f'{count} explanations'} (fall of chi2): {names}.{other}"
        )
    if count > 1:
        rest = "" if f.fragile or f.untried else " All others are ruled out."
        return f"the data do not decide between {count} explanations (fall of chi2): {names}.{rest}{other}"
    if len(kinds[0]) > 1:
        return f"one law explains the residual, under {len(kinds[0])} names (fall of chi2): {names}.{other}"
    return f"the best explanation (fall of chi2) is {names}, but it is not clearly ahead.{other}"


def _kind(kind: Sequence[Explanation]) -> str:
    """Explanations that predict the same values, with their fall."""
    if len(kind) == 1:
        return f"{kind[0].name} ({kind[0].fall:.4g})"
    names = ", ".join(e.name for e in kind[:-1]) + f" or {kind[-1].name}"
    return (
        f"{names} ({kind[0].fall:.4g}; the same values under {len(kind)} names, which only other settings can separate)"
    )


def _partial(f: Findings, winner: Row, failing: Sequence[Condition]) -> str:
    uneven = next((c for c in failing if c.name == HOMOGENEITY), None)
    if uneven is None:
        rest = share_text(1 - f.share)
        return f"{winner.name} explains {share_text(f.share)} of the excess misfit, {rest} has another cause."
    part = f"{share_text(f.share)} of the excess" if f.weighed else "part of the residual"
    return (
        f"{winner.name} would explain {part}, but not with one strength ({uneven.text}): another "
        "cause produces it, or acts as well."
    )


def _unknown(f: Findings, curve: Fingerprint, basis: Basis) -> str:
    best = f"{f.ratio:.3g} times as much as the best effect" if f.winner else "what no effect does"
    if f.winner and f.beside:
        best += ", both counted beside noise that neighbours share"
    i = int(np.argmax(np.abs(curve.curve)))
    size = percent(curve.curve[i]) if curve.kind == "gain" else f"{curve.curve[i]:.2g} DN"
    where = curve.labels[i] if curve.labels else f"{curve.coordinate} {curve.centres[i]:.3g}{spaced(curve.unit)}"
    text = (
        f"structure is left that depends on '{curve.coordinate}': a curve along it explains {best}. "
        f"As {'a gain' if curve.kind == 'gain' else 'an offset'}, it is largest at {where}: {size}. "
        "No effect of the library has this shape with one strength."
    )
    if (beyond := math.sqrt(max(basis.misfit**2 - basis.noise**2, 0.0))) < CLUTTERED:
        text += (
            f" It is faint: misfit beyond noise is {percent(beyond)} of the signal. Mottle of a coating or a fixed "
            "pattern of the sensor has about this size."
        )
    return text


# -- the report ------------------------------------------------------------------------------------------------------
def report(d: Diagnosis) -> str:
    """Everything that a diagnosis says, for a terminal; blocks without content are left out."""
    lines = [
        *_data_lines(d),
        f"{d.word.replace('_', ' ')}: {d.sentence}",
        "",
        *_effect_lines(d),
        "",
        "decided by: " + "; ".join(f"{c.name} {'yes' if c.holds else 'no'} ({c.text})" for c in d.conditions),
        *_explanation_lines(d),
        *_split_lines(d),
        *_level_lines(d),
        *_curve_lines(d),
        *_law_lines(d),
        *_shift_lines(d),
        *advice_lines(d.advice),
        *(f"next: {hint}" for hint in d.hints),
        *(f"warning: {w}" for w in d.warnings),
    ]
    return "\n".join(lines) + "\n"


def _data_lines(d: Diagnosis) -> list[str]:
    b = d.basis
    values = f"{b.values:,}".replace(",", " ")
    thinned = f"; 1 in {b.thinning} pixels for curves and splits" if b.thinning > 1 else ""
    return [
        f"diagnose: {b.frames} frames, {values} values used ({percent(b.masked)} masked{thinned}), noise "
        f"{percent(b.noise)}, misfit {percent(b.misfit)}, excess {b.excess_sd:.3g} sd"
    ]


def _effect_lines(d: Diagnosis) -> list[str]:
    """The table of effects that are significant or were refitted, the upper limits of all others, and the untested."""
    lines = []
    shown = [r for r in d.rows if r.p_family < LEVEL or r.refit is not None]
    if shown:
        head = (
            "effect",
            "T",
            "p_fam",
            "strength (1 sd)",
            "of plausible",
            "image",
            "misfit->",
            "explains",
            "visible",
            "refit T",
            "confused with",
            "verdict",
        )
        lines.append(table([head, *(_cells(r, d) for r in shown)], left=(0, 3, 10, 11)))
    rest = [r for r in d.rows if r.p_family >= LEVEL]
    if rest:
        lines.append("no evidence; upper limits: " + ", ".join(limit_text(r) for r in rest))
    if d.not_tested:
        lines.append("not tested: " + ", ".join(f"{name} ({why})" for name, why in d.not_tested.items()))
    return lines


def ranking(rows: Sequence[Row], most: int = 8) -> str:
    """The best effects by score, while their refits are still to come."""
    shown = [r for r in rows if r.net > 0][:most]
    if not shown:
        return "by score, before refits: no effect explains more than chance does"
    lines = [f"  {r.name:<32} chi2 falls by {r.net:.3g}" for r in shown]
    return "\n".join(["by score, before refits (ranking.csv in the step's folder has all):", *lines])


def _cells(r: Row, d: Diagnosis) -> tuple[str, ...]:
    now, sd = (r.refit.strength, r.refit.sd) if r.refit else ([a + c for a, c in zip(r.start, r.change)], r.sd)
    reaches = [r.reach(i) for i in range(len(now))]
    known = any(reach.holds(v, s) for reach, v, s in zip(reaches, now, sd))  # else its size says nothing either
    note = ", ".join([x for x in (r.verdict, *r.flags) if x])
    if r.verdict == "claimed":
        note += f" (homogeneous: yes, held out: {'yes' if d.levels[-1].fall > 0 else 'no'})"
    return (
        r.name,
        f"{r.fall:.4g}",
        p_text(r.p_family),
        r.refit.told.split(" (")[0] if r.refit and r.refit.told else strength_text(now, sd, r.units, reaches),
        f"{r.of_plausible:.2g}" if known else "-",
        percent(r.image) if known else "-",
        percent(r.misfit_after),
        share_text(r.share),
        percent(r.survival),
        f"{r.refit.fall:.4g}" if r.refit else "-",
        f"{r.confused_with} (.{min(int(100 * r.cos), 99):02d})" if r.confused_with else "-",
        note,
    )


def _explanation_lines(d: Diagnosis) -> list[str]:
    """The explanations that may be the truth, and the best of the others."""
    if len([e for e in d.explanations if e.effects]) < 2:
        return []
    alive = [e for e in d.explanations if e.possible]
    others = [e for e in d.explanations if e.effects and not e.possible]
    others.sort(key=lambda e: not e.refuted)
    head = ("explanation", "fall", "cost", "excess left", "behind", "needed", "blocks left out", "")
    lines = []
    for e in [*alive[:6], *others[:5]]:
        blocks = "-" if math.isnan(e.ahead) else f"{e.ahead:+.4g}"
        behind, needed = ("-", "-") if e in alive[:1] else (f"{e.lead:.3g}", f"{e.needed:.3g}")
        more = "contains a survivor, and is likelier" if e.larger else "contains a survivor"
        mark = "survives" if e.survives else more if e.larger or not e.lead > e.needed else ""
        mark = e.refuted or mark
        lines.append((e.name, f"{e.fall:.4g}", f"{e.cost:.3g}", f"{e.excess_sd:.2g} sd", behind, needed, blocks, mark))
    return [
        "",
        "explanations (behind the best in score, and what would rule one out):",
        table([head, *lines], left=(0, 7)),
    ]


def _split_lines(d: Diagnosis) -> list[str]:
    if not d.splits:
        return []
    lines = [
        "",
        "homogeneity (strength relative to the whole; h = (fall gained by splitting) / (fall); p by noise / by the "
        "scatter between parts)",
    ]
    for s in d.splits:
        parts = ", ".join(f"{label} {with_sd(x, sd)}" for label, x, sd in zip(s.labels[:8], s.strength, s.sd))
        lines.append(
            f"  {s.effect} by {s.by}: h {s.h:.3f}, p {p_text(s.p)} / {p_text(s.chance)}"
            f"{'' if s.holds else '  INHOMOGENEOUS'}: {parts}"
        )
    return lines


def _level_lines(d: Diagnosis) -> list[str]:
    if not d.levels:
        return []
    lines = [
        "",
        f"misfit                 fitted   held out   (noise {percent(d.basis.noise)}; only per-frame variables fitted "
        "on held-out frames)",
    ]
    for level in d.levels:
        fall = (
            ""
            if math.isnan(level.fall)
            else f"   chi2 falls by {level.fall:.4g}, {level.frames_better} of {level.frames} frames better"
        )
        lines.append(f"  {level.model:<20} {percent(level.fitted):>7}   {percent(level.held_out):>8}{fall}")
    if len(d.levels) > 1 and not math.isnan(d.levels[-1].fall):
        lines.append("  (a falling held-out misfit verifies prediction; it does not prove the identity of the cause)")
    return lines


def _curve_lines(d: Diagnosis) -> list[str]:
    if not d.fingerprints:
        return []
    lines = ["", "curves along coordinates (fall of chi2 less its number of bins; R = over the best effect)"]
    lines += [
        f"  {f.coordinate:<18} {f.net:10.4g}  R {f.ratio:8.3g}  p {p_text(f.p)}"
        + (f"  {f.family:<8}" if f.family else "")
        + (f"  {share_text(f.share)} of the excess" if math.isfinite(f.share) else "")
        for f in [f for f in d.fingerprints if not f.per_frame][:8]
    ]
    if d.families:
        best = ", ".join(f"{f.family} {f.coordinate} {f.of_best:.2f}" for f in d.families)
        lines.append(f"  best of each family: {best}")
    return lines


def _law_lines(d: Diagnosis) -> list[str]:
    if not d.laws or not d.laws[0].p < LEVEL:
        return []
    lines = ["", "freer laws of what was added (a strength that changes slowly along a coordinate)"]
    return lines + [
        f"  {law.effect} along {law.coordinate}: {law.dof} further numbers, fall {law.fall:.4g}, p {p_text(law.p)}"
        for law in d.laws[:3]
    ]


def _shift_lines(d: Diagnosis) -> list[str]:
    if not d.shifts or d.word not in NAMED:
        return []
    return [
        "",
        "calibrated parameters had moved to hide it:",
        *(f"  {s.variable:<24} {s.before:.5g} -> {s.after:.5g} {s.unit} ({times_sd(s.in_sd)})" for s in d.shifts[:6]),
    ]
