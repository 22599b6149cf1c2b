"""A skin that is held at its rim, free behind and stiffened by springs: its influence against quadratic elements of
scikit-fem, its contact against finer elements, and what it carries along."""

import numpy as np
import pytest

from optics.skin import contact, held, pressing
from optics.skin.composite import FORMS, Skin, solver
from optics.skin.contact import local_axis
from optics.skin.held import HeldContact, HeldSkin

SMALL = (24.0, 20.0, 5.0, 0.04, 0.49, 0.003)  # mm, N/mm^2, N/mm^3: a quarter of the shipped skin
PLACE = (3.0, -2.0)


@pytest.fixture(scope="module")
def skin():
    return HeldSkin(*SMALL)


@pytest.fixture(scope="module")
def ball():
    return contact.indenter_profile("sphere", 6.0, (0.0, 0.0, 0.0), 8.0, 0.1)


def pressed(skin, pressure, pitch, place):
    n = len(pressure)
    none = np.zeros((n, n))
    return HeldContact(
        none, pressure, np.zeros((n, n, 2)), none.astype(bool), pitch, (skin.layer,), skin=skin, place=place
    )


@pytest.mark.parametrize("axis", range(3))
def test_loads_beyond_the_first_quarter_are_mirror_images(axis):
    """What is not solved for is what it would be, to rounding."""
    skin = Skin((10.0, 8.0, 5.0), (4, 6, 4), 0.04, 0.49, 2)
    nx, ny, nz = skin.shape
    loads = np.zeros((3 * len(skin.nodes), nx * ny))
    loads[3 * skin.layer(0) + axis, np.arange(nx * ny)] = 1.0
    whole = solver(skin, 0.003, FORMS[0], skin.held)(loads).T.reshape(nx, ny, nx, ny, nz, 3)
    part = whole.copy()
    part[(nx + 1) // 2 :] = part[:, (ny + 1) // 2 :] = np.nan
    HeldSkin._mirror(part, axis)
    np.testing.assert_allclose(part, whole, rtol=0, atol=1e-9 * np.abs(whole).max())


@pytest.mark.slow  # half a minute of scikit-fem
def test_a_narrow_load_against_quadratic_elements():
    """A pressure of 1.2 mm standard deviation on the shipped skin, which its own elements of 2 mm do not resolve."""
    skfem = pytest.importorskip("skfem")
    from skfem.helpers import ddot, div, sym_grad

    young, poisson, springs, place, sd = 0.04, 0.45, 0.003, (5.0, -4.0), 1.2
    lame, shear = young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))
    axes = [
        np.unique(np.r_[np.linspace(-h, c - 4, 6), np.linspace(c - 4, c + 4, 9), np.linspace(c + 4, h, 6)])
        for h, c in zip((24.0, 21.5), place)
    ]
    mesh = skfem.MeshHex.init_tensor(*axes, np.array([-5, -3.75, -2.5, -1.5, -0.7, 0.0]))
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementHex2()), intorder=4)

    @skfem.BilinearForm
    def stiffness(u, v, w):
        return lame * div(u) * div(v) + 2 * shear * ddot(sym_grad(u), sym_grad(v))

    @skfem.BilinearForm
    def film(u, v, w):  # (3): a spheroid whose corners lie on the rim
        x, y = w.x[0] / (24 * 2**0.5), w.x[1] / (21.5 * 2**0.5)
        k = springs * (1 - np.sqrt(np.maximum(1 - x**2 - y**2, 0)))
        return k * (u[0] * v[0] + u[1] * v[1] + u[2] * v[2])

    def load_at(x, y):
        return 0.01 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * sd**2))

    @skfem.LinearForm
    def load(v, w):
        return -load_at(w.x[0], w.x[1]) * v[2]

    face = skfem.FacetBasis(mesh, basis.elem, facets=mesh.facets_satisfying(lambda p: p[2] > -1e-9), intorder=8)
    plane = skfem.InteriorFacetBasis(
        mesh, basis.elem, facets=mesh.facets_satisfying(lambda p: np.abs(p[2] + 2.5) < 1e-9), intorder=6
    )
    rim = basis.get_dofs(lambda p: (np.abs(p[0]) > 24 - 1e-9) | (np.abs(p[1]) > 21.5 - 1e-9))
    whole = stiffness.assemble(basis) + film.assemble(plane)
    moved = skfem.solve(*skfem.condense(whole, load.assemble(face), D=rim))
    points = np.array(
        [[5, -4, 0], [6.5, -4, 0], [9, -2, 0], [0, 0, 0], [-12, 8, 0], [5, -4, -2.5], [5, -4, -5], [8, -4, -5]], float
    )
    wanted = (basis.probes(points.T) @ moved).reshape(3, -1).T * [1, 1, -1]

    axis = local_axis(81, 0.12)
    touch = pressed(
        HeldSkin(48.0, 43.0, 5.0, young, poisson, springs),
        load_at(place[0] + axis[None, :], place[1] + axis[:, None]),
        0.12,
        place,
    )
    found = np.stack([touch.moved(p[:1], p[1:2], place, -p[2])[:, 0] for p in points])
    # 0.8 % of the largest: cubic splines over 2 mm, and quadratic elements of 4 mm far away; 0.4 % under the load
    np.testing.assert_allclose(found, wanted, atol=0.008 * np.abs(wanted).max())


