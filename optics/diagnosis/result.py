"""What a diagnosis is: one of six verdict words, the table of effects and everything that the verdict rests on.

    NOTHING      no effect stands out among all that were tested, or none that is plausible, and no structure is left:
                 no low frequencies, no single strong one, and no bands
    CLAIM        one effect is part of every explanation (set of effects) that a refit of everything does not rule out;
                 no curve along a coordinate does better; its strength is homogeneous; held-out frames improve
    AMBIGUOUS    several explanations are not told apart, and no effect is part of all, or only one that may be a detail
                 of the others: the set, and what would decide
    PARTIAL      an effect explains a part; the rest, or the inhomogeneity of its strength, has another cause
    UNKNOWN      a curve along a coordinate (radius, height, ...) explains more than any effect: the curve
    CANNOT_TELL  none of these: which condition failed, the best explanation so far, and what would decide

Only a CLAIM names a cause. Significance alone is no verdict: on a real sensor many small effects are significant. The
rule is in `optics.diagnosis.decide`, its numbers in `optics.diagnosis.thresholds`, the wording in
`optics.diagnosis.text`. Fractions are fractions (0.01 is 1 %); text shows per cent."""

from __future__ import annotations

import csv
import io
import json
import math
import typing
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from typing import TYPE_CHECKING, Any, cast

from optics.diagnosis import showing
from optics.diagnosis.thresholds import EACH, EXCESS, MARGIN, TELLS, USUAL, is_structured
from optics.errors import Underdetermined
from optics.fit.compare import plain
from optics.words import Reach

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WORDS = ("NOTHING", "CLAIM", "AMBIGUOUS", "PARTIAL", "UNKNOWN", "CANNOT_TELL")
NAMED = ("CLAIM", "PARTIAL", "AMBIGUOUS")  # words that answer by effects
PLANS = ("together", "more of the same")  # families of advice that consist of several shots


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
    strength, sd     per variable, in its unit; sd from noise and `clutter`; at_bound: variables that ended at a bound
    excess_sd, structure_p   what is left with it: excess misfit, and p of structure
    clear            of the strengths from their start, in standard deviations of all of them together
    chance           family-wise p of the strength by its scatter between parts of the sensor or session; NaN: not
                     computed, or too few parts
    clutter          covariance of the strengths by that scatter, beyond noise; empty: none
    told             what is known of strengths of which a gauge leaves only combinations, in words; '' otherwise
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
    clear: float = math.nan
    chance: float = math.nan
    clutter: list[list[float]] = field(default_factory=list)
    told: str = ""

    @property
    def complete(self) -> bool:
        """Whether nothing is left to explain."""
        return leaves_nothing(self.structure_p, self.excess_sd)


def leaves_nothing(structure_p: float, excess_sd: float) -> bool:
    """Whether nothing is left to explain, by p of its structure and by its excess in standard deviations."""
    return excess_sd < EXCESS and not is_structured(structure_p, excess_sd)


@dataclass
class Explanation:
    """A set of effects that was added together, everything calibrated again (`optics.diagnosis.explanations`).

    effects      names, none for the base
    fall         of chi2; cost: what its strengths could have fitted and how far they are from plausible, in chi2
    excess_sd, structure_p   what is left (as in Refit)
    lead         of the best explanation's score over this one's; needed: the lead by which it would be told apart
    ahead        chi2 of blocks of readings left out in turn, less that of the base; NaN for images
    variables, strength, sd, units   of all its strengths
    survives     whether it is not told apart from the best
    told         effect -> what is known of its strengths where a gauge leaves only combinations, in words
    same_as      name of a better one that survives and predicts the same values, under another name: no value of these
                 captures can tell the two apart, however often it is taken again; '' for none
    larger       whether it contains one that survives, and has a better score: likelier, but not shown to be needed
    refuted      what rules it out besides its score, in words; '' for nothing
    dials        whose errors, which captures do not state, it needs to survive; '' for none
    values       {"common": ..., "frame": ...} of its fit, where it is possible and has several effects: once one of
                 them is added, the next diagnosis looks for the others there
    """

    effects: list[str]
    fall: float
    cost: float
    excess_sd: float
    structure_p: float
    lead: float
    needed: float
    ahead: float
    variables: list[str]
    strength: list[float]
    sd: list[float]
    units: list[str]
    survives: bool
    told: dict[str, str] = field(default_factory=dict)
    same_as: str = ""
    larger: bool = False
    refuted: str = ""
    dials: str = ""
    values: dict[str, dict] = field(default_factory=dict, repr=False)

    @property
    def possible(self) -> bool:
        """Whether it may be the truth, by what the captures tell."""
        return self.survives or self.larger

    @property
    def complete(self) -> bool:
        """Whether nothing is left to explain."""
        return leaves_nothing(self.structure_p, self.excess_sd)

    @property
    def name(self) -> str:
        return " with ".join(self.effects)


