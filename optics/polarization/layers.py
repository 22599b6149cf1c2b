"""Layers: thin sheets that change light as it passes, as Mueller matrices in the light's own axes.

A layer is a part of the category `bsdf` on a flat or curved surface. Its physics is one function of what a ray meets:

    mueller(crossing, layer) -> Mueller          crossing: how the light passes (`Crossing`); layer: the part's
                                                 parameters

in arithmetic that numpy arrays and Dr.Jit share (optics.polarization.mueller). The prediction follows each camera ray
through the layers (optics.light.paths) and multiplies these matrices in numpy; mi.render meets the same function inside
a null BSDF (`bsdf`). Effects add to it at the stage `layer`, with a function of the same form."""

from __future__ import annotations

import math
from collections.abc import Callable

from optics.polarization.mueller import Mueller, absorber, cos, sin, sqrt, where


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


class Crossing:
    """How light passes a layer, in the layer's own axes: z the normal (towards the viewer), x the layer's zero
    direction.

    k            unit vector of the light's direction, (kx, ky, kz)
    x, y         the axes that the Stokes vectors refer to, unit vectors with k = x cross y
    u, v         where it passes, mm along the layer's x and y axes from the layer's middle
    wavelengths  nm
    """

    def __init__(self, k, x, u, v, wavelengths):
        self.k, self.x, self.u, self.v, self.wavelengths = k, x, u, v, wavelengths
        self.y = cross(k, x)

    @property
    def cos(self):
        """Cosine of the angle of incidence."""
        return where(self.k[2] < 0, -self.k[2], self.k[2])

    def _doubled(self, axis):
        """(cos 2 phi, sin 2 phi) of a direction across k, of any length, against the axes x, y."""
        c, s = dot(axis, self.x), dot(axis, self.y)
        norm = c * c + s * s
        return (c * c - s * s) / norm, 2 * c * s / norm

    def polarizer_axis(self, angle) -> tuple:
        """(q, u) of the transmitted direction of a sheet polarizer whose transmission axis lies at `angle` (deg).

        Across the ray and across the absorbing molecules a: t = k x a (Korger et al., Opt. Express 21, 27032 (2013)).
        """
        angle = angle * (math.pi / 180)
        return self._doubled(cross(self.k, (-sin(angle), cos(angle), 0 * angle)))

    def axis(self, angle) -> tuple:
        """(q, u) of a direction in the sheet at `angle` (deg), seen along the ray."""
        angle = angle * (math.pi / 180)
        a = (cos(angle), sin(angle), 0 * angle)
        along = dot(a, self.k)
        return self._doubled(tuple(c - along * k for c, k in zip(a, self.k)))

    def plane(self) -> tuple:
        """(q, u) of the s direction, across the plane of incidence; that of the layer's x axis at normal incidence."""
        level = 1 - self.k[2] * self.k[2] < 1e-12
        return self._doubled(
            (where(level, 0.0 * self.k[1] + 1, -self.k[1]), where(level, 0.0, self.k[0]), 0 * self.k[2])
        )

    def retardance(self, a, b, index) -> tuple:
        """Components against the axes x, y of a retardance that is (a, b) against the sheet's own axes at normal
        incidence.

        The sheet's birefringence is the tensor [[a, b], [b, -a]]/2 in its plane (a along x less along y, b along the
        diagonals), without part along its normal; a ray sees what of it lies across the ray inside the sheet, over a
        path longer by 1/cos. Small birefringence: Yeh & Gu, Optics of Liquid Crystal Displays, 2nd ed., 3.2."""
        inner = sqrt(1 - (1 - self.k[2] * self.k[2]) / (index * index))
        bent = (self.k[0] / index, self.k[1] / index, where(self.k[2] < 0, -inner, inner))
        middle = tuple(p + q for p, q in zip(self.k, bent))
        share = 1 + dot(self.k, bent)
        x, y = (tuple(c - dot(bent, axis) / share * m for c, m in zip(axis, middle)) for axis in (self.x, self.y))

        def tensor(p, q):
            return (a * (p[0] * q[0] - p[1] * q[1]) + b * (p[0] * q[1] + p[1] * q[0])) / 2

        return (tensor(x, x) - tensor(y, y)) / inner, 2 * tensor(x, y) / inner


def evaluate(own: Callable, crossing: Crossing, layer, effects=()) -> Mueller:
    """The layer's own Mueller matrix, then those of `effects` (of the stage `layer`), in their order.

    A layer with `cover`, f(u, v) -> 1 or 0, does nothing where that is 0."""
    matrix = own(crossing, layer)
    for effect in effects:
        matrix = effect.stages["layer"](crossing, layer) @ matrix
    cover = getattr(layer, "cover", None)
    if cover is None:
        return matrix
    inside = cover(crossing.u, crossing.v)
    return matrix * inside + absorber(1 - inside)


class Texture:
    """An image (H, W, C) for Dr.Jit: f(s, t) -> C values at s along the columns and t along the rows, both from 0 to 1
    over the whole pixels, linear between their centres and constant beyond."""

    def __init__(self, values):
        self.values, self.made = values, {}

    def __call__(self, s, t):
        import drjit as dr
        import mitsuba as mi

        if mi.variant() not in self.made:
            self.made[mi.variant()] = mi.Texture2f(
                # the texture units of graphics processors interpolate with weights of eight bits
                mi.TensorXf(self.values.astype("float32")),
                use_accel=False,
                wrap_mode=dr.WrapMode.Clamp,
            )
        return self.made[mi.variant()].eval(mi.Point2f(s, t))
