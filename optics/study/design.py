"""A capture session before it is taken: which frames tell a scene's effects apart, and which effects no frames can.

Candidate frames (places and depths of a press, lights, exposures; angles of polarizers and powers where there is no
gel; distances of an object) are rendered once, with the derivative images of all that `optics calibrate` solves for and
of every effect. Frames are then chosen one after the other for the greatest mean probability of the right decision,

    mean over ordered pairs (a, b) of Phi(sqrt(D_ab)/2),      b another effect, or none

with every effect at a tenth of its plausible strength, the size at which a diagnosis states its power. The
criterion is the mean and not the smallest D, which two effects that no frame can tell apart would hold at 0 whatever is
chosen. Each term saturates once a pair is decided, so further frames go to pairs that are not. Only the noise and the
settings are assumed known."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from optics.captures import readings
from optics.captures.capture_set import FILE, Captures, Frame, Table, noise_table
from optics.captures.noise import Noise
from optics.diagnosis import advice as advise
from optics.diagnosis import statistics as st
from optics.diagnosis.evidence import Candidate, Evidence, Progress, measure
from optics.diagnosis.thresholds import CLEAR, LEVEL
from optics.errors import BadScene, Underdetermined
from optics.files.output import new_folder, shipped
from optics.fit.scene_model import SceneModel
from optics.scene.loader import Scene
from optics.scene.parameter import Parameter, Values, beside, keys_with
from optics.scene.trust import Named
from optics.study.setup import Setup, effect_variables, variables_of_base
from optics.words import spaced, table

SHARE = 0.1  # of the plausible strength
FEWEST = 2  # frames: with one, nothing can be held out and nothing be compared
FRAMES_MOST = 1000  # of a planned session
GROUPS = 4  # below, a calibration holds nothing out by itself
FULL = 0.8  # of full scale: where an exposure puts the brightest half per cent of an image
LONG_SIDE = 64  # px of the images that are rendered for a plan, where -D does not say otherwise
ROWS = 400_000  # values of all candidates that are kept, thinned evenly
SWEEPS = 60  # candidates where a camera has one pixel: each a sweep of the analyser in steps of STEP
STEP = 15.0  # deg
NOISE = Noise(system_gain=0.04, dark_noise=0.8, black_level=8.0, saturation=255.0, prnu=0.0)  # an ordinary 8 bit camera


@dataclass(frozen=True)
class Choice:
    """A frame that could be taken: settings by key, the press or object place it belongs to, and its light, in words.

    swept   of a camera of one pixel: a key and the values that it takes, one reading each
    """

    words: str
    group: str
    settings: dict[str, float]
    swept: dict[str, list[float]] = field(default_factory=dict)

    @property
    def readings(self) -> list[dict[str, float]]:
        """The settings of each reading; one for an image."""
        count = max((len(v) for v in self.swept.values()), default=1)
        return [{**self.settings, **{k: v[i] for k, v in self.swept.items()}} for i in range(count)]


@dataclass(frozen=True)
class Power:
    """One effect in a planned session, at the strength that was asked for.

    d          expected chi2 against no effect at all; power: probability to notice it (family-wise 1 %)
    rival      the effect that mimics it best, gap: D against that; cos: of what calibration leaves of both
    """

    effect: str
    strength: str
    d: float
    power: float
    rival: str
    gap: float
    cos: float

    @property
    def correct(self) -> float:
        return st.probability_correct(min(self.gap, self.d))


@dataclass
class Plan:
    """Frames in the order in which they were chosen (`worth`: mean P(correct) up to each), and what they tell apart."""

    scene: str
    frames: list[Choice]
    worth: list[float]
    effects: list[Power]
    confused: list[dict]
    share: float
    noise: Noise
    pool: int
    size: tuple[int, int]
    nested: list[tuple[str, str]] = field(default_factory=list)
    unseen: list[str] = field(
        default_factory=list
    )  # effects that no candidate frame shows, or with an image that is not finite
    warnings: list[str] = field(default_factory=list)

    def json(self) -> dict:
        return {
            "scene": self.scene,
            "frames": [
                {"words": f.words, "group": f.group, "parameters": f.settings, "swept": f.swept, "worth": w}
                for f, w in zip(self.frames, self.worth)
            ],
            "effects": [{**asdict(e), "correct": e.correct} for e in self.effects],
            "confused": self.confused,
            "contained": [list(pair) for pair in self.nested],
            "unseen": self.unseen,
            "share_of_plausible": self.share,
            "candidates": self.pool,
            "size": list(self.size),
            "warnings": self.warnings,
        }

    def text(self) -> str:
        lines = [
            f"design: {len(self.frames)} of {self.pool} candidate frames for {self.scene}, "
            + (
                "sweeps of readings, "
                if self.size == (1, 1)
                else f"images of {self.size[0]} x {self.size[1]} px (D grows with their number), "
            )
            + f"every effect at {self.share:g} of its plausible strength",
            "",
        ]
        rows: list[tuple[str, ...]] = [
            ("", "group", "frame", "mean P(correct)"),
            *((str(i + 1), f.group, f.words, f"{w:.3f}") for i, (f, w) in enumerate(zip(self.frames, self.worth))),
        ]
        lines += [table(rows), ""]
        rows = [("effect", "strength", "noticed", "hardest to tell from", "D", "P(correct)")]
        rows += [
            (
                e.effect,
                e.strength,
                f"{e.power:.0%}",
                f"{e.rival} (cos {e.cos:.2f})" if e.rival else "-",
                f"{e.gap:.3g}",
                f"{e.correct:.2f}",
            )
            for e in sorted(self.effects, key=lambda e: -e.correct)
        ]
        lines.append(table(rows))
        alike = [c for c in self.confused if not c["weak"]]
        if alike:
            lines += ["", f"not separated (D below {CLEAR:g}):"]
            lines += [f"  {c['effect']} from {c['rival']}: D {c['d']:.3g}; {c['why']}" for c in alike[:20]]
            if len(alike) > 20:
                lines.append(f"  and {len(alike) - 20} more (--json lists all)")
        weak = [f"{e.effect} ({e.d:.2g})" for e in self.effects if e.d < CLEAR]
        if weak:
            lines += [
                "",
                f"too weak to be noticed at {self.share:g} of the plausible strength (D against none): "
                f"{', '.join(weak)}",
            ]
        if self.unseen:
            lines.append(f"no candidate frame shows: {', '.join(self.unseen)}")
        if self.nested:
            lines.append("contained, and not compared: " + ", ".join(f"{a} in {b}" for a, b in self.nested))
        return "\n".join([*lines, *(f"warning: {w}" for w in self.warnings)]) + "\n"


# -- candidates ------------------------------------------------------------------------------------------------------
def candidates(parameters: dict[str, Parameter], base: dict, swept: bool, fixed_exposure: bool = False) -> list[Choice]:
    """The frames to choose from: every place under several lights and exposures; of a camera of one pixel, sweeps.

    Exposures are factors here, 1 where an image is as bright as it may be; `plan` turns them into settings.
    """
    lights, exposures = (
        keys_with(parameters, "power"),
        [] if fixed_exposure else keys_with(parameters, "exposure")[:1],
    )
    if swept:
        return _sweeps(parameters, base, lights, exposures)
    found = []
    on = {"all lights": tuple(lights)}
    half = len(lights) // 2
    if len(lights) > 3:
        on |= {"first half of the lights": tuple(lights[:half]), "other half of the lights": tuple(lights[half:])}
    single = [{f"{k.rpartition('.')[0]} alone": (k,)} for k in lights] if len(lights) > 1 else []
    places = _places(parameters, base)
    for n, (place, words, settings) in enumerate(places):
        own = dict(on)
        for k in (2 * n, 2 * n + 1):  # two of the lights at each place, so that all are seen at some
            own |= single[k % len(single)] if single else {}
        for light, lit in own.items():
            for factor in (1.0, *advise.EXPOSURES[:1]) if exposures and light == "all lights" else (1.0,):
                found.append(
                    Choice(
                        f"{words}; {light}" + ("" if factor == 1 else f", {factor:g} of the exposure"),
                        place,
                        {**settings, **{k: float(k in lit) for k in lights}, **dict.fromkeys(exposures, factor)},
                    )
                )
    return found + [
        Choice(
            "all lights off", "dark", {**places[0][2], **dict.fromkeys(lights, 0.0), **dict.fromkeys(exposures, 1.0)}
        )
    ]


def _places(parameters: dict[str, Parameter], base: dict) -> list[tuple[str, str, dict]]:
    """(group, words, settings) of the places of a press, distances of an object, angles of films; one place where
    nothing moves."""
    keys = partial(keys_with, parameters)
    if depth := keys("press depth"):
        skin = partial(beside, parameters, depth[0])
        press_x, press_y = skin("press x"), skin("press y")
        wide = [0.3 * float(base.get(skin(side), 8.0)) for side in ("width", "length")]
        normal = 0.12 * float(base.get(skin("thickness"), 4.0))
        spots = [(0.0, 0.0), *advise.places(np.zeros((1, 2)), np.array(wide), 5)]
        found: list[tuple[str, str, dict]] = []
        for i, (x, y) in enumerate(spots):
            for to in (normal, 2 * normal) if i < 3 else (normal,):
                found.append(
                    (
                        f"press-{len(found):02d}",
                        f"press at x = {x:.2g}, y = {y:.2g} mm, {to:.2g} mm deep",
                        {press_x: x, press_y: y, depth[0]: round(to, 4)},
                    )
                )
        return [
            *found,
            (
                "untouched",
                "nothing pressed",
                dict.fromkeys((press_x, press_y, depth[0]), 0.0),
            ),
        ]
    if distance := keys("distance"):
        here = float(base[distance[0]]) or 1.0
        return [
            (f"distance-{i}", f"object at {to:g} mm", {distance[0]: to})
            for i, to in enumerate((here, here / 2, 2 * here, here / 8, 0.0))
        ]
    angles = [k for k in keys("angle") if base.get(beside(parameters, k, "inserted"), 1.0)]
    if angles:
        return [
            (f"angle-{to:g}", f"{angles[0]} = {to:g} deg", {angles[0]: float(base[angles[0]]) + to})
            for to in (0.0, 30.0, 45.0, 60.0, 90.0, 135.0)
        ]
    return [("", "the scene", {})]


def _sweeps(parameters: dict, base: dict, lights: Sequence[str], exposures: Sequence[str]) -> list[Choice]:
    """Sweeps of the analyser, with everything else that a bench turns dealt out to SWEEPS points that cover each
    setting evenly."""
    from scipy.stats import qmc

    switch = {
        k: beside(parameters, k, "inserted") for k in keys_with(parameters, "angle")
    }  # angle -> what takes it out
    inserted = {k: base.get(known, 1.0) for k, known in switch.items()}
    films = [k for k, there in inserted.items() if there and switch[k] in base]
    if not films:
        raise Underdetermined(
            "design: a camera of one pixel and no polarizer to turn: no two readings differ but in brightness; "
            "allowed: a scene "
            "with images (-D width=..., -D height=...) or with a polarizer film"
        )
    swept, *others = films
    levels: dict[str, list[float]] = {
        k: [0.0, 20.0, 45.0, 90.0] for k in (*others, *(k for k in inserted if k not in films))
    }
    levels |= {known: [0.0, 0.0, 1.0] for k, known in switch.items() if known is not None and not inserted[k]}
    levels |= {k: [1.0, 0.4] for k in (*lights, *exposures)}
    if (approach := beside(parameters, swept, "approach")) is not None:
        levels[approach] = [1.0, -1.0]
    points = qmc.Sobol(len(levels), scramble=True, rng=np.random.default_rng(0)).random(64)[:SWEEPS]
    angles = {swept: np.arange(0.0, 180.0, STEP).tolist()}
    found = []
    for row in points:
        own = {k: values[int(u * len(values))] for u, (k, values) in zip(row, levels.items())}
        out = [k for k, there in own.items() if k in switch.values() and not there]
        words = ", ".join(
            f"{k} {v:g}" for k, v in own.items() if not k.startswith(tuple(o.rpartition(".")[0] + "." for o in out))
        )
        found.append(Choice(f"{swept} 0 ... {180 - STEP:g}, {words}", "", own, angles))
    return [*found, Choice("all lights off", "", {**found[0].settings, **dict.fromkeys(lights, 0.0)}, angles)]


# -- the plan --------------------------------------------------------------------------------------------------------
def _checked(scene: Scene, effects: Sequence | None) -> tuple[list, list]:
    """(every effect that the scene can express, those that were asked for); raises BadScene."""
    for part, role in ((scene.camera, "camera"), (scene.integrator, "integrator")):
        if part is None:
            first = next(p for p in scene.registry.parts.values() if p.role == role)
            raise BadScene(
                f"{scene.path}: no part of the type '{first.kind}'; a capture session needs one: add a "
                f'<{first.category} type="{first.kind}">'
            )
    swept = math.prod(scene.camera.resolution) == 1  # readings of a photodiode
    known = [
        e for _, e in sorted(scene.registry.effects.items()) if scene.can_express(e) and not (swept and e.mixes_pixels)
    ]
    effects = list({e.key: e for e in effects or ()}.values())  # an effect named twice would be its own rival
    for e in effects:
        if e not in known:
            raise BadScene(
                f"{scene.path}: the scene cannot express the effect '{e.name}'; it can: "
                f"{', '.join(k.key for k in known)}"
            )
    return known, effects


def _imagined(scene: Scene, pool: Sequence[Choice], noise: Noise) -> SceneModel:
    """A model of the candidates: their settings, and black images that predictions will replace."""
    width, height = scene.camera.resolution
    swept = width * height == 1
    bands = scene.integrator.bands if scene.integrator is not None else ()
    channels = 1 if len(bands or (0,)) == 1 else 3
    if scene.integral is not None:
        channels = len(scene.integral.quantum)
    blank = np.zeros((height, width, channels), np.float32)
    first = Frame("first", blank, parameters=dict(pool[0].readings[0]), file="design")
    table = Table("readings.csv", ["reading"]) if swept else None
    model = SceneModel(scene, Captures(Path("."), str(scene.path), [first], noise=noise, table=table), noise)
    model.frames = []
    return model.imagine(
        [
            Frame(
                f"candidate-{i}",
                np.repeat(blank, len(c.readings), 0) if c.swept else blank,
                group=c.group or None,
                parameters=dict(c.settings),
                file="design",
                readings={k: np.array(v).reshape(-1, 1, 1) for k, v in c.swept.items()},
            )
            for i, c in enumerate(pool)
        ]
    )


def plan(
    scene: Scene,
    frames: int,
    effects: Sequence | None = None,
    *,
    noise: Noise = NOISE,
    values: Values | None = None,
    setup: Setup | None = None,
    added: Sequence = (),
    share: float = SHARE,
    fixed_exposure: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> Plan:
    """Choose `frames` frames of a scene (optics.scene.loader.Scene) that tell its effects apart.

    effects   that may be missing; None: all that the scene can express
    values    of a calibration, in place of the scene's own
    setup     what that calibration solves for (optics.study.setup.Setup); added: effects that it has
    share     of the plausible strength, at which effects are told apart
    fixed_exposure   leave the exposure as the scene has it

    Raises Underdetermined for too few frames or effects, BadScene for a scene without a camera or a light.
    """
    from scipy.special import ndtr

    say = progress or (lambda what, done, total: None)
    _require(frames, share)
    known, effects = _checked(scene, effects)
    setup = setup or Setup(captures="")
    values = Values() if values is None else Values(dict(values.common))
    base = {**scene.values(), **values.common}
    pool = candidates(scene.parameters, base, math.prod(scene.camera.resolution) == 1, fixed_exposure)
    model = _imagined(scene, pool, noise)
    for key in model.driven:
        values.common.setdefault(key, float(base[key]))
    pool = _expose(model, values, pool, base, say)
    places = [c.group or str(i) for i, c in enumerate(pool)]
    depths = keys_with(scene.parameters, "press depth")
    untouched = {
        i for i, c in enumerate(pool) if any(c.settings.get(k) == 0 for k in depths)
    }  # where nobody has to find a place
    solved = [
        v
        for v in variables_of_base(model, setup, range(len(pool)))
        if v.frames is None or not (advise.is_place(model, v.keys[0]) and untouched.issuperset(v.frames))
    ]
    solved += [v for e in added for v in effect_variables(model, e)]
    taken = {key for v in solved for key in v.keys}
    members = [Candidate.at(model, values, e, effect_variables(model, e)) for e in effects or known]
    members = [c for c in members if not any(k in taken for v in c.variables for k in v.keys)]
    if not members:
        raise Underdetermined(
            f"{scene.path}: none of the effects asked for is free to be missing; the calibration solves for them "
            "already"
        )
    evidence = measure(model, values, solved, members, range(len(pool)), ROWS, seed, say, "what candidate frames show")
    diagonal = np.diag(evidence.normal.gram)
    unseen = [
        c.effect.name for c in members if c.broken or not any(diagonal[i] > 0 for own in c.forms.values() for i in own)
    ]
    members = [c for c in members if c.effect.name not in unseen]
    if not members:
        raise Underdetermined(f"{scene.path}: none of {len(pool)} candidate frames shows {' or '.join(unseen)}")
    seen = _outlook(evidence, members, share, seed)

    def worth(chosen: Sequence[int]) -> float:
        """Mean P(correct) over all ordered pairs that can differ, and of each against nothing."""
        gaps, alone = seen.falls(chosen)
        every = np.concatenate([gaps[np.isfinite(gaps)], alone])
        return float(np.mean(ndtr(np.sqrt(np.maximum(every, 0.0)) / 2)))

    chosen: list[int] = []
    path: list[float] = []
    for n in range(frames):
        say("choosing frames", n, frames)
        seen_places = {places[s] for s in chosen}
        fresh = [s for s in range(len(pool)) if places[s] not in seen_places] if len(seen_places) < GROUPS else []
        chosen.append(max(fresh or range(len(pool)), key=lambda s: worth([*chosen, s])))
        path.append(worth(chosen))
    say("choosing frames", frames, frames)
    return _report(scene, [pool[s] for s in chosen], path, seen, chosen, members, share, noise, len(pool), unseen)


def session(
    subject: str | Path,
    frames: int,
    effects: Sequence[str] = (),
    defines: dict | None = None,
    plugins: Named = None,
    noise: dict | None = None,
    share: float = SHARE,
    fixed_exposure: bool = False,
    progress: Progress | None = None,
) -> Plan:
    """Plan a session for a scene by its name, or for a study by its folder: with its values, its noise, and what it has
    added. The frames that a study has are not counted: a session stands by itself.

    Raises as `plan`, and UnknownKey for an effect that nobody knows.
    """
    from optics.scene import loader as scenes
    from optics.study import loop

    _require(frames, share)  # before anything is loaded
    path = Path(subject)
    if (path / "ladder.json").is_file():
        study, model, setup = loop.take_up(path, plugins)
        scene = scenes.load(model.scene.path, {**model.scene.defines, **(defines or {})}, plugins=setup.plugins)
        scene.set(model.captures.parameters)  # what was set in all frames stays so
        chosen = [scene.registry.find_effect(name) for name in effects] or loop.candidates(model, study)
        return plan(
            scene,
            frames,
            chosen,
            noise=replace(model.noise, **(noise or {})),
            setup=setup,
            added=loop.effects_of(study, scene.registry),
            values=Values(dict(study.fit(len(study.steps) - 1)["parameters"])),
            share=share,
            fixed_exposure=fixed_exposure,
            progress=progress,
        )
    file = scenes.find(subject)
    text, defines = file.read_text(encoding="utf-8"), dict(defines or {})
    sizes = {n: re.search(rf'<default name="{n}" value="(\d+)"', text) for n in ("width", "height")}
    usual = {n: int(m[1]) for n, m in sizes.items() if m is not None}
    if len(usual) == 2 and "$width" in text and "$height" in text and not set(usual) & set(defines):
        longest = max(usual.values())
        if longest > LONG_SIDE:
            defines |= {n: str(max(round(size * LONG_SIDE / longest), 1)) for n, size in usual.items()}
    scene = scenes.load(file, defines, plugins=plugins)
    chosen = [scene.registry.find_effect(name) for name in effects]
    return plan(
        scene,
        frames,
        chosen,
        noise=replace(NOISE, **(noise or {})),
        share=share,
        fixed_exposure=fixed_exposure,
        progress=progress,
    )


def _require(frames: int, share: float) -> None:
    if frames < FEWEST:
        raise Underdetermined(
            f"design: {frames} frames; allowed: {FEWEST} or more, as with one nothing can be held out and nothing "
            "compared"
        )
    if frames > FRAMES_MOST:
        raise ValueError(f"design: {frames} frames; allowed: {FEWEST} to {FRAMES_MOST}; a session of more repeats them")
    if not 0 < share < math.inf:
        raise ValueError(f"design: strength of {share:g} plausible sizes; allowed: > 0, finite")


def _expose(model: Any, values: Values, pool: list[Choice], base: dict, say: Progress) -> list[Choice]:
    """Turn factors of the exposure into exposures that fill the camera's range, and put predictions in place of images.

    One exposure per light, the same at all places: what a session can do.
    """
    key = next(iter(keys_with(model.parameters, "exposure")), None)
    lights = keys_with(model.parameters, "power")
    images = model.captures.table is None
    fitting: dict[tuple, float] = {}
    found = []
    for i, c in enumerate(pool):
        say("exposures", i, len(pool))
        own, words = dict(c.settings), c.words
        if key in own:
            light, present = tuple(own.get(k, 1.0) for k in lights), float(base[key])
            if light not in fitting:
                model.frames[i].parameters[key] = present
                fitting[light] = (
                    float(f"{present * _brighter(model, values, i):.3g}") if images and any(light) else present
                )
            own[key] = model.frames[i].parameters[key] = own[key] * fitting[light]
            words += f", exposure {own[key]:g}" if images else ""
        model.frames[i].image = np.minimum(model.predict(values, [i])[0], model.noise.saturation).astype(np.float32)
        found.append(replace(c, settings=own, words=words))
    say("exposures", len(pool), len(pool))
    return found


def _brighter(model: Any, values: Values, frame: int) -> float:
    """Factor on a frame's exposure at which its brightest half per cent stands at FULL of full scale; 1 in the dark."""
    signal = model.predict(values, [frame])[0] - model.noise.black_level
    bright = float(np.quantile(signal, 0.995))
    return FULL * (model.noise.saturation - model.noise.black_level) / bright if bright > 0 else 1.0


