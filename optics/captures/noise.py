"""Camera noise in the terms of EMVA 1288: what a digital number (DN) scatters by, how it is measured, what to mask.

    variance(S) = [K (S - b) + d^2] / n + q^2 / 12 + (p (S - b))^2          DN^2

S signal (DN), K system gain (DN per electron), b black level (DN), d dark noise (DN rms), n frames averaged, q step of
the quantisation (DN), p photo-response non-uniformity (relative rms). Source: EMVA 1288, linear camera model and photon
transfer; p is a fixed pattern, the same in every image, so that averaging frames leaves it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from optics.errors import Underdetermined

if TYPE_CHECKING:
    from optics.captures.capture_set import Captures

SATURATED = (
    0.96  # of saturation: above, response bends before it clips (top-1 of a diagnosis fell from 99 to 17 % unmasked)
)
DITHERED = (
    0.25  # temporal variance per step^2 from which the step acts as noise q^2/12 to 2.5 % (at 0.09: only to 45 %)
)
UNITS = {
    "system_gain": "DN per electron",
    "dark_noise": "DN, rms",
    "black_level": "DN",
    "saturation": "DN",
    "prnu": "(relative, rms)",
    "quantisation": "DN",
}
DEMOSAICED = (
    "3 channels and no cfa: if these are demosaiced, neighbouring pixels share their noise and a diagnosis raises "
    "false alarms (85 % of sets at a perfect chi2); supply raw frames and cfa"
)


@dataclass(frozen=True)
class Noise:
    """Noise of a camera; every number as in the module's text, `saturation` in DN."""

    system_gain: float
    dark_noise: float
    black_level: float
    saturation: float
    prnu: float
    quantisation: float = 1.0

    def __post_init__(self):
        for name, unit in UNITS.items():
            value, allowed = getattr(self, name), {"black_level": "finite", "system_gain": "> 0"}.get(name, ">= 0")
            if not math.isfinite(value) or (allowed != "finite" and value < 0) or (allowed == "> 0" and value == 0):
                raise ValueError(f"{name} = {value:g} {unit}; allowed: {allowed}; see the camera's EMVA 1288 sheet")
        if self.saturation <= self.black_level:
            raise ValueError(f"saturation = {self.saturation:g} DN; allowed: > black_level = {self.black_level:g} DN")

    def variance(self, signal: np.ndarray, frames_averaged: int = 1) -> np.ndarray:
        """Variance in DN^2 of a noise-free signal in DN (any shape), recorded as the mean of `frames_averaged`
        frames."""
        light = np.maximum(np.asarray(signal, float) - self.black_level, 0.0)
        temporal = self.system_gain * light + self.dark_noise**2
        step = self.quantisation**2 / 12
        if frames_averaged > 1:  # the step averages down like the rest only where the temporal noise dithers it
            step = np.where(temporal >= DITHERED * self.quantisation**2, step / frames_averaged, step)
        return temporal / frames_averaged + step + (self.prnu * light) ** 2

    def sd(self, signal: np.ndarray, frames_averaged: int = 1) -> np.ndarray:
        """Standard deviation in DN: the root of `variance`."""
        return np.sqrt(self.variance(signal, frames_averaged))

    def summed(self, frames: int) -> Noise:
        """Noise of the sum of `frames` frames (DN add up), stated as that of one frame, as [noise] asks for.

        The gain in DN per electron stays, the quantisation of all frames but one is counted as dark noise.
        """
        return replace(
            self,
            dark_noise=math.sqrt(frames * self.dark_noise**2 + (frames - 1) * self.quantisation**2 / 12),
            black_level=frames * self.black_level,
            saturation=frames * self.saturation,
        )

    def fixed_pattern(self, shape: Sequence[int], rng: np.random.Generator) -> np.ndarray:
        """A gain per pixel, relative, of rms `prnu`; make it once per camera and hand it to every `expose`."""
        return self.prnu * rng.standard_normal(shape)

    def expose(
        self, signal: np.ndarray, rng: np.random.Generator, fixed_pattern: np.ndarray | None = None
    ) -> np.ndarray:
        """One frame in DN of a noise-free signal in DN; fixed_pattern: relative gain per pixel, None: all alike."""
        light = np.maximum(np.asarray(signal, float) - self.black_level, 0.0)
        if fixed_pattern is not None:
            light = light * np.maximum(1.0 + fixed_pattern, 0.0)
        frame = self.black_level + self.system_gain * rng.poisson(light / self.system_gain)
        frame = np.clip(frame + self.dark_noise * rng.standard_normal(light.shape), 0.0, self.saturation)
        return np.round(frame / self.quantisation) * self.quantisation if self.quantisation else frame

    @property
    def pedestal(self) -> bool:
        """Whether the black level stands three sigma above 0, so that dark noise is not clipped."""
        return self.black_level >= 3 * float(self.sd(self.black_level))

    def usable(self, image: np.ndarray, dilate: int = 1) -> np.ndarray:
        """Mask (H, W, C), True = use: not within `dilate` pixels of saturation, in each channel's own plane.

        Without a pedestal, what stands within 3 sigma of 0 is cut by the clipping and left out as well.
        """
        image = np.asarray(image)
        bad = image >= SATURATED * self.saturation
        for axis in (0, 1):  # a square neighbourhood, one axis after the other
            padded = np.pad(bad, [(dilate, dilate) if a == axis else (0, 0) for a in range(3)])
            bad = np.lib.stride_tricks.sliding_window_view(padded, 2 * dilate + 1, axis).any(-1)
        return ~bad if self.pedestal else ~bad & (image >= 3 * self.sd(image))


