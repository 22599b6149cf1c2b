"""Runs the tour: every command and every Python block of docs/tour.md, in order, and refreshes what the page shows.

    python docs/tools/tour.py FOLDER [--real] [--write]

FOLDER is where the commands work. The page's `sh` and `python` blocks are executed as they stand; `text` blocks hold
lines of what the command before them printed, with "..." for what is left out. `--real` includes the part that needs
the measured images: FOLDER/digit-depth, fetched as the page says, or made from a copy (`lay_out`). `--write` puts the
present lines and images into the page and into docs/images; without it, lines that the program no longer prints are
reported."""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import shlex
import shutil
import sys
from dataclasses import dataclass, field
from pathlib import Path

DOCS = Path(__file__).resolve().parent.parent
PAGE = DOCS / "tour.md"
IMAGES = DOCS / "images"
BLOCK = re.compile(r"^```(sh|python|text)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"[-+]?(?<![\w.])\d+\.?\d*(?:e[-+]?\d+)?")
REAL = "## On a real sensor"  # what stands below needs the measured images
FETCHED = ("git", "sed")  # commands that fetch the images; tests lay them out from a copy instead
SHOWN = re.compile(r"^(?::::\{figure\}|\{figure\}) images/(\S+)", re.MULTILINE)


@dataclass
class Block:
    """A block of the page: its language, text, and place; for a `text` block what the program printed before it."""

    language: str
    text: str
    start: int
    end: int
    real: bool
    printed: str = ""
    missing: list[str] = field(default_factory=list)


def blocks(page: str) -> list[Block]:
    real = page.index(REAL)
    return [Block(m[1], m[2], m.start(2), m.end(2), m.start() > real) for m in BLOCK.finditer(page)]


def commands(block: Block) -> list[list[str]]:
    """The commands of a `sh` block, without comments, lines that end in a backslash joined."""
    lines = block.text.replace("\\\n", " ").splitlines()
    found = [shlex.split(line, comments=True) for line in lines]
    return [c for c in found if c]


def run(command: list[str]) -> str:
    """What a command of the page prints; `optics` runs in this process."""
    from optics.cli import main

    if command[:2] == ["cp", "-r"]:
        shutil.copytree(*command[2:])
        return ""
    if command[0] != "optics":
        raise ValueError(f"{shlex.join(command)}: the tour runs `optics` and `cp -r` only")
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):  # a terminal shows both
        code = main(command[1:])
    if code == 2:
        raise RuntimeError(f"{shlex.join(command)}: exit code 2")
    return out.getvalue()


def skeleton(line: str) -> str:
    """A line without its numbers and its spacing."""
    return " ".join(NUMBER.sub("#", line).split())


def present(shown: str, printed: str) -> tuple[str, list[str]]:
    """The lines of a `text` block as the program prints them now, in order, and those that it does not print."""
    lines, at, found, missing = printed.splitlines(), 0, [], []
    for line in shown.splitlines():
        if line.strip() in ("...", ""):
            found.append(line)
            continue
        for i in range(at, len(lines)):
            if (
                skeleton(lines[i]) == skeleton(line)
                or line.endswith(" ...")
                and skeleton(lines[i]).startswith(skeleton(line[:-4]))
            ):
                found.append(cut(line, lines[i].rstrip()))
                at = i + 1
                break
        else:
            found.append(line)
            missing.append(line)
    return "\n".join(found) + "\n", missing


def cut(shown: str, line: str) -> str:
    """A line that the page ends with "..." ends where it did."""
    if not shown.endswith(" ..."):
        return line
    words = len(shown[:-4].split())
    return re.match(r"\s*" + r"\s+".join([r"\S+"] * words), line)[0] + " ..."


def lay_out(measured: Path, folder: Path) -> None:
    """What the page's commands fetch, from a folder that holds it: `images` and `labels.csv`."""
    target = folder / "digit-depth"
    target.mkdir(parents=True, exist_ok=True)
    shutil.copytree(measured / "images", target / "qt_images", dirs_exist_ok=True)
    shutil.copyfile(measured / "labels.csv", target / "labels.csv")


def walk(folder: Path, real: bool = False, quick: bool = True, page: str | None = None) -> list[Block]:
    """Execute the page's blocks in a folder; the blocks with what was printed and what is missing.

    quick   the part without measured images;   real   the part with them
    """
    found = blocks(PAGE.read_text(encoding="utf-8") if page is None else page)
    printed, space = "", {}
    here = os.getcwd()
    os.chdir(folder)
    try:
        for block in found:
            if not (real if block.real else quick):
                continue
            if block.language == "text":
                block.printed = printed
                _, block.missing = present(block.text, printed)
            elif block.language == "sh":
                printed = ""
                for command in commands(block):
                    if command[0] not in FETCHED:
                        print("+", shlex.join(command), file=sys.stderr, flush=True)
                        printed += run(command)
            else:
                out = io.StringIO()
                with contextlib.redirect_stdout(out):
                    exec(compile(block.text, str(PAGE), "exec"), space)
                printed = out.getvalue()
    finally:
        os.chdir(here)
    return found


def images(page: str, real: bool) -> list[str]:
    """Names of the figures of the page's parts."""
    return [m[1] for m in SHOWN.finditer(page) if real or m.start() < page.index(REAL)]


def main() -> None:
    import matplotlib

    matplotlib.use("Agg")
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--real", action="store_true", help="include the part that needs the measured images")
    parser.add_argument("--only-real", action="store_true", help="run that part alone")
    parser.add_argument("--measured", type=Path, help="a folder with images and labels.csv, in place of fetching them")
    parser.add_argument("--write", action="store_true", help="put lines and images into the page")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    real = options.real or options.only_real
    if real and options.measured:
        lay_out(options.measured.resolve(), options.folder)
    page = PAGE.read_text(encoding="utf-8")
    found = walk(options.folder, real, not options.only_real, page)
    for block in found:
        for line in block.missing:
            print(f"not printed any more: {line}", file=sys.stderr)
    if not options.write:
        raise SystemExit(1 if any(b.missing for b in found) else 0)
    for block in reversed(found):
        if block.language == "text" and block.printed:
            page = page[: block.start] + present(block.text, block.printed)[0] + page[block.end :]
    PAGE.write_text(page, encoding="utf-8")
    IMAGES.mkdir(exist_ok=True)
    for name in images(page, real):
        made = options.folder / name
        if made.is_file():
            shutil.copyfile(made, IMAGES / name)


if __name__ == "__main__":
    main()
