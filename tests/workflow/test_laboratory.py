"""Benches of other laboratories: their makers agree with closed forms, write folders that load, hide what they say as
strongly as they say, and are counted as their count says."""

import ast
import importlib
import itertools
import json
import math
import pkgutil
from dataclasses import replace

import numpy as np
import pytest

from optics.captures import capture_set
from optics.proof import blind, cells, count, elsewhere
from optics.proof.makers import laboratory
from optics.proof.makers.laboratory import bench, causes, design, folder, mosaic, photographs, session, student
from optics.proof.rigs import RIGS
from optics.proof.rigs import laboratory as rigs
from optics.scene import loader as scenes
from optics.scene.checking import mueller, ray
from optics.scene.parameter import Values
from optics.study import setup

OUTSIDE = {name: rig for name, rig in RIGS.items() if rig.outside}
IMAGES = ("photographs", "polarization_camera")
DIAL = np.arange(0.0, 180.0, 15.0)
T1 = bench.T1


def seen(numbers=None, **settings):
    """(n,) light of a lamp of power 1 at an analyser turned by DIAL, in the green."""
    found = bench.reading(numbers or {}, {"analyzer.angle": DIAL, **settings})
    return found[:, 0]


def two_films(rng=None):
    found = student.session(rng or np.random.default_rng(3))
    meter = session.Meter(5000.0, 2.0, 0.001, unit="V", per=1000.0, decimals=3)
    made = session.Session({"analyzer.angle": np.arange(0.0, 361.0, 10.0)}, {"polarizer.angle": 0.0}, meter)
    return made if rng is None else found


# -- the physics -----------------------------------------------------------------------------------------------------
def test_two_films_follow_malus_with_a_floor():
    """I = ((T1^2 + T2^2) cos^2 + 2 T1 T2 sin^2)/2 of unpolarized light, and once the whole of a lamp polarized along
    it."""
    c2 = np.cos(np.radians(DIAL)) ** 2
    t2 = 0.03
    leaky = {f"{film}_leak": t2 for film in bench.FILMS}
    assert seen() == pytest.approx(T1**2 / 2 * c2, abs=1e-15)
    assert seen(leaky) == pytest.approx((T1**2 + t2**2) / 2 * c2 + T1 * t2 * (1 - c2), rel=1e-12)
    assert seen({"lamp_q": 1.0}) == pytest.approx(T1**2 * c2, abs=1e-15)
    assert seen({"analyzer_zero": 20.0}) == pytest.approx(T1**2 / 2 * np.cos(np.radians(DIAL + 20)) ** 2, abs=1e-15)


def test_a_third_film_between_crossed_ones_passes_sin_2_theta_squared():
    found = bench.reading({}, {"middle.inserted": np.ones(12), "middle.angle": DIAL, "analyzer.angle": np.full(12, 90)})
    assert found[:, 0] == pytest.approx(T1**3 / 8 * np.sin(np.radians(2 * DIAL)) ** 2, abs=1e-15)


def test_a_plate_turned_between_films_and_its_colours():
    """sin^2(d/2) sin^2 2psi between crossed films, d as 1/wavelength; the sign of the plate does not show."""
    settings = {"sample.angle": DIAL, "analyzer.angle": np.full(12, 90.0)}
    bands = (620.0, 540.0, 460.0)
    expected = T1**2 / 2 * np.sin(np.radians(2 * DIAL))[:, None] ** 2
    expected = expected * np.sin(np.radians(35.0 * 540 / np.array(bands))) ** 2
    for sign in (1, -1):
        assert bench.reading({"plate_0": sign * 70.0}, settings, bands) == pytest.approx(expected, abs=1e-14)
    higher = bench.reading({"plate_0": 70.0 + 720.0}, settings, bands)
    assert higher[:, 1] == pytest.approx(expected[:, 1], abs=1e-13)  # whole waves more: the same at 540 nm only
    assert np.abs(higher[:, 0] - expected[:, 0]).max() > 0.05


def test_a_camera_shows_the_mean_of_a_signal_below_black_as_well():
    """As of a dark offset of -4 DN in crossed films: noise of 1 DN over 4000 pixels, 0.016 DN, four times."""
    camera = photographs.Camera(247.0, 1.0, 0.0, gain=0.1)
    for level in (-4.0, 0.0, 30.0):
        shown = camera.shown(np.full(4000, level), np.random.default_rng(5)) - camera.black
        assert shown.mean() == pytest.approx(level, abs=4 * camera.sd(np.array(level)) / math.sqrt(4000))


