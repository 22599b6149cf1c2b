"""What others publish of methods that name missing physics, beside rates: measures of one cell, for its record.

    bias        mean of |found - built| / plausible size over what the base calibrates, without the missing effect and
                with it; parameters of which the data leave more than LOOSE plausible sizes open are left out: what a
                gauge fixes is neither right nor wrong
    localised   parts of the image (the cells of the coordinate 'place') in which a kind that the library lacks acts,
                and parts in which the residual's curve differs from none (Benjamini & Hochberg, 5 %)

With rates of `optics.proof.count` these are the four measures of LISDD (arXiv 2606.23215), there of ordinary
differential equations whose missing term acts in one regime of operation: form recovery, parameter bias, localisation
F1, false discovery rate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from optics.diagnosis.fingerprints import SIDE
from optics.diagnosis.result import Diagnosis
from optics.fit.result import Fit
from optics.proof.cells import Cell

LOOSE = 0.5  # plausible sizes: a standard deviation beyond says that data do not hold a parameter
FOUND = 0.05  # false discovery rate of parts
ACTS = 0.1  # of where a kind acts most: a part in which it acts less is not counted as its place


def bias(built: dict[str, float], base: Fit, with_effect: Fit | None) -> list[float]:
    """[without the effect, with it, what noise alone would make of either]; [] where nothing can be compared.

    built    key -> true value; variables with a value per frame are left out"""
    sd = {v.name: float(s) for v, s in zip(base.variables, base.sd)}
    wanted = [
        v
        for v in base.variables
        if v.frames is None and v.keys[0] in built and sd[v.name] < LOOSE * v.parameter.plausible
    ]
    if not wanted or with_effect is None:
        return []

    def off(found: Fit) -> float:
        at = {v.name: float(e) for v, e in zip(found.variables, found.estimate)}
        return float(np.mean([abs(at[v.name] - built[v.keys[0]]) / v.parameter.plausible for v in wanted]))

    noise = np.sqrt(2 / np.pi) * float(np.mean([sd[v.name] / v.parameter.plausible for v in wanted]))
    return [off(base), off(with_effect), noise]


def first_fit(d: Diagnosis, cell: Cell) -> Fit | None:
    """The refit with the one effect that is hidden, whether it was claimed or not; None without it."""
    return d.fits.get(cell.hidden[0]) if cell.kind == "library" and len(cell.hidden) == 1 else None


def parts_of(gain: np.ndarray) -> list[int]:
    """Numbers of the parts in which a gain (H, W), 0 where it does nothing, acts."""
    height, width = gain.shape
    row, column = np.mgrid[:height, :width]
    part = row * SIDE // height * SIDE + column * SIDE // width
    mean = np.bincount(part.ravel(), np.abs(gain).ravel()) / np.bincount(part.ravel())
    return np.flatnonzero(mean > ACTS * mean.max()).tolist()


def flagged(d: Diagnosis) -> list[int] | None:
    """Numbers of the parts whose residual differs from none; None where the diagnosis has no map."""
    from scipy.stats import norm

    place = next((f for f in d.fingerprints if f.coordinate == "place"), None)
    if place is None:
        return None
    sd = np.array(place.sd, float)
    known = np.isfinite(sd) & (sd > 0)
    p = np.ones(len(sd))
    p[known] = 2 * norm.sf(np.abs(np.array(place.curve, float)[known] / sd[known]))
    return [int(round(place.centres[i])) if place.centres else int(i) for i in _discoveries(p)]


def _discoveries(p: np.ndarray) -> np.ndarray:
    """Places of what Benjamini & Hochberg's procedure finds."""
    order = np.argsort(p)
    below = np.flatnonzero(p[order] <= FOUND * (np.arange(len(p)) + 1) / len(p))
    return order[: below[-1] + 1] if len(below) else order[:0]


def f1(true: Sequence[int], found: Sequence[int]) -> float:
    """2 TP/(2 TP + FP + FN)."""
    both = len({*true} & {*found})
    return 2 * both / max(len({*true}) + len({*found}), 1)


def false_share(named: Sequence[str], true: Sequence[str]) -> float:
    """Of the effects that were named, the share that is not there; 0 where none was named."""
    return len({*named} - {*true}) / max(len({*named}), 1)
