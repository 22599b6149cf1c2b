"""Beads as balls: traced without their mesh, through a pupil, behind a flat interface, and lit by one another."""

import numpy as np
import pytest


@pytest.fixture(scope="module")
def load(mitsuba):
    from optics.scene import loader

    return lambda **defines: loader.load("particle_gel", {k: str(v) for k, v in defines.items()})


def test_balls_are_met_where_the_formula_says(load):
    """Ends of rays against the closed form, to the digits of float32; which ball is met, to the ball."""
    import mitsuba as mi

    from optics.light.renderer import Renderer

    scene = load(beads=60, diameter=1.2, field=11, width=40, height=40, x_fov=34, detail=1)
    renderer = Renderer(scene)
    renderer.apply({**scene.values(), "gel.press_depth": 0.5})
    rng = np.random.default_rng(1)
    u, v = rng.uniform(0, 40, (2, 5000)).astype("f")
    sample = renderer._trace(u, v)
    o, d = (np.array(a, float).T for a in scene.camera.ray(mi.Float(u), mi.Float(v)))
    centres, radii = scene.parts["beads"].balls()
    b = np.einsum("nc,nmc->nm", d, centres - o[:, None])
    root = radii**2 - np.linalg.norm(o[:, None] + b[..., None] * d[:, None] - centres, axis=-1) ** 2
    t = np.where(root > 0, b - np.sqrt(np.maximum(root, 0)), np.inf)
    first = t.argmin(1)
    on = np.isfinite(t.min(1))
    crowd = scene.traced.crowds[0]
    met = np.array(sample.si.shape == mi.ShapePtr(crowd.shape)) & np.array(sample.si.is_valid())
    assert (met != on).mean() < 1e-3  # float32 at rims
    both = met & on
    assert (np.array(sample.si.prim_index)[both] == first[both]).mean() > 0.999
    place, normal = (np.array(a, float).T[both] for a in (sample.si.p, sample.si.sh_frame.n))
    same = np.array(sample.si.prim_index)[both] == first[both]
    off = place - centres[first[both]]
    np.testing.assert_allclose(np.linalg.norm(off, axis=1)[same], radii[first[both]][same], atol=1e-5)
    np.testing.assert_allclose(normal[same], off[same] / radii[first[both]][same, None], atol=1e-4)


def test_the_mesh_follows_when_it_is_asked_for(load):
    """Images LED by LED leave the mesh where it was; `scene.mitsuba` has it at its place."""
    import mitsuba as mi

    scene = load(beads=5, detail=1, width=16, height=16)
    scene.mitsuba  # noqa: B018
    before = np.array(mi.traverse(scene.parts["beads"])["vertex_positions"])
    scene.set({"gel.press_depth": 0.8}, meshes=False)
    np.testing.assert_array_equal(np.array(mi.traverse(scene.parts["beads"])["vertex_positions"]), before)
    mesh = np.array(mi.traverse(next(s for s in scene.mitsuba.shapes() if s.id() == "beads"))["vertex_positions"])
    middles = mesh.reshape(5, -1, 3).mean(1)
    np.testing.assert_allclose(middles, scene.parts["beads"].centres(), atol=1e-4)
    assert np.abs(mesh - before).max() > 0.01


def test_an_interface_of_the_same_index_hides_no_ball_that_a_press_pushed_through(load):
    """The half-space of a deep press moves low balls through the base, by a hundredth of a millimetre or more. An index
    of 1 + 1e-6 there changes rounding alone, by 2e-4 of the image. Rays that began within such a ball saw its far
    side: 18 %."""
    from optics.light.renderer import Renderer

    scene = load(
        beads=40, diameter=1.2, field=11, top=0.65, bottom=3.85, width=32, height=32, x_fov=34, fine=5, detail=1
    )
    renderer = Renderer(scene)
    pressed = {**scene.values(), "gel.press_depth": 0.9}
    plain, behind = (renderer.radiance({**pressed, "base.index": index}) for index in (1.0, 1 + 1e-6))
    centres, radii = scene.parts["beads"].balls()
    assert (centres[:, 2] - radii).min() < -4.51
    assert np.sqrt(np.mean((behind - plain) ** 2)) < 1e-3 * plain.mean()


