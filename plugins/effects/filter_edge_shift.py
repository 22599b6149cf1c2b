"""Filter edge shift: the edge of an interference filter moves to shorter waves for light that comes aslant.

Definition
    I'_b = I_b T(lambda_b/s)/T(lambda_b),  s = sqrt(1 - e sin(theta)^2),  T(lambda) = 1/(1 + exp((lambda - lambda_0)/w))
e = `edge_tilt` = 1/n^2 with the filter's effective index n, theta the field angle, lambda_0 = `edge_wavelength` and w =
`edge_softness` of the edge: a short pass, such as the filter that keeps infrared light from a colour camera. What it
takes at normal incidence is in the sensitivities already.
Fingerprint
    red fades towards the corners, with the square of the field angle, the other channels stay: vignetting of one
    colour. Vignetting of the lens is alike in all channels.
Validity
    one edge; collimated light in each pixel, as before a lens or behind one of long focus. T is read at the bands:
    where the edge lies within the spectrum of a light, fixed bands in steps of w/2 are needed.
References
    Macleod, Thin-Film Optical Filters, 4th ed., ch. 8 (tilted filters).
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def passed(nm, camera):
    return 1 / (1 + np.exp((nm - camera.edge_wavelength) / camera.edge_softness))


def shade(image, camera):
    sine = camera.tan**2 / (1 + camera.tan**2)
    seen_as = camera.bands / np.sqrt(1 - camera.edge_tilt * sine[..., None])
    return image * (passed(seen_as, camera) / passed(camera.bands, camera))


def check_shifted_edge():
    """At the wavelength lambda_0 s half is passed at the angle theta; the axis and far shorter waves lose nothing."""
    sine, e = np.sin(np.radians(30.0)), 1 / 1.7**2
    s = np.sqrt(1 - e * sine**2)
    camera = SimpleNamespace(
        tan=np.array([[0.0, np.tan(np.radians(30.0))]]),
        bands=np.array([650.0 * s, 400.0]),
        edge_wavelength=650.0,
        edge_softness=8.0,
        edge_tilt=e,
    )
    found = shade(np.ones((1, 2, 2)), camera)
    agree(found[0, 0], [1.0, 1.0])
    agree(found[0, 1] * passed(camera.bands, camera), [0.5, 1.0], 1e-9)


effect = Effect(
    name="filter edge shift",
    part="camera",
    stages={"lens": shade},
    parameters=(
        Parameter(
            "edge_tilt", "1", 0.0, (0.0, 0.9), "e = 1/n^2 of the filter", neutral=0.0, plausible=0.3, how="image"
        ),
    ),
    shape=(
        Parameter(
            "edge_wavelength", "nm", 650.0, (400.0, 1100.0), "where the filter passes half", plausible=5.0, how="image"
        ),
        Parameter("edge_softness", "nm", 10.0, (1.0, 100.0), "softness w of the edge", plausible=2.0, how="image"),
    ),
    acts=("radius", "channel"),
    needs="a wide field of view and light near the filter's edge: an LED within 20 nm of it, beside one 60 nm below, "
    "which it leaves alone",
    checks=(check_shifted_edge,),
)
