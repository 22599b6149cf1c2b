"""The rough boundary against Walter's formulae with Jones vectors in double precision, and against Mitsuba's own
boundaries.

Light that comes from `wo` leaves along `wi`, unless a test asks for the opposite way (importance). Directions whose
cosine to the surface is below 0.05 are left out of comparisons, and facets within some 0.1 deg of the critical angle:
float32 leaves less than four digits of 1/cos there, and of the root that the refracted cosine is."""

from __future__ import annotations

import numpy as np
import pytest

RNG = np.random.default_rng  # every test seeds its own
KINDS = ("beckmann", "ggx")
# relative: rounding of the facet's normal (1e-7) over the width of the lobe (0.1), through exp() or a fourth power
CLOSE = 1e-4


def unit(v):
    v = np.asarray(v, float)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def dot(a, b):
    return (a * b).sum(-1)


def slanted(degrees, azimuth=20.0):
    """One direction at an angle to the normal; beyond 90 deg from behind."""
    t, a = np.radians([degrees, azimuth])
    return np.array([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t)])


def sphere(rng, count, lowest=0.05):
    """(count, 3) directions, uniform but for those along the surface."""
    v = unit(rng.normal(size=(3 * count, 3)))
    return v[np.abs(v[:, 2]) > lowest][:count]


def vectors(mi, v):
    return mi.Vector3f(*np.asarray(v, np.float32).reshape(-1, 3).T)


