"""Which layout of beads feels the least force, and which is least upset by noise: Tables 1 and 2, Figures 5 and 6.

    found = tables(CONSTANTS)       thresholds, condition numbers and errors of four layouts, beside what is printed
    print(found.text())

Beads at random places in 30 x 30 mm below the face of a half-space are moved by a point force in the middle
(optics.skin.forces) and projected by a pinhole camera (optics.readers.force). All is averaged over draws.

    threshold   the force at which the largest component of the motion is half a pixel
    kappa       the condition number (10) of the reconstruction at 0.5 N, with 1000 beads
    error       root mean square error of the reconstructed force (8) where each motion has Gaussian noise of 0.5 px

The numbers of the source's Table 1 are not at hand. Those used were found from its Table 2, of which f and E are seen
through their quotient alone: both multiply every motion, to first order. f/E and d are identified, d by the beads at
6 mm. Poisson's ratio shows in the thresholds of normal forces alone, and 1/2, its end, fits best; the number of beads
hardly shows (`identified` of the result).

Source: Sensors 19 (2019) 928, section 3."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from optics.readers.force import condition, image_motion, reconstruct
from optics.skin.forces import unit_displacements
from optics.words import table

FOCAL = 286.0  # px; only f/E counts, but for the second order of the motion, which is below 1 % at half a pixel
WIDTH = 30.0  # mm
HALF_A_PIXEL = 0.5  # px
FORCE, FEW_BEADS = 0.5, 1000  # N, and beads of the condition numbers
NOISE = 0.5  # px, of the error
AGREEING = 0.12  # of a printed threshold: they have two digits, and the constants behind them are lost
LAYOUTS = {"1 mm": (1.0, 1.0), "2 mm": (2.0, 2.0), "6 mm": (6.0, 6.0), "1-6 mm": (1.0, 6.0)}
FORCES = {"shear": np.array([1.0, 0.0, 0.0]), "normal": np.array([0.0, 0.0, 1.0])}
PRINTED = {  # N: Table 2
    "1 mm": {"shear": 0.013, "normal": 0.035},
    "2 mm": {"shear": 0.027, "normal": 0.059},
    "6 mm": {"shear": 0.056, "normal": 0.084},
    "1-6 mm": {"shear": 0.018, "normal": 0.048},
}
LIMITS = {  # of the constants: name, unit, lowest, highest
    "distance": ("distance", "mm", max(deep for _, deep in LAYOUTS.values()) + 1, 1e4),
    "f_by_e": ("f/E", "px mm^2/N", 1.0, 1e6),
    "poisson": ("Poisson's ratio", "", 0.0, 0.5),
    "beads": ("beads", "", 10, 100_000),
}
ORDER = ("1 mm", "2 mm", "1-6 mm", "6 mm")  # Figures 5 and 6 in words: the worst first
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Constants:
    """Table 1: distance d of the optical centre from the face, mm; f/E, px mm^2/N; Poisson's ratio; number of beads."""

    distance: float = 20.0
    f_by_e: float = 2600.0
    poisson: float = 0.5
    beads: int = 3000

    def __post_init__(self) -> None:
        for own, (name, unit, low, high) in LIMITS.items():
            value = getattr(self, own)
            if not low <= value <= high:
                raise ValueError(
                    f"{name} = {value:g} {unit}".rstrip() + f"; allowed: {low:g} to {high:g} {unit}".rstrip()
                )

    @property
    def young(self) -> float:
        """N/mm^2 that belongs to FOCAL."""
        return FOCAL / self.f_by_e

    def unit(self, points: np.ndarray) -> np.ndarray:
        """(N, 3, 3) displacement of each bead per unit force, mm/N."""
        return unit_displacements(points, self.young, self.poisson)


CONSTANTS = Constants()


def draw(layout: str, seed: int, beads: int = CONSTANTS.beads) -> np.ndarray:
    """(N, 3) places x, y, h of beads, mm."""
    rng = np.random.default_rng([seed, list(LAYOUTS).index(layout)])
    return np.concatenate(
        [rng.uniform(-WIDTH / 2, WIDTH / 2, (beads, 2)), rng.uniform(*LAYOUTS[layout], (beads, 1))], 1
    )


def threshold(layout: str, kind: str, constants: Constants = CONSTANTS, draws: int = 20) -> float:
    """N: the force at which the largest component of the motion, averaged over draws, is half a pixel."""
    from scipy.optimize import brentq

    drawn = [draw(layout, seed, constants.beads) for seed in range(draws)]
    moved = [constants.unit(points) @ FORCES[kind] for points in drawn]

    def excess(force: float) -> float:
        motions = [image_motion(p, u * force, FOCAL, constants.distance) for p, u in zip(drawn, moved)]
        return float(np.mean([np.abs(m).max() for m in motions])) - HALF_A_PIXEL

    high = 1e-3
    while excess(high) < 0:
        high *= 1.5  # in small steps: a large force would push beads behind the camera
    return brentq(excess, 0.0, high, xtol=1e-6)


