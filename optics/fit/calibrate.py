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
from scipy.optimize import lsq_linear
from scipy.sparse.csgraph import connected_components

from optics.errors import Underdetermined, UnknownKey
from optics.scene.parameter import Values, Variable
from optics.words import some, spaced

REACH = 4.0  # plausible sizes that one step may change what the image is not linear in
POOR = 0.25  # of the gain that a linearisation promises: with less, it has been followed too far
NEGLIGIBLE = (
    1e-3  # of the excess of chi2: a promise that is not worth another linearisation, a tenth of what a diagnosis allows
)
ALIKE = 0.995  # correlation beyond which two variables are said to stand for each other
TRUNCATION = 1e-12  # eigenvalues of the scaled normal matrix below this share of the largest count as undetermined


@dataclass
class Fit:
    """What a calibration found.

    values       start values with the estimates put in
    estimate     (p,) in the order of `variables`; covariance (p, p) from the noise model and the priors
    chi2, dof    of the data, without priors; per frame in frame_chi2, frame_n
    converged    whether the fall of chi2 still predicted is below 1 per variable, or a thousandth of what noise does
                 not explain; `reason`
                 says why it stopped
    warnings     sentences: combinations that the captures cannot tell apart, variables that do nothing or stand at a
                 bound
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
    normal: Normal | None = None  # the last linearisation, for `extended`

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
            lines.append(
                f"{variable.name:<28}{self.estimate[i]:12.5g}{self.sd[i]:11.2g}  {variable.parameter.unit:<6}"
                f"{start}   {other}{bound}"
            )
        lines.append(
            f"chi2 per degree of freedom {self.chi2_per_dof:.4f} ({self.dof} degrees of freedom); {self.reason}"
        )
        return "\n".join([*lines, *(f"warning: {w}" for w in self.warnings)])


@dataclass
class Normal:
    """Normal equations at one point: A = J'WJ + priors, b = J'Wr + priors, chi2 of data and of priors.

    rows   per frame: which variables act in it, their whitened derivative images (k, n), sqrt(weight), residual
           whitened
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


def variables_from(
    model,
    free: Sequence[str],
    per_group: Sequence[str] = (),
    priors: Mapping[str, tuple] | None = None,
    frames: Sequence[int] | None = None,
) -> list[Variable]:
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
        variables += [
            Variable(k, (k,), model.parameters[k]) for k in matching(pattern) if all(k != v.name for v in variables)
        ]
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


def for_frames(model, variables: Sequence[Variable], frames: Sequence[int]) -> list[Variable]:
    """What a fit's per-frame variables are called in other frames: one per group where the fit has one per group.

    A prior goes along when it is the same for all, or stands about what every frame sets.
    """

    def group(f: int) -> str:
        frame = model.frames[f]
        return getattr(frame, "group", None) or getattr(frame, "name", str(f))

    def noted(key: str, f: int) -> float:
        return float(model.frames[f].parameters.get(key, model.base[key]))

    def prior_in(alike: Sequence[Variable], f: int) -> tuple[float, float] | None:
        priors = {v.prior for v in alike}
        if len(priors) == 1:
            return alike[0].prior
        same = None not in priors and len({sd for _, sd in priors}) == 1
        key = alike[0].keys[0]
        if same and all(v.prior[0] == noted(key, v.frames[0]) for v in alike):
            return noted(key, f), alike[0].prior[1]
        return None

    found = []
    for keys in dict.fromkeys(v.keys for v in variables if v.frames is not None):
        alike = [v for v in variables if v.keys == keys and v.frames is not None]
        groups = [group(v.frames[0]) for v in alike]
        single = len(set(groups)) < len(groups)  # several values within one group: each frame has its own
        shared: dict[str, list[int]] = {}
        for f in frames:
            shared.setdefault(getattr(model.frames[f], "name", str(f)) if single else group(f), []).append(f)
        found += [
            Variable(f"{keys[0]}[{name}]", keys, alike[0].parameter, tuple(own), prior_in(alike, own[0]))
            for name, own in shared.items()
        ]
    return found


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