def test_a_folder_states_any_wavelength_but_that_at_which_benches_are_described(tmp_path):
    """A laser's owner writes its wavelength: without it, a plate of his catalogue would be another at 650 nm."""
    plain = two_films()
    for band in (bench.GREEN, 650.0):
        made = replace(plain, bands=(band,))
        folder.write(tmp_path / f"{band:g}", made, made.mean({}))
        assert capture_set.load(tmp_path / f"{band:g}").bands == ([band] if band != bench.GREEN else [])


def test_limits_of_haze_of_a_twist_and_of_a_dichroic_sheet():
    c2 = np.cos(np.radians(DIAL)) ** 2
    assert seen({"haze": 1.0}) == pytest.approx(np.full(12, T1**2 / 4), rel=1e-12)
    assert seen({"haze": 0.4}) == pytest.approx(T1**2 / 2 * (0.6 * c2 + 0.2), rel=1e-12)
    # many waves of a twisted plate turn the polarization with them (Mauguin): 45 degrees of twist, to 2 %
    many = {"plate_0": 30 * 24.0, "plate_45": 0.0, "twist": 45.0}
    turned = {f"sample.{k}": np.full(12, v) for k, v in (("angle", 22.5),)}
    assert seen(many, **turned) == pytest.approx(T1**2 / 2 * np.cos(np.radians(DIAL - 45)) ** 2, abs=0.02 * T1**2 / 2)
    # a sheet that absorbs one polarization whole is a film along the other, of T1 = 2 by its norm
    sheet = seen({"dichroic_q": 20 * math.cos(math.radians(60)), "dichroic_u": 20 * math.sin(math.radians(60))})
    expected = T1**2 * np.cos(np.radians(30)) ** 2 * np.cos(np.radians(DIAL - 30)) ** 2
    assert sheet == pytest.approx(expected, abs=1e-12)


def test_what_a_detector_and_a_film_do_besides():
    """A detector's polarization, plain and the more the brighter it is; a stripe, an eccentric pinion, and fatigue."""
    a = np.radians(DIAL)
    level = T1**2 / 2 * np.cos(a) ** 2
    for name, share in (("detector", 1.0), ("detector_bright", level / level.max())):
        found = seen({f"{name}_q": 0.1, f"{name}_u": -0.2})
        assert found == pytest.approx(level * (1 + share * (0.1 * np.cos(2 * a) - 0.2 * np.sin(2 * a))), abs=1e-15)
    stripe = seen({"analyzer_stripe_s": 0.3}, **{"polarizer.inserted": np.zeros(12)}) / (T1 / 2)
    assert stripe[6] == pytest.approx(0.7) and np.all(stripe[[0, 11]] > 0.999)  # at 90 deg, and nothing far from it
    pinion = seen({"analyzer_pinion_s": 3.0})
    assert pinion == pytest.approx(T1**2 / 2 * np.cos(a + np.radians(3) * np.sin(5 * a)) ** 2, abs=1e-15)
    even = {"analyzer.angle": np.zeros(40)}
    tired = bench.reading({"fatigue": 0.2}, even)[:, 0] / (T1**2 / 2)
    assert tired[0] == 1 and np.all(np.diff(tired) < 0) and tired[-1] == pytest.approx(1 - 0.2 * T1**2 / 2, abs=1e-4)


def test_the_same_cause_by_its_proof():
    """Each name that counts as another's has the same numbers of the bench, and the same matrix in the library."""
    leaks, plates = (causes.CAUSES[name].groups(()) for name in ("coloured leak", "retardance"))
    assert causes.CAUSES["extinction leak"].groups(()) == leaks[:1]
    assert causes.CAUSES["stress birefringence"].groups(()) == plates[:1]
    at = ray(wavelengths=(620.0, 540.0, 460.0))
    leak = [mueller("polarizer_film", at, transmittance=0.8, leak=0.02, **k) for k in ({}, {"leak_tilt": 0.0})]
    assert leak[0] == pytest.approx(leak[1], abs=0)
    stressed = mueller("sheet", at, stress=1.0, stress_optic=5.0, stress_thickness=3.0, angle=20.0)
    degrees = 360 * 5e-12 * 1e6 * 3e-3 / 540e-9  # 2 pi C d stress/lambda of 1 MPa
    plate = [mueller("sheet", at, retard_0=sign * degrees, angle=20.0) for sign in (1, -1)]
    assert min(np.abs(stressed - p).max() for p in plate) < 1e-9
    film = {"film misalignment": "polarizer misalignment", "film leak": "extinction leak"}
    for name, library in film.items():  # numbers of one film, of those that the other moves
        assert {*causes.CAUSES[name].groups(())[0]} <= {n for g in causes.CAUSES[library].groups(()) for n in g}
    one = replace(mosaic.session(np.random.default_rng(1)), absent=(), exclude={})
    turned = {"analyzer_zero": 3.0}
    assert design.fit(one, turned) > 100  # a turn of the sites is seen, and is one of the film to the last bit
    assert design.fit(one, turned, ["film misalignment"]) < 1e-3
    assert set(rigs.SAME) == {"coloured leak", "stress birefringence", "site misalignment", *film}


