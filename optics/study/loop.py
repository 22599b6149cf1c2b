"""The loop: calibrate the base model, ask what is missing, add it, watch the held-out error fall; step by step on disk.

    record, model, fit = begin(setup, folder)                         base model, calibrated without the held-out frames
    diagnosis = examine(record, model, setup, fit)                    what does it lack?
    fit, comparison = extend(record, model, setup, fit, effect)       free that effect, calibrate everything again
    ... until the verdict is NOTHING, or UNKNOWN

Each step is a folder of the study (optics.study.record), from which another process can continue. Scripts use
`optics.Study`, which calls these verbs and keeps their results together."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from optics.captures import capture_set as capture_files
from optics.captures import identity
from optics.diagnosis.dials import Width, unstated, width_of
from optics.diagnosis.dials_at_extinction import at_extinction, width_of_angles
from optics.diagnosis.refit import Expected
from optics.diagnosis.result import Diagnosis, Row
from optics.diagnosis.score import SETTLED
from optics.errors import BadCapture, Underdetermined, UnknownKey
from optics.files.output import file_hash
from optics.fit import calibrate
from optics.fit.compare import Comparison
from optics.fit.model import values_in
from optics.fit.result import Fit
from optics.fit.scene_model import SceneModel
from optics.fit.tempering import tempered, weight_of
from optics.scene import trust
from optics.scene.declare import Effect
from optics.scene.parameter import Values, Variable
from optics.scene.registry import Registry
from optics.scene.trust import Named
from optics.study import checks, places
from optics.study.calibrated import origin_of
from optics.study.cells import Cells, cells_for, coarser_models, open_in_cells
from optics.study.record import Record
from optics.study.refits import Refits
from optics.study.setup import (
    Setup,
    check_priors,
    effect_variables,
    open_model,
    recorded,
    split,
    steady,
    variables_of_base,
)
from optics.study.shown import fingerprints_of, mosaic_of, shown_frames
from optics.study.stages import (
    SAME,
    TOGETHER,
    Progress,
    background_of,
    comparison_of,
    cooled,
    fit_base,
    fit_from_cells,
    held_out_values,
    lowest,
    null_models,
    off_neutral,
    settled,
)
from optics.words import key_of

AGAIN, FURTHER = 6, 30  # iterations of a restored fit: one that had converged only needs its derivatives again


# -- begin, and continue ---------------------------------------------------------------------------------------------
def begin(
    setup: Setup,
    folder: str | Path,
    *,
    title: str = "",
    command: Sequence[str] = (),
    resume: bool = False,
    progress: Progress | None = None,
) -> tuple[Record, SceneModel, Fit]:
    """Start a study: calibrate the base model and record it as the first step.

    Where nothing states how well dials were set, their errors are found from the readings first; the study takes them
    as if they had been stated."""
    model = open_model(setup)
    check_priors(model, setup)
    model.scene.check(setup.values, "start values")
    doubts = checks.of_dials(unstated(model), width := _dial_error(model, setup))
    if width is not None:
        setup = replace(setup, uncertainty=dict.fromkeys(unstated(model), width.stated))
        model = open_model(setup)
    fitted, held = split(model, setup)
    variables = variables_of_base(model, setup, fitted)
    usable = [model.usable(i) for i in range(len(model.frames))]
    record = Record.create(
        folder,
        scene=str(model.captures.scene),
        captures=str(setup.captures),
        inputs=places.inputs_of(model),
        near={"captures": os.path.relpath(setup.captures, os.path.abspath(folder))},
        seed=setup.seed,
        command=command,
        title=title,
        noise=asdict(model.noise),
        warnings=[*doubts, *checks.before_calibration(model, setup, held)],
        resume=resume,
        facts={
            "frames": len(model.frames),
            "fitted": len(fitted),
            "held_out": len(held),
            "image": list(model.shape),
            **mosaic_of(model),
            "masked": 1 - float(sum(u.sum() for u in usable)) / values_in(model, range(len(usable))),
            "setup": asdict(setup),
        },
        prints=identity.sketch_of(model.captures),
    )
    trust.remember(model.scene.registry.own_files)  # named, or agreed to: the study goes on with them
    if record.steps:
        return record, model, restore(record, model)
    clock = time.perf_counter()
    with record.alone():
        try:
            start, robust = Values(dict(setup.values)), setup.robust
            checks.require_light(model, start, variables, fitted)
            coarser = coarser_models(model, setup, fitted, variables)
            with model.where_used():
                if coarser:
                    own = partial(variables_of_base, setup=setup, frames=fitted)
                    found = fit_from_cells(model, coarser, own, fitted, start, progress, robust)
                else:
                    found = fit_base(model, variables, fitted, start, progress, robust=robust, tempering=True)
            write_step(record, model, None, found, held, time.perf_counter() - clock)
        except BaseException:
            record.discard()
            raise
    return record, model, found


def _dial_error(model: SceneModel, setup: Setup) -> Width | None:
    """The error of dials that the captures do not state, by a first calibration; None where readings show none."""
    if setup.uncertainty is not None or not unstated(model):
        return None
    # of the noise, held-out readings tell too: of few settings each is needed
    frames = list(range(len(model.frames))) if model.captures.table is not None else split(model, setup)[0]
    found = fit_base(model, variables_of_base(model, setup, frames), frames, Values(dict(setup.values)))
    keys, values = unstated(model), Values(dict(setup.values))
    if model.captures.table is None and at_extinction(model, found.values, keys, frames):

        def calibrated(width: float) -> Fit:
            free = open_model(own := replace(setup, uncertainty=dict.fromkeys(keys, width)))
            return fit_base(free, variables_of_base(free, own, frames), frames, values, tempering=True)

        return width_of_angles(calibrated)
    tested = candidates(model, None)
    seek(model, found.values, tested, frames)
    try:
        return width_of(model, found, tested, lambda e: effect_variables(model, e), frames, setup.seed)
    except Underdetermined:  # a diagnosis will say why
        return None


def take_up(
    folder: str | Path, plugins: Named = None, captures: str | Path | None = None
) -> tuple[Record, SceneModel, Setup]:
    """The record, model and setup of an existing study, wherever it and its inputs lie. Raises BadCapture where an
    input is gone or has changed since it began.

    plugins    folders or files that are known besides those that the study was made with; None: those that are found
               with it. What is not named must be trusted (optics.scene.trust)
    captures   where its captures are, if they are not found"""
    record = Record.open(folder)
    setup = recorded(record.ladder["facts"]["setup"])
    found = places.captures_of(record.folder, record.ladder, setup, captures)
    scene = places.scene_named(found)
    around = places.plugin_places(record.folder, setup, found, scene)
    own = [*around, *(trust.named(plugins) or ())]
    changed = places.changed(
        record.ladder, setup, found, scene, [file for place in own for file in trust.plugin_files(place)]
    )
    if changed:
        raise BadCapture(
            f"{folder}: changed since the study began: {', '.join(changed[:5])}{' ...' if len(changed) > 5 else ''} "
            f"(captures: {found}); start a new study"
        )
    code = places.code_of(record.folder, record.ladder, setup, around, plugins)
    if code or plugins is not None:
        setup = replace(setup, plugins=[str(file) for file in code])
    setup = replace(setup, captures=str(found))
    return record, open_model(setup, code=code), setup


def kept(record: Record, model: SceneModel, index: int = -1) -> tuple[list[Variable], Values, list[int]]:
    """What a step's folder holds of its fit: the variables, the values, and the frames that were fitted."""
    setup = recorded(record.ladder["facts"]["setup"])
    fitted, _ = split(model, setup)
    index %= len(record.steps)
    data = record.fit(index)
    names = {f.name: i for i, f in enumerate(model.frames)}
    values = Values(dict(data["parameters"]), {names[n]: dict(own) for n, own in data["frames"].items()})
    variables = _variables(model, setup, fitted, record.added(index))
    return tempered(variables, record.steps[index].get("tempering", 1.0)), values, fitted


