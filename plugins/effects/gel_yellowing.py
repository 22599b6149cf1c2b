"""Gel yellowing: the gel absorbs blue light, and ever less towards the red.

Definition
    L' = L exp(-y exp(-(lambda - 440)/w) (d_light + d_view))
with the coefficient y = `yellowing` at 440 nm, the width w = `yellowing_width` of the absorption's tail, and the
lengths of both paths inside the gel, -thickness < z < 0. Silicones and polyurethanes that age, or are cured too hot,
have the exponential tail of an absorption in the ultraviolet.
Fingerprint
    blue light darkens with the length of its path: towards the far side of its LED and towards the corners, while red
    light stays. Gel absorption darkens all colours alike; a blue LED that is weaker darkens everywhere.
Validity
    one exponential over the visible; no scattering. The extinction of thin films does not hold over centimetres.
References
    Urbach, Phys. Rev. 92, 1324 (1953); Born & Wolf, Principles of Optics, 14.1.
"""

from types import SimpleNamespace

import numpy as np

from optics.polarization.mueller import exp
from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def tint(path, gel):
    tail = exp((440.0 - gel.nm(path.wavelengths)) / gel.yellowing_width)
    return exp(-gel.yellowing * tail * (path.view + path.light))


def check_tail():
    """Half is left at 440 nm after ln 2/y; at 440 + w ln 2 nm, where the coefficient is y/2, the root of a half."""
    gel = SimpleNamespace(yellowing=0.1, yellowing_width=60.0, nm=lambda wavelengths: wavelengths)
    path = SimpleNamespace(view=5.0, light=1.931471806, wavelengths=440.0 + 60.0 * np.log(np.array([1.0, 2.0])))
    agree(tint(path, gel), [0.5, 0.5**0.5], 1e-9)


effect = Effect(
    name="gel yellowing",
    part="gel",
    stages={"segment": tint},
    parameters=(
        Parameter(
            "yellowing", "1/mm", 0.0, (0.0, 10.0), "absorption coefficient y at 440 nm", neutral=0.0, plausible=0.01
        ),
    ),
    shape=(
        Parameter(
            "yellowing_width", "nm", 60.0, (10.0, 1000.0), "width w: over it the coefficient falls to 1/e",
            plausible=20.0,
        ),
    ),
    acts=("gel_path", "led_distance", "height", "channel"),
    needs="an LED of 470 nm or less beside a red one, presses of different depth and place",
    checks=(check_tail,),
)  # fmt: skip
