"""Beads at random places: a seeded draw without overlaps, and how far they sink before the gel is hard.

    places = draw(3000, (29.4, 29.4, 3.7), diameters, seed=0)       (N, 3) in the unit cube
    settled(600.0)                                                  mm in ten minutes

Source: Sensors 19 (2019) 928, section 2 and appendix A. Its (A3) as printed lacks a factor 1/b; with it 0.35 mm come
out, as its text says."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

JAMMED = 0.384  # of the volume: where random sequential addition of equal balls ends (Widom's problem)


def lots(count: int, seed: int) -> np.ndarray:
    """(N,) one normal number for each bead, which says whether it is large or small."""
    return np.random.default_rng([seed, 1]).standard_normal(count)


def sizes(count: int, diameter: float, spread: float, seed: int) -> np.ndarray:
    """(N,) diameters in mm: log-normal about a mean, with the relative standard deviation `spread`."""
    if spread == 0:
        return np.full(count, float(diameter))
    return diameter * np.exp(spread * lots(count, seed) - spread**2 / 2)


def write_places(path: Path, points: np.ndarray, diameters: np.ndarray | None = None) -> None:
    """Write (N, 3) middles in the world, mm, and (N,) diameters as a table `x,y,depth[,diameter]`."""
    table = np.column_stack([points[:, :2], -points[:, 2], *([] if diameters is None else [diameters])])
    names = "x,y,depth" + ("" if diameters is None else ",diameter")
    np.savetxt(path, table, fmt="%.6f", delimiter=",", header=names, comments="")


def read_places(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """(N, 3) middles in the world, mm, and (N,) diameters or None, of a table with the columns `x`, `y`, `depth` below
    the face, and perhaps `diameter`, mm. Raises ValueError with the file, the line and what is allowed."""
    allowed = "allowed: a table of numbers, mm, whose first line is x,y,depth or x,y,depth,diameter"
    try:
        lines = [line.strip() for line in Path(path).read_text(encoding="utf-8").splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"places of beads: {path}: unreadable: {error}; {allowed}") from error
    names = lines[0].replace(" ", "").split(",") if lines else []
    if names not in (["x", "y", "depth"], ["x", "y", "depth", "diameter"]):
        raise ValueError(f"places of beads: {path}: the first line is '{lines[0] if lines else ''}'; {allowed}")
    rows = []
    for number, line in enumerate(lines[1:], 2):
        if not line:
            continue
        try:
            row = [float(word) for word in line.split(",")]
        except ValueError:
            row = []
        if len(row) != len(names) or not np.isfinite(row).all():
            raise ValueError(f"places of beads: {path}, line {number}: '{line[:60]}'; {allowed}")
        if len(row) == 4 and not row[3] > 0:
            raise ValueError(f"places of beads: {path}, line {number}: diameter = {row[3]:g} mm; allowed: above 0")
        rows.append(row)
    if not rows:
        raise ValueError(f"places of beads: {path} has no bead; {allowed}")
    table = np.array(rows)
    return table[:, :3] * [1, 1, -1], table[:, 3] if len(names) == 4 else None


def draw(
    count: int,
    box: tuple[float, float, float],
    diameters: np.ndarray,
    seed: int = 0,
    name: str = "beads",
    tries: int = 400,
) -> np.ndarray:
    """(N, 3) places in the unit cube of balls whose middles lie in a box (mm) and that do not overlap.

    Random sequential addition: the balls come one after another, and one that overlaps is drawn again, `tries` times.
    Raises ValueError where they do not fit."""
    box = np.asarray(box, float)
    if not (box > 0).all():
        raise ValueError(
            f"'{name}': the middles of the beads have {box[0]:g} x {box[1]:g} x {box[2]:g} mm; allowed: a body larger "
            "than a bead, a top above the bottom"
        )
    filled = float((np.pi / 6 * diameters**3).sum() / np.prod(box + diameters.max()))
    refusal = (
        f"'{name}': {count} beads of {diameters.mean():.3g} mm do not fit without overlaps: they would fill "
        f"{filled:.0%} of the body, and a random draw ends at {JAMMED:.0%} at most"
    )
    advice = "allowed: fewer or smaller beads, or a larger body"
    if filled > JAMMED:
        raise ValueError(f"{refusal}; {advice}")
    rng = np.random.default_rng([seed, 0])
    cell = float(diameters.max())
    grid: dict[tuple[int, int, int], list[int]] = {}
    unit, places = np.empty((count, 3)), np.empty((count, 3))
    around = [(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)]
    for n in range(count):
        for _ in range(tries):
            at = rng.random(3)
            p = at * box
            c = tuple(int(v) for v in p // cell)
            near = [m for o in around for m in grid.get((c[0] + o[0], c[1] + o[1], c[2] + o[2]), ())]
            apart = (diameters[n] + diameters[near]) / 2
            if not near or (((places[near] - p) ** 2).sum(-1) >= apart**2).all():
                break
        else:
            raise ValueError(refusal + f"; number {n + 1} found no place in {tries} draws; {advice}")
        unit[n], places[n] = at, p
        grid.setdefault(c, []).append(n)
    return unit


def settled(
    time: float,
    radius: float = 0.25,
    density: float = 1020.0,
    around: float = 980.0,
    viscosity: float = 9.3,
    gravity: float = 9.81,
) -> float:
    """mm that a ball sinks in a fluid in a time, s, from rest (A1)-(A3).

    radius   mm;   density, around   of the ball and of the fluid, kg/m^3;   viscosity  Pa s;   gravity  m/s^2"""
    r = radius * 1e-3
    volume, drag = 4 / 3 * math.pi * r**3, 6 * math.pi * viscosity * r
    lag = density * volume / drag  # s
    return (density - around) * volume * gravity / drag * (time + lag * math.expm1(-time / lag)) * 1e3
