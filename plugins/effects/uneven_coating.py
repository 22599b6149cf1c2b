"""Uneven coating: what presses on the coating shows through it more in some places of the face than in others.

Definition
    L' = L (1 + q(x, y) c(x, y)),   c = 1 where the object touches the face, 0 elsewhere
    q = q_x x + q_y y + (q_xx x^2 + 2 q_xy x y + q_yy y^2)/2
with the place (x, y) on the face from the gel's middle. Where the gain of a `thin coating` is g, and g_0 in the middle,
q = (g - g_0)/(1 + g_0). Of a coat that scatters and absorbs nothing, of the thickness d(x, y), with R = S d/(1 + S d)
and an object of the reflectance rho_b behind it,
    g = rho_b (1 - R)^2 / (R (1 - R rho_b))
    dg/g = -(1 + R - rho_b R (1 - R)/(1 - R rho_b)) dd/d
so that g is larger by 10 to 20 % where the coat is thinner by 10 %.
Fingerprint
    contacts differ in brightness by where they are on the face, the same under every LED and with every shape of one
    material, and smoothly. A curved face makes such gradients that turn with the LED. Where nothing touches there is
    none: what the coat itself reflects is in the flat field.
Validity
    a thickness that varies slowly over the face; objects of one reflectance. Bodies that differ, or grains of the coat,
    make contacts differ from one to the next: those have no such law.
References
    Kubelka, J. Opt. Soc. Am. 38, 448 (1948), layers over a backing; the neglect of S1.4: a coat that is the same
    everywhere.
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def show(path, gel):
    x, y = path.p.x, path.p.y
    bent = gel.uneven_xx * x * x + 2 * gel.uneven_xy * x * y + gel.uneven_yy * y * y
    return 1 + (gel.uneven_x * x + gel.uneven_y * y + bent / 2) * gel.touched(path.p)


def check_two_contacts():
    """A ball of 1.5 mm, 0.5 mm deep, at (2, 1) and at (-2, 1) mm: q = 0.01 x + 0.02 y + 0.003 x^2 - 0.002 x y is
    0.048 in one and 0.016 in the other; on the face 4 mm away nothing changes."""
    import mitsuba as mi

    numbers = {"uneven_x": 0.01, "uneven_y": 0.02, "uneven_xx": 0.006, "uneven_xy": -0.002}
    for x, q in ((2.0, 0.048), (-2.0, 0.016)):
        gel = made("gel", press_depth=0.5, press_x=x, press_y=1.0, **numbers, bsdf={"type": "membrane"})
        gel.heights([0.0], [0.0])  # presses
        for at, expected in ((x, 1 + q), (-x, 1.0)):
            agree(np.array(show(SimpleNamespace(p=mi.Point3f(at, 1.0, -0.1)), gel)), expected, 1e-5)


def coefficient(name: str, unit: str, most: float, plausible: float, of: str) -> Parameter:
    return Parameter(
        name,
        unit,
        0.0,
        (-most, most),
        f"what shows through the coating, by {of}",
        neutral=0.0,
        plausible=plausible,
        when_pressed=True,
    )


effect = Effect(
    name="uneven coating",
    part="gel",
    stages={"segment": show},
    parameters=(
        coefficient("uneven_x", "1/mm", 1.0, 0.01, "x"),
        coefficient("uneven_y", "1/mm", 1.0, 0.01, "y"),
        coefficient("uneven_xx", "1/mm^2", 1.0, 0.005, "x^2/2"),
        coefficient("uneven_xy", "1/mm^2", 1.0, 0.005, "x y"),
        coefficient("uneven_yy", "1/mm^2", 1.0, 0.005, "y^2/2"),
    ),
    acts=("row", "column", "contact_distance"),
    needs="contacts all over the field, whose edges are in view",
    checks=(check_two_contacts,),
)
