"""The one vocabulary: a parameter of a part of the scene, with its key, unit, bounds and neutral value.

Settings, free parameters and effects are roles that a parameter plays; see `optics.scene.registry` for the
declarations."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from optics.errors import OutOfBounds, UnknownKey
from optics.words import Reach, spaced

HOW = ("ad", "difference", "image", "layer", "path")
FREE = ("", "all", "press", "crowd")
LARGEST = 1e18  # of any number: squares of larger ones overflow in single precision, in which images are computed
FALL = 10.0  # a linearisation lowers a factor to no less than this part of it: at 0 it would hide everything else
ROLES = {  # of parameters: what the library turns, sets or solves for, whatever a part calls it
    "power": "scales all light of a light; 0 switches it off",
    "power gain": "scales all light of a light in single frames",
    "band power": "share of the power in one spectral band (`band`)",
    "light x": "where a point light stands, right, mm",
    "light y": "where a point light stands, down, mm",
    "light z": "where a point light stands, from the camera towards the skin, mm",
    "light pan": "turn of a point light's axis about its up axis, deg",
    "light tilt": "turn of a point light's axis about its side axis, deg",
    "light turn": "turn of a point light about the axis of the board that it stands on, deg",
    "light wavelength": "peak of a light's spectrum, nm; 0: white",
    "light width": "full width at half maximum of a light's spectrum, nm",
    "light area": "emitting area of a point light, mm^2; 0: a point",
    "second bounce": "weight of light that the skin reflects twice",
    "exposure": "full scale of the camera per unit of radiance",
    "pupil": "area of the camera's entrance pupil, mm^2; 0: a pinhole",
    "focus": "distance from the camera at which its lens is sharp, mm",
    "press x": "where the skin is pressed, right, mm",
    "press y": "where the skin is pressed, down, mm",
    "press depth": "how deep the skin is pressed, mm; 0: untouched",
    "thickness": "of the skin, mm",
    "width": "of a skin or a sheet along x, mm",
    "length": "of a skin or a sheet along y, mm",
    "distance": "from the untouched skin to an object, mm",
    "angle": "turn of a film about its normal, deg",
    "inserted": "1 where a film is in the beam, 0 where it is taken out",
    "face": "share of light that each face of a film reflects",
    "clock": "when a frame was taken",
    "approach": "from which side a setting was reached",
    "regions": "a word: the map of regions on a surface (optics.scene.regions)",
    "region": "a word: the number of the region that a layer covers",
}


@dataclass(frozen=True)
class Parameter:
    """One physical quantity of a part: `led.power`, `membrane.sigma`, `camera.x_fov`.

    name        as written in XML, unique within its part
    unit        mm, deg, nm, 1/mm, DN, px, 1 ...
    default     value when the XML does not give one
    bounds      (low, high), closed
    doc         what it means, in one sentence, with its symbol in the source
    neutral     value at which its effect vanishes; None where it has none (a position has no neutral value)
    plausible   the size of a change that a real sensor shows; sets steps and scales, > 0
    step        half width of a central difference, in plausible sizes: narrow where the image bends, wide where an edge
                that moves changes a rim's pixel by jumps of one sample
    how         how its derivative image is made: 'ad' (forward mode through the render), 'difference' (central, common
                random numbers: it moves shadows or geometry), 'image' (arithmetic on the linear images), 'layer'
                (complex step through the Mueller matrices of the layers and the Stokes vectors of sources), 'path' (by
                the lengths of the ways that light took through dielectric bodies)
    squared     True where the image depends on the square of it (a roughness): a fit steps in the square, whose onset
                is linear, and stays above a thousandth of `plausible`
    saturates   of a squared parameter s: the value v beyond which its effect levels off; a fit steps in s^2/(1 +
                s^2/v^2)
    linear      True where the image is exactly linear in it (one render serves every value)
    multiplies  True of a factor on the light that passes (a transmittance, a gain) in which the image need not be
                linear: a fit that stepped it to 0 would see nothing of anything else
    starts      values at which a search begins besides the present one, of what a fit cannot reach step by step from
                there: other orders of a retardance, other quadrants of an unknown zero
    period      change that makes no difference: half a turn of a film's zero; a fit ends within half of it from neutral
    pair        name of the part's parameter that is the other component of the same vector; `starts` are then its
                lengths, each taken in eight directions
    through     name of the part's setting, or 'clock' for the scene's, through whose changes alone it shows: where
                that has one value in all frames, it acts as other parameters do (a wobble as a transmittance, a scale
                as an offset), and no effect frees it there
    when_pressed    True where it does nothing while nothing presses: images of the gel at rest serve all its values
    role        what it is to the library, one of ROLES; '' for what only the part itself and effects read
    band        number of the spectral band that it belongs to, from 0; None: of all bands
    free        what a calibration solves for unless its setup says otherwise: 'all' (one value for all frames), 'press'
                (a value for each group of frames), 'crowd' (one value, where a crowd of balls shows where the camera
                stands), '' (not)
    prior_sd    standard deviation of the prior about the scene's value that holds where it is free by `free`; None: no
                prior
    choices     the allowed words, for a parameter that is a choice and not a number; files: endings of files that serve
                as well
    """

    name: str
    unit: str
    default: float | str
    bounds: tuple[float, float] = (-math.inf, math.inf)
    doc: str = ""
    neutral: float | None = None
    plausible: float = 1.0
    how: str = "ad"
    step: float = 0.1
    linear: bool = False
    multiplies: bool = False
    starts: tuple[float, ...] = ()
    period: float = math.inf
    pair: str = ""
    through: str = ""
    when_pressed: bool = False
    squared: bool = False
    saturates: float = math.inf
    role: str = ""
    band: int | None = None
    free: str = ""
    prior_sd: float | None = None
    choices: tuple[str, ...] = ()
    files: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.role and self.role not in ROLES:
            raise ValueError(f"parameter {self.name}: role = {self.role!r} is none of {', '.join(ROLES)}")
        if self.free not in FREE:
            raise ValueError(f"parameter {self.name}: free = {self.free!r} is none of {', '.join(map(repr, FREE))}")
        if self.how not in HOW:
            raise ValueError(f"parameter {self.name}: how = {self.how!r} is none of {', '.join(HOW)}")
        if not self.choices:
            for value, where in ((self.default, "declaration"), *((start, "a start") for start in self.starts)):
                if not self.bounds[0] <= float(value) <= self.bounds[1]:
                    raise OutOfBounds(self.name, float(value), self.unit, self.bounds, where)

    @property
    def is_number(self) -> bool:
        return not self.choices

    @property
    def differentiable(self) -> bool:
        return self.is_number

    @property
    def reach(self) -> Reach:
        """What its value can be, for text."""
        return Reach(*self.bounds, self.plausible)

    @property
    def factor(self) -> bool:
        """Whether the image is proportional to it, or a part of the image is: a power, a reflectance, a
        transmittance. 0 switches that off, and is no place that a fit may step to from above."""
        return (self.linear or self.multiplies) and self.neutral != 0 and self.bounds[0] == 0

    def lowest(self, value: float) -> float:
        """How far down one linearisation may lead: to the lower bound, of a factor above 0 to a tenth of its value."""
        return value / FALL if self.factor and value > 0 else self.bounds[0]

    def coordinate(self, value: float) -> float:
        """u(value): what a fit steps in, so that the image is nearly linear in it."""
        return value**2 / (1 + (value / self.saturates) ** 2) if self.squared else value

    def at_coordinate(self, u: float) -> float:
        """The inverse of `coordinate`; u below 0 counts as 0."""
        return math.sqrt(max(u, 0.0) / max(1 - u / self.saturates**2, 1e-12)) if self.squared else u

    def stepped(self, value: float, du: float, bent: bool = True) -> float:
        """Where a step of du in the coordinate leads. A factor, such as a power, moves by its logarithm if `bent`: what
        it multiplies may shrink by as much (brightness and reflectance), and the image stays. Beyond e times the value
        it goes on straight, as a logarithm that overshoots does so without measure."""
        if not bent or not self.factor or value <= 0:
            return self.at_coordinate(self.coordinate(value) + du)
        t = du / value
        return value * (math.exp(t) if t < 1 else math.e * t)

    def per_coordinate(self, value: float) -> float:
        """d value / d u; infinite at 0 of a squared parameter."""
        if not self.squared:
            return 1.0
        return (1 + (value / self.saturates) ** 2) ** 2 / (2 * value) if value else math.inf

    @property
    def near(self) -> float:
        """What is nearer than this to a bound stands at it."""
        return 1e-6 * self.plausible

    def side(self, value: float) -> int:
        """+1 at the lower bound, from which it may only rise; -1 at the upper; 0 between. A factor, whose scale may be
        any, stands at 0 only where it is 0."""
        low, high = self.bounds
        return 1 if value <= low + (0 if self.factor else self.near) else -1 if value >= high - self.near else 0

    def sides(self, value: float) -> tuple[float, float]:
        """The two values of a central difference, `step` to either side, within bounds."""
        step = self.step * self.plausible
        return max(value - step, self.bounds[0]), min(value + step, self.bounds[1])

    def check(self, value: Any, key: str, where: str = "") -> Any:
        """Return the value in its own type, or raise: not a number, not finite, out of bounds, not a choice."""
        if self.choices:
            if value not in self.choices and not (self.files and str(value).endswith(self.files)):
                raise UnknownKey(
                    str(value),
                    self.choices,
                    f"choice for {key}",
                    where,
                    f"or a file ({', '.join(self.files)})" if self.files else "",
                )
            return str(value)
        try:
            if isinstance(value, (str, bytes, bool)):  # "1.0" in quotes would be kept as text where it is stored
                raise TypeError
            number = float(value)
        except (TypeError, ValueError):
            raise ValueError(
                f"{where + ': ' if where else ''}{key} = {value!r} is not a "
                f"number{f' in {self.unit}' if spaced(self.unit) else ''}; allowed: a number, without quotes or unit"
            ) from None
        if not math.isfinite(number):
            raise ValueError(f"{where + ': ' if where else ''}{key} = {number}{spaced(self.unit)} is not finite")
        if abs(number) > LARGEST:
            raise ValueError(
                f"{where + ': ' if where else ''}{key} = {number:g}{spaced(self.unit)} is beyond what can be computed "
                f"with; allowed: {-LARGEST:g} to {LARGEST:g}{spaced(self.unit)}"
            )
        if not self.bounds[0] <= number <= self.bounds[1]:
            raise OutOfBounds(key, number, self.unit, self.bounds, where)
        return number


def keys_with(parameters: Mapping[str, Parameter], role: str) -> list[str]:
    """The keys of all parameters that have a role, in their order."""
    return [key for key, p in parameters.items() if p.role == role]


def beside(parameters: Mapping[str, Parameter], key: str, role: str) -> str | None:
    """The key of the parameter with this role of the part that `key` belongs to; None where the part has none."""
    part = key.rpartition(".")[0]
    return next((k for k, p in parameters.items() if p.role == role and k.rpartition(".")[0] == part), None)


@dataclass(frozen=True)
class Variable:
    """What a calibration solves for: one number that sets one or several parameters, in all frames or in some.

    name      shown to the user; the key itself, or `led.size` for a value shared by all parts of a kind,
              or `gel.press_x[press-03]` for a value of some frames
    keys      the scene parameters that take the value
    frames    indices of the frames that it holds in; None: all
    parameter the declaration (unit, bounds, plausible size)
    prior     (mean, standard deviation) or None
    weight    how many times the prior counts beside chi2 (optics.fit.tempering)
    """

    name: str
    keys: tuple[str, ...]
    parameter: Parameter
    frames: tuple[int, ...] | None = None
    prior: tuple[float, float] | None = None
    weight: float = 1.0

    @property
    def precision(self) -> float:
        """1/variance of the prior as it counts beside chi2; 0 without a prior."""
        return 0.0 if self.prior is None else self.weight / self.prior[1] ** 2

    def holds_in(self, frame: int) -> bool:
        return self.frames is None or frame in self.frames

    def with_prior(self, mean: float, sd: float) -> Variable:
        return replace(self, prior=(float(mean), float(sd)))


@dataclass
class Values:
    """Values of parameters by key, for all frames and, above those, for single frames."""

    common: dict[str, Any] = field(default_factory=dict)  # numbers, and words of choices
    frame: dict[int, dict[str, Any]] = field(default_factory=dict)

    def at(self, frame: int, base: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """base <- common <- this frame's own."""
        return {**(base or {}), **self.common, **self.frame.get(frame, {})}

    def put(self, variable: Variable, value: float) -> None:
        if variable.frames is None:
            for key in variable.keys:
                self.common[key] = float(value)
        else:
            for index in variable.frames:
                self.frame.setdefault(index, {}).update({key: float(value) for key in variable.keys})

    def without(self, variables: Iterable[Variable], given: Mapping[str, Any]) -> Values:
        """These but for the variables', in held-out frames too: they have what is `given` by key, else the values of
        scene and captures."""
        common = {key for v in variables if v.frames is None for key in v.keys}
        own = {key for v in variables if v.frames is not None for key in v.keys}
        return Values(
            {
                **{key: value for key, value in self.common.items() if key not in common},
                **{key: value for key, value in given.items() if key in common | own},
            },
            {i: {key: value for key, value in at.items() if key not in own} for i, at in self.frame.items()},
        )

    def record(self) -> dict[str, dict]:
        """As JSON keeps them, for `of_record`."""
        return {"common": dict(self.common), "frame": {str(i): dict(own) for i, own in self.frame.items()}}

    @classmethod
    def of_record(cls, kept: Mapping[str, Any]) -> Values:
        return cls(dict(kept["common"]), {int(i): dict(own) for i, own in kept["frame"].items()})

    def copy(self) -> Values:
        return Values(dict(self.common), {index: dict(own) for index, own in self.frame.items()})
