"""Depolarization: a hazy sheet mixes the polarizations of the light that it transmits.

Definition
    M = diag(1, 1 - d, 1 - d, 1 - d)
Fingerprint
    the contrast of Malus' curve falls: the dark end rises and the bright end drops by the same amount, so that the mean
    over all angles stays. A leak raises the dark end alone. Visible between two polarizers only.
Validity
    forward scattering that stays within the beam; the same for linear and circular polarization.
References
    Goldstein, Polarized Light, 3rd ed., ch. 6 (depolarizers); physics of hazy elastomers: forward scattering.
"""

import numpy as np

from optics.polarization.mueller import depolarizer
from optics.scene.checking import agree, mueller
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def mix(crossing, sheet):
    return depolarizer(1.0 - sheet.depolarization)


def check_contrast():
    """Between parallel and crossed ideal polarizers: (1 - d/2)/2 and d/4 of unpolarized light; circular light keeps
    1 - d."""
    sheet = mueller("sheet", depolarization=0.1)
    first = mueller("polarizer_film", transmittance=1.0)
    for angle, expected in ((0.0, 0.475), (90.0, 0.025)):
        agree((mueller("polarizer_film", transmittance=1.0, angle=angle) @ sheet @ first)[:, 0, 0], [expected])
    agree(sheet[0] @ [1, 0, 0, 1], np.array([1, 0, 0, 0.9]))


effect = Effect(
    name="depolarization",
    part="sheet",
    per="part",
    stages={"layer": mix},
    parameters=(
        Parameter(
            "depolarization",
            "1",
            0.0,
            (0.0, 1.0),
            "share d of the polarization that is lost",
            neutral=0.0,
            plausible=0.02,
            how="layer",
        ),
    ),
    acts=("analyzer.angle", "intensity"),
    needs="the bright and the dark end of Malus' curve, at known power",
    checks=(check_contrast,),
)
