"""Radial distortion: the lens bends the image towards or away from its middle.

Definition
    x_d = x (1 + k1 r^2)                                         Brown-Conrady, OpenCV's sign
in normalised coordinates; the strength is k1 of the camera, traced through the rays and not warped afterwards.
Fingerprint
    shifts contours outwards or inwards with the third power of the radius; visible only where the image has contours.
    Errors of the press positions absorb most of it when they are fitted per press.
Validity
    |k1| r^2 < 0.1; wide angles need k2, k3 (parameters of the camera as well).
References
    Brown, Photogrammetric Engineering 32, 444 (1966).
"""

from optics.scene.declare import Effect

effect = Effect(
    name="radial distortion",
    part="camera",
    parameters=("k1",),
    acts=("radius", "gradient"),
    needs="presses all over the field with known positions",
)
