"""MagicTac's Algorithms 1-3: each quantity by a closed form, each state on a scene drawn for it, and what noise does to
them."""

import numpy as np
import pytest

from optics.readers import grid
from optics.readers.grid import Contact, Proximity, References, combine, contact, proximity, read_sequence, references

HEIGHT, WIDTH = 120, 160  # px
SHAPE = (HEIGHT, WIDTH, 3)
Y, X = np.indices((HEIGHT, WIDTH)) + 0.5


# -- Drawing ---------------------------------------------------------------------------------------------------------
def repeat(plane):
    return np.repeat(np.asarray(plane, float)[..., None], 3, axis=2)


def texture(seed=0):
    return np.random.default_rng(seed).uniform(60, 140, SHAPE)  # DN; every fraction of a step alike


def take(scene, noise, rng, common=0.0):
    """A frame in whole DN of 8 bit; `common`: sd of noise that the three channels share."""
    shot = scene + noise * rng.standard_normal(SHAPE) + common * rng.standard_normal((HEIGHT, WIDTH, 1))
    return np.clip(np.round(shot), 0, 255).astype(np.float32)


def spot(x, y, sd=14.0):
    return np.exp(-((X - x) ** 2 + (Y - y) ** 2) / (2 * sd**2))


def near_thing(level):
    """A thing lit red, green and blue from three sides: 72 and 80 px apart, above 5 sd."""
    return level * np.stack([spot(40, 35), spot(120, 35), spot(80, 95)], -1)


def flashlight(level, sd=40.0):
    return level * repeat(spot(90, 50, sd))


def stripes(shift=0, where=None, period=16, width=4):
    """(H, W) bool: upright walls; shifted to the right by whole px, in rows below `where` only if given."""
    walls = (X.astype(int) % period) < width
    moved = (X.astype(int) - shift) % period < width
    return moved if where is None else np.where(where < Y, moved, walls)


def lit(walls, on=120.0, off=10.0):
    return repeat(np.where(walls, on, off))


# -- The quantities --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "levels, bits",
    [
        ([7], 0),
        ([0, 255], 1),
        ([1, 2, 3, 4], 2),
        ([5, 5, 9, 200], 1.5),
        (range(256), 8),
        ([0, 0, 0, 10], 2 - 0.75 * np.log2(3)),
        ([0.5, 1.0], 0),
        ([0.49, 0.5], 1),
    ],
)
def test_entropy_is_that_of_the_shares_of_whole_levels(levels, bits):
    plane = np.array(list(levels), float).reshape(1, -1)
    assert grid.entropy(plane) == pytest.approx(bits, abs=1e-12)
    assert grid.entropy(np.repeat(plane, 3, axis=0)[:, ::-1]) == pytest.approx(
        bits, abs=1e-12
    )  # neither size nor order count


@pytest.mark.parametrize(
    "channel, level", list(enumerate((76, 150, 29)))
)  # 0.299, 0.587 and 0.114 of 255: 76.2, 149.7, 29.1
def test_grey_weighs_channels_as_bt_601(channel, level):
    image = np.full((1, 2, 3), float(level))
    image[0, 1] = 255.0 * (np.arange(3) == channel)
    assert grid.entropy(image) == 0  # both pixels are of one level
    assert grid.entropy(image + [[[1.0], [0]]]) == 1 and grid.entropy(image - [[[1.0], [0]]]) == 1


def test_entropy_refuses_what_is_not_8_bit():
    with pytest.raises(ValueError, match="0 to 4000 DN; allowed: 0 to 255"):
        grid.entropy(np.array([[0.0, 4000.0]]))


@pytest.mark.parametrize("angle", [0.0, 0.5, np.pi / 2, 2.0, np.pi])
def test_correlation_is_the_cosine_between_channels(angle):
    u, v = np.cos(2 * np.pi * X / WIDTH), np.cos(4 * np.pi * X / WIDTH)  # orthogonal, of mean 0 and equal power
    image = np.stack([100 + 40 * u, 80 + 9 * (np.cos(angle) * u + np.sin(angle) * v), 90 - 5 * v], -1)
    assert grid.correlations(image) == pytest.approx([np.cos(angle), 0, -np.sin(angle)], abs=1e-9)