@pytest.mark.slow
def test_leak_haze_and_offset_are_one_cosine_of_two_films_and_not_of_two_powers():
    """(1 + c cos 2 theta) with a free power: one number, four causes; at another power of the lamp an offset differs,
    at another exposure room light does."""
    one = two_films()
    twice = {"analyzer.angle": np.tile(DIAL, 2), "source.power": np.repeat([1.0, 0.3], 12)}
    two = session.Session(twice, {"polarizer.angle": 0.0}, one.meter)
    hidden = causes.at({"haze": 1.0}, 0.1)
    gaps = [design.gaps(s, hidden, ["depolarization"]) for s in (one, two)]
    for name in ("extinction leak", "stray light", "dark offset"):
        assert gaps[0][name] < 1e-3
    assert gaps[1]["extinction leak"] < 1e-3 and min(gaps[1][n] for n in ("stray light", "dark offset")) > 100
    assert design.correct(gaps[0]["extinction leak"]) == pytest.approx(0.5, abs=0.01)


def test_the_library_with_the_true_numbers_predicts_every_cause_of_the_usual_law(tmp_path):
    """Two films, a plate, two powers, two exposures, a clock and three bands at once, to rounding: what a cell hides by
    the usual law is what the library means by the same name."""
    rng, count = np.random.default_rng(0), 60
    settings = {
        **{f"{part}.angle": np.round(rng.uniform(-180, 180, count)) for part in ("polarizer", "sample", "analyzer")},
        "source.power": rng.choice([0.5, 1.0], count),
        "camera.exposure": rng.choice([0.5, 1.0], count),
        "source.time": np.arange(count) / 10,
        "analyzer.approach": rng.choice([-1.0, 1.0], count),
    }
    plate, given = {"plate_0": 70.0, "plate_45": 30.0}, {"sample.retard_0": 70.0, "sample.retard_45": 30.0}
    meter = session.Meter(5000.0, 2.0, 0.0, unit="V", per=1000.0, decimals=3)
    one = session.Session(settings, {}, meter, (620.0, 540.0, 460.0), plate, given, power=1.5)
    folder.write(tmp_path / "set", one, one.mean({}))
    model = setup.open_model(setup.Setup(captures=str(tmp_path / "set")))
    # stress birefringence is another number of the library, of the same plate: see above; of those in the sample, their
    # order matters
    alone = [(name,) for name in causes.CAUSES if name != "stress birefringence"]
    together = itertools.combinations(("depolarization", "dichroism", "retardance"), 2)
    for name in (*alone, *together):
        drawn = (causes.CAUSES[n].draw(rng, ("polarizer", "analyzer")) for n in name)
        hidden = {k: v for n, d in zip(name, drawn) for k, v in causes.at(d, 0.3 * causes.CAUSES[n].most).items()}
        values = {library_key(k): v + plate.get(k, 0.0) for k, v in hidden.items()}
        mean = one.mean(hidden)
        for frame, image in zip(model.frames, model.predict(Values({"source.power": 1.5, **values}))):
            rows = frame.rows.ravel().astype(int)
            assert image.reshape(len(rows), 3) == pytest.approx(mean[rows], abs=1e-9), name


