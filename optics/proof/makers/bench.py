"""Simulated readings of a polarizer bench, by 2 x 2 coherency matrices: a second account of what the scenes model.

    source -> polarizer -> sample -> (middle) -> analyzer -> photodiode          all at normal incidence, light along +z

Transverse axes are x (right) and y (up) for an observer at the detector who looks towards the source, so that x, y, z
are right-handed; angles run counterclockwise from x for that observer. A polarizer's angle is that of its transmission
axis, a retarder's that of its fast axis. Fields go as exp(-i w t): what is retarded gains positive phase, J = <E
E^dagger>, and S3 = 2 Im(J_yx) > 0 turns counterclockwise for the observer. With n n^T the projector on an axis:

    polarizer   T = sqrt(T1) n n^T + sqrt(T2) (1 - n n^T)              T1 along the axis, T2 across it
    retarder    T = exp(-i d/2) n n^T + exp(i d/2) (1 - n n^T)         d phase, n fast axis
    any part    J -> sum_m T_m J T_m^dagger                            m modes that do not interfere
    depolarizer T_m = sqrt(1 - 3d/4), sqrt(d/4) sigma_1, 2, 3          S1, S2, S3 -> (1 - d) S: a Pauli channel
    backwards   T_m^T in the same x and y (reciprocity)
    a face      J -> (1 - R) J onwards, R J back: the direction of vibration stays, the handedness to the ray changes

Source: Born and Wolf, Principles of Optics, 10.9 (coherency matrix); de Hoop's reciprocity for the transposed matrix.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from numbers import Real
from pathlib import Path

import numpy as np

from optics.captures import capture_set as capture_files
from optics.captures.noise import Noise
from optics.errors import BadCapture, OutputExists, UnknownKey

WAVELENGTHS = (620.0, 540.0, 460.0)  # nm: red, green, blue
CHANNELS = {1: (1,), 3: (0, 1, 2)}  # which of the wavelengths a photodiode with so many channels sees
REFERENCE = 540.0  # nm: retardance and leak are given here
REST = 1e-18  # of the source's light: bounces are followed down to this, far below what good crossed films let through
DEFAULTS = {
    "source.power": 1.0,
    "source.time": 0.0,
    "sample.angle": 0.0,
    **{f"{part}.{what}": 0.0 for part in ("polarizer", "middle", "analyzer") for what in ("angle", "approach")},
}
PAULI = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, -1j], [1j, 0]]])

Settings = Sequence[Mapping[str, float]]  # one reading each, by key; what is missing stands at DEFAULTS


# -- What is on the bench --------------------------------------------------------------------------------------------
def _within(low: float, high: float, default: float):
    return field(default=default, metadata={"bounds": (low, high)})


class _Checked:
    """Refuses what no bench can be: every number finite and within the bounds that its field declares."""

    def __post_init__(self):
        for f in fields(self):
            low, high = f.metadata.get("bounds", (-math.inf, math.inf))
            for value in np.ravel(getattr(self, f.name)):
                if isinstance(value, Real) and not (math.isfinite(value) and low <= value <= high):
                    raise ValueError(
                        f"{type(self).__name__}.{f.name} = {value:g}; allowed: finite, {low:g} to {high:g}; correct it"
                    )


@dataclass(frozen=True)
class Source(_Checked):
    """Light of radiance power power_rgb (setting power) (1 + drift time), partly linearly polarized."""

    power: float = _within(0, math.inf, 1.0)  # multiplies the setting `source.power`
    power_rgb: tuple[float, float, float] = field(default=(1.0, 1.0, 1.0), metadata={"bounds": (0, math.inf)})
    dop: float = _within(0, 1, 0.0)  # degree of linear polarization
    dop_angle: float = 0.0  # deg
    drift: float = 0.0  # relative, per minute of the setting `source.time`


@dataclass(frozen=True)
class Polarizer(_Checked):
    """A film: face, absorber, face. T1 and T2 are the absorber's own, the faces' losses come on top.

    True angle = scale dial + offset + backlash approach / 2, in deg; T1 and T2 both times 1 + wobble_c cos(dial) +
    wobble_s sin(dial); T2 at a wavelength w (nm) is leak exp(leak_slope (w - 540)/100).
    """

    transmittance: float = _within(0, 1, 0.8)  # T1, of light polarized along the axis
    leak: float = _within(0, 1, 0.0)  # T2 at 540 nm, of light polarized across it
    leak_slope: float = 0.0  # per 100 nm
    offset: float = 0.0  # deg
    scale: float = 1.0  # true deg per dial deg
    backlash: float = 0.0  # deg between the two directions of approach
    wobble_c: float = _within(-0.5, 0.5, 0.0)
    wobble_s: float = _within(-0.5, 0.5, 0.0)
    face_reflectance: float = _within(0, 0.5, 0.0)  # of each of the two faces


@dataclass(frozen=True)
class Sample(_Checked):
    """A retarder, then a stressed one, then a depolarizer, in the order of the light; `sample.angle` turns all of
    it."""

    retardance: float = 0.0  # deg of phase at 540 nm
    axis: float = 0.0  # deg, fast axis
    dispersion: float = 0.0  # d(w) = retardance (540/w) (1 + dispersion ((540/w)^2 - 1)), w in nm
    stress_retardance: float = 0.0  # deg of phase at 540 nm, as 1/wavelength
    stress_axis: float = 0.0  # deg, fast axis
    depolarization: float = _within(0, 1, 0.0)  # linear and circular alike
    transmittance: float = _within(0, 1, 1.0)


@dataclass(frozen=True)
class Photodiode(_Checked):
    """DN = black + (saturation - black) (gain radiance)^gamma + offset, in one channel (540 nm) or three (RGB)."""

    gain: float = _within(0, math.inf, 1.0)  # full scale per unit radiance
    gamma: float = _within(0.1, 10, 1.0)
    offset: float = 0.0  # DN
    channels: int = 1

    def __post_init__(self):
        super().__post_init__()
        if self.channels not in CHANNELS:
            raise ValueError(
                f"Photodiode.channels = {self.channels}; allowed: 1 (540 nm) or 3 (620, 540, 460 nm); correct it"
            )


@dataclass(frozen=True)
class Truth(_Checked):
    """The bench as it is; a polarizer that is None is not on it. `stray`: radiance that reaches the photodiode at every
    angle."""

    source: Source = Source()
    p1: Polarizer | None = Polarizer()
    sample: Sample = Sample()
    pm: Polarizer | None = None
    p2: Polarizer | None = Polarizer()
    stray: float = _within(0, math.inf, 0.0)
    photodiode: Photodiode = Photodiode()


# -- Light through it ------------------------------------------------------------------------------------------------
def radiance(truth: Truth, settings: Settings) -> np.ndarray:
    """Radiance at the photodiode (n, C), stray light included, for n readings and C channels.

    Raises UnknownKey for a setting that the bench lacks, ValueError for one that is not finite or a negative source.
    """
    dials = _dials(truth, settings)
    channels = list(CHANNELS[truth.photodiode.channels])
    wavelengths, source = np.array(WAVELENGTHS)[channels], truth.source
    power = source.power * dials["source.power"] * (1 + source.drift * dials["source.time"])
    if np.any(power < 0):
        raise ValueError(
            f"reading {np.argmin(power)}: source of {power.min():g}; allowed: >= 0; see source.power, drift and time"
        )
    planes = _film("polarizer", truth.p1, dials, wavelengths)
    planes += [(_sample_modes(truth.sample, dials["sample.angle"], wavelengths), 0.0)]
    planes += _film("middle", truth.pm, dials, wavelengths) + _film("analyzer", truth.p2, dials, wavelengths)
    unit = (1 - source.dop) / 2 * PAULI[0] + source.dop * _projector(source.dop_angle)
    out = _transmit(planes, np.broadcast_to(unit, (len(settings), len(channels), 2, 2)))
    return _intensity(out) * power[:, None] * np.array(source.power_rgb)[channels] + truth.stray


def _dials(truth: Truth, settings: Settings) -> dict[str, np.ndarray]:
    """{key: (n,)} of every setting, the missing ones at their defaults."""
    if not len(settings):
        raise ValueError("settings: zero readings; allowed: one or more; see malus_sweep")
    absent = [
        part for part, film in (("polarizer", truth.p1), ("middle", truth.pm), ("analyzer", truth.p2)) if film is None
    ]
    known = [key for key in DEFAULTS if key.split(".")[0] not in absent]
    for index, reading in enumerate(settings):
        for key, value in reading.items():
            if key not in known:
                hint = "this part is not on the bench: give it in Truth" if key in DEFAULTS else ""
                raise UnknownKey(key, known, "setting", f"reading {index}", hint)
            if not math.isfinite(value):
                raise ValueError(f"reading {index}: {key} = {value}; allowed: finite; correct it")
    return {
        key: np.array([reading.get(key, default) for reading in settings], float) for key, default in DEFAULTS.items()
    }


def _projector(angle) -> np.ndarray:
    """n n^T (..., 2, 2) for an axis at `angle` (...), deg."""
    n = np.stack([np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))], -1)
    return n[..., :, None] * n[..., None, :]


def _on_axis(along, across, angle) -> np.ndarray:
    """T (n, C, 2, 2) with amplitudes (n, C) `along` and `across` an axis at `angle` (n,), deg."""
    projector = _projector(angle)[:, None]
    return np.asarray(along)[..., None, None] * projector + np.asarray(across)[..., None, None] * (PAULI[0] - projector)


def _film(part: str, film: Polarizer | None, dials: Mapping[str, np.ndarray], wavelengths: np.ndarray) -> list:
    """Face, absorber, face as planes (modes, reflectance); nothing where the film is absent."""
    if film is None:
        return []
    dial = dials[f"{part}.angle"]
    angle = film.scale * dial + film.offset + film.backlash / 2 * dials[f"{part}.approach"]
    wobble = (1 + film.wobble_c * np.cos(np.deg2rad(dial)) + film.wobble_s * np.sin(np.deg2rad(dial)))[:, None]
    leak = film.leak * np.exp(film.leak_slope * (wavelengths - REFERENCE) / 100)
    absorber = _on_axis(np.sqrt(film.transmittance * wobble), np.sqrt(leak * wobble), angle)[None], 0.0
    face = math.sqrt(1 - film.face_reflectance) * PAULI[:1, None, None], film.face_reflectance
    return [face, absorber, face] if film.face_reflectance else [absorber]


def _sample_modes(sample: Sample, turn: np.ndarray, wavelengths: np.ndarray) -> np.ndarray:
    """Modes (m, n, C, 2, 2) of the sample turned by `turn` (n,), deg."""
    ratio = REFERENCE / wavelengths
    own = sample.retardance * ratio * (1 + sample.dispersion * (ratio**2 - 1))
    retarder, stressed = (
        _on_axis(np.exp(-0.5j * phase), np.exp(0.5j * phase), axis + turn)
        for phase, axis in (
            (np.deg2rad(own)[None], sample.axis),
            (np.deg2rad(sample.stress_retardance * ratio)[None], sample.stress_axis),
        )
    )
    weights = np.array([1 - 0.75 * sample.depolarization, *[sample.depolarization / 4] * 3])
    channel = (np.sqrt(weights)[:, None, None] * PAULI)[weights > 0]
    return math.sqrt(sample.transmittance) * channel[:, None, None] @ (stressed @ retarder)


def _transmit(planes: Sequence[tuple[np.ndarray, float]], light: np.ndarray) -> np.ndarray:
    """Coherency matrices (n, C, 2, 2) behind the last plane, every order of reflection between the planes included.

    One pass takes all light that goes one way to the end, and leaves what each plane sends back as the start of the
    next pass the other way; k reversals, k passes. What goes back to the source or reaches the photodiode does not
    return."""
    zero = np.zeros(light.shape, complex)
    starts, leaving, onwards = (
        [light, *[zero] * len(planes)],
        zero,
        True,
    )  # light that sets out before each plane, and last
    while sum(_intensity(start) for start in starts).max() > REST:
        wave, back = starts[0], []
        for (modes, reflectance), start in zip(planes, starts[1:]):
            back.append(reflectance * wave)
            wave = (modes @ wave @ modes.conj().swapaxes(-1, -2)).sum(0) + start
        leaving = leaving + wave if onwards else leaving
        starts, onwards = [zero, *reversed(back)], not onwards
        planes = [(modes.swapaxes(-1, -2), reflectance) for modes, reflectance in reversed(planes)]
    return leaving


def _intensity(light: np.ndarray) -> np.ndarray:
    return np.trace(light, axis1=-2, axis2=-1).real


# -- Readings of it --------------------------------------------------------------------------------------------------
def expected(truth: Truth, settings: Settings, noise: Noise) -> np.ndarray:
    """Mean reading (n, C) in DN, neither rounded nor clipped; errors as of `radiance`."""
    diode = truth.photodiode
    m = (
        diode.gain * np.maximum(radiance(truth, settings), 0.0)
    ) ** diode.gamma  # crossed polarizers leave -1e-17 by rounding
    return noise.black_level + (noise.saturation - noise.black_level) * m + diode.offset


def readings(truth: Truth, settings: Settings, noise: Noise, seed: int, bits: int = 16) -> np.ndarray:
    """Readings (n, C) in whole DN, 0 to 2^bits - 1: electrons counted, dark noise, rounded, clipped at 0 and
    saturation.

    All that stands above the black level is counted in electrons, an offset too (dark current). The photodiode has one
    element and so no fixed pattern. Raises as `radiance`, and ValueError for noise that does not fit.
    """
    if noise.prnu:
        raise ValueError(
            f"prnu = {noise.prnu:g}; allowed: 0, as a photodiode's one element has no pattern; leave it to the gain"
        )
    if not noise.saturation <= 2**bits - 1:
        raise ValueError(
            f"saturation = {noise.saturation:g} DN; allowed: <= {2**bits - 1} DN at {bits} bit; give more bits"
        )
    rng = np.random.default_rng(seed)
    mean = expected(truth, settings, noise)
    electrons = np.maximum(mean - noise.black_level, 0.0) / noise.system_gain
    reading = noise.system_gain * rng.poisson(electrons) + np.minimum(mean, noise.black_level)
    reading += noise.dark_noise * rng.standard_normal(mean.shape)
    return np.clip(np.round(reading), 0.0, math.floor(noise.saturation))


def with_effects(hidden: Mapping[str, float], gain: float) -> Truth:
    """A bench with effects of the library in it, {name: strength from none}; films, a sheet and a diode of `gain` that
    are else ideal.

    The misaligned, scaled, slack or wobbling film is the second; both leak. A sheet's fast axis is at 20 deg, a
    polarized lamp's at 30."""
    p1, p2, source, sample, diode, stray = Polarizer(), Polarizer(), Source(), Sample(), Photodiode(gain=gain), 0.0
    film = {"polarizer misalignment": "offset", "servo backlash": "backlash", "analyzer wobble": "wobble_c"}
    for effect, s in hidden.items():
        if effect in film:
            p2 = replace(p2, **{film[effect]: s})
        elif effect == "servo scale":
            p2 = replace(p2, scale=1 + s)
        elif effect == "extinction leak":
            p1, p2 = replace(p1, leak=s), replace(p2, leak=s)
        elif effect == "retardance":
            sample = replace(sample, retardance=s, axis=20.0)
        elif effect == "depolarization":
            sample = replace(sample, depolarization=s)
        elif effect == "polarized source":
            source = replace(source, dop=s, dop_angle=30.0)
        elif effect == "source drift":
            source = replace(source, drift=s)
        elif effect == "camera gamma":
            diode = replace(diode, gamma=1 + s)
        elif effect == "dark offset":
            diode = replace(diode, offset=s)
        elif effect == "stray light":
            stray = s
        else:
            raise ValueError(f"no independent way to make {effect} on the bench")
    return Truth(p1=p1, p2=p2, source=source, sample=sample, photodiode=diode, stray=stray)