def test_correlation_takes_all_pixels():
    image = np.random.default_rng(1).uniform(0, 255, SHAPE) ** 2 / 255
    image[30:60] = 0  # zeros too
    whole = np.corrcoef(image.reshape(-1, 3).T)
    assert grid.correlations(image) == pytest.approx([whole[0, 1], whole[0, 2], whole[1, 2]], abs=1e-12)


def test_correlation_with_a_constant_channel_is_undefined():
    image = repeat(X)
    image[..., 1] = 7.3
    assert grid.correlations(image) == pytest.approx([np.nan, 1, np.nan], nan_ok=True)
    image[..., 1] += 1e-5 * np.sin(Y)  # rounding is no image
    assert grid.correlations(image) == pytest.approx([np.nan, 1, np.nan], nan_ok=True)


def test_one_pixel_is_read_and_left_as_it_is():
    image = np.array([[[3.0, 200.0, 9.0]]])
    assert np.isnan(grid.correlations(image)).all() and grid.entropy(image) == 0
    assert image.ravel().tolist() == [3, 200, 9]


def test_similarity_is_the_share_of_the_reference_that_is_left():
    reference, now = np.zeros(SHAPE, bool), np.zeros(SHAPE, bool)
    reference[:10, :10, :2] = True  # 100 px; blue has none
    now[:10, 7:90, 0] = True  # 30 of them, and 800 others
    now[..., 1] = True
    assert grid.similarity(now, reference) == pytest.approx([0.3, 1, np.nan], nan_ok=True)


# -- Depth -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("black_level, saturation", [(0, 65535), (0, 4080), (64, 64 + 4 * 255), (2.5, 3.5)])
def test_depth_and_black_level_change_nothing(black_level, saturation):
    rng = np.random.default_rng(2)
    walls = lit(stripes())
    frames = [take(walls, 1.0, rng) for _ in range(6)]
    image = take(lit(stripes(shift=2)) + near_thing(60), 1.0, rng)

    def other(a):
        return black_level + a.astype(float) * (saturation - black_level) / 255

    still = references(frames)
    same = references([other(f) for f in frames], black_level=black_level, saturation=saturation)
    np.testing.assert_allclose(same.background, still.background, atol=1e-9)
    assert np.array_equal(same.grid, still.grid)
    near, near_same = proximity(image, still), proximity(other(image), same)
    np.testing.assert_allclose(near_same.filtered, near.filtered, atol=1e-9)
    # grey levels half way between two whole ones may round either way: 0.299 R + 0.587 G + 0.114 B often has three
    # decimals
    assert near_same.entropy == pytest.approx(near.entropy, abs=0.01)
    assert near_same.correlation == pytest.approx(near.correlation, abs=1e-9)
    assert contact(other(image), same).similarity == contact(image, still).similarity


def test_whole_numbers_are_read_as_fractions_are():
    rng = np.random.default_rng(3)
    frames = [take(texture(), 2.0, rng) for _ in range(4)]
    still, same = references(frames), references([f.astype(np.uint8) for f in frames])
    image = take(texture() + near_thing(50), 2.0, rng)
    assert np.array_equal(still.background, same.background)  # and no difference of unsigned numbers has wrapped round
    assert proximity(image.astype(np.uint8), same).entropy == proximity(image, still).entropy


def test_what_is_beyond_the_range_is_cut_as_a_camera_would():
    image = np.zeros(SHAPE) - 5.0
    image[0, 0], image[0, 1] = 64, 10000
    assert grid.eight_bit(image, 64, 1084)[0, :3, 0].tolist() == [0, 255, 0]


def test_frames_of_another_depth_are_noticed():
    with pytest.raises(ValueError, match="frame 1: up to 4000 DN; allowed: <= 255 DN"):
        references([np.full(SHAPE, 200.0), np.full(SHAPE, 4000.0)], 1)


# -- Algorithm 1 -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("count, means", [(1, [3]), (2, [1.5, 5]), (3, [1, 3.5, 5.5]), (7, [0, 1, 2, 3, 4, 5, 6])])
def test_backgrounds_are_means_of_frames_in_a_row(count, means):
    still = references([np.full(SHAPE, float(i)) for i in range(7)], count)
    assert still.background.shape == (count, *SHAPE)
    assert still.background[:, 5, 5, 1] == pytest.approx(means)
    assert np.all(still.ceiling == still.background.max(0)) and still.ceiling.max() == pytest.approx(means[-1])


