"""The contract of test_plugins.py for the parameters of dielectric bodies, where light is followed by Monte Carlo.

A small printed block, one LED in each band. Derivatives are compared as weighted means over the image, over seeds, in
units of their own standard errors."""

import numpy as np
import pytest

from optics.scene.registry import known

KINDS = ("clear", "cells", "block", "room")
EFFECTS = sorted(k for k, e in known().effects.items() if e.part in KINDS and e.part != "room")  # a light of its own
SEEDS = 4
DEFINES = {
    "width": 8,
    "height": 8,
    "x_fov": 6,
    "columns": 3,
    "rows": 3,
    "layers": 2,
    "block_width": 2.6,
    "block_length": 2.6,
    "distance": 0.4,
    "stance": "standing",
    "diameter": 24,
    "scattering": 0.06,
    "rays": 128,
    "packets": 32_000,
}
# so dark that few paths are long: the noise of a difference of images is that of the paths that diverge, the long ones
VALUES = {
    "filling.absorption": 0.6,
    "walls.absorption": 0.5,
    "filling.absorption_slope": 0.3,
    "walls.absorption_slope": 0.2,
    "window.absorption": 0.05,
}
BENT = (
    "index",
    "index_offset",
    "dispersion",
    "roughness",
    "birefringence",
)  # what bends rays is noise on this bench and seen on a slab
KEYS = [
    "led_red.x",
    "led_red.z",
    "led_red.mu",
    "camera.x",
    "camera.x_fov",
    "object.distance",
    *(
        f"{part}.{p.name}"
        for part, kind in (("walls", "clear"), ("filling", "clear"), ("grid", "cells"))
        for p in known().parameters_of(kind)
        if p.name not in BENT and not p.name.startswith("unfilled") and f"{part}.{p.name}" != "walls.scattering"
    ),
]

QUICK = {
    "led_red.z",
    "camera.x",
    "filling.absorption",
    "filling.scattering",
    "grid.wall",
    "object.distance",
}  # one of each way


@pytest.fixture(scope="module")
def bench(mitsuba):
    from optics.light.monte_carlo import MonteCarloRenderer
    from optics.scene import loader as scene

    loaded = scene.load("magictac", {k: str(v) for k, v in DEFINES.items()})
    loaded.set(
        {**VALUES, **{f"led_{c}.{a}": v for c, a, v in (("red", "x", -2.0), ("green", "x", 2.0), ("blue", "y", 2.0))}}
    )
    return loaded, MonteCarloRenderer(loaded, remember=4 * SEEDS), loaded.values()


def weighed(image):
    """(..., B, 6) of (..., H, W, B): the image in six weights."""
    v, u = np.mgrid[: image.shape[-3], : image.shape[-2]] / (image.shape[-3] - 1) - 0.5
    return np.einsum("...hwb,khw->...bk", image, np.stack([np.ones_like(u), u, v, u * v, u**2, v**2])) / u.size


def means(renderer, values, seed):
    return weighed(renderer.estimate(values, seed).radiance)


def beside(p):
    return 1e-30 if p.neutral == 0 else p.neutral


@pytest.mark.slow
@pytest.mark.parametrize("key", EFFECTS)
def test_an_effect_at_neutral_is_not_there(key, bench):
    """Its functions, evaluated next to neutral, leave the image as it is, with the same random numbers."""
    scene, renderer, values = bench
    effect = known().effects[key]
    own = {
        f"{n}.{p.name}": p
        for n, part in scene.parts.items()
        if part.kind == effect.part
        for p in known().effect_parameters(effect)
    }
    one, other = (
        renderer.estimate({**values, **{k: f(p) for k, p in own.items()}}).radiance
        for f in (lambda p: p.neutral, beside)
    )
    np.testing.assert_allclose(other, one, rtol=0, atol=1e-5 * one.max())  # atomic sums in float32, in another order


