"""The integrator `tactile` against stock `path` and `volpath`, pixel by pixel, and the prediction LED by LED against
both.

Two unbiased renders of a scene differ by noise alone. Each pixel gets Welch's t from the means of independent renders;
the smallest p-value must pass after Sidak's correction for the number of pixels. Seeds are fixed, so the outcome is
too."""

from __future__ import annotations

import numpy as np
import pytest

from optics.proof.makers import white

SEEDS = 12  # independent renders: their scatter is the variance
SAMPLES = 32  # per pixel and render: enough for a mean to be nearly normal also at the rim of a shadow
SIGNIFICANCE = 0.01  # of the whole image, after Sidak
MONO, SPECTRAL = "llvm_ad_mono_polarized", "llvm_ad_spectral_polarized"
BOTH = pytest.mark.parametrize("variant", [MONO, SPECTRAL], indirect=True)


def renders(scene, integrator, seeds=SEEDS, spp=SAMPLES, first=0):
    """(seeds, H, W, C) independent renders by an integrator given as a dictionary."""
    import mitsuba as mi

    made = mi.load_dict(integrator)
    return np.array([np.array(mi.render(scene, integrator=made, spp=spp, seed=first + k)) for k in range(seeds)], float)


def least_p(a, b):
    """The smallest p-value over the pixels after Sidak's correction, and the p-value of the whole images' means."""
    a, b = (x.mean(-1) if x.shape[-1] <= 4 else x for x in (a, b))  # channels of a pixel share their noise
    moving = (a.std(0) > 1e-6 * a.max()) | (
        b.std(0) > 1e-6 * b.max()
    )  # others have no noise and must agree by themselves
    still = np.abs(a.mean(0) - b.mean(0))[~moving]
    assert still.size == 0 or still.max() <= 1e-5 * np.abs(b).max(), f"noise-free pixels differ by {still.max():g}"
    p = welch(a[:, moving], b[:, moving])
    whole = welch(a.mean(tuple(range(1, a.ndim))), b.mean(tuple(range(1, b.ndim))))
    return 1 - (1 - p.min()) ** p.size, whole


def welch(a, b):
    """p-values of equal means, (N, ...) each; one of them may be free of noise."""
    from scipy.stats import ttest_ind_from_stats

    one, other = ((x.mean(0), x.std(0, ddof=1), len(x)) for x in (a, b))
    return ttest_ind_from_stats(*one, *other, equal_var=False).pvalue


def agree(scene, ours, stock, **options):
    a, b = renders(scene, ours, **options), renders(scene, stock, first=1000, **options)
    assert b.mean() > 0, "the reference is black: nothing is compared"
    worst, whole = least_p(a, b)
    assert worst > SIGNIFICANCE, f"a pixel differs (p = {worst:.2g}); means {a.mean():.6g} and {b.mean():.6g}"
    assert whole > SIGNIFICANCE / 10, f"the means {a.mean():.6g} and {b.mean():.6g} differ (p = {whole:.2g})"


def sensor(mi, size=(32, 24), distance=8.0, tilt=(0.0, -4.0, 0.0)):
    """A stock camera above the plane z = 0, looking down at the origin from the side."""
    return {
        "type": "perspective",
        "fov": 35,
        "to_world": mi.ScalarTransform4f().look_at([tilt[0], tilt[1], distance], [0, 0, 0], [0, 1, 0]),
        "film": {
            "type": "hdrfilm",
            "width": size[0],
            "height": size[1],
            "rfilter": {"type": "box"},
            "component_format": "float32",
        },
        "sampler": {"type": "independent"},
    }


def floor(mi, reflectance=0.5):
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().scale(6),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": reflectance}},
    }


def lamp(mi, radiance=3.0, half=0.5):
    """A square lamp at height 4, shining down."""
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([1.0, 0.5, 4]).rotate([1, 0, 0], 180).scale(half),
        "emitter": {"type": "area", "radiance": {"type": "uniform", "value": radiance}},
    }


def point(where=(0.5, 0.5, 4.0), intensity=20.0):
    return {"type": "point", "position": list(where), "intensity": {"type": "uniform", "value": intensity}}


