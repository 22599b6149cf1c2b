"""Servo scale: a polarizer turns by more or less than its dial says.

Definition
    axis = scale angle + offset                                  one scale for each dial
Fingerprint
    the period of Malus' curve is not 180 degrees: the error of the angle grows with the angle. An offset is the same
    everywhere.
Validity
    a constant ratio of gears or pulse widths.
References
    Vi2TaP (RA-L 2025), II.B 2 (gear set with a ratio of 1:1, servo MG90S).
"""

from optics.scene.checking import agree, mueller, transmission_axis
from optics.scene.declare import Effect


def check_ratio():
    """2 % more than the dial's 50 degrees, from an offset of 3 on: 54 degrees; the dark of Malus' curve comes at
    90/1.02."""
    agree(transmission_axis(mueller("polarizer_film", angle=50.0, scale=1.02, offset=3.0)), [54.0])
    pair = mueller("polarizer_film", angle=90 / 1.02, scale=1.02) @ mueller("polarizer_film")
    agree(pair[:, 0, 0], [0.0], 0, 1e-15)


effect = Effect(
    name="servo scale",
    part="polarizer_film",
    parameters=("scale",),
    per="part",
    acts=("analyzer.angle",),
    needs="angles over half a turn or more",
    onset="both",  # of films that stand only where the light turns, the slope is 0
    checks=(check_ratio,),
)