def kappa(layout: str, kind: str, constants: Constants = CONSTANTS, draws: int = 20, force: float = FORCE) -> float:
    """N/px: the condition number (10), averaged over draws."""
    found = []
    for seed in range(draws):
        points = draw(layout, seed, FEW_BEADS)
        found.append(condition(points, force * FORCES[kind], constants.unit(points), FOCAL, constants.distance))
    return float(np.mean(found))


def noisy_error(
    layout: str, kind: str, sd: float, constants: Constants = CONSTANTS, draws: int = 20, force: float = FORCE
) -> float:
    """N: root mean square error of the force vector when each motion has Gaussian noise of sd px."""
    errors = []
    for seed in range(draws):
        points = draw(layout, seed, FEW_BEADS)
        unit, applied = constants.unit(points), force * FORCES[kind]
        motion = image_motion(points, unit @ applied, FOCAL, constants.distance)
        motion = motion + np.random.default_rng([seed, list(LAYOUTS).index(layout), 9]).normal(0, sd, motion.shape)
        errors.append(reconstruct(points, motion, unit, FOCAL, constants.distance) - applied)
    return float(np.sqrt(np.mean(np.sum(np.square(errors), -1))))


@dataclass(frozen=True)
class Tables:
    """thresholds, kappas, errors   by layout and kind of force;   exact  largest error of (8) without noise, relative
    identified   relative change of each threshold where one constant changes by a tenth, by change, layout and kind"""

    constants: Constants
    draws: int
    thresholds: dict[str, dict[str, float]]
    kappas: dict[str, dict[str, float]]
    errors: dict[str, dict[str, float]]
    exact: float
    identified: dict[str, dict[str, dict[str, float]]]

    @property
    def off(self) -> dict[str, dict[str, float]]:
        """Departure of each threshold from the printed one, relative."""
        return {la: {k: v / PRINTED[la][k] - 1 for k, v in own.items()} for la, own in self.thresholds.items()}

    def order(self, values: dict[str, dict[str, float]], kind: str) -> tuple[str, ...]:
        """Layouts, the worst first."""
        return tuple(sorted(LAYOUTS, key=lambda layout: -values[layout][kind]))

    @property
    def agrees(self) -> bool:
        """Whether every threshold is within AGREEING of the printed one and every order the printed one."""
        near = all(abs(v) <= AGREEING for own in self.off.values() for v in own.values())
        return near and all(self.order(v, kind) == ORDER for v in (self.kappas, self.errors) for kind in FORCES)

    def record(self) -> dict:
        """For programs."""
        found = {k: v for k, v in asdict(self).items() if k != "constants"}
        return {"constants": asdict(self.constants), **found, "printed": PRINTED, "order": ORDER, "agrees": self.agrees}

    def text(self) -> str:
        """The tables as the command line prints them."""
        c, pieces = self.constants, []
        pieces.append(
            f"Table 1, as found from Table 2 (its printed numbers are not at hand): d = {c.distance:g} mm, f/E = "
            f"{c.f_by_e:g} px mm^2/N,\nPoisson's ratio {c.poisson:g}, {c.beads} beads; averages of {self.draws} draws"
        )
        rows: list[tuple[str, ...]] = [("layout", *(x for kind in FORCES for x in (kind, "printed", "off")))]
        for layout, own in self.thresholds.items():
            cells = [(f"{own[k]:.4f}", f"{PRINTED[layout][k]:.3f}", f"{self.off[layout][k]:+.0%}") for k in FORCES]
            rows.append((layout, *(x for cell in cells for x in cell)))
        pieces.append("Table 2: threshold, N\n" + table(rows))
        rows = [("layout", *(f"{what}, {kind}" for what in ("kappa", "error") for kind in FORCES))]
        for layout in LAYOUTS:
            numbers = [values[layout][kind] for values in (self.kappas, self.errors) for kind in FORCES]
            rows.append((layout, *(f"{v:.4f}" for v in numbers)))
        pieces.append(
            f"Figure 5: condition number kappa at {FORCE:g} N, N/px, {FEW_BEADS} beads. Figure 6: error of the force "
            f"at a noise of {NOISE:g} px, N\n" + table(rows)
        )
        rows = [("order, the worst first", *FORCES, "printed")]
        for name, values in (("Figure 5, kappa", self.kappas), ("Figure 6, error", self.errors)):
            rows.append((name, *(" > ".join(self.order(values, kind)) for kind in FORCES), " > ".join(ORDER)))
        pieces.append(table(rows) + f"\nwithout noise (8) is exact: largest error {self.exact:.1e} of the force")
        rows = [("", *(f"{la}, {kind}" for la in LAYOUTS for kind in FORCES))]
        for name, change in self.identified.items():
            rows.append((name, *(f"{change[la][kind]:+.1%}" for la in LAYOUTS for kind in FORCES)))
        pieces.append(
            "What Table 2 identifies: change of the thresholds where a constant changes by a tenth. f and E show "
            "through their\nquotient alone; f/E and d are identified, Poisson's ratio shows in normal forces alone, "
            "the number of beads hardly\n" + table(rows)
        )
        return "\n\n".join(pieces)


