"""The formulas of parts, against numpy in double precision, in the form of their source; those of single plugins are
checks in the plugin files.

The parts compute in float32, whose rounding is 6e-8; tolerances near 1e-5 relative are what a chain of some ten
operations leaves of it. Looser ones say why."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

RNG = np.random.default_rng  # every test seeds its own
CLOSE = 1e-5  # relative: float32 through about ten operations


def unit(v):
    v = np.asarray(v, float)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def cosine(a, b):
    return (a * b).sum(-1)


def close(found, expected, tolerance=CLOSE, floor=0.0):
    """Largest |found - expected| relative to the expected value, or to the largest one where that is smaller than floor
    x it."""
    found, expected = np.asarray(found, float), np.asarray(expected, float)
    scale = np.maximum(np.abs(expected), max(floor, 1e-12) * np.abs(expected).max())
    worst = float((np.abs(found - expected) / scale).max())
    assert worst <= tolerance, f"off by {worst:.2g} relative; allowed: {tolerance:g}"


def angle_form(wi, wo, rho, sigma):
    """(S3) as printed: angles of the local frame, alpha and beta the larger and the smaller one; 1/sr without the
    cosine."""
    theta_r, theta_i = np.arccos(wi[..., 2]), np.arccos(wo[..., 2])
    phi = np.arctan2(wi[..., 1], wi[..., 0]) - np.arctan2(wo[..., 1], wo[..., 0])
    alpha, beta = np.maximum(theta_r, theta_i), np.minimum(theta_r, theta_i)
    a = 1.0 - 0.5 * sigma**2 / (sigma**2 + 0.33)
    b = 0.45 * sigma**2 / (sigma**2 + 0.09)
    return rho / np.pi * (a + b * np.maximum(0, np.cos(phi)) * np.sin(alpha) * np.tan(beta))


def kappa(point, led, axis, power, mu):
    """(S2): s runs from the lit point to the LED, so that (-s).p is the cosine to the axis."""
    s = led - point
    distance = np.linalg.norm(s, axis=-1)
    return power * np.maximum(cosine(-s / distance[..., None], axis), 0) ** mu / distance**2


def hemisphere(rng, count, lowest=0.05):
    """(count, 3) directions uniform in solid angle, with cosines above `lowest`."""
    z = rng.uniform(lowest, 1, count)
    phi = rng.uniform(0, 2 * np.pi, count)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)


# -- the LED ---------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def plugin(mitsuba):
    """Makes one part from its parameters."""
    return lambda **parts: mitsuba.load_dict(parts)


def vectors(mi, v):
    return mi.Vector3f(*np.asarray(v, np.float32).T)


def radiance(mi, led, points, wavelengths=(600.0, 550.0, 500.0, 450.0)):
    """(N, 4) kappa per lane at points."""
    import drjit as dr

    it = dr.zeros(mi.Interaction3f, len(points))
    it.p = mi.Point3f(vectors(mi, points))
    it.wavelengths = dr.zeros(type(it.wavelengths), len(points)) + mi.UnpolarizedSpectrum(*wavelengths)
    to = led.position() - it.p
    distance = dr.norm(to)
    return np.array(led.radiance(it, to / distance, distance) + dr.zeros(mi.UnpolarizedSpectrum, len(points))).T


def test_led_is_s2(mitsuba, plugin):
    rng = RNG(1)
    for _ in range(6):
        where, target = rng.uniform(-12, 12, 3), rng.uniform(-3, 3, 3)
        power, mu = rng.uniform(0.2, 5), rng.uniform(0.3, 12)
        led = plugin(type="led", position=where.tolist(), target=target.tolist(), power=power, mu=mu)
        axis = unit(target - where)
        points = target + rng.uniform(-6, 6, (400, 3))
        points = points[cosine(unit(points - where), axis) > 0.2]  # cos^mu below is rounding of the direction times mu
        # mu up to 12 times the rounding of the cosine
        close(radiance(mitsuba, led, points)[:, 0], kappa(points, where, axis, power, mu), 3 * CLOSE)


def test_led_sends_nothing_backwards(mitsuba, plugin):
    led = plugin(type="led", position=[0.0, 0.0, -5.0], mu=1.2)
    assert (radiance(mitsuba, led, RNG(2).uniform(-5, 5, (50, 3)) * [1, 1, 0.1] + [0, 0, -6]) == 0).all()


def test_led_pan_and_tilt_turn_the_axis_by_their_angle(mitsuba, plugin):
    """pan about the local up axis, tilt about the local side axis; the world's y spans up, or x where the LED shines
    along y."""
    for target, helper in (([0.0, 0.0, 0.0], [0, 1, 0]), ([3.0, 8.0, -5.0], [1, 0, 0]), ([-3.0, 1.0, 2.0], [0, 1, 0])):
        where = np.array([3.0, -7.0, -5.0])
        nominal = unit(np.array(target) - where)
        side = unit(np.cross(helper, nominal))
        up = np.cross(nominal, side)
        for turn, toward in (("pan", side), ("tilt", up)):
            for degrees in (-60.0, 5.0, 40.0):
                led = plugin(type="led", position=where.tolist(), target=target, **{turn: degrees})
                expected = np.cos(np.radians(degrees)) * nominal + np.sin(np.radians(degrees)) * toward
                close(np.array(led.axis()).ravel(), expected, CLOSE, floor=0.1)
        led = plugin(type="led", position=where.tolist(), target=target, pan=10.0, tilt=-20.0)
        both = unit(nominal + np.tan(np.radians(10)) * side + np.tan(np.radians(-20)) * up)
        close(np.array(led.axis()).ravel(), both, CLOSE, floor=0.1)


def test_led_spectrum_is_a_gaussian_of_its_fwhm(mitsuba, plugin):
    led = plugin(type="led", position=[0.0, 0.0, -5.0], wavelength=540.0, fwhm=40.0)
    white = plugin(type="led", position=[0.0, 0.0, -5.0])
    at = (540.0, 560.0, 520.0, 580.0)
    point = np.array([[0.5, 0.2, 0.0]])
    share = radiance(mitsuba, led, point, at) / radiance(mitsuba, white, point, at)
    close(share[0], [1, 0.5, 0.5, 1 / 16], CLOSE)


# -- the membrane ----------------------------------------------------------------------------------------------------
def reflect(mi, membrane, wi, wo, cosine_too=True):
    """(N, 4) of the membrane's eval (with the cosine) or brdf."""
    import drjit as dr

    si = dr.zeros(mi.SurfaceInteraction3f, len(wi))
    si.t, si.wi = mi.Float(1), vectors(mi, wi)
    wo = vectors(mi, wo)
    value = (
        mi.unpolarized_spectrum(membrane.eval(mi.BSDFContext(), si, wo, True))
        if cosine_too
        else membrane.brdf(si, wo, True)
    )
    return np.array(value + dr.zeros(mi.UnpolarizedSpectrum, len(np.asarray(wi)))).T