def block(mi):
    """A box on the floor: shadows, and a corner that lights itself."""
    return {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().translate([-0.6, 0.2, 0.6]).scale(0.6),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.8}},
    }


def built(**parts):
    import mitsuba as mi

    return mi.load_dict({"type": "scene", **parts}, optimize=False)


def tactile(max_depth, **more):
    return {"type": "tactile", "max_depth": max_depth, "interreflection": 1.0, **more}


@pytest.mark.slow
@BOTH
@pytest.mark.parametrize("max_depth", [2, 4])
def test_diffuse_surfaces_under_an_area_light(variant, max_depth):
    import mitsuba as mi

    scene = built(sensor=sensor(mi), floor=floor(mi), block=block(mi), lamp=lamp(mi))
    agree(scene, tactile(max_depth), {"type": "path", "max_depth": max_depth, "rr_depth": 100})


@pytest.mark.slow
@BOTH
def test_an_absorbing_medium(variant):
    """A clear block of absorbing gel on the floor: exp(-sigma d) along the ray here, tracking in `volpath`."""
    import mitsuba as mi

    gel = {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().translate([0, 0, 1]).scale([1.5, 1.5, 0.9]),
        "bsdf": {"type": "null"},
        "interior": {
            "type": "homogeneous",
            "albedo": {"type": "uniform", "value": 0.0},
            "sigma_t": {"type": "uniform", "value": 0.4},
        },
    }
    scene = built(sensor=sensor(mi), floor=floor(mi), gel=gel, light=point())
    agree(scene, tactile(3), {"type": "volpath", "max_depth": 3, "rr_depth": 100})


@pytest.mark.slow
@BOTH
def test_light_through_a_polarizer(variant):
    """Shadow rays pass a polarizer that is tilted against both the lamp and the camera."""
    import mitsuba as mi

    film = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, 1.5]).rotate([1, 0, 0], 20).scale(1.2),
        "bsdf": {"type": "polarizer", "theta": {"type": "uniform", "value": 30.0}},
    }
    scene = built(sensor=sensor(mi), floor=floor(mi), film=film, light=point())
    agree(scene, tactile(3), {"type": "volpath", "max_depth": 3, "rr_depth": 100})


@pytest.mark.slow
@BOTH
@pytest.mark.parametrize("max_depth", [2, 3])
def test_an_area_light_behind_a_null_surface(variant, max_depth):
    """A ray that runs into the lamp must not lose its last bounce to the sheet before it; a wide lamp is often run
    into."""
    import mitsuba as mi

    sheet = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, 3]).scale(4),
        "bsdf": {"type": "null"},
    }
    scene = built(
        sensor=sensor(mi, distance=2.5), floor=floor(mi), block=block(mi), lamp=lamp(mi, 0.1, half=3), sheet=sheet
    )
    agree(scene, tactile(max_depth), {"type": "volpath", "max_depth": max_depth, "rr_depth": 100})


@pytest.mark.slow
@BOTH
def test_null_surfaces_are_not_there(variant):
    import mitsuba as mi

    sheet = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, 1.5]).scale(1.2),
        "bsdf": {"type": "null"},
    }
    plain = {"floor": floor(mi), "block": block(mi), "light": point()}
    scene = built(sensor=sensor(mi), sheet=sheet, **plain)
    agree(scene, tactile(3), {"type": "volpath", "max_depth": 3, "rr_depth": 100})
    with_sheet, without = renders(scene, tactile(2), 2), renders(built(sensor=sensor(mi), **plain), tactile(2), 2)
    # the same samples with and without the sheet: float32 rounding of the interrupted ray moves some across an edge
    assert np.median(np.abs(with_sheet - without)) <= 1e-5 * without.max()


@pytest.mark.slow
def test_the_comparison_notices_two_percent(mitsuba):
    """What the tests above would say of a medium that absorbs 2 % too much, or of a bounce that is missing."""
    mi = mitsuba
    scene = built(sensor=sensor(mi), floor=floor(mi), block=block(mi), lamp=lamp(mi))
    two, three = (renders(scene, tactile(depth)) for depth in (2, 3))
    assert min(least_p(two, three)) < 1e-6
    assert least_p(two, 1.02 * renders(scene, tactile(2), first=500))[1] < 1e-6


