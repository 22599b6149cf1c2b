"""Plain Mitsuba: after `optics.register()`, `mi.load_file` gives the scenes that this library's loader gives."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

SMALL = {"width": "24", "height": "18"}
GRID = {"columns": "4", "rows": "4", "layers": "2", "block_width": "3.6", "block_length": "3.6"}
CASES = {  # every shipped scene: what replaces its <default>s, at rest and pressed
    "9dtact": ({"depth": "0"}, {}),
    "colour_bench": ({}, {"bands": "592, 530, 470"}),
    "digit": ({}, {"depth": "0.8"}),
    "gelsight": ({}, {"depth": "0.8"}),
    "gelsight_bench": ({"depth": "0"}, {}),
    "gelsight_mini": ({"depth": "0"}, {}),
    "grid_bench": ({}, {"distance": "0.5"}),
    "magictac": ({**GRID, "room": "1"}, {**GRID, "room": "1", "distance": "-0.5"}),
    "particle_gel": ({"beads": "30"}, {"beads": "30", "depth": "0.8"}),
    "polariscope": ({"analyzer": "30"}, {"analyzer": "60", "polarizer": "30", "regions": "quarters"}),
    "polarization_camera": ({"polarizer": "1"}, {"regions": "halves", "sample_regions": "halves"}),
    "polarizer_bench": ({"analyzer": "30"}, {"analyzer": "30", "polarizer": "30", "pattern": "disc"}),
    "reflection_bench": ({}, {"analyzer": "60", "incidence": "57"}),
    "vi2tap": ({}, {"analyzer": "60", "depth": "3", "x": "4"}),
}
# Two of them draw one of several lights per path, in the order in which Mitsuba lists them: its optimization turns the
# order round, so that images agree in the mean only.
DRAWN = ("grid_bench", "magictac")
SEEDS = 8
# Mitsuba sums a smooth mesh's vertex normals in parallel, in an order that changes from load to load: a normal, and
# with it an image, is known to some roundings of a float32 (6e-8 each; up to 5e-9 of the largest value was seen).
ROUNDING = 1e-6
# Our loader asks for intersections that no ray slips through, which round otherwise: 5e-6 at the rims of beads.
RIMS = {"particle_gel": 1e-5}


@pytest.fixture(scope="module")
def mi(mitsuba):
    from optics.scene.mitsuba_parts import register

    register()
    return mitsuba


def test_every_shipped_scene_is_here():
    from optics.scene.loader import shipped_scenes

    assert sorted(CASES) == shipped_scenes()


def image(mi, scene, seed=3, spp=16):
    return np.array(mi.render(scene, spp=spp, seed=seed))


def said(deed):
    """What an error says, and what it came from."""
    with pytest.raises(Exception) as caught:  # Dr.Jit wraps what a plugin raises
        deed()
    error, texts = caught.value, []
    while error is not None:
        texts.append(str(error))
        error = error.__cause__ or error.__context__
    return " ".join(texts)


def both(mi, name, replaced, **options):
    """The scene by Mitsuba's loader and by ours."""
    from optics.scene import loader

    path = loader.find(name)
    text = path.read_text(encoding="utf-8")
    defines = {k: v for k, v in {**SMALL, **replaced}.items() if f'<default name="{k}"' in text}
    return mi.load_file(str(path), **options, **defines), loader.load(name, defines)


LONG = ("magictac", "grid_bench")  # Monte Carlo: among the slow tests, but for one of them at rest
PRESSED = ("gelsight", "vi2tap")  # the other sensors are slow ones when something presses them


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, pressed",
    [
        pytest.param(name, pressed, marks=[pytest.mark.slow] * (name == LONG[0] or (pressed and name not in PRESSED)))
        for name in CASES
        for pressed in (False, True)
    ],
    ids=[f"{name}-{state}" for name in CASES for state in ("rest", "pressed")],
)
def test_load_file_gives_what_our_loader_gives(name, pressed, mi):
    plain, ours = both(mi, name, CASES[name][pressed])
    if name not in DRAWN:
        found, expected = image(mi, plain), image(mi, ours.mitsuba)
        assert expected.max() > 0
        # Mitsuba also joins rectangles of one material to one mesh: their places differ in the last bit of a float32
        assert np.abs(found - expected).max() <= RIMS.get(name, ROUNDING) * expected.max()
        return
    exact, _ = both(mi, name, CASES[name][pressed], optimize=False)
    expected = image(mi, ours.mitsuba)
    assert expected.max() > 0
    assert np.abs(image(mi, exact) - expected).max() <= ROUNDING * expected.max()
    images = [np.array([image(mi, s, 10 + k, 64) for k in range(SEEDS)]) for s in (plain, ours.mitsuba)]
    means, errors = zip(*((i.mean((1, 2)).mean(0), i.mean((1, 2)).std(0, ddof=1) / SEEDS**0.5) for i in images))
    # Student's t of three channels with 14 degrees of freedom: 5 is reached once in 2000
    assert (np.abs(means[0] - means[1]) < 5 * np.hypot(*errors)).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["vi2tap", "magictac"])
