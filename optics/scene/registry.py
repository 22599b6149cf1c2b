"""The registry: all parts and effects of some folders of plugins, by kind and by key; built whole or not at all.

    Registry.of(folders)   the registry of exactly these folders, the same object until one of their files changes
    known(*folders)        of the shipped plugins, of what `include` named, and of these folders
    default()              `known()`, as it was when Mitsuba's plugins were last registered

A registry never changes. A scene owns the one that it was loaded with (`Scene.registry`), so that two scenes with
different plugins live in one process."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from pathlib import Path
from types import MappingProxyType, ModuleType

import numpy as np

from optics.errors import Apart, BadCapture, BadPlugin, BadScene, OutOfBounds, UnknownKey
from optics.files.output import shipped
from optics.scene.declare import CATEGORIES, IMAGE_STAGES, STAGES, Effect, Part
from optics.scene.parameter import Parameter
from optics.scene.trust import plugin_files
from optics.words import key_of

EARLIER = {  # names that modules once had, which plugin files may still import
    "optics.effect": "optics.plugin",
    "optics.parameter": "optics.plugin",
    "optics.layers": "optics.plugin",
    "optics.mueller": "optics.polarization.mueller",
    "optics.bsdf": "optics.scene.surfaces",
    "optics.gel": "optics.skin",
    "optics.gel.contact": "optics.skin.contact",
    "optics.gel.lattice": "optics.skin.lattice",
    "optics.gel.halfspace": "optics.skin.halfspace",
}


@dataclass(frozen=True, eq=False)
class Registry:
    """All parts and effects of some folders, by kind and by key. Two registries are equal if they are the same."""

    parts: Mapping[str, Part]
    effects: Mapping[str, Effect]
    folders: tuple[Path, ...] = ()
    files: tuple[Path, ...] = ()  # that were executed
    classes: dict = field(default_factory=dict, repr=False)  # variant -> kind -> class, built when first needed

    @classmethod
    def of(cls, folders: Iterable[str | Path]) -> Registry:
        """The registry of the plugin files in these folders and their subfolders; raises BadPlugin and leaves nothing
        behind.

        A path may also be that of one plugin file. Names that start with _ or . are passed over. The same folders with
        the same contents give the same registry.
        """
        folders = tuple(dict.fromkeys(Path(folder).resolve() for folder in folders))
        found = dict.fromkeys(file for folder in folders for file in plugin_files(folder))
        files = tuple((file, _content(file.read_bytes())) for file in found)
        known = _registries.get(folders)
        if known is not None and known[0] == files:
            return known[1]
        items = [(file, item) for file, content in files for item in declared(file, content)]
        made = cls.holding(items, folders, tuple(file for file, _ in files))
        _registries[folders] = files, made
        return made

    @classmethod
    def holding(
        cls,
        items: Iterable[tuple[Path | str, Part | Effect]],
        folders: Sequence[Path] = (),
        files: Sequence[Path] = (),
    ) -> Registry:
        """The registry of declarations, each with the file that messages name."""
        parts: dict[str, Part] = {}
        effects: dict[str, Effect] = {}
        for file, item in items:
            _add(parts, effects, item, str(file))
        made = cls(MappingProxyType(parts), MappingProxyType(effects), tuple(folders), tuple(files))
        made.check()
        return made

    @property
    def own_files(self) -> list[Path]:
        """The plugin files that do not ship."""
        home = shipped("plugins").resolve()
        return [file for file in self.files if not file.is_relative_to(home)]

    def name_of(self, file: Path) -> str:
        """A plugin file's path relative to the folder that it was found in; of a file that was named, its name."""
        home = next((folder for folder in self.folders if folder in file.parents), file.parent)
        return file.relative_to(home).as_posix()

    def kinds(self, part: str) -> tuple[str, ...]:
        """The kinds that a name stands for: the part of that kind first, and all that play that role."""
        return self._kinds.get(part, ())

    @cached_property
    def _kinds(self) -> dict[str, tuple[str, ...]]:
        names = {name for part in self.parts.values() for name in (part.kind, part.role)}
        stands = {n: [k for k, part in self.parts.items() if n in (k, part.role)] for n in names}
        return {n: tuple(sorted(kinds, key=lambda k: k != n)) for n, kinds in stands.items()}

    def parameters_of(self, kind: str) -> tuple[Parameter, ...]:
        """A part's own parameters and those that effects bring to it."""
        if kind not in self._parameters:
            brought = [
                p
                for e in self.effects.values()
                if kind in self.carriers(e)
                for p in (*e.parameters, *e.shape)
                if not isinstance(p, str)
            ]
            self._parameters[kind] = self.parts[kind].parameters + tuple(brought)
        return self._parameters[kind]

    @cached_property
    def _parameters(self) -> dict[str, tuple[Parameter, ...]]:
        return {}

    def parameter(self, part: str, name: str) -> Parameter:
        """The declaration of a parameter of a kind, or of the first kind that plays a role and has it."""
        found = [p for kind in self.kinds(part) for p in self.parameters_of(kind)]
        for p in found:
            if p.name == name:
                return p
        raise UnknownKey(name, [p.name for p in found], "parameter", part)

    def effect_parameters(self, effect: Effect) -> tuple[Parameter, ...]:
        return tuple(self.parameter(effect.part, name) for name in effect.parameter_names)

    def functions(self, kind: str, stage: str) -> tuple[Callable, ...]:
        """The functions that effects bring to a part at a stage, in a fixed order (by key)."""
        return tuple(e.stages[stage] for e in self.at_stage(kind, stage))

    def at_stage(self, kind: str, stage: str) -> tuple[Effect, ...]:
        """The effects that act on a part at a stage, in a fixed order (by key)."""
        if (kind, stage) not in self._stages:
            self._stages[kind, stage] = tuple(
                self.effects[k]
                for k in sorted(self.effects)
                if kind in self.carriers(self.effects[k]) and stage in self.effects[k].stages
            )
        return self._stages[kind, stage]

    @cached_property
    def _stages(self) -> dict[tuple[str, str], tuple[Effect, ...]]:
        return {}

    def shaping(self, kind: str) -> frozenset[str]:
        """Names of a shape's parameters that move its surface: its own, and those of effects of the stage `surface`.
        Empty for what is no shape."""
        if self.parts[kind].category != "shape":
            return frozenset()
        brought = (n for e in self.at_stage(kind, "surface") for n in (*e.parameter_names, *(p.name for p in e.shape)))
        return frozenset((*(p.name for p in self.parts[kind].parameters), *brought))

    def carriers(self, effect: Effect) -> tuple[str, ...]:
        """The kinds that carry an effect: of those that its part's name stands for, the ones that have what it
        reads."""
        return tuple(
            k for k in self.kinds(effect.part) if {p.name for p in self.parts[k].parameters}.issuperset(effect.reads)
        )

    def find_effect(self, name: str) -> Effect:
        key = key_of(name)
        if key not in self.effects:
            raise UnknownKey(name, self.effects, "effect", hint="`optics effects` lists them")
        return self.effects[key]

    def check(self) -> None:
        """Every effect's part exists and has what the effect needs, and no two declare the same parameter."""
        for effect in self.effects.values():
            for name in (effect.part, *effect.requires):
                if not self.kinds(name):
                    raise BadPlugin(f"{effect.file}: part '{name}' is none of {', '.join(sorted(self.parts))}")
            if not self.carriers(effect):
                raise BadPlugin(
                    f"{effect.file}: no part '{effect.part}' has all that the effect reads: {', '.join(effect.reads)}"
                )
            for stage in effect.stages:
                if not set(self.kinds(effect.part)) <= set(self.kinds(STAGES[stage]) or self.parts):
                    raise BadPlugin(
                        f"{effect.file}: stage '{stage}' belongs to the part '{STAGES[stage]}', not to '{effect.part}'"
                    )
            if "layer" in effect.stages and any(self.parts[k].mueller is None for k in self.kinds(effect.part)):
                raise BadPlugin(
                    f"{effect.file}: stage 'layer' belongs to a layer (a part with a Mueller matrix), which "
                    f"'{effect.part}' is not"
                )
            for name in effect.parameter_names:
                if self.parameter(effect.part, name).neutral is None:
                    raise BadPlugin(f"{effect.file}: {effect.part}.{name} has no neutral value to rest at")
        for kind in self.parts:
            names = [p.name for p in self.parameters_of(kind)]
            twice = {n for n in names if names.count(n) > 1}
            if twice:
                raise BadPlugin(f"part '{kind}': parameter {', '.join(sorted(twice))} is declared twice")


