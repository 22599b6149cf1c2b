"""Servo scale: the polarizers turn by more or less than their dials say.

Definition
    axis = scale angle + offset
Fingerprint
    the period of Malus' curve is not 180 degrees: an error of the angle that grows with it. An offset is the same everywhere.
Validity
    a constant ratio of gears or pulse widths.
References
    Vi2TaP (RA-L 2025), II.B 2 (gear set with a ratio of 1:1, servo MG90S).
"""

from optics.effect import Effect

effect = Effect(name="servo scale", part="polarizer_film", parameters=("scale",), acts=("analyzer.angle",),
                needs="angles over half a turn or more")
