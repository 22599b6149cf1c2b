"""Speed, measured beside stock Mitsuba in one run: `make bench`, or a part of it: `make bench ARGS=spectra`. Prints
ratios; judges nothing.

new press    geometry, hits, shadows and images of six LEDs, 320 x 240
taxim        a new press by the package of that name, where it is installed with jax (a table of a sensor's shades and a
             table of shadows, no LED apart), and ours, both 640 x 480
derivatives  all derivative images of 30 parameters, in units of the primal
render       the same scene by `tactile` and by stock `path`: time x variance, which is time at equal noise
prediction   the images of six LEDs against `path` with as many samples as its noise needs to fall to their error
spectra      a new press in auto bands over the same in the scene's fixed ones, in turns; processor time. A floor and
             a wall under a white LED by auto bands and by stock `path` with wavelengths by Monte Carlo: time at equal
             noise
ranking      every effect scored on 16 frames of 160 x 120, presses solved for as well
workers      a batch by two worker processes and by one, beside what two processes of the machine do at all: plain
             loops, and sums over arrays that no cache holds
cuda         the new press and the ranking on an NVIDIA device, where there is one; on the processor: press, ranking
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
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


GRID = """<scene version="3.0.0">
    MEDIA
    INTEGRATOR
    <sensor type="camera" id="camera">
        <film type="hdrfilm"><integer name="width" value="WIDTH"/><integer name="height" value="HEIGHT"/><rfilter type="box"/></film>
        <float name="x_fov" value="41"/>
        <transform name="to_world"><translate z="-22"/></transform>
    </sensor>
    <shape type="cube" id="block"><transform name="to_world"><scale x="8.2" y="8.2" z="2.75"/><translate z="-2.75"/></transform>WALLS</shape>
    <shape type="cells" id="grid">
        <integer name="columns" value="20"/><integer name="rows" value="20"/><integer name="layers" value="6"/>FILLING
    </shape>
    <shape type="rectangle" id="card">
        <transform name="to_world"><rotate x="1" angle="180"/><scale x="12" y="12"/><translate z="0.5"/></transform>
        <bsdf type="diffuse"><spectrum name="reflectance" value="0.6"/></bsdf>
    </shape>
    LAMPS
