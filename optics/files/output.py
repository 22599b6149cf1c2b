"""Files that are written whole or not at all, checks before any work that they can be, and what identifies them
later."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path

from optics import __version__
from optics.errors import OutputExists

PACKAGES = ("mitsuba", "drjit", "numpy", "scipy", "scikit-image")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file in the same folder that takes the place of `path` when the block ends without an error."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.parent / f".{path.stem}.{uuid.uuid4().hex}{path.suffix}"
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def claim(paths: Sequence[Path], force: bool = False) -> None:
    """Make sure, before any work, that files can be written: none exists (unless `force`), every folder can take
    them."""
    for path in map(Path, paths):
        if path.is_dir() or (path.exists() and not force):
            raise OutputExists(
                f"{path} exists; choose another name" + ("" if path.is_dir() else ", or --force to replace it")
            )
        check_folder(path.parent)


def check_folder(folder: Path) -> None:
    """Raises where a folder cannot be made or written to."""
    folder = Path(folder).absolute()
    there = next(p for p in (folder, *folder.parents) if p.exists())
    if not there.is_dir():
        raise NotADirectoryError(f"{folder}: '{there}' is a file and no folder; choose another place for the output")
    if not os.access(there, os.W_OK):
        raise PermissionError(f"{folder}: '{there}' cannot be written to; choose another place for the output")


def write_json(path: Path, record: Mapping) -> Path:
    with replacing(path) as file:
        file.write_text(json.dumps(record, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    return path


def shipped(folder: str) -> Path:
    """The folder `plugins` or `scenes` of a source checkout, or the copy of it inside an installed package."""
    here = Path(__file__).resolve().parents[1]
    for candidate in (here / "_data" / folder, here.parent / folder):
        if candidate.is_dir():
            return candidate
    raise FileNotFoundError(f"the folder '{folder}' of this installation is missing; install the package again")


def versions() -> dict[str, str]:
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


def file_hash(file: Path) -> str:
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
