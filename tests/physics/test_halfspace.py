"""Displacement in the skin under a dent, against Boussinesq's and Hertz' closed forms, and against equilibrium:
optics/skin/halfspace.py."""

import math

import numpy as np
import pytest

from optics.skin.contact import LocalMap, displacement, indenter_profile, local_axis, surface
from optics.skin.halfspace import carried, stress_integrals

# Three loads P_i s_i / (2 pi (r^2 + s_i^2)^1.5), point loads seen from s_i further away (mm, G = 1): chosen so that P
# and P s^2 sum to 0, and the dent with its tails in 1/r and 1/r^3 ends within the map
LOADS = ((5 / 3, 1.0), (-8 / 3, 2.0), (1.0, 3.0))
PITCH = 0.15
RATIOS = (0.5, 0.3)


def superposed(term):
    return sum(p * term(s) for p, s in LOADS)


def loaded(poisson):
    """The dent of the three loads on a map of 60 mm: D = P (1 - nu)/(2 pi G sqrt(r^2 + s^2)); 5e-7 is left at its
    border."""
    axis = local_axis(401, PITCH)
    r = np.hypot(axis, axis[:, None])
    return superposed(lambda s: (1 - poisson) / (2 * np.pi) / np.sqrt(r**2 + s**2))


def points(count=60, reach=12.0, seed=0):
    return np.random.default_rng(seed).uniform(-reach, reach, (2, count)) / math.sqrt(2)


def at(maps, x, y):
    return np.array([surface(x, y, 0, 0, m) for m in maps])


def pressed(depth=1.0):
    """A cube on edge, turned: nothing about its dent is symmetric."""
    return displacement(indenter_profile("cube", 6.0, (35, 20, 30), extent=8.0, pitch=0.08), depth, 5.0, 0.4)[0]


# -- Displacement ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("depth", [0.0, 0.5, 2.5, 5.0])
@pytest.mark.parametrize("poisson", RATIOS)
def test_point_loads_of_boussinesq(depth, poisson):
    """u_z = P/(4 pi G) (2(1-nu)/R + h H/R^3), u_r = P/(4 pi G) (h r/R^3 - (1-2nu) r/(R(R+H))), H = h + s: Johnson
    3.2."""
    x, y = points()
    r = np.hypot(x, y)

    def down(s):
        big = np.sqrt(r**2 + (depth + s) ** 2)
        return (2 * (1 - poisson) / big + depth * (depth + s) / big**3) / (4 * np.pi)

    def out(s):
        big = np.sqrt(r**2 + (depth + s) ** 2)
        return (depth * r / big**3 - (1 - 2 * poisson) * r / (big * (big + depth + s))) / (4 * np.pi)

    expected = np.array([superposed(out) * x / r, superposed(out) * y / r, superposed(down)])
    found = at(carried(loaded(poisson), PITCH, depth, poisson), x, y)
    # the spline's share, and the dent's tail beyond its map: 1e-5 of the largest displacement, 0.02 to 0.09 mm
    np.testing.assert_allclose(found, expected, atol=2e-5 * np.abs(expected).max() + 2e-7)


def test_hertz_on_the_axis():
    """uz(h) = D(0) + (p0 a/4G) (t - t^2 acot t - atan t), t = h/a: e_zz = (s_z - s_r)/3G of Johnson (3.45),
    integrated."""
    a, scale = 3.0, 0.4  # mm contact radius, p0/G
    axis = local_axis(501, 0.12)
    r = np.hypot(axis, axis[:, None])
    far = np.maximum(r, a)
    # Johnson (3.42) with E* = 4G
    outside = (2 * a**2 - far**2) * np.arcsin(a / far) + far * a * np.sqrt(1 - (a / far) ** 2)
    dent = scale / (8 * a) * np.where(r < a, np.pi / 2 * (2 * a**2 - r**2), outside)
    for h in (0.6, 1.5, 2.5, 4.0):
        t = h / a
        expected = np.pi * scale * a / 8 + scale * a / 4 * (t - t**2 * math.atan(1 / t) - math.atan(t))
        # the tail p0 a^2/(6 G r) beyond the map, which ends at 30 mm: integral of it times 3 h^3 r/R^5
        expected -= scale * a**2 / 6 * 0.75 * h**3 / 30**4
        found = float(at(carried(dent, 0.12, h), 0.0, 0.0)[2])
        assert found == pytest.approx(expected, rel=1e-4)  # the spline's share