@pytest.mark.parametrize("majority, least", [(0.0, 1), (0.25, 2), (0.5, 3), (0.75, 4)])
def test_grid_is_what_more_than_a_share_of_frames_has(majority, least):
    frames = np.zeros((4, *SHAPE))
    for times in range(5):
        frames[:times, :, 30 * times : 30 * times + 30] = 36  # columns that are above in so many of four
    frames[:, :, 150:] = 35  # at the threshold is not above
    still = references(frames, blur=0, majority=majority)
    found = [bool(still.grid[60, 30 * times + 15, 2]) for times in range(5)]
    assert found == [times >= least for times in range(5)]
    assert not still.grid[:, 150:].any()


def test_blur_is_opencv_s_five_by_five():
    frame = np.zeros(SHAPE)
    frame[60, 80] = 250.0
    weights = np.exp(-(np.arange(-2, 3) ** 2) / (2 * 1.1**2))
    weights /= weights.sum()
    for at, weight in (((60, 80), weights[2] ** 2), ((60, 82), weights[2] * weights[0]), ((58, 78), weights[0] ** 2)):
        level = 250 * weight
        assert references([frame], 1, binary=level * 0.999).grid[at].all()
        assert not references([frame], 1, binary=level * 1.001).grid[at].any()
    assert references([frame], 1, binary=0).grid[..., 0].sum() == 25
    assert references([np.full(SHAPE, 36.0)], 1).grid.all()  # no darker at the border
    assert (
        references([frame], 1, blur=0).grid[..., 0].sum() == 1 and not references([frame] * 3, 1, binary=35).grid.any()
    )


def test_channels_are_not_mixed():
    frame = np.zeros(SHAPE)
    frame[..., 1] = lit(stripes(), off=0)[..., 1]
    still = references([frame], 1, binary=5)
    assert still.share[1] > 0.2 and still.share[[0, 2]].tolist() == [0, 0]


# -- Algorithm 2 -----------------------------------------------------------------------------------------------------
def test_intersection_is_the_running_minimum_of_the_differences():
    rng = np.random.default_rng(4)
    frames = [take(texture(), 5.0, rng) for _ in range(9)]
    still = references(frames, 3)
    image = take(texture() + near_thing(30), 5.0, rng)
    for band in (0.0, 4.0):
        running = np.full(SHAPE, 255.0)  # as Algorithm 2 is written
        for group in (frames[:3], frames[3:6], frames[6:]):
            difference = image - np.mean(group, axis=0, dtype=float)
            running = np.minimum(running, np.where(difference > band, difference, 0))
        found = proximity(image, still, dead_band=band)
        np.testing.assert_allclose(found.filtered, running, atol=1e-9)
        assert found.entropy == grid.entropy(found.filtered)
        assert found.correlation == pytest.approx(found.pairs.mean(), abs=1e-12)
    # whole numbers less means of three: what passes keeps its value, band and all
    assert found.filtered[found.filtered > 0].min() == pytest.approx(4 + 1 / 3)


def quiet(seed=5, noise=0.3):
    rng = np.random.default_rng(seed)
    return references([take(texture(), noise, rng) for _ in range(30)]), rng


def test_a_still_scene_is_normal():
    still, rng = quiet()
    for _ in range(5):
        found = proximity(take(texture(), 0.3, rng), still)
        assert found.state == "Normal" and 0 < found.entropy < 0.3


def test_a_thing_that_channels_see_apart_is_approaching():
    still, rng = quiet()
    found = [proximity(take(texture() + near_thing(level), 0.3, rng), still) for level in (0, 3, 10, 30, 90)]
    assert [f.state for f in found] == ["Normal"] + 4 * ["Approaching"]
    assert np.all(np.diff([f.entropy for f in found]) > 0.2)  # rises as it comes nearer
    # spots u, v that do not overlap: cov = -<u><v>, var = <u^2> - <u>^2, with <u> = 2 pi sd^2 / A, <u^2> = pi sd^2 / A
    mean, square = 2 * np.pi * 14**2 / (HEIGHT * WIDTH), np.pi * 14**2 / (HEIGHT * WIDTH)
    assert found[-1].correlation == pytest.approx(
        -(mean**2) / (square - mean**2), abs=0.015
    )  # two are cut by the border


