"""A bench of polarizers as Stokes vectors, and what can be wrong with it.

    lamp -> polarizer -> sample -> middle -> analyzer -> detector            angles in deg, counterclockwise for a
                                                                              viewer at the detector
A bench is a flat table {name: number}; what it does not name stands at PLAIN, which is a perfect bench. In the frame
of a part's axis a Stokes vector (I, Q, U, V) becomes

    film       (a I + b Q, b I + a Q, c U, c V)      a, b = (T1 +- T2)/2, c = sqrt(T1 T2)
    plate      (I, Q, U cos d + V sin d, V cos d - U sin d)         fast axis, phase d
    dichroic   (I + D Q, Q + D I, c U, c V)          absorbed less along its axis, D = tanh x, c = sqrt(1 - D^2)
    haze       (I, (1 - h) Q, (1 - h) U, (1 - h) V)

Source: Collett, Field Guide to Polarization, 2005: Mueller matrices of a polarizer, a wave plate, a depolarizer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

Bench = Mapping[str, float]
Settings = Mapping[str, np.ndarray]  # scene key -> (n,) what stands on the dials

FILMS = ("polarizer", "middle", "analyzer")
T1 = 0.8  # of a film along its axis
GREEN = 540.0  # nm: retardance and leak are given here
MOST_FRAMES = 40  # photographs of a set
REGIONS = 4  # of a panel
TWISTED = 24  # thin plates that stand for a twisted one
STRIPE = 8.0  # deg, sd: half width of a stripe in a film, as its dial turns
TEETH = 5  # turns of a pinion per turn of its film
KEPT = 0.8  # of a detector's fatigue, from one reading to the next
# of each film: deg, 1, deg, deg at full lag, relative once and twice per turn, deg (a ratio that grows), deg once per
# turn and twice, deg once per turn of a pinion, the depth of a stripe as a vector to its place on the dial, T2, its
# slope/100 nm
FILM = {
    "zero": 0.0,
    "scale": 1.0,
    "slack": 0.0,
    "lag": 0.0,
    "wobble_c": 0.0,
    "wobble_s": 0.0,
    "wobble_2": 0.0,
    "bent": 0.0,
    "eccentric_c": 0.0,
    "eccentric_s": 0.0,
    "eccentric_2": 0.0,
    "pinion_c": 0.0,
    "pinion_s": 0.0,
    "stripe_c": 0.0,
    "stripe_s": 0.0,
    "leak": 0.0,
    "leak_slope": 0.0,
}
PLAIN: dict[str, float] = {
    **{f"power_{band}": 1.0 for band in range(3)},
    # lamp: linear polarization; relative per minute; relative at the end of a warm-up; a step at half time
    **dict.fromkeys(("lamp_q", "lamp_u", "drift", "warm_up", "lamp_step"), 0.0),
    **{f"{film}_{name}": value for film in FILMS for name, value in FILM.items()},
    # sample: deg at 540 nm along 0 and 45 deg; Cauchy's; deg from face to face; haze; half of the logarithm of
    # the transmittance along over that across an axis, at 0 and at 45 deg
    **dict.fromkeys(("plate_0", "plate_45", "dispersion", "twist", "haze", "dichroic_q", "dichroic_u"), 0.0),
    # detector: its own polarization, in all light and the more the brighter it is; how much a reading tires it
    **dict.fromkeys(("detector_q", "detector_u", "detector_bright_q", "detector_bright_u", "fatigue"), 0.0),
    # light past the films, plain and polarized; exponent less 1; bends; DN
    **dict.fromkeys(("stray", "stray_q", "stray_u"), 0.0),
    # what each channel has of each other one
    **dict.fromkeys(("gamma", "gamma_shadows", "bend", "knee", "dark", "dark_growth", "range_step", "crosstalk"), 0.0),
    # of photographs: fall-off by cos^4v of the angle to the axis, and a gain of each
    "vignetting": 0.0,
    # of a panel: level and polarization of each region; of pixels: gains that go with their analysers' angles
    **{f"region_{k}_{what}": float(what == "level") for k in range(REGIONS) for what in ("level", "q", "u")},
    **dict.fromkeys(("site_q", "site_u", "site_d"), 0.0),
    **{f"gain_{frame}": 1.0 for frame in range(MOST_FRAMES)},
}


def reading(bench: Bench, settings: Settings, bands: Sequence[float] = (GREEN,), full: float = 1.0) -> np.ndarray:
    """Mean reading (n, C) of n settings in C bands (nm), `full` per unit of light, without noise.

    Raises KeyError for a number that no bench has."""
    if unknown := set(bench) - set(PLAIN):
        raise KeyError(f"no number {', '.join(sorted(unknown))} of a bench; there are {', '.join(PLAIN)}")
    b = {**PLAIN, **bench}
    count = len(next(iter(settings.values())))
    wavelengths = np.array(bands, float)
    light = _lamp(b, settings, count, len(bands))
    for film in FILMS:
        if film == "middle":
            light = _sample(b, light, settings, wavelengths)
        default = 0.0 if film == "middle" else 1.0
        inside = _column(settings, f"{film}.inserted", count, default)[:, None, None]
        light = inside * _film(b, film, light, settings, wavelengths) + (1 - inside) * light
    brightness = light[..., 0] / max(float(light[..., 0].max()), 1e-9)
    signal = light[..., 0]
    for stokes, end in ((light[..., 1], "q"), (light[..., 2], "u")):
        signal = signal + (b[f"detector_{end}"] + b[f"detector_bright_{end}"] * brightness) * stokes
    # light of the room, some of it through the analyser as through a window
    axis = np.radians(2 * axis_of(b, "analyzer", settings, count))[:, None]
    signal = signal + b["stray"] + b["stray_q"] * np.cos(axis) + b["stray_u"] * np.sin(axis)
    exposure = _column(settings, "camera.exposure", count, 1.0)
    if "frame" in settings:
        gains = np.array([b[f"gain_{frame}"] for frame in range(MOST_FRAMES)])
        tangent = settings["ray.x"] ** 2 + settings["ray.y"] ** 2
        psi = np.radians(2 * _column(settings, "analyzer.angle", count))
        exposure = exposure * (
            1 + b["site_q"] * np.cos(psi) + b["site_u"] * np.sin(psi) + b["site_d"] * np.cos(2 * psi)
        )
        exposure = exposure * gains[settings["frame"].astype(int)] * (1 + tangent) ** (-2 * b["vignetting"])
    return _meter(b, signal * exposure[:, None], settings, count, full)


def _column(settings: Settings, key: str, count: int, default: float = 0.0) -> np.ndarray:
    return np.broadcast_to(np.asarray(settings.get(key, default), float), (count,))


def _lamp(b: Bench, settings: Settings, count: int, channels: int) -> np.ndarray:
    time = _column(settings, "source.time", count)
    whole = max(float(np.ptp(time)), 1e-9)
    since = (time - time.min()) / whole
    level = 1 + b["drift"] * time + b["warm_up"] * (1 - np.exp(-5 * since)) + b["lamp_step"] * (since > 0.5)
    level = level * _column(settings, "source.power", count, 1.0)
    power = np.array([b[f"power_{band}"] for band in range(channels)])
    if "region" in settings:
        seen = settings["region"].astype(int)
        share, q, u = (
            np.array([b[f"region_{k}_{what}"] for k in range(REGIONS)])[seen] for what in ("level", "q", "u")
        )
        stokes = np.stack([np.ones(count), q, u, np.zeros(count)], -1)
        return ((level * share)[:, None] * power)[..., None] * stokes[:, None]
    return (level[:, None] * power)[..., None] * np.array([1.0, b["lamp_q"], b["lamp_u"], 0.0])


def axis_of(b: Bench, film: str, settings: Settings, count: int) -> np.ndarray:
    """(n,) deg of a film's axis where its dial stands."""
    dial, way = _column(settings, f"{film}.angle", count), _column(settings, f"{film}.approach", count)
    back = np.flatnonzero(np.diff(way, prepend=np.nan) != 0)  # readings before which it turned back
    since = np.abs(dial - dial[back[np.searchsorted(back, np.arange(count), side="right") - 1]])
    psi = np.radians(dial)
    return (
        b[f"{film}_scale"] * dial
        + b[f"{film}_zero"]
        + b[f"{film}_slack"] * way / 2
        + b[f"{film}_lag"] * way * (np.minimum(since / 20, 1) - 0.5)  # taken up over 20 degrees
        + b[f"{film}_bent"] * dial * np.abs(dial) / 360  # a ratio that grows along the turn
        + b[f"{film}_eccentric_c"] * np.cos(psi)
        + b[f"{film}_eccentric_s"] * np.sin(psi)
        + b[f"{film}_eccentric_2"] * np.sin(2 * psi)
        + b[f"{film}_pinion_c"] * np.cos(TEETH * psi)
        + b[f"{film}_pinion_s"] * np.sin(TEETH * psi)
    )


