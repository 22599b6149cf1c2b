"""Records to rates: each with its number of cells and its 95 % interval (Clopper & Pearson, 1934), against the targets.

A target is reached when the near end of the interval reaches it: few cells reach nothing, whatever their rate.

    top-1        the hidden effect has the largest fall of chi2 after refit; top-3: is among the three best by score
    in the set   is among the effects that the refit cannot tell from the best
    precision    of claims where a library effect, two, or none was hidden: share that name a hidden one
    strength     of right claims by the library's own law: within 20 %; pulls: (found - true)/sd of those without
                 clutter
    fall         of chi2, brought by the refit over predicted before it (by the score; where the image of a weak effect
                 is not that of a strong one, by its image at the strength that the score found), of the right effects
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

from optics.diagnosis.thresholds import CLEAR, LEVEL
from optics.proof.elsewhere import Elsewhere, elsewhere
from optics.proof.measures import f1, false_share
from optics.proof.rates import Rate, last, named, rate_of

CLEAN = 0.0


@dataclass
class Counted:
    """What is counted of one sensor or bench: rates of different sensors are never pooled."""

    done: int
    unreachable: int
    failed: list[str]
    rates: list[Rate]
    confusion: dict[str, dict[str, int]]
    words: dict[str, dict[str, int]]
    power: dict[str, list[int]]  # change -> [right claims, n], without clutter, own law
    ties: tuple[int, int]
    set_size: float | None  # mean, at 0.2 %
    pulls: dict[str, list[float]]
    falls: list[float]
    null_p: list[float]
    held_out: list[float]
    seconds: float  # of a processor, in all
    made: dict[str, int]  # commit and day -> cells
    measures: list[Measure]

    @property
    def each(self) -> float:
        """Seconds of a processor that a cell took."""
        return self.seconds / max(self.done, 1)

    def lines(self) -> list[str]:
        """For a terminal."""
        lines = [f"  {'':<60}{'bound':>7}{'rate':>7}{'n':>6}   {'95 %':<13} {'first':>6} {'ambit.':>7}  reached"]
        for r in self.rates:
            lo, hi = r.interval
            lines.append(
                f"  {r.name:<60}{r.bound:>7.3f}{r.value:>7.3f}{r.n:>6}   {lo:.3f}-{hi:.3f}   {r.first:>5g} "
                f"{r.ambitious:>7g}  {r.verdict}"
            )
        lines += [f"  ambiguous verdicts: {self.ties[1]}; {self.ties[0]} of them list the hidden effect"]
        if self.set_size is not None:
            lines += [f"  mean number of effects in the set at 0.2 %: {self.set_size:.2f} (target: at most 2)"]
        for law, values in self.pulls.items():
            if len(values) > 1:
                lines.append(
                    f"  pulls of strengths ({law}): n {len(values)}, mean {np.mean(values):+.2f}, "
                    f"sd {np.std(values, ddof=1):.2f}"
                )
        if self.falls:
            q = np.percentile(self.falls, [10, 50, 90])
            lines.append(
                f"  fall of chi2 over its prediction: median {q[1]:.2f}, 10 % to 90 % {q[0]:.2f} to {q[2]:.2f}, "
                f"n {len(self.falls)}"
            )
        if len(self.null_p) > 4:
            from scipy.stats import kstest

            lines.append(
                f"  family-wise p of {len(self.null_p)} sets without a hidden effect or clutter: uniform with "
                f"p = {kstest(self.null_p, 'uniform').pvalue:.2g} (Kolmogorov-Smirnov)"
            )
        if self.held_out:
            lines.append(f"  held-out chi2 per value after a right claim: median {np.median(self.held_out):.3f}")
        lines += [f"  {m.name}: {m.text}" for m in self.measures]
        lines += [f"  cells by commit and day: {', '.join(f'{n} {what}' for what, n in self.made.items())}"]
        return lines + [f"  failed: {f}" for f in self.failed[:10]]


@dataclass(frozen=True)
class Measure:
    """A measure that others publish of their methods: mean of n cells, with a 95 % interval by drawing cells again."""

    name: str
    value: float
    low: float
    high: float
    n: int

    @property
    def text(self) -> str:
        return f"{self.value:.3g} ({self.low:.3g} to {self.high:.3g}, n {self.n})" if self.n else "no cells"


@dataclass
class Count:
    """All that is counted; `rigs`: by sensor."""

    done: int
    planned: int
    rigs: dict[str, Counted] = field(default_factory=dict)
    elsewhere: Elsewhere | None = None  # benches of other laboratories, which have rates of their own

    @property
    def only(self) -> Counted:
        """Of the one sensor that there is."""
        (one,) = self.rigs.values()
        return one

    def rate(self, name: str) -> Rate:
        return next(r for r in self.only.rates if r.name == name)

    @property
    def holds(self) -> bool:
        """Whether no target of the first release is missed for certain, by any sensor."""
        rates = [*(r for one in self.rigs.values() for r in one.rates)]
        rates += self.elsewhere.rates if self.elsewhere else []
        return all(r.verdict != "MISSED" for r in rates)

    def text(self) -> str:
        """For a terminal."""
        lines = [f"proof: {self.done} of {self.planned} cells run"] if self.rigs else []
        for name, one in self.rigs.items():
            lines += [
                "",
                f"{name}: {one.done} cells, {one.each:.0f} s of a processor each; {one.unreachable} skipped, as "
                f"the effect cannot be made so strong, {len(one.failed)} failed",
                *one.lines(),
            ]
        lines += ["", *self.elsewhere.lines()] if self.elsewhere else []
        return "\n".join(lines) + "\n"

    def json(self) -> dict:
        return asdict(self)


def _some(good: Sequence[dict], kind: str, test: Callable[[dict], bool] = lambda c: True) -> list[dict]:
    return [r for r in good if r["cell"]["kind"] == kind and test(r["cell"])]


def _own(good: Sequence[dict]) -> tuple[list[dict], list[dict]]:
    """Cells with an effect of the library by its own law, and those of them without clutter."""
    own = _some(good, "library", lambda c: c["law"] == "same")
    return own, [r for r in own if r["cell"]["clutter"] == CLEAN]


def _hidden(r: dict):
    return r["cell"]["hidden"]


def _named_rates(good: Sequence[dict]) -> list[Rate]:
    """How often the right effect is named first, stands in the set, and is claimed; how often nothing or another is."""
    own, clean = _own(good)
    middle = [r for r in clean if r["cell"]["change"] == 0.005]
    weak = [r for r in clean if r["cell"]["change"] == 0.002]
    shown = [r for r in weak if last(r)["p_best"] < LEVEL]
    none, pair = _some(good, "none"), _some(good, "pair")
    calm = [r for r in none if r["cell"]["clutter"] == CLEAN]

    def claims(of):
        return [r for r in of if named(r)]

    def right(r):
        return named(r) <= set(_hidden(r))

    return [
        rate_of(
            "top-1 after refit, 0.5 %, no clutter",
            middle,
            lambda r: [last(r)["claimed"] or (last(r)["refit"] or [""])[0]] == _hidden(r),
            0.95,
            0.99,
        ),
        rate_of(
            "top-3 by score, 0.5 %, no clutter", middle, lambda r: _hidden(r)[0] in last(r)["score"][:3], 0.97, 0.99
        ),
        rate_of("in the set, 0.2 %, no clutter", weak, lambda r: _hidden(r)[0] in last(r)["set"], 0.97, 0.99),
        rate_of(
            "in the set, 0.2 %, no clutter, where one stands out",
            shown,
            lambda r: _hidden(r)[0] in last(r)["set"],
            0.97,
            0.99,
        ),
        rate_of(
            "an effect stands out where none is hidden", calm, lambda r: last(r)["p_best"] < LEVEL, 0.03, 0.015, True
        ),
        rate_of("claims where none is hidden, any clutter", none, named, 0.03, 0.01, True),
        rate_of("precision of claims, own law, any clutter", claims([*own, *pair, *none]), right, 0.95, 0.99),
        rate_of(
            "precision of claims, another law",
            claims(_some(good, "library", lambda c: c["law"] == "other")),
            right,
            0.85,
            0.95,
        ),
    ]


def _size_rates(good: Sequence[dict]) -> list[Rate]:
    """Claims against clutter, unknown kinds, pairs, and how near strengths and falls of chi2 come."""
    own, clean = _own(good)
    unknown, pair, rates = _some(good, "unknown"), _some(good, "pair"), []
    for clutter, first, ambitious in ((0.0, 0.8, 0.9), (0.15, 0.7, 0.85), (0.5, 0.5, 0.65), (1.0, 0.3, 0.5)):
        of = [r for r in own if r["cell"]["change"] == 0.02 and r["cell"]["clutter"] == clutter]
        rates.append(
            rate_of(
                f"right claims, 2 %, clutter {clutter:g}", of, lambda r: named(r) == set(_hidden(r)), first, ambitious
            )
        )
    judged = [r for r in own if last(r)["strength"]]
    seen = [r for r in clean if r["cell"]["change"] <= 0.005 and _fall(r)]
    return rates + [
        rate_of("unknown kinds falsely claimed", unknown, named, 0.10, 0.03, True),
        rate_of(
            "unknown kind's coordinate in the top two, no clutter",
            [r for r in unknown if r["cell"]["clutter"] == CLEAN],
            lambda r: set(r["coordinates"]) & set(last(r)["coordinates"][:2]),
            0.75,
            0.90,
        ),
        rate_of("pairs named exactly, 1 % + 1 %, no clutter", pair, lambda r: named(r) == set(_hidden(r)), 0.85, 0.95),
        rate_of("strength within 20 % where claimed", judged, lambda r: abs(_ratio(r) - 1) < 0.2, 0.80, 0.95),
        rate_of(
            "fall of chi2 within 20 % of its prediction, to 0.5 %",
            seen,
            lambda r: abs(_fall(r) - 1) < 0.2,
            0.90,
            0.90,
        ),
    ]


def _told(good: Sequence[dict]) -> tuple[dict[str, dict[str, int]], dict[str, dict[str, int]]]:
    """What was named by what was hidden, and the verdicts by the kind of cell: numbers of cells."""
    confusion: dict[str, dict[str, int]] = {}
    words: dict[str, dict[str, int]] = {}
    for r in good:
        c = r["cell"]
        kind = {
            "library": _hidden(r)[0] if _hidden(r) else "",
            "none": "nothing",
            "pair": "two effects",
            "unknown": f"not in the library: {_hidden(r)[0] if _hidden(r) else ''}",
            "mistake": f"noise mistaken: {c['mistake']}",
        }[c["kind"]]
        names, true = named(r), set(_hidden(r))
        told = next(iter(names), last(r)["word"])
        if c["kind"] == "pair" and names:
            told = "both" if names == true else "one of two" if names < true else "another"
        confusion.setdefault(kind, {}).setdefault(told, 0)
        confusion[kind][told] += 1
        words.setdefault(c["kind"], {}).setdefault(last(r)["word"], 0)
        words[c["kind"]][last(r)["word"]] += 1
    return confusion, words


def _power(clean: Sequence[dict]) -> dict[str, list[int]]:
    """At each raw change in percent: [right claims, cells]."""
    power: dict[str, list[int]] = {}
    for r in clean:
        own = power.setdefault(f"{100 * r['cell']['change']:g}", [0, 0])
        own[0] += named(r) == set(_hidden(r))
        own[1] += 1
    return power


def _measures(good: Sequence[dict]) -> list[Measure]:
    """Form recovery, parameter bias, localisation F1 and false discovery rate, as LISDD has them."""
    own, clean = _own(good)
    found = []
    for change in sorted({r["cell"]["change"] for r in clean}):
        of = [float(named(r) == set(_hidden(r))) for r in clean if r["cell"]["change"] == change]
        found.append(_mean(f"form recovery: the right effect named, alone, {100 * change:g} %, no clutter", of))
    shifts = [s["bias"] for r in own if (s := r["steps"][0]).get("bias")]
    for k, what in enumerate(("without the missing effect", "with it", "by noise alone")):
        found.append(_mean(f"parameter bias in plausible sizes, {what}", [b[k] for b in shifts]))
    local = [r for r in _some(good, "unknown") if r.get("parts") and last(r).get("flagged") is not None]
    found.append(
        _mean("localisation F1, kinds that act in a part", [f1(r["parts"], last(r)["flagged"]) for r in local])
    )
    several = [r for r in _some(good, "pair") if named(r)]
    found.append(_mean("false discovery rate, two hidden", [false_share(list(named(r)), _hidden(r)) for r in several]))
    every = [r for r in good if r["cell"]["kind"] in ("library", "pair", "none", "unknown") and named(r)]
    true = [_hidden(r) if r["cell"]["kind"] in ("library", "pair") else [] for r in every]
    found.append(
        _mean("false discovery rate, all cells", [false_share(list(named(r)), t) for r, t in zip(every, true)])
    )
    return found


def _mean(name: str, values: Sequence[float]) -> Measure:
    """The mean; where all values are alike, its interval is that of a share of n (Clopper & Pearson) if they are 0 or
    1."""
    if not values:
        return Measure(name, float("nan"), float("nan"), float("nan"), 0)
    own = np.array(values, float)
    if {*own.tolist()} <= {0.0, 1.0}:
        low, high = Rate(name, int(own.sum()), len(own), 0, 0).interval
    else:
        drawn = np.random.default_rng(0).choice(own, (2000, len(own))).mean(1)
        low, high = np.percentile(drawn, [2.5, 97.5])
    return Measure(name, float(own.mean()), float(low), float(high), len(own))


def count(records: Sequence[dict], planned: int) -> Count:
    """Count records; `planned`: how many cells the plan has. Those of other laboratories are counted by themselves."""
    others = [r for r in records if r.get("facts") is not None]
    records = [r for r in records if r.get("facts") is None]
    names = list(dict.fromkeys(r["cell"]["rig"] for r in records))
    rigs = {n: _counted([r for r in records if r["cell"]["rig"] == n]) for n in names}
    return Count(len(records), planned, rigs, elsewhere(others))


def _counted(records: Sequence[dict]) -> Counted:
    """Of one sensor."""
    made = [r for r in records if not r["unreachable"]]
    failed = [f"{'+'.join(r['cell']['hidden'])} s{r['cell']['seed']}: {r['failed']}" for r in made if r["failed"]]
    good = [r for r in made if r["steps"] and not r["failed"]]
    own, clean = _own(good)
    weak = [r for r in clean if r["cell"]["change"] == 0.002]
    seen = [r for r in clean if r["cell"]["change"] <= 0.005 and _fall(r)]
    judged = [r for r in own if last(r)["strength"]]
    calm = [r for r in _some(good, "none") if r["cell"]["clutter"] == CLEAN]
    ties = [r for r in [*own, *_some(good, "library", lambda c: c["law"] == "other")] if last(r)["word"] == "AMBIGUOUS"]
    confusion, words = _told(good)
    right = [r for r in own if named(r) == set(_hidden(r))]
    return Counted(
        done=len(records),
        unreachable=len(records) - len(made),
        failed=failed,
        rates=[*_named_rates(good), *_size_rates(good)],
        confusion=confusion,
        words=words,
        power=_power(clean),
        ties=(sum(_hidden(r)[0] in last(r)["ambiguous"] for r in ties), len(ties)),
        set_size=float(np.mean([len(last(r)["set"]) for r in weak])) if weak else None,
        pulls={
            "no clutter": [_pull(r) for r in judged if r["cell"]["clutter"] == CLEAN and _pull(r) is not None],
            "clutter": [_pull(r) for r in judged if r["cell"]["clutter"] > CLEAN and _pull(r) is not None],
        },
        falls=[_fall(r) for r in seen],
        null_p=[last(r)["p_best"] for r in calm],
        held_out=[last(r)["held_out"][-1] for r in right if last(r)["held_out"][-1] is not None],
        seconds=float(sum(r.get("cpu", 0.0) for r in records)),
        made=dict(sorted(Counter(r.get("made", "unknown") for r in records).items())),
        measures=_measures(good),
    )


def _ratio(r: dict) -> float:
    name, (found, _) = next(iter(last(r)["strength"].items()))
    return abs(found) / abs(r["truth"][name])  # of some, such as a stop between two lobes, the sign is not seen


def _fall(r: dict) -> float | None:
    """Fall of chi2 by the hidden effect over its prediction, where that says that there is something; None
    elsewhere."""
    before, after = last(r)["falls"].get(r["cell"]["hidden"][0], (0.0, 0.0))
    return after / before if before > CLEAR else None


def _pull(r: dict) -> float | None:
    name, (found, sd) = next(iter(last(r)["strength"].items()))
    return (found - r["truth"][name]) / sd if isinstance(sd, float) and sd > 0 else None
