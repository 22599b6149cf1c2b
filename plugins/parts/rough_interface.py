"""Rough interface: a ground or etched clear boundary that reflects and refracts, and keeps polarization.

Definition
    f(wi, wo) cos(theta_o) = M(m) D(m) G1(wi) G1(wo) |wi.m| / |wi.n| J
    J = 1/(4 |wo.m|) reflected,   nu^2 |wo.m| / (wi.m + nu wo.m)^2 refracted (over nu^2 where radiance is followed)
of mirror-like facets with normals m about the surface's normal n, as common as D(m) says and seen as often as Smith's
G1 says (`distribution` beckmann or ggx; roughness `alpha`, the rms slope of beckmann's facets). nu is `index` from the
side that n points to, 1/index from behind. M(m) is Fresnel's Mueller matrix of the facet, its axes s and p across and
in the plane of wi and wo, turned to the axes that Mitsuba implies for a ray:
    M_r = [[a, b, 0, 0], [b, a, 0, 0], [0, 0, Re z, -Im z], [0, 0, Im z, Re z]],   a, b = (|r_s|^2 +- |r_p|^2)/2,  z =
    r_p r_s*
    M_t = [[a, b, 0, 0], [b, a, 0, 0], [0, 0, c, 0], [0, 0, 0, c]],    a, b = (T_s +- T_p)/2,  c = sqrt(T_s T_p)
    r_s = (c1 - nu c2)/(c1 + nu c2),  r_p = (nu c1 - c2)/(nu c1 + c2),  T_s = 4 nu c1 c2/(c1 + nu c2)^2,  T_p with nu c1
                                      + c2
c2 = -i sqrt((1 - c1^2)/nu^2 - 1) beyond the critical angle: all is reflected, with the phase between p and s as arg z.
Fingerprint
    what lies behind is blurred, the more the farther behind it lies; lights show as broad glints, polarized away from
    the normal. Crossed polarizers stay nearly dark: facets that light meets obliquely leave four weak lobes about the
    glint.
Validity
    light that facets pass on to each other is lost: of a beam along the normal of index 1.5, beckmann loses nothing at
    alpha 0.3 and 1 % at 0.7 (from the dense side 0 and 19 %), ggx 1 and 6 % (10 and 40 %). One index for all bands. A
    lobe narrower than 1e-4 rad is one direction; at index 1 the boundary is not there, whatever its roughness. The
    effect of alpha is its square for beckmann; the tail of ggx makes it alpha^2 ln(1/alpha). For mi.render: the quick
    prediction LED by LED looks through flat interfaces only. To pass it is a bounce of the integrator `tactile`, which
    its `max_depth` and `interreflection` count.
References
    Walter, Marschner, Li & Torrance, EGSR 2007, eqs. (17), (20)-(27), (33), (34); Heitz & d'Eon, CGF 33, 103 (2014),
    for the sampling of visible facets; Born & Wolf, Principles of Optics, 1.5.2 and 1.5.4.
"""

from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.mitsuba_parts import Declared
from optics.scene.parameter import Parameter

# a lobe narrower than this (rad) is one direction: float32 leaves 6e-8 of a direction, 6e-4 of such a lobe's width
SHARP = 1e-4

PARAMETERS = (
    Parameter(
        "index",
        "1",
        1.0,
        (0.4, 2.5),
        "n2/n1: index of the far side relative to the side that the normal points to",
        neutral=1.0,
        plausible=0.4,
        how="difference",
    ),
    Parameter(
        "alpha",
        "1",
        0.0,
        (0.0, 1.0),
        "roughness alpha of the facets; 0: smooth",
        neutral=0.0,
        plausible=0.1,
        how="difference",
        squared=True,
    ),
    Parameter("distribution", "-", "beckmann", choices=("beckmann", "ggx"), doc="distribution D of the facets' slopes"),
)


