"""Polarized light from single matrices to whole scenes, against the physics written out a second time.

Here matrices are plain (..., 4, 4) arrays of the textbooks' elements along x, turned by rotations of axes; oblique
layers are worked out in world coordinates from their physics: molecules that absorb, the index ellipsoid, Fresnel's
amplitudes. Fields go as exp(-i w t); Stokes vectors stand in axes x (right), y (up) of whom the light reaches, and S3 =
2 Im(E_x conj E_y)."""

from __future__ import annotations

from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from optics.light import paths
from optics.light.development import STEP
from optics.polarization import mueller
from optics.polarization.layers import Crossing, evaluate
from optics.scene.registry import known

RNG = np.random.default_rng  # every test seeds its own
MONO, SPECTRAL = "llvm_ad_mono_polarized", "llvm_ad_spectral_polarized"
BOTH = pytest.mark.parametrize("variant", [MONO, SPECTRAL], indirect=True)
JUST_MONO = pytest.mark.parametrize("variant", [MONO], indirect=True)  # Mitsuba's `stokes` shows no bands
BANDS = {MONO: "540", SPECTRAL: "620, 540, 460"}  # nm
ROUNDING = 1e-10  # of products of some ten 4 x 4 matrices in double precision, along rays that float32 holds exactly
GEOMETRY = (
    5e-6  # of intensities: directions and normals come in float32 (6e-8), and retardances of 1e3 deg multiply them
)
FLOAT32 = 2e-5  # of intensities: matrices in float32 through some ten surfaces, retardances as above


# -- the textbooks' elements -----------------------------------------------------------------------------------------
def rows(*entries):
    """(..., 4, 4) of sixteen entries that broadcast."""
    return np.stack(np.broadcast_arrays(*(np.asarray(e, float) for e in entries)), -1).reshape(
        *np.broadcast_shapes(*(np.shape(e) for e in entries)), 4, 4
    )


def turn(phi):
    """Stokes vectors in axes turned by phi (rad), from x to y."""
    c, s = np.cos(2 * np.asarray(phi)), np.sin(2 * np.asarray(phi))
    return rows(1, 0, 0, 0, 0, c, s, 0, 0, -s, c, 0, 0, 0, 0, 1)


def at(phi, element):
    """An element whose own x axis lies at phi (rad)."""
    return turn(-np.asarray(phi)) @ element @ turn(phi)


def polarizer(along, across=0.0):
    a, b, c = (along + across) / 2, (along - across) / 2, np.sqrt(along * across)
    return rows(a, b, 0, 0, b, a, 0, 0, 0, 0, c, 0, 0, 0, 0, c)


def retarder(delta):
    """A retarder of delta (rad) with its fast axis along x."""
    c, s = np.cos(delta), np.sin(delta)
    return rows(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, c, s, 0, 0, -s, c)


def linear(angle, degree=1.0):
    """Stokes vector of light polarized at an angle (rad)."""
    return np.array([1.0, degree * np.cos(2 * angle), degree * np.sin(2 * angle), 0.0])


def amplitudes(cos1, n):
    """r_s, r_p of Fresnel for a wave on a boundary of relative index n, and the cosine beyond, complex where all is
    reflected."""
    cos2 = np.sqrt(1 - (1 - np.asarray(cos1) ** 2) / n**2 + 0j)
    return (cos1 - n * cos2) / (cos1 + n * cos2), (n * cos1 - cos2) / (n * cos1 + cos2), cos2


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def dot(a, b):
    return (a * b).sum(-1)


def off(found, expected, scale=None):
    """Largest |found - expected| over the largest expected value, or over `scale`."""
    found, expected = np.asarray(found, float), np.asarray(expected, float)
    assert found.shape == expected.shape
    return float((np.abs(found - expected) / (np.abs(expected).max() if scale is None else scale)).max())


# -- stacks of plates ------------------------------------------------------------------------------------------------
class Plate(NamedTuple):
    """A square in the way at z (mm), looking at the camera, spun about its normal and tilted about x and y (deg)."""

    kind: str
    z: float
    spin: float = 0.0
    tilt_x: float = 0.0
    tilt_y: float = 0.0
    bsdf: str = ""  # XML inside <bsdf>

    @property
    def axes(self):
        """Its x axis, its y axis and its normal."""
        turns = (("y", self.tilt_y), ("x", self.tilt_x), ("z", self.spin), ("x", 180.0))
        product = Rotation.identity()
        for axis, angle in turns:
            product = product * Rotation.from_euler(axis, angle, degrees=True)
        return product.as_matrix().T

    def xml(self, name, half=600):
        return f"""<shape type="rectangle" id="{name}_plate"><transform name="to_world"><rotate x="1" angle="180"/>
            <rotate z="1" angle="{self.spin}"/><rotate x="1" angle="{self.tilt_x}"/><rotate y="1" angle="{self.tilt_y}"/>
            <scale value="{half}"/><translate z="{self.z}"/></transform>
            <bsdf type="{self.kind}" id="{name}">{self.bsdf}</bsdf></shape>"""  # noqa: E501


LAMP = Plate("diffuse", 200.0, bsdf='<spectrum name="reflectance" value="0"/>')
CENTRES = (
    '<sampler type="stratified"><boolean name="jitter" value="false"/>'
    '<integer name="sample_count" value="1"/></sampler>'
)
STACK = """<scene version="3.0.0">
    <default name="size" value="1"/><default name="x_fov" value="1"/><default name="bands" value="540"/>
    <integrator type="tactile" id="integrator">
        <string name="bands" value="$bands"/><boolean name="stokes" value="true"/></integrator>
    <sensor type="camera" id="camera"><float name="x_fov" value="$x_fov"/><film type="hdrfilm">
        <integer name="width" value="$size"/><integer name="height" value="$size"/><rfilter type="box"/>
        <string name="component_format" value="float32"/></film>SAMPLER</sensor>
    PLATES
</scene>"""


def loaded(file, variant, **defines):
    from optics.light.renderer import Renderer
    from optics.scene import loader as scene

    found = scene.load(file, {"bands": BANDS[variant], **defines}, variant)
    return found, Renderer(found)


def stack(folder, variant, plates, **defines):
    """A scene of plates (name -> Plate) before a wide lamp, for a camera at the origin that looks along z."""
    lamp = LAMP.xml("lamp", 3000).replace("</shape>", '<emitter type="source" id="source"/></shape>')
    text = STACK.replace("SAMPLER", CENTRES).replace(
        "PLATES", "\n".join([p.xml(n) for n, p in plates.items()] + [lamp])
    )
    file = folder / "stack.xml"
    file.write_text(text)
    return loaded(file, variant, **defines)


def bench(variant, **defines):
    return loaded("polarizer_bench", variant, **defines)


def centred(name, folder):
    """A shipped scene whose renders take one sample per pixel, in its middle."""
    from optics.scene import loader as scene

    text = scene.find(name).read_text(encoding="utf-8")
    start, end = text.index("<sampler"), text.index("</sampler>") + len("</sampler>")
    file = folder / f"{name}.xml"
    file.write_text(text[:start] + CENTRES + text[end:], encoding="utf-8")
    return file


def matrix(scene, renderer, values):
    """(N, B, 4, 4) Mueller matrices from the paths' ends to the camera."""
    path = renderer.hits(values).path
    found = [paths.transmission(scene, path, values, renderer.wavelengths, c) for c in range(4)]
    return np.moveaxis(np.array([np.broadcast_arrays(*row) for row in found]), (0, 1), (-2, -1))


def rendered(scene, values):
    """(4, H, W, B) Stokes vectors by mi.render, of one sample per pixel."""
    import mitsuba as mi

    scene.set({k: v for k, v in values.items() if k in scene.parameters})
    lanes, bands = scene.integrator.lanes, len(scene.integrator.bands)
    image = np.array(mi.render(scene.mitsuba, spp=1, seed=0), float)[..., -4 * lanes :]
    return np.moveaxis(image.reshape(*image.shape[:2], 4, lanes)[..., :bands], 2, 0)


# -- layers by hand --------------------------------------------------------------------------------------------------
def azimuth(axis, k, x):
    """Angle of an axis against x, seen by whom the light along k reaches."""
    return np.arctan2(dot(axis, np.cross(k, x)), dot(axis, x))


def film_by_hand(own, wavelength, k, x, e1, e2):
    """What vibrates along the molecules is absorbed, seen across the ray: t = k x a (Korger 2013)."""
    psi = np.radians(own("scale") * own("angle") + own("offset") + own("approach") * own("backlash") / 2)
    steps, dial = (wavelength - 540) / 100, np.radians(own("angle"))
    t1 = own("transmittance") * np.exp(own("transmittance_slope") * steps)
    cos = np.abs(dot(k, np.cross(e1, e2)))
    t2 = np.maximum(own("leak") + own("leak_tilt") * steps + own("leak_oblique") * (1 - cos**2), 0)
    molecules = np.cos(psi) * e2 - np.sin(psi) * e1
    film = at(azimuth(np.cross(k, molecules), k, x), polarizer(t1 + 0 * t2, t2))
    film = film * (1 + own("wobble_c") * np.cos(dial) + own("wobble_s") * np.sin(dial))
    return own("inserted") * film + (1 - own("inserted")) * np.eye(4)


