"""Calibrate a GelSight-type sensor from captured images, in a few lines, and see what the model lacks.

    python examples/calibrate_gelsight.py CAPTURES

CAPTURES is a folder with a captures.toml (see the README); `optics demo` makes one in renders/demo/captures.
"""

import sys

from optics.fit import calibrate
from optics.scene.parameter import Values
from optics.study import loop

setup = loop.Setup(captures=sys.argv[1])
model = loop.open_model(setup)  # scene and captures, checked against each other
fitted, held_out = loop.split(model, setup)  # one press in four is kept back

variables = calibrate.variables_from(
    model,
    free=["led_*.[xyz]", "led_*.pan", "led_*.tilt", "led_*.mu", "led_*.power", "membrane.rho_*", "membrane.sigma"],
    per_group=["gel.press_[xy]", "gel.press_depth"],  # one value per press
    priors={"led_*.power": (1.0, 0.3), "gel.press_*": (None, 0.05)},  # the lambda term of S4; what the stage knows, mm
    frames=fitted,
)
fit = calibrate.fit(model, variables, Values(), fitted)
print(fit.table())

comparison = loop.comparison_of(model, loop.held_out_values(model, fit, held_out)[0], held_out, len(variables), 0)
print(comparison.text())
