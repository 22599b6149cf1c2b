"""A floor before a wall of another paint under a white LED, channels as integrals over the wavelength: ours by Gauss
nodes, and by stock plugins alone with wavelengths by Monte Carlo.

Tests hold one to the other, and `make bench` times them. Shared are the curves of light, paints and camera."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

CAMERA = "Nikon 5100 (NPL)"
WHITE_LED = "phosphor(450, 20, 560, 120, 4)"
FLOOR, WALL = "colour:orange", "colour:blue sky"
POWER = 20.0
PIXELS, FINER = (32, 24), 3  # of the stock film; ours is finer each way and averaged, as the film averages a pixel


def by_nodes(folder: Path, max_depth: int, nodes: str = "auto 8"):
    """(scene, f(seed) -> (H, W, 3)) by Gauss nodes; the wall stands outside the view. Turned by 180 deg, as the image
    of a stock camera is."""
    from optics.light.renderer import Renderer
    from optics.scene import loader

    width, height = (n * FINER for n in PIXELS)
    file = folder / "white.xml"
    file.write_text(
        f"""<scene version="3.0.0">
        <integrator type="tactile" id="integrator"><string name="bands" value="{nodes}"/>
            <integer name="max_depth" value="{max_depth}"/>
            <float name="interreflection" value="{max_depth - 2}"/></integrator>
        <sensor type="camera" id="camera"><string name="sensitivity" value="{CAMERA}"/>
            <float name="x_fov" value="35"/>
            <transform name="to_world"><lookat origin="0,-4,8" target="0,0,0" up="0,1,0"/></transform>
            <film type="hdrfilm"><integer name="width" value="{width}"/><integer name="height" value="{height}"/></film>
        </sensor>
        <bsdf type="membrane" id="paint"><float name="sigma" value="0"/>
            <string name="reflectance" value="{FLOOR}"/></bsdf>
        <bsdf type="membrane" id="coat"><float name="sigma" value="0"/>
            <string name="reflectance" value="{WALL}"/></bsdf>
        <shape type="rectangle" id="floor"><transform name="to_world"><scale value="6"/></transform>
            <ref id="paint"/></shape>
        <shape type="rectangle" id="wall"><transform name="to_world"><rotate y="1" angle="-90"/>
            <scale value="3"/><translate x="3.5"/></transform><ref id="coat"/></shape>
        <emitter type="led" id="led"><point name="position" x="0.5" y="0.5" z="4"/>
            <point name="target" x="0.5" y="0.5" z="0"/><float name="mu" value="0"/>
            <float name="power" value="{POWER}"/>
            <string name="spectrum" value="{WHITE_LED}"/></emitter></scene>""",
        encoding="utf-8",
    )
    scene = loader.load(file)
    renderer, values = Renderer(scene), scene.values()

    def image(seed: int = 0) -> np.ndarray:
        channels = renderer.radiance(values, seed) @ scene.integral.matrix(values).T
        return channels.reshape(PIXELS[1], FINER, PIXELS[0], FINER, 3).mean((1, 3))[::-1, ::-1]

    return scene, image


def by_wavelengths(unit: float, max_depth: int) -> Callable[[int, int], np.ndarray]:
    """f(spp, seed) -> (H, W, 3) by stock plugins: a point light, diffuse paints, `path` with wavelengths by Monte
    Carlo, and a `specfilm` with the camera's curves in steps of 1 nm. unit: what a channel's integral is divided by."""
    import mitsuba as mi

    from optics.spectra.reading import read_channels, read_curve

    def table(curve):
        nm = np.arange(360.0, 831.0)
        values = {"wavelengths": nm, "values": curve(nm)}
        return {"type": "irregular", **{k: ",".join(f"{x:.9g}" for x in v) for k, v in values.items()}}

    def paint(name):
        return {"type": "diffuse", "reflectance": table(read_curve(name, "reflectance"))}

    light, to = read_curve(WHITE_LED, "power"), mi.ScalarTransform4f
    channels = {f"channel{c}": table(q) for c, q in enumerate(read_channels(CAMERA))}
    film = {"type": "specfilm", "width": PIXELS[0], "height": PIXELS[1], "component_format": "float32"}
    wall = to().translate([3.5, 0, 0]).rotate([0, 1, 0], -90).scale(3)
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 35,
                "to_world": to().look_at([0, -4, 8], [0, 0, 0], [0, 1, 0]),
                "film": {**film, "rfilter": {"type": "box"}, **channels},
                "sampler": {"type": "independent"},
            },
            "floor": {"type": "rectangle", "to_world": to().scale(6), "bsdf": paint(FLOOR)},
            "wall": {"type": "rectangle", "to_world": wall, "bsdf": paint(WALL)},
            "light": {"type": "point", "position": [0.5, 0.5, 4.0], "intensity": table(light)},
        },
        optimize=False,
    )
    path = mi.load_dict({"type": "path", "max_depth": max_depth, "rr_depth": 100})

    def image(spp: int, seed: int) -> np.ndarray:
        return np.array(mi.render(scene, integrator=path, spp=spp, seed=seed), float) * POWER / light.area / unit

    return image
