"""What Mitsuba needs of a part: the variant, the plugin classes built for it, and a base that reads and exposes
parameters."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import sys
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from functools import wraps
from pathlib import Path

from optics.doctor import PlatformError
from optics.errors import BadPlugin, BadScene, UnknownKey
from optics.scene.declare import IMAGE_STAGES, Part
from optics.scene.line import EDGES
from optics.scene.parameter import Parameter
from optics.scene.regions import found_file
from optics.scene.registry import Registry, default, include
from optics.spectra.curve import Curve

VARIABLE = "OPTICS_VARIANT"  # of the environment: the variant where none is named
DEFAULT_VARIANT = os.environ.get(VARIABLE, "").strip() or "llvm_ad_spectral_polarized"
_loading: ContextVar[Registry | None] = ContextVar("registry", default=None)  # of the scene that is being loaded
_coarseness: ContextVar[int] = ContextVar("coarseness", default=1)  # of the meshes that are being made
_registered: dict[str, dict[str, str]] = {}  # variant -> kind -> category that Mitsuba knows it in
_watching = False  # whether Mitsuba tells us when its variant changes
_made = itertools.count()  # numbers the parts in the order in which they were made


def use_variant(variant: str = DEFAULT_VARIANT, registry: Registry | None = None) -> None:
    """Set the Mitsuba variant and register the plugins of a registry for it (None: those that every scene knows).

    Scalar variants are refused: Python plugins run 30-120 times slower in them and emitters fail. Raises PlatformError
    where the machine cannot run the variant.
    """
    from optics.doctor import require_llvm

    _refuse_scalar(variant)
    if variant.startswith("llvm"):
        require_llvm()
    import drjit as dr
    import mitsuba as mi

    if variant not in mi.variants():
        raise UnknownKey(variant, [v for v in mi.variants() if not v.startswith("scalar")], "variant")
    if variant.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise PlatformError(
            f"variant {variant}: no NVIDIA GPU that Dr.Jit can use; allowed: {variant.replace('cuda', 'llvm', 1)}; "
            f"leave --variant and {VARIABLE} away, or see `optics doctor` for the variants of this machine"
        )
    if mi.variant() != variant:
        mi.set_variant(variant)
        mi.set_log_level(mi.LogLevel.Error)
    _prepare(registry or default(), variant)


def register(plugins: str | Path | list[str | Path] | None = None) -> None:
    """Make the parts known to plain Mitsuba, in the present variant and in every one that is set later.

    plugins   a folder of your own plugins, or several, that all scenes of this process know from now on

    Edited plugin files are taken up. Raises RuntimeError where no variant is set yet, ValueError in a scalar one.
    """
    import mitsuba as mi

    global _watching
    variant = mi.variant()
    if variant is None:
        raise RuntimeError(
            f'no Mitsuba variant is set; call mitsuba.set_variant("{DEFAULT_VARIANT}") before optics.register()'
        )
    _refuse_scalar(variant)
    registry = include(*([] if plugins is None else [plugins] if isinstance(plugins, (str, Path)) else plugins))
    _prepare(registry, variant)
    if not _watching:
        mi.detail.add_variant_callback(_follow_variant)
        _watching = True


def _follow_variant(old: str | None, new: str) -> None:
    """After mi.set_variant: Mitsuba's plugins belong to a variant."""
    if not new.startswith("scalar"):
        _prepare(default(), new)


def _refuse_scalar(variant: str) -> None:
    if variant.startswith("scalar"):
        raise ValueError(f"variant {variant}: scalar variants are not supported; use {DEFAULT_VARIANT}")


def _prepare(registry: Registry, variant: str) -> None:
    """Build a registry's classes for the present variant, and have Mitsuba ask for them by the names of their kinds.

    Mitsuba's names are global: each kind is registered once per variant, with a constructor that asks which registry
    is meant."""
    import mitsuba as mi

    if variant not in registry.classes:
        registry.classes[variant] = {kind: _built(registry, part) for kind, part in registry.parts.items()}
    names = _registered.setdefault(variant, {})
    for kind, part in registry.parts.items():
        if names.get(kind) != part.category:
            getattr(mi, f"register_{part.category}")(kind, _constructor(kind, variant))
            names[kind] = part.category


