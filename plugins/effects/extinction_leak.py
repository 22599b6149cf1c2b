"""Extinction leak: a polarizer lets some light through across its axis.

Definition
    T2 = leak                                                    every polarizer film alike, all bands alike
so that crossed films transmit T1 T2, and Malus' curve stands on a floor: I = I0 ((T1^2 + T2^2)/2 cos(d)^2 + T1 T2
sin(d)^2) for unpolarized light and the angle d between. A sheet sold as "99 %" has T2 = 0.005 T1.
Fingerprint
    the dark end is lifted and nothing else; the same in every channel. A background or a dark offset looks alike while
    source and exposure stay as they are: a dimmer source lowers the leak with it and leaves them.
Validity
    small: the bright end loses as little as it gains.
References
    Vi2TaP (RA-L 2025), II.B; Goldstein, Polarized Light, 3rd ed., 5.2 and 26.2.
"""

from optics.scene.declare import Effect

effect = Effect(
    name="extinction leak",
    part="polarizer_film",
    parameters=("leak",),
    onset="both",
    acts=("intensity", "analyzer.angle"),
    needs="crossed polarizers, and readings at another power of the source",
)
