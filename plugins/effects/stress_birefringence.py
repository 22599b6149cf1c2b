"""Stress birefringence: a sheet under stress delays light between its principal stresses.

Definition
    delta(lambda) = 2 pi C (sigma_1 - sigma_2) d/lambda          stress-optic law
The pattern turns with the sheet's `angle`, except that of the skin. The components are (a, b) = 2 pi C d/lambda stress
(P_q, P_u), with the coefficient C = `stress_optic` (C > 0: the larger tension is the fast axis), the thickness d =
`stress_thickness`, and the pattern (P_q, P_u) = (s_xx - s_yy, 2 s_xy) per unit of `stress`:
    even    (1, 0): uniform tension along the sheet's x axis
    disc    a disc of the diameter `stress_size` pressed along its y axis: s_ij of the two point loads, in units of
            2P/(pi D d)
    bend    a bar along x, bent: (2 y/size, 0)
    gel     of the skin that the present press deforms (see `field`), stress in units of its shear modulus,
            thickness included
    a file  an image (H, W, 2 or more) in NPY or EXR: P_q and P_u over the square of `stress_size`, row 0 on top
Fingerprint
    a pattern of fringes that follows the stress; between crossed polarizers dark where a principal stress is along a
    polarizer. A faint pattern is of second order and hidden; see `retardance`.
Validity
    linear elasticity in the sheet's plane, stress constant through the thickness (or integrated through it: `gel`).
References
    Frocht, Photoelasticity II (1948), 4.19 (disc); Goldstein, Polarized Light, 3rd ed., 24.6; Brewster's law 1 B =
    1e-12/Pa.
"""

import math

import numpy as np

from optics.errors import BadScene
from optics.polarization.mueller import cos, real, retarder, sin, where
from optics.scene.checking import agree, mueller, ray
from optics.scene.declare import Effect
from optics.scene.layer import PatternImage
from optics.scene.parameter import Parameter
from optics.skin.halfspace import SkinStress


def strain(crossing, sheet):
    turn = 0.0 if sheet.stress_pattern == "gel" else sheet.angle * (math.pi / 180)
    c, s = cos(turn), sin(turn)
    x, y = crossing.u * c + crossing.v * s, crossing.v * c - crossing.u * s  # the pattern's own axes
    q, u = pattern(x, y, sheet)
    p_q, p_u = q * (c * c - s * s) - u * (2 * c * s), q * (2 * c * s) + u * (c * c - s * s)
    factor = 2 * math.pi * sheet.stress_optic * sheet.stress_thickness * sheet.stress / crossing.wavelengths
    return retarder(*crossing.retardance(p_q * factor, p_u * factor, sheet.index))


def pattern(x, y, sheet):
    if sheet.stress_pattern == "even":
        return 1.0 + 0 * x, 0 * x
    if sheet.stress_pattern == "bend":
        return 2 * y / sheet.stress_size, 0 * x
    if sheet.stress_pattern == "disc":
        return disc(x, y, sheet.stress_size / 2)
    return sheet.field(x, y, sheet.stress_size)


def disc(x, y, radius):
    """(s_xx - s_yy, 2 s_xy) of a disc pressed at (0, +-R) by P, over 2P/(pi D thickness) D = P/(pi R d); 0 outside."""
    inside = real(x * x + y * y) < real(radius * radius) * 0.9999
    up, down = radius - y, radius + y
    r1, r2 = x * x + up * up, x * x + down * down
    q = -(2 * radius) * (up * (x * x - up * up) / (r1 * r1) + down * (x * x - down * down) / (r2 * r2))
    u = 2 * (2 * radius) * (up * up * x / (r1 * r1) - down * down * x / (r2 * r2))
    return where(inside, q, 0.0 * q), where(inside, u, 0.0 * u)


