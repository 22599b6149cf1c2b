"""The contract that the library relies on, held against every part and effect that a scan finds.

A user's plugins are held to it as well: `pytest tests/contract --plugin-folder DIR`. The checks are plain functions, so that
the tests at the end can show that each of them notices what it is there for.
"""

from __future__ import annotations

import math
import re
from contextlib import contextmanager

import numpy as np
import pytest

from optics.effect import IMAGE_STAGES, Effect, Registry, registry, shipped
from optics.render import POWERS

PARTS = sorted(registry().parts)
EFFECTS = sorted(registry().effects)
NUMBERS = [(kind, p.name) for kind in PARTS for p in registry().parameters_of(kind) if p.is_number]
SECTIONS = ("Definition", "Fingerprint", "Validity", "References")
UNITS = {"1", "mm", "mm^2", "deg", "rad", "nm", "px", "px^2", "DN", "1/mm", "1/mm^2", "MPa", "1e-12/Pa", "-"}

IDENTITY = 1e-6  # of full scale: ten roundings of float32
FLOAT = 3e-7  # relative rounding of an image in float32: what a difference of two images cannot resolve


def ways(how, image_of_one_led=False):
    """Parameters by the way of their derivative; those alone that act in the image of one LED at power 1."""
    elsewhere = {("led", name) for name in POWERS} | {("tactile", "interreflection")} | {
        ("membrane", name) for e in registry().at_stage("membrane", "ambient") for name in e.parameter_names}
    return [pytest.param(kind, name, id=f"{kind}.{name}") for kind, name in NUMBERS
            if registry().parameter(kind, name).how == how and not (image_of_one_led and (kind, name) in elsewhere)]


# -- what a plugin says about itself ------------------------------------------------------------------------------------------


def check_documentation(item):
    """The four sections, each with a text."""
    name = item.kind if not isinstance(item, Effect) else item.name
    lines = item.doc.strip().splitlines()
    assert lines and re.match(r".+: .+", lines[0]), f"{name}: the first line is not 'Name: what it is.'"
    found = {s: [i for i, line in enumerate(lines) if line.strip() == s] for s in SECTIONS}
    for section, where in found.items():
        assert len(where) == 1, f"{name}: {len(where)} sections '{section}'; one is needed"
        assert lines[where[0] + 1:] and lines[where[0] + 1].strip(), f"{name}: the section '{section}' is empty"
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
    for p in effect.shape:
        assert p.neutral is None, f"{p.name}: a shape has no neutral value"
    assert effect.acts and effect.needs, f"{effect.name}: says not through what it acts or what it needs"
    assert effect.scope in ("common", "frame") and effect.per in ("kind", "part")
    for stage in effect.stages:
        how = {p.how for p in parameters}
        assert (stage in IMAGE_STAGES) == (how == {"image"}), f"{effect.name}: derivatives by {how} at the stage '{stage}'"


@pytest.mark.parametrize("kind", PARTS)
def test_parts_document_and_declare_themselves(kind, mitsuba):
    part = registry().parts[kind]
    check_documentation(part)
    for p in registry().parameters_of(kind):
        check_declaration(p)
    for check in part.checks:
        check()


@pytest.mark.parametrize("key", EFFECTS)
def test_effects_document_and_declare_themselves(key, mitsuba):
    effect = registry().effects[key]
    check_documentation(effect)
    check_effect_declaration(effect, registry())
    for check in effect.checks:
        check()


# -- where a parameter is seen ------------------------------------------------------------------------------------------------


@pytest.fixture
def bench_of(benches):
    """The bench on which a kind of part is seen; its parameters are put back afterwards."""
    from optics import scene

    used = []

    def find(kind):
        for name in sorted(scene.shipped_scenes(), key=lambda n: (n != "gelsight", n)):
            bench = benches(name)
            if any(p.kind == kind for p in bench.scene.parts.values()):
                used.append(bench)
                return bench
        pytest.fail(f"no shipped scene has a part of the kind '{kind}'; its parameters cannot be tested")

    yield find
    for bench in used:
        bench.scene.set(bench.values)


def key_of(bench, kind, name):
    return next(f"{n}.{name}" for n, p in bench.scene.parts.items() if p.kind == kind)


