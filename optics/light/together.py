"""Alike LEDs as one light, whose numbers differ from lane to lane: one kernel shades what each of them lights.

An image of a few thousand pixels takes longer to ask for than to compute. Six LEDs over one geometry ask once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from optics.errors import Apart
from optics.light.samples import Finer, Sample, aligned

PLAIN = (bool, int, float, str, tuple, list, type(None))  # what may be equal in all lights
ALIKE = ("numbers", "words")  # the same of a class
ASKS_ONE = ("number", "numbered", "held", "hold", "reread")  # Python numbers of one light
FRAME = "own_frame"  # three vectors that each light has for itself, for good
_frames: WeakKeyDictionary = WeakKeyDictionary()  # light -> its frame in Python numbers


class Together:
    """Lights of one class, as one of them.

    lights   that are `alike`;   lane   number of the light in each lane (Dr.Jit);   given   numbers by name that are
    not the lights' own: Dr.Jit arrays with a value for each light, which may carry gradients

    What is asked for in Python numbers (`number`, `held`) raises Apart."""

    def __init__(self, lights: Sequence, lane, given: dict[str, Any] | None = None):
        self._lights, self._lane, self._given = tuple(lights), lane, dict(given or {})

    def __getattr__(self, name: str):
        import drjit as dr
        import mitsuba as mi

        first = self._lights[0]
        if name in first.numbers:
            table = self._given[name] if name in self._given else numbers_of(self._lights, name)
            value = dr.gather(mi.Float, table, self._lane)
        elif name == FRAME:
            axes = np.array([_frame(light) for light in self._lights], np.float32).transpose(1, 2, 0)
            value = [dr.gather(mi.Vector3f, mi.Vector3f(np.ascontiguousarray(own)), self._lane) for own in axes]
        elif name == "curves":
            return self._same_curves()
        else:
            return getattr(first, name) if name in ALIKE else self._shared(name)
        self.__dict__[name] = value
        return value

    def _same_curves(self) -> dict:
        """Measured spectra, where all lights have the same: what a pigment takes up asks for them. Raises Apart."""
        first, *others = ({name: id(curve) for name, curve in light.curves.items()} for light in self._lights)
        if any(own != first for own in others):
            raise Apart("curves")
        return self._lights[0].curves

    def _shared(self, name: str):
        """What all lights have in common: a function or property of their class, a neighbour, a plain value."""
        owner = next((c for c in type(self._lights[0]).__mro__ if name in vars(c)), None)
        found = None if owner is None else vars(owner)[name]
        if name in ASKS_ONE or (owner is not None and owner.__module__.startswith(("mitsuba", "drjit"))):
            raise Apart(name)
        if isinstance(found, property):
            return found.fget(self)
        if callable(found) and hasattr(found, "__get__"):
            return found.__get__(self)
        first, *others = (getattr(light, name, Apart) for light in self._lights)
        if first is not Apart and all(o is first or (type(o) in PLAIN and o == first) for o in others):
            return first
        raise Apart(name)

    def spectrum(self, wavelengths):
        """Measured spectra are looked up light by light."""
        import drjit as dr
        import mitsuba as mi

        if not any(light.curves for light in self._lights):
            return type(self._lights[0]).spectrum(self, wavelengths)
        found = mi.UnpolarizedSpectrum(0.0)
        for k, light in enumerate(self._lights):
            before = {name: getattr(light, name) for name in self._given}
            for name, table in self._given.items():
                setattr(light, name, dr.gather(mi.Float, table, mi.UInt32(k)))
            try:
                found = dr.select(self._lane == k, light.spectrum(wavelengths), found)
            finally:
                for name, value in before.items():
                    setattr(light, name, value)
        return found

    def places(self) -> list[tuple[float, float]]:
        return self._lights[0].places()

    def reach(self) -> float:
        return max(light.reach() for light in self._lights)

    def stands(self) -> tuple[float, ...]:
        """Where the one that is nearest to the camera stands."""
        return min((light.stands() for light in self._lights), key=lambda at: at[2])

    def functions(self, stage: str) -> tuple:
        """Those that any of the lights needs: the others have neutral numbers."""
        asked = {f: None for light in self._lights for f in light.functions(stage)}
        own = {e.stages[stage]: e for e in self.registry.at_stage(self.kind, stage)}
        moved = [f for f, e in own.items() if any(n in self._given for n in e.at_rest)]
        return tuple(f for f in own if f in asked or f in moved)


def numbers_of(lights: Sequence, name: str):
    """A number of each light (Dr.Jit)."""
    import mitsuba as mi

    return mi.Float([light.held[name] for light in lights])


def _frame(light) -> np.ndarray:
    """(3, 3) axes of a light's own frame, one behind the other."""
    if light not in _frames:
        _frames[light] = np.array([np.array(axis, float).ravel() for axis in getattr(light, FRAME)])
    return _frames[light]