def surface(mi, wi, count=1):
    import drjit as dr

    si = dr.zeros(mi.SurfaceInteraction3f, max(count, np.asarray(wi).size // 3))
    si.t, si.wi = mi.Float(1), vectors(mi, wi)
    return si


def boundary(mi, index=1.5, alpha=0.2, distribution="beckmann"):
    return mi.load_dict({"type": "rough_interface", "index": index, "alpha": alpha, "distribution": distribution})


def stock(mi, index=1.5, alpha=0.2, distribution="beckmann"):
    return mi.load_dict(
        {"type": "roughdielectric", "int_ior": index, "ext_ior": 1.0, "alpha": alpha, "distribution": distribution}
    )


def context(mi, component=None, mode="Radiance"):
    found = mi.BSDFContext(getattr(mi.TransportMode, mode))
    if component is not None:
        found.component = component
    return found


def matrices(mi, value, count):
    """(count, 4, 4) of the first band."""
    import drjit as dr

    dr.eval(value)
    return np.stack([np.stack([np.array(value[i, j][0]) * np.ones(count) for j in range(4)], -1) for i in range(4)], -2)


def intensity(mi, value, count):
    return np.array(mi.unpolarized_spectrum(value)[0]) * np.ones(count)


def draws(mi, rng, count):
    return mi.Float(rng.random(count).astype("f")), mi.Point2f(*rng.random((2, count)).astype("f"))


def grid(mi, size):
    u = ((np.arange(size) + 0.5) / size).astype("f")
    return mi.Point2f(*(a.ravel() for a in np.meshgrid(u, u)))


def met(index, wi, wo):
    """The facet that joins two directions: relative index nu, reflected or not, normal, square of nu times the
    refracted cosine."""
    nu = np.where(wi[:, 2] > 0, index, 1 / index)
    back = wi[:, 2] * wo[:, 2] > 0
    m = unit(wi + np.where(back, 1, nu)[:, None] * wo)
    m = m * np.sign(m[:, 2:])
    return nu, back, m, dot(wi, m) ** 2 + nu**2 - 1


def pairs(mi, bsdf, index, rng, count):
    """Directions (wi, wo) as a boundary scatters them, from both sides, and one in four at random."""
    wi, (u1, u2) = sphere(rng, count), draws(mi, rng, count)
    bs, _ = bsdf.sample(context(mi), surface(mi, wi), u1, u2, True)
    wo = np.array(bs.wo).T
    wo[::4] = sphere(rng, count)[: len(wo[::4])]
    keep = np.isfinite(wo).all(1) & (np.abs(wo[:, 2]) > 0.05)
    wi, wo = wi[keep].astype("f"), unit(wo[keep]).astype("f")
    keep = np.abs(met(index, unit(wi), unit(wo))[3]) > 1e-3
    return wi[keep], wo[keep]


# -- Walter's formulae with Jones vectors, in double precision -------------------------------------------------------
def facets(kind, alpha, m, *directions):
    """D(m) and the product of G1: eqs. (25), (27) of the Beckmann, (33), (34) of the GGX distribution."""
    cos2 = m[:, 2] ** 2
    tan2 = (1 - cos2) / cos2 / alpha**2
    common = np.exp(-tan2) if kind == "beckmann" else (1 + tan2) ** -2
    shading = 1.0
    for v in directions:
        a = np.abs(v[:, 2]) / np.sqrt(1 - v[:, 2] ** 2) / alpha
        g1 = (
            np.where(a < 1.6, (3.535 * a + 2.181 * a**2) / (1 + 2.276 * a + 2.577 * a**2), 1)
            if kind == "beckmann"
            else 2 / (1 + np.sqrt(1 + a**-2))
        )
        shading = shading * g1 * (dot(v, m) * v[:, 2] > 0)
    return common / (np.pi * alpha**2 * cos2**2), shading


def jones_to_mueller(j):
    a = np.array([[1, 0, 0, 1], [1, 0, 0, -1], [0, 1, 1, 0], [0, 1j, -1j, 0]])
    both = np.einsum("nac,nbd->nabcd", j, j.conj()).reshape(-1, 4, 4)
    return np.real(a @ both @ np.linalg.inv(a))


def walter(mi, kind, index, alpha, wi, wo):
    """(N, 4, 4): eqs. (20), (21) times the cosine to the source, with Fresnel's amplitudes along s and p of each
    facet."""
    wi, wo = unit(wi), unit(wo)
    nu, back, m, square = met(index, wi, wo)
    along, across = dot(wi, m), dot(wo, m)
    c1 = np.abs(along)
    c2 = np.sqrt(square + 0j).conj() / nu  # -i beyond the critical angle: fields oscillate as exp(+i omega t)
    r_s, r_p = (c1 - nu * c2) / (c1 + nu * c2), (nu * c1 - c2) / (nu * c1 + c2)
    amplitudes = [np.where(back, r, np.sqrt(1 - np.minimum(np.abs(r) ** 2, 1))) for r in (r_s, r_p)]
    into, out = -wo, wi
    s = unit(np.cross(wi, wo))
    field = sum(
        a[:, None, None] * x[:, :, None] * y[:, None, :]  # (N, 3, 3): from the electric field before to the one after
        for a, x, y in zip(amplitudes, (s, np.cross(out, s)), (s, np.cross(into, s)))
    )
    x_in, x_out = (np.array(mi.mueller.stokes_basis(vectors(mi, k)), float).T for k in (into, out))
    ends = [np.stack([x, np.cross(k, x)], -1) for k, x in ((into, x_in), (out, x_out))]
    matrix = jones_to_mueller(np.einsum("nia,nij,njb->nab", ends[1], field, ends[0]))
    d, g = facets(kind, alpha, m, wi, wo)
    scale = np.where(
        back, d * g / (4 * np.abs(wi[:, 2])), np.abs(along * across / wi[:, 2]) * d * g / (along + nu * across) ** 2
    )
    return matrix * scale[:, None, None]


def off(found, expected, weight=1.0):
    """Largest difference of any element, relative to the intensity, times the weight of the pair; pairs below 1e-6 of
    the brightest are left out."""
    size = expected[:, 0, 0]
    bright = size > 1e-6 * size.max()
    assert bright.mean() > 0.3
    return (weight * np.abs(found - expected).max(axis=(1, 2)) / np.where(bright, size, 1.0))[bright].max()


def surely_refracted(index, wi, wo):
    """(n,) 1, and less where rounding matters more than CLOSE: behind a facet that is near total reflection the cosine
    is the root of a small difference, so that a rounding e of single precision becomes e n^2/cos^2 of the light. Four
    add up: those of three products and a norm."""
    inside = wi[:, 2] < 0  # in the medium of the given index
    n = np.where(inside, index, 1 / index)
    half = n[:, None] * wi + wo
    cos = (wo * half).sum(1) / np.linalg.norm(half, axis=1)
    lost = 4 * np.finfo(np.float32).eps * np.maximum(n, 1 / n) ** 2 / np.maximum(cos**2, 1e-12)
    return np.where(wi[:, 2] * wo[:, 2] < 0, np.minimum(1.0, CLOSE / lost), 1.0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("index, alpha", [(1.5, 0.1), (0.7, 0.3), (1.05, 0.4), (2.2, 0.8)])
def test_every_element_is_walters_formula_with_fresnels_amplitudes(mitsuba, kind, index, alpha):
    mi = mitsuba
    bsdf = boundary(mi, index, alpha, kind)
    wi, wo = pairs(mi, bsdf, index, RNG(1), 4000)
    value = bsdf.eval(context(mi), surface(mi, wi), vectors(mi, wo), True)
    weight = surely_refracted(index, wi, wo)
    assert (weight == 1).mean() > 0.9
    assert off(matrices(mi, value, len(wi)), walter(mi, kind, index, alpha, wi, wo), weight) <= CLOSE


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["index", "alpha"])
@pytest.mark.parametrize("index, alpha", [(1.5, 0.2), (0.7, 0.4)])
def test_forward_derivatives_of_every_element_are_those_of_the_formula(mitsuba, kind, name, index, alpha):
    """Forward mode through eval, against central differences of the formula in double precision."""
    import drjit as dr

    mi = mitsuba
    bsdf = boundary(mi, index, alpha, kind)
    wi, wo = pairs(mi, bsdf, index, RNG(3), 3000)
    held = mi.traverse(bsdf)
    dr.enable_grad(held[name])
    held.update()
    value = bsdf.eval(context(mi), surface(mi, wi), vectors(mi, wo), True)
    dr.set_grad(held[name], 1.0)
    dr.forward_to(value)
    found = matrices(mi, dr.grad(value), len(wi))
    h = 1e-5
    at = [walter(mi, kind, index + s * (name == "index"), alpha + s * (name == "alpha"), wi, wo) for s in (h, -h)]
    expected, size = (at[0] - at[1]) / (2 * h), (at[0] + at[1])[:, 0, 0] / 2
    bright = size > 1e-4 * size.max()
    scale = np.abs(expected).max(axis=(1, 2)) + size  # the derivative passes through 0 somewhere
    worst = np.abs(found - expected).max(axis=(1, 2))[bright] / scale[bright]
    assert np.isfinite(found).all() and bright.mean() > 0.2
    # 1e-3: rounding of the facet's normal once more over the lobe's width; the kink of the Beckmann G1 at a = 1.6 is
    # 1e-3 of it
    assert worst.max() <= 1e-3


# -- against Mitsuba's own boundaries --------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize(
    "variant", ["llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_mono_polarized", "llvm_ad_spectral_polarized"], indirect=True
)
def test_intensities_densities_and_draws_are_those_of_the_stock_rough_dielectric(variant):
    import mitsuba as mi

    for kind, index, alpha, mode in (("beckmann", 1.5, 0.2, "Radiance"), ("ggx", 0.8, 0.4, "Importance")):
        both = boundary(mi, index, alpha, kind), stock(mi, index, alpha, kind)
        wi, wo = pairs(mi, both[1], index, RNG(2), 4000)
        (value, density), (stock_value, stock_density) = (
            b.eval_pdf(context(mi, mode=mode), surface(mi, wi), vectors(mi, wo), True) for b in both
        )
        for found, expected in (
            (intensity(mi, value, len(wi)), intensity(mi, stock_value, len(wi))),
            (np.array(density), np.array(stock_density)),
        ):
            there = expected > 0
            assert there.mean() > 0.5 and (found[~there] == 0).all()
            assert np.abs(found / np.where(there, expected, 1) - 1)[there].max() <= CLOSE
        (drawn, weight), (stock_drawn, stock_weight) = (
            b.sample(context(mi, mode=mode), surface(mi, wi), *draws(mi, RNG(13), len(wi)), True) for b in both
        )
        there = (np.array(drawn.pdf) > 0) & (np.abs(np.array(drawn.wo)[2]) > 0.05)
        assert there.mean() > 0.8
        assert np.abs(np.array(drawn.wo) - np.array(stock_drawn.wo))[:, there].max() <= CLOSE
        assert (np.array(drawn.sampled_type) == np.array(stock_drawn.sampled_type))[there].all()
        assert np.abs(intensity(mi, weight, len(wi)) - intensity(mi, stock_weight, len(wi)))[there].max() <= CLOSE


@pytest.mark.parametrize("index", [1.5, 0.75])
@pytest.mark.parametrize("degrees", [0.0, 33.0, 65.0, 125.0, 170.0])
def test_smooth_facets_are_the_smooth_dielectric(mitsuba, index, degrees):
    """Mean Mueller matrices over the lobe, reflected and transmitted, in both directions of transport; at alpha 0
    exactly."""
    mi = mitsuba
    flat = mi.load_dict({"type": "dielectric", "int_ior": index, "ext_ior": 1.0})
    size, wi = 128, slanted(degrees)
    for mode in ("Radiance", "Importance"):
        for way in (0, 1):
            ask = context(mi, way, mode)
            bs, weight = flat.sample(ask, surface(mi, wi), mi.Float(0.5), mi.Point2f(0.5), True)
            expected = matrices(mi, weight, 1)[0]
            # 3e-6: rounding; 1e-4: the lobe of 2e-3 rad turns the light's axes and the angle of incidence by 4e-6 on
            # average (the tail of ggx more), and the grid of 128 x 128 does not quite balance both sides
            for alpha, kind, tolerance in ((0.0, "ggx", 3e-6), (2e-3, "beckmann", 1e-4), (2e-3, "ggx", 1e-4)):
                rough = boundary(mi, index, alpha, kind)
                found, weight = rough.sample(ask, surface(mi, wi, size**2), mi.Float(0.5), grid(mi, size), True)
                mean = matrices(mi, weight, size**2).mean(0)
                assert np.abs(mean - expected).max() <= tolerance
                if expected[0, 0] > 0:
                    beside = np.array(found.wo) - np.array(bs.wo)
                    assert (
                        np.abs(beside if alpha == 0 else beside.mean(1)).max() <= tolerance
                    )  # of alpha 0 no draw at all
                    assert np.array(found.eta) == pytest.approx(np.array(bs.eta)[0])


def test_total_reflection_keeps_its_phase(mitsuba):
    """tan(delta/2) = cos(theta) sqrt(sin(theta)^2 - n^2)/sin(theta)^2 (Born & Wolf, 1.5.4), n = 1/1.49661: 45 deg at
    51.782 deg."""
    mi = mitsuba
    for degrees in (45.0, 51.782, 60.0, 80.0):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        delta = 2 * np.arctan(c * np.sqrt(s**2 - 1.49661**-2) / s**2)
        _, weight = boundary(mi, 1.49661, 0.0).sample(
            context(mi), surface(mi, slanted(180 - degrees)), mi.Float(0.5), mi.Point2f(0.5), True
        )
        matrix = matrices(mi, weight, 1)[0]
        assert matrix[0, 0] == pytest.approx(1, abs=1e-6)
        assert matrix[3, 3] == pytest.approx(
            np.cos(delta), abs=2e-6
        )  # turning the axes leaves this element; 2e-6: rounding
        assert np.linalg.norm(matrix[3, 1:3]) == pytest.approx(np.sin(delta), abs=2e-6)
    assert delta < np.radians(45)


# -- what makes it a scattering function -----------------------------------------------------------------------------
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("index, degrees", [(1.5, 40.0), (1.5, 150.0)])
def test_samples_fall_as_the_density_says(mitsuba, kind, index, degrees, tmp_path, monkeypatch):
    """Chi^2 test over the sphere; draws that leave on the wrong side count in neither."""
    import drjit as dr
    from mitsuba.python.chi2 import ChiSquareTest, SphericalDomain

    mi = mitsuba
    monkeypatch.chdir(tmp_path)  # a test that fails leaves its tables behind
    bsdf, wi = boundary(mi, index, 0.4, kind), slanted(degrees)

    def sample(u):
        bs, _ = bsdf.sample(context(mi), surface(mi, wi, dr.width(u)), u.x, mi.Point2f(u.y, u.z), True)
        return bs.wo, dr.select(bs.pdf > 0, mi.Float(1), 0)

    test = ChiSquareTest(
        domain=SphericalDomain(),
        sample_func=sample,
        sample_dim=3,
        sample_count=300_000,
        res=51,
        ires=16,
        pdf_func=lambda wo: bsdf.pdf(context(mi), surface(mi, wi, dr.width(wo)), wo, True),
    )
    assert test.run(significance_level=1e-3)  # the draws are always the same: this passes or fails for good


@pytest.mark.parametrize("kind", KINDS)
def test_weights_are_value_over_density(mitsuba, kind):
    """Every element, both sides, all draws; and each way alone makes up the whole."""
    mi = mitsuba
    bsdf, rng, count = boundary(mi, 1.4, 0.3, kind), RNG(4), 4000
    wi, (u1, u2) = sphere(rng, count), draws(mi, rng, count)
    si, ways = surface(mi, wi), {}
    for way in (None, 0, 1):
        bs, weight = bsdf.sample(context(mi, way), si, u1, u2, True)
        value, density = bsdf.eval_pdf(context(mi, way), si, bs.wo, True)
        weight, value, density, drawn = (
            matrices(mi, weight, count),
            matrices(mi, value, count),
            np.array(density),
            np.array(bs.pdf),
        )
        valid = drawn > 0
        assert (
            valid.mean() > (0.6 if way == 1 else 0.9) and (weight[~valid] == 0).all()
        )  # nothing passes in total reflection
        wo = unit(np.array(bs.wo).T)
        regular = valid & (np.abs(wo[:, 2]) > 0.05) & (np.abs(met(1.4, wi, wo)[3]) > 1e-3)
        assert regular.mean() > 0.5
        # the facet found again from both directions
        assert np.abs(density[regular] / drawn[regular] - 1).max() <= 2 * CLOSE
        assert np.abs(value[regular] / density[regular, None, None] - weight[regular]).max() <= 2 * CLOSE
        ways[way] = matrices(mi, bsdf.eval(context(mi, way), si, vectors(mi, wi[::-1]), True), count)
    assert (ways[None] == ways[0] + ways[1]).all() and (ways[0][:, 0, 0] * ways[1][:, 0, 0] == 0).all()


def quadrature(size):
    """Directions over the sphere and their solid angles: Gauss-Legendre in the polar angle, midpoints in azimuth."""
    x, w = np.polynomial.legendre.leggauss(size)
    theta = np.concatenate([np.pi / 4 * (x + 1), np.pi / 2 + np.pi / 4 * (x + 1)])
    phi = (np.arange(2 * size) + 0.5) * np.pi / size
    weight = np.repeat(np.tile(w * np.pi / 4, 2) * np.sin(theta) * np.pi / size, len(phi))
    theta, phi = (a.ravel() for a in np.meshgrid(theta, phi, indexing="ij"))
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1), weight


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("index", [1.5, 0.7])
def test_no_light_is_made_of_whatever_polarization(mitsuba, kind, index):
    """All that a beam sends to both sides is at most the beam, for the polarization that fares best (m00 + |m01, m02,
    m03|); the integral of eval is what sampling returns, that of the density the share of draws that count."""
    import drjit as dr

    mi = mitsuba
    wo, solid = quadrature(320)
    ask, count = context(mi, mode="Importance"), 2**18

    def row(value, count):
        dr.eval(value)
        return np.stack([np.array(value[0, j][0]) * np.ones(count) for j in range(4)])

    u1, u2 = draws(mi, RNG(6), count)
    for alpha in (0.2, 0.6):
        bsdf = boundary(mi, index, alpha, kind)
        for degrees in (0.0, 50.0, 75.0, 120.0):
            value, density = bsdf.eval_pdf(ask, surface(mi, slanted(degrees), len(wo)), vectors(mi, wo), True)
            sent = (row(value, len(wo)) * solid).sum(1)
            bs, weight = bsdf.sample(ask, surface(mi, slanted(degrees), count), u1, u2, True)
            drawn = row(weight, count).mean(1)
            # 5e-3: Walter's rational G1 of the Beckmann distribution is good to 3.5e-3, and the density (the stock
            # one's, too) is made of it; the quadrature leaves 1e-3 next to critical angles, a quarter of a million
            # draws 1e-3
            assert np.abs(sent - drawn).max() <= 5e-3
            assert (np.array(density) * solid).sum() == pytest.approx((np.array(bs.pdf) > 0).mean(), abs=5e-3)
            for total in (sent, drawn):
                assert total[0] > 0.4 and total[0] + np.linalg.norm(total[1:]) <= 1 + 1e-3


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("index, alpha", [(1.5, 0.05), (0.7, 0.3), (1.001, 0.5), (2.3, 0.9), (0.45, 0.01), (1.4, 0.0)])
def test_every_matrix_is_physical(mitsuba, kind, index, alpha):
    """The coherency matrix of every value and every weight has no negative eigenvalue (Cloude, Proc. SPIE 1166, 177,
    1989)."""
    mi = mitsuba
    bsdf, rng, count = boundary(mi, index, alpha, kind), RNG(7), 4000
    wi, (u1, u2) = sphere(rng, count, 0.0), draws(mi, rng, count)  # along the surface, too
    bs, weight = bsdf.sample(context(mi), surface(mi, wi), u1, u2, True)
    value = bsdf.eval(context(mi), surface(mi, wi), bs.wo, True)
    sigma = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, -1j], [1j, 0]]])
    for found in (matrices(mi, weight, count), matrices(mi, value, count)):
        assert np.isfinite(found).all()
        some = found[found[:, 0, 0] > 1e-20]
        assert len(some) > 0.7 * count or (alpha == 0 and len(some) == 0)  # a smooth boundary has no values
        coherency = (
            sum(some[:, i, j, None, None] * np.kron(sigma[i], sigma[j].conj()) for i in range(4) for j in range(4)) / 4
        )
        lowest = np.linalg.eigvalsh(coherency)[:, :1] / np.real(np.trace(coherency, axis1=1, axis2=2))[:, None]
        assert (lowest >= -1e-5).all()  # rounding leaves -1e-6


