"""Spectra: what is read and refused, quadratures against closed forms, colours against the colour-science library."""

import math

import numpy as np
import pytest

from optics.errors import BadScene, UnknownKey
from optics.scene import loader
from optics.scene.surfaces import curve_of
from optics.spectra.colours import illuminant, linear_srgb, xyz
from optics.spectra.curve import Curve
from optics.spectra.quadrature import gauss_nodes, lagrange, widths
from optics.spectra.reading import gaussian, overlap, read_channels, read_curve

TABLES = {
    "plain.csv": "400,0.1\n500,0.5\n700,0.2\n",
    "header.csv": "# source: a data sheet\nwavelength (um);T (%)\n0.4;10\n0.5;50\n0.7;20\n",
    "tabs.txt": "lambda_nm\tT\n400\t0.1\n500\t0.5\n700\t0.2\n",
    "lamp.spd": "400 0.1\n500 0.5\n700 0.2\n",
}
BAD = {  # a file's text: what the error says
    "500,0.5\n400,0.1\n": "do not ascend: 500 nm, then 400 nm",
    "400,0.1\n400,0.2\n": "do not ascend",
    "400,-0.1\n500,0.2\n": "-0.1 at 400 nm",
    "400,10\n500,50\n": "looks like per cent",
    "0.4,0.1\n0.7,0.2\n": "header that names another unit",
    "wavelength (inch),T\n400,0.1\n500,0.2\n": "unit 'inch'",
    "400,0.1\n500\n": "differ in length, or have no value, such as '500'",
    "nm,T\n400;0.1\n500;0.2\n": "no value, such as '400;0.1'",
    "400,0.1\n500,abc\n": "'abc'",
    "400,nan\n500,0.1\n": "nan at 400 nm is not finite",
    "wavelength (nm),T\n": "a header and no rows",
    "400,0.1\n": "1 row",
    "": "no rows",
}


@pytest.mark.parametrize("name", TABLES)
def test_tables_of_all_dialects_read_alike(name, tmp_path):
    (tmp_path / name).write_text(TABLES[name], encoding="utf-8")
    curve = read_curve(name, "transmittance", [tmp_path])
    assert curve([400.0, 450.0, 600.0, 300.0, 800.0]) == pytest.approx([0.1, 0.3, 0.35, 0.1, 0.2], abs=1e-12)
    assert "a data sheet" in curve.source or name != "header.csv"


@pytest.mark.parametrize("text", BAD)
def test_a_bad_table_gets_one_error(text, tmp_path):
    (tmp_path / "bad.csv").write_text(text, encoding="utf-8")
    with pytest.raises(BadScene, match="filter = 'bad.csv'.*" + BAD[text].split()[0].replace("(", r"\(")) as error:
        read_curve("bad.csv", "transmittance", [tmp_path], "camera.filter")
    assert BAD[text] in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("encoding", ["latin-1", "utf-16"])  # as spectrometers and spreadsheets save them
def test_a_table_in_another_encoding_gets_one_error(encoding, tmp_path):
    (tmp_path / "own.csv").write_text("wavelength (\u00b5m),T\n0.4,0.1\n0.5,0.2\n", encoding=encoding)
    with pytest.raises(BadScene, match=r"camera.filter = 'own.csv': own.csv is not text in UTF-8; allowed"):
        read_curve("own.csv", "transmittance", [tmp_path], "camera.filter")


def test_bands_that_are_no_light_ask_for_the_unit():
    from optics.spectra.bands import parse

    for text, wrong in (("0.61, 0.54, 0.46", "0.61 nm"), ("0.4:0.7:0.1", "0.4 nm"), ("6100, 54000", "54000 nm")):
        with pytest.raises(BadScene, match=rf"camera: bands = .*: {wrong}; allowed: .*is the unit nm"):
            parse(text, "camera")
    assert parse("610, 540, 460", "camera") == ((610.0, 540.0, 460.0), None)


@pytest.mark.parametrize(
    "text", ["nowhere.csv", "gaussian(530)", "blackbody(-3)", "400:0.1, x:2", "silver", "phosphor(1)"]
)
def test_what_is_no_spectrum_says_what_is_allowed(text):
    with pytest.raises(BadScene, match="allowed|ship"):
        read_curve(text, "power")
    with pytest.raises(UnknownKey, match="D65"):
        read_curve("CIE D66", "power")


def test_laws():
    """The width of a Gaussian; Wien's displacement of a black body; the share of a phosphor's power."""
    line = read_curve("gaussian(530, 35)", "power")
    assert line([530.0, 547.5]) == pytest.approx([1.0, 0.5], abs=1e-9)
    hot = read_curve("blackbody(5000)", "power")
    assert hot.nm[hot.values.argmax()] == pytest.approx(2897771.955 / 5000, abs=0.5)  # the table's step
    white = read_curve("phosphor(450, 20, 560, 120, 4)", "power")
    die = math.sqrt(math.pi / (4 * math.log(2))) * 20
    assert white.area == pytest.approx(5 * die, rel=1e-4)  # the phosphor's tail ends with the table at 200 nm


