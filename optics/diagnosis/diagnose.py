"""From residual to verdict: which missing effect would explain what a calibrated model leaves, if any.

`diagnose` goes through these steps, each in a file of its own:

    score         every effect against the calibrated model; the best are chosen        optics.diagnosis.score
    refit         each chosen effect is added and everything calibrated again            optics.diagnosis.refit
    fingerprints  the residual as curves along every coordinate                          optics.diagnosis.fingerprints
    homogeneity   whether an effect's strength is the same in every part of the data     optics.diagnosis.homogeneity
    held out      frames that were not fitted                                            optics.diagnosis.held_out
    decide        findings, and one of six words                                         optics.diagnosis.decide
    pairs         two effects at once, where no single one leaves nothing                optics.diagnosis.pairs
    remarks       upper limits, warnings, hints                                          optics.diagnosis.remarks
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from optics.diagnosis import fingerprints as prints
from optics.diagnosis import held_out as held
from optics.diagnosis import homogeneity, pairs, remarks
from optics.diagnosis import statistics as st
from optics.diagnosis.decide import Findings, decide
from optics.diagnosis.evidence import Candidate, Evidence, Progress, silent
from optics.diagnosis.findings import basis_of, findings_of, refuted, simplest
from optics.diagnosis.refit import Case, add_both, refit_each
from optics.diagnosis.result import Basis, Diagnosis, Family, Fingerprint, Pair, Split
from optics.diagnosis.score import Table, score
from optics.diagnosis.text import sentence
from optics.diagnosis.thresholds import CLEAR, EXCESS, LEVEL, MAX_SPLIT, close
from optics.fit import calibrate
from optics.fit.model import Model
from optics.fit.result import Fit
from optics.scene.declare import Effect
from optics.scene.parameter import Variable

MAX_REFITS = 10  # besides the winners of other weights: each costs a calibration
FIXED_HINT = "divide the pattern out with a flat_field, mask what is dirt, or note the sensor's own as [noise] prnu"


def diagnose(
    model: Model,
    fit: Fit,
    effects: Sequence[Effect],
    variables_of: Callable[[Effect], Sequence[Variable]],
    held_out: Sequence[int] = (),
    *,
    fitted: Sequence[int],
    refit: Callable[..., Fit] | None = None,
    rows_max: int = 400_000,
    seed: int = 0,
    top: int = 5,
    progress: Progress | None = None,
) -> Diagnosis:
    """Score, refit and judge: which effect a calibrated model lacks.

    fit           of the base on the frames `fitted`, converged
    effects       candidates; those that are in the base already are passed over
    variables_of  the variables that an effect frees; one per frame for the scope 'frame'
    held_out      frames that were not fitted; only what each frame has for itself is fitted there
    refit         `optics.fit.calibrate.fit` unless given; called as refit(model, variables, start, frames=[...])
    rows_max      values (pixel x channel) that curves, splits and alternative weights may use
    seed          of the simulations and of derivative images; the same seed gives the same table
    top           how many of the best effects are refitted, besides those that cannot be told from the best

    Raises Underdetermined when the base is not calibrated to convergence, or black level or saturation are unknown;
    ValueError when frames are fitted and held out at once, or none is fitted.
    """
    say = progress or silent
    fitted, held_out = [int(i) for i in fitted], [int(i) for i in held_out]
    both = sorted(set(fitted) & set(held_out))
    if both:
        raise ValueError(f"diagnose: frames {both} are fitted and held out at once; a frame is one or the other")
    scored = score(model, fit, effects, variables_of, fitted, rows_max=rows_max, seed=seed, progress=progress)
    evidence, table = scored.evidence, scored.table
    case = Case(
        model,
        fit,
        evidence,
        table,
        refit or calibrate.fit,
        fitted,
        held_out,
        variables_of,
        rows_max,
        seed,
        say,
    )
    basis = basis_of(model, evidence, evidence.structure(evidence.whitened, evidence.base))
    chosen = _choose(table, top)
    fits = refit_each(case, chosen)
    winner, done, members = _contenders(chosen, basis)

    places = prints.places(model, fit.values, evidence)
    reference = winner.row.net_refit if winner else max([c.row.net for c in table.order], default=0.0)
    fingerprints = prints.fingerprints(model, evidence, places, max(reference, 1.0), say)
    families = prints.families(fingerprints)
    split = partial(homogeneity.split, model, evidence, places, rows_max, seed, say)
    splits = _split_members(case, members, fits, split)
    levels = held.levels(case, winner, fits)
    shifts = held.shifts(case, winner, fits) if winner else []

    findings = findings_of(case, winner, done, members, fits, fingerprints, splits, levels, basis)
    word, conditions = decide(findings)
    tried = _pairs(case, word, winner, done, fingerprints, split)
    word = "PARTIAL" if any(p.complete for p in tried) else word

    remarks.write_limits(case, winner if word == "CLAIM" else None, fits, basis)
    remarks.write_verdicts(table, word, winner, members, splits)
    rows, names = [c.row for c in table.order], [c.effect.name for c in chosen]
    gaps, correct = _gaps(evidence, chosen)
    hints = remarks.hints_of(word, conditions, members, gaps, names)
    text = sentence(word, conditions, findings, rows, [c.row for c in members], fingerprints, levels, shifts, basis)
    if any(p.complete for p in tried):
        text = pairs.words(tried, {row.name: row.share for row in rows})
    elif word in ("PARTIAL", "UNKNOWN"):
        text += pairs.doubt(tried)
    if word in ("UNKNOWN", "CANNOT_TELL"):
        text, fixed = _unexplained(case, word, text, fingerprints, families, findings, basis)
        hints = [FIXED_HINT, *hints] if fixed else hints
    return Diagnosis(
        word=word,
        sentence=text,
        conditions=conditions,
        basis=basis,
        rows=rows,
        ambiguous=[c.effect.name for c in members] if word == "AMBIGUOUS" else [],
        compared=names,
        gaps=gaps,
        correct=correct,
        splits=splits,
        levels=levels,
        fingerprints=fingerprints,
        shifts=shifts,
        hints=hints,
        not_tested=scored.not_tested,
        warnings=remarks.warnings_of(case, word, winner, shifts, scored.dropped, basis),
        claimed=winner.effect.name if winner and word == "CLAIM" else "",
        pairs=tried,
        families=families,
        fits=fits,
        evidence=replace(evidence, blocks=[], sigma=[], whitened=[], use=[], candidates=table.order),
    )


def _choose(table: Table, top: int) -> list[Candidate]:
    """The effects to refit: the best ones, those that cannot be told from the best, winners of other weights.

    An effect that noise explains is not refitted: a refit costs a calibration.
    """
    live = [c for c in table.order if c.row.net > 0 and c.row.p_family < LEVEL]
    chosen = live[:top] + [c for c in live[top:] if close(live[0].row.net, c.row.net)]
    chosen = chosen[:MAX_REFITS]
    others = {table.winner_uniform, table.winner_dilated} - {c.effect.name for c in chosen}
    return chosen + [c for c in live if c.effect.name in others]


def _contenders(chosen: Sequence[Candidate], basis: Basis) -> tuple[Candidate | None, list[Candidate], list[Candidate]]:
    """(winner, refitted effects, members of the ambiguous set), the winner first in both lists.

    An effect that contains another and does no better is left out: it is the other one with strengths to spare."""
    done = sorted((c for c in chosen if c.row.refit is not None), key=lambda c: -c.row.net_refit)
    winner = simplest(done) if done and done[0].row.net_refit > 0 else None
    done = [c for c in done if not any(c.contains(d) and c.row.net_refit - d.row.net_refit < CLEAR for d in done)]
    if winner is None:
        return None, done, []
    done.sort(key=lambda c: c is not winner)
    members = [
        c
        for c in done
        if c.row.net_refit > 0 and close(winner.row.net_refit, c.row.net_refit) and not refuted(winner, c, basis.dof)
    ]
    return winner, done, members


def _split_members(
    case: Case,
    members: Sequence[Candidate],
    fits: Mapping[str, Fit],
    split: Callable[..., tuple[list[Split], float, np.ndarray]],
) -> list[Split]:
    """Test the members' homogeneity, and write into their refits what the scatter of their strengths says."""
    splits = []
    for c in members[:MAX_SPLIT]:
        own, p, clutter = split(c, fits[c.effect.name], c.row.refitted, c.row.net_refit)
        splits += own
        c.row.refit = homogeneity.scattered(c.row.refitted, case.table.family.p(p), clutter)
    return splits


