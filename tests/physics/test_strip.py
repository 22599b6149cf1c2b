"""Strips: their light on an unshadowed plane by Lambert's polygon formula, and their soft shadows, derivatives and the
integrator's renders against stock Mitsuba, which has rectangles that shine."""

from __future__ import annotations

import numpy as np
import pytest

from optics.scene.parameter import Values, Variable

LONG = {"position": (1.0, 11.0, -5.0), "target": (0.0, 0.0, 0.0), "along": (1.0, 0.1, 0.0)}
STRIPS = {  # pose, size (mm): a strip of GelSight Mini, a light bar at 40 mm, a square panel of 54 mm^2
    "strip": ({**LONG}, (15.0, 1.5)),
    "bar": ({**LONG, "position": (-14.0, 2.0, -6.0), "along": (0.0, 1.0, 0.2)}, (40.0, 3.0)),
    "panel": ({**LONG, "position": (9.0, 7.0, -8.0), "along": (-1.0, 1.0, 0.0)}, (7.35, 7.35)),
}
SCENE = """<scene version="3.0.0">
    <integrator type="tactile" id="integrator"><string name="bands" value="550"/></integrator>
    <sensor type="camera" id="camera">
        <transform name="to_world"><translate z="-24"/></transform>
        <float name="x_fov" value="40"/>
        <film type="hdrfilm">
            <integer name="width" value="{width}"/><integer name="height" value="{height}"/><rfilter type="box"/>
            <string name="component_format" value="float32"/>
        </film>
    </sensor>
    <shape type="gel" id="gel">
        <float name="width" value="24"/><float name="length" value="20"/>
        <float name="indenter_size" value="2"/><float name="press_depth" value="{depth}"/>
        <bsdf type="membrane" id="membrane"><float name="rho_r" value="0.6"/><float name="sigma" value="0"/></bsdf>
    </shape>
    <emitter type="strip" id="strip">
        <point name="position" x="{p[0]}" y="{p[1]}" z="{p[2]}"/>
        <point name="target" x="{t[0]}" y="{t[1]}" z="{t[2]}"/>
        <vector name="along" x="{a[0]}" y="{a[1]}" z="{a[2]}"/>
        <float name="length" value="{size[0]}"/><float name="width" value="{size[1]}"/>
        <float name="mu" value="1"/><float name="power" value="2"/>{more}
    </emitter>
</scene>"""
POWER, RHO = 2.0, 0.6


