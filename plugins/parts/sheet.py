"""Sheet: a thin clear layer in the light's way: a plate, a foil, the sample slot of a bench.

Definition
    M = t F                    transmittance t = transmittance exp(transmittance_slope (lambda - 540)/100)
    F = diattenuator(s, (1 - R_s)^2, (1 - R_p)^2)      both faces, Fresnel's R_s, R_p
n = `index` is the sheet's index over that of what surrounds it: 1 in the middle of a skin of its own kind, 1.5 for a
plate in air. What the sheet does to polarization besides are effects: `retardance`, `stress`, `dichroism`,
`depolarization`. With them it is a wave plate, a stressed plate, a tinted drawn foil, or a depolarizing one; their axes
turn with the sheet's `angle`. Angles count from the surface's x axis to its y axis: counterclockwise for a viewer at
whom the surface's normal points.
A sheet that covers a part of the view alone has a map, `region_map` (optics.scene.regions): it acts where the map has
the number `region` and does nothing elsewhere, so that one photograph shows the sample beside bare light. The map stays
where it is when the sheet turns. Two sheets with one map and two numbers are two samples.
Fingerprint
    weakens the light behind it; a tilted one polarizes weakly, across the plane of incidence.
Validity
    thin: a ray is not shifted; reflections between its own faces are left out (4 % of 4 % at n = 1.5).
References
    Born & Wolf, Principles of Optics, 1.5.2.
XML
    region_size float, 0.0: width of the map of regions, mm; 0: as wide as the camera sees
"""

import math

from optics.polarization.mueller import diattenuator, exp, fresnel
from optics.scene.checking import agree, mueller, principal_transmittances, ray
from optics.scene.layer import layer
from optics.scene.parameter import Parameter
from optics.scene.regions import FILES, PATTERNS, Regions

PARAMETERS = (
    Parameter(
        "transmittance",
        "1",
        1.0,
        (0.0, 1.0),
        "transmittance at 540 nm without the faces' losses",
        neutral=1.0,
        plausible=0.05,
        multiplies=True,
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
        starts=(22.5, 67.5, 112.5, 157.5),
        how="layer",
    ),
    Parameter(
        "region_map",
        "-",
        "whole",
        role="regions",
        choices=("whole", "halves", "quarters"),
        doc="where the sheet is: whole, halves (0 left, 1 right), quarters (0 1 above 2 3) or an image of numbers",
        files=FILES,
    ),
    Parameter(
        "region",
        "-",
        "1",
        role="region",
        choices=tuple("01234567"),
        doc="number of the region that the sheet covers, where it has a map",
    ),
)

BESIDE = ("transmittance",)  # without bare light beside it, it is a share of the light's power


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


def check_regions():
    """A sheet of t = 0.5 on the right half alone: 0.5 at x = +1 mm, 1 at -1 mm; in a quarter alone, in the fourth."""
    for pattern, number, expected in (("halves", 1, [0.5, 1.0, 0.5, 1.0]), ("quarters", 3, [1.0, 1.0, 0.5, 1.0])):
        regions = Regions(PATTERNS[pattern], 4.0)

        def cover(x, y, regions=regions, number=number):
            return regions.within(x, y, number)

        places = ((1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0))
        found = [mueller("sheet", ray(u=u, v=v), transmittance=0.5, cover=cover)[0, 0, 0] for u, v in places]
        agree(found, expected)


def random(rng):
    """A plate or a foil at any angle; its transmittance leaves room for a colour."""
    return {"index": rng.uniform(1.0, 1.6), "transmittance": rng.uniform(0.5, 0.85), "angle": rng.uniform(0, 180)}


part = layer("sheet", PARAMETERS, pass_sheet, checks=(check_plate, check_regions), random=random, beside=BESIDE)
