"""Simulated readings of a polarizer bench against closed forms, and against an exact inversion for the reflections."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from optics.captures import capture_set as captures
from optics.captures.noise import Noise
from optics.errors import BadCapture, OutputExists, UnknownKey
from optics.proof.makers import bench as jones
from optics.proof.makers.bench import Photodiode, Polarizer, Sample, Source, Truth

DIODE = Noise(system_gain=0.5, dark_noise=1.5, black_level=100.0, saturation=4095.0, prnu=0.0)
RGB = np.array([620.0, 540.0, 460.0])  # nm
EXACT = (
    1e-12  # of unit light: some 100 operations of double precision, each off by 1e-16, and what is left of the bounces
)
ANGLES = np.linspace(-180, 360, 37)


def turns(angles=ANGLES, **others):
    """One reading per analyzer angle; others by key with _ for the dot."""
    return [
        {"analyzer.angle": float(a), **{key.replace("_", "."): value for key, value in others.items()}} for a in angles
    ]


def cos(angle):
    return np.cos(np.deg2rad(angle))


def sin(angle):
    return np.sin(np.deg2rad(angle))


def mono(truth, settings):
    return jones.radiance(truth, settings)[:, 0]


def check(found, wanted, error=EXACT):
    np.testing.assert_allclose(found, wanted, rtol=0, atol=error)


# -- Polarizers ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("angle", [0.0, 25.0, -130.0])
def test_malus(angle):
    check(mono(Truth(), turns(polarizer_angle=angle)), 0.8**2 / 2 * cos(ANGLES - angle) ** 2)


def test_two_leaking_polarizers_and_crossed_leak():
    one, two = Polarizer(0.8, 0.01), Polarizer(0.7, 0.03)
    wanted = ((0.8 * 0.7 + 0.01 * 0.03) * cos(ANGLES) ** 2 + (0.8 * 0.03 + 0.01 * 0.7) * sin(ANGLES) ** 2) / 2
    check(mono(Truth(p1=one, p2=two), turns()), wanted)
    check(mono(Truth(p1=one, p2=one), turns([90.0])), 0.8 * 0.01)  # T1 T2 of unit light
    faint = replace(one, leak=1e-9)
    assert mono(Truth(p1=faint, p2=faint), turns([90.0])) == pytest.approx(
        0.8e-9, rel=1e-7
    )  # sqrt(T2) is 3e-5, rounding 1e-16


def test_three_polarizers():
    settings = [
        {"polarizer.angle": p, "middle.angle": m, "analyzer.angle": a}
        for p in (0, 20)
        for m in (45, 80)
        for a in (90, 10)
    ]
    p, m, a = (np.array([s[f"{part}.angle"] for s in settings]) for part in ("polarizer", "middle", "analyzer"))
    check(mono(Truth(pm=Polarizer(0.9)), settings), 0.8**2 * 0.9 / 2 * cos(m - p) ** 2 * cos(a - m) ** 2)


def test_partly_polarized_source():
    source = Source(dop=0.3, dop_angle=20.0)
    check(mono(Truth(source, p1=None), turns()), 0.8 / 2 * (1 + 0.3 * cos(2 * (ANGLES - 20))))
    check(
        mono(Truth(replace(source, dop=1.0), p1=None), turns()), 0.8 * cos(ANGLES - 20) ** 2
    )  # T1: of light along the axis
    check(mono(Truth(source, p1=None, p2=None), [{}]), 1.0)


def test_turning_the_whole_bench_changes_nothing():
    truth = Truth(
        Source(dop=0.4, dop_angle=10),
        Polarizer(0.8, 0.02, face_reflectance=0.04),
        Sample(50, 15, 0.1, 30, -40, 0.1),
        Polarizer(0.7, 0.1),
        Polarizer(0.8, 0.01, face_reflectance=0.05),
    )
    turned = replace(truth, source=replace(truth.source, dop_angle=10 + 33))
    here = [{"polarizer.angle": 5.0, "middle.angle": 40.0, "analyzer.angle": a, "sample.angle": 12.0} for a in ANGLES]
    check(
        jones.radiance(turned, [{key: value + 33 for key, value in s.items()} for s in here]),
        jones.radiance(truth, here),
    )


# -- The sample ------------------------------------------------------------------------------------------------------
def between(p, a, axis, phase):
    """Fraction of Malus' maximum behind a retarder: cos^2(a - p) - sin 2(axis - p) sin 2(axis - a) sin^2(phase/2)."""
    return cos(a - p) ** 2 - sin(2 * (axis - p)) * sin(2 * (axis - a)) * sin(phase / 2) ** 2


