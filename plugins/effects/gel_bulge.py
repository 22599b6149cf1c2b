"""Gel bulge: the incompressible gel rises around a contact.

Definition
    z'(x, y) = z(x, y) + b ring(x, y),   integral of ring = displaced volume
The volume that the indenter displaces returns as a wide ring around the contact; b = 1 conserves the volume.
Fingerprint
    a faint halo of opposite slope around every contact, a few millimetres wide. Smoothing of the dent's skirt changes
    the inner part of the same region with the opposite sign.
Validity
    small strains, gel much wider than the contact; elastic constants enter only through the ring's width.
References
    Johnson, Contact Mechanics, 3.4 and 5.8 (layers); F-TAC Hand supplementary information, S1.6 (neglected there).
"""

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def rise(x, y, gel):
    from optics.skin import contact

    ring = contact.ring_bulge(gel.map, gel.touch, gel.number("thickness"))
    return gel.number("bulge") * contact.surface(x, y, gel.number("press_x"), gel.number("press_y"), ring)


def check_volume():
    """Integral of z over an endless face: -V without, half of it at b = 0.5, 0 at b = 1; V is nearly the spherical
    cap's pi d^2 (R - d/3)."""
    x = np.linspace(-30, 30, 1201)

    def volume(bulge):
        gel = made("gel", press_depth=0.5, bulge=bulge, bsdf={"type": "membrane"})
        return np.trapezoid(np.trapezoid(gel.heights(x, x), x, axis=1), x)

    alone, cap = volume(0.0), np.pi * 0.5**2 * (1.5 - 0.5 / 3)
    assert -1.6 * cap < alone < -cap  # smoothing widens the dent and never narrows it
    agree([volume(0.5), volume(1.0)], [alone / 2, 0.0], 0, 1e-3 * abs(alone))  # trapezia of 0.05 mm


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
            "share b of the displaced volume that returns",
            neutral=0.0,
            plausible=0.5,
            how="difference",
            step=0.8,
        ),
    ),
    acts=("contact_distance", "slope"),
    needs="deep presses, seen with their surroundings",
    checks=(check_volume,),
)
