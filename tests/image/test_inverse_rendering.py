"""The example of inverse rendering, as a reader runs it: plain Mitsuba, one optimizer, one image with noise."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "inverse_rendering.py"
NEAR = 0.05  # mm: what calibration asks of an LED's position; the image's noise leaves 0.001 mm, the last steps 0.02 mm
SHARE = 0.01  # of the reflectance: the same of the skin


@pytest.fixture(scope="module")
def run(mitsuba):
    from optics.scene.mitsuba_parts import use_variant

    try:
        return runpy.run_path(str(EXAMPLE))
    finally:
        use_variant()


def test_positions_are_found(run):
    found = {key: abs(run["found"][key] - run["truth"][key]) for key in run["positions"]}
    begun = {key: abs(run["guess"][key] - run["truth"][key]) for key in run["positions"]}
    assert len(found) == 18 and max(begun.values()) > 0.4
    assert max(found.values()) < NEAR, found


def test_the_reflectance_is_found(run):
    key = run["reflectance"]
    assert abs(run["guess"][key] / run["truth"][key] - 1) > 0.1
    assert abs(run["found"][key] / run["truth"][key] - 1) < SHARE


def test_the_measured_image_is_a_camera_s(run):
    """Whole numbers of 12 bit, with noise: not the image that the fit renders."""
    measured = run["measured"]
    assert (measured == np.round(measured)).all() and measured.min() >= 0 and measured.max() < 4096
    # 2 DN, less where the image is dark and the noise is cut at 0
    assert (measured - run["gain"] * run["image"]).std() > 1.5