@pytest.mark.parametrize("sigma", [0.0, 0.05, 0.2, 0.6, 1.5])
def test_membrane_is_s3_in_angles(mitsuba, plugin, sigma):
    rng = RNG(3)
    rho = rng.uniform(0.1, 1, 3)
    membrane = plugin(type="membrane", rho_r=rho[0], rho_g=rho[1], rho_b=rho[2], sigma=sigma)
    wi, wo = hemisphere(rng, 2000), hemisphere(rng, 2000)
    found = reflect(mitsuba, membrane, wi, wo)
    for band in range(3):
        # 3e-5: the azimuth's cosine is a difference of products that cancel at grazing angles (cosines above 0.05)
        close(found[:, band], angle_form(wi, wo, rho[band], sigma) * wo[:, 2], 3 * CLOSE)


def test_specular_lobe_is_normalised_blinn_phong(mitsuba, plugin):
    """f' - f = k (e + 2)/(8 pi) (n.h)^e, white; and k is about the share of the light from straight above that it
    returns."""
    rng = RNG(14)
    wi, wo = hemisphere(rng, 1000, 0.3), hemisphere(rng, 1000, 0.3)
    k, e = 0.2, 15.0
    plain, shiny = (
        plugin(type="membrane", rho_r=0.5, rho_g=0.2, sigma=0.3, specular=s, specular_exponent=e) for s in (0.0, k)
    )
    half = unit(wi + wo)
    lobe = reflect(mitsuba, shiny, wi, wo, False) - reflect(mitsuba, plain, wi, wo, False)
    expected = k * (e + 2) / (8 * np.pi) * half[:, 2] ** e
    for band in range(2):
        assert np.abs(lobe[:, band] - expected).max() < 1e-6  # a difference of values near 0.2 in float32
    mirror = plugin(type="membrane", rho_r=0.0, rho_g=0.0, rho_b=0.0, specular=1.0, specular_exponent=100.0)
    # the normalisation is that of a lobe without the cosine's and the half vector's change: 10 % at e = 100
    assert directional_albedo(mitsuba, mirror, 1.0, 200) == pytest.approx(1, abs=0.1)
    assert directional_albedo(mitsuba, mirror, 1.0, 200) <= 1


def test_membrane_is_reciprocal(mitsuba, plugin):
    rng = RNG(4)
    wi, wo = hemisphere(rng, 500), hemisphere(rng, 500)
    for extra in ({}, {"specular": 0.2, "specular_exponent": 20.0}):
        membrane = plugin(type="membrane", sigma=0.4, **extra)
        close(reflect(mitsuba, membrane, wi, wo, False), reflect(mitsuba, membrane, wo, wi, False), CLOSE)


def test_membrane_reflects_nothing_from_behind(mitsuba, plugin):
    membrane = plugin(type="membrane", sigma=0.4)
    down, up = [[0.0, 0.6, -0.8]], [[0.6, 0.0, 0.8]]
    for wi, wo in ((down, up), (up, down), (down, down)):
        assert (reflect(mitsuba, membrane, wi, wo) == 0).all()


def directional_albedo(mi, membrane, cos_view, size=64):
    """int f cos dw by Gauss-Legendre in the angle and midpoints in azimuth, first band."""
    x, w = np.polynomial.legendre.leggauss(size)
    theta = np.pi / 4 * (x + 1)
    phi = (np.arange(size) + 0.5) * 2 * np.pi / size
    theta, phi = (a.ravel() for a in np.meshgrid(theta, phi, indexing="ij"))
    weight = np.repeat(w * np.pi / 4, size) * np.sin(theta) * 2 * np.pi / size
    wo = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    wi = np.broadcast_to([np.sqrt(1 - cos_view**2), 0.0, cos_view], wo.shape)
    return float((reflect(mi, membrane, wi, wo)[:, 0] * weight).sum())


def test_a_smooth_membrane_in_a_white_furnace_returns_rho(mitsuba, plugin):
    membrane = plugin(type="membrane", rho_r=0.7, sigma=0.0)
    for cos_view in (0.02, 0.5, 1.0):
        assert directional_albedo(mitsuba, membrane, cos_view) == pytest.approx(0.7, rel=1e-5)