@pytest.mark.parametrize("phase", [0.0, 37.0, 90.0, 180.0, 400.0])
@pytest.mark.parametrize("axis", [0.0, 22.5, 45.0, 100.0])
def test_retarder(phase, axis):
    wanted = 0.32 * between(10.0, ANGLES, axis, phase)
    check(mono(Truth(sample=Sample(phase, axis)), turns(polarizer_angle=10.0)), wanted)
    check(mono(Truth(sample=Sample(phase, axis - 30)), turns(polarizer_angle=10.0, sample_angle=30.0)), wanted)
    check(
        mono(
            Truth(sample=Sample(stress_retardance=phase, stress_axis=axis - 30)),
            turns(polarizer_angle=10.0, sample_angle=30.0),
        ),
        wanted,
    )


def test_half_wave_plate_mirrors_and_quarter_wave_plate_makes_circular():
    check(mono(Truth(sample=Sample(180, 25)), turns(polarizer_angle=10.0)), 0.32 * cos(ANGLES - (2 * 25 - 10)) ** 2)
    check(mono(Truth(sample=Sample(90, 45)), turns()), 0.32 / 2)


def test_colours():
    phase = 200 * 540 / RGB * (1 + 0.2 * ((540 / RGB) ** 2 - 1))
    colour = Photodiode(channels=3)
    source = Source(power_rgb=(0.5, 1.0, 2.0))
    found = jones.radiance(Truth(source, sample=Sample(200, 30, 0.2), photodiode=colour), turns(ANGLES))
    check(found, 0.32 * np.array([0.5, 1, 2]) * between(0, ANGLES[:, None], 30, phase))
    stress = jones.radiance(Truth(sample=Sample(stress_retardance=100, stress_axis=30), photodiode=colour), turns())
    check(stress, 0.32 * between(0, ANGLES[:, None], 30, 100 * 540 / RGB))
    leaky = Polarizer(0.8, 0.01, leak_slope=-1.5)
    found = jones.radiance(Truth(p1=leaky, p2=leaky, photodiode=colour), turns([90.0]))
    check(found[0], 0.8 * 0.01 * np.exp(-1.5 * (RGB - 540) / 100))
    assert found[0, 2] > found[0, 1] > found[0, 0]  # a negative slope: more leak in the blue


def test_two_retarders_in_order():
    """Quarter wave with its fast axis at 45 deg: what swings at 45 runs ahead, so light from x turns clockwise, and y
    leads x by a quarter; a second one with its fast axis at x brings x level with y: linear at +45 deg. The other order
    leaves x alone first and makes it circular then."""
    check(
        mono(Truth(sample=Sample(90, 45, stress_retardance=90, stress_axis=0)), turns()), 0.32 * cos(ANGLES - 45) ** 2
    )
    check(mono(Truth(sample=Sample(90, 0, stress_retardance=90, stress_axis=45)), turns()), 0.32 / 2)
    check(
        mono(Truth(sample=Sample(90, 25, stress_retardance=90, stress_axis=25)), turns()), 0.32 * cos(ANGLES - 50) ** 2
    )
    check(mono(Truth(sample=Sample(70, 25, stress_retardance=70, stress_axis=115)), turns()), 0.32 * cos(ANGLES) ** 2)


def test_depolarizer():
    for strength in (0.0, 0.2, 1.0):
        sample = Sample(depolarization=strength, transmittance=0.9)
        check(mono(Truth(sample=sample), turns()), 0.9 * 0.32 / 2 * (1 + (1 - strength) * cos(2 * ANGLES)))
    modes = jones._sample_modes(Sample(90, 45, depolarization=0.2), np.zeros(1), np.array([540.0]))
    light = (modes @ np.diag([1.0, 0.0]) @ modes.conj().swapaxes(-1, -2)).sum(0)[0, 0]
    check([np.trace(light).real, 2 * light[1, 0].imag], [1.0, -0.8])  # circular light too; S3 < 0: clockwise, as above


# -- Reflections between the faces -----------------------------------------------------------------------------------
def film(t, r):
    """(transmittance, reflectance) of face, absorber, face for one polarization: sums of geometric series."""
    ring = (1 - r) ** 2 / (1 - (r * t) ** 2)
    return ring * t, r + ring * r * t**2


def test_pair_of_films():
    one, two = Polarizer(0.8, 0.05, face_reflectance=0.04), Polarizer(0.7, 0.02, face_reflectance=0.1)
    wanted = []
    for seconds in ((0.7, 0.02), (0.02, 0.7)):  # aligned, then crossed: what each polarization meets in the second film
        pairs = [(film(t, 0.04), film(u, 0.1)) for t, u in zip((0.8, 0.05), seconds)]
        wanted.append(sum(t * u / (1 - r * s) for (t, r), (u, s) in pairs) / 2)
    check(mono(Truth(p1=one, p2=two), turns([0.0, 90.0])), wanted)


