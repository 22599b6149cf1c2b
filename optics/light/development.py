"""What the camera makes of the light: bands to irradiance, channels, response, digital numbers.

    I_b  = lens(L_b)                        effects of the stage `lens`
         = sum_j w_j lens(S_j)_b            of a camera with a mosaic of analysers: what its pixels let through
    I_c  = exposure gain gain_c sum_b M_cb I_b     M with effects of the stage `sensitivity`; then those of `sensor`
    m_c  = G_c^-1(I_c)                      then effects of the stage `response`
    DN   = black + (saturation - black) m_c + offset

with the weights w = 1/2 (1, cos 2a, sin 2a) of the Stokes vector in a pixel whose analyser stands at the angle a,
counterclockwise in the image from its right, and the effects of the stage `site` on them.

Where an effect brings light from pixel to pixel (`Effect.finer`), the lens acts on parts of pixels: images per band are
then (side H, side W, B), and what a pixel records is the mean of its parts.

All of it is numpy arithmetic, analytic in the image and in every camera parameter, so that derivatives come from a
complex step: f'(x) v = Im f(x + i h v)/h with h = 1e-30, exact to rounding (Squire & Trapp, SIAM Rev. 40, 110, 1998).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

from optics.errors import BadScene
from optics.scene.declare import IMAGE_STAGES, Effect
from optics.scene.images import SIDE, of_pixels, repeated
from optics.spectra.reading import FILES, read_channels

LENSES = 4  # of which the geometry of pixels is kept
STEP = 1e-30  # of the complex step; far below rounding, far above underflow


def sensitivities(name: str, bands: tuple[float, ...], channels: int = 3) -> np.ndarray:
    """M (channels, bands): the identity, or a measured camera of colour-science at the bands, largest entry 1."""
    if name == "identity":
        return np.eye(channels, len(bands)) if len(bands) > 1 else np.ones((1, 1))
    matrix = np.stack([np.interp(bands, c.nm, c.values) for c in read_channels(name)])
    return matrix / matrix.max()


def channel_matrix(camera, bands: tuple[float, ...]) -> np.ndarray:
    """M (C, B) of bands that are read at their centres: of a camera's curves behind its filter, largest entry 1."""
    if not camera.channels:
        matrix = sensitivities("identity", bands)
        return matrix * camera.curves["filter"](bands) if "filter" in camera.curves else matrix
    if "filter" not in camera.curves and not camera.sensitivity.lower().endswith(FILES):
        return sensitivities(camera.sensitivity, bands)
    matrix = camera.seen(np.array(bands))
    if not matrix.any():
        low, high = min(c.span[0] for c in camera.channels), max(c.span[1] for c in camera.channels)
        raise BadScene(
            f"'{camera.name}' sees none of the bands {', '.join(f'{b:g}' for b in bands)} nm; allowed: bands between "
            f"{low:g} and {high:g} nm that its filter passes"
        )
    return matrix / matrix.max()


