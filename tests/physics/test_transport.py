"""dielectric bodies: the way of light through many faces, against closed forms, ray by ray, by two routes, and against
stock Mitsuba.

The account by hand follows fields and not Stokes vectors: amplitudes of Fresnel along s and p, in world coordinates.
"""

import numpy as np
import pytest

from optics.errors import BadScene

SPECTRAL, MONO = "llvm_ad_spectral_polarized", "llvm_ad_mono_polarized"
SIGMAS = 5.0  # standard errors that a mean of thousands of rays may be off

SCENE = """<scene version="3.0.0">
    <default name="size" value="8"/>
    <integrator type="tactile"><string name="bands" value="BANDS"/></integrator>
    <sensor type="camera" id="camera">
        <film type="hdrfilm"><integer name="width" value="$size"/><integer name="height" value="$size"/><rfilter type="box"/></film>
        <float name="x_fov" value="FOV"/>
        <transform name="to_world"><translate x="0.013" y="0.007" z="-20"/></transform>
    </sensor>
    BODIES
</scene>"""  # noqa: E501
BLACK = '<bsdf type="diffuse"><spectrum name="reflectance" value="0"/></bsdf>'


def clear(name, index, absorption=0.0, outside="", more="", roughness=0.0):
    more += f'<float name="roughness" value="{roughness}"/>' if roughness else ""
    where = f'<string name="outside" value="{outside}"/>' if outside else ""
    return (
        f'<bsdf type="clear" id="{name}">{where}<float name="index" value="{index}"/><float name="absorption" '
        f'value="{absorption}"/>'
        f"{more}</bsdf>"
    )


def box(name, bsdf, half, middle=(0, 0, 0), turn=""):
    scale, shift = (" ".join(f'{a}="{v}"' for a, v in zip("xyz", values)) for values in (half, middle))
    place = f'<transform name="to_world"><scale {scale}/>{turn}<translate {shift}/></transform>'
    return f'<shape type="cube" id="{name}">{place}{bsdf}</shape>'


def screen(z, half=400.0, name="screen", more=""):
    """A luminous plane that faces the camera."""
    return (
        f'<shape type="rectangle" id="{name}_plane"><transform name="to_world"><rotate x="1" angle="180"/><scale '
        f'x="{half}" y="{half}"/>'
        f'<translate z="{z}"/></transform>{BLACK}<emitter type="source" id="{name}">{more}</emitter></shape>'
    )


def grid(cells, bsdf, pitch=0.8, wall=0.2, skin=0.5):
    counts = "".join(f'<integer name="{n}" value="{v}"/>' for n, v in zip(("columns", "rows", "layers"), cells))
    return (
        f'<shape type="cells" id="grid">{counts}<float name="pitch" value="{pitch}"/><float name="wall" '
        f'value="{wall}"/>'
        f'<float name="skin" value="{skin}"/>{bsdf}</shape>'
    )


def load(folder, bodies, fov=1.0, variant=SPECTRAL, bands="620, 540, 460", **defines):
    from optics.light.transport import Transport
    from optics.scene import loader as scene

    file = folder / "scene.xml"
    file.write_text(SCENE.replace("BANDS", bands).replace("FOV", str(fov)).replace("BODIES", "\n    ".join(bodies)))
    return Transport(scene.load(file, {k: str(v) for k, v in defines.items()}, variant))


def near(found, error, expected):
    """Within SIGMAS standard errors: of the mean over all pixels of a band."""
    mean, sd = found.mean((0, 1)), np.sqrt((error**2).mean((0, 1)) / error[..., 0].size)
    assert (np.abs(mean - expected) < SIGMAS * sd + 1e-6).all(), f"{mean} +- {sd}, expected {expected}"


# -- closed forms ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("alpha", [0.0, 0.4])
def test_a_slab_transmits_all_orders(tmp_path, mitsuba, alpha):
    """T = (1 - R)^2 a/(1 - R^2 a^2), a = exp(-alpha d), and its derivative by alpha (Born & Wolf, 7.6.1, without
    interference)."""
    n, d = 1.5, 2.0
    t = load(tmp_path, [box("slab", clear("glass", n, alpha), (300, 300, d / 2)), screen(20)])
    found = t.take(rays=4000, slopes=True)
    r, a = ((n - 1) / (n + 1)) ** 2, np.exp(-alpha * d)
    near(found.radiance[0], found.error[0], (1 - r) ** 2 * a / (1 - r**2 * a**2))
    slope = -d * a * (1 - r) ** 2 * (1 + r**2 * a**2) / (1 - r**2 * a**2) ** 2
    # the slope's own error is about d times that of the image
    near(found.slopes["glass"][0], d * 1.5 * found.error[0], slope)


def test_tilted_plates_hand_polarization_on(tmp_path, mitsuba):
    """Two plates at 60 degrees: T = (T_s^2 + T_p^2)/2, each with all orders between its faces, T = (1 - R)/(1 + R);
    what the plates reflect leaves sideways. A scalar account, which forgets the polarization in between, is 2 % off."""
    n, angle = 1.5, 60.0
    plates = [
        box("one", clear("glass", n), (60, 60, 0.5), (0, 0, 0), f'<rotate x="1" angle="{angle}"/>'),
        box("two", clear("glass_2", n), (60, 60, 0.5), (0, 0, 200), f'<rotate x="1" angle="{angle}"/>'),
    ]
    t = load(tmp_path, [*plates, screen(400, half=60)], fov=1)
    found = t.take(rays=6000)
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    inside = np.sqrt(1 - (s / n) ** 2)
    r = np.array([((c - n * inside) / (c + n * inside)) ** 2, ((n * c - inside) / (n * c + inside)) ** 2])
    one = (1 - r) / (1 + r)
    both = one**2
    assert abs(both.mean() - one.mean() ** 2) > 0.02
    near(found.radiance[0], found.error[0], both.mean())


