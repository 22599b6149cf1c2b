"""Balls painted by numpy: a quick image of a crowd, and how it changes where one ball moves.

A renderer needs a second for an image of beads that shade each other. Where thousands of places are tried, a plainer
model does:

    light of a place s of a ball with the normal n = share (polynomial of s, 2nd degree) x (1, n, n n)       `Glow`
    share: of its lights' irradiance, those that no other ball stands in the way of                          `shaded`
    a sample of a pixel shows the nearest ball that its ray meets, or the background                         `layers`

`Glow` is fitted to what the renderer itself says of balls that stand alone (`optics.fit.lone_beads`). As each sample
knows the nearest ball and the one behind it, the change of the image by a move of one ball is found for all balls at
once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

SIDE = 4  # samples of a pixel each way
CHUNK = 400  # balls at a time
BLOCKERS = 4  # balls that may shade one place from one light
DIMMEST = 0.12  # of the light of a ball that nothing shades


def of_normal(n: np.ndarray) -> np.ndarray:
    """(..., 9) 1, n, and the products of n's components but for the one that 1 gives."""
    x, y, z = np.moveaxis(n, -1, 0)
    return np.stack([np.ones_like(x), x, y, z, x * x, x * y, x * z, y * y, y * z], -1)


@dataclass
class Glow:
    """Light of balls that nothing shades: (10, 9, C) coefficients of the place's and the normal's polynomials.

    middle, scale   (3,) mm, of the places it was fitted to"""

    coefficients: np.ndarray
    middle: np.ndarray
    scale: np.ndarray

    @classmethod
    def fitted(cls, places: np.ndarray, normals: np.ndarray, light: np.ndarray) -> Glow:
        """Least squares of (M, C) light at places (M, 3) mm with normals (M, 3); what is darker than three standard
        deviations of the rest lies in a shadow, and counts no more."""
        middle = places.mean(0)
        scale = np.maximum(np.abs(places - middle).max(0), 1e-9)
        each = _of_place((places - middle) / scale)[:, :, None] * of_normal(normals)[:, None]
        columns = each.reshape(len(places), -1)
        kept = np.ones(len(places), bool)
        found = np.zeros((columns.shape[1], light.shape[1]))
        for _ in range(6):
            found = np.linalg.lstsq(columns[kept], light[kept], rcond=1e-9)[0]
            off = (light - columns @ found).sum(1)
            now = off > -3 * np.sqrt(np.mean(off[kept] ** 2))
            if (now == kept).all():
                break
            kept = now
        return cls(found.reshape(10, 9, -1), middle, scale)

    def times(self, factor: float) -> Glow:
        """The same with lights so many times as strong."""
        return replace(self, coefficients=self.coefficients * factor)

    def at(self, middles: np.ndarray) -> np.ndarray:
        """(N, 9, C) what the normal's terms count for balls at (N, 3) mm."""
        return np.einsum("np,pkc->nkc", _of_place((middles - self.middle) / self.scale), self.coefficients)


def _of_place(s: np.ndarray) -> np.ndarray:
    x, y, z = s.T
    return np.stack([np.ones_like(x), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z], -1)


def between(at: np.ndarray, known: np.ndarray, spots: np.ndarray, diameter: float) -> np.ndarray:
    """(N, S, BLOCKERS, 3) middles of the known balls (K, 3) that may stand between balls at (N, 3) and lights at
    (S, 3), the nearest to the line first, NaN where there is none."""
    found = np.full((len(at), len(spots), BLOCKERS, 3), np.nan)
    for start in range(0, len(at) if len(known) else 0, CHUNK):
        some = slice(start, start + CHUNK)
        line = spots - at[some, None]  # (n, S, 3)
        length = np.linalg.norm(line, axis=-1, keepdims=True)
        line = line / length
        off = known - at[some, None]  # (n, K, 3)
        along = np.einsum("nkc,nsc->nsk", off, line)
        away = np.sqrt(np.maximum((off**2).sum(-1)[:, None] - along**2, 0))
        # a ball itself, which may be among the known, lies at 0
        away = np.where((along > 0.3 * diameter) & (along < length), away, np.inf)
        order = np.argsort(away, -1)[..., :BLOCKERS]
        near = np.take_along_axis(away, order, -1) < 1.1 * diameter
        found[some, :, : order.shape[-1]] = np.where(near[..., None], known[order], np.nan)
    return found


