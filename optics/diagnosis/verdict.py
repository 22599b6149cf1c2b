"""A diagnosis as a result: its table, its verdict in one of six words, and how it reads.

    NOTHING      no effect stands out among all that were tested, and no low-frequency structure is left
    CLAIM        one effect stands out by a margin, after everything was calibrated again with it; no curve along a
                 coordinate does better; its strength is the same everywhere; frames that were not fitted improve
    AMBIGUOUS    several effects explain the residual about equally well: the set, and what would tell them apart
    PARTIAL      an effect explains a part; the rest, or the inhomogeneity of its strength, has another cause
    UNKNOWN      a curve along a coordinate (radius, height, ...) explains more than any effect: the curve
    CANNOT_TELL  none of these; which condition failed and what would decide

Only a CLAIM names a cause. Significance alone is not a verdict: on a real sensor a little of everything is significant.
Fractions are fractions throughout (0.01 is 1 %); text shows per cent."""

from __future__ import annotations

import csv
import io
import json
import math
import typing
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from optics.diagnosis import showing
from optics.errors import Underdetermined
from optics.fit.compare import plain
from optics.words import p_text, percent, spaced, table, with_sd

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEVEL = 0.01  # nominal level of the family-wise test and of the structure test
CLEAR = 10.8  # chi2 between two effects at which the right one wins in 95 % of cases: Phi(sqrt(10.8)/2)
MARGIN = 0.2  # of the best effect's fall: with real misfit, chi2 differences below it decide nothing
# a map of the sensor or of the session that explains this much more than the best effect says: not this effect ...
RIVAL = 1.5
# ... and a curve along one coordinate: with a true effect it gains only what clutter adds (measured: 1.02; 1.2 with a
# false one)
RIVAL_CURVE = 1.12
SHARE = 0.05  # of the excess misfit that a claimed effect must explain ...
EXCESS = 5.0  # ... where there is an excess of this many standard deviations at all
UNEVEN = 0.1  # of the fall: what splitting the strength by channel, frame, ... may still gain
STRENGTH = 2.0  # standard deviations that a claimed strength must differ from none by: a fall without it is another's
MAPS = ("place", "reading")  # where, or when, whatever the cause: a fine map mimics every curve that does not move
MIMICS = (*MAPS, "frame")
AT_FAULT = "units, LEDs that were off, black_level, and that images are linear (not encoded for viewing) and whole, with row 0 at the top"
FAR = 0.3  # misfit over mean signal: beyond what effects of a sensor leave
# of the signal: misfit as of the fixed pattern alone in a good sensor (optics.proof, clutter 1), whose coating adds 1 %
# of mottle
CLUTTERED = 0.005
HIDDEN = 2.0  # standard deviations of excess misfit that may hide beside an effect which seems to leave none
AS_GOOD = 0.8  # of the best curve's fall: what is nearer than that is not told apart from it
PLANS = ("together", "more of the same")  # kinds of advice that are several shots
TELLS = 0.02  # gain of P(correct) below which a shot is not worth a line
CURVE = "a curve explains it"
NAMED = ("CLAIM", "PARTIAL", "AMBIGUOUS")  # words that name effects
WORDS = ("NOTHING", "CLAIM", "AMBIGUOUS", "PARTIAL", "UNKNOWN", "CANNOT_TELL")


# -- the result -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Condition:
    """One of the numbers that decided: it holds when `value` is on the right side of `limit`."""

    name: str
    value: float
    limit: float
    holds: bool
    text: str


@dataclass(frozen=True)
class Refit:
    """An effect added and refitted, everything calibrated again.

    fall, predicted  of chi2, with the weights of the base model; ratio: fall / predicted
    strength, sd     per variable, in its unit, with noise and `clutter`; at_bound: variables that ended at a bound
    excess_sd, structure_p   what is left with it: excess misfit, and the test of low-frequency structure
    """

    fall: float
    predicted: float
    ratio: float
    chi2_before: float
    chi2_after: float
    strength: list[float]
    sd: list[float]
    at_bound: list[str]
    excess_sd: float
    structure_p: float
    converged: bool
    reason: str
    clear: float = (
        math.nan
    )  # of its strength from where it started, in standard deviations of all its variables together
    chance: float = (
        math.nan
    )  # family-wise p of its strength by the scatter between parts of the sensor or session; NaN: not asked, or too few
    clutter: list[list[float]] = field(
        default_factory=list
    )  # covariance of the strengths by that scatter, beyond noise; it is in sd. Empty: none

    @property
    def complete(self) -> bool:
        """Whether nothing is left to explain."""
        return self.excess_sd < EXCESS and not is_structured(self.structure_p, self.excess_sd)


