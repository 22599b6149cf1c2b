"""Frames for the eye: measured, predicted and residual, and what an effect would change in them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from optics.diagnosis.result import Diagnosis
from optics.fit.compare import led_label
from optics.fit.result import Fit
from optics.fit.scene_model import SceneModel
from optics.scene.parameter import Values


@dataclass(frozen=True)
class Shown:
    """A frame for the eye.

    measured, predicted, sd   (H, W, C) in DN; sd is one standard deviation of the noise
    usable                    bool, (H, W) or (H, W, C)
    led, group, held_out      what was lit, the group it belongs to, and whether the calibration has not seen it
    settings                  of a sweep of point readings, (N, 1, C): the N values of every key; units: of these keys
    """

    name: str
    measured: np.ndarray
    predicted: np.ndarray
    sd: np.ndarray
    usable: np.ndarray
    led: str = ""
    group: str = ""
    held_out: bool = False
    settings: Mapping[str, np.ndarray] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)

    @property
    def residual(self) -> np.ndarray:
        """(H, W, C) measured minus predicted in sigmas, NaN where not usable."""
        good = np.broadcast_to(self.usable if self.usable.ndim == 3 else self.usable[..., None], self.measured.shape)
        good = good & (self.sd > 0)
        return np.where(good, (self.measured - self.predicted) / np.where(good, self.sd, 1.0), np.nan)


@dataclass(frozen=True)
class Fingerprint:
    """What an effect would add to a frame, and the residual that it is to explain; both (H, W, C) in sigmas.

    image   the change of the image by a refit (`fingerprints_of`), or strength * projected derivative image; what the
            calibration absorbs is taken out of both
    """

    effect: str
    frame: str
    image: np.ndarray
    residual: np.ndarray
    strength: float = math.nan


def mosaic_of(model: SceneModel) -> dict[str, Any]:
    """Of raw frames: `mosaic`, the cell of analysers (deg, row by row), or `cfa`, the pattern of colour filters."""
    cell = getattr(model.scene.camera, "mosaic", ())
    if cell:
        return {"mosaic": [list(row) for row in cell]}
    return {} if model.captures.cfa is None else {"cfa": model.captures.cfa}


def cell_of(model: SceneModel) -> tuple[int, int]:
    """Rows and columns that a raw mosaic repeats; (1, 1) without one."""
    found = mosaic_of(model)
    if "mosaic" in found:
        return len(found["mosaic"]), len(found["mosaic"][0])
    return (2, 2) if found else (1, 1)


def shown_frames(
    model: SceneModel, values: Values, held_out: Sequence[int] = (), frames: Sequence[int] | None = None
) -> list[Shown]:
    """All frames of a model, or the given ones, with its predictions for `values`."""
    indices = list(range(len(model.frames))) if frames is None else list(frames)
    out = []
    for i in indices:
        f, prediction = model.frames[i], np.asarray(model.predict(values, [i])[0])
        settings = (
            {}
            if model.captures.table is None
            else {
                key: np.broadcast_to(np.ravel(value), len(prediction))
                for key, value in (*f.parameters.items(), *f.readings.items())
            }
        )
        out.append(
            Shown(
                f.name,
                np.asarray(f.image),
                prediction,
                np.sqrt(model.variance(values, i, prediction)),
                model.usable(i),
                led_label(f.parameters),
                f.group or "",
                i in set(held_out),
                settings,
                {key: model.parameters[key].unit for key in settings},
            )
        )
    return out


def fingerprints_of(model: SceneModel, fit: Fit, diagnosis: Diagnosis, frame: int, count: int = 4) -> list[Fingerprint]:
    """What the best effects of a diagnosis change in a frame when they are added and everything is calibrated again.

    image = (prediction of the refit - prediction of the base) / sd, beside residual = (measured - base) / sd: the right
    effect looks like the residual. It is taken from the refits, so it holds where the image is not linear, too.
    """
    base = np.asarray(model.predict(fit.values, [frame])[0])
    use = model.usable(frame)
    sd = np.sqrt(model.variance(fit.values, frame, base))
    found = model.frames[frame]
    residual = np.where(use, (np.asarray(found.image) - base) / sd, np.nan)
    rows = [r for r in diagnosis.rows if r.name in diagnosis.fits][:count]
    out = []
    for row in rows:
        image = (np.asarray(model.predict(diagnosis.fits[row.name].values, [frame])[0]) - base) / sd
        strength = row.refit.strength[0] if row.refit is not None and len(row.refit.strength) == 1 else math.nan
        out.append(Fingerprint(row.name, found.name, np.where(use, image, np.nan), residual, strength))
    return out
