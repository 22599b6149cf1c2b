"""Values that a calibration keeps, as rivals of effects.

A scene states more than is calibrated: where the camera stands and how wide it sees, how large the ball is that
presses, how smooth the skin. What is stated wrongly there is misfit too, and some effect of the library may take it up.
So once something is found, each of these values is freed by itself: first to first order, as an effect is scored, and
those that may explain as much as the best explanation are calibrated and held against it by the score of
`optics.diagnosis.explanations`.

Not asked are values that captures state without an uncertainty, which are known; parameters of effects, which are asked
anyway; and what changes no image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optics.diagnosis import statistics as st
from optics.diagnosis.competition import design_effect
from optics.diagnosis.evidence import Candidate, Evidence
from optics.diagnosis.explanations import Outcome, Trial, cost_of
from optics.diagnosis.refit import FAILURES, Case, chi2, further
from optics.fit.model import value_of
from optics.fit.result import Fit
from optics.fit.scene_model import SceneModel
from optics.scene.declare import Effect
from optics.scene.parameter import Variable
from optics.words import spaced, with_sd

VALUE = Effect("another value", part="scene", parameters=())
VISIBLE = 3.0  # sd of an image, by which a plausible change must show in one frame to be asked about
FEW = 3  # values that are calibrated, the best by first order
# Roles of what is a state and no measure, and of what effects ask about in other words: an error of a film's angle, an
# LED whose spectrum lies elsewhere.
OTHERWISE = ("inserted", "approach", "clock", "angle", "light wavelength", "light width")
PART = 0.5  # of what the best explanation explains, by first order, from which they are


@dataclass(frozen=True)
class FixedValue:
    """Another value of a parameter that the calibration keeps.

    kept, value, sd   in its unit; plausible: size of an error of it; fall: of chi2 with it free
    lead   of the best explanation's score over it
    """

    key: str
    unit: str
    kept: float
    value: float
    sd: float
    plausible: float
    fall: float
    lead: float

    def text(self) -> str:
        """In words, to stand behind 'another value of'."""
        return f"{self.key} ({with_sd(self.value, self.sd, unit=self.unit)} in place of {self.kept:g})"

    def advice(self) -> str:
        """What to do."""
        return (
            f'state in captures.toml how well {self.key} is known ([parameters] "{self.key}" = {self.kept:g} and '
            f'[uncertainty] "{self.key}" = {self.plausible:g}{spaced(self.unit)}, or the first alone if it is exact), '
            "calibrate again, and diagnose"
        )


def best_of_fixed(case: Case, outcome: Outcome) -> FixedValue | None:
    """The kept value that does best beside the outcome; None where none explains PART of what the best one does."""
    model = case.model
    if case.evidence.is_table or not isinstance(model, SceneModel) or model.monte_carlo:
        return None
    variables = _acting(case, kept_values(model, case))
    if not variables:
        return None
    fall, change = _first_order(case, variables)
    order = [i for i in np.argsort(-fall)[:FEW] if fall[i] > max(PART * outcome.best.fall, outcome.scale)]
    found = [_calibrated(case, outcome, variables[i], float(change[i])) for i in order]
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
    frame = evidence.frames[int(np.argmax([float(np.mean(np.square(w))) for w in evidence.whitened]))]
    seen = np.array([_lengths(case, [v], frame)[0] for v in variables])
    return [v for v, length in zip(variables, seen) if length > VISIBLE]


def _lengths(case: Case, variables: Sequence[Variable], frame: int) -> list[float]:
    """Length of the change of one frame by a plausible change of each variable, in sd."""
    ((_, images),) = case.model.derivatives(case.fit.values, variables, [frame], seed=case.seed)
    sigma, use = next((s, u) for f, s, u in zip(*_frames(case.evidence)) if f == frame)
    return [
        float(np.linalg.norm((images[v.name] / sigma)[use])) * v.parameter.plausible if v.name in images else 0.0
        for v in variables
    ]


def _frames(evidence: Evidence) -> tuple[Sequence, ...]:
    return evidence.frames, evidence.sigma, evidence.use


def _first_order(case: Case, variables: Sequence[Variable]) -> tuple[np.ndarray, np.ndarray]:
    """(fall of chi2, change) of each variable by itself, everything else calibrated again."""
    evidence, first = case.evidence, len(case.evidence.columns)
    normal = evidence.thinned(extra=len(variables))
    made = case.model.derivatives(case.fit.values, variables, evidence.frames, seed=case.seed)
    of = {frame: images for frame, (_, images) in zip(evidence.frames, made)}
    for block in evidence.blocks:
        none = np.zeros(len(block.r))
        own = [
            of[block.frame][v.name].ravel()[block.index] / block.sigma if v.name in of[block.frame] else none
            for v in variables
        ]
        st.add_bins(normal, block.where, block.middle, block.r, first, np.zeros(len(block.r), int), 1, own)
    columns = list(range(first, first + len(variables)))
    projected = evidence.project(normal, evidence.base, columns, evidence.thinning)
    information, lengths = np.diag(projected.information), np.diag(normal.gram)[columns]
    live = information > st.VISIBLE * lengths
    safe = np.where(live, information, 1.0)
    fall = np.where(live, projected.score**2 / safe, 0.0) * evidence.thinning
    return fall, np.where(live, projected.score / safe, 0.0)


def _calibrated(case: Case, outcome: Outcome, v: Variable, change: float) -> FixedValue | None:
    """The value with everything else calibrated again; None without a result."""
    start = case.fit.values.copy()
    kept = value_of(case.model, start, v)
    start.put(v, float(np.clip(kept + change, *v.parameter.bounds)))
    try:
        found = further(case.model, [*case.base, v], start, list(case.fitted), negligible=case.negligible)
    except FAILURES:
        return None
    left, expected, images = chi2(case, found.values)
    after = left + case.prior_chi2(found.values)
    own = Candidate.at(case.model, case.fit.values, VALUE, [v])
    rival = Trial([own], found, case.before - after, after, expected, images)
    rival.cost = cost_of(case, rival.members, found)
    return FixedValue(
        v.name,
        v.parameter.unit,
        kept,
        value_of(case.model, found.values, v),
        _sd(found, v),
        v.parameter.plausible,
        rival.fall,
        _lead(case, outcome, rival),
    )


def _lead(case: Case, outcome: Outcome, rival: Trial) -> float:
    """Of the best explanation's score over the rival's."""
    best = outcome.best
    data = (chi2(case, rival.fit.values)[0] - chi2(case, best.fit.values)[0]) / outcome.scale
    if best.members:
        data /= design_effect(case, outcome, best, rival)
    priors = case.known_chi2(rival.fit.values) - case.known_chi2(best.fit.values)
    return data + priors + rival.cost - best.cost


def _sd(found: Fit, v: Variable) -> float:
    return float(found.sd[[w.name for w in found.variables].index(v.name)])
