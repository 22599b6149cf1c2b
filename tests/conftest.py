"""What several test files share: Mitsuba set up once, a small sensor that shows every effect, and a few measures.

Tests cannot import one another's modules, so everything shared is a fixture. `pytest --plugin-folder DIR` adds a user's
folder of plugins, which then has to meet the same contract as those that ship."""

from __future__ import annotations

import gc
import os
import re
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

# Before numpy is imported. The matrices of the tests are small: a second thread of BLAS only waits, and takes the core
# from Dr.Jit or from the other worker (test_lattice.py: 13 s of processor time in place of 24).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

os.environ.setdefault("OPTICS_PROCESSES", "1")  # commands that tests run in this process begin no others

# What a test trusts is nobody's: the user's own list of trusted plugins is neither read nor written.
os.environ["XDG_CONFIG_HOME"] = tempfile.mkdtemp(prefix="optics-tests-config-")

import numpy as np
import pytest

LONG = 0.3  # s of processor time, of a test that may leave scenes behind
WIDTH, HEIGHT = 80, 60  # px: small enough to be quick, large enough for shadows and rims
FULL_SCALE = 255.0  # DN


def pytest_addoption(parser):
    parser.addoption("--plugin-folder", default=None, help="a further folder of plugins for the contract tests")


def pytest_configure(config):
    folder = config.getoption("--plugin-folder", default=None)
    if folder:
        from optics.scene.registry import include

        include(folder)


def is_worker():
    """Whether this process is one of several that pytest-xdist runs (`make test`)."""
    return "PYTEST_XDIST_WORKER" in os.environ


# The files that take the longest, the longest first: workers that begin with them end at about the same time.
LONGEST = (
    "test_demo",
    "test_plugins",
    "test_tactile",
    "test_calibration",
    "test_bench",
    "test_proof",
    "test_transport",
)


def pytest_collection_modifyitems(items):
    if is_worker():
        place = {name: number for number, name in enumerate(LONGEST)}
        items.sort(key=lambda item: place.get(item.path.stem, len(LONGEST)))  # stable: the others keep their order


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item, nextitem):
    """Let the scenes of a test go with it; a scene and its parts hold each other, so that nothing else does.

    Dr.Jit records the code of every part that is alive for each call of a part, whichever scene a kernel traces:
    thirteen benches alive cost test_touch_hidden.py 52 s of processor time in place of 16. To look for them takes some
    .02 s: after a test that took long, and after a file."""
    result = yield
    spent = time.process_time() - getattr(item.session, "processor_time", 0.0)
    if nextitem is None or nextitem.path != item.path or spent > LONG:
        gc.collect()
    item.session.processor_time = time.process_time()
    return result


@pytest.fixture(scope="session")
def mitsuba():
    """Mitsuba in the default variant, on an LLVM that works."""
    from optics.doctor import require_llvm

    require_llvm()  # before drjit is imported: a bad LLVM ends the process
    from optics.scene.mitsuba_parts import use_variant

    use_variant()
    import mitsuba

    if is_worker():
        import drjit

        drjit.set_thread_count(1)  # there is a worker for each core
    gc.collect()
    gc.freeze()  # modules stay: what collects later need not look at them
    return mitsuba


@pytest.fixture
def variant(mitsuba, request):
    """Another variant for one test: parametrise it indirectly; the default one comes back afterwards."""
    from optics.scene.mitsuba_parts import use_variant

    use_variant(request.param)
    yield request.param
    use_variant()


