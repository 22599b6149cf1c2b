"""Pairs of effects, ranked by the linear fall of chi2 that both make together, T = u' V^-1 u over the columns of both.
`shortfall` says what the refits of each alone fell short of their own T: so much less is expected of a pair.

One of the two stands out by itself. The other need not: beside a strong effect a weak one may ask for a sign that it
cannot have, as a haze beside a bent response did, which explained nothing alone and 45,000 of chi2 with it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, product

import numpy as np

from optics.diagnosis import statistics as st
from optics.diagnosis.evidence import Candidate, Evidence
from optics.diagnosis.thresholds import CLEAR, MARGIN

CONSIDERED = 10  # effects, the best by themselves, each with all others: some 500 pairs
REFITTED = 8  # pairs at most: each costs a calibration
# Of the fall: by how much two effects must do better than one to be refitted, and one that does not stand out by itself
# beside another to be asked for
LEAD = MARGIN / 4


def ranked(
    evidence: Evidence, candidates: Sequence[Candidate], others: Sequence[Candidate] = ()
) -> list[tuple[float, Candidate, Candidate, np.ndarray]]:
    """(expected fall less its degrees of freedom, a, b, coefficients of both), best first: of pairs of candidates, and
    of each of these with each of the others that stands out beside it."""
    # where an effect lies within another one, that one is tried
    candidates = [a for a in candidates if not any(a.contains(d) for d in candidates)]
    others = [b for b in others if not any(b.contains(d) for d in (*candidates, *others))]
    found = [joint for a, b in combinations(candidates, 2) if (joint := _both(evidence, a, b))]
    for a, b in product(candidates, others):
        joint = _both(evidence, a, b)
        if joint and joint[0] - a.row.net > max(CLEAR, LEAD * a.row.net):
            found.append(joint)
    return sorted(found, key=lambda t: -t[0])


def _both(evidence: Evidence, a: Candidate, b: Candidate) -> tuple[float, Candidate, Candidate, np.ndarray] | None:
    """See `ranked`; None for effects that share a strength, or would need one beyond a bound."""
    if {key for v in a.variables for key in v.keys} & {key for v in b.variables for key in v.keys}:
        return None
    projected = evidence.projected
    own = np.array([*a.columns, *b.columns]) - len(evidence.base)
    live = np.array([*a.cone.live, *(len(a.columns) + b.cone.live)])
    seen = own[live]  # where the projection left only rounding, no fall is expected
    inverse, rank = st.inverse(projected.information[np.ix_(seen, seen)], st.VISIBLE)
    linear = np.zeros(len(own))
    linear[live] = inverse @ projected.score[seen]
    if not all(s * x >= 0 for s, x in zip([*a.sides, *b.sides], linear) if s):
        return None
    return float(projected.score[own] @ linear) - rank, a, b, linear


def shortfall(members: Sequence[Candidate]) -> float:
    """How much less than their scores promised the refits of effects by themselves brought, 0 without refits: of an
    image that is far from proportional to its strength, a pair does not keep the promise either."""
    return sum(max(c.row.fall - c.row.refit.fall, 0.0) for c in members if c.row.refit is not None)
