"""Refraction at the window: the camera looks through a flat window into a denser gel.

Definition
    Snell's law and Fresnel's transmittances at every `interface`; see the part. The strength is the index; 1 means no
    window.
Fingerprint
    the image shrinks towards the optical axis, more so for what lies deeper; the corners darken by a few percent. In a
    fit the camera's field of view and position absorb nearly all of it: only a dent's depth or oblique views tell. Of
    beads in a gel, the LEDs' light falls off otherwise with depth, too: behind the window they seem to stand elsewhere.
Validity
    flat windows across the optical axis; the onset is not linear over the range of real indices, so the ranking takes a
    finite step.
References
    Born & Wolf, Principles of Optics, 1.5; Treibitz et al., IEEE TPAMI 34, 51 (2012) (flat ports).
"""

import math

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect


def check_apparent_depth():
    """Near the axis what lies at the depth t appears at t/n; light along the normal is transmitted by 4n/(n + 1)^2."""
    import mitsuba as mi

    n, angle = 1.41, 0.01
    window = made("interface", index=n)
    wo, t_s, t_p, _ = window.refract(mi.Vector3f(math.sin(angle), 0, math.cos(angle)))
    # paraxial to angle^2 = 1e-4
    agree(np.array(wo.x / wo.z) / math.tan(angle), 1 / n, 2e-4)
    agree([t_s[0], t_p[0]], [4 * n / (n + 1) ** 2] * 2, 2e-4)


def random(rng):
    """A silicone or an acrylic in air, with the spread of clear polymers."""
    return {"index": rng.uniform(1.35, 1.6)}


effect = Effect(
    name="refraction at the window",
    part="interface",
    parameters=("index",),
    onset="secant",
    acts=("radius", "height"),
    needs="presses of known position all over the field, and of different depth",
    checks=(check_apparent_depth,),
    random=random,
)
