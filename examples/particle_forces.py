"""Table 2 and Figures 5 and 6 of the particle sensor: which layout of beads feels the least force, which is least upset
by noise.

    python examples/particle_forces.py

Draws beads at random in 30 x 30 mm below the face of a half-space, moves them by a point force in the middle
(Boussinesq and Cerruti) and projects them with a pinhole camera, as Sensors 19 (2019) 928 does in section 3. Printed
beside each other: the threshold (the smallest force at which the largest motion in the image, averaged over draws,
is half a pixel) and the published one; the condition number kappa of the reconstruction at 0.5 N; and the error of the
force when the motions have noise.

The published table of constants is lost. Those used here were found from Table 2 itself: d = 20 mm, f/E = 2600
px mm^2/N, nu = 1/2, 3000 beads. Only f/E and d are identified: to first order the thresholds depend on f and E
through f/E alone, nu
changes them by a few per cent, and the number of beads by its logarithm."""

import numpy as np

from optics.readers.force import condition, image_motion, reconstruct
from optics.skin.forces import unit_displacements

DISTANCE = 20.0  # mm, from the optical centre to the face
FOCAL, YOUNG = 286.0, 0.11  # px and N/mm^2: only the quotient counts
POISSON = 0.5
BEADS = 3000
DRAWS = 20
WIDTH = 30.0  # mm
HALF_A_PIXEL = 0.5  # px
LAYOUTS = {"1 mm": (1.0, 1.0), "2 mm": (2.0, 2.0), "6 mm": (6.0, 6.0), "1-6 mm": (1.0, 6.0)}
FORCES = {"shear": np.array([1.0, 0.0, 0.0]), "normal": np.array([0.0, 0.0, 1.0])}
PRINTED = {  # N: Table 2
    "1 mm": {"shear": 0.013, "normal": 0.035},
    "2 mm": {"shear": 0.027, "normal": 0.059},
    "6 mm": {"shear": 0.056, "normal": 0.084},
    "1-6 mm": {"shear": 0.018, "normal": 0.048},
}


def draw(layout: str, seed: int, beads: int = BEADS) -> np.ndarray:
    """(N, 3) places x, y, h of beads, mm."""
    rng = np.random.default_rng([seed, list(LAYOUTS).index(layout)])
    return np.concatenate(
        [rng.uniform(-WIDTH / 2, WIDTH / 2, (beads, 2)), rng.uniform(*LAYOUTS[layout], (beads, 1))], 1
    )


def threshold(
    layout: str, kind: str, draws: int = DRAWS, distance: float = DISTANCE, f_by_e: float = FOCAL / YOUNG
) -> float:
    """N: the force at which the largest component of the motion, averaged over draws, is half a pixel."""
    from scipy.optimize import brentq

    drawn = [draw(layout, seed) for seed in range(draws)]
    units = [unit_displacements(points, 1.0, POISSON) @ FORCES[kind] for points in drawn]  # at E = 1

    def excess(force: float) -> float:
        # the motion is that of f and E together: u goes with F/E, the image with f
        young = FOCAL / f_by_e
        motions = [image_motion(p, u * force / young, FOCAL, distance) for p, u in zip(drawn, units)]
        return float(np.mean([np.abs(m).max() for m in motions])) - HALF_A_PIXEL

    return brentq(excess, 1e-4, 0.5, xtol=1e-6)


def noisy_error(layout: str, kind: str, sd: float, force: float = 0.5, beads: int = 1000, draws: int = 60) -> float:
    """N: root mean square error of the force vector when each motion has Gaussian noise of sd px (Figure 6)."""
    errors = []
    for seed in range(draws):
        points = draw(layout, seed, beads)
        unit = unit_displacements(points, YOUNG, POISSON)
        applied = force * FORCES[kind]
        motion = image_motion(points, unit @ applied, FOCAL, DISTANCE)
        motion = motion + np.random.default_rng([seed, list(LAYOUTS).index(layout), 9]).normal(0, sd, motion.shape)
        errors.append(reconstruct(points, motion, unit, FOCAL, DISTANCE) - applied)
    return float(np.sqrt(np.mean(np.sum(np.square(errors), -1))))


def kappa(layout: str, kind: str, force: float = 0.5, beads: int = 1000, draws: int = 20) -> float:
    """N/px: the condition number (10), averaged over draws (Figure 5)."""
    found = []
    for seed in range(draws):
        points = draw(layout, seed, beads)
        unit = unit_displacements(points, YOUNG, POISSON)
        found.append(condition(points, force * FORCES[kind], unit, FOCAL, DISTANCE))
    return float(np.mean(found))


def main() -> None:
    print(f"d = {DISTANCE:g} mm, f/E = {FOCAL / YOUNG:g} px mm^2/N, nu = {POISSON:g}, {BEADS} beads, {DRAWS} draws")
    print("\nTable 2: threshold, N                 shear                       normal")
    print(f"{'layout':12}" + 2 * f"{'here':>10}{'printed':>10}{'':>8}")
    for layout, printed in PRINTED.items():
        row = f"{layout:12}"
        for kind in FORCES:
            own = threshold(layout, kind)
            row += f"{own:10.4f}{printed[kind]:10.3f}{own / printed[kind] - 1:+8.0%}"
        print(row)
    print("\nFigure 5: kappa at 0.5 N, N/px, 1000 beads (the published figure has no numbers; order: 1 mm worst, then")
    print("2 mm, 1-6 mm, and 6 mm best); Figure 6: error of the force at a noise of 0.5 px, N")
    print(f"{'layout':12}{'kappa shear':>14}{'normal':>10}{'error shear':>16}{'normal':>10}")
    for layout in LAYOUTS:
        found = [kappa(layout, k) for k in FORCES] + [noisy_error(layout, k, 0.5) for k in FORCES]
        print(f"{layout:12}{found[0]:14.4f}{found[1]:10.4f}{found[2]:16.4f}{found[3]:10.4f}")
    for kind in FORCES:
        order = sorted(LAYOUTS, key=lambda layout: -kappa(layout, kind))
        print(f"order of kappa, {kind}, worst first: {', '.join(order)}")
    print("\nWhat Table 2 identifies: shear and normal threshold at 1 mm and 6 mm when one constant is changed by 10 %")
    for name, change in (
        ("as above", {}),
        ("f/E", {"f_by_e": 1.1 * FOCAL / YOUNG}),
        ("d", {"distance": 1.1 * DISTANCE}),
    ):
        found = [threshold(la, k, 5, **change) for la in ("1 mm", "6 mm") for k in FORCES]
        print(f"{name:12}" + "".join(f"{v:10.4f}" for v in found))


if __name__ == "__main__":
    main()
