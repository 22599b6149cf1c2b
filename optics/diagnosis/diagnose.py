"""From residual to verdict: which missing effect would explain what a calibrated model leaves over, if any does.

`diagnose` scores every effect against the calibrated model, adds the best ones by a refit, tests the winner for
homogeneity, on frames that were not fitted and against curves along every coordinate, and answers with one of six words
(`optics.diagnosis.verdict`). Masks and sums are in `optics.diagnosis.evidence`, the algebra is in
`optics.diagnosis.statistics`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from optics.diagnosis import fingerprints as prints
from optics.diagnosis import homogeneity as evenness
from optics.diagnosis import pairs
from optics.diagnosis import statistics as st
from optics.diagnosis.evidence import Candidate, Evidence, Progress, at_bound, measure
from optics.diagnosis.verdict import (
    AS_GOOD,
    AT_FAULT,
    CLEAR,
    CURVE,
    EXCESS,
    HIDDEN,
    LEVEL,
    NAMED,
    UNEVEN,
    Basis,
    Diagnosis,
    Findings,
    Fingerprint,
    Level,
    Pair,
    Refit,
    Row,
    Shift,
    Split,
    close,
    decide,
    moved_by,
    rivals,
    sentence,
)
from optics.errors import Underdetermined
from optics.fit.calibrate import for_frames
from optics.fit.model import Model, value_of
from optics.scene.declare import Effect
from optics.scene.parameter import Values, Variable
from optics.words import some

START = 0.7  # of the expected change, to begin a refit from: the linear estimate overshoots more often than not
SETTLED = 0.01  # of the excess of chi2: what a calibrated base may still absorb
KAPPA = 0.1  # noise per pixel of derivative images over their signal, above which strengths are biased
IMPLAUSIBLE = 10.0  # times the plausible strength: worth a look
MAX_REFITS = 10
MAX_SPLIT = 4  # members of an ambiguous set that are tested for homogeneity
# of misfit that hides: what lies where two effects differ: on the polarizer bench .006 on average and .07 at most, on
# gelsight .002
ALONG = 0.05
LOOKS = 3  # at an effect's image, to find the strength at which it was taken
# where no shot was simulated
USUALLY = "the same press at 0.4 of the exposure, and one deeper press, often tell more than repeats"


# -- the verb ---------------------------------------------------------------------------------------------------------


def diagnose(
    model,
    fit,
    effects: Sequence[Effect],
    variables_of: Callable[[Effect], Sequence[Variable]],
    held_out: Sequence[int] = (),
    *,
    fitted: Sequence[int],
    refit: Callable | None = None,
    rows_max: int = 400_000,
    seed: int = 0,
    top: int = 5,
    progress: Progress | None = None,
) -> Diagnosis:
    """Score, refit and judge: what a calibrated model lacks.

    model         optics.fit.model.Model, or anything with its predict, derivatives, usable, coordinates, frames, noise,
                  base
    fit           optics.fit.calibrate.Fit of the base on the frames `fitted`, converged
    effects       candidates; those that the base has already are passed over
    variables_of  the variables that an effect frees; one per frame for the scope 'frame'
    held_out      frames that were not fitted; only what is solved for per frame is fitted there
    refit         optics.fit.calibrate.fit, or a function with its arguments
    rows_max      values (pixel x channel) that curves, splits and alternative weights may use
    seed          of the simulations and of derivative images; the same seed gives the same table
    top           how many of the best effects are added and refitted, besides those that cannot be told from the best

    Raises Underdetermined when the base is not calibrated to convergence, or black level or saturation are not known.
    """
    if refit is None:
        from optics.fit.calibrate import fit as refit
    say = progress or (lambda what, done, total: None)
    fitted, held_out = [int(i) for i in fitted], [int(i) for i in held_out]
    both = sorted(set(fitted) & set(held_out))
    if both:
        raise ValueError(f"diagnose: frames {both} are fitted and held out at once; a frame is one or the other")
    scored = score(model, fit, effects, variables_of, fitted, rows_max=rows_max, seed=seed, progress=progress)
    evidence, table, dropped, not_tested = scored.evidence, scored.table, scored.dropped, scored.not_tested
    structure = evidence.structure(evidence.whitened, evidence.base)
    basis = _basis(model, evidence, structure)
    chosen = _choose(table, top)
    fits = _refit(model, fit, evidence, table, chosen, refit, fitted, say)

    rows = [c.row for c in table.order]
    done = sorted((c for c in chosen if c.row.refit is not None), key=lambda c: -c.row.net_refit)
    winner = _simplest(done) if done and done[0].row.net_refit > 0 else None
    done = [c for c in done if not any(c.contains(d) and c.row.net_refit - d.row.net_refit < CLEAR for d in done)]
    places = prints.places(model, fit.values, evidence)
    reference = winner.row.net_refit if winner else max([c.row.net for c in table.order], default=0.0)
    fingerprints = prints.fingerprints(model, evidence, places, max(reference, 1.0), say)
    families = prints.families(fingerprints)

    if winner:
        done.sort(key=lambda c: c is not winner)
    members = (
        [
            c
            for c in done
            if c.row.net_refit > 0
            and close(winner.row.net_refit, c.row.net_refit)
            and not _refuted(winner, c, basis.dof)
        ]
        if winner
        else []
    )
    splits, split = [], partial(evenness.split, model, evidence, places, rows_max, seed, say)
    if winner:
        for c in members[:MAX_SPLIT]:
            own, p, clutter = split(c, fits[c.effect.name], c.row.refit, c.row.net_refit)
            splits += own
            c.row.refit = evenness.scattered(c.row.refit, table.family.p(p), clutter)
    levels = _held_out(model, fit, evidence, winner, fits, refit, held_out, variables_of, say)
    shifts = _shifts(model, fit, winner, fits) if winner else []
    followed = _followed(model, evidence, winner, fits, fingerprints)
    findings = _findings(table, winner, done, members, fingerprints, splits, levels, basis, structure, followed)
    word, conditions = decide(findings)
    found = []
    if winner and word not in ("NOTHING", "CLAIM") and not any(c.row.refit.complete for c in done):
        found = pairs.search(
            evidence,
            table.order,
            winner.row.net_refit,
            lambda both: _add_both(model, fit, evidence, both, refit, fitted, split, table.family),
        )
        found = pairs.beside_curves(found, fingerprints, {row.name: row.expected for row in rows})
        word = "PARTIAL" if any(p.complete for p in found) else word
    _write_limits(model, evidence, table, winner if word == "CLAIM" else None, fits, basis, rows_max, seed, say)
    _write_verdicts(table, word, winner, members, splits, levels)
    names = [c.effect.name for c in chosen]
    gaps, correct = _gaps(evidence, chosen)
    hints = _hints(word, conditions, members, gaps, names)
    text = sentence(word, conditions, findings, rows, [c.row for c in members], fingerprints, levels, shifts, basis)
    if any(p.complete for p in found):
        text = pairs.words(found, {row.name: row.share for row in rows})
    elif word in ("PARTIAL", "UNKNOWN"):
        text += pairs.doubt(found)
    if word in ("UNKNOWN", "CANNOT_TELL"):
        excess = basis.chi2 - basis.dof if basis.excess_sd > EXCESS else 0.0
        fixed = prints.fixed_text(
            prints.fixed_pattern(model, evidence, excess), max([f.share for f in fingerprints], default=0.0)
        )
        unknown = (
            [prints.unexplained(fingerprints, findings.fall, excess), "" if fixed else prints.goes_with(families)]
            if word == "UNKNOWN"
            else []
        )
        text = " ".join(filter(None, [fixed, text[0].upper() + text[1:] if fixed else text, *unknown]))
        if fixed:
            hints.insert(
                0,
                "divide the pattern out with a flat_field, mask what is dirt, or note the sensor's own as [noise] prnu",
            )
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
        not_tested=not_tested,
        warnings=_warnings(model, fit, evidence, table, word, winner, shifts, dropped, structure, basis),
        claimed=winner.effect.name if word == "CLAIM" else "",
        pairs=found,
        families=families,
        fits=fits,
        evidence=replace(evidence, blocks=[], sigma=[], whitened=[], use=[], candidates=table.order),
    )


@dataclass
class Scored:
    """Every effect scored against a calibrated model; dropped: names of variables at a bound, not_tested: {effect:
    why}."""

    evidence: Evidence
    table: Table
    dropped: list[str]
    not_tested: dict[str, str]


def score(
    model,
    fit,
    effects: Sequence[Effect],
    variables_of: Callable[[Effect], Sequence[Variable]],
    fitted: Sequence[int],
    *,
    rows_max: int = 400_000,
    seed: int = 0,
    progress: Progress | None = None,
) -> Scored:
    """The first part of a diagnosis: derivative images, projection and ranking, nothing added yet. Arguments and errors
    as of `diagnose`."""
    fitted = [int(i) for i in fitted]
    if not fitted:
        raise ValueError("diagnose: no fitted frames given; name the frames that the base was calibrated on")
    _require_noise(model)
    base, dropped = _base_variables(model, fit, fitted)
    candidates, not_tested = _candidates(model, fit, effects, variables_of, fitted)
    evidence = measure(
        model, fit.values, base, candidates, fitted, rows_max, seed, progress or (lambda what, done, total: None)
    )
    _require_convergence(evidence, fit)
    return Scored(evidence, _rank(evidence, candidates, seed), dropped, not_tested)


# -- what must hold before any score ----------------------------------------------------------------------------------


def _require_noise(model) -> None:
    """Refuse to judge images whose saturation or black level nobody knows: both fake effects at any significance."""
    noise = getattr(model, "noise", None)
    for name, cost in (
        ("saturation", "unmasked saturation makes the right effect lose in four of five cases"),
        ("black_level", "half a DN of black level looks like glare"),
    ):
        value = getattr(noise, name, None)
        if value is None or not math.isfinite(value):
            raise Underdetermined(
                f"diagnose: the camera's {name} is not known, and {cost}; give it under [noise] in "
                "captures.toml, or estimate the noise from dark and repeated frames"
            )


def _base_variables(model, fit, fitted: Sequence[int]) -> tuple[list[Variable], list[str]]:
    """The variables that the base may move in the fitted frames, and names of those that rest at a bound."""
    present = [v for v in fit.variables if v.frames is None or set(v.frames) & set(fitted)]
    stuck = set(getattr(fit, "at_bound", ()))
    bound = [v.name for v in present if v.name in stuck or at_bound(v, value_of(model, fit.values, v))]
    return [v for v in present if v.name not in bound], bound


def _candidates(model, fit, effects, variables_of, fitted) -> tuple[list[Candidate], dict[str, str]]:
    taken = {key for v in fit.variables for key in v.keys}
    found, not_tested = [], {}
    for effect in effects:
        variables = [v for v in variables_of(effect) if v.frames is None or set(v.frames) & set(fitted)]
        if not variables:
            not_tested[effect.name] = "the scene has no part that carries it"
            continue
        if any(key in taken for v in variables for key in v.keys):
            not_tested[effect.name] = "in the model already"
            continue
        found.append(Candidate.at(model, fit.values, effect, variables))
    return found, not_tested


def _require_convergence(evidence: Evidence, fit) -> None:
    """Refuse a base that is not calibrated: |Q'r|^2 would be chi2 of a parameter, not of a missing effect.

    Allowed is 1 per parameter or, where the model misses the data by more than noise, a percent of that excess:
    derivative images of moving edges are finite samples, which no calibration can make orthogonal to a residual with
    structure."""
    rank = max(evidence.projected.rank, 1)
    excess = max(evidence.projected.chi2 - (evidence.normal.count - rank), 0.0)
    allowed = max(1.0, SETTLED * excess / rank)
    if evidence.gradient >= allowed:
        how = "" if getattr(fit, "converged", True) else f" (it stopped: {fit.reason})"
        raise Underdetermined(
            f"diagnose: the base model is not calibrated to convergence{how}: moving its {rank} parameters "
            f"would lower chi2 by {evidence.projected.absorbed:.3g}, {evidence.gradient:.3g} per parameter (most of all {some(_off(evidence))}); "
            f"allowed: below {allowed:.3g}; calibrate again from there, without robust weights, or hold what the captures hardly tell apart: leave it "
            "out of --free, or give it a --prior"
        )


def _off(evidence: Evidence) -> list[str]:
    """The variables of the base whose images change most in the step that would calibrate it."""
    step = evidence.inverse(evidence.base) @ (evidence.normal.score[evidence.base] + evidence.pull)
    change = np.abs(step) * np.sqrt(np.maximum(np.diag(evidence.normal.gram)[evidence.base], 0))
    return [evidence.columns[evidence.base[i]].name for i in np.argsort(-change)[:3] if change[i] > 0.3 * change.max()]


# -- ranking ----------------------------------------------------------------------------------------------------------


@dataclass
class Table:
    """All candidates, best first, and the family-wise test that they share."""

    order: list[Candidate]
    information: np.ndarray  # V of all columns, zero where nothing is visible
    family: st.Family
    p_best: float
    winner_uniform: str
    winner_dilated: str


def _rank(evidence: Evidence, candidates: list[Candidate], seed: int) -> Table:
    projected, first = evidence.projected, len(evidence.base)
    # where noise of a derivative image is more than what survives of it, products of two such images are chance, and
    # may be next to nothing
    visible = (projected.survival > st.VISIBLE) & (
        np.diag(projected.information) > evidence.normal.noise[evidence.rest]
    )
    for c in candidates:
        if c.broken:
            visible[[i - first for columns in c.forms.values() for i in columns]] = False
    information = projected.information * np.outer(visible, visible)
    score = projected.score * visible
    shared = []
    for c in candidates:
        best = None
        for form, columns in c.forms.items():
            own = np.array(columns) - first
            cone = st.Cone(information[np.ix_(own, own)], c.sides, seed)
            shared.append((own, cone))
            fall, linear = cone.solve(score[own])
            if best is None or fall - cone.expectation > best[0]:
                best = (fall - cone.expectation, form, own, cone, fall, linear)
        _, c.form, own, c.cone, fall, c.linear = best
        c.columns = [int(i) + first for i in own]
        c.row = _row(evidence, c, own, fall)
    family = st.Family(information, shared, seed)
    critical = family.critical(LEVEL)
    uniform_gram = evidence.thinned(lambda block: block.sigma)
    chi2, dof = projected.chi2, max(evidence.normal.count - projected.rank, 1)
    for c in candidates:
        row = c.row
        row.p_family = family.p(row.p)
        row.power = c.cone.power(c.linear_of(c.usual / 10), c.cone.critical(critical))
        raw = uniform_gram.gram[np.ix_(c.columns, c.columns)]
        usual = c.linear_of(c.usual)
        c.raw = math.sqrt(max(usual @ raw @ usual, 0.0) / max(uniform_gram.count, 1)) / evidence.signal
        row.image = math.sqrt(max(c.linear @ raw @ c.linear, 0.0) / max(uniform_gram.count, 1)) / evidence.signal
        row.misfit_after = evidence.noise * math.sqrt(max(chi2 - row.fall, 0.0) / dof)
        excess = chi2 - dof
        row.share = row.net / excess if excess > EXCESS * math.sqrt(2 * dof) else math.nan
        row.confused_with, row.cos = _confused(information, c, candidates, first)
        if row.survival <= st.VISIBLE or not len(c.cone.live):
            row.flags.append("a derivative image is not finite" if c.broken else "nothing visible")
        if row.kappa > KAPPA:
            row.flags.append("noisy derivative")
        if any(
            v.parameter.neutral is not None and abs(value - v.parameter.neutral) > 1e-9 * abs(v.parameter.plausible)
            for v, value in zip(c.variables, c.start)
        ):
            row.flags.append("not at neutral: tests a change of the value assumed")
    order = sorted(candidates, key=lambda c: (not len(c.cone.live), -c.row.net, c.effect.name))
    p_best = min((c.row.p_family for c in candidates), default=1.0)
    uniform = _winner(evidence, uniform_gram, candidates)
    dilated = _winner(evidence, evidence.thinned(lambda block: block.inner.astype(float)), candidates)
    return Table(order, information, family, p_best, uniform, dilated)


def _row(evidence: Evidence, c: Candidate, own: np.ndarray, fall: float) -> Row:
    raw = np.diag(evidence.normal.gram)[c.columns] * c.plausible**2
    survival = float(evidence.projected.survival[own] @ raw / raw.sum()) if raw.sum() > 0 else 0.0
    kappa = evidence.normal.kappa()[c.columns]
    seen = c.cone.live
    change = c.change_of(c.linear)
    return Row(
        name=c.effect.name,
        variables=[v.name for v in c.variables],
        units=[v.parameter.unit for v in c.variables],
        form=c.form,
        fall=fall,
        expected=c.cone.expectation,
        p=float(c.cone.p(fall)),
        p_family=1.0,
        start=c.start.tolist(),
        change=change.tolist(),
        sd=c.sd_of(c.cone.sd).tolist(),
        of_plausible=float(np.max(np.abs(change) / c.plausible)),
        image=math.nan,
        misfit_after=math.nan,
        share=math.nan,
        survival=survival,
        power=0.0,
        kappa=float(kappa[seen].max(initial=0.0)),
        confused_with="",
        cos=0.0,
        upper=[math.nan] * len(c.variables),
    )


def _confused(information: np.ndarray, c: Candidate, candidates: Sequence[Candidate], first: int) -> tuple[str, float]:
    """The effect that mimics this one best, and |cos| of the angle between what survives of both."""
    own = np.array(c.columns) - first
    strength = c.direction
    full = float(strength @ information[np.ix_(own, own)] @ strength)
    best = ("", 0.0)
    for other in candidates:
        if other is c or not full > 0 or not other.columns or not len(other.cone.live):
            continue
        gap = st.gap(information, own, strength, np.array(other.columns) - first, other.cone)
        cos = math.sqrt(max(1 - gap / full, 0.0))
        if cos > best[1]:
            best = (other.effect.name, cos)
    return best


def _winner(evidence: Evidence, normal: st.Normal, candidates: Sequence[Candidate]) -> str:
    """The best effect with other weights; the scale of the weights cannot matter to an order."""
    if not candidates:
        return ""
    projected = evidence.project(normal, evidence.base, evidence.rest, evidence.thinning)
    first = len(evidence.base)
    scale = projected.chi2 / max(normal.count - projected.rank, 1)
    net = {}
    for c in candidates:
        if not len(c.cone.live):
            continue
        own = np.array(c.columns) - first
        seen = (projected.survival[own] > st.VISIBLE).astype(float)
        cone = st.Cone(projected.information[np.ix_(own, own)] * np.outer(seen, seen), c.sides, draws=1000)
        net[c.effect.name] = cone.solve(projected.score[own] * seen)[0] / scale - cone.expectation
    return max(net, key=net.get, default="")


def _choose(table: Table, top: int) -> list[Candidate]:
    """The effects to add and refit: the best ones, those that cannot be told from the best, winners of other weights.

    What chance explains is not added: a refit is as dear as a calibration.
    """
    live = [c for c in table.order if c.row.net > 0 and c.row.p_family < LEVEL]
    chosen = live[:top] + [c for c in live[top:] if close(live[0].row.net, c.row.net)]
    chosen = chosen[:MAX_REFITS]
    others = {table.winner_uniform, table.winner_dilated} - {c.effect.name for c in chosen}
    return chosen + [c for c in live if c.effect.name in others]


def _gaps(evidence: Evidence, chosen: Sequence[Candidate]) -> tuple[list[list[float]], list[list[float]]]:
    """D[a][b], expected chi2 of a over b when a is true as found, and the probability to decide rightly."""
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


# -- refit ------------------------------------------------------------------------------------------------------------


def _refit(
    model,
    fit,
    evidence: Evidence,
    table: Table,
    chosen: Sequence[Candidate],
    refit: Callable,
    fitted: Sequence[int],
    say: Progress,
) -> dict:
    """Add each chosen effect, calibrate everything again, and write what came of it into its row."""
    before = evidence.normal.square + _prior_chi2(model, fit.values, fit.variables)
    base = [v for v in fit.variables if v.frames is None or set(v.frames) & set(fitted)]
    fits = {}
    for n, c in enumerate(chosen):
        say("refit", n, len(chosen))
        best, (predicted, linear) = None, _look_again(model, fit, evidence, c)
        # where an image is not in proportion to its strength, between a weak effect and a strong one lie other minima
        for fraction, enough in ((START, 0.0), *([(1.0, 0.5)] if c.form == "secant" else []), (0.1, 0.5)):
            if enough and (predicted < CLEAR or best is not None and best[0] > enough * predicted):
                break  # nothing to win, or an attempt before was as good as predicted
            start = _start(model, fit, evidence, [(c, linear)], fraction)
            try:
                found = refit(model, [*base, *c.variables], start, frames=list(fitted))
            except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
                c.row.flags.append(f"refit failed: {error}")
                continue
            after, expected, images = _chi2(model, found.values, evidence)
            after += _prior_chi2(model, found.values, fit.variables)
            if math.isfinite(after) and (best is None or before - after > best[0]):
                best = (before - after, after, expected, found, images)
        if best is None:
            c.row.flags.append("refit without a result")
            continue
        fall, after, expected, found, images = best
        fits[c.effect.name] = found
        strength = [value_of(model, found.values, v) for v in c.variables]
        sd = {v.name: float(s) for v, s in zip(found.variables, found.sd)}
        ended = [v.name for v, s, at in zip(c.variables, strength, c.start) if at_bound(v, s) and abs(s - at) > 0]
        ratio = fall / predicted if predicted > 0 else math.nan
        c.row.refit = Refit(
            fall,
            predicted,
            ratio,
            before,
            after,
            strength,
            [sd.get(v.name, math.nan) for v in c.variables],
            ended,
            _excess(evidence, after, expected, [c]),
            evidence.structure(images, [*evidence.base, *c.columns]).p,
            bool(found.converged),
            str(found.reason),
            _clear(found, c, strength),
        )
        if not 0.5 <= ratio <= 2 and predicted > CLEAR:
            c.row.flags.append("nonlinear")
        if ended:
            c.row.flags.append("at a bound")
        size = np.abs(np.array(strength) - c.start) / c.plausible
        if size.max() > IMPLAUSIBLE and fall > CLEAR:
            c.row.flags.append(f"{size.max():.2g} times the plausible strength")
    say("refit", len(chosen), len(chosen))
    return fits


def _clear(found, c: Candidate, strength: Sequence[float]) -> float:
    """sqrt(d' C^-1 d) of the strengths' change d and their covariance C; NaN where C is not known."""
    names = [v.name for v in found.variables]
    own = [names.index(v.name) for v in c.variables if v.name in names]
    covariance = np.asarray(found.covariance, float)[np.ix_(own, own)]
    if len(own) < len(c.variables) or not np.isfinite(covariance).all():
        return math.nan
    change = np.array(strength) - c.start
    inverse, rank = st.inverse(covariance)
    return math.sqrt(max(float(change @ inverse @ change), 0.0)) if rank else math.nan


def _add_both(
    model,
    fit,
    evidence: Evidence,
    both: list[Candidate],
    refit: Callable,
    fitted: Sequence[int],
    split: Callable,
    family: st.Family,
) -> Pair | None:
    """What comes of two effects that are added together; None where no refit succeeds. `split` is
    `homogeneity.split`."""
    base = [v for v in fit.variables if v.frames is None or set(v.frames) & set(fitted)]
    start = _start(model, fit, evidence, [(c, c.linear) for c in both], START)
    try:
        found = refit(model, [*base, *(v for c in both for v in c.variables)], start, frames=list(fitted))
    except (ValueError, ArithmeticError, np.linalg.LinAlgError):
        return None
    after, expected, images = _chi2(model, found.values, evidence)
    after += _prior_chi2(model, found.values, fit.variables)
    fall = evidence.normal.square + _prior_chi2(model, fit.values, fit.variables) - after
    columns = [*evidence.base, *(i for c in both for i in c.columns)]
    pair = Pair(
        [c.effect.name for c in both],
        fall,
        _excess(evidence, after, expected, both),
        evidence.structure(images, columns).p,
    )
    for c, other in (
        (both, both[::-1]) if pair.complete else ()
    ):  # a second effect may take up clutter, or what the first has wrong
        strength = [value_of(model, found.values, v) for v in c.variables]
        alone = _clear(found, c, strength) ** 2
        own, chance, _ = split(c, found, pair, fall if math.isnan(alone) else alone, other.variables)
        uneven = [s.by for s in own if not s.holds]
        if uneven or family.p(chance) >= LEVEL:
            return replace(
                pair,
                but=f"{c.effect.name}'s strength "
                + (
                    f"then differs by {uneven[0]}"
                    if uneven
                    else "is no more than its scatter between parts of the data"
                ),
            )
    return pair


def _look_again(model, fit, evidence: Evidence, c: Candidate) -> tuple[float, np.ndarray]:
    """(fall of chi2 that a refit will bring, coefficients) of an effect by its image at the strength that was found,
    not at the plausible.

    A secant to the plausible strength is the wrong image where a weak effect has another shape than a strong one: leaks
    that add in amplitude, two components of one retardance. Scores and tests stay what they were."""
    fall, linear, first = c.row.fall, c.linear, len(evidence.columns)
    if c.form != "secant" or not linear.any():
        return fall, linear
    plain, k = evidence.thinned(extra=1), evidence.thinning
    before = model.predict(fit.values, evidence.frames, evidence.seed)
    for _ in range(LOOKS):
        values, normal = fit.values.copy(), plain.copy()
        for v, start, step in zip(c.variables, c.start, c.change_of(linear)):
            values.put(v, float(np.clip(start + step, *v.parameter.bounds)))
        for block, old, new in zip(evidence.blocks, before, model.predict(values, evidence.frames, evidence.seed)):
            image = (np.asarray(new, float) - old).reshape(-1)[block.index] / block.sigma
            st.add_bins(normal, block.where, block.middle, block.r, first, np.zeros(len(block.r), int), 1, [image])
        projected = evidence.project(normal, evidence.base, [first], k)
        information, score = projected.information[0, 0], projected.score[0]
        if not (math.isfinite(score) and projected.survival[0] > st.VISIBLE and score > 0):
            return c.row.fall, c.linear
        fall, times = k * score**2 / information, score / information
        if abs(times - 1) < 0.25:
            break
        linear = linear * min(max(times, 0.1), 10.0)
    return float(fall), linear


def _start(model, fit, evidence: Evidence, effects: Sequence[tuple[Candidate, np.ndarray]], fraction: float) -> Values:
    """Effects at a fraction of their expected change, and the base where it would move to make room for them."""
    values, first, moves = fit.values.copy(), len(evidence.base), 0.0
    for c, linear in effects:
        linear = linear * fraction
        for v, start, step in zip(c.variables, c.start, c.change_of(linear)):
            low, high = v.parameter.bounds
            values.put(
                v,
                float(
                    np.clip(
                        start + step,
                        start + 0.9 * (low - start) if math.isfinite(low) else -math.inf,
                        start + 0.9 * (high - start) if math.isfinite(high) else math.inf,
                    )
                ),
            )
        moves = moves + evidence.projected.response[:, np.array(c.columns) - first] @ linear
    for i, move in zip(evidence.base, moves):
        v = evidence.columns[i]
        low, high = v.parameter.bounds
        here = value_of(model, fit.values, v)
        limit = 3 * abs(v.parameter.plausible)  # beyond, the linear guess is no guide
        to = here + float(np.clip(move, -limit, limit))
        values.put(
            v,
            float(
                np.clip(
                    to,
                    low + 0.1 * (here - low) if math.isfinite(low) else to,
                    high - 0.1 * (high - here) if math.isfinite(high) else to,
                )
            ),
        )
    return values


def _chi2(model, values: Values, evidence: Evidence) -> tuple[float, float, list[np.ndarray]]:
    """chi2 of other values on the same pixels with the same weights, what it would be were they true, and the whitened
    residual images.

    Brighter pixels are noisier: by the base's weights chi2 of the truth is sum of variance/sigma^2, not the number of
    values."""
    total, expected, images = 0.0, 0.0, []
    predicted = model.predict(values, evidence.frames)
    for frame, prediction, sigma, use in zip(evidence.frames, predicted, evidence.sigma, evidence.use):
        image = np.where(use, (np.asarray(model.frames[frame].image, float) - prediction) / sigma, 0.0)
        total += float(np.sum(image**2))
        variance = evidence.variance(model, frame, np.asarray(prediction, float), values)
        expected += float(np.sum(np.where(use, variance, 0.0) / sigma.astype(float) ** 2))
        images.append(image)
    return total, expected, images


def _excess(evidence: Evidence, after: float, expected: float, added: Sequence[Candidate]) -> float:
    """Standard deviations by which chi2 with these effects is more than it would be were they all that is there."""
    free = evidence.projected.rank + sum(len(c.cone.live) for c in added)
    return (after - expected + free) / math.sqrt(2 * max(evidence.normal.count - free, 1))


def _prior_chi2(model, values: Values, variables: Sequence[Variable]) -> float:
    return sum(((value_of(model, values, v) - v.prior[0]) / v.prior[1]) ** 2 for v in variables if v.prior is not None)


# -- held-out frames, shifts ------------------------------------------------------------------------------------------


def _held_out(
    model,
    fit,
    evidence: Evidence,
    winner: Candidate | None,
    fits: Mapping,
    refit: Callable,
    held_out: Sequence[int],
    variables_of,
    say: Progress,
) -> list[Level]:
    """Base and winner on frames that were not fitted: globals frozen, only what is per frame solved for, alike for
    both."""
    n = evidence.normal.count
    after = _chi2(model, fits[winner.effect.name].values, evidence)[0] if winner else math.nan

    def level(name, chi2, held, count, fall=math.nan, better=0):
        return Level(
            name,
            evidence.noise * math.sqrt(chi2 / n),
            evidence.noise * math.sqrt(held / count) if count else math.nan,
            chi2 / n,
            held / count if count else math.nan,
            n,
            count,
            fall,
            better,
            len(held_out),
        )

    if not held_out:
        levels = [level("base", evidence.normal.square, math.nan, 0)]
        return levels + ([level(winner.effect.name, after, math.nan, 0)] if winner else [])
    say("held-out frames", 0, 2)
    pose = for_frames(model, fit.variables, held_out)
    values = fit.values.copy()
    if pose:
        values = refit(model, pose, values, frames=list(held_out)).values
    masks, sds, base = [], [], []
    for f in held_out:
        prediction = np.asarray(model.predict(values, [f])[0], float)
        variance = evidence.variance(model, f, prediction, values)
        use = np.asarray(model.usable(f), bool) & np.isfinite(prediction)
        masks.append(use)
        sds.append(np.sqrt(np.where(use, variance, 1.0)))
        base.append(_square(model, f, prediction, use, sds[-1]))
    count = int(sum(m.sum() for m in masks))
    levels = [level("base", evidence.normal.square, sum(base), count)]
    if winner is None or not count:
        return levels
    say("held-out frames", 1, 2)
    own = [v for v in variables_of(winner.effect) if v.frames is not None and set(v.frames) & set(held_out)]
    values = fits[winner.effect.name].values.copy()
    if pose or own:
        values = refit(model, [*pose, *own], values, frames=list(held_out)).values
    with_effect = [
        _square(model, f, np.asarray(model.predict(values, [f])[0], float), use, sd)
        for f, use, sd in zip(held_out, masks, sds)
    ]
    fall = sum(base) - sum(with_effect) - len(own)
    better = int(sum(b > w for b, w in zip(base, with_effect)))
    say("held-out frames", 2, 2)
    return [*levels, level(winner.effect.name, after, sum(with_effect), count, fall, better)]


def _square(model, frame: int, prediction: np.ndarray, use: np.ndarray, sd: np.ndarray) -> float:
    residual = (np.asarray(model.frames[frame].image, float) - prediction) / sd
    return float(np.sum(np.where(use & np.isfinite(residual), residual, 0.0) ** 2))


def _shifts(model, fit, winner: Candidate, fits: Mapping) -> list[Shift]:
    """How far the base's parameters moved when the winner was added, the farthest (in their own sd) first."""
    found = fits[winner.effect.name]
    sd = {v.name: float(s) for v, s in zip(fit.variables, fit.sd)}
    present = {v.name for v in found.variables}
    shifts = []
    for v in fit.variables:
        if v.name not in present:
            continue
        before, after = value_of(model, fit.values, v), value_of(model, found.values, v)
        own = sd.get(v.name, math.nan)
        in_sd = (after - before) / own if own > 0 else math.nan
        out = v.prior is not None and abs(after - v.prior[0]) > 3 * v.prior[1]
        shifts.append(
            Shift(winner.effect.name, v.name, v.parameter.unit, before, after, in_sd, bool(abs(in_sd) > 3 or out))
        )
    return sorted(shifts, key=lambda s: -abs(s.in_sd) if math.isfinite(s.in_sd) else 0.0)


# -- findings, limits, warnings ---------------------------------------------------------------------------------------


def _refuted(winner: Candidate, other: Candidate, dof: int) -> bool:
    """Whether the winner leaves nothing to explain, and another, refitted, does: more than misfit that hides beside the
    winner could fake.

    For the wrong one of two to lead by L in chi2, what lies along the one direction in which their images differ must
    be sqrt(L) or more. Noise has a variance of 1 there, and misfit of which H is hidden a share of it: L > CLEAR (1 +
    ALONG H)."""
    own, left = winner.row.refit, other.row.refit
    if other is winner or not own.complete or left is None or not left.converged:
        return False
    hidden = (abs(own.excess_sd) + HIDDEN) * math.sqrt(
        2 * dof
    )  # below none: the noise is overstated, by as much as that
    return left.structure_p < LEVEL or winner.row.net_refit - other.row.net_refit > CLEAR * (1 + ALONG * hidden)


def _simplest(done: Sequence[Candidate]) -> Candidate:
    """The best effect, or one that it contains and that does as well."""
    best = done[0]
    return next((c for c in done[1:] if best.contains(c) and best.row.net_refit - c.row.net_refit < CLEAR), best)


def _findings(table, winner, done, members, fingerprints, splits, levels, basis, structure, followed) -> Findings:
    if winner is None:
        best = max((c.row.net for c in table.order), default=0.0)
        own = Findings(table.p_best, structure.p, fall=max(best, 0.0), excess_sd=basis.excess_sd)
    else:
        mine = [s for s in splits if s.effect == winner.effect.name]
        others = [c for c in table.order if c is not winner and not c.contains(winner)]
        even = {c.effect.name: all(s.holds for s in splits if s.effect == c.effect.name) for c in members[:MAX_SPLIT]}
        worst = max(mine, key=lambda s: (not s.holds, s.h), default=None)
        excess = basis.chi2 - basis.dof
        own = Findings(
            table.p_best,
            structure.p,
            winner.effect.name,
            table.family.p(float(winner.cone.p(winner.row.refit.fall))),
            winner.row.net_refit,
            max([c.row.net_refit for c in done[1:]] + [c.row.net for c in others if c not in done] + [0.0]),
            refuted=winner.row.refit.complete
            and all(
                _refuted(winner, c, basis.dof)
                for c in others
                if close(winner.row.net_refit, max(c.row.net_refit, 0.0 if c in done else c.row.net))
            ),
            share=winner.row.net_refit / excess if excess > 0 else math.nan,
            excess_sd=basis.excess_sd,
            left=basis.misfit * math.sqrt(max(1 - winner.row.refit.fall / basis.chi2, 0.0)),
            uneven=worst.h if worst else 0.0,
            uneven_by=f" by {worst.by} ({_extremes(worst)})" if worst else "",
            uneven_limit=worst.limit if worst else UNEVEN,
            even=all(s.holds for s in mine),
            some_even=any(even.values()) if even else True,
            held_out=levels[-1].fall if len(levels) > 1 else math.nan,
            clear=winner.row.refit.clear,
            chance=winner.row.refit.chance,
        )
    if not fingerprints:
        return own
    better = [followed] if followed else rivals(fingerprints, own.fall)
    best = better[0] if better else fingerprints[0]
    return replace(own, ratio=best.ratio, rival=bool(better), coordinate=best.coordinate, curve_share=best.share)


def _followed(model, evidence: Evidence, winner: Candidate | None, fits, fingerprints) -> Fingerprint | None:
    """The curve along a setting, clocks aside, that an effect's numbers per frame follow and that explains as much as
    they do: they mimic whatever goes with what was set in each frame. None where they go their own way, as a drift
    does, and for other effects."""
    if winner is None or winner.effect.scope != "frame":
        return None
    fit = fits[winner.effect.name]
    own = {
        v.frames[0]: value_of(model, fit.values, v)
        for v in fit.variables
        if v.name in winner.row.variables and v.frames
    }
    turned, found = prints.settings(model, evidence), []
    for curve in fingerprints:
        if curve.coordinate in turned and curve.family != "time" and curve.net > AS_GOOD * winner.row.net_refit:
            x = dict(zip(evidence.frames, turned[curve.coordinate]))
            both = [(x[f], y) for f, y in own.items() if math.isfinite(x.get(f, math.nan))]
            found.append((st.follows(*np.array(both).T) if len(both) > 1 else math.nan, curve))
    p, curve = min(found, key=lambda t: (math.isnan(t[0]), t[0]), default=(math.nan, None))
    return curve if p * len(found) < LEVEL else None


def _extremes(split: Split) -> str:
    """'R 2.75, B 0.03': the parts of a split where the strength is largest and smallest."""
    order = np.argsort(split.strength)
    return ", ".join(f"{split.labels[i]} {split.strength[i]:.2f}" for i in (order[-1], order[0]))


def _basis(model, evidence: Evidence, structure: st.Structure) -> Basis:
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
        frame_names=[str(getattr(model.frames[f], "name", f)) for f in evidence.frames],
        frame_phi=[c / m for c, m in zip(frame_chi2, frame_n)],
    )


