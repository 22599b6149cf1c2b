"""Other laws of the effects that a model has already: strengths that change slowly along a coordinate.

The library gives each effect one law. Where a bench follows another, such as a lamp that warms up and then stays, or a
dial that is squeezed as well as eccentric, the effect is right, and what it leaves looks like some second effect. So
each effect that was added is given a freer law, s + sum over k of s_k cos(pi k x) with x the rank of a coordinate
between 0 and 1, and competes with the explanations of what is left, of readings by the same deviance. `Law.cost` is
what so many strengths could have fitted (`optics.diagnosis.result.Fingerprint.cost`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from scipy.special import chdtrc
from scipy.stats import rankdata

from optics.diagnosis import fingerprints as prints
from optics.diagnosis import statistics as st
from optics.diagnosis.dials import unstated
from optics.diagnosis.evidence import Evidence
from optics.diagnosis.result import Law
from optics.diagnosis.session import Frames, Session
from optics.diagnosis.thresholds import MIMICS
from optics.fit.model import Model
from optics.fit.scene_model import SceneModel
from optics.scene.declare import Effect
from optics.scene.parameter import Variable

ORDERS = (2, 4, 8)  # cosines of a law, the first that score best
PER_NUMBER = 4  # values per number that is fitted, at least
ALWAYS = ("intensity", "channel")  # coordinates of readings that every law may run along, besides clocks

Judge = Callable[[Sequence[np.ndarray]], tuple[float, int, float]]


def other_laws(
    model: Model,
    evidence: Evidence,
    places: Sequence[dict[str, np.ndarray]],
    added: Sequence[Effect],
    variables_of: Callable[[Effect], Sequence[Variable]],
    scale: float,
    session: Session | Frames | None,
) -> list[Law]:
    """A freer law of each added effect along each coordinate, best score first.

    places   what `optics.diagnosis.fingerprints.places` returns
    scale    variance over the stated one, in which falls are judged beside noise that neighbours share
    session  whose readings, or frames, share noise; None: none is known to
    """
    if not added:
        return []
    turned = prints.settings(model, evidence)
    unknown = _frame_by_frame(model, evidence, turned)
    # of what was set, effects of the library differ in how they depend on it; what happened meanwhile is no effect
    clocks = {k for f in evidence.frames for k in model.frames[f].readings if model.parameters[k].role == "clock"}
    common = set.intersection(*[set(p) for p in places])
    judge = _fall_of_readings(evidence, session, scale) if session is not None else _fall_of_images(evidence)
    found = []
    for effect in added:
        keys = {key for v in variables_of(effect) for key in v.keys}
        own = [i for i in evidence.base if keys & set(evidence.columns[i].keys)]
        along = {*effect.acts, *((*clocks, *ALWAYS) if evidence.is_table else ())}
        for coordinate in sorted((along & common) - {*MIMICS} - unknown) if own else []:
            x = np.concatenate([p[coordinate] for p in places])
            laws = []
            for images in _strengths(evidence, own, x):
                fall, dof, plain = judge(images)
                if dof:
                    laws.append(Law(effect.name, coordinate, fall, dof, float(chdtrc(dof, max(fall, 0.0))), plain))
            found += [max(laws, key=lambda law: law.score)] if laws else []
    return sorted(found, key=lambda law: -law.score)


def _frame_by_frame(model: Model, evidence: Evidence, turned: Mapping[str, Sequence[float]]) -> set[str]:
    """Dials of images that stand elsewhere in each frame, by errors that captures do not state: a law along such a
    dial is a strength of each frame, and so is the error."""
    if evidence.is_table or not isinstance(model, SceneModel):
        return set()
    return {key for key in unstated(model) if len(set(turned.get(key, ()))) == len(evidence.frames)}


def _strengths(evidence: Evidence, own: Sequence[int], x: np.ndarray) -> Iterator[list[np.ndarray]]:
    """Per block, the images (n, k) of further strengths of the columns `own`, by the number of cosines along x (n,)."""
    good = np.isfinite(x)
    levels = len(np.unique(x[good]))
    place = np.where(good, (rankdata(np.where(good, x, 0.0)) - 0.5) / len(x), 0.5)
    ends = np.cumsum([len(block.r) for block in evidence.blocks])[:-1]
    room = evidence.normal.count - evidence.projected.rank
    for order in dict.fromkeys(min(order, levels - 1) for order in ORDERS):
        if order < 1 or PER_NUMBER * order * len(own) > room:
            return
        waves = np.cos(np.pi * place[:, None] * np.arange(1, order + 1)) * good[:, None]
        yield [
            (block.columns(own)[:, :, None] * wave[:, None, :]).reshape(len(block.r), -1)
            for block, wave in zip(evidence.blocks, np.split(waves, ends))
        ]


def _fall_of_images(evidence: Evidence) -> Judge:
    """(fall of chi2, dof, the same fall) of further images of each block."""

    def fall_of(images: Sequence[np.ndarray]) -> tuple[float, int, float]:
        projected, lengths = evidence.off_base(images, images[0].shape[1])
        fall, dof, *_ = st.joint(projected, lengths)
        return fall * evidence.thinning, dof, fall * evidence.thinning

    return fall_of


def _fall_of_readings(evidence: Evidence, session: Session | Frames, scale: float) -> Judge:
    """(fall of deviance, dof, fall of chi2 as if neighbours shared nothing), in units of the scale; the deviance from
    where the base stands, as effects fall: both are judged by other weights than those that it was fitted by."""
    base, r = evidence.dense(evidence.base), np.concatenate([block.r for block in evidence.blocks])
    rank, before = st.orthonormal(base).shape[1], session.about(r, base)

    def fall_of(images: Sequence[np.ndarray]) -> tuple[float, int, float]:
        whole = np.hstack([base, np.concatenate(images)])
        dof = st.orthonormal(whole).shape[1] - rank
        if not dof:
            return 0.0, 0, 0.0
        after = session.about(r, whole)
        return before.standing(scale) - after.deviance(scale), dof, (before.white - after.white) / scale

    return fall_of
