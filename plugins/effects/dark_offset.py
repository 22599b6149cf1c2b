"""Dark offset: the camera's zero is not where it was taken to be.

Definition
    DN' = DN + offset
Fingerprint
    the same number at every pixel, whatever light there is and whatever the exposure. Where it is claimed of an offset
    that was there from the start, `black_level` of captures.toml is too low by as much. Half a DN looks like glare
    where there is no such effect.
Validity
    constant over a session; one number for all channels.
References
    EMVA 1288 release 4.0, 2.2 (dark signal).
"""

from optics.scene.declare import Effect

effect = Effect(
    name="dark offset",
    part="camera",
    parameters=("offset",),
    acts=("intensity",),
    needs="dark frames, or readings at two exposures and two powers",
)