def _write_limits(
    model,
    evidence: Evidence,
    table: Table,
    claimed: Candidate | None,
    fits: Mapping,
    basis: Basis,
    rows_max: int,
    seed: int,
    say: Progress,
) -> None:
    """Upper limits of every effect; after a claim, at the values with the claimed effect, where it can mislead no
    more."""
    others, widen = table.order, math.sqrt(max(basis.phi, 1.0))
    if claimed is not None:
        values, refit = fits[claimed.effect.name].values, claimed.row.refit
        base = [
            v
            for v in [*(evidence.columns[i] for i in evidence.base), *claimed.variables]
            if not at_bound(v, value_of(model, values, v))
        ]
        others = [replace(c, forms={}, broken=False) for c in table.order if c is not claimed]
        evidence = measure(model, values, base, others, evidence.frames, rows_max, seed, say, "upper limits")
        widen = math.sqrt(max(1 + refit.excess_sd * math.sqrt(2 / basis.dof), 1.0))
    projected, first = evidence.projected, len(evidence.base)
    for c in others:
        best = -math.inf
        for form, columns in c.forms.items():
            seen = [j for j, i in enumerate(columns) if projected.survival[i - first] > st.VISIBLE]
            if not seen or c.broken or (claimed is None and form != c.form):
                continue
            own = [columns[j] - first for j in seen]
            cone = st.Cone(projected.information[np.ix_(own, own)], [c.sides[j] for j in seen], draws=1000)
            fall, found = cone.solve(projected.score[own])
            if fall - cone.expectation > best:
                best = fall - cone.expectation
                linear = np.full(len(c.variables), math.nan)
                linear[seen] = np.abs(found) + 2 * widen * cone.sd
                c.form = form
                c.row.upper = c.change_of(linear).tolist()


