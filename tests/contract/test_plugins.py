"""The contract that the library relies on, held against every part and effect that a scan finds.

A user's plugins are held to it as well: `pytest tests/contract --plugin-folder DIR`. The checks are plain functions, so
that the tests at the end can show that each of them notices what it is there for."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from optics.errors import BadPlugin
from optics.files.output import shipped
from optics.scene import checking
from optics.scene.declare import IMAGE_STAGES, Effect
from optics.scene.loader import find, shipped_scenes
from optics.scene.registry import Registry, known

REGISTRY = known()
PARTS = sorted(REGISTRY.parts)
# parts that light is followed through by Monte Carlo: their contract is in test_monte_carlo.py
MONTE_CARLO = ("clear", "cells", "block", "room")
EFFECTS = sorted(k for k, e in REGISTRY.effects.items() if e.part not in MONTE_CARLO)


def parameters_tested(kind):
    """The parameters that are tested on a kind of part: of one that stands in for another camera or gel, those that the
    other has not been brought as well."""
    part, all_of_it = REGISTRY.parts[kind], REGISTRY.parameters_of(kind)
    if part.role not in ("camera", "gel") or part.role == kind:
        return all_of_it
    return [p for p in all_of_it if p in part.parameters or p not in REGISTRY.parameters_of(part.role)]


NUMBERS = [(kind, p.name) for kind in PARTS if kind not in MONTE_CARLO for p in parameters_tested(kind) if p.is_number]
LAYERS = [kind for kind in PARTS if REGISTRY.parts[kind].mueller is not None]
# of forces, which no image shows, and of a drag's slip; of a twist, one rim gains what another loses. The physics
# tests hold them against closed forms
LABELS_ONLY = tuple(("gel", name) for name in ("young", "poisson", "friction", "twist"))
DRAGGING = ("shift_x", "shift_y")  # of a gel: they move what it carries
POWERS = ("power", "band power")  # roles
MOVED = ("carried", "markers", "target", "beads")  # kinds of shapes that a scene moves besides the gel
OF_IMAGES = tuple(s for s in IMAGE_STAGES if s != "sensitivity")  # stages whose functions are given an image
LAYERED = ("layer", "detector", "glow")  # stages whose functions are differentiated by complex step
SECTIONS = ("Definition", "Fingerprint", "Validity", "References")
UNITS = {
    "1",
    "N",
    "mm",
    "mm^2",
    "deg",
    "rad",
    "nm",
    "px",
    "px^2",
    "DN",
    "1/mm",
    "1/mm^2",
    "MPa",
    "1e-12/Pa",
    "N/mm^3",
    "-",
}

IDENTITY = 1e-6  # of full scale: ten roundings of float32
FLOAT = 3e-7  # relative rounding of an image in float32: what a difference of two images cannot resolve

FILMS = ("analyzer", "middle", "polarizer")
SURROUNDINGS = {  # parameter: what has to stand about it for it to be seen, and for its onset to be smooth
    # one ball in place of fifty, of whose many shadows some edge always passes a sample; and no kink of (S3), which a
    # far light's turn sends across many pixels
    **{
        key: {"membrane.sigma": 0.0, "gel.indenter": "sphere", "gel.indenter_size": 1.5}
        for key in ("led.turn", *(f"board.{name}" for name in ("x", "y", "z", "rx", "ry", "rz", "scale")))
    },
    # the part's Validity: of polarized light, and behind two films, a film without a leak leaks as sqrt(T2) at first
    "polarizer_film.leak": {"middle.inserted": 0.0, "source.dop_q": 0.0, "source.dop_u": 0.0},
    # below 0 a leak is cut off
    "polarizer_film.leak_tilt": {f"{film}.leak": 0.01 for film in FILMS},
    # they stiffen a held skin, whose dent they shape where it is the elastic one
    "gel.springs": {"gel.backing": "held", "gel.dent_model": "elastic"},
    # what a ball does not show
    **{
        f"gel.press_r{axis}": {
            "gel.indenter": "cube",
            "gel.indenter_size": 6.0,
            "gel.press_rx": 25.0,
            "gel.press_ry": 20.0,
            "gel.press_rz": 30.0,
        }
        for axis in "xyz"
    },
    "gel.indenter_spacing": {"gel.indenter": "balls", "gel.indenter_size": 0.8, "gel.indenter_spacing": 1.8},
    "gel.evened": {
        "gel.indenter": "balls",
        "gel.indenter_size": 0.8,
        "gel.indenter_spacing": 1.8,
        "gel.curve_xx": -0.01,
        "gel.curve_yy": -0.01,
    },
    "gel.stretch_gain": {"gel.stretch": 0.05, "gel.stretch_xx": 0.002, "gel.stretch_yy": 0.003},
    **dict.fromkeys(
        (f"gel.stretch{axes}" for axes in ("", "_x", "_y", "_xx", "_xy", "_yy")), {"gel.stretch_gain": 0.3}
    ),
    "gel.shown_between": {"gel.indenter": "balls", "gel.indenter_size": 0.8, "gel.indenter_spacing": 1.8},
    "gel.thickness": {"gel.absorption": 0.02},
    # off the middle, where stick turns into slip, and without the film, as for the depth of a press
    **{f"gel.{name}": {f"skin.{name}": 0.3, "film.inserted": 0.0} for name in DRAGGING},
    "elastic_skin.thickness": {"gel.absorption": 0.02},
    "camera.focus": {"camera.pupil_area": 2.0},
    "fisheye.focus": {"camera.pupil_area": 2.0},
    "beads.gravity": {"beads.settling": 0.3},
    "fluorescent.bleaching": {"dye.time": 3.0},
    "fluorescent.time": {"dye.bleaching": 0.05},
    **{f"elastic_skin.{name}": {f"gel.{name}": 8.0} for name in ("width", "length")},  # its rim in view
    **{f"strip.{name}": {"strip_red.phosphor_leak": 0.1} for name in ("die_wavelength", "die_width")},
    **{f"ring.{name}": {"inner_ring.phosphor_leak": 0.1} for name in ("die_wavelength", "die_width")},
    **{f"{kind}.settling": {f"{kind}.drift": 0.02, f"{kind}.time": 3.0} for kind in ("source", "panel")},
    # the clock of the first scene whose camera has one
    "camera.dark_drift": {"source.time": 3.0},
    "camera.dark_settling": {"source.time": 3.0, "camera.dark_drift": 2e-3},
    # the first direction of a carried film is constant in each triangle: a film that bends makes small jumps
    "gel.press_depth": {"film.inserted": 0.0},
    **{f"carried.{name}": {"skin.press_depth": 0.0} for name in ("width", "length", "depth")},
}


def is_dear(kind, name):
    """Whether a number of a light of many points is one of an LED too, whose formula it takes: its kernels take seconds
    to compile."""
    alike = ("led", name) in NUMBERS and name not in ("x", "pan", "fwhm")  # of each kind of number one is tried
    return kind in ("strip", "ring") and alike


def ways(how, often=True):
    """Parameters whose derivative is made in one way; without `often`, all but the first of each part are slow."""
    own = [n for n in NUMBERS if REGISTRY.parameter(*n).how == how and n not in LABELS_ONLY]
    first = dict(reversed(own))
    slow = [is_dear(*n) or not (often or first[n[0]] == n[1]) for n in own]
    return [pytest.param(*n, id=".".join(n), marks=[pytest.mark.slow] * s) for n, s in zip(own, slow)]


def settling():
    """Every effect, and every parameter with a neutral value that none frees, as an effect of its own."""
    freed = {(e.part, name) for e in REGISTRY.effects.values() for name in e.parameter_names}
    alone = [
        Effect(f"{kind} {name}", kind, (name,))
        for kind, name in NUMBERS
        if REGISTRY.parameter(kind, name).neutral is not None and (kind, name) not in freed
    ]
    found = (*(REGISTRY.effects[k] for k in EFFECTS), *alone)
    return [
        pytest.param(e, id=e.key, marks=[pytest.mark.slow] * all(is_dear(e.part, name) for name in e.parameter_names))
        for e in found
    ]


# -- what a plugin says about itself ---------------------------------------------------------------------------------
def check_documentation(item):
    """The four sections, each with a text."""
    name = item.kind if not isinstance(item, Effect) else item.name
    lines = item.doc.strip().splitlines()
    assert lines and re.match(r".+: .+", lines[0]), f"{name}: the first line is not 'Name: what it is.'"
    found = {s: [i for i, line in enumerate(lines) if line.strip() == s] for s in SECTIONS}
    for section, where in found.items():
        assert len(where) == 1, f"{name}: {len(where)} sections '{section}'; one is needed"
        assert lines[where[0] + 1 :] and lines[where[0] + 1].strip(), f"{name}: the section '{section}' is empty"
    order = [found[s][0] for s in SECTIONS]
    assert order == sorted(order), f"{name}: the sections are not in the order {', '.join(SECTIONS)}"


def check_declaration(p):
    """Unit, bounds, neutral value and plausible size make sense together."""
    assert re.fullmatch(r"[a-z][a-z0-9_]*", p.name), f"{p.name}: not a lower-case word"
    assert p.doc, f"{p.name}: no documentation"
    assert p.unit in UNITS, f"{p.name}: unit {p.unit!r} is none of {', '.join(sorted(UNITS))}"
    if not p.is_number:
        assert p.default in p.choices
        return
    low, high = p.bounds
    assert low < high
    assert low <= p.default <= high
    assert math.isfinite(p.plausible) and p.plausible > 0
    assert p.plausible <= high - low, f"{p.name}: a plausible change of {p.plausible} leaves the bounds {p.bounds}"
    if p.neutral is not None:
        assert low <= p.neutral <= high
        assert p.neutral + p.plausible <= high or p.neutral - p.plausible >= low


def check_effect_declaration(effect, reg):
    parameters = reg.effect_parameters(effect)
    assert parameters, f"{effect.name}: frees nothing"
    for p in parameters:
        assert p.is_number and p.neutral is not None
        assert p.default == p.neutral, f"{p.name}: rests at {p.default}, which is not its neutral value {p.neutral}"
    freed = {name for e in reg.effects.values() if e.part == effect.part for name in e.parameter_names}
    for p in effect.shape:
        assert p.neutral is None or p.name in freed, f"{p.name}: a shape that no effect frees has no neutral value"
    assert effect.acts and effect.needs, f"{effect.name}: says not through what it acts or what it needs"
    assert effect.scope in ("common", "frame") and effect.per in ("kind", "part")
    for stage in effect.stages:
        how = {p.how for p in parameters}
        for own, stages in (("image", IMAGE_STAGES), ("layer", LAYERED)):
            assert (stage in stages) == (how == {own}), f"{effect.name}: derivatives by {how} at the stage '{stage}'"


@pytest.mark.parametrize("kind", PARTS)
def test_parts_document_and_declare_themselves(kind, mitsuba):
    part = REGISTRY.parts[kind]
    check_documentation(part)
    for p in REGISTRY.parameters_of(kind):
        check_declaration(p)
    if part.mueller is not None or part.stokes is not None:
        for p in REGISTRY.parameters_of(kind):
            assert not p.is_number or p.how == ("ad" if part.stokes and p.role in POWERS else "layer"), (
                f"{kind}.{p.name}: {p.how}"
            )


@pytest.mark.parametrize("key", sorted(REGISTRY.effects))
def test_effects_document_and_declare_themselves(key, mitsuba):
    effect = REGISTRY.effects[key]
    check_documentation(effect)
    check_effect_declaration(effect, REGISTRY)


ITEMS = [pytest.param(item, id=f"part {kind}") for kind, item in sorted(REGISTRY.parts.items())]
ITEMS += [pytest.param(item, id=f"effect {key}") for key, item in sorted(REGISTRY.effects.items())]


def is_shipped(item):
    return Path(item.file).is_relative_to(shipped("plugins").resolve())


# Whose checks take seven seconds and more: among the slow tests.
COSTLY = ("twisted-plate", "finite-layer")


@pytest.mark.parametrize(
    "item",
    [pytest.param(*i.values, id=i.id, marks=[pytest.mark.slow] * (i.id.split()[-1] in COSTLY)) for i in ITEMS],
)
def test_plugins_meet_their_own_closed_forms(item, mitsuba):
    """Every check that the file carries; a file that ships carries one at least."""
    assert item.checks or not is_shipped(item), f"{item.file}: carries no check"
    for check in item.checks:
        check()


@pytest.mark.parametrize("item", [i for i in ITEMS if is_shipped(i.values[0])])
def test_a_file_that_ships_has_the_name_of_what_it_declares(item):
    """The effect's key with underscores, or the part's kind; `room` is a source of another name."""
    name = item.key.replace("-", "_") if isinstance(item, Effect) else item.kind
    assert Path(item.file).stem == {"room": "source"}.get(name, name)


def own_parameters(item, registry=REGISTRY):
    """The parameters whose plausible values an item's sampler draws: an effect's with those that shape it."""
    if not isinstance(item, Effect):
        return item.parameters
    return (*registry.effect_parameters(item), *item.shape)


@pytest.mark.parametrize("item", ITEMS)
def test_samplers_draw_plausible_values(item):
    """Values of its own numbers alone, within bounds and not all the same; the same ones from the same generator."""
    kinds = REGISTRY.kinds(item.part if isinstance(item, Effect) else item.kind)
    own = {p.name: p for kind in kinds for p in REGISTRY.parameters_of(kind)}
    draws = [checking.draw(item, own_parameters(item), np.random.default_rng(seed)) for seed in (1, 1, 2)]
    for values in draws:
        for name, value in values.items():
            own[name].check(value, name)
    assert draws[0] == draws[1] and (draws[0] != draws[2] or not draws[0])
    if item.random is not None:
        named = item.random(np.random.default_rng(1)).keys()
        assert named <= own.keys(), (
            f"{item.file}: draws {', '.join(sorted(named - own.keys()))}, which it does not have"
        )


# -- where a parameter is seen ---------------------------------------------------------------------------------------
class Material:
    """A material alone, as a bench, for materials that only mi.render can pass: it reflects (left) and transmits a
    smooth
    world.

    Rows of the image are directions of sight, channels S0, S1 and S3; the mean over a grid of sampled directions has no
    noise."""

    SIDE = 32  # of the grid

    def __init__(self, mi, kind):
        from optics.scene import loader as scene

        self.mi = mi
        self.bsdf = mi.load_dict({"type": kind, "id": "sample"})
        parameters = {f"sample.{name}": p for name, p in self.bsdf.numbers.items()}
        self.values = {key: p.default for key, p in parameters.items()}
        self.values.update({k: v for k, v in {"sample.index": 1.3, "sample.alpha": 0.2}.items() if k in parameters})
        self.scene = SimpleNamespace(registry=REGISTRY, parts={"sample": self.bsdf}, parameters=parameters, gel=None)
        self.scene.check = lambda values: scene.Scene.check(self.scene, values)
        self.scene.set = lambda values: None
        self.renderer = SimpleNamespace(kind=lambda key: kind, bounce_key="")
        polar = np.radians([5.0, 40.0, 55.0, 150.0]).repeat(self.SIDE**2)  # the last one from behind
        u = (np.arange(self.SIDE) + 0.5) / self.SIDE
        self.grid = mi.Point2f(*(np.tile(a.ravel(), 4).astype("f") for a in np.meshgrid(u, u)))
        self.si = mi.SurfaceInteraction3f()
        self.si.t = mi.Float(np.ones(polar.size, "f"))
        self.si.wi = mi.Vector3f(*(a.astype("f") for a in (0.8 * np.sin(polar), 0.6 * np.sin(polar), np.cos(polar))))

    def image(self, values=None):
        import drjit as dr

        held = self.mi.traverse(self.bsdf)
        for key, value in {**self.values, **(values or {})}.items():
            held[key.rsplit(".", 1)[1]] = dr.opaque(self.mi.Float, value)
        held.update()
        return np.stack([self.seen(way) for way in (0, 1)], 1)

    def seen(self, way):
        import drjit as dr

        context = self.mi.BSDFContext()
        context.component = way
        bs, weight = self.bsdf.sample(context, self.si, self.mi.Float(0.5), self.grid, True)
        world = dr.select(bs.pdf > 0, 1 + 0.5 * bs.wo.x + dr.square(bs.wo.z), 0.0)
        channels = [weight[i, j][0] * world for i, j in ((0, 0), (1, 0), (3, 2))]
        dr.eval(channels)
        return np.stack([np.array(c, float).reshape(4, -1).mean(1) for c in channels], -1)

    def derivative(self, key, values=None):
        """By differences, as the model takes it of parameters that declare 'difference'."""
        p, now = self.scene.parameters[key], {**self.values, **(values or {})}
        return differences(lambda v: self.image({**now, key: v}), now[key], p.step * p.plausible, p.bounds)[0]


# scenes whose images are made LED by LED
SHIPPED = [n for n in shipped_scenes() if 'type="clear"' not in find(n).read_text(encoding="utf-8")]
# scenes that are dark at rest, and those whose interface is not there: for what no other scene has
LAST = {"colour_bench": None, "particle_gel": "interface"}


def kinds_for(thing, name=""):
    """The kinds of parts with which a kind, or an effect, and its parameter `name` are seen; its own comes first."""
    kinds = (thing.part, *thing.requires) if isinstance(thing, Effect) else (thing,)
    part = REGISTRY.parts[kinds[0]]
    for effect in REGISTRY.effects.values():  # what an effect brings to a part is seen where the effect is
        brought = [p.name for p in (*effect.parameters, *effect.shape) if not isinstance(p, str)]
        if effect.part == part.kind and name in brought:
            kinds += effect.requires
    if any(p.name == name and p.role == "light turn" for p in part.parameters):
        kinds += ("board",)
    return kinds


@lru_cache(None)
def scenes_for(kinds):
    """(scene, own kinds of the first part there) for each shipped scene with parts of these kinds, the best first.

    Those with the kinds themselves come before those where others play their roles."""
    order = sorted(
        shipped_scenes(),
        key=lambda n: (
            n != "gelsight",
            n.startswith("polari") and n != "polarizer_bench",
            LAST.get(n, "") in (None, kinds[0]),
            n,
        ),
    )
    texts = {name: find(name).read_text(encoding="utf-8") for name in order}
    return [
        (name, meant(kinds[0]))
        for meant in (lambda kind: (kind,), REGISTRY.kinds)
        for name, text in texts.items()
        if 'type="clear"' not in text and all(any(f'type="{k}"' in text for k in meant(kind)) for kind in kinds)
    ]


TAKEN = {}  # (scene, kinds, name of a parameter) -> whether it does anything there; what is known needs no scene


@pytest.fixture
def bench_of(benches, mitsuba):
    """The bench on which a kind of part, or an effect, is seen; its parameters are put back afterwards."""
    used = []

    def takes(scene, own, name):
        if (scene, own, name) not in TAKEN:
            holders = [p for p in benches(scene).scene.parts.values() if p.kind in own]
            for n in {name, *(p.name for kind in own for p in REGISTRY.parameters_of(kind))}:
                TAKEN[scene, own, n] = any(p.takes(n) for p in holders)
        return TAKEN[scene, own, name]

    def seen_on(thing, name=""):
        kinds = kinds_for(thing, name)
        named = thing.parameter_names if isinstance(thing, Effect) else (name,) if name else ()
        for scene, own in scenes_for(kinds):
            if all(takes(scene, own, n) for n in named):
                used.append(benches(scene))
                return used[-1]
        part = REGISTRY.parts[kinds[0]]
        if part.mueller is not None:
            used.append(benches("polarizer_bench", slot=part.kind))
            return used[-1]
        if part.category == "bsdf":
            return Material(mitsuba, part.kind)
        pytest.fail(f"no shipped scene has parts of the kinds {', '.join(kinds)}; what they declare cannot be tested")

    yield seen_on
    for bench in used:
        bench.scene.set(bench.values)


def bench_asked(fixtures, values):
    """By which `conftest.py` orders the tests, from a test's fixtures and parameters: (the scene that it loads, what it
    tests there); the scene is "" for none, "~" (after all others) for one of its own."""
    if not {"bench", "benches", "bench_of"} & set(fixtures):
        return ("~" if "load_bench" in fixtures else "", "")
    if "bench_of" not in fixtures:
        return ("gelsight" if "bench" in fixtures else values.get("name", "polarizer_bench"), "")
    kind, name = values.get("kind", "markers"), values.get("name", "")
    thing = values.get("effect") or REGISTRY.effects.get(values.get("key")) or kind
    found = scenes_for(kinds_for(thing, name))
    return (found[0][0] if found else "polarizer_bench", getattr(thing, "key", f"{kind}.{name}"))


def keys(bench, kind, name):
    own = [n for n, p in bench.scene.parts.items() if p.kind == kind]
    own = own or [n for n, p in bench.scene.parts.items() if p.role == kind]
    return [f"{n}.{name}" for n in own]


def key_of(bench, kind, name):
    return keys(bench, kind, name)[0]


def about(bench, key):
    """The bench's values, with the values of other parameters that make this one visible."""
    kind, name = bench.renderer.kind(key), key.rsplit(".", 1)[1]
    return {**bench.values, **companions(bench, kind, name), **surroundings(bench, kind, name)}