def test_light_common_to_all_channels_is_noise():
    still, rng = quiet()
    for level in (5, 30, 90):
        found = proximity(take(texture() + flashlight(level), 0.3, rng), still)
        assert found.state == "Noise" and found.correlation > 0.9 and np.all(found.pairs > 0.9)
    glare = proximity(take(texture() + 400, 0.3, rng), still)  # all saturated: F = 255 - B
    assert (
        glare.entropy > 0.5 and glare.state == "Approaching"
    )  # with textures that channels do not share: the backgrounds' own


def test_thresholds_decide_as_algorithm_2_writes_them():
    still, rng = quiet()
    image = take(texture() + flashlight(30), 0.3, rng)
    e, c = proximity(image, still).entropy, proximity(image, still).correlation

    def state(**thresholds):
        return proximity(image, still, **thresholds).state

    assert state(entropy_threshold=e + 1e-9) == "Normal" and state(entropy_threshold=e) == "Noise"
    assert state(correlation_threshold=c + 1e-9) == "Approaching" and state(correlation_threshold=c) == "Noise"


@pytest.mark.parametrize(
    "noise, bits",
    [
        (0.1, 0.05),
        (0.2, 0.12),
        (0.3, 0.19),
        (0.4, 0.29),
        (0.5, 0.39),
        (0.6, 0.50),
        (0.7, 0.59),
        (1, 0.83),
        (2, 1.41),
        (5, 2.37),
    ],
)
def test_noise_alone_has_the_entropy_that_the_manual_says(noise, bits):
    rng = np.random.default_rng(6)
    frames = [take(texture(), noise, rng) for _ in range(31)]
    found = proximity(frames.pop(), references(frames))
    assert found.entropy == pytest.approx(bits, abs=0.015)  # the table's last digit, and 0.005 of 19200 px
    assert abs(found.correlation) < 0.02  # 19200^-1/2 / 3^1/2 is 0.004
    if noise != 0.6:
        assert found.state == ("Normal" if noise < 0.6 else "Approaching")
    banded = proximity(take(texture(), noise, rng), references(frames), dead_band=3 * noise)
    assert banded.state == "Normal" and banded.entropy < 0.12
    single = proximity(take(texture(), noise, rng), references(frames, 30))
    assert single.state == "Normal" and single.entropy < 0.36


def test_a_dead_band_hides_noise_and_keeps_what_is_brighter():
    rng, noise = np.random.default_rng(7), 2.0
    still = references([take(texture(), noise, rng) for _ in range(30)])
    far, near = (take(texture() + near_thing(level), noise, rng) for level in (0, 60))
    assert proximity(far, still).state == "Approaching"  # falsely
    assert proximity(far, still, dead_band=3 * noise).state == "Normal"
    assert proximity(near, still, dead_band=3 * noise).state == "Approaching"
    lamp = take(texture() + flashlight(60), noise, rng)
    assert proximity(lamp, still, dead_band=3 * noise).state == "Noise"


def test_lamps_that_drift_by_half_a_percent_look_like_a_thing():
    still, rng = quiet()
    drifted = take(1.005 * texture(), 0.3, rng)
    assert proximity(drifted, still).state == "Approaching"  # falsely: 0.5 DN, in textures that channels do not share
    assert proximity(drifted, still, dead_band=2.0).state == "Normal"


def test_one_channel_alone_has_no_correlation_and_is_approaching():
    still = references([texture()] * 3)
    image = texture()
    image[..., 0] += 50 * spot(80, 60)
    found = proximity(image, still)
    assert np.isnan(found.pairs).all() and found.correlation == 0 and found.state == "Approaching"


def test_a_pair_without_correlation_counts_as_the_least_noise_would_make_it():
    still = references([texture()] * 3)
    image = texture()
    image[..., :2] += 50 * spot(80, 60)[..., None]
    found = proximity(image, still)
    assert found.pairs == pytest.approx([1, np.nan, np.nan], nan_ok=True)
    assert found.correlation == pytest.approx(1 / 3) and found.state == "Noise"
    image[..., 2] += 0.01 * np.random.default_rng(8).uniform(size=(HEIGHT, WIDTH))
    noisy = proximity(image, still)
    assert np.isfinite(noisy.pairs).all()
    assert noisy.correlation == pytest.approx(found.correlation, abs=0.02)  # 19200^-1/2 = 0.007 for each of two


