"""Interreflection: the coated face lights itself.

Definition
    L' = L + s L_2,   L_2 the light after two reflections
by Monte Carlo over the second direction. s = 1 is physics; a fit that needs s far from 1 means that interreflection is
not the cause. Among fluorescent beads it is the light that they scatter into one another: what one sends, its own light
and what it reflects, is reflected by the next, and the excitation that it reflects excites the next again.
Fingerprint
    the inner flanks of a dent and its shadows brighten, with the square of the reflectance: colours become more
    saturated. A specular lobe brightens where a mirror would. Beads are lit from the sides that neighbours are on.
Validity
    two reflections; a bright cover outside the gel takes part only if it is in the scene.
References
    Forsyth & Zisserman, IEEE TPAMI 13, 671 (1991); F-TAC Hand supplementary information, S1.5 (neglected: black cover).
"""

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect


def check_integrating_sphere():
    """In a sphere of radius R every point lights every other alike: an LED of the lobe cos(theta) and the power eta in
    its middle gives L_2 = rho^2 eta/(4 pi R^2) everywhere, in the dark half as well."""
    import mitsuba as mi

    rho, eta, radius = 0.6, 100.0, 5.0
    white = {"type": "membrane", "rho_r": rho, "rho_g": rho, "rho_b": rho, "sigma": 0.0}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "tactile", "interreflection": 1.0, "bands": "610, 540, 460"},
            "ball": {"type": "sphere", "radius": radius, "flip_normals": True, "bsdf": white},
            "led": {"type": "led", "position": [0.0, 0.0, 0.0], "target": [0.0, 0.0, 1.0], "mu": 1.0, "power": eta},
            "camera": {
                "type": "camera",
                "x_fov": 30.0,
                "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 180),
                "film": {"type": "hdrfilm", "width": 8, "height": 8},
            },
        },
        optimize=False,
    )
    u, v = np.random.default_rng(13).uniform(0, 8, (2, 65536)).astype("f")
    hits = scene.integrator().hits(scene, scene.sensors()[0], mi.Float(u), mi.Float(v))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, u.size)
    light = np.array(scene.integrator().bounced(scene, *hits, scene.emitters()[0], 1, sampler)[0])
    agree(light.mean(), rho**2 * eta / (4 * np.pi * radius**2), 0.01)  # the noise of 65536 paths is 0.4 %


effect = Effect(
    name="interreflection",
    part="tactile",
    requires=("membrane",),
    parameters=("interreflection",),
    acts=("height", "slope", "shadow", "channel"),
    needs="deep presses with steep flanks",
    checks=(check_integrating_sphere,),
)
