"""Gel wedge: the coated face is tilted against the camera's window.

Definition
    z'(x, y) = z(x, y) + x tan(w_x) + y tan(w_y)
Fingerprint
    a smooth gradient across every frame that turns with the side the light comes from. In a fit, positions and axes of
    the LEDs absorb most of it; presses at different places keep a share.
Validity
    a plane face; a bent one needs more terms.
References
    F-TAC Hand supplementary information, S1.1 ("uniform and known elastomer thickness" is assumed there).
"""

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def tilt(x, y, gel):
    return x * np.tan(np.radians(gel.number("wedge_x"))) + y * np.tan(np.radians(gel.number("wedge_y")))


def check_plane():
    """Without a press the edge of the face at x = 10 mm rises by 10 tan(2 deg) = 0.34921 mm, at y = 8 mm by -8 tan(1
    deg) = -0.13964 mm."""
    gel = made("gel", wedge_x=2.0, wedge_y=-1.0, bsdf={"type": "membrane"})
    z = gel.heights([-10.0, 0.0, 10.0], [0.0, 8.0])
    agree(z, [[-0.349208, 0.0, 0.349208], [-0.488848, -0.139640, 0.209567]], 0, 1e-5)  # parameters in float32


effect = Effect(
    name="gel wedge",
    part="gel",
    stages={"surface": tilt},
    parameters=(
        Parameter(
            "wedge_x",
            "deg",
            0.0,
            (-20.0, 20.0),
            "tilt w_x along x",
            neutral=0.0,
            plausible=0.5,
            how="difference",
            step=0.8,
        ),
        Parameter(
            "wedge_y",
            "deg",
            0.0,
            (-20.0, 20.0),
            "tilt w_y along y",
            neutral=0.0,
            plausible=0.5,
            how="difference",
            step=0.8,
        ),
    ),
    acts=("row", "column", "led"),
    needs="frames lit from different sides, one LED each",
    checks=(check_plane,),
)