def surroundings(bench, kind, name):
    return {k: v for k, v in SURROUNDINGS.get(f"{kind}.{name}", {}).items() if k in bench.values}


def companions(bench, kind, name):
    """Other parameters of the same effect at a plausible value: an exponent shows only where its lobe is there."""
    values = {}
    for effect in bench.scene.registry.effects.values():
        if effect.part == kind and name in (p.name for p in effect.shape):
            for p in bench.scene.registry.effect_parameters(effect):
                for holder in (n for n, part in bench.scene.parts.items() if part.kind == kind):
                    values[f"{holder}.{p.name}"] = inward(p, p.neutral, p.plausible)
    return values


def inward(p, value, step):
    """value + step, or value - step where that leaves the bounds."""
    return value + step if value + step <= p.bounds[1] else value - step


def places(bench, key, p, base):
    """Where a derivative is tested: at neutral, unless it means nothing there, and away from it where that costs
    little.

    A parameter without a neutral value is tested at the working point in place of neutral.
    """
    kind, here = bench.renderer.kind(key), base[key] if p.neutral is None else p.neutral
    away = inward(p, here, 0.7 * p.plausible)
    if any(
        e.onset == "secant"
        for e in bench.scene.registry.effects.values()
        if e.part == kind and p.name in e.parameter_names
    ):
        return (away,)
    if p.how == "difference":  # on one side of 0 a difference does not know that the slope of a square is 0
        return (away,) if p.squared else (here,)
    return (here, away)


