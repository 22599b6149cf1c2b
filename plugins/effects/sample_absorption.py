"""Sample absorption: a sheet beside bare light weakens what passes it.

Definition
    M = t F                      t = `transmittance` of the sheet in its region of the view, 1 outside
Fingerprint
    its region is darker by one factor at all angles of all polarizers. A depolarization or a retardance there changes
    with the angles.
Validity
    a sheet that covers a part of the view (`region_map`). Over the whole view a transmittance is a share of the light's
    power, and no effect.
References
    Born & Wolf, Principles of Optics, 4.8.2 (absorption in a plate).
"""

from optics.scene.checking import agree, mueller
from optics.scene.declare import Effect


def check_every_polarization_alike():
    """0.7 of S0, S1, S2 and S3."""
    agree(mueller("sheet", transmittance=0.7)[0], [[0.7 * (i == j) for j in range(4)] for i in range(4)])


effect = Effect(
    name="sample absorption",
    part="sheet",
    per="part",
    parameters=("transmittance",),
    acts=("place",),
    needs="bare light beside the sample, at two angles of the analyser",
    checks=(check_every_polarization_alike,),
)
