"""Noise that neighbouring readings share: how much less a session knows than its readings, counted one by one.

A lamp wanders, a dial keeps its error while several readings are taken, an amplifier drifts. Readings in the order in
which they were recorded then have the covariance scale V,

    V_ij = [i = j] + power h_i h_j exp(-|t_i - t_j|/length)

in units of the variance that the noise model states, with the number t of a reading. h goes with one over the noise of
a reading, as of an amplifier, or with the signal over it, as of a lamp (`kind`), rms 1 in both cases. Such noise
imitates whatever changes slowly during a session. So each explanation of the readings is judged by its deviance with
the shared noise that suits it best,

    deviance = min over power >= 0, length, kind of (r' V^-1 r / scale + ln det V + ln det(P + K' V^-1 K) + x^2)

with the residual r after everything that was fitted is fitted again by these weights. K are the images of what is known
beforehand to a precision P, such as the dial of each photograph: its error is one more noise, with the covariance
K P^-1 K', and what that allows, shared noise need not bring; the determinant is counted from its value without shared
noise. x is the rms of the shared noise
over that of the signal, in units of WANDER. Its prior is a Gaussian's, not Student's as of an effect: whoever takes
readings sees a lamp that wanders by 5 % and mends it, while an effect may be of any size.

The exponential is an Ornstein-Uhlenbeck process, which is Markov: a Kalman filter whitens n readings in n steps. The
scale is found by restricted maximum likelihood.

Source: Patterson & Thompson, Recovery of inter-block information when block sizes are unequal, Biometrika 58, 545
(1971); Harvey, Forecasting, structural time series models and the Kalman filter (1989), ch. 3.4."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from optics.diagnosis import statistics as st

FEWEST = 12  # degrees of freedom from which a correlation is estimated
LEAST, MOST = 0.01, 100.0  # powers tried, at least: in units of the noise of a reading
PER_DECADE = 2.5  # powers
LENGTHS = 7  # tried, from SHORTEST to half of the session
SHORTEST = 3.0  # readings: shared over fewer, it is hardly more than noise of a wrong size
# What shared noise must gain in twice the log likelihood: few white sessions exceed it, and these lose little.
NOTED = 4.0
WANDER = 0.015  # of the signal, rms: what a lamp or an amplifier may wander in a session
NOTICED = 2 * WANDER  # of the signal, rms: a wander that nobody takes for noise
KINDS = ("amplifier", "lamp")


@dataclass(frozen=True)
class Correlation:
    """scale, power, length and kind of V.

    gain    twice the log likelihood, restricted or less what is implausible, over that of white noise
    price   what the noise costs of that, by determinants and by what is implausible; 0 where it is restricted
    """

    scale: float = 1.0
    power: float = 0.0
    length: float = 1.0
    kind: str = KINDS[0]
    gain: float = 0.0
    price: float = 0.0

    @property
    def share(self) -> float:
        """Of the variance, that which neighbours share."""
        return self.power / (1 + self.power)


class Readings:
    """Readings about one explanation.

    residual  (n,) whitened;   fitted: (n, k) whitened images of what was fitted
    order     (n,) numbers of the readings, in any order
    loads     kind -> (n,) whitened: what an amplifier or a lamp moves, the latter the signal
    beside    (k + 1, k + 1) products of images and residual among further values, which share nothing; None: there are
              none
    more      their number;   shortest   length, in readings
    known     (m,) the columns of `fitted` that are known beforehand, with their precision in `beside`
    most      of the signal, rms: what noise that neighbours share may be
    """

    def __init__(
        self,
        residual: np.ndarray,
        fitted: np.ndarray,
        order: np.ndarray,
        loads: Mapping[str, np.ndarray],
        beside: np.ndarray | None = None,
        more: int = 0,
        shortest: float = SHORTEST,
        most: float = math.inf,
        known: np.ndarray | None = None,
    ):
        self.most = most
        places = np.argsort(order, kind="stable")
        columns = np.column_stack([fitted, residual])[places]
        beside = np.zeros((columns.shape[1],) * 2) if beside is None else beside
        whole = columns.T @ columns + beside
        self.reached = float(whole[-1, -1])  # as the fit left it, which may have stopped short of what images promise
        own = np.arange(0) if known is None else known
        dials = columns[:, own], beside[np.ix_(own, own)]
        root = st.root(whole[:-1, :-1]).T  # of an orthonormal basis of what was fitted
        turn = np.zeros((len(whole), root.shape[1] + 1))
        turn[:-1, :-1], turn[-1, -1] = root, 1.0
        turn[:-1, -1] = -root @ (root.T @ whole[:-1, -1])  # the residual off that basis
        columns, beside = columns @ turn, turn.T @ beside @ turn
        self.white = float((turn.T @ whole @ turn)[-1, -1])
        self.bright = float(np.mean(np.square(loads["lamp"]))) if len(residual) else 0.0
        self.free = len(residual) + more - root.shape[1]
        # kind, r' V^-1 r, determinants of V and of what is known beforehand, that of all else which was fitted
        self.shared: list[tuple[str, np.ndarray, np.ndarray, np.ndarray]] = []
        if self.free < FEWEST or not self.white > 0:
            return
        t = order[places].astype(float)
        lengths = np.geomspace(shortest, max(float(np.ptp(t)) / 2, 2 * shortest), LENGTHS)
        self.power, self.length = (grid.ravel() for grid in np.meshgrid(powers(self.bright), lengths))
        for kind, load in loads.items():
            lit = of_rms_1(load)[places]
            left, logs, determinant = _left(columns, t, lit, self.power, self.length, beside)
            beforehand = _known(*dials, t, lit, self.power, self.length)
            self.shared.append((kind, left, logs + beforehand, determinant - beforehand))

    def deviance(self, scale: float) -> float:
        """See the module."""
        return self.white / scale - self.noise(scale).gain

    def standing(self, scale: float) -> float:
        """The deviance where the fit stands: what it left by the weights that it had, or where it stopped short, is not
        fitted again."""
        return self.reached / scale - self.noise(scale).gain

    def noise(self, scale: float, most: float = math.inf) -> Correlation:
        """The shared noise of least deviance, no more of the signal than `most`; `gain` is what it lowers the deviance
        by."""
        best = Correlation(scale)
        if not self.shared:
            return best
        x2 = self.power * scale / max(self.bright, 1e-12) / WANDER**2
        x2 = np.where(x2 > (min(self.most, most) / WANDER) ** 2, math.inf, x2)
        for kind, left, logs, _ in self.shared:
            gains = self.white / scale - (left / scale + logs + x2)
            i = int(np.argmax(gains))
            if gains[i] > best.gain:
                price = float((logs + x2)[i])
                best = Correlation(scale, float(self.power[i]), float(self.length[i]), kind, float(gains[i]), price)
        return best

    def correlation(self) -> Correlation:
        """By restricted maximum likelihood; one that noise alone makes (NOTED) is none."""
        best = Correlation(self.white / max(self.free, 1))
        none = self.free * np.log(max(self.white, 1e-300))
        for kind, left, logs, determinant in self.shared:
            gains = none - self.free * np.log(left) - logs - determinant
            i = int(np.argmax(gains))
            if gains[i] > max(best.gain, NOTED):
                scale = float(left[i] / self.free)
                best = Correlation(scale, float(self.power[i]), float(self.length[i]), kind, float(gains[i]))
        return best


def powers(bright: float) -> np.ndarray:
    """Powers that are tried, up to a wander that nobody takes for noise: of the mean of a whole image, whose noise is
    small, that is more than 100. bright: mean square of the signal over the noise."""
    decades = math.log10(max(MOST, NOTICED**2 * bright) / LEAST)
    return LEAST * 10 ** (np.arange(math.ceil(PER_DECADE * decades - 1e-9) + 1) / PER_DECADE)


def of_rms_1(load: np.ndarray) -> np.ndarray:
    """h (n,); 0 where nothing is lit."""
    rms = float(np.sqrt(np.mean(np.square(load)))) if len(load) else 0.0
    return np.asarray(load, float) / (rms or 1.0)


def _left(
    columns: np.ndarray,
    t: np.ndarray,
    load: np.ndarray,
    power: np.ndarray,
    length: np.ndarray,
    beside: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(r' V^-1 r after the fit, ln det V, ln det of the fit's normal equations), each (g,), by powers and lengths (g,).

    columns   (n, k + 1): an orthonormal basis of what was fitted, and the residual, in the order of t
    beside    (k + 1, k + 1) products of the same among further values
    """
    white, logs = whitened(columns, t, load, power, length)
    products = np.einsum("igj,igk->gjk", white, white, optimize=True) + beside
    fitted, own, across = products[:, :-1, :-1], products[:, -1, -1], products[:, :-1, -1]
    if columns.shape[1] == 1:
        return own, logs, np.zeros(len(power))
    solved = np.linalg.solve(fitted, across[..., None])[..., 0]
    left = np.maximum(own - np.einsum("gk,gk->g", across, solved), 1e-300)
    return left, logs, np.linalg.slogdet(fitted)[1]


