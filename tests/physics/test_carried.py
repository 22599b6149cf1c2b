"""What the skin carries and what stands before it, as meshes: plugins/parts/carried.py, markers.py and target.py."""

import numpy as np
import pytest

from optics.skin.contact import surface
from optics.skin.halfspace import carried

SCENE = """<scene version="3.0.0">
    <default name="depth" value="0"/>
    <shape type="gel" id="gel">
        <float name="width" value="48"/> <float name="length" value="43"/> <float name="thickness" value="5"/>
        <float name="extent" value="8"/> <float name="map_pitch" value="0.1"/> <float name="pitch" value="0.12"/>
        <float name="indenter_size" value="6"/> <float name="smoothing" value="0.6"/>
        <float name="press_x" value="3"/> <float name="press_y" value="-2"/> <float name="press_depth" value="$depth"/>
    </shape>
    <shape type="carried" id="film"/>
    <shape type="carried" id="inner"> <float name="depth" value="5"/> </shape>
    %s
</scene>"""
MARKERS = '<shape type="markers" id="markers"/>'
TARGET = '<scene version="3.0.0"> <shape type="target" id="target"/> </scene>'
PRESS = (3.0, -2.0)
BOTH = pytest.mark.parametrize("variant", ["llvm_ad_mono_polarized", "llvm_ad_spectral_polarized"], indirect=True)
FLOAT = 4e-6  # mm: rounding of float32 at 50 mm
ORIGIN = 2e-5  # mm: the same of a ray that comes from 60 mm away, some operations later


@pytest.fixture
def load(tmp_path, mitsuba):
    from optics.scene import loader as scene

    def load(text, depth=0, variant="llvm_ad_spectral_polarized"):
        file = tmp_path / "skin.xml"
        file.write_text(text, encoding="utf-8")
        return scene.load(file, {"depth": depth} if "$depth" in text else None, variant=variant)

    return load


def array(part, name):
    import mitsuba as mi

    return np.array(mi.traverse(part)[name], float).reshape(-1, 2 if "texcoords" in name else 3)


def vertices(part):
    return array(part, "vertex_positions")


def rays(scene, x, y, start=-60.0, ahead=True):
    """What parallel rays along z meet: through world points (x, y), from z = start on."""
    import mitsuba as mi

    x, y = (a.ravel().astype(np.float32) for a in np.broadcast_arrays(x, y))
    z = np.broadcast_to(np.asarray(start, np.float32), x.shape)
    direction = mi.Vector3f(0, 0, 1 if ahead else -1)
    return scene.mitsuba.ray_intersect(mi.Ray3f(mi.Point3f(x, y, np.array(z)), direction))


def numbers(vector):
    return np.array(vector, float).T


