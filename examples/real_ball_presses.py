"""Two real sensors, pressed by a ball: import, calibrate, add what is missing, beside models without physics.

    python examples/real_ball_presses.py TAXIM/dataPack_small.npz DIGIT_FOLDER OUTPUT

TAXIM is the calibration pack of a GelSight sensor (Si & Yuan, Taxim, RA-L 7, 2361, 2022), DIGIT_FOLDER holds `images/`
and `labels.csv` of a DIGIT (github.com/vocdex/digit-depth). Images are averaged over blocks of 2 x 2 and 4 x 4 px, as a
ball's shading needs no more; calibrating either sensor takes about 13 minutes on two cores. OUTPUT gets the captures,
the studies, and a report each."""

import sys
from collections.abc import Sequence
from pathlib import Path

import optics
from optics.captures import importing
from optics.fit.null_models import NullTable

TAXIM = {"bin": 2, "every": 2, "leds": 6, "camera_distance": 40.0, "skirt": 0.88, "contact_share": 0.79}
DIGIT = {
    "bin": 4,
    "camera_distance": 28.0,
    "skirt": 0.81,
    "contact_share": 0.85,
    "gel_thickness": 4.6,
    "leds": 6,
    "ball_radius": 3.0,
    "mm_per_pixel": 1 / 17.15,
}
ADDED = {
    "gelsight": (),
    "digit": ("lens blur", "light from the surrounding face", "height fall-off"),
}  # lower the held-out error


def study(captures: Path, folder: Path, added: Sequence[str], held_out: list[str] | None = None) -> list[NullTable]:
    """Calibrate an imported set and add effects one by one; returns the null models' table after every step."""
    found = optics.calibrate(captures, folder, held_out=held_out)
    for name in added:
        found.add(name)
    print(found.fit.table(), found.table(), sep="\n\n")
    return [NullTable.from_json(found.record.metrics(i)["nulls"]) for i in range(len(found.records()))]


def main(taxim: Path, digit: Path, output: Path) -> None:
    for name, found in (
        ("gelsight", importing.import_taxim(taxim, output / "gelsight", **TAXIM)),
        ("digit", importing.import_circles(digit / "images", digit / "labels.csv", output / "digit", **DIGIT)),
    ):
        print(f"\n{name}: contradictions in the data", *found.warnings, sep="\n- ")
        folder = output / f"{name}-study"
        print(study(found.folder, folder, ADDED[name])[-1].text())
        calibrated = optics.Study.open(folder)
        print("\nwhat remains above the noise:", calibrated.diagnose().text())
        print(calibrated.report())


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]))
