"""Two real sensors, pressed by a ball: import, calibrate, and hold the physical model against three null models.

    python examples/real_ball_presses.py TAXIM/dataPack_small.npz DIGIT_FOLDER OUTPUT

TAXIM is the calibration pack of a GelSight sensor (Si & Yuan, Taxim, RA-L 7, 2361, 2022), DIGIT_FOLDER holds `images/` and
`labels.csv` of a DIGIT (github.com/vocdex/digit-depth). Pictures are averaged over blocks of 2 x 2 and 4 x 4 px, as a ball's
shading needs no more; either sensor takes a few minutes on two cores.
"""

import json
import sys
from pathlib import Path

from optics import captures, importing, nulls, scene
from optics.render import Model

TAXIM = dict(bin=2, camera_distance=40.0, skirt=0.88, contact_share=0.79)
DIGIT = dict(bin=4, camera_distance=28.0, skirt=0.81, contact_share=0.85, gel_thickness=4.6, leds=6, ball_radius=3.0,
             mm_per_pixel=1 / 17.15)


def study(folder, fitted, held_out, steps=(2, 8, 4, 6)):
    """Calibrate an imported set on some presses and score it on others, beside the null models."""
    presses = captures.load(folder)
    model = Model(scene.load(presses.scene), presses, flat_field="additive")
    fit = importing.calibrate_presses(model, fitted, steps=steps)
    values = importing.refine_poses(model, fit.values, held_out)
    return fit, nulls.compare(model, values, fitted, held_out, importing.circles_of(presses))


def main(taxim, digit, output):
    taxim = importing.import_taxim(taxim, output / "taxim", **TAXIM)
    digit = importing.import_circles(digit / "images", digit / "labels.csv", output / "digit", **DIGIT)
    for name, found, fitted, held_out in (("GelSight", taxim, range(0, 48, 3), range(1, 49, 4)),
                                          ("DIGIT", digit, [i for i in range(14) if i % 5 != 2], [2, 7, 12])):
        held_out = [i for i in held_out if i not in fitted]
        print(f"\n{name}: contradictions in the data", *found.warnings, sep="\n- ")
        fit, table = study(found.folder, list(fitted), held_out)
        print(fit.table(), table.text(), sep="\n\n")
        (found.folder.parent / f"{name.lower()}.json").write_text(json.dumps(table.json(), indent=1))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]))
