"""Dichroism: a sheet absorbs one linear polarization more than the one across it.

Definition
    M = [[1, D n'], [D n, c + (1 - c) n n']] of linear light;  circular light keeps c
    D = tanh x,  c = sqrt(1 - D^2)
with x = ln(T_1/T_2)/2 of the transmittances along the axis and across it, whose mean is the sheet's `transmittance`; D
is the diattenuation (T_1 - T_2)/(T_1 + T_2). The axis phi stands in n = (cos 2 phi, sin 2 phi): `dichroism_0` = x cos 2
phi, `dichroism_45` = x sin 2 phi, against the sheet's own axes. Drawn and dyed polymers, tinted tape and wood are
dichroic; a large x is a polarizer. Light meets the dichroism after a depolarization and before a retardance.
Fingerprint
    a sheet that is turned in unpolarized light, with one film before or behind it, makes the signal swing twice per
    turn in first order, where a retardance does nothing. So it does between two films that are not crossed. Between
    crossed films it lets light through in second order, at 45 deg D^2/4 of what passes the first film: turned there, it
    looks exactly like a retardance. At rest behind the last film it looks like a polarized detector; at rest behind a
    film, like a change of power or of that film's zero.
Validity
    weak absorption over one wavelength of light, the same at all wavelengths. A ray aslant sees the part of the
    in-plane absorption that lies across it, over a longer path (optics.polarization.layers.Crossing.retardance). A
    sheet that is not to make light needs a transmittance of 1/(1 + D) or less.
References
    Lu & Chipman, J. Opt. Soc. Am. A 13, 1106 (1996), eqs. (16)-(18); Goldstein, Polarized Light, 3rd ed., 5.2.
"""

import math

import numpy as np

from optics.polarization.mueller import dichroic, turned
from optics.scene.checking import agree, mueller, ray
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def absorb(crossing, sheet):
    a, b = turned(sheet.dichroism_0, sheet.dichroism_45, sheet.angle)
    return dichroic(*crossing.retardance(a, b, sheet.index))


def check_transmittances():
    """Light along the axis at 30 deg passes by 1 + D and across it by 1 - D, still polarized; their ratio is exp(2
    x)."""
    x, double = 0.2, math.radians(60.0)
    sheet = mueller("sheet", dichroism_0=x, angle=30.0)[0]
    passed = [1 + math.tanh(x), 1 - math.tanh(x)]
    agree(math.log(passed[0] / passed[1]), 2 * x)
    for sign, t in zip((1.0, -1.0), passed):
        light = np.array([1.0, sign * math.cos(double), sign * math.sin(double), 0.0])
        agree(sheet @ light, t * light, 0, 1e-12)
    agree(mueller("sheet", dichroism_0=x * math.cos(double), dichroism_45=x * math.sin(double))[0], sheet, 0, 1e-12)
    agree(sheet @ [1, 0, 0, 1] * math.cosh(x), [math.cosh(x), *(sheet[1:3, 0] * math.cosh(x)), 1.0], 0, 1e-12)


def check_crossed_films():
    """At 45 deg between ideal crossed films (sqrt(T_1) - sqrt(T_2))^2/4 of what passes the first film; turned before
    one film, (1 + D cos 2 phi)/2."""
    films = [mueller("polarizer_film", transmittance=1.0, angle=angle) for angle in (0.0, 90.0)]
    for x in (0.1, 0.6):
        d = math.tanh(x)
        passed = (films[1] @ mueller("sheet", dichroism_45=x) @ films[0])[:, 0, 0]
        agree(passed, [(math.sqrt(1 + d) - math.sqrt(1 - d)) ** 2 / 8], 1e-12)
        for phi in (0.0, 20.0, 75.0):
            turned = (films[0] @ mueller("sheet", dichroism_0=x, angle=phi))[:, 0, 0]
            agree(turned, [(1 + d * math.cos(math.radians(2 * phi))) / 2])


def check_aslant():
    """At 40 deg of incidence in a sheet of the index of its surroundings, along the axis or across it: x (1 +
    cos^2)/(2 cos)."""
    c = math.cos(math.radians(40.0))
    matrix = mueller("sheet", ray(40.0), dichroism_0=0.05)
    agree(np.hypot(matrix[:, 0, 1], matrix[:, 0, 2]), [math.tanh(0.05 * (1 + c * c) / 2 / c)])


def check_whole_dichroism():
    """x = 20 is an ideal film of twice its transmittance."""
    film = mueller("polarizer_film", transmittance=1.0, angle=20.0)[0]
    agree(mueller("sheet", dichroism_0=20.0, angle=20.0)[0] / 2, film, 0, 1e-8)


def random(rng):
    """Up to 0.1 with its axis anywhere, in a sheet that absorbs as much."""
    size, double = rng.uniform(0, 0.1), rng.uniform(0, 2 * math.pi)
    components = {"dichroism_0": size * math.cos(double), "dichroism_45": size * math.sin(double)}
    return {**components, "transmittance": rng.uniform(0.5, 0.85)}


effect = Effect(
    name="dichroism",
    part="sheet",
    per="part",
    stages={"layer": absorb},
    onset="both",
    parameters=tuple(
        Parameter(
            f"dichroism_{axis}",
            "1",
            0.0,
            (-2.0, 2.0),
            f"half of ln(T along / T across) of an axis at {axis} deg of the sheet",
            neutral=0.0,
            plausible=0.02,
            pair=f"dichroism_{45 - axis}",
            how="layer",
        )
        for axis in (0, 45)
    ),
    acts=("analyzer.angle", "sample.angle"),
    needs="the sheet turned before or behind one film; bare light beside it helps",
    checks=(check_transmittances, check_crossed_films, check_aslant, check_whole_dichroism),
    random=random,
)
