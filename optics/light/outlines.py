"""Outlines: which part of each pixel shows which ball of a crowd, to a thousandth, and rays for it.

Definition
    g = (R^2 - s^2)/(2 R)           s: distance of a ball's middle from a ray; R: its radius; g = 0 on its outline
    a_j(cell) = area of the cell on the side g_j > 0 of the line g_j + grad g_j x = 0
    w_j = a_j prod_{i before j} (1 - a_i),   w_0 = prod (1 - a_i)        0: what is behind all balls
over the cells of a grid in each pixel that shows a ball, front to back; behind a pupil, over such a grid for each of
many places on it. A pixel is then the mean over its cells of sum_j w_j L_j, with L_j the light of a ray through the
middle of what the cell shows of ball j.

Where rays go through a lattice of places and each counts as what it meets, a bead that moves changes pixels by jumps of
one ray. Of a camera of 12 bits that saw 45 beads 5 px wide, 64 rays a pixel left errors of .07 of the noise's variance,
512 left .008, and a bead that moved changed chi2 by 100 at random, so that no fit found the end of its valley. With 16
cells errors are .003, and the same as long as nothing moves far.

Two outlines that cross within one cell are taken as independent there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from scipy.spatial import cKDTree

# Places on a pupil each way, at each of which outlines are worked out: the least, and more for each px of blur. Of
# beads 5 px wide, blurred over half a pixel and one, errors are then .004 and .006 of the noise's variance
ON_PUPIL, PER_BLUR, MOST_ON_PUPIL = 3, 2.5, 6
SMALL = 1e-3  # of a cell: a part that is left to the others
NEAR = 2e-3  # of a radius: a ray is sent by at least so much beside an outline
# Of the way from a ball's outline to the middle of what a cut cell shows of it: the light of a ball rises from its
# outline with the root of the distance d, whose mean over 0 to d is its value at 4/9 d
LIMB = 1 / 9
FEWEST, MOST = 3, 24  # cells of a pixel each way
HALF = 0.75  # px: half the diagonal of a pixel, and a little
AT_ONCE = 250_000  # cells of balls that are worked out together
NEWTON = 4  # steps to the place where a middle is seen

Rays = Callable[..., tuple[np.ndarray, np.ndarray]]  # (u, v[, lens]) in px -> origins and unit directions (N, 3)


@dataclass(frozen=True, eq=False)
class Shown:
    """Rays for the parts of pixels, those of a pixel behind each other.

    pixel    (N,) its number, rising;   u, v  px
    weight   (N,) share of the pixel that a ray stands for: they add up to 1 in each
    pair     (N,) what it is to meet: a ball, by its pair (`Outlines`), or -1: none of them
    cut      (N,) whether its cell has other parts too
    lens     (2, N) places on the pupil in the unit square; of a pinhole its middle
    """

    pixel: np.ndarray
    u: np.ndarray
    v: np.ndarray
    weight: np.ndarray
    pair: np.ndarray
    cut: np.ndarray
    lens: np.ndarray


class Outlines:
    """The balls of a crowd in the pixels of one image.

    rays      of the camera, behind its windows;   shape  (H, W);   middles, radii  of the balls, mm
    pupil     its radius, mm; 0: a pinhole;   focus  distance at which the lens is sharp, mm
    own       (H, W) bool: the pixels that show a ball, or may
    """

    def __init__(
        self,
        rays: Rays,
        shape: tuple[int, int],
        middles: np.ndarray,
        radii: np.ndarray,
        pupil: float = 0.0,
        focus: float = 1.0,
    ):
        self.rays, self.shape, self.middles, self.radii = rays, shape, middles, radii
        self.pupil = pupil
        index = np.arange(shape[0] * shape[1])
        o, d = rays(index % shape[1] + 0.5, index // shape[1] + 0.5)
        self.pixel, self.ball = (np.zeros(0, int),) * 2
        self.rank = np.zeros(0, int)
        self.blur = 0.0  # px, the largest of all
        self.steps: list[np.ndarray] = []  # (N, 3) each, mm beside a ball for a px across and down
        self.radius = np.inf  # px, the median of the balls
        own = np.zeros(len(index), bool)
        seen = np.abs(o).max(1) < 1e6  # beyond the image circle a fisheye has no ray
        if seen.any() and len(radii):
            own = self._find(o, d, seen, focus)
        self.own = own.reshape(shape)

    def _find(self, o: np.ndarray, d: np.ndarray, seen: np.ndarray, focus: float) -> np.ndarray:
        """(H W,) pixels that show a ball; and the pairs of a pixel and a ball that it shows or may show, pixel by
        pixel from front to back."""
        height, width = self.shape
        u, v, self.steps = _seen_at(o, d, seen, self.shape, self.middles)
        smallest, largest = _sizes(*self.steps)
        away = np.linalg.norm(self.middles - np.median(o[seen], axis=0), axis=1)
        blur = self.pupil * np.abs(1 - away / focus)
        self.blur = float(np.max(blur / np.maximum(largest, 1e-9)))
        soft = blur + largest if self.pupil else blur
        reach = np.minimum((self.radii + soft) / np.maximum(smallest, 1e-9) + 1.5, 2.0 * max(self.shape))
        pixels, balls = [], []
        for k in np.flatnonzero(np.isfinite(u) & np.isfinite(v)):
            rows = np.arange(max(int(v[k] - reach[k]), 0), min(int(v[k] + reach[k]) + 1, height))
            columns = np.arange(max(int(u[k] - reach[k]), 0), min(int(u[k] + reach[k]) + 1, width))
            if len(rows) and len(columns):
                pixels.append((rows[:, None] * width + columns).ravel())
                balls.append(np.full(pixels[-1].size, k))
        if not pixels:
            return np.zeros(height * width, bool)
        pixel, ball = np.concatenate(pixels), np.concatenate(balls)
        s, t, _ = _missed(o[pixel], d[pixel], self.middles[ball])
        room = HALF * largest[ball] + soft[ball]
        shown = (s < self.radii[ball] + room) & (t > 0) & seen[pixel]
        pixel, ball, t = pixel[shown], ball[shown], t[shown]
        own = np.zeros(height * width, bool)
        own[pixel] = True
        order = np.lexsort((t, pixel))
        self.pixel, self.ball = pixel[order], ball[order]
        self.radius = (
            float(np.median((self.radii / np.maximum(largest, 1e-9))[np.unique(ball)])) if len(ball) else np.inf
        )
        starts = np.flatnonzero(np.diff(self.pixel, prepend=-1))
        self.rank = np.arange(len(self.pixel)) - np.repeat(starts, np.diff([*starts, len(self.pixel)]))
        return own

    def cells(self, across: float) -> int:
        """Cells of a pixel each way, of which a ball's radius is as long as `across`, in the median: images in which a
        pixel stands for several have as many cells in a ball, whose noise is less."""
        return int(np.clip(math.ceil(across / max(self.radius, 1e-6)), FEWEST, MOST))

    def shown(self, side: int) -> Shown:
        """Rays for the parts of the pixels that show a ball, one for each part of each of `side` x `side` cells in the
        middle of what the cell shows of it, and of the pupil's places that it is shown to: they change as smoothly as
        outlines move."""
        ids, starts = np.unique(self.pixel, return_index=True)
        ends = np.r_[starts[1:], len(self.pixel)]
        parts, begin, places = [], 0, _on_pupil(self.blur) if self.pupil else np.full((2, 1), 0.5, np.float32)
        while begin < len(ids):
            most = max(AT_ONCE // (side**2 * places.shape[1]), 1)
            stop = max(int(np.searchsorted(ends, starts[begin] + most, side="right")), begin + 1)
            own = slice(int(starts[begin]), int(ends[stop - 1]))
            parts.append(_Cells(self, ids[begin:stop], own, side, places).shown())
            begin = stop
        if not parts:
            none = np.zeros(0, np.float32)
            number = none.astype(int)
            return Shown(number, none, none, none, number, number > 0, np.zeros((2, 0), np.float32))
        return Shown(*(np.concatenate([getattr(p, f.name) for p in parts], axis=-1) for f in fields(Shown)))

    def aimed(self, shown: Shown, cut: np.ndarray, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """(n, 3) directions by which the rays `cut`, from `o` along `d`, meet what they are for: a ray whose cell an
        outline crosses may pass beside its ball, or meet one before it."""
        d = d.copy()
        pixel, pair = shown.pixel[cut], shown.pair[cut]
        first, last = (np.searchsorted(self.pixel, pixel, side=side) for side in ("left", "right"))
        rank = np.where(pair < 0, last, pair) - first
        for k in range(int(rank.max(initial=-1)) + 1):
            at = np.flatnonzero((rank >= k) & (first + k < last))
            ball = self.ball[first[at] + k]
            middles, radius = self.middles[ball], self.radii[ball]
            s, t, _ = _missed(o[at], d[at], middles)
            wanted = np.where(rank[at] == k, 1 - NEAR, 1 + NEAR) * radius
            wrong = np.flatnonzero((s > wanted) == (rank[at] == k))
            at, away = at[wrong], (wanted[wrong] / np.maximum(s[wrong], 1e-9))[:, None]
            off = o[at] + t[wrong, None] * d[at] - middles[wrong]
            to = middles[wrong] + off * away - o[at]
            d[at] = to / np.linalg.norm(to, axis=1, keepdims=True)
        return d


class _Cells:
    """The cells of some pixels that show a ball, `side` each way, for each place on a pupil, and their parts.

    ids   the pixels' numbers;   own  their pairs
    part_pixel, part_pair   of each part its pixel's place in `ids` and its pair, -1: what is behind all balls
    places   (2, grids) on the pupil in the unit square
    shares   (parts, grids, side^2) of each cell that belongs to it;   across, down  from the cell's middle to its own,
             in cells
    """

    def __init__(self, outlines: Outlines, ids: np.ndarray, own: slice, side: int, places: np.ndarray):
        self.width, self.ids, self.side, self.places = outlines.shape[1], ids, side, places
        grids = places.shape[1]
        row, column = np.divmod(np.arange(side**2), side)
        u = (ids % self.width)[:, None, None] + (column + 0.5) / side + np.zeros((1, grids, 1))
        v = (ids // self.width)[:, None, None] + (row + 0.5) / side + np.zeros((1, grids, 1))
        lens = np.broadcast_to(places[:, None, :, None], (2, *u.shape)).reshape(2, -1) if outlines.pupil else None
        o, d = (a.reshape(len(ids), -1, 3) for a in outlines.rays(u.ravel(), v.ravel(), lens))
        pixel, ball = np.searchsorted(ids, outlines.pixel[own]), outlines.ball[own]
        s, _, off = _missed(o[pixel], d[pixel], outlines.middles[ball][:, None])
        radius = outlines.radii[ball][:, None].astype(np.float32)
        g = (radius**2 - s**2) / (2 * radius)
        steps = [(step[ball, None] / (side * radius[..., None])).astype(np.float32) for step in outlines.steps]
        slopes = [sum(a * step[..., k] for k, a in enumerate(off)) for step in steps]  # of g, from cell to cell
        square = np.maximum(slopes[0] * slopes[0] + slopes[1] * slopes[1], 1e-24)
        g -= square / (24 * radius)  # by which an outline within a cell lies inside its tangent
        covers, moment = _cut(g, *slopes)
        middle = moment / np.maximum(covers, 1e-6)
        inside = (middle - LIMB * (middle + g) * (covers < 1)) / square  # times the slopes: from the cell's middle
        outside = -moment / np.maximum(1 - covers, 1e-6) / square
        behind = np.ones((len(ids), g.shape[1]), np.float32)
        pushed = [np.zeros_like(behind) for _ in slopes]
        moved = [np.zeros_like(covers) for _ in slopes]
        rank = outlines.rank[own]
        for k in range(int(rank.max(initial=-1)) + 1):
            at = np.flatnonzero(rank == k)  # one of each pixel
            left = behind[pixel[at]]
            for push, move, slope in zip(pushed, moved, slopes):
                move[at] = push[pixel[at]] + inside[at] * slope[at]
                push[pixel[at]] += outside[at] * slope[at]
            behind[pixel[at]] = left * (1 - covers[at])
            covers[at] *= left
        part_pixel = np.concatenate([pixel, np.arange(len(ids))])
        order = np.argsort(part_pixel, kind="stable")
        self.part_pixel = part_pixel[order]
        self.part_pair = np.concatenate([np.arange(own.start, own.stop), np.full(len(ids), -1)])[order]
        joined = (np.concatenate([a, b])[order] for a, b in ((covers, behind), *zip(moved, pushed)))
        self.shares, self.across, self.down = (a.reshape(len(order), grids, side**2) for a in joined)

    def shown(self) -> Shown:
        part, cell = np.nonzero(self.shares.mean(1) > SMALL)
        own = self.shares[part, :, cell]
        share = own.sum(1)
        across, down = (np.sum(own * a[part, :, cell], 1) / share for a in (self.across, self.down))
        row, column = np.divmod(cell, self.side)
        at = self.part_pixel[part]
        pixel = self.ids[at]
        return Shown(
            pixel,
            (pixel % self.width + (column + 0.5 + np.clip(across, -0.49, 0.49)) / self.side).astype(np.float32),
            (pixel // self.width + (row + 0.5 + np.clip(down, -0.49, 0.49)) / self.side).astype(np.float32),
            (share / np.bincount(at, share)[at]).astype(np.float32),
            self.part_pair[part],
            share < own.shape[1],
            ((own @ self.places.T).T / share).astype(np.float32),
        )


def _missed(o: np.ndarray, d: np.ndarray, middles: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Distance of middles from rays, how far along these they are beside them, and x, y, z from there to them."""
    to = [np.float32(middles[..., k]) - o[..., k] for k in range(3)]
    along = [d[..., k] for k in range(3)]
    t = to[0] * along[0] + to[1] * along[1] + to[2] * along[2]
    off = [a - t * b for a, b in zip(to, along)]
    return np.sqrt(off[0] * off[0] + off[1] * off[1] + off[2] * off[2]), t, off


