"""What robots compute from such a sensor's images: markers to a fraction of a pixel, areas without steps, one r for all
sizes."""

import numpy as np
import pytest
from scipy import ndimage

from optics.errors import UnknownKey
from optics.readers.markers import displacement, find, grid_order, match
from optics.readers.proximity import area, distance, metric, reliable_range

WIDTH, HEIGHT = 160, 120  # px
COLUMNS, ROWS, PITCH_X, PITCH_Y = 5, 4, 26.0, 24.0  # px
RADIUS, BRIGHT, DARK = 4.2, 120.0, 20.0  # px, DN, DN
FINE = 8  # samples per pixel and axis: the sampled outline places a centre of this radius to 0.01 px


# -- Drawing ---------------------------------------------------------------------------------------------------------
def cover(inside, shape=(HEIGHT, WIDTH)):
    """(H, W) share of each pixel in which inside(x, y) holds, by FINE x FINE samples."""
    s = (np.arange(FINE) + 0.5) / FINE
    x, y = (np.arange(shape[1])[:, None] + s).ravel(), (np.arange(shape[0])[:, None] + s).ravel()
    return inside(x[None], y[:, None]).reshape(shape[0], FINE, shape[1], FINE).mean((1, 3))


def disc(x, y, radius, shape=(HEIGHT, WIDTH)):
    return cover(lambda u, v: np.hypot(u - x, v - y) < radius, shape)


def draw(centres, radius=RADIUS, bright=BRIGHT, behind=DARK):
    """Opaque discs on what is behind them, DN."""
    image = np.zeros((HEIGHT, WIDTH)) + behind
    for (x, y), level in zip(centres, np.broadcast_to(bright, len(centres))):
        left, top = int(x) - 12, int(y) - 12
        a = np.zeros((HEIGHT, WIDTH))
        window = (slice(max(top, 0), top + 25), slice(max(left, 0), left + 25))
        a[window] = disc(x - max(left, 0), y - max(top, 0), radius, a[window].shape)
        image = image + a * (level - image)
    return image


def grid(seed=None, jitter=1.0):
    """(20, 2) row by row, about the middle, each off its node by a known fraction of a pixel."""
    x = (np.arange(COLUMNS) - (COLUMNS - 1) / 2) * PITCH_X + WIDTH / 2
    y = (np.arange(ROWS) - (ROWS - 1) / 2) * PITCH_Y + HEIGHT / 2
    nodes = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    return nodes if seed is None else nodes + np.random.default_rng(seed).uniform(-jitter, jitter, nodes.shape)


def texture(seed, low, high, size=3.0, shape=(HEIGHT, WIDTH)):
    t = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=shape), size)
    return low + (high - low) * (t - t.min()) / np.ptp(t)


def errors(true, found):
    """Distance from each true centre to the found one nearest to it, px."""
    return np.linalg.norm(true[:, None] - found.centres, axis=2).min(axis=1)


# -- Finding markers -------------------------------------------------------------------------------------------------
def test_centres_are_sub_pixel_and_a_pixel_s_middle_is_at_one_half():
    true = grid(seed=1)
    found = find(draw(true))
    assert len(found) == 20
    assert errors(true, found).max() < 0.02  # 0.01 of the drawing, and the weights that the plane's fit leaves
    one = np.zeros((41, 61))
    one[20:25, 30:35] = 1.0  # rows 20..24: the middle is 22.5
    assert find(one).centres == pytest.approx(np.array([[32.5, 22.5]]), abs=1e-9)


def test_noise_moves_centres_as_photon_statistics_say():
    noise, excess = 4.0, BRIGHT - DARK
    off = []
    for seed in range(6):
        true = grid(seed)
        found = find(draw(true) + np.random.default_rng(100 + seed).normal(0, noise, (HEIGHT, WIDTH)))
        assert len(found) == 20
        off.append(errors(true, found))
    # sum of (x noise)^2 over the disc / (area excess)^2 = (noise / excess)^2 / (4 pi) per axis; the skirt adds, its cut
    # takes
    expected = np.sqrt(2 / (4 * np.pi)) * noise / excess
    assert 0.6 * expected < np.sqrt(np.mean(np.square(off))) < 2 * expected


