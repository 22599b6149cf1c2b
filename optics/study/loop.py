"""The loop: calibrate the base model, ask what is missing, add it, watch the held-out error fall; step by step on disk.

    study = begin(setup, folder)            base model, calibrated on the frames that are not held out
    diagnosis = examine(study)              what does it lack?
    extend(study, "lens vignetting")        free that effect, calibrate everything again
    ... until the verdict is NOTHING, or UNKNOWN

Every step is a folder of the study (optics.study.record), and each can be taken up again by another process from that
folder."""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from optics.captures import capture_set as capture_files
from optics.diagnosis.verdict import AT_FAULT, FAR
from optics.errors import BadCapture, Underdetermined, UnknownKey
from optics.fit import calibrate
from optics.fit.compare import Comparison, Row, compare
from optics.fit.model import Model
from optics.scene import loader as scenes
from optics.scene.declare import Effect
from optics.scene.parameter import Values, Variable
from optics.scene.registry import Registry
from optics.study import record as ladder
from optics.study.record import Study
from optics.words import some, spaced

Progress = Callable[[str, int, int], None]

POSE = ("press_x", "press_y", "press_depth")  # what is solved for per press, unless the user says otherwise
POSE_SD = 0.05  # mm: how well a stage usually knows it
# of the noise: error of a prediction that is followed by Monte Carlo, below which it adds less than 5 % to the noise
CHANCE = 0.3
ASPECT = 0.02  # by which the sides of images may be in another ratio than the scene's
GROUPS = 4  # of frames, from which on one in so many is held out
GAUGE = 10.0  # plausible sizes: how far what no data hold may be from the scene's value


@dataclass
class Setup:
    """What a study starts from; kept in its record, so that any process can go on with it.

    captures    folder of the capture set
    defines     -D of the scene; the image size is added where the scene names width and height
    free        key patterns that are solved for in all frames; empty: every LED (position, axis, lobe, power), every
                membrane (rho, sigma), every source (power)
    per_group   key patterns with a value per group of frames; None: the press, where groups are given
    priors      pattern -> (mean or None for the present value, standard deviation)
    held_out    names of groups that the calibration does not see; None: one in four, evenly spread
    values      start values, by key;   flat_field  how a background image enters, see `optics.fit.model.Model`
    robust      residuals beyond three sigmas count less (Huber), as dirt and glints ask for; a diagnosis weighs all
                alike
    """

    captures: str
    defines: dict[str, str] = field(default_factory=dict)
    plugins: str | None = None
    free: list[str] = field(default_factory=list)
    per_group: list[str] | None = None
    priors: dict[str, tuple[float | None, float]] = field(default_factory=dict)
    held_out: list[str] | None = None
    values: dict[str, float] = field(default_factory=dict)
    flat_field: str | None = None
    robust: bool = False
    seed: int = 0


def setup_for(captures: str | Path, **given) -> Setup:
    """A setup of what is given (None and empty: not given); an imported set says the rest by itself, in import.json.

    Where `free` or `per_group` are given, the advised priors, which belong to other parameters, are left out.
    """
    note = Path(captures) / "import.json"
    advised = json.loads(note.read_text(encoding="utf-8")).get("setup", {}) if note.is_file() else {}
    own = {name: value for name, value in given.items() if value or (value == [] and name in ("per_group", "held_out"))}
    if {"free", "per_group"} & set(own):
        advised = {name: value for name, value in advised.items() if name == "flat_field"}
    setup = Setup(captures=str(captures), **{**advised, **own})
    setup.priors = {pattern: tuple(prior) for pattern, prior in setup.priors.items()}
    return setup


def plugins_of(setup: Setup) -> Path:
    """The folder of plugins that belongs to a setup, whether it is there or not: the one that was named, or the one
    beside the captures."""
    return Path(setup.plugins) if setup.plugins else Path(setup.captures) / "plugins"


