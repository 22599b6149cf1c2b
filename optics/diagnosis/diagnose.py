"""From residual to verdict: which missing effect would explain what a calibrated model leaves, if any.

`diagnose` goes through these steps, each in a file of its own:

    score         every effect against the calibrated model; the best are chosen        optics.diagnosis.score
    refit         each chosen effect is added and everything calibrated again            optics.diagnosis.refit
    search        sets of effects are refitted together                                  optics.diagnosis.search
    competition   which of these explanations survive, and what all survivors share      optics.diagnosis.competition
    fingerprints  the residual as curves along every coordinate                          optics.diagnosis.fingerprints
    homogeneity   whether an effect's strength is the same in every part of the data     optics.diagnosis.homogeneity
    held out      frames that were not fitted                                            optics.diagnosis.held_out
    decide        findings, and one of six words                                         optics.diagnosis.decide
    remarks       upper limits, warnings, hints                                          optics.diagnosis.remarks
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from optics.diagnosis import competition, explanations, homogeneity, patterns, remarks, search, shared_noise
from optics.diagnosis import fingerprints as prints
from optics.diagnosis import held_out as held
from optics.diagnosis import statistics as st
from optics.diagnosis.by_frame import in_some_frames
from optics.diagnosis.decide import Findings, decide
from optics.diagnosis.dials_as_rival import with_rivals
from optics.diagnosis.evidence import Candidate, Progress, silent
from optics.diagnosis.explanations import Outcome
from optics.diagnosis.findings import basis_of, findings_of, followed, subject_of
from optics.diagnosis.fixed_values import FixedValue, best_of_fixed
from optics.diagnosis.laws import other_laws
from optics.diagnosis.refit import COARSE, Case, Cooled, Expected, after_at, refit_each, swings
from optics.diagnosis.result import (
    NAMED,
    Basis,
    Diagnosis,
    Family,
    Fingerprint,
    Law,
    Level,
    Row,
    Shift,
    Split,
    kinds_of,
)
from optics.diagnosis.score import Scored, score
from optics.diagnosis.text import leaves_misfit, sentence
from optics.diagnosis.thresholds import AS_GOOD, CLEAR, EXCESS, LEVEL, MARGIN, MAX_SPLIT, SHARE, SWINGING, close
from optics.errors import Underdetermined
from optics.fit import calibrate
from optics.fit.model import Model
from optics.fit.result import Fit
from optics.scene.declare import Effect
from optics.scene.parameter import Variable

MAX_REFITS = 10  # besides the winners of other weights: each costs a calibration
DRIFT_HINT = (
    "give each frame a flat_field of its own, taken just before or after it; `optics import --background near` makes "
    "one from the presses next to each"
)
SURFACE_HINT = (
    "press the same body twice at one place, and once turned: what stays with the place is the coating's, what turns "
    "with the body is the body's, and the rest comes of the press"
)
FIXED_HINT = "divide the pattern out with a flat_field, mask what is dirt, or note the sensor's own as [noise] prnu"


@dataclass(frozen=True)
class Request:
    """What is diagnosed, and how.

    fit           of the base on the frames `fitted`, converged
    effects       candidates; those that are in the base already are passed over
    variables_of  the variables that an effect frees; one per frame for the scope 'frame'
    held_out      frames that were not fitted; only what each frame has for itself is fitted there
    refit         called as refit(model, variables, start, frames=[...])
    foresee       called before the refits, with the variables of each effect that is refitted
    cooler        called with the refits, the best first. Where that one asks that priors count less than in the
                  base, and that may change the verdict, it returns what the diagnosis begins again from; else None
    negligible    share of what images leave beyond noise below which a promised fall is not worth another linearisation
    rows_max      values (pixel x channel) that curves, splits and alternative weights may use
    seed          of the simulations and of derivative images; the same seed gives the same table
    top           how many of the best effects are refitted, besides those that cannot be told from the best
    ranked        called with the ranking by score, before anything is refitted: refits of images take minutes
    excluded      effect -> why it is not among `effects`, for the record
    added         effects that the model has already, whose laws may differ from the library's (optics.diagnosis.laws)
    asked         names of effects that are refitted, whatever their score
    expected      what an earlier diagnosis of the study found beside effects that were added since

    Raises ValueError when frames are fitted and held out at once.
    """

    model: Model
    fit: Fit
    effects: Sequence[Effect]
    variables_of: Callable[[Effect], Sequence[Variable]]
    held_out: Sequence[int] = ()
    fitted: Sequence[int] = ()
    refit: Callable[..., Fit] = calibrate.fit
    foresee: Callable[[Sequence[Sequence[Variable]], Progress], None] | None = None
    cooler: Callable[[Sequence[Fit]], Cooled | None] | None = None
    negligible: float = COARSE
    rows_max: int = 400_000
    seed: int = 0
    top: int = 5
    progress: Progress | None = None
    ranked: Callable[[list[Row]], None] | None = None
    excluded: Mapping[str, str] = field(default_factory=dict)
    added: Sequence[Effect] = ()
    asked: Collection[str] = ()
    expected: Sequence[Expected] = ()

    def __post_init__(self) -> None:
        both = sorted(set(self.fitted) & set(self.held_out))
        if both:
            raise ValueError(f"diagnose: frames {both} are fitted and held out at once; a frame is one or the other")


def diagnose(
    model: Model,
    fit: Fit,
    effects: Sequence[Effect],
    variables_of: Callable[[Effect], Sequence[Variable]],
    held_out: Sequence[int] = (),
    *,
    fitted: Sequence[int],
    **options: Any,
) -> Diagnosis:
    """Score, refit and judge: which effect a calibrated model lacks. All arguments are fields of `Request`.

    Raises Underdetermined when the base is not calibrated to convergence, or black level or saturation are unknown;
    ValueError when frames are fitted and held out at once, or none is fitted.
    """
    fitted, held_out = [int(i) for i in fitted], [int(i) for i in held_out]
    return _diagnosed(Request(model, fit, effects, variables_of, held_out, fitted, **options))


def _diagnosed(request: Request) -> Diagnosis:
    """The steps of the module, one after the other."""
    scored = score(
        request.model,
        request.fit,
        request.effects,
        request.variables_of,
        request.fitted,
        rows_max=request.rows_max,
        seed=request.seed,
        progress=request.progress,
    )
    if request.ranked:
        request.ranked([c.row for c in scored.table.order])
    case = _case_of(request, scored)
    chosen = _choose(case, request.top, request.asked)
    due = {name for e in case.expected if len(e.names) == 1 for name in e.names} - {c.effect.name for c in chosen}
    chosen += [c for c in case.table.order if c.effect.name in due]
    chosen, fits = _without_wild_lights(case, chosen, refit_each(case, chosen), scored.not_tested)
    if request.cooler is not None and (cooled := request.cooler(_best_first(case, fits))):
        cooler = replace(request, fit=cooled.base, refit=cooled.refit, foresee=cooled.foresee, cooler=None, asked=fits)
        try:
            again = _diagnosed(cooler)
        except Underdetermined:  # with priors that count less the base has no end
            pass
        else:
            again.warnings.append(cooled.remark)
            return again
    judged = _judge(request, case, chosen, fits)
    return _written(request, scored, case, chosen, fits, judged)


def _case_of(request: Request, scored: Scored) -> Case:
    """What refits and the competition work on."""
    evidence, table = scored.evidence, scored.table
    case = Case(
        request.model,
        request.fit,
        evidence,
        table,
        request.refit,
        list(request.fitted),
        list(request.held_out),
        request.variables_of,
        request.rows_max,
        request.seed,
        request.progress or silent,
        foresee=request.foresee,
        negligible=request.negligible,
    )
    known = {c.effect.name for c in table.order}
    near = [e for e in request.expected if e.names <= known]
    case.expected = [e for e in near if after_at(case, e.values) < case.before - CLEAR]
    if isinstance(evidence.spectrum, st.Sweeps) and evidence.thinning == 1:
        evidence.spectrum.apart = case.session.apart
    case.places = prints.places(request.model, request.fit.values, evidence)
    return case


@dataclass(frozen=True)
class Judged:
    """What a verdict is written from; the fields are those of `Diagnosis` and of `optics.diagnosis.findings`."""

    basis: Basis
    outcome: Outcome
    subject: Candidate | None
    levels: list[Level]
    fingerprints: list[Fingerprint]
    families: list[Family]
    laws: list[Law]
    splits: list[Split]
    shifts: list[Shift]
    findings: Findings
    fixed: FixedValue | None


def _judge(request: Request, case: Case, chosen: list[Candidate], fits: dict[str, Fit]) -> Judged:
    """Competition, curves, laws and splits; effects that the competition had refitted are appended to `chosen`."""
    model, evidence, places = case.model, case.evidence, case.places or []
    basis = basis_of(model, evidence, evidence.structure(evidence.whitened, evidence.base))
    outcome, levels = held.judge(case, search.search(case, chosen, fits))
    outcome = with_rivals(case, outcome)
    chosen += [c for c in case.table.order if c.effect.name in fits and c not in chosen]
    subject, best = subject_of(case, outcome), outcome.best

    reference = best.fall - best.expectation if subject else max([c.row.net for c in case.table.order], default=0.0)
    fingerprints = prints.fingerprints(model, evidence, places, max(reference, 1.0), case.say)
    families = prints.families(fingerprints)
    curve = followed(case, subject, best.fit, best.fall - best.expectation, fingerprints)
    if curve:
        outcome, levels = _without_followers(case, outcome, levels, curve.coordinate)
        subject, best = subject_of(case, outcome), outcome.best
    beside = case.session if evidence.is_table else None if best.by_frame else case.lamp
    laws = other_laws(model, evidence, places, request.added, request.variables_of, outcome.scale, beside)
    splits, chance = _split(case, outcome, subject, basis)
    shifts = held.shifts(case, best.members, best.fit) if subject else []
    findings = findings_of(case, outcome, fingerprints, laws, splits, chance, levels, basis)
    fixed = best_of_fixed(case, outcome, _excess(basis)) if decide(findings)[0] != "NOTHING" else None
    if fixed and not (findings.rival and fixed.fall < AS_GOOD * fingerprints[0].net):
        findings = replace(
            findings,
            fixed=fixed.text(),
            fixed_fall=fixed.fall,
            fixed_lead=fixed.lead,
            fixed_needed=fixed.needed,
            fixed_wins=fixed.wins,
        )
    return Judged(basis, outcome, subject, levels, fingerprints, families, laws, splits, shifts, findings, fixed)


def _written(
    request: Request,
    scored: Scored,
    case: Case,
    chosen: Sequence[Candidate],
    fits: dict[str, Fit],
    judged: Judged,
) -> Diagnosis:
    """The word, its conditions, and everything that is said with it."""
    model, evidence, table = case.model, case.evidence, case.table
    outcome, subject, findings, basis = judged.outcome, judged.subject, judged.findings, judged.basis
    best = outcome.best
    word, conditions = decide(findings)
    records = outcome.records()

    remarks.write_limits(case, best if word == "CLAIM" else None, basis)
    remarks.write_verdicts(table, word, subject, outcome, judged.splits)
    rows, names = [c.row for c in table.order], [c.effect.name for c in chosen]
    gaps, correct = _gaps(case, outcome, chosen)
    ambiguous = list(dict.fromkeys(name for e in records if e.possible for name in e.effects))
    kinds = [[e.name for e in kind] for kind in kinds_of(records)]
    if findings.fragile and findings.fragile not in ambiguous:  # by other weights or masks it is the best
        ambiguous.append(findings.fragile)
        kinds.append([findings.fragile])
    hints = remarks.hints_of(word, conditions, outcome, findings, gaps, names)
    if judged.fixed and findings.fixed_lead <= findings.fixed_needed:
        hints = [judged.fixed.advice(), *hints]
    if subject and word in NAMED:
        hints = [*remarks.replaced(case, best, request.added), *hints]
    text = sentence(word, conditions, findings, rows, records, judged.fingerprints, judged.levels, judged.shifts, basis)
    lamp = remarks.lamp_text(case, outcome, basis)
    partly = None
    if word in ("UNKNOWN", "CANNOT_TELL", "PARTIAL"):
        least = max([f.net for f in judged.fingerprints], default=0.0)
        least = max(least, best.fall - best.expectation, findings.fixed_fall)
        partly = in_some_frames(model, evidence, table.order, least, _excess(basis))
    if word in ("UNKNOWN", "CANNOT_TELL"):
        text, first = _unexplained(case, word, text, lamp, judged, bool(partly))
        hints = [*first, *hints]
    else:
        text = " ".join(filter(None, [text, lamp]))
    if partly:
        text, hints = f"{partly.text()} {text[0].upper()}{text[1:]}", [partly.advice(), *hints]
    # of one press, what is fixed in the image and what is the surface's own look the same
    if leaves_misfit(best.excess_sd, basis) and not (
        FIXED_HINT in hints and len(patterns.presses_of(model, evidence)) < 2
    ):
        surface = patterns.surface_text(patterns.by_surface(model, best.fit.values, evidence, best.images))
        text, hints = " ".join(filter(None, [text, surface])), [*hints, *[SURFACE_HINT] * bool(surface)]
    return Diagnosis(
        word=word,
        sentence=text,
        conditions=conditions,
        basis=basis,
        rows=rows,
        ambiguous=ambiguous if word == "AMBIGUOUS" else [],
        compared=names,
        gaps=gaps,
        correct=correct,
        splits=judged.splits,
        levels=judged.levels,
        fingerprints=judged.fingerprints,
        shifts=judged.shifts,
        hints=hints,
        not_tested={**scored.not_tested, **request.excluded},
        warnings=[
            *filter(None, [scored.unsettled]),
            *remarks.warnings_of(case, word, subject, outcome, judged.shifts, scored.dropped, basis),
        ],
        kinds=kinds if word == "AMBIGUOUS" else [],
        claimed=subject.effect.name if subject and word == "CLAIM" else "",
        explanations=records,
        families=judged.families,
        laws=judged.laws,
        fits=fits,
        evidence=replace(evidence, blocks=[], sigma=[], whitened=[], use=[], candidates=table.order),
    )


def _without_wild_lights(
    case: Case, chosen: list[Candidate], fits: dict[str, Fit], not_tested: dict[str, str]
) -> tuple[list[Candidate], dict[str, Fit]]:
    """Leave out effects by which a light would change from frame to frame by more than lights do (SWINGING): gains of
    every light in every frame follow whatever is wrong with how these light the skin, in any company."""
    wild = {
        c.effect.name: times
        for c in chosen
        if c.effect.name in fits and (times := swings(fits[c.effect.name], c)) > SWINGING
    }
    for name, times in wild.items():
        not_tested[name] = f"a light would change by {times:.2g} times what is plausible; {SWINGING:g} allowed"
    case.table.leave_out(wild)
    kept = {name: found for name, found in fits.items() if name not in wild}
    return [c for c in chosen if c.effect.name not in wild], kept


def _without_followers(
    case: Case, outcome: Outcome, levels: list[Level], coordinate: str
) -> tuple[Outcome, list[Level]]:
    """The competition where strengths of each frame follow a setting: what happens to frames by themselves, as the
    drift of a lamp does, follows nothing that is set. Where nothing else explains the residual they stay."""
    if not any(t.members and not t.by_frame for t in outcome.survivors):
        return outcome, levels
    gone = [t for t in outcome.trials if t.by_frame]
    return held.judge(case, competition.beside_refuted(case, outcome, gone, f"its strengths follow {coordinate}"))


def _best_first(case: Case, fits: Mapping[str, Fit]) -> list[Fit]:
    """The refits, that of the largest fall first."""
    falls = {c.effect.name: c.row.refit.fall for c in case.table.order if c.row.refit is not None}
    return [fits[name] for name in sorted(fits, key=lambda name: -falls[name])]


def _choose(case: Case, top: int, asked: Collection[str] = ()) -> list[Candidate]:
    """The effects to refit: those that cannot be told from the best by score; of a table all that stand out besides, as
    its refits are cheap; of images the best of them, winners of other weights, and those whose image bends: what
    crossed films show of a misalignment goes with its square, and its score says little of what a refit reaches.

    Where noise explains every effect, none is refitted."""
    seen = [c for c in case.table.order if c.row.net > 0]
    live = [c for c in seen if c.row.p_family < LEVEL]
    if not live:
        return []
    near = [c for c in seen if close(live[0].row.net, c.row.net)]
    if case.evidence.is_table:
        return [c for c in seen if c in live or c in near]
    chosen = live[:top] + [c for c in near if c not in live[:top]]
    chosen = chosen[:MAX_REFITS]
    others = {*case.table.preferred.values(), *asked} - {c.effect.name for c in chosen}
    near_enough = [c for c in live if c.row.net > MARGIN * live[0].row.net]
    bent = {c.effect.name for c in near_enough if c.effect.onset != "tangent"}
    return chosen + [c for c in live if c.effect.name in others | bent and c not in chosen]


def _split(case: Case, outcome: Outcome, subject: Candidate | None, basis: Basis) -> tuple[list[Split], float]:
    """(splits of the main effect of each survivor, p of the subject's strength by its scatter).

    What scatters is written into the refit of an effect that explains the residual by itself."""
    splits: list[Split] = []
    chance = math.nan
    done: set[str] = set()
    left = {frozenset(e.effects): e for e in outcome.records()}
    for trial in outcome.survivors:
        if not trial.members or len(done) >= MAX_SPLIT:
            continue
        main = (
            subject
            if subject in trial.members
            else max(trial.members, key=lambda c: outcome.own_fall(trial, c.effect.name))
        )
        if main is None or main.effect.name in done:
            continue
        done.add(main.effect.name)
        net = outcome.own_fall(trial, main.effect.name) - main.cone.expectation
        if not case.evidence.is_table and trial.fall < SHARE * _excess(basis):
            continue  # too little for a claim, and a split takes as long as a score
        beside = [v for c in trial.members if c is not main for v in c.variables]
        own, p, clutter, noise = homogeneity.split(
            case.model,
            case.evidence,
            case.places or [],
            case.rows_max,
            case.seed,
            case.say,
            main,
            trial.fit,
            left[trial.names],
            net,
            beside,
            shared_noise.noise_of(case, outcome, trial),
            competition.fall_beside(outcome, trial, main.effect.name) - main.cone.expectation,
            candidates=case.table.order,
        )
        splits += own
        if not case.evidence.is_table:  # refits of readings are linearised where they end
            trial.fit = homogeneity.with_errors(trial.fit, main.variables, noise)
        # of readings, noise that neighbours share and errors of dials have been rivals, by their likelihood
        p = math.nan if case.evidence.is_table else case.table.family.bounded(p)
        chance = p if main is subject else chance
        if len(trial.members) == 1 and main.row.refit is not None:
            sd = dict(zip((v.name for v in trial.fit.variables), trial.fit.sd))
            main.row.refit = replace(main.row.refit, sd=[float(sd[v.name]) for v in main.variables])
            main.row.refit = homogeneity.scattered(main.row.refitted, p, clutter)
    return splits, chance


def _excess(basis: Basis) -> float:
    """The misfit of the base beyond noise, where it is more than noise may make; else 0."""
    return basis.chi2 - basis.dof if basis.excess_sd > EXCESS else 0.0


def _gaps(case: Case, outcome: Outcome, chosen: Sequence[Candidate]) -> tuple[list[list[float]], list[list[float]]]:
    """(D[a][b], P(correct)): expected chi2 of a over b when a is true as found, probability of deciding rightly.

    By derivative images, D is what b leaves of a's; but where strengths are large, b may come nearer than its tangent
    says. Where both were refitted, b leaves no more than the difference of the two predictions, and of what is
    known."""
    evidence = case.evidence
    first, information = len(evidence.base), evidence.projected.information
    fits = {c.effect.name: t for t in outcome.trials if len(t.members) == 1 for c in t.members}

    def expected(a: Candidate, b: Candidate) -> float:
        if a is b:
            return 0.0
        own, other = np.array(a.columns) - first, np.array(b.columns) - first
        found = st.gap(information, own, a.direction, other, b.cone)
        if a.effect.name in fits and b.effect.name in fits:
            found = min(found, max(explanations.apart(case, fits[a.effect.name], fits[b.effect.name]), 0.0))
        return found

    gaps = [[expected(a, b) for b in chosen] for a in chosen]
    return gaps, [[st.probability_correct(d) for d in line] for line in gaps]


def _unexplained(
    case: Case,
    word: str,
    text: str,
    lamp: str,
    judged: Judged,
    partly: bool,
) -> tuple[str, list[str]]:
    """(sentence, what to do about patterns of the image) where no effect explains the residual.

    lamp     what a lamp did to whole frames, in words: not said where one light of several is found to have done it
    partly   whether an effect in some frames does"""
    findings, fingerprints = judged.findings, judged.fingerprints
    excess, best = _excess(judged.basis), max([f.share for f in fingerprints], default=0.0)
    pattern = partial(patterns.fixed_pattern, case.model, case.evidence, excess)
    fixed = patterns.fixed_text(pattern(), best, pattern(True), pattern(True, True))
    drift = patterns.drifting_pattern(case.model, case.fit.values, case.evidence, excess, case.seed)
    drifting = patterns.drifting_text(drift)
    light, share, swing = patterns.swinging_light(case.model, case.evidence, excess)
    texts = (fixed, drifting, patterns.swinging_text(light, share, swing))
    found = [part[0].upper() + part[1:] for part in texts if part]
    parts = [*found, text[0].upper() + text[1:] if found else text, "" if light else lamp]
    if word == "UNKNOWN" or findings.fall < SHARE * excess:
        parts.append(prints.unexplained(fingerprints, findings.fall, excess, bool(found) or partly))
    if word == "UNKNOWN" and not fixed and not (drifting and drift.share > best):
        parts.append(prints.goes_with(judged.families))
    hints = [DRIFT_HINT] * bool(drifting) + [FIXED_HINT] * ("same in every frame" in fixed)
    if light:
        hints.append(
            f'state how steady it is ([uncertainty] "{light}.power" in captures.toml, {swing:.1g} times the power that '
            "frames set), calibrate again, and diagnose what is left"
        )
    return " ".join(filter(None, parts)), hints
