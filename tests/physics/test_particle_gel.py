"""The particle gel: outlines and motion of beads against exact projections, light against a path tracer, refusals."""

import numpy as np
import pytest

from optics.skin.cloud import draw, settled, sizes
from optics.skin.forces import ball, displacements


@pytest.fixture(scope="module")
def load(mitsuba):
    from optics.scene import loader

    return lambda **defines: loader.load("particle_gel", {k: str(v) for k, v in defines.items()})


def test_outlines_are_those_of_balls(load):
    """Rays around single beads: what hits the mesh and not the ball, or the reverse, passes within 0.05 px of its
    rim."""
    import mitsuba as mi

    scene = load(beads=8, seed=2)
    camera, centres = scene.camera, scene.parts["beads"].centres()
    focal, rng = camera.scales()[0], np.random.default_rng(0)
    for centre, at in zip(centres, camera.project(centres)):
        u, v = (at + rng.uniform(-6, 6, (40_000, 2))).astype("f").T
        o, d = camera.ray(mi.Float(u), mi.Float(v))
        o = o + d * ((-4.45 - o.z) / d.z)  # behind the face of the base
        si = scene.mitsuba.ray_intersect(mi.Ray3f(o, d, mi.Float(0), scene.integrator.wavelengths(len(u))))
        hit = np.array(si.shape == mi.ShapePtr(next(s for s in scene.mitsuba.shapes() if s.id() == "beads")))
        away = centre - np.array([0, 0, -18.75])
        distance = np.linalg.norm(away)
        angle = np.arccos(np.clip(np.array(d, float).T @ away / distance, -1, 1))
        rim = np.arcsin(0.275 / distance)
        inside = angle < rim
        assert inside.sum() > 2000  # some 4 px of radius
        assert np.abs(angle - rim)[hit != inside].max(initial=0) * focal < 0.05
        # the mean silhouette is the ball's: 40,000 rays of which a third hit leave 0.7 % of the area
        assert hit.sum() == pytest.approx(inside.sum(), rel=0.01)


def test_a_press_moves_beads_as_the_half_space_does(load):
    scene = load(beads=50, detail=1, width=32, height=32)
    beads = scene.parts["beads"]
    rest = beads.centres()
    scene.set({"gel.press_x": 3.0, "gel.press_y": -2.0, "gel.press_depth": 0.5, "gel.drag_y": 0.3})
    places, forces = ball(0.5, 0.6).nodes(0.12, 0.5, (0.0, 0.3))
    at = rest * [1, 1, -1] + [-3.0, 2.0, 1.25]
    expected = rest + displacements(at, places, forces, 0.12) * [1, 1, -1]
    np.testing.assert_allclose(beads.centres(), expected, atol=1e-12)
    assert scene.gel.force()[2] == pytest.approx(ball(0.5, 0.6).force(0.12))
    scene.set({"gel.press_depth": 0.0})
    np.testing.assert_array_equal(beads.centres(), rest)
    # the same force, asked for in newtons
    scene.set({"gel.press_force": ball(0.5, 0.6).force(0.12)})
    np.testing.assert_allclose(beads.centres(), expected, atol=1e-9)


def test_an_image_says_the_force_of_its_press(load):
    from optics.light.rendering import RenderJob

    job = RenderJob(load(beads=20, detail=1, width=24, height=24), layers=())
    press = job.take({"gel.press_force": 0.05, "gel.drag_x": 0.1}).header["provenance"]["press"]
    np.testing.assert_allclose(press["force"], [0.005, 0.0, 0.05], rtol=1e-9)


def test_beads_follow_a_dented_gel_of_any_kind(mitsuba):
    """In a gel that knows its dent alone, between the depths at which sheets are carried."""
    from optics.scene.checking import made
    from optics.skin.halfspace import carried_points, displaced

    gel = made(
        "gel", press_depth=0.8, indenter_size=3.0, extent=6.0, pitch=0.2, map_pitch=0.1, bsdf={"type": "membrane"}
    )
    points = np.array([[0.5, 0.2, -1.0], [1.0, -1.0, -2.3], [0.0, 2.0, -4.0]])
    exact = np.concatenate([displaced(gel, x, y, -z)[None] for x, y, z in points])
    assert np.abs(exact - points).max() > 0.2
    # linear between nine levels from 1 to 4 mm: (0.375 mm)^2/8 of a displacement of 0.8 mm that bends over 1 mm
    np.testing.assert_allclose(carried_points(gel, points), exact, atol=0.01)


