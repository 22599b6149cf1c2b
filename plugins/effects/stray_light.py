"""Stray light: light reaches the detector past the layers, whatever they are set to.

Definition
    I' = I + s                                                   s in units of radiance, the same in all bands
Fingerprint
    an offset that depends neither on the angle of a polarizer nor on the power of the source. It scales with the
    exposure, which a dark offset does not; a leak scales with the source. Light only adds.
Validity
    constant over a session and over the image.
References
    Goldstein, Polarized Light, 3rd ed., ch. 14 (background of polarimeters).
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def add(image, camera):
    return image + camera.stray * getattr(camera, "white", 1.0)


def check_floor():
    """A dark image shows s in every pixel and band; the contrast (max - min)/(max + min) of a cos^2 curve falls to
    1/(1 + 2 s)."""
    dark, curve = np.zeros((2, 3, 3)), np.cos(np.radians([0.0, 30.0, 90.0]))[None, :, None] ** 2
    camera = SimpleNamespace(stray=0.02)
    agree(add(dark, camera), np.full(dark.shape, 0.02))
    found = add(curve, camera)
    agree((found.max() - found.min()) / (found.max() + found.min()), 1 / 1.04)


effect = Effect(
    name="stray light",
    part="camera",
    stages={"lens": add},
    parameters=(
        Parameter(
            "stray", "1", 0.0, (0.0, 1e3), "radiance s added to every pixel", neutral=0.0, plausible=0.01, how="image"
        ),
    ),
    requires=("polarizer_film",),
    acts=("intensity",),
    needs="readings at another power of the source and at another exposure",
    checks=(check_floor,),
)
