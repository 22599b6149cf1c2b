"""Eccentric dial: the scale of a dial is centred beside the axis about which the film turns.

Definition
    axis = scale psi + offset + e_c cos(psi) + e_s sin(psi)      psi: what the dial says; each dial has its own pair
with e_c = `eccentric_c`, e_s = `eccentric_s`, deg. A scale of the radius r whose middle lies d off the axis misreads
by up to d/r: 0.1 mm on 15 mm are 0.38 deg, so that 0.4 deg is plausible.
Fingerprint
    the flanks of Malus' curve shift one way and, half a turn on, the other, and nothing happens where the curve is
    flat: the first and the second half turn differ, as with a wobble, which acts where the curve is bright. Over less
    than half a turn it looks like a scale and an offset.
Validity
    first harmonic: d much smaller than r, one mark of reading. Two marks that face each other are read without it.
References
    Chauvenet, A Manual of Spherical and Practical Astronomy, vol. II (eccentricity of graduated circles).
"""

import numpy as np

from optics.scene.checking import agree, mueller, transmission_axis
from optics.scene.declare import Effect


def check_circle():
    """The angle of a mark on a circle of 15 mm about a point 0.1 mm beside the axis, to the second order, (d/r)^2/2 =
    0.0013 deg."""
    d, r = 0.1, 15.0
    for psi in (0.0, 50.0, 130.0, 215.0, 300.0):
        mark = r * np.exp(1j * np.radians(psi)) + d * np.exp(1j * np.radians(25.0))  # the scale's middle is at 25 deg
        true = np.degrees(np.angle(mark))
        e = np.degrees(d / r)
        c, s = e * np.sin(np.radians(25.0)), -e * np.cos(np.radians(25.0))
        found = transmission_axis(mueller("polarizer_film", angle=psi, eccentric_c=c, eccentric_s=s))
        agree((found - true + 90) % 180 - 90, [0.0], 0, 0.0013)


def check_opposite_marks():
    """The mean of two readings half a turn apart is free of it, their difference is twice the error."""
    axes = [transmission_axis(mueller("polarizer_film", angle=a, eccentric_c=0.3, eccentric_s=0.4)) for a in (40, 220)]
    c, s = np.cos(np.radians(40.0)), np.sin(np.radians(40.0))
    agree(np.mean(axes), 40.0)
    agree((axes[0] - axes[1]) / 2, [0.3 * c + 0.4 * s], 1e-10)  # 1e-14 of 40 deg, of a difference of 0.5


def random(rng):
    """An error of up to 2 degrees with its largest anywhere."""
    size, place = rng.uniform(0, 2), rng.uniform(0, 2 * np.pi)
    return {"eccentric_c": size * np.cos(place), "eccentric_s": size * np.sin(place)}


effect = Effect(
    name="eccentric dial",
    part="polarizer_film",
    parameters=("eccentric_c", "eccentric_s"),
    per="part",
    acts=("analyzer.angle",),
    needs="a whole turn of the analyser",
    onset="both",  # of films that stand only where the light turns, the slope is 0
    checks=(check_circle, check_opposite_marks),
    random=random,
)
