"""Clear material: what a transparent body is made of, on the body's surface.

Definition
    n1 sin(theta1) = n2 sin(theta2)                              Snell (21-23), n1 and n2 of the two materials that meet
    s'' = s - 2 g (g.s)                                          reflection (24), of all light beyond asin(n2/n1)
    R, T by Fresnel's formulae                                   with polarization, in place of the free factors mu',
    mu'' of (25, 26)
    I exp(-alpha d)                                              Beer-Lambert along every stretch d inside (27-29)
`index` and `absorption` hold at 540 nm; how they change with the wavelength are effects (`dispersion`, `coloured
absorption`) or measured curves (XML). The surface's normals point out of the body. `outside` (XML) names the clear
material around it, as the wall around a cell's filling; without it that is air.
Fingerprint
    walls show as bright and dark lines, totally reflecting where they are met at grazing incidence; absorption darkens
    long ways.
Validity
    thicker than the coherence length of an LED's light (some 10 um): no interference. Faces are smooth but for `rough
    walls`.
References
    Fan, Li, Cong & Zhang, MagicGripper, supplementary VII-A, eqs. (18)-(29); Born & Wolf, Principles of Optics, 1.5.
XML
    outside string: id of the clear material around the body; without it, air
    index_spectrum string: form of the index over the wavelength, which `index` shifts: a file, a name or a law
    absorption_spectrum string: form of the absorption over the wavelength, which `absorption` scales
"""

from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.parameter import Parameter
from optics.scene.surfaces import passing

PARAMETERS = (
    Parameter(
        "index", "1", 1.5, (1.0, 2.5), "refractive index n at 540 nm", plausible=0.01, how="difference", step=1.0
    ),
    Parameter(
        "absorption",
        "1/mm",
        0.0,
        (0.0, 10.0),
        "absorption coefficient alpha at 540 nm",
        neutral=0.0,
        plausible=0.01,
        how="path",
    ),
)