def open_model(setup: Setup, model_class: type = Model) -> Model:
    """Captures and scene of a setup as a model; raises before anything is rendered when they contradict each other."""
    found = capture_files.load(setup.captures)
    path = scenes.find(found.scene)
    defines = dict(setup.defines)
    height, width = found.frames[0].image.shape[:2]
    usual = dict(re.findall(r'<default name="(width|height)" value="(\d+)"', path.read_text(encoding="utf-8")))
    for name, size in (("width", width), ("height", height)):
        if name in usual:
            defines.setdefault(name, str(size))
    if (
        found.table is None
        and len(usual) == 2
        and abs(width * int(usual["height"]) / (height * int(usual["width"])) - 1) > ASPECT
    ):
        found.warnings.append(
            f"the images are {width} x {height} px, the scene's own are {usual['width']} x {usual['height']}: cut or turned "
            "images show another part of the sensor than the scene's camera; give them whole, row 0 at the top, or "
            "write x_fov and principal point of what is left into the scene"
        )
    plugins = plugins_of(setup)
    loaded = scenes.load(path, defines, plugins=plugins if setup.plugins or plugins.is_dir() else None)
    capture_files.check(found, loaded.parameters)
    noise = found.noise
    if noise is None:
        from optics.captures.noise import estimate

        noise = estimate(found)
    options = {} if setup.flat_field is None else {"flat_field": setup.flat_field}
    return model_class(loaded, found, noise, **options)


def split(model: Model, setup: Setup) -> tuple[list[int], list[int]]:
    """Indices of fitted and of held-out frames. Raises UnknownKey for a group that does not exist."""
    groups = capture_files.groups(model.captures)
    names = list(groups)
    held = setup.held_out
    if held is None:
        held = names[1::4] if len(names) >= GROUPS else []
    for name in held:
        if name not in groups:
            raise UnknownKey(name, names, "group of frames", setup.captures)
    out = sorted(i for name in held for i in groups[name])
    fitted = [i for i in range(len(model.frames)) if i not in set(out)]
    if not fitted:
        raise Underdetermined(f"{setup.captures}: every group is held out; leave some to calibrate on")
    return fitted, out


def default_free(model: Model) -> list[str]:
    """Every LED's position, axis, lobe and power, every membrane's reflectance and roughness, every source's power."""
    patterns = []
    spectral = len(model.scene.integrator.bands or (0,))
    for led in model.scene.leds:
        patterns += [f"{led}.{n}" for n in ("x", "y", "z", "pan", "tilt", "mu", "power")]
    for source in (n for n, part in model.scene.sources.items() if part.kind == "source"):
        patterns += [f"{source}.power"] if spectral == 1 else [f"{source}.power_{c}" for c in "rgb"[:spectral]]
    for membrane in model.scene.membranes:
        patterns += [f"{membrane}.rho_{c}" for c in "rgb"[:spectral]] + [f"{membrane}.sigma"]
    return patterns


def variables_of_base(model: Model, setup: Setup, frames: Sequence[int]) -> list[Variable]:
    """The base model's variables: free ones in all frames, and those of each group."""
    free = setup.free or default_free(model)
    priors = {k: tuple(v) for k, v in setup.priors.items()}
    if not setup.free:
        # the lambda term of S4: powers and reflectances are only determined together
        priors = {**{f"{led}.power": (None, 0.3) for led in model.scene.leds}, **priors}
    per_group = setup.per_group
    grouped = any(f.group for f in model.frames)
    if per_group is None:
        per_group = []
        if grouped and model.scene.gel is not None:
            per_group = [f"{model.scene.gel.name}.{n}" for n in POSE]
            priors = {**{f"{p}*": (None, POSE_SD) for p in per_group}, **priors}
    variables = calibrate.variables_from(model, free, per_group, None, frames)
    if setup.per_group is None:
        variables = [v for v in variables if v.frames is None or not _untouched(model, v.frames)]
    for pattern, prior in priors.items():
        variables = [_with_prior(model, v, pattern, prior) for v in variables]
    return variables


def _untouched(model: Model, frames: Sequence[int]) -> bool:
    """Whether frames say that nothing presses the gel: there is then no place of a press to solve for."""
    key = f"{model.scene.gel.name}.press_depth"
    return all(model.frames[i].parameters.get(key) == 0 for i in frames)


def _with_prior(model, variable: Variable, pattern: str, prior) -> Variable:
    if not (fnmatch(variable.keys[0], pattern) or fnmatch(variable.name, pattern)):
        return variable
    mean = calibrate.start_of(model, variable, Values()) if prior[0] is None else prior[0]
    return variable.with_prior(mean, prior[1])


