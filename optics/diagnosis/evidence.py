"""Evidence: derivative images of a calibrated model and of candidate effects, whitened and summed over the frames.

Masks come from data and noise, never from the size of a residual; weights come from the prediction. Normal equations
take every usable pixel; curves, splits and alternative weights use a thinned lattice of pixels that is kept in memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from optics.captures.capture_set import Frame
from optics.diagnosis import statistics as st
from optics.diagnosis.result import Row
from optics.errors import Underdetermined
from optics.fit.model import Model, seeds_apart, value_of, values_in
from optics.scene.declare import Effect
from optics.scene.parameter import Values, Variable

NOT_FINITE = 0.01  # of the usable values: more than stray pixels, such as a normal that no surface has
DARK = 1e-6  # of the noise: less light than this, on average, is none
OF_SCALE = 0.003  # of full scale: the offset of an amplifier or a meter that was not set to zero
SQUARE_ONSET = 1e-3  # plausible sizes from neutral below which a squared parameter counts as being there

Progress = Callable[[str, int, int], None]  # (what, done, total)


def silent(what: str, done: int, total: int) -> None:
    """Progress that is not reported."""


def at_bound(variable: Variable, value: float) -> bool:
    """Whether a variable stands at one of its bounds: it may move to one side only."""
    return variable.parameter.side(value) != 0


@dataclass
class Candidate:
    """An effect under test: its variables, where they start, and what was found.

    sides       per variable: +1 may only rise, -1 may only fall, 0 either
    plausible   per variable, in its unit
    forms       'tangent' / 'secant' -> columns of the evidence that hold its images
    broken      whether a derivative image was not finite
    Set when it is scored (`optics.diagnosis.score`):
    form        the form that explains most; columns, cone and linear (coefficients of the columns, see `change_of`) are
                of it
    raw         rms change of the images at the plausible strengths, over the mean signal, before any calibration
    """

    effect: Effect
    variables: list[Variable]
    start: np.ndarray
    sides: list[int]
    plausible: np.ndarray
    forms: dict[str, list[int]] = field(default_factory=dict)
    broken: bool = False
    form: str = ""
    columns: list[int] = field(default_factory=list)
    cone: st.Cone = None  # type: ignore[assignment]
    linear: np.ndarray = None  # type: ignore[assignment]
    row: Row = None  # type: ignore[assignment]
    raw: float = 0.0

    def contains(self, other: Candidate) -> bool:
        """Whether it frees everything that another frees, and more: it fits as well as that one in any case."""
        mine, others = ({(key, v.frames) for v in c.variables for key in v.keys} for c in (self, other))
        return mine > others

    @classmethod
    def at(cls, model: Model, values: Values, effect: Effect, variables: Sequence[Variable]) -> Candidate:
        """An effect under test at the values: its strengths start there, and move to the sides that are open."""
        start = np.array([value_of(model, values, v) for v in variables])
        sides = [v.parameter.side(value) for v, value in zip(variables, start)]
        return cls(effect, list(variables), start, sides, np.array([_plausible(model, v) for v in variables]))

    @property
    def usual(self) -> np.ndarray:
        """Changes of plausible size, to the side that is open. Per-frame strengths alternate in sign: all alike would
        be one scale, which a calibration absorbs."""
        sides = np.array(self.sides)
        turn = np.where([v.frames is not None and i % 2 == 1 for i, v in enumerate(self.variables)], -1.0, 1.0)
        return self.plausible * np.where(sides == 0, turn, sides)

    @property
    def direction(self) -> np.ndarray:
        """Coefficients at which effects are compared: as found, or of the usual size where nothing was found."""
        return self.linear if self.linear.any() else self.linear_of(self.usual)

    def _squares(self) -> np.ndarray:
        """Which variables act by their square: a secant to the plausible size is then linear in s^2/plausible."""
        own = [
            v.parameter.squared and abs(start) < SQUARE_ONSET * v.parameter.plausible
            for v, start in zip(self.variables, self.start)
        ]
        return np.array(own) & (self.form == "secant")

    def change_of(self, linear: np.ndarray) -> np.ndarray:
        """Change of each strength, in its unit, from the coefficients of the columns."""
        return np.where(self._squares(), np.sign(linear) * np.sqrt(np.abs(linear) * self.plausible), linear)

    def linear_of(self, change: np.ndarray) -> np.ndarray:
        """Coefficients of the columns for a change of the strengths; the inverse of `change_of`."""
        return np.where(self._squares(), np.sign(change) * change**2 / self.plausible, change)

    def sd_of(self, sd: np.ndarray) -> np.ndarray:
        """Standard deviation of each strength from those of the coefficients."""
        change = np.abs(self.change_of(self.linear))
        slope = np.maximum(2 * change / self.plausible, np.sqrt(sd / self.plausible))
        return np.where(self._squares(), sd / np.where(slope > 0, slope, 1.0), sd)


def _plausible(model: Model, variable: Variable) -> float:
    """The plausible size of a variable, in its unit. What is declared in DN is meant for cameras: of a table, whose
    readings have any unit, it is a share of the full scale."""
    if variable.parameter.unit != "DN" or model.captures is None or model.captures.table is None:
        return variable.parameter.plausible
    return OF_SCALE * float(model.noise.saturation - model.noise.black_level)


# -- measuring: one pass over the frames -----------------------------------------------------------------------------
@dataclass
class Block:
    """Values of one frame that are kept: whitened columns a (n, k) in the places `where`, residual r (n,).

    b            a second render of the same columns where images are noisy, else None
    prediction   (n,) DN, of the seed `Evidence.seed`, not of the residual's: where images are Monte Carlo estimates,
                 its error is independent of r
    index        (n,) into the flattened (H, W, C)
    inner        (n,) bool: still used when the mask is widened by one pixel
    """

    frame: int
    where: np.ndarray
    a: np.ndarray
    b: np.ndarray | None
    r: np.ndarray
    sigma: np.ndarray
    prediction: np.ndarray
    index: np.ndarray
    inner: np.ndarray

    @property
    def middle(self) -> np.ndarray:
        return self.a if self.b is None else (self.a + self.b) / 2

    def columns(self, columns: Sequence[int]) -> np.ndarray:
        """(n, k) whitened derivative images; 0 where the block has none of a column."""
        position = {int(w): i for i, w in enumerate(self.where)}
        images = np.zeros((len(self.r), len(columns)))
        there = [(i, position[c]) for i, c in enumerate(columns) if c in position]
        images[:, [i for i, _ in there]] = self.middle[:, [j for _, j in there]]
        return images


@dataclass
class Evidence:
    """Normal equations of all frames, the thinned values, and whitened residual images.

    columns          variable of each column; base, rest: columns of the base, and of candidates
    values           at which the images were made
    sigma, whitened, use   per frame (H, W, C): standard deviation in DN, residual in sigmas (0 outside the mask), mask
    precision, pull  1/tau^2 and (mean - value)/tau^2 of the base's priors
    thinning         k: every k-th value is kept in `blocks`
    render_noise     variance between two seeds of the prediction, over that of the camera
    signal           mean predicted signal, DN; noise: rms standard deviation over it; masked: share not used
    seed             of images to bin or to scale residuals by: were they binned by an image whose error is in the
                     residual, residuals would follow that error
    projected        candidates projected off the base; candidates: those that were scored, best first
    """

    columns: list[Variable]
    base: list[int]
    rest: list[int]
    values: Values
    normal: st.Normal
    blocks: list[Block]
    frames: list[int]
    sigma: list[np.ndarray]
    whitened: list[np.ndarray]
    use: list[np.ndarray]
    spectrum: st.Spectrum | st.Sweeps
    precision: np.ndarray
    pull: np.ndarray
    thinning: int
    not_finite: int
    render_noise: float
    signal: float
    noise: float
    masked: float
    seed: int = 0
    projected: st.Projected = None  # type: ignore[assignment]
    candidates: list[Candidate] = field(default_factory=list)

    @property
    def apart(self) -> float:
        """Values whose noise in derivative images is independent: neighbours within 2 x 2 pixels and channels share
        directions of the second bounce, and all frames do."""
        return max(self.normal.count / max(len(self.frames), 1) / (4 * self.channels), 1.0)

    @property
    def channels(self) -> int:
        return self.use[0].shape[2]

    @property
    def is_table(self) -> bool:
        """Whether the values are readings of a table."""
        return isinstance(self.spectrum, st.Sweeps)

    def dense(self, columns: Sequence[int]) -> np.ndarray:
        """(n, k) whitened derivative images of all kept values, 0 where a block has none of a column."""
        return np.concatenate([block.columns(columns) for block in self.blocks])

    def order(self, model: Model) -> np.ndarray:
        """(n,) number of each kept value in the order of recording: the row of the table that it stands in."""
        numbers = []
        for block in self.blocks:
            frame = model.frames[block.frame]
            rows = frame.rows if frame.rows is not None else np.full(frame.image.shape[:1] + (1, 1), block.frame, float)
            numbers.append(np.broadcast_to(rows, frame.image.shape).reshape(-1)[block.index])
        return np.concatenate(numbers)

    def lit(self, model: Model) -> np.ndarray:
        """(n,) predicted signal of each kept value over its standard deviation."""
        black = float(model.noise.black_level)
        return np.concatenate([(block.prediction - black) / block.sigma for block in self.blocks])

    @property
    def gradient(self) -> float:
        """|Q'r|^2 per parameter of the base: below 1 it is calibrated."""
        return self.projected.absorbed / max(self.projected.rank, 1)

    def inverse(self, base: Sequence[int], bend: np.ndarray | float = 0.0) -> np.ndarray:
        """(p, p) inverse of the Gram matrix of base columns, with the priors of the first of them; `bend` is added to
        its diagonal (optics.fit.curvature)."""
        gram = self.normal.gram[np.ix_(base, base)] + np.diag(_padded(self.precision, base) + bend)
        return st.inverse(gram, self.normal.truncation(base))[0]

    def structure(
        self,
        whitened: Sequence[np.ndarray],
        base: Sequence[int],
        apart: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> st.Structure:
        """Test of structure in residual images, after a calibration of the columns `base`: of low frequencies, and of
        what the spectrum looks for besides.

        apart   of readings, what whitens columns (n, k) by the noise that they share; None: by that of settings"""
        if apart is not None and isinstance(self.spectrum, st.Sweeps):
            return self.spectrum.test(whitened, base, self.inverse(base), apart)
        return self.spectrum.test(whitened, base, self.inverse(base))

    def variance(self, model: Model, frame: int, prediction: np.ndarray, values: Values | None = None) -> np.ndarray:
        """(H, W, C) DN^2, of a frame about its prediction. Where the model does not state the error of its prediction,
        the variance between two seeds is added."""
        known = model.variance(values or self.values, frame, prediction)
        return known if model.monte_carlo else known * (1 + self.render_noise)

    def thinned(self, weight: Callable[[Block], np.ndarray] | None = None, extra: int = 0) -> st.Normal:
        """Normal equations of the kept pixels alone; `weight` (n,) multiplies rows, `extra` columns are left empty."""
        normal = st.Normal(len(self.columns) + extra)
        for block in self.blocks:
            if weight is None:
                normal.add(block.where, block.a, block.r, block.b)
                continue
            w = weight(block)
            b = None if block.b is None else block.b * w[:, None]
            normal.add(block.where, block.a * w[:, None], block.r * w, b)
        return normal

    def off_base(self, images: Iterable[np.ndarray], count: int) -> tuple[st.Projected, np.ndarray]:
        """(what the base leaves of further columns, their squared lengths), of the kept values.

        images   (n, count) whitened, of each block in order"""
        first = len(self.columns)
        normal = self.thinned(extra=count)
        for block, own in zip(self.blocks, images):
            st.add_bins(normal, block.where, block.middle, block.r, first, np.zeros(len(block.r), int), 1, [*own.T])
        columns = list(range(first, first + count))
        return self.project(normal, self.base, columns, self.thinning), np.diag(normal.gram)[columns]

    def project(
        self, normal: st.Normal, base: Sequence[int], rest: Sequence[int], thinning: int = 1, noisy: bool = False
    ) -> st.Projected:
        """Project with the priors of the first base columns; thinned data meet thinned priors."""
        return st.project(
            normal,
            base,
            rest,
            _padded(self.precision, base) / thinning,
            _padded(self.pull, base) / thinning,
            noisy=noisy,
        )


def known_products(precision: np.ndarray, pull: np.ndarray, columns: int) -> np.ndarray:
    """(k + 1, k + 1) products of images and residual of what is known beforehand of the first of `columns` variables,
    as if it had been read: an image 1/tau, a residual (mean - value)/tau (`priors`)."""
    found = np.zeros((columns + 1, columns + 1))
    count = len(precision)
    found[range(count), range(count)] = precision
    found[:count, -1] = found[-1, :count] = pull
    found[-1, -1] = float(np.sum(pull[precision > 0] ** 2 / precision[precision > 0]))
    return found


def _padded(known: np.ndarray, base: Sequence[int]) -> np.ndarray:
    """Priors of the first base columns, none for those that follow."""
    return np.concatenate([known, np.zeros(len(base) - len(known))])


@dataclass
class Layout:
    """Which image each column of the evidence holds: tangents of the base, tangents and then secants of candidates.

    steps   variable's name -> the step of its secant, its plausible size to the side that is open
    """

    tangent: list[Variable]
    secant: list[Variable] = field(default_factory=list)
    steps: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, base: Sequence[Variable], candidates: Sequence[Candidate]) -> Layout:
        """Give every candidate its columns (`Candidate.forms`) behind those of the base."""
        layout = cls(list(base))
        for c in candidates:
            if c.effect.onset in ("tangent", "both"):
                c.forms["tangent"] = [len(layout.tangent) + i for i in range(len(c.variables))]
                layout.tangent += c.variables
        for c in candidates:
            if c.effect.onset in ("secant", "both"):
                c.forms["secant"] = [len(layout.columns) + i for i in range(len(c.variables))]
                layout.secant += c.variables
                for v, side in zip(c.variables, c.sides):
                    layout.steps[v.name] = v.parameter.plausible * (-1 if side < 0 else 1)
        return layout

    @property
    def columns(self) -> list[Variable]:
        return self.tangent + self.secant

    def images(
        self, model: Model, values: Values, frames: Sequence[int], seed: int, wanted: set[int] | None = None
    ) -> Iterator[tuple[np.ndarray | None, dict[int, np.ndarray]]]:
        """(prediction, column -> derivative image (H, W, C)) of each frame; `wanted`: these columns only. The
        prediction is None where there are none."""
        passes = []
        for first, variables, steps in ((0, self.tangent, None), (len(self.tangent), self.secant, self.steps)):
            places: dict[str, list[int]] = {}  # two effects may free the same variable
            for i, v in enumerate(variables):
                if wanted is None or first + i in wanted:
                    places.setdefault(v.name, []).append(first + i)
            if not places:
                continue
            asked = list({v.name: v for v in variables if v.name in places}.values())
            secant = None if steps is None else {v.name: steps[v.name] for v in asked}
            passes.append((places, iter(model.derivatives(values, asked, frames, secant=secant, seed=seed))))
        for _ in frames:
            prediction, found = None, {}
            for places, images in passes:
                prediction, named = next(images)
                found.update({i: np.asarray(image) for name, image in named.items() for i in places[name]})
            yield prediction, found


