"""Solid angle: even samples of the directions in which a point sees a rectangle.

Points spread evenly over a lamp's area are noise near it, where their light goes by cos_l / r^2; directions spread
evenly over the solid angle Omega that it fills all bring the same: E = L cos_s Omega of every sample.

    Omega = g0 + g1 + g2 + g3 - 2 pi        of the inner angles g of the rectangle's image on the unit sphere

Source: Urena, Fajardo & King, An area-preserving parametrization for spherical rectangles, CGF 32(4), 59 (2013),
section 3."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

SMALL = 1e-3  # sr; below it rounding of the four angles counts, and points of the area serve as well


@dataclass(frozen=True)
class Rectangle:
    """Of Dr.Jit's numbers: corner; x, y unit vectors along its edges, width and height (mm); light leaves along
    `normal`."""

    corner: object
    x: object
    y: object
    normal: object
    width: object
    height: object

    @classmethod
    def of(cls, shape) -> Rectangle | None:
        """A shape of Mitsuba as a rectangle; None: it is none, or a sheared one. Not to be called within a loop of
        Dr.Jit."""
        import drjit as dr
        import mitsuba as mi

        if shape.shape_type() != +mi.ShapeType.Rectangle:
            return None
        corner, right, up = (
            np.ravel(np.array(shape.sample_position(mi.Float(0), mi.Point2f(*at)).p)).astype(float)
            for at in ((0, 0), (1, 0), (0, 1))
        )
        width, height = np.linalg.norm(right - corner), np.linalg.norm(up - corner)
        x, y = (right - corner) / width, (up - corner) / height
        if abs(x @ y) > 1e-5:
            return None
        found = cls(
            mi.Point3f(*corner.tolist()),
            *(mi.Vector3f(*v.tolist()) for v in (x, y, np.cross(x, y))),
            mi.Float(float(width)),
            mi.Float(float(height)),
        )
        dr.make_opaque(*vars(found).values())  # a place that a calibration moves compiles no new kernel
        return found

    def seen(self, place, sample):
        """A point of the rectangle in an even direction, and its solid angle from the place: (point, Omega), Dr.Jit.

        Where Omega < 1e-3 sr the point is even in area, and what is given is its weight A cos_l / r^2.
        """
        import drjit as dr
        import mitsuba as mi

        to = self.corner - place
        x0, y0 = dr.dot(to, self.x), dr.dot(to, self.y)
        x1, y1, depth = x0 + self.width, y0 + self.height, dr.minimum(-dr.abs(dr.dot(to, self.normal)), -1e-6)
        # normals of the four sides of the pyramid; each has one component along z
        n0, n1, n2, n3 = (c * dr.rsqrt(dr.square(depth) + dr.square(c)) for c in (-y0, x1, y1, -x0))
        g0, g1, g2, g3 = (dr.safe_acos(-a * b) for a, b in ((n0, n1), (n1, n2), (n2, n3), (n3, n0)))
        omega = g0 + g1 + g2 + g3 - 2 * math.pi
        # across: the arc that cuts off the sample's share; along it: evenly in the height over the unit sphere's
        # equator
        angle = sample.x * omega + 2 * math.pi - g2 - g3
        sin, cos = dr.sincos(angle)
        f = (cos * n0 - n2) / dr.select(dr.abs(sin) < 1e-9, 1e-9, sin)
        c = dr.clip(dr.copysign(dr.rsqrt(dr.square(f) + dr.square(n0)), f), -1, 1)
        xu = dr.clip(-c * depth * dr.rsqrt(dr.maximum(1 - dr.square(c), 1e-12)), x0, x1)
        far = dr.sqrt(dr.square(xu) + dr.square(depth))
        h0, h1 = (e * dr.rsqrt(dr.square(far) + dr.square(e)) for e in (y0, y1))
        h = h0 + sample.y * (h1 - h0)
        yv = dr.clip(h * far * dr.rsqrt(dr.maximum(1 - dr.square(h), 1e-12)), y0, y1)

        small = omega < SMALL
        across, along = (
            dr.select(small, x0 + sample.x * self.width, xu),
            dr.select(small, y0 + sample.y * self.height, yv),
        )
        square = dr.square(across) + dr.square(along) + dr.square(depth)
        by_area = self.width * self.height * -depth * dr.rsqrt(square) / square
        point = mi.Point3f(self.corner + (across - x0) * self.x + (along - y0) * self.y)
        return point, dr.select(small, by_area, dr.maximum(omega, 0.0))
