"""Forces on a half-space: it obeys the equations of elasticity, and a ball's contact is Hertz' and Sneddon's."""

import math

import numpy as np
import pytest

from optics.skin.forces import ball, ball_by_force, displacements, pressure_nodes, unit_displacements

E, NU = 0.7, 0.3


def stress(points, force):
    """(N, 3, 3) N/mm^2 of a point force at the origin, by Hooke's law from complex steps of the displacement."""
    gradient = np.empty((len(points), 3, 3))
    for j in range(3):
        step = points.astype(complex)
        step[:, j] += 1e-20j
        gradient[:, :, j] = (unit_displacements(step, E, NU) @ force).imag / 1e-20
    strain = (gradient + gradient.transpose(0, 2, 1)) / 2
    lame, shear = E * NU / ((1 + NU) * (1 - 2 * NU)), E / (2 * (1 + NU))
    return lame * np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 2 * shear * strain


@pytest.mark.parametrize("force", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.3, -0.5, 0.8)])
def test_every_plane_bears_the_force_and_no_bit_of_the_body_is_pulled(force):
    # a plane at the depth 2 mm: r = 2 sinh(t)-like nodes out to 2e5 mm, where 1e-5 of the force is left
    t, w = np.polynomial.legendre.leggauss(120)
    t, w = 6 * (t + 1), 6 * w
    angle = 2 * np.pi * np.arange(16) / 16
    r = np.sinh(t)
    points = np.stack(
        [np.outer(r, np.cos(angle)).ravel(), np.outer(r, np.sin(angle)).ravel(), np.full(r.size * 16, 2.0)], -1
    )
    area = np.repeat(w * r * np.cosh(t) * 2 * np.pi / 16, 16)
    borne = (stress(points, np.array(force))[:, :, 2] * area[:, None]).sum(0)
    np.testing.assert_allclose(borne, -np.array(force), atol=5e-5)  # what lies beyond the last node, and float sums

    inside, h = np.array([[0.4, -0.7, 0.9], [2.0, 1.0, 0.3]]), 1e-4
    pull = sum(
        (stress(inside + h * np.eye(3)[j], np.array(force)) - stress(inside - h * np.eye(3)[j], np.array(force)))[
            :, :, j
        ]
        for j in range(3)
    ) / (2 * h)
    np.testing.assert_allclose(pull, 0, atol=1e-6)  # central differences: h^2 of a third derivative
    free = stress(np.array([[0.8, 0.5, 0.0]]), np.array(force))[0, :, 2]
    np.testing.assert_allclose(free, 0, atol=1e-12)


def test_a_ball_is_hertzs_for_small_contacts():
    radius, e_star = 6.0, E / (1 - NU**2)
    depth = 0.1**2 * radius  # contact radius a tenth of the ball's
    contact = ball(depth, radius)
    # the ball is no paraboloid: the next term of Sneddon's series is (a/R)^2 / 3 and less
    assert contact.a == pytest.approx(math.sqrt(radius * depth), rel=0.005)
    assert contact.force(E, NU) == pytest.approx(4 / 3 * e_star * math.sqrt(radius) * depth**1.5, rel=0.01)
    assert ball_by_force(contact.force(E, NU), radius, E, NU).depth == pytest.approx(depth, rel=1e-9)
    a = contact.a
    r = np.array([1.5, 3.0]) * a  # Johnson (3.42a): the face outside of Hertz' pressure
    hertz = depth / np.pi * ((2 - (r / a) ** 2) * np.arcsin(a / r) + np.sqrt((r / a) ** 2 - 1))
    np.testing.assert_allclose(contact.face(r), hertz, rtol=0.005)
    # the axis below: Johnson (3.41)-like, from the superposed pressure, against a quadrature of Hertz' own
    h = np.array([0.5, 1.0, 3.0]) * a
    q, w = np.polynomial.legendre.leggauss(60)
    q, w = (q + 1) / 2 * a, w / 2 * a
    p = 3 * contact.force(E, NU) / (2 * np.pi * a**2) * np.sqrt(1 - (q / a) ** 2)
    rho = np.hypot(q, h[:, None])
    below = (1 + NU) / (2 * np.pi * E) * (h[:, None] ** 2 / rho**3 + 2 * (1 - NU) / rho)
    expected = (below * p * 2 * np.pi * q * w).sum(-1)
    found = displacements(np.stack([0 * h, 0 * h, h], -1), *contact.nodes(E, NU), E, NU)
    np.testing.assert_allclose(found[:, 2], expected, rtol=0.01)
    np.testing.assert_allclose(found[:, :2], 0, atol=1e-12)


