"""Light over the wavelength by plain sums in steps of 1 nm: lamps, colour sensors, and what hides in them.

    signal_c = exposure sum over nm of  S(nm) Q_c(nm) P(nm) / N

with the spectrum S of a lamp (its sum over all wavelengths is its power), the sensitivity Q of a channel, read in the
colour-science library's own table, and what the way P leaves; N is the largest sum of S Q over lamps and channels as
they are drawn. It shares nothing with `optics.scene.integral` and `optics.spectra`: no curve of theirs, no quadrature,
no effect's function. What is hidden acts on lines, which are formulas here, on sensitivities, or on the way.

Another law has the same cause and size as the library's, but another form, as in OTHER."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

NM = np.arange(380.0, 781.0)  # what the sensor sees
RANGES = ((580.0, np.inf), (500.0, 580.0), (0.0, 500.0))  # of red, green and blue reflectances
MIDDLES = (620.0, 540.0, 460.0)  # where these are given
DIE, DIE_WIDTH = 450.0, 20.0  # nm: of what a phosphor lets through

# effect -> how the other law differs from that of the library
OTHER = {
    "LED centre shift": "1.5 of it for LEDs of phosphides (beyond 560 nm), a half for those of nitrides, as by heat",
    "LED width": "towards the red alone, twice as much: the high-energy side keeps its slope",
    "phosphor leak": "the die stands at 445 nm and is 25 nm wide",
    "sensitivity tail": "half of it at the blue end, one and a half at the red end, as silicon responds",
    "metameric paint": "bent: less steep to the blue, m x (1 + 0.5 x/20 nm)",
    "gel yellowing": "the tail falls over 45 nm, for 60",
    "chromatic focus": "in focus is 525 nm, for 540",
    "lateral colour": "bent, as of an achromat: m x (1 - 0.3 x), x in 100 nm",
    "filter edge shift": "the edge is 14 nm soft, for 10",
    "dispersive retardance": "with the fourth power of 540/nm, less a linear part: 0.6 of (540/nm)^4 - 1",
}


@dataclass(frozen=True)
class Line:
    """A line of a lamp: peak and full width at half maximum in nm, and its share of the lamp's power."""

    peak: float
    width: float
    share: float = 1.0


Lamp = Sequence[Line]  # a coloured LED is one line, a white one its die and its phosphor


def gaussian(nm: np.ndarray, peak: float, low: float, high: float) -> np.ndarray:
    """Of area 1, with half widths at half maximum low and high, nm."""
    x = nm - peak
    form = np.exp(-np.log(2) * np.where(x < 0, x / low, x / high) ** 2)
    return form / (np.sqrt(np.pi / np.log(2)) * (low + high) / 2)


def spectrum(lamp: Lamp, hidden: Mapping[str, float], other: bool = False, nm: np.ndarray = NM) -> np.ndarray:
    """Power of a lamp per nm, with what is hidden in it; the power of all its wavelengths is 1."""
    total = sum(line.share for line in lamp)
    middle = sum(line.share * line.peak for line in lamp) / total
    shift, growth = hidden.get("LED centre shift", 0.0), hidden.get("LED width", 0.0)
    if other:
        shift = shift * (1.5 if middle > 560 else 0.5)
    power = np.zeros(len(nm))
    for line in lamp:
        wide = 1 + growth
        peak = middle + (line.peak - middle) * wide + shift
        low, high = line.width / 2 * wide, line.width / 2 * wide
        if other:
            peak, low, high = line.peak + shift, line.width / 2, line.width / 2 * (1 + 2 * growth)
        power += line.share / total * gaussian(nm, peak, low, high)
    leak = hidden.get("phosphor leak", 0.0)
    die, width = (445.0, 25.0) if other else (DIE, DIE_WIDTH)
    return (1 - leak) * power + leak * gaussian(nm, die, width / 2, width / 2)


@lru_cache(maxsize=4)
def _table(camera: str) -> np.ndarray:
    import colour

    data = colour.MSDS_CAMERA_SENSITIVITIES[camera]
    return np.array([np.interp(NM, data.wavelengths, row, left=0.0, right=0.0) for row in np.asarray(data.values).T])


def sensitivities(camera: str, hidden: Mapping[str, float] | None = None, other: bool = False) -> np.ndarray:
    """(3, N) of the channels of a camera of the colour-science library, with a tail that is hidden."""
    quantum = _table(camera)
    tail = (hidden or {}).get("sensitivity tail", 0.0) * np.ones(len(NM))
    if other:
        tail = tail * (0.5 + (NM - NM[0]) / np.ptp(NM))
    return quantum + tail * (quantum.max() - quantum)


def reflectance(rho: Sequence[float], hidden: Mapping[str, float], other: bool = False) -> np.ndarray:
    """(N,) of a paint with the reflectances rho in the ranges of red, green and blue; on a border their mean, which is
    what a sum over a step needs."""
    found = np.zeros(len(NM))
    for (low, high), middle, own in zip(RANGES, MIDDLES, rho):
        x = (NM - middle) / 100
        bent = x * (1 + 0.5 * x / 0.2) if other else x
        share = ((low <= NM) & (high > NM)) / 2 + ((low < NM) & (high >= NM)) / 2
        found += share * own * np.exp(hidden.get("metameric paint", 0.0) * bent)
    return found