def step_of(images: Sequence[np.ndarray]) -> float:
    """The step of the quantisation in DN: the common divisor of whole numbers (16 for 12 bit in 16), 0 for
    fractions."""
    levels = np.unique(
        np.concatenate([image.ravel()[:: 1 + image.size // 20000] for image in images])
    )  # a sample will do
    if np.any(levels != np.round(levels)):
        return 0.0
    return float(np.gcd.reduce(levels.astype(np.int64))) if len(levels) >= 32 else 1.0  # few levels share one by chance


def estimate(captures: Captures, black_level: float | None = None, saturation: float | None = None) -> Noise:
    """Noise from repeated frames: photon transfer (EMVA 1288), one gain for all channels; PRNU is an upper limit, as
    texture of the scene finer than three pixels counts as PRNU. Raises Underdetermined with what to supply.

    black_level  DN; None: the mean of dark frames with repeats (every `*.power` or `*.exposure` that is set is 0)
    saturation   DN; None: full scale of the smallest converter (8, 10, 12, 14, 16 bit) that holds the values
    """
    here = f"{captures.folder}/captures.toml"
    repeated = [frame for frame in captures.frames if frame.repeats]
    if not repeated:
        raise Underdetermined(
            f"{here}: noise: no frame has repeats; add `repeats` at six exposures or more, or give [noise]"
        )
    stacks = [np.stack([f.image, *f.repeats]).astype(float) for f in repeated]
    masks = [np.broadcast_to(True if f.mask is None else f.mask[..., None], f.image.shape) for f in repeated]
    lights = [
        [
            value
            for key, value in {**captures.parameters, **f.parameters}.items()
            if key.endswith((".power", ".exposure"))
        ]
        for f in repeated
    ]
    dark = [bool(values) and not any(values) for values in lights]
    step = step_of(stacks)
    if saturation is None:
        top = max(float(image.max()) for f in captures.frames for image in (f.image, *f.repeats))
        saturation = next(((2**n - 1) * step for n in (8, 10, 12, 14, 16) if (2**n - 1) * step >= top), None)
        if not saturation:
            raise Underdetermined(
                f"{here}: noise: values to {top:g} DN, step {step:g} DN, fit no converter; give saturation in DN"
            )
    if black_level is None:
        if not any(dark):
            raise Underdetermined(
                f"{here}: noise: lit frames cannot tell the black level from dark noise; add repeats of a dark "
                "frame (every power 0), or give the black level in DN"
            )
        values = np.concatenate([stack[:, mask].ravel() for stack, mask, d in zip(stacks, masks, dark) if d])
        if np.mean(values <= 0) > 0.005:  # as from a pedestal below 2.6 sigma
            raise Underdetermined(
                f"{here}: noise: {np.mean(values <= 0):.1%} of the dark values are clipped at 0 DN; set a pedestal "
                "in the camera, or give the black level in DN"
            )
        black_level = float(values.mean())
    parts = [_levels(stack, mask & (stack.mean(0) < 0.9 * saturation)) for stack, mask in zip(stacks, masks)]
    mean, variance, weight = (np.concatenate(part) for part in zip(*parts))
    keep = (variance > DITHERED * step**2) & (mean >= 3 * np.sqrt(variance))  # neither hidden by the step nor cut at 0
    few = "; add repeats at six exposures or more, from dark to 90 % of saturation"
    if keep.sum() < 3:
        raise Underdetermined(f"{here}: noise: {keep.sum()} signal levels can be used, 3 are needed" + few)
    (gain, floor), covariance = photon_transfer(mean[keep] - black_level, variance[keep], weight[keep])
    gain_sd, floor_sd = np.sqrt(np.diag(covariance))
    if gain < 10 * gain_sd:
        raise Underdetermined(
            f"{here}: noise: system_gain {gain:.3g} +- {gain_sd:.2g} DN per electron; needed to 10 %" + few
        )
    if floor - step**2 / 12 < -3 * floor_sd:
        raise Underdetermined(
            f"{here}: noise: variance {floor:.3g} DN^2 at black level {black_level:g} DN: the black level is too low "
            "or the response is bent; give the black level, and raw frames"
        )
    noise = Noise(float(gain), math.sqrt(max(floor - step**2 / 12, 0.0)), black_level, saturation, 0.0, step)
    stride = 2 if captures.cfa else 1  # to the next pixel of the same colour
    lit = [(stack, mask) for stack, mask, d in zip(stacks, masks, dark) if not d and stack.shape[2] > 2 * stride]
    return replace(noise, prnu=_prnu(lit, noise, stride))


def photon_transfer(light: np.ndarray, variance: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit variance = K (S - b) + intercept: ((K, intercept), covariance); a variance varies by variance^2 / weight."""
    design, fitted = np.stack([light, np.ones_like(light)], 1), variance
    for _ in range(5):  # weights from the line, not from the scatter: low readings must not pull it down
        weighted = design.T * (weight / np.maximum(fitted, 1e-3 * variance.max()) ** 2)
        covariance = np.linalg.pinv(weighted @ design)
        fitted = design @ (line := covariance @ (weighted @ variance))
    return line, covariance


def _levels(stack: np.ndarray, use: np.ndarray) -> list[np.ndarray]:
    """[mean, variance, weight] of a stack (n, H, W, C) in up to 24 groups of pixels of like signal."""
    stack = stack[:, use]
    if stack.shape[1] < 2:
        return [np.zeros(0)] * 3
    stack = stack - (stack.mean(1) - stack.mean())[:, None]  # flicker of the lamp is no noise
    mean, variance = stack.mean(0), stack.var(0, ddof=1)
    wide = np.ptp(np.percentile(mean, [1, 99])) / math.sqrt(variance.mean() / len(stack) + 1e-12)
    count = int(np.clip(wide / 10, 1, min(24, 1 + len(mean) // 200)))  # sorted by signal, not by noise
    groups = np.array_split(np.argsort(mean, kind="stable"), count)
    return list(np.array([(mean[g].mean(), variance[g].mean(), len(g) * (len(stack) - 1) / 2) for g in groups]).T)


def _prnu(lit: Sequence[tuple[np.ndarray, np.ndarray]], noise: Noise, stride: int) -> float:
    """Rms of the pixel gains, from d = (a - 2 b + c)/sqrt(6) along rows: var(d) = temporal/n + (p (S - b))^2."""
    squares, lights = [np.zeros(0)], [np.zeros(0)]
    for stack, mask in lit:
        mean = stack.mean(0)
        use = noise.usable(stack.max(0)) & noise.usable(stack.min(0)) & mask
        windows = [np.lib.stride_tricks.sliding_window_view(a, 2 * stride + 1, 1)[..., ::stride] for a in (mean, use)]
        triple = windows[0][windows[1].all(-1)]
        sd = noise.sd(triple[:, 1], len(stack))
        score = triple @ np.array([1, -2, 1]) / math.sqrt(6) / sd
        inside = np.abs(score) <= 3 * 1.4826 * np.median(np.abs(score)) if len(score) else []  # edges are no pattern
        squares.append(score[inside] ** 2 / 0.9733 - 1)  # the square of a Gaussian that is cut at three sigma
        lights.append(((triple[:, 1] - noise.black_level) / sd)[inside] ** 2)
    square, light = np.concatenate(squares), np.concatenate(lights)
    return math.sqrt(max(square @ light, 0.0) / (light @ light)) if light.any() else 0.0


def warnings_of(noise: Noise, captures: Captures) -> list[str]:
    """What about the camera and the frames weakens a verdict, in sentences."""
    found = [
        (
            captures.values_are == "DN" and not noise.pedestal,
            f"no pedestal: black level {noise.black_level:g} DN is below 3 sigma of the dark noise; dim pixels are cut "
            "at 0 and "
            "masked, and half a DN of black level looks like glare: raise the camera's offset",
        ),
        (
            captures.values_are == "DN"
            and captures.cfa is None
            and captures.table is None
            and captures.frames[0].image.shape[2] == 3,
            DEMOSAICED,
        ),
        (captures.bits == 8, "8 bit: a step of 1 DN hides what is weaker than it; record 10 bit or more"),
        (
            len(captures.frames) == 1,
            "one frame only: nothing can be held out, so no verdict can be verified; add frames",
        ),
        (
            noise.prnu > 0.003 and captures.flat_field is None,
            f"PRNU {noise.prnu:.2%} is above 0.3 % and does not average down over frames: record a flat_field to "
            "divide it out",
        ),
    ]
    return [text for holds, text in found if holds]
