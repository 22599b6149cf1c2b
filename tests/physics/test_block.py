"""A printed body that a target presses: its faces, the cells that move along, and the contact as rays meet it."""

import numpy as np
import pytest

SCENE = """<scene version="3.0.0">
    <default name="distance" value="1"/>
    <default name="scattering" value="0"/>
    <default name="columns" value="5"/>
    <default name="rows" value="4"/>
    <default name="layers" value="3"/>
    <integrator type="tactile"><string name="bands" value="540"/></integrator>
    <sensor type="camera" id="camera">
        <film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="12"/><rfilter type="box"/></film>
        <float name="x_fov" value="9"/>
        <transform name="to_world"><translate x="0.013" y="0.007" z="-20"/></transform>
    </sensor>
    <shape type="block" id="block">
        <float name="width" value="7"/><float name="length" value="6"/><float name="thickness" value="3"/><integer name="layers" value="6"/>
        <bsdf type="clear" id="walls"><float name="index" value="1.5"/><float name="absorption" value="0.05"/></bsdf>
    </shape>
    <shape type="cells" id="grid">
        <integer name="columns" value="$columns"/><integer name="rows" value="$rows"/><integer name="layers" value="$layers"/>
        <bsdf type="clear" id="filling">
            <string name="outside" value="walls"/><float name="index" value="1.42"/><float name="absorption" value="0.1"/>
            <float name="scattering" value="$scattering"/>
        </bsdf>
    </shape>
    <shape type="target" id="object">
        <string name="stance" value="ball"/><float name="diameter" value="8"/><float name="distance" value="$distance"/>
        <bsdf type="diffuse"><spectrum name="reflectance" value="0.5"/></bsdf>
    </shape>
    <shape type="rectangle"><transform name="to_world"><scale x="2" y="1.5"/><lookat origin="-5,0,-1.5" target="0,0,-1.5" up="0,0,1"/></transform>
        <bsdf type="diffuse"><spectrum name="reflectance" value="0"/></bsdf><emitter type="source" id="lamp"/></shape>
</scene>"""  # noqa: E501
SIGMAS = 5.0


@pytest.fixture
def load(tmp_path, mitsuba):
    from optics.scene import loader as scene

    (tmp_path / "scene.xml").write_text(SCENE)
    return lambda variant="llvm_ad_spectral_polarized", **defines: scene.load(
        tmp_path / "scene.xml", {k: str(v) for k, v in defines.items()}, variant
    )


def triangles(shape):
    import mitsuba as mi

    params = mi.traverse(shape)
    points = np.array(params["vertex_positions"]).reshape(-1, 3).astype(float)
    return points, np.array(params["faces"]).reshape(-1, 3)


def volume(shape):
    points, faces = triangles(shape)
    a, b, c = (points[faces[:, k]] for k in range(3))
    return (a * np.cross(b, c)).sum() / 6


@pytest.mark.parametrize("distance", [1.0, -0.4, -1.2])
def test_the_body_is_closed(load, distance):
    """Each edge belongs to two triangles that run along it in opposite ways; the volume is that of the skin, normals
    outwards."""
    block = load(distance=distance).parts["block"]
    points, faces = triangles(block)
    _, same = np.unique(points, axis=0, return_inverse=True)
    edges = np.concatenate([same.ravel()[faces][:, [i, (i + 1) % 3]] for i in range(3)])
    forth, back = (sorted(map(tuple, e)) for e in (edges, edges[:, ::-1]))
    assert forth == back and len(set(forth)) == len(forth)
    if distance > 0:
        assert volume(block) == pytest.approx(7 * 6 * 3, rel=1e-6)
        return
    # of the lattice's cubes, which overhang the sides by less than one: as many parts of itself does the body lose
    kept = block.pressed.volume_ratio.mean()
    assert 0.9 < kept < 1 and volume(block) / (7 * 6 * 3) == pytest.approx(kept, abs=2e-3)


def test_light_meets_the_target_where_it_touches(load):
    """Rays from within, upwards: under the contact they meet the target, around it the face, nowhere a gap in between.

    The radius lies between that of a half space, a^2 = R d (Hertz), and that of a thin incompressible layer, a^2 = 2 R
    d."""
    import mitsuba as mi

    depth, radius = 0.5, 4.0
    scene = load(distance=-depth)
    r, turn = np.meshgrid(
        np.linspace(0, 2.9, 117), 0.0137 + np.linspace(0, 2 * np.pi, 25)[:-1]
    )  # off the meshes' edges
    origin = mi.Point3f(*(mi.Float((r * f(turn)).ravel().astype(np.float32)) for f in (np.cos, np.sin)), -0.55)
    si = scene.mitsuba.ray_intersect(mi.Ray3f(origin, mi.Vector3f(0, 0, 1)))
    touches = np.array(si.shape == mi.ShapePtr(scene.parts["object"])).reshape(r.shape)
    assert touches.any(1).all()
    edge = np.array([row[seen].max() for row, seen in zip(r, touches)])
    assert all(seen[row < e].all() for row, seen, e in zip(r, touches, edge)), "a gap in the contact"
    assert radius * depth < (edge**2).mean() < 2 * radius * depth
    assert np.ptp(edge) < 0.3  # half a pitch of the lattice: round
    # the face follows it: 5 micrometres behind, and back to the untouched face at the rim of the body but for the bulge
    points, faces = triangles(scene.parts["block"])
    z = np.array(si.t).reshape(r.shape) - 0.55
    np.testing.assert_allclose(z[touches], (radius - depth - np.sqrt(radius**2 - r**2))[touches], atol=1e-3)
    assert np.abs(points[:, 2]).max() < 3.01 and points[:, 2].max() < 0.3


