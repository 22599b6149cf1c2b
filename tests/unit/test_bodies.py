"""Places of many bodies: the elimination of a sparse problem, colours, tables; and beads of an independent maker."""

from types import SimpleNamespace

import numpy as np
import pytest

from optics.fit.bodies import _Equations, _Problem, refine
from optics.scene.parameter import Values
from optics.skin.cloud import read_places, write_places


@pytest.fixture
def equations():
    """12 bodies in 300 values, four of which share some of their values, beside two parameters."""
    from scipy.sparse import csr_matrix

    rng = np.random.default_rng(0)
    j = np.zeros((300, 36))
    for body in range(12):
        j[20 * body : 20 * body + 30, 3 * body : 3 * body + 3] = rng.normal(size=(30, 3))
    k, r = rng.normal(size=(300, 2)), rng.normal(size=300)
    axes = rng.normal(size=(12, 3, 3))
    problem = SimpleNamespace(
        prior=(2.0, 0.7), axes=axes, variables=[], model=None, pixels=[], of_priors=lambda points: 0.0
    )
    points = rng.normal(size=(12, 3))
    found = _Equations.__new__(_Equations)
    import optics.fit.bodies as module

    keep, module.prior_terms = module.prior_terms, lambda *_: (np.zeros(2), np.zeros(2), 0.0)
    try:
        found.__init__(problem, csr_matrix(j), k, r, points, Values())
    finally:
        module.prior_terms = keep
    slope = np.zeros((12, 36))
    for body in range(12):
        slope[body, 3 * body : 3 * body + 3] = -axes[body, :, 2] / 0.7
    whole = np.vstack([np.hstack([j, k]), np.hstack([slope, np.zeros((12, 2))])])
    right = np.concatenate([r, -(-points[:, 2] - 2.0) / 0.7])
    return found, whole, right, axes


def test_eliminating_the_bodies_solves_the_whole(equations):
    found, whole, right, _ = equations
    x, z, promised = found.step(0.0)
    step = np.linalg.lstsq(whole, right, rcond=None)[0]
    assert promised == pytest.approx(right @ right - np.sum((right - whole @ step) ** 2))
    np.testing.assert_allclose(np.concatenate([x, z]), step, rtol=1e-8, atol=1e-10)


def test_errors_are_those_of_the_whole(equations):
    found, whole, _, axes = equations
    covariance = np.linalg.inv(whole.T @ whole)
    own, sd = found.errors()
    np.testing.assert_allclose(sd, np.sqrt(np.diag(covariance))[36:], rtol=1e-8)
    for body in range(12):
        block = covariance[3 * body : 3 * body + 3, 3 * body : 3 * body + 3]
        np.testing.assert_allclose(own[body], axes[body].T @ block @ axes[body], rtol=1e-8)


def test_no_two_bodies_of_a_colour_meet():
    rng = np.random.default_rng(3)
    outlines = [np.column_stack([rng.uniform(0, 60, (80, 2)), rng.uniform(2, 5, 80)]) for _ in range(2)]
    colours = _Problem._coloured(SimpleNamespace(outlines=outlines))
    assert sorted(np.concatenate(colours)) == list(range(80))
    assert len(colours) < 25
    for one in outlines:
        for colour in colours:
            apart = np.linalg.norm(one[colour, None, :2] - one[None, colour, :2], axis=-1)
            reach = one[colour, None, 2] + one[None, colour, 2]
            assert (apart + 1e9 * np.eye(len(colour)) >= reach).all()


def test_a_table_of_places_comes_back(tmp_path):
    points, diameters = np.array([[1.0, -2.0, -0.5], [0.25, 3.0, -4.0]]), np.array([0.5, 0.6])
    write_places(tmp_path / "a.csv", points, diameters)
    one, sizes = read_places(tmp_path / "a.csv")
    np.testing.assert_allclose(one, points)
    np.testing.assert_allclose(sizes, diameters)
    write_places(tmp_path / "b.csv", points)
    assert read_places(tmp_path / "b.csv")[1] is None


@pytest.mark.parametrize(
    "text, said",
    [
        ("1,2,3\n", "the first line is '1,2,3'"),
        ("x,y,depth\n1,2\n", "line 2: '1,2'"),
        ("x,y,depth\n1,2,nan\n", "line 2: '1,2,nan'"),
        ("x,y,depth,diameter\n1,2,3,-0.5\n", "line 2: diameter = -0.5 mm"),
        ("x,y,depth\n", "has no bead"),
    ],
)
def test_a_table_that_is_none_is_refused(tmp_path, text, said):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(ValueError, match="allowed") as error:
        read_places(tmp_path / "a.csv")
    assert said in str(error.value)


def test_a_bead_is_in_doubt_by_noise_and_by_the_others():
    """Twice what noise leaves, and twice what others leave where a scene is wrong everywhere."""
    from optics.fit.sought import in_doubt

    assert in_doubt(np.array([0.5, 0.53, 0.6, 1.2])).tolist() == [False, False, False, True]
    assert in_doubt(np.array([0.1, 0.1, 0.3])).tolist() == [False] * 3
    assert in_doubt(np.array([2.0, 2.1, 2.5, 4.7])).tolist() == [False, False, False, True]
    assert in_doubt(np.zeros(0)).tolist() == []


