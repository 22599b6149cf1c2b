"""Captures of a small printed grid by a renderer of its own: stock Mitsuba's `volpath`, `dielectric` faces around stock
media.

It shares nothing with `optics.light.transport` or our parts. Rays start at the camera; they reach a panel through a
shadow ray from a matt surface, or by hitting it. Absorption and scattering are sampled, not weighted. The faces of the
cells and of the rod are separate meshes. Each panel is rendered alone; light is unpolarized until the faces polarize it
(mono variant, Mueller matrices). Effects are made by stock means: a medium's coefficients, an index, `roughdielectric`
(Beckmann, which depolarizes completely), another mesh. Then come photons, read noise and 8 bits. The Monte Carlo error
of an image, from independent passes, is reported as a share of the camera's noise: it should stay below 0.3."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from optics.captures import capture_set as capture_files
from optics.captures.noise import Noise
from optics.proof.makers import in_variant
from optics.scene.loader import Scene

VARIANT = "llvm_ad_mono_polarized"
# small pixels at high gain: 800 electrons are white
CAMERA = Noise(system_gain=0.3, dark_noise=2.0, black_level=8.0, saturation=255.0, prnu=0.0)
MAKERS = (
    "volume scattering",
    "rough walls",
    "index mismatch",
    "body absorption",
    "unfilled cell",
    "wall thickness",
    "dispersion",
    "coloured absorption",
)
PASSES = 8  # independent renders of an image
BOX = np.array(
    [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
)  # sides, seen from outside


class GridMaker:
    """Makes frames of a grid_bench scene's values with hidden effects {name: strength} or none.

    effects   volume scattering   sigma_s of the filling, 1/mm;       body absorption   alpha of the filling, 1/mm
              rough walls         alpha of the cells' faces;          index mismatch    what is added to the filling's
                                  index
              unfilled cell       (column, row, layer), full of air;  wall thickness    what is added to that of walls,
                                  mm
              dispersion          of the filling: what its index has at 540/sqrt(2) nm more than at 540 nm
              coloured absorption of the filling: change of ln(alpha) per 100 nm
    spp       samples per pixel of an image, over all passes
    shares    of every frame made so far: rms of the image's own error over the camera's noise
    """

    def __init__(
        self,
        scene: Scene,
        values: Mapping[str, float] | None = None,
        effects: Mapping | None = None,
        noise: Noise = CAMERA,
        seed: int = 0,
        spp: int = 8192,
    ):
        import mitsuba as mi

        self.values, self.effects = {**scene.values(), **(values or {})}, dict(effects or {})
        unknown = set(self.effects) - set(MAKERS)
        if unknown:
            raise ValueError(f"no independent way to make {', '.join(sorted(unknown))}; known: {', '.join(MAKERS)}")
        self.size, self.camera_z = scene.camera.resolution, float(scene.camera.columns[3].z[0])
        self.counts = next(s for s in scene.mitsuba.shapes() if s.id() == "grid").counts
        cell = self.effects.get("unfilled cell")
        if cell is not None and not (len(cell) == 3 and all(0 <= c < n for c, n in zip(cell, self.counts))):
            raise ValueError(f"unfilled cell = {cell}; allowed: (column, row, layer) below {self.counts}")
        body = next(s for s in scene.mitsuba.shapes() if s.id() == "body").bbox()
        self.body = np.array([np.array(body.min).ravel(), np.array(body.max).ravel()], float)
        placed = mi.traverse(scene.mitsuba)
        self.panels = {
            name: np.array(placed[f"{s.id()}.to_world"].matrix, float).reshape(4, 4)
            for name, part in scene.sources.items()
            for s in scene.mitsuba.shapes()
            if s.emitter() is part
        }
        self.noise, self.seed, self.spp, self.count = noise, seed, spp, 0
        self.shares: list[float] = []
        self.bands = tuple(float(nm) for nm in scene.integrator.bands)

    # -- bodies -------------------------------------------------------------------------------------------------------
    def mesh(self, name: str, points, faces, **has):
        """A mesh of flat triangles with its material, and its media."""
        import mitsuba as mi

        properties = mi.Properties()
        properties["face_normals"] = True
        for key, value in has.items():
            if value is not None:
                properties[key] = value
        mesh = mi.Mesh(name, len(points), len(faces), properties, has_vertex_normals=False, has_vertex_texcoords=False)
        params = mi.traverse(mesh)
        params["vertex_positions"] = mi.Float(np.asarray(points, np.float32).ravel())
        params["faces"] = mi.UInt32(np.asarray(faces, np.uint32).ravel())
        params.update()
        return mesh

    def boxes(self, name: str, low: np.ndarray, high: np.ndarray, **has):
        """Boxes between (N, 3) corners, their normals outwards."""
        at = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        points = low[:, None] + at * (high - low)[:, None]
        faces = np.concatenate([BOX[:, [0, 1, 2]], BOX[:, [0, 2, 3]]])
        return self.mesh(
            name, points.reshape(-1, 3), (faces + 8 * np.arange(len(low))[:, None, None]).reshape(-1, 3), **has
        )

    def cells(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners (columns, rows, layers, 3) of the cells, low and high."""
        pitch, skin = self.values["grid.pitch"], self.values["grid.skin"]
        half = (pitch - self.values["grid.wall"] - self.effects.get("wall thickness", 0.0)) / 2
        middle = np.stack(
            np.meshgrid(
                *[(np.arange(n) - (n - 1) / 2) * pitch for n in self.counts[:2]],
                -skin - (np.arange(self.counts[2]) + 0.5) * pitch,
                indexing="ij",
            ),
            -1,
        )
        return middle - half, middle + half

    def rod(self, distance: float, bsdf):
        """The rod that stands before the face: 512 sides."""
        v, sides = self.values, 512
        angle, radius = 2 * np.pi * np.arange(sides) / sides, v["object.diameter"] / 2
        x, y = v["object.x"] + radius * np.cos(angle), v["object.y"] + radius * np.sin(angle)
        ends = [np.stack(np.broadcast_arrays(x, y, z), -1) for z in (distance, distance + v["object.length"])]
        i, middle = np.arange(sides), np.full(sides, 2 * sides)
        j = (i + 1) % sides
        faces = np.concatenate(
            [
                np.stack(f, -1)
                for f in (
                    (i, j, sides + j),
                    (i, sides + j, sides + i),
                    (middle, j, i),
                    (middle + 1, sides + i, sides + j),
                )
            ]
        )
        centres = [[v["object.x"], v["object.y"], z] for z in (distance, distance + v["object.length"])]
        return self.mesh("rod", np.concatenate([*ends, centres]), faces, bsdf=bsdf)

    def scene(self, distance: float, panel: str, nm: float = 540.0):
        """The stock scene with the rod at a distance (mm) and one panel of radiance 1, as it is at a wavelength."""
        import mitsuba as mi

        v, e, t = self.values, self.effects, mi.ScalarTransform4f
        walls, filling = v["walls.index"], v["filling.index"] + e.get("index mismatch", 0.0)
        filling += e.get("dispersion", 0.0) * ((540 / nm) ** 2 - 1)
        fades = np.exp(e.get("coloured absorption", 0.0) * (nm - 540) / 100)
        rough = e.get("rough walls", 0.0)

        def medium(absorption, scattering=0.0):
            total = absorption + scattering
            if total == 0:
                return None
            return mi.load_dict(
                {
                    "type": "homogeneous",
                    "sigma_t": {"type": "uniform", "value": float(total)},
                    "albedo": {"type": "uniform", "value": float(scattering / total)},
                    "phase": {"type": "isotropic"},
                }
            )

        def face(inside, outside, alpha=0.0):
            kind = (
                {"type": "roughdielectric", "distribution": "beckmann", "alpha": float(alpha)}
                if alpha
                else {"type": "dielectric"}
            )
            return mi.load_dict({**kind, "int_ior": float(inside), "ext_ior": float(outside)})

        def matt(reflectance):
            return {"type": "diffuse", "reflectance": {"type": "uniform", "value": float(reflectance)}}

        resin = medium(v["walls.absorption"])
        support = medium(
            fades * e.get("body absorption", v["filling.absorption"]),
            e.get("volume scattering", v["filling.scattering"]),
        )
        low, high = self.cells()
        filled = np.ones(self.counts, bool)
        if "unfilled cell" in e:
            filled[tuple(e["unfilled cell"])] = False
        width, height = self.size
        looking = mi.ScalarTransform4f([[-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, self.camera_z], [0, 0, 0, 1]])
        content = {
            "type": "scene",
            "integrator": {"type": "volpath", "max_depth": 512, "rr_depth": 10_000},
            "sensor": {
                "type": "perspective",
                "fov": float(v["camera.x_fov"]),
                "fov_axis": "x",
                "near_clip": 0.01,
                "far_clip": 1e3,
                "to_world": looking,
                "film": {
                    "type": "hdrfilm",
                    "width": width,
                    "height": height,
                    "rfilter": {"type": "box"},
                    "pixel_format": "luminance",
                    "component_format": "float32",
                },
                "sampler": {"type": "multijitter", "sample_count": 64},
            },
            "body": self.boxes("body", self.body[:1], self.body[1:], bsdf=face(walls, 1.0), interior=resin),
            "cells": self.boxes(
                "cells", low[filled], high[filled], bsdf=face(filling, walls, rough), interior=support, exterior=resin
            ),
            "rod": self.rod(distance, mi.load_dict(matt(v["object.bsdf.reflectance.value"]))),
        }
        if not filled.all():
            content["hollow"] = self.boxes(
                "hollow", low[~filled], high[~filled], bsdf=face(1.0, walls, rough), exterior=resin
            )
        for name, place in self.panels.items():
            content[name] = {"type": "rectangle", "to_world": t(place), "bsdf": matt(0.0)}
            if name == panel:
                content[name]["emitter"] = {"type": "area", "radiance": {"type": "uniform", "value": 1.0}}
        return mi.load_dict(content, optimize=False)

    def radiance(self, distance: float, panel: str, nm: float = 540.0) -> tuple[np.ndarray, np.ndarray]:
        """(H, W) radiance at power 1 and a wavelength, and its standard error from independent passes."""
        import mitsuba as mi

        with in_variant(VARIANT):
            scene = self.scene(distance, panel, nm)
            passes = []
            for _ in range(PASSES):
                self.count += 1
                image = mi.render(
                    scene, spp=max(self.spp // PASSES, 1), seed=(self.seed * 100_003 + self.count) % 2**31
                )
                passes.append(np.array(image, float).reshape(*self.size[::-1]))
            return np.mean(passes, 0), np.std(passes, 0, ddof=1) / np.sqrt(PASSES)

    # -- camera -------------------------------------------------------------------------------------------------------
    def photograph(self, radiance: np.ndarray, error: np.ndarray, rng) -> np.ndarray:
        """(H, W, B) noisy, quantised DN of a radiance (H, W) or (H, W, B); the share that the image's own error has
        in that noise goes to `shares`."""
        n = self.noise
        full = (n.saturation - n.black_level) * self.values["camera.exposure"]
        signal = n.black_level + full * radiance
        self.shares.append(float(np.sqrt(np.mean((full * error / n.sd(signal)) ** 2))))
        found = n.expose(signal, rng).astype(np.float32)
        return found if found.ndim == 3 else found[..., None]

    def captures(
        self, distances: Sequence[float], progress: Callable[[str, int, int], None] | None = None
    ) -> capture_files.Captures:
        """Frames of the rod at every distance (mm), a group each, lit by one panel after the other."""
        rng = np.random.default_rng([self.seed, 3])
        frames = []
        with in_variant(VARIANT):
            light = {}
            for k, distance in enumerate(distances):
                for panel in self.panels:
                    each = [self.radiance(distance, panel, nm) for nm in self.bands]
                    light[distance, panel] = tuple(np.stack(images, -1) for images in zip(*each))
                if progress:
                    progress("captures", k + 1, len(distances))
        for k, distance in enumerate(distances):
            for panel in self.panels:
                radiance, error = light[distance, panel]
                power = self.values[f"{panel}.power"]
                settings = {
                    "object.distance": float(distance),
                    **{f"{n}.power": float(n == panel) for n in self.panels},
                }
                name = f"distance{k:02d}-{panel}"
                frames.append(
                    capture_files.Frame(
                        name,
                        self.photograph(power * radiance, power * error, rng),
                        None,
                        f"distance-{k:02d}",
                        settings,
                        [],
                        f"frames/{name}.png",
                    )
                )
        known = {"camera.exposure": float(self.values["camera.exposure"])}
        return capture_files.Captures(Path("."), "grid_bench", frames, known, self.noise, None, None, "DN", None, [])
