"""A crowd: a shape of thousands of balls, traced as balls and not as their mesh.

A part that has `balls()` -> ((N, 3) middles, (N,) radii) in mm is a crowd. Plain Mitsuba traces its mesh, as the part
may be pressed, carved or exported as any mesh; images LED by LED trace Mitsuba's stock `ellipsoids` in its place, which
stand in a second scene beside the other shapes of the first. Its tree of 3000 boxes is made in milliseconds, where that
of a million triangles takes a second, and a ray costs a third."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

BEYOND = 1e-4  # share of the coordinates' size by which a ray starts beyond an interface (optics.light.led_by_led)


@contextlib.contextmanager
def _remarks_away() -> Iterator[None]:
    """Without what nanobind writes to stderr of the types that a tensor is not, while Mitsuba takes one as a
    property."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _scene(shapes):
    import mitsuba as mi

    return mi.load_dict({"type": "scene", **{f"shape{k}": shape for k, shape in enumerate(shapes)}}, optimize=False)


class Crowd:
    """Balls of one part in a scene of their own, and what a ray meets of them.

    first    number of the first ball among those of all crowds, from 1
    """

    def __init__(self, part, first: int):
        import mitsuba as mi

        self.part, self.first = part, first
        self.count = len(part.balls()[1])
        with _remarks_away():
            self.shape = mi.load_dict({"type": "ellipsoids", **self._tensors(), "extent": 1.0, "bsdf": part.bsdf()})
        self.place()

    def _tensors(self):
        import mitsuba as mi

        middles, radii = self.part.balls()
        unturned = np.tile(np.array([0, 0, 0, 1], np.float32), (len(radii), 1))
        rows = {"centers": middles, "scales": np.repeat(radii[:, None], 3, 1), "quaternions": unturned}
        return {name: mi.TensorXf(row.astype(np.float32)) for name, row in rows.items()}

    def place(self) -> None:
        """Take up where the balls are now."""
        import drjit as dr
        import mitsuba as mi

        self.middles, self.radii = self.part.balls()
        params = mi.traverse(self.shape)
        now = np.array(params["data"]).reshape(self.count, -1)  # middle, three half axes, rotation
        now[:, :3], now[:, 3:6] = self.middles, self.radii[:, None]
        params["data"] = mi.Float(now.astype(np.float32).ravel())
        params.update()
        self._rows = mi.Float(np.column_stack([self.middles, self.radii]).astype(np.float32).ravel())
        dr.eval(self._rows)

    def sharpen(self, si: Any, origin: Any) -> Any:
        """The same hits, to the last digits of float32: Mitsuba's are off by up to a hundredth of a radius at rims.

        With b = (s - o).d and l the distance of the middle s from the ray, t = b - sqrt(r^2 - l^2)."""
        import drjit as dr
        import mitsuba as mi

        own = si.is_valid() & (si.shape == mi.ShapePtr(self.shape))
        row = 4 * dr.select(own, si.prim_index, 0)
        s = mi.Point3f(*(dr.gather(mi.Float, self._rows, row + i, own) for i in range(3)))
        r = dr.gather(mi.Float, self._rows, row + 3, own)
        d = -si.to_world(si.wi)
        b = dr.dot(s - origin, d)
        off = origin + b * d - s
        t = b - dr.sqrt(dr.maximum(dr.square(r) - dr.squared_norm(off), 0.0))
        n: Any = mi.Normal3f(dr.normalize(origin + t * d - s))
        si.t = dr.select(own, t, si.t)
        si.p = dr.select(own, s + r * n, si.p)
        si.n = dr.select(own, n, si.n)
        si.sh_frame = dr.select(own, mi.Frame3f(n), si.sh_frame)
        si.wi = dr.select(own, si.to_local(-d), si.wi)
        return si


class Traced:
    """The scene that images LED by LED trace: one with balls in place of crowds' meshes.

    scene    Mitsuba's, of other shapes than crowds, and their balls, without flat interfaces
    windows  these interfaces, which lie between the camera and all else
    """

    def __init__(self, whole, parts):
        found = [part for part in parts if hasattr(part, "balls")]
        firsts = np.cumsum([1, *(len(part.balls()[1]) for part in found)])
        self.crowds = [Crowd(part, int(first)) for part, first in zip(found, firsts)]
        self.bodies = int(firsts[-1])  # the first number that no ball has
        others = [shape for shape in whole.shapes() if not any(shape is part for part in found)]
        flat = [shape for shape in others if getattr(shape.bsdf(), "role", "") == "interface"]
        others = [shape for shape in others if not any(shape is window for window in flat)]
        self.scene = _scene((*others, *(c.shape for c in self.crowds)))
        self.windows = [shape.bsdf() for shape in flat]
        self._front = _scene(flat)

    def faces(self) -> list:
        """The shapes of the interfaces that bend light, the camera's first; none while no index differs."""
        if all(window.number("index") == 1 for window in self.windows):
            return []
        return sorted(self._front.shapes(), key=lambda shape: float(shape.bbox().min.z))

    def place(self) -> None:
        """Take up where all shapes are now."""
        for crowd in self.crowds:
            crowd.place()
        self.scene.parameters_changed([])
        self._front.parameters_changed([])

    def enter(self, o: Any, d: Any, wavelengths: Any) -> tuple:
        """Rays behind the flat interfaces between the camera and all else, and what these leave of their light.

        They start a ball's diameter before the last interface, as if what they saw from behind it went on: a press may
        push a ball a little through, and a ray that starts within it would see its far side."""
        import drjit as dr
        import mitsuba as mi

        weight: Any = mi.UnpolarizedSpectrum(1.0)
        if all(window.number("index") == 1 for window in self.windows):
            return o, d, weight
        room: Any = mi.Float(0.0)  # before the last interface
        for _ in self.windows:
            ray: Any = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d))
            ray.wavelengths = wavelengths
            si: Any = self._front.ray_intersect(ray)
            flat = si.is_valid()
            bs, passed = si.bsdf().sample(mi.BSDFContext(), si, mi.Float(0.5), mi.Point2f(0.5), flat)
            d = dr.select(flat, si.to_world(bs.wo), d)
            o = dr.select(flat, si.p + d * (BEYOND * (1 + dr.max(dr.abs(si.p)))), o)
            weight = dr.select(flat, weight * mi.unpolarized_spectrum(passed), weight)
            room = dr.select(flat, si.t, room)
        widest = 2 * max((float(np.max(crowd.radii)) for crowd in self.crowds), default=0.0)
        return o - d * dr.minimum(widest, room), d, weight

    def sharpen(self, si, origin):
        for crowd in self.crowds:
            si = crowd.sharpen(si, origin)
        return si

    def number(self, met):
        """A number for the body that a ray met, other than any other's: of balls their own, of other shapes one each,
        0 of none."""
        import drjit as dr
        import mitsuba as mi

        number = mi.UInt32(0)
        for k, shape in enumerate(self.scene.shapes()):
            own = met.is_valid() & (met.shape == mi.ShapePtr(shape))
            crowd = next((c for c in self.crowds if c.shape is shape or c.shape == shape), None)
            number = dr.select(own, self.bodies + k if crowd is None else crowd.first + met.prim_index, number)
        return number