# -- the shipped sensor ----------------------------------------------------------------------------------------------
def gelsight(tmp_path, variant, leds=None, window=True, size=(32, 24), stokes=False, bands=True, **defines):
    """The GelSight-type scene, pressed; with some LEDs only, without its window, without bands, or with Stokes
    channels."""
    import re

    from optics.scene import loader as scene

    text = scene.find("gelsight").read_text(encoding="utf-8")
    if leds is not None:
        text = re.sub(rf'<emitter type="led" id="(?!(?:{"|".join(leds)})")[^"]*">.*?</emitter>', "", text, flags=re.S)
    if not window:
        text = re.sub(r'<shape type="rectangle" id="front">.*?</shape>', "", text, flags=re.S)
    if not bands:
        text = re.sub(r'<string name="bands"[^>]*>', "", text)
    if stokes:
        text = text.replace(
            '<integrator type="tactile" id="integrator">',
            '<integrator type="tactile" id="integrator"><boolean name="stokes" value="true"/>',
        )
    file = tmp_path / "scene.xml"
    file.write_text(text, encoding="utf-8")
    return scene.load(file, {"width": size[0], "height": size[1], "depth": 0.6, **defines}, variant)


def band_images(scene, spp, seeds=4, first=0):
    """(seeds, H, W, 3): S0 of the three bands by `tactile` through mi.render."""
    import mitsuba as mi

    images = np.array([np.array(mi.render(scene.mitsuba, spp=spp, seed=first + k)) for k in range(seeds)], float)
    start = images.shape[-1] - len(scene.integrator.aov_names())
    return images[..., start : start + 3]