def kinds_of(explanations: Sequence[Explanation]) -> list[list[Explanation]]:
    """The explanations that may be the truth, those together that predict the same values (`Explanation.same_as`)."""
    found: dict[str, list[Explanation]] = {}
    for e in [e for e in explanations if e.possible]:
        found.setdefault(e.same_as or e.name, []).append(e)
    return list(found.values())


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
    low, high, plausible   bounds and plausible size of each strength
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
    low: list[float] = field(default_factory=list)
    high: list[float] = field(default_factory=list)
    plausible: list[float] = field(default_factory=list)

    def reach(self, index: int) -> Reach:
        """What the strength of this index can be, for text."""
        known = index < min(len(self.low), len(self.high), len(self.plausible))
        return Reach(self.low[index], self.high[index], self.plausible[index]) if known else Reach()

    @property
    def net(self) -> float:
        """Fall less its mean when the effect is absent: comparable between effects with one and with many strengths."""
        return self.fall - self.expected

    @property
    def refitted(self) -> Refit:
        """The refit of an effect that had one; ValueError otherwise."""
        if self.refit is None:
            raise ValueError(f"effect '{self.name}' was not refitted")
        return self.refit

    @property
    def net_refit(self) -> float:
        """The same of the fall after a refit; -inf without one."""
        return -math.inf if self.refit is None else self.refit.fall - self.expected


@dataclass(frozen=True)
class Split:
    """The strength of an effect in parts of the data, relative to that in all of it: 1 everywhere for a true effect.

    h       fall of chi2 by splitting, less its degrees of freedom, over the effect's own fall
    p       of the fall under ideal noise; chance: by the scatter that clutter makes between parts of the data, NaN
            where that is unknown
    limit   h that noise and clutter allow; holds: whether h is within it
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


def occam(dof: int, *falls: float) -> float:
    """dof ln(1 + fall/dof), by the largest of the falls: what so many numbers could have fitted, with a prior as wide
    as what they did fit."""
    return dof * math.log1p(max(0.0, *falls) / dof)


@dataclass(frozen=True)
class Fingerprint:
    """The residual as a curve along one coordinate, after projecting off what a calibration absorbs.

    fall, dof   of chi2 with a gain and an offset per bin; net: fall less dof; ratio: net over the best effect's fall
    kind        'gain' (curve: relative change of the signal) or 'offset' (curve: DN), whichever explains more
    centres     of the bins, in `unit`; labels: names in their place, for frame and channel; cells of 'place' run row by
                row
    family      what the coordinate belongs to (`optics.diagnosis.fingerprints`)
    share       of the excess misfit, NaN within noise
    size        rms change that it makes, over the rms signal
    per_frame   whether nobody set the coordinate: the fit solves for it frame by frame, or it is a gain of each frame.
                With a bin for each of its values the curve is that along 'frame' by another name
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
    size: float = 0.0
    per_frame: bool = False

    @property
    def cost(self) -> float:
        """dof ln(1 + fall/dof) + 3 ln(1 + (size/USUAL)^2/2) + EACH: what so many bins could have fitted, whatever the
        data are, with a prior as wide as the curve that was found; how far that width is from usual; and the odds that
        an unknown cause acts. The same three costs as of an effect (`optics.diagnosis.explanations`)."""
        return occam(self.dof, self.fall) + 3 * math.log1p((self.size / USUAL) ** 2 / 2) + EACH


