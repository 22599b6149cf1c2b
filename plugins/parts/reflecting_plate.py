"""Reflecting plate: a face of glass or plastic that reflects the beam of a bench, at an angle that is set by a dial.

Definition
    M = (1 - scatter) [F(theta, n) + back_face B(theta, n)] + scatter diag(1, 0, 0, 0)
    theta = incidence + incidence_offset,   n = index + index_slope (lambda - 540)/100, not below 1
    F = 1/2 [[R_s + R_p, R_s - R_p, 0, 0], [R_s - R_p, R_s + R_p, 0, 0], [0, 0, 2 r_s r_p, 0], [0, 0, 0, 2 r_s r_p]]
    r_s = (cos theta - n cos theta')/(cos theta + n cos theta')
    r_p = (n cos theta - cos theta')/(n cos theta + cos theta')
with sin theta = n sin theta', R = r^2, and B the same of the light that the back face of a plane-parallel plate
returns, all orders of it without interference: R_j (1 - R_j)^2/(1 - R_j^2) in place of R_j, and r_s r_p (1 - R_s)(1 -
R_p)/(1 - R_s R_p) in place of r_s r_p. `scatter` is what a rough or dusty face sends on without polarization.
The beam is unfolded: it goes on along the bench's axis, and Stokes vectors refer, before and behind the plate, to the
axes of an observer whom the light reaches, x to the right and y up. F stands in the axes (s, p), s along the angle
`plane` + 90 deg: with plane = 0 the plane of incidence is level. As in any mirror right and left are exchanged: light
at 45 deg leaves at 135 deg at normal incidence.
Fingerprint
    reflects s more than p, and no p at all at Brewster's angle tan theta = n: there unpolarized light leaves polarized
    across the plane of incidence, S1/S0 = -1.
Validity
    a clear, isotropic, flat plate (no metal, no film of oil), thicker than the coherence length; the beam stays on the
    axis.
References
    Born & Wolf, Principles of Optics, 1.5.2; Goldstein, Polarized Light, 3rd ed., ch. 7.
"""

import math

from optics.polarization.mueller import Mueller, cos, depolarizer, real, rotation, sqrt, where
from optics.scene.checking import agree, mueller, ray
from optics.scene.layer import layer
from optics.scene.parameter import Parameter

PARAMETERS = (
    Parameter(
        "incidence",
        "deg",
        45.0,
        (0.0, 89.0),
        "angle of incidence by the dial",
        plausible=1.0,
        how="layer",
    ),
    Parameter(
        "incidence_offset",
        "deg",
        0.0,
        (-20.0, 0.9),
        "angle of incidence at dial 0",
        neutral=0.0,
        plausible=0.5,
        how="layer",
    ),
    Parameter("index", "1", 1.5, (1.0, 5.0), "refractive index n at 540 nm", plausible=0.02, how="layer", free="all"),
    Parameter(
        "index_slope",
        "1",
        0.0,
        (-0.2, 0.2),
        "change of n per 100 nm",
        neutral=0.0,
        plausible=0.005,
        how="layer",
    ),
    Parameter("plane", "deg", 0.0, (-180.0, 180.0), "angle of the plane of incidence", plausible=0.5, how="layer"),
    Parameter(
        "back_face",
        "1",
        0.0,
        (0.0, 1.0),
        "share of the light from the back face that reaches the detector",
        neutral=0.0,
        plausible=0.1,
        how="layer",
    ),
    Parameter(
        "scatter",
        "1",
        0.0,
        (0.0, 1.0),
        "share of the light that the face sends on without polarization",
        neutral=0.0,
        plausible=1e-3,
        how="layer",
    ),
)


def reflect(crossing, plate):
    cos1 = cos((math.pi / 180) * (plate.incidence + plate.incidence_offset))
    n = plate.index + plate.index_slope * (crossing.wavelengths - 540.0) / 100
    n = where(real(n) < 1, 1.0 + 0.0 * n, n)
    cos2 = sqrt(1 - (1 - cos1 * cos1) / (n * n))
    s, p = (cos1 - n * cos2) / (cos1 + n * cos2), (n * cos1 - cos2) / (n * cos1 + cos2)
    r_s, r_p, both = s * s, p * p, s * p
    back_s, back_p = (r * (1 - r) * (1 - r) / (1 - r * r) for r in (r_s, r_p))
    back = both * (1 - r_s) * (1 - r_p) / (1 - r_s * r_p)
    level_s, level_p, mixed = (a + plate.back_face * b for a, b in ((r_s, back_s), (r_p, back_p), (both, back)))
    mean, half = (level_s + level_p) / 2, (level_s - level_p) / 2
    face = Mueller([[mean, half, 0, 0], [half, mean, 0, 0], [0, 0, mixed, 0], [0, 0, 0, mixed]])
    q, u = crossing.axis(plate.plane + 90.0)
    matrix = rotation(q, -u) @ face @ rotation(q, u)
    return matrix * (1 - plate.scatter) + depolarizer(0 * q) * plate.scatter


def check_brewster():
    """At tan theta = n unpolarized light leaves with S1/S0 = -1, of the power ((n^2 - 1)/(n^2 + 1))^2/2; in a plane of
    incidence at 30 deg with the polarization at 120 deg."""
    n = 1.5
    theta = math.degrees(math.atan(n))
    power = ((n * n - 1) / (n * n + 1)) ** 2 / 2
    agree(mueller("reflecting_plate", index=n, incidence=theta)[0][:, 0], [power, -power, 0, 0], 1e-12, 1e-15)
    c, s = math.cos(math.radians(240)), math.sin(math.radians(240))
    turned = mueller("reflecting_plate", index=n, incidence=theta, plane=30.0)[0][:, 0]
    agree(turned, [power, power * c, power * s, 0], 1e-12, 1e-15)


def check_normal_incidence():
    """R = ((n - 1)/(n + 1))^2 of every polarization, a mirror's axes: S2 and S3 change their sign; with the back face 2
    R/(1 + R)."""
    share = (0.5 / 2.5) ** 2
    mirror = [[share, 0, 0, 0], [0, share, 0, 0], [0, 0, -share, 0], [0, 0, 0, -share]]
    agree(mueller("reflecting_plate", incidence=0.0)[0], mirror, 1e-12, 1e-15)
    whole = mueller("reflecting_plate", incidence=0.0, back_face=1.0)[0]
    agree([whole[0, 0], whole[1, 1], whole[3, 3]], [2 * share / (1 + share)] * 2 + [-2 * share / (1 + share)])


def check_dispersion():
    """R of n = 1.5 and 1.6 at normal incidence, in bands of 540 and 440 nm."""
    found = mueller("reflecting_plate", ray(wavelengths=(540.0, 440.0)), incidence=0.0, index_slope=-0.1)[:, 0, 0]
    agree(found, [(0.5 / 2.5) ** 2, (0.6 / 2.6) ** 2])


def check_scattering():
    """Of light polarized in the plane of incidence, at Brewster's angle the scattered share alone is left."""
    left = mueller("reflecting_plate", incidence=math.degrees(math.atan(1.5)), scatter=0.01)[0] @ [1, 1, 0, 0]
    agree(left, [0.01, 0, 0, 0], 1e-12, 1e-15)


def random(rng):
    """Glass or plastic at any angle but grazing."""
    return {"incidence": rng.uniform(5, 80), "index": rng.uniform(1.3, 2.0), "scatter": rng.uniform(0, 0.01)}


part = layer(
    "reflecting_plate",
    PARAMETERS,
    reflect,
    polarizes=True,
    checks=(check_brewster, check_normal_incidence, check_dispersion, check_scattering),
    random=random,
)
