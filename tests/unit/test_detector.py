"""A detector that prefers a polarization (stage `detector`): readings, images, Stokes vectors and fits against plain
numpy."""

from pathlib import Path

import numpy as np
import pytest

from optics.captures.capture_set import Captures, Frame
from optics.captures.noise import Noise
from optics.fit.scene_model import SceneModel
from optics.light.renderer import Renderer
from optics.light.rendering import RenderJob
from optics.scene import loader
from optics.scene.parameter import Values, Variable

Q, U = 0.03, -0.05
DETECTOR = {"camera.detector_q": Q, "camera.detector_u": U}
DIAL = np.arange(0.0, 180.0, 15.0)


@pytest.fixture(scope="module")
def bench(mitsuba):
    return loader.load("polarizer_bench")


def table(scene, values):
    frames = [Frame(str(k), np.full((1, 1, 1), v), parameters={"analyzer.angle": a}) for k, (a, v) in
              enumerate(zip(DIAL, values))]  # fmt: skip
    noise = Noise(0.0, 0.5, 0.0, 1000.0, 0.0, signed=True)
    return SceneModel(scene, Captures(Path("."), "polarizer_bench", frames, noise=noise, table=Path("t.csv")))


def test_readings_are_weighed_by_the_axis_of_the_last_film(bench):
    """T1^2/2 cos^2 (1 + q cos 2a + u sin 2a) behind films at 0 and a; 1 + q q' with no film before a polarized lamp."""
    renderer, values = Renderer(bench), bench.values()
    seen = renderer.radiance({**values, **DETECTOR, "analyzer.angle": DIAL})[:, 0, 0]
    a = np.radians(DIAL)
    expected = 0.32 * np.cos(a) ** 2 * (1 + Q * np.cos(2 * a) + U * np.sin(2 * a))
    assert seen == pytest.approx(expected, abs=1e-7)  # rays are traced in single precision
    bare = {**values, "analyzer.inserted": 0.0, "polarizer.inserted": 0.0, "source.dop_q": 0.4}
    assert renderer.radiance({**bare, **DETECTOR})[0, 0, 0] == pytest.approx(1 + 0.4 * Q, abs=1e-7)
    assert np.array_equal(renderer.radiance({**values, "camera.detector_q": 0.0}), renderer.radiance(values))


def test_light_from_a_plate_shows_the_detector_without_any_film(mitsuba):
    """(R_p + R_s)/2 + q (R_p - R_s)/2: 0 lies in the plane of incidence."""
    scene = loader.load("reflection_bench")
    out = {**scene.values(), "analyzer.inserted": 0.0, "polarizer.inserted": 0.0}
    renderer = Renderer(scene)
    p, s = (
        renderer.radiance({**out, "polarizer.inserted": 1.0, "polarizer.transmittance": 1.0, "polarizer.angle": angle})
        for angle in (0.0, 90.0)
    )
    found = renderer.radiance({**out, **DETECTOR})
    assert float(s[0, 0, 0]) > 2 * float(p[0, 0, 0])
    assert found == pytest.approx((p + s) + Q * (p - s), rel=1e-6)


@pytest.mark.slow
def test_images_record_the_weighed_light_and_keep_the_stokes_vectors_that_arrive(mitsuba):
    """LED by LED and by mi.render alike; S0 of the file is that of the light, and what the camera makes is not."""
    defines = {"width": 4, "height": 3, "x_fov": 4, "analyzer": 30, "bands": "540"}
    for spp, off in ((None, 1e-6), (4, 1e-5)):  # mi.render: single precision throughout
        scene = loader.load("polarizer_bench", defines)  # each time anew: a scene keeps the values of its last image
        job = RenderJob(scene, spp=spp)
        plain, weighed = job.take({}), job.take(DETECTOR)
        assert job.exact == (spp is None)
        vectors = plain.stokes()[1][:, :, 0]
        assert weighed.stokes()[1][:, :, 0] == pytest.approx(vectors, rel=1e-7)
        assert plain.camera[..., 0] == pytest.approx(255 * vectors[..., 0], rel=off)
        expected = vectors @ (1.0, Q, U, 0.0)
        assert np.abs(expected / vectors[..., 0] - 1).max() > 0.02
        assert weighed.camera[..., 0] == pytest.approx(255 * expected, rel=off)


def test_stokes_vectors_of_a_renderer_are_those_before_the_detector(bench):
    renderer, values = Renderer(bench), {**bench.values(), "analyzer.angle": 30.0}
    assert np.array_equal(renderer.stokes({**values, **DETECTOR}), renderer.stokes(values))


def test_derivatives_of_readings_alone_and_all_at_once(bench):
    """Of one variable, and of several in one long sweep, against the closed form."""
    model = table(bench, np.ones(len(DIAL)))
    variables = [Variable(k, (k,), model.parameters[k]) for k in (*DETECTOR, "analyzer.offset")]
    here = Values({**DETECTOR, "analyzer.offset": 3.0, "source.power": 2.0})
    a = np.radians(DIAL + 3.0)
    level = 1000 * 2 * 0.32 * np.cos(a) ** 2
    expected = {"camera.detector_q": level * np.cos(2 * a), "camera.detector_u": level * np.sin(2 * a)}
    for chosen in (variables, variables[:1], variables[1:2]):
        for (_, found), frame in zip(model.derivatives(here, chosen), model.frames):
            rows = frame.rows.ravel().astype(int)
            for v in chosen:
                if v.name in expected:
                    assert found[v.name].ravel() == pytest.approx(expected[v.name][rows], abs=2e-3)  # float32 of 640
    assert bench.can_express(bench.registry.find_effect("polarized detector"))


def test_scenes_without_films_and_cameras_with_analysers_have_no_such_effect(mitsuba):
    for name in ("gelsight", "polarization_camera"):
        scene = loader.load(name)
        assert not scene.can_express(scene.registry.find_effect("polarized detector")), name
    camera = loader.load("polarization_camera", {"width": 8, "height": 6})
    renderer, values = Renderer(camera), camera.values()
    assert np.array_equal(renderer.radiance({**values, **DETECTOR}), renderer.radiance(values))
