"""Channels as integrals over the wavelength: limits, few nodes against many bands, derivatives, closed forms."""

import re
from pathlib import Path

import numpy as np
import pytest

from optics.captures.capture_set import Captures, Frame, definitions, load
from optics.captures.noise import Noise
from optics.errors import BadCapture, BadScene
from optics.files import exr
from optics.files.images import write_image
from optics.files.output import shipped
from optics.fit.scene_model import SceneModel
from optics.light.renderer import Renderer
from optics.light.rendering import RenderJob
from optics.light.transport import materials
from optics.scene import checking, loader
from optics.scene.line import WHITE
from optics.scene.parameter import Values, Variable
from optics.spectra.reading import gaussian, read_channels

NIKON = "Nikon 5100 (NPL)"
SIZE = {"width": "24", "height": "32", "depth": "0.5"}


def digit(mitsuba, folder, bands, **attributes):
    """DIGIT with other bands; attributes of LEDs in XML as {led_red: '<...>'}."""
    text = (shipped("scenes") / "digit.xml").read_text(encoding="utf-8")
    if any('"spectrum"' in xml for xml in attributes.values()):
        text = re.sub(r'<string name="line_shape"[^>]*>', "", text)
    for part, xml in attributes.items():
        text = re.sub(rf'(<(?:emitter|sensor|bsdf) type="\w+" id="{part}">)', rf"\1 {xml}", text)
    file = folder / f"digit_{len(list(folder.iterdir()))}.xml"
    file.write_text(text, encoding="utf-8")
    return loader.load(file, {**SIZE, "bands": bands})


@pytest.mark.slow
def test_lines_give_what_bands_at_their_peaks_give(mitsuba, tmp_path):
    """LEDs of 1 nm at the peaks: their integrals differ from the sensitivities there by the bend of these at 530 nm,
    a kink of 3 % per 5 nm over a third of a nm."""
    images = []
    for bands in ("625, 530, 470", "auto"):
        text = (shipped("scenes") / "digit.xml").read_text(encoding="utf-8")
        text = re.sub(r'name="fwhm" value="[^"]+"', 'name="fwhm" value="1"', text)
        text = re.sub(r'<string name="line_shape"[^>]*>', "", text)  # Gaussians: measured lines have long flanks
        file = tmp_path / "lines.xml"
        file.write_text(text, encoding="utf-8")
        images.append(RenderJob(loader.load(file, {**SIZE, "bands": bands})).take().camera)
    assert images[0].max() > 100
    assert images[1] == pytest.approx(images[0], abs=1e-3 * images[0].max())


@pytest.fixture(scope="module")
def auto(mitsuba, tmp_path_factory):
    return digit(mitsuba, tmp_path_factory.mktemp("auto"), "auto")


@pytest.mark.slow
def test_few_nodes_give_what_many_bands_give(mitsuba, auto, tmp_path):
    """Eleven bands in place of 161, whose trapezium rule of 2.5 nm errs by 3e-4 at the kinks of the sensitivities,
    which are straight lines over 5 nm."""
    # two nodes in a range that holds a tenth of a line, one in those that its flanks reach, or a phosphor's leak would
    assert len(auto.integral.nm) == 11 and auto.integral.error < 1e-12  # nothing on the way depends on the wavelength
    fine = digit(mitsuba, tmp_path, "380:780:2.5")
    found, expected = (RenderJob(s).take() for s in (auto, fine))
    assert found.camera == pytest.approx(expected.camera, abs=4e-4 * expected.camera.max())
    for name in ("colour.X", "colour.Y", "colour.Z", "camera.G"):
        assert found.channels[name] == pytest.approx(expected.channels[name], abs=4e-4 * expected.channels[name].max())
    back, _ = exr.read(expected.write_exr(tmp_path / "bands.exr"))
    bands, vectors = exr.spectral_image(back)
    assert bands == pytest.approx(np.arange(380.0, 780.1, 2.5)) and vectors.shape == (32, 24, 161, 1)
    assert not any(name.startswith("S0.") for name in found.channels)