@pytest.mark.slow
def test_a_wave_plate_between_tilted_plates(tmp_path, mitsuba):
    """The plates above, turned by 45 degrees, and between them a body that neither reflects nor absorbs, birefringent
    along x: T = ((T_s + T_p)^2 + (T_s - T_p)^2 cos delta)/4, delta = 2 pi dn d/lambda, for three wavelengths."""
    n, angle, dn, d = 1.5, 60.0, 1e-4, 1.7
    turn = f'<rotate x="1" angle="{angle}"/><rotate z="1" angle="45"/>'
    bodies = [
        box("one", clear("glass", n), (60, 60, 0.5), (0, 0, 0), turn),
        box("two", clear("glass_2", n), (60, 60, 0.5), (0, 0, 300), turn),
        box(
            "plate",
            clear("plain", 1.0, more=f'<float name="birefringence" value="{dn}"/>'),
            (60, 60, d / 2),
            (0, 0, 150),
        ),
    ]
    t = load(tmp_path, [*bodies, screen(500, half=60)], fov=1)
    found = t.take(rays=8000)
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    inside = np.sqrt(1 - (s / n) ** 2)
    r = np.array([((c - n * inside) / (c + n * inside)) ** 2, ((n * c - inside) / (n * c + inside)) ** 2])
    one = (1 - r) / (1 + r)
    expected = (
        one.sum() ** 2 + (one[0] - one[1]) ** 2 * np.cos(2 * np.pi * dn * d * 1e6 / np.array([620, 540, 460]))
    ) / 4
    assert np.ptp(expected) > 0.01
    near(found.radiance[0], found.error[0], expected)


def test_the_furnace_neither_gains_nor_loses(tmp_path, mitsuba):
    """Radiance 1 from everywhere is radiance 1 behind any dielectric body, here a grid in a block (0.5 %)."""
    t = load(
        tmp_path,
        [
            box("block", clear("walls", 1.5), (2.2, 2.2, 1.5), (0, 0, -1.4)),
            grid((4, 4, 2), clear("filling", 1.4, outside="walls")),
            SKY,
        ],
        fov=14,
    )
    found = t.take(rays=512)
    assert found.lost < 1e-3
    assert np.abs(found.radiance[0].mean((0, 1)) - 1).max() < 0.005
    near(found.radiance[0], found.error[0], 1.0)


@pytest.mark.slow
def test_light_goes_both_ways_alike(tmp_path, mitsuba):
    """Power from panel A on panel B through a grid, and from B on A: per radiance and area the same (reciprocity)."""
    from optics.light.transport import BATCHES, Run

    power = []
    for lamp, target in ((-1, 1), (1, -1)):

        def panel(side, inner):
            return (
                f'<shape type="rectangle" id="p{side + 1}"><transform name="to_world"><scale x="0.7" y="0.7"/><lookat '
                f'origin="{side * 3},{0.4 * side},-1.5" target="0,0,-1.2" '
                f'up="0,1,0"/></transform>{BLACK}{inner}</shape>'
            )

        t = load(
            tmp_path,
            [
                box("block", clear("walls", 1.5, 0.05), (2.2, 2.2, 1.5), (0, 0, -1.4)),
                grid((4, 4, 2), clear("filling", 1.4, 0.1, outside="walls")),
                panel(lamp, '<emitter type="source" id="light"/>'),
                panel(target, ""),
            ],
        )
        run = Run(t, [0, 1, 2], 1, 0)
        run.images(1, 40_000, True)
        # mean irradiance in the first band times the area, of each batch
        caught = np.array(run.irradiance).reshape(BATCHES, len(run.rows), -1)[:, 0].mean(-1) * 1.4**2
        power.append((caught.mean(), caught.std(ddof=1) / np.sqrt(BATCHES)))
    (a, da), (b, db) = power
    assert a > 20 * da and abs(a - b) < SIGMAS * np.hypot(da, db), power


# -- rough faces -----------------------------------------------------------------------------------------------------
SKY = (
    '<shape type="sphere" id="sky"><float name="radius" value="60"/><boolean name="flip_normals" value="true"/>'
    f'{BLACK}<emitter type="source" id="light"/></shape>'
)


def rough_dielectric(roughness, index=1.5):
    return (
        f'<bsdf type="roughdielectric"><float name="int_ior" value="{index}"/><float name="ext_ior" value="1"/><float '
        'name="alpha" '
        f'value="{roughness}"/><string name="distribution" value="beckmann"/></bsdf>'
    )


def stock_lamp(shape):
    """A luminous shape of ours as Mitsuba's own."""
    return (
        shape[: shape.index("<emitter")]
        + '<emitter type="area"><spectrum name="radiance" value="1"/></emitter></shape>'
    )


