"""The fisheye's laws against closed forms, their inverses, and OpenCV; what folds over or ends is refused."""

import numpy as np
import pytest

from optics.scene import fisheye

FILM = {"type": "hdrfilm", "width": 480, "height": 480}
D = (0.03, -0.012, 0.004, -0.0007)  # within one per cent of its law at 80 deg: the size of a calibrated lens's
K = (290.0, 287.0, 243.0, 236.5)  # fx, fy, cx, cy in px


def lens(**values):
    from optics.scene.checking import made

    return made("fisheye", film=FILM, **values)


def seen(camera, uv):
    import mitsuba as mi

    _, d = camera.ray(*(mi.Float(a.astype("f")) for a in uv.T))
    return np.array(d).T


def points(count=200):
    rng = np.random.default_rng(0)
    theta, phi = np.radians(rng.uniform(0, 55, count)), rng.uniform(0, 2 * np.pi, count)
    d = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    return d * rng.uniform(5, 60, (count, 1))


def test_opencvs_model_is_met(mitsuba):
    """cv2.fisheye.projectPoints, and its inverse cv2.fisheye.undistortPoints, to 1e-3 px."""
    cv2 = pytest.importorskip("cv2")
    fx, fy, cx, cy = K
    matrix = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])  # OpenCV counts from the pixel's middle
    camera = lens(fx=fx, fy=fy, cx=cx, cy=cy, distortion=" ".join(map(str, D)))
    at = points()
    expected = cv2.fisheye.projectPoints(at[:, None], np.zeros(3), np.zeros(3), matrix, np.array(D))[0][:, 0] + 0.5
    np.testing.assert_allclose(camera.project(at), expected, atol=1e-3)
    # and the rays through these pixels look at the points: 1e-3 px is 3.4e-6 rad
    d = at / np.linalg.norm(at, axis=-1, keepdims=True)
    np.testing.assert_allclose(seen(camera, expected), d, atol=3.4e-6)
    back = cv2.fisheye.undistortPoints(expected[:, None] - 0.5, matrix, np.array(D))[:, 0]
    x, y, _ = camera.normalised(_own(camera), expected[:, 0], expected[:, 1])
    np.testing.assert_allclose(np.stack([x, y], -1), back, rtol=1e-5, atol=1e-6)


def _own(camera):
    from types import SimpleNamespace

    return SimpleNamespace(**camera.held)


@pytest.mark.parametrize("law", fisheye.LAWS)
@pytest.mark.parametrize("k", [(0.0,) * 4, D])
def test_projection_and_rays_are_inverse_to_each_other_in_any_pose(law, k, mitsuba):
    camera = lens(law=law, x_fov=130.0, distortion=" ".join(map(str, k)), x=1.0, z=-3.0, pan=12.0, tilt=-7.0, roll=33.0)
    v, u = np.mgrid[20:470:45, 20:470:45] + 0.5
    uv = np.stack([u.ravel(), v.ravel()], -1)
    away = seen(camera, uv)
    np.testing.assert_allclose(np.linalg.norm(away, axis=-1), 1, atol=1e-6)
    found = camera.project(np.array([1.0, 0.0, -3.0]) + 25 * away)
    np.testing.assert_allclose(found, uv, atol=1e-3)  # px; float32 of 480 px is 3e-5


def test_behind_the_camera_and_beyond_the_circle(mitsuba):
    """A full turn: the left edge of an equidistant image of 300 deg looks 150 deg from the axis. No light beyond the
    circle."""
    import mitsuba as mi

    camera = lens(x_fov=300.0, image_circle=200.0)
    d = seen(camera, np.array([[240 - 239.99 * 150 / 180, 240.0]]))
    np.testing.assert_allclose(np.degrees(np.arctan2(-d[0, 0], d[0, 2])), 125, atol=0.01)
    _, _, inside = camera.ray_seen(mi.Float([240.0, 41.0, 39.0]), mi.Float(240.0))
    assert np.array(inside).tolist() == [True, True, False]


@pytest.mark.parametrize("name", ["x_fov", "k1", "k3", "principal_x", "aspect"])
def test_derivatives_of_rays_by_the_calibration(name, mitsuba):
    """Forward mode through the inversion against central differences: what a calibration in plain Mitsuba uses."""
    import drjit as dr
    import mitsuba as mi

    camera = lens(x_fov=110.0, distortion=" ".join(map(str, D)), law="equisolid")
    at = [mi.Float([60.0, 400.0, 250.0]), mi.Float([100.0, 300.0, 20.0])]
    value = camera.number(name)
    step = {"x_fov": 0.5, "principal_x": 1.0}.get(name, 0.01 if name == "aspect" else 0.001)

    def rays(v):
        setattr(camera, name, mi.Float(v))
        return np.array(camera.ray(*at)[1], float)

    reference = (rays(value + step) - rays(value - step)) / (2 * step)
    x = mi.Float(value)
    dr.enable_grad(x)
    setattr(camera, name, x)
    d = camera.ray(*at)[1]
    dr.set_grad(x, 1.0)
    found = np.array(dr.forward_to(d), float)
    # float32 over the step, and its square in the third derivative
    np.testing.assert_allclose(found, reference, atol=2e-3 * np.abs(reference).max() + 1e-6)


@pytest.mark.parametrize(
    "values, message",
    [
        ({"distortion": "-0.6 0 0 0", "x_fov": 140.0}, "folds over at 42.71 deg"),
        ({"distortion": "0.1 0.2"}, "four of OpenCV"),
        ({"fx": 60.0, "law": "equisolid"}, "too short"),
        ({"cx": 243.0, "cy": 236.0}, "cx, cy without fx"),
        ({"law": "orthographic"}, "unknown choice for"),
    ],
)
def test_what_no_lens_does_is_refused(values, message, mitsuba):
    with pytest.raises(Exception, match=message):
        lens(**values)


def test_a_fold_beyond_the_image_is_none(mitsuba):
    lens(distortion="-0.6 0 0 0", x_fov=140.0, image_circle=50.0)
    lens(distortion="-0.6 0 0 0", x_fov=40.0)
