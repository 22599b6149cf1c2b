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
    CLEAR,
    EXCESS,
    FAR,
    LEVEL,
    MARGIN,
    MIMICS,
    SHARE,
    STRENGTH,
    UNEVEN,
    allowed,
    is_structured,
)
from optics.words import p_text, percent

CURVE = "a curve explains it"  # name of the condition that a curve must meet for UNKNOWN


@dataclass(frozen=True)
class Findings:
    """The numbers that a verdict is made of. Falls are of chi2, net: less what an absent effect gives on average.

    p_family     of the best of all candidates; structure_p: of low-frequency structure, NaN where there are too few
                 readings, or too small images, to show any
    winner       the effect with the largest fall after a refit, '' if none; p_winner: family-wise, of that fall
    fall, runner_up   of the winner and of the next one
    refuted      with the winner nothing is left to explain, while every effect within the margin leaves structure, or
                 more than could hide beside the winner: the misfit that makes small differences worthless is absent
    ratio        the best curve's fall over the winner's; coordinate: of that curve
    rival        whether a curve does significantly better, by RIVAL (a map) or RIVAL_CURVE
    share        of the excess that the winner explains, where excess_sd > EXCESS; curve_share: that of the best curve
    left         misfit over mean signal with the winner
    uneven       largest h of the winner's splits, by the split uneven_by (in words), uneven_limit allowed; even:
                 whether all its splits hold; some_even: whether those of any member of the ambiguous set do
    held_out     fall on held-out frames, NaN where there are none
    clear        of the winner's strength from none, in standard deviations; NaN where they are unknown
    chance       family-wise p of that strength by its scatter between parts of the sensor or session, NaN where there
                 are too few parts
    """

    p_family: float
    structure_p: float
    winner: str = ""
    p_winner: float = 1.0
    fall: float = 0.0
    runner_up: float = 0.0
    refuted: bool = False
    ratio: float = 0.0
    rival: bool = False
    coordinate: str = ""
    share: float = math.nan
    curve_share: float = math.nan
    left: float = math.nan
    excess_sd: float = 0.0
    uneven: float = 0.0
    uneven_by: str = ""
    uneven_limit: float = UNEVEN
    even: bool = True
    some_even: bool = True
    held_out: float = math.nan
    clear: float = math.nan
    chance: float = math.nan

    @property
    def structured(self) -> bool:
        """Whether the base model leaves low-frequency structure."""
        return is_structured(self.structure_p, self.excess_sd)

    @property
    def weighed(self) -> bool:
        """Whether the base model leaves an excess, of which an effect or a curve explains a share."""
        return self.excess_sd > EXCESS


def decide(f: Findings) -> tuple[str, list[Condition]]:
    """One of the six words, and the conditions that it rests on."""
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
            Condition("significant", 1.0, LEVEL, False, "no refit brought the fall that the score promised")
        )
        if not f.structured and not f.weighed:
            return "NOTHING", conditions
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
    return "CANNOT_TELL", conditions


def _word_of_winner(f: Findings, failed: set[str]) -> str:
    """The word for the winner, given the names of its conditions that failed; '' where it decides nothing."""
    if not failed:
        return "CLAIM"
    if failed & {"significant", "strength"} and not f.structured and not f.weighed:
        # The refit did not bring the fall that the score promised, or the base's own calibration brought it.
        return "NOTHING"
    alone = not failed & {"significant", "no better curve", "share", "beyond clutter", "near"}
    if failed & {"lead", "margin"} and alone and f.some_even:
        return "AMBIGUOUS"
    return "PARTIAL" if failed <= {"share", "even"} else ""


def _is_anything_there(f: Findings, significant: bool) -> list[Condition]:
    """Whether an effect stands out, and whether structure is left: if neither, nothing is missing."""
    return [
        Condition(
            "an effect stands out",
            f.p_family,
            LEVEL,
            significant,
            f"family-wise p {p_text(f.p_family)} against {LEVEL:g}",
        ),
        Condition(
            "structure is left",
            f.structure_p,
            LEVEL,
            f.structured,
            f"too few readings, or too small images, to show any; excess {f.excess_sd:.2g} sd against {EXCESS:g}"
            if math.isnan(f.structure_p)
            else f"low-frequency test p {p_text(f.structure_p)} against {LEVEL:g}",
        ),
    ]