def _variables(model: SceneModel, setup: Setup, fitted: Sequence[int], added: Sequence[str]) -> list[Variable]:
    """What is solved for in a model to which effects were added, by their keys."""
    variables = variables_of_base(model, setup, fitted)
    for key in added:
        effect = model.scene.registry.find_effect(key)
        variables += _of_fitted(effect_variables(model, effect, variables), fitted)
    return variables


def restore(record: Record, model: SceneModel, index: int = -1) -> Fit:
    """The fit of a step, from its folder: the same variables and values, with derivatives and errors computed anew."""
    variables, values, fitted = kept(record, model, index)
    most = AGAIN if record.steps[index]["converged"] else FURTHER
    if model.dialled:
        model.weighed_at = values.copy()
    enough = TOGETHER * weight_of(variables)
    with model.where_used():
        found = calibrate.fit(model, variables, values, fitted, max_iterations=most, tolerance=enough)
        if record.steps[index]["converged"] and not found.converged:  # on another machine, the last digits differ
            found = calibrate.fit(model, variables, found.values, fitted, max_iterations=FURTHER, tolerance=enough)
    return found


def _of_fitted(variables: Sequence[Variable], fitted: Sequence[int]) -> list[Variable]:
    """The variables that hold in fitted frames only, or in all."""
    return [v for v in variables if v.frames is None or set(v.frames) <= set(fitted)]


