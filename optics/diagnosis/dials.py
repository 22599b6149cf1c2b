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

Of images that are taken one by one, a gain of each frame is as sudden as a dial. Its size is sought besides, and the
width has a prior: at the turning points of the light a dial shows nothing, and no dial is off by so much that half as
much light passes. Images have few settings, and all effects together would take up any error of a dozen: L holds one
effect at a time, or none, and the likeliest counts. Where films stand crossed in most images, slopes tell nothing: see
`optics.diagnosis.dials_at_extinction`.

Source: Patterson & Thompson, Recovery of inter-block information when block sizes are unequal, Biometrika 58, 545
(1971)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from optics.diagnosis import statistics as st
from optics.diagnosis.evidence import Candidate, Evidence, measure, silent
from optics.diagnosis.refit import FAILURES
from optics.diagnosis.score import base_variables, candidates_of
from optics.diagnosis.thresholds import EACH, USUAL
from optics.fit import calibrate
from optics.fit.result import Fit
from optics.fit.scene_model import SceneModel
from optics.scene.declare import Effect
from optics.scene.parameter import Variable

LOOSE = 10.0  # plausible sizes that every effect may have, before it counts as dial error
WIDTHS = np.concatenate([[0.0], np.geomspace(1e-3, 10.0, 361)])  # deg
SIZES = np.concatenate([[0.0], np.geomspace(0.1, 30.0, 26)])  # plausible sizes of what acts on each frame
BY_EYE = 0.5  # deg: of a dial that is read by eye on a scale in degrees
SCALES = 40  # sizes of the noise that are tried
NOTED = 1.0  # twice the log likelihood that errors must gain: chance brings as much on one of six exact benches, and
# the width that it finds there is small
PER_WAVE = 8  # readings per slow wave of the session
WAVES = 40  # slow waves, at most
ROWS = 400_000  # readings to keep: all
OFF = 0.1  # plausible sizes off neutral from which all effects start: some have no slope there
STEPS = 5  # linearisations of that fit
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
    """The dials of films and plates that readings or frames turn, and whose errors captures do not state; one that is
    stated as 0 is exact."""
    turned: dict[str, set[float]] = {}
    for frame in model.frames if model.renderer.layered else ():
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
    seed: int = 0,
) -> Width | None:
    """The error that the settings of all unstated dials have; None where readings show none.

    It is sought about the calibrated base first. What a strong effect leaves beside its tangent would count as dial
    error there. So it is sought again about a fit of all effects at once, each held by a prior of LOOSE plausible
    sizes, or, of images, where such a fit would take minutes, of the likeliest effect; and the smaller of the two is
    returned.

    fit, effects, variables_of, fitted, seed   as of `optics.diagnosis.diagnose.diagnose`
    """
    keys = unstated(model)
    if not keys:
        return None
    base, _ = base_variables(model, fit, fitted)
    candidates, _ = candidates_of(model, fit, effects, variables_of, fitted)
    evidence = measure(model, fit.values, base, candidates, fitted, ROWS, seed, silent)
    first, acting = _width_about(model, evidence, candidates, keys)
    if first is None or not acting:
        return first
    values, held = fit.values.copy(), {}
    for c in acting:
        for v, start, size, usual in zip(c.variables, c.start, c.plausible, c.usual):
            if v.name not in held:  # two effects may free the same variable
                held[v.name] = v.with_prior(float(start), LOOSE * float(size))
                values.put(v, float(np.clip(start + OFF * usual, *v.parameter.bounds)))
    try:
        found = calibrate.fit(model, [*base, *held.values()], values, fitted, max_iterations=STEPS)
    except FAILURES:
        return first
    others = [Candidate.at(model, found.values, c.effect, c.variables) for c in candidates if not c.broken]
    again = measure(model, found.values, base, others, fitted, ROWS, seed, silent)
    second, _ = _width_about(model, again, others, keys)
    return second if second is None or second.sd < first.sd else first


