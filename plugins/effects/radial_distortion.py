"""Radial distortion: the lens bends the image towards or away from its middle.

Definition
    x_d = x (1 + k1 r^2)                                         Brown-Conrady, OpenCV's sign
in normalised coordinates. The strength is k1 of the camera; rays are bent, the image is not warped afterwards.
Fingerprint
    shifts contours outwards or inwards with the third power of the radius; visible only where the image has contours.
    Errors of the press positions absorb most of it when a position is fitted for each press.
Validity
    |k1| r^2 < 0.1; wide angles need k2, k3 (parameters of the camera as well).
References
    Brown, Photogrammetric Engineering 32, 444 (1966).
"""

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect


def check_cubic():
    """The pixel at f x (1 + k1 x^2) sees the direction x, for both signs of k1; f = 100 px."""
    import mitsuba as mi

    for k1 in (-0.1, 0.1):
        film = {"type": "hdrfilm", "width": 200, "height": 100}
        camera = made("camera", film=film, fx=100.0, fy=100.0, cx=100.0, cy=50.0, k1=k1)
        x = np.array([-0.9, -0.3, 0.0, 0.5])
        u = 100 + 100 * x * (1 + k1 * x**2)
        _, d = camera.ray(mi.Float(u.astype("f")), mi.Float(np.full(4, 50.0, "f")))
        # ten steps of the fixed point at |k1| r^2 = 0.08 leave 1e-6 or less
        agree(np.array(d.x) / np.array(d.z), x, 0, 1e-5)


effect = Effect(
    name="radial distortion",
    part="camera",
    parameters=("k1",),
    acts=("radius", "gradient"),
    needs="presses all over the field with known positions",
    checks=(check_cubic,),
)
