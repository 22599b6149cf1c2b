"""Exponential skirt: a contact drags the skin beside it along further than smoothing alone does.

Definition
    D(x) = max over touched points p of D0(p) exp(-|x - p| / l)
with the length l (`skirt`), before the smoothing of S1.6; l = 0 leaves D0. For a ball of radius R that touches up to
the radius a, the slope falls from a/sqrt(R^2 - a^2) at the edge of contact by 1/e over every l.
Fingerprint
    a ring around every contact, about l wide, on the side that each LED lights; the real contact is smaller than the
    circle that the eye sees. Smoothing makes a shorter ring of Gaussian shape, gel bulge a wider one of opposite slope.
Validity
    a form that real dents of coated gels follow, not elasticity: a membrane under tension T on a bed of stiffness k has
    l = sqrt(T/k), a half-space a skirt that falls as 1/r. The onset is not linear, so the ranking takes a finite step.
References
    Johnson, Contact Mechanics, 4.3 (elastic foundation) and 3.4 (half-space).
"""

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect


def check_fall_over_a_length():
    """Beside the contact of a ball the depth falls by 1/e over every l = 0.5 mm, along both axes."""
    values = {"press_depth": 0.4, "indenter_size": 2.0, "skirt": 0.5, "smoothing": 0.01}
    gel = made("gel", **values, bsdf={"type": "membrane"})
    r = np.array([1.3, 1.8, 2.3])  # mm; the ball is touched up to 1.2 mm or less
    # 2 %: the map's pitch is 0.03 mm, 6 % of l, of which a bilinear map and the kernels of smoothing leave a third
    for depth in (-gel.heights(r, [0.0])[0], -gel.heights([0.0], r)[:, 0]):
        assert depth[0] > 0.02
        agree(depth[1:] / depth[:-1], [np.exp(-1)] * 2, 0.02)


effect = Effect(
    name="exponential skirt",
    part="gel",
    parameters=("skirt",),
    onset="secant",
    acts=("contact_distance", "slope"),
    needs="presses of different depth, seen with their surroundings",
    checks=(check_fall_over_a_length,),
)
