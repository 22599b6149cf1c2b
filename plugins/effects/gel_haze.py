"""Gel haze: the gel scatters a little light, once, on its way.

Definition
    L' = L exp(-h (d_light + d_view)) + h/(4 pi) int_0^d_view kappa(x) exp(-h (s + l(x))) ds
with the scattering coefficient h, isotropic single scattering, kappa of (S2) without the cosine, the length l(x) inside
the gel of the way from the LED to x, and the integral along the camera's ray inside the gel by Gauss-Legendre
quadrature with eight nodes.
Fingerprint
    a veil that brightens towards the LEDs and fills shadows, without the structure of the face; it grows with the gel's
    thickness. Veiling glare is flat; ambient light follows the reflectance.
Validity
    thin: h d << 1. Shadows inside the volume are neglected.
References
    Nishita, Miyawaki & Nakamae, SIGGRAPH 1987 (single scattering); Narasimhan et al., SIGGRAPH 2006.
"""

from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter

NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
NEAREST = 0.2  # mm: how near to an LED the integrand is evaluated; a ray through the LED itself would diverge


def dim(path, gel):
    import drjit as dr

    return dr.exp(-gel.haze * (path.view + path.light))


def veil(path, gel):
    import drjit as dr
    import mitsuba as mi

    toward = dr.normalize(path.camera - path.p)
    total = mi.UnpolarizedSpectrum(0.0)
    for node, weight in zip(NODES, WEIGHTS):
        s = path.view * float((1 + node) / 2)
        point = mi.Interaction3f()
        point.p = path.p + toward * s
        point.wavelengths = path.wavelengths
        to_led = path.lamp - point.p
        distance = dr.maximum(dr.norm(to_led), NEAREST)
        total += (
            path.led.radiance(point, to_led / distance, distance)
            * dr.exp(-gel.haze * (path.view - s + gel.length_inside(point.p, path.lamp)))
            * float(weight / 2)
        )
    return total * path.view * gel.haze * (1 / (4 * dr.pi))


def check_veil_along_the_axis():
    """With an LED of kappa = 1 everywhere, on the camera's ray and outside the gel, l(x) is s, the exponent is -2 h s,
    and the integral is elementary; what crosses the gel is dimmed by exp(-h d)."""
    import mitsuba as mi

    h, view = 0.03, 4.0
    path = SimpleNamespace(
        p=mi.Point3f(0, 0, 0),
        camera=mi.Point3f(0, 0, -24),
        lamp=mi.Point3f(0, 0, -10),
        led=SimpleNamespace(radiance=lambda point, to_led, far: mi.UnpolarizedSpectrum(1.0)),
        view=mi.Float(view),
        light=mi.Float(2.0),
        wavelengths=mi.Color0f() if not mi.is_spectral else mi.UnpolarizedSpectrum(540.0),
    )
    gel = SimpleNamespace(haze=mi.Float(h), length_inside=lambda p, lamp: view + p.z)
    integral = (1 - np.exp(-2 * h * view)) / (2 * h)
    agree(np.array(veil(path, gel)).ravel(), h / (4 * np.pi) * integral, 1e-5)
    agree(np.array(dim(path, gel)), np.exp(-h * 6.0), 1e-5)


effect = Effect(
    name="gel haze",
    part="gel",
    stages={"segment": dim, "volume": veil},
    parameters=(Parameter("haze", "1/mm", 0.0, (0.0, 2.0), "scattering coefficient h", neutral=0.0, plausible=0.01),),
    acts=("led_distance", "gel_path", "shadow"),
    needs="shadows, and frames with one LED each",
    checks=(check_veil_along_the_axis,),
)
