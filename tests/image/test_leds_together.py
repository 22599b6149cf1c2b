"""Images of LEDs over one geometry that are made at once are those that are made one by one, derivatives too."""

import numpy as np
import pytest

from optics.errors import Apart
from optics.light.renderer import Renderer
from optics.light.samples import aligned
from optics.light.together import Together, alike
from optics.scene import loader

SMALL = {"width": "32", "height": "24"}


def pressed(name):
    """(scene, values with a dent, and with every effect of its LEDs)."""
    scene = loader.load(name, SMALL)
    values = {**scene.values(), f"{scene.gel.name}.press_depth": 0.5, f"{scene.gel.name}.press_x": 0.7}
    values |= dict.fromkeys(scene.powers.values(), 1.0)
    for key, p in scene.parameters.items():
        if key.split(".")[0] in scene.leds and p.how == "ad" and values[key] == p.neutral:
            values[key] = float(np.clip(p.neutral + 0.3 * p.plausible, *p.bounds))
    return scene, values


SCENES = ["digit", *(pytest.param(n, marks=pytest.mark.slow) for n in ("gelsight", "gelsight_bench", "gelsight_mini"))]


@pytest.mark.parametrize("name", SCENES)
def test_images(mitsuba, name):
    """Pixels' centres, rims of shadows and what bends; LEDs of different classes and boards apart."""
    scene, values = pressed(name)
    values |= {k: 2.0 for k, p in scene.parameters.items() if p.role == "light area"}
    one_by_one, at_once = Renderer(scene), Renderer(scene)
    at_once.together = set(scene.leds)
    at_once_made = 0
    for led in scene.leds:
        expected, found = one_by_one.led(values, led), at_once.led(values, led)
        at_once_made += found.group is not None
        largest = expected.radiance.max()  # single precision, in which the same light takes another way
        assert largest > 0 and np.abs(found.radiance - expected.radiance).max() < 1e-5 * largest
        assert (found.rim == expected.rim).all() and (found.index == expected.index).all()
        assert (np.array(found.visible) == np.array(expected.visible)).all()
    assert at_once_made >= 2 and not at_once.apart


@pytest.mark.parametrize("name", ["digit", pytest.param("gelsight_bench", marks=pytest.mark.slow)])
def test_derivatives(mitsuba, name):
    """By what each LED has for itself, by a board that all stand on, and by what the surface holds."""
    scene, values = pressed(name)
    one_by_one, at_once = Renderer(scene), Renderer(scene)
    at_once.together = set(scene.leds)
    leds = list(scene.leds)[:3]
    own = ["x", "pan", "mu", "line_growth"]
    boards = [f"{b}.{n}" for b in scene.boards for n in ("x", "rz")]
    surface = [k for k in one_by_one.shading_keys if scene.parameters[k].how == "ad"][:3]
    assert surface and (boards or name != "gelsight_bench")
    shared = [*boards, *surface]
    asked = [f"{led}.{k}" for led in scene.leds for k in own]
    with at_once.asking([*asked, *shared]):
        for led in leds:
            for key in [*(f"{led}.{k}" for k in own), *shared]:
                expected, found = (r.led_tangent(values, led, key) for r in (one_by_one, at_once))
                # single precision, summed in another order
                assert np.allclose(found, expected, rtol=1e-4, atol=2e-5 * max(np.abs(expected).max(), 1e-12)), key
        assert len(at_once._slopes) == len(scene.leds)  # all were made with the first
    assert any(np.abs(one_by_one.led_tangent(values, leds[0], k)).max() > 0 for k in surface)


def test_what_is_not_alike(mitsuba):
    """Words, points and sides of a window set LEDs apart; what one of them alone can answer is refused."""
    scene = loader.load("digit", SMALL)
    lights = list(scene.leds.values())
    assert [len(own) for own in alike(lights, [])] == [len(lights)]
    lights[0].hold("area", 1.0)
    assert sorted(len(own) for own in alike(lights, [])) == [1, len(lights) - 1]
    lights[0].hold("area", 0.0)
    lights[0].hold("z", lights[1].number("z") + 2.0)
    assert len(alike(lights, [lights[1].number("z") + 1.0])) == 2
    import mitsuba as mi

    both = Together(lights[:2], mi.UInt32([0, 1, 1]))
    assert np.allclose(np.array(both.x), [lights[k].number("x") for k in (0, 1, 1)])
    assert np.allclose(np.array(both.axis()).T[1], np.array(lights[1].axis()).ravel(), atol=1e-6)
    assert both.board is None and both.kind == "led" and both.reach() == 0
    for ask in (
        lambda: both.number("x"),
        lambda: both.held,
        lambda: both.unheard_of,
        lambda: both.name,
        lambda: both.id(),
    ):
        with pytest.raises(Apart):
            ask()


def test_shadows_follow_the_board(mitsuba):
    """Shadows are kept only while an LED and its board stay where they are. The board was forgotten, and shadows
    depended on what had been rendered before."""
    scene, values = pressed("gelsight_bench")
    (board,) = scene.boards
    moved = {**values, f"{board}.x": values[f"{board}.x"] + 4.0, f"{board}.z": values[f"{board}.z"] + 4.0}
    led = next(iter(scene.leds))
    for together in (set(), set(scene.leds)):
        before, fresh = Renderer(scene), Renderer(scene)
        before.together = fresh.together = together
        still = before.led(values, led).radiance
        found, expected = before.led(moved, led).radiance, fresh.led(moved, led).radiance
        assert np.abs(found - expected).max() < 1e-5 * expected.max()
        assert np.abs(found - still).max() > 0.1 * expected.max()


