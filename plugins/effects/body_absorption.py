"""Body absorption: a clear material takes light along every stretch through it.

Definition
    I = I0 exp(-absorption d)                                    Beer-Lambert (27-29), d the way in the material
Fingerprint
    the image darkens with the length of the ways, most far from the LEDs; walls and fillings differ by where the ways
    lie.
Validity
    grey: `coloured absorption` is what changes with the wavelength. In one material alone and on ways of one length it
    looks like a weaker light.
References
    Fan, Li, Cong & Zhang, MagicGripper, supplementary VII-A, eqs. (27)-(29).
"""

from optics.scene.declare import Effect

effect = Effect(
    name="body absorption",
    part="clear",
    parameters=("absorption",),
    per="part",
    acts=("led_distance", "height"),
    needs="LEDs at different distances, one at a time",
)
