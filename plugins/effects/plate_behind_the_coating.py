"""Plate behind the coating: between the balls of a plate, the plate itself shows through.

Definition
    L' = L (1 + g b(x, y)),   b = 1 where the plate touches the face between its balls, 0 on the balls
    g = rho_p (1 - rho)^2 / (rho (1 - rho rho_p))
with the coat's own reflectance rho and the plate's, rho_p: the series of reflections between a coat that absorbs
nothing and what lies behind it.
Fingerprint
    all of the touched frames but the balls is brighter than the untouched sensor by one factor, the same under every
    LED. A lamp that drifts between the frames differs from frame to frame and brightens the balls too; a coating that
    only the balls show through leaves the rest as it was.
Validity
    balls that are pressed in to the plate; one reflectance of the plate. Not with a single indenter, beside which the
    coating has air behind it.
References
    Kubelka, J. Opt. Soc. Am. 38, 448 (1948), layers over a backing; the neglect of S1.4: an opaque coat.
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def show(path, gel):
    return 1 + gel.shown_between * gel.beside(path.p)


def check_between():
    """Balls 1 mm apart: between them the coating is brighter by g, on a ball it is not; nor beside a single ball."""
    import mitsuba as mi

    numbers = {"press_depth": 0.2, "indenter_size": 0.25, "shown_between": 0.05, "smoothing": 0.02, "map_pitch": 0.02}
    plate = made("gel", indenter="balls", indenter_spacing=1.0, **numbers, bsdf={"type": "membrane"})
    ball = made("gel", **numbers, bsdf={"type": "membrane"})
    for gel, x, expected in ((plate, 0.0, 1.0), (plate, 0.5, 1.05), (plate, 1.0, 1.0), (ball, 0.5, 1.0)):
        gel.heights([0.0], [0.0])  # presses
        agree(np.array(show(SimpleNamespace(p=mi.Point3f(x, 0.0, -0.1)), gel)), expected, 1e-5)


effect = Effect(
    name="plate behind the coating",
    part="gel",
    reads=("indenter_spacing",),
    stages={"segment": show},
    parameters=(
        Parameter(
            "shown_between",
            "1",
            0.0,
            (-0.9, 5.0),
            "gain g of the coating where the plate between balls touches it",
            neutral=0.0,
            plausible=0.05,
            when_pressed=True,
        ),
    ),
    acts=("contact_distance",),
    needs="a plate of balls",
    checks=(check_between,),
)