@pytest.mark.parametrize("sigma", [0.05, 0.1, 0.2, 0.3, 0.6, 1.5])
def test_a_rough_membrane_creates_no_energy(mitsuba, plugin, sigma):
    """The albedo is at most rho for light from all sides, and for any one direction up to 60 deg.

    Beyond, (S3) as published exceeds it: at 90 deg the albedo is rho (A + B/2), at most 1.0151 rho (sigma = 0.2). That
    much is allowed, and no more."""
    membrane = plugin(type="membrane", rho_r=1.0, sigma=sigma)
    x, w = np.polynomial.legendre.leggauss(12)
    cosines, weights = (x + 1) / 2, w / 2
    albedo = np.array([directional_albedo(mitsuba, membrane, c) for c in cosines])
    assert 2 * (albedo * cosines * weights).sum() <= 1
    assert albedo[cosines > 0.5].max() <= 1
    a, b = 1 - 0.5 * sigma**2 / (sigma**2 + 0.33), 0.45 * sigma**2 / (sigma**2 + 0.09)
    assert directional_albedo(mitsuba, membrane, 0.001) == pytest.approx(
        a + b / 2, rel=2e-3
    )  # A + B/2 but for the last 0.06 deg
    assert albedo.max() <= 1.0152


def test_membrane_sampling_returns_the_albedo(mitsuba, plugin):
    """mean of the sample weights = int f cos dw: the sampler and the formula agree."""
    import drjit as dr

    mi = mitsuba
    membrane = plugin(type="membrane", rho_r=0.8, sigma=0.5)
    size = 512
    u = ((np.arange(size) + 0.5) / size).astype(np.float32)
    grid = mi.Point2f(*(a.ravel() for a in np.meshgrid(u, u)))
    si = dr.zeros(mi.SurfaceInteraction3f, size * size)
    si.t, si.wi = mi.Float(1), mi.Vector3f(0.8, 0, 0.6)
    _, weight = membrane.sample(mi.BSDFContext(), si, mi.Float(0.5), grid, True)
    mean = float(np.array(mi.unpolarized_spectrum(weight)[0]).mean())
    assert mean == pytest.approx(directional_albedo(mi, membrane, 0.6), rel=2e-4)  # midpoints against quadrature


# -- the camera ------------------------------------------------------------------------------------------------------
def camera_of(mi, width=320, height=240, **values):
    return mi.load_dict({"type": "camera", **values, "film": {"type": "hdrfilm", "width": width, "height": height}})


def rays(mi, camera, u, v):
    o, d = camera.ray(mi.Float(np.asarray(u, np.float32)), mi.Float(np.asarray(v, np.float32)))
    return np.array(o).T, np.array(d).T


def test_pinhole_by_field_of_view_and_by_k(mitsuba):
    rng = RNG(5)
    u, v = rng.uniform(0, 320, 200), rng.uniform(0, 240, 200)
    by_fov = camera_of(mitsuba, x_fov=41.0, aspect=1.02, principal_x=3.0, principal_y=-2.0)
    f = 160 / np.tan(np.radians(41.0) / 2)
    by_k = camera_of(mitsuba, fx=f, fy=1.02 * f, cx=163.0, cy=118.0)
    expected = unit(np.stack([(u - 163) / f, (v - 118) / (1.02 * f), np.ones_like(u)], -1))
    for camera in (by_fov, by_k):
        close(rays(mitsuba, camera, u, v)[1], expected, CLOSE, floor=0.1)
    o, d = rays(mitsuba, by_k, [163.0], [118.0])
    assert np.abs(d[0] - [0, 0, 1]).max() < 1e-6  # the principal point looks along z


def test_distortion_is_opencvs_and_its_inverse_returns(mitsuba):
    """Points projected by OpenCV's formula (there and back): k1, k2, p1, p2, k3."""
    k1, k2, p1, p2, k3 = -0.12, 0.04, 0.003, -0.002, 0.01
    rng = RNG(6)
    x, y = rng.uniform(-0.55, 0.55, (2, 300))
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    f = 200.0
    camera = camera_of(mitsuba, fx=f, fy=f, cx=160.0, cy=120.0, k1=k1, k2=k2, k3=k3, p1=p1, p2=p2)
    _, d = rays(mitsuba, camera, f * xd + 160, f * yd + 120)
    # 1e-5 of the image's half width: ten steps of the fixed point at |k1| r^2 < 0.08 leave 1e-7, float32 pixels 3e-7
    assert np.abs(d[:, :2] / d[:, 2:] - np.stack([x, y], -1)).max() < 1e-5


def test_pose_is_roll_then_tilt_then_pan_about_fixed_axes(mitsuba):
    from scipy.spatial.transform import Rotation

    mi = mitsuba
    nominal = mi.ScalarTransform4f().translate([1, 2, -24]).rotate([0, 1, 0], 12)
    camera = camera_of(mi, x_fov=50.0, to_world=nominal, x=0.3, y=-0.2, z=0.5, pan=4.0, tilt=-3.0, roll=25.0)
    u, v = RNG(7).uniform(0, 320, 50), RNG(8).uniform(0, 240, 50)
    f = 160 / np.tan(np.radians(25))
    d = unit(np.stack([(u - 160) / f, (v - 120) / f, np.ones_like(u)], -1))
    outer = Rotation.from_rotvec([0, np.radians(12), 0])
    turn = (
        outer
        * Rotation.from_rotvec([0, np.radians(4), 0])
        * Rotation.from_rotvec([np.radians(-3), 0, 0])
        * Rotation.from_rotvec([0, 0, np.radians(25)])
    )
    o, found = rays(mi, camera, u, v)
    close(found, turn.apply(d), CLOSE, floor=0.1)
    close(o, np.broadcast_to(np.array([1, 2, -24]) + outer.apply([0.3, -0.2, 0.5]), o.shape), CLOSE)