class Bench:
    """A scene as a model of one frame, at a working point where every effect can be seen.

    values      every parameter at the working point
    image       noise-free image (H, W, C), 1 = full scale, with some values replaced
    """

    def __init__(self, scene, values, flat_field=None, mode=None):
        from optics.captures.capture_set import Captures, Frame
        from optics.captures.noise import Noise
        from optics.fit.scene_model import SceneModel

        self.scene = scene
        width, height = scene.camera.resolution
        channels = 1 if len(scene.integrator.bands or ()) == 1 else 3
        frame = Frame("bench", np.zeros((height, width, channels), np.float32))
        noise = Noise(system_gain=0.1, dark_noise=1.0, black_level=0.0, saturation=FULL_SCALE, prnu=0.0)
        self.model = SceneModel(
            scene, Captures(Path("."), str(scene.path), [frame], noise=noise, flat_field=flat_field), flat_field=mode
        )
        self.renderer = self.model.renderer
        self.values = {**scene.values(), **{k: v for k, v in values.items() if k in scene.parameters}}

    def at(self, values=None):
        from optics.scene.parameter import Values

        return Values(common={**self.values, **(values or {})})

    def image(self, values=None):
        return self.model.predict(self.at(values))[0] / FULL_SCALE

    def derivative(self, key, values=None, keys=None):
        """d image / d value by the model's own means; zero where the model says that nothing depends on it."""
        from optics.scene.parameter import Variable

        variable = Variable(key, tuple(keys or (key,)), self.scene.parameters[key])
        _, images = next(iter(self.model.derivatives(self.at(values), [variable])))
        return images.get(key, np.zeros(self.model.shape)) / FULL_SCALE

    def forget(self):
        """Drop every image that the renderer keeps."""
        from optics.light.renderer import Renderer

        self.model.renderer = self.renderer = Renderer(self.scene)


# A dent off the middle, a coloured membrane, three LEDs of unequal power, one of them coloured: nothing is symmetric,
# so that no derivative vanishes by accident. The other LEDs are off to save time. Highlights reach half of full
# scale.
WORKING_POINT = {
    "gel.press_x": 1.5,
    "gel.press_y": -0.8,
    "gel.press_depth": 0.5,
    "membrane.rho_r": 0.7,
    "membrane.rho_g": 0.55,
    "membrane.rho_b": 0.4,
    "membrane.sigma": 0.3,
    "led_1.wavelength": 560.0,
    "led_1.fwhm": 150.0,
    "led_1.pan": 4.0,
    "led_1.tilt": -3.0,
    "led_1.power": 0.9,
    "led_1.power_g": 0.7,
    "led_2.power": 0.0,
    "led_3.power": 0.6,
    "led_4.power": 0.0,
    "led_5.power": 0.8,
    "led_6.power": 0.0,
    "camera.exposure": 150.0,
}


# Light comes in aslant (13 to 23 deg), passes three films and a sheet that does all that a sheet can, and no two axes
# agree. Nothing rests at neutral that an effect needs to be seen: a retardance for its dispersion, a leak for its
# slope, a clock for a drift.
FILMS = ("analyzer", "middle", "polarizer")
POLARIZER_POINT = {
    "camera.x": -40.0,
    "camera.y": -50.0,
    "camera.pan": 11.0,
    "camera.tilt": -14.0,
    "camera.exposure": 5.0,
    "analyzer.angle": 35.0,
    "middle.angle": 75.0,
    "polarizer.angle": -20.0,
    "analyzer.offset": 2.0,
    "polarizer.scale": 1.01,
    **{
        f"{film}.{name}": value
        for film in FILMS
        for name, value in (("leak", 0.01), ("approach", 0.7), ("backlash", 1.5))
    },
    "sample.transmittance": 0.8,
    "sample.transmittance_slope": 0.05,
    "sample.index": 1.3,
    "sample.angle": 20.0,
    "sample.retard_0": 40.0,
    "sample.retard_45": -25.0,
    "sample.retard_dispersion": 0.1,
    "sample.stress": 4.0,
    "sample.stress_size": 60.0,
    "sample.depolarization": 0.05,
    "sample.alpha": 0.2,
    "source.power": 0.8,
    "source.power_r": 0.9,
    "source.power_g": 1.1,
    "source.power_b": 0.7,
    "source.dop_q": 0.1,
    "source.dop_u": -0.05,
    "source.drift": 0.02,
    "source.settling": 0.3,
    "source.time": 3.0,
    "source.wavelength": 560.0,
    "source.fwhm": 150.0,
}

# A press beside the middle, under stress; the film and the object end within the view. One of the LEDs in the body is
# blue, so that the markers both glow and reflect.
FINGER_POINT = {
    "camera.exposure": 8.0,
    "analyzer.angle": 50.0,
    "film.angle": 10.0,
    "silicone.stress": 0.0133,
    "silicone.index": 1.2,
    "skin.press_x": 3.0,
    "skin.press_y": -2.0,
    "film_sheet.width": 15.0,
    "film_sheet.length": 12.0,
    "uv_left.wavelength": 440.0,
    "uv_left.fwhm": 120.0,
    "uv_left.power": 500.0,
    "uv_left.power_g": 0.8,
    "pigment.absorptance": 0.6,
    "object.x": 2.0,
    "object.y": -6.0,
    "object.length": 14.0,
    "uv_right.power": 0.0,
    "room_right.power": 0.0,
    "wall_paint.ambient": 0.3,
    "markers.pitch_x": 6.0,
    "markers.pitch_y": 6.0,
}

