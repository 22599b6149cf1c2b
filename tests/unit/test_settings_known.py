"""What the experimenter knows besides the values: how well settings are known, what is not there, what is ruled out."""

from pathlib import Path

import numpy as np
import pytest

from optics.captures import capture_set as capture_files
from optics.captures.capture_set import Captures, Frame, Table
from optics.captures.noise import Noise, estimate, repeated
from optics.errors import BadCapture, Underdetermined, UnknownKey
from optics.fit import calibrate
from optics.scene.parameter import Values

METER = Noise(0.0, 1.0, 0.0, 1000.0, 0.0, 0.0, signed=True, ends=False)
DIAL = 0.5  # deg, one standard deviation


def readings(angles, uncertainty, parameters=None, groups=None, values=None):
    """A table in memory: one row for each angle of the analyser."""
    frames = [
        Frame(
            f"row {i}",
            np.full((1, 1, 1), 0.0 if values is None else values[i], np.float32),
            group=None if groups is None else groups[i],
            parameters={"analyzer.angle": float(a)},
        )
        for i, a in enumerate(angles)
    ]
    return Captures(
        Path("."),
        "polarizer_bench",
        frames,
        dict(parameters or {}),
        METER,
        table=Table("readings.csv", ["reading"]),
        uncertainty=dict(uncertainty),
    )


@pytest.fixture(scope="module")
def bench(mitsuba):
    from optics.scene import loader

    return loader.load("polarizer_bench")


@pytest.fixture(scope="module")
def model_of(bench):
    from optics.fit.scene_model import SceneModel

    return lambda captures: SceneModel(bench, captures)


# -- readings: errors of settings in the variance --------------------------------------------------------------------
def test_the_variance_of_a_reading_is_that_of_dials_turned_at_random(model_of):
    """The mean square of 4000 dial errors per angle, to second order: where the slope vanishes, half a degree still
    brings light. The mean of e^4 from n draws is known to sqrt(32/3/n), 5.2 %, that of e^2 to 2.2 %; five of these."""
    angles, draws = np.array([0.0, 10.0, 30.0, 45.0, 70.0, 90.0]), 4000
    model = model_of(readings(angles, {"analyzer.angle": DIAL}))
    values = Values({"source.power": 2.4})
    prediction = model.predict(values, [0])[0]
    brought = (model.variance(values, 0, prediction) - model.noise.variance(prediction)).ravel()
    rng = np.random.default_rng(4)
    turned = (np.sort(angles)[:, None] + DIAL * rng.standard_normal((len(angles), draws))).reshape(-1, 1, 1)
    twin = model.imagine([Frame("turned", np.zeros(turned.shape, np.float32), readings={"analyzer.angle": turned})])
    drawn = twin.predict(values, [len(model.frames)])[0].reshape(len(angles), draws)
    assert brought.max() > 40 * model.noise.variance(0.0)  # the dial, not the meter, is what scatters
    steep = np.sin(2 * np.radians(np.sort(angles))) > 0.1
    tolerance = 5 * np.where(steep, np.sqrt(2 / draws), np.sqrt(32 / 3 / draws))
    assert np.all(np.abs(np.mean((drawn - prediction[:, :, 0]) ** 2, 1) / brought - 1) < tolerance)
    # in closed form: P = P0 cos^2 with P0 = 2.4 x 0.8^2/2 x 1000, P' = -P0 sin(2 angle), P'' = -2 P0 cos(2 angle)
    t, dial, top = 2 * np.radians(np.sort(angles)), np.radians(DIAL), 2.4 * 0.32 * 1000
    np.testing.assert_allclose(
        brought, (top * np.sin(t) * dial) ** 2 + 0.75 * (2 * top * np.cos(t) * dial**2) ** 2, rtol=1e-3
    )


def test_the_variance_follows_the_values_and_is_kept(model_of, monkeypatch):
    """Twice the light, four times the variance; at values that were asked for before, nothing is computed."""
    model = model_of(readings([0.0, 20.0, 50.0, 80.0], {"analyzer.angle": DIAL}))
    one, two = Values({"source.power": 1.0}), Values({"source.power": 2.0})
    zero = np.zeros((4, 1, 1))
    first = model.variance(one, 0, zero) - 1.0
    np.testing.assert_allclose(model.variance(two, 0, zero) - 1.0, 4 * first, rtol=1e-9)
    monkeypatch.setattr(model, "_tangent", lambda *a: pytest.fail("differentiated again"))
    np.testing.assert_array_equal(model.variance(one, 0, zero) - 1.0, first)