def _width_about(
    model: SceneModel, evidence: Evidence, candidates: Sequence[Candidate], keys: Sequence[str]
) -> tuple[Width | None, list[Candidate]]:
    """(the width about calibrated values, the effects that may act besides: of readings all, of images the likeliest,
    if any)."""
    # of images, what has a strength for each frame is sought beside the width, as a gain
    acting = [c for c in candidates if not c.broken and (evidence.is_table or c.effect.scope != "frame")]
    known = [i for c in acting for columns in c.forms.values() for i in columns]
    sizes = np.concatenate([*(LOOSE * c.plausible for c in acting for _ in c.forms), []])
    slow, errors = _slow(model, evidence), [_errors(model, evidence, key) for key in keys]
    ends = np.cumsum([0, *(len(block.r) for block in evidence.blocks)])
    first, beside = len(evidence.base), len(evidence.base) + len(known)
    width = beside + sum(part.shape[1] for part in (slow, *errors))
    gram, score = np.zeros((width, width)), np.zeros(width)
    for block, start, end in zip(evidence.blocks, ends, ends[1:]):
        own = [part[start:end].toarray() for part in (slow, *errors)]
        columns = np.hstack([block.columns([*evidence.base]), block.columns(known) * sizes, *own])
        there = np.flatnonzero(columns.any(0))
        gram[np.ix_(there, there)] += columns[:, there].T @ columns[:, there]
        score[there] += columns[:, there].T @ block.r
    square = sum(float(block.r @ block.r) for block in evidence.blocks)
    found, sized = Products(gram, score, square, int(ends[-1])), beside + slow.shape[1]
    if evidence.is_table:
        return most_likely([found.likelihood(first, sized)]), acting
    # a few images have fewer settings than there are effects, which would take up any error together
    places = first + np.cumsum([0, *(sum(map(len, c.forms.values())) for c in acting)])
    alone = [range(first, first), *map(range, places, places[1:])]
    found_with: list[tuple[Profile, list[Candidate]]] = []
    for i, one in enumerate(alone):
        part = found.of_columns([*range(first), *one, *range(beside, width)])
        profile = part.likelihood(first, first + len(one), first + len(one) + slow.shape[1], EACH * bool(one))
        if profile is not None:
            found_with.append((profile, acting[i - 1 : i] if i else []))
    _, likeliest = max(found_with, key=lambda f: float(f[0].likelihood.max()), default=(None, []))
    return most_likely([profile for profile, _ in found_with]), likeliest


@dataclass(frozen=True)
class Profile:
    """Twice the log likelihood of widths, deg; several of each, by what else is sought."""

    likelihood: np.ndarray
    widths: np.ndarray


def most_likely(profiles: Sequence[Profile | None]) -> Width | None:
    """The width of largest likelihood, whatever of several sets of effects acts besides; None where exact dials are as
    likely."""
    known = [p for p in profiles if p is not None]
    if not known:
        return None
    likelihood, widths = (np.concatenate(arrays) for arrays in zip(*((p.likelihood, p.widths) for p in known)))
    best = int(np.argmax(likelihood))
    gain = float(likelihood[best] - likelihood[widths == 0].max())
    if gain < NOTED:
        return None
    near = widths[likelihood > likelihood[best] - 1]  # the profile's interval
    return Width(float(widths[best]), float(near.min()), float(near.max()), gain)


