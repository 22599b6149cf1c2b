"""Inverse rendering with Mitsuba and Dr.Jit alone: positions of six LEDs and the skin's reflectance, from one image.

The image is rendered here at other samples than the fit sees, with the noise of a 12-bit camera, so the answer is known.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_mono")
import optics  # noqa: E402

optics.register()


def load(spp: int):
    scene = mi.load_file(str(optics.shipped("scenes") / "gelsight.xml"), width=32, height=24, depth=0.5, optimize=False)
    return scene, mi.traverse(scene)
