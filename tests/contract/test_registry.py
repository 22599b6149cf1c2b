"""The registry of plugins: built whole or not at all, by folders, with no trace of one scene's plugins in another's."""

import sys
from pathlib import Path

import numpy as np
import pytest

from optics.errors import BadPlugin, UnknownKey
from optics.files.output import shipped
from optics.scene import registry as registries
from optics.scene.registry import Registry, known

CURVE = '''"""Row curve: {slope} of the signal per row."""
from optics.plugin import Effect, Parameter

effect = Effect(
    "row curve",
    "camera",
    (Parameter("row_curve", "1", 0.0, neutral=0.0, plausible=0.1, how="image"),),
    stages={{"sensor": lambda image, camera: image * (1 + camera.row_curve * {slope} * camera.v[..., None])}},
)
'''


def written(folder: Path, **files) -> Path:
    folder.mkdir(exist_ok=True)
    for name, text in files.items():
        (folder / f"{name}.py").write_text(text, encoding="utf-8")
    return folder


@pytest.fixture
def kept(monkeypatch):
    """What a test includes for all scenes is forgotten after it."""
    monkeypatch.setattr(registries, "_included", registries._included)
    monkeypatch.setattr(registries, "_default", None)


def test_two_folders_may_draft_the_same_effect(tmp_path, mitsuba, load_bench):
    benches = {}
    for name, slope in (("one", 0.01), ("two", 0.02)):
        folder = written(tmp_path / name, row_curve=CURVE.format(slope=slope))
        benches[slope] = load_bench("gelsight", plugins=folder)
    usual = load_bench("gelsight")
    assert "row-curve" not in usual.scene.registry.effects and "camera.row_curve" not in usual.scene.parameters
    rows = np.arange(usual.model.shape[0])[:, None, None] + 0.5
    for slope, bench in benches.items():  # each as its own file has it, whichever was loaded last
        gain = bench.image({"camera.row_curve": 0.1}) / np.maximum(bench.image(), 1e-6)
        assert np.allclose(gain, 1 + 0.1 * slope * rows, atol=1e-6)


def test_one_scenes_effects_are_no_candidates_of_anothers(tmp_path, load_bench):
    own = load_bench("gelsight", plugins=written(tmp_path / "own", row_curve=CURVE.format(slope=0.01)))
    usual = load_bench("gelsight")
    assert own.scene.can_express(own.scene.registry.find_effect("row curve"))
    with pytest.raises(UnknownKey, match="row curve"):
        usual.scene.registry.find_effect("row curve")
    assert set(own.scene.registry.effects) - set(usual.scene.registry.effects) == {"row-curve"}


def test_a_failed_scan_leaves_nothing_behind(tmp_path, kept):
    folder = written(tmp_path / "own", row_curve=CURVE.format(slope=0.01), torn="raise RuntimeError('torn')")
    before = known()
    modules = set(sys.modules)
    for build in (known, registries.include):
        with pytest.raises(BadPlugin, match=r"torn\.py: RuntimeError: torn"):
            build(folder)
        assert known() is before and "row-curve" not in known().effects
    assert not [name for name in set(sys.modules) - modules if "torn" in name]
    (folder / "torn.py").unlink()
    assert "row-curve" in known(folder).effects


def test_an_edited_file_is_taken_up_and_only_then(tmp_path):
    folder = written(tmp_path / "own", row_curve=CURVE.format(slope=0.01))
    first = known(folder)
    assert known(folder) is first
    written(folder, row_curve=CURVE.format(slope=0.02))  # as long as before, and within the same second
    second = known(folder)
    assert second is not first
    assert [r.effects["row-curve"].doc[:15] for r in (first, second)] == ["Row curve: 0.01", "Row curve: 0.02"]
    assert second.parts["led"] is first.parts["led"]  # files that did not change are not executed again
    (folder / "row_curve.py").unlink()
    assert "row-curve" not in known(folder).effects