def effects_of(study: Study, registry: Registry) -> list[Effect]:
    """The effects that the study has added so far, of the registry of its scene."""
    return [registry.find_effect(step["effect"]) for step in study.steps if step["effect"]]


def effect_variables(model: Model, effect: Effect) -> list[Variable]:
    """What adding an effect frees. Of several strengths a common part may show nowhere, such as the gain of all frames:
    where no data hold it, it stays where the scene has it, by a prior GAUGE times what is plausible, which data that do
    hold it outweigh."""
    found = model.scene.variables_of(effect, len(model.frames))
    return (
        [_with_prior(model, v, "*", (None, GAUGE * v.parameter.plausible)) for v in found] if len(found) > 1 else found
    )


def fit_base(
    model: Model,
    variables: Sequence[Variable],
    fitted: Sequence[int],
    start: Values,
    progress: Progress | None = None,
    tolerance: float = 0.05,
    robust: bool = False,
) -> calibrate.Fit:
    """Calibrate in three stages: what holds in all frames, then the poses, a press at a time, then everything
    together."""
    variables = list(variables)
    begun = np.array([calibrate.start_of(model, v, start) for v in variables])  # where the first stage starts
    common = [v for v in variables if v.frames is None]
    if len(common) < len(variables):
        values = start
        if common:
            values = calibrate.fit(
                model, common, start, fitted, max_iterations=12, tolerance=20.0, robust=robust, progress=progress
            ).values
        start = values.copy()
        groups: dict[tuple[int, ...], list[Variable]] = {}
        for v in variables:
            if v.frames is not None:
                groups.setdefault(v.frames, []).append(v)
        for frames, own in groups.items():
            found = calibrate.fit(
                model, own, values, frames, max_iterations=6, tolerance=2.0, robust=robust, progress=progress
            )
            for index in frames:
                start.frame.setdefault(index, {}).update(found.values.frame[index])
    found = calibrate.fit(model, variables, start, fitted, tolerance=tolerance, robust=robust, progress=progress)
    found.start = begun
    return found


def off_neutral(model: Model, values: Values, variables: Sequence[Variable]) -> Values:
    """Values with variables a tenth of their plausible size off: one-sided onsets have no slope to follow at a
    bound."""
    moved = values.copy()
    for v in variables:
        moved.put(v, calibrate.start_of(model, v, moved) + 0.1 * v.parameter.plausible)
    return moved


def held_out_values(model: Model, found: calibrate.Fit, held: Sequence[int]) -> tuple[Values, int]:
    """Values for all frames: on held-out ones only what is solved for per frame is fitted. And how many those are."""
    own = calibrate.for_frames(model, found.variables, held)
    return (calibrate.fit(model, own, found.values, held).values if own else found.values), len(own)


def comparison_of(
    model: Model, values: Values, held: Sequence[int], parameters: int, held_parameters: int
) -> Comparison:
    """All frames measured against predicted, by optics.fit.compare."""
    predicted = model.predict(values)
    return compare(
        [f.image for f in model.frames],
        predicted,
        [np.sqrt(model.variance(values, i, p)) for i, p in enumerate(predicted)],
        [model.usable(i) for i in range(len(model.frames))],
        [model.coordinates(values, i) for i in range(len(model.frames))],
        [f.parameters for f in model.frames],
        [f.group or f.name for f in model.frames],
        names=[f.name for f in model.frames],
        full_scale=model.noise.saturation - model.noise.black_level,
        black_level=model.noise.black_level,
        held_out=held,
        parameters=parameters,
        held_out_parameters=held_parameters,
    )


