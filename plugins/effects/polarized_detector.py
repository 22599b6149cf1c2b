"""Polarized detector: a detector records one linear polarization more strongly than the one across it.

Definition
    I = S0 + q S1 + u S2
with q = `detector_q` = p cos(2a), u = `detector_u` = p sin(2a): p the polarization sensitivity, a the angle that is
preferred, counted as the camera's axes are. A photodiode behind an oblique window, a meter whose diffuser is seen
obliquely and a lens with tilted surfaces are such detectors. A glass plate of index 1.5, tilted by 30 degrees, has p =
(T_p - T_s)/(T_p + T_s) = 0.033, both faces and the light between them counted: 0.03 is plausible.
Fingerprint
    turning the last film changes the brightness with two cycles per turn, whatever stands before it: behind two films,
    the bright parts of Malus' curve shift to one side, and the dark stays dark. Behind a film at rest it is a constant
    factor. It looks like a polarized source, which the first film shows: of one film alone, the two are the same to the
    last bit. Everything turned together is a mere choice of the axes.
Validity
    linear polarization; the same in all bands and over the image. Of a camera with analysers on its pixels, the
    sensitivities are those of site gain.
References
    Goldstein, Polarized Light, 3rd ed., ch. 14 (rotating-element polarimeters); Born & Wolf, Principles of Optics,
    1.5.2 (a boundary's transmittances).
"""

import numpy as np

from optics.polarization.mueller import fresnel
from optics.scene.checking import agree, mueller, numbers, stokes
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def weigh(row, camera):
    return row[0], row[1] + row[0] * camera.detector_q, row[2] + row[0] * camera.detector_u, row[3]


def reading(light, q, u):
    """What a detector records of a Stokes vector."""
    return np.dot(weigh((1.0, 0, 0, 0), numbers("camera", detector_q=q, detector_u=u)), light)


def check_analyser():
    """(1 + p cos 2(alpha - a))/2 of unpolarized light behind an ideal film at alpha, for p = 0.1 and a = 25 deg."""
    p, a = 0.1, 25.0
    q, u = p * np.cos(np.radians(2 * a)), p * np.sin(np.radians(2 * a))
    for alpha in (0.0, 25.0, 70.0, 115.0):
        light = mueller("polarizer_film", transmittance=1.0, angle=alpha)[0] @ (1.0, 0.0, 0.0, 0.0)
        agree(reading(light, q, u), (1 + p * np.cos(np.radians(2 * (alpha - a)))) / 2)


def check_twin():
    """Behind one film a polarized source and an even detector read what an even source and a polarized detector do."""
    for alpha in (0.0, 33.0, 120.0):
        film = mueller("polarizer_film", leak=0.02, angle=alpha)[0]
        source = reading(film @ stokes("source", dop_q=0.03, dop_u=-0.02)[0], 0.0, 0.0)
        agree(reading(film @ stokes("source")[0], 0.03, -0.02), source)


def check_oblique_window():
    """A plate of index 1.5 at 30 deg: (1 - R)/(1 + R) of s and of p, R of one face; p = 0.0326."""
    r_s, r_p, _ = fresnel(np.cos(np.radians(30.0)), 1.5)
    t_s, t_p = (1 - r_s) / (1 + r_s), (1 - r_p) / (1 + r_p)
    agree((t_p - t_s) / (t_p + t_s), 0.0326, 0, 1e-4)  # of four figures
    behind = np.array([(t_p + t_s) / 2, (t_p - t_s) / 2])  # light at 0 and at 90 deg behind the plate, 0 along p
    for sign in (1.0, -1.0):
        p = behind[1] / behind[0]
        agree(behind[0] * reading((1.0, sign, 0.0, 0.0), p, 0.0), t_p if sign > 0 else t_s)


def random(rng):
    """A sensitivity of up to 0.1 at any angle."""
    p, double = rng.uniform(0, 0.1), rng.uniform(0, 2 * np.pi)
    return {"detector_q": p * np.cos(double), "detector_u": p * np.sin(double)}


effect = Effect(
    name="polarized detector",
    part="camera",
    stages={"detector": weigh},
    parameters=tuple(
        Parameter(
            f"detector_{name}",
            "1",
            0.0,
            (-1.0, 1.0),
            f"{name}: what the detector records of S{k}, per S0",
            neutral=0.0,
            plausible=0.03,
            how="layer",
        )
        for k, name in ((1, "q"), (2, "u"))
    ),
    requires=("polarizer_film",),
    acts=("analyzer.angle",),
    needs="the film before the detector at three angles or more; with one film, another one behind it or none at all",
    checks=(check_analyser, check_twin, check_oblique_window),
    random=random,
)