def _on_pupil(blur: float) -> np.ndarray:
    """(2, n) places on the pupil, in the unit square, for outlines that are blurred over `blur` px: the middles of a
    grid. Places that differ from cell to cell go with sides of the pixel, and leave ten times the error."""
    side = int(np.clip(math.ceil(ON_PUPIL + PER_BLUR * blur), ON_PUPIL, MOST_ON_PUPIL))
    middles = (np.arange(side) + 0.5) / side
    return np.stack([a.ravel() for a in np.meshgrid(middles, middles)]).astype(np.float32)


def _cut(g: np.ndarray, across: np.ndarray, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Area of a square of side 1 in which g + across x + down y > 0, x and y from its middle, and the integral of
    across x + down y over it.

    With m >= q the sizes of the slopes, the area rises with g as a trapezoid A' does, of height 1/m up to |g| =
    (m - q)/2, which falls to 0 at (m + q)/2; the integral is that of |g| A' from |g| onwards."""
    m, q = np.maximum(np.abs(across), np.abs(down)), np.minimum(np.abs(across), np.abs(down))
    m, q, size = np.maximum(m, 1e-12), np.maximum(q, 1e-13), np.abs(g)
    flat, end = (m - q) / 2, (m + q) / 2
    outer = np.clip(size, flat, end)
    half = np.where(size < flat, size / m, 0.5 - (end - outer) ** 2 / (2 * m * q))
    moment = (end**3 / 6 - end * outer**2 / 2 + outer**3 / 3) / (m * q)
    moment += np.maximum(flat**2 - np.minimum(size, flat) ** 2, 0.0) / (2 * m)
    return (0.5 + np.sign(g) * half).astype(np.float32), moment.astype(np.float32)


def _seen_at(
    o: np.ndarray, d: np.ndarray, seen: np.ndarray, shape: tuple[int, int], middles: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """(u, v) in px where middles are seen, by the rays of all pixels, and what a px across and down is there, mm.

    From the pixel that looks most nearly the same way, steps along the images of its neighbours: of windows that bend
    light no closed form is known."""
    height, width = shape
    known = np.flatnonzero(seen)
    to = middles - np.median(o[known], axis=0)
    _, at = cKDTree(d[known]).query(to / np.linalg.norm(to, axis=1, keepdims=True))
    u, v = known[at] % width + 0.5, known[at] // width + 0.5
    steps: list[np.ndarray] = []
    for _ in range(NEWTON):
        column, row = (np.clip(np.nan_to_num(a).astype(int), 0, n - 1) for a, n in ((u, width), (v, height)))
        start = row * width + column

        def nearest(pixel: np.ndarray) -> np.ndarray:
            t = np.sum((middles - o[pixel]) * d[pixel], axis=1, keepdims=True)
            return o[pixel] + t * d[pixel]

        x = nearest(start)
        steps = []
        for n, size, stride in ((column, width, 1), (row, height, width)):
            sign = np.where(n + 1 < size, 1, -1) if size > 1 else np.zeros(len(n), int)
            step = (nearest(start + sign * stride) - x) * sign[:, None]
            steps.append(step - np.sum(step * d[start], axis=1, keepdims=True) * d[start])
        if height == 1:
            steps[1] = np.cross(d[start], steps[0])
        if width == 1:
            steps[0] = np.cross(steps[1], d[start])
        a, b, c = (np.sum(p * q, axis=1) for p, q in ((steps[0], steps[0]), (steps[0], steps[1]), (steps[1], steps[1])))
        e = [np.sum(step * (middles - x), axis=1) for step in steps]
        det = np.maximum(a * c - b * b, 1e-30)
        u, v = column + 0.5 + (c * e[0] - b * e[1]) / det, row + 0.5 + (a * e[1] - b * e[0]) / det
    return u, v, steps


def _sizes(across: np.ndarray, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The least and most mm of a pixel whose sides are (N, 3) each."""
    a, b, c = (np.sum(p * q, axis=1) for p, q in ((across, across), (across, down), (down, down)))
    spread = np.sqrt(((a - c) / 2) ** 2 + b**2)
    smallest, largest = (np.sqrt(np.maximum((a + c) / 2 + sign * spread, 0.0)) for sign in (-1, 1))
    return smallest, largest
