"""How far dials stop from what is written down, found from readings whose owner does not say it.

A film is turned by hand, or by an encoder, and each time it stops a little off its setting. The error of a reading is
then the slope of the signal along the dial times that of the setting: large on the flanks, none at the turning points.
Where it is left out, a bench of a good instrument has noise many times as large as is stated, and each of its settings
is an argument for some effect.

The width is found by restricted maximum likelihood, before any effect is chosen. Residuals r of the calibrated base
have the covariance

    V(w) = s^2 (1 + L L' + w^2 D D')

with D one column per setting of a dial, the slopes (whitened, per deg) of all readings that were taken at it; L what
may act besides, so that it does not count as dial error: the images of every effect at LOOSE plausible sizes, and
slow waves of a lamp or an amplifier along the session; s^2, at least 1, a noise that is larger than is stated. All
effects change slowly along a dial or along the session, and errors of single settings do not: that tells them apart.

Source: Patterson & Thompson, Recovery of inter-block information when block sizes are unequal, Biometrika 58, 545
(1971)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from optics.diagnosis import statistics as st
from optics.diagnosis.diagnose import choose
from optics.diagnosis.evidence import Candidate, Evidence, measure, silent
from optics.diagnosis.explanations import search
from optics.diagnosis.refit import Case, refit_each
from optics.diagnosis.score import score
from optics.fit import calibrate
from optics.fit.result import Fit
from optics.fit.scene_model import SceneModel
from optics.scene.declare import Effect
from optics.scene.parameter import Variable

LOOSE = 10.0  # plausible sizes that every effect may have, before it counts as dial error
WIDTHS = np.geomspace(1e-3, 10.0, 121)  # deg
NOTED = 4.0  # twice the log likelihood that errors must gain: in one of forty exact benches chance brings as much
PER_WAVE = 8  # readings per slow wave of the session
WAVES = 40  # slow waves, at most
ROWS = 400_000  # readings to keep: all
TOP = 5  # effects that are refitted, besides all that stand out
FEWEST = 8  # degrees of freedom from which a width is sought


@dataclass(frozen=True)
class Width:
    """Standard deviation of the settings of dials, deg; low, high: where the likelihood is a factor sqrt(e) below;
    gain: twice the log likelihood over that of exact dials."""

    sd: float
    low: float
    high: float
    gain: float

    @property
    def stated(self) -> float:
        """The standard deviation as it is written down, two figures."""
        return float(f"{self.sd:.2g}")


def unstated(model: SceneModel) -> list[str]:
    """The dials that readings turn, and whose errors captures do not state; one that is stated as 0 is exact."""
    turned: dict[str, set[float]] = {}
    for frame in model.frames if model.captures.table is not None else ():
        for key, values in {**frame.parameters, **frame.readings}.items():
            if model.parameters[key].unit == "deg" and model.parameters[key].how == "layer":
                turned.setdefault(key, set()).update(np.unique(values).tolist())
    return [key for key, values in turned.items() if len(values) > 1 and key not in model.stated_errors]


def width_of(
    model: SceneModel,
    fit: Fit,
    effects: Sequence[Effect],
    variables_of: Callable[[Effect], Sequence[Variable]],
    fitted: Sequence[int],
    *,
    refit: Callable[..., Fit] | None = None,
    seed: int = 0,
) -> Width | None:
    """The error that the settings of all unstated dials have; None where readings show none.

    It is sought about the calibrated base first. What a strong effect leaves beside its tangent would count as dial
    error: so it is sought again about the best explanation of the readings, in the noise that is stated, and the
    smaller of the two is returned.

    fit, effects, variables_of, fitted, refit, seed   as of `optics.diagnosis.diagnose.diagnose`
    """
    keys = unstated(model)
    if not keys:
        return None
    scored = score(model, fit, effects, variables_of, fitted, seed=seed)
    evidence, table = scored.evidence, scored.table
    first = _width_about(model, evidence, table.order, keys)
    if first is None:
        return None
    case = Case(model, fit, evidence, table, refit or calibrate.fit, [*fitted], [], variables_of, ROWS, seed, silent)
    chosen = choose(case, TOP)
    leader = search(case, chosen, refit_each(case, chosen)).leader
    if not leader.members:
        return first
    held = {c.effect.name for c in leader.members}
    others = [
        Candidate.at(model, leader.fit.values, c.effect, c.variables) for c in table.order if c.effect.name not in held
    ]
    base = [evidence.columns[i] for i in evidence.base] + [v for c in leader.members for v in c.variables]
    again = measure(model, leader.fit.values, base, others, list(fitted), ROWS, seed, silent)
    second = _width_about(model, again, others, keys)
    return second if second is None or second.sd < first.sd else first


def _width_about(
    model: SceneModel, evidence: Evidence, candidates: Sequence[Candidate], keys: Sequence[str]
) -> Width | None:
    """The width about calibrated values."""
    images = [_waves(model, evidence)]
    for c in candidates:
        if not c.broken:
            images += [evidence.dense(columns) * c.plausible for columns in c.forms.values()]
    residual = np.concatenate([block.r for block in evidence.blocks])
    errors = np.hstack([_errors(model, evidence, key) for key in keys])
    return most_likely(residual, evidence.dense(evidence.base), LOOSE * np.hstack(images), errors)


def most_likely(residual: np.ndarray, fitted: np.ndarray, beside: np.ndarray, errors: np.ndarray) -> Width | None:
    """The width of largest likelihood, see the module.

    residual  (n,) whitened;   fitted: (n, k) images of what was fitted;   beside: (n, l) L;   errors: (n, m) D
    """
    count = len(residual)
    taken = st.orthonormal(fitted)
    free = count - taken.shape[1]
    if free < FEWEST or not errors.any():
        return None
    rest = linalg.qr(taken)[0][:, taken.shape[1] :] if taken.shape[1] else np.eye(count)
    inner, spread = rest.T @ beside, rest.T @ errors
    # V(w)/s^2 is diagonal where U'(1 + L L')U = 1 and U' D D' U = diag(shares)
    shares, turn = linalg.eigh(spread @ spread.T, np.eye(free) + inner @ inner.T)
    square = (turn.T @ (rest.T @ residual)) ** 2
    widths = np.concatenate([[0.0], WIDTHS])
    ratios = 1 + widths[:, None] ** 2 * np.maximum(shares, 0.0)
    chi2, logs = (square / ratios).sum(1), np.log(ratios).sum(1)
    scale = np.maximum(chi2 / free, 1.0)
    likelihood = -(chi2 / scale + free * np.log(scale) + logs)
    best = int(np.argmax(likelihood))
    gain = float(likelihood[best] - likelihood[0])
    if gain < NOTED:
        return None
    own = widths * np.sqrt(scale)
    near = own[likelihood > likelihood[best] - 1]
    return Width(float(own[best]), float(near.min()), float(near.max()), gain)


def _waves(model: SceneModel, evidence: Evidence) -> np.ndarray:
    """(n, k) slow changes along the session, rms 1 in all: of an amplifier, and of a lamp."""
    order, signal = evidence.order(model), evidence.lit(model)
    rows, place = np.unique(order, return_inverse=True)
    count = min(max(len(rows) // PER_WAVE, 1), WAVES)
    waves = np.cos(np.pi * (place[:, None] + 0.5) / len(rows) * np.arange(1, count + 1)) * np.sqrt(2 / count)
    rms = float(np.sqrt(np.mean(np.square(signal))))
    return np.hstack([waves, waves * signal[:, None] / rms if rms > 0 else waves])


def _errors(model: SceneModel, evidence: Evidence, key: str) -> np.ndarray:
    """(n, m) whitened slope of each reading per deg of a dial, one column for each time that it was set."""
    settings, slopes = [], []
    for block in evidence.blocks:
        frame = model.frames[block.frame]
        own = {**frame.parameters, **frame.readings}.get(key, np.nan)
        settings.append(np.broadcast_to(np.asarray(own, float), frame.image.shape).reshape(-1)[block.index])
        slope = model.slopes(evidence.values, block.frame, {key: 1.0}).get(key, 0.0)
        slopes.append(np.broadcast_to(slope, frame.image.shape).reshape(-1)[block.index] / block.sigma)
    setting, slope = np.concatenate(settings), np.concatenate(slopes)
    places = np.argsort(evidence.order(model), kind="stable")
    made = np.empty(len(setting), int)
    made[places] = np.cumsum(np.diff(setting[places], prepend=np.nan) != 0) - 1
    return np.where(made[:, None] == np.arange(made.max() + 1), slope[:, None], 0.0)
