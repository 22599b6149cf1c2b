"""Bleaching: a dye shines less with every minute under its excitation.

Definition
    L' = L exp(-bleaching time)                                  of the fluorescence alone; `time`: of the frame
with the rate `bleaching` per unit of time at the light that the frames have.
Fingerprint
    the fluorescence falls with the clock, by the same factor everywhere; what is reflected stays. A lamp that drifts
    takes both.
Validity
    one rate for all beads: those near an LED bleach faster. Between frames the light stays on.
References
    Lakowicz, Principles of Fluorescence Spectroscopy, 3rd ed., 1.7 and 20.1 (photobleaching).
"""

import math

from optics.scene.checking import agree, made
from optics.scene.declare import Effect


def check_half_life():
    """At a rate of ln 2/10 half of it is left after ten units of time, a quarter after twenty; at time 0 all."""
    import drjit as dr
    import mitsuba as mi

    si = dr.zeros(mi.SurfaceInteraction3f)
    si.sh_frame, si.wi = mi.Frame3f(mi.Normal3f(0, 0, 1)), mi.Vector3f(0, 0, 1)
    si.wavelengths = type(si.wavelengths)(525.0) if mi.is_spectral else si.wavelengths
    led = made("led", position=[0.0, 0.0, 10.0], power=100.0, wavelength=365.0)
    new, old, older = (
        made("fluorescent", bleaching=math.log(2) / 10, time=time).fluorescence(si, led, mi.Vector3f(0, 0, 1), 10.0)[0][
            0
        ]
        for time in (0.0, 10.0, 20.0)
    )
    agree([old / new, older / new], [0.5, 0.25], 1e-5)


effect = Effect(
    name="bleaching",
    part="fluorescent",
    parameters=("bleaching",),
    acts=("frame", "channel"),
    needs="the setting `time`, and the same press early and late",
    checks=(check_half_life,),
)
