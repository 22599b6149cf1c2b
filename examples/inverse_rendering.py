"""Inverse rendering with Mitsuba and Dr.Jit alone: positions of six LEDs and the skin's reflectance from one image.

The measured image is made here, so that the answer is known, but not as the fit makes its own: from other samples, 32
times as many, and with the noise and the steps of a 12-bit camera. The powers are held, as brighter LEDs and a darker
skin look the same. Run it with `python examples/inverse_rendering.py`; docs/inverse-rendering.md explains it."""

import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_mono")
import optics  # noqa: E402
from optics.scene.loader import find  # noqa: E402

optics.register()
mi.set_log_level(mi.LogLevel.Error)
scene = mi.load_file(str(find("gelsight")), width=32, height=24, depth=0.5, optimize=False)
params, rng = mi.traverse(scene), np.random.default_rng(0)
positions, reflectance = [f"led_{k}.{axis}" for k in range(1, 7) for axis in "xyz"], "membrane.rho_r"
truth = {key: float(params[key][0]) for key in [*positions, reflectance]}

# a camera of 12 bit: the brightest pixel at 80 % of full scale, 2 DN of noise
image = np.array(mi.render(scene, spp=64, seed=1_000_000))
gain = float(0.8 * 4095 / image.max())
measured = np.clip(np.round(gain * image + rng.normal(0, 2, image.shape)), 0, 4095).astype(np.float32)

# up to 0.5 mm and 17 % away; short memories (beta), as late gradients are a hundredth of the first ones
guess = {key: truth[key] + rng.uniform(-0.5, 0.5) for key in positions} | {reflectance: 0.5}
adam = mi.ad.Adam(lr=0.15, beta_1=0.8, beta_2=0.8, params={key: mi.Float(value) for key, value in guess.items()})
for i in range(60):
    step = 0.15 * 0.95**i  # mm
    adam.set_learning_rate(dict.fromkeys(positions, step) | {reflectance: 0.2 * step})
    params.update(adam)
    rendered = gain * mi.render(scene, params, spp=2, seed=2 * i, seed_grad=2 * i + 1)
    dr.backward(dr.mean(dr.square(rendered - mi.TensorXf(measured)), axis=None))
    adam.step()

found = {key: float(adam[key][0]) for key in truth}
for key in truth:
    print(f"{key:16} true {truth[key]:7.3f}   start {guess[key]:7.3f}   found {found[key]:7.3f}")
