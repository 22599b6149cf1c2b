"""Wobble: the transmittance of a turning polarizer changes once per turn.

Definition
    I' = I (1 + w_c cos(psi) + w_s sin(psi))                     psi: the dial's angle
Causes are a wedge, which moves the beam over the detector, and a film that is denser on one side. Each dial has its own
pair.
Fingerprint
    one cycle per turn, where Malus has two: curves of the first and the second half turn differ.
Validity
    first harmonic; a few percent.
References
    Goldstein, Polarized Light, 3rd ed., ch. 14 (rotating-element polarimeters: beam wander).
"""

import numpy as np

from optics.scene.checking import agree, mueller
from optics.scene.declare import Effect


def check_first_harmonic():
    """The Fourier components of the transmittance over a turn: T1/2, w_c T1/4 and w_s T1/4, and no second harmonic."""
    turn = np.arange(0.0, 360.0, 30.0)
    level = [
        mueller("polarizer_film", transmittance=0.8, angle=a, wobble_c=0.02, wobble_s=-0.03)[0, 0, 0] for a in turn
    ]
    component = [(level * np.exp(-1j * k * np.radians(turn))).mean() for k in (0, 1, 2)]
    agree(np.real(component), [0.4, 0.004, 0.0], 0, 1e-15)
    agree(np.imag(component), [0.0, 0.006, 0.0], 0, 1e-15)


effect = Effect(
    name="analyzer wobble",
    part="polarizer_film",
    parameters=("wobble_c", "wobble_s"),
    per="part",
    acts=("analyzer.angle",),
    needs="a whole turn of the analyser",
    checks=(check_first_harmonic,),
)
