"""How bright a ball is that nothing shades: the renderer's own images of a few balls at a time."""

from __future__ import annotations

from typing import Any

import numpy as np

from optics.fit.painted import Canvas, Glow
from optics.fit.scene_model import SceneModel
from optics.scene.parameter import Values

APART = 6.5  # diameters between balls, so that few stand in the light of another
DRAWS = 12  # images
INNER = 0.97  # of a radius, within which the samples of a pixel must lie


def rays(model: SceneModel, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions (N, 3) of the camera's rays through places in px, behind its windows."""
    o, d, _ = model.renderer._rays(u.astype(np.float32), v.astype(np.float32))
    return np.array(o, float).T, np.array(d, float).T


def at_depth(model: SceneModel, places: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """(N, 3) mm where the lines of sight through (N, 2) px are (N,) mm below the face."""
    o, d = rays(model, *np.asarray(places, float).T)
    return o + d * ((-depths - o[:, 2]) / d[:, 2])[:, None]


def outline(model: SceneModel, middles: np.ndarray, radii: np.ndarray) -> float:
    """px: the largest radius of balls in the image."""
    away = middles - model.renderer._eye()
    side = np.cross(away, [0.0, 1.0, 0.0])
    side *= (radii / np.linalg.norm(side, axis=1))[:, None]
    camera: Any = model.scene.camera
    wide = np.linalg.norm(camera.project(middles + side) - camera.project(middles), axis=1)
    return float(np.nanmax(wide, initial=1.0))


def size(part: Any) -> float:
    """mm: the diameter of a crowd's balls in the median."""
    return 2 * float(np.median(part.balls()[1]))


def scattered(model: SceneModel, depths: tuple[float, float], diameter: float, seed: int) -> np.ndarray:
    """(N, 3) mm: places on a shifted grid in the image, APART diameters from each other, at random depths."""
    height, width = model.shape[:2]
    rng = np.random.default_rng([seed, 17])
    middle = np.array([[width / 2, height / 2]])
    two = at_depth(model, middle + [[0, 0], [1, 0]], np.full(2, depths[1]))
    step = APART * diameter / np.linalg.norm(two[1] - two[0])  # px
    cells = np.maximum(1, np.rint(np.array([width, height]) / step)).astype(int)
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in cells), indexing="ij"), -1).reshape(-1, 2)
    places = (grid + rng.uniform(0, 1, 2)) % cells / cells * [width, height]
    return at_depth(model, places, rng.uniform(*depths, len(places)))


def glow(
    model: SceneModel, name: str, values: Values, frame: int, canvas: Canvas, depths: tuple[float, float]
) -> tuple[Glow, np.ndarray]:
    """The light of balls that stand alone in a frame, and (H, W, C) of what is there without them.

    model   with as many balls as `scattered` gives"""
    part: Any = model.scene.parts[name]
    black = model.noise.black_level
    places, normals, lights, images = [], [], [], []
    for draw in range(DRAWS):
        model.scene.put(name, scattered(model, depths, size(part), draw), part.measured)
        image = model.predict(values, [frame])[0] - black
        middles, radii = part.balls()
        at = model.scene.camera.project(middles)
        pixels = canvas.around(at, outline(model, middles, radii))
        t, terms = canvas.terms(pixels, middles, INNER * radii)
        ball, box = np.nonzero(np.isfinite(t).all(-1) & (pixels >= 0))
        normal = terms[ball, box, :, 1:4].mean(1)
        places.append(middles[ball])
        normals.append(normal / np.linalg.norm(normal, axis=1)[:, None])
        lights.append(image.reshape(-1, image.shape[2])[pixels[ball, box]])
        images.append(image)
    found = Glow.fitted(*(np.concatenate(a) for a in (places, normals, lights)))
    return found, np.median(images, 0)  # each pixel shows the ground in most of the images
