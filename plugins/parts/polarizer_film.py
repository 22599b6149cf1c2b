"""Polarizer film: a dichroic sheet with two principal transmittances, on a dial.

Definition
    M = diattenuator(t(angle), T1, T2) (1 + w_c cos(psi) + w_s sin(psi))
    angle = scale psi + offset + approach backlash / 2 + e_c cos(psi) + e_s sin(psi)
                                                                 psi: what the dial says, `angle`
    T1 = transmittance exp(transmittance_slope (lambda - 540)/100)   along the transmission axis t
    T2 = leak + leak_tilt (lambda - 540)/100 + leak_oblique sin(theta)^2       across it, not below 0
with t across the ray and across the absorbing molecules, t = k x a: two crossed sheets that are dark on the axis leak
away from it, in a cross of dark arms. A sheet of the polarization ratio P lets T2 = T1 (1 - P)/(1 + P) through: 99 % is
0.005 T1. The angle counts from the surface's x axis (the first edge of a rectangle) to its y axis: counterclockwise for
a viewer at whom the surface's normal points. T1 and T2 are those of the whole sheet. With `face` > 0 both its faces
reflect that share, and light that goes to and fro between them and the faces of other films is summed.
Fingerprint
    two of them follow Malus, cos^2 of the angle between; a leak lifts the dark end, an offset shifts the curve, a
    wobble returns once per turn (Malus twice), an eccentric dial shifts the curve one way and, half a turn on, the
    other, a backlash splits the curves turned one way and the other.
Validity
    thin sheets, no refraction in them; reflections between films as at normal incidence. At T2 = 0 the leak of a film
    that polarized light reaches (the middle one of three, one behind a tilted face) starts as a square root, whose
    slope is left out.
References
    Vi2TaP (RA-L 2025), eq. (1); Korger et al., Opt. Express 21, 27032 (2013), oblique incidence; Goldstein, Polarized
    Light, 3rd ed., 5.2.
"""

import math

from optics.polarization.mueller import absorber, cos, diattenuator, exp, real, sin, where
from optics.scene.checking import agree, mueller
from optics.scene.layer import layer
from optics.scene.parameter import Parameter

