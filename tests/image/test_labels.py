"""Labels of a press: forces against contact mechanics, pixels against the whole, markers against what a robot finds."""

import math

import numpy as np
import pytest

from optics.errors import BadScene, UnknownKey
from optics.light import labels
from optics.light.rendering import RenderJob
from optics.readers import markers as reader
from optics.scene import loader as scenes

FINGER = {"width": "160", "height": "120", "x_fov": "80", "analyzer": "90", "x": "1", "y": "0.5"}


def taken(name, defines, names, values=None):
    job = RenderJob(scenes.load(name, defines), labels=names, layers=("aov",))
    return job, job.take(values)


def test_forces_of_a_gel_on_its_window():
    """A ball on a bonded incompressible layer: Hertz times 1 + 1.133 x + 1.283 x^2 + 0.769 x^3 + 0.0975 x^4 with x =
    sqrt(R depth)/thickness (Dimitriadis et al., Biophys. J. 82 (2002) 2798)."""
    values = {"gel.indenter_size": 6.0, "gel.poisson": 0.5, "gel.young": 0.3}
    job, image = taken("gelsight", {"width": "64", "height": "48", "depth": "0.15"}, ("force", "pressure"), values)
    x = math.sqrt(6.0 * 0.15) / job.scene.gel.number("thickness")
    hertz = 4 / 3 * 0.3 / 0.75 * math.sqrt(6.0) * 0.15**1.5
    series = 1 + 1.133 * x + 1.283 * x**2 + 0.769 * x**3 + 0.0975 * x**4
    told = image.labels.numbers
    # 1.5 %: the ball is a paraboloid in the formula, depth/R = 1/40, and the series ends
    assert told["force"][2] == pytest.approx(hertz * series, rel=0.015)
    np.testing.assert_allclose(image.labels.arrays["force"].sum((0, 1)), told["force"], rtol=1e-12)
    pressed = image.channels["pressure.Y"]
    assert (
        pressed.max() <= image.labels.arrays["force"][..., 2].max() / np.diff(image.labels.arrays["x"])[0] ** 2 * 1.0001
    )
    assert ((pressed > 0) <= (image.channels["contact.Y"] >= 0)).all() and pressed.any()


@pytest.mark.slow
def test_pixels_add_up_to_the_force_and_the_drag():
    job, image = taken(
        "gelsight",
        {"width": "160", "height": "120", "depth": "0.6"},
        ("force", "pressure", "displacement", "height"),
        {"gel.shift_x": 3.0, "gel.friction": 0.5},
    )
    told, c = image.labels.numbers, image.channels
    position = job.renderer.hits(job.base | {"gel.press_depth": 0.6}).position
    area = np.abs(np.gradient(position[..., 0], axis=1) * np.gradient(position[..., 1], axis=0))
    # 4 %: pixels of 0.1 mm over a contact of 1 mm radius
    assert (c["pressure.Y"] * area).sum() == pytest.approx(told["force"][2], rel=0.04)
    assert told["force"][0] == pytest.approx(0.5 * told["force"][2], rel=1e-3)  # 3 mm slip all over
    inside = c["slip.Y"] > 0
    assert inside.any() and (c["traction.X"][inside] > 0).all()
    assert c["displacement.Z"].min() == pytest.approx(-0.6, rel=0.02)
    assert c["height.Z"].min() == pytest.approx(-0.6, rel=0.02)
    assert 0 < told["dent_difference"] < 0.1  # mm: a skirt of smoothing is no elastic one


@pytest.mark.slow
def test_markers_are_where_a_robot_finds_them():
    """Positions and motion of the labels against the centres that the reader finds in the rendered images."""
    names = ("markers", "force")
    scene = scenes.load("vi2tap", FINGER)
    job = RenderJob(scene, labels=names, layers=())
    rest = job.take({"skin.press_depth": 0.0})
    pressed = job.take({"skin.press_depth": 1.2, "skin.shift_x": 1.0})
    told = {k: np.array(v, float) for k, v in pressed.labels.numbers.items() if k.startswith("marker")}
    seen = np.isfinite(told["markers_at_rest"]).all(1)
    found = [reader.find(image.camera[..., 1]).centres for image in (rest, pressed)]
    nearest = [
        np.linalg.norm(told[key][seen][:, None] - centres, axis=-1)
        for key, centres in zip(("markers_at_rest", "markers"), found)
    ]
    whole = nearest[0].min(1) < 2.0  # px: those that the image's border does not cut
    assert whole.sum() >= 6
    motion = found[1][nearest[1].argmin(1)] - found[0][nearest[0].argmin(1)]
    off = np.abs(motion - told["marker_motion"][seen])[whole]
    # 0.1 px: what the reader resolves; a cap that tilts beside the press shows its wall, and its centroid follows
    assert np.median(off) < 0.1
    assert off.max() < 0.1 + 0.2 * np.abs(told["marker_motion"][seen][whole]).max()
    assert np.abs(told["marker_motion"][seen][whole]).max() > 1.0
    assert pressed.labels.numbers["force"][0] > 0


