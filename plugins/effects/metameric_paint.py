"""Metameric paint: a paint whose reflectance changes within the bands of red, green and blue.

Definition
    f' = f exp(m (lambda - lambda_c)/100)                        m = `metamerism`
with the facets' reflection f of the membrane and the middle lambda_c of the band that a wavelength belongs to: 620 nm
from 580 nm on, 540 nm from 500 nm on, 460 nm below. rho_r, rho_g and rho_b are reflectances at these three wavelengths.
Pigments that look alike under one light, which rho describes, differ between them: under another light they do not
match.
Fingerprint
    a channel changes by the place of the light's spectrum in its band: lights of one colour, but not of one wavelength,
    change against each other, and white ones against coloured ones. In bands that stand at 620, 540 and 460 nm nothing
    changes. With one light in each band it is nearly a gain of that light, which its power and rho take up but for the
    flanks of its line; two lights in one band, 30 nm apart and of known powers, tell it apart.
Validity
    one slope in all bands; light of lamps, not what `ambient` adds. Without bands as integrals (`bands` auto) it is
    read at the bands' wavelengths. A measured paint is given by the membrane's `reflectance`.
References
    Wyszecki & Stiles, Color Science, 2nd ed., 3.8 (metamerism); CIE 15:2018, 9.2.
"""

from types import SimpleNamespace

import numpy as np

from optics.polarization.mueller import exp
from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.line import EDGES
from optics.scene.parameter import Parameter

MIDDLES = (620.0, 540.0, 460.0)  # nm, of the bands from EDGES[0] on, from EDGES[1] on, and below


def tilt(geometry, membrane):
    nm = membrane.nm(geometry.si.wavelengths)
    middle = membrane.in_range(*MIDDLES, nm)
    return geometry.facets * (exp(membrane.metamerism * (nm - middle) / 100) - 1)


def check_match():
    """At the middles of the bands nothing changes; at 640 nm, and at 480 nm, by exp(0.2 m); below the edge at 500 nm
    the middle is another."""

    def in_range(first, second, third, nm):
        return np.where(nm >= EDGES[0], first, np.where(nm >= EDGES[1], second, third))

    membrane = SimpleNamespace(metamerism=0.5, nm=lambda wavelengths: wavelengths, in_range=in_range)
    nm = np.array([620.0, 540.0, 460.0, 640.0, 480.0, 500.0, 499.0])
    found = tilt(SimpleNamespace(si=SimpleNamespace(wavelengths=nm), facets=0.2), membrane)
    steps = np.array([0.0, 0.0, 0.0, 0.2, 0.2, -0.4, 0.39])
    agree(0.2 + found, 0.2 * np.exp(0.5 * steps), 1e-12)


effect = Effect(
    name="metameric paint",
    part="membrane",
    stages={"reflection": tilt},
    parameters=(
        Parameter(
            "metamerism", "1", 0.0, (-5.0, 5.0), "change m of ln(rho) per 100 nm within a band", neutral=0.0,
            plausible=0.2,
        ),
    ),
    acts=("channel", "led"),
    needs="two lights of different wavelengths in one band, their powers known, or two paints",
    checks=(check_match,),
)  # fmt: skip
