"""Depolarization: a hazy sheet mixes the polarizations of the light that it lets through.

Definition
    M = diag(1, 1 - d, 1 - d, 1 - d)
Fingerprint
    the contrast of Malus' curve falls: the dark end rises and the bright end sinks by the same amount, so that the mean
    over all angles stays. A leak raises the dark end alone. Between two polarizers only.
Validity
    forward scattering that stays within the beam; the same for linear and circular polarization.
References
    Goldstein, Polarized Light, 3rd ed., ch. 6 (depolarizers); physics of hazy elastomers: forward scattering.
"""

from optics.polarization.mueller import depolarizer
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def mix(crossing, sheet):
    return depolarizer(1.0 - sheet.depolarization)


effect = Effect(
    name="depolarization",
    part="sheet",
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
)