def differences(f, value, step, bounds):
    """Derivative of f by differences of second order, central or, next to a bound, one-sided (and the values it
    used)."""
    if bounds[0] <= value - step and value + step <= bounds[1]:
        return (f(value + step) - f(value - step)) / (2 * step), (value - step, value + step)
    s = step if value + 2 * step <= bounds[1] else -step
    return (-3 * f(value) + 4 * f(value + s) - f(value + 2 * s)) / (2 * s), (value, value + s, value + 2 * s)


def calm(bench, key, values, base):
    """Pixels that contain no rim (of a shadow or of the face) at any of the values: elsewhere an edge crosses
    samples."""
    rim = np.zeros(bench.model.shape[:2], bool)
    for value in values:
        now = {**base, key: value}
        for led in bench.model.lit(now):
            rim |= bench.renderer.shadows(now, led)[0]
    return ~rim


def moves(bench, key):
    """Whether the parameter moves geometry, and with it the rims of shadows."""
    kind, name = bench.renderer.kind(key), key.rsplit(".", 1)[1]
    return (
        (kind in MOVED or any(kind in bench.scene.registry.kinds(role) for role in ("gel", "camera", "interface")))
        and bench.scene.parameters[key].how == "difference"
        or (
            kind in bench.scene.registry.kinds("led")
            and name in ("x", "y", "z", "turn", "area", "length", "width", "roll", "radius")
        )
        or kind == "board"
    )


# -- effects at and near neutral -------------------------------------------------------------------------------------
def beside(p):
    """A value next to neutral. Functions are evaluated there; at neutral itself the program skips them."""
    return inward(p, p.neutral, 1e-30 if p.neutral == 0 else 4e-16 * abs(p.neutral))


def at(bench, effect, value):
    """Values of an effect's own parameters in all parts that have them: value(p)."""
    return {
        k: value(p) for p in bench.scene.registry.effect_parameters(effect) for k in keys(bench, effect.part, p.name)
    }


def check_identity(bench, effect):
    """With its functions evaluated at neutral the image is the image without them."""
    gel = bench.scene.gel
    for press in ({}, {f"{gel.name}.press_depth": 0.0}) if gel is not None else ({},):
        before, after = (bench.image({**at(bench, effect, value), **press}) for value in (lambda p: p.neutral, beside))
        off = np.abs(after - before)
        # a part that builds its shape in another way for the parameter may move a few samples of a rim
        built = not effect.stages and any(moves(bench, k) for k in at(bench, effect, beside))
        off = off.mean() if built else off.max()
        assert off <= IDENTITY, f"{effect.name}: {off:.2g} of full scale"


def at_rest(bench, effect, p):
    """The bench's values with an effect at neutral, and with what makes one of its parameters visible."""
    return {**bench.values, **at(bench, effect, lambda q: q.neutral), **surroundings(bench, effect.part, p.name)}


def moved(bench, effect, p, step):
    """Image with one parameter of an effect set off neutral in all parts that have it."""
    return bench.image(
        {**at_rest(bench, effect, p), **dict.fromkeys(keys(bench, effect.part, p.name), p.neutral + step)}
    )


def directions(p):
    return [s for s in (1, -1) if p.bounds[0] <= p.neutral + s * p.plausible <= p.bounds[1]]


def check_continuity(bench, effect):
    """A ten-thousandth of a plausible strength changes the image by about as little of what the plausible one
    changes."""
    for p in bench.scene.registry.effect_parameters(effect):
        rest = bench.image(at_rest(bench, effect, p))
        if p.role == "pupil" and bench.renderer.crowded:
            # Behind a pupil other samples are taken, so many that they err as much: the image changes by their errors,
            # up and down, and on the whole by next to nothing.
            sharp, rest = rest, moved(bench, effect, p, 1e-6 * p.plausible)
            jump = rest - sharp
            assert abs(jump.mean()) < 0.1 * np.abs(jump).mean(), f"{effect.name}: {p.name} jumps at neutral"
        for sign in directions(p):
            whole = np.abs(moved(bench, effect, p, sign * p.plausible) - rest).mean()
            little = np.abs(moved(bench, effect, p, sign * 1e-4 * p.plausible) - rest).mean()
            assert whole > 1e-7, f"{effect.name}: a plausible {p.name} does nothing to the bench"
            # 20 times: an onset like a square root, which ranking by a finite step can still use, would give 100. The
            # floor: a single sample of the 16 of a rim that flips is worth up to 1e-6 of the mean; in a crowded scene
            # it is one of six, and which of a bead's rays are lit changes with it.
            floor = 5e-6 if getattr(bench.renderer, "crowded", False) else 1e-6
            assert little <= 20e-4 * whole + floor, f"{effect.name}: {p.name} jumps by {little:.2g} at neutral"


def check_onset(bench, effect):
    """The slope from neutral agrees within 5 % when a step of 3 % of plausible is halved twice, or a secant is
    declared."""
    if effect.onset == "secant":
        return
    for p in bench.scene.registry.effect_parameters(effect):
        rest = bench.image(at_rest(bench, effect, p))
        sign, *back = directions(p)
        steps = [sign * p.plausible / n for n in (32, 64, 128)] + [-sign * p.plausible / 128] * len(back)
        slopes = [(moved(bench, effect, p, h) - rest) / h for h in steps]
        keep = np.ones(rest.shape[:2], bool)
        for key in keys(bench, effect.part, p.name):
            if moves(bench, key):
                keep &= calm(bench, key, [p.neutral, *(p.neutral + h for h in steps)], at_rest(bench, effect, p))
        size = np.linalg.norm(slopes[2][keep])
        assert size > 0, f"{effect.name}: the image does not feel {p.name} at neutral; declare onset='secant'"
        for one, other, h in zip(slopes, slopes[1:], steps[1:]):  # the last pair: the slope on the other side
            off = np.linalg.norm((one - other)[keep])
            rounding = FLOAT * np.linalg.norm(rest) / abs(h)
            assert off <= 0.05 * size + rounding, (
                f"{effect.name}: the slope in {p.name} changes by {off / size:.0%} when the step is halved or turned "
                "round"
            )


@pytest.mark.parametrize("key", EFFECTS)
def test_an_effect_at_neutral_is_not_there(key, bench_of):
    effect = REGISTRY.effects[key]
    check_identity(bench_of(effect), effect)


@pytest.mark.slow
@pytest.mark.parametrize("effect", settling())
def test_what_has_a_neutral_value_sets_in_continuously(effect, bench_of):
    check_continuity(bench_of(effect), effect)


