"""Elastic contact on a grid against closed forms (Hertz, flat punch, thin layer, Cattaneo and Mindlin, twist), and a
skin with a stiff film against finite elements."""

import math

import numpy as np
import pytest

from optics.skin import forces
from optics.skin.contact import local_axis, surface
from optics.skin.pressing import drag, press
from optics.skin.stack import Layer, fields, half_space, response

YOUNG = 0.3  # N/mm^2
K = np.array([0.01, 0.1, 1.0, 5.0, 30.0])  # 1/mm


def paraboloid(depth, radius, nodes=65, wide=1.15):
    """(overlap, pitch, contact radius of Hertz) of a ball near its lowest point."""
    a = math.sqrt(radius * depth)
    axis = local_axis(nodes, 2 * wide * a / (nodes - 1))
    return depth - (axis**2 + axis[:, None] ** 2) / (2 * radius), axis[1] - axis[0], a


def deep(poisson):
    return (Layer(math.inf, YOUNG, poisson),)


# -- Layers ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("poisson", [0.3, 0.5])
def test_a_layer_on_a_rigid_base_meets_its_closed_form(poisson):
    layer, kt, a = Layer(2.0, YOUNG, poisson), 2 * K, 3 - 4 * poisson
    found = response(K, (layer,))
    down = (a * np.sinh(2 * kt) - 2 * kt) / (a * np.cosh(2 * kt) + 2 * kt**2 + 5 - 12 * poisson + 8 * poisson**2)
    # 1e-10: rounding, of a volume that cannot change under a wave 300 thicknesses long
    np.testing.assert_allclose(found.down, (1 - poisson) / (layer.shear * K) * down, rtol=1e-10)
    np.testing.assert_allclose(found.across, np.tanh(kt) / (layer.shear * K), rtol=1e-10)
    np.testing.assert_allclose(found.side, found.lift, rtol=1e-9, atol=1e-30)  # Betti; 0 of short waves at nu = 1/2
    cut = response(K, (Layer(0.5, YOUNG, poisson), Layer(1.5, YOUNG, poisson)), 0.7)
    np.testing.assert_allclose(
        cut, response(K, (layer,), 0.7), rtol=1e-9, atol=1e-30
    )  # a cut through a layer changes nothing
    np.testing.assert_allclose(response(K, deep(poisson)), half_space(K, layer), rtol=1e-9, atol=1e-12)


def test_fields_below_a_load_are_those_of_point_forces():
    """A Gaussian pressure and shear on a layer so thick that its base does nothing, against Boussinesq and Cerruti."""
    axis = local_axis(41, 0.05)
    bump = np.exp(-(axis**2 + axis[:, None] ** 2) / (2 * 0.25**2))
    shear = np.stack([0.5 * bump, -0.2 * bump], -1)
    ux, uy, uh = fields(bump, shear, 0.05, (Layer(60.0, YOUNG, 0.45),), 1.5)
    places, loads = forces.pressure_nodes(bump, 0.05, (0.5, -0.2))
    x, y = np.array([0.0, 0.7, 2.0, -1.0]), np.array([0.0, 0.4, -1.5, 2.5])
    points = np.stack([x, y, np.full(4, 1.5)], -1)
    expected = forces.displacements(points, places, loads, YOUNG, 0.45)
    found = np.stack([surface(x, y, 0.0, 0.0, m) for m in (ux, uy, uh)], -1)
    # 3 %: what the base at 60 mm takes from a motion at 1.5 mm is 1.5/60 of it
    np.testing.assert_allclose(found, expected, atol=0.03 * np.abs(expected).max())


