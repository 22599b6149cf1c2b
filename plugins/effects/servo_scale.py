"""Servo scale: a polarizer turns by more or less than its dial says.

Definition
    axis = scale angle + offset                                  one scale for each dial
Fingerprint
    the period of Malus' curve is not 180 degrees: an error of the angle that grows with it. An offset is the same
    everywhere.
Validity
    a constant ratio of gears or pulse widths.
References
    Vi2TaP (RA-L 2025), II.B 2 (gear set with a ratio of 1:1, servo MG90S).
"""

from optics.scene.declare import Effect

effect = Effect(
    name="servo scale",
    part="polarizer_film",
    parameters=("scale",),
    per="part",
    acts=("analyzer.angle",),
    needs="angles over half a turn or more",
)
