"""Coloured leak: the extinction of a polarizer depends on the wavelength.

Definition
    T2(lambda) = leak + leak_tilt (lambda - 540)/100, not below 0
Dichroic films are darkest in the middle of the visible and leak in the blue or in the red, so that crossed films look
violet.
Fingerprint
    the dark end has a colour that the bright end lacks.
Validity
    a straight line over the bands.
References
    Goldstein, Polarized Light, 3rd ed., 26.2 (dichroic sheet polarizers).
"""

from optics.scene.declare import Effect

effect = Effect(
    name="coloured leak",
    part="polarizer_film",
    parameters=("leak", "leak_tilt"),
    onset="both",
    acts=("channel", "intensity"),
    needs="crossed polarizers in two colours or more",
)
