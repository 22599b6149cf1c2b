"""Refraction at the window: the camera looks through a flat window into a denser gel.

Definition
    Snell's law and Fresnel's transmittances at every `interface`; see the part. The strength is the index, 1 is no
    window.
Fingerprint
    the image shrinks towards the optical axis, more so for what lies deeper; the corners darken by a few percent.
    The camera's field of view and position absorb nearly all of it: only a dent's depth or oblique views tell.
Validity
    flat windows across the optical axis; the onset is not linear over the range of real indices, so the ranking takes a
    finite step.
References
    Born & Wolf, Principles of Optics, 1.5; Treibitz et al., IEEE TPAMI 34, 51 (2012) (flat ports).
"""

from optics.scene.declare import Effect

effect = Effect(
    name="refraction at the window",
    part="interface",
    parameters=("index",),
    onset="secant",
    acts=("radius", "height"),
    needs="presses of known position all over the field, and of different depth",
)
