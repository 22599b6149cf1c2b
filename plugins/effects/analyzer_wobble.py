"""Wobble: the transmittance of a turning polarizer changes once per turn.

Definition
    I' = I (1 + w_c cos(psi) + w_s sin(psi))                     psi: what the dial says
from a wedge that makes the beam walk over the detector, or a film that is denser on one side; each dial has its own.
Fingerprint
    one cycle per turn, where Malus has two: curves of the first and the second half turn differ.
Validity
    first harmonic; a few percent.
References
    Goldstein, Polarized Light, 3rd ed., ch. 14 (rotating-element polarimeters: beam wander).
"""

from optics.scene.declare import Effect

effect = Effect(
    name="analyzer wobble",
    part="polarizer_film",
    parameters=("wobble_c", "wobble_s"),
    per="part",
    acts=("analyzer.angle",),
    needs="a whole turn of the analyser",
)
