"""Dark offset: the camera's zero differs from the calibrated black level.

Definition
    DN' = DN + offset
Fingerprint
    the same number of DN at every pixel, whatever the light and the exposure. An offset that was there from the start
    means that `black_level` in captures.toml is too low by as much. Half a DN looks like glare where there is no glare.
Validity
    constant over a session; one number for all channels.
References
    EMVA 1288 release 4.0, 2.2 (dark signal).
"""

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect


def check_digital_numbers():
    """black_level + offset in the dark and offset above half of full scale elsewhere, at two exposures."""
    from optics.light.development import Developer

    camera = made("camera", film={"type": "hdrfilm", "width": 2, "height": 2})
    developer = Developer(camera, (620.0, 540.0, 460.0), black=8.0, saturation=248.0)
    for exposure, level in ((1.0, 0.5), (2.0, 0.25)):
        values = {f"{camera.name}.{n}": camera.number(n) for n in camera.numbers}
        values |= {f"{camera.name}.exposure": exposure, f"{camera.name}.offset": 3.0}
        agree(developer.develop(np.zeros((2, 2, 3)), values), np.full((2, 2, 3), 11.0))
        agree(developer.develop(np.full((2, 2, 3), level), values), np.full((2, 2, 3), 131.0))


effect = Effect(
    name="dark offset",
    part="camera",
    parameters=("offset",),
    acts=("intensity",),
    needs="dark frames, or readings at two exposures and two powers",
    checks=(check_digital_numbers,),
)