NOT_AUTO = {  # scenes that take no auto bands, and why; lines as theirs: tests/unit/test_spectra.py
    "grid_bench": "followed in up to 4 bands; allowed",
    "magictac": "followed in up to 4 bands; allowed",
    "particle_gel": "the camera sees the light of inner_ring, outer_ring itself.*allowed: fixed bands",
}
WAYS = {
    "tilt": lambda nm: np.exp(0.3 * (nm - 540) / 100),
    "fade": lambda nm: np.exp(-0.5 * np.exp(-(nm - 540) / 100)),  # a resin that turns yellow
    "quarter wave": lambda nm: np.sin(np.pi / 4 * 540 / nm) ** 2,  # between crossed polarizers
}


@pytest.mark.parametrize("name", sorted(p.stem for p in shipped("scenes").glob("*.xml")))
def test_nodes_of_every_shipped_scene_meet_sums_in_steps_of_1_nm(mitsuba, tmp_path, name):
    """Each light of each scene, as it is and over ways that change with the wavelength, to 1e-4 of its largest
    channel."""
    text = (shipped("scenes") / f"{name}.xml").read_text(encoding="utf-8")
    text = re.sub(r'<default name="(bands|sensitivity)"[^>]*>', "", text)
    text = re.sub(r'<string name="sensitivity"[^>]*>', "", text)
    text = re.sub(r'(<string name="bands" value=")[^"]*', r"\1auto 5", text)
    text, cameras = re.subn(
        r'(<sensor type="(?:camera|fisheye)"[^>]*>)', rf'\1 <string name="sensitivity" value="{NIKON}"/>', text
    )
    assert cameras == 1
    (tmp_path / "scene.xml").write_text(text, encoding="utf-8")
    if name in NOT_AUTO:
        with pytest.raises(BadScene, match=NOT_AUTO[name]):
            loader.load(tmp_path / "scene.xml")
        return
    scene = loader.load(tmp_path / "scene.xml")
    integral, values = scene.integral, scene.values()
    every = slice(None, None, 4)  # of the grid of 0.25 nm
    nm = integral.grid[every]
    assert np.diff(nm) == pytest.approx(1.0)
    ends = np.where((nm == nm[0]) | (nm == nm[-1]), 0.5, 1.0)
    quantum = np.stack([np.interp(nm, q.nm, q.values, left=0, right=0) for q in read_channels(NIKON)])
    matrix = integral.matrix(values)
    assert integral.groups
    for group in integral.groups:
        weights = quantum * group.spectrum(values)[every] * ends / integral.unit
        for way in (np.ones_like, *WAYS.values()):
            found = matrix[:, group.bands] @ way(integral.nm[group.bands])
            # the amber line of 17 nm stands on a corner of the red sensitivity, which is straight over 5 nm: there sums
            # in steps of 1 nm are off by 2.4e-4, which is found with steps of 0.25 nm
            tolerance = 3e-4 if group.lights == ("led_amber",) else 1e-4
            assert found == pytest.approx(weights @ way(nm), abs=tolerance * weights.sum(1).max()), group.lights
            fine = (integral.quantum * integral.step * group.spectrum(values)) @ way(integral.grid) / integral.unit
            assert found == pytest.approx(fine, abs=2e-5 * weights.sum(1).max()), group.lights


@pytest.mark.slow
@pytest.mark.parametrize(
    "paint",
    [
        '<string name="reflectance" value="colour:orange"/>',
        '<spectrum name="reflectance" value="380:0.1, 560:0.8, 780:0.2"/>',
    ],
)
def test_reflectance_and_filter_are_integrated(mitsuba, tmp_path, paint):
    """A patch of a colour checker, a spectrum of Mitsuba's, and a filter: by the estimated error and by many bands."""
    xml = {
        "membrane": paint,
        "camera": '<string name="filter" value="400:0.1, 560:0.9, 700:0.4"/>',
    }
    few, many = (digit(mitsuba, tmp_path, bands, **xml) for bands in ("auto", "380:780:2.5"))
    # corners of paint and filter within the line of the green LED: twelve nodes in a range, the most, leave 2.8e-4
    assert 6 < len(few.integral.nm) < 60 and few.integral.error < 3e-4
    found, expected = (RenderJob(s).take().camera for s in (few, many))
    assert np.abs(found - expected).max() < 5e-4 * expected.max()  # 3e-4 of the trapezium rule, see above