def measure(
    model: Model,
    values: Values,
    base: Sequence[Variable],
    candidates: Sequence[Candidate],
    frames: Sequence[int],
    rows_max: int,
    seed: int,
    say: Progress,
    what: str = "derivative images",
) -> Evidence:
    """One pass over the frames: derivative images of the base and of every candidate, whitened and summed.

    The residual comes from `model.predict`; derivative images have seeds of their own. Where a second seed changes an
    image of the first frame, that variable is rendered twice in every frame and products are taken across.

    rows_max   values to keep for curves, splits and alternative weights;   what: the name of this pass in `say`
    Raises Underdetermined when no value is usable, ValueError when more than NOT_FINITE of them are not finite.
    """
    layout = Layout.of(base, candidates)
    seeds = seeds_apart(seed)
    evidence, total = _empty(model, values, layout, len(base), frames, rows_max, seeds[0])
    noisy: set[int] = set()
    seconds: Iterator[tuple[np.ndarray | None, dict[int, np.ndarray]]] = iter(())
    signal = variance = 0.0
    say(what, 0, len(frames))
    firsts = layout.images(model, values, frames, seeds[0])
    for n, (frame, plain, (own, first)) in enumerate(zip(frames, model.predict(values, frames), firsts)):
        prediction = np.asarray(plain, float)
        second: dict[int, np.ndarray] = {}
        if n == 0:
            ((other, again),) = layout.images(model, values, [frame], seeds[1])
            noisy = {c for c in first if c not in again or not np.array_equal(first[c], again[c], equal_nan=True)}
            second = again if noisy else {}
            seconds = layout.images(model, values, frames[1:], seeds[1], noisy)
            if own is not None and other is not None and not np.array_equal(own, other):
                evidence.render_noise = _between(own, other, model.noise.variance(prediction), model.usable(frame))
        elif noisy:
            _, second = next(seconds)
        binned = prediction if own is None else own
        _add_frame(evidence, model, frame, n, prediction, binned, first, second, noisy, candidates, len(base))
        use, sigma = evidence.use[-1], evidence.sigma[-1]
        signal += float(prediction[use].sum())
        variance += float((sigma[use].astype(float) ** 2).sum())
        say(what, n + 1, len(frames))
    _require_values(evidence)
    count = evidence.normal.count
    evidence.signal = signal / count - float(model.noise.black_level)
    if abs(evidence.signal) <= DARK * math.sqrt(variance / count):
        raise Underdetermined(
            f"diagnose: the calibrated model predicts no light in any of {len(frames)} frames: they are no brighter "
            f"than black_level = {float(model.noise.black_level):g}; expose longer, or correct [noise] black_level in "
            "captures.toml"
        )
    evidence.noise = math.sqrt(variance / count) / evidence.signal
    evidence.masked = 1 - (count / total)
    evidence.projected = evidence.project(
        evidence.normal, evidence.base, evidence.rest, noisy=not noisy.isdisjoint(evidence.base)
    )
    return evidence


