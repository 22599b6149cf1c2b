"""Body absorption: a clear material absorbs light along every stretch through it.

Definition
    I = I0 exp(-absorption d)                                    Beer-Lambert (27-29), d the path in the material
Fingerprint
    the image darkens with the length of the paths, most far from the LEDs; walls and fillings differ by where their
    paths lie.
Validity
    grey: `coloured absorption` is the part that changes with the wavelength. In one material alone, and on paths of one
    length, it looks like a weaker light.
References
    Fan, Li, Cong & Zhang, MagicGripper, supplementary VII-A, eqs. (27)-(29).
"""

import math

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect


def check_stretch():
    """exp(-alpha d) of a stretch of 3 mm inside the material, which ends where its face lets out light of the index 1;
    a stretch outside, which ends in front of the face, loses nothing."""
    import drjit as dr
    import mitsuba as mi

    material = made("clear", index=1.0, absorption=0.2)
    si = dr.zeros(mi.SurfaceInteraction3f, 1)
    si.t = mi.Float(3.0)
    for cos, left in ((-1.0, math.exp(-0.6)), (1.0, 1.0)):
        si.wi = mi.Vector3f(0, 0, cos)
        _, weight = material.sample(mi.BSDFContext(), si, mi.Float(0.5), mi.Point2f(0.5))
        agree(np.array(mi.unpolarized_spectrum(weight)).ravel()[:3], [left] * 3, 1e-5)


effect = Effect(
    name="body absorption",
    part="clear",
    parameters=("absorption",),
    per="part",
    acts=("led_distance", "height"),
    needs="LEDs at different distances, one at a time",
    checks=(check_stretch,),
)
