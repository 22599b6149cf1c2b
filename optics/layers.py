"""Layers: thin sheets that change light as it passes, as Mueller matrices in the light's own axes.

A layer is a part of the category `bsdf` on a flat or curved surface. Its physics is one function of what a ray meets:

    mueller(crossing, layer) -> Mueller          crossing: how the light passes (`Crossing`); layer: the part's parameters

in arithmetic that numpy arrays and Dr.Jit share (optics.mueller). The prediction follows each camera ray through the layers
(optics.paths) and multiplies these matrices in numpy; mi.render meets the same function inside a null BSDF (`bsdf`).
Effects add to it at the stage `layer`, with a function of the same form.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import SimpleNamespace

from optics.bsdf import passing
from optics.effect import Part, registry
from optics.mueller import Mueller, cos, real, sin, sqrt, where

MONO = 540.0  # nm: the wavelength of variants that know none


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


class Crossing:
    """How light passes a layer, in the layer's own axes: z the normal (towards the viewer), x the layer's zero direction.

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
        return self._doubled((where(level, 0.0 * self.k[1] + 1, -self.k[1]), where(level, 0.0, self.k[0]), 0 * self.k[2]))

    def retardance(self, a, b, index) -> tuple:
        """Components against the axes x, y of a retardance that is (a, b) against the sheet's own axes at normal incidence.

        The sheet's birefringence is the tensor [[a, b], [b, -a]]/2 in its plane (a along x less along y, b along the diagonals),
        without part along its normal; a ray sees what of it lies across the ray inside the sheet, over a path longer by 1/cos.
        Small birefringence: Yeh & Gu, Optics of Liquid Crystal Displays, 2nd ed., 3.2.
        """
        inner = sqrt(1 - (1 - self.k[2] * self.k[2]) / (index * index))
        bent = (self.k[0] / index, self.k[1] / index, where(self.k[2] < 0, -inner, inner))
        middle = tuple(p + q for p, q in zip(self.k, bent))
        share = 1 + dot(self.k, bent)
        x, y = (tuple(c - dot(bent, axis) / share * m for c, m in zip(axis, middle)) for axis in (self.x, self.y))

        def tensor(p, q):
            return (a * (p[0] * q[0] - p[1] * q[1]) + b * (p[0] * q[1] + p[1] * q[0])) / 2

        return (tensor(x, x) - tensor(y, y)) / inner, 2 * tensor(x, y) / inner


def evaluate(kind: str, own: Callable, crossing: Crossing, layer, active=None) -> Mueller:
    """The layer's matrix with those of its effects, in the order of their keys; `active` are the stage's effects."""
    matrix = own(crossing, layer)
    for effect in registry().at_stage(kind, "layer") if active is None else active:
        matrix = effect.stages["layer"](crossing, layer) @ matrix
    return matrix


def active_effects(kind: str, values: Mapping) -> list:
    """Effects of the stage `layer` that do not rest at neutral, for values by parameter name (numbers, arrays, complex)."""
    import numpy as np

    neutral = {p.name: p.neutral for p in registry().parameters_of(kind)}
    return [e for e in registry().at_stage(kind, "layer")
            if any(np.any(np.asarray(values[n]) != neutral[n]) for n in e.parameter_names)]


class PatternImage:
    """A pattern of two numbers from an image (H, W, 2 or more): f(x, y, size) over a square of `size` mm about the layer's middle,
    row 0 at +y, linear between the pixels' centres, 0 outside; x, y and size may be numpy's (complex ones too) or Dr.Jit's."""

    def __init__(self, path):
        from pathlib import Path

        import numpy as np

        from optics.errors import BadScene

        path = Path(path)
        if not path.is_file():
            raise BadScene(f"{path}: no such file; allowed: an image of a pattern, (H, W, 2), as .npy or .exr")
        if path.suffix == ".npy":
            values = np.load(path)
        else:
            from optics.images import read_image

            values, _ = read_image(path, str(path))
        if values.ndim != 3 or values.shape[2] < 2 or not np.isfinite(values).all():
            raise BadScene(f"{path}: shape {values.shape}; allowed: (H, W, 2 or more), all finite: s_xx - s_yy and 2 s_xy")
        self.values = np.asarray(values[..., :2], float)
        self.texture = Texture(self.values)

    def __call__(self, x, y, size):
        import numpy as np

        s, t = 0.5 + x / size, 0.5 - y / size
        inside = (real(s) >= 0) & (real(s) <= 1) & (real(t) >= 0) & (real(t) <= 1)
        if isinstance(s, np.ndarray):
            s, t = np.broadcast_arrays(s, t)
            found = self._linear(s, t)
        else:
            found = self.texture(s, t)
        return tuple(where(inside, f, 0.0 * f) for f in found)

    def _linear(self, s, t) -> tuple:
        import numpy as np

        low, share = [], []
        for place, count in zip((t, s), self.values.shape):
            place = place * count - 0.5
            place = np.where(np.real(place) < 0, 0.0, np.where(np.real(place) > count - 1, count - 1, place))
            low.append(np.minimum(np.real(place).astype(int), max(count - 2, 0)))
            share.append(place - low[-1])
        (i, j), (a, b) = low, share
        down, right = (np.minimum(k + 1, count - 1) for k, count in zip(low, self.values.shape))
        for v in np.moveaxis(self.values, -1, 0):
            yield (1 - a) * ((1 - b) * v[i, j] + b * v[i, right]) + a * ((1 - b) * v[down, j] + b * v[down, right])


