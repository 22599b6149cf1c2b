"""Coloured leak: the extinction of a polarizer depends on the wavelength.

Definition
    T2(lambda) = leak + leak_tilt (lambda - 540)/100, not below 0
Dichroic films are darkest in the middle of the visible and leak in the blue or in the red, so that crossed films look
violet.
Fingerprint
    the dark end has a colour that the bright end lacks.
Validity
    linear in the wavelength over the bands.
References
    Goldstein, Polarized Light, 3rd ed., 26.2 (dichroic sheet polarizers).
"""

from optics.scene.checking import agree, mueller, principal_transmittances, ray
from optics.scene.declare import Effect


def check_line_over_wavelengths():
    """T2 at 640, 540 and 340 nm; 0 where the line falls below it; T1 is that of every band."""
    matrix = mueller("polarizer_film", ray(wavelengths=(640, 540, 340)), transmittance=0.8, leak=0.01, leak_tilt=0.006)
    t1, t2 = principal_transmittances(matrix)
    agree(t1, [0.8] * 3)
    agree(t2, [0.016, 0.01, 0.0], 1e-12, 1e-15)


def random(rng):
    """A leak that changes by half or less from 540 to 640 nm."""
    leak = rng.uniform(0.002, 0.02)
    return {"leak": leak, "leak_tilt": leak * rng.uniform(-0.5, 0.5)}


effect = Effect(
    name="coloured leak",
    part="polarizer_film",
    parameters=("leak", "leak_tilt"),
    onset="both",
    acts=("channel", "intensity"),
    needs="crossed polarizers in two colours or more",
    checks=(check_line_over_wavelengths,),
    random=random,
)