def _write_verdicts(table: Table, word: str, winner, members, splits, levels) -> None:
    for c in table.order:
        mine = [s for s in splits if s.effect == c.effect.name]
        if mine and not all(s.holds for s in mine):
            c.row.flags.append("uneven")
        if c.row.refit is None and c.row.net <= 0 or c.row.p_family >= LEVEL:
            c.row.verdict = "nothing visible" if "nothing visible" in c.row.flags else "no evidence"
        elif word == "CLAIM" and c is winner:
            c.row.verdict = "MISSING"
        elif word == "AMBIGUOUS" and c in members:
            c.row.verdict = "possible"
        elif word == "PARTIAL" and c is winner:
            c.row.verdict = "partial"
        if c is winner and table.p_best < LEVEL and {table.winner_uniform, table.winner_dilated} - {c.effect.name}:
            c.row.flags.append("fragile")


def _warnings(model, fit, evidence, table, word, winner, shifts, dropped, structure, basis) -> list[str]:
    """What weakens the verdict, in sentences."""
    texts = [] if getattr(fit, "converged", True) else [f"the base stopped before it converged: {fit.reason}"]
    captures = getattr(model, "captures", None)
    if captures is not None:
        from optics.captures.noise import warnings_of

        texts += [w for w in warnings_of(model.noise, captures) if w not in texts]
    if dropped:
        texts.append(f"at a bound and taken as known: {', '.join(dropped)}")
    if evidence.not_finite:
        texts.append(f"{evidence.not_finite} values left out because prediction or derivative is not finite")
    if evidence.render_noise > 0.01:
        texts.append(
            f"Monte Carlo noise of the prediction adds {evidence.render_noise:.1%} to the variance; render with more "
            "samples"
        )
    noisy = [c.effect.name for c in table.order if c.row.kappa > KAPPA]
    if noisy:
        texts.append(
            f"derivative images are noisy (kappa above {KAPPA:g}): {', '.join(noisy)}; render with more samples"
        )
    if structure.high < 0.7:
        texts.append(
            f"fine detail of the residual has {structure.high:.2f} of the noise expected: the images look interpolated "
            "or filtered, or the noise is overstated; neighbouring pixels then share their noise and p is too small"
        )
    if abs(basis.excess_sd) > EXCESS and structure.p >= LEVEL:
        texts.append(
            f"chi2 is {basis.phi:.3g} per degree of freedom without structure: rather the noise model (gain, PRNU) is off "
            "than the physics"
        )
    if winner is not None and table.p_best < LEVEL:
        for other, what in (
            (table.winner_uniform, "with uniform weights"),
            (table.winner_dilated, "with masks one pixel wider"),
        ):
            if other and other != winner.effect.name:
                texts.append(f"fragile: {what} the best effect is {other}, not {winner.effect.name}")
    moved = [s for s in shifts if s.warn]
    if moved and word in NAMED:
        texts.append(
            f"with {winner.effect.name}, what had been calibrated moves by more than 3 sd or out of its prior: "
            + some([moved_by(s) for s in moved], 3)
        )
    return texts


