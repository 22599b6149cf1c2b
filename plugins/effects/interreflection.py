"""Interreflection: the coated face lights itself.

Definition
    L' = L + s L_2,   L_2 the light after two reflections
by Monte Carlo over the second direction; s = 1 is physics, and a fit that needs s far from 1 says that this is not the
cause.
Fingerprint
    the inner flanks of a dent and its shadows brighten, with the square of the reflectance: colours get purer. A
    specular lobe brightens where a mirror would.
Validity
    two reflections; a bright cover outside the gel must be in the scene to take part.
References
    Forsyth & Zisserman, IEEE TPAMI 13, 671 (1991); F-TAC Hand supplementary information, S1.5 (neglected: black cover).
"""

from optics.scene.declare import Effect

effect = Effect(
    name="interreflection",
    part="tactile",
    requires=("membrane",),
    parameters=("interreflection",),
    acts=("height", "slope", "shadow", "channel"),
    needs="deep presses with steep flanks",
)
