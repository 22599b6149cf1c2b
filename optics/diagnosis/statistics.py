"""The linear algebra of a diagnosis: how much of a residual an effect explains that no calibration can absorb.

Notation, whitened throughout (divided by the standard deviation that the noise model gives each value):

    r   residual, measured minus predicted                  J   derivative images of the calibrated parameters
    g   derivative images of an effect at its start         Q   orthonormal basis of J
    G = g - QQ'g        what of the effect a new calibration would leave visible
    V = G'G             information that the data hold on its strength s
    u = G'r             score
    s = V^-1 u          expected change of the strength (EPC), covariance V^-1
    T = u'V^-1 u        predicted fall of chi2 when the effect is freed and everything is calibrated again
    survival = |G|^2 / |g|^2

Everything is computed from normal equations, so images can be streamed. Nothing here knows a model or a file. Columns
are scaled to unit length before any truncation: no result depends on the unit of a parameter.

Sources: score test and EPC: Sorbom, Psychometrika 54, 371 (1989); cone tests: Silvapulle & Sen, Constrained Statistical
Inference (2005); errors in variables: Fuller, Measurement Error Models (1987).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

Index = Sequence[int] | np.ndarray  # places of columns

TRUNCATION = 1e-9  # of the largest eigenvalue of unit-length columns: below, a direction is undetermined
VISIBLE = 1e-6  # survival below which normal equations in double precision cannot tell what is left from rounding
DRAWS = 40_000  # of the simulated maximum: 1 % of them are 400, known to 5 %
BINS = 16  # of a curve along a coordinate
RIPPLES, FREQUENCIES = 8, 1000  # frequencies from which, and up to which, the strongest one is looked for
# Cycles from which on a gain of whole lines is looked for, trials a cycle, and the lines that a frame must have
CYCLES, TRIALS, LINES = 2, 2, 16
NARROW = 8  # cosines per side that count as low frequency


# -- normal equations ------------------------------------------------------------------------------------------------
class Normal:
    """Sums over pixels of products of whitened columns A (n, m) and residual r (n,): A'A, A'r, r'r.

    With a twin B, an independent render of the same derivative images, products are taken across the two,
    sym(A'B) and mean(A, B)'r: noise of one image then multiplies noise of another and averages out, where A'A would
    add it up (a strength found with noise of 0.3 of the signal per pixel would come out at 0.7 of the truth).
    """

    def __init__(self, columns: int):
        self.gram = np.zeros((columns, columns))
        self.score = np.zeros(columns)
        self.noise = np.zeros((columns, columns))  # sums over pixels of the covariance of one render
        self.square = 0.0
        self.count = 0

    def add(self, where: Index, a: np.ndarray, r: np.ndarray, b: np.ndarray | None = None) -> None:
        """Add pixels: a (n, k) in the columns `where`, r (n,); columns that are left out are zero in these pixels."""
        where = np.asarray(where, int)
        if b is None:
            product, middle = a.T @ a, a
        else:
            product, middle = a.T @ b, (a + b) / 2
            product = (product + product.T) / 2
            self.noise[np.ix_(where, where)] += (a - b).T @ (a - b) / 2
        self.gram[np.ix_(where, where)] += product
        self.score[where] += middle.T @ r
        self.square += float(r @ r)
        self.count += len(r)

    def copy(self) -> Normal:
        twin = Normal(0)
        twin.gram, twin.score, twin.noise = self.gram.copy(), self.score.copy(), self.noise.copy()
        twin.square, twin.count = self.square, self.count
        return twin

    def kappa(self) -> np.ndarray:
        """Noise over signal per pixel of one render of each column."""
        signal = np.maximum(np.diag(self.gram), 1e-300)
        with np.errstate(over="ignore"):  # infinite, where the products of two images come out below 0
            return np.sqrt(np.diag(self.noise) / signal)

    def truncation(self, columns: Index) -> float:
        """Eigenvalues of these columns that their noise can make: kappa^2/sqrt(n), times 5, and never below TRUNCATION.

        Only theirs: a candidate's noisy image says nothing about what the base can absorb, and a base direction that is
        truncated is mistaken for part of a missing effect (a sixth of a strength was lost so, and an eighth of a fall
        of chi2)."""
        columns = np.asarray(columns, int)
        kappa = self.kappa()[columns][np.diag(self.gram)[columns] > 0]
        return max(TRUNCATION, 5 * float(kappa.max(initial=0.0)) ** 2 / np.sqrt(max(self.count, 1)))


def inverse(gram: np.ndarray, truncation: float = TRUNCATION) -> tuple[np.ndarray, int]:
    """Eigen-truncated inverse and rank of a symmetric matrix whose columns may have any units."""
    r = root(gram, truncation)
    return r.T @ r, len(r)


def root(gram: np.ndarray, truncation: float = TRUNCATION) -> np.ndarray:
    """(rank, k) R with R gram R' = 1, whose R'R is the `inverse`."""
    length = np.sqrt(np.maximum(np.diag(gram), 0.0))
    scale = np.where(length > 0, 1 / np.where(length > 0, length, 1.0), 0.0)
    if not len(gram) or not scale.any():
        return np.zeros((0, len(gram)))
    values, vectors = np.linalg.eigh(gram * scale * scale[:, None])
    keep = values > truncation * values[-1]
    return (vectors[:, keep] / np.sqrt(values[keep])).T * scale


@dataclass(frozen=True)
class Projected:
    """What is left of some columns and of the residual when the base columns are projected off.

    information  V (k, k); score: u (k,)
    survival     (k,) V_jj / |g_j|^2, 0..1
    response     (p, k) d base parameters / d strength: how a calibration would move to hide the effect
    rank         of the base; absorbed: |Q'r|^2; chi2: r'r - |Q'r|^2
    """

    information: np.ndarray
    score: np.ndarray
    survival: np.ndarray
    response: np.ndarray
    rank: int
    absorbed: float
    chi2: float


def project(
    normal: Normal,
    base: Index,
    rest: Index,
    precision: np.ndarray | None = None,
    pull: np.ndarray | None = None,
    truncation: float | None = None,
    noisy: bool = False,
) -> Projected:
    """Project the columns `base` off the columns `rest` and the residual.

    precision, pull   (p,) 1/tau^2 and (mean - value)/tau^2 of priors on the base: rows that a calibration sees as well
    noisy             images of the base are Monte Carlo estimates: the expectation of their noise is left out of
                      `absorbed`. J'r itself counts in the scores: at the optimum that a fit found with images J + N it
                      is not 0 but -N'r, and what nearly is an image of the base would show all of that
    """
    base, rest = np.asarray(base, int), np.asarray(rest, int)
    precision = np.zeros(len(base)) if precision is None else precision
    pull = np.zeros(len(base)) if pull is None else pull
    k = normal.gram[np.ix_(base, base)] + np.diag(precision)
    b = normal.score[base] + pull
    across = normal.gram[np.ix_(base, rest)]
    raw = np.diag(normal.gram)[rest]
    inv, rank = inverse(k, normal.truncation(base) if truncation is None else truncation)
    x = inv @ across
    v = normal.gram[np.ix_(rest, rest)] - across.T @ x
    absorbed = float(b @ inv @ b)
    if noisy:
        own = float((inv * normal.noise[np.ix_(base, base)]).sum())
        absorbed = max(absorbed - own * normal.square / max(normal.count, 1) / 2, 0.0)
    prior = float(np.sum(pull**2 / np.where(precision > 0, precision, 1.0)))
    survival = np.clip(np.divide(np.diag(v), raw, out=np.zeros(len(rest)), where=raw > 0), 0.0, 1.0)
    return Projected(
        (v + v.T) / 2, normal.score[rest] - x.T @ b, survival, -x, rank, absorbed, normal.square + prior - absorbed
    )


def noise_left(normal: Normal, base: Index, rest: Index, response: np.ndarray) -> np.ndarray:
    """(k, k) N, the noise of one render of the columns `rest`, with what the base takes of it (`Projected.response`)
    taken off: A'A of one render would exceed V by it."""
    both, left = np.concatenate([base, rest]), np.vstack([response, np.eye(len(rest))])
    return left.T @ normal.noise[np.ix_(both, both)] @ left


def certain(information: np.ndarray, noise: np.ndarray, share: float) -> tuple[np.ndarray, float]:
    """Of the strengths of one effect, the combinations of which images show more than their own noise.

    information, noise   (k, k) V and N of the effect's images (`Projected`, `noise_left`)
    share                of the noise of one render: what may be left of it in the product of two

    Returns (k, k) P, by which scores are multiplied (and V from both sides), and by how much scores vary more than V
    says: with a mean of two renders by V + N/2, so by 1 + the largest eigenvalue of V^-1 N/2. Two strengths that act
    almost alike leave next to nothing of their difference: products of two renders are then random, near 0 or below it,
    and a score over one of these passes for a fall of chi2 of any size (in a printed grid 40 for 3)."""
    size = np.sqrt(np.maximum(np.diag(information), 0.0))
    scale = np.where(size > 0, 1 / np.where(size > 0, size, 1.0), 0.0)
    values, vectors = np.linalg.eigh(information * scale * scale[:, None])
    own = np.einsum("ij,ik,kj->j", vectors, noise * scale * scale[:, None], vectors)
    keep = (values > share * own) & (values > 0)
    vectors, values = vectors[:, keep], values[keep]
    root = (vectors / np.sqrt(values)).T * scale
    spread = 1 + np.linalg.eigvalsh(root @ noise @ root.T).max(initial=0.0) / 2
    return size[:, None] * (vectors @ vectors.T) * scale, float(spread)


# -- one effect ------------------------------------------------------------------------------------------------------
class Cone:
    """Strengths that an effect may take: each free, >= 0 or <= 0, with the information V on them.

    T = max over allowed s of 2 s'u - s'Vs. Under the null hypothesis T follows a mixture of chi2 distributions whose
    weights (probability that j strengths come out off their bound) are exact for one strength and simulated for more.
    Combinations of strengths of which the projection has left only rounding (VISIBLE) are undetermined.

    spread   variance of scores over V, above 1 where the images of the effect are noisy (`certain`)
    """

    def __init__(
        self, information: np.ndarray, sides: Sequence[int], seed: int = 0, draws: int = 10_000, spread: float = 1.0
    ):
        side, self.spread = np.asarray(sides, int), spread
        self.information = np.asarray(information, float)
        diagonal = np.diag(self.information)
        self.live = np.flatnonzero(diagonal > 0)
        sign = np.where(side < 0, -1.0, 1.0)[self.live]
        v = self.information[np.ix_(self.live, self.live)] * sign * sign[:, None]
        self.sign, self.free, self.bound = sign, np.flatnonzero(side[self.live] == 0), np.flatnonzero(side[self.live])
        across = v[np.ix_(self.bound, self.free)]
        self.free_inverse, self.free_rank = inverse(v[np.ix_(self.free, self.free)], VISIBLE)
        # a bound strength that free ones imitate, as a leak and its slope do at one wavelength, adds but rounding
        own = np.diag(v)[self.bound]
        seen = own - np.einsum("bi,ij,bj->b", across, self.free_inverse, across) > VISIBLE * own
        self.bound, across = self.bound[seen], across[seen]
        self.across = across @ self.free_inverse  # (bound, free)
        self.cone = v[np.ix_(self.bound, self.bound)] - self.across @ across.T
        self.inverse, self.rank = inverse(self.information, VISIBLE)
        self.weights = self._weights(seed, draws)  # [j] = P(chi2 with j degrees of freedom)

    def _weights(self, seed: int, draws: int) -> np.ndarray:
        weights = np.zeros(len(self.live) + 1)
        if len(self.bound) < 2:
            active = np.array([1.0]) if not len(self.bound) else np.array([0.5, 0.5])
        else:
            z = gaussian(self.cone, draws, np.random.default_rng([seed, 11]))
            active = np.bincount((_descend(self.cone, z) > 0).sum(1), minlength=len(self.bound) + 1) / draws
        weights[self.free_rank : self.free_rank + len(active)] = active
        return weights

    def _split(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u = u[..., self.live] * self.sign
        free = u[..., self.free]
        return free, u[..., self.bound] - free @ self.across.T

    def fall(self, scores: np.ndarray) -> np.ndarray:
        """T of many scores (n, k) at once, (n,)."""
        free, bound = self._split(np.asarray(scores, float))
        fall = np.einsum("ni,ij,nj->n", free, self.free_inverse, free)
        if len(self.bound) == 1:
            fall = fall + np.maximum(bound[:, 0], 0.0) ** 2 / self.cone[0, 0]
        elif len(self.bound):
            x = _descend(self.cone, bound)
            fall = fall + np.maximum(2 * (x * bound).sum(1) - np.einsum("ni,ij,nj->n", x, self.cone, x), 0.0)
        return fall

    def solve(self, u: np.ndarray) -> tuple[float, np.ndarray]:
        """(T, s): predicted fall of chi2 and the change of the strengths, exact (NNLS)."""
        from scipy.optimize import nnls

        free, bound = self._split(np.asarray(u, float))
        x = np.zeros(len(self.bound))
        if len(self.bound) == 1:
            x[0] = max(bound[0], 0.0) / self.cone[0, 0]
        elif len(self.bound):
            scale = 1 / np.sqrt(np.diag(self.cone))
            values, vectors = np.linalg.eigh(self.cone * scale * scale[:, None])
            keep = values > VISIBLE * values[-1]
            root, vectors = np.sqrt(values[keep]), vectors[:, keep]
            x = scale * nnls((vectors * root).T, (vectors / root).T @ (bound * scale), maxiter=100 * len(x))[0]
        s = np.zeros(len(self.information))
        y = self.free_inverse @ free - self.across.T @ x
        s[self.live[self.free]], s[self.live[self.bound]] = self.sign[self.free] * y, self.sign[self.bound] * x
        return float(free @ self.free_inverse @ free + max(2 * x @ bound - x @ self.cone @ x, 0.0)), s

    @property
    def expectation(self) -> float:
        """Mean of T when the effect is absent: 1 for a free strength, 1/2 for a one-sided one, times the spread."""
        return self.spread * float(self.weights @ np.arange(len(self.weights)))

    @property
    def sd(self) -> np.ndarray:
        """(k,) standard deviation of each strength, NaN where it is undetermined."""
        variance = self.spread * np.diag(self.inverse)
        return np.sqrt(np.where(variance > 0, variance, np.nan))

    def p(self, fall) -> np.ndarray:
        """Probability of a larger T when the effect is absent; an array like `fall`."""
        from scipy.special import chdtrc

        fall = np.asarray(fall, float)
        p = np.where(fall > 0, 0.0, self.weights[0])
        for dof in np.flatnonzero(self.weights[1:]) + 1:
            p = p + self.weights[dof] * chdtrc(dof, fall / self.spread)
        return np.where(fall > 0, p, 1.0)

    def critical(self, p: float) -> float:
        """T at which `p` is reached."""
        from scipy.optimize import brentq

        if self.p(1e-9) <= p:
            return 0.0
        return float(brentq(lambda fall: float(self.p(fall)) - p, 1e-9, 1e4))

    def power(self, strength: np.ndarray, critical: float) -> float:
        """Probability that T exceeds `critical` when the strengths are `strength`: noncentral with ncp = s'Vs."""
        from scipy.special import chndtr, ndtr

        ncp, critical = float(strength @ self.information @ strength) / self.spread, critical / self.spread
        dof = int(np.flatnonzero(self.weights)[-1])
        if not ncp > 0 or dof == 0:
            return 0.0
        if dof == 1 and self.weights[0] > 0:
            return float(ndtr(np.sqrt(ncp) - np.sqrt(critical)))
        return float(1 - chndtr(critical, dof, ncp)) if ncp < 1e4 else 1.0


def gaussian(covariance: np.ndarray, draws: int, rng: np.random.Generator) -> np.ndarray:
    """(draws, k) samples of N(0, covariance); the covariance may be singular."""
    length = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(length > 0, length, 1.0)
    values, vectors = np.linalg.eigh(covariance / scale / scale[:, None])
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return rng.standard_normal((draws, len(covariance))) @ root.T * length


def _descend(v: np.ndarray, u: np.ndarray, sweeps: int = 100, tolerance: float = 1e-4) -> np.ndarray:
    """argmax over x >= 0 of 2 x'u - x'vx for many u (n, k) at once: coordinate descent, to `tolerance` sd."""
    x = np.zeros_like(u)
    for _ in range(sweeps):
        moved = 0.0
        for j in range(len(v)):
            fresh = np.maximum(x[:, j] + (u[:, j] - x @ v[:, j]) / v[j, j], 0.0)
            moved = max(moved, float(np.abs(fresh - x[:, j]).max(initial=0.0)) * np.sqrt(v[j, j]))
            x[:, j] = fresh
        if moved < tolerance:
            break
    return x


# -- many effects ----------------------------------------------------------------------------------------------------
class Family:
    """Family-wise error: the probability that the best of all absent candidates has a p as small as this one.

    Simulated: scores are drawn from N(0, V) with the V of all candidates together, so that look-alikes count once.
    Below the reach of the simulation, the number of effectively independent candidates found at its end is kept.
    """

    def __init__(
        self,
        information: np.ndarray,
        candidates: Sequence[tuple[Index, Cone]],
        seed: int = 0,
        draws: int = DRAWS,
    ):
        self.draws, self.count = draws, len(candidates)
        z = gaussian(information, draws, np.random.default_rng([seed, 12]))
        smallest = np.ones(draws)
        for columns, cone in candidates:
            np.minimum(smallest, cone.p(cone.fall(z[:, np.asarray(columns, int)])), out=smallest)
        self.smallest = np.sort(smallest)

    def p(self, p: float) -> float:
        """Family-wise probability of a smallest p as small as this one; NaN of NaN."""
        if math.isnan(p):
            return p
        tail = 200
        if self.draws >= 2 * tail and p < self.smallest[tail - 1]:
            return float(p / self.smallest[tail - 1] * tail / self.draws)
        return float(min(1.0, np.searchsorted(self.smallest, p, side="right") / self.draws)) if p < 1 else 1.0

    def bounded(self, p: float) -> float:
        """`p` of a p that does not come from V, such as one by scatter: no more than the sum over all candidates.

        Where derivative images have Monte Carlo noise, V is the product of two estimates and may have negative
        eigenvalues. Scores drawn without these vary more than V says, and the smallest p of absent candidates comes
        out too small: of a printed grid, a p of 1.3e-6 had passed for 0.04 among 23 candidates."""
        return p if math.isnan(p) else min(self.p(p), self.count * p)

    def critical(self, p: float) -> float:
        """Single p that has the family-wise probability `p`."""
        return float(self.smallest[min(int(p * self.draws), self.draws - 1)])


def gap(information: np.ndarray, a: Index, strength: np.ndarray, b: Index, rival: Cone) -> float:
    """D: expected chi2 by which the data prefer effect a, true with `strength`, over effect b at its best."""
    a, b = np.asarray(a, int), np.asarray(b, int)
    full = float(strength @ information[np.ix_(a, a)] @ strength)
    mimicked, _ = rival.solve(information[np.ix_(b, a)] @ strength)
    return max(full - mimicked, 0.0)


def probability_correct(d: float) -> float:
    """P(the true one of two effects has the smaller chi2) = Phi(sqrt(D)/2)."""
    from scipy.special import ndtr

    return float(ndtr(np.sqrt(max(d, 0.0)) / 2))


# -- bins: fingerprints and splits -----------------------------------------------------------------------------------
def bin_edges(x: np.ndarray, bins: int = BINS, fewest: int = 20) -> np.ndarray | None:
    """Edges of at most `bins` bins: half of them hold equal counts, half are equally wide, so that neither a flat
    region nor a long tail takes them all. One bin per value where there are few values; None where there is only
    one."""
    x = x[np.isfinite(x)]
    if not len(x):
        return None
    sample = x[:: max(1, len(x) // 200_000)].astype(float)
    values = np.unique(sample)
    if len(values) < 2:
        return None
    if len(values) <= bins:
        return np.concatenate([[-np.inf], (values[1:] + values[:-1]) / 2, [np.inf]])
    low, high = np.quantile(sample, [0.005, 0.995])
    inner = np.concatenate(
        [np.quantile(sample, np.linspace(0, 1, bins // 2 + 1))[1:-1], np.linspace(low, high, bins // 2 + 2)[1:-1]]
    )
    edges = np.unique(inner)
    keep, floor = [], max(fewest, len(sample) // 2000)
    last = 0
    counts = np.searchsorted(np.sort(sample), edges)
    for edge, count in zip(edges, counts):
        if count - last >= floor and len(sample) - count >= floor:
            keep.append(edge)
            last = count
    return np.concatenate([[-np.inf], keep, [np.inf]]) if keep else None


def add_bins(
    normal: Normal,
    where: Index,
    a: np.ndarray,
    r: np.ndarray,
    first: int,
    bins: np.ndarray,
    count: int,
    carriers: Sequence[np.ndarray],
) -> None:
    """Add columns 1{bin} * carrier, starting at column `first`: bins (n,) in 0..count-1 or -1 for none.

    Only products with the new columns are added; those of `a` (n, k) among themselves are there already.
    """
    from scipy.sparse import csr_array

    rows = np.flatnonzero(bins >= 0)
    index = np.concatenate([bins[rows] + i * count for i in range(len(carriers))])
    data = np.concatenate([carrier[rows] for carrier in carriers])
    width = count * len(carriers)
    b = csr_array((data, (np.tile(rows, len(carriers)), index)), shape=(len(r), width)).T.tocsr()
    new = np.arange(first, first + width)
    where = np.asarray(where, int)
    across = b @ a
    normal.gram[np.ix_(new, where)] += across
    normal.gram[np.ix_(where, new)] += across.T
    normal.gram[np.ix_(new, new)] += (b @ b.T).toarray()
    normal.score[new] += b @ r


def joint(
    projected: Projected, scale: np.ndarray, truncation: float = 1e-6
) -> tuple[float, int, np.ndarray, np.ndarray]:
    """(T, dof, s, sd) of columns that may be dependent among themselves or absorbed by the base.

    scale  (k,) squared lengths of the columns before projection: what survives of them below `truncation` is no column
    """
    length = np.sqrt(np.maximum(scale, 0.0))
    unit = np.where(length > 0, 1 / np.where(length > 0, length, 1.0), 0.0)
    values, vectors = np.linalg.eigh(projected.information * unit * unit[:, None])
    keep = values > truncation
    vectors = vectors[:, keep] * unit[:, None]
    z = vectors.T @ projected.score
    fall = float(np.sum(z**2 / values[keep]))
    return fall, int(keep.sum()), vectors @ (z / values[keep]), np.sqrt(np.sum(vectors**2 / values[keep], 1))


# -- structure -------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Structure:
    """Test of low against high spatial frequencies: F, its degrees of freedom and p; NaN where images are too small.

    high  mean power of the high frequencies, 1 where the noise model is right and pixels are independent
    """

    f: float
    p: float
    dof_low: float
    dof_high: float
    high: float


@cache
def cosines(n: int) -> np.ndarray:
    """(n, n) orthonormal DCT-II: row k is the cosine of k half periods."""
    x = np.arange(n) + 0.5
    basis = np.sqrt(2 / n) * np.cos(np.pi * np.outer(np.arange(n), x) / n)
    basis[0] /= np.sqrt(2)
    return basis


def planes_of(use: np.ndarray) -> list[tuple]:
    """Indices (rows, columns, channel) of the planes of a mask (H, W, C) that hold pixels on a regular grid.

    A raw mosaic fills only some of the four positions of a 2 x 2 cell in a channel: each is a plane of its own.
    """
    planes: list[tuple] = []
    for c in range(use.shape[2]):
        cells = [(slice(i, None, 2), slice(j, None, 2), c) for i in (0, 1) for j in (0, 1)]
        filled = [use[cell].any() for cell in cells]
        planes += (
            [(slice(None), slice(None), c)] if all(filled) else [cell for cell, full in zip(cells, filled) if full]
        )
    return planes


class Spectrum:
    """Power of whitened residuals in the lowest NARROW x NARROW cosines against the highest quarter; that of the
    strongest frequency along rows and columns against all others; and that of a gain of whole rows or columns. p is
    the smallest of the three, times three.

    White noise has the same power in all frequencies, whatever its size: a noise that is stated wrongly changes
    nothing, structure does. The degrees of freedom that a calibration takes from the low frequencies are counted from
    the images of J.
    """

    def __init__(self, columns: int):
        self.low_gram = np.zeros((columns, columns))
        self.planes: list[list[tuple]] = []
        self.signals: list[np.ndarray] = []
        self.trace = self.square = self.high_count = 0.0

    def add(self, use: np.ndarray, where: Index, columns: np.ndarray, signal: np.ndarray) -> None:
        """Add a frame: use (H, W, C) bool; columns (H, W, C, k) and the light that is predicted (H, W, C), whitened
        and zero outside, columns in the places `where`."""
        self.signals.append(signal.astype(np.float32))
        planes = [p for p in planes_of(use) if min(use[p].shape) >= 16 and use[p].mean() > 0.2]
        self.planes.append(planes)
        where = np.asarray(where, int)
        for plane in planes:
            mask = use[plane].astype(float)
            rows, cols = self._low(mask.shape)
            basis = np.einsum("ah,bw->abhw", rows, cols).reshape(len(rows) * len(cols), -1)
            covariance = (basis * mask.ravel()) @ basis.T  # of the low coefficients of masked white noise
            self.trace += float(np.trace(covariance))
            self.square += float(np.sum(covariance**2))
            self.high_count += (mask.shape[0] // 2) * (mask.shape[1] // 2) * float(mask.mean())
            low = basis @ columns[plane].reshape(mask.size, -1)
            self.low_gram[np.ix_(where, where)] += low.T @ low

    @staticmethod
    def _low(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        rows, columns = (cosines(n)[: min(NARROW, n // 4)] for n in shape)
        return rows, columns

    def test(self, residuals: Sequence[np.ndarray], base: Index, inverse_gram: np.ndarray) -> Structure:
        """F test of whitened residuals (H, W, C), zero outside the masks; base and (J'J)^-1 name what was
        calibrated."""
        from scipy.fft import dctn
        from scipy.special import fdtrc

        if not any(self.planes):
            return Structure(*[float("nan")] * 5)
        low = high = 0.0
        for residual, planes in zip(residuals, self.planes):
            for plane in planes:
                power = dctn(residual[plane], norm="ortho") ** 2
                h, w = power.shape
                low += float(power[: min(NARROW, h // 4), : min(NARROW, w // 4)].sum())
                high += float(power[h - h // 2 :, w - w // 2 :].sum())
        base = np.asarray(base, int)
        taken = float(np.sum(inverse_gram * self.low_gram[np.ix_(base, base)]))
        expected = max(self.trace - taken, 1e-9)
        dof_low = max(self.trace**2 / self.square * expected / self.trace, 1.0)
        dof_high = max(self.high_count, 1.0)
        mean_high = high / dof_high
        f = low / expected / max(mean_high, 1e-300)
        p = float(fdtrc(dof_low, dof_high, f))
        p = min(p, self._ripple(residuals), self._bands(residuals))
        return Structure(f, min(1.0, 3 * p), dof_low, dof_high, mean_high)

    def _bands(self, residuals: Sequence[np.ndarray]) -> float:
        """p of the strongest frequency, of CYCLES or more, of a gain of whole rows or columns, the same in all
        channels: of all frames together (a read-out), and of what each frame has besides (mains light under a rolling
        shutter).

        The gain of a line in units of its own error is z = u / sqrt(v), u = sum r g and v = sum r^2 g^2 of all frames,
        g the light predicted: no image alone shows what a hundred show together. What a frame f has besides is
        (u_f - v_f u/v) / sqrt(v_f), which has one degree of freedom less than there are frames. P(f) = 2 |sum_n z_n
        exp(-2 pi i f n)|^2 / N of white noise is chi2 with two degrees of freedom, and sums over frames have two for
        each (Scargle, Astrophysical Journal 263, 835 (1982), eq. 10 and 13). In steps of a quarter cycle, trials are
        TRIALS a cycle. Where lines vary by more than their errors, all frequencies do. P of all frames is then measured
        by its mean further than three quarters of a cycle off, and F is asked instead of chi2; that of a frame by its
        own mean. Frames with fewer than LINES lines tell nothing."""
        from scipy.special import fdtrc, gammaincc

        ps = []
        for axis in (0, 1):
            us, vs = [], []
            for r, g in zip(residuals, self.signals):
                weighed = r * g
                v = (weighed**2).sum((1 - axis, 2), dtype=float)
                if np.count_nonzero(v) >= LINES:
                    us.append(weighed.sum((1 - axis, 2), dtype=float))
                    vs.append(v)
            if not us:
                continue
            u, v = np.array(us), np.maximum(np.array(vs), 1e-300)  # u is 0 as well where v is
            n, gain = u.shape[1], u.sum(0) / v.sum(0)
            trials = TRIALS * n / 2
            (power,) = _periodogram(u.sum(0, keepdims=True) / np.sqrt(v.sum(0)))
            k = int(power.argmax())
            rest = np.delete(power, slice(max(k - 3, 0), k + 4))
            scale, known = float(rest.mean()), len(rest) / 2
            p = fdtrc(2, known, power[k] / scale) if scale > 1 else gammaincc(1, power[k])
            ps.append(float(p) * trials)
            if len(u) > 1:
                powers = _periodogram((u - v * gain) / np.sqrt(v))
                powers /= np.maximum(powers.mean(1, keepdims=True), 1.0)
                ps.append(float(gammaincc(len(u) - 1, powers.sum(0).max())) * trials)
        return min(1.0, min(ps, default=1.0) * max(len(ps), 1))

    def _ripple(self, residuals: Sequence[np.ndarray]) -> float:
        """p of the strongest frequency in the means of rows and of columns, against the mean of all frequencies: bands
        of a read-out, flicker of mains light under a rolling shutter. Summed over frames by power, as its phase may
        change from frame to frame, and by amplitude, as a fixed pattern does not."""
        from scipy.special import gammaincc

        profiles: dict[tuple[int, int, str], list[np.ndarray]] = {}
        for residual, planes in zip(residuals, self.planes):
            for plane in planes:
                use = (residual[plane] != 0).astype(float)
                for axis in (0, 1):
                    count = use.sum(1 - axis)
                    mean = residual[plane].sum(1 - axis) / np.sqrt(np.maximum(count, 1.0))
                    mean = mean * math.sqrt(len(count) / max(int(np.count_nonzero(count)), 1))
                    profiles.setdefault((axis, len(mean), str(plane)), []).append(mean)
        ps = []
        for own in profiles.values():
            together = np.array(own)
            for group in (together, together.sum(0, keepdims=True)):
                power = (np.abs(np.fft.rfft(group, axis=1)[:, 1:-1]) ** 2).sum(0)
                if len(power) > RIPPLES and power.mean() > 0:
                    count = len(group)
                    excess = float(power.max()) / float(power.mean())
                    ps.append(float(gammaincc(count, count * excess)) * len(power))
        return min(1.0, min(ps, default=1.0) * max(len(ps), 1))


class Sweeps:
    """As `Spectrum`, for readings: power of whitened residuals in the NARROW lowest cosines along what was swept,
    against the rest.

    Along each coordinate in turn, by the ranks of its values. What a calibration absorbs is projected off, so that F is
    exactly F-distributed in white noise of any size. p is that of the best coordinate times their number.

    apart   whitens columns (n, k) of all readings by the errors that some of them share: the channels of one setting of
            a dial move together, which is no structure"""

    def __init__(self) -> None:
        self.parts: list[tuple] = []
        self.apart: Callable[[np.ndarray], np.ndarray] = np.asarray

    def add(self, use: np.ndarray, where: Index, columns: np.ndarray, along: Mapping[str, np.ndarray]) -> None:
        """Add a sweep: as in `Spectrum`, and along: {coordinate: value of each reading, (N, 1, 1)}."""
        self.parts.append(
            (
                use,
                np.asarray(where, int),
                columns[use],
                {k: np.broadcast_to(x, use.shape)[use] for k, x in along.items()},
            )
        )

    def test(
        self,
        residuals: Sequence[np.ndarray],
        base: Index,
        inverse_gram: np.ndarray,
        apart: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> Structure:
        """As `Spectrum.test`; `high` is NaN, as neighbouring readings share no interpolation, unlike pixels.

        apart   in place of the attribute, where noise is shared otherwise"""
        apart = apart or self.apart
        r = np.concatenate([residual[use] for residual, (use, *_) in zip(residuals, self.parts)]).astype(float)
        calibrated = np.zeros((len(r), len(base)))
        for (use, where, columns, _), end in zip(self.parts, np.cumsum([use.sum() for use, *_ in self.parts])):
            here = [(i, int(np.flatnonzero(where == c)[0])) for i, c in enumerate(base) if c in where]
            calibrated[end - use.sum() : end, [i for i, _ in here]] = columns[:, [j for _, j in here]]
        taken = orthonormal(apart(calibrated))
        r = apart(r[:, None])[:, 0]
        r = r - taken @ (taken.T @ r)
        names = sorted(set.intersection(*[set(along) for *_, along in self.parts]))
        tests = [_slow(np.concatenate([along[name] for *_, along in self.parts]), r, taken) for name in names]
        found = [test for test in tests if test]
        if all("reading" in along for *_, along in self.parts):
            found += _ripple_of(np.concatenate([along["reading"] for *_, along in self.parts]), r, taken.shape[1])
        if not found:
            return Structure(*[float("nan")] * 5)
        p, f, low, free = min(found)
        return Structure(f, min(1.0, p * len(found)), low, free, float("nan"))


def _periodogram(profiles: np.ndarray) -> np.ndarray:
    """|sum_n z_n exp(-2 pi i f n)|^2 / N of profiles (frames, n), at frequencies from CYCLES on in steps of a quarter
    cycle: of white noise with a mean of 1; N counts what is not 0."""
    lines = np.maximum(np.count_nonzero(profiles, 1), 1)
    return np.abs(np.fft.rfft(profiles, 4 * profiles.shape[1], axis=1)[:, 4 * CYCLES :]) ** 2 / lines[:, None]


def _ripple_of(t: np.ndarray, r: np.ndarray, taken: int) -> list[tuple[float, float, int, int]]:
    """[(p, F, 2, free)] of the strongest frequency of readings r (n,) with the numbers t, against all others: flicker
    of a lamp, a periodic error of a drive; empty where there are too few. `taken` directions are projected off r."""
    span, total, free = float(np.ptp(t)) + 1, float(r @ r), len(r) - taken
    count = min(int(span // 2) - 1, FREQUENCIES)
    if count < RIPPLES or free < 2 * RIPPLES or not total > 0:
        return []
    turns = np.arange(1, count + 1)
    power = np.array([2 / len(r) * abs(np.exp(-2j * np.pi * k * t / span) @ r) ** 2 for k in turns])
    share = min(float(power.max()) / total, 1.0)
    p = (1 - share) ** ((free - 2) / 2) * count  # of white noise: the share of one of free/2 planes
    return [(min(1.0, p), float(power.max()) * free / (2 * total), 2, free - 2)]


def follows(x: np.ndarray, y: np.ndarray) -> float:
    """p of numbers y (n,) if they did not depend on x (n,), by the test of `Sweeps` about their mean; NaN where they
    are too few or all equal. The error of y is taken from its scatter about the curve."""
    y = y - np.mean(y)
    found = _slow(x, y, np.full((len(y), 1), len(y) ** -0.5)) if y.any() else None
    return found[0] if found else float("nan")


def differs(groups: Sequence[Sequence[float]]) -> float:
    """p of groups of numbers if all had one mean (one-way analysis of variance); NaN where no group repeats."""
    from scipy.stats import f_oneway

    if len(groups) < 2 or all(len(g) < 2 for g in groups) or len({y for g in groups for y in g}) < 2:
        return float("nan")
    return float(f_oneway(*groups).pvalue)


def _slow(x: np.ndarray, r: np.ndarray, taken: np.ndarray) -> tuple[float, float, int, int] | None:
    """(p, F, low, free) of the lowest cosines of r (n,) by the ranks of x, at most NARROW and n/4 of them, against the
    rest; None where there are too few. Columns of `taken`, orthonormal, are projected off r already."""
    from scipy.special import fdtrc
    from scipy.stats import rankdata

    count = min(NARROW, len(np.unique(x)) - 1, len(x) // 4)
    slow = orthonormal(np.cos(np.pi * np.outer((rankdata(x) - 0.5) / len(x), np.arange(1, count + 1))))
    left, s, _ = np.linalg.svd(slow - taken @ (taken.T @ slow), full_matrices=False)
    basis = left[:, s**2 > VISIBLE]
    low, free = basis.shape[1], len(r) - taken.shape[1] - basis.shape[1]
    if not low or free < len(r) // 4:
        return None
    power = float(np.sum((basis.T @ r) ** 2))
    f = power / low / max((float(r @ r) - power) / free, 1e-300)
    return float(fdtrc(low, free, f)), f, low, free


def orthonormal(columns: np.ndarray) -> np.ndarray:
    """A basis of what columns of any units span."""
    length = np.linalg.norm(columns, axis=0)
    if not length.any():
        return np.zeros((len(columns), 0))
    u, s, _ = np.linalg.svd(columns[:, length > 0] / length[length > 0], full_matrices=False)
    return u[:, s > 1e-6 * s.max(initial=0.0)]


# -- thinning --------------------------------------------------------------------------------------------------------
def thinning(values: int, limit: int) -> int:
    """Smallest odd k so that every k-th of `values` pixels are at most `limit`; odd, so that a mosaic is thinned
    evenly."""
    k = max(1, -(-values // max(limit, 1)))
    return k + 1 - k % 2


def lattice(shape: tuple[int, int, int], k: int, shift: int = 0) -> np.ndarray:
    """(H, W, C) bool: every k-th pixel on the most even lattice (column + s row = const mod k), shifted by channel."""
    if k == 1:
        return np.ones(shape, bool)
    reach = np.arange(-k, k + 1)

    def distance(s):
        column, row = np.meshgrid(reach, reach)
        hit = ((column + s * row) % k == 0) & ((column != 0) | (row != 0))
        return (column**2 + row**2)[hit].min()

    s = max(range(1, k), key=distance)
    row, column, channel = np.ogrid[: shape[0], : shape[1], : shape[2]]
    return (column + s * row + channel + shift) % k == 0
