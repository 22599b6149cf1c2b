"""Height fall-off: a dent loses light as it rises towards the camera.

Definition
    L' = L exp(-c h),   h = -z the height of the face above its rest, mm
Fingerprint
    tops of dents are darker than their slope says, in proportion to their height and whichever LED lights them. Gel
    absorption does the opposite: a shorter way brightens.
Validity
    a description, not a mechanism: presses of DIGIT-type sensors show it, the cause is not established. LEDs that shine
    from a narrow slit below the top of the dent, light guided in the window, or a coating that stretches and thins
    would do it.
References
    none; see Validity.
"""

from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def lose(path, gel):
    import drjit as dr

    return dr.exp(gel.height_loss * path.p.z)


effect = Effect(
    name="height fall-off",
    part="gel",
    stages={"segment": lose},
    parameters=(Parameter("height_loss", "1/mm", 0.0, (-2.0, 2.0), "fall-off c", neutral=0.0, plausible=0.05),),
    acts=("height",),
    needs="presses of different depth",
)
