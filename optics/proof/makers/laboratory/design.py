"""What a session can tell, by the maker's own formulas: fits of what is hidden by the owner's bench, and by the bench
with every other cause."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import brentq, least_squares
from scipy.stats import norm

from optics.proof.makers.laboratory.bench import PLAIN, Bench
from optics.proof.makers.laboratory.causes import CAUSES, Groups, both
from optics.proof.makers.laboratory.session import Session

DONE = 1e-6  # chi2 per value of a fit that need not be tried from another start
TWIN = 1e-4  # of the chi2 that a hidden cause makes, left by another cause: nothing in the session tells them apart
STARTS = 2
MOST = 90  # readings that stand for all in a fit: of more, so many at random
SIZES = {
    "zero": 3.0,
    "scale": 0.02,
    "slack": 2.0,
    "eccentric": 1.0,
    "plate": 30.0,
    "dark": 20.0,
    "drift": 0.01,
}  # of one step; else 0.05


def kept(session: Session) -> np.ndarray:
    """Indices of MOST readings of a session, or of all."""
    if session.count <= MOST:
        return np.arange(session.count)
    return np.sort(np.random.default_rng(17).permutation(session.count)[:MOST])


def thinned(session: Session) -> Session:
    """The readings that are kept, as a session."""
    keep = kept(session)
    return replace(session, settings={key: column[keep] for key, column in session.settings.items()})


def fit(session: Session, hidden: Bench, causes: Sequence[str] = (), sd: np.ndarray | None = None) -> float:
    """chi2 that the owner's bench leaves of a hidden bench's signal, with the causes in it: lamp, unknown zeros, and
    all strengths free.

    sd   of the readings of `thinned(session)`, each by itself; None: the covariance of the hidden bench"""
    whole, session = session, thinned(session)
    signal = session.mean(hidden)
    white = None if sd is not None else np.linalg.inv(np.linalg.cholesky(whole.covariance(hidden, kept(whole))))
    sd = session.sd(hidden) if sd is None else sd
    groups: Groups = tuple((f"power_{band}",) for band in range(len(session.bands)))
    groups += tuple((name,) for name in session.free)
    low, high = [-math.inf] * len(groups), [math.inf] * len(groups)
    for cause in causes:
        own = CAUSES[cause].groups(session.turned)
        own = tuple(g for g in own if not set(g) & {n for group in groups for n in group})
        groups += own
        low += [CAUSES[cause].low] * len(own)
        high += [CAUSES[cause].high] * len(own)
    sizes = np.array([next((s for k, s in SIZES.items() if k in g[0]), 0.05) for g in groups])
    rng, best = np.random.default_rng(31), math.inf
    plain = session.mean({})
    level = (signal * plain / sd**2).sum(0) / np.maximum((plain**2 / sd**2).sum(0), 1e-300)  # of the lamp, per band
    bright = (np.clip(level, 0.1, 10) - 1) * session.power / sizes[: len(level)]

    def left(x: np.ndarray) -> np.ndarray:
        hidden = both(*({name: PLAIN[name] + value * s for name in g} for g, value, s in zip(groups, x, sizes)))
        if white is not None:
            return white @ np.ravel(session.mean(hidden) - signal)
        return np.ravel((session.mean(hidden) - signal) / sd)

    bounds = np.array(low) / sizes, np.array(high) / sizes
    for turn in range(STARTS):
        start = np.zeros(len(groups))
        if turn or causes:
            start = start + (0.1 if not turn else 2.0) * np.abs(rng.standard_normal(len(groups)))
        start[: len(session.bands)] = bright
        start = np.clip(start, bounds[0] + 1e-6, bounds[1] - 1e-6)
        best = min(best, 2 * least_squares(left, start, bounds=bounds, max_nfev=40, xtol=1e-9, ftol=1e-9).cost)
        if best < DONE * signal.size:
            break
    return best if white is not None else best * whole.count / session.count


def snr(session: Session, hidden: Bench) -> float:
    """Rms change per value after the best fit of the owner's bench, over the noise of a value by itself."""
    return math.sqrt(fit(session, hidden, sd=thinned(session).sd({})) / (session.count * len(session.bands)))


def size_of(session: Session, part: Callable[[float], Bench], most: float, wanted: float) -> float:
    """Size of a cause, `part(size)` on the bench, at which it has this signal to noise ratio; inf where no bench has so
    much of it."""

    def excess(logarithm: float) -> float:
        return math.log(max(snr(session, part(math.exp(logarithm))), 1e-9) / wanted)

    if excess(math.log(most)) < 0:
        return math.inf
    lowest = math.log(most) - 12
    return 0.0 if excess(lowest) > 0 else math.exp(brentq(excess, lowest, math.log(most), xtol=0.02))


# of a camera with analysers on its pixels, whose film is the bench's middle one; the first five of it alone
ON_PIXELS = (
    "site gain",
    "site extinction",
    "site misalignment",
    "film misalignment",
    "film leak",
    "camera gamma",
    "residual response curve",
    "dark offset",
    "stray light",
    "depolarization",
    "retardance",
    "dichroism",
    "gain drift",
)


def rivals(session: Session) -> list[str]:
    """Causes that a session knows of: those of its parts."""
    found = [c for c in CAUSES if c not in ("colour crosstalk", "coloured leak") or len(session.bands) > 1]
    if "region" in session.settings:
        found = [c for c in found if c in ON_PIXELS]
    else:
        found = [c for c in found if c not in ON_PIXELS[:5]]
    if "frame" not in session.settings:
        found = [c for c in found if c not in ("lens vignetting", "gain drift")]
    elif "camera.gain" in session.fixed:
        found = [c for c in found if c != "gain drift"]
    if "source.time" not in session.settings:
        found = [c for c in found if c != "source drift"]
    if not any(key.endswith(".approach") for key in session.settings):
        found = [c for c in found if c != "servo backlash"]
    if "sample" in session.absent:
        found = [c for c in found if c not in ("depolarization", "retardance", "stress birefringence", "dichroism")]
    return [c for c in found if c not in session.exclude]


def gaps(session: Session, hidden: Bench, true: Sequence[str]) -> dict[str, float]:
    """{other cause: expected chi2 by which what is hidden is better}: D, as far as the sets of strengths go."""
    return {c: fit(session, hidden, [c]) for c in rivals(session) if c not in true}


def correct(gap: float) -> float:
    """P(correct) = Phi(sqrt(D)/2)."""
    return float(norm.cdf(math.sqrt(max(gap, 0.0)) / 2))
