"""Speed, measured beside stock Mitsuba in one run: `make bench`. Prints ratios; judges nothing.

    new press    geometry, hits, shadows and images of six LEDs, 320 x 240
    derivatives  all derivative images of 30 parameters, in units of the primal
    render       the same scene by `tactile` and by stock `path`: time x variance, which is time at equal noise
    prediction   the images of six LEDs against `path` with as many samples as its noise needs to fall to their error
    ranking      every effect scored on 16 frames of 160 x 120, presses solved for as well
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
    from optics import scene as scenes
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

    stock = scenes.load("gelsight", {"width": "320", "height": "240", "depth": "0.61"}, variant="llvm_ad_mono_polarized")
    import mitsuba as mi

    bounces = {"max_depth": 3, "rr_depth": 100}  # `path` counts the window
    cost, variance = {}, {}
    for name, integrator in (("tactile", stock.mitsuba.integrator()), ("path", mi.load_dict({"type": "path", **bounces}))):
        seeds = iter(range(10**6))
        images = [np.array(mi.render(stock.mitsuba, integrator=integrator, spp=16, seed=next(seeds)))[..., 0] for _ in range(8)]
        variance[name] = float(np.mean(np.var(images, 0, ddof=1)))
        cost[name] = timed(lambda: np.array(mi.render(stock.mitsuba, integrator=integrator, spp=16, seed=next(seeds))))  # noqa: B023
        row(f"{name}, 16 samples per pixel", f"{cost[name] * 1e3:.0f} ms", f"variance {variance[name]:.3g}")
    ratio = cost["tactile"] * variance["tactile"] / (cost["path"] * variance["path"])
    row("tactile / stock path at equal noise", f"{ratio:.2g} x", "time x variance; below 1 is faster; target 1")

    # Our error: against many samples of `tactile`, less their own noise.
    use_variant("llvm_ad_spectral_polarized")
    level = scene.values()["membrane.rho_r"] / stock.values()["membrane.rho_r"]
    ours_image = sum(renderer.led(now, led).radiance for led in scene.leds)[..., 0] / level
    use_variant("llvm_ad_mono_polarized")
    many = [np.array(mi.render(stock.mitsuba, integrator=stock.mitsuba.integrator(), spp=512, seed=10**6 + k))[..., 0]
            for k in range(4)]
    own = float(np.mean(np.var(many, 0, ddof=1))) / len(many)
    error = max(float(np.mean((ours_image - np.mean(many, 0)) ** 2)) - own, own)
    needed = 16 * variance["path"] / error
    row("ours / stock path at equal error", f"{ours / (cost['path'] * needed / 16):.2g} x",
        f"path needs {needed:.3g} samples for our rms error of {error**0.5:.1e}; its time extrapolated from 16")
    use_variant("llvm_ad_spectral_polarized")

    from optics import captures as files, demo, diagnose as diagnosis, loop, synthetic
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
        row(f"ranking {len(effects)} effects, 16 frames 160x120", f"{time.perf_counter() - start:.0f} s",
            f"{len(fit.variables)} parameters in the base; target below 60 s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
