"""Rough walls: the faces of a dielectric body are not smooth, as where layers are printed on one another.

Definition
    facets with normals m about the face's normal, distributed by Beckmann's D(m) with the rms slope alpha =
    `roughness`; Snell's and Fresnel's laws hold at each facet; a facet is met in proportion to its visible area
    (Smith's G1)
The body whose surface it is has the roughness: the outer face of walls belongs to the walls, the wall of a cell to the
filling.
Fingerprint
    lines of walls lose their sharpness and total reflection its edge, most at grazing incidence; sharp again where the
    indices agree.
Validity
    facets wider than the wavelength, alike in all directions across the face; up to 1e-4 a face is smooth. Light that
    facets pass on to each other is lost: of radiance 1 from everywhere a plate of index 1.5 shows nothing less at 0.1,
    0.4 % less at 0.3, 7 % at 0.5; of a packet among the many grazing faces of `magictac` it is 0.2 % at 0.02, 1.4 % at
    0.05, 5 % at 0.1 and 12 % at 0.2. mi.render takes faces for smooth.
References
    Walter, Marschner, Li & Torrance, EGSR 2007, eqs. (20)-(27); Heitz & d'Eon, CGF 33, 103 (2014), for visible facets.
"""

import math

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def check_shadowing():
    """G1 = 1/(1 + Lambda) with Lambda = exp(-a^2)/(2 a sqrt(pi)) - erfc(a)/2, a = 1/(alpha tan(theta)) (Smith's exact
    form, Walter's eq. 26), and a smooth face below 1e-4."""
    import mitsuba as mi

    from optics.light.transport import Run

    down, up = mi.Vector3f(0, 0, -1), mi.Vector3f(0, 0, 1)
    for alpha in (5e-5, 0.1, 0.3, 0.5):
        normal, seen = Run.facet(down, up, mi.Float(alpha), mi.PCG32(1))
        assert (abs(normal.z[0] - 1) < 1e-12) == (alpha < 1e-4)
        for theta in (30.0, 70.0, 80.0):
            t = math.radians(theta)
            a = 1 / (alpha * math.tan(t))
            shadowed = math.exp(-a * a) / (2 * a * math.sqrt(math.pi)) - math.erfc(a) / 2 if alpha > 1e-4 else 0.0
            found = seen(mi.Vector3f(math.sin(t), 0, math.cos(t)))
            agree(np.array(found), 1 / (1 + shadowed), 4e-3)  # Walter's rational fit: 0.35 %


effect = Effect(
    name="rough walls",
    part="clear",
    per="part",
    onset="secant",
    parameters=(
        Parameter(
            "roughness",
            "1",
            0.0,
            (0.0, 0.5),
            "roughness alpha of the body's faces: rms slope",
            neutral=0.0,
            plausible=0.05,
            how="difference",
            squared=True,
        ),
    ),
    acts=("rim", "radius"),
    needs="sharp images of walls and of edges behind them",
    checks=(check_shadowing,),
)
