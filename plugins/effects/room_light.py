"""Room light: light of the surroundings comes in through a clear skin.

Definition
    L = power power_c                                            radiance of a surface before the sensor, the same from
    every side
Fingerprint
    the same in every frame, whichever LED is on; through the clear cells it is seen directly, sharp and uncoloured, and
    what stands before the sensor shades it.
Validity
    as even as the scene's `room` is; steady. A scene without one cannot express it.
References
    Fan, Li, Cong & Zhang, MagicGripper, III.D and Fig. 26, for light that reaches all channels alike.
"""

from optics.scene.declare import Effect

effect = Effect(
    name="room light",
    part="room",
    parameters=("power",),
    per="part",
    acts=("intensity", "frame"),
    needs="a frame with all LEDs off",
)
