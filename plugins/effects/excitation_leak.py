"""Excitation leak: the filter of the next channel lets a share of the excitation through.

Definition
    I'_j = I_j + x I_b                                           b: the band of the shortest wavelength; j: the next
with the share x (`excitation_leak`). LEDs of a short wavelength make beads shine at a longer one. A colour filter that
separates the two is never dense: what the cover, and whatever else is grey, reflects of the LEDs shows in the beads'
channel.
Fingerprint
    in the emission's channel appears what the excitation's shows: reflections without fluorescence, such as a cover
    that should be black. Colour crosstalk goes both ways and between all channels.
Validity
    beads that shine (where nothing does, this is colour crosstalk); one share over the field; bands that are channels
    (`sensitivity` identity). One band alone has no other to leak from.
References
    Lakowicz, Principles of Fluorescence Spectroscopy, 3rd ed., 2.4 (filters); EMVA 1288 release 4.0, 4.2.
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def leaked(image, camera):
    order = np.argsort(camera.bands)
    if len(order) < 2:
        return image
    path = np.zeros((len(order), len(order)))
    path[order[1], order[0]] = 1.0
    return image + camera.excitation_leak * (image @ path.T)


def check_share():
    """Blue light of 2 appears with a share of 0.1 in green, and nowhere else; red and green leak nowhere."""
    camera = SimpleNamespace(bands=np.array([610.0, 525.0, 465.0]), excitation_leak=0.1)
    agree(leaked(np.array([[[0.3, 0.5, 2.0]]]), camera)[0, 0], [0.3, 0.7, 2.0])
    agree(leaked(np.array([[[0.3]]]), SimpleNamespace(bands=np.array([540.0]), excitation_leak=0.1))[0, 0], [0.3])


effect = Effect(
    name="excitation leak",
    part="camera",
    stages={"lens": leaked},
    parameters=(
        Parameter(
            "excitation_leak",
            "1",
            0.0,
            (0.0, 1.0),
            "share x of the excitation in the next channel",
            neutral=0.0,
            plausible=0.03,
            how="image",
        ),
    ),
    requires=("beads",),
    acts=("channel",),
    needs="a channel that sees the excitation alone",
    checks=(check_share,),
)
