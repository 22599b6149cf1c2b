"""`particle_gel`: a small field of beads, pressed at three places, by numpy alone (optics.proof.makers.particle)."""

from __future__ import annotations

import numpy as np

from optics.captures import capture_set as capture_files
from optics.proof.cells import Cell
from optics.proof.makers.particle import CAMERA, MAKERS, SIDE, ParticleMaker
from optics.proof.rigs.base import ImageRig, Mean
from optics.scene import loader as scenes

FEW = 2  # rays of a pixel each way where strengths are chosen, which takes only the settings of the frames


class ParticleGel(ImageRig):
    """Forty beads at rest and under three presses, the first made again as the last, lit by one ring after the other;
    one press is held out. 0.7 DN of noise in the dark, 1 at 150. Clutter and kinds that the library lacks are not
    made."""

    name = "particle_gel"
    effects = MAKERS
    mistakes = ("gain +20 %", "gain -20 %")
    cluttered = False
    free = ("inner_ring.power", "outer_ring.power", "dye.yield", "camera.x_fov", "camera.z")
    defines = {
        "width": "32",
        "height": "32",
        "x_fov": "34",
        "beads": "40",
        "diameter": "1.2",
        "field": "11",
        "top": "0.65",
        "bottom": "3.85",
        "fine": "3",
        "detail": "1",
    }
    held_out = ("press-02",)
    # Presses of one depth alone move the beads far from them alike, which the camera's height takes for its own: of a
    # finite layer that changed images by 2 % nothing was left. The press that is held out is a deep one, as at a middle
    # depth a height between those that others ask for predicts as well.
    presses = ((0.0, 0.0, 0.9), (2.0, -1.5, 0.6), (-1.5, 2.0, 0.9), (0.0, 0.0, 0.0), (0.0, 0.0, 0.9))
    frames = 3

    def scene(self):
        return scenes.load(self.name, self.defines)

    def built(self, scene, seed: int) -> dict[str, float]:
        rng = np.random.default_rng([seed, 1])
        values = {f"{name}.power": scene.values()[f"{name}.power"] * rng.uniform(0.9, 1.1) for name in scene.leds}
        values["dye.yield"] = rng.uniform(0.6, 0.75)
        values["camera.x_fov"] = 34 + rng.uniform(-0.5, 0.5)
        return {**values, "cover.sigma": 0.0}

    def captures(self, cell: Cell, truth, unknown, *, mean: bool = False) -> capture_files.Captures:
        scene = self.scene()
        noise = Mean(CAMERA) if mean else CAMERA
        side = FEW if mean else SIDE
        maker = ParticleMaker(scene, self.built(scene, cell.seed), truth, noise, 1000 + cell.seed, side)
        found = maker.captures(self.presses)
        found.noise = CAMERA
        return found
