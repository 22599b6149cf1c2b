"""Dark offset: the camera's zero is not where it was taken to be.

Definition
    DN' = DN + offset
Fingerprint
    the same number at every pixel, whatever light there is and whatever the exposure.
Validity
    constant over a session; one number for all channels. Offered where polarizers are: there darkness is a measurement.
    Elsewhere `black_level` of the captures says it.
References
    EMVA 1288 release 4.0, 2.2 (dark signal).
"""

from optics.effect import Effect

effect = Effect(name="dark offset", part="camera", parameters=("offset",), requires=("polarizer_film",), acts=("intensity",),
                needs="dark frames, or readings at two exposures and two powers")