def companions(bench, kind, name):
    """Other parameters of the same effect at a plausible value: an exponent shows only where its lobe is there."""
    values = {}
    for effect in registry().effects.values():
        if effect.part == kind and name in (p.name for p in effect.shape):
            for p in registry().effect_parameters(effect):
                for holder in (n for n, part in bench.scene.parts.items() if part.kind == kind):
                    values[f"{holder}.{p.name}"] = inward(p, p.neutral, p.plausible)
    return values


def inward(p, value, step):
    """value + step, or value - step where that leaves the bounds."""
    return value + step if value + step <= p.bounds[1] else value - step


def places(bench, key, p):
    """Where a derivative is tested: at neutral, unless an effect says that it means nothing there, and away from it.

    A parameter without a neutral value is tested at the working point, and away from it where that costs little.
    """
    here = bench.values[key] if p.neutral is None else p.neutral
    away = inward(p, here, 0.7 * p.plausible)
    if p.neutral is None:
        return (here,) if p.how == "difference" else (here, away)
    kind = bench.renderer.kind(key)
    nothing = any(e.onset == "secant" for e in registry().effects.values() if e.part == kind and p.name in e.parameter_names)
    return (away,) if nothing else (here, away)


def differences(f, value, step, bounds):
    """Derivative of f by differences of second order, central or, next to a bound, one-sided (and the values it used)."""
    if bounds[0] <= value - step and value + step <= bounds[1]:
        return (f(value + step) - f(value - step)) / (2 * step), (value - step, value + step)
    s = step if value + 2 * step <= bounds[1] else -step
    return (-3 * f(value) + 4 * f(value + s) - f(value + 2 * s)) / (2 * s), (value, value + s, value + 2 * s)


def calm(bench, key, values, base):
    """Pixels that are no rim (of a shadow or of the face) under any of the values: elsewhere an edge moves through the samples."""
    rim = np.zeros(bench.model.shape[:2], bool)
    for value in values:
        now = {**base, key: value}
        for led in bench.model.lit(now):
            rim |= bench.renderer.led(now, led).rim
    return ~rim


def moves(bench, key):
    """Whether the parameter moves geometry, and with it the rims of shadows."""
    kind, name = bench.renderer.kind(key), key.rsplit(".", 1)[1]
    return kind in ("gel", "camera", "interface") and bench.scene.parameters[key].how == "difference" or (
        kind == "led" and name in ("x", "y", "z", "area"))


# -- effects at and near neutral ------------------------------------------------------------------------------------------------


@contextmanager
def evaluated(bench, effect, monkeypatch):
    """The program leaves out functions of effects at neutral; in this context those of one effect are evaluated all the same."""
    import mitsuba as mi

    with monkeypatch.context() as patch:
        for part in bench.scene.parts.values():
            if part.kind == effect.part:
                usual = part.functions

                def functions(stage, usual=usual):
                    own = effect.stages.get(stage)
                    return tuple(f for f in usual(stage) if f is not own) + ((own,) if own else ())

                patch.setattr(part, "functions", functions, raising=False)
        for name in effect.parameter_names:
            if effect.part == "camera":
                patch.setitem(bench.model.developer.neutral, name, math.nan)  # nothing equals it
        if "surface" in effect.stages:
            bench.scene.gel.rebuild(mi.traverse(bench.scene.gel))
            bench.scene.mitsuba.parameters_changed([])
        bench.forget()
        yield
    bench.forget()
    if "surface" in effect.stages:
        bench.scene.gel.rebuild(mi.traverse(bench.scene.gel))
        bench.scene.mitsuba.parameters_changed([])


def check_identity(bench, effect, monkeypatch):
    """With its functions evaluated at neutral the image is the image without them."""
    for neutral in ({}, {"gel.press_depth": 0.0}):
        before = bench.image(neutral)
        with evaluated(bench, effect, monkeypatch):
            after = bench.image(neutral)
        assert np.abs(after - before).max() <= IDENTITY, f"{effect.name}: {np.abs(after - before).max():.2g} of full scale"


def keys(bench, effect, name):
    return [f"{n}.{name}" for n, p in bench.scene.parts.items() if p.kind == effect.part]