def birefringent(delta, axis, k, x, e1, e2, index):
    """A sheet that retards by delta (N,) at normal incidence, fast along `axis` (N, rad): by the section of its index
    ellipsoid.

    Across the wave inside, the impermeability 1/N^2 has two axes and two values 1/n^2; over the path d/cos they make
    the retardance. A birefringence of 1e-6 is the limit of a small one."""
    tiny, normal = 1e-6, np.cross(e1, e2)
    fast = np.cos(axis)[:, None] * e1 + np.sin(axis)[:, None] * e2
    slow = np.cross(normal, fast)

    def dyad(v):
        return v[..., :, None] * v[..., None, :]

    impermeability = (
        dyad(fast) / (index - tiny / 2) ** 2 + dyad(slow) / (index + tiny / 2) ** 2 + dyad(normal) / index**2
    )
    cos = dot(k, normal)
    inside = np.sqrt(1 - (1 - cos**2) / index**2)
    bent = k / index + (np.sign(cos) * inside - cos / index)[:, None] * normal
    s = np.cross(k, normal)
    s = unit(np.where(np.linalg.norm(s, axis=-1, keepdims=True) > 1e-9, s, x))
    across = np.stack([s, np.cross(bent, s)], -2)  # s and p of the wave inside
    values, vectors = np.linalg.eigh(across @ impermeability @ np.swapaxes(across, -1, -2))
    n_slow, n_fast = (values[:, i] ** -0.5 for i in range(2))
    leading = vectors[:, :1, 1] * s + vectors[:, 1:, 1] * np.cross(
        k, s
    )  # s stays s and p stays p where the wave leaves
    return at(azimuth(leading, k, x), retarder(delta * (n_slow - n_fast) / tiny / inside))


def stress_by_hand(pattern, x, y, size):
    """(s_xx - s_yy, 2 s_xy) of the patterns, from stress tensors."""
    if pattern == "even":
        return 1 + 0 * x, 0 * x
    if pattern == "bend":
        return 2 * y / size, 0 * x
    # disc: a point load on a half plane spreads as -cos/r along the radius (Flamant), here from the top and below
    total = 0
    for side in (1, -1):
        r = np.stack([x, y - side * size / 2], -1)
        length = np.linalg.norm(r, axis=-1)
        radial = r / length[:, None]
        total = total - (size * -side * radial[:, 1] / length)[:, None, None] * radial[:, :, None] * radial[:, None, :]
    total = np.where((np.hypot(x, y) < size / 2)[:, None, None], total, 0)
    return total[:, 0, 0] - total[:, 1, 1], 2 * total[:, 0, 1]


def sheet_by_hand(own, wavelength, k, x, e1, e2, u, v):
    """Both faces by Fresnel, then depolarization, then retardance, then stress: the order of the effects' keys."""
    normal = np.cross(e1, e2)
    r_s, r_p, _ = amplitudes(np.abs(dot(k, normal)), own("index"))
    t = own("transmittance") * np.exp(own("transmittance_slope") * (wavelength - 540) / 100)
    s = np.cross(k, normal)
    s = np.where(np.linalg.norm(s, axis=-1, keepdims=True) > 1e-9, s, x)
    total = at(azimuth(s, k, x), polarizer(t * (1 - np.abs(r_s) ** 2) ** 2, t * (1 - np.abs(r_p) ** 2) ** 2))
    total = np.diag([1.0] + [1 - own("depolarization")] * 3) @ total
    dial, ratio = np.radians(own("angle")), 540 / wavelength
    delta = np.hypot(own("retard_0"), own("retard_45")) * ratio * (1 + own("retard_dispersion") * (ratio**2 - 1))
    axis = np.arctan2(own("retard_45"), own("retard_0")) / 2 + dial
    total = birefringent(np.radians(delta) + 0 * u, axis + 0 * u, k, x, e1, e2, own("index")) @ total
    c, s = np.cos(dial), np.sin(dial)
    q, p = stress_by_hand(own("stress_pattern"), u * c + v * s, v * c - u * s, own("stress_size"))
    metres = (
        own("stress_optic") * 1e-12 * own("stress") * 1e6 * own("stress_thickness") * 1e-3
    )  # path difference per pattern
    return (
        birefringent(
            2 * np.pi * metres / (wavelength * 1e-9) * np.hypot(q, p),
            np.arctan2(p, q) / 2 + dial,
            k,
            x,
            e1,
            e2,
            own("index"),
        )
        @ total
    )


def camera_rays(size, x_fov, roll=0.0):
    """(N, 3) directions of a square camera at the origin that looks along z, and its vertical, pointing down."""
    spin = Rotation.from_euler("z", roll, degrees=True)
    v, u = np.mgrid[:size, :size] + 0.5
    f = size / 2 / np.tan(np.radians(x_fov) / 2)
    d = np.stack([(u - size / 2) / f, (v - size / 2) / f, 1 + 0 * u], -1).reshape(-1, 3)
    return unit(spin.apply(d)), spin.apply([0.0, 1.0, 0.0])


def follow(plates, values, wavelength, d, vertical, o=(0.0, 0.0, 0.0)):
    """Stokes axes at the end: (M (N, 4, 4) from there to the camera, k, x), for rays (N, 3) through plates in their
    order."""
    total, o = np.eye(4), np.broadcast_to(np.array(o, float), d.shape)
    k, x = -d, unit(np.cross(vertical, d))
    for name, p in plates.items():
        e1, e2, normal = p.axes
        own = lambda parameter, name=name: values[f"{name}.{parameter}"]  # noqa: E731
        o = o + d * (dot(np.array([0, 0, p.z]) - o, normal) / dot(d, normal))[:, None]
        u, v = dot(o - [0, 0, p.z], e1), dot(o - [0, 0, p.z], e2)
        if p.kind == "polarizer_film":
            total = total @ film_by_hand(own, wavelength, k, x, e1, e2)
        elif p.kind == "sheet":
            total = total @ sheet_by_hand(own, wavelength, k, x, e1, e2, u, v)
        # an interface, met from the side of its normal: what comes through is weighed by 1/n^2, and new axes begin
        else:
            n, cos = own("index"), dot(k, normal)
            r_s, r_p, cos2 = amplitudes(cos, n)
            s = np.cross(k, normal)
            s = unit(np.where(np.linalg.norm(s, axis=-1, keepdims=True) > 1e-9, s, x))
            total = total @ turn(-azimuth(s, k, x)) @ polarizer(1 - np.abs(r_s) ** 2, 1 - np.abs(r_p) ** 2) / n**2
            d = d / n + (cos / n - cos2.real)[:, None] * normal
            k, x = -d, unit(np.cross(vertical, d))
            total = total @ turn(azimuth(s, k, x))
    return total, k, x


def source_by_hand(values, k, x, e1):
    q, u = values["source.dop_q"], values["source.dop_u"]
    return (turn(-azimuth(e1, k, x)) @ linear(np.arctan2(u, q) / 2, np.hypot(q, u))[:, None])[..., 0]


FILM = {
    "inserted": (0.5, 1),
    "angle": (-180, 180),
    "transmittance": (0.6, 0.95),
    "transmittance_slope": (-0.05, 0.05),
    "leak": (0.01, 0.3),
    "leak_tilt": (-0.02, 0.02),
    "leak_oblique": (0, 0.1),
    "offset": (-20, 20),
    "scale": (0.9, 1.1),
    "approach": (-1, 1),
    "backlash": (-5, 5),
    "wobble_c": (-0.03, 0.03),
    "wobble_s": (-0.03, 0.03),
}
SHEET = {
    "transmittance": (0.6, 1),
    "transmittance_slope": (-0.2, 0.2),
    "index": (1.0, 1.7),
    "angle": (-180, 180),
    "depolarization": (0, 0.5),
    "retard_0": (-300, 300),
    "retard_45": (-300, 300),
    "retard_dispersion": (-0.5, 0.5),
    "stress": (-5, 5),
    "stress_optic": (1, 6),
    "stress_thickness": (1, 3),
    "stress_size": (500, 800),
}
SOURCE = {"dop_q": (-0.7, 0.7), "dop_u": (-0.7, 0.7)}
DRAWN = {"polarizer_film": FILM, "sheet": SHEET, "interface": {"index": (1.2, 1.6)}}


def drawn(rng, bounds, name):
    return {f"{name}.{p}": rng.uniform(*b) for p, b in bounds.items()}


