"""The plan: what is hidden where. Rounds of cells, each round of another seed, so that any number of rounds is
balanced."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

import numpy as np

CLUTTER = (0.0, 0.15, 0.5, 1.0)
# (raw change of the image, clutter, law), as often as they count: most where the targets are asked
LIBRARY = (
    *[(0.005, 0.0, "same")] * 8,
    *[(0.002, 0.0, "same")] * 4,
    *[(0.02, 0.0, "same")] * 3,
    *[(0.02, c, "same") for c in CLUTTER[1:]] * 3,
    *[(0.005, c, "same") for c in CLUTTER[1:]],
    *[(0.002, c, "same") for c in CLUTTER[1:]],
    *[(0.02, c, "other") for c in CLUTTER],
    *[(0.005, 0.0, "other")] * 2,
)
UNKNOWN_CHANGE = 0.01
PAIR_CHANGE = 0.01
# what is written down wrongly of the camera, or done to its images
MISTAKES = ("gain +20 %", "gain -20 %", "pattern 0.3 %", "pattern 1 %", "black level 0.5 DN", "demosaiced")


@dataclass(frozen=True)
class Cell:
    """One capture set to be made and judged.

    kind     library, none, pair, unknown, mistake;   hidden   effects, or the unknown kind
    change   rms of the image's change by each, over its mean;   law   "same" as the library's, or "other"
    snr      in place of `change` on benches of other laboratories: rms change per value over its noise
    salt     tells cells apart that are else alike
    """

    rig: str
    kind: str
    hidden: tuple[str, ...]
    change: float
    clutter: float
    law: str
    mistake: str
    seed: int
    snr: float = 0.0
    salt: int = 0

    @property
    def name(self) -> str:
        words = [
            self.rig,
            self.kind,
            "+".join(self.hidden) or "none",
            f"{100 * self.change:g}",
            f"c{self.clutter:g}",
            self.law,
        ]
        words += [self.mistake] if self.mistake else []
        words += [f"snr{self.snr:g}"] if self.snr else []
        words += [f"n{self.salt}"] if self.salt else []
        text = "_".join([*words, f"s{self.seed:03d}"])
        return "".join(ch if ch.isalnum() or ch in "+-._" else "-" for ch in text)

    def json(self) -> dict:
        return asdict(self)

    @classmethod
    def of(cls, data: dict) -> Cell:
        return cls(**{**data, "hidden": tuple(data["hidden"])})


def rounds(rig, count: int, first: int = 0) -> Iterator[list[Cell]]:
    """Cells of one rig, round by round: every effect once, three sets with nothing hidden, unknown kinds, a pair, a
    mistake.

    rig   with `name`, `effects`, `others` (effects with another law), `unknown`, `pairs`, `mistakes`, `cluttered`; one
          of another laboratory (`outside`) has `rounds` of its own
    """
    if rig.outside:
        yield from rig.rounds(count, first)
        return
    effects = list(rig.effects)
    for number in range(first, first + count):
        rng = np.random.default_rng([number, 23])
        order = rng.permutation(len(LIBRARY))  # of each round, without repeats
        cells = []
        for i, effect in enumerate(effects):
            change, clutter, law = LIBRARY[order[i % len(order)]]
            clutter = clutter if rig.cluttered else 0.0
            if law == "other" and effect not in rig.others:
                law = "same"
            cells.append(Cell(rig.name, "library", (effect,), change, clutter, law, "", number))
        levels = [0.0, CLUTTER[1 + number % 3]] if rig.cluttered else [0.0]
        cells += [Cell(rig.name, "none", (), 0.0, c, "same", "", number) for c in levels]
        for k in range(min(2, len(rig.unknown))):
            kind = list(rig.unknown)[(2 * number + k) % len(rig.unknown)]
            clutter = 0.0 if (number // 4 + k) % 2 == 0 or not rig.cluttered else 0.5
            cells.append(Cell(rig.name, "unknown", (kind,), UNKNOWN_CHANGE, clutter, "same", "", number))
        if rig.pairs:
            both = rig.pairs[number % len(rig.pairs)]
            cells.append(Cell(rig.name, "pair", tuple(both), PAIR_CHANGE, 0.0, "same", "", number))
        if rig.mistakes:
            cells.append(
                Cell(rig.name, "mistake", (), 0.0, 0.0, "same", rig.mistakes[number % len(rig.mistakes)], number)
            )
        yield [cells[i] for i in rng.permutation(len(cells))]  # so that what is done when time is up is balanced


def pairs_of(effects: Sequence[str], apart: int = 3) -> list[tuple[str, str]]:
    """Pairs of neighbours in a circle, and of those some places apart: each effect in four of them."""
    count = len(effects)
    return (
        [(effects[i], effects[(i + step) % count]) for step in (1, apart) for i in range(count)]
        if count > apart
        else []
    )
