"""Polarizer misalignment: the dial of a polarizer reads 0 where its axis is not at 0.

Definition
    axis = scale angle + offset                                  one offset for each polarizer
Fingerprint
    Malus' curve is shifted: the dark is not at 90 degrees. Unpolarized light shows only the difference between two
    polarizers; a third one, or partly polarized light, shows each.
Validity
    any angle; half a turn changes nothing.
References
    Vi2TaP (RA-L 2025), eq. (1).
"""

import numpy as np

from optics.scene.checking import agree, mueller
from optics.scene.declare import Effect


def check_shifted_malus():
    """Behind a polarizer at 0, an analyser that is 3 degrees off passes sin(3)^2 of the most at 90 and none at 87."""
    first = mueller("polarizer_film", transmittance=1.0)
    for angle, expected in ((90.0, np.sin(np.radians(3)) ** 2 / 2), (87.0, 0.0)):
        pair = mueller("polarizer_film", transmittance=1.0, angle=angle, offset=3.0) @ first
        agree(pair[:, 0, 0], [expected], 1e-9, 1e-15)  # 1 - cos cancels: 1e-16 of 1 is 1e-13 of sin(3)^2


effect = Effect(
    name="polarizer misalignment",
    part="polarizer_film",
    parameters=("offset",),
    per="part",
    acts=("analyzer.angle",),
    needs="the analyser on both flanks of Malus' curve",
    onset="both",  # of films that stand only where the light turns, the slope is 0
    checks=(check_shifted_malus,),
)
