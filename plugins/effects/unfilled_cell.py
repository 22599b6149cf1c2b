"""Unfilled cell: one cell of a printed grid lacks its filling, and which.

Definition
    index 1 + (n - 1)(1 - u), absorption and scattering times (1 - u)      u = `unfilled`, 1 where it is empty
Fingerprint
    one cell with bright and dark edges, as its walls reflect totally; the cells behind it are displaced.
Validity
    one cell. Which one is searched where the residual is, before u is fitted: `seek` weighs the misfit by the cells
    that each pixel is seen through, and tries those with the highest score, the best of them in all frames.
References
    Fan, Li, Cong & Zhang, MagicGripper, III.A, prints cells that are all filled.
"""

import numpy as np

from optics.scene.checking import agree, scene_of
from optics.scene.declare import Effect

TRIED = 12  # cells whose image is made
FINALS = 3  # of these, the ones that are weighed in all frames
RAYS = 16  # per pixel, for what it is seen through
SEED = 1001


def seek(model, values, frames):
    """The cell that explains the residual best: {key: value} of its column, row and layer."""
    from optics.light.transport import Transport
    from optics.scene.parameter import Values

    name, grid = next((n, p) for n, p in model.scene.parts.items() if p.kind == "cells")
    predictions = model.predict(values, frames)
    sd = [np.sqrt(model.variance(values, i, p)) for i, p in zip(frames, predictions)]
    residual = [
        np.where(model.usable(i), model.frames[i].image - p, 0.0) / s for i, p, s in zip(frames, predictions, sd)
    ]
    excess = np.mean([(r**2).mean(-1) for r in residual], 0)
    model.set_scene(values, frames[0])
    seen = Transport(model.scene).seen_through(RAYS)
    seen = seen[: np.prod(grid.counts)].reshape(-1, excess.size)
    size = np.sqrt((seen**2).sum(1))
    score = seen @ (excess - np.median(excess)).ravel() / np.maximum(size, 0.05 * size.max())
    # frames of one geometry first: all lights are in one image
    geometry = model.renderer.geometry(model.at(values, frames[0]))
    alike = [k for k, i in enumerate(frames) if model.renderer.geometry(model.at(values, i)) == geometry]
    # the change is taken between images of another seed: the error of the predictions is in the residual, and would
    # look like a change
    plain: dict[int, np.ndarray] = {}

    def worth(cell: int, used: list[int]) -> float:
        """Fall of chi2 that the emptied cell's image would bring in these frames, at its best strength."""
        trial = Values({**values.common, **at[cell], f"{name}.unfilled": 1.0}, values.frame)
        new = [k for k in used if k not in plain]
        plain.update(zip(new, model.predict(values, [frames[k] for k in new], SEED)))
        changes = [(p - plain[k]) / sd[k] for k, p in zip(used, model.predict(trial, [frames[k] for k in used], SEED))]
        along, length = (
            sum(float((c * o).sum()) for c, o in zip(changes, others))
            for others in ([residual[k] for k in used], changes)
        )
        return along**2 / length if length > 0 and along > 0 else 0.0

    tried = [int(cell) for cell in np.argsort(-score)[:TRIED]]
    at = {
        cell: dict(
            zip(
                (f"{name}.unfilled_{axis}" for axis in ("column", "row", "layer")),
                map(float, np.unravel_index(cell, grid.counts)),
            )
        )
        for cell in tried
    }
    falls = {cell: worth(cell, alike) for cell in tried}
    finals = sorted(tried, key=lambda cell: -falls[cell])[:FINALS]
    if len(alike) < len(frames):
        falls = {cell: worth(cell, list(range(len(frames)))) for cell in finals}
    best = max(finals, key=lambda cell: falls[cell])
    return at[best] if falls[best] > 0 else {}


def check_material():
    """Half filled with a resin of n = 1.5 and 0.2/mm a cell has n = 1.25 and 0.1/mm; empty it is air."""
    from optics.light.transport import Transport

    grid = (
        '<shape type="cells" id="grid"><integer name="columns" value="2"/><integer name="rows" value="2"/>'
        '<integer name="layers" value="1"/><float name="unfilled" value="{}"/><float name="unfilled_column" value="1"/>'
        '<bsdf type="clear" id="resin"><float name="index" value="1.5"/><float name="absorption" value="0.2"/></bsdf>'
        "</shape>"
    )
    lamp = '<shape type="rectangle"><emitter type="source" id="lamp"/></shape>'
    for share, index, absorption in ((0.5, 1.25, 0.1), (1.0, 1.0, 0.0)):
        transport = Transport(scene_of(grid.format(share), lamp))
        cells = next(s for s in transport.surfaces if s.cells is not None)
        # cells count layers first, then rows: column 1, row 0 is the third; the others have the resin
        assert len(set(cells.fillings[[0, 1, 3]])) == 1
        odd = transport.materials[cells.fillings[2]]
        agree(odd.index, [index] * 3, 1e-6)
        agree(odd.absorption, [absorption] * 3, 1e-6)


def random(rng):
    """One of the first 2 x 2 x 2 cells, which every grid of two cells each way has, filled by half or less."""
    place = {f"unfilled_{axis}": float(rng.integers(2)) for axis in ("column", "row", "layer")}
    return {"unfilled": rng.uniform(0.5, 1), **place}


effect = Effect(
    name="unfilled cell",
    part="cells",
    parameters=("unfilled",),
    per="part",
    onset="secant",
    seek=seek,
    acts=("row", "column"),
    needs="sharp images of the grid",
    checks=(check_material,),
    random=random,
)