def _between(one: np.ndarray, two: np.ndarray, variance: np.ndarray, usable: np.ndarray) -> float:
    """Mean of half the square of the difference of two predictions, over the camera's variance."""
    sample = (np.asarray(one, float) - two)[usable] ** 2 / 2 / variance[usable]
    return float(np.mean(sample[np.isfinite(sample)]))


def _empty(
    model: Model, values: Values, layout: Layout, base: int, frames: Sequence[int], rows_max: int, seed: int
) -> tuple[Evidence, float]:
    """(evidence without a frame yet, values that the frames hold); base: columns of the base."""
    columns = layout.columns
    total, used = values_in(model, frames), sum(int(model.usable(frame).sum()) for frame in frames)
    sweeps = all(model.frames[f].readings for f in frames)
    precision, pull = priors(model, values, columns[:base])
    evidence = Evidence(
        columns=columns,
        base=list(range(base)),
        rest=list(range(base, len(columns))),
        values=values,
        normal=st.Normal(len(columns)),
        blocks=[],
        frames=list(frames),
        sigma=[],
        whitened=[],
        use=[],
        spectrum=st.Sweeps() if sweeps else st.Spectrum(len(columns)),
        precision=precision,
        pull=pull,
        thinning=st.thinning(used, rows_max),
        not_finite=0,
        render_noise=0.0,
        signal=0.0,
        noise=0.0,
        masked=0.0,
        seed=seed,
    )
    return evidence, total