# -- the bench -------------------------------------------------------------------------------------------------------
TURNS = np.arange(0.0, 360.0, 5.0)


@BOTH
def test_malus_at_every_five_degrees(variant):
    """cos(a - p)^2 T^2/2 of unpolarized light, from a table of readings, from single values, and by mi.render."""
    scene, renderer = bench(variant)
    values = {**scene.values(), "polarizer.angle": 20.0, "polarizer.transmittance": 0.9}
    expected = 0.9 * 0.8 / 2 * np.cos(np.radians(TURNS - 20)) ** 2
    table = renderer.image({**values, "analyzer.angle": TURNS}, "source")
    assert table.shape == (len(TURNS), 1, renderer.bands)
    single = [renderer.stokes({**values, "analyzer.angle": a})[0, 0, 0] for a in TURNS]
    traced = [rendered(scene, {**values, "analyzer.angle": a})[0, 0, 0] for a in TURNS[::3]]
    for band in range(renderer.bands):
        assert off(table[:, 0, band], expected) < ROUNDING
        assert off(np.array(single)[:, band], expected) < ROUNDING
        # the pixel's one ray stands up to 0.7 deg from the axis: sin^2 of that is what the films' seen axes may turn by
        assert off(np.array(traced)[:, band], expected[::3]) < 1e-4


@BOTH
def test_three_polarizers(variant):
    """cos(a)^2 cos(b)^2 for the angles between neighbours: a film between crossed ones brings light back."""
    scene, renderer = bench(variant, middle=1)
    a, b = (x.ravel() for x in np.meshgrid(np.radians(TURNS), np.radians(TURNS)))
    values = {
        **scene.values(),
        "polarizer.angle": 10.0,
        "middle.angle": 10 + np.degrees(a),
        "analyzer.angle": 10 + np.degrees(a + b),
    }
    assert off(renderer.image(values, "source")[:, 0, 0], 0.8**3 / 2 * np.cos(a) ** 2 * np.cos(b) ** 2) < ROUNDING


@BOTH
def test_wave_plates_turn_light_as_the_textbooks_say(variant):
    """Half a wave mirrors the plane at the fast axis; a quarter makes S3 = sin 2(axis - plane), and +-1 at 45
    degrees."""
    scene, renderer = bench(variant)
    ratio = 540 / renderer.wavelengths  # the plates are made for 540 nm, and only there half or a quarter of a wave
    middle = int(np.argmin(np.abs(ratio - 1)))
    for plane in (0.0, 25.0, 100.0):
        for axis in (0.0, 30.0, 45.0, 130.0):
            values = {
                **scene.values(),
                "analyzer.inserted": 0.0,
                "polarizer.angle": plane,
                "polarizer.transmittance": 1.0,
            }
            for delta in (180.0, 90.0, 37.0):
                found = renderer.stokes({**values, "sample.retard_0": delta, "sample.angle": axis})[:, 0, 0] * 2
                plates = at(np.radians(axis), retarder(np.radians(delta * ratio)))
                expected = (plates @ linear(np.radians(plane))).T
                assert off(found, expected) < ROUNDING
                turned = renderer.stokes({**values, "sample.retard_45": delta, "sample.angle": axis - 45})[:, 0, 0] * 2
                assert off(turned, expected) < ROUNDING
                if delta == 180:
                    assert off(found[:, middle], linear(np.radians(2 * axis - plane))) < ROUNDING
                if delta == 90:
                    assert abs(found[3, middle] - np.sin(np.radians(2 * (axis - plane)))) < ROUNDING


def test_retardance_follows_the_wavelength(mitsuba):
    """delta = 2 pi d dn/lambda, with the sample's dispersion, and the stress-optic law in SI units; read as angle of S2
    and S3."""
    scene, renderer = bench(SPECTRAL, bands="660, 540, 470, 430")
    values = {**scene.values(), "analyzer.inserted": 0.0, "polarizer.angle": 45.0}
    nm = renderer.wavelengths

    def angle(**sample):
        s = renderer.stokes({**values, **{f"sample.{k}": v for k, v in sample.items()}})[:, 0, 0]
        return np.arctan2(-s[3], s[2])

    assert off(angle(retard_0=100.0), np.radians(100 * 540 / nm)) < ROUNDING
    bent = np.radians(80 * 540 / nm * (1 + 0.3 * ((540 / nm) ** 2 - 1)))
    assert off(angle(retard_0=80.0, retard_dispersion=0.3), bent) < ROUNDING
    # 4 MPa in 3 mm of 5 Brewster: a path difference of 60 nm
    assert off(angle(stress=4.0, stress_optic=5.0, stress_thickness=3.0), 2 * np.pi * 60 / nm) < ROUNDING
    assert off(angle(stress=4.0, retard_0=-25.0), 2 * np.pi * 60 / nm - np.radians(25 * 540 / nm)) < ROUNDING


@BOTH
def test_a_polarization_ratio_of_99_percent(variant):
    """T2 = T1 (1 - P)/(1 + P): the contrast (max - min)/(max + min) of one film in polarized light is P, that of two
    P^2."""
    scene, renderer = bench(variant)
    ratio, t1 = 0.99, 0.76
    t2 = t1 * (1 - ratio) / (1 + ratio)
    assert t2 == pytest.approx(0.005 * t1, rel=0.01)  # as the film's docstring rounds it
    values = {**scene.values(), "analyzer.angle": TURNS}
    for name in ("analyzer", "polarizer"):
        values.update({f"{name}.transmittance": t1, f"{name}.leak": t2})
    one = renderer.image({**values, "polarizer.inserted": 0.0, "source.dop_q": 1.0}, "source")[:, 0, 0]
    assert np.ptp(one) / (one.max() + one.min()) == pytest.approx(ratio, rel=ROUNDING)
    two = renderer.image(values, "source")[:, 0, 0]
    assert np.ptp(two) / (two.max() + two.min()) == pytest.approx(ratio**2, rel=ROUNDING)
    c2 = np.cos(np.radians(TURNS)) ** 2
    assert off(two, (t1**2 + t2**2) / 2 * c2 + t1 * t2 * (1 - c2)) < ROUNDING


# -- single matrices -------------------------------------------------------------------------------------------------
KNOWN = ((45.0, 36.239), (51.782, 45.000), (60.0, 40.336), (75.0, 21.902), (85.0, 7.425))  # deg, n = 1.49661


def test_total_reflection_retards_by_the_known_angles():
    """Known retardances, the argument of Fresnel's complex amplitudes, and the maximum tan(d/2) = (1 - n^2)/(2n)."""
    n = 1 / 1.49661
    angle, known = np.array(KNOWN).T
    found = np.degrees(mueller.total_reflection_phase(np.cos(np.radians(angle)), n))
    assert np.abs(found - known).max() < 1e-3  # the digits they were given with; 0.01 deg is what a rhomb needs
    dense = np.linspace(np.arcsin(n) + 1e-6, np.pi / 2, 500)
    for index in (n, 1 / 1.51, 1 / 2.4):
        inside = np.maximum(dense, np.arcsin(index) + 1e-6)
        r_s, r_p, _ = amplitudes(np.cos(inside), index)
        found = mueller.total_reflection_phase(np.cos(inside), index)
        assert np.abs(np.exp(1j * found) - r_s / r_p).max() < 1e-10
        # at the best angle, sin^2 = 2 n^2/(1 + n^2), the slope is 0: exact to rounding
        best = mueller.total_reflection_phase(np.sqrt(1 - 2 * index**2 / (1 + index**2)), index)
        assert np.tan(best / 2) == pytest.approx((1 - index**2) / (2 * index), rel=1e-12)
    below = np.arcsin(n) - 0.01
    assert mueller.total_reflection_phase(np.cos(below), n) == 0


@pytest.mark.parametrize(("index", "angle"), [(1.51, 48 + 37 / 60), (1.51, 54 + 37 / 60), (1.49661, 51.782)])
def test_two_reflections_in_fresnels_rhomb_make_a_quarter_wave_plate(index, angle):
    """Born & Wolf, 1.5.4: glass of n = 1.51 at 48 37' or 54 37'. Light at 45 degrees leaves circular, with the
    handedness that the fields of both reflections have."""
    cos = np.cos(np.radians(angle))
    reflection = mueller.fresnel_reflection(cos, 1 / index).numpy()
    s = reflection @ reflection @ linear(np.pi / 4)
    r_s, r_p, _ = amplitudes(cos, 1 / index)
    field_s, field_p = r_s**2, r_p**2  # the signs of p at two mirrors cancel
    assert abs(s[3] - (field_s * np.conj(field_p)).imag) < 1e-12
    # half a minute of the angle, at most 1.5 deg per deg in each of two reflections
    assert np.degrees(np.arctan2(np.hypot(s[1], s[2]), s[3])) < 0.03