@pytest.mark.slow
@pytest.mark.parametrize("key", EFFECTS)
def test_an_effect_sets_in_linearly_or_says_that_it_does_not(key, bench_of):
    effect = REGISTRY.effects[key]
    check_onset(bench_of(effect), effect)


def without(folder, name, *shapes):
    """A file of a shipped scene without some of its shapes."""
    from optics.scene import loader as scene

    text = scene.find(name).read_text(encoding="utf-8")
    for shape in shapes:
        text, count = re.subn(rf'<shape type="\w+" id="{shape}">.*?</shape>', "", text, flags=re.S)
        assert count == 1
    file = folder / f"{name}.xml"
    file.write_text(text, encoding="utf-8")
    return file


def test_a_window_of_index_1_is_not_there(bench, tmp_path):
    """An effect without functions, which is never left out: the scene with and without the window."""
    from optics.light.renderer import Renderer
    from optics.scene import loader as scene

    file = without(tmp_path, "gelsight", "front")
    width, height = bench.scene.camera.resolution
    renderer = Renderer(scene.load(file, {"width": width, "height": height}))
    values = {k: v for k, v in bench.values.items() if k in renderer.scene.parameters}
    exposure = values["camera.exposure"]
    for led in bench.model.lit(values):
        found, expected = (
            r.led(values if r is renderer else bench.values, led).radiance for r in (bench.renderer, renderer)
        )
        assert np.abs(found - expected).max() * exposure <= 10 * IDENTITY  # a ray that starts again is rounded again


def test_a_sheet_at_rest_and_a_film_taken_out_are_not_there(benches, tmp_path):
    """A sheet whose parameters all rest, and a film that is not inserted: the bench with and without their plates."""
    from optics.scene import loader as scene

    bench = benches("polarizer_bench")
    file = without(tmp_path, "polarizer_bench", "middle_plate", "sample_plate")
    values = {
        **bench.values,
        "middle.inserted": 0.0,
        **{f"sample.{p.name}": p.neutral for p in bench.scene.registry.parameters_of("sheet") if p.neutral is not None},
    }
    defines = {k: v for k, v in bench.scene.defines.items() if k not in ("middle", "pattern")}
    bare = type(bench)(scene.load(file, defines), values)
    assert np.abs(bare.image() - bench.image(values)).max() <= IDENTITY


@pytest.mark.slow
def test_a_rough_boundary_of_index_1_is_not_there_in_a_render(benches, tmp_path):
    """mi.render with and without it in the sample slot, at the roughness of the working point."""
    from optics.light.rendering import RenderJob
    from optics.scene import loader as scene

    bench = benches("polarizer_bench", slot="rough_interface")
    bare = scene.load(without(tmp_path, "polarizer_bench", "sample_plate"), bench.scene.defines)
    values = {**bench.values, "sample.index": 1.0}
    images = [
        RenderJob(loaded, spp=16, saturation=1.0, layers=()).take({k: values[k] for k in loaded.parameters}).camera
        for loaded in (bench.scene, bare)
    ]
    assert images[1].max() > 0.01
    assert np.abs(images[0] - images[1]).max() <= 10 * IDENTITY  # spawned once more, a ray is rounded once more


# -- derivatives -----------------------------------------------------------------------------------------------------
def compare(found, reference, image, step, tolerance, keep=True, what=""):
    """|found - reference| <= tolerance |reference| + the rounding of float32 in a difference over the step."""
    keep = np.broadcast_to(np.asarray(keep)[..., None] if np.ndim(keep) else True, found.shape)
    off, size = np.linalg.norm((found - reference)[keep]), np.linalg.norm(reference[keep])
    rounding = FLOAT * np.linalg.norm(image) / step
    assert np.isfinite(found).all(), f"{what}: not finite"
    assert off <= tolerance * size + rounding, (
        f"{what}: off by {off / max(size, 1e-300):.2g} (rounding {rounding / max(size, 1e-300):.1g})"
    )


def without_flips(bench, key, found, reference, keep):
    """The pixels kept, in a scene of beads without one in a thousand: of their thousands of shadows' edges one may pass
    a sample between the values at which rims are looked for. So may, of a board that carries all LEDs, the edge of a
    shadow that is smaller than a pixel, which no rim tells of."""
    if not getattr(bench.renderer, "crowded", False) and bench.renderer.kind(key) != "board":
        return keep
    off = np.abs(found - reference).max(-1)
    return keep & (off <= np.quantile(off[np.broadcast_to(keep, off.shape)], 0.999))


def check_forward_mode(bench, key):
    """Renderer.led_tangent against differences, per LED image: at neutral and away from it."""
    p = bench.scene.parameters[key]
    part = key.rsplit(".", 1)[0]
    led = part if part in bench.scene.leds else next(iter(bench.scene.leds))
    base = about(bench, key)
    r = bench.renderer
    for value in places(bench, key, p, base):
        now = {**base, key: value}
        step = 0.5 * p.step * p.plausible
        reference, used = differences(lambda v: r.image({**base, key: v}, led), value, step, p.bounds)
        keep = calm(bench, key, [value, *used], base) if moves(bench, key) else True
        # 5e-4: what the third derivative leaves of a step of 5 % of a plausible change; where the LED moves, some
        # pixels cross the kink of (S3) at perpendicular azimuths within the step, and their differences are off by some
        # percent
        tolerance = 2e-3 if moves(bench, key) else 5e-4
        found = r.led_tangent(now, led, key)
        keep = without_flips(bench, key, found, reference, keep)
        compare(found, reference, r.image(now, led), step, tolerance, keep, f"{key} = {value:g}")


def check_complex_step(bench, key):
    """The camera's derivative by complex step against differences in double precision."""
    p = bench.scene.parameters[key]
    base = about(bench, key)
    light = bench.model.radiance(base)
    develop = bench.model.developer.develop
    for value in places(bench, key, p, base):
        linear = bench.model.developer.linearise(light, {**base, key: value})
        step = 1e-3 * p.plausible
        reference, _ = differences(lambda v: develop(light, {**base, key: v}), value, step, p.bounds)
        found = linear.of_parameter((key,))
        assert np.linalg.norm(reference) > 0, f"{key}: nothing depends on it"
        # 1e-5: third derivative over a thousandth of a plausible change; double precision leaves 1e-10 of the rest
        off = np.linalg.norm(found - reference) / np.linalg.norm(reference)
        assert off <= 1e-5, f"{key} = {value:g}: off by {off:.2g}"
    return np.linalg.norm(reference) * p.plausible


@pytest.mark.parametrize("kind, name", ways("image"))
def test_complex_step_against_differences(kind, name, bench_of):
    bench = bench_of(kind, name)
    key = key_of(bench, kind, name)
    if bench.scene.parameters[key].how == "difference":  # where rays start all over the pupil
        slope = bench.derivative(key, about(bench, key))
        assert np.isfinite(slope).all() and np.abs(slope).max() > 0
        return
    check_complex_step(bench, key)


def check_layer_step(bench, key):
    """The model's derivative by complex step through layers and sources against differences of its images; how strong
    it is."""
    p = bench.scene.parameters[key]
    base, strongest = about(bench, key), 0.0
    for value in places(bench, key, p, base):
        found = bench.derivative(key, {**base, key: value})
        reference, _ = differences(lambda v: bench.image({**base, key: v}), value, 3e-3 * p.plausible, p.bounds)
        size = np.linalg.norm(reference)
        off = np.linalg.norm(found - reference)
        # 1e-5: as for the camera; 1e-7 of the image over a plausible change: a slope that is 0, of which a step leaves
        # that much
        assert off <= 1e-5 * size + 1e-7 * np.linalg.norm(bench.image(base)) / p.plausible, (
            f"{key} = {value:g}: off by {off / max(size, 1e-300):.2g}"
        )
        strongest = max(strongest, size * p.plausible)
    return strongest


@pytest.mark.parametrize("kind, name", ways("layer"))
def test_complex_step_through_layers_against_differences(kind, name, bench_of):
    bench = bench_of(kind, name)
    strength = [check_layer_step(bench, key) for key in keys(bench, kind, name)]
    assert max(strength) > 1e-5, f"{kind}.{name} does nothing to the bench"


def check_model_derivative(bench, key, tolerance, rims=False):
    """Model.derivatives against differences of Model.predict over other steps than it takes itself; how strong they
    are."""
    p = bench.scene.parameters[key]
    base = about(bench, key)
    if key == bench.renderer.bounce_key:
        base["gel.press_depth"] = 1.2  # steep flanks that see each other
    strongest = 0.0
    for value in places(bench, key, p, base):
        found = bench.derivative(key, {**base, key: value})
        step = 0.5 * p.step * p.plausible
        reference, used = differences(lambda v: bench.image({**base, key: v}), value, step, p.bounds)
        own = [
            min(max(value + s * p.step * p.plausible, p.bounds[0]), p.bounds[1]) for s in (-1, 1)
        ]  # the model's own steps
        keep = calm(bench, key, [value, *used, *own], base) if moves(bench, key) else True
        keep = without_flips(bench, key, found, reference, keep)
        compare(found, reference, bench.image({**base, key: value}), step, tolerance, keep, f"{key} = {value:g}")
        if rims:
            check_rim(found, reference, ~keep, key)
        strongest = max(strongest, np.abs(reference).max() * p.plausible)
    return strongest


@pytest.mark.parametrize("kind, name", ways("ad", often=False))
def test_forward_mode_against_differences(kind, name, bench_of):
    """In the image of one LED, where the parameter acts there, and in the model's."""
    bench = bench_of(kind, name)
    key = key_of(bench, kind, name)
    apart = (bench.renderer.bounce_key, *bench.renderer.ambient_keys)
    if bench.scene.parameters[key].role not in POWERS and key not in apart:
        check_forward_mode(bench, key)
    # 1e-3: twice the tolerance of one LED's image, since ambient light is differentiated by differences
    assert check_model_derivative(bench, key, 1e-3) > 1e-7, f"{key} does nothing to the bench"