def test_a_straight_line_needs_two_nodes(mitsuba, tmp_path):
    """What two nodes integrate exactly is told as exact, also where a range ends within the light of an LED; and where
    nobody says how many nodes, there are two for each range."""
    line = {"membrane": '<string name="reflectance" value="300:0.05, 900:0.95"/>'}
    two, free = (digit(mitsuba, tmp_path, bands, **line).integral for bands in ("auto 2", "auto"))
    assert two.error < 1e-10 and len(free.nm) <= len(two.nm)  # 1e-10: rounding of sums over 1600 places


@pytest.mark.slow
@pytest.mark.parametrize("key", ["led_green.wavelength", "led_red.fwhm"])
def test_derivatives_by_peak_and_width(auto, mitsuba, tmp_path, key):
    """Auto bands: complex step through the matrix, against central differences. Cubics between the values of a measured
    line have bends that jump, so steps are .002 nm: 2e-6 off, as the square of the step (8e-4 with .05 nm).

    Fixed bands: forward mode, off the corners of Dr.Jit's table in steps of .25 nm, against steps of .005 nm. Single
    precision makes 4e-3 of the largest of that."""
    base = auto.values()
    job = RenderJob(auto)
    image = job.renderer.radiance(base)
    found = job.developer.linearise(image, base).of_parameter((key,))
    sides = [job.developer.develop(image, {**base, key: base[key] + s * 0.002}) for s in (1, -1)]
    assert auto.parameters[key].how == "image" and np.abs(found).max() > 0.1
    assert found == pytest.approx((sides[0] - sides[1]) / 0.004, rel=1e-4, abs=1e-5)
    fine = digit(mitsuba, tmp_path, "400:700:5")
    renderer = Renderer(fine)
    led = key.split(".")[0]
    own = {**fine.values(), f"{led}.wavelength": fine.values()[f"{led}.wavelength"] + 0.1}
    tangent = renderer.led_tangent(own, led, key)
    sides = [renderer.image({**own, key: own[key] + s * 0.005}, led) for s in (1, -1)]
    assert tangent == pytest.approx((sides[0] - sides[1]) / 0.01, abs=5e-3 * float(np.abs(tangent).max()))


def test_a_measured_line_is_moved_and_stretched(mitsuba, tmp_path):
    """Channels of an LED of a measured form at 528 nm, 36 nm wide: sums in steps of .1 nm over the table of the file as
    it stands, moved and stretched here; by auto bands and by many. Its own peak and width where none are given."""
    file = shipped("scenes") / "spectra" / "led_ingan_518.csv"
    nm, power = np.loadtxt(file, delimiter=",", skiprows=5).T
    top = int(power.argmax())
    left, right = np.interp(0.5, power[2 : top + 1], nm[2 : top + 1]), np.interp(-0.5, -power[top:], nm[top:])
    xml = (
        '<scene version="3.0.0"><integrator type="tactile" id="integrator"><string name="bands" value="BANDS"/>'
        f'</integrator><sensor type="camera" id="camera"><string name="sensitivity" value="{NIKON}"/></sensor>'
        '<shape type="rectangle" id="floor"><bsdf type="membrane" id="paint"/></shape>'
        '<emitter type="led" id="led"><string name="line_shape" value="led_ingan_518.csv"/>PLACE</emitter></scene>'
    )

    def loaded(bands, place):
        scene = tmp_path / "scene.xml"
        scene.write_text(xml.replace("BANDS", bands).replace("PLACE", place), encoding="utf-8")
        return loader.load(scene)

    own = loaded("auto", "").values()
    assert own["led.wavelength"] == pytest.approx(nm[top], abs=0.1)
    assert own["led.fwhm"] == pytest.approx(right - left, abs=0.05)
    place = '<float name="wavelength" value="528"/><float name="fwhm" value="36"/>'
    fine = np.arange(380.0, 780.0, 0.1)
    line = np.interp(nm[top] + (fine - 528) * (right - left) / 36, nm, power, left=0, right=0)
    quantum = np.stack([np.interp(fine, q.nm, q.values, left=0, right=0) for q in read_channels(NIKON)])
    expected = quantum @ line / line.sum()
    for bands in ("auto", "380:780:1"):
        integral = loaded(bands, place).integral
        values = integral.base
        if bands == "auto":
            found = integral.matrix(values).sum(1) * integral.unit
        else:
            found = integral.matrix(values) @ integral.spectrum("led", values)[::4] * integral.unit
        assert found == pytest.approx(expected, abs=1e-3 * expected.max())  # cubics for straight lines: 5e-4
    both = place + '<string name="spectrum" value="gaussian(530, 30)"/>'
    with pytest.raises(BadScene, match="'spectrum' and 'line_shape' are both given; allowed"):
        loaded("auto", both)