def _against_effects(f: Findings) -> list[Condition]:
    """The winner against noise and against the other effects, after the refit."""
    lead = f.fall - f.runner_up
    margin = lead / f.fall if f.fall > 0 else 0.0
    return [
        Condition(
            "significant", f.p_winner, LEVEL, f.p_winner < LEVEL, f"after refit, family-wise p {p_text(f.p_winner)}"
        ),
        Condition(
            "lead", lead, CLEAR, lead > CLEAR, f"chi2 falls by {lead:.3g} more than with the next, {CLEAR:g} needed"
        ),
        Condition(
            "margin",
            margin,
            MARGIN,
            margin > MARGIN or f.refuted,
            f"{margin:.0%} ahead of the next, "
            + (
                "which leaves more than could hide beside the best"
                if f.refuted and margin <= MARGIN
                else f"{MARGIN:.0%} needed"
            ),
        ),
    ]


def _against_causes_outside(f: Findings) -> list[Condition]:
    """The winner against causes that are not in the library: curves, the rest of the misfit, a wrong set-up."""
    limit = allowed(f.coordinate)
    return [
        Condition(
            "no better curve",
            f.ratio,
            limit,
            not f.rival,
            f"the best curve ({f.coordinate or 'none'}) explains {f.ratio:.2f} of it, {limit:g} allowed",
        ),
        Condition(
            "share",
            f.share,
            SHARE,
            not f.weighed or f.share > SHARE,
            f"{f.share:.0%} of the excess explained, {SHARE:.0%} needed"
            if f.weighed
            else f"not asked for: the excess is {f.excess_sd:.2g} sd, below {EXCESS:g}",
        ),
        Condition(
            "near",
            f.left,
            FAR,
            not f.left > FAR,
            f"with it the model still misses the images by {percent(f.left)} of their mean, {FAR:.0%} allowed",
        ),
    ]


def _of_the_strength(f: Findings) -> list[Condition]:
    """Whether the winner's strength is real: above its error and its scatter, homogeneous, good for other frames."""
    return [
        Condition(
            "strength",
            f.clear,
            STRENGTH,
            not f.clear < STRENGTH,
            "its error is unknown" if math.isnan(f.clear) else f"{f.clear:.2g} sd from none, {STRENGTH:g} needed",
        ),
        Condition(
            "beyond clutter",
            f.chance,
            LEVEL,
            not f.chance >= LEVEL,
            "too few parts of the data to tell"
            if math.isnan(f.chance)
            else f"family-wise p {p_text(f.chance)} by the scatter between parts of the data, against {LEVEL:g}",
        ),
        Condition(
            "even",
            f.uneven,
            f.uneven_limit,
            f.even,
            f"splitting its strength{f.uneven_by} gains {f.uneven:.2f} of the fall, {f.uneven_limit:.2g} allowed",
        ),
        Condition(
            "held out",
            f.held_out,
            0.0,
            f.held_out > 0,
            "no frames were held out"
            if math.isnan(f.held_out)
            else f"chi2 of held-out frames falls by {f.held_out:.3g}",
        ),
    ]


def rivals(fingerprints: Sequence[Fingerprint], fall: float) -> list[Fingerprint]:
    """The curves that do better than an effect with this net fall; the one to name first.

    Better by more than `allowed`, significantly, and by more than the number of bins gives by noise alone (3 sd)."""
    better = [
        f
        for f in fingerprints
        if f.ratio >= allowed(f.coordinate)
        and f.p < LEVEL / len(fingerprints)
        and f.net - fall > 3 * math.sqrt(2 * f.dof) * f.net / (f.fall - f.dof)
    ]
    return ordered(better)


def ordered(curves: Sequence[Fingerprint]) -> list[Fingerprint]:
    """Best first, but a curve that can mimic others (MIMICS) after them, where one of them is nearly as good.

    'place', a map of the sensor, and 'reading', one of a session, can mimic every curve that does not move, and 'frame'
    every setting."""
    reach = AS_GOOD * max((f.net for f in curves), default=0.0)
    special = any(f.net > reach for f in curves if f.coordinate not in MIMICS)
    return sorted(curves, key=lambda f: (special and f.coordinate in MIMICS, -f.net))