def normal_equations(
    model,
    variables: Sequence[Variable],
    values: Values,
    frames: Sequence[int],
    robust: bool = False,
    tick: Callable[[], None] | None = None,
) -> Normal:
    """J'WJ, J'Wr and chi2 of the frames at the values, with the priors' rows."""
    p = len(variables)
    a, b = np.zeros((p, p)), np.zeros(p)
    index_of = {v.name: i for i, v in enumerate(variables)}
    frame_chi2, frame_n, rows = [], [], []
    for frame, (prediction, images) in zip(frames, model.derivatives(values, variables, frames)):
        mask = model.usable(frame)
        scale = np.sqrt(mask / model.variance(values, frame, prediction)).astype(np.float32)
        if robust:
            scale *= np.sqrt(huber((model.frames[frame].image - prediction) * scale)).astype(np.float32)
        whitened = whiten(model, frame, prediction, scale)
        j = (
            np.stack([(image * scale).ravel() for image in images.values()])
            if images
            else np.zeros((0, whitened.size), np.float32)
        )
        where = [index_of[n] for n in images]
        # sums in double precision: of powers and reflectances only priors hold the common factor, and single precision
        # loses a prior beside precise data
        images64 = j.astype(float)
        a[np.ix_(where, where)] += images64 @ images64.T
        b[where] += images64 @ whitened
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
    """The normal equations at other values with the derivative images and weights of `normal`: one prediction, no
    derivative."""
    b, frame_chi2 = np.zeros(len(variables)), []
    for frame, prediction, (where, j, scale) in zip(frames, model.predict(values, frames), normal.rows):
        whitened = whiten(model, frame, prediction, scale)
        b[where] += j.astype(float) @ whitened
        frame_chi2.append(float(whitened.astype(float) @ whitened))
    pull, _, prior = prior_terms(model, variables, values)
    return Normal(normal.a, b + pull, sum(frame_chi2), prior, frame_chi2, normal.frame_n, normal.rows)


def solve(a: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray, damping: float = 0.0) -> np.ndarray:
    """The x in [low, high] that minimises x'(A + damping diag A)x/2 - b'x.

    In the eigenbasis of the scaled matrix; directions below TRUNCATION stay put. Bounds are kept by an active-set
    method (Stark & Parker's bounded-variable least squares), so that what is free makes up for what is held."""
    scale = np.sqrt(np.where(np.diag(a) > 0, np.diag(a), 1.0))
    low, high = np.where(np.diag(a) > 0, low, 0.0), np.where(np.diag(a) > 0, high, 0.0)
    eigen, vectors = np.linalg.eigh(a / np.outer(scale, scale))
    kept = eigen > TRUNCATION * max(eigen.max(initial=0.0), 1e-300)
    root, basis = np.sqrt(eigen[kept] + damping), vectors[:, kept].T
    target = basis @ (b / scale) / root
    step = basis.T @ (target / root) / scale
    if np.all((low <= step) & (step <= high)):
        return step
    open_ = high > low
    bounded = lsq_linear(
        (root[:, None] * basis)[:, open_], target, ((low * scale)[open_], (high * scale)[open_]), method="bvls"
    )
    step = np.zeros(len(b))
    step[open_] = bounded.x / scale[open_]
    return np.clip(step, low, high)


