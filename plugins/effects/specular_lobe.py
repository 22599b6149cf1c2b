"""Specular lobe: the coating reflects a share of the light towards the mirror direction.

Definition
    f'(wi, wo) = f(wi, wo) + k (e + 2)/(8 pi) (n.h)^e
with the half vector h, the exponent e (`specular_exponent`) and the strength k: normalised Blinn-Phong, white.
Fingerprint
    a bright patch where the slope turns the mirror direction to the camera; it moves with the LED, not with the
    reflectance. Interreflection brightens the same inner flanks, but without a patch on the outer ones.
Validity
    a rough coating (e < 100); mirrors and paints with flakes need their own lobe.
References
    Blinn, SIGGRAPH 1977; Akenine-Moeller et al., Real-Time Rendering, 4th ed., 9.8.1 (normalisation).
"""

from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def lobe(geometry, membrane):
    import drjit as dr
    import mitsuba as mi

    half = dr.normalize(geometry.wi + geometry.wo)
    cos = dr.maximum(mi.Frame3f.cos_theta(half), 1e-4)
    e = membrane.specular_exponent
    return membrane.specular * (e + 2) / (8 * dr.pi) * dr.power(cos, e)


effect = Effect(
    name="specular lobe",
    part="membrane",
    stages={"reflection": lobe},
    parameters=(Parameter("specular", "1", 0.0, (0.0, 1.0), "strength k of the lobe", neutral=0.0, plausible=0.03),),
    shape=(Parameter("specular_exponent", "1", 12.0, (1.0, 200.0), "exponent e of the lobe", plausible=3.0),),
    acts=("slope", "incidence", "emission"),
    needs="steep slopes seen under several LEDs, one at a time",
)
