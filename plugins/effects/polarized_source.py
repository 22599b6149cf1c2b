"""Partly polarized source: the light is polarized before it meets a polarizer.

Definition
    S = L (1, q, u, 0)
with q = `dop_q` = p cos(2a), u = `dop_u` = p sin(2a), the degree of polarization p and its angle a. Mirrors, diffusers
seen obliquely and liquid crystal screens emit such light.
Fingerprint
    turning the first polarizer changes the brightness, with two cycles per turn; turning both together as well. With
    the first polarizer at rest it is a constant factor and cannot be seen.
Validity
    linear polarization, the same in all bands.
References
    Goldstein, Polarized Light, 3rd ed., ch. 4.
"""

import numpy as np

from optics.scene.checking import agree, mueller, stokes
from optics.scene.declare import Effect


def check_first_polarizer():
    """(1 + p cos 2(alpha - a))/2 behind an ideal polarizer at alpha, for p = 0.2 and a = 25 deg."""
    p, a = 0.2, 25.0
    q, u = p * np.cos(np.radians(2 * a)), p * np.sin(np.radians(2 * a))
    light = stokes("source", dop_q=q, dop_u=u)[0]
    for alpha in (0.0, 25.0, 70.0):
        passed = (mueller("polarizer_film", transmittance=1.0, angle=alpha)[0] @ light)[0]
        agree(passed, (1 + p * np.cos(np.radians(2 * (alpha - a)))) / 2)


def random(rng):
    """A degree of polarization of up to 0.3 at any angle."""
    p, double = rng.uniform(0, 0.3), rng.uniform(0, 2 * np.pi)
    return {"dop_q": p * np.cos(double), "dop_u": p * np.sin(double)}


effect = Effect(
    name="polarized source",
    part="source",
    parameters=("dop_q", "dop_u"),
    acts=("polarizer.angle",),
    needs="the first polarizer at two angles or more",
    checks=(check_first_polarizer,),
    random=random,
)
