"""LED drift: in every frame each LED has a power of its own.

Definition
    eta'_kf = (1 + d_kf) eta_k                                   `led.gain` = 1 + d_kf of the LED k in frame f
Causes are junctions that warm up (red LEDs lose most light, up to about 1 % for each degree), drivers that share a
supply, and pulses that beat with the shutter.
Fingerprint
    what one LED lights is brighter or darker in a frame, with the shading of that LED; other LEDs stay. A gain of the
    frame changes all of them alike.
Validity
    one number per frame and LED: of frames with one LED each it is the gain of the frame, which is asked instead. The
    spectrum stays, which of a warming LED moves too.
References
    Schubert, Light-Emitting Diodes, 2nd ed., ch. 6 (output and junction temperature).
"""

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect


def check_gain():
    """The irradiance across the beam grows by the gain, wherever the LED lights."""
    import mitsuba as mi

    beam, distance = mi.Vector3f([0.0, 0.6], [0.0, 0.0], [-1.0, -0.8]), mi.Float([2.0, 3.0])
    plain, brighter = (made("led", position=[0.0, 0.0, -5.0], gain=gain) for gain in (1.0, 1.05))
    agree(np.array(brighter.kappa(None, beam, distance)), 1.05 * np.array(plain.kappa(None, beam, distance)), 1e-6)


effect = Effect(
    name="LED drift",
    part="led",
    parameters=("gain",),
    scope="frame",
    per="part",
    acts=("frame", "led"),
    needs="frames in which several LEDs are lit together; repeated frames of one press",
    checks=(check_gain,),
)