@pytest.mark.slow
def test_a_path_tracer_sees_the_same_light(load):
    """Light by light with few samples in each pixel, and mi.render with many, through an absorbing gel."""
    from optics.light.rendering import RenderJob

    scene = load(width=60, height=60, beads=60, diameter=2.4, depth=0.5, top=1.3, bottom=3.2)
    absorbing = {"gel.absorption": 0.05}
    exact, traced = (RenderJob(scene, spp=spp, layers=(), saturation=1.0).take(absorbing) for spp in (None, 256))
    one, other = (image.camera.reshape(6, 10, 6, 10, 3).mean((1, 3)) for image in (exact, traced))
    for channel in (1, 2):
        assert other[..., channel].max() > 0.02
        # blocks of 100 px, whose rims of 32 samples err by up to a tenth of the contrast, some in the same way
        np.testing.assert_allclose(one[..., channel], other[..., channel], atol=0.02 * other[..., channel].max())
    assert np.abs(one - other)[..., 1].mean() < 0.005 * other[..., 1].max()


def test_the_fluorescence_of_a_bead_is_that_of_the_formula(load):
    """The brightest point of a bead on the axis: yield/pi times the photons absorbed, in the green band."""
    scene = load(beads=1, width=48, height=48, x_fov=2, seed=4)
    scene.set({"beads.width": 0.551, "beads.length": 0.551, "outer_ring.power": 0.0})
    from optics.light.renderer import Renderer

    x, y, z = scene.parts["beads"].centres()[0]
    assert abs(x) < 1e-3 and abs(y) < 1e-3
    front = z - 0.275
    image = Renderer(scene).radiance({**scene.values()})
    distance2 = 8.0**2 + (front + 17) ** 2
    cos = (front + 17) / distance2**0.5
    nm = np.linspace(300, 700, 8001)
    bell = lambda peak, fwhm: np.exp(-4 * np.log(2) * ((nm - peak) / fwhm) ** 2)  # noqa: E731
    absorbed = 40 * cos**2 / distance2 * 0.9 * np.trapezoid(bell(465, 25) * bell(465, 60) * nm, nm)
    emission = np.interp(525, nm, bell(525, 40)) / np.trapezoid(bell(525, 40), nm)
    # a pixel beside the middle of the bead, whose radius is 24 px: the face is turned by less than 2 deg
    assert image[24, 24, 1] == pytest.approx(0.7 / np.pi * absorbed * emission / 525, rel=0.01)


def test_sinking():
    """0.35 mm in ten minutes, as the source's text says; at first a fall, in the end Stokes' speed."""
    assert settled(600.0) == pytest.approx(0.3513, rel=1e-3)
    assert settled(1e-9) == pytest.approx(0.5 * 9.81 * (1 - 980 / 1020) * 1e-18 * 1e3, rel=1e-3)
    speed = 2 / 9 * 40 * 9.81 * 0.25e-3**2 / 9.3
    assert (settled(2000.0) - settled(1000.0)) / 1000 == pytest.approx(speed * 1e3, rel=1e-9)


def test_beads_that_do_not_fit_are_refused_in_one_sentence(optics):
    code, _, err = optics("render", "particle_gel", "-D", "beads=2000", "-D", "diameter=1.6", "-o", "never.exr")
    assert code == 2 and "do not fit without overlaps" in err and "fewer or smaller beads" in err, err
    with pytest.raises(ValueError, match="larger than a bead"):
        draw(3, (1.0, -0.1, 1.0), np.full(3, 0.5))
    assert sizes(4000, 0.5, 0.1, 3).std() == pytest.approx(0.05, rel=0.05)  # 4000 draws: 1 %, five times


def test_an_image_does_not_depend_on_those_before_it(load):
    """Which pixels are sampled finely is kept with a geometry: it may not hang on the dye of the first image."""
    from optics.light.renderer import Renderer

    scene = load(beads=300, detail=1, width=40, height=40)
    bleached = {**scene.values(), "dye.time": 3.0, "dye.bleaching": 0.3}
    alone = Renderer(scene).radiance(bleached)
    after = Renderer(scene)
    after.radiance({**bleached, "dye.bleaching": 0.0, "gel.dye": 2.0, "camera.x_fov": 20.0})  # where beads are large
    np.testing.assert_array_equal(after.radiance(bleached), alone)
    soft = {**bleached, "camera.pupil_area": 2.0, "camera.focus": 12.0}  # a focus of its own is asked for later
    after.radiance({**bleached, "camera.x_fov": 25.0})
    np.testing.assert_array_equal(
        after.radiance(soft), Renderer(load(beads=300, detail=1, width=40, height=40)).radiance(soft)
    )


SMALL = {"width": 12, "height": 12, "x_fov": 20, "beads": 12, "field": 6, "diameter": 1.2, "top": 0.65, "bottom": 3.85}