def _add(parts: dict[str, Part], effects: dict[str, Effect], item: Part | Effect, file: str) -> None:
    """Take one declaration in, or say what is wrong with it by itself."""
    if isinstance(item, Part):
        if item.category not in CATEGORIES:
            raise BadPlugin(f"{file}: category {item.category!r} is none of {', '.join(CATEGORIES)}")
        if item.kind in parts:
            raise BadPlugin(f"{file}: a part of the kind '{item.kind}' exists already; choose another kind")
        if item.category == "emitter" and item.role != "board" and not any(p.role == "power" for p in item.parameters):
            raise BadPlugin(
                f"{file}: the light '{item.kind}' has no parameter with role='power'; declare the one that scales its "
                "light and switches it off at 0"
            )
        parts[item.kind] = item
        return
    if item.key == "new":
        raise BadPlugin(
            f"{file}: an effect cannot be called 'new', which is the word for writing one; choose another name"
        )
    if item.key in effects:
        raise BadPlugin(f"{file}: the effect '{item.name}' exists already ({effects[item.key].file})")
    for stage in item.stages:
        if stage not in STAGES:
            raise BadPlugin(f"{file}: stage {stage!r} is none of {', '.join(STAGES)}")
    if item.onset not in ("tangent", "secant", "both"):
        raise BadPlugin(f"{file}: onset {item.onset!r} is none of tangent, secant, both")
    for p in item.parameters:
        if isinstance(p, Parameter) and p.neutral is None:
            raise BadPlugin(f"{file}: parameter '{p.name}' of the effect '{item.name}' declares no neutral value")
    effects[item.key] = item