@pytest.mark.parametrize("depth", [0.2, 2.0])
def test_a_deep_ball_bears_what_its_rings_bear_and_its_nodes_move_beads_as_fine_ones(depth):
    contact = ball(depth, 0.6)
    c, d = contact._rings()
    assert contact.stiff_force() == pytest.approx((2 * c * d).sum(), rel=1e-10)
    assert d.sum() == pytest.approx(depth, rel=1e-10)
    # just outside, the face is where just inside is: the ball's own edge. sqrt(1e-8) is its steepness there
    assert contact.face(contact.a * (1 + 1e-8)) == pytest.approx(contact.face(contact.a), abs=2e-3)
    places, forces = contact.nodes(E, NU, (0.2, 0.0))
    assert forces.sum(0) == pytest.approx(contact.force(E, NU) * np.array([0.2, 0, 1]), rel=1e-12)
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.uniform(-4, 4, (50, 2)), rng.uniform(1.2, 5, (50, 1))], -1)
    t, w = np.polynomial.legendre.leggauss(40)
    t, w = (t + 1) / 2, w / 2
    angle = 2 * np.pi * np.arange(48) / 48
    r = (c[:, None] * np.sqrt(1 - t**2)).ravel()
    weight = ((2 * c * d)[:, None] * w).ravel() * E / (1 - NU**2) / 48
    fine = np.stack([np.outer(r, np.cos(angle)), np.outer(r, np.sin(angle))], -1).reshape(-1, 2)
    loads = np.repeat(weight, 48)[:, None] * np.array([0.2, 0, 1])
    expected = displacements(points, fine, loads, E, NU)
    # at twice the contact radius: (a/R)^12 of the angles, (a/R)^16 of the radii
    np.testing.assert_allclose(
        displacements(points, places, forces, E, NU), expected, atol=2e-4 * np.abs(expected).max()
    )


def test_bad_loads_are_refused():
    points = [[0.0, 0.0, 1.0]]
    with pytest.raises(ValueError, match="lifts the skin off"):
        displacements(points, [[0.0, 0.0]], [[0.0, 0.0, -1.0]], E)
    with pytest.raises(ValueError, match="below the face"):
        displacements([[0.0, 0.0, -1.0]], [[0.0, 0.0]], [[0.0, 0.0, 1.0]], E)
    with pytest.raises(ValueError, match="lifts the skin off"):
        ball_by_force(-1.0, 0.6, E)
    with pytest.raises(ValueError, match="lift off"):
        pressure_nodes(np.full((3, 3), -1.0), 0.1)


def test_a_layer_on_a_rigid_base_obeys_its_boundary_conditions_and_the_equations_inside():
    """Half-space and correction together, by central differences: nothing moves at the base, no stress on the face
    beside the load, no net force on a bit of the body; and a thick layer is a half-space."""
    from optics.skin.layer import base_correction

    t, rings = 3.0, (np.array([0.0]), np.array([1.0]))

    def field(points, thickness=t):
        place, force = np.zeros((1, 2)), np.array([[0.0, 0.0, 1.0]])
        return displacements(points, place, force, E, NU) + base_correction(points, *rings, 1.0, E, NU, thickness)

    base = np.array([[0.0, 0.0, t], [1.0, 0.5, t], [-4.0, 2.0, t]])
    below = displacements(base, np.zeros((1, 2)), np.array([[0.0, 0.0, 1.0]]), E, NU)
    assert np.abs(below).max() > 0.2
    np.testing.assert_allclose(field(base), 0, atol=1e-5)

    def gradient(at, h=2e-3):
        steps = h * np.eye(3)
        return np.stack([(field(at + s) - field(at - s)) / (2 * h) for s in steps], -1)

    def stresses(at):
        g = gradient(at)
        lame, shear = E * NU / ((1 + NU) * (1 - 2 * NU)), E / (2 * (1 + NU))
        strain = (g + g.transpose(0, 2, 1)) / 2
        return lame * np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 2 * shear * strain

    face = np.array([[1.5, 0.7, 2.5e-3], [0.0, 3.0, 2.5e-3]])
    scale = np.abs(stresses(np.array([[1.5, 0.7, 1.0]]))).max()
    # 2.5e-3 mm below the face: so much of the stress per mm, and the steps' square
    np.testing.assert_allclose(stresses(face)[:, :, 2], 0, atol=0.01 * scale)
    inside, h = np.array([[1.0, 0.4, 1.2], [0.3, -2.0, 2.2]]), 0.02
    pull = sum((stresses(inside + h * e) - stresses(inside - h * e))[:, :, j] for j, e in enumerate(np.eye(3))) / (
        2 * h
    )
    np.testing.assert_allclose(pull, 0, atol=5e-3 * scale)  # h^2 of a third derivative of a field that bends in 1 mm
    thick = base_correction(inside, *rings, 1.0, E, NU, 300.0)
    assert np.abs(thick).max() < 0.02 * np.abs(field(inside)).max()