def _pairs(
    case: Case,
    word: str,
    winner: Candidate | None,
    done: Sequence[Candidate],
    fingerprints: Sequence[Fingerprint],
    split: Callable[..., tuple[list[Split], float, np.ndarray]],
) -> list[Pair]:
    """Pairs of effects, tried where no single effect is claimed or leaves nothing to explain."""
    if winner is None or word in ("NOTHING", "CLAIM") or any(c.row.refitted.complete for c in done):
        return []
    order = case.table.order
    found = pairs.search(case.evidence, order, winner.row.net_refit, lambda both: add_both(case, both, split))
    return pairs.beside_curves(found, fingerprints, {c.row.name: c.row.expected for c in order})


def _gaps(evidence: Evidence, chosen: Sequence[Candidate]) -> tuple[list[list[float]], list[list[float]]]:
    """(D[a][b], P(correct)): expected chi2 of a over b when a is true as found, probability of deciding rightly."""
    first, information = len(evidence.base), evidence.projected.information
    gaps = [
        [
            0.0
            if a is b
            else st.gap(information, np.array(a.columns) - first, a.direction, np.array(b.columns) - first, b.cone)
            for b in chosen
        ]
        for a in chosen
    ]
    return gaps, [[st.probability_correct(d) for d in line] for line in gaps]


def _unexplained(
    case: Case,
    word: str,
    text: str,
    fingerprints: Sequence[Fingerprint],
    families: Sequence[Family],
    findings: Findings,
    basis: Basis,
) -> tuple[str, bool]:
    """(sentence, whether a fixed pattern lies in the images) where no effect explains the residual."""
    excess = basis.chi2 - basis.dof if basis.excess_sd > EXCESS else 0.0
    share = prints.fixed_pattern(case.model, case.evidence, excess)
    fixed = prints.fixed_text(share, max([f.share for f in fingerprints], default=0.0))
    parts = [fixed, text[0].upper() + text[1:] if fixed else text]
    if word == "UNKNOWN":
        parts += [prints.unexplained(fingerprints, findings.fall, excess), "" if fixed else prints.goes_with(families)]
    return " ".join(filter(None, parts)), bool(fixed)