def tables(constants: Constants = CONSTANTS, draws: int = 20, progress: Progress | None = None) -> Tables:
    """Both tables and the numbers of both figures."""
    wanted = (("f/E", "f_by_e", 1), ("d", "distance", 1), ("Poisson's ratio", "poisson", -1), ("beads", "beads", 1))
    changes = dict(_tenth(constants, *each) for each in wanted)
    done, total = 0, (4 + len(changes)) * len(LAYOUTS) * len(FORCES)
    few = min(draws, 5)

    def each(function: Callable[[str, str], float]) -> dict[str, dict[str, float]]:
        nonlocal done
        found: dict[str, dict[str, float]] = {}
        for layout in LAYOUTS:
            for kind in FORCES:
                found.setdefault(layout, {})[kind] = function(layout, kind)
                done += 1
                if progress:
                    progress("layouts of beads", done, total)
        return found

    def exact(layout: str, kind: str) -> float:
        return noisy_error(layout, kind, 0.0, constants, few) / FORCE

    before = each(lambda la, k: threshold(la, k, constants, few))
    identified = {}
    for name, change in changes.items():
        other = replace(constants, **change)
        after = each(lambda la, k, other=other: threshold(la, k, other, few))  # type: ignore[misc]
        identified[name] = {la: {k: after[la][k] / before[la][k] - 1 for k in FORCES} for la in LAYOUTS}
    return Tables(
        constants,
        draws,
        each(lambda la, k: threshold(la, k, constants, draws)),
        each(lambda la, k: kappa(la, k, constants, draws)),
        each(lambda la, k: noisy_error(la, k, NOISE, constants, 3 * draws)),
        max(exact(layout, kind) for layout in LAYOUTS for kind in FORCES),
        identified,
    )


def _tenth(constants: Constants, title: str, name: str, sign: int) -> tuple[str, dict[str, Any]]:
    """A constant changed by a tenth: upwards (sign 1), or the other way where that leaves its limits."""
    now, (_, _, low, high) = getattr(constants, name), LIMITS[name]
    sign = sign if low <= (1 + sign / 10) * now <= high else -sign
    after = (1 + sign / 10) * now
    return f"{title} {'+' if sign > 0 else '-'} 10 %", {name: round(after) if isinstance(now, int) else after}


def plot(file: Path, constants: Constants = CONSTANTS, draws: int = 20, progress: Progress | None = None) -> None:
    """Figure 5 above Figure 6: kappa over the force, error over the noise, for shear and normal forces."""
    from matplotlib.figure import Figure

    from optics.files.output import replacing

    forces, noises = np.linspace(0.1, 1.0, 7), np.linspace(0.0, 1.0, 6)
    figure = Figure((9, 7), layout="constrained")
    axes = figure.subplots(2, 2, sharey="row")
    for column, kind in enumerate(FORCES):
        for k, layout in enumerate(LAYOUTS):
            above = [kappa(layout, kind, constants, draws, f) for f in forces]
            below = [noisy_error(layout, kind, sd, constants, draws) for sd in noises]
            axes[0, column].plot(forces, above, label=layout)
            axes[1, column].plot(noises, below, label=layout)
            if progress:
                progress("figures", column * len(LAYOUTS) + k + 1, 2 * len(LAYOUTS))
        axes[0, column].set(title=f"{kind} force", xlabel="force, N")
        axes[1, column].set(xlabel=f"noise of the motion, px, at {FORCE:g} N")
    axes[0, 0].set_ylabel("condition number, N/px")
    axes[1, 0].set_ylabel("error of the force, N")
    axes[1, 0].legend(title="beads at", frameon=False)
    with replacing(file) as temporary:
        figure.savefig(temporary, dpi=110)
