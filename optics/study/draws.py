"""What is drawn for the samples of a batch: by sample, by sensor of a series, and from what a study found.

    sample   of [sample], anew in every image
    unit     of [unit], once for each sensor of a series, which makes `per_unit` images
    posterior  the values that a study calibrated, jointly Gaussian with their covariance, once for each sensor

A draw depends on the seed, the number of the image or sensor, and the key alone."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from optics.errors import OutOfBounds, UnknownKey
from optics.scene.loader import Scene
from optics.scene.parameter import Parameter
from optics.study.fit_files import Posterior

if TYPE_CHECKING:
    from optics.study.batch import Job

Finite = Annotated[float, Field(allow_inf_nan=False)]
Value = Finite | str
Pair = Annotated[list[Finite], Field(min_length=2, max_length=2)]

ATTEMPTS = 10_000  # draws among which one lies within all bounds; twelve values found at a bound need 4096


class BadJob(ValueError):
    """A job file that contradicts its format or its scene."""


class Strict(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class Distribution(Strict):
    """A distribution of values: exactly one of them is given."""

    uniform: Pair | None = Field(None, description="[low, high], low < high")
    log_uniform: Pair | None = Field(None, description="[low, high], 0 < low < high")
    normal: Pair | None = Field(None, description="[mean, standard deviation], the second above 0")
    choice: Annotated[list[Value], Field(min_length=1)] | None = Field(None, description="a list of numbers or texts")
    grid: Annotated[list[Value], Field(min_length=1)] | None = Field(None, description="a list of numbers or texts")
    plausible: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = Field(
        None, description="a number above 0, times the plausible size of the parameter"
    )

    @model_validator(mode="after")
    def _one(self) -> Distribution:
        given = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(
                f"{' and '.join(given) or 'nothing'} given; allowed: exactly one of "
                f"{', '.join(type(self).model_fields)}"
            )
        pair = self.uniform or self.log_uniform
        if pair and not pair[0] < pair[1]:
            raise ValueError(f"{given[0]} = {pair}; allowed: [low, high] with low < high")
        if self.log_uniform and not self.log_uniform[0] > 0:
            raise ValueError(f"log_uniform = {self.log_uniform}; allowed: [low, high] with 0 < low")
        if self.normal and not self.normal[1] > 0:
            raise ValueError(f"normal = {self.normal}; allowed: [mean, standard deviation] with the second above 0")
        return self

    def draw(self, rng: np.random.Generator) -> float | str:
        """A value; of `plausible` the change, in plausible sizes, before the bounds of a parameter cut it."""
        if self.plausible is not None:
            return float(rng.normal(0.0, self.plausible))
        if self.uniform:
            return float(rng.uniform(self.uniform[0], self.uniform[1]))
        if self.log_uniform:
            return float(np.exp(rng.uniform(*np.log(self.log_uniform))))
        if self.normal:
            return float(rng.normal(self.normal[0], self.normal[1]))
        assert self.choice is not None, "a grid is counted, not drawn"
        return self.choice[int(rng.integers(len(self.choice)))]

    @property
    def extremes(self) -> list[float | str]:
        """The extreme values of all draws, for a check of bounds; none for what has no ends."""
        return [*(self.uniform or self.log_uniform or self.choice or self.grid or [])]


def stream(seed: int, number: int, purpose: str) -> np.random.Generator:
    """The random stream of one image or sensor for one purpose."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number, zlib.crc32(purpose.encode()))))


@dataclass(frozen=True)
class Drawn:
    """One number or word that is drawn: the keys that take it, and from what."""

    name: str
    keys: tuple[str, ...]
    parameter: Parameter
    distribution: Distribution
    unit: bool

    def around(self, value: float, seed: int, number: int) -> float:
        """A value of a `plausible` distribution about `value`, the first that lies within the bounds."""
        rng, (low, high) = stream(seed, number, self.purpose), self.parameter.bounds
        for _ in range(ATTEMPTS):
            found = value + self.parameter.plausible * float(self.distribution.draw(rng))
            if low <= found <= high:
                return found
        raise OutOfBounds(self.name, found, self.parameter.unit, (low, high), "plausible draws")

    @property
    def purpose(self) -> str:
        return f"unit {self.name}" if self.unit else self.name