class Descent:
    """Damped steps down chi2 + priors, with the derivative images of one linearisation at a time.

    Steps are taken in `Parameter.coordinate`. State: theta, values, `here` (the normal equations at theta, on the
    images of the last `linearise`), damping."""

    def __init__(
        self,
        model,
        variables: Sequence[Variable],
        values: Values,
        frames: Sequence[int],
        robust: bool = False,
        damping: float = 1e-3,
    ):
        self.model, self.variables, self.frames, self.robust = model, list(variables), list(frames), robust
        self.low, self.high = (np.array([v.parameter.bounds[k] for v in variables], float) for k in (0, 1))
        for i, v in enumerate(variables):
            if v.parameter.squared:
                self.low[i] = max(self.low[i], 1e-3 * v.parameter.plausible)
        self.near = np.array([v.parameter.near for v in variables])
        self.reach = np.array([np.inf if v.parameter.linear else REACH * v.parameter.plausible for v in variables])
        self.theta = np.clip([start_of(model, v, values) for v in variables], self.low, self.high)
        self.values, self.damping, self.here = self.moved(values, self.theta), damping, None
        self.trust, self.bent = 1.0, False
        linear = getattr(model, "linear_in", lambda variable: False)
        self.powers = [i for i, v in enumerate(self.variables) if linear(v)]

    def moved(self, values: Values, theta: np.ndarray) -> Values:
        values = values.copy()
        for v, value in zip(self.variables, theta):
            values.put(v, float(value))
        return values

    def linearise(self, tick: Callable[[], None] | None = None) -> Normal:
        self.take(normal_equations(self.model, self.variables, self.values, self.frames, self.robust, tick))
        return self.here

    def take(self, normal: Normal) -> None:
        """Go on from normal equations at theta."""
        self.here, self.at = normal, self.theta
        self.slope = np.array([v.parameter.per_coordinate(t) for v, t in zip(self.variables, self.theta)])

    def _step(self, damping: float) -> tuple[np.ndarray, float]:
        """Where a damped step leads, and the fall of the misfit that the linear model expects of it.

        A damped step keeps within REACH, in which a linearisation may be trusted at all (a light that is sent round the
        sensor does not come back), or further where steps have brought what they promised."""
        reach = self.trust * self.reach if damping else np.inf
        box = (self.theta, np.maximum(self.low, self.theta - reach), np.minimum(self.high, self.theta + reach))
        u, low, high = (np.array([v.parameter.coordinate(t) for v, t in zip(self.variables, values)]) for values in box)
        a, b = self.here.a * np.outer(self.slope, self.slope), self.here.b * self.slope
        step = solve(a, b, low - u, high - u, damping)
        fall = float(2 * b @ step - step @ a @ step)
        moved = np.array([v.parameter.stepped(t, d, self.bent) for v, t, d in zip(self.variables, self.theta, step)])
        for end in (self.low, self.high):  # what stands at a bound is taken as known: not beside it by rounding
            moved = np.where(np.abs(moved - end) < self.near, end, moved)
        return np.clip(moved, self.low, self.high), fall

    def creep(self) -> None:
        """Go on along what is left near the best: nearly flat valleys, where any damping forbids to go, and which bend
        where one factor makes up for another. Far from it, factors by which lights grow without measure as they turn
        away are no way down."""
        self.damping, self.bent = 1e-9, True

    @property
    def promised(self) -> float:
        """The fall of the misfit that the linear model still expects."""
        return self._step(0.0)[1] if self.variables else 0.0

    def _at(self, theta: np.ndarray) -> tuple[np.ndarray, Values, Normal]:
        """Theta, with its values and its misfit."""
        values = self.moved(self.values, theta)
        return theta, values, again(self.model, self.variables, values, self.frames, self.here)

    def _settled(self, theta: np.ndarray, values: Values) -> tuple[np.ndarray, Values, Normal]:
        """Theta with the powers, in which the image is linear, solved for where all else is (variable projection)."""
        index, theta = self.powers, theta.copy()
        normal = normal_equations(self.model, [self.variables[i] for i in index], values, self.frames, self.robust)
        theta[index] += solve(normal.a, normal.b, (self.low - theta)[index], (self.high - theta)[index])
        return self._at(np.clip(theta, self.low, self.high))

    def chord(self, steps: int, enough: float, rough: float = 0.0, part: float = 0.0) -> float:
        """Steps on the same derivative images, which cost many times what a prediction does, `steps` of them tried at
        most; the total fall.

        Lights that move or widen change their brightness by far more than their pattern: a long step ends on the wall
        of a narrow valley. There the powers are solved for once more, which costs about a prediction, before a step is
        given up.

        enough   a promised fall, or a gain, not worth another step
        rough    chi2 may rise by a promise below this: close to the best, where chi2 is rough as shadow rims cross
                 pixels,
                 the root of J'Wr is followed, not chi2
        part     share of the first promise, of which no step beyond the first is worth its prediction
        """
        gained = first = 0.0
        while steps > 0:
            promised = self.promised
            first = first or promised
            if promised < enough or (gained and promised > part * first > 0):
                break
            worst = -promised if promised < rough else 0.0
            found, gain, expected, tried = self._search(steps, worst)
            steps -= tried
            if not gain > worst:
                break
            self.theta, self.values, self.here = found
            self.trust = min(2 * self.trust, 1e3) if gain > expected / 2 else max(self.trust / 2, 1.0)
            gained += gain
            self.damping = max(self.damping / 10, 1e-9)
            if gain < enough or 10 * enough < gain < POOR * expected:
                break
        return gained

    def _search(self, most: int, worst: float) -> tuple[tuple[np.ndarray, Values, Normal], float, float, int]:
        """(where it leads, its gain, what was expected, predictions): the first step that brings its part of what was
        expected, under ever more damping, or the best of `most`. A gain that is a poor part of what the same images
        promise is one that a shorter step beats, and costs a prediction more; taking it for progress spends a
        linearisation on a hundredth of that.

        worst   below it no gain is a step; negative where chi2 is rough, and there any above it is one
        """
        best = None
        for tried in range(1, most + 1):
            target, expected = self._step(self.damping)  # within reach, of which less may be expected
            found = self._at(target)
            if self.powers and not self.here.total - found[2].total > max(worst, expected / 2):
                found = min(found, self._settled(*found[:2]), key=lambda t: t[2].total)
            gain = self.here.total - found[2].total
            gain = gain if np.isfinite(gain) else -np.inf
            if best is None or gain > best[1]:
                best = found, gain, expected
            elif best[1] > worst:  # more damping brings less
                break
            if gain > (worst or POOR * expected) or self.damping > 1e4:
                break
            self.damping, self.trust = max(self.damping * 10, 1e-3), max(self.trust / 2, 1.0)
        return *best, tried


