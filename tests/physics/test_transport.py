"""Clear bodies: the way of light through many faces, against closed forms, ray by ray, by two routes, and against stock Mitsuba.

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
</scene>"""
BLACK = '<bsdf type="diffuse"><spectrum name="reflectance" value="0"/></bsdf>'


def clear(name, index, absorption=0.0, outside="", more=""):
    where = f'<string name="outside" value="{outside}"/>' if outside else ""
    return (f'<bsdf type="clear" id="{name}">{where}<float name="index" value="{index}"/><float name="absorption" value="{absorption}"/>'
            f'{more}</bsdf>')


def box(name, bsdf, half, middle=(0, 0, 0), turn=""):
    scale, shift = (" ".join(f'{a}="{v}"' for a, v in zip("xyz", values)) for values in (half, middle))
    return f'<shape type="cube" id="{name}"><transform name="to_world"><scale {scale}/>{turn}<translate {shift}/></transform>{bsdf}</shape>'


def screen(z, half=400.0, name="screen", more=""):
    """A luminous plane that faces the camera."""
    return (f'<shape type="rectangle" id="{name}_plane"><transform name="to_world"><rotate x="1" angle="180"/><scale x="{half}" y="{half}"/>'
            f'<translate z="{z}"/></transform>{BLACK}<emitter type="source" id="{name}">{more}</emitter></shape>')


def grid(cells, bsdf, pitch=0.8, wall=0.2, skin=0.5):
    counts = "".join(f'<integer name="{n}" value="{v}"/>' for n, v in zip(("columns", "rows", "layers"), cells))
    return (f'<shape type="cells" id="grid">{counts}<float name="pitch" value="{pitch}"/><float name="wall" value="{wall}"/>'
            f'<float name="skin" value="{skin}"/>{bsdf}</shape>')


def load(folder, bodies, fov=1.0, variant=SPECTRAL, bands="620, 540, 460", **defines):
    from optics import scene
    from optics.transport import Transport

    file = folder / "scene.xml"
    file.write_text(SCENE.replace("BANDS", bands).replace("FOV", str(fov)).replace("BODIES", "\n    ".join(bodies)))
    return Transport(scene.load(file, {k: str(v) for k, v in defines.items()}, variant))


def near(found, error, expected):
    """Within SIGMAS standard errors: of the mean over all pixels of a band."""
    mean, sd = found.mean((0, 1)), np.sqrt((error**2).mean((0, 1)) / error[..., 0].size)
    assert (np.abs(mean - expected) < SIGMAS * sd + 1e-6).all(), f"{mean} +- {sd}, expected {expected}"


# -- closed forms ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("alpha", [0.0, 0.4])
def test_a_slab_transmits_all_orders(tmp_path, mitsuba, alpha):
    """T = (1 - R)^2 a/(1 - R^2 a^2), a = exp(-alpha d), and its derivative by alpha (Born & Wolf, 7.6.1, without interference)."""
    n, d = 1.5, 2.0
    t = load(tmp_path, [box("slab", clear("glass", n, alpha), (300, 300, d / 2)), screen(20)])
    found = t.take(rays=4000, slopes=True)
    r, a = ((n - 1) / (n + 1)) ** 2, np.exp(-alpha * d)
    near(found.radiance[0], found.error[0], (1 - r) ** 2 * a / (1 - r**2 * a**2))
    slope = -d * a * (1 - r) ** 2 * (1 + r**2 * a**2) / (1 - r**2 * a**2) ** 2
    # the slope's own error is about d times that of the picture
    near(found.slopes["glass"][0], d * 1.5 * found.error[0], slope)


def test_tilted_plates_hand_polarization_on(tmp_path, mitsuba):
    """Two plates at 60 degrees: T = (T_s^2 + T_p^2)/2, each with all orders between its faces, T = (1 - R)/(1 + R); what the plates
    reflect leaves sideways. A scalar account, which forgets the polarization in between, is 2 % off."""
    n, angle = 1.5, 60.0
    plates = [box("one", clear("glass", n), (60, 60, 0.5), (0, 0, 0), f'<rotate x="1" angle="{angle}"/>'),
              box("two", clear("glass_2", n), (60, 60, 0.5), (0, 0, 200), f'<rotate x="1" angle="{angle}"/>')]
    t = load(tmp_path, [*plates, screen(400, half=60)], fov=1)
    found = t.take(rays=6000)
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    inside = np.sqrt(1 - (s / n) ** 2)
    r = np.array([((c - n * inside) / (c + n * inside)) ** 2, ((n * c - inside) / (n * c + inside)) ** 2])
    one = (1 - r) / (1 + r)
    both = one**2
    assert abs(both.mean() - one.mean() ** 2) > 0.02
    near(found.radiance[0], found.error[0], both.mean())