@dataclass(frozen=True)
class Law:
    """A freer law of an effect that the model has: its strength changes slowly along a coordinate.

    fall, dof   with so many further strengths, of chi2 or, of readings, of deviance (optics.diagnosis.correlation)
    p           of that fall in noise
    plain       fall of chi2 as if neighbours shared no noise, where `fall` is of deviance
    """

    effect: str
    coordinate: str
    fall: float
    dof: int
    p: float
    plain: float = 0.0

    @property
    def cost(self) -> float:
        """What so many numbers could have fitted. By the larger fall: where the law is the cause no lamp wanders, and
        the data know its numbers as well as they know the strength of an effect. Curves of unknown causes pay less, by
        their fall beside a lamp that wanders: an effect must not win over one by the curve's price alone."""
        return occam(self.dof, self.fall, self.plain)

    @property
    def score(self) -> float:
        """fall less cost."""
        return self.fall - self.cost


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

    fall, frames_better   against the base model on held-out frames, with what is known of the settings of each
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
class Drift:
    """A pattern far from the contacts that successive frames share and distant ones do not
    (`optics.diagnosis.patterns.drifting_pattern`): its share of the excess misfit, and the probability of as much in a
    random order of the frames; NaN where they are unknown."""

    share: float = math.nan
    p: float = math.nan


@dataclass(frozen=True)
class Surface:
    """What differs from contact to contact, the same under every light (`optics.diagnosis.patterns.by_surface`): its
    share of the excess misfit in the contacts, its rms as a share of the brightness, and their number; how much of it
    is one brightness of each contact, and the rms of that."""

    share: float = math.nan
    rms: float = math.nan
    contacts: int = 0
    whole: float = math.nan
    whole_rms: float = math.nan


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

    before, after   D without and with the shots of the advice; correct_before, correct_after: P(correct)
    share_before, share_after   D over the fall by the effect itself, where misfit is left and a verdict therefore asks
                                for MARGIN of it; else NaN
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
        """Whether the shots change what can be decided."""
        return self.correct_after - self.correct_before > TELLS or self.share_before < MARGIN <= self.share_after


