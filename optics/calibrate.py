"""Calibration: the values of free parameters that explain the captures, by Levenberg-Marquardt on derivative images.

    minimise  sum_pixels ((y - f(theta)) / sigma)^2 + sum_priors ((theta - mean) / sd)^2

with sigma from the prediction (not from the data), re-evaluated at every step; masks from data and noise only. The
priors hold the lambda term of S4. Frames are streamed: only the normal equations are kept.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from optics.errors import Underdetermined, UnknownKey
from optics.parameter import Values, Variable

TRUNCATION = 1e-12  # eigenvalues of the scaled normal matrix below this share of the largest count as undetermined


@dataclass
class Fit:
    """What a calibration found.

    values       start values with the estimates put in
    estimate     (p,) in the order of `variables`; covariance (p, p) from the noise model and the priors
    chi2, dof    of the data, without priors; per frame in frame_chi2, frame_n
    converged    whether the fall of chi2 still predicted is below 1 per variable; `reason` says why it stopped
    warnings     sentences: combinations that the captures cannot tell apart, variables that do nothing or stand at a bound
    """

    values: Values
    variables: list[Variable]
    estimate: np.ndarray
    covariance: np.ndarray
    chi2: float
    dof: int
    frames: list[int]
    frame_chi2: list[float]
    frame_n: list[int]
    converged: bool
    reason: str
    history: list[float] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    start: np.ndarray | None = None
    at_bound: list[str] = field(default_factory=list)
    normal: "Normal | None" = None  # the last linearisation, for `extended`

    @property
    def sd(self) -> np.ndarray:
        return np.sqrt(np.maximum(np.diag(self.covariance), 0))

    @property
    def correlation(self) -> np.ndarray:
        sd = np.where((self.sd > 0) & np.isfinite(self.sd), self.sd, 1)
        return self.covariance / np.outer(sd, sd)

    @property
    def chi2_per_dof(self) -> float:
        return self.chi2 / max(self.dof, 1)

    def table(self) -> str:
        """One line per variable: estimate, standard deviation, unit, start, and what it correlates with most."""
        lines = [f"{'variable':<28}{'estimate':>12}{'+- sd':>11}  {'unit':<6}{'start':>11}   strongest correlation"]
        correlation = np.abs(self.correlation - np.eye(len(self.variables)))
        for i, variable in enumerate(self.variables):
            j = int(np.argmax(correlation[i])) if len(self.variables) > 1 else i
            other = f"{self.correlation[i, j]:+.2f} {self.variables[j].name}" if j != i else ""
            start = "" if self.start is None else f"{self.start[i]:11.5g}"
            bound = "  at its bound" if variable.name in self.at_bound else ""
            lines.append(f"{variable.name:<28}{self.estimate[i]:12.5g}{self.sd[i]:11.2g}  {variable.parameter.unit:<6}"
                         f"{start}   {other}{bound}")
        lines.append(f"chi2 per degree of freedom {self.chi2_per_dof:.4f} ({self.dof} degrees of freedom); {self.reason}")
        return "\n".join([*lines, *(f"warning: {w}" for w in self.warnings)])


@dataclass
class Normal:
    """Normal equations at one point: A = J'WJ + priors, b = J'Wr + priors, chi2 of data and of priors.

    rows   per frame: which variables act in it, their whitened derivative images (k, n), sqrt(weight), residual whitened
    """

    a: np.ndarray
    b: np.ndarray
    chi2: float
    prior: float
    frame_chi2: list[float]
    frame_n: list[int]
    rows: list[tuple[list[int], np.ndarray, np.ndarray]]

    @property
    def total(self) -> float:
        return self.chi2 + self.prior


def variables_from(model, free: Sequence[str], per_group: Sequence[str] = (), priors: Mapping[str, tuple] | None = None,
                   frames: Sequence[int] | None = None) -> list[Variable]:
    """Variables for key patterns: `free` in all frames (`led_*.x`), `per_group` with a value per group of frames.

    priors: pattern -> (mean or None for the present value, standard deviation).
    Raises UnknownKey for a pattern that matches no number of the scene.
    """
    numbers = [k for k, p in model.parameters.items() if p.is_number]
    variables = []

    def matching(pattern):
        found = fnmatch.filter(numbers, pattern)
        if not found:
            raise UnknownKey(pattern, numbers, "parameter", hint="`optics params SCENE` lists them; * and ? match")
        return found

    for pattern in free:
        variables += [Variable(k, (k,), model.parameters[k]) for k in matching(pattern)
                      if all(k != v.name for v in variables)]
    groups: dict[str, list[int]] = {}
    for index in range(len(model.frames)) if frames is None else frames:
        frame = model.frames[index]
        groups.setdefault(frame.group or frame.name, []).append(index)
    for pattern in per_group:
        for key in matching(pattern):
            variables += [Variable(f"{key}[{g}]", (key,), model.parameters[key], tuple(ii)) for g, ii in groups.items()]
    for pattern, (mean, sd) in (priors or {}).items():
        hit = False
        for i, v in enumerate(variables):
            if fnmatch.fnmatch(v.keys[0], pattern) or fnmatch.fnmatch(v.name, pattern):
                variables[i] = v.with_prior(start_of(model, v, Values()) if mean is None else mean, sd)
                hit = True
        if not hit:
            raise UnknownKey(pattern, [v.name for v in variables], "free parameter for a prior")
    return variables


def start_of(model, variable: Variable, values: Values) -> float:
    """The value that a variable starts from: the fitted one, else what its frames set, else the scene's."""
    if variable.frames is not None:
        return float(model.at(values, variable.frames[0])[variable.keys[0]])
    return float(values.common.get(variable.keys[0], model.base[variable.keys[0]]))


