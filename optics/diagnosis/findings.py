"""Findings: the numbers that a verdict is made of, gathered from scores, refits, splits, curves and held-out frames."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from optics.diagnosis import fingerprints as prints
from optics.diagnosis import statistics as st
from optics.diagnosis.decide import Findings, rivals
from optics.diagnosis.evidence import Candidate, Evidence
from optics.diagnosis.refit import Case
from optics.diagnosis.result import Basis, Fingerprint, Level, Split
from optics.diagnosis.thresholds import AS_GOOD, CLEAR, HIDDEN, LEVEL, MAX_SPLIT, UNEVEN, close
from optics.fit.model import Model, value_of
from optics.fit.result import Fit

# Of the misfit that hides: the share that lies along the one direction in which two effects differ. Measured: .006 on
# average and .07 at most on the polarizer bench, .002 on gelsight.
ALONG = 0.05


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


def simplest(done: Sequence[Candidate]) -> Candidate:
    """The best effect, or one that it contains and that does as well."""
    best = done[0]
    return next((c for c in done[1:] if best.contains(c) and best.row.net_refit - c.row.net_refit < CLEAR), best)


def refuted(winner: Candidate, other: Candidate, dof: int) -> bool:
    """Whether the winner leaves nothing to explain, while another effect, refitted, leaves more than misfit that hides
    beside the winner could fake.

    For the wrong one of two to lead by L in chi2, sqrt(L) or more must lie along the one direction in which their
    images differ. Noise has a variance of 1 there, and of misfit of which H is hidden, a share ALONG lies there: the
    right one leads if L > CLEAR (1 + ALONG H)."""
    own, left = winner.row.refit, other.row.refit
    if own is None or other is winner or not own.complete or left is None or not left.converged:
        return False
    # an excess below none means that the noise is overstated by as much, and hides that much more
    hidden = (abs(own.excess_sd) + HIDDEN) * math.sqrt(2 * dof)
    return left.structure_p < LEVEL or winner.row.net_refit - other.row.net_refit > CLEAR * (1 + ALONG * hidden)


def findings_of(
    case: Case,
    winner: Candidate | None,
    done: Sequence[Candidate],
    members: Sequence[Candidate],
    fits: Mapping[str, Fit],
    fingerprints: Sequence[Fingerprint],
    splits: Sequence[Split],
    levels: Sequence[Level],
    basis: Basis,
) -> Findings:
    """The numbers that decide.

    done      refitted effects, the winner first; members: those that explain the residual about equally well
    splits    of the members that were split
    """
    table = case.table
    if winner is None:
        best = max((c.row.net for c in table.order), default=0.0)
        own = Findings(table.p_best, basis.structure_p, fall=max(best, 0.0), excess_sd=basis.excess_sd)
    else:
        own = _of_winner(case, winner, done, members, splits, levels, basis)
    if not fingerprints:
        return own
    followed = _followed(case, winner, fits, fingerprints)
    better = [followed] if followed else rivals(fingerprints, own.fall)
    best_curve = better[0] if better else fingerprints[0]
    return replace(
        own,
        ratio=best_curve.ratio,
        rival=bool(better),
        coordinate=best_curve.coordinate,
        curve_share=best_curve.share,
    )


def _of_winner(
    case: Case,
    winner: Candidate,
    done: Sequence[Candidate],
    members: Sequence[Candidate],
    splits: Sequence[Split],
    levels: Sequence[Level],
    basis: Basis,
) -> Findings:
    """What the refit, the splits and the held-out frames say about the winner."""
    refit, table = winner.row.refitted, case.table
    mine = [s for s in splits if s.effect == winner.effect.name]
    others = [c for c in table.order if c is not winner and not c.contains(winner)]
    even = [all(s.holds for s in splits if s.effect == c.effect.name) for c in members[:MAX_SPLIT]]
    worst = max(mine, key=lambda s: (not s.holds, s.h), default=None)
    excess = basis.chi2 - basis.dof
    return Findings(
        table.p_best,
        basis.structure_p,
        winner.effect.name,
        table.family.p(float(winner.cone.p(refit.fall))),
        winner.row.net_refit,
        max([c.row.net_refit for c in done[1:]] + [c.row.net for c in others if c not in done] + [0.0]),
        refuted=refit.complete
        and all(
            refuted(winner, c, basis.dof)
            for c in others
            if close(winner.row.net_refit, max(c.row.net_refit, 0.0 if c in done else c.row.net))
        ),
        share=winner.row.net_refit / excess if excess > 0 else math.nan,
        excess_sd=basis.excess_sd,
        left=basis.misfit * math.sqrt(max(1 - refit.fall / basis.chi2, 0.0)),
        uneven=worst.h if worst else 0.0,
        uneven_by=f" by {worst.by} ({_extremes(worst)})" if worst else "",
        uneven_limit=worst.limit if worst else UNEVEN,
        even=all(s.holds for s in mine),
        some_even=any(even) if even else True,
        held_out=levels[-1].fall if len(levels) > 1 else math.nan,
        clear=refit.clear,
        chance=refit.chance,
    )


def _followed(
    case: Case, winner: Candidate | None, fits: Mapping[str, Fit], fingerprints: Sequence[Fingerprint]
) -> Fingerprint | None:
    """The curve along a setting (clocks aside) that an effect's per-frame strengths follow, and that explains as much:
    such strengths mimic whatever depends on what was set in each frame. None for other effects, and where they do not
    follow any setting, as a drift does not."""
    if winner is None or winner.effect.scope != "frame":
        return None
    model, evidence, fit = case.model, case.evidence, fits[winner.effect.name]
    own = {
        v.frames[0]: value_of(model, fit.values, v)
        for v in fit.variables
        if v.name in winner.row.variables and v.frames
    }
    turned = prints.settings(model, evidence)
    found: list[tuple[float, Fingerprint]] = []
    for curve in fingerprints:
        if curve.coordinate in turned and curve.family != "time" and curve.net > AS_GOOD * winner.row.net_refit:
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
