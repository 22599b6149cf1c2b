"""Fingerprints by family, and effects drafted from curves: the right family is named, a draft carries its curve, errors
name what can be done."""

import base64
import io
import json
import sys
from copy import copy
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from optics.diagnosis.evidence import measure
from optics.diagnosis.fingerprints import (
    families,
    family_of,
    fingerprints,
    goes_with,
    places,
    unexplained,
)
from optics.diagnosis.patterns import (
    drifting_pattern,
    drifting_text,
    fixed_pattern,
    fixed_text,
    swinging_light,
    swinging_text,
)
from optics.diagnosis.result import Basis, Family, Fingerprint
from optics.diagnosis.statistics import Sweeps
from optics.errors import OutputExists, UnknownKey
from optics.fit.geometry import lit_geometry
from optics.fit.model import value_of
from optics.lookup import lookup
from optics.scene.registry import declared, known
from optics.study import draft

sys.path.insert(0, str(Path(__file__).parent))
from mock_model import MockModel, mock_fit, simulate

FITTED = (0, 1, 2, 3)
DRIFT = [0.02, -0.04, 0.03, 0.0]


@cache
def case(name, strength):
    """Model, fit, evidence and curves of a mock sensor with an effect that no library holds."""
    model = MockModel(len(FITTED), 24)
    start = simulate(model, np.random.default_rng(3), {name: DRIFT if name == "red_drift" else strength})
    fit = mock_fit(model, model.base_variables(FITTED), start, FITTED)
    evidence = measure(model, fit.values, fit.variables, [], FITTED, 400_000, 0, lambda *a: None)
    return (
        model,
        fit,
        evidence,
        fingerprints(model, evidence, places(model, fit.values, evidence), 1.0, lambda *a: None),
    )


@pytest.mark.parametrize(
    "name, strength, family, coordinates",
    [
        ("stain", 0.06, "camera", {"place", "row", "column", "radius"}),
        ("banding", 0.03, "camera", {"row"}),
        ("height_gain", 0.05, "geometry", {"height", "contact_distance", "contact"}),
        ("slope_gain", 0.4, "geometry", {"slope", "contact_distance", "contact"}),
        ("red_drift", 0.0, "time", {"frame"}),
    ],
)
def test_an_unknown_effect_is_put_into_its_family(name, strength, family, coordinates):
    found = case(name, strength)[3]
    first = families(found)[0]
    assert first.family == family and first.coordinate in coordinates
    assert "of the excess misfit a curve along it explains" in goes_with(families(found))
    assert first.of_best == 1 and all(f.of_best <= 1 / 0.8 for f in families(found))
    assert goes_with(families(found)).startswith(
        f"It goes with {'the ' if family == 'camera' else ''}{family} ({first.coordinate}"
    )


