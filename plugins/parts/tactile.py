"""Tactile: the integrator that serves every sensor; polarized, in fixed bands, with Stokes channels.

Definition
    L(x -> camera) = sum_k V(x, S_k) T_gel f(wi, s_k) cos(theta_k) kappa_k + ambient + volume            (S5)
                   + s sum (one more bounce), s = `interreflection`
in the bands given by `bands` (nm; red first), so that a spectral render has no spectral noise. The
camera's ray passes flat interfaces (part `interface`) by Snell's law with the transmitted share as weight; LEDs are
sampled through null and index-matched surfaces; homogeneous media are followed analytically, exp(-sigma_a d) per
segment; the gel's own effects (stages `segment` and `volume`) act on the path inside -thickness < z < 0. Every surface
is lit by all point lights and by one of the others, drawn by Monte Carlo: to draw one of the LEDs would be most of the
noise. Every bounce after the first is scaled by `interreflection`: 1 is physics, 0 is direct light only.
Fingerprint
    interreflection fills shadows and the inner flanks of a dent.
Validity
    scattering media only to first order (effect "gel haze"); refraction of the light on its way from an LED to the
    membrane is not followed: LEDs belong on the gel's side of a refracting interface.
References
    F-TAC Hand supplementary information, S1.4-S1.5, eq. (S5); Veach, thesis (1997), ch. 8, for the direct-light
    estimator.
XML
    bands string: wavelengths of the camera's bands, nm, red first: "610, 540, 460"; with more than four, a range
        "400:700:10" or "auto", channels are integrals over the wavelength (optics.scene.integral)
    stokes boolean, False: whether S1 to S3 are rendered as further channels
    max_depth integer, 2: edges of a path between scattering surfaces; 2 is direct light
    max_null integer, 8: flat or index-matched faces that a path may pass beyond that
    rays integer, 64: camera rays per pixel through clear bodies
    packets integer, 100000: packets of light that each lamp sends through clear bodies
    rr_depth integer, 5: read by the base class of Mitsuba's integrators; paths are not ended at random here
"""

from optics.scene.checking import agree
from optics.scene.declare import Part
from optics.scene.integral import FEW, parse
from optics.scene.mitsuba_parts import DEFAULT_VARIANT, Declared
from optics.scene.parameter import Parameter
from optics.scene.wiring import ensure_wired

PARAMETERS = (
    Parameter(
        "interreflection",
        "1",
        0.0,
        (0.0, 4.0),
        "scale of every bounce after the first; 1 is physics",
        neutral=0.0,
        role="second bounce",
        plausible=1.0,
        linear=True,
    ),
)


