"""What a study starts from: captures, scene and choices; the model they give; what is free in it; what is held out."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from optics.captures import capture_set as capture_files
from optics.captures.noise import Noise, estimate
from optics.errors import BadCapture, OutOfBounds, Underdetermined, UnknownKey
from optics.fit import calibrate
from optics.fit.gauges import acting
from optics.fit.known_shape import ALL, REGIONS
from optics.fit.model import value_of
from optics.fit.scene_model import FLAT_FIELDS, SceneModel
from optics.scene import loader as scenes
from optics.scene import trust
from optics.scene.declare import Effect
from optics.scene.parameter import Values, Variable, keys_with
from optics.words import some

ASPECT = 0.02  # relative difference of aspect ratio between images and scene beyond which they are said to be cut
GROUPS = 4  # with at least this many groups of frames, every fourth is held out
GAUGE = 10.0  # plausible sizes: standard deviation of the prior that keeps a degenerate mode near the scene's value


@dataclass
class Setup:
    """What a study starts from. Its record keeps it, so that another process can continue.

    captures    folder of the capture set
    defines     -D of the scene; the size of the images is added where the scene names width and height
    plugins     further folders of plugins, or files; empty: none. None: `plugins` beside captures and scene, where
                there are such folders and they are trusted (optics.scene.trust)
    outside     images and tables may lie outside the folder of the captures
    free        key patterns of the parameters to solve for, one value for all frames; empty: position, axis, lobe and
                power of every LED, reflectance and roughness of every membrane, power of every source, before a crowd
                of balls the camera's pose and field of view
    per_group   key patterns of parameters with a value per group of frames; None: the press, where groups are given
    priors      pattern -> (mean, standard deviation); a mean of None is the present value
    held_out    names of groups that the calibration does not see; None: one in four, of four or more
    values      start values, by key
    flat_field  how a background image enters, see `optics.fit.model.Model`
    region      what is fitted and judged: "all" of each image, or "known": where the skin's shape is known
                (optics.fit.known_shape); "": all
    uncertainty standard deviation of settings by key, where the captures state none; None: that of dials is found from
                the readings when a study begins (optics.diagnosis.dials)
    robust      residuals beyond three sigmas count less (Huber), for dirt and glints; a diagnosis weighs all alike
    seed        of everything random
    """

    captures: str
    defines: dict[str, str] = field(default_factory=dict)
    plugins: list[str] | None = None
    outside: bool = False
    free: list[str] = field(default_factory=list)
    per_group: list[str] | None = None
    priors: dict[str, tuple[float | None, float]] = field(default_factory=dict)
    held_out: list[str] | None = None
    values: dict[str, float | str] = field(default_factory=dict)
    flat_field: str | None = None
    region: str = ""
    uncertainty: dict[str, float] | None = None
    robust: bool = False
    seed: int = 0


def setup_for(captures: str | Path, **given: object) -> Setup:
    """The setup of the given fields; what an imported set advises stands for None and empty.

    An importer writes its advice to import.json. A prior or value that is given of one parameter leaves those of
    others as advised. Where `free` or `per_group` is given, the advised priors belong to other parameters and are left
    out. Raises BadCapture for advice that is none: a file of data names no code.
    """
    advised = _advised(Path(captures) / "import.json")
    kept = ("per_group", "held_out", "plugins")  # of which an empty list says something
    own = {name: value for name, value in given.items() if value or (value == [] and name in kept)}
    if {"free", "per_group"} & set(own):
        advised = {name: value for name, value in advised.items() if name in ("flat_field", "region")}
    if own.get("region", ALL) not in REGIONS:
        raise UnknownKey(str(own["region"]), REGIONS, "region", "--region")
    for name in ("priors", "values"):  # what is given of one parameter leaves the others as advised
        if name in advised and name in own:
            own[name] = advised[name] | own[name]  # type: ignore[operator]
    return recorded({**advised, **own, "captures": str(captures)})


ADVICE = (
    "free",
    "per_group",
    "priors",
    "held_out",
    "values",
    "flat_field",
    "region",
    "uncertainty",
    "robust",
    "defines",
)


def _advised(file: Path) -> dict[str, Any]:
    """The fields of a setup that an imported set advises; none without the file."""
    if not file.is_file():
        return {}
    try:
        note = json.loads(file.read_text(encoding="utf-8-sig"))
        advised = note.get("setup", {}) if isinstance(note, dict) else None
    except ValueError as error:
        raise BadCapture(f"{file}: not valid JSON: {error}; import the set again") from error
    if not isinstance(advised, dict):
        raise BadCapture(f"{file}: setup is no table; allowed: {', '.join(ADVICE)}; import the set again")
    if "plugins" in advised:
        raise BadCapture(
            f"{file}: setup: plugins = {advised['plugins']!r}: a capture set is data and names no code; remove it, and "
            "give the folder by '--plugins' if you trust it"
        )
    for name in advised:
        if name not in ADVICE:
            raise UnknownKey(name, ADVICE, "key", f"{file}: setup")
    priors = advised.get("priors", {})
    if not isinstance(priors, dict) or not all(_is_prior(prior) for prior in priors.values()):
        raise BadCapture(f"{file}: setup: priors = {priors!r}; allowed: pattern -> [mean or null, standard deviation]")
    for name, value in advised.items():
        if name != "priors" and value is not None and not _ADVISED[name][0](value):
            raise BadCapture(f"{file}: setup: {name} = {value!r}; allowed: {_ADVISED[name][1]}; import the set again")
    return {name: value for name, value in advised.items() if value is not None}


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _are_texts(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(v, str) for v in value)


def _maps_to(value: object, *kinds: Callable[[object], bool]) -> bool:
    return isinstance(value, dict) and all(any(kind(v) for kind in kinds) for v in value.values())


def _is_text(value: object) -> bool:
    return isinstance(value, str)


_ADVISED: dict[str, tuple[Callable[[object], bool], str]] = {  # what an entry may be, and the same in words
    "free": (_are_texts, "a list of patterns"),
    "per_group": (_are_texts, "a list of patterns"),
    "held_out": (_are_texts, "a list of groups"),
    "values": (lambda v: _maps_to(v, _is_number, _is_text), "key -> number or text"),
    "defines": (lambda v: _maps_to(v, _is_number, _is_text), "name -> number or text"),
    "uncertainty": (lambda v: _maps_to(v, lambda n: _is_number(n) and n >= 0), "key -> number from 0 on"),  # type: ignore[operator]
    "flat_field": (lambda v: v in FLAT_FIELDS, f"{', '.join(FLAT_FIELDS)}"),
    "region": (lambda v: v in REGIONS, f"{' or '.join(REGIONS)}"),
    "robust": (lambda v: isinstance(v, bool), "true or false"),
}


def _is_prior(prior: object) -> bool:
    pair = isinstance(prior, list) and len(prior) == 2
    return pair and (prior[0] is None or _is_number(prior[0])) and _is_number(prior[1]) and prior[1] > 0  # type: ignore[index]


def recorded(facts: Mapping[str, Any]) -> Setup:
    """The setup of a study's record, which keeps pairs as lists, and in earlier versions one folder of plugins."""
    setup = Setup(**facts)
    if isinstance(setup.plugins, str):
        setup.plugins = [setup.plugins]
    setup.priors = {pattern: (prior[0], prior[1]) for pattern, prior in setup.priors.items()}
    return setup


