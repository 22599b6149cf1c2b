"""Camera noise in the terms of EMVA 1288: what a digital number (DN) scatters by, how it is measured, what to mask.

    variance(S) = [K (S - b) + d^2] / n + q^2 / 12 + (p (S - b))^2          DN^2

S signal (DN), K system gain (DN per electron), b black level (DN), d dark noise (DN rms), n frames averaged, q step of
the quantisation (DN), p photo-response non-uniformity (relative rms). Source: EMVA 1288, linear camera model and photon
transfer; p is a fixed pattern, the same in every image, so that averaging frames leaves it.

Demosaicing, resizing and JPEG make neighbours share their noise. A pixel and its neighbour along a row or a column then
have the correlation rho, pixels (m, n) apart rho^(m + n), and a mean of k x k pixels has the variance of a pixel times

    [1 + 2 sum over d < k of (1 - d/k) rho^d]^2 / k^2
"""

from __future__ import annotations

import math
from collections.abc import Collection, Hashable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from optics.errors import Underdetermined
from optics.scene.parameter import LARGEST

if TYPE_CHECKING:
    from optics.captures.capture_set import Captures, Frame

SATURATED = (
    0.96  # of saturation: above, response bends before it clips (top-1 of a diagnosis fell from 99 to 17 % unmasked)
)
DITHERED = (
    0.25  # temporal variance per step^2 from which the step acts as noise q^2/12 to 2.5 % (at 0.09: only to 45 %)
)
PER_CHANNEL = ("system_gain", "dark_noise", "correlation")  # what may be a number for each channel
UNITS = {
    "system_gain": "DN per electron",
    "dark_noise": "DN, rms",
    "black_level": "DN",
    "saturation": "DN",
    "prnu": "(relative, rms)",
    "quantisation": "DN",
    "correlation": "(of neighbouring pixels)",
}
DEMOSAICED = (
    "3 channels and no cfa: if these are demosaiced, neighbouring pixels share their noise and a diagnosis raises "
    "false alarms (85 % of sets at a perfect chi2); supply raw frames and cfa. If each pixel measured all three, state "
    'cfa = "none"'
)
UNLIMITED = (
    "the end of the instrument's range is not known, so that no reading is left out as saturated; give saturation "
    "under [noise] where it has one"
)
REPEATS = 10  # degrees of freedom of repeated readings: their standard deviation is then known to 22 %
SLOPED = 3.0  # standard deviations from 0 of a gain that readings determine


