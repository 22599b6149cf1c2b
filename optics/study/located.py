"""Beads whose places nobody knows: found in images at rest, then fitted with a few parameters of the scene.

    found = locate(Setup(captures="session"), "beads.csv")
    optics calibrate session -D places=beads.csv ...

In the images at rest beads are found one behind the other (`optics.fit.sought`), however many overlap. Then
`optics.fit.bodies` fits all places in all frames: a bead's size, its brightness, its shadows and its motion under
presses tell its depth. In what is left beads are sought once more, and all are fitted again. A scene takes part whose
beads have `<string name="places" value="$places"/>`."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from optics.errors import BadScene
from optics.files.output import write_text
from optics.fit.bodies import Bodies, refine
from optics.fit.calibrate import variables_from
from optics.fit.scene_model import SceneModel
from optics.fit.sought import Seeker
from optics.scene.parameter import Values, Variable
from optics.skin.cloud import write_places
from optics.study.setup import Setup, open_model

AMISS = 1.5  # chi2 over its degrees of freedom, above which places are not to be believed
ROUNDS = 2  # fits, before each of which beads are sought


@dataclass
class Located:
    """Places of beads, and what was found with them.

    file     the table of places;   fit   optics.fit.bodies.Bodies
    found    number of beads in the image at rest;   added   those that the residual showed
    doubtful   (N,) whether a bead is far off where it is seen
    """

    file: Path
    fit: Bodies
    found: int
    added: int
    doubtful: np.ndarray

    def record(self) -> dict:
        """What goes to the .json beside the table."""
        fit = self.fit
        return {
            "beads": len(fit.points),
            "found": self.found,
            "added": self.added,
            "chi2": fit.chi2,
            "dof": fit.dof,
            "doubtful": np.flatnonzero(self.doubtful).tolist(),
            "errors": np.round(fit.errors, 6).tolist(),
            "parameters": {v.name: [fit.values.common[v.name], float(sd)] for v, sd in zip(fit.variables, fit.sd)},
        }

    def text(self) -> str:
        fit = self.fit
        across, deep = np.median(fit.errors[:, :2]), np.median(fit.errors[:, 2])
        lines = [
            f"{len(fit.points)} beads: {self.found} in the image at rest, {self.added} in what was left",
            f"chi2/dof {fit.chi2 / fit.dof:.3f}; errors in the median {across:.3g} mm across, {deep:.3g} mm in depth",
        ]
        if self.doubtful.any():
            lines.append(
                f"warning: {self.doubtful.sum()} beads are far off where they are seen, and may be wrong; "
                f"{self.file.with_suffix('.json').name} lists their rows under `doubtful`"
            )
        if fit.chi2 > AMISS * fit.dof:
            lines.append(
                "warning: the fit does not explain the images. Some positions or the scene are wrong: give more "
                "presses, free parameters (--free), and compare the images"
            )
        lines += [
            f"{v.name:30s} {fit.values.common[v.name]:.5g} +- {sd:.2g} {v.parameter.unit}"
            for v, sd in zip(fit.variables, fit.sd)
        ]
        return "\n".join(lines)


def locate(
    setup: Setup,
    file: str | Path,
    free: Sequence[str] = (),
    *,
    progress: Callable[[str, int, int], None] | None = None,
) -> Located:
    """Find the beads of a capture set, write the table of their places, and a .json of errors beside it.

    free   key patterns of parameters that are fitted with them; none: the powers of the lights

    Raises BadScene for a scene that takes no table of places, ValueError where no bead is found."""
    file = Path(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    try:
        return _located(setup, file, free, progress)
    except BaseException:
        file.unlink(missing_ok=True)
        raise


def _located(
    setup: Setup, file: Path, free: Sequence[str], progress: Callable[[str, int, int], None] | None
) -> Located:
    setup = replace(setup, defines={**setup.defines, "places": os.path.abspath(file)})

    def reopen(points: np.ndarray) -> SceneModel:
        write_places(file, points)
        return open_model(setup)

    def solved_for(model: SceneModel) -> list[Variable]:
        return variables_from(model, list(free) or sorted(model.scene.powers.values()))

    model = reopen(np.array([[0.0, 0.0, -1.0]]))  # until the images at rest are read
    name = _crowd(model)
    layer: Any = model.scene.parts[name]
    seeker = Seeker(reopen, name, at_rest(model), layer.layer(), solved_for, Values(dict(setup.values)), progress)
    points, values = seeker.seek()
    if not len(points):
        raise ValueError(
            f"{model.captures.folder}: no bead is seen in the frames at rest; allowed: a frame without a press, in "
            f"which beads of {seeker.diameter:g} mm (beads.diameter) are 4 px wide or more and brighter than what is "
            "around them"
        )
    found = len(points)
    for round_ in range(ROUNDS):
        model = reopen(points)
        fit = refine(
            model,
            name,
            solved_for(model),
            values,
            depth_prior=seeker.prior,
            missing=True,
            max_iterations=6,
            progress=progress,
        )
        points, values = seeker.seek(fit.points, fit.values) if round_ < ROUNDS - 1 else (fit.points, fit.values)
        if np.array_equal(points, fit.points):
            break
    if fit.chi2 < AMISS * fit.dof:  # none is missing: all pixels count by their noise
        fit = refine(model, name, solved_for(model), values, depth_prior=seeker.prior, progress=progress)
    write_places(file, fit.points)
    located = Located(file, fit, found, len(fit.points) - found, seeker.doubtful(fit.points, fit.values))
    write_text(file.with_suffix(".json"), json.dumps(located.record(), indent=1))
    return located


def _crowd(model: SceneModel) -> str:
    parts: dict[str, Any] = {
        n: part for n, part in model.scene.parts.items() if hasattr(part, "put") and hasattr(part, "layer")
    }
    found = list(parts)
    if len(found) != 1 or len(parts[found[0]].balls()[1]) != 1:
        raise BadScene(
            f"{model.scene.path}: {len(found)} parts have beads to locate, and the definition 'places' reaches "
            f"{'none of them' if found else 'none'}; allowed: one part of the kind 'beads' that has "
            '<string name="places" value="$places"/>'
        )
    return found[0]


def at_rest(model: SceneModel) -> list[int]:
    """The frames whose skin is pressed least; of those under the same lights, the first."""
    gel = model.scene.gel
    key = None if gel is None else model.scene.key(gel.name, "press depth")
    depths = [0.0 if key is None else float(f.parameters.get(key, model.base[key])) for f in model.frames]
    least = [i for i, depth in enumerate(depths) if depth == min(depths)]
    first: dict[tuple, int] = {}
    for i in least:
        settings = model.frames[i].parameters
        first.setdefault(tuple(str(settings.get(key)) for key in model.scene.powers.values()), i)
    return list(first.values())
