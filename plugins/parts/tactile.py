"""Tactile: the integrator that serves every sensor; polarized, in fixed bands, with Stokes channels.

Definition
    L(x -> camera) = sum_k V(x, S_k) T_gel f(wi, s_k) cos(theta_k) kappa_k + ambient + volume            (S5)
                   + s sum (one more bounce), s = `interreflection`
in the bands given by `bands` (nm, at most four; red first), so that a spectral render has no spectral noise. The
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
"""

import math

from optics.scene.checking import agree
from optics.scene.declare import Part
from optics.scene.mitsuba_parts import Declared
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
        plausible=1.0,
        linear=True,
    ),
)


def product(a, b):
    """a after b: of Mueller matrices in polarized variants, of spectra in others."""
    return a @ b if mi.is_polarized else a * b


def scaled(value):
    """A spectrum as the Mueller matrix of an absorber (polarized variants) or as it is."""
    return mi.mueller.absorber(value) if mi.is_polarized else mi.Spectrum(value)


def build():
    # dr.syntax rewrites a function with the globals of its file and without its closure
    global dr, mi, mis_weight, REFLECTED
    import drjit as dr
    import mitsuba as mi
    from mitsuba.python.ad.integrators.common import ADIntegrator, mis_weight

    REFLECTED = int(
        mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.GlossyReflection
    )  # by a rough surface, not through it

    class Tactile(Declared.on(ADIntegrator)):
        kind = "tactile"

        def __init__(self, props):
            super().__init__(props)
            self.stokes = props.get("stokes", False)
            self.max_depth = props.get("max_depth", 2)  # edges of a path between surfaces: 2 is direct light
            self.max_null = props.get("max_null", 8)
            self.rays, self.packets = props.get("rays", 64), props.get("packets", 100_000)  # of optics.light.transport
            text = str(props.get("bands", ""))
            self.bands = tuple(float(w) for w in text.replace(",", " ").split())
            self.lanes = dr.size_v(mi.UnpolarizedSpectrum)
            if len(self.bands) > self.lanes and mi.is_spectral:
                raise ValueError(
                    f"tactile: {len(self.bands)} bands, but a render carries at most {self.lanes}; "
                    "render the others in a second scene"
                )
            self.declare(props)
            self.gel_of = {}
            self.glowing_of = {}

        def render_forward(self, *given, **more):
            with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False):  # recorded loops cannot be differentiated
                return super().render_forward(*given, **more)

        def render_backward(self, *given, **more):
            with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False):
                return super().render_backward(*given, **more)

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
                self.gel_of[key] = next((s for s in scene.shapes() if getattr(s, "kind", "") == "gel"), None)
            return self.gel_of[key]

        def glowing(self, scene):
            """The fluorescent pigments of the scene."""
            key = scene.ptr if hasattr(scene, "ptr") else id(scene)
            if key not in self.glowing_of:
                found = {
                    s.bsdf().name: s.bsdf() for s in scene.shapes() if getattr(s.bsdf(), "kind", "") == "fluorescent"
                }
                self.glowing_of[key] = tuple(found.values())
            return self.glowing_of[key]

        def excited(self, scene, si, led, to_led, distance):
            """Radiance per band of the fluorescence that one LED excites."""
            total = mi.UnpolarizedSpectrum(0.0)
            for pigment in self.glowing(scene):
                own = si.is_valid() & (si.bsdf() == mi.BSDFPtr(pigment))
                total += dr.select(own, pigment.fluorescence(si, led, to_led, distance), 0.0)
            return total

        # -- one LED at a time: what calibration and batches use
        # ---------------------------------------------------------

        def hits(self, scene, camera, u, v):
            """Where the camera's rays through the pixel positions (u, v) meet the membrane: (si, weight, origin)."""
            o, d = camera.ray(u, v)
            ray = mi.Ray3f(o, d, mi.Float(0), self.wavelengths(dr.width(u)))
            si = scene.ray_intersect(ray)
            weight = mi.UnpolarizedSpectrum(1.0)
            for _ in range(sum(1 for s in scene.shapes() if getattr(s.bsdf(), "kind", "") == "interface")):
                flat = si.is_valid() & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.DeltaTransmission)
                bs, passed = si.bsdf().sample(mi.BSDFContext(), si, mi.Float(0.5), mi.Point2f(0.5), flat)
                d = si.to_world(bs.wo)
                start = si.p + d * (
                    1e-4 * (1 + dr.max(dr.abs(si.p)))
                )  # spawn_ray would shift it sideways, along the normal
                through = scene.ray_intersect(mi.Ray3f(start, d, mi.Float(0), si.wavelengths), flat)
                weight = dr.select(flat, weight * mi.unpolarized_spectrum(passed), weight)
                si = dr.select(flat, through, si)
            return si, weight, dr.select(si.is_valid(), si.p + si.to_world(si.wi) * si.t, o)

        def windows(self, scene, led):
            """How many flat interfaces stand between an LED and the skin."""
            reach = math.sqrt(led.number("area") / math.pi)
            return sum(
                1
                for s in scene.shapes()
                if getattr(s.bsdf(), "kind", "") == "interface" and s.bbox().max.z > led.number("z") - reach
            )

        def visible(self, scene, si, point, led):
            """Whether the straight line from the surface to a point of an LED meets nothing but windows (detached)."""
            with dr.suspend_grad():
                valid = si.is_valid()
                ray = si.spawn_ray_to(point)
                for _ in range(self.windows(scene, led)):
                    hit = scene.ray_intersect(ray, valid)
                    flat = hit.is_valid() & mi.has_flag(hit.bsdf().flags(), mi.BSDFFlags.DeltaTransmission)
                    ray = dr.select(flat, hit.spawn_ray_to(point), ray)
                return valid & ~scene.ray_test(ray, valid)

        def direct(self, scene, si, weight, origin, led, visibility, sample=None):
            """Radiance per band that one LED sends to the camera by one reflection (S3, S5), and by the gel itself."""
            point = led.position() if sample is None else led.point(sample)
            to_led = point - si.p
            distance = dr.norm(to_led)
            s = to_led / distance
            value = mi.unpolarized_spectrum(si.bsdf().eval(mi.BSDFContext(), si, si.to_local(s), si.is_valid()))
            light = value * led.radiance(si, s, distance) + self.excited(scene, si, led, s, distance)
            light = light & visibility
            gel = self.gel(scene)
            if gel is not None:
                path = gel.path(si.p, origin, point, led, si)
                for function in gel.functions("segment"):
                    light *= function(path, gel)
                for function in gel.functions("volume"):
                    light += dr.select(si.is_valid(), function(path, gel), 0.0)
            return light * weight

        def ambient(self, scene, si, weight, membrane):
            """Radiance per band that no LED made, of one membrane."""
            own = si.is_valid() & (si.bsdf() == mi.BSDFPtr(membrane))
            return dr.select(own, membrane.ambient_radiance(si), 0.0) * weight

        def bounced(self, scene, si, weight, origin, led, count, sampler):
            """Radiance per band that one LED sends to the camera by two reflections, mean of `count` directions."""
            total = mi.UnpolarizedSpectrum(0.0)
            context = mi.BSDFContext()
            for _ in range(count):
                bs, factor = si.bsdf().sample(context, si, sampler.next_1d(), sampler.next_2d(), si.is_valid())
                second = scene.ray_intersect(si.spawn_ray(si.to_world(bs.wo)), si.is_valid())
                light = self.direct(scene, second, 1.0, si.p, led, self.visible(scene, second, led.position(), led))
                total += dr.select(second.is_valid(), mi.unpolarized_spectrum(factor) * light, 0.0)
            gel = self.gel(scene)
            if gel is not None:
                last = gel.path(si.p, origin, si.p, led, si)  # `direct` followed the light up to the first surface only
                for function in gel.functions("segment"):
                    weight = weight * function(last, gel)
            return total * weight / count

        # -- any scene, any light: what mi.render calls
        # --------------------------------------------------------------------

        def aov_names(self):
            return [f"S{i}.{j}" for i in range(4) for j in range(self.lanes)] if self.stokes and mi.is_polarized else []

        def sample_rays(self, scene, sensor, sampler, *args, **kwargs):
            ensure_wired(scene, self)
            ray, weight, position = super().sample_rays(scene, sensor, sampler, *args, **kwargs)
            down = mi.Vector3f(
                0, 1, 0
            )  # of our camera's frame; up in a stock one's, which is the same for Stokes vectors
            self.vertical = sensor.turned(down) if hasattr(sensor, "turned") else sensor.world_transform() @ down
            if mi.is_spectral and self.bands:
                ray.wavelengths = self.wavelengths(dr.width(ray.o))
                weight = mi.Spectrum(1.0)
            return ray, weight, position

        def absorption(self, medium, si, active):
            """sigma_a of a homogeneous medium in each band, 1/mm."""
            mei = dr.zeros(mi.MediumInteraction3f, dr.width(si))
            mei.p, mei.wavelengths, mei.medium = si.p, si.wavelengths, medium
            sigma_s, _, sigma_t = medium.get_scattering_coefficients(mei, active)
            return sigma_t - sigma_s

        def look_up(self, scene):
            """What acts in a scene besides its surfaces and lights: the gel and its effects, LEDs, membranes that
            shine."""
            self.inside = gel = self.gel(scene)
            self.fading, self.veils = (gel.functions(s) if gel is not None else () for s in ("segment", "volume"))
            emitters = scene.emitters()
            points = [i for i, e in enumerate(emitters) if mi.has_flag(e.flags(), mi.EmitterFlags.DeltaPosition)]
            self.points, self.others = len(points), len(points) < len(emitters)
            self.point_lights = dr.gather(mi.EmitterPtr, scene.emitters_dr(), mi.UInt32(points)) if points else None
            self.lamps = (
                [e for e in emitters if getattr(e, "kind", "") == "led"] if self.veils or self.glowing(scene) else []
            )
            self.shining = [
                m
                for m in {s.bsdf() for s in scene.shapes()}
                if getattr(m, "kind", "") == "membrane" and m.functions("ambient")
            ]

        def kept(self, si, origin, point):
            """Share of the light that effects of the gel leave on its way from a point over the surface to where a ray
            began."""
            share = mi.UnpolarizedSpectrum(1.0)
            for function in self.fading:
                share *= function(self.inside.path(si.p, origin, point, None, si), self.inside)
            return scaled(share)

        def own_light(self, scene, si, origin):
            """Light that the gel and the membranes add by themselves at a surface: stages `volume` and `ambient`."""
            added = mi.UnpolarizedSpectrum(0.0)
            for led in self.lamps if self.glowing(scene) else ():
                to_led = led.position() - si.p
                distance = dr.norm(to_led)
                clear = ~scene.ray_test(si.spawn_ray_to(led.position()), si.is_valid())
                added += dr.select(clear, self.excited(scene, si, led, to_led / distance, distance), 0.0)
            for function in self.veils:
                for led in self.lamps:
                    added += function(self.inside.path(si.p, origin, led.position(), led, si), self.inside)
            for membrane in self.shining:
                added += self.ambient(scene, si, 1.0, membrane)
            return mi.mueller.depolarizer(added) if mi.is_polarized else mi.Spectrum(added)

        @dr.syntax
        def transmittance(self, scene, si, ds, medium, active):
            """Mueller matrix of the straight way from the surface to a light: null surfaces and absorbing media."""
            through = mi.Spectrum(1.0)
            ray = si.spawn_ray_to(ds.p)
            remaining = mi.Float(ray.maxt)
            inside = mi.MediumPtr(medium)
            going = mi.Bool(active)
            step = mi.UInt32(0)
            while going:
                ray.maxt = remaining
                hit = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=going)
                met = going & hit.is_valid()
                length = dr.select(met, hit.t, remaining)
                filled = going & (inside != None)  # noqa: E711 (a Dr.Jit comparison)
                fade = dr.select(filled, dr.exp(-self.absorption(inside, hit, filled) * length), 1.0)
                through = product(through, scaled(fade))
                passed = hit.bsdf().eval_null_transmission(hit, met)
                passed = hit.to_world_mueller(passed, hit.wi, hit.wi)
                through = dr.select(met, product(through, passed), through)
                inside = dr.select(met & hit.is_medium_transition(), hit.target_medium(ray.d), inside)
                remaining = remaining - length
                ray = dr.select(met, hit.spawn_ray(ray.d), ray)
                step += 1
                going = (
                    met & (remaining > 1e-4) & (step < self.max_null) & (dr.max(mi.unpolarized_spectrum(through)) > 0)
                )
            return through

        def sent(self, scene, si, origin, medium, ds, weight, active):
            """What a light sends from a surface to where a ray began: a Mueller matrix or a spectrum."""
            start = dr.select(si.is_medium_transition(), si.target_medium(ds.d), medium)
            way = self.transmittance(scene, si, ds, start, active)
            wo = si.to_local(ds.d)
            value, density = si.bsdf().eval_pdf(mi.BSDFContext(), si, wo, active)
            value = si.to_world_mueller(value, -wo, si.wi)
            mis = dr.select(ds.delta, 1.0, mis_weight(ds.pdf, density))
            way = product(way, self.kept(si, origin, ds.p))
            return dr.select(active, product(product(value, way), weight) * mis, 0.0)

        @dr.syntax
        def from_points(self, scene, sampler, si, origin, medium, active):
            """What all point lights send: to draw one of them would be most of the noise of a scene lit by LEDs."""
            total = mi.Spectrum(0.0)
            k = mi.UInt32(0)
            going = mi.Bool(active)
            while going:
                light = dr.gather(mi.EmitterPtr, self.point_lights, k, going)
                ds, weight = light.sample_direction(si, sampler.next_2d(), going)
                total = total + self.sent(scene, si, origin, medium, ds, weight, going & (ds.pdf != 0))
                k += 1
                going = going & (k < self.points)
            return total

        @dr.syntax
        def sample(self, mode, scene, sampler, ray, δL=None, state_in=None, active=True, **_):
            self.look_up(scene)
            context = mi.BSDFContext()
            ray = mi.Ray3f(ray)
            first = mi.Vector3f(ray.d)
            bounce = mi.UInt32(0)  # scattering events so far
            reflected = mi.Bool(False)  # by a rough surface before
            light = mi.Spectrum(0.0)
            throughput = mi.Spectrum(1.0)
            active = mi.Bool(active)
            previous = dr.zeros(mi.Interaction3f)
            pdf = mi.Float(1.0)
            delta = mi.Bool(True)
            medium = dr.zeros(mi.MediumPtr)
            step = mi.UInt32(0)
            while active:
                si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
                filled = active & (medium != None) & si.is_valid()  # noqa: E711
                fade = dr.select(filled, dr.exp(-self.absorption(medium, si, filled) * si.t), 1.0)
                throughput = product(throughput, scaled(fade))
                bsdf = si.bsdf(ray)

                # light that is hit
                ds = mi.DirectionSample3f(scene, si=si, ref=previous)
                mis = mis_weight(pdf, scene.pdf_emitter_direction(previous, ds, ~delta))
                emitted = ds.emitter.eval(si, active & (bounce < self.max_depth)) * dr.select(delta, 1.0, mis)
                light = light + product(throughput, emitted)

                # light that is sampled: of every point light, and of one of the others
                last = bounce + 1 >= self.max_depth
                clear = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) | (
                    mi.has_flag(bsdf.flags(), mi.BSDFFlags.DeltaTransmission)
                    & ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.DeltaReflection)
                )
                onward = active & si.is_valid() & (~last | clear)
                lit = onward & ~last & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
                throughput = dr.select(lit & reflected, throughput * self.interreflection, throughput)
                light = dr.select(lit, light + product(throughput, self.own_light(scene, si, ray.o)), light)
                if dr.hint(self.points > 0, mode="scalar"):
                    light = light + product(throughput, self.from_points(scene, sampler, si, ray.o, medium, lit))
                if dr.hint(self.others, mode="scalar"):
                    ds, weight = scene.sample_emitter_direction(si, sampler.next_2d(), False, lit)
                    one = lit & (ds.pdf != 0) & ~mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.DeltaPosition)
                    light = light + product(throughput, self.sent(scene, si, ray.o, medium, ds, weight, one))

                # onward
                bs, factor = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), onward)
                factor = si.to_world_mueller(factor, -bs.wo, si.wi)
                straight = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
                reflected |= onward & ((bs.sampled_type & REFLECTED) != 0)
                factor = dr.select(lit, product(factor, self.kept(si, ray.o, si.p)), factor)
                throughput = dr.select(onward, product(throughput, factor), throughput)
                direction = si.to_world(bs.wo)
                medium = dr.select(onward & si.is_medium_transition(), si.target_medium(direction), medium)
                ray = si.spawn_ray(direction)
                scattered = onward & ~straight
                previous = dr.select(scattered, dr.detach(mi.Interaction3f(si)), previous)
                pdf = dr.select(scattered, dr.detach(bs.pdf), pdf)
                delta = dr.select(scattered, mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta), delta)
                bounce = dr.select(scattered, bounce + 1, bounce)
                step += 1
                active = (
                    onward & (dr.max(mi.unpolarized_spectrum(throughput)) > 0) & (step < self.max_depth + self.max_null)
                )
            channels = []
            if dr.hint(self.stokes and mi.is_polarized, mode="scalar"):
                basis = mi.mueller.stokes_basis(-first)
                side = dr.normalize(dr.cross(first, self.vertical))
                vector = mi.mueller.rotate_stokes_basis_m(-first, basis, side) @ light
                channels = [vector[i, 0][j] for i in range(4) for j in range(self.lanes)]
            return light, mi.Bool(True), channels, None

        def to_string(self):
            return f"Tactile[bands={self.bands}]"

    return Tactile


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


part = Part("tactile", "integrator", PARAMETERS, build, checks=(check_lit_plate,))