def moved(bench, effect, p, step):
    """Image with one parameter of an effect set off neutral in all parts that have it."""
    return bench.image(dict.fromkeys(keys(bench, effect, p.name), p.neutral + step))


def directions(p):
    return [s for s in (1, -1) if p.bounds[0] <= p.neutral + s * p.plausible <= p.bounds[1]]


def check_continuity(bench, effect):
    """A ten-thousandth of a plausible strength changes the image by about as little of what the plausible one changes."""
    rest = bench.image()
    for p in registry().effect_parameters(effect):
        for sign in directions(p):
            whole = np.abs(moved(bench, effect, p, sign * p.plausible) - rest).mean()
            little = np.abs(moved(bench, effect, p, sign * 1e-4 * p.plausible) - rest).mean()
            assert whole > 1e-7, f"{effect.name}: a plausible {p.name} does nothing to the bench"
            # 20 times: an onset like a square root, which ranking by a finite step can still use, would give 100. The floor: a
            # single sample of the 16 of a rim that flips is worth up to 1e-6 of the mean.
            assert little <= 20e-4 * whole + 1e-6, f"{effect.name}: {p.name} jumps by {little:.2g} at neutral"


def check_onset(bench, effect):
    """The slope from neutral agrees within 5 % when a step of 3 % of plausible is halved twice, or a secant is declared."""
    if effect.onset == "secant":
        return
    rest = bench.image()
    for p in registry().effect_parameters(effect):
        sign, *back = directions(p)
        steps = [sign * p.plausible / n for n in (32, 64, 128)] + [-sign * p.plausible / 128] * len(back)
        slopes = [(moved(bench, effect, p, h) - rest) / h for h in steps]
        keep = np.ones(rest.shape[:2], bool)
        for key in keys(bench, effect, p.name):
            if moves(bench, key):
                keep &= calm(bench, key, [p.neutral, *(p.neutral + h for h in steps)], bench.values)
        size = np.linalg.norm(slopes[2][keep])
        assert size > 0, f"{effect.name}: the image does not feel {p.name} at neutral; declare onset='secant'"
        for one, other, h in zip(slopes, slopes[1:], steps[1:]):  # the last pair: the slope on the other side
            off = np.linalg.norm((one - other)[keep])
            rounding = FLOAT * np.linalg.norm(rest) / abs(h)
            assert off <= 0.05 * size + rounding, (
                f"{effect.name}: the slope in {p.name} changes by {off / size:.0%} when the step is halved or turned round")


@pytest.mark.parametrize("key", EFFECTS)
def test_an_effect_at_neutral_is_not_there(key, bench_of, monkeypatch):
    effect = registry().effects[key]
    check_identity(bench_of(effect.part), effect, monkeypatch)


@pytest.mark.parametrize("key", EFFECTS)
def test_an_effect_sets_in_continuously(key, bench_of):
    effect = registry().effects[key]
    check_continuity(bench_of(effect.part), effect)


@pytest.mark.parametrize("key", EFFECTS)
def test_an_effect_sets_in_linearly_or_says_that_it_does_not(key, bench_of):
    effect = registry().effects[key]
    check_onset(bench_of(effect.part), effect)


def test_a_window_of_index_1_is_not_there(bench, tmp_path):
    """The one effect without functions whose neutral value is not skipped: the scene with and without the window."""
    from optics import scene
    from optics.render import Renderer

    text = re.sub(r'<shape type="rectangle" id="front">.*?</shape>', "", scene.find("gelsight").read_text(encoding="utf-8"),
                  flags=re.S)
    file = tmp_path / "open.xml"
    file.write_text(text, encoding="utf-8")
    width, height = bench.scene.camera.resolution
    renderer = Renderer(scene.load(file, {"width": width, "height": height}))
    values = {k: v for k, v in bench.values.items() if k in renderer.scene.parameters}
    exposure = values["camera.exposure"]
    for led in bench.model.lit(values):
        found, expected = (r.led(values if r is renderer else bench.values, led).radiance for r in (bench.renderer, renderer))
        assert np.abs(found - expected).max() * exposure <= 10 * IDENTITY  # a ray that starts again is rounded again


# -- derivatives ----------------------------------------------------------------------------------------------------------------


