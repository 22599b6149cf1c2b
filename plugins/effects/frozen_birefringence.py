"""Frozen birefringence: residual stress of a print makes a dielectric body birefringent along its layers' direction.

Definition
    delta = 2 pi dn sin^2(angle) d / lambda
the retardance of a stretch d, with dn = `birefringence`, the optic axis along the world's x, and the angle between ray
and axis.
Fingerprint
    none of its own: it turns the polarization between two faces that polarize, and shows as faint colours where light
    is reflected or refracted obliquely more than once.
Validity
    uniaxial, weak (dn below 1e-3: rays are not split), the same in the whole body; printed resins keep 1e-5 to 1e-4.
    Stress of a press is not included. mi.render leaves it out.
References
    Born & Wolf, Principles of Optics, 15.3; Goldstein, Polarized Light, 3rd ed., 5.3.
"""

import math

from optics.scene.checking import agree, scene_of
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def check_retardance():
    """Light polarized at 45 degrees to the axis keeps cos(delta) of S2 and turns sin(delta) of it into S3: across the
    axis, at 30 degrees to it (a quarter of the retardance) and along it (none)."""
    import mitsuba as mi

    from optics.light.transport import Run, Transport

    dn, d, band = 1e-4, 1.7, 540.0
    body = '<bsdf type="clear" id="body"><float name="birefringence" value="1e-4"/></bsdf>'
    lamp = '<shape type="rectangle"><emitter type="source" id="lamp"/></shape>'
    run = Run(Transport(scene_of(f'<shape type="cube">{body}</shape>', lamp, bands=str(band))), [0], 1, 0)
    for angle, square in ((90.0, 1.0), (30.0, 0.25), (0.0, 0.0)):
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        state = {"d": mi.Vector3f(c, 0, s), "x": mi.Vector3f(s, 0, -c), "medium": mi.UInt32(1)}
        state["v"] = [mi.Float(entry) for entry in (1.0, 0.0, 1.0, 0.0)]
        vector, _ = run.retarded(state, mi.Float(d), True)
        delta = 2 * math.pi * dn * square * d * 1e6 / band
        agree([vector[2][0], abs(vector[3][0])], [math.cos(delta), abs(math.sin(delta))], 0, 1e-6)


effect = Effect(
    name="frozen birefringence",
    part="clear",
    per="part",
    onset="secant",
    parameters=(
        Parameter(
            "birefringence",
            "1",
            0.0,
            (-1e-3, 1e-3),
            "index along x, less that across",
            neutral=0.0,
            plausible=3e-5,
            how="difference",
            step=1.0,
        ),
    ),
    acts=("channel", "incidence"),
    needs="light that is polarized by slanting faces before and behind the body: two panels, aslant",
    checks=(check_retardance,),
)