def test_the_furnace_neither_gains_nor_loses(tmp_path, mitsuba):
    """Radiance 1 from everywhere is radiance 1 behind any clear body, here a grid in a block (0.5 %)."""
    sphere = ('<shape type="sphere" id="sky"><float name="radius" value="60"/><boolean name="flip_normals" value="true"/>'
              f'{BLACK}<emitter type="source" id="light"/></shape>')
    t = load(tmp_path, [box("block", clear("walls", 1.5), (2.2, 2.2, 1.5), (0, 0, -1.4)), grid((4, 4, 2), clear("filling", 1.4, outside="walls")),
                        sphere], fov=14)
    found = t.take(rays=512)
    assert found.lost < 1e-3
    assert np.abs(found.radiance[0].mean((0, 1)) - 1).max() < 0.005
    near(found.radiance[0], found.error[0], 1.0)


def test_light_goes_both_ways_alike(tmp_path, mitsuba):
    """Power from panel A on panel B through a grid, and from B on A: per radiance and area the same (reciprocity)."""
    from optics.transport import BATCHES, Run

    power = []
    for lamp, target in ((-1, 1), (1, -1)):
        def panel(side, inner):
            return (f'<shape type="rectangle" id="p{side + 1}"><transform name="to_world"><scale x="0.7" y="0.7"/><lookat '
                    f'origin="{side * 3},{0.4 * side},-1.5" target="0,0,-1.2" up="0,1,0"/></transform>{BLACK}{inner}</shape>')
        t = load(tmp_path, [box("block", clear("walls", 1.5, 0.05), (2.2, 2.2, 1.5), (0, 0, -1.4)),
                            grid((4, 4, 2), clear("filling", 1.4, 0.1, outside="walls")),
                            panel(lamp, '<emitter type="source" id="light"/>'), panel(target, "")])
        run = Run(t, [0, 1, 2], 1, 0)
        run.images(1, 40_000, True)
        # mean irradiance in the first band times the area, of each batch
        caught = np.array(run.irradiance).reshape(BATCHES, len(run.rows), -1)[:, 0].mean(-1) * 1.4**2
        power.append((caught.mean(), caught.std(ddof=1) / np.sqrt(BATCHES)))
    (a, da), (b, db) = power
    assert a > 20 * da and abs(a - b) < SIGMAS * np.hypot(da, db), power


# -- ray by ray --------------------------------------------------------------------------------------------------------


def amplitudes(cos, n):
    """r_s, r_p of Fresnel, complex beyond the critical angle, and the cosine beyond."""
    beyond = np.sqrt(1 - (1 - cos**2) / n**2 + 0j)
    beyond = np.where(beyond.imag < 0, -beyond, beyond)
    return (cos - n * beyond) / (cos + n * beyond), (n * cos - beyond) / (n * cos + beyond), beyond


def test_one_cell_ray_by_ray(tmp_path, mitsuba):
    """Every stretch of many rays through one cell in a block against (23), (24) and (29): direction, absorption, and what the faces
    leave of two crossed linear polarizations, followed as fields."""
    import drjit as dr
    import mitsuba as mi

    from optics.transport import Run

    n_wall, n_fill, a_wall, a_fill = 1.5, 1.42, 0.3, 0.7
    t = load(tmp_path, [box("block", clear("walls", n_wall, a_wall), (0.6, 0.6, 0.6), (0, 0, -0.6)),
                        grid((1, 1, 1), clear("filling", n_fill, a_fill, outside="walls"), skin=0.2), screen(30)])
    run = Run(t, [0, 1, 2], 1, 5)
    rng, count, steps = np.random.default_rng(2), 2000, 12
    p = rng.uniform(-4, 4, (count, 3)) * (1, 1, 0) + (0, 0, -6)
    to = rng.uniform(-0.55, 0.55, (count, 3)) + (0, 0, -0.6)
    d = to - p
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    log = dr.zeros(mi.Float, count * steps * 14)

    def along(s, length, sigma, active):
        k = (s["depth"] * count + s["pixel"]) * 14
        numbers = [*s["p"], *s["d"], *s["x"], *s["v"], s["tau"][0]]
        for i, value in enumerate(numbers):
            dr.scatter(log, value, k + i, s["active"] & (s["depth"] < steps))

    x = np.cross(d, (0, 1, 0))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    vector = [mi.Vector3f(*a.T.astype(np.float32)) for a in (d, x)]
    start = {"p": mi.Point3f(*p.T.astype(np.float32)), "d": vector[0], "x": vector[1], "tau": [mi.Float(1.0)] * 3,
             "rng": mi.PCG32(size=count, initstate=7), "pixel": dr.arange(mi.UInt32, count)}
    run.fly(start, False, False, along, lambda *_: mi.Bool(False))
    log = np.array(log).reshape(steps, count, 14).astype(float)
    flown = (np.linalg.norm(log[..., 3:6], axis=-1) > 0.5)
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
            came = n_fill if (np.abs(back - middle) < half).all() else n_wall if (np.abs(back - middle) < 0.6).all() else 1.0
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
            # fields: light comes along -s2, leaves along -s; what the camera saw of it before and after the face
            share = (abs(r_s) ** 2 + abs(r_p) ** 2) / 2
            side = np.cross(s, g)
            if np.linalg.norm(side) < 1e-3:
                continue
            side /= np.linalg.norm(side)
            e_in, e_out = (side, np.cross(-s2, side)), (side, np.cross(-s, side))
            ways = np.diag([r_s, r_p]) / np.sqrt(share) if reflected else np.diag(
                [np.sqrt(1 - abs(r_s) ** 2), np.sqrt(1 - abs(r_p) ** 2)]) / np.sqrt(1 - share) / (n2 / n1)
            for field in ((1, 0), (0, 1), (1, 1), (1, 1j)):  # along the new axes x and k cross x
                field = np.array(field, complex) / np.linalg.norm(field)
                y_in, y_out = np.cross(-s2, now[6:9]), np.cross(-s, was[6:9])
                e = field[0] * now[6:9] + field[1] * y_in
                out = ways @ np.array([e @ e_in[0], e @ e_in[1]])
                e = out[0] * e_out[0] + out[1] * e_out[1]
                a, b = e @ was[6:9], e @ y_out
                seen_before = stokes(a, b) @ was[9:13]
                seen = stokes(*field) @ now[9:13]
                assert abs(seen - seen_before) < 3e-5 * max(1, abs(was[9]) / share), (ray, k)
            checked["total" if reflected and share > 1 - 1e-9 else "reflected" if reflected else "refracted"] += 1
    assert min(checked.values()) > 30, checked