@dataclass(frozen=True)
class Products:
    """Of images X (n, k) and a residual r (n,), whitened: gram X'X, score X'r, square r'r, count n."""

    gram: np.ndarray
    score: np.ndarray
    square: float
    count: int

    @classmethod
    def of(cls, images: np.ndarray, residual: np.ndarray) -> Products:
        return cls(images.T @ images, images.T @ residual, float(residual @ residual), len(residual))

    def of_columns(self, columns: Sequence[int]) -> Products:
        return Products(self.gram[np.ix_(columns, columns)], self.score[columns], self.square, self.count)

    def likelihood(self, fitted: int, beside: int, sized: int | None = None, cost: float = 0.0) -> Profile | None:
        """Of the covariance of the module: columns before `fitted` were fitted, those before `beside` are L, those
        before `sized` are L by a size that is sought too, in units of theirs; the others D. None where there is nothing
        to tell a width by.

        A size that is sought is as likely as the strength of an effect (`optics.diagnosis.explanations`); cost: what
        the effects of L cost besides."""
        sized = beside if sized is None else sized
        inverse, rank = st.inverse(self.gram[:fitted, :fitted])
        across = self.gram[fitted:, :fitted] @ inverse
        information = self.gram[fitted:, fitted:] - across @ self.gram[:fitted, fitted:]
        score = self.score[fitted:] - across @ self.score[:fitted]
        chi2 = self.square - float(self.score[:fitted] @ inverse @ self.score[:fitted])
        free, first = self.count - rank, sized - fitted
        # what a fit takes up but for rounding, as a leak does a lamp behind crossed films, is not seen
        seen = np.diag(information) > st.VISIBLE * np.diag(self.gram)[fitted:]
        information, score = information * np.outer(seen, seen), score * seen
        if free < FEWEST or not np.diag(information)[first:].any():
            return None
        sizes = SIZES if sized > beside else np.ones(1)
        found = []
        for size in sizes:
            scale = np.ones(len(score))
            scale[beside - fitted : first] = size
            found.append(Products(information * np.outer(scale, scale), score * scale, chi2, free).reduced(first))
        scales = np.geomspace(1.0, max(max(float(left[0]) for left, _ in found) / free, 1.0) * 2, SCALES)
        likelihood = np.array([-(left / scales[:, None] + free * np.log(scales)[:, None] + log) for left, log in found])
        widths = np.sqrt(WIDTHS**2 * scales[:, None])  # (scale, width)
        if sized > beside:
            likelihood -= 3 * np.log1p(sizes**2 / 2)[:, None, None] + unlikely(widths)
        return Profile(likelihood.ravel() - cost, np.broadcast_to(widths, likelihood.shape).ravel())

    def reduced(self, first: int) -> tuple[np.ndarray, np.ndarray]:
        """(chi2, ln det) for each of WIDTHS, at the scale 1, columns before `first` being L and the others D; ln det
        but for what all sets of the same columns share."""
        # of alike images that are 1e9 times larger than noise, rounding leaves no difference, nor its sign
        beside = np.eye(first) + self.gram[:first, :first]
        inverse, _ = st.inverse(beside)
        mixed = inverse @ self.gram[:first, first:]
        chi2 = self.square - float(self.score[:first] @ inverse @ self.score[:first])
        shares, turn = np.linalg.eigh(self.gram[first:, first:] - self.gram[first:, :first] @ mixed)
        square = (turn.T @ (self.score[first:] - mixed.T @ self.score[:first])) ** 2
        ratios = 1 + WIDTHS[:, None] ** 2 * np.maximum(shares, 0.0)
        return chi2 - (square * WIDTHS[:, None] ** 2 / ratios).sum(1), np.log(ratios).sum(1) + _log_det(beside)


def unlikely(width: float | np.ndarray) -> float | np.ndarray:
    """-2 ln of the prior density of a width, deg. It is a Gaussian's, not Student's as of the strength of an effect:
    whoever turns a dial reads it."""
    return np.square(width / BY_EYE)


def _log_det(matrix: np.ndarray) -> float:
    return float(np.linalg.slogdet(matrix)[1])


def _slow(model: SceneModel, evidence: Evidence) -> csr_array:
    """(n, k) what a lamp or an amplifier may do besides. Of readings, slow waves along the session, rms 1 LOOSE noises
    in all; of frames, a gain of each, of USUAL."""
    order, signal = evidence.order(model), evidence.lit(model)
    rows, place = np.unique(order, return_inverse=True)
    if not evidence.is_table:
        return csr_array((USUAL * signal, (np.arange(len(signal)), place)), shape=(len(signal), len(rows)))
    count = min(max(len(rows) // PER_WAVE, 1), WAVES)
    waves = np.cos(np.pi * (place[:, None] + 0.5) / len(rows) * np.arange(1, count + 1)) * np.sqrt(2 / count)
    rms = float(np.sqrt(np.mean(np.square(signal))))
    return csr_array(LOOSE * np.hstack([waves, waves * signal[:, None] / rms if rms > 0 else waves]))


def _errors(model: SceneModel, evidence: Evidence, key: str) -> csr_array:
    """(n, m) whitened slope of each value per deg of a dial, one column for each time that it was set."""
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
    return csr_array((slope, (np.arange(len(slope)), made)), shape=(len(slope), int(made.max()) + 1))
