"""Whose code may run: plugins that ship, that the user names, or whose content the user has agreed to.

Captures, scenes and studies are data. Python that lies beside them, or that they name, is found and does not run until
the user says so:

    named     --plugins PATH, or `plugins=` in Python: these run. 'none': nothing runs but what ships
    trusted   the content of a file (SHA-256) that the user was asked about, or that a study of the user's was made
              with; remembered in the user's configuration folder, wherever the file lies

Where nobody can be asked, a file that is neither is refused by its name."""

from __future__ import annotations

import json
import os
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path

from optics.errors import BadPlugin, Untrusted
from optics.files.output import file_hash, shipped, write_text

NONE = "none"  # the word that names no plugins
BESIDE = "plugins"  # folder beside a scene, captures, or in a study
COMPILED = (".so", ".dylib", ".dll")  # what Mitsuba loads from such a folder by itself
Named = str | Path | Sequence[str | Path] | None

# Asked by `admit` where a user can answer: (files, where they lie) -> whether they may run. The command line sets it.
ask: Callable[[Sequence[Path], str], bool] | None = None
_agreed: set[str] = set()  # hashes that this process trusts


def named(plugins: Named) -> tuple[Path, ...] | None:
    """The paths of an argument `plugins`; None where it names nothing, empty for 'none'."""
    if plugins is None:
        return None
    given = [plugins] if isinstance(plugins, (str, Path)) else list(plugins)
    if [str(p) for p in given] == [NONE]:
        return ()
    return tuple(Path(p) for p in given)


def beside(place: Path) -> list[Path]:
    """The folder of plugins in a folder of data, where there is one that does not ship."""
    folder = Path(place) / BESIDE
    return [folder] if folder.is_dir() and not _ships(folder) else []


def plugin_files(path: str | Path) -> list[Path]:
    """The plugin files that a path stands for: itself, or those of a folder and its subfolders, in order. Names that
    begin with _ or . are passed over. Raises BadPlugin."""
    path = Path(path)
    if path.is_file() and path.suffix == ".py":
        return [path]
    if not path.is_dir():
        raise BadPlugin(
            f"{path}: no Python file; allowed: a .py file or a folder of them"
            if path.exists()
            else f"{path}: no such folder of plugins"
        )
    return [
        file
        for file in sorted(path.rglob("*.py"))
        if file.is_file() and not any(piece.startswith(("_", ".")) for piece in file.relative_to(path).parts)
    ]


def once(paths: Sequence[Path], further: Sequence[Path]) -> list[Path]:
    """The paths, and of the further files those whose content is not among them yet: a copy is the same plugin."""
    seen, found = {file_hash(file) for path in paths for file in plugin_files(path)}, list(paths)
    for file in further:
        if (digest := file_hash(file)) not in seen:
            seen.add(digest)
            found.append(file)
    return found


def admit(paths: Iterable[Path], where: str) -> list[Path]:
    """The plugin files of these paths, all of which may run: they ship, or are trusted, or the user now says so.

    where   "beside the captures", for messages. Raises Untrusted."""
    found = [file for path in paths for file in plugin_files(path)]
    admit_files(found, where)
    return found


def admit_files(files: Sequence[Path], where: str) -> None:
    """Raises Untrusted unless all of these files may run. Of a file that is not trusted the user is asked, where there
    is somebody to ask."""
    strange = [file for file in files if not trusted(file)]
    if not strange:
        return
    if ask is not None and ask(strange, where):
        remember(strange)
        return
    first = strange[0]
    kind = "compiled code" if first.suffix in COMPILED else "Python"
    more = f" (and {len(strange) - 1} more)" if len(strange) > 1 else ""
    alone = "move it away" if kind != "Python" else f"'--plugins {NONE}' goes on without it"
    raise Untrusted(
        f"{first}{more}: {kind} {where} runs only if you say so: read it, then add '--plugins {first.parent}' "
        f"(in Python: plugins=...); {alone}"
    )


def trusted(file: Path) -> bool:
    """Whether a file ships, or has content that the user has agreed to."""
    if _ships(file):
        return True
    digest = file_hash(file)
    return digest in _agreed or digest in _kept()


def remember(files: Iterable[Path]) -> list[Path]:
    """Trust the present content of files from now on; returns those that were not trusted before."""
    new = [Path(file) for file in files if not trusted(file)]
    if not new:
        return []
    day = datetime.now(timezone.utc).date().isoformat()
    digests = {file_hash(file): f"{file.absolute()}, {day}" for file in new}
    _agreed.update(digests)
    try:
        write_text(store(), json.dumps({**_kept(), **digests}, indent=1) + "\n")
    except OSError as error:
        warnings.warn(
            f"{store()}: cannot be written ({error.strerror}), so that the plugin {new[0]} is trusted in this process "
            "alone; name it by --plugins next time",
            stacklevel=2,
        )
    return new


def store() -> Path:
    """The file that holds what the user trusts: hash to where it lay and when."""
    home = os.environ.get("XDG_CONFIG_HOME") or os.path.join(os.path.expanduser("~"), ".config")
    return Path(home) / "tactile-optics" / "trusted-plugins.json"


def _kept() -> dict[str, str]:
    """What the store holds; nothing where it cannot be read."""
    try:
        kept = json.loads(store().read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return {str(k): str(v) for k, v in kept.items()} if isinstance(kept, dict) else {}


def _ships(path: Path) -> bool:
    home = shipped("plugins").resolve()
    path = Path(path).resolve()
    return path == home or home in path.parents


# -- code that Mitsuba would load by itself ---------------------------------------------------------------------------
def compiled(scene: Path, defines: Mapping[str, str]) -> list[Path]:
    """Compiled plugins that Mitsuba would load for a scene: it looks for `plugins/NAME.so` beside the scene, in the
    present folder and in every <path> of the scene, before it takes its own."""
    return sorted(
        file
        for place in _searched(scene, defines)
        if (place / BESIDE).is_dir()
        for file in (place / BESIDE).iterdir()
        if file.suffix in COMPILED
    )


def _searched(scene: Path, defines: Mapping[str, str]) -> set[Path]:
    """The folders where Mitsuba looks for what a scene names; of scenes that it includes, theirs too."""
    places, seen, todo = {Path.cwd(), scene.parent}, set(), [scene]
    values = dict(defines)
    while todo:
        file = todo.pop()
        if file in seen or not file.is_file():
            continue
        seen.add(file)
        places.add(file.parent)
        text = file.read_text(encoding="utf-8", errors="replace")
        for tag in re.findall(r"<default\b[^>]*>", text):
            if (name := _attribute(tag, "name")) is not None:
                values.setdefault(name, _attribute(tag, "value") or "")
        for tag in re.findall(r"<path\b[^>]*>", text):
            value = _filled(_attribute(tag, "value") or "", values)
            places |= {place / value for place in list(places)}
        for tag in re.findall(r"<include\b[^>]*>", text):
            value = _filled(_attribute(tag, "filename") or "", values)
            todo += [place / value for place in places]
    return {place.resolve() for place in places}


def _attribute(tag: str, name: str) -> str | None:
    found = re.search(rf"\b{name}\s*=\s*(?:\"([^\"]*)\"|'([^']*)')", tag)
    return None if found is None else found[1] if found[1] is not None else found[2]


def _filled(text: str, values: Mapping[str, str]) -> str:
    for name in sorted(values, key=len, reverse=True):
        text = text.replace(f"${name}", str(values[name]))
    return text