def test_light_that_the_camera_does_not_see_is_refused():
    with pytest.raises(BadScene, match="850 to 950 nm.*is the unit nm"):
        overlap(read_curve("850:1, 950:1", "power"), read_channels("Nikon 5100 (NPL)"), "led.spectrum", "'camera'")


def test_a_curve_has_one_value_in_all_arithmetics(mitsuba):
    """The complex step gives the slope of a line; Dr.Jit reads a table in steps of 0.25 nm, whose points it meets."""
    curve = Curve(np.array([400.0, 500.0, 700.0]), np.array([0.1, 0.5, 0.2]), "transmittance")
    assert curve(np.array([450 + 1e-30j])).imag / 1e-30 == pytest.approx([0.004])
    lanes = curve(mitsuba.UnpolarizedSpectrum(390.0, 450.0, 600.0, 800.0))
    assert [lanes[i][0] for i in range(4)] == pytest.approx([0.1, 0.3, 0.35, 0.2], rel=1e-6)  # single precision
    light = Curve(curve.nm, curve.values, "power")
    lanes = light(mitsuba.UnpolarizedSpectrum(390.0, 450.0, 600.0, 800.0))
    assert [lanes[i][0] for i in range(4)] == pytest.approx([0.0, 0.3, 0.35, 0.0], rel=1e-6)


NM = np.arange(400.0, 701.0, 7.0)
PAIRS = "400:0.1, 550:0.8, 700:0.2"
OF_MITSUBA = {  # a spectrum of Mitsuba's in a scene: the same by a text of ours, or a number
    f'value="{PAIRS}"': PAIRS,
    'filename="own.spd"': PAIRS,
    'value="0.5"': 0.5,
    'type="uniform"><float name="value" value="0.5"/>': 0.5,
    'type="blackbody"><float name="temperature" value="3000"/>': "blackbody(3000)",
    'type="d65"': "CIE D65",
    'type="irregular"><string name="wavelengths" value="400,550,700"/>'
    '<string name="values" value="0.1,0.8,0.2"/>': PAIRS,
}


@pytest.mark.parametrize("text", OF_MITSUBA)
def test_spectra_of_mitsuba_are_read(mitsuba, text, tmp_path):
    """Form alone: Mitsuba's own have units of their own. D65 is tabulated in steps of 5 nm there, 1 nm here, and
    multiplied in single precision."""
    (tmp_path / "own.spd").write_text(TABLES["lamp.spd"].replace("500 0.5", "550 0.8"), encoding="utf-8")
    inside = f"<spectrum name='spectrum' {text}{'</spectrum>' if '><' in text else '/>'}"
    scene = tmp_path / "scene.xml"
    scene.write_text(
        f"""<scene version="3.0.0"><integrator type="tactile" id="integrator"><string name="bands" value="auto"/>
        </integrator><sensor type="camera" id="camera"><string name="sensitivity" value="Nikon 5100 (NPL)"/></sensor>
        <shape type="rectangle" id="floor"><bsdf type="membrane" id="paint"/></shape>
        <emitter type="led" id="led">{inside}</emitter></scene>""",
        encoding="utf-8",
    )
    found = loader.load(scene).leds["led"].curves["spectrum"](NM)
    same = OF_MITSUBA[text]
    expected = read_curve(same, "power")(NM) if isinstance(same, str) else np.ones(len(NM))
    assert found / found.sum() == pytest.approx(expected / expected.sum(), rel=1e-3)
    if isinstance(same, float):
        assert found == pytest.approx(same)


def test_a_texture_is_no_spectrum(mitsuba):
    image = mitsuba.load_dict({"type": "checkerboard"})
    for given in (image, mitsuba.ScalarColor3f(1, 0.5, 0.2)):
        with pytest.raises(BadScene, match="^led.spectrum: .* is no spectrum; allowed: Mitsuba's spectra, or a file"):
            curve_of(given, "power", "led.spectrum")
    dark = mitsuba.load_dict({"type": "uniform", "value": 1.5})
    with pytest.raises(BadScene, match="camera.filter: a transmittance of 1.5; allowed: 0 to 1"):
        curve_of(dark, "transmittance", "camera.filter")


def test_nodes_of_a_gaussian_are_those_of_gauss_and_hermite():
    nm = np.arange(400.0, 660.0, 0.25)
    weight = gaussian(nm, 530.0, 30.0)
    nodes = gauss_nodes(nm, weight, 5)
    x, w = np.polynomial.hermite.hermgauss(5)
    sd = 30.0 / (2 * math.sqrt(2 * math.log(2)))
    assert nodes == pytest.approx(530 + math.sqrt(2) * sd * x, abs=1e-6)  # a sum over a Gaussian is exact
    weights = lagrange(nodes, nm) @ weight
    assert weights / weights.sum() == pytest.approx(w / w.sum(), rel=1e-6)
    assert len(gauss_nodes(nm, (nm == 500) * 1.0, 3)) == 1  # one place has one node


