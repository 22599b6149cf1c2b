"""Layers as parts: the declaration of a thin sheet by its Mueller matrix, and the null BSDF by which Mitsuba meets
it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import SimpleNamespace

from optics.errors import BadCapture, BadScene
from optics.polarization.layers import Crossing, Texture, evaluate
from optics.polarization.mueller import real, where
from optics.scene.declare import Part
from optics.scene.mitsuba_parts import Neighbour
from optics.scene.registry import Registry
from optics.scene.surfaces import passing, to_local_mueller

MONO = 540.0  # nm: the wavelength of variants that know none


def active_effects(registry: Registry, kind: str, values: Mapping, stage: str = "layer") -> list:
    """Effects of a stage that do not rest at neutral, for values by parameter name (numbers, arrays, complex)."""
    import numpy as np

    neutral = {p.name: p.neutral for p in registry.parameters_of(kind)}
    return [
        e for e in registry.at_stage(kind, stage) if any(np.any(np.asarray(values[n]) != neutral[n]) for n in e.at_rest)
    ]


class PatternImage:
    """A pattern of two numbers from an image (H, W, 2 or more): f(x, y, size) over a square of `size` mm about the
    layer's middle, row 0 at +y, linear between the pixels' centres, 0 outside; x, y and size may be numpy's (complex
    ones too) or Dr.Jit's."""

    def __init__(self, path):
        from pathlib import Path

        import numpy as np

        from optics.files.images import read_array

        path = Path(path)
        if not path.is_file():
            raise BadScene(f"{path}: no such file; allowed: an image of a pattern, (H, W, 2), as .npy or .exr")
        try:
            values = read_array(path, str(path))
        except BadCapture as error:
            raise BadScene(str(error)) from error
        if (
            values.ndim != 3
            or values.shape[2] < 2
            or 0 in values.shape
            or values.dtype.kind not in "uif"
            or not np.isfinite(values).all()
        ):
            raise BadScene(
                f"{path}: shape {values.shape}, type {values.dtype}; allowed: (H, W, 2 or more), all finite: "
                "s_xx - s_yy and 2 s_xy"
            )
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


def crossing_of(si, band: float | None = None, extent: tuple[float, float] | None = None) -> Crossing:
    """How light that leaves a surface interaction towards si.wi passes the surface, in Mitsuba's implicit axes
    (Dr.Jit).

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
    return SimpleNamespace(
        name=part.name,
        field=getattr(part, "field", None),
        **part.context({n: getattr(part, n) for n in part.words}),
        **{n: getattr(part, n) for n in (*part.numbers, *part.words)},
    )


def layer(
    kind: str,
    parameters: tuple,
    mueller: Callable,
    *,
    polarizes: bool = False,
    checks: tuple = (),
    random: Callable | None = None,
    beside: tuple[str, ...] = (),
) -> Part:
    """The declaration of a layer: its name in XML, its parameters, its Mueller matrix, whether it polarizes light, its
    checks and its sampler.

    beside  parameters that effects free only where the layer covers a part of the view: elsewhere they are a share of
    the
            light's power
    """
    return Part(
        kind,
        "bsdf",
        parameters,
        lambda: bsdf(kind, mueller, beside),
        checks,
        mueller=mueller,
        polarizes=polarizes,
        random=random,
    )


def bsdf(kind: str, own: Callable, beside: tuple[str, ...] = ()) -> type:
    """A null BSDF of the present Mitsuba variant that weighs passing light with the layer's matrix."""
    import drjit as dr
    import mitsuba as mi

    class Layer(passing(mi.BSDFFlags.Null)):
        unrendered = {"face": "mi.render leaves out what layers reflect to one another"}
        carrier = Neighbour()  # the stretching shape that it lies on, if it does
        skin = Neighbour()  # the gel of the scene
        field = None  # what an effect makes of both (optics.scene.declare.Effect.field)

        def wire(self, scene):
            shapes = scene.shapes_of(self)
            carriers = [shape for shape in shapes if hasattr(shape, "carrier") and shape.named("width")]
            if carriers and len(shapes) > 1:
                raise BadScene(
                    f"'{self.name}' lies on {len(shapes)} shapes ({', '.join(repr(s.id()) for s in shapes)}), but a "
                    "layer that stretches needs a material of its own; where the XML gives each its own, load it with "
                    "optimize=False, as Mitsuba makes one of equal materials"
                )
            self.carrier, self.skin = carriers[0] if carriers else None, scene.one("gel")
            if self.word("regions") is not None and shapes:
                self.place_maps(scene.one("camera"), shapes[0])
            self.follow(self.carrier, self.skin)
            if not self._leaders:
                self.place()

        def place(self):
            fields = [e.field(self) for e in self.registry.at_stage(kind, "layer") if e.field is not None]
            self.field = next((found for found in fields if found is not None), None)

        def takes(self, name):
            regions = self.map_of_regions({n: getattr(self, n) for n in self.words})
            if regions is None:
                return name not in beside
            return regions.has(int(getattr(self, self.word("region"))))

        def context(self, words):
            regions = self.map_of_regions(words)
            if regions is None:
                return {}
            number = int(words[self.word("region")])
            return {"cover": lambda x, y: regions.within(x, y, number)}

        def extent(self):
            return None if self.carrier is None else (self.carrier.numbered("width"), self.carrier.numbered("length"))

        def matrix(self, si):
            """What light that leaves towards si.wi went through, in Mitsuba's implicit axes."""
            stages = [e for e in self.registry.at_stage(kind, "layer") if e.stages["layer"] in self.functions("layer")]
            return evaluate(own, crossing_of(si, self.band, self.extent()), numbers_of(self), stages)

        def weight(self, si, active):
            matrix = self.matrix(si)
            value = matrix.mitsuba() if mi.is_polarized else mi.Spectrum(matrix.rows[0][0])
            if mi.is_polarized:  # in BSDF code matrices stand in the implicit axes of local directions
                value = to_local_mueller(si, value, si.to_world(si.wi), si.to_world(si.wi))
            return dr.select(active, value, 0.0)

        def sample(self, ctx, si, sample1, sample2, active=True):
            return self.passed(-si.wi, 1.0, mi.BSDFFlags.Null), self.weight(si, active)

        def eval_null_transmission(self, si, active=True):
            return self.weight(si, active)

    Layer.kind = kind
    return Layer