@pytest.mark.slow
@pytest.mark.parametrize("kind, name", ways("difference", often=False))
def test_differences_do_not_depend_on_their_step(kind, name, bench_of):
    bench = bench_of(kind, name)
    # 3 %: the model's steps are twice as wide, and away from rims images bend by a few percent over a plausible change
    strength = check_model_derivative(
        bench, key_of(bench, kind, name), 0.03, rims=kind in MOVED or (kind == "gel" and name in DRAGGING)
    )
    assert strength > 1e-7, f"{kind}.{name} does nothing to the bench"


# What layers, glow and a pressed skin make of derivatives by each of the four ways, in the finger.
IN_THE_FINGER = (
    "analyzer.angle",
    "film.offset",
    "silicone.stress",
    "inner_face.index",
    "skin.press_depth",
    "uv_left.power",
    "uv_left.x",
    "room_left.tilt",
    "object_paint.rho_g",
    "wall_paint.ambient",
    "camera.gain_g",
)


@pytest.mark.slow
@pytest.mark.parametrize("key", IN_THE_FINGER)
def test_derivatives_behind_layers(key, bench_of):
    bench = bench_of("markers")
    checks = {
        "layer": (check_layer_step,),
        "image": (check_complex_step,),
        "ad": (check_model_derivative, 2e-3),
        "difference": (check_model_derivative, 0.03),
    }
    check, *tolerance = checks[bench.scene.parameters[key].how]
    assert check(bench, key, *tolerance) > 1e-5


@pytest.mark.parametrize(
    "key",
    (
        "analyzer.angle",
        "film.offset",
        "analyzer.transmittance",
        "object_paint.rho_g",
        "wall_paint.ambient",
        "object.bsdf.reflectance.value",
    ),
)
def test_derivatives_of_light_that_no_lamp_made(key, bench_of, monkeypatch):
    """With every lamp off, the ambient light of the paints is still seen through the layers."""
    bench = bench_of("markers")
    for light in bench.scene.lights:
        monkeypatch.setitem(bench.values, f"{light}.power", 0.0)
    layer = bench.scene.parameters[key].how == "layer"
    assert (check_layer_step(bench, key) if layer else check_model_derivative(bench, key, 2e-3)) > 1e-5


def test_an_image_does_not_depend_on_those_before_it(bench):
    """Values of stock plugins act whatever geometry is in use, also in light of the room."""
    key, room = (
        "membrane.reflectance.value",
        {"membrane.ambient": 0.01, **{f"{n}.power": 0.0 for n in bench.scene.leds}},
    )
    for light in (room, {}):
        before = bench.image(light)
        brighter = bench.image({**light, key: 1.1})
        assert np.array_equal(bench.image(light), before) and np.abs(brighter - before).max() > 0.01 * before.max()


def check_linear(bench, key):
    """linear: second differences vanish; squared: twice the value has four times the effect."""
    p = bench.scene.parameters[key]
    if p.linear:
        start = bench.values[key]
        sign = 1 if start + 2 * p.plausible <= p.bounds[1] else -1
        a, b, c = (bench.image({key: start + k * sign * p.plausible}) for k in range(3))
        assert np.abs(c - b).max() > 1e-6 or key == bench.renderer.bounce_key
        assert np.abs(a + c - 2 * b).max() <= 4 * FLOAT * np.abs(c).max(), f"{key}: not linear"
    if p.squared:
        rest, once, twice = (bench.image({key: k * 0.1 * p.plausible}) for k in range(3))
        assert np.linalg.norm(twice - rest) == pytest.approx(4 * np.linalg.norm(once - rest), rel=0.05)


@pytest.mark.parametrize(
    "kind, name",
    [
        pytest.param(k, n, id=f"{k}.{n}")
        for k, n in NUMBERS
        if REGISTRY.parameter(k, n).linear or REGISTRY.parameter(k, n).squared
    ],
)
def test_declared_linear_or_squared_is_true(kind, name, bench_of):
    bench = bench_of(kind, name)
    check_linear(bench, key_of(bench, kind, name))


def test_shared_and_mixed_variables(bench):
    """One value for all LEDs, and light and camera at once: the sum of the single derivatives."""
    leds = list(bench.model.lit(bench.values))
    lobes = [f"{n}.mu" for n in leds]
    for keys_ in (lobes, [f"{n}.power" for n in leds]):
        together = bench.derivative(keys_[0], keys=keys_)
        single = sum(bench.derivative(k) for k in keys_)
        assert np.abs(together - single).max() <= 1e-5 * np.abs(single).max()


def test_derivatives_through_a_bent_response(bench):
    """The chain rule through lens, sensor and response: light's derivative against differences with every camera effect
    on."""
    camera = {
        "camera.vignetting": 0.7,
        "camera.blur": 0.8,
        "camera.glare": 0.05,
        "camera.crosstalk": 0.04,
        "camera.response2_r": 0.2,
        "camera.response3_g": 0.1,
        "camera.response_bend": 0.1,
        "camera.offset": 2.0,
    }
    for key in ("led_1.mu", "membrane.sigma", "gel.absorption", "led_3.power"):
        p = bench.scene.parameters[key]
        value = bench.values[key] + 0.5 * p.plausible
        step = 0.5 * p.step * p.plausible
        reference, _ = differences(lambda v: bench.image({**camera, key: v}), value, step, p.bounds)
        found = bench.derivative(key, {**camera, key: value})
        compare(found, reference, bench.image({**camera, key: value}), step, 1e-3, what=key)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["multiplicative", "additive"])
def test_derivatives_with_a_flat_field(bench, mode):
    """The measured background and the prediction at rest take part in every derivative."""
    from optics.fit.scene_model import FLAT_FIELDS

    assert mode in FLAT_FIELDS
    height, width = bench.model.shape[:2]
    v, u = np.mgrid[:height, :width]
    flat = 60 + 20 * np.sin(u / 9)[..., None] * [1, 0.5, -0.5] + v[..., None] / 3
    flattened = type(bench)(bench.scene, bench.values, flat.astype(np.float32), mode)
    for key in (
        "led_1.mu",
        "led_3.power",
        "membrane.rho_g",
        "camera.gain_r",
        "camera.response2_g",
        "gel.absorption",
        "gel.wedge_x",
        "gel.press_depth",
    ):
        p = bench.scene.parameters[key]
        value = bench.values[key] + 0.5 * p.plausible
        step = 0.5 * p.step * p.plausible
        reference, used = differences(lambda x: flattened.image({key: x}), value, step, p.bounds)
        own = [value + s * p.step * p.plausible for s in (-1, 0.5, 1)]
        keep = True
        if moves(bench, key):
            keep = calm(bench, key, [value, *used, *own], bench.values)
            keep &= calm(bench, key, [value, *used, *own], {**bench.values, "gel.press_depth": 0.0})
        # what a wedge does to the face at rest and to the dented face nearly cancels: 0.3 % of either is 6 % of the
        # rest
        compare(
            flattened.derivative(key, {key: value}),
            reference,
            flattened.image({key: value}),
            step,
            {"gel.wedge_x": 0.1, "gel.press_depth": 0.03}.get(key, 1e-3),
            keep,
            key,
        )


def check_rim(found, reference, rim, key):
    """At rims derivatives are finite samples of a moving edge: their sum over the rim, not each pixel, is to be
    trusted.

    At 80 x 60 px and 64 samples the sum is good to 10 %; single pixels of a press's rim are off by 80 %.
    """
    off, size = np.abs((found - reference)[rim].sum()), np.abs(reference[rim]).sum()
    assert off < 0.25 * size, f"{key}: the rim's sum is off by {off:.2g} of {size:.2g}"


@pytest.mark.parametrize("key", ["led_1.x", "led_1.z", "gel.press_x", "gel.press_depth"])
def test_moved_rims_carry_about_the_right_light(key, bench):
    p = bench.scene.parameters[key]
    value, step = bench.values[key], 0.5 * p.plausible
    reference, used = differences(lambda v: bench.image({key: v}), value, step, p.bounds)
    check_rim(bench.derivative(key), reference, ~calm(bench, key, [value, *used], bench.values), key)


# -- images stay images ----------------------------------------------------------------------------------------------
def check_image_function(effect, stage, bench):
    """lens and sensor are affine in the image; response acts pixel by pixel; none changes the shape; none is in
    place."""
    function = effect.stages[stage]
    view = bench.model.developer.view(
        {
            **bench.values,
            **{
                k: inward(p, p.neutral, p.plausible)
                for p in bench.scene.registry.effect_parameters(effect)
                for k in keys(bench, effect.part, p.name)
            },
        }
    )
    rng = np.random.default_rng(5)
    a, b = rng.uniform(0, 1, (2, view.height, view.width, 3))
    kept = a.copy()
    out = function(a, view)
    assert out.shape == a.shape and np.isfinite(out).all()
    assert (a == kept).all(), f"{effect.name}: changes the image it is given"
    poked = a.copy()
    poked[2, 3] += 0.5
    elsewhere = np.abs(function(poked, view) - out).max(-1) > 1e-9
    elsewhere[2, 3] = False
    assert elsewhere.any() == effect.mixes_pixels, (
        f"{effect.name}: mixes_pixels = {effect.mixes_pixels}, but pixels mix or do not"
    )
    if stage == "response":
        order = rng.permutation(a.shape[0] * a.shape[1])
        shuffled = a.reshape(-1, 3)[order].reshape(a.shape)
        assert np.abs(function(shuffled, view).reshape(-1, 3) - out.reshape(-1, 3)[order]).max() < 1e-12
    else:
        assert np.abs(function(0.3 * a + 0.7 * b, view) - 0.3 * out - 0.7 * function(b, view)).max() < 1e-12