def test_a_registry_does_not_change(tmp_path):
    found = Registry.of([shipped("plugins")])
    for change in (
        lambda: found.parts.__setitem__("led", None),
        lambda: found.effects.pop("led-size"),
        lambda: setattr(found, "parts", {}),
    ):
        with pytest.raises((TypeError, AttributeError)):
            change()
    assert isinstance(found.folders, tuple)


def test_an_effect_twice_in_one_set_of_folders_is_refused(tmp_path):
    folders = [written(tmp_path / name, row_curve=CURVE.format(slope=0.01)) for name in ("one", "two")]
    with pytest.raises(BadPlugin, match="'row curve' exists already"):
        known(*folders)


EARLIER = '''"""Ring: darker towards the rim, written against names that modules had before."""
from optics.bsdf import matt, passing
from optics.effect import Declared, Effect, Part
from optics.layers import crossing_of, layer
from optics.lookup import lookup
from optics.mueller import diattenuator
from optics.parameter import Parameter

PARAMETERS = (Parameter("strength", "1", 0.5, (0.0, 1.0), "share that passes", plausible=0.1, how="layer"),)


def weigh(crossing, own):
    from optics.mueller import absorber  # once a scene is rendered

    return absorber(own.strength + 0.0 * crossing.u)


part = layer("old_cell", PARAMETERS, weigh)
effect = Effect(
    "ring",
    "camera",
    (Parameter("ring", "1", 0.0, neutral=0.0, plausible=0.1, how="image"),),
    stages={"sensor": lambda image, camera: image * (1 - camera.ring * camera.tan[..., None] ** 2)},
)
'''


def test_files_written_against_earlier_module_names_load(tmp_path, load_bench):
    bench = load_bench("polarizer_bench", slot="old_cell", plugins=written(tmp_path / "own", ring=EARLIER))
    full, half = (bench.image({"sample.strength": s}) for s in (1.0, 0.5))
    assert full.max() > 0 and np.allclose(half, full / 2, rtol=1e-6)
    assert "ring" in bench.scene.registry.effects


CAMERA = '''"""Fisheye: an equidistant camera, r = f theta.

Definition
    r = f theta, f = width/(x_fov in rad), about the image's middle
Fingerprint
    straight lines bow outwards.
Validity
    half angles below 90 deg.
References
    Kannala & Brandt, IEEE TPAMI 28, 1335 (2006), with k_i = 0.
"""
from optics.plugin import Declared, Parameter, Part
from optics.scene.registry import known

_CAMERA = known().parts["camera"]


def build():
    import drjit as dr
    import mitsuba as mi

    class WideLens(_CAMERA.build()):
        kind = "wide_lens"

        def ray(self, u, v):
            width, height = self.resolution
            f = width / dr.deg2rad(self.x_fov)
            x, y = (u - width / 2) / f, (v - height / 2) / f
            theta = dr.norm(mi.Vector2f(x, y))
            share = dr.select(theta > 1e-6, dr.sin(theta) / dr.maximum(theta, 1e-6), 1.0)
            origin = self.columns[3] + self.to_world(mi.Vector3f(self.x, self.y, self.z))
            direction = self.turned(mi.Vector3f(x * share, y * share, dr.cos(theta)))
            return mi.Point3f(origin) + dr.zeros(mi.Point3f, dr.width(u)), direction

    return WideLens


part = Part("wide_lens", "sensor", _CAMERA.parameters, build, role="camera")
'''


def model_of(scene, *settings):
    """A model of black 8 bit frames, one for each of the settings, each a group of its own."""
    from optics.captures.capture_set import Captures, Frame
    from optics.captures.noise import Noise
    from optics.fit.scene_model import SceneModel

    width, height = scene.camera.resolution
    black = np.zeros((height, width, 3), np.float32)
    frames = [Frame(f"f{i}", black, group=f"g{i}", parameters=dict(s)) for i, s in enumerate(settings or [{}])]
    noise = Noise(system_gain=0.1, dark_noise=1.0, black_level=0.0, saturation=255.0, prnu=0.0)
    return SceneModel(scene, Captures(scene.path.parent, str(scene.path), frames, noise=noise))


