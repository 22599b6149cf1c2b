"""Telecentric lens: the lens looks along its axis all over the field, or the camera stands farther off than assumed.

Definition
    d = ((1 - t) X/Z, (1 - t) Y/Z, 1)                            along the ray that meets the face at (X, Y, 0)
with the camera's distance Z from the untouched face, z = 0, in the scene: `telecentricity` t = 1 - Z/Z_t of a camera at
Z_t whose image of the face is as large. 1 is a telecentric lens, t < 0 a camera that stands nearer, t > 1 a
hypercentric lens.
Fingerprint
    what stands towards the camera by h moves by t h r/Z towards the middle of the image, flanks and all: in each
    contact the side that faces away from the middle is seen at a steeper place. The face itself stays. A scale that is
    wrong moves the face as well, radial distortion moves all with the third power of the radius, and a position that is
    fitted for each press takes all of it up: it needs a plate of known contacts, or presses of different depth.
Validity
    the part `camera` over a gel whose untouched face is at z = 0; no window that bends the rays.
References
    Born & Wolf, Principles of Optics, 4.8.3 (entrance pupil at infinity).
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree, made
from optics.scene.declare import Effect


def check_rays():
    """Over a gel whose face is 20 mm away, all rays meet it where they did, and with t = 1 they are parallel; with t =
    0.5 they come together at 40 mm. The face is sharp all over where the lens is focused on its distance."""
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": 80, "height": 60}
    u = mi.Float([0, 20, 80])
    for t in (0.0, 0.5, 1.0):
        camera = made("camera", x_fov=60.0, film=film, telecentricity=t)
        camera.away = 20.0
        o, d = (np.array(a) for a in camera.ray(u, mi.Float([0.0, 30.0, 30.0])))
        met = o + d * ((20.0 - o[2]) / d[2])
        x = np.array([-40, -20, 40]) / (40 / np.tan(np.pi / 6))
        agree(met, [20 * x, [20 * x[0] * 0.75, 0, 0], [20.0] * 3], 0, 1e-4)
        # slopes of the rays, as from where they would come together
        agree(d[0] / d[2], (1 - t) * x, 0, 1e-6)
        own = SimpleNamespace(x_fov=60.0, aspect=1.0, principal_x=0.0, principal_y=0.0, focus=20.0, telecentricity=t)
        slant = np.linalg.norm(met - o, axis=0)
        agree(camera.astray(own, np.array([0.0, 20, 80]), np.array([0.0, 30, 30]), slant), 0.0, 0, 1e-5)


effect = Effect(
    name="telecentric lens",
    part="camera",
    parameters=("telecentricity",),
    requires=("gel",),
    acts=("radius", "gradient", "height"),
    needs="a plate of contacts of known places all over the field, or presses of different depth",
    checks=(check_rays,),
)