@pytest.mark.parametrize("n", [1.33, 1.5, 2.4, 1 / 1.41])
def test_light_reflected_at_brewsters_angle_is_polarized_across_the_plane(n):
    for angle, pure in ((np.arctan(n), True), (np.arctan(n) - 0.05, False), (0.3, False)):
        s = mueller.fresnel_reflection(np.cos(angle), n).numpy()[:, 0]
        if pure:
            assert s[1] == pytest.approx(s[0], rel=1e-12)
            assert s[0] == pytest.approx(((n**2 - 1) / (n**2 + 1)) ** 2 / 2, rel=1e-12)  # r_s there
        else:
            assert 0 < s[1] < 0.999 * s[0]
    assert mueller.fresnel_reflection(np.cos(np.arctan(n)), n).numpy()[2, 2] == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("n", [1.33, 1.5, 1 / 1.41, 1 / 1.49661])
def test_reflectance_is_the_same_from_both_sides_and_nothing_is_lost(n):
    """R(theta_1, n) = R(theta_2, 1/n), and |r|^2 + n cos2/cos1 |t|^2 = 1 with the amplitudes t of the electric
    field."""
    cos1 = np.linspace(1, 0.02, 200)
    cos1 = cos1[1 - (1 - cos1**2) / n**2 > 1e-6]
    r_s, r_p, cos2 = mueller.fresnel(cos1, n)
    back_s, back_p, back = mueller.fresnel(cos2, 1 / n)
    assert off(back, cos1) < 1e-9  # the root of a difference that cancels at grazing angles
    assert off(back_s, r_s) < 1e-9 and off(back_p, r_p) < 1e-9
    beam = n * cos2 / cos1
    assert off(r_s + beam * (2 * cos1 / (cos1 + n * cos2)) ** 2, 1 + 0 * cos1) < 1e-12
    assert off(r_p + beam * (2 * cos1 / (n * cos1 + cos2)) ** 2, 1 + 0 * cos1) < 1e-12
    if n < 1:
        assert mueller.fresnel(0.9 * np.sqrt(1 - n**2), n)[:2] == (1, 1)
    reflection = mueller.fresnel_reflection(cos1, n).numpy()
    assert off(reflection[..., 0, 0], (r_s + r_p) / 2) < 1e-12
    assert off(reflection[..., 2, 2], np.real(amplitudes(cos1, n)[0] * amplitudes(cos1, n)[1])) < 1e-12


@pytest.mark.parametrize("index", [1.41, 1 / 1.41])
def test_an_interface_in_a_white_furnace_passes_what_it_does_not_reflect(mitsuba, tmp_path, index):
    """Light of radiance 1 from all of medium 2: what leaves into medium 1 (T/n^2, over its directions) and what is
    reflected (over directions in medium 2) add up to pi, and with n^2 in the way of etendue T is the same in both
    directions."""
    scene, _ = stack(
        tmp_path, SPECTRAL, {"window": Plate("interface", 20.0, bsdf=f'<float name="index" value="{index}"/>')}
    )
    values = {**scene.values(), "window.index": index}
    x, w = np.polynomial.legendre.leggauss(200)
    zero = np.zeros((200, 1))

    def passed(cos, sign):
        sine = np.sqrt(1 - cos**2)
        crossing = Crossing(
            (-sine[:, None], zero, sign * cos[:, None]), (zero, zero + 1, zero), zero, zero, np.array([540.0])
        )
        return paths.layer_matrix(scene, "window", crossing, values).numpy()[:, 0]

    def flux(of, limit):
        """int of(cos theta) cos theta d omega up to an angle at which it may have a root: theta = limit (1 - t^2)."""
        t = (x + 1) / 2
        theta = limit * (1 - t**2)
        return 2 * np.pi * (of(np.cos(theta)) * np.cos(theta) * np.sin(theta) * limit * 2 * t * w / 2).sum()

    ends = [np.arcsin(min(1, n)) for n in (index, 1 / index)]  # in medium 1, in medium 2: beyond, all is reflected
    away = flux(lambda c: passed(c, 1)[:, 0, 0], ends[0])
    kept = (
        flux(lambda c: sum(np.abs(r) ** 2 for r in amplitudes(c, 1 / index)[:2]) / 2, ends[1])
        + np.pi * np.cos(ends[1]) ** 2
    )
    assert away + kept == pytest.approx(np.pi, rel=1e-9)  # 200 points of a smooth function
    cos1 = np.linspace(0.99, np.cos(ends[0]) + 0.01, 200)
    cos2 = np.sqrt(1 - (1 - cos1**2) / index**2)
    assert off(passed(cos1, 1) * index**2, passed(cos2, -1) / index**2) < 1e-9


def test_signs_are_mitsubas(mitsuba):
    """Retarder, diattenuator, turned elements, rotation of axes and specular reflection below and beyond the critical
    angle."""
    mi = mitsuba
    rng = RNG(1)
    phi, delta, t1, t2 = (
        rng.uniform(-np.pi, np.pi, 50),
        rng.uniform(-6, 6, 50),
        rng.uniform(0, 1, 50),
        rng.uniform(0, 1, 50),
    )
    q, u = np.cos(2 * phi), np.sin(2 * phi)

    def theirs(name, *values):
        made = getattr(mi.mueller, name)(
            *(v if not isinstance(v, np.ndarray) else mi.Float(v.astype(np.float32)) for v in values)
        )
        return np.moveaxis(np.array(made), -1, 0)

    f = [mi.Float(v.astype(np.float32)) for v in (phi, delta, t1, t2)]
    single = 5e-6  # Mitsuba's side is float32, angles up to 6 rad
    for ours, element in (
        (mueller.retarder(delta * q, delta * u), mi.mueller.linear_retarder(f[1])),
        (mueller.diattenuator(q, u, t1, t2), mi.mueller.diattenuator(f[2], f[3])),
    ):
        assert off(ours.numpy(), theirs("rotated_element", f[0], element)) < single
    assert off(mueller.retarder(delta * q, delta * u).numpy(), at(phi, retarder(delta))) < 1e-12
    assert off(mueller.diattenuator(q, u, t1, t2).numpy(), at(phi, polarizer(t1, t2))) < 1e-12
    assert off(mueller.rotation(q, u).numpy(), theirs("rotator", phi)) < single
    assert off(mueller.rotation(q, u).numpy(), turn(phi)) < 1e-12
    for n in (1.5, 1 / 1.5):
        cos = rng.uniform(0.05, 1, 50)
        cos = cos[np.abs(1 - (1 - cos**2) / n**2) > 1e-3]  # roots of float32 differences at the critical angle
        expected = theirs("specular_reflection", cos, mi.Complex2f(n, 0.0))
        assert off(mueller.fresnel_reflection(cos, n).numpy(), expected) < 1e-4  # as above, by the root
    assert (expected[:, 2, 3] != 0).any() and (expected[:, 2, 3] == 0).any()


def test_an_element_met_from_behind_is_its_mirror_image():
    """In axes (-x, y) an axis at phi lies at -phi, and the first element becomes the last."""
    rng = RNG(2)
    phi, delta, t1, t2 = rng.uniform(-3, 3, 20), rng.uniform(-6, 6, 20), rng.uniform(0, 1, 20), rng.uniform(0, 1, 20)
    q, u = np.cos(2 * phi), np.sin(2 * phi)
    plates, films = mueller.retarder(delta * q, delta * u), mueller.diattenuator(q, u, t1, t2)
    assert off(plates.reversed.numpy(), at(-phi, retarder(delta))) < 1e-12
    assert off(films.reversed.numpy(), at(-phi, polarizer(t1, t2))) < 1e-12
    assert off((plates @ films).reversed.numpy(), at(-phi, polarizer(t1, t2)) @ at(-phi, retarder(delta))) < 1e-12
    assert off(plates.reversed.reversed.numpy(), plates.numpy()) < 1e-12


# -- stacks of layers ------------------------------------------------------------------------------------------------
def summed(elements):
    """(4, 4) that a row of elements leaves of light that passes them in order, all reflections solved for at once.

    Elements are matrices, or numbers: the reflectances of clear faces. Stokes vectors keep the axes x, y of the room on
    both ways, S3 the phase between them: a face returns r S, and a layer met from behind has the transposed Jones
    matrix."""
    count, flip = len(elements), np.diag([1, 1, 1, -1])
    system, start = np.eye(8 * (count + 1)), np.zeros((8 * (count + 1), 4))
    forth, back = (lambda gap: slice(8 * gap, 8 * gap + 4)), (lambda gap: slice(8 * gap + 4, 8 * gap + 8))
    start[forth(0)] = np.eye(4)
    for gap, element in enumerate(elements):
        r = element * np.eye(4) if np.ndim(element) == 0 else np.zeros((4, 4))
        through, behind = (
            ((1 - element) * np.eye(4),) * 2 if np.ndim(element) == 0 else (element, flip @ element.T @ flip)
        )
        system[forth(gap + 1), forth(gap)] -= through
        system[forth(gap + 1), back(gap + 1)] -= r
        system[back(gap), back(gap + 1)] -= behind
        system[back(gap), forth(gap)] -= r
    return np.linalg.solve(system, start)[forth(count)]