def library_key(number):
    film, _, rest = number.partition("_")
    own = {"zero": "offset", "slack": "backlash", "leak_slope": "leak_tilt"}
    if film in bench.FILMS:
        return f"{film}.{own.get(rest, rest)}"
    part = {"haze": "sample.depolarization", "plate_0": "sample.retard_0", "plate_45": "sample.retard_45"}
    part |= {"dichroic_q": "sample.dichroism_0", "dichroic_u": "sample.dichroism_45"}
    lamp = {"lamp_q": "source.dop_q", "lamp_u": "source.dop_u", "drift": "source.drift"}
    meter = {"dark": "camera.offset", "bend": "camera.response_bend"}
    return {**part, **lamp, **meter}.get(number, f"camera.{number}")


def test_the_makers_import_nothing_of_the_library():
    for info in pkgutil.iter_modules(laboratory.__path__):
        module = importlib.import_module(f"{laboratory.__name__}.{info.name}")
        with open(module.__file__, encoding="utf-8") as file:
            tree = ast.parse(file.read())
        found = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
        found |= {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
        own = {name for name in found if name and name.startswith("optics")}
        assert all(name.startswith(laboratory.__name__) for name in own), (info.name, own)


# -- what goes wrong every day ---------------------------------------------------------------------------------------
def test_a_dial_that_does_not_move_keeps_its_error_and_a_lamp_wanders_slowly():
    rng = np.random.default_rng(0)
    dial = np.repeat(np.arange(0.0, 200.0), 4)
    one = session.Session({"analyzer.angle": dial}, {}, session.Meter(1e4, 1.0, 0.0), dial_sd=0.5)
    error = (one.turned_off(rng)["analyzer.angle"] - dial).reshape(-1, 4)
    assert np.ptp(error, axis=1).max() == 0 and 0.42 < error[:, 0].std() < 0.58  # 200 draws: 5 % of sd, three of them
    slow = session.wandering(20000, 10.0, rng)
    lag = np.corrcoef(slow[:-10], slow[10:])[0, 1]
    assert abs(slow.std() - 1) < 0.1 and abs(lag - math.exp(-1)) < 0.1  # 1000 independent stretches


def test_a_meter_shows_whole_steps_of_its_range_and_no_light_below_nothing():
    lux = session.Meter(9000.0, 0.5, 0.0, ((2000.0, 1.0), (math.inf, 10.0)), "lux", clipped=True)
    shown = lux.shown(np.linspace(0, 8000, 400)[:, None], np.random.default_rng(1))
    low, high = shown[shown < 1900], shown[shown > 2100]
    assert low.min() == 0 and np.all(low == np.round(low)) and np.any(low % 10) and not np.any(high % 10)
    volts = session.Meter(5000.0, 3.0, 0.0)
    assert (volts.shown(np.zeros((400, 1)), np.random.default_rng(1)) < 0).any()  # noise on both sides of the dark


@pytest.mark.slow
def test_noise_of_a_reading_is_that_of_the_instrument_and_of_its_dial():
    one = two_films()
    rough = session.Session(one.settings, one.fixed, one.meter, dial_sd=0.5)
    many = np.stack([rough.take({}, np.random.default_rng(k)) for k in range(300)])
    assert many.std(0) / rough.sd({}) == pytest.approx(1, abs=0.2)  # 4 % of each sd; no slope: curvature
    shaken = replace(rough, wander=0.02, memory=5.0)
    many = np.stack([shaken.take({}, np.random.default_rng(k))[:, 0] for k in range(1000)])
    expected = shaken.covariance({}, np.arange(shaken.count))
    sd = np.sqrt(np.diag(expected))
    # a correlation by 1000 draws: 3 %, five of them; what a cosine does beyond second order is less
    assert np.abs(np.cov(many.T) / np.outer(sd, sd) - expected / np.outer(sd, sd)).max() < 0.16


# -- folders ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("rig", [rig for name, rig in OUTSIDE.items() if name not in IMAGES])
def test_folders_load_and_fit_the_scene(rig, tmp_path):
    rig = rig()
    for number, cell in enumerate(c for c in next(rig.rounds(1)) if c.kind == "none"):
        rig.make(tmp_path / str(number), cell)
        found = capture_set.load(tmp_path / str(number))
        own, one = rig.setup(tmp_path / str(number), 0), rig.plan(cell)[0]
        assert len(found.frames) == one.count and found.bands == ([*one.bands] if one.bands != (bench.GREEN,) else [])
        scene = scenes.load(found.scene, {"bands": ", ".join(f"{b:g}" for b in one.bands)})
        capture_set.check(found, scene.parameters)
        assert set(own.free) <= set(scene.parameters)
        rng = np.random.default_rng([seed_of(cell), 1])
        taken = one.take({}, rng)
        assert np.array([f.image.ravel() for f in found.frames]) == pytest.approx(taken, rel=1e-6, abs=1e-6)
        for key, column in one.settings.items():
            assert [f.parameters[key] for f in found.frames] == pytest.approx(column, rel=1e-5, abs=1e-4)
        assert bool(found.uncertainty) == one.dials_said and set(found.exclude) == set(one.exclude)


def seed_of(cell):
    import zlib

    return zlib.crc32(cell.name.encode())


@pytest.mark.slow
def test_photographs_load_and_are_what_the_library_sees_with_the_true_numbers(tmp_path):
    """Each pixel along its own ray, a plate beside bare light: to 0.12 DN, as the library lets a ray that is 2.5
    degrees off see 0.1 % more of a plate's 400 degrees, and the maker does not: 0.4 deg, 0.0035 of half of 247 DN."""
    one = next(
        s for s in map(photographs.session, map(np.random.default_rng, range(50))) if s.base and "sheet" in s.note
    )
    wrong = {"vignetting": 20.0, "haze": 0.1, "polarizer_leak": 0.02, "analyzer_leak": 0.02}
    mean = one.mean(wrong).reshape(one.frames, photographs.HEIGHT, photographs.WIDTH, 3)
    one = replace(one, absent=(), exclude={})
    photographs.write(tmp_path / "set", one, np.round(mean))
    model = setup.open_model(setup.Setup(captures=str(tmp_path / "set")))
    assert len(model.frames) == one.frames and model.shape == (photographs.HEIGHT, photographs.WIDTH, 3)
    values = {library_key(name): value for name, value in wrong.items()} | {"source.power": one.power}
    found = np.array(model.predict(Values(values)))
    assert found == pytest.approx(mean + photographs.BLACK, abs=0.12)
    plain = one.mean({}).reshape(mean.shape)
    assert np.abs(mean - plain).max() > 5  # what is hidden shows
    taken = one.take(wrong, np.random.default_rng(0))
    assert taken.shape == mean.shape and taken.max() <= 255 and not np.any(taken % 1)


def test_a_polarization_camera_is_what_the_library_sees_with_the_true_numbers(tmp_path):
    """Four unknown polarizations behind every site, bare and behind a film: to 0.15 DN of 4095, as the camera's corners
    look half a degree off the axis."""
    one = replace(mosaic.session(np.random.default_rng(1)), absent=(), exclude={})
    true = {"panel.power": one.power * bench.T1}
    for k in range(bench.REGIONS):
        end = f"_{k}" if k else ""
        true |= {f"panel.dop_{x}{end}": one.zeros[f"region_{k}_{x}"] for x in "qu"}
        true |= {f"panel.level_{k}": one.zeros[f"region_{k}_level"]} if k else {}
    shape = one.frames, mosaic.HEIGHT, mosaic.WIDTH
    mosaic.write(tmp_path / "set", one, np.round(one.mean({}).reshape(shape)) + mosaic.BLACK)
    model = setup.open_model(setup.Setup(captures=str(tmp_path / "set")))
    for hidden, values in (
        ({}, {}),
        ({"site_q": 0.05, "site_d": 0.02}, {"camera.site_gain_q": 0.05, "camera.site_gain_d": 0.02}),
        ({"analyzer_zero": 3.0}, {"camera.site_turn": 3.0}),
        ({"analyzer_leak": 0.04}, {"camera.site_extinction": 0.05}),
        ({"middle_zero": 4.0, "middle_leak": 0.05}, {"polarizer.offset": 4.0, "polarizer.leak": 0.05}),
    ):
        found = np.array(model.predict(Values({**true, **values})))[..., 0] - mosaic.BLACK
        assert found == pytest.approx(one.mean(hidden).reshape(shape), abs=0.15), hidden
    turned = one.turned_off(np.random.default_rng(0))
    assert np.array_equal(turned["analyzer.angle"], one.settings["analyzer.angle"])
    assert not np.array_equal(turned["middle.angle"], one.settings["middle.angle"])


def test_a_folder_is_text_as_an_instrument_and_a_stranger_write_it(tmp_path):
    one = replace(two_films(), continental=True, headed=True, radians=True, note="two films", absent=("sample",))
    folder.write(tmp_path / "set", one, one.take({}, np.random.default_rng(0)))
    text, rows = (tmp_path / "set" / name for name in ("captures.toml", "readings.txt"))
    assert 'absent = ["sample"]' in text.read_text() and "[exclude]" not in text.read_text()
    lines = rows.read_text().splitlines()
    assert len(lines) == 39 and lines[1] == "analyzer (rad)\tV" and lines[3].startswith("0,174533\t")
    found = capture_set.load(tmp_path / "set")
    assert [f.parameters["analyzer.angle"] for f in found.frames] == pytest.approx(
        one.settings["analyzer.angle"], abs=1e-4
    )


# -- the plan --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("rig", OUTSIDE.values())
def test_rounds_hide_every_cause_once_and_nothing_and_two(rig):
    rig = rig()
    batches = list(cells.rounds(rig, 8))
    for batch in batches:
        assert sorted(c.hidden[0] for c in batch if c.kind == "library") == sorted(rig.effects)
        assert {c.kind for c in batch} == {"library", "none", "pair", "unknown"}
    everything = [c for batch in batches for c in batch]
    assert len({c.name for c in everything}) == len(everything)
    assert {c.hidden[0] for c in everything if c.kind == "unknown"} == set(rig.unknown)
    assert {c.hidden[0] for c in everything if c.law == "other"} == set(rig.others) <= set(rig.effects)
    snrs = [c.snr for c in everything if c.hidden]
    assert rig.weakest <= min(snrs) < 2 * rig.weakest and rig.strongest / 2 < max(snrs) <= rig.strongest
    assert all(cells.Cell.of(json.loads(json.dumps(c.json()))) == c for c in everything[:50])


@pytest.mark.slow
def test_what_is_hidden_is_as_strong_as_is_asked():
    rig = rigs.Motor()
    for cell in (
        c for c in next(rig.rounds(1)) if c.kind == "library" and c.hidden[0] in ("dark offset", "stray light")
    ):
        _, hidden, facts = rig.plan(cell)
        assert hidden and facts["snr"][cell.hidden[0]] == pytest.approx(cell.snr, rel=0.05)  # searched to 2 % of size
        assert 0.5 <= facts["correct"] <= 1 and facts["readings"] > 50


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n, c in causes.CAUSES.items() if c.other])
def test_another_law_is_another_shape_of_the_same_cause(name):
    """Of size 0 it is nothing; of another size it is not what the usual law makes at any strength."""
    rng = np.random.default_rng(5)
    dial = np.concatenate([np.arange(0.0, 360.0, 10.0), np.arange(360.0, 0.0, -10.0)])
    settings = {
        "analyzer.angle": dial,
        "analyzer.approach": np.where(np.arange(72) < 36, 1.0, -1.0),
        "source.time": np.arange(72.0),
        "sample.angle": np.arange(72.0) * 7,
    }
    one = session.Session(settings, {"polarizer.angle": 0.0}, session.Meter(5000.0, 2.0, 0.001), power=2.0)
    cause = causes.CAUSES[name]
    direction = cause.draw(rng, ("analyzer",))
    assert one.mean(causes.both(cause.other(direction, 0.0))) == pytest.approx(one.mean({}), rel=1e-12)
    size = design.size_of(one, lambda s: cause.other(direction, s), cause.most, 5.0)
    hidden = causes.both(cause.other(direction, size))
    left = design.fit(one, hidden, [name])
    if name != "extinction leak":  # two films of two batches are one cosine as well
        assert left > 1e-3 * 72 * 5.0**2  # of the chi2 that it makes: a lag over 20 degrees differs in few readings


