"""Optical rotation: a sheet turns the plane of linear polarization, by circular birefringence.

Definition
    rho(lambda) = rotation (540/lambda)^2
counterclockwise for who sees the light; a dextrorotatory substance (sugar) has rotation < 0. Where the sheet is also a
linear retarder both act together: an elliptical retarder of the linear components (a, b) and the circular component -2
rho, optics.polarization.mueller.elliptical_retarder.
Fingerprint
    all of Malus' curve shifts by rho, whatever the angle of the sheet; its dark end stays dark. With one wavelength and
    nothing else in the beam, a turned polarizer looks alike; other wavelengths turn by other angles. At one wavelength
    a plate that is twisted is a linear retarder and a rotation (equivalence theorem).
Validity
    rotatory dispersion far from absorption bands (Drude's law with one short wavelength). The same for both directions
    of light.
References
    Goldstein, Polarized Light, 3rd ed., 24.3; Hurwitz & Jones, J. Opt. Soc. Am. 31, 493 (1941), equivalence theorem.
"""

import numpy as np

from optics.scene.checking import agree, mueller, ray, transmission_axis
from optics.scene.declare import Effect


def check_pure_rotation():
    """Light of a polarizer at 20 deg leaves at 32 deg, fully polarized; in a band of 432 nm at 20 + 12 1.25^2."""
    at = ray(wavelengths=(540.0, 432.0))
    passed = mueller("sheet", at, rotation=12.0, angle=33.0) @ mueller(
        "polarizer_film", at, transmittance=1.0, angle=20.0
    )
    agree(transmission_axis(np.swapaxes(passed, -1, -2)), [32.0, 20 + 12 * 1.25**2])
    agree(np.hypot(passed[:, 1, 0], passed[:, 2, 0]), passed[:, 0, 0])


def check_elliptical_retarder():
    """Half of a turn about (1, 0, 1)/sqrt(2) of the Poincare sphere exchanges S1 and S3 and turns S2 round; two plates
    of half of a retardance and rotation are the whole."""
    size = 180 / np.sqrt(2)
    agree(mueller("sheet", retard_0=size, rotation=-size / 2)[0, 1:, 1:], [[0, 0, 1], [0, -1, 0], [1, 0, 0]], 0, 1e-12)
    half = mueller("sheet", retard_45=15.0, retard_0=8.0, rotation=7.0)[0]
    agree(half @ half, mueller("sheet", retard_45=30.0, retard_0=16.0, rotation=14.0)[0], 0, 1e-12)


effect = Effect(
    name="optical rotation",
    part="sheet",
    per="part",
    parameters=("rotation",),
    acts=("analyzer.angle", "channel"),
    needs="bare light beside the sample, or light of two wavelengths",
    checks=(check_pure_rotation, check_elliptical_retarder),
)
