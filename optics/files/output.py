"""Output that appears whole or not at all, checks before any work that it can be written, and what identifies it."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import platform
import re
import shutil
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib import metadata
from pathlib import Path

from optics.errors import OutputExists
from optics.version import __version__

PACKAGES = ("mitsuba", "drjit", "numpy", "scipy", "scikit-image")


FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def naming(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """A disk that is full is said with the file that was to be written: writers name none, or a temporary one."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        code, file = getattr(error, "errno", None), getattr(error, "filename", None)
        said = str(error)
        if code not in FULL and not (
            code is None and (_NO_SPACE in said or re.search(r"requested and \d+ written", said))
        ):
            raise
        name = str(path) if file is None else str(file).replace(str(temporary or path), str(path))
        raise OSError(
            code or errno.ENOSPC,
            f"{os.strerror(code or errno.ENOSPC)}: it is not written, nothing of it is kept; free some space, or "
            "choose another place",
            name,
        ) from error


_NO_SPACE = os.strerror(errno.ENOSPC)


@contextmanager
def alone(file: Path, said: str) -> Iterator[None]:
    """Hold a lock file against other processes; the system frees the lock however the process ends. Raises OutputExists
    with what is said where another one has it."""
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    with open(file, "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise OutputExists(said) from error
        except OSError:  # a file system without locks
            pass
        yield


@contextmanager
def folders_for(*places: Path) -> Iterator[None]:
    """Make folders; where the block ends with an error, those that were not there and are empty go again."""
    new = {p for place in places for p in (place, *place.parents) if not p.exists()}
    try:
        for place in places:
            place.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        for folder in sorted(new, key=lambda p: len(p.parts), reverse=True):
            with suppress(OSError):  # it holds something, or was not made
                folder.rmdir()
        raise


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary file beside `path` that replaces it when the block ends without an error; removed otherwise."""
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "is a folder; choose the name of a file", str(path))
    if path.exists() and not path.is_file():  # /dev/null, /dev/stdout: written to, never replaced
        yield path
        return
    temporary = path.parent / f".{path.stem}.{uuid.uuid4().hex}{path.suffix}"
    with folders_for(path.parent):
        try:
            with naming(path, temporary):
                yield temporary
                os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def together(files: Sequence[Path]) -> Iterator[None]:
    """Write several files of one result: where the block ends with an error, those that it made are removed again."""
    before = {file for file in files if file.exists()}
    with folders_for(*(file.parent for file in files)):
        try:
            yield
        except BaseException:
            for file in set(files) - before:
                file.unlink(missing_ok=True)
            raise


def write_text(path: str | Path, text: str) -> Path:
    """Write a UTF-8 text file, whole or not at all."""
    with replacing(path) as file:
        file.write_text(text, encoding="utf-8")
    return Path(path)


@contextmanager
def new_folder(folder: str | Path, *, replace: bool = False) -> Iterator[Path]:
    """A temporary folder beside `folder` that takes its place when the block ends without an error.

    An empty folder gives way. One with content gives way only with `replace`: it is moved aside first, and back again
    if the new one cannot take its place. Raises OutputExists, before anything is written.
    """
    folder = Path(os.path.abspath(folder))
    if not replace:
        check_new_folder(folder)
    elif (folder / RECORD).is_file():
        raise OutputExists(f"{folder} holds a study, which is never replaced; choose another folder")
    temporary = folder.parent / f".{folder.name}.{uuid.uuid4().hex}"
    old = temporary.with_name(temporary.name + ".old")
    with folders_for(folder.parent):
        try:
            temporary.mkdir()
            with naming(folder, temporary):
                yield temporary
            if folder.exists():
                folder.rename(old)
            try:
                temporary.rename(folder)
            except OSError:
                if old.exists():
                    old.rename(folder)
                raise
            shutil.rmtree(old, ignore_errors=True)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def check_new_folder(folder: str | Path) -> None:
    """Raises OutputExists where a folder holds something already, and what `check_folder` raises."""
    folder = Path(folder)
    check_folder(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputExists(f"{folder} exists and is not empty; choose another folder")


def claim(paths: Sequence[Path], force: bool = False) -> None:
    """Check, before any work, that files can be written: none exists (unless `force`), and every folder is writable."""
    places = [Path(os.path.abspath(path)) for path in paths]
    for path in places:
        if places.count(path) > 1:
            raise OutputExists(f"{path} is named for two outputs; give each a name of its own")
    for path in map(Path, paths):
        spare_records(path)
        if path.is_dir() or (path.exists() and not force):
            raise OutputExists(
                f"{path} exists; choose another name" + ("" if path.is_dir() else ", or --force to replace it")
            )
        check_folder(path.parent)


RECORD = "ladder.json"  # what makes a folder a study


def spare_records(path: Path) -> None:
    """Raises OutputExists for a file of a study's record: its ladder.json, and all in its folder `steps`."""
    path = Path(os.path.abspath(path))
    for study in path.parents:
        if (study / RECORD).is_file() and (path == study / RECORD or study / "steps" in path.parents):
            raise OutputExists(f"{path} belongs to the record of the study {study}; choose another name")


def check_folder(folder: Path) -> None:
    """Raises NotADirectoryError or PermissionError where a folder cannot be made or written to."""
    folder = Path(folder).absolute()
    there = next(p for p in (folder, *folder.parents) if p.exists())
    if not there.is_dir():
        raise NotADirectoryError(f"{folder}: '{there}' is a file and no folder; choose another place for the output")
    if not os.access(there, os.W_OK):
        raise PermissionError(f"{folder}: '{there}' cannot be written to; choose another place for the output")


def write_json(path: str | Path, record: Mapping) -> Path:
    """Write a JSON file with sorted keys, whole or not at all."""
    return write_text(path, json.dumps(record, indent=1, sort_keys=True) + "\n")


def shipped(folder: str) -> Path:
    """The folder `plugins` or `scenes` of a source checkout, or the copy of it inside an installed package."""
    here = Path(__file__).resolve().parents[1]
    for candidate in (here / "_data" / folder, here.parent / folder):
        if candidate.is_dir():
            return candidate
    raise FileNotFoundError(f"the folder '{folder}' of this installation is missing; install the package again")


def versions() -> dict[str, str]:
    """Versions of this package, of Python, of the system and of the packages that results depend on."""
    found = {
        "optics": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
    }
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


def file_hash(file: str | Path) -> str:
    """`sha256:` and the hexadecimal SHA-256 of a file."""
    digest = hashlib.sha256()
    with open(file, "rb") as f:
        while block := f.read(1 << 20):
            digest.update(block)
    return "sha256:" + digest.hexdigest()


def input_hashes(inputs: Sequence[str | Path]) -> dict[str, str]:
    """Path -> SHA-256 of each file; folders give every file in them. Raises FileNotFoundError."""
    out = {}
    for path in map(Path, inputs):
        if not path.exists():
            raise FileNotFoundError(f"{path}: no such input")
        for file in sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]:
            out[str(file)] = file_hash(file)
    return out
