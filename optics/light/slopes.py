"""Derivatives of the light of one LED, or of several that were made together, by numbers of parts: in forward mode at
the pixels' centres and at the finer samples, there with what shadows add that move."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from itertools import repeat
from typing import TYPE_CHECKING, Any

import numpy as np

from optics.light.moving_shadows import turned
from optics.light.samples import LedImage
from optics.light.together import numbers_of

if TYPE_CHECKING:
    from optics.light.renderer import Renderer

MOVES = ("light x", "light y", "light z", "light turn")  # roles of a light's parameters that move it


class Slopes:
    """Of the image of an LED by the parameters `keys`; of several that were made together, `mates`, each by its own
    LED's parameters.

    moving    the parameters that move the light, and with it shadows at the finer samples
    straight  whether it is a point that is seen straight, whose shadows move as optics.light.moving_shadows has it
    """

    def __init__(self, renderer: Renderer, image: LedImage, keys: Sequence[str], mates: Sequence[LedImage] = ()):
        parts = renderer.scene.parts
        self.renderer, self.image, self.keys, self.mates = renderer, image, list(keys), mates
        self.lamp, self.group = renderer.scene.leds[image.led], image.group if mates else None
        self.sampled = bool(len(image.index)) if self.group is None else self.group.finer is not None
        self.moving = [k for k in keys if self.sampled and _moves(k, self.lamp, parts)]
        self.straight = bool(self.moving) and not renderer.crowded and not self.lamp.places()
        self._places = {k: (parts[k.rsplit(".", 1)[0]], k.rsplit(".", 1)[1]) for k in keys}
        together = self.group is not None
        self._own = {k: name for k, (part, name) in self._places.items() if together and part is self.lamp}

    def made(self, values: Mapping) -> dict[LedImage, dict[str, tuple]]:
        """Image -> key -> (values at the centres, at the finer samples or None), as `Renderer._raw` has them."""
        r, image, group = self.renderer, self.image, self.group
        r.apply(values, move=bool(self.moving))
        pixels = image.hits.size * max(len(self.mates), 1)
        rays = image.finer.size if group is None else sum(group.sizes)
        centres: Iterable[np.ndarray] = repeat(np.zeros((pixels, r.bands)))
        if not r.crowded:
            made = r._each_band_of(self._at_centres, image.led)
            centres = [np.broadcast_to(m, (pixels, r.bands)) for m in made]
        finely: Iterable[np.ndarray | None] = repeat(None)
        if self.sampled:
            made = r._each_band_of(self._at_finer, image.led)
            finely = [np.broadcast_to(m, (rays, r.bands)) for m in made]
        wide = image.hits.everywhere
        if group is None:
            return {image: {k: (wide(c), f) for k, c, f in zip(self.keys, centres, finely)}}
        each = zip(*(group.apart(c, f) for c, f in zip(centres, finely)))
        return {
            mate: {of_light(k, image.led, mate.led): (wide(c), f) for k, (c, f) in zip(self.keys, raw)}
            for mate, raw in zip(self.mates, each)
        }

    # -- of what ----------------------------------------------------------------------------------------------------
    def _at_centres(self) -> list:
        if self.group is None:
            return self._shading(self.image.hits.sample, lambda given: self.lamp, self.image.visible, self.keys)
        return self._shading(self.group.centres(), self.group.at_centres, self.group.visible, self.keys)

    def _at_finer(self) -> list:
        sample, lights = self._finer
        visible = (self.image if self.group is None else self.group).rim_visible
        if self.straight:
            return self._with_shadows(sample, lights, visible)
        still = [k for k in self.keys if k not in self.moving]
        found = dict(zip(still, self._shading(sample, lights, visible, still))) if still else {}
        return [found[k] if k in found else self._by_difference(k, sample, lights) for k in self.keys]

    @cached_property
    def _finer(self) -> tuple[Any, Callable]:
        """(the finer samples, what gives the light in every lane of them)."""
        if self.group is None:
            return self.image.finer.sample, lambda given: self.lamp
        return self.group.finer, self.group.at_finer

    # -- how --------------------------------------------------------------------------------------------------------
    def _shading(self, sample, lights: Callable, visible, keys: Sequence[str]) -> list:
        """Where shadows stay."""
        import drjit as dr
        import mitsuba as mi

        attached = {k: mi.Float(dr.detach(self._value(k))) for k in keys}

        def take(light):
            found = []
            for value in attached.values():
                dr.set_grad(value, 1.0)
                found.append(dr.forward_to(light, flags=dr.ADFlag.ClearVertices | dr.ADFlag.AllowNoGrad))
                dr.clear_grad(value)
                dr.clear_grad(light)
            return found

        dr.enable_grad(*attached.values())
        with self._put(attached) as given:
            return self.renderer._shade_each(sample, lights(given), visible, take)

    def _with_shadows(self, sample, lights: Callable, visible) -> list:
        """Of a point light: how what it lights changes, and what its shadows take where they move."""
        import drjit as dr
        import mitsuba as mi

        found = dict(zip(self.keys, self._shading(sample, lights, visible, self.keys)))
        lit, unlit = (self.renderer._shade(sample, lights({}), mi.Mask(seen)) for seen in (True, False))
        for key in self.moving:
            speed = self._speed(key, lights)
            found[key] += (lit - unlit) * sum(dr.dot(speed, side) * rate for side, rate in self._shadows)
        return [found[k] for k in self.keys]

    def _by_difference(self, key: str, sample, lights: Callable):
        """A central difference, shadows included."""
        import drjit as dr
        import mitsuba as mi

        r = self.renderer
        number = r.scene.parameters[key]
        step, sides = number.step * number.plausible, []
        for sign in (1, -1):
            value = mi.Float(self._value(key) + sign * step)
            dr.make_opaque(value)
            with self._put({key: value}) as given:
                light = lights(given)
                sides.append(r._shade(sample, light, r._visible(sample.si, light)))
        return (sides[0] - sides[1]) / (2 * step)

    @cached_property
    def _shadows(self) -> list[tuple]:
        """How the shadows at the finer samples move with the light: the same in all bands."""
        sample, lights = self._finer
        return turned(self.renderer.scene.integrator, self.renderer._world(), sample.si, lights({}))

    def _speed(self, key: str, lights: Callable):
        """How far the light moves per unit of a parameter, mm."""
        import drjit as dr
        import mitsuba as mi

        value = mi.Float(dr.detach(self._value(key)))
        dr.enable_grad(value)
        with self._put({key: value}) as given:
            at = lights(given).position()
        dr.set_grad(value, 1.0)
        return dr.forward_to(at, flags=dr.ADFlag.ClearVertices | dr.ADFlag.AllowNoGrad)

    # -- numbers of parts -------------------------------------------------------------------------------------------
    def _value(self, key: str):
        """Of several LEDs, one value for each."""
        return numbers_of(self.group.lights, self._own[key]) if key in self._own else getattr(*self._places[key])

    @contextmanager
    def _put(self, numbers: Mapping) -> Iterator[dict]:
        """Within it parts hold other numbers; gives those that are the LEDs' own."""
        before = {k: getattr(*self._places[k]) for k in numbers if k not in self._own}
        for k in before:
            setattr(*self._places[k], numbers[k])
        try:
            yield {self._own[k]: number for k, number in numbers.items() if k in self._own}
        finally:
            for k, number in before.items():
                setattr(*self._places[k], number)


def _moves(key: str, lamp, parts: Mapping) -> bool:
    """Whether a parameter moves this light."""
    name, number = key.rsplit(".", 1)
    return name == board_of(lamp) or (parts[name] is lamp and lamp.numbers[number].role in MOVES)


def of_light(key: str, led: str, other: str) -> str:
    """The key of an LED's own parameter, of another LED; any other key as it is."""
    name, _, number = key.rpartition(".")
    return f"{other}.{number}" if name == led else key


def board_of(light) -> str:
    """Name of the board that a light stands on; '' for none."""
    board = getattr(light, "board", None)
    return board.name if board is not None else ""