# -- counting --------------------------------------------------------------------------------------------------------
def record(
    hidden=("a",), kind="library", claimed="", ambiguous=(), snr=3.0, correct=0.99, alone=None, failed="", **facts
):
    step = {"word": "CLAIM" if claimed else "X", "claimed": claimed, "ambiguous": list(ambiguous), "correct": correct}
    return {
        "cell": cells.Cell("r", kind, tuple(hidden), 0.0, 0.0, "same", "", 0, snr).json(),
        "facts": {"snr": dict.fromkeys(hidden, snr), "correct": 0.99, "alone": alone or {}, **facts},
        "steps": [] if failed else [step],
        "failed": failed,
        "unreachable": False,
    }


def rate(records, name):
    found = next(r for r in elsewhere.elsewhere(records).rates if r.name == name)
    return found.k, found.n


def test_claims_are_right_where_they_name_what_is_hidden():
    records = [
        record(claimed="a"),
        record(claimed="b"),
        record((), "none", claimed="a"),
        record(("odd",), "unknown", claimed="a"),
        record(("a", "b"), "pair", claimed="b", alone={"a": 99.0, "b": 99.0}),
        record(claimed="c", same={"a": ["c"]}),
    ]
    assert rate(records, "claims that are right") == (3, 6)
    assert rate(records, "claims where nothing is hidden") == (1, 1)
    assert rate(records, "kinds that no library has: falsely claimed") == (1, 1)


