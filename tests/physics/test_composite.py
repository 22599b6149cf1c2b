"""The finger's skin by bricks: patch test, a clamped plate against quadratic elements, contact, the film's springs."""

import math

import numpy as np
import pytest

from optics.errors import UnknownKey
from optics.skin.composite import Skin, _factor, brick, complementary, fit_springs

SMALL = Skin(elements=(12, 11, 2), film=1)
RADIUS = 6.0  # mm


def test_a_brick_meets_the_patch_test_and_turns_freely():
    """Constant strain: the nodal forces are those of the constant stress; a rigid motion costs nothing."""
    edges, young, poisson = (2.0, 1.5, 1.2), 0.04, 0.49
    k = brick(edges, young, poisson)
    at = np.array([(a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1)]) * edges
    gradient = np.array([[0.01, 0.004, -0.002], [0.001, -0.02, 0.003], [0.005, 0.002, 0.015]])
    lame, shear = young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))
    strain = (gradient + gradient.T) / 2
    stress = lame * np.trace(strain) * np.eye(3) + 2 * shear * strain
    work = 0.5 * math.prod(edges) * (stress * strain).sum()
    moved = (at @ gradient.T).ravel()
    assert 0.5 * moved @ k @ moved == pytest.approx(work, rel=1e-10)
    turn = np.array([[0, -1, 0.5], [1, 0, -0.2], [-0.5, 0.2, 0]])
    np.testing.assert_allclose(k @ (at @ turn.T + [1, 2, 3]).ravel(), 0.0, atol=1e-12)
    assert np.sum(np.linalg.eigvalsh(k) < 1e-9) == 6  # and no other motion is free


def test_a_clamped_plate_against_quadratic_elements():
    """A pressure on the middle of the skin, which its rim holds and which gives way by bending; at a ratio of 0.3,
    where the quadratic elements do not lock."""
    skfem = pytest.importorskip("skfem")
    from skfem.helpers import ddot, div, sym_grad

    lame, shear = 0.04 * 0.3 / (1.3 * 0.4), 0.04 / 2.6
    x, y, z = np.linspace(-24, 24, 9), np.linspace(-21.5, 21.5, 9), np.linspace(-5, 0, 3)
    mesh = skfem.MeshHex.init_tensor(x, y, z)
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementHex2()), intorder=4)

    @skfem.BilinearForm
    def stiffness(u, v, w):
        return lame * div(u) * div(v) + 2 * shear * ddot(sym_grad(u), sym_grad(v))

    def shape(x, y):
        return 1e-4 * np.exp(-(x**2 + y**2) / (2 * 6.0**2))

    @skfem.LinearForm
    def load(v, w):
        return -shape(w.x[0], w.x[1]) * v[2]

    face = skfem.FacetBasis(mesh, basis.elem, facets=mesh.facets_satisfying(lambda p: p[2] > -1e-9), intorder=6)
    rim = basis.get_dofs(lambda p: (np.abs(p[0]) > 24 - 1e-9) | (np.abs(p[1]) > 21.5 - 1e-9))
    moved = skfem.solve(*skfem.condense(stiffness.assemble(basis), load.assemble(face), D=rim))
    wanted = (basis.probes(np.array([[0.0], [0.0], [-5.0]])) @ moved)[2]

    skin = Skin(elements=(16, 16, 4), poisson=0.3)
    loads = np.zeros((3 * len(skin.nodes), 1))
    top = skin.layer(0)
    dx, dy = 48 / 16, 43 / 16
    loads[3 * top + 2, 0] = -shape(*skin.nodes[top, :2].T) * dx * dy
    found = _factor(skin, 0.0, "bowl")(loads).reshape(-1, 3)
    middle = np.argmin(np.abs(skin.nodes - [0, 0, -5]).sum(1))
    # 5 %: bricks with straight edges bend stiffly, four of them through the thickness, under quadratic ones 6 mm wide
    assert found[middle, 2] == pytest.approx(float(np.squeeze(wanted)), rel=0.05)


