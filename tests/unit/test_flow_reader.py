"""Beads found and followed in rendered images, against the motion that they were given."""

import sys

import numpy as np
import pytest

from optics.readers import flow


@pytest.fixture(scope="module")
def pair(mitsuba):
    """A part of the particle gel at rest and pressed: images in DN, where the beads were (px), how far they moved."""
    pytest.importorskip("cv2")
    from optics.light.rendering import RenderJob
    from optics.scene import loader

    scene = loader.load(
        "particle_gel", {"width": "140", "height": "120", "x_fov": "26", "beads": "1500", "detail": "1"}
    )
    job, beads = RenderJob(scene, layers=()), scene.parts["beads"]
    rest, at = job.take().camera, scene.camera.project(beads.centres())
    now = job.take({"gel.press_x": 1.0, "gel.press_depth": 1.5}).camera
    moved = scene.camera.project(beads.centres()) - at
    inside = (at > 8).all(-1) & (at[:, 0] < 132) & (at[:, 1] < 112)
    return rest, now, at[inside], moved[inside]


def test_beads_are_found_and_followed(pair):
    rest, now, at, moved = pair
    keypoints = flow.find_beads(rest)
    near = np.linalg.norm(at[:, None] - keypoints, axis=-1)
    # beads of 9 px overlap: half of them are whole; those are found to a fraction of a radius
    assert np.median(near.min(1)) < 2.0 and 0.4 * len(at) < len(keypoints) < 1.3 * len(at)
    whole = near.min(0) < 1.0
    sparse = flow.sparse_flow(rest, now, keypoints)
    off = np.linalg.norm(sparse - moved[near.argmin(0)], axis=-1)[whole]
    assert np.linalg.norm(moved, axis=-1).max() > 2
    assert np.nanmedian(off) < 0.15  # px; a bead's own neighbours move by other amounts
    assert np.isnan(off).mean() < 0.2


def test_the_dense_flow_is_that_of_the_beads(pair):
    rest, now, at, moved = pair
    field = flow.dense_flow(rest, now)
    u, v = (at - 0.5).round().astype(int).T
    off = np.linalg.norm(field[v, u] - moved, axis=-1)
    assert np.median(off) < 0.15 and np.median(off) < 0.3 * np.median(np.linalg.norm(moved, axis=-1))
    size, _, count = flow.dense_bins(field, 4)
    assert count.sum() == 140 * 120 and size.max() > 0.5
    still = flow.dense_flow(rest, rest)
    assert np.abs(still).max() < 1e-3


def test_the_reader_of_a_stream_is_the_readers_of_pairs(pair):
    """Dense and sparse, in bins of whole pixels (140 x 120: 10 x 10) and of parts of pixels (9 x 9)."""
    rest, now = pair[:2]
    field, keypoints = flow.dense_flow(rest, now), flow.find_beads(rest)
    moved = flow.sparse_flow(rest, now, keypoints)
    pixels = flow.pixel_middles(rest.shape[:2])
    for bins in (10, 9):
        for kind, places, motion in (("dense", pixels, field.reshape(-1, 2)), ("sparse", keypoints, moved)):
            vectors, size, angle = flow.FlowReader(rest, kind, bins)(now)
            sizes, angles, _ = flow.bin_means(places, motion, rest.shape[:2], bins)
            # means of 168 px in float32 and in float64
            np.testing.assert_allclose(size, sizes, atol=1e-5)
            np.testing.assert_allclose(vectors, flow.bin_vectors(places, motion, rest.shape[:2], bins), atol=1e-5)
            np.testing.assert_allclose(np.exp(1j * angle), np.exp(1j * angles), atol=1e-4)
    size, angle = flow.dense_features(np.zeros((12, 12, 2), np.float32), 3)[1:]
    assert not size.any() and not angle.any()
    whole = rest.clip(0, 255).round()
    np.testing.assert_array_equal(flow.green(whole.astype(np.uint8)), flow.green(whole))


def test_what_is_no_pair_of_images_is_refused(pair, monkeypatch):
    rest = pair[0]
    with pytest.raises(ValueError, match="same size"):
        flow.dense_flow(rest, rest[:-2])
    with pytest.raises(ValueError, match="finite"):
        flow.find_beads(np.full((4, 4), np.nan))
    assert flow.find_beads(np.zeros((20, 20))).shape == (0, 2)
    assert flow.sparse_flow(rest, rest, np.zeros((0, 2))).shape == (0, 2)
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ModuleNotFoundError, match="opencv-python-headless"):
        flow.dense_flow(rest, rest)