@pytest.fixture
def load(tmp_path):
    """A gel lit by one strip, 24 x 18 px at a width of 24: load(name, width, depth)."""
    from optics.scene import loader

    def made(name, width=24, depth=0.0, variant="llvm_ad_spectral_polarized", more=""):
        pose, size = STRIPS[name]
        p, t, a = (pose[k] for k in ("position", "target", "along"))
        file = tmp_path / f"{name}.xml"
        file.write_text(
            SCENE.format(p=p, t=t, a=a, size=size, width=width, height=width * 3 // 4, depth=depth, more=more)
        )
        return loader.load(file, variant=variant)

    return made


def unit(v):
    v = np.asarray(v, float)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def corners(name, shift=(0.0, 0.0, 0.0), stretch=(0.0, 0.0), roll=0.0):
    """(4, 3) corners of a strip, moved and made larger by some mm, turned by deg about its axis from the first side to
    the second."""
    pose, (length, width) = STRIPS[name]
    axis = unit(np.subtract(pose["target"], pose["position"]))
    along = unit(np.array(pose["along"]) - np.dot(pose["along"], axis) * axis)
    across = np.cross(axis, along)
    c, s = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    side, up = (c * along + s * across) * (length + stretch[0]) / 2, (c * across - s * along) * (width + stretch[1]) / 2
    middle = np.add(pose["position"], shift)
    return np.array([middle - side - up, middle + side - up, middle + side + up, middle - side + up])


def irradiance(points, polygon, normal):
    """(...,) Lambert: E = L/2 |sum of the edges' angles times the cosine of their planes' normals to the surface's|, of
    a polygon of radiance L = power / area that lies wholly above the surface."""
    to = unit(polygon[None] - points.reshape(-1, 1, 3))
    total = 0.0
    for one, next_ in zip(range(4), (1, 2, 3, 0)):
        edge = np.cross(to[:, one], to[:, next_])
        sine = np.linalg.norm(edge, axis=-1)
        angle = np.arctan2(sine, (to[:, one] * to[:, next_]).sum(-1))
        total = total + angle * (edge @ normal) / sine
    area = np.linalg.norm(np.cross(polygon[1] - polygon[0], polygon[3] - polygon[0]))
    return np.abs(total).reshape(points.shape[:-1]) / 2 * POWER / area


def seen(renderer, values):
    """(H, W, 3) where the flat face is seen."""
    return renderer.hits(values).position


def expected(points, *moved, **also):
    return RHO / np.pi * irradiance(points, corners(*moved, **also), np.array([0.0, 0.0, -1.0]))


@pytest.mark.parametrize("name", STRIPS)
def test_light_on_a_plane_is_that_of_lamberts_polygon(name, mitsuba, load, at_middles):
    from optics.light.renderer import Renderer

    scene = load(name)
    renderer, values = Renderer(scene), scene.values()
    found = renderer.radiance(values)[..., 0]
    exact = expected(seen(renderer, values), name)
    assert exact.max() > 1.5 * exact.min()
    off = np.abs(found / exact - 1)
    # the middle of the strip is 5 to 8 mm above the face: n points leave some thousandths, and next to a strip more
    assert off.max() < 5e-3 and off.mean() < 1e-3


@pytest.mark.parametrize(
    "key, moved",
    [
        ("x", lambda d: {"shift": (d, 0, 0)}),
        ("z", lambda d: {"shift": (0, 0, d)}),
        ("length", lambda d: {"stretch": (d, 0)}),
        ("width", lambda d: {"stretch": (0, d)}),
        ("roll", lambda d: {"roll": d}),
    ],
)
def test_derivatives_are_those_of_lamberts_polygon(key, moved, mitsuba, load, at_middles):
    """By the model, on an unshadowed plane, against differences of the closed form."""
    from pathlib import Path

    from optics.captures.capture_set import Captures, Frame
    from optics.captures.noise import Noise
    from optics.fit.scene_model import SceneModel

    scene = load("strip")
    noise = Noise(system_gain=0.1, dark_noise=1.0, black_level=0.0, saturation=1.0, prnu=0.0)
    frames = [Frame("plane", np.zeros((18, 24, 1), np.float32))]
    model = SceneModel(scene, Captures(Path("."), "strip", frames, noise=noise))
    at = Values(common=scene.values())
    variable = Variable(f"strip.{key}", (f"strip.{key}",), scene.parameters[f"strip.{key}"])
    found = next(iter(model.derivatives(at, [variable])))[1][f"strip.{key}"][..., 0]
    points, step = seen(model.renderer, scene.values()), 1e-3
    exact = (expected(points, "strip", **moved(step)) - expected(points, "strip", **moved(-step))) / (2 * step)
    off = np.linalg.norm(found - exact) / np.linalg.norm(exact)
    # the points' error, some thousandths; a width spreads the same power over a little more of the same place, so that
    # little is left of its derivative
    assert off < (0.1 if key == "width" else 0.01)


SPP, SEEDS = 128, 16  # samples of a render; independent renders, whose scatter is the variance
SIGNIFICANCE = 0.01  # of the whole image, after Sidak


def stock(mi, scene, name):
    """(seeds, H, W) radiance of the same skin by stock `path`, lit by a stock rectangle that shines."""
    polygon = corners(name)
    x, y = (polygon[1] - polygon[0]) / 2, (polygon[3] - polygon[0]) / 2
    z = np.cross(unit(x), unit(y))  # light leaves along it
    area = 4 * np.linalg.norm(np.cross(x, y))
    to_world = np.eye(4)
    to_world[:3] = np.stack([x, y, z, polygon.mean(0)], -1)
    assert np.dot(z, -polygon.mean(0)) > 0  # towards the middle of the face
    light = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(to_world.tolist()),
        "emitter": {"type": "area", "radiance": {"type": "uniform", "value": POWER / area}},
    }
    made = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "camera": scene.camera,
            "gel": scene.gel,
            "light": light,
        },
        optimize=False,
    )
    return np.array([np.array(mi.render(made, spp=SPP, seed=k), float)[..., 0] for k in range(SEEDS)])


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_mono"], indirect=True)
@pytest.mark.parametrize("name", ["strip", "panel"])
def test_soft_shadows_are_those_of_stock_mitsuba(name, variant, load):
    """A deep dent, whose rim throws a shadow with a penumbra: the prediction, and the integrator's render, pixel by
    pixel."""
    import mitsuba as mi

    from optics.light.renderer import Renderer

    scene = load(name, width=48, depth=1.6, variant=variant)
    values, images = scene.values(), stock(mi, scene, name)
    renderer = Renderer(scene)
    found = renderer.radiance(values)[..., 0]
    seen = np.array(renderer.led(values, "strip").visible, float)
    share = seen.mean(0).reshape(found.shape)
    half = (share > 0.05) & (share < 0.95)
    assert half.mean() > 0.05, "there is no penumbra to compare"
    # 1e-3 of the brightest: the points' error as on the plane; in the penumbra half a step, which is evenly distributed
    points = 1e-3 * found.max() + half * 0.5 / len(seen) / 3**0.5 * found / np.maximum(share, 0.05)
    assert least_p(images, found, points) > SIGNIFICANCE
    assert found.mean() == pytest.approx(images.mean(), rel=1e-3)
    assert least_p(images, unshadowed(renderer, values), points) < 1e-9, (
        "the comparison does not notice shadows that are missing"
    )

    scene.set(values)  # a prediction is made at power 1
    ours = np.array([np.array(mi.render(scene.mitsuba, spp=SPP, seed=100 + k), float)[..., 0] for k in range(SEEDS)])
    assert least_p(images, ours.mean(0), ours.std(0, ddof=1) / SEEDS**0.5) > SIGNIFICANCE


