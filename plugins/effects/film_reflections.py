"""Film reflections: light is reflected to and fro between the faces of the polarizer films.

Definition
    each film is face - absorber - face, each face reflects the share r = `face`; all orders of reflections between all
    faces of all films are summed as Mueller matrices (adding method), light from behind by reciprocity.
A film's transmittances are those of the whole film, the faces' losses included. For two ideal films at the angle d the
first order adds r^2 (5 cos(d)^2 + cos(d)^6) to the cos(d)^2 that passes: light that crossed the absorber again was
filtered again.
Fingerprint
    Malus' curve becomes a little narrower, by a cos^6 that neither a leak nor an offset produces; 0.2 % at r = 0.04.
Validity
    the prediction only: mi.render leaves it out. As at normal incidence; no interference (films thicker than the
    coherence length).
References
    van de Hulst, Multiple Light Scattering (1980), ch. 4; Born & Wolf, Principles of Optics, 1.5.2 (r = 0.04 at n =
    1.5).
"""

import numpy as np

from optics.polarization.mueller import Mueller, Slab, face
from optics.scene.checking import agree, mueller
from optics.scene.declare import Effect


def check_first_order():
    """r^2 (5 cos^2 + cos^6) of two films whose absorbers are ideal; r = 1e-3, so that r^3 is 1e-3 of it."""
    r = 1e-3

    def film(angle):
        inner = mueller("polarizer_film", transmittance=(1 - r) ** 2, angle=angle)[0] / (1 - r) ** 2
        return face(r).after(Slab(Mueller.of(inner))).after(face(r))

    for angle in (0.0, 35.0, 60.0):
        passed = film(angle).after(film(0.0)).t.numpy()[0, 0] / (1 - r) ** 4
        cos2 = np.cos(np.radians(angle)) ** 2
        agree((2 * passed - cos2) / r**2, 5 * cos2 + cos2**3, 5e-3)


effect = Effect(
    name="film reflections",
    part="polarizer_film",
    parameters=("face",),
    onset="secant",
    acts=("analyzer.angle", "intensity"),
    needs="many angles, with little noise: the change is second order in r",
    checks=(check_first_order,),
)