def _turned(light: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Against axes that are turned by `angle` (n,), deg."""
    c, s = (f(np.radians(2 * angle))[:, None] for f in (np.cos, np.sin))
    i, q, u, v = np.moveaxis(light, -1, 0)
    return np.stack([i, c * q + s * u, c * u - s * q, v], -1)


def _across(axis: np.ndarray, settings: Settings) -> np.ndarray:
    """(n,) deg of the axis of the light that passes, across its ray: perpendicular to the ray and to the absorbing
    axis, counted from the image's right."""
    if "ray.x" not in settings:
        return axis
    ray = np.stack([-settings["ray.x"], -settings["ray.y"], np.ones(len(axis))], -1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    a = np.radians(axis)
    absorbing = np.stack([-np.sin(a), np.cos(a), np.zeros(len(a))], -1)
    passing = np.cross(absorbing, ray)
    right = np.array([1.0, 0, 0]) - ray[:, :1] * ray
    up = np.cross(ray, right)
    x, y = ((passing * e).sum(-1) / np.linalg.norm(e, axis=-1) for e in (right, up))
    return np.degrees(np.arctan2(y, x))


def _film(b: Bench, film: str, light: np.ndarray, settings: Settings, wavelengths: np.ndarray) -> np.ndarray:
    count = len(light)
    axis = _across(axis_of(b, film, settings, count), settings)
    psi = np.radians(_column(settings, f"{film}.angle", count))
    t2 = np.maximum(b[f"{film}_leak"] + b[f"{film}_leak_slope"] * (wavelengths - GREEN) / 100, 0.0)
    mean, half, across = (T1 + t2) / 2, (T1 - t2) / 2, np.sqrt(T1 * t2)
    i, q, u, v = np.moveaxis(_turned(light, axis), -1, 0)
    out = np.stack([mean * i + half * q, half * i + mean * q, across * u, across * v], -1)
    once, twice = b[f"{film}_wobble_c"] * np.cos(psi) + b[f"{film}_wobble_s"] * np.sin(psi), np.cos(2 * psi)
    passed = (1 + once + b[f"{film}_wobble_2"] * twice) * _striped(b, film, psi)
    return _turned(out, -axis) * passed[:, None, None]


def _striped(b: Bench, film: str, psi: np.ndarray) -> np.ndarray:
    """(n,) share that a stripe in a film leaves at dial angles psi (rad): it passes the beam once per turn."""
    stripe = complex(b[f"{film}_stripe_c"], b[f"{film}_stripe_s"])
    off = np.degrees(np.angle(np.exp(1j * (psi - np.angle(stripe)))))
    return 1 - abs(stripe) * np.exp(-0.5 * (off / STRIPE) ** 2)


def _sample(b: Bench, light: np.ndarray, settings: Settings, wavelengths: np.ndarray) -> np.ndarray:
    there = settings.get("sample.there")
    if there is not None:
        return np.where(
            there[:, None, None] > 0,
            _sample(b, light, {k: v for k, v in settings.items() if k != "sample.there"}, wavelengths),
            light,
        )
    turn = _column(settings, "sample.angle", len(light))
    light = light * np.array([1.0, *[1 - b["haze"]] * 3])
    if b["dichroic_q"] or b["dichroic_u"]:
        i, q, u, v = np.moveaxis(_turned(light, turn), -1, 0)
        x = np.hypot(b["dichroic_q"], b["dichroic_u"])  # half of the logarithm of the ratio of the transmittances
        d, n, m = np.tanh(x), b["dichroic_q"] / x, b["dichroic_u"] / x
        along = q * n + u * m
        across = np.sqrt(1 - d * d)
        q, u, v = (
            d * n * i + across * q + (1 - across) * n * along,
            d * m * i + across * u + (1 - across) * m * along,
            (across * v),
        )
        light = _turned(np.stack([i + d * along, q, u, v], -1), -turn)
    ratio = GREEN / wavelengths
    phase = np.hypot(b["plate_0"], b["plate_45"]) * ratio * (1 + b["dispersion"] * (ratio**2 - 1))
    fast = np.degrees(np.arctan2(b["plate_45"], b["plate_0"])) / 2 + turn
    layers = TWISTED if b["twist"] else 1
    if phase.any():
        for k in range(layers):
            angle = fast + b["twist"] * ((k + 0.5) / layers - 0.5)
            c, s = np.cos(np.radians(phase / layers)), np.sin(np.radians(phase / layers))
            i, q, u, v = np.moveaxis(_turned(light, angle), -1, 0)
            light = _turned(np.stack([i, q, c * u + s * v, c * v - s * u], -1), -angle)
    return light


def _meter(b: Bench, signal: np.ndarray, settings: Settings, count: int, full: float) -> np.ndarray:
    m = np.maximum(signal, 0.0)
    m = m * (1 - b["fatigue"] * _tired(m)) if b["fatigue"] else m
    m = m + b["crosstalk"] * (m.sum(1, keepdims=True) - m.shape[1] * m)
    m = m ** (1 + b["gamma"] + b["gamma_shadows"] * (1.4 - 0.8 * m)) if b["gamma"] or b["gamma_shadows"] else m
    m = m + b["bend"] * m * (1 - m)
    m = m - 2 * b["knee"] * np.maximum(m - 0.5, 0.0) ** 2  # linear to half of the range
    m = m * (1 + b["range_step"] * (m > 0.3 * m.max(initial=1e-9)))
    time = _column(settings, "source.time", count)
    growth = 1 - np.exp(-5 * (time - time.min()) / max(float(np.ptp(time)), 1e-9))
    return full * m + b["dark"] + (b["dark_growth"] * growth)[:, None]


def _tired(m: np.ndarray) -> np.ndarray:
    """(n, C) how tired a detector is before each reading: the light of those before it, the latest most; 1 after
    many of 1."""
    found = np.zeros_like(m)
    for i in range(1, len(m)):
        found[i] = KEPT * found[i - 1] + (1 - KEPT) * m[i - 1]
    return found