# -- the whole pixel -------------------------------------------------------------------------------------------------
def flat_pixel(values, width, height, led="led_1", camera_z=-24.0, absorption=0.0):
    """(H, W, 3) radiance of the flat face z = 0 under one LED at power 1, in numpy: rays, distances, (S2), (S3),
    paths."""
    v, u = np.mgrid[:height, :width] + 0.5
    f = width / 2 / np.tan(np.radians(values["camera.x_fov"]) / 2)
    d = unit(np.stack([(u - width / 2) / f, (v - height / 2) / f, np.ones_like(u)], -1))
    camera = np.array([0, 0, camera_z])
    p = camera + d * (-camera_z / d[..., 2:])
    lamp = np.array([values[f"{led}.{a}"] for a in "xyz"])
    axis = unit(-lamp)
    helper = np.array([0.0, 1, 0]) if abs(axis[1]) < 0.9 else np.array([1.0, 0, 0])
    side = unit(np.cross(helper, axis))
    axis = unit(
        axis
        + np.tan(np.radians(values[f"{led}.pan"])) * side
        + np.tan(np.radians(values[f"{led}.tilt"])) * np.cross(axis, side)
    )
    to_led, to_camera = unit(lamp - p), unit(camera - p)

    def local(w):  # the face's normal is -z
        return np.stack([w[..., 0], -w[..., 1], -w[..., 2]], -1)

    light = kappa(p, lamp, axis, 1.0, values[f"{led}.mu"])
    depth = values["gel.thickness"]
    d_light = np.linalg.norm(lamp - p, axis=-1) * np.minimum(1, depth / -lamp[2])
    d_view = depth / d[..., 2]
    light = light * np.exp(-absorption * (d_light + d_view))
    rho = np.array([values[f"membrane.rho_{c}"] for c in "rgb"])
    fr = angle_form(local(to_camera), local(to_led), 1.0, values["membrane.sigma"])
    paths = SimpleNamespace(p=p, lamp=lamp, axis=axis, camera=camera, light=d_light, view=d_view)
    return (light * fr * -to_led[..., 2])[..., None] * rho, paths


FLAT = {
    "gel.press_depth": 0.0,
    "led_1.pan": 7.0,
    "led_1.tilt": -11.0,
    "led_1.mu": 1.7,
    "membrane.sigma": 0.35,
    "membrane.rho_g": 0.4,
    "led_1.wavelength": 0.0,
    "gel.press_x": 0.0,
    "gel.press_y": 0.0,
}


def test_a_pixel_is_the_mean_of_what_it_sees(bench):
    """Next to an LED a pixel's middle is 6e-4 off its mean, by 8 x 8 places in it; second differences of the middles
    leave a tenth of that, at the image's borders a third. A rough face has a kink (S3)."""
    values = {**bench.values, **FLAT, "led_1.mu": 1.6, "membrane.sigma": 0.0}
    width, height = bench.scene.camera.resolution
    middles, _ = flat_pixel(values, width, height)
    means = flat_pixel(values, 8 * width, 8 * height)[0].reshape(height, 8, width, 8, 3).mean((1, 3))
    found = bench.renderer.led(values, "led_1").radiance
    off, missed = (np.abs(image / means - 1)[..., 0] for image in (middles, found))
    assert off.max() > 4e-4
    assert missed[1:-1, 1:-1].max() < 0.1 * off[1:-1, 1:-1].max()
    assert missed.max() < 0.4 * off.max()


def test_a_flat_gel_under_one_led_is_the_closed_form_in_every_pixel(bench, at_middles):
    values = {**bench.values, **FLAT}
    width, height = bench.scene.camera.resolution
    close(bench.renderer.led(values, "led_1").radiance, flat_pixel(values, width, height)[0])


def test_absorption_follows_the_lengths_inside_the_gel(bench, at_middles):
    """Beer-Lambert over both ways between z = -thickness and the face; the LED stands below the window's plane at z =
    -5."""
    values = {**bench.values, **FLAT, "gel.absorption": 0.13}
    width, height = bench.scene.camera.resolution
    close(bench.renderer.led(values, "led_1").radiance, flat_pixel(values, width, height, absorption=0.13)[0])
    above = {**values, "led_1.z": -2.5}  # an LED inside the gel: its whole way counts
    found = (
        bench.renderer.led(above, "led_1").radiance
        / bench.renderer.led({**above, "gel.absorption": 0.0}, "led_1").radiance
    )
    p = flat_pixel(above, width, height)[1].p
    lamp = np.array([values["led_1.x"], values["led_1.y"], -2.5])
    d_view = 4 * np.linalg.norm(p - [0, 0, -24], axis=-1) / 24
    close(found[..., 0], np.exp(-0.13 * (np.linalg.norm(lamp - p, axis=-1) + d_view)))


def test_haze_is_the_single_scattering_integral(bench, at_middles):
    """The veil against 500 midpoints along the camera's ray inside the gel, and the loss of what crosses it."""
    h = 0.03
    values = {**bench.values, **FLAT, "led_1.mu": 1.2, "led_1.pan": 0.0, "led_1.tilt": 0.0}
    width, height = bench.scene.camera.resolution
    clear, way = flat_pixel(values, width, height)
    veil = np.zeros((height, width))
    toward = unit(way.camera - way.p)
    for share in (np.arange(500) + 0.5) / 500:  # s from the face to where the ray enters the gel
        s = way.view * share
        x = way.p + toward * s[..., None]
        inside = np.minimum(1, (x[..., 2] + values["gel.thickness"]) / np.maximum(x[..., 2] - way.lamp[2], 1e-9))
        veil += (
            kappa(x, way.lamp, way.axis, 1.0, 1.2)
            * way.view
            / 500
            * np.exp(-h * (way.view - s + inside * np.linalg.norm(way.lamp - x, axis=-1)))
        )
    found = bench.renderer.led({**values, "gel.haze": h}, "led_1").radiance
    expected = clear * np.exp(-h * (way.light + way.view))[..., None] + h / (4 * np.pi) * veil[..., None]
    close(found, expected)


