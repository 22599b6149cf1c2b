"""Bead settling: beads sink in the gel before it is hard.

Definition
    s_j -> s_j + settling (D_j/D)^2 (cos(gravity), sin(gravity), 0)
    settling = (rho_p - rho_f) V g/b [t + (m/b)(exp(-b t/m) - 1)],  b = 6 pi eta R,  m = rho_p V
The mould lies on its side while the gel cures, so that the beads sink across the view, towards `gravity` (deg, from x,
right, to y, down). Stokes: the speed grows with the square of the diameter. The source prints the second line,
its (A3), without the factor 1/b.
Fingerprint
    all beads are shifted one way; the camera's own shift moves near and far beads by other amounts, and the LEDs not.
Validity
    one viscosity until the gel is hard; beads at the wall would pile up there and do not.
References
    Sensors 19 (2019) 928, appendix A: 0.35 mm in ten minutes; Stokes (1851).
"""

from optics.scene.checking import agree, made
from optics.scene.declare import Effect
from optics.skin.cloud import settled


def check_ten_minutes():
    """The published numbers: 1020 and 980 kg/m^3, a radius of 0.25 mm, 9.3 Pa s: 0.3513 mm in 600 s; and the beads go
    there."""
    agree(settled(600.0), 0.3513, 1e-3)  # the source rounds the volume to 0.0654 mm^3
    size = {"count": 4, "detail": 1, "gravity": 30.0, "bsdf": {"type": "fluorescent"}}
    before, after = (made("beads", settling=way, **size).centres() for way in (0.0, 0.35))
    agree(after - before, [[0.35 * 0.75**0.5, 0.175, 0.0]] * 4, 1e-5, 1e-6)


effect = Effect(
    name="bead settling",
    part="beads",
    parameters=("settling",),
    acts=("gradient",),
    needs="beads at places that are known from the time before the cure, or by the seed",
    checks=(check_ten_minutes,),
)
