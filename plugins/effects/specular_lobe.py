"""Specular lobe: the coating reflects a share of the light towards the mirror direction.

Definition
    f'(wi, wo) = f(wi, wo) + k (e + 2)/(8 pi) (n.h)^e
with the half vector h, the exponent e (`specular_exponent`) and the strength k: normalised Blinn-Phong, white.
Fingerprint
    a bright patch where the slope turns the mirror direction to the camera; it moves with the LED and does not follow
    the reflectance. Interreflection brightens the same inner flanks, but without a patch on the outer ones.
Validity
    a rough coating (e < 100); mirrors and paints with flakes need their own lobe.
References
    Blinn, SIGGRAPH 1977; Akenine-Moeller et al., Real-Time Rendering, 4th ed., 9.8.1 (normalisation).
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def lobe(geometry, membrane):
    import drjit as dr
    import mitsuba as mi

    half = dr.normalize(geometry.wi + geometry.wo)
    cos = dr.maximum(mi.Frame3f.cos_theta(half), 1e-4)
    e = membrane.specular_exponent
    return membrane.specular * (e + 2) / (8 * dr.pi) * dr.power(cos, e)


def check_lobe():
    """k (e + 2)/(8 pi) in the mirror direction, whatever the incidence; cos(t/2)^e of it for light along the normal
    that is seen at the angle t."""
    import mitsuba as mi

    k, e = 0.2, 15.0
    face = SimpleNamespace(specular=mi.Float(k), specular_exponent=mi.Float(e))
    peak = k * (e + 2) / (8 * np.pi)
    for t in np.radians([0.0, 20.0, 50.0]):
        seen = mi.Vector3f(float(np.sin(t)), 0, float(np.cos(t)))
        for wi, share in ((mi.Vector3f(-seen.x, 0, seen.z), 1.0), (mi.Vector3f(0, 0, 1), np.cos(t / 2) ** e)):
            agree(np.array(lobe(SimpleNamespace(wi=wi, wo=seen), face)), peak * share, 1e-5)


effect = Effect(
    name="specular lobe",
    part="membrane",
    stages={"reflection": lobe},
    parameters=(Parameter("specular", "1", 0.0, (0.0, 1.0), "strength k of the lobe", neutral=0.0, plausible=0.03),),
    shape=(Parameter("specular_exponent", "1", 12.0, (1.0, 200.0), "exponent e of the lobe", plausible=3.0),),
    acts=("slope", "incidence", "emission"),
    needs="steep slopes seen under several LEDs, one at a time",
    checks=(check_lobe,),
)
