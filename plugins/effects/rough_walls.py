"""Rough walls: the faces of a dielectric body are not smooth, as where layers are printed on one another.

Definition
    facets with normals m about the face's normal, as common as Beckmann's D(m), alpha = `roughness` the rms of their
    slope; Snell's and Fresnel's laws hold at each facet, which is met as often as it is seen (Smith's G1)
The body whose surface it is has the roughness: the outer face of walls is theirs, the wall of a cell is the filling's.
Fingerprint
    lines of walls lose their sharpness and total reflection its edge, most at grazing incidence; sharp again where the
    indices agree.
Validity
    facets wider than the wavelength, alike in all directions across the face; up to 1e-4 a face is smooth. Light that
    facets pass on to each other is lost: of radiance 1 from everywhere a plate of index 1.5 shows nothing less at 0.1,
    0.4 % less at 0.3, 7 % at 0.5; of a packet among the many grazing faces of `magictac` it is 0.2 % at 0.02, 1.4 % at
    0.05, 5 % at 0.1 and 12 % at 0.2. mi.render takes faces for smooth.
References
    Walter, Marschner, Li & Torrance, EGSR 2007, eqs. (20)-(27); Heitz & d'Eon, CGF 33, 103 (2014), for facets that are
    seen.
"""

from optics.scene.declare import Effect
from optics.scene.parameter import Parameter

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
)