@dataclass
class Pair:
    """Two effects that were added together: fall of chi2, and what is left (as in Refit); but: what speaks against one
    of them."""

    effects: list[str]
    fall: float
    excess_sd: float
    structure_p: float
    but: str = ""

    @property
    def complete(self) -> bool:
        """Whether nothing is left to explain, nor speaks against either."""
        return not self.but and Refit.complete.fget(self)


@dataclass
class Row:
    """What was found about one effect. Fractions are fractions (0.01 is 1 %).

    fall         T, predicted fall of chi2; expected: its mean when the effect is absent
    p, p_family  for this effect alone under ideal noise; for the best of all candidates
    change, sd   expected change of each strength from its start; of_plausible: the largest, in plausible sizes
    image        raw change of the image by it, rms over mean signal, before any calibration
    misfit_after predicted misfit, in units of the mean signal; share: of the excess, NaN within noise
    survival     how much of the effect a calibration leaves visible
    power        probability to notice a tenth of the plausible strength
    kappa        noise over signal per pixel of its derivative images
    upper        upper limit of the absolute change, |change| + 2 sd, the sd widened by sqrt(phi) where there is misfit;
                 after a claim, with the claimed effect in the model
    """

    name: str
    variables: list[str]
    units: list[str]
    form: str
    fall: float
    expected: float
    p: float
    p_family: float
    start: list[float]
    change: list[float]
    sd: list[float]
    of_plausible: float
    image: float
    misfit_after: float
    share: float
    survival: float
    power: float
    kappa: float
    confused_with: str
    cos: float
    upper: list[float]
    refit: Refit | None = None
    flags: list[str] = field(default_factory=list)
    verdict: str = ""

    @property
    def net(self) -> float:
        """Fall beyond what chance gives: comparable between effects with one and with many strengths."""
        return self.fall - self.expected

    @property
    def net_refit(self) -> float:
        return -math.inf if self.refit is None else self.refit.fall - self.expected


@dataclass(frozen=True)
class Split:
    """The strength of an effect in parts of the data, relative to its strength in all of it (1 everywhere if it is
    true).

    h       fall of chi2 by splitting, less chance, over the effect's own fall; p under ideal noise; chance: p by the
            scatter that clutter
            makes between parts of the data, NaN where it is not known
    limit   h that is allowed, by what noise and clutter make; holds: whether h is within it
    """

    effect: str
    by: str
    labels: list[str]
    strength: list[float]
    sd: list[float]
    fall: float
    dof: int
    p: float
    h: float
    chance: float
    limit: float
    holds: bool


@dataclass(frozen=True)
class Fingerprint:
    """The residual as a curve along one coordinate, what calibration absorbs taken out.

    fall, dof   of chi2 with a gain and an offset per bin; net: fall less dof; ratio: net over the best effect's fall
    kind        'gain' (curve: relative change of the signal) or 'offset' (curve: DN), whichever explains more
    labels      names in place of centres for frame and channel; cells of 'place' run row by row
    family      what the coordinate belongs to (optics.diagnosis.fingerprints); share: of the excess misfit, NaN within
                noise; unit: of the centres
    """

    coordinate: str
    fall: float
    dof: int
    p: float
    net: float
    ratio: float
    kind: str
    centres: list[float]
    curve: list[float]
    sd: list[float]
    labels: list[str]
    family: str = ""
    share: float = math.nan
    unit: str = ""


@dataclass(frozen=True)
class Family:
    """The best curve of the coordinates that belong together: camera, light, geometry, time, or a setting.

    share    of the excess misfit, NaN within noise; of_best: of the fall that the best family's curve has
    """

    family: str
    coordinate: str
    net: float
    share: float
    of_best: float


