"""Servo backlash: the angle of a polarizer depends on the side from which it was approached.

Definition
    axis = scale angle + offset + approach backlash/2            approach = +1 from below, -1 from above
Fingerprint
    Malus' curve splits in two, one for each sense of turning; their mean does not move.
Validity
    a dead zone of constant width; needs the setting `approach`.
References
    Vi2TaP (RA-L 2025), II.B 2 (servo MG90S: dead band of a few microseconds, about 1 degree with its gears).
"""

from optics.scene.checking import agree, mueller, transmission_axis
from optics.scene.declare import Effect


def check_dead_zone():
    """A dead zone of 4 degrees puts the axis 2 degrees to either side of the dial's 30, or on it if the side is
    unknown."""
    for approach, axis in ((1.0, 32.0), (-1.0, 28.0), (0.0, 30.0)):
        agree(transmission_axis(mueller("polarizer_film", angle=30.0, approach=approach, backlash=4.0)), [axis])


effect = Effect(
    name="servo backlash",
    part="polarizer_film",
    parameters=("backlash",),
    acts=("analyzer.approach",),
    needs="the same angles from both sides, with the setting `approach`",
    checks=(check_dead_zone,),
)
