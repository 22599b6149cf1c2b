"""Index mismatch: a clear material's refractive index is not the one that its data sheet says.

Definition
    n(lambda) = index + index_offset
Fingerprint
    walls between two materials grow brighter and darker with the difference of their indices, and vanish where it does;
    rays that leave the block elsewhere move what is seen behind it.
Validity
    one offset for all colours (`dispersion` is what changes with them). Where every material's is free, light that
    stays inside tells their ratios only. Printed resins: 0.01, by batch and curing.
References
    Born & Wolf, Principles of Optics, 1.5.
"""

from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def shift(n, wavelengths, clear):
    return n + clear.index_offset


effect = Effect(
    name="index mismatch",
    part="clear",
    stages={"index": shift},
    per="part",
    parameters=(
        Parameter(
            "index_offset",
            "1",
            0.0,
            (-0.3, 0.3),
            "offset of the index from `index`",
            neutral=0.0,
            plausible=0.01,
            how="difference",
        ),
    ),
    acts=("rim", "radius"),
    needs="images in which walls between two materials are seen",
)
