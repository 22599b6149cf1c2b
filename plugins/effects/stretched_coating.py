"""Stretched coating: where a press spreads the skin its coating reflects more light, or less.

Definition
    L' = L (1 + k (J - 1)),    J - 1 = s + sx x + sy y + sxx x^2 + sxy x y + syy y^2
with the areal stretch J of the pressed face, that the gel's `stretch` parameters state (measured by the coating's own
grain, which moves from the flat field to the press), and one number k for all places, LEDs and presses.
    k < 0    a coating that is thinned scatters less: k = -1/(1 + S d) where it absorbs nothing and air lies behind,
             with its coefficient S of scattering and its thickness d (Kubelka-Munk, R = S d/(1 + S d), d -> d/J)
    k > 0    what lies behind is brighter; or the gel, whose volume stays, is thinner by h (1 - 1/J) and its face nearer
             to the light: k = (3 z^2/D^2 - 1) h/z for a lamp at the height z and the distance D
Fingerprint
    a gain of the pressed image over the flat field, the same under every LED, smooth, and least where the skin spreads
    least. Lens vignetting and uneven lamps divide out with a multiplicative flat field; a lamp that drifts is one
    factor for a frame; the object behind a thin coating shows in the contacts only.
Validity
    small J - 1; a stretch that varies slowly over the image. Frames that state no stretch have none.
References
    Kubelka, J. Opt. Soc. Am. 38, 448 (1948); K. L. Johnson, Contact Mechanics, 5.8 (a layer that cannot be compressed);
    the neglect of S1.4: a coating that is the same everywhere and stays so.
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter
from optics.skin.contact import STRETCH


def brighten(path, gel):
    return 1 + gel.stretch_gain * gel.stretched(path.p)


def check_gain():
    """J - 1 = 0.04 + 0.002 (x - 1)^2 and k = 0.5: at x = 3 mm a pressed face is 1.024 times as bright; at rest it is
    not."""
    import mitsuba as mi

    numbers = {"stretch": 0.042, "stretch_x": -0.004, "stretch_xx": 0.002, "stretch_gain": 0.5}
    for depth, expected in ((0.3, 1.024), (0.0, 1.0)):
        gel = made("gel", press_depth=depth, **numbers, bsdf={"type": "membrane"})
        gel.heights([0.0], [0.0])  # presses
        agree(np.array(brighten(SimpleNamespace(p=mi.Point3f(3.0, 1.0, -0.1)), gel)), expected, 1e-6)


effect = Effect(
    name="stretched coating",
    part="gel",
    reads=STRETCH,
    stages={"segment": brighten},
    parameters=(
        Parameter(
            "stretch_gain",
            "1",
            0.0,
            (-2.0, 2.0),
            "gain k of the coating's light per areal stretch of the face",
            neutral=0.0,
            plausible=0.3,
            when_pressed=True,
        ),
    ),
    acts=("radius",),
    needs="frames that state how far the skin is stretched (gel.stretch ...), as an import of scans measures it",
    checks=(check_gain,),
)
