"""Beads whose places nobody knows: found in images at rest, then fitted with a few parameters of the scene.

    found = locate(Setup(captures="session"), "beads.csv")
    optics calibrate session -D places=beads.csv ...

In the image at rest each bead is found as a bright disc (`optics.readers.flow.find_beads`), on the line of sight
through its middle and in the middle of the layer that has beads. `optics.fit.bodies` fits all places in all frames:
a bead's size, its brightness and its motion under presses tell its depth. Where the residual shows a bead that was
not found, hidden behind another or merged with it, it is added, and all are fitted once more. A scene takes part
whose beads have `<string name="places" value="$places"/>`."""

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
from optics.readers.flow import find_beads
from optics.scene.parameter import Values
from optics.skin.cloud import write_places
from optics.study.setup import Setup, open_model

AMISS = 1.5  # chi2 over its degrees of freedom, above which places are not to be believed
ROUNDS = 3  # fits, between which beads are added
SEEN = 6.0  # standard deviations by which a disc as large as a bead must stand out of the residual
BRIGHT = 0.3  # of the median bead's light, which it must have


@dataclass
class Located:
    """Places of beads, and what was found with them.

    file     the table of places;   fit   optics.fit.bodies.Bodies
    found    number of beads in the image at rest;   added   those that the residual showed
    """

    file: Path
    fit: Bodies
    found: int
    added: int

    def record(self) -> dict:
        """What goes to the .json beside the table."""
        fit = self.fit
        return {
            "beads": len(fit.points),
            "found": self.found,
            "added": self.added,
            "chi2": fit.chi2,
            "dof": fit.dof,
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
    write_places(file, np.array([[0.0, 0.0, -1.0]]))  # until the image at rest is read
    model = open_model(setup)
    name = _crowd(model)
    points = start_places(model, name)
    found = len(points)
    depths = depth_prior(model, name)
    for round_ in range(ROUNDS):
        write_places(file, points)
        model = open_model(setup)
        variables = variables_from(model, list(free) or sorted(model.scene.powers.values()))
        fit = refine(model, name, variables, Values(dict(setup.values)), depth_prior=depths, progress=progress)
        more = missed(model, name, fit) if round_ < ROUNDS - 1 else np.zeros((0, 3))
        if not len(more):
            break
        points = np.concatenate([fit.points, more])
    write_places(file, fit.points)
    located = Located(file, fit, found, len(fit.points) - found)
    write_text(file.with_suffix(".json"), json.dumps(located.record(), indent=1))
    return located


def _crowd(model: SceneModel) -> str:
    parts: dict[str, Any] = {n: part for n, part in model.scene.parts.items() if hasattr(part, "put")}
    found = list(parts)
    if len(found) != 1 or len(parts[found[0]].balls()[1]) != 1:
        raise BadScene(
            f"{model.scene.path}: {len(found)} parts have beads to locate, and the definition 'places' reaches "
            f"{'none of them' if found else 'none'}; allowed: one part of the kind 'beads' that has "
            '<string name="places" value="$places"/>'
        )
    return found[0]


def depth_prior(model: SceneModel, name: str) -> tuple[float, float]:
    """Mean and standard deviation of the depths between `top` and `bottom`, mm."""
    top, bottom = (model.scene.parts[name].number(n) for n in ("top", "bottom"))
    return (top + bottom) / 2, (bottom - top) / np.sqrt(12)


def at_rest(model: SceneModel) -> list[int]:
    """The frames whose skin is pressed least."""
    gel = model.scene.gel
    key = None if gel is None else model.scene.key(gel.name, "press depth")
    depths = [0.0 if key is None else float(f.parameters.get(key, model.base[key])) for f in model.frames]
    return [i for i, depth in enumerate(depths) if depth == min(depths)]


def start_places(model: SceneModel, name: str) -> np.ndarray:
    """(N, 3) mm: beads of the image at rest, in the middle of the layer that has them."""
    image = np.sum([model.frames[i].image.astype(float) - model.noise.black_level for i in at_rest(model)], 0)
    light = image[..., int(np.argmax(image.mean((0, 1))))]
    places = find_beads(np.clip(light, 0, None), saturation=max(float(light.max()), 1.0))
    if not len(places):
        raise ValueError(
            f"{model.captures.folder}: no bead is seen in the frames at rest; allowed: a frame without a press, in "
            "which beads are 4 px wide or more and brighter than what is around them"
        )
    return _at_depth(model, places, depth_prior(model, name)[0])


def _at_depth(model: SceneModel, places: np.ndarray, depth: float) -> np.ndarray:
    """(N, 3) where the lines of sight through (N, 2) px are so deep below the face."""
    import mitsuba as mi

    if not len(places):
        return np.zeros((0, 3))
    o, d = (np.array(a, float).T for a in model.scene.camera.ray(*(mi.Float(a.astype("f")) for a in places.T)))
    return o + d * ((-depth - o[:, 2]) / d[:, 2])[:, None]


def missed(model: SceneModel, name: str, fit: Bodies) -> np.ndarray:
    """(N, 3) starts of beads that the residual at rest shows: discs of light as large as a bead, brighter than
    predicted by SEEN standard deviations and by BRIGHT of a bead."""
    from scipy.ndimage import gaussian_filter, maximum_filter

    frames = at_rest(model)
    predicted = model.predict(fit.values, frames)
    camera: Any = model.scene.camera
    part: Any = model.scene.parts[name]
    middles, radii = part.balls()
    wide = float(np.median(np.linalg.norm(camera.project(middles + [1e-2, 0, 0]) - camera.project(middles), axis=1)))
    sd = max(0.5 * wide * 100 * float(np.median(radii)), 0.7)  # px
    left: np.ndarray | float = 0.0
    power: np.ndarray | float = 0.0
    light: np.ndarray | float = 0.0
    for i, p in zip(frames, predicted):
        left = left + (model.frames[i].image - p).sum(-1)
        power = power + model.variance(fit.values, i, p).sum(-1)
        light = light + (p - model.noise.black_level).sum(-1)
    smooth = gaussian_filter(np.asarray(left), sd)
    noise = np.sqrt(gaussian_filter(np.asarray(power), sd) / (4 * np.pi * sd**2))
    bead = float(np.median(gaussian_filter(np.asarray(light), sd)[_within(model, camera.project(middles))]))
    peak = (smooth == maximum_filter(smooth, 2 * int(np.ceil(2 * sd)) + 1)) & (smooth > SEEN * noise)
    v, u = np.nonzero(peak & (smooth > BRIGHT * bead))
    return _at_depth(model, np.column_stack([u, v]) + 0.5, depth_prior(model, name)[0])


def _within(model: SceneModel, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels that hold places in px."""
    height, width = model.shape[:2]
    column, row = np.floor(places).astype(int).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return row[inside], column[inside]
