"""Pairs of effects: where no single effect explains a residual, two that leave nothing of it.

Pairs are ranked by the linear fall of chi2, T = u' V^-1 u over the columns of both, and the best are refitted together
with everything else. Only a pair that leaves nothing counts: two more parameters do not do that by accident."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from optics.diagnosis import statistics as st
from optics.diagnosis.evidence import Candidate, Evidence
from optics.diagnosis.result import Fingerprint, Pair
from optics.diagnosis.thresholds import CLEAR, HIDDEN, LEVEL, MARGIN, MIMICS

CONSIDERED = 10  # effects, the best by themselves: 45 pairs
REFITTED = 4  # pairs: each costs a calibration
# Of the fall: by how much two effects must do better than one, and than one curve where they leave misfit. Smaller than
# the MARGIN between single effects, as each of a pair must besides leave nothing and pass its own tests.
LEAD = MARGIN / 4


def ranked(evidence: Evidence, candidates: Sequence[Candidate]) -> list[tuple[float, Candidate, Candidate, np.ndarray]]:
    """(expected fall less its degrees of freedom, a, b, coefficients of both), best first."""
    projected, first, found = evidence.projected, len(evidence.base), []
    for a, b in combinations(candidates, 2):
        if any(c.contains(d) for c in (a, b) for d in candidates):
            continue  # the effect within it is tried
        if {key for v in a.variables for key in v.keys} & {key for v in b.variables for key in v.keys}:
            continue
        own, live = (
            np.array([*a.columns, *b.columns]) - first,
            np.array([*a.cone.live, *(len(a.columns) + b.cone.live)]),
        )
        seen = own[live]  # where the projection left only rounding, no fall is expected
        inverse, rank = st.inverse(projected.information[np.ix_(seen, seen)], st.VISIBLE)
        linear = np.zeros(len(own))
        linear[live] = inverse @ projected.score[seen]
        signs = [s * x >= 0 for s, x in zip([*a.sides, *b.sides], linear) if s]
        if all(signs):  # no strength beyond a bound
            found.append((float(projected.score[own] @ linear) - rank, a, b, linear))
    return sorted(found, key=lambda t: -t[0])


def search(
    evidence: Evidence, order: Sequence[Candidate], alone: float, add: Callable[[list[Candidate]], Pair | None]
) -> list[Pair]:
    """The best pairs, refitted, best first.

    order   effects, best first; alone: the best single effect's net fall
    add     refits effects whose `linear` is set; None without a result
    """
    live = [c for c in order if c.row.p_family < LEVEL and len(c.cone.live) and not c.broken][:CONSIDERED]
    best = [t for t in ranked(evidence, live) if t[0] - alone > max(CLEAR, LEAD * alone)]
    pairs = []
    for _, a, b, linear in best[:REFITTED]:
        kept = a.linear, b.linear
        a.linear, b.linear = linear[: len(a.columns)], linear[len(a.columns) :]
        try:
            pair = add([a, b])
        finally:
            a.linear, b.linear = kept
        if pair is not None and math.isfinite(pair.fall):
            pairs.append(pair)
    return sorted(pairs, key=lambda p: -p.fall)


def beside_curves(
    pairs: Sequence[Pair], fingerprints: Sequence[Fingerprint], chance: Mapping[str, float]
) -> list[Pair]:
    """The pairs, with a `but` where one curve does as well: one cause that the library lacks is then more likely.

    chance   effect -> mean fall when it is absent
    """
    curve = max((f for f in fingerprints if f.coordinate not in MIMICS), key=lambda f: f.net, default=None)

    def judged(pair: Pair) -> Pair:
        net = pair.fall - sum(chance[name] for name in pair.effects)
        lead = LEAD * net if pair.excess_sd > HIDDEN else 0.0
        if curve is None or not pair.complete or net > curve.net + max(CLEAR, lead):
            return pair
        return replace(
            pair, but=f"one curve, along '{curve.coordinate}', explains {curve.net / net:.0%} of what both do"
        )

    return [judged(pair) for pair in pairs]


def words(pairs: Sequence[Pair], share: dict[str, float]) -> str:
    """The pairs that leave nothing, in a sentence; share: of the excess, what each effect explains alone."""
    complete = [p for p in pairs if p.complete]
    common = [n for n in complete[0].effects if all(n in p.effects for p in complete)]
    if not common:
        named = ", or ".join(" with ".join(p.effects) for p in complete)
        return f"no single effect explains the residual; two together leave nothing: {named}."
    one = max(common, key=lambda n: share.get(n, 0.0))
    others = [next(n for n in p.effects if n != one) for p in complete]
    part = f" {one} alone explains {share[one]:.0%}." if math.isfinite(share.get(one, math.nan)) else ""
    return (
        f"no single effect explains the residual, but {one} together with {' or with '.join(others)} leaves nothing."
        f"{part} Add {one}, calibrate and diagnose again."
    )


def doubt(pairs: Sequence[Pair]) -> str:
    """Why two effects that would leave nothing are not named; '' where there are none."""
    return next((f" {' with '.join(p.effects)} would leave nothing, but {p.but}." for p in pairs if p.but), "")