@pytest.mark.parametrize("key, stage", [(k, s) for k in EFFECTS for s in REGISTRY.effects[k].stages if s in OF_IMAGES])
def test_image_functions_are_affine_or_act_pixel_by_pixel(key, stage, bench_of):
    effect = REGISTRY.effects[key]
    check_image_function(effect, stage, bench_of(effect))


def draw(rng, bench, chosen=None):
    """Plausible values about the working point, by the samplers of all parts and effects."""
    values, registry = {}, bench.scene.registry
    for name, part in bench.scene.parts.items():
        around = {p: bench.values[f"{name}.{p}"] for p in part.numbers}
        effects = [e for e in registry.effects.values() if part.kind in registry.carriers(e)]
        # what draws several parameters comes last: its values belong together
        for item in (registry.parts[part.kind], *sorted(effects, key=lambda e: len(e.parameter_names))):
            drawn = checking.draw(item, own_parameters(item, registry), rng, around)
            values.update((f"{name}.{p}", value) for p, value in drawn.items())
    return {k: v for k, v in values.items() if k in bench.scene.parameters and (chosen is None or k in chosen)}


def check_random_values(bench, effect, seed):
    """Two draws of an effect's own parameters: finite images within bounds."""
    rng = np.random.default_rng(seed)
    own = [*bench.scene.registry.effect_parameters(effect), *effect.shape]
    chosen = {k for p in own for k in keys(bench, effect.part, p.name)}
    for _ in range(2):
        image = bench.image(draw(rng, bench, chosen))
        assert np.isfinite(image).all()
        assert image.min() > -0.02 and image.max() < 10  # an offset of one DN is 0.004


@pytest.mark.slow
@pytest.mark.parametrize("key", EFFECTS)
def test_random_strengths_give_images(key, bench_of):
    effect = REGISTRY.effects[key]
    check_random_values(bench_of(effect), effect, seed=EFFECTS.index(key))


# 5: interreflection, haze, absorption, gloss and the size of LEDs are on; 2: absorption and sizes alone
@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 5])
def test_everything_drawn_at_once_gives_images(seed, bench):
    """All parameters of the sensor within a plausible change, all effects on; and derivatives at that point are
    finite."""
    values = draw(np.random.default_rng(seed), bench)
    image = bench.image(values)
    assert np.isfinite(image).all() and image.std() > 0
    for key in ("led_1.x", "membrane.sigma", "gel.haze", "camera.blur"):
        assert np.isfinite(bench.derivative(key, values)).all(), key


# All effects of these at once compile for three seconds and more: among the slow tests.
LONG = ("9dtact", "colour_bench", "digit", "gelsight_bench", "gelsight_mini", "particle_gel", "vi2tap")


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in LONG else n for n in SHIPPED])
def test_every_scene_gives_images_with_all_its_effects(name, benches):
    """Each effect that a scene can express is drawn at once: parts that stand in for another carry what they can
    compute."""
    bench = benches(name)
    effects = [e for e in bench.scene.registry.effects.values() if bench.scene.can_express(e)]
    own = {k for e in effects for held in bench.scene.keys_of(e).values() for k in held}
    image = bench.image(draw(np.random.default_rng(3), bench, own))
    assert effects and np.isfinite(image).all() and image.std() > 0


@pytest.mark.parametrize(
    "kind, seed", [("source", 0), ("source", 1), pytest.param("markers", 0, marks=pytest.mark.slow)]
)
def test_all_layers_drawn_at_once_give_derivatives(kind, seed, bench_of):
    """All parameters of a layered scene within a plausible change: an image, and the right derivatives by those of
    layers."""
    bench = bench_of(kind)
    rng = np.random.default_rng(seed)
    values = {
        **bench.values,
        **draw(rng, bench),
        bench.renderer.bounce_key: 0.0,
    }  # of a second bounce only powers have derivatives
    # light that is taken away everywhere leaves pixels that are darker than black
    values.update({k: abs(v) for k, v in values.items() if k.endswith(".stray")})
    if kind != "source":  # reflections between films take their time
        values.update({k: 0.0 for k in values if k.endswith(".face")})
    image = bench.image(values)
    assert np.isfinite(image).all() and image.std() > 0 and image.min() > -0.05 and image.max() < 10
    numbers = sorted(k for k in bench.renderer.layer_keys if bench.scene.parameters[k].is_number)
    for key in rng.choice(numbers, 20 if kind == "source" else 5, replace=False):
        p = bench.scene.parameters[key]
        # near a bound, where a film without a leak goes as a square root, a thousandth of the distance to it
        room = min(abs(values[key] - bound) for bound in p.bounds)
        step = min(3e-3 * p.plausible, 1e-3 * room) if room > p.near else 3e-3 * p.plausible
        # the error of a central difference goes with the square of its step: two of them leave the fourth power
        wide, fine = (
            differences(lambda v: bench.image({**values, key: v}), values[key], h, p.bounds)[0]
            for h in (step, step / 2)
        )
        reference = (4 * fine - wide) / 3
        off = np.linalg.norm(bench.derivative(key, values) - reference)
        assert off <= 1e-5 * np.linalg.norm(reference) + 1e-7 * np.linalg.norm(image) / p.plausible, (
            f"{key}: off by {off:.2g}"
        )


@pytest.mark.parametrize("key", EFFECTS)
def test_no_light_no_image(key, bench_of):
    """With every light off all is black whatever the strength, but for effects that bring their own light.

    A camera that adds to the signal does so at every pixel alike, unless the effect says that it acts through the dark
    signal."""
    effect = REGISTRY.effects[key]
    bench = bench_of(effect)
    dark = {
        **bench.values,
        **{k: bench.scene.parameters[k].neutral for k in bench.renderer.ambient_keys},
        **{f"{light}.power": 0.0 for light in bench.scene.lights},
        **at(bench, effect, lambda p: inward(p, p.neutral, p.plausible)),
    }
    image, shines = bench.image(dark), "ambient" in effect.stages
    assert (bench.model.radiance(dark).max() > 0) == shines
    assert shines or "dark" in effect.acts or np.ptp(image, axis=(0, 1)).max() == 0
    assert shines or effect.part == "camera" or np.abs(image).max() == 0


@pytest.mark.parametrize("kind, name", [pytest.param(k, n, id=f"{k}.{n}") for k, n in NUMBERS])
def test_bounds_are_kept(kind, name, bench_of):
    from optics.errors import OutOfBounds

    bench = bench_of(kind, name)
    key = key_of(bench, kind, name)
    p = bench.scene.parameters[key]
    for bound, sign in zip(p.bounds, (-1, 1)):
        if math.isfinite(bound):
            bench.scene.check({key: bound})
            with pytest.raises(OutOfBounds, match=re.escape(key)):
                bench.scene.check({key: bound + sign * max(1e-3, abs(bound) * 1e-3)})
    for wrong in (math.nan, math.inf, "much"):
        with pytest.raises(ValueError, match=re.escape(key)):
            bench.scene.check({key: wrong})


# -- layers and sources ----------------------------------------------------------------------------------------------
def crossings(rng, count, bands=(620.0, 540.0, 460.0), steepest=60.0):
    """Random crossings: either side, any direction, place and axes; (count, 1) against the bands."""
    from optics.polarization.layers import Crossing

    theta, phi, turn = np.radians([steepest, 360, 360])[:, None] * rng.uniform(0, 1, (3, count))
    k = np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), rng.choice([-1, 1], count) * np.cos(theta)], -1
    )
    s = np.stack([-np.sin(phi), np.cos(phi), 0 * phi], -1)
    x = np.cos(turn)[:, None] * s + np.sin(turn)[:, None] * np.cross(k, s)
    u, v = rng.uniform(-10, 10, (2, count, 1))
    return Crossing(*(tuple(a[:, i : i + 1] for i in range(3)) for a in (k, x)), u, v, np.array(bands))


def layer_of(bench, kind, values):
    """A part of a layered scene as its functions read it."""
    from optics.light.paths import part_values

    name = next(n for n, p in bench.scene.parts.items() if p.kind == kind)
    return part_values(bench.scene, name, values, {})


OF_THE_LAYERS = ("dichroism",)  # effects that share out what their layer absorbs


def check_realisable(bench, kind, seed):
    """Within a plausible change of the bench a layer's own matrix, and that of each of its effects, is one of something
    passive; of an effect that passes one polarization better on account of what the layer absorbs, with the layer."""
    from optics.polarization.mueller import gain, physical

    rng = np.random.default_rng(seed)
    effects = bench.scene.registry.at_stage(kind, "layer")
    for _ in range(5):
        layer = layer_of(bench, kind, {**bench.values, **draw(rng, bench)})
        crossing = crossings(rng, 40)
        own = bench.scene.registry.parts[kind].mueller(crossing, layer)
        matrices = [e.stages["layer"](crossing, layer) for e in effects] + [own]
        for name, matrix in zip([*(e.name for e in effects), kind], matrices):
            m, whole = matrix.numpy(), (matrix if name not in OF_THE_LAYERS else matrix @ own).numpy()
            assert np.isfinite(m).all()
            assert physical(m).min() >= -1e-9, f"{name}: no physical matrix, eigenvalue {physical(m).min():.2g}"
            assert gain(whole).max() <= 1 + 1e-9, f"{name}: makes light, gain {gain(whole).max():.6f}"


def check_emission(bench, kind, seed):
    """The degree of polarization of a source is 1 or less."""
    rng = np.random.default_rng(seed)
    for _ in range(5):
        source = layer_of(bench, kind, {**bench.values, **draw(rng, bench)})
        vector = np.stack(np.broadcast_arrays(*bench.scene.registry.parts[kind].stokes(crossings(rng, 40), source)), -1)
        assert np.isfinite(vector).all()
        assert (np.linalg.norm(vector[..., 1:], axis=-1) <= vector[..., 0] * (1 + 1e-12)).all(), (
            f"{kind}: polarized beyond 1"
        )


