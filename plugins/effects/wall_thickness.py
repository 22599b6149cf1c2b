"""Wall thickness: the printed walls between the cells are thicker or thinner than designed.

Definition
    wall = `wall` + `wall_error`                                 mm; the cells' pitch stays
Fingerprint
    all lines of walls widen alike, in every layer; nothing moves.
Validity
    all walls alike. A printer's droplets spread, so that walls come out thicker.
References
    Fan, Li, Cong & Zhang, MagicGripper, III.A, for the designed walls.
"""

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect


def check_cells():
    """At a pitch of 0.8 mm walls of 0.2 + 0.05 mm leave cells of 0.55 mm each way; their middles stay."""
    shape = {"columns": 2, "rows": 1, "layers": 3, "bsdf": {"type": "clear"}}
    thick, drawn = (made("cells", pitch=0.8, wall=0.2, wall_error=e, **shape).vertices() for e in (0.05, 0.0))
    agree(np.ptp(thick, axis=1), np.full((6, 3), 0.55), 1e-5)
    agree(thick.mean(1), drawn.mean(1), 0, 1e-6)


effect = Effect(
    name="wall thickness",
    part="cells",
    parameters=("wall_error",),
    per="part",
    acts=("row", "column"),
    needs="sharp images of the grid",
    checks=(check_cells,),
)
