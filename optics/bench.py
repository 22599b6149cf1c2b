"""Speed, measured beside stock Mitsuba in one run: `make bench`. Prints ratios; judges nothing.

    render       six LEDs with shadows, 320 x 240, at equal noise: ours against `path` (more samples until the noise agrees)
    new press    geometry, hits, shadows and images of six LEDs
    derivatives  all derivative images of 30 parameters, in units of the primal
    ranking      every effect scored on 16 frames of 160 x 120
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import numpy as np


def timed(function, repeats: int = 5) -> float:
    """Median wall-clock seconds of a function, after one call that warms caches and kernels."""
    function()
    laps = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        laps.append(time.perf_counter() - start)
    return median(laps)


def row(name: str, value: str, note: str = "") -> None:
    print(f"{name:<44}{value:>16}   {note}", flush=True)


def main() -> int:
    from optics import scene as scenes, synthetic
    from optics.effect import use_variant
    from optics.render import Renderer

    scene = scenes.load("gelsight", {"width": "320", "height": "240", "depth": "0.6"})
    renderer = Renderer(scene)
    values = scene.values()
    depth = iter(np.linspace(0.4, 0.8, 400))

    def press():
        now = {**values, "gel.press_depth": float(next(depth))}
        renderer.together = set(scene.leds)
        return sum(renderer.led(now, led).radiance for led in scene.leds)

    ours = timed(press, 9)
    row("new press, six LEDs, 320x240 (ours)", f"{ours * 1e3:.0f} ms", "target below 200 ms")

    now = {**values, "gel.press_depth": 0.61}
    keys = [f"{led}.{n}" for led in scene.leds for n in ("x", "y", "z", "mu", "pan")][:30]
    lit = timed(press, 5)
    [renderer.led(now, led) for led in scene.leds]
    derivatives = timed(lambda: [renderer.led_tangent(now, k.split(".")[0], k) for k in keys], 3)
    row("30 derivative images", f"{derivatives / lit:.1f} x primal", "target below 30 x")

    ours_image = sum(renderer.led(now, led).radiance for led in scene.leds)[..., 0] / np.array(scene.values()["membrane.rho_r"])
    use_variant("llvm_ad_mono")
    import mitsuba as mi

    maker = synthetic.Maker(scene, now, seed=1)
    mesh = maker.mesh((0.0, 0.0, 0.61), pitch=0.06)
    content = {"type": "scene", "integrator": {"type": "path", "max_depth": 2}, "sensor": maker.sensor(), "face": mesh}
    content["sensor"]["sampler"] = {"type": "independent"}
    for led in scene.leds:
        content[led] = maker.emitter(led)
    stock = mi.load_dict(content, optimize=False)
    reference = np.mean([np.array(mi.render(stock, spp=256, seed=100 + k))[..., 0] for k in range(8)], 0)
    error = float(np.sqrt(np.mean((ours_image - reference) ** 2)))
    spp, noise = 4, np.inf
    while spp <= 4096:
        image = np.array(mi.render(stock, spp=spp, seed=7))[..., 0]
        noise = float(np.sqrt(np.mean((image - reference) ** 2)))
        if noise <= error:
            break
        spp *= 2
    path = timed(lambda: np.array(mi.render(stock, spp=min(spp, 4096), seed=8)), 3)
    row("stock path at our error, same scene", f"{path * 1e3:.0f} ms", f"{spp} spp, rms {noise:.2e} against {error:.2e}")
    warm = timed(lambda: (renderer._images.clear(), renderer._hits.clear(), use_variant("llvm_ad_spectral_polarized"),
                          [renderer.led(now, led) for led in scene.leds]), 3)
    row("ours / stock path at equal error", f"{warm / path:.2f} x", "below 1 is faster; ours gives six LEDs apart, three bands")

    from optics import captures as files, demo, diagnose as diagnosis, loop
    from optics.parameter import Values

    with tempfile.TemporaryDirectory() as folder:
        small = scenes.load("gelsight", {"width": "160", "height": "120"})
        made = synthetic.Maker(small, demo.truth(small, 1), {}, seed=1).captures(
            synthetic.presses(4, 1), drives=[{led: 1.0} for led in list(small.leds)[:4]])
        files.write(made, Path(folder) / "captures", bits=8)
        setup = loop.Setup(captures=str(Path(folder) / "captures"), held_out=[])
        model = loop.open_model(setup)
        fit = loop.fit_base(model, loop.variables_of_base(model, setup, range(16)), list(range(16)),
                            Values(demo.truth(small, 1)))
        from optics.effect import registry

        effects = [e for e in registry().effects.values() if model.scene.can_express(e)]
        start = time.perf_counter()
        diagnosis.diagnose(model, fit, effects, lambda e: loop.effect_variables(model, e), fitted=list(range(16)), top=0)
        row(f"ranking {len(effects)} effects, 16 frames 160x120", f"{time.perf_counter() - start:.0f} s", "target below 60 s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