@dataclass(frozen=True)
class Advice:
    """One simulated frame or several: what taking them would tell apart (`optics.diagnosis.advice`).

    shot       in words
    family     kind of the shot; 'together' for the best few, 'more of the same' for as many others to compare with
    settings   of each frame, by key: what differs from an existing frame; press: name of a new press, '' for the same
    frames     how many are taken
    pairs      hardest first
    nuisances  nuisance parameters that the shot brings; they were projected off, with their priors
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
        """The pair that is hardest to tell apart without the shot."""
        return self.pairs[0]

    @property
    def least(self) -> float:
        """The smallest D between any two effects with the shot."""
        return min(p.after for p in self.pairs)


@dataclass(frozen=True)
class Basis:
    """What the verdict rests on: data, masks, noise, misfit. Misfit and noise in units of the mean signal.

    masked     share of the values that are not used; not_finite: values left out because a prediction is not finite
    thinning   k: every k-th pixel serves curves, splits and alternative weights; the ranking itself uses all pixels
    signal     mean predicted signal, DN
    rank       of the base's derivative images: dof = values - rank
    phi        chi2 / dof; excess_sd: (chi2 - dof) / sqrt(2 dof); frame_phi: chi2 per value of each frame
    gradient   |Q'r|^2 per parameter: below 1 the base is calibrated
    structure_*  F and p of the structure; high_frequency: 1 where the noise model is right
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
    """The verdict, the table of effects and everything behind them.

    `text`, `to_csv` and `to_json` are three views of the same numbers.

    word        one of WORDS; sentence: the verdict in words; conditions: what decided it
    rows        one per tested effect, best first; not_tested: effect -> why
    ambiguous   effects of the explanations that the data cannot tell apart, under AMBIGUOUS, the simplest explanation
                first; claimed: the cause, under CLAIM
    kinds       under AMBIGUOUS, names of those explanations, those together that predict the same values
    compared    effects that were refitted, in the order of gaps (D between them) and correct (P(correct))
    levels      misfit of the base, then of the base with the best effect, on fitted and held-out frames
    explanations   sets of effects that were refitted, best first; families: what the residual depends on, best first
    laws        freer laws of the effects that the model has already, best first
    advice      what to measure next; hints: the same in words, from declarations
    fits        effect -> `optics.fit.result.Fit` of its refit; evidence: `optics.diagnosis.evidence.Evidence` without
                pixels. Neither is written to a file
    """

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
    explanations: list[Explanation] = field(default_factory=list)
    advice: list[Advice] = field(default_factory=list)
    families: list[Family] = field(default_factory=list)
    laws: list[Law] = field(default_factory=list)
    kinds: list[list[str]] = field(default_factory=list)
    fits: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)
    evidence: Any = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.word not in WORDS:
            raise ValueError(f"verdict {self.word!r} is none of {', '.join(WORDS)}")
        if (self.word == "CLAIM") != bool(self.claimed):
            raise ValueError(f"verdict {self.word}: only a CLAIM names a cause, and always one; got {self.claimed!r}")

    @property
    def survivors(self) -> list[Explanation]:
        """The explanations that are not told apart, best first."""
        return [e for e in self.explanations if e.survives]

    @property
    def missing(self) -> str:
        """Name of the missing effect, under CLAIM; anything else raises Underdetermined."""
        if self.word != "CLAIM":
            raise Underdetermined(f"{self.word}: no cause is established, so none is named. {self.sentence}")
        return self.claimed

    def row(self, effect: str) -> Row:
        """The row of an effect; KeyError if it was not tested."""
        for row in self.rows:
            if row.name == effect:
                return row
        raise KeyError(f"no effect '{effect}' in the table; tested: {', '.join(r.name for r in self.rows)}")

    def to_dict(self) -> dict[str, Any]:
        """Plain data without fits and evidence: NaN becomes None, infinity 'inf'."""
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
        return table_of(self.rows)

    def text(self, width: int = 0) -> str:
        """The report for a terminal."""
        from optics.diagnosis.text import report

        return report(self)

    def records(self) -> list[dict[str, Any]]:
        """One record per effect (optics.diagnosis.showing.records)."""
        return showing.records(self)

    def plot(self) -> Figure:
        """A chart of the ranking and of curves along coordinates (optics.diagnosis.showing.plot)."""
        return showing.plot(self)

    def _repr_html_(self) -> str:
        return showing.html(self)


def table_of(rows: Sequence[Row]) -> str:
    """Rows as CSV, one line each."""
    names = [f.name for f in fields(Row) if f.name != "refit"]
    names += [f"refit_{f.name}" for f in fields(Refit)]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(names)
    for row in rows:
        cells = {f.name: getattr(row, f.name) for f in fields(Row)}
        if row.refit is not None:
            cells.update({f"refit_{k}": v for k, v in asdict(row.refit).items()})
        writer.writerow([_cell(cells.get(name)) for name in names])
    return out.getvalue()


def _record(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if isinstance(value, list):
        return [_record(v) for v in value]
    return value


def _restore(kind: Any, data: Any) -> Any:
    """The inverse of `plain` for the dataclasses of this file: None is NaN where a float is declared."""
    if data is None:
        return math.nan if kind is float else None
    if is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        return cast(Any, kind)(**{name: _restore(hints[name], value) for name, value in data.items()})
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is list:
        return [_restore(arguments[0], value) for value in data]
    if origin is dict and arguments:
        return {key: _restore(arguments[1], value) for key, value in data.items()}
    if arguments and type(None) in arguments:
        return _restore(arguments[0], data)
    return float(data) if kind is float else data


def _cell(value: Any) -> str:
    if isinstance(value, list):
        return ";".join(_cell(v) for v in value)
    if isinstance(value, float):
        return "" if math.isnan(value) else repr(value)
    return "" if value is None else str(value)