class Texture:
    """An image (H, W, C) for Dr.Jit: f(s, t) -> C values at s along the columns and t along the rows, both from 0 to 1 over
    the whole pixels, linear between their centres and constant beyond."""

    def __init__(self, values):
        self.values, self.made = values, {}

    def __call__(self, s, t):
        import drjit as dr
        import mitsuba as mi

        if mi.variant() not in self.made:
            self.made[mi.variant()] = mi.Texture2f(mi.TensorXf(self.values.astype("float32")), wrap_mode=dr.WrapMode.Clamp)
        return self.made[mi.variant()].eval(mi.Point2f(s, t))


def crossing_of(si, band: float | None = None, extent: tuple[float, float] | None = None) -> Crossing:
    """How light that leaves a surface interaction towards si.wi passes the surface, in Mitsuba's implicit axes (Dr.Jit).

    band    nm, of mono variants;   extent  width and length at rest of a sheet that stretches
    """
    import drjit as dr
    import mitsuba as mi

    normal = si.sh_frame.n
    across = dr.normalize(si.dp_du - normal * dr.dot(normal, si.dp_du))
    frame = mi.Frame3f(across, dr.cross(normal, across), normal)
    world = si.to_world(si.wi)
    k, x = frame.to_local(world), frame.to_local(mi.mueller.stokes_basis(world))
    wavelengths = mi.UnpolarizedSpectrum(si.wavelengths) if mi.is_spectral else mi.UnpolarizedSpectrum(band or MONO)
    width, length = extent or (dr.norm(si.dp_du), dr.norm(si.dp_dv))
    v = (si.uv.y - 0.5) * length * dr.sign(dr.dot(si.dp_dv, frame.t))
    return Crossing((k.x, k.y, k.z), (x.x, x.y, x.z), (si.uv.x - 0.5) * width, v, wavelengths)


def numbers_of(part) -> SimpleNamespace:
    """A part's parameters as its functions read them, in Dr.Jit."""
    return SimpleNamespace(name=part.name, field=getattr(part, "field", None), **{n: getattr(part, n) for n in (*part.numbers, *part.words)})


def layer(kind: str, parameters: tuple, mueller: Callable) -> Part:
    """The declaration of a layer: its name in XML, its parameters, its Mueller matrix."""
    return Part(kind, "bsdf", parameters, lambda: bsdf(kind, mueller), mueller=mueller)


def bsdf(kind: str, own: Callable) -> type:
    """A null BSDF of the present Mitsuba variant that weighs passing light with the layer's matrix."""
    import drjit as dr
    import mitsuba as mi

    class Layer(passing(mi.BSDFFlags.Null)):
        carrier = None  # the stretching shape that it lies on, if it does

        def extent(self):
            return None if self.carrier is None else (self.carrier.number("width"), self.carrier.number("length"))

        def matrix(self, si):
            """What light that leaves towards si.wi went through, in Mitsuba's implicit axes."""
            stages = [e for e in registry().at_stage(kind, "layer") if e.stages["layer"] in self.functions("layer")]
            return evaluate(kind, own, crossing_of(si, self.band, self.extent()), numbers_of(self), stages)

        def weight(self, si, active):
            matrix = self.matrix(si)
            value = matrix.mitsuba() if mi.is_polarized else mi.Spectrum(matrix.rows[0][0])
            if mi.is_polarized:  # in BSDF code matrices stand in the implicit axes of local directions
                value = si.to_local_mueller(value, si.to_world(si.wi), si.to_world(si.wi))
            return dr.select(active, value, 0.0)

        def sample(self, ctx, si, sample1, sample2, active=True):
            return self.passed(-si.wi, 1.0, mi.BSDFFlags.Null), self.weight(si, active)

        def eval_null_transmission(self, si, active=True):
            return self.weight(si, active)

    Layer.kind = kind
    return Layer