# -- the model -------------------------------------------------------------------------------------------------------
def open_model(
    setup: Setup,
    model_class: type = SceneModel,
    fitted: Noise | None = None,
    code: Sequence[Path] | None = None,
) -> SceneModel:
    """Captures and scene of a setup as a model; raises, before anything is rendered, where they contradict each
    other.

    fitted   noise of the captures that the values to come were fitted to, if they are others
    code     the plugin files that are known besides the shipped ones, which may run; None: as the setup says"""
    named = setup.plugins if code is None else [str(file) for file in code]
    beside: list[Path] = []
    if named is None:
        beside = trust.admit(trust.beside(Path(setup.captures)), "beside the captures")
    found = capture_files.load(setup.captures, setup.outside)
    path = scenes.find(found.scene)
    height, width = found.frames[0].image.shape[:2]
    defines, usual = definitions_of(setup, found, path, (width, height)), _usual(path)
    if found.table is None and len(usual) == 2:
        own_width, own_height = int(usual["width"]), int(usual["height"])
        if abs(width * own_height / (height * own_width) - 1) > ASPECT:
            found.warnings.append(
                f"the images are {width} x {height} px, the scene's own are {own_width} x {own_height}: cropped or "
                "turned images show another part of the sensor than the scene's camera; give them whole, row 0 at the "
                "top, or correct x_fov and the principal point in the scene"
            )
    loaded = scenes.load(path, defines, plugins=named, found=beside)
    setup.values = loaded.spread(setup.values, "start values")
    capture_files.check(found, loaded.parameters)
    for index, f in enumerate(found.frames):
        where = f"{found.folder / capture_files.FILE}: frame {index} ('{f.file or f.name}')"
        loaded.check_press({**found.parameters, **f.parameters}, where)
    found = capture_files.state(found, loaded.parts, {k: e.name for k, e in loaded.registry.effects.items()})
    found.uncertainty = {**(setup.uncertainty or {}), **found.uncertainty}
    noise = found.noise
    if noise is None:
        noise = estimate(found, clocks=keys_with(loaded.parameters, "clock"))
    options = {} if setup.flat_field is None else {"flat_field": setup.flat_field}
    if setup.region:
        options["region"] = setup.region
    model = model_class(loaded, found, noise.in_scale_of(fitted), **options)
    model.assumed_errors = dict(setup.uncertainty or {})
    model.recipe = partial(open_model, setup, model_class, fitted, loaded.registry.own_files)
    return model