def test_even_light_and_what_darkens_are_not_seen():
    still = references([texture()] * 3)
    for change in (20.0, -20.0, -near_thing(50), 0.0):
        found = proximity(texture() + change, still)
        assert found.entropy == 0 and found.state == "Normal" and found.correlation == 0 and np.isnan(found.pairs).all()


# -- Algorithm 3 -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "shift, where, left",
    [(0, None, 1), (1, None, 0.75), (2, None, 0.5), (4, None, 0), (16, None, 1), (4, 90, 0.75), (2, 30, 0.625)],
)
@pytest.mark.parametrize("dark", [False, True])
def test_similarity_falls_by_the_part_of_the_walls_that_moved(shift, where, left, dark):
    def draw(*args):
        return 130 - lit(stripes(*args)) if dark else lit(stripes(*args))  # 120 and 10 DN

    found = contact(draw(shift, where), references([draw()] * 3, blur=0, dark=dark))
    assert found.channels == pytest.approx(3 * [left]) and found.similarity == pytest.approx(left)
    assert found.state == ("Touched" if left < 0.6 else "Untouched")
    assert np.array_equal(found.grid[..., 1], stripes(shift, where))


def test_similarity_at_the_threshold_is_untouched():
    still = references([lit(stripes())] * 3, blur=0)
    half = lit(stripes(shift=2))
    assert contact(half, still, similarity_threshold=0.5).state == "Untouched"
    assert contact(half, still, similarity_threshold=0.5 + 1e-9).state == "Touched"


def test_settings_of_the_references_are_those_of_the_image():
    walls = lit(stripes(), on=120, off=60)  # all above 35 DN
    still = references([walls] * 3, binary=90, blur=0)
    assert still.share == pytest.approx(3 * [0.25])
    assert contact(lit(stripes(2), on=120, off=60), still).similarity == 0.5
    blurred = references([walls] * 3, binary=62, blur=3)
    assert contact(walls, blurred).similarity == 1 and blurred.share.min() > 0.5


def test_a_wide_mask_cannot_lose_more_than_its_share_allows():
    wide = ~stripes(width=4)  # a = 3/4 of the image
    still = references([lit(wide)] * 3, blur=0)
    assert still.share == pytest.approx(3 * [0.75])
    all_shifts = [contact(lit(np.roll(wide, s, axis=1)), still).similarity for s in range(16)]
    assert min(all_shifts) == pytest.approx(2 - 1 / 0.75)
    assert np.mean(all_shifts) == pytest.approx(0.75)  # by chance
    assert {contact(lit(np.roll(wide, s, axis=1)), still).state for s in range(16)} == {"Untouched"}


def test_noise_leaves_the_similarity_of_a_still_grid():
    rng = np.random.default_rng(9)
    scene = lit(stripes()) + 30 * X[..., None] / WIDTH
    still = references([take(scene, 2.0, rng) for _ in range(12)])
    assert contact(take(scene, 2.0, rng), still).similarity > 0.98  # whole columns of the rim may stand at tau_B


def test_a_grid_that_breaks_up_is_touched():
    rng = np.random.default_rng(10)
    still = references([take(lit(stripes()), 1.0, rng) for _ in range(6)])
    assert still.share == pytest.approx(3 * [0.375], abs=0.01)  # the blur widens 4 px to 6 above 35 of 120 DN
    found = contact(take(lit(stripes(8)), 1.0, rng), still)
    assert found.state == "Touched" and found.similarity < 0.05


def test_light_adds_to_bright_grids_and_takes_from_dark_ones():
    scene, light = 130 - lit(stripes()), flashlight(80, sd=60)
    bright, dark = references([scene] * 3), references([scene] * 3, dark=True)
    assert contact(scene + light, bright).similarity == 1  # whatever is added
    assert contact(scene + light, dark).similarity < 0.5
    assert contact(scene * 0.2, bright).similarity == 0  # an exposure that the camera cuts down


