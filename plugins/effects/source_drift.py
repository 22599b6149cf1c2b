"""Source drift: the lamp warms up or its supply sags while readings are taken.

Definition
    L' = L (1 + drift g(time))                                   `time`: a setting of the frame or reading
    g(t) = (1 - exp(-settling t))/settling                       t where settling is 0: it never settles
Fingerprint
    follows the clock, whatever angle is set: repeated sweeps differ by a factor.
Validity
    one lamp that approaches its balance at one rate, from time 0 on.
References
    EMVA 1288 release 4.0, 6.4 (temporal stability of the light source); Newton's law of cooling.
"""

import numpy as np

from optics.scene.checking import agree, stokes
from optics.scene.declare import Effect


def check_line_in_time():
    """All of the Stokes vector of a half polarized source grows by 2 % per unit of time."""
    for time in (0.0, 1.0, 5.0):
        agree(stokes("source", dop_q=0.5, drift=0.02, time=time)[0], (1 + 0.02 * time) * np.array([1, 0.5, 0, 0]))


def check_settling():
    """One that settles at the rate 0.5 ends 4 % higher; after one time constant it has gone 63 % of the way."""
    for time, done in ((0.02, 1 - np.exp(-0.01)), (2.0, 1 - np.exp(-1)), (60.0, 1.0)):
        agree(stokes("source", drift=0.02, settling=0.5, time=time)[0, 0], 1 + 0.04 * done)


effect = Effect(
    name="source drift",
    part="source",
    parameters=("drift", "settling"),
    acts=("source.time",),
    needs="the setting `time`, and the same angle early and late",
    checks=(check_line_in_time, check_settling),
)
