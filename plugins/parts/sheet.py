"""Sheet: a thin clear layer in the light's way: a plate, a foil, the sample slot of a bench.

Definition
    M = t F                    transmittance t = transmittance exp(transmittance_slope (lambda - 540)/100)
    F = diattenuator(s, (1 - R_s)^2, (1 - R_p)^2)      both faces, Fresnel's R_s, R_p
n = `index` is the sheet's index over that of what surrounds it: 1 in the middle of a skin of its own kind, 1.5 for a
plate in air. What the sheet does to polarization besides are effects: `retardance`, `stress`, `depolarization`. With
them it is a wave plate, a stressed plate, or a depolarizing foil; their axes turn with the sheet's `angle`. Angles
count from the surface's x axis to its y axis: counterclockwise for a viewer at whom the surface's normal points.
Fingerprint
    weakens the light behind it; a tilted one polarizes weakly, across the plane of incidence.
Validity
    thin: a ray is not shifted; reflections between its own faces are left out (4 % of 4 % at n = 1.5).
References
    Born & Wolf, Principles of Optics, 1.5.2.
"""

import math

from optics.polarization.mueller import diattenuator, exp, fresnel
from optics.scene.checking import agree, mueller, principal_transmittances, ray
from optics.scene.layer import layer
from optics.scene.parameter import Parameter

PARAMETERS = (
    Parameter(
        "transmittance",
        "1",
        1.0,
        (0.0, 1.0),
        "transmittance at 540 nm without the faces' losses",
        neutral=1.0,
        plausible=0.05,
        how="layer",
    ),
    Parameter(
        "transmittance_slope",
        "1",
        0.0,
        (-2.0, 2.0),
        "change of ln t per 100 nm",
        neutral=0.0,
        plausible=0.05,
        how="layer",
    ),
    Parameter(
        "index",
        "1",
        1.0,
        (1.0, 2.5),
        "refractive index n of the sheet over that of its surroundings",
        neutral=1.0,
        plausible=0.1,
        how="layer",
    ),
    Parameter(
        "angle",
        "deg",
        0.0,
        (-7200.0, 7200.0),
        "turn of the sheet about its normal",
        role="angle",
        plausible=1.0,
        how="layer",
    ),
)


def pass_sheet(crossing, sheet):
    q, u = crossing.plane()
    r_s, r_p, _ = fresnel(crossing.cos, sheet.index)
    steps = (crossing.wavelengths - 540.0) / 100
    t = sheet.transmittance * exp(sheet.transmittance_slope * steps)
    return diattenuator(q, u, t * ((1 - r_s) * (1 - r_s)), t * ((1 - r_p) * (1 - r_p)))


def check_plate():
    """A plate of n = 1.5 passes t 0.96^2 along its normal, with a colour of its own; at Brewster's angle p whole and s
    (1 - R_s)^2, R_s = ((n^2 - 1)/(n^2 + 1))^2."""
    n, bands = 1.5, (640.0, 540.0)
    matrix = mueller("sheet", ray(wavelengths=bands), index=n, transmittance=0.9, transmittance_slope=-math.log(2))
    agree(matrix[:, 0, 0], [0.45 * 0.96**2, 0.9 * 0.96**2])
    oblique = principal_transmittances(mueller("sheet", ray(math.degrees(math.atan(n))), index=n))
    agree(oblique, [[1.0], [(1 - ((n * n - 1) / (n * n + 1)) ** 2) ** 2]])


def random(rng):
    """A plate or a foil at any angle; its transmittance leaves room for a colour."""
    return {"index": rng.uniform(1.0, 1.6), "transmittance": rng.uniform(0.5, 0.85), "angle": rng.uniform(0, 180)}


part = layer("sheet", PARAMETERS, pass_sheet, checks=(check_plate,), random=random)
