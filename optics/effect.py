"""Names that plugin files import: `from optics.effect import Effect`. New files may write `from optics import Effect`."""

from optics.scene.declare import Effect, Part
from optics.scene.mitsuba_parts import Declared

__all__ = ["Declared", "Effect", "Part"]
