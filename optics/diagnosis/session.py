"""The readings of a table as a session: in the order in which they were taken, with the errors that some of them share.

Readings at one setting of a dial share its error, and so do the channels of one reading. The noise model weighs them as
independent, with an error that is larger by the root of their number (`optics.captures.capture_set.sweeps`). Here they
have the covariance that they really have, about one setting

    V_ij = [i = j] (1 - sum over dials of u_i^2) + sum over dials of u_i u_j / n

with u_i the share of the noise of a reading that comes from a dial, as it is weighed, and n readings at that setting.
Residuals and images are whitened by it before neighbours are asked what they share besides
(`optics.diagnosis.correlation`). What is known of variables beforehand counts as further readings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy import linalg

from optics.diagnosis import statistics as st
from optics.diagnosis.correlation import Correlation, Readings, of_rms_1, whitened
from optics.diagnosis.evidence import Evidence, known_products
from optics.fit.model import Model

APART = 0.3  # frames: what they do not share is one of each
# From which it is asked what a lamp did in each. Of six frames, four of them fitted, a lamp that wandered by a percent
# was claimed as the wobble of an analyser while more were needed.
FEWEST_FRAMES = 3
LEAST = 1e-3  # of the noise of a reading: what its instrument brings, at least
MOST = 64  # values that share an error, beyond which they are left as they are


class Session:
    """Of the kept readings of a table, in the order of the evidence's blocks.

    most   of the signal, rms: what noise that neighbours share may be"""

    most = math.inf

    def __init__(self, model: Model, evidence: Evidence):
        self.order = evidence.order(model).astype(float)
        self.known = evidence.precision, evidence.pull
        self.parts = _shared_errors(model, evidence)
        self.loads = {
            "amplifier": np.concatenate([1 / block.sigma for block in evidence.blocks]),
            "lamp": evidence.lit(model),
        }
        self.loads = {kind: self.apart(load[:, None])[:, 0] for kind, load in self.loads.items()}
        for index, _ in self.parts:
            self.order[index] = self.order[index].mean()

    def apart(self, columns: np.ndarray) -> np.ndarray:
        """(n, k) whitened by what readings of one setting share."""
        found = np.array(columns, float)
        for index, turn in self.parts:
            found[index] = turn @ found[index]
        return found

    def about(
        self, residual: np.ndarray, fitted: np.ndarray, known: tuple[np.ndarray, np.ndarray] | None = None
    ) -> Readings:
        """Readings about an explanation: residual (n,) and images (n, k), whitened.

        known   precision and pull of the first columns (`optics.diagnosis.evidence.priors`); None: the base's"""
        whole = self.apart(np.column_stack([fitted, residual]))
        precision, pull = known or self.known
        beside = known_products(precision, pull, fitted.shape[1])
        own = np.flatnonzero(precision)
        return Readings(
            whole[:, -1], whole[:, :-1], self.order, self.loads, beside, len(own), most=self.most, known=own
        )

    def independent(self, columns: np.ndarray, noise: Correlation) -> np.ndarray:
        """(n, k) images as of readings that are independent, in units of their noise: what is new in each of them."""
        apart = self.apart(columns) / np.sqrt(noise.scale)
        if not noise.power:
            return apart
        places = np.argsort(self.order, kind="stable")
        load = of_rms_1(self.loads[noise.kind])[places]
        power, length = np.array([noise.power]), np.array([noise.length])
        found = np.empty_like(apart)
        found[places] = whitened(apart[places], self.order[places], load, power, length)[0][:, 0]
        return found