def test_contact_pushes_and_never_pulls():
    pushed = SMALL.push((3.0, -2.0), 2.0, RADIUS, c=0.01)
    assert pushed.load[2] < 0 and (pushed.force[:, 2] <= 0).all()
    face = SMALL.layer(0)
    r = np.hypot(*(SMALL.nodes[face, :2] - [3.0, -2.0]).T)
    under = r < RADIUS
    ball = -2.0 + RADIUS - np.sqrt(RADIUS**2 - r[under] ** 2)
    gap = ball - pushed.displacement[face[under], 2]
    touching = pushed.force[face[under], 2] < 0
    assert touching.any() and gap.min() > -1e-9  # mm: nothing stands inside the ball
    np.testing.assert_allclose(gap[touching], 0.0, atol=1e-9)
    assert not pushed.displacement[SMALL.held].any()
    assert not SMALL.push((0.0, 0.0), 0.0, RADIUS).load.any()


def test_the_active_set_is_the_constrained_minimum():
    from scipy.optimize import nnls

    rng = np.random.default_rng(1)
    root = rng.normal(size=(12, 12))
    matrix, wanted = root @ root.T + 0.5 * np.eye(12), rng.normal(size=12)
    factor = np.linalg.cholesky(matrix).T
    exact, _ = nnls(factor, np.linalg.solve(factor.T, wanted))
    np.testing.assert_allclose(complementary(matrix, wanted), exact, atol=1e-9)


def test_springs_are_the_spheroid():
    at = SMALL.nodes[SMALL.layer(1), :2]
    share = np.prod(np.array(SMALL.size[:2]) / SMALL.elements[:2])
    middle, corner = np.argmin(np.abs(at).sum(1)), np.argmax(np.abs(at).sum(1))
    for form, inside, outside in (("bowl", 0.0, 0.3), ("printed", 0.3, 0.0)):
        k = SMALL.springs(0.3, form) / share
        # at the node nearest the middle 2 mm off in y: 1 - sqrt(1 - (1.95/30.4)^2)
        assert k[middle] == pytest.approx(inside, abs=2e-3) and k[corner] == pytest.approx(outside, abs=1e-8)
    z = SMALL.springs(0.3, "printed") / share
    half = np.array([48.0, 43.0]) / 2 * math.sqrt(2)
    np.testing.assert_allclose((at / half) ** 2 @ [1, 1] + (z / 0.3) ** 2, 1.0, atol=1e-9)  # (3)


def test_springs_stiffen_and_are_found_again_from_four_forces():
    """Forces with 1 % noise at a place in each quadrant give c back."""
    places = [(12.0, 11.7), (-12.0, 11.7), (-12.0, -11.7), (12.0, -11.7)]
    bare, held = (-SMALL.push(places[0], 2.0, RADIUS, c).load[2] for c in (0.0, 0.02))
    assert held > 1.3 * bare
    noise = 1 + 0.01 * np.random.default_rng(0).normal(size=4)
    found = fit_springs(SMALL, places, 2.0, held * noise, RADIUS)
    # F rises as c^0.3 here: 1 % of four forces is 0.5 % of F and 2 % of c; three of those
    assert found == pytest.approx(0.02, rel=0.06)
    with pytest.raises(ValueError, match="the bare skin fits as well"):
        fit_springs(SMALL, places, 2.0, [bare / 2] * 4, RADIUS)


def test_bad_skins_are_refused():
    with pytest.raises(ValueError, match="a ratio from 0 to below 0.5"):
        Skin(poisson=0.5)
    with pytest.raises(ValueError, match="a depth below its 5 mm"):
        SMALL.push((0.0, 0.0), 6.0, RADIUS)
    with pytest.raises(UnknownKey, match="did you mean 'bowl'"):
        SMALL.springs(1.0, "bow")