def alike(lights: Sequence, faces: Sequence[float]) -> list[list]:
    """The lights in groups that can be asked as one: of one class and board, with the same words and points.

    faces   where flat interfaces lie, mm: lights of a group stand on the same side of each"""
    groups: dict[tuple, list] = {}
    for light in lights:
        nearest = light.stands()[2] - light.reach()
        key = (
            type(light),
            id(getattr(light, "board", None)),
            tuple((w, getattr(light, w)) for w in light.words),
            tuple(light.places()),
            tuple(z > nearest for z in faces),
        )
        groups.setdefault(key, []).append(light)
    return list(groups.values())


class Group:
    """What images of alike LEDs over one geometry are made from: a lane for each LED and pixel, and for each of the
    finer samples that an LED takes.

    lights       the LEDs;   sample   ends of the camera's rays at the pixels' centres, of which there are `pixels`
    visible      what each LED reaches of these, LED by LED, as `Renderer._visible` has it; None before
    finer        the finer samples of all LEDs, LED by LED; None where none takes any
    ends         how many there are of these without those that LEDs share
    rim_visible  what each LED reaches of its own
    """

    def __init__(self, lights: Sequence, sample: Sample, pixels: int):
        import drjit as dr
        import mitsuba as mi

        self.lights, self.sample, self.pixels = tuple(lights), sample, pixels
        self.names = [light.name for light in lights]
        self.visible = self.rim_visible = self._ends = None
        self.sizes, self.ends = [0] * len(self.names), 0
        lanes = dr.arange(mi.UInt32, len(self.names) * pixels)
        self._pixel, self._light, self._fine_light, self._end = lanes % pixels, lanes // pixels, None, None

    def centres(self) -> Sample:
        """The ends of rays at pixels' centres, in every lane."""
        return gathered(self.sample, self._pixel)

    def at_centres(self, given: dict | None = None) -> Together:
        """The lights, in every lane of `centres`."""
        return Together(self.lights, self._light, given)

    def at_finer(self, given: dict | None = None) -> Together:
        """The lights, in every lane of `finer`."""
        return Together(self.lights, self._fine_light, given)

    @property
    def finer(self) -> Sample | None:
        return gathered(self._ends, self._end)

    def split(self, finer: Finer, places: Sequence[np.ndarray]) -> list[Finer]:
        """Take finer samples that LEDs share, of each LED the places of its pixels among theirs; gives those of
        each."""
        import mitsuba as mi

        starts = np.cumsum(finer.counts) - finer.counts
        counts = [finer.counts[own] for own in places]
        ends = [
            np.repeat(starts[own] + count - np.cumsum(count), count) + np.arange(count.sum())
            for own, count in zip(places, counts)
        ]
        self.sizes, self._ends, self.ends = [len(own) for own in ends], finer.sample, finer.size
        self._end = mi.UInt32(aligned(np.concatenate(ends), np.uint32))
        self._fine_light = mi.UInt32(aligned(np.repeat(np.arange(len(places)), self.sizes), np.uint32))
        return [
            Finer(count, self._own_finer(k), (finer.at[0][own], finer.at[1][own]))
            for k, (count, own) in enumerate(zip(counts, ends))
        ]

    def _own_finer(self, k: int):
        if not self.sizes[k]:
            return None
        return lambda: gathered(self._ends, gathered(self._end, self._fine(k)))

    def _fine(self, k: int):
        """Lanes of the finer samples of a light."""
        return _lanes(sum(self.sizes[:k]), self.sizes[k])

    def apart(self, centres: np.ndarray, fine: np.ndarray | None) -> list[tuple]:
        """(values at the pixels' centres, at the finer samples or None) of each light, from those of all lanes."""
        cuts = np.cumsum(self.sizes)[:-1]
        own = np.split(fine, cuts) if fine is not None else [None] * len(self.sizes)
        return [(c, f if f is not None and len(f) else None) for c, f in zip(np.split(centres, len(self.sizes)), own)]

    def visible_to(self, name: str):
        """`visible` of one light."""
        return gathered(self.visible, _lanes(self.names.index(name) * self.pixels, self.pixels))

    def finely_visible_to(self, name: str):
        """`rim_visible` of one light."""
        k = self.names.index(name)
        return gathered(self.rim_visible, self._fine(k)) if self.sizes[k] else None


def _lanes(first: int, count: int):
    """Lanes behind each other; the first is opaque: as a literal it would be compiled into a kernel of its own."""
    import drjit as dr
    import mitsuba as mi

    return dr.opaque(mi.UInt32, first) + dr.arange(mi.UInt32, count)


def gathered(tree, lanes):
    """What a tree of Dr.Jit arrays holds in some lanes; what is the same in all stays as it is."""
    import drjit as dr

    if tree is None:
        return None
    if isinstance(tree, list):
        return [gathered(item, lanes) for item in tree]
    if isinstance(tree, Sample):
        return Sample(*(gathered(item, lanes) for item in tree))
    if dr.is_struct_v(tree):
        found = type(tree)()
        for name in type(tree).DRJIT_STRUCT:
            setattr(found, name, gathered(getattr(tree, name), lanes))
        return found
    if not dr.is_array_v(tree):
        return tree
    if dr.depth_v(tree) > 1:
        return type(tree)(*(gathered(item, lanes) for item in tree))
    return tree if dr.width(tree) == 1 else dr.gather(type(tree), tree, lanes)