def test_ambient_light_meets_the_facets_that_light_of_leds_meets(bench):
    """Ambient light on a rough face: rho E/pi times the integral of Oren and Nayar's qualitative model over the
    hemisphere, by numbers."""
    sigma, values = 0.4, {**bench.values, "membrane.sigma": 0.4, "membrane.ambient": 0.3, "gel.press_depth": 0.6}
    hits = bench.renderer.hits(values)
    eye = np.array(hits.origin).T - hits.position.reshape(-1, 3)
    cos = np.sum(eye * hits.normal.reshape(-1, 3), -1) / np.linalg.norm(eye, axis=-1)
    view = np.arccos(np.clip(cos, -1, 1)).reshape(hits.shape)
    a, b = 1 - 0.5 * sigma**2 / (sigma**2 + 0.33), 0.45 * sigma**2 / (sigma**2 + 0.09)
    light, turn = np.meshgrid(
        (np.arange(900) + 0.5) / 900 * np.pi / 2, (np.arange(360) + 0.5) / 180 * np.pi, indexing="ij"
    )
    steps = np.pi / 2 / 900 * np.pi / 180
    at = np.linspace(0, view.max(), 12)
    share = [
        np.sum(
            (a + b * np.maximum(0, np.cos(turn)) * np.sin(np.maximum(light, v)) * np.tan(np.minimum(light, v)))
            / np.pi
            * np.cos(light)
            * np.sin(light)
        )
        * steps
        for v in at
    ]
    found = bench.renderer.ambient(values)[..., 0] / (values["membrane.rho_r"] * 0.3 / np.pi)
    assert found.min() > 0.8 and np.ptp(found) > 0.02
    assert np.abs(found - np.interp(view, at, share)).max() < 2e-3  # straight lines between twelve angles


def test_height_fall_off_and_ambient_light(bench, at_middles):
    """exp(-c h) with the height of the face; rho E/pi everywhere on a smooth one; rho G/pi (1 - n_z)/2 with n_z towards
    the camera."""
    values = {**bench.values, "gel.press_depth": 0.8}
    hits, plain = bench.renderer.hits(values), bench.renderer.led(values, "led_1").radiance
    rim = bench.renderer.led(values, "led_1").rim  # sampled finely: the hit at the centre is not its height
    faded = bench.renderer.led({**values, "gel.height_loss": 0.5}, "led_1").radiance
    height = -hits.position[..., 2]
    assert height.max() > 0.7
    lit = ~rim & (hits.bent == 0) & (plain[..., 0] > 0)
    close(faded[lit], plain[lit] * np.exp(-0.5 * height[lit])[:, None])
    rho = np.array([values[f"membrane.rho_{c}"] for c in "rgb"])
    close(
        bench.renderer.ambient({**values, "membrane.ambient": 0.3, "membrane.sigma": 0}),
        np.broadcast_to(rho * 0.3 / np.pi, plain.shape),
    )
    ground = np.array([0.2, 0.1, 0.4])
    found = bench.renderer.ambient({**values, **{f"membrane.ground_{c}": g for c, g in zip("rgb", ground)}})
    share = (1 + hits.normal[..., 2:]) / 2
    assert share.max() > 0.1
    assert np.abs(found - rho * ground / np.pi * share).max() < 1e-7  # 1 + n_z cancels where the face is flat


# -- the window ------------------------------------------------------------------------------------------------------
WINDOWED = """<scene version="3.0.0">
    <integrator type="tactile" id="integrator"><string name="bands" value="610, 540, 460"/></integrator>
    <sensor type="camera" id="camera">
        <transform name="to_world"><translate z="-24"/></transform>
        <float name="x_fov" value="60"/>
        <film type="hdrfilm"><integer name="width" value="40"/><integer name="height" value="30"/><rfilter type="box"/></film>
    </sensor>
    <bsdf type="membrane" id="membrane"/>
    <shape type="rectangle" id="outside">
        <transform name="to_world"><rotate x="1" angle="180"/><scale x="60" y="60"/><translate z="-8"/></transform>
        <bsdf type="interface" id="air_acrylic"><float name="index" value="1.49"/></bsdf>
    </shape>
    <shape type="rectangle" id="inside">
        <transform name="to_world"><rotate x="1" angle="180"/><scale x="60" y="60"/><translate z="-4"/></transform>
        <bsdf type="interface" id="acrylic_gel"><float name="index" value="0.9463"/></bsdf>
    </shape>
    <shape type="gel" id="gel"><float name="width" value="40"/><float name="length" value="30"/><ref id="membrane"/></shape>
    <emitter type="led" id="led_1"><point name="position" x="10" y="2" z="-3"/></emitter>
</scene>"""  # noqa: E501


def fresnel(n, c1):
    """Cosine beyond the boundary and transmittances T_s, T_p by Fresnel's amplitudes and the ratio of beams."""
    c2 = np.sqrt(1 - (1 - c1**2) / n**2)
    t_s, t_p = 2 * c1 / (c1 + n * c2), 2 * c1 / (n * c1 + c2)
    return c2, n * c2 / c1 * t_s**2, n * c2 / c1 * t_p**2


