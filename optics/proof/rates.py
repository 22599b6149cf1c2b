"""A rate with its interval (Clopper & Pearson, 1934) and its targets, and what a record of a cell says."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Rate:
    """k of n, its 95 % interval, and the targets ('at least', or 'at most' where `low` is good)."""

    name: str
    k: int
    n: int
    first: float
    ambitious: float
    low: bool = False

    @property
    def value(self) -> float:
        return self.k / self.n if self.n else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        from scipy.stats import binomtest

        if not self.n:
            return 0.0, 1.0
        ci = binomtest(self.k, self.n).proportion_ci(0.95, method="exact")
        return float(ci.low), float(ci.high)

    @property
    def bound(self) -> float:
        """The near end of the interval: what targets are held against."""
        return self.interval[1] if self.low else self.interval[0]

    def reached(self, target: float) -> bool:
        return self.bound <= target if self.low else self.bound >= target

    @property
    def verdict(self) -> str:
        if not self.n:
            return "no cells"
        if self.reached(self.ambitious):
            return "ambitious"
        if self.reached(self.first):
            return "first release"
        beyond = self.interval[0] > self.first if self.low else self.interval[1] < self.first
        return "MISSED" if beyond else "open"  # open: the interval holds the target, more cells would tell


def last(r: dict) -> dict:
    return r["steps"][-1]


def named(r: dict) -> set[str]:
    """All effects that the loop added, claimed, or named as two that together leave nothing."""
    found = set()
    for step in r["steps"]:
        found |= {*step.get("added", ()), *step.get("pair", ()), *filter(None, [step["claimed"]])}
    return found


def rate_of(name, of: Sequence[dict], test: Callable[[dict], bool], first, ambitious, low=False) -> Rate:
    return Rate(name, sum(bool(test(r)) for r in of), len(of), first, ambitious, low)