def begin(
    setup: Setup,
    folder: str | Path,
    *,
    title: str = "",
    command: Sequence[str] = (),
    resume: bool = False,
    progress: Progress | None = None,
) -> tuple[Study, Model, calibrate.Fit]:
    """Start a study: calibrate the base model and record it as the first step."""
    model = open_model(setup)
    fitted, held = split(model, setup)
    variables = variables_of_base(model, setup, fitted)
    everywhere = variables_of_base(model, setup, range(len(model.frames)))
    for pattern in setup.priors:
        if not any(fnmatch(name, pattern) for v in everywhere for name in (v.keys[0], v.name)):
            raise UnknownKey(pattern, [v.name for v in everywhere], "free parameter for a prior")
    model.scene.check(setup.values, "start values")
    usable = [model.usable(i) for i in range(len(model.frames))]
    study = Study.create(
        folder,
        scene=str(model.captures.scene),
        captures=str(setup.captures),
        inputs=[setup.captures, model.scene.path, *model.scene.registry.folders],
        seed=setup.seed,
        command=command,
        title=title,
        noise=asdict(model.noise),
        warnings=[*_warnings(model), *_unverified(model, setup, held)],
        resume=resume,
        facts={
            "frames": len(model.frames),
            "fitted": len(fitted),
            "held_out": len(held),
            "image": list(model.shape),
            "masked": 1 - float(np.mean([u.sum() / model.size for u in usable])),
            "setup": asdict(setup),
        },
    )
    if study.steps:
        return study, model, restore(study, model)
    start = Values(dict(setup.values))
    clock = time.perf_counter()
    try:
        found = fit_base(model, variables, fitted, start, progress, robust=setup.robust)
        record(study, model, "base", None, found, held, time.perf_counter() - clock)
    except BaseException:
        study.discard()
        raise
    return study, model, found


def _warnings(model: Model) -> list[str]:
    from optics.captures.noise import warnings_of
    from optics.light.rendering import veiled

    texts = [*model.captures.warnings, *warnings_of(model.noise, model.captures), *_unnamed(model), *_astray(model)]
    if (
        model.renderer.layered
        and model.captures.table is None
        and (what := veiled(model.renderer, model.at(Values(), 0)))
    ):
        texts.append(f"the model leaves out light that comes through layers: {what}")
    if model.monte_carlo and (share := model.chance()) > CHANCE:
        texts.append(
            f"the prediction of dielectric bodies is an estimate by Monte Carlo; its error is {share:.2g} of the noise in the first frame. It is "
            f"added to the noise, pixel by pixel, but is the same in frames of the same geometry: raise `rays` and `packets` of "
            f"the scene's integrator until it is below {CHANCE:g}"
        )
    return list(dict.fromkeys(texts))


def _unverified(model: Model, setup: Setup, held: Sequence[int]) -> list[str]:
    """Several frames, of which none is held out because there are too few groups."""
    groups = len(capture_files.groups(model.captures))
    if held or setup.held_out is not None or groups < 2:
        return []
    return [
        f"{groups} groups of frames: none is held out, so nothing verifies what is found; take {GROUPS} or more, or name one to hold out "
        "(--hold-out)"
    ]


def _astray(model: Model) -> list[str]:
    """Presses that lie beyond the gel."""
    gel = model.scene.gel
    if gel is None:
        return []
    for axis, side in (("press_x", "width"), ("press_y", "length")):
        key, size = f"{gel.name}.{axis}", float(model.base[f"{gel.name}.{side}"])
        for f in model.frames:
            if abs(f.parameters.get(key, 0.0)) > size / 2:
                return [
                    f"frame '{f.name}': {key} = {f.parameters[key]:g} mm lies beyond the gel, which is {size:g} mm wide there: check units"
                ]
    return []


def _unnamed(model: Model) -> list[str]:
    """Lights that some frames set and others leave to the scene, which has them on."""
    own = [{*f.parameters, *f.readings} for f in model.frames]
    left = {
        key: i
        for key in (f"{n}.power" for n in model.scene.lights)
        if model.base[key] and any(key in keys for keys in own)
        for i, keys in enumerate(own)
        if key not in keys
    }
    if not left:
        return []
    key, frame = next(iter(left.items()))
    return [
        f"{', '.join(left)}: set in some frames and not in others, such as '{model.frames[frame].name}', where {key} is the scene's "
        f"{model.base[key]:g}; write 0 where a light was off"
    ]


def _far(model: Model, found: calibrate.Fit, level: Row) -> list[str]:
    """What no effect explains: a model that is nowhere near its images, or values far from what is known of them."""
    texts = []
    if level.rms > FAR * level.signal:
        texts.append(
            f"the model misses the images by {level.rms / max(level.signal, 1e-9):.0%} of its own mean, which is no matter of effects: check {AT_FAULT}"
        )
    moved = [(v, found.values.get(v, model.base)) for v in found.variables if v.prior is not None]
    moved = [(v, value) for v, value in moved if abs(value - v.prior[0]) > 3 * v.prior[1]]
    if moved:
        v, value = max(moved, key=lambda t: abs(t[1] - t[0].prior[0]) / t[0].prior[1])
        texts.append(
            f"{some([v.name for v, _ in moved], 4)}: calibrated to more than "
            f"3 sd from what is known, most {v.name}: {value:.4g}{spaced(v.parameter.unit)} for {v.prior[0]:.4g} +- {v.prior[1]:g}; "
            f"check {AT_FAULT}"
        )
    return texts