@pytest.mark.slow
@pytest.mark.parametrize("key", [k if k in QUICK else pytest.param(k, marks=pytest.mark.slow) for k in KEYS])
def test_derivatives_against_differences(key, bench):
    """The renderer's own against differences over a plausible change, both as means over seeds with common random
    numbers."""
    scene, renderer, values = bench
    p = scene.parameters[key]
    if key != "filling.scattering":
        values = {**values, "filling.scattering": 0.3}  # the cells show by what they scatter
    low, high = max(values[key] - p.plausible, p.bounds[0]), min(values[key] + p.plausible, p.bounds[1])
    sides = [np.array([means(renderer, {**values, key: v}, s) for s in range(SEEDS)]).sum(1) for v in (high, low)]
    wide = (sides[0] - sides[1]) / (high - low)
    own = np.array([weighed(renderer.tangent(values, key, s)) for s in range(SEEDS)])
    error = np.hypot(*(a.std(0, ddof=1) for a in (wide, own))) / np.sqrt(SEEDS)
    wide, own = wide.mean(0), own.mean(0)
    size = np.abs(wide).max()
    assert size > 3 * error.flat[np.abs(wide).argmax()], f"{key} does nothing to the bench that stands out of the noise"
    assert (np.abs(own - wide) < 6 * error + 0.05 * size).all()  # straight over a plausible change to some per cent


@pytest.mark.slow
def test_a_material_that_absorbs_nothing_has_its_derivative(bench):
    """At neutral, which is a bound, more absorption means less light, in proportion to the path lengths."""
    scene, renderer, values = bench
    clear = {**values, "window.absorption": 0.0}
    found = renderer.tangent(clear, "window.absorption").mean()
    assert found == pytest.approx(
        renderer.tangent({**values, "window.absorption": 1e-6}, "window.absorption").mean(), rel=1e-2
    )
    # the window is 4 mm thick and passed once by rays of the camera, near its axis, and by little else
    assert -6 < found / renderer.radiance(clear).mean() < -3.9


SLAB = """<scene version="3.0.0">
    <integrator type="tactile" id="integrator"><string name="bands" value="620, 540, 460"/><integer name="rays" value="4000"/><integer name="packets" value="8"/></integrator>
    <sensor type="camera" id="camera">
        <film type="hdrfilm"><integer name="width" value="6"/><integer name="height" value="6"/></film>
        <float name="x_fov" value="1"/><transform name="to_world"><translate x="0.01" y="0.02" z="-20"/></transform>
    </sensor>
    <shape type="cube" id="plate"><transform name="to_world"><scale x="9" y="9" z="1"/></transform>
        <bsdf type="clear" id="glass"><float name="index" value="1.5"/></bsdf></shape>
    <shape type="rectangle" id="screen"><transform name="to_world"><rotate x="1" angle="180"/><scale x="8" y="8"/><translate z="20"/></transform>
        <bsdf type="diffuse"><spectrum name="reflectance" value="0"/></bsdf><emitter type="source" id="lamp"/></shape>
</scene>"""  # noqa: E501


@pytest.mark.slow
@pytest.mark.parametrize(
    "key, factor",
    [
        ("glass.index", (1, 1, 1)),
        ("glass.index_offset", (1, 1, 1)),
        ("glass.dispersion", [(540 / w) ** 2 - 1 for w in (620, 540, 460)]),
    ],
)
def test_derivatives_by_the_index(key, factor, mitsuba, tmp_path):
    """Of a slab's transmittance T = 2n/(n^2 + 1): dT/dn = 2 (1 - n^2)/(n^2 + 1)^2, in every band by its dispersion."""
    from optics.light.monte_carlo import MonteCarloRenderer
    from optics.scene import loader as scene

    (tmp_path / "slab.xml").write_text(SLAB)
    loaded = scene.load(tmp_path / "slab.xml")
    renderer, p = MonteCarloRenderer(loaded), loaded.parameters[key]
    found = np.array([renderer.tangent(loaded.values(), key, seed).mean((0, 1)) for seed in range(8)])
    error = found.std(0, ddof=1) / np.sqrt(8)
    expected = 2 * (1 - 1.5**2) / (1.5**2 + 1) ** 2 * np.array(factor)
    assert p.plausible > 0 and error.max() < 0.25 * np.abs(expected).max()
    assert (np.abs(found.mean(0) - expected) <= 5 * error + 0.01 * np.abs(expected)).all(), (
        found.mean(0),
        error,
        expected,
    )


