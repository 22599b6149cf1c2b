"""Oblique leak: polarizers extinguish worse at oblique incidence than their axes alone explain.

Definition
    T2(theta) = leak + leak_oblique sin(theta)^2
beyond what the turn of the projected axes does, which the part `polarizer_film` has by itself.
Fingerprint
    crossed films brighten towards the edge of a wide field in all directions, also along the arms of the dark cross.
Validity
    a small leak, the same in all azimuths.
References
    Korger et al., Opt. Express 21, 27032 (2013); Vi2TaP (RA-L 2025), II.B (a field of 120 degrees).
"""

from optics.scene.declare import Effect

effect = Effect(
    name="oblique leak",
    part="polarizer_film",
    parameters=("leak_oblique",),
    onset="both",
    acts=("radius", "intensity"),
    needs="crossed polarizers in a wide field",
)
