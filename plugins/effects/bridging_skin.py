"""Bridging skin: the skin does not follow into the corner beside a contact, but bridges it with an arc.

Definition
    D0' = the closing of D0 by a ball of the radius q (`fillet`), which rolls over the skin on the gel's side:
    D0'(r) = q - sqrt(q^2 - (x - r)^2) for r_t < r < x,   x = sqrt(d (2 (R + q) - d)),   r_t = x R/(R + q)
beside a ball of the radius R that is pressed by d: the arc that is tangent to the ball, at r_t, and to the untouched
face, at x. A membrane under the tension T that the pressure p of the gel holds against both has q = T/p.
Fingerprint
    the real contact is smaller than the ball, and flanks go on beyond its rim with less and less slope, brighter on the
    side that faces the LED, and end at x. An exponential skirt has no end, and is steepest where it begins; smoothing
    bends the rim both ways.
Validity
    a skin stiff against bending or under tension, before its weight; no friction. Gel that flows into the corner has a
    smaller arc under a deeper press.
References
    Serra, Image Analysis and Mathematical Morphology (1982), II (closing by a ball); Johnson, Contact Mechanics, 4.3;
    the neglect of S1.6: a skin that touches all that it can reach.
"""

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect


def check_arc():
    """Beside a ball of 1.5 mm, 0.4 mm deep, an arc of 0.5 mm; of a cylinder on its side, found on the grid, the same
    across its axis."""
    fine = {"press_depth": 0.4, "smoothing": 1e-3, "map_pitch": 0.01, "extent": 3.0, "fillet": 0.5}
    meets = np.sqrt(0.4 * (2 * 2.0 - 0.4))
    leaves = meets * 1.5 / 2.0
    r = np.array([0.3, 0.8, leaves + 0.1, meets - 0.1, meets - 0.02, meets + 0.1])
    arc = 0.5 - np.sqrt(0.25 - np.clip(meets - r, 0, 0.5) ** 2)
    expected = -np.where(r < leaves, 0.4 - 1.5 + np.sqrt(np.maximum(2.25 - r**2, 0)), arc)
    # the last blur, pitch^2/2 of the curvature 1/q: 1e-4 mm
    agree(made("gel", **fine, bsdf={"type": "membrane"}).heights(r, [0.0])[0], expected, 0, 3e-4)
    lying = made("gel", indenter="cylinder", **{**fine, "map_pitch": 0.02}, bsdf={"type": "membrane"})
    agree(lying.heights([0.0], r)[:, 0], expected, 0, 0.015)  # 3 % of the radius: directions that are tried


effect = Effect(
    name="bridging skin",
    part="gel",
    parameters=("fillet",),
    onset="secant",
    acts=("contact_distance", "slope"),
    needs="presses with steep flanks, seen with their surroundings",
    checks=(check_arc,),
)