def _outlook(evidence: Evidence, members: Sequence[Candidate], share: float, seed: int) -> advise.Outlook:
    """Informations of all candidate frames, every effect at its share of the plausible strength; of one per frame, with
    random signs."""
    rng, squares = np.random.default_rng([seed, 17]), np.diag(evidence.normal.gram)
    found = []
    for c in members:
        c.form, power = _onset(c, squares)
        c.columns = c.forms[c.form]
        signs = np.where(np.array(c.sides) < 0, -1.0, 1.0)
        if len(signs) > 1:  # parts and frames differ from each other: all alike is often what a calibration absorbs
            signs = np.where(np.array(c.sides) == 0, rng.choice([-1.0, 1.0], len(signs)), signs)
        strength = c.linear_of(share * c.plausible * signs) if power == 1 else share**2 * c.plausible * signs
        member = advise.Member(c.effect.name, [], [], [])
        for v, column, side, size in zip(c.variables, c.columns, c.sides, strength.tolist()):
            if v.frames is None:
                member.columns.append(column)
                member.sides.append(side)
                member.strength.append(size)
            else:
                member.bring(v.frames[0], column, side, size)
        found.append(member)
    grams = advise.informations(evidence)
    return advise.Outlook(
        np.zeros_like(evidence.normal.gram),
        grams,
        evidence.base,
        evidence.precision,
        found,
        [[] for _ in grams],
        evidence.normal.truncation(evidence.base),
        advise.nested_in(members),
    )


