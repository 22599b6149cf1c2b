"""A TOML file's values, checked one by one: what is refused names the file, the place, the value and what is
allowed."""

from __future__ import annotations

import difflib
import math
import sys
import unicodedata
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from optics.errors import BadCapture, UnknownKey

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def parse(file: Path) -> dict:
    """The file's content, with or without a byte order mark; raises BadCapture with line and column."""
    try:
        return tomllib.loads(file.read_text(encoding="utf-8-sig"))
    except UnicodeDecodeError as error:
        raise BadCapture(f"{file}: byte {error.start} is no UTF-8 ({error.reason}); save the file as UTF-8") from error
    except (ValueError, RecursionError) as error:  # TOMLDecodeError, a number too long
        raise BadCapture(f"{file}: not valid TOML: {error}; correct this line (text needs quotes)") from error


def keys(table: object, known: Sequence[str], where: str) -> None:
    """A table with no other keys than these (none named: any)."""
    if not isinstance(table, Mapping):
        raise BadCapture(
            f"{where} = {table!r} is no table; allowed: a table" + (f" with {', '.join(known)}" if known else "")
        )
    for key in table:
        if known and key not in known:
            raise UnknownKey(key, known, "key", where, f"(allowed: {', '.join(known)})")


def text(table: Mapping, key: str, where: str, allowed: Sequence[str] = ()) -> str | None:
    """The text under a key, or None where the key is absent."""
    value = table.get(key)
    if key in table and (not isinstance(value, str) or not value or (allowed and value not in allowed)):
        raise BadCapture(f"{where}: {key} = {value!r}; allowed: {', '.join(allowed) or 'text in quotes, not empty'}")
    return value


def texts(table: Mapping, key: str, where: str) -> list[str]:
    """The list of texts under a key; empty where the key is absent."""
    value = table.get(key, [])
    if not isinstance(value, list) or not all(isinstance(v, str) and v for v in value):
        raise BadCapture(f'{where}: {key} = {value!r}; allowed: a list of texts, such as ["one", "two"]')
    return value


def number(value: object, key: str, unit: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise BadCapture(
            f"{where}: {key} = {value!r}{' ' + unit if unit else ''}; allowed: a finite number, without quotes"
        )
    return float(value)


def settings(table: Any, where: str) -> dict[str, float | str]:
    """Parameters by key: finite numbers or texts."""
    keys(table, (), where)
    for key, value in table.items():
        if isinstance(value, Mapping):
            raise BadCapture(
                f'{where}: {key} is a table; a key with a dot needs quotes: "{key}.{next(iter(value), "")}"'
            )
    return {
        key: value if isinstance(value, str) else number(value, f'"{key}"', "", where) for key, value in table.items()
    }


def existing(folder: Path, name: str, where: str) -> Path:
    """The file of this name, relative to `folder`."""
    if "\0" in name:
        raise BadCapture(f"{where} = {name!r}: has a zero byte; allowed: the path of a file")
    file = folder / name
    if file.is_file():
        return file
    if file.exists():
        raise BadCapture(f"{where} = '{name}': a folder, a pipe or a device in {folder}; allowed: a file; name one")
    raise BadCapture(
        f"{where} = '{name}': no such file in {folder}; allowed: a path relative to {folder.name}; "
        + _instead(folder, name)
    )


def _instead(folder: Path, name: str) -> str:
    """What to write in place of a name that no file has."""
    if "\\" in name and (folder / name.replace("\\", "/")).is_file():
        return f"write / between folders: '{name.replace(chr(92), '/')}'"
    there = [Path(name).with_name(p.name).as_posix() for p in (folder / Path(name).parent).glob("*")]
    if same := [n for n in there if unicodedata.normalize("NFC", n) == unicodedata.normalize("NFC", name)]:
        return (
            f"the file's name has its accents in another form of Unicode: copy '{same[0]}' from a listing of the folder"
        )
    near = [n for n in there if n.casefold() == name.casefold()] or difflib.get_close_matches(name, there, n=1)
    return f"did you mean '{near[0]}'?" if near else "correct the path or add the file"


def inside(folder: Path, name: str, where: str) -> Path:
    """As `existing`, of a file that lies in `folder` when all links are followed; another one is refused unread."""
    file = folder / name if "\0" not in name else existing(folder, name, where)
    try:
        target = file.resolve()
    except (RuntimeError, OSError) as error:  # the class changed with Python 3.13
        raise BadCapture(f"{where} = '{name}': a link that leads back to itself; allowed: a file; name one") from error
    if not target.is_relative_to(folder.resolve()):
        raise BadCapture(
            f"{where} = '{name}': lies outside {folder}, at {target}; allowed: files of the capture folder, or "
            "any with '--allow-outside' (in Python: outside=True), where you know who wrote the file"
        )
    return existing(folder, name, where)
