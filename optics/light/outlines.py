"""Outlines: which part of each pixel shows which ball of a crowd, to some thousandths, and rays for it.

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
cells they are .003, and change smoothly.

Two outlines that cross within one cell are taken as independent there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.spatial import cKDTree

# Places on a pupil each way, at each of which outlines are worked out: the least, and more for each px of blur
ON_PUPIL, PER_BLUR, MOST_ON_PUPIL = 3, 2.5, 6
WORK = 6e7  # cells, places and pairs that are worked out, at most: of more, fewer places and cells
RAYS = 6e6  # behind a pupil, about, at most
# Groups of these places each way that have rays of their own, by the blur in radii of a ball, below which they suffice.
# One ray from the middle of places that see a ball from limb to limb finds it too bright
GROUPS = ((0.03, 1), (0.08, 2), (0.25, 3), (math.inf, MOST_ON_PUPIL))
SMALL = 1e-3  # of a cell: a part that is left to the others
NEAR = 2e-3  # of a radius: a ray is sent by at least so much beside an outline
# Of the way from a ball's outline to the middle of what a cut cell shows of it: the light of a ball rises from its
# outline with the root of the distance d, whose mean over 0 to d is its value at 4/9 d
LIMB = 1 / 9
FEWEST, MOST = 3, 24  # cells of a pixel each way
CELLS = 4e6  # of an image, at most, where balls are smaller than a pixel
HALF = 0.75  # px: half the diagonal of a pixel, and a little
AT_ONCE = 250_000  # cells of balls that are worked out together
NEWTON = 3  # steps to the place where a middle is seen
AROUND = np.array([[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]])[..., None]  # px, of the rays that tell a step
RIM = np.array([[0.0, 1.0, 0.5, 0.5], [0.5, 0.5, 0.0, 1.0]], np.float32)  # places on a pupil
ROOM = 1.15  # times the blur at these: balls that are looked for in a pixel

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


@dataclass(frozen=True)
class Grain:
    """How finely images are made: the same for all images of a renderer, as a finer one differs a little.

    radius  of a ball, px;   blur  px for each mm of a pupil's radius;   cells  of a pixel each way
    pairs   of a pixel and a ball that it may show, which bound what is worked out behind a pupil"""

    radius: float
    blur: float
    cells: int
    pairs: int = 0

    def behind(self, pupil: float) -> Plan:
        """How an image is made behind a pupil of this radius, mm."""
        if not pupil:
            return Plan(self.cells, 1, 1, self.cells)
        cells, blur = self.cells, self.blur * pupil
        side = int(np.clip(math.ceil(ON_PUPIL + PER_BLUR * blur), ON_PUPIL, MOST_ON_PUPIL))
        while self.pairs * (cells * side) ** 2 > WORK and side > ON_PUPIL:
            side -= 1
        while self.pairs * (cells * side) ** 2 > WORK and cells > FEWEST:
            cells -= 1
        groups = min(next(n for limit, n in GROUPS if blur < limit * self.radius), side)
        blocks = cells
        while self.pairs * (blocks * groups) ** 2 > RAYS and max(blocks, groups) > 1:
            # what rays share, in px, is to be as small in the image as on the pupil
            if groups == 1 or (blocks > 1 and (groups - 1) <= blur * (blocks - 1)):
                blocks -= 1
            else:
                groups -= 1
        return Plan(cells, side, groups, blocks)


@dataclass(frozen=True)
class Plan:
    """Cells of a pixel and places on a pupil, each way, at which outlines are worked out; and groups of places and
    blocks of cells, each way, that have a ray for each part."""

    cells: int
    side: int
    groups: int
    blocks: int

    def on_pupil(self) -> np.ndarray:
        """(2, n) places on the pupil, in the unit square: the middles of a grid, whatever the cell. Places that differ
        from cell to cell go with sides of the pixel, and leave ten times the error."""
        middles = (np.arange(self.side) + 0.5) / self.side
        return np.stack([a.ravel() for a in np.meshgrid(middles, middles)]).astype(np.float32)

    def together(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Numbers of the places, and of the cells in blocks (blocks, cells) of as many each, that share a ray."""
        blocks = _blocks(self.cells, self.blocks)
        alike = [np.stack([b for b in blocks if len(b) == size]) for size in {len(b) for b in blocks}]
        for places in _blocks(self.side, self.groups):
            yield from ((places, own) for own in alike)