def compare(found, reference, image, step, tolerance, keep=True, what=""):
    """|found - reference| <= tolerance |reference| + what rounding of float32 makes of a difference over the step."""
    keep = np.broadcast_to(np.asarray(keep)[..., None] if np.ndim(keep) else True, found.shape)
    off, size = np.linalg.norm((found - reference)[keep]), np.linalg.norm(reference[keep])
    rounding = FLOAT * np.linalg.norm(image) / step
    assert np.isfinite(found).all(), f"{what}: not finite"
    assert off <= tolerance * size + rounding, f"{what}: off by {off / max(size, 1e-300):.2g} (rounding {rounding / max(size, 1e-300):.1g})"


def check_forward_mode(bench, kind, name):
    """Renderer.led_tangent against differences, per LED image: at neutral and away from it."""
    key = key_of(bench, kind, name)
    p = bench.scene.parameters[key]
    led = key.rsplit(".", 1)[0] if kind == "led" else next(iter(bench.scene.leds))
    base = {**bench.values, **companions(bench, kind, name)}
    r = bench.renderer
    for value in places(bench, key, p):
        now = {**base, key: value}
        step = 0.5 * p.step * p.plausible
        reference, used = differences(lambda v: r.led({**base, key: v}, led).radiance, value, step, p.bounds)
        keep = calm(bench, key, [value, *used], base) if moves(bench, key) else True
        # 5e-4: what the third derivative leaves of a step of 5 % of a plausible change; where the LED moves, some pixels cross
        # the kink of (S3) at perpendicular azimuths within the step, and their differences are off by some percent
        tolerance = 2e-3 if moves(bench, key) else 5e-4
        compare(r.led_tangent(now, led, key), reference, r.led(now, led).radiance, step, tolerance, keep, f"{key} = {value:g}")


@pytest.mark.parametrize("kind, name", ways("ad", image_of_one_led=True))
def test_forward_mode_against_differences(kind, name, bench_of):
    check_forward_mode(bench_of(kind), kind, name)


def check_complex_step(bench, kind, name):
    """The camera's derivative by complex step against differences in double precision."""
    key = key_of(bench, kind, name)
    p = bench.scene.parameters[key]
    base = {**bench.values, **companions(bench, kind, name)}
    light = bench.model.radiance(base)
    develop = bench.model.developer.develop
    for value in places(bench, key, p):
        linear = bench.model.developer.linearise(light, {**base, key: value})
        step = 1e-3 * p.plausible
        reference, _ = differences(lambda v: develop(light, {**base, key: v}), value, step, p.bounds)
        found = linear.of_parameter((key,))
        assert np.linalg.norm(reference) > 0, f"{key}: nothing depends on it"
        # 1e-5: third derivative over a thousandth of a plausible change; double precision leaves 1e-10 of the rest
        off = np.linalg.norm(found - reference) / np.linalg.norm(reference)
        assert off <= 1e-5, f"{key} = {value:g}: off by {off:.2g}"


@pytest.mark.parametrize("kind, name", ways("image"))
def test_complex_step_against_differences(kind, name, bench_of):
    check_complex_step(bench_of(kind), kind, name)


def check_model_derivative(bench, kind, name, tolerance):
    """Model.derivatives against differences of Model.predict over other steps than it takes itself."""
    key = key_of(bench, kind, name)
    p = bench.scene.parameters[key]
    base = {**bench.values, **companions(bench, kind, name)}
    if key == bench.renderer.bounce_key:
        base["gel.press_depth"] = 1.2  # steep flanks that see each other
    strongest = 0.0
    for value in places(bench, key, p):
        found = bench.derivative(key, {**base, key: value})
        step = 0.5 * p.step * p.plausible
        reference, used = differences(lambda v: bench.image({**base, key: v}), value, step, p.bounds)
        own = [min(max(value + s * p.step * p.plausible, p.bounds[0]), p.bounds[1]) for s in (-1, 1)]  # the model's own steps
        keep = calm(bench, key, [value, *used, *own], base) if moves(bench, key) else True
        compare(found, reference, bench.image({**base, key: value}), step, tolerance, keep, f"{key} = {value:g}")
        strongest = max(strongest, np.abs(reference).max() * p.plausible)
    return strongest