def _require_values(evidence: Evidence) -> None:
    count = evidence.normal.count
    if count == 0:
        raise Underdetermined("diagnose: no usable value in the fitted frames; check masks, saturation and exposure")
    if evidence.not_finite > NOT_FINITE * count:
        raise ValueError(
            f"diagnose: prediction or derivative images of the base are not finite in {evidence.not_finite} of "
            f"{count + evidence.not_finite} usable values; a parameter may have left its physical range"
        )


def priors(model: Model, values: Values, base: Sequence[Variable]) -> tuple[np.ndarray, np.ndarray]:
    """(1/tau^2, (mean - value)/tau^2) of the base's priors, 0 where there is none."""
    precision, pull = np.zeros(len(base)), np.zeros(len(base))
    for i, v in enumerate(base):
        if v.prior is not None:
            precision[i] = v.precision
            pull[i] = (v.prior[0] - value_of(model, values, v)) * precision[i]
    return precision, pull


def _add_frame(
    evidence: Evidence,
    model: Model,
    frame: int,
    n: int,
    prediction: np.ndarray,
    other: np.ndarray,
    first: dict[int, np.ndarray],
    second: dict[int, np.ndarray],
    noisy: set[int],
    candidates: Sequence[Candidate],
    p: int,
) -> None:
    """Whiten a frame's images and add them; n: its place among the frames, p: number of base columns."""
    image = np.asarray(model.frames[frame].image, float)
    variance = evidence.variance(model, frame, prediction)
    mask = np.asarray(model.usable(frame), bool)
    good = mask & np.isfinite(prediction) & np.isfinite(image) & (variance > 0)
    where = np.array(sorted(first), int)
    broken: set[int] = set()  # columns of candidates with a value that is not finite: left out as a whole
    for c in where:
        for images in (first, second):
            if c in images and not np.isfinite(images[c][good]).all():
                if c < p:
                    good &= np.isfinite(images[c])
                else:
                    broken.add(c)
                    for candidate in candidates:
                        candidate.broken |= any(c in columns for columns in candidate.forms.values())
    evidence.not_finite += int(mask.sum() - good.sum())
    weight = np.where(good, 1 / np.sqrt(np.where(good, variance, 1.0)), 0.0)

    def stack(images: dict[int, np.ndarray]) -> np.ndarray:
        out = np.zeros((*image.shape, len(where)))
        for i, c in enumerate(where):
            if c not in broken:
                np.multiply(np.where(good, images.get(c, first[c]), 0.0), weight, out=out[..., i])
        return out

    a = stack(first)
    b = stack(second) if noisy else None
    whitened = np.where(good, (image - prediction) * weight, 0.0)
    evidence.normal.add(where, a[good], whitened[good], None if b is None else b[good])
    if isinstance(evidence.spectrum, st.Sweeps):
        evidence.spectrum.add(good, where, a, _swept(model.frames[frame], prediction))
    else:
        signal = np.where(good, (prediction - model.noise.black_level) * weight, 0.0)
        evidence.spectrum.add(good, where, a, signal)
    keep = good & st.lattice(image.shape, evidence.thinning, n)
    evidence.blocks.append(
        Block(
            frame,
            where,
            a[keep],
            None if b is None else b[keep],
            whitened[keep],
            1 / weight[keep],
            np.asarray(other, float)[keep],
            np.flatnonzero(keep),
            (mask if isinstance(evidence.spectrum, st.Sweeps) else _dilated(mask))[keep],
        )
    )
    evidence.use.append(good)
    evidence.sigma.append(np.where(good, np.sqrt(variance), np.inf).astype(np.float32))
    evidence.whitened.append(whitened.astype(np.float32))


def _swept(sweep: Frame, prediction: np.ndarray) -> dict[str, np.ndarray]:
    """name -> value of each reading of a sweep: predicted signal, row of the table, and settings.

    A simulated shot has one reading for all that are alike, and no row."""
    still = {k: np.full(1, v) for k, v in sweep.parameters.items() if isinstance(v, float)}
    turned = {
        k: v
        for k, v in (("reading", sweep.rows), *sweep.readings.items())
        if v is not None and len(v) == len(prediction)
    }
    return {"signal": prediction, **still, **turned}


def _dilated(mask: np.ndarray) -> np.ndarray:
    """The mask with every unusable region grown by one pixel, within each plane of a mosaic."""
    from scipy.ndimage import binary_erosion

    out = np.zeros_like(mask)
    for plane in st.planes_of(mask):
        out[plane] = binary_erosion(mask[plane], np.ones((3, 3), bool), border_value=1)
    return out
