"""What a printed grid says of its surroundings: still, something near, a flashlight, a touch; read by Algorithms 1-3,
beside the paper.

    python examples/states_magictac.py [image.png]

Renders the shipped grid with a rod of 20 mm, as thick as a finger, that comes near and presses, and with light from
before the skin; makes frames of 8 bits of them, with noise; and reads entropy, correlation of the channels and
similarity of the grid with the published thresholds. Two cameras look: one keeps its exposure, the other the mean of
its frames, as automatic exposure does. Prints a table, with what MagicGripper's Figures 21 and 25 to 29 show, and draws
the frames above the curves.

What to see: the published drops of the similarity, under touch and under a flashlight, are a camera's that dims its
image. With a fixed exposure light only adds, and more of an image stays above 35 DN."""

import sys
from pathlib import Path

import numpy as np

from optics.captures.noise import Noise
from optics.light.monte_carlo import MonteCarloRenderer
from optics.readers import grid
from optics.scene import loader as scenes

FAR = 60.0  # mm: nothing near
NEAR = (20.0, 10.0, 5.0, 2.0)  # mm before the skin
TORCH = (1e-5, 3e-5, 1e-4)  # radiance from before the skin; the still grid's is 1.6e-5 in the mean
DEPTHS = (0.05, 0.2, 0.6, 1.0)  # mm into it
NOISE = Noise(
    system_gain=0.005, dark_noise=0.2, black_level=0.0, saturation=255.0, prnu=0.0
)  # still reads as the paper's 0.48 bit
FRAMES = 30  # N of Algorithm 1
MEAN = 60.0  # DN of the still frame
BRIGHT = 6.0  # times the light of the still frame, in all channels: touched cells
SCENE = {
    "width": "80",
    "height": "60",
    "rays": "96",
    "packets": "150000",
    "scattering": "0.05",
    "stance": "lying",
    "diameter": "20",
}
PUBLISHED = {
    "still": "0.48 bit indoors; S 0.85",
    "approach": "E up, to 4; C down, 0.2 to 0",
    "flashlight": "E up; C to nearly 1; S < 0.5",
    "touch": "S from 0.85 to < 0.8; wider with force",
}


def images() -> list[tuple[str, str, np.ndarray]]:
    """(state, what is set, radiance (H, W, 3) in R, G, B)."""
    scene = scenes.load("magictac", SCENE)
    renderer, values = MonteCarloRenderer(scene), scene.values()
    settings = [("still", "nothing near", {"object.distance": FAR})]
    settings += [("approach", f"{d:g} mm", {"object.distance": d}) for d in NEAR]
    settings += [("flashlight", f"L = {power:g}", {"object.distance": FAR, "room.power": power}) for power in TORCH]
    settings += [("touch", f"{d:g} mm deep", {"object.distance": -d}) for d in DEPTHS]
    made = []
    for state, what, own in settings:
        print(f"\r{len(made)} of {len(settings)} images", end="", file=sys.stderr, flush=True)
        made.append((state, what, renderer.radiance({**values, **own})))
    print("\r", end="", file=sys.stderr)
    return made


def held(image: np.ndarray) -> np.ndarray:
    """DN of a camera that keeps the mean of its frame, clipped values and all."""
    low, high = 0.0, 100.0 * MEAN / image.mean()
    for _ in range(60):
        gain = (low + high) / 2
        low, high = (gain, high) if np.clip(image * gain, 0, 255).mean() < MEAN else (low, gain)
    return np.clip(image * high, 0, 255)


def readings(made) -> tuple[dict, dict, list[float]]:
    """Frames by camera; rows of the readers by camera, for bright cells and for dark walls; share of touched cells in
    the view."""
    rng, exposure = np.random.default_rng(1), MEAN / made[0][2].mean()
    cameras = {"fixed": lambda image: np.clip(image * exposure, 0, 255), "holds its mean": held}
    frames, rows = {}, {}
    for name, camera in cameras.items():
        still = [NOISE.expose(camera(made[0][2]), rng) for _ in range(FRAMES)]
        frames[name] = [NOISE.expose(camera(image), rng) for _, _, image in made]
        rows[name] = [grid.read_sequence(frames[name], grid.references(still, dark=dark)) for dark in (False, True)]
    floor = np.maximum(made[0][2], 0.3 * made[0][2].mean())  # walls are dark
    return frames, rows, [float(((image / floor).min(-1) > BRIGHT).mean()) for _, _, image in made]