def places(count=40, half=(22.0, 19.0)):
    """Points on the skin away from the meshes' lines, half of them around the press."""
    rng = np.random.default_rng(3)
    near = rng.uniform(-4, 4, (2, count // 2)) + np.array(PRESS)[:, None]
    far = rng.uniform(-1, 1, (2, count - count // 2)) * np.array(half)[:, None]
    return np.concatenate([near, far], 1)


def moved(scene, x, y, depth):
    gel = scene.gel
    ux, uy, uz = (surface(x, y, *PRESS, m) for m in carried(gel.map, gel.map.pitch, depth))
    return np.stack([x + ux, y + uy, -depth - uz], -1)


# -- At rest ---------------------------------------------------------------------------------------------------------
@BOTH
def test_an_untouched_skin_is_flat(load, variant):
    scene = load(SCENE % MARKERS, 0, variant)
    for name, depth in (("film", 2.5), ("inner", 5.0)):
        part = scene.parts[name]
        p, uv, n = vertices(part), array(part, "vertex_texcoords"), array(part, "vertex_normals")
        assert (p[:, 2] == -depth).all()
        np.testing.assert_allclose(p[:, :2], (uv - 0.5) * (48, 43), atol=FLOAT)
        assert (p[:, :2].min(0) == (-24, -21.5)).all() and (p[:, :2].max(0) == (24, 21.5)).all()
        np.testing.assert_allclose(n, np.broadcast_to((0, 0, -1), n.shape), atol=1e-6)
    si = rays(scene, np.array([4.8, -17.0]), np.array([8.6, 13.0]))
    # uv differ by 1/120 within a face, and are rounded to 6e-8: 96 * 120 * 6e-8
    np.testing.assert_allclose(numbers(si.dp_du), [(48, 0, 0)] * 2, atol=6e-4)
    np.testing.assert_allclose(numbers(si.dp_dv), [(0, 43, 0)] * 2, atol=6e-4)
    np.testing.assert_allclose(numbers(si.uv)[0], (0.6, 0.7), atol=1e-6)
    np.testing.assert_allclose(numbers(si.sh_frame.n), [(0, 0, -1)] * 2, atol=1e-6)


@BOTH
def test_markers_at_rest(load, variant):
    scene = load(SCENE % MARKERS, 0, variant)
    part = scene.parts["markers"]
    centres = part.centres()
    x, y = np.meshgrid(9.5 * np.arange(-2, 3), 8.5 * (np.arange(4) - 1.5))
    np.testing.assert_allclose(centres, np.stack([x.ravel(), y.ravel(), np.full(20, -6.0)], -1), atol=1e-12)
    p, n = (a.reshape(20, -1, 3) for a in (vertices(part), array(part, "vertex_normals")))
    off = p - centres[:, None]
    r = np.hypot(off[..., 0], off[..., 1])
    np.testing.assert_allclose(r[:, -1], 0, atol=FLOAT)
    np.testing.assert_allclose(r[:, :-1], 1.5, atol=FLOAT)
    assert set(np.round(off[..., 2].ravel(), 5)) == {0.0, 1.0}
    wall = off[:, :192] * (1, 1, 0) / 1.5
    np.testing.assert_allclose(n[:, :192], wall, atol=2e-3)  # the two triangles of a side weigh differently on its ends
    np.testing.assert_allclose(n[:, 192:], np.broadcast_to((0, 0, -1), n[:, 192:].shape), atol=1e-6)
    # seen from the camera: caps where markers are, the face beside them, and walls from aside
    for shift, z in ((0.0, -6.0), (1.45, -6.0), (1.55, -5.0)):
        np.testing.assert_allclose(numbers(rays(scene, centres[:, 0] + shift, centres[:, 1]).p)[:, 2], z, atol=ORIGIN)


def test_other_numbers_of_markers(load):
    text = (
        '<scene version="3.0.0"> <shape type="markers" id="m"> <integer name="columns" value="2"/> '
        '<integer name="rows" value="1"/> <float name="pitch_x" value="4"/> </shape> </scene>'
    )
    np.testing.assert_allclose(load(text).parts["m"].centres(), [(-2, 0, -6), (2, 0, -6)])


# -- Pressed ---------------------------------------------------------------------------------------------------------
@BOTH
def test_a_press_carries_sheets_and_markers(load, variant):
    scene = load(SCENE % MARKERS, 1.5, variant)
    for name, depth in (("film", 2.5), ("inner", 5.0)):
        part = scene.parts[name]
        rest = (array(part, "vertex_texcoords") - 0.5) * (48, 43)
        expected = moved(scene, *rest.T, depth)
        assert np.abs(expected[:, 2] + depth).max() > 0.1
        np.testing.assert_allclose(vertices(part), expected, atol=FLOAT)
    markers = scene.parts["markers"]
    x, y = markers.rest().T
    shift = markers.centres() - np.stack([x, y, np.full(20, -6.0)], -1)
    away = np.stack([x, y], -1) - PRESS
    distance = np.linalg.norm(away, axis=-1)
    out = (shift[:, :2] * away).sum(-1) / distance
    assert (out > 0).all() and (shift[:, 2] < 0).all()  # outwards and towards the camera, each of them
    assert (
        np.abs(shift[:, 0] * away[:, 1] - shift[:, 1] * away[:, 0]) / distance < 0.02 * out
    ).all()  # along the radius
    # the base moves as the half-space says, the cap tilts by the face's slope at a lever of 1 mm: away from the contact
    base = moved(scene, x, y, 5.0)
    lever = markers.centres() - base
    np.testing.assert_allclose(np.linalg.norm(lever, axis=-1), 1.0, atol=1e-12)
    e = 1.5  # mm: mean slopes over the foot
    tangents = [(moved(scene, x + a, y + b, 5.0) - moved(scene, x - a, y - b, 5.0)) for a, b in ((e, 0), (0, e))]
    for t in tangents:
        assert np.abs((lever * t).sum(-1)).max() < 1e-12
    assert ((lever[:, :2] * away).sum(-1)[distance < 10] > 0).all()


@BOTH
def test_nothing_comes_out_of_order(load, variant):
    """Rays from the camera's side meet inner face, film and outer face in this order, at depths that the half-space
    says."""
    import mitsuba as mi

    scene = load(SCENE % "", 2.2, variant)
    x, y = places(200)
    start, heights = -60.0, []
    for name in ("inner", "film", "gel"):
        si = rays(scene, x, y, start)
        assert np.array(si.shape == mi.ShapePtr(scene.parts[name])).all(), name
        assert (numbers(si.n)[:, 2] < 0).all() and (numbers(si.sh_frame.n)[:, 2] < 0).all()
        heights.append(numbers(si.p)[:, 2])
        start = heights[-1] + 1e-3
    assert (np.diff(heights, axis=0) > 0.1).all()
    assert -heights[2].min() > 1.9 and -5 - heights[0].min() > 0.2  # and all that with a deep dent


def test_the_sheets_first_direction_follows_the_skin(load):
    scene = load(SCENE % "", 1.5)
    x, y = places()
    si = rays(scene, x, y)  # the inner face, from the camera
    u, v = numbers(si.uv).T
    rest = (u - 0.5) * 48, (v - 0.5) * 43
    # linear between vertices 0.4 mm apart: 0.4^2/8 of a curvature of 0.07/mm, along x and along y
    np.testing.assert_allclose(moved(scene, *rest, 5.0), numbers(si.p), atol=3e-3)
    e = 0.2
    tangent = (moved(scene, rest[0] + e, rest[1], 5.0) - moved(scene, rest[0] - e, rest[1], 5.0)) / (2 * e)
    assert np.abs(tangent[:, 2]).max() > 0.05  # it does tilt
    np.testing.assert_allclose(numbers(si.dp_du) / 48, tangent, atol=0.01)  # constant within a face: half of 0.4 mm off
    normal = numbers(si.sh_frame.n)
    assert np.abs((normal * tangent).sum(-1)).max() < 2e-3


def test_the_dent_carries_however_it_comes(load):
    """Loaded pressed, pressed later, moved there and back: the same meshes, and ray tracing sees them."""
    pressed, set_later = load(SCENE % MARKERS, 1.0), load(SCENE % MARKERS, 0)
    before = {n: vertices(set_later.parts[n]) for n in ("film", "inner", "markers")}
    set_later.set({"gel.press_depth": 1.0})
    x, y = places()
    for n in before:
        assert np.abs(vertices(set_later.parts[n]) - before[n]).max() > 0.05
        assert (vertices(set_later.parts[n]) == vertices(pressed.parts[n])).all()
    assert (np.array(rays(set_later, x, y).t) == np.array(rays(pressed, x, y).t)).all()
    assert np.array(rays(set_later, *np.array(PRESS)).t)[0] < 55 - 0.05
    set_later.set({"gel.press_depth": 0.0})
    for n in before:
        assert (vertices(set_later.parts[n]) == before[n]).all()


def test_parameters_move_what_they_name(load):
    """A parameter of a carried part is set while the skin is pressed: through the scene, and through mi.traverse."""
    import mitsuba as mi

    scene = load(SCENE % MARKERS, 1.0)
    film, markers = scene.parts["film"], scene.parts["markers"]
    scene.set({"film.depth": 1.5, "markers.height": 2.0})
    rest = (array(film, "vertex_texcoords") - 0.5) * (48, 43)
    np.testing.assert_allclose(vertices(film), moved(scene, *rest.T, 1.5), atol=FLOAT)
    lever = markers.centres() - moved(scene, *markers.rest().T, 5.0)
    np.testing.assert_allclose(np.linalg.norm(lever, axis=-1), 2.0, atol=1e-12)
    seen = numbers(rays(scene, *markers.centres()[:, :2].T).p)
    np.testing.assert_allclose(seen, markers.centres(), atol=ORIGIN)
    params = mi.traverse(film)
    params["depth"] = 2.0
    params.update()
    np.testing.assert_allclose(vertices(film), moved(scene, *rest.T, 2.0), atol=FLOAT)


def test_the_foot_of_a_marker_stays_on_the_face(load):
    """No light passes under a marker: the foot's rim lies on the inner face's mesh, which is linear between its
    vertices."""
    scene = load(
        (SCENE % '<shape type="markers" id="markers"> <float name="height" value="0.5"/> </shape>').replace(
            'name="press_x" value="3"', 'name="press_x" value="0"'
        ),
        2.0,
    )
    foot = vertices(scene.parts["markers"]).reshape(20, -1, 3)[:, :96].reshape(-1, 3)
    middles = foot.reshape(20, 96, 3).mean(1, keepdims=True)[..., :2]
    x, y = (middles + 1.002 * (foot[:, :2].reshape(20, 96, 2) - middles)).reshape(-1, 2).T
    height = numbers(rays(scene, x, y, start=foot[:, 2] + 0.4, ahead=False).p)[:, 2]
    # 0.4^2/8 of a curvature of 0.1/mm along x and along y, and 0.003 mm of a slope of 0.2
    assert np.abs(height - foot[:, 2]).max() < 5e-3
    assert np.ptp(foot[:, 2]) > 0.3


# -- Target ----------------------------------------------------------------------------------------------------------
def edge(scene, inside, outside, axis):
    """Where a ray stops meeting the target along x or y, mm, by bisection."""
    for _ in range(30):
        middle = (inside + outside) / 2
        x, y = (middle, 0.5) if axis == 0 else (0.5, middle)
        hit = np.array(rays(scene, np.array([x]), np.array([y])).is_valid())[0]
        inside, outside = (middle, outside) if hit else (inside, middle)
    return inside


@BOTH
def test_silhouette_of_the_target(load, variant):
    scene = load(TARGET, variant=variant)
    part = scene.parts["target"]
    # a polygon of 256 sides: the radius at a corner, 8e-5 less between two
    loss = 10 * (1 - np.cos(np.pi / 256))
    for side in (1, -1):
        assert edge(scene, 0, side * 60, 0) == pytest.approx(side * 40, abs=ORIGIN)
        assert edge(scene, 0, side * 60, 1) == pytest.approx(side * 10, abs=loss + ORIGIN)
    y = np.linspace(-9.9, 9.9, 41)
    si = rays(scene, 3.0, y)
    height = 30 - np.sqrt(100 - y**2)  # distance 20, radius 10
    # on the flanks a chord's depth error is the radial one over the slope's cosine, 0.14 at 9.9 mm
    np.testing.assert_allclose(numbers(si.p)[:, 2], height, atol=loss / 0.14 + ORIGIN)
    np.testing.assert_allclose(numbers(si.sh_frame.n), np.stack([0 * y, y, -np.sqrt(100 - y**2)], -1) / 10, atol=2e-3)
    assert vertices(part)[:, 2].min() == 20 and vertices(part)[:, 2].max() == 40

    scene.set({"target.stance": "standing", "target.diameter": 30.0, "target.distance": 5.0, "target.length": 12.0})
    for axis in (0, 1):
        half = np.sqrt(15**2 - 0.5**2)  # the line passes the axis at 0.5 mm
        assert edge(scene, 0, 60, axis) == pytest.approx(half, abs=1.5 * loss + ORIGIN)
    si = rays(scene, np.array([0.0, 14.0]), np.array([0.0, 0.0]))
    np.testing.assert_allclose(numbers(si.p)[:, 2], 5, atol=ORIGIN)
    np.testing.assert_allclose(numbers(si.n), [(0, 0, -1)] * 2, atol=1e-6)
    back = rays(scene, np.array([0.0]), np.array([0.0]), start=60.0, ahead=False)
    assert numbers(back.p)[0, 2] == pytest.approx(17, abs=ORIGIN) and numbers(back.n)[0, 2] == 1
    assert vertices(part)[:, 2].min() == 5 and vertices(part)[:, 2].max() == 17

    scene.set({"target.x": 100.0})
    assert not np.array(rays(scene, np.array([0.0]), np.array([0.0])).is_valid())[0]
    assert np.array(rays(scene, np.array([100.0]), np.array([0.0])).is_valid())[0]


def test_the_target_is_closed(load):
    """Each edge belongs to two triangles that run along it in opposite ways, corners counted by their place."""
    import mitsuba as mi

    part = load(TARGET).parts["target"]
    faces = np.array(mi.traverse(part)["faces"]).reshape(-1, 3)
    _, same = np.unique(np.round(vertices(part), 4), axis=0, return_inverse=True)
    corners = same.ravel()[faces]
    corners = corners[[len(set(c)) == 3 for c in corners]]  # at the poles every other triangle has no area
    edges = np.concatenate([corners[:, [i, (i + 1) % 3]] for i in range(3)])
    forth, back = (sorted(map(tuple, e)) for e in (edges, edges[:, ::-1]))
    assert forth == back and len(set(forth)) == len(forth)
    a, b, c = (vertices(part)[faces[:, i]] for i in range(3))
    volume = (a * np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(np.pi * 100 * 80, rel=2e-4)  # positive: normals outwards; the polygon lacks 1e-4


def test_stances_are_named(load):
    from optics.errors import UnknownKey

    scene = load(TARGET)
    with pytest.raises(UnknownKey, match="standing"):
        scene.set({"target.stance": "leaning"})