@pytest.mark.parametrize("kind, name", ways("ad"))
def test_the_model_knows_its_derivatives(kind, name, bench_of):
    # 1e-3: twice the tolerance of one LED's image, since ambient light is differentiated by differences
    assert check_model_derivative(bench_of(kind), kind, name, 1e-3) > 1e-7, f"{kind}.{name} does nothing to the bench"


@pytest.mark.parametrize("kind, name", ways("difference"))
def test_differences_do_not_depend_on_their_step(kind, name, bench_of):
    # 3 %: the model's steps are twice as wide, and away from rims images bend by a few percent over a plausible change
    check_model_derivative(bench_of(kind), kind, name, 0.03)


@pytest.mark.parametrize("kind, name", [p for how in ("ad", "difference") for p in ways(how)])
def test_declared_linear_or_squared_is_true(kind, name, bench_of):
    """linear: second differences vanish; squared: twice the value has four times the effect."""
    bench = bench_of(kind)
    key = key_of(bench, kind, name)
    p = bench.scene.parameters[key]
    if not (p.linear or p.squared):
        return
    if p.linear:
        start = bench.values[key]
        a, b, c = (bench.image({key: start + k * p.plausible}) for k in range(3))
        assert np.abs(c - b).max() > 1e-6 or key == bench.renderer.bounce_key
        assert np.abs(a + c - 2 * b).max() <= 4 * FLOAT * np.abs(c).max()
    if p.squared:
        rest, once, twice = (bench.image({key: k * 0.1 * p.plausible}) for k in range(3))
        assert np.linalg.norm(twice - rest) == pytest.approx(4 * np.linalg.norm(once - rest), rel=0.05)


def test_shared_and_mixed_variables(bench):
    """One value for all LEDs, and light and camera at once: the sum of the single derivatives."""
    leds = list(bench.model.lit(bench.values))
    lobes = [f"{n}.mu" for n in leds]
    for keys_ in (lobes, [f"{n}.power" for n in leds]):
        together = bench.derivative(keys_[0], keys=keys_)
        single = sum(bench.derivative(k) for k in keys_)
        assert np.abs(together - single).max() <= 1e-5 * np.abs(single).max()


def test_derivatives_through_a_bent_response(bench):
    """The chain rule through lens, sensor and response: light's derivative against differences with every camera effect on."""
    camera = {"camera.vignetting": 0.7, "camera.blur": 0.8, "camera.glare": 0.05, "camera.crosstalk": 0.04,
              "camera.response2_r": 0.2, "camera.response3_g": 0.1, "camera.response_bend": 0.1, "camera.offset": 2.0}
    for key in ("led_1.mu", "membrane.sigma", "gel.absorption", "led_3.power"):
        p = bench.scene.parameters[key]
        value = bench.values[key] + 0.5 * p.plausible
        step = 0.5 * p.step * p.plausible
        reference, _ = differences(lambda v: bench.image({**camera, key: v}), value, step, p.bounds)
        found = bench.derivative(key, {**camera, key: value})
        compare(found, reference, bench.image({**camera, key: value}), step, 1e-3, what=key)


@pytest.mark.parametrize("mode", ["multiplicative", "additive"])
def test_derivatives_with_a_flat_field(bench, mode):
    """The measured background and the prediction at rest take part in every derivative."""
    from optics.render import FLAT_FIELDS

    assert mode in FLAT_FIELDS
    height, width = bench.model.shape[:2]
    v, u = np.mgrid[:height, :width]
    flat = 60 + 20 * np.sin(u / 9)[..., None] * [1, 0.5, -0.5] + v[..., None] / 3
    flattened = type(bench)(bench.scene, bench.values, flat.astype(np.float32), mode)
    for key in ("led_1.mu", "led_3.power", "membrane.rho_g", "camera.gain_r", "camera.response2_g", "gel.absorption", "gel.wedge_x",
                "gel.press_depth"):
        p = bench.scene.parameters[key]
        value = bench.values[key] + 0.5 * p.plausible
        step = 0.5 * p.step * p.plausible
        reference, used = differences(lambda x: flattened.image({key: x}), value, step, p.bounds)
        own = [value + s * p.step * p.plausible for s in (-1, 0.5, 1)]
        keep = True
        if moves(bench, key):
            keep = calm(bench, key, [value, *used, *own], bench.values)
            keep &= calm(bench, key, [value, *used, *own], {**bench.values, "gel.press_depth": 0.0})
        # what a wedge does to the face at rest and to the dented face nearly cancels: 0.3 % of either is 6 % of the rest
        compare(flattened.derivative(key, {key: value}), reference, flattened.image({key: value}), step,
                {"gel.wedge_x": 0.1, "gel.press_depth": 0.03}.get(key, 1e-3), keep, key)