def test_two_media_window_bends_and_dims_as_by_hand(mitsuba, tmp_path):
    """Where each pixel's ray meets z = 0 through air, acrylic and gel, and the share of radiance that arrives."""
    from optics.light.renderer import Renderer
    from optics.scene import loader as scene

    file = tmp_path / "windowed.xml"
    file.write_text(WINDOWED)
    loaded = scene.load(file)
    hits = Renderer(loaded).hits(loaded.values())
    assert hits.valid.all()
    f = 20 / np.tan(np.radians(30))
    v, u = np.mgrid[:30, :40] + 0.5
    direction = np.stack([u - 20, v - 15], -1) / f
    tangent = np.linalg.norm(direction, axis=-1)
    sine = np.sin(np.arctan(tangent))
    radius, share_s, share_p = np.zeros_like(sine), 1.0, 1.0
    before = 1.0
    for index, height in ((1.0, 16.0), (1.49, 4.0), (1.49 * 0.9463, 4.0)):
        inside = sine / index
        radius = radius + height * inside / np.sqrt(1 - inside**2)
        if index != 1.0:
            n = index / before
            _, t_s, t_p = fresnel(n, np.sqrt(1 - (sine / before) ** 2))
            share_s, share_p = share_s * t_s / n**2, share_p * t_p / n**2
        before = index
    expected = direction / tangent[..., None] * radius[..., None]
    assert np.abs(hits.position[..., :2] - expected).max() < 1e-4  # mm; float32 at 24 mm, twice spawned off a plane
    assert np.abs(hits.position[..., 2]).max() < 1e-5
    weight = np.array(hits.weight[0]).reshape(30, 40)
    # each boundary's mean of T_s and T_p is taken by itself: polarization by the first reaches the second with 1e-5
    close(weight, (share_s + share_p) / 2, 5e-5)


def test_fresnel_at_normal_incidence_at_brewsters_angle_and_beyond_the_critical_one(mitsuba, plugin):
    mi = mitsuba
    for n in (1.41, 1.49, 1 / 1.41):
        window = plugin(type="interface", index=n)
        wo, t_s, t_p, met = window.refract(mi.Vector3f(0, 0, 1))
        assert float(t_s[0]) == pytest.approx(4 * n / (n + 1) ** 2, rel=1e-6)
        assert float(t_p[0]) == pytest.approx(4 * n / (n + 1) ** 2, rel=1e-6)
        brewster = np.arctan(n)
        _, _, t_p, _ = window.refract(mi.Vector3f(float(np.sin(brewster)), 0, float(np.cos(brewster))))
        assert float(t_p[0]) == pytest.approx(1, abs=1e-6)
        angles = np.linspace(0.01, 0.6, 40)
        wi = mi.Vector3f(np.sin(angles).astype(np.float32), 0, np.cos(angles).astype(np.float32))
        wo, t_s, t_p, _ = window.refract(wi)
        _, e_s, e_p = fresnel(n, np.cos(angles))
        close(np.array(t_s), e_s)
        close(np.array(t_p), e_p)
        close(
            np.array(wo).T,
            np.stack([-np.sin(angles) / n, 0 * angles, -np.sqrt(1 - np.sin(angles) ** 2 / n**2)], -1),
            CLOSE,
            0.1,
        )
    window = plugin(type="interface", index=1 / 1.41)
    _, t_s, t_p, _ = window.refract(mi.Vector3f(0.8, 0, 0.6))  # beyond asin(1/1.41) = 45 deg
    assert float(t_s[0]) == float(t_p[0]) == 0


def test_passing_a_window_there_and_back_is_the_identity(mitsuba, plugin):
    """Snell backwards, and T the same both ways."""
    mi = mitsuba
    window = plugin(type="interface", index=1.41)
    wi = vectors(mi, hemisphere(RNG(9), 200))
    wo, t_s, t_p, n = window.refract(wi)
    back, r_s, r_p, m = window.refract(wo)
    # 5e-5: the cosine is the root of a difference, which cancels at grazing incidence (cosines above 0.05)
    close(np.array(back).T, np.array(wi).T, 5 * CLOSE, floor=0.1)
    close(np.array(t_s), np.array(r_s), 5 * CLOSE)
    close(np.array(t_p), np.array(r_p), 5 * CLOSE)
    close(np.array(n * m), np.ones(200), CLOSE)


def test_window_polarizes_by_its_transmittances(mitsuba, plugin):
    """Unpolarized light leaves with S1/S0 = (T_s - T_p)/(T_s + T_p) across the plane of incidence; with T/n^2 as
    weight."""
    import drjit as dr

    mi = mitsuba
    n, angle = 1.41, np.radians(55)
    window = plugin(type="interface", index=n)
    si = dr.zeros(mi.SurfaceInteraction3f, 1)
    si.t, si.wi = mi.Float(1), mi.Vector3f(float(np.sin(angle)), 0, float(np.cos(angle)))
    bs, weight = window.sample(mi.BSDFContext(), si, mi.Float(0.5), mi.Point2f(0.5), True)
    across = mi.Vector3f(0, 1, 0)  # s-polarized: perpendicular to the plane of incidence
    turned = mi.mueller.rotate_mueller_basis(
        weight, -bs.wo, mi.mueller.stokes_basis(-bs.wo), across, si.wi, mi.mueller.stokes_basis(si.wi), across
    )
    m = (
        np.array(turned)[..., 0].reshape(4, 4, -1)[:, :, 0]
        if np.array(turned).ndim > 3
        else np.array(turned).reshape(4, 4, -1)[:, :, 0]
    )
    _, t_s, t_p = fresnel(n, np.cos(angle))
    expected = (
        np.array(
            [
                [t_s + t_p, t_s - t_p, 0, 0],
                [t_s - t_p, t_s + t_p, 0, 0],
                [0, 0, 2 * np.sqrt(t_s * t_p), 0],
                [0, 0, 0, 2 * np.sqrt(t_s * t_p)],
            ]
        )
        / 2
        / n**2
    )
    assert np.abs(m - expected).max() < 1e-5