def by_stock(folder, bodies, fov, integrator="path"):
    import mitsuba as mi

    from optics.scene.wiring import wire

    text = SCENE.replace("BANDS", "540").replace("FOV", str(fov)).replace("BODIES", "\n".join(bodies))
    text = text.replace(
        '<integrator type="tactile"><string name="bands" value="540"/></integrator>',
        f'<integrator type="{integrator}"><integer name="max_depth" value="512"/><integer name="rr_depth" '
        'value="1000"/></integrator>',
    )
    (folder / "stock.xml").write_text(text)
    scene = mi.load_file(str(folder / "stock.xml"), optimize=False, size="8")
    wire(scene)  # for an integrator that does not know the parts
    return scene


def rendered(scene, spp, seeds):
    """Mean and standard error (H, W) over seeds."""
    import mitsuba as mi

    runs = np.stack([np.array(mi.render(scene, spp=spp, seed=seed))[..., 0] for seed in range(seeds)]).astype(float)
    return runs.mean(0), runs.std(0, ddof=1) / np.sqrt(seeds)


def test_facets_have_beckmanns_slopes(tmp_path, mitsuba):
    """Along the normal all facets are seen: slopes across either axis have the mean square alpha^2/2 and the mean
    fourth power 3 alpha^4/4, by the directions that rays are reflected and refracted into."""
    n, roughness, count = 1.5, 0.1, 200_000
    t = load(tmp_path, [box("block", clear("glass", n, roughness=roughness), (50, 50, 50)), screen(300)])
    d = np.tile([0.0, 0.0, 1.0], (count, 1))
    log = followed(t, d * -60 + (0.01, 0.02, 0), d, 2, x=np.tile([1.0, 0.0, 0.0], (count, 1)))
    out, inside = log[1, :, 3:6], log[1, :, 14] == 1
    m = np.where(inside[:, None], n * out - d, out - d)  # along the facet's normal, of either sign
    slopes = m[:, :2] / m[:, 2:]
    assert abs(inside.mean() - 0.96) < SIGMAS * np.sqrt(0.96 * 0.04 / count)
    for slope in slopes.T:
        assert abs(slope.mean()) < SIGMAS * roughness / np.sqrt(2 * count)
        assert abs((slope**2).mean() / (roughness**2 / 2) - 1) < SIGMAS * np.sqrt(2 / count)
        assert abs((slope**4).mean() / (0.75 * roughness**4) - 1) < SIGMAS * np.sqrt(96 / 9 / count)


@pytest.mark.slow
def test_faces_hardly_rough_are_nearly_smooth(tmp_path, mitsuba):
    """The same random numbers at every roughness: the image of a grid does not move up to 1e-4, and at 1e-3 by less
    than its noise."""
    smooth, least, little = (
        load(tmp_path, little_grid(0.1, r), fov=9).take(rays=256, packets=40_000) for r in (0.0, 1e-4, 1e-3)
    )
    np.testing.assert_allclose(
        least.radiance, smooth.radiance, rtol=0, atol=1e-5 * smooth.radiance.max()
    )  # the order of atomic sums
    moved = (little.radiance - smooth.radiance).std()
    assert 0 < moved < 0.7 * np.sqrt(2 * (smooth.error**2).mean())  # of two images with random numbers of their own: 1


@pytest.mark.parametrize("roughness", [0.1, 0.3])
def test_stock_rough_dielectric_sees_the_same(tmp_path, mitsuba, roughness):
    """A rough slab before the edge of a luminous half plane, pixel by pixel: z has no mean and the spread of noise.
    Mitsuba's takes all polarization out of the light; what that changes is below 1e-5 here, as light crosses the faces
    near their normal."""
    half_plane = screen(20).replace('<translate z="20"/>', '<translate x="400" z="20"/>')
    own, other = (
        box("slab", bsdf, (300, 300, 1))
        for bsdf in (clear("glass", 1.5, roughness=roughness), rough_dielectric(roughness))
    )
    ours = load(tmp_path, [own, half_plane], fov=12, variant=MONO, bands="540", size=8).take(rays=8000, reach="paths")
    theirs, error = rendered(by_stock(tmp_path, [other, stock_lamp(half_plane)], 12), 1000, 12)
    found, own = ours.radiance[0, ..., 0], ours.error[0, ..., 0]
    z = (found - theirs) / np.hypot(error, own)
    assert np.ptp(found[3]) > 0.5 and abs(z.mean()) < SIGMAS / 8 and 0.5 < np.mean(z**2) < 2.0, (
        z.mean(),
        np.mean(z**2),
    )


@pytest.mark.slow
@pytest.mark.parametrize("roughness", [0.1, 0.3, 0.5])
def test_what_rough_faces_lose(tmp_path, mitsuba, roughness):
    """Light that facets pass on to each other: of radiance 1 from everywhere a slab shows 0.4 % less at 0.3 and 7 % at
    0.5, as by stock."""
    own, other = (
        box("slab", bsdf, (20, 20, 1))
        for bsdf in (clear("glass", 1.5, roughness=roughness), rough_dielectric(roughness))
    )
    found = load(tmp_path, [own, SKY], variant=MONO, bands="540").take(rays=4000)
    theirs, error = rendered(by_stock(tmp_path, [other, stock_lamp(SKY)], 1), 1000, 8)
    loss, sd = 1 - found.radiance.mean(), np.sqrt((error**2 + found.error[0, ..., 0] ** 2).mean()) / 8
    assert abs(loss - (1 - theirs.mean())) < SIGMAS * sd + 1e-5
    assert abs(loss - {0.1: 0.0, 0.3: 0.0044, 0.5: 0.072}[roughness]) < 1e-4 + 0.03 * loss


