"""Surface scattering: a rough or dusty face sends unpolarized light along with its reflection.

Definition
    M' = (1 - scatter) M + scatter diag(1, 0, 0, 0)
Fingerprint
    a floor that depends on no angle: at Brewster's angle p light is not dark, and between crossed films neither. A leak
    of the films goes with the reflected light, a stray light of the room with neither lamp nor films.
Validity
    all of it is depolarized; the same at all angles of incidence.
References
    Stover, Optical Scattering, 3rd ed. (2012), ch. 2.
"""

from optics.scene.checking import agree, mueller
from optics.scene.declare import Effect


def check_a_floor():
    """Light that meets crossed films, s before and p behind: scatter/2 of it passes, and nothing else."""
    films = [mueller("polarizer_film", transmittance=1.0, angle=angle)[0] for angle in (90.0, 0.0)]
    passed = films[1] @ mueller("reflecting_plate", scatter=0.01, incidence=30.0)[0] @ films[0]
    agree(passed[0, 0], 0.01 / 4, 1e-12)


effect = Effect(
    name="surface scattering",
    part="reflecting_plate",
    parameters=("scatter",),
    acts=("plate.incidence", "intensity"),
    needs="p light about Brewster's angle, or crossed films before and behind the plate",
    checks=(check_a_floor,),
)