@BOTH
@pytest.mark.parametrize("max_depth", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_a_pressed_gelsight(variant, max_depth, tmp_path):
    """Six LEDs, a dent with shadows, a rough membrane; without bands, as `path` draws its wavelengths by Monte
    Carlo."""
    scene = gelsight(tmp_path, variant, window=False, bands=False)
    agree(scene.mitsuba, tactile(max_depth), {"type": "path", "max_depth": max_depth, "rr_depth": 100})


@pytest.mark.slow
@pytest.mark.parametrize("variant", [MONO], indirect=True)
def test_a_window_of_index_1_takes_no_depth_and_no_light(variant, tmp_path):
    """Stock `path` counts the way through the window as a bounce; `tactile` does not."""
    scene = gelsight(tmp_path, variant)
    agree(scene.mitsuba, tactile(2), {"type": "path", "max_depth": 3, "rr_depth": 100})


def test_interreflection_scales_the_second_bounce_alone(mitsuba):
    """Light of an area lamp that a ray runs into after one reflection is direct light: no strength may dim it."""
    mi = mitsuba
    scene = built(sensor=sensor(mi), floor=floor(mi), block=block(mi), lamp=lamp(mi))
    once, twice = renders(scene, tactile(2)), renders(scene, tactile(3))
    none, half = (renders(scene, tactile(3, interreflection=s), first=500) for s in (0.0, 0.5))
    assert min(least_p(none, once)) > SIGNIFICANCE / 10
    assert min(least_p(half, (once + twice) / 2)) > SIGNIFICANCE / 10


@pytest.mark.slow
def test_led_by_led_is_what_the_integrator_renders(mitsuba, tmp_path):
    """Renderer.led at four times the resolution, averaged, against mi.render with `tactile`, per band."""
    from optics.light.renderer import Renderer

    fine = gelsight(tmp_path, SPECTRAL, leds=["led_2"], size=(160, 120))
    values = fine.values()
    led = Renderer(fine).led(values, "led_2").radiance.reshape(30, 4, 40, 4, 3).mean((1, 3))
    whole = gelsight(tmp_path, SPECTRAL, leds=["led_2"], size=(40, 30), stokes=True)
    images = band_images(whole, spp=256)
    error, noise = np.abs(images.mean(0) - led), images.std(0, ddof=1) / 2
    # away from rims the only difference is where in the pixel the samples lie: 0.1 % of the brightest pixel bounds it;
    # at rims both are finite samples of the shadow's edge, 16 x 16 of the regular grid against 1024 at random
    assert (error <= 5 * noise + 1e-3 * led.max()).all(), (error - 5 * noise).max() / led.max()
    assert abs(images.mean() / led.mean() - 1) < 5e-4  # over all pixels these average out


@pytest.mark.slow
def test_all_leds_and_two_bounces_are_what_the_integrator_renders(mitsuba, tmp_path):
    """The prediction's linear image (six LEDs, powers, interreflection, absorption) against mi.render with
    `tactile`."""
    from optics.light.renderer import Renderer

    fine = gelsight(tmp_path, SPECTRAL, size=(160, 120))
    powers = {f"led_{k}.power": 0.4 + 0.1 * k for k in range(1, 7)}
    values = {
        **fine.values(),
        **powers,
        "membrane.rho_r": 0.9,
        "membrane.rho_b": 0.3,
        "integrator.interreflection": 1.0,
        "gel.absorption": 0.05,
    }
    renderer = Renderer(fine)

    def ours(image):
        total = sum(renderer.powers(values, n) * image(values, n) for n in fine.leds)
        return total.reshape(30, 4, 40, 4, -1).mean((1, 3))

    direct = ours(lambda v, n: renderer.led(v, n).radiance)
    second = np.array([ours(lambda v, n: renderer.bounced(v, n, seed)).mean() for seed in range(4)])
    small = gelsight(tmp_path, SPECTRAL, size=(40, 30), stokes=True)
    small.set(values)
    once = band_images(small, spp=512, seeds=6)
    small.integrator.max_depth = 3
    twice = band_images(small, spp=512, seeds=6)
    noise = once.std(0, ddof=1) / np.sqrt(6)
    over = np.abs(once.mean(0) - direct) - 5 * noise
    # 0.1 %: where in a pixel the samples lie, as above
    assert over.max() <= 1e-3 * direct.max(), f"{over.max() / direct.max():.2g} of the brightest pixel beyond the noise"
    # the second bounce is 0.1 % of the light; both means have errors of about 1 %, found from their seeds
    more = twice.mean((1, 2, 3)) - once.mean((1, 2, 3))
    error = np.hypot(more.std(ddof=1) / np.sqrt(len(more)), second.std(ddof=1) / np.sqrt(len(second)))
    assert error < 0.02 * more.mean()
    assert second.mean() == pytest.approx(more.mean(), abs=4 * error)


@pytest.mark.slow
def test_second_directions_leave_no_common_error(mitsuba, tmp_path):
    """What the directions of one seed miss is noise of single cells: the mean over the face misses nearly nothing, and
    single cells miss less than with directions by the surface's law alone."""
    from optics.light.renderer import Renderer

    scene = gelsight(tmp_path, SPECTRAL, size=(80, 60))
    renderer = Renderer(scene)
    values = {**scene.values(), "led_1.power": 1.0}
    scatter = {}
    for grazing in (True, False):
        renderer.grazing = grazing
        renderer._plain.clear()
        images = np.array([renderer.bounced(values, "led_1", seed)[..., 0] for seed in range(8)])
        scatter[grazing] = images.std(0, ddof=1).mean()
        if grazing:  # of 30 x 40 cells, half are well lit
            assert images.mean((1, 2)).std(ddof=1) < 3 * scatter[True] / np.sqrt(600)
    assert scatter[True] < 0.5 * scatter[False]


EFFECTS = {
    "gel.absorption": 0.05,
    "gel.haze": 0.03,
    "gel.height_loss": 0.2,
    "membrane.ambient": 2e-3,
    "membrane.specular": 0.1,
}


@pytest.mark.slow
@pytest.mark.parametrize("key", EFFECTS)
def test_effects_of_light_are_in_both_renders(mitsuba, tmp_path, key):
    """What an effect changes, LED by LED and by mi.render: the same in every pixel."""
    from optics.light.renderer import Renderer

    scene = gelsight(tmp_path, SPECTRAL, leds=["led_2"], stokes=True, size=(40, 30))
    assert key in scene.parameters
    values, renderer = scene.values(), Renderer(scene)

    def both(strength):
        now = {**values, key: strength}
        led = renderer.led(now, "led_2").radiance + renderer.ambient(now)
        scene.set(now)
        return led, band_images(scene, spp=64)

    (led_0, whole_0), (led_1, whole_1) = both(values[key]), both(EFFECTS[key])
    change, expected = whole_1.mean(0) - whole_0.mean(0), led_1 - led_0  # same seeds: same places in the pixels
    assert np.abs(expected).max() > 0.005 * led_0.max()
    # 8 % of the largest change, met at the rims of shadows, where both are samples of a pixel; all pixels together: 0.5
    # %
    assert np.abs(change - expected).max() <= 0.08 * np.abs(expected).max()
    assert change.sum() == pytest.approx(expected.sum(), rel=0.005)


@pytest.mark.slow
def test_bands_are_the_monochrome_renders_of_stock_path(mitsuba, tmp_path):
    """One spectral render with bands is three mono renders by `path`, each with the band's reflectance."""
    from optics.scene.mitsuba_parts import use_variant

    rho = (0.8, 0.5, 0.25)
    scene = gelsight(tmp_path, SPECTRAL, window=False, stokes=True)
    scene.set({"membrane.rho_r": rho[0], "membrane.rho_g": rho[1], "membrane.rho_b": rho[2]})
    ours = band_images(scene, SAMPLES, SEEDS)
    try:
        for band, value in enumerate(rho):
            grey = gelsight(tmp_path, MONO, window=False)
            grey.set({"membrane.rho_r": value})
            stock = renders(grey.mitsuba, {"type": "path", "max_depth": 2, "rr_depth": 100}, first=1000 * (band + 1))
            worst, whole = least_p(ours[..., band : band + 1], stock)
            assert worst > SIGNIFICANCE / 3 and whole > SIGNIFICANCE / 10, f"band {band}"
    finally:
        use_variant()


def test_a_mono_variant_refuses_three_bands(mitsuba, tmp_path):
    """It would render the first band three times."""
    from optics.errors import BadScene
    from optics.light.renderer import Renderer
    from optics.scene.mitsuba_parts import use_variant

    try:
        with pytest.raises(BadScene, match="3 bands.*carries 1"):
            Renderer(gelsight(tmp_path, MONO))
    finally:
        use_variant()


@pytest.mark.slow
def test_bands_bring_no_spectral_noise(mitsuba, tmp_path):
    """A narrow LED: with bands the only noise is where in the pixel a sample falls; wavelengths by Monte Carlo mostly
    miss it."""
    narrow = {"led_1.wavelength": 540.0, "led_1.fwhm": 30.0}
    steady = gelsight(tmp_path, SPECTRAL, leds=["led_1"], stokes=True, size=(64, 48))
    steady.set({**narrow, "gel.press_depth": 0.0})
    images = band_images(steady, spp=4, seeds=8)[:, 16:32, 16:48, 1]
    quiet = float((images.std(0) / images.mean(0)).mean())
    drawn = gelsight(tmp_path, SPECTRAL, leds=["led_1"], window=False, bands=False, size=(64, 48))
    drawn.set({**narrow, "gel.press_depth": 0.0})
    images = renders(drawn.mitsuba, tactile(2), seeds=8, spp=4)[:, 16:32, 16:48, 1]
    loud = float((images.std(0) / np.abs(images.mean(0))).mean())
    assert quiet < 0.01  # the shading varies by some percent within one 0.28 mm pixel; four samples halve its scatter
    assert loud > 20 * quiet


# -- channels as integrals over the wavelength -----------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("max_depth", [2, 3])
def test_integrals_over_the_wavelength(mitsuba, tmp_path, max_depth):
    """A white LED, two paints, a camera's three curves: 24 Gauss nodes, whose error is told as 2.8e-5, against
    wavelengths by Monte Carlo."""
    scene, ours = white.by_nodes(tmp_path, max_depth)
    assert scene.integral.error < 5e-5  # a tenth of the scatter of the means of whole images, which the Z-test sees
    stock = white.by_wavelengths(scene.integral.unit, max_depth)
    a, b = np.array([ours(k) for k in range(SEEDS)]), np.array([stock(128, 1000 + k) for k in range(SEEDS)])
    flat = [x.reshape(*x.shape[:2], -1) for x in (a, b)]  # each channel for itself
    worst, _ = least_p(*flat)
    assert worst > SIGNIFICANCE, f"a pixel differs (p = {worst:.2g})"
    for channel in range(3):
        _, whole = least_p(*(x[..., channel : channel + 1] for x in (a, b)))
        assert whole > SIGNIFICANCE / 10, f"channel {channel}: the means differ (p = {whole:.2g})"
    assert least_p(flat[0] * 1.02, flat[1])[1] < 1e-6  # two percent would be noticed


@pytest.mark.slow
def test_integrals_take_less_time_than_wavelengths_by_monte_carlo(mitsuba):
    """Time to the same error. The limit is far from the factor of some thousands, because other processes may run."""
    from optics.proof.speed import spectral_noise

    ours, stock, error, level = spectral_noise(2, passes=4)
    assert error < 0.02 * level  # the images are of one scene
    assert stock > 10 * ours


# -- polarization ----------------------------------------------------------------------------------------------------
def polarizer(mi, angle, height, tilt=0.0):
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, height]).rotate([1, 0, 0], tilt).scale(3),
        "bsdf": {"type": "polarizer", "theta": {"type": "uniform", "value": float(angle)}},
    }