def test_widths_are_those_of_the_trapezium_rule():
    assert widths(np.array([400.0, 410.0, 430.0])) == pytest.approx([5, 15, 10])
    assert widths(np.array([430.0, 410.0, 400.0])) == pytest.approx([10, 15, 5])


LIGHTS = (
    *("white", "gaussian(625, 20)", "gaussian(530, 35)", "gaussian(470, 25)", "CIE A", "CIE D50", "CIE D65"),
    *("CIE LED-B1", "CIE LED-B3", "CIE LED-V1", "CIE LED-RGB1", "blackbody(2856)", "phosphor(450, 20, 560, 120, 4)"),
)
PATHS = {
    "tilt": lambda nm: np.exp(0.3 * (nm - 540) / 100),
    "fade": lambda nm: np.exp(-0.5 * np.exp(-(nm - 540) / 100)),  # a resin that turns yellow
    "quarter wave": lambda nm: np.sin(math.pi / 4 * 540 / nm) ** 2,  # between crossed polarizers
    "face": lambda nm: 1 - ((np.sqrt(1 + 1.0093 * nm**2 / (nm**2 - 13185)) - 1) / 2.4) ** 2,
}


@pytest.mark.parametrize("camera", ["Nikon 5100 (NPL)", "Sigma SDMerill (NPL)"])
def test_five_nodes_in_each_range_meet_sums_in_steps_of_1_nm(camera):
    """1e-4 of a channel's largest integral, for lights and cameras that ship and for what paths do to light; 2e-5
    against sums on the nodes' own grid."""
    quantum = read_channels(camera)
    low, high = quantum[0].span
    nm, coarse = np.arange(low, high + 0.1, 0.25), np.arange(low, high + 0.1)
    ranges = np.digitize(nm, [500.0, 580.0])
    for text in LIGHTS:
        light = (lambda x: np.ones(len(x))) if text == "white" else read_curve(text, "power")
        density = np.array([q(nm) for q in quantum]) * light(nm) * widths(nm)
        sums = np.array([q(coarse) for q in quantum]) * light(coarse) * widths(coarse)
        nodes, rows = [], []
        for k in range(3):
            inside = ranges == k
            if density[:, inside].sum() > 1e-6 * density.sum():
                nodes.append(gauss_nodes(nm[inside], density[:, inside].sum(0), 5))
                rows.append(density[:, inside] @ lagrange(nodes[-1], nm[inside]).T)
        found, at = np.concatenate(rows, 1), np.concatenate(nodes)
        for name, path in PATHS.items():
            largest, integral = sums.sum(1).max(), found @ path(at)
            assert integral == pytest.approx(density @ path(nm), abs=2e-5 * largest), (text, name)
            # LED-RGB1 has lines as narrow as its table, of which sums in steps of 1 and 0.25 nm differ by 1.1e-4
            tolerance = 1e-4 if text != "CIE LED-RGB1" else 2e-4
            assert integral == pytest.approx(sums @ path(coarse), abs=tolerance * largest), (text, name)


@pytest.mark.parametrize("light", ["A", "D50", "D65", "FL2"])
@pytest.mark.filterwarnings("ignore::colour.utilities.verbose.ColourRuntimeWarning")  # that it aligns its tables
def test_colour_checker_patches_have_the_colours_of_the_colour_science_library(light):
    import colour

    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    lamp = read_curve(f"CIE {light}", "power")
    white = colour.XYZ_to_xy(xyz(lamp))
    lab = [[], []]
    for name, data in colour.SDS_COLOURCHECKERS["BabelColor Average"].items():
        own = xyz(lamp, read_curve(f"colour:{name}", "reflectance"))
        reference = colour.sd_to_XYZ(data, observer, colour.SDS_ILLUMINANTS[light], method="Integration") / 100
        for kept, value in zip(lab, (own, reference)):
            kept.append(colour.XYZ_to_Lab(value, white))
    assert colour.delta_E(np.array(lab[0]), np.array(lab[1])).max() < 0.01


def test_srgb_has_no_adaptation_unless_asked():
    d65, a = illuminant("D65"), illuminant("A")
    assert linear_srgb(d65) == pytest.approx([1, 1, 1], abs=1e-3)  # the standard rounds its matrix to four digits
    assert linear_srgb(a)[0] > 1.5 * linear_srgb(a)[2]  # A stays yellow
    assert linear_srgb(a, adapt_from=a) == pytest.approx([1, 1, 1], abs=1e-3)