def test_one_hidden_is_found_by_name_or_in_the_set_and_only_from_snr_1():
    records = [record(claimed="a"), record(ambiguous=["b", "a"]), record(ambiguous=["b"]), record(snr=0.5)]
    assert rate(records, "one, SNR >= 1: named, or in the set") == (2, 3)
    assert rate(records, "one, SNR >= 1, P(correct) >= .95: named alone") == (1, 3)
    unsure = [record(claimed="a", correct=0.6), record(claimed="a", correct=None)]  # the second: by the maker
    assert rate(unsure, "one, SNR >= 1, P(correct) >= .95: named alone") == (1, 1)
    assert rate(unsure, "the same, P(correct) by the maker's formulas") == (2, 2)


def test_members_of_a_set_that_no_reading_tells_from_the_truth_count_once():
    found = elsewhere.elsewhere([record(ambiguous=["a", "b", "c", "d"], twins=["b", "c"]), record(ambiguous=["d"])])
    assert found.sizes["one hidden"] == (2.5, 2)
    assert found.sizes["one hidden, what no reading tells from it counted with it"] == (1.5, 2)


def test_two_hidden_are_found_one_by_one_or_in_a_set_with_both():
    both, alone = ("a", "b"), {"a": 99.0, "b": 50.0}
    one_by_one = record(both, "pair", claimed="a", alone=alone)
    one_by_one["steps"].append({**one_by_one["steps"][0], "claimed": "b"})
    records = [
        one_by_one,
        record(both, "pair", ambiguous=["a + b", "c"], alone=alone),
        record(both, "pair", claimed="a", alone=alone),
        record(both, "pair", alone={"a": 99.0, "b": 1.0}),  # b alone explains it all: not two to be found
    ]
    assert rate(records, "two hidden: both named, or in a set with both") == (2, 3)
    assert elsewhere.elsewhere(records).sizes["two hidden"] == (2.0, 1)