class Developer:
    """The camera of a scene as arithmetic on images of a fixed size.

    camera     the scene's camera part
    bands      wavelengths of the image's bands, nm
    black, saturation    DN; (0, 1) for radiance
    distances  f(values) -> (H, W) mm from the camera to what its pixels see, for effects that ask for `view.astray`
    site       (H, W) rad, the analyser angle of each pixel of a mosaic; None for a camera without one. With a mosaic
               images per band are Stokes vectors, (3, H, W, B)
    """

    def __init__(
        self,
        camera,
        bands: tuple[float, ...],
        black: float = 0.0,
        saturation: float = 255.0,
        distances: Callable[[Mapping], np.ndarray] | None = None,
    ):
        self.distances = distances
        self.camera, self.name = camera, camera.name
        self.width, self.height = camera.resolution
        self.bands = tuple(bands)
        self.integral = camera.integral
        self.matrix = channel_matrix(camera, self.bands) if self.integral is None else self.integral.matrix()
        self.black, self.saturation = float(black), float(saturation)
        self.names = tuple(camera.numbers)
        self.neutral = {n: p.neutral for n, p in camera.numbers.items()}
        self.effects = {stage: camera.registry.at_stage(camera.kind, stage) for stage in IMAGE_STAGES}
        self.v, self.u = np.mgrid[: self.height, : self.width] + 0.5
        self._lens_kept: dict[tuple, tuple] = {}
        self.site = None
        mosaic = getattr(camera, "mosaic", ())
        if mosaic:
            cell = np.radians(np.array(mosaic, float))
            self.site = cell[np.ix_(*(np.arange(n) % m for n, m in zip((self.height, self.width), cell.shape)))]

    def _normalised(self, own: Mapping[str, Any]) -> tuple:
        """x, y and the tangent of the field angle of each pixel, and the focal length; the latest are kept, as all
        frames have one lens."""
        key = tuple(own.values())
        swept = any(np.ndim(value) for value in key)
        if not swept and key in self._lens_kept:
            return self._lens_kept[key]
        x, y, focal = self.camera.normalised(SimpleNamespace(**own), self.u, self.v)
        found = x, y, np.hypot(x, y), focal
        if not swept:
            for image in map(np.asarray, found):
                image.flags.writeable = False
            self._lens_kept = {key: found} if len(self._lens_kept) >= LENSES else {**self._lens_kept, key: found}
        return found

    def view(self, values: Mapping[str, complex]) -> SimpleNamespace:
        """What an image function sees as `camera`: every parameter of the camera, and the geometry of its pixels.

        u, v (H, W) px; x, y (H, W) normalised coordinates; tan (H, W) tangent of the field angle; focal (px); width,
        height (px); side, parts of a pixel each way that the image has, for effects that are `finer`; astray() (H, W)
        px by which a ray off the pupil's middle misses the chief ray, per mm off it, at the distance that the pixel
        sees; bands (nm); images of the geometry are shared, and cannot be written to;
        time, the scene's clock, 0 without one, (N, 1, 1) where readings were swept;
        white (B,) radiance per band of white light of radiance 1; settings: all values by key, those of
        other parts too, (N, 1, 1) where readings were swept."""
        own = {n: values[f"{self.name}.{n}"] for n in self.names}

        def astray() -> np.ndarray:
            if self.distances is None:
                raise BadScene(
                    f"'{self.name}' blurs by distance, and here none is known; allowed: {self.name}.pupil_area = 0"
                )
            with np.errstate(divide="ignore"):
                return self.camera.astray(SimpleNamespace(**own), self.u, self.v, self.distances(values))

        x, y, tan, focal = self._normalised(own)
        return SimpleNamespace(
            **own,
            u=self.u,
            v=self.v,
            px=x,
            py=y,
            tan=tan,
            focal=focal,
            width=self.width,
            height=self.height,
            side=1,
            astray=astray,
            bands=np.array(self.bands),
            white=np.ones(len(self.bands)) if self.integral is None else self.integral.white,
            site=self.site,
            settings=values,
            time=values.get(self.camera.clock, 0.0),
        )

    def side(self, values: Mapping[str, complex]) -> int:
        """How many values of a pixel each way the lens wants to act on."""
        own = (n for e in self.effects["lens"] if e.finer for n in e.parameter_names)
        return SIDE if any(values[f"{self.name}.{n}"] != self.neutral[n] for n in own) else 1

    def _stage(self, stage: str, image, view):
        for effect in self._active(stage, view):
            image = effect.stages[stage](image, view)
        return image

    def _active(self, stage: str, view) -> Iterator[Effect]:
        for effect in self.effects[stage]:
            if all(getattr(view, n) == self.neutral[n] for n in effect.parameter_names):
                continue  # at neutral an effect is the identity; the contract tests hold every effect to that
            if (
                stage == "lens"
                and getattr(self.camera, "sampled", False)
                and self.camera.named("pupil") in effect.parameter_names
            ):
                continue  # rays started all over the pupil
            yield effect

    def _lens(self, image, view):
        """(H, W, B) behind the lens, of an image as large or in parts of pixels. An effect that does not know of parts
        changes all parts of a pixel as it changes the pixel."""
        side = np.shape(image)[-3] // self.height
        if side <= 1 or np.shape(image)[-3:-1] != (side * self.height, side * self.width):
            return self._stage("lens", image, view)
        active, finer = list(self._active("lens", view)), SimpleNamespace(**{**vars(view), "side": side})
        first = max((k + 1 for k, effect in enumerate(active) if effect.finer), default=0)
        for effect in active[:first]:
            if effect.finer:
                image = effect.stages["lens"](image, finer)
            else:
                whole = of_pixels(image, side)
                image = image + repeated(effect.stages["lens"](whole, view) - whole, side)
        image = of_pixels(image, side)
        for effect in active[first:]:
            image = effect.stages["lens"](image, view)
        return image

    def channels(self, image, view):
        """Irradiance per channel, 1 = full scale, of an image per band (H, W, B), or in parts of pixels."""
        image = self._lens(image, view) if self.site is None else self.behind_analysers(image, view)
        image = image @ self.mixing(view).T
        return self._stage("sensor", image * self.scale(view), view)

    def mixing(self, view) -> np.ndarray:
        """M (C, B) from bands to channels, with what effects of the stage `sensitivity` make of it; of channels that
        are integrals it depends on the lights' spectra."""
        own = self.integral
        found = self.matrix if own is None else own.matrix(view.settings)
        active = [
            e
            for e in self.effects["sensitivity"]
            if any(getattr(view, n) != self.neutral[n] for n in e.parameter_names)
        ]
        if not active:
            return found
        nm, quantum = (view.bands, found) if own is None else (own.grid, own.quantum)
        for effect in active:
            quantum = effect.stages["sensitivity"](quantum, nm, view)
        return quantum if own is None else own.matrix(view.settings, quantum)

    def behind_analysers(self, stokes, view) -> np.ndarray:
        """Irradiance per band (H, W, B) behind the analyser of each pixel, of Stokes vectors (3, H, W, B).

        A lens treats all polarizations alike; what it adds to darkness is unpolarized."""
        dark = self._lens(np.zeros(np.shape(stokes)[1:]), view)
        weights = self.weights(view)
        total: Any = 0.0
        for j, component in enumerate(stokes):
            total = total + weights[..., j, None] * (self._lens(component, view) - (dark if j else 0.0))
        return total

    def weights(self, view) -> np.ndarray:
        """(H, W, 3): share of S0, S1 and S2 that each pixel of a mosaic records."""
        double = 2 * self.site
        ideal = np.stack([np.ones_like(double), np.cos(double), np.sin(double)], -1) / 2
        return self._stage("site", ideal, view)

    def gains(self, view) -> np.ndarray:
        """(C,) gain of each channel."""
        return self.camera.gains(view, len(self.matrix))

    def scale(self, view) -> np.ndarray:
        """(C,) full scale per unit of irradiance in each channel."""
        return getattr(view, self.camera.named("exposure")) * self.gains(view)

    def respond(self, irradiance, view):
        """DN of an irradiance per channel."""
        m = self._stage("response", self.camera.respond(view, irradiance), view)
        return self.black + (self.saturation - self.black) * m + self.camera.added(view)

    def develop(self, image: np.ndarray, values: Mapping[str, complex]) -> np.ndarray:
        """DN (H, W, C), noise-free and not clipped, of radiance per band (H, W, B), of Stokes
        vectors (3, H, W, B) for a mosaic of analysers; or these in parts of pixels."""
        view = self.view(values)
        return self.respond(self.channels(image, view), view)

    def linearise(
        self, image: np.ndarray, values: Mapping[str, float], parted: Callable[[], np.ndarray] | None = None
    ) -> Linear:
        """Prediction and derivatives about an image and camera values; `parted` gives the image in parts of pixels, for
        derivatives by what acts on them and is at neutral."""
        return Linear(self, image, values, parted)


