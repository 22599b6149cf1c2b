"""Captures of a particle gel by numpy alone: balls by their equation, lights by sums, rays through all of the pupil.

It shares nothing with `optics.light` or our parts: rays of a pixel start on the pupil, each is held against every ball
(closed form) and the cover's face (a height by splines), and what it meets is lit by every LED on its own, with shadows
by the distance of balls from the way. Spectra are summed over the wavelength. The skin moves by direct sums of point
forces, of the pressures of flat punches of growing size (Sneddon's contact), incompressible; on a stiff base by the
Hankel transform of such a layer. Shared with the model is what its scene file says: the places of the draw, which bead
is large and which small (`optics.skin.cloud.lots`), and where LEDs and lens are. Effects are made in the same way: a
pupil with an area, an absorbing dye along each way, diameters that are normal (log-normal in the model), a shift of the
balls, rays and light that a denser gel bends by Snell's law (in the model, rays alone), light from ball to ball by a
random direction of each ray, a Gaussian over the image. Then come photons, read noise and quantisation. Images are
means of SIDE^2 rays per pixel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from optics.captures import capture_set as capture_files
from optics.captures.noise import Noise
from optics.scene.loader import Scene
from optics.skin.cloud import lots

# small pixels at high gain, 2.5 DN of noise in the dark and 4 at 150; a frame is the mean of 16
CAMERA = Noise(system_gain=0.005, dark_noise=0.625, black_level=8.0, saturation=255.0, prnu=0.0)
MAKERS = (
    "lens vignetting",
    "lens blur",
    "defocus",
    "excitation leak",
    "inner filter",
    "bleaching",
    "bead settling",
    "bead size spread",
    "refraction at the window",
    "finite layer",
    "interreflection",
)
SIDE = 20  # rays of a pixel each way
RINGS, STEPS, ANGLES = 24, 6, 16  # of a contact: flat punches, radii in each, angles


class ParticleMaker:
    """Makes frames of a particle gel's values with hidden effects {name: strength} or none.

    effects   lens vignetting  power of cos^4;            lens blur         px^2, of a Gaussian along each axis
              defocus          mm^2, area of the pupil;   excitation leak   share of the last band in the one before
              inner filter     1/mm, absorption of the dye at its peak;     bleaching   per unit of time
              bead settling    mm, of the mean bead;      bead size spread  relative
              refraction at the window  index of the gel over that of the base, less 1
              finite layer     share of the way from a half-space to a layer on a rigid base
              interreflection  scale of the light that beads and cover send to one another (scattering by beads)
    """

    def __init__(
        self,
        scene: Scene,
        values: Mapping[str, float] | None = None,
        effects: Mapping[str, float] | None = None,
        noise=CAMERA,
        seed: int = 0,
        side: int = SIDE,
    ):
        self.values, self.effects = {**scene.values(), **(values or {})}, dict(effects or {})
        unknown = set(self.effects) - set(MAKERS)
        if unknown:
            raise ValueError(f"no independent way to make {', '.join(sorted(unknown))}; known: {', '.join(MAKERS)}")
        self.noise, self.seed = noise, seed
        self.side = round(1.5 * side) if "defocus" in self.effects else side  # rays that cross a pupil scatter
        self.size, self.bands = scene.camera.resolution, np.array(scene.integrator.bands)
        self.camera_z = float(scene.camera.columns[3].z[0])
        beads = scene.parts["beads"]
        self.drawn, self.draw_seed, self.rings = (
            beads.drawn,
            beads.seed,
            {n: led.count for n, led in scene.leds.items()},
        )
        v = self.values
        spread = self.effects.get("bead size spread", 0.0)
        self.diameters = v["beads.diameter"] * np.maximum(1 + spread * lots(len(self.drawn), self.draw_seed), 0.1)
        self.index = 1 + self.effects.get("refraction at the window", 0.0)

    # -- places -------------------------------------------------------------------------------------------------------
    def rest(self) -> np.ndarray:
        """(N, 3) middles of the balls at rest, mm."""
        v = self.values
        box = np.array([v["beads.width"], v["beads.length"], v["beads.bottom"] - v["beads.top"] + v["beads.diameter"]])
        at = (self.drawn - [0.5, 0.5, 0.0]) * (box - v["beads.diameter"])
        way = np.radians(v["beads.gravity"])
        sunk = self.effects.get("bead settling", 0.0) * (self.diameters / v["beads.diameter"]) ** 2
        at = np.stack([at[:, 0] + sunk * np.cos(way), at[:, 1] + sunk * np.sin(way), -v["beads.top"] - at[:, 2]], 1)
        return at

    def loads(self, press: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """(K, 2) places and (K,) forces over E, mm^2, of a ball pressed in by press[2] mm at press[:2]."""
        x, y, depth = press
        ball = self.values["gel.tip_radius"]
        sink = lambda c: c * np.arctanh(c / ball)  # noqa: E731 (depth at which the contact has the radius c)
        low, high = 0.0, ball * (1 - 1e-12)
        for _ in range(80):
            middle = (low + high) / 2
            low, high = (middle, high) if sink(middle) < depth else (low, middle)
        edges = np.linspace(0, low, RINGS + 1)
        c = (edges[1:] + edges[:-1]) / 2
        force = 2 * c * np.diff(sink(edges)) / (1 - 0.25)  # of a flat punch over E: 2 a delta/(1 - nu^2)
        q = (np.arange(STEPS) + 0.5) / STEPS  # share of a punch's force within r: 1 - sqrt(1 - r^2/c^2)
        r = c[:, None] * np.sqrt(1 - (1 - q) ** 2)
        angle = 2 * np.pi * (np.arange(ANGLES) + 0.5) / ANGLES
        at = np.stack([x + r[..., None] * np.cos(angle), y + r[..., None] * np.sin(angle)], -1)
        return at.reshape(-1, 2), np.broadcast_to(force[:, None, None], at.shape[:3]).ravel() / (STEPS * ANGLES)

    def moved(self, points: np.ndarray, press: Sequence[float]) -> np.ndarray:
        """(N, 3) points (N, 3) of the skin under a press: 3 F/(4 pi E R) (x h/R^2, y h/R^2, 1 + h^2/R^2)."""
        if press[2] == 0:
            return points
        places, forces = self.loads(press)
        found = points.copy()
        height = self.values["gel.cover"] - points[:, 2]
        for start in range(0, len(points), 500):
            some = slice(start, start + 500)
            x, y = (points[some, i, None] - places[:, i] for i in (0, 1))
            h = height[some, None]
            r = np.sqrt(x**2 + y**2 + h**2)
            size = 3 * forces / (4 * np.pi * r)
            found[some] += np.stack([(size * x * h / r**2).sum(1), (size * y * h / r**2).sum(1), 0 * h[:, 0]], 1)
            found[some, 2] -= (size * (1 + h**2 / r**2)).sum(1)
        share = self.effects.get("finite layer", 0.0)
        return found + share * (self.moved_in_layer(points, press) - found) if share else found

    def moved_in_layer(self, points: np.ndarray, press: Sequence[float]) -> np.ndarray:
        """(N, 3) the same in an incompressible layer that sticks to a rigid base at the height 0 and is h thick.

        With u_z = int w J0(k r) k dk and, as no volume changes, u_r = -int w_z/k J1(k r) k dk:
        w = B (k z cosh kz - sinh kz) + D k z sinh kz, no shear at the top, w_zz + k^2 w = 0, and the pressure's
        transform -q = mu (3 w_z - w_zzz/k^2)."""
        from scipy.special import j0, j1

        places, forces = self.loads(press)
        away = np.hypot(*(places - np.asarray(press[:2])).T)
        h = self.values["gel.cover"] + self.values["gel.thickness"]
        step = 0.02
        k = step * (np.arange(1000) + 0.5)[:, None]  # 1/mm, to 20: exp(-20 cover) is left
        q = (j0(k * away) @ forces)[:, None] / (2 * np.pi)  # over E
        s, c, t = np.sinh(k * h), np.cosh(k * h), k * h
        # of the two solutions: w_zz + k^2 w over k^2, and mu (3 w_z - w_zzz/k^2) over mu k
        top = 2 * t * c, 2 * t * s + 2 * c
        normal = 3 * t * s - (t * s + 2 * c), 3 * (s + t * c) - (t * c + 3 * s)
        b = -3 * q / k / (normal[0] - normal[1] * top[0] / top[1])  # mu = E/3
        d = -b * top[0] / top[1]
        z = points[:, 2] + self.values["gel.thickness"]
        x, y = points[:, 0] - press[0], points[:, 1] - press[1]
        r = np.maximum(np.hypot(x, y), 1e-9)
        found = points.copy()
        for start in range(0, len(points), 400):
            some = slice(start, start + 400)
            at = np.clip(z[some], 0, h)
            s, c, t = np.sinh(k * at), np.cosh(k * at), k * at
            w, slope = b * (t * c - s) + d * t * s, k * (b * t * s + d * (s + t * c))
            up = (w * j0(k * r[some]) * k).sum(0) * step
            out = -(slope * j1(k * r[some])).sum(0) * step
            found[some] += np.stack([out * x[some] / r[some], out * y[some] / r[some], up], 1)
        return found

    def face(self, press: Sequence[float]):
        """Height of the gel's face as a spline of x and y, mm."""
        from scipy.interpolate import RectBivariateSpline

        axis = np.linspace(-15, 15, 101)
        grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
        at = self.moved(np.column_stack([grid, np.zeros(len(grid))]), press)
        return RectBivariateSpline(axis, axis, at[:, 2].reshape(101, 101))

    # -- rays ---------------------------------------------------------------------------------------------------------
    def rays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Origins, directions (N, 3) and angles from the axis (N,) of all rays, those of a pixel behind each other."""
        v, (width, height) = self.values, self.size
        n = self.side**2
        # the R2 sequence, shifted at random from pixel to pixel: no two rays of a pixel share a row or a column, so
        # that a rim that moves by a thousandth of a pixel changes it by as much
        shift = np.random.default_rng([self.seed, 9]).random((2, width * height)).repeat(n, axis=1)
        k = np.tile(np.arange(n), width * height)
        pixel = np.arange(width * height).repeat(n)
        across, down = ((k * step + own) % 1.0 for step, own in zip((0.7548776662466927, 0.5698402909980532), shift))
        row, column = pixel // width, pixel % width
        self.places = across.reshape(height, width, n), down.reshape(height, width, n)  # of rays in their pixels
        focal = width / 2 / np.radians(v["camera.x_fov"] / 2)
        x = (column + across - width / 2 - v["camera.principal_x"]) / focal
        y = (row + down - height / 2 - v["camera.principal_y"]) / focal
        theta = np.hypot(x, y)
        sine = np.sinc(theta / np.pi)
        d = np.stack([x * sine, y * sine, np.cos(theta)], 1)
        o = np.zeros_like(d) + [v["camera.x"], v["camera.y"], self.camera_z + v["camera.z"]]
        area = self.effects.get("defocus", 0.0)
        if area:
            rng = np.random.default_rng([self.seed, 5])
            # equal areas in radius and angle, by further irrational steps, shifted from pixel to pixel
            shift = rng.random((2, width * height)).repeat(n, axis=1)
            radius = np.sqrt((k * 0.6180339887498949 + shift[0]) % 1.0 * area / np.pi)
            angle = 2 * np.pi * (k * 0.4142135623730951 + shift[1])
            side = np.cross(d, [0.0, 1.0, 0.0])
            side /= np.linalg.norm(side, axis=1, keepdims=True)
            up = np.cross(d, side)
            shift = radius[:, None] * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * up)
            d = v["camera.focus"] * d - shift
            d /= np.linalg.norm(d, axis=1, keepdims=True)
            o = o + shift
        if self.index != 1:
            o = o + d * ((-v["gel.thickness"] - o[:, 2]) / d[:, 2])[:, None]
            d = d / [self.index, self.index, 1.0]
            d[:, 2] = np.sqrt(1 - d[:, 0] ** 2 - d[:, 1] ** 2)
        return o, d, theta

    def met(self, o, d, centres, face) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Places (N, 3), normals (N, 3) and numbers (N,) of what rays meet: a ball, or -1 for the face."""
        width, height = self.size
        far, number = np.full(len(d), np.inf), np.full(len(d), -1)
        middle, eye = d.reshape(height, width, -1, 3).mean(2), o.reshape(height, width, -1, 3).mean(2)
        middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
        wide = 1.5 / (width / np.radians(self.values["camera.x_fov"]))  # rad: a pixel and a half
        nearest = np.linalg.norm(centres[:, None] - eye.reshape(1, -1, 3)[:, ::37], axis=-1).min()
        wide *= max(1.0, 15.0 / nearest)  # from the base's face, balls are nearer and a pixel is as wide
        wide += np.sqrt(self.effects.get("defocus", 0.0) / np.pi) / nearest  # the pupil's radius at the nearest balls
        rows = np.arange(len(d)).reshape(height, width, -1)
        for k, (centre, size) in enumerate(zip(centres, self.diameters / 2)):
            to = centre - eye
            distance = np.linalg.norm(to, axis=-1)
            along = (middle * to).sum(-1) / distance
            near = rows[along > np.cos(np.arcsin(np.minimum(size / distance, 1.0)) + wide)].ravel()
            b = ((o[near] - centre) * d[near]).sum(1)
            root = b**2 - ((o[near] - centre) ** 2).sum(1) + size**2
            t = np.where(root > 0, -b - np.sqrt(np.maximum(root, 0)), np.inf)
            closer = t < far[near]
            far[near[closer]], number[near[closer]] = t[closer], k
        return self.ends(o, d, far, number, centres, face)

    def ends(self, o, d, far, number, centres, face) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Places, normals and numbers of what rays meet that go so far to balls; the others go to the face."""
        free = number < 0
        t = -o[free, 2] / d[free, 2]
        for _ in range(4):  # the face is all but flat
            p = o[free] + t[:, None] * d[free]
            t = t + (face(p[:, 0], p[:, 1], grid=False) - p[:, 2]) / d[free, 2]
        far[free] = t
        p = o + far[:, None] * d
        normal = np.empty_like(p)
        normal[~free] = (p[~free] - centres[number[~free]]) / (self.diameters[number[~free]] / 2)[:, None]
        slope = [face(p[free, 0], p[free, 1], dx=i, dy=1 - i, grid=False) for i in (1, 0)]
        normal[free] = np.stack([slope[0], slope[1], -np.ones(free.sum())], 1)
        normal[free] /= np.linalg.norm(normal[free], axis=1, keepdims=True)
        return p, normal, number

    # -- light --------------------------------------------------------------------------------------------------------
    def lamps(self, ring: str) -> np.ndarray:
        """(n, 3) places of a ring's LEDs, which look along z, mm."""
        v, n = self.values, self.rings[ring]
        angle = 2 * np.pi * np.arange(n) / n + np.radians(v[f"{ring}.roll"])
        at = np.stack([v[f"{ring}.radius"] * np.cos(angle), v[f"{ring}.radius"] * np.sin(angle), 0 * angle], 1)
        return at + [v[f"{ring}.{c}"] for c in "xyz"]

    def irradiance(self, ring: str, p, normal, number, centres, view) -> tuple[np.ndarray, np.ndarray]:
        """(N,) irradiance that one ring at power 1 brings to places, and what of it a dye in the gel leaves on both
        ways, per band (N, B)."""
        v, total, left = self.values, np.zeros(len(p)), np.zeros((len(p), len(self.bands)))
        dye = self.effects.get("inner filter", 0.0)
        absorbed = dye * np.exp(-4 * np.log(2) * ((self.bands - v["gel.dye_peak"]) / v["gel.dye_fwhm"]) ** 2)
        own = dye * np.exp(-4 * np.log(2) * ((v[f"{ring}.wavelength"] - v["gel.dye_peak"]) / v["gel.dye_fwhm"]) ** 2)
        groups = [np.flatnonzero(number == k) for k in range(-1, len(centres))]
        for lamp in self.lamps(ring):
            to = lamp - p
            distance = np.linalg.norm(to, axis=1)
            to /= distance[:, None]
            sent = np.maximum(-to[:, 2], 0) ** v[f"{ring}.mu"] / distance**2
            if self.index != 1:
                to, sent = self.bent(p, lamp, v[f"{ring}.mu"])
            light = np.maximum((normal * to).sum(1), 0) * sent
            for k, group in enumerate(groups, -1):
                self._shade(light, group, k, p, to, lamp, centres)
            light /= self.rings[ring]
            total += light
            way = gel_length(p, to, distance, v["gel.thickness"])
            left += light[:, None] * np.exp(-own * way[:, None] - absorbed * view[:, None])
        return total, left

    def bent(self, p, lamp, mu: float) -> tuple[np.ndarray, np.ndarray]:
        """Unit vectors along which the light of a lamp comes through the base's face, and its power per area across
        them: power cos^mu(a) dOmega/dA, as rho = h tan a + depth tan b and sin a = index sin b."""
        base = -self.values["gel.thickness"]
        h, depth = base - lamp[2], np.maximum(p[:, 2] - base, 1e-6)
        side = lamp[:2] - p[:, :2]
        rho = np.maximum(np.linalg.norm(side, axis=1), 1e-9)
        a = np.arctan(rho / (h + depth))
        for _ in range(6):
            b = np.arcsin(np.minimum(np.sin(a) / self.index, 0.999999))
            grown = h / np.cos(a) ** 2 + depth / np.cos(b) ** 3 * np.cos(a) / self.index
            a = a - (h * np.tan(a) + depth * np.tan(b) - rho) / grown
        b = np.arcsin(np.minimum(np.sin(a) / self.index, 0.999999))
        to = np.column_stack([side * (np.sin(b) / rho)[:, None], -np.cos(b)])
        return to, np.cos(a) ** mu * np.sin(a) / (rho * grown * np.cos(b))

    def _shade(self, light, group, k: int, p, to, lamp, centres) -> None:
        """Take the light away from places of one body that other balls shade."""
        if not len(group):
            return
        around = p[group].mean(0) if k >= 0 else None
        for m, centre in enumerate(centres):
            if m == k:
                continue
            r = self.diameters[m] / 2
            if around is not None:  # a ball in the way of a lamp to another ball lies near the line between them
                line = lamp - around
                s = np.clip((centre - around) @ line / (line @ line), 0, 1)
                if np.linalg.norm(centre - around - s * line) > r + self.diameters[k] / 2:
                    continue
                some = group
            else:
                scale = (lamp[2] - 0.0) / (lamp[2] - centre[2])  # where the shadow falls on the face
                spot = lamp + (centre - lamp) * scale
                some = group[np.abs(p[group, 0] - spot[0]) < 3 * r]
                some = some[np.abs(p[some, 1] - spot[1]) < 3 * r]
            if not len(some):
                continue
            away = centre - p[some]
            along = (away * to[some]).sum(1)
            light[some[(along > 0) & ((away**2).sum(1) - along**2 < r**2)]] = 0.0

    def radiance(self, press: Sequence[float]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Of each ring at power 1: (H, W, B) radiance by reflection, and by fluorescence."""
        v, (width, height) = self.values, self.size
        o, d, theta = self.rays()
        centres, face = self.moved(self.rest(), press), self.face(press)
        p, normal, number = self.met(o, d, centres, face)
        view = gel_length(p, -d, np.full(len(p), np.inf), v["gel.thickness"])
        fall = np.cos(theta) ** (4 * self.effects.get("lens vignetting", 0.0)) / self.index**2
        ball = number >= 0
        nm = np.linspace(200, 900, 14001)
        bell = lambda x, peak, fwhm: np.exp(-4 * np.log(2) * ((x - peak) / fwhm) ** 2)  # noqa: E731
        made = bell(nm, v["dye.emission_peak"], v["dye.emission_fwhm"])
        photons = bell(self.bands, v["dye.emission_peak"], v["dye.emission_fwhm"]) / np.trapezoid(made, nm)
        found = {}
        for ring in self.rings:
            _, light = self.irradiance(ring, p, normal, number, centres, view)
            sent = bell(nm, v[f"{ring}.wavelength"], v[f"{ring}.fwhm"])
            taken = v["dye.absorptance"] * bell(nm, v["dye.absorption_peak"], v["dye.absorption_fwhm"])
            excited = v["dye.yield"] / np.pi * np.trapezoid(sent * taken * nm, nm) * photons / self.bands
            seen = bell(self.bands, v[f"{ring}.wavelength"], v[f"{ring}.fwhm"])
            images = [self.rho(ball) / np.pi * light * seen, ball[:, None] * excited * light]
            if self.effects.get("interreflection", 0.0):
                more = self.bounced(ring, p, normal, number, centres, face, seen, excited)
                images = [i + self.effects["interreflection"] * m for i, m in zip(images, more)]
            found[ring] = tuple(
                self.behind_lens((fall[:, None] * image).reshape(height, width, -1, len(self.bands)))
                for image in images
            )
        return found

    def rho(self, ball: np.ndarray) -> np.ndarray:
        """(N, B) reflectances of balls and of the cover."""
        v = self.values
        return np.where(ball[:, None], [v[f"dye.rho_{c}"] for c in "rgb"], [v[f"cover.rho_{c}"] for c in "rgb"])

    def bounced(self, ring: str, p, normal, number, centres, face, seen, excited) -> tuple[np.ndarray, np.ndarray]:
        """(N, B) reflected and shining radiance by light that came over one other place, in a random direction of each
        ray: what that place sends is reflected, and its excitation excites again."""
        rng = np.random.default_rng([self.seed, 7])
        z, angle = 2 * rng.random(len(p)) - 1, 2 * np.pi * rng.random(len(p))
        # a point of a ball's face about the normal's end: its direction has the cosine's law
        d = normal + np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], 1)
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        far, met = np.full(len(p), np.inf), np.full(len(p), -1)
        for k, (centre, size) in enumerate(zip(centres, self.diameters / 2)):
            to = p - centre
            b = (to * d).sum(1)
            root = b**2 - (to**2).sum(1) + size**2
            t = np.where((root > 0) & (number != k), -b - np.sqrt(np.maximum(root, 0)), np.inf)
            closer = (t > 0) & (t < far)
            far[closer], met[closer] = t[closer], k
        there = (met >= 0) | ((number >= 0) & (d[:, 2] > 1e-3))  # the face sends nothing to itself
        mirrored, shone = np.zeros((2, len(p), len(self.bands)))
        q, own, other = self.ends(p[there], d[there], far[there], met[there], centres, face)
        inside = (np.abs(q[:, :2]) < self.values["gel.width"] / 2).all(1)[:, None]
        light = inside * self.irradiance(ring, q, own, other, centres, np.zeros(len(q)))[1]
        ball, first = other >= 0, number[there] >= 0
        arrived = self.rho(ball) / np.pi * light * seen + ball[:, None] * excited * light
        mirrored[there] = self.rho(first) * arrived
        shone[there] = first[:, None] * excited * self.rho(ball)[:, 2:] * light[:, 2:]
        return mirrored, shone

    # -- camera -------------------------------------------------------------------------------------------------------
    def behind_lens(self, light: np.ndarray) -> np.ndarray:
        """(H, W, B) of the light (H, W, N, B) of all rays. A blur spreads each by a Gaussian about its place: a pixel
        gets differences of two error functions of it. Beyond the borders the image is mirrored."""
        from scipy.special import ndtr

        if "lens blur" not in self.effects:
            return light.mean(2)
        sd, (width, height) = np.sqrt(self.effects["lens blur"]), self.size
        reach = int(np.ceil(6 * sd)) + 1
        around = ((reach, reach), (reach, reach), (0, 0))
        light = np.pad(light, (*around, (0, 0)), "symmetric")
        x, y = (np.pad(place, around, "symmetric") for place in self.places)
        for side in (slice(None, reach), slice(-reach, None)):
            x[:, side], y[side] = 1 - x[:, side], 1 - y[side]
        steps = np.arange(-reach, reach + 1)  # to pixels that a ray's light falls on
        total = np.zeros((height + 4 * reach, width + 4 * reach, light.shape[-1]))
        for row in range(len(light)):
            right = ndtr((steps + 1 - x[row][..., None]) / sd) - ndtr((steps - x[row][..., None]) / sd)
            down = ndtr((steps + 1 - y[row][..., None]) / sd) - ndtr((steps - y[row][..., None]) / sd)
            sent = (light[row][:, :, None] * right[..., None]).reshape(*right.shape[:2], -1)
            fallen = (down.swapaxes(1, 2) @ sent).reshape(-1, len(steps), len(steps), light.shape[-1]) / right.shape[1]
            for i in range(len(steps)):
                for j in range(len(steps)):
                    total[row + i, j : j + len(fallen)] += fallen[:, i, j]
        return total[2 * reach : -2 * reach, 2 * reach : -2 * reach]

    def photograph(self, radiance: np.ndarray, rng) -> np.ndarray:
        """(H, W, B) noisy, quantised DN."""
        n, image = self.noise, radiance
        if "excitation leak" in self.effects:
            image = image.copy()
            image[..., 1] += self.effects["excitation leak"] * image[..., 2]
        signal = n.black_level + (n.saturation - n.black_level) * self.values["camera.exposure"] * image
        return n.expose(signal, rng).astype(np.float32)

    def captures(self, presses: Sequence[Sequence[float]]) -> capture_files.Captures:
        """Frames of every press (x, y, depth in mm), a group each, lit by one ring after the other; `time` goes on by 1
        from frame to frame."""
        rng = np.random.default_rng([self.seed, 3])
        kept: dict[tuple, dict] = {}
        frames: list[capture_files.Frame] = []
        for k, press in enumerate(presses):
            key = tuple(float(c) for c in press)
            light = kept.setdefault(key, None) or self.radiance(press)
            kept[key] = light
            for ring, (mirrored, shone) in light.items():
                time = float(len(frames))
                left = np.exp(-self.effects.get("bleaching", 0.0) * time)
                settings = {f"gel.press_{n}": c for n, c in zip(("x", "y", "depth"), key)}
                settings |= {f"{n}.power": float(n == ring) for n in self.rings}
                settings["dye.time"] = time
                image = self.photograph(self.values[f"{ring}.power"] * (mirrored + left * shone), rng)
                name = f"press{k:02d}-{ring}"
                frames.append(
                    capture_files.Frame(name, image, None, f"press-{k:02d}", settings, [], f"frames/{name}.png")
                )
        known = {"camera.exposure": float(self.values["camera.exposure"]), "cover.sigma": 0.0}
        return capture_files.Captures(Path("."), "particle_gel", frames, known, self.noise, None, None, "DN", None, [])


def gel_length(p: np.ndarray, d: np.ndarray, longest: np.ndarray, thickness: float) -> np.ndarray:
    """(N,) mm of straight ways from places p along unit vectors d, that leave the gel at z = -thickness."""
    inside = np.maximum(p[:, 2] + thickness, 0) / np.maximum(-d[:, 2], 1e-9)
    return np.minimum(inside, longest)
