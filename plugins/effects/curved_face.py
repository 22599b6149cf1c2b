"""Curved face: at rest the coated face is not level but stands out in its middle, or bends as a saddle.

Definition
    z0(x, y) = (c_xx x^2 + 2 c_xy x y + c_yy y^2)/2,    the face at rest; an indenter meets it as it is
A contact has the indenter's shape whatever lay there before. A multiplicative flat field shows the curved face, and a
contact is therefore brighter than over a level one by
    g = 1/(1 + (l_x s_x + l_y s_y)/l_z) - 1,    s = (c_xx x + c_xy y, c_xy x + c_yy y)
with the way (l_x, l_y) to the lamp along the face, its height l_z over the face, and the slope s of the face at rest.
Fingerprint
    in every contact the ratio to the flat field grows towards the side that the LED is on, linearly over the field and
    under each LED in its own direction: the gradients are one symmetric matrix times the LED's direction. Contacts near
    the field's rim are smaller (a face that stands out), all around.
Validity
    curves that are wide against the contact. The skin between the balls of a plate keeps the share 1 - `evened`.
    A gel that is tilted as a whole is a gel wedge; LEDs that stand elsewhere change light and flat field alike.
References
    do Carmo, Differential Geometry of Curves and Surfaces (1976), 3.3 (second fundamental form of a graph); the neglect
    of F-TAC Hand S1.1: a uniform elastomer thickness.
"""

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect


def check_contact_keeps_its_shape():
    """A face that stands out by 0.1 mm over 5 mm, c = -8e-3/mm, is z0 where nothing touches it, and under a ball at x =
    3 mm, where z0 = -0.036 mm, the ball: its lowest point is press_depth below, and its contact leans to no side."""
    curved = {"curve_xx": -8e-3, "curve_xy": 2e-3, "smoothing": 1e-3, "map_pitch": 0.01, "bsdf": {"type": "membrane"}}
    rest = made("gel", **curved).heights([-5.0, 0.0, 5.0], [2.0])[0]
    agree(rest, [-0.1 - 0.02, 0.0, -0.1 + 0.02], 0, 1e-6)
    r = np.array([-0.6, -0.3, 0.0, 0.3, 0.6])
    pressed = made("gel", press_x=3.0, press_depth=0.5, extent=1.8, **curved)
    agree(pressed.heights(3.0 + r, [0.0])[0], -0.036 - (0.5 - 1.5 + np.sqrt(1.5**2 - r**2)), 0, 1e-4)  # blur of sd^2/R


def check_plate_of_balls():
    """Balls of a plate are balls over a curved face too, with a skirt and without, as deep as the plate says: below the
    mean of z0, (c_xx 20^2 + c_yy 16^2)/24 = -0.0907 mm. A blur of sd^2/R = 2e-4 mm lowers them all."""
    face = {"curve_xx": -8e-3, "curve_yy": 4e-3, "evened": 0.25, "map_pitch": 0.01, "extent": 2.5}
    plate = {"indenter": "balls", "indenter_size": 0.5, "indenter_spacing": 1.5, "smoothing": 1e-3}
    r = np.array([-0.2, -0.1, 0.0, 0.1, 0.2])
    for skirt in (0.0, 0.05):
        gel = made("gel", press_depth=0.2, skirt=skirt, **face, **plate, bsdf={"type": "membrane"})
        for middle in (0.0, 1.5):
            agree(gel.heights(middle + r, [0.0])[0], -0.0906667 - (0.2 - 0.5 + np.sqrt(0.25 - r**2)), 0, 2.5e-4)


effect = Effect(
    name="curved face",
    part="gel",
    parameters=("curve_xx", "curve_xy", "curve_yy"),
    onset="tangent",
    acts=("row", "column", "led"),
    needs="contacts all over the field, lit from different sides, one LED each",
    checks=(check_contact_keeps_its_shape, check_plate_of_balls),
)
