"""The results of a scoreboard (optics.study.scoreboard): on a terminal, and on disk as scoreboard.json."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from optics.errors import UnknownKey
from optics.fit.compare import plain
from optics.words import number, some, table

PUBLISHED: dict[str, Any] = {
    "name": "published, another sensor's images",
    "l1": (0.009, 0.003),
    "ssim": (0.976, 0.008),
    "psnr": (38.8, 1.2),
    "images": 140,
    "source": "Zhao et al., F-TAC Hand, Nature Machine Intelligence (2025), supplementary information, Table S1",
}
STEP, RIVAL = "step", "rival"


# -- results ---------------------------------------------------------------------------------------------------------
@dataclass
class Level:
    """Errors in one region: rms and noise in DN, ratio without unit, l1 and psnr of full scale; sd over frames.

    cells   the same numbers for each lamp and channel: led, channel, rms, ratio, l1, ssim, psnr, chi2_per_dof, n"""

    n: int
    rms: float
    noise: float
    ratio: float | None
    chi2_per_dof: float
    l1: float
    ssim: float
    psnr: float
    sd: dict[str, float]
    cells: list[dict[str, Any]]

    def span(self, key: str) -> tuple[float, float]:
        """Smallest and largest of the cells; NaN where they have no such number."""
        values = [float(c[key]) for c in self.cells if c[key] is not None and math.isfinite(c[key])]
        return (min(values), max(values)) if values else (math.nan, math.nan)


@dataclass
class Entry:
    """One model: its kind (`RIVAL` or `STEP`), how many numbers it has, and its errors.

    numbers   in all, without those found in held-out frames: those of a table for every lamp and channel, those of a
              step but for poses. None: a photograph
    each      the same over the number of lamps times channels
    poses     numbers found in the held-out frames themselves, in all
    how       what the errors in the contact and in the whole image are of: {"contact": ..., "whole": ...}
    """

    name: str
    kind: str
    numbers: int | None
    poses: int
    contact: Level
    whole: Level
    how: dict[str, str] = field(default_factory=dict)

    @property
    def each(self) -> float:
        return math.nan if self.numbers is None else self.numbers / max(len(self.contact.cells), 1)


@dataclass
class Ring:
    """The circle through calibrated LEDs: middle and radius in mm, rms distance from it, azimuths in deg and the step
    to the next LED."""

    study: str
    middle: tuple[float, float]
    radius: float
    off: float
    leds: list[dict[str, Any]]


@dataclass
class Images:
    """A held-out frame as models predict it: (H, W, C) DN; the contact (H, W) bool; the mosaic of its pixels, as
    optics.study.shown.mosaic_of says it."""

    frame: str
    measured: np.ndarray
    predicted: dict[str, np.ndarray]
    usable: np.ndarray
    contact: np.ndarray
    mosaic: dict[str, Any] = field(default_factory=dict)


@dataclass
class Board:
    """All models on the held-out frames of one capture set.

    by_presses   name -> [{presses, rms, ratio}] in the contact: held-out error against the number of fitted groups
    rivals_azimuths  direction of each LED by the directional table, deg, where frames are lit by one LED
    """

    captures: str
    studies: list[str]
    fitted: list[str]
    held_out: list[str]
    frames: int
    size: tuple[int, int]
    channels: list[str]
    region: str
    full_scale: float
    entries: list[Entry]
    by_presses: dict[str, list[dict[str, Any]]]
    rings: list[Ring]
    rivals_azimuths: dict[str, float]
    notes: list[str]
    images: Images | None = field(default=None, repr=False)

    @property
    def name(self) -> str:
        return Path(self.captures).name

    @property
    def measure(self) -> str:
        """What the contact is judged by: 'ratio' where there is a flat field, else 'rms'."""
        return "ratio" if self.entries and self.entries[0].contact.ratio is not None else "rms"

    def entry(self, name: str) -> Entry:
        """Raises UnknownKey for another name."""
        for entry in self.entries:
            if entry.name == name:
                return entry
        raise UnknownKey(name, [e.name for e in self.entries], "model of the scoreboard")

    def of(self, kind: str) -> list[Entry]:
        return [e for e in self.entries if e.kind == kind]

    def best(self, kind: str) -> Entry | None:
        """The one with the smallest error in the contact."""
        return min(self.of(kind), key=lambda e: float(getattr(e.contact, self.measure)), default=None)

    @property
    def beaten(self) -> bool:
        """Whether a rival has a smaller error in the contact than the best step; False where there is no step."""
        step, rival = self.best(STEP), self.best(RIVAL)
        if step is None or rival is None:
            return False
        return float(getattr(rival.contact, self.measure)) < float(getattr(step.contact, self.measure))

    def json(self) -> dict[str, Any]:
        """Plain data, without images."""
        found = {key: value for key, value in self.__dict__.items() if key != "images"}
        found["entries"] = [{**asdict(e), "numbers_each": e.each} for e in self.entries]
        found["rings"] = [asdict(ring) for ring in self.rings]
        return plain(found)


# -- on a terminal and on disk -----------------------------------------------------------------------------------------
def text(boards: Sequence[Board]) -> str:
    """The boards as aligned tables, the contact first, and the published numbers below."""
    blocks = []
    for board in boards:
        head = (
            f"{board.captures}: {board.frames} held-out frames ({some(board.held_out)}), fitted on {some(board.fitted)}"
        )
        parts = [head, *(f"note: {note}" for note in board.notes)]
        for title, which in ((f"in the contact ({board.region})", "contact"), ("whole image", "whole")):
            parts.append("\n" + table([(title, *COLUMNS), *(_line(e, getattr(e, which)) for e in board.entries)], (0,)))
        if any(len(rows) > 1 for rows in board.by_presses.values()):
            parts.append("\n" + _presses_text(board))
        parts += ["\n" + _ring_text(ring) for ring in board.rings]
        blocks.append("\n".join(parts))
    p = PUBLISHED
    low, high = p["l1"], p["ssim"]
    blocks.append(
        f"published, on {p['images']} images of another sensor: L1 {low[0]:g} +- {low[1]:g}, SSIM {high[0]:g} +- "
        f"{high[1]:g}, PSNR {p['psnr'][0]:g} +- {p['psnr'][1]:g} dB\n({p['source']})"
    )
    return "\n\n".join(blocks)


COLUMNS = ("numbers", "each", "ratio rms", "range", "rms DN", "chi2/dof", "L1", "SSIM", "PSNR dB")


def _line(entry: Entry, level: Level) -> tuple[str, ...]:
    low, high = level.span("ratio")
    return (
        entry.name,
        "image" if entry.numbers is None else str(entry.numbers),
        number(entry.each, 4),
        "-" if level.ratio is None else f"{level.ratio:.4f}",
        f"{low:.4f}-{high:.4f}" if math.isfinite(low) else "-",
        f"{level.rms:.2f}",
        number(level.chi2_per_dof, 4),
        f"{level.l1:.4f}",
        f"{level.ssim:.3f}",
        f"{level.psnr:.1f}",
    )


def _presses_text(board: Board) -> str:
    counts = sorted({row["presses"] for rows in board.by_presses.values() for row in rows})
    what = "ratio rms" if board.measure == "ratio" else "rms DN"
    lines = [(f"{what} in the contact, by presses fitted", *map(str, counts))]
    for name, rows in board.by_presses.items():
        of = {row["presses"]: row[board.measure] for row in rows}
        lines.append((name, *(number(of.get(count)) for count in counts)))
    return table(lines, (0,))


def _ring_text(ring: Ring) -> str:
    lines = [(f"LEDs of {ring.study}", "x mm", "y mm", "azimuth deg", "step deg")]
    lines += [
        (r["led"], f"{r['x']:.2f}", f"{r['y']:.2f}", f"{r['azimuth']:.1f}", f"{r['step']:.1f}") for r in ring.leds
    ]
    x, y = ring.middle
    return (
        f"{table(lines, (0,))}\nring of {ring.radius:.2f} mm about ({x:.2f}, {y:.2f}) mm, LEDs {ring.off:.2g} mm rms "
        "off it; a step is to the next LED"
    )


def to_json(boards: Sequence[Board]) -> str:
    """scoreboard.json: all boards, and the published numbers."""
    return json.dumps({"boards": [b.json() for b in boards], "published": plain(PUBLISHED)}, indent=1, allow_nan=False)