# -- ray by ray ------------------------------------------------------------------------------------------------------
def amplitudes(cos, n):
    """r_s, r_p of Fresnel, complex beyond the critical angle, and the cosine beyond."""
    beyond = np.sqrt(1 - (1 - cos**2) / n**2 + 0j)
    beyond = np.where(beyond.imag < 0, -beyond, beyond)
    return (cos - n * beyond) / (cos + n * beyond), (n * cos - beyond) / (n * cos + beyond), beyond


def followed(t, p, d, steps, x=None, group=(0, 1, 2)):
    """(steps, N, 15) of rays that start at p along d: where each stretch begins, its direction, the axis x, the row of
    sensitivities, the weight, the number of the material; zeros beyond a ray's end."""
    import drjit as dr
    import mitsuba as mi

    from optics.light.transport import Run

    run, count, width = Run(t, list(group), 1, 5), len(p), 15
    log = dr.zeros(mi.Float, count * steps * width)

    def along(s, length, sigma, active):
        k = (s["depth"] * count + s["pixel"]) * width
        for i, value in enumerate([*s["p"], *s["d"], *s["x"], *s["v"], s["tau"][0], mi.Float(s["medium"])]):
            dr.scatter(log, value, k + i, s["active"] & (s["depth"] < steps))

    x = np.cross(d, (0, 1, 0)) if x is None else x
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    vector = [mi.Vector3f(*a.T.astype(np.float32)) for a in (d, x)]
    start = {
        "p": mi.Point3f(*p.T.astype(np.float32)),
        "d": vector[0],
        "x": vector[1],
        "tau": [mi.Float(1.0)] * len(group),
        "rng": mi.PCG32(size=count, initstate=7),
        "pixel": dr.arange(mi.UInt32, count),
    }
    run.fly(start, False, False, along, lambda *_: mi.Bool(False))
    return np.array(log).reshape(steps, count, width).astype(float)


@pytest.mark.slow
def test_one_cell_ray_by_ray(tmp_path, mitsuba):
    """Every stretch of many rays through one cell in a block against (23), (24) and (29): direction, absorption, and
    what the faces leave of two crossed linear polarizations, followed as fields."""
    n_wall, n_fill, a_wall, a_fill = 1.5, 1.42, 0.3, 0.7
    t = load(
        tmp_path,
        [
            box("block", clear("walls", n_wall, a_wall), (0.6, 0.6, 0.6), (0, 0, -0.6)),
            grid((1, 1, 1), clear("filling", n_fill, a_fill, outside="walls"), skin=0.2),
            screen(30),
        ],
    )
    rng, count, steps = np.random.default_rng(2), 2000, 12
    p = rng.uniform(-4, 4, (count, 3)) * (1, 1, 0) + (0, 0, -6)
    to = rng.uniform(-0.55, 0.55, (count, 3)) + (0, 0, -0.6)
    d = to - p
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    log = followed(t, p, d, steps)
    flown = np.linalg.norm(log[..., 3:6], axis=-1) > 0.5
    assert flown[2].mean() > 0.9  # the others leave by one reflection
    checked = {"reflected": 0, "total": 0, "refracted": 0}
    half, middle = 0.3, np.array([0.0, 0.0, -0.6])  # of the cell
    for ray in range(count):
        for k in range(1, steps):
            if not flown[k, ray]:
                break
            now, was = log[k, ray], log[k - 1, ray]
            at, s, s2 = now[:3], was[3:6], now[3:6]
            outer = np.abs(np.abs(at - middle) - 0.6).min() < 2e-3
            axis = np.argmin(np.abs(np.abs(at - middle) - (0.6 if outer else half)))
            g = np.eye(3)[axis] * np.sign(s[axis])  # of the face, along the ray
            others = np.abs(np.delete(np.abs(at - middle), axis)[:, None] - (half, 0.6))
            if others.min() < 0.03:
                continue  # at an edge the place does not say which face was met
            # which materials meet: by where the ray came from
            back = at - 1e-2 * s
            came = (
                n_fill
                if (np.abs(back - middle) < half).all()
                else n_wall
                if (np.abs(back - middle) < 0.6).all()
                else 1.0
            )
            pairs = {n_fill: n_wall, 1.0: n_wall, n_wall: 1.0 if outer else n_fill}
            n1, n2 = came, pairs[came]
            gs = g @ s
            r_s, r_p, beyond = amplitudes(gs, n2 / n1)
            reflected = s2 @ g < 0
            if reflected:
                expected = s - 2 * g * gs  # (24)
            else:
                expected = n1 / n2 * s + g * np.sqrt(1 - (n1 / n2) ** 2 * (1 - gs**2)) - n1 / n2 * g * gs  # (23)
            np.testing.assert_allclose(s2, expected, atol=3e-6)
            alpha = {1.0: 0.0, n_wall: a_wall, n_fill: a_fill}[came]
            # the start of a stretch is lifted off its face by up to 2e-3 mm; faint rays come back doubled
            fade = now[13] / was[13]
            assert min(abs(fade / np.exp(-alpha * np.linalg.norm(at - was[:3])) - f) for f in (1, 2)) < 4e-3  # (29)
            share = (abs(r_s) ** 2 + abs(r_p) ** 2) / 2
            assert fields_off(was, now, g, n2 / n1) < 3e-5 * max(1, abs(was[9]) / share), (ray, k)
            checked["total" if reflected and share > 1 - 1e-9 else "reflected" if reflected else "refracted"] += 1
    assert min(checked.values()) > 30, checked


