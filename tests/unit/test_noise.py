"""The noise model against simulated cameras of known gain, dark noise, black level and fixed pattern."""

from dataclasses import replace

import numpy as np
import pytest

from optics.captures.capture_set import Captures, Frame
from optics.captures.noise import Noise, estimate, photon_transfer, step_of, warnings_of
from optics.errors import Underdetermined

CAMERA = Noise(system_gain=0.05, dark_noise=1.5, black_level=8.0, saturation=255.0, prnu=0.003)
EXPOSURES = (0.0, 0.1, 0.25, 0.4, 0.6, 0.85)  # of saturation; the first is dark


def record(noise, seed, exposures=EXPOSURES, readings=4, size=64, slope=0.0, **changes):
    """A capture set as this camera would record it; `slope`: relative change of light across the image."""
    rng = np.random.default_rng(seed)
    shape = (size, size, 1)
    pattern, tilt = noise.fixed_pattern(shape, rng), np.broadcast_to(np.linspace(1 - slope, 1, size)[:, None], shape)
    frames = []
    for exposure in exposures:
        signal = noise.black_level + exposure * (noise.saturation - noise.black_level) * tilt
        images = [noise.expose(signal, rng, pattern).astype(np.float32) for _ in range(readings)]
        frames.append(Frame(str(exposure), images[0], parameters={"led.power": exposure}, repeats=images[1:]))
    return replace(Captures(None, "bench", frames), **changes)


# -- The model -------------------------------------------------------------------------------------------------------
def test_variance_is_the_sum_of_its_terms():
    assert CAMERA.variance(8.0) == pytest.approx(1.5**2 + 1 / 12)
    assert CAMERA.variance(108.0) == pytest.approx(0.05 * 100 + 1.5**2 + 1 / 12 + 0.3**2)
    assert CAMERA.variance(0.0) == CAMERA.variance(8.0)  # no light below black
    assert CAMERA.variance(108.0, 4) == pytest.approx((0.05 * 100 + 1.5**2 + 1 / 12) / 4 + 0.3**2)  # the pattern stays
    quiet = replace(CAMERA, dark_noise=0.3)
    assert quiet.variance(8.0, 4) == pytest.approx(0.3**2 / 4 + 1 / 12)  # below 0.5 DN nothing dithers the step
    assert CAMERA.sd(np.array([8.0, 108.0])) == pytest.approx(np.sqrt(CAMERA.variance(np.array([8.0, 108.0]))))


@pytest.mark.parametrize(
    "noise", [CAMERA, replace(CAMERA, system_gain=2.0, saturation=4095.0, prnu=0.0), replace(CAMERA, dark_noise=0.5)]
)
@pytest.mark.parametrize("frames", [1, 9])
def test_exposures_scatter_as_the_model_says(noise, frames):
    rng = np.random.default_rng(5)
    signal = rng.uniform(15, 0.7 * noise.saturation, 40_000)
    pattern = noise.fixed_pattern(signal.shape, rng)
    mean = np.mean([noise.expose(signal, rng, pattern) for _ in range(frames)], axis=0)
    pulls = (mean - signal) / noise.sd(signal, frames)
    assert np.mean(pulls) == pytest.approx(0.0, abs=4 / np.sqrt(40_000))
    assert np.mean(pulls**2) == pytest.approx(
        1.0, abs=4 * np.sqrt(2 / 40_000) + 0.005
    )  # + Poisson's kurtosis, 1/N electrons


@pytest.mark.parametrize(("dark_noise", "error"), [(0.5, 0.03), (0.3, 0.5)])
def test_the_step_acts_as_noise_where_it_is_dithered(dark_noise, error):
    noise, rng = replace(CAMERA, system_gain=1e-6, dark_noise=dark_noise, prnu=0.0), np.random.default_rng(1)
    ratios = [
        noise.expose(np.full(200_000, 20 + phase), rng).var() / noise.variance(20.0) for phase in (0.0, 0.25, 0.5)
    ]
    assert (
        error / 2 < np.abs(np.array(ratios) - 1).max() < error
    )  # the worst phase between two steps; sampling adds 0.3 %