def panel(mi):
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().scale(5),
        "emitter": {"type": "area", "radiance": {"type": "uniform", "value": 2.0}},
    }


def stokes(scene, spp=4):
    """(H, W, 4) S0..S3 of the first lane by `tactile`."""
    import mitsuba as mi

    image = np.array(mi.render(scene, integrator=mi.load_dict(tactile(3, stokes=True, bands="550")), spp=spp), float)
    lanes = (image.shape[-1] - {1: 1}.get(image.shape[-1] % 4, 3)) // 4
    return image[..., image.shape[-1] - 4 * lanes :: lanes]


@BOTH
@pytest.mark.parametrize("angle", [0.0, 25.0, 60.0, 90.0])
def test_malus(variant, angle):
    """Unpolarized light 2 behind two films: S0 = 2/2 cos^2(angle) on the axis, and fully polarized."""
    import mitsuba as mi

    scene = built(
        sensor=sensor(mi, (3, 3), tilt=(0, 0, 0)),
        panel=panel(mi),
        first=polarizer(mi, 0, 1),
        second=polarizer(mi, angle, 2),
    )
    s = stokes(scene)[1, 1]
    expected = np.cos(np.radians(angle)) ** 2
    # the pixel is 12 deg wide: off the axis the films' projected angle departs by up to tan^2(6 deg)/2 = 0.6 %
    assert s[0] == pytest.approx(expected, rel=0.01, abs=1e-3)
    assert np.hypot(s[1], s[2]) == pytest.approx(s[0], rel=1e-4, abs=1e-4)
    assert abs(s[3]) < 1e-4