@dataclass(frozen=True)
class Noise:
    """Noise of a camera; every number as in the module's text, `saturation` in DN.

    system_gain, dark_noise   a number, or one for each channel: of the last axis of a signal (H, W, C). A signal whose
             last axis is no list of the channels has the mean of the gains and the rms of the dark noises
    correlation   of the noise of neighbouring pixels, 0 to 1; a number, or one for each channel
    signed   whether a value below 0 is a reading like any other, as of a volt meter, and not cut off there
    ends     whether values end at `saturation`; else it only sets the scale of what a camera makes of light
    """

    system_gain: float | tuple[float, ...]
    dark_noise: float | tuple[float, ...]
    black_level: float
    saturation: float
    prnu: float
    quantisation: float = 1.0
    signed: bool = False
    ends: bool = True
    correlation: float | tuple[float, ...] = 0.0

    def __post_init__(self):
        rules = {"black_level": "finite"} if self.signed else {"black_level": "finite", "system_gain": "> 0"}
        for name in PER_CHANNEL:
            if isinstance(values := getattr(self, name), (list, tuple)):
                object.__setattr__(self, name, tuple(float(v) for v in values))
        lists = {name: v for name in PER_CHANNEL if isinstance(v := getattr(self, name), tuple)}
        if {len(v) for v in lists.values()} - {3}:
            given = ", ".join(f"{name} = {v}" for name, v in lists.items())
            raise ValueError(f"{given}; allowed: a number, or three of them, for R, G and B")
        if not all(v < 1 for v in np.atleast_1d(self.correlation)):
            raise ValueError(f"correlation = {self.correlation}; allowed: 0 or more, below 1, of neighbouring pixels")
        for name, unit in UNITS.items():
            own, allowed = getattr(self, name), rules.get(name, ">= 0")
            if name == "saturation" and not self.ends and own == math.inf:
                continue
            for value in own if isinstance(own, tuple) else (own,):
                if not math.isfinite(value) or (allowed != "finite" and value < 0) or (allowed == "> 0" and value == 0):
                    raise ValueError(f"{name} = {value:g} {unit}; allowed: {allowed}; see the camera's EMVA 1288 sheet")
                if abs(value) > LARGEST:
                    raise ValueError(
                        f"{name} = {value:g} {unit} is beyond what can be computed with; allowed: up to {LARGEST:g}"
                    )
        if self.saturation <= self.black_level:
            raise ValueError(f"saturation = {self.saturation:g} DN; allowed: > black_level = {self.black_level:g} DN")

    def variance(self, signal: np.ndarray, frames_averaged: int = 1) -> np.ndarray:
        """Variance in DN^2 of a noise-free signal in DN (any shape), recorded as the mean of `frames_averaged`
        frames."""
        light = np.maximum(np.asarray(signal, float) - self.black_level, 0.0)
        gain, dark = self._numbers(light.shape)
        temporal = gain * light + dark**2
        step = self.quantisation**2 / 12
        if frames_averaged > 1:  # the step averages down like the rest only where the temporal noise dithers it
            step = np.where(temporal >= DITHERED * self.quantisation**2, step / frames_averaged, step)
        return temporal / frames_averaged + step + (self.prnu * light) ** 2

    def _numbers(self, shape: Sequence[int]) -> tuple[Any, Any]:
        """(system_gain, dark_noise) for a signal of a shape: numbers, or arrays along its last axis."""

        def of(value: float | tuple[float, ...], power: int) -> Any:
            if not isinstance(value, tuple):
                return value
            numbers = np.array(value)
            return numbers if shape and shape[-1] == len(value) else float(np.mean(numbers**power)) ** (1 / power)

        return of(self.system_gain, 1), of(self.dark_noise, 2)

    def written(self, name: str) -> float | list[float]:
        """A number as files hold it: of each channel its own in a list."""
        own = getattr(self, name)
        return [float(v) for v in own] if isinstance(own, tuple) else float(own)

    def of_channel(self, channel: int) -> Noise:
        """The noise of one channel, for signals of any shape."""
        own = {n: v[channel] for n in PER_CHANNEL if isinstance(v := getattr(self, n), tuple)}
        return replace(self, **own)

    def sd(self, signal: np.ndarray, frames_averaged: int = 1) -> np.ndarray:
        """Standard deviation in DN: the root of `variance`."""
        return np.sqrt(self.variance(signal, frames_averaged))

    def times(self, factor: float | np.ndarray) -> Noise:
        """Noise of so many times the temporal variance: a number, or one for each channel."""

        def of(value: float | tuple[float, ...], by: float | np.ndarray) -> float | tuple[float, ...]:
            found = np.multiply(value, by)
            return tuple(found.tolist()) if found.ndim else float(found)

        return replace(self, system_gain=of(self.system_gain, factor), dark_noise=of(self.dark_noise, np.sqrt(factor)))

    def in_cells(self, k: int) -> Noise:
        """The noise of the mean of k x k pixels, as if such means were independent of each other. That of the step is a
        mean too, where noise dithers it (EMVA 1288)."""
        shared = 1 + 2 * sum(((1 - d / k) * np.array(self.correlation) ** d for d in range(1, k)), np.zeros(()))
        return replace(
            self.times((shared / k) ** 2), quantisation=self.quantisation / k, prnu=self.prnu / k, correlation=0.0
        )

    def summed(self, frames: int) -> Noise:
        """Noise of the sum of `frames` frames (DN add up), stated as that of one frame, as [noise] asks for.

        The gain in DN per electron stays, the quantisation of all frames but one is counted as dark noise.
        """
        return replace(
            self,
            dark_noise=self._dark_with_rounding(frames, frames - 1),
            black_level=frames * self.black_level,
            saturation=frames * self.saturation,
        )

    def unrounded(self) -> Noise:
        """Noise of whole values to which a fraction was added: their rounding error counts as dark noise."""
        return replace(self, dark_noise=self._dark_with_rounding(1, 1), quantisation=0.0)

    def _dark_with_rounding(self, frames: int, roundings: int) -> float | tuple[float, ...]:
        """Dark noise of the sum of so many frames, with the error of so many roundings."""

        def of(dark: float) -> float:
            return math.sqrt(frames * dark**2 + roundings * self.quantisation**2 / 12)

        return tuple(map(of, self.dark_noise)) if isinstance(self.dark_noise, tuple) else of(self.dark_noise)

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
        gain, dark = self._numbers(light.shape)
        if np.all(np.asarray(gain) > 0):
            light = gain * rng.poisson(light / gain)
        if self.signed:  # what a camera adds may lie below its black level
            light = light + np.minimum(np.asarray(signal, float) - self.black_level, 0.0)
        frame = self.black_level + light + dark * rng.standard_normal(light.shape)
        frame = np.clip(frame, -math.inf if self.signed else 0.0, self.saturation if self.ends else math.inf)
        return np.round(frame / self.quantisation) * self.quantisation if self.quantisation else frame

    def in_scale_of(self, other: Noise | None) -> Noise:
        """The same noise in the full scale of another, which a fit's powers are stated in, where neither ends there."""
        alike = other is not None and not other.ends and not self.ends
        return replace(self, saturation=other.saturation) if alike and other is not None else self

    @property
    def pedestal(self) -> bool:
        """Whether the black level stands three sigma above 0, so that dark noise is not clipped."""
        return self.black_level >= 3 * float(np.max(self.sd(np.full(3, self.black_level))))

    def usable(self, image: np.ndarray, dilate: int = 1) -> np.ndarray:
        """Mask (H, W, C), True = use: not within `dilate` pixels of saturation, in each channel's own plane.

        Without a pedestal, what stands within 3 sigma of 0 is cut by the clipping and left out as well, unless values
        below 0 are readings like any other. Where values do not end, none is saturated.
        """
        image = np.asarray(image)
        if not self.ends:
            return np.ones(image.shape, bool) if self.signed or self.pedestal else image >= 3 * self.sd(image)
        bad = image >= SATURATED * self.saturation
        for axis in (0, 1):  # a square neighbourhood, one axis after the other
            padded = np.pad(bad, [(dilate, dilate) if a == axis else (0, 0) for a in range(3)])
            bad = np.lib.stride_tricks.sliding_window_view(padded, 2 * dilate + 1, axis).any(-1)
        return ~bad if self.pedestal or self.signed else ~bad & (image >= 3 * self.sd(image))