# -- the gel's shape -------------------------------------------------------------------------------------------------
def test_wedge_is_a_tilted_plane(bench):
    """z = x tan(w_x) + y tan(w_y) and its normal, where each ray meets it."""
    values = {**bench.values, "gel.press_depth": 0.0, "gel.wedge_x": 2.0, "gel.wedge_y": -1.0}
    hits = bench.renderer.hits(values)
    a, b = np.tan(np.radians([2.0, -1.0]))
    p = hits.position
    assert np.abs(p[..., 2] - a * p[..., 0] - b * p[..., 1]).max() < 1e-5  # mm, float32 at 24 mm
    close(hits.normal, np.broadcast_to(unit([a, b, -1.0]), p.shape), CLOSE, floor=0.1)


def test_a_pressed_sphere_is_seen_where_it_is(bench):
    """Inside the contact the camera meets the sphere itself, to the smoothing's flattening of its rim."""
    values = {**bench.values, "gel.press_depth": 0.5, "gel.press_x": 0.7, "gel.press_y": -0.4}
    hits = bench.renderer.hits(values)
    p = hits.position
    r = np.hypot(p[..., 0] - 0.7, p[..., 1] + 0.4)
    inside = r < 0.6
    assert inside.sum() > 10
    sphere = -0.5 + 1.5 - np.sqrt(1.5**2 - r[inside] ** 2)
    assert (
        np.abs(p[..., 2][inside] - sphere).max() < 2e-3
    )  # mm; grid pitch 0.06: sagitta 0.06^2/8/1.5 = 3e-4, and smoothing


# -- the camera's arithmetic -----------------------------------------------------------------------------------------
@pytest.fixture
def view(bench):
    """The camera as image functions see it, all at neutral."""
    return bench.model.developer.view(bench.values)


def test_response_is_the_inverse_of_its_cubic(mitsuba):
    from optics.light.development import STEP
    from optics.scene.response import inverse_cubic

    irradiance = np.concatenate([np.linspace(0, 1, 2001), RNG(10).uniform(0, 1, 500)])
    for a, b in ((0.3, 0.1), (-0.4, 0.2), (0.6, -0.3), (0.9, 0.0), (0.0, -0.4), (0.0, 0.0)):
        m = inverse_cubic(irradiance, a, b)
        assert np.abs(m + a * (m**2 - m) + b * (m**3 - m) - irradiance).max() < 1e-9  # Newton to rounding
        assert (np.diff(m[:2001]) > 0).all()
        slope = inverse_cubic(irradiance + 1j * STEP, a, b).imag / STEP
        assert np.abs(slope * (1 + a * (2 * m - 1) + b * (3 * m**2 - 1)) - 1).max() < 1e-9  # (G^-1)' = 1/G'
    inside = slice(5, -5)
    for a, b in ((0.3, 0.1), (-0.4, 0.2)):  # derivatives by the response's own terms, against central differences
        for which in range(2):
            h = 1e-6
            low, high = ((a - h * (1 - which), b - h * which), (a + h * (1 - which), b + h * which))
            differences = (inverse_cubic(irradiance, *high) - inverse_cubic(irradiance, *low)) / (2 * h)
            step = (
                inverse_cubic(
                    irradiance.astype(complex),
                    a + (1j * STEP if which == 0 else 0),
                    b + (1j * STEP if which == 1 else 0),
                ).imag
                / STEP
            )
            assert np.abs(differences - step)[inside].max() < 1e-8
    with pytest.raises(ValueError, match="not monotone"):
        inverse_cubic(irradiance, 0.9, 0.45)


def test_the_view_has_the_tangent_of_the_field_angle(view):
    """By which effects know the angle between a pixel's ray and the optical axis."""
    x, y = (view.u - view.width / 2) / view.focal, (view.v - view.height / 2) / view.focal
    assert np.abs(view.tan - np.sqrt(x * x + y * y)).max() < 1e-12


def test_bend_and_the_chain_to_digital_numbers(bench):
    """DN = black + (saturation - black) m, m = G^-1(exposure gain M L) + bend m (1 - m)."""
    from optics.light.development import Developer
    from optics.scene.response import inverse_cubic

    camera = bench.scene.camera
    developer = Developer(camera, bench.scene.integrator.bands, black=7.0, saturation=250.0)
    values = {
        **bench.values,
        "camera.exposure": 2.0,
        "camera.gain": 1.1,
        "camera.response2_g": 0.2,
        "camera.response3_g": -0.1,
        "camera.response_bend": 0.15,
        "camera.offset": 0.5,
    }
    image = RNG(12).uniform(0, 0.4, (*camera.resolution[::-1], 3))
    irradiance = 2.2 * image
    m = irradiance.copy()
    m[..., 1] = inverse_cubic(irradiance[..., 1], 0.2, -0.1)
    m = m + 0.15 * m * (1 - m)
    assert np.abs(developer.develop(image, values) - (7 + 243 * m + 0.5)).max() < 1e-10


# -- light that the face sends to itself -----------------------------------------------------------------------------
def ball(mi, rho, max_depth=2, **led):
    """A membrane all around, seen from inside, with an LED in its middle: the integrating sphere."""
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {
                "type": "tactile",
                "max_depth": max_depth,
                "interreflection": 1.0,
                "bands": "610, 540, 460",
                "stokes": True,
            },
            "ball": {
                "type": "sphere",
                "radius": 5.0,
                "flip_normals": True,
                "bsdf": {"type": "membrane", "rho_r": rho, "rho_g": rho, "rho_b": rho, "sigma": 0.0},
            },
            "led": {
                "type": "led",
                "position": [0.0, 0.0, 0.0],
                "target": [0.0, 0.0, 1.0],
                "mu": 1.0,
                "power": 100.0,
                **led,
            },
            "camera": {
                "type": "camera",
                "x_fov": 30.0,
                "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 180),
                "film": {
                    "type": "hdrfilm",
                    "width": 8,
                    "height": 8,
                    "rfilter": {"type": "box"},
                    "component_format": "float32",
                },
            },
        },
        optimize=False,
    )