def fit(
    model,
    variables: Sequence[Variable],
    start: Values | None = None,
    frames: Sequence[int] | None = None,
    *,
    max_iterations: int = 40,
    robust: bool = False,
    tolerance: float = 0.05,
    progress: Callable[[str, int, int], None] | None = None,
) -> Fit:
    """Levenberg-Marquardt within bounds.

    Stops when the fall of chi2 that the linear model still predicts is below `tolerance` per variable or NEGLIGIBLE
    beside the excess, or when no damping gives a lower chi2. Raises Underdetermined when no pixel is usable or no
    variable does anything."""
    variables = list(variables)
    frames = list(range(len(model.frames))) if frames is None else list(frames)
    filled = with_start(model, variables, start or Values())
    first = np.array([start_of(model, v, filled) for v in variables])
    for v, value in zip(variables, first):
        v.parameter.check(value, v.name, "start value")
    descent = Descent(model, variables, filled, frames, robust)
    history, reason = [], ""
    best, tries = (np.inf, descent.theta, descent.values), 0
    done, accuracy = 0, tolerance * max(len(variables), 1)

    def tick():
        nonlocal done
        done += 1
        if progress:
            progress("calibrate", done, max_iterations * len(frames))

    for iteration in range(max_iterations):
        normal = descent.linearise(tick)
        if sum(normal.frame_n) == 0:
            names = [str(getattr(model.frames[f], "name", f)) for f in frames]
            raise Underdetermined(
                f"no usable value in the {len(frames)} frames to fit ({some(names)}): all are saturated, at black, or "
                "masked; check [noise] black_level and saturation in captures.toml, and the masks"
            )
        silent = [v.name for i, v in enumerate(variables) if normal.a[i, i] == 0]
        if len(silent) == len(variables) and variables:
            there = [f"{v.name} = {value:.4g}{spaced(v.parameter.unit)}" for v, value in zip(variables, descent.theta)]
            raise Underdetermined(
                f"none of the {len(variables)} free parameters changes any frame: at {some(there)}; allowed: what some "
                "frame depends on; free others, or correct what the frames set"
            )
        history.append(normal.total)
        promise, excess = descent.promised, max(normal.chi2 - sum(normal.frame_n) + len(variables), 0.0)
        if promise < max(accuracy, NEGLIGIBLE * excess):
            best, reason = (promise, descent.theta, descent.values), f"converged after {iteration} linearisations"
            break
        near = promise < 20 * len(variables)
        if near:
            tries += 1
            descent.creep()
            if promise < best[0]:
                best = (promise, descent.theta, descent.values)
            stuck = len(history) > 1 and history[-2] - promise / 4 < history[-1]
            if (tries > 4 and stuck) or (tries > 1 and best[0] < len(variables) / 2):
                break
        gained = descent.chord(3 if near else 8, accuracy / 10, 20 * len(variables) if near else 0.0, 0.3)
        if gained < accuracy and not near:
            reason = f"no lower misfit within reach; the linear model still promised {promise:.3g}"
            break
    else:
        reason = f"stopped after {max_iterations} linearisations without converging; allow more or start nearer"
    if not reason:
        reason = (
            f"converged after {iteration + 1} linearisations"
            if best[0] < len(variables)
            else f"the linear model still promised a fall of {best[0]:.3g}, which no step brought"
        )
        descent.theta, descent.values = best[1:]
    if descent.at is not descent.theta:  # the last steps moved on from where the derivative images were made
        normal = descent.linearise()
    theta, converged = descent.theta, reason.startswith("converged")
    covariance = covariance_of(normal.a)
    # of variables with priors, the degrees of freedom that these and not the data hold: sum of c_ii/sd_i^2
    held = sum(
        float(np.clip(c / v.prior[1] ** 2, 0.0, 1.0))
        for v, c in zip(variables, np.diag(covariance))
        if v.prior is not None
    )
    result = Fit(
        descent.values,
        variables,
        theta,
        covariance,
        normal.chi2,
        round(sum(normal.frame_n) - len(variables) + held),
        frames,
        normal.frame_chi2,
        normal.frame_n,
        converged,
        reason,
        history,
        start=first,
    )
    result.at_bound = [
        v.name for v, t, lo, hi in zip(variables, theta, descent.low, descent.high) if t <= lo or t >= hi
    ]
    result.warnings = warnings_of(result, normal.a)
    result.normal = normal
    return result


