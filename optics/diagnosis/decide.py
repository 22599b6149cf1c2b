"""The rule of the verdict: from `Findings` to one of six words, and the conditions that decided it.

Every condition is kept with its value and its limit, whether it held or not. The limits are in
`optics.diagnosis.thresholds`, what the words mean in `optics.diagnosis.result`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from optics.diagnosis.result import Condition, Fingerprint
from optics.diagnosis.thresholds import (
    AS_GOOD,
    CARRIED,
    EXCESS,
    FAR,
    IMPOSSIBLE,
    LEVEL,
    MIMICS,
    SHARE,
    STRENGTH,
    SURE,
    TOLD,
    UNEVEN,
    allowed,
    is_structured,
)
from optics.words import p_text, percent

MANY = 3  # effects of one explanation
DIALS = "dials known"  # of an effect with a strength per frame
UNPREDICTED = 9.0  # times the chi2 of fitted frames: errors three times as large are no scatter of few frames
PREDICTS = "held-out frames"
LIGHT = "light"
HOMOGENEITY = "homogeneity"
STANDS_OUT = "an effect stands out"
RIVALS = "rivals calibrated"  # of pairs of effects of images, which are dear
LAW = "no other law"  # of an effect that the model has already
KEPT = "no other value"  # of what the calibration keeps
CLUTTER = "beyond clutter"  # of the strength, which parts of the data tell
NO_DETAIL = "no detail"  # of what is not decided
PLAUSIBLE = "plausible"  # strengths for what the effect adds
CURVE = "a curve explains it"  # name of the condition that a curve must meet for UNKNOWN


@dataclass(frozen=True)
class Findings:
    """The numbers that a verdict is made of. Falls are of chi2, net: less what an absent effect gives on average.

    p_family     of the best of all candidates; structure_p: of structure in the residual, NaN where there are too few
                 readings, or too small images, to show any
    winner       the effect that is part of every explanation that survives; where there is none, the best single
                 effect; '' if nothing is told apart from no effect at all. p_winner: family-wise, of its fall
    fall         of the best explanation
    common       whether the winner is part of every explanation that survives; survivors: their number
    lead         of the best explanation's score over that of the best one without the winner; needed: TOLD, or more
                 where misfit is left
    against      that explanation, in words
    detail_of    effects of the best explanation that explain nearly all without the winner, and are not part of every
                 explanation, in words; '' for none
    adds         what the winner adds to the fall of the others, beside noise that neighbours share; priced: what its
                 strengths cost for being far from neutral (`optics.diagnosis.explanations`)
    ratio        the best curve's fall, less its cost, over that of the best explanation; coordinate: of that curve;
                 beside: whether noise that neighbouring readings or frames share was allowed for in both
    rival        whether a curve does significantly better, by RIVAL (a map) or RIVAL_CURVE, where misfit is left, or is
                 not told apart from several effects; curve_lead: of its score over that of the best explanation,
                 0 where that leaves nothing
    shared       whether noise that neighbouring readings share explains it as well as the best explanation
    wander       rms of such noise over the signal where it alone leaves no misfit, over `memory` readings; wander_p: of
                 structure that it leaves; NaN where it does not do
    share        of the excess that the best explanation explains, where excess_sd > EXCESS; curve_share: the best curve
    left         misfit over mean signal with the best explanation
    uneven       largest h of the winner's splits, by the split uneven_by (in words), uneven_limit allowed;
                 uneven_certain: whether its parts surely differ, by little; even: whether all its splits
                 hold; some_even: whether those of any survivor do
    held_out     fall on held-out frames, NaN where there are none; p_both: p_winner of the two falls together
    ahead        fall of chi2 on blocks of readings that were left out in turn; NaN for images
    clear        of the winner's strength from none, in standard deviations; NaN where they are unknown
    far          of it, in plausible sizes; at_end: at which end of its range it stands, in words; '' for none
    complete     whether the best explanation leaves nothing
    ran          what of the base ran to the end of its range, and comes back with the best explanation, in words
    unset        dials of images whose errors nobody states, where the winner has a strength for each frame; '' for none
    chance       family-wise p of that strength by its scatter between parts of the sensor or session, NaN where there
                 are too few parts
    carried      share of the winner's fall in the one part that carries most of it, by the part carried_by (in words);
                 of effects with a strength per frame
    law          an effect that the model has, and the coordinate along which another law of it explains most; ''  for
                 none that is significant; law_lead: of the best explanation's score over that law's
    fixed        a value that the calibration keeps, and the one that explains most, in words; '' for none that explains
                 much; fixed_fall: of chi2 with it free; fixed_lead: of the best explanation over that value;
                 fixed_needed: by a claim; fixed_wins: whether it is the value that leads
    fragile      an effect that other weights or masks prefer clearly, '' for none
    untried      explanations without the winner that may do better by their scores, and were not refitted, in words
    run_away     a power that has run away from the others, in words (optics.fit.run_away)
    base_fitted  chi2 per value that the base leaves on fitted frames; base_held_out: on held-out ones, NaN for none
    measured     whether repeats fix the size of the noise
    misstated    whether the excess is that of images whose noise is stated a little too small: without structure
    """

    p_family: float
    structure_p: float
    winner: str = ""
    p_winner: float = 1.0
    fall: float = 0.0
    common: bool = True
    shared: bool = False
    wander: float = math.nan
    wander_p: float = math.nan
    memory: float = math.nan
    survivors: int = 1
    lead: float = math.inf
    needed: float = TOLD
    against: str = ""
    ratio: float = 0.0
    beside: bool = False
    rival: bool = False
    curve_lead: float = math.inf
    coordinate: str = ""
    share: float = math.nan
    curve_share: float = math.nan
    left: float = math.nan
    excess_sd: float = 0.0
    uneven: float = 0.0
    uneven_by: str = ""
    uneven_limit: float = UNEVEN
    uneven_certain: bool = False
    even: bool = True
    some_even: bool = True
    held_out: float = math.nan
    p_both: float = math.nan
    ahead: float = math.nan
    clear: float = math.nan
    far: float = 0.0
    at_end: str = ""
    complete: bool = True
    ran: str = ""
    unset: str = ""
    chance: float = math.nan
    carried: float = 0.0
    carried_by: str = ""
    law: str = ""
    law_lead: float = math.inf
    fixed: str = ""
    fixed_fall: float = 0.0
    fixed_lead: float = math.inf
    fixed_needed: float = SURE
    fixed_wins: bool = False
    fragile: str = ""
    detail_of: str = ""
    adds: float = math.inf
    priced: float = 0.0
    untried: Sequence[str] = ()
    run_away: str = ""
    base_fitted: float = math.nan
    base_held_out: float = math.nan
    measured: bool = False
    misstated: bool = False

    @property
    def another_law(self) -> bool:
        """Whether another law of an effect that the model has does clearly better than the best explanation."""
        return self.law_lead < -TOLD

    @property
    def another_value(self) -> bool:
        """Whether another value of what the calibration keeps does clearly better than the best explanation, and no
        other law of an added effect does better still."""
        return self.fixed_wins and self.structured and self.fixed_lead < self.law_lead

    @property
    def structured(self) -> bool:
        """Whether the base model leaves structure, or more than a noise that repeats have measured."""
        return is_structured(self.structure_p, self.excess_sd) or (self.measured and self.weighed)

    @property
    def refuted(self) -> bool:
        """Whether held-out frames take back what made the winner significant. Where it hardly acts, chi2 may rise or
        fall by a little there, and says nothing."""
        return self.held_out <= 0 and not self.p_both < LEVEL

    @property
    def weighed(self) -> bool:
        """Whether the base model leaves an excess, of which an effect or a curve explains a share."""
        return self.excess_sd > EXCESS and not self.misstated


def decide(f: Findings) -> tuple[str, list[Condition]]:
    """One of the six words, and the conditions that it rests on. A model that misses held-out frames by far more than
    the fitted ones is not as good as the data can tell, whatever the fitted ones say."""
    word, conditions = _by_fitted(f)
    if word == "NOTHING" and f.base_held_out > UNPREDICTED * max(f.base_fitted, 1.0):
        text = (
            f"chi2 per value is {f.base_held_out:.3g} on held-out frames and {f.base_fitted:.3g} on fitted ones: the "
            "model does not predict what it was not fitted to. A setting of theirs may be wrong, or a part of the "
            "range may lack fitted frames"
        )
        conditions.append(Condition(PREDICTS, f.base_held_out, UNPREDICTED, False, text))
        return "CANNOT_TELL", conditions
    return word, conditions


def _by_fitted(f: Findings) -> tuple[str, list[Condition]]:
    significant = f.p_family < LEVEL
    conditions = _is_anything_there(f, significant)
    if not significant and not f.structured:
        return "NOTHING", conditions
    if significant and f.winner:
        rest = [*_against_effects(f), *_against_causes_outside(f), *_of_the_strength(f)]
        conditions += rest
        word = _word_of_winner(f, {c.name for c in rest if not c.holds})
        if word:
            return word, conditions
    elif significant:
        conditions.append(
            Condition(
                "significant",
                1.0,
                LEVEL,
                False,
                "after everything is calibrated again, no effect explains more than chance does",
            )
        )
        if not f.structured and not f.weighed:
            return "NOTHING", conditions
    if f.another_value:
        if not any(c.name == KEPT for c in conditions):
            conditions.append(_kept(f))
        return "CANNOT_TELL", conditions
    if f.another_law and f.structured:
        return "UNKNOWN", conditions
    if f.rival and f.structured:
        if not f.curve_share < SHARE:
            return "UNKNOWN", conditions
        conditions.append(
            Condition(
                CURVE,
                f.curve_share,
                SHARE,
                False,
                f"the best one ({f.coordinate}) explains {f.curve_share:.1%} of the excess, {SHARE:.0%} needed: the "
                "rest is spread homogeneously, as from a wrong noise model",
            )
        )
    if f.wander_p >= LEVEL and not (significant and f.winner):
        text = f"{wander_text(f)} leaves none (p {p_text(f.wander_p)})"
        conditions.append(Condition("structure beside shared noise", f.wander_p, LEVEL, False, text))
        return "NOTHING", conditions
    return "CANNOT_TELL", conditions


def wander_text(f: Findings) -> str:
    """The noise that neighbouring readings share, in words."""
    return f"noise of {percent(f.wander)} of the signal that some {f.memory:.2g} neighbouring readings share"


def _word_of_winner(f: Findings, failed: set[str]) -> str:
    """The word for the winner, given the names of its conditions that failed; '' where it decides nothing."""
    if not failed:
        return "CLAIM"
    refuted = {"held out"} if f.refuted else set()
    if failed & {"significant", "strength", PLAUSIBLE, CLUTTER, *refuted} and not f.structured and not f.weighed:
        # The refit did not bring the fall that the score promised, or the base's own calibration brought it; or the
        # strength scatters as much between parts of the data, or is too far from neutral for what it explains; or
        # frames that took no part do not know of it.
        return "NOTHING"
    bars = {"share", CLUTTER, "near", LIGHT}  # what is no tie between causes
    if not f.shared:  # where it is, noise is one of those that tie: that an effect gains little over it is no bar
        bars.add("significant")
    if f.curve_lead > TOLD:
        bars.add("no better curve")
    alone = not failed & bars
    alone = alone and not f.another_law and not f.another_value
    rivals = f.survivors > 1 or f.shared or failed & {LAW, KEPT} or bool(f.fragile) or bool(f.unset) or bool(f.untried)
    if failed & {"lead", LAW, KEPT, "robust", DIALS, RIVALS, NO_DETAIL} and alone and f.some_even and rivals:
        return "AMBIGUOUS"
    some = failed - {"spread", NO_DETAIL, *(() if f.another_value else (KEPT,))}
    return "PARTIAL" if some and some <= {"share", HOMOGENEITY} else ""


def _is_anything_there(f: Findings, significant: bool) -> list[Condition]:
    """Whether an effect stands out, and whether structure is left: if neither, nothing is missing."""
    if math.isnan(f.structure_p):
        structure = (
            f"too few readings, or too small images, to show any; excess {f.excess_sd:.2g} sd against {EXCESS:g}"
        )
    else:
        structure = f"test of structure p {p_text(f.structure_p)} against {LEVEL:g}"
        if f.measured and f.weighed:
            structure += f"; excess {f.excess_sd:.2g} sd over a noise that repeats have measured"
    return [
        Condition(
            STANDS_OUT,
            f.p_family,
            LEVEL,
            significant,
            f"family-wise p {p_text(f.p_family)} against {LEVEL:g}",
        ),
        Condition("structure is left", f.structure_p, LEVEL, f.structured, structure),
    ]


def _against_effects(f: Findings) -> list[Condition]:
    """The winner against noise and against the explanations without it, after the refit."""
    return [
        Condition(
            "significant", f.p_winner, LEVEL, f.p_winner < LEVEL, f"after refit, family-wise p {p_text(f.p_winner)}"
        ),
        Condition(
            "lead",
            f.lead,
            f.needed,
            f.common and f.lead > f.needed and not f.shared,
            f"{f.lead:.3g} ahead of {f.against or 'no effect'}, {f.needed:.3g} needed"
            if f.common
            else f"the data do not decide between {f.survivors} explanations, and no effect is part of all",
        ),
        _unless(
            f.detail_of,
            NO_DETAIL,
            f"it may be a detail of {f.detail_of}, which explains nearly all without it and is not decided",
            "nothing that is not decided explains nearly all without it",
        ),
        _unless(f.fragile, "robust", f"other weights or masks prefer {f.fragile}", "other weights and masks agree"),
        Condition(
            RIVALS,
            float(len(f.untried)),
            0.0,
            not f.untried,
            f"by scores {_first_of(f.untried)} may explain more, and {'was' if len(f.untried) == 1 else 'were'} not "
            "calibrated"
            if f.untried
            else "every pair that may explain more by its score was calibrated",
        ),
    ]


def _unless(found: str, name: str, text: str, otherwise: str) -> Condition:
    """A condition that holds unless something was found, with the text for either case."""
    return Condition(name, float(bool(found)), 0.0, not found, text if found else otherwise)


def _first_of(names: Sequence[str]) -> str:
    """'a with b, and 3 more pairs'."""
    more = len(names) - 1
    return names[0] + (f", and {more} more pair{'s' * (more > 1)}," if more else "")


def _against_causes_outside(f: Findings) -> list[Condition]:
    """The winner against causes that are not in the library: curves, the rest of the misfit, a wrong set-up."""
    limit = allowed(f.coordinate)
    return [
        Condition(
            "no better curve",
            f.ratio,
            limit,
            not f.rival,
            f"the best curve ({f.coordinate or 'none'}) explains {f.ratio:.2f} times as much as the best explanation, "
            + (f"{limit:g} allowed" if f.rival or f.ratio < limit else "but not after the cost of its bins"),
        ),
        Condition(
            LAW,
            f.law_lead,
            SURE,
            f.law_lead > SURE,
            f"{f.law_lead:.3g} ahead of a freer law of {f.law}, {SURE:.3g} needed"
            if f.law
            else "no freer law of an added effect explains it",
        ),
        _kept(f),
        _unless(
            f.unset,
            DIALS,
            f"errors of {f.unset}, which captures do not state, act on every frame too: give them under [uncertainty]",
            "no error of a dial that nobody states acts as it does",
        ),
        _unless(
            f.run_away,
            LIGHT,
            f"{f.run_away}: the model lets almost none of that light through, so an effect may lead only because of "
            "this power. Give the power a prior (--prior)",
            "no power stands apart from the others",
        ),
        Condition(
            "share",
            f.share,
            SHARE,
            not f.weighed or f.share > SHARE,
            f"{f.share:.0%} of the excess explained, {SHARE:.0%} needed"
            if f.weighed
            else f"not asked for: the excess is {f.excess_sd:.2g} sd, "
            + ("without structure, as of a noise that is stated too small" if f.misstated else f"below {EXCESS:g}"),
        ),
        Condition(
            "near",
            f.left,
            FAR,
            not f.left > FAR,
            f"with it the model still misses the images by {percent(f.left)} of their mean, {FAR:.0%} allowed",
        ),
    ]


def _kept(f: Findings) -> Condition:
    """The winner against values that the calibration keeps."""
    text = (
        f"{f.fixed_lead:.3g} ahead of another value of {f.fixed}, {f.fixed_needed:.3g} needed"
        if f.fixed
        else "none that the calibration keeps and that was asked about does as well"
    )
    return Condition(KEPT, f.fixed_lead, f.fixed_needed, f.fixed_lead > f.fixed_needed, text)


def _of_the_strength(f: Findings) -> list[Condition]:
    """Whether the winner's strength is real: above its error and its scatter, homogeneous, good for other frames."""
    found = [
        Condition(
            "strength",
            f.clear,
            STRENGTH,
            not f.clear < STRENGTH,
            "its error is unknown" if math.isnan(f.clear) else f"{f.clear:.2g} sd from none, {STRENGTH:g} needed",
        ),
        Condition(
            PLAUSIBLE,
            f.adds,
            f.priced,
            not f.adds < f.priced,
            f"it adds {f.adds:.3g} to the fall of chi2, and {f.far:.2g} plausible sizes cost {max(f.priced, 0.0):.3g}",
        ),
        Condition(
            "range",
            f.far,
            IMPOSSIBLE,
            not f.far > IMPOSSIBLE or (not f.at_end and (f.complete or not f.ran)),
            f"{f.far:.2g} times the plausible strength"
            + (f", at the end of its range ({f.at_end})" if f.at_end else "")
            + (f"; without it {f.ran} ran to the end of its range" if f.ran else "")
            + (f"; {IMPOSSIBLE:g} allowed" if f.at_end or (f.ran and not f.complete) else ""),
        ),
        Condition(
            CLUTTER,
            f.chance,
            LEVEL,
            not f.chance >= LEVEL,
            "not applied: readings, or images with too few parts"
            if math.isnan(f.chance)
            else f"p {p_text(f.chance)} by the scatter between parts of the data, against {LEVEL:g}",
        ),
        Condition(
            HOMOGENEITY,
            f.uneven,
            f.uneven_limit,
            f.even,
            "not applied: it explains too little, or the data have no parts to compare"
            if math.isnan(f.uneven)
            else f"splitting its strength{f.uneven_by} gains {f.uneven:.2f} of the fall, {f.uneven_limit:.2g} allowed",
        ),
        Condition(
            "held out",
            f.held_out,
            0.0,
            f.held_out > 0 or (math.isnan(f.held_out) and f.ahead > 0),
            (
                "no frames were held out"
                if math.isnan(f.ahead)
                else "no frames were held out; blocks of readings were left out instead"
            )
            if math.isnan(f.held_out)
            else f"chi2 of held-out frames falls by {f.held_out:.3g}"
            if f.held_out > 0 or f.refuted
            else f"chi2 of held-out frames rises by {-f.held_out:.2g}, too little to refute it, and does not verify it",
        ),
    ]
    if not math.isnan(f.ahead):
        text = f"chi2 of blocks of readings that were left out falls by {f.ahead:.3g}"
        found.append(Condition("blocks left out", f.ahead, 0.0, f.ahead > 0, text))
    if f.carried_by:
        text = f"{f.carried:.0%} of the fall lies in {f.carried_by}, {CARRIED:.0%} allowed"
        found.append(Condition("spread", f.carried, CARRIED, f.carried < CARRIED, text))
    return found


