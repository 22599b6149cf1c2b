"""The registry: all parts and effects that were found in the folders of plugins, by kind and by key."""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

from optics.errors import BadPlugin, UnknownKey
from optics.files.output import shipped
from optics.scene.declare import CATEGORIES, STAGES, Effect, Part
from optics.scene.parameter import Parameter
from optics.words import key_of


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
        brought = [
            p
            for e in self.effects.values()
            if e.part == kind
            for p in (*e.parameters, *e.shape)
            if not isinstance(p, str)
        ]
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
        return tuple(
            self.effects[k]
            for k in sorted(self.effects)
            if self.effects[k].part == kind and stage in self.effects[k].stages
        )

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
            raise BadPlugin(
                f"{file}: an effect cannot be called 'new', which is the word for writing one; choose another name"
            )
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


_registry: Registry | None = None


def registry() -> Registry:
    """The registry of this process; the shipped plugins are scanned at the first call."""
    global _registry
    if _registry is None:
        fresh = Registry()
        fresh.scan(shipped("plugins"))
        _registry = fresh
    return _registry