def check_readings(bench, kind):
    """Settings of many readings in one array (first axis) give what they give one by one."""
    from optics.light import paths

    scene, bands = bench.scene, bench.renderer.wavelengths
    u, v = (np.array([0.4 * n]) for n in scene.camera.resolution)
    path = paths.trace(scene, u, v)
    sources = list(scene.sources)
    for key in bench.renderer.layer_keys:
        p = scene.parameters[key]
        if bench.renderer.kind(key) != kind or not p.is_number:
            continue
        many = np.clip(bench.values[key] + p.plausible * np.array([-1.0, 0.0, 0.7]), *p.bounds)

        def rows(value):
            values = {**bench.values, key: value}
            return np.array(
                [
                    np.broadcast_to(e, (np.size(value), len(bands)))
                    for e in (
                        *paths.transmission(scene, path, values, bands),
                        *(c for n in sources for c in paths.emitted(scene, n, path, values, bands)),
                    )
                ]
            )

        together, alone = rows(many), np.concatenate([rows(float(m)) for m in many], 1)
        assert np.abs(together - alone).max() <= 1e-12, f"{key}: readings differ from single values"


def check_both_arithmetics(mi, bench, kind):
    """The matrices that mi.render evaluates in Dr.Jit are those that the prediction multiplies in numpy."""
    from optics.polarization.layers import Crossing, evaluate
    from optics.scene.layer import numbers_of

    part, bands = bench.scene.registry.parts[kind], (620.0, 540.0, 460.0)
    bench.scene.set(bench.values)
    here = crossings(np.random.default_rng(3), 30, bands)
    there = Crossing(
        *(tuple(mi.Float(c.ravel().astype("f")) for c in a) for a in (here.k, here.x)),
        *(mi.Float(c.ravel().astype("f")) for c in (here.u, here.v)),
        mi.UnpolarizedSpectrum(*bands, *bands[-1:] * (len(mi.UnpolarizedSpectrum()) - len(bands))),
    )
    own = next(p for p in bench.scene.parts.values() if p.kind == kind)
    found, expected = (
        [e for row in evaluate(part.mueller, c, layer, bench.scene.registry.at_stage(kind, "layer")).rows for e in row]
        if part.mueller is not None
        else part.stokes(c, layer)
        for c, layer in ((there, numbers_of(own)), (here, layer_of(bench, kind, bench.values)))
    )
    for dr_entry, entry in zip(found, expected):
        lanes = mi.UnpolarizedSpectrum(dr_entry)
        for b in range(len(bands)):
            off = np.abs(np.array(lanes[b]) - np.broadcast_to(entry, (30, 3))[:, b]).max()
            # 2e-5: float32 leaves 4e-6 of an angle of a hundred degrees, twice that of the doubled one
            assert off <= 2e-5, f"{kind}: Dr.Jit differs from numpy by {off:.2g}"


@pytest.mark.parametrize("kind", LAYERS)
def test_layers_are_physical(kind, bench_of):
    check_realisable(bench_of(kind), kind, LAYERS.index(kind))


SOURCES = [kind for kind in PARTS if REGISTRY.parts[kind].stokes is not None and kind not in MONTE_CARLO]


@pytest.mark.parametrize("kind", SOURCES)
def test_sources_are_physical(kind, bench_of):
    check_emission(bench_of(kind), kind, 4)


@pytest.mark.parametrize("kind", LAYERS + SOURCES)
def test_readings_are_single_values_side_by_side(kind, bench_of):
    check_readings(bench_of(kind), kind)


@pytest.mark.parametrize("kind", LAYERS + SOURCES)
def test_renders_meet_the_same_matrices(kind, bench_of, mitsuba):
    check_both_arithmetics(mitsuba, bench_of(kind), kind)


# -- a user's own folder ---------------------------------------------------------------------------------------------
GOOD = '''"""LED halo: the package of an LED scatters a little light aside.

Definition
    kappa' = kappa (1 + q (1 - c^2)),   c the cosine to the LED's axis
Fingerprint
    brighter far from the axis.
Validity
    small q.
References
    none.
"""
from optics.effect import Effect
from optics.parameter import Parameter


def scatter(beam, led):
    return 1 + led.halo * (1 - beam.cos * beam.cos)


effect = Effect(name="LED halo", part="led", stages={"emission": scatter}, acts=("led",), needs="one LED per frame",
                parameters=(Parameter("halo", "1", 0.0, (0.0, 5.0), "share q", neutral=0.0, plausible=0.2),))
'''

CELL = '''"""Sugar cell: a solution that turns the plane of polarization; a cloudy one scrambles a part of it.

Definition
    M = t R(a),   a = rotation (540/lambda)^2,   diag(1, 1 - h, 1 - h, 1 - h) when it is cloudy
Fingerprint
    Malus' curve is shifted, in blue the most.
Validity
    thin, at every angle alike.
References
    none.
"""
import math

from optics.effect import Effect
from optics.layers import layer
from optics.mueller import cos, depolarizer, real, rotation, sin, where
from optics.parameter import Parameter


def turn(crossing, cell):
    ratio = 540.0 / crossing.wavelengths
    double = (math.pi / 90) * cell.rotation * (ratio * ratio)
    return rotation(cos(double), sin(double)) * cell.transmittance


def scramble(crossing, cell):
    return depolarizer(1.0 - cell.cloud)


part = layer("sugar_cell", (
    Parameter("transmittance", "1", 0.9, (0.0, 1.0), "transmittance t", plausible=0.05, how="layer", linear=True),
    Parameter("rotation", "deg", 20.0, (-720.0, 720.0), "rotation at 540 nm", plausible=1.0, how="layer")), turn)
effect = Effect(name="cloudy cell", part="sugar_cell", stages={"layer": scramble}, acts=("analyzer.angle",), needs="Malus' curve",
                parameters=(Parameter("cloud", "1", 0.0, (0.0, 1.0), "share h", neutral=0.0, plausible=0.05, how="layer"),))
'''  # noqa: E501

BAD = {  # what is wrong -> (replacements in the good plugin, the check that has to notice)
    "not the identity at neutral": ([("return 1 +", "return 1.001 +")], check_identity),
    "jumps at neutral": (
        [("return 1 + led.halo *", "import drjit as dr\n    return 1 + dr.select(led.halo > 0, 0.2 + led.halo, 0) *")],
        check_continuity,
    ),
    "sets in with the square": ([("led.halo *", "led.halo * led.halo *")], check_onset),
    "hides its derivative": (
        [("return 1 + led.halo", "import drjit as dr\n    return 1 + dr.detach(led.halo)")],
        check_forward_mode,
    ),
    "not documented": ([("Fingerprint\n    brighter far from the axis.\n", "")], check_documentation),
}
BAD_LAYER = {
    "not the identity at neutral": ([("1.0 - cell.cloud", "0.999 - cell.cloud")], check_identity),
    "jumps at neutral": (
        [("1.0 - cell.cloud", "where(real(cell.cloud) > 0, 0.8, 1.0) - cell.cloud")],
        check_continuity,
    ),
    "sets in with the square": ([("cell.cloud)", "cell.cloud * cell.cloud)")], check_onset),
    "hides its derivative": ([("cell.cloud)", "real(cell.cloud))")], check_layer_step),
    "is no physical matrix": ([("1.0 - cell.cloud", "1.0 + cell.cloud")], check_realisable),
    "makes light": ([("* cell.transmittance", "* (1.3 * cell.transmittance)")], check_realisable),
    "is not linear": ([("* cell.transmittance", "* cell.transmittance * cell.transmittance")], check_linear),
    "takes single values alone": (
        [("* cell.rotation *", "* (cell.rotation if real(cell.rotation) < 30 else 30.0) *")],
        check_readings,
    ),
    "mixes readings": ([("* cell.rotation *", "* (cell.rotation + 0 * crossing.u).mean() *")], check_readings),
    "is another one in a render": (
        [
            (
                "1.0 - cell.cloud",
                "1.0 - cell.cloud - (0 if hasattr(crossing.u, 'shape') and "
                "type(crossing.u).__module__ == 'numpy' else 0.1)",
            )
        ],
        check_both_arithmetics,
    ),
    "differentiates another way": (
        [('plausible=0.05, how="layer"),))', "plausible=0.05),))")],
        check_effect_declaration,
    ),
}


@pytest.fixture
def user_bench(tmp_path, load_bench):
    """Writes a plugin, or several by the names of their files, into a user's folder and loads a shipped scene with it
    as a bench, in a registry of its own."""

    def load(text, name="gelsight", slot=None):
        folder = tmp_path / "plugins"
        folder.mkdir()
        for file, own in ({"own": text} if isinstance(text, str) else text).items():
            (folder / f"{file}.py").write_text(own, encoding="utf-8")
        return load_bench(name, slot, folder)

    return load


@pytest.mark.slow
def test_a_users_folder_meets_the_same_contract(user_bench):
    bench = user_bench(GOOD)
    effect = bench.scene.registry.find_effect("LED halo")
    assert "led_3.halo" in bench.scene.parameters
    check_documentation(effect)
    check_effect_declaration(effect, bench.scene.registry)
    check_declaration(bench.scene.registry.parameter("led", "halo"))
    check_identity(bench, effect)
    check_continuity(bench, effect)
    check_onset(bench, effect)
    check_forward_mode(bench, "led_1.halo")
    check_random_values(bench, effect, 1)
    assert check_model_derivative(bench, "led_1.halo", 1e-3) > 1e-4