def test_different_spectra_are_asked_one_by_one(mitsuba):
    """By a pigment, which computes from an LED's measured spectrum how much of it is absorbed."""
    import mitsuba as mi

    lights = list(loader.load("digit", SMALL).leds.values())
    with pytest.raises(Apart):
        assert Together(lights, mi.UInt32([0, 1, 2])).curves
    assert Together(lights[:1], mi.UInt32([0, 0])).curves is lights[0].curves


def test_rings(mitsuba):
    """What a part holds besides its numbers, such as how many LEDs a ring has, is the same of all that are alike."""
    scene = loader.load("particle_gel", {**SMALL, "beads": "3"})
    rings = list(scene.leds.values())
    assert len(rings) == 2 and len(alike(rings, [])) == (1 if rings[0].count == rings[1].count else 2)
    import mitsuba as mi

    both = Together(rings, mi.UInt32([1, 0]))
    if rings[0].count != rings[1].count:
        with pytest.raises(Apart):
            both.point(mi.Point2f(0.3, 0.5))
        rings[1].count = rings[0].count
        both = Together(rings, mi.UInt32([1, 0]))
    found = np.array(both.point(mi.Point2f(0.3, 0.5))).T
    expected = [np.array(ring.point(mi.Point2f(0.3, 0.5))).ravel() for ring in reversed(rings)]
    assert np.allclose(found, expected, atol=1e-5)


def test_effects_that_ask_one_led(mitsuba, tmp_path):
    """With plugins of one's own, which may ask their LED for a Python number, images are made one by one; so they are
    where it turns out that this must be."""
    (tmp_path / "near.py").write_text(
        '''"""Near: light falls with the LED's height.

Definition
    x
"""
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def act(beam, led):
    return 1 + led.near * abs(led.number("z"))


effect = Effect(
    name="nearness",
    part="led",
    stages={"emission": act},
    parameters=(Parameter("near", "1/mm", 0.0, (-1.0, 1.0), "strength", neutral=0.0, plausible=0.1),),
    acts=("led",),
)
'''
    )
    scene = loader.load("digit", SMALL, plugins=tmp_path)
    values = {**scene.values(), **{f"{led}.near": 0.1 for led in scene.leds}}
    one_by_one, at_once, at_rest = Renderer(scene), Renderer(scene), Renderer(scene)
    at_once.together = at_rest.together = set(scene.leds)
    assert at_once.apart and at_rest.apart
    at_once.apart = at_rest.apart = False
    for led in scene.leds:
        assert (at_once.led(values, led).radiance == one_by_one.led(values, led).radiance).all()
    assert at_once.apart
    still = scene.values()  # the effect is asked only for its derivative
    with at_rest.asking([f"{led}.near" for led in scene.leds]):
        for led in scene.leds:
            expected = one_by_one.led_tangent(still, led, f"{led}.near")
            assert np.allclose(at_rest.led_tangent(still, led, f"{led}.near"), expected, rtol=1e-5)
    assert at_rest.apart and expected.max() > 0


def test_another_press_needs_no_other_kernel(mitsuba):
    """What differs from press to press, such as how many finer samples an LED takes, is no part of compiled code: a
    calibration of six LEDs that are lit one at a time took twice as long. Nor is where an indenter touches, of what it
    shows through the coating: each derivative of such an effect was compiled by itself."""
    import drjit as dr

    scene, values = pressed("digit")
    values |= {k: p.plausible for k, p in scene.parameters.items() if p.when_pressed}
    renderer = Renderer(scene)
    renderer.together = set(scene.leds)
    *others, last = scene.leds

    def press(x):
        """An image of all LEDs, derivatives of all, then of one that is lit alone."""
        now = {**values, f"{scene.gel.name}.press_x": x}
        alone = {**now, **{scene.powers[led]: 0.0 for led in others}}
        keys = [f"{led}.{name}" for led in scene.leds for name in ("x", "mu")]
        for state, asked in ((now, keys), (alone, [f"{last}.x", f"{last}.mu"])):
            with renderer.asking(asked):
                for key in asked:
                    renderer.led_tangent(state, key.split(".")[0], key)

    for x in (0.0, 0.2):
        press(x)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for x in (0.7, 0.9):
            press(x)
        made = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    assert len(made) > 30 and all(k["cache_hit"] for k in made)


def test_arrays_begin_where_every_kernel_can_read_them():
    """numpy's own begin at odd multiples of 16 bytes, or at even ones: each was a kernel of its own."""
    for n in (1, 7, 1000, 100_001):
        values = np.random.default_rng(n).random((1, n))
        found = [aligned(values), aligned(values * 1e6, np.uint32)]
        assert all(a.ctypes.data % 64 == 0 and a.shape == (n,) and a.flags.c_contiguous for a in found)
        assert np.array_equal(found[0], values.astype(np.float32)[0])
        assert np.array_equal(found[1], (values * 1e6).astype(np.uint32)[0])
