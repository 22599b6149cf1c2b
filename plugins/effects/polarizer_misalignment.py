"""Polarizer misalignment: a polarizer's axis is not where its dial says 0.

Definition
    axis = scale angle + offset                                  one offset for each polarizer
Fingerprint
    Malus' curve is shifted: the dark is not at 90 degrees. Unpolarized light shows only the difference between two
    polarizers; a third one, or partly polarized light, shows each.
Validity
    any angle; half a turn is none.
References
    Vi2TaP (RA-L 2025), eq. (1).
"""

from optics.scene.declare import Effect

effect = Effect(
    name="polarizer misalignment",
    part="polarizer_film",
    parameters=("offset",),
    per="part",
    acts=("analyzer.angle",),
    needs="the analyser on both flanks of Malus' curve",
)
