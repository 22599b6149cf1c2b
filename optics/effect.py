"""Declarations: a part of a sensor, an effect of a part, and the folder they are found in.

A plugin is one file. It holds a module-level `part` (a Mitsuba plugin with its parameters) or an `effect` (one or a few
parameters of a part that rest at their neutral value, and the function that brings them in). Files are found by
scanning folders, never imported by name, so that what ships has no privilege over what a user writes.

Where an effect enters, in the order that light takes (`STAGES`):

    surface     gel       dz = f(x, y, gel)           mm, added to the gel surface; numpy, (N,) arrays
    emission    led       k  = f(beam, led)           factor on the radiance that an LED sends to a point; Dr.Jit
    segment     gel       k  = f(path, gel)           factor on the light along its path in the gel; Dr.Jit
    reflection  membrane  fr = f(geometry, membrane)  added to the BRDF, 1/sr; Dr.Jit
    volume      gel       L  = f(path, gel)           radiance added by the gel itself, per LED; Dr.Jit
    ambient     membrane  L  = f(geometry, membrane)  radiance added that no LED made; Dr.Jit
    glow        interface L  = f(glow, interface)     (B,) radiance that a boundary sends to the camera, per light; numpy
    index       clear     n  = f(n, wavelengths, clear)  refractive index per band; arithmetic of optics.mueller
    absorption  clear     a  = f(a, wavelengths, clear)  absorption coefficient per band, 1/mm; arithmetic of optics.mueller
    layer       a layer   M  = f(crossing, layer)     Mueller matrix that light passes after the layer's own (optics.layers)
    lens        camera    I  = f(image, camera)       irradiance per band, (H, W, B); numpy
    sensor      camera    I  = f(image, camera)       signal per channel, (H, W, C), 1 = full scale; numpy
    response    camera    m  = f(image, camera)       response per channel, 1 = full scale; numpy

`camera` has the camera's parameters, the geometry of its pixels (optics.develop), and in `settings` all values by key, such as `source.time`.
Functions of the stages `lens` and `sensor` are affine in the image, those of `response` act pixel by pixel. All three must
be analytic (no abs, max or branches on their complex arguments): their derivatives are taken by complex step, exact to
rounding (Squire & Trapp, SIAM Rev. 40, 110, 1998). An effect without functions frees parameters that its part has.
"""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

from optics.errors import BadPlugin, UnknownKey
from optics.parameter import Parameter
from optics.words import key_of

STAGES = {
    "surface": "gel", "emission": "led", "segment": "gel", "reflection": "membrane", "volume": "gel",
    "ambient": "membrane", "glow": "interface", "index": "clear", "absorption": "clear", "layer": "", "lens": "camera",
    "sensor": "camera", "response": "camera",
}
IMAGE_STAGES = ("lens", "sensor", "response")
CATEGORIES = ("bsdf", "emitter", "sensor", "shape", "integrator")


@dataclass(frozen=True)
class Part:
    """A part of a sensor: the name of its Mitsuba plugin, its category, its parameters and its class.

    build   called once per Mitsuba variant, returns the plugin class (a subclass of mi.BSDF, mi.Emitter, ...)
    checks  functions without arguments that raise AssertionError: the closed forms that the part must meet
    mueller of a layer: its Mueller matrix (optics.layers);   stokes   of a source: the Stokes vector that it sends
    """

    kind: str
    category: str
    parameters: tuple[Parameter, ...]
    build: Callable[[], type]
    checks: tuple[Callable[[], None], ...] = ()
    doc: str = ""
    file: str = ""
    mueller: Callable | None = None
    stokes: Callable | None = None