def test_exposures_are_whole_and_clipped():
    dn = CAMERA.expose(np.linspace(-20, 400, 1000).reshape(10, 10, 10), np.random.default_rng(0))
    assert np.all(dn == np.round(dn)) and dn.min() >= 0 and dn.max() == 255
    fine = replace(CAMERA, quantisation=0.0).expose(np.full((9, 9), 50.0), np.random.default_rng(0))
    assert np.any(fine != np.round(fine))
    coarse = replace(CAMERA, quantisation=4.0).expose(np.full((9, 9), 50.0), np.random.default_rng(0))
    assert np.all(coarse % 4 == 0)


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("system_gain", 0.0, "system_gain = 0 DN per electron; allowed: > 0"),
        ("dark_noise", -1.0, "dark_noise = -1 DN, rms; allowed: >= 0"),
        ("prnu", float("nan"), "prnu = nan .relative, rms.; allowed"),
        ("black_level", float("inf"), "allowed: finite"),
        ("saturation", 8.0, "allowed: > black_level = 8 DN"),
        ("quantisation", -1.0, "allowed: >= 0"),
        ("correlation", -0.1, "correlation = -0.1 .of neighbouring pixels.; allowed: >= 0"),
        ("correlation", (0.2, 1.0, 0.2), "allowed: 0 or more, below 1"),
        ("correlation", float("nan"), "allowed: 0 or more, below 1"),
    ],
)
def test_impossible_numbers_are_refused(name, value, text):
    with pytest.raises(ValueError, match=text):
        replace(CAMERA, **{name: value})


def test_channels_may_have_numbers_of_their_own():
    own = replace(CAMERA, system_gain=[0.05, 0.1, 0.2], dark_noise=(1.5, 0.7, 1.0))
    signal = np.full((4, 5, 3), 100.0)
    for c in range(3):
        alone = replace(CAMERA, system_gain=own.system_gain[c], dark_noise=own.dark_noise[c])
        assert own.variance(signal)[0, 0, c] == pytest.approx(alone.variance(100.0))
        assert own.of_channel(c) == alone
    # without a list of the channels: the mean gain and the rms of the dark noises
    rms = np.sqrt((1.5**2 + 0.7**2 + 1.0) / 3)
    alike = replace(CAMERA, system_gain=0.35 / 3, dark_noise=rms)
    assert own.variance(100.0) == pytest.approx(alike.variance(100.0))
    assert own.summed(4).of_channel(1) == own.of_channel(1).summed(4)
    assert own.pedestal and not replace(own, dark_noise=(0.1, 0.1, 3.0)).pedestal
    frames = np.stack([own.expose(signal, np.random.default_rng(k)) for k in range(2000)])
    # of a variance of 40 000 values: 0.7 %
    assert frames.var(0).mean((0, 1)) == pytest.approx(
        own.variance(signal)[0, 0] - (own.prnu * 92) ** 2, rel=0.04
    )  # no pattern was asked for
    for bad in ({"system_gain": (0.1, 0.0, 0.1)}, {"dark_noise": (1.0, 1.0)}, {"dark_noise": [1.0, 1.0, -1.0]}):
        with pytest.raises(ValueError, match="allowed"):
            replace(CAMERA, **bad)