def _constructor(kind: str, variant: str) -> Callable:
    def construct(props):
        registry = _loading.get() or default()
        if kind not in registry.parts:
            raise BadScene(
                f"the type '{kind}' is of another scene's plugins; load this scene with the folder that holds it, or "
                "name the folder in optics.register(plugins=...)"
            )
        if variant not in registry.classes:
            _prepare(registry, variant)
        return registry.classes[variant][kind](props)

    return construct


class loading:
    """Context in which Mitsuba makes the parts of one registry."""

    def __init__(self, registry: Registry):
        self.registry = registry

    def __enter__(self):
        self.token = _loading.set(self.registry)

    def __exit__(self, *_):
        _loading.reset(self.token)


@contextlib.contextmanager
def coarser(times: int) -> Iterator[None]:
    """Context in which scenes are loaded for an image of so many times fewer pixels each way: parts may make their
    meshes as much coarser (`coarseness`)."""
    token = _coarseness.set(times)
    try:
        yield
    finally:
        _coarseness.reset(token)


def coarseness() -> int:
    """How many times coarser a mesh may be than the scene says."""
    return _coarseness.get()


def _built(registry: Registry, part: Part) -> type:
    """The Mitsuba class of a part, which parameters must not hide anything of."""
    cls = part.build()
    cls.registry, cls.role = registry, part.role
    if part.category == "bsdf":
        for name in ("sample", "eval", "pdf", "eval_pdf", "eval_null_transmission"):
            if name in dir(cls):
                setattr(cls, name, _once_wired(getattr(cls, name)))
    for p in registry.parameters_of(part.kind):
        if is_taken(p.name, cls):
            files = [
                e.file
                for e in registry.effects.values()
                if part.kind in registry.carriers(e) and p in (*e.parameters, *e.shape)
            ]
            raise BadPlugin(
                f"{files[0] if files else part.file}: parameter '{p.name}' has the name of something else that the "
                "part "
                f"'{part.kind}' has; choose another name"
            )
    return cls


def _once_wired(method: Callable) -> Callable:
    """A method of a material that must not be asked before the material knows its neighbours."""

    @wraps(method)
    def asked(self, *given, **more):
        answer = method(self, *given, **more)
        if not self._waits:
            return answer
        scene = _rendered()
        if scene is None:
            return _nan(answer)
        if any(shape.bsdf() is self for shape in scene.shapes()):
            raise BadScene(
                f"{self._waits}, and the parts of this scene are not connected yet; the integrator 'tactile' does "
                "that at its first image; call optics.wire(scene) before you render with another integrator"
            )
        return answer  # Dr.Jit traces every material alive, those of other scenes as well

    return asked


def _rendered():
    """The scene that is being rendered: what a caller of Mitsuba, such as mi.render, has as `scene`; None if unknown.
    A material knows neither its scene nor who asks."""
    import mitsuba as mi

    frame = sys._getframe(2)
    while frame is not None:
        scene = frame.f_locals.get("scene")
        if isinstance(scene, mi.Scene):
            return scene
        frame = frame.f_back
    return None


def _nan(answer):
    """A material's answer with its weights made NaN: better no image than a wrong one."""
    if isinstance(answer, tuple):  # (sample, weight) or (value, density): the weight is the spectrum
        return tuple(_nan(part) if _is_weight(part) else part for part in answer)
    return answer * math.nan


def _is_weight(thing) -> bool:
    import mitsuba as mi

    return isinstance(thing, mi.Spectrum)


class Neighbour:
    """An attribute: another part of the same scene, or None.

    It is held weakly: the scene holds all its parts, and Python never lets go of a ring of references that runs through
    Mitsuba."""

    def __set_name__(self, owner, name):
        self.name = f"_{name}"

    def __get__(self, part, owner=None):
        known = part.__dict__.get(self.name) if part is not None else None
        return None if known is None else known()

    def __set__(self, part, neighbour):
        part.__dict__[self.name] = None if neighbour is None else weakref.ref(neighbour)


