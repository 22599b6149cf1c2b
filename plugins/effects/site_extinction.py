"""Site extinction: the analysers on the pixels of a polarization camera let some light across their axes.

Definition
    I = 1/2 [(1 + e) S0 + (1 - e) (S1 cos 2a + S2 sin 2a)]
of a pixel whose analyser stands at the angle a, with e = T2/T1 = `site_extinction`, the reciprocal of the extinction
ratio; the transmittance T1 along the axis is part of the exposure. Light that crosses to the pixel beside looks alike.
Fingerprint
    the modulation from site to site shrinks by (1 - e)/(1 + e), the mean stays: all light looks less polarized. Of a
    source whose degree of polarization is unknown it shows not at all; light of a good polarizer tells it.
Validity
    the same in all pixels and bands. Wire grids on pixels have extinction ratios of 50 to 500, lower at short waves and
    at steep incidence.
References
    Goldstein, Polarized Light, 3rd ed., 5.2 and 26.2; Lane, Rode & Roesgen, Appl. Opt. 61, C161 (2022), calibration of
    a camera with a mosaic of wire grids.
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def leak(weights, camera):
    e = camera.site_extinction
    return weights * np.stack([1 + e, 1 - e, 1 - e])


def check_malus_with_a_floor():
    """Light of intensity 1 polarized at 30 deg, behind analysers at 30, 75 and 120 deg: 1, (1 + e)/2 and e."""
    angle = np.radians([30.0, 75.0, 120.0])
    ideal = np.stack([np.ones(3), np.cos(2 * angle), np.sin(2 * angle)], -1) / 2
    light = np.array([1.0, np.cos(np.radians(60)), np.sin(np.radians(60))])
    agree(leak(ideal, SimpleNamespace(site_extinction=0.02)) @ light, [1.0, 0.51, 0.02])


def random(rng):
    """Extinction ratios from 1000 to 20, evenly in the logarithm."""
    return {"site_extinction": 10 ** rng.uniform(-3, -1.3)}


effect = Effect(
    name="site extinction",
    part="camera",
    stages={"site": leak},
    parameters=(
        Parameter(
            "site_extinction",
            "1",
            0.0,
            (0.0, 1.0),
            "e: transmittance of a pixel's analyser across its axis over that along it",
            neutral=0.0,
            plausible=0.01,
            how="image",
        ),
    ),
    acts=("site", "analyzer.angle"),
    needs="light of a known, high degree of polarization: a good polarizer before the camera",
    checks=(check_malus_with_a_floor,),
    random=random,
)
