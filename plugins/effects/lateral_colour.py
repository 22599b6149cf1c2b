"""Lateral colour: the lens images each wavelength at a size of its own.

Definition
    r'(lambda) = r (1 + m (lambda - 540)/100)                    m = `lateral_colour`, per 100 nm
with the distance r of an image point from the optical axis, px. The glass of a lens bends blue light more than red, and
its focal length, which is the scale of the image, changes with the wavelength.
Fingerprint
    contours have coloured rims, red on one side and blue on the other, that grow with the distance from the axis; in
    the middle there are none. Radial distortion moves all colours alike; dispersion of a body acts at the body's edges.
Validity
    a line over the wavelength: an achromat, whose two ends of the visible meet, needs a parabola. The image is
    resampled by cubic splines through halves of pixels, which move details below 2 px by 5 % less than they should. In
    a single band nothing happens, and of one narrow light in several bands next to nothing but a change of the size,
    which is the field of view.
References
    Born & Wolf, Principles of Optics, 4.7 (chromatic aberration of magnification); Unser, IEEE Signal Processing
    Magazine 16 (6), 22 (1999).
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.images import magnified
from optics.scene.parameter import Parameter


def resize(image, camera):
    several = np.ptp(camera.bands) > 0
    growth = camera.lateral_colour * np.where(several & (camera.bands > 0), (camera.bands - 540.0) / 100, 0.0)
    middle = tuple(
        camera.side * (n / 2 + np.real(m))
        for n, m in ((camera.width, camera.principal_x), (camera.height, camera.principal_y))
    )
    return magnified(image, growth, middle)


def check_parabola():
    """A parabola about the axis, which cubic splines read exactly: its value at the distance r is that at r/(1 + g),
    g = 0.02 at 640 nm, -0.02 at 440 nm, 0 at 540 nm; 20 px from the borders, where rows go on as they end: what that
    does to a spline falls by 0.268 from px to px, to 4e-12."""
    u, v = np.meshgrid(np.arange(60) + 0.5 - 33.0, np.arange(50) + 0.5 - 23.0)
    camera = SimpleNamespace(
        lateral_colour=0.02, bands=np.array([640.0, 540.0, 440.0]), width=60, height=50, principal_x=3.0,
        principal_y=-2.0, side=1,
    )  # fmt: skip
    parabola = 2.0 + 0.1 * u - 0.03 * u * v + 0.05 * v**2
    found = resize(np.repeat(parabola[..., None], 3, 2), camera)[20:-20, 20:-20]
    for band, g in enumerate((0.02, 0.0, -0.02)):
        x, y = u / (1 + g), v / (1 + g)
        expected = (2.0 + 0.1 * x - 0.03 * x * y + 0.05 * y**2)[20:-20, 20:-20]
        agree(found[..., band], expected, 1e-9, 1e-9)
    camera.bands = camera.bands[:1]
    agree(resize(parabola[..., None], camera), parabola[..., None], 1e-9, 1e-9)


effect = Effect(
    name="lateral colour",
    part="camera",
    stages={"lens": resize},
    mixes_pixels=True,
    finer=True,
    parameters=(
        Parameter(
            "lateral_colour",
            "1",
            0.0,
            (-0.05, 0.05),
            "growth m of the image per 100 nm",
            neutral=0.0,
            plausible=0.001,
            how="image",
        ),
    ),
    acts=("radius", "gradient", "channel"),
    needs="contours far from the middle in two colours as far apart as 470 and 625 nm",
    checks=(check_parabola,),
)