@pytest.mark.slow
def test_the_effect_of_roughness_is_its_square(mitsuba, tmp_path):
    """Before the edge of a luminous half plane, a plate that hardly refracts turns rays by (n - 1) times the slope of a
    facet, twice: the edge x = 0 is seen as wide as s^2 = (alpha (n - 1))^2/2 (L^2 + (L + d/n)^2), L behind the plate of
    the thickness d, and the integral of x times the image differs by -s^2/2, to second order in the slope (2 %); its
    derivative by the renderer's own difference."""
    from optics.light.monte_carlo import MonteCarloRenderer
    from optics.scene import loader as scene

    n, fov, width = 1.05, 4, 24
    text = SLAB
    for old, new in (
        ('width" value="6"', f'width" value="{width}"'),
        ('x_fov" value="1"', f'x_fov" value="{fov}"'),
        ('value="1.5"', f'value="{n}"'),
        ('value="4000"', 'value="1000"'),
        ('<translate z="20"/>', '<translate x="8" z="20"/>'),
    ):
        text = text.replace(old, new)
    (tmp_path / "edge.xml").write_text(text)
    loaded = scene.load(tmp_path / "edge.xml")
    renderer, values, key = MonteCarloRenderer(loaded), loaded.values(), "glass.roughness"
    x = np.tan(np.radians(fov / 2)) * 40 * (2 * (np.arange(width) + 0.5) / width - 1)

    def moment(image):
        return (image.mean((0, 2)) * x).sum() * (x[1] - x[0])

    def agrees(found, expected):
        error = np.std(found, ddof=1) / np.sqrt(len(found))
        assert error < 0.05 * expected
        assert abs(np.mean(found) + expected) < 5 * error + 0.02 * expected, (np.mean(found), error, expected)

    square = (n - 1) ** 2 / 2 * (19**2 + (19 + 2 / n) ** 2)  # s^2/alpha^2
    images = {
        alpha: np.array([moment(renderer.radiance({**values, key: alpha}, seed)) for seed in range(4)])
        for alpha in (0.1, 0.15, 0.2)
    }
    for low, high in ((0.1, 0.2), (0.1, 0.15)):
        agrees(images[high] - images[low], square / 2 * (high**2 - low**2))
    assert loaded.parameters[key].squared
    agrees([moment(renderer.tangent({**values, key: 0.15}, key, seed)) for seed in range(4)], square * 0.15)


def test_effects_are_offered_where_they_act(bench):
    """Scattering in the filling and not in the walls, which it is refused in; nothing that belongs to light followed
    LED by LED."""
    from optics.errors import BadScene

    scene, renderer, values = bench
    effects = known().effects
    assert scene.keys_of(effects["volume-scattering"]) == {"scattering": ["filling.scattering"]}
    assert set(scene.keys_of(effects["dispersion"])["dispersion"]) == {
        f"{n}.dispersion" for n in ("window", "walls", "filling")
    }
    assert all(scene.can_express(effects[k]) for k in EFFECTS)
    assert not any(scene.can_express(e) for e in effects.values() if "emission" in e.stages or e.part == "tactile")
    with pytest.raises(BadScene, match="walls.scattering = 0.1 1/mm; allowed: 0 in a material that fills no `cells`"):
        renderer.radiance({**values, "walls.scattering": 0.1})


def test_scenes_that_monte_carlo_cannot_follow_are_refused(bench, tmp_path):
    """An image by mi.render, in which LEDs would be dark; a curve LED by LED; films and meshes without coordinates in
    between."""
    from optics import cli
    from optics.errors import BadScene
    from optics.light.monte_carlo import MonteCarloRenderer
    from optics.light.rendering import RenderJob, obstacle
    from optics.scene import loader as scenes

    scene, _, _ = bench
    for more in ({"spp": 4}, {"stokes": True}):
        with pytest.raises(BadScene, match="brings no light of an LED, which is a point, through dielectric bodies"):
            RenderJob(scene, **more)
    assert obstacle(scene) and not obstacle(scene, chance=True)
    text = scenes.find("magictac").read_text(encoding="utf-8")
    film = '<shape type="rectangle"><bsdf type="polarizer_film" id="film"/></shape></scene>'
    mesh = '<shape type="cells" id="rod"><bsdf type="diffuse"/></shape></scene>'
    for body, said in ((film, "neither clear nor matt"), (mesh, "'rod' is matt, and no map")):
        (tmp_path / "more.xml").write_text(text.replace("</scene>", body))
        loaded = scenes.load(tmp_path / "more.xml", {k: str(v) for k, v in DEFINES.items()})
        with pytest.raises(BadScene, match=said):
            MonteCarloRenderer(loaded).radiance(loaded.values())
    assert cli.main(["sweep", "magictac", "--key", "filling.absorption", "--from", "0", "--to", "1"]) == 2


