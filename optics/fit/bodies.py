"""Places of many small bodies, refined together with the scene's parameters: a sparse problem.

A thousand beads in a gel have three unknown coordinates each, and each touches a few pixels only. Derivative images
of many beads are made at once: beads whose outlines stay apart in all frames share a colour (Curtis, Powell & Reid,
J. Inst. Math. Appl. 13 (1974) 117), and all of a colour are moved together. With the derivatives J of the places,
sparse, and K of the scene's parameters, dense, the normal equations

    [A  B] [x]   [a]        A = J'WJ + priors, sparse: beads that share a pixel        a = J'W(y - f)
    [B' C] [z] = [b]        B = J'WK,  C = K'WK + priors                               b = K'W(y - f)

are solved by eliminating the beads: (C - B'A^-1 B) z = b - B'A^-1 a (Schur's complement), then A x = a - B z.
Derivatives leave out what a bead's shadow does beyond its own outline: that slows the steps, and moves nothing
where they end, as the residual there is noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optics.errors import BadScene
from optics.fit.calibrate import with_start
from optics.fit.descent import prior_terms
from optics.fit.model import value_of
from optics.fit.scene_model import SceneModel
from optics.scene.parameter import Values, Variable

SHIFT = 0.25  # px: half width of a central difference across the line of sight; a rim is linear over a pixel
ALONG = 0.02  # of the distance, along the line of sight: a fiftieth of the outline's radius
MARGIN = 2.0  # px beyond an outline that a bead still changes
WORTH = 0.02  # fall of what is minimised per variable that is not worth another step
DAMPING = 1e-3
ROUGH = 0.01  # of the light, by which a prediction may be off while bodies are missing
LOOSE = 2.0  # such errors, from which on a pixel counts less: as 1/(1 + (r/2)^2)^2, after Geman and McClure
CHORDS, MOST_POOR = 10, 4  # steps on the same derivatives, and those without a gain that are tried
GOOD = 0.7  # of the fall that was promised: with less, derivatives no longer hold, and other steps may lead astray
PART = 0.05  # of what the steps on these derivatives gained: a step that gains less is better followed by new ones
LARGEST = 4.0  # half widths of the differences, by which one step moves a bead at most


State = tuple[list[np.ndarray], list[np.ndarray]]  # predictions and residuals of frames


@dataclass
class Bodies:
    """What was found of N bodies and p parameters.

    points, errors   (N, 3) mm, the middles at rest in the world, and their standard deviations along x, y and z
    covariances      (N, 3, 3) mm^2 of each middle
    values, sd       of the scene's parameters, and their (p,) standard deviations in the order of `variables`
    chi2, dof        of the data at the end;   history   of what was minimised, step by step
    """

    points: np.ndarray
    errors: np.ndarray
    covariances: np.ndarray
    variables: list[Variable]
    values: Values
    sd: np.ndarray
    chi2: float
    dof: int
    history: list[float]


def refine(
    model: SceneModel,
    name: str,
    variables: Sequence[Variable] = (),
    start: Values | None = None,
    frames: Sequence[int] | None = None,
    *,
    depth_prior: tuple[float, float] | None = None,
    missing: bool = False,
    max_iterations: int = 12,
    progress: Callable[[str, int, int], None] | None = None,
) -> Bodies:
    """Fit the places of the crowd `name`, from where they are, and the variables to frames of a model.

    depth_prior   mean and standard deviation of -z, mm, that hold for every bead before it is seen
    missing       bodies may be missing, or be where none are: a pixel that is far off counts little, each body goes its
                  own way, and its errors grow with what is left around it

    Leaves the scene with the places that were found. Raises BadScene where the part has no places to fit."""
    part: Any = model.scene.parts.get(name)
    if part is None or not hasattr(part, "put"):
        raise BadScene(f"'{name}' is no part with places to fit; allowed: a part of the kind 'beads'")
    frames = list(range(len(model.frames)) if frames is None else frames)
    problem = _Problem(model, part, list(variables), frames, ROUGH if missing else 0.0)
    problem.prior = depth_prior
    values = with_start(model, problem.variables, start or Values())
    points = part.rest() - part.sunk()
    if missing:
        points, values, state = problem.settle(points, values, max_iterations, progress)
        history: list[float] = []
    else:
        points, values, state, history = _descent(problem, points, values, max_iterations, progress)
    equations = problem.linearise(points, values, state)
    history.append(equations.total)
    covariances, sd = equations.errors()
    chi2 = equations.chi2
    if missing:
        chi2, near = problem.misfit(points, values, state)
        covariances = covariances * np.maximum(near, 1.0)[:, None, None]
    model.scene.put(name, points, part.measured)
    errors = np.sqrt(np.einsum("nii->ni", covariances))
    return Bodies(points, errors, covariances, problem.variables, values, sd, chi2, equations.dof, history)


def _descent(
    problem: _Problem,
    points: np.ndarray,
    values: Values,
    max_iterations: int,
    progress: Callable[[str, int, int], None] | None,
) -> tuple[np.ndarray, Values, State, list[float]]:
    """Levenberg and Marquardt's steps of all together; places, values, the state there, and what was minimised."""
    damping, history = DAMPING, []
    state = problem.residual(points, values)
    for iteration in range(max_iterations):
        if progress:
            progress("places", iteration, max_iterations)
        equations = problem.linearise(points, values, state)
        history.append(equations.total)
        gained, poor = 0.0, 0
        for _ in range(CHORDS):  # on the same derivatives, which cost as much as some twenty steps
            x, z, promised = equations.step(damping)
            moved = problem.moved(points, x), problem.put(values, z)
            trial = problem.residual(*moved)
            gain = equations.total - problem.total(*moved, trial)
            if gain > 0:
                (points, values), state = moved, trial
                gained += gain
                equations.renew(points, values, state)
                damping = max(damping / 5, 1e-8)
                if gain < GOOD * promised or gain < PART * gained:
                    break
            else:
                damping, poor = max(damping * 8, DAMPING), poor + 1
                if gained or poor > MOST_POOR:
                    break
        if gained < WORTH * (points.size + len(problem.variables)):
            break
    return points, values, state, history