def stokes(a, b):
    """Stokes vector of a field; circular as optics.polarization.mueller has it: a quarter-wave plate, fast at 45
    degrees, makes S3 > 0 of x."""
    return np.array(
        [abs(a) ** 2 + abs(b) ** 2, abs(a) ** 2 - abs(b) ** 2, 2 * (a * np.conj(b)).real, 2 * (a * np.conj(b)).imag]
    )


def fields_off(was, now, g, n):
    """By how much the rows of two stretches differ, at most, about fields that meet a face of the normal g (along the
    ray) and the relative index n in between: light comes along -s2 and leaves along -s."""
    s, s2, side = was[3:6], now[3:6], np.cross(was[3:6], g)
    if np.linalg.norm(side) < 1e-3:
        return 0.0
    r_s, r_p, _ = amplitudes(g @ s, n)
    share = (abs(r_s) ** 2 + abs(r_p) ** 2) / 2
    side /= np.linalg.norm(side)
    e_in, e_out = (side, np.cross(-s2, side)), (side, np.cross(-s, side))
    ways = (
        np.diag([r_s, r_p]) / np.sqrt(share)
        if s2 @ g < 0
        else np.diag([np.sqrt(1 - abs(r_s) ** 2), np.sqrt(1 - abs(r_p) ** 2)]) / np.sqrt(1 - share) / n
    )
    worst = 0.0
    for field in ((1, 0), (0, 1), (1, 1), (1, 1j)):  # along the new axes x and k cross x
        field = np.array(field, complex) / np.linalg.norm(field)
        e = field[0] * now[6:9] + field[1] * np.cross(-s2, now[6:9])
        out = ways @ np.array([e @ e_in[0], e @ e_in[1]])
        e = out[0] * e_out[0] + out[1] * e_out[1]
        seen_before = stokes(e @ was[6:9], e @ np.cross(-s, was[6:9])) @ was[9:13]
        worst = max(worst, abs(stokes(*field) @ now[9:13] - seen_before))
    return worst


@pytest.mark.slow
def test_a_facet_acts_as_a_face(tmp_path, mitsuba):
    """What a rough face leaves of fields, by the facet that sent a ray where it went; the weight is G1 of Smith for
    Beckmann's slopes, 2/(1 + erf(a) + exp(-a^2)/(a sqrt(pi))), a = 1/(alpha tan(theta)) (Walter et al. 2007), as
    Mitsuba rounds it."""
    from scipy.special import erf

    n, roughness, count, angle = 1.5, 0.3, 2000, np.radians(65)
    t = load(tmp_path, [box("block", clear("glass", n, roughness=roughness), (50, 50, 50)), screen(300)])
    d = np.tile([np.sin(angle), 0.0, np.cos(angle)], (count, 1))
    log = followed(t, np.array([0.013, 0.017, -50.0]) - d, d, 2)
    checked = {True: 0, False: 0}
    for was, now in zip(*log):
        if np.linalg.norm(now[3:6]) < 0.5:
            continue  # lost
        inside = bool(now[14])
        m = n * now[3:6] - was[3:6] if inside else was[3:6] - now[3:6]
        m /= np.linalg.norm(m)
        share = np.mean(np.abs(amplitudes(m @ was[3:6], n)[:2]) ** 2)
        assert fields_off(was, now, m, n) < 2e-5 / share, "the facet's normal is known to some 1e-6"
        a = abs(now[5]) / np.hypot(now[3], now[4]) / roughness
        g1 = 2 / (1 + erf(a) + np.exp(-(a**2)) / (a * np.sqrt(np.pi)))
        assert min(abs(now[13] / g1 - f) for f in (1, 2)) < 0.01 and (now[5] > 0) == inside
        checked[inside] += 1
    assert min(checked.values()) > 100 and sum(checked.values()) > 0.8 * count, checked


def test_the_critical_angle(tmp_path, mitsuba):
    """A ray that leaves glass of 1.5 through its flat face passes to 0.01 deg below asin(1/1.5), and not 0.01 deg
    above."""
    import drjit as dr
    import mitsuba as mi

    t = load(tmp_path, [box("block", clear("glass", 1.5), (50, 50, 50)), screen(300)])
    bsdf = next(s.shape for s in t.surfaces if s.inside == 1).bsdf()
    limit = np.degrees(np.arcsin(1 / 1.5))
    for angle, passes in ((limit - 0.01, True), (limit + 0.01, False)):
        si = dr.zeros(mi.SurfaceInteraction3f, 1)
        si.wi = mi.Vector3f(float(np.sin(np.radians(angle))), 0, -float(np.cos(np.radians(angle))))
        bs, _ = bsdf.sample(mi.BSDFContext(), si, mi.Float(0.9999), mi.Point2f(0.5), mi.Bool(True))
        assert (float(bs.wo.z[0]) > 0) == passes