def test_readings_at_an_unmoved_dial_share_its_error(model_of):
    """Sets of 6 angles with 5 readings at each: what a weighted fit says of the lamp's power is how it scatters over
    2000 sets whose dial errors are drawn once per angle (a standard deviation from n sets is known to 1/sqrt(2n),
    1.6 %: five of these). Were the five readings taken as independent, it would be 2.2 times too small."""
    places, each, sets = np.array([15.0, 30.0, 45.0, 60.0, 75.0, 85.0]), 5, 2000
    model = model_of(readings(np.repeat(places, each), {"analyzer.angle": DIAL}))
    truth = Values({"source.power": 2.4})
    order = np.concatenate([f.rows.ravel() for f in model.frames]).astype(int)
    prediction = np.concatenate(model.predict(truth)).ravel()
    weight = 1 / np.concatenate([model.variance(truth, i, p) for i, p in enumerate(model.predict(truth))]).ravel()
    slope = prediction / 2.4
    said = 1 / np.sqrt(weight @ slope**2)
    rng = np.random.default_rng(5)
    turned = places + DIAL * rng.standard_normal((sets, len(places)))
    true = 2.4 * 320 * np.cos(np.radians(np.repeat(turned, each, 1))) ** 2
    measured = (true + rng.standard_normal(true.shape))[:, order]
    found = (measured * weight) @ slope / (weight @ slope**2)
    assert found.std() == pytest.approx(said, rel=5 / np.sqrt(2 * sets))


def test_rows_that_return_to_a_setting_are_drawn_anew():
    """Only consecutive rows share a draw: 0, 0, 20, 0 is three draws, of two rows and one and one."""
    swept = sweep(readings([0.0, 0.0, 20.0, 0.0], {"analyzer.angle": DIAL}))
    weighed = {int(r): float(sd) for f in swept.frames for r, sd in zip(f.rows.ravel(), sds(f))}
    assert weighed == pytest.approx({0: DIAL * np.sqrt(2), 1: DIAL * np.sqrt(2), 2: DIAL, 3: DIAL})