def test_a_skin_with_a_stiff_film_against_finite_elements():
    """Silicone, a polarizer film of 3 GPa in its middle, silicone, on a rigid base, under a Gaussian pressure: the
    motion of the face and of the film, by axisymmetric quadratic elements."""
    skfem = pytest.importorskip("skfem")
    from skfem.helpers import grad

    layers = (Layer(2.5, 0.04, 0.45), Layer(0.2, 3000.0, 0.35), Layer(2.3, 0.04, 0.45))
    width, thick = 1.2, 5.0
    r = np.unique(np.concatenate([np.linspace(0, 4, 17), np.linspace(4, 30, 27)]))
    h = np.unique(np.concatenate([np.linspace(0, 2.5, 13), np.linspace(2.5, 2.7, 3), np.linspace(2.7, 5, 10)]))
    mesh = skfem.MeshQuad.init_tensor(r, h)
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementQuad2()), intorder=6)

    def moduli(x):
        inside = [(x[1] > 2.5) & (x[1] < 2.7), ~((x[1] > 2.5) & (x[1] < 2.7))]
        lame = [
            (m.young * m.poisson / ((1 + m.poisson) * (1 - 2 * m.poisson)), m.shear) for m in (layers[1], layers[0])
        ]
        return tuple(sum(np.where(i, v[j], 0.0) for i, v in zip(inside, lame)) for j in (0, 1))

    @skfem.BilinearForm
    def stiffness(u, v, w):
        lam, mu = moduli(w.x)
        a, b = grad(u), grad(v)
        hoop_u, hoop_v = u[0] / w.x[0], v[0] / w.x[0]
        volume = (a[0, 0] + a[1, 1] + hoop_u) * (b[0, 0] + b[1, 1] + hoop_v)
        shear = (a[0, 1] + a[1, 0]) * (b[0, 1] + b[1, 0])
        return (lam * volume + mu * (2 * (a[0, 0] * b[0, 0] + a[1, 1] * b[1, 1] + hoop_u * hoop_v) + shear)) * w.x[0]

    @skfem.LinearForm
    def load(v, w):
        return 0.01 * np.exp(-(w.x[0] ** 2) / (2 * width**2)) * v[1] * w.x[0]

    face = skfem.FacetBasis(mesh, basis.elem, facets=mesh.facets_satisfying(lambda x: x[1] < 1e-9), intorder=6)
    held = basis.get_dofs(lambda x: x[1] > thick - 1e-9).all()
    held = np.union1d(held, basis.get_dofs(lambda x: x[0] < 1e-9).all("u^1"))  # the axis stays where it is
    held = np.union1d(held, basis.get_dofs(lambda x: x[0] > 30 - 1e-9).all())
    moved = skfem.solve(*skfem.condense(stiffness.assemble(basis), load.assemble(face), D=held))
    at = np.array([0.05, 1.0, 2.0, 4.0])
    axis = local_axis(97, 0.125)
    pressure = 0.01 * np.exp(-(axis**2 + axis[:, None] ** 2) / (2 * width**2))
    for depth in (0.0, 2.5):
        points = np.stack([at, np.full(4, max(depth, 1e-6))])
        by_elements = (basis.probes(points) @ moved).reshape(2, -1)
        ux, _, uh = fields(pressure, np.zeros((97, 97, 2)), 0.125, layers, depth)
        found = np.stack([surface(at, 0 * at, 0.0, 0.0, m) for m in (ux, uh)])
        # 1 %: elements of 0.25 mm under a pressure 1.2 mm wide
        np.testing.assert_allclose(found, by_elements, atol=0.01 * np.abs(by_elements).max())
    soft = fields(pressure, np.zeros((97, 97, 2)), 0.125, (Layer(5.0, 0.04, 0.45),), 0.0)[2].values.max()
    assert 0.5 * soft > np.abs(by_elements).max()  # the film matters: what lies on it is held


# -- Pressure --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("poisson", [0.3, 0.5])
def test_a_ball_on_a_half_space_is_hertz(poisson):
    depth, radius = 0.05, 5.0
    overlap, pitch, a = paraboloid(depth, radius)
    touch = press(overlap, pitch, deep(poisson))
    force = 4 / 3 * YOUNG / (1 - poisson**2) * math.sqrt(radius) * depth**1.5
    assert touch.force[2] == pytest.approx(force, rel=1e-3)  # 28 nodes a radius: the error goes as (pitch/a)^1.5
    assert touch.pressure.max() == pytest.approx(1.5 * force / (math.pi * a**2), rel=2e-3)
    assert touch.area == pytest.approx(math.pi * a**2, rel=0.02)  # whole cells along the rim
    assert (touch.pressure >= 0).all() and not touch.pressure[overlap < -depth].any()
    under = touch.displacement()[2].values
    middle = len(under) // 2
    assert under[middle, middle] == pytest.approx(depth, rel=0.05)  # maps of a half-space are cut, at 13 widths


def test_a_deep_ball_is_sneddon():
    """A round needle as deep as half its radius, whose true shape matters."""
    depth, radius, nodes = 0.3, 0.6, 81
    exact = forces.ball(depth, radius)
    axis = local_axis(nodes, 2.2 * exact.a / (nodes - 1))
    r2 = axis**2 + axis[:, None] ** 2
    overlap = depth - (radius - np.sqrt(np.maximum(radius**2 - r2, 0)))
    touch = press(overlap, axis[1] - axis[0], deep(0.5))
    assert touch.force[2] == pytest.approx(exact.force(YOUNG), rel=5e-3)  # the contact radius by whole cells


