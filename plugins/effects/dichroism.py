"""Dichroism: a sheet absorbs one linear polarization more than the one across it.

Definition
    M = [[1, d'], [d, c + (1 - c) n n']]        d = D n,  c = sqrt(1 - D^2);  circular light keeps c
with the diattenuation D = (T_1 - T_2)/(T_1 + T_2) of the transmittances along the axis and across it, and the axis phi
in n = (cos 2 phi, sin 2 phi): `dichroism_0` = D cos 2 phi, `dichroism_45` = D sin 2 phi, against the sheet's own axes.
What the sheet absorbs of both is its `transmittance`. Drawn and dyed polymers, tinted tape and wood are dichroic; D = 1
is a polarizer. Light meets it before the sheet's other effects whose names come later.
Fingerprint
    turned by itself before unpolarized light and one film, the sheet makes the signal swing twice per turn in first
    order, where a retardance does nothing. Between crossed films it lets light through in second order, D^2/4 of what
    passes the first one at 45 deg. It looks like a retardance where light is polarized and the sheet turns between two
    films; and at rest behind the last film, like a polarized detector.
Validity
    an absorption that is weak over one wavelength; the same at all wavelengths. A ray aslant sees what lies across it,
    over a longer path, to first order in D.
References
    Lu & Chipman, J. Opt. Soc. Am. A 13, 1106 (1996), eqs. (16)-(18); Goldstein, Polarized Light, 3rd ed., 5.2.
"""

import math

import numpy as np

from optics.polarization.mueller import cos, dichroic, sin
from optics.scene.checking import agree, mueller, ray
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def absorb(crossing, sheet):
    turn = 2 * sheet.angle * (math.pi / 180)
    a = sheet.dichroism_0 * cos(turn) - sheet.dichroism_45 * sin(turn)
    b = sheet.dichroism_0 * sin(turn) + sheet.dichroism_45 * cos(turn)
    return dichroic(*crossing.retardance(a, b, sheet.index))


def check_transmittances():
    """Light along the axis at 30 deg passes by 1 + D and across it by 1 - D, still polarized; D = 0.2."""
    double = math.radians(60.0)
    sheet = mueller("sheet", dichroism_0=0.2, angle=30.0)[0]
    for sign in (1.0, -1.0):
        light = np.array([1.0, sign * math.cos(double), sign * math.sin(double), 0.0])
        agree(sheet @ light, (1 + sign * 0.2) * light, 0, 1e-12)
    agree(mueller("sheet", dichroism_0=0.2 * math.cos(double), dichroism_45=0.2 * math.sin(double))[0], sheet, 0, 1e-12)


def check_crossed_films():
    """At 45 deg between ideal crossed films D^2/4 in place of the first order, as (sqrt(1 + D) - sqrt(1 - D))^2/4 of
    what passes the first film; turned before one film, (1 + D cos 2 phi)/2."""
    films = [mueller("polarizer_film", transmittance=1.0, angle=angle) for angle in (0.0, 90.0)]
    for d in (0.1, 0.6):
        passed = (films[1] @ mueller("sheet", dichroism_45=d) @ films[0])[:, 0, 0]
        agree(passed, [(math.sqrt(1 + d) - math.sqrt(1 - d)) ** 2 / 8])
        for phi in (0.0, 20.0, 75.0):
            turned = (films[0] @ mueller("sheet", dichroism_0=d, angle=phi))[:, 0, 0]
            agree(turned, [(1 + d * math.cos(math.radians(2 * phi))) / 2])


def check_aslant():
    """At 40 deg of incidence in a sheet of the index of its surroundings, along the axis and across the plane of
    incidence: D (1 + cos^2)/(2 cos) of the part that lies across the ray."""
    c = math.cos(math.radians(40.0))
    matrix = mueller("sheet", ray(40.0), dichroism_0=0.05)
    agree(np.hypot(matrix[:, 0, 1], matrix[:, 0, 2]), [0.05 * (1 + c * c) / 2 / c], 0, 1e-9)


def random(rng):
    """A diattenuation of up to 0.1 with its axis anywhere: less than what a random sheet absorbs of both."""
    size, double = rng.uniform(0, 0.1), rng.uniform(0, 2 * math.pi)
    return {"dichroism_0": size * math.cos(double), "dichroism_45": size * math.sin(double)}


effect = Effect(
    name="dichroism",
    part="sheet",
    per="part",
    stages={"layer": absorb},
    onset="tangent",
    parameters=tuple(
        Parameter(
            f"dichroism_{axis}",
            "1",
            0.0,
            (-0.7, 0.7),
            f"diattenuation along {axis} deg of the sheet",
            neutral=0.0,
            plausible=0.02,
            pair=f"dichroism_{45 - axis}",
            how="layer",
        )
        for axis in (0, 45)
    ),
    acts=("analyzer.angle", "sample.angle"),
    needs="the sheet turned behind or before one film, or bare light beside it",
    checks=(check_transmittances, check_crossed_films, check_aslant),
    random=random,
)
