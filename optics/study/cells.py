"""A study's model in cells of k x k pixels, in which large images are diagnosed (`optics.captures.cells`).

The scene is loaded with a smaller film. What it states in pixels, the principal point and the variance of a blur, is
turned into cells, and so are the values of a fit."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from optics.captures.cells import in_cells
from optics.fit.scene_model import SceneModel
from optics.scene.loader import Scene
from optics.scene.mitsuba_parts import coarser
from optics.scene.parameter import Values, Variable
from optics.study.setup import Setup, definitions_of

LARGE = 60_000  # usable values of the fitted frames, above which they are put into cells: some minutes of a diagnosis
LARGEST_CELL = 4  # px each way: the dent of a ball that covers fifty pixels still covers a hundred cells
FINER = 3  # times: from the cells of one model in which a calibration begins to those of the next
SMALLEST = 24  # cells along the shorter side of an image
IN_PIXELS = {"px": 1, "px^2": 2}  # unit -> its power of a length in pixels
IN_CELLS = {"px": "cell", "px^2": "cell^2"}  # what a diagnosis says of numbers in cells


class Cells:
    """How values change from pixels to cells of k x k and back.

    whole   the model in pixels
    """

    def __init__(self, whole: SceneModel, k: int):
        self.whole, self.k = whole, k
        self.width, self.height = whole.scene.camera.resolution
        self.columns, self.rows = self.width // k, self.height // k
        name = whole.scene.camera.name
        self.fov, self.middle = f"{name}.x_fov", {f"{name}.principal_x": 0, f"{name}.principal_y": 1}

    @property
    def cut(self) -> bool:
        """Whether columns are left out, and with them a part of the field of view."""
        return self.columns * self.k != self.width

    def into(self, key: str, value: float) -> float:
        """A value in cells."""
        if key == self.fov:
            half = math.tan(math.radians(value) / 2) * self.columns * self.k / self.width
            return math.degrees(2 * math.atan(half))
        if key in self.middle:
            return (value + self._half(key)[0]) / self.k - self._half(key)[1]
        return value / self.k ** self.power(key)

    def back(self, key: str, value: float) -> float:
        """A value in pixels."""
        if key == self.fov:
            half = math.tan(math.radians(value) / 2) * self.width / (self.columns * self.k)
            return math.degrees(2 * math.atan(half))
        if key in self.middle:
            return (value + self._half(key)[1]) * self.k - self._half(key)[0]
        return value * self.k ** self.power(key)

    def power(self, key: str) -> int:
        return IN_PIXELS.get(self.whole.parameters[key].unit, 0)

    def _half(self, key: str) -> tuple[float, float]:
        """Half of the image along the axis of a principal point, in pixels and in cells."""
        axis = self.middle[key]
        return (self.width, self.height)[axis] / 2, (self.columns, self.rows)[axis] / 2

    def turns(self, key: str) -> bool:
        """Whether a parameter has another value in cells."""
        return self.power(key) > 0 or (key == self.fov and self.cut)

    def all_into(self, values: Mapping[str, Any]) -> dict[str, Any]:
        return {key: self.into(key, value) if self.turns(key) else value for key, value in values.items()}

    def values_into(self, values: Values) -> Values:
        return Values(self.all_into(values.common), {i: self.all_into(own) for i, own in values.frame.items()})

    def values_back(self, values: Values) -> Values:
        def pixels(own: Mapping[str, Any]) -> dict[str, Any]:
            return {key: self.back(key, value) if self.turns(key) else value for key, value in own.items()}

        return Values(pixels(values.common), {i: pixels(own) for i, own in values.frame.items()})


def cells_for(
    model: SceneModel, fitted: Sequence[int], variables: Sequence[Variable], largest: int = LARGEST_CELL
) -> Cells | None:
    """The cells, of at most `largest` pixels each way, in which a study's fitted frames are diagnosed; None where these
    are small, or cannot be put into cells: readings, raw mosaics, scenes of Monte Carlo estimates, and scenes whose
    size in pixels is fixed, or whose frames or priors state something in pixels."""
    captures, camera = model.captures, model.scene.camera
    values = sum(int(model.usable(i).sum()) for i in fitted)
    if values <= LARGE or captures.table is not None or captures.cfa or captures.mosaic or model.monte_carlo:
        return None
    k = min(math.ceil(math.sqrt(values / LARGE)), largest, min(camera.resolution) // SMALLEST)
    if k < 2:
        return None
    found = Cells(model, k)
    text = model.scene.path.read_text(encoding="utf-8")
    if len(set(re.findall(r'<default name="(width|height)"', text))) < 2 or found.fov not in model.parameters:
        return None
    by_frame = {key for f in captures.frames for key in (*f.parameters, *f.uncertainty)} | set(captures.uncertainty)
    priors = {key for v in variables if v.prior is not None for key in v.keys}
    if any(found.turns(key) for key in by_frame | priors):
        return None
    return found


def coarser_models(
    model: SceneModel, setup: Setup, fitted: Sequence[int], variables: Sequence[Variable]
) -> list[tuple[SceneModel, Cells]]:
    """The models in cells in which a calibration of large images begins, the coarsest first; none where cells would
    be smaller than FINER pixels, which saves nothing, or cannot be made (`cells_for`)."""
    cells, found = cells_for(model, fitted, variables, min(model.scene.camera.resolution)), []
    k = cells.k if cells is not None else 1
    while k >= FINER:
        cells = Cells(model, k)
        found.append((open_in_cells(setup, cells)[0], cells))
        k //= FINER
    return found


def open_in_cells(setup: Setup, cells: Cells) -> tuple[SceneModel, Setup]:
    """The model in cells, and the setup with its start values in cells."""
    whole = cells.whole
    captures = in_cells(whole.captures, whole.noise, cells.k)
    stated = {key: cells.into(key, float(whole.base[key])) for key in whole.parameters if cells.turns(key)}
    captures = replace(captures, parameters={**captures.parameters, **stated})
    sized = replace(setup, defines={k: v for k, v in setup.defines.items() if k not in ("width", "height")})
    defines = definitions_of(sized, captures, whole.scene.path, (cells.columns, cells.rows))
    with coarser(cells.k):
        loaded = Scene(whole.scene.path, defines, whole.scene.variant, whole.scene.registry)
    loaded.parameters = {k: replace(p, unit=IN_CELLS.get(p.unit, p.unit)) for k, p in loaded.parameters.items()}
    model = type(whole)(loaded, captures, captures.noise, whole.flat_field, whole.region)
    model.assumed_errors, model.cell = dict(whole.assumed_errors), cells.k
    if whole.recipe is not None:
        model.recipe = partial(_open_again, whole.recipe, setup, cells.k)
    return model, replace(setup, values=cells.all_into(setup.values))


def _open_again(whole: Callable[[], SceneModel], setup: Setup, k: int) -> SceneModel:
    return open_in_cells(setup, Cells(whole(), k))[0]
