"""Retardance: a sheet between polarizers delays one polarization against the other.

Definition
    delta(lambda) = delta_540 (540/lambda) (1 + retard_dispersion ((540/lambda)^2 - 1))
    delta_540 = sqrt(retard_0^2 + retard_45^2),  fast axis = atan2(retard_45, retard_0)/2 + angle of the sheet
    M = twisted_retarder(a, b, twist, -2 rotation (540/lambda)^2)      optics.polarization.mueller
where (a, b) are delta cos and sin of twice the axis, in the plate's middle if it is twisted. `twist` and `rotation` are
0 unless their own effects, `twisted plate` and `optical rotation`, free them.
An oblique ray sees the part of the in-plane birefringence that lies across it, over a longer path
(optics.polarization.layers.Crossing.retardance). A wave plate is retard_0 = 90 deg (quarter wave) or 180 deg (half
wave) and an `angle`. The two components, in place of retardance and axis, pass through zero without a seam. Dispersion
0 means a birefringence that is the same at all wavelengths.
Fingerprint
    between crossed polarizers, light returns as sin(delta/2)^2 sin(2 psi)^2, without a first order: a faint retardance
    is hidden, and its sign does not show. Behind a quarter-wave plate it shows in first order, and with its sign.
Validity
    a sheet whose birefringence is small against its index. Rays run in it as its `index` bends them.
References
    Goldstein, Polarized Light, 3rd ed., 5.3; Yeh & Gu, Optics of Liquid Crystal Displays, 2nd ed., 3.2 (oblique rays).
"""

import math

import numpy as np

from optics.polarization.mueller import retarder, turned, twisted_retarder
from optics.scene.checking import agree, mueller, ray
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter

# deg: within a quarter of an order cos(delta) is monotonic; the first leaves 0, where it has no slope
ORDERS = (30.0, *(90.0 * k for k in range(1, 9)))


def retard(crossing, sheet):
    a, b = turned(sheet.retard_0, sheet.retard_45, sheet.angle)
    ratio = 540.0 / crossing.wavelengths
    radians = (math.pi / 180) * ratio * (1 + sheet.retard_dispersion * (ratio * ratio - 1))
    a, b = (c * radians for c in crossing.retardance(a, b, sheet.index))
    if all(isinstance(angle, (int, float)) and angle == 0 for angle in (sheet.twist, sheet.rotation)):
        return retarder(a, b)
    circular = (-2 * math.pi / 180) * sheet.rotation * (ratio * ratio)
    return twisted_retarder(a, b, (math.pi / 180) * sheet.twist + 0.0 * a, circular)


def check_crossed_polarizers():
    """sin(delta/2)^2 sin(2 psi)^2 of the light behind the first polarizer, delta = 40 deg 540/lambda, psi = 45 and 15
    deg: by the second component, and by the sheet's angle."""
    bands = np.array([620.0, 540.0, 460.0])
    at = ray(wavelengths=bands)
    films = [mueller("polarizer_film", at, transmittance=1.0, angle=angle) for angle in (0.0, 90.0)]
    for sheet, psi in (({"retard_45": 40.0}, 45.0), ({"retard_0": 40.0, "angle": 15.0}, 15.0)):
        passed = (films[1] @ mueller("sheet", at, **sheet) @ films[0])[:, 0, 0]
        agree(passed, np.sin(np.radians(20 * 540 / bands)) ** 2 * np.sin(np.radians(2 * psi)) ** 2 / 2, 1e-12)


def check_quarter_wave_plate():
    """With the fast axis at +45 degrees, light at 0 degrees becomes S3 = +1."""
    agree(mueller("sheet", retard_0=90.0, angle=45.0)[0] @ [1, 1, 0, 0], [1, 0, 0, 1], 0, 1e-12)


def random(rng):
    """A retardance of up to 40 degrees with its axis anywhere."""
    size, axis = rng.uniform(0, 40), rng.uniform(0, 2 * math.pi)
    return {"retard_0": size * math.cos(axis), "retard_45": size * math.sin(axis)}


effect = Effect(
    name="retardance",
    part="sheet",
    per="part",
    stages={"layer": retard},
    onset="both",
    parameters=(
        Parameter(
            "retard_0",
            "deg",
            0.0,
            (-720.0, 720.0),
            "retardance at 540 nm with the fast axis at 0 deg of the sheet (less that at 90)",
            neutral=0.0,
            plausible=10.0,
            starts=ORDERS,
            pair="retard_45",
            how="layer",
        ),
        Parameter(
            "retard_45",
            "deg",
            0.0,
            (-720.0, 720.0),
            "retardance at 540 nm with the fast axis at 45 deg of the sheet (less that at 135)",
            neutral=0.0,
            plausible=10.0,
            starts=ORDERS,
            pair="retard_0",
            how="layer",
        ),
    ),
    shape=(
        Parameter(
            "retard_dispersion",
            "1",
            0.0,
            (-1.0, 1.0),
            "dispersion of the birefringence",
            neutral=0.0,
            plausible=0.05,
            how="layer",
        ),
        Parameter(
            "twist",
            "deg",
            0.0,
            (-1440.0, 1440.0),
            "turn of the plate's axis along the light, counterclockwise for who sees it",
            neutral=0.0,
            plausible=5.0,
            how="layer",
        ),
        Parameter(
            "rotation",
            "deg",
            0.0,
            (-1440.0, 1440.0),
            "optical rotation at 540 nm, counterclockwise for who sees the light",
            neutral=0.0,
            plausible=1.0,
            how="layer",
        ),
    ),
    acts=("analyzer.angle", "sample.angle"),
    needs="the sheet at two angles or more, best behind a quarter-wave plate",
    checks=(check_crossed_polarizers, check_quarter_wave_plate),
    random=random,
)