def test_a_slightly_rough_boundary_keeps_the_polarization_that_the_stock_one_loses(mitsuba):
    """Light polarized at 45 deg that meets the boundary at the normal, all that passes summed up."""
    mi, size = mitsuba, 128
    for kind in KINDS:
        for alpha, floor in (
            (0.05, 0.99999),
            (0.4, 0.999),
        ):  # measured: 0.999999 and 0.9996 (ggx), 1 and 0.99997 (beckmann)
            kept, lost = (
                matrices(
                    mi,
                    make(mi, 1.5, alpha, kind).sample(
                        context(mi, 1, "Importance"),
                        surface(mi, slanted(0.0), size**2),
                        mi.Float(0.5),
                        grid(mi, size),
                        True,
                    )[1],
                    size**2,
                ).mean(0)
                @ [1, 0, 1, 0]
                for make in (boundary, stock)
            )
            assert floor <= np.linalg.norm(kept[1:]) / kept[0] <= 1 + 1e-5
            assert kept[2] / kept[0] > floor and (lost[1:] == 0).all()
            assert kept[0] == pytest.approx(lost[0], rel=1e-5)


# -- near the values where an effect vanishes ------------------------------------------------------------------------
@pytest.mark.parametrize("index", [1.5, 0.7])
def test_roughness_sets_in_with_its_square(mitsuba, index):
    """Means over the refracted lobe of `beckmann`: four times as far from the smooth boundary at twice the
    roughness."""
    mi, size = mitsuba, 256
    means = []
    for alpha in (0.0, 0.02, 0.04):
        bs, weight = boundary(mi, index, alpha).sample(
            context(mi, 1), surface(mi, slanted(20.0), size**2), mi.Float(0.5), grid(mi, size), True
        )
        matrix = matrices(mi, weight, size**2)
        means.append([(matrix[:, 0, 0] * np.array(bs.wo)[2]).mean(), matrix[:, 1, 1].mean()])
    rest, once, twice = np.array(means, float)
    # 5 %: the fourth power of 0.04, and the grid's 256 x 256
    assert (twice - rest) / (once - rest) == pytest.approx([4, 4], rel=0.05)


