"""Features of presses: projected ones against the scene built again for each press, tables against each bead alone,
measured ones from images through the command line."""

import json
import re

import numpy as np
import pytest

from optics.readers import flow

JOB = """scene = "particle_gel"
out = "images"
seed = 4
outputs = ["dn"]
layers = []
[defines]
width = 90
height = 80
beads = 700
detail = 1
x_fov = {fov}
[parameters]
"gel.stiff_base" = {base}
[sample]
"gel.press_x" = {{ grid = {x} }}
"gel.press_depth" = {{ grid = {depth} }}
[noise]
system_gain = 0.1
dark_noise = 1.0
black_level = 0.0
saturation = 255.0
prnu = 0.0
"""


@pytest.fixture
def job(mitsuba, tmp_path):
    def write(name="job", base=1.0, x=(-2.0, 1.5), depth=(0.5, 1.5), fov=60):
        file = tmp_path / f"{name}.toml"
        file.write_text(JOB.format(base=base, x=list(x), depth=list(depth), fov=fov))
        return file

    return write


def test_projected_features_are_those_of_the_scene_built_again(job):
    """Beads moved by the scene itself, pixels by pixel, through the reader's own binning."""
    from scipy.spatial import cKDTree

    from optics.scene import loader
    from optics.study.force_data import project

    found = project(job(), [("dense", 5), ("sparse", 5)])
    defines = {"width": "90", "height": "80", "beads": "700", "detail": "1", "x_fov": "60"}
    scene = loader.load("particle_gel", defines)
    scene.set({"gel.stiff_base": 1.0})
    rest = scene.parts["beads"].centres()
    start = scene.camera.project(rest)
    # the nearest bead along each pixel's ray, by the formula of a ball
    import mitsuba as mi

    places = flow.pixel_middles((80, 90)).astype("f")
    o, d = (np.array(a, float).T for a in scene.camera.ray(mi.Float(places[:, 0]), mi.Float(places[:, 1])))
    along = np.einsum("pj,nj->pn", d, rest - o[0])
    off2 = ((rest - o[0]) ** 2).sum(1) - along**2
    hit = np.where(off2 < 0.275**2, along - np.sqrt(np.maximum(0.275**2 - off2, 0)), np.inf)
    first = np.where(np.isfinite(hit.min(1)), hit.argmin(1), -1)
    u, v = start.astype(int).T
    inside = (start >= 0).all(1) & (u < 90) & (v < 80)
    free = np.nonzero(inside)[0][first.reshape(80, 90)[v[inside], u[inside]] == np.nonzero(inside)[0]]
    lit = np.nonzero(first >= 0)[0]
    filled = first[lit[cKDTree(places[lit]).query(places)[1]]]
    for k, (x, depth) in enumerate(((-2.0, 0.5), (-2.0, 1.5), (1.5, 0.5), (1.5, 1.5))):
        scene.set({"gel.press_x": x, "gel.press_depth": depth})
        moved = scene.camera.project(scene.parts["beads"].centres()) - start
        for kind, at, motion in (("dense", places, moved[filled]), ("sparse", start[free], moved[free])):
            one = found[kind, 5]
            # outlines of 80 faces: one bead of the dozen in a bin may show in one account and not in the other
            few = 0.06 * np.abs(moved).max()
            size, angle, count = flow.bin_means(at, motion, (80, 90), 5)
            np.testing.assert_allclose(one.size[k], size, atol=few)
            np.testing.assert_allclose(one.motion[k], flow.bin_vectors(at, motion, (80, 90), 5), atol=few)
            clear = (count > 0) & (0.7 * size < np.hypot(*one.motion[k].T).T) & (size > 0.2 * size.max())
            turn = np.angle(np.exp(1j * (one.angle[k] - angle)))
            assert clear.sum() > 3 and np.abs(turn[clear]).max() < 0.1
        np.testing.assert_allclose(one.place[k], [x, 0.0])
        assert one.force[k] == pytest.approx(scene.gel.force()[2], rel=1e-6)
    assert found["dense", 5].face == (30.0, 30.0)


@pytest.mark.parametrize("base", (0.0, 1.0))
def test_the_table_of_a_press_is_true_to_a_ten_thousandth(job, base):
    """As wide as the face is, at places between its knots; 4 of 13 presses."""
    from optics.study import batch, force_data

    file = job(base=base, x=np.linspace(-13.5, 13.5, 13).round(3).tolist(), depth=[1.7])
    read = batch.read(file)
    sensor = force_data.Sensor(batch.Maker(read, file, None))
    samples = [{**sensor.base, **read.values(i)} for i in range(13)]
    carried, alone = force_data.Carried(sensor, samples), force_data.Carried(sensor, samples[:1])
    assert carried.often and not alone.often
    for values in samples[::4]:
        place, _ = sensor.hold(values)
        exact, found = alone(values, place), carried(values, place)
        assert len(carried.tables) == 1
        assert np.abs(found - exact).max() < 1e-4 * np.abs(exact - sensor.rest).max()
    # a press by force is at rest without it
    pushed = force_data.Sensor(
        batch.Maker(read.model_copy(update={"parameters": {"gel.press_force": 0.1}}), file, None)
    )
    np.testing.assert_array_equal(pushed.rest, sensor.rest)
    assert pushed.hold(pushed.values)[1] == pytest.approx(0.1)
    assert np.abs(pushed.beads.centres() - pushed.rest).max() == 0
    # a drag is not the same all around: each bead is computed
    dragged = {**samples[3], "gel.drag_x": 0.5}
    place, _ = sensor.hold(dragged)
    np.testing.assert_array_equal(
        force_data.Carried(sensor, [dragged] * 20)(dragged, place), sensor.gel.carry(*(sensor.rest * [1, 1, -1]).T)
    )