@pytest.mark.parametrize("depth", [0.5, 2.5, 5.0])
def test_every_element_of_a_dent_displaces_radially(depth):
    """u = sum D 3 h^2 (x - x', y - y', h)/(2 pi R^5), also at the maps' border, where they are cut off."""
    dent = pressed()
    maps = carried(dent, dent.pitch, depth)
    half = maps[0].axis[-1]
    u, v = np.meshgrid(dent.axis, dent.axis)

    def exact(x, y):
        dx, dy = x - u, y - v
        weight = dent.values * dent.pitch**2 * 3 * depth**2 / (2 * np.pi) * (dx * dx + dy * dy + depth**2) ** -2.5
        return (weight * dx).sum(), (weight * dy).sum(), depth * weight.sum()

    largest = maps[2].values.max()
    # 6e-5 from the spline, for so narrow a dent, up to where maps fade; there an R^-4 tail is cut off 9 depths away:
    # 1.5e-4
    for low, high, tolerance in ((0, 4, 1e-4), (4, 0.85 * half, 1e-4), (0.87 * half, 1.2 * half, 3e-4)):
        angle, r = np.linspace(0, 6, 12), np.linspace(low, high, 12)
        x, y = r * np.cos(angle), r * np.sin(angle)
        expected = np.array([exact(*p) for p in zip(x, y)]).T
        np.testing.assert_allclose(at(maps, x, y), expected, atol=tolerance * largest)


def test_at_the_face_it_is_the_dent_and_nothing_moves_sideways():
    dent = pressed()
    ux, uy, uz = carried(dent, dent.pitch, 0.0)
    assert ux.values.max() == uy.values.max() == 0
    np.testing.assert_allclose(uz.values, dent.values, atol=1e-12)


def test_volume_is_kept_at_every_depth():
    dent = pressed()
    for depth in (0.3, 2.5, 5.0):
        # what lies beyond 9 depths of the dent: integral of 3 h^3/R^5 is 1/9^3 = 1.4e-3 of a point dent's, less of a
        # wide one's
        assert carried(dent, dent.pitch, depth)[2].volume == pytest.approx(dent.volume, rel=1.4e-3)


