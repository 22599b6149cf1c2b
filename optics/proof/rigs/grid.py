"""`grid_bench`: a small printed grid, a rod at three distances, by stock Mitsuba's `volpath`
(optics.proof.makers.grid); in one colour, and in three for what changes with the wavelength."""

from __future__ import annotations

import numpy as np

from optics.captures import capture_set as capture_files
from optics.proof.cells import Cell
from optics.proof.makers.grid import CAMERA, GridMaker
from optics.proof.rigs.base import ImageRig, Mean
from optics.scene import loader as scenes


class Grid(ImageRig):
    """A matt rod at three distances, lit by one panel after the other; one distance is held out. 8 bits, 800 electrons:
    what the stock integrator can give in minutes is noisier than a better camera. Clutter and kinds that the library
    lacks are not made; which cell was not filled is no strength."""

    name = "grid_bench"
    effects = ("volume scattering", "rough walls", "index mismatch", "body absorption", "wall thickness")
    mistakes = ("gain +20 %", "gain -20 %")
    cluttered = False
    free = ("panel_*.power",)
    defines = {
        "rays": "1024",
        "packets": "100000",
    }  # the model's error is then a quarter of the camera's noise, which it adds to it
    held_out = ("distance-01",)
    several = {
        "rough walls": ("filling.roughness",),
        "index mismatch": ("filling.index_offset",),
        "body absorption": ("filling.absorption",),
    }
    most = {"wall thickness": 0.3}
    uncounted = ("index mismatch",)  # free are both indices
    distances = (2.5, 4.0, 6.0)
    width, height, spp = 32, 24, 8192

    def scene(self):
        return scenes.load("grid_bench", {**self.defines, "width": str(self.width), "height": str(self.height)})

    def built(self, scene, seed: int) -> dict[str, float]:
        rng = np.random.default_rng([seed, 1])
        return {f"{name}.power": rng.uniform(0.9, 1.1) for name in scene.sources}

    def captures(self, cell: Cell, truth, unknown, *, mean: bool = False) -> capture_files.Captures:
        scene = self.scene()
        hidden = {
            e: s + (self.start(scene, self.keys(scene, e)[0]) if e != "wall thickness" else 0.0)
            for e, s in truth.items()
        }
        maker = GridMaker(
            scene,
            self.built(scene, cell.seed),
            hidden,
            Mean(CAMERA) if mean else CAMERA,
            1000 + cell.seed,
            64 if mean else self.spp,
        )
        found = maker.captures(self.distances)
        found.noise = CAMERA
        return found

    def parameters(self, effect: str):
        return None if effect in self.uncounted else super().parameters(effect)


class GridColour(Grid):
    """The same in red, green and blue, at two distances and with coarser pixels: each wavelength goes its own way
    through the filling, or loses its own share there."""

    name = "grid_colour"
    effects = ("dispersion", "coloured absorption")
    mistakes = ()
    defines = {**Grid.defines, "bands": "610, 540, 460"}
    held_out = ("distance-01",)
    several = {"dispersion": ("filling.dispersion",), "coloured absorption": ("filling.absorption_slope",)}
    most = {"dispersion": 0.05, "coloured absorption": 3.0}
    uncounted = ()
    distances = (2.5, 4.5)
    width, height, spp = 20, 15, 4096

    def parameters(self, effect: str):
        """Of the dispersion of both materials: what walls bend is the difference."""
        if effect == "dispersion":
            return {"filling.dispersion": 1.0, "walls.dispersion": -1.0}, 0.0
        return super().parameters(effect)
