"""Descent: damped Gauss-Newton steps down chi2 plus priors, several on the derivative images of one linearisation.

    normal equations    A = J'WJ + diag(1/sd^2),  b = J'Wr + (mean - theta)/sd^2
    step                min_x  x'(A + damping diag A)x/2 - b'x  within bounds

with J the derivative images, r the residual, W = 1/variance. Frames are streamed: besides A and b, only whitened
derivative images are kept. A prediction is cheap beside a linearisation, so steps are tried on the same images until
they bring little of what these promise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from optics.fit.curvature import own_curvature
from optics.fit.model import Model, value_of
from optics.scene.parameter import Values, Variable

REACH = 4.0  # plausible sizes that one step may change a nonlinear parameter: beyond, a light may pass the sensor's rim
# Times REACH, where no damping brings a gain: what the residual's own curvature holds back, as the zero of a dial at
# which images stand still, is not damped by what its image is worth.
SHORT_OF = (0.1, 0.01)
LITTLE = 0.01  # of what is promised: a gain that is as good as none
MOST_TRUST = 1e3  # times REACH: where steps keep bringing what they promise, the reach no longer matters
POOR = 0.25  # of the promised gain: a step that brings less has followed the linearisation too far
GOOD = 0.5  # of the promised gain: a step that brings more may be followed by one twice as long
# Of the promised gain, which is half of the slope times the step: a step that brings more shows that chi2 bends less
# than the images say, as along the valleys of a wrong model, and is made longer at once.
BETTER = 1.5
# eigenvalues of the scaled normal matrix below this share of the largest are rounding of double precision: undetermined
TRUNCATION = 1e-12
ONSET = 1e-3  # plausible sizes: a squared parameter starts no lower, as its derivative is 0 at 0
FIRST_DAMPING = 1e-3  # share of the diagonal: shortens only directions that the data hardly determine
EASING = 10.0  # factor between one damping and the next, as Marquardt has it
LEAST_DAMPING = 1e-9  # below the eigenvalue of a degenerate mode (`result.DEGENERATE`), which may then be followed
MOST_DAMPING = 1e4  # leaves a ten-thousandth of the step along the gradient: a shorter one is no progress
SCALED = 2.0  # times the truth: a power that starts further off is solved for before all else
HALVINGS = 4  # lengths of a step around the bend of a valley that are tried
CORRECTIONS = 2  # predictions that lead each back to the valley's floor
HUBER = 3.0  # standard deviations beyond which a robust fit lowers the weight of a value


Rows = tuple[np.ndarray, np.ndarray, np.ndarray]  # of a frame, see `Normal`


@dataclass
class Normal:
    """Normal equations at one point: A = J'WJ + priors, b = J'Wr + priors, chi2 of data and of priors.

    rows   per frame: indices of the variables that act in it, their whitened derivative images (k, n) float32 at the
           n values that are used, and sqrt(weight) (H, W, C), 0 at the others
    """

    a: np.ndarray
    b: np.ndarray
    chi2: float
    prior: float
    frame_chi2: list[float]
    frame_n: list[int]
    rows: list[Rows]

    @property
    def total(self) -> float:
        """What is minimised: chi2 of the data plus that of the priors."""
        return self.chi2 + self.prior

    @property
    def excess(self) -> float:
        """By how much chi2 exceeds the number of values."""
        return max(self.chi2 - sum(self.frame_n), 0.0)


def huber(whitened: np.ndarray, limit: float = HUBER) -> np.ndarray:
    """Weights min(1, limit/|r|), by which a robust fit multiplies 1/sigma^2."""
    return np.minimum(1.0, limit / np.maximum(np.abs(whitened), 1e-12))


def normal_equations(
    model: Model,
    variables: Sequence[Variable],
    values: Values,
    frames: Sequence[int],
    robust: bool = False,
    tick: Callable[[], None] | None = None,
) -> Normal:
    """J'WJ, J'Wr and chi2 of the frames at the values, plus the priors. One derivative image per variable and frame."""
    p = len(variables)
    a, b = np.zeros((p, p)), np.zeros(p)
    index_of = {v.name: i for i, v in enumerate(variables)}
    frame_chi2: list[float] = []
    frame_n: list[int] = []
    rows: list[Rows] = []
    for frame, (prediction, images) in zip(frames, model.derivatives(values, variables, frames)):
        mask = model.usable(frame)
        scale = np.sqrt(mask / model.variance(values, frame, prediction)).astype(np.float32)
        if robust:
            scale *= np.sqrt(huber((model.frames[frame].image - prediction) * scale)).astype(np.float32)
        whitened = whiten(model, frame, prediction, scale)
        j = stacked(images, scale)
        where = np.array([index_of[n] for n in images], int)
        # Sums in double precision: only priors hold the common factor of powers and reflectances, and beside precise
        # data single precision loses a prior.
        exact = j.astype(float)
        a[np.ix_(where, where)] += exact @ exact.T
        b[where] += exact @ whitened
        frame_chi2.append(float(whitened.astype(float) @ whitened))
        frame_n.append(int(mask.sum()))
        rows.append((where, j, scale))
        if tick:
            tick()
    pull, curvature, prior = prior_terms(model, variables, values)
    return Normal(a + np.diag(curvature), b + pull, sum(frame_chi2), prior, frame_chi2, frame_n, rows)


def stacked(images: dict[str, np.ndarray], scale: np.ndarray) -> np.ndarray:
    """(k, n) derivative images times sqrt(weight) at the n values that are used: a third of a raw mosaic's."""
    used = scale > 0
    if not images:
        return np.zeros((0, int(used.sum())), np.float32)
    return np.stack([image[used] * scale[used] for image in images.values()])


