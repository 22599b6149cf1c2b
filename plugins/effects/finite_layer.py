"""Finite layer: the gel ends on a stiff base, which a half-space does not.

Definition
    u = u_half-space + b (u_layer - u_half-space)                b: `stiff_base`; both under the same normal force
with the displacement u_layer of a layer of cover and gel that sticks to a rigid base (optics.skin.layer). At 1 nothing
moves at the base. A drag stays that of the half-space.
Fingerprint
    deep beads, which a half-space moves too far, stand still; far from the press beads near the face swing back, as an
    incompressible layer has nowhere to go but sideways.
Validity
    one material for cover and gel, a base that is rigid against both, small strains. The force at a given depth of the
    press is still the half-space's: the layer's is greater by about the contact radius over the thickness.
References
    Johnson, Contact Mechanics (1985), 5.8; Burmister, J. Appl. Phys. 16 (1945) 89.
"""

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect


def check_nothing_moves_at_the_base():
    """At the base nothing moves with it, and half as much as without it at a share of a half."""
    moved = []
    for share in (0.0, 0.5, 1.0):
        skin = made("elastic_skin", press_depth=1.0, stiff_base=share, poisson=0.4, bsdf={"type": "membrane"})
        at = np.array([0.0, 1.0, 4.0])
        moved.append(skin.carry(at, at / 2, np.full(3, 4.5)) - np.stack([at, at / 2, np.full(3, -4.5)], -1))
    assert np.abs(moved[0]).max() > 0.04  # mm
    agree(moved[2], np.zeros((3, 3)), 0, 1e-5)
    agree(moved[1], moved[0] / 2, 0, 1e-5)


effect = Effect(
    name="finite layer",
    part="elastic_skin",
    parameters=("stiff_base",),
    acts=("gradient", "radius"),
    needs="a press that moves beads at several depths",
    checks=(check_nothing_moves_at_the_base,),
)