def stokes(a, b):
    """Stokes vector of a field; circular as optics.mueller has it: a quarter-wave plate, fast at 45 degrees, makes S3 > 0 of x."""
    return np.array([abs(a) ** 2 + abs(b) ** 2, abs(a) ** 2 - abs(b) ** 2, 2 * (a * np.conj(b)).real, 2 * (a * np.conj(b)).imag])


def test_the_critical_angle(tmp_path, mitsuba):
    """A ray that leaves glass of 1.5 through its flat face passes to 0.01 deg below asin(1/1.5), and not 0.01 deg above."""
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


# -- two routes, and stock Mitsuba -------------------------------------------------------------------------------------

LAMPS = [f'<shape type="rectangle" id="lamp_{i}"><transform name="to_world"><scale x="1.4" y="1.0"/><lookat origin="{x},{y},-1.4" '
         f'target="0,0,-1.3" up="0,0,1"/></transform>{BLACK}<emitter type="source" id="light_{i}"/></shape>' for i, (x, y) in enumerate(((3, 0), (0, -3)))]
COAT = ('<shape type="rectangle" id="coat"><transform name="to_world"><rotate x="1" angle="180"/><scale x="2.6" y="2.6"/><translate z="0.2"/></transform>'
        '<bsdf type="diffuse"><spectrum name="reflectance" value="0.6"/></bsdf></shape>')


def little_grid(scattering=0.0, coat=COAT, fill=1.4):
    more = f'<float name="scattering" value="{scattering}"/>'
    return [box("block", clear("walls", 1.5, 0.05), (1.8, 1.8, 1.2), (0, 0, -1.2)),
            grid((3, 3, 2), clear("filling", fill, 0.1, outside="walls", more=more), skin=0.4), *LAMPS, *([coat] if coat else [])]


@pytest.mark.parametrize("scattering", [0.0, 0.3])
def test_maps_and_paths_agree(tmp_path, mitsuba, scattering):
    """Pixel by pixel: z has the spread of noise, and no mean; the maps' resolution stays below."""
    t = load(tmp_path, little_grid(scattering), fov=9, size=12)
    quick, slow = t.take(rays=256, packets=200_000), t.take(rays=8000, reach="paths", seed=3)
    for light in range(2):
        sd = np.hypot(quick.error, slow.error)[light]
        z = np.divide(quick.radiance[light] - slow.radiance[light], sd, out=np.zeros_like(sd), where=sd > 0)
        assert np.abs(z.mean()) < SIGMAS / np.sqrt(z[..., 0].size) + 0.1, (light, z.mean())
        assert np.mean(z**2) < 2.0  # of Student's t with some 7 degrees of freedom: 1.4
        off = quick.radiance[light].mean() / slow.radiance[light].mean() - 1
        error = slow.error[light].mean() / slow.radiance[light].mean() / 6
        assert abs(off) < 0.01 + SIGMAS * error, (light, off, error)


