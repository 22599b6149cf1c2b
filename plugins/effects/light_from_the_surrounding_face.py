"""Light from the surrounding face: the flat face around a dent lights the dent's flanks.

Definition
    L' = L + rho_c/pi G_c (1 - n_z)/2
(1 - n_z)/2 is the view factor from a facet, whose normal makes the angle arccos n_z with the camera's axis, to a wide
bright plane below; G_c is the radiosity of that plane in the first three bands.
Fingerprint
    every flank brightens alike, whichever way it faces, and with the square of its slope; flat parts stay. One bounce
    within the mesh (interreflection) is the same light with its true borders, at a higher cost.
Validity
    convex dents that are small against the lit face; the face's roughness is left out, and the estimate of G absorbs
    what that changes. Physics allows G_c up to the flat face's own reflected light, rho times its irradiance; a larger
    estimate means that walls, window or gel send light from the side as well.
References
    Howell et al., A Catalog of Radiation Heat Transfer Configuration Factors, A-3 (plate to inclined element).
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def from_the_side(geometry, membrane):
    import drjit as dr
    import mitsuba as mi

    share = (1 + geometry.si.sh_frame.n.z) / 2  # the camera stands at -z
    colours = (membrane.ground_r, membrane.ground_g, membrane.ground_b)
    if getattr(membrane, "integral", None) is not None:
        ground = membrane.by_colour(*colours, geometry.si.wavelengths)
    else:
        ground = mi.UnpolarizedSpectrum(*(*colours, mi.Float(0.0))[: dr.size_v(mi.UnpolarizedSpectrum)])
    return geometry.albedo * ground * (share * dr.inv_pi)


def check_view_factors():
    """rho G/pi times 0 where the face is flat, 1/4 on a slope of 60 degrees and 1/2 on a wall."""
    import mitsuba as mi

    face = SimpleNamespace(ground_r=mi.Float(0.2), ground_g=mi.Float(0.1), ground_b=mi.Float(0.4))
    # the camera is at -z: a flat face has the normal -z
    for n_z, factor in ((-1.0, 0.0), (-0.5, 0.25), (0.0, 0.5)):
        si = SimpleNamespace(sh_frame=SimpleNamespace(n=SimpleNamespace(z=mi.Float(n_z))))
        found = from_the_side(SimpleNamespace(si=si, albedo=mi.UnpolarizedSpectrum(0.7)), face)
        agree(np.array(found).ravel()[:3], 0.7 / np.pi * factor * np.array([0.2, 0.1, 0.4]), 1e-5)


effect = Effect(
    name="light from the surrounding face",
    part="membrane",
    stages={"ambient": from_the_side},
    parameters=tuple(
        Parameter(
            f"ground_{c}",
            "1/mm^2",
            0.0,
            (0.0, 100.0),
            f"radiosity G of the surroundings in the {word} band, in the unit of (S2)'s kappa",
            neutral=0.0,
            plausible=1e-3,
            linear=True,
        )
        for c, word in (("r", "first"), ("g", "second"), ("b", "third"))
    ),
    acts=("slope", "channel"),
    needs="steep contacts seen from above, lit from several sides",
    checks=(check_view_factors,),
)
