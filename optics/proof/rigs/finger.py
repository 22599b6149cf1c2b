"""`vi2tap`: a skin between two polarizer films, an object and a wall behind it, by stock Mitsuba's films
(optics.proof.makers.finger)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from optics.captures import capture_set as capture_files
from optics.proof.cells import Cell, pairs_of
from optics.proof.makers.finger import FingerMaker
from optics.proof.makers.touch import CAMERA
from optics.proof.rigs.base import PATTERNS, ImageRig, Mean, Workshop
from optics.scene import loader as scenes

# kind -> coordinates by any of which it is rightly named
UNKNOWN = {
    "stain": ("place",),
    "banding": ("row",),
    "tap": ("column",),
    "red drift": ("frame",),
    "third harmonic": ("analyzer.angle",),
}
# what the renders know of: a film that is turned, what glows; the rest is made by mixing them, or on the image
RENDERED = ("polarizer misalignment", "marker leak")


class WildFinger(Workshop, FingerMaker):
    """A maker of a finger's frames with clutter of the camera, and kinds that the library lacks: see
    `Workshop.furnish`.

    shared   renders by geometry and angle: makers that share them make only what differs anew
    """

    def __init__(
        self,
        scene,
        values,
        effects,
        noise,
        seed: int,
        spp: int,
        *,
        unknown: Mapping[str, float],
        clutter: float,
        pattern: float | None,
        shared: dict,
    ):
        super().__init__(scene, values, effects, noise, seed, spp)
        self.furnish(unknown, UNKNOWN, clutter, False, pattern)
        self.shared = shared

    def parts(self, geometry, analyzer: float):
        own = tuple((n, s) for n, s in sorted(self.effects.items()) if n in RENDERED)
        key = (self.seed, tuple(geometry[1]), geometry[2], round(analyzer, 9), own)
        if key not in self.shared:
            while len(self.shared) > 100:
                self.shared.pop(next(iter(self.shared)))
            self.shared[key] = super().parts(geometry, analyzer)
        return self.shared[key]

    def radiance(self, parts, dial: float) -> np.ndarray:
        return super().radiance(parts, dial) * (
            1 + self.unknown.get("third harmonic", 0.0) * np.cos(3 * np.radians(dial))
        )

    def gain(self, kind: str, size: float, frame: int, press) -> np.ndarray:
        return np.ones((1, 1, 1)) if kind == "third harmonic" else super().gain(kind, size, frame, press)


class Finger(ImageRig):
    """Four scenes, the skin untouched and pressed, the object at four distances, at five angles of the analyser; one
    scene is held out. 8 bits, 6000 electrons: a better camera would see what the two accounts differ by at edges. A
    retarder is not hidden: the stock one fades with the cosine of the incidence, where a plate's path grows."""

    name = "vi2tap"
    effects = (
        "extinction leak",
        "coloured leak",
        "oblique leak",
        "polarizer misalignment",
        "servo scale",
        "servo backlash",
        "analyzer wobble",
        "depolarization",
        "stray light",
        "dark offset",
        "camera gamma",
        "gain drift",
        "lens vignetting",
        "marker leak",
        "veiling glare",
    )
    unknown = UNKNOWN
    random = ("gain drift",)
    # a coloured leak has a leak in it: the one name says both
    pairs = [
        p
        for p in pairs_of([e for e in effects if e not in ("gain drift", "depolarization", "dark offset")])
        if set(p) != {"extinction leak", "coloured leak"}
    ]
    free = ("object_paint.rho_*", "wall_paint.rho_*", "pigment.yield")
    defines = {"wall_dark": "1"}  # an even wall: edges of its chequers would be masked
    several = {
        "extinction leak": ("analyzer.leak", "film.leak"),
        "coloured leak": ("analyzer.leak_tilt", "film.leak_tilt"),
        "oblique leak": ("analyzer.leak_oblique", "film.leak_oblique"),
        "marker leak": ("inner_face.marker_leak",),
    }
    # what a fit finds is not the number that was hidden: films' offsets are known by their difference, exponentials are
    # no lines
    uncounted = ("polarizer misalignment", "coloured leak")
    frames = 5
    views = (((0.0, 0.0, 0.0), 30.0), ((4.0, 3.0, 2.0), 15.0), ((-6.0, 2.0, 1.2), 45.0), ((2.0, -6.0, 1.6), 22.0))
    angles = (0.0, 40.0, 75.0, 90.0, 120.0)
    width, height, spp = 32, 24, 144

    def __init__(self):
        super().__init__()
        self.shared: dict = {}

    def scene(self):
        return scenes.load(self.name, {**self.defines, "width": str(self.width), "height": str(self.height)})

    def built(self, scene, seed: int) -> dict[str, float]:
        rng, drawn = np.random.default_rng([seed, 1]), scene.values()
        paints = {f"{paint}_paint.rho_{c}": rng.uniform(0.3, 0.7) for paint in ("object", "wall") for c in "rgb"}
        return {"camera.exposure": 6.5, **paints, "pigment.yield": drawn["pigment.yield"] * rng.uniform(0.9, 1.1)}

    def captures(self, cell: Cell, truth, unknown, *, mean: bool = False) -> capture_files.Captures:
        scene = self.scene()
        own = {
            "servo scale": lambda s: 1 + s,
            "extinction leak": lambda s: scene.values()["film.leak"] + s,
            "coloured leak": lambda s: s / scene.values()["film.leak"],
        }  # as the maker counts
        hidden = {effect: own.get(effect, float)(s) for effect, s in truth.items()}
        maker = WildFinger(
            scene,
            self.built(scene, cell.seed),
            hidden,
            Mean(CAMERA) if mean else CAMERA,
            1000 + cell.seed,
            self.spp,
            unknown=unknown,
            clutter=cell.clutter,
            pattern=PATTERNS.get(cell.mistake),
            shared=self.shared,
        )
        found = maker.captures(self.views, self.angles)
        found.noise = CAMERA
        return found

    def parameters(self, effect: str):
        return None if effect in self.uncounted else super().parameters(effect)