def test_the_numbers_of_a_curve_are_those_of_all_values_although_some_found_it():
    model, fit, evidence, found = case("banding", 0.03)
    whole = next(f for f in found if f.coordinate == "row")
    some = measure(model, fit.values, fit.variables, [], FITTED, 2 * evidence.normal.count // 5, 0, lambda *a: None)
    assert some.thinning == 3
    row = next(
        f
        for f in fingerprints(model, some, places(model, fit.values, some), 50.0, lambda *a: None)
        if f.coordinate == "row"
    )
    # chi2 of a third of the values falls by net/3 with a variance of about 4 net/3 + 2 dof; 3 sd, tripled
    assert abs(row.net - whole.net) < 9 * np.sqrt(4 * whole.net / 3 + 2 * whole.dof)
    assert row.net == pytest.approx(3 * (row.fall - row.dof)) and row.ratio == pytest.approx(row.net / 50)
    assert row.share == pytest.approx(row.net / (some.projected.chi2 - (some.normal.count - some.projected.rank)))
    assert row.p < 1e-12


def test_coordinates_of_a_model_in_cells_are_in_pixels_of_the_camera():
    """Of cells of 3 x 3 px the first lies about row 1, the second about row 4; a steepness per cell is three per px."""
    model = MockModel(len(FITTED), 24)
    start = simulate(model, np.random.default_rng(3))
    fit = mock_fit(model, model.base_variables(FITTED), start, FITTED)
    evidence = measure(model, fit.values, fit.variables, [], FITTED, 400_000, 0, lambda *a: None)
    whole = places(model, fit.values, evidence)[0]
    model.cell = 3
    coarse = places(model, fit.values, evidence)[0]
    for name in ("row", "column"):
        assert coarse[name] == pytest.approx(3 * whole[name] + 1)
    for name, power in (("radius", 1), ("gradient", -1), ("laplacian", -2), ("signal", 0), ("place", 0)):
        assert coarse[name] == pytest.approx(3.0**power * whole[name], rel=1e-6, nan_ok=True)


def test_noise_that_is_stated_too_small_is_no_pattern():
    """Six frames with noise 1.5 times as large as stated: gains of pixels take a sixth of the excess, and are noise."""
    model = MockModel(len(FITTED), 24)
    start, rng = simulate(model, np.random.default_rng(3)), np.random.default_rng(4)
    for index, frame in enumerate(model.frames):
        sd = np.sqrt(model.variance(start, index, frame.image))
        frame.image = frame.image + np.sqrt(1.25) * sd * rng.standard_normal(frame.image.shape)
    fit = mock_fit(model, model.base_variables(FITTED), start, FITTED)
    evidence = measure(model, fit.values, fit.variables, [], FITTED, 400_000, 0, lambda *a: None)
    excess = evidence.projected.chi2 - (evidence.normal.count - evidence.projected.rank)
    assert excess > 0.8 * evidence.normal.count and abs(fixed_pattern(model, evidence, excess)) < 0.03


@pytest.mark.parametrize(
    "share, best, by_channel, by_light, said",
    [
        (0.92, 0.52, 0.93, 0.93, "dirt"),  # a smear, which a coarse map of places explains by half
        (0.97, 1.0, 0.97, 0.97, ""),  # bands: a curve along the rows says it with fewer numbers
        (0.33, 0.14, 0.36, 0.4, "dirt"),
        (0.29, 0.14, 0.3, 0.76, "each light has a pattern of its own"),
        (0.32, 0.14, 0.99, 1.0, "in each channel"),  # a pattern of the sensor, different in each channel
        (0.32, 0.14, 0.99, np.nan, "in each channel"),
        (0.04, 0.01, 0.04, 0.04, ""),
        (np.nan, 0.01, np.nan, np.nan, ""),
    ],
)
def test_what_is_fixed_in_the_image_and_what_a_light_brings(share, best, by_channel, by_light, said):
    text = fixed_text(share, best, by_channel, by_light)
    assert (said in text) if said else text == ""


@pytest.mark.parametrize("pattern", ["of pixels", "of channels", "of lights"])
def test_patterns_of_pixels_channels_and_lights_are_told_apart(pattern):
    """30 frames, each under one of three LEDs, with a gain of 3 % (rms) of each pixel, of each pixel and channel, or of
    each pixel under each LED."""
    frames = list(range(30))
    model, rng = MockModel(len(frames), 16), np.random.default_rng(3)
    start = simulate(model, rng)
    gains = 1 + 0.03 * rng.standard_normal((3, 16, 16, 3))
    for n, frame in enumerate(model.frames[: len(frames)]):
        own = {"of pixels": gains[0, ..., :1], "of channels": gains[0], "of lights": gains[n % 3, ..., :1]}[pattern]
        frame.image = 8 + own * (frame.image - 8)
        frame.parameters = {f"led_{n % 3}.power": 1.0}
    fit = mock_fit(model, model.base_variables(frames), start, frames)
    evidence = measure(model, fit.values, fit.variables, [], frames, 400_000, 0, lambda *a: None)
    excess = evidence.projected.chi2 - (evidence.normal.count - evidence.projected.rank)
    shares = [fixed_pattern(model, evidence, excess, *by) for by in ((), (True,), (True, True))]
    said = {"of pixels": "every frame, explains", "of channels": "in each channel", "of lights": "under each light"}
    assert said[pattern] in fixed_text(shares[0], 0.02, *shares[1:]), shares
    thinned = replace(evidence, thinning=3)
    assert np.isnan(fixed_pattern(model, thinned, excess, True, True))


@pytest.mark.parametrize("pattern", ["scratch", "none", "banding"])
def test_a_pattern_fixed_in_the_image_is_told_from_a_curve(pattern):
    """A scratch of one pixel's width across the image, dark by 10 % in every frame: no curve along a coordinate is
    it."""
    model = MockModel(len(FITTED), 24)
    start = simulate(model, np.random.default_rng(3), {"banding": 0.03} if pattern == "banding" else None)
    if pattern == "scratch":
        for frame in model.frames:
            frame.image[range(24), range(24)] = 8 + 0.9 * (frame.image[range(24), range(24)] - 8)
    fit = mock_fit(model, model.base_variables(FITTED), start, FITTED)
    evidence = measure(model, fit.values, fit.variables, [], FITTED, 400_000, 0, lambda *a: None)
    found = fingerprints(model, evidence, places(model, fit.values, evidence), 1.0, lambda *a: None)
    excess = evidence.projected.chi2 - (evidence.normal.count - evidence.projected.rank)
    share, best = fixed_pattern(model, evidence, excess), max(f.share for f in found)
    assert bool(fixed_text(share, best)) == (pattern == "scratch")
    if pattern == "scratch":
        assert share > 0.8
    few, swept = (
        replace(evidence, blocks=evidence.blocks[:2]),
        replace(evidence, spectrum=Sweeps()),
    )  # a table has no image
    assert all(np.isnan(fixed_pattern(model, *given)) for given in ((few, excess), (swept, excess), (evidence, 0.0)))


def of_a_session(pattern, presses=18, side=20):
    """(model, fit, evidence, excess) of presses with a pattern of 3 % that fades within three frames, that stays, or
    that is new in each frame; or with a lamp that wanders by 2 % as slowly."""
    rng = np.random.default_rng(4)
    model = MockModel(presses, side)
    start = simulate(model, rng)
    fields = rng.standard_normal((presses, side, side))
    slow = [fields[0]]
    for field in fields[1:]:
        slow.append(0.7 * slow[-1] + np.sqrt(1 - 0.7**2) * field)
    gains = {
        "fades": 0.03 * np.array(slow),
        "stays": 0.03 * np.repeat(fields[:1], presses, 0),
        "is new": 0.03 * fields,
        "lamp": 0.02 * np.array([s[0, 0] for s in slow])[:, None, None] * np.ones((side, side)),
    }[pattern]
    black = model.noise.black_level
    for frame, gain in zip(model.frames, gains):
        frame.image = (black + (frame.image - black) * (1 + gain[..., None])).astype(np.float32)
    fitted = tuple(range(presses))
    fit = mock_fit(model, model.base_variables(fitted), start, fitted)
    evidence = measure(model, fit.values, fit.variables, [], fitted, 400_000, 0, lambda *a: None)
    return model, fit, evidence, evidence.projected.chi2 - (evidence.normal.count - evidence.projected.rank)


def test_a_pattern_that_successive_frames_share_is_a_sensor_that_changes():
    """Neighbours keep .7 of the pattern, frames six apart .12, and .26 of the values lie far from the contacts: about
    .16 of the excess. One session of 18 presses scatters about that."""
    model, fit, evidence, excess = of_a_session("fades")
    drift = drifting_pattern(model, fit.values, evidence, excess)
    assert drift.p < 0.01 and 0.15 < drift.share < 0.25
    assert "the untouched sensor changes during the session" in drifting_text(drift)
    assert np.isnan(drifting_pattern(model, fit.values, replace(evidence, frames=(0, 1, 2)), excess).share)
    assert np.isnan(drifting_pattern(model, fit.values, replace(evidence, spectrum=Sweeps()), excess).share)


@pytest.mark.slow
@pytest.mark.parametrize("pattern", ["stays", "is new", "lamp"])
def test_what_frames_share_in_any_order_and_a_lamp_are_no_sensor_that_changes(pattern):
    model, fit, evidence, excess = of_a_session(pattern)
    assert not drifting_text(drifting_pattern(model, fit.values, evidence, excess))


@pytest.mark.parametrize(("changed", "named"), [((1,), "led1"), ((), ""), ((0, 1, 2), "")])
def test_one_light_that_changes_from_frame_to_frame_is_named(changed, named):
    """The power of one light wanders by 3 % (rms) in twelve frames; in noise, and where an exposure makes all lights
    wander alike, no light is named."""
    frames = list(range(12))
    model, rng = MockModel(len(frames), 16), np.random.default_rng(6)
    start = simulate(model, rng)
    swing = 0.03 * rng.standard_normal(len(frames))
    for n, frame in enumerate(model.frames[: len(frames)]):
        (before,) = model.predict(start, [n])
        moved = start.copy()
        for light in changed:
            v = model.variable(f"led{light}.power")
            moved.put(v, value_of(model, start, v) * (1 + swing[n]))
        (after,) = model.predict(moved, [n])
        frame.image = frame.image + (after - before).astype(np.float32)
    fit = mock_fit(model, model.base_variables(frames), start, frames)
    evidence = measure(model, fit.values, fit.variables, [], frames, 400_000, 0, lambda *a: None)
    excess = evidence.projected.chi2 - (evidence.normal.count - evidence.projected.rank)
    light, share, rms = swinging_light(model, evidence, excess)
    assert light == named
    if named:
        # presses of their own take up some of it; of twelve draws the rms scatters by a fifth
        assert share > 0.8 and rms == pytest.approx(np.std(swing), rel=0.5)
        assert "led1 alone" in swinging_text(light, share, rms)
    assert named or swinging_text(light, share, rms) == ""


def test_in_noise_no_curve_is_significant_and_none_has_a_share():
    found = case("banding", 0.0)[3]
    assert min(f.p for f in found) * len(found) > 0.01 and all(np.isnan(f.share) for f in found)
    assert "how much a curve along it explains of what the best curve does" in goes_with(
        [Family("camera", "row", 9.0, np.nan, 1.0)]
    )


def test_directions_that_calibration_absorbs_are_not_drawn():
    """A level is what powers of LEDs take up: a curve with it would be large, and noise."""
    _, _, evidence, found = case("banding", 0.03)
    channel, frame = (next(f for f in found if f.coordinate == name) for name in ("channel", "frame"))
    assert channel.kind == frame.kind == "offset" and not any(channel.curve)
    values = evidence.normal.count / len(FITTED)
    assert max(frame.sd) < 2 * np.median(evidence.sigma) / np.sqrt(
        values
    )  # of a mean of noise; ten times that with the level


def test_places_know_texture_and_settings():
    model, fit, evidence, _ = case("banding", 0.03)
    turned = copy(model)
    turned.frames = [
        replace(f, parameters={**f.parameters, "room.heat": 10.0 * i, "led0.power": i})
        for i, f in enumerate(model.frames)
    ]
    found = places(turned, fit.values, evidence)
    assert [set(p["room.heat"]) for p in found] == [{0.0}, {10.0}, {20.0}, {30.0}] and "led0.power" not in found[0]
    prediction = turned.predict(fit.values, [FITTED[0]])[0]
    up, down, left, right, here = (prediction[i, j, 0] for i, j in ((7, 8), (9, 8), (8, 7), (8, 9), (8, 8)))
    at = list(evidence.blocks[0].index).index((8 * 24 + 8) * 3)
    assert found[0]["gradient"][at] == pytest.approx(np.hypot(down - up, right - left) / 2)
    assert found[0]["laplacian"][at] == pytest.approx(up + down + left + right - 4 * here)


def test_a_map_or_a_number_per_frame_comes_first_only_where_no_curve_is_nearly_as_good():
    def curve(name, net):
        return Fingerprint(name, net, 4, 0.0, net, 2.0, "gain", [], [], [], [], family_of(name))

    assert [f.coordinate for f in families([curve("place", 100.0), curve("row", 90.0), curve("frame", 95.0)])] == [
        "row",
        "frame",
    ]
    assert [f.coordinate for f in families([curve("place", 100.0), curve("row", 70.0), curve("frame", 95.0)])] == [
        "place",
        "frame",
    ]
    one = Family("camera", "row", 100.0, 0.9, 1.0)
    assert " or " not in goes_with([one, Family("time", "frame", 95.0, 0.85, 0.95)])


def test_shares_of_curve_effect_and_remainder_add_up():
    found = case("banding", 0.03)[3]
    row = next(f for f in found if f.coordinate == "row")
    assert 0.5 < row.share < 1.1 and row.unit == "px"
    assert unexplained([replace(row, net=900.0)], 100.0, 1000.0) == (
        "The best effect explains 10% of the excess misfit, the best curve, along 'row', 90%. Neither of them explains "
        "the other 10%."
    )
    assert unexplained([replace(row, net=2000.0)], 100.0, 1000.0) == (  # chance makes it more
        "The best effect explains 10% of the excess misfit, the best curve, along 'row', 100%."
    )
    assert "Neither" not in unexplained([replace(row, net=900.0)], 100.0, 1000.0, True)  # a pattern has the rest
    assert unexplained(found, 100.0, 0.0) == ""  # within noise nothing has a share


def test_families_that_explain_alike_are_not_told_apart():
    one, other = Family("camera", "row", 100.0, 0.9, 1.0), Family("geometry", "height", 95.0, 0.85, 0.95)
    assert "or geometry (height 85%), which these captures do not separate" in goes_with([one, other])
    assert "rather than with geometry (height 85%)" in goes_with([one, replace(other, of_best=0.5)])
    assert goes_with([replace(one, net=-1.0)]) == goes_with([]) == ""


def test_a_setting_has_the_family_of_its_part():
    """The family follows from the category of the part, and from the role of a clock."""
    from optics.scene.registry import known

    parts = known().parts
    assert [
        family_of(f"part.{name}", "time" if known().parameter(kind, name).role == "clock" else parts[kind].family)
        for kind, name in (
            ("camera", "exposure"),
            ("source", "time"),
            ("polarizer_film", "angle"),
            ("led", "x"),
            ("gel", "press_depth"),
            ("target", "distance"),
        )
    ] == ["camera", "time", "setting", "light", "geometry", "geometry"]


@pytest.mark.parametrize("name, count", [("place", 16), ("channel", 3), ("frame", len(FITTED))])
def test_a_named_bin_without_data_keeps_its_number(name, count):
    """Where a corner is masked throughout, or a channel saturated, the others must not take its name."""
    model, fit, evidence, whole = case("banding", 0.03)
    found = [{**p, name: np.maximum(p[name], 1)} for p in places(model, fit.values, evidence)]
    one = next(f for f in fingerprints(model, evidence, found, 1.0, lambda *a: None) if f.coordinate == name)
    assert len(one.curve) == len(one.labels) == count
    assert one.centres[1:] == list(range(1, count)) and np.isnan(one.centres[0]) and one.curve[0] == 0
    usual = next(f for f in whole if f.coordinate == name)
    assert one.labels == usual.labels and one.dof < usual.dof


def lit_point(powers):
    """A camera at the origin that looks along z at one point 2 mm off its axis; two lamps that point along z. No
    Mitsuba."""
    hits = SimpleNamespace(
        position=np.array([[[2.0, 0.0, 4.0]]]),
        normal=np.array([[[0.0, 0.0, -1.0]]]),
        origin=np.zeros(3),
        valid=np.ones((1, 1), bool),
        shape=(1, 1),
    )
    axes = tuple(tuple(np.array([float(i == j)]) for j in range(3)) for i in range(3))
    now = {f"{led}.{n}": 0.0 for led in ("near", "above") for n in ("x", "y", "pan", "tilt")} | {
        "near.z": 2.0,
        "above.z": 0.0,
        "above.x": 2.0,
    }
    return SimpleNamespace(
        renderer=SimpleNamespace(wanted=None, hits=lambda now: hits, image=lambda now, led: np.ones((1, 1, 3))),
        turn_to=lambda values, frame: now,
        captures=SimpleNamespace(table=None),
        lit=lambda now: powers,
        scene=SimpleNamespace(
            gel=None,
            leds={led: SimpleNamespace(frame=axes) for led in ("near", "above")},
            key=lambda part, role: f"{part}.{role.split()[-1]}",
            places_of=lambda now: {
                led: np.array([now[f"{led}.{axis}"] for axis in "xyz"]) for led in ("near", "above")
            },
        ),
    )


def test_geometry_of_the_brightest_led_exists_in_every_frame():
    for powers in ({"near": 1.0, "above": 0.5}, {"above": 0.5, "near": 1.0}):
        found = {k: float(v[0, 0]) for k, v in lit_geometry(lit_point(powers), None, 0).items()}
        # to the lamp 45 deg off the normal, to the camera atan(2/4), both to the same side
        assert found["half_angle"] == pytest.approx((45 + np.degrees(np.arctan(0.5))) / 2)
        assert found["led_angle"] == pytest.approx(45) and found["depth"] == pytest.approx(np.hypot(2, 4))
        assert found["near.distance"] == pytest.approx(np.hypot(2, 2)) and found["above.distance"] == pytest.approx(4)
        assert np.isnan(found["light_azimuth"])  # a flat place has none
    dark = lit_geometry(lit_point({}), None, 0)
    assert set(dark) == set(found) and all(np.isnan(v).all() for k, v in dark.items() if k != "depth")


def diagnosis(*found, named=None):
    """As much of a diagnosis as a draft reads."""
    return SimpleNamespace(
        fingerprints=list(found), families=[named] if named else [], basis=SimpleNamespace(signal=50.0)
    )


def load(text, folder, name):
    """The effect that a text declares; its checks are run."""
    effect = declared(draft.write(text, folder, name))[0]
    for check in effect.checks:
        check()
    return effect


def test_a_draft_carries_its_curve_and_lowers_chi2_by_it(tmp_path):
    model, fit, evidence, found = case("banding", 0.03)
    row = next(f for f in found if f.coordinate == "row")
    assert row.kind == "gain"
    text = draft.draft_effect(
        diagnosis(*found), "row", name="bands", black_level=model.noise.black_level, saturation=model.noise.saturation
    )
    act = load(text, tmp_path, "bands").stages["lens"]
    side, black = model.shape[0], model.noise.black_level
    v, u = np.mgrid[:side, :side] + 0.5
    camera = SimpleNamespace(v=v, u=u, bands=1.0)
    flat = act(np.ones((side, side, 3)), camera)
    assert flat[:, 0, 0] - 1 == pytest.approx(
        row.curve, abs=2e-4 * np.abs(row.curve).max()
    )  # a bin per row, written with 4 digits
    assert (act(np.ones((side, side, 3)), SimpleNamespace(v=v, u=u, bands=0.0)) == 1).all()
    before = after = 0.0
    for frame, sigma, use in zip(evidence.frames, evidence.sigma, evidence.use):
        image, prediction = model.frames[frame].image, model.predict(fit.values, [frame])[0]
        before += float(np.sum((((image - prediction) / sigma)[use]) ** 2))
        after += float(np.sum((((image - black - act(prediction - black, camera)) / sigma)[use]) ** 2))
    # the rest of the fall comes when the base is calibrated again with it
    assert before - after > 0.6 * row.net > 100


def test_the_best_coordinate_is_drafted_unless_one_is_named(tmp_path):
    found = case("height_gain", 0.05)[3]
    height = next(f for f in found if f.coordinate == "height")
    named = Family("geometry", "height", height.net, height.share, 1.0)
    text = draft.draft_effect(diagnosis(*found, named=named), name="falls off", black_level=64.0, saturation=1023.0)
    effect = load(text, tmp_path, "falls off")
    assert (effect.part, list(effect.stages), effect.acts, effect.name) == (
        "gel",
        ["segment"],
        ("height",),
        "falls off",
    )
    assert "lowered chi2" in effect.doc


def test_an_offset_becomes_what_its_stage_can_do(tmp_path):
    curve = Fingerprint(
        "row", 100.0, 4, 0.0, 96.0, 2.0, "offset", [0.0, 10.0, 20.0], [1.0, -2.0, 1.0], [0.1] * 3, [], "camera"
    )
    options = {"black_level": 5.0, "saturation": 205.0}
    effect = load(draft.draft_effect(diagnosis(curve), "row", name="amp glow", **options), tmp_path, "amp glow")
    v, u = np.mgrid[:30, :2] + 0.5
    out = effect.stages["sensor"](np.zeros((30, 2, 3)), SimpleNamespace(v=v, u=u, amp_glow=1.0))
    assert out[[0, 5, 10, 20, 29], 0, 0] * 200 == pytest.approx([1.0, -0.5, -2.0, 1.0, 1.0])  # DN
    assert "dark" in effect.acts
    channel = replace(curve, coordinate="channel", centres=[0.0, 1.0, 2.0])
    tint = load(draft.draft_effect(diagnosis(channel), name="tint", **options), tmp_path, "tint").stages["sensor"]
    assert tint(np.zeros((2, 2, 3)), SimpleNamespace(tint=1.0))[1, 1] * 200 == pytest.approx([1.0, -2.0, 1.0])
    text = draft.draft_effect(
        diagnosis(replace(curve, coordinate="height", family="geometry")), "height", name="step", **options
    )
    assert "relative to the mean signal of 50 DN" in text and "0.02, -0.04, 0.02" in text


def test_signal_and_cells_are_read_where_they_are(tmp_path):
    options = {"black_level": 5.0, "saturation": 205.0}
    curve = Fingerprint(
        "signal", 100.0, 4, 0.0, 96.0, 2.0, "gain", [5.0, 105.0, 205.0], [0.0, 0.1, 0.0], [0.01] * 3, [], "camera"
    )
    bend = load(draft.draft_effect(diagnosis(curve), "signal", name="bend", **options), tmp_path, "bend").stages[
        "response"
    ]
    image = np.array([0.0, 0.25, 0.5, 0.9])
    assert bend(image, SimpleNamespace(bend=1.0)) == pytest.approx(image * (1 + np.array([0.0, 0.05, 0.1, 0.02])))
    slope = bend(image + 1e-30j, SimpleNamespace(bend=1.0)).imag / 1e-30
    step = (bend(image + 1e-6, SimpleNamespace(bend=1.0)) - bend(image - 1e-6, SimpleNamespace(bend=1.0))) / 2e-6
    assert slope[[1, 3]] == pytest.approx(step[[1, 3]], rel=1e-6)  # 0 and 0.5 are corners of the polygon
    cells = replace(
        curve, coordinate="place", centres=list(range(16)), curve=[0.01 * k for k in range(16)], sd=[0.001] * 16
    )
    stain = load(draft.draft_effect(diagnosis(cells), "place", name="stain", **options), tmp_path, "stain").stages[
        "lens"
    ]
    v, u = np.mgrid[:10, :14] + 0.5  # sides that four does not divide, as `places` cuts them
    out = stain(np.ones((10, 14, 3)), SimpleNamespace(v=v, u=u, width=14, height=10, stain=1.0))
    row, column = np.mgrid[:10, :14]
    assert out[..., 0] == pytest.approx(1 + 0.01 * (row * 4 // 10 * 4 + column * 4 // 14))


@pytest.mark.parametrize(
    "x", [2.0, np.array([1.0, 2.0, 9.0]).reshape(3, 1, 1)]
)  # set in a frame; swept from reading to reading
def test_a_setting_of_any_part_is_drafted_whatever_the_scene_calls_it(x, tmp_path):
    curve = Fingerprint("eye.gain", 100.0, 4, 0.0, 96.0, 2.0, "gain", [1.0, 3.0], [0.0, 0.2], [0.01] * 2, [], "camera")
    found = diagnosis(
        curve,
        replace(curve, coordinate="lamp.time", family="time"),
        replace(curve, coordinate="led_1.distance", family="geometry"),
    )
    assert draft.drafted(found) == ["eye.gain", "lamp.time"]
    for along in draft.drafted(found):
        act = load(
            draft.draft_effect(found, along, name="step", black_level=0.0, saturation=1.0), tmp_path / along, "step"
        ).stages["sensor"]
        image = act(np.ones((3, 2, 3)), SimpleNamespace(settings={along: x}, step=1.0))
        assert image == pytest.approx(
            np.broadcast_to(1.1 if np.ndim(x) == 0 else np.array([1.0, 1.1, 1.2]).reshape(3, 1, 1), (3, 2, 3))
        )


def test_a_table_has_each_place_once_and_a_strength_that_is_plausible():
    options, nan = {"name": "x", "black_level": 0.0, "saturation": 1.0}, np.nan
    curve = Fingerprint(
        "incidence",
        9.0,
        4,
        0.0,
        8.0,
        2.0,
        "gain",
        [30.0, 10.0, nan, 10.0],
        [0.5, -2.0, 7.0, 8.0],
        [0.01] * 4,
        [],
        "light",
    )
    text = draft.draft_effect(diagnosis(curve), **options)
    assert "AT = [\n    10, 30,\n]" in text and "    -2, 0.5,\n]" in text
    assert "plausible=0.25," in text  # half of the light at most
    assert "along the brightest LED" in text
    assert "plausible=1," in draft.draft_effect(diagnosis(replace(curve, curve=[0.1, 0.2, nan, nan])), **options)
    with pytest.raises(ValueError, match="has 1 points; a table needs two"):
        draft.draft_effect(diagnosis(replace(curve, centres=[10.0, nan, nan, 10.0])), **options)
    with pytest.raises(ValueError, match="0 everywhere"):
        draft.draft_effect(diagnosis(replace(curve, curve=[0.0] * 4)), **options)


def test_lookup_of_dr_jit_is_that_of_numpy_and_so_is_its_slope(mitsuba):
    import drjit as dr

    at, values, x = [0.0, 1.0, 3.0], [1.0, 2.0, -2.0], np.array([-5.0, 0.5, 2.0, 9.0])
    there = mitsuba.Float(x)
    dr.enable_grad(there)
    dr.set_grad(there, 1.0)
    found = lookup(there, at, values)
    assert np.array(found) == pytest.approx(lookup(x, at, values), abs=1e-6)  # float32
    assert np.array(dr.forward_to(found)) == pytest.approx([0.0, 1.0, -2.0, 0.0], abs=1e-6)


def test_lookup():
    at, values = [0.0, 1.0, 3.0], [1.0, 2.0, -2.0]
    assert lookup(np.array([-5.0, 0.0, 0.5, 1.0, 2.0, 3.0, 9.0]), at, values) == pytest.approx(
        [1.0, 1.0, 1.5, 2.0, 0.0, -2.0, -2.0]
    )
    assert np.imag(lookup(np.array([-5.0, 0.5, 2.0, 9.0]) + 1e-30j, at, values)) / 1e-30 == pytest.approx(
        [0.0, 1.0, -2.0, 0.0]
    )
    assert np.isnan(lookup(np.nan, at, values))
    for wrong in ([0.0, 0.0, 1.0], [0.0, 1.0]):
        with pytest.raises(ValueError, match="places rising"):
            lookup(0.5, wrong, values)


# -- what cannot be --------------------------------------------------------------------------------------------------
def test_what_no_draft_can_carry_is_refused_with_the_alternatives():
    known = [
        Fingerprint(c, 9.0, 1, 0.0, 8.0, 2.0, "gain", [0.0, 1.0], [0.0, 0.1], [0.01] * 2, [], "camera")
        for c in ("laplacian", "row", "contact_distance")
    ]
    options = {"name": "x", "black_level": 0.0, "saturation": 1.0}
    with pytest.raises(ValueError, match="no draft along 'laplacian': .* mixes pixels.*; a draft can follow row"):
        draft.draft_effect(diagnosis(*known), "laplacian", **options)
    with pytest.raises(ValueError, match="no stage of a model sees it; a draft can follow row"):
        draft.draft_effect(diagnosis(*known), "contact_distance", **options)
    with pytest.raises(UnknownKey, match="did you mean 'row'"):
        draft.draft_effect(diagnosis(*known), "rows", **options)
    with pytest.raises(ValueError, match="diagnose the study again"):
        draft.draft_effect(diagnosis(), "row", **options)


@pytest.fixture
def study(tmp_path):
    """The record of a study with a diagnosis, as much of it as a draft reads."""
    known = [
        Fingerprint(c, 9.0, 1, 0.0, 8.0, 2.0, "gain", [0.0, 1.0], [0.0, 0.1], [0.01] * 2, [], "camera")
        for c in ("row", "height")
    ]
    record = {
        "format": 1,
        "scene": "gelsight",
        "noise": {"black_level": 8.0, "saturation": 255.0},
        "inputs": {},
        "shown": [],
        "facts": {"setup": {"captures": str(tmp_path / "captures"), "plugins": None}},
        "prints": ["00a1b2c3d4e5", "10a1b2c3d4e5"],
        "steps": [],
    }
    told = {
        "word": "UNKNOWN",
        "sentence": "",
        "conditions": [],
        "rows": [],
        "ambiguous": [],
        "compared": [],
        "gaps": [],
        "correct": [],
        "splits": [],
        "levels": [],
        "shifts": [],
        "hints": [],
        "not_tested": {},
        "warnings": [],
        "basis": {f.name: [] if f.name.startswith("frame_") else 0 for f in fields(Basis)},
        # as written before coordinates had families
        "fingerprints": [
            {
                k: getattr(f, k)
                for k in ("coordinate", "fall", "dof", "p", "net", "ratio", "kind", "centres", "curve", "sd", "labels")
            }
            for f in known
        ],
    }
    folder = tmp_path / "study"
    (folder / "steps" / "00-base").mkdir(parents=True)
    (folder / "ladder.json").write_text(json.dumps(record))
    (folder / "steps" / "00-base" / "step.json").write_text(
        json.dumps({"index": 0, "name": "base", "folder": "00-base", "effect": None, "frames": [], "fingerprints": []})
    )
    (folder / "steps" / "00-base" / "diagnosis.json").write_text(json.dumps(told))
    return folder


def test_effects_new_writes_a_draft_into_the_study_and_never_twice(study, optics):
    code, said, noted = optics("effects", "new", "Row bands", "--from", study)
    file = study / "plugins" / "row_bands.py"
    assert code == 0 and said.strip() == str(file) and f"optics add {study}" in noted
    text = file.read_text()
    code, _, error = optics("effects", "new", "row bands", "--from", study)
    assert code == 2 and "an effect 'row bands' exists already" in error and file.read_text() == text
    with pytest.raises(OutputExists, match="row_bands.py exists"):
        draft.write("", file.parent, "row bands")
    code, page, _ = optics("effects", "row-bands", "--plugins", file.parent)
    assert code == 0 and "REPLACE the table" in page and "row_bands.py" in page


def test_a_draft_is_of_the_last_diagnosis(study, optics):
    base = study / "steps" / "00-base"
    later = base.with_name("01-more")
    later.mkdir()
    (later / "step.json").write_text(
        json.dumps({**json.loads((base / "step.json").read_text()), "index": 1, "name": "more", "folder": later.name})
    )
    told = json.loads((base / "diagnosis.json").read_text())
    (later / "diagnosis.json").write_text(
        json.dumps({**told, "fingerprints": [{**told["fingerprints"][0], "coordinate": "column"}]})
    )
    code, said, _ = optics("effects", "new", "stripes", "--from", study)
    assert code == 0 and Path(said.strip()) == study / "plugins" / "stripes.py"
    assert "along 'column'" in Path(said.strip()).read_text() and "step 'more'" in Path(said.strip()).read_text()


def test_effects_new_writes_a_stub(tmp_path, optics):
    code, said, _ = optics("effects", "new", "soft edge", "--part", "led", "-o", tmp_path / "mine")
    assert code == 0 and Path(said.strip()) == tmp_path / "mine" / "soft_edge.py"
    code, page, _ = optics("effects", "soft edge", "--plugins", tmp_path / "mine")
    assert code == 0 and "emission" in page


@pytest.mark.parametrize(
    "words, error",
    [
        (("new",), "no name"),
        (("new", "2 fast"), "the first a letter"),
        (("new", "new"), "not 'new'"),
        (("new", "class"), "not a word of Python"),
        (("new", "lens vignetting"), "exists already"),
        (("new", "gain"), "has a parameter 'gain'"),
        (("new", "tan"), "means something else"),
        (("new", "number", "--part", "gel"), "choose another"),
        (("new", "a", "-o", "file"), "is a file and no folder"),
        (("new", "a", "--stage", "layer"), "copy a file"),
        (("new", "a", "--stage", "lense"), "did you mean 'lens'"),
        (("new", "a", "--part", "sheet"), "unknown part"),
        (("new", "a", "--part", "gel", "--stage", "lens"), "belongs to the part 'camera'"),
        (("new", "a", "--along", "row"), "Add --from STUDY"),
        (("vignetting", "--stage", "lens"), "only with `optics effects new NAME`"),
        (("halo", "bright"), "only with"),
        (("new", "a", "--from", "STUDY", "--along", "rows"), "did you mean 'row'"),
        (("new", "a", "--from", "STUDY", "--stage", "lens"), "leave them out"),
    ],
)
def test_errors_of_effects_new(words, error, study, tmp_path, optics, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    code, said, noted = optics("effects", *(study if w == "STUDY" else w for w in words))
    assert code == 2 and error in noted and not said
    assert not (tmp_path / "plugins").exists()


def test_a_study_without_a_diagnosis_or_without_a_gel(study, optics):
    record = json.loads((study / "ladder.json").read_text())
    (study / "ladder.json").write_text(json.dumps({**record, "scene": "polarizer_bench"}))
    code, _, error = optics("effects", "new", "a", "--from", study, "--along", "height")
    assert code == 2 and "passes no gel; a draft can follow row" in error
    (study / "ladder.json").write_text(json.dumps({**record, "scene": "magictac"}))
    code, _, error = optics("effects", "new", "a", "--from", study, "--along", "height")
    assert code == 2 and "followed by Monte Carlo" in error and "a draft can follow row" in error
    (study / "steps" / "00-base" / "diagnosis.json").unlink()
    code, _, error = optics("effects", "new", "a", "--from", study)
    assert code == 2 and "optics diagnose" in error


def test_names_that_functions_of_a_camera_see_are_those_that_no_effect_may_take():
    from optics.light.development import Developer

    own = {"x_fov": 40.0, "principal_x": 0.0, "principal_y": 0.0, "aspect": 1.0}
    camera = SimpleNamespace(
        name="camera",
        kind="camera",
        registry=known(),
        resolution=(4, 3),
        sensitivity="identity",
        channels=(),
        curves={},
        clock="",
        integral=None,
        numbers={n: SimpleNamespace(neutral=None) for n in own},
        normalised=lambda own, u, v: (u, v, 1.0),
    )
    view = Developer(camera, (450.0, 550.0, 650.0)).view({f"camera.{n}": value for n, value in own.items()})
    assert set(vars(view)) - set(own) == set(draft.VIEW)


def test_no_effect_is_called_new(tmp_path):
    from optics.errors import BadPlugin

    (tmp_path / "new.py").write_text(draft.new_effect("old").replace('name="old"', 'name="new"'))
    with pytest.raises(BadPlugin, match="cannot be called 'new'"):
        known(tmp_path)


@pytest.mark.parametrize("word", ["takes", "held", "eval"])  # of every part, of an instance, of Mitsuba's own classes
def test_no_parameter_hides_an_attribute_of_its_part(word, tmp_path):
    from optics.errors import BadPlugin
    from optics.scene.mitsuba_parts import use_variant

    (tmp_path / "glint.py").write_text(
        "from optics.scene.declare import Effect\nfrom optics.scene.parameter import Parameter\n\n"
        f"GLINT = Effect(name='glint', part='membrane', parameters=(Parameter('{word}', '1', 0.0, neutral=0.0),))\n"
    )
    with pytest.raises(BadPlugin, match=f"glint.py: parameter '{word}' has the name of something else"):
        use_variant(registry=known(tmp_path))


# -- residuals in a report -------------------------------------------------------------------------------------------
def test_components_find_what_frames_have_in_common():
    from optics.pages.residual_maps import components
    from optics.study.record import Shown

    rng = np.random.default_rng(0)
    one, pattern = np.ones((20, 30, 1)), np.sin(np.arange(30) / 3)[None, :, None] * np.ones((20, 1, 1))
    weights = (2.0, -2.0, 1.0, 0.0, 0.0, 0.0)
    frames = [
        Shown(f"f{i}", w * pattern + rng.standard_normal((20, 30, 1)), 0 * one, one, one > 0)
        for i, w in enumerate(weights)
    ]
    found = components(frames)
    scores = np.array([float(s["score"].replace("−", "-")) for s in found["components"][0]["scores"]])
    assert scores[0] * scores[1] < 0 and np.abs(scores[:2]).min() > 1 and np.abs(scores[3:]).max() < 0.6
    # 9 w^2/2 sums to 4.5 of the pattern beside 6 of the noise, of which the first component has a sixth
    assert float(found["components"][0]["share"].split("\u202f")[0]) == pytest.approx(100 * (4.5 + 1) / 10.5, abs=8)
    assert components(frames[:2])["components"] == []
    one = np.ones((192, 288, 1))
    fine = [Shown(f"f{i}", rng.standard_normal(one.shape), 0 * one, one, one > 0) for i in range(6)]
    of_noise = [float(s["score"].replace("−", "-")) for s in components(fine)["components"][0]["scores"]]
    assert sum(s * s for s in of_noise) == pytest.approx(
        1, abs=0.15
    )  # means over 3 x 3 px, still in sigmas; the largest of six is above 1


def test_pages_belong_to_the_first_and_the_last_step():
    from optics.fit.compare import compare
    from optics.pages.residual_maps import coordinates, pages

    rng = np.random.default_rng(4)
    images, one = rng.standard_normal((6, 32, 48, 3)), np.ones((32, 48, 3))
    c = compare(list(images), [0 * one] * 6, [one] * 6, [one > 0] * 6)
    steps = [{"index": i, "name": name} for i, name in enumerate(("base", "a", "b"))]
    assert [len(pages([c] * n, [[]] * n, steps[:n])) for n in (1, 3)] == [1, 2]
    assert [p["step"] for p in pages([c] * 3, [[]] * 3, steps)] == ["base", "+ b"]
    told = {
        "fingerprints": [
            {"coordinate": n, "net": net, "share": 0.5, "ratio": 2.0, "family": "camera"}
            for n, net in (("row", 8), ("x", -1))
        ]
    }
    assert [(r["name"], r["bar"]) for r in coordinates(told)] == [("row", "100.0")] and coordinates(None) == []


def decoded(uri):
    from PIL import Image

    return Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2])))