@pytest.mark.slow
def test_a_light_does_not_depend_on_the_others(bench):
    """A room that is off is not followed, and changes no other light's image when it is on; its image goes with its
    power."""
    scene, renderer, values = bench
    without, beside = (renderer.estimate({**values, "room.power": power}) for power in (0.0, 1e-4))
    assert beside.lights == list(scene.lights) and "room" not in without.lights
    for name in without.lights:
        one, other = (p.radiance[p.lights.index(name)] for p in (without, beside))
        np.testing.assert_allclose(other, one, rtol=0, atol=1e-5 * one.max())
    dark = {**values, **{f"{n}.power": 0.0 for n in scene.lights}}
    one, two = (renderer.radiance({**dark, "room.power": power}) for power in (1e-4, 2e-4))
    np.testing.assert_allclose(two, 2 * one, rtol=1e-12)
    assert 0 < one.max() < 1e-4  # what is seen through faces has the radiance of the room or less


@pytest.mark.slow
def test_no_light_no_image(bench):
    scene, renderer, values = bench
    dark = {**values, **{f"{n}.power": 0.0 for n in scene.lights}}
    for image in (renderer.radiance(dark), renderer.error(dark), renderer.tangent(dark, "filling.absorption")):
        assert image.shape == (scene.camera.resolution[1], scene.camera.resolution[0], 3) and not image.any()


@pytest.mark.slow
def test_the_model_differentiates_by_the_renderer(bench, tmp_path, monkeypatch):
    """One derivative of each way, through development: absorption by the ways, index by differences, a power by
    linearity. Faint rays are not thinned, which a difference would draw anew."""
    from optics.captures.capture_set import Captures, Frame
    from optics.captures.noise import Noise
    from optics.fit.scene_model import SceneModel
    from optics.light import transport
    from optics.scene.parameter import Values, Variable

    monkeypatch.setattr(transport, "FAINT", 0.0)
    scene, _, values = bench
    frame = Frame("one", np.zeros((*scene.camera.resolution[::-1], 3), np.float32))
    model = SceneModel(scene, Captures(tmp_path, str(scene.path), [frame], noise=Noise(0.1, 1.0, 0.0, 255.0, 0.0)))
    now = Values({**values, "camera.exposure": 4000.0})
    keys = ["filling.absorption", "walls.index", "led_red.power"]
    prediction, images = next(iter(model.derivatives(now, [Variable(k, (k,), scene.parameters[k]) for k in keys])))
    assert prediction.max() > 5 and images.keys() == set(keys)
    for key, step, tolerance in (
        ("led_red.power", 0.1, 1e-5),
        ("filling.absorption", 1e-3, 5e-3),
        ("walls.index", 1e-2, 1e-5),
    ):
        # of the index: the model's own step
        sides = [model.predict(Values({**now.common, key: values[key] + d}))[0] for d in (step, -step)]
        difference = (sides[0] - sides[1]) / (2 * step)
        np.testing.assert_allclose(
            images[key].mean((0, 1)), difference.mean((0, 1)), rtol=tolerance, atol=1e-4 * np.abs(difference).max()
        )


@pytest.mark.slow
def test_a_study_is_told_of_the_error_of_its_predictions(bench, tmp_path):
    """Four times the rays and packets halve the error."""
    from optics.captures.capture_set import Captures, Frame
    from optics.captures.noise import Noise
    from optics.fit.scene_model import SceneModel
    from optics.study import checks

    scene, _, values = bench
    frame = Frame(
        "one",
        np.zeros((*scene.camera.resolution[::-1], 3), np.float32),
        parameters={**values, "camera.exposure": 4000.0},
    )
    rays, packets = scene.integrator.rays, scene.integrator.packets
    shares = []
    try:
        for more in (1, 4):
            scene.integrator.rays, scene.integrator.packets = rays * more, packets * more
            model = SceneModel(
                scene, Captures(tmp_path, str(scene.path), [frame], noise=Noise(0.1, 0.05, 0.0, 255.0, 0.0))
            )
            shares.append(model.chance())
    finally:
        scene.integrator.rays, scene.integrator.packets = rays, packets
    assert 1.4 < shares[0] / shares[1] < 2.8 and shares[0] > checks.CHANCE
    assert any("a Monte Carlo estimate" in text for text in checks.of_captures(model)) == (shares[1] > checks.CHANCE)
