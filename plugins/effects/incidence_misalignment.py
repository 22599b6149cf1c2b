"""Incidence misalignment: the dial of a reflecting plate does not read 0 at normal incidence.

Definition
    theta = incidence + incidence_offset
Fingerprint
    Brewster's minimum of p light lies beside its place, and the curves of s and p shift with it; another index moves
    the minimum too, and changes the reflectance at normal incidence.
Validity
    a rigid offset of the dial.
References
    Born & Wolf, Principles of Optics, 1.5.3.
"""

import math

from optics.scene.checking import agree, mueller
from optics.scene.declare import Effect


def check_a_shifted_minimum():
    """With an offset of -2 deg p light vanishes 2 deg above Brewster's angle."""
    dial = math.degrees(math.atan(1.5)) + 2
    agree((mueller("reflecting_plate", incidence=dial, incidence_offset=-2.0)[0] @ [1, 1, 0, 0])[0], 0, 0, 1e-15)


effect = Effect(
    name="incidence misalignment",
    part="reflecting_plate",
    parameters=("incidence_offset",),
    acts=("plate.incidence",),
    needs="p light at angles on both sides of Brewster's, and angles near normal",
    checks=(check_a_shifted_minimum,),
)
