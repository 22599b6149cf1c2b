"""Extinction leak: a polarizer transmits some light across its axis.

Definition
    T2 = leak                                                    the same in every polarizer film and every band
Crossed films transmit T1 T2, and Malus' curve has a floor: I = I0 ((T1^2 + T2^2)/2 cos(d)^2 + T1 T2 sin(d)^2) for
unpolarized light and the angle d between the axes. A sheet sold as "99 %" has T2 = 0.005 T1.
Fingerprint
    the dark end is raised and nothing else changes; the same in every channel. A background or a dark offset looks
    alike while source and exposure stay as they are: a dimmer source lowers the leak and leaves those unchanged.
Validity
    small: the bright end loses as little as the dark end gains.
References
    Vi2TaP (RA-L 2025), II.B; Goldstein, Polarized Light, 3rd ed., 5.2 and 26.2.
"""

from optics.scene.checking import agree, mueller
from optics.scene.declare import Effect


def check_malus_with_a_floor():
    """Two films of T1 = 0.8, T2 = 0.01 at 0, 30 and 90 degrees: the docstring's I."""
    t1, t2 = 0.8, 0.01
    film = mueller("polarizer_film", transmittance=t1, leak=t2)
    for angle, cos2 in ((0.0, 1.0), (30.0, 0.75), (90.0, 0.0)):
        pair = mueller("polarizer_film", transmittance=t1, leak=t2, angle=angle) @ film
        agree(pair[:, 0, 0], (t1**2 + t2**2) / 2 * cos2 + t1 * t2 * (1 - cos2))


def random(rng):
    """From a good film (1e-4) to a poor one (0.05), evenly in the logarithm."""
    return {"leak": 10 ** rng.uniform(-4, -1.3)}


effect = Effect(
    name="extinction leak",
    part="polarizer_film",
    parameters=("leak",),
    onset="both",
    acts=("intensity", "analyzer.angle"),
    needs="crossed polarizers, and readings at another power of the source",
    checks=(check_malus_with_a_floor,),
    random=random,
)
