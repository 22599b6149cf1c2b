"""How the shadows of a point light move with it.

A shadow stays where it is while the light moves along the ray that it sends there: only the two components of a move
across that ray count. Differences by x, y and z do not know this. Each has the rounding of the samples that a pixel's
edge crosses, and in a sum in which they should cancel this rounding is left: of a light that may move along its beam,
two thirds of what images seemed to tell about that lay in ten pixels at rims of shadows, and was not there.

Source: Ramamoorthi, Mahajan & Belhumeur, A first-order analysis of lighting, shading, and shadows, ACM Trans. Graph.
26(1), article 2 (2007): shadows move by the angle at which a blocker's edge is seen."""

from __future__ import annotations

# by which a light is turned either way about a point of the skin: an edge moves by a hundredth of its distance from
# what casts it, which of a dent is a part of a pixel
TURN = 0.01  # rad


def turned(integrator, world, si, light) -> list[tuple]:
    """[(direction, change per mm of whether the ends si of camera rays see the light)] of two moves across the ray to
    it, a vector and a Float in each lane; nothing carries gradients."""
    import drjit as dr
    import mitsuba as mi

    with dr.suspend_grad():
        at = light.position()
        distance = dr.norm(at - si.p)
        step, found = dr.opaque(mi.Float, TURN) * distance, []
        for side in mi.coordinate_system((at - si.p) / distance):
            on, off = (
                dr.select(integrator.visible(world, si, at + sign * step * side, light), mi.Float(1), mi.Float(0))
                for sign in (1, -1)
            )
            found.append((side, (on - off) / (2 * step)))
            dr.eval(found[-1])
    return found