def through_prism(folder, apex, n, incidence, copies=8, more="", band=None):
    """Deviation (deg) of rays that pass both faces of a prism; angles in deg, `incidence` (N,). band: number of the one
    that they belong to; None: all, which then go one way."""
    half = np.radians(apex) / 2
    height = float(1 / np.tan(half))
    corners = [(x, y, z) for y in (-5, 5) for x, z in ((-1, 0), (1, 0), (0, height))]
    faces = [(1, 2, 3), (4, 6, 5), (1, 3, 6), (1, 6, 4), (2, 5, 6), (2, 6, 3), (1, 4, 5), (1, 5, 2)]
    (folder / "prism.obj").write_text(
        "".join("{} {} {} {}\n".format(*row) for row in [("v", *c) for c in corners] + [("f", *f) for f in faces])
    )
    shape = (
        f'<shape type="obj" id="prism"><string name="filename" value="{folder / "prism.obj"}"/><boolean '
        'name="face_normals" value="true"/>'
        f"{clear('glass', n, more=more)}</shape>"
    )
    t = load(folder, [shape, screen(30)])
    group = (0, 1, 2) if band is None else (band,)
    angle = np.repeat(np.radians(incidence) - half, copies)  # of the ray above the base
    d = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], -1)
    log = followed(t, np.array([-0.4, 0.0, 0.6 * height]) - 3 * d, d, 3, group=group)
    out = np.degrees(angle - np.arctan2(log[2, :, 5], log[2, :, 3])).reshape(len(incidence), copies)
    passed = ((log[1, :, 14] == 1) & (log[2, :, 14] == 0)).reshape(out.shape)  # neither face reflected
    assert passed.any(1).all() and (log[2, :, 3] > 0)[passed.ravel()].all()
    return np.array([row[ok].mean() for row, ok in zip(out, passed)])


@pytest.mark.parametrize("apex, n", [(60.0, 1.5), (40.0, 1.7)])
def test_a_prism_deviates(tmp_path, mitsuba, apex, n):
    """delta = theta1 - A + asin(n sin(A - asin(sin(theta1)/n))), least 2 asin(n sin(A/2)) - A (Born & Wolf, 4.7.2);
    to 3e-5 deg, a few roundings of a direction in float32."""
    a, symmetric = np.radians(apex), np.degrees(np.arcsin(n * np.sin(np.radians(apex / 2))))
    incidence = np.concatenate([[symmetric], symmetric + np.linspace(-15, 25, 41)])
    found, theta = through_prism(tmp_path, apex, n, incidence), np.radians(incidence)
    expected = np.degrees(theta - a + np.arcsin(n * np.sin(a - np.arcsin(np.sin(theta) / n))))
    np.testing.assert_allclose(found, expected, rtol=0, atol=3e-5)
    assert abs(found[0] - (2 * symmetric - apex)) < 3e-5 and found.min() > found[0] - 3e-5


SELLMEIER = '<string name="index_spectrum" value="pmma.csv"/>'
CAUCHY = '<float name="dispersion" value="0.008"/>'


@pytest.mark.parametrize("law, more", [("sellmeier", SELLMEIER), ("cauchy", CAUCHY)])
def test_a_prism_disperses(tmp_path, mitsuba, law, more):
    """Each band goes the way of its own index: deviations at 620, 540 and 460 nm of an equilateral prism of 1.4932 at
    540 nm, by n^2 = 1 + 1.1819 w^2/(w^2 - 0.011313), w in um, of the source of its table (whose rows have five digits:
    5e-6 in n are 6e-4 deg), or by n + 0.008 ((540/nm)^2 - 1); and the spread from 460 to 620 nm."""
    nm, apex = np.array([620.0, 540.0, 460.0]), np.radians(60.0)
    um2 = (nm / 1e3) ** 2
    n = np.sqrt(1 + 1.1819 * um2 / (um2 - 0.011313)) if law == "sellmeier" else 0.008 * ((540 / nm) ** 2 - 1)
    n = 1.4932 + n - n[1]
    incidence = np.array([40.0, 48.3, 60.0])
    theta = np.radians(incidence)
    found = np.array([through_prism(tmp_path, 60.0, 1.4932, incidence, more=more, band=b) for b in range(3)])
    bent = np.arcsin(np.sin(theta) / n[:, None])
    expected = np.degrees(theta - apex + np.arcsin(n[:, None] * np.sin(apex - bent)))
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-3 if law == "sellmeier" else 5e-5)
    spread = found[2] - found[0]
    assert (spread > 0.3).all() and spread == pytest.approx(expected[2] - expected[0], abs=2e-3)