class _Problem:
    """The frames of a model as a function of the places of bodies and of a few parameters.

    rough   share of the light that a prediction may miss, while bodies are missing; 0: none is"""

    prior: tuple[float, float] | None = None

    def __init__(self, model: SceneModel, part: Any, variables: list[Variable], frames: list[int], rough: float = 0.0):
        self.model, self.part, self.variables, self.frames, self.rough = model, part, variables, frames, rough
        self.pixels = [(f, model.usable(f)) for f in frames]

    def place(self, points: np.ndarray) -> None:
        self.model.scene.put(self.part.name, points, self.part.measured)

    def predict(self, points: np.ndarray, values: Values) -> list[np.ndarray]:
        self.place(points)
        return self.model.predict(values, self.frames)

    def residual(self, points: np.ndarray, values: Values) -> State:
        """Predictions, and the residuals of all frames."""
        found = self.predict(points, values)
        return found, [self.model.frames[f].image - p for f, p in zip(self.frames, found)]

    def weights(self, values: Values, predictions: Sequence[np.ndarray]) -> list[np.ndarray]:
        """1/sd of all values of the frames; 0 where a pixel is not used. While bodies are missing (`rough`), what is
        far off counts little: light may come from one that is missing, and would blow up its neighbours."""
        found = []
        for (frame, used), p in zip(self.pixels, predictions):
            image, variance = self.model.frames[frame].image, self.model.variance(values, frame, p)
            if self.rough:
                variance = variance + (self.rough * (np.maximum(image, p) - self.model.noise.black_level)) ** 2
                variance = variance * (1 + (image - p) ** 2 / (LOOSE**2 * variance)) ** 2
            found.append(np.sqrt(used / variance))
        return found

    def around(self, state: State) -> np.ndarray:
        """(N,) chi2 of the pixels of each body, at the present weights."""
        squares = [((r * s) ** 2).sum(-1).ravel() for r, s in zip(state[1], self.scales)]
        return np.sum([[one[own].sum() for own in of] for one, of in zip(squares, self.own)], 0)

    def misfit(self, points: np.ndarray, values: Values, state: State) -> tuple[float, np.ndarray]:
        """chi2 by the noise alone, and (N,) chi2 over the number of values of each body's pixels."""
        rough, self.rough = self.rough, 0.0
        try:
            self.look(points, values)
            self.scales = self.weights(values, state[0])
        finally:
            self.rough = rough
        count = np.sum([[len(own) for own in of] for of in self.own], 0) * self.model.shape[2]
        chi2 = sum(float(((r * s) ** 2).sum()) for r, s in zip(state[1], self.scales))
        return chi2, self.around(state) / np.maximum(count, 1)

    def settle(
        self,
        points: np.ndarray,
        values: Values,
        steps: int,
        progress: Callable[[str, int, int], None] | None = None,
    ) -> tuple[np.ndarray, Values, State]:
        """Places and values after some steps, and the state there. A body keeps its step where the residual around it
        falls, so that one that goes astray holds up no other."""
        damping = np.full(len(points), DAMPING)
        state = self.residual(points, values)
        for step in range(steps):
            if progress:
                progress("places", step, steps)
            equations = self.linearise(points, values, state)
            x, z, _ = equations.step(damping)
            moved, now = self.moved(points, x), self.put(values, z)
            trial = self.residual(moved, now)
            good = self.around(trial) < self.around(state)
            points, values = np.where(good[:, None], moved, points), now
            damping = np.where(good, np.maximum(damping / 4, 1e-6), damping * 6)
            state = trial if good.all() else self.residual(points, values)
        return points, values, state

    def put(self, values: Values, z: np.ndarray) -> Values:
        values = values.copy()
        for v, step in zip(self.variables, z):
            low, high = v.parameter.bounds
            values.put(v, float(np.clip(value_of(self.model, values, v) + step, low, high)))
        return values

    def moved(self, points: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Points after a step (3 N,) in units of the half widths along the axes of each line of sight. A body stays in
        the skin: at most it touches the face from below."""
        step = np.clip(x.reshape(-1, 3), -LARGEST, LARGEST)
        there = points + np.einsum("nkc,nk->nc", self.axes, step)
        there[:, 2] = np.minimum(there[:, 2], -self.part.balls()[1])
        return there

    def total(self, points: np.ndarray, values: Values, state: State) -> float:
        chi2 = sum(float((r**2 * s**2).sum()) for r, s in zip(state[1], self.scales))
        return chi2 + self.of_priors(points) + prior_terms(self.model, self.variables, values)[2]

    def of_priors(self, points: np.ndarray) -> float:
        return 0.0 if self.prior is None else float((((-points[:, 2] - self.prior[0]) / self.prior[1]) ** 2).sum())

    def look(self, points: np.ndarray, values: Values) -> None:
        """Axes of steps (N, 3, 3), mm, and the pixels of each body in each frame."""
        camera, eye = self.model.scene.camera, self.model.renderer._eye()
        height, width = self.model.shape[:2]
        self.outlines = []  # (frames, N, 3): x, y and radius in px
        for f in self.frames:
            self.place(points)
            self.model.renderer.apply(self.model.at(values, f))
            middles, radii = self.part.balls()
            away = np.linalg.norm(middles - eye, axis=1)
            at = camera.project(middles)
            side = np.cross(middles - eye, [0.0, 1.0, 0.0])
            side *= (radii / np.linalg.norm(side, axis=1))[:, None]
            up = np.cross(side, middles - eye) / away[:, None]
            wide = [np.linalg.norm(camera.project(middles + s) - at, axis=1) for s in (side, up)]
            self.outlines.append(np.column_stack([at, np.maximum(*wide) + MARGIN]))
            self.scale = np.minimum(*wide) / radii  # px per mm across
        line = (points - eye) / np.linalg.norm(points - eye, axis=1)[:, None]
        across = np.cross(line, [0.0, 1.0, 0.0])
        across /= np.linalg.norm(across, axis=1)[:, None]
        per = SHIFT / self.scale
        far = ALONG * np.linalg.norm(points - eye, axis=1)
        self.axes = np.stack([across * per[:, None], np.cross(line, across) * per[:, None], line * far[:, None]], 1)
        y, x = np.mgrid[:height, :width] + 0.5
        self.own: list[list[np.ndarray]] = []
        for outlines in self.outlines:
            self.own.append([])
            for u, v, r in outlines:
                low, high = (int(np.clip(np.floor(u - r), 0, width)), int(np.clip(np.ceil(u + r), 0, width)))
                top, end = (int(np.clip(np.floor(v - r), 0, height)), int(np.clip(np.ceil(v + r), 0, height)))
                box = np.s_[top:end, low:high]
                inside = (x[box] - u) ** 2 + (y[box] - v) ** 2 < r**2
                rows, columns = np.nonzero(inside)
                self.own[-1].append((rows + top) * width + columns + low)

    def _coloured(self) -> list[np.ndarray]:
        """Numbers of bodies, colour by colour: no two of a colour come near each other in any frame."""
        from scipy.spatial import cKDTree

        count = len(self.outlines[0])
        near: list[set[int]] = [set() for _ in range(count)]
        for outlines in self.outlines:
            seen = np.flatnonzero(np.isfinite(outlines).all(1))
            widest = outlines[seen, 2].max(initial=0)
            for i, j in cKDTree(outlines[seen, :2]).query_pairs(2 * widest):
                a, b = seen[i], seen[j]
                if np.hypot(*(outlines[a, :2] - outlines[b, :2])) < outlines[a, 2] + outlines[b, 2]:
                    near[a].add(b)
                    near[b].add(a)
        colour = np.full(count, -1)
        for k in sorted(range(count), key=lambda k: -len(near[k])):
            taken = {colour[m] for m in near[k]}
            colour[k] = next(c for c in range(count + 1) if c not in taken)
        return [np.flatnonzero(colour == c) for c in range(colour.max() + 1)]

    def linearise(self, points: np.ndarray, values: Values, state: State) -> _Equations:
        channels = self.model.shape[2]
        self.look(points, values)
        predictions, residuals = state
        self.scales = self.weights(values, predictions)
        size = residuals[0].size
        rows, columns, entries = [], [], []
        for colour in self._coloured():
            for k in range(3):
                step = np.zeros_like(points)
                step[colour] = self.axes[colour, k]
                up, down = self.predict(points + step, values), self.predict(points - step, values)
                for f, (high, low) in enumerate(zip(up, down)):
                    change = ((high - low) / 2 * self.scales[f]).reshape(-1, channels)
                    for body in colour:
                        own = self.own[f][body]
                        rows.append((f * size + own[:, None] * channels + np.arange(channels)).ravel())
                        columns.append(np.full(len(own) * channels, 3 * body + k))
                        entries.append(change[own].ravel())
        return self.equations((rows, columns, entries), residuals, points, values)

    def equations(
        self, derivatives: tuple[list, list, list], residuals: list[np.ndarray], points: np.ndarray, values: Values
    ) -> _Equations:
        """Normal equations of the places' weighed derivatives, in pieces of rows, columns and entries, and of the
        variables'."""
        from scipy.sparse import coo_matrix

        size = residuals[0].size
        rows, columns, entries = (np.concatenate(pieces) for pieces in derivatives)
        j = coo_matrix((entries, (rows, columns)), (size * len(self.frames), points.size)).tocsr()
        self.place(points)
        dense = np.zeros((j.shape[0], len(self.variables)))
        if self.variables:
            index = {v.name: i for i, v in enumerate(self.variables)}
            for f, (_, images) in enumerate(self.model.derivatives(values, self.variables, self.frames)):
                for name, image in images.items():
                    dense[f * size : (f + 1) * size, index[name]] = (image * self.scales[f]).ravel()
        r = np.concatenate([(res * s).ravel() for res, s in zip(residuals, self.scales)])
        return _Equations(self, j, dense, r, points, values)


class _Equations:
    """Normal equations of a problem at one point."""

    def __init__(self, problem: _Problem, j: Any, k: np.ndarray, r: np.ndarray, points: np.ndarray, values: Values):
        from scipy.sparse import block_diag, csc_matrix

        self.problem, self.j, self.k = problem, j, k
        self.a, self.b, self.c = csc_matrix(j.T @ j), j.T @ k, k.T @ k
        if problem.prior is not None:
            self.slope = -problem.axes[:, :, 2] / problem.prior[1]  # of the depth, in standard deviations
            self.a = self.a + csc_matrix(block_diag([np.outer(s, s) for s in self.slope]))
        self.c = self.c + np.diag(prior_terms(problem.model, problem.variables, values)[1])
        self.toward(r, points, values)
        self.dof = int(sum(u.sum() for _, u in problem.pixels)) - points.size - len(problem.variables)

    def renew(self, points: np.ndarray, values: Values, state: State) -> None:
        """Take up other residuals with the same derivatives and weights."""
        self.toward(np.concatenate([(r * s).ravel() for r, s in zip(state[1], self.problem.scales)]), points, values)

    def toward(self, r: np.ndarray, points: np.ndarray, values: Values) -> None:
        """The right side, and what is minimised, of weighed residuals."""
        problem = self.problem
        pull, _, prior = prior_terms(problem.model, problem.variables, values)
        self.ra, self.rb, self.chi2 = self.j.T @ r, self.k.T @ r + pull, float(r @ r)
        self.total = self.chi2 + problem.of_priors(points) + prior
        if problem.prior is not None:
            mean, sd = problem.prior
            self.ra = self.ra - (self.slope * ((-points[:, 2] - mean) / sd)[:, None]).ravel()

    def _eliminated(self, damping: float | np.ndarray) -> tuple[Any, np.ndarray, np.ndarray]:
        """A factorised, A^-1 B, and the Schur complement C - B'A^-1 B; of each body its own damping, or one."""
        from scipy.sparse import diags
        from scipy.sparse.linalg import splu

        diagonal = self.a.diagonal()
        lift = np.repeat(damping, 3 if np.ndim(damping) else diagonal.size) * diagonal + 1e-12 * max(
            diagonal.max(), 1e-300
        )  # of bodies that nothing shows
        factor = splu((self.a + diags(lift)).tocsc())
        inner = factor.solve(self.b) if self.b.shape[1] else self.b
        return factor, inner, self.c + np.min(damping) * np.diag(np.diag(self.c)) - self.b.T @ inner

    def step(self, damping: float | np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """(3 N,) in half widths of the differences along each line of sight, (p,) of the parameters, and the fall that
        they promise."""
        factor, inner, schur = self._eliminated(damping)
        z = np.linalg.lstsq(schur, self.rb - inner.T @ self.ra, rcond=1e-12)[0] if len(schur) else np.zeros(0)
        x = factor.solve(self.ra - self.b @ z)
        fall = 2 * (x @ self.ra + z @ self.rb) - x @ (self.a @ x) - 2 * x @ (self.b @ z) - z @ self.c @ z
        return x, z, float(fall)

    def errors(self) -> tuple[np.ndarray, np.ndarray]:
        """(N, 3, 3) mm^2 covariances of the places, and (p,) standard deviations of the parameters."""
        factor, inner, schur = self._eliminated(0.0)
        cross = np.linalg.pinv(schur) if len(schur) else schur
        count, axes = len(self.ra) // 3, self.problem.axes
        found = np.empty((count, 3, 3))
        for start in range(0, count, 256):
            some = np.arange(3 * start, 3 * min(start + 256, count))
            unit = np.zeros((len(self.ra), len(some)))
            unit[some, np.arange(len(some))] = 1.0
            block = factor.solve(unit)[some].reshape(len(some) // 3, 3, len(some) // 3, 3)
            own = np.einsum("ikil->ikl", block)
            part = inner[some].reshape(-1, 3, inner.shape[1])
            own = own + np.einsum("ikp,pq,ilq->ikl", part, cross, part)
            at = axes[start : start + 256]
            found[start : start + 256] = np.einsum("nkc,nkl,nld->ncd", at, own, at)
        return found, np.sqrt(np.maximum(np.diag(cross), 0.0))