def test_a_second_camera_is_one_new_file(tmp_path, mitsuba):
    """It renders, predicts, has its derivatives, and takes part in every effect of cameras."""
    from optics.light.rendering import RenderJob
    from optics.scene import loader

    folder = written(tmp_path / "own", wide_lens=CAMERA)
    text = loader.find("gelsight").read_text(encoding="utf-8")
    assert 'type="camera"' in text
    path = tmp_path / "wide_lens.xml"
    path.write_text(text.replace('<sensor type="camera"', '<sensor type="wide_lens"'), encoding="utf-8")
    small = {"width": "32", "height": "24"}
    scene, usual = loader.load(path, small, plugins=folder), loader.load("gelsight", small)
    assert scene.camera.kind == "wide_lens" and scene.camera.role == "camera"
    assert [e.key for e in scene.registry.effects.values() if scene.can_express(e)] == [
        e.key for e in usual.registry.effects.values() if usual.can_express(e)
    ]
    with pytest.raises(BadPlugin, match="belongs to the part 'gel'"):
        known(folder, written(tmp_path / "bad", row_curve=CURVE.format(slope=1).replace('"sensor"', '"surface"')))
    image = RenderJob(scene).take({"camera.exposure": 150.0}).camera
    straight = RenderJob(usual).take({"camera.exposure": 150.0}).camera
    assert image.max() > 20 and np.abs(image - straight).max() > 1  # DN: the same sensor through another lens
    shaded = RenderJob(scene).take({"camera.exposure": 150.0, "camera.vignetting": 1.0}).camera
    assert shaded[0, 0, 0] < image[0, 0, 0] and np.allclose(shaded[12, 16], image[12, 16], rtol=0.02)

    from optics.scene.parameter import Values, Variable

    model = model_of(scene)
    # the step of the first is the model's own, as rims jump with a step; shading is linear in the second
    for key, here, step in (("camera.x_fov", model.base["camera.x_fov"], 0.4), ("camera.vignetting", 0.5, 0.01)):
        variable = Variable(key, (key,), scene.parameters[key])
        at = Values({"camera.exposure": 150.0, "camera.vignetting": 0.0, key: here})
        _, slopes = next(iter(model.derivatives(at, [variable])))
        low, high = (model.predict(Values({**at.common, key: here + s * step}))[0] for s in (-1.0, 1.0))
        difference = (high - low) / (2 * step)
        # rounding: 1e-6 of 255 DN over twice the step
        assert np.abs(slopes[key] - difference).max() < 0.02 and np.abs(difference).max() > 1, key


LIGHT = '''"""Spot: an LED whose power is called drive."""
from dataclasses import replace

from optics.scene.registry import known

_LED = known().parts["led"]


def build():
    class Spot(_LED.build()):
        kind = "spot"
        power = property(lambda self: self.drive)

    return Spot


PARAMETERS = tuple(replace(p, name="drive") if p.role == "power" else p for p in _LED.parameters)
part = replace(_LED, kind="spot", role="led", parameters=PARAMETERS, build=build)
'''

SKIN = '''"""Pad: a gel whose press has names of its own."""
from dataclasses import replace

from optics.scene.registry import known

_GEL = known().parts["gel"]
NAMES = {"press_x": "touch_x", "press_y": "touch_y", "press_depth": "dent"}


def build():
    class Pad(_GEL.build()):
        kind = "pad"
        pressing = tuple(NAMES.values())

        def number(self, name):
            return super().number(NAMES.get(name, name))

    return Pad


PARAMETERS = tuple(replace(p, name=NAMES.get(p.name, p.name)) for p in _GEL.parameters)
part = replace(_GEL, kind="pad", role="gel", parameters=PARAMETERS, build=build)
'''

SMALL = {"width": "32", "height": "24"}