def test_blur_leaves_centres_and_areas():
    true = grid(seed=2)
    found = find(ndimage.gaussian_filter(draw(true), 1.5))
    assert len(found) == 20
    assert (
        errors(true, found).max() < 0.05
    )  # symmetric blur moves nothing; what is cut at the skirt's end is 2 % of the light
    # +- one pixel of outline in a radius of four: pixels count as a whole here
    assert np.median(found.areas) == pytest.approx(np.pi * RADIUS**2, rel=0.15)


def test_a_lamp_on_one_side_and_a_sloping_background_lose_no_marker():
    true, slope = grid(seed=3), 0.2  # DN per px
    excess = 20 + 80 * (true[:, 0].max() - true[:, 0]) / np.ptp(true[:, 0])  # 5 : 1 from left to right
    behind = DARK + slope * np.arange(WIDTH)
    image = draw(true, bright=DARK + slope * true[:, 0] + excess, behind=behind)
    found = find(image)
    assert len(found) == 20
    # opaque discs on a slope g are found g r^2 / (4 excess) downhill: 0.044 px for the dimmest; 0.02 as on an even
    # ground
    assert np.all(errors(true, found) < slope * RADIUS**2 / (4 * excess) + 0.02)


def test_a_background_brighter_than_the_markers_is_taken_off_where_it_is_wide():
    true = grid(seed=3)
    dome = 300 * np.exp(-((np.arange(WIDTH)[None] - 50) ** 2 + (np.arange(HEIGHT)[:, None] - 40) ** 2) / (2 * 45**2))
    image = draw(true, behind=0.0) + dome  # clear markers: their light adds
    found = find(image)
    assert len(found) == 20
    assert errors(true, found).max() < 0.03  # a plane is fitted; the dome's curvature is even about each marker


def test_a_close_neighbour_pulls_neither_centre():
    true = np.array([(70.3, 60.6), (70.3 + 3 * RADIUS, 61.2)])  # in the ring that the surround is taken from
    assert errors(true, find(draw(true))).max() < 0.02  # as alone


def test_dimmer_texture_neither_hides_markers_nor_makes_any():
    true = grid(seed=4)
    image = draw(true, behind=texture(5, 10, 60)) + np.random.default_rng(6).normal(0, 2, (HEIGHT, WIDTH))
    found = find(image)
    assert len(found) == 20
    assert errors(true, found).max() < 0.3  # the texture in the pixels of the rim: 25 of 90 DN over a width of 1 px


def test_perspective_makes_ellipses_whose_centroids_are_found():
    tilt = np.array([[1.0, 0.08, 0.0], [0.0, 1.0, 0.0], [0.0018, 0.0012, 1.0]])  # about the middle: 1.7 : 1 in size
    true, image = [], np.full((HEIGHT, WIDTH), DARK)
    for x, y in grid() - [WIDTH / 2, HEIGHT / 2]:

        def inside(u, v, x=x, y=y):
            p = np.tensordot(np.linalg.inv(tilt), np.stack(np.broadcast_arrays(u - WIDTH / 2, v - HEIGHT / 2, 1.0)), 1)
            return np.hypot(p[0] / p[2] - x, p[1] / p[2] - y) < RADIUS

        u, v, w = tilt @ (x, y, 1.0)
        left, top = int(u / w + WIDTH / 2) - 8, int(v / w + HEIGHT / 2) - 8
        a = cover(lambda s, t: inside(s + left, t + top), (17, 17))
        image[top : top + 17, left : left + 17] += (BRIGHT - DARK) * a
        rows, columns = np.indices(a.shape) + 0.5
        true.append([left + (a * columns).sum() / a.sum(), top + (a * rows).sum() / a.sum()])
    true, found = np.array(true), find(image)
    assert len(found) == 20
    assert errors(true, found).max() < 0.03  # of the drawing (0.01) and of smaller discs than elsewhere
    assert np.linalg.norm(found.centres[grid_order(found)] - true, axis=1).max() < 0.03


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((60, 80)),
        np.full((60, 80, 3), 7, np.uint8),
        np.tile(np.arange(80.0), (60, 1)),
        np.random.default_rng(0).normal(20, 3, (60, 80)),
    ],
    ids=["black", "grey", "ramp", "noise"],
)
def test_an_image_without_markers_has_none(image):
    found = find(image, count=20)
    assert len(find(image, detectable=0, roundness=0)) == 0  # no candidate, before any is weighed
    assert len(found) == 0 and found.centres.shape == (0, 2) and found.score.shape == (0,)