def test_a_step_leaves_no_bead_outside_the_skin():
    """Two beads of 0.6 mm, a step of 0.2 mm up: one would stick out of the face, under which the skin's motion ends."""
    problem = object.__new__(_Problem)
    problem.axes = np.tile(np.eye(3), (2, 1, 1))
    problem.part = SimpleNamespace(balls=lambda: (np.zeros((2, 3)), np.array([0.3, 0.3])))
    found = problem.moved(np.array([[0.0, 0.0, -0.4], [1.0, 0.0, -2.0]]), np.array([0.1, 0.0, 0.2, 0.0, 0.1, 0.2]))
    np.testing.assert_allclose(found, [[0.1, 0.0, -0.3], [1.0, 0.1, -1.8]])


@pytest.fixture
def fourteen(mitsuba):
    """Beads by the numpy maker, at rest and under one press: true values, true places, and a model of any table."""
    from optics.fit.scene_model import SceneModel
    from optics.proof.makers.particle import CAMERA, ParticleMaker
    from optics.proof.rigs.particle import ParticleGel
    from optics.scene import loader

    rig = ParticleGel()
    rig.defines = {**rig.defines, "beads": "14", "fine": "4"}
    scene = rig.scene()
    built = rig.built(scene, 0)
    maker = ParticleMaker(scene, built, {}, CAMERA, 5)
    captures = maker.captures([(0.0, 0.0, 0.0), (2.0, -1.5, 0.6)])
    captures.parameters.update({k: built[k] for k in ("camera.x_fov", "dye.yield")})

    def model(table):
        return SceneModel(loader.load("particle_gel", {**rig.defines, "places": str(table)}), captures, CAMERA)

    return built, maker.rest(), model


@pytest.mark.slow
def test_places_and_parameters_come_back_with_their_errors(fourteen, tmp_path):
    """Fourteen beads, started 0.08 mm aside and half a millimetre too deep or too high."""
    from optics.fit.calibrate import variables_from

    built, truth, opened = fourteen
    start = truth + np.random.default_rng(0).normal(0, [0.08, 0.08, 0.5], truth.shape)
    write_places(tmp_path / "start.csv", start)
    model = opened(tmp_path / "start.csv")
    variables = variables_from(model, ["*_ring.power"])
    fit = refine(model, "beads", variables, depth_prior=(2.25, 0.92))
    pulls = (fit.points - truth) / fit.errors
    # 14 numbers each: 1 +- 0.19, three times
    assert np.all(np.abs(np.sqrt((pulls**2).mean(0)) - 1) < 0.6), pulls
    assert fit.chi2 / fit.dof < 1.05  # 12,244 values: 1 +- 0.013; both makers' samples at rims add 0.01
    for variable, sd in zip(variables, fit.sd):
        assert abs(fit.values.common[variable.name] - built[variable.name]) < 4 * sd, variable.name
    assert np.median(fit.errors[:, 2]) < 0.03 and np.median(fit.errors[:, :2]) < 0.005  # mm


@pytest.mark.slow
def test_beads_are_found_without_a_start(fourteen, tmp_path, monkeypatch):
    """The same fourteen, of which nothing is known but the layer that holds them: all are found, and no other."""
    from optics.study import located
    from optics.study.setup import Setup

    _, truth, opened = fourteen
    monkeypatch.setattr(located, "open_model", lambda setup: opened(setup.defines["places"]))
    found = located.locate(Setup(captures="session"), tmp_path / "beads.csv")
    fit = found.fit
    apart = np.linalg.norm(fit.points[:, None] - truth[None], axis=-1)
    nearest = apart.argmin(1)
    assert sorted(nearest) == list(range(14))
    assert apart.min(1).max() < 0.1  # mm, of beads of 1.2
    pulls = (fit.points - truth[nearest]) / fit.errors
    assert np.all(np.abs(np.sqrt((pulls**2).mean(0)) - 1) < 0.6), pulls  # 14 numbers each: 1 +- 0.19
    assert fit.chi2 / fit.dof < 1.05
    np.testing.assert_allclose(read_places(tmp_path / "beads.csv")[0], fit.points, atol=1e-6)


@pytest.mark.slow
def test_beads_that_overlap_are_found_one_behind_the_other(mitsuba, tmp_path):
    """64 beads as dense as the shipped scene's, which cover 0.8 of the image, by the numpy maker."""
    from optics.fit.calibrate import variables_from
    from optics.fit.scene_model import SceneModel
    from optics.fit.sought import Seeker
    from optics.proof.makers.particle import CAMERA, ParticleMaker
    from optics.scene import loader

    size = {"width": "76", "height": "76", "x_fov": "17", "beads": "64", "field": "4.4", "fine": "2", "seed": "7"}
    scene = loader.load("particle_gel", size)
    powers = {f"{name}.power": scene.values()[f"{name}.power"] * k for name, k in zip(scene.leds, (1.05, 0.93))}
    maker = ParticleMaker(scene, {**powers, "cover.sigma": 0.0}, {}, CAMERA, 1007, 6)
    captures = maker.captures([(0.0, 0.0, 0.0)])

    def reopen(points):
        write_places(tmp_path / "beads.csv", points)
        return SceneModel(
            loader.load("particle_gel", {**size, "places": str(tmp_path / "beads.csv")}), captures, CAMERA
        )

    seeker = Seeker(reopen, "beads", [0, 1], (0.4, 4.1), lambda m: variables_from(m, ["*_ring.power"]), Values())
    points, values = seeker.seek()
    apart = np.linalg.norm(points[:, None] - maker.rest()[None], axis=-1)
    assert (apart.min(0) < 0.1).sum() >= 32
    believed = ~seeker.doubtful(points, values)
    assert (apart.min(1)[believed] > 0.3).sum() <= 1 and believed.sum() >= 32
    assert (apart.min(1) > 0.3).sum() <= 0.2 * len(points)
    for name, true in powers.items():
        assert values.common[name] == pytest.approx(true, rel=0.02)
