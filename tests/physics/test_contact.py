"""Closed forms and smoothness of a pressed skin: optics/skin/contact.py."""

import math

import numpy as np
import pytest

from optics.errors import BadCapture, UnknownKey
from optics.skin.contact import (
    LocalMap,
    cone_envelope,
    displacement,
    dragged,
    gaussian_blur,
    graded_axis,
    grid_normals,
    indenter_profile,
    ring_bulge,
    rotation_matrix,
    surface,
)

# mm; the sphere of 3 mm diameter of S1.4 in a DIGIT-like gel
R, DEPTH, GEL, SMOOTHING, PITCH = 1.5, 0.5, 2.0, 0.4, 0.03
RIM = math.sqrt(2 * R * DEPTH - DEPTH**2)


def pressed_sphere(depth=DEPTH, size=R, smoothing=SMOOTHING, thickness=GEL, pitch=PITCH, extent=4.0):
    return displacement(indenter_profile("sphere", size, extent=extent, pitch=pitch), depth, thickness, smoothing)


def radii(local_map):
    return np.hypot(*np.meshgrid(local_map.axis, local_map.axis))


# -- Depth against closed forms --------------------------------------------------------------------------------------
def last_blur(smoothing, pitch=PITCH, levels=4):
    """Variance of the blur that comes last, mm^2."""
    return (smoothing / 2**levels) ** 2 + pitch**2


def cap_after(r, variance):
    """The cap and what a small blur makes of it: plus variance/2 times its Laplacian, h'' + h'/r with h' = -r/s."""
    s = np.sqrt(np.maximum(R**2 - r**2, 1e-3))
    return DEPTH - R + s - variance / 2 * (1 / s + R**2 / s**3)


def test_unsmoothed_sphere_is_its_cap():
    pressed, _ = pressed_sphere(smoothing=0)
    r = radii(pressed)
    # the discrete Gaussian of one node has faded to 2e-4 and 1e-5
    inside, outside = r < RIM - 5 * PITCH, r > RIM + 6 * PITCH
    # fourth order: pitch^4 / R^3 = 2e-7
    np.testing.assert_allclose(pressed.values[inside], cap_after(r, last_blur(0))[inside], atol=1e-5)
    assert pressed.values[outside].max() < 1e-5
    # at the rim a kink of slope 1.12, blurred by one node, stands 0.4 * 1.12 pitch high; the rounded corner adds less
    # than 0.19 * 1.12 pitch
    assert np.abs(pressed.values - np.where(r < RIM, cap_after(r, 0), 0)).max() < 0.6 * PITCH