# -- what can be added -----------------------------------------------------------------------------------------------
def effects_of(record: Record | None, registry: Registry) -> list[Effect]:
    """The effects in the model of the last step, of the registry of its scene; none before the study begins."""
    return [] if record is None else [registry.find_effect(key) for key in record.added()]


def candidates(model: SceneModel, record: Record | None, without: Sequence[str] = ()) -> list[Effect]:
    """Every effect that the scene can express, the study has not added, and nothing rules out (`excluded`)."""
    left_out = excluded(model, record, without)
    return [e for e in _expressible(model, record) if e.name not in left_out]


def excluded(model: SceneModel, record: Record | None, without: Sequence[str] = ()) -> dict[str, str]:
    """Effects that could be tested but for what the captures state, or `without` names: {name: reason}.

    absent       every part that could carry the effect, or that it requires, is not there
    unseen       whatever its strength, the frames would be the same: a film is out of the beam, a dial never turned
    [exclude]    the reason is the user's
    a setting    that is stated with one value in every frame and without an uncertainty rules out what would vary it
                 from frame to frame
    drafted      a draft was drawn from these captures, or from some of them (optics.captures.identity)
    Raises UnknownKey for an unknown effect in `without`."""
    registry, captures = model.scene.registry, model.captures
    dropped = {registry.find_effect(name).key for name in without}
    ruled_out = {key_of(name): reason for name, reason in captures.exclude.items()}
    stated = steady(model)
    drawn = _drawn_from(model, _expressible(model, record))
    found = {}
    for effect in _expressible(model, record):
        if effect.key in ruled_out:
            found[effect.name] = f"excluded: {ruled_out[effect.key]}"
        elif effect.key in dropped:
            found[effect.name] = "left out on request"
        elif missing := _missing(model, effect):
            found[effect.name] = f"absent: {', '.join(missing)}"
        elif effect.key in drawn:
            found[effect.name] = "drafted from these captures: it fits them by construction; test it on others"
        else:
            keys = [key for keys in model.scene.keys_of(effect).values() for key in keys]
            fixed = [key for key in keys if key in stated] if effect.scope == "frame" else []
            if fixed and (effect.per == "kind" or len(fixed) == len(keys)):
                found[effect.name] = f"stated: {fixed[0]} = {stated[fixed[0]]:g} in every frame"
            elif not effect_variables(model, effect):
                found[effect.name] = f"no frame can show it; it needs {effect.needs}"
    return found


def _drawn_from(model: SceneModel, effects: Sequence[Effect]) -> set[str]:
    """The keys of effects that were drafted from the captures of the model, or from some of them."""
    drafts = [e for e in effects if e.drafted_from]
    if not drafts:
        return set()
    prints, table = identity.prints_of(model.captures), model.captures.table is not None
    return {e.key for e in drafts if identity.shared(e.drafted_from.split(), prints, table)}


def _expressible(model: SceneModel, record: Record | None) -> list[Effect]:
    """Every effect that the scene can express and the study has not added."""
    done = {e.key for e in effects_of(record, model.scene.registry)}
    return [
        e
        for k, e in sorted(model.scene.registry.effects.items())
        if k not in done and model.scene.can_express(e) and not (e.mixes_pixels and model.captures.table is not None)
    ]


