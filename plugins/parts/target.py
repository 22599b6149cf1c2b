"""Target: a solid cylinder in front of the sensor, for what the camera sees through the skin.

Definition
    stance lying      axis along x at z = distance + diameter/2, from x - length/2 to x + length/2
    stance standing   axis along z at (x, y), flat end towards the sensor, from z = distance to z = distance + length
The nearest point stands `distance` before the untouched face at z = 0; a negative distance is that of an object that presses it.
Fingerprint
    its picture shrinks with the distance, as 1/(distance + camera's distance from the face).
Validity
    it does not press the skin: the gel's own press does. The circle is a polygon of 256 sides, inside it by 8e-5 of the radius.
References
    Vi2TaP (RA-L 2025), Fig. 5: cylinders of 20, 30 and 40 mm diameter, 60 to 10 mm before the skin.
"""

from optics.effect import Declared, Part
from optics.parameter import Parameter

PARAMETERS = (
    Parameter("diameter", "mm", 20.0, (0.1, 1000.0), "of the cylinder", plausible=0.1, how="difference", step=1.0),
    Parameter("length", "mm", 80.0, (0.1, 2000.0), "along its axis", plausible=0.2, how="difference", step=1.0),
    Parameter("distance", "mm", 20.0, (-5.0, 2000.0), "from the untouched face to its nearest point", plausible=0.2,
              how="difference", step=1.0),
    Parameter("x", "mm", 0.0, (-1000.0, 1000.0), "its middle, right", plausible=0.2, how="difference", step=1.0),
    Parameter("y", "mm", 0.0, (-1000.0, 1000.0), "its middle, down", plausible=0.2, how="difference", step=1.0),
    Parameter("stance", "-", "lying", choices=("lying", "standing"), doc="lying across the view along x, or standing on end"),
)
SEGMENTS = 256


def build():
    import mitsuba as mi
    import numpy as np

    class Target(Declared.on_mesh()):
        kind = "target"

        def __init__(self, props):
            i = np.arange(SEGMENTS)
            j = (i + 1) % SEGMENTS
            low, high, first, last = (i + k * SEGMENTS for k in range(4))  # two rings of the mantle, two of the ends
            near, far = (np.full_like(i, 4 * SEGMENTS + k) for k in range(2))  # middles of the ends
            faces = np.concatenate([np.stack(corners, -1) for corners in (
                (low, low[j], high[j]), (low, high[j], high), (near, first[j], first), (far, last, last[j]))])
            mi.Mesh.__init__(self, "target", 4 * SEGMENTS + 2, len(faces), props, True, False)
            self.declare(props)
            angle = 2 * np.pi / SEGMENTS * i
            self.circle = np.stack([np.cos(angle), np.sin(angle)], -1)
            params = mi.traverse(self)
            params["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
            self.rebuild(params)

        def rebuild(self, params):
            """Vertices for the present parameters."""
            n = self.number
            radius, length = n("diameter") / 2, n("length")
            if self.stance == "lying":  # rows: directions of the circle and of the axis; a corner lies nearest to the face
                across, axis = np.array([(0.0, 0.0, -1.0), (0.0, 1.0, 0.0)]), np.array([1.0, 0.0, 0.0])
                start = np.array([n("x") - length / 2, n("y"), n("distance") + radius])
            else:
                across, axis = np.array([(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]), np.array([0.0, 0.0, 1.0])
                start = np.array([n("x"), n("y"), n("distance")])
            ring, end = start + radius * self.circle @ across, length * axis
            vertices = np.concatenate([ring, ring + end, ring, ring + end, [start, start + end]])
            params["vertex_positions"] = mi.Float(vertices.astype(np.float32).ravel())
            params.update()

        def to_string(self):
            return f"Target[{self.name}]"

    return Target


part = Part("target", "shape", PARAMETERS, build)