def test_a_smooth_boundary_is_one_direction_each_way(mitsuba):
    mi = mitsuba
    f = mi.BSDFFlags
    wi, count = sphere(RNG(8), 500), 500
    for alpha, types in (
        (0.0, f.DeltaReflection | f.DeltaTransmission),
        (0.01, f.GlossyReflection | f.GlossyTransmission),
    ):
        bsdf = boundary(mi, 1.5, alpha)
        bs, _ = bsdf.sample(context(mi), surface(mi, wi), *draws(mi, RNG(9), count), True)
        kinds = np.array(bs.sampled_type)
        assert np.bitwise_or.reduce(kinds) == int(types)
        reflected = np.array(bs.wo)[2] * wi[:, 2] > 0
        assert ((np.array(bs.sampled_component) == 0) == reflected).all() and 0 < reflected.sum() < count
        mirror = bsdf.eval_pdf(context(mi), surface(mi, wi), vectors(mi, wi * [-1, -1, 1]), True)
        assert (intensity(mi, mirror[0], count) > 0).all() == (alpha > 0) == (np.array(mirror[1]) > 0).all()


@pytest.mark.parametrize("alpha", [0.0, 0.5])
def test_at_index_1_it_is_not_there(mitsuba, alpha):
    mi, count = mitsuba, 2000
    bsdf, wi = boundary(mi, 1.0, alpha), sphere(RNG(10), count, 0.0)
    si = surface(mi, wi)
    bs, weight = bsdf.sample(context(mi), si, *draws(mi, RNG(11), count), True)
    assert np.abs(np.array(bs.wo).T + wi).max() < 1e-6
    assert np.abs(matrices(mi, weight, count) - np.eye(4)).max() < 1e-5
    assert (np.array(bs.sampled_type) == int(mi.BSDFFlags.Null | mi.BSDFFlags.DeltaTransmission)).all()
    assert (intensity(mi, bsdf.eval_null_transmission(si, True), count) == 1).all()
    assert (intensity(mi, bsdf.eval(context(mi), si, bs.wo, True), count) == 0).all()
    assert (intensity(mi, boundary(mi, 1.1, alpha).eval_null_transmission(si, True), count) == 0).all()


