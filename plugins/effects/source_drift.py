"""Source drift: the lamp warms up or its supply sags while readings are taken.

Definition
    L' = L (1 + drift time)                                      `time`: a setting of the frame or reading
Fingerprint
    follows the clock, whatever angle is set: repeated sweeps differ by a factor.
Validity
    linear in time over the session.
References
    EMVA 1288 release 4.0, 6.4 (temporal stability of the light source).
"""

import numpy as np

from optics.scene.checking import agree, stokes
from optics.scene.declare import Effect


def check_line_in_time():
    """All of the Stokes vector of a half polarized source grows by 2 % per unit of time."""
    for time in (0.0, 1.0, 5.0):
        agree(stokes("source", dop_q=0.5, drift=0.02, time=time)[0], (1 + 0.02 * time) * np.array([1, 0.5, 0, 0]))


effect = Effect(
    name="source drift",
    part="source",
    parameters=("drift",),
    acts=("source.time",),
    needs="the setting `time`, and the same angle early and late",
    checks=(check_line_in_time,),
)
