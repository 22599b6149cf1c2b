"""Gain drift: every frame has its own gain.

Definition
    I'_f = (1 + d_f) I_f                                         `camera.gain` = 1 + d_f in frame f
from automatic exposure, warming LEDs, or a supply that sags.
Fingerprint
    a whole frame is brighter or darker than the model, in all channels alike and without any structure.
Validity
    one number per frame; drift inside a frame (rolling shutter, mains flicker) shows as rows.
References
    EMVA 1288 release 4.0, sec. 2 (linear model: gain).
"""

from optics.scene.declare import Effect

effect = Effect(
    name="gain drift",
    part="camera",
    parameters=("gain",),
    scope="frame",
    acts=("frame",),
    needs="repeated frames of the same press, in another order",
)