# -- which plugins there are -----------------------------------------------------------------------------------------
_registries: dict[tuple[Path, ...], tuple[tuple, Registry]] = {}  # folders -> their files, and what they hold
_included: tuple[Path, ...] = ()  # folders that every scene of this process knows beside the shipped ones
_default: Registry | None = None


def known(*folders: str | Path | None) -> Registry:
    """The registry of the shipped plugins, of the folders that were included, and of these."""
    return Registry.of((shipped("plugins"), *_included, *(f for f in folders if f is not None)))


def include(*folders: str | Path) -> Registry:
    """Make folders known to every scene that is loaded from now on; returns `default()`."""
    global _included, _default
    more = tuple(Path(folder).resolve() for folder in folders)
    _default = known(*more)  # raises before anything is taken over
    _included = tuple(dict.fromkeys((*_included, *more)))
    return _default


def default() -> Registry:
    """What `mi.load_file` knows: the shipped plugins and the included folders, as they were at the last `include`."""
    global _default
    if _default is None:
        _default = known()
    return _default


# -- what a plugin does wrong when it runs ----------------------------------------------------------------------------
OURS = (Apart, BadPlugin, BadScene, BadCapture, UnknownKey, OutOfBounds)  # errors that say by themselves what is wrong


def _guarded(item: Part | Effect) -> Part | Effect:
    """The declaration with functions that name their file where they fail, or give something of another shape."""
    if isinstance(item, Part) or not isinstance(item.stages, Mapping):
        return item
    stages = {stage: _named(f, stage, item) if callable(f) else f for stage, f in item.stages.items()}
    return replace(item, stages=stages)


