"""The thresholds of a verdict, each with its reason. Fractions are fractions (0.01 is 1 %); falls are of chi2."""

from __future__ import annotations

import math

LEVEL = 0.01  # nominal level of the family-wise test and of the structure test
CARRIED = 0.9  # of the fall of an effect with a strength per frame: more in one part says something of that part alone
JUDGED = 4  # values per strength of a frame, below which such a strength fits anything
CLEAR = 10.8  # fall of chi2 between two effects at which the right one wins in 95 % of cases: Phi(sqrt(10.8)/2)
MARGIN = 0.2  # of the best effect's fall: with real misfit, smaller differences of chi2 decide nothing
TOLD = 2 * math.log(
    19
)  # lead in score at which the odds are 19 to 1: one in twenty of such decisions is wrong, at most
# The same at which an effect is claimed: odds of 99 to 1. Noise is never quite what the model says, and of 74 claims on
# strangers' benches 3 of the 6 with a lead between the two were wrong, none of those above.
SURE = 2 * math.log(99)
# The same where the data do not tell, and plausibility alone decides: what a strength of 36 plausible sizes costs. Of
# three claims on strangers' benches by less than that, two were wrong.
NO_TIE = 3 * math.log1p(36**2 / 2)
EACH = 2 * math.log(9)  # cost of an effect: prior odds of one in ten that a given one of the library acts
USUAL = 0.05  # of the signal: what an unknown cause changes, as effects of plausible size do
# Of the best explanation's fall: where effects that are not decided explain more of it alone, what is decided may be a
# detail of their law. A dial with a bent scale was named eccentric, where a wrong scale alone explained 95 %.
MAIN = 0.9
HALF = 0.5  # of what the best explanation leaves: misfit that is left may lie along the direction that tells two apart
# A map of the sensor or of the session that explains this much more than the best effect: the effect is not the cause.
RIVAL = 1.5
# The same for a curve along one coordinate. With a true effect it gains only what clutter adds: 1.02 was measured, and
# 1.2 with a false one.
RIVAL_CURVE = 1.12
# Share of the excess: where the best explanation leaves less, by HIDDEN standard deviations, what is left is a detail
# of its law, and no curve is a rival. In 548 sets of strangers' benches this changes one verdict, to a right claim.
DETAIL = 0.01
SHARE = 0.05  # of the excess misfit that a claimed effect must explain ...
EXCESS = 5.0  # ... where the excess is more than this many standard deviations
UNEVEN = 0.1  # of the fall: what splitting the strength by channel, frame, ... may still gain
MISSTATED = 2.0  # variance over the stated one above which what the best explanation leaves is misfit, not noise
STRENGTH = 2.0  # standard deviations of a claimed strength from none: a fall without it has another cause
# Plausible sizes (what NO_TIE costs) beyond which a strength is no claim if it stands at the end of its range, or if it
# leaves structure where the base had run to the end of its own: falls are counted from a base that failed then, and all
# that brings it back seems to be missing.
IMPOSSIBLE = 36.0
# Plausible sizes, of 2 % each, by which the power of one LED may change from frame to frame (rms). A red one loses
# about 1 % for each degree, and frames of a session differ by less than ten. On a real DIGIT, gains of each LED that
# followed errors of the shading came to 28.
SWINGING = 5.0
FAR = 0.3  # misfit over the mean signal: more than the effects of a sensor leave
# Misfit over the mean signal of the fixed pattern alone in a good sensor (optics.proof, clutter 1), whose coating adds
# 1 % of mottle.
CLUTTERED = 0.005
HIDDEN = 2.0  # standard deviations of excess misfit that may hide beside an effect which seems to leave none
AS_GOOD = 0.8  # of the best curve's fall: curves above are not told apart from it
MAX_SPLIT = 4  # members of an ambiguous set whose homogeneity is tested: each costs the images of a diagnosis
TELLS = 0.02  # gain of P(correct) below which a shot is not worth a line
MAPS = ("place", "reading")  # where, or when, whatever the cause: a fine map mimics every curve that does not move
MIMICS = (*MAPS, "frame")  # coordinates whose curves can mimic others: 'frame' mimics every setting


def is_structured(structure_p: float, excess_sd: float) -> bool:
    """Whether misfit is left: structure; an excess, where images are too small to show it (p is NaN)."""
    return excess_sd > EXCESS if math.isnan(structure_p) else structure_p < LEVEL


def close(best: float, other: float) -> bool:
    """Whether two falls of chi2 that were predicted, or that leave misfit, are too close to tell the effects apart."""
    return best - other < max(CLEAR, MARGIN * best)


def allowed(coordinate: str) -> float:
    """How many times the best effect's fall a curve along this coordinate may explain."""
    return RIVAL if coordinate in MAPS else RIVAL_CURVE
