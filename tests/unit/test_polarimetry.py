"""Polarimetry says of a matrix what it was made of, and of a ray what the prediction says of it."""

import numpy as np
import pytest

from optics.errors import BadScene, UnknownKey
from optics.light import paths, polarimetry
from optics.light.polarimetry import decompose
from optics.light.renderer import Renderer
from optics.polarization import mueller
from optics.scene import loader as scene

EXACT = 1e-12  # a few operations in double precision on numbers about 1
RETARDANCE = 1e-7  # deg: of arc tangents of these


def axis(angle):
    return np.cos(np.radians(2 * angle)), np.sin(np.radians(2 * angle))


def polarizer(angle, t1=1.0, t2=0.0):
    return mueller.diattenuator(*axis(angle), t1, t2).numpy()


def plate(angle, retardance):
    return mueller.retarder(*(np.radians(retardance) * c for c in axis(angle))).numpy()


def rotation(rng):
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def embedded(block, column=(0, 0, 0)):
    matrix = np.eye(4)
    matrix[1:, 1:], matrix[1:, 0] = block, column
    return matrix


# -- decomposition ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("seed", range(12))
def test_the_factors_of_a_product_come_back(seed):
    rng = np.random.default_rng(seed)
    d = rng.normal(size=3)
    d *= rng.uniform(0.05, 0.98) / np.linalg.norm(d)
    first = polarimetry._diattenuator(d)
    turn = embedded(rotation(rng))
    axes = rotation(rng)
    last = embedded(axes @ np.diag(rng.uniform(0.2, 0.9, 3)) @ axes.T, 0.1 * rng.normal(size=3))
    found = decompose(0.7 * last @ turn @ first)
    for own, made in ((found.diattenuator, first), (found.retarder, turn), (found.depolarizer, last)):
        np.testing.assert_allclose(own, made, atol=1e-10)  # 1 - D^2 = 0.04 divides
    assert found.transmittance == pytest.approx(0.7, rel=EXACT)
    assert found.diattenuation == pytest.approx(np.linalg.norm(d), rel=1e-10)
    assert found.largest + found.smallest == pytest.approx(1.4, rel=EXACT)
    assert found.depolarization == pytest.approx(1 - np.trace(last[1:, 1:]) / 3, abs=1e-10)


@pytest.mark.parametrize("angle", [0, 22.5, 45, 100, 179])
@pytest.mark.parametrize("retardance", [1e-3, 30, 90, 179, 180])
def test_wave_plates(angle, retardance):
    found = decompose(0.9 * plate(angle, retardance))
    assert found.retardance == pytest.approx(retardance, abs=RETARDANCE)
    fast = {angle, angle - 90} if retardance == 180 else {angle}  # fast and slow are one in a half wave
    assert min(abs(found.fast_axis - f) for f in fast) == pytest.approx(0, abs=1e-6)
    assert found.fast_ellipticity == pytest.approx(0, abs=1e-6)
    assert (found.transmittance, found.diattenuation, found.depolarization) == (
        pytest.approx(0.9),
        pytest.approx(0, abs=EXACT),
        pytest.approx(0, abs=1e-9),
    )
    assert np.isnan(found.axis) and found.depolarization_index == pytest.approx(1)


def test_optical_rotation_is_a_retardance_of_circular_light():
    turn = mueller.rotation(*axis(-20)).numpy()  # polarized light leaves turned by 20 deg from x to y
    found = decompose(turn)
    assert found.retardance == pytest.approx(40, abs=RETARDANCE) and abs(found.fast_ellipticity) == pytest.approx(45)
    assert np.isnan(found.fast_axis)


@pytest.mark.parametrize("angle", [0, 45, 135, 170])
def test_polarizers(angle):
    found = decompose(polarizer(angle, 0.8, 0.004))
    assert found.axis == pytest.approx(angle) and found.polarizance_axis == pytest.approx(angle)
    assert (found.largest, found.smallest) == (pytest.approx(0.8), pytest.approx(0.004))
    assert found.diattenuation == pytest.approx(0.796 / 0.804) and found.polarizance == pytest.approx(
        found.diattenuation
    )
    assert found.retardance == pytest.approx(0, abs=1e-5) and found.depolarization == pytest.approx(0, abs=1e-9)
    assert found.realisable > -EXACT
    perfect = decompose(polarizer(angle, 0.8))
    assert (
        perfect.smallest == pytest.approx(0, abs=EXACT) and np.isnan(perfect.retardance) and np.isnan(perfect.fast_axis)
    )


