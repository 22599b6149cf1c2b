"""Exponential skirt: the skin beside a contact is dragged along further than smoothing says.

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

from optics.scene.declare import Effect

effect = Effect(
    name="exponential skirt",
    part="gel",
    parameters=("skirt",),
    onset="secant",
    acts=("contact_distance", "slope"),
    needs="presses of different depth, seen with their surroundings",
)
