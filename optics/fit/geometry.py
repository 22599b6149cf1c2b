"""What a scene knows of every pixel of a frame: coordinates along which residuals are binned.

Angles in degrees, lengths in mm, world coordinates with z from the camera towards the skin."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from optics.light.renderer import everywhere
from optics.scene.parameter import Values

if TYPE_CHECKING:
    from optics.fit.scene_model import SceneModel
    from optics.light.samples import Hits

DISTANCES = 8  # LEDs up to which the distance to each is a coordinate of its own: more would be as many fine maps
FLAT = 1.0  # deg of slope below which the direction of the slope is noise


def coordinates(model: SceneModel, values: Values, index: int, seed: int = 0) -> dict[str, np.ndarray]:
    """name -> (H, W), units in `optics.fit.compare.UNITS`; boolean for a region, NaN where a pixel has no value.

    Of a sweep of readings, (N, 1): only intensity, the set values and the row in the table tell readings apart."""
    now = model.turn_to(values, index)
    intensity = model.intensity(now, index, seed)
    if model.captures.table is not None:
        frame = model.frames[index]
        count = frame.image.shape[0]
        return {
            "intensity": intensity,
            "far": np.ones((count, 1), bool),
            "reading": np.asarray(frame.rows)[..., 0],
            "frame": np.full((count, 1), float(index)),
            **{k: v[..., 0] for k, v in frame.readings.items()},
        }
    with everywhere(model.renderer):
        hits = model.renderer.hits(now)
    view = model.developer.view(now)
    emission = _inclination(_to_camera(hits), hits.normal)
    incidence, distance, shadow, rim = _light(model, now, hits)
    known = {
        "radius": view.tan * view.focal,
        "row": view.v,
        "column": view.u,
        "emission": emission,
        "incidence": incidence,
        "led_distance": distance,
        "intensity": intensity,
        "shadow": shadow,
        "rim": rim,
        "frame": np.full(hits.shape, float(index)),
    }
    if view.site is not None:
        known["site"] = np.degrees(view.site)
    if model.scene.gel is not None:
        known.update(_press(model, now, hits, emission))
    known["far"] = ~(known.get("contact", shadow) | rim | shadow) & hits.valid
    return known


def _light(model: SceneModel, now: Mapping, hits: Hits) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(H, W) each: incidence of the LED that is brightest in a pixel, distance to it, shadow of any, rims."""
    shadow, rim = np.zeros(hits.shape, bool), hits.edges.copy()
    incidence, distance, best = np.full(hits.shape, np.nan), np.full(hits.shape, np.nan), np.zeros(hits.shape)
    places = model.scene.places_of(now)
    for led, power in model.lit(now).items():
        if led in model.scene.sources:
            continue
        around, lit = model.renderer.shadows(now, led)
        shadow |= ~lit & hits.valid
        rim |= around
        to = places[led] - hits.position
        strength = (power * model.renderer.image(now, led)).sum(-1)
        brightest = strength > best
        best = np.where(brightest, strength, best)
        incidence = np.where(brightest, _inclination(to, hits.normal), incidence)
        distance = np.where(brightest, np.linalg.norm(to, axis=-1), distance)
    return incidence, distance, shadow, rim & hits.valid


def _press(model: SceneModel, now: Mapping, hits: Hits, emission: np.ndarray) -> dict[str, np.ndarray]:
    """What the shape of the pressed gel gives each pixel, and how far the contact is (px)."""
    from scipy.ndimage import distance_transform_edt

    p, n = hits.position, hits.normal
    x, y = (np.where(hits.valid, p[..., i], 0) for i in (0, 1))
    touch = model.renderer.contact_weight(now, x.ravel(), y.ravel()).reshape(hits.shape) > 0.5
    return {
        "height": np.where(hits.valid, -p[..., 2], 0),
        "slope": _slope(n),
        "contact": touch & hits.valid,
        "curvature": np.gradient(n[..., 0], axis=1) + np.gradient(n[..., 1], axis=0),
        "contact_distance": distance_transform_edt(~touch) if touch.any() else np.full(hits.shape, np.nan),
        # a grazing view, of which a camera sees next to nothing, would give a path without end: 0.001 bounds it
        "gel_path": np.array(model.scene.gel.numbered("thickness") + p[..., 2])
        / np.maximum(np.cos(np.radians(emission)), 1e-3),
    }


