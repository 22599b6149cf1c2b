"""Places on a board of LEDs in numbers: what the part `board` computes in a scene, for values that no scene has."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np


def on_board(at: np.ndarray, turn: float, pose: Mapping[str, float]) -> np.ndarray:
    """(3,) mm: where a point (3,) of the board's frame stands, turned by `turn` (deg) about its axis.

    pose   x, y, z (mm), rx, ry, rz (deg) and scale, as the part `board` defines them"""
    from scipy.spatial.transform import Rotation

    own = Rotation.from_euler("z", turn, degrees=True).apply(at) * np.array([pose["scale"], pose["scale"], 1.0])
    turned = Rotation.from_euler("xyz", [pose["rx"], pose["ry"], pose["rz"]], degrees=True).apply(own)
    return np.array([pose["x"], pose["y"], pose["z"]]) + turned
