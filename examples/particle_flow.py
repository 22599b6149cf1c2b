"""How well optical flow finds the motion of beads that a rendering shows: sparse and dense, by the depth of the bead.

    python examples/particle_flow.py [pixels]

Renders the particle gel at rest and pressed by 1.5 mm (480 x 480 px, or as many as asked for), at several places, finds
the beads and their motion as a robot would, and holds it to the motion that the beads were given, projected by the
fisheye. A bead counts where its middle shows: what is hidden has no motion to be seen. Prints the median error in px of
the sparse and the dense reader by depth of the bead, the share of the keypoints that was lost, and the error of the
features (11) in 20 x 20 bins."""

import sys
import time

import numpy as np

from optics.light.rendering import RenderJob
from optics.readers import flow
from optics.scene import loader

PRESSES = ((0.0, 0.0), (4.0, -3.0), (-8.0, 6.0))  # mm
DEPTH = 1.5  # mm
LAYERS = ((0.4, 1.3), (1.3, 2.2), (2.2, 3.2), (3.2, 4.1))  # mm below the face: of beads


def seen(scene, centres: np.ndarray) -> np.ndarray:
    """(N,) whether a bead's middle shows and is not hidden by another one."""
    import mitsuba as mi

    at = scene.camera.project(centres)
    o, d = scene.camera.ray(*(mi.Float(a.astype("f")) for a in at.T))
    si = scene.traced.scene.ray_intersect(mi.Ray3f(o, d, mi.Float(0), scene.integrator.wavelengths(len(at))))
    width, height = scene.camera.resolution
    hit = np.linalg.norm(np.array(si.p, float).T - centres, axis=-1) < 0.51 * scene.parts["beads"].diameters()
    return hit & (at > 4).all(-1) & (at[:, 0] < width - 4) & (at[:, 1] < height - 4)


def take(job, values: dict, seed: int) -> np.ndarray:
    """DN of one image with the noise of a camera: 10 bit of full well, 1 DN of read noise."""
    image = job.take(values).camera
    rng = np.random.default_rng(seed)
    return np.clip(np.rint(image + rng.normal(0, np.sqrt(1 + np.maximum(image, 0) * 0.1))), 0, 255)


def measure(size: int = 480, presses=PRESSES, spp: int | None = None) -> dict:
    """Errors in px of each reader's motions: "sparse", "dense" (N, 2) depth and error; "shift" the true motions."""
    scene = loader.load("particle_gel", {"width": str(size), "height": str(size)})
    job = RenderJob(scene, layers=(), spp=spp)
    beads = scene.parts["beads"]
    rest = take(job, {}, 0)
    at_rest = beads.centres()
    free, start = seen(scene, at_rest), scene.camera.project(at_rest)
    keypoints = flow.find_beads(rest)
    found: dict = {
        "sparse": [],
        "dense": [],
        "shift": [],
        "bins": {"sparse": [], "dense": []},
        "keypoints": len(keypoints),
    }
    nearest = np.argmin(np.linalg.norm(start[:, None] - keypoints, axis=-1) + 1e9 * ~free[:, None], 0)
    own = np.linalg.norm(start[nearest] - keypoints, axis=-1) < 2.0 * size / 480  # px: half a bead's radius
    for number, (x, y) in enumerate(presses):
        values = {"gel.press_x": x, "gel.press_y": y, "gel.press_depth": DEPTH}
        now = take(job, values, number + 1)
        true = scene.camera.project(beads.centres()) - start
        began = time.perf_counter()
        sparse = flow.sparse_flow(rest, now, keypoints)
        middle = time.perf_counter()
        field = flow.dense_flow(rest, now)
        found["seconds"] = middle - began, time.perf_counter() - middle
        off = np.linalg.norm(sparse - true[nearest], axis=-1)
        depth = -at_rest[:, 2]
        found["sparse"].append(np.stack([depth[nearest], off], -1)[own])
        u, v = (start[free] - 0.5).round().astype(int).T
        off = np.linalg.norm(field[v, u] - true[free], axis=-1)
        found["dense"].append(np.stack([depth[free], off], -1))
        found["shift"].append(np.linalg.norm(true[free], axis=-1))
        size_true, _, count = flow.bin_means(start[free], true[free], rest.shape[:2], 20)
        for kind, (size_found, _, _) in (
            ("sparse", flow.bin_means(keypoints, sparse, rest.shape[:2], 20)),
            ("dense", flow.dense_bins(field, 20)),
        ):
            found["bins"][kind].append(np.abs(size_found - size_true)[count > 2])
    found["beads"], found["free"] = len(start), int(free.sum())
    for name in ("sparse", "dense", "shift"):
        found[name] = np.concatenate(found[name])
    return found


def main() -> None:
    size = int(sys.argv[1]) if len(sys.argv) > 1 else 480
    found = measure(size)
    print(f"{found['beads']} beads, {found['free']} not hidden, {found['keypoints']} keypoints")
    print(f"true motion of beads, px: median {np.median(found['shift']):.2f}, largest {found['shift'].max():.1f}")
    for name in ("sparse", "dense"):
        rows = found[name]
        lost = np.isnan(rows[:, 1]).mean()
        print(f"\n{name}: error, px (median, 90 %), lost {lost:.1%}")
        for low, high in LAYERS:
            own = rows[(rows[:, 0] >= low) & (rows[:, 0] < high), 1]
            own = own[~np.isnan(own)]
            print(
                f"  depth {low:g} to {high:g} mm: {np.median(own):.3f}  {np.quantile(own, 0.9):.3f}  ({len(own)} beads)"
            )
        bins = np.concatenate(found["bins"][name])
        print(f"  size (11) in 20 x 20 bins: median error {np.median(bins):.3f} px, 90 % {np.quantile(bins, 0.9):.3f}")
    print("\nseconds per image pair: sparse {:.4f}, dense {:.4f}".format(*found["seconds"]))


if __name__ == "__main__":
    main()