@pytest.mark.parametrize("reflectance", [0.04, 0.3])
def test_clear_films_lose_light_by_reflection_alone(reflectance):
    clear = Polarizer(1.0, 1.0, face_reflectance=reflectance)
    truth = Truth(sample=Sample(70, 20, stress_retardance=50, depolarization=0.3), p1=clear, p2=clear, pm=clear)
    # a pile of N lossless faces: (1 - R)/(1 + (N - 1) R), whatever lies between them and keeps the light
    check(mono(truth, [{}]), (1 - reflectance) / (1 + 5 * reflectance))
    check(mono(replace(truth, pm=None), [{}]), (1 - reflectance) / (1 + 3 * reflectance))


def test_light_goes_twice_through_a_quarter_wave_plate():
    """Behind a polarizer at 0 deg the plate at 45 deg turns what a clear film sends back by 90 deg, each time it does
    so."""
    truth = Truth(
        p1=Polarizer(0.8, face_reflectance=0.2), sample=Sample(90, 45), p2=Polarizer(1.0, 1.0, face_reflectance=0.3)
    )
    (t, along), (_, across), (u, clear) = film(0.8, 0.2), film(0.0, 0.2), film(1.0, 0.3)
    check(mono(truth, [{}]), t / 2 * u * (1 + clear * across) / (1 - clear**2 * along * across))
    check(mono(replace(truth, sample=Sample()), [{}]), t / 2 * u / (1 - clear * along))  # without the plate


def test_all_orders_of_reflection_against_an_inversion():
    """Layers added one by one as 4 x 4 matrices on vec(J), with all bounces between two of them summed by an
    inverse."""

    def operator(*modes):
        return sum(np.kron(m, m.conj()) for m in modes)

    def matrix(along, across, angle):
        c, s = cos(angle), sin(angle)
        turn = np.array([[c, -s], [s, c]])
        return turn @ np.diag([along, across]) @ turn.T

    def add(a, b):
        """Layers (onwards, reflected at the front, backwards, reflected at the back): b behind a."""
        down, up = (np.linalg.inv(np.eye(4) - m) for m in (a[3] @ b[1], b[1] @ a[3]))
        return (b[0] @ down @ a[0], a[1] + a[2] @ b[1] @ down @ a[0], a[2] @ up @ b[2], b[3] + b[0] @ a[3] @ up @ b[2])

    def layers(truth, p, m, a, turn):
        def face(r):
            return (1 - r) * np.eye(4), r * np.eye(4), (1 - r) * np.eye(4), r * np.eye(4)

        def whole(f, angle):
            body = operator(matrix(np.sqrt(f.transmittance), np.sqrt(f.leak), angle))
            return [face(f.face_reflectance), (body, 0 * body, body, 0 * body), face(f.face_reflectance)]

        s = truth.sample
        own, stress = (
            matrix(np.exp(-0.5j * np.deg2rad(d)), np.exp(0.5j * np.deg2rad(d)), axis + turn)
            for d, axis in ((s.retardance, s.axis), (s.stress_retardance, s.stress_axis))
        )
        shrink = (1 - s.depolarization) * np.eye(4)
        shrink[np.ix_([0, 3], [0, 3])] += s.depolarization / 2  # vec(J) = (xx, xy, yx, yy); the trace stays
        sample = shrink @ operator(stress @ own), np.zeros((4, 4)), operator(own @ stress) @ shrink, np.zeros((4, 4))
        return [*whole(truth.p1, p), sample, *whole(truth.pm, m), *whole(truth.p2, a)]

    rng = np.random.default_rng(4)
    for _ in range(5):
        films = [
            Polarizer(rng.uniform(0.6, 1), rng.uniform(0, 0.5), face_reflectance=rng.uniform(0, 0.4)) for _ in range(3)
        ]
        sample = Sample(
            rng.uniform(0, 360), rng.uniform(0, 180), 0, rng.uniform(0, 360), rng.uniform(0, 180), rng.uniform(0, 1)
        )
        truth = Truth(Source(dop=rng.uniform(), dop_angle=30.0), films[0], sample, films[1], films[2])
        p, m, a, turn = rng.uniform(0, 360, 4)
        stack, *others = layers(truth, p, m, a, turn)
        for other in others:
            stack = add(stack, other)
        light = (1 - truth.source.dop) / 2 * np.eye(2) + truth.source.dop * matrix(1, 0, 30.0)
        wanted = (stack[0] @ light.ravel())[[0, 3]].sum().real
        check(
            mono(truth, [{"polarizer.angle": p, "middle.angle": m, "analyzer.angle": a, "sample.angle": turn}]), wanted
        )