# Each region is polarized in another way and none along an axis of the mosaic; the film and the sheet are in.
CAMERA_POINT = {
    **{k: v for k, v in POLARIZER_POINT.items() if k.startswith(("camera.", "polarizer.", "sample."))},
    "camera.x": -58.0,  # looks aslant at the panel's middle, where its regions meet
    "camera.y": -75.0,
    "camera.exposure": 3.0,
    "panel.power": 0.8,
    "panel.power_r": 0.9,
    "panel.power_g": 1.1,
    "panel.power_b": 0.7,
    "panel.level_1": 1.4,
    "panel.level_2": 0.7,
    "panel.dop_q": 0.1,
    "panel.dop_u": -0.05,
    "panel.dop_q_1": -0.2,
    "panel.dop_u_1": 0.15,
    "panel.dop_q_2": 0.25,
    "panel.dop_u_3": 0.3,
    "panel.drift": 0.02,
    "panel.time": 3.0,
}

# A press beside the middle; the red strip nearer than it ships, white and turned: its shadows are long and soft.
MINI_POINT = {
    "gel.press_x": 1.5,
    "gel.press_y": -0.8,
    "camera.exposure": 2000.0,
    "strip_red.x": -16.0,
    "strip_red.z": -6.0,
    "strip_red.wavelength": 560.0,
    "strip_red.fwhm": 150.0,
    "strip_red.pan": 4.0,
    "strip_red.tilt": -3.0,
    "strip_red.mu": 1.2,
    "strip_red.power": 0.9,
    "strip_red.power_g": 0.7,
    "strip_red.roll": 5.0,
    "strip_green.power": 0.0,
}

# Few beads, large in view, so that most pixels hold no rim; a ring whose light reaches every band.
PARTICLE_POINT = {
    "beads.top": 1.3,
    "beads.bottom": 3.1,
    "gel.press_force": 0.05,
    "gel.press_y": -0.7,
    "gel.drag_x": 0.2,
    "gel.poisson": 0.45,
    "gel.absorption": 0.01,
    "inner_ring.wavelength": 500.0,
    "inner_ring.fwhm": 150.0,
    "inner_ring.pan": 4.0,
    "inner_ring.tilt": -3.0,
    "inner_ring.mu": 1.2,
    "inner_ring.power_g": 0.7,
    "inner_ring.roll": 5.0,
    "outer_ring.power": 0.0,
    "cover.rho_r": 0.2,
    "cover.rho_g": 0.3,
    "cover.rho_b": 0.25,
}

POINTS = {  # scene: (what replaces its <default>s, values)
    "gelsight": ({"width": WIDTH, "height": HEIGHT, "depth": 0.5}, WORKING_POINT),
    "gelsight_mini": ({"width": WIDTH, "height": HEIGHT, "depth": 0.5}, MINI_POINT),
    "polarizer_bench": (
        {"width": 8, "height": 6, "x_fov": 7, "bands": "620, 540, 460", "middle": 1, "pattern": "disc"},
        POLARIZER_POINT,
    ),
    "reflection_bench": (
        {"width": 8, "height": 6, "x_fov": 7, "bands": "620, 540, 460"},
        {
            **POLARIZER_POINT,
            "camera.exposure": 40.0,
            "plate.incidence": 50.0,
            "plate.plane": 8.0,
            "plate.scatter": 2e-3,
        },
    ),
    "polariscope": ({"width": 8, "height": 6, "x_fov": 7, "bands": "620, 540, 460"}, POLARIZER_POINT),
    "polarization_camera": (
        {"width": 8, "height": 6, "x_fov": 7, "bands": "620, 540, 460", "polarizer": 1, "sample_regions": "halves"},
        CAMERA_POINT,
    ),
    "particle_gel": (
        {"width": 48, "height": 40, "x_fov": 40, "beads": 40, "detail": 1, "diameter": 2.4, "depth": 0.4, "x": 1.0},
        PARTICLE_POINT,
    ),
    "vi2tap": ({"width": 32, "height": 24, "x_fov": 45, "depth": 1, "wall_dark": 1}, FINGER_POINT),
}
SLOT = r'<bsdf type="sheet" id="sample">.*?</bsdf>'