class Frames:
    """Images as a session: what the lamp, or an exposure, does to a whole frame is shared by its pixels.

    The part of a residual along the signal of its frame is one reading, with the load |g| of its whitened signal g;
    what is across shares nothing.

    most   as of `Session`"""

    most = math.inf

    def __init__(self, model: Model, evidence: Evidence):
        signal = np.split(evidence.lit(model), np.cumsum([len(block.r) for block in evidence.blocks])[:-1])
        self.signal = [g / max(float(np.linalg.norm(g)), 1e-12) for g in signal]
        self.thinning = evidence.thinning
        self.known = evidence.precision, evidence.pull
        self.loads = {"lamp": np.array([np.linalg.norm(g) for g in signal]) * np.sqrt(evidence.thinning)}

    def about(
        self, residual: np.ndarray, fitted: np.ndarray, known: tuple[np.ndarray, np.ndarray] | None = None
    ) -> Readings:
        """As of `Session`: the dial of a frame that is known to a degree does not take up what a lamp did there."""
        along, across = self._parts(residual, fitted)
        order, more = np.arange(len(along)), self.thinning * len(residual) - len(along)
        precision, pull = known or self.known
        across += known_products(precision, pull, fitted.shape[1])
        own = np.flatnonzero(precision)
        more += len(own)
        return Readings(along[:, -1], along[:, :-1], order, self.loads, across, more, APART, self.most, own)

    def settled(
        self, residual: np.ndarray, fitted: np.ndarray, known: tuple[np.ndarray, np.ndarray], noise: Correlation
    ) -> np.ndarray:
        """(k,) by how much what was fitted moves where a lamp made so much of the residual."""
        along, products = self._parts(residual, fitted)
        products += along.T @ (along / (1 + self._shared(noise))[:, None]) + known_products(*known, fitted.shape[1])
        return st.inverse(products[:-1, :-1])[0] @ products[:-1, -1]

    def independent(self, columns: Sequence[np.ndarray], noise: Correlation) -> list[np.ndarray]:
        """Of each frame, (n,) or (n, k) values in units of the noise, with what its lamp may have done weighed down: as
        of frames that share nothing with each other."""
        return [
            c - (1 - 1 / math.sqrt(1 + p)) * np.multiply.outer(g, g @ c)
            for c, g, p in zip(columns, self.signal, self._shared(noise))
        ]

    def _parts(self, residual: np.ndarray, fitted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(frames, k + 1) images and residual along the signal of each frame, and their (k + 1, k + 1) products across
        it."""
        whole = np.column_stack([fitted, residual])
        parts = np.split(whole, np.cumsum([len(g) for g in self.signal])[:-1])
        along = np.array([g @ part for g, part in zip(self.signal, parts)]) * np.sqrt(self.thinning)
        return along, self.thinning * whole.T @ whole - along.T @ along

    def _shared(self, noise: Correlation) -> np.ndarray:
        """(frames,) variance of a noise along the signal of each frame, in units of what nothing shares."""
        bright = float(np.mean(np.square(self.loads["lamp"]))) if len(self.signal) else 1.0
        return noise.power * np.square(self.loads["lamp"]) / max(bright, 1e-300)


def _shared_errors(model: Model, evidence: Evidence) -> list[tuple[np.ndarray, np.ndarray]]:
    """[(places of values that share an error, (m, m) that whitens them)]."""
    found, first = [], 0
    for block in evidence.blocks:
        frame = model.frames[block.frame]
        made = {key: number for key, number in frame.made.items() if isinstance(number, np.ndarray)}
        if made:

            def kept(values: np.ndarray, frame=frame, block=block) -> np.ndarray:
                return np.broadcast_to(values, frame.image.shape).reshape(-1)[block.index]

            errors = model.errors_of_settings(evidence.values, block.frame)
            shares = {key: kept(error) / block.sigma for key, error in errors.items()}
            numbers = {key: kept(number) for key, number in made.items()}
            rows = kept(np.arange(len(frame.image)).reshape(-1, 1, 1))
            # readings that share the error of the dial that is turned least often share any other's too, or none
            last = min(numbers, key=lambda key: len(np.unique(numbers[key])))
            for number in np.unique(numbers[last]):
                own = np.flatnonzero(numbers[last] == number)
                if 1 < len(own) <= MOST:
                    found.append((first + own, _whitening(own, shares, numbers, rows)))
        first += len(block.r)
    return found


def _whitening(
    own: np.ndarray, shares: Mapping[str, np.ndarray], numbers: Mapping[str, np.ndarray], rows: np.ndarray
) -> np.ndarray:
    """L^-1 of the covariance L L' of values, see the module; `own`: their places."""
    alone = 1 - sum(np.square(share[own]) for share in shares.values())
    covariance = np.diag(np.maximum(alone, LEAST))
    for key, share in shares.items():
        same = numbers[key][own][:, None] == numbers[key][own]
        readings = np.array([len(np.unique(rows[numbers[key] == number])) for number in numbers[key][own]])
        covariance += same * np.outer(share[own], share[own]) / readings
    return linalg.solve_triangular(np.linalg.cholesky(covariance), np.eye(len(own)), lower=True)
