"""Thin coating: what presses on the coating shows through it.

Definition
    L' = L (1 + g c(x, y)),   c = 1 where the object touches the face, 0 elsewhere
    g = rho_b (1 - rho)^2 / (rho (1 - rho rho_b))
with the coat's own reflectance rho and that of the object behind it, rho_b: of a coat that absorbs nothing, the series
of reflections between the two. Behind a coat that is not touched lies air, to which what passes is lost.
Fingerprint
    the touched area is brighter than its slope explains by one factor, the same under every LED and at every height,
    and ends at the rim of the contact. Height fall-off and gel absorption grow with the depth of the dent instead.
    A dark object makes no difference (g = 0); one that wets the coat may darken it (g < 0).
Validity
    one reflectance of the object; no gap in the contact.
References
    Kubelka, J. Opt. Soc. Am. 38, 448 (1948), layers over a backing; the neglect of S1.4: an opaque coat.
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def show(path, gel):
    return 1 + gel.shown_through * gel.touched(path.p)


def check_contact():
    """A ball of 1.5 mm, 0.5 mm deep at (0.7, 0): its lowest point is brighter by g, the face 4 mm away is not."""
    import mitsuba as mi

    gel = made("gel", press_depth=0.5, press_x=0.7, shown_through=0.1, bsdf={"type": "membrane"})
    gel.heights([0.0], [0.0])  # presses
    for x, expected in ((0.7, 1.1), (0.7 - 4.0, 1.0)):
        agree(np.array(show(SimpleNamespace(p=mi.Point3f(x, 0.0, -0.1)), gel)), expected, 1e-5)


effect = Effect(
    name="thin coating",
    part="gel",
    stages={"segment": show},
    parameters=(
        Parameter(
            "shown_through",
            "1",
            0.0,
            (-0.9, 5.0),
            "gain g of the coating where something touches it",
            neutral=0.0,
            plausible=0.05,
            when_pressed=True,
        ),
    ),
    acts=("contact_distance",),
    needs="presses whose contact has an edge in view",
    checks=(check_contact,),
)
