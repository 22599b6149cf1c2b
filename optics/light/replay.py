"""Replay: derivatives of an image in forward and in reverse mode, one surface of the light's way at a time.

Dr.Jit differentiates no loop over parameters of the scene, and the graph of a way of 256 surfaces would take gigabytes.
So one surface at a time is differentiated, inside a loop over the surfaces. Of a state x_k = (light gathered L,
throughput T, ray o, d), parameters p and x_k+1 = f(x_k, p) (`Walk.event`):

    forward   dx_k+1 = df/dx dx_k + df/dp dp       from the camera on, along with the light's way
    reverse   g_k = (df/dx)^T g_k+1,  dp += (df/dp)^T g_k+1       backwards over states that were recorded before

For the reverse, the way is followed twice: first to keep every STRIDE-th state, then from each of these, last one
first, to record all states of a stretch, with the random numbers that were drawn. So memory holds STRIDE states per
ray, and one more for each stretch. The samples are those of the image of the same seed. Densities and visibilities are
detached, as in the image: what the edge of a shadow or of a shape does when it moves is missed.

Source: Griewank & Walther, Evaluating Derivatives, 2nd ed. (2008), ch. 12, for checkpoints; Vicini, Speierer & Jakob,
ACM TOG 40, 108 (2021), for derivatives inside the loop. Its replay of the throughput by division is not possible here:
a polarizer's Mueller matrix has no inverse."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi

STRIDE = 16  # surfaces between two states that are kept: about the square root of the longest way (256)
KEEP_INPUTS = dr.ADFlag.ClearEdges | dr.ADFlag.ClearInterior  # parameters keep their tangents for the next surface
RECORDED = ("ray", "throughput", "bounce", "step", "reflected", "previous", "pdf", "delta", "medium")


class Tape:
    """A sampler that notes what it draws, or draws what was noted (`drawn` given)."""

    def __init__(self, sampler=None, drawn=()):
        self.sampler, self.drawn, self.next = sampler, list(drawn), 0

    def take(self, draw, active):
        if self.sampler is not None:
            self.drawn.append(getattr(self.sampler, draw)(active))
        self.next += 1
        return self.drawn[self.next - 1]

    def next_1d(self, active=True):
        return self.take("next_1d", active)

    def next_2d(self, active=True):
        return self.take("next_2d", active)


def leaf(value):
    """A copy that derivatives are asked of."""
    found = type(value)(dr.detach(value))
    dr.enable_grad(found)
    return found


def backward(*ends) -> None:
    """Hand adjoints on to all that values depend on: (value, adjoint), ..."""
    ends = [(value, adjoint) for value, adjoint in ends if dr.grad_enabled(value)]
    for value, adjoint in ends:
        dr.set_grad(value, adjoint)
        dr.enqueue(dr.ADMode.Backward, value)
    if ends:
        dr.traverse(dr.ADMode.Backward)


class Replay:
    """Methods of the integrator that `dr.forward` and `dr.backward` call through `mi.render`."""

    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        """Derivative of the image (H, W, C) along the parameters' tangents."""
        with dr.suspend_grad():
            shot = self.shoot(scene, sensor, seed, spp)
            _, light, times = self.checkpoints(scene, shot)
            moved = [mi.Vector3f(0), mi.Vector3f(0), mi.Vector3f(0)]
            with dr.resume_grad():
                given = (shot.ray.o, shot.ray.d, self.vertical)
                if attached := [v for v in given if dr.grad_enabled(v)]:
                    dr.forward_to(attached, flags=KEEP_INPUTS)
                    moved = [mi.Vector3f(dr.grad(v)) for v in given]
            tangent = self.push(scene, shot, times, *moved[:2])
            with dr.resume_grad():
                leaves = [leaf(v) for v in (light, shot.start.d, self.vertical)]
                for value, change in zip(leaves, (tangent, *moved[1:])):
                    dr.set_grad(value, change)
                image = self.developed(shot, *leaves)
                dr.forward_to(image)
                return dr.grad(image)

    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        """Add to the parameters' gradients those of a function of the image, from its gradient by the image
        (H, W, C)."""
        with dr.suspend_grad():
            shot = self.shoot(scene, sensor, seed, spp)
            kept, light, times = self.checkpoints(scene, shot)
            with dr.resume_grad():
                leaves = [leaf(v) for v in (light, shot.start.d, self.vertical)]
                backward((self.developed(shot, *leaves), grad_in))
                light, first, vertical = (dr.grad(v) for v in leaves)
            adjoint = {"throughput": dr.zeros(mi.Spectrum), "o": mi.Vector3f(0), "d": mi.Vector3f(0)}
            for s in reversed(kept):
                adjoint = self.pull(scene, s, times, light, adjoint)
            with dr.resume_grad():
                backward((shot.ray.o, adjoint["o"]), (shot.ray.d, adjoint["d"] + first), (self.vertical, vertical))
            dr.eval()

    # -- the image ----------------------------------------------------------------------------------------------------
    def shoot(self, scene, sensor, seed, spp):
        """The camera's rays: `start` without derivatives, `ray` with those of the camera."""
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        with dr.resume_grad():  # effects at neutral act where a derivative is asked of them
            self.look_up(scene)
        sampler, spp = self.prepare(sensor, seed, spp, self.aov_names())
        ray, weight, place = self.sample_rays(scene, sensor, sampler)
        start = mi.Ray3f(dr.detach(ray))
        return SimpleNamespace(
            film=sensor.film(), spp=spp, sampler=sampler, ray=ray, start=start, weight=weight, place=place
        )

    def developed(self, shot, light, first, vertical):
        """The film's image of what the rays gathered."""
        from mitsuba.python.ad.integrators.common import ADIntegrator

        block = shot.film.create_block()
        block.set_coalesce(block.coalesce() and shot.spp >= 4)  # as Mitsuba does for the image itself
        ADIntegrator._splat_to_block(
            block,
            shot.film,
            shot.place,
            value=light * shot.weight,
            weight=1.0,
            alpha=mi.Float(1.0),
            aovs=self.channels(light, first, vertical),
            wavelengths=shot.start.wavelengths,
        )
        shot.film.put_block(block)
        return shot.film.develop()

    # -- the way ------------------------------------------------------------------------------------------------------
    def checkpoints(self, scene, shot) -> tuple[list[dict], object, int]:
        """Every STRIDE-th state of the rays' way, the light that they gather on all of it, and the number of surfaces
        that the longest of their shadow rays meets."""
        s, kept = self.start(shot.start, shot.sampler.clone()), []
        dr.eval(s)
        while True:
            kept.append({**s, "sampler": s["sampler"].clone()})
            s = self.walk(scene, s, dr.opaque(mi.UInt32, len(kept) * STRIDE))
            longest = dr.max(s["shadow"])
            dr.eval(s, longest)
            if not dr.any(s["active"]):
                return kept, s["light"], int(longest[0])

    def differentiated(self, scene, s: dict, times: int) -> tuple:
        """The leaves (throughput, o, d) of a state, and the results (light, throughput, o, d) of its next surface."""
        leaves = [leaf(v) for v in (s["throughput"], s["ray"].o, s["ray"].d)]
        ray = mi.Ray3f(s["ray"])
        ray.o, ray.d = leaves[1:]
        after = self.event(scene, {**s, "throughput": leaves[0], "ray": ray}, times)
        return after, leaves, (after["light"], after["throughput"], after["ray"].o, after["ray"].d)

    def push(self, scene, shot, times: int, o, d):
        """Tangent of the light that the rays gather, from the tangents of their origins and directions."""

        def step(state):
            with dr.resume_grad():
                after, leaves, results = self.differentiated(scene, state["way"], times)
                for value, name in zip(leaves, ("throughput", "o", "d")):
                    dr.set_grad(value, state[name])
                dr.forward_to([v for v in results if dr.grad_enabled(v)], flags=KEEP_INPUTS)
                light, throughput, o, d = (dr.grad(v) for v in results)
            after.update({name: dr.detach(after[name]) for name in ("light", "throughput", "ray", "previous")})
            found = {"throughput": throughput, "o": mi.Vector3f(o), "d": mi.Vector3f(d)}
            return ({"way": after, "light": state["light"] + light, **found},)

        state = {
            "way": self.start(shot.start, shot.sampler),
            "light": dr.zeros(mi.Spectrum),
            "throughput": dr.zeros(mi.Spectrum),
            "o": o,
            "d": d,
        }
        state = dr.while_loop((state,), lambda state: state["way"]["active"], step)[0]
        return state["light"]

    def record(self, scene, s: dict, times: int) -> tuple[dict, object]:
        """All states of a stretch of STRIDE surfaces with the random numbers drawn there (surface, ray), and how many
        surfaces each ray meets on it."""
        count, start = dr.width(s["ray"]), s["step"]
        lane = dr.arange(mi.UInt32, count)
        book = {name: dr.empty(type(s[name]), count * STRIDE) for name in RECORDED}
        book["drawn"] = [dr.empty(kind, count * STRIDE) for kind in self.draws()]
        dr.make_opaque(book)

        def step(state):
            tape = Tape(state["sampler"])
            after = self.event(scene, {**state, "sampler": tape}, times)
            place = (state["step"] - start) * count + lane
            for name in RECORDED:
                dr.scatter(book[name], state[name], place)
            for target, value in zip(book["drawn"], tape.drawn, strict=True):
                dr.scatter(target, value, place)
            return ({**after, "sampler": state["sampler"]},)

        s = {**s, "sampler": s["sampler"].clone()}
        end = dr.while_loop((s,), lambda s: s["active"] & (s["step"] - start < STRIDE), step)[0]
        met = end["step"] - start
        dr.eval(met, book)
        return book, met

    def pull(self, scene, s: dict, times: int, light, adjoint: dict) -> dict:
        """Adjoints of a state before a stretch from those after it and from that of the light gathered; those of
        parameters are added to them."""
        book, met = self.record(scene, s, times)
        count = dr.width(met)
        lane = dr.arange(mi.UInt32, count)

        def step(state):
            k = state["k"] - 1
            place = k * count + lane
            s = {name: dr.gather(type(book[name]), book[name], place) for name in RECORDED}
            s["sampler"] = Tape(drawn=[dr.gather(type(d), d, place) for d in book["drawn"]])
            s.update(light=dr.zeros(mi.Spectrum), shadow=mi.UInt32(0), active=mi.Bool(True))
            with dr.resume_grad():
                _, leaves, results = self.differentiated(scene, s, times)
                backward(*zip(results, (light, state["throughput"], state["o"], state["d"])))
                throughput, o, d = (mi.Spectrum(dr.grad(leaves[0])), *(mi.Vector3f(dr.grad(v)) for v in leaves[1:]))
            return ({"k": k, "throughput": throughput, "o": o, "d": d},)

        end = dr.while_loop(({"k": met, **adjoint},), lambda state: state["k"] > 0, step)[0]
        dr.eval(end)
        return {name: end[name] for name in adjoint}
