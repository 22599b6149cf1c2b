"""Calibrate a GelSight-type sensor from captured images, and find which physical effect its model lacks.

    python examples/calibrate_gelsight.py CAPTURES STUDY

CAPTURES is a folder with a captures.toml (see the README); `optics demo` makes one in renders/demo/captures. STUDY is
the folder of the new study, in which a report and the charts are written as well.
"""

import sys

import optics

captures, folder = sys.argv[1:3]

# Three stages: LEDs and membrane, then the place and depth of each press, then everything together. A prior of 30 % on
# the LEDs' powers holds the product of powers and reflectances together (the lambda term of S4), one of 0.05 mm on
# presses says what the stage knew. Every fourth press is held out: on it only the press itself is fitted.
study = optics.calibrate(captures, folder)
print(study.fit.table())
study.fit.plot().savefig(study.folder / "fit.png")

verdict = study.diagnose()
print(verdict.text())
verdict.plot().savefig(study.folder / "verdict.png")

if verdict.word == "CLAIM":
    study.add(verdict.missing)
print(study.table())
study.plot().savefig(study.folder / "ladder.png")
print(study.report())
