"""A scene that nobody holds is let go, with all its parts: Dr.Jit records the code of every part that is alive for each
call of a part, so that whatever is rendered afterwards would take longer."""

from __future__ import annotations

import gc
import weakref

import pytest

from optics.files.output import shipped
from optics.light.renderer import Renderer
from optics.scene import loader

AUTO = {"bands": "auto", "sensitivity": "Nikon 5100 (NPL)"}
SCENES = sorted(p.stem for p in shipped("scenes").glob("*.xml"))


@pytest.mark.slow
@pytest.mark.parametrize("name, defines", [*((name, {}) for name in SCENES), ("gelsight", AUTO), ("vi2tap", AUTO)])
def test_parts_go_with_their_scene(mitsuba, name, defines):
    small = {} if name == "polarizer_bench" else {"width": "8", "height": "8"}
    scene = loader.load(name, {**small, **defines})
    parts = {part: weakref.ref(thing) for part, thing in scene.parts.items()}
    assert parts
    if not scene.monte_carlo:
        Renderer(scene).radiance(scene.values(), 0)
    del scene
    gc.collect()
    assert [part for part, alive in parts.items() if alive() is not None] == []