def _known(
    columns: np.ndarray, beside: np.ndarray, t: np.ndarray, load: np.ndarray, power: np.ndarray, length: np.ndarray
) -> np.ndarray:
    """ln det(P + K' V^-1 K), less its value without shared noise, (g,); columns (n, m): of K, in the order of t."""
    if not columns.shape[1]:
        return np.zeros(len(power))
    white, _ = whitened(columns, t, load, power, length)
    products = np.einsum("igj,igk->gjk", white, white, optimize=True) + beside
    return np.linalg.slogdet(products)[1] - np.linalg.slogdet(columns.T @ columns + beside)[1]


def whitened(
    columns: np.ndarray, t: np.ndarray, load: np.ndarray, power: np.ndarray, length: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(L^-1 columns (n, g, k), ln det V (g,)) with V = L L', by powers and lengths (g,); columns (n, k) in the order
    of t."""
    count, width = columns.shape
    state, spread = np.zeros((len(power), width)), np.array(power)
    white, logs = np.empty((count, len(power), width)), np.zeros(len(power))
    keeps = np.exp(-np.diff(t, prepend=t[0])[:, None] / length)
    for i in range(count):
        keep = keeps[i]
        if keep[0] < 1:
            state, spread = state * keep[:, None], keep**2 * spread + (1 - keep**2) * power
        variance = load[i] ** 2 * spread + 1
        gain = spread * load[i] / variance
        surprise = columns[i] - load[i] * state
        white[i] = surprise / np.sqrt(variance)[:, None]
        logs += np.log(variance)
        state = state + gain[:, None] * surprise
        spread = spread * (1 - gain * load[i])
    return white, logs
