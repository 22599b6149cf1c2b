"""Directions in which a skin that is level at rest meets itself.

A flank of a dent meets the level face in the lune between its own horizon and the level; beyond its edge, everything
meets its neighbours' flanks a little above the level. Directions drawn by the cosine rarely lead to either.

    lune    by the cosine exactly (Nusselt: uniform in the lune's projection onto the tangent plane)
            density  (w.n)/pi / ((1 - cos(theta))/2)
    low     uniform in azimuth and elevation e, from the surface's horizon or the level to ABOVE
            density  1/(2 pi (ABOVE - e_low) cos(e))

per steradian, with n the normal of the surface, m that of the level, along z, and cos(theta) = n.m. All directions that
meet the level then weigh alike. The rest is drawn by the surface's own law, and each direction is weighed by the three
densities together: the mean is right for every shape (balance heuristic: Veach & Guibas, SIGGRAPH 1995, 419)."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

ABOVE = math.radians(35.0)  # up to which flanks of neighbouring dents are met
LUNE, LOW = 0.5, 0.35  # shares of the directions; where the surface is level, the lune's are drawn low
LEAST = 1e-4  # 1 - cos(theta) of a surface that has a lune, and cosine of one that still has a horizon


def _level(n):
    """(normal at rest, n.m): towards the side that the surface looks to."""
    m = mi.Vector3f(0, 0, dr.select(n.z < 0, mi.Float(-1), mi.Float(1)))
    return m, dr.dot(n, m)


def _shares(cos):
    """(share drawn in the lune, share drawn low) of surfaces tilted by cos = n.m."""
    lune = dr.select((1 - cos > LEAST) & (cos > LEAST), mi.Float(LUNE), mi.Float(0))
    low = dr.select(cos > LEAST, LUNE + LOW - lune, 0.0)
    return lune, low


def _half_circle(u):
    """The cosine of psi with (psi - sin(psi) cos(psi))/pi = u: uniform in a half disc, seen along its diameter."""
    half = dr.minimum(u, 1 - u)
    psi = dr.cbrt(1.5 * dr.pi * half)
    for _ in range(3):
        sin, cos = dr.sincos(psi)
        psi -= (psi - sin * cos - dr.pi * half) / dr.maximum(2 * sin * sin, 1e-9)
    cos = dr.clip(dr.cos(psi), -1, 1)
    return dr.select(u < 0.5, cos, -cos)


def _in_lune(n, m, cos, u):
    """Unit vectors in the lune."""
    across = dr.cross(n, m)
    across /= dr.maximum(dr.norm(across), 1e-9)
    down = dr.cross(n, across)
    down = dr.select(dr.dot(down, m) > 0, -down, down)
    x = _half_circle(u.x)
    y = dr.safe_sqrt(1 - x * x) * (cos + (1 - cos) * u.y)
    return x * across + y * down + dr.safe_sqrt(1 - x * x - y * y) * n


def _lowest(n, cos, h):
    """Elevation from which low directions are drawn, at the azimuth of the level vector h."""
    return dr.maximum(dr.atan2(-dr.dot(h, n), cos), 0.0)


def _low(n, m, cos, u):
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * u.x)
    h = mi.Vector3f(cos_phi, sin_phi, 0)
    least = _lowest(n, cos, h)
    sin, cos_e = dr.sincos(dr.lerp(least, dr.maximum(mi.Float(ABOVE), least), u.y))
    return cos_e * h + sin * m


def drawn(n, choice, u, own):
    """(directions, whether they count): `own` where the number `choice` in 0..1 is beyond both shares; u (2,) numbers
    in the unit square, n unit normals."""
    m, cos = _level(n)
    lune, low = _shares(cos)
    w = dr.select(choice < lune, _in_lune(n, m, cos, u), _low(n, m, cos, u))
    near = choice < lune + low
    w = dr.select(near, w, own)
    return w, ~near | (density(n, w, 0.0) > 0)


def density(n, w, law):
    """1/sr, density of `drawn` at unit vectors w; `law` that of the surface's own directions."""
    m, cos = _level(n)
    lune, low = _shares(cos)
    up = dr.dot(w, m)
    beside = dr.safe_sqrt(1 - up * up)
    h = (w - up * m) / dr.maximum(beside, 1e-9)
    least, e = _lowest(n, cos, h), dr.atan2(up, beside)
    in_lune = dr.dot(w, n) / dr.pi / dr.maximum((1 - cos) / 2, 1e-9)
    in_low = 1 / (2 * dr.pi * dr.maximum((ABOVE - least) * beside, 1e-9))
    found = dr.select((up < 0) & (dr.dot(w, n) > 0), lune * in_lune, 0.0)
    found += dr.select((e >= least) & (e <= ABOVE) & (up >= 0), low * in_low, 0.0)
    return found + (1 - lune - low) * law