def test_what_is_cut_long_wide_or_one_pixel_is_no_marker():
    image = draw([(80.3, 60.7), (1.0, 30.2), (158.5, 90.1)])  # one whole, two cut by the border
    image[20:23, 40:60] = BRIGHT  # 20 : 3 long
    image[75:115, 20:60] = BRIGHT  # wider than a fifth of the height, 24 px
    image[30, 120] = 40 * BRIGHT  # a hot pixel
    found = find(image)
    assert len(found) == 1
    assert found.centres[0] == pytest.approx((80.3, 60.7), abs=0.02)
    assert len(find(image, roundness=0.1)) == 2  # and only the roundness kept the long one out


def test_contrast_score_and_count_are_what_they_say():
    noise, black = 2.0, 8.0
    excess = np.full(20, 40.0)
    excess[7], excess[12] = 90.0, 70.0
    true = grid(seed=7)
    image = draw(true, radius=6.0, bright=DARK + excess) + np.random.default_rng(8).normal(0, noise, (HEIGHT, WIDTH))
    best = find(image, count=2, black_level=black)
    assert np.linalg.norm(best.centres - true[[7, 12]], axis=1).max() < 0.1
    inner = (4.5 / 6) ** 2  # of the area: the rim's pixels are brighter than the surround, but by less
    assert np.all(best.contrast < excess[[7, 12]] / (DARK - black) * 1.05)
    assert np.all(best.contrast > excess[[7, 12]] / (DARK - black) * (inner + (1 - inner) / 2))
    # outliers beyond 3 sd are cut from the surround, and its sd is of about 250 pixels: 5 % each
    assert best.score == pytest.approx(best.contrast * (DARK - black) / noise, rel=0.15)
    assert len(find(image)) == 20 and len(find(image, detectable=28)) == 2  # 40 / 2 = 20 is below 28, 35 above


def test_whole_numbers_and_channels_change_nothing_but_their_step():
    true = grid(seed=9)
    image = draw(true)
    found = find(np.repeat(np.round(image).astype(np.uint8)[..., None], 3, axis=2))
    assert len(found) == 20 and errors(true, found).max() < 0.03  # a step of 1 DN in 100 at the rim adds less than 0.01
    assert np.isfinite(found.score).all() and found.score.max() < 100 * 12**0.5


@pytest.mark.parametrize(
    "image, options, said",
    [
        (np.zeros(9), {}, "allowed: real"),
        (np.full((40, 40), np.nan), {}, "1600 pixels are NaN"),
        (np.zeros((40, 40)), {"largest": 60}, "largest marker = 60 px"),
        (np.zeros((40, 40)), {"roundness": 2}, "roundness = 2"),
        (np.zeros((40, 40)), {"count": -1}, "count = -1"),
    ],
)
def test_find_refuses_what_it_cannot_mean(image, options, said):
    with pytest.raises(ValueError, match=said):
        find(image, **options)


# -- Following markers -----------------------------------------------------------------------------------------------
def push(points, strength):
    """A press in the middle: outwards, strongest at one pitch from it, px."""
    away = (points - [WIDTH / 2, HEIGHT / 2]) / PITCH_X
    return strength * away * np.exp((1 - np.sum(away**2, axis=1, keepdims=True)) / 2)


