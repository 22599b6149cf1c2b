"""Boards of LEDs: pick-and-place files of several programs, places in numbers against those in a scene, bad boards."""

from pathlib import Path

import numpy as np
import pytest

import optics
from optics.errors import BadScene
from optics.scene import loader
from optics.scene.boards import on_board
from optics.scene.pick_and_place import placed

KICAD = (
    'Ref,Val,Package,PosX,PosY,Rot,Side\n"D1","LED","0603",12.5000,-3.2500,90.0000,top\n"D2","LED","0603",1,2,0,top\n'
)
ALTIUM = "# made by Altium\n\nDesignator\tLayer\tMid X\tMid Y\nD1\tTop\t12.5mm\t-3.25mm\nD2\tTop\t100mil\t2mm\n"
EASYEDA = "Designator;Mid X(mil);Mid Y(mil)\nD1;492.126;-127.953\n"


@pytest.mark.parametrize("text", [KICAD, ALTIUM, EASYEDA], ids=["kicad", "altium", "easyeda"])
def test_pick_and_place_files_of_several_programs(text, tmp_path):
    (tmp_path / "board.csv").write_text(text, encoding="utf-8-sig")
    assert placed("board.csv:D1", [tmp_path]) == pytest.approx((12.5, -3.25), abs=1e-4)


def test_a_number_with_a_unit_of_its_own(tmp_path):
    (tmp_path / "board.csv").write_text(ALTIUM)
    assert placed("board.csv:D2", [tmp_path]) == pytest.approx((2.54, 2.0))


ASCII = """### Module positions - created on a Tuesday ###
## Unit = inches, Angle = deg.
# Ref     Val       Package                PosX       PosY       Rot  Side
D1        LED       0603                   0.5        -0.25      90.0000  top
## End
"""


@pytest.mark.parametrize(
    "text, expected",
    [
        (ASCII, (12.7, -6.35)),
        ("Ref,Mid X (inch),Mid Y (inch)\nD1,0.5,1in\n", (12.7, 25.4)),
        ("Ref,Mid X [um],Mid Y [cm]\nD1,1000,3\n", (1.0, 30.0)),
        ("Units used: mil\n\nDesignator,Mid X,Mid Y\nD1,100,2mm\n", (2.54, 2.0)),
        ("Ref;PosX;PosY\nD1;1,5;-2\n", (1.5, -2.0)),
        ("Reference list\nRef,PosX,PosY\n\n#\nD1,1,2\nD1,1,2\n", (1.0, 2.0)),
    ],
    ids=["kicad ascii", "inches", "units in brackets", "unit above", "decimal comma", "twice at one place"],
)
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_units_and_notations_of_pick_and_place_files(text, expected, encoding, tmp_path):
    (tmp_path / "board.csv").write_text(text, encoding=encoding, newline="\r\n")
    assert placed("board.csv:D1", [tmp_path]) == pytest.approx(expected)


HEAD = "Ref,PosX,PosY\n"


@pytest.mark.parametrize(
    "text, named, message",
    [
        (KICAD, "board.csv", "FILE:DESIGNATOR"),
        (KICAD, "board.csv:D9", "no part 'D9'; it has D1, D2"),
        ("a,b\n1,2\n", "board.csv:D1", "no pick-and-place table"),
        ("Ref,PosX\nD1,2\n", "board.csv:D1", "no column for y; its head is Ref, PosX"),
        (HEAD + "D1,two,3\n", "board.csv:D1", "line 2: x = 'two'; allowed: a number, in mm or with a unit: mm, mil"),
        (HEAD + "D1,nan,3\n", "board.csv:D1", "line 2: x = 'nan'"),
        (HEAD + "D1,2,1e300\n", "board.csv:D1", r"line 2: y = 1e\+300 mm; allowed: -10000 to 10000 mm; check its unit"),
        (HEAD + "D1,2,3ft\n", "board.csv:D1", "line 2: y = '3ft'"),
        ("Ref,PosX(ft),PosY(ft)\nD1,2,3\n", "board.csv:D1", r"unit 'ft' of the column 'PosX\(ft\)'; allowed: mm"),
        (HEAD + "D2,1,1\nD1,1,2\nD1,3,4\n", "board.csv:D1", "'D1' appears several times, in lines 3, 4"),
        (HEAD + "D1,2\n", "board.csv:D1", "line 2: 2 columns of 3; needed: D1's x and y"),
        (HEAD + '"D1,2,3\nD2,1,2\n', "board.csv:D1", "no part 'D1'; it has D1,2,3, D2"),
        (HEAD + 20_000 * "D,1,2\n", "board.csv:D1", "over 10000 rows"),
        (HEAD + "D1," + 200_000 * "1" + ",3\n", "board.csv:D1", "no part 'D1'"),
        ("Ref," + 50_000 * "x," + "\n", "board.csv:D1", "no column for y"),
        ("", "board.csv:D1", "no pick-and-place table"),
        (KICAD, "/etc/passwd:root", "/etc/passwd: lies outside .*; allowed: a file beside the scene's XML"),
        (KICAD, "../../../../../../../../../../etc/passwd:root", "lies outside"),
        (KICAD, "link.csv:D1", "link.csv: lies outside .*, at /etc/passwd"),
    ],
)
def test_bad_pick_and_place_files(text, named, message, tmp_path):
    (tmp_path / "board.csv").write_text(text)
    (tmp_path / "link.csv").symlink_to("/etc/passwd")
    with pytest.raises(ValueError, match=message) as raised:
        placed(named, [tmp_path])
    assert len(str(raised.value)) < 800