def _onset(c: Candidate, squares: np.ndarray) -> tuple[str, int]:
    """Which derivative images describe an effect at a small strength, and the power of the strength that they grow
    with.

    Where both are at hand the tangent, unless it is nothing beside the finite step: then the onset is quadratic.
    """
    if len(c.forms) < 2:
        return next(iter(c.forms)), 1
    tangent, secant = (float(sum(squares[i] for i in c.forms[form])) for form in ("tangent", "secant"))
    if tangent > 0.01 * secant:
        return "tangent", 1
    return "secant", 1 if any(v.parameter.squared for v in c.variables) else 2


def _report(
    scene: Scene,
    frames: Any,
    path: Any,
    seen: Any,
    chosen: Any,
    members: Any,
    share: float,
    noise: Noise,
    count: int,
    unseen: Any,
) -> Plan:
    gaps, alone = seen.falls(chosen)
    information, rest = seen.information(chosen)
    names = [m.name for m in seen.members]
    share_left = np.divide(gaps, alone[:, None], out=np.full_like(gaps, np.inf), where=alone[:, None] > 0)
    cos = np.sqrt(
        np.maximum(1 - share_left, 0.0)
    )  # of what a calibration leaves of both; 0 where there is nothing to compare
    effects, confused = [], []
    for i, (m, c) in enumerate(zip(seen.members, members)):
        columns, sides, strength = m.at(chosen)
        own = [rest.index(k) for k in columns]
        cone = st.Cone(information[np.ix_(own, own)], sides, draws=2000)
        power = cone.power(strength, cone.critical(LEVEL / len(names))) if len(cone.live) else 0.0
        j = int(np.argmin(gaps[i]))
        rival, gap = (names[j], gaps[i, j]) if math.isfinite(gaps[i, j]) else ("", alone[i])
        parameter = c.variables[0].parameter
        effects.append(
            Power(
                m.name,
                f"{share * parameter.plausible:.2g}{spaced(parameter.unit)}",
                float(alone[i]),
                float(power),
                rival,
                float(gap),
                float(cos[i, j]),
            )
        )
        confused += [
            {
                "effect": m.name,
                "rival": names[k],
                "d": float(gaps[i, k]),
                "weak": bool(alone[i] < CLEAR),
                "why": f"what a calibration leaves of them has cos {cos[i, k]:.3f}; D {alone[i]:.3g} against none",
            }
            for k in np.flatnonzero(gaps[i] < CLEAR)
        ]
    confused.sort(key=lambda c: (c["weak"], c["d"]))
    nested = [(names[a], names[b]) for a, b in sorted(seen.nested)]
    warnings = []
    groups = len({f.group for f in frames}) if any(f.group for f in frames) else len(frames)
    if groups < GROUPS and not frames[0].swept:  # readings are dealt out to sweeps, of which there are enough
        warnings.append(
            f"{groups} presses or places: fewer than {GROUPS} groups are not held out by themselves, and without "
            "held-out frames "
            "there is no CLAIM; plan more frames, or name one with --hold-out"
        )
    name = scene.path.stem if scene.path.parent == shipped("scenes") else str(scene.path)
    return Plan(
        name,
        frames,
        path,
        effects,
        confused,
        share,
        noise,
        count,
        tuple(scene.camera.resolution),
        nested,
        unseen,
        warnings,
    )