@pytest.mark.parametrize("name", ["index", "alpha"])
def test_derivatives_follow_the_sampled_directions(mitsuba, name):
    """Forward mode through sample, directions and weights: each way alone against central differences with the same
    random numbers, and the chance of either way against both ways' sum."""
    import drjit as dr

    mi, count = mitsuba, 2**16
    bsdf = boundary(mi, 1.5, 0.2, "ggx")
    held = mi.traverse(bsdf)
    rest, (u1, u2) = float(held[name][0]), draws(mi, RNG(12), count)

    def seen(way, value, derivative=False):
        held[name] = dr.opaque(mi.Float, value)
        if derivative:
            dr.enable_grad(held[name])
        held.update()
        bs, weight = bsdf.sample(context(mi, way), surface(mi, slanted(55.0), count), u1, u2, True)
        image = (
            weight[0, 0][0] * (1 + bs.wo.x + dr.square(bs.wo.z)) + weight[1, 0][0]
        )  # a smooth world, lit a little polarized
        if derivative:
            dr.set_grad(held[name], 1.0)
            dr.forward_to(image)
        return np.array(dr.grad(image) if derivative else image, float)

    total, h = 0.0, 2e-3
    for way in (0, 1):
        found, expected = seen(way, rest, True), (seen(way, rest + h) - seen(way, rest - h)) / (2 * h)
        assert np.isfinite(found).all() and np.abs(expected.mean()) > 0.01
        # 3e-3: the third derivative over a step of 1 % of alpha; draws that change sides within the step
        assert found.mean() == pytest.approx(expected.mean(), rel=3e-3)
        total += found.mean()
    both = seen(None, rest, True)
    assert both.mean() == pytest.approx(total, abs=4 * both.std() / np.sqrt(count))  # always the same draws
    assert both.std() / np.sqrt(count) < 0.03 * abs(total)


