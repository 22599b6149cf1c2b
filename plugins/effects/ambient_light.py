"""Ambient light: light that no LED made reaches the coated face from all sides.

Definition
    L' = L + rho_c E / pi (A + B g(t)),    g(t) = (sin t (t - sin t cos t) + 2/3 tan t (1 - sin^3 t)) / pi
with the irradiance E of the face, the same from every direction and in every band, the reflectance rho_c and what the
face's roughness (A, B) makes of such light at the angle t of sight: the integral of its reflection over the hemisphere.
Fingerprint
    an offset that does not follow the LEDs' powers, proportional to the reflectance. Veiling glare and a wrong black
    level look alike; frames of different power, or one with all LEDs off, separate them.
Validity
    diffuse leak, no shadow of its own; a lamp outside a clear skin is not this.
References
    F-TAC Hand supplementary information, S1.5 (neglected there: black cover).
"""

from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def leak(geometry, membrane):
    import drjit as dr

    a, b = membrane.rough()
    cos = dr.clip(dr.abs(geometry.cos_view), 1e-3, 1.0)
    t, sin = dr.acos(cos), dr.safe_sqrt(1 - cos * cos)
    g = (sin * (t - sin * cos) + 2 / 3 * sin / cos * (1 - sin * sin * sin)) / dr.pi
    return geometry.albedo * (membrane.ambient / dr.pi) * (a + b * g)


effect = Effect(
    name="ambient light",
    part="membrane",
    stages={"ambient": leak},
    parameters=(
        Parameter(
            "ambient",
            "1/mm^2",
            0.0,
            (0.0, 10.0),
            "irradiance E, in the unit of (S2)'s kappa",
            neutral=0.0,
            plausible=2e-4,
            linear=True,
        ),
    ),
    acts=("intensity", "frame", "channel"),
    needs="frames of different LED power, or a frame with all LEDs off",
)