def _hints(word: str, conditions, members: Sequence[Candidate], gaps, names) -> list[str]:
    """What to measure next, in words; ranked by declared needs, not by simulated shots."""
    failed = {c.name for c in conditions if not c.holds}
    hints = []
    if word == "AMBIGUOUS" and len(members) > 1:
        pairs = [
            (
                min(
                    gaps[names.index(a.effect.name)][names.index(b.effect.name)],
                    gaps[names.index(b.effect.name)][names.index(a.effect.name)],
                ),
                a,
                b,
            )
            for i, a in enumerate(members)
            for b in members[i + 1 :]
        ]
        d, a, b = min(pairs, key=lambda pair: pair[0])
        more = math.ceil(CLEAR / d) if d > 0 else 0
        pair = (
            f"hardest pair: {a.effect.name} / {b.effect.name}, expected chi2 between them D = {d:.3g}, "
            f"P(correct) = {st.probability_correct(d):.2f} in noise alone; "
        )
        if d >= CLEAR:
            hints += [
                pair + "noise would allow a decision, but not the misfit that both leave",
                "add each of them in a copy of the study, diagnose again, and keep the one after which the least is left: what else is "
                "missing hides which of them it is",
            ]
        else:
            hints.append(
                pair
                + (
                    f"{more} times as many frames of the same kind would decide in 95 % of cases"
                    if 0 < more < 1000
                    else "more frames of the same kind will not decide"
                )
            )
        for one, other in ((a, b), (b, a)):
            alone = [x for x in one.effect.acts if x not in other.effect.acts]
            if alone:
                hints.append(f"only {one.effect.name} acts through {', '.join(alone)}: vary that and keep the rest")
        hints += [f"{c.effect.name} needs: {c.effect.needs}" for c in members if c.effect.needs]
        hints.append(USUALLY)
    if "held out" in failed and word != "NOTHING" and "held out" in {c.name for c in conditions}:
        hints.append(
            "hold out frames that the fit has not seen (other presses or places), or find why they do not improve"
        )
    if "near" in failed:
        hints.append(f"no effect brings the model near its images: check {AT_FAULT}")
    if CURVE in failed:
        hints.append(
            "check [noise]: repeats of one frame tell system_gain and dark_noise, a flat_field takes the sensor's own pattern out"
        )
    if word == "UNKNOWN":
        hints.append(
            "draft an effect from the curve (optics effects new NAME --from STUDY), add it, and diagnose again"
        )
    return hints
