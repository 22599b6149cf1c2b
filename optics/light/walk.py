"""Walk: what a ray of the camera gathers on its way through any scene, one surface after another.

A state holds a wavefront of rays between two surfaces (`start`); `event` takes every ray to its next surface, adds the
light that is hit and the light that is sampled there, and sends the ray on. `walk` repeats `event` until no ray is
left.
The methods of `Walk` become methods of the integrator `tactile`. The classes of Mitsuba that they use are those of the
present variant, so this module is imported where a part is built, after a variant is set."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from optics.scene.surfaces import to_world_mueller

NEAR = 1e-4  # mm: a shadow ray that ends nearer to its light than this has arrived


def product(a, b):
    """a after b: of Mueller matrices in polarized variants, of spectra in others."""
    return a @ b if mi.is_polarized else a * b


def scaled(value):
    """A spectrum as the Mueller matrix of an absorber (polarized variants) or as it is."""
    return mi.mueller.absorber(value) if mi.is_polarized else mi.Spectrum(value)


def heuristic(pdf_a, pdf_b):
    """Weight of a sample of density a by the power heuristic, detached."""
    from mitsuba.python.ad.integrators.common import mis_weight

    return mis_weight(pdf_a, pdf_b)


def masked(active, new: dict, old: dict) -> dict:
    """The new state of the rays that are active, the old one of others. A sampler moves on by itself."""
    return {name: new[name] if name == "sampler" else dr.select(active, new[name], old[name]) for name in new}


def repeat(state: dict, going: Callable, step: Callable, times: int | None = None) -> dict:
    """`step` as long as a ray is going.

    times   None: a loop that is traced once. A number: so many steps one after another, as a derivative needs them;
            Dr.Jit differentiates no traced loop that uses parameters of the scene
    """
    if times is None:
        return dr.while_loop((state,), lambda s: going(s), lambda s: (step(s),))[0]
    for _ in range(times):
        state = masked(going(state), step(state), state)
    return state


def held(mask, value):
    """The value, without derivatives where the mask is false: there they may be infinite, and 0 times that is no
    number."""
    return dr.select(mask, value, dr.detach(value)) if dr.grad_enabled(value) else value


def reflecting() -> int:
    """Flags of a reflection by a rough surface, not through it."""
    return int(mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.GlossyReflection)


def see_through(flags):
    """Whether rays pass a surface straight or refracted, and none is reflected: it takes nothing of the depth."""
    return mi.has_flag(flags, mi.BSDFFlags.Null) | (
        mi.has_flag(flags, mi.BSDFFlags.DeltaTransmission) & ~mi.has_flag(flags, mi.BSDFFlags.DeltaReflection)
    )


class Walk:
    """Methods of the integrator that follow light in any scene; what `mi.render` calls."""

    def look_up(self, scene) -> None:
        """What acts in a scene besides its surfaces and lights: the gel and its effects, LEDs, membranes that
        shine."""
        self.inside = gel = self.gel(scene)
        self.fading, self.veils = (gel.functions(s) if gel is not None else () for s in ("segment", "volume"))
        emitters = scene.emitters()
        points = [i for i, e in enumerate(emitters) if mi.has_flag(e.flags(), mi.EmitterFlags.DeltaPosition)]
        boards = sum(getattr(e, "role", "") == "board" for e in emitters)
        self.points, self.others = len(points), len(points) + boards < len(emitters)
        self.point_lights = dr.gather(mi.EmitterPtr, scene.emitters_dr(), mi.UInt32(points)) if points else None
        self.point_list = [emitters[i] for i in points]
        self.lamps = (
            [e for e in emitters if getattr(e, "role", "") == "led"] if self.veils or self.glowing(scene) else []
        )
        self.shining = [
            m
            for m in {s.bsdf() for s in scene.shapes()}
            if getattr(m, "role", "") == "membrane" and m.functions("ambient")
        ]

    # -- the rays -----------------------------------------------------------------------------------------------------
    def start(self, ray, sampler, active=True) -> dict:
        """The state of rays that leave the camera.

        light       what each has gathered: a Mueller matrix or a spectrum per band
        throughput  what becomes of light that it meets next, on its way to the camera
        bounce      scattering events so far;   step  surfaces so far;   reflected  by a rough surface before
        previous, pdf, delta    where and how it was scattered last, for the weight of luminous areas that it meets
        shadow      surfaces that the longest of its shadow rays met
        """
        return {
            "ray": mi.Ray3f(ray),
            "light": mi.Spectrum(0.0),
            "throughput": mi.Spectrum(1.0),
            "bounce": mi.UInt32(0),
            "step": mi.UInt32(0),
            "reflected": mi.Bool(False),
            "active": mi.Bool(active),
            "previous": dr.zeros(mi.Interaction3f),
            "pdf": mi.Float(1.0),
            "delta": mi.Bool(True),
            "medium": dr.zeros(mi.MediumPtr),
            "shadow": mi.UInt32(0),
            "sampler": sampler,
        }

    def walk(self, scene, s: dict, until=None) -> dict:
        """Follow rays to their end, or until each has met `until` surfaces."""
        return repeat(
            s,
            lambda s: s["active"] if until is None else s["active"] & (s["step"] < until),
            lambda s: self.event(scene, s),
        )

    def draws(self) -> list[type]:
        """What `event` draws from the sampler, in its order: a point of each LED with an area, for the light of
        haze and pigments; a point of each light; and the way on."""
        wide = sum(1 for led in self.lamps if led.reach() > 0)
        return [mi.Point2f] * (wide + self.points + self.others) + [mi.Float, mi.Point2f]

    def event(self, scene, s: dict, times: int | None = None) -> dict:
        """The state after the next surface. `times`: surfaces that shadow rays meet, see `repeat`."""
        s = dict(s)
        sampler, active = s["sampler"], s["active"]
        si = scene.ray_intersect(s["ray"], mi.RayFlags.All, coherent=False, active=active)
        si = held(active & si.is_valid(), si)
        filled = active & (s["medium"] != None) & si.is_valid()  # noqa: E711 (a Dr.Jit comparison)
        fade = dr.select(filled, dr.exp(-self.absorption(s["medium"], si, filled) * si.t), 1.0)
        s["throughput"] = product(s["throughput"], scaled(fade))
        bsdf = si.bsdf(s["ray"])
        s["light"] = s["light"] + product(s["throughput"], self.met(scene, s, si))

        last = s["bounce"] + 1 >= self.max_depth
        onward = active & si.is_valid() & (~last | see_through(bsdf.flags()))
        lit = onward & ~last & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        s["throughput"] = dr.select(lit & s["reflected"], s["throughput"] * self.interreflection, s["throughput"])
        s["light"], longest = self.sampled(scene, s, si, lit, times)
        s["shadow"] = dr.maximum(s["shadow"], longest)
        self.send_on(s, si, bsdf, sampler, onward, lit)
        s["step"] = s["step"] + 1
        s["active"] = (
            onward
            & (dr.max(mi.unpolarized_spectrum(s["throughput"])) > 0)
            & (s["step"] < self.max_depth + self.max_null)
        )
        return s

    def met(self, scene, s: dict, si):
        """What the surface itself sends out, where a ray meets a light."""
        ds = mi.DirectionSample3f(scene, si=si, ref=s["previous"])
        mis = heuristic(s["pdf"], scene.pdf_emitter_direction(s["previous"], ds, ~s["delta"]))
        return ds.emitter.eval(si, s["active"] & (s["bounce"] < self.max_depth)) * dr.select(s["delta"], 1.0, mis)

    def sampled(self, scene, s: dict, si, lit, times: int | None) -> tuple:
        """The light gathered after what the gel, every point light and one of the other lights send to a surface; and
        the surfaces that the longest shadow ray met."""
        ray, medium, throughput = s["ray"], s["medium"], s["throughput"]
        light, longest, si = s["light"], mi.UInt32(0), held(lit, si)
        light = dr.select(lit, light + product(throughput, self.own_light(scene, si, ray.o, s["sampler"])), light)
        if self.points > 0:
            sent, longest = self.from_points(scene, s["sampler"], si, ray.o, medium, lit, times)
            light = light + product(throughput, sent)
        if self.others:
            sample = s["sampler"].next_2d()
            ds, weight = scene.sample_emitter_direction(si, sample, False, lit)
            one = lit & (ds.pdf != 0) & ~mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.DeltaPosition)
            if dr.grad_enabled(si):  # from within the plane of a luminous area, the weight has no derivative
                one = one & dr.isfinite(ds.pdf) & (mi.unpolarized_spectrum(weight)[0] != 0)
                si = held(one, si)
                ds, weight = scene.sample_emitter_direction(si, sample, False, lit)
            sent, met = self.sent(scene, si, ray.o, medium, ds, weight, one, times)
            light, longest = light + product(throughput, sent), dr.maximum(longest, met)
        return light, longest

    def send_on(self, s: dict, si, bsdf, sampler, onward, lit) -> None:
        """Draw the rays' way on from a surface, into the state."""
        si = held(onward, si)
        bs, factor = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d(), onward)
        factor = to_world_mueller(si, factor, -bs.wo, si.wi)
        straight = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        s["reflected"] = s["reflected"] | onward & ((bs.sampled_type & reflecting()) != 0)
        factor = dr.select(lit, product(factor, self.kept(si, s["ray"].o, si.p)), factor)
        s["throughput"] = dr.select(onward, product(s["throughput"], factor), s["throughput"])
        direction = si.to_world(bs.wo)
        s["medium"] = dr.select(onward & si.is_medium_transition(), si.target_medium(direction), s["medium"])
        s["ray"] = si.spawn_ray(direction)
        scattered = onward & ~straight
        s["previous"] = dr.select(scattered, dr.detach(mi.Interaction3f(si)), s["previous"])
        s["pdf"] = dr.select(scattered, dr.detach(bs.pdf), s["pdf"])
        s["delta"] = dr.select(scattered, mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta), s["delta"])
        s["bounce"] = dr.select(scattered, s["bounce"] + 1, s["bounce"])

    # -- light that is sampled ----------------------------------------------------------------------------------------
    def absorption(self, medium, si, active):
        """sigma_a of a homogeneous medium in each band, 1/mm."""
        mei = dr.zeros(mi.MediumInteraction3f, dr.width(si))
        mei.p, mei.wavelengths, mei.medium = si.p, si.wavelengths, medium
        sigma_s, _, sigma_t = medium.get_scattering_coefficients(mei, active)
        return sigma_t - sigma_s

    def kept(self, si, origin, point):
        """Share of the light that effects of the gel leave on its way from a point over the surface to where a ray
        began."""
        share = mi.UnpolarizedSpectrum(1.0)
        for function in self.fading:
            share *= function(self.inside.path(si.p, origin, point, None, si), self.inside)
        return scaled(share)

    def own_light(self, scene, si, origin, sampler):
        """Light that the gel and the membranes add by themselves at a surface: stages `volume` and `ambient`."""
        added = mi.UnpolarizedSpectrum(0.0)
        spots = [led.point(sampler.next_2d()) if led.reach() > 0 else led.position() for led in self.lamps]
        for led, point in zip(self.lamps, spots) if self.glowing(scene) else ():
            to_led = point - si.p
            distance = dr.norm(to_led)
            clear = self.visible(scene, si, point, led)
            shone = self.excited(scene, si, led, to_led / distance, distance)
            for function in self.fading:
                shone *= function(self.inside.path(si.p, origin, point, led, si), self.inside)
            added += dr.select(clear, shone, 0.0)
        for function in self.veils:
            for led, point in zip(self.lamps, spots):
                added += function(self.inside.path(si.p, origin, point, led, si), self.inside)
        for membrane in self.shining:
            added += self.ambient(scene, si, 1.0, origin, membrane)
        return mi.mueller.depolarizer(added) if mi.is_polarized else mi.Spectrum(added)

    def transmittance(self, scene, si, ds, medium, active, times: int | None = None) -> tuple:
        """Mueller matrix of the straight way from the surface to a light, through null surfaces and absorbing media;
        and the number of surfaces met."""
        ray = si.spawn_ray_to(ds.p)
        way = {
            "through": mi.Spectrum(1.0),
            "ray": ray,
            "remaining": mi.Float(ray.maxt),
            "inside": mi.MediumPtr(medium),
            "going": mi.Bool(active),
            "step": mi.UInt32(0),
        }

        def onward(w):
            w = dict(w)
            ray, remaining, going = mi.Ray3f(w["ray"]), w["remaining"], w["going"]
            ray.maxt = remaining
            hit = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=going)
            met = going & hit.is_valid()
            length = dr.select(met, hit.t, remaining)
            filled = going & (w["inside"] != None)  # noqa: E711
            fade = dr.select(filled, dr.exp(-self.absorption(w["inside"], hit, filled) * length), 1.0)
            through = product(w["through"], scaled(fade))
            passed = hit.bsdf().eval_null_transmission(hit, met)
            passed = to_world_mueller(hit, passed, hit.wi, hit.wi)
            w["through"] = dr.select(met, product(through, passed), through)
            w["inside"] = dr.select(met & hit.is_medium_transition(), hit.target_medium(ray.d), w["inside"])
            w["remaining"] = remaining - length
            w["ray"] = dr.select(met, hit.spawn_ray(ray.d), ray)
            w["step"] = w["step"] + 1
            w["going"] = (
                met
                & (w["remaining"] > NEAR)
                & (w["step"] < self.max_null)
                & (dr.max(mi.unpolarized_spectrum(w["through"])) > 0)
            )
            return w

        way = repeat(way, lambda w: w["going"], onward, times)
        return way["through"], way["step"]

    def sent(self, scene, si, origin, medium, ds, weight, active, times: int | None = None) -> tuple:
        """What a light sends from a surface to where a ray began, a Mueller matrix or a spectrum; and the surfaces met
        on the way."""
        start = dr.select(si.is_medium_transition(), si.target_medium(ds.d), medium)
        way, met = self.transmittance(scene, si, ds, start, active, times)
        wo = si.to_local(ds.d)
        value, density = si.bsdf().eval_pdf(mi.BSDFContext(), si, wo, active)
        value = to_world_mueller(si, value, -wo, si.wi)
        mis = dr.select(ds.delta, 1.0, heuristic(ds.pdf, density))
        way = product(way, self.kept(si, origin, ds.p))
        return dr.select(active, product(product(value, way), weight) * mis, 0.0), met

    def from_points(self, scene, sampler, si, origin, medium, active, times: int | None = None) -> tuple:
        """What all point lights send: to draw one of them would be most of the noise of a scene lit by LEDs."""

        def one(light, s):
            ds, weight = light.sample_direction(si, s["sampler"].next_2d(s["going"]), s["going"])
            lit = s["going"] & (ds.pdf != 0)
            sent, met = self.sent(scene, si, origin, medium, ds, weight, lit, times)
            return {**s, "total": s["total"] + sent, "longest": dr.maximum(s["longest"], met)}

        def following(s):
            light = dr.gather(mi.EmitterPtr, self.point_lights, s["k"], s["going"])
            s = one(light, s)
            k = s["k"] + 1
            return {**s, "k": k, "going": s["going"] & (k < self.points)}

        state = {"total": mi.Spectrum(0.0), "longest": mi.UInt32(0), "going": mi.Bool(active), "sampler": sampler}
        if times is None:
            state = repeat({**state, "k": mi.UInt32(0)}, lambda s: s["going"], following)
        else:
            for light in self.point_list:
                state = one(mi.EmitterPtr(light), state)
        return state["total"], state["longest"]