def test_a_denser_gel_shrinks_the_image_and_dims_it(load):
    """Rays behind the base's face by Snell's law, which pass it where straight ones do; their weight is T/n^2."""
    from optics.light.renderer import Renderer

    scene = load(beads=5, detail=1, width=32, height=32)
    renderer = Renderer(scene)
    straight = renderer._rays(np.array([4.0], "f"), np.array([16.0], "f"))
    renderer.apply({**scene.values(), "base.index": 1.05})
    o, d, weight = renderer._rays(np.array([4.0], "f"), np.array([16.0], "f"))
    before, after = (np.array(a, float).ravel() for a in (straight[1], d))
    at_face = [
        p + (-4.5 - p[2]) / v[2] * v
        for p, v in ((np.array(straight[0], float).ravel(), before), (np.array(o).ravel(), after))
    ]
    np.testing.assert_allclose(at_face[1], at_face[0], atol=1e-5)
    np.testing.assert_allclose(after[:2], before[:2] / 1.05, atol=1e-6)
    sine = np.hypot(*before[:2])
    c1, c2 = np.sqrt(1 - sine**2), np.sqrt(1 - (sine / 1.05) ** 2)
    lost = [((c1 - 1.05 * c2) / (c1 + 1.05 * c2)) ** 2, ((1.05 * c1 - c2) / (1.05 * c1 + c2)) ** 2]
    assert np.array(weight).ravel()[0] == pytest.approx((1 - np.mean(lost)) / 1.05**2, rel=1e-5)


def test_a_bead_lights_another_as_a_lambert_sphere(mitsuba):
    """The light that a far ball scatters to a face is that of a matt ball in full phase: of the irradiance E, 2 rho E
    r^2/(3 d^2) reaches the face, by reflection and as excitation; a small ball, 40 radii away."""
    import mitsuba as mi

    from optics.light.led_by_led import LedByLed  # noqa: F401  (methods of the integrator)

    radius, distance, rho = 0.1, 4.0, 0.4
    dye = {
        "type": "fluorescent",
        "rho_r": 0.0,
        "rho_g": 0.5,
        "rho_b": rho,
        "yield": 0.7,
        "absorption_peak": 465.0,
        "absorption_fwhm": 60.0,
    }
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "tactile", "bands": "610, 525, 465"},
            "ball": {"type": "sphere", "center": [0.0, 0.0, distance], "radius": radius, "bsdf": dye},
            "led": {
                "type": "led",
                "position": [0.0, 0.0, -200.0],
                "target": [0.0, 0.0, 0.0],
                "power": 1e4,
                "mu": 0.0,
                "wavelength": 465.0,
                "fwhm": 25.0,
            },
        },
        optimize=False,
    )
    import drjit as dr

    integrator, led, ball = scene.integrator(), scene.emitters()[0], scene.shapes()[0]
    # a face at the origin, turned to the ball, of the same dye; directions in the cone of the ball, weighed by it
    count, cone = 200_000, 1 - np.cos(np.arcsin(radius / distance))
    rng = np.random.default_rng(2)
    z, angle = 1 - cone * rng.random(count), 2 * np.pi * rng.random(count)
    s = np.sqrt(1 - z**2)
    d = mi.Vector3f(*(a.astype("f") for a in (s * np.cos(angle), s * np.sin(angle), z)))
    ray = mi.Ray3f(mi.Point3f(0, 0, 0), d, mi.Float(0), integrator.wavelengths(count))
    second = scene.ray_intersect(ray)
    point = led.position()
    seen = integrator.visible(scene, second, point, led)
    face = dr.zeros(mi.SurfaceInteraction3f, count)
    face.t, face.shape, face.sh_frame = mi.Float(1.0), mi.ShapePtr(ball), mi.Frame3f(mi.Normal3f(0, 0, 1))
    face.wi, face.wavelengths = mi.Vector3f(0, 0, 1), second.wavelengths
    again = np.array(integrator.excited_again(scene, face, second, led, point, seen)[1]).mean()
    irradiance = 1e4 / (200.0 + distance) ** 2
    # of all directions with the cosine's law, those in the cone are its solid angle over pi
    arrived = again * 2 * cone
    expected = np.array(
        ball.bsdf().excited(face, led, mi.Float(2 * rho * irradiance * radius**2 / (3 * distance**2)))[1]
    )[0]
    # 200,000 directions leave 0.2 %; the ball's distance, 1/40, squared
    assert arrived == pytest.approx(expected, rel=0.03)