@pytest.mark.slow
def test_an_elastic_dent_is_the_skin_that_forces_are_of():
    """What is rendered, what is carried and what labels say are one skin; a geometric dent says how far it is off."""
    names = ("force", "displacement", "markers")
    small = {**FINGER, "width": "64", "height": "48", "depth": "2"}
    told = {}
    for dent in ("geometric", "elastic"):
        job, image = taken("vi2tap", {**small, "dent": dent}, names)
        told[dent] = image.labels.numbers
    assert told["elastic"]["force"] == told["geometric"]["force"] and told["elastic"]["force"][2] > 0.05
    assert told["geometric"]["dent_difference"] > 0.3  # mm: a skin that is held at its rim bends as a whole
    assert told["elastic"]["dent_difference"] < 1e-9
    skin, film = job.scene.gel, job.scene.parts["film_sheet"]
    x, y, press = np.array([1.0, 6.0]), np.array([0.5, -4.0]), (1.0, 0.5)
    import mitsuba as mi

    sheet = np.array(mi.traverse(job.scene.parts["film_sheet"])["vertex_positions"]).reshape(film.rows, film.columns, 3)
    grid = np.stack(np.meshgrid(*(np.linspace(-h, h, n) for h, n in ((24, film.columns), (21.5, film.rows)))), -1)
    near = [np.hypot(*(grid - place).transpose(2, 0, 1)).argmin() for place in zip(x, y)]
    at = grid.reshape(-1, 2)[near]
    moved = skin.touching().moved(*at.T, press, 2.5)
    np.testing.assert_allclose(sheet.reshape(-1, 3)[near], np.c_[at + moved[:2].T, -2.5 - moved[2]], atol=1e-5)
    assert moved[2].max() > 0.8


@pytest.mark.parametrize("lens", ["fisheye", "pinhole", "telecentric"])
def test_a_camera_is_turned_around_as_its_law_says(lens):
    if lens == "fisheye":
        camera = scenes.load("particle_gel", {"width": "96", "height": "96", "beads": "10"}).camera
    else:
        scene = scenes.load("gelsight", {"width": "96", "height": "96"})
        camera = scene.camera
        scene.set({"camera.telecentricity": 1.0 if lens == "telecentric" else 0.0})
    rng = np.random.default_rng(0)
    pixel = rng.uniform(5, 90, (40, 2))
    import mitsuba as mi

    origin, direction = (np.array(a).T for a in camera.ray(*(mi.Float(pixel[:, i].astype("f")) for i in (0, 1))))
    assert (np.ptp(direction, axis=0).max() < 1e-6) == (lens == "telecentric") == (np.ptp(origin, axis=0).max() > 1e-3)
    points = origin + rng.uniform(7.0, 20.0, (40, 1)) * direction
    found = labels.project(camera, points)
    whole = np.isfinite(found).all(1)
    assert whole.sum() > 20
    np.testing.assert_allclose(found[whole], pixel[whole], atol=0.02)  # px; rays are float32


def test_labels_that_a_scene_lacks_are_refused():
    scene = scenes.load("gelsight", {"width": "32", "height": "24"})
    with pytest.raises(BadScene, match="no label 'markers'"):
        RenderJob(scene, labels=("markers",))
    with pytest.raises(UnknownKey, match="did you mean 'force'"):
        labels.named(scene, "forces")
    assert labels.named(scene, "all") == ("force", "pressure", "displacement", "height", "pose")


def test_a_block_tells_its_force_and_where_its_target_stands():
    small = {"width": "8", "height": "6", "columns": "2", "rows": "2", "layers": "2", "distance": "-0.3"}
    found = labels.of(scenes.load("magictac", small), None, None, ("force", "pose"))
    assert found.numbers["force"][2] > 0 and found.numbers["pose"]["distance"] == pytest.approx(-0.3)