def record(
    study: Study,
    model: Model,
    name: str,
    effect: Effect | None,
    found: calibrate.Fit,
    held: Sequence[int],
    seconds: float,
) -> Comparison:
    """Write a calibrated model down as the next step of the study."""
    values, extra = held_out_values(model, found, held)
    comparison = comparison_of(model, values, held, len(found.variables), extra)
    found.warnings += _far(model, found, comparison.fitted)
    everywhere = Values(dict(found.values.common), {**values.frame, **found.values.frame})
    kept = calibrate.Fit(**{**found.__dict__, "values": everywhere})
    study.add_step(
        name,
        effect.key if effect else None,
        kept,
        comparison,
        frames=ladder.shown_frames(model, everywhere, held),
        seconds=seconds,
        nulls=null_models(model, values, found.frames, held),
        background=background_of(model, values),
    )
    return comparison


def null_models(model: Model, values: Values, fitted: Sequence[int], held: Sequence[int]) -> dict | None:
    """How an imported set's model stands beside models without physics (optics.fit.null_models); None where there is
    nothing to compare."""
    from optics.captures import importing
    from optics.fit import null_models as nulls

    if model.flat is None or not held or not (model.captures.folder / "import.json").is_file():
        return None
    return nulls.compare(model, values, fitted, held, importing.circles_of(model.captures)).json()


def background_of(model: Model, values: Values) -> dict | None:
    """The flat field's mode, and how much of the background the scene explains without it, per channel."""
    return None if model.flat is None else {"mode": model.flat_field, "channels": model.background_share(values)}


def take_up(folder: str | Path) -> tuple[Study, Model, Setup]:
    """A study that exists, with its model."""
    study = Study.open(folder)
    setup = Setup(**study.record["facts"]["setup"])
    setup.priors = {k: tuple(v) for k, v in setup.priors.items()}
    changed = study.changed_inputs()
    if changed:
        raise BadCapture(f"{folder}: changed since the study began: {', '.join(changed[:5])}; start a new study")
    return study, open_model(setup), setup


def kept(study: Study, model: Model, index: int = -1) -> tuple[list[Variable], Values, list[int]]:
    """What a step's folder has of its fit: the variables, the values, and the frames that were fitted."""
    setup = Setup(**study.record["facts"]["setup"])
    fitted, _ = split(model, setup)
    steps = study.steps[: len(study.steps) + index + 1] if index < 0 else study.steps[: index + 1]
    data = study.fit(len(steps) - 1)
    names = {f.name: i for i, f in enumerate(model.frames)}
    values = Values(dict(data["parameters"]), {names[n]: dict(own) for n, own in data["frames"].items()})
    variables = variables_of_base(model, setup, fitted)
    for step in steps:
        if step["effect"]:
            variables += [
                v
                for v in effect_variables(model, model.scene.registry.find_effect(step["effect"]))
                if v.frames is None or set(v.frames) <= set(fitted)
            ]
    return variables, values, fitted


def restore(study: Study, model: Model, index: int = -1) -> calibrate.Fit:
    """The fit of a step, from its folder: the same variables and values, with errors computed afresh."""
    variables, values, fitted = kept(study, model, index)
    return calibrate.fit(model, variables, values, fitted, max_iterations=6 if study.steps[index]["converged"] else 30)


def candidates(model: Model, study: Study) -> list[Effect]:
    """Every effect that the scene can express and the study has not added."""
    done = {e.key for e in effects_of(study, model.scene.registry)}
    return [
        e
        for k, e in sorted(model.scene.registry.effects.items())
        if k not in done and model.scene.can_express(e) and not (e.mixes_pixels and model.captures.table is not None)
    ]