@dataclass(frozen=True)
class Effect:
    """A physical effect: parameters that rest at neutral until somebody adds them.

    name        words, as in a sentence: "lens vignetting"
    part        kind of the part that carries it
    parameters  new ones (declared here) or names of parameters that the part already has
    stages      stage -> function: where the physics enters, see the module's text; empty: the part itself does it
    shape       further parameters that the functions use and that stay as they are (a width, an exponent)
    onset       'tangent' (linear at neutral), 'secant' (the derivative at neutral says nothing: a finite step to
                `plausible` is used) or 'both'
    scope       'common' (one value in all frames) or 'frame' (a value per frame)
    per         'kind' (one value shared by all parts of the kind, such as all LEDs) or 'part' (each its own)
    requires    kinds of further parts that a scene must have for the effect to make sense in it
    pictures    True where it mixes the pixels of a picture: point readings cannot have it
    acts        coordinates that it acts through: radius, height, slope, led, channel, frame, intensity ...
    needs       what a capture set must vary for it to be seen, in words
    seek        where an effect has a place that no derivative leads to: f(model, values, frames) -> {key: value} of further parameters
                that do nothing at neutral, found from the residual before the effect is scored or added
    checks      closed forms, as in Part
    """

    name: str
    part: str
    parameters: tuple[Parameter | str, ...]
    stages: Mapping[str, Callable] = field(default_factory=dict)
    shape: tuple[Parameter, ...] = ()
    onset: str = "tangent"
    scope: str = "common"
    per: str = "kind"
    requires: tuple[str, ...] = ()
    pictures: bool = False
    acts: tuple[str, ...] = ()
    needs: str = ""
    seek: Callable | None = None
    checks: tuple[Callable[[], None], ...] = ()
    doc: str = ""
    file: str = ""

    @property
    def key(self) -> str:
        """The name as one word, for the command line: 'lens vignetting' -> 'lens-vignetting'."""
        return key_of(self.name)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return tuple(p if isinstance(p, str) else p.name for p in self.parameters)


@dataclass
class Registry:
    """All parts and effects that were found, by kind and by key."""

    parts: dict[str, Part] = field(default_factory=dict)
    effects: dict[str, Effect] = field(default_factory=dict)
    folders: list[Path] = field(default_factory=list)
    classes: dict[str, dict[str, type]] = field(default_factory=dict)  # variant -> kind -> class

    def parameters_of(self, kind: str) -> tuple[Parameter, ...]:
        """A part's own parameters and those that effects bring to it."""
        own = self.parts[kind].parameters
        brought = [p for e in self.effects.values() if e.part == kind for p in (*e.parameters, *e.shape)
                   if not isinstance(p, str)]
        return own + tuple(brought)

    def parameter(self, kind: str, name: str) -> Parameter:
        for p in self.parameters_of(kind):
            if p.name == name:
                return p
        raise UnknownKey(name, [p.name for p in self.parameters_of(kind)], "parameter", kind)

    def effect_parameters(self, effect: Effect) -> tuple[Parameter, ...]:
        return tuple(self.parameter(effect.part, name) for name in effect.parameter_names)

    def functions(self, kind: str, stage: str) -> tuple[Callable, ...]:
        """The functions that effects bring to a part at a stage, in a fixed order (by key)."""
        return tuple(e.stages[stage] for e in self.at_stage(kind, stage))

    def at_stage(self, kind: str, stage: str) -> tuple[Effect, ...]:
        """The effects that act on a part at a stage, in a fixed order (by key)."""
        return tuple(self.effects[k] for k in sorted(self.effects)
                     if self.effects[k].part == kind and stage in self.effects[k].stages)

    def find_effect(self, name: str) -> Effect:
        key = key_of(name)
        if key not in self.effects:
            raise UnknownKey(name, self.effects, "effect", hint="`optics effects` lists them")
        return self.effects[key]

    # -- adding -----------------------------------------------------------------------------------------------------

    def add(self, item: Part | Effect, file: str) -> None:
        if isinstance(item, Part):
            if item.category not in CATEGORIES:
                raise BadPlugin(f"{file}: category {item.category!r} is none of {', '.join(CATEGORIES)}")
            if item.kind in self.parts:
                raise BadPlugin(f"{file}: a part of the kind '{item.kind}' exists already; choose another kind")
            self.parts[item.kind] = item
            return
        if item.key == "new":
            raise BadPlugin(f"{file}: an effect cannot be called 'new', which is the word for writing one; choose another name")
        if item.key in self.effects:
            raise BadPlugin(f"{file}: the effect '{item.name}' exists already ({self.effects[item.key].file})")
        for stage in item.stages:
            if stage not in STAGES:
                raise BadPlugin(f"{file}: stage {stage!r} is none of {', '.join(STAGES)}")
            if STAGES[stage] not in ("", item.part):
                raise BadPlugin(f"{file}: stage '{stage}' belongs to the part '{STAGES[stage]}', not to '{item.part}'")
        if item.onset not in ("tangent", "secant", "both"):
            raise BadPlugin(f"{file}: onset {item.onset!r} is none of tangent, secant, both")
        for p in item.parameters:
            if isinstance(p, Parameter) and p.neutral is None:
                raise BadPlugin(f"{file}: parameter '{p.name}' of the effect '{item.name}' declares no neutral value")
        self.effects[item.key] = item

    def check(self) -> None:
        """After a scan: every effect's part exists, and no two declare the same parameter."""
        for effect in self.effects.values():
            for kind in (effect.part, *effect.requires):
                if kind not in self.parts:
                    raise BadPlugin(f"{effect.file}: part '{kind}' is none of {', '.join(sorted(self.parts))}")
            if "layer" in effect.stages and self.parts[effect.part].mueller is None:
                raise BadPlugin(f"{effect.file}: stage 'layer' belongs to a layer (a part with a Mueller matrix), which "
                                f"'{effect.part}' is not")
            for name in effect.parameter_names:
                if self.parameter(effect.part, name).neutral is None:
                    raise BadPlugin(f"{effect.file}: {effect.part}.{name} has no neutral value to rest at")
        for kind in self.parts:
            names = [p.name for p in self.parameters_of(kind)]
            twice = {n for n in names if names.count(n) > 1}
            if twice:
                raise BadPlugin(f"part '{kind}': parameter {', '.join(sorted(twice))} is declared twice")

    def scan(self, folder: Path) -> None:
        """Load every plugin file of a folder and its subfolders (names starting with _ or . are passed over)."""
        folder = Path(folder).resolve()
        if folder in self.folders:
            return
        if not folder.is_dir():
            raise BadPlugin(f"{folder}: no such folder of plugins")
        for file in sorted(folder.rglob("*.py")):
            if any(piece.startswith(("_", ".")) for piece in file.relative_to(folder).parts):
                continue
            for item in declared(file):
                self.add(item, str(file))
        self.folders.append(folder)
        self.check()
        self.classes.clear()  # effects may bring parameters to classes that are built already


