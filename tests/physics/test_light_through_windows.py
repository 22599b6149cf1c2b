"""Light of an LED through flat interfaces (optics.light.windows): against rays that obey Snell's law, in closed form on
the axis, and in images of beads behind a base of another index."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

LAMP = np.array([3.0, 1.0, -20.0])
PLACES = np.array([[0.0, 0.0, -1.0], [2.0, 1.0, -2.0], [5.0, -3.0, -0.5], [9.0, 4.0, -3.0], [3.0, 1.0, -1.0]])
FACES = ((-6.0, 1.49), (-4.5, 0.94))  # where, and the index over that before


@pytest.fixture(scope="module")
def seen(mitsuba):
    """What `seen_through` gives for interfaces (z, index): unit vectors to the LED here and where the light leaves it,
    (N, 3), 1/d^2 and T."""
    import drjit as dr
    import mitsuba as mi

    from optics.light.windows import seen_through

    def of(faces, places=PLACES):
        shapes = [
            mi.load_dict(
                {
                    "type": "rectangle",
                    "to_world": mi.ScalarTransform4f().translate([0, 0, z]).rotate([1, 0, 0], 180).scale(40),
                    "bsdf": {"type": "interface", "index": index},
                }
            )
            for z, index in faces
        ]
        point = mi.Point3f(*(mi.Float(c) for c in places.T.astype(np.float32)))
        lamp = SimpleNamespace(kappa=lambda it, to, d: 1 / dr.square(d), radiance=lambda it, to, d: to)
        led, at = seen_through(point, lamp, mi.Point3f(*map(float, LAMP)), shapes)
        to = at - point
        distance = dr.norm(to)
        return (
            np.array(to / distance).T,
            np.array(led.radiance(None, None, distance) / led.passed).T,
            np.array(led.kappa(None, None, distance) / led.passed),
            np.array(led.passed),
        )

    return of


def landed(direction, place, across, faces):
    """Where a ray from the lamp, refracted at the interfaces, meets the plane through a place and across a
    direction."""
    at, way, n = LAMP, direction / np.linalg.norm(direction), 1.0
    sine = way[:2].copy()
    for z, index in faces:
        at = at + way * (z - at[2]) / way[2]
        n *= index
        way = np.array([*(sine / n), math.sqrt(1 - sine @ sine / n**2)])
    return at + way * ((place - at) @ across) / (way @ across)


@pytest.mark.parametrize("faces", [FACES, FACES[:1], ((-4.5, 0.8),)])
def test_rays_that_leave_it_so_arrive_and_spread_so(seen, faces):
    """The ray along `out` meets the point; four beside it tell the area that a solid angle lights."""
    to, out, brightness, passed = seen(faces)
    for place, arrives, leaves, found in zip(PLACES, to, out, brightness):
        assert np.linalg.norm(landed(-leaves, place, arrives, faces) - place) < 1e-5  # float32 at 20 mm
        one = np.cross(leaves, [0.3, 0.8, 0.5])
        one /= np.linalg.norm(one)
        step = 1e-5
        wide = [
            (landed(-leaves + step * d, place, arrives, faces) - landed(-leaves - step * d, place, arrives, faces))
            / (2 * step)
            for d in (one, np.cross(leaves, one))
        ]
        assert found == pytest.approx(1 / np.linalg.norm(np.cross(*wide)), rel=2e-5)
    assert np.all((passed > 0.9) & (passed < 1))


def test_on_the_axis_it_stands_at_the_apparent_depth(seen):
    """d = sum of t_i/n_i, and T = 4 n/(n + 1)^2 at each interface."""
    to, out, brightness, passed = seen(FACES)
    n = np.cumprod([1.0, 1.49, 0.94])
    depth = np.array([14.0, 1.5, 3.5]) / n
    assert to[-1] == pytest.approx([0, 0, -1]) and out[-1] == pytest.approx([0, 0, -1])
    assert brightness[-1] == pytest.approx(depth.sum() ** -2, rel=1e-6)
    assert passed[-1] == pytest.approx(np.prod([4 * r / (r + 1) ** 2 for r in (1.49, 0.94)]), rel=1e-6)


def test_beyond_the_angle_of_total_reflection_nothing_is_lost_of_the_rest(seen):
    """From a dense base into a thin gel light runs at 90 deg at most: far aside it grazes, and its share falls to 0."""
    far = np.array([[3.0 + x, 1.0, -4.4] for x in (1.0, 10.0, 30.0)])
    _, out, brightness, passed = seen(((-4.5, 0.8),), far)
    sine = np.linalg.norm(out[:, :2], axis=1)
    assert np.all(np.diff(sine) > 0) and np.all(sine <= 0.8) and np.isfinite(brightness).all()
    assert np.all(np.diff(passed) < 0) and passed[-1] < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("key, step", [("inner_ring.x", 0.05), ("inner_ring.z", 0.05), ("base.index", 0.002)])
def test_derivatives_behind_a_base_of_another_index(key, step, mitsuba):
    """Against central differences, of beads that no outline crosses: shading alone."""
    from optics.fit.scene_model import SceneModel
    from optics.proof.cells import Cell
    from optics.proof.makers.particle import CAMERA
    from optics.proof.rigs.particle import ParticleGel
    from optics.scene.parameter import Values, Variable

    rig = ParticleGel()
    captures = rig.captures(Cell(rig.name, "none", (), 0.0, 0.0, "same", "", 0), {}, {}, mean=True)
    model = SceneModel(rig.scene(), captures, CAMERA)
    values = Values({**rig.built(rig.scene(), 0), "base.index": 1.2})
    variable = Variable(key, (key,), model.parameters[key])
    ((_, images),) = model.derivatives(values, [variable], [0])
    here = model.at(values, 0)[key]
    sides = []
    for sign in (1, -1):
        there = values.copy()
        there.common[key] = here + sign * step
        sides.append(model.predict(there, [0])[0])
    expected = (sides[0] - sides[1]) / (2 * step)
    found = images[key]
    calm = np.abs(found - expected) < 0.05 * np.abs(expected).max()
    assert np.abs(expected).max() > 0.1 and calm.mean() > 0.9
    assert (found * expected)[calm].sum() / (expected**2)[calm].sum() == pytest.approx(1, abs=0.02)