def _missing(model: SceneModel, effect: Effect) -> list[str]:
    """The absent parts that an effect cannot do without; empty where others carry it."""
    absent = model.captures.absent
    for keys in model.scene.keys_of(effect).values():
        holders = {key.rpartition(".")[0] for key in keys}
        if holders and holders <= set(absent):
            return sorted(holders)
    for kind in effect.requires:
        holders = {name for name, part in model.scene.parts.items() if kind in (part.kind, part.role)}
        if holders and holders <= set(absent):
            return sorted(holders)
    return []


def seek(model: SceneModel, values: Values, effects: Sequence[Effect], frames: Sequence[int]) -> None:
    """Set, in the values, the place of effects that have one (an unfilled cell), as their residual suggests."""
    for effect in effects:
        if effect.seek is not None:
            values.common.update(model.scene.check(effect.seek(model, values, frames), effect.name))


# -- diagnose --------------------------------------------------------------------------------------------------------
def examine(
    record: Record,
    model: SceneModel,
    setup: Setup,
    found: Fit,
    progress: Progress | None = None,
    advised: bool = True,
    without: Sequence[str] = (),
    ranked: Callable[[list[Row]], None] | None = None,
    cells: Cells | None = None,
) -> Diagnosis:
    """Diagnose the last step, and add the diagnosis with the best effects' fingerprints to its folder. The ranking by
    score is there before anything is refitted.

    without     effects that are not tested
    ranked      called with the rows of that ranking
    advised     where effects tie, also advise what to measure next, which renders frames that nobody has taken yet
    cells       in which the model is; None: in pixels. What is recorded is in pixels

    Raises OutputExists where another process works on the study.
    """
    with record.alone(), model.where_used():
        return _examined(record, model, setup, found, progress, advised, without, ranked, cells)


def _examined(
    record: Record,
    model: SceneModel,
    setup: Setup,
    found: Fit,
    progress: Progress | None,
    advised: bool,
    without: Sequence[str],
    ranked: Callable[[list[Row]], None] | None,
    cells: Cells | None,
) -> Diagnosis:
    from optics.diagnosis.advice import advise
    from optics.diagnosis.diagnose import diagnose
    from optics.diagnosis.remarks import USUALLY

    fitted, held = split(model, setup)
    tested, ruled_out = candidates(model, record, without), excluded(model, record, without)
    seek(model, found.values, tested, fitted)

    refits = Refits(model, setup, found, tested, record.refits(len(record.steps) - 1))

    def keep(rows: list[Row]) -> None:
        record.put_ranking(len(record.steps) - 1, rows)
        if ranked:
            ranked(rows)

    result = diagnose(
        model,
        found,
        tested,
        lambda e: effect_variables(model, e),
        held,
        fitted=fitted,
        refit=refits.of,
        foresee=refits.foresee,
        cooler=refits.cooler,
        negligible=refits.coarse,
        seed=setup.seed,
        progress=progress,
        ranked=keep,
        added=effects_of(record, model.scene.registry),
        excluded=ruled_out,
        expected=_expected(record, model, cells),
    )
    result.advice = advise(model, result, _freed_as_in(model, found.variables), setup.seed, progress) if advised else []
    if cells is not None:
        result.fits = {name: replace(fit, values=cells.values_back(fit.values)) for name, fit in result.fits.items()}
        for e in result.explanations:
            if e.values:
                e.values = cells.values_back(Values.of_record(e.values)).record()
        result.warnings.append(
            f"images of {cells.width} x {cells.height} px were diagnosed in cells of {cells.k} x {cells.k} px; each "
            "cell counts as one pixel of this diagnosis. Finer structure, such as a blur or the rim of a shadow, shows "
            "less"
        )
    if result.advice:
        result.hints = [hint for hint in result.hints if hint != USUALLY]
    worst = int(np.argmax(np.array(found.frame_chi2) / np.maximum(found.frame_n, 1)))
    record.put_diagnosis(len(record.steps) - 1, result, fingerprints_of(model, found, result, found.frames[worst]))
    return result