# -- Dials, lamp and photodiode --------------------------------------------------------------------------------------
def test_dial_to_angle():
    crooked = Polarizer(offset=2.0, scale=1.01, backlash=3.0)
    for part in ("polarizer", "analyzer"):
        truth = replace(Truth(), **{{"polarizer": "p1", "analyzer": "p2"}[part]: crooked})
        for approach in (-1.0, 0.0, 1.0):
            settings = [{f"{part}.angle": a, f"{part}.approach": approach} for a in ANGLES]
            check(mono(truth, settings), 0.32 * cos(1.01 * ANGLES + 2 + 1.5 * approach) ** 2)


def test_wobble_has_one_cycle_per_turn_of_the_dial():
    truth = Truth(p2=Polarizer(leak=0.01, offset=30.0, wobble_c=0.05, wobble_s=-0.02))
    plain = mono(Truth(p2=Polarizer(leak=0.01, offset=30.0)), turns())
    check(
        mono(truth, turns()), plain * (1 + 0.05 * cos(ANGLES) - 0.02 * sin(ANGLES))
    )  # of the dial, not of the true angle


def test_power_drift_and_stray_light():
    settings = [{"source.power": p, "source.time": t} for p in (0.0, 0.5, 2.0) for t in (0.0, 10.0)]
    p, t = (np.array([s[key] for s in settings]) for key in ("source.power", "source.time"))
    check(mono(Truth(Source(1.5, drift=-0.004), stray=0.03), settings), 0.32 * 1.5 * p * (1 - 0.004 * t) + 0.03)


def test_response():
    truth = Truth(photodiode=Photodiode(gain=1.5, gamma=1.2, offset=-7.0), stray=0.1)
    wanted = 100 + 3995 * (1.5 * (0.32 * cos(ANGLES) ** 2 + 0.1)) ** 1.2 - 7
    check(jones.expected(truth, turns(), DIODE)[:, 0], wanted, EXACT * 4095)


@pytest.mark.parametrize(("gain", "offset"), [(0.0, 0.0), (0.0, -40.0), (0.3, 20.0), (2.0, 0.0)])
def test_mean_and_variance_of_readings(gain, offset):
    count = 20_000
    truth, settings = Truth(photodiode=Photodiode(gain=gain, offset=offset)), [{}] * count
    mean = jones.expected(truth, settings[:1], DIODE)[0, 0]
    variance = float(DIODE.variance(mean))  # EMVA 1288 with a step of 1 DN, dithered: dark noise is 1.5 DN
    found = jones.readings(truth, settings, DIODE, seed=3)
    assert found.shape == (count, 1) and np.all(found == np.round(found))
    assert found.mean() == pytest.approx(mean, abs=4 * np.sqrt(variance / count))  # 4 sigma: once in 16 000
    assert found.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / count))  # 4 sigma of a Gaussian's variance
    assert np.array_equal(found, jones.readings(truth, settings, DIODE, seed=3))
    assert not np.array_equal(found, jones.readings(truth, settings, DIODE, seed=4))


def test_readings_are_clipped():
    high = jones.readings(Truth(photodiode=Photodiode(gain=10.0)), [{}] * 50, DIODE, 0, bits=12)
    low = jones.readings(Truth(photodiode=Photodiode(gain=0.0, offset=-200.0)), [{}] * 50, DIODE, 0, bits=12)
    assert np.all(high == 4095) and np.all(low == 0)


# -- Sweeps and files ------------------------------------------------------------------------------------------------
def test_sweep():
    settings = jones.malus_sweep(73, (0.0, 45.0, 90.0), turns=2, minutes=36, fixed={"sample.angle": 5.0})
    column = {key: np.array([s[key] for s in settings]) for key in settings[0]}
    assert len(settings) == 73 and set(column) == {
        "source.power",
        "source.time",
        "polarizer.angle",
        "analyzer.angle",
        "analyzer.approach",
        "sample.angle",
    }
    check(column["source.time"], np.arange(73) / 2, 1e-12)  # rounding of 36 minutes
    assert list(np.unique(column["polarizer.angle"])) == [0, 45, 90]
    assert (
        np.all(column["sample.angle"] == 5)
        and column["analyzer.angle"].min() == 0
        and column["analyzer.angle"].max() == 720
    )
    for angle in (0, 45, 90):
        run = column["polarizer.angle"] == angle
        steps = np.diff(column["analyzer.angle"][run])
        approach = column["analyzer.approach"][run]
        same = approach[1:] == approach[:-1]
        assert np.all(np.sign(steps[same]) == approach[1:][same]) and set(approach) == {1.0, -1.0}