def _usual(scene: Path) -> dict[str, str]:
    """The width and height that a scene names by themselves, px."""
    return dict(re.findall(r'<default name="(width|height)" value="(\d+)"', scene.read_text(encoding="utf-8")))


def definitions_of(
    setup: Setup, captures: capture_files.Captures, scene: Path, size: tuple[int, int]
) -> dict[str, str]:
    """-D of the scene, with the (width, height) of the images where it names them."""
    defines = capture_files.definitions(captures, setup.defines, scene)
    usual = _usual(scene)
    for name, pixels in zip(("width", "height"), size):
        if name in usual:
            defines.setdefault(name, str(pixels))
    return defines


def split(model: SceneModel, setup: Setup) -> tuple[list[int], list[int]]:
    """Indices of fitted and of held-out frames. Raises UnknownKey for a group that does not exist."""
    groups = capture_files.groups(model.captures)
    names = list(groups)
    held = setup.held_out
    if held is None:
        held = _every_fourth(model, groups) if len(names) >= GROUPS else []
    for name in held:
        if name not in groups:
            raise UnknownKey(name, names, "group of frames", setup.captures)
    out = sorted(i for name in held for i in groups[name])
    fitted = [i for i in range(len(model.frames)) if i not in set(out)]
    if not fitted:
        raise Underdetermined(f"{setup.captures}: every group is held out; leave some to calibrate on")
    return fitted, out


def _every_fourth(model: SceneModel, groups: Mapping[str, Sequence[int]]) -> list[str]:
    """One group of four: the second, or the next that is not the only one at a level of some setting. Held out, the one
    photograph of a shorter exposure would leave nothing that tells a dark offset from light.

    Levels are those of settings with fewer values than half of the groups: of more, as of a dial that is turned, each
    value is like its neighbours."""
    names = list(groups)
    needed: set[str] = set()
    for key in {key for f in model.frames for key in f.parameters}:
        seen: dict[float | str | None, set[str]] = {}
        for name in names:
            for i in groups[name]:
                seen.setdefault(model.frames[i].parameters.get(key), set()).add(name)
        if 2 * len(seen) < len(names):
            needed |= {next(iter(own)) for own in seen.values() if len(own) == 1}
    slots = [names[first : first + GROUPS] for first in range(1, len(names), GROUPS)]
    return [next((name for name in slot if name not in needed), slot[0]) for slot in slots]


# -- what is free ----------------------------------------------------------------------------------------------------
def default_free(model: SceneModel) -> list[str]:
    """The parameters that parts declare free in all frames, of LEDs, of sources, then of other parts: position, axis,
    lobe and power of every LED, power of every source, reflectance and roughness of every membrane; before a crowd of
    balls, whose outlines show it, also the camera's pose and field of view where the captures do not state them as
    known.

    Of a light with free powers in single bands, these are free where the scene has several bands, and the power of all
    bands where it has one."""
    scene = model.scene
    bands = len((scene.integrator.bands if scene.integrator is not None else ()) or (0,))
    keys = []
    for name in dict.fromkeys((*scene.leds, *scene.sources, *scene.parts)):
        numbers = scene.parts[name].numbers.values()
        own = [p for p in numbers if p.free == "all" and (p.band or 0) < bands]
        if any(p.role == "band power" for p in own):
            own = [p for p in own if p.role != ("power" if bands > 1 else "band power")]
        keys += [f"{name}.{p.name}" for p in own]
        if scene.traced is not None:
            keys += [key for p in numbers if p.free == "crowd" and not _is_known(model, key := f"{name}.{p.name}")]
    return keys