def test_a_displaced_field_is_matched_in_any_order_without_the_lost_and_the_false():
    rest = grid(seed=10)
    true = push(rest, 6.0)
    now = np.delete(rest + true, [3, 12], axis=0)
    now = np.vstack([now, [[5.0, 5.0]]])[np.random.default_rng(11).permutation(19)]  # two lost, one false
    moved = match(rest, now)
    assert np.flatnonzero(np.isnan(moved[:, 0])).tolist() == [3, 12]
    kept = np.delete(np.arange(20), [3, 12])
    assert moved[kept] == pytest.approx(true[kept], abs=1e-12)


def test_the_nearest_is_not_taken_from_whom_it_belongs_to():
    rest, now = np.array([[0.0, 0.0], [10.0, 0.0]]), np.array([[6.0, 0.0], [16.0, 0.0]])  # 6 is nearer to 10 than to 0
    assert match(rest, now, reach=8.0) == pytest.approx(np.full((2, 2), [6.0, 0.0]))
    assert np.isnan(match(rest, now[:1] + 20, reach=8.0)).all()


def test_the_reach_follows_the_spacing_and_ends_where_it_says():
    rest = np.array([[0.0, 0.0], [10.0, 0.0], [40.0, 0.0]])
    moved = match(rest, rest + [[4.4, 0], [0, 4.6], [13.4, 0]])  # reaches 4.5, 4.5 and 13.5
    assert np.isnan(moved[:, 0]).tolist() == [False, True, False]


def test_nothing_matches_nothing_and_one_marker_needs_a_reach():
    assert match(np.zeros((0, 2)), grid()).shape == (0, 2)
    assert np.isnan(match(grid(), find(np.zeros((60, 80))))).all()
    with pytest.raises(ValueError, match="give reach in px"):
        match([[1.0, 2.0]], [[1.0, 2.0]])
    assert match([[1.0, 2.0]], [[1.5, 2.0]], reach=1.0) == pytest.approx(np.array([[0.5, 0.0]]))
    with pytest.raises(ValueError, match="reach = 0"):
        match(grid(), grid(), reach=0.0)
    with pytest.raises(ValueError, match="leave lost markers out"):
        match(grid(), np.full((3, 2), np.nan))


def test_displacement_reads_two_images_row_by_row():
    rest = grid(seed=12)
    true = push(rest, 5.0)
    shown = np.delete(rest + true, 6, axis=0)  # one is lost
    rng = np.random.default_rng(13)
    images = [draw(p) + rng.normal(0, 2, (HEIGHT, WIDTH)) for p in (rest, shown)]
    places, moved = displacement(*images, grid=(COLUMNS, ROWS))
    assert (
        np.abs(places - rest).max() < 0.08
    )  # five sd of the noise's 0.28 noise / excess = 0.006, and the cut of the skirt
    assert np.flatnonzero(np.isnan(moved[:, 0])).tolist() == [6]
    assert np.nanmax(np.abs(moved - true)) < 0.1
    assert len(displacement(*images)[0]) == 20
    with pytest.raises(ValueError, match="19 markers for 5 columns x 4 rows"):
        displacement(images[1], images[0], grid=(COLUMNS, ROWS))


@pytest.mark.parametrize("turn", [-20, 0, 20])  # deg
@pytest.mark.parametrize("seed", range(4))
def test_grid_order_bears_perspective_turn_and_displacement(turn, seed):
    rng = np.random.default_rng(seed)
    p = grid(seed, jitter=0.2 * PITCH_Y) - [WIDTH / 2, HEIGHT / 2]
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    p = p @ np.array([[c, s], [-s, c]])
    p = p / (1 + p @ [0.002, -0.001])[:, None]  # 1.5 : 1 in size from corner to corner
    shuffle = rng.permutation(20)
    assert shuffle[grid_order(p[shuffle])].tolist() == list(range(20))


def test_grid_order_refuses_rather_than_guesses():
    for wrong in (
        grid()[:, ::-1],
        np.random.default_rng(0).uniform(0, 100, (20, 2)),
        np.zeros((20, 2)),
        np.repeat(np.arange(20.0)[:, None], 2, axis=1),
    ):  # 4 x 5, a cloud, a point, a line
        with pytest.raises(ValueError, match="do not form 5 columns x 4 rows"):
            grid_order(wrong)
    with pytest.raises(ValueError, match="exactly 20"):
        grid_order(grid()[1:])


