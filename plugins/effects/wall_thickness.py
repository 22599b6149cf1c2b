"""Wall thickness: the printed walls between the cells are thicker or thinner than drawn.

Definition
    wall = `wall` + `wall_error`                                 mm; the cells' pitch stays
Fingerprint
    all lines of walls widen alike, in every layer; nothing moves.
Validity
    all walls alike. A printer's droplets spread, walls come out thicker.
References
    Fan, Li, Cong & Zhang, MagicGripper, III.A, for walls as drawn.
"""

from optics.scene.declare import Effect

effect = Effect(
    name="wall thickness",
    part="cells",
    parameters=("wall_error",),
    per="part",
    acts=("row", "column"),
    needs="sharp images of the grid",
)