@dataclass(frozen=True)
class Opponent:
    """The explanation that curves are held against.

    fall      net fall of chi2; cost: of its strengths;   strengths, effects: their numbers
    decides   whether small differences decide: it leaves nothing, or has readings to explain, whose noise is known
    complete  whether it leaves nothing that a curve could explain
    """

    fall: float
    cost: float = 0.0
    effects: int = 1
    strengths: int = 1
    complete: bool = False
    decides: bool = False


def rivals(fingerprints: Sequence[Fingerprint], best: Opponent) -> list[Fingerprint]:
    """The curves that do better than an explanation; the one to name first.

    Better by more than `allowed`, significantly, by more than the number of bins gives by noise alone (3 sd), and by
    more than bins could have fitted whatever the data are (`Fingerprint.cost`). Where small differences decide, a
    curve is a rival of one effect if its score is better by TOLD, and of several if it is better: one unknown cause is
    simpler. If it has no more than twice as many numbers as they have strengths, or they are MANY, it is one if it is
    not told apart from them."""
    near = []
    for f in fingerprints:
        as_many = best.effects >= MANY or f.dof <= 2 * best.strengths
        behind = best.fall - best.cost - (f.net - f.cost)
        slack = -TOLD if best.effects == 1 else TOLD if as_many else 0.0
        asked = best.decides and not (best.effects == 1 and best.complete) and f.coordinate not in MIMICS
        if asked and f.p < LEVEL / len(fingerprints) and behind < slack:
            near.append(f)
    if best.complete or near:
        return ordered(near)
    fall = best.fall
    better = [
        f
        for f in fingerprints
        if f.ratio >= allowed(f.coordinate)
        and f.p < LEVEL / len(fingerprints)
        and f.net - fall > 3 * math.sqrt(2 * f.dof) * f.net / (f.fall - f.dof)
        and f.net - f.cost > fall
    ]
    return ordered(better)


def ordered(curves: Sequence[Fingerprint]) -> list[Fingerprint]:
    """Best first, but a curve that can mimic others (MIMICS) after them, where one of them is nearly as good.

    'place', a map of the sensor, and 'reading', one of a session, can mimic every curve that does not move, and 'frame'
    every setting."""
    reach = AS_GOOD * max((f.net for f in curves), default=0.0)
    special = any(f.net > reach for f in curves if f.coordinate not in MIMICS)
    return sorted(curves, key=lambda f: (special and f.coordinate in MIMICS, -f.net))