# -- Area ------------------------------------------------------------------------------------------------------------
def scene(a, thing=100.0, behind=None, noise=0.0, blur=0.0, seed=20):
    """(image with the object, image without), DN: coverage a of the object before a textured room."""
    behind = texture(21, 10, 40) if behind is None else behind
    rng = np.random.default_rng(seed)
    pair = (behind + a * (thing - behind), behind)
    return [(ndimage.gaussian_filter(p, blur) if blur else p) + rng.normal(0, noise, p.shape) for p in pair]


@pytest.mark.parametrize("noise, blur", [(0, 0), (2, 0), (2, 2)])
def test_area_grows_with_the_object_without_steps(noise, blur):
    radius = np.arange(18.0, 19.0, 0.15)
    true = np.array([disc(80.3, 60.2, r).sum() for r in radius])
    found = np.array([area(*scene(disc(80.3, 60.2, r), noise=noise, blur=blur)) for r in radius])
    assert found == pytest.approx(true, rel=0.02)  # a fifth of a pixel all around: the room's texture in the difference
    # 113 px of outline: whole pixels would come in jumps of several; a pixel in parts is off by a tenth, and they
    # average
    assert np.std(found - true) < 2.0


@pytest.mark.parametrize("radius", [2.5, 4.0, 10.0, 45.0, 75.0])
def test_area_holds_from_a_speck_to_a_filled_and_clipped_view(radius):
    a = disc(
        80.3, 60.2, radius
    )  # 75 px: nine tenths of the view, cut by the border; no statistic of the whole image holds
    # a tenth of a pixel all around, 0.2 / radius: the level at the rim is that of the texture within
    assert area(*scene(a, noise=2)) == pytest.approx(a.sum(), rel=0.02 + 0.2 / radius)


def test_area_takes_the_largest_piece_its_holes_and_darker_things_and_colours():
    a, small = disc(100, 60, 20.3), disc(30, 20, 8.0)
    hole = disc(100, 60, 14.0)
    pair = scene(np.maximum(a - hole, small), noise=1)
    assert area(*pair) == pytest.approx(a.sum(), rel=0.02)  # as the outline alone
    dark = scene(a, thing=0.0, behind=np.full((HEIGHT, WIDTH), 60.0), noise=1)
    assert area(*dark) == pytest.approx(a.sum(), rel=0.01)
    grey = np.full((HEIGHT, WIDTH, 3), 50.0)  # differs in hue and not in brightness
    hue = grey + a[..., None] * np.array([20.0, 0.0, -20.0])
    assert area(hue, grey) == pytest.approx(a.sum(), rel=0.01)


def test_area_is_zero_where_nothing_is_and_the_threshold_decides_what_is_something():
    nothing = scene(np.zeros((HEIGHT, WIDTH)), noise=2)
    assert area(*nothing) == 0.0 and area(nothing[0], nothing[0]) == 0.0
    faint = scene(disc(80, 60, 20.0), thing=57.0, behind=np.full((HEIGHT, WIDTH), 50.0), noise=2)  # 7 DN, noise 2.8
    assert area(*faint) == pytest.approx(np.pi * 400, rel=0.1)
    assert area(*faint, threshold=4) == 0.0 and area(*faint, noise=7) == 0.0  # 11 and 10.5 DN


def test_shadows_do_not_win_and_a_threshold_in_dn_keeps_them_off():
    a, beside, touching = disc(110, 60, 15.3), disc(40, 60, 35.0), disc(75, 60, 35.0)
    room = texture(23, 60, 70)
    wide = [
        room * (1 - 0.15 * beside) * (1 - a) + 150 * a,
        room,
    ]  # a shadow of 10 DN, five times as large as the object
    assert area(*wide) == pytest.approx(a.sum(), rel=0.01)
    wide = [room * (1 - 0.15 * touching) * (1 - a) + 150 * a, room]
    assert area(*wide) > 3 * a.sum()  # what `falls short` says
    assert area(*wide, threshold=20, noise=1) == pytest.approx(
        a.sum(), rel=0.03
    )  # 10 of 85 DN in half of the rim's pixels