def test_masks_follow_data_and_noise_per_channel():
    image = np.full((7, 7, 2), 100.0)
    image[3, 3, 0] = 245.0  # 0.96 of 255 is 244.8
    image[0, 6, 1] = 1.0
    usable = CAMERA.usable(image)
    assert not usable[2:5, 2:5, 0].any() and usable[..., 0].sum() == 49 - 9 and usable[..., 1].all()
    assert (
        CAMERA.usable(image, dilate=0)[..., 0].sum() == 48 and CAMERA.usable(image, dilate=2)[..., 0].sum() == 49 - 25
    )
    bare = replace(CAMERA, black_level=0.0)  # no pedestal: 3 sigma of 0 is 3 sqrt(0.05 S + 1.5^2 + 1/12), S = 4.7 DN
    assert (
        not bare.usable(image)[0, 6, 1]
        and bare.usable(np.full((1, 1, 1), 5.0)).all()
        and not bare.usable(np.full((1, 1, 1), 4.5)).any()
    )
    assert CAMERA.pedestal and not bare.pedestal


# -- Estimation ------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("slope", [0.0, 0.5])
@pytest.mark.parametrize(
    "noise",
    [
        CAMERA,
        replace(CAMERA, system_gain=0.2, prnu=0.01),
        Noise(1.0, 6.0, 64.0, 4095.0, 0.005),
        Noise(0.8, 1.0, 20.0, 1023.0, 0.004),
    ],
)
def test_a_known_camera_is_recovered(noise, slope):
    runs = [estimate(record(noise, seed, slope=slope)) for seed in range(24)]
    assert all(run.saturation == noise.saturation and run.quantisation == 1.0 for run in runs)
    for name, most in (
        ("system_gain", 0.03),
        ("dark_noise", 0.02),
        ("black_level", 0.005),
        ("prnu", 0.25),
    ):  # one run's scatter
        values, truth = np.array([getattr(run, name) for run in runs]), getattr(noise, name)
        sd = values.std(ddof=1)
        assert sd < most * truth, name
        # No bias beyond 3.5 standard errors (24 runs, 8 cases, 4 numbers: one chance in 20 at all) and, for PRNU, 3 %:
        # its score is cut at three sigma of a mixture of widths.
        allowed = 3.5 * sd / np.sqrt(len(runs)) + (0.03 * truth if name == "prnu" else 0.0)
        assert values.mean() == pytest.approx(truth, abs=allowed), name


def test_the_uncertainty_of_the_photon_transfer_is_honest():
    rng = np.random.default_rng(8)
    light, weight = np.linspace(0, 200, 12), np.full(12, 2000.0)
    truth = np.array([0.05, 2.3])
    pulls = []
    for _ in range(200):
        expected = truth[0] * light + truth[1]
        line, covariance = photon_transfer(light, expected * rng.chisquare(2 * weight) / (2 * weight), weight)
        pulls.append((line - truth) / np.sqrt(np.diag(covariance)))
    assert np.abs(np.mean(pulls, axis=0)).max() < 4 / np.sqrt(200)
    assert np.abs(np.std(pulls, axis=0) - 1).max() < 4 / np.sqrt(400)


def test_two_readings_flicker_masks_and_colour_are_enough():
    c = record(CAMERA, 1, readings=2, size=96)
    for i, f in enumerate(c.frames):
        if i:
            f.repeats[0] = np.round(f.repeats[0] * 1.01)  # a lamp that flickers by 1 %
        f.image[:5] = 255.0  # a reflection, left out by the mask
        f.repeats[0][:5] = 0.0
        f.mask = np.ones((96, 96), bool)
        f.mask[:5] = False
    c.frames[0].image[:5] = 8.0
    c.frames[0].repeats[0][:5] = 8.0
    found = estimate(c)
    assert found.system_gain == pytest.approx(0.05, rel=0.1)  # 5 sd of 2 readings of 96 x 96 pixels
    assert found.dark_noise == pytest.approx(1.5, rel=0.1)


def test_a_mosaic_compares_pixels_of_one_colour():
    c = record(replace(CAMERA, prnu=0.01), 3)
    for f in c.frames[1:]:
        for image in (f.image, *f.repeats):
            image[:, ::2] = np.round(
                8 + (image[:, ::2] - 8) * 0.8
            )  # neighbours of another colour; their noise shrinks as well
    assert estimate(replace(c, cfa="RGGB")).prnu == pytest.approx(0.01, rel=0.15)
    assert estimate(c).prnu > 0.03  # taken for a pattern where the mosaic is not declared


