"""Gel absorption: light is absorbed on its way through the gel.

Definition
    L' = L exp(-a (d_light + d_view))                            Beer-Lambert
with the absorption coefficient a and the lengths of both paths inside the gel, -thickness < z < 0.
Fingerprint
    darkens with the length of the path: towards the far side of each LED and towards the corners. A dent, which is
    nearer to the camera, brightens. The lobe exponent and the powers absorb most of it in a fit when only one depth is
    pressed.
Validity
    clear gel: no scattering (the effect "gel haze"), one coefficient for all bands.
References
    Bouguer-Lambert-Beer law, Born & Wolf, Principles of Optics, 14.1; printed-cell sensors use it as I exp(-alpha d).
"""

from types import SimpleNamespace

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def fade(path, gel):
    import drjit as dr

    return dr.exp(-gel.absorption * (path.view + path.light))


def check_half_length():
    """Half of the light is left after ln 2/a = 6.9315 mm, whichever of the two paths it is; a quarter after both."""
    gel = SimpleNamespace(absorption=0.1)
    for view, light, left in ((6.931471806, 0.0, 0.5), (0.0, 6.931471806, 0.5), (6.931471806, 6.931471806, 0.25)):
        agree(fade(SimpleNamespace(view=view, light=light), gel), left, 1e-9)  # of ten digits


effect = Effect(
    name="gel absorption",
    part="gel",
    stages={"segment": fade},
    parameters=(
        Parameter("absorption", "1/mm", 0.0, (0.0, 10.0), "absorption coefficient a", neutral=0.0, plausible=0.01),
    ),
    acts=("gel_path", "led_distance", "height"),
    needs="presses of different depth and place",
    checks=(check_half_length,),
)