@pytest.mark.parametrize("x, radius", [(80.3, 25.0), (78.0, 30.0), (86.0, 28.0)])
def test_markers_before_an_object_are_bridged(x, radius):
    a, markers = disc(x, 60.2, radius), draw(grid(), behind=0.0)
    hidden = find(markers).mask(markers.shape)
    view, room = (np.where(markers > 0, markers, p) for p in scene(a, noise=1))
    depth = np.where(markers > 0, 20.0, 30 * a + 150 * (1 - a))  # nearer than the object
    # each of up to six markers on the rim hides 120 px of which a cut by a straight line is wrong by its sagitta, some
    # 3 px
    for found in (area(view, room, hidden=hidden), area(depth, threshold=60, hidden=hidden)):
        assert found == pytest.approx(a.sum(), rel=0.025)
    alone = np.where(markers > 0, 20.0, 150.0)
    assert (
        area(alone, threshold=60, hidden=hidden) == 0.0 and area(alone, threshold=60) > 40
    )  # a marker passes for an object
    with pytest.raises(ValueError, match="see Markers.mask"):
        area(view, room, hidden=hidden[1:])


def test_area_of_a_depth_map_counts_mixed_pixels_by_their_depth():
    a = disc(70.4, 55.1, 14.7)
    wall = np.linspace(100, 180, WIDTH)[None] + np.zeros((HEIGHT, 1))
    depth = 30 * a + wall * (1 - a)
    depth -= 20 * disc(140, 20, 6.0)  # nearer than the wall there, but not than the threshold
    depth = np.minimum(depth, np.where(disc(93, 55, 6.0) > 0, 30.0, np.inf))  # 2 px beside it, another thing
    assert area(depth, threshold=60) == pytest.approx(
        a.sum(), rel=0.007
    )  # the wall: 0.5 mm/px over 3 px of rim, of 100 mm
    slope = np.where(np.abs(np.arange(HEIGHT)[:, None] - 60) < 25, np.linspace(20, 100, WIDTH), 200.0)
    assert area(slope, threshold=60) == pytest.approx(
        (slope < 60).sum(), rel=0.005
    )  # its end without a jump: 0.3 px along 49
    assert area(np.full((HEIGHT, WIDTH), 200.0), threshold=60) == 0.0
    assert area(np.full((HEIGHT, WIDTH), 20.0), threshold=60) == HEIGHT * WIDTH
    full = scene(np.ones((HEIGHT, WIDTH)), thing=texture(22, 60, 140))
    assert area(*full) == HEIGHT * WIDTH  # no rim along the border of the view
    empty = np.where(
        a > 0.5, np.linspace(30, 55, WIDTH), np.inf
    )  # a tilted thing, nothing behind: whole pixels are all there is
    assert area(empty, threshold=60) == pytest.approx((a > 0.5).sum(), abs=1e-6)


@pytest.mark.parametrize(
    "arguments, said",
    [
        ((np.zeros((9, 9)),), "threshold in mm"),
        ((np.zeros((9, 9, 3)), None, 5.0), "threshold in mm"),
        ((np.zeros((9, 9)), np.zeros((9, 8))), "the same shape"),
        ((np.zeros((9, 9)), None, -1.0), "threshold = -1"),
        ((np.full((9, 9), np.nan), np.zeros((9, 9))), "81 values are NaN"),
    ],
)
def test_area_refuses_what_it_cannot_mean(arguments, said):
    with pytest.raises(ValueError, match=said):
        area(*arguments)


# -- Metric ----------------------------------------------------------------------------------------------------------
DISTANCES = np.arange(60.0, 9.0, -1.0)  # mm from the skin, as in IV.A.3
CAMERA = 25.0  # mm, from the camera to the skin's outer face
SIZES = (20, 30, 40)  # mm


