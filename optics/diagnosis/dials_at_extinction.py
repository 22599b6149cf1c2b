"""How far dials stop from what is written down, where films stand crossed in every image.

By what is written down such images are dark, and what light they have, I = P sin^2(d), is the square of what two dials
are off: it has no slope at the settings, on which `optics.diagnosis.dials` rests. Instead the angles of each image are
calibrated with a width that is assumed, and the width follows from where they end: of a component u of an image's
angles (deg from the settings) that it tells to 1/sqrt(l)

    u = t'(e + m) + n,  var n = 1/l;    e: the errors, of variance w^2;  m: a zero of each dial

and the width is that of the largest likelihood, with the prior of `optics.diagnosis.dials`. A zero that is off is an
effect, and no error of the settings: all zeros within ZERO are as likely. A few turns of that end where the width that
is found is the one assumed."""

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
ZERO = 10.0  # deg: zeros of dials that may be


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
    u, noise, zeros = [], [], []
    angles = own_angles(fit).values()
    keys = list(dict.fromkeys(fit.variables[i].keys for places in angles for i in places))
    for places in angles:
        variables = [fit.variables[i] for i in places]
        priors = np.array([v.precision for v in variables])
        information, turn = np.linalg.eigh(fit.normal.a[np.ix_(places, places)] - np.diag(priors))
        middles = np.array([v.prior[0] for v in variables if v.prior is not None])
        off = turn.T @ (fit.estimate[list(places)] - middles)
        of_dial = np.array([[float(v.keys == key) for key in keys] for v in variables])
        for told, one, to in zip(information, off, turn.T @ of_dial):
            if told > priors.max():  # the rest stands where the prior has put it
                u.append(one * (1 + priors.max() / told))  # without the prior's pull
                noise.append(1 / told)
                zeros.append(to)
    if len(u) <= len(keys):
        return None
    likelihood = np.array([_likelihood(np.array(u), np.array(noise) + w**2, np.array(zeros)) for w in WIDTHS])
    return most_likely([Profile(likelihood - unlikely(WIDTHS), WIDTHS)])


def _likelihood(u: np.ndarray, variance: np.ndarray, zeros: np.ndarray) -> float:
    """Twice the log likelihood of u, of variances of their own and with zeros' (n, k) of variance ZERO^2 in common."""
    weighed = zeros / variance[:, None]
    inner = np.eye(zeros.shape[1]) / ZERO**2 + zeros.T @ weighed
    along = weighed.T @ u
    square = float(u @ (u / variance) - along @ np.linalg.solve(inner, along))
    return -(square + float(np.log(variance).sum() + np.linalg.slogdet(inner)[1]))