def ball_image(mi, scene, spp, seed=0):
    """(8, 8) S0 of the first band."""
    image = np.array(mi.render(scene, spp=spp, seed=seed), float)
    return image[..., image.shape[-1] - 16]


@pytest.mark.slow
def test_the_integrating_sphere(mitsuba):
    """In a sphere every point lights every other alike: after k reflections L_k = rho^(k-1) mean(L_1), whatever lit it
    first.

    The LED's lobe cos(theta) fills one half: mean(L_1) = rho/pi eta/R^2 int cos dw/(4 pi) = rho eta/(4 pi R^2). The
    camera looks at the dark half, where L_1 = 0, so that only reflected light arrives."""
    mi = mitsuba
    rho, eta, radius = 0.6, 100.0, 5.0
    mean = rho * eta / (4 * np.pi * radius**2)
    # the relative noise of one path is 1 (the cosine lobe); 64 pixels x 4096 samples leave 0.2 %
    assert ball_image(mi, ball(mi, rho, 2), 16).max() == 0
    second = ball_image(mi, ball(mi, rho, 3), 4096).mean()
    assert second == pytest.approx(rho * mean, rel=0.01)
    every = ball_image(mi, ball(mi, rho, 40), 4096).mean()  # 0.6^39 of the light is left
    assert every == pytest.approx(mean * rho / (1 - rho), rel=0.01)


def test_the_second_bounce_is_absorbed_on_its_last_way_too(mitsuba, tmp_path):
    """Same paths with and without absorption: each loses at least what the ways to the camera and from the LED take."""
    import re

    from optics.light.renderer import Renderer
    from optics.scene import loader as scene

    file = tmp_path / "open.xml"
    file.write_text(re.sub(r'<shape type="rectangle".*?</shape>', "", WINDOWED, flags=re.S))
    loaded = scene.load(file)
    values = {**loaded.values(), "gel.thickness": 15.0, "gel.press_depth": 0.8}
    renderer = Renderer(loaded)
    clear, grey = (renderer.bounced({**values, "gel.absorption": a}, "led_1")[..., 0] for a in (0.0, 0.1))
    seen = clear > 0
    assert seen.sum() > 30  # only the dent and its surroundings see each other
    least = 15 - 0.8 + 3 - 0.8  # mm: straight up from the dent's top, and straight down to it from the LED
    assert (grey[seen] / clear[seen]).max() < np.exp(-0.1 * least)


def test_energy_is_never_created_in_a_furnace(mitsuba):
    """A sphere of rho = 1 lit for k reflections holds k-1 times the light of one, and not more."""
    mi = mitsuba
    mean = 100.0 / (4 * np.pi * 25)
    four = ball_image(mi, ball(mi, 1.0, 5), 4096).mean()
    assert four == pytest.approx(3 * mean, rel=0.01)
    rough = mi.load_dict({"type": "membrane", "rho_r": 1.0, "sigma": 0.7})
    assert directional_albedo(mi, rough, 0.7) < 1


@pytest.mark.slow
def test_a_fold_lights_itself_by_its_form_factor(bench, mitsuba):
    """Two wide plates at a right angle, one lit evenly: radiance of the dark one at height h is rho L (1 - cos-weighted
    factor).

    A point of an endless plate at the distance h from the fold sees an endless perpendicular strip of width w under the
    factor (1 - h/sqrt(h^2 + w^2))/2 (Howell, A Catalog of Radiation Heat Transfer Configuration Factors, B-5)."""
    mi = mitsuba
    width, length, rho = 4.0, 400.0, 0.5
    white = {"type": "membrane", "rho_r": rho, "rho_g": rho, "rho_b": rho, "sigma": 0.0}
    lit = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([width / 2, 0, 0]).scale([width / 2, length / 2, 1]),
        "bsdf": white,
        "emitter": {"type": "area", "radiance": {"type": "uniform", "value": 3.0}},
    }
    dark = {
        "type": "rectangle",
        "bsdf": white,
        "to_world": mi.ScalarTransform4f().translate([0, 0, 50]).rotate([0, 1, 0], 90).scale([50, length / 2, 1]),
    }
    heights = np.array([0.5, 1.5, 3.0, 6.0])
    for h in heights:
        scene = mi.load_dict(
            {
                "type": "scene",
                "lit": lit,
                "dark": dark,
                "integrator": {"type": "tactile", "max_depth": 2, "bands": "610, 540, 460", "stokes": True},
                "camera": {
                    "type": "perspective",
                    "fov": 0.1,
                    "to_world": mi.ScalarTransform4f().look_at([30, 0, 40], [0, 0, float(h)], [0, 1, 0]),
                    "film": {
                        "type": "hdrfilm",
                        "width": 2,
                        "height": 2,
                        "rfilter": {"type": "box"},
                        "component_format": "float32",
                    },
                },
            },
            optimize=False,
        )
        image = np.array(mi.render(scene, spp=20000), float)
        expected = rho * 3.0 * (1 - h / np.hypot(h, width)) / 2
        found = image[..., image.shape[-1] - 16].mean()
        assert found == pytest.approx(
            expected, rel=0.02
        )  # 80 000 paths of the BSDF's sampling and the light's: about 0.5 %