def test_behind_a_perfect_polarizer_the_factors_still_make_the_matrix():
    for whole in (
        polarizer(30) @ plate(10, 70) @ polarizer(80),
        polarizer(0) @ polarizer(90, 1, 1e-3),
        polarizer(0) @ polarizer(45),
        mueller.depolarizer(0.6).numpy() @ polarizer(25),
        plate(0, 180) @ polarizer(45),
    ):
        found = decompose(whole)
        np.testing.assert_allclose(
            whole, found.transmittance * found.depolarizer @ found.retarder @ found.diattenuator, atol=1e-9
        )


def test_depolarizers():
    found = decompose(mueller.depolarizer(0.7, 0.4).numpy())
    assert found.depolarization == pytest.approx(0.4) and found.retardance == pytest.approx(0, abs=1e-6)
    assert found.depolarization_index == pytest.approx(np.sqrt((2 * 0.49 + 0.16) / 3))
    nothing = decompose(mueller.depolarizer(0.0).numpy())
    assert (nothing.depolarization, nothing.depolarization_index) == (1, 0)
    line = decompose(embedded(np.diag([0.5, 0, 0])))  # one axis is left: nothing can be seen to turn
    assert line.retardance == 0 and line.depolarization == pytest.approx(1 - 0.5 / 3)


def test_no_light_and_no_matrix():
    dark = decompose(np.zeros((4, 4)))
    assert dark.transmittance == 0 and np.isnan(dark.retardance)
    for wrong in (np.eye(3), np.full((4, 4), np.nan)):
        with pytest.raises(ValueError, match="allowed: \\(4, 4\\), finite"):
            decompose(wrong)
    assert decompose(np.diag([1, 1, 1, -1.0])).realisable < -0.1  # a mirror of the Poincare sphere is no layer


# -- rays ------------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def scenes(mitsuba):
    return {
        "bench": scene.load("polarizer_bench", {"bands": "620, 540, 460", "width": "5", "height": "5", "x_fov": "8"}),
        "finger": scene.load("vi2tap", {"width": "48", "height": "36", "depth": "1.5", "bands": "650, 580, 520, 460"}),
    }


@pytest.fixture
def bench(scenes):
    """A lamp behind three polarizers and a sample, 5 x 5 px; its values are put back."""
    values = scenes["bench"].values()
    yield scenes["bench"]
    scenes["bench"].set(values)


@pytest.fixture
def finger(scenes):
    """A pressed skin with a film, behind an analyser; its values are put back."""
    values = scenes["finger"].values()
    yield scenes["finger"]
    scenes["finger"].set(values)


SET = {
    "sample.retard_0": 70.0,
    "sample.angle": 25.0,
    "analyzer.angle": 40.0,
    "analyzer.leak": 0.01,
    "middle.angle": 10.0,
}


@pytest.mark.parametrize(
    "values", [SET, {**SET, "analyzer.face": 0.05, "polarizer.face": 0.04}], ids=["clear", "faces"]
)
def test_the_whole_is_what_the_prediction_multiplies(bench, values):
    values = {**bench.values(), **values}
    bands = np.array([620.0, 540.0, 460.0])
    names, matrices, whole = polarimetry.stack(bench, values, 0.5, 4.5, bands)
    assert names == ["analyzer", "middle", "sample", "polarizer"] and matrices.shape == (4, 3, 4, 4)
    path = paths.trace(bench, np.array([0.5]), np.array([4.5]))
    rows = np.stack([np.stack(paths.transmission(bench, path, values, bands, c), -1)[0] for c in range(4)], -2)
    np.testing.assert_allclose(whole, rows, atol=EXACT)
    product = matrices[0] @ matrices[1] @ matrices[2] @ matrices[3]
    apart = np.abs(product - whole).max()
    assert apart < EXACT if values["analyzer.face"] == 0 else 1e-4 < apart < 0.01  # light between faces: 0.05 x 0.04