def test_beads_show_where_the_camera_stands(load):
    """Its pose and field of view are solved for unless a set states them as known; before a gel without beads they are
    not. A set that knew nothing of a camera 0.06 mm aside was off by 47 times its noise without them."""
    from pathlib import Path

    from optics.captures.capture_set import Captures, Frame
    from optics.captures.noise import Noise
    from optics.fit.scene_model import SceneModel
    from optics.scene import loader
    from optics.study.setup import Setup, default_free, variables_of_base

    noise = Noise(system_gain=0.1, dark_noise=1.0, black_level=0.0, saturation=255.0, prnu=0.0)
    pose = {f"camera.{name}" for name in ("x", "y", "z", "pan", "tilt", "roll", "x_fov")}

    def model(scene, given=(), uncertain=(), frame=()):
        frames = [Frame("f", np.zeros((12, 12, 3), np.float32), parameters=dict(frame))]
        own = Captures(Path("."), "", frames, dict(given), noise, None, None, "DN", None, [])
        own.uncertainty = dict(uncertain)
        return SceneModel(scene, own)

    beads = load(**SMALL)
    found = {v.name: v.prior for v in variables_of_base(model(beads), Setup(captures="."), [0]) if v.name in pose}
    assert found == {
        name: (20.0 if name == "camera.x_fov" else 0.0, 0.2 if name[-2:] in (".x", ".y", ".z") else 0.5)
        for name in pose
    }
    stated = {"camera.z": 0.1, "camera.x": 0.2}
    assert pose - set(default_free(model(beads, stated, {"camera.x": 0.1}))) == {"camera.z"}
    assert pose - set(default_free(model(beads, frame={"camera.y": 0.3}))) == {"camera.y"}
    of_groups = variables_of_base(model(beads), Setup(captures=".", per_group=["camera.x"]), [0])
    assert {(v.name, v.prior) for v in of_groups if v.keys == ("camera.x",)} == {("camera.x[f]", None)}
    plain = loader.load("gelsight", {"width": "12", "height": "12"})
    assert not pose & set(default_free(model(plain)))


def test_a_derivative_image_is_made_once(load, monkeypatch):
    """A diagnosis scores effects by the images with which its refits begin; other values and steps have images of their
    own, and a seed changes neither them, as outlines are exact, nor the prediction."""
    from pathlib import Path

    from optics.captures.capture_set import Captures, Frame
    from optics.captures.noise import Noise
    from optics.fit.scene_model import SceneModel
    from optics.scene.parameter import Values, Variable

    noise = Noise(system_gain=0.1, dark_noise=1.0, black_level=0.0, saturation=255.0, prnu=0.0)
    frames = [Frame("f", np.zeros((12, 12, 3), np.float32))]
    model = SceneModel(
        load(**SMALL), Captures(Path("."), "particle_gel", frames, {}, noise, None, None, "DN", None, [])
    )
    z = Variable("camera.z", ("camera.z",), model.parameters["camera.z"])

    def image(values=None, seed=5, secant=None):
        return next(iter(model.derivatives(values or Values(), [z], [0], secant, seed)))[1]["camera.z"]

    plain, first = model.predict(Values(), [0])[0], image()
    assert np.array_equal(first, image(seed=6)) and not np.array_equal(first, image(secant={"camera.z": 0.3}))
    traced = []
    monkeypatch.setattr(model.renderer, "_trace", lambda *a: traced.append(a) or 1 / 0)
    assert np.array_equal(first, image()) and not traced
    assert np.array_equal(plain, model.predict(Values(), [0])[0])
    with pytest.raises(ZeroDivisionError):
        image(Values({"camera.z": 0.1}))


def test_a_press_that_is_made_again_later_has_the_same_images(load, monkeypatch):
    """While nothing bleaches the clock changes no image, and none is made again; with bleaching it does, and the
    derivative by it at none is -time times the fluorescence."""
    from optics.light.renderer import Renderer

    renderer = Renderer(load(**SMALL))
    values = renderer.scene.values()
    early, late = ({**values, "dye.time": time} for time in (1.0, 3.0))
    first = renderer.radiance(early)
    slopes = [renderer.led_tangent(now, "inner_ring", "dye.bleaching") for now in (early, late)]
    assert np.abs(slopes[0]).max() > 0
    np.testing.assert_allclose(slopes[1], 3 * slopes[0], rtol=1e-5, atol=1e-7 * np.abs(slopes[1]).max())
    left = renderer.radiance({**late, "dye.bleaching": 0.1})
    assert left[..., 1].sum() < 0.9 * first[..., 1].sum()  # exp(-0.3) of the green, which is all fluorescence
    monkeypatch.setattr(renderer, "_render_led", None)
    monkeypatch.setattr(renderer, "_shaded_again", None)
    assert np.array_equal(first, renderer.radiance(late))
