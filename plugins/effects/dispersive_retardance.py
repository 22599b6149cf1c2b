"""Dispersive retardance: a sheet's birefringence depends on the wavelength.

Definition
    delta(lambda) = delta_540 (540/lambda) (1 + retard_dispersion ((540/lambda)^2 - 1))
Without it a retardance falls as 1/lambda by the longer wave alone.
Fingerprint
    the ratio of the retardances of two colours is not that of their wavelengths; nothing where there is no retardance.
Validity
    Cauchy's law with one term.
References
    Born & Wolf, Principles of Optics, 2.3.4 and 15.4.
"""

from optics.scene.declare import Effect

effect = Effect(
    name="dispersive retardance",
    part="sheet",
    parameters=("retard_dispersion",),
    acts=("channel", "analyzer.angle"),
    needs="a retardance, in two colours or more",
)
