"""`Model`: what a fit and a diagnosis ask of a model, and nothing else.

`optics.fit.scene_model.SceneModel` implements it for a scene and its captures. Anything with these members can be
fitted and diagnosed: the unit tests judge a sensor that is written in numpy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np

from optics.captures.capture_set import Captures, Frame
from optics.captures.noise import Noise
from optics.scene.parameter import Parameter, Values, Variable


@runtime_checkable
class Model(Protocol):
    """Predictions, derivative images, masks and coordinates of the frames of a measurement.

    Images are (H, W, C) in DN, row 0 on top; a sweep of N point readings is an image of shape (N, 1, C). `values` are
    parameter values in the units of their declarations; a frame is named by its index in `frames`.
    """

    @property
    def frames(self) -> list[Frame]:
        """Measured images, and what was set in each; of a raw mosaic, the same image in all channels."""
        ...

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """Key -> declaration: unit, bounds, plausible size."""
        ...

    @property
    def base(self) -> Mapping[str, Any]:
        """Key -> value before anything is fitted, in the parameter's unit; a word for a choice."""
        ...

    @property
    def shape(self) -> tuple[int, ...]:
        """(H, W, C) of the frames."""
        ...

    @property
    def size(self) -> float:
        """Measured values per frame: pixels x channels, or the pixels of a raw mosaic."""
        ...

    @property
    def noise(self) -> Noise:
        """The camera's noise model."""
        ...

    @property
    def captures(self) -> Captures | None:
        """The capture set that the frames come from; None where there is none."""
        ...

    @property
    def driven(self) -> set[str] | None:
        """Keys of light powers that frames set as drive levels, which multiply the fitted power; None where what a
        frame sets is the power itself."""
        ...

    @property
    def drives(self) -> set[str]:
        """Keys of `driven` whose value in a frame is a drive level when it is fitted, as it is when it is set: those
        that are set with an uncertainty. What is fitted of others in a frame is the power itself."""
        ...

    @property
    def monte_carlo(self) -> bool:
        """Whether predictions are Monte Carlo estimates, whose own error `variance` includes."""
        ...

    def at(self, values: Values, index: int) -> dict[str, Any]:
        """Every parameter's value in a frame: base <- fitted in all frames <- set in this frame <- fitted in it."""
        ...

    def linear_in(self, variable: Variable) -> bool:
        """Whether predictions are linear in this variable and all others of which this holds, taken together."""
        ...

    def predict(self, values: Values, frames: Sequence[int] | None = None, seed: int = 0) -> list[np.ndarray]:
        """Noise-free (H, W, C) in DN of each frame; None: of all. The seed matters where there is sampling error."""
        ...

    def derivatives(
        self,
        values: Values,
        variables: Sequence[Variable],
        frames: Sequence[int] | None = None,
        secant: Mapping[str, float] | None = None,
        seed: int = 0,
    ) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
        """Per frame, the prediction (H, W, C) and {variable's name: d prediction / d value}, DN per unit.

        secant   name -> finite step from the present value that replaces the tangent
        A variable that does nothing in a frame has no image there.
        """
        ...

    def usable(self, index: int) -> np.ndarray:
        """(H, W, C) bool, the values to use, from data, noise and masks only: no fit can change it."""
        ...

    def variance(self, values: Values, index: int, prediction: np.ndarray) -> np.ndarray:
        """(H, W, C) in DN^2, of a frame about its prediction: camera noise and, if `monte_carlo`, the estimate's."""
        ...

    def error_of_estimate(self, values: Values, index: int) -> np.ndarray:
        """(H, W, C) in DN^2, the estimate's alone, if `monte_carlo`."""
        ...

    def errors_of_settings(self, values: Values, index: int) -> dict[str, np.ndarray]:
        """key -> (N, 1, C) standard deviation in DN, signed, that the error of a setting brings to each reading of a
        sweep (`Frame.uncertainty`); it is part of `variance`. Empty where settings are exact."""
        ...

    def coordinates(self, values: Values, index: int, seed: int = 0) -> dict[str, np.ndarray]:
        """name -> (H, W) or (H, W, C): what is known of every pixel, in the units of `optics.fit.compare.UNITS`;
        boolean for a region. A comparison bins residuals by these, a diagnosis as well."""
        ...

    def lit_geometry(self, values: Values, index: int) -> dict[str, np.ndarray]:
        """name -> (H, W): further coordinates, for a diagnosis: how lights stand to the surface (see
        `optics.fit.geometry.lit_geometry`). Empty where there is no geometry."""
        ...

    def wavelengths(self) -> list[float]:
        """Mean wavelength of each channel, nm; 0 where unknown."""
        ...

    def family(self, key: str) -> str:
        """What a parameter key belongs to: 'camera', 'light', 'geometry' or 'time'; '' for any other name."""
        ...

    def imagine(self, frames: Sequence[Frame]) -> Model:
        """The same model with further frames: measurements that could be made."""
        ...


def seeds_apart(seed: int = 0) -> tuple[int, int]:
    """Two seeds of derivative images: apart from that of predictions, 0, and for every seed another pair."""
    return 2 * seed + 1001, 2 * seed + 1002


def values_in(model: Model, frames: Sequence[int]) -> float:
    """Measured values that these frames hold, used or not: sweeps of readings differ in length."""
    mean = np.mean([f.image.size for f in model.frames])
    return float(model.size * sum(model.frames[i].image.size for i in frames) / mean)


def value_of(model: Model, values: Values, variable: Variable) -> float:
    """The present value of a variable: fitted in its first frame <- set in it <- fitted in all <- the scene's; of a
    drive level (`Model.drives`), the level and not the power."""
    key = variable.keys[0]
    if variable.frames is None:
        return float(values.common.get(key, model.base[key]))
    first = variable.frames[0]
    if key in model.drives:
        return float(values.frame.get(first, {}).get(key, model.frames[first].parameters.get(key, 1.0)))
    return float(model.at(values, first)[key])
