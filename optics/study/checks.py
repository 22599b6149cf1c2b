"""What is doubtful about captures and their calibration, in sentences that say what to check."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from optics.captures import capture_set as capture_files
from optics.diagnosis.dials import Width
from optics.diagnosis.text import AT_FAULT
from optics.diagnosis.thresholds import FAR
from optics.fit.compare import Row
from optics.fit.model import value_of
from optics.fit.result import Fit
from optics.fit.run_away import powers_apart
from optics.fit.scene_model import SceneModel
from optics.fit.tempering import weight_of
from optics.scene.parameter import Values, Variable
from optics.study.setup import GROUPS, Setup
from optics.words import some, spaced

# of the noise: Monte Carlo error of a prediction below which it adds less than 5 % to the noise (in quadrature)
CHANCE = 0.3
COLLIMATED = 4.0  # of the face's width: the distance of a light from which its directions differ by 7 deg at most
# Times the light of the images, more than a reflectance that is free may make up for; sd of what is known of a power
DIM, IMPOSSIBLE = 10.0, 10.0
BRIGHT = 3  # frames that tell, the brightest
SURPRISING = 3.0  # standard deviations of a prior, beyond which a calibrated value contradicts it


def before_calibration(model: SceneModel, setup: Setup, held: Sequence[int]) -> list[str]:
    """Doubts about captures and scene, each once."""
    return [*of_captures(model), *_unverified(model, setup, held)]


def require_light(model: SceneModel, values: Values, variables: Sequence[Variable], fitted: Sequence[int]) -> None:
    """Raise ValueError where the model sends far more or less light than images show, and no free power may make up for
    it: a calibration would take long to find that out."""
    powers = [v for v in variables if model.linear_in(v) and model.family(v.keys[0]) == "light"]
    scales = [v for v in variables if model.linear_in(v) and v not in powers]
    if model.captures.table is not None or not powers or any(v.prior is None for v in [*powers, *scales]):
        return
    scene, black = model.scene.values(), float(model.noise.black_level)
    frames = sorted(fitted, key=lambda i: -float(np.sum(model.frames[i].image[model.usable(i)])))[:BRIGHT]
    images = [model.frames[i].image[model.usable(i)] - black for i in frames]
    sent = [image[model.usable(i)] - black for i, image in zip(frames, model.predict(values, frames))]
    square = sum(float(np.sum(s**2)) for s in sent)
    ratio = sum(float(np.sum(s * y)) for s, y in zip(sent, images)) / square if square else math.nan
    if not 0 < ratio < math.inf:  # nothing is usable, or the model sends nothing: what the fit says of that is clearer
        return
    known = [v.prior for v in powers if v.prior is not None]
    beyond = min(abs(ratio - 1) * abs(value_of(model, values, v)) / prior[1] for v, prior in zip(powers, known))
    if 1 / DIM < ratio < DIM or not beyond > IMPOSSIBLE:
        return
    v, prior = powers[0], known[0]
    key = v.keys[0]
    raise ValueError(
        f"{model.captures.folder}: at its start the model sends {1 / ratio:.2g} times the light of the images, and "
        f"what is known of the powers does not allow that: {key} = {value_of(model, values, v):.4g} for "
        f"{prior[0]:.4g} +- {prior[1]:.2g} (the scene has {scene[key]:.4g}). Allowed: {1 / DIM:g} to {DIM:g} times. "
        "If frames set powers, let them set those of the scene; or give another prior (--prior "
        f"'{key}={prior[0] * ratio:.2g}+-{prior[1] * ratio:.2g}'), or correct the camera's exposure"
    )


def of_captures(model: SceneModel) -> list[str]:
    """Doubts about the captures, their noise, and what the model can predict of them."""
    from optics.captures.noise import warnings_of
    from optics.light.rendering import veiled

    texts = [*model.captures.warnings, *warnings_of(model.noise, model.captures), *_unnamed(model), *_astray(model)]
    texts += [*without_shading(model), *repeated_images(model)]
    if model.cut_off:
        count = sum(int((f.image == 0).sum()) for f in model.frames)
        texts.append(
            f"{count} readings are 0 and none is negative: the instrument shows nothing below 0. These readings are "
            "only upper limits, and are left out"
        )
    images_through_layers = model.renderer.layered and model.captures.table is None
    if images_through_layers and (what := veiled(model.renderer, model.at(Values(), 0))):
        texts.append(f"the model leaves out light that comes through layers: {what}")
    if model.monte_carlo and (share := model.chance()) > CHANCE:
        texts.append(
            "the prediction of dielectric bodies is a Monte Carlo estimate; its error is "
            f"{share:.2g} of the noise in the first frame. It is added to the noise, pixel by pixel, but frames of the "
            "same geometry share it: raise `rays` and `packets` of the scene's integrator until it is below "
            f"{CHANCE:g}"
        )
    return list(dict.fromkeys(texts))


def after_calibration(model: SceneModel, found: Fit, level: Row | None) -> list[str]:
    """What no effect explains: a model nowhere near its images, or values that contradict their priors."""
    texts = []
    if level is not None and level.rms > FAR * level.signal:
        what = (
            f"misses the images by {level.rms / level.signal:.0%} of its own mean"
            if level.signal > level.noise
            else f"sends no light, and misses the images by {level.rms:.3g} DN"
        )
        texts.append(f"the model {what}, too far for a missing effect: check {AT_FAULT}")
    if (misfit := weight_of(found.variables)) > 1:
        texts.append(
            "the model misses the images by more than their noise. Errors include this misfit: they are "
            f"{misfit**0.5:.3g} times those of noise alone. Priors count {misfit:.3g} times as much relative to the "
            "images, so that parameters stay near them until the missing effect is found"
        )
    texts += _far_lights(model, found)
    if apart := powers_apart(model, found):
        texts.append(
            f"{apart}: the model lets almost none of that light through, and its power explains what is missing. If "
            "the lamps are known to be more alike, give this power a prior (--prior)"
        )
    known = [(v, value_of(model, found.values, v), v.prior) for v in found.variables if v.prior is not None]
    moved = [(v, value, prior) for v, value, prior in known if abs(value - prior[0]) > SURPRISING * prior[1]]
    if moved:
        v, value, prior = max(moved, key=lambda t: abs(t[1] - t[2][0]) / t[2][1])
        texts.append(
            f"{some([v.name for v, _, _ in moved], 4)}: calibrated to more than {SURPRISING:g} sd from the prior, most "
            f"{v.name}: {value:.4g}{spaced(v.parameter.unit)} for {prior[0]:.4g} +- {prior[1]:g}; check {AT_FAULT}"
        )
    return texts


def _far_lights(model: SceneModel, found: Fit) -> list[str]:
    """Lights that ran so far from where they were known to be that their distance shows no more; those of a board as
    one."""
    scene, gel = getattr(model, "scene", None), getattr(getattr(model, "scene", None), "gel", None)
    if scene is None or gel is None:
        return []
    start, now = model.at(Values(), 0), model.at(found.values, 0)
    across = [float(now[key]) for role in ("width", "length") if (key := scene.key(gel.name, role))]
    here, there = scene.places_of(start), scene.places_of(now)
    texts: dict[str, str] = {}
    for led in there if across else ():
        board = getattr(scene.leds[led], "board", None)
        keys = {scene.key(led, f"light {axis}") for axis in "xyz"}
        keys |= {f"{board.name}.{p}" for p in board.numbers} if board is not None else set()
        placed = [(v, v.prior) for v in found.variables if v.prior is not None and set(v.keys) & keys]
        before, after = math.hypot(*here[led]), math.hypot(*there[led])
        astray = any(abs(value_of(model, found.values, v) - p[0]) > SURPRISING * p[1] for v, p in placed)
        if astray and after > max(2 * before, COLLIMATED * max(across)):
            name = led if board is None else board.name
            texts[name] = (
                f"{name} moved from {before:.3g} mm to {after:.3g} mm, where its light is practically collimated over "
                f"the {max(across):.3g} mm of the face. This happens if light that fills shadows is missing: test "
                "'light returned by the window', 'ambient light' and 'interreflection'"
            )
    return list(texts.values())


def of_dials(keys: Sequence[str], width: Width | None) -> list[str]:
    """What was found of the errors of dials that nobody states."""
    if width is None:
        return []
    return [
        f"{some(keys, 4)}: captures.toml does not state how well they were set; the readings say "
        f"{width.stated:g} deg (1 sd, {width.low:.2g} to {width.high:.2g}), which is taken from now on. State your own "
        f'under [uncertainty], as "{keys[0]}" = {width.stated:g}, or 0 for a dial that is exact'
    ]


def _unverified(model: SceneModel, setup: Setup, held: Sequence[int]) -> list[str]:
    """Several groups of frames, of which none is held out because there are too few."""
    groups = len(capture_files.groups(model.captures))
    if held or setup.held_out is not None or groups < 2:
        return []
    return [
        f"{groups} groups of frames: none is held out, so nothing verifies what is found; take {GROUPS} or more, or "
        "name one to hold out (--hold-out)"
    ]


def without_shading(model: SceneModel) -> list[str]:
    """Images under light that hold one value: nothing in them tells a model from another."""
    found = {}
    for f in model.frames:
        values = f.image[np.isfinite(f.image)]
        lit = any(f.parameters.get(key, model.base[key]) != 0 for key in model.scene.powers.values())
        if f.readings or values.size < 2 or values.min() < values.max() or not lit:
            continue
        found[f.name] = float(values.flat[0])
    if not found:
        return []
    name, value = next(iter(found.items()))
    return [
        f"{len(found)} of {len(model.frames)} images hold one value everywhere, such as '{name}', where every value is "
        f"{value:g} DN: nothing in them tells one model from another. Look at the files, or leave these frames out"
    ]


def repeated_images(model: SceneModel) -> list[str]:
    """Images of the same pixels under other names: noise gives no camera the same image twice."""
    first: dict[bytes, str] = {}
    pairs = []
    for f in model.frames if model.captures.values_are == "DN" else ():
        values = f.image[np.isfinite(f.image)]
        if f.readings or values.size < 2 or values.min() == values.max():
            continue
        twin = first.setdefault(np.ascontiguousarray(f.image).tobytes(), f.name)
        if twin != f.name:
            pairs.append((twin, f.name))
    if not pairs:
        return []
    twin, own = pairs[0]
    return [
        f"{len(pairs)} of {len(model.frames)} images are identical to another one ('{own}' to '{twin}'), "
        "so that one measurement counts twice. Check the files and remove copies"
    ]


def _astray(model: SceneModel) -> list[str]:
    """Presses that lie beyond the gel."""
    gel = model.scene.gel
    if gel is None:
        return []
    for axis, side in (("press x", "width"), ("press y", "length")):
        key, across = (model.scene.key(gel.name, role) for role in (axis, side))
        if key is None or across is None:
            continue
        size = float(model.base[across])
        for f in model.frames:
            if abs(float(f.parameters.get(key, 0.0))) > size / 2:
                return [
                    f"frame '{f.name}': {key} = {f.parameters[key]:g} mm lies beyond the gel, which is {size:g} mm "
                    "wide there: check units"
                ]
    return []


def _unnamed(model: SceneModel) -> list[str]:
    """Lights that some frames set and others leave to the scene, which has them on."""
    own = [{*f.parameters, *f.readings} for f in model.frames]
    left = {
        key: i
        for key in model.scene.powers.values()
        if model.base[key] and any(key in keys for keys in own)
        for i, keys in enumerate(own)
        if key not in keys
    }
    if not left:
        return []
    key, frame = next(iter(left.items()))
    return [
        f"{', '.join(left)}: set in some frames and not in others, such as '{model.frames[frame].name}', where {key} "
        f"is the scene's {model.base[key]:g}; write 0 where a light was off"
    ]