@pytest.mark.slow
def test_light_that_beads_scatter_into_one_another_is_a_stock_path_tracers(tmp_path, mitsuba):
    """White beads without a dye over a grey cover, in one band: LED by LED, light after two reflections against what
    stock `path` adds when it may follow one bounce more. Without the base's face, which ends its shadow rays."""
    import re

    import mitsuba as mi

    from optics.light.renderer import Renderer
    from optics.scene import loader

    text = loader.find("particle_gel").read_text(encoding="utf-8").replace("610, 525, 465", "465")
    text = re.sub(r'<shape type="rectangle" id="base_face">.*?</shape>', "", text, flags=re.S)
    (tmp_path / "one_band.xml").write_text(text, encoding="utf-8")
    size = {"width": 24, "height": 24, "x_fov": 34, "beads": 40, "diameter": 1.2, "field": 11, "top": 0.65}
    size |= {"bottom": 3.85, "fine": 4, "detail": 4}
    defines = {name: str(value) for name, value in size.items()}
    scene = loader.load(tmp_path / "one_band.xml", defines, "llvm_ad_mono_polarized")
    try:
        white = {f"dye.rho_{c}": 0.9 for c in "rgb"} | {f"cover.rho_{c}": 0.3 for c in "rgb"}
        values = {**scene.values(), **white, "dye.yield": 0.0, "cover.sigma": 0.0}
        renderer = Renderer(scene)
        ours = np.array(
            [sum(renderer.powers(values, n) * renderer.bounced(values, n, seed) for n in scene.leds) for seed in (0, 1)]
        )
        scene.set(values)

        def traced(depth, seed):
            path = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 100})
            return np.array(mi.render(scene.mitsuba, integrator=path, spp=512, seed=seed)).mean(-1)

        # of a seed, both have the same first reflections: their noise goes in the difference
        more = np.array([traced(3, seed) - traced(2, seed) for seed in range(6)])
    finally:
        mi.set_variant("llvm_ad_spectral_polarized")
    ours, more = (a.reshape(-1, 6, 4, 6, 4).mean((2, 4)) for a in (ours, more))
    noise = np.sqrt(ours.var(0, ddof=1) / len(ours) + more.var(0, ddof=1) / len(more))
    off = ours.mean(0) - more.mean(0)
    assert noise.mean() < 0.1 * more.mean()
    assert abs(off.mean()) < 4 * np.sqrt(np.mean(noise**2) / noise.size)
    assert np.abs(off).max() < 6 * np.sqrt(np.mean(noise**2)) + 0.01 * more.max()  # rims of meshes with 5120 faces


@pytest.mark.parametrize("area", [0.0, 1.2])
def test_few_cells_are_nearly_as_good_as_many(area, mitsuba):
    """The green image of a small crowd, 10 cells across a bead's radius beside 57, without a pupil and with one that
    blurs outlines over a third of a pixel. Rays that count as what they meet, 16 or 64 of them, were off by 0.011 and
    0.004; these by 0.0006."""
    from optics.light.renderer import Renderer
    from optics.scene import loader

    size = {"width": 24, "height": 24, "x_fov": 34, "beads": 40, "diameter": 1.2, "field": 11, "top": 0.65}
    images = []
    for fine in (1, 6):
        defines = {name: str(value) for name, value in {**size, "bottom": 3.85, "fine": fine}.items()}
        scene = loader.load("particle_gel", defines)
        images.append(Renderer(scene).radiance({**scene.values(), "camera.pupil_area": area})[..., 1])
    assert np.std(images[0] - images[1]) < 0.0012 * images[1].max()


@pytest.mark.parametrize("area, most", [(0.0, 0.003), (8.0, 0.008)])
def test_an_image_holds_the_light_of_plain_rays(area, most, mitsuba):
    """Of beads whose light falls towards their outlines; a ray from the middle of the pupil's places that see a part of
    a bead, in place of rays from all of them, found 2 % too much. Now 0.2 and 0.5 % are left."""
    from optics.light.renderer import Renderer
    from optics.light.samples import Finer, LedImage
    from optics.scene import loader

    size = {"width": 24, "height": 24, "x_fov": 34, "beads": 40, "diameter": 1.2, "field": 11, "top": 0.65}
    renderer = Renderer(loader.load("particle_gel", {k: str(v) for k, v in {**size, "bottom": 3.85}.items()}))
    values = {**renderer.scene.values(), "camera.pupil_area": area}
    found = renderer.led(values, "inner_ring")
    side, pixels = 24, np.arange(24 * 24)
    places = (np.arange(side) + 0.5) / side
    u, v = (
        (corner[:, None] + a.ravel()).ravel()
        for corner, a in zip((pixels % 24, pixels // 24), np.meshgrid(places, places))
    )
    lens = np.random.default_rng(0).random((2, u.size)).astype(np.float32) if area else None
    plain = Finer(np.full(24 * 24, side**2), renderer._trace(u, v, lens), (u, v))
    visible = renderer._visible(plain.sample.si, renderer.scene.leds["inner_ring"])
    image = LedImage("inner_ring", found.hits, None, pixels, plain, None, visible, None)
    plainly = renderer._mix(image, renderer._direct(image))
    assert found.radiance[..., 1].sum() == pytest.approx(plainly[..., 1].sum(), rel=most)
