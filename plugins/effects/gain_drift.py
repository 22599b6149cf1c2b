"""Gain drift: every frame has its own gain.

Definition
    I'_f = (1 + d_f) I_f                                         `camera.gain` = 1 + d_f in frame f
Causes are automatic exposure, LEDs that warm up, or a supply that sags.
Fingerprint
    a whole frame is brighter or darker than the model, in all channels alike and without any structure.
Validity
    one number per frame; drift within a frame (rolling shutter, mains flicker) shows as rows.
References
    EMVA 1288 release 4.0, sec. 2 (linear model: gain).
"""

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect


def check_gain():
    """The signal above the black level grows by the gain; the black level stays."""
    from optics.light.development import Developer

    camera = made("camera", film={"type": "hdrfilm", "width": 2, "height": 2})
    developer = Developer(camera, (620.0, 540.0, 460.0), black=8.0, saturation=248.0)
    values = {f"{camera.name}.{n}": camera.number(n) for n in camera.numbers} | {f"{camera.name}.gain": 1.05}
    agree(developer.develop(np.full((2, 2, 3), 0.5), values), np.full((2, 2, 3), 8 + 240 * 0.525))
    agree(developer.develop(np.zeros((2, 2, 3)), values), np.full((2, 2, 3), 8.0))


effect = Effect(
    name="gain drift",
    part="camera",
    parameters=("gain",),
    scope="frame",
    acts=("frame",),
    needs="repeated frames of the same press, in another order",
    checks=(check_gain,),
)
