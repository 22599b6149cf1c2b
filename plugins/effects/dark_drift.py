"""Dark drift: the dark signal grows or falls while readings are taken, as the detector warms.

Definition
    m' = m + dark_drift g(time)                   `time`: a setting of the frame or reading
    g(t) = (1 - exp(-settling t))/settling        t where settling is 0: it never settles
of the response m, 1 = full scale, with settling = `dark_settling`. Dark current and an amplifier's zero depend on
temperature, which approaches a balance.
Fingerprint
    follows the clock and is the same in bright and in dark readings: the extinguished ones show it most. A source that
    drifts changes the bright ones, a dark offset is there from the first reading on.
Validity
    one number for all channels; a detector that approaches its balance at one rate, from time 0 on. Slow light of the
    room that grows by the clock looks alike.
References
    EMVA 1288 release 4.0, 2.2 (dark signal); Newton's law of cooling.
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter
from optics.scene.warming import settled


def rise(image, camera):
    return image + camera.dark_drift * settled(camera.time, camera.dark_settling)


def check_line_in_time():
    """0.002 of full scale per unit of time are 0.006 after 3 units, at every level."""
    image = np.array([[[0.0, 0.3, 0.9]]])
    for time in (0.0, 3.0, np.array([[[1.0]], [[4.0]]])):
        camera = SimpleNamespace(dark_drift=0.002, dark_settling=0.0, time=time)
        agree(rise(image, camera) - image, 0.002 * time + 0 * image, 1e-12, 1e-15)


def check_settling():
    """One that settles at the rate 0.5 ends 1 higher; after one time constant it has gone 63 % of the way."""
    for time, done in ((0.02, 1 - np.exp(-0.01)), (2.0, 1 - np.exp(-1)), (60.0, 1.0)):
        agree(rise(np.zeros(1), SimpleNamespace(dark_drift=0.5, dark_settling=0.5, time=time)), [done])


effect = Effect(
    name="dark drift",
    part="camera",
    stages={"response": rise},
    parameters=(
        Parameter(
            "dark_drift",
            "1",
            0.0,
            (-1.0, 1.0),
            "change of the dark signal per unit of time, at time 0, of full scale",
            neutral=0.0,
            plausible=5e-4,
            through="clock",
            how="image",
        ),
        Parameter(
            "dark_settling",
            "1",
            0.0,
            (0.0, 1e3),
            "rate at which that change settles, per unit of time; 0: it never does",
            neutral=0.0,
            plausible=0.1,
            through="clock",
            how="image",
        ),
    ),
    acts=("source.time",),
    needs="the time of each reading, and a dark reading early and late",
    checks=(check_line_in_time, check_settling),
)