def test_the_comparison_notices_parts_that_were_not_wired(name, mi, monkeypatch):
    """What Mitsuba made of these two before parts looked for one another."""
    plain, ours = both(mi, name, CASES[name][True], optimize=False)
    monkeypatch.setitem(type(plain.integrator()).sample_rays.__globals__, "ensure_wired", lambda *_: None)
    assert "call optics.wire" in said(lambda: image(mi, plain))
    for shape in plain.shapes():
        if hasattr(shape.bsdf(), "registry"):
            shape.bsdf()._waits = ""
    found, expected = image(mi, plain), image(mi, ours.mitsuba)
    assert np.linalg.norm(found - expected) > 0.01 * np.linalg.norm(expected)


MOVES = {  # numbers that a float32 holds exactly, as traverse carries no other
    "vi2tap": [
        {"skin.press_depth": 3.0, "skin.press_x": 4.0},
        {"inner_sheet.depth": 4.0, "markers.radius": 1.0, "silicone.stress": 0.015625, "camera.pan": 3.0},
        {"skin.press_depth": 0.0, "analyzer.angle": 40.0, "uv_left.x": -17.0, "pigment.yield": 0.25},
    ],
    "magictac": [{"object.distance": -0.5}, {"grid.wall": 0.25, "walls.index": 1.515625}, {"object.distance": 3.0}],
    "gelsight": [{"gel.press_depth": 0.875, "led_1.x": 1.0}, {"gel.press_depth": 0.1875, "membrane.sigma": 0.5}],
}


@pytest.mark.parametrize("name", [n if n == "gelsight" else pytest.param(n, marks=pytest.mark.slow) for n in MOVES])
def test_updates_through_traverse_are_those_of_our_scene(name, mi):
    from optics.scene.wiring import traverse_paths

    start = {**GRID, "room": "1"} if name == "magictac" else {}
    plain, ours = both(mi, name, start, optimize=False)
    params, paths = mi.traverse(plain), traverse_paths(plain)
    before = None
    for values in MOVES[name]:
        for key, value in values.items():
            params[paths[key]] = value
        params.update()
        ours.set(values)
        found, expected = image(mi, plain), image(mi, ours.mitsuba)
        assert np.abs(found - expected).max() <= ROUNDING * expected.max()
        assert before is None or np.abs(found - before).max() > 1e-3 * found.max()
        before = found
        for a, b in zip(plain.shapes(), ours.mitsuba.shapes()):
            if hasattr(a, "registry"):
                assert np.array_equal(*(np.array(mi.traverse(s)["vertex_positions"]) for s in (a, b))), a.id()


@pytest.mark.slow
def test_what_is_updated_before_the_first_image_is_in_it(mi):
    plain, ours = both(mi, "vi2tap", {})
    params = mi.traverse(plain)
    params["skin.press_depth"] = 3.0
    params.update()
    ours.set({"skin.press_depth": 3.0})
    expected = image(mi, ours.mitsuba)
    assert np.abs(image(mi, plain) - expected).max() <= ROUNDING * expected.max()


@pytest.mark.parametrize("name", CASES)
def test_values_and_traverse_agree(name, mi):
    """There is one present value of each number, however one asks for it and whoever set it."""
    from optics.scene import loader
    from optics.scene.wiring import traverse_paths

    text = loader.find(name).read_text(encoding="utf-8")
    scene = loader.load(
        name, {k: v for k, v in {**SMALL, **GRID}.items() if f'<default name="{k}"' in text and name != "grid_bench"}
    )
    paths = traverse_paths(scene.mitsuba)
    own = [f"{n}.{p}" for n, part in scene.parts.items() for p in part.numbers]
    assert sorted(paths) == sorted(own)
    rng = np.random.default_rng(7)

    def compare():
        params, values = mi.traverse(scene.mitsuba), scene.values()
        for key, path in paths.items():
            assert float(params[path][0]) == pytest.approx(values[key], rel=1e-6, abs=1e-6), key

    compare()
    quick = [k for k in own if not scene.moves(k)]  # geometry takes a while, and was moved above
    for by_traverse in (False, True, False):
        changed = {}
        for key in rng.choice(quick, 20, replace=False):
            low, high = scene.parameters[key].sides(scene.values()[key])
            changed[str(key)] = float(np.float32(low + rng.random() * (high - low)))
        if by_traverse:
            params = mi.traverse(scene.mitsuba)
            for key, value in changed.items():
                params[paths[key]] = value
            params.update()
        else:
            scene.set(changed)
        compare()
        assert all(scene.values()[k] == pytest.approx(v, rel=1e-6) for k, v in changed.items())


