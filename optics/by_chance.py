"""Predictions of scenes with clear bodies: their light is followed by chance (optics.transport), with the same random numbers every time.

The same seed gives the same picture, so that fits and differences see a smooth function; its error is that of the rays and packets
that the scene's integrator names (`rays` per pixel, `packets` per light).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping

import numpy as np

from optics.render import POWERS, LedImage, Renderer
from optics.scene import Scene
from optics.transport import Picture, Transport

STEP = 1e-3  # of a plausible change: for the derivative of an absorption coefficient by what it depends on


class ClearRenderer(Renderer):
    """`optics.render.Renderer` for a scene with clear bodies: all lights in one picture."""

    by_chance = True

    def __init__(self, scene: Scene, remember: int = 24):
        super().__init__(scene, remember)
        self.layered = False
        silent = {k for k, p in scene.parameters.items() if p.how == "image"} | {
            f"{n}.{p}" for n in scene.lights for p in ("power", "power_r", "power_g", "power_b")}
        self.deciding = sorted(k for k in scene.parameters if k not in silent)
        self._pictures: OrderedDict = OrderedDict()

    def picture(self, values: Mapping, seed: int = 0, slopes: bool = False) -> Picture:
        """All lights at power 1; kept. slopes: with the derivatives by absorption."""
        key = (seed, *(values[k] for k in self.deciding))
        known = self._pictures.get(key)
        if known is None or slopes and not known.slopes:
            self._apply(values)
            integrator = self.scene.integrator
            known = self._pictures[key] = Transport(self.scene).take(integrator.rays, integrator.packets, seed, slopes)
            while len(self._pictures) > self.remember:
                self._pictures.popitem(last=False)
        self._pictures.move_to_end(key)
        return known

    def image(self, values: Mapping, light: str, component: int = 0) -> np.ndarray:
        return self.light({**values, **{f"{light}.{p}": 1.0 for p in POWERS}, self.bounce_key: 0.0}, light, 0, component)

    def light(self, values: Mapping, light: str, seed: int = 0, component: int = 0) -> np.ndarray:
        found = self.picture(values, seed)
        image = self.powers(values, light) * found.radiance[found.lights.index(light)]
        return image if component == 0 else np.zeros_like(image)

    def error(self, values: Mapping) -> np.ndarray:
        """(H, W, B) standard error of the picture."""
        found = self.picture(values)
        return np.sqrt(sum((self.powers(values, n) * found.error[found.lights.index(n)]) ** 2 for n in self.lit(values)))

    def led(self, values: Mapping, led: str) -> LedImage:
        """No shadow has a rim here."""
        hits = self.hits(values)
        return LedImage(led, hits, np.zeros(hits.shape, bool), np.zeros(0, int), None, None, None, hits.valid)

    def bounced(self, values: Mapping, led: str, seed: int = 0, component: int = 0) -> np.ndarray:
        return np.zeros((self.height, self.width, self.bands))

    def tangent(self, values: Mapping, key: str, seed: int = 0) -> np.ndarray:
        """d radiance / d parameter: by the lengths of the ways for what changes an absorption, else a central difference with the
        same random numbers."""
        name, parameter = key.rsplit(".", 1)
        declared = self.scene.parameters[key]
        if declared.how == "path":
            h = STEP * declared.plausible
            fading = [self._fading(values, key, values[key] + s * h) for s in (1, -1)]
            found = self.picture(values, seed, slopes=True)
            return (fading[0] - fading[1]) / (2 * h) * sum(
                self.powers(values, n) * found.slopes[name][found.lights.index(n)] for n in self.lit(values))
        h = declared.step * declared.plausible
        low, high = max(values[key] - h, declared.bounds[0]), min(values[key] + h, declared.bounds[1])
        return (self.radiance({**values, key: high}, seed) - self.radiance({**values, key: low}, seed)) / (high - low)

    def _fading(self, values: Mapping, key: str, value: float) -> np.ndarray:
        """(B,) absorption coefficient of a material for another value of one of its parameters."""
        import mitsuba as mi

        self._apply({**values, key: value}, move=False)
        part = self.scene.parts[key.rsplit(".", 1)[0]]
        return np.array([np.array(part.fading(mi.Float(float(w)))).item() for w in self.wavelengths])


def renderer_of(scene: Scene, remember: int = 24) -> Renderer:
    """The renderer that a scene's light needs."""
    clear = any(p.kind == "clear" for p in scene.parts.values())
    return (ClearRenderer if clear else Renderer)(scene, remember)