def test_moved_rims_carry_about_the_right_light(bench):
    """At rims derivatives are finite samples of a moving edge: their sum over the rim, not each pixel, is to be trusted.

    At 80 x 60 px and 64 samples the sum is good to 10 %; single pixels of a press's rim are off by 80 %.
    """
    for key in ("led_1.x", "led_1.z", "gel.press_x", "gel.press_depth"):
        p = bench.scene.parameters[key]
        value, step = bench.values[key], 0.5 * p.plausible
        reference, used = differences(lambda v: bench.image({key: v}), value, step, p.bounds)
        found = bench.derivative(key)
        rim = ~calm(bench, key, [value, *used], bench.values)
        off = np.abs((found - reference)[rim].sum()) / np.abs(reference[rim]).sum()
        assert off < 0.25, f"{key}: the rim's sum is off by {off:.0%}"


# -- images stay images -----------------------------------------------------------------------------------------------------------


def check_image_function(effect, stage, bench):
    """lens and sensor are affine in the image; response acts pixel by pixel; none changes the shape; none is in place."""
    function = effect.stages[stage]
    view = bench.model.developer.view({**bench.values, **{k: inward(p, p.neutral, p.plausible)
                                                          for p in registry().effect_parameters(effect)
                                                          for k in keys(bench, effect, p.name)}})
    rng = np.random.default_rng(5)
    a, b = rng.uniform(0, 1, (2, view.height, view.width, 3))
    kept = a.copy()
    out = function(a, view)
    assert out.shape == a.shape and np.isfinite(out).all()
    assert (a == kept).all(), f"{effect.name}: changes the image it is given"
    if stage == "response":
        order = rng.permutation(a.shape[0] * a.shape[1])
        shuffled = a.reshape(-1, 3)[order].reshape(a.shape)
        assert np.abs(function(shuffled, view).reshape(-1, 3) - out.reshape(-1, 3)[order]).max() < 1e-12
    else:
        assert np.abs(function(0.3 * a + 0.7 * b, view) - 0.3 * out - 0.7 * function(b, view)).max() < 1e-12


@pytest.mark.parametrize("key, stage", [(k, s) for k in EFFECTS for s in registry().effects[k].stages if s in IMAGE_STAGES])
def test_image_functions_are_affine_or_act_pixel_by_pixel(key, stage, bench_of):
    effect = registry().effects[key]
    check_image_function(effect, stage, bench_of(effect.part))


def draw(rng, bench, chosen=None):
    """Values drawn evenly within one plausible change of the working point, kept to the bounds."""
    values = {}
    for key, p in bench.scene.parameters.items():
        if p.is_number and p.unit and (chosen is None or key in chosen):
            values[key] = float(np.clip(bench.values[key] + rng.uniform(-1, 1) * p.plausible, *p.bounds))
    return values


def check_random_values(bench, effect, seed):
    """Two draws of an effect's own parameters: finite images, no darker than darkness, within bounds of the scene."""
    rng = np.random.default_rng(seed)
    own = [*registry().effect_parameters(effect), *effect.shape]
    chosen = {k for p in own for k in keys(bench, effect, p.name)}
    for _ in range(2):
        image = bench.image(draw(rng, bench, chosen))
        assert np.isfinite(image).all()
        assert image.min() > -0.02 and image.max() < 10  # an offset of one DN is 0.004


@pytest.mark.parametrize("key", EFFECTS)
def test_random_strengths_give_images(key, bench_of):
    effect = registry().effects[key]
    check_random_values(bench_of(effect.part), effect, seed=EFFECTS.index(key))