# -- in a scene ------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize(
    "integrator, stride",
    [
        ({"type": "stokes", "nested": {"type": "path", "max_depth": 5}}, 3),
        ({"type": "tactile", "stokes": True, "max_depth": 3}, 4),
    ],
    ids=["path", "tactile"],
)
def test_a_lamp_behind_a_polarizer_seen_through_rough_glass(mitsuba, integrator, stride):
    """Its Stokes vector is the bare one times T/n^2 or T n^2, however the glass is turned about its normal; stock:
    unpolarized."""
    mi = mitsuba
    turn = mi.ScalarTransform4f

    def stokes(bsdf, roll=0.0, flip=180.0):
        pane = (
            {}
            if bsdf is None
            else {
                "pane": {
                    "type": "rectangle",
                    "bsdf": bsdf,
                    "to_world": turn().rotate([0, 0, 1], roll).rotate([1, 0, 0], flip).scale(3),
                }
            }
        )
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": integrator,
                **pane,
                "sensor": {
                    "type": "perspective",
                    "fov": 8,
                    "to_world": turn().look_at([0, 0, -9], [0, 0, 0], [0, 1, 0]),
                    "film": {
                        "type": "hdrfilm",
                        "width": 4,
                        "height": 4,
                        "rfilter": {"type": "box"},
                        "pixel_format": "rgb",
                    },
                    "sampler": {"type": "independent", "sample_count": 256},
                },
                "film": {
                    "type": "rectangle",
                    "to_world": turn().translate([0, 0, 4]).rotate([1, 0, 0], 180).scale(60),
                    "bsdf": {"type": "polarizer", "theta": 27.0},
                },
                "lamp": {
                    "type": "rectangle",
                    "to_world": turn().translate([0, 0, 5]).rotate([1, 0, 0], 180).scale(60),
                    "emitter": {"type": "area", "radiance": {"type": "uniform", "value": 1.0}},
                },
            },
            optimize=False,
        )
        image = np.array(mi.render(scene, seed=1)).mean((0, 1))
        return image[3:][::stride][:4]

    bare = stokes(None)
    degree = np.linalg.norm(bare[1:]) / bare[0]
    assert degree == pytest.approx(1, abs=1e-3)
    rough = {"type": "rough_interface", "index": 1.5, "alpha": 0.1}
    for roll, flip in ((0.0, 180.0), (35.0, 180.0), (-70.0, 0.0)):
        found = stokes(rough, roll, flip)
        # 2 %: 4096 paths, of which 4 % are reflected into the dark; 2e-3: facets met at up to 10 deg
        assert found[0] / bare[0] == pytest.approx(0.96 * 1.5 ** (-2 if flip else 2), rel=0.02)
        assert found[1:] / found[0] == pytest.approx(bare[1:] / bare[0], abs=2e-3)
    lost = stokes({"type": "roughdielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 0.1})
    assert np.abs(lost[1:] / lost[0]).max() < 1e-6 and lost[0] == pytest.approx(stokes(rough)[0], rel=1e-3)