def view(fov):
    """Half sizes of a 4:3 view at 1 mm, of a horizontal field of view in deg."""
    return np.tan(np.radians(fov / 2)), 0.75 * np.tan(np.radians(fov / 2))


def standing(diameter, d, fov):
    """Share of a pinhole's view that a disc at distance d, centred, covers: the closed form of a circle cut by a
    rectangle."""
    w, h = view(fov)
    r = diameter / 2 / (CAMERA + d)

    def quarter(x):  # integral of sqrt(r^2 - x^2) from 0
        x = np.minimum(x, r)
        return (x * np.sqrt(r**2 - x**2) + r**2 * np.arcsin(x / r)) / 2

    flat = np.sqrt(np.maximum(r**2 - h**2, 0.0))  # up to here the top is cut
    flat = np.minimum(flat, w)
    return (flat * np.minimum(h, r) * (r > h) + quarter(np.minimum(w, r)) - quarter(flat)) / (w * h)


def lying(diameter, d, fov):
    """The same of a long cylinder across the view: its outline are the two planes through the pinhole that touch it."""
    near = CAMERA + d
    return np.minimum(diameter / 2 / np.sqrt(near * (near + diameter)) / view(fov)[1], 1.0)


def curves(share, form, fov=120.0, initial=30.0, pixels=640 * 480):
    k = int(np.flatnonzero(initial == DISTANCES)[0])
    px = {size: share(size, DISTANCES, fov) * pixels for size in SIZES}
    return {size: metric(px[size], px[size][k], px[20][k], pixels, form) for size in SIZES}


def test_the_analytic_area_is_that_of_a_drawn_disc_in_and_beyond_the_view():
    for diameter, fov in ((20, 120.0), (40, 60.0), (60, 60.0)):
        w, _ = view(fov)
        radius = diameter / 2 / (CAMERA + 10) / w * WIDTH / 2
        drawn = disc(WIDTH / 2, HEIGHT / 2, radius).mean()
        assert standing(diameter, 10.0, fov) == pytest.approx(drawn, rel=2e-3)  # samples of an eighth of a pixel


def test_the_consistent_form_makes_standing_cylinders_share_one_curve_and_the_printed_form_does_not():
    r = curves(standing, "consistent")
    for size in SIZES:
        assert r[size] == pytest.approx(r[20], rel=1e-12)  # areas go as (D / z)^2, and D^2 cancels
    assert reliable_range(DISTANCES, r, tolerance=1e-9) == 60.0
    printed = curves(standing, "printed")
    for size in SIZES:
        assert printed[size] == pytest.approx(printed[20] * (size / 20) ** 4, rel=1e-12)
    assert np.isnan(reliable_range(DISTANCES, printed, tolerance=0.5))


def test_lying_cylinders_share_a_curve_to_a_few_per_cent_in_the_consistent_form_only():
    r = curves(lying, "consistent")
    apart = np.abs(r[40] / r[20] - 1)
    assert (
        0.03 < apart.max() < 0.04
    )  # the outline is not that of a flat strip: sqrt((z + 20) / (z + 40)) changes with z
    assert apart[DISTANCES == 30] == pytest.approx(0, abs=1e-12)
    printed = curves(lying, "printed")
    assert (printed[40] / printed[20]).min() > 3


def test_only_the_consistent_form_stops_a_hand_where_the_paper_reports():
    """Fig. 5b: at the reference's r of 10 mm the hand stood 11.5 mm before the 30 mm cylinder."""
    stops = {}
    for form in ("consistent", "printed"):
        r = curves(standing, form)
        stops[form] = distance(r[20][-1], r[30], DISTANCES)
    assert stops["consistent"] == pytest.approx(10.0, abs=1e-6)
    assert stops["printed"] == pytest.approx(35 * 1.5**2 - 25, abs=0.01)  # (D/D')^4 = (z/z')^2


