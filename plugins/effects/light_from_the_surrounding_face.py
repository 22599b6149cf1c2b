"""Light from the surrounding face: the flat face around a dent lights the dent's flanks.

Definition
    L' = L + rho_c/pi G_c (1 - n_z)/2
(1 - n_z)/2 is the share of its view that a facet, whose normal makes the angle arccos n_z with the camera's axis, gives
to a wide bright plane below; G_c is the radiosity of that plane in the first three bands.
Fingerprint
    every flank brightens alike, whichever way it faces, and with the square of its slope; flat parts stay. One bounce
    within the mesh (interreflection) is the same light with its true borders, and dearer to compute.
Validity
    convex dents, small against the lit face, whose roughness is left out: G holds what it takes away. Physics allows
    G_c up to the flat face's own reflected light, rho times its irradiance; a larger estimate says that walls, window
    or gel send light from the side as well.
References
    Howell et al., A Catalog of Radiation Heat Transfer Configuration Factors, A-3 (plate to inclined element).
"""

from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def from_the_side(geometry, membrane):
    import drjit as dr
    import mitsuba as mi

    share = (1 + geometry.si.sh_frame.n.z) / 2  # the camera stands at -z
    colours = (membrane.ground_r, membrane.ground_g, membrane.ground_b, mi.Float(0.0))
    return geometry.albedo * mi.UnpolarizedSpectrum(*colours[: dr.size_v(mi.UnpolarizedSpectrum)]) * (share * dr.inv_pi)


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
)