def test_cells_move_along_and_keep_their_volumes(load):
    """The parts of the maps fill a cell: their volumes against those of its mesh, and places against the corners."""
    grid = load(distance=-0.8).parts["grid"]
    points, _ = triangles(grid)
    found = grid.cells(2)
    corner = points.reshape(-1, 8, 3)
    mesh = np.array([volume_of(c) for c in corner])
    assert np.ptp(mesh) > 0.03 * mesh.mean()  # the press is felt
    np.testing.assert_allclose(found.volumes.sum(1), mesh, rtol=0.01)  # trilinear faces against two triangles
    places = np.einsum("nij,nkj->nki", found.rows, corner - found.origins[:, None])
    np.testing.assert_allclose(places.mean(1), 0.5, atol=1e-5)
    still = load(distance=1).parts["grid"].cells(2)
    np.testing.assert_allclose(still.volumes, 0.6**3 / 8, rtol=1e-6)


def volume_of(corner):
    box = np.array(
        [
            [0, 1, 3],
            [0, 3, 2],
            [4, 6, 7],
            [4, 7, 5],
            [0, 4, 5],
            [0, 5, 1],
            [2, 3, 7],
            [2, 7, 6],
            [0, 2, 6],
            [0, 6, 4],
            [1, 5, 7],
            [1, 7, 3],
        ]
    )
    a, b, c = (corner[box[:, k]] for k in range(3))
    return (a * np.cross(b, c)).sum() / 6


@pytest.mark.slow
def test_a_cell_that_was_not_filled(load):
    """Where it is the only one, as if the filling were air; half filled, half of what makes it differ; and the
    derivative by the filling's absorption, of what is left of it."""
    from optics.light.transport import Transport

    one = {"columns": 1, "rows": 1, "layers": 1, "scattering": 0.2}
    images = []
    for lack, index, alpha, sigma in (
        (1.0, 1.42, 0.1, 0.2),
        (0.0, 1.0, 0.0, 0.0),
        (0.5, 1.42, 0.1, 0.2),
        (0.0, 1.21, 0.05, 0.1),
    ):
        scene = load(**one)
        scene.set(
            {"grid.unfilled": lack, "filling.index": index, "filling.absorption": alpha, "filling.scattering": sigma}
        )
        images.append(Transport(scene).take(rays=16, packets=4000, slopes=True))
    for a, b, share in ((*images[:2], 0.0), (*images[2:], 0.5)):
        np.testing.assert_allclose(a.radiance, b.radiance, rtol=0, atol=1e-5 * b.radiance.max())
        np.testing.assert_allclose(
            a.slopes["filling"], share * b.slopes["filling"], rtol=0, atol=1e-5 * np.abs(b.slopes["filling"]).max()
        )
    scene.set({"grid.unfilled": 0.5, "grid.unfilled_column": 1.0})
    with pytest.raises(ValueError, match="grid.unfilled_column = 1; allowed: 0 to 0"):
        Transport(scene)


@pytest.mark.slow
@pytest.mark.parametrize("scattering", [pytest.param(0.0, marks=pytest.mark.slow), 0.5])
def test_a_pressed_grid_by_two_routes(load, scattering):
    """Maps against rays that find the lamp by themselves, in contact: the target's light and the cells' (z, and the
    mean)."""
    from optics.light.transport import Transport

    t = Transport(load(distance=-0.5, scattering=scattering))
    quick, slow = t.take(rays=256, packets=150_000), t.take(rays=6000, reach="paths", seed=3)
    sd = np.hypot(quick.error, slow.error)[0]
    z = np.divide(quick.radiance[0] - slow.radiance[0], sd, out=np.zeros_like(sd), where=sd > 0)
    # of Student's t with 7 to 14 degrees of freedom .49; the maps' resolution adds, and rare bright paths make the mean
    # useless
    assert np.median(z**2) < 0.9, np.median(z**2)
    off, error = (
        quick.radiance.mean() / slow.radiance.mean() - 1,
        np.sqrt((sd**2).sum()) / sd.size / slow.radiance.mean(),
    )
    assert abs(off) < 0.01 + SIGMAS * error, (off, error)
