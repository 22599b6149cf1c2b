"""LED by LED: the light of a single LED on given points of the skin, what calibration and batches use.

The camera's rays are followed once through the flat interfaces (`hits`); each LED is then a shading of these points
with a visibility of its own (`direct`, `visible`), so that powers, colours and exposures need no new rays. The methods
of `LedByLed` become methods of the integrator `tactile`; this module is imported where a part is built, after a variant
is set."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from optics.light.grazing import density, drawn
from optics.light.windows import seen_through

# share of the coordinates' size (mm) that a ray is moved along its direction beyond a flat interface, so that it does
# not meet it again; float32 resolves 1e-7
BEYOND = 1e-4


def is_interface(shape) -> bool:
    """Whether a shape is a flat boundary that the camera looks through."""
    return getattr(shape.bsdf(), "role", "") == "interface"


class LedByLed:
    """Methods of the integrator that follow the light of one LED at a time.

    fronts   of a crowded scene (`optics.scene.crowd.Traced`), whose flat interfaces stand in a scene of their own, and
             bend the light of LEDs; None elsewhere, where it passes them straight"""

    def hits(self, scene, camera, u, v):
        """Where the camera's rays through the pixel positions (u, v) meet the membrane: (si, weight, origin)."""
        return self.reached(scene, *camera.ray(u, v))

    def reached(self, scene, o, d):
        """Where rays meet the membrane, whatever flat interfaces they pass: (si, weight, origin)."""
        ray = mi.Ray3f(o, d, mi.Float(0), self.wavelengths(dr.width(o)))
        si = scene.ray_intersect(ray)
        weight = mi.UnpolarizedSpectrum(1.0)
        for _ in range(sum(1 for s in scene.shapes() if is_interface(s))):
            flat = si.is_valid() & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.DeltaTransmission)
            bs, passed = si.bsdf().sample(mi.BSDFContext(), si, mi.Float(0.5), mi.Point2f(0.5), flat)
            d = si.to_world(bs.wo)
            # spawn_ray would shift it sideways, along the normal
            start = si.p + d * (BEYOND * (1 + dr.max(dr.abs(si.p))))
            through = scene.ray_intersect(mi.Ray3f(start, d, mi.Float(0), si.wavelengths), flat)
            weight = dr.select(flat, weight * mi.unpolarized_spectrum(passed), weight)
            si = dr.select(flat, through, si)
        return si, weight, dr.select(si.is_valid(), si.p + si.to_world(si.wi) * si.t, o)

    def between(self, shapes, led):
        """The flat interfaces among some shapes that stand between an LED and the skin."""
        nearest = led.stands()[2] - led.reach()
        return [s for s in shapes if is_interface(s) and s.bbox().max.z > nearest]

    def appears(self, scene, p, led, point):
        """(LED, point) as they appear from the points p, behind interfaces that bend light."""
        if self.fronts is None or self.fronts.scene is not scene:
            return led, point
        faces = self.between(self.fronts.faces(), led)
        return seen_through(p, led, point, faces) if faces else (led, point)

    def spots(self, led):
        """The points that stand for an LED, one after another, each for an equal share of its light; opaque, so that
        what is compiled for one serves all."""
        for place in led.places():
            yield led.point(mi.Point2f(*(dr.opaque(mi.Float, c) for c in place)))
        if not led.places():
            yield led.position()

    def visible(self, scene, si, point, led):
        """Whether the straight line from the surface to a point of an LED meets nothing but windows (detached)."""
        with dr.suspend_grad():
            valid = si.is_valid()
            ray = si.spawn_ray_to(self.appears(scene, si.p, led, point)[1])
            for _ in self.between(scene.shapes(), led):
                hit = scene.ray_intersect(ray, valid)
                flat = hit.is_valid() & mi.has_flag(hit.bsdf().flags(), mi.BSDFFlags.DeltaTransmission)
                ray = dr.select(flat, hit.spawn_ray_to(point), ray)
            return valid & ~scene.ray_test(ray, valid)

    def excited(self, scene, si, led, to_led, distance):
        """Radiance per band of the fluorescence that one LED excites."""
        total = mi.UnpolarizedSpectrum(0.0)
        for pigment in self.glowing(scene):
            own = si.is_valid() & (si.bsdf() == mi.BSDFPtr(pigment))
            total += dr.select(own, pigment.fluorescence(si, led, to_led, distance), 0.0)
        return total

    def excited_again(self, scene, si, second, led, point, visibility):
        """Radiance per band of the fluorescence at `si` that light of an LED excites which a second pigment reflects,
        for a direction that was drawn by its cosine: pi times the radiance is the irradiance."""
        total = mi.UnpolarizedSpectrum(0.0)
        led, point = self.appears(scene, second.p, led, point)
        to_led = point - second.p
        distance = dr.norm(to_led)
        to_led /= distance
        cos = dr.maximum(dr.dot(second.sh_frame.n, to_led), 0.0)
        sent = led.kappa(second, to_led, distance) * cos & visibility
        for pigment in self.glowing(scene):
            own = si.is_valid() & (si.bsdf() == mi.BSDFPtr(pigment))
            for other in self.glowing(scene):
                here = own & second.is_valid() & (second.bsdf() == mi.BSDFPtr(other))
                again = pigment.excited(si, led, other.returned(led.wavelength) * sent)
                total += dr.select(here, again, 0.0)
        return total

    def direct(self, scene, si, weight, origin, led, visibility, point=None):
        """Radiance per band that one LED sends to the camera by one reflection (S3, S5), and by the gel itself; as a
        point at its position, or at another."""
        led, point = self.appears(scene, si.p, led, led.position() if point is None else point)
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

    def ambient(self, scene, si, weight, origin, membrane):
        """Radiance per band that no LED made, of one membrane; the gel acts on it on the way to the camera."""
        own = si.is_valid() & (si.bsdf() == mi.BSDFPtr(membrane))
        return dr.select(own, membrane.ambient_radiance(si), 0.0) * weight * self.kept_to(scene, si, origin)

    def kept_to(self, scene, si, origin, led=None):
        """Share of the light that effects of the gel leave on its way from the surface to where a ray began."""
        gel, share = self.gel(scene), mi.UnpolarizedSpectrum(1.0)
        for function in gel.functions("segment") if gel is not None else ():
            share *= function(gel.path(si.p, origin, si.p, led, si), gel)
        return share

    def second_direction(self, si, sampler, grazing):
        """(direction, BRDF times cosine over the density that it was drawn by, cosine over pi and this density); drawn
        by the surface's law, or with `grazing` most of them where a level skin meets itself."""
        context, bsdf, n = mi.BSDFContext(), si.bsdf(), si.sh_frame.n
        bs, factor = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), si.is_valid())
        if not grazing:
            return si.to_world(bs.wo), mi.unpolarized_spectrum(factor), 1.0
        w, counts = drawn(n, sampler.next_1d(), sampler.next_2d(), si.to_world(bs.wo))
        own = si.to_local(w)
        value, law = bsdf.eval_pdf(context, si, own, si.is_valid() & counts)
        p = density(n, w, law)
        weight = dr.select(counts & (p > 0), 1 / p, 0.0)
        cos = dr.maximum(mi.Frame3f.cos_theta(own), 0.0)
        return w, mi.unpolarized_spectrum(value) * weight, cos / dr.pi * weight

    def met_next(self, scene, si, sampler, grazing):
        """What second directions meet: the same for every LED (detached)."""
        with dr.suspend_grad():
            second = scene.ray_intersect(si.spawn_ray(self.second_direction(si, sampler, grazing)[0]), si.is_valid())
            dr.eval(second)
        return second

    def bounced(self, scene, si, weight, origin, led, count, sampler, grazing=False, met=None):
        """Radiance per band that one LED sends to the camera by two reflections, mean of `count` directions; of one,
        which met what `met_next` found, if that is given."""
        total = mi.UnpolarizedSpectrum(0.0)
        for _ in range(count):
            w, factor, cosine = self.second_direction(si, sampler, grazing)
            second = scene.ray_intersect(si.spawn_ray(w), si.is_valid()) if met is None else met
            point = led.point(sampler.next_2d()) if led.reach() > 0 else led.position()
            seen = self.visible(scene, second, point, led)
            light = factor * self.direct(scene, second, 1.0, si.p, led, seen, point)
            light += cosine * self.excited_again(scene, si, second, led, point, seen)
            total += dr.select(second.is_valid(), light, 0.0)
        # `direct` followed the light up to the first surface only
        return total * weight * self.kept_to(scene, si, origin, led) / count
