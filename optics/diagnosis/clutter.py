"""Clutter: how much more the score of an image varies than noise alone makes it.

Noise is independent from pixel to pixel; clutter is not: neighbours share mottle, a fixed pattern, a drifting lamp. The
variance of a score x'r, V = x'x by noise, is estimated twice:

    by parts     B, from the scatter of the score between G parts of the sensor or session (`variances`)
    by others    from the scores of all other effects, which have no reason to be there: phi V with
                 phi = 1 + a m + b n,    m = sum over places (sum of x there)^2 / V,  n = the same, of each frame apart
                 since clutter adds up where an image has one sign over its reach (`Others`)

16 parts alone leave a score of five errors in doubt among 39 effects, whatever all others say. Both are joined as a
variance with d, and one with d0 degrees of freedom; d0 is how well `others` predict each other's scatter.

Sources: Liang & Zeger, Longitudinal data analysis using generalized linear models, Biometrika 73, 13 (1986), the robust
variance; Smyth, Linear models and empirical Bayes methods for assessing differential expression in microarray
experiments, Stat. Appl. Genet. Mol. Biol. 3, 3 (2004), variances that many tests share; Kish, Survey Sampling, 1965."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from optics.diagnosis import statistics as st
from optics.diagnosis.thresholds import MAPS

FRAMES = 6  # from which their scatter says something of a strength that all of them have
PARTS = 16  # of the sensor or session: wider than clutter is correlated, enough for a variance
REACH = 8  # squares along a side of the sensor, within which clutter adds up: half as wide as the parts
FEWEST = 8  # directions of other effects' images, from which their variances are learnt
ROUNDS = 10  # of reweighting, by which a and b change no longer

Scatter = tuple[np.ndarray, float]  # (B (k, k), G): the variance of a score u (k,), as if from G parts


@dataclass(frozen=True)
class Parts:
    """Parts of the sensor or session: per block, the number (n,) of each value's part, below `count`."""

    bins: list[np.ndarray]
    count: int

    def sums(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """(count, k) sums of images (n, k) over each part."""
        found = np.zeros((self.count, images[0].shape[1]))
        for image, index in zip(images, self.bins):
            np.add.at(found, index, image)
        return found

    def together(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """(k, k) variance of the scores of images (n, k) where each part shares clutter as large as the noise of one
        value: sum over the parts of (sum of x)(sum of x)'."""
        sums = self.sums(images)
        return sums.T @ sums


def maps_of(places: Sequence[dict]) -> Iterator[Parts]:
    """The parts by each of MAPS that there is, and by frames. Of readings, those of a frame are no neighbours."""
    by_frame = () if "reading" in places[0] else ("frame",)
    for name in (*MAPS, *by_frame):
        edges = st.bin_edges(np.concatenate([p[name] for p in places]), PARTS) if name in places[0] else None
        if edges is None or (name == "frame" and len(places) < FRAMES):
            continue
        yield Parts([np.searchsorted(edges, place[name], side="right") - 1 for place in places], len(edges) - 1)


def variances(images: Sequence[np.ndarray], left: Sequence[np.ndarray], places: Sequence[dict]) -> list[Scatter]:
    """(B, G) for each of `maps_of`: the variance of the score x'r of images x, by its scatter between G parts.

    B = sum of w w' with w = (1 - V_g/V)^(-1/2) u_g, u_g = sum of x r over part g, V_g of x x', where r is the residual
    at the optimum. The fit has absorbed a share V_g/V of part g, so that without clutter the mean of B is V. Where a
    fit stopped short of the optimum, or followed other images than these, the residuals `left` are brought there first:
    a part with nearly all information would otherwise show that rest many times over.

    Source: Liang & Zeger (1986); Bell & McCaffrey, Bias reduction in standard errors for linear regression with
    multi-stage samples, Survey Methodology 28, 169 (2002)."""
    found: list[Scatter] = []
    k = images[0].shape[1]
    root = st.root(sum(x.T @ x for x in images))
    back = np.linalg.pinv(root)
    rest = root.T @ root @ sum(x.T @ r for x, r in zip(images, left))
    left = [r - x @ rest for x, r in zip(images, left)]
    for parts in maps_of(places):
        b, count = np.zeros((k, k)), 0
        for own, r in _by_part(images, left, parts):
            share, vectors = np.linalg.eigh(root @ (own.T @ own) @ root.T)
            # a direction that one part alone determines has no scatter
            free = np.where(share < 1 - 1e-6, np.maximum(1 - share, 1e-6) ** -0.5, 0.0)
            w = back @ (vectors * free) @ (vectors.T @ (root @ (own.T @ r)))
            b, count = b + np.outer(w, w), count + 1
        found.append((b, count))
    return found


def _by_part(
    images: Sequence[np.ndarray], left: Sequence[np.ndarray], parts: Parts
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(images (n, k), residual (n,)) of each part in which there is an image."""
    for g in range(parts.count):
        own = np.concatenate([x[index == g] for x, index in zip(images, parts.bins)])
        if own.any():
            yield own, np.concatenate([r[index == g] for r, index in zip(left, parts.bins)])


def by_clutter(score: np.ndarray, information: np.ndarray, variances: Sequence[Scatter]) -> float:
    """p of a score u (k,) of information V by its variance B between G parts: the largest p of all maps, NaN without.

    Where G >= 2 k: T2 = u' B^-1 u, T2 (G - k)/(k (G - 1)) ~ F(k, G - k). Fewer parts determine too little of B's
    directions (15 strengths and 16 parts would need T2 = 1.4e6), but its trace and how it scatters along u: with z =
    V^-1/2 u and M = V^-1/2 B V^-1/2, z'z / tr M ~ F(h, h (G - 1)), h = (tr M)^2 / tr M^2, and (z'z)^2 / (k z'Mz), which
    is below F(k, G - 1) wherever M is no multiple of 1, for z lies where M is large. The first is weak where M is
    large in one direction and u in others, such as the level of a lamp that one pair of frames shares; the smaller p
    counts twice. Combinations of strengths of which V holds only rounding (VISIBLE), such as a gain common to all
    frames beside lights, are left out.

    Source: Brunner, Dette & Munk, Box-type approximations in nonparametric factorial designs, J. Am. Stat. Assoc. 92,
    1494 (1997)."""
    from scipy.stats import f as fisher

    ps, white = [], st.root(information, st.VISIBLE)
    for b, parts in variances:
        spread, vectors = np.linalg.eigh(white @ b @ white.T)
        known = spread > st.TRUNCATION * max(spread.max(initial=0.0), 1e-300)
        spread, z, k = spread[known], vectors[:, known].T @ white @ score, int(known.sum())
        if not k or parts < 3:
            continue
        if parts >= 2 * k:
            ps.append(float(fisher.sf(np.sum(z**2 / spread) * (parts - k) / (k * (parts - 1)), k, parts - k)))
        else:
            h, square = spread.sum() ** 2 / np.sum(spread**2), float(z @ z)
            whole = float(fisher.sf(square / spread.sum(), h, h * (parts - 1)))
            along = float(fisher.sf(square**2 / max(k * float(z**2 @ spread), 1e-300), k, parts - 1))
            ps.append(min(2 * min(whole, along), 1.0))
    return max(ps, default=math.nan)


# -- what other effects say ------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Learnt:
    """The variance of a score by those of other effects, for one of `maps_of`: phi = level (1 + weights . reach) with
    `dof` degrees of freedom."""

    level: float
    weights: np.ndarray
    dof: float


class Others:
    """Images of effects that are not there, by which clutter is measured beside that of an effect which may be.

    images   per block, (n, k): after all that is calibrated, and the effect itself, is projected off
    left     per block, (n,) whitened residual with that effect in the model

    Their images are made independent first: directions x with x'x = 1, in which noise alone gives phi = 1. Of each
    direction the scatter between parts and the square of its score together give one value of phi. The square also
    sees a pattern that all parts share."""

    def __init__(self, images: Sequence[np.ndarray], left: Sequence[np.ndarray], places: Sequence[dict]):
        self.places, self.learnt = places, list[Learnt]()
        root = st.root(sum(x.T @ x for x in images), st.VISIBLE)
        if len(root) < FEWEST or not {"row", "column"} <= set(places[0]):
            return
        directions = [x @ root.T for x in images]
        square = sum(x.T @ r for x, r in zip(directions, left)) ** 2
        self.squares = _squares(places)
        reach = np.stack([np.diag(parts.together(directions)) for parts in self.squares], -1)
        for (b, _), dof in zip(variances(directions, left, places), _dof(directions, places)):
            self.learnt.append(_learn((dof * np.diag(b) + square) / (dof + 1), dof + 1, reach))

    def join(self, images: Sequence[np.ndarray], found: Sequence[Scatter]) -> list[Scatter]:
        """The variances `found` of the score of some images, joined with what others say of them."""
        if not self.learnt:
            return list(found)
        root = st.root(sum(x.T @ x for x in images))
        back, white = np.linalg.pinv(root), [x @ root.T for x in images]
        reach, joined = [parts.together(white) for parts in self.squares], []
        for (b, parts), dof, own in zip(found, _dof(white, self.places), self.learnt):
            d = min(float(dof.min(initial=math.inf)), parts - 1)
            expected = own.level * (np.eye(len(root)) + sum(w * m for w, m in zip(own.weights, reach)))
            joined.append(((d * b + own.dof * back @ expected @ back.T) / (d + own.dof), 1 + d + own.dof))
        return joined


def _squares(places: Sequence[dict]) -> list[Parts]:
    """Squares of the sensor that all frames share; the same of each frame."""
    rows, columns = (1 + max(float(p[name].max(initial=0.0)) for p in places) for name in ("row", "column"))
    shared = [(p["row"] * REACH // rows * REACH + p["column"] * REACH // columns).astype(int) for p in places]
    apart = [index + n * REACH**2 for n, index in enumerate(shared)]
    return [Parts(shared, REACH**2), Parts(apart, REACH**2 * len(places))]


def _dof(images: Sequence[np.ndarray], places: Sequence[dict]) -> list[np.ndarray]:
    """Per map, (k,) degrees of freedom of the scatter between its parts: V^2 / sum of V_g^2, as few where one part
    holds nearly all of an image."""
    found = []
    for parts in maps_of(places):
        power = parts.sums([x**2 for x in images])
        squares = np.sum(power**2, 0)
        found.append(np.divide(power.sum(0) ** 2, squares, out=np.ones(len(squares)), where=squares > 0))
    return found


def _learn(phi: np.ndarray, dof: np.ndarray, reach: np.ndarray) -> Learnt:
    """From phi (J,) of directions, each with its degrees of freedom, and how far they reach (J, 2).

    The weights a, b >= 0 by least squares, each phi with its own error; then level and d0 by the moments of log phi
    over what they predict (Smyth 2004, section 6.2), the first not below noise, the second not above J."""
    from scipy.optimize import nnls
    from scipy.special import digamma, polygamma

    expected, weights = np.ones(len(phi)), np.zeros(reach.shape[1])
    for _ in range(ROUNDS):
        w = np.sqrt(dof / 2) / expected
        weights = nnls(reach * w[:, None], (phi - 1) * w)[0]
        expected = 1 + reach @ weights
    e = np.log(np.maximum(phi, 1e-12) / expected) - digamma(dof / 2) + np.log(dof / 2)
    more = float(e.var(ddof=1) - polygamma(1, dof / 2).mean())
    d0 = min(2 * _trigamma_inverse(more) if more > 0 else math.inf, float(len(phi)))
    level = math.exp(float(e.mean()) + digamma(d0 / 2) - math.log(d0 / 2))
    return Learnt(max(level, 1.0), weights, d0)


def _trigamma_inverse(value: float) -> float:
    """y with trigamma(y) = value > 0, by Newton's method on its reciprocal (Smyth 2004, appendix)."""
    from scipy.special import polygamma

    y = 0.5 + 1 / value
    for _ in range(50):
        tri = float(polygamma(1, y))
        step = tri * (1 - tri / value) / float(polygamma(2, y))
        y += step
        if -step < 1e-8 * y:
            break
    return y