def malus_sweep(
    count: int,
    polarizer_angles: Sequence[float] = (0.0,),
    turns: float = 1.0,
    minutes: float = 30.0,
    power: float = 1.0,
    fixed: Mapping[str, float] | None = None,
) -> list[dict[str, float]]:
    """Settings of `count` readings: at each angle of the polarizer (deg) the analyzer goes `turns` round and back
    again.

    minutes   from the first reading to the last, evenly
    fixed     further settings that hold in every reading, such as {"sample.angle": 30.0}
    """
    if count < 2 * len(polarizer_angles):
        raise ValueError(
            f"count = {count}; allowed: >= {2 * len(polarizer_angles)}, out and back at each angle of the polarizer"
        )
    found = []
    for angle, run in zip(polarizer_angles, np.array_split(np.arange(count), len(polarizer_angles))):
        for approach, way in zip((1.0, -1.0), np.array_split(run, 2)):
            part = np.arange(len(way)) / len(way)
            dial = 360 * turns * (part if approach > 0 else 1 - part)
            found += [
                {
                    "source.power": float(power),
                    "source.time": minutes * int(index) / (count - 1),
                    "polarizer.angle": float(angle),
                    "analyzer.angle": float(d),
                    "analyzer.approach": approach,
                    **(fixed or {}),
                }
                for index, d in zip(way, dial)
            ]
    return found