def test_a_channel_without_grid_is_left_out():
    scene = lit(stripes())
    scene[..., 2] = 5
    found = contact(lit(stripes(2)), references([scene] * 3, blur=0))
    assert found.channels == pytest.approx([0.5, 0.5, np.nan], nan_ok=True) and found.similarity == 0.5


@pytest.mark.parametrize(
    "level, dark, said",
    [
        (20, False, "no pixel is above binary = 35 8 bit DN in any channel"),
        (90, True, "no pixel is at or below binary = 35 8 bit DN"),
    ],
)
def test_without_any_grid_there_is_no_contact_to_read(level, dark, said):
    still = references([np.full(SHAPE, level)] * 3, dark=dark)
    with pytest.raises(ValueError, match=said):
        contact(np.full(SHAPE, level), still)
    assert proximity(np.full(SHAPE, level), still).state == "Normal"


# -- Both together ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "near, touch, left, together",
    [
        ("Normal", "Untouched", 0.85, "Normal"),
        ("Approaching", "Untouched", 0.85, "Approaching"),
        ("Noise", "Untouched", 0.85, "Noise"),
        ("Normal", "Touched", 0.55, "Touched"),
        ("Approaching", "Touched", 0.3, "Touched"),
        ("Normal", "Touched", 0.3, "Touched"),
        ("Noise", "Touched", 0.55, "Touched"),
        ("Noise", "Touched", 0.5, "Touched"),
        ("Noise", "Touched", 0.49, "Noise"),
    ],
)
def test_a_drop_is_light_only_where_it_is_deep_and_channels_agree(near, touch, left, together):
    assert (
        combine(Proximity(near, 1.0, 0.0, np.zeros(3), None), Contact(touch, left, np.full(3, left), None)) == together
    )


def test_a_sequence_reads_as_figure_28_tells_it():
    rng = np.random.default_rng(11)
    cells = (X % 12 > 4) & (Y % 12 > 4)

    def press(radius):  # a disc of the grid moves by a wall's width
        return np.where(np.hypot(X - 80, Y - 60) < radius, np.roll(cells, (5, 5), (0, 1)), cells)

    def shot(seen, thing=0.0, light=0.0):  # walls of 12 DN between cells of 90, through which the thing is seen
        return take(repeat(np.where(seen, 90, 12)) + near_thing(thing) * seen[..., None] + light, 0.3, rng, common=0.2)

    still = references([shot(cells) for _ in range(30)], dark=True)
    story = [
        shot(cells),
        shot(cells, 5),
        shot(cells, 20),
        shot(press(45), 40),
        shot(cells, light=flashlight(90, 90)),
        shot(cells),
    ]
    rows = read_sequence((image for image in story), still, similarity_threshold=0.8)
    frame, entropy, correlation, similarity, near, touch, state = zip(*rows)
    assert frame == (0, 1, 2, 3, 4, 5)
    assert state == ("Normal", "Approaching", "Approaching", "Touched", "Noise", "Normal")
    assert touch == (
        "Untouched",
        "Untouched",
        "Untouched",
        "Touched",
        "Touched",
        "Untouched",
    )  # light alone would be a touch
    assert entropy[0] < 0.5 < entropy[1] < entropy[2] < entropy[4] and correlation[0] > 0.1 > correlation[2]
    assert correlation[4] > 0.95 and similarity[4] < 0.5
    assert min(similarity[:3]) > 0.95 and 0.5 < similarity[3] < 0.8
    # and what falls short: places that walls leave brighten in all channels
    assert near[3] == "Noise" and correlation[3] > 0.8
    (deep,) = read_sequence([shot(press(70), 40)], still)
    assert deep.similarity < 0.5 and deep.contact == "Touched" and deep.state == "Noise"


def test_a_sequence_is_the_three_readers_and_passes_their_options_on():
    rng = np.random.default_rng(12)
    scene = lit(stripes())
    still = references([take(scene, 1.0, rng) for _ in range(6)])
    image = take(scene + near_thing(30), 1.0, rng)
    (row,) = read_sequence([image], still)
    near, touch = proximity(image, still), contact(image, still)
    assert row == (0, near.entropy, near.correlation, touch.similarity, near.state, touch.state, combine(near, touch))
    (row,) = read_sequence([image], still, entropy_threshold=8, similarity_threshold=1.0, dead_band=4.0)
    assert row.entropy == proximity(image, still, dead_band=4.0).entropy and row.proximity == "Normal"
    moved = take(lit(stripes(8)), 1.0, rng)
    (row,) = read_sequence([moved], still, correlation_threshold=-1)
    assert (row.proximity, row.contact, row.state) == ("Noise", "Touched", "Noise")
    (row,) = read_sequence([moved], still, correlation_threshold=-1, light_similarity=0)
    assert row.state == "Touched"
    assert read_sequence([], still) == []


