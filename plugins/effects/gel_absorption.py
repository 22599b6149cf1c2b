"""Gel absorption: light is lost on its way through the gel.

Definition
    L' = L exp(-a (d_light + d_view))                            Beer-Lambert
with the absorption coefficient a and the lengths of both ways inside the gel, -thickness < z < 0.
Fingerprint
    darkens with the length of the way: towards the far side of each LED and towards the corners; a dent, being nearer
    to the camera, brightens. A lobe exponent and the powers absorb most of it when only one depth is pressed.
Validity
    clear gel: no scattering (the effect "gel haze"), one coefficient for all bands.
References
    Bouguer-Lambert-Beer law, Born & Wolf, Principles of Optics, 14.1; printed-cell sensors use it as I exp(-alpha d).
"""

from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def fade(path, gel):
    import drjit as dr

    return dr.exp(-gel.absorption * (path.view + path.light))


effect = Effect(
    name="gel absorption",
    part="gel",
    stages={"segment": fade},
    parameters=(
        Parameter("absorption", "1/mm", 0.0, (0.0, 10.0), "absorption coefficient a", neutral=0.0, plausible=0.01),
    ),
    acts=("gel_path", "led_distance", "height"),
    needs="presses of different depth and place",
)