def write(
    folder: str | Path,
    truth: Truth,
    settings: Settings,
    noise: Noise,
    seed: int,
    scene: str = "polarizer_bench",
    bits: int = 16,
) -> Path:
    """Write `readings` as a capture set with a table; returns the folder, which appears whole or not at all.

    Columns: every setting that a reading has, then `reading`, or `red`, `green`, `blue`. Raises as `readings`,
    OutputExists for a folder that exists, and BadCapture for a reading that is saturated in every channel, which no
    capture set may hold."""
    folder = Path(folder)
    if os.path.lexists(folder):
        raise OutputExists(f"{folder} exists; choose another folder")
    values = readings(truth, settings, noise, seed, bits)
    if (full := np.all(values >= math.floor(noise.saturation), axis=1)).any():
        raise BadCapture(
            f"{folder}: reading {np.argmax(full)} is saturated ({noise.saturation:g} DN); allowed: some value below; "
            "lower the photodiode's gain or the source's power"
        )
    keys = [key for key in DEFAULTS if any(key in reading for reading in settings)]
    frames = [
        capture_files.Frame(
            f"row {index}",
            value.astype(np.float32).reshape(1, 1, -1),
            parameters={key: float(reading.get(key, DEFAULTS[key])) for key in keys},
        )
        for index, (reading, value) in enumerate(zip(settings, values))
    ]
    table = capture_files.Table("readings.csv", ["reading"] if values.shape[1] == 1 else ["red", "green", "blue"])
    return capture_files.write(capture_files.Captures(folder, scene, frames, noise=noise, table=table), folder)
