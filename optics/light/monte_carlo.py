"""Predictions of scenes with dielectric bodies, by Monte Carlo (optics.light.transport) with the same random numbers
every time.

The same seed gives the same image, so that fits and differences see a smooth function; its error is that of the rays
and packets that the scene's integrator names (`rays` per pixel, `packets` per light)."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Mapping

import numpy as np

from optics.light import paths
from optics.light.development import STEP
from optics.light.renderer import Renderer
from optics.light.samples import LedImage
from optics.light.transport import Estimate, Transport
from optics.scene.loader import Scene
from optics.scene.surfaces import coefficient

MEMORY = 5e8  # bytes of images that are kept


class MonteCarloRenderer(Renderer):
    """`optics.light.renderer.Renderer` for a scene with dielectric bodies: the lights in one image."""

    monte_carlo = True
    progress = None  # called with what is followed ("packets", "rays"), how many are done, and of how many

    def __init__(self, scene: Scene, remember: int = 24):
        super().__init__(scene, remember)
        self.layered = False
        silent = {k for k, p in scene.parameters.items() if p.how == "image"} | set(scene.power_keys(*scene.lights))
        self.deciding = sorted(k for k in scene.parameters if k not in silent)
        # lights that are off at first are followed only where they are on
        self.always = {n for n, p in scene.lights.items() if p.numbered("power") > 0}
        self._estimates: OrderedDict = OrderedDict()
        # all differences of a geometry, which each of its frames asks for: an image, its error, and slopes by four
        # materials
        self.kept = max(remember, int(MEMORY / (48 * len(scene.lights) * self.width * self.height * self.bands)))
        self._sloped = (
            False  # whether derivatives by absorption have been asked for: then they are made along with each image
        )

    def estimate(self, values: Mapping, seed: int = 0, slopes: bool = False) -> Estimate:
        """The lights at power 1; kept. slopes: with the derivatives by absorption."""
        lights = tuple(n for n in self.scene.lights if n in self.always or values[self.scene.powers[n]] != 0)
        key = (seed, lights, *(values[k] for k in self.deciding))
        known = self._estimates.get(key)
        self._sloped |= slopes
        if known is None or slopes and not known.slopes:
            self.apply(values)
            integrator = self.scene.integrator
            known = self._estimates[key] = Transport(self.scene, lights).take(
                integrator.rays, integrator.packets, seed, self._sloped, progress=self.progress
            )
            while len(self._estimates) > self.kept:
                self._estimates.popitem(last=False)
        self._estimates.move_to_end(key)
        return known

    def image(self, values: Mapping, light: str, component: int = 0, seed: int = 0) -> np.ndarray:
        return self.light({**values, **dict.fromkeys(self.scene.power_keys(light), 1.0)}, light, seed, component)

    def light(self, values: Mapping, light: str, seed: int = 0, component: int = 0) -> np.ndarray:
        found = self.estimate(values, seed)
        image = self.powers(values, light) * found.radiance[found.lights.index(light)]
        return image if component == 0 else np.zeros_like(image)

    def error(self, values: Mapping) -> np.ndarray:
        """(H, W, B) standard error of the image."""
        found = self.estimate(values)
        return np.sqrt(
            self._sum((self.powers(values, n) * found.error[found.lights.index(n)]) ** 2 for n in self.lit(values))
        )

    def _sum(self, images: Iterable[np.ndarray]) -> np.ndarray:
        """(H, W, B) of the lights that are on; black where none is."""
        return sum(images, np.zeros((self.height, self.width, self.bands)))

    def led(self, values: Mapping, led: str, seed: int = 0) -> LedImage:
        """No shadow has a rim here."""
        hits = self.hits(values)
        return LedImage(led, hits, np.zeros(hits.shape, bool), np.zeros(0, int), None, None, None, hits.valid)

    def bounced(
        self, values: Mapping, led: str, seed: int = 0, component: int = 0, roughly: bool = False
    ) -> np.ndarray:
        return np.zeros((self.height, self.width, self.bands))

    def tangent(self, values: Mapping, key: str, seed: int = 0) -> np.ndarray:
        """d radiance / d parameter: by the lengths of the ways for what changes an absorption, else a central
        difference with the same random numbers."""
        name = key.rsplit(".", 1)[0]
        if self.scene.parameters[key].how == "path":
            own = paths.part_values(self.scene, name, {**values, key: values[key] + 1j * STEP}, {})
            functions = self.scene.registry.functions(self.scene.parts[name].kind, "absorption")
            stepped = coefficient(own, "absorption", self.wavelengths, functions)
            slope = np.imag(stepped) / STEP  # of the coefficient, per band
            found = self.estimate(values, seed, slopes=True)
            return slope * self._sum(
                self.powers(values, n) * found.slopes[name][found.lights.index(n)] for n in self.lit(values)
            )
        low, high = self.scene.parameters[key].sides(values[key])
        return (self.radiance({**values, key: high}, seed) - self.radiance({**values, key: low}, seed)) / (high - low)


def renderer_of(scene: Scene, remember: int = 24) -> Renderer:
    """The renderer that a scene's light needs."""
    return (MonteCarloRenderer if scene.monte_carlo else Renderer)(scene, remember)