@pytest.mark.parametrize("bands", ["auto", "400:700:5"])
def test_a_wave_plate_between_crossed_polarizers(mitsuba, tmp_path, bands):
    """sum of S(nm) Q(nm) sin^2(delta/2), delta = 250 deg 540/nm, under a white lamp and under a line of 40 nm."""
    text = (shipped("scenes") / "polarizer_bench.xml").read_text(encoding="utf-8")
    text = text.replace('<float name="x_fov"', f'<string name="sensitivity" value="{NIKON}"/><float name="x_fov"')
    file = tmp_path / "bench.xml"
    file.write_text(text, encoding="utf-8")
    plate = {"polarizer.angle": 45.0, "analyzer.angle": 135.0, "sample.retard_0": 250.0}
    plate.update(
        {f"{film}.{n}": v for film in ("polarizer", "analyzer") for n, v in (("transmittance", 1.0), ("leak", 0.0))}
    )
    nm = np.arange(380.0, 781.0)
    passed = np.sin(np.radians(250 * 540 / nm) / 2) ** 2 / 2
    quantum = np.array([q(nm) for q in read_channels(NIKON)])
    for line in (0.0, 560.0):
        text = file.read_text(encoding="utf-8")
        own = tmp_path / f"bench_{line:g}.xml"
        numbers = f'<float name="wavelength" value="{line}"/><float name="fwhm" value="40"/>'
        lamp = f'<emitter type="source" id="source">{numbers}</emitter>'
        own.write_text(text.replace('<emitter type="source" id="source"/>', lamp), encoding="utf-8")
        scene = loader.load(own, {"bands": bands} if 'name="bands"' in text else {})
        keys = {k: v for k, v in plate.items() if k in scene.parameters}
        assert len(keys) == len(plate)
        renderer = Renderer(scene)
        values = {**scene.values(), **keys}
        reading = (renderer.radiance(values) @ scene.integral.matrix(values).T)[0, 0]
        power = gaussian(nm, line, 40.0) if line else np.ones(len(nm))
        exact = (quantum * power) @ passed / (quantum * power).sum(1).max()
        seen = reading / scene.integral.matrix(values).sum(1).max() if bands == "auto" else reading
        tolerance = 2e-3 if bands == "auto" else 2e-2  # the probes are weaker than the plate; 400 to 700 nm alone
        assert seen == pytest.approx(exact, abs=tolerance), line


def test_measured_index_and_absorption_reach_the_paths_of_light(mitsuba):
    """n of PDMS by Sellmeier's formula of its source, shifted to 1.41 at 540 nm; an absorption that doubles."""
    body = (
        '<bsdf type="clear" id="gel"><float name="index" value="1.41"/><float name="absorption" value="0.02"/>'
        '<string name="index_spectrum" value="pdms_sylgard184.csv"/>'
        '<string name="absorption_spectrum" value="440:2, 540:1, 640:0.5"/></bsdf>'
    )
    lamp = '<emitter type="led" id="led"><point name="position" x="5" y="0" z="-9"/></emitter>'
    bands = np.array([640.0, 540.0, 440.0])
    scene = checking.scene_of(f'<shape type="cube">{body}</shape>', lamp, bands="640, 540, 440")
    found = materials(scene, bands)[1]
    um2 = (bands / 1e3) ** 2
    n = np.sqrt(1 + 1.0093 * um2 / (um2 - 0.013185))
    assert found.index == pytest.approx(1.41 + n - n[1], abs=2e-5)  # a table in steps of 10 nm, to five digits
    assert found.absorption == pytest.approx([0.01, 0.02, 0.04])
    lanes = scene.parts["gel"].refractive(mitsuba.UnpolarizedSpectrum(640.0, 540.0, 440.0, 440.0))
    assert [lanes[i][0] for i in range(3)] == pytest.approx(found.index, abs=1e-6)