def step_of(images: Sequence[np.ndarray]) -> float:
    """The step of the quantisation in DN: the common divisor of whole numbers (16 for 12 bit in 16), 0 for
    fractions."""
    levels = np.unique(
        np.concatenate([image.ravel()[:: 1 + image.size // 20000] for image in images])
    )  # a sample will do
    if np.any(levels != np.round(levels)):
        return 0.0
    return float(np.gcd.reduce(levels.astype(np.int64))) if len(levels) >= 32 else 1.0  # few levels share one by chance


def estimate(
    captures: Captures,
    black_level: float | None = None,
    saturation: float | None = None,
    clocks: Collection[str] = (),
) -> Noise:
    """Noise from repeated frames: photon transfer (EMVA 1288), one gain for all channels; PRNU is an upper limit, as
    texture of the scene finer than three pixels counts as PRNU. Raises Underdetermined with what to supply.

    Readings of a table: see `_of_readings`.

    black_level  DN; None: the mean of dark frames with repeats (every `*.power` or `*.exposure` that is set is 0)
    saturation   DN; None: full scale of the smallest converter (8, 10, 12, 14, 16 bit) that holds the values
    clocks       keys that say when a reading was taken: readings that differ in nothing else are repeats
    """
    if captures.table is not None:
        return _of_readings(captures, black_level, saturation, clocks)
    here = f"{captures.folder}/captures.toml"
    repeated_frames = [frame for frame in captures.frames if frame.repeats]
    if not repeated_frames:
        raise Underdetermined(
            f"{here}: noise: no frame has repeats; add `repeats` at six exposures or more, or give [noise]"
        )
    stacks = [np.stack([f.image, *f.repeats]).astype(float) for f in repeated_frames]
    masks = [np.broadcast_to(True if f.mask is None else f.mask[..., None], f.image.shape) for f in repeated_frames]
    lights = [
        [
            value
            for key, value in {**captures.parameters, **f.parameters}.items()
            if key.endswith((".power", ".exposure"))
        ]
        for f in repeated_frames
    ]
    dark = [bool(values) and not any(values) for values in lights]
    step = step_of(stacks)
    if saturation is None:
        top = max(float(image.max()) for f in captures.frames for image in (f.image, *f.repeats))
        saturation = next(((2**n - 1) * step for n in (8, 10, 12, 14, 16) if (2**n - 1) * step >= top), None)
        if not saturation:
            raise Underdetermined(
                f"{here}: noise: values to {top:g} DN, step {step:g} DN, fit no A/D converter; give saturation in DN"
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
            "or the response is not linear; give the black level, and raw frames"
        )
    noise = Noise(float(gain), math.sqrt(max(floor - step**2 / 12, 0.0)), black_level, saturation, 0.0, step)
    # to the next pixel of the same colour, or behind the same analyser
    stride = 2 if captures.cfa else len(captures.mosaic[0]) if captures.mosaic else 1
    lit = [(stack, mask) for stack, mask, d in zip(stacks, masks, dark) if not d and stack.shape[2] > 2 * stride]
    return replace(noise, prnu=_prnu(lit, noise, stride))


def repeated(captures: Captures, clocks: Collection[str] = ()) -> list[list[Frame]]:
    """Readings of a table that repeat each other, two or more in each list: those of equal settings (`clocks` aside) in
    consecutive rows where these hold REPEATS degrees of freedom, else all of equal settings in a group.

    What comes back to a setting later brings the error of the dial, and drift; consecutive rows do not."""
    if captures.table is None:
        return []

    def key(frame: Frame) -> Hashable:
        return (frame.group, *sorted(item for item in frame.parameters.items() if item[0] not in clocks))

    runs: list[list[Frame]] = []
    equal: dict[Hashable, list[Frame]] = {}
    for frame in captures.frames:
        if runs and key(runs[-1][0]) == key(frame):
            runs[-1].append(frame)
        else:
            runs.append([frame])
        equal.setdefault(key(frame), []).append(frame)
    channels = captures.frames[0].image.size
    runs = [rows for rows in runs if len(rows) > 1]
    if channels * sum(len(rows) - 1 for rows in runs) >= REPEATS:
        return runs
    return [rows for rows in equal.values() if len(rows) > 1]


def _of_readings(
    captures: Captures, black_level: float | None, saturation: float | None, clocks: Collection[str]
) -> Noise:
    """Noise of repeated readings (`repeated`) from their variance about their own mean ("pure error").

    variance = K (S - b) + d^2 with b the black level, 0 unless given, where the gain K stands SLOPED standard
    deviations from 0 and d^2 is not below 0; else the same d^2 at every level. Readings have no end unless a saturation
    is given.
    Raises Underdetermined where fewer than REPEATS degrees of freedom are there, or all repeats are the same number."""
    here = f"{captures.folder}/captures.toml"
    groups = [np.stack([f.image.reshape(-1) for f in rows]).astype(float) for rows in repeated(captures, clocks)]
    channels = captures.frames[0].image.size
    freedom = channels * sum(len(rows) - 1 for rows in groups)
    if freedom < REPEATS:
        raise Underdetermined(
            f"{here}: noise: rows of equal settings leave {freedom} degrees of freedom, {REPEATS} are needed; give "
            "dark_noise (the standard deviation of a reading) under [noise], or repeat readings"
        )
    mean = np.concatenate([rows.mean(0) for rows in groups])
    variance = np.concatenate([rows.var(0, ddof=1) for rows in groups])
    weight = np.concatenate([np.full(channels, (len(rows) - 1) / 2) for rows in groups])
    step, black = captures.step, 0.0 if black_level is None else black_level
    pooled = float(weight @ variance / weight.sum())
    if pooled == 0 and step == 0:
        raise Underdetermined(
            f"{here}: noise: rows of equal settings hold the same number, copies and not repeats; give dark_noise "
            "(the standard deviation of a reading) under [noise]"
        )
    gain, floor = 0.0, pooled
    if pooled > 0 and len(mean) > 2 and np.ptp(mean) > 0:
        (slope, intercept), covariance = photon_transfer(mean - black, variance, weight)
        if slope > SLOPED * math.sqrt(covariance[0, 0]) and intercept >= step**2 / 12:
            gain, floor = float(slope), float(intercept)
    top = max(float(f.image.max()) for f in captures.frames)
    dark = math.sqrt(max(floor - step**2 / 12, 0.0))
    scale = saturation if saturation is not None else top if top > black else black + 1.0
    return Noise(gain, dark, black, scale, 0.0, step, signed=True, ends=saturation is not None)


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


def _brightest(frame: Frame) -> float:
    """DN, of the pixels that are used; -inf for none."""
    own = frame.image if frame.mask is None else frame.image[frame.mask]
    return float(np.max(own, initial=-math.inf, where=np.isfinite(own)))


def may_be_demosaiced(captures: Captures) -> bool:
    """Whether three channels of its images may come from one value per pixel, for all that is stated."""
    plain = captures.values_are == "DN" and captures.table is None and captures.cfa is None and not captures.unfiltered
    return plain and captures.frames[0].image.shape[2] == 3


def warnings_of(noise: Noise, captures: Captures) -> list[str]:
    """What about the camera and the frames weakens a verdict, in sentences."""
    found = [
        (
            captures.values_are == "DN" and not noise.pedestal and not noise.signed,
            f"no pedestal: black level {noise.black_level:g} DN is below 3 sigma of the dark noise; dim pixels are cut "
            "at 0 and "
            "masked, and half a DN of black level looks like glare: raise the camera's offset",
        ),
        (may_be_demosaiced(captures), DEMOSAICED),
        (
            captures.values_are == "DN"
            and noise.ends
            and any(_brightest(f) > noise.saturation + 1 for f in captures.frames),
            f"values above saturation = {noise.saturation:g} DN: no converter gives them; correct [noise] saturation",
        ),
        (captures.bits == 8, "8 bit: a step of 1 DN hides what is weaker than it; record 10 bit or more"),
        (
            len(captures.frames) == 1,
            "one frame only: nothing can be held out, so no verdict can be verified; add frames",
        ),
        (
            noise.prnu > 0.003 and captures.flat_field is None and any(f.flat_field is None for f in captures.frames),
            f"PRNU {noise.prnu:.2%} is above 0.3 % and does not average down over frames: record a flat_field to "
            "divide it out",
        ),
    ]
    return [text for holds, text in found if holds]