def seek(model: Model, values: Values, effects: Sequence[Effect], frames: Sequence[int]) -> None:
    """Put into the values where effects that have a place would be, as their residual says."""
    for effect in effects:
        if effect.seek is not None:
            values.common.update(model.scene.check(effect.seek(model, values, frames), effect.name))


def examine(
    study: Study,
    model: Model,
    setup: Setup,
    found: calibrate.Fit,
    progress: Progress | None = None,
    advised: bool = True,
):
    """Diagnose the last step and write the diagnosis, with the best effects' fingerprints, into it; `advised`: where
    effects tie, also what to measure next, which is rendered shot by shot."""
    from optics.diagnosis.advice import advise
    from optics.diagnosis.diagnose import USUALLY, diagnose

    fitted, held = split(model, setup)
    tested = candidates(model, study)
    seek(model, found.values, tested, fitted)
    known, results = {v.name for v in found.variables}, {}
    steps = {v.name: v.parameter.plausible for e in tested if e.onset != "tangent" for v in effect_variables(model, e)}

    def refit(model, variables, start, frames):
        """Chord steps on the base's derivative images where an effect is added to it; a full fit otherwise."""
        extra = [v for v in variables if v.name not in known]
        bent = sum(v.name in steps for v in extra) > 1  # a chord per parameter knows nothing of their products
        if found.normal is None or not extra or bent or list(frames) != list(found.frames):
            return calibrate.fit(model, variables, start, frames)
        names = tuple(v.name for v in extra)
        if names not in results:  # a diagnosis asks again from another start, which chord steps do not use
            leader = max((found.chi2 - f.chi2 for f in results.values()), default=0.0)
            quick = calibrate.extended(model, found, extra, {v.name: steps[v.name] for v in extra if v.name in steps})
            if not quick.converged and found.chi2 - quick.chi2 > 0.7 * leader:
                quick = afresh(variables, extra, frames, quick)
            results[names] = quick
        return results[names]

    def afresh(variables, extra, frames, quick):
        """Calibrate from the study's start: nearer than the base's values, which a strong effect has bent far away."""
        values = off_neutral(model, Values(dict(setup.values)), extra)
        best = fit_base(model, variables, frames, values, tolerance=0.5)
        if best.chi2 < quick.chi2:
            return best
        return calibrate.fit(model, variables, quick.values, frames, max_iterations=4, tolerance=0.5)

    result = diagnose(
        model,
        found,
        tested,
        lambda e: effect_variables(model, e),
        held,
        fitted=fitted,
        refit=refit,
        seed=setup.seed,
        progress=progress,
    )
    result.advice = advise(model, result, effect_variables, setup.seed, progress) if advised else []
    if result.advice:
        result.hints = [hint for hint in result.hints if hint != USUALLY]
    worst = int(np.argmax(np.array(found.frame_chi2) / np.maximum(found.frame_n, 1)))
    study.put_diagnosis(len(study.steps) - 1, result, ladder.fingerprints_of(model, found, result, found.frames[worst]))
    return result


def extend(
    study: Study,
    model: Model,
    setup: Setup,
    found: calibrate.Fit,
    effect: Effect,
    start: Values | None = None,
    progress: Progress | None = None,
) -> tuple[calibrate.Fit, Comparison]:
    """Free an effect, calibrate everything again, and record the step.

    start   values to begin from, such as those of the diagnosis's refit; else the present ones with the effect off
            neutral
    """
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
    extra = [v for v in effect_variables(model, effect) if v.frames is None or set(v.frames) <= set(fitted)]
    variables = [*found.variables, *extra]
    if start is None:
        seek(model, found.values, [effect], fitted)
        start = off_neutral(model, found.values, extra)
    clock = time.perf_counter()
    best = calibrate.fit(model, variables, start, fitted, robust=setup.robust, progress=progress)
    study.note_inputs([effect.file] if effect.file else [])  # a draft is written after the study began
    comparison = record(study, model, effect.name, effect, best, held, time.perf_counter() - clock)
    before, after = (step["held_out"]["chi2_per_dof"] if step["held_out"] else math.nan for step in study.steps[-2:])
    if after > before:
        best.warnings.append(
            f"held-out chi2/dof rises from {before:.4g} to {after:.4g} with {effect.name}: it does not predict what it was not "
            "fitted to, and is not the cause, or not by itself"
        )
    return best, comparison
