"""LED size: the source is a disc rather than a point.

Definition
    L' = mean of L over a disc of area A across the LED's axis, with the shadows of each of its points
The mean is taken over 25 points that have the mean square radius of the disc. The strength is the area, since the
smooth part of the effect grows with the radius squared.
Fingerprint
    shadow rims widen with the distance between the edge and the face it shades; far from rims almost nothing changes.
    Lens blur softens all contours alike.
Validity
    the penumbra of a finite source is not analytic at A = 0, so the ranking takes a finite step; the points, five
    across the disc, show as steps in a penumbra of more pixels than that.
References
    F-TAC Hand supplementary information, S1.3 (LEDs taken as points there).
"""

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect


def check_disc():
    """Points of the source lie across the axis, and their mean square distance from its middle is r^2/2 = A/(2 pi)."""
    import mitsuba as mi

    led = made("led", position=[4.0, 1.0, -5.0], target=[0.0, 0.5, 0.0], area=3.0)
    u = (np.arange(64) + 0.5) / 64
    grid = np.array([a.ravel() for a in np.meshgrid(u, u)], np.float32)
    offset = np.array(led.point(mi.Point2f(*grid)) - led.position()).T
    assert np.abs(offset @ np.array(led.axis()).ravel()).max() < 1e-5
    agree((offset**2).sum(1).mean(), 3.0 / (2 * np.pi), 2e-3)  # 64 x 64 midpoints leave 1e-3 of it


effect = Effect(
    name="LED size",
    part="led",
    parameters=("area",),
    onset="secant",
    acts=("rim", "led"),
    needs="cast shadows: deep presses, LEDs at low elevation",
    checks=(check_disc,),
)