def _is_known(model: SceneModel, key: str) -> bool:
    """Whether the captures give the parameter as known: in single frames, or in all without an uncertainty."""
    captures = model.captures
    single = any(key in f.parameters or key in f.readings for f in model.frames)
    return single or (key in captures.parameters and key not in captures.uncertainty)


def variables_of_base(model: SceneModel, setup: Setup, frames: Sequence[int]) -> list[Variable]:
    """The base model's variables in these frames: those of all frames, those of each group, and settings that are
    known with an uncertainty (`settings_in_doubt`)."""
    doubts = settings_in_doubt(model, frames)
    priors = dict(setup.priors)
    grouped = setup.per_group or ()
    shared = setup.free or [k for k in default_free(model) if not any(fnmatch(k, p) for p in grouped)]
    if not setup.free:
        own = {k: model.parameters[k].prior_sd for k in shared}
        priors = {**{k: (None, sd) for k, sd in own.items() if sd is not None}, **priors}
    per_group = setup.per_group
    if per_group is None:
        per_group = []
        if any(f.group for f in model.frames):
            per_group = [k for k, p in model.parameters.items() if p.free == "press"]
            own = {f"{k}*": model.parameters[k].prior_sd for k in per_group}
            priors = {**{k: (None, sd) for k, sd in own.items() if sd is not None}, **priors}
    twice = _twice(model, setup.free, setup.per_group or ())
    if twice:
        raise ValueError(
            f"{some(twice, 4)}: free for all frames and for each group at once, which no frame can separate; "
            "allowed: one of --free and --per-group"
        )
    variables = calibrate.variables_from(model, shared, per_group, None, frames)
    swept = {v.keys[0] for v in variables for i in v.frames or () if v.keys[0] in model.frames[i].readings}
    if swept:
        raise ValueError(
            f"{some(sorted(swept), 4)}: set anew in the readings of a group, so that a group has no one value; "
            "allowed: per group what the table does not set; give the error of a setting under [uncertainty]"
        )
    if setup.per_group is None:
        variables = [v for v in variables if v.frames is None or not _untouched(model, v.frames)]
    for pattern, prior in priors.items():
        variables = [_with_prior(model, v, pattern, prior) for v in variables]
    for i, v in enumerate(variables):  # what is free anyway has its setting as its prior, unless the setup has another
        given = any(fnmatch(name, pattern) for pattern in setup.priors for name in (v.keys[0], v.name))
        known = [d.prior for d in doubts if d.keys == v.keys and _within(d, v) and d.prior is not None]
        if known and not given:
            variables[i] = v.with_prior(*known[0])
    free = {(key, frame) for v in variables for key in v.keys for frame in v.frames or (None,)}
    return variables + [d for d in doubts if not free & {(d.keys[0], frame) for frame in d.frames or (None,)}]


def _twice(model: SceneModel, free: Sequence[str], per_group: Sequence[str]) -> list[str]:
    """The parameters that patterns of both kinds match."""

    def matched(patterns: Sequence[str]) -> set[str]:
        return {key for key in model.parameters for pattern in patterns if fnmatch(key, pattern)}

    return sorted(matched(free) & matched(per_group))


def _within(inner: Variable, outer: Variable) -> bool:
    """Whether a variable holds in some of the frames that another holds in, or both in all."""
    if inner.frames is None or outer.frames is None:
        return inner.frames is outer.frames
    return set(inner.frames) <= set(outer.frames)