def main(image_file: str = "renders/states.png") -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    made = images()
    frames, rows, wide = readings(made)
    print(
        f"thresholds {grid.BINARY:g} DN, E {grid.ENTROPY:g} bit, C {grid.CORRELATION:g}, S {grid.SIMILARITY:g}; "
        f"still frame {MEAN:g} DN in the mean"
    )
    print(f"{'':26}{'exposure fixed':^46}  {'the mean held':^28}")
    print(
        "state       set to           E     C     S     bright  Algorithm 2  Algorithm 3  S     walls' S  "
        "Algorithm 3  published"
    )
    for k, (state, what, _) in enumerate(made):
        a, b, walls = rows["fixed"][0][k], rows["holds its mean"][0][k], rows["holds its mean"][1][k]
        said = PUBLISHED[state] if k == 0 or made[k - 1][0] != state else ""
        print(
            f"{state:<11} {what:<14} {a.entropy:5.2f} {a.correlation:5.2f}  {a.similarity:4.2f}  {wide[k]:7.1%}  "
            f"{a.proximity:<11}  {a.contact:<11}  "
            f"{b.similarity:4.2f}  {walls.similarity:8.2f}  {b.contact:<11}  {said}".rstrip()
        )

    figure = plt.figure(figsize=(1.3 * len(made), 5.6))
    heights = figure.add_gridspec(
        3, len(made), height_ratios=(1, 1, 2.2), hspace=0.12, wspace=0.04, left=0.05, right=0.995, top=0.9, bottom=0.13
    )
    for row, name in enumerate(frames):
        for k, (state, what, _) in enumerate(made):
            axis = figure.add_subplot(heights[row, k])
            axis.imshow(frames[name][k].astype(np.uint8))
            axis.set_xticks([])
            axis.set_yticks([])
            if row == 0:
                axis.set_title(f"{state}\n{what}", fontsize=8)
            if k == 0:
                axis.set_ylabel("exposure\nfixed" if row == 0 else "mean\nheld", fontsize=8)
    axis, at = figure.add_subplot(heights[2, :]), np.arange(len(made))
    a, b, walls = rows["fixed"][0], rows["holds its mean"][0], rows["holds its mean"][1]
    for label, values, colour, style in (
        ("entropy / 8 bit", [r.entropy / 8 for r in a], "tab:blue", "o-"),
        ("correlation", [r.correlation for r in a], "tab:red", "o-"),
        ("similarity, exposure fixed", [r.similarity for r in a], "0.6", "s--"),
        ("similarity, mean held", [r.similarity for r in b], "tab:green", "s-"),
        ("similarity of dark walls, mean held", [r.similarity for r in walls], "tab:olive", "s-"),
    ):
        axis.plot(at, values, style, ms=4, lw=1, label=label, color=colour)
    for level, colour, name in (
        (grid.ENTROPY / 8, "tab:blue", "0.5 bit"),
        (grid.CORRELATION, "tab:red", "0.2"),
        (grid.SIMILARITY, "tab:green", "0.6"),
    ):
        axis.axhline(level, color=colour, lw=0.7, ls=":")
        axis.text(len(made) - 0.52, level, name, color=colour, fontsize=7, ha="right", va="bottom")
    for state, said in PUBLISHED.items():
        inside = [k for k, m in enumerate(made) if m[0] == state]
        axis.axvspan(
            inside[0] - 0.5, inside[-1] + 0.5, color="0.5", alpha=0.08 * (list(PUBLISHED).index(state) % 2), lw=0
        )
        words = said.replace("; ", ";\n") if len(inside) < 3 else said
        axis.text(
            np.mean(inside),
            -0.28,
            f"published: {words}" if len(inside) > 2 else f"published:\n{words}",
            fontsize=7,
            ha="center",
            va="top",
        )
    axis.set_xticks([])
    axis.set_xlim(-0.5, len(made) - 0.5)
    axis.set_ylim(-0.25, 1.05)
    axis.legend(fontsize=7, ncol=5, loc="lower left", bbox_to_anchor=(0, 0.99), frameon=False)
    Path(image_file).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(image_file, dpi=120)


if __name__ == "__main__":
    main(*sys.argv[1:])