def declared(file: Path) -> Iterator[Part | Effect]:
    """Execute a plugin file and yield what it declares, with the file's docstring as documentation."""
    name = "optics_plugin_" + re.sub(r"\W", "_", str(file.resolve()))
    spec = importlib.util.spec_from_file_location(name, file)
    module: ModuleType = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise BadPlugin(f"{file}: {type(error).__name__}: {error}") from error
    found = [v for k, v in vars(module).items() if isinstance(v, (Part, Effect)) and not k.startswith("_")]
    if not found:
        raise BadPlugin(f"{file}: declares neither a part nor an effect; files that only help begin with '_'")
    for item in found:
        object.__setattr__(item, "doc", module.__doc__ or "")
        object.__setattr__(item, "file", str(file))
        yield item


def shipped(folder: str) -> Path:
    """The folder `plugins` or `scenes` of a source checkout, or the copy of it inside an installed package."""
    here = Path(__file__).resolve().parent
    for candidate in (here / "_data" / folder, here.parent / folder):
        if candidate.is_dir():
            return candidate
    raise FileNotFoundError(f"the folder '{folder}' of this installation is missing; install the package again")


_registry: Registry | None = None


def registry() -> Registry:
    """The registry of this process; the shipped plugins are scanned at the first call."""
    global _registry
    if _registry is None:
        fresh = Registry()
        fresh.scan(shipped("plugins"))
        _registry = fresh
    return _registry


# -- Mitsuba ------------------------------------------------------------------------------------------------------------

DEFAULT_VARIANT = "llvm_ad_spectral_polarized"


def use_variant(variant: str = DEFAULT_VARIANT) -> None:
    """Set the Mitsuba variant and register the plugin classes for it.

    Classes belong to the variant that they were built under, so they are built once per variant and registered again
    whenever it is set. Scalar variants are refused: Python plugins run 30-120 times slower in them and emitters fail.
    """
    from optics.doctor import require_llvm

    if variant.startswith("scalar"):
        raise ValueError(f"variant {variant}: scalar variants are not supported; use {DEFAULT_VARIANT}")
    if variant.startswith("llvm"):
        require_llvm()
    import mitsuba as mi

    if variant not in mi.variants():
        raise UnknownKey(variant, [v for v in mi.variants() if not v.startswith("scalar")], "variant")
    if mi.variant() != variant:
        mi.set_variant(variant)
        mi.set_log_level(mi.LogLevel.Error)
    reg = registry()
    if variant in reg.classes:
        return
    classes = {kind: _built(reg, part) for kind, part in reg.parts.items()}
    for kind, cls in classes.items():
        getattr(mi, f"register_{reg.parts[kind].category}")(kind, lambda props, cls=cls: cls(props))
    reg.classes[variant] = classes


