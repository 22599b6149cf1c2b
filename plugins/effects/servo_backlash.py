"""Servo backlash: where a polarizer stands depends on the side from which it came.

Definition
    axis = scale angle + offset + approach backlash/2            approach = +1 from below, -1 from above
Fingerprint
    Malus' curve splits in two, for one and the other sense of turning; their mean is where it was.
Validity
    a dead zone of constant width; needs the setting `approach`.
References
    Vi2TaP (RA-L 2025), II.B 2 (servo MG90S: dead band of a few microseconds, about 1 degree with its gears).
"""

from optics.scene.declare import Effect

effect = Effect(
    name="servo backlash",
    part="polarizer_film",
    parameters=("backlash",),
    acts=("analyzer.approach",),
    needs="the same angles from both sides, with the setting `approach`",
)