def test_incompressible_and_in_equilibrium():
    """div u = 0, and laplace u = grad p/G: its curl vanishes. By differences of 0.15 mm at a depth of 2.5 mm."""
    dent, h, step = pressed(), 2.5, 0.15
    x, y = points(20, 5.0)
    depths = h + step * np.arange(-2, 3)
    planes = [carried(dent, dent.pitch, d) for d in depths]
    shift = step * np.arange(-2, 3)
    # (h, y, x, component, point)
    u = np.array([[[at(p, x + a, y + b) for a in shift] for b in shift] for p in planes])

    def d(f, axis):
        f = np.moveaxis(f, axis, 0)
        return np.moveaxis((f[2:] - f[:-2]) / (2 * step), 0, axis)

    def middle(f):
        return f[tuple(slice((n - 1) // 2, (n + 1) // 2) for n in f.shape[:3])][0, 0, 0]

    gradient = [[middle(d(u[:, :, :, c], axis)) for axis in (2, 1, 0)] for c in range(3)]
    divergence = sum(gradient[c][c] for c in range(3))
    size = np.abs(gradient).max()
    # differences of second order: step^2/6 times third derivatives, up to 15/h^2 of the first: 0.9 %
    assert np.abs(divergence).max() < 0.015 * size
    inner = u[1:-1, 1:-1, 1:-1]
    laplace = (
        u[2:, 1:-1, 1:-1]
        + u[:-2, 1:-1, 1:-1]
        + u[1:-1, 2:, 1:-1]
        + u[1:-1, :-2, 1:-1]
        + u[1:-1, 1:-1, 2:]
        + u[1:-1, 1:-1, :-2]
        - 6 * inner
    ) / step**2
    third = [[middle(d(laplace[:, :, :, c], axis)) for axis in (2, 1, 0)] for c in range(3)]
    for a, b in ((0, 1), (1, 2), (0, 2)):
        assert (
            np.abs(third[a][b] - third[b][a]).max() < 0.03 * np.abs(third).max()
        )  # fifth derivatives, larger yet: 1.7 %


# -- Stress ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("between", [(0.0, 2.5), (2.5, 5.0), (1.0, 1.2)])
@pytest.mark.parametrize("poisson", RATIOS)
def test_stress_of_point_loads(between, poisson):
    """s_r - s_t = P/(2 pi) ((1-2nu) r^2 (2R+H)/(R^3 (R+H)^2) - 3 r^2 h/R^5): Johnson 3.2, tension positive."""
    x, y = points()
    r, angle = np.hypot(x, y), np.arctan2(y, x)
    nodes, weights = np.polynomial.legendre.leggauss(24)
    h = between[0] + (between[1] - between[0]) * (nodes[:, None] + 1) / 2

    def difference(s):
        big, deep = np.sqrt(r**2 + (h + s) ** 2), h + s
        return ((1 - 2 * poisson) * r**2 * (2 * big + deep) / (big**3 * (big + deep) ** 2) - 3 * r**2 * h / big**5) / (
            2 * np.pi
        )

    total = weights @ superposed(difference) * (between[1] - between[0]) / 2
    found = at(stress_integrals(loaded(poisson), PITCH, *between, poisson), x, y)
    expected = np.array([total * np.cos(2 * angle), total * np.sin(2 * angle)])
    np.testing.assert_allclose(found, expected, atol=2e-4 * np.abs(expected).max())


def test_stress_follows_from_displacement():
    """Q = integral 2 (d ux/dx - d uy/dy), U = integral 2 (d ux/dy + d uy/dx) over G, for a dent without symmetry."""
    dent, (h1, h2), e = pressed(), (1.0, 5.0), 0.02
    x, y = points(20, 6.0)
    nodes, weights = np.polynomial.legendre.leggauss(8)
    q, u = 0.0, 0.0
    for node, weight in zip(nodes, weights * (h2 - h1) / 2):
        maps = carried(dent, dent.pitch, h1 + (h2 - h1) * (node + 1) / 2)[:2]
        along_x = (at(maps, x + e, y) - at(maps, x - e, y)) / (2 * e)
        along_y = (at(maps, x, y + e) - at(maps, x, y - e)) / (2 * e)
        q = q + weight * 2 * (along_x[0] - along_y[1])
        u = u + weight * 2 * (along_y[0] + along_x[1])
    found = at(stress_integrals(dent, dent.pitch, h1, h2), x, y)
    # slopes of a cubic spline with 8 nodes to a depth: 3e-4
    np.testing.assert_allclose(found, [q, u], atol=5e-4 * np.abs(found).max())


def test_beside_a_contact_the_skin_is_compressed_along_the_radius():
    dent = displacement(indenter_profile("sphere", 5.0, extent=6.0, pitch=0.1), 0.5, 5.0, 0.4)[0]
    q, u = stress_integrals(dent, dent.pitch, 0.0, 5.0)
    assert surface(4.0, 0.0, 0, 0, q) < 0 < surface(0.0, 4.0, 0, 0, q)
    assert surface(3.0, 3.0, 0, 0, u) < 0 < surface(-3.0, 3.0, 0, 0, u)
    assert abs(surface(0.0, 0.0, 0, 0, q)) < 1e-9


# -- Maps ------------------------------------------------------------------------------------------------------------
def test_maps_fit_a_local_map_and_change_smoothly_with_depth():
    dent = pressed()
    for m in carried(dent, dent.pitch, 2.5) + stress_integrals(dent, dent.pitch, 0.0, 2.5):
        assert isinstance(m, LocalMap) and len(m.values) % 2
        assert np.abs(m.values[:2]).max() == np.abs(m.values[:, -2:]).max() == 0
    x, y = points(30, 10.0)
    fine = np.array([at(carried(dent, dent.pitch, h), x, y) for h in 2.5 + 1e-3 * np.arange(12)])
    # the grid changes with the depth; a jump would be the spline's error, 1e-5 of 0.5 mm
    assert np.abs(np.diff(fine, 2, axis=0)).max() < 1e-5


@pytest.mark.parametrize(
    "call",
    [
        lambda d: carried(d, d.pitch, -1.0),
        lambda d: carried(d, 0.0, 1.0),
        lambda d: carried(d, d.pitch, math.nan),
        lambda d: carried(d, d.pitch, 1.0, 0.6),
        lambda d: stress_integrals(d, d.pitch, 2.0, 1.0),
        lambda d: carried(d.values[:, :-2], d.pitch, 1.0),
        lambda d: carried(d.values[:-1, :-1], d.pitch, 1.0),
    ],
)
def test_says_what_is_wrong(call):
    with pytest.raises(ValueError, match="half-space|dent of shape"):
        call(LocalMap(np.zeros((9, 9)), 0.1))
