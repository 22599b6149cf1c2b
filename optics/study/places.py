"""What a study was made from, known by content: its captures, scene and plugins, wherever they lie by now.

The record keeps a hash of every file under a name that no place is part of:

    captures/NAME    a file of the capture set, as captures.toml names it
    scene/NAME       the scene, unless it ships
    plugins/NAME     a plugin that ships, or the scene
    own/NAME         any other plugin: named, found and trusted, or drafted by the study

so that a study may be moved, copied to another machine, or opened by another installation of the same version."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from optics.captures import capture_set as capture_files
from optics.errors import BadCapture
from optics.files import toml_checks
from optics.files.output import file_hash, shipped
from optics.fit.scene_model import SceneModel
from optics.scene import loader as scenes
from optics.scene import trust
from optics.scene.registry import Registry
from optics.study.setup import Setup

CAPTURES, SCENE, SHIPPED, OWN = "captures/", "scene/", "plugins/", "own/"
ADVICE = "import.json"


# -- what is recorded ------------------------------------------------------------------------------------------------
def inputs_of(model: SceneModel) -> dict[str, str]:
    """The hash of every file that a model was made of, by the names above."""
    captures = model.captures
    found = {CAPTURES + name: file_hash(file) for name, file in captures.files.items()}
    advice = captures.folder / ADVICE
    if advice.is_file():
        found[CAPTURES + ADVICE] = file_hash(advice)
    found[(SHIPPED if scene_ships(model.scene.path) else SCENE) + model.scene.path.name] = file_hash(model.scene.path)
    home = shipped("plugins").resolve()
    for file in model.scene.registry.files:
        if file.is_relative_to(home):
            found[SHIPPED + file.relative_to(home).as_posix()] = file_hash(file)
    return {**found, **own_plugins(model.scene.registry)}


def own_plugins(registry: Registry) -> dict[str, str]:
    """The hash of every plugin file of a registry that does not ship."""
    found: dict[str, str] = {}
    for file in registry.own_files:
        found[_free(OWN + registry.name_of(file), found)] = file_hash(file)
    return found


def _free(name: str, taken: Mapping[str, str]) -> str:
    number, first = 2, name
    while name in taken:
        name, number = f"{first}#{number}", number + 1
    return name


def scene_ships(path: Path) -> bool:
    return path.resolve().is_relative_to(shipped("scenes").resolve())


def portable(inputs: Mapping[str, str], captures: str) -> dict[str, str]:
    """Recorded inputs by the names above; earlier versions recorded absolute paths, and every file of the folders."""
    found: dict[str, str] = {}
    for name, digest in inputs.items():
        path = Path(name)
        if not path.is_absolute():
            found[name] = digest
        elif "__pycache__" in path.parts:
            continue
        elif path.is_relative_to(captures):
            found[CAPTURES + path.relative_to(captures).as_posix()] = digest
        elif path.suffix == ".py":
            parts = path.parts
            after = len(parts) - 1 - parts[::-1].index("plugins") if "plugins" in parts else len(parts) - 2
            rest = "/".join(parts[after + 1 :])
            ships = (shipped("plugins") / rest).is_file()
            found[SHIPPED + rest if ships else _free(OWN + path.name, found)] = digest
        elif path.suffix == ".xml":
            found[(SHIPPED if (shipped("scenes") / path.name).is_file() else SCENE) + path.name] = digest
        else:
            found[name] = digest
    return found


# -- where it is now -------------------------------------------------------------------------------------------------
def candidates(study: Path, recorded: str | Path, near: str | None = None) -> list[Path]:
    """Where a file or folder may be that a study knew at an absolute path: as far from the study as it was; there;
    beside the study, or in it, by its name."""
    recorded, study = Path(recorded), Path(os.path.abspath(study))
    found = [*([study / near] if near else []), recorded, study.parent / recorded.name, study / recorded.name]
    return list(dict.fromkeys(Path(os.path.normpath(p)) for p in found))


def captures_of(study: Path, ladder: Mapping[str, Any], setup: Setup, given: str | Path | None = None) -> Path:
    """The folder of a study's captures: the first place whose captures.toml has the recorded content, or else that has
    one. Raises BadCapture where none has.

    given   where the user says that they are"""
    inputs = portable(ladder["inputs"], setup.captures)
    wanted = inputs.get(CAPTURES + capture_files.FILE)
    near = ladder.get("near", {}).get("captures")
    places = [Path(given)] if given is not None else candidates(study, setup.captures, near)
    files = {p: p / capture_files.FILE if p.suffix != ".toml" else p for p in places}
    there = [p for p, file in files.items() if file.is_file()]
    if not there:
        raise BadCapture(
            f"{study}: its captures are gone: no {capture_files.FILE} in {', '.join(map(str, places))}; say where they "
            "are: --captures DIR (in Python: captures=...)"
        )
    same = next((p for p in there if file_hash(files[p]) == wanted), None)
    return (same or (Path(setup.captures) if Path(setup.captures) in there else there[0])).absolute()


def plugin_places(study: Path, setup: Setup, captures: Path, scene: Path | None) -> list[Path]:
    """Where plugins of a study may lie."""
    named = [place for folder in setup.plugins or () for place in candidates(study, folder)]
    data = [captures, *([scene.parent] if scene is not None else [])]
    found = [p for p in named if p.exists()] + [f for place in (study, *data) for f in trust.beside(place)]
    return list(dict.fromkeys(found))


def scene_named(captures: Path) -> Path | None:
    """The XML file that captures name as their scene; None where there is none."""
    file = captures / capture_files.FILE if captures.is_dir() else captures
    name = toml_checks.parse(file).get("scene")
    if not isinstance(name, str):
        return None
    if name.lower().endswith(".xml"):
        path = file.parent / name
        return path.resolve() if path.is_file() else None
    return scenes.find(name) if name in scenes.shipped_scenes() else None


def changed(
    ladder: Mapping[str, Any], setup: Setup, captures: Path, scene: Path | None, own: Iterable[Path]
) -> list[str]:
    """Names of recorded inputs that are gone or have another content; nothing is executed.

    own   plugin files that the study can find"""
    folder = captures if captures.is_dir() else captures.parent
    here = {file_hash(file) for file in own}
    found = []
    for name, digest in portable(ladder["inputs"], setup.captures).items():
        if name.startswith(OWN):
            same = digest in here
        elif name.startswith(CAPTURES):
            same = _has(folder / name.removeprefix(CAPTURES), digest)
        elif name.startswith(SCENE) or (name.startswith(SHIPPED) and name.endswith(".xml")):
            same = scene is not None and _has(scene, digest)
        elif name.startswith(SHIPPED):
            same = _has(shipped("plugins") / name.removeprefix(SHIPPED), digest)
        else:
            same = _has(Path(name), digest)
        if not same:
            found.append(name)
    return found


def _has(file: Path, digest: str) -> bool:
    return file.is_file() and file_hash(file) == digest


def code_of(
    study: Path, ladder: Mapping[str, Any], setup: Setup, places: Sequence[Path], plugins: trust.Named
) -> list[Path]:
    """The plugin files besides the shipped ones that a study is opened with: those that `plugins` names and those that
    it was made with; where nothing is named, all that lie in its places. All may run. Raises Untrusted."""
    named = trust.named(plugins)
    drafted = set(ladder.get("drafts", {}).values())
    found = [file for place in places for file in trust.plugin_files(place)]
    if named is not None:
        wanted = {h for name, h in portable(ladder["inputs"], setup.captures).items() if name.startswith(OWN)}
        found = [file for file in found if file_hash(file) in wanted]
    given = [file for path in named or () for file in trust.plugin_files(path)]
    found = [file for file in trust.once([], found) if file_hash(file) not in {file_hash(g) for g in given}]
    made = [file for file in found if file_hash(file) in drafted]
    trust.admit_files(made, f"that the study {study} holds as its own draft")
    trust.admit_files([file for file in found if file not in made], f"found with the study {study}")
    return [*given, *found]


# -- of a fit, which may lie anywhere ----------------------------------------------------------------------------------
def study_of(file: Path) -> Path:
    """The folder of the study that a fit.toml is a step of; the folder that it lies in where it is of none."""
    folder = Path(os.path.abspath(file)).parent
    return next((f for f in folder.parents if (f / "ladder.json").is_file()), folder)