def both_of(tmp_path, source, *changes):
    """gelsight with some of its text replaced and a folder of plugins, and as it ships."""
    from optics.scene import loader

    text = loader.find("gelsight").read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "own.xml"
    path.write_text(text, encoding="utf-8")
    own = loader.load(path, SMALL, plugins=written(tmp_path / "own", part=source))
    return own, loader.load("gelsight", SMALL)


def test_a_second_kind_of_light_is_one_new_file(tmp_path, mitsuba):
    """It is lit, driven, freed and differentiated by its own names."""
    from optics.diagnosis.advice import families
    from optics.scene.parameter import Values, Variable
    from optics.study.setup import Setup, default_free, variables_of_base

    own, usual = both_of(
        tmp_path, LIGHT, ('<emitter type="led"', '<emitter type="spot"'), ('name="power"', 'name="drive"')
    )
    assert [part.kind for part in own.leds.values()] == ["spot"] * len(usual.leds)
    press = {"gel.press_depth": 0.5}
    half, full = ({f"led_{k}.{name}": 0.0 for k in range(2, 7)} for name in ("drive", "power"))
    model, other = model_of(own, press, {**press, **half}), model_of(usual, press, {**press, **full})
    at = Values({"camera.exposure": 150.0})
    for found, expected in zip(model.predict(at), other.predict(at)):
        assert expected.max() > 5 and np.allclose(found, expected, atol=1e-4)
    assert [k.replace("drive", "power") for k in default_free(model)] == default_free(other)
    assert model.driven == set(half) and {k.replace("drive", "power") for k in model.driven} == other.driven
    priors = [{v.name: v.prior for v in variables_of_base(m, Setup(""), [0, 1])} for m in (model, other)]
    assert priors[0]["led_1.drive"] == priors[1]["led_1.power"] and priors[0]["led_1.drive"][1] == 0.3
    slopes = [
        next(iter(m.derivatives(at, [Variable(k, (k,), m.parameters[k])], [0])))[1][k]
        for m, k in ((model, "led_1.drive"), (other, "led_1.power"))
    ]
    assert np.abs(slopes[1]).max() > 1 and np.allclose(*slopes, atol=1e-4)
    shots = [[s.settings for s in families(m, at, [0, 1]) if s.family == "dark"] for m in (model, other)]
    assert shots[0] == [dict.fromkeys((f"led_{k}.drive" for k in range(1, 7)), 0.0)] and len(shots[1]) == 1


def test_a_second_kind_of_skin_is_one_new_file(tmp_path, mitsuba):
    """It is pressed, freed per press and set back to rest by its own names, and what moves with a skin moves with
    it."""
    from optics.diagnosis.advice import families
    from optics.scene.parameter import Values
    from optics.study.setup import Setup, variables_of_base

    own, usual = both_of(
        tmp_path,
        SKIN,
        ('<shape type="gel"', '<shape type="pad"'),
        ('name="press_x"', 'name="touch_x"'),
        ('name="press_y"', 'name="touch_y"'),
        ('name="press_depth"', 'name="dent"'),
    )
    assert own.gel.kind == "pad"
    names = {"press_x": "touch_x", "press_y": "touch_y", "press_depth": "dent"}
    press = {"press_x": 0.5, "press_y": -0.25, "press_depth": 0.5}
    model = model_of(own, {f"gel.{names[k]}": v for k, v in press.items()})
    other = model_of(usual, {f"gel.{k}": v for k, v in press.items()})
    at = Values({"camera.exposure": 150.0})
    found, expected = (m.predict(at)[0] for m in (model, other))
    rest = other.developer.develop(other.radiance(other.untouched(other.at(at, 0))), other.at(at, 0))
    assert np.abs(expected - rest).max() > 5 and np.allclose(found, expected, atol=1e-3)
    assert [k for k, v in model.untouched(model.at(at, 0)).items() if v != model.at(at, 0)[k]] == [
        f"gel.{n}" for n in names.values()
    ]
    solved = [
        {v.name: v.prior for v in variables_of_base(m, Setup(""), [0]) if v.frames is not None} for m in (model, other)
    ]
    assert list(solved[0].values()) == list(solved[1].values()) == [(v, 0.05) for v in press.values()]
    assert [n.split("[")[0] for n in solved[0]] == [f"gel.{n}" for n in names.values()]
    places = [m.lit_geometry(at, 0)["press_distance"] for m in (model, other)]
    assert np.allclose(*places, equal_nan=True, atol=1e-4)
    words = [[s.words for s in families(m, at, [0])] for m in (model, other)]
    assert words[0] == words[1] and any("deep" in w for w in words[0])


