"""Where the shape of what is seen is known: in the contact, on the level face far from it, and of a gel at rest.

A gel that a body of known shape presses has that body's shape where they touch, and far away it is level as it was;
between the two its skin hangs free, and its shape is a model as well. `region = "known"` fits and judges a model where
only the optics can fail:

    plate of balls     INNER radii around the middle of each ball that is whole in view; and where four balls are as far
                       as can be, where the skin is level by symmetry: APART of their spacing from each, and two radii
    other indenters    where the indenter touches the face; and FAR contact radii away from there
    at rest            all of the image

A contact alone does not tell a lamp's gain from light that only the contact returns; the level face does. All is
as the poses say that the captures state: no fit changes it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from optics.light.renderer import everywhere
from optics.scene.parameter import Values

if TYPE_CHECKING:
    from optics.fit.scene_model import SceneModel

ALL, KNOWN = "all", "known"
REGIONS = (ALL, KNOWN)
INNER = 0.65  # of a ball's radius: well inside the contact
APART = 0.58  # of the spacing of balls, from the middle of each: near the middle of four, which is .71 away
FAR = 2.0  # contact radii from a contact's edge
MOST_BALLS = 40  # on either side of the plate's first ball


def is_plate(model: SceneModel, index: int) -> bool:
    """Whether a plate of balls is pressed in a frame."""
    gel = model.scene.gel
    return gel is not None and model.at(Values(), index).get(f"{gel.name}.indenter") == "balls"


def known_shape(model: SceneModel, index: int) -> np.ndarray:
    """(H, W) bool: the contact and the level face; of a frame in which nothing is pressed, all."""
    from scipy.ndimage import distance_transform_edt

    now, gel = model.at(Values(), index), model.scene.gel.name
    depth = model.scene.key(gel, "press depth")
    if depth and not float(now[depth]) > 0:
        return np.ones(model.shape[:2], bool)
    touched = contact(model, index)
    if is_plate(model, index):
        radius, spacing = float(now[f"{gel}.indenter_size"]), float(now[f"{gel}.indenter_spacing"])
        return touched | (np.linalg.norm(on_balls(model, index)[0], axis=-1) > max(APART * spacing / radius, 2.0))
    if not touched.any():
        return touched
    return touched | (distance_transform_edt(~touched) > FAR * math.sqrt(touched.sum() / math.pi))


def contact(model: SceneModel, index: int) -> np.ndarray:
    """(H, W) bool: what touches the indenter, at the pose that the captures state."""
    now, renderer = model.at(Values(), index), model.renderer
    if is_plate(model, index):
        offset, whole = on_balls(model, index)
        return whole & (np.linalg.norm(offset, axis=-1) < INNER)
    with everywhere(renderer):
        hits = renderer.hits(now)
    x, y = (np.where(hits.valid, hits.position[..., k], 0) for k in (0, 1))
    return (renderer.contact_weight(now, x.ravel(), y.ravel()).reshape(hits.shape) > 0.5) & hits.valid


def on_balls(model: SceneModel, index: int) -> tuple[np.ndarray, np.ndarray]:
    """((H, W, 2) offset on the untouched face from the nearest ball's middle over the radius, (H, W) bool: that ball is
    whole in view)."""
    now, gel = model.at(Values(), index), model.scene.gel.name
    with everywhere(model.renderer):
        face = model.renderer.hits(model.untouched(dict(now))).position[..., :2]
    return _nearest_ball(face, now, gel)


def _nearest_ball(face: np.ndarray, now: Mapping, gel: str) -> tuple[np.ndarray, np.ndarray]:
    """`on_balls` of points on the face, (H, W, 2) mm."""
    radius, spacing = float(now[f"{gel}.indenter_size"]), float(now[f"{gel}.indenter_spacing"])
    turn = math.radians(float(now[f"{gel}.press_rz"]))
    press = np.array([float(now[f"{gel}.press_{axis}"]) for axis in "xy"])
    rotation = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])  # of rows
    place = np.rint((face - press) @ np.linalg.inv(rotation) / spacing)
    place = np.clip(place, -MOST_BALLS, MOST_BALLS)
    middle = press + place @ rotation * spacing
    low, high = face.min((0, 1)), face.max((0, 1))
    whole = ((middle - radius >= low) & (middle + radius <= high)).all(-1)
    return (face - middle) / radius, whole


def contact_in_words(plate: bool) -> str:
    """The contact in words."""
    return f"{INNER:g} radii of each whole ball" if plate else "where the indenter touches"
