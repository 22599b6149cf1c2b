"""Source drift: the lamp warms up or its supply sags while readings are taken.

Definition
    L' = L (1 + drift time)                                      `time`: a setting of the frame or reading
Fingerprint
    follows the clock, whatever angle is set: repeated sweeps differ by a factor.
Validity
    a straight line over the session.
References
    EMVA 1288 release 4.0, 6.4 (temporal stability of the light source).
"""

from optics.scene.declare import Effect

effect = Effect(
    name="source drift",
    part="source",
    parameters=("drift",),
    acts=("source.time",),
    needs="the setting `time`, and the same angle early and late",
)
