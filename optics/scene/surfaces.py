"""Surfaces and materials: what matt surfaces, surfaces that send light one way, and clear materials have in common.

Classes belong to the Mitsuba variant that is set when they are made, so these functions are called where a part is
built."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from optics.errors import BadScene
from optics.scene.mitsuba_parts import Declared
from optics.spectra.curve import VISIBLE

MIDDLE = 540.0  # nm: where `index` and `absorption` of a clear material hold


def matt() -> type:
    """A base for surfaces that reflect into all directions and depolarize: `brdf(si, wo, active)` is f(wi, wo) per
    band, 1/sr.

    Directions are sampled by their cosine; light comes from the side that the normal points to.
    """
    import drjit as dr
    import mitsuba as mi

    class Matt(Declared.on(mi.BSDF)):
        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.declare(props)
            self.m_components = [mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0]

        def rho(self, si):
            """Reflectance in each band: rho_r, rho_g, rho_b, 1."""
            return self.by_colour(self.rho_r, self.rho_g, self.rho_b, si.wavelengths)

        def sample(self, ctx, si, sample1, sample2, active=True):
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = mi.warp.square_to_cosine_hemisphere(sample2)
            bs.pdf = mi.warp.square_to_cosine_hemisphere_pdf(bs.wo)
            bs.eta = mi.Float(1.0)
            bs.sampled_type = mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            bs.sampled_component = mi.UInt32(0)
            lit = active & (mi.Frame3f.cos_theta(si.wi) > 0) & (bs.pdf > 0)
            return bs, dr.select(lit, unpolarized(self.brdf(si, bs.wo, active) * dr.pi), mi.Spectrum(0.0))

        def eval(self, ctx, si, wo, active=True):
            cos_v, cos_l = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
            return unpolarized(dr.select(active & (cos_v > 0) & (cos_l > 0), self.brdf(si, wo, active) * cos_l, 0.0))

        def pdf(self, ctx, si, wo, active=True):
            lit = active & (mi.Frame3f.cos_theta(si.wi) > 0) & (mi.Frame3f.cos_theta(wo) > 0)
            return dr.select(lit, mi.warp.square_to_cosine_hemisphere_pdf(wo), 0.0)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def to_string(self):
            return f"{type(self).__name__}[{self.name}]"

    return Matt


def texture_of(curve, band: float | None = None):
    """A curve over the wavelength as a texture of Mitsuba's; in a mono variant its value at a band, or in the middle of
    the visible."""
    import mitsuba as mi

    if not mi.is_spectral:
        return mi.load_dict({"type": "uniform", "value": float(curve(band or MIDDLE))})
    low, high = VISIBLE
    inside = (curve.nm > low) & (curve.nm < high)
    nm = [low, *curve.nm[inside], high]
    return mi.load_dict(
        {
            "type": "irregular",
            "wavelengths": ", ".join(f"{w:.6g}" for w in nm),
            "values": ", ".join(f"{v:.8g}" for v in curve(nm)),
        }
    )


def curve_of(value, kind: str, where: str):
    """The curve of a spectrum of Mitsuba's: the pairs or the file of a `<spectrum>`, constant over the visible where it
    is one number; any other of its spectra (`blackbody`, `regular`, `d65`) read in steps of 1 nm over the visible.

    kind    one of optics.spectra.curve.KINDS;   where   what asks for it, for errors: 'led_red.spectrum'
    Raises BadScene, of a texture over a surface and in a mono variant, where Mitsuba's spectra are one number.
    """
    import mitsuba as mi
    import numpy as np

    from optics.spectra.reading import ALLOWED, checked

    if hasattr(value, "is_uniform"):  # what Mitsuba reads of a <spectrum> without a type
        nm, values = np.asarray(value.wavelengths, float), np.asarray(value.values, float)
        nm, values = (np.array(VISIBLE), np.repeat(values, 2)) if value.is_uniform() else (nm, values)
        return checked(nm, values, kind, "a spectrum of Mitsuba's", where)
    if not isinstance(value, mi.Texture) or value.is_spatially_varying():
        raise BadScene(f"{where}: {type(value).__name__} is no spectrum; allowed: Mitsuba's spectra, or {ALLOWED}")
    if not mi.is_spectral:
        raise BadScene(f"{where}: {value.class_name()} has one value in the variant {mi.variant()}; allowed: {ALLOWED}")
    nm = np.arange(VISIBLE[0], VISIBLE[1] + 1)
    si = mi.SurfaceInteraction3f()
    si.wavelengths = mi.UnpolarizedSpectrum(mi.Float(nm.astype(np.float32)))
    values = np.array(value.eval(si)[0], float)
    return checked(nm, np.broadcast_to(values, nm.shape), kind, f"Mitsuba's {value.class_name()}", where)


def unpolarized(value):
    """A weight per band that leaves no polarization, as a Spectrum of the present variant."""
    import mitsuba as mi

    return mi.mueller.depolarizer(value) if mi.is_polarized else mi.Spectrum(value)


def passing(flags: int) -> type:
    """A base for surfaces that send light on in one direction and scatter none: `sample` and `eval_null_transmission`
    are theirs.

    flags  what passing counts as, of mi.BSDFFlags
    """
    import drjit as dr
    import mitsuba as mi

    class Passing(Declared.on(mi.BSDF)):
        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.declare(props)
            self.m_components = [flags | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide]
            self.m_flags = self.m_components[0]

        def passed(self, wo, eta, kind):
            """The sample of a ray that goes on along wo."""
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo, bs.eta = wo, mi.Float(eta)
            bs.pdf = mi.Float(1.0)
            bs.sampled_type = mi.UInt32(kind)
            bs.sampled_component = mi.UInt32(0)
            return bs

        def eval(self, ctx, si, wo, active=True):
            return mi.Spectrum(0.0)

        def pdf(self, ctx, si, wo, active=True):
            return mi.Float(0.0)

        def eval_pdf(self, ctx, si, wo, active=True):
            return mi.Spectrum(0.0), mi.Float(0.0)

        def to_string(self):
            return f"{type(self).__name__}[{self.kind}, {self.name}]"

    return Passing


def coefficient(clear, stage: str, wavelengths, functions: Sequence[Callable]):
    """`index` or `absorption` (1/mm) of a clear material per band, with what the functions of effects of that stage
    make of it; for numpy, complex numbers among them, and for Dr.Jit."""
    value = getattr(clear, stage) + 0 * wavelengths
    curve = getattr(clear, "curves", {}).get(f"{stage}_spectrum")
    if curve is not None:
        own, middle = curve(wavelengths), float(curve(MIDDLE))
        value = value + (own - middle) if stage == "index" else value * (own / middle)
    for function in functions:
        value = function(value, wavelengths, clear)
    return value


def axis_rotation(forward, current, target):
    """Mueller matrix that turns Stokes vectors of light along `forward` from one axis across it to another.

    mi.mueller.rotate_stokes_basis by way of cosine and sine: its angle has no derivative where the axes are the
    same."""
    import drjit as dr
    import mitsuba as mi

    c, s = dr.dot(current, target), dr.dot(forward, dr.cross(current, target))
    c, s = mi.UnpolarizedSpectrum(c * c - s * s), mi.UnpolarizedSpectrum(2 * c * s)
    return mi.Spectrum(1, 0, 0, 0, 0, c, s, 0, 0, -s, c, 0, 0, 0, 0, 1)


def _between(si, matrix, forward_in, forward_out, to):
    """A Mueller matrix in the axes that Mitsuba implies for two directions, as one in those of the turned
    directions."""
    import mitsuba as mi

    basis, into, out = mi.mueller.stokes_basis, to(forward_in), to(forward_out)
    first = axis_rotation(into, basis(into), to(basis(forward_in)))
    return axis_rotation(out, to(basis(forward_out)), basis(out)) @ matrix @ first


def to_world_mueller(si, matrix, forward_in, forward_out):
    """si.to_world_mueller, with derivatives by the directions."""
    import drjit as dr
    import mitsuba as mi

    if not mi.is_polarized or not dr.grad_enabled(forward_in, forward_out, si.sh_frame):
        return si.to_world_mueller(matrix, forward_in, forward_out)
    return _between(si, matrix, forward_in, forward_out, si.to_world)


def to_local_mueller(si, matrix, forward_in, forward_out):
    """si.to_local_mueller, with derivatives by the directions."""
    import drjit as dr
    import mitsuba as mi

    if not mi.is_polarized or not dr.grad_enabled(forward_in, forward_out, si.sh_frame):
        return si.to_local_mueller(matrix, forward_in, forward_out)
    return _between(si, matrix, forward_in, forward_out, si.to_local)
