"""Everything that a plugin file imports: `from optics import Effect, Parameter, Part`.

A part that is a layer also takes `layer`; one that is a Mitsuba class takes `Declared`, or one of the bases `matt` and
`passing`. The arithmetic of Mueller matrices is `optics.polarization.mueller`."""

from optics.lookup import lookup
from optics.polarization.layers import Crossing, Texture, evaluate
from optics.scene.declare import Effect, Part
from optics.scene.layer import PatternImage, crossing_of, layer, numbers_of
from optics.scene.mitsuba_parts import Declared
from optics.scene.parameter import Parameter, Values, Variable
from optics.scene.registry import BadPlugin
from optics.scene.surfaces import matt, passing, unpolarized
from optics.scene.wiring import ensure_wired

__all__ = [
    "BadPlugin",
    "Crossing",
    "Declared",
    "Effect",
    "Parameter",
    "Part",
    "PatternImage",
    "Texture",
    "Values",
    "Variable",
    "crossing_of",
    "ensure_wired",
    "evaluate",
    "layer",
    "lookup",
    "matt",
    "numbers_of",
    "passing",
    "unpolarized",
]
