"""Ambient light: light that no LED emitted reaches the coated face from all sides.

Definition
    L' = L + rho_c E / pi (A + B g(t)),    g(t) = (sin t (t - sin t cos t) + 2/3 tan t (1 - sin^3 t)) / pi
with the irradiance E of the face, the same from every direction and in every band, the reflectance rho_c, the face's
roughness (A, B) of (S3), and the angle t of sight: the integral of the face's reflection over the hemisphere.
Fingerprint
    an offset that does not depend on the LEDs' powers and is proportional to the reflectance. Veiling glare and a wrong
    black level look alike; frames of different power, or one with all LEDs off, separate them.
Validity
    diffuse light without a shadow of its own; a lamp outside a clear skin is another effect.
References
    F-TAC Hand supplementary information, S1.5 (neglected there: black cover).
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def leak(geometry, membrane):
    import drjit as dr

    a, b = membrane.rough()
    cos = dr.clip(dr.abs(geometry.cos_view), 1e-3, 1.0)
    t, sin = dr.acos(cos), dr.safe_sqrt(1 - cos * cos)
    g = (sin * (t - sin * cos) + 2 / 3 * sin / cos * (1 - sin * sin * sin)) / dr.pi
    return geometry.albedo * (membrane.ambient / dr.pi) * (a + b * g)


def check_hemisphere():
    """rho E/pi of a smooth face; of a rough one, sigma = 0.4, the integral of (S3) in angles over the hemisphere."""
    sigma2 = 0.4**2
    a, b = 1 - 0.5 * sigma2 / (sigma2 + 0.33), 0.45 * sigma2 / (sigma2 + 0.09)
    light, turn = np.meshgrid(
        (np.arange(900) + 0.5) / 900 * np.pi / 2, (np.arange(360) + 0.5) / 180 * np.pi, indexing="ij"
    )
    cell = np.pi / 2 / 900 * np.pi / 180 * np.cos(light) * np.sin(light)
    for view in (0.1, 0.6, 1.2):
        bent = np.maximum(0, np.cos(turn)) * np.sin(np.maximum(light, view)) * np.tan(np.minimum(light, view))
        for rough, share in (((1.0, 0.0), 1.0), ((a, b), ((a + b * bent) / np.pi * cell).sum())):
            face = SimpleNamespace(rough=lambda rough=rough: rough, ambient=0.3)
            found = leak(SimpleNamespace(cos_view=np.cos(view), albedo=0.7), face)
            agree(found, 0.7 * 0.3 / np.pi * share, 1e-4)  # of midpoints, 900 by 360


effect = Effect(
    name="ambient light",
    part="membrane",
    stages={"ambient": leak},
    parameters=(
        Parameter(
            "ambient",
            "1/mm^2",
            0.0,
            (0.0, 10.0),
            "irradiance E, in the unit of (S2)'s kappa",
            neutral=0.0,
            plausible=2e-4,
            linear=True,
        ),
    ),
    acts=("intensity", "frame", "channel"),
    needs="frames of different LED power, or a frame with all LEDs off",
    checks=(check_hemisphere,),
)