class Linear:
    """The camera linearised about one image: `image` in DN, tangents of images and of camera parameters."""

    def __init__(
        self,
        developer: Developer,
        bands: np.ndarray,
        values: Mapping[str, float],
        parted: Callable[[], np.ndarray] | None = None,
    ):
        self.developer, self.bands, self.values, self.parted = developer, np.asarray(bands, float), values, parted
        self._parts: np.ndarray | None = None
        self.view = developer.view(values)
        channels = developer.channels(self.bands, self.view)
        stepped = developer.respond(channels + 1j * STEP, self.view)
        self.image = stepped.real
        self.slope = stepped.imag / STEP  # the response acts pixel by pixel
        self.floor = developer.channels(np.zeros_like(self.bands), self.view)  # what the camera adds to darkness

    def of_image(self, tangent: np.ndarray) -> np.ndarray:
        """d DN for a change of the radiance per band; lens and sensor are affine in the image."""
        return self.slope * (self.developer.channels(np.asarray(tangent, float), self.view) - self.floor)

    def of_parameter(self, keys: tuple[str, ...]) -> np.ndarray:
        """d DN / d value for camera parameters that share one value."""
        stepped = dict(self.values)
        for key in keys:
            stepped[key] = stepped[key] + 1j * STEP
        bands = self.bands
        if self.parted is not None and self.developer.side(stepped) > 1:
            bands = self._parts = self.parted() if self._parts is None else self._parts
        return self.developer.develop(np.asarray(bands, complex), stepped).imag / STEP

    def at(self, keys: tuple[str, ...], value: float) -> np.ndarray:
        """DN at another value of camera parameters (for finite steps)."""
        return self.developer.develop(self.bands, {**self.values, **dict.fromkeys(keys, value)})
