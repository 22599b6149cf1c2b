"""Back-face reflection: the detector of a reflection bench sees the back face of the plate as well.

Definition
    R_j' = R_j + back_face R_j (1 - R_j)^2/(1 - R_j^2)           j = s, p; all orders, without interference
Fingerprint
    at normal incidence nearly twice the light of a glass plate; Brewster's angle stays, for at it the inner face
    reflects no p light either. A brighter lamp looks alike near normal incidence, where R is small; at grazing
    incidence the share falls.
Validity
    a plane-parallel, clear plate thicker than the coherence length, whose second beam reaches the detector in part. A
    plate with a black back has none.
References
    Born & Wolf, Principles of Optics, 1.5.2 and 7.6.1 (sums over orders).
"""

from optics.scene.checking import agree, mueller
from optics.scene.declare import Effect


def check_a_pile_of_two_faces():
    """2 R_s/(1 + R_s) and 2 R_p/(1 + R_p) at 70 deg: Stokes' formula for a plate."""
    front, plate = (mueller("reflecting_plate", incidence=70.0, back_face=share)[0] for share in (0.0, 1.0))
    for sign in (-1, 1):  # s along 90 deg: S1 = -S0
        r = front[0, 0] + sign * front[0, 1]
        agree(plate[0, 0] + sign * plate[0, 1], 2 * r / (1 + r))


effect = Effect(
    name="back-face reflection",
    part="reflecting_plate",
    parameters=("back_face",),
    acts=("plate.incidence", "polarizer.angle"),
    needs="angles of incidence from normal to grazing, in s and in p light",
    checks=(check_a_pile_of_two_faces,),
)
