"""Patterns of the image: what is left alike in the same pixels of many frames, wherever the sensor is pressed.

A pattern that is the same in all frames is dirt, a scratch or the sensor's own. One that successive frames share and
distant ones do not is a sensor that changes during the session: a coating that wrinkles, a gel that creeps, a window
that mists over. Neither is an effect on light that presses would show, and both may pass for a curve along what
happened to differ between frames.

What differs from contact to contact, alike under every light, is the coating or the body there, and no law of light
explains it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from optics.captures.capture_set import group_of
from optics.diagnosis import statistics as st
from optics.diagnosis.evidence import Evidence
from optics.diagnosis.result import Drift, Surface
from optics.diagnosis.thresholds import EXCESS, LEVEL, SHARE
from optics.fit.compare import led_label
from optics.fit.model import Model, value_of
from optics.scene.parameter import Values
from optics.words import percent

NEARLY_ALL = 0.8  # share of the excess: what is fixed in the image is fixed, whatever curve comes near it
MORE = 0.1  # share of the excess, by which further gains must explain more to be the pattern's own
REPEATED = 3  # frames that show a pixel, for a pattern to be called fixed
SEVERAL = 6  # frames, from which their order can be told from chance: 720 orders
MANY = 12  # contacts, over which a law is told from what is each contact's own
LIGHTS = 3  # of a press, under which a pixel is seen
HALF = 0.5  # of the excess, from which the light that changes is named
CELLS = 6  # each way, in which a contact is divided
MUCH = 0.25  # of what is left, from which it is said
DISTANT = 1 / 3  # of the session: frames that are so far apart share what does not change
AWAY = 2.0  # radii of the contact beyond which a press is not asked about
ORDERS = 1999  # in which chance could have put the frames


def fixed_pattern(
    model: Model, evidence: Evidence, excess: float, by_channel: bool = False, by_light: bool = False
) -> float:
    """Share of the excess misfit that one gain for each pixel, the same in all frames, explains: dirt, scratches, the
    sensor's own pattern.

    Of pixels that REPEATED frames or more show, less what noise explains: the number of gains times chi2 per degree of
    freedom of what they leave, as in an analysis of variance. Noise that is stated too small has no pattern. NaN where
    there are no such pixels, no excess, or readings of a table.
    excess       chi2 less its degrees of freedom
    by_channel   a gain of its own in each channel;   by_light: under each light too, NaN where there is one light, or
                 where pixels are thinned by frames, so that one under one light is not the same under another
    """
    if isinstance(evidence.spectrum, st.Sweeps):
        return math.nan
    black = float(model.noise.black_level)
    share = 1 if by_channel else evidence.channels  # of a pixel's values, those with one gain
    pixels = max((int(b.index.max(initial=0)) for b in evidence.blocks), default=0) // share + 1
    lights = {""}
    if by_light:
        lights = {led_label(model.frames[f].parameters) for f in evidence.frames}
        if len(lights) < 2 or evidence.thinning > 1:
            return math.nan
    order = {label: n for n, label in enumerate(sorted(lights))}
    size = pixels * len(order)
    shown, along, length, square, count = (np.zeros(size) for _ in range(5))
    for block in evidence.blocks:
        label = led_label(model.frames[block.frame].parameters) if by_light else ""
        place = block.index // share + pixels * order[label]
        g = (block.prediction - black) / block.sigma
        shown += np.bincount(np.unique(place), minlength=size)
        along += np.bincount(place, g * block.r, size)
        length += np.bincount(place, g * g, size)
        square += np.bincount(place, block.r**2, size)
        count += np.bincount(place, minlength=size)
    use = (shown >= REPEATED) & (length > 0)
    if not use.any() or not excess > 0:
        return math.nan
    by_gains, gains = float(np.sum(along[use] ** 2 / length[use])), int(use.sum())
    return _beyond_noise(by_gains, gains, float(square[use].sum()), int(count[use].sum())) * evidence.thinning / excess


def _beyond_noise(explained: float, numbers: int, square: float, count: int) -> float:
    """What so many numbers explain of `count` values whose squares sum to `square`, less what they explain of noise:
    as an analysis of variance has it, by what they leave, so that noise which is stated too small is no pattern."""
    left = (square - explained) / max(count - numbers, 1)
    return explained - numbers * max(left, 1.0)


def swinging_light(model: Model, evidence: Evidence, excess: float) -> tuple[str, float, float]:
    """(light, share of the excess misfit that its power explains when it is free in each frame, rms of the relative
    change) of the light of which that explains most, and another light less than half as much; ('', NaN, NaN) for none.

    By the images of powers that are calibrated, less what noise explains, as in `fixed_pattern`; REPEATED lit frames
    or more.
    excess   chi2 less its degrees of freedom
    """
    lights: dict[str, list[int]] = {}
    for i in evidence.base:
        v = evidence.columns[i]
        if v.parameter.role in ("power", "band power") and v.frames is None and len(v.keys) == 1:
            lights.setdefault(v.keys[0].rpartition(".")[0], []).append(i)
    if len(lights) < 2 or isinstance(evidence.spectrum, st.Sweeps) or not excess > 0:
        return "", math.nan, math.nan
    found = []
    for light, columns in lights.items():
        powers = np.array([value_of(model, evidence.values, evidence.columns[i]) for i in columns])
        change, along, square, count = [], 0.0, 0.0, 0
        for block in evidence.blocks:
            image = block.columns(columns) @ powers
            length = float(image @ image)
            if length > 0:
                change.append(float(image @ block.r) / length)
                along += change[-1] ** 2 * length
                square, count = square + float(block.r @ block.r), count + len(block.r)
        if len(change) >= REPEATED:
            share = _beyond_noise(along, len(change), square, count) * evidence.thinning / excess
            found.append((share, light, math.sqrt(float(np.mean(np.square(change))))))
    found.sort(reverse=True)
    if len(found) < 2 or found[0][0] < HALF or found[1][0] > found[0][0] / 2:
        return "", math.nan, math.nan
    share, light, swing = found[0]
    return light, share, swing


def swinging_text(light: str, share: float, swing: float) -> str:
    """One sentence on that light; '' for none."""
    if not light:
        return ""
    return (
        f"the power of {light} alone, free in each frame, explains {min(share, 1.0):.0%} of the excess: this light "
        f"changed from frame to frame by {percent(swing, 2)} (rms)."
    )


def fixed_text(share: float, best: float, by_channel: float = math.nan, by_light: float = math.nan) -> str:
    """One sentence where a fixed pattern explains nearly all, a quarter more than the best curve does, or twice as much
    as that; '' where not.

    by_channel, by_light   shares by gains of each channel, and of each light too: what a light brings is no dirt"""

    def beyond(more: float, less: float) -> bool:
        return more > less + max((1 - min(less, 1.0)) / 2, MORE)

    most = np.nanmax([share, by_channel]) if not math.isnan(share) else share
    if not most > max(SHARE, min(2 * best, max(NEARLY_ALL, 1.25 * best))):
        return ""
    if beyond(by_light, most):
        return (
            f"one gain for each pixel under each light explains {min(by_light, 1.0):.0%} of the excess, one for all "
            f"lights {min(most, 1.0):.0%}: each light has a pattern of its own, such as a lobe of another shape."
        )
    if beyond(by_channel, share):
        return (
            f"one gain for each pixel in each channel, the same in every frame, explains {min(by_channel, 1.0):.0%} of "
            f"the excess, one for all channels {min(share, 1.0):.0%}: the sensor's own pattern, dirt of one colour, or "
            "the pattern of a light that one channel alone sees."
        )
    return (
        f"one gain for each pixel, the same in every frame, explains {min(most, 1.0):.0%} of the excess: dirt, "
        "a scratch or the sensor's own pattern is fixed in the image, whatever curve it resembles."
    )


def drifting_pattern(model: Model, values: Values, evidence: Evidence, excess: float, seed: int = 0) -> Drift:
    """What successive frames share, and distant ones do not, far from where they are pressed; see `Drift`.

    With residuals w of frames i and j in the pixels that both leave untouched, after each frame's own gain, and their
    covariance C of n values,

        share = (C of successive frames - C of those that are DISTANT) n / excess,   p of C of successive frames among
        those of ORDERS random orders of the session

    Successive are two frames of one light. NaN where there are fewer than SEVERAL frames, no contacts or no excess.
    excess   chi2 less its degrees of freedom
    """
    frames = evidence.frames
    if isinstance(evidence.spectrum, st.Sweeps) or len(frames) < SEVERAL or not excess > 0:
        return Drift()
    whitened, use = [], []
    for i, w, sigma, mask in zip(frames, evidence.whitened, evidence.sigma, evidence.use):
        where = model.coordinates(values, i)
        if not {"contact", "contact_distance"} <= set(where):
            return Drift()
        pressed, distance = np.asarray(where["contact"], bool), np.asarray(where["contact_distance"], float)
        radius = float(distance[pressed].max()) if pressed.any() else 0.0
        own = np.asarray(mask, bool) & (distance > AWAY * radius)[..., None]
        light = (np.asarray(model.frames[i].image, float) - float(model.noise.black_level)) / sigma
        light, rest = np.where(own, light, 0.0), np.where(own, w, 0.0).astype(float)
        gain = np.sum(light * rest, (0, 1)) / np.maximum(np.sum(light**2, (0, 1)), 1e-300)
        whitened.append((rest - gain * light).ravel())
        use.append(own.ravel().astype(np.float32))
    together, count = np.array(whitened) @ np.array(whitened).T, np.array(use) @ np.array(use).T
    lights = [led_label(model.frames[i].parameters) for i in frames]
    last: dict[str, int] = {}
    pairs: list[tuple[int, int]] = []
    for i, light in enumerate(lights):
        pairs += [(last[light], i)] if light in last else []
        last[light] = i
    apart = [(i, j) for i in range(len(frames)) for j in range(i) if i - j >= DISTANT * len(frames)]
    apart = [(i, j) for i, j in apart if lights[i] == lights[j]]
    if len(pairs) < SEVERAL - 1 or not apart:
        return Drift()

    def mean(found: np.ndarray) -> float:
        one, other = found.T
        return float(together[one, other].sum() / max(count[one, other].sum(), 1.0))

    near, far = np.array(pairs), mean(np.array(apart))
    found, rng = mean(near), np.random.default_rng([seed, 41])
    places = {light: np.flatnonzero([own == light for own in lights]) for light in last}
    chance = 0
    for _ in range(ORDERS):
        order = np.arange(len(frames))
        for place in places.values():
            order[place] = rng.permutation(place)
        chance += mean(order[near]) >= found
    share = (found - far) * float(np.trace(count)) / excess
    return Drift(float(share), (1 + chance) / (1 + ORDERS))


def drifting_text(drift: Drift) -> str:
    """One sentence where a pattern that drifts holds more than SHARE of the excess; '' where not."""
    if not (drift.p < LEVEL and drift.share > SHARE):
        return ""
    return (
        f"{min(drift.share, 1.0):.0%} of the excess lies far from the contacts, in a pattern that successive frames "
        "share and distant ones do not: the untouched sensor changes during the session."
    )


def by_surface(model: Model, values: Values, evidence: Evidence, images: Sequence[np.ndarray]) -> Surface:
    """What an explanation leaves in contacts that one brightness of each pixel of a press, the same under all its
    lights, would mend, and that follows no law of the sensor.

    With the residuals r of a pixel in all frames of a press and its whitened signal g there, b = g'r/g'g is what its
    brightness is off by, and noise alone gives it the variance 1/g'g. A law of light or of the camera goes with the
    place in the image or with the place in the contact: of b is taken the quadratic in the former and the mean over all
    contacts at the latter (CELLS each way) that fit best. What is left of it takes b^2 g'g from chi2, of which noise
    takes 1. The share is of the chi2 of these pixels less the number of their values. Of it one brightness of each
    contact has what the weighted mean there takes, less 1 a contact for noise. NaN where no press is seen under LIGHTS
    lights, for fewer than MANY contacts, or without excess. Of one press, pixels of the camera that differ look
    the same, unless a flat field has divided them out.

    images   per frame (H, W, C) residual over its noise, 0 where it is not used"""
    if isinstance(evidence.spectrum, st.Sweeps):
        return Surface()
    contacts = [c for own in presses_of(model, evidence) for c in _contacts_of(model, values, evidence, images, own)]
    if len(contacts) < MANY:
        return Surface()
    bright, weight, square, count, *places, cell = np.concatenate(contacts, 1)
    contact = np.repeat(np.arange(len(contacts)), [c.shape[1] for c in contacts])
    excess = float(square.sum() - count.sum())
    if excess < EXCESS * math.sqrt(2 * count.sum()):
        return Surface()
    laws = np.column_stack([*places, *(cell == c for c in np.unique(cell))]) * np.sqrt(weight)[:, None]
    law, _, rank, _ = np.linalg.lstsq(laws, bright * np.sqrt(weight), rcond=None)
    off = bright * np.sqrt(weight) - laws @ law  # in standard deviations
    taken = float(off @ off) - (len(off) - rank)
    spread = float(np.mean(off**2 / weight) - np.mean(1 / weight))
    sums, weights = np.bincount(contact, off * np.sqrt(weight)), np.bincount(contact, weight)
    whole = float(np.sum(sums**2 / weights)) - len(contacts)
    apart = float(np.mean((sums / weights) ** 2 - 1 / weights))
    return Surface(
        taken / excess,
        math.sqrt(max(spread, 0.0)),
        len(contacts),
        whole / taken if taken > 0 else math.nan,
        math.sqrt(max(apart, 0.0)),
    )


def presses_of(model: Model, evidence: Evidence) -> list[list[int]]:
    """Which of the evidence's frames each press has."""
    presses: dict[str, list[int]] = {}
    for k, i in enumerate(evidence.frames):
        presses.setdefault(group_of(model.frames[i]), []).append(k)
    return list(presses.values())


