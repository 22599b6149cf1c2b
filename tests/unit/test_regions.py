"""Maps of regions: samples beside bare light in one photograph, against plain numpy."""

import math

import numpy as np
import pytest

from optics.captures import capture_set
from optics.captures.capture_set import Captures, Frame
from optics.captures.noise import Noise
from optics.errors import BadScene
from optics.fit import calibrate
from optics.fit.scene_model import SceneModel
from optics.light.rendering import RenderJob
from optics.scene import loader
from optics.scene.parameter import Values, Variable
from optics.scene.regions import PATTERNS, Regions, read_regions

H, W = 12, 16
NOISE = Noise(0.1, 1.5, 64.0, 4095.0, 0.0)
MAP = np.zeros((H, W), np.uint8)
MAP[2:9, 4:9] = 1
MAP[3:11, 11:14] = 2
SAMPLE = {"retard_0": 60.0, "retard_45": 35.0, "depolarization": 0.1, "transmittance": 0.8}
REFERENCE = {"retard_0": -20.0, "retard_45": 90.0}


def plain(analyser, polarizer=0.0):
    """(H, W) between ideal films: 2 (t/4)(1 + (1 - d) a.R p), R the turn of the Poincare sphere by a retarder."""
    a, p = (np.array([math.cos(2 * x), math.sin(2 * x), 0.0]) for x in np.radians([analyser, polarizer]))
    levels = []
    for sheet in ({}, SAMPLE, REFERENCE):
        q, u = (math.radians(sheet.get(k, 0.0)) for k in ("retard_0", "retard_45"))
        delta = math.hypot(q, u)
        axis = np.array([q, u, 0.0]) / delta if delta else np.array([1.0, 0.0, 0.0])
        turned = p * math.cos(delta) + np.cross(axis, p) * math.sin(-delta) + axis * (axis @ p) * (1 - math.cos(delta))
        levels.append(sheet.get("transmittance", 1.0) / 4 * (1 + (1 - sheet.get("depolarization", 0.0)) * (a @ turned)))
    return 2 * np.array(levels)[MAP]


@pytest.fixture
def folder(tmp_path):
    from PIL import Image

    Image.fromarray(MAP).save(tmp_path / "map.png")
    return tmp_path


def model_of(folder, frames):
    scene = loader.load("polariscope", {"width": W, "height": H})
    where = {f"{name}.region_map": "map.png" for name in ("sample", "reference")}
    ideal = {"analyzer.transmittance": 1.0, "polarizer.transmittance": 1.0, "source.power": 2.0}
    return SceneModel(scene, Captures(folder, "polariscope", frames, {**where, **ideal}, NOISE))


ANGLES = ((90.0, 0.0), (0.0, 0.0), (45.0, 0.0), (100.0, 20.0), (60.0, 75.0))
VALUES = {
    **{f"sample.{k}": v for k, v in SAMPLE.items()},
    **{f"reference.{k}": v for k, v in REFERENCE.items()},
}


def frames(rng=None):
    found = []
    for i, (a, p) in enumerate(ANGLES):
        dn = 64 + (4095 - 64) * plain(a, p)[..., None]
        image = dn if rng is None else NOISE.expose(dn, rng)
        settings = {"analyzer.angle": a, "polarizer.angle": p}
        found.append(Frame(str(i), image.astype(np.float32), parameters=settings))
    return found


def test_each_region_of_a_photograph_has_a_sample_of_its_own(mitsuba, folder):
    measured = frames()
    model = model_of(folder, measured)
    for found, frame in zip(model.predict(Values(VALUES)), measured):
        # 12 DN of 4095: rays are up to 5 deg aslant, where retardances differ by sin(5 deg)^2/2 = 0.4 %
        assert np.abs(found - frame.image).max() < 12
    bare = model.predict(Values({}))[1]
    assert np.array_equal(bare[MAP == 0], model.predict(Values(VALUES))[1][MAP == 0])


def test_a_fit_finds_both_samples_at_once(mitsuba, folder):
    model = model_of(folder, frames(np.random.default_rng(2)))
    free = [Variable(k, (k,), model.parameters[k]) for k in ("source.power", *VALUES)]
    # from near the truth: a retardance is found up to its order and sign
    start = {
        "source.power": 1.8,
        **{k: v + 15 if "retard" in k else 0.9 if "trans" in k else 0.0 for k, v in VALUES.items()},
    }
    found = calibrate.fit(model, free, Values(start))
    off = found.estimate - np.array([{"source.power": 2.0, **VALUES}[v.name] for v in free])
    # 4 sd, and what plain numpy leaves out of slanting rays: 0.4 % of the retardance
    assert found.converged and (np.abs(off) < 4 * found.sd + 0.004 * np.abs(found.estimate)).all()
    assert abs(found.chi2 / found.dof - 1) < 0.25


def test_an_effect_has_a_strength_for_each_sample_that_is_there(mitsuba, folder):
    model = model_of(folder, frames())
    effect = model.scene.registry.find_effect("retardance")
    names = [v.name for v in model.scene.variables_of(effect)]
    assert names == [f"{n}.retard_{k}" for k in (0, 45) for n in ("sample", "reference")]
    halves = loader.load("polariscope")  # where no pixel has the number 2
    assert [v.name for v in halves.variables_of(effect)] == ["sample.retard_0", "sample.retard_45"]
    absorption = model.scene.registry.find_effect("sample absorption")
    assert halves.can_express(absorption) and not loader.load("polarizer_bench").can_express(absorption)


