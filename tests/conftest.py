"""What several test files share: Mitsuba set up once, a small sensor that shows every effect, and a few measures.

Tests cannot import one another's modules, so everything shared is a fixture. `pytest --plugin-folder DIR` adds a user's folder of
plugins, which then has to meet the same contract as those that ship.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

WIDTH, HEIGHT = 80, 60  # px: small enough to be quick, large enough for shadows and rims
FULL_SCALE = 255.0  # DN


def pytest_addoption(parser):
    parser.addoption("--plugin-folder", default=None, help="a further folder of plugins for the contract tests")


def pytest_configure(config):
    folder = config.getoption("--plugin-folder", default=None)
    if folder:
        from optics.effect import registry

        registry().scan(Path(folder))


@pytest.fixture(scope="session")
def mitsuba():
    """Mitsuba in the default variant, on an LLVM that works."""
    from optics.doctor import require_llvm

    require_llvm()  # before drjit is imported: a bad LLVM ends the process
    from optics.effect import use_variant

    use_variant()
    import mitsuba

    return mitsuba


@pytest.fixture
def variant(mitsuba, request):
    """Another variant for one test: parametrise it indirectly; the default one comes back afterwards."""
    from optics.effect import use_variant

    use_variant(request.param)
    yield request.param
    use_variant()


class Bench:
    """A scene as a model of one frame, at a working point where every effect can be seen.

    values      every parameter at the working point
    image       noise-free image (H, W, C), 1 = full scale, with some values replaced
    """

    def __init__(self, scene, values, flat_field=None, mode=None):
        from optics.captures import Captures, Frame
        from optics.noise import Noise
        from optics.render import Model

        self.scene = scene
        width, height = scene.camera.resolution
        frame = Frame("bench", np.zeros((height, width, 3), np.float32))
        noise = Noise(system_gain=0.1, dark_noise=1.0, black_level=0.0, saturation=FULL_SCALE, prnu=0.0)
        self.model = Model(scene, Captures(Path("."), str(scene.path), [frame], noise=noise, flat_field=flat_field), flat_field=mode)
        self.renderer = self.model.renderer
        self.values = {**scene.values(), **{k: v for k, v in values.items() if k in scene.parameters}}

    def at(self, values=None):
        from optics.parameter import Values

        return Values(common={**self.values, **(values or {})})

    def image(self, values=None):
        return self.model.predict(self.at(values))[0] / FULL_SCALE

    def derivative(self, key, values=None, keys=None):
        """d image / d value by the model's own means; zero where the model says that nothing depends on it."""
        from optics.parameter import Variable

        variable = Variable(key, tuple(keys or (key,)), self.scene.parameters[key])
        _, images = next(iter(self.model.derivatives(self.at(values), [variable])))
        return images.get(key, np.zeros(self.model.shape)) / FULL_SCALE

    def forget(self):
        """Drop every image that the renderer keeps."""
        from optics.render import Renderer

        self.model.renderer = self.renderer = Renderer(self.scene)


# A dent off the middle, a coloured membrane, three LEDs of unequal power, one of them coloured: nothing is symmetric, so that no
# derivative vanishes by chance. The other LEDs are off to save time. Highlights reach half of full scale.
WORKING_POINT = {
    "gel.press_x": 1.5, "gel.press_y": -0.8, "gel.press_depth": 0.5,
    "membrane.rho_r": 0.7, "membrane.rho_g": 0.55, "membrane.rho_b": 0.4, "membrane.sigma": 0.3,
    "led_1.wavelength": 560.0, "led_1.fwhm": 150.0, "led_1.pan": 4.0, "led_1.tilt": -3.0,
    "led_1.power": 0.9, "led_1.power_g": 0.7,
    "led_2.power": 0.0, "led_3.power": 0.6, "led_4.power": 0.0, "led_5.power": 0.8, "led_6.power": 0.0,
    "camera.exposure": 150.0,
}


@pytest.fixture(scope="session")
def benches(mitsuba):
    """Shipped scenes as benches by name, each loaded once, small and pressed."""
    from optics import scene

    loaded = {}

    def bench(name="gelsight"):
        if name not in loaded:
            defines = {"width": WIDTH, "height": HEIGHT, "depth": 0.5}
            text = scene.find(name).read_text(encoding="utf-8")
            known = {k: v for k, v in defines.items() if f'<default name="{k}"' in text}
            loaded[name] = Bench(scene.load(name, known), WORKING_POINT)
        return loaded[name]

    return bench


@pytest.fixture
def bench(benches):
    """The GelSight-type sensor, 80 x 60 px; its parameters are put back afterwards."""
    found = benches("gelsight")
    yield found
    found.scene.set(found.values)


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
