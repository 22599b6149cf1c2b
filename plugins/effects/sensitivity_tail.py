"""Sensitivity tail: every channel sees a little of all wavelengths.

Definition
    Q'_c(lambda) = (1 - t) Q_c(lambda) + t Q_max                 t = `sensitivity_tail`, Q_max the largest of all Q
The dyes of a mosaic's colour filters do not block everything: behind each of them silicon keeps a pedestal, which
published curves often leave out. LEDs outside a channel's band reach it through that pedestal.
Fingerprint
    each channel gains the same share of all light, whatever its colour: shadows of one LED are filled, in its own
    channels' neighbours, by the light of the others. Colour crosstalk gives a channel what its neighbours see instead,
    so that light between two bands counts for less.
Validity
    a pedestal without colour over the range of the curves. In bands that are channels themselves (sensitivity
    "identity") it is the same as colour crosstalk but for a gain.
References
    Jiang, Liu, Gu & Susstrunk, WACV 2013 (measured sensitivities of 28 cameras).
"""

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def pedestal(quantum, nm, camera):
    best = quantum.ravel()[quantum.real.argmax()]
    return quantum + camera.sensitivity_tail * (best - quantum)


def check_pedestal():
    """Of a channel that is blind for a band, t of the best; of the best, nothing is lost."""
    from types import SimpleNamespace

    import numpy as np

    quantum = np.array([[0.8, 0.0], [0.2, 0.4]])
    agree(pedestal(quantum, None, SimpleNamespace(sensitivity_tail=0.1)), [[0.8, 0.08], [0.26, 0.44]])


effect = Effect(
    name="sensitivity tail",
    part="camera",
    stages={"sensitivity": pedestal},
    parameters=(
        Parameter(
            "sensitivity_tail",
            "1",
            0.0,
            (0.0, 0.5),
            "share t of the best sensitivity at every wavelength",
            neutral=0.0,
            plausible=0.01,
            how="image",
        ),
    ),
    acts=("channel",),
    needs="LEDs of different colours; to tell it from crosstalk, an LED between two channels, such as 500 nm, or a "
    "band-pass filter before an LED",
    checks=(check_pedestal,),
)
