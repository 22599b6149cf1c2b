"""Rehearsal: if an effect were hidden in these captures, would a diagnosis name it? From derivative images alone.

The scores of a hidden effect with strengths s are u = V s + z, z ~ N(0, V), with the information V that calibration
leaves (as in `optics.diagnosis.statistics`). Thousands of such u give the falls of chi2 of all candidates, hence which
one comes first, and by how much:

    noticed   the best candidate is significant among all of them (family-wise, 1 %)
    first     the hidden effect has the largest fall
    named     it leads by what a claim requires
    as        the effect that comes first most often where the hidden one does not

Linear in the effect and in the base, with the camera's noise only: clutter and nonlinear effects do worse. `imitate`
makes captures for the whole loop, of the model alone or of the measured images.

Source: the idea is that of "make_perfect_observations" in mrcal.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from optics.captures import capture_set as capture_files
from optics.captures.noise import Noise
from optics.diagnosis import statistics as st
from optics.diagnosis.evidence import Progress
from optics.diagnosis.score import score
from optics.diagnosis.thresholds import CLEAR, LEVEL, MARGIN
from optics.errors import BadCapture
from optics.fit.model import Model
from optics.fit.result import Fit
from optics.scene.declare import Effect
from optics.scene.parameter import Values, Variable
from optics.words import percent, spaced, table

if TYPE_CHECKING:
    from optics.fit.scene_model import SceneModel


NEVER = 0.01  # of the draws: an effect that is named more rarely counts as never named


@dataclass(frozen=True)
class Rehearsed:
    """One hidden effect: its largest strength (over the plausible size), in `unit`, and shares of the draws."""

    effect: str
    strength: float
    unit: str
    noticed: float
    first: float
    named: float
    mistaken_for: str
    mistaken: float


@dataclass(frozen=True)
class Rehearsal:
    """All effects, each at the strength that makes one change of the images.

    change   rms change over the mean signal, before any calibration
    unseen   effects whose images calibration absorbs altogether
    """

    change: float
    frames: int
    rows: list[Rehearsed]
    unseen: list[str]

    def text(self) -> str:
        lines = [
            f"rehearsal: {self.frames} frames, every effect hidden in turn at a change of the images by "
            f"{percent(self.change)}, in the camera's noise alone"
        ]
        lines.append(
            table(
                [("effect", "strength", "noticed", "first", "named", "most often taken for")]
                + [
                    (
                        r.effect,
                        f"{r.strength:.3g}{spaced(r.unit)}",
                        f"{r.noticed:.0%}",
                        f"{r.first:.0%}",
                        f"{r.named:.0%}",
                        f"{r.mistaken_for} ({r.mistaken:.0%})" if r.mistaken_for else "",
                    )
                    for r in sorted(self.rows, key=lambda r: -r.named)
                ],
                left=(0, 5),
            )
        )
        if self.rows:
            lines.append(
                f"all: first in {np.mean([r.first for r in self.rows]):.0%}, named in "
                f"{np.mean([r.named for r in self.rows]):.0%}; never named: "
                f"{', '.join(r.effect for r in self.rows if r.named < NEVER) or 'none'}"
            )
        if self.unseen:
            lines.append(f"invisible in these captures: {', '.join(self.unseen)}")
        return "\n".join(lines) + "\n"

    def to_json(self) -> str:
        return json.dumps(asdict(self), indent=1)


def rehearse(
    model: Model,
    fit: Fit,
    effects: Sequence[Effect],
    variables_of: Callable[[Effect], Sequence[Variable]],
    fitted: Sequence[int],
    *,
    change: float = 0.005,
    draws: int = 2000,
    seed: int = 0,
    progress: Progress | None = None,
) -> Rehearsal:
    """Hide every effect in turn.

    change   as in `Rehearsal`; draws: simulated data sets; other arguments as of `optics.diagnosis.diagnose.diagnose`

    Raises ValueError for a change that is not positive, Underdetermined as a diagnosis does.
    """
    if not change > 0:
        raise ValueError(f"change = {100 * change:g} %; allowed: above 0 % of the mean signal, such as 0.5 %")
    scored = score(model, fit, effects, variables_of, fitted, seed=seed, progress=progress)
    evidence, table = scored.evidence, scored.table
    first, information = len(evidence.base), table.information
    live = [c for c in table.order if len(c.cone.live) and c.raw > 0]
    places = [np.array(c.columns) - first for c in live]
    noise = st.gaussian(information, draws, np.random.default_rng([seed, 29]))
    critical = table.family.critical(LEVEL)
    levels = [c.cone.critical(critical) for c in live]
    rows = []
    for a, c in enumerate(live):
        linear = c.linear_of(c.usual) * change / c.raw
        scores = noise + information[:, places[a]] @ linear
        falls = np.stack([other.cone.fall(scores[:, own]) for other, own in zip(live, places)])
        noticed = (falls > np.array(levels)[:, None]).any(0)
        net = falls - np.array([other.cone.expectation for other in live])[:, None]
        # an effect that contains it fits as well in any case, and rivals it only if it leads by CLEAR
        net -= np.array([[CLEAR if other.contains(c) else 0.0] for other in live])
        rivals = np.delete(net, a, 0)
        lead = net[a] - rivals.max(0, initial=0.0)
        best = net.argmax(0)
        wrong = np.bincount(best[best != a], minlength=len(live)) / draws
        strengths = c.change_of(linear)
        biggest = int(np.argmax(np.abs(strengths / c.plausible)))
        rows.append(
            Rehearsed(
                c.effect.name,
                float(strengths[biggest]),
                c.variables[biggest].parameter.unit,
                float(noticed.mean()),
                float((best == a).mean()),
                float((noticed & (best == a) & (lead > np.maximum(CLEAR, MARGIN * net[a]))).mean()),
                live[int(wrong.argmax())].effect.name if wrong.any() else "",
                float(wrong.max(initial=0.0)),
            )
        )
    return Rehearsal(change, len(evidence.frames), rows, [c.effect.name for c in table.order if c not in live])


def imitate(
    model: SceneModel, values: Values, folder: str | Path, seed: int = 0, measured_at: Values | None = None
) -> Path:
    """Write captures as this model predicts them at these values, with its camera's noise and its frames' settings; or
    the measured images, changed by what the model says that these values change.

    Simulated images show what a residual would look like, and what the loop concludes from it. They prove nothing about
    the model, which made them. Measured ones keep their own noise and all that the model lacks.

    measured_at   values at which the model describes the measured images: to each the difference of the predictions at
                  `values` and at these is added, in DN, and import.json goes along, since what it advises still holds.
                  None: images are simulated

    Raises BadCapture for readings in a table, where measured images would not change, and as
    `optics.captures.capture_set.write`."""
    captures = model.captures
    if captures.table is not None:
        raise BadCapture(
            f"{captures.folder}: readings in a table cannot be imitated; allowed: images; `optics rehearse` works "
            "for both"
        )
    signals = model.predict(values)
    if measured_at is None:
        rng, noise = np.random.default_rng([seed, 31]), model.noise
        images = [noise.expose(signal, rng) for signal in signals]
    else:
        noise = model.noise.unrounded()
        changes = [after - before for after, before in zip(signals, model.predict(measured_at))]
        if not any(np.any(change) for change in changes):
            raise BadCapture(
                f"{captures.folder}: none of the images would change; allowed: --set of what acts in these frames "
                "and is not set or found in each of them, such as --set camera.vignetting=0.3"
            )
        images = [_added(model.noise, f.image, change) for f, change in zip(model.frames, changes)]
    frames = []
    for frame, image in zip(model.frames, images):
        image = image.astype(np.float32)
        if captures.cfa is not None:
            image = np.take_along_axis(image, capture_files.cfa_channel(image.shape, captures.cfa)[..., None], axis=2)
        frames.append(replace(frame, image=image, repeats=[]))
    whole = noise.quantisation == 1 and float(noise.saturation).is_integer()
    bits = None if not whole else 8 if noise.saturation <= 255 else 16
    written = capture_files.write(replace(captures, frames=frames, noise=noise, warnings=[]), folder, bits=bits)
    if measured_at is not None and (advice := captures.folder / "import.json").is_file():
        shutil.copyfile(advice, written / advice.name)
    return written


def _added(noise: Noise, image: np.ndarray, change: np.ndarray) -> np.ndarray:
    """A measured image with a change; what is cut off, at saturation or at black, says nothing and stays."""
    return np.where(noise.usable(image, 0), np.minimum(image + change, noise.saturation), image)