def test_a_bad_frame_is_named():
    still = references([lit(stripes())] * 3)
    with pytest.raises(ValueError, match=r"frame 1: image \(60, 160, 3\), references \(120, 160, 3\)"):
        read_sequence([lit(stripes()), lit(stripes())[::2]], still)


# -- What is refused -------------------------------------------------------------------------------------------------
NAN = np.full(SHAPE, np.nan)
GOOD = [np.full(SHAPE, 100.0)] * 3


@pytest.mark.parametrize(
    "frames, options, said",
    [
        ([], {}, "count = 3 backgrounds of 0 frames"),
        (GOOD, {"count": 4}, "count = 4 backgrounds of 3"),
        (GOOD, {"count": 0}, "count = 0"),
        (GOOD, {"count": 1.5}, "count = 1.5"),
        (GOOD[0], {}, r"shape \(160, 3\).*allowed: real \(H, W, 3\)"),
        ([np.zeros((9, 9))] * 3, {}, r"shape \(9, 9\)"),
        ([np.zeros((9, 9, 1))] * 3, {}, "demosaic"),
        ([np.zeros((9, 9, 3), complex)] * 3, {}, "complex"),
        ([*GOOD, np.zeros((9, 9, 3))], {}, r"frame 3: shape \(9, 9, 3\)"),
        ([*GOOD, NAN], {}, "57600 values are NaN"),
        (GOOD, {"binary": 300}, "binary = 300 8 bit DN; allowed: 0 to 255"),
        (GOOD, {"binary": np.nan}, "binary = nan"),
        (GOOD, {"blur": -1}, "blur = -1 px"),
        (GOOD, {"majority": 1}, "allowed: 0 to below 1"),
        (GOOD, {"saturation": 0}, "saturation = 0 DN; allowed"),
        (GOOD, {"black_level": np.inf}, "black_level = inf"),
    ],
)
def test_references_refuse_what_they_cannot_mean(frames, options, said):
    with pytest.raises(ValueError, match=said):
        references(frames, **options)


@pytest.mark.parametrize(
    "reader, option, value",
    [
        (proximity, "entropy_threshold", 9),
        (proximity, "correlation_threshold", -1.1),
        (proximity, "dead_band", -1),
        (contact, "similarity_threshold", 1.5),
        (read_sequence, "light_similarity", 2),
        (read_sequence, "dead_band", np.nan),
    ],
)
def test_readers_refuse_settings_out_of_range(reader, option, value):
    image = [GOOD[0]] if reader is read_sequence else GOOD[0]
    with pytest.raises(ValueError, match=f"{option} = {value:g}.*allowed: .* to .*; see"):
        reader(image, references(GOOD), **{option: value})


@pytest.mark.parametrize("reader", [proximity, contact])
@pytest.mark.parametrize("image", [NAN, np.zeros((9, 9, 3)), np.zeros(SHAPE[:2]), np.zeros((2, *SHAPE))])
def test_readers_refuse_other_images(reader, image):
    with pytest.raises(ValueError, match="allowed"):
        reader(image, references(GOOD))


@pytest.mark.parametrize(
    "background, mask, said",
    [
        (np.zeros(SHAPE), np.zeros(SHAPE, bool), r"allowed: \(M, H, W, 3\)"),
        (np.zeros((1, *SHAPE)), np.zeros((9, 9, 3), bool), r"grid \(9, 9, 3\)"),
        (np.zeros((0, *SHAPE)), np.zeros(SHAPE, bool), r"background \(0,"),
        (np.zeros((1, *SHAPE)), np.zeros(SHAPE), "allowed: bool"),
    ],
)
def test_references_made_by_hand_are_checked(background, mask, said):
    with pytest.raises(ValueError, match=said):
        References(background, mask)
