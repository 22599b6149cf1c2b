"""Volume scattering: a material that is not quite clear sends light aside.

Definition
    dL/ds = -sigma_s L + sigma_s/(4 pi) integral L domega        sigma_s = `scattering`, the same in all directions
Fingerprint
    the whole body glows, brightest before the LEDs, where a clear one is dark; images through it fade.
Validity
    isotropic, unpolarized afterwards. mi.render does not follow it.
References
    Chandrasekhar, Radiative Transfer (1960), 1.5.
"""

from optics.scene.declare import Effect
from optics.scene.parameter import Parameter

effect = Effect(
    name="volume scattering",
    part="clear",
    per="part",
    parameters=(
        Parameter(
            "scattering",
            "1/mm",
            0.0,
            (0.0, 10.0),
            "scattering coefficient sigma_s",
            neutral=0.0,
            plausible=0.02,
            how="difference",
            step=1.0,
        ),
    ),
    acts=("led_distance", "intensity"),
    needs="LEDs of different sides, one at a time",
)
