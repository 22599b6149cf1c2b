"""Unfilled cell: one cell of a printed grid lacks its filling, and which.

Definition
    index 1 + (n - 1)(1 - u), absorption and scattering times (1 - u)      u = `unfilled`, 1 where it is empty
Fingerprint
    one cell with bright and dark edges, as its walls reflect totally; the cells behind it are displaced.
Validity
    one cell, and which is sought where the residual is, before u is fitted: `seek` weighs the misfit by the cells that each pixel is
    seen through, and tries those that come first.
References
    Fan, Li, Cong & Zhang, MagicGripper, III.A, prints cells that are all filled.
"""

import numpy as np

from optics.effect import Effect

TRIED = 12  # cells whose picture is made
RAYS = 16  # per pixel, for what it is seen through


def seek(model, values, frames):
    """The cell that explains the residual best: {key: value} of its column, row and layer."""
    from optics.parameter import Values
    from optics.transport import Transport

    name, grid = next((n, p) for n, p in model.scene.parts.items() if p.kind == "cells")
    predictions = model.predict(values, frames)
    sd = [np.sqrt(model.variance(values, i, p)) for i, p in zip(frames, predictions)]
    residual = [np.where(model.usable(i), model.frames[i].image - p, 0.0) / s for i, p, s in zip(frames, predictions, sd)]
    excess = np.mean([(r**2).mean(-1) for r in residual], 0)
    model.renderer._apply(model.at(values, frames[0]))
    seen = Transport(model.scene).seen_through(RAYS)
    seen = seen[:np.prod(grid.counts)].reshape(-1, excess.size)
    size = np.sqrt((seen**2).sum(1))
    score = seen @ (excess - np.median(excess)).ravel() / np.maximum(size, 0.05 * size.max())
    # frames of one geometry: all lights are in one picture
    geometry = model.renderer.geometry(model.at(values, frames[0]))
    alike = [k for k, i in enumerate(frames) if model.renderer.geometry(model.at(values, i)) == geometry]
    best, place = 0.0, None
    for cell in np.argsort(-score)[:TRIED]:
        at = dict(zip((f"{name}.unfilled_{axis}" for axis in ("column", "row", "layer")), map(float, np.unravel_index(cell, grid.counts))))
        trial = Values({**values.common, **at, f"{name}.unfilled": 1.0}, values.frame)
        changes = [(p - predictions[k]) / sd[k] for k, p in zip(alike, model.predict(trial, [frames[k] for k in alike]))]
        along, length = (sum(float((c * o).sum()) for c, o in zip(changes, others)) for others in ([residual[k] for k in alike], changes))
        if length > 0 and along > 0 and along**2 / length > best:
            best, place = along**2 / length, at
    return place or {}


effect = Effect(name="unfilled cell", part="cells", parameters=("unfilled",), per="part", onset="secant", seek=seek,
                acts=("row", "column"), needs="sharp pictures of the grid")