def field(sheet):
    """The pattern that a file holds, or the present press's stress in the skin, from the sheet's depth on both sides
    alike up to the skin's inner face."""
    pattern = sheet.stress_pattern
    if pattern.endswith((".npy", ".exr")):
        return PatternImage(sheet.find_file(pattern))
    if pattern != "gel":
        return None
    if sheet.skin is None or sheet.carrier is None:
        raise BadScene(
            f"'{sheet.name}': stress_pattern = 'gel' needs a sheet in the skin, a shape of the type 'carried'"
        )
    thickness = sheet.skin.number("thickness")
    return SkinStress(sheet.skin, max(2 * sheet.carrier.number("depth") - thickness, 0.0), thickness)


def check_stress_optic_law():
    """2 MPa in 3 mm of C = 5 Brewster retard 540 nm by 2 pi 5e-12 2e6 3e-3/540e-9 = 0.34907, by the ratio of the
    wavelengths in other bands; crossed polarizers at 45 degrees pass sin(delta/2)^2/2."""
    at = ray(wavelengths=(620.0, 540.0, 460.0))
    films = [mueller("polarizer_film", at, transmittance=1.0, angle=angle) for angle in (0.0, 90.0)]
    passed = (films[1] @ mueller("sheet", at, stress=2.0, angle=45.0) @ films[0])[:, 0, 0]
    agree(passed, np.sin(0.3490658504 * 540 / np.array([620, 540, 460]) / 2) ** 2 / 2, 1e-9)


def check_patterns():
    """Frocht's disc: in its middle the principal stresses 2P/(pi D d) and -6P/(pi D d) differ by 4 units, on the edge
    there is no stress; a bent bar has the tension +-1 at its edges and 0 on its neutral axis."""
    q, u = disc(np.array([0.0, 9.999]), np.array([0.0, 0.0]), 10.0)
    agree(q, [4.0, 0.0], 0, 1e-3)  # 1e-4 of the radius inside the edge
    agree(u, [0.0, 0.0], 0, 1e-12)
    for y, delta in ((10.0, 0.3490658504), (-5.0, 0.1745329252), (0.0, 0.0)):
        matrix = mueller("sheet", ray(v=y), stress=2.0, stress_pattern="bend", stress_size=20.0)
        agree(matrix[0, 3, 3], np.cos(delta), 1e-9)


def random(rng):
    """Up to 2 MPa over a sheet of a few centimetres."""
    return {"stress": rng.uniform(-2, 2), "stress_size": rng.uniform(10, 60)}


effect = Effect(
    name="stress birefringence",
    field=field,
    part="sheet",
    per="part",
    stages={"layer": strain},
    onset="both",
    parameters=(
        Parameter(
            "stress",
            "MPa",
            0.0,
            (-1e3, 1e3),
            "stress of the pattern",
            neutral=0.0,
            plausible=0.2,
            starts=(-9.0, 9.0, -18.0, 18.0, -27.0, 27.0, -36.0, 36.0),  # 9 MPa in 3 mm retard by 90 deg
            how="layer",
        ),
    ),
    shape=(
        Parameter(
            "stress_optic",
            "1e-12/Pa",
            5.0,
            (-1e5, 1e5),
            "stress-optic coefficient C, in Brewster",
            plausible=0.5,
            how="layer",
        ),
        Parameter("stress_thickness", "mm", 3.0, (1e-6, 100.0), "thickness d", plausible=0.1, how="layer"),
        Parameter("stress_size", "mm", 20.0, (1e-3, 1000.0), "size of the pattern", plausible=1.0, how="layer"),
        Parameter(
            "stress_pattern",
            "-",
            "even",
            choices=("even", "disc", "bend", "gel"),
            doc="even, disc, bend, gel or a file",
            files=(".npy", ".exr"),
        ),
    ),
    acts=("analyzer.angle", "sample.angle", "radius"),
    needs="the sheet at two angles, best behind a quarter-wave plate",
    checks=(check_stress_optic_law, check_patterns),
    random=random,
)