def test_an_object_that_overfills_the_view_falls_below_the_curve_in_either_form():
    r = curves(standing, "consistent", fov=60.0)
    assert r[40][-1] < 0.9 * r[20][-1] and r[40][0] == pytest.approx(r[20][0], rel=1e-12)
    assert np.isnan(reliable_range(DISTANCES, r, tolerance=0.1))  # it is the nearest where they part


def test_metric_is_a_share_of_the_image_and_refuses_other_forms():
    assert metric(300.0, 200.0, 100.0, 1000) == pytest.approx(0.15)
    assert metric(300.0, 200.0, 100.0, 1000, "printed") == pytest.approx(0.6)
    fine, coarse = curves(standing, "consistent"), curves(standing, "consistent", pixels=320 * 240)
    assert fine[40] == pytest.approx(coarse[40], rel=1e-12)
    with pytest.raises(UnknownKey, match="did you mean 'printed'"):
        metric(1.0, 1.0, 1.0, 1, "print")
    with pytest.raises(ValueError, match="initial area = 0 px"):
        metric(1.0, 0.0, 1.0, 1)
    with pytest.raises(ValueError, match="smallest -1 px"):
        metric(np.array([2.0, -1.0]), 1.0, 1.0, 1)


def test_distance_reads_a_pinhole_s_curve_off_four_nodes_and_nothing_beyond_it():
    nodes = np.array([30.0, 10.0, 60.0, 45.0])  # in any order

    def r(d):
        return 40.0 / (CAMERA + d) ** 2

    d = np.array([[10.0, 17.3], [41.9, 60.0]])
    assert distance(r(d), r(nodes), nodes) == pytest.approx(d, abs=1e-6)  # d is linear in r^-1/2; the ends as rounded
    assert np.isnan(distance(np.array([r(9.9), r(60.1), 0.0, -1.0, np.nan, np.inf]), r(nodes), nodes)).all()
    assert distance(r(20.0), r(nodes), nodes) == pytest.approx(20.0, abs=1e-6)
    assert distance(r(10.0) * (1 + 1e-12), r(nodes), nodes) == 10.0  # rounded elsewhere


def test_distance_between_nodes_is_monotone_on_a_rough_curve():
    d, r = np.array([10.0, 20, 30, 40, 60]), np.array([0.3, 0.29, 0.1, 0.09, 0.01])
    read = distance(np.linspace(0.3, 0.01, 400), r, d)
    assert np.all(np.diff(read) > 0) and read[[0, -1]] == pytest.approx([10, 60])


@pytest.mark.parametrize(
    "r, d, said",
    [
        ([0.3, 0.1, 0.2], [10, 20, 30], "r = 0.1 at 20 mm and 0.2 at 30 mm"),
        ([0.3, 0.3], [10, 20], "falls strictly"),
        ([0.3, 0.2], [10, 10], "average repeats"),
        ([0.3], [10], "n >= 2"),
        ([0.3, 0.0], [10, 20], "r above 0"),
    ],
)
def test_distance_refuses_curves_that_give_one_r_two_distances(r, d, said):
    with pytest.raises(ValueError, match=said):
        distance(0.2, np.array(r), np.array(d))


def test_reliable_range_ends_where_the_curves_part():
    d = np.linspace(60, 10, 11)
    r = {"a": np.ones(11), "b": 1 + 0.01 * np.maximum(d - 30, 0)}
    # 2 x / (2 + x) = 0.1 at x = 0.2 / 1.9: 40.5 mm; straight between 40 and 45 mm
    assert reliable_range(d, r, 0.1) == pytest.approx(30 + 20 / 1.9, abs=0.05)
    assert reliable_range(d, r, 0.3) == 60.0
    r["c"] = np.where(d == 20, 5.0, 1.0)  # parts once near and agrees again: what lies beyond is not reliable
    assert 15 <= reliable_range(d, r, 0.1) < 20
    assert np.isnan(reliable_range(d, {"a": r["a"], "b": 2 * r["a"]}))
    with pytest.raises(ValueError, match="1 objects"):
        reliable_range(d, {"a": r["a"]})
    with pytest.raises(ValueError, match="not of that shape: b"):
        reliable_range(d, {"a": r["a"], "b": np.ones(3)})
