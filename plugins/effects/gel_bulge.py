"""Gel bulge: the incompressible gel rises around a contact.

Definition
    z'(x, y) = z(x, y) + b ring(x, y),   integral of ring = displaced volume
the volume that the indenter displaces comes back as a wide ring around the contact; b = 1 conserves the volume.
Fingerprint
    a faint halo of opposite slope around every contact, a few millimetres wide. Smoothing of the dent's skirt changes
    the inner part of the same region with the other sign.
Validity
    small strains, gel much wider than the contact; elastic constants enter only through the ring's width.
References
    Johnson, Contact Mechanics, 3.4 and 5.8 (layers); F-TAC Hand supplementary information, S1.6 (neglected there).
"""

from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def rise(x, y, gel):
    from optics.skin import contact

    ring = contact.ring_bulge(gel.map, gel.touch, gel.number("thickness"))
    return gel.number("bulge") * contact.surface(x, y, gel.number("press_x"), gel.number("press_y"), ring)


effect = Effect(
    name="gel bulge",
    part="gel",
    stages={"surface": rise},
    parameters=(
        Parameter(
            "bulge",
            "1",
            0.0,
            (0.0, 2.0),
            "share b of the displaced volume that comes back",
            neutral=0.0,
            plausible=0.5,
            how="difference",
            step=0.8,
        ),
    ),
    acts=("contact_distance", "slope"),
    needs="deep presses, seen with their surroundings",
)
