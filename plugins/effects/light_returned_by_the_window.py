"""Light returned by the window: what the coating scatters is reflected at the window's outer face and lights it again.

Definition
    L' = L + g rho_b/pi E_0,    E_0 = kappa_b cos(theta) of each LED in the middle of the untouched face
with the share g (`returned`). A wide face that is lit evenly has g = rho R/(1 - rho R), the series of all returns, with
the hemispherical reflectance R of the window's outer face from inside,
    R = 2 int_0^1 r(c) c dc                    .536 for an index of 1.41, .596 for 1.5: most by total reflection
with Fresnel's r for unpolarized light at the cosine c. The light arrives far from where it left, two thicknesses and
more to the side, and mainly from 45 to 90 degrees off the face's normal: it casts no sharp shadows, and lights slopes
up to 45 degrees as much as the flat face, within 2 % for an index of 1.41 (5 % for 1.5).
Fingerprint
    shadows and faces that turn away are filled, in proportion to the LED that is lit. Ambient light is the same
    whichever LED is lit, and remains when all are off; veiling glare does not follow the reflectance; one bounce within
    the dent (interreflection) stays near it.
Validity
    a window whose outer face meets air, a gel and a window of nearly one index, a lit face that is wide against their
    thickness; g of one number for all LEDs. Slopes steeper than 60 degrees get less than this.
References
    Duntley, J. Opt. Soc. Am. 32, 61 (1942); Saunderson, J. Opt. Soc. Am. 32, 727 (1942) (internal reflection of diffuse
    light); the neglect of S1.5: light that reaches the face once.
"""

import math
from types import SimpleNamespace

import numpy as np

from optics.scene.checking import agree
from optics.scene.declare import Effect
from optics.scene.parameter import Parameter


def fill(path, gel):
    import drjit as dr
    import mitsuba as mi

    middle = mi.Interaction3f()
    middle.p, middle.wavelengths = mi.Point3f(0.0, 0.0, 0.0), path.wavelengths
    to_led = path.lamp - middle.p
    distance = dr.norm(to_led)
    to_led /= distance
    irradiance = path.led.radiance(middle, to_led, distance) * dr.maximum(-to_led.z, 0.0)
    scattered = along_the_normal(path.si, gel.coats)
    kept = mi.UnpolarizedSpectrum(1.0)
    for function in gel.functions("segment"):
        kept *= function(gel.path(path.p, path.camera, path.p, path.led, path.si), gel)
    return scattered * irradiance * kept * gel.returned


def along_the_normal(si, coats):
    """Radiance per irradiance along the normal; of other materials than the membranes, beside them, none. Membranes are
    asked one by one: Dr.Jit cannot follow the derivative by a roughness through a second call of what a surface points
    to."""
    import drjit as dr
    import mitsuba as mi

    normal = mi.Vector3f(0.0, 0.0, 1.0)
    if not coats:
        return mi.unpolarized_spectrum(si.bsdf().eval(mi.BSDFContext(), si, normal, si.is_valid()))
    found = mi.UnpolarizedSpectrum(0.0)
    for coat in coats:
        found += dr.select(si.bsdf() == mi.BSDFPtr(coat), coat.brdf(si, normal), 0.0)
    return found


def check_share():
    """Under an LED of kappa = 2 at 60 deg from the face's normal, a face of reflectance 0.5 gets g 0.5/pi 2 cos(60 deg)
    more; what the gel keeps of light on its way to the camera acts on it too."""
    import mitsuba as mi

    lamp = mi.Point3f(3.0**0.5, 0.0, -1.0)
    material = SimpleNamespace(eval=lambda ctx, si, wo, active: mi.Spectrum(0.5) * (wo.z / math.pi))
    face = SimpleNamespace(bsdf=lambda: material, is_valid=lambda: mi.Bool(True))
    led = SimpleNamespace(radiance=lambda point, to_led, distance: mi.UnpolarizedSpectrum(2.0))
    path = SimpleNamespace(
        lamp=lamp,
        led=led,
        si=face,
        p=mi.Point3f(1.0, 0.0, 0.0),
        camera=None,
        wavelengths=mi.Color0f() if not mi.is_spectral else mi.UnpolarizedSpectrum(540.0),
    )
    gel = SimpleNamespace(
        returned=mi.Float(0.4),
        functions=lambda stage: [lambda path, gel: 0.9],
        path=lambda *ends: SimpleNamespace(),
        coats=(),
    )
    agree(np.array(fill(path, gel)).ravel(), 0.4 * 0.9 * 0.5 / np.pi * 2 * 0.5, 1e-5)


effect = Effect(
    name="light returned by the window",
    part="gel",
    stages={"volume": fill},
    parameters=(
        Parameter(
            "returned",
            "1",
            0.0,
            (0.0, 5.0),
            "light g that the window returns, over what the LED sends to the middle of the face",
            neutral=0.0,
            plausible=0.1,
        ),
    ),
    acts=("shadow", "slope", "intensity", "LED"),
    needs="frames with one LED each, and one with all LEDs off",
    checks=(check_share,),
)