PARAMETERS = (
    Parameter(
        "inserted",
        "1",
        1.0,
        (0.0, 1.0),
        "1: the film stands in the light; 0: it was taken out",
        how="layer",
        role="inserted",
        plausible=0.1,
    ),
    Parameter(
        "angle",
        "deg",
        0.0,
        (-7200.0, 7200.0),
        "dial angle psi of the transmission axis",
        role="angle",
        plausible=1.0,
        how="layer",
    ),
    Parameter(
        "transmittance",
        "1",
        0.8,
        (0.0, 1.0),
        "transmittance T1 along the axis",
        plausible=0.05,
        multiplies=True,
        how="layer",
    ),
    Parameter(
        "transmittance_slope",
        "1",
        0.0,
        (-2.0, 2.0),
        "change of ln T1 per 100 nm",
        neutral=0.0,
        plausible=0.05,
        how="layer",
    ),
    Parameter(
        "leak",
        "1",
        0.0,
        (0.0, 1.0),
        "transmittance T2 across the axis at 540 nm",
        neutral=0.0,
        plausible=0.005,
        how="layer",
    ),
    Parameter("leak_tilt", "1", 0.0, (-0.2, 0.2), "change of T2 per 100 nm", neutral=0.0, plausible=0.005, how="layer"),
    Parameter(
        "leak_oblique",
        "1",
        0.0,
        (0.0, 0.5),
        "leak that grows with sin(theta)^2 of the incidence",
        neutral=0.0,
        plausible=0.01,
        how="layer",
    ),
    Parameter(
        "offset",
        "deg",
        0.0,
        (-180.0, 180.0),
        "misalignment: axis at dial 0",
        neutral=0.0,
        plausible=1.0,
        starts=(-45.0, 45.0, 90.0),
        period=180.0,
        how="layer",
    ),
    Parameter(
        "scale",
        "1",
        1.0,
        (0.5, 2.0),
        "axis turns this much per turn of the dial",
        neutral=1.0,
        plausible=0.01,
        through="angle",
        how="layer",
    ),
    Parameter(
        "approach",
        "1",
        0.0,
        (-1.0, 1.0),
        "side from which the dial came: +1 from below, -1 from above, 0 unknown",
        role="approach",
        plausible=1.0,
        how="layer",
    ),
    Parameter(
        "backlash",
        "deg",
        0.0,
        (-20.0, 20.0),
        "width of the dead zone of the drive",
        neutral=0.0,
        plausible=0.5,
        through="approach",
        how="layer",
    ),
    Parameter(
        "eccentric_c",
        "deg",
        0.0,
        (-20.0, 20.0),
        "error of the dial once per turn, cosine part e_c",
        neutral=0.0,
        plausible=0.4,
        through="angle",
        how="layer",
    ),
    Parameter(
        "eccentric_s",
        "deg",
        0.0,
        (-20.0, 20.0),
        "error of the dial once per turn, sine part e_s",
        neutral=0.0,
        plausible=0.4,
        through="angle",
        how="layer",
    ),
    Parameter(
        "wobble_c",
        "1",
        0.0,
        (-0.5, 0.5),
        "change of transmittance once per turn, cosine part w_c",
        neutral=0.0,
        plausible=0.01,
        through="angle",
        how="layer",
    ),
    Parameter(
        "wobble_s",
        "1",
        0.0,
        (-0.5, 0.5),
        "change of transmittance once per turn, sine part w_s",
        neutral=0.0,
        plausible=0.01,
        through="angle",
        how="layer",
    ),
    Parameter(
        "face",
        "1",
        0.0,
        (0.0, 0.1),
        "reflectance r of each face, T1 <= (1 - r)^2; 0: reflections are left out",
        neutral=0.0,
        role="face",
        plausible=0.04,
        how="layer",
    ),
)


def polarize(crossing, film):
    dial = film.angle * (math.pi / 180)
    shifted = film.eccentric_c * cos(dial) + film.eccentric_s * sin(dial)
    q, u = crossing.polarizer_axis(film.scale * film.angle + film.offset + film.approach * film.backlash / 2 + shifted)
    steps = (crossing.wavelengths - 540.0) / 100
    t1 = film.transmittance * exp(film.transmittance_slope * steps)
    t2 = film.leak + film.leak_tilt * steps + film.leak_oblique * (1 - crossing.cos * crossing.cos)
    t2 = where(real(t2) < 0, 0.0 * t2, t2)
    film_matrix = diattenuator(q, u, t1, t2) * (1 + film.wobble_c * cos(dial) + film.wobble_s * sin(dial))
    return film_matrix * film.inserted + absorber(1 - film.inserted)


def check_malus():
    """cos(d)^2/2 of unpolarized light behind two ideal films; a film that was taken out does nothing."""
    first = mueller("polarizer_film", transmittance=1.0, angle=20.0)
    for angle in (20.0, 65.0, 80.0, 110.0):
        pair = mueller("polarizer_film", transmittance=1.0, angle=angle) @ first
        agree(pair[0, 0, 0], math.cos(math.radians(angle - 20)) ** 2 / 2, 1e-12, 1e-15)
    agree(mueller("polarizer_film", inserted=0.0)[0], [[float(i == j) for j in range(4)] for i in range(4)])


def random(rng):
    """A sheet polarizer at any angle, with a leak of up to 5 %."""
    return {"angle": rng.uniform(0, 180), "transmittance": rng.uniform(0.6, 0.9), "leak": rng.uniform(1e-4, 0.05)}


part = layer("polarizer_film", PARAMETERS, polarize, polarizes=True, checks=(check_malus,), random=random)