@pytest.fixture(scope="session")
def load_bench(mitsuba, tmp_path_factory):
    """Loads a shipped scene as a bench, small and pressed.

    slot     puts a material of this kind in the sample slot of the polarizer bench, as the part `sample`
    plugins  a further folder of plugins
    """
    from optics.scene import loader as scene

    def load(name="gelsight", slot=None, plugins=None):
        defines, values = POINTS.get(name, POINTS["gelsight"])
        text, file = scene.find(name).read_text(encoding="utf-8"), name
        if slot is not None:
            text, count = re.subn(SLOT, f'<bsdf type="{slot}" id="sample"/>', text, flags=re.S)
            assert count == 1, f"{name}.xml has no sample slot"
            file = tmp_path_factory.mktemp("scenes") / f"{name}.xml"
            file.write_text(text, encoding="utf-8")
        asked = {k: v for k, v in defines.items() if f'"${k}"' in text}
        return Bench(scene.load(file, asked, plugins=plugins), values)

    return load


@pytest.fixture(scope="module")
def benches(load_bench):
    """`load_bench`, which keeps the bench it loaded last: tests of one bench that follow each other share it.

    One alone, since Dr.Jit records the code of every part that is alive for each call of a part: with thirteen benches
    alive the contract tests took three times as long."""
    kept = {}

    def load(name, slot=None):
        if (name, slot) not in kept:
            kept.clear()
            gc.collect()  # a scene and its parts hold each other
            kept[name, slot] = load_bench(name, slot)
        return kept[name, slot]

    return load


@pytest.fixture
def bench(benches):
    """The GelSight-type sensor, 80 x 60 px; its parameters are put back afterwards."""
    found = benches("gelsight")
    yield found
    found.scene.set(found.values)


@pytest.fixture
def optics(capsys):
    """Run a command line: (exit code, stdout, stderr)."""
    from optics import cli

    def run(*arguments):
        code = cli.main([str(a) for a in arguments])
        said = capsys.readouterr()
        return code, said.out, said.err

    return run


@pytest.fixture(scope="session")
def measures():
    """How far apart two images are."""

    def largest(a, b):
        """max |a - b|."""
        return float(np.abs(np.asarray(a, float) - np.asarray(b, float)).max())

    def relative(a, b, where=True):
        """|a - b| / |b|, root of the sum of squares over the pixels `where`."""
        a, b = np.asarray(a, float), np.asarray(b, float)
        keep = np.broadcast_to(where if np.ndim(where) in (0, a.ndim) else np.asarray(where)[..., None], a.shape)
        return float(np.linalg.norm((a - b)[keep]) / max(np.linalg.norm(b[keep]), 1e-300))

    return SimpleNamespace(largest=largest, relative=relative)


@pytest.fixture
def between_films():
    """Writes 16-bit photographs of an even panel between two films: (folder, [(light in DN, settings)], lines of the
    head of captures.toml, random numbers) -> folder."""
    gain, floor, black = 4.0, 20.0, 500.0  # DN per electron, DN, DN

    def write(folder, frames, head, rng, size=(6, 6)):
        from PIL import Image

        (folder / "frames").mkdir(parents=True)
        text = [
            'scene = "polarizer_bench"',
            'absent = ["middle", "sample"]',
            f"[noise]\nsystem_gain = {gain}\ndark_noise = {floor}\nblack_level = {black}",
            "saturation = 65535\nprnu = 0.0",
            *head,
        ]
        for i, (light, settings) in enumerate(frames):
            image = black + gain * rng.poisson(light / gain, size) + floor * rng.standard_normal(size)
            name = f"frames/{i:02d}.png"
            Image.fromarray(np.round(image).astype(np.uint16)).save(folder / name)
            text += [f'[[frames]]\nimage = "{name}"\n[frames.parameters]']
            text += [f'"{key}" = {value}' for key, value in settings.items()]
        (folder / "captures.toml").write_text("\n".join(text) + "\n")
        return folder

    return write


@pytest.fixture
def at_middles(monkeypatch):
    """Images of what the middles of pixels see, which closed forms of single rays give, in place of means of pixels."""
    monkeypatch.setattr("optics.light.renderer.bend", lambda image, rim: 0 * image)
