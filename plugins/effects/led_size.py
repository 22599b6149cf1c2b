"""LED size: the source is a disc and not a point.

Definition
    L' = mean of L over a disc of area A across the LED's axis, with the shadows of each of its points
16 points on two circles, with the mean square radius of the disc; the strength is the area, as the smooth part of the
effect grows with the radius squared.
Fingerprint
    shadow rims widen with the distance between the edge and the face it shades; far from rims almost nothing. Lens blur
    softens all contours alike.
Validity
    the penumbra of a finite source is not analytic at A = 0, so the ranking takes a finite step; 16 points show as
    steps in a penumbra wider than about 4 px.
References
    F-TAC Hand supplementary information, S1.3 (LEDs taken as points there).
"""

from optics.scene.declare import Effect

effect = Effect(
    name="LED size",
    part="led",
    parameters=("area",),
    onset="secant",
    acts=("rim", "led"),
    needs="cast shadows: deep presses, LEDs at low elevation",
)