@pytest.mark.parametrize("channels", [1, 3])
def test_capture_set_comes_back(tmp_path, channels):
    truth = Truth(p1=Polarizer(leak=0.01), photodiode=Photodiode(gain=2.0, channels=channels))
    settings = jones.malus_sweep(40, (0.0, 45.0)) + [{"sample.angle": 20.0}]
    folder = jones.write(tmp_path / "set", truth, settings, DIODE, seed=7, bits=12)
    back = captures.load(folder)
    assert (back.scene, back.values_are, back.warnings) == ("polarizer_bench", "DN", [])
    assert back.noise == replace(DIODE, quantisation=1.0, signed=True)  # a step of 1 DN, read off the values
    assert back.table.values == (["reading"] if channels == 1 else ["red", "green", "blue"])
    values = np.stack([f.image[0, 0] for f in back.frames])
    assert np.array_equal(values, jones.readings(truth, settings, DIODE, seed=7, bits=12))
    assert [f.parameters for f in back.frames[:-1]] == [{**s, "sample.angle": 0.0} for s in settings[:-1]]
    assert back.frames[-1].parameters == {**{key: jones.DEFAULTS[key] for key in settings[0]}, "sample.angle": 20.0}
    with pytest.raises(OutputExists, match="choose another folder"):
        jones.write(folder, truth, settings, DIODE, seed=7)
    (tmp_path / "empty").mkdir()
    with pytest.raises(OutputExists):
        jones.write(tmp_path / "empty", truth, settings, DIODE, seed=7)


def test_what_is_refused(tmp_path):
    with pytest.raises(UnknownKey, match="did you mean 'analyzer.angle'"):
        jones.radiance(Truth(), [{}, {"analyser.angle": 3.0}])
    with pytest.raises(UnknownKey, match="middle.angle.*not on the bench"):
        jones.radiance(Truth(), [{"middle.angle": 3.0}])
    with pytest.raises(ValueError, match="reading 1: source of -0.5; allowed: >= 0"):
        jones.radiance(Truth(Source(drift=-0.1)), [{}, {"source.time": 15.0}])
    with pytest.raises(ValueError, match="reading 0: analyzer.angle = nan"):
        jones.radiance(Truth(), [{"analyzer.angle": np.nan}])
    with pytest.raises(ValueError, match="zero readings"):
        jones.radiance(Truth(), [])
    with pytest.raises(ValueError, match=r"Polarizer.leak = 1.5; allowed: finite, 0 to 1"):
        Polarizer(leak=1.5)
    with pytest.raises(ValueError, match="Source.power_rgb = -1"):
        Source(power_rgb=(1, 1, -1))
    with pytest.raises(ValueError, match="Truth.stray = -2"):
        Truth(stray=-2)
    with pytest.raises(ValueError, match="channels = 2; allowed: 1"):
        Photodiode(channels=2)
    with pytest.raises(ValueError, match="prnu = 0.003; allowed: 0"):
        jones.readings(Truth(), [{}], replace(DIODE, prnu=0.003), 0)
    with pytest.raises(ValueError, match="saturation = 4095 DN; allowed: <= 255 DN at 8 bit"):
        jones.readings(Truth(), [{}], DIODE, 0, bits=8)
    with pytest.raises(ValueError, match="count = 3; allowed: >= 4"):
        jones.malus_sweep(3, (0.0, 45.0))
    with pytest.raises(BadCapture, match="reading 0 is saturated"):
        jones.write(tmp_path / "set", Truth(photodiode=Photodiode(gain=20.0)), [{}], DIODE, 0)
    assert not (tmp_path / "set").exists()


def test_shares_no_optics_with_the_models():
    """What a fit is tried on must not come from the code that is fitted."""
    import subprocess

    loaded = subprocess.run(
        [sys.executable, "-c", "import sys, optics.proof.makers.bench; print(*sys.modules)"],
        text=True,
        capture_output=True,
        check=True,
    ).stdout.split()
    models = (
        "optics.polarization.mueller",
        "optics.polarization.layers",
        "optics.light.renderer",
        "optics.scene.loader",
        "optics.light.development",
        "optics.scene.registry",
        "plugins",
        "mitsuba",
        "drjit",
    )
    assert "optics.proof.makers.bench" in loaded and not [name for name in loaded if name.startswith(models)]