STRAIGHT = ("polarizer_film", "sheet", "polarizer_film", "sheet", "sheet", "polarizer_film")


def straight(folder, variant):
    plates = {f"layer_{i}": Plate(kind, 20.0 + 25 * i) for i, kind in enumerate(STRAIGHT)}
    scene, renderer = stack(folder, variant, plates)
    return scene, renderer, plates


def explicit(values, name, kind, wavelength):
    """A layer's matrix at normal incidence in its middle, from its angles alone."""
    own, steps = (lambda p: values[f"{name}.{p}"]), (wavelength - 540) / 100
    dial = np.radians(own("angle"))
    if kind == "polarizer_film":
        axis = np.radians(own("scale") * own("angle") + own("offset") + own("approach") * own("backlash") / 2)
        t1 = own("transmittance") * np.exp(own("transmittance_slope") * steps)
        film = at(axis, polarizer(t1, max(own("leak") + own("leak_tilt") * steps, 0)))
        film = film * (1 + own("wobble_c") * np.cos(dial) + own("wobble_s") * np.sin(dial))
        return own("inserted") * film + (1 - own("inserted")) * np.eye(4)
    n, ratio = own("index"), 540 / wavelength
    clear = own("transmittance") * np.exp(own("transmittance_slope") * steps) * (4 * n / (n + 1) ** 2) ** 2
    delta = np.hypot(own("retard_0"), own("retard_45")) * ratio * (1 + own("retard_dispersion") * (ratio**2 - 1))
    wave = at(dial + np.arctan2(own("retard_45"), own("retard_0")) / 2, retarder(np.radians(delta)))
    load = (
        2 * np.pi * own("stress_optic") * own("stress") * own("stress_thickness") / wavelength
    )  # 1e-12/Pa MPa mm/nm = 1
    if own("stress_pattern") == "disc":  # in the middle of a pressed disc s_xx - s_yy is 4 times 2P/(pi D d)
        load = 4 * load
    return at(dial, retarder(load)) @ wave @ np.diag([1.0] + [1 - own("depolarization")] * 3) * clear


@BOTH
def test_a_stack_at_normal_incidence_is_the_product_of_its_matrices(variant, tmp_path):
    """All sixteen entries, in every band, for random settings of everything that a film and a sheet can do."""
    scene, renderer, plates = straight(tmp_path, variant)
    rng = RNG(3)
    for trial in range(20):
        values = scene.values()
        for name, p in plates.items():
            values.update(drawn(rng, DRAWN[p.kind], name))
        values.update({f"layer_{i}.stress_pattern": "disc" if trial % 2 else "even" for i in (1, 3, 4)})
        for name in plates if trial >= 10 else ():
            if f"{name}.leak" in values:
                values[f"{name}.leak"] = values[f"{name}.leak_tilt"] = (
                    0.0  # nothing passes across: as ideal as films are
                )
        found = matrix(scene, renderer, values)[0]
        for band, wavelength in enumerate(renderer.wavelengths):
            expected = np.eye(4)
            for name, p in plates.items():
                expected = expected @ explicit(values, name, p.kind, wavelength)
            assert off(found[band], expected) < ROUNDING


def film_with_faces(matrix, r):
    """A film's transmittances are those of the whole film, the losses of both its faces included."""
    return [r, matrix / (1 - r) ** 2, r]


def test_faces_of_films_reflect_to_and_fro(mitsuba, tmp_path):
    """The sum over all ways against the solution of all ways at once."""
    scene, renderer, plates = straight(tmp_path, SPECTRAL)
    rng = RNG(4)
    for _ in range(10):
        values, elements = scene.values(), []
        for name, p in reversed(plates.items()):
            values.update(drawn(rng, DRAWN[p.kind], name))
            alone = explicit(values, name, p.kind, 540.0)
            if p.kind == "polarizer_film":
                values[f"{name}.face"] = rng.uniform(0, 0.06)
                elements += film_with_faces(alone, values[f"{name}.face"] * values[f"{name}.inserted"])
            else:
                elements.append(alone)
        found = matrix(scene, renderer, values)[0, list(renderer.wavelengths).index(540.0)]
        # left out is the fifth round trip between a face and all that stands behind it, at most four times as bright:
        # (4 r^2)^5
        assert off(found, summed(elements)) < 6e-10


def random_stack(rng):
    """Plates that are spun and tilted, and all that they can do: in front a window of two faces, behind it films and
    sheets."""
    kinds = ["interface", "interface", *rng.permutation(["polarizer_film", "polarizer_film", "sheet", "sheet"])]
    plates, values = {}, {}
    for i, kind in enumerate(kinds):
        spin, tilts = rng.uniform(-180, 180), rng.uniform(-4, 4, 2)
        plates[f"layer_{i}"] = Plate(str(kind), 20.0 + 30 * i, spin, *tilts)
        values.update(drawn(rng, DRAWN[kind], f"layer_{i}"))
        if kind == "sheet":
            values[f"layer_{i}.stress_pattern"] = str(rng.choice(["even", "disc", "bend"]))
    values["layer_1.index"] = 1.05 / values["layer_0.index"]  # out of the glass into something a little denser than air
    return plates, {**values, **drawn(rng, SOURCE, "source")}


@pytest.mark.slow
@BOTH
@pytest.mark.parametrize("seed", [5, 6])
def test_a_tilted_stack_before_a_wide_camera(variant, tmp_path, seed):
    """Prediction and mi.render, pixel by pixel in all four components, against physics in world coordinates."""
    plates, drawn_values = random_stack(RNG(seed))
    scene, renderer = stack(tmp_path, variant, plates, size=9, x_fov=80)
    values = {**scene.values(), **drawn_values, "camera.roll": 23.0}
    found = renderer.stokes(values)
    assert not renderer.hits(values).edges.any()  # every plate fills the view: what a pixel's middle sees is the pixel
    d, vertical = camera_rays(9, 80, 23.0)
    for band, wavelength in enumerate(renderer.wavelengths):
        through, k, x = follow(plates, values, wavelength, d, vertical)
        expected = (through @ source_by_hand(values, k, x, LAMP.axes[0])[..., None])[..., 0]
        assert off(found[..., band].reshape(4, -1).T, expected, expected[:, :1]) < GEOMETRY
    # rays that Mitsuba sends on start beside the surface, by 1e-4 of its coordinates: patterns of stress are met
    # elsewhere
    assert off(rendered(scene, values), found, found[:1]) < 1e-4
    # oblique rays see other axes and longer ways: the axial matrix alone would be far off
    assert off(found, found[:, 4:5, 4:5] + 0 * found, found[:1]) > 0.05


def stock(mi, shapes, fov, size):
    """(4, H, W) Stokes vectors by `stokes(volpath)` of plates before an area light of radiance 1."""
    scene = mi.load_dict(
        {
            "type": "scene",
            **shapes,
            "lamp": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate([0, 0, 200]).scale(3000).rotate([1, 0, 0], 180),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}},
                "emitter": {"type": "area", "radiance": {"type": "uniform", "value": 1.0}},
            },
            "integrator": {"type": "stokes", "own": {"type": "volpath", "max_depth": 3}},
            "sensor": {
                "type": "perspective",
                "fov": fov,
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 0], [0, 0, 1], [0, -1, 0]),
                "sampler": {"type": "stratified", "jitter": False, "sample_count": 1},
                "film": {
                    "type": "hdrfilm",
                    "width": size,
                    "height": size,
                    "rfilter": {"type": "box"},
                    "component_format": "float32",
                },
            },
        },
        optimize=False,
    )
    image = np.array(mi.render(scene, spp=1), float)[..., -12:]
    return np.moveaxis(image.reshape(size, size, 4, 3)[..., 0], -1, 0)


