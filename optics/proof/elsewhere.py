"""The count on benches of other laboratories: what a stranger is told, by every diagnosis of his loop.

claim      an effect that the loop names: claimed, or one of two that together leave nothing; right where it is
           hidden, or is the same by its physics (`optics.proof.rigs.laboratory.SAME`); neither right nor wrong where
           everyday life brings it besides, as a lamp that wanders brings the gain drift of photographs
set        effects that the last diagnosis does not tell apart; a member "a + b" stands for both together
told apart whether the session can tell the hidden effect from every other: P(correct) by the maker's own formulas, and
           as the diagnosis prints it where it refitted the hidden effect
needed     of two hidden: neither alone, with lamp and zeros solved for, leaves less than CLEAR of chi2
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from optics.diagnosis.thresholds import CLEAR
from optics.proof.rates import Rate, last, named, rate_of

STRONG = 1.0  # signal to noise per value from which a single effect is asked for
APART = 0.95  # P(correct) from which a session can tell it from every other


@dataclass
class Elsewhere:
    """What is counted. `crashes`: cells that ended in an error; `sizes`: mean members of sets, {single, pair: mean};
    `wrong`: one line for each cell that went wrong, by cause; `rigs`: the same for each bench."""

    done: int
    crashes: list[str]
    rates: list[Rate]
    sizes: dict[str, tuple[float, int]]
    wrong: dict[str, list[str]]
    seconds: float
    rigs: dict[str, Elsewhere] = field(default_factory=dict)

    def lines(self) -> list[str]:
        """For a terminal."""
        found = [
            f"other laboratories: {self.done} cells, {self.seconds / max(self.done, 1):.1f} s of a processor each; "
            f"{len(self.crashes)} ended in an error (target: 0)"
        ]
        for name, one in {"": self, **(self.rigs if len(self.rigs) > 1 else {})}.items():
            found += ["", f"{name or 'all'}:", f"  {'':<60}{'rate':>7}{'n':>6}   {'95 %':<13} {'target':>6}  reached"]
            for r in one.rates:
                lo, hi = r.interval
                found += [f"  {r.name:<60}{r.value:>7.3f}{r.n:>6}   {lo:.3f}-{hi:.3f}   {r.first:>5g}  {r.verdict}"]
            for what, (mean, n) in one.sizes.items():
                found += [f"  members of a set, {what}: {mean:.2f} on average, n {n}"]
        return found + [f"crash: {c}" for c in self.crashes[:10]]


def elsewhere(records: Sequence[dict], parts: bool = True) -> Elsewhere | None:
    """Count records of benches of other laboratories; None where there are none."""
    if not records:
        return None
    made = [r for r in records if not r["unreachable"]]
    good = [r for r in made if r["steps"] and not r["failed"]]
    single = [r for r in good if r["cell"]["kind"] == "library"]
    pairs = [r for r in good if r["cell"]["kind"] == "pair"]
    strong = [r for r in single if snr(r) >= STRONG]
    claims = [(r, name) for r in good for name in sorted(_claimed(r))]
    right = [name in _true(r) for r, name in claims]
    needed = [r for r in pairs if min(r["facts"]["alone"].values()) >= CLEAR]
    none = [r for r in good if r["cell"]["kind"] == "none"]
    rates = [
        Rate("claims that are right", sum(right), len(right), 0.95, 0.95),
        rate_of("claims where nothing is hidden", none, _claimed, 0.01, 0.01, True),
        rate_of("two hidden: both named, or in a set with both", needed, _both, 0.9, 0.9),
        rate_of("one, SNR >= 1: named, or in the set", strong, _told, 0.9, 0.9),
        rate_of(
            "one, SNR >= 1, P(correct) >= .95: named alone",
            [r for r in strong if _apart(r) >= APART],
            lambda r: bool(_claimed(r)) and _claimed(r) <= _true(r),
            0.8,
            0.8,
        ),
        rate_of(
            "the same, P(correct) by the maker's formulas",
            [r for r in strong if r["facts"]["correct"] >= APART],
            lambda r: bool(_claimed(r)) and _claimed(r) <= _true(r),
            0.8,
            0.8,
        ),
        rate_of(
            "kinds that no library has: falsely claimed",
            [r for r in good if r["cell"]["kind"] == "unknown"],
            _claimed,
            0.1,
            0.1,
            True,
        ),
    ]
    sizes = {}
    for what, of, size in (
        ("one hidden", single, lambda r: len(ties(r))),
        ("one hidden, what no reading tells from it counted with it", single, _classes),
        ("one hidden, names of one law on these readings counted once", single, kinds),
        ("two hidden", pairs, lambda r: len(ties(r))),
        ("two hidden, names of one law on these readings counted once", pairs, kinds),
    ):
        counts = [size(r) for r in of if ties(r)]
        if counts:
            sizes[what] = (float(np.mean(counts)), len(counts))
    found = Elsewhere(
        len(records),
        [f"{r['cell']['rig']} {_hidden(r)} s{r['cell']['seed']}: {r['failed']}" for r in made if r["failed"]],
        rates,
        sizes,
        wrong(made),
        float(sum(r.get("cpu", 0.0) for r in records)),
    )
    if parts:
        names = sorted({r["cell"]["rig"] for r in records})
        found.rigs = {n: one for n in names if (one := elsewhere([r for r in records if r["cell"]["rig"] == n], False))}
    return found


def _claimed(r: dict) -> set[str]:
    """What was named, but for what everyday life brings besides."""
    return named(r) - set(r["facts"].get("besides", ()))


def snr(r: dict) -> float:
    """Signal to noise per value of the weakest that is hidden, as the cell was made."""
    return min(r["facts"]["snr"].values(), default=0.0)


def ties(r: dict) -> list[str]:
    """Members of the set that the last diagnosis could not tell apart; none where it gives no set."""
    return list(last(r)["ambiguous"])


def kinds(r: dict) -> int:
    """Explanations of that set, those that predict the same values counted once."""
    return len(last(r).get("kinds") or ties(r))


def _classes(r: dict) -> int:
    """Members of the set, where those that reproduce all readings of the hidden cause count as one with it."""
    same = {*_true(r), *r["facts"].get("twins", ())}
    return len({*ties(r)} - same) + bool({*ties(r)} & same)


def _hidden(r: dict) -> str:
    return " + ".join(r["cell"]["hidden"]) or "nothing"


def _true(r: dict) -> set[str]:
    """What may be named: the hidden causes of the library, and what is the same by physics."""
    hidden = r["cell"]["hidden"] if r["cell"]["kind"] in ("library", "pair") else ()
    return {*hidden, *(name for names in r["facts"].get("same", {}).values() for name in names)}


def _members(r: dict) -> set[str]:
    """All effects that were named or stand in the last set."""
    return _claimed(r) | {part.strip() for member in ties(r) for part in member.split(" + ")}


def _told(r: dict) -> bool:
    """The hidden effect was named, and nothing that is not there; or it stands in the set."""
    return bool(_members(r) & _true(r)) and _claimed(r) <= _true(r)


def _both(r: dict) -> bool:
    said = _members(r)
    each = [{name, *r["facts"].get("same", {}).get(name, ())} for name in r["cell"]["hidden"]]
    return all(names & said for names in each) and _claimed(r) <= _true(r)


def _apart(r: dict) -> float:
    said = next((s["correct"] for s in r["steps"] if s.get("correct") is not None), 1.0)
    return min(said, r["facts"]["correct"])


def wrong(records: Sequence[dict]) -> dict[str, list[str]]:
    """{what went wrong: a line per cell}, most frequent first: what was hidden, what was said."""
    found: dict[str, list[tuple[str, dict]]] = {}
    for r in records:
        kind = r["cell"]["kind"]
        if r["failed"]:
            why = f"crash: {r['failed'].split(':')[0]} at {r.get('where', '')}"
        elif not r["steps"]:
            continue
        elif false := sorted(_claimed(r) - _true(r)):
            why = f"false claim of {' and '.join(false)}"
        elif kind == "library" and snr(r) >= STRONG and not _told(r):
            why = f"{_hidden(r)} not found: {last(r)['word']}"
        elif kind == "library" and snr(r) >= STRONG and _apart(r) >= APART and not _claimed(r):
            why = f"{_hidden(r)} not named alone: {last(r)['word']}"
        elif kind == "pair" and min(r["facts"]["alone"].values()) >= CLEAR and not _both(r):
            why = "two hidden, not both named"
        else:
            continue
        found.setdefault(why, []).append((_line(r), r))
    order = Counter({why: len(lines) for why, lines in found.items()}).most_common()
    return {why: [line for line, _ in found[why]] for why, _ in order}


def _line(r: dict) -> str:
    facts, cell = r["facts"], r["cell"]
    told = " then ".join(
        s["word"] + (f" {s['claimed']}" if s["claimed"] else "") + (f" {s['ambiguous']}" if s["ambiguous"] else "")
        for s in r["steps"]
    )
    sizes = ", ".join(f"{name} SNR {value:.2g}" for name, value in facts.get("snr", {}).items()) or "nothing"
    numbers = ", ".join(f"{k} {v:.3g}" for k, v in facts.get("numbers", {}).items())
    twins = f"; cannot be told from {', '.join(facts['twins'])}" if facts.get("twins") else ""
    return (
        f"{cell['rig']} {cell['kind']} {cell['law']} s{cell['seed']} | {facts.get('session', '')}, "
        f"{facts.get('readings', 0)} readings, dial {facts.get('dial_sd', 0):.2g} deg"
        f"{' stated' if facts.get('dials_said') else ''}, wander {facts.get('wander_to_noise', 0):.1g} of the noise"
        f"{', one row misread' if facts.get('misread') else ''} | {sizes} ({numbers}); P(correct) "
        f"{facts.get('correct', float('nan')):.2f}{twins} | {told or r['failed'][:160]}"
    )