# -- what cannot be wired is said ------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize(
    "name, told",
    [
        ("vi2tap", "moves with the part 'gel'.* call optics.wire"),
        ("magictac", "(lies inside 'walls'|moves with the part 'target').* call optics.wire"),
    ],
)
def test_another_integrator_needs_a_wired_scene(name, told, mi):
    from optics.scene.wiring import wire

    plain, _ = both(mi, name, CASES[name][True])
    other = mi.load_dict({"type": "volpath", "max_depth": 32, "rr_depth": 99})
    assert re.search(told, said(lambda: mi.render(plain, integrator=other, spp=1)))
    wire(plain)
    assert np.isfinite(np.array(mi.render(plain, integrator=other, spp=1))).all()


SHEETS = """<scene version="3.0.0">
    <integrator type="tactile"><string name="bands" value="620, 540, 460"/></integrator>
    <sensor type="camera" id="camera"><transform name="to_world"><translate z="-25"/></transform>
        <film type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="3"/></film></sensor>
    <shape type="gel" id="skin"><bsdf type="membrane" id="face"/></shape>
    <shape type="carried" id="one"><float name="depth" value="1"/><bsdf type="{kind}" id="a"/></shape>
    <shape type="carried" id="two"><float name="depth" value="2"/><bsdf type="{kind}" id="b"/></shape>
    <emitter type="led" id="led"><point name="position" x="0" y="0" z="-9"/></emitter>
</scene>"""


@pytest.mark.slow
def test_shapes_that_move_are_not_joined_by_mitsubas_optimization(mi, tmp_path):
    """Equal materials become one; the shapes that have it stay what they are."""
    path = tmp_path / "two.xml"
    path.write_text(SHEETS.format(kind="interface"), encoding="utf-8")
    plain = mi.load_file(str(path))
    assert {"skin", "one", "two"} <= {shape.id() for shape in plain.shapes()}
    params = mi.traverse(plain)
    params["skin.press_depth"] = 0.9
    params.update()
    image(mi, plain, spp=1)
    lowest = {s.id(): s.bbox().min.z for s in plain.shapes()}
    assert lowest["one"] < -1.01 and lowest["two"] < -2.01  # each with a dent, from its own place at rest

    path.write_text(SHEETS.format(kind="sheet"), encoding="utf-8")
    joined = mi.load_file(str(path))
    assert re.search("'a' lies on 2 shapes.*optimize=False", said(lambda: image(mi, joined, spp=1)))
    image(mi, mi.load_file(str(path), optimize=False), spp=1)


def run(code):
    return subprocess.run([sys.executable, "-c", code], text=True, capture_output=True, cwd=Path(__file__).parents[2])


@pytest.mark.parametrize(
    "code, told",
    [
        ("", 'RuntimeError: no Mitsuba variant is set; call mitsuba.set_variant("llvm_ad_spectral_polarized") before'),
        ("mi.set_variant('scalar_rgb')", "ValueError: variant scalar_rgb: scalar variants are not supported; use llvm"),
    ],
)
def test_register_says_what_to_do(code, told):
    done = run(f"import mitsuba as mi\n{code}\nfrom optics.scene.mitsuba_parts import register\nregister()")
    assert done.returncode == 1 and told in done.stderr


@pytest.mark.slow
def test_register_follows_the_variant_and_knows_a_users_folder(tmp_path):
    (tmp_path / "glass.py").write_text(
        '"""Glass: a boundary of another name."""\n'
        "from dataclasses import replace\nfrom optics.scene.registry import default, known\n"
        "_INTERFACE = known().parts['interface']\n"
        "def build():\n    class Glass(_INTERFACE.build()):\n        kind = 'glass'\n    return Glass\n"
        "part = replace(_INTERFACE, kind='glass', role='interface', build=build)\n"
    )
    done = run(
        "import mitsuba as mi\nfrom optics.scene.mitsuba_parts import register\n"
        "mi.set_variant('llvm_ad_mono')\n"
        f"register({str(tmp_path)!r})\n"
        "for variant in ('llvm_ad_mono', 'llvm_ad_spectral', 'scalar_rgb', 'llvm_ad_mono'):\n"
        "    mi.set_variant(variant)\n"
        "    if variant != 'scalar_rgb':\n"
        "        print(variant, type(mi.load_dict({'type': 'glass', 'index': 1.5})).__name__)\n"
    )
    assert done.stdout.splitlines() == ["llvm_ad_mono Glass", "llvm_ad_spectral Glass", "llvm_ad_mono Glass"], (
        done.stderr
    )
