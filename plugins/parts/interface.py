"""Interface: a flat, clear boundary between two media that the camera looks through.

Definition
    n1 sin(theta1) = n2 sin(theta2)                              Snell, `index` = n2/n1
    T_s = 1 - ((c1 - n c2)/(c1 + n c2))^2,  T_p = 1 - ((n c1 - c2)/(n c1 + c2))^2
    L1 = T L2 / n^2                                              radiance seen from the side of medium 1
with c = cos(theta), n = index; medium 1 is on the side that the surface's normal points to (the camera's side). Light
is always transmitted; the reflected share is lost (its weight is the transmitted one), so that a ray never branches and
the index never enters a sampling probability. Two of them make a window: air to acrylic, acrylic to gel.
Fingerprint
    the image shrinks towards the axis, more with depth; a small fall-off towards the corners.
Validity
    no reflection from the window; flat and parallel to itself. At index 1 the interface is not there. The light of LEDs
    passes it straight, but for images LED by LED of a gel full of beads: there it is bent (`optics.light.windows`).
References
    Born & Wolf, Principles of Optics, 1.5.2 (Fresnel's formulae).
"""

from optics.scene.checking import agree, made
from optics.scene.declare import Part
from optics.scene.parameter import Parameter
from optics.scene.surfaces import passing

PARAMETERS = (
    Parameter(
        "index",
        "1",
        1.0,
        (0.4, 2.5),
        "n2/n1: index of the far side relative to the camera's side",
        neutral=1.0,
        plausible=0.4,
        how="difference",
    ),
)


def build():
    import drjit as dr
    import mitsuba as mi

    class Interface(passing(mi.BSDFFlags.DeltaTransmission)):
        kind = "interface"

        def refract(self, wi):
            """Direction beyond the interface, transmittances T_s and T_p, relative index met; for a local direction
            wi."""
            front = mi.Frame3f.cos_theta(wi) >= 0
            n = dr.select(front, self.index, 1 / self.index)
            c1 = dr.abs(mi.Frame3f.cos_theta(wi))
            c2 = dr.sqrt(dr.maximum(1 - (1 - dr.square(c1)) / dr.square(n), 0))
            wo = mi.Vector3f(-wi.x / n, -wi.y / n, dr.select(front, -c2, c2))
            t_s = 1 - dr.square((c1 - n * c2) / (c1 + n * c2))
            t_p = 1 - dr.square((n * c1 - c2) / (n * c1 + c2))
            total = (1 - dr.square(c1)) / dr.square(n) >= 1  # total internal reflection: nothing is transmitted
            return wo, dr.select(total, 0, t_s), dr.select(total, 0, t_p), n

        def sample(self, ctx, si, sample1, sample2, active=True):
            wo, t_s, t_p, n = self.refract(si.wi)
            # also Null: passing a window is no scattering event and takes nothing of an integrator's depth
            bs = self.passed(wo, n, mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.Null)
            scale = 1 / dr.square(n)
            if mi.is_polarized:
                a, b, c = (t_s + t_p) / 2, (t_s - t_p) / 2, dr.sqrt(t_s * t_p)
                matrix = mi.Spectrum(a, b, 0, 0, b, a, 0, 0, 0, 0, c, 0, 0, 0, 0, c)
                normal = mi.Vector3f(0, 0, 1)
                side_in, side_out = dr.cross(normal, -wo), dr.cross(normal, si.wi)
                level = dr.squared_norm(side_in) < 1e-12  # at normal incidence every basis serves
                side_in = dr.select(level, mi.mueller.stokes_basis(-wo), dr.normalize(side_in))
                side_out = dr.select(level, mi.mueller.stokes_basis(si.wi), dr.normalize(side_out))
                weight = (
                    mi.mueller.rotate_mueller_basis(
                        matrix,
                        -wo,
                        side_in,
                        mi.mueller.stokes_basis(-wo),
                        si.wi,
                        side_out,
                        mi.mueller.stokes_basis(si.wi),
                    )
                    * scale
                )
            else:
                weight = mi.Spectrum((t_s + t_p) / 2 * scale)
            return bs, weight & active

        def eval_null_transmission(self, si, active=True):
            _, t_s, t_p, _ = self.refract(si.wi)
            mean = mi.UnpolarizedSpectrum((t_s + t_p) / 2)
            return mi.mueller.absorber(mean) if mi.is_polarized else mi.Spectrum(mean)

    return Interface


def check_brewster():
    """At Brewster's angle, tan = n, p-polarized light passes whole and s loses ((n^2 - 1)/(n^2 + 1))^2; beyond the
    critical angle nothing passes."""
    import math

    import mitsuba as mi

    n = 1.41
    angle = math.atan(n)
    wo, t_s, t_p, _ = made("interface", index=n).refract(mi.Vector3f(math.sin(angle), 0, math.cos(angle)))
    agree([t_s[0], t_p[0]], [1 - ((n * n - 1) / (n * n + 1)) ** 2, 1.0], 1e-5)
    agree([-wo.x[0], -wo.z[0]], [math.cos(angle), math.sin(angle)], 1e-5)  # at right angles to what is reflected
    _, t_s, t_p, _ = made("interface", index=1 / n).refract(mi.Vector3f(0.8, 0, 0.6))
    agree([t_s[0], t_p[0]], [0.0, 0.0])


def random(rng):
    """A clear polymer in air."""
    return {"index": rng.uniform(1.35, 1.6)}


part = Part("interface", "bsdf", PARAMETERS, build, checks=(check_brewster,), refracts=True, random=random)
