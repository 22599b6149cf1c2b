"""No ray slips through the pressed face where two of its triangles meet: such a sample would be black, and images would
jump as the press moves by less than a micrometre."""

from __future__ import annotations

import numpy as np

from optics.light.renderer import Renderer
from optics.scene import loader

RAYS = 1_000_000  # of which Embree's fast test loses four


def test_every_ray_into_the_middle_of_the_view_meets_the_face(mitsuba):
    renderer = Renderer(loader.load("gelsight_bench", {"width": "153", "height": "128"}))
    renderer.apply(renderer.scene.values() | {renderer.scene.key(renderer.scene.gel.name, "press depth"): 0.2})
    places = np.random.default_rng(0).uniform([[2.0], [2.0]], [[151.0], [126.0]], (2, RAYS)).astype(np.float32)
    hits = renderer._trace(*places).si
    assert int((~np.array(hits.is_valid())).sum()) == 0
