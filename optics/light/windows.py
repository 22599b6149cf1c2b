"""Light of an LED that comes through flat interfaces: where the LED appears to stand, and how bright.

Light leaves the LED at the angle a to the interfaces' normal, and runs at a_i in the layer i, which is t_i thick and
has the index n_i over that of the first one:

    sin a = n_i sin a_i                                             Snell
    rho = sum t_i tan a_i                                           the way sideways, which tells a
    1/d^2 = dOmega/dA = sin a da / (rho drho cos a_m)
          = 1 / (cos a cos a_m  sum t_i/(n_i cos a_i)  sum t_i/(n_i cos^3 a_i))
    T = product over the interfaces of (T_s + T_p)/2                of the part `interface`

with the last layer m and the area dA across the light there. A point sees the LED along a_m, at the distance d, by the
light that it sends along a, times T. Without a change of index it is the LED itself.

Source: Born & Wolf, Principles of Optics, 1.5 and 3.2.2 (intensity along a tube of rays). This module is imported where
a part is built, after a variant is set."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

STEPS = 8  # Newton's, from the straight line: angles near grazing are right to float32
GRAZING = 1 - 1e-5  # of the sine at which light runs along an interface
THIN = 1e-6  # mm, of a layer that a body pushes through


class Seen:
    """An LED as it appears from behind interfaces: it is what it is, but for where its light leaves it and how much of
    that comes through. `out`: unit vector to the LED where it leaves; `passed`: T."""

    def __init__(self, led, out, passed):
        self.led, self.out, self.passed = led, out, passed

    def __getattr__(self, name):
        return getattr(self.led, name)

    def kappa(self, it, to_led, distance):
        return self.led.kappa(it, self.out, distance) * self.passed

    def radiance(self, it, to_led, distance):
        return self.led.radiance(it, self.out, distance) * self.passed


def seen_through(p, led, point, faces: Sequence):
    """(LED, point) as they appear from the points p, behind flat interfaces across the z axis.

    faces   shapes of the part `interface`, those that the light meets first first; the LED is on their camera's side
    """
    bounds = [float(face.bbox().min.z) for face in faces]
    n = [mi.Float(1.0)]
    for face in faces:
        n.append(n[-1] * face.bsdf().index)
    t = [bounds[0] - point.z, *(b - a for a, b in zip(bounds, bounds[1:])), dr.maximum(p.z - bounds[-1], THIN)]
    side = mi.Vector2f(point.x - p.x, point.y - p.y)
    rho = dr.norm(side)

    def way(q):
        """(rho, d rho/dq, cosines) of the sine q."""
        cos = [dr.sqrt(1 - dr.square(q / own)) for own in n]
        reached = sum(t_i * q / (own * c) for t_i, own, c in zip(t, n, cos))
        return reached, sum(t_i / (own * c * c * c) for t_i, own, c in zip(t, n, cos)), cos

    with dr.suspend_grad():
        most, depth = mi.Float(1.0), mi.Float(0.0)
        for own, t_i in zip(n, t):
            most, depth = dr.minimum(most, own), depth + t_i
        most *= GRAZING
        q = dr.minimum(rho / dr.hypot(rho, depth), most)
        for _ in range(STEPS):
            reached, slope, _ = way(q)
            q = dr.clip(q - (reached - rho) / slope, 0, most)
    q = dr.detach(q)
    reached, slope, _ = way(q)
    q = dr.clip(q - (reached - rho) / slope, 0, most)  # once more, with derivatives
    _, slope, cos = way(q)
    spread = sum(t_i / (own * c) for t_i, own, c in zip(t, n, cos))
    distance = dr.sqrt(spread * slope * cos[0] * cos[-1])
    along = side / dr.maximum(rho, 1e-9)
    arrives, leaves = q / n[-1], q
    passed = mi.Float(1.0)
    for face, own, c in zip(faces, n, cos):
        _, t_s, t_p, _ = face.bsdf().refract(mi.Vector3f(q / own, 0, c))
        passed *= (t_s + t_p) / 2
    towards = mi.Vector3f(along.x * arrives, along.y * arrives, -cos[-1])
    out = mi.Vector3f(along.x * leaves, along.y * leaves, -cos[0])
    return Seen(led, out, passed), p + towards * distance