def lit_geometry(model: SceneModel, values: Values, frame: int) -> dict[str, np.ndarray]:
    """name -> (H, W): how the LED that is brightest in a pixel stands to the surface, and the distance to each LED.

    half_angle      deg, between the normal and the bisector of the directions to LED and camera: 0 at a mirror's glint
    led_angle       deg, between the axis of the LED and the direction to the pixel: the angle of the lobe
    light_azimuth   deg, between the downhill direction and that to the LED, seen along z; NaN where the slope is below
                    FLAT
    press_distance  mm, from the centre of the press along the skin
    depth           mm, from the camera; only in scenes without a gel
    NAME.distance   mm, from this LED, NaN in frames where it is off; only in scenes of at most DISTANCES LEDs
    Empty for readings in a table.
    """
    if model.captures.table is not None:
        return {}
    now, scene, renderer = model.turn_to(values, frame), model.scene, model.renderer
    with everywhere(renderer):
        hits = renderer.hits(now)
    p, n = hits.position, hits.normal
    eye = _to_camera(hits)
    to_camera = _unit(eye)
    found = {"depth": np.where(hits.valid, np.linalg.norm(eye, axis=-1), np.nan)} if scene.gel is None else {}
    best, toward, axis = np.full(hits.shape, -1.0), np.zeros(p.shape), np.zeros(p.shape)
    at = scene.places_of(now)
    on = model.lit(now)
    for led, power in on.items():
        if led not in at:
            continue
        strength = (power * renderer.image(now, led)).sum(-1)
        brighter = strength > best
        best = np.where(brighter, strength, best)
        toward[brighter] = _unit(at[led] - p)[brighter]
        axis[brighter] = _axis(scene.leds[led], *(now[scene.key(led, f"light {turn}")] for turn in ("pan", "tilt")))
    lit = (best > 0) & hits.valid
    # a dark frame gets NaN, not nothing: a coordinate that one frame lacks is dropped for all
    found["half_angle"] = np.where(lit, _angle(n, _unit(toward + to_camera)), np.nan)
    found["led_angle"] = np.where(lit, _angle(-toward, axis), np.nan)
    found["light_azimuth"] = np.where(lit & (_slope(n) > FLAT), _angle(_flat(n), _flat(toward)), np.nan)
    if scene.gel is not None:
        press = [scene.key(scene.gel.name, f"press {axis}") for axis in "xy"]
        if all(press):
            found["press_distance"] = np.hypot(*(p[..., i] - float(now[key]) for i, key in enumerate(press)))
    if 1 < len(at) <= DISTANCES:
        found.update(
            {
                f"{led}.distance": np.where(hits.valid & (led in on), np.linalg.norm(place - p, axis=-1), np.nan)
                for led, place in at.items()
            }
        )
    return found


def _axis(led, pan: float, tilt: float) -> np.ndarray:
    """Unit vector of the direction in which an LED is brightest."""
    side, up, ahead = (np.array([float(c[0]) for c in axis]) for axis in led.frame)
    return _unit(ahead + np.tan(np.radians(float(pan))) * side + np.tan(np.radians(float(tilt))) * up)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


def _flat(v: np.ndarray) -> np.ndarray:
    return _unit(v * (1, 1, 0))


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1)))


def _inclination(to: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """deg, (H, W): between vectors of any length and unit normals."""
    cos = (to * normal).sum(-1) / np.maximum(np.linalg.norm(to, axis=-1), 1e-9)
    return np.degrees(np.arccos(np.clip(cos, -1, 1)))


def _slope(normal: np.ndarray) -> np.ndarray:
    """deg, (H, W): of the surface against the resting skin, whose normal is -z."""
    return np.degrees(np.arccos(np.clip(-normal[..., 2], -1, 1)))


def _to_camera(hits: Hits) -> np.ndarray:
    """(H, W, 3) mm, from a hit to where its ray began: one point, or one for each pixel."""
    origin = np.array(hits.origin)
    return (origin.T.reshape(hits.position.shape) if origin.size == hits.position.size else origin) - hits.position