def with_start(model, variables: Sequence[Variable], values: Values) -> Values:
    """Values in which every variable is put explicitly."""
    filled = values.copy()
    for variable in variables:
        filled.put(variable, start_of(model, variable, values))
    return filled


def huber(whitened: np.ndarray, limit: float = 3.0) -> np.ndarray:
    """Weights min(1, limit/|r|): what robust fitting multiplies into 1/sigma^2."""
    return np.minimum(1.0, limit / np.maximum(np.abs(whitened), 1e-12))


def normal_equations(model, variables: Sequence[Variable], values: Values, frames: Sequence[int], robust: bool = False,
                     tick: Callable[[], None] | None = None) -> Normal:
    """J'WJ, J'Wr and chi2 of the frames at the values, with the priors' rows."""
    p = len(variables)
    a, b = np.zeros((p, p)), np.zeros(p)
    index_of = {v.name: i for i, v in enumerate(variables)}
    frame_chi2, frame_n, rows = [], [], []
    for frame, (prediction, images) in zip(frames, model.derivatives(values, variables, frames)):
        mask = model.usable(frame)
        scale = np.sqrt(mask / model.noise.variance(prediction)).astype(np.float32)
        if robust:
            scale *= np.sqrt(huber((model.frames[frame].image - prediction) * scale)).astype(np.float32)
        whitened = whiten(model, frame, prediction, scale)
        j = (np.stack([(image * scale).ravel() for image in images.values()]) if images
             else np.zeros((0, whitened.size), np.float32))
        where = [index_of[n] for n in images]
        a[np.ix_(where, where)] += (j @ j.T).astype(float)
        b[where] += (j @ whitened).astype(float)
        frame_chi2.append(float(whitened.astype(float) @ whitened))
        frame_n.append(int(mask.sum()))
        rows.append((where, j, scale))
        if tick:
            tick()
    pull, curvature, prior = prior_terms(model, variables, values)
    return Normal(a + np.diag(curvature), b + pull, sum(frame_chi2), prior, frame_chi2, frame_n, rows)