def test_layouts_are_drawn_anew_for_presses_of_every_depth(job):
    from optics.study.force_data import project

    file = job(x=np.linspace(-5, 5, 12).round(3).tolist(), depth=[0.5, 1.5])
    one, two = (project(file, [("dense", 4)], range(n))["dense", 4] for n in (1, 2))
    other = np.abs(one.motion - two.motion).reshape(24, -1).max(1) > 1e-6
    for depth in (0, 1):  # the depth turns fastest
        assert 0 < other[depth::2].sum() < 12
    assert two.source["bead_seeds"] == [0, 1]
    np.testing.assert_array_equal(one.force, two.force)


@pytest.mark.slow
def test_from_a_job_to_metrics_on_the_command_line(job, optics, tmp_path, monkeypatch):
    """Images of a batch, their flow, a map trained on projected presses, its metrics; then what is refused."""
    pytest.importorskip("cv2")
    monkeypatch.chdir(tmp_path)
    job("images", 0.0, (-2.0, 1.5), (1.5,), 30)
    job("presses", 0.0, np.linspace(-4, 4, 12).round(3).tolist(), (0.8, 1.5), 30)
    code, _, err = optics("force-features", "images.toml", "-o", "seen")
    assert code == 2 and "make them with optics batch" in err, err
    assert optics("batch", "images.toml", "--workers", "1")[0] == 0
    seen = optics("force-features", "images.toml", "-o", "seen", "--bins", "6")
    told = optics("force-features", "images.toml", "-o", "told", "--bins", "6", "--project")
    assert seen[0] == told[0] == 0 and "2 presses" in seen[1] and "ms an image" in seen[1], seen
    assert sorted(p.name for p in (tmp_path / "seen").iterdir()) == ["dense-6.npz", "sparse-6.npz"]
    from optics.readers.force_learning import FeatureSet

    for flow_kind in ("dense", "sparse"):
        measured, true = (FeatureSet.read(tmp_path / f / f"{flow_kind}-6.npz").motion for f in ("seen", "told"))
        # flow is drawn towards that of its surroundings, and errs; without a press it would be 0, and the error 1
        error = np.linalg.norm(measured - true) / np.linalg.norm(true)
        assert error < 0.6 and np.vdot(measured, true) > 0.6 * np.vdot(true, true), error
    assert optics("force-features", "presses.toml", "-o", "p", "--bins", "6", "--project")[0] == 0
    code, out, _ = optics("force-train", "p/dense-6.npz", "-o", "m.npz", "--kind", "linear", "--bins", "3", "--json")
    assert code == 0 and json.loads(out)["results"][0]["presses"] == 4
    code, out, _ = optics("force-test", "m.npz", "seen/dense-6.npz", "told/dense-6.npz")
    assert code == 0 and "RMSE_mc" in out and out.count("dense-6.npz") == 2, out
    for words, said in (
        ("force-features images.toml -o seen --bins 6", "exists; choose another name, or --force"),
        ("force-features images.toml -o new --bins 500", "1 to 200 bins each way"),
        ("force-features images.toml -o new --bead-seeds 3", "without --project"),
        ("force-train p/dense-6.npz -o n.npz --kind deep", "allowed: published, linear, scaled"),
        ("force-train m.npz -o n.npz --kind linear", "not a file of optics force-features|is missing"),
        ("force-test p/dense-6.npz seen/dense-6.npz", "optics force-train"),
        ("force-tables --poisson 0.7", "allowed: 0 to 0.5"),
        ("force-tables -o x.gif", "allowed: a name ending in .png"),
    ):
        code, _, err = optics(*words.split())
        assert code == 2 and re.search(said, err) and err.count("\n") == 1, (words, err)
    file = job("lit")
    file.write_text(file.read_text().replace("[noise]", '"camera.exposure" = { uniform = [30, 40] }\n[noise]'))
    code, _, err = optics("force-features", "lit.toml", "-o", "o", "--project")
    assert code == 2 and "camera.exposure; presses are projected of one sensor" in err, err
    (tmp_path / "other.toml").write_text('scene = "gelsight"\nout = "o"\ncount = 12\n')
    code, _, err = optics("force-features", "other.toml", "-o", "o", "--project")
    assert code == 2 and "a scene like particle_gel" in err, err