@JUST_MONO
def test_stock_polarizers_and_retarders_on_the_axis(variant, tmp_path):
    """Mitsuba's own plates under its own integrator `stokes(volpath)`; the `theta` of its polarizer turns the other way
    round."""
    import mitsuba as mi

    scene, renderer = stack(
        tmp_path,
        variant,
        {
            f"layer_{i}": Plate(k, 20.0 + 20 * i)
            for i, k in enumerate(("polarizer_film", "sheet", "sheet", "polarizer_film"))
        },
        x_fov=1,
    )
    rng = RNG(7)
    for last in (0.0, 1.0):  # with and without the analyser
        theta, delta = rng.uniform(-90, 90, 4), rng.uniform(-180, 180, 4)
        values, shapes = {**scene.values(), "layer_0.inserted": last}, {}
        for i, (name, angle) in enumerate(zip(("layer_0", "layer_1", "layer_2", "layer_3"), theta)):
            values[f"{name}.angle"] = angle
            if i in (1, 2):
                values[f"{name}.retard_0"] = delta[i]
                own = {"type": "retarder", "delta": {"type": "uniform", "value": delta[i]}}
            else:
                own = {"type": "polarizer", "transmittance": {"type": "uniform", "value": 0.8}}
            own["theta"] = {"type": "uniform", "value": angle if i in (1, 2) else -angle}
            shapes[name] = {
                "type": "rectangle",
                "bsdf": own,
                "to_world": mi.ScalarTransform4f().translate([0, 0, 20.0 + 20 * i]).scale(50).rotate([1, 0, 0], 180),
            }
        if not last:
            del shapes["layer_0"]
        found = stock(mi, shapes, 0.002, 2)
        expected = renderer.stokes(values)[:, 0, 0, 0]
        assert np.abs(expected[1:]).min() > 0.01 * expected[0] or last  # behind the plates all components are there
        # float32, and rays up to 0.001 deg from the axis, with which the retarders' axes turn
        assert off(found, expected[:, None, None] + 0 * found, expected[0]) < FLOAT32