def build():
    import drjit as dr
    import mitsuba as mi

    from optics.errors import BadScene
    from optics.polarization.mueller import diattenuator, fresnel, fresnel_reflection
    from optics.scene.surfaces import MIDDLE, coefficient

    class Clear(passing(mi.BSDFFlags.DeltaTransmission)):
        kind = "clear"
        around = None  # the clear material outside; None is air
        unrendered = dict.fromkeys(
            ("scattering", "roughness", "birefringence"),
            "mi.render follows neither scattering, roughness nor birefringence",
        )
        fills_cells = False  # what light is scattered is known in cells only
        bands = 3  # of the scene

        def __init__(self, props):
            self.outside = str(props.get("outside", ""))
            super().__init__(props)
            self.read_spectrum(props, "index_spectrum", "index")
            absorption = self.read_spectrum(props, "absorption_spectrum", "absorption")
            if absorption is not None and not absorption(MIDDLE) > 0:
                raise ValueError(f"{self.name}.absorption_spectrum is 0 at {MIDDLE:g} nm, where `absorption` holds")
            if self.outside:
                self._waits = f"'{self.name}' lies inside '{self.outside}'"
            sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_components = [
                mi.BSDFFlags.DeltaReflection | sides,
                mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.NonSymmetric | sides,
            ]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def wire(self, scene):
            self.fills_cells = any(hasattr(shape, "cells") for shape in scene.shapes_of(self))
            self.bands = len(getattr(scene.integrator, "bands", range(self.bands)))
            self.around = scene.named(self.outside) if self.outside else None
            if self.outside and getattr(self.around, "role", "") != self.role:
                others = ", ".join(p.name for p in scene.parts if p.role == self.role and p is not self)
                raise BadScene(
                    f"'{self.name}': outside = '{self.outside}'; allowed: the id of a clear material ("
                    f"{others or 'there is no other'}), or nothing for air"
                )

        def takes(self, name):
            if name in ("dispersion", "absorption_slope"):  # of one band they say no more than the coefficient itself
                return self.bands > 1
            return name != "scattering" or self.fills_cells

        def context(self, words):
            return {"curves": self.curves}

        def fading(self, wavelengths):
            """alpha per band, 1/mm."""
            return coefficient(self, "absorption", wavelengths, self.functions("absorption"))

        def refractive(self, wavelengths):
            """n per band."""
            return coefficient(self, "index", wavelengths, self.functions("index"))

        def sample(self, ctx, si, sample1, sample2, active=True):
            cos = mi.Frame3f.cos_theta(si.wi)
            front = cos >= 0
            bands = (
                mi.UnpolarizedSpectrum(si.wavelengths) if mi.is_spectral else mi.UnpolarizedSpectrum(self.band or 540.0)
            )
            around = self.around
            # a ray has one direction for all bands: that of the first
            n = self.refractive(bands)[0] / (around.refractive(bands)[0] if around is not None else 1.0)
            n = dr.select(front, n, 1 / n)
            r_s, r_p, cos2 = fresnel(dr.minimum(dr.abs(cos), 1.0), n)
            share = (r_s + r_p) / 2
            ways = ctx.is_enabled(mi.BSDFFlags.DeltaReflection, 0), ctx.is_enabled(mi.BSDFFlags.DeltaTransmission, 1)
            chance = dr.detach(share) if all(ways) else mi.Float(float(ways[0]))
            reflected = sample1 < chance
            back = dr.select(front, 1.0, -1.0)
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = dr.select(
                reflected,
                mi.Vector3f(-si.wi.x, -si.wi.y, si.wi.z),
                mi.Vector3f(-si.wi.x / n, -si.wi.y / n, -back * cos2),
            )
            bs.eta = dr.select(reflected, 1.0, n)
            bs.pdf = dr.select(reflected, chance, 1 - chance)
            bs.sampled_component = dr.select(reflected, mi.UInt32(0), mi.UInt32(1))
            bs.sampled_type = dr.select(
                reflected, mi.UInt32(+mi.BSDFFlags.DeltaReflection), mi.UInt32(+mi.BSDFFlags.DeltaTransmission)
            )
            # along the stretch that the ray has come, towards the camera: it lies outside where the front was met
            alpha = dr.select(front, around.fading(bands) if around is not None else 0.0, self.fading(bands))
            weight = dr.exp(-alpha * si.t) / bs.pdf
            weight *= dr.select(reflected | (ctx.mode != mi.TransportMode.Radiance), 1.0, 1 / dr.square(n))
            if not mi.is_polarized:
                value = mi.Spectrum(weight * dr.select(reflected, share, 1 - share))
            else:
                value = self.turned(
                    ctx,
                    si.wi,
                    bs.wo,
                    dr.select(
                        reflected,
                        fresnel_reflection(dr.minimum(dr.abs(cos), 1.0), n).mitsuba(),
                        diattenuator(1.0, 0.0, 1 - r_s, 1 - r_p).mitsuba(),
                    )
                    * mi.mueller.absorber(weight),
                )
            return bs, dr.select(active & (bs.pdf > 0), value, 0.0)

        def turned(self, ctx, wi, wo, matrix):
            """A matrix between axes (s, p) as one between the axes that Mitsuba implies for both rays."""
            arriving, leaving = (-wo, wi) if ctx.mode == mi.TransportMode.Radiance else (-wi, wo)
            s = dr.cross(mi.Vector3f(0, 0, 1), leaving)
            level = dr.squared_norm(s) < 1e-10  # at normal incidence every axis serves
            basis_in, basis_out = mi.mueller.stokes_basis(arriving), mi.mueller.stokes_basis(leaving)
            s = dr.select(level, basis_out, dr.normalize(s))
            return mi.mueller.rotate_mueller_basis(matrix, arriving, s, basis_in, leaving, s, basis_out)

    return Clear


def check_faces():
    """Along the normal a face of the index 1.5 reflects 4 % from either side; beyond the critical angle it reflects all
    light."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    glass = made("clear", index=1.5)

    def weight(wi, component):
        context, si = mi.BSDFContext(), dr.zeros(mi.SurfaceInteraction3f, 1)
        context.component, si.wi, si.t = component, mi.Vector3f(*wi), mi.Float(1)
        found = glass.sample(context, si, mi.Float(0.5), mi.Point2f(0.5))[1]
        return np.array(mi.unpolarized_spectrum(found)).ravel()[0]

    for cos in (1.0, -1.0):
        agree(weight((0, 0, cos), 0), 0.04, 1e-5)
    inside = (0.8, 0.0, -0.6)  # sin = 0.8 > 1/1.5
    agree([weight(inside, 0), weight(inside, 1)], [1.0, 0.0], 1e-5)


def random(rng):
    """A printed resin, clear over centimetres."""
    return {"index": rng.uniform(1.4, 1.6), "absorption": rng.uniform(0, 0.05)}


part = Part("clear", "bsdf", PARAMETERS, build, checks=(check_faces,), random=random)