@pytest.mark.slow
def test_bands_of_different_index_are_followed_apart(tmp_path, mitsuba):
    """A plate shifts a ray by d sin(a) (1 - cos(a)/sqrt(n^2 - sin(a)^2)) (Snell), each band by its own n: 1.5 + 0.1
    ((540/nm)^2 - 1), more than any glass, so that blue and red see the edge of a screen 1.45 px apart behind a plate
    that is turned by 50 deg, and green in the middle of the image."""
    from scipy.optimize import brentq

    thick, distance = 8.0, 35.0

    def met(angle, n):
        """Where a ray from the camera at an angle to the axis meets the screen, mm."""
        a = np.radians(50.0) - angle
        shift = thick * np.sin(a) * (1 - np.cos(a) / np.sqrt(n**2 - np.sin(a) ** 2))
        return distance * np.tan(angle) + shift / np.cos(angle)

    indices = 1.5 + 0.1 * ((540 / np.array([620.0, 540.0, 460.0])) ** 2 - 1)
    edge = met(0.0, 1.5)
    plate = box("plate", clear("glass", 1.5, more='<float name="dispersion" value="0.1"/>'), (40, 40, thick / 2),
                turn='<rotate y="1" angle="50"/>')  # fmt: skip
    halves = [
        f'<shape type="rectangle" id="{name}_plane"><transform name="to_world"><rotate x="1" angle="180"/><scale '
        f'x="40" y="40"/><translate x="{middle + edge + 0.013}" z="15"/></transform>{BLACK}<emitter type="source" '
        f'id="{name}"/></shape>'
        for name, middle in (("right", 40), ("left", -40))
    ]
    t = load(tmp_path, [plate, *halves], fov=14.0, size=64)
    rows = t.take(rays=256, packets=1000, seed=1).radiance[:, 28:36].mean(1)  # (light, W, B), in the plane of incidence
    share = rows[t.lights.index("right")] / rows.sum(0)
    low, high = share[25:29].mean(0), share[36:40].mean(0)  # what the plate reflects twice makes a faint ghost
    place = 36 - ((share - low) / (high - low))[28:36].sum(0)  # px from the left rim to the edge
    pixel = 2 * np.tan(np.radians(7.0)) / 64
    expected = [32 + np.tan(brentq(lambda angle, n=n: met(angle, n) - edge, -0.1, 0.1)) / pixel for n in indices]
    assert place == pytest.approx(expected, abs=0.05)  # 256 rays in each of eight pixels at the edge


def test_the_aperture_of_a_light_guide(tmp_path, mitsuba):
    """A core of n1 in a coat of n2 guides what arrives below asin(sqrt(n1^2 - n2^2)) at its end, through the coat's
    flat end as well, which leaves n sin(theta) as it is; to 0.002 deg, where 4 % already leak at their first
    reflection."""
    n1, n2, copies = 1.5, 1.42, 250
    t = load(
        tmp_path,
        [
            box("outer", clear("coat", n2), (2, 2, 10)),
            box("inner", clear("core", n1, outside="coat"), (0.5, 0.5, 9.5)),
            screen(300),
        ],
    )
    limit = np.degrees(np.arcsin(np.sqrt(n1**2 - n2**2)))
    fan = limit + np.arange(-0.1, 0.1, 3.1e-4)
    angle = np.repeat(np.radians(fan), copies)
    d = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
    inside = np.sin(angle) / n2  # sine of the angle in the coat: aimed at the middle of the core's end
    middle = np.stack([-0.5 * inside / np.sqrt(1 - inside**2), 0 * angle + 0.013, 0 * angle - 10], -1)
    log = followed(t, middle - d, d, 4)
    medium = log[..., 14].reshape(4, len(fan), copies)
    entered = (medium[:3] == np.array([0, 1, 2])[:, None, None]).all(0)
    leaks = (entered & (medium[3] == 1)).sum(1) / entered.sum(1)
    assert entered.mean() > 0.9
    assert (leaks[fan < limit - 2e-4] == 0).all() and (leaks[fan > limit + 2e-3] > 0).all()


# -- two routes, and stock Mitsuba -----------------------------------------------------------------------------------
LAMPS = [
    f'<shape type="rectangle" id="lamp_{i}"><transform name="to_world"><scale x="1.4" y="1.0"/><lookat '
    f'origin="{x},{y},-1.4" '
    f'target="0,0,-1.3" up="0,0,1"/></transform>{BLACK}<emitter type="source" id="light_{i}"/></shape>'
    for i, (x, y) in enumerate(((3, 0), (0, -3)))
]
COAT = (
    '<shape type="rectangle" id="coat"><transform name="to_world"><rotate x="1" angle="180"/><scale x="2.6" '
    'y="2.6"/><translate z="0.2"/></transform>'
    '<bsdf type="diffuse"><spectrum name="reflectance" value="0.6"/></bsdf></shape>'
)


def little_grid(scattering=0.0, roughness=0.0):
    more = f'<float name="scattering" value="{scattering}"/>'
    return [
        box("block", clear("walls", 1.5, 0.05, roughness=roughness), (1.8, 1.8, 1.2), (0, 0, -1.2)),
        grid((3, 3, 2), clear("filling", 1.4, 0.1, outside="walls", more=more, roughness=roughness), skin=0.4),
        *LAMPS,
        COAT,
    ]


@pytest.mark.slow
@pytest.mark.parametrize("scattering, roughness", [(0.0, 0.0), (0.3, 0.0), (0.1, 0.15)])
def test_maps_and_paths_agree(tmp_path, mitsuba, scattering, roughness):
    """Pixel by pixel: z has the spread of noise, and no mean; the maps' resolution stays below."""
    t = load(tmp_path, little_grid(scattering, roughness), fov=9, size=12)
    quick, slow = t.take(rays=256, packets=200_000), t.take(rays=8000, reach="paths", seed=3)
    for light in range(2):
        sd = np.hypot(quick.error, slow.error)[light]
        z = np.divide(quick.radiance[light] - slow.radiance[light], sd, out=np.zeros_like(sd), where=sd > 0)
        assert np.abs(z.mean()) < SIGMAS / np.sqrt(z[..., 0].size) + 0.1, (light, z.mean())
        assert np.mean(z**2) < 2.0  # of Student's t with some 7 degrees of freedom: 1.4
        off = quick.radiance[light].mean() / slow.radiance[light].mean() - 1
        error = slow.error[light].mean() / slow.radiance[light].mean() / 6
        assert abs(off) < 0.01 + SIGMAS * error, (light, off, error)