@pytest.mark.slow
def test_a_ball_against_finer_elements(skin, ball):
    """The force at two places between nodes and a depth at which elements of 1 mm resolve the contact."""
    fine = Skin(SMALL[:3], (24, 20, 4), *SMALL[3:5])
    for place in ((0.0, 0.0), PLACE):
        force = held.indent(ball, 2.0, place, skin).force[2]
        # 3 %: a contact of 3 mm radius has 30 of the finer nodes
        assert force == pytest.approx(-fine.push(place, 2.0, 6.0, SMALL[5]).load[2], rel=0.03)


def test_nothing_stands_in_the_ball_and_nothing_pulls(skin, ball):
    touch = held.indent(ball, 1.5, PLACE, skin)
    x, y = PLACE[0] + touch.axis[None, :], PLACE[1] + touch.axis[:, None]
    gap = touch.moved(x, y, PLACE)[2] - touch.overlap
    assert (touch.pressure >= 0).all() and touch.touched.any()
    # 2 um: maps are cubic splines of what was solved at nodes 0.3 mm apart
    assert gap.min() > -2e-3 and np.abs(gap[touch.touched]).max() < 2e-3
    assert held.indent(ball, 0.0, PLACE, skin).force[2] == 0
    # the rim is held: of a layer without end that stands for what is near, some microns are left there
    assert np.abs(touch.moved(np.array([12.0]), np.array([0.0]), PLACE)).max() < 0.01


def test_a_drag_sticks_and_slips(skin, ball):
    touch = held.indent(ball, 1.5, PLACE, skin)
    slid = pressing.drag(touch, (4.0, 0.0), 0.0, 0.5)
    assert slid.force[0] == pytest.approx(0.5 * touch.force[2], rel=1e-3) and (slid.slip == touch.touched).all()
    stuck = pressing.drag(touch, (0.05, 0.0), 0.0, 0.5)
    assert 0 < stuck.force[0] < slid.force[0] / 2
    still = (touch.pressure > 0.5 * touch.pressure.max()).nonzero()
    v, u = (PLACE[i] + touch.axis[still[1 - i]] for i in (1, 0))
    alone = pressing.shear_alone(stuck).moved(u, v, PLACE)
    # what sticks goes along by all of the 0.05 mm; 2 %: two grids of splines
    np.testing.assert_allclose(alone[0], 0.05, rtol=0.02)
