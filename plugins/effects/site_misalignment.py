"""Site misalignment: the mosaic of analysers is turned against the image's axes.

Definition
    I = 1/2 [S0 + S1 cos 2(a + t) + S2 sin 2(a + t)]
with t = `site_turn`, counterclockwise in the image, the same of all pixels.
Fingerprint
    all angles of polarization are off by t, their degree stays. Where nothing says at which angle the light is
    polarized, it is a common turn of everything before the camera, and shows not at all.
Validity
    rigid: all pixels alike. A camera that is rolled turns the view as well (`roll`).
References
    Goldstein, Polarized Light, 3rd ed., 5.3 (rotation of axes).
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def turn(weights, camera):
    double = 2 * np.pi / 180 * camera.site_turn
    c, s = np.cos(double), np.sin(double)
    w, q, u = weights[..., 0], weights[..., 1], weights[..., 2]
    return np.stack([w, q * c - u * s, q * s + u * c], -1)


def check_turned_analysers():
    """Ideal analysers at 0, 45 and 100 deg, turned by 10 deg, are those at 10, 55 and 110 deg."""

    def ideal(degrees):
        double = 2 * np.radians(np.array(degrees))
        return np.stack([np.ones(3), np.cos(double), np.sin(double)], -1) / 2

    found = turn(ideal([0.0, 45.0, 100.0]), SimpleNamespace(site_turn=10.0))
    agree(found, ideal([10.0, 55.0, 110.0]), 1e-12, 1e-15)


effect = Effect(
    name="site misalignment",
    part="camera",
    stages={"site": turn},
    parameters=(
        Parameter(
            "site_turn",
            "deg",
            0.0,
            (-90.0, 90.0),
            "t: turn of all analysers of the mosaic, counterclockwise in the image",
            neutral=0.0,
            plausible=0.5,
            how="image",
        ),
    ),
    acts=("site", "analyzer.angle"),
    needs="light whose angle of polarization is known: a polarizer with a dial before the camera",
    checks=(check_turned_analysers,),
)