def shaded(
    middles: np.ndarray, radius: float, normals: np.ndarray, spots: np.ndarray, blockers: np.ndarray
) -> np.ndarray:
    """(m, n) share of the light of point lights (S, 3) that comes to places of balls (m, 3) with normals (m, n, 3) past
    others: each light counts by its irradiance of a face that nothing shades.

    blockers   (m, S, B, 3) as of `between`"""
    middles, spots, blockers = (np.asarray(a, np.float32) for a in (middles, spots, blockers))
    places = middles[:, None] + np.float32(radius) * normals
    total = np.zeros(places.shape[:2], np.float32)
    left = np.zeros_like(total)
    for i, spot in enumerate(spots):
        to = spot - places
        distance = np.linalg.norm(to, axis=-1)
        to /= distance[..., None]
        light = np.maximum((normals * to).sum(-1), 0) / distance**2
        total += light
        for b in range(blockers.shape[2]):
            some = np.flatnonzero(np.isfinite(blockers[:, i, b, 0]))
            if len(some):
                off = blockers[some, i, b, None] - places[some]
                along = (off * to[some]).sum(-1)
                hit = (along > 0) & ((off**2).sum(-1) - along**2 < radius**2)
                light[some] = np.where(hit, 0, light[some])
        left += light
    return left / np.maximum(total, 1e-12)


@dataclass
class Box:
    """Some balls as the canvas meets them: of ball i in the n pixels around it, with k samples each.

    balls    (m,) numbers;   pixels  (m, n), -1 beyond the image
    t        (m, n, k) distance along the ray, infinite where it passes by;   light  (m, n, k, C)
    """

    balls: np.ndarray
    pixels: np.ndarray
    t: np.ndarray
    light: np.ndarray


