"""Marker leak: part of the markers' light is guided in the clear skin and leaves it elsewhere.

Definition
    L = m <L_markers>                        from the skin's face to the camera, the same everywhere on it
with the share m and the mean radiance of the fluorescent markers in the image. Light that enters the skin under a
marker beyond the critical angle is guided by total reflection until a flaw of the face lets it out.
Fingerprint
    a faint glow in the colour of the markers over the skin, between the markers. It is there at every angle of the
    analyser and follows the ultraviolet lamps. The leak of a polarizer has the colours of the background and vanishes
    when the background is dark.
Validity
    uniform over the face: guided light crosses it many times. A quick prediction; mi.render leaves it out.
References
    Vi2TaP (RA-L 2025), II.B (markers cast into the skin); Born & Wolf, Principles of Optics, 1.5.4 (total reflection).
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def shine(glow, interface):
    return interface.marker_leak * glow.markers


def check_share():
    """Half a percent of the markers' mean radiance, band by band."""
    found = shine(SimpleNamespace(markers=np.array([0.2, 1.0, 0.4])), SimpleNamespace(marker_leak=0.005))
    agree(found, [0.001, 0.005, 0.002])


effect = Effect(
    name="marker leak",
    part="interface",
    stages={"glow": shine},
    per="part",
    requires=("fluorescent",),
    parameters=(
        Parameter(
            "marker_leak",
            "1",
            0.0,
            (0.0, 1.0),
            "share m of the markers' mean radiance",
            neutral=0.0,
            plausible=0.005,
            how="layer",
        ),
    ),
    acts=("channel", "intensity"),
    needs="crossed polarizers and a dark background, ultraviolet lamps on and off",
    checks=(check_share,),
)