def test_only_some_layers(bench):
    values = {**bench.values(), **SET}
    names, matrices, whole = polarimetry.stack(bench, values, 2.5, 2.5, [540.0], ["sample", "polarizer"])
    assert names == ["sample", "polarizer"]
    np.testing.assert_allclose(whole, matrices[0] @ matrices[1], atol=EXACT)
    assert decompose(matrices[0, 0]).fast_axis == pytest.approx(25)
    with pytest.raises(UnknownKey, match="did you mean 'sample'"):
        polarimetry.stack(bench, values, 2.5, 2.5, [540.0], ["sampel"])


def test_a_ray_through_a_stressed_skin(finger):
    values = {**finger.values(), "silicone.stress": 0.05, "analyzer.angle": 30.0}
    at = 24.3, 18.2
    ray = polarimetry.follow(finger, values, *at)
    assert ray.names == ["analyzer", "inner_face", "silicone", "film", "outer_face"] and ray.end in ("object", "wall")
    bands = np.array([650.0, 460.0])
    names, matrices, whole = polarimetry.stack(finger, values, *at, bands, ray=ray)
    path = paths.trace(finger, *np.array(at)[:, None])
    rows = np.stack([np.stack(paths.transmission(finger, path, values, bands, c), -1)[0] for c in range(4)], -2)
    np.testing.assert_allclose(whole, rows, atol=EXACT)
    delays = [decompose(m).retardance for m in matrices[names.index("silicone")]]
    assert delays[0] > 0.01 and delays[1] / delays[0] == pytest.approx(650 / 460, rel=1e-6)


def test_places(bench):
    assert polarimetry.pixel(bench, None) == (2.5, 2.5) and polarimetry.pixel(bench, "0, 5") == (0, 5)
    for text in ("5", "a,b", "1,2,3", "6,1", "-1,2", "nan,1"):
        with pytest.raises(ValueError, match="--at .*0,0 \\(top left\\) to 5,5"):
            polarimetry.pixel(bench, text)
    bare = scene.load("polarizer_bench")
    bare.camera = None
    with pytest.raises(BadScene, match="no camera ray"):
        polarimetry.pixel(bare, None)


# -- images ----------------------------------------------------------------------------------------------------------
def test_the_colours_of_angles_close_and_keep_their_lightness():
    angles = np.arange(0, 180, 5.0)
    colours = polarimetry.wheel(angles)
    np.testing.assert_allclose(polarimetry.wheel(angles + 180), colours, atol=1e-9)
    assert colours.min() > 0 and colours.max() < 1  # nothing is clipped
    apart = np.linalg.norm(colours[:, None] - colours[None], axis=-1)
    far = np.abs((angles[:, None] - angles[None] + 90) % 180 - 90) >= 20
    assert apart[far].min() > 0.15 and np.diag(apart, 1).max() < 0.13
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    assert np.ptp(linear @ [0.2126, 0.7152, 0.0722]) < 0.12  # OKLab's lightness is not CIE's luminance, but near it


def test_maps_are_grey_where_nothing_can_be_said():
    stokes = np.zeros((2, 2, 1, 4))
    stokes[0, 0, 0] = 1, 0, 1, 0  # polarized along 45 deg
    stokes[0, 1, 0] = 1, 0, 0, 0  # unpolarized
    stokes[1, 0, 0] = 1e-4, 1e-4, 0, 0  # dark
    degree, angle = polarimetry.map_colours(stokes)
    np.testing.assert_allclose(angle[0, 0, 0], polarimetry.wheel(45.0))
    assert degree[0, 0, 0] == pytest.approx([0.99, 0.91, 0.14], abs=0.01)  # the bright end of viridis
    assert (angle[0, 1] == polarimetry.GREY).all() and (degree[0, 1] != polarimetry.GREY).any()
    assert (degree[1] == polarimetry.GREY).all() and (angle[1] == polarimetry.GREY).all()


