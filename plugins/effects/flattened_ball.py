"""Flattened ball: the ball that presses is no ball, but a spheroid, less tall than wide.

Definition
    h(r) = (1 - f) (R - sqrt(R^2 - r^2))
with the height h of the indenter over its lowest point, the radius R as seen from above and the flattening f: all its
slopes are 1 - f times those of a ball. Below 0 it is taller than wide.
Fingerprint
    all slopes in the contact are off by one factor, that of a ball of another radius by one that grows towards the rim;
    the rim stands where the ball's does. A coating's thickness moves the rim outwards.
Validity
    spheroids about the press axis. Solder balls sag on their pads as they melt: .5 mm balls stand 10 to 20 % less tall
    than wide. Polished balls of steel have none (1e-4).
References
    the indenter of S1.2, a sphere.
"""

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect


def check_spheroid():
    """A ball of 1.5 mm that is a tenth less tall: depth - 0.9 (R - sqrt(R^2 - r^2)); with a skirt of 0.3 mm it is the
    same in the contact, and beyond it falls by 1/e over every 0.3 mm."""
    fine = {"press_depth": 0.4, "flattening": 0.1, "smoothing": 1e-3, "map_pitch": 0.01, "extent": 2.5}
    r = np.array([0.0, 0.3, 0.6])
    ball = -0.4 + 0.9 * (1.5 - np.sqrt(1.5**2 - r**2))
    agree(made("gel", **fine, bsdf={"type": "membrane"}).heights(r, [0.0])[0], ball, 0, 2e-4)  # pitch^2/R of the blur
    dragged = made("gel", **fine, skirt=0.3, bsdf={"type": "membrane"})
    agree(dragged.heights(r, [0.0])[0], ball, 0, 2e-4)
    beyond = -dragged.heights([1.2, 1.5], [0.0])[0]
    agree(beyond[1] / beyond[0], np.exp(-1), 2e-3)


effect = Effect(
    name="flattened ball",
    part="gel",
    parameters=("flattening",),
    acts=("slope", "contact_distance"),
    needs="presses of one or more balls, seen with the rim of the contact",
    checks=(check_spheroid,),
)