def _blocks(side: int, count: int) -> list[np.ndarray]:
    """The numbers of the cells of a square grid in count x count blocks."""
    row, column = np.divmod(np.arange(side**2), side)
    block = (row * count // side) * count + column * count // side
    return [np.flatnonzero(block == k) for k in range(count**2)]


class Outlines:
    """The balls of a crowd in the pixels of one image.

    rays      of the camera, behind its windows;   shape  (H, W);   middles, radii  of the balls, mm
    pupil     its radius, mm; 0: a pinhole
    own       (H, W) bool: the pixels that show a ball, or may
    """

    def __init__(self, rays: Rays, shape: tuple[int, int], middles: np.ndarray, radii: np.ndarray, pupil: float = 0.0):
        self.rays, self.shape, self.middles, self.radii, self.pupil = rays, shape, middles, radii, pupil
        index = np.arange(shape[0] * shape[1])
        o, d = rays(index % shape[1] + 0.5, index // shape[1] + 0.5)
        self.pixel, self.ball, self.rank = (np.zeros(0, int),) * 3
        self.steps: list[np.ndarray] = []  # (N, 3) each, mm beside a ball for a px across and down
        # (N,) mm of a px at a ball, and over which its outline is blurred
        self.largest = self.blur = np.zeros(len(radii))
        own = np.zeros(len(index), bool)
        seen = _seen(o)
        if seen.any() and len(radii):
            own = self._find(o, d, seen)
        self.own = own.reshape(shape)

    def _find(self, o: np.ndarray, d: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """(H W,) pixels that show a ball; and the pairs of a pixel and a ball that it shows or may show, pixel by
        pixel from front to back."""
        height, width = self.shape
        u, v, self.steps, origins = self._places(o, d, seen)
        smallest, self.largest = _sizes(*self.steps)
        away = np.linalg.norm(self.middles - origins, axis=1)
        # the limb of a near ball is seen further aside than its radius at its distance
        aside = 1 / np.sqrt(np.maximum(1 - np.minimum(self.radii / np.maximum(away, 1e-9), 1) ** 2, 1e-4))
        self.blur = self._blurred(u, v)
        soft = ROOM * self.blur
        reach = aside * (self.radii + soft) / np.maximum(smallest, 1e-9) + 1.5
        reach = np.minimum(np.where(away > self.radii, reach, np.inf), 2.0 * max(self.shape))
        pixels, balls = [np.zeros(0, int)], [np.zeros(0, int)]
        for k in np.flatnonzero(smallest > 0):
            rows = np.arange(max(int(v[k] - reach[k]), 0), min(int(v[k] + reach[k]) + 1, height))
            columns = np.arange(max(int(u[k] - reach[k]), 0), min(int(u[k] + reach[k]) + 1, width))
            pixels.append((rows[:, None] * width + columns).ravel())
            balls.append(np.full(pixels[-1].size, k))
        pixel, ball = np.concatenate(pixels), np.concatenate(balls)
        s, t, _ = _missed(o[pixel], d[pixel], self.middles[ball])
        room = aside[ball] * (HALF * self.largest[ball] + soft[ball])
        shown = (s < self.radii[ball] + room) & (t > 0) & seen[pixel]
        pixel, ball, t = pixel[shown], ball[shown], t[shown]
        own = np.zeros(height * width, bool)
        own[pixel] = True
        order = np.lexsort((t, pixel))
        self.pixel, self.ball = pixel[order], ball[order]
        starts = np.flatnonzero(np.diff(self.pixel, prepend=-1))
        self.rank = np.arange(len(self.pixel)) - np.repeat(starts, np.diff([*starts, len(self.pixel)]))
        return own

    def _places(self, o: np.ndarray, d: np.ndarray, seen: np.ndarray) -> tuple:
        """(u, v) in px where middles are seen, what a px across and down is there, mm, 0 where none is seen, and where
        those rays start.

        From the pixel that looks most nearly the same way, steps along rays half a pixel aside: of windows that bend
        light no closed form is known."""
        known = np.flatnonzero(seen)
        to = self.middles - np.median(o[known], axis=0)
        _, at = cKDTree(d[known]).query(to / np.maximum(np.linalg.norm(to, axis=1, keepdims=True), 1e-9))
        place = np.stack(np.divmod(known[at], self.shape[1])[::-1]) + 0.5
        steps, origins = [np.zeros((len(to), 3))] * 2, o[known[at]]
        for _ in range(NEWTON):
            u, v = (place + AROUND).transpose(1, 0, 2).reshape(2, -1)
            starts, along = (a.reshape(5, -1, 3) for a in self.rays(u, v))
            there = _seen(starts.reshape(-1, 3)).reshape(5, -1)
            t = np.sum((self.middles - starts) * along, axis=-1, keepdims=True)
            x = starts + t * along
            now = []
            for k in (1, 3):
                halves = np.where(there[k : k + 2, :, None], [x[k] - x[0], x[0] - x[k + 1]], 0.0)
                step = halves.sum(0) * np.where(there[k] & there[k + 1], 1, 2)[:, None]  # one of them stands for both
                now.append(step - np.sum(step * along[0], axis=1, keepdims=True) * along[0])
            a, b, c = _products(*now)
            e = [np.sum(step * (self.middles - x[0]), axis=1) for step in now]
            det = a * c - b * b
            told = there[0] & (det > 0)
            steps = [np.where(told[:, None], new, old) for new, old in zip(now, steps)]
            origins = np.where(told[:, None], starts[0], origins)
            safe = np.where(told, det, 1.0)
            move = np.where(told, np.stack([c * e[0] - b * e[1], a * e[1] - b * e[0]]) / safe, 0.0)
            place = place + np.clip(move, -2.0 * max(self.shape), 2.0 * max(self.shape))
        return place[0], place[1], steps, origins

    def _blurred(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(N,) mm beside the balls over which a pupil blurs what lies there: by rays from its rim."""
        if not self.pupil:
            return np.zeros(len(u))
        o, d = self.rays(u, v)
        t = np.sum((self.middles - o) * d, axis=1, keepdims=True)
        found = []
        for place in RIM.T:
            start, along = self.rays(u, v, np.repeat(place[:, None], len(u), 1))
            s, _, _ = _missed(start, along, o + t * d)
            found.append(np.where(_seen(start) & _seen(o), s, 0.0))
        return np.max(found, axis=0)

    def grain(self, across: float) -> Grain:
        """For images like this one, of which a ball's radius is as long as `across` cells, in the median: where a pixel
        stands for several, with less noise, a ball has as many. Of a pupil whose radius is 1 mm."""
        shown = np.unique(self.ball)
        if not len(shown):
            return Grain(math.inf, 0.0, FEWEST)
        px = self.largest[shown]
        radius, blur = float(np.median(self.radii[shown] / px)), float(np.median(self.blur[shown] / px))
        most = math.sqrt(CELLS / max(int(self.own.sum()), 1))
        cells = int(max(min(math.ceil(across / radius), MOST, most), FEWEST))
        return Grain(radius, blur, cells, len(self.pixel))

    def shown(self, grain: Grain) -> Shown:
        """Rays for the parts of the pixels that show a ball, one for each part of each cell in the middle of what the
        cell shows of it, and of the pupil's places that it is shown to: they change as smoothly as outlines move."""
        ids, starts = np.unique(self.pixel, return_index=True)
        ends = np.r_[starts[1:], len(self.pixel)]
        plan = grain.behind(self.pupil)
        places = plan.on_pupil()
        parts, begin = [], 0
        while begin < len(ids):
            most = max(AT_ONCE // (plan.cells * plan.side) ** 2, 1)
            stop = max(int(np.searchsorted(ends, starts[begin] + most, side="right")), begin + 1)
            own = slice(int(starts[begin]), int(ends[stop - 1]))
            parts.append(_Cells(self, ids[begin:stop], own, plan.cells, places).shown(plan))
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

    def shown(self, plan: Plan) -> Shown:
        """The rays, for each part one for each group of places on the pupil and block of cells."""
        found = [self._from(places, blocks) for places, blocks in plan.together()]
        joined = Shown(*(np.concatenate([getattr(one, f.name) for one in found], axis=-1) for f in fields(Shown)))
        order = np.argsort(joined.pixel, kind="stable")
        joined = Shown(*(getattr(joined, f.name)[..., order] for f in fields(Shown)))
        at = np.searchsorted(self.ids, joined.pixel)
        return replace(joined, weight=(joined.weight / np.bincount(at, joined.weight)[at]).astype(np.float32))

    def _from(self, places: np.ndarray, blocks: np.ndarray) -> Shown:
        """Those of some places on the pupil and of blocks (blocks, cells) of as many cells each; their weights are
        shares of the cells."""
        shares = self.shares[:, places][..., blocks].transpose(0, 2, 1, 3)  # (parts, blocks, places, cells)
        part, block = np.nonzero(shares.mean((2, 3)) > SMALL)
        own = shares[part, block]
        share = own.sum((1, 2))
        cell = blocks[block]
        row, column = np.divmod(cell, self.side)
        at = []
        for middle, moved in ((column, self.across), (row, self.down)):
            inside = np.clip(moved[part[:, None, None], places[:, None], cell[:, None]], -0.49, 0.49)
            at.append(np.sum(own * (middle[:, None] + 0.5 + inside), (1, 2)) / share / self.side)
        pixel = self.ids[self.part_pixel[part]]
        return Shown(
            pixel,
            (pixel % self.width + at[0]).astype(np.float32),
            (pixel // self.width + at[1]).astype(np.float32),
            share,
            self.part_pair[part],
            own.min((1, 2)) < 1,
            ((own.sum(2) @ self.places[:, places].T).T / share).astype(np.float32),
        )


def _seen(o: np.ndarray) -> np.ndarray:
    """(N,) whether there are rays: beyond the image circle a fisheye's start far behind the world."""
    return np.abs(o).max(1) < 1e6


def _missed(o: np.ndarray, d: np.ndarray, middles: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Distance of middles from rays, how far along these they are beside them, and x, y, z from there to them."""
    to = [np.float32(middles[..., k]) - o[..., k] for k in range(3)]
    along = [d[..., k] for k in range(3)]
    t = to[0] * along[0] + to[1] * along[1] + to[2] * along[2]
    off = [a - t * b for a, b in zip(to, along)]
    return np.sqrt(off[0] * off[0] + off[1] * off[1] + off[2] * off[2]), t, off


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
    moment = (end - outer) ** 2 * (end + 2 * outer) / (6 * m * q)
    moment += np.maximum(flat**2 - np.minimum(size, flat) ** 2, 0.0) / (2 * m)
    return (0.5 + np.sign(g) * half).astype(np.float32), moment.astype(np.float32)


def _sizes(across: np.ndarray, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The least and most mm of a pixel whose sides are (N, 3) each."""
    a, b, c = _products(across, down)
    spread = np.sqrt(((a - c) / 2) ** 2 + b**2)
    smallest, largest = (np.sqrt(np.maximum((a + c) / 2 + sign * spread, 0.0)) for sign in (-1, 1))
    return smallest, largest


def _products(p: np.ndarray, q: np.ndarray) -> Iterator[np.ndarray]:
    """(N,) p p, p q, q q of vectors (N, 3)."""
    return (np.sum(one * other, axis=1) for one, other in ((p, p), (p, q), (q, q)))