class Declared:
    """What every part can do: read its declared parameters from XML, expose them, know its effects and its neighbours.

    A plugin class derives from `Declared.on(mi.BSDF)` and names its `kind` (Mitsuba's classes allow one base only).
    A part that depends on others of its scene says so in `wire`, and follows them in `place`.
    """

    kind: str
    registry: Registry  # that it was built for
    role: str
    band: float | None = None  # nm: what a mono variant renders, where the scene's integrator names one band
    unrendered: Mapping[str, str] = {}  # parameters without a derivative through mi.render, and why
    curves: Mapping[str, Curve] = {}  # spectra that it was given, by the name of the attribute in XML
    _integral = None  # reference to that of the scene; a part must not hold its scene, which Mitsuba has hold the part
    lane = None  # of lights and pigments whose spectrum is in the integral's matrix: 1 in the lanes that are theirs
    region_size = 0.0  # mm across a map of regions; 0: as wide as the camera sees
    _wired = False
    _waits = ""  # of a material: why it cannot be asked before its scene is wired
    _leaders = ()
    _followers = ()

    @staticmethod
    def on(base: type) -> type:
        """A subclass of a Mitsuba class that has the methods of this one."""
        return type(
            f"Declared{base.__name__}",
            (base,),
            {n: f for n, f in vars(Declared).items() if not n.startswith("__") and n not in ("on", "on_mesh")},
        )

    @staticmethod
    def on_mesh() -> type:
        """`on(mi.Mesh)` for a shape that makes its own vertices: `rebuild(params)` follows every change of its
        parameters, and of the parts that it follows."""
        import mitsuba as mi

        class DeclaredMesh(Declared.on(mi.Mesh)):
            moved_by = ""  # role of the part that it moves with

            def declare(self, props):
                super().declare(props)
                if self.moved_by and is_part(self.bsdf()) and not self.bsdf()._waits:
                    self.bsdf()._waits = f"'{self.name}' moves with the part '{self.moved_by}'"
                if _loading.get() is None:  # Mitsuba's own loader merges meshes of one material, which then do not move
                    self.add_attribute("face_own", 1, [0.0] * self.face_count())

            def traverse(self, cb):
                mi.Mesh.traverse(self, cb)
                self.put_parameters(cb)

            def parameters_changed(self, keys=()):
                if any(key in self.numbers for key in keys) or not keys:
                    self.reread(keys)
                    if self.placed_by(keys):
                        move([self])
                else:
                    mi.Mesh.parameters_changed(self, list(keys))

            def place(self):
                self.rebuild(mi.traverse(self))

        return DeclaredMesh

    def declare(self, props) -> None:
        """Read every declared parameter from `props` (unknown ones stay for Mitsuba to complain about)."""
        import mitsuba as mi

        self.name = props.id()
        self.numbers: dict[str, Parameter] = {}
        self.words: dict[str, Parameter] = {}
        self.held: dict[str, float] = {}  # the numbers as Python floats, to ask without waiting for the device
        self._order = next(_made)
        self._folders = tuple(str(folder) for folder in mi.file_resolver())
        self.curves = {}
        if any(p.role == "regions" for p in self.registry.parameters_of(self.kind)):
            self.read_map_size(props)
        for p in self.registry.parameters_of(self.kind):
            value = p.check(props.get(p.name, p.default), f"{self.name}.{p.name}", "scene")
            if p.is_number:
                self.numbers[p.name] = p
                self.hold(p.name, value)
            else:
                self.words[p.name] = p
                setattr(self, p.name, value)

    def find_file(self, name: str) -> Path:
        """A file that the scene names, beside the scene's file or where Mitsuba looks for files."""
        return found_file(self._folders, name)

    def read_spectrum(self, props, name: str, kind: str) -> Curve | None:
        """The curve that an attribute names (optics.spectra.reading), or a spectrum of Mitsuba's, kept in `curves`;
        None without it."""
        from optics.scene.surfaces import curve_of
        from optics.spectra.reading import read_curve

        given, where = props.get(name) if name in props else "", f"{self.name}.{name}"
        if not isinstance(given, str):
            self.curves[name] = curve_of(given, kind, where)
        elif given.strip():
            self.curves[name] = read_curve(given, kind, self._folders, where)
        return self.curves.get(name)

    def read_sensitivities(self, text: str, name: str) -> tuple[Curve, ...]:
        """The curves of a camera's channels that an attribute names."""
        from optics.spectra.reading import read_channels

        return read_channels(text, self._folders, f"{self.name}.{name}")

    def by_colour(self, first, second, third, wavelengths):
        """A spectrum of three values: of the first three bands; where channels are integrals, of the wavelengths from
        580 nm on, from 500 nm on, and below. A fourth band has 1."""
        import drjit as dr
        import mitsuba as mi

        if self._integral is None:
            return mi.UnpolarizedSpectrum(*(first, second, third, mi.Float(1.0))[: dr.size_v(mi.UnpolarizedSpectrum)])
        return self.in_range(first, second, third, mi.UnpolarizedSpectrum(wavelengths))

    def in_range(self, first, second, third, nm):
        """A spectrum of three values: from 580 nm on, from 500 nm on, and below."""
        import drjit as dr

        return dr.select(nm >= EDGES[0], first, dr.select(nm >= EDGES[1], second, third))

    def nm(self, wavelengths):
        """Wavelengths as a spectrum; in a mono variant that of its band, 540 nm where it names none."""
        import mitsuba as mi

        return mi.UnpolarizedSpectrum(wavelengths if mi.is_spectral else self.band or 540.0)

    @property
    def integral(self):
        """Of scenes whose channels are integrals, the `optics.scene.integral.Integral`; None of others."""
        if self._integral is None:
            return None
        if (found := self._integral()) is None:
            raise ReferenceError(f"the scene of '{self.name}' is gone; keep it as long as its parts")
        return found

    @integral.setter
    def integral(self, integral) -> None:
        self._integral = weakref.ref(integral)

    # -- neighbours ---------------------------------------------------------------------------------------------------
    def wire(self, scene) -> None:
        """Find the neighbours that the part depends on (optics.scene.wiring.Neighbours); called once a scene."""

    def place(self) -> None:
        """Take up what the parts that this one follows have become."""

    def follow(self, *leaders) -> None:
        """Be placed anew whenever one of these parts changes (None and Mitsuba's own objects never do)."""
        self._leaders = tuple(weakref.ref(leader) for leader in leaders if is_part(leader))
        for leader in filter(None, (known() for known in self._leaders)):
            if all(known() is not self for known in leader._followers):
                leader._followers = (*leader._followers, weakref.ref(self))

    def placed_by(self, names=()) -> bool:
        """Whether a change of these parameters (none: of any) moves the part or those that follow it."""
        shaping = self.registry.shaping(self.kind) or self.words
        return any(name in shaping for name in names or (*self.numbers, *self.words))

    # -- parameters ---------------------------------------------------------------------------------------------------
    def traverse(self, cb) -> None:
        self.put_parameters(cb)

    def parameters_changed(self, keys=()) -> None:
        self.reread(keys)

    def put_parameters(self, cb) -> None:
        import mitsuba as mi

        for name in getattr(self, "numbers", ()):
            flags = mi.ParamFlags.Differentiable if self.rendered(name) else mi.ParamFlags.NonDifferentiable
            cb.put(name, getattr(self, name), flags)

    def beyond(self, name: str) -> str:
        """Why Dr.Jit finds no derivative by a parameter through `mi.render`, or a wrong one; empty where it does."""
        known = self.__dict__.setdefault("_beyond", {})  # asked for at every change of a scene
        if name not in known:
            known[name] = self._why_beyond(name)
        return known[name]

    def _why_beyond(self, name: str) -> str:
        if self.numbers[name].how == "image":
            return "it acts on the finished image"
        if name in self.registry.shaping(self.kind):
            return "it moves a surface that is made outside Dr.Jit"
        stages = {
            s
            for e in self.registry.effects.values()
            if name in e.parameter_names and self.kind in self.registry.carriers(e)
            for s in e.stages
        }
        if stages and stages <= {*IMAGE_STAGES, "detector", "glow"}:
            return "it acts on the finished image"
        return self.unrendered.get(name, "")

    def rendered(self, name: str) -> bool:
        """Whether `mi.render` has the derivative by a parameter, away from edges that move."""
        return not self.beyond(name)

    def hold(self, name: str, value: float) -> None:
        """Set a number, as an evaluated variable: a literal would be compiled into every kernel."""
        import drjit as dr
        import mitsuba as mi

        setattr(self, name, dr.opaque(mi.Float, value))
        self.held[name] = float(value)

    def reread(self, keys=()) -> None:
        """After a change through mi.traverse: take the numbers over.

        Raises ValueError where a derivative is asked for that `mi.render` does not have."""
        import drjit as dr

        for name in keys or self.held:
            if name not in self.held:
                continue
            value = getattr(self, name)
            if dr.grad_enabled(value) and not self.rendered(name):
                raise ValueError(
                    f"{self.name}.{name} has no derivative through mi.render: {self.beyond(name)}; allowed: a central "
                    "difference of two images"
                )
            dr.make_opaque(value)  # as in `hold`
            self.held[name] = float(value[0])

    def number(self, name: str) -> float:
        return self.held[name]

    def named(self, role: str) -> str | None:
        """The name of the part's number that has a role (optics.scene.parameter.ROLES); None where it has none."""
        return next((name for name, p in self.numbers.items() if p.role == role), None)

    def numbered(self, role: str) -> float:
        """The number that has a role; raises BadScene where the part declares none."""
        name = self.named(role)
        if name is None:
            raise BadScene(
                f"'{self.name}': the part '{self.kind}' declares no parameter with role={role!r}, which is needed here"
            )
        return self.held[name]

    def word(self, role: str) -> str | None:
        """The name of the part's word that has a role; None where it has none."""
        return next((name for name, p in self.words.items() if p.role == role), None)

    def context(self, words: Mapping[str, str]) -> dict:
        """What the part's functions read besides its parameters, for values of its words."""
        return {}

    def map_of_regions(self, words: Mapping[str, str]):
        """The map of regions (optics.scene.regions.Regions) that the part's words name; None for none."""
        name = self.word("regions")
        return None if name is None or words[name] == "whole" else self.maps(words[name])

    def read_map_size(self, props) -> None:
        self.region_size = float(props.get("region_size", 0.0))

    def place_maps(self, camera, shape) -> None:
        """Maps of regions `region_size` mm wide, or as wide as the camera sees the shape."""
        from optics.scene.regions import Maps, view_width

        self.maps = Maps(self._folders, self.region_size or view_width(camera, shape))

    def takes(self, name: str) -> bool:
        """Whether a parameter does anything where the part stands in its scene."""
        return True

    def active(self, stage: str, own) -> tuple[Callable, ...]:
        """The functions of effects at a stage that do not rest at neutral at the parameters `own`, complex ones among
        them."""
        return tuple(
            e.stages[stage]
            for e in self.registry.at_stage(self.kind, stage)
            if any(getattr(own, n) != self.numbers[n].neutral for n in e.at_rest)
        )

    def functions(self, stage: str) -> tuple[Callable, ...]:
        """The functions of effects at a stage, but for those that rest at neutral and carry no derivative.

        Leaving them out saves time and changes nothing: the contract tests hold every effect to the identity at
        neutral."""
        import drjit as dr

        return tuple(
            e.stages[stage]
            for e in self.registry.at_stage(self.kind, stage)
            if any(
                n in self.held and (self.held[n] != self.numbers[n].neutral or dr.grad_enabled(getattr(self, n)))
                for n in e.at_rest
            )
        )


HELD = ("name", "numbers", "words", "held", "registry", "role")  # what every part holds beside its parameters


def is_taken(word: str, cls: type = Declared) -> bool:
    """Whether a part has something of this name, which a parameter would hide."""
    return word in HELD or hasattr(cls, word)


def is_part(thing) -> bool:
    """Whether a Mitsuba object is a part of ours."""
    return hasattr(type(thing), "put_parameters")


def move(parts) -> bool:
    """Place parts and all that follow them, each once and after those that it follows; whether a shape was among
    them."""
    waiting, wanted = list(parts), []
    while waiting:
        part = waiting.pop()
        if part not in wanted:
            wanted.append(part)
            waiting += [follower for known in part._followers if (follower := known()) is not None]
    wanted.sort(key=lambda part: part._order)
    placed: list = []
    while wanted:
        ready = [p for p in wanted if not any(known() in wanted for known in p._leaders)]
        for part in ready:
            part.place()
        placed += ready
        wanted = [p for p in wanted if p not in ready]
    return any(hasattr(part, "rebuild") for part in placed)
