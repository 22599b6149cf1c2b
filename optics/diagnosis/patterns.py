"""Patterns of the image: what is left alike in the same pixels of many frames, wherever the sensor is pressed.

A pattern that is the same in all frames is dirt, a scratch or the sensor's own. One that successive frames share and
distant ones do not is a sensor that changes during the session: a coating that wrinkles, a gel that creeps, a window
that mists over. Neither is an effect on light that presses would show, and both may pass for a curve along what
happened to differ between frames."""

from __future__ import annotations

import math

import numpy as np

from optics.diagnosis import statistics as st
from optics.diagnosis.evidence import Evidence
from optics.diagnosis.result import Drift
from optics.diagnosis.thresholds import LEVEL, SHARE
from optics.fit.compare import led_label
from optics.fit.model import Model
from optics.scene.parameter import Values

REPEATED = 3  # frames that show a pixel, for a pattern to be called fixed
SEVERAL = 6  # frames, from which their order can be told from chance: 720 orders
DISTANT = 1 / 3  # of the session: frames that are so far apart share what does not change
AWAY = 2.0  # radii of the contact beyond which a press is not asked about
ORDERS = 1999  # in which chance could have put the frames


def fixed_pattern(model: Model, evidence: Evidence, excess: float) -> float:
    """Share of the excess misfit that one gain for each pixel, the same in all frames, explains: dirt, scratches, the
    sensor's own pattern.

    Of pixels that REPEATED frames or more show, less the number of gains, which noise explains; NaN where there are no
    such pixels, no excess, or readings of a table.
    excess   chi2 less its degrees of freedom
    """
    if isinstance(evidence.spectrum, st.Sweeps):
        return math.nan
    black, size = (
        float(model.noise.black_level),
        max((int(b.index.max(initial=0)) for b in evidence.blocks), default=0) // evidence.channels + 1,
    )
    shown, along, length = np.zeros(size), np.zeros(size), np.zeros(size)
    for block in evidence.blocks:
        pixel, g = block.index // evidence.channels, (block.prediction - black) / block.sigma
        shown += np.bincount(np.unique(pixel), minlength=size)
        along += np.bincount(pixel, g * block.r, size)
        length += np.bincount(pixel, g * g, size)
    use = (shown >= REPEATED) & (length > 0)
    if not use.any() or not excess > 0:
        return math.nan
    return float(np.sum(along[use] ** 2 / length[use]) - use.sum()) * evidence.thinning / excess


def fixed_text(share: float, best: float) -> str:
    """One sentence where a fixed pattern explains much more than the best curve does; '' where not."""
    if not share > max(SHARE, 2 * best):
        return ""
    return (
        f"one gain for each pixel, the same in every frame, explains {min(share, 1.0):.0%} of the excess: dirt, "
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
