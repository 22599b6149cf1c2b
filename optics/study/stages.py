"""The staged calibration, and how its result is tested on frames that it has not seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from optics.captures.capture_set import group_of
from optics.fit import calibrate
from optics.fit.branches import over_branches
from optics.fit.compare import Comparison, compare
from optics.fit.model import value_of
from optics.fit.result import Fit
from optics.fit.scene_model import SceneModel
from optics.fit.tempering import temperature, tempered, weight_of
from optics.scene.parameter import Values, Variable
from optics.study.cells import Cells
from optics.study.shown import cell_of

Progress = Callable[[str, int, int], None]

# Iterations and tolerances (chi2 per variable) of the stages: the first two only bring the last one close.
COMMON: dict[str, Any] = {"max_iterations": 12, "tolerance": 20.0}
POSES: dict[str, Any] = {"max_iterations": 6, "tolerance": 2.0}
TOGETHER = 0.05  # chi2 per variable: a twentieth of what noise alone makes of each
SETTLING = 2  # fits after which weights that follow the slopes of readings change little
UNSETTLED, STILL = 12, 0.3  # such fits at most; standard deviations by which the last one may move off its weights
COOLINGS, COOLER = 4, 1.5  # fits at most, each with priors that count less than a part of those before
SAME = 2e-4  # of the excess of chi2 of images: fits from different starts end within a thousandth of each other
OFF = 0.1  # plausible sizes off neutral from which an effect is followed


def fit_base(
    model: SceneModel,
    variables: Sequence[Variable],
    fitted: Sequence[int],
    start: Values,
    progress: Progress | None = None,
    tolerance: float = TOGETHER,
    robust: bool = False,
    negligible: float | None = None,
    tempering: bool = False,
) -> Fit:
    """Calibrate in three stages: what all frames share, then the poses of one press at a time, then everything
    together.

    tempering   of images: priors count as much more as the model misses them by more than noise, first at the start
                values, then where each stage ends (optics.fit.tempering)"""
    tempering = tempering and model.captures.table is None

    def weighed(variables: Sequence[Variable], values: Values) -> list[Variable]:
        return tempered(variables, temperature(model, values, fitted, dof)) if tempering else list(variables)

    def enough(tolerance: float) -> float:
        """The fall of chi2 per variable that ends a stage; of a wrong model as much as its misfit allows."""
        return max(tolerance, TOGETHER * weight_of(variables)) if tempering else tolerance

    dof = sum(int(model.usable(i).sum()) for i in fitted) - len(variables)
    variables = weighed(variables, start)
    if model.dialled:
        model.weighed_at = start.copy()
    begun = np.array([value_of(model, start, v) for v in variables])  # where the first stage starts
    common = [v for v in variables if v.frames is None]
    if len(common) < len(variables):
        values = start
        if common:
            stage = {**COMMON, "tolerance": enough(COMMON["tolerance"])}
            values = calibrate.fit_over_starts(
                model, common, start, fitted, **stage, robust=robust, progress=progress
            ).values
        start = values.copy()
        variables = weighed(variables, start)
        groups: dict[tuple[int, ...], list[Variable]] = {}
        for v in variables:
            if v.frames is not None:
                groups.setdefault(v.frames, []).append(v)
        for frames, own in groups.items():
            stage = {**POSES, "tolerance": enough(POSES["tolerance"])}
            found = calibrate.fit(model, own, values, frames, **stage, robust=robust, progress=progress)
            for index in frames:
                start.frame.setdefault(index, {}).update(found.values.frame[index])
        variables = weighed(variables, start)
    found = calibrate.fit_over_starts(
        model,
        variables,
        start,
        fitted,
        tolerance=tolerance,
        negligible=SAME if tempering and negligible is None else negligible,
        robust=robust,
        progress=progress,
    )
    if tempering:
        found = cooled(model, found, robust, progress)
    if model.captures.table is None:
        found = lowest(model, found, robust, progress, cooling=tempering)
    found = settled(model, found, robust, progress, tolerance)
    found.start = begun
    return found


def fit_from_cells(
    model: SceneModel,
    coarser: Sequence[tuple[SceneModel, Cells]],
    variables: Callable[[SceneModel], list[Variable]],
    fitted: Sequence[int],
    start: Values,
    progress: Progress | None = None,
    robust: bool = False,
) -> Fit:
    """`fit_base` of large images: its three stages in the first of some models in cells, then everything together in
    one after the other, and in pixels.

    coarser     (model, its cells), the largest first; variables: those of a model, alike in all
    start       in pixels

    What is far off moves in a small part of the time, and over hills of chi2 that fine detail makes."""
    values, begun = start, np.array([value_of(model, start, v) for v in variables(model)])
    for k, (one, cells) in enumerate(coarser):
        own = cells.values_into(values)
        with one.where_used():
            found = (
                fit_base(one, variables(one), fitted, own, progress, robust=robust, tempering=True)
                if k == 0
                else _together(one, variables(one), fitted, own, progress, robust)
            )
        values = cells.values_back(found.values)
    found = _together(model, variables(model), fitted, values, progress, robust)
    found.start = begun
    return found


def _together(
    model: SceneModel,
    variables: Sequence[Variable],
    fitted: Sequence[int],
    start: Values,
    progress: Progress | None,
    robust: bool,
) -> Fit:
    """Everything calibrated together from values that are close, with priors that count as the misfit asks."""
    dof = sum(int(model.usable(i).sum()) for i in fitted) - len(variables)
    weighed = tempered(variables, temperature(model, start, fitted, dof))
    options: dict[str, Any] = {"tolerance": TOGETHER, "negligible": SAME, "robust": robust, "progress": progress}
    found = cooled(model, calibrate.fit(model, weighed, start, fitted, **options), robust, progress)
    return lowest(model, found, robust, progress)


def settled(
    model: SceneModel, found: Fit, robust: bool = False, progress: Progress | None = None, tolerance: float = TOGETHER
) -> Fit:
    """A fit calibrated again with the errors of settings weighed at its own values; the fit itself where no reading has
    such an error."""
    if not model.dialled:
        return found
    for turn in range(UNSETTLED):
        # one that a bad model throws from one side of an extinction to the other is taken halfway
        at = found.values.copy()
        if turn >= SETTLING and model.weighed_at is not None:
            for v in found.variables:
                at.put(v, (value_of(model, at, v) + value_of(model, model.weighed_at, v)) / 2)
        model.weighed_at = at
        found = calibrate.fit(
            model, found.variables, found.values, found.frames, tolerance=tolerance, robust=robust, progress=progress
        )
        moved = [abs(e - value_of(model, at, v)) for v, e in zip(found.variables, found.estimate)]
        if turn + 1 >= SETTLING and not any(m > STILL * sd for m, sd in zip(moved, found.sd)):
            break
    return found


def cooled(model: SceneModel, found: Fit, robust: bool = False, progress: Progress | None = None) -> Fit:
    """A fit of images calibrated again with priors that count as its own misfit asks, while that is less."""
    for _ in range(COOLINGS):
        now = weight_of(found.variables)
        weight = temperature(model, found.values, found.frames, found.dof)
        if weight > now / COOLER and not weight == 1 < now:
            break
        found = calibrate.fit(
            model,
            tempered(found.variables, weight),
            found.values,
            found.frames,
            tolerance=TOGETHER,
            negligible=SAME,
            robust=robust,
            progress=progress,
        )
    return found


def lowest(
    model: SceneModel, found: Fit, robust: bool = False, progress: Progress | None = None, cooling: bool = True
) -> Fit:
    """A fit of images, or the lower one from where single frames have a lower minimum.

    cooling   whether priors may count less there; not in a refit, which is held against others with the same priors"""

    def follow(values: Values) -> Fit:
        again = calibrate.fit(
            model,
            found.variables,
            values,
            found.frames,
            tolerance=TOGETHER,
            negligible=SAME,
            robust=robust,
            progress=progress,
        )
        return cooled(model, again, robust, progress) if cooling else again

    return over_branches(model, found, follow)


def off_neutral(model: SceneModel, values: Values, variables: Sequence[Variable]) -> Values:
    """Values with variables a tenth of their plausible size off: at a bound a one-sided onset has no slope to
    follow."""
    moved = values.copy()
    for v in variables:
        moved.put(v, value_of(model, moved, v) + OFF * v.parameter.plausible)
    return moved


def held_out_values(model: SceneModel, found: Fit, held: Sequence[int]) -> tuple[Values, int]:
    """Values for all frames, and the number of variables fitted for it: on held-out frames only those with a value per
    frame or group are fitted."""
    own = calibrate.for_frames(model, found.variables, held)
    if not own:
        return found.values, 0

    def follow(values: Values) -> Fit:
        return calibrate.fit(model, own, values, held)

    return over_branches(model, follow(found.values), follow).values, len(own)


def comparison_of(
    model: SceneModel, values: Values, held: Sequence[int] = (), parameters: int = 0, held_parameters: int = 0
) -> Comparison:
    """All frames, measured against predicted; `parameters` were fitted to the frames that are not held out,
    `held_parameters` to the held-out ones."""
    predicted = model.predict(values)
    return compare(
        [f.image for f in model.frames],
        predicted,
        [np.sqrt(model.variance(values, i, p)) for i, p in enumerate(predicted)],
        [model.usable(i) for i in range(len(model.frames))],
        [model.coordinates(values, i) for i in range(len(model.frames))],
        [f.parameters for f in model.frames],
        [group_of(f) for f in model.frames],
        names=[f.name for f in model.frames],
        full_scale=model.noise.saturation - model.noise.black_level,
        black_level=model.noise.black_level,
        held_out=held,
        parameters=parameters,
        held_out_parameters=held_parameters,
        cell=cell_of(model),
    )


def null_models(model: SceneModel, values: Values, fitted: Sequence[int], held: Sequence[int]) -> dict | None:
    """An imported set's model beside models without physics (optics.fit.null_models); None without held-out frames,
    backgrounds or labelled circles."""
    from optics.captures import importing
    from optics.fit import null_models as nulls

    if not held or any(model.flat_of(i) is None for i in (*fitted, *held)) or not importing.has_circles(model.captures):
        return None
    return nulls.compare(model, values, fitted, held, importing.circles_of(model.captures)).json()


def background_of(model: SceneModel, values: Values) -> dict | None:
    """The flat field's mode, and how much of the background the scene explains without it, per channel."""
    return None if model.flat_of(0) is None else {"mode": model.flat_field, "channels": model.background_share(values)}