def test_a_light_without_a_power_is_refused(tmp_path):
    source = LIGHT.replace('replace(p, name="drive") if p.role == "power" else p for p in', "p for p in").replace(
        "_LED.parameters)", '_LED.parameters if p.role != "power")'
    )
    with pytest.raises(BadPlugin, match="'spot' has no parameter with role='power'"):
        known(written(tmp_path / "own", spot=source))


def test_a_stand_in_carries_an_effect_only_with_what_it_reads(tmp_path):
    registry = known()
    assert registry.carriers(registry.find_effect("stretched coating")) == ("gel",)
    assert set(registry.carriers(registry.find_effect("gel yellowing"))) == {"gel", "elastic_skin"}
    assert "stretch_gain" not in {p.name for p in registry.parameters_of("elastic_skin")}
    file = Path(registry.find_effect("stretched coating").file)
    lacking = (
        file.read_text(encoding="utf-8").replace("reads=STRETCH", 'reads=("strain",)').replace("stretch", "strtch")
    )
    with pytest.raises(BadPlugin, match="no part 'gel' has all that the effect reads: strain"):
        known(written(tmp_path / "own", lacking=lacking))


def test_the_shipped_parts_have_what_their_roles_ask_for(mitsuba, load_bench):
    """The table of the page on parts, on parts of a scene: some are set when a part is made."""
    import re

    text = (shipped("plugins").parent / "docs" / "write-a-part.md").read_text(encoding="utf-8")
    table = text.split("| role | methods and attributes of its class |")[1].split("\n\n")[0]
    told = {row[0]: row[1:] for row in (re.findall(r"`(\w+)`", line) for line in table.splitlines()) if row}
    assert sorted(told) == ["camera", "gel", "led", "membrane"]
    parts = load_bench("gelsight").scene.parts.values()
    for role, names in told.items():
        part = next(p for p in parts if p.role == role)
        assert len(names) > 2 and [n for n in names if not hasattr(part, n)] == []


NAMED = {  # files that read a parameter by its name, and why they may
    "optics/light/paths.py": {"index"},  # the declared meaning of `refracts`
    "optics/scene/crowd.py": {"index"},  # of flat interfaces: the same
    "optics/light/transport.py": {"dop_q", "dop_u"},  # of sources among dielectric bodies, which must not polarize
}


def test_the_library_knows_no_kind_and_reads_no_parameter_by_name():
    """Between scene and study, parts are told apart by role and traits, and parameters are found by role."""
    import ast

    root = shipped("plugins").parent / "optics"
    found = []
    for package in ("scene", "skin", "polarization", "light", "fit", "diagnosis", "study"):
        for file in sorted((root / package).glob("*.py")):
            name = file.relative_to(root.parent).as_posix()
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if not isinstance(node, ast.Call) or not all(isinstance(a, ast.Constant) for a in node.args[1:2]):
                    continue
                call, given = ast.unparse(node.func), [a.value for a in node.args if isinstance(a, ast.Constant)]
                if call == "getattr" and given[:1] == ["kind"]:
                    found.append(f"{name}:{node.lineno}: getattr(..., 'kind')")
                if (
                    call.endswith(".number")
                    and isinstance((given or [0])[0], str)
                    and given[0] not in NAMED.get(name, ())
                ):
                    found.append(f"{name}:{node.lineno}: number({given[0]!r})")
    assert found == []
