"""Noise that neighbouring readings share: how much less a session knows than its readings, counted one by one.

A lamp wanders, a dial keeps its error while several readings are taken, an amplifier drifts. Readings in the order in
which they were recorded then have the covariance

    C_ij = scale ((1 - share) [i = j] + share exp(-|t_i - t_j|/length))

in units of the variance that the noise model states, with the number t of a reading. A sum d'r of residuals has the
variance d'Cd where d'd was counted: the ratio is the design effect, by which falls of chi2 are divided before they are
judged. The three numbers are found by restricted maximum likelihood, from what is left of the residual when everything
that was fitted is projected off.

Source: Patterson & Thompson, Recovery of inter-block information when block sizes are unequal, Biometrika 58, 545
(1971); the exponential term is an Ornstein-Uhlenbeck process."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from optics.diagnosis import statistics as st

LONGEST = 250  # readings of one piece of a session; pieces count as independent, so that the cost stays linear
FEWEST = 12  # degrees of freedom from which a correlation is estimated
SHARES = np.concatenate([[0.0], np.linspace(0.04, 0.96, 24), [0.98, 0.99]])
# Twice the gain of log likelihood at which a correlation counts: few white sessions exceed it, and these lose little.
NOTED = 4.0


@dataclass(frozen=True)
class Correlation:
    """scale, share and length of C; gain: twice the log likelihood over that of white noise of the same scale."""

    scale: float = 1.0
    share: float = 0.0
    length: float = 1.0
    gain: float = 0.0

    def design_effect(self, direction: np.ndarray, order: np.ndarray) -> float:
        """d'Cd/d'd of a whitened image d (n,) of readings with the numbers `order` (n,); at least 1."""
        total = float(direction @ direction)
        if not total > 0:
            return max(self.scale, 1.0)
        shared = 0.0
        if self.share > 0:
            for piece in _pieces(order):
                d, t = direction[piece], order[piece].astype(float)
                shared += float(d @ np.exp(-np.abs(t[:, None] - t) / self.length) @ d)
        return max(self.scale * (1 - self.share + self.share * shared / total), 1.0)


def estimate(residual: np.ndarray, fitted: np.ndarray, order: np.ndarray) -> Correlation:
    """The correlation of a whitened residual (n,) about the whitened images (n, k) that were fitted to it.

    order   (n,) numbers of the readings, in any order; a correlation that noise alone makes (NOTED) is none
    """
    pieces = []
    for piece in _pieces(order):
        basis = st.orthonormal(fitted[piece])
        free = len(piece) - basis.shape[1]
        if free >= FEWEST:
            pieces.append((np.linalg.qr(basis, mode="complete")[0][:, basis.shape[1] :], residual[piece], order[piece]))
    free = sum(n.shape[1] for n, *_ in pieces)
    if not pieces:
        return Correlation(scale=_scale(residual, fitted))
    left = [n.T @ r for n, r, _ in pieces]
    white = sum(float(z @ z) for z in left)
    if not white > 0:
        return Correlation(scale=0.0)
    best = Correlation(white / free)
    none = -free * np.log(white / free)
    span = max(float(np.ptp(t)) for *_, t in pieces)
    for length in np.geomspace(1.0, max(span / 4, 2.0), 8):
        spread, projected = [], []
        for (n, _, t), z in zip(pieces, left):
            values, vectors = np.linalg.eigh(n.T @ np.exp(-np.abs(t[:, None] - t).astype(float) / length) @ n)
            spread.append(values)
            projected.append((vectors.T @ z) ** 2)
        values, square = np.concatenate(spread), np.concatenate(projected)
        variances = np.maximum((1 - SHARES)[:, None] + SHARES[:, None] * values, 1e-9)
        scale = np.mean(square / variances, 1)
        gains = -free * np.log(scale) - np.log(variances).sum(1) - none
        i = int(np.argmax(gains))
        if gains[i] > max(best.gain, NOTED):
            best = Correlation(float(scale[i]), float(SHARES[i]), float(length), float(gains[i]))
    return best


def _scale(residual: np.ndarray, fitted: np.ndarray) -> float:
    """chi2 per degree of freedom of what is left of a residual."""
    basis = st.orthonormal(fitted)
    left = residual - basis @ (basis.T @ residual)
    return float(left @ left) / max(len(left) - basis.shape[1], 1)


def _pieces(order: np.ndarray) -> Iterator[np.ndarray]:
    """Places of the readings, in the order of their numbers, in pieces of at most LONGEST."""
    places = np.argsort(order, kind="stable")
    yield from np.array_split(places, max(1, -(-len(places) // LONGEST)))
