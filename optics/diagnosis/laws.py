"""Other laws of the effects that a model has already: strengths that change slowly along a coordinate.

The library gives each effect one law. Where a bench follows another, such as a lamp that warms up and then stays, or a
dial that is squeezed as well as eccentric, the effect is right, and what it leaves looks like some second effect. So
each effect that was added is given a freer law, s + sum over k of s_k cos(pi k x) with x the rank of a coordinate
between 0 and 1, and competes with the explanations of what is left. `Law.cost` is what so many strengths could have
fitted (`optics.diagnosis.result.Fingerprint.cost`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from scipy.special import chdtrc
from scipy.stats import rankdata

from optics.diagnosis import fingerprints as prints
from optics.diagnosis import statistics as st
from optics.diagnosis.evidence import Evidence
from optics.diagnosis.result import Law
from optics.diagnosis.thresholds import MIMICS
from optics.fit.model import Model
from optics.scene.declare import Effect
from optics.scene.parameter import Variable

ORDERS = (2, 4, 8)  # cosines of a law, the first that score best
PER_NUMBER = 4  # values per number that is fitted, at least
ALWAYS = ("intensity", "channel")  # coordinates of readings that every law may run along, besides the settings


def other_laws(
    model: Model,
    evidence: Evidence,
    places: Sequence[dict[str, np.ndarray]],
    added: Sequence[Effect],
    variables_of: Callable[[Effect], Sequence[Variable]],
) -> list[Law]:
    """A freer law of each added effect along each coordinate, best score first.

    places   what `optics.diagnosis.fingerprints.places` returns
    """
    if not added:
        return []
    turned = set(prints.settings(model, evidence))
    common = set.intersection(*[set(p) for p in places])
    found = []
    for effect in added:
        keys = {key for v in variables_of(effect) for key in v.keys}
        own = [i for i in evidence.base if keys & set(evidence.columns[i].keys)]
        along = {*effect.acts, *((*turned, *ALWAYS) if evidence.is_table else ())}
        for coordinate in sorted((along & common) - {*MIMICS}) if own else []:
            laws = list(_laws(evidence, effect, own, coordinate, [p[coordinate] for p in places]))
            found += [max(laws, key=lambda law: law.score)] if laws else []
    return sorted(found, key=lambda law: -law.score)


def _laws(
    evidence: Evidence, effect: Effect, own: Sequence[int], coordinate: str, values: Sequence[np.ndarray]
) -> Iterator[Law]:
    """Laws of one effect along one coordinate, by the number of cosines."""
    x = np.concatenate(values)
    good = np.isfinite(x)
    levels = len(np.unique(x[good]))
    place = np.where(good, (rankdata(np.where(good, x, 0.0)) - 0.5) / len(x), 0.5)
    ends = np.cumsum([len(v) for v in values])[:-1]
    for order in ORDERS:
        order = min(order, levels - 1)
        room = evidence.normal.count - evidence.projected.rank
        if order < 1 or PER_NUMBER * order * len(own) > room:
            return
        waves = [np.cos(np.pi * k * place) * good for k in range(1, order + 1)]
        first = len(evidence.columns)
        normal = evidence.thinned(extra=order * len(own))
        for block, *curves in zip(evidence.blocks, *(np.split(w, ends) for w in waves)):
            images = block.columns(own)
            carriers = [images[:, i] * w for i in range(len(own)) for w in curves]
            st.add_bins(normal, block.where, block.middle, block.r, first, np.zeros(len(block.r), int), 1, carriers)
        rest = list(range(first, first + order * len(own)))
        projected = evidence.project(normal, evidence.base, rest, evidence.thinning)
        fall, dof, *_ = st.joint(projected, np.diag(normal.gram)[rest])
        if dof:
            yield Law(effect.name, coordinate, fall * evidence.thinning, dof, float(chdtrc(dof, fall)))
        if order == levels - 1:
            return
