"""Beads found in images one behind the other, without a start.

What hides a bead is nearer to the camera, and so is what shades it from lights that stand there. So the nearest are
found first: a ball is tried at every pixel and depth, painted with the shadows of those that are known
(`optics.fit.painted`), and taken where it explains the image much better than what is there: by its size, and by how
its light falls to its rim. All balls found so far are fitted together, the scene itself rendering them; then those
behind them are sought in what is left, with less asked of each. Balls that explain nothing any more go, and before less
is asked those that are far off where they are seen: a ball that stands for several others is, a right one is not. At
last such balls are taken as well, and called doubtful.

    points, values = Seeker(reopen, "beads", frames, (0.4, 4.1), variables, Values()).seek()       (N, 3) mm
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optics.fit.bodies import ROUGH, State, _Equations, _Problem
from optics.fit.calibrate import with_start
from optics.fit.lone_beads import at_depth, glow, outline, rays, scattered, size
from optics.fit.model import value_of
from optics.fit.painted import DIMMEST, SIDE, Box, Canvas, Glow, Layers, between, dims, layers, of_normal, shaded, shine
from optics.fit.scene_model import SceneModel
from optics.scene.parameter import Values, Variable

PAINTED = 0.03  # of the light, by which a painted ball may be off
GRADE = 0.025  # of the radius in px, from one depth that is tried to the next
STRICT = (200.0, 100.0, 50.0, 25.0, 12.0, 6.0, 3.0)  # times a ball must explain what it leaves, first and later
COARSE = 10.0  # the same of a ball in the middle of a pixel, which may be half of one aside
FINER = (0.5, 0.25, 0.125)  # px, and steps of depth, by which places are mended
SMALL = 4.0  # px: balls of a smaller radius are tried in parts of pixels
MOST = 800  # places that are mended in a sweep
FEWEST, PART = 9, 0.35  # pixels that must show a ball, or of those that it fills if they are few
SEEN = 40.0  # chi2 that a ball must explain
BRIGHTEST = 1.05  # of the light of a ball that nothing shades
TOUCH = 0.93  # diameters: balls are no nearer to each other, but for the errors of their places
SAME = 0.6  # diameters: two so near are one
NEAR_BALLS = 0.99  # quantile of an image that balls near the camera show
FEW = 0.03  # of the balls, found in a sweep: then less is asked
LATER = 4  # where STRICT goes on from, once all balls were fitted
DOUBTFUL = 1.0  # mean of log(1 + chi2) where a ball is seen, from which on it is in doubt: noise alone has .53
ELSEWHERE = 0.2  # diameters, from the place of a ball that was in doubt
SWEEPS, SETTLE, AFTER = 40, 6, 2  # at most; steps of the fit after each, and without those in doubt
ROOM = 1.0  # px beyond an outline that a step of a difference changes
CHUNK = 4000  # places at a time


@dataclass
class View:
    """A frame: its number, the light of balls alone, (S, 3) mm of its lights, (H, W, C) of the image above black, of
    the ground without balls, and of what pixels count."""

    frame: int
    glow: Glow
    spots: np.ndarray
    image: np.ndarray
    ground: np.ndarray
    used: np.ndarray


@dataclass
class Painting:
    """A view painted: boxes of all balls and what samples show, each ball as bright as it is seen, `dim` of what was
    painted; (N, S, B, 3) what may shade each."""

    boxes: list[Box]
    shown: Layers
    dim: np.ndarray
    blockers: np.ndarray


Canvases = tuple[Canvas, Canvas]  # rays of all samples, and of the middles of pixels


class Painted(_Problem):
    """The frames of a model as a function of the places of balls, with derivatives of painted balls.

    rough   share of the light that the prediction may miss, while balls are missing
    """

    def __init__(
        self,
        model: SceneModel,
        name: str,
        variables: Sequence[Variable],
        views: Sequence[View],
        canvases: Canvases,
        rough: float,
    ):
        super().__init__(model, model.scene.parts[name], list(variables), [v.frame for v in views], rough)
        self.views, (self.canvas, self.centre) = list(views), canvases

    def balls(self, points: np.ndarray, values: Values, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Middles and radii in a frame."""
        self.place(points)
        self.model.renderer.apply(self.model.at(values, frame))
        middles, radii = self.part.balls()
        return middles.copy(), radii.copy()

    def paint(
        self,
        view: View,
        numbers: np.ndarray,
        pixels: np.ndarray,
        middles: np.ndarray,
        radii: np.ndarray,
        blockers: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """(m, n, k) distances and (m, n, k, C) light of some balls in pixels (m, n)."""
        t, terms = self.canvas.terms(pixels, middles[numbers], radii[numbers])
        light = shine(terms, view.glow.at(middles[numbers]))
        normals = self.centre.terms(pixels, middles[numbers], radii[numbers])[1][:, :, 0, 1:4]
        normals = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
        share = shaded(middles[numbers], float(radii[0]), normals, view.spots, blockers[numbers])
        t[pixels < 0] = np.inf
        return t, light * share[..., None, None]

    def painting(self, points: np.ndarray, values: Values, predictions: Sequence[np.ndarray]) -> list[Painting]:
        """All views, each ball as bright as it is predicted."""
        samples, found = self.canvas.samples, []
        for view, prediction in zip(self.views, predictions):
            middles, radii = self.balls(points, values, view.frame)
            blockers = between(middles, middles, view.spots, 2 * float(radii.max()))
            reach = outline(self.model, middles, radii) * 1.05 + ROOM
            pixels = self.canvas.around(self.model.scene.camera.project(middles), reach)
            boxes = []
            for some in self.canvas.parts(len(points)):
                t, light = self.paint(view, some, pixels[some], middles, radii, blockers)
                boxes.append(Box(some, pixels[some], t, light))
            dark = np.zeros((samples, prediction.shape[2]), np.float32)
            shown = layers(boxes, samples, dark)
            light = prediction - self.model.noise.black_level
            dim = dims(shown, light, len(points), self.canvas.side**2)
            for box in boxes:
                box.light *= dim[box.balls][:, None, None, None]
            found.append(Painting(boxes, layers(boxes, samples, dark), dim, blockers))
        return found

    def linearise(self, points: np.ndarray, values: Values, state: State) -> _Equations:
        self.look(points, values)
        predictions, residuals = state
        self.scales = self.weights(values, predictions)
        size, channels, n = residuals[0].size, residuals[0].shape[2], self.canvas.side**2
        rows, columns, entries = [], [], []
        for k, painting in enumerate(self.painting(points, values, predictions)):
            view, shown = self.views[k], painting.shown
            moved = {
                (axis, sign): self.balls(points + sign * self.axes[:, axis], values, view.frame)
                for axis in range(3)
                for sign in (1, -1)
            }
            for box in painting.boxes:
                sample = np.maximum(box.pixels[..., None], 0) * n + np.arange(n)
                own = shown.first[sample] == box.balls[:, None, None]
                other_t = np.where(own, shown.far[sample], shown.near[sample])
                other = np.where(own[..., None], shown.behind[sample], shown.light[sample])
                scale = self.scales[k].reshape(-1, channels)[np.maximum(box.pixels, 0)]
                dim = painting.dim[box.balls][:, None, None, None]
                for axis in range(3):
                    change: Any = 0.0
                    for sign in (1, -1):
                        t, light = self.paint(view, box.balls, box.pixels, *moved[axis, sign], painting.blockers)
                        change = change + sign * np.where((t < other_t)[..., None], dim * light, other).mean(2)
                    value = change / 2 * scale
                    used = (box.pixels >= 0) & (value != 0).any(-1)
                    ball, _ = np.nonzero(used)
                    rows.append((k * size + box.pixels[used][:, None] * channels + np.arange(channels)).ravel())
                    columns.append(np.repeat(3 * box.balls[ball] + axis, channels))
                    entries.append(value[used].ravel())
        return self.equations((rows, columns, entries), residuals, points, values)


@dataclass
class Found:
    """What is known between sweeps: (N, 3) mm, values, of each view (P, C) light that is predicted, and (P,) mm, how
    near each pixel's nearest ball is; (N,) how far off each ball is where it is seen."""

    points: np.ndarray
    values: Values
    shown: list[np.ndarray]
    near: np.ndarray
    off: np.ndarray


def in_doubt(off: np.ndarray) -> np.ndarray:
    """Which balls are far off where they are seen: more than noise, and than twice the others, as a scene may be wrong
    everywhere."""
    return off > max(DOUBTFUL, 2 * float(np.median(off))) if len(off) else np.zeros(0, bool)


class Seeker:
    """Finds the balls of a crowd in frames that show them at the same places.

    reopen      (N, 3) places -> the model with as many balls there
    frames      their numbers;   depths   mm, of the highest and the lowest middle that there may be
    variables   of a model, what is fitted with the places
    """

    def __init__(
        self,
        reopen: Callable[[np.ndarray], SceneModel],
        name: str,
        frames: Sequence[int],
        depths: tuple[float, float],
        variables: Callable[[SceneModel], list[Variable]],
        values: Values,
        progress: Callable[[str, int, int], None] | None = None,
    ):
        self.reopen, self.name, self.depths = reopen, name, depths
        self.prior = sum(depths) / 2, (depths[1] - depths[0]) / np.sqrt(12)  # of equal chances between both
        self.variables, self.progress = variables, progress
        model = reopen(np.array([[0.0, 0.0, -sum(depths) / 2]]))
        self.diameter = size(model.scene.parts[name])
        self.model = model = reopen(scattered(model, depths, self.diameter, 0))
        self.values = with_start(model, variables(model), values)
        fine, self.centre = (Canvas(lambda u, v: rays(model, u, v), model.shape[:2], side) for side in (SIDE, 1))
        self.canvases = fine, self.centre
        self.views = [self._view(f) for f in frames]
        self._level(variables(model))
        self.levels = self._levels()
        self.refuted = np.zeros((0, 3))  # places of balls that were in doubt
        height, width = model.shape[:2]
        middle = at_depth(model, np.array([[width / 2, height / 2]]), np.array([sum(depths) / 2]))
        wide = outline(model, middle, np.array([self.diameter / 2]))
        self.fewest = min(FEWEST, int(PART * np.pi * (wide - 0.5) ** 2))
        small = wide < SMALL
        self.tried = Canvas(lambda u, v: rays(model, u, v), model.shape[:2], 3) if small else self.centre
        per = 2 if small else 1  # places that are tried in a pixel each way
        v, u = (np.mgrid[: height * per, : width * per].reshape(2, -1) + 0.5) / per
        self.pixel = v.astype(int) * width + u.astype(int)
        places = np.column_stack([u, v])
        self.grid = np.stack([at_depth(model, places, np.full(len(u), d)) for d in self.levels], 1)  # (P, L, 3) mm
        _, d = rays(model, np.array([width / 2, width / 2 + 1]), np.full(2, height / 2))
        self.pitch = float(np.arccos(np.clip(d[0] @ d[1], -1, 1)))  # rad of a pixel in the middle of the image

    # -- what is known before -----------------------------------------------------------------------------------------
    def _view(self, frame: int) -> View:
        model = self.model
        found, ground = glow(model, self.name, self.values, frame, self.canvases[0], self.depths)
        image = np.asarray(model.frames[frame].image, float) - model.noise.black_level
        return View(frame, found, self._spots(frame), image, ground, model.usable(frame))

    def _spots(self, frame: int) -> np.ndarray:
        """(S, 3) mm: the points of the lights that are on in a frame."""
        scene: Any = self.model.scene
        now = self.model.at(self.values, frame)
        self.model.renderer.apply(now)
        lit = [n for n, led in scene.leds.items() if np.any(np.asarray(now[scene.powers[n]]) != 0)]
        points = [p for n in lit for p in scene.integrator.spots(scene.leds[n])]
        return np.array([np.array(p, float).ravel()[:3] for p in points]).reshape(-1, 3)

    def _level(self, variables: Sequence[Variable]) -> None:
        """Begin with lights of about the right power: the brightest of an image are balls near the camera that
        nothing shades."""
        model, eye = self.model, self.model.renderer._eye()
        height, width = model.shape[:2]
        nearest = at_depth(model, np.array([[width / 2, height / 2]]), np.array([self.depths[1]]))
        toward = (eye - nearest) / np.linalg.norm(eye - nearest)
        powers = set(model.scene.powers.values())
        factors: dict[str, list[float]] = {}
        for view in self.views:
            alone = float((of_normal(toward) @ view.glow.at(nearest)[0]).sum())
            seen = float(np.quantile(view.image.sum(-1)[view.used.any(-1)], NEAR_BALLS))
            factor = max(seen, 0.0) / max(alone, 1e-30)
            view.glow = view.glow.times(factor)
            view.ground = view.ground * factor
            now = model.at(self.values, view.frame)
            for key in powers:
                if np.any(np.asarray(now[key]) != 0):
                    factors.setdefault(key, []).append(factor)
        for v in variables:
            for key in powers & {*v.keys} & factors.keys():
                self.values.put(v, value_of(model, self.values, v) * float(np.median(factors[key])))

    def _levels(self) -> np.ndarray:
        """Depths to try, whose outlines differ by GRADE."""
        eye = self.model.renderer._eye()
        near, far = (-d - eye[2] for d in reversed(self.depths))
        count = max(2, int(np.ceil(np.log(far / near) / GRADE)) + 1)
        return -(np.geomspace(near, far, count) + eye[2])

    # -- the search ---------------------------------------------------------------------------------------------------
    def seek(self, points: np.ndarray | None = None, values: Values | None = None) -> tuple[np.ndarray, Values]:
        """(N, 3) mm, and the values that were fitted with them.

        points, values   of balls that were found before, and fitted: those that go on explaining something stay as
                         they are, and what is left is asked less of from the first"""
        shown = [view.ground.reshape(-1, view.ground.shape[2]) for view in self.views]
        if points is None:
            nothing = Found(np.zeros((0, 3)), self.values, shown, np.full(len(shown[0]), np.inf), np.zeros(0))
            found = self.swept(nothing, 0)
        else:
            found = self.swept(self.believed(self.settled(points, values or self.values, 0)), LATER)
        found = self.swept(self.believed(found), LATER, doubt=False)
        return found.points, found.values

    def swept(self, found: Found, grade: int, doubt: bool = True) -> Found:
        """What sweeps come to, from a grade of STRICT on.

        doubt   whether balls that are in doubt go before less is asked, for others to be found in their place"""
        self.refuted, doubted = np.zeros((0, 3)), not doubt
        for sweep in range(SWEEPS):
            if self.progress:
                self.progress("beads", sweep, SWEEPS)
            more, before = self.candidates(found, STRICT[grade]), len(found.points)
            if len(more):
                found = self.settled(np.concatenate([found.points, more]), found.values)
            if len(found.points) > (1 + FEW) * before:
                continue
            if not doubted:
                before, found, doubted = len(found.points), self.believed(found), True
                if len(found.points) < before:
                    continue
            grade += 1
            self.refuted, doubted = np.zeros((0, 3)), not doubt
            if grade == len(STRICT):
                break
        return found

    def believed(self, found: Found) -> Found:
        """What is left without balls that are in doubt: the worse half of them goes first, as a wrong ball makes its
        neighbours doubtful. None is sought there again while as much is asked."""
        while (doubtful := in_doubt(found.off)).any():
            worse = found.off >= np.median(found.off[doubtful])
            self.refuted = np.concatenate([self.refuted, found.points[worse]])
            found = self.settled(found.points[~worse], found.values, AFTER)
        return found

    def weigh(self, points: np.ndarray, found: Found, strict: float, shade: Sequence[np.ndarray] = ()) -> np.ndarray:
        """(M,) scores of balls at (M, 3) places in front of what is found: the fall of chi2, less `strict` times what
        the ball leaves in its pixels.

        shade   of each view (M, S, B, 3) what may stand in its light (optics.fit.painted.between); none: nothing"""
        radius = self.diameter / 2
        at = self.model.scene.camera.project(points)
        reach = outline(self.model, points, np.full(len(points), radius)) if len(points) else 0.0
        score = np.full(len(points), -np.inf)
        for start in range(0, len(points), CHUNK):
            some = slice(start, start + CHUNK)
            pixels = self.tried.around(at[some], reach)
            inside = np.maximum(pixels, 0)
            t, terms = self.tried.terms(inside, points[some], np.full(len(pixels), radius))
            visible = (pixels >= 0) & (t.max(-1) < found.near[inside]) & self._inner(points[some], inside)
            normals = terms[..., 1:4].mean(2)
            fall, left = np.zeros((2, len(pixels)))
            for k, view in enumerate(self.views):
                light = shine(terms, view.glow.at(points[some])).mean(2)
                if len(shade):
                    light *= shaded(points[some], radius, normals, view.spots, shade[k][some])[..., None]
                y, p = (a.reshape(len(found.near), -1)[inside] for a in (view.image, found.shown[k]))
                w = visible[..., None] * view.used.reshape(len(found.near), -1)[inside] / self._variance(y, p)
                a = (w * y * light).sum((1, 2)) / np.maximum((w * light**2).sum((1, 2)), 1e-30)
                a = np.clip(a, DIMMEST, BRIGHTEST)[:, None, None]
                remains = (w * (y - a * light) ** 2).sum((1, 2))
                left += remains
                fall += (w * (y - p) ** 2).sum((1, 2)) - remains
            score[some] = np.where(visible.sum(1) >= self.fewest, fall - strict * left, -np.inf)
        return score

    def _inner(self, points: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """Which pixels' middles lie within the outlines of balls by more than half of a pixel."""
        o, d = self.centre.o[pixels, 0], self.centre.d[pixels, 0]
        off = points[:, None].astype(np.float32) - o
        along = (off * d).sum(-1)
        away = np.sqrt(np.maximum((off**2).sum(-1) - along**2, 0))
        return away < self.diameter / 2 - 0.5 * self.pitch * along

    def _variance(self, y: np.ndarray, p: np.ndarray) -> np.ndarray:
        light, noise = np.maximum(y, p), self.model.noise
        return noise.variance(np.maximum(light, 0) + noise.black_level) + (PAINTED * light) ** 2

    def candidates(self, found: Found, strict: float) -> np.ndarray:
        """(M, 3) places of balls that are worth adding, none of which overlaps another in the image."""
        from scipy.spatial import cKDTree

        excess, values = np.zeros(len(found.near)), 0
        for view, p in zip(self.views, found.shown):
            y = view.image.reshape(p.shape)
            excess += (view.used.reshape(p.shape) * (y - p) ** 2 / self._variance(y, p)).sum(1)
            values += p.shape[1]
        worth = excess[self.pixel] > 2.0 * values
        known = cKDTree(found.points) if len(found.points) else None

        back = cKDTree(self.refuted) if len(self.refuted) else None

        def free(at: np.ndarray) -> np.ndarray:
            apart = np.ones(len(at), bool) if known is None else known.query(at)[0] > TOUCH * self.diameter
            return apart if back is None else apart & (back.query(at)[0] > ELSEWHERE * self.diameter)

        at = self.grid[worth].reshape(-1, 3)
        at = at[free(at)] if len(at) else at
        score = self.weigh(at, found, min(strict, COARSE))
        at, score = at[score > SEEN], score[score > SEEN]
        at = at[self._apart(at, score, 0.6, deep=True)[:MOST]]
        if not len(at):
            return at
        shade = [between(at, found.points, view.spots, self.diameter) for view in self.views]
        for step in FINER:
            at = self._closer(at, found, strict, shade, step)
        score = self.weigh(at, found, strict, shade)
        good = (score > SEEN) & free(at)
        return at[good][self._apart(at[good], score[good], 2.0)]

    def _apart(self, at: np.ndarray, score: np.ndarray, radii: float, deep: bool = False) -> np.ndarray:
        """Numbers of the best of places (N, 3), best first, that keep so many radii from each better one in the image;
        `deep`: or two steps of depth."""
        if not len(at):
            return np.zeros(0, int)
        wide = radii * outline(self.model, at, np.full(len(at), self.diameter / 2))
        away = np.log(np.linalg.norm(at - self.model.renderer._eye(), axis=1)) / (2 * GRADE) * wide
        places = np.column_stack([self.model.scene.camera.project(at), away if deep else 0 * away])
        picked: list[int] = []
        for i in np.argsort(-score):
            if not picked or np.linalg.norm(places[picked] - places[i], axis=1).min() > 0.999 * wide:
                picked.append(int(i))
        return np.array(picked)

    def _closer(
        self, at: np.ndarray, found: Found, strict: float, shade: Sequence[np.ndarray], step: float
    ) -> np.ndarray:
        """The same places, each moved to the best of those around it, `step` px and as many steps of depth away."""
        away = at - self.model.renderer._eye()
        distance = np.linalg.norm(away, axis=1)[:, None]
        line = away / distance
        across = np.cross(line, [0.0, 1.0, 0.0])
        across /= np.linalg.norm(across, axis=1)[:, None]
        steps = np.stack([self.pitch * across, self.pitch * np.cross(line, across), GRADE * line], 1)
        moves = step * np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
        tried = at[:, None] + np.einsum("mk,nkc->nmc", moves, distance[..., None] * steps)
        each = [np.repeat(of, len(moves), 0) for of in shade]
        score = self.weigh(tried.reshape(-1, 3), found, strict, each).reshape(len(at), -1)
        return tried[np.arange(len(at)), score.argmax(1)]

    def _problem(self, points: np.ndarray) -> Painted:
        self.model = model = self.reopen(points)
        problem = Painted(model, self.name, self.variables(model), self.views, self.canvases, ROUGH)
        problem.prior = self.prior
        return problem

    def settled(self, points: np.ndarray, values: Values, steps: int = SETTLE) -> Found:
        """Fit all places together, drop what explains nothing, and take the level of the lights from the rest."""
        problem = self._problem(points)
        points, values, (predictions, _) = problem.settle(points, values, steps)
        paintings = problem.painting(points, values, predictions)
        kept = self.needed(paintings, points, predictions)
        if not kept.all():
            points = points[kept]
            problem = self._problem(points)
            predictions, _ = problem.residual(points, values)
            paintings = problem.painting(points, values, predictions)
        samples = self.canvases[0].side ** 2
        for view, painting in zip(self.views, paintings):
            seen = painting.dim * dims(painting.shown, view.image, len(points), samples)
            view.glow = view.glow.times(float(np.median(seen)))
        shown = self._shown(predictions)
        near = paintings[0].shown.near.reshape(-1, samples).min(1)
        return Found(points, values, shown, near, self.misfit(paintings, shown, len(points)))

    def doubtful(self, points: np.ndarray, values: Values) -> np.ndarray:
        """(N,) whether a ball is far off in the pixels that show it."""
        problem = self._problem(points)
        predictions, _ = problem.residual(points, values)
        paintings = problem.painting(points, values, predictions)
        return in_doubt(self.misfit(paintings, self._shown(predictions), len(points)))

    def _shown(self, predictions: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Of each view (P, C) predicted light."""
        return [(p - self.model.noise.black_level).reshape(-1, p.shape[2]) for p in predictions]

    def misfit(self, paintings: Sequence[Painting], shown: Sequence[np.ndarray], count: int) -> np.ndarray:
        """(N,) mean of log(1 + chi2) over the values in which each ball is the nearest: a pixel that is far off does
        not count for many."""
        samples = self.canvases[0].side ** 2
        above, below = np.zeros(count), np.zeros(count)
        for view, painting, p in zip(self.views, paintings, shown):
            y, used = view.image.reshape(p.shape), view.used.reshape(p.shape)
            each = used * np.log1p((y - p) ** 2 / self._variance(y, p))
            first = painting.shown.first.reshape(-1, samples)
            ball = np.where(first >= 0, first, count)
            for k in range(samples):
                above += np.bincount(ball[:, k], each.sum(1), count + 1)[:count]
                below += np.bincount(ball[:, k], used.sum(1), count + 1)[:count]
        return above / np.maximum(below, 1)

    def needed(
        self, paintings: Sequence[Painting], points: np.ndarray, predictions: Sequence[np.ndarray]
    ) -> np.ndarray:
        """Which balls explain more than they cost, by chi2 where each is taken away, and are no second of another."""
        from scipy.spatial import cKDTree

        gain, n = np.zeros(len(points)), self.canvases[0].side ** 2
        for view, painting, prediction in zip(self.views, paintings, predictions):
            p = (prediction - self.model.noise.black_level).reshape(-1, prediction.shape[2])
            y = view.image.reshape(p.shape)
            w = view.used.reshape(p.shape) / self._variance(y, p)
            first, behind = (a.reshape(len(p), n, -1) for a in (painting.shown.first, painting.shown.behind))
            for box in painting.boxes:
                inside = np.maximum(box.pixels, 0)
                own = (first[inside] == box.balls[:, None, None, None]) & (box.pixels >= 0)[..., None, None]
                after = p[inside] - (own * (box.light - behind[inside])).mean(2)
                gain[box.balls] += (w[inside] * ((y[inside] - after) ** 2 - (y[inside] - p[inside]) ** 2)).sum((1, 2))
        top, bottom = self.depths
        kept = (gain > SEEN / 2) & (np.abs(-points[:, 2] - (top + bottom) / 2) < (bottom - top) / 2 + self.diameter)
        for i, j in sorted(cKDTree(points).query_pairs(SAME * self.diameter)):
            if kept[i] and kept[j]:
                kept[i if gain[i] < gain[j] else j] = False
        return kept
