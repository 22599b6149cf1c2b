"""The pupil: rays of plain Mitsuba against the circle of confusion, and the blur of images against these rays."""

import numpy as np
import pytest

from optics.scene.checking import made


@pytest.mark.parametrize("kind", ["camera", "fisheye"])
def test_rays_through_the_pupil_miss_by_the_circle_of_confusion(kind, mitsuba):
    """Rays of one pixel meet at the focus; elsewhere their second moment in the image is what the blur says."""
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": 200, "height": 160}
    camera = made(kind, x_fov=70.0, pupil_area=0.8, focus=15.0, aspect=1.1, film=film)
    n = 96
    k = (np.arange(n) + 0.5) / n
    disc = mi.Point2f(*(a.ravel().astype("f") for a in np.meshgrid(k, k)))
    assert camera.needs_aperture_sample()
    ray, _ = camera.sample_ray(0.0, 0.5, mi.Point2f(0.8, 0.3), disc)
    o, d = np.array(ray.o, float).T, np.array(ray.d, float).T
    assert np.linalg.norm(o, axis=1).max() == pytest.approx(np.sqrt(0.8 / np.pi), rel=0.02)  # of the grid's last row

    def crossed(distance):
        """Where the rays are so far from the camera, in px."""
        if kind == "fisheye":
            along = (o * d).sum(1)
            return camera.project(o + d * (np.sqrt(along**2 - (o**2).sum(1) + distance**2) - along)[:, None])
        at = o + d * ((distance - o[:, 2]) / d[:, 2])[:, None]
        focal = float(np.ravel(np.array(camera.focal()[0]))[0])
        return np.stack([focal * at[:, 0] / at[:, 2] + 100, 1.1 * focal * at[:, 1] / at[:, 2] + 80], 1)

    np.testing.assert_allclose(crossed(15.0), np.full((n * n, 2), [160.0, 48.0]), atol=2e-3)  # float32 rays
    own = type("Own", (), {**{p: camera.number(p) for p in camera.numbers}})
    for distance in (11.0, 24.0):
        x, y, _ = camera.normalised(own, np.array([[160.0]]), np.array([[48.0]]))
        slant = distance if kind == "fisheye" else distance * np.sqrt(1 + x**2 + y**2)
        spread = camera.astray(own, np.array([[160.0]]), np.array([[48.0]]), slant)[0, 0]
        along, across = np.linalg.eigvalsh(np.cov(crossed(distance).T))
        # the geometric mean of two axes that differ by a fifth; 96^2 rays leave 1e-3, the far rim's aberration 1 %
        assert np.sqrt(along * across) == pytest.approx(0.8 / (4 * np.pi) * spread**2, rel=0.015)


@pytest.mark.slow
def test_the_blur_is_that_of_rays_through_the_pupil(mitsuba):
    """Beads before and behind the focus, by the effect and by mi.render; without it the two differ three times as
    much."""
    from optics.light.rendering import RenderJob
    from optics.scene import loader

    scene = loader.load(
        "particle_gel", {"width": "96", "height": "96", "beads": "120", "diameter": "1.6", "bottom": "3.6"}
    )
    wide = {"camera.pupil_area": 12.0, "camera.focus": 16.0}
    sharp, blurred, traced = (
        RenderJob(scene, spp=spp, layers=(), saturation=1.0)
        .take(values)
        .camera[..., 1]
        .reshape(24, 4, 24, 4)
        .mean((1, 3))
        for spp, values in ((None, {"camera.pupil_area": 0.0}), (None, wide), (256, wide))
    )
    error, change = np.std(blurred - traced), np.std(sharp - traced)
    # what is left: noise of 256 samples and of the sharp image's rims, and what a rim hides
    assert change > 0.01 and error < 0.35 * change, (error, change)