# -- what to fill in -------------------------------------------------------------------------------------------------
def write(planned: Plan, folder: str | Path) -> Path:
    """Write a folder with a captures.toml that lists the frames to take, without images. Raises OutputExists."""
    import tomlkit

    folder = Path(os.path.abspath(folder))
    document = tomlkit.document()
    # not captures.MARK: once its images are in, the folder is a measured set, which no writing of captures may replace
    document.add(
        tomlkit.comment(
            "A session to be taken, planned by optics. Put each image where `image` says, correct what you set "
            "otherwise,"
        )
    )
    document.add(tomlkit.comment("and put your camera's numbers under [noise]."))
    document["scene"] = planned.scene
    document["noise"] = noise_table(planned.noise)
    if planned.size == (1, 1):
        document["table"] = {"file": "readings.csv", "values": ["reading"]}
    else:
        tables = document["frames"] = tomlkit.aot()
        for i, f in enumerate(planned.frames):
            table = tomlkit.table()
            table.add("image", tomlkit.item(f"frames/{i:03d}.png").comment(f.words))
            if f.group:
                table["group"] = f.group
            table["parameters"] = {k: float(v) for k, v in f.settings.items()}
            tables.append(table)
    with new_folder(folder) as new:
        if planned.size == (1, 1):
            blank: list[Any] = [""]
            rows = [readings.Row(dict(own), blank) for f in planned.frames for own in f.readings]
            readings.write(new / "readings.csv", rows, ["reading"])
        else:
            (new / "frames").mkdir()
        (new / FILE).write_text(tomlkit.dumps(document), encoding="utf-8")
    return folder