def test_rows_that_share_an_error_are_held_out_together():
    """Twelve positions of the dial, each read four times: no sweep has a part of the readings at one position."""
    captures = readings(np.repeat(np.arange(0.0, 120.0, 10.0), 4), {"analyzer.angle": DIAL})
    rows = [set((f.rows.ravel() // 4).astype(int)) for f in sweep(captures).frames]
    assert len(rows) == 8 and sum(map(len, rows)) == 12 == len(set().union(*rows))
    captures.uncertainty = {}  # a dial without errors: each reading is dealt out by itself
    assert sum(len(set((f.rows.ravel() // 4).astype(int))) for f in sweep(captures).frames) == 48


def sweep(captures):
    from optics.scene.registry import known

    parts = known()
    parameters = {f"analyzer.{p.name}": p for p in parts.parameters_of("polarizer_film")}
    parameters |= {f"polarizer.{p.name}": p for p in parts.parameters_of("polarizer_film")}
    return capture_files.sweeps(captures, parameters, ["source"])


def sds(frame):
    return np.broadcast_to(frame.uncertainty["analyzer.angle"], frame.rows.shape).ravel()


def test_groups_of_a_table_make_sweeps(model_of):
    captures = readings(np.arange(40.0), {}, groups=["up"] * 20 + ["down"] * 20)
    frames = sweep(captures).frames
    assert [(f.group, len(f.image)) for f in frames] == [("up", 20), ("down", 20)]


def test_readings_at_one_setting_are_predicted_each(model_of):
    """A sweep in which nothing moves has a prediction for every reading, and its derivatives."""
    from optics.scene.parameter import Variable

    model = model_of(readings([30.0] * 5, {}))
    power = Variable("source.power", ("source.power",), model.parameters["source.power"])
    prediction, images = next(iter(model.derivatives(Values(), [power])))
    assert prediction.shape == images["source.power"].shape == model.predict(Values())[0].shape == (5, 1, 1)


# -- settings whose error many values share: variables with a prior --------------------------------------------------
def test_a_setting_made_once_is_solved_for_with_its_uncertainty(model_of, tmp_path):
    """The fixed polarizer's angle, whether stated for the set or in a column that never changes."""
    from optics.study.setup import Setup, variables_of_base

    stated = readings(np.arange(0.0, 180.0, 5), {"polarizer.angle": 1.0}, {"polarizer.angle": 20.0})
    column = readings(np.arange(0.0, 180.0, 5), {"polarizer.angle": 1.0})
    for f in column.frames:
        f.parameters["polarizer.angle"] = 20.0
    for captures in (stated, column):
        model = model_of(captures)
        variables = variables_of_base(model, Setup("."), range(len(model.frames)))
        known = [v for v in variables if v.keys == ("polarizer.angle",)]
        assert [(v.frames, v.prior) for v in known] == [(None, (20.0, 1.0))]
        assert not any(model._dialled(i) for i in range(len(model.frames)))


def test_a_setting_that_lasts_is_one_variable_for_its_readings(model_of):
    """Two positions of the polarizer, each for a sweep of 36 readings: two draws, not 72."""
    from optics.study.setup import Setup, variables_of_base

    captures = readings([*np.arange(0.0, 180.0, 5)] * 2, {"polarizer.angle": 1.0})
    for i, f in enumerate(captures.frames):
        f.parameters["polarizer.angle"] = 0.0 if i < 36 else 30.0
    model = model_of(captures)
    frames = range(len(model.frames))
    variables = [v for v in variables_of_base(model, Setup("."), frames) if v.keys == ("polarizer.angle",)]
    assert [v.prior for v in variables] == [(0.0, 1.0), (30.0, 1.0)]
    assert sorted(i for v in variables for i in v.frames) == list(frames)
    for v in variables:
        assert {model.frames[i].parameters["polarizer.angle"] for i in v.frames} == {v.prior[0]}


def test_images_that_follow_each_other_at_a_setting_share_its_error():
    """Two films between crossed ones: the analyser stays for three frames, and is set anew in another group."""
    angles, groups = [90.0, 90.0, 90.0, 0.0, 0.0, 0.0], [None, None, None, None, None, "again"]
    frames = [
        Frame(
            f"{i}", np.zeros((2, 2, 1), np.float32), group=g, parameters={"analyzer.angle": a, "sample.angle": 10.0 * i}
        )
        for i, (a, g) in enumerate(zip(angles, groups))
    ]
    captures = Captures(Path("."), "polarizer_bench", frames, uncertainty={"analyzer.angle": 1.0, "sample.angle": 1.0})
    made = [f.made for f in capture_files.with_lasting_settings(captures).frames]
    assert [m["analyzer.angle"] for m in made] == [0, 0, 0, 1, 1, 2]
    assert [m["sample.angle"] for m in made] == [0, 1, 2, 3, 4, 5]


def test_readings_of_an_instrument_that_shows_nothing_below_0_are_limits(model_of):
    """Three zeros, and none below, are left out; where a negative reading is among them, zeros are readings."""
    values, angles = [0.0, 0.0, 0.0, 5.0, 90.0, 200.0, 300.0, 150.0], np.arange(0.0, 80.0, 10.0)
    model = model_of(readings(angles, {}, values=values))
    kept = np.concatenate([model.usable(i).ravel() for i in range(len(model.frames))])
    assert model.cut_off and kept.sum() == 5
    for others in ([-1.0, *values[1:]], [2.0, *values[1:]]):
        model = model_of(readings(angles, {}, values=others))
        assert not model.cut_off and all(model.usable(i).all() for i in range(len(model.frames)))


SIZE = 6  # px


@pytest.fixture(scope="module")
def pictures(mitsuba):
    """A camera between polarizers: four frames, whose analyser stood elsewhere than its dial said."""
    from optics.fit.scene_model import SceneModel
    from optics.scene import loader

    scene = loader.load("polarizer_bench", {"width": SIZE, "height": SIZE, "x_fov": 8})
    noise = Noise(0.01, 1.0, 20.0, 1000.0, 0.0, 0.0)
    said, errors = [20.0, 40.0, 60.0, 75.0], [0.6, -0.9, 1.2, -0.4]
    frames = [
        Frame(f"f{i}", np.zeros((SIZE, SIZE, 1), np.float32), parameters={"analyzer.angle": a})
        for i, a in enumerate(said)
    ]
    captures = Captures(Path("."), str(scene.path), frames, noise=noise, uncertainty={"analyzer.angle": 1.0})
    model = SceneModel(scene, captures)
    true = Values({"source.power": 2.0}, {i: {"analyzer.angle": a + e} for i, (a, e) in enumerate(zip(said, errors))})
    rng = np.random.default_rng(1)
    for f, image in zip(model.frames, model.predict(true)):
        f.image = (image + rng.standard_normal(image.shape)).astype(np.float32)
    return model, [a + e for a, e in zip(said, errors)]


def test_the_error_of_a_frames_setting_is_solved_for(pictures):
    """In fitted and in held-out frames, each about what the frame set; without the uncertainty the dial is believed."""
    from optics.study.setup import Setup, variables_of_base
    from optics.study.stages import fit_base, held_out_values

    model, true = pictures
    fitted, held = [0, 1, 3], [2]
    variables = variables_of_base(model, Setup("."), fitted)
    own = [v for v in variables if v.keys == ("analyzer.angle",)]
    assert [(v.frames, v.prior) for v in own] == [((0,), (20.0, 1.0)), ((1,), (40.0, 1.0)), ((3,), (75.0, 1.0))]
    found = fit_base(model, variables, fitted, Values())
    assert found.converged and found.chi2 / found.dof < 1 + 5 * np.sqrt(2 / found.dof)
    values, count = held_out_values(model, found, held)
    assert count == 1
    again = calibrate.for_frames(model, found.variables, held)
    assert [(v.name, v.frames, v.prior) for v in again] == [("analyzer.angle[f2]", (2,), (60.0, 1.0))]
    sd = dict(zip([v.name for v in found.variables], found.sd))
    for i, frames in enumerate([(0,), (1,), (2,), (3,)]):
        at = (found.values if i in fitted else values).frame[i]["analyzer.angle"]
        # four standard deviations; the held-out frame's power is known to that of the fit
        assert abs(at - true[i]) < 4 * max(sd.values()), (frames, at, true[i])
    for f in model.frames:
        f.image = f.image  # images stay
    model.captures.uncertainty = {}
    try:
        believed = variables_of_base(model, Setup("."), fitted)
        assert [v.keys for v in believed if v.frames is not None] == []
        plain = fit_base(model, believed, fitted, Values())
        assert plain.chi2 / plain.dof > 2  # the dials are wrong by a degree
    finally:
        model.captures.uncertainty = {"analyzer.angle": 1.0}


def test_a_frames_own_uncertainty_replaces_the_sets(pictures):
    from optics.study.setup import Setup, variables_of_base

    model, _ = pictures
    model.frames[1].uncertainty, model.frames[2].uncertainty = {"analyzer.angle": 0.1}, {"analyzer.angle": 0.2}
    model.frames[3].uncertainty = {"analyzer.angle": 0.0}  # exact
    try:
        own = [v for v in variables_of_base(model, Setup("."), [0, 1, 3]) if v.frames]
        assert [(v.frames, v.prior) for v in own] == [((0,), (20.0, 1.0)), ((1,), (40.0, 0.1))]
        assert [v.prior for v in calibrate.for_frames(model, own, [2])] == [(60.0, 0.2)]
    finally:
        for f in model.frames:
            f.uncertainty = {}


def test_what_is_free_anyway_gets_its_setting_as_prior(pictures):
    from optics.study.setup import Setup, variables_of_base

    model, _ = pictures
    free = Setup(".", free=["source.power"], per_group=["analyzer.angle"])
    given = Setup(".", free=["source.power"], per_group=["analyzer.angle"], priors={"analyzer.angle*": (None, 7.0)})
    assert [v.prior for v in variables_of_base(model, free, [0, 1]) if v.frames] == [(20.0, 1.0), (40.0, 1.0)]
    assert [v.prior for v in variables_of_base(model, given, [0, 1]) if v.frames] == [(20.0, 7.0), (40.0, 7.0)]


def test_a_drive_level_in_doubt_multiplies_the_power_that_all_frames_share(mitsuba):
    """Two LEDs whose drivers are set to 2 %: levels per frame about what was set, one power each, an LED that is off is
    off; derivatives agree with differences."""
    from optics.fit.model import value_of
    from optics.fit.scene_model import SceneModel
    from optics.scene import loader
    from optics.scene.parameter import Variable
    from optics.study.setup import Setup, variables_of_base

    scene = loader.load("gelsight", {"width": 24, "height": 18})
    levels = [(1.0, 0.0), (0.5, 1.0)]
    frames = [
        Frame(f"f{i}", np.zeros((18, 24, 3), np.float32), parameters={"led_1.power": a, "led_2.power": b})
        for i, (a, b) in enumerate(levels)
    ]
    sd = {"led_1.power": 0.02, "led_2.power": 0.02}
    captures = Captures(Path("."), str(scene.path), frames, noise=Noise(0.1, 1.0, 2.0, 255.0, 0.0), uncertainty=sd)
    model = SceneModel(scene, captures)
    variables = variables_of_base(model, Setup(".", free=["led_[12].power"]), [0, 1])
    known = {v.name: v.prior for v in variables if v.frames}
    assert known == {
        "led_1.power[f0]": (1.0, 0.02),
        "led_1.power[f1]": (0.5, 0.02),
        "led_2.power[f1]": (1.0, 0.02),
    }
    values = Values({"led_1.power": 3.0, "led_2.power": 2.0})
    drive = Variable("drive", ("led_1.power",), model.parameters["led_1.power"], (1,))
    assert value_of(model, values, drive) == 0.5 and model.at(values, 1)["led_1.power"] == 1.5
    values.put(drive, 0.6)
    assert value_of(model, values, drive) == 0.6 and model.at(values, 1)["led_1.power"] == pytest.approx(1.8)
    power = Variable("power", ("led_1.power",), model.parameters["led_1.power"])
    assert model.linear_in(power) and not model.linear_in(drive)
    prediction, images = next(iter(model.derivatives(values, [drive, power], [1])))
    for variable, step in ((drive, 0.1), (power, 0.5)):
        moved = values.copy()
        moved.put(variable, value_of(model, values, variable) + step)
        expected = (model.predict(moved, [1])[0] - prediction) / step  # linear: exact but for rounding of images
        assert np.abs(images[variable.name] - expected).max() < 1e-3 * np.abs(expected).max()


def test_a_fit_file_tells_drive_levels_from_powers():
    """Of a light set with an uncertainty, what was found in a frame multiplies the power; of others it is the power."""
    from optics.study.calibrated import _values

    sensor = {"drive": {"a.power": 1.0, "b.power": 1.0}, "frames": {"f": {"a.power": 0.5, "b.power": 0.5}}}
    data = {"parameters": {"a.power": 3.0, "b.power": 3.0}, "frames": {"f": {"a.power": 0.6, "b.power": 1.8}}}
    found = _values(Path("fit.toml"), {"sensor": {**sensor, "levels": ["a.power"]}, **data}, "f", True)
    assert found == pytest.approx({"a.power": 1.8, "b.power": 1.8})


# -- flat fields -----------------------------------------------------------------------------------------------------
def test_each_frame_has_its_own_flat_field(mitsuba):
    """At rest, a frame is its background times its gain, its own where it has one."""
    from optics.fit.scene_model import SceneModel
    from optics.scene import loader

    scene = loader.load("gelsight", {"width": 24, "height": 18})
    shape = (18, 24, 3)
    level = [np.full(shape, v, np.float32) for v in (50.0, 90.0)]
    frames = [
        Frame("own", np.zeros(shape, np.float32), parameters={"gel.press_depth": 0.0}, flat_field=level[1]),
        Frame("set", np.zeros(shape, np.float32), parameters={"gel.press_depth": 0.0}),
    ]
    model = SceneModel(
        scene, Captures(Path("."), str(scene.path), frames, noise=Noise(0.1, 1.0, 2.0, 255.0, 0.0), flat_field=level[0])
    )
    for image, expected in zip(model.predict(Values()), (90.0, 50.0)):
        assert np.abs(image - expected).max() < 1e-3  # a ratio of an image to itself
    without = SceneModel(scene, model.captures, flat_field="none")
    assert without.flat_of(0) is None


# -- noise from repeats ----------------------------------------------------------------------------------------------
def repeats(levels, each, sd, seed=0):
    rng = np.random.default_rng(seed)
    values = np.repeat(levels, each) + rng.standard_normal(len(levels) * each) * np.repeat(sd(np.array(levels)), each)
    c = readings(np.repeat(np.arange(len(levels)), each), {}, values=values)
    c.noise = None
    return c


def test_repeated_rows_give_the_noise():
    """Of 20 levels x 10 readings: 180 degrees of freedom, a standard deviation to 5.3 %; five of these. Levels go
    through 0: they are data."""
    found = estimate(repeats(np.linspace(-100, 900, 20), 10, lambda s: 0 * s + 3.0))
    assert found.dark_noise == pytest.approx(3.0, rel=5 / np.sqrt(2 * 180)) and found.system_gain == 0
    assert (found.signed, found.ends, found.black_level, found.prnu) == (True, False, 0.0, 0.0)


def test_a_range_of_signals_gives_the_gain_too():
    """K = 0.2 from 40 levels of 20 readings. Over 200 such sets the gain scatters by 5.7 %, the standard deviation at
    these two signals by 4.0 and 2.7 %: five of each."""
    found = estimate(repeats(np.linspace(10, 2000, 40), 20, lambda s: np.sqrt(4.0 + 0.2 * s)))
    assert found.system_gain == pytest.approx(0.2, rel=0.28)
    at = np.array([100.0, 1900.0])
    np.testing.assert_allclose(found.sd(at), np.sqrt(4.0 + 0.2 * at), rtol=0.2)


def test_consecutive_rows_are_preferred_to_returns():
    """A dial that comes back brings its error; readings in a row do not."""
    c = repeats([100.0, 500.0, 100.0, 500.0], 10, lambda s: 0 * s + 1.0)
    for i, f in enumerate(c.frames):
        f.parameters["analyzer.angle"] = float(i // 10 % 2)
        f.image = f.image + (40.0 if i >= 20 else 0.0)
    assert [len(rows) for rows in repeated(c)] == [10] * 4
    assert estimate(c).dark_noise == pytest.approx(1.0, rel=5 / np.sqrt(2 * 36))
    c.frames = c.frames[::10] * 6  # never two of one setting in a row
    assert [len(rows) for rows in repeated(c)] == [12, 12]


def test_too_few_repeats_are_refused():
    with pytest.raises(Underdetermined, match="leave 4 degrees of freedom, 10 are needed; give dark_noise"):
        estimate(repeats([1.0, 2.0, 3.0, 4.0], 2, lambda s: 0 * s + 1.0))
    with pytest.raises(Underdetermined, match="hold the same number, copies"):
        estimate(repeats([0.125], 20, lambda s: 0 * s))


def test_whole_readings_without_scatter_have_the_noise_of_their_step():
    c = repeats([5.0, 9.0], 10, lambda s: 0 * s)
    c.step = 1.0
    found = estimate(c)
    assert found.dark_noise == 0 and float(found.variance(7.0)) == pytest.approx(1 / 12)


# -- what is not there, what is ruled out ----------------------------------------------------------------------------
TOML = """scene = "polarizer_bench"
{top}
[noise]
dark_noise = 1.0
{tables}
[table]
file = "readings.csv"
values = ["reading"]
"""


def write(folder, top="", tables="", seed=3, first=0.0, leak=0.02):
    rng = np.random.default_rng(seed)
    angles = np.arange(first, 180.0, 4.0)
    folder.mkdir(exist_ok=True)
    rows = [f"{a},{700 * (np.cos(np.radians(a)) ** 2 + leak) + rng.standard_normal():.3f}" for a in angles]
    (folder / "readings.csv").write_text("\n".join(["analyzer.angle,reading", *rows]) + "\n")
    (folder / "captures.toml").write_text(TOML.format(top=top, tables=tables))
    return folder


def opened(folder, **setup):
    from optics.study.setup import Setup, open_model

    return open_model(Setup(str(folder), **setup))


class Fresh:
    """A record without steps."""

    steps: list = []

    def added(self):
        return []


def ruled_out(model, without=()):
    from optics.study import loop

    found = loop.excluded(model, Fresh(), without)
    names = {e.name for e in loop.candidates(model, Fresh(), without)}
    assert not names & set(found)
    said = {name: why for name, why in found.items() if "no frame can show it" not in why}
    return said, names  # by what is stated, beside what no frame could show anyway


def test_without_statements_everything_is_tested(mitsuba, tmp_path):
    found, names = ruled_out(opened(write(tmp_path)))
    assert found == {} and {"retardance", "gain drift", "extinction leak", "polarizer misalignment"} <= names


def test_what_is_absent_has_no_effect(mitsuba, tmp_path):
    model = opened(write(tmp_path, 'absent = ["sample", "middle"]'))
    found, names = ruled_out(model)
    assert {"retardance", "depolarization", "stress birefringence"} <= set(found)
    assert set(found.values()) == {"absent: sample"}
    assert model.base["middle.inserted"] == 0
    # the films that are there still leak; the absent one has no share in it
    from optics.study.setup import effect_variables

    leak = effect_variables(model, model.scene.registry.find_effect("extinction leak"))
    assert "extinction leak" in names and [v.keys for v in leak] == [("analyzer.leak", "polarizer.leak")]


def test_absent_takes_a_film_out_of_the_light(mitsuba, tmp_path):
    """Without the analyser a reading does not depend on its angle."""
    model = opened(write(tmp_path, 'absent = ["analyzer", "sample"]'))
    image = np.concatenate(model.predict(Values()))
    assert np.ptp(image) < 1e-9 * image.max()


@pytest.mark.parametrize(
    ("top", "tables", "error", "text"),
    [
        ('absent = ["sampel"]', "", UnknownKey, r"captures.toml: absent: unknown part 'sampel'; did you mean 'sample'"),
        (
            'absent = ["analyzer"]',
            '[parameters]\n"analyzer.inserted" = 1\n',
            BadCapture,
            r"\[parameters\]: analyzer.inserted = 1.0, but 'analyzer' is absent; allowed: one of these",
        ),
        (
            "",
            '[exclude]\n"gain drfit" = "why"\n',
            UnknownKey,
            r"\[exclude\]: unknown effect 'gain drfit'; did you mean",
        ),
        ("bands = [470, 530, 625]", "", ValueError, "channels: 1, the camera of the scene 'polarizer_bench' has 3"),
        (
            "",
            '[uncertainty]\n"source.power" = 0.1\n',
            BadCapture,
            r"\[uncertainty\]: source.power has an uncertainty, and nothing sets it",
        ),
    ],
)
def test_wrong_statements_are_refused_before_rendering(mitsuba, tmp_path, top, tables, error, text):
    with pytest.raises(error, match=text):
        opened(write(tmp_path, top, tables))


def test_bands_are_the_scenes_and_the_command_line_wins(mitsuba, tmp_path):
    assert opened(write(tmp_path, "bands = [470]")).developer.bands == (470.0,)
    assert opened(tmp_path, defines={"bands": "600"}).developer.bands == (600.0,)
    xml = (tmp_path / "own.xml").resolve()
    xml.write_text("<scene version='3.0.0'/>")
    text = (tmp_path / "captures.toml").read_text().replace("polarizer_bench", "own.xml")
    (tmp_path / "captures.toml").write_text(text)
    with pytest.raises(BadCapture, match=r'bands = \[470.0\] nm, but .*own.xml has no <default name="bands">; allowed'):
        opened(tmp_path)


def test_excluded_effects_come_with_their_reason(mitsuba, tmp_path):
    found, _ = ruled_out(opened(write(tmp_path, "", '[exclude]\n"Extinction Leak" = "crossed films are black"\n')))
    assert found == {"extinction leak": "excluded: crossed films are black"}


def test_what_is_stated_in_every_frame_does_not_vary(mitsuba, tmp_path):
    stated = '[parameters]\n"camera.gain" = 1.0\n'
    found, _ = ruled_out(opened(write(tmp_path / "a", "", stated)))
    assert found == {"gain drift": "stated: camera.gain = 1 in every frame"}
    found, names = ruled_out(opened(write(tmp_path / "b", "", stated + '[uncertainty]\n"camera.gain" = 0.01\n')))
    assert found == {} and "gain drift" in names
    frames = [Frame(str(i), np.zeros((1, 1, 1)), parameters={"a": 1.0, "b": i, "c": "x"}) for i in range(3)]
    assert capture_files.stated(Captures(Path("."), "s", frames, {"d": 2.0, "b": 5.0})) == {
        "d": 2.0,
        "a": 1.0,
        "c": "x",
    }
    del frames[0].parameters["a"]
    assert "a" not in capture_files.stated(Captures(Path("."), "s", frames))


@pytest.mark.slow
def test_effects_left_out_on_request_are_said_with_the_reasons(mitsuba, tmp_path):
    """The whole loop on readings with a leak: what leaks is found, unless it is ruled out or left out on request."""
    import optics

    write(tmp_path / "captures", 'absent = ["sample", "middle"]', '[parameters]\n"camera.gain" = 1.0\n')
    study = optics.calibrate(tmp_path / "captures", tmp_path / "study")
    with pytest.raises(UnknownKey, match="unknown effect 'extinction leek'; did you mean 'extinction-leak'"):
        study.diagnose(without=["extinction leek"])
    verdict = study.diagnose(without="extinction leak", advised=False)
    assert "extinction leak" not in [row.name for row in verdict.rows]
    assert verdict.not_tested["extinction leak"] == "left out on request"
    assert verdict.not_tested["retardance"] == "absent: sample"
    assert verdict.not_tested["gain drift"] == "stated: camera.gain = 1 in every frame"
    assert "extinction leak (left out on request)" in verdict.text()
    with pytest.raises(BadCapture, match="absent: sample, which the effect 'retardance' needs"):
        study.add("retardance")
    assert "extinction leak" in [row.name for row in study.diagnose(advised=False).rows]


@pytest.mark.slow
def test_without_on_the_command_line(mitsuba, tmp_path, capsys):
    from optics.cli import main

    write(tmp_path / "captures")
    assert main(["calibrate", str(tmp_path / "captures"), "-o", str(tmp_path / "study"), "--quiet"]) == 0
    capsys.readouterr()
    assert main(["diagnose", str(tmp_path / "study"), "--without", "retardnce"]) == 2
    assert "unknown effect 'retardnce'; did you mean 'retardance'?" in capsys.readouterr().err
    main(["diagnose", str(tmp_path / "study"), "--without", "retardance", "--without", "dark offset", "--quiet"])
    said = capsys.readouterr().out
    assert "retardance (left out on request)" in said and "dark offset (left out on request)" in said


@pytest.mark.slow
def test_a_fit_predicts_readings_of_another_session(mitsuba, tmp_path):
    """Neither session says where its meter ends; that the second is never as bright as the first changes no power."""
    import optics

    top = 'absent = ["sample", "middle"]'
    optics.calibrate(write(tmp_path / "bright", top, leak=0.0), tmp_path / "study", held_out=[])
    dim = write(tmp_path / "dim", top, seed=4, first=60.0, leak=0.0)
    text = (dim / "readings.csv").read_text().splitlines()
    (dim / "readings.csv").write_text("\n".join(text[:15]) + "\n")
    found = optics.facade.compare(dim, tmp_path / "study").comparison.total
    assert found.n == 14 and found.chi2_per_dof < 1 + 5 * np.sqrt(2 / 14)


def test_a_curve_beside_readings_takes_their_bands_and_what_is_absent(mitsuba, tmp_path, capsys):
    import json

    from optics.cli import main

    folder = write(tmp_path / "captures", 'bands = [470]\nabsent = ["sample", "analyzer"]')
    line = ["sweep", "polarizer_bench", "--key", "analyzer.angle", "--captures", str(folder), "--json", "--quiet"]
    assert main(line) == 0
    found = json.loads(capsys.readouterr().out)
    readings = np.array(found["curves"][0]["readings"])
    assert found["channels"] == ["reading"] and np.ptp(readings) < 1e-9 * readings.max()  # no analyser, no Malus
    assert main([*line, "-D", "bands=470, 530, 625"]) == 2
    assert "readings of 1 channels" in capsys.readouterr().err


def test_where_nothing_speaks_of_a_press_none_is_sought(mitsuba):
    """Groups of frames of a skin that nothing presses: by the frames, or by the scene where these are silent. A press
    whose place is stated and whose depth is not has a depth to be found."""
    from optics.fit.scene_model import SceneModel
    from optics.scene import loader
    from optics.study.setup import Setup, variables_of_base

    stated = {
        "silent": {},
        "flat": {"gel.press_depth": 0.0},
        "place": {"gel.press_x": 1.0},
        "deep": {"gel.press_depth": 0.4},
    }
    frames = [Frame(n, np.zeros((18, 24, 3), np.float32), parameters=p, group=n) for n, p in stated.items()]
    scene = loader.load("gelsight", {"width": 24, "height": 18})
    model = SceneModel(scene, Captures(Path("."), str(scene.path), frames, noise=Noise(0.1, 1.0, 2.0, 255.0, 0.0)))
    sought = {v.name for v in variables_of_base(model, Setup("."), range(4)) if v.keys == ("gel.press_depth",)}
    assert sought == {"gel.press_depth[place]", "gel.press_depth[deep]"}