@pytest.mark.slow
def test_a_crash_is_counted_whatever_it_is_and_told_with_its_place(monkeypatch):
    rig = rigs.Student()
    cell = next(c for c in next(rig.rounds(1)) if c.kind == "none")
    monkeypatch.setattr(blind.loop, "examine", lambda *args, **kwargs: [][1])
    found = blind.run(rig, cell)
    assert found["failed"].startswith("IndexError") and found["where"].startswith("test_laboratory.py:")
    counted = count.count([found], 1)
    assert len(counted.elsewhere.crashes) == 1 and counted.done == 0 and "crash: student nothing s0" in counted.text()
    assert list(elsewhere.wrong([found]))[0].startswith("crash: IndexError at test_laboratory.py")


@pytest.mark.slow
def test_the_loop_runs_on_a_bench_of_another_laboratory():
    """A polarized lamp behind one film: the detector could be polarized as well, to the last bit. The diagnosis names
    both, and its record is counted."""
    rig = rigs.Student()
    cell = next(c for c in next(rig.rounds(1)) if c.hidden == ("polarized source",))
    found = blind.run(rig, cell)
    facts = found["facts"]
    assert facts["session"].startswith("one film") and facts["twins"] == ["polarized detector"]
    assert facts["correct"] == pytest.approx(0.5) and found["cpu"] > 0 and not found["failed"]
    assert found["steps"][0]["word"] == "AMBIGUOUS"
    assert {*found["steps"][0]["ambiguous"]} == {"polarized source", "polarized detector"}
    assert elsewhere.elsewhere([found]).done == 1


def test_a_constant_factor_is_the_lamp_and_no_cause():
    """A detector's polarization behind films at rest is a factor, however large, that the lamp's power takes up."""
    one = student.session(np.random.default_rng(56))  # from the old lamp's power, a fit ended beside the right one
    assert one.turned == ("middle",) and one.fixed["analyzer.angle"] == 90
    for size in (0.25, 0.8):
        assert design.snr(one, {"detector_q": -size, "detector_u": -size / 2}) < 1e-3
