"""Twisted plate: the axis of a birefringent sheet turns from face to face.

Definition
    M = rotation(-phi) elliptical_retarder(a', b', 2 phi),   a' + i b' = delta exp(2 i psi - i phi)
with the twist phi = `twist`, counterclockwise for who sees the light, and the retardance delta and the axis psi in the
plate's middle, of `retardance`: in axes that turn along with it the plate is uniform. A twisted nematic cell has phi =
90 deg; stacked foils, drawn tape and injected plastic are twisted a little.
Fingerprint
    where delta is large against phi, linear polarization along the axis follows the twist (Mauguin); where it is small,
    a twist does nothing. Light from crossed polarizers has no angle of the sheet at which it is dark. At one wavelength
    the plate is a linear retarder and a rotation (equivalence theorem) and cannot be told from them; other wavelengths
    tell.
Validity
    an even twist, weak birefringence, no reflections in the plate, near normal incidence.
References
    Yeh & Gu, Optics of Liquid Crystal Displays, 2nd ed., 4.3; Gooch & Tarry, J. Phys. D 8, 1575 (1975).
"""

import numpy as np

from optics.scene.checking import agree, mueller, ray
from optics.scene.declare import Effect


def between(angle, at, **sheet):
    """Transmittance of unpolarized light: a film at 0 deg, the plate, a film at an angle."""
    films = [mueller("polarizer_film", at, transmittance=1.0, angle=a) for a in (0.0, angle)]
    return (films[1] @ mueller("sheet", at, **sheet) @ films[0])[:, 0, 0]


def check_gooch_and_tarry():
    """A cell of 90 deg, light along the axis where it enters, films parallel: sin(pi/2 sqrt(1 + u^2))^2/(1 + u^2)/2,
    with u = delta/pi; dark at u = sqrt(3) and, by the same formula, at u = sqrt(15)."""
    bands = np.array([620.0, 540.0, 460.0])
    u = 0.8 * 540 / bands
    expected = np.sin(np.pi / 2 * np.sqrt(1 + u * u)) ** 2 / (1 + u * u) / 2
    at = ray(wavelengths=bands)  # the axis stands at 0 where light enters, at 45 deg in the middle
    agree(between(0.0, at, retard_45=0.8 * 180, twist=90.0), expected, 1e-9)
    for minimum in (3, 15):
        agree(between(0.0, ray(), retard_45=180 * np.sqrt(minimum), twist=90.0), [0.0], 0, 1e-12)


def check_limits():
    """Without twist the plain retarder; a slow twist carries light along the axis with it; a fast one does nothing; a
    stack of 400 plain plates, each turned a little, is the same plate."""
    agree(mueller("sheet", retard_45=70.0, twist=1e-9), mueller("sheet", retard_45=70.0), 0, 1e-9)
    # 60 deg of twist in 40 orders: (phi/delta)^2 = 5e-6
    slow = mueller("sheet", retard_0=360 * 40.0, twist=60.0)[0] @ [1, np.cos(np.pi / 3), -np.sin(np.pi / 3), 0]
    agree(slow[1:3], [np.cos(np.pi / 3), np.sin(np.pi / 3)], 0, 1e-2)
    agree(mueller("sheet", retard_0=20.0, twist=1440.0)[0], np.eye(4), 0, 0.02)  # delta/(2 phi) = 0.007
    whole, count = np.eye(4), 400
    for k in range(count):
        psi = 20.0 + 50.0 * ((k + 0.5) / count - 0.5)
        whole = mueller("sheet", retard_0=130.0 / count, angle=psi)[0] @ whole
    agree(mueller("sheet", retard_0=130.0, angle=20.0, twist=50.0)[0], whole, 0, 1e-5)  # 1/count^2


effect = Effect(
    name="twisted plate",
    part="sheet",
    per="part",
    parameters=("twist",),
    acts=("analyzer.angle", "sample.angle", "channel"),
    needs="a retardance, at several angles of the sheet, in two colours or more",
    checks=(check_gooch_and_tarry, check_limits),
)