# -- readings against a parameter ------------------------------------------------------------------------------------
@pytest.mark.slow
def test_a_spot_is_a_pixel_of_the_image(finger):
    whole, values = Renderer(finger), {**finger.values(), "analyzer.angle": 20.0}
    picture = sum(whole.powers(values, n) * whole.image(values, n) for n in finger.lights) + whole.ambient(values)
    hits = whole.hits(values)
    rim = whole._joint_rim(hits)
    bright = picture.sum(-1) > 0.1 * np.median(picture.sum(-1)[hits.valid])
    smooth, rims = (np.argwhere(bright & where) for where in (~rim, rim))
    for row, column in (*smooth[[0, len(smooth) // 2, -1]], rims[len(rims) // 2], (0, 0)):
        spot = polarimetry.Spot(finger, column, row)
        own = spot.radiance(values)[spot.at]
        # at a rim other finer samples of the same pixel: a share of its brightness
        np.testing.assert_allclose(own, picture[row, column], rtol=0.3 if rim[row, column] else 1e-5, atol=1e-9)


def test_malus_and_the_ratio_of_extinction(bench):
    found = polarimetry.sweep(
        bench, "analyzer.angle", np.linspace(0, 180, 37), (2.5, 2.5), {"analyzer.leak": 0.004, "polarizer.angle": 30}
    )
    curve = found.curves[0]
    turn = np.radians(curve.x - 30)
    expected = (
        255 * 0.4 * (0.8 * np.cos(turn) ** 2 + 0.004 * np.sin(turn) ** 2)
    )  # T1 of the first is halved by unpolarized light
    np.testing.assert_allclose(curve.y, np.repeat(expected[:, None], 3, 1), rtol=1e-6)
    row = found.summary()[0]
    assert row["extinction_ratio"] == pytest.approx(200) and (row["at"], row["dark_at"]) == (30, 120)
    assert found.ideal(curve)[24, 0] == pytest.approx(0, abs=1e-9) and row["from_ideal"] < 0.004
    assert found.channels == ["R", "G", "B"] and len(found.to_csv().splitlines()) == 38


def test_other_parameters_and_their_ends(bench):
    found = polarimetry.sweep(
        bench, "sample.depolarization", [0, 0.5, 1], (2.5, 2.5), {"analyzer.angle": 90}, radiance=True
    )
    np.testing.assert_allclose(
        found.curves[0].y, np.repeat([[0], [0.08], [0.16]], 3, 1), atol=1e-9
    )  # 0.8 x 0.8 / 2 x d / 2
    assert found.ideal(found.curves[0]) is None and found.summary()[0]["extinction_ratio"] == float("inf")
    assert polarimetry.span(bench, "analyzer.angle", None, 90) == (0, 90)
    with pytest.raises(ValueError, match="--from is missing; allowed: 0 to 1"):
        polarimetry.span(bench, "sample.depolarization", None, 1)
    with pytest.raises(UnknownKey, match="did you mean 'analyzer.angle'"):
        polarimetry.span(bench, "analyser.angle", 0, 1)
    with pytest.raises(ValueError, match="is a word"):
        polarimetry.span(bench, "sample.stress_pattern", 0, 1)


@pytest.mark.slow
def test_effects_that_mix_pixels_see_the_whole_image(finger):
    values = {"camera.glare": 0.2, "camera.exposure": 3.0}
    found = polarimetry.sweep(finger, "analyzer.angle", [0.0, 90.0], (24, 18), values)
    from optics.light.rendering import RenderJob

    image = RenderJob(finger).take({**values, "analyzer.angle": 90.0})
    np.testing.assert_allclose(found.curves[0].y[1], image.camera[18, 24], rtol=1e-5)


def test_plots_and_maps_are_images(bench, tmp_path):
    from PIL import Image

    polarimetry.sweep(bench, "analyzer.angle", np.linspace(0, 180, 7), (2.5, 2.5)).plot(tmp_path / "a.png")
    files = tmp_path / "d.png", tmp_path / "e.png"
    polarimetry.write_maps(files, [460.0, 620.0], np.random.default_rng(0).random((6, 8, 2, 4)))
    for file in (tmp_path / "a.png", *files):
        with Image.open(file) as shown:
            assert min(shown.size) > 300 and np.ptp(np.asarray(shown.convert("L"))) > 100
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.png", "d.png", "e.png"]


def test_maps_fade_where_light_does():
    """Pixels of ever less light, all polarized alike: no step of colour between neighbours of nearly the same light."""
    level = np.geomspace(1.0, 1e-4, 200)
    stokes = (level[:, None] * [1.0, 0.6, 0.3, 0.0])[None, :, None, :]
    for colours in polarimetry.map_colours(stokes):
        assert np.abs(np.diff(colours[0, :, 0], axis=0)).max() < 0.1  # a hard limit steps by all of the colour
        np.testing.assert_allclose(colours[0, level > 0.011, 0], np.broadcast_to(colours[0, :1, 0], (98, 3)), atol=1e-6)
        assert (colours[0, level < 1.9e-3] == polarimetry.GREY).all()