def examine_in_cells(
    record: Record,
    model: SceneModel,
    setup: Setup,
    cells: Cells,
    progress: Progress | None = None,
    advised: bool = True,
    without: Sequence[str] = (),
    ranked: Callable[[list[Row]], None] | None = None,
) -> Diagnosis:
    """`examine` of large images, in cells of k x k pixels; the values of its refits are in pixels again."""
    coarse, own = open_in_cells(setup, cells)
    variables, values, fitted = kept(record, coarse)
    start = cells.values_into(values)
    # a diagnosis calls a base settled that promises less than SETTLED of its excess; four times as well leaves room
    enough = SETTLED / 4
    with coarse.where_used():
        found = calibrate.fit(
            coarse, variables, start, fitted, max_iterations=FURTHER, negligible=enough, progress=progress
        )
    return examine(record, coarse, own, found, progress, advised, without, ranked, cells)


def _expected(record: Record, model: SceneModel, cells: Cells | None) -> list[Expected]:
    """What the diagnosis of the step before found beside the effect that this step added."""
    earlier = record.diagnosis(len(record.steps) - 2) if len(record.steps) > 1 else None
    if earlier is None or not record.steps[-1]["effect"] or record.steps[-1].get("dropped"):
        return []
    added = model.scene.registry.find_effect(record.steps[-1]["effect"]).name
    found = []
    for e in earlier.get("explanations", ()):
        if e.get("values") and added in e["effects"]:
            values = Values.of_record(e["values"])
            others = frozenset(e["effects"]) - {added}
            found.append(Expected(others, values if cells is None else cells.values_into(values)))
    return found


def cells_of(record: Record, model: SceneModel) -> Cells | None:
    """The cells in which the last step is diagnosed; None: in pixels, as where somebody's own effect may count them."""
    own = {str(file) for file in model.scene.registry.own_files}
    tested = [*candidates(model, record), *effects_of(record, model.scene.registry)]
    if any(str(Path(e.file).resolve()) in own and {"lens", "sensor"} & set(e.stages) for e in tested):
        return None
    variables, _, fitted = kept(record, model)
    return cells_for(model, fitted, variables)


def _freed_as_in(model: SceneModel, held: Sequence[Variable]) -> Callable[[Any, Effect], list[Variable]]:
    """f(imagined, effect): what adding an effect frees in a model with further frames: what it frees in this one, and
    the values of those frames alone. A film that only a further frame puts into the beam is not asked for yet."""

    def freed(imagined: Any, effect: Effect) -> list[Variable]:
        present = {v.name for v in effect_variables(model, effect, held)}
        return [v for v in effect_variables(imagined, effect, held) if v.frames is not None or v.name in present]

    return freed


def _without(
    record: Record, model: SceneModel, setup: Setup, found: Fit, dropped: Sequence[Effect], fitted: Sequence[int]
) -> tuple[list[Variable], list[Variable]]:
    """The variables of a model without effects that were added before, and those that it loses.

    Raises ValueError for an effect of which nothing would go, as another one has its parameters too."""
    gone = {e.key for e in dropped}
    staying = _variables(model, setup, fitted, [key for key in record.added() if key not in gone])
    names = {v.name for v in staying}
    leaving = [v for v in found.variables if v.name not in names]
    for effect in dropped:
        own = {v.name for v in effect_variables(model, effect)}
        if not any(v.name in own for v in leaving):
            raise ValueError(
                f"{record.folder}: dropping '{effect.name}' would change nothing: what it frees belongs to the rest of "
                "the model as well; drop that too, or start another study"
            )
    return staying, leaving


# -- add -------------------------------------------------------------------------------------------------------------
def extend(
    record: Record,
    model: SceneModel,
    setup: Setup,
    found: Fit,
    effect: Effect,
    start: Values | None = None,
    progress: Progress | None = None,
    dropped: Sequence[Effect] = (),
) -> tuple[Fit, Comparison]:
    """Free an effect, calibrate everything again, and record the step.

    start     values to begin from, such as those of a diagnosis's refit; None: the present ones, with the effect a
              little off neutral
    dropped   effects that were added before, and are not in the model from here on

    Raises OutputExists where another process works on the study, or has added a step since it was opened.
    """
    with record.alone():
        return _extended(record, model, setup, found, effect, start, progress, dropped)