def test_smoothed_sphere_keeps_its_cap_in_the_contact_and_never_passes_through_the_indenter():
    bare, _ = pressed_sphere(smoothing=0)
    pressed, contact = pressed_sphere()
    r = radii(pressed)
    core = r < r[contact.values > 1 - 1e-9].max() - 5 * math.sqrt(last_blur(SMOOTHING))
    assert r[core].max() > 0.55 * RIM  # the contact is as large as in Hertz, sqrt(R depth) = 0.77 RIM, less 0.2 mm
    np.testing.assert_allclose(pressed.values[core], cap_after(r, last_blur(SMOOTHING))[core], atol=1e-5)
    # the skin lies on the indenter or deeper, but for the last blur's sd^2/2 * Laplacian, 2.4 /mm at the contact's edge
    assert (pressed.values - bare.values).min() > -last_blur(SMOOTHING) / 2 * 2.4
    line = pressed.values[len(r) // 2, len(r) // 2 :]
    assert (np.diff(line) <= 1e-15).all()  # no groove at the rim: depth falls from the axis outwards throughout


@pytest.mark.parametrize("depth", [0.1, 0.3, 0.5, 1.0])
def test_contact_radius(depth):
    _, contact = pressed_sphere(depth=depth, smoothing=0)
    line = contact.values[len(contact.values) // 2, len(contact.values) // 2 :]
    first = np.argmax(line < 0.5)
    edge = contact.axis[len(line) - 1 :][first - 1] + PITCH * (line[first - 1] - 0.5) / (line[first - 1] - line[first])
    # the weight is 1/2 where height = depth; a cubic step 2 pitches wide, read linearly between its nodes: 0.1 pitch
    assert edge == pytest.approx(math.sqrt(2 * R * depth - depth**2), abs=0.1 * PITCH)
    assert contact.volume == pytest.approx(math.pi * edge**2, rel=4 * PITCH / edge * 0.1)  # same error all around


def test_volume_converges_with_the_pitch():
    volume = math.pi * DEPTH**2 * (R - DEPTH / 3)
    error = [abs(pressed_sphere(smoothing=0, pitch=p, extent=3)[0].volume / volume - 1) for p in (0.08, 0.04, 0.02)]
    # the softened rim adds 2 pi r * 0.1 * slope * pitch^2 = 0.8 pitch^2 of 1.05 mm^3
    assert error[0] < 0.8 * 0.08**2 * 1.2 and error[2] < 0.8 * 0.02**2 * 1.2
    assert error[0] / error[2] > 8  # second order would be 16; the nodes at the rim scatter


def test_smoothed_depth_converges_with_the_pitch():
    at = np.linspace(0, 3, 61)
    z = [surface(at, 0 * at, 0, 0, pressed_sphere(pitch=p)[0]) for p in (0.08, 0.04, 0.01)]
    coarse, fine = np.abs(z[0] - z[2]).max(), np.abs(z[1] - z[2]).max()
    # the last blur makes of the kink where the skin leaves, 0.6 in slope, a lift of 0.4 * 0.6 * sd, with sd = 0.084 and
    # 0.047 against 0.027 mm: up to 0.014 and 0.005 mm
    assert coarse < 0.014 and fine < 0.005 and fine < coarse / 2


def test_smoothing_zero_is_the_limit_and_the_widest_kernel_sets_the_tail():
    almost, none = pressed_sphere(smoothing=1e-4)[0], pressed_sphere(smoothing=0)[0]
    # a blur of 1e-4 mm lifts a rim of slope 1.1 by less
    np.testing.assert_allclose(almost.values, none.values, atol=1e-4)
    wide, narrow = pressed_sphere(smoothing=0.6)[0], pressed_sphere(smoothing=0.2)[0]
    middle = len(wide.values) // 2
    far = middle + round(1.6 / PITCH)
    assert wide.values[middle, far] > 5 * narrow.values[middle, far]


def test_depth_zero_and_below_leave_the_skin_alone_and_small_depths_join_it():
    for depth in (0.0, -0.3):
        pressed, contact = pressed_sphere(depth=depth)
        assert not pressed.values.any() and not contact.values.any()
    flat, _ = displacement(indenter_profile("cube", R, (0, 0, 0), 4.0, PITCH), 1e-6, GEL, SMOOTHING)
    assert flat.values.max() == pytest.approx(1e-6, rel=1e-9)
    assert pressed_sphere(depth=1e-6)[0].values.max() < 1e-6  # its contact, 2 um wide, is lost between the nodes


def test_clipping_to_the_gel_thickness():
    pressed, contact = pressed_sphere(depth=1.0, thickness=0.6)
    r = radii(pressed)
    assert pressed.values.max() == pytest.approx(0.6, abs=1e-12)  # rounding of the blur
    flat = r < math.sqrt(2 * R * 0.4 - 0.4**2) - 0.3  # 8 sd of the last blur inside the circle where height = 1.0 - 0.6
    np.testing.assert_allclose(pressed.values[flat], 0.6, atol=1e-10)
    assert (contact.values[r < 0.8] == 1).all()


def test_maps_end_with_zero_value_and_slope():
    # wider than the grid
    pressed, contact = displacement(indenter_profile("cube", 9.0, (0, 0, 0), 4.0, PITCH), 0.5, GEL, SMOOTHING)
    for m in (pressed, contact, ring_bulge(pressed, contact, 2.0)):
        assert not any(border.any() for border in (m.values[:2], m.values[-2:], m.values[:, :2], m.values[:, -2:]))
        assert np.isfinite(m.values).all() and m.values.min() >= 0


def test_blur_is_a_gaussian_of_the_variance_asked_for():
    a = np.zeros((125, 125))
    a[62, 62] = 1
    r2 = np.subtract.outer(np.arange(125), [62]) ** 2 + (np.arange(125) - 62) ** 2
    for sd in (0.3, 1.0, 4.0):
        b = gaussian_blur(a, sd)[:125, :125]
        assert b.sum() == pytest.approx(1, abs=1e-13)
        assert (b * r2).sum() == pytest.approx(2 * sd**2, rel=1e-8)  # exact by construction; rounding times r^2
    exact = np.exp(-r2 / 32) / (32 * np.pi)
    np.testing.assert_allclose(b, exact, atol=0.017 * exact.max())  # lattice: the peak rises by 1/(8 sd^2) per axis


# -- Indenters -------------------------------------------------------------------------------------------------------
def test_profiles_lie_on_their_envelopes():
    for shape, size, rotation in (
        ("sphere", 1.5, (0, 0, 0)),
        ("cube", 2.0, (10, 5, 20)),
        ("cube", 2.0, (0, 0, 0)),
        ("cylinder", 1.0, (0, 0, 30)),
        ("cylinder", 0.7, (0, 25, 10)),
        ("cylinder", 0.7, (0, 90, 0)),
    ):
        p = indenter_profile(shape, size, rotation, 4.0, 0.04)
        seen = np.isfinite(p.height)
        assert np.isfinite(p.envelope).all() and p.envelope.min() >= 0
        assert (p.height - p.envelope)[seen].min() > -1e-12
        dv, du = (np.diff(p.envelope, axis=i) / p.pitch for i in (0, 1))
        # slopes end at tan 75 deg; the polygon of a rim lies 3e-4 radius inside it: a step of that times the slope
        step = 3.1e-4 * size * math.tan(math.radians(75)) / p.pitch if shape == "cylinder" else 1e-9
        assert max(np.abs(du).max(), np.abs(dv).max()) < math.tan(math.radians(75)) + step


def test_cube_turned_by_right_angles_and_about_its_axis():
    flat = indenter_profile("cube", 2.0, (0, 0, 0), 3.0, 0.05)
    inside = np.maximum(*np.abs(np.meshgrid(flat.axis, flat.axis))) <= 1 + 1e-9
    assert (flat.height[inside] == 0).all() and np.isinf(flat.height[~inside]).all()
    turned = indenter_profile("cube", 2.0, (90, 180, 270), 3.0, 0.05)
    np.testing.assert_allclose(turned.envelope, flat.envelope, atol=1e-12)
    u, v = np.meshgrid(flat.axis, flat.axis)
    wall = math.tan(math.radians(75)) * np.hypot(np.maximum(np.abs(u) - 1, 0), np.maximum(np.abs(v) - 1, 0))
    np.testing.assert_allclose(flat.envelope, wall, atol=1e-12)


def test_cube_on_edge_and_on_corner():
    edge = indenter_profile("cube", 2.0, (45, 0, 0), 3.0, 0.05)  # an edge along x, faces at 45 deg
    u, v = np.meshgrid(edge.axis, edge.axis)
    inside = (np.abs(u) < 1) & (np.abs(v) < math.sqrt(2) - 1e-6)
    np.testing.assert_allclose(edge.height[inside], np.abs(v)[inside], atol=1e-12)
    corner = indenter_profile("cube", 2.0, (45, -math.degrees(math.atan(1 / math.sqrt(2))), 0), 3.0, 0.05)
    middle = len(corner.height) // 2
    assert corner.height[middle, middle] == pytest.approx(0, abs=1e-12)
    # three faces meet in the corner; the flattest way up is along an edge, 1/sqrt 2, the steepest down a face, sqrt 2
    around = np.arange(360.0)
    ring = surface(0.5 * np.cos(around), 0.5 * np.sin(around), 0, 0, LocalMap(corner.envelope, 0.05))
    assert ring.min() == pytest.approx(0.5 / math.sqrt(2), rel=0.01)  # the spline cuts edges by a tenth of the pitch
    assert ring.max() == pytest.approx(0.5 * math.sqrt(2), rel=0.01)


def test_lying_cylinder_and_its_turns():
    lying = indenter_profile("cylinder", 1.0, (0, 0, 0), 4.0, 0.05)
    u, v = np.meshgrid(lying.axis, lying.axis)
    inside = (np.abs(u) < 2 + 1e-9) & (np.abs(v) < 1 - 1e-6)
    np.testing.assert_allclose(lying.height[inside], 1 - np.sqrt(1 - v[inside] ** 2), atol=1e-12)
    assert np.isinf(lying.height[(np.abs(u) > 2.01) | (np.abs(v) > 1.01)]).all()
    across = indenter_profile("cylinder", 1.0, (0, 0, 90), 4.0, 0.05)
    # the rim's polygon begins elsewhere: 3e-4 R * slope
    np.testing.assert_allclose(across.envelope, lying.envelope.T, atol=3e-3)
    upright = indenter_profile("cylinder", 1.0, (0, 90, 0), 4.0, 0.05)
    disc = np.hypot(u, v) < 1 - 1e-9
    assert np.abs(upright.height[disc]).max() < 1e-12 and np.isinf(upright.height[np.hypot(u, v) > 1.001]).all()


def test_balls_are_spheres_where_the_plate_holds_them():
    """The ball on the axis and its neighbours, a plate that is turned in its plane and one that is tilted: each is the
    closed form about its own middle."""
    ball, spacing, extent, pitch = 0.25, 1.0, 2.4, 0.02
    alone = indenter_profile("sphere", ball, (0, 0, 0), extent, pitch)
    for rotation in ((0, 0, 0), (0, 0, 17), (1.5, -2.0, 17)):
        plate = indenter_profile("balls", ball, rotation, extent, pitch, spacing=spacing)
        turn = rotation_matrix(*rotation)
        u, v = np.meshgrid(plate.axis, plate.axis)
        for column, row in ((0, 0), (1, 0), (-1, 2), (2, -1)):
            x, y, rise = turn @ (column * spacing, row * spacing, 0)
            r = np.hypot(u - x, v - y)
            near = r < ball - 1e-6
            assert near.sum() > 100 or max(abs(x), abs(y)) > extent - ball
            exact = ball - np.sqrt(ball**2 - r[near] ** 2) + rise
            np.testing.assert_allclose(plate.height[near], exact, atol=1e-12)
        seen = np.isfinite(plate.height)
        assert (plate.height - plate.envelope)[seen].min() > -1e-12
        middle = np.hypot(u, v) < spacing / 2 - 0.05
        np.testing.assert_allclose(plate.envelope[middle], alone.envelope[middle], atol=1e-12)
    with pytest.raises(ValueError, match=r"spacing = 0.4 mm for balls of radius 0.25 mm; it must be 0.5 mm"):
        indenter_profile("balls", ball, spacing=0.4)


def test_the_skirts_of_a_tilted_plate_of_balls_are_the_largest_of_all_balls():
    """Contact lines on a fine grid of radii, and every ball of the plate tried, not only those around a point."""
    profile = indenter_profile("balls", 0.25, (0.5, -0.3, 1.0), 3.0, 0.03, spacing=1.0)
    turn = rotation_matrix(0.5, -0.3, 1.0)
    u, v = np.meshgrid(profile.axis, profile.axis)
    radii = np.linspace(0, 0.24, 200_001)
    cap = 0.25 - np.sqrt(0.25**2 - radii**2)
    slope = radii / np.sqrt(0.25**2 - radii**2)
    for depth, skirt in ((0.12, 0.1), (0.05, 0.02)):
        expected = np.zeros(u.shape)
        for number in np.ndindex(9, 9):
            x, y, rise = turn[:, :2] @ (np.array(number) - 4.0)
            at = np.argmin(np.abs(depth - rise - cap - skirt * slope))
            r = np.hypot(u - x, v - y)
            on_ball = depth - rise - 0.25 + np.sqrt(np.maximum(0.25**2 - r**2, 0.0))
            beyond = (depth - rise - cap[at]) * np.exp(-(r - radii[at]) / skirt)
            expected = np.maximum(expected, np.where(r < radii[at], on_ball, beyond))
        found = dragged(profile, np.zeros(u.shape), depth, 2.0, skirt)
        np.testing.assert_allclose(found, expected, atol=2e-7)  # the grid of radii, 1.2e-6 mm, along a slope below 1


def test_the_face_behind_a_coat_is_parallel_to_the_indenter():
    """Of balls the radius grows, of a lying cylinder too, found from its heights; a flat face stays; a sharp edge gets
    the coat's own radius. Directions are sought 9 deg apart from the normal and 15 deg around it: 1 % of the coat."""
    coat, pitch = 0.1, 0.02
    ball, larger = (indenter_profile("sphere", r, (0, 0, 0), 2.0, pitch, coat=c) for r, c in ((1.0, coat), (1.1, 0.0)))
    np.testing.assert_array_equal(ball.height, larger.height)
    assert ball.balls.radius == 1.1
    lying, thick = (indenter_profile("cylinder", r, (0, 0, 30), 2.0, pitch, coat=c) for r, c in ((1, coat), (1.1, 0)))
    u, v = np.meshgrid(lying.axis, lying.axis)
    across = np.abs(v * math.cos(math.radians(30)) - u * math.sin(math.radians(30)))
    near = (across < 0.8) & (np.hypot(u, v) < 1.2)
    apart = (lying.height - thick.height)[near]
    assert apart.min() > -1e-4 and apart.max() < 0.01 * coat
    edge = indenter_profile("cube", 2.0, (45, 0, 0), 2.0, pitch, coat=coat)
    row = edge.height[:, len(edge.axis) // 2]
    y = np.abs(edge.axis)
    round_off = coat / math.sqrt(2)
    arc = np.where(y < round_off, coat - np.sqrt(np.maximum(coat**2 - y**2, 0)), y - coat * (math.sqrt(2) - 1))
    off = np.abs(row - arc)
    # at an edge the directions lie d sin(9 deg) apart: half of that, 8 % of d, on its slope of 1
    assert off[y < 1].max() < 0.08 * coat and off[(y > 0.2) & (y < 1)].max() < 0.01 * coat
    with pytest.raises(ValueError, match="coat = -0.1 mm; it must be 0 or more"):
        indenter_profile("sphere", 1.0, coat=-0.1)


@pytest.mark.parametrize("kind", ["tmd", "npy", "png"])
def test_a_height_map_of_a_sphere_against_the_closed_form(tmp_path, kind):
    """A cap of 1 mm radius, 0.01 mm from sample to sample, more along y than along x; turned, it is the same cap."""
    from PIL import Image

    step, file = 0.01, tmp_path / f"cap.{kind}"
    x, y = (np.arange(n) * step - (n - 1) / 2 * step for n in (161, 201))
    heights = np.sqrt(1.0 - np.add.outer(y**2, x**2).clip(0, 0.7)) - 0.5
    size = step
    if kind == "tmd":
        sizes = np.array([161, 201], "<u4").tobytes() + np.array([161 * step, 201 * step, 0, 0], "<f4").tobytes()
        file.write_bytes(b"Binary TrueMap Data File v2.0\r\n\0" + b"a cap\0" + sizes + heights.astype("<f4").tobytes())
        size = 1.0
    elif kind == "npy":
        np.save(file, heights)
    else:
        Image.fromarray(np.round(heights * 1000).astype(np.uint16)).save(file)
    exact = indenter_profile("sphere", 1.0, (0, 0, 0), 1.5, 0.02)
    for turn in (0, 30):
        found = indenter_profile(file, size, (0, 0, turn), 1.5, 0.02)
        u, v = np.meshgrid(found.axis, found.axis)
        near = np.hypot(u, v) < 0.7
        # the curvature c is 2.7/mm at 0.7 mm: 0.02^2 c/8 between means, as much by the means; of PNG 1 um
        limit = 1.5e-3 if kind == "png" else 5e-4
        assert np.abs(found.height[near] - exact.height[near]).max() < limit
        assert np.abs(found.envelope[near] - exact.envelope[near]).max() < limit
    assert np.isinf(found.height[0, 0])


def test_a_height_map_that_is_cut_off_is_refused(tmp_path):
    file = tmp_path / "cut.tmd"
    file.write_bytes(b"Binary TrueMap Data File v2.0\r\n\0\0" + np.array([9, 9], "<u4").tobytes() + b"\0" * 40)
    with pytest.raises(BadCapture, match="9 x 9 heights over 0 x 0 mm"):
        indenter_profile(file, 1.0)
    np.save(tmp_path / "line.npy", np.zeros(5))
    with pytest.raises(BadCapture, match=r"shape \(5,\); allowed: \(rows, columns\)"):
        indenter_profile(tmp_path / "line.npy", 0.1)


@pytest.mark.parametrize("kind", ["stl", "ply", "obj"])
def test_mesh_sphere_against_the_closed_form(tmp_path, kind):
    trimesh = pytest.importorskip("trimesh")
    file = tmp_path / f"ball.{kind}"
    ball = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    ball.export(file)
    cast = indenter_profile(file, R, (20, 30, 40), 3.0, 0.03)
    exact = indenter_profile("sphere", R, (0, 0, 0), 3.0, 0.03)
    r = np.hypot(*np.meshgrid(cast.axis, cast.axis))
    # a facet of edge 0.039 R lies edge^2 / (6 R) = 4e-4 mm inside the sphere; slope 1.1 at the rim adds half
    core = r < RIM
    assert np.abs(cast.envelope - exact.envelope)[core].max() < 6e-4
    assert (np.isfinite(cast.height) == np.isfinite(exact.height))[np.abs(r - R) > 0.03].all()
    a, _ = displacement(cast, DEPTH, GEL, SMOOTHING)
    b, _ = displacement(exact, DEPTH, GEL, SMOOTHING)
    assert np.abs(a.values - b.values).max() < 6e-4


def test_mesh_cube_against_the_closed_form(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    file = tmp_path / "block.stl"
    trimesh.creation.box((1, 1, 1)).export(file)
    for rotation in ((0, 0, 0), (15, -10, 30)):
        cast, exact = (indenter_profile(s, 2.0, rotation, 3.0, 0.03) for s in (file, "cube"))
        a, b = (displacement(p, DEPTH, GEL, SMOOTHING)[0] for p in (cast, exact))
        # distances along walls come out up to 2.7 % long: 3.6e-3 mm on a wall of 0.5 / tan 75 deg = 0.13 mm
        assert np.abs(a.values - b.values).max() < 3.6e-3 * math.tan(math.radians(75))
        assert a.volume == pytest.approx(b.volume, rel=4 * 3.6e-3 / 2)  # four walls
        inside = np.isfinite(cast.height) & np.isfinite(exact.height)
        # taken at the nearest ray: half a pitch * slope
        np.testing.assert_allclose(cast.height[inside], exact.height[inside], atol=0.03)


def test_mesh_size_is_a_scale_and_a_change_of_file_is_seen(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    import os

    file = tmp_path / "ball.ply"
    trimesh.creation.icosphere(subdivisions=4, radius=1.0).export(file)
    one, two = (indenter_profile(file, s, (0, 0, 0), 3.0 * s, 0.03 * s) for s in (1.0, 2.0))
    np.testing.assert_allclose(two.envelope, 2 * one.envelope, atol=1e-12)
    assert indenter_profile(file, 1.0, (0, 0, 0), 3.0, 0.03) is one
    trimesh.creation.icosphere(subdivisions=4, radius=0.5).export(file)
    os.utime(file, ns=(1, 1))
    half = indenter_profile(file, 1.0, (0, 0, 0), 3.0, 0.03)
    assert np.isfinite(half.height).sum() < 0.3 * np.isfinite(one.height).sum()


def test_cone_envelope_is_a_cone_to_three_percent():
    height = np.full((81, 81), np.inf)
    height[40, 40] = 0
    r = np.hypot(*np.meshgrid(np.arange(81) - 40, np.arange(81) - 40))
    cone = cone_envelope(height, 1.0)
    assert (cone >= r - 1e-9).all() and (cone <= 1.0275 * r + 1e-9).all()  # 1/cos of half of 26.6 deg


def test_errors_name_what_is_wrong(tmp_path):
    with pytest.raises(UnknownKey, match="did you mean 'sphere'"):
        indenter_profile("spere", 1.0)
    with pytest.raises(FileNotFoundError, match="nowhere.stl"):
        indenter_profile("nowhere.stl", 1.0)
    with pytest.raises(ValueError, match="size = 0 mm"):
        indenter_profile("sphere", 0.0)
    with pytest.raises(ValueError, match="pitch"):
        indenter_profile("sphere", 1.0, extent=1.0, pitch=2.0)
    broken = tmp_path / "broken.stl"
    broken.write_bytes(b"solid nothing\nendsolid nothing\n")
    with pytest.raises(ValueError, match="broken.stl"):
        indenter_profile(broken, 1.0)
    with pytest.raises(ValueError, match="depth = nan"):
        displacement(indenter_profile("sphere", 1.0), math.nan, 1.0, 0.1)
    with pytest.raises(ValueError, match="allow at least"):
        graded_axis(-8, 8, 0, 2, 0.05, 60)


# -- Smoothness: central differences with two steps must tell the same derivative ------------------------------------
X, Y = np.linspace(-7, 7, 121)[None, :], np.linspace(-7, 7, 121)[:, None]  # fixed points; the press moves below them


def skin(shape="sphere", size=R, x=0.2, y=-0.3, depth=DEPTH, smoothing=SMOOTHING, rotation=(0, 0, 0)):
    pressed, contact = displacement(indenter_profile(shape, size, rotation, 4.0, PITCH), depth, GEL, smoothing)
    return 0.5 * surface(X, Y, x, y, ring_bulge(pressed, contact, GEL)) - surface(X, Y, x, y, pressed)


def agreement(function, steps=(0.005, 0.02)):
    """Norm of the difference of central differences with two steps, over their norm."""
    small, large = ((function(h) - function(-h)) / (2 * h) for h in steps)
    return np.linalg.norm(small - large) / np.linalg.norm(large)


# Central differences err by h^2/6 times third over first derivative. The narrowest is a kink under the last blur,
# sd 0.04 mm; when it moves, its derivative is a step of that sd, and h^2 / (6 sd^2) = 4 % is what a wall, where all
# that moves are kinks, may differ by; a sphere's cap moves as a whole, so a quarter of it. A size moves walls through
# the nodes, 0.03 mm apart, which sample them coarsely: as much again and half more.
@pytest.mark.parametrize("what", ["x", "y", "depth", "size", "smoothing"])
@pytest.mark.parametrize(
    "shape, size, rotation, tolerance",
    [("sphere", R, (0, 0, 0), 0.01), ("cylinder", 1.0, (0, 0, 20), 0.04), ("cube", 2.0, (8, 5, 15), 0.04)],
)
def test_smooth_in(what, shape, size, rotation, tolerance):
    base = {"size": size, "x": 0.2, "y": -0.3, "depth": DEPTH, "smoothing": SMOOTHING}
    walls_in_size = 2.5 if what == "size" else 1
    difference = agreement(lambda h: skin(shape, rotation=rotation, **{**base, what: base[what] + h}))
    assert difference < tolerance * walls_in_size


def test_mesh_is_smooth_in_size(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    file = tmp_path / "ball.stl"
    trimesh.creation.icosphere(subdivisions=4, radius=1.0).export(file)
    assert agreement(lambda h: skin(file, size=1.3 + h)) < 0.04  # as the sphere, and its facets pass under the nodes


def test_smooth_in_depth_at_every_node_and_step():
    """No jump hides in a norm: second differences of the surface in depth stay bounded as the step shrinks."""
    bends = []
    for h in (4e-3, 1e-3, 2.5e-4):
        low, middle, high = (pressed_sphere(depth=DEPTH + k * h)[0].values for k in (-1, 0, 1))
        bends.append(np.abs(high - 2 * middle + low).max() / h)
    # a jump would make it grow sixteenfold; what stays are blurred kinks of nodes that the skin leaves: 2 % of slope 1
    assert max(bends) < 0.02


# -- Interpolation, axes, ring, normals ------------------------------------------------------------------------------
def test_surface_passes_through_the_nodes_is_zero_outside_and_the_same_both_ways():
    pressed, _ = pressed_sphere()
    u = pressed.axis
    np.testing.assert_allclose(surface(u[None] + 3, u[:, None] - 2, 3, -2, pressed), pressed.values, atol=1e-14)
    x, y = np.linspace(-9, 9, 83), np.linspace(-8, 8, 71)
    grid = surface(x[None], y[:, None], 1.0, 0.5, pressed)
    np.testing.assert_allclose(grid, surface(*np.meshgrid(x, y), 1.0, 0.5, pressed), atol=1e-15)
    outside = (np.abs(x - 1.0) > 4.2)[None] | (np.abs(y - 0.5) > 4.2)[:, None]
    assert not grid[outside].any()


def test_surface_moves_with_the_press():
    pressed, _ = pressed_sphere()
    np.testing.assert_allclose(
        surface(X, Y, 0.3171, -0.2, pressed), surface(X + 1.5, Y - 2, 1.8171, -2.2, pressed), atol=1e-12
    )


def test_press_beside_the_plate():
    pressed, contact = pressed_sphere()
    for x in (6.5, 8.0, 12.0, 40.0):
        axis = graded_axis(-8, 8, x, 2, 0.05, 161)
        z = surface(axis[None], axis[:, None], x, 0, pressed)
        assert np.isfinite(z).all() and np.isfinite(grid_normals(axis, axis, z)).all()
        assert (z.max() > 1e-9) == (x < 11)


@pytest.mark.parametrize("centre", [0.0, 3.3, 5.9, 6.1, 7.9, 8.1, 9.99, 10.1, 30.0, -7.0, -11.0])
def test_graded_axis(centre):
    x = graded_axis(-8, 8, centre, 2.0, 0.05, 161)
    assert len(x) == 161 and x[0] == -8 and x[-1] == 8
    steps = np.diff(x)
    assert steps.min() > 0.0499  # the ends are set exactly: rounding of the inverse
    middle = (x[1:] + x[:-1]) / 2
    fine = np.abs(middle - centre) < 2 - 0.05
    np.testing.assert_allclose(steps[fine], 0.05, rtol=1e-9)
    assert (steps[1:] / steps[:-1]).max() < 1.6 and (steps[1:] / steps[:-1]).min() > 1 / 1.6


@pytest.mark.parametrize("centre", [0.0, 3.0, 5.99, 6.0, 7.0, 8.0, 9.9, 10.0, 10.1])
def test_graded_axis_moves_smoothly(centre):
    one, two = (
        (graded_axis(-8, 8, centre + h, 2.0, 0.05, 161) - graded_axis(-8, 8, centre - h, 2.0, 0.05, 161)) / (2 * h)
        for h in (1e-4, 1e-3)
    )
    assert np.abs(one).max() < 4  # no point runs away from the press
    # the density has kinks, so the error is of first order: step / pitch * slope of it
    assert np.abs(one - two).max() < 0.03


def test_graded_axis_with_points_to_spare_is_even():
    np.testing.assert_allclose(graded_axis(0, 1, 0.3, 0.1, 0.1, 41), np.linspace(0, 1, 41))


def test_ring_conserves_volume_and_leaves_the_contact_alone():
    pressed, contact = pressed_sphere()
    ring = ring_bulge(pressed, contact, GEL)
    assert ring.volume == pytest.approx(pressed.volume, rel=1e-12)  # normalised to it
    touching = radii(pressed)[contact.values > 0.99].max()
    r = radii(ring)
    # the contact is read through hats of one coarse pitch; the blur of a disc is 0.43 at its edge, above 0.4
    assert ring.values[r < touching - ring.pitch].max() == 0
    assert GEL / 2 < r.ravel()[ring.values.argmax()] < 2 * GEL or r.ravel()[ring.values.argmax()] < 2 * RIM
    # the Gaussian's height; the hole moves volume outwards
    assert ring.values.max() < pressed.volume / (2 * math.pi * GEL**2) * 1.5
    none = ring_bulge(*pressed_sphere(depth=0), GEL)
    assert not none.values.any()


def test_normals_of_a_sphere_and_a_plane():
    errors = []
    for refine in (2, 4, 8):
        k = np.linspace(-1, 1, 40 * refine + 1)
        x = 1.2 * k + 0.4 * k**3  # uneven by a factor of two, in the same way at every refinement
        u, v = np.meshgrid(x, x)
        s = np.sqrt(9 - u**2 - v**2)  # a dome towards the camera: its normal is its radius
        n = grid_normals(x, x, -s)
        errors.append(np.abs(n - np.stack([u, v, -s], -1) / 3).max())
        np.testing.assert_allclose(np.linalg.norm(n, axis=-1), 1, rtol=1e-14)
        assert (n[..., 2] < 0).all()
    assert errors[0] / errors[1] > 3.5 and errors[1] / errors[2] > 3.7  # second order up to the corners: 4 in the limit
    # a third of step^2 (0.015^2) times the third derivative in the corners, about 3 u / s^4 * 9 = 0.5
    assert errors[2] < 3e-4
    tilted = grid_normals(x, x, 0.1 * u - 0.2 * v)
    np.testing.assert_allclose(tilted - np.array([0.1, -0.2, -1]) / math.sqrt(1.05), 0, atol=1e-12)


def test_maps_that_are_kept_stay_within_their_memory():
    """Of many depths of a plate whose maps hold 3 MB; the latest is kept, and the same when it is asked for again. A
    map that is larger than all that may be kept is kept until the next."""
    from optics.skin import contact

    def held(cache):
        return sum(2 * one.values.nbytes for made in cache.values() for one in made)

    plate = indenter_profile("balls", 0.2, extent=6.0, pitch=0.02, spacing=1.0)
    one, _ = displacement(plate, 0.1, GEL, 0.0)
    each = 4 * one.values.nbytes
    assert each == 4 * 8 * 601**2
    for depth in np.linspace(0.11, 0.13, int(contact.KEPT / each) + 5):
        latest, _ = displacement(plate, depth, GEL, 0.0)
    assert contact.KEPT - each < held(displacement.cache) <= contact.KEPT
    assert displacement(plate, 0.13, GEL, 0.0)[0] is latest
    assert displacement(plate, 0.1, GEL, 0.0)[0] is not one

    large = contact.kept(lambda made: 2 * contact.KEPT)(lambda number: [number])
    assert large(1) is large(1) and len(large.cache) == 1
    assert large(2) is large(2) and len(large.cache) == 1