def stock(folder, roughness, alpha_wall=0.05, alpha_fill=0.1, fill=1.4):
    """The little grid of stock dielectrics, or of rough interfaces, with stock media and lamps, for `volpath`."""

    def medium(name, alpha):
        spectra = f'<spectrum name="sigma_t" value="{alpha}"/><spectrum name="albedo" value="0"/>'
        return f'<medium type="homogeneous" id="{name}">{spectra}</medium>'

    def face(inside, outside, within, without=""):
        around = f'<ref id="{without}" name="exterior"/>' if without else ""
        indices = f'<float name="int_ior" value="{inside}"/><float name="ext_ior" value="{outside}"/>'
        smooth = f'<bsdf type="dielectric">{indices}</bsdf>'
        numbers = f'<float name="index" value="{inside / outside}"/><float name="alpha" value="{roughness}"/>'
        rough = f'<bsdf type="rough_interface">{numbers}</bsdf>'
        return f'{rough if roughness else smooth}<ref id="{within}" name="interior"/>{around}'

    return by_stock(
        folder,
        [
            medium("resin", alpha_wall),
            medium("support", alpha_fill),
            box("block", face(1.5, 1.0, "resin"), (1.8, 1.8, 1.2), (0, 0, -1.2)),
            grid((3, 3, 2), face(fill, 1.5, "support", "resin"), skin=0.4),
            *map(stock_lamp, LAMPS),
            COAT,
        ],
        9,
        "volpath",
    )


@pytest.mark.slow
@pytest.mark.parametrize("roughness", [0.0, pytest.param(0.15, marks=pytest.mark.slow)])
def test_stock_volpath_sees_the_same(tmp_path, mitsuba, roughness):
    """The same grid by Mitsuba's own dielectrics, media and integrator, pixel by pixel: z has no mean and the spread of
    noise. Of rough faces by the part `rough_interface`, which keeps polarization where stock `roughdielectric` loses
    it."""
    t = load(tmp_path, little_grid(roughness=roughness), fov=9, variant=MONO, bands="540", size=8)
    ours = t.take(rays=4000, packets=400_000)
    theirs, error = rendered(stock(tmp_path, roughness), 1500, 12)
    found, own = ours.radiance.sum(0)[..., 0], np.sqrt((ours.error**2).sum(0))[..., 0]
    z = (found - theirs) / np.hypot(error, own)
    assert theirs.mean() > 20 * np.sqrt((error**2).mean()) / 8
    assert abs(z.mean()) < SIGMAS / 8 and 0.5 < np.mean(z**2) < 2.0, (z.mean(), np.mean(z**2))
    # over all pixels to a per cent of what is seen, beside the noise
    assert (
        abs(found.mean() / theirs.mean() - 1)
        < 0.01 + SIGMAS * np.hypot(*(np.sqrt((e**2).mean()) / 8 for e in (error, own))) / theirs.mean()
    )


@pytest.mark.slow
def test_derivatives_by_absorption(tmp_path, mitsuba, monkeypatch):
    """Against central differences with common random numbers; faint rays are not thinned, which would draw anew."""
    from optics.light import transport

    monkeypatch.setattr(transport, "FAINT", 0.0)

    def at(wall, fill, slopes):
        t = load(tmp_path, little_grid(0.2), fov=9, size=4)
        t.scene.set({"walls.absorption": wall, "filling.absorption": fill})
        from optics.light.transport import Transport

        return Transport(t.scene).take(rays=512, packets=100_000, slopes=slopes)

    here = at(0.05, 0.1, True)
    for name, low, high in (("walls", (0.045, 0.1), (0.055, 0.1)), ("filling", (0.05, 0.095), (0.05, 0.105))):
        difference = (at(*high, False).radiance - at(*low, False).radiance) / 0.01
        # (0.005 l)^2/6 of ways l up to 100 mm, and atomic sums in float32
        np.testing.assert_allclose(here.slopes[name], difference, rtol=0, atol=5e-3 * np.abs(difference).max())
        assert (difference.mean((1, 2)) < 0).all()


def test_what_is_nested_wrongly_is_refused(tmp_path, mitsuba):
    bodies = [
        box("block", clear("walls", 1.5), (1.8, 1.8, 1.2), (0, 0, -1.2)),
        grid((3, 3, 2), clear("filling", 1.4), skin=0.4),
        screen(20),
    ]
    with pytest.raises(BadScene, match="not its neighbour.*`outside` names the wrong material"):
        load(tmp_path, bodies, fov=9).take(rays=8)
    bodies[1] = grid((3, 3, 2), clear("filling", 1.4, outside="wall"), skin=0.4)
    with pytest.raises(BadScene, match="'filling': outside = 'wall'; allowed: .*walls"):
        load(tmp_path, bodies)


@pytest.mark.slow
def test_the_stated_error_is_that_between_seeds(mitsuba):
    """Variance of eight images, pixel by pixel, over the mean of the squares of their stated errors: 1, and .01 by
    Monte Carlo (measured over six sets; pixels share maps). Generators that start beside one another gave 1.4."""
    from optics.light.transport import Transport
    from optics.scene import loader as scenes

    transport = Transport(scenes.load("grid_bench", {"width": "16", "height": "12"}))
    taken = [transport.take(256, 50_000, seed=seed) for seed in range(8)]
    ratio = np.var([p.radiance for p in taken], 0, ddof=1).mean() / np.mean([p.error**2 for p in taken])
    assert ratio == pytest.approx(1, abs=0.05)