</scene>"""  # noqa: E501
SIDES = ((-8.7, 0.0), (8.7, 0.0), (0.0, 8.7))


def lamps(emitter: str) -> str:
    return "\n".join(
        f'<shape type="rectangle" id="panel_{k}"><transform name="to_world"><scale x="6" y="2"/><lookat origin="{x}, '
        f'{y}, -2.5" '
        'target="0, 0, -2.5" up="0, 0, 1"/></transform><bsdf type="diffuse"><spectrum name="reflectance" '
        'value="0"/></bsdf>'
        f"{emitter.format(k)}</shape>"
        for k, (x, y) in enumerate(SIDES)
    )


def printed_grid() -> None:
    """20 x 20 x 6 cells that absorb, lit by three panels: ours against stock `volpath`, and the time to 5 % noise."""
    from optics.light.transport import Transport
    from optics.scene import loader as scenes

    ours = {
        "MEDIA": "",
        "INTEGRATOR": '<integrator type="tactile" id="integrator"><string name="bands" value="540"/></integrator>',
        "WALLS": '<bsdf type="clear" id="walls"><float name="index" value="1.5"/><float name="absorption" '
        'value="0.05"/></bsdf>',
        "FILLING": '<bsdf type="clear" id="filling"><string name="outside" value="walls"/><float name="index" '
        'value="1.4"/>'
        '<float name="absorption" value="0.1"/></bsdf>',
        "LAMPS": lamps('<emitter type="source" id="lamp_{}"/>'),
    }
    medium = (
        '<medium type="homogeneous" id="{}"><spectrum name="sigma_t" value="{}"/>'
        '<spectrum name="albedo" value="0"/></medium>'
    )
    glass = '<bsdf type="dielectric"><float name="int_ior" value="{}"/><float name="ext_ior" value="{}"/></bsdf>'
    stock = {
        "MEDIA": medium.format("resin", 0.05) + medium.format("support", 0.1),
        "INTEGRATOR": '<integrator type="volpath"><integer name="max_depth" value="512"/><integer name="rr_depth" '
        'value="1000"/></integrator>',
        "WALLS": glass.format(1.5, 1.0) + '<ref id="resin" name="interior"/>',
        "FILLING": glass.format(1.4, 1.5) + '<ref id="support" name="interior"/><ref id="resin" name="exterior"/>',
        "LAMPS": lamps('<emitter type="area"><spectrum name="radiance" value="1"/></emitter>'),
    }

    def text(slots, width, height):
        found = GRID.replace("WIDTH", str(width)).replace("HEIGHT", str(height))
        for slot, own in slots.items():
            found = found.replace(slot, own)
        return found

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "grid.xml"
        file.write_text(text(ours, 80, 60))
        transport = Transport(scenes.load(file, variant="llvm_ad_mono_polarized"))
        import mitsuba as mi

        seeds = iter(range(10**6))
        start = time.perf_counter()
        images = [transport.take(rays=256, packets=100_000, seed=next(seeds)) for _ in range(2)]
        cost = (time.perf_counter() - start) / 2
        level = images[0].radiance.sum(0).mean()
        variance = float(np.mean([(p.error**2).sum(0).mean() for p in images]))
        file.write_text(text(stock, 80, 60))
        theirs = mi.load_file(str(file), optimize=False)
        np.array(mi.render(theirs, spp=1, seed=0))
        start = time.perf_counter()
        images = [np.array(mi.render(theirs, spp=64, seed=next(seeds)))[..., 0] for _ in range(6)]
        cost_stock = (time.perf_counter() - start) / 6
        variance_stock = float(np.mean(np.var(images, 0, ddof=1)))
        row(
            "printed grid, stock volpath, 80x60, 64 samples",
            f"{cost_stock:.1f} s",
            f"noise {variance_stock**0.5 / np.mean(images):.0%} a pixel",
        )
        row("printed grid, ours, three lights apart", f"{cost:.1f} s", f"noise {variance**0.5 / level:.0%} a pixel")
        row(
            "ours / stock volpath at equal noise",
            f"{cost * variance / (cost_stock * variance_stock):.2g} x",
            f"time x variance; target 0.1; means differ by {level / np.mean(images) - 1:+.1%}",
        )

        file.write_text(text(ours, 160, 120))
        transport = Transport(scenes.load(file, variant="llvm_ad_mono_polarized"))
        start = time.perf_counter()
        image = transport.take(rays=256, packets=1_500_000)
        cost = time.perf_counter() - start
        image, error = image.radiance.sum(0), (image.error**2).sum(0) ** 0.5
        row(
            "20x20x6 cells, 160x120",
            f"{cost:.0f} s",
            f"noise {np.median(error / np.maximum(image, 1e-12)):.1%} in the median pixel, "
            f"{(error**2).mean() ** 0.5 / image.mean():.0%} rms; target 5 % below 60 s",
        )


def new_press(width: int, height: int):
    """(renderer of gelsight, values, function that makes the six LEDs' images of a press that is new each time)."""
    from optics.light.renderer import Renderer
    from optics.scene import loader as scenes

    scene = scenes.load("gelsight", {"width": str(width), "height": str(height), "depth": "0.6"})
    renderer, values = Renderer(scene), scene.values()
    depth = iter(np.linspace(0.4, 0.8, 400))

    def press():
        now = {**values, "gel.press_depth": float(next(depth))}
        renderer.together = set(scene.leds)
        return sum(renderer.led(now, led).radiance for led in scene.leds)

    return renderer, values, press


def beside_taxim() -> None:
    """A press by the package `taxim` and by ours: a ball of 4 mm, pressed 0.6 mm deep."""
    from importlib.metadata import version
    from importlib.util import find_spec

    if not (find_spec("taxim") and find_spec("jax")):
        row("taxim", "not installed", "pip install taxim[jax-cpu], to measure it beside ours")
        return
    from taxim import Taxim

    taxim = Taxim(backend="jax", device="cpu")
    height, width = 480, 640
    mm = 0.0295  # per pixel, of its calibration
    y, x = np.mgrid[:height, :width]
    r2 = ((x - width / 2) ** 2 + (y - height / 2) ** 2) * mm**2
    ball = (4.0 - np.sqrt(np.maximum(16.0 - r2, 0.0))).astype(np.float32)  # above its lowest point
    map_ = taxim.convert_height_map(ball)
    for shadow in (False, True):
        cost = timed(
            lambda: taxim.render_direct(map_, with_shadow=shadow, press_depth=0.6).block_until_ready(),  # noqa: B023
            5,
        )
        row(
            f"taxim {version('taxim')}, jax, {width}x{height}",
            f"{cost * 1e3:.0f} ms",
            f"with{'' if shadow else 'out'} shadows; one image of all lights together",
        )
    _, _, press = new_press(width, height)
    row(f"new press, six LEDs, {width}x{height} (ours)", f"{timed(press, 5) * 1e3:.0f} ms", "shadows; an image per LED")


def against_stock(renderer, now: dict, ours: float) -> None:
    """The integrator `tactile` and our images against stock `path`: the time to the same error.

    now   values of the scene, as for `renderer`;   ours  s that the six images of a new press take
    """
    import mitsuba as mi

    from optics.scene import loader as scenes
    from optics.scene.mitsuba_parts import use_variant

    scene = renderer.scene
    stock = scenes.load(
        "gelsight", {"width": "320", "height": "240", "depth": "0.61"}, variant="llvm_ad_mono_polarized"
    )
    bounces = {"max_depth": 3, "rr_depth": 100}  # `path` counts the window
    cost, variance = {}, {}
    for name, integrator in (
        ("tactile", stock.mitsuba.integrator()),
        ("path", mi.load_dict({"type": "path", **bounces})),
    ):
        seeds = iter(range(10**6))
        images = [
            np.array(mi.render(stock.mitsuba, integrator=integrator, spp=16, seed=next(seeds)))[..., 0]
            for _ in range(8)
        ]
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
    many = [
        np.array(mi.render(stock.mitsuba, integrator=stock.mitsuba.integrator(), spp=512, seed=10**6 + k))[..., 0]
        for k in range(4)
    ]
    own = float(np.mean(np.var(many, 0, ddof=1))) / len(many)
    error = max(float(np.mean((ours_image - np.mean(many, 0)) ** 2)) - own, own)
    needed = 16 * variance["path"] / error
    row(
        "ours / stock path at equal error",
        f"{ours / (cost['path'] * needed / 16):.2g} x",
        f"path needs {needed:.3g} samples for our rms error of {error**0.5:.1e}; its time extrapolated from 16",
    )


NIKON = "Nikon 5100 (NPL)"
SPECTRAL = {  # scene: what the image is taken of, the parameter that changes from lap to lap, and the target
    "gelsight": ({"width": "320", "height": "240"}, "gel.press_depth", 1.5),
    "digit": ({}, "gel.press_depth", 1.5),
    "vi2tap": ({"analyzer": "90"}, "skin.press_depth", 2.5),
}


def spectral_cost(name: str, laps: int = 7) -> tuple[float, float, int]:
    """Processor seconds of an image in fixed bands and in auto bands, medians of laps in turns, each at another depth
    of the press; and the number of auto bands. The camera is the same."""
    from optics.light.rendering import RenderJob
    from optics.scene import loader as scenes

    defines, key, _ = SPECTRAL[name]
    loaded = [scenes.load(name, {**defines, "sensitivity": NIKON, **more}) for more in ({}, {"bands": "auto"})]
    jobs = [RenderJob(scene) for scene in loaded]
    spent: tuple[list[float], list[float]] = ([], [])
    for lap in range(laps + 2):
        for job, own in zip(jobs, spent):
            start = time.process_time()
            job.take({key: 0.4 + 0.03 * lap})
            if lap >= 2:  # the first two compile kernels, and fill what is kept
                own.append(time.process_time() - start)
    return median(spent[0]), median(spent[1]), len(loaded[1].integral.nm)


def spectral_noise(max_depth: int, passes: int = 32, spp: int = 256) -> tuple[float, float, float, float]:
    """Of channels as integrals (optics.proof.makers.white): s of our image, loading and tracing included; s of stock
    `path`, in the variant `llvm_ad_spectral_polarized`, to the same error; that error, rms; the images' mean.

    The error is that against the mean of the passes, less the noise of that mean, plus three of its standard
    deviations: what ours is at most, so that the time of `path` is what it takes at least."""
    from optics.proof.makers import white

    with tempfile.TemporaryDirectory() as folder:
        scene, warm = white.by_nodes(Path(folder), max_depth, "auto")
        stock = white.by_wavelengths(scene.integral.unit, max_depth)
        warm(), stock(spp, 0)  # kernels are compiled
        start = time.perf_counter()
        image = white.by_nodes(Path(folder), max_depth, "auto")[1]()
        ours = time.perf_counter() - start
    start = time.perf_counter()
    images = np.array([stock(spp, 1 + k) for k in range(passes)])
    spent = (time.perf_counter() - start) / passes
    variance = images.var(0, ddof=1)
    own = variance / passes
    excess = float(((image - images.mean(0)) ** 2 - own).mean())
    sd = float(np.sqrt((2 * own**2 * (1 + 1 / (passes - 1))).sum()) / own.size)  # of noise alone
    error = max(excess, 0.0) + 3 * sd
    return ours, spent * float(variance.mean()) / error, error**0.5, float(images.mean())


def spectra() -> None:
    for max_depth in (2, 3):
        ours, stock, error, level = spectral_noise(max_depth)
        row(
            f"white LED, {'direct light' if max_depth == 2 else 'two bounces'}: ours / stock path",
            f"{ours / stock:.2g} x",
            f"{ours:.2f} s; path at least {stock:.3g} s to our error, at most {error / level:.1e}; target below 1",
        )
    for name, (_, _, target) in SPECTRAL.items():
        fixed, auto, bands = spectral_cost(name)
        row(
            f"{name}: auto bands / fixed bands",
            f"{auto / fixed:.2f} x",
            f"{1e3 * auto:.0f} ms with {bands} bands, {1e3 * fixed:.0f} ms fixed; target below {target} x",
        )


def ranking() -> None:
    """The time in which a diagnosis ranks all effects that gelsight can express."""
    from optics.captures import capture_set as files
    from optics.diagnosis import diagnose as diagnosis
    from optics.proof import demo
    from optics.proof.makers import touch as synthetic
    from optics.scene import loader as scenes
    from optics.scene.parameter import Values
    from optics.study import loop

    with tempfile.TemporaryDirectory() as folder:
        small = scenes.load("gelsight", {"width": "160", "height": "120"})
        made = synthetic.Maker(small, demo.truth(small, 1), {}, seed=1).captures(
            synthetic.presses(4, 1), drives=[{led: 1.0} for led in list(small.leds)[:4]]
        )
        files.write(made, Path(folder) / "captures", bits=8)
        setup = loop.Setup(captures=str(Path(folder) / "captures"), held_out=[])
        model = loop.open_model(setup)
        fit = loop.fit_base(
            model, loop.variables_of_base(model, setup, range(16)), list(range(16)), Values(demo.truth(small, 1))
        )
        effects = [e for e in model.scene.registry.effects.values() if model.scene.can_express(e)]
        start = time.perf_counter()
        found = diagnosis.diagnose(
            model, fit, effects, lambda e: loop.effect_variables(model, e), fitted=list(range(16)), top=0
        )
        row(
            f"ranking {len(effects)} effects, 16 frames 160x120",
            f"{time.perf_counter() - start:.0f} s",
            f"{len(fit.variables)} parameters in the base; first: {found.rows[0].name}; target below 60 s",
        )


def press_of_ours():
    """What `new_press` gives, and the s that its images take."""
    renderer, values, press = new_press(320, 240)
    ours = timed(press, 9)
    row("new press, six LEDs, 320x240 (ours)", f"{ours * 1e3:.0f} ms", "target 66 ms on two quiet cores")
    cpu = time.process_time()
    press()
    row("the same, of a processor", f"{(time.process_time() - cpu) * 1e3:.0f} ms")
    return renderer, values, press, ours


def cuda() -> None:
    """In a process of its own, as the variant of all parts is chosen when it starts."""
    from optics.scene.mitsuba_parts import VARIABLE

    variant = "cuda_ad_spectral_polarized"
    print(variant, flush=True)
    command = [sys.executable, "-m", "optics.proof.speed", "press", "ranking"]
    done = subprocess.run(command, env={**os.environ, VARIABLE: variant}, stderr=subprocess.PIPE, text=True)
    if done.returncode:
        row("not measured", "", (done.stderr.strip().splitlines() or ["no reason given"])[-1])


def presses() -> None:
    renderer, values, press, ours = press_of_ours()
    scene = renderer.scene
    beside_taxim()

    now = {**values, "gel.press_depth": 0.61}
    keys = [f"{led}.{n}" for led in scene.leds for n in ("x", "y", "z", "mu", "pan")][:30]
    lit = timed(press, 5)
    [renderer.led(now, led) for led in scene.leds]
    derivatives = timed(lambda: [renderer.led_tangent(now, k.split(".")[0], k) for k in keys], 3)
    row("30 derivative images", f"{derivatives / lit:.1f} x primal", "target below 30 x")

    against_stock(renderer, now, ours)


BATCH = """scene = "gelsight"
out = "images"
count = COUNT
outputs = ["exr", "dn"]
layers = ["spectral"]
[defines]
width = 96
height = 72
[sample]
"gel.press_x" = { uniform = [-3, 3] }
"gel.press_y" = { uniform = [-3, 3] }
"gel.press_depth" = { log_uniform = [0.1, 1] }
[noise]
system_gain = 0.05
dark_noise = 1.0
black_level = 2.0
saturation = 255.0
prnu = 0.01
"""
PLAIN = {
    "loops": "n = 0\nfor i in range(20_000_000): n += i * i",
    "sums over arrays": "import numpy\na = numpy.zeros(20_000_000)\nfor i in range(60): a += 1.0",
}


def batch_times(count: int, workers: int) -> tuple[float, float]:
    """Images per second between a tenth and nine tenths of a batch, and seconds of the whole command."""
    with tempfile.TemporaryDirectory() as folder:
        job = Path(folder) / "job.toml"
        job.write_text(BATCH.replace("COUNT", str(count)))
        start = time.perf_counter()
        command = [sys.executable, "-m", "optics.cli", "batch", str(job), "--workers", str(workers), "--quiet"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        whole = time.perf_counter() - start
        ends = sorted(file.stat().st_mtime for file in (Path(folder) / "images/images").glob("*.exr"))
    first, last = count // 10, count - count // 10 - 1
    return (last - first) / (ends[last] - ends[first]), whole


def side_by_side(code: str, processes: int) -> float:
    """Seconds until so many processes have each run the code once, with one thread each."""
    one_thread = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    start = time.perf_counter()
    running = [subprocess.Popen([sys.executable, "-c", code], env=one_thread) for _ in range(processes)]
    for process in running:
        process.wait()
    return time.perf_counter() - start


def workers(count: int = 300) -> None:
    (one, alone), (two, both) = (batch_times(count, n) for n in (1, 2))
    row(
        "two workers / one, GelSight 96 x 72",
        f"{two / one:.2f} x",
        f"{two:.1f} and {one:.1f} images/s; {alone / both:.2f} x with starts, {count} images; target 1.9 x",
    )
    for name, code in PLAIN.items():
        laps = [[side_by_side(code, n) for n in (1, 2)] for _ in range(3)]
        most = median(2 * alone / both for alone, both in laps)
        row(f"  two processes / one of this machine, {name}", f"{most:.2f} x")


PARTS = {
    "presses": presses,
    "grid": printed_grid,
    "spectra": spectra,
    "ranking": ranking,
    "workers": workers,
    "cuda": cuda,
}
ALONE = {"press": press_of_ours}  # the first lines of `presses` by themselves


def main(names: Sequence[str]) -> int:
    """Measure the named parts; none named: all."""
    parts = {**PARTS, **ALONE}
    if unknown := set(names) - set(parts):
        print(f"no part {', '.join(sorted(unknown))}; there are {', '.join(parts)}", file=sys.stderr)
        return 2
    from optics.scene.mitsuba_parts import use_variant

    for name in names or PARTS:
        use_variant()  # a part may leave another
        parts[name]()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
