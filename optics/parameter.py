"""Names that plugin files import: `from optics.parameter import Parameter`. New files may write `from optics import Parameter`."""

from optics.scene.parameter import Parameter

__all__ = ["Parameter"]
