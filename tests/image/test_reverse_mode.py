"""Derivatives through `mi.render`: reverse mode against forward mode and against central differences.

Each scene is rendered small, at a working point where every parameter acts. One reverse pass gives the derivative of a
weighted sum of the image by all parameters at once. Forward mode, along random directions of all parameters, must give
the same sum; central differences of images with the same samples must give it parameter by parameter. Pixels that an
edge crosses within the step are left out: Dr.Jit does not see edges move."""

from __future__ import annotations

import numpy as np
import pytest

SAMPLES, SEED = 2, 1  # per pixel; the random numbers that image and derivatives share
STEP = 0.02  # of the plausible size of a parameter, to either side
# of a principal point: with 0.02 the rays move by the width of a facet of the skin, across which normals bend (6 % off)
STEP_PX = 0.005
# of a difference: the image's curvature within the step leaves 0.1 to 0.5 %, most for LED lobes and distances
NEAR = 0.01
FLOAT = (
    1e-6  # of the weighted image: what rounding of float32 images leaves in a difference of two, before the division
)
SUMS = 1e-4  # forward against reverse: the same terms, added in float32 in another order
CURVED = 0.2  # of the median change: second difference of a pixel that an edge crosses

SCENES = {  # what replaces <default>s, surfaces of a path, parts that are looked at one parameter at a time
    "gelsight": ({"width": 16, "height": 12, "depth": 0.5}, 3, ("led_1", "membrane", "gel", "integrator", "camera")),
    "digit": ({"width": 12, "height": 16, "depth": 0.3}, 2, ("led_red",)),
    "gelsight_mini": ({"width": 16, "height": 12}, 2, ("strip_red",)),
    "vi2tap": (
        {"width": 16, "height": 12, "x_fov": 45, "depth": 1, "wall_dark": 1},
        2,
        ("uv_left", "pigment", "film", "silicone"),
    ),
    "polarizer_bench": (
        {"width": 8, "height": 6, "x_fov": 7, "bands": "620, 540, 460", "middle": 1, "pattern": "disc"},
        2,
        ("analyzer", "sample", "source", "camera"),
    ),
    "grid_bench": ({"width": 12, "height": 9, "filling": 1.4}, 40, ("walls", "filling")),
}


class Plain:
    """A shipped scene in plain Mitsuba: its parameters by their paths, all of them away from neutral and from bounds.

    numbers   path -> (part, declaration) of what `mi.render` has derivatives by;   refused   of all others
    """

    def __init__(self, name, values):
        import drjit as dr
        import mitsuba as mi

        from optics.scene import loader
        from optics.scene.mitsuba_parts import is_part

        defines, depth, self.single = SCENES[name]
        scene = loader.load(name, defines)
        scene.set({k: v for k, v in values.items() if k in scene.parameters})
        scene.integrator.max_depth = depth
        self.scene, self.params = scene.mitsuba, mi.traverse(scene.mitsuba)
        self.numbers, self.refused = {}, {}
        for path, (_, _, node, _) in self.params.properties.items():
            key = path.rsplit(".", 1)[-1]
            if is_part(node) and key in node.numbers:
                (self.numbers if node.rendered(key) else self.refused)[path] = (node, node.numbers[key])
        for path, (part, p) in self.numbers.items():
            value = part.number(p.name)
            if value == p.neutral or value in p.bounds:
                away = p.plausible if value + p.plausible <= p.bounds[1] else -p.plausible
                self.params[path] = dr.opaque(mi.Float, value + away)
        self.params.update()
        self.size = {path: p.plausible for path, (_, p) in self.numbers.items()}
        self.at = {path: part.number(p.name) for path, (part, p) in self.numbers.items()}
        image = self.image()
        scale = np.abs(image).mean((0, 1))
        weights = np.random.default_rng(2).uniform(0.5, 1.5, image.shape)
        self.base, self.weights = image, np.where(scale > 1e-6 * scale.max(), weights / np.maximum(scale, 1e-30), 0.0)
        self.bright = np.abs(image * self.weights).max()

    def image(self, steps=None):
        """The image with some parameters moved, in plausible sizes."""
        import drjit as dr
        import mitsuba as mi

        for path, step in (steps or {}).items():
            self.params[path] = dr.opaque(mi.Float, self.at[path] + step * self.size[path])
        self.params.update()
        found = np.array(mi.render(self.scene, self.params, spp=SAMPLES, seed=SEED), float)
        for path in steps or {}:
            self.params[path] = dr.opaque(mi.Float, self.at[path])
        self.params.update()
        return found

    def difference(self, steps):
        """Central difference of the image along `steps`; and the pixels that no edge crosses."""
        step = STEP_PX if any(self.numbers[k][1].unit == "px" for k in steps) else STEP
        up, down = (self.image({k: s * step * v for k, v in steps.items()}) for s in (1, -1))
        change, curve = (np.abs(d * self.weights).max(-1) for d in (up - down, up + down - 2 * self.base))
        return (up - down) / (2 * step), curve <= CURVED * np.median(change) + FLOAT * self.bright

    def attached(self):
        """All parameters, with derivatives; mi.render takes the same samples as `image` for them."""
        import drjit as dr
        import mitsuba as mi

        found = {}
        for path in self.numbers:
            found[path] = dr.opaque(mi.Float, self.at[path])
            dr.enable_grad(found[path])
            self.params[path] = found[path]
        self.params.update()
        return found, lambda: mi.render(self.scene, self.params, spp=SAMPLES, seed=SEED + 1, seed_grad=SEED)

    def reverse(self, weights):
        """Derivative of the weighted sum of the image by each parameter, per plausible size."""
        import drjit as dr
        import mitsuba as mi

        found, render = self.attached()
        dr.backward(dr.sum(render() * mi.TensorXf(weights.astype(np.float32)), axis=None))
        return {path: float(dr.grad(value)[0]) * self.size[path] for path, value in found.items()}

    def forward(self, weights, steps):
        """Derivative of the weighted sum along a direction."""
        import drjit as dr

        found, render = self.attached()
        for path, value in found.items():
            dr.set_grad(value, steps[path] * self.size[path])
        image = render()
        dr.forward_to(image)
        return float((np.array(dr.grad(image), float) * weights).sum())


