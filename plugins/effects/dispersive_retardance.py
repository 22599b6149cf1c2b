"""Dispersive retardance: a sheet's birefringence depends on the wavelength.

Definition
    delta(lambda) = delta_540 (540/lambda) (1 + retard_dispersion ((540/lambda)^2 - 1))
Without dispersion a retardance falls as 1/lambda, by the longer wave alone.
Fingerprint
    the ratio of the retardances of two colours is not that of their wavelengths; nothing where there is no retardance.
Validity
    Cauchy's law with one term.
References
    Born & Wolf, Principles of Optics, 2.3.4 and 15.4.
"""

import numpy as np

from optics.scene.checking import agree, mueller, ray
from optics.scene.declare import Effect


def check_ratio_of_colours():
    """cos(delta), the circular light that a retarder leaves circular, at 540 and 450 nm: delta = 40 and 40 1.2 (1 +
    0.1 0.44) degrees."""
    matrix = mueller("sheet", ray(wavelengths=(540.0, 450.0)), retard_45=40.0, retard_dispersion=0.1)
    agree(matrix[:, 3, 3], np.cos(np.radians([40.0, 40 * 1.2 * 1.044])))


effect = Effect(
    name="dispersive retardance",
    part="sheet",
    per="part",
    parameters=("retard_dispersion",),
    acts=("channel", "analyzer.angle"),
    needs="a retardance, in two colours as far apart as 460 and 620 nm",
    checks=(check_ratio_of_colours,),
)