def test_a_flat_punch():
    """F = 2 a E* depth, with the pressure of the rim without bound: nearest the rim the cells lose."""
    a, depth, nodes = 1.0, 0.02, 121
    axis = local_axis(nodes, 2.2 / (nodes - 1))
    inside = axis**2 + axis[:, None] ** 2 <= a**2
    touch = press(np.where(inside, depth, -1.0), axis[1] - axis[0], deep(0.4))
    equivalent = math.sqrt(inside.sum() * touch.pitch**2 / math.pi)
    # 1 %: the cells that stand for the circle are half a cell wider than those whose middles lie in it
    assert touch.force[2] == pytest.approx(2 * equivalent * YOUNG / (1 - 0.4**2) * depth, rel=0.01)


def test_a_thin_bonded_layer_is_a_bed_of_springs():
    """a >> t, compressible: p = M overlap/t with the uniaxial modulus M, F = pi R M depth^2/t, a = sqrt(2 R depth)
    (Johnson, 5.8)."""
    poisson, thick, radius, depth = 0.3, 0.1, 50.0, 0.01
    a, nodes = math.sqrt(2 * radius * depth), 81
    axis = local_axis(nodes, 2.2 * a / (nodes - 1))
    overlap = depth - (axis**2 + axis[:, None] ** 2) / (2 * radius)
    touch = press(overlap, axis[1] - axis[0], (Layer(thick, YOUNG, poisson),))
    modulus = YOUNG * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson))
    assert touch.force[2] == pytest.approx(math.pi * radius * modulus * depth**2 / thick, rel=0.03)  # (t/a)^1 = 0.1


# -- Shear -----------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def ball():
    overlap, pitch, a = paraboloid(0.05, 5.0, 81, 1.1)
    return press(overlap, pitch, deep(0.5)), a


@pytest.mark.parametrize("share", [0.3, 0.7, 0.95])
def test_a_drag_is_cattaneo_and_mindlin(ball, share):
    """delta = 3 mu P/(16 a) (2 - nu)/G [1 - (1 - Q/(mu P))^(2/3)], stuck within a (1 - Q/(mu P))^(1/3)."""
    touch, a = ball
    mu, load, stiff = 0.4, touch.force[2], YOUNG / 3
    move = 3 * mu * load / (16 * a) * 1.5 / stiff * (1 - (1 - share) ** (2 / 3))
    held = drag(touch, (0.6 * move, 0.8 * move), 0.0, mu)
    across = np.array([0.6, 0.8]) * share * mu * load
    # 1 %: the closed form takes the shear to have one direction, which it has to some percent of itself at nu = 1/2
    np.testing.assert_allclose(held.force[:2], across, atol=0.01 * share * mu * load)
    stuck = (held.touched & ~held.slip).sum() * held.pitch**2
    assert math.sqrt(stuck / math.pi) == pytest.approx(a * (1 - share) ** (1 / 3), abs=1.5 * held.pitch)
    assert (np.hypot(*np.moveaxis(held.shear, -1, 0)) <= mu * held.pressure * (1 + 1e-9)).all()


def test_a_drag_that_slips_all_over_is_friction_times_pressure(ball):
    held = drag(ball[0], (5.0, 0.0), 0.0, 0.4)
    np.testing.assert_allclose(held.force[:2], [0.4 * held.force[2], 0.0], rtol=1e-3, atol=1e-6)
    assert held.slip[held.touched].all()


def test_a_twist_is_stuck_at_first_and_slips_at_last(ball):
    """T = 16/3 G a^3 phi for small phi and 3 pi/16 mu P a at last (Lubkin 1951; Johnson, 7.2 and 3.9)."""
    touch, a = ball
    mu, load, stiff = 0.4, touch.force[2], YOUNG / 3
    last = 3 * math.pi / 16 * mu * load * a
    small = 0.02 * last / (16 / 3 * stiff * a**3)
    assert drag(touch, (0.0, 0.0), small, mu).torque == pytest.approx(0.02 * last, rel=0.02)  # a rim always slips
    assert drag(touch, (0.0, 0.0), 1.0, mu).torque == pytest.approx(last, rel=2e-3)
    np.testing.assert_allclose(drag(touch, (0.0, 0.0), 1.0, mu).force[:2], 0.0, atol=1e-3 * mu * load)


def test_no_friction_no_shear_and_no_contact_no_force(ball):
    assert not drag(ball[0], (1.0, 0.0), 0.0, 0.0).shear.any()
    overlap, pitch, _ = paraboloid(0.05, 5.0)
    assert not press(overlap - 1.0, pitch, deep(0.5)).force.any()


def test_bad_grids_are_refused():
    with pytest.raises(ValueError, match="odd number"):
        press(np.zeros((4, 4)), 0.1, deep(0.5))
    with pytest.raises(ValueError, match="only the last"):
        press(np.ones((5, 5)), 0.1, (*deep(0.5), *deep(0.5)))
    with pytest.raises(ValueError, match="Poisson's ratio 0.6"):
        Layer(1.0, 0.1, 0.6)
