"""Values that a calibration keeps, as rivals of effects.

A scene states more than is calibrated: where the camera stands and how wide it sees, how large the ball is that
presses, how smooth the skin. What is stated wrongly there is misfit too, and some effect of the library may take it up.
So once something is found, each of these values is freed by itself: first to first order, as an effect is scored, and
those that may explain as much as the best explanation are calibrated and held against it as explanations are
(`optics.diagnosis.competition`).

Not asked are values that captures state without an uncertainty, which are known; parameters of effects, which are asked
anyway; and what changes no image. Nothing is asked of readings of a table, nor of images that are estimated by Monte
Carlo: their derivatives share the error of the prediction."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from optics.diagnosis import statistics as st
from optics.diagnosis.competition import held_against
from optics.diagnosis.evidence import Candidate
from optics.diagnosis.explanations import Outcome, trial_of
from optics.diagnosis.refit import FAILURES, START, Case, further
from optics.diagnosis.thresholds import SHARE, SURE
from optics.fit.model import value_of
from optics.fit.scene_model import SceneModel
from optics.scene.declare import Effect
from optics.scene.parameter import Variable
from optics.words import spaced, with_sd

VALUE = Effect("another value", part="scene", parameters=())
VISIBLE = 3.0  # sd of an image, by which a plausible change must show in one frame to be asked about
FEW = 3  # values that are calibrated, the best by first order
# Roles that are not asked about: states of a part (a film that is taken out), and what effects ask about in other words
# (an error of a film's angle, an LED whose spectrum lies elsewhere)
OTHERWISE = ("inserted", "approach", "clock", "angle", "light wavelength", "light width")
PART = 0.5  # of the fall of the best explanation: values that reach it by first order are calibrated


@dataclass(frozen=True)
class FixedValue:
    """Another value of a parameter that the calibration keeps.

    kept, value, sd   in its unit; plausible: size of an error of it; fall: of chi2 with it free
    lead, needed   of the best explanation over it, and what a claim needs
    wins   whether it leads the best explanation by as much as another explanation needs
    """

    key: str
    unit: str
    kept: float
    value: float
    sd: float
    plausible: float
    fall: float
    lead: float
    needed: float
    wins: bool

    def text(self) -> str:
        """In words, to stand behind 'another value of'."""
        return f"{self.key} ({with_sd(self.value, self.sd, unit=self.unit)} in place of {self.kept:g})"

    def advice(self) -> str:
        """What to do."""
        unit = f", in {self.unit}" if spaced(self.unit) else ""
        return (
            f'state in captures.toml how well {self.key} is known ([parameters] "{self.key}" = {self.kept:g} and '
            f'[uncertainty] "{self.key}" = {self.plausible:g}{unit}; the first alone if it is exact), '
            "calibrate again, and diagnose"
        )


def best_of_fixed(case: Case, outcome: Outcome, excess: float) -> FixedValue | None:
    """The kept value that does best beside the outcome; None where none explains PART of what the best one does.

    excess   chi2 of the base less its degrees of freedom; 0 within noise"""
    model = case.model
    if case.evidence.is_table or not isinstance(model, SceneModel) or model.monte_carlo:
        return None
    variables = _acting(case, kept_values(model, case))
    try:
        fall, change, information = _first_order(case, variables)
    except FAILURES:
        return None
    least = max(PART * outcome.best.fall, SHARE * excess, outcome.scale)
    order = [i for i in np.argsort(-fall)[:FEW] if fall[i] > least]
    found = [_calibrated(case, outcome, variables[i], float(change[i]), float(information[i]), excess) for i in order]
    return min((f for f in found if f is not None), key=lambda f: f.lead, default=None)


def kept_values(model: SceneModel, case: Case) -> list[Variable]:
    """One variable for each number of a part that no calibration solves for and nobody states."""
    registry = model.scene.registry
    of_effects = {
        (kind, name)
        for e in registry.effects.values()
        for kind in registry.kinds(e.part)
        for name in (*e.parameter_names, *(p.name for p in e.shape))
    }
    free = {key for v in case.fit.variables for key in v.keys}
    stated = {key for f in case.fitted for key in (*model.frames[f].parameters, *model.frames[f].readings)}
    stated |= set(model.captures.parameters)
    found = []
    for name, part in model.scene.parts.items():
        for p in part.numbers.values():
            key = f"{name}.{p.name}"
            if key in free | stated or (part.kind, p.name) in of_effects or p.neutral is not None or p.linear:
                continue
            if key in model.parameters and p.role not in OTHERWISE:
                found.append(Variable(key, (key,), model.parameters[key]))
    return found


def _acting(case: Case, variables: Sequence[Variable]) -> list[Variable]:
    """Those whose plausible change shows in the frame of which most is left."""
    evidence = case.evidence
    i = int(np.argmax([float(np.mean(np.square(w))) for w in evidence.whitened]))
    found = []
    for v in variables:
        try:
            ((_, images),) = case.model.derivatives(case.fit.values, [v], [evidence.frames[i]], seed=evidence.seed)
        except FAILURES:  # what no calibration touched before may have no image beside its value
            continue
        if v.name in images:
            change = (images[v.name] / evidence.sigma[i])[evidence.use[i]] * v.parameter.plausible
            if np.isfinite(change).all() and np.linalg.norm(change) > VISIBLE:
                found.append(v)
    return found


def _first_order(case: Case, variables: Sequence[Variable]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(fall of chi2, change, information) of each variable by itself, everything else calibrated again."""
    evidence = case.evidence
    made = case.model.derivatives(case.fit.values, variables, [b.frame for b in evidence.blocks], seed=evidence.seed)

    def whitened() -> Iterator[np.ndarray]:
        for block, (_, images) in zip(evidence.blocks, made):
            none = np.zeros(len(block.r))
            own = [images[v.name].ravel()[block.index] / block.sigma if v.name in images else none for v in variables]
            yield np.stack(own, axis=1) if own else np.zeros((len(block.r), 0))

    projected, lengths = evidence.off_base(whitened(), len(variables))
    information = np.diag(projected.information)
    live = np.isfinite(information) & (information > st.VISIBLE * lengths)
    safe = np.where(live, information, 1.0)
    fall = np.where(live, projected.score**2 / safe, 0.0) * evidence.thinning
    return fall, np.where(live, projected.score / safe, 0.0), np.where(live, information, 0.0) * evidence.thinning


def _calibrated(
    case: Case, outcome: Outcome, v: Variable, change: float, information: float, excess: float
) -> FixedValue | None:
    """The value with everything else calibrated again; None without a result."""
    start = case.fit.values.copy()
    own = Candidate.at(case.model, start, VALUE, [v])
    own.cone = st.Cone(np.array([[information]]), own.sides)
    kept = value_of(case.model, start, v)
    start.put(v, float(np.clip(kept + START * change, *v.parameter.bounds)))
    try:
        found = further(case.model, [*case.base, v], start, list(case.fitted), negligible=case.negligible)
    except FAILURES:
        return None
    rival = trial_of(case, [own], found)
    (lead, needed), (ahead, most) = held_against(case, outcome, rival)
    return FixedValue(
        v.name,
        v.parameter.unit,
        kept,
        value_of(case.model, found.values, v),
        float(found.sd[[w.name for w in found.variables].index(v.name)]),
        v.parameter.plausible,
        rival.fall,
        lead,
        max(needed, SURE),
        ahead > most and rival.fall > SHARE * excess,
    )