def test_a_users_layer_meets_the_same_contract(user_bench, mitsuba):
    bench = user_bench(CELL, "polarizer_bench", "sugar_cell")
    effect = bench.scene.registry.find_effect("cloudy cell")
    check_documentation(bench.scene.registry.parts["sugar_cell"])
    check_effect_declaration(effect, bench.scene.registry)
    for p in bench.scene.registry.parameters_of("sugar_cell"):
        check_declaration(p)
        assert check_layer_step(bench, f"sample.{p.name}") > 1e-3
        check_linear(bench, f"sample.{p.name}")
    check_identity(bench, effect)
    check_continuity(bench, effect)
    check_onset(bench, effect)
    check_random_values(bench, effect, 1)
    check_realisable(bench, "sugar_cell", 1)
    check_readings(bench, "sugar_cell")
    check_both_arithmetics(mitsuba, bench, "sugar_cell")


def spoil(text, replacements):
    for old, new in replacements:
        assert old in text
        text = text.replace(old, new)
    return text


@pytest.mark.parametrize("fault", BAD)
def test_the_contract_notices(fault, user_bench):
    replacements, check = BAD[fault]
    bench = user_bench(spoil(GOOD, replacements))
    effect = bench.scene.registry.find_effect("LED halo")
    arguments = {check_forward_mode: (bench, "led_1.halo"), check_documentation: (effect,)}.get(check, (bench, effect))
    with pytest.raises(AssertionError):
        check(*arguments)


@pytest.mark.parametrize("fault", BAD_LAYER)
def test_the_contract_notices_in_layers(fault, user_bench, mitsuba):
    replacements, check = BAD_LAYER[fault]
    bench = user_bench(spoil(CELL, replacements), "polarizer_bench", "sugar_cell")
    effect = bench.scene.registry.find_effect("cloudy cell")
    arguments = {
        check_layer_step: (bench, "sample.cloud"),
        check_linear: (bench, "sample.transmittance"),
        check_realisable: (bench, "sugar_cell", 1),
        check_readings: (bench, "sugar_cell"),
        check_both_arithmetics: (mitsuba, bench, "sugar_cell"),
        check_effect_declaration: (effect, bench.scene.registry),
    }.get(check, (bench, effect))
    with pytest.raises((AssertionError, ValueError)):  # an array that is asked for its truth raises by itself
        check(*arguments)


@pytest.mark.slow
def test_stubs_of_new_effects_meet_the_contract(user_bench):
    from optics.study import draft

    bench = user_bench({f"my_{stage}": draft.new_effect(f"my {stage}", stage) for stage in draft.STUBS})
    for stage in draft.STUBS:
        effect = bench.scene.registry.find_effect(f"my {stage}")
        check_documentation(effect)
        check_effect_declaration(effect, bench.scene.registry)
        check_declaration(bench.scene.registry.effect_parameters(effect)[0])
        check_identity(bench, effect)
        check_continuity(bench, effect)
        check_onset(bench, effect)
        if stage in OF_IMAGES:
            check_image_function(effect, stage, bench)
        for check in effect.checks:
            check()


RAMP = {
    "place": range(16),
    "channel": range(3),
}  # cells; of other coordinates: a straight line from 0 to beyond any value
STEEP = {"height", "gel_path", "press_distance", "led_distance"}  # mm


def along(name):
    """Gain of a strength of 1 per unit of a coordinate."""
    return 0.1 if name in STEEP else 0.005


@pytest.fixture
def drafts(user_bench):
    """A bench with a draft along every coordinate that one can follow, each a gain that is linear in it; LED 1 alone is
    lit."""
    from optics.diagnosis.result import Fingerprint
    from optics.study import draft

    texts = {}
    for name in draft.CARRIERS:
        at = [float(x) for x in RAMP.get(name, (-1000, 1000))]
        curve = Fingerprint(
            name, 9.0, 1, 0.0, 8.0, 2.0, "gain", at, [along(name) * x for x in at], [1e-5] * len(at), [], "geometry"
        )
        found = SimpleNamespace(fingerprints=[curve], families=[], basis=SimpleNamespace(signal=1.0))
        texts[f"along_{name}"] = draft.draft_effect(
            found, name, name=f"along {name}", black_level=0.0, saturation=255.0
        )
    bench = user_bench(texts)
    bench.values.update(dict.fromkeys(("led_3.power", "led_5.power"), 0.0))
    return bench


def draft_key(bench, name):
    effect = bench.scene.registry.find_effect(f"along {name}")
    return f"{ {'gel': 'gel', 'led': 'led_1', 'camera': 'camera'}[effect.part] }.{effect.parameter_names[0]}"


def test_drafts_act_along_the_coordinate_that_was_diagnosed(drafts):
    """What a draft's stage computes is what the fingerprint was binned by, pixel by pixel, but at rims and where a
    press's edge bends."""
    from optics.study import draft

    bench = drafts
    known = {**bench.model.coordinates(bench.at(), 0), **bench.model.lit_geometry(bench.at(), 0)}
    height, width = bench.model.shape[:2]
    v, u = np.mgrid[:height, :width]
    known.update(row=v, column=u, place=v * 4 // height * 4 + u * 4 // width)
    rest = bench.image()
    bent = (
        bench.model.renderer.hits(bench.model.at(bench.at(), 0)).bent > 0
    )  # means over the pixel, where coordinates are its middle's
    lit = (rest.min(-1) > 1e-3) & ~known["rim"] & ~known["shadow"] & ~bent
    assert lit.mean() > 0.6
    for name in draft.CARRIERS:
        effect = bench.scene.registry.find_effect(f"along {name}")
        check_documentation(effect)
        check_effect_declaration(effect, bench.scene.registry)
        strength = 0.3
        gain = bench.image({draft_key(bench, name): strength}) / np.maximum(rest, 1e-6) - 1
        expected = {"channel": np.arange(3.0), "signal": rest * 255}.get(name)
        expected = known[name][..., None] if expected is None else expected
        off = np.abs(gain / (along(name) * strength) - expected)[lit]
        assert np.isfinite(off).all()
        # rounding of float32: 1e-6 of the image is 7e-4 deg; a degree near 0 is an arc cosine near 1, good to 0.02
        assert np.quantile(off, 0.99) < 0.03 + 1e-3 * np.nanmax(np.abs(expected)), (
            f"{name}: off by {np.quantile(off, 0.99):.3g}"
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, key, tolerance",
    [
        ("incidence", "led_1.x", 2e-3),
        ("led_distance", "led_1.z", 2e-3),
        ("half_angle", "led_1.y", 2e-3),
        (
            "led_angle",
            "led_1.tilt",
            5e-3,
        ),  # an angle to an axis is a cone: within the step, 0.25 deg, pixels cross its tip
        ("height", "gel.press_depth", 0.03),
        ("slope", "gel.press_x", 0.12),
    ],
)  # the slope bends at the edge of the contact, which the two steps cross by more or less
def test_derivatives_go_through_a_draft(name, key, tolerance, drafts):
    """Of what moves the coordinate itself, with the draft at a strength at which it matters; tolerances as without
    drafts."""
    strong = {draft_key(drafts, name): 8.0}
    before = drafts.derivative(key)
    drafts.values.update(strong)
    assert np.abs(drafts.derivative(key) - before).max() > 0.05 * np.abs(before).max()
    assert check_model_derivative(drafts, key, tolerance) > 1e-4


def test_an_effect_at_the_stage_layer_of_another_part_is_refused(user_bench):
    with pytest.raises(BadPlugin, match="'led' is not"):
        user_bench(spoil(CELL, [('part="sugar_cell", stages', 'part="led", stages')]), "polarizer_bench", "sugar_cell")


def test_the_contract_notices_light_polarized_beyond_itself(benches, monkeypatch):
    bench = benches("polarizer_bench")
    part = bench.scene.registry.parts["source"]

    def stokes(crossing, source):
        level, q, u, v = part.stokes(crossing, source)
        return level, 8 * q, 8 * u, v

    parts = {**bench.scene.registry.parts, "source": replace(part, stokes=stokes)}
    faulty = Registry.holding((item.file, item) for item in (*parts.values(), *bench.scene.registry.effects.values()))
    monkeypatch.setattr(bench.scene, "registry", faulty)
    with pytest.raises(AssertionError, match="polarized beyond 1"):
        check_emission(bench, "source", 4)


def test_the_contract_notices_pixels_that_mix(benches):
    with pytest.raises(AssertionError, match="pixels mix"):
        check_image_function(replace(REGISTRY.effects["lens-blur"], mixes_pixels=False), "lens", benches("gelsight"))


def test_the_contract_notices_glow_without_a_derivative(benches, monkeypatch):
    import drjit as dr

    pigment = type(benches("vi2tap").scene.parts["pigment"])
    usual = pigment.fluorescence
    monkeypatch.setattr(pigment, "fluorescence", lambda *arguments: dr.detach(usual(*arguments)))
    with pytest.raises(AssertionError, match="pigment.yield"):
        check_forward_mode(benches("vi2tap"), "pigment.yield")


def test_the_contract_notices_a_shape_that_moves_in_jumps(benches, monkeypatch):
    bench = benches("vi2tap")
    markers = type(bench.scene.parts["markers"])
    usual = markers.number
    monkeypatch.setattr(markers, "number", lambda self, name: round(usual(self, name) * 8) / 8)
    bench.forget()
    with pytest.raises(AssertionError, match="markers.radius"):
        assert check_model_derivative(bench, "markers.radius", 0.03, rims=True) > 1e-7, "markers.radius does nothing"
    bench.forget()


def test_the_contract_notices_a_material_declared_otherwise(mitsuba):
    bench = Material(mitsuba, "rough_interface")
    bench.scene.parameters["sample.alpha"] = replace(bench.scene.parameters["sample.alpha"], squared=False, linear=True)
    with pytest.raises(AssertionError, match="not linear"):
        check_linear(bench, "sample.alpha")