def build():
    import drjit as dr
    import mitsuba as mi

    def turn(forward, axis, target):
        """Stokes vectors of light along `forward`, from one axis across it to another (rotate_stokes_basis without
        angles, whose derivative is not finite where the two axes agree)."""
        c, s = dr.dot(axis, target), dr.dot(forward, dr.cross(axis, target))
        q, u = c * c - s * s, 2 * c * s
        return mi.Matrix4f(1, 0, 0, 0, 0, q, u, 0, 0, -u, q, 0, 0, 0, 0, 1)

    class Facet:
        """Fresnel's formulae at one facet: nu, cosines, amplitudes, reflectance r; for c1 = wi.m of any sign, all in
        mi.Float."""

        def __init__(self, nu, along):
            self.nu, self.along = nu, along
            self.c1 = c1 = dr.abs(along)
            square = c1 * c1 + (nu - 1) * (nu + 1)  # (nu c2)^2, without rounding where nu is 1
            self.c2 = c2 = dr.safe_sqrt(square) / nu  # 0 beyond the critical angle
            beyond = mi.Complex2f(c2, -dr.safe_sqrt(-square) / nu)
            self.r_s, self.r_p = (c1 - nu * beyond) / (c1 + nu * beyond), (nu * c1 - beyond) / (nu * c1 + beyond)
            self.r = (dr.squared_norm(self.r_s) + dr.squared_norm(self.r_p)) / 2

        def reflection(self):
            b, z = (dr.squared_norm(self.r_s) - dr.squared_norm(self.r_p)) / 2, self.r_p * dr.conj(self.r_s)
            return mi.Matrix4f(self.r, b, 0, 0, b, self.r, 0, 0, 0, 0, z.real, -z.imag, 0, 0, z.imag, z.real)

        def transmission(self):
            to_s, to_p = self.c1 + self.nu * self.c2, self.nu * self.c1 + self.c2
            common = 4 * self.nu * self.c1 * self.c2
            t_s, t_p, c = common / (to_s * to_s), common / (to_p * to_p), common / (to_s * to_p)
            a, b = (t_s + t_p) / 2, (t_s - t_p) / 2
            return mi.Matrix4f(a, b, 0, 0, b, a, 0, 0, 0, 0, c, 0, 0, 0, 0, c)

    class RoughInterface(Declared.on(mi.BSDF)):
        kind = "rough_interface"

        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.declare(props)
            f = mi.BSDFFlags
            sides = f.FrontSide | f.BackSide
            # also Delta and Null: what a smooth surface, or one of index 1, is
            self.m_components = [
                f.GlossyReflection | f.DeltaReflection | sides,
                f.GlossyTransmission | f.DeltaTransmission | f.Null | f.NonSymmetric | sides,
            ]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def facets(self):
            name = {"beckmann": "Beckmann", "ggx": "GGX"}[self.distribution]
            return mi.MicrofacetDistribution(getattr(mi.MicrofacetType, name), self.alpha)

        def relative(self, wi):
            return dr.select(wi.z >= 0, self.index, 1 / self.index)

        def absent(self):
            return dr.abs(self.index - 1) < 1e-6

        def sharp(self, reflected):
            """Whether a lobe is one direction: the reflected one as wide as alpha, the refracted one as alpha |index -
            1|."""
            return self.alpha * dr.select(reflected, 1, dr.abs(self.index - 1)) <= SHARP

        def share(self, ctx, facet, reflected):
            """Probability of the way that is taken: by the reflectance, unless only one way is asked for."""
            ways = ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0), ctx.is_enabled(mi.BSDFFlags.GlossyTransmission, 1)
            r = facet.r if all(ways) else mi.Float(float(ways[0]))
            return dr.select(reflected, r, 1 - r) * float(any(ways))

        def passed(self, ctx, wi, wo, facet, reflected):
            """M of a facet between Mitsuba's axes of both rays, over nu^2 where radiance is refracted; else M_00 as a
            spectrum."""
            to_source = ctx.mode == mi.TransportMode.Radiance
            scale = dr.select(reflected | (not to_source), 1, 1 / dr.square(facet.nu))
            matrix = dr.select(reflected, facet.reflection(), facet.transmission()) * scale
            if not mi.is_polarized:
                return mi.Spectrum(matrix[0, 0])
            arriving, leaving = (-wo, wi) if to_source else (-wi, wo)
            s = dr.cross(wi, wo)
            level = dr.squared_norm(s) < 1e-8  # there the facet acts alike on every axis
            basis_in, basis_out = mi.mueller.stokes_basis(arriving), mi.mueller.stokes_basis(leaving)
            s = dr.select(level, basis_out, dr.normalize(s))
            return mi.Spectrum(turn(leaving, s, basis_out) @ matrix @ turn(arriving, basis_in, s))

        def spread(self, along, across, nu, reflected):
            """J = d omega_m / d omega_o for along = wi.m and across = wo.m."""
            return dr.select(reflected, 0.25 / dr.abs(across), dr.abs(across) * dr.square(nu / (along + nu * across)))

        # -- Mitsuba --------------------------------------------------------------------------------------------------
        def sample(self, ctx, si, sample1, sample2, active=True):
            wi, facets = si.wi, self.facets()
            m, density = facets.sample(dr.mulsign(wi, wi.z), sample2)
            smooth = (self.alpha <= SHARP) | self.absent()
            m = dr.select(smooth, mi.Normal3f(0, 0, 1), m)
            along, nu = dr.dot(wi, m), self.relative(wi)
            facet = Facet(nu, along)
            reflected = sample1 < dr.detach(self.share(ctx, facet, mi.Bool(True)))
            wo = dr.select(reflected, 2 * along * m - wi, (along / nu - dr.mulsign(facet.c2, along)) * m - wi / nu)
            probability = self.share(ctx, facet, reflected)
            seen, sharp = dr.select(smooth, 1, facets.smith_g1(wo, m)), self.sharp(reflected)
            valid = (
                active
                & (wi.z != 0)
                & (density > 0)
                & (seen > 0)
                & (probability > 0)
                & ((wi.z * wo.z > 0) == reflected)
                & (reflected | (facet.c2 > 0))
            )

            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo, bs.eta = wo, dr.select(reflected, 1, nu)
            density = dr.select(sharp, 1, density * self.spread(along, dr.dot(wo, m), nu, reflected))
            bs.pdf = dr.select(valid, density * probability, 0)
            f = mi.BSDFFlags
            through = dr.select(self.absent(), mi.UInt32(f.DeltaTransmission | f.Null), mi.UInt32(+f.DeltaTransmission))
            bs.sampled_type = dr.select(
                sharp,
                dr.select(reflected, mi.UInt32(+f.DeltaReflection), through),
                dr.select(reflected, mi.UInt32(+f.GlossyReflection), mi.UInt32(+f.GlossyTransmission)),
            )
            bs.sampled_component = dr.select(reflected, mi.UInt32(0), mi.UInt32(1))
            weight = self.passed(ctx, wi, wo, facet, reflected) * (seen / dr.detach(probability))
            return bs, dr.select(valid, weight, 0)

        def eval_pdf(self, ctx, si, wo, active=True):
            wi, facets = si.wi, self.facets()
            reflected, nu = wi.z * wo.z > 0, self.relative(wi)
            m = dr.normalize(wi + wo * dr.select(reflected, 1, nu))
            m = dr.mulsign(m, m.z)
            along, across = dr.dot(wi, m), dr.dot(wo, m)
            facet = Facet(nu, along)
            asked = ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0) & reflected | (
                ctx.is_enabled(mi.BSDFFlags.GlossyTransmission, 1) & ~reflected
            )
            valid = active & asked & (along * wi.z > 0) & (across * wo.z > 0) & ~self.sharp(reflected)
            density = facets.pdf(dr.mulsign(wi, wi.z), m) * self.spread(along, across, nu, reflected)
            value = self.passed(ctx, wi, wo, facet, reflected) * (density * facets.smith_g1(wo, m))
            return dr.select(valid, value, 0), dr.select(valid, density * self.share(ctx, facet, reflected), 0)

        def eval(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[1]

        def eval_null_transmission(self, si, active=True):
            return dr.select(self.absent() & active, mi.Spectrum(1), mi.Spectrum(0))

        def to_string(self):
            return f"RoughInterface[{self.name}]"

    return RoughInterface


def check_mirror_direction():
    """Along the normal of Beckmann's facets of the slope alpha, D(0) = 1/(pi alpha^2): the light that comes straight
    back has the radiance R D/4, R = ((n - 1)/(n + 1))^2, and what passes straight T D n^2/(n - 1)^2/n^2."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    n, alpha = 1.5, 0.2
    face, si = made("rough_interface", index=n, alpha=alpha), dr.zeros(mi.SurfaceInteraction3f, 1)
    si.wi = mi.Vector3f(0, 0, 1)
    d = 1 / (np.pi * alpha**2)
    for cos, expected in ((1.0, 0.04 * d / 4), (-1.0, 0.96 * d / (n - 1) ** 2)):
        found = face.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, cos))
        agree(np.array(mi.unpolarized_spectrum(found)).ravel()[0], expected, 1e-5)


def random(rng):
    """Ground glass in air."""
    return {"index": rng.uniform(1.35, 1.6), "alpha": rng.uniform(0.05, 0.5)}


part = Part("rough_interface", "bsdf", PARAMETERS, build, checks=(check_mirror_direction,), random=random)
