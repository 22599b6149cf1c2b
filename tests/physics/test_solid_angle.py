"""Directions to a rectangle: even in solid angle, which is that of van Oosterom & Strackee; and the light of a panel
near a surface."""

import numpy as np
import pytest

NEAR = [(1.3, 2.2, 3.5), (5, 5, 5), (0, 0, 0), (4.2, 3.6, 0.5), (1, 2, 3.05), (30, 2, 1)]
FAR = (80.0, 90.0, 40.0)  # less than 1e-3 sr: points of the area


@pytest.fixture
def shape(mitsuba):
    mi = mitsuba
    return mi.load_dict(
        {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([1, 2, 3]).rotate([0.6, 0.8, 0], 40).scale([2.5, 1, 1]),
        }
    )


def corners(shape):
    import mitsuba as mi

    return np.array(
        [
            np.ravel(np.array(shape.sample_position(mi.Float(0), mi.Point2f(*at)).p))
            for at in ((0, 0), (1, 0), (1, 1), (0, 1))
        ],
        float,
    )


def triangle(a, b, c):
    """Solid angle of a triangle, from the origin (van Oosterom & Strackee, IEEE Trans. Biomed. Eng. 30, 125 (1983), eq.
    8)."""
    la, lb, lc = (np.linalg.norm(v) for v in (a, b, c))
    over = la * lb * lc + a @ b * lc + a @ c * lb + b @ c * la
    return 2 * abs(np.arctan2(a @ np.cross(b, c), over))


@pytest.mark.parametrize("place", [*NEAR, FAR])
def test_the_solid_angle_and_even_directions(shape, place):
    import drjit as dr
    import mitsuba as mi

    from optics.light.solid_angle import Rectangle

    side = 400
    u = (np.arange(side) + 0.5) / side
    sample = mi.Point2f(mi.Float(np.tile(u, side)), mi.Float(np.repeat(u, side)))
    point, omega = Rectangle.of(shape).seen(mi.Point3f(*place) + dr.zeros(mi.Point3f, side**2), sample)
    at, omega = corners(shape) - place, np.array(omega)
    expected = triangle(at[0], at[1], at[2]) + triangle(at[0], at[2], at[3])
    assert omega.mean() == pytest.approx(expected, rel=1e-3 if place == FAR else 1e-4 + 2e-6 / expected)
    if place == FAR:
        return
    assert np.ptp(omega) == 0
    to = np.array(point).T - np.array(place)
    ways = to / np.linalg.norm(to, axis=1)[:, None]
    # the mean direction times Omega is half of the sum of the sides' arcs, each along its plane's normal (Lambert's
    # formula)
    lit = np.zeros(3)
    for a, b in zip(at, np.roll(at, -1, 0)):
        across = np.cross(a, b)
        lit += np.arctan2(np.linalg.norm(across), a @ b) * across / np.linalg.norm(across) / 2
    lit *= np.sign(lit @ ways.mean(0))
    np.testing.assert_allclose(ways.mean(0) * omega[0], lit, atol=2e-4 * expected)
    # and every point is of the rectangle
    inside = np.linalg.lstsq(np.stack([at[1] - at[0], at[3] - at[0]], 1), (to - at[0]).T, rcond=None)[0]
    assert inside.min() > -1e-4 and inside.max() < 1 + 1e-4


def test_what_is_no_rectangle(mitsuba):
    mi = mitsuba
    from optics.light.solid_angle import Rectangle

    sheared = mi.ScalarTransform4f([[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    assert Rectangle.of(mi.load_dict({"type": "rectangle", "to_world": sheared})) is None
    assert Rectangle.of(mi.load_dict({"type": "disk"})) is None
