"""Partly polarized source: the light is polarized before it meets a polarizer.

Definition
    S = L (1, q, u, 0)
with q = `dop_q` = p cos(2a), u = `dop_u` = p sin(2a), p the degree of polarization, a its angle; mirrors, diffusers
seen obliquely and liquid crystal screens do that.
Fingerprint
    turning the first polarizer changes the brightness, with two cycles per turn; turning both together as well. With
    the first polarizer at rest it is a factor and cannot be seen.
Validity
    linear polarization, the same in all bands.
References
    Goldstein, Polarized Light, 3rd ed., ch. 4.
"""

from optics.scene.declare import Effect

effect = Effect(
    name="polarized source",
    part="source",
    parameters=("dop_q", "dop_u"),
    acts=("polarizer.angle",),
    needs="the first polarizer at two angles or more",
)