@pytest.mark.parametrize("named", ["absent.csv:D1", "/dev/zero:D1", 5000 * "x" + ":D1", ".:D1", "a\0b.csv:D1"])
def test_files_that_are_none(named, tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file in .*; allowed: a pick-and-place file beside"):
        placed(named, [tmp_path])


def scene_with(tmp_path: Path, led: str) -> Path:
    text = (loader.find("gelsight_bench")).read_text(encoding="utf-8")
    start, end = text.index('<emitter type="led" id="led_1">'), text.index('<emitter type="led" id="led_2">')
    file = tmp_path / "scene.xml"
    file.write_text(f"{text[:start]}{led}{text[end:]}", encoding="utf-8")
    return file


def test_places_in_numbers_are_those_of_the_scene(mitsuba, tmp_path, monkeypatch):
    """Moved, turned about all axes and scaled, an LED from a pick-and-place file among others."""
    (tmp_path / "board.csv").write_text(KICAD)
    led = """<emitter type="led" id="led_1"><string name="board" value="ring"/>
        <string name="placed" value="board.csv:D1"/><float name="turn" value="7"/></emitter>"""
    scene = loader.load(scene_with(tmp_path, led))
    assert scene.places_of(scene.values())["led_1"] == pytest.approx(
        on_board(np.array([12.5, -3.25, -5.0]), 7.0, {"x": 0, "y": 0, "z": -25, "rx": 0, "ry": 0, "rz": 0, "scale": 1})
    )
    scene.set({"ring.x": 1.0, "ring.rx": 20.0, "ring.ry": -10.0, "ring.rz": 5.0, "ring.scale": 1.2})
    for name, place in scene.places_of(scene.values()).items():
        assert scene.leds[name].stands() == pytest.approx(place, abs=1e-9)
        assert np.array(scene.leds[name].position()).ravel() == pytest.approx(place, abs=1e-4)  # what is rendered
    monkeypatch.delattr(type(scene.boards["ring"]), "stands")  # a board of one's own may have none
    assert scene.leds["led_1"].stands() == pytest.approx(scene.places_of(scene.values())["led_1"], abs=1e-4)
    side, up, ahead = (np.array(v, float).ravel() for v in scene.leds["led_3"].frame)
    assert np.cross(side, up) == pytest.approx(ahead, abs=1e-5)


@pytest.mark.parametrize(
    "led, message",
    [
        (
            '<emitter type="led" id="led_1"><string name="board" value="nowhere"/></emitter>',
            "its board 'nowhere' is no",
        ),
        ('<emitter type="led" id="led_1"><string name="board" value="camera"/></emitter>', "its board 'camera' is no"),
        ('<emitter type="led" id="led_1"><string name="placed" value="b.csv:D1"/></emitter>', "name its board"),
    ],
)
def test_a_board_that_is_none(led, message, mitsuba, tmp_path):
    with pytest.raises(BadScene, match=message):
        loader.load(scene_with(tmp_path, led))


def test_a_board_sends_no_light_to_other_integrators(mitsuba):
    """Stock `path` draws it among the emitters and gets nothing: the picture is that of LEDs in the same places."""
    import mitsuba as mi

    def picture(place: str, board: str) -> np.ndarray:
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "path", "max_depth": 2},
                "sensor": {
                    "type": "perspective",
                    "to_world": mi.ScalarTransform4f().look_at([0, 0, -20], [0, 0, 0], [0, 1, 0]),
                    "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
                },
                "card": {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 180)},
                "led": {"type": "led", "position": [1, 0, 0 if board else -5], "target": [0, 0, 5 if board else 0]}
                | ({"board": "ring"} if board else {}),
                **({"ring": {"type": "board", "z": -5.0}} if board else {}),
            }
        )
        if board:  # Dr.Jit wraps what a plugin raises
            with pytest.raises(RuntimeError) as raised:
                mi.render(scene, spp=1)
            assert "call optics.wire(scene)" in str(raised.value.__cause__)
        optics.wire(scene)
        return np.array(mi.render(scene, spp=4096, seed=1))[..., :3]

    optics.register()
    plain, on_a_board = picture("", ""), picture("", "ring")
    middle = (slice(3, 5), slice(3, 5))
    # half of the samples draw the board: the rest count twice, with noise of 1/sqrt(4096) in each of four pixels
    assert on_a_board[middle].mean() == pytest.approx(plain[middle].mean(), rel=4 / np.sqrt(4 * 4096))