def _contacts_of(
    model: Model, values: Values, evidence: Evidence, images: Sequence[np.ndarray], own: Sequence[int]
) -> Iterator[np.ndarray]:
    """(10, n) of the pixels of each contact of a press: b, g'g, r'r, number of values; the terms of a quadratic in the
    place in the image; the number of the cell of the contact. own: which of the evidence's frames the press has."""
    from scipy.ndimage import label

    frames = [model.frames[evidence.frames[k]] for k in own]
    if len({led_label(f.parameters) for f in frames}) < LIGHTS:
        return
    where = model.coordinates(values, evidence.frames[own[0]])
    if "contact" not in where:
        return
    numbers, several = label(np.asarray(where["contact"], bool))
    along, length, square, count = np.zeros((4, *numbers.shape))
    for k, f in zip(own, frames):
        use = np.asarray(evidence.use[k], bool)
        r = np.where(use, images[k], 0.0).astype(float)
        light = np.asarray(f.image, float) - float(model.noise.black_level)
        g = np.where(use, light / evidence.sigma[k] - r, 0.0)  # of the prediction, without its noise
        for total, product in ((along, g * r), (length, g * g), (square, r * r), (count, use)):
            total += product.sum(-1)
    for n in range(1, several + 1):
        whole = np.array(np.nonzero(numbers == n), float)
        y, x = seen = np.nonzero((numbers == n) & (count >= LIGHTS) & (length > 0))
        middle, radius = whole.mean(1, keepdims=True), math.sqrt(whole.shape[1] / math.pi)
        down, right = np.clip((np.array(seen) - middle) / radius * CELLS / 2 + CELLS / 2, 0, CELLS - 1) // 1
        u, v = x / numbers.shape[1] - 0.5, y / numbers.shape[0] - 0.5
        if len(x):
            b, weight = along[seen] / length[seen], length[seen]
            yield np.stack([b, weight, square[seen], count[seen], u, v, u * u, u * v, v * v, CELLS * down + right])


def surface_text(found: Surface) -> str:
    """One sentence where the surface holds more than MUCH of what is left in contacts; '' where not."""
    if not found.share > MUCH:
        return ""
    text = (
        f"{min(found.share, 1.0):.0%} of what is left in the {found.contacts} contacts is one brightness of each "
        f"pixel, the same under every light ({found.rms:.1%} rms), and depends neither on the place in the image nor "
        "on that in the contact: it belongs to the coating, to the body that presses or, without a flat field, to the "
        "camera's pixels, and no law of light explains it."
    )
    if found.whole > SHARE:
        text += (
            f" {min(found.whole, 1.0):.0%} of that is one brightness of each contact ({found.whole_rms:.1%} rms): they "
            "differ in what the body reflects, or in how deep it presses."
        )
    return text