@dataclass(frozen=True)
class Level:
    """Misfit (in units of the mean signal) and chi2 per value of a model on fitted and on held-out frames.

    fall, frames_better   against the base model on held-out frames, less chance
    """

    model: str
    fitted: float
    held_out: float
    chi2_fitted: float
    chi2_held_out: float
    n_fitted: int
    n_held_out: int
    fall: float
    frames_better: int
    frames: int


@dataclass(frozen=True)
class Shift:
    """How far a calibrated parameter had moved to hide an effect: its value with the effect less that without."""

    effect: str
    variable: str
    unit: str
    before: float
    after: float
    in_sd: float
    warn: bool


@dataclass(frozen=True)
class Apart:
    """D, the expected chi2 by which the data would prefer `effect`, if true, over `rival`; and P(correct) =
    Phi(sqrt(D)/2).

    share_before, share_after   D over the fall by the effect itself, where misfit is left and a verdict asks for MARGIN
                                of it; else NaN
    """

    effect: str
    rival: str
    before: float
    after: float
    correct_before: float
    correct_after: float
    share_before: float = math.nan
    share_after: float = math.nan

    @property
    def told(self) -> bool:
        """Whether it makes a difference to what can be decided."""
        return self.correct_after - self.correct_before > TELLS or self.share_before < MARGIN <= self.share_after


@dataclass(frozen=True)
class Advice:
    """A frame that could be taken, or several, simulated: what it would tell apart (optics.diagnosis.advice).

    shot       in words; family: its kind, 'together' for the best few and 'more of the same' for as many others to
               compare with
    settings   of each frame, by key: what differs from a frame that exists; press: name of a new press, '' for the same
    frames     how many it takes
    pairs      hardest first
    nuisances  unknowns that it brings, which were projected off with what is known of them beforehand
    """

    shot: str
    family: str
    settings: list[dict[str, float]]
    press: list[str]
    frames: int
    pairs: list[Apart]
    nuisances: list[str]

    @property
    def hardest(self) -> Apart:
        """The pair that is hardest to tell apart without it."""
        return self.pairs[0]

    @property
    def least(self) -> float:
        """The smallest D between any two with it."""
        return min(p.after for p in self.pairs)


@dataclass(frozen=True)
class Basis:
    """What the verdict rests on: data, masks, noise, misfit. Misfit and noise in units of the mean signal.

    phi        chi2 / dof; excess_sd: (chi2 - dof) / sqrt(2 dof)
    thinning   every k-th pixel served for curves, splits and weights; the ranking itself uses all pixels
    gradient   |Q'r|^2 per parameter: below 1 the base is calibrated
    structure_*  F and p of the low-frequency structure; high_frequency: 1 where the noise model is right
    render_noise variance of the prediction's Monte Carlo noise over that of the measurement, added to it
    """

    frames: int
    values: int
    masked: float
    not_finite: int
    thinning: int
    signal: float
    noise: float
    misfit: float
    chi2: float
    dof: int
    rank: int
    phi: float
    excess_sd: float
    gradient: float
    structure_f: float
    structure_p: float
    high_frequency: float
    render_noise: float
    frame_names: list[str]
    frame_phi: list[float]


