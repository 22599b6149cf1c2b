"""Retardance: a sheet between polarizers delays one polarization against the other.

Definition
    delta(lambda) = delta_540 (540/lambda) (1 + retard_dispersion ((540/lambda)^2 - 1))
    delta_540 = sqrt(retard_0^2 + retard_45^2),  fast axis = atan2(retard_45, retard_0)/2 + angle of the sheet
An oblique ray sees what of the in-plane birefringence lies across it, over a longer path
(optics.polarization.layers.Crossing.retardance). A wave plate is retard_0 = 90 (quarter) or 180 deg (half wave) and an
`angle`; the two components, in place of retardance and axis, go through zero without a seam. Dispersion 0 is a
birefringence that is the same at all wavelengths.
Fingerprint
    between crossed polarizers, light returns as sin(delta/2)^2 sin(2 psi)^2, without first order: a faint retardance
    hides, and its sign does not show. Behind a quarter-wave plate it shows in first order, and with its sign.
Validity
    a sheet whose birefringence is small against its index. Rays run in it as its `index` bends them.
References
    Goldstein, Polarized Light, 3rd ed., 5.3; Yeh & Gu, Optics of Liquid Crystal Displays, 2nd ed., 3.2 (oblique rays).
"""

import math

from optics.polarization.mueller import cos, retarder, sin
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def retard(crossing, sheet):
    turn = 2 * sheet.angle * (math.pi / 180)
    a = sheet.retard_0 * cos(turn) - sheet.retard_45 * sin(turn)
    b = sheet.retard_0 * sin(turn) + sheet.retard_45 * cos(turn)
    ratio = 540.0 / crossing.wavelengths
    radians = (math.pi / 180) * ratio * (1 + sheet.retard_dispersion * (ratio * ratio - 1))
    return retarder(*(c * radians for c in crossing.retardance(a, b, sheet.index)))


effect = Effect(
    name="retardance",
    part="sheet",
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
    ),
    acts=("analyzer.angle", "sample.angle"),
    needs="the sheet at two angles or more, best behind a quarter-wave plate",
)