def stock(folder, alpha_wall=0.05, alpha_fill=0.1, fill=1.4):
    """The little grid of stock dielectrics and media, with stock lamps, for `volpath`."""
    import mitsuba as mi

    def medium(name, alpha):
        return (f'<medium type="homogeneous" id="{name}"><spectrum name="sigma_t" value="{alpha}"/><spectrum name="albedo" value="0"/></medium>')

    def dielectric(inside, outside, within, without=""):
        around = f'<ref id="{without}" name="exterior"/>' if without else ""
        return (f'<bsdf type="dielectric"><float name="int_ior" value="{inside}"/><float name="ext_ior" value="{outside}"/></bsdf>'
                f'<ref id="{within}" name="interior"/>{around}')

    lamps = [lamp[:lamp.index("<emitter")] + '<emitter type="area"><spectrum name="radiance" value="1"/></emitter></shape>' for lamp in LAMPS]
    bodies = [medium("resin", alpha_wall), medium("support", alpha_fill),
              box("block", dielectric(1.5, 1.0, "resin"), (1.8, 1.8, 1.2), (0, 0, -1.2)),
              grid((3, 3, 2), dielectric(fill, 1.5, "support", "resin"), skin=0.4), *lamps, COAT]
    text = SCENE.replace("BANDS", "540").replace("FOV", "9").replace("BODIES", "\n".join(bodies))
    text = text.replace('<integrator type="tactile"><string name="bands" value="540"/></integrator>',
                        '<integrator type="volpath"><integer name="max_depth" value="512"/><integer name="rr_depth" value="1000"/></integrator>')
    (folder / "stock.xml").write_text(text)
    return mi.load_file(str(folder / "stock.xml"), optimize=False, size="8")


def test_stock_volpath_sees_the_same(tmp_path, mitsuba):
    """The same grid by Mitsuba's own dielectrics, media and integrator, pixel by pixel: z has no mean and the spread of noise."""
    import mitsuba as mi

    t = load(tmp_path, little_grid(), fov=9, variant=MONO, bands="540", size=8)
    ours = t.take(rays=4000, packets=400_000)
    scene = stock(tmp_path)
    runs = np.stack([np.array(mi.render(scene, spp=1500, seed=seed))[..., 0] for seed in range(12)]).astype(float)
    theirs, error = runs.mean(0), runs.std(0, ddof=1) / np.sqrt(len(runs))
    found, own = ours.radiance.sum(0)[..., 0], np.sqrt((ours.error**2).sum(0))[..., 0]
    z = (found - theirs) / np.hypot(error, own)
    assert theirs.mean() > 20 * np.sqrt((error**2).mean()) / 8
    assert abs(z.mean()) < SIGMAS / 8 and 0.5 < np.mean(z**2) < 2.0, (z.mean(), np.mean(z**2))
    # over all pixels to a per cent of what is seen, beside the noise
    assert abs(found.mean() / theirs.mean() - 1) < 0.01 + SIGMAS * np.hypot(*(np.sqrt((e**2).mean()) / 8 for e in (error, own))) / theirs.mean()


def test_derivatives_by_absorption(tmp_path, mitsuba, monkeypatch):
    """Against central differences with common random numbers; faint rays are not thinned, which would draw anew."""
    from optics import transport

    monkeypatch.setattr(transport, "FAINT", 0.0)

    def at(wall, fill, slopes):
        t = load(tmp_path, little_grid(0.2), fov=9, size=4)
        t.scene.set({"walls.absorption": wall, "filling.absorption": fill})
        from optics.transport import Transport

        return Transport(t.scene).take(rays=512, packets=100_000, slopes=slopes)

    here = at(0.05, 0.1, True)
    for name, low, high in (("walls", (0.045, 0.1), (0.055, 0.1)), ("filling", (0.05, 0.095), (0.05, 0.105))):
        difference = (at(*high, False).radiance - at(*low, False).radiance) / 0.01
        # (0.005 l)^2/6 of ways l up to 100 mm, and atomic sums in float32
        np.testing.assert_allclose(here.slopes[name], difference, rtol=0, atol=5e-3 * np.abs(difference).max())
        assert (difference.mean((1, 2)) < 0).all()


def test_what_is_nested_wrongly_is_refused(tmp_path, mitsuba):
    bodies = [box("block", clear("walls", 1.5), (1.8, 1.8, 1.2), (0, 0, -1.2)), grid((3, 3, 2), clear("filling", 1.4), skin=0.4), screen(20)]
    with pytest.raises(BadScene, match="not its neighbour.*`outside` names the wrong material"):
        load(tmp_path, bodies, fov=9).take(rays=8)
    bodies[1] = grid((3, 3, 2), clear("filling", 1.4, outside="wall"), skin=0.4)
    with pytest.raises(BadScene, match="'filling': outside = 'wall'; allowed: .*walls"):
        load(tmp_path, bodies)