def settings_in_doubt(model: SceneModel, frames: Sequence[int]) -> list[Variable]:
    """The settings of these frames whose error all pixels of a frame, or all readings of a sweep, share: a variable
    each, with the setting and its uncertainty as its prior.

    One for all frames of what [parameters] sets; one for the images, or the sweeps, that share a setting
    (`Frame.made`). Errors that differ from reading to reading are in the variance (`SceneModel.variance`). A light that
    a frame switches off is off."""
    captures, found = model.captures, []
    single = {key for f in model.frames for key in (*f.parameters, *f.readings)}
    for key, sd in captures.uncertainty.items():
        if key in captures.parameters and key not in single and sd > 0:
            mean = float(captures.parameters[key])
            found.append(Variable(key, (key,), model.parameters[key], None, (mean, sd)))
    shared: dict[tuple[str, object], list[int]] = {}
    for index in frames:
        frame = model.frames[index]
        for key, sd in captures.uncertainty_of(frame).items():
            if np.ndim(sd) == 0 and not (key in model.driven and frame.parameters[key] == 0):
                shared.setdefault((key, frame.made.get(key, frame.name)), []).append(index)
    for (key, _), own in shared.items():
        first = model.frames[own[0]]
        prior = (float(first.parameters[key]), float(captures.uncertainty_of(first)[key]))
        found.append(Variable(f"{key}[{first.name}]", (key,), model.parameters[key], tuple(own), prior))
    return found


def check_priors(model: SceneModel, setup: Setup) -> None:
    """Raises UnknownKey for a prior on something that the setup does not solve for."""
    everywhere = variables_of_base(model, setup, range(len(model.frames)))
    for pattern, (mean, _) in setup.priors.items():
        for v in everywhere:
            low, high = v.parameter.bounds
            if (
                mean is not None
                and (fnmatch(v.keys[0], pattern) or fnmatch(v.name, pattern))
                and not low <= mean <= high
            ):
                raise OutOfBounds(v.name, mean, v.parameter.unit, (low, high), f"prior {pattern}")
        if not any(fnmatch(name, pattern) for v in everywhere for name in (v.keys[0], v.name)):
            raise UnknownKey(pattern, [v.name for v in everywhere], "free parameter for a prior")


def effect_variables(model: SceneModel, effect: Effect, held: Sequence[Variable] = ()) -> list[Variable]:
    """What adding an effect frees: of what the captures can show (`optics.fit.gauges.acting`), what a model with the
    variables `held` does not solve for already.

    Of several strengths a common mode may be degenerate, such as a gain that all frames share. A prior of GAUGE
    plausible sizes holds it at the scene's value, and data that determine it outweigh the prior. Parts that are absent
    have no part in it, nor has one of several parts of which captures state that it stays the same in all frames.
    """
    taken = {key for v in held for key in v.keys}
    if effect.scope == "frame" and effect.per != "kind":
        taken |= {*steady(model)}
    present = []
    for v in model.scene.variables_of(effect, len(model.frames)):
        keys = tuple(k for k in v.keys if k.rpartition(".")[0] not in model.captures.absent)
        if keys:
            present.append(v if keys == v.keys else replace(v, keys=keys))
    found = [v for v in acting(model, present) if not taken & set(v.keys)]
    if len(found) < 2:
        return found
    return [_with_prior(model, v, "*", (None, GAUGE * v.parameter.plausible)) for v in found]


def steady(model: SceneModel) -> dict[str, float | str]:
    """What every frame has with one value because the captures say so, and without an uncertainty."""
    doubted = {*model.captures.uncertainty, *(key for f in model.frames for key in f.uncertainty)}
    return {key: value for key, value in capture_files.stated(model.captures).items() if key not in doubted}


def _untouched(model: SceneModel, frames: Sequence[int]) -> bool:
    """Whether nothing presses the skin in these frames, so that there is no place of a press to solve for: they say so,
    or neither they nor the scene say anything of a press."""
    keys = keys_with(model.parameters, "press depth")
    of_presses = [key for key, p in model.parameters.items() if p.free == "press"]

    def depth(frame: int, key: str) -> Any:
        stated = {**model.captures.parameters, **model.frames[frame].parameters}
        return stated.get(key, math.nan if any(k in stated for k in of_presses) else model.base[key])

    return bool(keys) and all(depth(i, key) == 0 for key in keys for i in frames)


def _with_prior(model: SceneModel, variable: Variable, pattern: str, prior: tuple[float | None, float]) -> Variable:
    if not (fnmatch(variable.keys[0], pattern) or fnmatch(variable.name, pattern)):
        return variable
    mean = value_of(model, Values(), variable) if prior[0] is None else prior[0]
    return variable.with_prior(mean, prior[1])