@pytest.mark.slow
@pytest.mark.parametrize("more", [{"gel.haze": 0.1}, {"membrane.rho_r": 3.0, "integrator.interreflection": 1.0}])
@pytest.mark.parametrize("variant", ["llvm_ad_mono"], indirect=True)
def test_haze_and_a_second_bounce_are_in_both_renders(more, variant, load):
    """The light of a strip in the gel and by two reflections: the prediction against the integrator's render, in the
    mean."""
    import mitsuba as mi

    from optics.light.renderer import Renderer

    scene = load("strip", depth=1.8, variant=variant)
    values = {**scene.values(), **more}
    renderer = Renderer(scene)
    ours = [renderer.radiance(values, seed).mean() for seed in range(SEEDS)]
    without = renderer.radiance({**values, "gel.haze": 0.0, "integrator.interreflection": 0.0}).mean()
    scene.set(values)
    scene.integrator.max_depth = 3 if values["integrator.interreflection"] else 2
    means = [np.array(mi.render(scene.mitsuba, spp=512, seed=k), float)[..., 0].mean() for k in range(SEEDS)]
    mean, found = np.mean(means), np.mean(ours)
    error = np.hypot(np.std(means, ddof=1), np.std(ours, ddof=1)) / SEEDS**0.5
    assert abs(found - without) > 8 * error, "they do nothing here"
    assert abs(mean - found) < 4 * error + 5e-4 * found  # and the points' error


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_mono"], indirect=True)
def test_a_calibration_finds_a_stock_rectangle(variant, load):
    """Place, length and power of a strip from images of three presses by stock Mitsuba, from 1 mm, a third of the
    length and 30 % away."""
    from pathlib import Path

    import mitsuba as mi

    from optics.captures.capture_set import Captures, Frame
    from optics.captures.noise import Noise
    from optics.fit import calibrate
    from optics.fit.scene_model import SceneModel

    scene, rng = load("strip", width=40, variant=variant), np.random.default_rng(4)
    noise = Noise(system_gain=0.1, dark_noise=1.0, black_level=0.0, saturation=255.0, prnu=0.0)
    exposure, frames = 180.0, []
    for k, (x, y, depth) in enumerate(((-3.0, 1.0, 1.2), (2.5, -2.0, 0.8), (0.0, 3.0, 1.5))):
        press = {"gel.press_x": x, "gel.press_y": y, "gel.press_depth": depth}
        scene.set(press)
        clean = 255.0 * exposure * stock(mi, scene, "strip").mean(0)[..., None]
        image = clean + rng.normal(size=clean.shape) * np.sqrt(noise.variance(clean))
        frames.append(Frame(f"press {k}", image.astype(np.float32), parameters=press))
    model = SceneModel(scene, Captures(Path("."), "strip", frames, {"camera.exposure": exposure}, noise))
    truth = dict(zip("xyz", STRIPS["strip"][0]["position"])) | {"length": STRIPS["strip"][1][0], "power": POWER}
    start = dict(zip(truth, (2.0, 10.5, -5.7, 10.0, 0.7 * POWER)))
    variables = calibrate.variables_from(model, [f"strip.{name}" for name in truth])
    fit = calibrate.fit(model, variables, Values({f"strip.{n}": v for n, v in start.items()}))
    assert fit.converged, fit.reason
    off = np.array([e - truth[v.name.split(".")[1]] for v, e in zip(fit.variables, fit.estimate)])
    assert (np.abs(off) < 4 * fit.sd).all() and fit.sd.max() < 0.1, (off, fit.sd)
    # 3538 values scatter by 0.024; the stock image's own noise and the points add some percent
    assert fit.chi2_per_dof == pytest.approx(1, abs=0.1)


def unshadowed(renderer, values):
    """(H, W) without cast shadows."""
    import drjit as dr

    image = renderer.led(values, "strip")
    part = renderer.scene.leds["strip"]
    shaded = renderer._shade(image.hits.sample, part, [dr.ones(type(v), 1) for v in image.visible])
    return POWER * renderer._bands([shaded])[0].reshape(renderer.height, renderer.width)


def least_p(images, other, error):
    """The smallest p-value over the pixels after Sidak's correction, of the mean of independent renders against an
    image with an error of its own."""
    from scipy.stats import t

    own = images.std(0, ddof=1) / len(images) ** 0.5
    both = np.hypot(own, error)
    lit = both > 1e-9 * images.max()
    assert np.abs(images.mean(0) - other)[~lit].max(initial=0) < 1e-6 * images.max()
    p = 2 * t.sf(np.abs(images.mean(0) - other)[lit] / both[lit], len(images) - 1)
    return 1 - (1 - p.min()) ** p.size


def test_a_strip_that_cannot_be_is_refused(mitsuba, load):
    from optics.errors import BadScene

    with pytest.raises(BadScene, match="points = 6; allowed: 0 and multiples of 4"):
        load("strip", more='<integer name="points" value="6"/>')
