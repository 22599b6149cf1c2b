"""Volume scattering: a material that is not perfectly clear scatters light.

Definition
    dL/ds = -sigma_s L + sigma_s/(4 pi) integral L domega        sigma_s = `scattering`, the same in all directions
Fingerprint
    the whole body glows, brightest near the LEDs, where a clear one is dark; images through it fade.
Validity
    isotropic, unpolarized afterwards. mi.render does not follow it.
References
    Chandrasekhar, Radiative Transfer (1960), 1.5.
"""

import math

from optics.scene.checking import agree, scene_of
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def check_direct_light():
    """exp(-sigma_s d) of a small luminous screen far behind a body of the index 1 that is 2 mm thick; what is scattered
    towards the screen is 1e-4 of the light or less."""
    from optics.light.transport import Transport

    body = (
        '<shape type="cube"><transform name="to_world"><scale x="9" y="9"/></transform><bsdf type="clear" id="body">'
        '<float name="index" value="1"/><float name="scattering" value="0.25"/></bsdf></shape>'
    )
    screen = (
        '<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="180"/><scale x="4" y="4"/>'
        '<translate z="200"/></transform><bsdf type="diffuse"><spectrum name="reflectance" value="0"/></bsdf>'
        '<emitter type="source" id="lamp"/></shape>'
    )
    rays = 8000
    found = Transport(scene_of(body, screen)).take(rays=rays, reach="paths").radiance
    share = math.exp(-0.5)
    # a share of 16 pixels' rays: binomial, five standard deviations
    agree(found.mean(), share, 0, 5 * math.sqrt(share * (1 - share) / (16 * rays)))


effect = Effect(
    name="volume scattering",
    part="clear",
    per="part",
    parameters=(
        Parameter(
            "scattering",
            "1/mm",
            0.0,
            (0.0, 10.0),
            "scattering coefficient sigma_s",
            neutral=0.0,
            plausible=0.02,
            how="difference",
            step=1.0,
        ),
    ),
    acts=("led_distance", "intensity"),
    needs="LEDs of different sides, one at a time",
    checks=(check_direct_light,),
)