def _named(function: Callable, stage: str, effect: Effect) -> Callable:
    where = f"{effect.file}: the effect '{effect.name}', stage '{stage}'"
    own = not Path(effect.file).is_relative_to(shipped("plugins").resolve())  # what ships is held to it by tests

    @wraps(function)
    def act(given, *more):
        try:
            found = function(given, *more)
        except OURS:
            raise
        except Exception as error:
            if _interrupted(error):
                raise
            raise BadPlugin(f"{where}: {type(error).__name__}: {error}") from error
        if stage in IMAGE_STAGES:
            _check_image(found, given, where, own)
        return found

    return act


def _interrupted(error: BaseException | None) -> bool:
    """Whether Ctrl-C is behind an error: within a render, Dr.Jit wraps it in one of its own."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False


def _check_image(found: object, given: object, where: str, finite: bool) -> None:
    """An image stage gives numbers of the image's shape; of one pixel in many settings, one for each setting."""
    shape, before = np.shape(found), np.shape(given)  # type: ignore[arg-type]
    kind = np.asarray(found).dtype.kind
    same = len(shape) == len(before) and all(a in (b, 1) for a, b in zip(before, shape))
    if kind not in "fciu" or not same or shape[-1:] != before[-1:]:
        raise BadPlugin(
            f"{where}: gives {'an array of shape ' + str(shape) if kind in 'fciu' else type(found).__name__}; allowed: "
            f"numbers of the shape {before}, as it was given"
        )
    if finite and not np.isfinite(found).all() and np.isfinite(given).all():  # type: ignore[call-overload, arg-type]
        raise BadPlugin(f"{where}: gives NaN or infinity for an image of finite numbers; allowed: finite numbers")


# -- one file --------------------------------------------------------------------------------------------------------
def _content(source: bytes) -> str:
    return hashlib.sha256(source).hexdigest()


_declared: dict[Path, tuple[str, tuple[Part | Effect, ...]]] = {}  # file -> its hash, and what it declares


def declared(file: Path, content: str | None = None) -> tuple[Part | Effect, ...]:
    """Execute a plugin file and return what it declares, with the file's docstring as documentation.

    A file is executed again when its content (a hash) has changed."""
    file = Path(file).resolve()
    source = file.read_bytes()
    if content is None:
        content = _content(source)
    elif content != _content(source):
        raise BadPlugin(f"{file}: changed while it was read; try again")
    if file in _declared and _declared[file][0] == content:
        return _declared[file][1]
    for name, now in EARLIER.items():
        sys.modules.setdefault(name, importlib.import_module(now))
    name = "optics_plugin_" + re.sub(r"\W", "_", str(file))
    spec = importlib.util.spec_from_file_location(name, file)
    module: ModuleType = importlib.util.module_from_spec(spec)
    before = sys.modules.get(name)
    sys.modules[name] = module
    try:
        # compiled here: the interpreter's own cache tells versions of a file apart by whole seconds and its size
        exec(compile(source, str(file), "exec", dont_inherit=True), vars(module))
    except (Exception, SystemExit) as error:
        if before is None:
            del sys.modules[name]
        else:
            sys.modules[name] = before
        raise BadPlugin(f"{file}: {type(error).__name__}: {error}") from error
    found = [v for k, v in vars(module).items() if isinstance(v, (Part, Effect)) and not k.startswith("_")]
    if not found:
        raise BadPlugin(f"{file}: declares neither a part nor an effect; files that only help begin with '_'")
    items = tuple(_guarded(replace(item, doc=module.__doc__ or "", file=str(file))) for item in found)
    _declared[file] = content, items
    return items