@pytest.mark.parametrize("variant", [MONO], indirect=True)
@pytest.mark.parametrize("angle", [0.0, 30.0, 75.0])
def test_stokes_channels_follow_the_stock_convention(variant, angle):
    """Every pixel's S1/S0, S2/S0, S3/S0 behind an oblique film against Mitsuba's `stokes` around `path`."""
    import mitsuba as mi

    scene = built(sensor=sensor(mi, (9, 7)), panel=panel(mi), film=polarizer(mi, angle, 1.5, tilt=15))
    ours = stokes(scene, 256)
    stock = np.array(
        mi.render(
            scene, integrator=mi.load_dict({"type": "stokes", "inner": {"type": "path", "max_depth": 3}}), spp=256
        ),
        float,
    )
    stock = stock[..., stock.shape[-1] - 12 :: 3]
    assert np.abs(stock[..., 0]).min() > 0
    # both vary over a pixel (by up to 0.1) and are sampled at random places: 256 samples leave 0.1/sqrt(12)/16 = 0.002
    assert np.abs(ours[..., 1:] / ours[..., :1] - stock[..., 1:] / stock[..., :1]).max() < 0.01
    assert np.abs(ours[..., 0].mean() / stock[..., 0].mean() - 1) < 1e-3


@pytest.mark.parametrize("variant", [MONO], indirect=True)
def test_metal_polarizes_in_the_stock_frame(variant):
    """A rough, dark conductor lit by a lamp: light that is sampled and light that is hit, each turned into the sensor's
    frame."""
    import mitsuba as mi

    turned = (
        mi.ScalarTransform4f().rotate([1, 2, 0], 12).rotate([0, 0, 1], 40).scale(6)
    )  # its own frame is not the world's
    metal = {
        "type": "rectangle",
        "to_world": turned,
        "bsdf": {"type": "roughconductor", "alpha": 0.4, "eta": 1.5, "k": 0.1},
    }
    scene = built(sensor=sensor(mi, (9, 7), distance=3.0, tilt=(1.0, -5.0, 0.0)), metal=metal, lamp=lamp(mi, half=1.5))
    ours = stokes(scene, 4096)
    stock = np.array(
        mi.render(
            scene, integrator=mi.load_dict({"type": "stokes", "inner": {"type": "path", "max_depth": 3}}), spp=4096
        ),
        float,
    )
    stock = stock[..., stock.shape[-1] - 12 :: 3]
    bright = stock[..., 0] > 0.2 * stock[..., 0].max()
    degree = stock[bright][:, 1:] / stock[bright][:, :1]
    assert np.abs(degree[:, 0]).max() > 0.3 and np.abs(degree[:, 1]).max() > 0.1  # there is something to compare
    # 4096 samples of a relative noise near 0.3 leave 0.5 %
    assert np.abs(ours[bright][:, 1:] / ours[bright][:, :1] - degree).max() < 0.005