def extended(
    model, base: Fit, extra: Sequence[Variable], secant: Mapping[str, float] | None = None, steps: int = 10
) -> Fit:
    """Free further variables and calibrate everything again, by chord steps on the derivative images of a fit that has
    converged.

    Each step costs one prediction, where `fit` would make all derivative images afresh: what ranks many effects. The
    extra variables' images are tangents at the base's values, or secants of the sizes in `secant`. The steps follow the
    true prediction, so that the result is a true minimum along them; only its last digits, and the errors, are those of
    the base's linearisation. `converged` says whether the fall that it still predicts is below 1 per variable."""
    variables = [*base.variables, *extra]
    p, first = len(variables), len(base.variables)
    index_of = {v.name: i for i, v in enumerate(variables)}
    values = with_start(model, extra, base.values)
    a, b, rows = np.zeros((p, p)), np.zeros(p), []
    a[:first, :first] = base.normal.a
    derivatives = model.derivatives(values, list(extra), base.frames, secant=secant or {})
    for frame, (where, j, scale), (prediction, images) in zip(base.frames, base.normal.rows, derivatives):
        new = (
            np.stack([(i * scale).ravel() for i in images.values()])
            if images
            else np.zeros((0, j.shape[1]), np.float32)
        )
        there = [index_of[n] for n in images]
        whitened = whiten(model, frame, prediction, scale)
        added = new.astype(float)
        a[np.ix_(there, there)] += added @ added.T
        cross = j.astype(float) @ added.T
        a[np.ix_(where, there)] += cross
        a[np.ix_(there, where)] += cross.T
        rows.append((np.array([*where, *there], int), np.concatenate([j, new]), scale))
        b[rows[-1][0]] += rows[-1][1].astype(float) @ whitened
    pull, curvature, prior = prior_terms(model, variables, values)
    a[first:, first:] += np.diag(curvature[first:])
    descent = Descent(model, variables, values, base.frames, damping=1e-6)
    descent.take(Normal(a, b + pull, base.chi2, prior, base.frame_chi2, base.frame_n, rows))
    before = descent.here.total
    descent.chord(steps, 0.1 * p)
    here = descent.here
    return Fit(
        descent.values,
        variables,
        descent.theta,
        covariance_of(here.a),
        here.chi2,
        base.dof - len(extra),
        base.frames,
        here.frame_chi2,
        here.frame_n,
        descent.promised < p,
        "chord steps",
        [before, here.total],
    )


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
    texts, told = [], [set()]
    names = [v.name for v in result.variables]
    silent = [n for n, d in zip(names, np.diag(a)) if d == 0]
    if silent:
        texts.append(f"nothing in the frames depends on {some(silent, 8)}")
    if len(a):
        scale = np.sqrt(np.where(np.diag(a) > 0, np.diag(a), 1))
        eigen, vectors = np.linalg.eigh(a / np.outer(scale, scale))
        for value, vector in zip(eigen, vectors.T):
            if value < 1e-7 * eigen.max():
                part = [n for n, c in zip(names, vector) if abs(c) > 0.15 and n not in silent]
                if len(part) > 1:
                    told.append(set(part))
                    texts.append(
                        f"the captures cannot tell apart {some(part, 8)}: only a combination is determined; hold one of "
                        "them, or give it a prior"
                    )
    correlation = np.nan_to_num(result.correlation, posinf=0.0, neginf=0.0) * (1 - np.eye(len(names)))
    count, member = connected_components(np.abs(correlation) > ALIKE) if names else (0, None)
    for one in (np.flatnonzero(member == k) for k in range(count)):
        if len(one) < 2 or any({names[i] for i in one} <= part for part in told):
            continue
        if len(one) == 2:
            texts.append(f"{names[one[0]]} and {names[one[1]]} are correlated to {correlation[one[0], one[1]]:+.4f}")
        else:
            most = np.abs(correlation[np.ix_(one, one)]).max()
            texts.append(
                f"{some([names[i] for i in one])} are correlated among each other, to {most:.4f} at most: the captures know little "
                "more than one combination of them; hold one of them, or give it a prior"
            )
    texts += [f"{n} ended at its bound" for n in result.at_bound]
    if not result.converged:
        texts.append(result.reason)
    return texts
