"""Captures of the Vi2TaP finger by a renderer of its own: stock Mitsuba's `path`, its `polarizer`, finer meshes.

It shares nothing with `optics.light.renderer`, `optics.light.paths`, `optics.polarization.mueller` or the `tactile`
integrator. A polarizer with a leak is a mixture of two ideal ones, T1 along its axis and T2 across it: this is exact
for light that enters unpolarized and is only weighted at the end. Four renders in the mono variant (each film along or
across) hold every such pair. Objects outside and the markers are rendered separately, for unit reflectance and unit
excitation; quadrature over the spectra gives them their colours. Effects are made by mixing renders, by turning a film,
or by numpy on the image. Then come photons, read noise and 8 bits. A retarder is a mixture of films too: the stock one
turns by the angle to its x axis, which is not across an oblique ray, and has a seam there. Shared with the model are
the shape of a dent, Snell's and Fresnel's laws at the boundary, and the LED's lobe, which tests hold to closed
forms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from optics.captures import capture_set as capture_files
from optics.captures.noise import Noise
from optics.proof.makers.touch import CAMERA
from optics.scene.loader import Scene
from optics.scene.mitsuba_parts import use_variant

VARIANT = "llvm_ad_mono_polarized"
AXIS = 30.0  # deg: a retarder's fast axis
MAKERS = (
    "extinction leak",
    "coloured leak",
    "oblique leak",
    "polarizer misalignment",
    "servo scale",
    "servo backlash",
    "analyzer wobble",
    "depolarization",
    "retardance",
    "stray light",
    "dark offset",
    "camera gamma",
    "gain drift",
    "lens vignetting",
    "marker leak",
    "veiling glare",
)


class FingerMaker:
    """Makes frames of a vi2tap scene's values with hidden effects {name: strength} or none."""

    def __init__(
        self,
        scene: Scene,
        values: Mapping[str, float] | None = None,
        effects: Mapping[str, float] | None = None,
        noise: Noise = CAMERA,
        seed: int = 0,
        spp: int = 100,
    ):
        self.values = {**scene.values(), **(values or {})}
        self.effects = dict(effects or {})
        unknown = set(self.effects) - set(MAKERS)
        if unknown:
            raise ValueError(f"no independent way to make {', '.join(sorted(unknown))}; known: {', '.join(MAKERS)}")
        self.size, self.bands = scene.camera.resolution, np.array(scene.integrator.bands)
        self.frames = {
            n: np.array([[float(c[0]) for c in axis] for axis in led.frame]) for n, led in scene.leds.items()
        }
        self.noise, self.seed, self.spp, self.count = noise, seed, spp, 0
        self._kept: dict = {}  # displacements and images of the present geometry
        self.wall_dark = scene.defines.get("wall_dark", 0.6)

    # -- geometry -----------------------------------------------------------------------------------------------------
    def dent(self, press: Sequence[float]):
        """The pressed outer face's displacement map, or None."""
        from optics.skin import contact

        v = self.values
        if press[2] <= 0:
            return None
        profile = contact.indenter_profile("sphere", v["skin.indenter_size"], (0.0, 0.0, 0.0), 16.0, 0.08)
        return contact.displacement(profile, press[2], v["skin.thickness"], v["skin.smoothing"], skirt=v["skin.skirt"])[
            0
        ]

    def kept(self, key, make: Callable):
        if key not in self._kept:
            self._kept[key] = make()
        return self._kept[key]

    def maps(self, dent, depth: float):
        """Displacement maps at a depth of the present dent."""
        from optics.skin.halfspace import carried

        return self.kept(depth, lambda: carried(dent, dent.pitch, depth))

    def face(self, dent, press, depth: float, bsdf, name: str):
        """A sheet of the skin at a depth, on a uniform grid twice as fine as the model's."""
        from optics.skin import contact

        width, length, nx, ny = self.values["skin.width"], self.values["skin.length"], 241, 217
        x, y = np.linspace(-width / 2, width / 2, nx)[None, :], np.linspace(-length / 2, length / 2, ny)[:, None]
        ux = uy = uz = np.zeros((ny, nx))
        if dent is not None and depth == 0:
            uz = contact.surface(x, y, press[0], press[1], dent)
        elif dent is not None:
            ux, uy, uz = (contact.surface(x, y, press[0], press[1], m) for m in self.maps(dent, depth))
        points = np.stack(np.broadcast_arrays(x + ux, y + uy, -depth - uz), -1).reshape(-1, 3)
        index = np.arange(nx * ny).reshape(ny, nx)
        a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
        faces = np.stack([a, d, c, a, c, b], -1).reshape(-1, 3)
        uv = np.stack(np.broadcast_arrays(x / width + 0.5, y / length + 0.5), -1)
        return self.mesh(points, faces, bsdf, name, uv)

    def mesh(self, points, faces, bsdf, name: str, uv=None, shines: bool = False):
        import mitsuba as mi

        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict(bsdf)
        if shines:
            properties["emitter"] = mi.load_dict({"type": "area", "radiance": {"type": "uniform", "value": 1.0}})
        mesh = mi.Mesh(
            name, len(points), len(faces), properties, has_vertex_normals=False, has_vertex_texcoords=uv is not None
        )
        params = mi.traverse(mesh)
        params["vertex_positions"] = mi.Float(np.asarray(points, np.float32).ravel())
        params["faces"] = mi.UInt32(np.asarray(faces, np.uint32).ravel())
        if uv is not None:
            params["vertex_texcoords"] = mi.Float(uv.astype(np.float32).ravel())
        params.update()
        return mesh

    def markers(self, dent, press, bsdf, shines: bool = False):
        """The twenty markers as cylinders of 96 sides that stand on the inner face."""
        from optics.skin import contact

        v, sides = self.values, 96
        radius, height, depth = (v[f"markers.{n}"] for n in ("radius", "height", "depth"))
        maps = None if dent is None else self.maps(dent, depth)

        def moved(x, y):
            u = (
                [0.0] * 3
                if maps is None
                else [contact.surface(np.atleast_1d(x), np.atleast_1d(y), press[0], press[1], m) for m in maps]
            )
            return np.stack(np.broadcast_arrays(x + u[0], y + u[1], -depth - u[2]), -1)

        angle = 2 * np.pi * np.arange(sides) / sides
        circle = np.stack([np.cos(angle), -np.sin(angle)], -1) * radius
        points, faces = [], []
        for row in range(4):
            for column in range(5):
                at = np.array([(column - 2) * v["markers.pitch_x"], (row - 1.5) * v["markers.pitch_y"]])
                foot = moved(at[0], at[1]).reshape(3)
                slope = [
                    (moved(*(at + d))[..., 2] - moved(*(at - d))[..., 2]).item() / (2 * radius)
                    for d in (np.array([radius, 0.0]), np.array([0.0, radius]))
                ]
                axis = np.array([slope[0], slope[1], -1.0])
                axis /= np.linalg.norm(axis)
                e1 = np.cross(axis, [0.0, -1.0, 0.0])
                e1 /= np.linalg.norm(e1)
                e1 = e1 if e1[0] > 0 else -e1
                e2 = np.cross(axis, e1)
                e2 = e2 if e2[1] > 0 else -e2
                ring = foot + circle[:, :1] * e1 + circle[:, 1:] * e2
                base, i = sum(map(len, points)), np.arange(sides)
                j = (i + 1) % sides
                points += [
                    moved(at[0] + circle[:, 0], at[1] + circle[:, 1]),
                    ring + height * axis,
                    ring + height * axis,
                    (foot + height * axis)[None],
                ]
                faces += [
                    base + np.stack(f, -1)
                    for f in (
                        (i, j, sides + j),
                        (i, sides + j, sides + i),
                        (2 * sides + i, 2 * sides + j, np.full(sides, 3 * sides)),
                    )
                ]
        return self.mesh(np.concatenate(points), np.concatenate(faces), bsdf, "markers", None, shines)

    def cylinder(self, distance: float, bsdf):
        v, sides, half = self.values, 512, self.values["object.length"] / 2
        angle, radius = 2 * np.pi * np.arange(sides) / sides, v["object.diameter"] / 2
        y, z = radius * np.cos(angle) + v["object.y"], radius * np.sin(angle) + distance + radius
        ends = [np.stack(np.broadcast_arrays(v["object.x"] + s * half, y, z), -1) for s in (-1, 1)]
        middles = np.array([[v["object.x"] + s * half, v["object.y"], distance + radius] for s in (-1, 1)])
        i = np.arange(sides)
        j = (i + 1) % sides
        faces = np.concatenate(
            [
                np.stack(f, -1)
                for f in (
                    (i, j, sides + j),
                    (i, sides + j, sides + i),
                    (np.full(sides, 2 * sides), j, i),
                    (np.full(sides, 2 * sides + 1), sides + i, sides + j),
                )
            ]
        )
        return self.mesh(np.concatenate([*ends, middles]), faces, bsdf, "object")

    # -- light --------------------------------------------------------------------------------------------------------
    def rectangle(self, z: float, half: float, bsdf: dict) -> dict:
        import mitsuba as mi

        t = mi.ScalarTransform4f
        return {
            "type": "rectangle",
            "to_world": t().translate([0, 0, z]) @ t().rotate([1, 0, 0], 180) @ t().scale([half, half, 1]),
            "bsdf": bsdf,
        }

    def led(self, name: str) -> dict:
        import mitsuba as mi

        v, axis = self.values, self.frames[name][2]
        position = [float(v[f"{name}.{a}"]) for a in "xyz"]
        return {
            "type": "led",
            "position": mi.ScalarPoint3f(*position),
            "mu": float(v[f"{name}.mu"]),
            "target": mi.ScalarPoint3f(*[float(p + a) for p, a in zip(position, axis)]),
            "power": float(v[f"{name}.power"]),
        }

    def render(self, geometry, analyzer: float, film: float, what: str) -> np.ndarray:
        """(H, W) luminance behind ideal films with their axes at these angles; `what` is lit: object, wall or
        markers."""
        import mitsuba as mi

        dent, press, distance = geometry
        width, height = self.size
        looking = mi.ScalarTransform4f([[-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, -25], [0, 0, 0, 1]])

        def paint(name):
            return {"type": "diffuse", "reflectance": {"type": "uniform", "value": 1.0 if name == what else 0.0}}

        def ideal(angle):  # stock angles turn the other way, seen from the side of the normal
            return {"type": "polarizer", "theta": {"type": "uniform", "value": float(-angle)}}

        black, t = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}}, mi.ScalarTransform4f
        wall = {
            "type": "diffuse",
            "reflectance": {
                "type": "checkerboard",
                "to_uv": t().scale([20, 20, 1]),
                "color0": {"type": "uniform", "value": float(self.wall_dark)},
                "color1": {"type": "uniform", "value": 1.0},
            },
        }
        scene = {
            "type": "scene",  # `path` counts films as scattering: from the fifth surface on it would draw rays by lot
            "integrator": {"type": "path", "max_depth": 8 if what in ("object", "wall") else 4, "rr_depth": 100},
            "sensor": {
                "type": "perspective",
                "fov": float(self.values["camera.x_fov"]),
                "fov_axis": "x",
                "near_clip": 0.01,
                "far_clip": 1e4,
                "to_world": looking,
                "film": {
                    "type": "hdrfilm",
                    "width": width,
                    "height": height,
                    "rfilter": {"type": "box"},
                    "pixel_format": "luminance",
                    "component_format": "float32",
                },
                "sampler": {"type": "multijitter", "sample_count": self.spp},
            },
            "analyzer": self.rectangle(-23, 10, ideal(analyzer)),
            "film": self.face(dent, press, 2.5, ideal(film), "film"),
            "outer": self.face(
                dent, press, 0.0, {"type": "interface", "index": float(self.values["outer_face.index"])}, "outer"
            ),
            "inner": self.face(
                dent, press, 5.0, {"type": "interface", "index": float(self.values["inner_face.index"])}, "inner"
            ),
            "markers": self.markers(dent, press, paint("markers"), what == "coverage"),
            "object": self.cylinder(distance, paint("object")),
            "wall": self.rectangle(160, 1000, wall if what == "wall" else black),
        }
        for name, sign, axis in (("left", 1, "x"), ("right", -1, "x"), ("top", -1, "y"), ("bottom", 1, "y")):
            x, y = (24.0, 21.5)
            turn = t().rotate([0, 1, 0], 90 * sign) if axis == "x" else t().rotate([1, 0, 0], 90 * sign)
            place = [-x * sign, 0, -15] if axis == "x" else [0, y * sign, -15]
            size = [15, y, 1] if axis == "x" else [x, 15, 1]
            scene[f"body_{name}"] = {
                "type": "rectangle",
                "to_world": t().translate(place) @ turn @ t().scale(size),
                "bsdf": black,
            }
        lights = ("uv_left", "uv_right") if what == "markers" else ("room_left", "room_right")
        lights = [
            n for n in lights if self.values[f"{n}.power"] > 0
        ]  # `path` would draw a dark one as often as a bright one
        scene.update({name: self.led(name) for name in lights})
        self.count += 1
        image = np.array(mi.render(mi.load_dict(scene), seed=(self.seed * 7919 + self.count) % 2**31))
        return image.reshape(height, width).astype(float)

    def excitation(self) -> np.ndarray:
        """(B,) radiance per nm of the pigment per unit of pi x irradiance's kappa cos: by quadrature over both
        spectra."""
        v = self.values
        wavelength = np.linspace(150, 700, 20001)
        gauss = lambda x, peak, fwhm: np.exp(-4 * np.log(2) * ((x - peak) / fwhm) ** 2)  # noqa: E731
        lamp = gauss(wavelength, v["uv_left.wavelength"], v["uv_left.fwhm"])
        photons = np.trapezoid(
            lamp
            * v["pigment.absorptance"]
            * gauss(wavelength, v["pigment.absorption_peak"], v["pigment.absorption_fwhm"])
            * wavelength,
            wavelength,
        )
        wide = np.linspace(200, 1200, 40001)
        shape = gauss(wide, v["pigment.emission_peak"], v["pigment.emission_fwhm"])
        emission = gauss(self.bands, v["pigment.emission_peak"], v["pigment.emission_fwhm"]) / np.trapezoid(shape, wide)
        return v["pigment.yield"] * photons * emission / self.bands

    def parts(self, geometry, analyzer: float) -> dict[str, np.ndarray]:
        """{what: (2, 2, H, W, 1 or B)} behind ideal films: [analyser along | across][skin's film along | across];
        markers (2, 2, H, W)."""
        e, v = self.effects, self.values
        offset = e.get("polarizer misalignment", 0.0)
        film = v["film.angle"] + v["film.offset"]
        found = {}
        for what in ("object", "wall"):
            angles = [analyzer + offset, analyzer + offset + 90]
            found[what] = np.array([[self.render(geometry, a, film + f, what) for f in (0, 90)] for a in angles])[
                ..., None
            ]
            if "retardance" in e:
                found[what] = found[what] - self.taken_by_retarder(geometry, angles, film, what)
        # markers are in front of the skin's film, and their light is unpolarized: one render serves all four
        one = self.kept("markers", lambda: self.render(geometry, 0.0, film, "markers"))
        found["markers"] = np.broadcast_to(one / 2, (2, 2, *one.shape))
        if "marker leak" in e:  # behind one ideal film a surface of radiance 1 shows half of it
            cover = 2 * self.kept("coverage", lambda: self.render(geometry, 0.0, film, "coverage"))
            width, height = self.size
            focal = width / 2 / np.tan(np.radians(v["camera.x_fov"]) / 2)
            y, x = np.mgrid[:height, :width] + 0.5
            at = 20 / focal  # mm per px in the plane of the inner face, 20 mm before the camera
            skin = (np.abs(x - width / 2) * at < v["skin.width"] / 2) & (
                np.abs(y - height / 2) * at < v["skin.length"] / 2
            )
            mean = one.sum() / np.maximum(cover.sum() / 2, 1e-9)
            found["glow"] = e["marker leak"] * mean * (skin * (1 - np.clip(cover, 0, 1)))
        return found

    def taken_by_retarder(self, geometry, analyzers: Sequence[float], film: float, what: str) -> np.ndarray:
        """(2, 2, H, W, B) that a retarder behind the skin's film takes from its light: of light at f, the part
        polarized at 45 deg to the fast axis psi, sin 2(f - psi), is left with cos Gamma of itself; Gamma = retardance x
        540 nm/lambda, psi = AXIS."""
        diagonal = [[self.render(geometry, a, AXIS + d, what) for d in (45, 135)] for a in analyzers]
        lost = np.array([(plus - minus) / 2 for plus, minus in diagonal])[:, None, ..., None]
        share = np.array([np.sin(np.radians(2 * (film + f - AXIS))) for f in (0, 90)])[:, None, None, None]
        return share * lost * (1 - np.cos(np.radians(self.effects["retardance"] * 540 / self.bands)))

    def radiance(self, parts: Mapping[str, np.ndarray], dial: float) -> np.ndarray:
        """(H, W, B) of the frame, from the renders behind ideal films."""
        v, e = self.values, self.effects
        t1 = {n: v[f"{n}.transmittance"] for n in ("analyzer", "film")}
        leak = np.array([e.get("extinction leak", v["film.leak"])] * len(self.bands))
        if "coloured leak" in e:
            leak = leak * np.exp(e["coloured leak"] * (self.bands - 540) / 100)
        total = 0.0
        paints = {"object": "object_paint", "wall": "wall_paint"}
        weights = [[t1["analyzer"] + 0 * leak, leak], [t1["film"] + 0 * leak, leak]]
        for what, images in parts.items():
            if what == "glow":
                total = total + images[..., None] * (weights[0][0] + weights[0][1]) / 2 * self.excitation()
                continue
            if what == "markers":  # half of unpolarized light passes each of the two ideal analysers
                through = (weights[0][0] + weights[0][1]) * self.excitation()
                light = images[0, 0][..., None] * 2 * through
            else:
                rho = np.array([v[f"{paints[what]}.rho_{c}"] for c in "rgb"])[: len(self.bands)]
                light = sum(images[i, j] * weights[0][i] * weights[1][j] for i in (0, 1) for j in (0, 1)) * rho
                if "depolarization" in e:  # a share comes through with its polarization mixed
                    mixed = (
                        sum(images[i, j] * weights[1][j] for i in (0, 1) for j in (0, 1))
                        * ((weights[0][0] + weights[0][1]) / 2)
                        * rho
                    )
                    light = light + e["depolarization"] * (mixed - light)
            total = total + light
        if "oblique leak" in e:
            width, height = self.size
            focal = width / 2 / np.tan(np.radians(v["camera.x_fov"]) / 2)
            y, x = np.mgrid[:height, :width] + 0.5
            tan2 = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / focal**2
            sin2 = (tan2 / (1 + tan2))[..., None] * e["oblique leak"]  # at the analyser; refracted at the film
            inside = sin2 / v["inner_face.index"] ** 2
            for what in ("object", "wall"):
                rho = np.array([v[f"{paints[what]}.rho_{c}"] for c in "rgb"])[: len(self.bands)]
                images = parts[what] * rho
                total = total + (
                    sin2 * (images[1, 0] * weights[1][0] + images[1, 1] * weights[1][1])
                    + inside * (images[0, 1] * weights[0][0] + images[1, 1] * weights[0][1])
                )
            total = total + sin2 * images_of_markers(parts, self.excitation())
        if "analyzer wobble" in e:
            total = total * (1 + e["analyzer wobble"] * np.cos(np.radians(dial)))
        return total + e.get("stray light", 0.0)

    # -- camera -------------------------------------------------------------------------------------------------------
    def photograph(self, radiance: np.ndarray, rng, frame: int) -> np.ndarray:
        """Noisy, quantised DN of a radiance (H, W, 3); the camera's effects in numpy."""
        v, e, n = self.values, self.effects, self.noise
        width, height = self.size
        image = radiance.astype(float)
        if "lens vignetting" in e:
            focal = width / 2 / np.tan(np.radians(v["camera.x_fov"]) / 2)
            y, x = np.mgrid[:height, :width] + 0.5
            r = np.hypot(x - width / 2, y - height / 2) / focal
            image = image * (np.cos(np.arctan(r)) ** (4 * e["lens vignetting"]))[..., None]
        if "veiling glare" in e:
            image = image + e["veiling glare"] * (image.mean((0, 1)) - image)
        signal = image * v["camera.exposure"]
        if "gain drift" in e:
            signal = signal * (1 + e["gain drift"] * np.random.default_rng([self.seed, frame, 5]).standard_normal())
        if "camera gamma" in e:
            signal = np.maximum(signal, 0) ** (1 + e["camera gamma"])
        return n.expose(n.black_level + (n.saturation - n.black_level) * signal + e.get("dark offset", 0.0), rng)

    def captures(
        self,
        geometries: Sequence[tuple[Sequence[float], float]],
        dials: Sequence[float],
        progress: Callable[[str, int, int], None] | None = None,
    ) -> capture_files.Captures:
        """Frames of every geometry ((x, y, depth) of the press, distance of the object) at every dial of the analyser.

        With backlash, dials are come to from below in even frames and from above in odd ones.
        """
        use_variant(VARIANT)
        rng = np.random.default_rng([self.seed, 3])
        frames, e = [], self.effects
        for k, (press, distance) in enumerate(geometries):
            geometry = (self.dent(press), press, distance)
            self._kept.clear()
            for dial in dials:
                approach = 1.0 if len(frames) % 2 == 0 else -1.0
                true = dial * e.get("servo scale", 1.0) + approach * e.get("servo backlash", 0.0) / 2
                image = self.photograph(self.radiance(self.parts(geometry, true), dial), rng, len(frames)).astype(
                    np.float32
                )
                settings = {
                    "analyzer.angle": float(dial),
                    "analyzer.approach": approach,
                    "object.distance": float(distance),
                    "skin.press_x": float(press[0]),
                    "skin.press_y": float(press[1]),
                    "skin.press_depth": float(press[2]),
                }
                frames.append(
                    capture_files.Frame(
                        f"scene{k:02d}-{dial:g}",
                        image,
                        None,
                        f"scene-{k:02d}",
                        settings,
                        [],
                        f"frames/scene{k:02d}-{dial:g}.png",
                    )
                )
            if progress:
                progress("captures", k + 1, len(geometries))
        return capture_files.Captures(Path("."), "vi2tap", frames, self.known(), self.noise, None, None, "DN", None, [])

    def known(self) -> dict[str, float]:
        """What is written down of the set-up: its exposure and lights; matt paints and no light but the room's
        lamps."""
        lights = [f"{n}.power" for n in ("room_left", "room_right", "uv_left", "uv_right")]
        return {
            **{k: float(self.values[k]) for k in ("camera.exposure", *lights)},
            **{f"{paint}_paint.{n}": 0.0 for paint in ("object", "wall") for n in ("ambient", "sigma")},
        }


def images_of_markers(parts: Mapping[str, np.ndarray], excitation: np.ndarray) -> np.ndarray:
    """(H, W, B) markers behind one ideal analyser."""
    return parts["markers"][0, 0][..., None] * 2 * excitation