# -- crossed films in a wide field -----------------------------------------------------------------------------------
@JUST_MONO
def test_crossed_films_in_a_wide_field(variant, tmp_path):
    """Korger et al. (2013): T = |t1.t2|^2/2 with t = k x a/|k x a|, in every azimuth up to 62 deg from the axis; dark
    along both films' axes, bright between them. Mitsuba's `polarizer` is of the same kind."""
    import mitsuba as mi

    size, fov = 41, 106
    scene, renderer = stack(
        tmp_path,
        variant,
        {n: Plate("polarizer_film", z) for n, z in (("front", 20.0), ("rear", 40.0))},
        size=size,
        x_fov=fov,
    )
    d = camera_rays(size, fov)[0].reshape(size, size, 3)
    assert np.degrees(np.arccos(d[..., 2].min())) > 60
    for first in (0.0, 35.0):
        values = {
            **scene.values(),
            "front.angle": first,
            "rear.angle": first + 90,
            "front.transmittance": 1.0,
            "rear.transmittance": 1.0,
        }
        found = renderer.stokes(values)[0, ..., 0]
        t = []
        for angle in np.radians([first, first + 90]):  # counterclockwise as the camera sees it: y points down
            molecules = np.array([-np.sin(angle), -np.cos(angle), 0])
            t.append(unit(np.cross(d, molecules)))
        expected = dot(*t) ** 2 / 2
        assert expected.max() > 0.05
        assert off(found, expected, 0.5) < 1e-6  # directions in float32
        assert found[size // 2, size // 2] < 1e-15
        films = {
            f"film_{i}": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate([0, 0, 20 + 20 * i]).scale(600).rotate([1, 0, 0], 180),
                "bsdf": {"type": "polarizer", "theta": {"type": "uniform", "value": -angle}},
            }
            for i, angle in enumerate((first, first + 90))
        }
        assert off(stock(mi, films, fov, size)[0], expected, 0.5) < FLOAT32
        if first == 0:
            arms = np.concatenate([found[size // 2], found[:, size // 2]])
            assert arms.max() < 1e-12  # s and p of both films coincide there: rounding
            corner = found[0, 0]
            assert corner == pytest.approx(found[-1, 0], rel=1e-5) == pytest.approx(found[0, -1], rel=1e-5)
            # in the diagonal azimuth at theta the axes enclose 2 atan(cos theta): dark by cos^2 of it
            cos = d[0, 0, 2]
            assert corner == pytest.approx(0.5 * np.cos(2 * np.arctan(cos)) ** 2, rel=1e-5)


# -- what light can be -----------------------------------------------------------------------------------------------
def crossings(rng, count, wavelengths=(400.0, 540.0, 700.0)):
    """Light from both sides up to 80 deg from the normal, in any axes across it."""
    cos, phi, roll = (
        rng.uniform(np.cos(np.radians(80)), 1, count),
        rng.uniform(0, 2 * np.pi, count),
        rng.uniform(0, 7, count),
    )
    sine = np.sqrt(1 - cos**2)
    k = np.stack([sine * np.cos(phi), sine * np.sin(phi), cos * rng.choice([-1, 1], count)], -1)
    s = unit(np.cross(k, rng.normal(size=(count, 3))))
    x = np.cos(roll)[:, None] * s + np.sin(roll)[:, None] * np.cross(k, s)
    u, v = rng.uniform(-30, 30, (2, count, 1))
    return Crossing(*(tuple(a[:, i : i + 1] for i in range(3)) for a in (k, x)), u, v, np.array(wavelengths))


def settings(rng, kind, count):
    """Values of every parameter anywhere within its bounds (angles within two turns), each neutral in a quarter of the
    draws."""
    own = {}
    for p in known().parameters_of(kind):
        if not p.is_number:
            own[p.name] = p.default
            continue
        low, high = np.clip(p.bounds, -720, 720) if p.unit == "deg" else p.bounds
        own[p.name] = rng.uniform(low, high, (count, 1))
        if p.neutral is not None:
            own[p.name] = np.where(rng.random((count, 1)) < 0.25, p.neutral, own[p.name])
    return own


def largest_transmittance(kind, own, crossing):
    """What the parameters alone say of it, to leave out films that would be sources of light."""
    steps = (crossing.wavelengths - 540) / 100
    high = own.get("transmittance", 1.0) * np.exp(own.get("transmittance_slope", 0.0) * steps)
    if kind == "polarizer_film":
        high = np.maximum(high, own["leak"] + own["leak_tilt"] * steps + own["leak_oblique"] * (1 - crossing.cos**2))
        dial = np.radians(own["angle"])
        high = high * (1 + own["wobble_c"] * np.cos(dial) + own["wobble_s"] * np.sin(dial))
    if kind == "sheet":
        high = high * (1 + dichroism_of(own, crossing))
    return high


def dichroism_of(own, crossing):
    """Diattenuation that a ray sees of a sheet, to be left room for: the sheet's transmittance is a mean."""
    turn = np.radians(2 * own["angle"])
    a = own["dichroism_0"] * np.cos(turn) - own["dichroism_45"] * np.sin(turn)
    b = own["dichroism_0"] * np.sin(turn) + own["dichroism_45"] * np.cos(turn)
    return np.tanh(np.hypot(*crossing.retardance(a, b, own["index"])))


@pytest.mark.parametrize("kind", sorted(kind for kind, part in known().parts.items() if part.mueller is not None))
def test_layers_are_physical_for_all_settings_and_directions(mitsuba, kind):
    """Cloude's eigenvalues are >= 0 for every setting within bounds, a leak above the transmittance and huge
    retardances too.

    Left out of the gain alone, and of nothing else: settings whose slopes and wobbles lift a transmittance above 1,
    which the bounds, made for each parameter by itself, do not forbid."""
    rng = RNG(8)
    for pattern in ("even", "disc", "bend"):
        crossing, own = crossings(rng, 4000), settings(rng, kind, 4000)
        if "stress_pattern" in own:
            own["stress_pattern"] = pattern
        own = {"name": kind, "field": None, **own}
        found = evaluate(
            known().parts[kind].mueller, crossing, SimpleNamespace(**own), known().at_stage(kind, "layer")
        ).numpy()
        assert np.isfinite(found).all()
        dark = found[..., 0, 0] < 1e-12  # of a film that lets nothing through eigenvalues are rounding
        assert dark.mean() < 0.05
        assert mueller.physical(found)[~dark].min() >= -1e-12
        allowed = np.broadcast_to(largest_transmittance(kind, own, crossing) <= 1, dark.shape)
        assert allowed.mean() > 0.3
        assert 0.5 < mueller.gain(found)[allowed].max() <= 1 + 1e-12


@pytest.mark.parametrize("index", [0.5, 1 / 1.41, 1.0, 1.41, 2.5])
def test_interfaces_are_physical_from_all_sides(mitsuba, tmp_path, index):
    """Power is transmitted by n^2 times the matrix of the radiance; beyond the critical angle nothing is."""
    scene, _ = stack(tmp_path, SPECTRAL, {"window": Plate("interface", 20.0)})
    crossing = crossings(RNG(9), 2000, (540.0,))
    found = paths.layer_matrix(scene, "window", crossing, {**scene.values(), "window.index": index}).numpy()
    n = np.where(crossing.k[2] > 0, index, 1 / index)
    lit = n > np.sqrt(1 - crossing.cos**2)
    assert (found[~lit] == 0).all()
    assert mueller.physical(found[lit]).min() >= -1e-12
    assert mueller.gain(found * (n**2)[..., None, None]).max() <= 1 + 1e-12
    for cos, m in ((crossing.cos, index), (crossing.cos, 1 / index)):
        reflection = mueller.fresnel_reflection(cos[:, 0], m + 0 * cos[:, 0]).numpy()
        assert mueller.physical(reflection).min() >= -1e-12
        assert mueller.gain(reflection).max() <= 1 + 1e-12


def test_slabs_with_reflecting_faces_keep_the_energy(mitsuba):
    """What a row of films with faces transmits and reflects, from both sides: realisable, and together no more than
    came."""
    rng = RNG(10)
    count = 2000
    share = np.where(rng.random((count, 1)) < 0.2, 0.0, rng.uniform(0, 0.5, (count, 1)))
    stacked = None
    for kind in ("polarizer_film", "sheet", "polarizer_film"):
        crossing, own = crossings(rng, count, (540.0,)), settings(rng, kind, count)
        if kind == "polarizer_film":
            # left out: transmittances that are no film's: above 1, as before, and above what its two faces let through
            faces = (1 - share) ** 2
            own.update(
                wobble_c=0.0,
                wobble_s=0.0,
                inserted=1.0,
                transmittance=own["transmittance"] * faces,
                leak_tilt=0.0,
                leak=own["leak"] / 2 * faces,
                leak_oblique=own["leak_oblique"] * faces,
            )
        else:
            own["transmittance"] = own["transmittance"] / (1 + dichroism_of(own, crossing))
        matrices = evaluate(
            known().parts[kind].mueller,
            crossing,
            SimpleNamespace(name=kind, field=None, **own),
            known().at_stage(kind, "layer"),
        )
        slab = mueller.Slab(matrices)
        if kind == "polarizer_film":
            slab = paths.slab(matrices, share.ravel())
        stacked = slab if stacked is None else slab.after(stacked)
        for t, r in ((stacked.t, stacked.r), (stacked.t_back, stacked.r_back)):
            t, r = t.numpy(), (r + mueller.absorber(0.0)).numpy()
            for one in (t, r):
                lit = one[..., 0, 0] > 1e-12
                assert mueller.physical(one[lit]).min() >= -1e-12
            assert mueller.gain(t + r).max() <= 1 + 1e-12
    assert r[..., 0, 0].max() > 0.3


# -- derivatives -----------------------------------------------------------------------------------------------------
def generic(scene):
    """Every number of the bench's layers and of its lamp away from neutral, so that all of them matter."""
    rng = RNG(11)
    values = {**scene.values(), "sample.stress_pattern": "disc"}
    for name in ("analyzer", "middle", "polarizer"):
        values.update(drawn(rng, {**FILM, "inserted": (0.8, 0.9), "face": (0.02, 0.06)}, name))
    values.update(drawn(rng, {**SHEET, "stress_size": (40, 60)}, "sample"))
    lamp = {**SOURCE, "drift": (0.1, 0.2), "time": (0.5, 1), "wavelength": (545, 555), "fwhm": (80, 90)}
    values.update(drawn(rng, lamp, "source"))
    return values


@pytest.mark.slow
@pytest.mark.parametrize("variant", [MONO, pytest.param(SPECTRAL, marks=pytest.mark.slow)], indirect=True)
def test_derivatives_by_a_complex_step_are_those_of_differences(variant):
    """Every parameter of films, sheet and lamp, in intensity and polarization."""
    scene, renderer = bench(variant, width=3, height=3, x_fov=8, **({"bands": "610"} if variant == MONO else {}))
    values = generic(scene)
    keys = [k for k, p in scene.parameters.items() if p.how == "layer"]
    assert len(keys) > 50
    for key in keys:
        h = 1e-4 * min(1.0, scene.parameters[key].plausible)

        def image(value, key=key):
            return np.array([renderer.image({**values, key: value}, "source", component) for component in (0, 2)])

        found = image(values[key] + 1j * STEP).imag / STEP
        expected = (image(values[key] + h) - image(values[key] - h)) / (2 * h)
        assert np.abs(expected).max() > 1e-6, f"{key} does nothing"
        # differences in double precision: h^2 of parameters that act on a scale of 1, and 1e-16/h of an image near 1
        assert off(found, expected) < 1e-5, key


@pytest.mark.slow
@pytest.mark.parametrize("variant", [MONO, SPECTRAL], indirect=True)
@pytest.mark.parametrize("key", ["analyzer.angle", "analyzer.leak"])
def test_forward_derivatives_of_a_render_are_those_of_differences(variant, key, tmp_path):
    """mi.render with a gradient on one parameter, in all four components; loops are differentiated where they are not
    recorded."""
    import drjit as dr
    import mitsuba as mi

    plates = {
        n: Plate(k, z)
        for n, k, z in (
            ("analyzer", "polarizer_film", 20.0),
            ("sample", "sheet", 30.0),
            ("polarizer", "polarizer_film", 40.0),
        )
    }
    scene, _ = stack(tmp_path, variant, plates, size=3, x_fov=60)
    scene.set(
        {
            "analyzer.angle": 25.0,
            "analyzer.leak": 0.15,
            "polarizer.angle": -30.0,
            "polarizer.leak": 0.1,
            "sample.angle": 10.0,
            "sample.retard_0": 60.0,
            "source.dop_q": 0.3,
            "source.dop_u": -0.2,
        }
    )
    parameters = mi.traverse(scene.mitsuba)
    part, name = key.split(".")
    path = f"{part}_plate.bsdf.{name}"
    start = float(parameters[path][0])

    def shown(value):
        parameters[path] = value
        parameters.update()
        return mi.render(scene.mitsuba, parameters, spp=1, seed=1)

    with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False):
        attached = mi.Float(start)
        dr.enable_grad(attached)
        image = shown(attached)
        dr.set_grad(attached, 1.0)
        dr.forward_to(image)
        found = np.array(dr.grad(image), float)
    h = 0.5 if name == "angle" else 0.005
    expected = (np.array(shown(mi.Float(start + h)), float) - np.array(shown(mi.Float(start - h)), float)) / (2 * h)
    assert np.abs(expected).max() > 1e-3
    # (2 x 0.5 deg)^2/6 = 5e-5 of a derivative by an angle, h^2/(8 leak^2) = 1.4e-4 of one by a leak's root, and float32
    # over 2h
    assert off(found, expected) < 3e-4


# -- Vi2TaP ----------------------------------------------------------------------------------------------------------
SKIN = {"analyzer": -23.0, "inner_face": -5.0, "silicone": -3.75, "film": -2.5, "outer_face": 0.0}  # mm
KINDS = {"analyzer": "polarizer_film", "film": "polarizer_film", "silicone": "sheet"}
ROOM = ("room_left", "room_right")


@pytest.fixture(scope="module")
def finger(mitsuba, tmp_path_factory):
    """The scene at rest, small, its object out of the way, sampled in the middles of pixels."""
    scene, renderer = loaded(
        centred("vi2tap", tmp_path_factory.mktemp("finger")), SPECTRAL, width=64, height=48, x_fov=100
    )
    values = {**scene.values(), "object.y": 900.0}
    hits = renderer.hits(values)
    names = [shape.id() for shape in scene.mitsuba.shapes()]
    still = ~renderer.led(values, "uv_left").rim
    on = {n: (hits.path.shape.reshape(48, 64) == names.index(n)) & still for n in ("wall", "markers")}
    d, vertical = camera_rays(64, values["camera.x_fov"])
    d = d.reshape(64, 64, 3)[8:56]
    return SimpleNamespace(scene=scene, renderer=renderer, values=values, on=on, d=d, vertical=vertical, hits=hits)


def by_hand(finger, values, where, wavelength=540.0):
    """S0 at the camera of unpolarized light 1 from outside, for pixels that look through the whole skin."""
    plates = {n: Plate(KINDS.get(n, "interface"), z) for n, z in SKIN.items()}
    o = (0.0, 0.0, -25.0)
    return follow(plates, values, wavelength, finger.d[where], finger.vertical, o)[0][:, 0, 0]


def lit_by(finger, lights):
    return {**finger.values, **{f"{n}.power": 0.0 for n in finger.scene.lights if n not in lights}}


def test_the_room_behind_the_finger_fades_by_malus(finger):
    """Near the axis cos^2 + T_crossed/T_parallel sin^2; everywhere what oblique films and refracting faces make of
    it."""
    wall, values = finger.on["wall"], finger.values
    image = {
        a: finger.renderer.stokes({**lit_by(finger, ROOM), "analyzer.angle": a})[0, wall, 1]
        for a in (0.0, 30.0, 60.0, 90.0)
    }
    near = (np.degrees(np.arccos(finger.d[..., 2])) < 6)[wall]
    assert near.sum() >= 4 and len(near) > 100
    t1, t2 = values["film.transmittance"], values["film.leak"]
    floor = 2 * t1 * t2 / (t1**2 + t2**2)
    for a, found in image.items():
        c2 = np.cos(np.radians(a)) ** 2
        # axes seen at 6 deg from the normal turn by up to sin^2/4 = 0.0027, in the silicone by half of it
        assert np.abs(found / image[0.0] - (c2 + floor * (1 - c2)))[near].max() < 4e-3
        expected = by_hand(finger, {**values, "analyzer.angle": a}, wall) / by_hand(finger, values, wall)
        assert off(found / image[0.0], expected, 1.0) < GEOMETRY


@JUST_MONO
def test_stokes_vectors_of_many_readings_are_those_of_each(variant, tmp_path):
    scene, renderer = loaded("polarizer_bench", variant, bands="540")
    dial, power = np.array([0.0, 20.0, 75.0]), np.array([1.0, 0.5, 2.0])
    values = {**scene.values(), "sample.retard_0": 60.0, "sample.angle": 30.0}
    found = renderer.stokes({**values, "analyzer.angle": dial[:, None, None], "source.power": power[:, None, None]})
    each = [renderer.stokes({**values, "analyzer.angle": a, "source.power": p})[:, 0] for a, p in zip(dial, power)]
    np.testing.assert_allclose(found, np.stack(each, 1), rtol=0, atol=1e-15)


@pytest.mark.slow
def test_light_that_is_reflected_twice_has_its_derivative_by_a_layer(finger):
    """Of the share of two reflections alone: the derivative with it less the one without."""
    key, step = "film.angle", 1e-4
    values = {**finger.values, "analyzer.angle": 30.0, finger.renderer.bounce_key: 1.0}

    def twice(angle):
        now = {**values, key: angle}
        return finger.renderer.radiance(now) - finger.renderer.radiance({**now, finger.renderer.bounce_key: 0.0})

    found, expected = np.imag(twice(20.0 + 1e-30j)) / 1e-30, (twice(20.0 + step) - twice(20.0 - step)) / (2 * step)
    assert np.abs(expected).max() > 1e-3 * np.abs(twice(20.0)).max()
    assert off(found, expected, np.abs(expected).max()) < 1e-6


def test_markers_shine_at_every_angle_of_the_analyser_and_polarized_by_it(finger):
    """Unpolarized light: (T1 + T2)/2 of it passes whatever the angle, as S = (1, P cos 2a, P sin 2a, 0) along the seen
    axis a."""
    markers, values, uv = finger.on["markers"], finger.values, lit_by(finger, ("uv_left", "uv_right"))
    assert markers.sum() > 10
    t1, t2 = values["analyzer.transmittance"], values["analyzer.leak"]
    bare = finger.renderer.stokes({**uv, "analyzer.inserted": 0.0})[:, markers, 1]
    assert np.abs(bare[1:]).max() == 0 and bare[0].min() > 0
    for angle in (0.0, 37.0, 90.0):
        found = finger.renderer.stokes({**uv, "analyzer.angle": angle})[:, markers, 1]
        d = finger.d[markers]
        molecules = np.array([-np.sin(np.radians(angle)), -np.cos(np.radians(angle)), 0])
        axis = azimuth(np.cross(-d, molecules), -d, unit(np.cross(finger.vertical, d)))
        expected = bare[0] * (t1 + t2) / 2 * np.stack([linear(a, (t1 - t2) / (t1 + t2)) for a in axis], -1)
        assert off(found, expected, expected[0]) < GEOMETRY
        if angle == 37:  # seen obliquely the axis is not what the servo says
            assert np.degrees(np.ptp(axis)) > 5


def test_fluorescence_of_a_marker_is_the_integral_over_the_spectra(finger):
    """One LED on one cap: photons absorbed, by quadrature over the LED's and the pigment's spectra, and emitted at the
    bands."""
    values, markers = finger.values, finger.on["markers"]
    hits, bands = finger.hits, finger.renderer.wavelengths
    flat = markers & (hits.normal[..., 2] < -0.9999)
    image = finger.renderer.image(values, "uv_left") / (
        (values["analyzer.transmittance"] + values["analyzer.leak"]) / 2
    )
    flat &= image[..., 1] > 0
    row, column = np.argwhere(flat)[np.argmin(np.abs(np.argwhere(flat) - [24, 32]).sum(1))]
    own, led = (lambda p: values[f"pigment.{p}"]), (lambda p: values[f"uv_left.{p}"])

    def gauss(x, peak, fwhm):
        return np.exp(-4 * np.log(2) * ((x - peak) / fwhm) ** 2)

    nm = np.linspace(100, 700, 60001)
    absorbed = np.trapezoid(
        gauss(nm, led("wavelength"), led("fwhm"))
        * own("absorptance")
        * gauss(nm, own("absorption_peak"), own("absorption_fwhm"))
        * nm,
        nm,
    )
    place = np.array([led(a) for a in "xyz"])
    start = place - hits.position[row, column]
    target = finger.scene.parts["uv_left"]
    cos = dot(-unit(start), np.array(target.axis(), float).ravel())
    kappa = cos ** led("mu") / dot(start, start)
    wide = np.linspace(-500, 2000, 250001)
    photons = gauss(bands, own("emission_peak"), own("emission_fwhm")) / np.trapezoid(
        gauss(wide, own("emission_peak"), own("emission_fwhm")), wide
    )
    incidence = dot(unit(start), hits.normal[row, column])
    expected = own("yield") * kappa * incidence * absorbed * photons / (np.pi * bands)
    # an LED of 275 nm and 11 nm width reflects nothing visible: what is there is fluorescence; float32
    assert off(image[row, column], expected, expected) < FLOAT32
    quarter = finger.renderer.image({**values, "pigment.yield": own("yield") / 4}, "uv_left")
    assert off(quarter[row, column] * 4, finger.renderer.image(values, "uv_left")[row, column]) < FLOAT32


@pytest.mark.slow
def test_the_render_of_the_finger_is_its_prediction(finger):
    """mi.render with lamps, layers, refraction and fluorescence together, pixel by pixel away from rims, in all
    components."""
    values = {**finger.values, "analyzer.angle": 25.0, "silicone.retard_0": 60.0, "silicone.retard_45": -20.0}
    try:
        found, expected = rendered(finger.scene, values), finger.renderer.stokes(values)
    finally:
        finger.scene.set(finger.values)
    # Rays that Mitsuba sends on start up to 2 um beside the surface: nothing on a wall 185 mm away, but 13 mm from an
    # LED twice that over the distance, 4e-4 of its light
    for name, tolerance in (("wall", 1e-4), ("markers", 1e-3)):
        seen = finger.on[name]
        assert off(found[:, seen], expected[:, seen], expected[0][seen]) < tolerance


def test_a_press_moves_the_images_of_markers_outwards(mitsuba):
    """Middles of the caps' images against the projection of where their caps go, and all of them away from the
    press."""
    from scipy.ndimage import label

    scene, renderer = loaded("vi2tap", SPECTRAL, width=160, height=120, x_fov=70)
    shape = [s.id() for s in scene.mitsuba.shapes()].index("markers")
    f = 80 / np.tan(np.radians(35))
    v, u = np.mgrid[:120, :160] + 0.5

    def middles(values):
        """Of images and of caps, px from the middle, of the markers of the middle columns."""
        hits = renderer.hits(values)  # the caps alone: a marker that tilts shows its wall
        blobs, _ = label((hits.path.shape.reshape(120, 160) == shape) & (hits.normal[..., 2] < -0.7))
        caps = scene.parts["markers"].centres()
        caps = f * caps[:, :2] / (caps[:, 2:] + 25)
        caps = caps[(np.abs(caps) < [70, 50]).all(1)]
        chosen = [blobs == blobs[int(y + 60), int(x + 80)] for x, y in caps]
        return np.array([(u[b].mean() - 80, v[b].mean() - 60) for b in chosen]), caps

    rest, caps = middles(scene.values())
    pressed, caps_pressed = middles({**scene.values(), "skin.press_depth": 1.5})
    assert len(rest) == 6
    moved, expected = pressed - rest, caps_pressed - caps
    assert (dot(moved, unit(rest)) > 0).all()
    assert dot(moved, unit(rest)).max() > 1
    # the middle of some 250 pixels with steps at their rim is good to a twentieth of a pixel, in both images
    assert np.abs(moved - expected).max() < 0.15


def test_a_clock_shows_in_the_lamp_and_in_the_dark_signal(benches):
    """d image / d time of a lamp that grows and a dark signal that settles, which are read by one clock."""
    bench = benches("polarizer_bench")
    now = {"source.time": 3.0, "source.drift": 0.02, "camera.dark_drift": 2e-3, "camera.dark_settling": 0.5}
    later, before = (bench.image({**now, "source.time": 3.0 + step}) for step in (1e-3, -1e-3))
    assert bench.derivative("source.time", now) == pytest.approx((later - before) / 2e-3, rel=1e-4, abs=1e-7)