def test_what_was_given_is_not_estimated():
    lit = record(CAMERA, 2, exposures=EXPOSURES[1:])
    with pytest.raises(Underdetermined, match="dark frame"):
        estimate(lit)
    found = estimate(lit, black_level=8.0, saturation=250.0)
    assert (found.black_level, found.saturation) == (8.0, 250.0)
    assert found.dark_noise == pytest.approx(1.5, rel=0.1)  # extrapolated from 10 % of saturation


@pytest.mark.parametrize(
    ("captures", "text"),
    [
        (record(CAMERA, 0, readings=1), "no frame has repeats"),
        (
            record(CAMERA, 0, exposures=(0.0, 0.5)),
            "2 signal levels can be used, 3 are needed; add repeats at six exposures",
        ),
        (record(CAMERA, 0, exposures=(0.0, 0.01, 0.02), size=24), "needed to 10 %; add repeats at six exposures"),
        (record(replace(CAMERA, black_level=0.0), 0), "dark values are clipped at 0 DN; set a pedestal"),
        (record(replace(CAMERA, quantisation=0.0), 0), "give saturation in DN"),
    ],
)
def test_what_cannot_be_told_says_what_to_supply(captures, text):
    with pytest.raises(Underdetermined, match=text):
        estimate(captures)


def test_a_wrong_black_level_is_noticed():
    with pytest.raises(Underdetermined, match="black level is too low"):
        estimate(record(replace(CAMERA, system_gain=0.5), 0), black_level=-20.0)


def test_the_step_of_a_converter():
    assert step_of([np.arange(0, 4096, 16.0)]) == 16.0
    assert step_of([np.arange(100.0)]) == 1.0
    assert step_of([np.arange(100.0) / 4]) == 0.0
    assert step_of([np.array([10.0, 20.0])]) == 1.0  # too few to tell


def test_warnings_name_what_weakens_a_verdict():
    c = record(CAMERA, 0)
    assert warnings_of(CAMERA, c) == []
    frame = replace(c.frames[0], image=np.zeros((4, 4, 3), np.float32))
    weak = replace(c, frames=[frame], bits=8)
    texts = warnings_of(replace(CAMERA, black_level=0.0, prnu=0.01), weak)
    for text, word in zip(texts, ("pedestal", "demosaiced", "8 bit", "one frame", "PRNU 1.00%"), strict=True):
        assert word in text
    assert not any("PRNU" in t for t in warnings_of(replace(CAMERA, prnu=0.01), replace(c, flat_field=frame.image)))


def test_the_noise_of_a_sum_of_frames_is_that_of_its_frames():
    one, rng = Noise(0.2, 2.0, 64.0, 4095.0, 0.0), np.random.default_rng(5)
    many = one.summed(16)
    assert (many.black_level, many.saturation, many.system_gain) == (1024.0, 65520.0, 0.2)
    for level in (64.0, 200.0, 3000.0):
        signal = np.full((200, 200, 1), level)
        sums = sum(one.expose(signal, rng) for _ in range(16))
        assert many.variance(16 * level) == pytest.approx(16 * one.variance(level), rel=1e-12)
        # 40 000 values tell a variance to 0.7 %, and a mean to 1/200 of their scatter: four of these
        assert sums.var() == pytest.approx(float(many.variance(16 * level)), rel=0.028)
        assert sums.mean() == pytest.approx(16 * level, abs=4 * many.sd(16 * level) / 200)
    assert one.summed(1) == one


def test_a_fixed_pattern_does_not_average_down_in_a_sum():
    one, signal = Noise(0.2, 2.0, 64.0, 4095.0, 0.01), 3000.0
    floor = one.summed(16).variance(16 * signal) - replace(one, prnu=0.0).summed(16).variance(16 * signal)
    assert floor == pytest.approx((0.01 * 16 * (signal - 64.0)) ** 2)
