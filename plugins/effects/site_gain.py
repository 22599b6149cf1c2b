"""Site gain: pixels behind analysers of different angles differ in gain.

Definition
    I' = g(a) I,   g(a) = 1 + g_q cos 2a + g_u sin 2a + g_d cos 4a
of a pixel whose analyser stands at the angle a. Of sites at 0, 45, 90 and 135 deg any four gains of the mean 1 can be
written so: g_0 = 1 + g_q + g_d, g_45 = 1 + g_u - g_d, g_90 = 1 - g_q + g_d, g_135 = 1 - g_u - g_d. The mean is the
camera's exposure.
Fingerprint
    a pattern that repeats with the mosaic's cell, in proportion to the signal, however the light is polarized. Of one
    evenly polarized source g_q and g_u look like S1 and S2 of its own; light of other polarizations tells them apart,
    g_d at once.
Validity
    the same all over the sensor. Gains of single pixels are the fixed pattern of [noise] prnu, or a flat field.
References
    Powell & Gruev, Opt. Express 21, 21039 (2013), calibration of division-of-focal-plane polarimeters.
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def scale(weights, camera):
    double = 2 * camera.site
    gain = (
        1
        + camera.site_gain_q * np.cos(double)
        + camera.site_gain_u * np.sin(double)
        + camera.site_gain_d * np.cos(2 * double)
    )
    return weights * gain[..., None]


def check_four_gains():
    """0.99, 1.03, 0.96 and 1.02 at 0, 45, 90 and 135 deg, whatever the light."""
    camera = SimpleNamespace(
        site=np.radians([0.0, 45.0, 90.0, 135.0]), site_gain_q=0.015, site_gain_u=0.005, site_gain_d=-0.025
    )
    agree(scale(np.ones((4, 3)), camera), np.array([0.99, 1.03, 0.96, 1.02])[:, None] * np.ones(3))


MEANING = {
    "q": "gain of sites at 0 deg over that of sites at 90 deg: half of the difference",
    "u": "gain of sites at 45 deg over that of sites at 135 deg: half of the difference",
    "d": "gain of sites at 0 and 90 deg over that of sites at 45 and 135 deg: half of the difference of their means",
}
effect = Effect(
    name="site gain",
    part="camera",
    stages={"site": scale},
    parameters=tuple(
        Parameter(f"site_gain_{k}", "1", 0.0, (-0.5, 0.5), doc, neutral=0.0, plausible=0.01, how="image")
        for k, doc in MEANING.items()
    ),
    acts=("site", "intensity"),
    needs="light of several polarizations: a polarizer before the camera at two angles, or unpolarized light",
    checks=(check_four_gains,),
)