def build():
    import drjit as dr
    import mitsuba as mi
    from mitsuba.python.ad.integrators.common import ADIntegrator

    from optics.light.led_by_led import LedByLed
    from optics.light.replay import Replay
    from optics.light.walk import Walk
    from optics.scene.surfaces import axis_rotation

    class Tactile(with_methods(Declared.on(ADIntegrator), LedByLed, Walk, Replay)):
        kind = "tactile"

        def __init__(self, props):
            super().__init__(props)
            self.stokes = props.get("stokes", False)
            self.max_depth = props.get("max_depth", 2)  # edges of a path between surfaces: 2 is direct light
            self.max_null = props.get("max_null", 8)
            self.rays, self.packets = props.get("rays", 64), props.get("packets", 100_000)  # of optics.light.transport
            self.bands, self.nodes = parse(str(props.get("bands", "")), "tactile")
            self.lanes = dr.size_v(mi.UnpolarizedSpectrum)
            self.integrates = self.nodes is not None or len(self.bands) > FEW
            if self.integrates and not mi.is_spectral:
                raise ValueError(
                    f"tactile: auto bands and more than {FEW} need a spectral variant; allowed: {DEFAULT_VARIANT}"
                )
            self.declare(props)
            self.gel_of = {}
            self.glowing_of = {}
            self.fronts = None

        def wavelengths(self, size):
            """The bands as a ray's wavelengths; unused lanes repeat the last band."""
            if not mi.is_spectral:
                return mi.Color0f()
            bands = (self.bands or (620.0, 540.0, 460.0)) + (self.bands or (460.0,))[-1:] * self.lanes
            return dr.zeros(type(mi.Ray3f().wavelengths), size) + mi.UnpolarizedSpectrum(*bands[: self.lanes])

        def gel(self, scene):
            """The gel part of the scene, if it has one."""
            key = scene.ptr if hasattr(scene, "ptr") else id(scene)
            if key not in self.gel_of:
                self.gel_of[key] = next((s for s in scene.shapes() if getattr(s, "role", "") == "gel"), None)
            return self.gel_of[key]

        def glowing(self, scene):
            """The fluorescent pigments of the scene."""
            key = scene.ptr if hasattr(scene, "ptr") else id(scene)
            if key not in self.glowing_of:
                found = {s.bsdf().name: s.bsdf() for s in scene.shapes() if hasattr(s.bsdf(), "fluorescence")}
                self.glowing_of[key] = tuple(found.values())
            return self.glowing_of[key]

        def aov_names(self):
            return [f"S{i}.{j}" for i in range(4) for j in range(self.lanes)] if self.stokes and mi.is_polarized else []

        def sample_rays(self, scene, sensor, sampler, *args, **kwargs):
            ensure_wired(scene, self)
            ray, weight, position = super().sample_rays(scene, sensor, sampler, *args, **kwargs)
            # of our camera's frame; up in a stock one's, which is the same for Stokes vectors
            down = mi.Vector3f(0, 1, 0)
            with dr.resume_grad():
                self.vertical = sensor.turned(down) if hasattr(sensor, "turned") else sensor.world_transform() @ down
            if mi.is_spectral and self.bands:
                ray.wavelengths = self.wavelengths(dr.width(ray.o))
                weight = mi.Spectrum(1.0)
            return ray, weight, position

        def channels(self, light, first, vertical):
            """S0 ... S3 of the gathered light per band, against the image's horizontal, for camera rays along
            `first`."""
            if not (self.stokes and mi.is_polarized):
                return []
            basis = mi.mueller.stokes_basis(-first)
            side = dr.normalize(dr.cross(first, vertical))
            turn = axis_rotation if dr.grad_enabled(first, vertical) else mi.mueller.rotate_stokes_basis_m
            vector = turn(-first, basis, side) @ light
            return [vector[i, 0][j] for i in range(4) for j in range(self.lanes)]

        def sample(self, mode, scene, sampler, ray, δL=None, state_in=None, active=True, **_):
            if self.integrates:
                raise ValueError(
                    f"tactile: mi.render carries {self.lanes} bands; auto bands and more than {FEW} are rendered LED "
                    "by LED (optics render); allowed here: up to four bands"
                )
            self.look_up(scene)
            light = self.walk(scene, self.start(ray, sampler, active))["light"]
            return light, mi.Bool(True), self.channels(light, mi.Vector3f(ray.d), self.vertical), None

        def to_string(self):
            return f"Tactile[bands={self.bands}]"

    return Tactile


def with_methods(base: type, *mixins: type) -> type:
    """A subclass of a Mitsuba class that has the methods of further classes (Mitsuba's classes allow one base only)."""
    methods = {n: f for mixin in mixins for n, f in vars(mixin).items() if callable(f) or isinstance(f, staticmethod)}
    return type(base.__name__, (base,), methods)


def check_lit_plate():
    """An LED far above a smooth white plate in a narrow field: rho/pi power/d^2 in every band, with its colour,
    unpolarized."""
    import mitsuba as mi
    import numpy as np

    led = {"type": "led", "position": [0.0, 0.0, -1000.0], "power": 1e6, "power_g": 0.5}
    film = {"type": "hdrfilm", "width": 2, "height": 2, "rfilter": {"type": "box"}, "component_format": "float32"}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "tactile", "bands": "610, 540, 460", "stokes": True},
            "plate": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 180),
                "bsdf": {"type": "membrane", "rho_r": 0.5, "rho_g": 0.5, "rho_b": 0.5, "sigma": 0.0},
            },
            "led": led,
            "camera": {
                "type": "camera",
                "x_fov": 1.0,
                "to_world": mi.ScalarTransform4f().translate([0, 0, -20]),
                "film": film,
            },
        },
        optimize=False,
    )
    stokes = np.array(mi.render(scene, spp=1), float)[..., -16:].reshape(2, 2, 4, 4)  # S0 to S3 by band
    agree(stokes[..., 0, :3], np.broadcast_to(0.5 / np.pi * np.array([1, 0.5, 1]), (2, 2, 3)), 1e-5)
    agree(stokes[..., 1:, :], np.zeros((2, 2, 3, 4)), 0, 1e-7)


part = Part("tactile", "integrator", PARAMETERS, build, checks=(check_lit_plate,), role="integrator")