def _built(reg: Registry, part: Part) -> type:
    """The Mitsuba class of a part, which parameters must not hide anything of."""
    cls = part.build()
    for p in reg.parameters_of(part.kind):
        if is_taken(p.name, cls):
            files = [e.file for e in reg.effects.values() if e.part == part.kind and p in (*e.parameters, *e.shape)]
            raise BadPlugin(f"{files[0] if files else part.file}: parameter '{p.name}' has the name of something else that the part "
                            f"'{part.kind}' has; choose another name")
    return cls


_created: list | None = None  # parts made while a scene is being loaded


class collecting:
    """Context in which the parts that Mitsuba creates are listed, in the order of creation."""

    def __enter__(self) -> list:
        global _created
        self.outer, _created = _created, []
        return _created

    def __exit__(self, *_):
        global _created
        _created = self.outer


class Declared:
    """What every part can do: read its declared parameters from XML, expose them, know its effects.

    A plugin class derives from `Declared.on(mi.BSDF)` and names its `kind` (Mitsuba's classes allow one base only).
    """

    kind: str
    band: float | None = None  # nm: what a mono variant renders, where the scene's integrator names one band

    @staticmethod
    def on(base: type) -> type:
        """A subclass of a Mitsuba class that has the methods of this one."""
        return type(f"Declared{base.__name__}", (base,), {n: f for n, f in vars(Declared).items()
                                                          if (callable(f) or n == "band") and not n.startswith("__")
                                                          and n not in ("on", "on_mesh")})

    @staticmethod
    def on_mesh() -> type:
        """`on(mi.Mesh)` for a shape that makes its own vertices: `rebuild(params)` follows every change of its parameters."""
        import mitsuba as mi

        class DeclaredMesh(Declared.on(mi.Mesh)):
            def traverse(self, cb):
                mi.Mesh.traverse(self, cb)
                self.put_parameters(cb)

            def parameters_changed(self, keys=()):
                if any(key in self.numbers for key in keys) or not keys:
                    self.reread(keys)
                    self.rebuild(mi.traverse(self))
                else:
                    mi.Mesh.parameters_changed(self, list(keys))

        return DeclaredMesh

    def declare(self, props) -> None:
        """Read every declared parameter from `props` (unknown ones stay for Mitsuba to complain about)."""
        self.name = props.id()
        self.numbers: dict[str, Parameter] = {}
        self.words: dict[str, Parameter] = {}
        self.held: dict[str, float] = {}  # the numbers as Python floats, to ask without waiting for the device
        for p in registry().parameters_of(self.kind):
            value = p.check(props.get(p.name, p.default), f"{self.name}.{p.name}", "scene")
            if p.is_number:
                self.numbers[p.name] = p
                self.hold(p.name, value)
            else:
                self.words[p.name] = p
                setattr(self, p.name, value)
        if _created is not None:
            _created.append(self)

    def traverse(self, cb) -> None:
        self.put_parameters(cb)

    def parameters_changed(self, keys=()) -> None:
        self.reread(keys)

    def put_parameters(self, cb) -> None:
        import mitsuba as mi

        for name in getattr(self, "numbers", ()):
            cb.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

    def hold(self, name: str, value: float) -> None:
        """Set a number, as an evaluated variable: a literal would be compiled into every kernel."""
        import drjit as dr
        import mitsuba as mi

        setattr(self, name, dr.opaque(mi.Float, value))
        self.held[name] = float(value)

    def reread(self, keys=()) -> None:
        """After a change through mi.traverse: take the numbers over."""
        for name in keys or self.held:
            if name in self.held:
                self.held[name] = float(getattr(self, name)[0])

    def number(self, name: str) -> float:
        return self.held[name]

    def takes(self, name: str) -> bool:
        """Whether a parameter does anything where the part stands in its scene."""
        return True

    def functions(self, stage: str) -> tuple[Callable, ...]:
        """The functions of effects at a stage, but for those that rest at neutral and carry no derivative.

        Leaving them out saves time and changes nothing: the contract tests hold every effect to the identity at neutral. A part of
        an earlier scene knows no effect that was scanned since.
        """
        import drjit as dr

        return tuple(e.stages[stage] for e in registry().at_stage(self.kind, stage)
                     if any(n in self.held and (self.held[n] != self.numbers[n].neutral or dr.grad_enabled(getattr(self, n)))
                            for n in e.parameter_names))


HELD = ("name", "numbers", "words", "held")  # what every part holds beside its parameters


def is_taken(word: str, cls: type = Declared) -> bool:
    """Whether a part has something of this name, which a parameter would hide."""
    return word in HELD or hasattr(cls, word)


def is_part(thing) -> bool:
    """Whether a Mitsuba object is a part of ours."""
    return hasattr(type(thing), "put_parameters")
