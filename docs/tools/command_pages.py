"""Writes the reference of the command line from the program itself: what `optics COMMAND --help` says."""

from __future__ import annotations

import contextlib
import io
import os
from pathlib import Path

from plugin_pages import escaped, put

COLUMNS = "100"  # characters of a line of help


def help_text(*command: str) -> str:
    """What `optics COMMAND --help` prints."""
    from optics.cli import main

    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        main([*command, "--help"])
    return out.getvalue().strip("\n")


def sentence(text: str) -> str:
    """The first paragraph of a command's help, below its usage."""
    paragraphs = text.split("\n\n")
    return " ".join(paragraphs[1].split())


def write_page(file: Path) -> None:
    """Write the page of all commands, in the order of the program."""
    import typer

    from optics.cli import app

    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = COLUMNS
    try:
        names = list(typer.main.get_command(app).commands)
        texts = {name: help_text(name) for name in names}
    finally:
        os.environ.pop("COLUMNS") if before is None else os.environ.update(COLUMNS=before)
    head = (
        "# Commands\n\nWritten from the program: `optics COMMAND --help` says the same. Every command takes `--quiet` "
        "(no progress, no remarks) and `--debug` (where in the program an error came from)."
    )
    overview = ":::{container} wide\n| command | what it does |\n|---|---|\n"
    overview += "\n".join(f"| [`{n}`](#{n}) | {escaped(sentence(t))} |" for n, t in texts.items()) + "\n:::"
    pieces = [f"## {name}\n\n```text\n{text}\n```" for name, text in texts.items()]
    put(file, "\n\n".join([head, overview, *pieces]) + "\n")