def test_a_membrane_depolarizes(mitsuba, tmp_path):
    scene = gelsight(tmp_path, SPECTRAL, stokes=True)
    import mitsuba as mi

    image = np.array(mi.render(scene.mitsuba, spp=4))
    names = scene.integrator.aov_names()
    start = image.shape[-1] - len(names)
    assert np.abs(image[..., start + len(names) // 4 :]).max() == 0
    assert image[..., start].min() > 0


def test_stokes_vectors_turn_with_our_camera(mitsuba):
    """Light polarized along the world's x: horizontal in the image, vertical after a quarter turn, diagonal in
    between."""
    mi = mitsuba

    def behind_film(roll):
        camera = {
            "type": "camera",
            "x_fov": 10.0,
            "roll": roll,
            "to_world": mi.ScalarTransform4f().translate([0, 0, -8]),
            "film": {
                "type": "hdrfilm",
                "width": 3,
                "height": 3,
                "rfilter": {"type": "box"},
                "component_format": "float32",
            },
        }
        film = polarizer(mi, 0, -2)
        s = stokes(
            built(
                sensor=camera,
                panel=panel(mi) | {"to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 180).scale(5)},
                film=film,
            )
        )[1, 1]
        return s[1:3] / s[0]

    # 0.01: the film's axis projected onto a pixel of 3 deg
    assert behind_film(0.0) == pytest.approx([1, 0], abs=0.01)
    assert behind_film(90.0) == pytest.approx([-1, 0], abs=0.01)
    assert behind_film(45.0) == pytest.approx(-behind_film(-45.0), abs=0.01)
    assert abs(behind_film(45.0)[1]) == pytest.approx(1, abs=0.01)


@pytest.mark.slow
def test_painted_edges_are_as_smooth_as_those_of_shapes(mitsuba):
    """The chequers of the finger's wall against an image eight times as fine: within what the samples of a rim resolve
    of a step of 0.4."""
    from optics.light.renderer import Renderer
    from optics.scene import loader as scenes

    def rendered(width):
        scene = scenes.load("vi2tap", {"width": str(width), "height": str(width * 3 // 4)})
        values = {
            **scene.values(),
            **{f"{n}.power": 0.0 for n in scene.lights},
            "analyzer.inserted": 0.0,
            "film.inserted": 0.0,
        }
        return Renderer(scene).radiance(values)[..., 0]

    fine = rendered(384).reshape(36, 8, 48, 8)
    assert np.abs(rendered(48) - fine.mean((1, 3))).max() < 0.05 * fine.max()
    assert fine.std((1, 3)).max() > 0.1 * fine.max()  # there are edges
