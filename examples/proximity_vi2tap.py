"""Proximity with the Vi2TaP finger: three cylinders approach, the metric r of eq. (9) reads the distance; and where it
fails.

    python examples/proximity_vi2tap.py [image.png]

Follows the camera's rays through analyser, skin and film of the shipped finger to cylinders of 20, 30 and 40 mm
diameter, 60 to 10 mm before the skin, lying across the view and standing on end. The depth map that the rays give
stands for the paper's monocular depth network, without its errors. The 20 mm cylinder is the reference: its curve turns
r of the others into a distance. Prints the curves, how far they agree, what is read at 10 mm, and where a hand stops
that stops at the reference's r of 10 mm. The paper's hand stops at 11.51 (30 mm) and 12.58 mm (40 mm). With 320 x 240
px lying cylinders give 10.3 and 11.0 mm, in the paper's order and 1.2 and 1.5 mm short of it: from 13 to 9 mm the
outline of the 20 mm cylinder runs behind a row of markers, where its area hardly grows, and nothing here has the
network's errors."""

import sys
from pathlib import Path

import numpy as np

from optics.light.renderer import Renderer
from optics.readers import proximity
from optics.scene import loader as scenes

DISTANCES = np.array([60.0, 50.0, 42.0, 35.0, 30.0, 25.0, 20.0, 15.0, 12.0, 10.0])  # mm
NEARER = np.array([8.5, 7.0])  # mm: the reference's curve goes on, for objects that read as nearer than they are
DIAMETERS = (20.0, 30.0, 40.0)  # mm
FIRST = 35.0  # mm: where an object is first detected, the end of the range that the paper calls reliable
SIZE = (160, 120)  # px
FAR = 140.0  # mm: the wall is behind


def approach(stance: str):
    """(depth map (H, W) in mm of a cylinder's diameter and distance, pixels hidden by markers and body (H, W))."""
    scene = scenes.load("vi2tap", {"width": str(SIZE[0]), "height": str(SIZE[1]), "stance": stance})
    renderer, values = Renderer(scene), scene.values()
    shapes = [s.id() for s in scene.mitsuba.shapes()]
    front = [i for i, name in enumerate(shapes) if name == "markers" or name.startswith("body")]

    def depth(diameter: float, distance: float) -> tuple[np.ndarray, np.ndarray]:
        hits = renderer.hits({**values, "object.diameter": diameter, "object.distance": distance})
        return hits.position[..., 2], np.isin(hits.path.shape.reshape(SIZE[::-1]), front)

    return depth


def curves(stance: str = "lying") -> tuple[dict[float, np.ndarray], np.ndarray]:
    """r of each diameter at DISTANCES; and of the reference at NEARER."""
    depth = approach(stance)

    def area(diameter: float, distance: float) -> float:
        image, hidden = depth(diameter, distance)
        return proximity.area(image, threshold=FAR, hidden=hidden)

    areas = {d: np.array([area(d, z) for z in DISTANCES]) for d in DIAMETERS}
    first = {d: float(np.interp(FIRST, DISTANCES[::-1], a[::-1])) for d, a in areas.items()}
    near = np.array([area(DIAMETERS[0], z) for z in NEARER])
    one = first[DIAMETERS[0]]
    return (
        {d: proximity.metric(a, first[d], one, SIZE[0] * SIZE[1]) for d, a in areas.items()},
        proximity.metric(near, one, one, SIZE[0] * SIZE[1]),
    )


def main(image_file: str = "renders/proximity.png") -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True)
    for axis, stance in zip(axes, ("lying", "standing")):
        r, nearer = curves(stance)
        reference, at = np.concatenate([r[DIAMETERS[0]], nearer]), np.concatenate([DISTANCES, NEARER])
        print(f"{stance}\ndistance (mm)  " + "  ".join(f"r of {d:g} mm" for d in DIAMETERS))
        for i, z in enumerate(DISTANCES):
            print(f"{z:13g}  " + "  ".join(f"{r[d][i]:10.4f}" for d in DIAMETERS))
        rising = all(np.all(np.diff(curve) > 0) for curve in r.values())
        agree = proximity.reliable_range(DISTANCES, {f"D{d:g}": curve for d, curve in r.items()}, 0.15)
        read = {d: float(proximity.distance(r[d][-1], reference, at)) for d in DIAMETERS[1:]}
        print(
            f"r rises at every step: {'yes' if rising else 'no'}; curves agree within 15 % up to {agree:.0f} mm; "
            "where the "
            f"cylinders stand at {DISTANCES[-1]:g} mm the reference's curve reads "
            + ", ".join(f"{v:.2f} mm for D{d:g}" for d, v in read.items())
        )
        stops = {d: float(proximity.distance(r[DIAMETERS[0]][-1], r[d], DISTANCES)) for d in DIAMETERS[1:]}
        print(
            f"a hand that stops at the reference's r of {DISTANCES[-1]:g} mm stops at "
            + ", ".join(
                f"{v:.2f} mm from D{d:g}" if np.isfinite(v) else f"less than {DISTANCES[-1]:g} mm from D{d:g}"
                for d, v in stops.items()
            )
            + "\n"
        )
        for d, curve in r.items():
            axis.plot(DISTANCES, curve, "o-", ms=3, label=f"D{d:g}")
        axis.set_xlabel("distance (mm)")
        axis.set_title(f"{stance} cylinders")
    axes[0].set_ylabel("r")
    axes[0].legend()
    figure.tight_layout()
    Path(image_file).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(image_file, dpi=110)


if __name__ == "__main__":
    main(*sys.argv[1:])