def whiten(model: Model, frame: int, prediction: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """(n,) residual times sqrt(weight) at the n values that are used."""
    used = scale > 0
    return ((model.frames[frame].image[used] - prediction[used]) * scale[used]).astype(np.float32)


def prior_terms(model: Model, variables: Sequence[Variable], values: Values) -> tuple[np.ndarray, np.ndarray, float]:
    """Gradient (p,), curvature (p,) and value of the priors' share of what is minimised."""
    pull, curvature, total = np.zeros(len(variables)), np.zeros(len(variables)), 0.0
    for i, v in enumerate(variables):
        if v.prior is not None:
            gap = v.prior[0] - value_of(model, values, v)
            pull[i], curvature[i] = gap * v.precision, v.precision
            total += gap**2 * v.precision
    return pull, curvature, total


def with_priors(
    normal: Normal, model: Model, values: Values, old: Sequence[Variable], new: Sequence[Variable]
) -> Normal:
    """Normal equations at these values with the priors of other variables of the same names."""
    pulls, curvatures, priors = zip(*(prior_terms(model, variables, values) for variables in (old, new)))
    return replace(
        normal,
        a=normal.a + np.diag(curvatures[1] - curvatures[0]),
        b=normal.b + pulls[1] - pulls[0],
        prior=priors[1],
    )


def again(model: Model, variables: Sequence[Variable], values: Values, frames: Sequence[int], normal: Normal) -> Normal:
    """The normal equations at other values with the derivative images and weights of `normal`: costs one prediction
    per frame."""
    b, frame_chi2 = np.zeros(len(variables)), []
    for frame, prediction, (where, j, scale) in zip(frames, model.predict(values, frames), normal.rows):
        whitened = whiten(model, frame, prediction, scale)
        b[where] += j.astype(float) @ whitened
        frame_chi2.append(float(whitened.astype(float) @ whitened))
    pull, _, prior = prior_terms(model, variables, values)
    return Normal(normal.a, b + pull, sum(frame_chi2), prior, frame_chi2, normal.frame_n, normal.rows)


def scaled_eigen(a: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(scale (p,), eigenvalues, eigenvectors) of A / (scale scale'), whose diagonal is 1: independent of units."""
    scale = np.sqrt(np.where(np.diag(a) > 0, np.diag(a), 1.0))
    return scale, *np.linalg.eigh(a / np.outer(scale, scale))


def solve(a: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray, damping: float = 0.0) -> np.ndarray:
    """The x in [low, high] that minimises x'(A + damping diag A)x/2 - b'x.

    In the eigenbasis of the scaled matrix; directions below TRUNCATION do not move. Bounds are kept by an active-set
    method (Stark & Parker's bounded-variable least squares), so that free variables make up for those at a bound."""
    scale, eigen, vectors = scaled_eigen(a)
    low, high = np.where(np.diag(a) > 0, low, 0.0), np.where(np.diag(a) > 0, high, 0.0)
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


def covariance_of(a: np.ndarray) -> np.ndarray:
    """(p, p) inverse of the normal matrix in its determined directions; undetermined variables have infinite variance.

    A variable counts as undetermined if a truncated direction holds more than a ten-thousandth of its square."""
    if not len(a):
        return np.zeros((0, 0))
    scale, eigen, vectors = scaled_eigen(a)
    kept = eigen > TRUNCATION * max(eigen.max(), 1e-300)
    inverse = (vectors[:, kept] / eigen[kept]) @ vectors[:, kept].T / np.outer(scale, scale)
    lost = (np.abs(vectors[:, ~kept]) > 1e-2).any(1) | (np.diag(a) == 0)
    inverse[lost, lost] = np.inf
    return inverse


class Descent:
    """Damped steps down chi2 plus priors.

    Steps are taken in `Parameter.coordinate`, in which images are nearly linear.

    theta, values   where it stands: (p,) numbers, and the same put into the values of the model
    here            normal equations at theta, on the derivative images of the last `linearise`
    at              theta at which those images were made
    curved          what the residual adds there to the diagonal of A (optics.fit.curvature)
    damping         of the next step; trust: its reach, in units of REACH
    """

    def __init__(
        self,
        model: Model,
        variables: Sequence[Variable],
        values: Values,
        frames: Sequence[int],
        robust: bool = False,
        damping: float = FIRST_DAMPING,
    ):
        self.model, self.variables, self.frames, self.robust = model, list(variables), list(frames), robust
        self.low, self.high = (np.array([v.parameter.bounds[k] for v in variables], float) for k in (0, 1))
        for i, v in enumerate(variables):
            if v.parameter.squared:
                self.low[i] = max(self.low[i], ONSET * v.parameter.plausible)
        self.near = np.array([v.parameter.near for v in variables])
        self.reach = np.array([np.inf if v.parameter.linear else REACH * v.parameter.plausible for v in variables])
        self.theta = np.clip([value_of(model, values, v) for v in variables], self.low, self.high)
        self.values, self.damping = self.moved(values, self.theta), damping
        self.here: Normal
        self.at: np.ndarray
        self.curved: np.ndarray
        self.slope: np.ndarray  # d theta / d coordinate at `at`
        self.trust, self.bent = 1.0, False
        self.stride = 1.0  # part of a step that led furthest down a valley
        self.powers = [i for i, v in enumerate(self.variables) if model.linear_in(v)]

    def moved(self, values: Values, theta: np.ndarray) -> Values:
        """A copy of the values with theta put in."""
        values = values.copy()
        for v, value in zip(self.variables, theta):
            values.put(v, float(value))
        return values

    def linearise(self, tick: Callable[[], None] | None = None) -> Normal:
        """Make derivative images at theta."""
        self.take(normal_equations(self.model, self.variables, self.values, self.frames, self.robust, tick))
        return self.here

    def take(self, normal: Normal) -> None:
        """Go on from normal equations at theta."""
        self.here, self.at = normal, self.theta
        self.curved = own_curvature(self.model, self.variables, self.values, self.frames)
        self.slope = np.array([v.parameter.per_coordinate(t) for v, t in zip(self.variables, self.theta)])

    def step(self, damping: float) -> tuple[np.ndarray, float]:
        """(theta after a damped step, expected fall of what is minimised).

        A damped step keeps within REACH, where a linearisation can be trusted at all (a light that is sent past the
        sensor does not come back), or further where steps have brought what they promised. Without damping, only the
        bounds limit it."""
        u, a, b = self._straight(damping)
        return self._stepped(u), float(2 * b @ u - u @ a @ u)

    def _straight(self, damping: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(damped step, A, b), all in coordinates."""
        low, high = self._room(damping)
        a = (self.here.a + np.diag(self.curved)) * np.outer(self.slope, self.slope)
        b = self.here.b * self.slope
        return solve(a, b, low, high, damping), a, b

    def _room(self, damping: float) -> tuple[np.ndarray, np.ndarray]:
        """How far down and up a step may lead, in coordinates."""
        reach = self.trust * self.reach if damping else np.inf
        box = (self.theta, np.maximum(self.lowest, self.theta - reach), np.minimum(self.high, self.theta + reach))
        u, low, high = (np.array([v.parameter.coordinate(t) for v, t in zip(self.variables, values)]) for values in box)
        return low - u, high - u

    def _stepped(self, step: np.ndarray) -> np.ndarray:
        """Theta after a step in coordinates."""
        moved = np.array([v.parameter.stepped(t, d, self.bent) for v, t, d in zip(self.variables, self.theta, step)])
        for end in (self.low, self.high):  # rounding must not leave a parameter just beside its bound
            moved = np.where((np.abs(moved - end) < self.near) & (end >= self.lowest), end, moved)
        return np.clip(moved, self.lowest, self.high)

    def around(self) -> float:
        """Follow a narrow valley that bends. Returns the gain.

        A part t of the step u should leave b - t A u of the slope b. Where images bend it leaves more, and
        corrections by the same images lead back to the valley's floor: s <- s + A^-1 (b(theta + s) - b + t A u). The
        first is the geodesic acceleration of Transtrum & Sethna (arXiv 1201.5885), with the bend measured over the
        step itself, where shadow rims that cross pixels are small beside it."""
        u, a, b = self._straight(self.damping)
        low, high = self._room(self.damping)
        promised = float(2 * b @ u - u @ a @ u)
        best: tuple[np.ndarray, Values, Normal] | None = None
        gained, t = 0.0, min(2 * self.stride, 1.0)
        for _ in range(HALVINGS):
            s, expected = t * u, GOOD * t * (2 - t) * promised
            for n in range(CORRECTIONS + 1):
                found = there = self._at(self._stepped(s))
                if self.powers and n == 0 and not self.here.total - found[2].total > expected:
                    found = min(there, self._settled(*there[:2]), key=lambda x: x[2].total)
                gain = self.here.total - found[2].total
                if gain > gained:
                    gained, best, self.stride = gain, found, t
                if gain > expected or n == CORRECTIONS or not np.isfinite(there[2].total):
                    break
                s = s + solve(a, there[2].b * self.slope - b + t * (a @ u), low - s, high - s)
            if gained > expected or (best is not None and self.stride > t):
                break
            t /= 2
        if best is not None:
            self.theta, self.values, self.here = best
        return gained

    @property
    def lowest(self) -> np.ndarray:
        """(p,) how far down steps on these derivative images may lead: a factor that is switched off hides everything
        else."""
        return np.maximum(self.low, [v.parameter.lowest(t) for v, t in zip(self.variables, self.at)])

    def creep(self) -> None:
        """Follow nearly flat valleys, close to the optimum: next to no damping, which would forbid to move along them,
        and steps of factors by their logarithm, as such valleys bend where one factor makes up for another. Far from
        the optimum a light that turns away would grow without limit that way."""
        self.damping, self.bent = LEAST_DAMPING, True

    @property
    def promised(self) -> float:
        """The fall of what is minimised that the linearisation still expects."""
        return self.step(0.0)[1] if self.variables else 0.0

    def _at(self, theta: np.ndarray) -> tuple[np.ndarray, Values, Normal]:
        """Theta, with its values and its misfit."""
        values = self.moved(self.values, theta)
        return theta, values, again(self.model, self.variables, values, self.frames, self.here)

    def _settled(self, theta: np.ndarray, values: Values) -> tuple[np.ndarray, Values, Normal]:
        """Theta after the powers, in which the image is linear, are solved for with all else fixed (variable
        projection)."""
        variables = [self.variables[i] for i in self.powers]
        return self._at(self._solved(normal_equations(self.model, variables, values, self.frames, self.robust), theta))

    def _solved(self, normal: Normal, theta: np.ndarray) -> np.ndarray:
        """Theta with the powers at the minimum of their own normal equations; one that is best switched off falls to a
        part of its value, as in a step."""
        index, theta = self.powers, theta.copy()
        best = theta[index] + solve(normal.a, normal.b, (self.low - theta)[index], (self.high - theta)[index])
        least = self.lowest[index]
        theta[index] = np.where(best > self.low[index], np.clip(best, self.low[index], self.high[index]), least)
        return theta

    def scale(self) -> bool:
        """Solve for the powers alone on the images of `linearise`, and move there if one of them is off by more than
        SCALED: of readings in volts or in 12 bits nobody knows the scale, and all other images are proportional to it.
        Not where those that are gain less than a hundredth of what a full step promises: a faint lamp may be off by any
        factor.
        Returns whether theta has moved."""
        if not self.powers:
            return False
        index, here = self.powers, self.here
        own = Normal(here.a[np.ix_(index, index)], here.b[index], 0.0, 0.0, [], [], [])
        moved = self._solved(own, self.theta)
        old, new = self.theta[index], moved[index]
        far = (new > SCALED * old) | (old > SCALED * new)
        change = np.where(far, new - old, 0.0)
        if not far.any() or 2 * own.b @ change - change @ own.a @ change < LITTLE * self.promised:
            return False
        self.theta, self.values = moved, self.moved(self.values, moved)
        return True

    def chord(self, steps: int, enough: float, rough: float = 0.0, part: float = 0.0, negligible: float = 0.0) -> float:
        """Take steps on the same derivative images; returns the total fall. At most `steps` of them are tried.

        Lights that move or widen change their brightness far more than their pattern, so a long step ends on the wall
        of a narrow valley. There the powers are solved for again, which costs about a prediction, before a step is
        given up.

        enough   a promised fall, or a gain, that is not worth another step
        rough    below this promise chi2 may rise by as much as is promised: close to the optimum chi2 is rough, as
                 shadow rims cross pixels, and the root of J'Wr is followed instead
        part     share of the first promise below which a further step is worth its prediction
        negligible   share of what is left beyond noise that is as good as nothing, besides `enough`
        """
        gained = first = 0.0
        while steps > 0:
            promised, least = self.promised, max(enough, negligible * self.here.excess)
            first = first or promised
            if promised < least or (gained and promised > part * first > 0):
                break
            worst = -promised if promised < rough else 0.0
            found, gain, expected, tried = self._search(steps, worst)
            steps -= tried
            if not gain > worst:
                break
            self.theta, self.values, self.here = found
            self.trust = (
                min(2 * self.trust, MOST_TRUST) if gain > GOOD * expected else max(self.trust / 2, min(self.trust, 1.0))
            )
            gained += gain
            self.damping = max(self.damping / EASING, LEAST_DAMPING)
            # a poor step that still gains ten times what is worth a step is better followed by new images
            if gain < least or 10 * enough < gain < POOR * expected:
                break
        return gained

    def _search(self, most: int, worst: float) -> tuple[tuple[np.ndarray, Values, Normal], float, float, int]:
        """(where it leads, gain, expected gain, predictions made) of the first step that brings its part of what was
        expected, under increasing damping, or of the best of `most`.

        A gain that is a poor part of the promise is beaten by a shorter step on the same images, for one prediction
        more; accepting it would spend a linearisation on a hundredth of the promise. A gain that is more than was
        promised is followed by steps twice as long, while these bring half as much again.

        worst   a step must gain more than this; negative where chi2 is rough, where any such step is accepted
        """
        best: tuple[tuple[np.ndarray, Values, Normal], float, float] | None = None
        tried = 0
        while tried < most:
            tried += 1
            target, expected = self.step(self.damping)  # within reach, of which less may be expected
            found = self._at(target)
            if self.powers and not self.here.total - found[2].total > max(worst, GOOD * expected):
                found = min(found, self._settled(*found[:2]), key=lambda t: t[2].total)
            gain = self.here.total - found[2].total
            gain = gain if np.isfinite(gain) else -np.inf
            if best is None or gain > best[1]:
                best = found, gain, expected
            elif best[1] > worst:  # more damping brings less
                break
            if gain > (worst or POOR * expected) or self.damping > MOST_DAMPING:
                break
            self.damping, self.trust = max(self.damping * EASING, FIRST_DAMPING), max(self.trust / 2, 1.0)
        assert best is not None  # `most` is 1 or more
        ahead = best[2]
        while tried < most and best[1] > BETTER * ahead > 0:
            target = np.clip(2 * best[0][0] - self.theta, self.lowest, self.high)
            tried, found = tried + 1, self._at(target)
            gain, ahead = self.here.total - found[2].total, best[1]
            if gain > best[1]:
                best = found, gain, best[2]
        if best[1] > max(worst, LITTLE * self.promised):
            return *best, tried
        before = self.trust, self.damping
        for trust in SHORT_OF:
            tried, self.trust, self.damping = tried + 1, trust, FIRST_DAMPING
            target, expected = self.step(self.damping)
            found = self._at(target)
            gain = self.here.total - found[2].total
            if gain > max(best[1], 0.0):
                return found, gain, expected, tried
        self.trust, self.damping = before
        return *best, tried