def test_photographs_use_all_pixels_but_those_at_bright_edges_that_cross_them(mitsuba, folder):
    """Regions that end on the edges of pixels cost none; where they end within pixels, those at bright edges go."""
    dark = {"sample.transmittance": 0.2}
    whole = SceneModel(
        loader.load("polariscope", {"width": W, "height": H}), Captures(folder, "polariscope", frames(), dark, NOISE)
    )
    text = loader.find("polariscope").read_text(encoding="utf-8")
    region = '<string name="region" value="1"/>'
    assert text.count(region) == 1
    moved = region + '<float name="region_size" value="3"/>'  # mm: pixels of the map are not those of the camera
    (folder / "moved.xml").write_text(text.replace(region, moved).replace('value="halves"', 'value="map.png"'))
    scene = loader.load(folder / "moved.xml", {"width": W, "height": H})
    cut = SceneModel(scene, Captures(folder, str(folder / "moved.xml"), frames(), dark, NOISE))
    assert whole.usable(2).all()
    lost = ~cut.usable(2)[..., 0]
    assert 0 < lost.sum() < 30 and cut.renderer.hits(cut.at(Values(), 2)).edges[lost].all()


@pytest.mark.slow
def test_mi_render_sees_the_same_regions(mitsuba, folder):
    scene = loader.load("polariscope", {"width": W, "height": H, "regions": str(folder / "map.png")})
    values = {**scene.values(), **VALUES, "analyzer.angle": 35.0}
    exact, sampled = (RenderJob(scene, saturation=1.0, spp=spp, layers=()).take(values).camera for spp in (None, 16))
    inner = np.ones((H, W), bool)
    for axis in (0, 1):  # a float32 ray at an edge may fall to either side
        same = np.diff(MAP.astype(int), axis=axis) == 0
        for first in (0, 1):
            cut = tuple(slice(first, n - 1 + first) if k == axis else slice(None) for k, n in enumerate((H, W)))
            inner[cut] &= same
    # 1e-4: the mean over a pixel is not its middle, a tenth of a pixel's step squared
    assert np.abs(exact - sampled)[inner].max() < 1e-4 and exact.std() > 0.02


@pytest.mark.parametrize("name, part", [("polarization_camera", "panel"), ("polariscope", "sample")])
def test_a_map_holds_no_part(mitsuba, name, part):
    """In a circle of references a part would outlive its shape, which Dr.Jit would still ask for."""
    own = loader.load(name, {"width": 4, "height": 4}).parts[part]
    assert own.map_of_regions({"region_map": "halves"}) is not None
    held = list(vars(own.maps).values())
    assert all(thing is not own and getattr(thing, "__self__", None) is not own for thing in held)


def test_maps_lie_as_the_camera_sees_them():
    regions = Regions([[0, 1, 2], [3, 4, 5]], 6.0)  # pixels of 2 mm
    x, y = np.meshgrid([-2.0, 0.0, 2.0], [1.0, -1.0])
    assert np.array_equal(regions(x, y), [[0, 1, 2], [3, 4, 5]])
    assert np.array_equal(regions(x + 1e-30j, y), [[0, 1, 2], [3, 4, 5]])
    assert regions(np.array(99.0), np.array(-99.0)) == 5  # goes on beyond its edge
    assert set(PATTERNS) == {"even", "halves", "quarters"}


@pytest.mark.parametrize(
    "values, said",
    [
        (np.full((4, 4), 9), "values from 9 to 9"),
        (np.full((4, 4), 0.5), "values from 0.5"),
        (np.zeros((4, 4, 2)), "shape"),
        (-np.ones((4, 4)), "values from -1"),
    ],
)
def test_what_is_no_map_is_refused(tmp_path, values, said):
    np.save(tmp_path / "map.npy", values)
    with pytest.raises(BadScene, match=said) as error:
        read_regions(tmp_path / "map.npy")
    assert "map.npy" in str(error.value) and "0 to 7" in str(error.value)


def test_white_on_black_is_a_map(tmp_path):
    np.save(tmp_path / "map.npy", np.array([[0, 255], [255, 0]]))
    assert np.array_equal(read_regions(tmp_path / "map.npy"), [[0, 1], [1, 0]])
    with pytest.raises(BadScene, match="no such file"):
        read_regions(tmp_path / "other.npy")


def test_a_captured_set_keeps_its_map_beside_it(mitsuba, folder):
    """The file that captures.toml names lies in its folder, wherever the program runs."""
    capture_set.write(
        Captures(folder, "polariscope", frames(), {"sample.region_map": "map.png"}, NOISE), folder / "set"
    )
    (folder / "set" / "map.png").write_bytes((folder / "map.png").read_bytes())
    model = SceneModel(
        loader.load("polariscope", {"width": W, "height": H}), capture_set.load(folder / "set"), flat_field=None
    )
    assert model.base["sample.region_map"] == str((folder / "set" / "map.png").resolve())
