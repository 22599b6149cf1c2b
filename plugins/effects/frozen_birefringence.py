"""Frozen birefringence: stress that a print keeps makes a dielectric body birefringent along the way its layers were
drawn.

Definition
    delta = 2 pi dn sin^2(angle) d / lambda                      retardance of a stretch d, dn = `birefringence`, axis
    along the world's x
Fingerprint
    none of its own: it turns the polarization between two faces that polarize, and shows as faint colours where light
    is reflected or refracted aslant more than once.
Validity
    uniaxial, weak (dn below 1e-3: rays are not split), the same in the whole body; printed resins keep 1e-5 to 1e-4.
    Stress of a press is not in it. mi.render leaves it out.
References
    Born & Wolf, Principles of Optics, 15.3; Goldstein, Polarized Light, 3rd ed., 5.3.
"""

from optics.scene.declare import Effect
from optics.scene.parameter import Parameter

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
)
