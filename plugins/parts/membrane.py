"""Membrane: the coated inner face of the skin, a generalised Lambertian reflector.

Definition
    f(wi, wo) = rho_c / pi (A + B max(0, cos(phi_r - phi_i)) sin(alpha) tan(beta))      (S3)
    A = 1 - 0.5 s2/(s2 + 0.33)      B = 0.45 s2/(s2 + 0.09)      s2 = sigma^2
with the reflectance rho_c of each band (red, green, blue: the first three bands of the integrator, times an optional
texture `reflectance`), the roughness sigma (rad) of the facets, alpha and beta the larger and the smaller of the angles
to the normal. With s = wi.wo - cos_i cos_o the product cos(phi) sin(alpha) tan(beta) is s / max(cos_i, cos_o), which
has no singularity (Oren & Nayar's qualitative model).
Fingerprint
    rho scales a band everywhere; sigma brightens grazing views of slopes that face the light and flattens the shading.
Validity
    opaque coating, no lobe towards the mirror direction (the effect "specular lobe" adds one); depolarizes fully. The
    formula as published returns up to 1.5 % more light than it gets from beyond 65 deg for sigma of 0.05 to 0.3; over
    all directions less.
References
    F-TAC Hand supplementary information, S1.4, eq. (S3); Oren & Nayar, IJCV 14, 227 (1995).
XML
    reflectance texture, 1.0: a factor of the reflectance that varies over the surface; as a string, one that varies
        with the wavelength: a file, a name or pairs, such as "colour:dark skin"
"""

from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.parameter import Parameter
from optics.scene.surfaces import matt, texture_of

PARAMETERS = (
    Parameter(
        "rho_r",
        "1",
        1.0,
        (0.0, 10.0),
        "reflectance rho in the first band (red)",
        plausible=0.1,
        linear=True,
        band=0,
        free="all",
    ),
    Parameter(
        "rho_g",
        "1",
        1.0,
        (0.0, 10.0),
        "reflectance rho in the second band (green)",
        plausible=0.1,
        linear=True,
        band=1,
        free="all",
    ),
    Parameter(
        "rho_b",
        "1",
        1.0,
        (0.0, 10.0),
        "reflectance rho in the third band (blue)",
        plausible=0.1,
        linear=True,
        band=2,
        free="all",
    ),
    Parameter(
        "sigma",
        "rad",
        0.2,
        (0.0, 1.5),
        "roughness sigma of (S3)",
        plausible=0.1,
        squared=True,
        saturates=0.3,
        free="all",
    ),
)


def build():
    import drjit as dr
    import mitsuba as mi

    class Membrane(matt()):
        kind = "membrane"

        def __init__(self, props):
            super().__init__(props)
            named = props.get("reflectance") if "reflectance" in props else None
            if isinstance(named, str):  # a measured curve, as a spectrum of Mitsuba's
                curve = self.read_spectrum(props, "reflectance", "reflectance")
                self.reflectance = texture_of(curve, self.band)
            else:
                self.reflectance = props.get_texture("reflectance", 1.0)

        def traverse(self, cb):
            self.put_parameters(cb)
            cb.put("reflectance", self.reflectance, mi.ParamFlags.Differentiable)

        def albedo(self, si, active=True):
            """rho_c times the texture, per band."""
            return self.rho(si) * self.reflectance.eval(si, active)

        def rough(self):
            """(A, B) of the facets' roughness."""
            s2 = dr.square(self.sigma)
            return 1 - 0.5 * s2 / (s2 + 0.33), 0.45 * s2 / (s2 + 0.09)

        def brdf(self, si, wo, active=True):
            """f(wi, wo) per band, 1/sr, without the cosine."""
            cos_v, cos_l = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
            a, b = self.rough()
            s = dr.dot(si.wi, wo) - cos_v * cos_l
            tilt = dr.select(s > 0, s / dr.maximum(dr.maximum(cos_v, cos_l), 1e-6), 0.0)
            albedo = self.albedo(si, active)
            facets = albedo * ((a + b * tilt) * dr.inv_pi)
            value = mi.UnpolarizedSpectrum(facets)
            for function in self.functions("reflection"):
                value += function(Geometry(si, wo, cos_v, cos_l, albedo, facets), self)
            return value

        def ambient_radiance(self, si):
            """Radiance that no LED made, per band (0 unless an effect adds some)."""
            value = mi.UnpolarizedSpectrum(0.0)
            for function in self.functions("ambient"):
                value += function(Geometry(si, si.wi, mi.Frame3f.cos_theta(si.wi), None, self.albedo(si)), self)
            return value

    return Membrane


class Geometry:
    """What a `reflection` or `ambient` function sees: surface interaction, local direction to the light, cosines, rho,
    and what the membrane reflects without effects, 1/sr."""

    def __init__(self, si, wo, cos_view, cos_light, albedo, facets=None):
        self.si, self.wi, self.wo = si, si.wi, wo
        self.cos_view, self.cos_light, self.albedo, self.facets = cos_view, cos_light, albedo, facets


def check_lambert():
    """rho cos/pi of a smooth face in every direction; a rough one, sigma = 0.5, is A rho/pi along the normal, whatever
    the light's direction."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    wi = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [-0.8, 0.0, 0.6]])
    si = dr.zeros(mi.SurfaceInteraction3f, 3)
    si.t, si.wi = mi.Float(1), mi.Vector3f(*wi.T.astype("f"))
    for sigma, towards, share in ((0.0, [0.6, 0.0, 0.8], 1.0), (0.5, [0.0, 0.0, 1.0], 1 - 0.125 / 0.58)):
        face = made("membrane", rho_r=0.7, rho_g=0.5, rho_b=0.2, sigma=sigma)
        found = face.eval(mi.BSDFContext(), si, mi.Vector3f(*towards), True)
        expected = np.outer([0.7, 0.5, 0.2], [share * towards[2] / np.pi] * 3)
        agree(np.array(mi.unpolarized_spectrum(found))[:3], expected, 1e-5)


def random(rng):
    """A coloured paint."""
    return {"sigma": rng.uniform(0.05, 0.6), **{f"rho_{c}": rng.uniform(0.2, 0.9) for c in "rgb"}}


part = Part("membrane", "bsdf", PARAMETERS, build, checks=(check_lambert,), random=random)