class Draws:
    """All that a job draws in a scene.

    values      what is not drawn, by key: the fit's values and the job's
    posterior   of the job's fit; None: the job asks for none
    levels      key -> drive level that multiplies a calibrated power (optics.study.calibrated)

    Raises UnknownKey for what is neither a parameter nor an effect, BadJob for a distribution that does not fit it.
    """

    def __init__(
        self,
        job: Job,
        scene: Scene,
        values: Mapping[str, Any],
        where: Path,
        posterior: Posterior | None = None,
        levels: Mapping[str, float] | None = None,
    ):
        self.job, self.values, self.where = job, {**scene.values(), **values}, where
        self.drawn = [
            d
            for table, unit in ((job.sample, False), (job.unit, True))
            for key, distribution in table.items()
            for d in _resolved(scene, key, distribution, unit, f"{where}: [{'unit' if unit else 'sample'}]")
        ]
        own = {key for d in self.drawn for key in d.keys} | set(job.parameters)
        self.posterior = None
        if posterior is not None:
            self.posterior = _selected(posterior, job.posterior, own, f"{where}: posterior")
            self.levels = dict(levels or {})
            self.parameters = [scene.parameters[keys[0]] for keys in self.posterior.keys]

    @property
    def keys(self) -> list[str]:
        posterior = () if self.posterior is None else [key for keys in self.posterior.keys for key in keys]
        return [*(key for d in self.drawn for key in d.keys), *posterior]

    @property
    def serial(self) -> bool:
        """Whether the images are of a series of sensors."""
        return self.posterior is not None or bool(self.job.unit) or self.job.per_unit > 1

    def unit_of(self, index: int) -> int:
        return index // self.job.per_unit

    def at(self, index: int) -> dict[str, float | str]:
        """What is drawn for the image of this index, by key."""
        unit = self.unit_of(index)
        found: dict[str, Any] = self._calibrated(unit)
        plain = self.job.values(index)
        for d in self.drawn:
            if d.distribution.plausible is not None:
                about = float(found.get(d.keys[0], self.values[d.keys[0]]))
                value: Any = d.around(about, self.job.seed, unit if d.unit else index)
            else:
                value = plain[d.name]
            found.update(dict.fromkeys(d.keys, value))
        return found

    def _calibrated(self, unit: int) -> dict[str, float]:
        """A draw of the posterior within all bounds, or nothing."""
        if self.posterior is None:
            return {}
        rng = stream(self.job.seed, unit, "posterior")
        low, high = np.transpose([p.bounds for p in self.parameters])
        outside = np.zeros(len(low), int)
        for _ in range(10):
            draws = self.posterior.draw(ATTEMPTS // 10, rng)
            out = (draws < low) | (draws > high)
            if not out.any(1).all():
                chosen = draws[np.argmin(out.any(1))]
                return {
                    key: float(self.levels.get(key, 1.0) * value)
                    for keys, value in zip(self.posterior.keys, chosen)
                    for key in keys
                }
            outside += out.sum(0)
        raise BadJob(
            f"{self.where}: posterior: none of {ATTEMPTS} draws lies within all bounds; most often outside is "
            f"{self.posterior.names[int(np.argmax(outside))]}; leave it out: posterior = [patterns of the others]"
        )


def _resolved(scene: Scene, key: str, distribution: Distribution, unit: bool, where: str) -> list[Drawn]:
    """A key, or the variables of an effect that is named."""
    if key in scene.parameters:
        parameter = scene.parameters[key]
        if distribution.plausible is not None and not parameter.is_number:
            raise BadJob(f"{where}: {key} is a word and no number; allowed: choice")
        return [Drawn(key, (key,), parameter, distribution, unit)]
    effects = {effect.name: effect for effect in scene.registry.effects.values()}
    if key not in effects:
        raise UnknownKey(
            key,
            [*scene.parameters, *effects],
            "parameter",
            where,
            "`optics params SCENE` and `optics effects` list them",
        )
    effect = effects[key]
    if distribution.plausible is None:
        raise BadJob(f"{where}: {key} is an effect; allowed: {{ plausible = 1 }}, in plausible sizes of its parameters")
    if not scene.can_express(effect):
        raise BadJob(f"{where}: {scene.path} cannot express '{key}': it lacks a {effect.part}; `optics effects`")
    found = []
    for name, keys in scene.keys_of(effect).items():
        groups = [tuple(keys)] if effect.per == "kind" else [(one,) for one in keys]
        parameter = scene.registry.parameter(effect.part, name)
        if parameter.is_number:
            found += [Drawn(group[0], group, parameter, distribution, unit) for group in groups]
    return found


def _selected(posterior: Posterior, asked: bool | list[str], own: set[str], where: str) -> Posterior:
    """The variables that match the patterns of a job, and that it neither sets nor draws otherwise."""
    patterns = ["*"] if isinstance(asked, bool) else asked
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in posterior.names):
            raise UnknownKey(pattern, posterior.names, "variable", where, "the fit found no such")
    kept = [
        i
        for i, (name, keys) in enumerate(zip(posterior.names, posterior.keys))
        if any(fnmatchcase(name, pattern) for pattern in patterns) and not own & set(keys)
    ]
    if not kept:
        raise BadJob(f"{where}: the job sets or draws every value itself; leave posterior out, or these values")
    return posterior.only(kept)