@pytest.fixture(scope="module")
def plain(benches):
    known = {}

    def load(name):
        if name not in known:
            points = name if name in ("gelsight", "vi2tap", "polarizer_bench") else None
            known[name] = Plain(name, benches(points).values if points else {})
        return known[name]

    return load


# Most of them compile for half a minute and more where Dr.Jit's cache of kernels is empty: among the slow tests.
LONG = ("gelsight", "gelsight_mini", "digit", "polarizer_bench", "vi2tap", "grid_bench")


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in LONG else n for n in SCENES])
def test_reverse_mode_is_forward_mode_and_differences(name, plain):
    scene = plain(name)
    single = [path for path, (part, _) in scene.numbers.items() if part.name in scene.single]
    assert single
    differences, smooth = {}, np.ones(scene.base.shape[:2], bool)
    for path in single:
        differences[path], whole = scene.difference({path: 1.0})
        if whole.mean() > 0.5:
            smooth &= whole
    weights = scene.weights * smooth[..., None]
    assert smooth.mean() > 0.3, "hardly a pixel is smooth"
    reverse = scene.reverse(weights)
    size = np.abs(scene.base * weights).sum()
    wrong = {}
    for path, image in differences.items():
        expected = float((image * weights).sum())
        if abs(reverse[path] - expected) > NEAR * abs(expected) + FLOAT * size / STEP:
            wrong[path] = (reverse[path] / size, expected / size)
    assert not wrong, wrong
    rng = np.random.default_rng(3)
    for _ in range(2):
        steps = dict(zip(reverse, rng.choice([-1.0, 1.0], len(reverse))))
        if name == "polarizer_bench":  # forward mode gives NaN along the camera's pose; reverse mode was compared above
            steps.update({path: 0.0 for path in steps if path.startswith("camera.")})
        terms = np.array([steps[path] * reverse[path] for path in reverse])
        assert scene.forward(weights, steps) == pytest.approx(terms.sum(), abs=SUMS * np.abs(terms).sum())


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in LONG else n for n in SCENES])
def test_other_parameters_refuse_a_derivative(name, plain):
    """What moves a surface that is made outside Dr.Jit, or acts on the finished image, would get a silent 0."""
    import drjit as dr
    import mitsuba as mi

    scene = plain(name)
    assert scene.refused
    for path, (part, p) in scene.refused.items():
        value = dr.opaque(mi.Float, part.number(p.name))
        dr.enable_grad(value)
        scene.params[path] = value
        with pytest.raises(ValueError, match=f"{p.name} has no derivative through mi.render: .* central difference"):
            scene.params.update()
        scene.params[path] = dr.detach(value)
        scene.params.update()
        assert scene.params.flags(path) & mi.ParamFlags.NonDifferentiable.value


@pytest.mark.slow
def test_memory_does_not_grow_with_the_way(plain):
    """Only STRIDE states are kept at a time: four times the surfaces take less than twice the memory."""
    import drjit as dr

    scene = plain("grid_bench")
    ways = []
    for depth in (40, 160):
        scene.params["integrator.interreflection"] = scene.params["integrator.interreflection"]
        scene.scene.integrator().max_depth = depth
        dr.sync_thread()
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        scene.reverse(scene.weights)
        ways.append(dr.detail.malloc_watermark(dr.JitBackend.LLVM))
    scene.scene.integrator().max_depth = 40
    assert ways[1] < 2 * ways[0], ways
