"""How far dials stop from what is written down, where films stand crossed in every image.

By what is written down such images are dark, and what light they have, I = P sin^2(d), is the square of what two dials
are off: it has no slope at the settings, on which `optics.diagnosis.dials` rests. Instead the angles of each image are
calibrated with a width that is assumed, and the width follows from where they end: of a component u of an image's
angles (deg from the settings) that it tells to 1/sqrt(l)

    -2 ln L(w) = sum over components of  ln(1 + w^2 l) + u^2 l / (1 + w^2 l)

with the prior of `optics.diagnosis.dials`. A few turns of that end where the width that is found is the one assumed."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from optics.diagnosis.dials import BY_EYE, WIDTHS, Profile, Width, most_likely, unlikely
from optics.fit.branches import own_angles
from optics.fit.result import Fit
from optics.fit.scene_model import SceneModel
from optics.scene.parameter import Values

TURNS = 4  # calibrations
SAME = 0.1  # of a width: a change that is smaller is none


def at_extinction(model: SceneModel, values: Values, keys: Sequence[str], frames: Sequence[int]) -> bool:
    """Whether turns of some dials by BY_EYE change most images alike to both sides."""
    even, count = 0, 0
    middles = model.predict(values, frames)
    for key in keys:
        turned = []
        for by in (-BY_EYE, BY_EYE):
            moved = values.copy()
            for f in frames:
                moved.frame.setdefault(f, {})[key] = float(model.at(values, f)[key]) + by
            turned.append(model.predict(moved, frames))
        for f, low, middle, high in zip(frames, turned[0], middles, turned[1]):
            use = np.asarray(model.usable(f), bool)
            alike, apart = ((low + high) / 2 - middle)[use], ((high - low) / 2)[use]
            even, count = even + bool(np.sum(alike**2) > np.sum(apart**2)), count + 1
    return 2 * even > count


def width_of_angles(calibrated: Callable[[float], Fit]) -> Width | None:
    """The width that the angles of images have; None where they show none.

    calibrated   the base with an angle for each image, by the width that is assumed"""
    assumed, found = BY_EYE, None
    for _ in range(TURNS):
        found = width_in(calibrated(assumed))
        if found is None or abs(found.sd - assumed) < SAME * assumed:
            break
        assumed = found.sd
    return found


def width_in(fit: Fit) -> Width | None:
    """The width by the angles of one calibration."""
    assert fit.normal is not None
    u, told = [], []
    for places in own_angles(fit).values():
        variables = [fit.variables[i] for i in places]
        priors = np.array([v.precision for v in variables])
        information, turn = np.linalg.eigh(fit.normal.a[np.ix_(places, places)] - np.diag(priors))
        middles = np.array([v.prior[0] for v in variables if v.prior is not None])
        off = turn.T @ (np.array([fit.estimate[i] for i in places]) - middles)
        seen = information > priors.max()  # the rest stands where the prior has put it
        u += list(off[seen] * (1 + priors.max() / information[seen]))  # without the prior's pull
        told += list(information[seen])
    square, each = np.square(u), np.asarray(told)
    if not len(each):
        return None
    ratios = 1 + WIDTHS[:, None] ** 2 * each
    likelihood = -(np.log(ratios) + square * each / ratios).sum(1) - unlikely(WIDTHS)
    return most_likely([Profile(likelihood, WIDTHS)])