def test_light_that_only_an_effect_brings_has_nodes(mitsuba, tmp_path):
    """What leaks through the phosphor of an amber LED is blue, where the LED itself has no light: behind a filter that
    passes a tenth of blue, bands of its own against 1 nm. By the polynomials of the amber nodes it would be off by
    half."""
    xml = {
        "led_red": '<string name="spectrum" value="gaussian(592, 17)"/>',
        "membrane": '<string name="reflectance" value="400:0.1, 480:0.1, 560:0.9, 700:0.9"/>',
    }
    scene = digit(mitsuba, tmp_path, "auto", **xml)
    (group,) = [g for g in scene.integral.groups if g.lights == ("led_red",)]
    assert (scene.integral.nm[group.bands] < 500).any()
    key, nm = "led_red.phosphor_leak", scene.integral.grid
    paint = np.interp(scene.integral.nm, [400, 480, 560, 700], [0.1, 0.1, 0.9, 0.9])
    matrix = scene.integral.matrix({**scene.values(), key: 0.1}) - scene.integral.matrix(scene.values())
    found = matrix[:, group.bands] @ paint[group.bands]
    own = (
        gaussian(nm, 450.0, 20.0) / gaussian(nm, 450.0, 20.0).sum()
        - gaussian(nm, 592.0, 17.0) / gaussian(nm, 592.0, 17.0).sum()
    )
    exact = 0.1 * scene.integral.quantum @ (own * np.interp(nm, [400, 480, 560, 700], [0.1, 0.1, 0.9, 0.9]))
    assert found == pytest.approx(exact / scene.integral.unit, abs=2e-4)  # of channels that are 1 at most


def test_what_a_pigment_sends_is_drawn_times_the_sensitivities(mitsuba):
    """On Vi2TaP the red channel's small maximum at 530 nm counts more beside the pigment's light than by itself."""
    from optics.light.spectra import draw

    defines = {"width": "16", "height": "12", "bands": "auto", "sensitivity": NIKON}
    figure = draw(loader.load(shipped("scenes") / "vi2tap.xml", defines))
    red = [line.get_xydata() for line in figure.axes[0].lines if line.get_color() == "#c03030"]
    alone, seen = (np.interp(530.0, *line.T) / line[:, 1].max() for line in red)
    assert alone == pytest.approx(0.12, abs=0.02)  # of the table
    assert seen > 2 * alone  # white light by itself leaves it as it is


@pytest.mark.slow
def test_pigments_and_ultraviolet_leds_are_given_by_curves(mitsuba, tmp_path):
    """Vi2TaP with its Gaussians written as curves is the same image, in auto bands and in three; a curve of the LED
    that neither camera nor pigment takes up is refused."""
    text = (shipped("scenes") / "vi2tap.xml").read_text(encoding="utf-8")
    nm = np.arange(300.0, 800.0, 2.0)
    shine = ", ".join(f"{x:g}:{v:.9f}" for x, v in zip(nm, gaussian(nm, 520.0, 81.0) * 520 / nm))
    nm = np.arange(150.0, 500.0, 2.0)
    taken = ", ".join(f"{x:g}:{v:.9f}" for x, v in zip(nm, gaussian(nm, 300.0, 120.0)))
    curves = text.replace(
        '<bsdf type="fluorescent" id="pigment">',
        f'<bsdf type="fluorescent" id="pigment"><string name="emission_spectrum" value="{shine}"/>'
        f'<string name="excitation_spectrum" value="{taken}"/>',
    )
    for led in ("left", "right"):
        start = f'<emitter type="led" id="uv_{led}">'
        curves = curves.replace(start, start + '<string name="spectrum" value="LAMP"/>')
    assert curves.count("LAMP") == 2 and "emission_spectrum" in curves
    (tmp_path / "curves.xml").write_text(curves.replace("LAMP", "gaussian(275, 11)"), encoding="utf-8")
    (tmp_path / "far.xml").write_text(curves.replace("LAMP", "gaussian(900, 11)"), encoding="utf-8")
    formed = curves.replace('"spectrum" value="LAMP"', '"line_shape" value="gaussian(300, 20)"')  # moved to 275, 11 nm
    (tmp_path / "formed.xml").write_text(formed, encoding="utf-8")
    small = {"width": "32", "height": "24", "x_fov": "60", "sensitivity": NIKON, "analyzer": "90"}
    for bands in ("auto", "620, 540, 460"):
        images = [
            RenderJob(loader.load(scene, {**small, "bands": bands})).take().camera
            for scene in ("vi2tap", tmp_path / "curves.xml", tmp_path / "formed.xml")
        ]
        assert images[0].max() > 20
        for other in images[1:]:  # lines between points 2 nm apart
            assert other == pytest.approx(images[0], abs=2e-3 * images[0].max())
    with pytest.raises(BadScene, match="uv_left.spectrum.*is the unit nm"):
        loader.load(tmp_path / "far.xml", small)


