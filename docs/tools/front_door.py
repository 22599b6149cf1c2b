"""Writes the part of the API page that shows what `import optics` offers: every name of `optics.__all__`."""

from __future__ import annotations

import inspect
from pathlib import Path

from plugin_pages import put


def write_page(file: Path) -> None:
    import optics

    lines = []
    for name in getattr(optics, "__all__", ()):
        thing = getattr(optics, name)
        if inspect.isclass(thing):
            lines += [f".. autoclass:: optics.{name}", "   :members:", ""]
        elif callable(thing):
            lines += [f".. autofunction:: optics.{name}", ""]
    put(file, "\n".join(lines) + "\n")