@dataclass
class Diagnosis:
    """The table, the verdict and everything behind them. `text`, `to_csv` and `to_json` are views of the same
    numbers."""

    word: str
    sentence: str
    conditions: list[Condition]
    basis: Basis
    rows: list[Row]
    ambiguous: list[str]
    compared: list[str]
    gaps: list[list[float]]
    correct: list[list[float]]
    splits: list[Split]
    levels: list[Level]
    fingerprints: list[Fingerprint]
    shifts: list[Shift]
    hints: list[str]
    not_tested: dict[str, str]
    warnings: list[str]
    claimed: str = ""
    pairs: list[Pair] = field(default_factory=list)  # of effects that were tried together (optics.diagnosis.pairs)
    advice: list[Advice] = field(default_factory=list)  # what to measure next (optics.diagnosis.advice)
    families: list[Family] = field(default_factory=list)  # what the residual goes with, best first
    fits: dict = field(default_factory=dict, repr=False, compare=False)  # effect -> Fit of the refit; not written
    evidence: object = field(
        default=None, repr=False, compare=False
    )  # optics.diagnosis.evidence.Evidence, without pixels; not written

    def __post_init__(self):
        if self.word not in WORDS:
            raise ValueError(f"verdict {self.word!r} is none of {', '.join(WORDS)}")
        if (self.word == "CLAIM") != bool(self.claimed):
            raise ValueError(f"verdict {self.word}: only a CLAIM names a cause, and always one; got {self.claimed!r}")

    @property
    def missing(self) -> str:
        """Name of the missing effect, under CLAIM; anything else raises Underdetermined."""
        if self.word != "CLAIM":
            raise Underdetermined(f"{self.word}: no cause is established, so none is named. {self.sentence}")
        return self.claimed

    def row(self, effect: str) -> Row:
        for row in self.rows:
            if row.name == effect:
                return row
        raise KeyError(f"no effect '{effect}' in the table; tested: {', '.join(r.name for r in self.rows)}")

    def to_dict(self) -> dict:
        return plain(
            {f.name: _record(getattr(self, f.name)) for f in fields(self) if f.name not in ("fits", "evidence")}
        )

    def to_json(self) -> str:
        return json.dumps(self.to_dict(), indent=1, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> Diagnosis:
        return _restore(cls, json.loads(text))

    def to_csv(self) -> str:
        """One line per effect, as in `text`; several strengths of an effect are separated by ';'."""
        names = [f.name for f in fields(Row) if f.name != "refit"]
        names += [f"refit_{f.name}" for f in fields(Refit)]
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(names)
        for row in self.rows:
            cells = {f.name: getattr(row, f.name) for f in fields(Row)}
            if row.refit is not None:
                cells.update({f"refit_{k}": v for k, v in asdict(row.refit).items()})
            writer.writerow([_cell(cells.get(name)) for name in names])
        return out.getvalue()

    def text(self, width: int = 0) -> str:
        """The report for a terminal."""
        return _text(self)

    def records(self) -> list[dict[str, Any]]:
        """One record per effect (optics.diagnosis.showing.records)."""
        return showing.records(self)

    def plot(self) -> Figure:
        """A chart of the ranking and of curves along coordinates (optics.diagnosis.showing.plot)."""
        return showing.plot(self)

    def _repr_html_(self) -> str:
        return showing.html(self)


def _record(value):
    if is_dataclass(value):
        return asdict(value)
    if isinstance(value, list):
        return [_record(v) for v in value]
    return value


def _restore(kind, data):
    """The inverse of `plain` for the dataclasses of this file: None is NaN where a number is due."""
    if data is None:
        return math.nan if kind is float else None
    if is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        return kind(**{name: _restore(hints[name], value) for name, value in data.items()})
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is list:
        return [_restore(arguments[0], value) for value in data]
    if origin is dict and arguments:
        return {key: _restore(arguments[1], value) for key, value in data.items()}
    if arguments and type(None) in arguments:
        return _restore(arguments[0], data)
    return float(data) if kind is float else data


def _cell(value) -> str:
    if isinstance(value, list):
        return ";".join(_cell(v) for v in value)
    if isinstance(value, float):
        return "" if math.isnan(value) else repr(value)
    return "" if value is None else str(value)


# -- verdict ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Findings:
    """The numbers that a verdict is made of.

    p_family     of the best of all candidates; structure_p: of low-frequency structure (NaN: too few readings, or
                 images too small, to show any)
    winner       the effect with the largest fall after refit, '' if none; p_winner: family-wise, of that fall
    fall, runner_up   net falls of the winner and of the next one
    refuted      with the winner nothing is left to explain, and every effect within the margin leaves structure behind,
                 or more
                 than could hide beside the winner: the misfit that makes small differences worthless is then not there
    ratio        the best curve's net fall over the winner's
    rival        a curve does better by RIVAL (a map) or RIVAL_CURVE, significantly
    share        of the excess, where excess_sd > EXCESS; curve_share: that of the best curve
    left         misfit over mean signal with the winner
    uneven       largest h of the winner, uneven_by: its split, in words; even: whether all splits hold; some_even:
                 whether
                 those of any member of the ambiguous set do
    held_out     net fall on held-out frames, NaN where there are none
    clear        of the winner's strength from none, in standard deviations; NaN where they are not known
    chance       family-wise p of that strength by its scatter between parts of the sensor or session, NaN where these
                 are too few
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


def is_structured(structure_p: float, excess_sd: float) -> bool:
    """Whether something is left: low-frequency structure, or an excess where images are too small to show structure."""
    return excess_sd > EXCESS if math.isnan(structure_p) else structure_p < LEVEL


def decide(f: Findings) -> tuple[str, list[Condition]]:
    """One of the six words, and the conditions that it rests on."""
    structure = is_structured(f.structure_p, f.excess_sd)
    significant = f.p_family < LEVEL
    conditions = [
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
            structure,
            f"too few readings, or images too small, to show any; excess {f.excess_sd:.2g} sd against {EXCESS:g}"
            if math.isnan(f.structure_p)
            else f"low-frequency test p {p_text(f.structure_p)} against {LEVEL:g}",
        ),
    ]
    if not significant and not structure:
        return "NOTHING", conditions
    weighed = f.excess_sd > EXCESS
    if significant and not f.winner:
        conditions.append(
            Condition(
                "significant", 1.0, LEVEL, False, "no effect that was added brought the fall that its score promised"
            )
        )
        if not structure and not weighed:
            return "NOTHING", conditions
    elif significant:
        lead = f.fall - f.runner_up
        margin = lead / f.fall if f.fall > 0 else 0.0
        rest = [
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
            Condition(
                "no better curve",
                f.ratio,
                allowed(f.coordinate),
                not f.rival,
                f"the best curve ({f.coordinate or 'none'}) explains {f.ratio:.2f} of it, "
                f"{allowed(f.coordinate):g} allowed",
            ),
            Condition(
                "share",
                f.share,
                SHARE,
                not weighed or f.share > SHARE,
                f"{f.share:.0%} of the excess explained, {SHARE:.0%} needed"
                if weighed
                else f"no share is asked of an excess of {f.excess_sd:.2g} sd, below {EXCESS:g}",
            ),
            Condition(
                "near",
                f.left,
                FAR,
                not f.left > FAR,
                f"with it the model still misses the images by {percent(f.left)} of their mean, {FAR:.0%} allowed",
            ),
            Condition(
                "strength",
                f.clear,
                STRENGTH,
                not f.clear < STRENGTH,
                "its error is not known" if math.isnan(f.clear) else f"{f.clear:.2g} sd from none, {STRENGTH:g} needed",
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
        conditions += rest
        failed = {c.name for c in rest if not c.holds}
        if not failed:
            return "CLAIM", conditions
        if failed & {"significant", "strength"} and not structure and not weighed:
            return (
                "NOTHING",
                conditions,
                # no refit brought the fall that the score promised, or the base's calibration did; and nothing else is left
            )
        if (
            failed & {"lead", "margin"}
            and not failed & {"significant", "no better curve", "share", "beyond clutter", "near"}
            and f.some_even
        ):
            return "AMBIGUOUS", conditions
        if failed <= {"share", "even"}:
            return "PARTIAL", conditions
    if f.rival and structure:
        if not f.curve_share < SHARE:
            return "UNKNOWN", conditions
        conditions.append(
            Condition(
                CURVE,
                f.curve_share,
                SHARE,
                False,
                f"the best one ({f.coordinate}) explains {f.curve_share:.1%} of the excess, {SHARE:.0%} needed: what is left "
                "is spread evenly, as wrong noise spreads it",
            )
        )
    return "CANNOT_TELL", conditions


def close(best: float, other: float) -> bool:
    """Whether two falls are too close to be told apart."""
    return best - other < max(CLEAR, MARGIN * best)


def allowed(coordinate: str) -> float:
    """How many times as much as the best effect a curve along it may explain."""
    return RIVAL if coordinate in MAPS else RIVAL_CURVE


def rivals(fingerprints: Sequence[Fingerprint], fall: float) -> list[Fingerprint]:
    """The curves that do better than an effect with this net fall; the one to name first.

    'place', a map of the sensor, and 'reading', one of a session, can mimic every curve that does not move, and 'frame'
    every setting: they are named where no other curve is nearly as good."""
    better = [
        f
        for f in fingerprints
        if f.ratio >= allowed(f.coordinate)
        and f.p < LEVEL / len(fingerprints)
        and f.net - fall > 3 * math.sqrt(2 * f.dof) * f.net / (f.fall - f.dof)
    ]  # beyond what the number of bins gives by Monte Carlo
    return ordered(better)


def ordered(curves: Sequence[Fingerprint]) -> list[Fingerprint]:
    """Best first, but those that mimic any other stand behind where one of the others is nearly as good."""
    reach = AS_GOOD * max((f.net for f in curves), default=0.0)
    special = any(f.net > reach for f in curves if f.coordinate not in MIMICS)
    return sorted(curves, key=lambda f: (special and f.coordinate in MIMICS, -f.net))


# -- words ------------------------------------------------------------------------------------------------------------


def strength_text(values: Sequence[float], sds: Sequence[float], units: Sequence[str]) -> str:
    unit = spaced(units[0] if units else "")
    if len(values) == 1:
        return with_sd(values[0], sds[0]) + unit
    if len(values) <= 3:
        return ", ".join(with_sd(v, s) for v, s in zip(values, sds)) + unit
    biggest = int(np.argmax(np.abs(values)))
    return f"{len(values)} values up to {with_sd(values[biggest], sds[biggest])}{unit}"


def limit_text(row: Row) -> str:
    limits = [u for u in row.upper if math.isfinite(u)]
    return f"{row.name} < {max(limits):.2g}{spaced(row.units[0])}" if limits else f"{row.name}: nothing visible"


def moved_by(s: Shift) -> str:
    return f"{s.variable} by {abs(s.after - s.before):.2g}{spaced(s.unit)}"


def advice_text(a: Advice) -> str:
    p = a.hardest
    return (
        f"{a.shot}: {'tells' if p.told else 'hardly tells'} {p.effect} from {p.rival}, D {p.before:.3g} "
        f"-> {p.after:.3g}, P(correct) {p.correct_before:.2f} -> {p.correct_after:.2f}"
        + (
            ""
            if math.isnan(p.share_after)
            else f", D over the fall {percent(p.share_before)} -> {percent(p.share_after)} "
            f"({percent(MARGIN)} needed while misfit is left)"
        )
        + (f"; the closest two then have D {a.least:.3g}" if a.least < min(0.9 * p.after, 4 * CLEAR) else "")
    )


def advice_lines(advice: Sequence[Advice]) -> list[str]:
    """The best shots together, for comparison as many others, and the best of each kind by themselves where they tell
    anything."""
    plans = {a.family: a for a in advice if a.family in PLANS}
    singles = [a for a in advice if a.family not in PLANS]
    lines = [f"next: {advice_text(plans['together'])}"] if "together" in plans else []
    if "more of the same" in plans:
        lines.append(f"      (more of the same instead: {advice_text(plans['more of the same'])})")
    known = {a.shot for a in plans.values()}
    return (
        lines + [f"next, or by itself: {advice_text(a)}" for a in singles if a.shot not in known and a.hardest.told][:4]
    )


def sentence(
    word: str,
    conditions: Sequence[Condition],
    f: Findings,
    rows: Sequence[Row],
    members: Sequence[Row],
    fingerprints: Sequence[Fingerprint],
    levels: Sequence[Level],
    shifts: Sequence[Shift],
    basis: Basis,
) -> str:
    """The verdict in words, with the numbers that decided it."""
    winner = next((row for row in rows if row.name == f.winner), None)
    failing = [c for c in conditions if not c.holds and c.name != "structure is left"]
    if word == "NOTHING":
        tail = (
            "no low-frequency structure is left"
            if not math.isnan(f.structure_p)
            else f"no excess misfit is left ({f.excess_sd:.2g} sd)"
        )
        how = (
            f"family-wise p {p_text(f.p_family)}"
            if not f.p_family < LEVEL
            else f"after refit, family-wise p {p_text(f.p_winner)}"
            if not f.p_winner < LEVEL
            else f"after refit, the best, {f.winner}, has a strength of {f.clear:.2g} sd"
        )
        return (
            f"none of {len(rows)} effects stands out ({how}) and {tail}"
            f"{'' if math.isnan(f.structure_p) else f' (p {p_text(f.structure_p)})'}. "
            "The upper limits say what can still hide."
        )
    if word == "CLAIM":
        row, refit = winner, winner.refit
        base, added = levels[0], levels[-1]
        text = (
            f"{row.name} is missing, strength {strength_text(refit.strength, refit.sd, row.units)}. Adding it lowers held-out "
            f"misfit from {percent(base.held_out)} to {percent(added.held_out)} (noise: {percent(basis.noise)}). "
            "Its strength is the same in every part of the data."
        )
        others = [r for r in rows if r is not winner and any(math.isfinite(u) for u in r.upper)]
        if others:
            text += " Not " + ", not ".join(limit_text(r) for r in others[:3]) + "."
        moved = [s for s in shifts if s.warn][:2]
        if moved:
            text += " Before, " + " and ".join(moved_by(s).replace(" by ", " stood ", 1) + " off" for s in moved) + "."
        text += (
            " With it nothing is left to explain."
            if refit.complete
            else f" With it an excess of {refit.excess_sd:.2g} sd and structure (p {p_text(refit.structure_p)}) are left: add it, "
            "calibrate and diagnose again."
        )
        if "fragile" in row.flags:
            text += " Fragile: other weights or masks prefer another effect."
        return text + (
            " Falling held-out error verifies the prediction, not the identity; the identity rests on the margin "
            f"({f.fall - f.runner_up:.3g} in chi2), the homogeneity and the absence of a better curve."
        )
    if word == "AMBIGUOUS":
        names = ", ".join(f"{row.name} ({row.refit.fall:.3g})" for row in members)
        if len(members) < 2:
            names += " and at least one that was not added"
        return (
            f"these explain the residual about equally well (fall of chi2): {names}. The data cannot tell them apart."
        )
    if word == "PARTIAL":
        share = f.share if math.isfinite(f.share) else math.nan
        if "even" in {c.name for c in failing}:
            uneven = next(c for c in conditions if c.name == "even")
            part = f"{share:.0%} of the excess" if f.excess_sd > EXCESS else "part of the residual"
            return (
                f"{winner.name} would explain {part}, but not with one strength ({uneven.text}): it stands in for "
                "another cause, or comes with one."
            )
        return f"{winner.name} explains {share:.0%} of the excess misfit, {1 - share:.0%} has another cause."
    if word == "UNKNOWN":
        curve = next(c for c in fingerprints if c.coordinate == f.coordinate)
        best = f"{f.ratio:.3g} times as much as the best effect" if f.winner else "what no effect does"
        i = int(np.argmax(np.abs(curve.curve)))
        size = percent(curve.curve[i]) if curve.kind == "gain" else f"{curve.curve[i]:.2g} DN"
        where = curve.labels[i] if curve.labels else f"{curve.coordinate} {curve.centres[i]:.3g}{spaced(curve.unit)}"
        text = (
            f"structure is left that depends on '{curve.coordinate}': a curve along it explains {best}. "
            f"As {'a gain' if curve.kind == 'gain' else 'an offset'}, it is largest at {where}: {size}. No effect of the library has this shape."
        )
        if (beyond := math.sqrt(max(basis.misfit**2 - basis.noise**2, 0.0))) < CLUTTERED:
            text += (
                f" It is faint: misfit beyond noise is {percent(beyond)} of the signal, which mottle of a coating or a fixed pattern of the sensor "
                "makes as well."
            )
        return text
    last = [c for c in failing if c.name == CURVE]  # says more than all others together
    reasons = "; ".join(f"{c.name}: {c.text}" for c in last or failing) or "; ".join(c.text for c in conditions)
    return f"something is left, but no verdict holds ({reasons})."


def _text(d: Diagnosis) -> str:
    b = d.basis
    values = f"{b.values:,}".replace(",", " ")
    thinned = f"; 1 in {b.thinning} pixels for curves and splits" if b.thinning > 1 else ""
    lines = [
        f"diagnose: {b.frames} frames, {values} values used ({percent(b.masked)} masked{thinned}), noise "
        f"{percent(b.noise)}, misfit {percent(b.misfit)}, excess {b.excess_sd:.3g} sd"
    ]
    lines += [f"{d.word.replace('_', ' ')}: {d.sentence}", ""]
    shown = [r for r in d.rows if r.p_family < LEVEL or r.refit is not None]
    head = (
        "effect",
        "T",
        "p_fam",
        "strength (1 sd)",
        "of plausible",
        "image",
        "misfit->",
        "explains",
        "visible",
        "refit T",
        "confused with",
        "verdict",
    )
    body = []
    for r in shown:
        now, sd = (r.refit.strength, r.refit.sd) if r.refit else ([a + c for a, c in zip(r.start, r.change)], r.sd)
        note = ", ".join([x for x in (r.verdict, *r.flags) if x])
        if r.verdict == "MISSING":
            held = "yes" if d.levels[-1].fall > 0 else "no"
            note += f" (even: yes, held out: {held})"
        body.append(
            (
                r.name,
                f"{r.fall:.4g}",
                p_text(r.p_family),
                strength_text(now, sd, r.units),
                f"{r.of_plausible:.2g}",
                percent(r.image),
                percent(r.misfit_after),
                "-" if math.isnan(r.share) else f"{r.share:.0%}",
                percent(r.survival),
                f"{r.refit.fall:.4g}" if r.refit else "-",
                f"{r.confused_with} (.{min(int(100 * r.cos), 99):02d})" if r.confused_with else "-",
                note,
            )
        )
    if body:
        lines.append(table([head, *body], left=(0, 3, 10, 11)))
    rest = [r for r in d.rows if r.p_family >= LEVEL]
    if rest:
        lines.append("no evidence; upper limits: " + ", ".join(limit_text(r) for r in rest))
    if d.not_tested:
        lines.append("not tested: " + ", ".join(f"{name} ({why})" for name, why in d.not_tested.items()))
    lines += ["", "decided by: " + "; ".join(f"{c.name} {'yes' if c.holds else 'no'} ({c.text})" for c in d.conditions)]
    if d.splits:
        lines += [
            "",
            "homogeneity (strength relative to the whole; h = gain by splitting over the fall; p by noise / by the scatter between parts)",
        ]
        for s in d.splits:
            parts = ", ".join(f"{label} {with_sd(x, sd)}" for label, x, sd in zip(s.labels[:8], s.strength, s.sd))
            lines.append(
                f"  {s.effect} by {s.by}: h {s.h:.3f}, p {p_text(s.p)} / {p_text(s.chance)}{'' if s.holds else '  UNEVEN'}: {parts}"
            )
    if d.levels:
        lines += [
            "",
            f"misfit                 fitted   held out   (noise {percent(b.noise)}; only per-frame variables fitted "
            "on held-out frames)",
        ]
        lines += [
            f"  {level.model:<20} {percent(level.fitted):>7}   {percent(level.held_out):>8}"
            + (
                ""
                if math.isnan(level.fall)
                else f"   chi2 falls by {level.fall:.4g}, {level.frames_better} of {level.frames} frames better"
            )
            for level in d.levels
        ]
        if len(d.levels) > 1 and not math.isnan(d.levels[-1].fall):
            lines.append(
                "  (a falling held-out misfit verifies prediction; it does not prove the identity of the cause)"
            )
    if d.fingerprints:
        lines += ["", "curves along coordinates (fall of chi2 less its number of bins; R = over the best effect)"]
        lines += [
            f"  {f.coordinate:<18} {f.net:10.4g}  R {f.ratio:8.3g}  p {p_text(f.p)}"
            + (f"  {f.family:<8}" if f.family else "")
            + (f"  {f.share:.0%} of the excess" if math.isfinite(f.share) else "")
            for f in d.fingerprints[:8]
        ]
        if d.families:
            lines.append(
                "  best of each family: " + ", ".join(f"{f.family} {f.coordinate} {f.of_best:.2f}" for f in d.families)
            )
    if d.shifts and d.word in NAMED:
        lines += ["", "calibrated parameters had moved to hide it:"]
        lines += [
            f"  {s.variable:<24} {s.before:.5g} -> {s.after:.5g} {s.unit} ({s.in_sd:+.1f} sd)" for s in d.shifts[:6]
        ]
    lines += advice_lines(d.advice)
    lines += [f"next: {hint}" for hint in d.hints]
    lines += [f"warning: {w}" for w in d.warnings]
    return "\n".join(lines) + "\n"
