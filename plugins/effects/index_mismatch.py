"""Index mismatch: a clear material's refractive index is not the one of its data sheet.

Definition
    n(lambda) = index + index_offset
Fingerprint
    walls between two materials grow brighter and darker with the difference of their indices, and vanish where it does;
    rays that leave the block in another place shift what is seen behind it.
Validity
    one offset for all colours (`dispersion` changes with the colour). Where the offset of every material is free, light
    that stays inside determines their ratios only. Printed resins: 0.01, by batch and curing.
References
    Born & Wolf, Principles of Optics, 1.5.
"""

from types import SimpleNamespace

import numpy as np

from optics.polarization.mueller import fresnel
from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def shift(n, wavelengths, clear):
    return n + clear.index_offset


def check_reflectance_of_a_wall():
    """Between materials of the index 1.5 that differ by 0.02, a wall reflects (0.02/3.02)^2 along its normal, in every
    band."""
    one, other = (shift(np.full(3, 1.5), 0, SimpleNamespace(index_offset=offset)) for offset in (0.0, 0.02))
    agree(one, [1.5] * 3)
    for reflectance in fresnel(np.ones(3), other / one)[:2]:
        agree(reflectance, [(0.02 / 3.02) ** 2] * 3, 1e-9)


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
            step=1.0,
        ),
    ),
    acts=("rim", "radius"),
    needs="images in which walls between two materials are seen",
    checks=(check_reflectance_of_a_wall,),
)