def test_what_has_no_integral_is_refused(mitsuba, auto):
    with pytest.raises(BadScene, match="sensitivities.*Nikon"):
        loader.load("gelsight", {"bands": "auto"})
    with pytest.raises(BadScene, match="mi.render carries 4 bands"):
        RenderJob(auto, spp=4)
    for bands in ("auto 99", "700:400:10", "red", "400, 500, 450, 600, 700"):
        with pytest.raises(BadScene, match="allowed"):
            loader.load("digit", {"bands": bands})


def test_a_light_that_no_channel_sees_is_dark(mitsuba, tmp_path):
    """An infrared LED in place of the blue one; the others do not know of it."""
    with pytest.raises(BadScene, match="is the unit nm"):
        digit(mitsuba, tmp_path, "auto", led_blue='<string name="spectrum" value="900:1, 980:1"/>')
    text = (shipped("scenes") / "digit.xml").read_text(encoding="utf-8")
    (tmp_path / "infrared.xml").write_text(text.replace('value="470"/>', 'value="940"/>'), encoding="utf-8")
    job = RenderJob(loader.load(tmp_path / "infrared.xml", {**SIZE, "bands": "auto"}))
    found = job.take().channels
    assert found["camera.R"].max() > 0 and found["led_blue.B"].max() < 1e-6 * found["camera.B"].max()
    off = job.take({"led_blue.power": 0.0}).channels
    assert np.array_equal(found["camera.R"], off["camera.R"])


def test_lights_that_share_bands_keep_one_spectrum(mitsuba, tmp_path):
    """Three lamps of one curve have one set of nodes, two in each range."""
    xml = dict.fromkeys(("led_red", "led_green", "led_blue"), '<string name="spectrum" value="CIE LED-B3"/>')
    scene = digit(mitsuba, tmp_path, "auto", **xml)
    assert len(scene.integral.groups) == 1 and len(scene.integral.nm) == 6
    white = scene.integral.matrix() @ scene.integral.white  # what no lamp sends, in the bands of the lamps
    exact = (scene.integral.quantum * scene.integral.step).sum(1) / WHITE / scene.integral.unit
    assert white == pytest.approx(exact, rel=1e-9)


def test_a_fit_finds_the_wavelength_of_an_led(mitsuba, auto):
    """Two Gauss-Newton steps with the model's own derivative undo a shift by 3 nm and one of the effect by as much."""
    captures = Captures(
        Path("."), "digit", [Frame("0", np.zeros((32, 24, 3)))], noise=Noise(0.05, 1.0, 0.0, 255.0, 0.0)
    )
    model = SceneModel(auto, captures)
    for key, start in (("led_green.wavelength", 530.0), ("led_red.centre_shift", 0.0)):
        parameter = auto.parameters[key]
        variable = Variable(key, (key,), parameter)
        values = Values()
        values.put(variable, start + 3.0)
        measured = model.predict(values)[0]
        found = start
        for _ in range(3):
            values.put(variable, found)
            now = model.at(values, 0)
            slope = model.developer.linearise(model.radiance(now), now).of_parameter((key,))
            found += float((slope * (measured - model.predict(values)[0])).sum() / (slope**2).sum())
        assert found == pytest.approx(start + 3.0, abs=1e-3), key  # what is left of Gauss and Newton's steps


def test_captures_name_auto_bands(mitsuba, tmp_path):
    write_image(tmp_path / "0", np.zeros((32, 24, 3)), 8)
    for bands in ("auto", "400:700:10"):
        (tmp_path / "captures.toml").write_text(
            f'scene = "digit"\nbands = "{bands}"\n[[frames]]\nimage = "0.png"\n', encoding="utf-8"
        )
        assert definitions(load(tmp_path), {}, shipped("scenes") / "digit.xml")["bands"] == bands
    (tmp_path / "captures.toml").write_text('scene = "digit"\nbands = "auto 99"\n[[frames]]\nimage = "0.png"\n')
    with pytest.raises(BadCapture, match="auto N with 1 to 12"):
        load(tmp_path)