def test_colours_of_noise_are_alike_in_an_image_and_in_a_mosaic():
    """In a mosaic a block holds a quarter of the pixels of a channel, and its mean scatters twice as much."""
    from optics.fit.compare import compare
    from optics.pages.residual_maps import colours, regions

    rng = np.random.default_rng(2)
    images, full = rng.standard_normal((8, 128, 128, 3)), np.ones((128, 128, 3), bool)
    mosaic = np.zeros_like(full)
    mosaic[::2, ::2, 0] = mosaic[1::2, ::2, 1] = mosaic[::2, 1::2, 1] = mosaic[1::2, 1::2, 2] = True
    mosaic[:8, :8] = False  # a block that holds nothing
    for usable in (full, mosaic):
        c = compare(list(images), [np.zeros_like(images[0])] * 8, [np.ones_like(images[0])] * 8, [usable] * 8)
        sd = (
            np.asarray(decoded(colours(c)), float).std((0, 1)) / 255 * 10
        )  # of 4096 blocks: good to 1 %, and 4 % more of 16 levels
        assert sd == pytest.approx(1.0, abs=0.08)
        regions(c)


def test_regions_tell_a_wrong_mean_from_a_wide_spread():
    from optics.fit.compare import compare
    from optics.pages.residual_maps import regions

    rng = np.random.default_rng(1)
    images = rng.standard_normal((12, 32, 48, 1))
    images[:, :16] += 0.5
    images[:, 16:, 24:] *= 1.6
    c = compare(
        list(images), [np.zeros((32, 48, 1))] * 12, [np.ones((32, 48, 1))] * 12, [np.ones((32, 48, 1), bool)] * 12
    )
    found = regions(c)
    assert decoded(found["mean"]).size == decoded(found["sd"]).size == (16, 11) and found["cell"] == 3
    assert 0.4 < float(found["mean_top"]) < 0.95 and 1.4 < float(found["worst"]) < 2.1
    images = 5 + 0.1 * rng.standard_normal((12, 32, 48, 1))  # wrong, and steady
    c = compare(
        list(images), [np.zeros((32, 48, 1))] * 12, [np.ones((32, 48, 1))] * 12, [np.ones((32, 48, 1), bool)] * 12
    )
    assert float(regions(c)["worst"]) < 0.2


def test_a_draft_is_advised_only_along_what_a_draft_can_follow():
    from optics.diagnosis.remarks import hints_of

    def hints(coordinate):
        outcome = SimpleNamespace(survivors=[])
        findings = SimpleNamespace(shared=False, another_law=False, law="", coordinate=coordinate)
        return " ".join(hints_of("UNKNOWN", [], outcome, findings, [], []))

    assert "optics effects new NAME --from STUDY" in hints("radius")
    assert "no effect can be drafted along 'LED'" in hints("LED") and "effects new" not in hints("LED")