def unit(lamps: Sequence[Lamp], camera: str) -> float:
    """N: the largest of all sums of S Q, of lamps as they are drawn."""
    quantum = sensitivities(camera)
    return max(float((quantum @ spectrum(lamp, {})).max()) for lamp in lamps)


# -- a touch sensor ---------------------------------------------------------------------------------------------------
BENT_BY_LENS = ("lateral colour", "chromatic focus")  # what moves light from pixel to pixel
FINE = 4  # samples of a pixel each way, on which these act: what a pixel has is the mean of what falls on it
AROUND = 3  # pixels around the image, from which these bring light into it


def through_lens(
    grey: np.ndarray, weights: np.ndarray, field: np.ndarray, hidden: Mapping[str, float], other: bool
) -> np.ndarray:
    """(H, W, C) image of what looks alike at all wavelengths, grey (H, W), through a lens that does not; of what moves
    light (BENT_BY_LENS) grey is (FINE (H + 2 AROUND), FINE (W + 2 AROUND)). The axis meets the middle of the image.

    weights  (C, N) what each wavelength counts in each channel;   field  (H, W) tangent of the field angle

    Wavelengths go through the lens in slabs of 4 nm.
    """
    from scipy.ndimage import gaussian_filter, map_coordinates

    moved = bool(set(BENT_BY_LENS) & set(hidden))
    height, width = grey.shape
    y, x = np.mgrid[:height, :width] + 0.5
    found = np.zeros((*field.shape, len(weights)))
    for start in range(0, len(NM), 4):
        own = slice(start, start + 4)
        counts, nm = weights[:, own].sum(1), float(NM[own].mean())
        if not counts.any():
            continue
        image = grey
        if "lateral colour" in hidden:
            away = (nm - 540) / 100
            growth = 1 + hidden["lateral colour"] * away * ((1 - 0.3 * away) if other else 1)
            at = [(y - height / 2) / growth + height / 2 - 0.5, (x - width / 2) / growth + width / 2 - 0.5]
            image = map_coordinates(image, at, order=3, mode="nearest")
        if "chromatic focus" in hidden:
            sd = FINE * np.sqrt(hidden["chromatic focus"]) * abs(nm - (525.0 if other else 540.0)) / 100
            image = gaussian_filter(image, sd, mode="reflect", truncate=6) if sd > 0.05 else image
        if moved:
            image = image.reshape(height // FINE, FINE, width // FINE, FINE).mean((1, 3))
            image = image[AROUND:-AROUND, AROUND:-AROUND]
        if "filter edge shift" in hidden:
            soft = 14.0 if other else 10.0
            seen = NM[own] / np.sqrt(1 - hidden["filter edge shift"] * (field**2 / (1 + field**2))[..., None])
            kept = (1 + np.exp((NM[own] - 650.0) / soft)) / (1 + np.exp((seen - 650.0) / soft))
            found += image[..., None] * (kept @ weights[:, own].T)
        else:
            found += image[..., None] * counts
    return found


def tail_of_yellow(other: bool = False) -> np.ndarray:
    """(N,) absorption of a gel that turned yellow, over that at 440 nm."""
    return np.exp((440.0 - NM) / (45.0 if other else 60.0))


# -- a colour bench ---------------------------------------------------------------------------------------------------
def plate_phase(retardance: float, dispersion: float, other: bool = False, nm: np.ndarray = NM) -> np.ndarray:
    """(N,) rad: phase of a wave plate of a retardance in deg at 540 nm."""
    ratio = 540.0 / nm
    bent = 0.6 * (ratio**4 - 1) if other else ratio**2 - 1
    return np.radians(retardance * ratio * (1 + dispersion * bent))


def between_polarizers(first, plate, second, phase: np.ndarray, transmittance: float = 0.8) -> np.ndarray:
    """(n, N) share of unpolarized light that passes a polarizer, a wave plate and a polarizer.

    first, plate, second  (n,) deg: of their axes, counterclockwise;   phase  (N,) rad of the plate

    By amplitudes: of the field along the first axis, the parts along the plate's axes, one of them late by the phase,
    seen along the second axis (Born & Wolf, 15.4.3, eq. 4).
    """
    chi, psi = (np.radians(np.subtract(b, a)) for a, b in ((plate, first), (plate, second)))
    along, across = np.cos(chi) * np.cos(psi), np.sin(chi) * np.sin(psi)
    share = along**2 + across**2
    return transmittance**2 / 2 * (share[:, None] + 2 * (along * across)[:, None] * np.cos(phase))


def on_card(place: Sequence[float], card: float = 100.0, seen: float = 2.618, lobe: float = 1.2) -> float:
    """Radiance of a white matt card of reflectance 1 by an LED of power 1, mean over the square of half side `seen`
    that a sensor sees, mm; the LED looks at the card's middle."""
    x, w = np.polynomial.legendre.leggauss(8)
    u, v = np.meshgrid(seen * x, seen * x)
    way = np.stack([u, v, np.full(u.shape, card)], -1) - place
    axis = np.array([0.0, 0.0, card]) - place
    distance = np.linalg.norm(way, axis=-1)
    cos_lamp = way @ (axis / np.linalg.norm(axis)) / distance
    lit = cos_lamp**lobe * (way[..., 2] / distance) / distance**2 / np.pi
    return float((np.outer(w, w) * lit).sum() / 4)
