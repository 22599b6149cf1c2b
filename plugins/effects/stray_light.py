"""Stray light: light reaches the detector past the layers, the same whatever they are set to.

Definition
    I' = I + s                                                   s in units of radiance, all bands alike
Fingerprint
    a floor under everything that neither angle nor power of the source changes; scales with the exposure, where a dark
    offset does not. A leak scales with the source.
Validity
    constant over a session and over the image.
References
    Goldstein, Polarized Light, 3rd ed., ch. 14 (background of polarimeters).
"""

from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def add(image, camera):
    return image + camera.stray


effect = Effect(
    name="stray light",
    part="camera",
    stages={"lens": add},
    parameters=(
        Parameter(
            "stray", "1", 0.0, (-1e3, 1e3), "radiance s added to every pixel", neutral=0.0, plausible=0.01, how="image"
        ),
    ),
    requires=("polarizer_film",),
    acts=("intensity",),
    needs="readings at another power of the source and at another exposure",
)