def whiten(model, frame: int, prediction: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Residual times sqrt(weight), flat; 0 where a pixel is not used."""
    return np.where(scale > 0, (model.frames[frame].image - prediction) * scale, 0).ravel().astype(np.float32)


def prior_terms(model, variables: Sequence[Variable], values: Values) -> tuple[np.ndarray, np.ndarray, float]:
    """Gradient, curvature and value of the priors' share of the misfit."""
    pull, curvature, total = np.zeros(len(variables)), np.zeros(len(variables)), 0.0
    for i, v in enumerate(variables):
        if v.prior is not None:
            mean, sd = v.prior
            gap = mean - start_of(model, v, values)
            pull[i], curvature[i] = gap / sd**2, 1 / sd**2
            total += (gap / sd) ** 2
    return pull, curvature, total


def again(model, variables: Sequence[Variable], values: Values, frames: Sequence[int], normal: Normal) -> Normal:
    """The normal equations at other values with the derivative images and weights of `normal`: one prediction, no derivative."""
    b, frame_chi2 = np.zeros(len(variables)), []
    for frame, prediction, (where, j, scale) in zip(frames, model.predict(values, frames), normal.rows):
        whitened = whiten(model, frame, prediction, scale)
        b[where] += (j @ whitened).astype(float)
        frame_chi2.append(float(whitened.astype(float) @ whitened))
    pull, _, prior = prior_terms(model, variables, values)
    return Normal(normal.a, b + pull, sum(frame_chi2), prior, frame_chi2, normal.frame_n, normal.rows)


def solve(a: np.ndarray, b: np.ndarray, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Damped step in the eigenbasis of the scaled matrix; directions below TRUNCATION stay put. Returns step, kept share."""
    scale = np.sqrt(np.maximum(np.diag(a), 1e-300))
    eigen, vectors = np.linalg.eigh(a / np.outer(scale, scale))
    kept = eigen > TRUNCATION * max(eigen.max(), 1e-300)
    projected = vectors.T @ (b / scale)
    step = vectors @ np.where(kept, projected / (np.where(kept, eigen, 1) + damping), 0)
    return step / scale, kept


def fit(model, variables: Sequence[Variable], start: Values | None = None, frames: Sequence[int] | None = None, *,
        max_iterations: int = 40, robust: bool = False, tolerance: float = 0.05,
        progress: Callable[[str, int, int], None] | None = None) -> Fit:
    """Levenberg-Marquardt within bounds.

    A variable that stands at a bound and is pushed outwards is held for that step. Stops when the fall of chi2 that the linear
    model still predicts is below `tolerance` per variable, or when no damping gives a lower chi2.
    Raises Underdetermined when no pixel is usable or no variable does anything.
    """
    variables = list(variables)
    frames = list(range(len(model.frames))) if frames is None else list(frames)
    values = with_start(model, variables, start or Values())
    first = np.array([start_of(model, v, values) for v in variables])
    for v, value in zip(variables, first):
        v.parameter.check(value, v.name, "start value")
    low = np.array([v.parameter.bounds[0] for v in variables])
    high = np.array([v.parameter.bounds[1] for v in variables])
    squared = np.array([v.parameter.squared for v in variables], bool)
    floor = np.array([1e-3 * v.parameter.plausible for v in variables])
    low = np.where(squared, np.maximum(low, floor), low)
    theta = np.clip(first, low, high)
    for v, value in zip(variables, theta):
        values.put(v, float(value))
    damping, history, reason, converged = 1e-3, [], "", False
    best, tries = (np.inf, theta, values), 0
    done, accuracy = 0, tolerance * max(len(variables), 1)

    def tick():
        nonlocal done
        done += 1
        if progress:
            progress("calibrate", done, max_iterations * len(frames))

    def step_from(now: Normal) -> tuple[Values, np.ndarray, float]:
        """Damped step in theta, or in theta^2 where the image depends on that; and the fall that no damping would bring."""
        slope = np.where(squared, 1 / (2 * np.where(squared, theta, 1)), 1.0)
        a, b = now.a * np.outer(slope, slope), now.b * slope
        free = ~(((theta <= low) & (b < 0)) | ((theta >= high) & (b > 0)) | (np.diag(a) == 0))
        promised = float(b[free] @ solve(a[np.ix_(free, free)], b[free], 0.0)[0])
        step = np.zeros_like(theta)
        step[free], _ = solve(a[np.ix_(free, free)], b[free], damping)
        trial = np.clip(np.where(squared, np.sqrt(np.maximum(theta**2 + step, 0)), theta + step), low, high)
        moved = values.copy()
        for v, value in zip(variables, trial):
            moved.put(v, float(value))
        return moved, trial, promised

    for iteration in range(max_iterations):
        normal = normal_equations(model, variables, values, frames, robust, tick)
        if sum(normal.frame_n) == 0:
            raise Underdetermined("no usable pixel: every pixel is saturated, at black, or masked; check [noise] "
                                  "black_level and saturation in captures.toml, and the masks")
        silent = [v.name for i, v in enumerate(variables) if normal.a[i, i] == 0]
        if len(silent) == len(variables) and variables:
            raise Underdetermined(f"none of the {len(variables)} free parameters changes any frame: {', '.join(silent[:6])}")
        history.append(normal.total)
        first_promise = step_from(normal)[2] if variables else 0.0
        here = normal
        if first_promise < accuracy:
            reason, converged = f"converged after {iteration} linearisations", True
            break
        near = first_promise < 20 * len(theta)
        if near:
            tries += 1
            if first_promise < best[0]:
                best = (first_promise, theta.copy(), values)
            if tries > 4 or (tries > 1 and best[0] < len(theta) / 2):
                break
        # A linearisation serves for several steps while they keep the misfit falling fast (a chord method): derivative
        # images cost many times what a prediction does.
        gained = 0.0
        for _ in range(3 if near else 8):
            moved, trial, promised = step_from(here)
            if promised < accuracy / 10 or (gained and promised > 0.3 * first_promise):
                break
            there = again(model, variables, moved, frames, here)
            # Close to the best, chi2 is rough where shadow rims cross pixels: there the root of J'Wr is followed, not chi2.
            allowed = promised if near and promised < 20 * len(theta) else 0.0
            if np.isfinite(there.total) and there.total < here.total + allowed:
                gain = here.total - there.total
                theta, values, here = trial, moved, there
                gained += gain
                damping = max(damping / 10, 1e-9)
                if gain < 0.25 * promised and gain > accuracy:
                    break
                if gain < accuracy / 10:
                    break
            else:
                damping = max(damping * 10, 1e-3)
                if damping > 1e4:
                    break
        if gained < accuracy and not near:
            reason = f"no lower misfit within reach; the linear model still promised {first_promise:.3g}"
            break
    else:
        reason = f"stopped after {max_iterations} linearisations without converging; allow more or start nearer"
    if not reason:
        converged = best[0] < len(theta)
        reason = (f"converged after {iteration + 1} linearisations" if converged else
                  f"the linear model still promised a fall of {best[0]:.3g}, which no step brought")
        if not np.array_equal(best[1], theta):
            theta, values = best[1], best[2]
            normal = here = normal_equations(model, variables, values, frames, robust)
    if here is not normal:  # the last steps moved on from where the derivative images were made
        normal = normal_equations(model, variables, values, frames, robust)
    result = Fit(values, variables, theta, covariance_of(normal.a), normal.chi2,
                 sum(normal.frame_n) - len(variables) + sum(v.prior is not None for v in variables), frames,
                 normal.frame_chi2, normal.frame_n, converged, reason, history, start=first)
    result.at_bound = [v.name for v, t, lo, hi in zip(variables, theta, low, high) if t <= lo or t >= hi]
    result.warnings = warnings_of(result, normal.a)
    result.normal = normal
    return result


def extended(model, base: Fit, extra: Sequence[Variable], secant: Mapping[str, float] | None = None, steps: int = 10) -> Fit:
    """Free further variables and calibrate everything again, by chord steps on the derivative images of a fit that has converged.

    Each step costs one prediction, where `fit` would make all derivative images afresh: what ranks many effects. The extra
    variables' images are tangents at the base's values, or secants of the sizes in `secant`. The steps follow the true
    prediction, so that the result is a true minimum along them; only its last digits, and the errors, are those of the base's
    linearisation. `converged` says whether the fall that it still predicts is below 1 per variable.
    """
    variables = [*base.variables, *extra]
    p, first = len(variables), len(base.variables)
    index_of = {v.name: i for i, v in enumerate(variables)}
    values = with_start(model, extra, base.values)
    a, b, rows = np.zeros((p, p)), np.zeros(p), []
    a[:first, :first] = base.normal.a
    derivatives = model.derivatives(values, list(extra), base.frames, secant=secant or {})
    for frame, (where, j, scale), (prediction, images) in zip(base.frames, base.normal.rows, derivatives):
        new = np.stack([(i * scale).ravel() for i in images.values()]) if images else np.zeros((0, j.shape[1]), np.float32)
        there = [index_of[n] for n in images]
        whitened = whiten(model, frame, prediction, scale)
        a[np.ix_(there, there)] += (new @ new.T).astype(float)
        cross = (j @ new.T).astype(float)
        a[np.ix_(where, there)] += cross
        a[np.ix_(there, where)] += cross.T
        rows.append((np.array([*where, *there]), np.concatenate([j, new]), scale))
        b[rows[-1][0]] += (rows[-1][1] @ whitened).astype(float)
    pull, curvature, prior = prior_terms(model, variables, values)
    a[first:, first:] += np.diag(curvature[first:])
    here = Normal(a, b + pull, base.chi2, prior, base.frame_chi2, base.frame_n, rows)
    theta = np.array([start_of(model, v, values) for v in variables])
    low, high = (np.array([v.parameter.bounds[k] for v in variables]) for k in (0, 1))
    # where the image depends on the square, the coordinate is the square, as in `fit`
    squared = np.array([v.parameter.squared for v in variables], bool)
    slope = np.where(squared, 1 / (2 * np.maximum(theta, 1e-9)), 1.0)
    here.a, here.b = here.a * np.outer(slope, slope), here.b * slope
    for where, j, _ in rows:
        j *= slope[where][:, None].astype(np.float32)
    theta = np.where(squared, theta**2, theta)
    low, high = np.where(squared, (1e-3 * np.array([v.parameter.plausible for v in variables])) ** 2, low), np.where(
        squared, high**2, high)
    damping, promised = 1e-6, np.inf
    history = [here.total]
    for _ in range(steps):
        free = ~(((theta <= low) & (here.b < 0)) | ((theta >= high) & (here.b > 0)) | (np.diag(here.a) == 0))
        promised = float(here.b[free] @ solve(here.a[np.ix_(free, free)], here.b[free], 0.0)[0])
        if promised < 0.1 * p:
            break
        step = np.zeros(p)
        step[free], _ = solve(here.a[np.ix_(free, free)], here.b[free], damping)
        trial = np.clip(theta + step, low, high)
        moved = values.copy()
        for v, value in zip(variables, np.where(squared, np.sqrt(np.abs(trial)), trial)):
            moved.put(v, float(value))
        there = again(model, variables, moved, base.frames, here)
        there.b = there.b + (slope - 1) * prior_terms(model, variables, moved)[0]
        if np.isfinite(there.total) and there.total < here.total:
            gain, theta, values, here = here.total - there.total, trial, moved, there
            history.append(here.total)
            if gain < 0.1 * p:
                break
        else:
            damping = max(damping * 30, 1e-2)
            if damping > 1e3:
                break
    estimate = np.where(squared, np.sqrt(np.abs(theta)), theta)
    back = np.where(squared, 1 / (2 * np.maximum(estimate, 1e-9)), 1.0)  # d sigma / d sigma^2, where it ended
    covariance = covariance_of(here.a) * np.outer(back, back)
    return Fit(values, variables, estimate, covariance, here.chi2, base.dof - len(extra), base.frames,
               here.frame_chi2, here.frame_n, promised < p, f"{len(history) - 1} chord steps", history)


def covariance_of(a: np.ndarray) -> np.ndarray:
    """Inverse of the normal matrix on what is determined; undetermined variables get an infinite variance."""
    if not len(a):
        return np.zeros((0, 0))
    scale = np.sqrt(np.where(np.diag(a) > 0, np.diag(a), 1))
    eigen, vectors = np.linalg.eigh(a / np.outer(scale, scale))
    kept = eigen > TRUNCATION * max(eigen.max(), 1e-300)
    inverse = (vectors[:, kept] / eigen[kept]) @ vectors[:, kept].T / np.outer(scale, scale)
    lost = (np.abs(vectors[:, ~kept]) > 1e-2).any(1) | (np.diag(a) == 0)
    inverse[lost, lost] = np.inf
    return inverse


def warnings_of(result: Fit, a: np.ndarray) -> list[str]:
    """Sentences about variables that cannot be told apart, that do nothing, or that stand at a bound."""
    texts = []
    names = [v.name for v in result.variables]
    silent = [n for n, d in zip(names, np.diag(a)) if d == 0]
    if silent:
        texts.append(f"nothing in the frames depends on {', '.join(silent)}")
    if len(a):
        scale = np.sqrt(np.where(np.diag(a) > 0, np.diag(a), 1))
        eigen, vectors = np.linalg.eigh(a / np.outer(scale, scale))
        for value, vector in zip(eigen, vectors.T):
            if value < 1e-7 * eigen.max():
                part = [n for n, c in zip(names, vector) if abs(c) > 0.15 and n not in silent]
                if len(part) > 1:
                    texts.append(f"the captures cannot tell apart {', '.join(part[:8])}{' ...' if len(part) > 8 else ''}: only "
                                 "a combination is determined; hold one of them, or give it a prior")
    correlation = result.correlation
    for i in range(len(names)):
        for j in range(i):
            if np.isfinite(correlation[i, j]) and abs(correlation[i, j]) > 0.995:
                texts.append(f"{names[j]} and {names[i]} are correlated to {correlation[i, j]:+.4f}")
    texts += [f"{n} ended at its bound" for n in result.at_bound]
    if not result.converged:
        texts.append(result.reason)
    return texts
