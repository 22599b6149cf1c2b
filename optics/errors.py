"""What can be wrong with a user's input, in a few classes, each a subclass of the built-in error it refines.

Every text says what is wrong, the value with its unit, what is allowed, and the next step.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from optics.words import spaced


class UnknownKey(KeyError):
    """A key that no part of the scene, file or registry has; the text names the nearest known one."""

    def __init__(self, key: str, known: Iterable[str], what: str = "parameter", where: str = "", hint: str = ""):
        known = list(known)
        near = difflib.get_close_matches(key, known, n=1, cutoff=0.4)
        text = f"{where + ': ' if where else ''}unknown {what} '{key}'"
        if near:
            text += f"; did you mean '{near[0]}'?"
        elif known and len(known) <= 12:
            text += f"; known: {', '.join(sorted(known))}"
        if hint:
            text += f" {hint}" if near or hint.startswith("(") else f"; {hint}"
        super().__init__(text)
        self.key, self.nearest = key, near[0] if near else None

    def __str__(self) -> str:  # KeyError would print the repr
        return self.args[0]


class OutOfBounds(ValueError):
    """A value outside the bounds that its parameter declares."""

    def __init__(self, key: str, value: float, unit: str, bounds: tuple[float, float], where: str = ""):
        super().__init__(
            f"{where + ': ' if where else ''}{key} = {value:g}{spaced(unit)} is outside its bounds "
            f"[{bounds[0]:g}, {bounds[1]:g}]{spaced(unit)}; see `optics params SCENE`"
        )


class BadScene(ValueError):
    """A scene that cannot be loaded or lacks what the task needs."""


class BadCapture(ValueError):
    """A capture set that contradicts its format, its scene or itself."""


class BadPlugin(ValueError):
    """A plugin file whose declaration is incomplete or contradicts another one."""


class Apart(Exception):
    """Something was asked of several LEDs at once that only one of them can answer; never shown to a user."""


class Untrusted(BadPlugin):
    """Code that came with data, which the user has not agreed to run."""


class Underdetermined(ValueError):
    """The captures cannot decide what was asked of them."""


class OutputExists(FileExistsError):
    """A result would overwrite an existing one."""
