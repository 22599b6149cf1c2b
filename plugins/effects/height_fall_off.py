"""Height fall-off: a dent loses light as it rises towards the camera.

Definition
    L' = L exp(-c h),   h = -z the height of the face above its rest, mm
Fingerprint
    tops of dents are darker than their slope explains, in proportion to their height and whichever LED lights them. Gel
    absorption does the opposite: a shorter path brightens.
Validity
    a description, not a mechanism: presses of DIGIT-type sensors show it, the cause is not established. Possible causes
    are LEDs that shine from a narrow slit below the top of the dent, light guided in the window, and a coating that
    stretches and thins.
References
    none; see Validity.
"""

from types import SimpleNamespace

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def lose(path, gel):
    import drjit as dr

    return dr.exp(gel.height_loss * path.p.z)


def check_exponential():
    """The face at rest loses nothing; a top at z = -1.3863 mm loses half at c = 0.5/mm (ln 2/0.5), one below the face
    gains as much."""
    for z, left in ((0.0, 1.0), (-1.386294361, 0.5), (1.386294361, 2.0)):
        agree(lose(SimpleNamespace(p=SimpleNamespace(z=z)), SimpleNamespace(height_loss=0.5)), left, 1e-9)


effect = Effect(
    name="height fall-off",
    part="gel",
    stages={"segment": lose},
    parameters=(Parameter("height_loss", "1/mm", 0.0, (-2.0, 2.0), "fall-off c", neutral=0.0, plausible=0.05),),
    acts=("height",),
    needs="presses of different depth",
    checks=(check_exponential,),
)