def _extended(
    record: Record,
    model: SceneModel,
    setup: Setup,
    found: Fit,
    effect: Effect,
    start: Values | None,
    progress: Progress | None,
    dropped: Sequence[Effect],
) -> tuple[Fit, Comparison]:
    fitted, held = split(model, setup)
    if not model.scene.can_express(effect):
        missing = [n for n, keys in model.scene.keys_of(effect).items() if not keys]
        raise UnknownKey(
            effect.part,
            [p.kind for p in model.scene.parts.values()],
            "part of the scene",
            str(model.scene.path),
            f"the effect '{effect.name}' needs it for {', '.join(missing)}",
        )
    if gone := _missing(model, effect):
        raise BadCapture(
            f"{model.captures.folder / capture_files.FILE}: absent: {', '.join(gone)}, which the effect "
            f"'{effect.name}' needs; allowed: effects of parts that are there, or a new study of captures without it"
        )
    staying, values = list(found.variables), found.values
    if dropped:
        staying, leaving = _without(record, model, setup, found, dropped, fitted)
        values = values.without(leaving, setup.values)
        start = None if start is None else start.without(leaving, setup.values)
    extra = _of_fitted(effect_variables(model, effect, staying), fitted)
    if not extra:
        why = "no frame can show it" if not effect_variables(model, effect) else "the model solves for all of it"
        raise Underdetermined(
            f"{record.folder}: adding '{effect.name}' would change nothing: {why}; it needs {effect.needs or 'more'}"
        )
    variables = tempered([*staying, *extra], weight_of(found.variables))
    if start is None:
        seek(model, values, [effect], fitted)
        start = off_neutral(model, values, extra)
    clock = time.perf_counter()
    images = model.captures.table is None
    with model.where_used():
        best = calibrate.fit_over_starts(
            model,
            variables,
            start,
            fitted,
            tolerance=TOGETHER,
            negligible=SAME if images else None,
            robust=setup.robust,
            progress=progress,
            over=[v.name for v in extra],
        )
        if images:
            best = lowest(model, cooled(model, best, setup.robust, progress), setup.robust, progress)
        best = settled(model, best, setup.robust, progress)
    if effect.file:  # a draft is written after the study began
        own = places.own_plugins(model.scene.registry)
        file = Path(effect.file).resolve()
        digest = file_hash(file)
        record.note_inputs({name: h for name, h in own.items() if h == digest})
    comparison = write_step(record, model, effect, best, held, time.perf_counter() - clock, dropped)
    before, after = (step["held_out"]["chi2_per_dof"] if step["held_out"] else math.nan for step in record.steps[-2:])
    if after > before and dropped:
        best.warnings.append(
            f"held-out chi2/dof rises from {before:.4g} to {after:.4g} with {effect.name} in place of "
            f"{' and '.join(e.name for e in dropped)}: what was dropped predicts the held-out frames better"
        )
    elif after > before:
        best.warnings.append(
            f"held-out chi2/dof rises from {before:.4g} to {after:.4g} with {effect.name}: it does not predict the "
            "held-out frames, so it is not the cause, or not the only one"
        )
    return best, comparison


def write_step(
    record: Record,
    model: SceneModel,
    effect: Effect | None,
    found: Fit,
    held: Sequence[int],
    seconds: float,
    dropped: Sequence[Effect] = (),
) -> Comparison:
    """Record a calibrated model as the next step of the study, the base without an effect; returns how it compares with
    all frames."""
    with model.where_used():
        values, extra = held_out_values(model, found, held)
    comparison = comparison_of(model, values, held, len(found.variables), extra)
    found.warnings += checks.after_calibration(model, found, comparison.fitted)
    # A study that was taken up again brings the held-out poses of the step before: those found now replace them.
    everywhere = Values(dict(found.values.common), {**found.values.frame, **values.frame})
    name = effect.name if effect else "base"
    record.add_step(
        f"{name} without {' and '.join(e.name for e in dropped)}" if dropped else name,
        effect.key if effect else None,
        Fit(**{**found.__dict__, "values": everywhere}),
        comparison,
        frames=shown_frames(model, everywhere, held),
        seconds=seconds,
        nulls=null_models(model, values, found.frames, held),
        background=background_of(model, values),
        origin=origin_of(model, held, len(found.variables), extra),
        dropped=[e.key for e in dropped],
    )
    return comparison
