"""Noise that neighbouring readings share: how much less a session knows than its readings, counted one by one.

A lamp wanders, a dial keeps its error while several readings are taken, an amplifier drifts. Readings in the order in
which they were recorded then have the covariance

    C_ij = scale ((1 - share) [i = j] + share h_i h_j exp(-|t_i - t_j|/length))

in units of the variance that the noise model states, with the number t of a reading. h is 1, as of an amplifier, or
goes with the signal over its noise, as of a lamp (`kind`), rms 1 in both cases. A sum d'r of residuals has the variance
d'Cd where d'd was counted: the ratio is the design effect, by which falls of chi2 are divided before they are judged.
The numbers and the kind are found by restricted maximum likelihood: what was fitted is projected off, whatever it took.

The exponential is an Ornstein-Uhlenbeck process, which is Markov: a Kalman filter whitens n readings in n steps.

Source: Patterson & Thompson, Recovery of inter-block information when block sizes are unequal, Biometrika 58, 545
(1971); Harvey, Forecasting, structural time series models and the Kalman filter (1989), ch. 3.4."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optics.diagnosis import statistics as st

FEWEST = 12  # degrees of freedom from which a correlation is estimated
SHARES = np.array([0.01, 0.02, 0.04, 0.08, 0.13, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.88, 0.94, 0.98])
LENGTHS = 10  # tried, from one reading to half of the session
# Twice the gain of log likelihood at which a correlation counts: few white sessions exceed it, and these lose little.
NOTED = 4.0
KINDS = ("amplifier", "lamp")


@dataclass(frozen=True)
class Correlation:
    """scale, share, length and kind of C; gain: twice the log likelihood over that of white noise."""

    scale: float = 1.0
    share: float = 0.0
    length: float = 1.0
    gain: float = 0.0
    kind: str = KINDS[0]

    def design_effect(self, direction: np.ndarray, order: np.ndarray, signal: np.ndarray) -> float:
        """d'Cd/d'd of a whitened image d (n,) of readings with the numbers `order` (n,) and whitened signals
        `signal` (n,); at least 1."""
        total = float(direction @ direction)
        if not total > 0:
            return max(self.scale, 1.0)
        shared = 0.0
        if self.share > 0:
            places = np.argsort(order, kind="stable")
            d = (direction * _loading(self.kind, signal))[places]
            kept = np.exp(-np.diff(order[places].astype(float)) / self.length)
            shared, before = float(d @ d), 0.0
            for keep, last, value in zip(kept, d[:-1], d[1:]):
                before = keep * (before + last)
                shared += 2 * before * value
        return max(self.scale * (1 - self.share + self.share * shared / total), 1.0)


def estimate(residual: np.ndarray, fitted: np.ndarray, order: np.ndarray, signal: np.ndarray) -> Correlation:
    """The correlation of a whitened residual (n,) about the whitened images (n, k) that were fitted to it.

    order   (n,) numbers of the readings, in any order; signal: (n,) whitened. A correlation that noise alone makes
            (NOTED) is none
    """
    basis = st.orthonormal(fitted)
    free = len(residual) - basis.shape[1]
    left = residual - basis @ (basis.T @ residual)
    white = float(left @ left)
    if free < FEWEST or not white > 0:
        return Correlation(white / max(free, 1))
    places = np.argsort(order, kind="stable")
    columns, t = np.column_stack([basis, residual])[places], order[places].astype(float)
    lengths = np.geomspace(1.0, max(float(np.ptp(t)) / 2, 2.0), LENGTHS)
    share, length = (grid.ravel() for grid in np.meshgrid(SHARES, lengths))
    best, none = Correlation(white / free), free * np.log(white)
    for kind in KINDS:
        likely, scale = _likelihoods(columns, t, _loading(kind, signal)[places], share, length)
        gains = likely + none
        i = int(np.argmax(gains))
        if gains[i] > max(best.gain, NOTED):
            best = Correlation(float(scale[i]), float(share[i]), float(length[i]), float(gains[i]), kind)
    return best


def _loading(kind: str, signal: np.ndarray) -> np.ndarray:
    """h (n,), rms 1."""
    rms = float(np.sqrt(np.mean(np.square(signal)))) if len(signal) else 0.0
    return np.asarray(signal, float) / rms if kind == "lamp" and rms > 0 else np.ones(len(signal))


def _likelihoods(
    columns: np.ndarray, t: np.ndarray, load: np.ndarray, share: np.ndarray, length: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(twice the restricted log likelihood, scale) for each share and length (g,), up to a constant.

    columns   (n, k + 1): an orthonormal basis of what was fitted, and the residual, in the order of t
    """
    count, width = columns.shape
    state, spread = np.zeros((len(share), width)), np.ones(len(share))
    white, logs = np.empty((count, len(share), width)), np.zeros(len(share))
    keeps = np.exp(-np.diff(t, prepend=t[0])[:, None] / length)
    for i in range(count):
        keep = keeps[i]
        if keep[0] < 1:
            state, spread = state * keep[:, None], keep**2 * spread + 1 - keep**2
        variance = share * load[i] ** 2 * spread + 1 - share
        gain = spread * np.sqrt(share) * load[i] / variance
        surprise = columns[i] - (np.sqrt(share) * load[i])[:, None] * state
        white[i] = surprise / np.sqrt(variance)[:, None]
        logs += np.log(variance)
        state = state + gain[:, None] * surprise
        spread = spread * (1 - gain * np.sqrt(share) * load[i])
    products = np.einsum("igj,igk->gjk", white, white, optimize=True)
    fitted, own, across = products[:, :-1, :-1], products[:, -1, -1], products[:, :-1, -1]
    solved = np.linalg.solve(fitted, across[..., None])[..., 0] if width > 1 else across
    left = np.maximum(own - np.einsum("gk,gk->g", across, solved), 1e-300)
    free = count - (width - 1)
    determinant = np.linalg.slogdet(fitted)[1] if width > 1 else 0.0
    return -free * np.log(left) - logs - determinant, left / free