class Canvas:
    """The rays of a camera's image, SIDE^2 in each pixel.

    rays    u, v -> origins (M, 3) and unit directions (M, 3) of rays through (M,) px, (M,) px
    shape   rows and columns of the image
    """

    def __init__(self, rays: Callable[..., tuple], shape: tuple[int, int], side: int = SIDE):
        self.shape, self.side = shape, side
        height, width = shape
        at = (np.arange(side) + 0.5) / side
        v, u, j, i = np.meshgrid(np.arange(height), np.arange(width), at, at, indexing="ij")
        o, d = rays((u + i).ravel(), (v + j).ravel())
        self.o, self.d = (np.asarray(a, np.float32).reshape(height * width, side**2, 3) for a in (o, d))

    @property
    def samples(self) -> int:
        """Of the whole image."""
        return self.o.shape[0] * self.o.shape[1]

    @staticmethod
    def parts(count: int) -> Iterator[np.ndarray]:
        """Numbers up to a count, so many at a time as fit into memory."""
        for start in range(0, count, CHUNK):
            yield np.arange(start, min(start + CHUNK, count))

    def around(self, at: np.ndarray, reach: float) -> np.ndarray:
        """(N, n) numbers of the pixels within `reach` px of places (N, 2) px, by rows and columns; -1 beyond the
        image."""
        height, width = self.shape
        half = int(np.ceil(reach))
        v, u = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
        finite = np.where(np.isfinite(at), at, -10.0 * half)
        column, row = (np.floor(finite[:, i, None]).astype(int) + step for i, step in ((0, u), (1, v)))
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        return np.where(inside, row * width + column, -1)

    def terms(self, pixels: np.ndarray, middles: np.ndarray, radii: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`meet` of balls and the rays of the pixels (m, n)."""
        o, d = self.o[pixels], self.d[pixels]
        return meet(o, d, np.float32(middles)[:, None, None], np.float32(radii)[:, None, None])


def meet(o: np.ndarray, d: np.ndarray, s: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (...), infinite where a ray passes by, and (..., 9) terms of the normal where rays meet balls of
    middles s and radii r."""
    off = s - o
    b = (off * d).sum(-1)
    root = r**2 - (off**2).sum(-1) + b**2
    hit = root > 0
    t = np.where(hit, b - np.sqrt(np.maximum(root, 0)), np.inf).astype(np.float32)
    n = (np.where(hit, t, b)[..., None] * d - off) / r[..., None]
    return t, of_normal(n)


def shine(terms: np.ndarray, glow: np.ndarray) -> np.ndarray:
    """(m, ..., C) light of balls by terms (m, ..., 9) of the normal and (m, 9, C) of `Glow.at`."""
    light = terms.reshape(len(terms), -1, 9) @ glow.astype(np.float32)
    return np.maximum(light, 0).reshape(*terms.shape[:-1], -1)


@dataclass
class Layers:
    """What each sample shows: of all samples the nearest ball and the one behind it, with distances and light."""

    first: np.ndarray  # (S,) numbers, -1: none
    near: np.ndarray  # (S,) mm
    light: np.ndarray  # (S, C)
    far: np.ndarray  # (S,) mm: of the second
    behind: np.ndarray  # (S, C)


def layers(boxes: list[Box], samples: int, background: np.ndarray) -> Layers:
    """The two nearest of all balls in each of the samples (of each pixel, one after the other).

    background   (S, C) light where there is none"""
    where, t, ball, light = [], [], [], []
    for box in boxes:
        hit = np.isfinite(box.t)
        k = box.t.shape[2]
        sample = box.pixels[:, :, None] * k + np.arange(k)
        where.append(sample[hit])
        t.append(box.t[hit])
        ball.append(np.broadcast_to(box.balls[:, None, None], hit.shape)[hit])
        light.append(box.light[hit])
    at, deep, number, shown = (np.concatenate(a) for a in (where, t, ball, light))
    order = np.lexsort((deep, at))
    at, deep, number, shown = at[order], deep[order], number[order], shown[order]
    start = np.flatnonzero(np.r_[True, at[1:] != at[:-1]]) if len(at) else np.zeros(0, int)
    next_ = start + 1
    more = (next_ < len(at)) & (at[np.minimum(next_, len(at) - 1)] == at[start])
    found = Layers(
        np.full(samples, -1),
        np.full(samples, np.inf, np.float32),
        background.copy(),
        np.full(samples, np.inf, np.float32),
        background.copy(),
    )
    found.first[at[start]], found.near[at[start]], found.light[at[start]] = number[start], deep[start], shown[start]
    second = next_[more]
    found.far[at[second]], found.behind[at[second]] = deep[second], shown[second]
    return found


def dims(shown: Layers, light: np.ndarray, count: int, samples: int) -> np.ndarray:
    """(N,) how much of the light that is painted each ball has in the pixels that it fills: least squares; of those
    that fill none, the median.

    light   (H, W, C);   count   of balls;   samples   of a pixel"""
    first = shown.first.reshape(-1, samples)
    full = (first == first[:, :1]).all(1) & (first[:, 0] >= 0)
    painted = shown.light.reshape(len(first), samples, -1).mean(1)[full]
    seen = light.reshape(-1, light.shape[-1])[full]
    ball = first[full, 0]
    above = np.bincount(ball, (painted * seen).sum(1), count)
    below = np.bincount(ball, (painted**2).sum(1), count)
    known = below > 0
    found = np.where(known, above / np.where(known, below, 1.0), np.nan)
    middle = np.nanmedian(found) if known.any() else 1.0
    return np.clip(np.where(known, found, middle), DIMMEST, 1 / DIMMEST).astype(np.float32)
