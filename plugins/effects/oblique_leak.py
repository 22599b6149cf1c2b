"""Oblique leak: at oblique incidence polarizers extinguish worse than the directions of their axes explain.

Definition
    T2(theta) = leak + leak_oblique sin(theta)^2
in addition to the turn of the projected axes, which the part `polarizer_film` has by itself.
Fingerprint
    crossed films brighten towards the edge of a wide field in all directions, also along the arms of the dark cross.
Validity
    a small leak, the same in all azimuths.
References
    Korger et al., Opt. Express 21, 27032 (2013); Vi2TaP (RA-L 2025), II.B (a field of 120 degrees).
"""

from optics.scene.checking import agree, mueller, principal_transmittances, ray
from optics.scene.declare import Effect


def check_sine_squared():
    """T2 at 0, 30 and 60 degrees, in two azimuths: leak plus 0, 1/4 and 3/4 of leak_oblique."""
    for azimuth in (0.0, 70.0):
        for theta, square in ((0.0, 0.0), (30.0, 0.25), (60.0, 0.75)):
            matrix = mueller("polarizer_film", ray(theta, azimuth), leak=0.01, leak_oblique=0.04)
            agree(principal_transmittances(matrix)[1], [0.01 + 0.04 * square])


effect = Effect(
    name="oblique leak",
    part="polarizer_film",
    parameters=("leak_oblique",),
    onset="both",
    acts=("radius", "intensity"),
    needs="crossed polarizers in a wide field",
    checks=(check_sine_squared,),
)
