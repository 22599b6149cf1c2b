"""Room light: light of the surroundings enters through a clear skin.

Definition
    L = power power_c              radiance of a surface in front of the sensor, the same from every side
Fingerprint
    the same in every frame, whichever LED is on. Through the clear cells it is seen directly, sharp and uncoloured, and
    what stands before the sensor shades it.
Validity
    as uniform as the scene's `room`; steady. A scene without a `room` cannot express it.
References
    Fan, Li, Cong & Zhang, MagicGripper, III.D and Fig. 26, for light that reaches all channels alike.
"""

import math

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect


def check_radiance():
    """power times the share of each band, towards all sides; nothing on the back of the surface."""
    import drjit as dr
    import mitsuba as mi

    wall = made("rectangle", emitter={"type": "room", "power": 0.3, "power_r": 0.5, "power_b": 2.0})
    si = dr.zeros(mi.SurfaceInteraction3f, 1)
    si.sh_frame, si.dp_du, si.dp_dv = mi.Frame3f(mi.Normal3f(0, 0, 1)), mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.n, si.uv = mi.Normal3f(0, 0, 1), mi.Point2f(0.5, 0.5)
    for cos, expected in ((1.0, [0.15, 0.3, 0.6]), (0.5, [0.15, 0.3, 0.6]), (-0.5, [0.0, 0.0, 0.0])):
        si.wi = mi.Vector3f(math.sqrt(1 - cos**2), 0, cos)
        agree(np.array(mi.unpolarized_spectrum(wall.emitter().eval(si))).ravel()[:3], expected, 1e-5)


effect = Effect(
    name="room light",
    part="room",
    parameters=("power",),
    per="part",
    acts=("intensity", "frame"),
    needs="a frame with all LEDs off",
    checks=(check_radiance,),
)
