"""Ambient light: light that no LED made reaches the coated face from all sides.

Definition
    L' = L + rho_c E / pi
with the irradiance E of the face, the same in every direction and band, and the reflectance rho_c.
Fingerprint
    an offset that does not follow the LEDs' powers, proportional to the reflectance. Veiling glare and a wrong black level look
    alike; frames of different power, or one with all LEDs off, separate them.
Validity
    diffuse leak, no shadow of its own; a lamp outside a clear skin is not this.
References
    F-TAC Hand supplementary information, S1.5 (neglected there: black cover).
"""

from optics.effect import Effect
from optics.parameter import Parameter


def leak(geometry, membrane):
    return geometry.albedo * (membrane.ambient / 3.14159265358979)


effect = Effect(
    name="ambient light", part="membrane", stages={"ambient": leak},
    parameters=(Parameter("ambient", "1/mm^2", 0.0, (0.0, 10.0), "irradiance E, in the unit of (S2)'s kappa", neutral=0.0,
                          plausible=2e-4, linear=True),),
    acts=("intensity", "frame", "channel"), needs="frames of different LED power, or a frame with all LEDs off")
