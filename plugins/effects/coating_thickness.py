"""Coating thickness: the camera sees the inner face of the coating, a little rounder than what touches its outer face.

Definition
    h'(x) = d + min over |s| <= d of h(x + s) - sqrt(d^2 - s^2),   h' - h = d (1 - sqrt(1 + |grad h|^2)) on smooth parts
with the height h of the indenter over its lowest point and the thickness d (`coat`): the face parallel to the
indenter's. Of a ball of radius R it is a ball of radius R + d that is pressed as deep; flat parts stay as they are.
Fingerprint
    every flank is less steep than the indenter's own and lies further out, in the same way all around and under every
    LED: brighter on the side that faces away, darker on the side that faces the LED, and the rim stands d further out.
    Smoothing of the dent changes its rim alone.
Validity
    a coating that bends without thinning, on an indenter whose size is known; an indenter that is larger than stated
    looks alike. Thin coatings are 5 to 50 um.
References
    Serra, Image Analysis and Mathematical Morphology (1982), II (dilation by a ball); the neglect of S1.2: the
    membrane has no thickness.
"""

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect


def check_parallel_faces():
    """Under a coat of 0.1 mm a ball of 1.5 mm is one of 1.6 mm that is pressed as deep; a cube that is pressed edge
    first at 45 deg has flanks that lie d (sqrt(2) - 1) further down and an edge that is round."""
    fine = {"press_depth": 0.4, "smoothing": 1e-3, "map_pitch": 0.01, "extent": 2.0, "bsdf": {"type": "membrane"}}
    r = np.array([0.0, 0.3, 0.6])
    ball = made("gel", indenter_size=1.5, coat=0.1, **fine).heights(r, [0.0])[0]
    agree(ball, 1.2 - np.sqrt(1.6**2 - r**2), 0, 2e-4)  # pitch^2/R of the last blur
    edge = made("gel", indenter="cube", indenter_size=2.0, press_rx=45.0, coat=0.1, **fine).heights([0.0], r)[:, 0]
    agree(edge[[0, 1]], [-0.4, -0.4 + 0.3 - 0.1 * (np.sqrt(2) - 1)], 0, 2e-3)  # 1 % of d, and blur at the edge


effect = Effect(
    name="coating thickness",
    part="gel",
    parameters=("coat",),
    onset="tangent",
    acts=("slope", "contact_distance"),
    needs="an indenter of known size with steep flanks, seen under light from several sides",
    checks=(check_parallel_faces,),
)