@pytest.mark.parametrize("seed", range(2))
def test_everything_drawn_at_once_gives_images(seed, bench):
    """All parameters of the sensor within a plausible change, all effects on; and derivatives at that point are finite."""
    values = draw(np.random.default_rng(seed), bench)
    image = bench.image(values)
    assert np.isfinite(image).all() and image.std() > 0
    for key in ("led_1.x", "membrane.sigma", "gel.haze", "camera.blur"):
        assert np.isfinite(bench.derivative(key, values)).all(), key


@pytest.mark.parametrize("key", EFFECTS)
def test_no_light_no_image(key, bench_of):
    """With every LED off the image is black whatever the strength, but for effects that bring their own light."""
    effect = registry().effects[key]
    bench = bench_of(effect.part)
    dark = {f"{led}.power": 0.0 for led in bench.scene.leds}
    for p in registry().effect_parameters(effect):
        dark.update(dict.fromkeys(keys(bench, effect, p.name), inward(p, p.neutral, p.plausible)))
    image = bench.image(dark)
    assert (image.max() > 0) if "ambient" in effect.stages else (np.abs(image).max() == 0)


@pytest.mark.parametrize("kind, name", [pytest.param(k, n, id=f"{k}.{n}") for k, n in NUMBERS])
def test_bounds_are_kept(kind, name, bench_of):
    from optics.errors import OutOfBounds

    bench = bench_of(kind)
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


# -- a user's own folder ----------------------------------------------------------------------------------------------------------

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

BAD = {  # what is wrong -> (replacements in the good plugin, the check that has to notice)
    "not the identity at neutral": ([("return 1 +", "return 1.001 +")], check_identity),
    "jumps at neutral": ([("return 1 + led.halo *", "import drjit as dr\n    return 1 + dr.select(led.halo > 0, 0.2 + led.halo, 0) *")],
                         check_continuity),
    "sets in with the square": ([("led.halo *", "led.halo * led.halo *")], check_onset),
    "hides its derivative": ([("return 1 + led.halo", "import drjit as dr\n    return 1 + dr.detach(led.halo)")], check_forward_mode),
    "not documented": ([("Fingerprint\n    brighter far from the axis.\n", "")], check_documentation),
}


@pytest.fixture
def user_folder(tmp_path, mitsuba, monkeypatch):
    """Writes a plugin into a user's folder and loads the shipped sensor with it, in a registry of its own."""
    import optics.effect as declarations
    from optics import scene

    usual = declarations.registry()

    def load(text):
        folder = tmp_path / "plugins"
        folder.mkdir()
        (folder / "halo.py").write_text(text, encoding="utf-8")
        fresh = Registry()
        fresh.scan(shipped("plugins"))
        monkeypatch.setattr(declarations, "_registry", fresh)
        return scene.load("gelsight", {"width": 40, "height": 30, "depth": 0.5}, plugins=folder)

    yield load
    monkeypatch.undo()
    usual.classes.clear()  # Mitsuba knows the user's classes by now: the usual ones are registered again
    declarations.use_variant()


@pytest.fixture
def user_bench(user_folder, benches):
    bench = benches("gelsight")
    return lambda text: type(bench)(user_folder(text), bench.values)


def test_a_users_folder_meets_the_same_contract(user_bench, monkeypatch):
    bench = user_bench(GOOD)
    effect = registry().find_effect("LED halo")
    assert "led_3.halo" in bench.scene.parameters
    check_documentation(effect)
    check_effect_declaration(effect, registry())
    check_declaration(registry().parameter("led", "halo"))
    check_identity(bench, effect, monkeypatch)
    check_continuity(bench, effect)
    check_onset(bench, effect)
    check_forward_mode(bench, "led", "halo")
    check_random_values(bench, effect, 1)
    assert check_model_derivative(bench, "led", "halo", 1e-3) > 1e-4


@pytest.mark.parametrize("fault", BAD)
def test_the_contract_notices(fault, user_bench, monkeypatch):
    replacements, check = BAD[fault]
    text = GOOD
    for old, new in replacements:
        assert old in text
        text = text.replace(old, new)
    bench = user_bench(text)
    effect = registry().find_effect("LED halo")
    arguments = {check_identity: (bench, effect, monkeypatch), check_continuity: (bench, effect), check_onset: (bench, effect),
                 check_forward_mode: (bench, "led", "halo"), check_documentation: (effect,)}[check]
    with pytest.raises(AssertionError):
        check(*arguments)
